//! Formats that are recognised by their first bytes, plain or inside gzip, and read from front to
//! back.

use crate::error::Problem;
use crate::reads::{self, ReadFormat};
use crate::source::Source;
use crate::{Hints, mgh, mrc, nifti, npy, vtk};
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

    /// Returns the format's entry in the list of all.
    fn listed(self) -> &'static ReadFormat {
        match self {
            Format::Numpy => reads::NUMPY,
            Format::NumpyArchive => reads::NUMPY_ARCHIVE,
            Format::Pair => reads::PAIR,
            Format::FreeSurfer => reads::FREESURFER,
            Format::Mrc => reads::MRC,
            Format::LegacyVtk => reads::LEGACY_VTK,
        }
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
        hints.check_flags(self.listed())?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::RawHints;

    fn open(bytes: Vec<u8>, hints: &Hints) -> Result<Volume, String> {
        let source = Source::from_bytes(bytes);
        crate::read(source, Path::new("."), "a", hints).map_err(|e| e.to_string())
    }

    #[test]
    fn flag_for_other_files_is_refused_and_spacing_of_numpy_is_taken() {
        let dataset = Hints { dataset: Some("a".into()), ..Hints::default() };
        let nifti = nifti::tests::nifti1(false, 2, [4, 3, 2], nifti::tests::Affine::Sform);
        let numpy = npy::tests::npy(1, "<u2", false, "(2, 3, 4)");
        for bytes in [numpy.clone(), mgh::tests::mgh(0, true), nifti] {
            let e = open(bytes, &dataset).unwrap_err();
            assert!(
                e.contains("--dataset: is for .npz, .vti, .vtk, .h5, .hdf5, .ims, and this is"),
                "{e}"
            );
        }
        let raw = RawHints { spacing: Some([1.0, 2.0, 3.0]), ..RawHints::default() };
        let spaced = Hints { raw, ..Hints::default() };
        assert_eq!(open(numpy.clone(), &spaced).unwrap().lattice.spacing(), [1.0, 2.0, 3.0]);
        let e = open(mgh::tests::mgh(0, true), &spaced).unwrap_err();
        assert!(e.contains("--spacing") && e.contains("leave them out"), "{e}");
        let typed = Hints { raw: raw.with_type("int8").unwrap(), ..Hints::default() };
        let e = open(numpy, &typed).unwrap_err();
        assert!(e.contains("--type") && e.contains("leave them out"), "{e}");
    }
}
