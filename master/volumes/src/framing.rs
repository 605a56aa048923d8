//! Finds the outline of the visible part of a volume, and frames paths to it.
//!
//! The box of all visible voxels would be cheap and wrong: a scanner's noise puts a voxel here and
//! there above any threshold, and one in a corner would decide the picture. Cutting a share of the
//! voxels off each side (0.1 %, say) rejects noise too, but takes 3.7 % of a ball's radius and a
//! tenth of a cone's tip, which the picture then clips. Noise is told by being lonely, so cells of
//! 8x8x8 voxels count, the bricks of the renderer, and only if at least `DENSE` of their voxels
//! are visible. Voxels of such cells count exactly.

use crate::blocks::{BlockSource, MemorySource};
use crate::error::Problem;
use crate::store::relevance_table;
use rayon::prelude::*;
use slabcast_common::quality::{Classify, InvalidField, Quality};
use slabcast_common::transfer::{Support, TransferFunction};
use slabcast_common::volume::{Digest32, SampleKind, Samples, Volume, VolumeInfo};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::path::{CropBox, Framing, Orientation, ViewPath};
use slabcast_scene::tween::Tween;
use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

/// Edge of a cell in voxels.
const EDGE: usize = 8;

/// Visible voxels that a cell of 512 must have to count. A wire of one voxel that crosses a cell
/// has 8 of them. At 4, noise of one voxel in 500 (an angiogram at its lower threshold) fills some
/// cell of every corner; at 16, tips of a few voxels are lost.
const DENSE: usize = 8;

/// Returns index positions of visible voxels whose hull holds all visible voxels except lonely
/// ones: the hull of each layer k, in ascending order. Voxels within `crop` are visible if
/// `support` has their code.
pub fn outline(volume: &Volume, support: &Support, crop: Option<&CropBox>) -> Vec<[u32; 3]> {
    let source = MemorySource::new(volume, Digest32::default());
    outline_of(&source, 0, support, crop).expect("samples in memory can be read")
}

/// Returns the outline of a level of a source ([`outline`]), in index positions of the level.
///
/// # Errors
/// A file can't be read, or is damaged.
fn outline_of(
    source: &dyn BlockSource,
    level: usize,
    support: &Support,
    crop: Option<&CropBox>,
) -> Result<Vec<[u32; 3]>, Problem> {
    let info = &source.levels()[level];
    let inside = |voxel: [u32; 3]| crop.is_none_or(|c| c.contains(&info.lattice, voxel));
    let dims = info.lattice.dims;
    let codes = match info.summary.code_kind() {
        SampleKind::U8 => 256,
        SampleKind::U16 => 65536,
        SampleKind::F32 => 0,
    };
    let seen = relevance_table(support, codes);
    let whole = source.whole(level);
    let layer = |layer: u32, dense: usize| -> Result<Vec<[u32; 3]>, Problem> {
        let slices = layer * EDGE as u32..((layer + 1) * EDGE as u32).min(dims[2]);
        let read;
        let (samples, first) = match whole {
            Some(whole) => (whole.codes(), 0),
            None => {
                let end = [dims[0], dims[1], slices.end];
                read = source.read_box(level, [0, 0, slices.start], end)?;
                (&read, slices.start as usize)
            }
        };
        let slices = slices.start as usize..slices.end as usize;
        let dims = dims.map(|n| n as usize);
        Ok(match samples {
            Samples::U8(codes) => {
                let seen = &|c: u8| seen[usize::from(c)];
                Layer { codes, dims, first, seen, inside: &inside }.hulls(slices, dense)
            }
            Samples::U16(codes) => {
                let seen = &|c: u16| seen[usize::from(c)];
                Layer { codes, dims, first, seen, inside: &inside }.hulls(slices, dense)
            }
            Samples::F32(codes) => {
                let seen = &|c: f32| support.contains(f64::from(c));
                Layer { codes, dims, first, seen, inside: &inside }.hulls(slices, dense)
            }
        })
    };
    let of = |dense: usize| -> Result<Vec<[u32; 3]>, Problem> {
        let layers = (0..dims[2].div_ceil(EDGE as u32)).into_par_iter();
        let layers: Result<Vec<_>, _> = layers.map(|n| layer(n, dense)).collect();
        Ok(layers?.concat())
    };
    let dense = of(DENSE)?;
    // A volume with only a few visible voxels has no dense cell: then all of them count.
    if dense.is_empty() { of(1) } else { Ok(dense) }
}

/// Codes of some slices of a volume, in which layers of cells are searched.
struct Layer<'a, T, S, I> {
    codes: &'a [T],
    /// Samples of the volume along each axis.
    dims: [usize; 3],
    /// The first slice that `codes` holds.
    first: usize,
    seen: &'a S,
    inside: &'a I,
}

impl<T: Copy, S: Fn(T) -> bool, I: Fn([u32; 3]) -> bool> Layer<'_, T, S, I> {
    /// Returns the hulls of the slices of one layer of cells.
    fn hulls(&self, slices: std::ops::Range<usize>, dense: usize) -> Vec<[u32; 3]> {
        let [nx, ny, _] = self.dims;
        let cells = [nx.div_ceil(EDGE), ny.div_ceil(EDGE)];
        let mut counts = vec![0usize; cells[0] * cells[1]];
        for z in slices.clone() {
            for y in 0..ny {
                let row = &self.codes[((z - self.first) * ny + y) * nx..][..nx];
                let counts = &mut counts[y / EDGE * cells[0]..][..cells[0]];
                for (cell, run) in row.chunks(EDGE).enumerate() {
                    counts[cell] += run.iter().filter(|&&c| (self.seen)(c)).count();
                }
            }
        }
        if counts.iter().all(|&n| n < dense) {
            return Vec::new();
        }
        let mut points = Vec::new();
        for z in slices {
            let rows = (0..ny).filter_map(|y| {
                let row = &self.codes[((z - self.first) * ny + y) * nx..][..nx];
                let counts = &counts[y / EDGE * cells[0]..][..cells[0]];
                let counts_here = |x: &usize| {
                    counts[x / EDGE] >= dense
                        && (self.seen)(row[*x])
                        && (self.inside)([*x as u32, y as u32, z as u32])
                };
                let first = (0..nx).find(counts_here)?;
                let last = (first..nx).rev().find(counts_here)?;
                Some([y as i64, first as i64, last as i64])
            });
            let rows: Vec<[i64; 3]> = rows.collect();
            for side in [1, 2] {
                let sign = if side == 1 { 1 } else { -1 };
                let chain = chain(rows.iter().map(|r| [r[0], sign * r[side]]));
                points.extend(chain.iter().map(|p| [(sign * p[1]) as u32, p[0] as u32, z as u32]));
            }
        }
        points
    }
}

/// Returns the lower side of the hull of points with ascending first coordinates (Andrew's monotone
/// chain).
fn chain(points: impl Iterator<Item = [i64; 2]>) -> Vec<[i64; 2]> {
    let mut hull: Vec<[i64; 2]> = Vec::new();
    for p in points {
        while let [.., a, b] = hull[..] {
            let turn = (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]);
            if turn > 0 {
                break;
            }
            hull.pop();
        }
        hull.push(p);
    }
    hull
}

/// Returns the framing of a path that asks for one; `None` if it doesn't, or nothing is visible. It
/// does not depend on the quality. `transfer` is the function of all frames without one of their
/// own.
///
/// # Errors
/// Names the field of the path or function that doesn't fit the volume.
pub fn framing(
    path: &ViewPath,
    volume: &Volume,
    info: &VolumeInfo,
    transfer: &TransferFunction,
    orientation: Orientation,
) -> Result<Option<Framing>, InvalidField> {
    let source = MemorySource::new(volume, info.digest);
    framing_of(path, &source, &Outlines::default(), transfer, orientation).map_err(|e| match e {
        FramingError::Field(field) => field,
        FramingError::File(problem) => unreachable!("samples in memory can be read: {problem}"),
    })
}

/// Most samples of the level at which a path is framed. Larger volumes are framed to a coarser
/// level, where half a sample is a thousandth of the picture.
const MOST_SAMPLES: u64 = 1 << 28;

/// Reason for which a path can't be framed.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum FramingError {
    /// A field of the path or function doesn't fit the volume.
    #[error(transparent)]
    Field(#[from] InvalidField),
    /// The volume's file can't be read.
    #[error(transparent)]
    File(#[from] Problem),
}

/// Outlines that [`Outlines`] keeps. Each may have read 2^28 samples, and has a thousandth of them.
const OUTLINES_KEPT: usize = 8;

/// An outline, and what decides it within one source: level, visible codes and crop.
type KnownOutline = (usize, Support, Option<CropBox>, Arc<[[u32; 3]]>);

/// The latest outlines of one volume, so that requests with one transfer function read it once.
#[derive(Debug, Default)]
pub struct Outlines(Mutex<VecDeque<KnownOutline>>);

impl Outlines {
    /// Returns [`outline`] of a level of the source, from memory if it was asked for lately.
    ///
    /// # Errors
    /// A file can't be read, or is damaged.
    fn of(
        &self,
        source: &dyn BlockSource,
        level: usize,
        support: &Support,
        crop: Option<&CropBox>,
    ) -> Result<Arc<[[u32; 3]]>, Problem> {
        let known = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let is_it = |(of, codes, within, _): &KnownOutline| {
            *of == level && codes == support && within.as_ref() == crop
        };
        if let Some((.., points)) = known().iter().find(|known| is_it(known)) {
            return Ok(points.clone());
        }
        let points: Arc<[[u32; 3]]> = outline_of(source, level, support, crop)?.into();
        let mut known = known();
        known.retain(|known| !is_it(known));
        known.truncate(OUTLINES_KEPT - 1);
        known.push_front((level, support.clone(), crop.copied(), points.clone()));
        Ok(points)
    }
}

/// Returns the framing of a path to a volume that is read in boxes, in positions of its finest
/// level; `None` if the path doesn't ask for one, or nothing is visible. `outlines` caches the
/// outlines of `source`.
///
/// # Errors
/// A field of the path or function doesn't fit the volume, or a file can't be read.
pub fn framing_of(
    path: &ViewPath,
    source: &dyn BlockSource,
    outlines: &Outlines,
    transfer: &TransferFunction,
    orientation: Orientation,
) -> Result<Option<Framing>, FramingError> {
    if !path.wants_framing() {
        return Ok(None);
    }
    let levels = source.levels();
    let finest = &levels[0];
    let tween = Tween::from_path(path, &finest.summary)?;
    let quality = Quality { classify: Classify::Before, ..Quality::before() };
    let needs = BrickNeeds::for_path(path, transfer, tween.as_ref(), finest, &quality)?;
    let is_small = |level: &VolumeInfo| level.lattice.len() as u64 <= MOST_SAMPLES;
    let level = levels.iter().position(is_small).unwrap_or(levels.len() - 1);
    let to_level = finest.lattice.to_centre_of(&levels[level].lattice);
    let needs = needs.at_centre(to_level);
    let points = outlines.of(source, level, &needs.support, needs.crop.as_ref())?;
    let points: Vec<_> = points.iter().map(|&p| in_finest(levels, level, p)).collect();
    Ok(path.framing(&points, &finest.lattice, orientation)?)
}

/// Returns the sample of the finest level that is nearest to the centre of sample `point` of
/// another level.
fn in_finest(levels: &[VolumeInfo], level: usize, point: [u32; 3]) -> [u32; 3] {
    let (finest, coarse) = (&levels[0].lattice, &levels[level].lattice);
    std::array::from_fn(|a| {
        let ratio = (coarse.spacing()[a] / finest.spacing()[a]).round().max(1.0);
        let at = f64::from(point[a]) * ratio + (ratio - 1.0) * 0.5;
        (at as u32).min(finest.dims[a] - 1)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn box_of(points: &[[u32; 3]]) -> [[u32; 3]; 2] {
        let lo = std::array::from_fn(|a| points.iter().map(|p| p[a]).min().unwrap());
        let hi = std::array::from_fn(|a| points.iter().map(|p| p[a]).max().unwrap());
        [lo, hi]
    }

    fn above(cut: f64) -> Support {
        Support { intervals: vec![(cut, 255.0)], nan: false }
    }

    #[test]
    fn outline_holds_what_can_be_seen_and_leaves_lonely_voxels_out() {
        let ball = Volume::from_fn_u8("ball", [50, 44, 40], |i, j, k| {
            let d = [i.abs_diff(20), j.abs_diff(20), k.abs_diff(20)].map(|d| d * d);
            let noise = i >= 32 && (i * 7 + j * 31 + k * 53) % 401 == 0;
            if d.iter().sum::<u32>() <= 100 { 200 } else { u8::from(noise) * 90 }
        });
        let points = outline(&ball, &above(80.0), None);
        assert_eq!(box_of(&points), [[10; 3], [30; 3]]);
        assert!(points.len() < 21 * 2 * 21, "hulls, not all rows: {}", points.len());
        let half = "25:,:,:".parse::<slabcast_scene::path::Crop>().unwrap();
        let half = half.resolve(&ball.lattice).unwrap();
        assert_eq!(box_of(&outline(&ball, &above(80.0), Some(&half)))[0][0], 25);
    }

    #[test]
    fn little_is_still_something_and_nothing_is_nothing() {
        let dot =
            Volume::from_fn_u8("dot", [30; 3], |i, j, k| u8::from([i, j, k] == [3, 4, 5]) * 99);
        assert_eq!(box_of(&outline(&dot, &above(50.0), None)), [[3, 4, 5]; 2]);
        assert!(outline(&dot, &above(150.0), None).is_empty());
    }

    #[test]
    fn outline_is_read_once_for_each_support_and_crop() {
        let dot =
            Volume::from_fn_u8("dot", [30; 3], |i, j, k| u8::from([i, j, k] == [3, 4, 5]) * 99);
        let source = MemorySource::new(&dot, Digest32::default());
        let outlines = Outlines::default();
        let first = outlines.of(&source, 0, &above(50.0), None).unwrap();
        assert!(Arc::ptr_eq(&first, &outlines.of(&source, 0, &above(50.0), None).unwrap()));
        let right = "10:,:,:".parse::<slabcast_scene::path::Crop>().unwrap();
        let right = right.resolve(&dot.lattice).unwrap();
        assert!(outlines.of(&source, 0, &above(50.0), Some(&right)).unwrap().is_empty());
        assert!(outlines.of(&source, 0, &above(150.0), None).unwrap().is_empty());
        for cut in 0..OUTLINES_KEPT {
            outlines.of(&source, 0, &above(cut as f64), None).unwrap();
        }
        assert_eq!(outlines.0.lock().unwrap().len(), OUTLINES_KEPT);
        assert!(!Arc::ptr_eq(&first, &outlines.of(&source, 0, &above(50.0), None).unwrap()));
    }
}
