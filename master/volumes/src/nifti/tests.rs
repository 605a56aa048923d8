use super::*;
use slabcast_common::volume::Samples;
use std::path::Path;

/// The affine of a test file.
#[derive(Clone, Copy, PartialEq)]
pub(crate) enum Affine {
    Spacing,
    Qform,
    Sform,
}

struct Writer {
    bytes: Vec<u8>,
    big: bool,
}

macro_rules! putters {
    ($($name:ident: $t:ty),*) => {$(
        fn $name(&mut self, at: usize, x: $t) {
            let word = if self.big { x.to_be_bytes() } else { x.to_le_bytes() };
            self.bytes[at..at + word.len()].copy_from_slice(&word);
        }
    )*};
}

impl Writer {
    putters!(i16: i16, i32: i32, i64: i64, f32: f32, f64: f64);

    /// Samples 0, 1, 2, ... of `datatype`.
    fn samples(&mut self, datatype: i16, n: u32) {
        for i in 0..n {
            let at = self.bytes.len();
            let size = match datatype {
                2 | 256 => 1,
                4 | 512 => 2,
                8 | 16 | 768 => 4,
                _ => 8,
            };
            self.bytes.resize(at + size, 0);
            match datatype {
                2 | 256 => self.bytes[at] = i as u8,
                4 | 512 => self.i16(at, i as i16),
                8 | 768 => self.i32(at, i as i32),
                16 => self.f32(at, i as f32),
                64 => self.f64(at, i.into()),
                _ => self.i64(at, i.into()),
            }
        }
    }
}

/// A file of samples 0, 1, 2, ... with spacing 1 x 2 x 3.
pub(crate) fn nifti1(big: bool, datatype: i16, dims: [i16; 3], affine: Affine) -> Vec<u8> {
    let mut w = Writer { bytes: vec![0; 352], big };
    w.i32(0, 348);
    w.i16(40, 3);
    for a in 0..3 {
        w.i16(42 + 2 * a, dims[a]);
        w.f32(80 + 4 * a, a as f32 + 1.0);
    }
    w.i16(70, datatype);
    w.f32(108, 352.0);
    w.bytes[123] = 2;
    match affine {
        Affine::Spacing => {}
        Affine::Qform => {
            // Half a turn about z, left-handed: RAS from an LPS scan of falling slices.
            w.i16(252, 1);
            w.f32(76, -1.0);
            w.f32(264, 1.0);
            for a in 0..3 {
                w.f32(268 + 4 * a, 10.0 * (a as f32 + 1.0));
            }
        }
        Affine::Sform => {
            w.i16(254, 2);
            for a in 0..3 {
                w.f32(280 + 16 * a + 4 * a, a as f32 + 1.0);
                w.f32(280 + 16 * a + 12, -5.0 - a as f32);
            }
        }
    }
    w.bytes[344..348].copy_from_slice(b"n+1\0");
    w.samples(datatype, dims.iter().map(|&n| n as u32).product());
    w.bytes
}

/// A NIfTI-2 file of samples 0, 1, 2, ... with spacing 1 x 2 x 3 and an sform.
pub(crate) fn nifti2(big: bool, datatype: i16, dims: [i64; 3]) -> Vec<u8> {
    let mut w = Writer { bytes: vec![0; 544], big };
    w.i32(0, 540);
    w.bytes[4..12].copy_from_slice(b"n+2\0\r\n\x1a\n");
    w.i16(12, datatype);
    w.i64(16, 3);
    w.i64(168, 544);
    w.i32(348, 1);
    w.i32(500, 2);
    for a in 0..3 {
        w.i64(24 + 8 * a, dims[a]);
        w.f64(112 + 8 * a, a as f64 + 1.0);
        w.f64(400 + 32 * a + 8 * a, a as f64 + 1.0);
        w.f64(400 + 32 * a + 24, -5.0 - a as f64);
    }
    w.samples(datatype, dims.iter().map(|&n| n as u32).product());
    w.bytes
}

fn open(bytes: Vec<u8>) -> Result<Volume, Problem> {
    crate::read(Source::from_bytes(bytes), Path::new("."), "test.nii", &crate::Hints::default())
}

fn put(bytes: &[u8], at: usize, with: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    bytes[at..at + with.len()].copy_from_slice(with);
    bytes
}

#[test]
fn nifti_types_open_in_both_byte_orders_and_versions() {
    let mut values: Option<Vec<f64>> = None;
    for datatype in [2i16, 4, 8, 16, 64, 256, 512, 768, 1024, 1280] {
        for big in [false, true] {
            let one = nifti1(big, datatype, [4, 3, 2], Affine::Sform);
            let two = nifti2(big, datatype, [4, 3, 2]);
            let packed = crate::fuzz::gzip(&one);
            let volumes = [one, two, packed].map(|bytes| open(bytes).unwrap());
            for v in &volumes {
                assert_eq!(v.digest(), volumes[0].digest());
                assert_eq!(v.lattice.dims, [4, 3, 2]);
                let got: Vec<f64> =
                    (0..24).map(|i| v.summary.map.value(v.samples.code(i))).collect();
                assert_eq!(*values.get_or_insert(got.clone()), got, "datatype {datatype}");
            }
        }
    }
    assert_eq!(values.unwrap()[23], 23.0);
}

#[test]
fn nifti_prefers_sform_then_qform_then_spacing() {
    let file = |affine| nifti1(false, 2, [4, 3, 2], affine);
    let s = open(file(Affine::Sform)).unwrap();
    assert!(s.anatomical);
    assert_eq!(s.lattice.origin, DVec3::new(-5.0, -6.0, -7.0));
    assert_eq!(s.lattice.steps, [DVec3::X, DVec3::Y * 2.0, DVec3::Z * 3.0]);
    let q = open(file(Affine::Qform)).unwrap();
    assert!(q.anatomical);
    assert_eq!(q.lattice.origin, DVec3::new(10.0, 20.0, 30.0));
    assert_eq!(q.lattice.steps, [-DVec3::X, DVec3::Y * -2.0, DVec3::Z * -3.0]);
    let p = open(file(Affine::Spacing)).unwrap();
    assert!(!p.anatomical);
    assert_eq!(p.lattice, Lattice::from_spacing([4, 3, 2], [1.0, 2.0, 3.0]));
    // An sform in the file counts for nothing while its code is zero, and first otherwise.
    let both = put(&file(Affine::Sform), 252, &file(Affine::Qform)[252..280]);
    assert_eq!(open(put(&both, 254, &[0, 0])).unwrap().lattice.origin.x, 10.0);
    assert_eq!(open(put(&both, 254, &[1, 0])).unwrap().lattice.origin.x, -5.0);
}

#[test]
fn nifti_qform_quaternion_is_a_rotation() {
    // A quarter turn about x: j becomes z, k becomes -y.
    let s = std::f32::consts::FRAC_1_SQRT_2;
    let file = nifti1(false, 2, [4, 3, 2], Affine::Qform);
    let file = put(&file, 76, &1f32.to_le_bytes());
    let file = put(&file, 256, &s.to_le_bytes());
    let v = open(put(&file, 264, &[0; 4])).unwrap();
    let want = [DVec3::X, DVec3::Z * 2.0, DVec3::Y * -3.0];
    for (got, want) in v.lattice.steps.iter().zip(want) {
        assert!((*got - want).length() < 1e-6, "{got} against {want}");
    }
}

#[test]
fn nifti_applies_slope_and_units() {
    let file = nifti1(false, 256, [4, 3, 2], Affine::Sform);
    let with = |slope: f32, inter: f32| {
        let file = put(&file, 112, &slope.to_le_bytes());
        open(put(&file, 116, &inter.to_le_bytes()))
    };
    let v = with(2.0, 10.0).unwrap();
    assert!(matches!(v.samples, Samples::U8(_)));
    assert_eq!(v.summary.range(), (10.0, 56.0));
    assert_eq!(with(-2.0, 10.0).unwrap().summary.range(), (-36.0, 10.0));
    for slope in [0.0, f32::NAN, f32::INFINITY] {
        assert_eq!(with(slope, 7.0).unwrap().summary.range(), (0.0, 23.0));
    }
    assert_eq!(with(2.0, f32::NAN).unwrap().summary.range(), (0.0, 46.0));
    for (code, mm) in [(0, 1.0), (1, 1000.0), (2, 1.0), (3, 1e-3), (2 | 8, 1.0)] {
        assert_eq!(open(put(&file, 123, &[code])).unwrap().lattice.spacing()[0], mm);
    }
}

#[test]
fn nifti_errors_name_field_and_remedy() {
    let file = nifti1(false, 2, [4, 3, 2], Affine::Sform);
    for (at, with, say) in [
        (
            70,
            &[128, 0][..],
            "datatype: a voxel is 3 colours (RGB), not one number; take one of them with",
        ),
        (70, &[32, 0], "datatype: 32 is complex"),
        (70, &[3, 0], "datatype: 3 is not a type"),
        (344, b"ni1", "magic: is the header of a pair"),
        (344, b"\0\0\0", "magic: is `\\0\\0\\0\\0`, so this is damaged, or an ANALYZE header"),
        (40, &[2, 0], "dim[0]: is a 2-D picture of 4 x 3, not a volume; give the folder"),
        (40, &[1, 0], "dim[0]: is 1; a volume has 3 axes"),
        (42, &[0, 0], "dim: 0 x 3 x 2 has no samples"),
        (42, &[0xff, 0xff], "has no samples"),
        (42, &[100, 0], "data: truncated: 600 bytes are needed and 24 are there"),
        (280, &[0; 4], "srow: a spacing is zero"),
        (280, &f32::NAN.to_le_bytes(), "srow: spacing or origin is not finite"),
        (108, &f32::NAN.to_le_bytes(), "vox_offset: NaN"),
        (108, &100f32.to_le_bytes(), "vox_offset: 100"),
        (108, &1e9f32.to_le_bytes(), "vox_offset: 1000000000.0"),
        (108, &9000f32.to_le_bytes(), "vox_offset: 9000.0 lies past the end"),
    ] {
        let e = open(put(&file, at, with)).unwrap_err().to_string();
        assert!(e.contains(say), "byte {at}: {e}");
    }
    let series = put(&file, 40, &[4, 0]);
    let e = open(put(&series, 48, &[0xff, 0xff])).unwrap_err().to_string();
    assert!(e.contains("dim[4]: is -1; correct it"), "{e}");
    assert!(open(put(&series, 48, &[1, 0])).is_ok(), "a fourth axis of 1 is no axis");
    let e = open(file[..200].to_vec()).unwrap_err().to_string();
    assert!(e.contains("truncated"), "{e}");
    let mut packed = crate::fuzz::gzip(&file);
    packed.truncate(packed.len() - 12);
    let e = open(packed).unwrap_err().to_string();
    assert!(e.contains("truncated"), "{e}");
    let e = open(crate::fuzz::gzip(&[&file[..], b"x"].concat())).unwrap_err().to_string();
    assert!(e.contains("goes on after the 24 bytes that are declared"), "{e}");
}

#[test]
fn nifti_takes_one_of_several_volumes_or_components() {
    use crate::pick::Pick;
    let none = Pick::default();
    let read = |bytes: Vec<u8>, pick: Pick| {
        let source = Source::from_bytes(bytes);
        let hints = crate::Hints { pick, ..crate::Hints::default() };
        let notes = source.notes.clone();
        let v = crate::read(source, std::path::Path::new("."), "v.nii", &hints)
            .map_err(|p| p.to_string())?;
        assert_eq!(v.lattice.dims, [2, 1, 1]);
        Ok::<_, String>((
            (0..2).map(|i| v.samples.code(i) as u8).collect(),
            notes.take().join("; "),
        ))
    };
    let file = |axes: u8, t: u8, c: u8, datatype: [u8; 2]| {
        let file = nifti1(false, 2, [2, 1, 1], Affine::Sform);
        let file = put(&put(&put(&file, 40, &[axes, 0]), 48, &[t, 0]), 50, &[c, 0]);
        [&put(&file, 70, &datatype)[..352], &(0..12).collect::<Vec<u8>>()].concat()
    };
    for packed in [false, true] {
        let pack = |bytes: Vec<u8>| if packed { crate::fuzz::gzip(&bytes) } else { bytes };
        let times = || pack(file(4, 6, 1, [2, 0]));
        let said = "the first of 6 times was read; --time takes another";
        assert_eq!(read(times(), none).unwrap(), (vec![0, 1], said.to_string()));
        for pick in [Pick { volume: Some(5), ..none }, Pick { time: Some(5), ..none }] {
            assert_eq!(read(times(), pick).unwrap(), (vec![10, 11], String::new()));
        }
        let e = read(times(), Pick { volume: Some(6), ..none }).unwrap_err();
        assert_eq!(e, "--volume: 6 is not there: the file has 6 volumes; give 0 to 5");
        let vectors = || pack(file(5, 2, 3, [2, 0]));
        let e = read(vectors(), none).unwrap_err();
        assert!(e.starts_with("dim[5]: a voxel is 3 components, not one number; take one"), "{e}");
        let pick = Pick { channel: Some(1), time: Some(1), ..none };
        assert_eq!(read(vectors(), pick).unwrap(), (vec![6, 7], String::new()));
        let rgb = || pack(file(4, 2, 1, [128, 0]));
        let pick = Pick { channel: Some(2), time: Some(1), ..none };
        assert_eq!(read(rgb(), pick).unwrap(), (vec![8, 11], String::new()));
        let cut = pack(file(4, 60, 1, [2, 0]));
        let e = read(cut, Pick { volume: Some(59), ..none }).unwrap_err();
        assert!(e.contains("truncated"), "{e}");
    }
}
