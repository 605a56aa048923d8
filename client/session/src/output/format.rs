//! File formats of frames, and the names that ask for them.

use crate::fail::Fail;
use serde::{Deserialize, Serialize};
use slabcast_common::image::{Background, PixelFormat};
use std::path::{Path, PathBuf};

/// File format in which frames are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Format {
    /// 8-bit PNG
    Png,
    /// 16-bit PNG
    Png16,
    /// OpenEXR: linear premultiplied floats, no background
    Exr,
    /// 8-bit TIFF, packed without loss
    #[value(alias = "tiff")]
    Tif,
    /// JPEG in 4:4:4, quality 95
    #[value(alias = "jpeg")]
    Jpg,
    /// One moving PNG of all frames
    Apng,
    /// One uncompressed video of all frames (YUV4MPEG2), for ffmpeg and others
    Y4m,
    /// H.264 video of all frames, by ffmpeg
    Mp4,
    /// VP9 video of all frames, by ffmpeg
    Webm,
    /// One moving GIF of all frames, by ffmpeg
    Gif,
}

/// Endings that ask for a format, as a refusal names them.
const KNOWN: &str =
    ".png, .tif, .jpg or .exr for a picture, .mp4, .webm, .gif, .apng or .y4m for a moving one";

impl Format {
    /// Returns the pixel format that a master sends for this file format.
    pub fn pixels(self, background: Background) -> PixelFormat {
        match (self, background) {
            (Format::Png16, _) => PixelFormat::Rgba16,
            (Format::Exr, _) => PixelFormat::Rgba32F,
            (Format::Png | Format::Tif | Format::Apng, Background::Transparent) => {
                PixelFormat::Rgba8
            }
            _ => PixelFormat::Rgb8,
        }
    }

    /// Returns the ending of a file's name, without its dot.
    pub fn extension(self) -> &'static str {
        match self {
            Format::Png | Format::Png16 => "png",
            Format::Exr => "exr",
            Format::Tif => "tif",
            Format::Jpg => "jpg",
            Format::Apng => "apng",
            Format::Y4m => "y4m",
            Format::Mp4 => "mp4",
            Format::Webm => "webm",
            Format::Gif => "gif",
        }
    }

    /// Returns whether all frames go into one moving picture.
    pub fn moves(self) -> bool {
        matches!(self, Format::Apng | Format::Y4m) || self.by_ffmpeg()
    }

    /// Returns whether ffmpeg writes the file.
    pub fn by_ffmpeg(self) -> bool {
        matches!(self, Format::Mp4 | Format::Webm | Format::Gif)
    }

    /// Returns whether a file of this format can say what made it.
    pub(super) fn has_provenance(self) -> bool {
        !self.moves() || self == Format::Apng
    }

    /// Returns whether this machine can write the format: `false` where ffmpeg does and is missing.
    pub fn is_at_hand(self) -> bool {
        !self.by_ffmpeg() || super::ffmpeg::program().is_some()
    }

    /// Returns the frames a second where the user gives none. GIFs hold hundredths of a second and
    /// each frame in full: few. A video at less than 25 stutters.
    pub fn usual_fps(self) -> u16 {
        if matches!(self, Format::Mp4 | Format::Webm) { 30 } else { 12 }
    }

    /// Returns the word of `--format`.
    pub(super) fn name(self) -> &'static str {
        if self == Format::Png16 { "png16" } else { self.extension() }
    }

    /// Returns whether a name may end in `ends` (lower case) for this format.
    pub(super) fn fits(self, ends: &str) -> bool {
        match self {
            // A moving PNG is a PNG.
            Format::Apng => ends == "png" || ends == "apng",
            _ => Format::by_ending(ends).is_some_and(|f| f.extension() == self.extension()),
        }
    }

    fn by_ending(ends: &str) -> Option<Format> {
        Some(match ends {
            "png" => Format::Png,
            "exr" => Format::Exr,
            "tif" | "tiff" => Format::Tif,
            "jpg" | "jpeg" => Format::Jpg,
            "apng" => Format::Apng,
            "y4m" => Format::Y4m,
            "mp4" | "m4v" => Format::Mp4,
            "webm" => Format::Webm,
            "gif" => Format::Gif,
            _ => return None,
        })
    }
}

/// Ending of a path's last part in lower case, without its dot.
pub(super) fn ending(path: &Path) -> Option<String> {
    path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase)
}

/// Returns the format that the name of `-o` asks for; `None` for a folder, a pipe or stdout.
///
/// A name that ends in `/`, that is a folder's, or that has no ending is a folder. So is one whose
/// ending begins with no letter (`run.2`).
///
/// # Errors
/// The name has another ending: a folder called `turn.pdf` would be a surprise.
pub fn named(path: &Path) -> Result<Option<Format>, Fail> {
    let Some(ends) = ending(path) else { return Ok(None) };
    if path.is_dir() || path.to_string_lossy().ends_with('/') {
        return Ok(None);
    }
    let format = Format::by_ending(&ends);
    let is_word = ends.starts_with(|c: char| c.is_ascii_alphabetic());
    let special = std::fs::metadata(path).is_ok_and(|m| !m.is_file());
    if format.is_none() && is_word && !special {
        return Err(Fail::usage(format!(
            "-o: {}: no .{ends} is written; end the name in {KNOWN}, or in / for a folder",
            path.display()
        )));
    }
    Ok(format)
}

/// Returns a file's name if nothing has it, else the first free one of `NAME-2.png`, `NAME-3.png` and
/// so on: for files that the user did not name.
pub fn free_name(path: &Path) -> PathBuf {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let ending = path.extension().unwrap_or_default();
    let beside = |n: u32| path.with_file_name(format!("{stem}-{n}")).with_extension(ending);
    let names = std::iter::once(path.to_path_buf()).chain((2..10_000).map(beside));
    names.into_iter().find(|name| !name.exists()).unwrap_or_else(|| path.to_path_buf())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_ask_for_formats_folders_or_are_refused() {
        for (name, want) in [
            ("a.png", Some(Format::Png)),
            ("a.TIFF", Some(Format::Tif)),
            ("a.jpeg", Some(Format::Jpg)),
            ("turn.mp4", Some(Format::Mp4)),
            ("turn.mp4/", None),
            ("out", None),
            ("run.2", None),
            ("-", None),
        ] {
            assert_eq!(named(name.as_ref()).unwrap(), want, "{name}");
        }
        for name in ["turn.pdf", "a.bmp", "x.MOV"] {
            let said = named(name.as_ref()).unwrap_err();
            let said = said.line().unwrap_or_default();
            assert!(said.contains(name) && said.contains(".png, .tif"), "{name}: {said}");
        }
    }

    #[test]
    fn a_file_that_nobody_named_goes_beside_another() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("compare.png");
        assert_eq!(free_name(&file), file);
        std::fs::write(&file, "").unwrap();
        std::fs::write(dir.path().join("compare-2.png"), "").unwrap();
        assert_eq!(free_name(&file), dir.path().join("compare-3.png"));
    }

    #[test]
    fn every_format_fits_its_own_ending() {
        use clap::ValueEnum;
        for format in Format::value_variants() {
            assert!(format.fits(format.extension()), "{format:?}");
            let word = format.to_possible_value().unwrap();
            assert_eq!(word.get_name(), format.name());
            assert_eq!(serde_json::to_string(format).unwrap(), format!("\"{}\"", format.name()));
        }
    }
}
