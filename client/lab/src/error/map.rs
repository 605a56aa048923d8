//! The error map: the picture and, beside it, its error in false colours.
//!
//! The colour of a pixel is the largest error of its four channels against the limit. The scale is
//! always the same, so that maps can be compared: logarithmic, from 0.01 to 10 of 1/255. Each cell
//! of the sample is drawn as one block, in the colour of its one pixel.

use super::ErrorResult;
use slabcast_common::image::{Background, Picture};
use slabcast_common::occlusion::Rect;
use slabcast_render::judge::reference::grid_cells;
use slabcast_session::canvas::{self, Canvas, LINE, WHITE, viridis};
use slabcast_session::fail::Fail;
use slabcast_session::output::write_atomic;
use std::path::Path;

/// Ends of the scale in 1/255. Three decades: at 0.01 a pixel is as good as exact in any 8-bit
/// picture, and only one in a thousand of the worst view measured was above 10.
const SCALE: [f64; 2] = [0.01, 10.0];
/// Colour of a pixel that is blank in both picture and limit. The scale has no grey.
const BLANK: [u8; 3] = [96; 3];
/// Colour of an error beyond the scale, or not finite.
const OVER: [u8; 3] = WHITE;
/// Pixels between the two pictures and around the scale.
const GAP: usize = 8;
const BAR: usize = 10;
/// Edge of a dot of the digits, in pixels.
const DOT: usize = 2;
/// Least width of a canvas whose scale has numbers, in pixels.
const LEAST_NUMBERED_WIDTH: usize = 160;

/// Refuses a map that would overwrite the volume.
pub(super) fn check(map: &Path, volume: &Path) -> Result<(), Fail> {
    match (map.canonicalize(), volume.canonicalize()) {
        (Ok(a), Ok(b)) if a == b => {
            Err(Fail::usage(format!("--map: {} is the volume; give another file", map.display())))
        }
        (Ok(a), _) if a.is_dir() => {
            Err(Fail::usage(format!("--map: {} is a folder; give a file", map.display())))
        }
        _ => Ok(()),
    }
}

/// Returns the error at each pixel of the sample, in 1/255; `None` for a blank pixel.
fn errors(result: &ErrorResult) -> Vec<Option<f64>> {
    let w = result.picture.size[0] as usize;
    let one = |(&[x, y], want): (&[u32; 2], &[f64; 4])| {
        let got = result.picture.pixels[y as usize * w + x as usize].map(f64::from);
        if got[3] <= 0.0 && want[3] <= 0.0 {
            return None;
        }
        let off = |c: usize| (got[c] - want[c]).abs() * 255.0;
        // `f64::max` would ignore NaN.
        Some((0..4).map(off).fold(0.0, |a, b| if a >= b { a } else { b }))
    };
    result.sample.iter().zip(&result.limit).map(one).collect()
}

/// Returns the colour of an error in 1/255.
fn colour(error: Option<f64>) -> [u8; 3] {
    let Some(e) = error else { return BLANK };
    let [lo, hi] = SCALE;
    if e.is_nan() || e > hi {
        return OVER;
    }
    viridis(libm::log(e.max(lo) / lo) / libm::log(hi / lo))
}

/// Draws the picture at the left, its error at the right, the scale below.
fn draw(picture: &Picture, background: Background, blocks: &[(Rect, [u8; 3])]) -> Canvas {
    let [w, h] = picture.size.map(|n| n as usize);
    let width = 2 * w + GAP;
    let mut canvas = Canvas::new([width, h + GAP + BAR + GAP / 2 + LINE * DOT]);
    canvas.picture([0, 0], picture, background);
    for (r, colour) in blocks {
        canvas.fill([w + GAP + r.x0 as usize, r.y0 as usize], [r.width(), r.height()], *colour);
    }
    let bar = h + GAP;
    let [lo, hi] = SCALE;
    let all = libm::log(hi / lo);
    for x in 0..width {
        let e = lo * libm::exp((x as f64 + 0.5) / width as f64 * all);
        canvas.fill([x, bar], [1, BAR], colour(Some(e)));
    }
    if width >= LEAST_NUMBERED_WIDTH {
        for (i, text) in ["0.01", "0.1", "1", "10"].into_iter().enumerate() {
            let long = canvas::width(text, DOT);
            let x = (width - 1) * i / 3;
            canvas.fill([x, bar], [1, BAR + GAP / 2], WHITE);
            let x = x.saturating_sub(long / 2).min(width - long);
            canvas.text([x, bar + BAR + GAP / 2], DOT, text, WHITE);
        }
    }
    canvas
}

/// Writes the map, whole or not at all.
pub(super) fn write(path: &Path, result: &ErrorResult) -> Result<(), Fail> {
    let cells = grid_cells(result.picture.size, result.sample.len());
    let blocks: Vec<_> =
        cells.into_iter().zip(errors(result)).map(|(cell, e)| (cell, colour(e))).collect();
    let canvas = draw(&result.picture, result.scene.background, &blocks);
    let figures = result.whole[0].figures;
    let about = [
        ("slabcast lab error scale", scale()),
        (
            "slabcast lab error figures",
            format!("RMSE {} max {} of 1/255", figures.rmse, figures.max),
        ),
        ("slabcast pixels_sha256", result.picture.sha256().to_string()),
    ];
    write_atomic(path, |out| canvas.png(out, &about))
}

fn scale() -> String {
    let [lo, hi] = SCALE;
    format!(
        "largest error of the four channels against the limit, logarithmic: violet {lo} of 1/255 \
         or less, yellow {hi}, white above, grey blank"
    )
}

/// Returns a line that explains the map.
pub(super) fn caption(path: &Path, result: &ErrorResult) -> String {
    let all = result.sample.len() == result.picture.pixels.len();
    let blocks = if all { "" } else { "; a block is a pixel of the sample (--pixels all: each)" };
    format!("map: {}: {}{blocks}\n", path.display(), scale())
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_session::canvas::{PAPER, VIRIDIS};

    #[test]
    fn the_scale_ascends_in_lightness_and_has_no_grey() {
        let light = |c: [u8; 3]| {
            let [r, g, b] = c.map(f64::from);
            0.2126 * r + 0.7152 * g + 0.0722 * b
        };
        let mut last = 0.0;
        for i in 0..=300 {
            let c = colour(Some(0.01 * libm::pow(10.0, f64::from(i) / 100.0)));
            assert!(light(c) >= last - 1.0, "{i}: {c:?}");
            last = light(c);
            let (lo, hi) = (c.iter().min().unwrap(), c.iter().max().unwrap());
            assert!(hi - lo > 60, "{c:?} is almost grey");
        }
        assert_eq!(colour(Some(0.0)), VIRIDIS[0]);
        assert_eq!(colour(Some(10.0)), VIRIDIS[10]);
        for over in [10.1, f64::INFINITY, f64::NAN] {
            assert_eq!(colour(Some(over)), OVER);
        }
        assert_eq!(colour(None), BLANK);
    }

    #[test]
    fn blocks_stand_beside_the_picture_and_the_smallest_picture_has_a_scale() {
        for size in [[1u32, 1], [90, 3]] {
            let n = (size[0] * size[1]) as usize;
            let picture = Picture { size, pixels: vec![[0.0, 0.0, 1.0, 1.0]; n] };
            let whole = Rect::from_size(size);
            let canvas = draw(&picture, Background::Transparent, &[(whole, VIRIDIS[3])]);
            let at = |x: usize, y: usize| {
                let i = (y * canvas.size[0] + x) * 3;
                [canvas.bytes[i], canvas.bytes[i + 1], canvas.bytes[i + 2]]
            };
            let [w, h] = size.map(|n| n as usize);
            assert_eq!(at(w - 1, h - 1), [0, 0, 255]);
            assert_eq!(at(w, 0), PAPER);
            assert_eq!(at(w + GAP, 0), VIRIDIS[3]);
            assert_eq!(at(2 * w + GAP - 1, h - 1), VIRIDIS[3]);
            assert!(at(0, h + GAP)[2] > 80, "the scale begins violet");
        }
    }
}
