//! Invariance: changes that must not change a picture (unit of length, origin, storage order,
//! sample type, empty borders, extra points on a transfer function's lines), and monotony: thinner
//! sheets are not worse, and more opacity does not let more light through.
//!
//! Each bound is zero (no byte may differ) or derived where it stands, but for [`CUT_OTHERWISE`].
//! Positions are rounded, so two ways to compute one position could fall on two sides of a
//! boundary. They differ by 1e-13 pixels or so and boundaries are 1/256 pixel apart: no scene here
//! has a voxel that near to one.

use super::case::{Case, Row};
use super::changes::Turn;
use super::invariance_scenes::{
    BYTES, Effort, FIELD_SUMS, InvarianceCase, LARGEST, Scene, VIEWS, cropped, largest, mirrored,
    pixels_that_differ, rolled,
};
use super::shot::{ReferenceKind, Shot};
use glam::DVec3;
use slabcast_common::image::{Background, Picture};
use slabcast_common::quality::{Classify, Quality};
use slabcast_common::shade::Light;
use slabcast_common::transfer::{ColorSpace, TransferFunction};
use slabcast_render::judge::reference::ErrorFigures;
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;

/// A picture on its side against the upright one where the kernel leans, in 1/255. Such a kernel is
/// a product of profiles along two axes across the depth, and these are others then; a Gaussian
/// does not feel that, but each profile has its edge value taken away, 0.0039 of its peak. As much
/// as 5 % of a voxel's weight may move by two steps, which bounds nothing; 0.2 to 0.5 is what it
/// comes to.
const CUT_OTHERWISE: f64 = 1.0;

/// Largest difference of a field's opacity from the front and from behind, in 1/255. Planes are the
/// same, but segments are cut into sub-steps from the eye's side, which may cost 0.05, and gradients
/// count where opacity depends on them. 0.28 was the largest seen.
const FIELD_FROM_BEHIND: f64 = 0.5;

/// Largest difference of a field on its side from the upright one where the kernel leans, in 1/255. The
/// leaning B-spline is a product of profiles along other axes then. 1.3 was the largest seen.
const FIELD_LEANS_OTHERWISE: f64 = 2.0;

/// Error of fields that thinner planes don't make smaller, in 1/255: positions are rounded to 1/256
/// pixel, which turns normals (docs/design/sharp.md).
const FIELD_FLOOR: f64 = 0.1;

const EFFORT: Effort = Effort { samples: 48, size: [160, 128], pixels: 2000, every: 5 };

/// Returns the cases of the group, classified before reconstruction.
pub(crate) fn cases() -> Vec<Case> {
    with(EFFORT, Classify::Before)
}

/// Returns the same cases, classified after reconstruction.
pub(super) fn of_fields() -> Vec<Case> {
    with(EFFORT, Classify::After)
}

fn with(effort: Effort, order: Classify) -> Vec<Case> {
    let mut cases = Vec::new();
    for scene in [Scene::Opaque, Scene::Translucent, Scene::Stiff, Scene::Boxes] {
        if order == Classify::After && scene == Scene::Stiff {
            // Fields are summed in whole numbers alone.
            continue;
        }
        let checks: [(&str, Check); 8] = [
            ("unit of length", units),
            ("origin", origins),
            ("axes", axes),
            ("empty borders", borders),
            ("types of samples", types),
            ("parts, sides and channels", pictures),
            ("more opacity", opacity),
            ("thinner sheets", sheets),
        ];
        for (name, check) in checks {
            cases.push(Case::new(format!("{name}, {}", scene.name()), move |tools| {
                check(&InvarianceCase { scene, effort, shot: scene.shot(effort, order)?, tools })
            }));
        }
    }
    cases.push(Case::new("points on a transfer function's lines", move |tools| {
        let scene = Scene::Opaque;
        points(&InvarianceCase { scene, effort, shot: scene.shot(effort, order)?, tools })
    }));
    cases
}

/// One invariance of one scene.
type Check = fn(&InvarianceCase) -> Result<Vec<Row>, Fail>;

/// Scales lengths. Powers of two change nothing. Other factors round lengths in their
/// last bit, 1e-16 of them, and weights and looks, kept in f32, then change in one case of 10^8.
/// The bound is 1/255 in at most 0.01 % of the pixels.
fn units(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let powers = case.same_bytes("powers of 2", |s| {
        [-60, -30, -1, 10, 30, 60].map(|e| s.scaled(2f64.powi(e))).into()
    })?;
    let (mut off, mut share) = (0.0f64, 0.0f64);
    for (shot, want) in case.views()? {
        for s in [1e-9, 1e-6, 0.0706, 0.7, 3.0, 25.4, 1e6, 1e9] {
            let got = case.picture(&shot.scaled(s))?;
            off = off.max(largest(&want, &got));
            let differ = pixels_that_differ(&want, &got) as f64;
            share = share.max(100.0 * differ / want.pixels.len() as f64);
        }
    }
    Ok(vec![
        powers,
        Row::new(format!("{LARGEST}: 1e-9 to 1e9"), off, 1.0),
        Row::new("% of pixels that differ: 1e-9 to 1e9", share, 0.01),
    ])
}

/// 10^7 voxels away. Nothing differs while corner, centre, eye and target can be represented
/// there: they are multiples of 2^-29, since 10^7 < 2^24 and f64 has 53 bits. Where the eye
/// cannot be, it is off by at most 2^-30; see `units` for what that does.
fn origins(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let vox = case.shot.volume.lattice.vox();
    let exact = case.same_bytes("1e7 voxels away", |s| {
        [DVec3::splat(1e7), DVec3::new(-1e7, 3e6, 0.5)].map(|by| s.moved(by * vox)).into()
    })?;
    let (mut off, n) = (0.0f64, case.shot.volume.lattice.largest_extent());
    for (mut shot, _) in case.views()? {
        shot.view.eye.iter_mut().for_each(|x| *x += n * 0.1);
        let want = case.picture(&shot)?;
        let got = case.picture(&shot.moved(DVec3::new(1e7, 3e6, -1e7) * vox))?;
        off = off.max(largest(&want, &got));
    }
    Ok(vec![exact, Row::new(format!("{LARGEST}: eye rounded"), off, 1.0)])
}

/// Axes permuted and flipped, of the samples alone (each stays where it is) and of the world with
/// its camera. Normals have other codes in another world; without light nothing differs. Floats
/// are added in another order.
///
/// The other world is lit from the eye. A light from aside has a jump: a normal at right angles
/// to the eye's direction is turned towards the eye by its last bit, and then faces the light
/// or does not. With such a light pixels at silhouettes differ by 15/255 and more.
fn axes(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let turns: Vec<Turn> = Turn::all().into_iter().skip(1).step_by(case.effort.every).collect();
    let (mut stored, mut turned) = (0.0f64, 0.0f64);
    for (shot, want) in case.views()? {
        for t in &turns {
            stored = stored.max(largest(&want, &case.picture(&shot.stored(*t))?));
        }
        let mut lit = shot.clone();
        lit.transfer.shading.light = Light::Head;
        let want = case.picture(&lit)?;
        for t in &turns {
            let got = case.picture(&lit.turned(*t))?;
            let got = if t.mirrors() { mirrored(&got) } else { got };
            turned = turned.max(largest(&want, &got));
        }
    }
    let order = case.other_order();
    let coded = case.shot.transfer.shading.on && !case.is_field();
    let normals = if coded { 255.0 * case.normals() } else { 0.0 };
    Ok(vec![
        Row::new(format!("{LARGEST}: of storage"), stored, order),
        Row::new(format!("{LARGEST}: with the camera"), turned, order + normals),
    ])
}

/// More empty samples around a volume that has one layer of them (gradients look one sample
/// far). The camera stays; bricks and the volume's centre move, and with the bricks the order in
/// which floats are added.
fn borders(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    // A field is divided by the kernel's weight inside the volume, so borders as wide as a turned
    // kernel count.
    let base = if case.is_field() { 4 } else { 1 };
    let mut off = 0.0f64;
    for (shot, _) in case.views()? {
        let want = case.picture(&shot.padded(base))?;
        for n in [1, 3, 8] {
            off = off.max(largest(&want, &case.picture(&shot.padded(base + n))?));
        }
    }
    Ok(vec![Row::new(LARGEST, off, case.other_order())])
}

/// Values stored as 8-bit codes, 16-bit codes and floats give one picture; of a field, whose sums
/// have units of the range of codes, one up to [`FIELD_SUMS`].
fn types(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    if case.scene == Scene::Stiff {
        // Its values have 16 bits, of which floats hold all.
        return Ok(vec![case.same_bytes("u16, f32", |s| vec![s.in_floats()])?]);
    }
    let others = |s: &Shot| vec![s.in_16_bits(1), s.in_16_bits(256), s.in_floats()];
    if !case.is_field() {
        return Ok(vec![case.same_bytes("u8, u16, f32", others)?]);
    }
    let mut off = 0.0f64;
    for (shot, want) in case.views()? {
        for other in others(&shot) {
            off = off.max(largest(&want, &case.picture(&other)?));
        }
    }
    Ok(vec![Row::new(format!("{LARGEST}: u8, u16, f32"), off, FIELD_SUMS)])
}

/// A part of a larger picture; red and blue exchanged; the camera on its side, where weights are
/// multiplied in another order; opacity from behind, where sheets come in the other order.
fn pictures(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let [w, h] = case.shot.size;
    let (shot, want) = case.views()?.swap_remove(0);
    let mut large = Shot { size: [w + 64, h + h / 2], ..shot.clone() };
    large.view.height = large.view.height.map(|x| x * 1.5);
    let part = cropped(&case.picture(&large)?, [32, h / 4], [w, h]);

    let mut swapped = shot.clone();
    swapped.transfer.colors.iter_mut().for_each(|c| c.swap(1, 3));
    let mut swapped = case.picture(&swapped)?;
    swapped.pixels.iter_mut().for_each(|p| p.swap(0, 2));

    let mut square = Shot { size: [h, h], ..shot };
    square.quality.eps = 0.0;
    let upright = case.picture(&square)?;
    let target = DVec3::from_array(square.view.target);
    let to_eye = DVec3::from_array(square.view.eye) - target;
    let mut side = square.clone();
    side.view.up = to_eye.cross(DVec3::from_array(square.view.up)).to_array();
    let side = rolled(&case.picture(&side)?);
    let mut behind = square;
    behind.view.eye = (target - to_eye).to_array();
    let behind = mirrored(&case.picture(&behind)?);
    let alpha = |p: &Picture| {
        let pixels = p.pixels.iter().map(|p| [p[3]; 4]).collect();
        Picture { size: p.size, pixels }
    };
    let bound = 255.0 * 2.0 * case.rounding();
    let side_bound = match (case.scene, case.is_field()) {
        (Scene::Boxes, false) => CUT_OTHERWISE,
        (Scene::Boxes, true) => FIELD_LEANS_OTHERWISE,
        _ => bound,
    };
    let behind_bound = if case.is_field() { FIELD_FROM_BEHIND } else { bound };
    let bytes = |what: &str, got: &Picture| {
        Row::new(format!("{BYTES}: {what}"), pixels_that_differ(&want, got) as f64, 0.0)
    };
    Ok(vec![
        bytes("part of more", &part),
        bytes("red for blue", &swapped),
        Row::new(format!("{LARGEST}: on its side"), largest(&upright, &side), side_bound),
        Row::new(
            format!("{LARGEST}: A from behind"),
            largest(&alpha(&upright), &alpha(&behind)),
            behind_bound,
        ),
    ])
}

/// Opacities raised, point by point: no pixel becomes less opaque but by rounding, and, where
/// pixels are shut, by what that leaves out, at most eps.
fn opacity(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let raises = [|a: f64| 1.01 * a, |a: f64| 2.0 * a, |a: f64| a * (1.25 - 0.25 * a.min(1.0))];
    let most = if case.scene == Scene::Stiff { f64::INFINITY } else { 1.0 };
    let mut rows = Vec::new();
    for eps in [0.0, Quality::before().eps] {
        let mut lost = 0.0f64;
        for (mut shot, _) in case.views()? {
            shot.quality.eps = eps;
            let less = case.picture(&shot)?;
            for raise in raises {
                let mut more = shot.clone();
                more.transfer.opacities.iter_mut().for_each(|o| o[1] = raise(o[1]).min(most));
                let more = case.picture(&more)?;
                let pairs = less.pixels.iter().zip(&more.pixels);
                lost = pairs.map(|(l, m)| f64::from(l[3] - m[3])).fold(lost, f64::max);
            }
        }
        let bound = 255.0 * (eps + 2.0 * case.rounding());
        rows.push(Row::new(format!("opacity lost, eps {eps:.4}"), 255.0 * lost, bound));
    }
    Ok(rows)
}

/// Sheets half as thick are not worse than before by more than 5 %, down to the floor: what
/// rounded positions and sums leave at that thickness, found against the same sheets in f64.
fn sheets(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    if case.is_field() {
        return planes(case);
    }
    let mut rows = Vec::new();
    for at in [0, 2] {
        let (mut shot, _) = case.views()?.swap_remove(at);
        shot.quality.eps = 0.0;
        let sample = shot.ready()?.sample(case.effort.pixels);
        let limit = shot.ready()?.truth(ReferenceKind::Limit, &sample, case.tools);
        let (mut before, mut worst) = (f64::INFINITY, 0.0f64);
        for d in [2.0, 1.0, 0.5, 0.25, 0.125] {
            shot.quality.thickness = d;
            let ready = shot.ready()?;
            let got = ready.at(&ready.picture(Cut::on(case.tools.threads)), &sample);
            let same = ready.truth(ReferenceKind::SameSheets, &sample, case.tools);
            let black = Background::Colour([0.0; 3]);
            let rmse = |want: &[[f64; 4]]| ErrorFigures::compare(&got, want, black).rmse;
            let (now, floor) = (rmse(&limit), rmse(&same));
            worst = worst.max(now / f64::max(before, floor));
            before = now;
        }
        rows.push(Row::new(format!("RMSE over that before: {}", VIEWS[at].0), worst, 1.05));
    }
    Ok(rows)
}

/// Planes of a field nearer to each other are not worse by more than 5 %, down to [`FIELD_FLOOR`].
fn planes(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let mut rows = Vec::new();
    for at in [0, 2] {
        let (mut shot, _) = case.views()?.swap_remove(at);
        shot.quality.eps = 0.0;
        let sample = shot.ready()?.sample(case.effort.pixels);
        let limit = shot.field_limit(&sample, case.tools)?;
        let (mut before, mut worst) = (f64::INFINITY, 0.0f64);
        for thickness in [1.0, 2.0 / 3.0, 0.5, 0.25, 0.125] {
            shot.quality.thickness = thickness;
            let ready = shot.ready()?;
            let got = ready.at(&ready.picture(Cut::on(case.tools.threads)), &sample);
            let now = ErrorFigures::compare(&got, &limit, Background::Colour([0.0; 3])).rmse;
            worst = worst.max(now / f64::max(before, FIELD_FLOOR));
            before = now;
        }
        rows.push(Row::new(format!("RMSE over that before: {}", VIEWS[at].0), worst, 1.05));
    }
    Ok(rows)
}

/// Points on the lines of a transfer function. Those that can be represented, and whose lines can
/// be computed without rounding, change nothing; the others are off their line by the last bit of
/// f64, and looks, kept in f32, change by their last bit in one case of 10^8.
fn points(case: &InvarianceCase) -> Result<Vec<Row>, Fail> {
    let mut case = InvarianceCase { shot: case.shot.clone(), ..*case };
    let colors = [[0.0, 1.0, 0.5, 0.25], [128.0, 0.25, 1.0, 0.5], [192.0, 0.0, 0.5, 1.0]];
    let opacities = [[32.0, 0.0], [64.0, 0.5], [64.0, 0.125], [192.0, 0.875]];
    case.shot.transfer = TransferFunction {
        colors: colors.into(),
        opacities: opacities.into(),
        color_space: ColorSpace::Linear,
        ..case.shot.transfer
    };
    let exact = case.same_bytes("exact points", |s| {
        let mut s = s.clone();
        let tf = &mut s.transfer;
        tf.colors.insert(2, [160.0, 0.125, 0.75, 0.75]);
        tf.colors.insert(1, [64.0, 0.625, 0.75, 0.375]);
        tf.colors.insert(0, [-5.0, 1.0, 0.5, 0.25]);
        tf.opacities.insert(3, [128.0, 0.5]);
        // In the middle of a step.
        tf.opacities.insert(2, [64.0, 0.25]);
        tf.opacities.insert(1, [48.0, 0.25]);
        tf.opacities.insert(1, [40.0, 0.125]);
        tf.opacities.push([300.0, 0.875]);
        vec![s]
    })?;
    let mut off = 0.0f64;
    for (mut shot, want) in case.views()? {
        let tf = &mut shot.transfer;
        let on = |a: f64, b: f64, t: f64| a + (b - a) * t;
        for t in [0.1, 0.3, 0.7, 0.9] {
            tf.opacities.push([on(64.0, 192.0, t), on(0.125, 0.875, t)]);
            tf.opacities.push([on(32.0, 64.0, t), on(0.0, 0.5, t)]);
            tf.colors.push(std::array::from_fn(|i| on(colors[0][i], colors[1][i], t)));
        }
        tf.opacities.sort_by(|a, b| a[0].total_cmp(&b[0]));
        tf.colors.sort_by(|a, b| a[0].total_cmp(&b[0]));
        off = off.max(largest(&want, &case.picture(&shot)?));
    }
    // 2^-23 of an extinction and of a colour, and what sums make of it.
    let bound = 255.0 * (2f64.powi(-22) + 2.0 * case.rounding());
    Ok(vec![exact, Row::new(format!("{LARGEST}: rounded points"), off, bound)])
}

#[cfg(test)]
mod tests {
    use super::super::shot::Tools;
    use super::*;

    #[test]
    fn invariances_hold_on_small_scenes() {
        let effort = Effort { samples: 24, size: [64, 48], pixels: 400, every: 7 };
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let tools = Tools { threads: 2, runtime };
        let mut failed = Vec::new();
        let orders = [Classify::Before, Classify::After];
        for case in orders.into_iter().flat_map(|order| with(effort, order)) {
            for row in (case.work)(&tools).unwrap() {
                if !row.held() {
                    failed.push(format!("{}: {row:?}", case.name));
                }
            }
        }
        assert!(failed.is_empty(), "{failed:#?}");
    }
}
