//! Formats that are told by their first bytes, plain or inside gzip, and read from front to back.

use crate::error::Problem;
use crate::source::Source;
use crate::{Hints, RawHints, mgh, mrc, nifti, npy, vtk};
use slabcast_common::volume::Volume;
use std::path::Path;

/// A format.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Format {
    Numpy,
    NumpyArchive,
    /// A header of NIfTI or ANALYZE, whose samples lie in a second file.
    Pair,
    FreeSurfer,
    Mrc,
    LegacyVtk,
}

impl Format {
    /// Returns the format of a file with these first bytes, which come from inside gzip if `gzip`.
    pub(crate) fn of(start: &[u8], gzip: bool) -> Option<Format> {
        let formats = [
            (Format::Numpy, start.starts_with(npy::MAGIC)),
            (Format::NumpyArchive, !gzip && start.starts_with(npy::ZIP)),
            (Format::Pair, nifti::pair::sniff(start)),
            (Format::LegacyVtk, vtk::sniff(start)),
            (Format::Mrc, mrc::sniff(start)),
            (Format::FreeSurfer, mgh::sniff(start)),
        ];
        formats.into_iter().find_map(|(format, is)| is.then_some(format))
    }

    /// Reads a file from its start. `folder` is where the second file of a pair lies.
    pub(crate) fn read(
        self,
        source: Source,
        gzip: bool,
        folder: &Path,
        name: &str,
        hints: &Hints,
    ) -> Result<Volume, Problem> {
        let dataset = hints.dataset.as_deref();
        // NumPy alone keeps no spacing.
        let numpy = matches!(self, Format::Numpy | Format::NumpyArchive);
        let spacing = RawHints { spacing: hints.raw.spacing, ..RawHints::default() };
        if !(hints.raw.is_empty() || numpy && hints.raw == spacing) {
            return Err(Problem::malformed(
                "--type, --spacing, --skip, --byte-order",
                "are for raw numbers, and this file has a header that says all that",
                "leave them out",
            ));
        }
        match self {
            Format::Numpy => npy::read(source, gzip, name, &hints.raw),
            Format::NumpyArchive => npy::read_archive(source, name, &hints.raw, dataset),
            Format::Pair => nifti::pair::read(source, gzip, folder, name),
            Format::FreeSurfer => mgh::read(source, gzip, name),
            Format::Mrc => mrc::read(source, gzip, name),
            Format::LegacyVtk => vtk::read(source, gzip, name, dataset),
        }
    }
}
