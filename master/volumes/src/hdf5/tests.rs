//! Files that h5py 3.16 wrote (HDF5 1.14). Sample i of their 7 x 5 x 3 is 5 i - 100.

use super::*;
use crate::{Hints, RawHints};
use glam::DVec3;
use slabcast_common::volume::Volume;

pub(crate) const PLAIN: &[u8] = include_bytes!("samples/plain.h5");
pub(crate) const LATEST: &[u8] = include_bytes!("samples/latest.h5");
pub(crate) const IMARIS: &[u8] = include_bytes!("samples/cells.ims");
pub(crate) const SLICES: &[u8] = include_bytes!("samples/slices.mnc");
pub(crate) const WHOLE: &[u8] = include_bytes!("samples/whole.mnc");
pub(crate) const NETCDF: &[u8] = include_bytes!("samples/air.nc");
pub(crate) const VTKHDF: &[u8] = include_bytes!("samples/cube.vtkhdf");

fn hints(dataset: &str) -> Hints {
    Hints { dataset: Some(dataset.into()), ..Hints::default() }
}

fn try_open(bytes: &[u8], hints: &Hints) -> Result<Opened, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("file.h5");
    std::fs::write(&path, bytes).unwrap();
    crate::open_with(&path, hints).map_err(|e| e.problem.to_string())
}

fn open(bytes: &[u8], hints: &Hints) -> (Volume, Vec<String>) {
    let opened = try_open(bytes, hints).unwrap_or_else(|e| panic!("{e}"));
    (opened.volume, opened.notes)
}

fn values(v: &Volume) -> Vec<f64> {
    (0..v.lattice.len()).map(|i| v.summary.map.value(v.samples.code(i))).collect()
}

/// The samples of `planes` planes.
fn ramp(planes: usize) -> Vec<f64> {
    (0..35 * planes).map(|i| 5.0 * i as f64 - 100.0).collect()
}

#[test]
fn largest_dataset_is_read_with_its_distances_and_the_others_are_named() {
    let (v, notes) = open(PLAIN, &Hints::default());
    assert_eq!((v.lattice.dims, v.file_type.as_str()), ([7, 5, 3], "int16"));
    assert_eq!(values(&v), ramp(3));
    // Micrometres along z, y, x.
    assert_eq!(v.lattice.spacing(), [0.0015, 0.002, 0.003]);
    let said = notes.join("; ");
    assert!(said.contains("was read, the largest of 6 datasets"), "{said}");
    for name in ["`big` (2 x 5 x 7)", "`half`", "`bool`", "`compact`", "`lzf`"] {
        assert!(said.contains(name), "{name}: {said}");
    }
    assert!(!said.contains("complex") && !said.contains("twelve"), "{said}");
    let raw = RawHints { spacing: Some([1.0, 2.0, 4.0]), ..RawHints::default() };
    let (v, _) = open(PLAIN, &Hints { raw, ..Hints::default() });
    assert_eq!(v.lattice.spacing(), [1.0, 2.0, 4.0]);
}

#[test]
fn every_layout_and_type_gives_its_numbers() {
    let truth: Vec<f64> = (0..70).map(|i| f64::from((i + 1) % 2)).collect();
    let wrapped = ramp(2).into_iter().map(|x| f64::from(x as i32 as u8)).collect();
    for (file, path, kind, want) in [
        (PLAIN, "big", "int32", ramp(2)),
        (PLAIN, "/half", "float32", ramp(2)),
        (PLAIN, "bool", "uint8", truth),
        (PLAIN, "compact", "float64", ramp(2)),
        (PLAIN, "again/raw", "int16", ramp(3)),
        (LATEST, "fixed", "uint8", wrapped),
        (LATEST, "empty", "int16", vec![7.0; 12]),
    ] {
        let (v, _) = open(file, &hints(path));
        assert_eq!((v.file_type.as_str(), values(&v)), (kind, want), "{path}");
    }
    let (v, notes) = open(PLAIN, &hints("big"));
    assert_eq!(v.lattice.spacing(), [1.0; 3]);
    assert!(notes.iter().any(|n| n.contains("says no spacing; 1 mm was taken")), "{notes:?}");
}

#[test]
fn what_is_not_read_is_refused_by_name() {
    for (file, path, say) in [
        (PLAIN, "complex", "`complex`: holds records of several numbers (complex numbers are"),
        (PLAIN, "twelve", "`twelve`: holds integers that fill a part of their bytes"),
        (PLAIN, "lzf", "`lzf`: is packed by a filter that is not read"),
        (PLAIN, "text", "`text`: has the shape [], which is no volume"),
        (PLAIN, "none", "--dataset: there is no `none` among `big`, `bool`"),
        (PLAIN, "lost", "there is no `lost`"),
        (NETCDF, "x", "has the shape [7], which is no volume"),
        (&PLAIN[..5000], "big", "is damaged"),
    ] {
        let e = try_open(file, &hints(path)).unwrap_err();
        assert!(e.contains(say), "{e}");
    }
    // A link into another file is not followed.
    let e = try_open(PLAIN, &hints("far")).unwrap_err();
    assert!(e.contains("far"), "{e}");
}

#[test]
fn times_of_a_dataset_are_an_axis_and_its_unit_holds() {
    let (v, notes) = open(LATEST, &Hints::default());
    assert_eq!((v.lattice.dims, values(&v)), ([7, 5, 3], ramp(3)));
    let spacing = v.lattice.spacing();
    let want = [0.001, 0.002, 0.04];
    assert!(spacing.iter().zip(want).all(|(a, b)| (a - b).abs() < 1e-9), "{spacing:?}");
    assert!(notes.iter().any(|n| n.contains("the first of 3 times was read")), "{notes:?}");
    let pick = Pick { time: Some(2), ..Pick::default() };
    let (v, _) = open(LATEST, &Hints { pick, ..Hints::default() });
    assert_eq!(values(&v)[3], 2000.0 - 85.0);
}

#[test]
fn imaris_is_cropped_to_its_picture_and_placed_in_its_box() {
    let (v, notes) = open(IMARIS, &Hints::default());
    assert_eq!(v.lattice.dims, [7, 5, 3]);
    assert_eq!(values(&v), ramp(3).iter().map(|x| x + 100.0).collect::<Vec<_>>());
    let near = |a: DVec3, b: [f64; 3]| (a - DVec3::from_array(b)).length() < 1e-12;
    assert!(near(v.lattice.origin, [0.0105, -0.004, 0.0015]), "{:?}", v.lattice.origin);
    let spacing = DVec3::from_array(v.lattice.spacing());
    assert!(near(spacing, [0.001, 0.002, 0.003]), "{spacing}");
    let said = notes.join("; ");
    assert!(said.contains("of 2 channels") && said.contains("of 2 times"), "{said}");
    let pick = Pick { time: Some(1), channel: Some(1), ..Pick::default() };
    let (v, _) = open(IMARIS, &Hints { pick, ..Hints::default() });
    assert_eq!(values(&v)[0], 3000.0);
    let pick = Pick { channel: Some(2), ..Pick::default() };
    let e = try_open(IMARIS, &Hints { pick, ..Hints::default() }).unwrap_err();
    assert!(e.contains("--channel: 2 is not there"), "{e}");
}

#[test]
fn minc_values_and_places_are_those_of_nibabel() {
    for (file, first) in
        [(SLICES, [0.0, 0.0, 160.0, 166.0, 1022.0]), (WHOLE, [-59.0, -59.0, -27.0, -26.0, 43.0])]
    {
        let (v, _) = open(file, &Hints::default());
        let all = values(&v);
        for (i, want) in [0, 1, 34, 35, 104].into_iter().zip(first) {
            assert!((all[i] - want).abs() < 1e-4, "{i}: {} {want}", all[i]);
        }
        assert!(v.anatomical);
        let (sin, cos) = (0.5, 0.75f64.sqrt());
        let want = [
            DVec3::new(-2.0 * cos, -2.0 * sin, 0.0),
            DVec3::new(-1.5 * sin, 1.5 * cos, 0.0),
            DVec3::Z * 3.0,
        ];
        for (step, want) in v.lattice.steps.iter().zip(want) {
            assert!((*step - want).length() < 1e-9, "{step} {want}");
        }
        let origin = DVec3::new(18.66025404, -12.32050808, 5.0);
        assert!((v.lattice.origin - origin).length() < 1e-7, "{}", v.lattice.origin);
    }
    // One range for all slices keeps the numbers.
    assert_eq!(open(WHOLE, &Hints::default()).0.file_type, "uint16");
    assert_eq!(open(SLICES, &Hints::default()).0.file_type, "float32");
}

#[test]
fn netcdf_has_coordinates_fill_values_and_scales() {
    let (v, notes) = open(NETCDF, &Hints::default());
    assert_eq!((v.lattice.dims, v.file_type.as_str()), ([7, 5, 3], "float32"));
    let all = values(&v);
    assert!(all[3].is_nan());
    assert_eq!((all[0], all[104]), (-40.0, 220.0));
    let steps = [DVec3::X * 0.0015, DVec3::Y * 0.002, DVec3::Z * -0.01];
    assert!(v.lattice.steps.iter().zip(steps).all(|(a, b)| (*a - b).length() < 1e-12));
    assert!((v.lattice.origin - DVec3::new(0.004, 0.0, 0.03)).length() < 1e-12);
    let said = notes.join("; ");
    for say in ["of 2 times", "the fill value -999 have no value", "add_offset were applied"] {
        assert!(said.contains(say), "{say}: {said}");
    }
    // Without fill values the numbers stay as they are.
    let (v, _) = open(NETCDF, &hints("plain"));
    assert_eq!((v.file_type.as_str(), values(&v)[1]), ("int16", -95.0 / 4.0));
}

#[test]
fn vtkhdf_is_placed_as_vti() {
    let (v, _) = open(VTKHDF, &Hints::default());
    assert_eq!(values(&v), ramp(3));
    assert_eq!(v.lattice.steps, [DVec3::Y * 0.5, DVec3::NEG_X, DVec3::Z * 2.0]);
    assert_eq!(v.lattice.origin, DVec3::new(1.0, 2.0, 5.0));
}

#[test]
fn types_that_the_parser_takes_for_others_are_refused() {
    // bfloat16, and float32 in VAX order.
    let float = |size: u8, flags: u8, sign: u8, layout: [u8; 4], bias: u32| {
        let head = [0x11, flags, sign, 0, size, 0, 0, 0, 0, 0, size * 8, 0];
        [&head[..], &layout[..], &bias.to_le_bytes()[..]].concat()
    };
    assert!(Stored::parse(&float(4, 0x20, 31, [23, 8, 0, 23], 127)).is_ok());
    assert!(Stored::parse(&float(4, 0x21, 31, [23, 8, 0, 23], 127)).unwrap().big_endian);
    for odd in [
        float(2, 0x20, 15, [7, 8, 0, 7], 127),
        float(4, 0x61, 31, [23, 8, 0, 23], 127),
        float(4, 0x20, 31, [23, 8, 0, 23], 128),
    ] {
        assert_eq!(Stored::parse(&odd), Err("floats that are not IEEE's (such as bfloat16)"));
    }
    assert!(Stored::parse(&[0x10, 8, 0]).is_err());
}

#[test]
fn failure_of_the_parsing_process_is_reported() {
    let reader = Some(vec!["false".into()]);
    let e = try_open(PLAIN, &Hints { hdf5_reader: reader, ..Hints::default() }).unwrap_err();
    assert!(e.contains("HDF5: the process that parses it") && e.contains("exit status: 1"), "{e}");
    assert!(e.contains("h5py"), "{e}");
}
