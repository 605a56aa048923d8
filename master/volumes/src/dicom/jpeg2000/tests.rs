use super::*;

/// Pictures of 33 x 32 pixels that OpenJPEG 2.5 encoded: bits, whether signed, bytes.
pub(crate) const ENCODED: [(u8, bool, &[u8]); 7] = [
    (8, false, include_bytes!("unsigned_8.j2k")),
    (8, true, include_bytes!("signed_8.j2k")),
    (12, false, include_bytes!("unsigned_12.j2k")),
    (12, true, include_bytes!("signed_12.j2k")),
    (16, false, include_bytes!("unsigned_16.j2k")),
    (16, true, include_bytes!("signed_16.j2k")),
    // As a file of JP2, in tiles of 20 x 16 with precincts.
    (8, false, include_bytes!("tiles_8.jp2")),
];
/// The picture of 12 bits with loss, at an eighth of its size.
const LOSSY: &[u8] = include_bytes!("lossy_12.j2k");
const SIZE: (u16, u16) = (33, 32);

/// The picture that was encoded: flat, rough, smooth; over the whole range of its bits.
fn picture(bits: u8, signed: bool) -> Vec<i32> {
    let most = (1i32 << bits) - 1;
    let pixel = |x: i32, y: i32| match y {
        0..10 => {
            if x < 13 {
                most
            } else {
                most / 3
            }
        }
        10..12 => (x * x * 37 + y * y * 91) % (most + 1),
        _ => x * y * most / 1023,
    };
    let shift = if signed { 1 << (bits - 1) } else { 0 };
    (0..32).flat_map(|y| (0..33).map(move |x| pixel(x, y) - shift)).collect()
}

/// Returns the numbers of little-endian bytes.
fn numbers(bytes: &[u8], size: usize, signed: bool) -> Vec<i32> {
    let number = |b: &[u8]| match (size, signed) {
        (1, false) => b[0].into(),
        (1, true) => (b[0] as i8).into(),
        (2, false) => u16::from_le_bytes([b[0], b[1]]).into(),
        (2, true) => i16::from_le_bytes([b[0], b[1]]).into(),
        _ => i32::from_le_bytes([b[0], b[1], b[2], b[3]]),
    };
    bytes.chunks_exact(size).map(number).collect()
}

/// Decodes one picture, for the mutants of `fuzz.rs`.
pub(crate) fn one_jpeg_2000(bytes: &[u8]) -> Result<(), Problem> {
    unpack(bytes.to_vec(), SIZE, 2, false).map(|_| ())
}

#[test]
fn lossless_jpeg_2000_gives_every_bit() {
    for (bits, signed, file) in ENCODED {
        for size in [1, 2, 4].into_iter().filter(|size| 8 * size >= usize::from(bits)) {
            let out = unpack(file.to_vec(), SIZE, size, signed).unwrap();
            assert_eq!(
                numbers(&out, size, signed),
                picture(bits, signed),
                "{bits} {signed} {size}"
            );
        }
    }
}

#[test]
fn jpeg_2000_with_loss_is_near() {
    let out = numbers(&unpack(LOSSY.to_vec(), SIZE, 2, false).unwrap(), 2, false);
    // OpenJPEG gives these.
    for (x, y, value) in [(0, 5, 4095i32), (0, 31, 185), (4, 31, 372), (20, 20, 1631)] {
        assert!((out[y * 33 + x] - value).abs() <= 1, "{x} {y}: {}", out[y * 33 + x]);
    }
}

#[test]
fn picture_whose_sign_differs_from_the_file_keeps_its_bits() {
    // As in J2K_pixelrep_mismatch.dcm: 12 bits without sign, where the file says that there is one.
    let out = unpack(ENCODED[2].2.to_vec(), SIZE, 2, true).unwrap();
    let want = picture(12, false).into_iter().map(|v| if v > 2047 { v - 4096 } else { v });
    assert_eq!(numbers(&out, 2, true), want.collect::<Vec<_>>());
    let out = unpack(ENCODED[3].2.to_vec(), SIZE, 2, false).unwrap();
    let want = picture(12, true).into_iter().map(|v| v & 4095);
    assert_eq!(numbers(&out, 2, false), want.collect::<Vec<_>>());
}

/// Returns where the first tile-part begins.
fn first_tile(file: &[u8]) -> usize {
    file.windows(4).position(|w| w == [0xff, SOT, 0, 10]).unwrap()
}

#[test]
fn padding_a_missing_end_and_an_open_length_are_read() {
    let good = ENCODED[2].2;
    let want = unpack(good.to_vec(), SIZE, 2, false).unwrap();
    let mut open = [good, &[0]].concat();
    let at = first_tile(&open) + 6;
    open[at..at + 4].fill(0);
    for file in [[good, &[0]].concat(), good[..good.len() - 2].to_vec(), open] {
        assert_eq!(unpack(file, SIZE, 2, false).unwrap(), want);
    }
}

#[test]
fn jpeg_2000_errors_say_what_is_wrong() {
    let good = ENCODED[2].2;
    let with = |at: usize, bytes: &[u8]| {
        let mut file = good.to_vec();
        file[at..at + bytes.len()].copy_from_slice(bytes);
        file
    };
    let cod = good.windows(2).position(|w| w == [0xff, COD]).unwrap();
    let mut tiles = ENCODED[6].2.to_vec();
    let second = tiles.windows(4).rposition(|w| w == [0xff, SOT, 0, 10]).unwrap();
    tiles[second + 5] = 0;
    for (file, sizes, size, say) in [
        (good.to_vec(), (32, 32), 2, "has 33 x 32 pixels, where Columns and Rows say 32 x 32"),
        (good.to_vec(), SIZE, 1, "has 12 bits, where BitsAllocated says 8"),
        (good[..good.len() - 9].to_vec(), SIZE, 2, "ends early; get the file again"),
        (good[..30].to_vec(), SIZE, 2, "ends inside its header"),
        (with(40, &[0, 3]), SIZE, 2, "is JPEG 2000 of 3 colours, which is not read"),
        (with(42, &[23]), SIZE, 2, "of 24 bits a pixel, which is not read; convert it"),
        (with(24, &[0, 0, 0, 1, 0, 0, 0, 1]), SIZE, 2, "has 1056 tiles, more than fit"),
        (with(cod + 12, &[0x40]), SIZE, 2, "of high throughput, which is not read"),
        (tiles, SIZE, 2, "ends early"),
        (b"\xff\xd8\xff".to_vec(), SIZE, 2, "does not begin like one"),
    ] {
        let e = unpack(file, sizes, size, false).unwrap_err().to_string();
        assert!(e.starts_with("PixelData: ") && e.contains(say), "{say}: {e}");
    }
    // Sizes that would take much memory are refused before any is taken.
    let large = with(8, &[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
    let e = unpack(large, (16384, 16384), 2, false).unwrap_err().to_string();
    assert!(e.contains("is JPEG 2000 of 16384 x 16384 pixels, which is not read"), "{e}");
    let empty = with(8, &[0, 0, 0x10, 0x00, 0, 0, 0x10, 0x01]);
    let e = unpack(empty, (4096, 4097), 2, false).unwrap_err().to_string();
    assert!(e.contains("is too short for its size"), "{e}");
    // Precincts of one pixel each.
    let mut precincts = with(cod + 4, &[1]);
    precincts[cod + 3] += 6;
    precincts.splice(cod + 14..cod + 14, [0; 6]);
    let e = unpack(precincts, SIZE, 2, false).unwrap_err().to_string();
    assert!(e.contains("precincts, more than fit into its bytes"), "{e}");
}
