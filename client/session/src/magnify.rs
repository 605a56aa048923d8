//! A picture that was drawn small, at its full size.
//!
//! By cubic convolution (Keys 1981, a = -1/2, also called Catmull-Rom) of linear premultiplied
//! colours, by whole factors, so that each row and column has one of a few sets of weights. In one
//! written order of operations, like all that decides pixels; libraries for this choose theirs by
//! the machine, or take as long as drawing does.

use crate::direct;
use slabcast_common::image::Picture;

/// Rows that a thread magnifies at a time.
const ROWS: usize = 32;

/// Returns `small` with each edge `factor` times as long, computed on `threads` threads.
/// Colours stay between 0 and their alpha, alpha between 0 and 1.
pub fn magnified(small: Picture, factor: u32, threads: usize) -> Picture {
    if factor == 1 {
        return small;
    }
    let [w, h] = small.size.map(|n| n as usize);
    let by = factor as usize;
    let size = [small.size[0] * factor, small.size[1] * factor];
    let phases: Vec<(isize, [f32; 4])> = (0..by).map(|i| phase(i, by)).collect();
    let high = h * by;
    let bands = direct::map_parallel(high.div_ceil(ROWS), threads, |band, _: &mut ()| {
        let mut out = Vec::with_capacity(ROWS * w * by);
        let mut line = vec![[0.0f32; 4]; w];
        for y in band * ROWS..high.min((band + 1) * ROWS) {
            let (first, weights) = phases[y % by];
            let row = |n: isize| {
                let at = ((y / by) as isize + first + n).clamp(0, h as isize - 1) as usize;
                &small.pixels[at * w..][..w]
            };
            let rows = [row(0), row(1), row(2), row(3)];
            for (x, to) in line.iter_mut().enumerate() {
                *to = mix([rows[0][x], rows[1][x], rows[2][x], rows[3][x]], weights);
            }
            for x in 0..w {
                for (first, weights) in &phases {
                    let at =
                        |n: isize| line[(x as isize + first + n).clamp(0, w as isize - 1) as usize];
                    let [r, g, b, a] = mix([at(0), at(1), at(2), at(3)], *weights);
                    let a = a.clamp(0.0, 1.0);
                    out.push([r.clamp(0.0, a), g.clamp(0.0, a), b.clamp(0.0, a), a]);
                }
            }
        }
        out
    });
    Picture { size, pixels: bands.concat() }
}

fn mix(p: [[f32; 4]; 4], w: [f32; 4]) -> [f32; 4] {
    let mut sum = [0.0; 4];
    for c in 0..4 {
        sum[c] = (p[0][c] * w[0] + p[1][c] * w[1]) + (p[2][c] * w[2] + p[3][c] * w[3]);
    }
    sum
}

/// Returns the four source pixels of a magnified pixel, the `i`-th of the `by` pixels that one
/// small pixel becomes along an axis: the position of the first source, counted from the small
/// pixel, and the weights of all four.
fn phase(i: usize, by: usize) -> (isize, [f32; 4]) {
    // Centres: of the large pixel in units of small ones, from the small pixel's own.
    let at = (i as f64 + 0.5) / by as f64 - 0.5;
    let below = at.floor();
    let t = at - below;
    let weights = [
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    ];
    (below as isize - 1, weights.map(|w| w as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture(w: u32, h: u32, of: impl Fn(f32, f32) -> [f32; 4]) -> Picture {
        let at = |i: u32| of((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
        Picture { size: [w, h], pixels: (0..w * h).map(at).collect() }
    }

    #[test]
    fn slopes_stay_what_they_are() {
        let of = |x: f32, y: f32| {
            let a = 0.2 + 0.02 * x + 0.01 * y;
            [a * 0.5, a * 0.25, 0.0, a]
        };
        for by in [1, 2, 3, 4] {
            let (w, h) = (12, 10);
            let large = magnified(picture(w, h, of), by, 3);
            assert_eq!(large.size, [w * by, h * by]);
            let f = by as f32;
            for y in 2 * by..(h - 2) * by {
                for x in 2 * by..(w - 2) * by {
                    let got = large.pixels[(y * w * by + x) as usize];
                    let want = of((x as f32 + 0.5) / f, (y as f32 + 0.5) / f);
                    let off = (0..4).map(|c| (got[c] - want[c]).abs()).fold(0.0, f32::max);
                    assert!(off < 1e-6, "{by}: {x},{y}: {got:?} {want:?}");
                }
            }
        }
    }

    #[test]
    fn edges_overshoot_nothing_and_threads_change_nothing() {
        let step = |x: f32, _: f32| if x < 6.0 { [0.0; 4] } else { [1.0, 0.0, 0.5, 1.0] };
        let large = magnified(picture(40, 40, step), 4, 2);
        for p in &large.pixels {
            assert!((0.0..=1.0).contains(&p[3]), "{p:?}");
            assert!(p.iter().all(|c| (0.0..=p[3]).contains(c)), "{p:?}");
        }
        assert_eq!(large.pixels, magnified(picture(40, 40, step), 4, 1).pixels);
    }
}
