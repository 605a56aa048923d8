use slabcast_common::volume::{Samples, Volume};

/// Returns a PNG picture of `width` x `height` pixels from raw rows.
pub(crate) fn png(
    (width, height): (u32, u32),
    (colour, depth): (::png::ColorType, ::png::BitDepth),
    palette: Option<&[u8]>,
    rows: &[u8],
) -> Vec<u8> {
    let mut out = Vec::new();
    let mut encoder = ::png::Encoder::new(&mut out, width, height);
    encoder.set_color(colour);
    encoder.set_depth(depth);
    if let Some(palette) = palette {
        encoder.set_palette(palette.to_vec());
    }
    let mut writer = encoder.write_header().unwrap();
    writer.write_image_data(rows).unwrap();
    writer.finish().unwrap();
    out
}

use ::png::BitDepth::{Eight, Four, One, Sixteen};
use ::png::ColorType::{Grayscale, GrayscaleAlpha, Indexed, Rgb, Rgba};

/// Returns a baseline JPEG of 16 x 8 pixels: one block of 50 and one of 200.
pub(crate) fn jpeg(colours: bool) -> Vec<u8> {
    let mut out = vec![0xff, 0xd8];
    // A table of quantisation of ones.
    out.extend([0xff, 0xdb, 0, 67, 0]);
    out.extend([1; 64]);
    let components: u8 = if colours { 3 } else { 1 };
    out.extend([0xff, 0xc0, 0, 8 + 3 * components, 8, 0, 8, 0, 16, components]);
    (1..=components).for_each(|c| out.extend([c, 0x11, 0]));
    // Codes of DC: 00 for no bits, 01 for 10 bits, 10 for 11 bits. Of AC: 0 for the end of a block.
    out.extend([
        0xff, 0xc4, 0, 22, 0x00, 0, 3, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 10, 11,
    ]);
    out.extend([0xff, 0xc4, 0, 20, 0x10, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]);
    out.extend([0xff, 0xda, 0, 6 + 2 * components, components]);
    (1..=components).for_each(|c| out.extend([c, 0]));
    out.extend([0, 63, 0]);
    // DC is eight times the level below or above 128: -624, then 1200 more.
    let mut bits = String::new();
    for difference in [-624i32, 1200] {
        let (code, size) = if difference == -624 { ("01", 10) } else { ("10", 11) };
        let value = if difference < 0 { difference + (1 << size) - 1 } else { difference };
        bits.push_str(&format!("{code}{value:0size$b}0"));
        (1..components).for_each(|_| bits.push_str("000"));
    }
    end_scan(&mut out, bits);
    out
}

/// Writes the bits of a JPEG's scan, padded with ones and with a zero after each 0xff (ITU-T T.81,
/// section F.1.2.3), and the end of the image.
pub(crate) fn end_scan(out: &mut Vec<u8>, mut bits: String) {
    while !bits.len().is_multiple_of(8) {
        bits.push('1');
    }
    for byte in bits.as_bytes().chunks(8) {
        let byte = u8::from_str_radix(std::str::from_utf8(byte).unwrap(), 2).unwrap();
        out.push(byte);
        if byte == 0xff {
            out.push(0);
        }
    }
    out.extend([0xff, 0xd9]);
}

/// Puts files into a folder and opens it.
fn open(files: &[(&str, Vec<u8>)]) -> Result<(Volume, String), String> {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    match crate::open_with(folder.path(), &crate::Hints::default()) {
        Ok(opened) => Ok((opened.volume, opened.notes.join("\n"))),
        Err(e) => Err(e.problem.to_string()),
    }
}

fn bytes(v: &Volume) -> Vec<u8> {
    let Samples::U8(bytes) = &v.samples else { panic!("{:?}", v.file_type) };
    bytes.clone()
}

#[test]
fn folder_of_grey_png_pictures_is_a_stack_in_the_order_of_numbers() {
    let slice = |n: u8| png((3, 2), (Grayscale, Eight), None, &[n, 1, 2, 3, 4, 5]);
    let files = [("s10.png", slice(30)), ("s9.png", slice(20)), ("s1.PNG", slice(10))];
    let (v, notes) = open(&files).unwrap();
    assert_eq!(v.lattice.dims, [3, 2, 3]);
    let all = bytes(&v);
    assert_eq!((all[0], all[6], all[12], all[17]), (10, 20, 30, 5));
    assert_eq!(notes, "pictures have no spacing; 1 mm was taken (--spacing sets it)");
    let wide: Vec<u8> = (0..6u16).flat_map(|i| (i * 300).to_be_bytes()).collect();
    let (v, _) = open(&[("a.png", png((3, 2), (Grayscale, Sixteen), None, &wide))]).unwrap();
    assert_eq!(v.summary.map.value(v.samples.code(5)), 1500.0);
}

#[test]
fn png_in_colours_is_grey_only_if_all_its_pixels_are() {
    let grey: Vec<u8> = (0..6).flat_map(|i| [i * 9; 3]).collect();
    let (v, _) = open(&[("a.png", png((3, 2), (Rgb, Eight), None, &grey))]).unwrap();
    assert_eq!(bytes(&v), [0, 9, 18, 27, 36, 45]);
    let rgba: Vec<u8> = (0..6).flat_map(|i| [i, i, i, 255 - i]).collect();
    let (v, notes) = open(&[("a.png", png((3, 2), (Rgba, Eight), None, &rgba))]).unwrap();
    assert_eq!(bytes(&v), [0, 1, 2, 3, 4, 5]);
    assert!(notes.contains("transparency of pixels was not read"), "{notes}");
    let alpha: Vec<u8> = (0..6).flat_map(|i| [i, 255]).collect();
    let (v, notes) =
        open(&[("a.png", png((3, 2), (GrayscaleAlpha, Eight), None, &alpha))]).unwrap();
    assert_eq!(bytes(&v), [0, 1, 2, 3, 4, 5]);
    assert!(!notes.contains("transparency"), "{notes}");
    let mut red = grey.clone();
    red[15] = 200;
    let (v, _) = open(&[("a.png", png((3, 2), (Rgb, Eight), None, &red))]).unwrap();
    assert_eq!(v.file_type, "RGB uint8");
}

#[test]
fn png_of_few_bits_and_with_a_palette_keeps_stored_values() {
    let (v, _) =
        open(&[("a.png", png((10, 1), (Grayscale, One), None, &[0b1010_0000, 0x40]))]).unwrap();
    assert_eq!(bytes(&v), [1, 0, 1, 0, 0, 0, 0, 0, 0, 1]);
    let (v, _) = open(&[("a.png", png((3, 1), (Grayscale, Four), None, &[0x1f, 0x70]))]).unwrap();
    assert_eq!(bytes(&v), [1, 15, 7]);
    let colours = [0, 0, 0, 255, 0, 0, 7, 7, 7];
    let label = |palette: &[u8]| png((3, 1), (Indexed, Eight), Some(palette), &[2, 1, 0]);
    let (v, notes) = open(&[("a.png", label(&colours))]).unwrap();
    assert_eq!(bytes(&v), [2, 1, 0]);
    assert!(notes.contains("the stored indices were read"), "{notes}");
    let greys = [5, 5, 5, 6, 6, 6, 9, 9, 9];
    let (v, notes) = open(&[("a.png", label(&greys))]).unwrap();
    assert_eq!(bytes(&v), [9, 6, 5]);
    assert!(!notes.contains("indices"), "{notes}");
    let e = open(&[("a.png", label(&colours)), ("b.png", label(&greys))]).unwrap_err();
    assert!(e.contains("`b.png`: has another palette than the first"), "{e}");
}

#[test]
fn jpeg_stack_opens_grey_and_grey_in_colours() {
    for colours in [false, true] {
        let (v, _) = open(&[("a.jpg", jpeg(colours)), ("b.jpg", jpeg(colours))]).unwrap();
        assert_eq!(v.lattice.dims, [16, 8, 2]);
        let all = bytes(&v);
        assert!(all.chunks(16).all(|row| row[..8] == [50; 8] && row[8..] == [200; 8]), "{all:?}");
    }
    let grey = || png((16, 8), (Grayscale, Eight), None, &[0; 128]);
    let (v, notes) = open(&[("a.jpg", jpeg(false)), ("b.png", grey())]).unwrap();
    assert_eq!(v.lattice.dims, [16, 8, 1]);
    assert!(notes.contains("1 JPEG pictures beside the PNG ones were not read"), "{notes}");
}

#[test]
fn stack_of_unequal_or_broken_pictures_is_refused_by_name() {
    let good = || png((3, 2), (Grayscale, Eight), None, &[0, 1, 2, 3, 4, 5]);
    let other = png((2, 2), (Grayscale, Eight), None, &[0, 1, 2, 3]);
    let e = open(&[("a.png", good()), ("b.png", other)]).unwrap_err();
    assert!(e.contains("`b.png`: is 2 x 2 uint8, where the first is 3 x 2 uint8; make all"), "{e}");
    let e = open(&[("a.png", good()), ("b.nii.gz", vec![1])]).unwrap_err();
    assert!(
        e.contains("holds pictures and volume files; give the file `b.nii.gz` in it, or"),
        "{e}"
    );
    let cut = good()[..45].to_vec();
    let e = open(&[("a.png", good()), ("b.png", cut)]).unwrap_err();
    assert!(e.contains("`b.png` picture: ") && e.contains("get the"), "{e}");
    let whole = jpeg(false);
    let e = open(&[("a.jpg", whole[..whole.len() - 5].to_vec())]).unwrap_err();
    assert!(e.contains("`a.jpg` picture: is truncated or damaged"), "{e}");
}

#[test]
fn one_colour_of_a_stack_of_pictures_is_taken_by_channel() {
    let folder = tempfile::tempdir().unwrap();
    let rgb: Vec<u8> = (0..6).flat_map(|i| [i, 10 + i, 20 + i]).collect();
    let wide: Vec<u8> = rgb.iter().flat_map(|b| [*b, 1]).collect();
    let rgba: Vec<u8> = (0..6).flat_map(|i| [i, 10 + i, 20 + i, 30 + i]).collect();
    let put = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    let open = |channel| {
        let pick = crate::Pick { channel: Some(channel), ..crate::Pick::default() };
        let hints = crate::Hints { pick, ..crate::Hints::default() };
        crate::open_with(folder.path(), &hints).map(|opened| opened.volume)
    };
    for n in ["1.png", "2.png"] {
        put(n, &png((3, 2), (Rgb, Sixteen), None, &wide));
    }
    assert_eq!(
        open(2).unwrap().samples,
        Samples::U16((0..12).map(|i| (20 + i % 6) << 8 | 1).collect())
    );
    let e = open(3).unwrap_err().to_string();
    assert!(e.contains("--channel: 3 is not there: the file has 3 channels; give 0 to 2"), "{e}");
    for n in ["1.png", "2.png"] {
        put(n, &png((3, 2), (Rgba, Eight), None, &rgba));
    }
    assert_eq!(bytes(&open(3).unwrap())[..6], [30, 31, 32, 33, 34, 35]);
    let jpegs = tempfile::tempdir().unwrap();
    std::fs::write(jpegs.path().join("a.jpg"), jpeg(true)).unwrap();
    let pick = crate::Pick { channel: Some(1), ..crate::Pick::default() };
    let hints = crate::Hints { pick, ..crate::Hints::default() };
    let v = crate::open_with(jpegs.path(), &hints).unwrap().volume;
    assert!(bytes(&v).chunks(16).all(|row| row[..8] == [50; 8] && row[8..] == [200; 8]));
}

#[test]
fn folder_of_pictures_holds_one_volume() {
    let folder = tempfile::tempdir().unwrap();
    let picture = png((3, 2), (Grayscale, Eight), None, &[0, 1, 2, 3, 4, 5]);
    std::fs::write(folder.path().join("a.png"), picture).unwrap();
    let pick = |n| crate::Hints {
        pick: crate::Pick { volume: Some(n), ..crate::Pick::default() },
        ..crate::Hints::default()
    };
    assert!(crate::open_with(folder.path(), &pick(0)).is_ok());
    let e = crate::open_with(folder.path(), &pick(1)).unwrap_err().to_string();
    assert!(e.contains("--volume: 1 is not there: the file has 1 volume; leave it out"), "{e}");
}

#[test]
fn grey_and_opacity_are_two_channels_and_opacity_among_colours_is_the_fourth() {
    let folder = tempfile::tempdir().unwrap();
    let put = |name: &str, bytes: &[u8]| std::fs::write(folder.path().join(name), bytes).unwrap();
    let open = |channel| {
        let pick = crate::Pick { channel, ..crate::Pick::default() };
        let hints = crate::Hints { pick, ..crate::Hints::default() };
        crate::open_with(folder.path(), &hints).map(|opened| opened.volume)
    };
    let both: Vec<u8> = (0..6).flat_map(|i| [i, 30 + i]).collect();
    put("1.png", &png((3, 2), (GrayscaleAlpha, Eight), None, &both));
    assert_eq!(bytes(&open(Some(0)).unwrap()), [0, 1, 2, 3, 4, 5]);
    assert_eq!(bytes(&open(Some(1)).unwrap()), [30, 31, 32, 33, 34, 35]);
    let e = open(Some(2)).unwrap_err().to_string();
    assert!(e.contains("--channel: 2 is not there: the file has 2 channels"), "{e}");
    let rgb: Vec<u8> = (0..6).flat_map(|i| [i, 10 + i, 20 + i]).collect();
    put("2.png", &png((3, 2), (Rgb, Eight), None, &rgb));
    let blue = [0, 1, 2, 3, 4, 5, 20, 21, 22, 23, 24, 25];
    assert_eq!(bytes(&open(Some(2)).unwrap()), blue);
    let alpha = [30, 31, 32, 33, 34, 35, 255, 255, 255, 255, 255, 255];
    assert_eq!(bytes(&open(Some(3)).unwrap()), alpha);
    assert_eq!(open(None).unwrap().file_type, "RGBA uint8");
}
