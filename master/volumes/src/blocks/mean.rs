//! Halving: the next coarser level of a volume.
//!
//! A sample of the next level is the mean of two samples along each halved axis; integers are
//! rounded half up, so that all machines agree. An axis whose step is twice the smallest or more
//! stays as it is, and so does one of a single sample: thick slices keep their number until the
//! others are as thick. Where a side has an odd number of samples, the last mean is over those there
//! are.

use slabcast_common::volume::{Lattice, Samples};

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

fn halved_axes(lattice: &Lattice) -> [bool; 3] {
    let (spacing, dims) = (lattice.spacing(), lattice.dims);
    let smallest = (0..3).filter(|&a| dims[a] > 1).map(|a| spacing[a]).fold(f64::MAX, f64::min);
    std::array::from_fn(|a| dims[a] > 1 && spacing[a] < 2.0 * smallest)
}

/// Returns the samples of the next coarser level of a box of samples. `fine` has samples on a box of
/// `dims` samples of `lattice`, i fastest, which begins at an even index along each halved axis.
///
/// # Panics
/// If the samples and `dims` differ in number, or the lattice can't be halved.
pub fn halved(lattice: &Lattice, dims: [u32; 3], fine: &Samples) -> Samples {
    let axes = halved_axes(lattice);
    assert_ne!(axes, [false; 3], "a lattice that can be halved");
    assert_eq!(fine.len(), dims.iter().map(|&n| n as usize).product::<usize>(), "whole boxes");
    match fine {
        Samples::U8(v) => {
            Samples::U8(means(axes, dims, v, |sum: u64, n| ((sum + n / 2) / n) as u8))
        }
        Samples::U16(v) => {
            Samples::U16(means(axes, dims, v, |sum: u64, n| ((sum + n / 2) / n) as u16))
        }
        Samples::F32(v) => Samples::F32(float_means(axes, dims, v)),
    }
}

/// Calls `each` with the offsets of the samples under each coarse sample, i fastest.
fn groups(axes: [bool; 3], dims: [u32; 3], mut each: impl FnMut(&[usize])) {
    let [nx, ny, nz] = dims.map(|n| n as usize);
    let step = axes.map(|halved| if halved { 2 } else { 1 });
    let mut group = Vec::with_capacity(8);
    for z in (0..nz).step_by(step[2]) {
        for y in (0..ny).step_by(step[1]) {
            for x in (0..nx).step_by(step[0]) {
                group.clear();
                for k in z..(z + step[2]).min(nz) {
                    for j in y..(y + step[1]).min(ny) {
                        for i in x..(x + step[0]).min(nx) {
                            group.push((k * ny + j) * nx + i);
                        }
                    }
                }
                each(&group);
            }
        }
    }
}

fn means<T: Copy + Into<u64>>(
    axes: [bool; 3],
    dims: [u32; 3],
    fine: &[T],
    round: impl Fn(u64, u64) -> T,
) -> Vec<T> {
    let mut coarse = Vec::new();
    groups(axes, dims, |group| {
        let sum = group.iter().map(|&i| fine[i].into()).sum();
        coarse.push(round(sum, group.len() as u64));
    });
    coarse
}

/// Means of the finite samples; of samples without a finite one the first is taken.
fn float_means(axes: [bool; 3], dims: [u32; 3], fine: &[f32]) -> Vec<f32> {
    let mut coarse = Vec::new();
    groups(axes, dims, |group| {
        let finite = || group.iter().map(|&i| f64::from(fine[i])).filter(|x| x.is_finite());
        let n = finite().count();
        coarse.push(if n > 0 { (finite().sum::<f64>() / n as f64) as f32 } else { fine[group[0]] });
    });
    coarse
}
