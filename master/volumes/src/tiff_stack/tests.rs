use super::*;
use slabcast_common::volume::Samples;
use std::io::Cursor;
use std::path::Path;
use tiff::encoder::{Compression, TiffEncoder, colortype};

/// Pages of 5 x 4 samples 0, 1, 2, ...
pub(crate) fn pages(count: u16, compression: Compression) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let mut tiff = TiffEncoder::new(&mut out).unwrap().with_compression(compression);
    for page in 0..count {
        let data: Vec<u16> = (0..20).map(|i| page * 20 + i).collect();
        let mut image = tiff.new_image::<colortype::Gray16>(5, 4).unwrap();
        image.rows_per_strip(3).unwrap();
        image.write_data(&data).unwrap();
    }
    out.into_inner()
}

fn one<C: colortype::ColorType>(w: u32, h: u32, data: &[C::Inner], text: &str) -> Vec<u8>
where
    [C::Inner]: tiff::encoder::TiffValue,
{
    let mut out = Cursor::new(Vec::new());
    let mut tiff = TiffEncoder::new(&mut out).unwrap();
    let mut image = tiff.new_image::<C>(w, h).unwrap();
    image.encoder().write_tag(Tag::ImageDescription, text).unwrap();
    image.x_resolution(tiff::encoder::Rational { n: 4, d: 1 });
    image.y_resolution(tiff::encoder::Rational { n: 2, d: 1 });
    image.write_data(data).unwrap();
    out.into_inner()
}

fn open(bytes: Vec<u8>) -> Result<Volume, Problem> {
    crate::read(Source::from_bytes(bytes), Path::new("."), "t.tif", &crate::Hints::default())
}

#[test]
fn tiff_pages_become_slices_in_every_compression() {
    for compression in [
        Compression::Uncompressed,
        Compression::Lzw,
        Compression::Packbits,
        Compression::Deflate(tiff::encoder::DeflateLevel::Fast),
    ] {
        let v = open(pages(3, compression)).unwrap();
        assert_eq!((v.lattice.dims, v.file_type.as_str()), ([5, 4, 3], "uint16"));
        assert_eq!(v.samples, Samples::U16((0..60).collect()));
        assert_eq!(v.lattice.spacing(), [1.0; 3], "a resolution alone says nothing");
    }
}

#[test]
fn tiff_sample_types_and_imagej_and_ome_spacing() {
    let ij = "ImageJ=1.53\nimages=1\nunit=micron\nspacing=3\n";
    let v = open(one::<colortype::Gray32Float>(2, 1, &[-1.5, 2.0], ij)).unwrap();
    assert_eq!((v.file_type.as_str(), v.summary.range()), ("float32", (-1.5, 2.0)));
    let near = |got: [f64; 3], want: [f64; 3]| (0..3).all(|a| (got[a] - want[a]).abs() < 1e-12);
    assert!(near(v.lattice.spacing(), [0.25e-3, 0.5e-3, 3e-3]), "{:?}", v.lattice.spacing());
    let ome = "<?xml?><OME><Pixels SizeC=\"1\" SizeT=\"1\" SizeZ=\"1\" PhysicalSizeX=\"2\" \
               PhysicalSizeY=\"3\" PhysicalSizeZ=\"4\" PhysicalSizeZUnit=\"mm\"/></OME>";
    let v = open(one::<colortype::GrayI8>(2, 1, &[-1, 2], ome)).unwrap();
    assert_eq!(v.summary.range(), (-1.0, 2.0));
    assert!(near(v.lattice.spacing(), [2e-3, 3e-3, 4.0]), "{:?}", v.lattice.spacing());
    let e = open(one::<colortype::Gray8>(1, 1, &[1], "ImageJ=1\nimages=9\n")).unwrap_err();
    assert!(e.to_string().contains("9 pictures, and 1 pages"), "{e}");
    let e = open(one::<colortype::RGB8>(1, 1, &[1, 2, 3], "")).unwrap_err().to_string();
    assert!(
        e.contains(
            "a voxel is 3 colours (RGB), not one number; take one of them with --channel 0 to 2"
        ),
        "{e}"
    );
    let all = pages(2, Compression::Lzw);
    for cut in [8, 20, 60, all.len() / 2, all.len() - 1] {
        let e = open(all[..cut].to_vec()).unwrap_err();
        assert!(matches!(e.kind, OpenErrorKind::Damaged), "{cut}: {e}");
    }
}

/// Pages of 5 x 4 pixels of three colours: 3 i, 3 i + 1, 3 i + 2.
pub(crate) fn coloured(count: u16, text: &str) -> Vec<u8> {
    let mut out = Cursor::new(Vec::new());
    let mut tiff = TiffEncoder::new(&mut out).unwrap().with_compression(Compression::Lzw);
    for page in 0..count {
        let data: Vec<u16> = (0..60).map(|i| page * 60 + i).collect();
        let mut image = tiff.new_image::<colortype::RGB16>(5, 4).unwrap();
        if page == 0 && !text.is_empty() {
            image.encoder().write_tag(Tag::ImageDescription, text).unwrap();
        }
        image.rows_per_strip(3).unwrap();
        image.write_data(&data).unwrap();
    }
    out.into_inner()
}

#[test]
fn one_colour_of_a_tiff_is_taken_by_channel() {
    let blue = Pick { channel: Some(2), ..Pick::default() };
    let want = Samples::U16((0..60).map(|i| 3 * i + 2).collect());
    for text in [
        "",
        r#"{"shape": [3, 4, 5, 3], "axes": "ZYXS"}"#,
        "ImageJ=1.53\nimages=3\nslices=3\n",
        &ome("", "\"", "DimensionOrder=\"XYCZT\" SizeC=\"3\" SizeZ=\"3\" SizeT=\"1\""),
    ] {
        let (v, _) = picked(coloured(3, text), blue).unwrap_or_else(|e| panic!("{text}: {e}"));
        assert_eq!((v.lattice.dims, &v.samples), ([5, 4, 3], &want), "{text}");
        let e = noted(coloured(3, text)).unwrap_err().to_string();
        assert!(e.contains("a voxel is 3 colours (RGB)"), "{text}: {e}");
    }
    let dir = tempfile::tempdir().unwrap();
    for name in ["1.tif", "2.tif"] {
        std::fs::write(dir.path().join(name), coloured(1, "")).unwrap();
    }
    let hints = crate::Hints { pick: blue, ..crate::Hints::default() };
    let v = crate::open_with(dir.path(), &hints).unwrap().volume;
    assert_eq!(v.samples, Samples::U16((0..40).map(|i| 3 * (i % 20) + 2).collect()));
    let e = picked(coloured(1, ""), Pick { channel: Some(3), ..Pick::default() }).unwrap_err();
    assert!(e.to_string().contains("--channel: 3 is not there: the file has 3 channels"), "{e}");
}

#[test]
fn tiff_of_channels_one_after_another_and_of_half_floats_is_read() {
    // Planes of 4 x 3 bytes; as half floats, 0x3c00 is 1 and each more a 1024th.
    let mut planar = by_hand("", 3, 1, 1, 2);
    let edit = |bytes: &mut Vec<u8>, tag: u16, kind: u16, count: u32, value: u32| {
        let head = [&tag.to_le_bytes()[..], &kind.to_le_bytes()].concat();
        let at = bytes.windows(4).rposition(|w| w == head).unwrap();
        bytes[at + 4..at + 8].copy_from_slice(&count.to_le_bytes());
        bytes[at + 8..at + 12].copy_from_slice(&value.to_le_bytes());
    };
    // PlanarConfiguration in place of RowsPerStrip, which then is the whole page.
    edit(&mut planar, 277, 3, 1, 3);
    let at = planar.windows(4).rposition(|w| w == [0x16, 1, 3, 0]).unwrap();
    planar[at] = 0x1c;
    planar[at + 8] = 2;
    // StripByteCounts (279) must come before 284.
    let entries = planar[at..at + 24].to_vec();
    planar[at..at + 12].copy_from_slice(&entries[12..]);
    planar[at + 12..at + 24].copy_from_slice(&entries[..12]);
    for (tag, values) in [(273u16, [10u32, 22, 34]), (279, [12; 3])] {
        let place = planar.len() as u32;
        planar.extend(values.iter().flat_map(|n| n.to_le_bytes()));
        edit(&mut planar, tag, 4, 3, place);
    }
    let place = planar.len() as u32;
    planar.extend([8, 0, 8, 0, 8, 0]);
    edit(&mut planar, 258, 3, 3, place);
    for channel in 0..3 {
        let pick = Pick { channel: Some(channel), ..Pick::default() };
        let (v, _) = picked(planar.clone(), pick).unwrap();
        let first = 12 * channel as u8;
        assert_eq!(v.samples, Samples::U8((first..first + 12).collect()), "{channel}");
    }
    let mut half = by_hand("", 2, 2, 2, 1);
    // SampleFormat in place of SamplesPerPixel, and the last tag.
    while let Some(at) = half.windows(4).position(|w| w == [0x15, 1, 3, 0]) {
        let entries = half[at + 12..at + 36].to_vec();
        half[at..at + 24].copy_from_slice(&entries);
        half[at + 24..at + 36].copy_from_slice(&[0x53, 1, 3, 0, 1, 0, 0, 0, 3, 0, 0, 0]);
    }
    let data = half.windows(6).position(|w| w == [0, 0, 1, 0, 2, 0]).unwrap();
    (0..24).for_each(|i| half[data + 2 * i + 1] = 0x3c);
    let (v, _) = noted(half).unwrap();
    assert_eq!((v.lattice.dims, v.file_type.as_str()), ([4, 3, 2], "float16"));
    assert_eq!(v.samples, Samples::F32((0..24).map(|i| 1.0 + i as f32 / 1024.0).collect()));
}

#[test]
fn tiff_folder_is_sorted_by_number_and_must_have_pages_of_one_kind() {
    let dir = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| std::fs::write(dir.path().join(name), bytes).unwrap();
    for (name, value) in [("s 10.tif", 3), ("s 9.tif", 2), ("S 1.tiff", 1)] {
        put(name, &one::<colortype::Gray8>(2, 1, &[value, value], ""));
    }
    put("notes.txt", b"hello");
    let v = crate::open(dir.path()).unwrap();
    assert_eq!(v.lattice.dims, [2, 1, 3]);
    assert_eq!(v.samples, Samples::U8(vec![1, 1, 2, 2, 3, 3]));
    put("s 11.tif", &one::<colortype::Gray8>(1, 1, &[9], ""));
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("`s 11.tif`: is 1 x 1 uint8, where the first is 2 x 1 uint8"), "{e}");
    put("s 11.tif", &pages(2, Compression::Lzw));
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("s 11.tif"), "{e}");
}

/// A file of pages of 4 x 3 values 0, 1, 2, ... of uint8 or, with 2 `bytes`, uint16, with the
/// given text in the first. `pages` of its `planes` have a page of their own.
fn by_hand(text: &str, planes: u32, pages: u32, bytes: u16, photometric: u16) -> Vec<u8> {
    let plane = 12 * u32::from(bytes);
    let mut out = b"II*\0".to_vec();
    let data = 8 + text.len() as u32 + 1;
    let data = data + data % 2;
    let mut next = data + planes * plane;
    out.extend(next.to_le_bytes());
    out.extend(text.as_bytes());
    out.resize(data as usize, 0);
    for i in 0..planes * 12 {
        out.extend(&(i as u16).to_le_bytes()[..bytes.into()]);
    }
    for page in 0..pages {
        let mut tags: Vec<(u16, u16, u32, u32)> = vec![
            (256, 3, 1, 4),
            (257, 3, 1, 3),
            (258, 3, 1, 8 * u32::from(bytes)),
            (259, 3, 1, 1),
            (262, 3, 1, photometric.into()),
            (273, 4, 1, data + page * plane),
            (277, 3, 1, 1),
            (278, 3, 1, 3),
            (279, 4, 1, plane),
        ];
        if page == 0 {
            tags.insert(5, (270, 2, text.len() as u32 + 1, 8));
        }
        out.extend((tags.len() as u16).to_le_bytes());
        for (tag, kind, count, value) in &tags {
            out.extend(tag.to_le_bytes());
            out.extend(kind.to_le_bytes());
            out.extend(count.to_le_bytes());
            out.extend(value.to_le_bytes());
        }
        next += 6 + 12 * tags.len() as u32;
        out.extend(if page + 1 < pages { next } else { 0 }.to_le_bytes());
    }
    out
}

fn noted(bytes: Vec<u8>) -> Result<(Volume, String), Problem> {
    picked(bytes, Pick::default())
}

fn picked(bytes: Vec<u8>, pick: Pick) -> Result<(Volume, String), Problem> {
    let hints = crate::Hints { pick, ..crate::Hints::default() };
    let opened = crate::read_noted(Source::from_bytes(bytes), Path::new("."), "t.tif", &hints)?;
    Ok((opened.volume, opened.notes.join("\n")))
}

fn ome(prefix: &str, quote: &str, pixels: &str) -> String {
    format!("<?xml version=\"1.0\"?><{prefix}OME><{prefix}Image><{prefix}Pixels {pixels}></{prefix}Pixels></{prefix}Image></{prefix}OME>")
        .replace('"', quote)
}

#[test]
fn tiff_channels_and_times_are_axes_and_the_first_is_read() {
    let order =
        |order: &str| format!("DimensionOrder=\"{order}\" SizeC=\"2\" SizeZ=\"3\" SizeT=\"1\"");
    for (text, stride, say) in [
        (r#"{"shape": [2, 3, 3, 4], "axes": "CZYX"}"#.to_string(), 1, "the first of 2 channels"),
        (r#"{"shape": [2, 3, 3, 4], "axes": "TZYX"}"#.into(), 1, "the first of 2 times"),
        (r#"{"shape": [3, 2, 3, 4], "axes": "ZCYX"}"#.into(), 2, "the first of 2 channels"),
        (r#"{"axes": "TZCYX", "shape": [1, 3, 2, 3, 4]}"#.into(), 2, "the first of 2 channels"),
        (r#"{"shape": [2, 3, 3, 4]}"#.into(), 1, "the first of 2 along axis 0"),
        (r#"{"shape": [2, 3, 3, 4, 1]}"#.into(), 1, "the first of 2 along axis 0"),
        ("ImageJ=1.53\nimages=6\nchannels=2\nslices=3\nhyperstack=true\n".into(), 2, "2 channels"),
        ("ImageJ=1.53\nimages=6\nslices=3\nframes=2\nhyperstack=true\n".into(), 1, "2 times"),
        ("ImageJ=1.53\nimages=6\nchannels=2\n".into(), 2, "2 channels"),
        (ome("", "\"", &order("XYZCT")), 1, "the first of 2 channels"),
        (ome("ome:", "\"", &order("XYZCT")), 1, "the first of 2 channels"),
        (ome("", "'", &order("XYCZT")), 2, "the first of 2 channels"),
    ] {
        let (v, notes) =
            noted(by_hand(&text, 6, 6, 1, 1)).unwrap_or_else(|e| panic!("{text}: {e}"));
        assert_eq!(v.lattice.dims, [4, 3, 3], "{text}");
        let want = (0..3).flat_map(|z| (0..12).map(move |i| z * stride * 12 + i)).collect();
        assert_eq!(v.samples, Samples::U8(want), "{text}");
        assert!(notes.contains(say), "{text}: {notes}");
        let second = Pick { volume: Some(1), ..Pick::default() };
        let (v, notes) = picked(by_hand(&text, 6, 6, 1, 1), second).unwrap();
        let first = if stride == 1 { 3 } else { 1 };
        let want = (0..3).flat_map(|z| (0..12).map(move |i| (first + z * stride) * 12 + i));
        assert_eq!(v.samples, Samples::U8(want.collect()), "{text}");
        assert!(!notes.contains(say), "{text}: {notes}");
    }
    // Frames alone are no slices.
    let (v, notes) =
        noted(by_hand("{\"shape\": [6, 3, 4], \"axes\": \"TYX\"}", 6, 6, 1, 1)).unwrap();
    assert_eq!(v.lattice.dims, [4, 3, 1]);
    assert!(notes.contains("the first of 6 times"), "{notes}");
    // Slices alone, and a text whose pages have changed.
    for text in [
        "{\"shape\": [6, 3, 4]}",
        "{\"shape\": [6, 3, 4], \"axes\": \"QYX\"}",
        "{\"shape\": [9, 9, 9]}",
        "ImageJ=1\nimages=1\n",
        "{\"shape\": null}",
    ] {
        let (v, notes) = noted(by_hand(text, 6, 6, 1, 1)).unwrap();
        assert_eq!((v.lattice.dims, notes.as_str()), ([4, 3, 6], ""), "{text}");
    }
    // If the layout is missing or does not fit, the refusal tells it.
    for (text, say) in [
        ("{\"shape\": [2, 5, 3, 4], \"axes\": \"CZYX\"}", "2 channels or times of 5 slices"),
        ("{\"shape\": [6, 3, 4], \"axes\": \"ZXY\"}", "the axes `ZXY`, whose last are not Y and X"),
        ("ImageJ=1\nimages=7\nchannels=2\n", "which don't divide"),
    ] {
        let e = noted(by_hand(text, 6, 6, 1, 1)).unwrap_err().to_string();
        assert!(e.contains("ImageDescription") && e.contains(say), "{text}: {e}");
    }
    // Pages told one by one, in another order than that of the dimensions.
    let told = ome("", "\"", &order("XYZCT"))
        .replace("</Pixels>", "<TiffData FirstC=\"0\" FirstZ=\"1\" IFD=\"2\"/></Pixels>");
    let e = noted(by_hand(&told, 6, 6, 1, 1)).unwrap_err().to_string();
    assert!(e.contains("not in the order `XYZCT`"), "{e}");
}

#[test]
fn tiff_planes_without_pages_are_all_read() {
    for (text, stride) in [
        ("{\"shape\": [6, 3, 4], \"truncated\": true}", 1),
        ("ImageJ=1.53\nimages=6\nslices=6\n", 1),
        ("ImageJ=1.53\nimages=12\nchannels=2\nslices=6\n", 2),
    ] {
        let planes = 6 * stride;
        let (v, _) = noted(by_hand(text, planes, 1, 2, 1)).unwrap();
        assert_eq!(v.lattice.dims, [4, 3, 6], "{text}");
        let want =
            (0..6).flat_map(|z| (0..12).map(move |i| (z * stride * 12 + i) as u16)).collect();
        assert_eq!(v.samples, Samples::U16(want), "{text}");
    }
    // More than the file has.
    let text = "{\"shape\": [600, 3, 4], \"truncated\": true}";
    let e = noted(by_hand(text, 6, 1, 2, 1)).unwrap_err().to_string();
    assert!(e.contains("so 600 pictures, and 1 pages are there"), "{e}");
}

#[test]
fn tiff_white_is_zero_and_palette_keep_stored_values() {
    for bytes in [1, 2] {
        for (photometric, say) in [(0, "0 is white"), (3, "the stored indices were read"), (1, "")]
        {
            let (v, notes) = noted(by_hand("", 3, 3, bytes, photometric)).unwrap();
            let codes: Vec<f64> = (0..36).map(|i| v.summary.map.value(v.samples.code(i))).collect();
            assert_eq!(codes, (0..36).map(f64::from).collect::<Vec<_>>(), "{photometric}");
            assert!(notes.contains(say) && notes.is_empty() == say.is_empty(), "{notes}");
        }
    }
}

#[test]
fn ome_tiff_step_that_is_missing_or_without_known_unit_goes_by_x_and_is_noted() {
    let x_and_y = "SizeZ=\"3\" PhysicalSizeX=\"0.5\" PhysicalSizeY=\"0.5\"";
    for (z, want, say) in [
        ("", 0.5e-3, "does not say the step along z; that of x was taken"),
        ("PhysicalSizeZ=\"0\"", 0.5e-3, "does not say the step along z"),
        ("PhysicalSizeZ=\"0.75\"", 0.75e-3, ""),
        ("PhysicalSizeZ=\"5e-06\" PhysicalSizeZUnit=\"dm\"", 0.5e-3, ""),
        ("PhysicalSizeZ=\"7500\" PhysicalSizeZUnit=\"\u{c5}\"", 0.75e-3, ""),
        ("PhysicalSizeZ=\"2\" PhysicalSizeZUnit=\"reference frame\"", 2e-3, "no known length"),
    ] {
        let text = ome("", "\"", &format!("{x_and_y} {z}"));
        let (v, notes) = noted(by_hand(&text, 3, 3, 1, 1)).unwrap();
        let got = v.lattice.spacing();
        assert!((got[2] / want - 1.0).abs() < 1e-9 && got[0] == 0.5e-3, "{z}: {got:?}");
        assert!(notes.contains(say) && notes.is_empty() == say.is_empty(), "{z}: {notes}");
    }
}

/// A TIFF file of one strip, by hand: the `tiff` crate writes no pixels of fewer than 8 bits.
fn few_bits(bits: u16, photometric: u16, width: u16, rows: &[u8]) -> Vec<u8> {
    let mut out = b"II*\0\x08\0\0\0".to_vec();
    let height = rows.len() / (usize::from(width * bits)).div_ceil(8);
    let palette = 3 << bits;
    let entries: [(u16, u16, u32, u32); 9] = [
        (256, 3, 1, width.into()),
        (257, 3, 1, height as u32),
        (258, 3, 1, bits.into()),
        (259, 3, 1, 1),
        (262, 3, 1, photometric.into()),
        (273, 4, 1, 122),
        (278, 3, 1, height as u32),
        (279, 4, 1, rows.len() as u32),
        (320, 3, palette, 200),
    ];
    let entries = &entries[..if photometric == 3 { 9 } else { 8 }];
    out.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in entries {
        out.extend(tag.to_le_bytes());
        out.extend(kind.to_le_bytes());
        out.extend(count.to_le_bytes());
        out.extend(value.to_le_bytes());
    }
    out.extend([0; 4]);
    out.resize(122, 0);
    out.extend(rows);
    out.resize(200 + 2 * palette as usize, 0);
    out
}

#[test]
fn tiff_of_few_bits_and_with_a_palette_keeps_stored_values() {
    let open = |bytes: Vec<u8>| {
        let opened = super::read(Source::from_bytes(bytes), "a.tif", &RawHints::default())?;
        let v = opened.volume;
        let codes: Vec<f64> =
            (0..v.samples.len()).map(|i| v.summary.map.value(v.samples.code(i))).collect();
        Ok::<_, Problem>((v.lattice.dims, codes))
    };
    for photometric in [0, 1, 3] {
        let (dims, codes) = open(few_bits(1, photometric, 10, &[0xa0, 0x40, 0x01, 0x80])).unwrap();
        assert_eq!(dims, [10, 2, 1]);
        assert_eq!(codes[..10], [1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]);
        assert_eq!(codes[10..], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0]);
        let (_, codes) = open(few_bits(4, photometric, 3, &[0x1f, 0x70])).unwrap();
        assert_eq!(codes, [1.0, 15.0, 7.0], "photometric {photometric}");
        let (_, codes) = open(few_bits(2, photometric, 5, &[0x1b, 0x40])).unwrap();
        assert_eq!(codes, [0.0, 1.0, 2.0, 3.0, 1.0]);
    }
}
