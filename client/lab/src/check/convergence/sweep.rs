//! A sweep of one scene in one projection over sheet thicknesses, with the sources of its errors.

use slabcast_common::image::Picture;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::view::{Camera, View};
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_render::judge::reference::{Reference, SectionPlacement, SheetOptions, stratified};
use slabcast_render::{Frame, Scene};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::SceneBricks;
use slabcast_session::progress::Progress;
use std::sync::Arc;

/// A scene to sweep.
pub(super) struct SweepScene {
    /// Name in tables and file names.
    pub(super) name: String,
    pub(super) volume: Volume,
    pub(super) info: VolumeInfo,
    pub(super) transfer: TransferFunction,
    /// Quality; its thickness is replaced and its `eps` set to zero.
    pub(super) quality: Quality,
    pub(super) size: [u32; 2],
    /// Number of pixels compared.
    pub(super) pixels: usize,
    pub(super) seed: u64,
}

/// RMSE and maximum over all channels of the pixels where either is not blank, in 1/255.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Deviation {
    pub(super) rmse: f64,
    pub(super) max: f64,
}

impl Deviation {
    pub(super) fn between(got: &[[f64; 4]], want: &[[f64; 4]]) -> Deviation {
        let (mut squares, mut max, mut n) = (0.0, 0.0f64, 0usize);
        for (got, want) in got.iter().zip(want) {
            if got[3] <= 0.0 && want[3] <= 0.0 {
                continue;
            }
            n += 1;
            for c in 0..4 {
                let off = (got[c] - want[c]).abs() * 255.0;
                squares += off * off;
                max = if off <= max { max } else { off };
            }
        }
        Deviation { rmse: (squares / (4.0 * n.max(1) as f64)).sqrt(), max }
    }
}

/// All figures of one thickness.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct ThicknessFigures {
    /// Sheet thickness in vox.
    pub(super) thickness: f64,
    /// Rendered pictures against the limit.
    pub(super) linear: Deviation,
    pub(super) constant: Deviation,
    /// The paper's form against the limit of its own, and against the limit.
    pub(super) paper: Deviation,
    pub(super) paper_limit: Deviation,
    /// Sheets in f64 against the limit: the error of thickness alone.
    pub(super) linear_f64: Deviation,
    pub(super) constant_f64: Deviation,
    pub(super) paper_f64: Deviation,
    /// The linear rule's other errors, each against a picture without it: rounded positions, f32
    /// arithmetic, integer sums.
    pub(super) positions: Deviation,
    pub(super) floats: Deviation,
    pub(super) integers: Deviation,
    /// Linear in f64 with sections placed otherwise, in perspective views and where asked for:
    /// centroid, half-way, along the ray.
    pub(super) placed: Option<[Deviation; 3]>,
}

/// Results of a sweep.
pub(super) struct Sweep {
    pub(super) name: String,
    pub(super) projection: &'static str,
    /// Pixels compared that are not blank.
    pub(super) pixels: usize,
    /// Whether sheets added integers.
    pub(super) integers: bool,
    /// From the limit to that of the paper's form.
    pub(super) elsewhere: Deviation,
    pub(super) figures: Vec<ThicknessFigures>,
}

/// The largest rounding error at the thickness where it exceeds the error of thickness.
pub(super) struct Floor {
    pub(super) thickness: f64,
    pub(super) rmse: f64,
    pub(super) name: &'static str,
}

impl Sweep {
    /// The point at which linear compositing stops to gain: the thickest rung whose roundings are
    /// larger than what thickness does, and the largest of them.
    pub(super) fn floor(&self) -> Option<Floor> {
        let r = self.figures.iter().find(|r| r.linear_f64.rmse < rest(r))?;
        let mut all = [
            (r.positions.rmse, "rounded positions"),
            (r.floats.rmse, "f32 arithmetic"),
            (r.integers.rmse, "integer sums"),
        ];
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        Some(Floor { thickness: r.thickness, rmse: rest(r), name: all[0].1 })
    }
}

/// Roundings of all kinds together.
fn rest(r: &ThicknessFigures) -> f64 {
    let all = [r.positions, r.floats, r.integers];
    all.iter().map(|o| o.rmse * o.rmse).sum::<f64>().sqrt()
}

/// Sweeps `thicknesses` from `camera`. `placed`: also with sections placed otherwise.
pub(super) fn sweep(
    subject: &SweepScene,
    projection: &'static str,
    camera: &Camera,
    thicknesses: &[f64],
    placed: bool,
    threads: usize,
    progress: &mut Progress,
) -> Result<Sweep, Fail> {
    let view = |quality: &Quality| {
        View::new(&subject.info.lattice, camera, subject.size, quality)
            .map_err(|e| Fail::failed(format!("{}: {e}", subject.name)))
    };
    let quality =
        |compositing, thickness| Quality { compositing, thickness, eps: 0.0, ..subject.quality };
    let drawn = |compositing| {
        let q = quality(compositing, 1.0);
        SceneBricks::new(&subject.volume, &subject.info, &subject.transfer, q)
    };
    let (ours, papers) = (drawn(Compositing::Linear)?, drawn(Compositing::Paper)?);
    let sample = stratified(subject.size, subject.pixels, subject.seed);
    let reference = |drawn: &SceneBricks, quality: &Quality| {
        Ok::<_, Fail>(Reference::new(&drawn.spec, view(quality)?, &drawn.bricks))
    };
    let each = |pixel: &(dyn Fn(u32, u32) -> [f64; 4] + Sync)| {
        direct::map_parallel(sample.len(), threads, |i, _: &mut ()| {
            pixel(sample[i][0], sample[i][1])
        })
    };
    let picture = |drawn: &SceneBricks, quality: Quality| {
        let view = view(&quality)?;
        let spec = slabcast_common::message::SceneSpec { quality, ..drawn.spec.clone() };
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        let picture: Picture = direct::draw(&frame, &drawn.bricks, Cut::on(threads));
        let at = |p: &[u32; 2]| picture.pixels[(p[1] * subject.size[0] + p[0]) as usize];
        Ok::<_, Fail>(sample.iter().map(|p| at(p).map(f64::from)).collect::<Vec<_>>())
    };
    progress.phase(&format!("{}, {projection}: the limit", subject.name));
    let q = quality(Compositing::Linear, 1.0);
    let limit = {
        let r = reference(&ours, &q)?;
        each(&|x, y| r.pixel(x, y))
    };
    let papers_limit = {
        let r = reference(&papers, &q)?.with_sheet_payloads();
        each(&|x, y| r.pixel(x, y))
    };
    let mut figures = Vec::new();
    for &thickness in thicknesses {
        progress.phase(&format!("{}, {projection}: {thickness} vox", subject.name));
        let of = |compositing, sums| Quality { sums, ..quality(compositing, thickness) };
        let (linear, paper) = (Compositing::Linear, Compositing::Paper);
        let decided = ours.spec.quality.sums;
        let drawn = picture(&ours, of(linear, decided))?;
        let constant = picture(&ours, of(Compositing::Constant, decided))?;
        let floats = match decided {
            Sums::F32 => drawn.clone(),
            _ => picture(&ours, of(linear, Sums::F32))?,
        };
        let additive = picture(&papers, of(paper, papers.spec.quality.sums))?;

        let ours_in_f64 = reference(&ours, &of(linear, decided))?;
        let both = |how: SheetOptions| {
            let pixels = direct::map_parallel(sample.len(), threads, |i, _: &mut ()| {
                ours_in_f64.by_sheets_linear_and_constant(sample[i][0], sample[i][1], how)
            });
            pixels.into_iter().map(|[l, c]| (l, c)).unzip::<_, _, Vec<_>, Vec<_>>()
        };
        let (linear_f64, constant_f64) = both(SheetOptions::default());
        let (rounded, _) = both(SheetOptions { rounded: true, ..SheetOptions::default() });
        let paper_f64 = {
            let r = reference(&papers, &of(paper, papers.spec.quality.sums))?;
            each(&|x, y| r.at_same_thickness(x, y))
        };
        let placed = placed.then(|| {
            [SectionPlacement::Centroid, SectionPlacement::Between, SectionPlacement::Exact].map(
                |section| {
                    let (linear, _) = both(SheetOptions { section, rounded: false });
                    Deviation::between(&linear, &limit)
                },
            )
        });
        figures.push(ThicknessFigures {
            thickness,
            linear: Deviation::between(&drawn, &limit),
            constant: Deviation::between(&constant, &limit),
            paper: Deviation::between(&additive, &papers_limit),
            paper_limit: Deviation::between(&additive, &limit),
            linear_f64: Deviation::between(&linear_f64, &limit),
            constant_f64: Deviation::between(&constant_f64, &limit),
            paper_f64: Deviation::between(&paper_f64, &papers_limit),
            positions: Deviation::between(&rounded, &linear_f64),
            floats: Deviation::between(&floats, &rounded),
            integers: Deviation::between(&drawn, &floats),
            placed,
        });
    }
    Ok(Sweep {
        name: subject.name.clone(),
        projection,
        pixels: limit.iter().filter(|p| p[3] > 0.0).count(),
        integers: ours.spec.quality.sums != Sums::F32,
        elsewhere: Deviation::between(&papers_limit, &limit),
        figures,
    })
}
