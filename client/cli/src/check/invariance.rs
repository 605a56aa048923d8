//! What must not matter to a picture: the unit of length, where the origin is, along which axes
//! samples are stored and in which type, empty borders, points on a transfer function's lines.
//! And what must matter one way only: thinner sheets are not worse, more opacity does not let
//! more light through.
//!
//! Each bound is zero (no byte may differ) or derived where it stands. Positions are rounded, so
//! two ways to compute one position could fall on two sides of a boundary. They differ by 1e-13
//! pixels or so and boundaries are 1/256 pixel apart: no scene here has a voxel that near to one.

use super::cases;
use super::changes::Turn;
use super::shot::{Against, Shot, Tools};
use super::table::{Case, Row};
use crate::fail::Fail;
use crate::local::Cut;
use crate::volume;
use glam::DVec3;
use slabcast_common::image::{Background, Picture};
use slabcast_common::path::PathView;
use slabcast_common::path::ProjectionKind::{self, Ortho, Persp};
use slabcast_common::presets;
use slabcast_common::quality::Quality;
use slabcast_common::shade::{HeadWord, Light};
use slabcast_common::transfer::{ColorSpace, SIGMA_MAX, TransferFunction};
use slabcast_common::volume::Lattice;
use slabcast_render::reference::ErrorFigures;
use std::sync::Arc;

/// How much is drawn.
#[derive(Clone, Copy, Debug)]
struct Effort {
    /// Samples along the axes of a volume.
    samples: u32,
    size: [u32; 2],
    /// Pixels that are compared with the reference.
    pixels: usize,
    /// Every how manyth of the 47 turns is tried.
    every: usize,
}

/// The cases of the group.
pub(crate) fn cases() -> Vec<Case> {
    with(Effort { samples: 48, size: [160, 128], pixels: 2000, every: 1 })
}

fn with(effort: Effort) -> Vec<Case> {
    let mut cases = Vec::new();
    for scene in [Scene::Opaque, Scene::Translucent, Scene::Stiff, Scene::Boxes] {
        let asked: [(&str, Check); 8] = [
            ("unit of length", units),
            ("origin", origins),
            ("axes", axes),
            ("empty borders", borders),
            ("types of samples", types),
            ("parts, sides and channels", pictures),
            ("more opacity", opacity),
            ("thinner sheets", sheets),
        ];
        for (name, check) in asked {
            cases.push(Case::new(format!("{name}, {}", scene.name()), move |tools| {
                check(&Asked { scene, effort, shot: scene.shot(effort)?, tools })
            }));
        }
    }
    cases.push(Case::new("points on a transfer function's lines", move |tools| {
        let scene = Scene::Opaque;
        points(&Asked { scene, effort, shot: scene.shot(effort)?, tools })
    }));
    cases
}

/// One invariance of one scene.
type Check = fn(&Asked) -> Result<Vec<Row>, Fail>;

struct Asked<'a> {
    scene: Scene,
    effort: Effort,
    shot: Shot,
    tools: &'a Tools,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Scene {
    /// Lit and opaque.
    Opaque,
    /// Unlit, nothing hides anything.
    Translucent,
    /// Extinctions far beyond the cap of opacities: the sums are floats.
    Stiff,
    /// Samples that are not cubes, lit from aside.
    Boxes,
}

impl Scene {
    fn name(self) -> &'static str {
        match self {
            Scene::Opaque => "opaque",
            Scene::Translucent => "translucent",
            Scene::Stiff => "float sums",
            Scene::Boxes => "boxes",
        }
    }

    fn shot(self, effort: Effort) -> Result<Shot, Fail> {
        let n = effort.samples;
        let (formula, n, tf) = match self {
            Scene::Opaque => ("spheres", n, "peer-opaque"),
            Scene::Translucent => ("marker", n - 1, "peer-semi"),
            Scene::Stiff => ("blob", n / 2, "grey"),
            Scene::Boxes => ("spheres", n / 2, "peer-vessels"),
        };
        let mut volume = volume::open(format!("formula:{formula}:{n}").as_ref())?;
        let mut transfer = presets::by_name(tf, &volume.summary).map_err(|e| Fail::flag(&e))?;
        match self {
            Scene::Opaque => {}
            Scene::Translucent => transfer.shading.on = false,
            Scene::Stiff => transfer = cases::uncapped(&volume.info(volume.digest())),
            Scene::Boxes => {
                volume.lattice = Lattice::from_spacing([n; 3], [0.75, 1.0, 2.25]);
                transfer.shading.light = Light::Direction([0.5, 1.0, 0.25]);
            }
        }
        if self == Scene::Stiff {
            transfer.shading.on = false;
        }
        let view = view(&volume.lattice, [0.0, 2.0, 0.0], Ortho);
        let (volume, quality) = (Arc::new(volume), Quality::default());
        Ok(Shot { volume, transfer, quality, size: effort.size, view })
    }
}

/// Directions to the eye in extents of the volume. All coordinates are multiples of 1/8: they
/// stay exact when the origin is far away.
const VIEWS: [(&str, [f64; 3], ProjectionKind); 4] = [
    ("oblique", [0.75, 1.5, 0.625], Ortho),
    ("along an axis", [0.0, 2.0, 0.0], Ortho),
    ("perspective", [-0.75, 0.625, -0.375], Persp),
    ("perspective along an axis", [0.0, 1.5, 0.0], Persp),
];

fn view(lattice: &Lattice, to_eye: [f64; 3], projection: ProjectionKind) -> PathView {
    let (centre, extent) = (lattice.centre(), lattice.largest_extent());
    PathView {
        eye: (centre + DVec3::from_array(to_eye) * extent).to_array(),
        target: centre.to_array(),
        up: [0.0, 0.0, 1.0],
        projection,
        height: (projection == Ortho).then_some(1.25 * extent),
        fov: (projection == Persp).then_some(40.0),
    }
}

const BYTES: &str = "pixels whose bytes differ";
const LARGEST: &str = "largest difference";

impl Asked<'_> {
    fn picture(&self, shot: &Shot) -> Result<Picture, Fail> {
        Ok(shot.ready()?.picture(Cut::on(self.tools.threads)))
    }

    /// The shot from each of the views, with its picture.
    fn views(&self) -> Result<Vec<(Shot, Picture)>, Fail> {
        VIEWS
            .iter()
            .map(|(name, to_eye, projection)| {
                let view = view(&self.shot.volume.lattice, *to_eye, *projection);
                let shot = Shot { view, ..self.shot.clone() };
                let picture = self.picture(&shot)?;
                if picture.pixels.iter().all(|p| p[3] == 0.0) {
                    return Err(Fail::failed(format!("{name}: there is nothing to be seen")));
                }
                Ok((shot, picture))
            })
            .collect()
    }

    /// One row: by how many pixels any of `others` differs at most, from any view.
    fn same_bytes(&self, what: &str, others: impl Fn(&Shot) -> Vec<Shot>) -> Result<Row, Fail> {
        let mut most = 0;
        for (shot, want) in self.views()? {
            for other in others(&shot) {
                most = most.max(pixels_that_differ(&want, &self.picture(&other)?));
            }
        }
        Ok(Row::new(format!("{BYTES}: {what}"), most as f64, 0.0))
    }

    /// Sheets that the volume takes at most.
    fn sheets(&self) -> f64 {
        let l = &self.shot.volume.lattice;
        let n = l.dims.map(f64::from);
        let extent: DVec3 = DVec3::from_array(std::array::from_fn(|a| l.spacing()[a] * n[a]));
        extent.length() / l.vox() / self.shot.quality.thickness + 8.0
    }

    /// How far sums and closing sheets may be off by rounding, as a share of full light; what
    /// two ways to add the same numbers differ by is at most twice that.
    ///
    /// In a sheet a pixel gets at most (2 R + 1)^2 (2 R + 1 + d) contributions, R = 2 and d = 1:
    /// 150. Each is off by half a unit of an integer sum, of which 2^30 are 1.05 times a sheet
    /// full of the largest extinction; a sum of floats has 150 roundings instead. Products have 3
    /// roundings of f32, a closing sheet has some 8, and colour one of 2^-29. Relative errors of an
    /// optical depth count for all sheets together (tau exp(-tau) <= 0.37), absolute ones in
    /// each.
    fn rounding(&self) -> f64 {
        let f32s = 2f64.powi(-24);
        let unit = 1.05 * SIGMA_MAX * self.shot.quality.thickness * 2f64.powi(-30);
        let (a_sheet, in_all) =
            if self.scene == Scene::Stiff { (0.0, 150.0) } else { (75.0 * unit, 3.0) };
        self.sheets() * (a_sheet + 8.0 * f32s) + in_all * f32s
    }

    /// How far a picture with other codes for its normals may be off, as a share of full light.
    ///
    /// A code's coordinates are off by up to 1/254 in x and y and twice that in z, of a vector
    /// at least 1/sqrt 3 long: 0.0167 rad, and twice that between two codes of one normal. Light
    /// changes by at most 0.7 a radian (diffuse 0.7; where the highlight is steep, Lambert is
    /// flat), so a voxel's colour by 0.0234. A pixel is a mean of colours of weight A, and the
    /// colour rule adds differences to both neighbours by its gains, of which A / 2 shows.
    fn normals(&self) -> f64 {
        let voxel = 0.7 * 2.0 * (6f64.sqrt() / 254.0) * 3f64.sqrt();
        let y = self.shot.quality.thickness / self.shot.quality.std;
        voxel * (1.0 + (0.5 + 0.2 * y) + (0.5 - 0.07 * y).max(0.25))
    }
}

/// Lengths in another unit. Powers of two change nothing. Other factors round lengths in their
/// last bit, 1e-16 of them, and weights and looks, kept in f32, then change in one case of 10^8.
/// What is demanded is at most 1/255 in at most 0.01 % of the pixels.
fn units(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let powers = asked.same_bytes("powers of 2", |s| {
        [-60, -30, -1, 10, 30, 60].map(|e| s.scaled(2f64.powi(e))).into()
    })?;
    let (mut off, mut share) = (0.0f64, 0.0f64);
    for (shot, want) in asked.views()? {
        for s in [1e-9, 1e-6, 0.0706, 0.7, 3.0, 25.4, 1e6, 1e9] {
            let got = asked.picture(&shot.scaled(s))?;
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
fn origins(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let vox = asked.shot.volume.lattice.vox();
    let exact = asked.same_bytes("1e7 voxels away", |s| {
        [DVec3::splat(1e7), DVec3::new(-1e7, 3e6, 0.5)].map(|by| s.moved(by * vox)).into()
    })?;
    let (mut off, n) = (0.0f64, asked.shot.volume.lattice.largest_extent());
    for (mut shot, _) in asked.views()? {
        shot.view.eye.iter_mut().for_each(|x| *x += n * 0.1);
        let want = asked.picture(&shot)?;
        let got = asked.picture(&shot.moved(DVec3::new(1e7, 3e6, -1e7) * vox))?;
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
fn axes(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let turns: Vec<Turn> = Turn::all().into_iter().skip(1).step_by(asked.effort.every).collect();
    let (mut stored, mut turned) = (0.0f64, 0.0f64);
    for (shot, want) in asked.views()? {
        for t in &turns {
            stored = stored.max(largest(&want, &asked.picture(&shot.stored(*t))?));
        }
        let mut lit = shot.clone();
        lit.transfer.shading.light = Light::Head(HeadWord::Head);
        let want = asked.picture(&lit)?;
        for t in &turns {
            let got = asked.picture(&lit.turned(*t))?;
            let got = if t.mirrors() { mirrored(&got) } else { got };
            turned = turned.max(largest(&want, &got));
        }
    }
    let order = if asked.scene == Scene::Stiff { 2.0 * asked.rounding() } else { 0.0 };
    let normals = if asked.shot.transfer.shading.on { asked.normals() } else { 0.0 };
    Ok(vec![
        Row::new(format!("{LARGEST}: of storage"), stored, 255.0 * order),
        Row::new(format!("{LARGEST}: with the camera"), turned, 255.0 * (order + normals)),
    ])
}

/// More empty samples around a volume that has one layer of them (gradients look one sample
/// far). The camera stays; bricks and the volume's centre move, and with the bricks the order in
/// which floats are added.
fn borders(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let mut off = 0.0f64;
    for (shot, _) in asked.views()? {
        let want = asked.picture(&shot.padded(1))?;
        for n in [2, 4, 9] {
            off = off.max(largest(&want, &asked.picture(&shot.padded(n))?));
        }
    }
    let order = if asked.scene == Scene::Stiff { 2.0 * asked.rounding() } else { 0.0 };
    Ok(vec![Row::new(LARGEST, off, 255.0 * order)])
}

/// The same values as 8-bit codes, 16-bit codes and floats.
fn types(asked: &Asked) -> Result<Vec<Row>, Fail> {
    if asked.scene == Scene::Stiff {
        // Its values have 16 bits, of which floats hold all.
        return Ok(vec![asked.same_bytes("u16, f32", |s| vec![s.in_floats()])?]);
    }
    Ok(vec![
        asked.same_bytes("u8, u16, f32", |s| {
            vec![s.in_16_bits(1), s.in_16_bits(256), s.in_floats()]
        })?,
    ])
}

/// A part of a larger picture; red and blue exchanged; the camera on its side, where weights are
/// multiplied in another order; opacity from behind, where sheets come in the other order.
fn pictures(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let [w, h] = asked.shot.size;
    let (shot, want) = asked.views()?.swap_remove(0);
    let mut large = Shot { size: [w + 64, h + h / 2], ..shot.clone() };
    large.view.height = large.view.height.map(|x| x * 1.5);
    let part = cropped(&asked.picture(&large)?, [32, h / 4], [w, h]);

    let mut swapped = shot.clone();
    swapped.transfer.colors.iter_mut().for_each(|c| c.swap(1, 3));
    let mut swapped = asked.picture(&swapped)?;
    swapped.pixels.iter_mut().for_each(|p| p.swap(0, 2));

    let mut square = Shot { size: [h, h], ..shot };
    square.quality.eps = 0.0;
    let upright = asked.picture(&square)?;
    let target = DVec3::from_array(square.view.target);
    let to_eye = DVec3::from_array(square.view.eye) - target;
    let mut side = square.clone();
    side.view.up = to_eye.cross(DVec3::from_array(square.view.up)).to_array();
    let side = rolled(&asked.picture(&side)?);
    let mut behind = square;
    behind.view.eye = (target - to_eye).to_array();
    let behind = mirrored(&asked.picture(&behind)?);
    let alpha = |p: &Picture| {
        let pixels = p.pixels.iter().map(|p| [p[3]; 4]).collect();
        Picture { size: p.size, pixels }
    };
    let bound = 255.0 * 2.0 * asked.rounding();
    let bytes = |what: &str, got: &Picture| {
        Row::new(format!("{BYTES}: {what}"), pixels_that_differ(&want, got) as f64, 0.0)
    };
    Ok(vec![
        bytes("part of more", &part),
        bytes("red for blue", &swapped),
        Row::new(format!("{LARGEST}: on its side"), largest(&upright, &side), bound),
        Row::new(
            format!("{LARGEST}: A from behind"),
            largest(&alpha(&upright), &alpha(&behind)),
            bound,
        ),
    ])
}

/// Opacities raised, point by point: no pixel becomes less opaque but by rounding, and, where
/// pixels are shut, by what that leaves out, at most eps.
fn opacity(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let raises = [|a: f64| 1.01 * a, |a: f64| 2.0 * a, |a: f64| a * (1.25 - 0.25 * a.min(1.0))];
    let most = if asked.scene == Scene::Stiff { f64::INFINITY } else { 1.0 };
    let mut rows = Vec::new();
    for eps in [0.0, Quality::default().eps] {
        let mut lost = 0.0f64;
        for (mut shot, _) in asked.views()? {
            shot.quality.eps = eps;
            let less = asked.picture(&shot)?;
            for raise in raises {
                let mut more = shot.clone();
                more.transfer.opacities.iter_mut().for_each(|o| o[1] = raise(o[1]).min(most));
                let more = asked.picture(&more)?;
                let pairs = less.pixels.iter().zip(&more.pixels);
                lost = pairs.map(|(l, m)| f64::from(l[3] - m[3])).fold(lost, f64::max);
            }
        }
        let bound = 255.0 * (eps + 2.0 * asked.rounding());
        rows.push(Row::new(format!("opacity lost, eps {eps:.4}"), 255.0 * lost, bound));
    }
    Ok(rows)
}

/// Sheets half as thick are not worse than before by more than 5 %, down to the floor: what
/// rounded positions and sums leave at that thickness, found against the same sheets in f64.
fn sheets(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let mut rows = Vec::new();
    for at in [0, 2] {
        let (mut shot, _) = asked.views()?.swap_remove(at);
        shot.quality.eps = 0.0;
        let sample = shot.ready()?.sample(asked.effort.pixels);
        let limit = shot.ready()?.truth(Against::Limit, &sample, asked.tools);
        let (mut before, mut worst) = (f64::INFINITY, 0.0f64);
        for d in [2.0, 1.0, 0.5, 0.25, 0.125] {
            shot.quality.thickness = d;
            let ready = shot.ready()?;
            let got = ready.at(&ready.picture(Cut::on(asked.tools.threads)), &sample);
            let same = ready.truth(Against::SameSheets, &sample, asked.tools);
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

/// Points on the lines of a transfer function. Those that can be represented, and whose lines can
/// be computed without rounding, change nothing; the others are off their line by the last bit of
/// f64, and looks, kept in f32, change by their last bit in one case of 10^8.
fn points(asked: &Asked) -> Result<Vec<Row>, Fail> {
    let mut asked = Asked { shot: asked.shot.clone(), ..*asked };
    let colors = [[0.0, 1.0, 0.5, 0.25], [128.0, 0.25, 1.0, 0.5], [192.0, 0.0, 0.5, 1.0]];
    let opacities = [[32.0, 0.0], [64.0, 0.5], [64.0, 0.125], [192.0, 0.875]];
    asked.shot.transfer = TransferFunction {
        colors: colors.into(),
        opacities: opacities.into(),
        color_space: ColorSpace::Linear,
        ..asked.shot.transfer
    };
    let exact = asked.same_bytes("exact points", |s| {
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
    for (mut shot, want) in asked.views()? {
        let tf = &mut shot.transfer;
        let on = |a: f64, b: f64, t: f64| a + (b - a) * t;
        for t in [0.1, 0.3, 0.7, 0.9] {
            tf.opacities.push([on(64.0, 192.0, t), on(0.125, 0.875, t)]);
            tf.opacities.push([on(32.0, 64.0, t), on(0.0, 0.5, t)]);
            tf.colors.push(std::array::from_fn(|i| on(colors[0][i], colors[1][i], t)));
        }
        tf.opacities.sort_by(|a, b| a[0].total_cmp(&b[0]));
        tf.colors.sort_by(|a, b| a[0].total_cmp(&b[0]));
        off = off.max(largest(&want, &asked.picture(&shot)?));
    }
    // 2^-23 of an extinction and of a colour, and what sums make of it.
    let bound = 255.0 * (2f64.powi(-22) + 2.0 * asked.rounding());
    Ok(vec![exact, Row::new(format!("{LARGEST}: rounded points"), off, bound)])
}

fn pixels_that_differ(a: &Picture, b: &Picture) -> usize {
    let differ = |(p, q): &(&[f32; 4], &[f32; 4])| p.map(f32::to_bits) != q.map(f32::to_bits);
    a.pixels.iter().zip(&b.pixels).filter(differ).count()
}

/// In 1/255, over all channels; not a number where one of them is none.
fn largest(a: &Picture, b: &Picture) -> f64 {
    let want: Vec<[f64; 4]> = b.pixels.iter().map(|p| p.map(f64::from)).collect();
    super::shot::largest(&a.pixels, &want)
}

/// Left and right exchanged.
fn mirrored(p: &Picture) -> Picture {
    let mut p = p.clone();
    let width = p.size[0] as usize;
    p.pixels.chunks_mut(width).for_each(<[_]>::reverse);
    p
}

/// A square picture a quarter turn round.
fn rolled(p: &Picture) -> Picture {
    let n = p.size[0] as usize;
    let at = |i: usize| p.pixels[(i % n) * n + (n - 1 - i / n)];
    Picture { size: p.size, pixels: (0..n * n).map(at).collect() }
}

fn cropped(p: &Picture, corner: [u32; 2], size: [u32; 2]) -> Picture {
    let rows = (0..size[1]).map(|y| ((corner[1] + y) * p.size[0] + corner[0]) as usize);
    let pixels = rows.flat_map(|at| p.pixels[at..at + size[0] as usize].iter().copied());
    Picture { size, pixels: pixels.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn everything_holds_on_small_scenes() {
        let effort = Effort { samples: 24, size: [64, 48], pixels: 400, every: 7 };
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let tools = Tools { threads: 2, runtime };
        let mut failed = Vec::new();
        for case in with(effort) {
            for row in (case.work)(&tools).unwrap() {
                if !row.held() {
                    failed.push(format!("{}: {row:?}", case.name));
                }
            }
        }
        assert!(failed.is_empty(), "{failed:#?}");
    }
}
