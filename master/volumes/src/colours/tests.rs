use super::*;

fn made(colours: &[[u8; 4]], channels: usize) -> Made {
    let planes: Vec<Vec<u8>> =
        (0..channels).map(|c| colours.iter().map(|colour| colour[c]).collect()).collect();
    Made::of(&planes).expect("small")
}

#[test]
fn few_colours_are_kept_and_their_order_is_that_of_no_voxel() {
    let colours: Vec<[u8; 4]> =
        (0..60_000u32).map(|i| [i as u8, (i >> 8) as u8, (i * 7) as u8, 255]).collect();
    let forth = made(&colours, 3);
    assert_eq!((forth.rounded, forth.palette.has_alpha()), (0, false));
    let back: Vec<_> =
        forth.places.iter().map(|&p| forth.palette.colours()[usize::from(p)]).collect();
    assert_eq!(back, colours);
    let mut turned = colours.clone();
    turned.reverse();
    let turned = made(&turned, 3);
    assert_eq!(turned.palette, forth.palette);
    assert!(forth.notes(false).is_empty());
}

#[test]
fn many_colours_are_rounded_evenly_and_the_note_says_by_how_much() {
    // Every third level of red and green, every blue: 1.8 million colours.
    let all = || (0..86u32 * 86 * 256).map(|i| (i % 86 * 3, i / 86 % 86 * 3, i / 86 / 86));
    let colours: Vec<[u8; 4]> = all().map(|(r, g, b)| [r as u8, g as u8, b as u8, 255]).collect();
    let made = made(&colours, 3);
    assert!((30_000..=COLOURS_MAX).contains(&made.palette.colours().len()));
    for (&place, colour) in made.places.iter().zip(&colours) {
        let got = made.palette.colours()[usize::from(place)];
        assert!((0..4).all(|c| got[c].abs_diff(colour[c]) <= made.rounded));
    }
    assert!((1..=4).contains(&made.rounded), "{}", made.rounded);
    let note = made.notes(false).remove(0);
    assert!(note.contains("more than 65536 colours were rounded to"), "{note}");
    assert!(made.notes(true).is_empty());
}

#[test]
fn what_is_transparent_stays_so_and_an_even_alpha_says_nothing() {
    let colours: Vec<[u8; 4]> = (0..1u32 << 18)
        .map(|i| (i.wrapping_mul(2_654_435_761)).to_le_bytes())
        .map(|[r, g, b, a]| [r, g, b, if a < 40 { 0 } else { a }])
        .collect();
    let many = made(&colours, 4);
    assert_eq!(many.palette.value(), ColourValue::Alpha);
    for (&place, colour) in many.places.iter().zip(&colours) {
        let got = many.palette.colours()[usize::from(place)];
        assert_eq!(got[3] == 0, colour[3] == 0);
    }
    let even = made(&[[1, 2, 3, 9], [200, 2, 3, 9]], 4);
    assert_eq!((even.palette.value(), even.even_alpha), (ColourValue::Luminance, Some(9)));
    assert_eq!(even.palette.colours(), [[1, 2, 3, 9], [200, 2, 3, 9]]);
    assert!(even.notes(false)[0].starts_with("alpha is 9 everywhere"));
}

#[test]
fn sixteen_bits_are_scaled_from_the_bits_that_are_used() {
    let bytes = |v: Vec<u16>| to_bytes(&[Samples::U16(v)]).unwrap();
    let (full, note) = bytes(vec![0, 257, 65_535, 32_896]);
    assert_eq!(full, [[0, 1, 255, 128]]);
    assert!(note.unwrap().contains("0 to 65535 was scaled"));
    assert_eq!(bytes(vec![4095, 2048, 16]).0, [[255, 128, 1]]);
    assert_eq!(bytes(vec![255, 7]).0, [[255, 7]]);
    assert_eq!(to_bytes(&[Samples::U8(vec![3, 255])]).unwrap(), (vec![vec![3, 255]], None));
}

/// Voxels of a box of 5 x 4 x 3: red, green, blue and alpha by place.
fn voxel(i: usize) -> [u8; 4] {
    [(i * 4) as u8, (255 - i * 3) as u8, (i * i % 251) as u8, (i % 7 * 40) as u8]
}

const VOXELS: usize = 60;

fn beside(channels: usize) -> Vec<u8> {
    (0..VOXELS).flat_map(|i| voxel(i)[..channels].to_vec()).collect()
}

fn behind(channels: usize) -> Vec<u8> {
    (0..channels).flat_map(|c| (0..VOXELS).map(move |i| voxel(i)[c])).collect()
}

fn nrrd(lines: &str, data: &[u8]) -> Vec<u8> {
    [format!("NRRD0004\n{lines}\nencoding: raw\nendian: little\n\n").as_bytes(), data].concat()
}

fn nifti(datatype: i16, dims: [i16; 8], data: &[u8]) -> Vec<u8> {
    let mut b = vec![0u8; 352];
    b[..4].copy_from_slice(&348i32.to_le_bytes());
    dims.iter().enumerate().for_each(|(i, n)| {
        b[40 + 2 * i..42 + 2 * i].copy_from_slice(&n.to_le_bytes());
    });
    b[70..72].copy_from_slice(&datatype.to_le_bytes());
    (0..8).for_each(|i| b[76 + 4 * i..80 + 4 * i].copy_from_slice(&1f32.to_le_bytes()));
    b[108..112].copy_from_slice(&352f32.to_le_bytes());
    b[344..348].copy_from_slice(b"n+1\0");
    [&b, data].concat()
}

fn metaimage(channels: usize, kind: &str, data: &[u8]) -> Vec<u8> {
    let head = format!(
        "ObjectType = Image\nNDims = 3\nDimSize = 5 4 3\nElementType = {kind}\n\
         ElementNumberOfChannels = {channels}\nElementDataFile = LOCAL\n"
    );
    [head.as_bytes(), data].concat()
}

fn vti(channels: usize, active: &str, data: &[u8]) -> Vec<u8> {
    let text: Vec<String> = data.iter().map(u8::to_string).collect();
    format!(
        "<VTKFile type=\"ImageData\" byte_order=\"LittleEndian\"><ImageData \
         WholeExtent=\"0 4 0 3 0 2\" Origin=\"0 0 0\" Spacing=\"1 1 1\"><Piece \
         Extent=\"0 4 0 3 0 2\"><PointData {active}><DataArray type=\"UInt8\" Name=\"c\" \
         NumberOfComponents=\"{channels}\" format=\"ascii\">{}</DataArray></PointData></Piece>\
         </ImageData></VTKFile>",
        text.join(" ")
    )
    .into_bytes()
}

/// Returns a TIFF of three pages.
fn tiff<C: tiff::encoder::colortype::ColorType<Inner = T>, T: Copy>(
    channels: usize,
    number: fn(u8) -> T,
) -> Vec<u8>
where
    [T]: tiff::encoder::TiffValue,
{
    let mut out = std::io::Cursor::new(Vec::new());
    let mut encoder = tiff::encoder::TiffEncoder::new(&mut out).unwrap();
    for page in beside(channels).chunks(20 * channels) {
        let page: Vec<T> = page.iter().map(|&x| number(x)).collect();
        encoder.write_image::<C>(5, 4, &page).unwrap();
    }
    out.into_inner()
}

fn in_folder(files: &[(&str, Vec<u8>)], pick: Pick) -> Result<Opened, String> {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    let path = match files {
        [(name, _)] => folder.path().join(name),
        _ => folder.path().to_path_buf(),
    };
    crate::open_with(&path, &Hints { pick, ..Hints::default() }).map_err(|e| e.problem.to_string())
}

fn colours_of(volume: &Volume) -> Vec<[u8; 4]> {
    let palette = volume.summary.palette.as_ref().expect("it has colours");
    let Samples::U16(places) = volume.codes() else { panic!("places have 16 bits") };
    places.iter().map(|&place| palette.colours()[usize::from(place)]).collect()
}

pub(crate) fn samples_of_colours() -> Vec<(&'static str, usize, Vec<u8>)> {
    use tiff::encoder::colortype::{RGB8, RGB16, RGBA8};
    let (rgb, rgba) = (beside(3), beside(4));
    let wide: Vec<u8> = rgb.iter().flat_map(|&x| (u16::from(x) * 257).to_le_bytes()).collect();
    let first = |kind: &str, n: usize| {
        format!("type: uint8\ndimension: 4\nsizes: {n} 5 4 3\nkinds: {kind} domain domain domain")
    };
    let last = "type: uint8\ndimension: 4\nsizes: 5 4 3 3\nkinds: space space space RGB-color";
    let of_16 = "type: uint16\ndimension: 4\nsizes: 3 5 4 3\nkinds: RGB-color space space space";
    vec![
        ("a.nrrd", 3, nrrd(&first("RGB-color", 3), &rgb)),
        ("a.nrrd", 3, nrrd(&first("vector", 3), &rgb)),
        ("a.nrrd", 3, nrrd(last, &behind(3))),
        ("a.nrrd", 4, nrrd(&first("RGBA-color", 4), &rgba)),
        ("a.nrrd", 3, nrrd(of_16, &wide)),
        ("a.nii", 3, nifti(128, [3, 5, 4, 3, 1, 1, 1, 1], &rgb)),
        ("a.nii", 4, nifti(2304, [3, 5, 4, 3, 1, 1, 1, 1], &rgba)),
        ("a.nii", 3, nifti(2, [5, 5, 4, 3, 1, 3, 1, 1], &behind(3))),
        ("a.mha", 3, metaimage(3, "MET_UCHAR", &rgb)),
        ("a.mha", 4, metaimage(4, "MET_UCHAR", &rgba)),
        ("a.mha", 3, metaimage(3, "MET_USHORT", &wide)),
        ("a.vti", 3, vti(3, "Scalars=\"c\"", &rgb)),
        ("a.vti", 4, vti(4, "", &rgba)),
        ("a.tif", 3, tiff::<RGB8, u8>(3, |x| x)),
        ("a.tif", 4, tiff::<RGBA8, u8>(4, |x| x)),
        ("a.tif", 3, tiff::<RGB16, u16>(3, |x| u16::from(x) * 257)),
    ]
}

#[test]
fn every_format_opens_with_its_colours_and_one_channel_is_grey() {
    for (name, channels, bytes) in samples_of_colours() {
        let opened = in_folder(&[(name, bytes.clone())], Pick::default())
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        let volume = &opened.volume;
        let palette = volume.summary.palette.as_ref().expect("colours");
        assert_eq!((volume.lattice.dims, palette.channels()), ([5, 4, 3], channels), "{name}");
        let all: Vec<[u8; 4]> = (0..VOXELS)
            .map(|i| {
                if channels == 4 { voxel(i) } else { [voxel(i)[0], voxel(i)[1], voxel(i)[2], 255] }
            })
            .collect();
        assert_eq!(colours_of(volume), all, "{name}");
        let values: Vec<u8> = all.iter().map(|&c| palette.value().of(c)).collect();
        assert_eq!(volume.samples, Samples::U8(values), "{name}");
        assert_eq!(palette.value() == ColourValue::Alpha, channels == 4);
        let wide = volume.file_type.ends_with("uint16");
        let note = opened.notes.iter().any(|n| n.contains("0 to 65535 was scaled to 0 to 255"));
        assert_eq!(note, wide, "{name}: {:?}", opened.notes);

        let pick = Pick { channel: Some(1), ..Pick::default() };
        let grey = in_folder(&[(name, bytes.clone())], pick).unwrap().volume;
        assert_eq!(grey.summary.palette, None);
        let scale = if wide { 257.0 } else { 1.0 };
        let got: Vec<f64> = (0..VOXELS).map(|i| grey.samples.code(i)).collect();
        let want: Vec<f64> = (0..VOXELS).map(|i| f64::from(voxel(i)[1]) * scale).collect();
        assert_eq!(got, want, "{name} --channel 1");
        let pick = Pick { channel: Some(channels as u64), ..Pick::default() };
        let e = in_folder(&[(name, bytes)], pick).unwrap_err();
        let last = format!("--channel: {channels} is not there: the file has {channels} channels");
        assert!(e.starts_with(&last), "{name}: {e}");
    }
}

#[test]
fn pictures_in_colours_are_a_volume_and_grey_ones_stay_grey() {
    use crate::pictures::tests::png;
    use ::png::{BitDepth::Eight, ColorType};
    let picture = |at: usize, channels: usize| {
        let kind = if channels == 4 { ColorType::Rgba } else { ColorType::Rgb };
        let rows: Vec<u8> =
            (at * 20..at * 20 + 20).flat_map(|i| voxel(i)[..channels].to_vec()).collect();
        png((5, 4), (kind, Eight), None, &rows)
    };
    let opened =
        in_folder(&[("1.png", picture(0, 3)), ("2.png", picture(1, 3))], Pick::default()).unwrap();
    let all: Vec<[u8; 4]> = (0..40).map(|i| [voxel(i)[0], voxel(i)[1], voxel(i)[2], 255]).collect();
    assert_eq!(colours_of(&opened.volume), all);
    assert_eq!(opened.volume.file_type, "RGB uint8");
    // One with opacity makes all have it; the others are opaque.
    let mixed = [("1.png", picture(0, 3)), ("2.png", picture(1, 4))];
    let opened = in_folder(&mixed, Pick::default()).unwrap();
    let colours = colours_of(&opened.volume);
    assert_eq!(
        (colours[7], colours[27]),
        ([voxel(7)[0], voxel(7)[1], voxel(7)[2], 255], voxel(27))
    );
    let blue = Pick { channel: Some(2), ..Pick::default() };
    let opened = in_folder(&mixed, blue).unwrap();
    assert_eq!(opened.volume.samples.code(27), f64::from(voxel(27)[2]));
    let grey: Vec<u8> = (0..20).flat_map(|i| [i as u8; 3]).collect();
    let grey = png((5, 4), (ColorType::Rgb, Eight), None, &grey);
    let opened = in_folder(&[("1.png", grey.clone()), ("2.png", grey)], Pick::default()).unwrap();
    assert_eq!(opened.volume.summary.palette, None);
    let plain = png((5, 4), (ColorType::Grayscale, Eight), None, &[9; 20]);
    let e = in_folder(&[("1.png", plain.clone()), ("2.png", plain)], blue).unwrap_err();
    assert!(e.starts_with("--channel: 2 is not there: the file has 1 channel"), "{e}");
}

#[test]
fn vectors_and_other_colours_are_not_taken_for_red_green_and_blue() {
    let floats: Vec<u8> = (0..VOXELS * 3).flat_map(|i| (i as f32).to_le_bytes()).collect();
    let first = |number: &str, kind: &str, n: usize| {
        format!("type: {number}\ndimension: 4\nsizes: {n} 5 4 3\nkinds: {kind} space space space")
    };
    for (lines, data) in [
        (first("float", "vector", 3), &floats),
        (first("uint8", "HSV-color", 3), &beside(3)),
        (first("int8", "vector", 3), &beside(3)),
        (first("uint8", "vector", 2), &beside(3)),
    ] {
        let e = in_folder(&[("a.nrrd", nrrd(&lines, data))], Pick::default()).unwrap_err();
        assert!(e.contains("not one number; take one of them with --channel"), "{lines}: {e}");
    }
}

#[test]
fn colours_are_written_to_the_bit_and_keep_their_digest() {
    use crate::write::{Format, write};
    let formats = [
        Format::Nrrd { gzip: false },
        Format::Nrrd { gzip: true },
        Format::Nifti { gzip: false },
        Format::Nifti { gzip: true },
    ];
    for (name, channels, bytes) in samples_of_colours() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, &bytes).unwrap();
        let (opened, numbers) = crate::open_numbers(&path, &Hints::default()).unwrap();
        for format in formats {
            let numbers = numbers.as_ref();
            let (mut out, mut seen) = (Vec::new(), 0);
            let told = &mut |n| {
                seen = n;
                Ok(())
            };
            write(&opened.volume, numbers, format, &mut out, told).unwrap();
            assert_eq!(seen, VOXELS as u64);
            let file = if matches!(format, Format::Nrrd { .. }) { "b.nrrd" } else { "b.nii" };
            let again = in_folder(&[(file, out.clone())], Pick::default()).unwrap().volume;
            assert_eq!(again.digest(), opened.volume.digest(), "{name} {format:?}");
            if format == formats[0] {
                // The data of a file of 16 bits, too.
                let wide = opened.volume.file_type.ends_with("uint16");
                let size = channels * VOXELS * if wide { 2 } else { 1 };
                let want: Vec<u8> = match wide {
                    true => beside(channels).iter().flat_map(|&x| [x, x]).collect(),
                    false => beside(channels),
                };
                assert_eq!(out[out.len() - size..], want, "{name}");
            }
        }
    }
}

#[test]
fn many_colours_are_written_to_the_bit_though_they_are_drawn_rounded() {
    let mut state = 1u32;
    let mut random = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    };
    let data: Vec<u8> = (0..3 * 48 * 48 * 48).map(|_| random()).collect();
    let head =
        "type: uint8\ndimension: 4\nsizes: 3 48 48 48\nkinds: RGB-color domain domain domain";
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.nrrd");
    std::fs::write(&path, nrrd(head, &data)).unwrap();
    let (opened, numbers) = crate::open_numbers(&path, &Hints::default()).unwrap();
    let mut out = Vec::new();
    let format = crate::write::Format::Nrrd { gzip: false };
    crate::write::write(&opened.volume, numbers.as_ref(), format, &mut out, &mut |_| Ok(()))
        .unwrap();
    assert_eq!(out[out.len() - data.len()..], data);
    let drawn = crate::open_with(&path, &Hints::default()).unwrap();
    assert!(drawn.notes.iter().any(|n| n.contains("were rounded to")), "{:?}", drawn.notes);
    assert_eq!(drawn.volume.digest(), opened.volume.digest());
    let cap = Hints { max_bytes: Some(48 * 48 * 48 * 2), ..Hints::default() };
    let e = crate::open_with(&path, &cap).unwrap_err().to_string();
    assert!(e.contains("--max-bytes 331776"), "{e}");
}
