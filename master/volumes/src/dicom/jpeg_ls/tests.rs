use super::*;

/// Returns a picture of 20 x 12 pixels of `bits` bits: flat, with two levels; rough; smooth.
fn picture(bits: u32) -> Vec<i64> {
    let most = (1i64 << bits) - 1;
    let pixel = |x: i64, y: i64| match y {
        0..4 => (if x < 13 { 7 } else { 9 }).min(most),
        4..8 => (x * x * 37 + y * y * 91) % (most + 1),
        _ => (x * y * most / 200).min(most),
    };
    (0..12).flat_map(|y| (0..20).map(move |x| pixel(x, y))).collect()
}

fn bytes(hex: &str) -> Vec<u8> {
    let hex: Vec<u8> = hex.bytes().filter(u8::is_ascii_hexdigit).collect();
    let byte = |two: &[u8]| u8::from_str_radix(std::str::from_utf8(two).unwrap(), 16).unwrap();
    hex.chunks(2).map(byte).collect()
}

/// The picture as CharLS 2.4 encodes it: bits, largest error, bytes.
pub(crate) const ENCODED: [(u32, i64, &str); 6] = [
    (
        2,
        0,
        "\
        ffd8fff7000b02000c001401011100ffda000801010000000057ff7fbfff70ceeeeeeeeeff7fff7fff56b5db \
        bfff5fff7fff7ff42eff569cecddf2edf8f7a3c2ffd9 \
    ",
    ),
    (
        8,
        0,
        "\
        ffd8fff7000b08000c001401011100ffda00080101000000000b2bfe3fcff13e375a000003560000503b2943 \
        00000199153f2b8d244a20000034a000003880010000005847578ba6f00000165000028081959848cbed446d \
        8197e4605d86000000b2f8ca29800b2c35f800b3aaed37161be7c8c451045a358a23df12cf5581645f43b800 \
        0009a000000e4ac2b30c5c02050000001f0cac7ed0187b00000189f610323194a0c518410c6211c8060249a9 \
        10919884767771cb0894b12e633b9999999690ffd9 \
    ",
    ),
    (
        12,
        0,
        "\
        ffd8fff7000b0c000c001401011100ffda00080101000000004d81041084211111171112481fe207c60eb040 \
        00000006d41245b3b47f9911231b50a396c9b59fe8000001980000003d0edc2490b6c36d2ff9a44000001992 \
        85e3c0023001684b1df00002a89a0de041425c132be80969961994c40000000cc3d0486d1d8413454080fa49 \
        b0ad4bf8d4efa4f6cf70fa658a7b61e814ea04082014f3887a24344c655861529e3893d21194a785122a09ad \
        4005501e356b3e80188e50f5107199000000006c440a35cf40c20e9d4624d000000000cba54681a949e0c026 \
        3d09a308e859966589605796a599645881ca0664c742d6e3c08425caa2f8bd2f0ba2e8c5310c23082620cc8c \
        d852d3733e48c284b431cc6314c5354d434cd35380ffd9 \
    ",
    ),
    (
        16,
        0,
        "\
        ffd8fff7000b10000c001401011100fff8000d01ffff0012004301140040ffda000801010000000040d80100 \
        40100804020101010101010701010102040801fe2007c600eb0040ea31266dedbffa91646ed491cb64dacff5 \
        a99ce876e124936cada5ff1a4599a254deae181b4d72cf7c8a09c4ae8c0ccb0cacca8ca4ca0c9cc98cccfa11 \
        22dadb30267ee21e890d13195617a99f1c39e81e89e81e79e71f40a75235adb4602cc5bd3c320c25529e2e73 \
        303793c210589504ee27614e8036d8218079c00270002740428042404220422041e041e041a04183060c1430 \
        50c103038c0e0474801a432c3cf1394c5677212e45ff0e8c3a28e883a18e843a10e8039f8e7c39e8f02801a3 \
        3233c69350c3476112a05ef1cd423e047b08f411e023c047708ec11d023a04c8401a331abbe1308c14750125 \
        85dd1c9023585b10b6216bc2d705ae36b0dac36a9a28ffd9 \
    ",
    ),
    (
        8,
        2,
        "\
        ffd8fff7000b08000c001401011100ffda000801010002000077ff37eff17c7d70000040305bd10000005d39 \
        cf9f698000400006040047d8a9100200c18aa8600181a60d893a51388005a0674129e5439043ee8c00b1853e \
        5cd153a000d1f00000a91f3d45c300000069d6a0231ce000000e70923970000005bd9094510911111111088a \
        a522492492224459a244a924924affd9 \
    ",
    ),
    (
        12,
        5,
        "\
        ffd8fff7000b0c000c001401011100ffda00080101000500004c4abfff47ff7e000000000609e58f3e361735 \
        118cc7a1595cca773f89a2c8d63a80001dc605010030a8d8003c361f138a8573b150a8571b00000c3b728404 \
        3f44ad9c9f8949d5b1d0e8b76f1d0f42d44486c232a31383e245b06439315b02a364790090654923c00e2e17 \
        33000000cc0b0961c1cd62380000006ce46214e28e69e2048810204081024402a110c714b30e102448912244 \
        8a1428522729c424b34e102850a142848c18b0ffd9 \
    ",
    ),
];

/// Returns the encoded pictures, for the mutants of `fuzz.rs`.
pub(crate) fn encoded_pictures() -> Vec<Vec<u8>> {
    ENCODED.iter().map(|(_, _, hex)| bytes(hex)).collect()
}

/// Decodes a picture of any size, for the mutants of `fuzz.rs`.
pub(crate) fn one_jpeg_ls(file: &[u8]) -> Result<Vec<u8>, Problem> {
    let (parameters, _) = Parameters::read(file)?;
    unpack(file, (parameters.width.min(16384), parameters.height.min(16384)), 2)
}

#[test]
fn jpeg_ls_gives_every_bit_or_stays_within_its_error() {
    for (bits, near, hex) in ENCODED {
        let size = if bits <= 8 { 1 } else { 2 };
        let out = unpack(&bytes(hex), (20, 12), size).unwrap_or_else(|e| panic!("{bits}: {e}"));
        let got =
            out.chunks(size).map(|w| i64::from(w[0]) + w.get(1).map_or(0, |h| 256 * i64::from(*h)));
        let off = got.zip(picture(bits)).map(|(got, want)| (got - want).abs()).max();
        assert!(off.is_some_and(|off| off <= near), "{bits} bits: off by {off:?}, not {near}");
    }
}

#[test]
fn jpeg_ls_errors_say_what_is_wrong() {
    let good = bytes(ENCODED[2].2);
    let put = |at: usize, value: u8| {
        let mut file = good.clone();
        file[at] = value;
        file
    };
    let frame = good.windows(2).position(|w| w == [0xff, 0xf7]).unwrap();
    for (file, size, say) in [
        (good.clone(), (20, 13), "has 20 x 12 pixels, where Columns and Rows say 20 x 13"),
        (good[..good.len() - 30].to_vec(), (20, 12), "ends early"),
        (good[..40].to_vec(), (20, 12), "has"),
        (vec![0xff, 0xd8, 0xff], (20, 12), "has no scan"),
        (vec![], (20, 12), "has no beginning"),
        (put(frame + 9, 3), (20, 12), "is JPEG-LS of 3 colours"),
        (put(frame + 4, 1), (20, 12), "1 bits, which is not read"),
    ] {
        let e = unpack(&file, size, 2).unwrap_err().to_string();
        assert!(e.starts_with("PixelData: ") && e.contains(say), "{e}");
    }
    let e = unpack(&good, (20, 12), 1).unwrap_err().to_string();
    assert!(e.contains("has wider numbers than the 8 bits allocated"), "{e}");
}
