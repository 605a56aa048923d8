//! `pick`: which values made a pixel.
//!
//! A ray is followed through samples between which values are linear, in steps of half a vox, and each
//! step counts by the light that reaches the eye from it. A picture is drawn with wider kernels and in
//! sheets, so shares are those of the pixel to a few percent; they name values to show more or less of.

use glam::DVec3;
use serde_json::{Value, json};
use slabcast_common::math::srgb_from_linear;
use slabcast_common::quality::Compositing;
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::{NEAR, Projection, View};
use slabcast_common::volume::{Samples, VolumeInfo};
use slabcast_scene::path::CropBox;

/// Length of a step in vox.
const STEP: f64 = 0.5;

/// Steps of a ray at most.
const MOST_STEPS: usize = 200_000;

/// Bins of the values that a ray met, from which ranges are made.
const BINS: usize = 48;

/// Ranges that are told.
const RANGES: usize = 8;

/// Share of a pixel's light below which a bin counts as empty.
const FAINT: f64 = 0.002;

/// Samples of a box of a level: those from `lo` on, `dims` of them.
pub(crate) struct Field<'a> {
    pub(crate) info: &'a VolumeInfo,
    pub(crate) samples: &'a Samples,
}

impl Field<'_> {
    fn at(&self, index: [i64; 3]) -> f64 {
        let dims = self.info.lattice.dims;
        let [i, j, k] = std::array::from_fn(|a| index[a].clamp(0, i64::from(dims[a]) - 1) as usize);
        let n = (k * dims[1] as usize + j) * dims[0] as usize + i;
        match self.samples {
            Samples::U8(v) => f64::from(v[n]),
            Samples::U16(v) => f64::from(v[n]),
            Samples::F32(v) => f64::from(v[n]),
        }
    }

    /// Returns the code at an index position, linear between samples.
    fn code(&self, p: DVec3) -> f64 {
        let base = p.floor();
        let t = p - base;
        let b = [base.x as i64, base.y as i64, base.z as i64];
        let mut sum = 0.0;
        for corner in 0..8u8 {
            let bit = |axis: u8| i64::from(corner >> axis & 1);
            let share = |axis: u8, t: f64| if bit(axis) == 1 { t } else { 1.0 - t };
            let weight = share(0, t.x) * share(1, t.y) * share(2, t.z);
            if weight > 0.0 {
                sum += weight * self.at([b[0] + bit(0), b[1] + bit(1), b[2] + bit(2)]);
            }
        }
        sum
    }
}

/// Light that came from one step of a ray.
struct Seen {
    code: f64,
    share: f64,
    rgb: [f64; 3],
}

/// Returns what a pixel shows, as the fields of `picked`.
pub(crate) fn picked(
    field: &Field<'_>,
    view: &View,
    tf: &TransferFunction,
    crop: Option<&CropBox>,
    [x, y]: [u32; 2],
) -> Value {
    let info = field.info;
    let lattice = &info.lattice;
    let classifier = Classifier::new(tf, info, Compositing::Linear);
    let inverse = view.eye_from_index.inverse();
    let dims = lattice.dims.map(f64::from);
    let screen = DVec3::new(
        f64::from(x) + 0.5 - f64::from(view.size[0]) / 2.0,
        f64::from(y) + 0.5 - f64::from(view.size[1]) / 2.0,
        0.0,
    );
    // A position on the ray at depth z, in eye coordinates, and the ray's length for a step of z.
    let (nearest, stretch) = match view.projection {
        Projection::Ortho { .. } => (f64::NEG_INFINITY, 1.0),
        Projection::Persp { focal, distance } => {
            let slope = screen.length() / focal;
            (NEAR * distance - distance, (1.0 + slope * slope).sqrt())
        }
    };
    let at = |z: f64| match view.projection {
        Projection::Ortho { scale } => DVec3::new(screen.x / scale, screen.y / scale, z),
        Projection::Persp { focal, distance } => {
            let scale = focal / (z + distance);
            DVec3::new(screen.x / scale, screen.y / scale, z)
        }
    };
    let corners = (0..8u8).map(|corner| {
        let end = |axis: usize| if corner >> axis & 1 == 1 { dims[axis] - 0.5 } else { -0.5 };
        (view.eye_from_index * DVec3::new(end(0), end(1), end(2)) + view.eye_origin).z
    });
    let (from, to) =
        corners.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), z| (a.min(z), b.max(z)));
    let (from, step) = (from.max(nearest), STEP / stretch);
    let steps = (((to - from) / step).ceil().max(0.0) as usize).min(MOST_STEPS);
    let mut left = 1.0;
    let mut seen: Vec<Seen> = Vec::new();
    let (mut stopped, mut hit) = (Vec::new(), None);
    for n in 0..steps {
        let z = from + (n as f64 + 0.5) * step;
        let index = inverse * (at(z) - view.eye_origin);
        let inside = (0..3).all(|a| index[a] >= -0.5 && index[a] <= dims[a] - 0.5);
        if !inside {
            continue;
        }
        let voxel =
            std::array::from_fn(|a| (index[a].round().max(0.0) as u32).min(lattice.dims[a] - 1));
        if crop.is_some_and(|crop| !crop.contains(lattice, voxel)) {
            continue;
        }
        let code = field.code(index);
        let [sigma, r, g, b] = classifier.optics_at(code);
        if sigma <= 0.0 {
            continue;
        }
        let share = left * (1.0 - libm::exp(-sigma * STEP));
        seen.push(Seen { code, share, rgb: [r, g, b] });
        left -= share;
        stopped.push((1.0 - left, z, index, code));
        if left < 1e-4 {
            break;
        }
    }
    let alpha = 1.0 - left;
    // Half of the light that is stopped at all.
    if let Some(half) = stopped.iter().find(|(so_far, ..)| *so_far >= alpha / 2.0) {
        let (_, z, index, code) = *half;
        let s = lattice.steps;
        let world = lattice.origin + s[0] * index.x + s[1] * index.y + s[2] * index.z;
        hit = Some((world, z * lattice.vox(), code));
    }
    let value = |code: f64| info.summary.map.offset + info.summary.map.scale * code;
    json!({
        "hit": hit.map(|(world, ..)| world.to_array()),
        "depth": hit.map(|(_, depth, _)| depth),
        "value": hit.map(|(_, _, code)| value(code)),
        "ranges": ranges(&seen, alpha, value),
        "alpha": alpha,
    })
}

/// Joins values into ranges between which nothing was seen, the largest share first.
fn ranges(seen: &[Seen], alpha: f64, value: impl Fn(f64) -> f64) -> Vec<Value> {
    let codes = seen.iter().map(|s| s.code);
    let (lo, hi) = codes.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), c| (a.min(c), b.max(c)));
    if seen.is_empty() || alpha <= 0.0 {
        return Vec::new();
    }
    let width = ((hi - lo) / BINS as f64).max(f64::MIN_POSITIVE);
    let mut bins = [(0.0, [0.0; 3]); BINS];
    for s in seen {
        let bin = &mut bins[(((s.code - lo) / width) as usize).min(BINS - 1)];
        bin.0 += s.share;
        (0..3).for_each(|c| bin.1[c] += s.share * s.rgb[c]);
    }
    let is_faint = |bin: &(f64, [f64; 3])| bin.0 < FAINT * alpha;
    let mut found: Vec<(usize, usize, f64, [f64; 3])> = Vec::new();
    for (i, bin) in bins.iter().enumerate().filter(|(_, bin)| !is_faint(bin)) {
        match found.last_mut() {
            // A quarter of the range at most, so that shares say something.
            Some(last) if last.1 == i && i - last.0 < BINS / 4 => {
                last.1 = i + 1;
                last.2 += bin.0;
                (0..3).for_each(|c| last.3[c] += bin.1[c]);
            }
            _ => found.push((i, i + 1, bin.0, bin.1)),
        }
    }
    found.sort_by(|a, b| b.2.total_cmp(&a.2));
    found.truncate(RANGES);
    let told = found.into_iter().map(|(first, end, share, rgb)| {
        let [r, g, b] =
            rgb.map(|c| (srgb_from_linear((c / share).clamp(0.0, 1.0)) * 255.0).round());
        let ends = [first, end].map(|n| value(lo + n as f64 * width));
        json!({
            "from": ends[0].min(ends[1]), "to": ends[0].max(ends[1]), "share": share / alpha,
            "color": format!("#{:02x}{:02x}{:02x}", r as u8, g as u8, b as u8),
        })
    });
    told.collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::quality::Quality;
    use slabcast_common::view::{Camera, CameraProjection};
    use slabcast_common::volume::{Digest32, Volume};
    use slabcast_scene::presets;

    /// A ball of 200 of radius 10 within air, in a volume of 40 samples each way.
    fn ball() -> Volume {
        Volume::from_fn_u8("ball", [40; 3], |i, j, k| {
            let d2: f64 = [i, j, k].iter().map(|&n| (f64::from(n) - 19.5).powi(2)).sum();
            if d2 <= 100.0 { 200 } else { 0 }
        })
    }

    fn pick_at(projection: CameraProjection, pixel: [u32; 2]) -> Value {
        let volume = ball();
        let info = volume.info(Digest32::default());
        let camera = Camera {
            target: DVec3::ZERO,
            to_eye: DVec3::new(0.0, -1.0, 0.0),
            up: DVec3::new(0.0, 0.0, 1.0),
            projection,
        };
        let view = View::new(&info.lattice, &camera, [80, 80], &Quality::default()).unwrap();
        let tf = presets::by_name("peer-skull", &info.summary).unwrap();
        let field = Field { info: &info, samples: volume.codes() };
        picked(&field, &view, &tf, None, pixel)
    }

    #[test]
    fn middle_of_a_ball_is_hit_at_its_surface_and_its_corner_nowhere() {
        for projection in [
            CameraProjection::Ortho { height: 40.0 },
            CameraProjection::Persp { fov: 30.0, distance: 100.0 },
        ] {
            let middle = pick_at(projection, [40, 40]);
            let alpha = middle["alpha"].as_f64().unwrap();
            assert!(alpha > 0.99, "{middle}");
            let depth = middle["depth"].as_f64().unwrap();
            assert!((depth + 10.0).abs() < 1.5, "in front of the target, by the radius: {middle}");
            let hit = middle["hit"][1].as_f64().unwrap();
            let centre = 19.5;
            assert!((hit - (centre - 10.0)).abs() < 1.5, "{middle}");
            let shares: f64 = middle["ranges"]
                .as_array()
                .unwrap()
                .iter()
                .map(|range| range["share"].as_f64().unwrap())
                .sum();
            assert!(shares > 0.9 && shares < 1.001, "{middle}");
            let corner = pick_at(projection, [1, 1]);
            assert!(corner["hit"].is_null() && corner["ranges"].as_array().unwrap().is_empty());
        }
    }
}
