//! Files as people have them, through the real program: `info` and `render` take each as it is,
//! and get the same voxels as from its twin. They are not part of the repository; where their
//! folder is missing the test says so and passes.

use crate::program::{good, run, text};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::{Path, PathBuf};

fn data() -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    match folder.canonicalize() {
        Ok(folder) => Some(folder),
        Err(_) => {
            // A direct write: the test harness captures only what the macros print.
            let _ = writeln!(std::io::stderr(), "skipped: needs shared/data (formats)");
            None
        }
    }
}

/// Returns the JSON that `slabcast info --json` prints.
fn info(dir: &Path, file: &Path, more: &[&str]) -> serde_json::Value {
    let file = file.to_string_lossy();
    let out = good(dir, &[&["info", &file, "--json"], more].concat());
    serde_json::from_str(&out).expect("it is JSON")
}

/// The hash of one small picture of a file.
fn picture(dir: &Path, file: &Path, out: &str) -> String {
    let (file, out) = (file.to_string_lossy(), &format!("{out}/"));
    let args =
        ["render", &file, "--size", "48x48", "--frames", "1", "-q", "-o", out, "--stats", "-"];
    let line = good(dir, &args);
    let stats: serde_json::Value = serde_json::from_str(&line).expect("one line of JSON");
    stats["pixels_sha256"].as_str().expect("a hash").to_string()
}

#[test]
fn every_format_opens_with_the_voxels_of_its_twin() {
    let Some(data) = data() else { return };
    let dir = tempfile::tempdir().unwrap();
    let mut twins = BTreeMap::new();
    // Each file, its twin, and whether it says where its axes point.
    for (file, twin, anatomical) in [
        ("nrrd/engine_detached_gzip.nhdr", "engine", false),
        ("nrrd/engine_256x256x128_uint8.raw.gz", "engine", false),
        ("nrrd/tooth_attached_raw.nrrd", "tooth", true),
        ("nrrd/A_J_attached_gzip.nrrd", "mouse_skull", true),
        ("metaimage/stent_int16.mhd", "stent", true),
        ("metaimage/stent_int16.raw", "stent", true),
        ("metaimage/stent_int16_z.mhd", "stent", true),
        ("metaimage/stent_int16_z.zraw", "stent", true),
        ("metaimage/LIDC2.mha", "lidc2", true),
        ("nifti/CT_AVM.nii.gz", "ct_avm", true),
        ("nifti/chris_t1.nii.gz", "chris_t1", true),
        ("raw/aneurism_256x256x256_uint8.raw", "aneurism", false),
        ("vti/aneurism.vti", "aneurism", false),
    ] {
        let path = data.join("formats").join(file);
        let twin = data.join(format!("{twin}.nrrd"));
        let a = info(dir.path(), &path, &[]);
        let b = twins.entry(twin.clone()).or_insert_with(|| info(dir.path(), &twin, &[]));
        for field in ["dims", "stored_as", "file_type"] {
            assert_eq!(a[field], b[field], "{file}: {field}");
        }
        assert_eq!(a["values"]["histogram"], b["values"]["histogram"], "{file}");
        assert_eq!(a["anatomical"], anatomical, "{file}");
        let hash = picture(dir.path(), &path, &format!("out/{file}"));
        if a["digest"] == b["digest"] {
            let of_twin = picture(dir.path(), &twin, &format!("twin/{file}"));
            assert_eq!(hash, of_twin, "{file}");
        }
    }
}

#[test]
fn dicom_folder_and_single_slice_open_the_series() {
    let Some(data) = data() else { return };
    let dir = tempfile::tempdir().unwrap();
    let folder = data.join("formats/dicom");
    let series = info(dir.path(), &folder, &[]);
    assert_eq!(series["dims"], serde_json::json!([512, 512, 32]));
    assert_eq!(series["anatomical"], true);
    let spacing = series["spacing"].as_array().unwrap();
    for (got, want) in spacing.iter().zip([0.41, 0.41, 1.5]) {
        assert!((got.as_f64().unwrap() - want).abs() < 0.005, "{got}");
    }
    let slice = folder.join("1-041.dcm");
    assert_eq!(info(dir.path(), &slice, &[])["digest"], series["digest"]);
    let out = run(dir.path(), &["info", &slice.to_string_lossy()]);
    assert!(text(&out.stderr).contains("1-041.dcm is one of 32 slices"), "{}", text(&out.stderr));
    picture(dir.path(), &folder, "out");
}

/// A file's voxels, values and place, whatever it is called.
#[test]
fn convert_keeps_voxels_values_and_orientation() {
    let dir = tempfile::tempdir().unwrap();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../samples/mni152_t1.nii.gz");
    let sample = sample.to_string_lossy();
    let want = info(dir.path(), Path::new(&*sample), &[])["digest"].clone();
    let mut from = sample.to_string();
    for name in ["a.nrrd", "b.nii", "c.nii.gz"] {
        let said = good(dir.path(), &["convert", &from, name]);
        assert!(said.starts_with(&format!("{name}: ")), "{said}");
        assert_eq!(info(dir.path(), Path::new(name), &[])["digest"], want, "{name}");
        from = name.to_string();
    }
    good(dir.path(), &["convert", "a.nrrd", "b.nii", "--force", "-q"]);
    assert_eq!(
        crate::program::names(dir.path()),
        ["a.nrrd", "b.nii", "c.nii.gz"],
        "nothing else is left"
    );
    // Raw numbers, told by flags.
    std::fs::write(dir.path().join("r.bin"), [0, 1, 0, 2, 0, 3, 1, 0, 2, 0, 3, 0]).unwrap();
    let flags = ["--dims", "3x2x1", "--type", "int16", "--byte-order", "big", "--spacing", "1x2x3"];
    good(dir.path(), &[&["convert", "r.bin", "r.nrrd"][..], &flags].concat());
    let (a, b) =
        (info(dir.path(), Path::new("r.bin"), &flags), info(dir.path(), Path::new("r.nrrd"), &[]));
    assert_eq!((&a["digest"], &a["values"]["max"]), (&b["digest"], &serde_json::json!(768.0)));
}

/// OME-Zarr has all levels, and level 0 is the file.
#[test]
fn convert_writes_a_pyramid_whose_finest_level_is_the_volume() {
    let dir = tempfile::tempdir().unwrap();
    let sample = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../samples/mni152_t1.nii.gz");
    let sample = sample.to_string_lossy();
    let want = info(dir.path(), Path::new(&*sample), &[]);
    let said = good(dir.path(), &["convert", &sample, "x.ome.zarr"]);
    assert!(said.starts_with("x.ome.zarr: ") && said.contains(" levels"), "{said}");
    let found = info(dir.path(), Path::new("x.ome.zarr"), &[]);
    for key in ["digest", "file_type", "anatomical", "steps", "origin", "values"] {
        assert_eq!(found[key], want[key], "{key}");
    }
    assert_eq!(found["levels"][0]["dims"], want["dims"]);
    let text = good(dir.path(), &["info", "x.ome.zarr"]);
    assert!(text.contains("levels       0: ") && text.contains(" 1: "), "{text}");
    let again = run(dir.path(), &["convert", &sample, "x.ome.zarr"]);
    assert_eq!(again.status.code(), Some(1));
    good(dir.path(), &["convert", &sample, "x.ome.zarr", "--force", "-q"]);
    assert_eq!(crate::program::names(dir.path()), ["x.ome.zarr"], "nothing else is left");
}

/// By way of the hidden command, whose process confines itself.
#[test]
fn hdf5_is_read_by_a_process_of_its_own() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("cells.ims");
    std::fs::write(&file, include_bytes!("../../../../master/volumes/src/hdf5/samples/cells.ims"))
        .unwrap();
    let most = |more: &[&str]| info(dir.path(), &file, more)["values"]["max"].clone();
    assert_eq!(most(&[]), serde_json::json!(520.0));
    assert_eq!(most(&["--time", "1", "--channel", "1"]), serde_json::json!(3520.0));
    let path = "/DataSet/ResolutionLevel 0/TimePoint 1/Channel 0/Data";
    assert_eq!(most(&["--dataset", path]), serde_json::json!(1520.0));
    assert_eq!(most(&["--spacing", "1x2x0.5"]), serde_json::json!(520.0));
    // A file that ends early, and the process with it.
    std::fs::write(&file, &std::fs::read(&file).unwrap()[..3000]).unwrap();
    let out = run(dir.path(), &["info", &file.to_string_lossy()]);
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stderr).contains("cells.ims: "), "{}", text(&out.stderr));
}

#[test]
fn dataset_flag_takes_one_of_several_arrays() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("two.vtk");
    let array = |name: &str, from: u32| {
        let numbers: Vec<String> = (from..from + 8).map(|n| n.to_string()).collect();
        format!("SCALARS {name} short\nLOOKUP_TABLE default\n{}\n", numbers.join(" "))
    };
    let head = "# vtk DataFile Version 3.0\ntwo arrays\nASCII\nDATASET STRUCTURED_POINTS\n\
                DIMENSIONS 2 2 2\nORIGIN 0 0 0\nSPACING 1 1 1\nPOINT_DATA 8\n";
    std::fs::write(&file, [head, &array("a", 0), &array("b", 100)].concat()).unwrap();
    let most = |more: &[&str]| info(dir.path(), &file, more)["values"]["max"].clone();
    assert_eq!(most(&[]), serde_json::json!(7.0));
    assert_eq!(most(&["--dataset", "b"]), serde_json::json!(107.0));
    let out = run(dir.path(), &["info", &file.to_string_lossy(), "--dataset", "c"]);
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("--dataset: there is no `c`") && said.contains("`a`, `b`"), "{said}");
}
