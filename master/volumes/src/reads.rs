//! The formats that are read: one list, from which messages, help texts and documents have theirs.
//!
//! Tests compare the crate's documentation, the table of docs/reference/files.md and the help of
//! `--series` and `--dataset` with it. A format that is added here and not there fails them.

use crate::error::Problem;
use crate::{Hints, RawHints};

/// A flag that some formats take and others have no use for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flag {
    /// `--series`: one of several DICOM series.
    Series,
    /// `--dataset`: one of several arrays.
    Dataset,
    /// `--spacing`: the distances of samples.
    Spacing,
    /// `--dims`, `--type`, `--byte-order` and `--skip`: what a header would say.
    Raw,
}

impl Flag {
    /// Flags that name a part of a file.
    const PARTS: [Flag; 2] = [Flag::Series, Flag::Dataset];

    /// Returns the flag as users type it.
    pub fn name(self) -> &'static str {
        match self {
            Flag::Series => "--series",
            Flag::Dataset => "--dataset",
            Flag::Spacing => "--spacing",
            Flag::Raw => "--type, --skip, --byte-order",
        }
    }

    /// Returns whether hints have the flag.
    fn is_given(self, hints: &Hints) -> bool {
        match self {
            Flag::Series => hints.series.is_some(),
            Flag::Dataset => hints.dataset.is_some(),
            Flag::Spacing => hints.raw.spacing.is_some(),
            Flag::Raw => {
                let spacing = RawHints { spacing: hints.raw.spacing, ..RawHints::default() };
                hints.raw != spacing
            }
        }
    }
}

/// A format that is read.
#[derive(Debug)]
pub struct ReadFormat {
    /// Name of the format, for messages.
    pub name: &'static str,
    /// Endings of its files, in lower case; none if it is a folder.
    pub endings: &'static [&'static str],
    /// Name of the format in the documents' tables.
    pub documented: &'static str,
    /// Flags that it takes.
    pub flags: &'static [Flag],
    /// Whether messages name the endings, too: few people know them by the format.
    named: bool,
}

const fn read(
    name: &'static str,
    endings: &'static [&'static str],
    flags: &'static [Flag],
) -> ReadFormat {
    ReadFormat { name, endings, documented: name, flags, named: false }
}

pub(crate) const NRRD: &ReadFormat = &read("NRRD", &[".nrrd", ".nhdr"], &[]);
pub(crate) const METAIMAGE: &ReadFormat = &read("MetaImage", &[".mha", ".mhd"], &[]);
pub(crate) const NIFTI: &ReadFormat = &read("NIfTI", &[".nii", ".nii.gz"], &[]);
pub(crate) const PAIR: &ReadFormat =
    &ReadFormat { documented: "pairs", ..read("ANALYZE", &[".hdr", ".hdr.gz"], &[]) };
pub(crate) const FREESURFER: &ReadFormat =
    &ReadFormat { named: true, ..read("FreeSurfer", &[".mgh", ".mgz"], &[]) };
pub(crate) const MRC: &ReadFormat = &ReadFormat {
    named: true,
    ..read("MRC", &[".mrc", ".map", ".ccp4", ".rec", ".st", ".mrc.gz", ".map.gz"], &[])
};
pub(crate) const NUMPY: &ReadFormat =
    &ReadFormat { named: true, ..read("NumPy", &[".npy", ".npy.gz"], &[Flag::Spacing]) };
pub(crate) const NUMPY_ARCHIVE: &ReadFormat = &ReadFormat {
    documented: "NumPy",
    named: true,
    ..read("NumPy archives", &[".npz"], &[Flag::Spacing, Flag::Dataset])
};
pub(crate) const VTI: &ReadFormat = &ReadFormat {
    documented: "VTK",
    named: true,
    ..read("VTK image data", &[".vti"], &[Flag::Dataset])
};
pub(crate) const LEGACY_VTK: &ReadFormat = &ReadFormat {
    documented: "legacy VTK",
    named: true,
    ..read("legacy VTK", &[".vtk", ".vtk.gz"], &[Flag::Dataset])
};
pub(crate) const HDF5: &ReadFormat = &ReadFormat {
    named: true,
    ..read(
        "HDF5",
        &[".h5", ".hdf5", ".ims", ".mnc", ".nc", ".vtkhdf"],
        &[Flag::Spacing, Flag::Dataset],
    )
};
pub(crate) const TIFF: &ReadFormat = &read("TIFF", &[".tif", ".tiff"], &[Flag::Spacing]);
pub(crate) const PICTURES: &ReadFormat = &ReadFormat {
    documented: "PNG, JPEG",
    ..read("a folder of PNG or JPEG pictures", &[], &[Flag::Spacing])
};
pub(crate) const DICOM: &ReadFormat =
    &ReadFormat { documented: "DICOM", ..read("DICOM slices", &[".dcm", ".ima"], &[Flag::Series]) };
pub(crate) const ZARR: &ReadFormat = &read("Zarr", &[], &[Flag::Spacing]);
pub(crate) const OME_ZARR: &ReadFormat =
    &ReadFormat { documented: "OME-Zarr", ..read("OME-Zarr", &[], &[]) };
pub(crate) const RAW: &ReadFormat = &ReadFormat {
    documented: "raw numbers",
    ..read("raw numbers with --dims and --type", &[".raw", ".raw.gz"], &[Flag::Spacing, Flag::Raw])
};
pub(crate) const FORMULA: &ReadFormat =
    &ReadFormat { documented: "by formula", ..read("formula:NAME", &[], &[]) };

/// All formats that are read, in the order of messages.
pub const FORMATS: [&ReadFormat; 18] = [
    NRRD,
    METAIMAGE,
    NIFTI,
    PAIR,
    FREESURFER,
    MRC,
    NUMPY,
    NUMPY_ARCHIVE,
    VTI,
    LEGACY_VTK,
    HDF5,
    TIFF,
    PICTURES,
    DICOM,
    ZARR,
    OME_ZARR,
    RAW,
    FORMULA,
];

/// Returns the formats as the remedy of an error names them.
pub(crate) fn remedy() -> String {
    let name = |format: &&ReadFormat| match format.named {
        true => format!("{} ({})", format.name, shortest(format).join(", ")),
        false => format.name.to_string(),
    };
    let names: Vec<String> = FORMATS.iter().map(name).collect();
    let (last, others) = names.split_last().expect("there are formats");
    format!("give {} or {last}", others.join(", "))
}

/// Endings of headers whose samples lie in another file.
pub const DETACHED_HEADERS: [&str; 3] = [".mhd", ".nhdr", ".hdr"];

/// Returns a format's endings without those that only lengthen another, such as `.vtk.gz`.
fn shortest(format: &ReadFormat) -> Vec<&'static str> {
    format.endings.iter().filter(|e| !e.ends_with(".gz")).take(3).copied().collect()
}

/// Returns the formats that take a flag, as a list of endings and names: `.npz, .vti, .vtk`.
pub fn takers(flag: Flag) -> String {
    let takes = FORMATS.iter().filter(|f| f.flags.contains(&flag));
    let names = takes.flat_map(|f| match shortest(f) {
        endings if endings.is_empty() || flag == Flag::Series => vec![f.name],
        endings => endings,
    });
    names.collect::<Vec<_>>().join(", ")
}

/// Returns the endings, in lower case, of files that are volumes without a flag: of headers, where
/// the numbers lie beside, and none of raw numbers.
pub fn endings() -> impl Iterator<Item = &'static str> {
    let with_header = FORMATS.iter().filter(|f| !f.flags.contains(&Flag::Raw));
    with_header.flat_map(|f| f.endings.iter().copied())
}

/// Returns whether a file's name has the ending of a volume or of raw numbers.
pub(crate) fn is_volume_name(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    endings().chain(RAW.endings.iter().copied()).any(|end| name.ends_with(end))
}

impl Hints {
    /// Refuses flags that a format has no use for, rather than to ignore them.
    pub(crate) fn check_flags(&self, format: &ReadFormat) -> Result<(), Problem> {
        let spare = |flag: &Flag| flag.is_given(self) && !format.flags.contains(flag);
        if let Some(&flag) = Flag::PARTS.iter().find(|f| spare(f)) {
            return Err(Problem::malformed(
                flag.name(),
                format!(
                    "is for {}, and this is {}",
                    takers(flag),
                    format.name.trim_end_matches(" with --dims and --type")
                ),
                "leave it out",
            ));
        }
        let field = match format.flags.contains(&Flag::Spacing) {
            true => Flag::Raw.name(),
            false => "--type, --spacing, --skip, --byte-order",
        };
        match [Flag::Raw, Flag::Spacing].iter().any(spare) {
            false => Ok(()),
            true => Err(Problem::malformed(
                field,
                format!("are for raw numbers, and this is {}, which says all that", format.name),
                "leave them out",
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn documents_list_the_formats_that_are_read_and_no_others() {
        let table = include_str!("../../../docs/reference/files.md");
        let table = table.split("## Volumes").nth(1).unwrap().split("\n\n").nth(1).unwrap();
        let rows: Vec<&str> = table.lines().skip(2).filter_map(|l| l.split('|').nth(1)).collect();
        for format in FORMATS {
            let row = rows.iter().find(|row| {
                let at = row.find(format.documented);
                at.is_some_and(|at| !row[..at].ends_with(char::is_alphabetic))
                    && format.endings.iter().all(|end| {
                        let plain = end.trim_end_matches(".gz");
                        row.contains(&format!("`{end}`")) || row.contains(&format!("`{plain}`"))
                    })
            });
            assert!(row.is_some(), "files.md has no row for {format:?}");
        }
        for row in &rows {
            let known = FORMATS.iter().any(|f| row.contains(f.documented));
            assert!(known, "files.md has a row that no format is of: {row}");
            for ending in row.split('`').filter(|word| word.starts_with('.')) {
                let known = FORMATS.iter().flat_map(|f| f.endings).any(|e| *e == ending);
                let extra = [".gz", ".img"].contains(&ending);
                assert!(known || extra, "{ending} of files.md is not in reads.rs");
            }
        }
    }

    #[test]
    fn crate_documentation_lists_the_formats_that_are_read() {
        let text = include_str!("lib.rs");
        let list = text.split("//! Formats read").nth(1).unwrap().split("//! [`write`]").next();
        let list = list.unwrap();
        for format in FORMATS {
            assert!(list.contains(format.documented), "lib.rs does not list {format:?}");
            for end in format.endings.iter().filter(|end| !end.ends_with(".gz")) {
                assert!(list.contains(&format!("`{end}`")), "lib.rs does not list {end}");
            }
        }
    }

    #[test]
    fn remedy_names_every_format() {
        let said = remedy();
        let want = "give NRRD, MetaImage, NIfTI, ANALYZE, FreeSurfer (.mgh, .mgz), MRC (.mrc, .map, \
                    .ccp4), NumPy (.npy), NumPy archives (.npz), VTK image data (.vti), legacy VTK \
                    (.vtk), HDF5 (.h5, .hdf5, .ims), TIFF, a folder of PNG or JPEG pictures, DICOM slices, Zarr, OME-Zarr, \
                    raw numbers with --dims and --type or formula:NAME";
        assert_eq!(said, want);
        assert_eq!(takers(Flag::Dataset), ".npz, .vti, .vtk, .h5, .hdf5, .ims");
        assert_eq!(takers(Flag::Series), "DICOM slices");
        for name in ["a.NII.gz", "b.mgz", "c.tif", "x.raw"] {
            assert!(is_volume_name(name), "{name}");
        }
        assert!(!is_volume_name("a.txt"));
    }

    #[test]
    fn flag_that_a_format_has_no_use_for_is_refused_by_every_format() {
        let series = Hints { series: Some("1".into()), ..Hints::default() };
        let dataset = Hints { dataset: Some("a".into()), ..Hints::default() };
        for format in FORMATS {
            for (flag, hints) in [(Flag::Series, &series), (Flag::Dataset, &dataset)] {
                let takes = format.flags.contains(&flag);
                assert_eq!(hints.check_flags(format).is_ok(), takes, "{flag:?} {format:?}");
            }
        }
        let e = crate::open_with("formula:spheres:8".as_ref(), &series).unwrap_err().to_string();
        assert!(e.contains("--series: is for DICOM slices, and this is formula:NAME"), "{e}");
        let e = dataset.check_flags(NRRD).unwrap_err().to_string();
        assert!(
            e.contains("--dataset: is for .npz, .vti, .vtk, .h5, .hdf5, .ims, and this is NRRD"),
            "{e}"
        );
    }
}
