use super::*;
use crate::source::Source;
use glam::DVec3;
use slabcast_common::volume::Lattice;
use std::path::Path;

const ALL: [Format; 4] = [
    Format::Nrrd { gzip: false },
    Format::Nrrd { gzip: true },
    Format::Nifti { gzip: false },
    Format::Nifti { gzip: true },
];

fn again(volume: &Volume, format: Format) -> Volume {
    let (mut bytes, mut seen) = (Vec::new(), 0);
    let on_progress = &mut |n| {
        seen = n;
        Ok(())
    };
    write(volume, format, &mut bytes, on_progress).unwrap();
    assert_eq!(seen, volume.samples.len() as u64);
    let source = Source::from_bytes(bytes);
    crate::read(source, Path::new("."), "x", &crate::Hints::default())
        .unwrap_or_else(|e| panic!("{format:?}: {e}"))
}

fn volume(samples: Samples, map: ValueMap, file_type: &str) -> Volume {
    // Numbers of f32, so that NIfTI keeps them.
    let lattice = Lattice {
        dims: [3, 2, 1],
        steps: [DVec3::new(0.0, -1.5, 0.0), DVec3::new(0.75, 0.0, 0.25), DVec3::Z * 3.0],
        origin: DVec3::new(-7.5, 8.0, 0.125),
    };
    Volume::new("v", file_type, true, lattice, samples, map)
}

#[test]
fn written_volume_reads_back_with_the_same_digest() {
    let shift = |offset| ValueMap { scale: 1.0, offset };
    let bytes = || Samples::U8(vec![0, 1, 2, 128, 254, 255]);
    let words = || Samples::U16(vec![0, 1, 255, 256, 40000, 65535]);
    for (samples, map, name) in [
        (bytes(), ValueMap::IDENTITY, "uint8"),
        (bytes(), shift(-128.0), "int8"),
        (words(), ValueMap::IDENTITY, "uint16"),
        (words(), shift(-32768.0), "int16"),
        (words(), shift(4e9 as u32 as f64), "uint32"),
        (words(), shift(-2147483648.0), "int32"),
        (words(), shift(-9007199254740992.0), "int64"),
        (
            Samples::F32(vec![-1.5, 0.0, 1e-40, 3e38, f32::NAN, f32::INFINITY]),
            ValueMap::IDENTITY,
            "float32",
        ),
    ] {
        let v = volume(samples, map, name);
        for format in ALL {
            let back = again(&v, format);
            assert_eq!(back.file_type, name, "{format:?}");
            assert_eq!(back.digest(), v.digest(), "{name} {format:?}");
            assert!(back.anatomical);
        }
    }
}

#[test]
fn written_volume_with_slope_keeps_its_values() {
    let half = ValueMap { scale: 0.5, offset: -3.25 };
    let odd = ValueMap { scale: 0.1, offset: 1.0 / 3.0 };
    let wide = ValueMap { scale: 4e9, offset: -2e9 };
    for (samples, map) in [
        (Samples::U8(vec![0, 1, 2, 128, 254, 255]), half),
        (Samples::U16(vec![0, 1, 2, 128, 254, 65535]), odd),
        (Samples::F32(vec![0.0, 0.25, 0.5, 1.0, 0.125, 0.75]), wide),
    ] {
        let v = volume(samples, map, "whatever");
        for format in ALL {
            let back = again(&v, format);
            let (lo, hi) = v.summary.range();
            for i in 0..6 {
                let a = v.summary.map.value(v.samples.code(i));
                let b = back.summary.map.value(back.samples.code(i));
                assert!((a - b).abs() <= (hi - lo) * 1e-6, "{format:?}: {a} became {b}");
            }
        }
    }
}

#[test]
fn written_lattice_without_anatomy_stays_without_where_the_format_allows() {
    let samples = || Samples::U8(vec![0; 6]);
    let mut v = volume(samples(), ValueMap::IDENTITY, "uint8");
    v.anatomical = false;
    assert_eq!(loss_warning(&v, ALL[0]), None);
    assert!(loss_warning(&v, ALL[2]).unwrap().contains("right, anterior"));
    let back = again(&v, ALL[0]);
    assert!(!back.anatomical && back.lattice == v.lattice);
    assert_eq!(again(&v, ALL[2]).lattice, v.lattice);
    v.lattice = Lattice::from_spacing([3, 2, 1], [1.0, 2.0, 3.0]);
    for format in ALL {
        let back = again(&v, format);
        assert!(!back.anatomical && back.lattice == v.lattice, "{format:?}");
        assert_eq!(loss_warning(&v, format), None);
    }
}

#[test]
fn write_stops_with_the_error_of_on_progress() {
    let v = volume(Samples::U8(vec![0; 6]), ValueMap::IDENTITY, "uint8");
    let stop = &mut |_| Err(io::Error::other("stopped"));
    let e = write(&v, ALL[0], &mut Vec::new(), stop).unwrap_err();
    assert_eq!(e.to_string(), "stopped");
}
