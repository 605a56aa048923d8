use super::*;
use crate::fuzz::gzip;
use std::io::{Cursor, Write};
use std::path::Path;

/// Returns an array of the numbers 0, 1, 2, ... in the order of memory.
pub(crate) fn npy(version: u8, descr: &str, fortran: bool, shape: &str) -> Vec<u8> {
    let fortran = if fortran { "True" } else { "False" };
    let mut text =
        format!("{{'descr': '{descr}', 'fortran_order': {fortran}, 'shape': {shape}, }}");
    text.push_str(&" ".repeat(64 - text.len() % 64));
    let mut out = MAGIC.to_vec();
    out.extend([version, 0]);
    match version {
        1 => out.extend((text.len() as u16).to_le_bytes()),
        _ => out.extend((text.len() as u32).to_le_bytes()),
    }
    out.extend(text.as_bytes());
    let sizes = shape
        .trim_matches(['(', ')'])
        .split(',')
        .filter_map(|n| n.trim().trim_end_matches('L').parse::<u32>().ok());
    for i in 0..sizes.product::<u32>() {
        let (order, kind) = descr.split_at(1);
        let mut word = match kind {
            "b1" => vec![(i % 2) as u8],
            "u1" | "i1" => vec![i as u8],
            "u2" | "i2" => (i as u16).to_le_bytes().to_vec(),
            "u4" | "i4" => i.to_le_bytes().to_vec(),
            "u8" | "i8" => u64::from(i).to_le_bytes().to_vec(),
            "f4" => (i as f32).to_le_bytes().to_vec(),
            "f8" => f64::from(i).to_le_bytes().to_vec(),
            // Whole numbers up to 2048 are exact halves.
            "f2" => {
                let bits = (i as f32).to_bits();
                let half = if i == 0 { 0 } else { (bits >> 13) - (112 << 10) };
                (half as u16).to_le_bytes().to_vec()
            }
            _ => vec![0; 16],
        };
        if order == ">" {
            word.reverse();
        }
        out.extend(word);
    }
    out
}

/// Returns a zip archive of these files.
pub(crate) fn archive(files: &[(&str, &[u8])], packed: bool) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let method = if packed { CompressionMethod::Deflated } else { CompressionMethod::Stored };
    for (name, bytes) in files {
        let options = zip::write::SimpleFileOptions::default().compression_method(method);
        zip.start_file(*name, options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn opened(bytes: Vec<u8>, dataset: Option<&str>) -> Result<(Volume, String), Problem> {
    let source = Source::from_bytes(bytes);
    let notes = source.notes.clone();
    let dataset = dataset.map(String::from);
    let hints = crate::Hints { dataset, ..crate::Hints::default() };
    let volume = crate::read(source, Path::new("."), "test.npy", &hints)?;
    Ok((volume, notes.take().join("\n")))
}

fn values(v: &Volume) -> Vec<f64> {
    (0..v.samples.len()).map(|i| v.summary.map.value(v.samples.code(i))).collect()
}

#[test]
fn numpy_types_open_in_both_byte_orders_and_all_versions() {
    let want: Vec<f64> = (0..24).map(f64::from).collect();
    for kind in ["u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"] {
        for order in ["<", ">"] {
            for version in 1..=3 {
                let bytes = npy(version, &format!("{order}{kind}"), false, "(2, 3, 4)");
                let (v, notes) = opened(bytes.clone(), None).unwrap();
                assert_eq!(v.lattice.dims, [4, 3, 2]);
                assert_eq!(values(&v), want, "{order}{kind} version {version}");
                assert!(notes.contains("z, y, x (C order") && notes.contains("1 mm"), "{notes}");
                let (packed, _) = opened(gzip(&bytes), None).unwrap();
                assert_eq!(packed.digest(), v.digest());
                for deflated in [false, true] {
                    let bytes = archive(&[("volume.npy", &bytes)], deflated);
                    let (archived, _) = opened(bytes, None).unwrap();
                    assert_eq!(archived.digest(), v.digest());
                }
            }
        }
    }
    let (v, _) = opened(npy(1, "|b1", false, "(2, 1, 2)"), None).unwrap();
    assert_eq!(values(&v), [0.0, 1.0, 0.0, 1.0]);
}

#[test]
fn fastest_axis_of_a_numpy_array_is_x() {
    for (fortran, shape, dims, note) in [
        (false, "(2, 3, 4)", [4, 3, 2], "z, y, x"),
        (true, "(2, 3, 4)", [2, 3, 4], "x, y, z (Fortran order"),
        (false, "(1, 2, 3, 1, 4)", [4, 3, 2], "z, y, x"),
        (false, "(1, 3L, 4L)", [4, 3, 1], "z, y, x"),
    ] {
        let (v, notes) = opened(npy(1, "<u2", fortran, shape), None).unwrap();
        assert_eq!((v.lattice.dims, notes.contains(note)), (dims, true), "{shape}: {notes}");
    }
}

#[test]
fn numpy_array_of_several_volumes_gives_the_picked_one() {
    let (c, f) = ("(2, 3, 2, 2, 5)", "(5, 2, 2, 3, 2)");
    for kind in ["<u2", ">f2", "<f8"] {
        for (fortran, shape) in [(false, c), (true, f)] {
            let bytes = npy(1, kind, fortran, shape);
            let (v, notes) = opened(bytes.clone(), None).unwrap();
            assert_eq!((v.lattice.dims, v.summary.range()), ([5, 2, 2], (0.0, 19.0)));
            let axes = if fortran { [3, 4] } else { [1, 0] };
            for (axis, size) in axes.into_iter().zip([3, 2]) {
                let said =
                    format!("the first of {size} along axis {axis} was read; --volume takes");
                assert!(notes.contains(&said), "{notes}");
            }
            for bytes in [bytes.clone(), gzip(&bytes), archive(&[("a.npy", &bytes)], true)] {
                let pick = Pick { volume: Some(4), ..Pick::default() };
                let hints = crate::Hints { pick, ..crate::Hints::default() };
                let v = crate::read(Source::from_bytes(bytes), Path::new("."), "a", &hints);
                assert_eq!(v.unwrap().summary.range(), (80.0, 99.0), "{kind} {shape}");
            }
        }
    }
}

#[test]
fn numpy_archive_with_several_arrays_asks_for_one() {
    let (a, b) = (npy(1, "<u2", false, "(2, 3, 4)"), npy(1, "<f4", false, "(1, 3, 2)"));
    let bytes = archive(&[("ct.npy", &a), ("mask.npy", &b)], true);
    let e = opened(bytes.clone(), None).unwrap_err().to_string();
    assert!(e.contains("holds 2 arrays: `ct`, `mask`; name one of them, such as --dataset ct"));
    for name in ["mask", "mask.npy"] {
        let (v, notes) = opened(bytes.clone(), Some(name)).unwrap();
        assert_eq!(v.lattice.dims, [2, 3, 1]);
        assert!(notes.contains("array `mask` of 2 was read"), "{notes}");
    }
    let e = opened(bytes, Some("pet")).unwrap_err().to_string();
    assert!(e.contains("there is no `pet` among `ct`, `mask`"), "{e}");
    let e = opened(archive(&[("0/.zarray", b"{}")], true), None).unwrap_err().to_string();
    assert!(e.contains("is Zarr inside zip; unpack it with unzip, and give its folder"), "{e}");
    let e = opened(archive(&[("a.txt", b"{}")], true), None).unwrap_err().to_string();
    assert!(e.contains("zip archive without NumPy arrays"), "{e}");
}

#[test]
fn numpy_errors_name_field_and_remedy() {
    for (descr, shape, say) in [
        ("<c8", "(2, 3, 4)", "descr: `<c8` is complex numbers; save plain numbers"),
        ("|O", "(2, 3, 4)", "descr: `|O` is Python objects"),
        ("<f4", "(3, 4)", "shape: is a 2-D picture of 4 x 3, not a volume; give the folder"),
        ("<f4", "(2, 2, 3, 4)", "shape: (2, 2, 3, 4) may have 4 colours or components"),
        ("<f4", "(0, 2, 3, 5)", "has no samples"),
        ("<f4", "()", "shape: () is not that of a volume"),
        ("<f4", "(0, 3, 4)", "shape: 4 x 3 x 0 has no samples"),
        ("<f4", "(-1, 3, 4)", "shape: `-1` is no size"),
    ] {
        let e = opened(npy(1, descr, false, shape), None).unwrap_err().to_string();
        assert!(e.contains(say), "{descr} {shape}: {e}");
    }
    let good = npy(1, "<f4", false, "(2, 3, 4)");
    let e = opened(good[..good.len() - 1].to_vec(), None).unwrap_err().to_string();
    assert!(e.contains("truncated: 96 bytes are needed and 95 are there"), "{e}");
    let (_, notes) = opened([&good[..], &[1; 7]].concat(), None).unwrap();
    assert!(notes.contains("7 bytes after the array were not read"), "{notes}");
    let mut bytes = archive(&[("a.npy", &good)], false);
    let place = bytes.windows(4).position(|w| w == 1f32.to_le_bytes()).unwrap();
    bytes[place] ^= 1;
    let e = opened(bytes, None).unwrap_err().to_string();
    assert!(e.contains("zip stream is damaged"), "a wrong checksum: {e}");
}
