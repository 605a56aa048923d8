//! Files that were read wrongly or refused without need. The small ones are built beside their
//! readers; these are whole files of other writers, outside the repository. Where they are missing,
//! a test prints `skipped: needs shared/faults` and passes.

use slabcast_volumes::{Hints, OpenError, Opened, open_with};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Returns the path of a file of the faults; `None`, with a line on stderr, if it is missing.
fn fault(file: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/faults").join(file);
    if !path.exists() {
        // A direct write: the test harness captures only what the macros print.
        let _ = writeln!(std::io::stderr(), "skipped: needs shared/faults ({file})");
        return None;
    }
    Some(path)
}

fn open(path: &Path) -> Result<Opened, OpenError> {
    open_with(path, &Hints::default())
}

#[test]
fn padding_after_gzip_is_no_fault_and_garbage_is_named() {
    for (file, notes, say) in [
        ("zeros.nii.gz", 1, ""),
        ("zeros.nrrd", 1, ""),
        ("garbage.nii.gz", 0, "`xx` follows"),
        ("no_trailer.nii.gz", 0, "ends before its checksum"),
    ] {
        let Some(path) = fault(&format!("16-gzip-trailing/{file}")) else { return };
        match open(&path) {
            Ok(opened) => assert!(say.is_empty() && opened.notes.len() == notes, "{file}"),
            Err(e) => assert!(!say.is_empty() && e.to_string().contains(say), "{file}: {e}"),
        }
    }
}

#[cfg(feature = "dicom")]
#[test]
fn dicom_series_are_not_refused_without_need() {
    for (folder, slices, notes) in [
        ("15-dicom-needless-refusals/bits_11_12", 3, 1),
        ("15-dicom-needless-refusals/signed_mixed", 3, 1),
        ("15-dicom-needless-refusals/frames_01", 3, 0),
        ("15-dicom-needless-refusals/thickness_5_mm", 3, 0),
        ("files/dicom_be_ow8", 3, 0),
        ("files/dicom_padded", 1, 1),
    ] {
        let Some(path) = fault(folder) else { return };
        let opened = open(&path).unwrap_or_else(|e| panic!("{e}"));
        assert_eq!(opened.volume.lattice.dims[2], slices, "{folder}");
        assert!(opened.notes.len() >= notes, "{folder}: {:?}", opened.notes);
    }
    let Some(path) = fault("files/dicom_be_ow8") else { return };
    let v = open(&path).unwrap().volume;
    let first: Vec<f64> = (0..6).map(|i| v.summary.map.value(v.samples.code(i))).collect();
    assert_eq!(first, [3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
}

#[test]
fn nrrd_and_metaimage_axes_are_those_of_space() {
    let Some(path) = fault("11-nrrd-vector-axis-as-x/rgb_2d.nrrd") else { return };
    let e = open(&path).unwrap_err().to_string();
    assert!(e.contains("is no axis of space") && e.contains("a 2-D picture of 20 x 24"), "{e}");
    // Three bytes a voxel are colours.
    let Some(path) = fault("11-nrrd-vector-axis-as-x/list_one_slice.nrrd") else { return };
    let opened = open(&path).unwrap_or_else(|e| panic!("{e}"));
    assert_eq!(opened.volume.lattice.dims, [20, 24, 1]);
    assert!(opened.volume.places.is_some());
    assert!(opened.notes.iter().any(|note| note.contains("2-D picture")), "{:?}", opened.notes);
    for (file, origin) in [
        ("no_matrix.mha", Some([31.5, -12.25, 107.75])),
        ("itk_4d_one.mha", Some([-31.5, 12.25, 107.75])),
        ("itk_4d_one.nrrd", None),
        ("comment.mhd", None),
    ] {
        let Some(path) = fault(&format!("files/{file}")) else { return };
        let v = open(&path).unwrap_or_else(|e| panic!("{e}")).volume;
        assert_eq!(v.lattice.dims, [7, 5, 3], "{file}");
        if let Some(origin) = origin {
            assert_eq!((v.lattice.origin.to_array(), v.anatomical), (origin, true), "{file}");
        }
    }
}
