//! Files made after public reports of faults, in shared/faults; where they are missing, the test
//! prints `skipped: needs shared/faults` and passes.

use slabcast_volumes::write::{self, Format};
use slabcast_volumes::{Hints, OpenError, Opened, open_numbers, open_with};
use std::collections::BTreeSet;
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

#[test]
fn labels_and_doubles_are_converted_to_the_bit() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/faults");
    for (file, size) in [
        ("02-convert-changes-labels/allen_like_u32.nrrd", 4),
        ("02-convert-changes-labels/labels_i32_70001.nrrd", 4),
        ("02-convert-changes-labels/ids_i64.nrrd", 8),
        ("files/wide_i4.nrrd", 4),
        ("files/wide_f8.nrrd", 8),
    ] {
        let Some(drawn) = fault(file) else { return };
        assert!(drawn.notes.join("\n").contains("drawn rounded"), "{file}: {:?}", drawn.notes);
        let (opened, numbers) = open_numbers(&folder.join(file), &Hints::default()).unwrap();
        let write = |format| {
            let mut bytes = Vec::new();
            let (volume, numbers) = (&opened.volume, numbers.as_ref());
            write::write(volume, numbers, format, &mut bytes, &mut |_| Ok(())).unwrap();
            bytes.split_off(bytes.len() - size * volume.samples.len())
        };
        let nrrd = write(Format::Nrrd { gzip: false });
        assert_eq!(nrrd, write(Format::Nifti { gzip: false }), "{file}");
        let first =
            |n: usize| nrrd[..n * size].chunks(size).map(<[u8]>::to_vec).collect::<Vec<_>>();
        if file.contains("allen") {
            let ids: BTreeSet<u32> = first(opened.volume.samples.len())
                .iter()
                .map(|b| u32::from_le_bytes(b[..].try_into().unwrap()))
                .collect();
            let want = [0, 1, 7, 997, 312_782_574, 312_782_575, 312_782_576, 614_454_277];
            assert_eq!(ids.into_iter().collect::<Vec<_>>(), want);
        }
        if file.contains("wide_i4") {
            let want = [-2_147_483_648, -2_106_185_886, -2_064_888_124, -2_023_590_361i32];
            assert_eq!(first(4), want.map(|n| n.to_le_bytes().to_vec()));
        }
        if file.contains("wide_f8") {
            let want = [-1e6, -701_922.953466288, -403_845.906_932_575_86f64];
            assert_eq!(first(3), want.map(|n| n.to_le_bytes().to_vec()));
        }
    }
}

#[test]
fn blanked_points_of_vti_have_no_value_and_masks_are_never_the_volume() {
    for (file, blanked) in [
        ("resampled_ball.vti", true),
        ("vtkGhostType_first.vti", true),
        ("vtkValidPointMask_first.vti", false),
    ] {
        let Some(opened) = fault(&format!("09-vti-blanked-and-ghost/{file}")) else { return };
        let summary = &opened.volume.summary;
        let notes = opened.notes.join("\n");
        assert_eq!(summary.nan > 0, blanked, "{file}: {notes}");
        assert_eq!(notes.contains("are blanked by `vtk"), blanked, "{file}: {notes}");
        if file.contains("first") {
            let (lo, hi) = summary.range();
            assert!(lo < 2.0 && hi > 60.0, "{file}: {lo} to {hi}");
        }
    }
}
