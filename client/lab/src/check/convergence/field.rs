//! A sweep over plane distances of a scene that is classified after reconstruction.

use super::sweep::{Deviation, SweepScene};
use super::{fraction, number, order};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::view::{Camera, View};
use slabcast_render::judge::reference::{FieldReference, stratified};
use slabcast_render::{Frame, Scene};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::SceneBricks;
use slabcast_session::progress::Progress;
use std::fmt::Write;
use std::sync::Arc;

/// Errors of one plane distance.
struct PlaneFigures {
    /// Distance of the planes in vox.
    thickness: f64,
    /// 32-bit sums against the limit.
    longs: Deviation,
    /// 16-bit sums against the limit.
    shorts: Deviation,
}

/// Results of a sweep.
pub(super) struct FieldSweep {
    name: String,
    projection: &'static str,
    /// Pixels compared.
    pixels: usize,
    figures: Vec<PlaneFigures>,
}

/// Sweeps `thicknesses`, of which those that fields are not drawn with are left out, from `camera`.
pub(super) fn sweep(
    subject: &SweepScene,
    projection: &'static str,
    camera: &Camera,
    thicknesses: &[f64],
    threads: usize,
    progress: &mut Progress,
) -> Result<FieldSweep, Fail> {
    let base = Quality { eps: 0.0, thickness: 1.0, sums: Sums::I32, ..subject.quality };
    let drawn = SceneBricks::new(&subject.volume, &subject.info, &subject.transfer, base)?;
    let view = |quality: &Quality| {
        View::new(&subject.info.lattice, camera, subject.size, quality)
            .map_err(|e| Fail::failed(format!("{}: {e}", subject.name)))
    };
    let sample = stratified(subject.size, subject.pixels, subject.seed);
    progress.phase(&format!("{}, {projection}: the limit", subject.name));
    let reference = FieldReference::new(&drawn.spec, view(&base)?, &drawn.bricks);
    let limit = direct::map_parallel(sample.len(), threads, |i, _: &mut ()| {
        reference.pixel(sample[i][0], sample[i][1])
    });
    let mut figures = Vec::new();
    for &thickness in thicknesses {
        let quality = |sums| Quality { thickness, sums, ..base };
        if quality(Sums::I32).check().is_err() {
            continue;
        }
        progress.phase(&format!("{}, {projection}: {thickness} vox", subject.name));
        let deviation = |sums| {
            let quality = quality(sums);
            let spec = SceneSpec { quality, ..drawn.spec.clone() };
            let frame = Frame::new(Arc::new(Scene::new(&spec)), view(&quality)?);
            let picture = direct::draw(&frame, &drawn.bricks, Cut::on(threads));
            let at = |p: &[u32; 2]| picture.pixels[(p[1] * subject.size[0] + p[0]) as usize];
            let got: Vec<[f64; 4]> = sample.iter().map(|p| at(p).map(f64::from)).collect();
            Ok::<_, Fail>(Deviation::between(&got, &limit))
        };
        let (longs, shorts) = (deviation(Sums::I32)?, deviation(Sums::I16)?);
        figures.push(PlaneFigures { thickness, longs, shorts });
    }
    let pixels = limit.iter().filter(|p| p[3] > 0.0).count();
    Ok(FieldSweep { name: subject.name.clone(), projection, pixels, figures })
}

impl FieldSweep {
    /// Returns the sweep as a table.
    pub(super) fn text(&self) -> String {
        let mut out = format!(
            "{}, {}: {} pixels that are not blank; RMSE in 1/255\n  vox |     i32  order     max \
             |     i16\n",
            self.name, self.projection, self.pixels
        );
        let mut before = None;
        for f in &self.figures {
            let _ = writeln!(
                out,
                "{:>5} | {:>7} {:>6} {:>7} | {:>7}",
                fraction(f.thickness),
                number(f.longs.rmse),
                order(before, f.longs.rmse),
                number(f.longs.max),
                number(f.shorts.rmse),
            );
            before = Some(f.longs.rmse);
        }
        out + "\n"
    }

    /// Returns the sweep as a line of JSON.
    pub(super) fn json(&self) -> String {
        let figures = |f: &PlaneFigures| {
            serde_json::json!({
                "thickness": f.thickness, "rmse": f.longs.rmse, "max": f.longs.max,
                "i16": {"rmse": f.shorts.rmse, "max": f.shorts.max}
            })
        };
        let value = serde_json::json!({
            "scene": self.name, "projection": self.projection, "classify": "after",
            "pixels": self.pixels, "figures": self.figures.iter().map(figures).collect::<Vec<_>>()
        });
        value.to_string() + "\n"
    }
}
