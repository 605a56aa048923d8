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
    write(volume, None, format, &mut bytes, on_progress).unwrap();
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
    let e = write(&v, None, ALL[0], &mut Vec::new(), stop).unwrap_err();
    assert_eq!(e.to_string(), "stopped");
}

/// Opens and writes a file as `slabcast convert` does; returns what was written.
fn converted(file: &Path, format: Format) -> Vec<u8> {
    let (opened, numbers) = crate::open_numbers(file, &crate::Hints::default()).unwrap();
    let mut bytes = Vec::new();
    write(&opened.volume, numbers.as_ref(), format, &mut bytes, &mut |_| Ok(())).unwrap();
    bytes
}

#[test]
fn wide_numbers_are_converted_to_the_bit_in_their_type() {
    let folder = tempfile::tempdir().unwrap();
    let spread = |i: u64| i.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    // Over the whole range, and close together far from zero, where f64 has no odd integers.
    let near = |i: u64| (1 << 60) + i;
    let doubles = [0.1, -1e300, f64::MIN_POSITIVE / 4.0, f64::INFINITY, -0.0];
    let double = |i: u64| doubles.get(i as usize).copied().unwrap_or(spread(i) as f64).to_bits();
    let filler = |i: u64| u64::from(if i == 3 { -3e38f32 } else { i as f32 }.to_bits());
    type Case<'a> = (&'a str, &'a str, usize, &'a dyn Fn(u64) -> u64);
    let cases: [Case<'_>; 8] = [
        ("float32", "float", 4, &filler),
        ("uint32", "uint32", 4, &spread),
        ("int32", "int32", 4, &spread),
        ("uint64", "uint64", 8, &spread),
        ("int64", "int64", 8, &spread),
        ("uint64", "uint64", 8, &near),
        ("int64", "int64", 8, &near),
        ("float64", "double", 8, &double),
    ];
    for (name, nrrd_name, size, number) in cases {
        let file = folder.path().join("in_7x5x3.raw");
        let data: Vec<u8> =
            (0..105).flat_map(|i| number(i).to_le_bytes().into_iter().take(size)).collect();
        let nrrd = format!(
            "NRRD0004\ntype: {nrrd_name}\ndimension: 3\nsizes: 7 5 3\nendian: little\nencoding: \
             raw\n\n"
        );
        std::fs::write(&file, [nrrd.as_bytes(), &data].concat()).unwrap();
        let out = converted(&file, Format::Nrrd { gzip: false });
        let head = String::from_utf8_lossy(&out).into_owned();
        assert!(head.contains(&format!("type: {nrrd_name}\n")), "{head}");
        assert!(out.ends_with(&data), "{name} in NRRD");
        let out = converted(&file, Format::Nifti { gzip: false });
        assert!(out.ends_with(&data) && out.len() == 352 + data.len(), "{name} in NIfTI");
        std::fs::write(folder.path().join("out.nii"), out).unwrap();
        let again = converted(&folder.path().join("out.nii"), Format::Nrrd { gzip: false });
        assert!(again.ends_with(&data), "{name} of NIfTI");
        // Drawn, they are rounded, and a note says so.
        let notes = crate::open_with(&file, &crate::Hints::default()).unwrap().notes.join("\n");
        let said = match name {
            "float32" => "the value -3.0000e38, far beyond all others, was taken for none".into(),
            name => format!("numbers of {name} are drawn rounded, by up to"),
        };
        assert!(notes.contains(&said), "{notes}");
    }
}

#[test]
fn integers_with_a_slope_keep_it_where_the_format_has_one_and_become_its_values_elsewhere() {
    let folder = tempfile::tempdir().unwrap();
    let (input, numbers) = (folder.path().join("in.nii"), [1u32, 70_001, 312_782_574, 312_782_575]);
    let v = volume(Samples::U8(vec![0; 6]), ValueMap::IDENTITY, "uint8");
    let mut bytes = Vec::new();
    write(&v, None, ALL[2], &mut bytes, &mut |_| Ok(())).unwrap();
    let mut set = |at: usize, with: &[u8]| bytes[at..at + with.len()].copy_from_slice(with);
    // 4 x 1 x 1 of uint32, slope 0.25, intercept -3.
    [4i16, 1, 1].iter().enumerate().for_each(|(a, n)| set(42 + 2 * a, &n.to_le_bytes()));
    set(70, &768i16.to_le_bytes());
    set(112, &0.25f32.to_le_bytes());
    set(116, &(-3.0f32).to_le_bytes());
    bytes.truncate(352);
    bytes.extend(numbers.iter().flat_map(|n| n.to_le_bytes()));
    std::fs::write(&input, &bytes).unwrap();
    let out = converted(&input, Format::Nifti { gzip: false });
    assert_eq!((&out[70..72], &out[112..120]), (&bytes[70..72], &bytes[112..120]));
    assert_eq!(out[352..], bytes[352..]);
    let out = converted(&input, Format::Nrrd { gzip: false });
    let values: Vec<u8> =
        numbers.iter().flat_map(|&n| (0.25 * f64::from(n) - 3.0).to_le_bytes()).collect();
    assert!(out.ends_with(&values));
    let (opened, numbers) = crate::open_numbers(&input, &crate::Hints::default()).unwrap();
    let note = |format| type_note(&opened.volume, numbers.as_ref(), format);
    let said = "the file has uint32, and float64 is written, with slope and intercept applied, as \
                NRRD has none";
    assert_eq!(note(Format::Nrrd { gzip: true }).as_deref(), Some(said));
    assert_eq!(note(Format::Nifti { gzip: true }), None);
}
