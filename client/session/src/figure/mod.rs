//! Annotations drawn over a finished picture: scale bar, colour bar, orientation letters, caption.
//!
//! [`Figure`] holds the user's flags and is stored in a picture's provenance. [`Marker`] computes the
//! text and lengths of a frame's annotations. [`Board`] draws them; pixels under no annotation don't
//! change.

mod bar;
mod board;
mod marks;

pub use board::{Board, Place, text_size};
pub use marks::Marker;

use crate::fail::Fail;
use crate::letters;
use serde::{Deserialize, Serialize};

/// Longest caption in characters: some eight lines of a square picture.
const MOST_LETTERS: usize = 400;

/// Marks over the picture, and its size on paper.
#[derive(clap::Args, Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
#[command(next_help_heading = "Figure (drawn over the picture)")]
pub struct Figure {
    /// Bar of a round length
    ///
    /// In mm, or with fitting prefix, where the file says where it lies; else --scale-bar=UNIT names the
    /// unit of its spacing. Parallel projection only.
    #[arg(long, value_name = "UNIT", num_args = 0..=1, require_equals = true,
          default_missing_value = "", hide_short_help = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scale_bar: Option<String>,
    /// Colours and opacities over the values
    #[arg(long, hide_short_help = true)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub color_bar: bool,
    /// Letters at the edges: L R A P S I, the sides of the body
    #[arg(long, hide_short_help = true)]
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub orientation: bool,
    /// Text below
    #[arg(long, value_name = "TEXT", hide_short_help = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub caption: Option<String>,
    /// Dots an inch on paper, for programs that place the picture
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=20_000),
          hide_short_help = true)]
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dpi: Option<u32>,
}

impl Figure {
    /// Returns whether there is nothing of it.
    pub fn is_empty(&self) -> bool {
        *self == Figure::default()
    }

    /// Returns the flag of one of the marks; `None` if there are none.
    pub fn flag(&self) -> Option<&'static str> {
        let given = [
            (self.scale_bar.is_some(), "scale-bar"),
            (self.color_bar, "color-bar"),
            (self.orientation, "orientation"),
            (self.caption.is_some(), "caption"),
        ];
        given.into_iter().find(|(given, _)| *given).map(|(_, flag)| flag)
    }

    /// Checks what needs no volume; `linear` is whether the file holds linear light, `still` whether
    /// it has room for dots an inch.
    ///
    /// # Errors
    /// A flag doesn't go with the format, or the caption can't be written.
    pub fn check(&self, linear: bool, still: bool) -> Result<(), Fail> {
        if let (Some(flag), true) = (self.flag(), linear) {
            return Err(Fail::usage(format!(
                "--{flag}: an EXR holds the light alone, without marks; give png, tif or jpg"
            )));
        }
        if self.dpi.is_some() && (!still || linear) {
            return Err(Fail::usage(
                "--dpi: goes into png, tif and jpg; this format has no place for it, leave it out",
            ));
        }
        let texts = [("caption", &self.caption), ("scale-bar", &self.scale_bar)];
        for (flag, text) in texts.into_iter().filter_map(|(flag, t)| Some((flag, t.as_ref()?))) {
            if flag == "caption" && text.trim().is_empty() {
                return Err(Fail::usage("--caption: is empty; give a text, or leave it out"));
            }
            if text.chars().count() > if flag == "caption" { MOST_LETTERS } else { 12 } {
                return Err(Fail::usage(format!(
                    "--{flag}: {} characters are too many to be drawn; give a shorter text",
                    text.chars().count()
                )));
            }
            if let Some(c) = letters::missing(text) {
                return Err(Fail::usage(format!(
                    "--{flag}: the font has no letter for {c:?}; leave it out, or set the text in \
                     the program that places the picture"
                )));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn captions_that_cannot_be_drawn_are_refused_by_name() {
        let of = |caption: &str| Figure { caption: Some(caption.into()), ..Figure::default() };
        assert!(of("Fig. 1: left hippocampus, 3 \u{b5}m").check(false, true).is_ok());
        for (caption, says) in [
            ("", "empty"),
            ("\u{6f22}", "no letter"),
            ("a\nb", "no letter"),
            (&"x".repeat(500), "too many"),
        ] {
            let said = of(caption).check(false, true).unwrap_err();
            let said = said.line().unwrap_or_default().to_string();
            assert!(said.starts_with("--caption: ") && said.contains(says), "{caption}: {said}");
        }
        let dpi = Figure { dpi: Some(300), ..Figure::default() };
        assert!(dpi.check(false, true).is_ok() && dpi.check(false, false).is_err());
        assert!(of("x").check(true, true).is_err());
    }
}
