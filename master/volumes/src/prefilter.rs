//! Coefficients of the cubic B-spline that passes through a volume's samples.
//!
//! A B-spline of the samples themselves blurs them; of these coefficients it interpolates them (Unser,
//! Aldroubi, Eden, "B-spline signal processing", 1993). Each axis is filtered forwards and backwards
//! with the pole `sqrt(3) - 2`; beyond its ends the volume is its mirror image. The pass takes four bytes a
//! voxel for as long as bricks are cut. Each sample has its own order of additions, so the coefficients
//! do not depend on the number of threads.

use rayon::prelude::*;
use slabcast_common::volume::{Samples, Volume};

/// Pole of the filter.
const POLE: f32 = -0.267_949_2;

/// Samples from which the forward pass begins: the pole to this power is 1e-7.
const BEGIN: usize = 12;

/// Returns the coefficients of all samples, in codes, in the order of the samples. They are cut off at
/// all codes' length beyond the smallest and the largest code. Samples that are NaN count as the
/// smallest code for their neighbours and stay NaN.
pub(crate) fn coefficients(volume: &Volume) -> Vec<f32> {
    let summary = &volume.summary;
    let (lo, hi) = (summary.min_code as f32, summary.max_code as f32);
    let code = |x: f32| if x.is_nan() { lo } else { x.clamp(lo, hi) };
    let mut c: Vec<f32> = match &volume.samples {
        Samples::U8(v) => v.par_iter().map(|&x| f32::from(x)).collect(),
        Samples::U16(v) => v.par_iter().map(|&x| f32::from(x)).collect(),
        Samples::F32(v) => v.par_iter().map(|&x| code(x)).collect(),
    };
    let [nx, ny, nz] = volume.lattice.dims.map(|n| n as usize);
    c.par_chunks_mut(nx).for_each(|row| filter(row, nx, 1));
    c.par_chunks_mut(nx * ny).for_each(|layer| filter(layer, ny, nx));
    filter_layers(&mut c, nz, nx * ny);
    let span = hi - lo;
    let cut = |c: &mut f32| *c = c.clamp(lo - span, hi + span);
    c.par_iter_mut().for_each(cut);
    if let Samples::F32(v) = &volume.samples {
        let keep = |(c, x): (&mut f32, &f32)| *c = if x.is_nan() { f32::NAN } else { *c };
        c.par_iter_mut().zip(v).for_each(keep);
    }
    c
}

/// Filters `n` rows of `width` samples along the direction across them.
fn filter(rows: &mut [f32], n: usize, width: usize) {
    if n < 2 {
        return;
    }
    // The gain comes first, so that the rows need no other pass.
    rows.iter_mut().for_each(|x| *x *= 6.0);
    for x in 0..width {
        let begin = mirrored(n, |i| rows[i * width + x]);
        rows[x] = begin;
    }
    for i in 1..n {
        let (before, here) = rows.split_at_mut(i * width);
        for (x, here) in here[..width].iter_mut().enumerate() {
            *here += POLE * before[(i - 1) * width + x];
        }
    }
    for x in 0..width {
        let [last, before] = [rows[(n - 1) * width + x], rows[(n - 2) * width + x]];
        rows[(n - 1) * width + x] = end(last, before);
    }
    for i in (0..n - 1).rev() {
        let (here, after) = rows.split_at_mut((i + 1) * width);
        for (x, after) in after[..width].iter().enumerate() {
            let here = &mut here[i * width + x];
            *here = POLE * (after - *here);
        }
    }
}

/// Filters `n` layers of `width` samples along the direction across them. Samples of a layer are
/// filtered in parallel.
fn filter_layers(all: &mut [f32], n: usize, width: usize) {
    if n < 2 {
        return;
    }
    all.par_iter_mut().for_each(|x| *x *= 6.0);
    let first: Vec<f32> =
        (0..width).into_par_iter().map(|x| mirrored(n, |i| all[i * width + x])).collect();
    all[..width].copy_from_slice(&first);
    for i in 1..n {
        let (before, here) = all.split_at_mut(i * width);
        let before = &before[(i - 1) * width..];
        here[..width].par_iter_mut().zip(before).for_each(|(here, before)| *here += POLE * before);
    }
    let (rest, last) = all.split_at_mut((n - 1) * width);
    let before = &rest[(n - 2) * width..];
    last.par_iter_mut().zip(before).for_each(|(last, before)| *last = end(*last, *before));
    for i in (0..n - 1).rev() {
        let (here, after) = all.split_at_mut((i + 1) * width);
        let step = |(here, after): (&mut f32, &f32)| *here = POLE * (after - *here);
        here[i * width..].par_iter_mut().zip(&after[..width]).for_each(step);
    }
}

/// The first value of the forward pass: the sum of the mirrored samples times powers of the pole.
fn mirrored(n: usize, at: impl Fn(usize) -> f32) -> f32 {
    let period = 2 * (n - 1);
    let (mut sum, mut power) = (0.0, 1.0);
    for i in 0..BEGIN {
        let i = i % period;
        sum += power * at(if i < n { i } else { period - i });
        power *= POLE;
    }
    sum
}

/// The last value of the backward pass, from the last two of the forward pass.
fn end(last: f32, before: f32) -> f32 {
    POLE / (POLE * POLE - 1.0) * (last + POLE * before)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The B-spline of coefficients at the sample `at`.
    fn spline(c: &[f32], dims: [u32; 3], at: [u32; 3]) -> f64 {
        let weights = [1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0];
        let mut sum = 0.0;
        for (n, wz) in weights.iter().enumerate() {
            for (m, wy) in weights.iter().enumerate() {
                for (l, wx) in weights.iter().enumerate() {
                    let p: [usize; 3] = std::array::from_fn(|a| {
                        let last = dims[a] as i64 - 1;
                        let p = i64::from(at[a]) + [l, m, n][a] as i64 - 1;
                        // The mirror image; of one sample, itself.
                        let p = p.abs().min(2 * last - p.abs().min(2 * last));
                        p.unsigned_abs().min(last as u64) as usize
                    });
                    let [nx, ny, _] = dims.map(|n| n as usize);
                    sum += wx * wy * wz * f64::from(c[(p[2] * ny + p[1]) * nx + p[0]]);
                }
            }
        }
        sum
    }

    #[test]
    fn splines_of_coefficients_pass_through_the_samples() {
        for dims in [[9, 7, 8], [1, 5, 2], [2, 1, 1], [1, 1, 1]] {
            // Not so rough that coefficients are cut off.
            let waves = |i: u32, j: u32, k: u32| {
                let [x, y, z] = [i, j, k].map(f64::from);
                (100.0 + 50.0 * libm::sin(x) * libm::cos(1.3 * y + 0.7 * z)) as u8
            };
            let volume = Volume::from_fn_u8("waves", dims, waves);
            let c = coefficients(&volume);
            for k in 0..dims[2] {
                for j in 0..dims[1] {
                    for i in 0..dims[0] {
                        let (got, want) = (spline(&c, dims, [i, j, k]), waves(i, j, k));
                        let off = (got - f64::from(want)).abs();
                        assert!(off < 1e-3, "{dims:?} {i},{j},{k}: {got} for {want}");
                    }
                }
            }
        }
    }
}
