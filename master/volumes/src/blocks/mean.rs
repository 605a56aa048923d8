//! Halving: makes the next coarser level of a volume.
//!
//! A sample of the next level is the mean of two samples along each halved axis; integers are
//! rounded half up, so that all machines agree. An axis with a step of at least twice the smallest
//! is not halved, nor is an axis of one sample: thick slices keep their number until the other
//! steps are as long. On a side with an odd number of samples, the last mean is over the samples
//! that are left.

use super::BLOCK_EDGE;
use rayon::prelude::*;
use slabcast_common::volume::{CoarseLevel, Lattice, Samples, Volume};

/// Returns the lattice of the next coarser level; `None` if no axis can be halved.
pub fn halved_lattice(lattice: &Lattice) -> Option<Lattice> {
    let axes = halved_axes(lattice);
    if axes == [false; 3] {
        return None;
    }
    let mut coarse = *lattice;
    for a in 0..3 {
        if axes[a] {
            coarse.dims[a] = lattice.dims[a].div_ceil(2);
            coarse.steps[a] = lattice.steps[a] * 2.0;
            coarse.origin += lattice.steps[a] * 0.5;
        }
    }
    Some(coarse)
}

/// Returns the lattices of all levels of a pyramid, the finest first. The last one has no side
/// longer than a block's edge, or can't be halved.
pub fn level_lattices(lattice: &Lattice) -> Vec<Lattice> {
    let mut levels = vec![*lattice];
    while let Some(last) = levels.last()
        && last.dims.iter().any(|&n| n > BLOCK_EDGE)
        && let Some(next) = halved_lattice(last)
    {
        levels.push(next);
    }
    levels
}

fn halved_axes(lattice: &Lattice) -> [bool; 3] {
    let (spacing, dims) = (lattice.spacing(), lattice.dims);
    let smallest = (0..3).filter(|&a| dims[a] > 1).map(|a| spacing[a]).fold(f64::MAX, f64::min);
    std::array::from_fn(|a| dims[a] > 1 && spacing[a] < 2.0 * smallest)
}

/// Returns the next coarser level of a volume, with the summary of level 0. `None` if no axis can
/// be halved, or if voxels have colours of their own (places in a palette have no mean).
///
/// Memory: the coarser samples, beside those of `fine`.
pub fn coarser(fine: &Volume) -> Option<Volume> {
    if fine.places.is_some() {
        return None;
    }
    let lattice = halved_lattice(&fine.lattice)?;
    let finest_vox = fine.coarse.map_or_else(|| fine.lattice.vox(), |coarse| coarse.finest_vox);
    let level = fine.coarse.map_or(0, |coarse| coarse.level) + 1;
    Some(Volume {
        name: fine.name.clone(),
        file_type: fine.file_type.clone(),
        anatomical: fine.anatomical,
        lattice,
        samples: halved(&fine.lattice, fine.lattice.dims, &fine.samples),
        summary: fine.summary.clone(),
        coarse: Some(CoarseLevel { level, finest_vox }),
        places: None,
    })
}

/// Halves a box of samples, on all cores of rayon's pool. `fine` is a box of `dims` samples of
/// `lattice`, i fastest; it begins at an even index along each halved axis. Returns its samples of
/// the next coarser level, i fastest.
///
/// # Panics
/// If the samples and `dims` differ in number, or the lattice can't be halved.
pub fn halved(lattice: &Lattice, dims: [u32; 3], fine: &Samples) -> Samples {
    let axes = halved_axes(lattice);
    assert_ne!(axes, [false; 3], "a lattice that can be halved");
    assert_eq!(fine.len(), dims.iter().map(|&n| n as usize).product::<usize>(), "whole boxes");
    match fine {
        Samples::U8(v) => Samples::U8(rows(axes, dims, v, integer_row)),
        Samples::U16(v) => Samples::U16(rows(axes, dims, v, integer_row)),
        Samples::F32(v) => Samples::F32(rows(axes, dims, v, float_row)),
    }
}

/// Calls `row` for each coarse row, with the fine rows under it (in the order of z, then y),
/// whether x is halved, and the coarse samples to write.
fn rows<T: Copy + Default + Send + Sync>(
    axes: [bool; 3],
    dims: [u32; 3],
    fine: &[T],
    row: impl Fn(&[&[T]], bool, &mut [T]) + Sync,
) -> Vec<T> {
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let step = axes.map(|halved| if halved { 2 } else { 1 });
    let [cx, cy, cz] = std::array::from_fn(|a| [nx, ny, nz][a].div_ceil(step[a]));
    let mut coarse = vec![T::default(); cx * cy * cz];
    coarse.par_chunks_mut(cx * cy).enumerate().for_each(|(z, slice)| {
        for (y, to) in slice.chunks_mut(cx).enumerate() {
            let mut under: [&[T]; 4] = [&[]; 4];
            let mut count = 0;
            for k in z * step[2]..((z + 1) * step[2]).min(nz) {
                for j in y * step[1]..((y + 1) * step[1]).min(ny) {
                    under[count] = &fine[(k * ny + j) * nx..][..nx];
                    count += 1;
                }
            }
            row(&under[..count], axes[0], to);
        }
    });
    coarse
}

/// Writes the means of a row of integers, rounded half up. Eight codes of 16 bits add up to less
/// than 2^19.
fn integer_row<T: Copy + Into<u32> + TryFrom<u32>>(under: &[&[T]], halve_x: bool, to: &mut [T]) {
    let mean = |sum: u32, n: u32| {
        T::try_from((sum + n / 2) / n).unwrap_or_else(|_| unreachable!("a mean of codes is a code"))
    };
    let in_row = if halve_x { 2 } else { 1 };
    // Whole groups of eight and four samples, the usual ones, with a constant divisor.
    let whole = if halve_x { under[0].len() / 2 } else { to.len() };
    match *under {
        [a, b, c, d] if halve_x => {
            for (x, to) in to[..whole].iter_mut().enumerate() {
                let pair = |row: &[T]| row[2 * x].into() + row[2 * x + 1].into();
                *to = mean(pair(a) + pair(b) + pair(c) + pair(d), 8);
            }
        }
        [a, b] if halve_x => {
            for (x, to) in to[..whole].iter_mut().enumerate() {
                let pair = |row: &[T]| row[2 * x].into() + row[2 * x + 1].into();
                *to = mean(pair(a) + pair(b), 4);
            }
        }
        _ => {
            for (x, to) in to[..whole].iter_mut().enumerate() {
                let all = under.iter().flat_map(|row| &row[x * in_row..(x + 1) * in_row]);
                let sum = all.map(|&code| -> u32 { code.into() }).sum();
                *to = mean(sum, (under.len() * in_row) as u32);
            }
        }
    }
    // The last sample of an odd side.
    for (x, to) in to.iter_mut().enumerate().skip(whole) {
        let sum = under.iter().map(|row| -> u32 { row[x * in_row].into() }).sum();
        *to = mean(sum, under.len() as u32);
    }
}

/// Writes the means of a row of floats over their finite samples. Without a finite sample, the
/// first one is taken.
fn float_row(under: &[&[f32]], halve_x: bool, to: &mut [f32]) {
    let in_row = if halve_x { 2 } else { 1 };
    for (x, to) in to.iter_mut().enumerate() {
        let (mut sum, mut n) = (0.0f64, 0u32);
        for row in under {
            for &value in &row[x * in_row..((x + 1) * in_row).min(row.len())] {
                if value.is_finite() {
                    sum += f64::from(value);
                    n += 1;
                }
            }
        }
        *to = if n > 0 { (sum / f64::from(n)) as f32 } else { under[0][x * in_row] };
    }
}
