//! Tests with DICOM files written in every transfer syntax that is read.

use super::*;
use glam::DVec3;
use slabcast_common::volume::Samples;

/// A transfer syntax that is read.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Syntax {
    Implicit,
    Explicit,
    Big,
    Deflated,
    Rle,
    Lossless,
}

pub(crate) const ALL: [Syntax; 6] = [
    Syntax::Implicit,
    Syntax::Explicit,
    Syntax::Big,
    Syntax::Deflated,
    Syntax::Rle,
    Syntax::Lossless,
];

pub(crate) fn element(
    out: &mut Vec<u8>,
    explicit: bool,
    big: bool,
    tag: (u16, u16),
    kind: &str,
    value: &[u8],
) {
    let short = |n: u16| if big { n.to_be_bytes() } else { n.to_le_bytes() };
    let long = |n: u32| if big { n.to_be_bytes() } else { n.to_le_bytes() };
    out.extend(short(tag.0));
    out.extend(short(tag.1));
    let mut value = value.to_vec();
    if value.len() % 2 == 1 {
        value.push(if kind == "UI" { 0 } else { b' ' });
    }
    if explicit {
        out.extend(kind.as_bytes());
        if matches!(kind, "OB" | "OW" | "SQ") {
            out.extend([0, 0]);
            out.extend(long(value.len() as u32));
        } else {
            out.extend(short(value.len() as u16));
        }
    } else {
        out.extend(long(value.len() as u32));
    }
    out.extend(value);
}

/// Encodes bytes as PackBits literals.
fn packbits_literals(bytes: &[u8]) -> Vec<u8> {
    bytes.chunks(128).flat_map(|c| [&[c.len() as u8 - 1][..], c].concat()).collect()
}

/// A slice of 16-bit `pixels`, 3 columns wide, at `z` of series `uid`.
pub(crate) fn slice(
    syntax: Syntax,
    uid: &str,
    z: f64,
    pixels: &[i16],
    more: &[(&str, &str)],
) -> Vec<u8> {
    let big = syntax == Syntax::Big;
    let explicit = syntax != Syntax::Implicit;
    let mut meta = vec![0u8; 128];
    meta.extend(b"DICM");
    let name = match syntax {
        Syntax::Implicit => "1.2.840.10008.1.2",
        Syntax::Explicit => "1.2.840.10008.1.2.1",
        Syntax::Deflated => "1.2.840.10008.1.2.1.99",
        Syntax::Big => "1.2.840.10008.1.2.2",
        Syntax::Rle => "1.2.840.10008.1.2.5",
        Syntax::Lossless => "1.2.840.10008.1.2.4.70",
    };
    element(&mut meta, true, false, (2, 0x10), "UI", name.as_bytes());
    let mut body = Vec::new();
    let mut put =
        |tag, kind: &str, value: &[u8]| element(&mut body, explicit, big, tag, kind, value);
    let short = |n: u16| if big { n.to_be_bytes() } else { n.to_le_bytes() };
    let get = |key: &str, or: &str| {
        more.iter().find(|(k, _)| *k == key).map_or(or, |(_, v)| v).as_bytes().to_vec()
    };
    put((8, 8), "CS", &get("image_type", "ORIGINAL\\PRIMARY\\AXIAL"));
    put((8, 0x60), "CS", b"CT");
    put((8, 0x103e), "LO", &get("description", "thorax"));
    put((0x18, 0x50), "DS", &get("thickness", "9"));
    put((0x20, 0xe), "UI", uid.as_bytes());
    put((0x20, 0x11), "IS", &get("number", "7"));
    put((0x20, 0x13), "IS", &get("instance", "1"));
    put((0x20, 0x32), "DS", &get("position", &format!("-4\\5\\{z}")));
    put((0x20, 0x37), "DS", &get("orientation", "1\\0\\0\\0\\1\\0"));
    let samples: u16 = String::from_utf8(get("samples", "1")).unwrap().parse().unwrap();
    put((0x28, 2), "US", &short(samples));
    put((0x28, 4), "CS", &get("photometric", "MONOCHROME2"));
    put((0x28, 8), "IS", &get("frames", "1"));
    put((0x28, 0x10), "US", &short(pixels.len() as u16 / 3));
    put((0x28, 0x11), "US", &short(3));
    put((0x28, 0x30), "DS", &get("pixel_spacing", "2\\0.5"));
    put((0x28, 0x100), "US", &short(16));
    let stored: u16 = String::from_utf8(get("stored", "16")).unwrap().parse().unwrap();
    put((0x28, 0x101), "US", &short(stored));
    put((0x28, 0x102), "US", &short(stored - 1));
    let signed: u16 = String::from_utf8(get("signed", "1")).unwrap().parse().unwrap();
    put((0x28, 0x103), "US", &short(signed));
    put((0x28, 0x1052), "DS", &get("intercept", "-1024"));
    put((0x28, 0x1053), "DS", &get("slope", "1"));
    if more.iter().any(|(key, _)| *key == "modality_lut") {
        put((0x28, 0x3000), "SQ", &[0xfe, 0xff, 0, 0xe0, 0, 0, 0, 0]);
    }
    let words: Vec<u8> = pixels.iter().flat_map(|p| short(*p as u16)).collect();
    if matches!(syntax, Syntax::Rle | Syntax::Lossless) {
        let halves = [1, 0].map(|b| {
            packbits_literals(&words.iter().skip(b).step_by(2).copied().collect::<Vec<_>>())
        });
        let mut fragment = vec![0; 64];
        fragment[..4].copy_from_slice(&2u32.to_le_bytes());
        fragment[4..8].copy_from_slice(&64u32.to_le_bytes());
        fragment[8..12].copy_from_slice(&(64 + halves[0].len() as u32).to_le_bytes());
        fragment.extend(halves.concat());
        if syntax == Syntax::Lossless {
            let words: Vec<u16> = pixels.iter().map(|p| *p as u16).collect();
            fragment = super::jpeg::tests::lossless(&words, 3, 16, 1);
        }
        body.extend([0xe0, 0x7f, 0x10, 0, b'O', b'B', 0, 0, 0xff, 0xff, 0xff, 0xff]);
        // In two fragments, as the standard allows.
        let (first, second) = fragment.split_at(fragment.len() / 4 * 2);
        for item in [&[][..], first, second] {
            body.extend([0xfe, 0xff, 0, 0xe0]);
            body.extend((item.len() as u32).to_le_bytes());
            body.extend(item);
        }
        body.extend([0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]);
    } else {
        let padding = String::from_utf8(get("padding", "0")).unwrap().parse().unwrap();
        put((0x7fe0, 0x10), "OW", &[words, vec![0; padding]].concat());
    }
    if syntax == Syntax::Deflated {
        let mut z = flate2::write::DeflateEncoder::new(Vec::new(), flate2::Compression::fast());
        z.write_all(&body).unwrap();
        body = z.finish().unwrap();
    }
    [meta, body].concat()
}

fn folder(files: &[(&str, Vec<u8>)]) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    files.iter().for_each(|(name, bytes)| std::fs::write(dir.path().join(name), bytes).unwrap());
    dir
}

fn pixels(from: i16) -> Vec<i16> {
    (from..from + 6).collect()
}

#[test]
fn dicom_transfer_syntaxes_give_the_same_sorted_series() {
    let mut first = None;
    for syntax in ALL {
        // Named against their order in space.
        let s = |z, from| slice(syntax, "1.2.3", z, &pixels(from), &[]);
        let dir = folder(&[("a.dcm", s(4.0, 20)), ("b", s(1.0, -10)), ("c.ima", s(2.5, 5))]);
        let v = crate::open(dir.path()).unwrap_or_else(|e| panic!("{syntax:?}: {e}"));
        assert_eq!(v.name, "CT 7 thorax");
        assert_eq!((v.lattice.dims, v.file_type.as_str()), ([3, 2, 3], "int16"));
        assert!(v.anatomical);
        // Columns 0.5 apart, rows 2; LPS became RAS.
        assert_eq!(v.lattice.steps, [DVec3::X * -0.5, DVec3::Y * -2.0, DVec3::Z * 1.5]);
        assert_eq!(v.lattice.origin, DVec3::new(4.0, -5.0, 1.0));
        let values: Vec<f64> = (0..18).map(|i| v.summary.map.value(v.samples.code(i))).collect();
        let want = [-10, 5, 20].into_iter().flat_map(pixels);
        let want: Vec<f64> = want.map(|p| f64::from(p) - 1024.0).collect();
        assert_eq!(values, want, "{syntax:?}");
        assert_eq!(*first.get_or_insert(v.digest()), v.digest());
        // One of its files means the series.
        let opened = crate::open_with(&dir.path().join("c.ima"), &crate::Hints::default()).unwrap();
        assert_eq!(opened.volume.digest(), v.digest());
        assert!(opened.notes[0].contains("one of 3 slices"), "{:?}", opened.notes);
    }
}

#[test]
fn dicom_lists_several_series_and_opens_one_by_name() {
    let s = |uid, z, number, description| {
        slice(
            Syntax::Implicit,
            uid,
            z,
            &pixels(0),
            &[("number", number), ("description", description)],
        )
    };
    let dir = folder(&[
        ("1", s("1.1", 0.0, "1", "scout")),
        ("2", s("1.2", 0.0, "2", "thorax")),
        ("3", s("1.2", 1.0, "2", "thorax")),
    ]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    let list = "2 series: `CT 2 thorax` (2 slices), `CT 1 scout` (1 slice); name one of them";
    assert!(e.contains("--series") && e.contains(list), "{e}");
    for (series, count) in [("1", 1), ("2", 2), ("thorax", 2), ("CT 2 thorax", 2), ("1.2", 2)] {
        let hints = crate::Hints { series: Some(series.into()), ..crate::Hints::default() };
        let opened = crate::open_with(dir.path(), &hints).unwrap();
        assert_eq!(opened.volume.lattice.dims[2], count, "{series}");
        assert!(opened.notes[0].contains("of 2 was read"), "{:?}", opened.notes);
    }
    let hints = crate::Hints { series: Some("brain".into()), ..crate::Hints::default() };
    let e = crate::open_with(dir.path(), &hints).unwrap_err().to_string();
    assert!(e.contains("there is no `brain` among `CT 2 thorax`"), "{e}");
}

#[test]
fn dicom_lists_series_of_the_same_name_with_their_uids() {
    let more = [("number", "2"), ("description", "t1")];
    let s = |uid, z| slice(Syntax::Explicit, uid, z, &pixels(0), &more);
    let dir = folder(&[("1", s("1.1", 0.0)), ("2", s("1.2", 0.0)), ("3", s("1.2", 1.0))]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    let list = "`CT 2 t1` (2 slices, UID `1.2`), `CT 2 t1` (1 slice, UID `1.1`); name one";
    assert!(e.contains(list), "{e}");
    let hints = crate::Hints { series: Some("1.1".into()), ..crate::Hints::default() };
    assert_eq!(crate::open_with(dir.path(), &hints).unwrap().volume.lattice.dims[2], 1);
}

#[test]
fn dicom_applies_rescale_of_each_slice_and_masks_unused_bits() {
    let s = |z, slope| {
        slice(Syntax::Explicit, "1", z, &[0, 1, 2], &[("slope", slope), ("intercept", "0")])
    };
    let dir = folder(&[("1", s(0.0, "0.5")), ("2", s(1.0, "2"))]);
    let v = crate::open(dir.path()).unwrap();
    assert_eq!(v.samples, Samples::F32(vec![0.0, 0.5, 1.0, 0.0, 2.0, 4.0]));
    // 12 bits: what stands above them is not the value's; bit 11 is its sign.
    let s = |z| slice(Syntax::Implicit, "1", z, &[0x7001, 0x0fff, 0x0800], &[("stored", "12")]);
    let dir = folder(&[("1", s(0.0)), ("2", s(1.0))]);
    let v = crate::open(dir.path()).unwrap();
    let values: Vec<f64> = (0..3).map(|i| v.summary.map.value(v.samples.code(i))).collect();
    assert_eq!(values, [1.0 - 1024.0, -1.0 - 1024.0, -2048.0 - 1024.0]);
}

#[test]
fn dicom_errors_name_file_field_and_remedy() {
    let good = |z| slice(Syntax::Explicit, "1", z, &pixels(0), &[]);
    let with = |z, key, value| slice(Syntax::Explicit, "1", z, &pixels(0), &[(key, value)]);
    let swap = |bytes: Vec<u8>, from: &str, to: &str| {
        let at = bytes.windows(from.len()).position(|w| w == from.as_bytes()).unwrap();
        let mut bytes = bytes;
        bytes[at..at + to.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    let dir = folder(&[("1", good(0.0)), ("2", with(1.0, "padding", "12"))]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("`2` PixelData: has 24 bytes, where Rows and Columns want 12"), "{e}");
    let dir = folder(&[("1", swap(good(0.0), "1.2.840.10008.1.2.1", "1.2.840.10008.1.2.9"))]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(
        e.contains("`1.2.840.10008.1.2.9` is not an encoding that is known; convert it"),
        "{e}"
    );
    let dir = folder(&[("1", with(0.0, "frames", "30"))]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("`1` NumberOfFrames: is above 1"), "{e}");
    let e = good(1.0).len() - 12 - 4;
    let mut short = good(1.0);
    short[e..e + 4].copy_from_slice(&10u32.to_le_bytes());
    let dir = folder(&[("1", good(0.0)), ("2", short)]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("has 10 bytes, where Rows and Columns want 12; get the whole file"), "{e}");
    // Gaps that tell no missing slice are drawn as if they were even, and said.
    let dir = folder(&[("1", good(0.0)), ("2", good(1.0)), ("3", good(3.0))]);
    let opened = crate::open_with(dir.path(), &crate::Hints::default()).unwrap();
    assert!(opened.notes[0].contains("1.000 to 2.000 mm apart"), "{:?}", opened.notes);
    // Also where the gap has 300 digits, or is refused for it.
    let dir = folder(&[("1", good(0.0)), ("2", good(1.0)), ("3", good(1e300))]);
    let line = match crate::open_with(dir.path(), &crate::Hints::default()) {
        Ok(opened) => opened.notes.join(" "),
        Err(e) => e.to_string(),
    };
    assert!(line.len() < 400, "{line}");
}

#[test]
fn missing_dicom_slices_are_without_value_and_the_others_keep_their_places() {
    let s = |z: f64| slice(Syntax::Explicit, "1", z, &pixels(z as i16), &[("intercept", "0")]);
    let places = [0.0, 1.0, 2.0, 5.0, 6.0, 7.0, 8.0, 9.0];
    let (values, notes) = read(&places.map(s));
    assert_eq!(values.len(), 60);
    for (z, slice) in values.chunks(6).enumerate() {
        match places.contains(&(z as f64)) {
            true => assert_eq!(slice[5], z as f64 + 5.0),
            false => assert!(slice.iter().all(|v| v.is_nan()), "{z}: {slice:?}"),
        }
    }
    let say = "2 slices of `CT 7 thorax` are missing, between 2.000 and 5.000 mm along";
    assert!(notes[0].contains(say), "{notes:?}");
    let dir = folder(
        &places.map(|z| (["0", "1", "2", "", "", "5", "6", "7", "8", "9"][z as usize], s(z))),
    );
    let v = crate::open(dir.path()).unwrap();
    assert_eq!((v.lattice.steps[2], v.file_type.as_str()), (DVec3::Z, "float32"));
    assert_eq!(v.summary.range(), (0.0, 14.0));
}

#[test]
fn dicom_elements_without_types_in_a_jpeg_file_are_read_as_they_are() {
    // pydicom's SC_rgb_jpeg.dcm: the syntax is JPEG, which has types, and the elements have none.
    let implicit =
        slice(Syntax::Implicit, "1", 0.0, &pixels(0), &[("samples", "3"), ("photometric", "RGB")]);
    let place = implicit.windows(18).position(|w| w == b"1.2.840.10008.1.2\0").unwrap();
    let mut jpeg = implicit[..place - 8].to_vec();
    element(&mut jpeg, true, false, (2, 0x10), "UI", b"1.2.840.10008.1.2.4.50");
    jpeg.extend(&implicit[place + 18..implicit.len() - 20]);
    jpeg.extend([0xe0, 0x7f, 0x10, 0, 0xff, 0xff, 0xff, 0xff]);
    jpeg.extend([0xfe, 0xff, 0, 0xe0, 0, 0, 0, 0]);
    jpeg.extend([0xfe, 0xff, 0, 0xe0, 2, 0, 0, 0, 0xff, 0xd8]);
    jpeg.extend([0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]);
    let dir = folder(&[("a.dcm", jpeg)]);
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("SamplesPerPixel: is 3: a picture in colours (`RGB`); leave it out"), "{e}");
    // Types in a file whose syntax has none.
    let explicit = slice(Syntax::Explicit, "1", 0.0, &pixels(0), &[]);
    let at = explicit.windows(20).position(|w| w == b"1.2.840.10008.1.2.1\0").unwrap();
    let mut turned = explicit[..at - 8].to_vec();
    element(&mut turned, true, false, (2, 0x10), "UI", b"1.2.840.10008.1.2");
    turned.extend(&explicit[at + 20..]);
    let dir = folder(&[("a.dcm", turned)]);
    assert_eq!(crate::open(dir.path()).unwrap().lattice.dims, [3, 2, 1]);
}

#[test]
fn dicom_reader_process_failure_is_reported() {
    let dir = folder(&[("1", slice(Syntax::Implicit, "1", 0.0, &pixels(0), &[]))]);
    for (program, say) in
        [(&["false"][..], "exit status: 1"), (&["/no/such"], "could not be started")]
    {
        let reader = program.iter().map(std::ffi::OsString::from).collect();
        let hints = crate::Hints { dicom_reader: Some(reader), ..crate::Hints::default() };
        let e = crate::open_with(dir.path(), &hints).unwrap_err().to_string();
        assert!(e.contains(say) && e.contains("512 MiB"), "{e}");
    }
}

/// Values of a folder of slices that are 1 apart from 0 on, and the notes.
fn read(slices: &[Vec<u8>]) -> (Vec<f64>, Vec<String>) {
    let names: Vec<String> = (0..slices.len()).map(|i| i.to_string()).collect();
    let files: Vec<_> = names.iter().map(String::as_str).zip(slices.iter().cloned()).collect();
    let dir = folder(&files);
    let opened = crate::open_with(dir.path(), &crate::Hints::default());
    let opened = opened.unwrap_or_else(|e| panic!("{e}"));
    let v = opened.volume;
    let count = v.lattice.len();
    ((0..count).map(|i| v.summary.map.value(v.samples.code(i))).collect(), opened.notes)
}

#[test]
fn dicom_bits_and_sign_hold_for_one_slice_each() {
    let s = |z, words: &[i16], stored, signed| {
        let more = [("stored", stored), ("signed", signed), ("intercept", "0")];
        slice(Syntax::Explicit, "1", z, words, &more)
    };
    // Bits above the stored ones are not the value's.
    let (values, notes) = read(&[
        s(0.0, &[0x7fff, 1, 2], "11", "0"),
        s(1.0, &[0x7fff, 1, 2], "12", "0"),
        s(2.0, &[-1, 1, 2], "12", "1"),
    ]);
    assert_eq!(values, [2047.0, 1.0, 2.0, 4095.0, 1.0, 2.0, -1.0, 1.0, 2.0]);
    assert!(notes[0].contains("PixelRepresentation; each was read by its own"), "{notes:?}");
    // All 16 bits of both kinds need more than 16.
    let (values, _) = read(&[s(0.0, &[-1, 0, 1], "16", "0"), s(1.0, &[-1, 0, 1], "16", "1")]);
    assert_eq!(values, [65535.0, 0.0, 1.0, -1.0, 0.0, 1.0]);
}

#[test]
fn dicom_wordings_that_do_not_matter_are_not_refused() {
    let s = |z, more: &[(&str, &str)]| slice(Syntax::Implicit, "1", z, &pixels(0), more);
    for more in [
        ("thickness", "5 mm"),
        ("thickness", "thin"),
        ("frames", "01"),
        ("frames", "+1"),
        ("frames", "0"),
    ] {
        let (values, notes) = read(&[s(0.0, &[more]), s(1.0, &[more])]);
        assert_eq!((values.len(), notes), (12, vec![]), "{more:?}");
    }
    // A lone slice has no other distance.
    for (thickness, say) in [
        ("5 mm", "SliceThickness is `5 mm`, and 5 mm was taken"),
        ("2,5", "SliceThickness is `2,5`, and 2.5 mm was taken"),
        ("thin", "SliceThickness is `thin`, which is no length; 1 mm was assumed"),
        ("0", "no distance of slices is given; 1 mm was assumed"),
    ] {
        let (_, notes) = read(&[s(0.0, &[("thickness", thickness)])]);
        assert_eq!(notes[0], say);
    }
    let (values, notes) = read(&[s(0.0, &[]), s(1.0, &[("padding", "8")])]);
    assert_eq!(values.len(), 12);
    let say = "1 of 2 slices have up to 8 bytes of padding after their pixels, which were ignored";
    assert_eq!(notes, [say]);
}

#[test]
fn dicom_bytes_in_big_endian_words_are_turned() {
    // Three columns of one row: the fourth byte is padding.
    let turn = |kind: &[u8; 2]| {
        let mut file = slice(Syntax::Big, "1", 0.0, &[0, 0, 0], &[("intercept", "0")]);
        let at = |file: &[u8], w: &[u8]| file.windows(w.len()).position(|x| x == w).unwrap();
        for (tag, value) in [(0x100u16, 8u16), (0x101, 8), (0x102, 7), (0x103, 0)] {
            let tag = [&0x28u16.to_be_bytes()[..], &tag.to_be_bytes(), b"US"].concat();
            let at = at(&file, &tag) + 8;
            file[at..at + 2].copy_from_slice(&value.to_be_bytes());
        }
        let pixels = at(&file, &[0x7f, 0xe0, 0, 0x10]);
        file.truncate(pixels);
        file.extend([0x7f, 0xe0, 0, 0x10, kind[0], kind[1], 0, 0, 0, 0, 0, 4, 1, 2, 3, 4]);
        read(&[file]).0
    };
    assert_eq!(turn(b"OW"), [2.0, 1.0, 4.0]);
    assert_eq!(turn(b"OB"), [1.0, 2.0, 3.0]);
}

#[test]
fn dicom_series_can_be_chosen_by_all_that_a_message_shows() {
    let long = |last: char| format!("1.2.826.0.1.3680043.8.498.{last}{}", "7".repeat(37));
    let (one, two) = (long('1'), long('2'));
    let axial = [("description", "t1")];
    let coronal = [("description", "t1"), ("orientation", "1\\0\\0\\0\\0\\1")];
    let s = |uid: &str, more| slice(Syntax::Explicit, uid, 0.0, &pixels(0), more);
    let words = "a description as long as the standard lets it be, sixty-four, i.e.";
    let dir = folder(&[
        ("1", s(&one, &axial)),
        ("2", s(&two, &axial)),
        ("3", s(&two, &coronal)),
        ("4", s("1.9", &[("description", words)])),
    ]);
    let open = |series: Option<&str>| {
        let series = series.map(String::from);
        crate::open_with(dir.path(), &crate::Hints { series, ..crate::Hints::default() })
    };
    let e = open(None).unwrap_err().to_string();
    let list = e.split("4 series: ").nth(1).unwrap();
    let list = list.split("; name one").next().unwrap();
    let mut places = Vec::new();
    for entry in list.split("), ") {
        // The UID where there is one, else the name.
        let shown = entry.split('`').nth(if entry.contains("UID") { 3 } else { 1 }).unwrap();
        let opened = open(Some(shown)).unwrap_or_else(|e| panic!("{shown}: {e}"));
        places.push(format!("{} {:?}", opened.volume.name, opened.volume.lattice.steps));
    }
    assert_eq!(places.len(), 4, "{list}");
    assert!(list.contains(&one) && list.contains(&format!("{two}/2")), "{list}");
    places.sort();
    places.dedup();
    assert_eq!(places.len(), 3, "only one and two/1 look alike: {places:?}");
    // The beginning of a UID, as far as it is unique.
    assert!(open(Some("1.9")).is_ok() && open(Some(&format!("{}...", &one[..63]))).is_ok());
    let e = open(Some("1.2.826")).unwrap_err().to_string();
    assert!(e.contains("3 series are called `1.2.826`"), "{e}");
}

#[test]
fn dicom_series_of_several_times_gives_the_picked_one() {
    // Two times of two slices; instance numbers go through the times first.
    let one = |z: f64, instance: &str, from: i16| {
        slice(
            Syntax::Explicit,
            "1.2",
            z,
            &pixels(from),
            &[("instance", instance), ("intercept", "0")],
        )
    };
    let files = [
        ("a", one(0.0, "1", 0)),
        ("b", one(0.0, "2", 100)),
        ("c", one(3.0, "3", 200)),
        ("d", one(3.0, "4", 300)),
    ];
    let dir = folder(&files);
    let read = |pick| {
        let hints = crate::Hints { pick, ..crate::Hints::default() };
        let opened = crate::open_with(dir.path(), &hints).map_err(|e| e.to_string())?;
        let v = &opened.volume;
        assert_eq!(v.lattice.dims, [3, 2, 2]);
        let values = [0, 6].map(|i| v.summary.map.value(v.samples.code(i)));
        Ok::<_, String>((values, opened.notes.join("; ")))
    };
    let none = Pick::default();
    let said = "the first of 2 times or echoes was read; --time takes another";
    assert_eq!(read(none).unwrap(), ([0.0, 200.0], said.into()));
    for pick in [Pick { volume: Some(1), ..none }, Pick { time: Some(1), ..none }] {
        assert_eq!(read(pick).unwrap(), ([100.0, 300.0], String::new()));
    }
    let e = read(Pick { time: Some(2), ..none }).unwrap_err();
    assert!(e.ends_with("--time: 2 is not there: the file has 2 times; give 0 to 1"), "{e}");
    std::fs::remove_file(dir.path().join("d")).unwrap();
    let e = read(none).unwrap_err();
    assert!(e.contains("times or echoes that are not whole; give a folder with one"), "{e}");
}

#[test]
fn bad_file_beside_a_dicom_series_is_left_out_and_noted_and_refused_if_it_is_the_one_given() {
    let s = |z: f64| slice(Syntax::Explicit, "1.2", z, &pixels(0), &[]);
    let bad = slice(Syntax::Explicit, "1.2", 2.0, &pixels(0), &[("orientation", "1\\0\\x")]);
    let cut = s(2.0).len() - 20;
    for (bad, say) in [
        (bad, "`bad.dcm` ImageOrientationPatient: `1\\\\0\\\\x` is not 6 numbers"),
        (s(2.0)[..cut].to_vec(), "`bad.dcm` elements: truncated"),
        (s(2.0)[..cut + 17].to_vec(), "`bad.dcm` data: truncated: 12 bytes are needed and 9"),
    ] {
        let dir = folder(&[("a", s(0.0)), ("b", s(1.0)), ("bad.dcm", bad)]);
        let opened = crate::open_with(dir.path(), &crate::Hints::default()).unwrap();
        assert_eq!(opened.volume.lattice.dims, [3, 2, 2]);
        let notes = opened.notes.join("; ");
        let said = format!("1 DICOM file was left out: {say}");
        assert!(notes.contains(&said), "want {said} in {notes}");
        assert!(crate::open(&dir.path().join("b")).is_ok(), "as a slice of its series");
        let e = crate::open(&dir.path().join("bad.dcm")).unwrap_err().to_string();
        assert!(e.contains(say), "{e}");
    }
}

#[test]
fn dicom_mosaics_and_tables_of_values_are_refused_and_palettes_said() {
    let open = |more: &[(&str, &str)]| {
        let dir = folder(&[("1", slice(Syntax::Explicit, "1", 0.0, &pixels(0), more))]);
        crate::open_with(dir.path(), &crate::Hints::default()).map_err(|e| e.to_string())
    };
    let e = open(&[("image_type", "ORIGINAL\\PRIMARY\\M\\ND\\MOSAIC")]).unwrap_err();
    assert!(e.contains("`1` ImageType: is MOSAIC") && e.contains("dcm2niix"), "{e}");
    let e = open(&[("modality_lut", "1")]).unwrap_err();
    assert!(e.contains("`1` ModalityLUTSequence: gives the values by a table"), "{e}");
    let notes = open(&[("photometric", "PALETTE COLOR")]).unwrap().notes.join("; ");
    assert!(notes.contains("the stored indices were read"), "{notes}");
}

#[test]
fn folder_above_a_series_is_refused_with_the_folder_below() {
    let dir = tempfile::tempdir().unwrap();
    let below = dir.path().join("DICOM/S01");
    std::fs::create_dir_all(&below).unwrap();
    for z in 0..3 {
        let bytes = slice(Syntax::Explicit, "1.2", f64::from(z), &pixels(0), &[]);
        std::fs::write(below.join(format!("IM{z}")), bytes).unwrap();
    }
    let said = "give the folder `DICOM/S01` below it, which holds 3 DICOM files";
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.ends_with(said), "{e}");
    // A DICOMDIR has no picture of its own.
    let mut dicomdir = slice(Syntax::Explicit, "1.2", 0.0, &pixels(0), &[]);
    dicomdir.truncate(dicomdir.len() - 24);
    std::fs::write(dir.path().join("DICOMDIR"), dicomdir).unwrap();
    for path in [dir.path().to_path_buf(), dir.path().join("DICOMDIR")] {
        let e = crate::open(&path).unwrap_err().to_string();
        assert!(e.contains("holds DICOM files, but no picture") && e.ends_with(said), "{e}");
    }
    std::fs::create_dir(dir.path().join("DICOM/S02")).unwrap();
    std::fs::copy(below.join("IM0"), dir.path().join("DICOM/S02/IM0")).unwrap();
    let e = crate::open(dir.path()).unwrap_err().to_string();
    let said = "give a folder below it: `DICOM/S01` (3 DICOM files), `DICOM/S02` (1 DICOM file)";
    assert!(e.ends_with(said), "{e}");
}
