use super::*;
use crate::dicom::jpeg::tests::lossless;
use crate::dicom::tests::element;
use glam::DVec3;

/// Returns a sequence of items, with lengths or with delimiters.
fn sequence(tag: Tag, items: &[Vec<u8>], delimited: bool) -> Vec<u8> {
    let mut out = Vec::new();
    out.extend(tag.0.to_le_bytes());
    out.extend(tag.1.to_le_bytes());
    out.extend(b"SQ\0\0");
    let body: Vec<u8> = items
        .iter()
        .flat_map(|item| {
            let len = if delimited { UNDEFINED } else { item.len() as u32 };
            let end: &[u8] = if delimited { &[0xfe, 0xff, 0x0d, 0xe0, 0, 0, 0, 0] } else { &[] };
            [&[0xfe, 0xff, 0x00, 0xe0][..], &len.to_le_bytes(), item, end].concat()
        })
        .collect();
    let len = if delimited { UNDEFINED } else { body.len() as u32 };
    out.extend(len.to_le_bytes());
    out.extend(body);
    if delimited {
        out.extend(DELIMITER);
    }
    out
}

fn item(elements: &[(Tag, &str, &[u8])]) -> Vec<u8> {
    let mut out = Vec::new();
    elements
        .iter()
        .for_each(|(tag, kind, value)| element(&mut out, true, false, *tag, kind, value));
    out
}

/// Returns a file of frames of 3 x 2 pixels: z, slope and the first of their numbers, which go up
/// by one.
pub(crate) fn enhanced(frames: &[(f64, f64, u16)], packed: bool, delimited: bool) -> Vec<u8> {
    let mut out = vec![0u8; 128];
    out.extend(b"DICM");
    let uid = if packed { "1.2.840.10008.1.2.4.70" } else { "1.2.840.10008.1.2.1" };
    element(&mut out, true, false, (2, 0x10), "UI", uid.as_bytes());
    let short = |n: u16| n.to_le_bytes();
    let count = frames.len().to_string();
    for (tag, kind, value) in [
        ((0x0020, 0x000e), "UI", &b"1.2.3"[..]),
        ((0x0028, 0x0002), "US", &short(1)),
        ((0x0028, 0x0008), "IS", count.as_bytes()),
        ((0x0028, 0x0010), "US", &short(2)),
        ((0x0028, 0x0011), "US", &short(3)),
        ((0x0028, 0x0100), "US", &short(16)),
        ((0x0028, 0x0101), "US", &short(16)),
        ((0x0028, 0x0102), "US", &short(15)),
        ((0x0028, 0x0103), "US", &short(0)),
    ] {
        element(&mut out, true, false, tag, kind, value);
    }
    let group = |tag, elements: &[(Tag, &str, &[u8])]| sequence(tag, &[item(elements)], delimited);
    let shared = [
        group((0x0020, 0x9116), &[((0x0020, 0x0037), "DS", b"1\\0\\0\\0\\1\\0")]),
        group((0x0028, 0x9110), &[((0x0028, 0x0030), "DS", b"2\\0.5")]),
        // A group of no interest.
        group((0x0018, 0x9006), &[((0x0028, 0x0030), "DS", b"9\\9")]),
    ];
    out.extend(sequence(SHARED, &[shared.concat()], delimited));
    let per_frame = frames.iter().map(|(z, slope, _)| {
        let (position, slope) = (format!("-4\\5\\{z}"), slope.to_string());
        let slope: [(Tag, &str, &[u8]); 2] =
            [((0x0028, 0x1052), "DS", b"0"), ((0x0028, 0x1053), "DS", slope.as_bytes())];
        [
            group((0x0020, 0x9113), &[((0x0020, 0x0032), "DS", position.as_bytes())]),
            group((0x0028, 0x9145), &slope),
        ]
        .concat()
    });
    out.extend(sequence(PER_FRAME, &per_frame.collect::<Vec<_>>(), delimited));
    let pixels = |first: u16| (first..first + 6).collect::<Vec<u16>>();
    if !packed {
        let words: Vec<u8> =
            frames.iter().flat_map(|f| pixels(f.2)).flat_map(u16::to_le_bytes).collect();
        element(&mut out, true, false, (0x7fe0, 0x0010), "OW", &words);
        return out;
    }
    out.extend([0xe0, 0x7f, 0x10, 0, b'O', b'B', 0, 0, 0xff, 0xff, 0xff, 0xff]);
    // With a table of offsets, and each frame in two fragments, if lengths are given.
    let (mut table, mut items) = (Vec::new(), Vec::new());
    for (_, _, first) in frames {
        table.extend((items.len() as u32).to_le_bytes());
        let frame = lossless(&pixels(*first), 3, 16, 1);
        let (start, end) = frame.split_at(if delimited { frame.len() } else { 20 });
        for part in [start, end].iter().filter(|part| !part.is_empty()) {
            items.extend([0xfe, 0xff, 0x00, 0xe0]);
            items.extend((part.len() as u32).to_le_bytes());
            items.extend(*part);
        }
    }
    if delimited {
        table.clear();
    }
    out.extend([0xfe, 0xff, 0x00, 0xe0]);
    out.extend((table.len() as u32).to_le_bytes());
    [&out[..], &table, &items, &DELIMITER].concat()
}

/// Returns a dose of two frames of 3 x 2 pixels, with numbers from 10 on.
fn dose(offsets: &str) -> Vec<u8> {
    let mut file = enhanced(&[(0.0, 1.0, 10), (1.0, 1.0, 20)], false, false);
    let start = file.windows(4).position(|w| w == [0x00, 0x52, 0x29, 0x92]).unwrap();
    let pixels = file.windows(4).position(|w| w == [0xe0, 0x7f, 0x10, 0x00]).unwrap();
    let places = item(&[
        ((0x0020, 0x0032), "DS", b"1\\2\\30"),
        ((0x0020, 0x0037), "DS", b"1\\0\\0\\0\\1\\0"),
        ((0x0028, 0x0030), "DS", b"2\\0.5"),
        ((0x3004, 0x000c), "DS", offsets.as_bytes()),
        ((0x3004, 0x000e), "DS", b"0.5"),
    ]);
    file.splice(start..pixels, places);
    file
}

#[test]
fn frames_of_a_dose_lie_at_their_offsets_in_its_unit() {
    // From the first frame, or from the patient's origin.
    for (offsets, z, first) in
        [("0\\2.5", 30.0, 5.0), ("30\\32.5", 30.0, 5.0), ("0\\-2.5", 27.5, 10.0)]
    {
        let (v, notes) = open(&dose(offsets)).unwrap();
        assert_eq!((v.lattice.dims, notes.as_str()), ([3, 2, 2], ""));
        assert_eq!(v.lattice.origin, DVec3::new(-1.0, -2.0, z), "{offsets}");
        assert_eq!(v.lattice.steps[2], DVec3::Z * 2.5);
        assert_eq!(v.summary.map.value(v.samples.code(0)), first);
    }
    let e = open(&dose("0")).unwrap_err();
    assert!(e.contains("GridFrameOffsetVector: has 1 frames, where NumberOfFrames says 2"), "{e}");
    let e = open(&dose("0\\x")).unwrap_err();
    assert!(e.contains("GridFrameOffsetVector: is not numbers"), "{e}");
}

fn open(bytes: &[u8]) -> Result<(slabcast_common::volume::Volume, String), String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.dcm");
    std::fs::write(&path, bytes).unwrap();
    match crate::open_with(&path, &crate::Hints::default()) {
        Ok(opened) => Ok((opened.volume, opened.notes.join("\n"))),
        Err(e) => Err(e.problem.to_string()),
    }
}

#[test]
fn frames_of_one_file_are_slices_sorted_by_place() {
    // Against their order in space.
    let frames = [(4.0, 1.0, 300), (1.0, 1.0, 100), (2.5, 1.0, 200)];
    for (packed, delimited) in [(false, false), (false, true), (true, false), (true, true)] {
        let (v, notes) = open(&enhanced(&frames, packed, delimited)).unwrap();
        assert_eq!((v.lattice.dims, notes.as_str()), ([3, 2, 3], ""));
        let steps = [DVec3::X * -0.5, DVec3::Y * -2.0, DVec3::Z * 1.5];
        assert_eq!((v.lattice.steps, v.lattice.origin), (steps, DVec3::new(4.0, -5.0, 1.0)));
        let values: Vec<f64> =
            [0, 5, 6, 12, 17].map(|i| v.summary.map.value(v.samples.code(i))).to_vec();
        assert_eq!(values, [100.0, 105.0, 200.0, 300.0, 305.0], "{packed} {delimited}");
    }
    let scaled = enhanced(&[(0.0, 1.0, 10), (1.0, 2.0, 10)], false, false);
    let (v, _) = open(&scaled).unwrap();
    assert_eq!(v.summary.map.value(v.samples.code(6)), 20.0, "each by its own slope");
}

#[test]
fn frames_that_contradict_their_file_are_refused() {
    let good = enhanced(&[(0.0, 1.0, 10), (1.0, 1.0, 20)], false, false);
    let replaced = |from: &[u8], to: &[u8]| {
        let at = good.windows(from.len()).position(|w| w == from).unwrap();
        [&good[..at], to, &good[at + from.len()..]].concat()
    };
    let e = open(&replaced(b"IS\x02\x002 ", b"IS\x02\x003 ")).unwrap_err();
    assert!(e.contains("has 2 frames, where NumberOfFrames says 3"), "{e}");
    let e = open(&replaced(&[0x52, 0x30, 0x92], &[0x52, 0x31, 0x92])).unwrap_err();
    assert!(e.contains("NumberOfFrames: is above 1, and the file does not say where"), "{e}");
    let e = open(&good[..good.len() - 3]).unwrap_err();
    assert!(e.contains("truncated: 24 bytes are needed and 21 are there"), "{e}");
    let packed = enhanced(&[(0.0, 1.0, 10), (1.0, 1.0, 20)], true, false);
    let e = open(&packed[..packed.len() - 12]).unwrap_err();
    assert!(e.contains("is truncated inside its fragments"), "{e}");
}
