//! Errors as figures.

use slabcast_common::image::{Background, Picture, PixelFormat};

/// The larger of two errors; what is not a number is the worst.
pub(super) fn worse(a: f64, b: f64) -> f64 {
    let b = b.abs();
    if b <= a {
        a
    } else if b.is_nan() {
        f64::INFINITY
    } else {
        b
    }
}

/// How far a picture is from what it should be (CONTRACTS.md, Colour and error): linear
/// premultiplied RGBA in units of 1/255, over the pixels where either has alpha above zero.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorFigures {
    /// Root of the mean square over all four channels.
    pub rmse: f64,
    /// Largest over all four channels; infinite if a number is not finite.
    pub max: f64,
    /// What 99.9 % of the pixels keep to in all four channels: of fewer than 1000, the maximum.
    pub most_999: f64,
    /// Share of the pixels off by more than 1 in a channel.
    pub share_above_1: f64,
    /// Root of the mean square over RGB of the 8-bit sRGB pictures, in their steps.
    pub rmse_srgb8: f64,
    /// Pixels that count.
    pub n_pixels: usize,
}

impl ErrorFigures {
    /// Compares pixels of a picture, linear premultiplied RGBA, with what they should be, one
    /// by one. `background` is what lies behind the 8-bit pictures.
    ///
    /// # Panics
    /// If there are not as many of the one as of the other.
    pub fn compare(got: &[[f32; 4]], want: &[[f64; 4]], background: Background) -> ErrorFigures {
        assert_eq!(got.len(), want.len(), "each pixel needs one to be compared with");
        let mut figures = ErrorFigures::default();
        let (mut squares, mut above) = (0.0, 0usize);
        let (mut left, mut right) = (Vec::new(), Vec::new());
        let mut each = Vec::new();
        for (got, want) in got.iter().zip(want) {
            let blank = |a: f64| a <= 0.0;
            if blank(f64::from(got[3])) && blank(want[3]) {
                continue;
            }
            left.push(*got);
            right.push(want.map(|x| x as f32));
            let mut worst = 0.0;
            for c in 0..4 {
                let off = worse(0.0, (f64::from(got[c]) - want[c]) * 255.0);
                squares += off * off;
                worst = f64::max(worst, off);
            }
            figures.max = figures.max.max(worst);
            each.push(worst);
            above += usize::from(worst > 1.0);
        }
        figures.n_pixels = left.len();
        if figures.n_pixels == 0 {
            return figures;
        }
        let n = figures.n_pixels as f64;
        figures.rmse = (squares / (4.0 * n)).sqrt();
        figures.share_above_1 = above as f64 / n;
        each.sort_unstable_by(f64::total_cmp);
        figures.most_999 = each[each.len() - 1 - each.len() / 1000];
        let bytes = |pixels: Vec<[f32; 4]>| {
            Picture { size: [pixels.len() as u32, 1], pixels }.encode(PixelFormat::Rgb8, background)
        };
        let steps = bytes(left).iter().zip(bytes(right)).fold(0.0, |sum, (&a, b)| {
            let off = f64::from(a) - f64::from(b);
            sum + off * off
        });
        figures.rmse_srgb8 = (steps / (3.0 * n)).sqrt();
        figures
    }
}
