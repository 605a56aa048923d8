use super::*;
use slabcast_common::volume::Samples;

fn open(name: &str, hints: &RawHints, bytes: &[u8]) -> Result<Volume, Problem> {
    read(Source::from_bytes(bytes.to_vec()), bytes.starts_with(&[0x1f, 0x8b]), name, hints)
}

#[test]
fn raw_file_name_gives_size_type_and_byte_order() {
    let none = RawHints::default();
    for (name, kind, first) in [
        ("x_3x2x1_uint16.raw", "uint16", 1.0),
        ("x-3x2x1-uint16le.raw", "uint16", 1.0),
        ("X.3X2X1.UINT16BE.RAW", "uint16", 256.0),
        ("x_3x2x1_int16_be.raw", "int16", 256.0),
        ("short_3x2x1.img", "int16", 1.0),
        ("short-leg_3x2x1_uint16.raw", "uint16", 1.0),
        ("big_3x2x1_uint16.raw", "uint16", 1.0),
        ("be_3x2x1_uint16.raw", "uint16", 1.0),
        ("to-be-or-not_3x2x1_uint16_big.raw", "uint16", 256.0),
        ("uint16_be_3x2x1.raw", "uint16", 256.0),
        ("float_3x2x1_int16.raw", "int16", 1.0),
    ] {
        let v = open(name, &none, &[1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0]).unwrap();
        assert_eq!((v.lattice.dims, v.file_type.as_str()), ([3, 2, 1], kind), "{name}");
        assert_eq!(v.summary.map.value(v.samples.code(0)), first, "{name}");
    }
    let source = Source::from_bytes(vec![0; 12]);
    let notes = source.notes.clone();
    read(source, false, "big_3x2x1_uint16.raw", &none).unwrap();
    let said = "raw numbers: 3x2x1 of uint16, little-endian were taken, by the file's name";
    assert_eq!(notes.take(), [said]);
    let packed = crate::fuzz::gzip(&[1, 2, 3, 4, 5, 6]);
    let v = open("x_3x2x1_u8.raw.gz", &none, &packed).unwrap();
    assert_eq!(v.samples, Samples::U8(vec![1, 2, 3, 4, 5, 6]));
}

#[test]
fn raw_flags_override_the_file_name() {
    let mut hints =
        RawHints { dims: Some([1, 2, 3]), spacing: Some([1.0, 2.0, 3.0]), ..RawHints::default() };
    assert!(hints.set_type("int8") && !hints.is_empty());
    hints.skip = Some(1);
    let v = open("x_9x9x9_float.raw", &hints, &[9, 0xff, 0, 0, 0, 0, 0]).unwrap();
    assert_eq!((v.lattice.dims, v.summary.range().0), ([1, 2, 3], -1.0));
    assert_eq!(v.lattice.spacing(), [1.0, 2.0, 3.0]);
    assert!(!hints.set_type("colour"));
}

#[test]
fn raw_size_mismatch_suggests_flags_that_fit() {
    let none = RawHints::default();
    for (name, bytes, say) in [
        ("x_2x2x2_uint8.raw", 16, "holds 16 bytes, and 2x2x2 of uint8 take 8; --type uint16"),
        ("x_2x2x2_uint8.raw", 12, "--dims 2x2x3 would fit"),
        ("x_2x2x2_uint8.raw", 13, "--skip 5 would fit"),
        ("x_9x9x9_uint8.raw", 27, "--dims 3x3x3 would fit"),
        ("x_9x9x9_uint8.raw", 31, "give --dims, --type and --skip"),
        ("x_2x2x2.raw", 32, "give --type float32"),
        ("x_2x2x2.raw", 31, "give one of uint8"),
        ("x.raw", 64, "--dims 4x4x4 --type uint8 would fit its 64 bytes"),
        ("x.raw", 54, "--dims 3x3x3 --type uint16 would fit its 54 bytes"),
        ("x.raw", 77, "such as --dims 256x256x128"),
        ("x_0x2x2_uint8.raw", 77, "has no samples"),
        ("x_99999x2x2_uint8.raw", 77, "is longer than 16384"),
    ] {
        let e = open(name, &none, &vec![0; bytes]).unwrap_err().to_string();
        assert!(e.contains(say), "{name}: want {say:?} in {e}");
    }
    let e = open("x_3x2x1_u8.raw.gz", &none, &crate::fuzz::gzip(&[0; 7])).unwrap_err();
    assert!(e.to_string().contains("goes on after the 6 bytes"), "{e}");
}
