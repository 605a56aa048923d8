//! Volumes, transfer functions and cameras of extreme scenes, and how a scene is judged.

use crate::check::case::Row;
use crate::check::enclose::Enclosure;
use crate::check::shot::{PreparedShot, ReferenceKind, Shot, Tools, largest, sane_within};
use glam::DVec3;
use slabcast_common::bounds;
use slabcast_common::brick::TightBox;
use slabcast_common::image::{Background, Picture};
use slabcast_common::quality::{Compositing, Quality};
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::view::Projection;
use slabcast_common::volume::{Lattice, Volume};
use slabcast_render::judge::reference::ErrorFigures;
use slabcast_scene::path::{PathView, ProjectionKind};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use std::sync::Arc;

/// Largest error of the reference itself, in 1/255: 7e-5 at its tolerance, by its own
/// documentation.
const JUDGE: f64 = 1e-3;

/// Thickness of the planes whose pictures of fields are held against the limit, in vox.
const FIELD_THIN: f64 = 0.125;

/// Largest RMSE of such planes against the limit, in 1/255.
const FIELD_RMSE: f64 = 0.3;

/// A transfer function: blue where values are small, orange where they are large; unshaded.
/// `opacities` are alphas of one vox.
pub(super) fn look(opacities: &[[f64; 2]]) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors: vec![[0.0, 0.1, 0.2, 0.9], [255.0, 1.0, 0.6, 0.1]],
        opacities: opacities.to_vec(),
        color_space: ColorSpace::Linear,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading { on: false, ..Shading::default() },
    }
}

/// Such a transfer function, lit.
pub(super) fn shaded(opacities: &[[f64; 2]]) -> TransferFunction {
    TransferFunction { shading: Shading::default(), ..look(opacities) }
}

/// Such a transfer function with extinctions per world unit.
pub(super) fn extinction(opacities: &[[f64; 2]]) -> TransferFunction {
    TransferFunction { opacity_unit: OpacityUnit::Extinction, ..look(opacities) }
}

/// A block of random values from 40 to 255 with air around it: as rough as a volume can be.
pub(super) fn rough(dims: [u32; 3]) -> Volume {
    let inside = |p: u32, n: u32| n < 8 || (2 <= p && p < n - 2);
    Volume::from_fn_u8("rough", dims, |i, j, k| {
        if !(inside(i, dims[0]) && inside(j, dims[1]) && inside(k, dims[2])) {
            return 0;
        }
        let mut h =
            i.wrapping_mul(0x9e37_79b1) ^ j.wrapping_mul(0x85eb_ca77) ^ k.wrapping_mul(0xc2b2_ae3d);
        h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
        40 + ((h ^ (h >> 13)) % 216) as u8
    })
}

/// Values that rise by `step` along i.
pub(super) fn ramp(dims: [u32; 3], step: u32) -> Volume {
    Volume::from_fn_u8("ramp", dims, |i, _, _| (i * step).min(255) as u8)
}

/// `volume` on another lattice.
pub(super) fn on_lattice(volume: Volume, spacing: [f64; 3], origin: [f64; 3]) -> Volume {
    let lattice = Lattice {
        origin: DVec3::from_array(origin),
        ..Lattice::from_spacing(volume.lattice.dims, spacing)
    };
    Volume { lattice, ..volume }
}

/// `volume` as `transfer` shows it, from an oblique direction, orthographic.
pub(super) fn shot(volume: Volume, transfer: TransferFunction) -> Shot {
    let view = ortho_camera(&volume, [0.53, 0.71, 0.36], [0.0, 0.0, 1.0]);
    Shot {
        volume: Arc::new(volume),
        transfer,
        quality: Quality::before(),
        size: [61, 47],
        view,
        crop: None,
    }
}

/// The orthographic camera that sees all of `volume` from direction `to_eye`.
pub(super) fn ortho_camera(volume: &Volume, to_eye: [f64; 3], up: [f64; 3]) -> PathView {
    let (centre, extent) = (volume.lattice.centre(), volume.lattice.largest_extent());
    PathView {
        eye: (centre + DVec3::from_array(to_eye) * (2.0 * extent)).to_array(),
        target: centre.to_array(),
        up,
        projection: ProjectionKind::Ortho,
        height: None,
        fov: None,
    }
}

/// The perspective camera at `eye`, looking at `target`, both from the volume's centre in units
/// of its largest extent.
pub(super) fn persp_camera(volume: &Volume, eye: [f64; 3], target: [f64; 3], fov: f64) -> PathView {
    let (centre, extent) = (volume.lattice.centre(), volume.lattice.largest_extent());
    let at = |p: [f64; 3]| (centre + DVec3::from_array(p) * extent).to_array();
    PathView {
        eye: at(eye),
        target: at(target),
        up: [0.0, 0.0, 1.0],
        projection: ProjectionKind::Persp,
        height: None,
        fov: Some(fov),
    }
}

/// Judges `shot` in both orders of classification.
pub(super) fn judge(shot: &Shot, pixels: usize, tools: &Tools) -> Result<Vec<Row>, Fail> {
    let mut rows = judge_before(shot, pixels, tools)?;
    let quality = Quality { eps: shot.quality.eps, ..Quality::default() };
    rows.extend(judge_field(&Shot { quality, ..shot.clone() }, pixels, tools)?);
    Ok(rows)
}

/// Draws `shot`, which is classified after reconstruction, serially, on threads and by clusters, and once
/// more without a cut-off. Returns rows for two properties:
///
/// - pixels without a cut-off differ from pixels with one by no more than [`cutoff_bound`];
/// - planes of [`FIELD_THIN`] have an RMSE against the f64 limit of at most [`FIELD_RMSE`], or of 3/4 of
///   the RMSE of default planes. Volumes with NaN have no such row: the limit leaves NaN out, and sheets
///   take it for an invisible code. Nor have pictures whose pixels are larger than a vox: positions are
///   rounded to 1/256 pixel.
///
/// # Errors
/// If a master would refuse the shot.
fn judge_field(shot: &Shot, pixels: usize, tools: &Tools) -> Result<Vec<Row>, Fail> {
    let ready = shot.ready()?;
    let (picture, trouble) = shot.everywhere(&ready, tools)?;
    let open = Shot { quality: Quality { eps: 0.0, ..shot.quality }, ..shot.clone() };
    let drawn = open.ready()?.picture(Cut::on(tools.threads));
    let left_out = largest_difference(&picture, &drawn);
    let sample = ready.sample(pixels);
    let limit = open.field_limit(&sample, tools)?;
    let mut errors = Vec::new();
    for thickness in [shot.quality.thickness, FIELD_THIN] {
        let quality = Quality { thickness, ..open.quality };
        let ready = Shot { quality, ..open.clone() }.ready()?;
        let got = ready.at(&ready.picture(Cut::on(tools.threads)), &sample);
        errors.push(ErrorFigures::compare(&got, &limit, Background::Colour([0.0; 3])));
    }
    let [at_default, thin] = [errors[0].rmse, errors[1].rmse];
    let mut rows = vec![
        Row::new("field: max that the cut-off leaves out", left_out, cutoff_bound(&ready))
            .with(trouble)
            .with(sane_within(&picture, slack(&ready)))
            .with(sane_within(&drawn, slack(&ready))),
    ];
    let coarse = matches!(ready.view.projection, Projection::Ortho { scale } if scale < 1.0);
    if !coarse && ready.spec.volume.summary.nan == 0 {
        let bound = f64::max(FIELD_RMSE, 0.75 * at_default);
        rows.push(Row::new("field: RMSE of planes of 1/8 vox", thin, bound));
    }
    Ok(rows)
}

/// Draws `shot` everywhere, and twice more with nothing shut; judges a sample of `pixels`.
///
/// Three things must hold. Pixels without a cut-off differ from pixels with one by no more than
/// [`cutoff_bound`]. Without a cut-off, a pixel is no farther from the same sheets in f64 than its
/// [`Enclosure`] says. Where rays are parallel, opacity does not depend on the thickness of sheets, and is
/// no farther from the limit than the enclosure says.
fn judge_before(shot: &Shot, pixels: usize, tools: &Tools) -> Result<Vec<Row>, Fail> {
    let ready = shot.ready()?;
    let (picture, trouble) = shot.everywhere(&ready, tools)?;
    let open = ready.with(Quality { eps: 0.0, ..ready.spec.quality });
    let never_shut = open.picture(Cut::on(tools.threads));
    let left_out = largest_difference(&picture, &ready.never_shut(Cut::on(tools.threads)));
    let mut rows = vec![
        Row::new("max that the cut-off leaves out", left_out, cutoff_bound(&ready))
            .with(trouble)
            .with(sane_within(&picture, slack(&ready)))
            .with(sane_within(&never_shut, slack(&ready))),
    ];
    let sample = open.sample(pixels);
    rows.extend(against_truth(&open, &open.at(&never_shut, &sample), &sample, tools));
    Ok(rows)
}

/// Sheets that the volume may touch.
fn sheets(ready: &PreparedShot) -> f64 {
    let whole = TightBox { lo: [0; 3], hi: ready.spec.volume.lattice.dims.map(|n| n - 1) };
    ready.view.project(&whole).map_or(0.0, |p| f64::from(p.sheets.len()))
}

/// By how much colour may exceed opacity. Opacity is kept in f32: where a sheet adds less than
/// half an ulp of it, it stands still while colour goes on. And colour is rounded to half a unit
/// of fixed point.
fn slack(ready: &PreparedShot) -> f64 {
    sheets(ready) * (0.5 / f64::from(1u32 << 24) + 0.5 / f64::from(1u32 << 28)) + 1e-6
}

/// Returns how much a pixel that goes on may gain on one that was shut: eps, and the rounding of
/// f32 and fixed-point colour in each sheet behind.
pub(super) fn cutoff_bound(ready: &PreparedShot) -> f64 {
    bounds::cutoff(&ready.spec.quality) + 255.0 * slack(ready)
}

/// Compares pixels with the truth, each with its own bound; shows the one that comes nearest to
/// its bound.
pub(super) fn against_truth(
    ready: &PreparedShot,
    got: &[[f32; 4]],
    sample: &[[u32; 2]],
    tools: &Tools,
) -> Vec<Row> {
    let enclosure = Enclosure::new(ready);
    let spans = direct::map_parallel(sample.len(), tools.threads, |i, _: &mut ()| {
        enclosure.pixel(sample[i][0], sample[i][1])
    });
    let parallel = matches!(ready.view.projection, Projection::Ortho { .. });
    let paper = ready.spec.quality.compositing == Compositing::Paper;
    let mut kinds = vec![(ReferenceKind::SameSheets, 0..4, "max from the same sheets in f64")];
    if parallel && !paper {
        kinds.push((ReferenceKind::Limit, 3..4, "max of alpha from the limit"));
    }
    let mut rows = Vec::new();
    for (against, channels, what) in kinds {
        let truth = ready.truth(against, sample, tools);
        let (mut worst, mut seen) = (Row::new(what, 0.0, JUDGE), -1.0);
        for ((got, want), spans) in got.iter().zip(&truth).zip(&spans) {
            for c in channels.clone() {
                let off = (f64::from(got[c]) - want[c]).abs() * 255.0;
                let most = (spans[c].hi - want[c]).max(want[c] - spans[c].lo) * 255.0 + JUDGE;
                let ratio = off / most;
                // NaN is worse than any error.
                if ratio > seen || ratio.is_nan() {
                    worst = Row::new(what, off, most);
                    seen = if ratio.is_nan() { f64::INFINITY } else { ratio };
                }
            }
        }
        rows.push(worst);
    }
    rows
}

/// Returns the largest difference of two pictures, in 1/255.
pub(super) fn largest_difference(a: &Picture, b: &Picture) -> f64 {
    let wide: Vec<[f64; 4]> = b.pixels.iter().map(|p| p.map(f64::from)).collect();
    largest(&a.pixels, &wide)
}
