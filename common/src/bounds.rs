//! How far a picture can be from its own sheets in exact arithmetic: what the cut-off and the
//! integers cost, at most, on any pixel.
//!
//! These are bounds, argued below, not estimates. They are in a frame's statistics, and
//! `slabcast check` holds pictures against them. In 1/255.

use crate::brick::TightBox;
use crate::message::SceneSpec;
use crate::quality::{Compositing, Quality, Sums};
use crate::transfer::Classifier;
use crate::view::{Projection, View};

/// What integer sums leave free above a solid of the largest extinction: ripple takes at most
/// 5 % for every kernel that `Quality::check` lets through but the narrowest, and the factor of
/// two up to 2^31 takes those. At half, single voxels of narrow kernels overflow; at double,
/// one bit of precision is given away.
const HEADROOM: f64 = 1.05;

/// Raw units of an integer sum for one unit of payload: 2^30 is a sheet of `thickness` vox full
/// of the largest payload (NUMERICS.md section 3).
pub fn raw_per_payload(payload_max: f64, thickness: f64) -> f32 {
    let solid = HEADROOM * payload_max * thickness;
    if solid > 0.0 { (f64::from(1u32 << 30) / solid) as f32 } else { 1.0 }
}

/// Raw units of a 16-bit sum for one unit of payload: 32767 is a sheet of `thickness` vox full of
/// the largest payload.
pub fn short_per_payload(payload_max: f64, thickness: f64) -> f64 {
    let solid = HEADROOM * payload_max * thickness;
    if solid > 0.0 { 32767.0 / solid } else { 1.0 }
}

/// Bound of the cut-off: a shut pixel lets less than eps of the light through, and no colour is
/// brighter than one.
pub fn cutoff(quality: &Quality) -> f64 {
    quality.eps * 255.0
}

/// Bound of the rounding to integers.
///
/// Let a pixel see N sheets and a sheet gather the kernels of m voxels there. Each contribution
/// is rounded by half a raw unit, so a sheet's optical depth tau and each of its colour sums E
/// are off by at most delta = m/2 units. With T the transmittance in front of a sheet,
/// a = 1 - exp(-tau) and psi = a / tau <= 1:
///
/// - alpha is 1 - exp(-sum tau): off by at most N delta;
/// - colour is the sum of T E psi. Its slope in E is T psi; its slope in tau, with what the
///   sheets behind lose, is at most T psi too. So it is off by at most 2 N delta;
/// - the colour rule adds T D phi. D moves by at most (85 G + 48 H + 4) delta / tau when the
///   sums of this sheet and its neighbours do (G <= 2 and H <= 1/2 its gains; a sheet before of
///   2 % of this one, where its weight grows fastest, gives most of it), and |phi| <= tau a / 12.
///   As the T a of all sheets add up to alpha <= 1, the rule adds at most 17 delta *in all*;
/// - the paper's opacity is min(tau, 1): a sheet's light moves by at most 2 delta, and what is
///   behind it by delta: 3 N delta;
/// - colour itself is kept in units of 2^-28, rounded once a sheet: N 2^-29. This is what is
///   left of it where sheets add floats.
///
/// m: a voxel belongs to a cell, and cells of voxels in a box lie in the box grown by half a cell
/// at each face; so there are no more than the grown box has cells.
pub fn quantisation(scene: &SceneSpec, view: &View) -> f64 {
    let whole = TightBox { lo: [0; 3], hi: scene.volume.lattice.dims.map(|n| n - 1) };
    let sheets = view.project(&whole).map_or(0.0, |p| f64::from(p.sheets.len()));
    let fixed_point = sheets * 0.5 / f64::from(1u32 << 28);
    let q = &scene.quality;
    if q.sums == Sums::F32 {
        return 255.0 * fixed_point;
    }
    let payload_max = Classifier::new(&scene.transfer, &scene.volume, q.compositing).payload_max();
    let d = view.thickness;
    let m = &view.eye_from_index;
    let cell = m.x_axis.abs() + m.y_axis.abs() + m.z_axis.abs();
    let r = view.kernel_radius * 2.0 + cell;
    let met = r.x * r.y * (r.z + d) / m.determinant().abs();
    let unit = match q.sums {
        // Payload, section, row and contribution are each rounded by half a unit, and then times
        // weights below one; three weights by 2^-16, times a payload below 2^15: 3.5 units.
        Sums::I16 => 3.5 / short_per_payload(payload_max, d),
        _ => 0.5 / f64::from(raw_per_payload(payload_max, d)),
    };
    let delta = met * unit * longest_secant(view);
    let times = match q.compositing {
        Compositing::Linear => 2.0 * sheets + 17.0,
        Compositing::Constant => 2.0 * sheets,
        Compositing::Paper => 3.0 * sheets,
    };
    255.0 * (times * delta + fixed_point)
}

/// Bound of what f32 opacity loses by being added up, sheet after sheet.
///
/// A += (1 - A) a is rounded by at most 2^-25 a sheet, half the last bit below one. An error of A
/// shrinks with every sheet that follows, so after N sheets it is at most N 2^-25. Colour adds
/// T a c with that T: the errors of T times a telescope to those of A once more, 2 N 2^-25 in all.
/// A million sheets make 15/255; a view of some hundred sheets 0.01.
pub fn accumulation(scene: &SceneSpec, view: &View) -> f64 {
    let whole = TightBox { lo: [0; 3], hi: scene.volume.lattice.dims.map(|n| n - 1) };
    let sheets = view.project(&whole).map_or(0.0, |p| f64::from(p.sheets.len()));
    255.0 * 2.0 * sheets / f64::from(1u32 << 25)
}

/// Of all pixels' rays, the longest between two planes one apart.
fn longest_secant(view: &View) -> f64 {
    match view.projection {
        Projection::Ortho { .. } => 1.0,
        Projection::Persp { focal, .. } => {
            let [u, v] = view.size.map(|n| f64::from(n) * 0.5 / focal);
            (1.0 + u * u + v * v).sqrt()
        }
    }
}
