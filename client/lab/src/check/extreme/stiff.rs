//! Stiffness: extinctions of 10^0 to 10^6 per vox (docs/design/promises.md, R34). Opacity never
//! goes above one, and halving the sheets never makes a picture worse, down to the floor of
//! rounding.

use super::scene::{extinction, rough, shot};
use crate::check::case::{Case, Row};
use crate::check::shot::{ReferenceKind, Shot};
use slabcast_common::quality::Quality;

/// From twice a vox to a sixteenth.
const THICKNESSES: [f64; 6] = [2.0, 1.0, 0.5, 0.25, 0.125, 0.0625];
/// Pixels of the sample. At half, the ratios of the stiffest scenes scatter by more than their
/// tolerance.
const PIXELS: usize = 512;

pub(super) fn cases() -> Vec<Case> {
    (0..=6)
        .map(|power| {
            Case::new(format!("stiffness 1e{power}, sheets from 2 to 1/16 vox"), move |tools| {
                let sigma = libm::pow(10.0, f64::from(power));
                let s = shot(
                    rough([16, 14, 12]),
                    extinction(&[[0.0, 0.0], [39.0, 0.0], [40.0, sigma]]),
                );
                let s = Shot { quality: Quality { eps: 0.0, ..s.quality }, ..s };
                let ready = s.ready()?;
                let sample = ready.sample(PIXELS);
                let limit = ready.truth(ReferenceKind::Limit, &sample, tools);
                let mut above = 0.0f64;
                let (mut before, mut worst) = (f64::NAN, 0.0f64);
                let mut floor_at = None;
                for thickness in THICKNESSES {
                    let r = ready.with(Quality { thickness, ..ready.spec.quality });
                    let picture = r.serial();
                    above = picture.pixels.iter().fold(above, |m, p| m.max(f64::from(p[3]) - 1.0));
                    let got = wide(&r.at(&picture, &sample));
                    let sheets = r.truth(ReferenceKind::SameSheets, &sample, tools);
                    let (error, floor) = (rmse(&got, &limit), rmse(&got, &sheets));
                    // Below it positions and f32 decide, which no sheet makes better.
                    if rmse(&sheets, &limit) < floor {
                        floor_at = Some(thickness);
                        break;
                    }
                    if before.is_finite() {
                        worst = worst.max(error / before);
                    }
                    before = error;
                }
                let to = floor_at.map_or(String::new(), |d| format!(", floor at {d}"));
                Ok(vec![
                    Row::new("max of alpha above one", above, 0.0),
                    Row::new(format!("RMSE at d/2 over RMSE at d{to}"), worst, 1.05),
                ])
            })
        })
        .collect()
}

fn wide(pixels: &[[f32; 4]]) -> Vec<[f64; 4]> {
    pixels.iter().map(|p| p.map(f64::from)).collect()
}

fn rmse(a: &[[f64; 4]], b: &[[f64; 4]]) -> f64 {
    let off = a.iter().flatten().zip(b.iter().flatten()).map(|(x, y)| (x - y) * (x - y));
    255.0 * (off.sum::<f64>() / (4 * a.len()) as f64).sqrt()
}
