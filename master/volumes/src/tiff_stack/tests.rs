use super::*;
use slabcast_common::volume::Samples;
use std::io::Cursor;
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
    assert!(e.contains("RGB(8) is not a grey picture; save it in shades of grey"), "{e}");
    let all = pages(2, Compression::Lzw);
    for cut in [8, 20, 60, all.len() / 2, all.len() - 1] {
        let e = open(all[..cut].to_vec()).unwrap_err();
        assert!(matches!(e.kind, OpenErrorKind::Damaged), "{cut}: {e}");
    }
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
