//! Text on pictures and charts: its width and its pixels.
//!
//! In a font that is part of the program, since a node of a cluster may have none. swash draws the
//! outline of each letter; letters stand side by side by their advance, unkerned.

use std::sync::OnceLock;
use swash::scale::{Render, ScaleContext, Source};
use swash::zeno::{Angle, Format, Transform, Vector};
use swash::{FontRef, GlyphId};

static FONT: &[u8] = include_bytes!("../fonts/DejaVuSans.ttf");

/// Returns the font of the program.
fn font() -> FontRef<'static> {
    static ONCE: OnceLock<FontRef<'static>> = OnceLock::new();
    // Part of the program, and read by the tests of this file.
    *ONCE.get_or_init(|| FontRef::from_index(FONT, 0).expect("the font of the program is a font"))
}

/// Returns the width of a text in pixels; `em` is the font's size in pixels.
pub fn width(text: &str, em: f64) -> f64 {
    letters(text, em).map(|(_, wide)| wide).sum()
}

/// Returns the first character of a text that the font has no letter for.
pub fn missing(text: &str) -> Option<char> {
    let letters = font().charmap();
    text.chars().find(|&c| letters.map(c) == 0)
}

/// Returns each letter's glyph and its advance in pixels.
fn letters(text: &str, em: f64) -> impl Iterator<Item = (GlyphId, f64)> {
    let font = font();
    let metrics = font.glyph_metrics(&[]).scale(em as f32);
    text.chars().map(move |c| {
        let glyph = font.charmap().map(c);
        (glyph, f64::from(metrics.advance_width(glyph)))
    })
}

/// The way in which a line of text runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Way {
    /// From left to right.
    Right,
    /// From below to above.
    Up,
}

/// Calls `put` with each pixel that a text covers, and by which part. Its base line begins at
/// `start`, in pixels to the right and down; `em` is the font's size in pixels.
///
/// # Errors
/// The first one of `put`.
pub fn draw<E>(
    text: &str,
    em: f64,
    start: (f64, f64),
    way: Way,
    mut put: impl FnMut((i32, i32), f64) -> Result<(), E>,
) -> Result<(), E> {
    let mut context = ScaleContext::new();
    let mut scaler = context.builder(font()).size(em as f32).build();
    let turn = (way == Way::Up).then(|| Transform::rotation(Angle::from_degrees(90.0)));
    let mut done = 0.0;
    for (glyph, wide) in letters(text, em) {
        let (x, y) = match way {
            Way::Right => (start.0 + done, start.1),
            Way::Up => (start.0, start.1 - done),
        };
        done += wide;
        // Whole pixels here, and the rest in the outline, whose y points upwards.
        let (left, top) = (x.floor(), y.floor());
        let rest = Vector::new((x - left) as f32, (top - y) as f32);
        let image = Render::new(&[Source::Outline])
            .format(Format::Alpha)
            .transform(turn)
            .offset(rest)
            .render(&mut scaler, glyph);
        // A space has no outline.
        let Some(image) = image else { continue };
        let place = image.placement;
        if place.width == 0 {
            continue;
        }
        for (row, line) in image.data.chunks_exact(place.width as usize).enumerate() {
            for (column, &covered) in line.iter().enumerate().filter(|(_, covered)| **covered > 0) {
                let at =
                    (left as i32 + place.left + column as i32, top as i32 - place.top + row as i32);
                put(at, f64::from(covered) / 255.0)?;
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The box about a text's pixels: least and most x and y, and the sum of what is covered.
    fn ink(text: &str, way: Way) -> ([i32; 4], f64) {
        let (mut area, mut covered) = ([i32::MAX, i32::MIN, i32::MAX, i32::MIN], 0.0);
        draw(text, 40.0, (100.0, 100.0), way, |(x, y), c| {
            area = [area[0].min(x), area[1].max(x), area[2].min(y), area[3].max(y)];
            covered += c;
            Ok::<(), std::convert::Infallible>(())
        })
        .unwrap_or_else(|e| match e {});
        (area, covered)
    }

    #[test]
    fn text_stands_on_its_base_line_and_is_as_wide_as_measured() {
        let ([left, right, top, bottom], covered) = ink("HHHH", Way::Right);
        assert_eq!(bottom, 99, "the base line begins at 100");
        assert!((69..=72).contains(&top), "capitals are 0.73 em high: {top}");
        let wide = f64::from(right - left);
        assert!((wide - width("HHHH", 40.0)).abs() < 10.0, "{wide}");
        assert!(covered > 500.0, "{covered}");
        // Below the base line.
        assert!(ink("p", Way::Right).0[3] > 103);
    }

    #[test]
    fn text_upwards_is_the_same_turned_to_the_left() {
        let ([left, right, top, bottom], covered) = ink("Ab p", Way::Right);
        let (turned, the_same) = ink("Ab p", Way::Up);
        // (x, y) about the start becomes (y, -x).
        let want = [top, bottom, 200 - right, 200 - left];
        assert!(turned.iter().zip(want).all(|(a, b)| (a - b).abs() <= 1), "{turned:?} {want:?}");
        assert!((covered - the_same).abs() < 0.02 * covered, "{covered} {the_same}");
    }

    #[test]
    fn letters_of_europe_are_there_and_others_are_named() {
        assert_eq!(
            missing("T1, 5 \u{b5}m, \u{3b1}, \u{c5}\u{142}\u{f6}\u{17e}, \u{416}\u{444}"),
            None
        );
        assert_eq!(missing("a \u{6f22}b"), Some('\u{6f22}'));
    }

    #[test]
    fn spaces_and_unknown_letters_have_a_width() {
        assert!(width(" ", 10.0) > 2.0);
        assert!(width("\u{10fffd}", 10.0) > 2.0);
        assert_eq!(width("", 10.0), 0.0);
        assert_eq!(ink("  ", Way::Right).1, 0.0);
    }
}
