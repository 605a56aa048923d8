//! Error of a moving picture against the still of the same view. Pure.

/// Edge of the blocks over which the error is averaged, in pixels of the still. Single pixels at silhouettes
/// are always far off; a block is large enough to average them out and small enough to show a lost part.
const BLOCK: u32 = 64;

/// A picture: 3 bytes of RGB a pixel, rows from the top, and its width and height in pixels.
#[derive(Clone, Copy)]
pub(crate) struct Picture<'a> {
    pub(crate) rgb: &'a [u8],
    pub(crate) size: [u32; 2],
}

/// Linear interpolation along one axis: two neighbouring source pixels, and the weight of the second.
#[derive(Clone, Copy)]
struct Between {
    first: usize,
    second: usize,
    share: f32,
}

/// Returns the interpolation that stretches `from` pixels of an axis to `to`, for each of the `to` pixels.
fn stretch(from: u32, to: u32) -> Vec<Between> {
    let last = from.saturating_sub(1) as f32;
    let at = |i: u32| ((i as f32 + 0.5) * from as f32 / to as f32 - 0.5).clamp(0.0, last);
    let between = |i: u32| {
        let (x, first) = (at(i), at(i).floor());
        let second = (first + 1.0).min(last);
        Between { first: first as usize, second: second as usize, share: x - first }
    };
    (0..to).map(between).collect()
}

/// Returns the largest root mean square difference between a preview, stretched to the still's size with
/// linear interpolation, and the still, over blocks of 64x64 pixels; as a share of full scale, 0 to 1.
pub(crate) fn largest_difference(preview: Picture, still: Picture) -> f32 {
    let [w, h] = still.size;
    let columns = stretch(preview.size[0], w);
    let rows = stretch(preview.size[1], h);
    let stride = preview.size[0] as usize * 3;
    let across = w.div_ceil(BLOCK) as usize;
    let mut largest = 0f32;
    for top in (0..h).step_by(BLOCK as usize) {
        let bottom = (top + BLOCK).min(h);
        let mut sums = vec![0f32; across];
        for y in top..bottom {
            let row = rows[y as usize];
            let upper = &preview.rgb[row.first * stride..][..stride];
            let lower = &preview.rgb[row.second * stride..][..stride];
            let exact = still.rgb[y as usize * w as usize * 3..].chunks_exact(3);
            for (x, (pixel, column)) in exact.zip(&columns).enumerate() {
                let mix = |line: &[u8], channel: usize| {
                    let a = f32::from(line[column.first * 3 + channel]);
                    let b = f32::from(line[column.second * 3 + channel]);
                    a + (b - a) * column.share
                };
                let of = |channel: usize| {
                    let (a, b) = (mix(upper, channel), mix(lower, channel));
                    let off = a + (b - a) * row.share - f32::from(pixel[channel]);
                    off * off
                };
                sums[x / BLOCK as usize] += of(0) + of(1) + of(2);
            }
        }
        for (i, sum) in sums.iter().enumerate() {
            let width = BLOCK.min(w - i as u32 * BLOCK);
            let n = 3 * width * (bottom - top);
            largest = largest.max((sum / n as f32).sqrt() / 255.0);
        }
    }
    largest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(size: [u32; 2], grey: u8) -> Vec<u8> {
        vec![grey; (size[0] * size[1] * 3) as usize]
    }

    #[test]
    fn difference_is_that_of_the_worst_block() {
        let (small, large) = ([30, 22], [90, 66]);
        let preview = flat(small, 100);
        let mut still = flat(large, 100);
        let of = |still: &[u8]| {
            let preview = Picture { rgb: &preview, size: small };
            largest_difference(preview, Picture { rgb: still, size: large })
        };
        assert_eq!(of(&still), 0.0);
        // The block in the lower right corner has 26x2 pixels.
        for y in 64..66 {
            for x in 64..90 {
                still[(y * 90 + x) * 3] = 130;
            }
        }
        let expected = (900f32 / 3.0).sqrt() / 255.0;
        assert!((of(&still) - expected).abs() < 1e-6);
    }

    #[test]
    fn stretched_ramps_stay_ramps() {
        let ramp = |w: u32| -> Vec<u8> {
            let step = 256 / w;
            let row = (0..w).map(move |x| (step / 2 + x * step) as u8);
            row.flat_map(|grey| [grey; 3]).collect()
        };
        let preview = Picture { rgb: &ramp(16), size: [16, 1] };
        let still = Picture { rgb: &ramp(64), size: [64, 1] };
        // The ends are flat for half a pixel of the preview: 2 and 6 of 255 off.
        let off = largest_difference(preview, still) * 255.0;
        assert!(off < 2.0, "{off}");
        let same = Picture { rgb: &ramp(16), size: [16, 1] };
        assert_eq!(largest_difference(preview, same), 0.0);
    }

    #[test]
    fn pictures_of_one_pixel_can_be_compared() {
        let one = Picture { rgb: &[10, 10, 10], size: [1, 1] };
        let two = Picture { rgb: &[10, 10, 10, 20, 20, 20], size: [2, 1] };
        assert!(largest_difference(one, two) > 0.0);
        assert_eq!(largest_difference(one, one), 0.0);
    }
}
