use super::*;
use slabcast_common::volume::Samples;

const HEAD: &str = "ObjectType = Image\nNDims = 3\nDimSize = 3 2 1\nElementType = MET_UCHAR\n";

fn open(header: &str, data: &[u8]) -> Result<Volume, Problem> {
    let bytes = [header.as_bytes(), data].concat();
    crate::read(Source::from_bytes(bytes), Path::new("."), "test.mha", &crate::Hints::default())
}

#[test]
fn metaimage_of_two_axes_is_called_a_picture() {
    let flat = HEAD.replace("NDims = 3", "NDims = 2").replace("3 2 1", "3 2");
    let e = open(&format!("{flat}ElementDataFile = LOCAL\n"), &[0; 6]).unwrap_err().to_string();
    assert!(e.contains("NDims: is a 2-D picture of 3 x 2, not a volume; give the folder"), "{e}");
}

#[test]
fn metaimage_reads_local_data_raw_compressed_and_as_text() {
    let data = [1, 2, 3, 4, 5, 6];
    let want = Samples::U8(data.to_vec());
    let local = |more: &str| format!("{HEAD}{more}ElementDataFile = LOCAL\n");
    assert_eq!(open(&local(""), &data).unwrap().samples, want);
    let packed = local("CompressedData = True\nCompressedDataSize = 99\n");
    assert_eq!(open(&packed, &crate::fuzz::zlib(&data)).unwrap().samples, want);
    assert_eq!(open(&packed, &crate::fuzz::gzip(&data)).unwrap().samples, want);
    assert_eq!(open(&local("BinaryData = False\n"), b"1 2 3\n4 5 6\n").unwrap().samples, want);
    assert_eq!(
        open(&local("HeaderSize = 2\n"), b"xx\x01\x02\x03\x04\x05\x06").unwrap().samples,
        want
    );
    assert_eq!(
        open(&local("HeaderSize = -1\n"), b"xxx\x01\x02\x03\x04\x05\x06").unwrap().samples,
        want
    );
    let dos = local("").replace('\n', "\r\n");
    assert_eq!(open(&dos, &data).unwrap().samples, want);
}

#[test]
fn metaimage_transform_matrix_rows_are_index_axes_in_lps() {
    let more = "TransformMatrix = 0 1 0 0 0 1 -1 0 0\nElementSpacing = 1 2 3\nOffset = 4 5 6\n";
    let v = open(&format!("{HEAD}{more}ElementDataFile = LOCAL\n"), &[0; 6]).unwrap();
    assert!(v.anatomical);
    assert_eq!(v.lattice.steps, [-DVec3::Y, DVec3::Z * 2.0, DVec3::X * 3.0]);
    assert_eq!(v.lattice.origin, DVec3::new(-4.0, -5.0, 6.0));
    let v = open(&format!("{HEAD}ElementSize = 1 2 3\nElementDataFile=LOCAL\n"), &[0; 6]);
    let v = v.unwrap();
    assert!(v.anatomical, "ITK takes the identity in LPS");
    assert_eq!(v.lattice.steps, [-DVec3::X, DVec3::Y * -2.0, DVec3::Z * 3.0]);
}

#[test]
fn metaimage_axes_of_one_sample_after_the_third_are_dropped() {
    let four = "ObjectType = Image\nNDims = 4\nDimSize = 3 2 1 1\nElementType = MET_UCHAR\n";
    let place = "TransformMatrix = -1 0 0 0 0 -1 0 0 0 0 1 0 0 0 0 1\nOffset = 31.5 -12.25 7 0\n\
                 ElementSpacing = 1 2 3 9\n";
    let v = open(&format!("{four}{place}ElementDataFile = LOCAL\n"), &[0; 6]).unwrap();
    assert_eq!(v.lattice.dims, [3, 2, 1]);
    assert_eq!(v.lattice.steps, [DVec3::X, DVec3::Y * 2.0, DVec3::Z * 3.0]);
    assert_eq!(v.lattice.origin, DVec3::new(-31.5, 12.25, 7.0));
    for (from, to, say) in [
        ("3 2 1 1", "1 2 1 0", "DimSize (line 3): `1 2 1 0` has no samples"),
        ("3 2 1 1", "3 2 1", "is not 4 whole numbers"),
        ("0 0 1 0 0", "0 0 1 5 0", "leads out of the space of its first three axes"),
        ("NDims = 4", "NDims = 2", "DimSize (line 3): `3 2 1 1` is not 2 whole numbers"),
    ] {
        let head = format!("{four}{place}ElementDataFile = LOCAL\n").replace(from, to);
        let e = open(&head, &[0; 6]).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
}

#[test]
fn metaimage_headers_may_have_comments_and_say_a_thing_twice() {
    let head = format!("# made by me\n\n{HEAD}#NDims = 9\nNDims = 3\nElementDataFile = LOCAL\n");
    assert_eq!(open(&head, &[7; 6]).unwrap().samples, Samples::U8(vec![7; 6]));
    let v = open(&head.replace("ObjectType = Image\n", ""), &[7; 6]).unwrap();
    assert_eq!(v.lattice.dims, [3, 2, 1]);
}

#[test]
fn metaimage_element_types_and_byte_order() {
    for (kind, name, bytes) in [
        ("MET_CHAR", "int8", 1),
        ("MET_USHORT", "uint16", 2),
        ("MET_LONG", "int32", 4),
        ("MET_ULONG_LONG", "uint64", 8),
        ("MET_FLOAT", "float32", 4),
        ("MET_DOUBLE", "float64", 8),
    ] {
        let head = HEAD.replace("MET_UCHAR", kind) + "ElementDataFile = LOCAL\n";
        assert_eq!(open(&head, &vec![0; 6 * bytes]).unwrap().file_type, name);
        let e = open(&head, &vec![0; 6 * bytes - 1]).unwrap_err().to_string();
        assert!(e.contains("bytes are needed and"), "{e}");
    }
    let head = HEAD.replace("MET_UCHAR", "MET_USHORT").replace("3 2 1", "1 1 1");
    let msb = format!("{head}BinaryDataByteOrderMSB = True\nElementDataFile = LOCAL\n");
    assert_eq!(open(&msb, &[1, 2]).unwrap().samples, Samples::U16(vec![258]));
}

#[test]
fn metaimage_errors_name_field_and_remedy() {
    let with = |from: &str, to: &str| format!("{HEAD}ElementDataFile = LOCAL\n").replace(from, to);
    for (header, say) in [
        (HEAD.to_string(), "line 5: `\\0\\0\\0\\0\\0\\0` is not `Key = Value`"),
        (with("Image", "Tube"), "ObjectType (line 1): `Tube` is not an image"),
        (with("NDims = 3", "NDims = 4"), "`3 2 1` is not 4 whole numbers"),
        (with("DimSize = 3 2 1\n", ""), "DimSize: is missing"),
        (with("3 2 1", "3 2"), "`3 2` is not 3 whole numbers"),
        (with("3 2 1", "3 0 1"), "3 x 0 x 1 has no samples"),
        (with("3 2 1", "3 2 -1"), "is not whole numbers"),
        (with("MET_UCHAR", "MET_STRING"), "ElementType (line 4): `MET_STRING` is not a type"),
        (with("ElementDataFile", "CompressedData = Maybe\nElementDataFile"), "give True or False"),
        (with("ElementDataFile", "ElementSpacing = 1 1\nElementDataFile"), "is not 3 numbers"),
        (
            with("ElementDataFile", "ElementSpacing = 1 1 0\nElementDataFile"),
            "ElementSpacing: a spacing is zero",
        ),
        (
            with("ElementDataFile", "TransformMatrix = 1 0 0 1 0 0 0 0 1\nElementDataFile"),
            "would be flat",
        ),
        (
            with("ElementDataFile", "ElementNumberOfChannels = 3\nElementDataFile"),
            "ElementNumberOfChannels: a voxel is 3 numbers, not one number; take one of them with --channel 0 to 2",
        ),
        (with("ElementDataFile", "NDims = 4\nElementDataFile"), "was given in line 2 with another"),
        (with("ElementDataFile", "HeaderSize = x\nElementDataFile"), "is not a number of bytes"),
        (with("LOCAL", "no.raw"), "ElementDataFile: `no.raw` is not there"),
        (with("LOCAL", "../x.raw"), "ElementDataFile"),
        (with("LOCAL", "LIST\na\nb"), "names 3 files where DimSize wants 1"),
        (with("LOCAL", "a%03d.raw 1 2 1"), "names 2 files where DimSize wants 1"),
        (with("LOCAL", "a%s.raw 1 2 1"), "in a way that is not known"),
        (with("ElementDataFile", "nonsense\nElementDataFile"), "`nonsense` is not `Key = Value`"),
    ] {
        let e = open(&header, &[0; 6]).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
    let e = open(HEAD, b"").unwrap_err().to_string();
    assert!(e.contains("ElementDataFile: is missing; end the header with"), "{e}");
}

#[test]
fn metaimage_takes_one_of_several_volumes_and_one_channel() {
    let head = "ObjectType = Image\nNDims = 4\nDimSize = 3 2 1 2\nElementType = MET_UCHAR\n\
                ElementNumberOfChannels = 2\nElementDataFile = LOCAL\n";
    let data: Vec<u8> = (0..24).collect();
    let read = |head: &str, pick: Pick| {
        let source = Source::from_bytes([head.as_bytes(), &data].concat());
        let (hints, notes) =
            (crate::Hints { pick, ..crate::Hints::default() }, source.notes.clone());
        let v = crate::read(source, Path::new("."), "v.mha", &hints).map_err(|p| p.to_string())?;
        let codes: Vec<u8> = (0..6).map(|i| v.samples.code(i) as u8).collect();
        Ok::<_, String>((codes, notes.take().join("; ")))
    };
    let e = read(head, Pick::default()).unwrap_err();
    assert!(e.contains("a voxel is 2 numbers, not one number; take one of them"), "{e}");
    let (codes, notes) = read(head, Pick { channel: Some(1), ..Pick::default() }).unwrap();
    assert_eq!(codes, [1, 3, 5, 7, 9, 11]);
    assert!(
        notes.starts_with("the first of 2 volumes was read; --volume takes another"),
        "{notes}"
    );
    // Channels count faster than volumes.
    let (codes, _) = read(head, Pick { volume: Some(3), ..Pick::default() }).unwrap();
    assert_eq!(codes, [13, 15, 17, 19, 21, 23]);
}
