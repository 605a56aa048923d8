//! Tests with VTI files written in every data format of VTK.

use super::*;
use crate::fuzz::{base64, xz, zlib};
use std::path::Path;

/// Data format of a test's array.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Way {
    Ascii,
    Inline { packed: bool },
    Appended { packed: bool, base64: bool },
}

pub(crate) const WAYS: [Way; 7] = [
    Way::Ascii,
    Way::Inline { packed: false },
    Way::Inline { packed: true },
    Way::Appended { packed: false, base64: false },
    Way::Appended { packed: true, base64: false },
    Way::Appended { packed: false, base64: true },
    Way::Appended { packed: true, base64: true },
];

/// Compresses a block as VTK's compressor of this name does.
fn block(compressor: &str, data: &[u8]) -> Vec<u8> {
    match compressor {
        "LZ4" => lz4_flex::block::compress(data),
        "LZMA" => xz(data),
        _ => zlib(data),
    }
}

/// Returns an array with its header of `word` bytes a number, in blocks of 16 bytes if it has a
/// compressor.
fn binary(data: &[u8], compressor: Option<&str>, base: bool, word: usize, big: bool) -> Vec<u8> {
    let number = |n: usize| match big {
        true => (n as u64).to_be_bytes()[8 - word..].to_vec(),
        false => (n as u64).to_le_bytes()[..word].to_vec(),
    };
    let (mut head, mut body) = (Vec::new(), Vec::new());
    if let Some(name) = compressor {
        let blocks: Vec<Vec<u8>> = data.chunks(16).map(|part| block(name, part)).collect();
        head.extend([number(blocks.len()), number(16), number(data.len() % 16)].concat());
        for block in blocks {
            head.extend(number(block.len()));
            body.extend(block);
        }
    } else {
        head = number(data.len());
        body = data.to_vec();
    }
    match (base, compressor.is_some()) {
        (false, _) => [head, body].concat(),
        (true, true) => [base64(&head), base64(&body)].concat(),
        (true, false) => base64(&[head, body].concat()),
    }
}

/// Returns a file of bytes `data` as 5 x 3 x 2 samples of `kind`, with another array before it.
/// Packed arrays are compressed by zlib.
pub(crate) fn vti(way: Way, kind: &str, data: &[u8], word: usize, big: bool) -> Vec<u8> {
    vti_by("ZLib", way, kind, data, word, big)
}

/// Returns files of `data` in blocks of lz4 and xz.
pub(crate) fn packed(data: &[u8]) -> Vec<Vec<u8>> {
    let ways = [WAYS[2], WAYS[4], WAYS[6]];
    let files = |name| ways.map(|way| vti_by(name, way, "UInt8", data, 4, false));
    ["LZ4", "LZMA"].into_iter().flat_map(files).collect()
}

/// Returns a file of bytes `data` as 5 x 3 x 2 samples of `kind`, with another array before it.
/// Packed arrays are compressed by VTK's compressor `name`.
fn vti_by(name: &str, way: Way, kind: &str, data: &[u8], word: usize, big: bool) -> Vec<u8> {
    let order = if big { "BigEndian" } else { "LittleEndian" };
    let packed = matches!(way, Way::Inline { packed: true } | Way::Appended { packed: true, .. });
    let by = |packed: bool| packed.then_some(name);
    let compressor = if packed { &format!(" compressor=\"vtk{name}DataCompressor\"") } else { "" };
    let head = format!(
        "<?xml version=\"1.0\"?>\n<!-- made <here> -->\n<VTKFile type=\"ImageData\" \
         version=\"1.0\" byte_order=\"{order}\" header_type=\"UInt{}\"{compressor}>\n<ImageData \
         WholeExtent=\"1 5 0 2 0 1\" Origin=\"10 20 30\" Spacing=\"1 2 3\" Direction=\"0 -1 0 1 0 \
         0 0 0 1\">\n<Piece Extent=\"1 5 0 2 0 1\"><PointData Scalars=\"v\">\n",
        8 * word
    );
    let tail = "</PointData><CellData></CellData></Piece></ImageData>\n";
    let array = |name: &str, attributes: &str, content: &[u8]| {
        let tag = format!("<DataArray type=\"{kind}\" Name=\"{name}\" {attributes}>");
        [tag.as_bytes(), content, b"</DataArray>\n"].concat()
    };
    let other = array("other", "NumberOfComponents=\"3\" format=\"ascii\"", b"1 2 3");
    let (inside, behind) = match way {
        Way::Ascii => {
            let text: Vec<String> = data.iter().map(u8::to_string).collect();
            (array("v", "format='ascii'", text.join(" ").as_bytes()), Vec::new())
        }
        Way::Inline { packed } => {
            let data = [b"\n  ", &binary(data, by(packed), true, word, big)[..], b"\n"].concat();
            (array("v", "format=\"binary\"", &data), Vec::new())
        }
        Way::Appended { packed, base64 } => {
            let array = array("v", "format=\"appended\" offset=\"8\"", b"");
            let encoding = if base64 { "base64" } else { "raw" };
            let tag = format!("<AppendedData encoding=\"{encoding}\">\n   _AAAAAAAA");
            let data = binary(data, by(packed), base64, word, big);
            (array, [tag.as_bytes(), &data, b"\n</AppendedData>"].concat())
        }
    };
    [head.as_bytes(), &other, &inside, tail.as_bytes(), &behind, b"</VTKFile>\n"].concat()
}

fn open(bytes: Vec<u8>) -> Result<Volume, Problem> {
    crate::read(Source::from_bytes(bytes), Path::new("."), "test.vti", &crate::Hints::default())
}

#[test]
fn vti_data_formats_give_the_same_samples() {
    let data: Vec<u8> = (0..30).map(|i| i * 7).collect();
    for way in WAYS {
        for (word, big) in [(4, false), (8, false), (4, true), (8, true)] {
            let v = open(vti(way, "UInt8", &data, word, big))
                .unwrap_or_else(|e| panic!("{way:?} {word} {big}: {e}"));
            assert_eq!(v.samples, Samples::U8(data.clone()), "{way:?} {word} {big}");
            assert_eq!(v.lattice.dims, [5, 3, 2]);
            // i runs along y, j along -x; the first point is one step from the origin.
            assert_eq!(v.lattice.steps, [DVec3::Y, DVec3::X * -2.0, DVec3::Z * 3.0]);
            assert_eq!(v.lattice.origin, DVec3::new(10.0, 21.0, 30.0));
        }
    }
    let wide: Vec<u8> = (0..30u16).flat_map(|i| (i * 300).to_be_bytes()).collect();
    let v = open(vti(WAYS[4], "UInt16", &wide, 4, true)).unwrap();
    assert_eq!(v.samples, Samples::U16((0..30).map(|i| i * 300).collect()));
}

#[test]
fn vti_blocks_of_lz4_and_xz_are_read_and_damage_is_named() {
    let data: Vec<u8> = (0..30).map(|i| i * 7).collect();
    for file in packed(&data) {
        assert_eq!(open(file).unwrap().samples, Samples::U8(data.clone()));
    }
    let wide: Vec<u8> = (0..30u32).flat_map(|i| (i * 70_000).to_le_bytes()).collect();
    for name in ["LZ4", "LZMA"] {
        let file = vti_by(name, WAYS[4], "UInt32", &wide, 8, false);
        let v = open(file.clone()).unwrap();
        assert_eq!(v.summary.range(), (0.0, 2_030_000.0), "{name}");
        let at = file.len() - 70;
        // lz4 has no checksum.
        if name == "LZMA" {
            let mut spoilt = file.clone();
            spoilt[at] ^= 0xff;
            let e = open(spoilt).unwrap_err().to_string();
            assert!(e.contains("of 8: ") && e.contains("get the file again"), "{e}");
        }
        let e = open(file[..at].to_vec()).unwrap_err().to_string();
        assert!(e.contains("of 8: ") && e.contains("; get the file again"), "{name}: {e}");
    }
    // A block that claims more than it can hold takes no memory.
    let file = vti_by("LZ4", WAYS[4], "UInt8", &data, 4, false);
    let at = file.windows(12).position(|w| w == [2, 0, 0, 0, 16, 0, 0, 0, 14, 0, 0, 0]).unwrap();
    let large = String::from_utf8_lossy(&file[..at]).replace("1 5 0 2 0 1", "1 1024 1 1024 1 1024");
    let mut head = file[at..].to_vec();
    head[..12].copy_from_slice(&[1, 0, 0, 0, 0, 0, 0, 0x40, 0, 0, 0, 0]);
    let e = open([large.as_bytes(), &head].concat()).unwrap_err().to_string();
    assert!(e.contains("can't hold so many") || e.contains("size that it can't have"), "{e}");
}

#[test]
fn vti_array_is_chosen_by_dataset() {
    let file = "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"0 1 0 1 0 1\"><Piece><PointData \
        Scalars=\"a\"><DataArray type=\"Int8\" Name=\"a\" format=\"ascii\">1 2 3 4 5 6 7 8</DataArray>\
        <DataArray type=\"Int8\" Name=\"b\" format=\"ascii\">9 8 7 6 5 4 3 2</DataArray></PointData>\
        <CellData><DataArray type=\"Int8\" Name=\"c\" format=\"ascii\">7</DataArray></CellData></Piece>\
        </ImageData></VTKFile>";
    let open = |dataset: Option<&str>| {
        let dataset = dataset.map(String::from);
        let hints = crate::Hints { dataset, ..crate::Hints::default() };
        let source = Source::from_bytes(file.into());
        let v = crate::read(source, Path::new("."), "a.vti", &hints).map_err(|p| p.to_string())?;
        Ok::<_, String>(v.summary.map.value(v.samples.code(0)))
    };
    assert_eq!(open(None), Ok(1.0));
    assert_eq!(open(Some("b")), Ok(9.0));
    assert_eq!(open(Some("c")), Ok(7.0));
    let e = open(Some("d")).unwrap_err();
    let say =
        "--dataset: there is no `d` with one number a point or cell among `a`, `b`, `c`; name";
    assert!(e.contains(say), "{e}");
}

#[test]
fn vti_cell_values_lie_between_the_points() {
    let file = String::from_utf8(vti(Way::Ascii, "UInt8", &[1, 2, 3, 4, 5, 6, 7, 8], 4, false));
    let file = file.unwrap().replace("PointData", "CellData");
    let v = open(file.replace("Direction", "Dropped").into()).unwrap();
    assert_eq!(v.lattice.dims, [4, 2, 1]);
    assert_eq!(v.lattice.origin, DVec3::new(11.5, 21.0, 31.5));
}

#[test]
fn vti_errors_name_field_and_remedy() {
    let data: Vec<u8> = (0..30).collect();
    let text = String::from_utf8(vti(Way::Ascii, "UInt8", &data, 4, false)).unwrap();
    let appended = String::from_utf8(vti(WAYS[6], "UInt8", &data, 4, false)).unwrap();
    let with = |from: &str, to: &str| text.replace(from, to);
    for (file, say) in [
        (with("ImageData\" v", "PolyData\" v"), "VTKFile type: `PolyData` is no ImageData"),
        (with("LittleEndian", "Middle"), "VTKFile byte_order: `Middle`"),
        (with("UInt32", "UInt16"), "VTKFile header_type"),
        (with("WholeExtent", "Extents"), "ImageData WholeExtent: is missing"),
        (with("1 5 0 2 0 1\" O", "1 5 0 2 0\" O"), "give 6 numbers"),
        (with("\"1 5 0 2 0 1\"", "\"1 -2 0 2 0 1\""), "1 to -2 has no points"),
        (with("\"1 5 0 2 0 1\"", "\"1 99999 0 2 0 1\""), "is longer than 16384"),
        (with("Extent=\"1 5 0 2 0 1\"><", "Extent=\"1 3 0 2 0 1\"><"), "Piece: is one of several"),
        (with("Spacing=\"1 2 3\"", "Spacing=\"1 0 3\""), "Spacing: a spacing is zero"),
        (with("UInt8\" Name=\"v", "String\" Name=\"v"), "DataArray type: `String`"),
        (with("Scalars=\"v\"", "Scalars=\"other\""), "`other`: a voxel is 3 numbers"),
        (with("Scalars=\"v\"", "Scalars=\"none\""), "`other`: a voxel is 3 numbers, not one"),
        (with("29<", "299<"), "number 30 is `299`, which is not a value of uint8"),
        (with("28 29<", "28<"), "`v` data: truncated: 30 bytes are needed and 29"),
        (with("29<", "29 30<"), "goes on after the 30 bytes"),
        (with("format='ascii'", "format='zip'"), "format: `zip`"),
        (appended.replace("offset=\"8\"", "offset=\"88888\""), "`v` offset: 88888 lies past"),
        (appended.replace("offset=\"8\"", "offset=\"x\""), "offset: `x`"),
        (
            appended.replace("offset=\"8\"", "offset=\"0\""),
            "bytes, where the extent and the type want 30",
        ),
        (appended.replace("vtkZLib", "vtkZ"), "VTKFile compressor"),
        (appended.replace("vtkZLib", "vtkLZ4"), "block 1 of 2: is damaged"),
        (appended.split("<AppendedData").next().unwrap().into(), "AppendedData: is missing"),
    ] {
        let e = open(file.into()).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
    let raw = vti(WAYS[4], "UInt8", &data, 4, false);
    let mut spoilt = raw.clone();
    let at = raw.len() - 60;
    spoilt[at] ^= 0xff;
    let e = open(spoilt).unwrap_err().to_string();
    assert!(e.contains("of 2: is damaged; get the file again"), "{e}");
    let e = open(raw[..at].to_vec()).unwrap_err().to_string();
    assert!(e.contains("truncated"), "{e}");
}

#[test]
fn vti_masks_before_or_after_the_array_hide_points_and_cells() {
    let file = |section: &str, arrays: &[(&str, &str, &str)]| {
        let arrays: String = arrays
            .iter()
            .map(|(kind, name, text)| {
                format!(
                    "<DataArray type=\"{kind}\" Name=\"{name}\" format=\"ascii\">{text}</DataArray>"
                )
            })
            .collect();
        let extent = if section == "CellData" { "0 2 0 2 0 1" } else { "0 1 0 1 0 0" };
        format!(
            "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"{extent}\"><Piece><{section}>\
             {arrays}</{section}></Piece></ImageData></VTKFile>"
        )
    };
    let v = ("Int64", "v", "5 -6 7 9");
    for (section, mask, hidden) in [
        ("PointData", ("UInt8", "vtkGhostType", "0 2 1 3"), [1, 3].as_slice()),
        ("CellData", ("UInt8", "vtkGhostType", "32 2 1 33"), &[0, 3]),
        ("PointData", ("Int8", "vtkValidPointMask", "1 0 1 1"), &[1]),
        ("CellData", ("Int8", "vtkValidCellMask", "1 1 0 1"), &[2]),
        ("PointData", ("UInt8", "vtkGhostLevels", "1 1 0 0"), &[]),
    ] {
        for arrays in [[v, mask], [mask, v]] {
            let volume = open(file(section, &arrays).into_bytes()).unwrap();
            let nan: Vec<usize> = (0..4).filter(|&i| volume.samples.code(i).is_nan()).collect();
            assert_eq!(nan, hidden, "{section} {}", mask.1);
            let other = if hidden.contains(&0) { (1, -6.0) } else { (0, 5.0) };
            assert_eq!(volume.summary.map.value(volume.samples.code(other.0)), other.1);
        }
    }
    let two = file("PointData", &[v, ("Int8", "w", "1 2 3 4")]);
    let source = Source::from_bytes(two.into_bytes());
    let notes = source.notes.clone();
    read(source, "two.vti", None).unwrap();
    assert_eq!(notes.take(), ["the array `v` was read, and `w` was not (--dataset takes another)"]);
    let masks = file("PointData", &[("UInt8", "vtkGhostType", "0 2 1 3")]);
    let e = open(masks.into_bytes()).unwrap_err().to_string();
    assert!(e.contains("there is none that can be drawn"), "{e}");
}
