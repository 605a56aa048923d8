//! Files made after public reports of faults, in shared/faults; where they are missing, the test
//! prints `skipped: needs shared/faults` and passes.

use slabcast_volumes::{Hints, OpenError, Opened, open_with};
use std::io::Write;
use std::path::Path;

/// Opens a file of the folder of faults; `None`, with a line on stderr, if the folder is missing.
fn fault(file: &str) -> Option<Opened> {
    Some(result(file)?.unwrap_or_else(|e| panic!("{e}")))
}

fn result(file: &str) -> Option<Result<Opened, OpenError>> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/faults");
    if !folder.is_dir() {
        // A direct write: the test harness captures only what the macros print.
        let _ = writeln!(std::io::stderr(), "skipped: needs shared/faults ({file})");
        return None;
    }
    Some(open_with(&folder.join(file), &Hints::default()))
}

fn first_values(opened: &Opened, count: usize) -> Vec<f64> {
    let v = &opened.volume;
    (0..count).map(|i| v.summary.map.value(v.samples.code(i))).collect()
}

#[test]
fn faults_of_tiff_have_one_channel_the_right_step_and_stored_values() {
    for (file, dims, note) in [
        ("06-tiff-channels-stacked/shaped_CZYX.tif", [12, 10, 6], "the first of 2 channels"),
        ("06-tiff-channels-stacked/shaped_TZYX.tif", [12, 10, 6], "the first of 2 times"),
        ("06-tiff-channels-stacked/ome_prefix.tif", [12, 10, 6], "the first of 2 channels"),
        ("06-tiff-channels-stacked/single_quotes.tif", [12, 10, 6], "the first of 2 channels"),
        ("06-tiff-channels-stacked/truncated_6_planes.tif", [12, 10, 6], ""),
        ("04-ome-z-step-1mm/no_PhysicalSizeZ.ome.tif", [32; 3], "not say the step along z"),
        ("04-ome-z-step-1mm/z_in_dm.ome.tif", [32; 3], ""),
        ("files/miniswhite_u1.tif", [7, 5, 3], "0 is white"),
        ("files/palette.tif", [7, 5, 3], "indices"),
    ] {
        let Some(opened) = fault(file) else { return };
        assert_eq!(opened.volume.lattice.dims, dims, "{file}");
        let notes = opened.notes.join("\n");
        assert!(notes.contains(note) && notes.is_empty() == note.is_empty(), "{file}: {notes}");
        if file.starts_with("04") {
            let spacing = opened.volume.lattice.spacing();
            assert!(spacing.iter().all(|s| (s / 0.5e-3 - 1.0).abs() < 1e-9), "{spacing:?}");
        }
        if file.starts_with("files") {
            assert_eq!(first_values(&opened, 6), [3.0, 4.0, 5.0, 6.0, 7.0, 8.0], "{file}");
        }
    }
}

#[test]
fn tiles_in_lzw_that_the_decoder_stops_in_are_not_called_truncated() {
    let Some(opened) = result("files/tiled_lzw.tif") else { return };
    let e = opened.expect_err("the tiff crate's issue 395").to_string();
    assert!(e.contains("is LZW in tiles") && e.contains("save it with deflate"), "{e}");
}

#[cfg(feature = "zarr")]
#[test]
fn faults_of_zarr_have_their_axes_steps_and_values() {
    for (file, dims, spacing, note) in [
        ("04-ome-z-step-1mm/z_without_unit.zarr", [32; 3], 0.5e-3, "z has no unit"),
        ("04-ome-z-step-1mm/flat_yx.zarr", [32, 32, 1], 0.5e-3, "not say the step along z"),
        ("13-zarr-dimension-names/xyz.zarr", [12, 10, 6], 1.0, ""),
        ("13-zarr-dimension-names/zyxc.zarr", [12, 10, 6], 1.0, "the first of 2 along `c`"),
        ("files/bitshuffle.zarr", [9, 7, 5], 1.0, ""),
    ] {
        let Some(opened) = fault(file) else { return };
        assert_eq!(opened.volume.lattice.dims, dims, "{file}");
        let got = opened.volume.lattice.spacing();
        assert!(got.iter().all(|s| (s / spacing - 1.0).abs() < 1e-9), "{file}: {got:?}");
        let notes = opened.notes.join("\n");
        assert!(notes.contains(note) && notes.is_empty() == note.is_empty(), "{file}: {notes}");
        if file.contains("bitshuffle") {
            let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/faults/files");
            let npy = std::fs::read(folder.join("bitshuffle.expected.npy")).expect("the values");
            let want: Vec<f64> = npy[npy.len() - 315..].iter().map(|b| f64::from(*b)).collect();
            assert_eq!(first_values(&opened, 315), want);
        }
    }
}
