//! Tests with real files. All but the sample are outside the repository, since their licences
//! differ; where they are missing, a test prints `skipped: needs shared/data` and passes.

use glam::DVec3;
use slabcast_common::quality::Quality;
use slabcast_common::shade::encode_normal;
use slabcast_common::volume::Volume;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::presets;
use slabcast_volumes::{BrickStore, OpenErrorKind, open};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Returns the path of a file of the data folder; `None`, with a line on stderr, if it is missing.
fn data(file: &str) -> Option<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    if !folder.is_dir() {
        // A direct write: the test harness captures only what the macros print.
        let _ = writeln!(std::io::stderr(), "skipped: needs shared/data ({file})");
        return None;
    }
    Some(folder.join(file))
}

fn volume(path: &Path) -> Volume {
    open(path).unwrap_or_else(|e| panic!("{e}"))
}

/// Compares with size, type and spacing in the README beside the data.
#[test]
fn real_nrrd_files_open_with_documented_size_type_and_spacing() {
    for (file, dims, kind, spacing) in [
        ("mri256", [256, 256, 256], "uint8", [1.0; 3]),
        ("aneurism", [256, 256, 256], "uint8", [1.0; 3]),
        ("mouse_skull", [176, 320, 128], "uint8", [0.0706; 3]),
        ("engine", [256, 256, 128], "uint8", [1.0; 3]),
        ("bonsai", [256, 256, 256], "uint8", [1.0; 3]),
        ("heptane", [302, 302, 302], "uint8", [1.0; 3]),
        ("chris_t1", [188, 256, 190], "uint8", [0.88; 3]),
        ("t1_icbm", [180, 216, 180], "uint8", [1.0; 3]),
        ("iguana", [210, 256, 179], "uint8", [0.10; 3]),
        ("ct_avm", [256, 242, 154], "uint8", [0.72, 0.72, 1.0]),
        ("lidc2", [256, 256, 133], "uint8", [1.41, 1.41, 2.5]),
        ("stent", [128, 128, 256], "int16", [1.0; 3]),
        ("tooth", [103, 94, 161], "uint8", [1.0; 3]),
        ("large/lidc0314_ct", [512, 512, 275], "int16", [0.78, 0.78, 1.0]),
    ] {
        let Some(path) = data(&format!("{file}.nrrd")) else { return };
        let v = volume(&path);
        assert_eq!(v.lattice.dims, dims, "{file}");
        assert_eq!(v.file_type, kind, "{file}");
        for (got, want) in v.lattice.spacing().iter().zip(spacing) {
            assert!((got - want).abs() < 0.02 * want, "{file}: spacing {got}, not {want}");
        }
        assert!(!v.anatomical, "{file} has spacings alone");
        assert_eq!(v.summary.total(), v.lattice.len() as u64, "{file}");
    }
}

#[test]
fn real_nrrd_files_have_documented_shares_above_thresholds() {
    for (file, cuts) in [
        ("mri256", &[(15.0, 24.1), (40.0, 21.3), (95.0, 7.7)][..]),
        ("aneurism", &[(20.0, 0.73), (100.0, 0.42)]),
        ("stent", &[(150.0, 6.2), (600.0, 0.4)]),
        ("large/lidc0314_ct", &[(500.0, 34.3), (1200.0, 2.9)]),
    ] {
        let Some(path) = data(&format!("{file}.nrrd")) else { return };
        let v = volume(&path);
        for &(cut, percent) in cuts {
            let map = v.summary.map;
            let above =
                (0..v.samples.len()).filter(|&i| map.value(v.samples.code(i)) >= cut).count();
            let got = 100.0 * above as f64 / v.samples.len() as f64;
            assert!((got - percent).abs() < 0.06, "{file}: {got} % above {cut}, not {percent}");
        }
    }
}

#[test]
fn real_files_in_several_formats_are_equal() {
    let Some(path) = data("engine.nrrd") else { return };
    let twin = |file: &str| volume(&data(file).expect("the folder is there"));
    let engine = volume(&path);
    assert_eq!(engine.digest(), twin("formats/nrrd/engine_detached_gzip.nhdr").digest());
    assert_eq!(twin("tooth.nrrd").samples, twin("formats/nrrd/tooth_attached_raw.nrrd").samples);
    assert_eq!(twin("ct_avm.nrrd").samples, twin("formats/nifti/CT_AVM.nii.gz").samples);
    assert_eq!(twin("chris_t1.nrrd").samples, twin("formats/nifti/chris_t1.nii.gz").samples);
    let aneurism = twin("aneurism.nrrd");
    for file in ["raw/aneurism_256x256x256_uint8.raw", "vti/aneurism.vti"] {
        assert_eq!(twin(&format!("formats/{file}")).digest(), aneurism.digest(), "{file}");
    }
    let stent = twin("stent.nrrd").samples;
    for file in ["stent_int16.mhd", "stent_int16_z.mhd", "stent_int16.raw", "stent_int16_z.zraw"] {
        assert_eq!(twin(&format!("formats/metaimage/{file}")).samples, stent, "{file}");
    }
    let packed = twin("formats/nrrd/engine_256x256x128_uint8.raw.gz");
    assert_eq!(packed.digest(), engine.digest(), "size and type from its name, gzip inside");
    assert_eq!(twin("lidc2.nrrd").samples, twin("formats/metaimage/LIDC2.mha").samples);
}

#[test]
fn real_metaimage_directions_become_ras() {
    let Some(path) = data("formats/metaimage/LIDC2.mha") else { return };
    let v = volume(&path);
    assert!(v.anatomical);
    // Rows of its matrix: left, anterior (y down in LPS), inferior.
    let want = [DVec3::X * -1.40625, DVec3::Y * 1.40625, DVec3::Z * -2.5];
    for (got, want) in v.lattice.steps.iter().zip(want) {
        assert!((*got - want).length() < 1e-9, "{got} against {want}");
    }
    assert!((v.lattice.origin - DVec3::new(0.0, -360.0, 332.5)).length() < 1e-9);
}

#[test]
fn real_nrrd_of_slicer_in_lps_becomes_ras() {
    let Some(path) = data("formats/nrrd/A_J_attached_gzip.nrrd") else { return };
    let v = volume(&path);
    let plain = volume(&data("mouse_skull.nrrd").expect("the folder is there"));
    assert!(v.anatomical && !plain.anatomical);
    assert_eq!(v.samples, plain.samples);
    let s = 0.0705567002296448;
    assert_eq!(v.lattice.steps, [DVec3::X * s, DVec3::Y * s, DVec3::Z * s]);
    assert_eq!(
        v.lattice.origin,
        DVec3::new(3.0515799522399902, 2.6987900733947763, 3.2279698848724365)
    );
}

#[test]
fn real_nifti_files_have_origin_and_slope() {
    let Some(path) = data("formats/nifti/CT_AVM.nii.gz") else { return };
    let avm = volume(&path);
    assert!(avm.anatomical);
    assert!((avm.summary.map.scale - 2.20863).abs() < 1e-5);
    assert!((avm.lattice.origin - DVec3::new(-73.3977, -69.6942, -64.11)).length() < 1e-3);
    let chris = volume(&data("formats/nifti/chris_t1.nii.gz").expect("the folder is there"));
    assert!(chris.anatomical && chris.lattice.is_isotropic());
    assert_eq!(chris.summary.map.scale, 1.0);
}

#[test]
fn sample_volume_is_upright_and_not_mirrored() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../samples/mni152_t1.nii.gz");
    let v = volume(&path);
    assert_eq!((v.name.as_str(), v.file_type.as_str()), ("mni152_t1.nii.gz", "uint8"));
    assert_eq!(v.lattice.dims, [197, 233, 189]);
    assert!(v.anatomical, "it says where right, anterior and superior are");
    assert_eq!(v.lattice.steps, [DVec3::X, DVec3::Y, DVec3::Z]);
    assert_eq!(v.lattice.origin, DVec3::new(-98.0, -134.0, -72.0));
    // Its README says that 21.8 % of the samples are brain, from value 20 on.
    let brain = v.summary.histogram[20..].iter().sum::<u64>() as f64 / v.lattice.len() as f64;
    assert!((brain - 0.218).abs() < 1e-3, "{brain}");
    // In anatomy: the top of the brain (vertex) is at z of some 80 mm above the anterior
    // commissure, the frontal pole at y of 70, the occipital pole at -105.
    let inside = |x: f64, y: f64, z: f64| {
        let i = (DVec3::new(x, y, z) - v.lattice.origin).to_array().map(|c| c as usize);
        v.samples.code(i[0] + 197 * (i[1] + 233 * i[2])) >= 20.0
    };
    assert!(inside(20.0, -20.0, 70.0) && !inside(20.0, -20.0, -70.0), "upside down");
    assert!(inside(25.0, -95.0, 0.0) && !inside(25.0, 95.0, 0.0), "back to front");
}

/// Compares the normals of a real head with a plain loop, and prints the time of building.
#[test]
fn real_head_bricks_match_a_plain_loop() {
    let Some(path) = data("mri256.nrrd") else { return };
    let start = std::time::Instant::now();
    let v = volume(&path);
    let digest = v.digest();
    let tf = presets::by_name("peer-opaque", &v.summary).unwrap();
    let wanted = BrickNeeds::for_transfer(&tf, &v.info(digest), &Quality::before());
    let store = BrickStore::build(&v, digest, &wanted);
    println!("mri256: open, digest, build {:?}", start.elapsed());
    let m = v.gradient_matrix();
    let grid = slabcast_common::brick::BrickGrid::new(v.lattice.dims);
    for info in store.infos().iter().step_by(37) {
        let brick = store.brick(info.id).unwrap();
        let corner = grid.corner(info.id);
        for (n, &i) in brick.index.iter().enumerate() {
            let l = slabcast_common::brick::local_position(i);
            let voxel = std::array::from_fn(|a| corner[a] + l[a]);
            assert_eq!(brick.normals.as_ref().unwrap()[n], encode_normal(v.gradient(voxel, &m)));
        }
    }
    let relevant: u64 = v.summary.histogram[39..].iter().sum();
    assert_eq!(store.relevant_voxels(), relevant, "peer-opaque shows what is above 38");
}

#[test]
fn real_files_that_are_no_volume_are_refused_by_name() {
    for (file, kind, say) in [
        ("README.md", OpenErrorKind::NotAVolume, "is text"),
        ("formats", OpenErrorKind::NotAVolume, "holds no slices or pictures"),
        ("formats/nrrd", OpenErrorKind::NotAVolume, "give one file in it, such as `A_J_attached"),
    ] {
        let Some(path) = data(file) else { return };
        let e = open(&path).unwrap_err();
        assert_eq!(e.problem.kind, kind);
        let line = e.to_string();
        assert!(line.contains(say) && line.contains(file), "{line}");
    }
}
