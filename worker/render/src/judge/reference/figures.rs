//! Error figures of a picture.

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

/// Errors of a picture against a reference, in linear premultiplied RGBA and units of 1/255, over
/// the pixels where either has alpha above zero (docs/design/contracts.md, "Colour and error").
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ErrorFigures {
    /// Root mean square error over all four channels, in 1/255.
    pub rmse: f64,
    /// Largest error over all four channels, in 1/255; infinite if a number is not finite.
    pub max: f64,
    /// 99.9th percentile over pixels of the largest error over channels, in 1/255; of fewer than
    /// 1000 pixels, the maximum.
    pub most_999: f64,
    /// Share (0 to 1) of the pixels with an error above 1/255 in any channel.
    pub share_above_1: f64,
    /// Root mean square error over RGB of the 8-bit sRGB pictures, in steps of 8 bits.
    pub rmse_srgb8: f64,
    /// Number of pixels that were compared: those with alpha above zero in either picture.
    pub n_pixels: usize,
}

impl ErrorFigures {
    /// Compares pixels `got` with reference pixels `want`, one by one, both linear premultiplied
    /// RGBA. `background` lies behind the 8-bit pictures.
    ///
    /// # Panics
    /// If `got` and `want` differ in length.
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
