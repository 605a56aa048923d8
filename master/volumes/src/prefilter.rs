//! Coefficients of the cubic B-spline that passes through a volume's samples.
//!
//! A B-spline with the samples as coefficients blurs them; with these coefficients it interpolates
//! them (Unser, Aldroubi, Eden, "B-spline signal processing", 1993). Each axis is filtered forwards
//! and backwards with the pole `sqrt(3) - 2`; the volume is mirrored at its ends. The coefficients
//! take four bytes a voxel for as long as bricks are cut. The order of additions is fixed for each
//! sample, so the coefficients do not depend on the number of threads.

use rayon::prelude::*;
use slabcast_common::volume::{Samples, Volume};

/// Pole of the filter.
const POLE: f32 = -0.267_949_2;

/// Gain of the filter, which keeps a constant as it is.
const GAIN: f32 = 6.0;

/// Number of samples that the first value of the forward pass sums: the pole to this power is 1e-7.
const BEGIN: usize = 12;

/// Returns the coefficients of all samples, in codes, in the order of the samples. With the
/// volume's codes from `lo` to `hi`, coefficients are clamped to `2 lo - hi` and `2 hi - lo`. NaN
/// samples stay NaN; for their neighbours they count as the smallest code.
///
/// Each layer is filtered along x and y while it is in the cache. Then each row is filtered along z
/// through all layers. So memory is read and written twice in all.
pub(crate) fn coefficients(volume: &Volume) -> Vec<f32> {
    let summary = &volume.summary;
    let (lo, hi) = (summary.min_code as f32, summary.max_code as f32);
    let [nx, ny, _] = volume.lattice.dims.map(|n| n as usize);
    let mut all = vec![0.0f32; volume.samples.len()];
    let layers = all.par_chunks_mut(nx * ny);
    let in_layer = |layer: &mut [f32]| {
        filter_along(layer, nx);
        filter_across(&mut layer.chunks_mut(nx).collect::<Vec<_>>());
    };
    match &volume.samples {
        Samples::U8(v) => layers.zip(v.par_chunks(nx * ny)).for_each(|(layer, codes)| {
            layer.iter_mut().zip(codes).for_each(|(to, &code)| *to = f32::from(code));
            in_layer(layer);
        }),
        Samples::U16(v) => layers.zip(v.par_chunks(nx * ny)).for_each(|(layer, codes)| {
            layer.iter_mut().zip(codes).for_each(|(to, &code)| *to = f32::from(code));
            in_layer(layer);
        }),
        Samples::F32(v) => layers.zip(v.par_chunks(nx * ny)).for_each(|(layer, codes)| {
            let code = |x: f32| if x.is_nan() { lo } else { x.clamp(lo, hi) };
            layer.iter_mut().zip(codes).for_each(|(to, &x)| *to = code(x));
            in_layer(layer);
        }),
    }
    let mut by_row: Vec<Vec<&mut [f32]>> = (0..ny).map(|_| Vec::new()).collect();
    all.chunks_mut(nx).enumerate().for_each(|(i, row)| by_row[i % ny].push(row));
    let span = hi - lo;
    by_row.into_par_iter().for_each(|mut rows| {
        filter_across(&mut rows);
        for c in rows.iter_mut().flat_map(|row| row.iter_mut()) {
            *c = c.clamp(lo - span, hi + span);
        }
    });
    if let Samples::F32(v) = &volume.samples {
        let keep = |(c, x): (&mut f32, &f32)| *c = if x.is_nan() { f32::NAN } else { *c };
        all.par_iter_mut().zip(v).for_each(keep);
    }
    all
}

/// Rows that are filtered at once, since each addition of a row waits for the one before.
const ROWS: usize = 8;

/// Filters each row of `n` samples in place.
fn filter_along(rows: &mut [f32], n: usize) {
    if n < 2 {
        return;
    }
    let mut some = rows.chunks_exact_mut(ROWS * n);
    some.by_ref().for_each(|rows| filter_rows::<ROWS>(rows, n));
    some.into_remainder().chunks_exact_mut(n).for_each(|row| filter_rows::<1>(row, n));
}

/// Filters `R` rows of `n` samples in place.
fn filter_rows<const R: usize>(rows: &mut [f32], n: usize) {
    let mut rest = rows;
    let rows: [&mut [f32]; R] =
        std::array::from_fn(|_| rest.split_off_mut(..n).expect("as many rows"));
    let mut last: [f32; R] = std::array::from_fn(|r| {
        let row = &rows[r];
        mirrored(n).fold(0.0, |sum, (power, i)| sum + power * (GAIN * row[i]))
    });
    for r in 0..R {
        rows[r][0] = last[r];
    }
    for i in 1..n {
        for r in 0..R {
            last[r] = GAIN * rows[r][i] + POLE * last[r];
            rows[r][i] = last[r];
        }
    }
    for r in 0..R {
        last[r] = end(last[r], rows[r][n - 2]);
        rows[r][n - 1] = last[r];
    }
    for i in (0..n - 1).rev() {
        for r in 0..R {
            last[r] = POLE * (last[r] - rows[r][i]);
            rows[r][i] = last[r];
        }
    }
}

/// Filters rows of equal length in place, across the rows: from one row to the next.
fn filter_across(rows: &mut [&mut [f32]]) {
    let n = rows.len();
    if n < 2 {
        return;
    }
    let mut begin = vec![0.0; rows[0].len()];
    for (power, i) in mirrored(n) {
        begin.iter_mut().zip(&*rows[i]).for_each(|(sum, x)| *sum += power * (GAIN * x));
    }
    rows[0].copy_from_slice(&begin);
    for i in 1..n {
        let (before, here) = rows.split_at_mut(i);
        let both = here[0].iter_mut().zip(&*before[i - 1]);
        both.for_each(|(here, before)| *here = GAIN * *here + POLE * before);
    }
    let (before, last) = rows.split_at_mut(n - 1);
    let both = last[0].iter_mut().zip(&*before[n - 2]);
    both.for_each(|(last, before)| *last = end(*last, *before));
    for i in (0..n - 1).rev() {
        let (here, after) = rows.split_at_mut(i + 1);
        let both = here[i].iter_mut().zip(&*after[0]);
        both.for_each(|(here, after)| *here = POLE * (after - *here));
    }
}

/// Iterates over the terms of the first value of the forward pass, in a mirrored row of `n`
/// samples: a power of the pole, and the index of the sample that it weighs.
fn mirrored(n: usize) -> impl Iterator<Item = (f32, usize)> {
    let period = 2 * (n - 1);
    let powers = std::iter::successors(Some(1.0), |power| Some(power * POLE));
    powers.zip(0..BEGIN).map(move |(power, i)| {
        let i = i % period;
        (power, if i < n { i } else { period - i })
    })
}

/// Returns the first value of the backward pass, which is the row's last coefficient. `before` and
/// `last` are the last two values of the forward pass.
fn end(last: f32, before: f32) -> f32 {
    POLE / (POLE * POLE - 1.0) * (last + POLE * before)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computes [`coefficients`] by the plain loop: sample by sample, one axis after the other.
    fn plain(volume: &Volume) -> Vec<f32> {
        let summary = &volume.summary;
        let (lo, hi) = (summary.min_code as f32, summary.max_code as f32);
        let codes: Vec<f32> =
            (0..volume.samples.len()).map(|i| volume.samples.code(i) as f32).collect();
        let code = |x: &f32| if x.is_nan() { lo } else { x.clamp(lo, hi) };
        let mut c: Vec<f32> = codes.iter().map(code).collect();
        let dims = volume.lattice.dims.map(|n| n as usize);
        let strides = [1, dims[0], dims[0] * dims[1]];
        for (n, stride) in dims.into_iter().zip(strides).filter(|(n, _)| *n > 1) {
            for first in (0..c.len()).filter(|i| i / stride % n == 0) {
                let at = |i: usize| first + i * stride;
                (0..n).for_each(|i| c[at(i)] *= 6.0);
                let (mut sum, mut power) = (0.0, 1.0);
                for i in 0..BEGIN {
                    let i = i % (2 * (n - 1));
                    sum += power * c[at(if i < n { i } else { 2 * (n - 1) - i })];
                    power *= POLE;
                }
                c[at(0)] = sum;
                (1..n).for_each(|i| c[at(i)] += POLE * c[at(i - 1)]);
                c[at(n - 1)] = end(c[at(n - 1)], c[at(n - 2)]);
                (0..n - 1).rev().for_each(|i| c[at(i)] = POLE * (c[at(i + 1)] - c[at(i)]));
            }
        }
        let cut = |(c, code): (&f32, &f32)| {
            if code.is_nan() { f32::NAN } else { c.clamp(lo - (hi - lo), hi + (hi - lo)) }
        };
        c.iter().zip(&codes).map(cut).collect()
    }

    #[test]
    fn coefficients_equal_the_plain_ones_bit_for_bit() {
        let bits = |c: &[f32]| c.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
        for dims in [[9, 17, 8], [1, 5, 2], [2, 1, 1], [1, 1, 1], [33, 1, 20], [64, 19, 3]] {
            let noise = |i: u32, j: u32, k: u32| ((i * 7919 + j * 104_729 + k * 1301) % 251) as u8;
            let bytes = Volume::from_fn_u8("noise", dims, noise);
            let Samples::U8(codes) = &bytes.samples else { unreachable!("made above") };
            let shorts = codes.iter().map(|&c| u16::from(c) * 257).collect();
            let wild = |(i, &c): (usize, &u8)| match i % 37 {
                5 => f32::NAN,
                9 => f32::INFINITY,
                _ => f32::from(c) - 80.0,
            };
            let floats = codes.iter().enumerate().map(wild).collect();
            for samples in [bytes.samples.clone(), Samples::U16(shorts), Samples::F32(floats)] {
                let map = slabcast_common::volume::ValueMap::IDENTITY;
                let volume = Volume::new("noise", "any", false, bytes.lattice, samples, map);
                assert_eq!(bits(&coefficients(&volume)), bits(&plain(&volume)), "{dims:?}");
            }
        }
    }

    /// Returns the value of the B-spline with coefficients `c` at sample `at`.
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
            // Smooth enough that no coefficient is clamped.
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
