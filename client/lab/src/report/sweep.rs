//! The settings of the sweep: each quality knob alone, promising combinations, and the work knobs,
//! which change the time only.

use crate::autotune::setting::Setting;
use crate::autotune::trial::Trial;
use serde::Serialize;
use slabcast_common::quality::{Compositing, Kernel, Quality, Sums};
use slabcast_session::direct::Cut;
use std::fmt;

/// The knob that a setting varies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Group {
    /// None: the requested setting.
    #[value(skip)]
    Default,
    Thickness,
    Eps,
    Kernel,
    Sums,
    Compositing,
    Shading,
    Size,
    Combinations,
    Work,
}

/// A change of how the work is divided; displayed as `tile 64`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum WorkKnob {
    Tile(u32),
    Slabs(u32),
    Threads(usize),
}

impl fmt::Display for WorkKnob {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            WorkKnob::Tile(n) => write!(f, "tile {n}"),
            WorkKnob::Slabs(n) => write!(f, "slabs {n}"),
            WorkKnob::Threads(n) => write!(f, "threads {n}"),
        }
    }
}

/// Whether a setting changes the picture or only the division of work.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Knob {
    Quality,
    Work(WorkKnob),
}

/// One setting of the sweep.
#[derive(Clone, Copy, Debug)]
pub(super) struct SweepPoint {
    pub(super) group: Group,
    pub(super) knob: Knob,
    pub(super) setting: Setting,
    pub(super) cut: Cut,
}

/// Edge of tiles in pixels where it is not varied: the default of `bench`.
const TILE_EDGE: u32 = 64;

const THICKNESSES: [f64; 8] = [4.0, 2.0, 1.5, 1.0, 0.75, 0.5, 0.25, 0.125];
const EPSES: [f64; 7] =
    [1.0 / 16.0, 1.0 / 64.0, 1.0 / 128.0, 1.0 / 256.0, 1.0 / 1024.0, 1.0 / 4096.0, 0.0];
/// Factors by which the picture is drawn smaller; 4 leaves one pixel in sixteen.
const SHRINKS: [u32; 2] = [2, 4];
/// Values that are combined: thickness, eps, sums, shrink. One more of each doubles the sweep.
const COMBINED: ([f64; 4], [f64; 3], [Sums; 2], [u32; 2]) = (
    [2.0, 1.0, 0.5, 0.25],
    [1.0 / 64.0, 1.0 / 512.0, 1.0 / 4096.0],
    [Sums::I16, Sums::I32],
    [1, 2],
);

/// Returns the settings that vary the knobs in `only` (all, if empty), the default first. Leaves
/// out invalid settings (16 bits with a tent) and repeats.
pub(super) fn points(trial: &Trial, only: &[Group]) -> Vec<SweepPoint> {
    list(trial.base, trial.size(), trial.threads, trial.is_shaded(), only)
}

fn list(
    base: Setting,
    size: [u32; 2],
    threads: usize,
    shaded: bool,
    only: &[Group],
) -> Vec<SweepPoint> {
    let cut = Cut { threads, tile: TILE_EDGE, slabs: 1 };
    let mut all: Vec<SweepPoint> = Vec::new();
    let mut put = |group: Group, setting: Setting| {
        let wanted = group == Group::Default || only.is_empty() || only.contains(&group);
        let there = all.iter().any(|t| t.setting == setting);
        if wanted && !there && setting.quality.check().is_ok() && setting.drawn_size(size).is_some()
        {
            all.push(SweepPoint { group, knob: Knob::Quality, setting, cut });
        }
    };
    let quality = |q: Quality| Setting { quality: q, ..base };
    let b = base.quality;
    put(Group::Default, base);
    for thickness in THICKNESSES {
        put(Group::Thickness, quality(Quality { thickness, ..b }));
    }
    for eps in EPSES {
        put(Group::Eps, quality(Quality { eps, ..b }));
    }
    for kernel in [Kernel::Gaussian, Kernel::Bspline, Kernel::Tent] {
        let gauss = Quality::before();
        put(Group::Kernel, quality(Quality { kernel, std: gauss.std, radius: gauss.radius, ..b }));
    }
    if b.kernel == Kernel::Gaussian {
        for std in [0.5, 0.7] {
            put(Group::Kernel, quality(Quality { std, ..b }));
        }
        for radius in [1.5, 2.5] {
            put(Group::Kernel, quality(Quality { radius, ..b }));
        }
    }
    for sums in [Sums::I16, Sums::I32, Sums::F32] {
        put(Group::Sums, quality(Quality { sums, ..b }));
    }
    for compositing in [Compositing::Linear, Compositing::Constant, Compositing::Paper] {
        put(Group::Compositing, quality(Quality { compositing, ..b }));
    }
    if shaded {
        put(Group::Shading, Setting { shaded: false, ..base });
    }
    for shrink in SHRINKS {
        put(Group::Size, Setting { shrink, ..base });
    }
    let (thicknesses, epses, sums, shrinks) = COMBINED;
    for shrink in shrinks {
        for thickness in thicknesses {
            for eps in epses {
                for sums in sums {
                    let q = Quality { thickness, eps, sums, ..b };
                    put(Group::Combinations, Setting { quality: q, shrink, ..base });
                }
            }
        }
    }
    if only.is_empty() || only.contains(&Group::Work) {
        let mut work = |knob: WorkKnob, cut: Cut| {
            all.push(SweepPoint { group: Group::Work, knob: Knob::Work(knob), setting: base, cut });
        };
        for tile in [16, 32, 64, 128, 256] {
            work(WorkKnob::Tile(tile), Cut { tile, ..cut });
        }
        for slabs in [1, 3, 5, 10] {
            work(WorkKnob::Slabs(slabs), Cut { slabs, ..cut });
        }
        let mut n = 1;
        while n < threads {
            work(WorkKnob::Threads(n), Cut { threads: n, ..cut });
            n *= 2;
        }
        work(WorkKnob::Threads(threads), cut);
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_setting_is_tried_once_and_may_be_drawn() {
        let base = Setting::asked(Quality::before());
        let all = list(base, [512, 512], 4, true, &[]);
        assert!(all.len() > 60, "{}", all.len());
        assert_eq!(all[0].setting, base);
        for (i, t) in all.iter().enumerate() {
            assert!(t.setting.quality.check().is_ok());
            let again =
                all[i + 1..].iter().any(|o| o.group != Group::Work && o.setting == t.setting);
            assert!(!again || t.group == Group::Work, "{t:?} comes twice");
        }
        for group in [
            Group::Thickness,
            Group::Eps,
            Group::Kernel,
            Group::Sums,
            Group::Compositing,
            Group::Shading,
            Group::Size,
            Group::Combinations,
            Group::Work,
        ] {
            assert!(all.iter().any(|t| t.group == group), "{group:?}");
        }
        let threads: Vec<_> = all
            .iter()
            .filter_map(|t| match t.knob {
                Knob::Work(WorkKnob::Threads(n)) => Some(n),
                _ => None,
            })
            .collect();
        assert_eq!(threads, [1, 2, 4]);
    }

    #[test]
    fn what_is_not_wanted_or_not_there_is_left_out() {
        let base = Setting::asked(Quality::before());
        let few = list(base, [511, 512], 1, false, &[Group::Size, Group::Shading]);
        assert_eq!(few.len(), 1, "odd pictures are not halved, and there is no light: {few:?}");
        let eps = list(base, [512, 512], 1, true, &[Group::Eps]);
        assert!(eps[1..].iter().all(|t| t.group == Group::Eps) && eps.len() == 8);
        let tent = Quality { kernel: Kernel::Tent, ..Quality::before() };
        let all = list(Setting::asked(tent), [512, 512], 1, true, &[]);
        assert!(all.iter().all(
            |t| t.setting.quality.kernel != Kernel::Tent || t.setting.quality.sums != Sums::I16
        ));
    }
}
