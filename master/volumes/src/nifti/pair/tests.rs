use super::*;
use crate::fuzz::gzip;
use crate::nifti::tests::{Affine, nifti1, nifti2};

/// Returns the header and the samples 0, 1, 2, ... of a NIfTI pair.
pub(crate) fn nifti_pair(big: bool, datatype: i16, dims: [i16; 3]) -> (Vec<u8>, Vec<u8>) {
    let mut header = nifti1(big, datatype, dims, Affine::Sform);
    let samples = header.split_off(352);
    header.truncate(348);
    header[344..348].copy_from_slice(b"ni1\0");
    header[108..112].copy_from_slice(&[0; 4]);
    (header, samples)
}

/// Returns a header of ANALYZE 7.5.
pub(crate) fn analyze(big: bool, datatype: i16, dims: [i16; 3]) -> Vec<u8> {
    let (mut header, _) = nifti_pair(big, datatype, dims);
    header[252..348].fill(0);
    header
}

/// Puts files into a folder and opens one of them.
fn open(files: &[(&str, &[u8])], which: &str) -> Result<(Volume, String), String> {
    let folder = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).unwrap();
    }
    match crate::open_with(&folder.path().join(which), &crate::Hints::default()) {
        Ok(opened) => Ok((opened.volume, opened.notes.join("\n"))),
        Err(e) => Err(e.problem.to_string()),
    }
}

fn values(v: &Volume) -> Vec<f64> {
    (0..v.samples.len()).map(|i| v.summary.map.value(v.samples.code(i))).collect()
}

#[test]
fn nifti_pair_opens_by_either_name_plain_and_packed() {
    for big in [false, true] {
        let (header, samples) = nifti_pair(big, 4, [4, 3, 2]);
        let single = nifti1(big, 4, [4, 3, 2], Affine::Sform);
        let (want, _) = open(&[("a.nii", &single)], "a.nii").unwrap();
        let (packed_header, packed) = (gzip(&header), gzip(&samples));
        let both: [(&str, &[u8]); 2] = [("s.01.hdr", &header), ("s.01.img", &samples)];
        let gz: [(&str, &[u8]); 2] = [("a.hdr.gz", &packed_header), ("a.img.gz", &packed)];
        let half: [(&str, &[u8]); 2] = [("a.hdr", &header), ("a.img.gz", &packed)];
        let capital: [(&str, &[u8]); 2] = [("A.HDR", &header), ("A.IMG", &samples)];
        for (files, which) in [
            (both, "s.01.hdr"),
            (both, "s.01.img"),
            (gz, "a.hdr.gz"),
            (gz, "a.img.gz"),
            (half, "a.hdr"),
            (half, "a.img.gz"),
            (capital, "A.HDR"),
            (capital, "A.IMG"),
        ] {
            let (v, notes) = open(&files, which).unwrap();
            assert_eq!((v.lattice, values(&v)), (want.lattice, values(&want)), "{which}");
            assert!(v.anatomical);
            let by_header = which.to_lowercase().contains("hdr");
            assert_eq!(notes.is_empty(), by_header, "{which}: {notes}");
        }
    }
    let mut header = nifti2(false, 1024, [4, 3, 2]);
    let samples = header.split_off(544);
    header.truncate(540);
    header[4..8].copy_from_slice(b"ni2\0");
    header[168..176].fill(0);
    let (v, _) = open(&[("a.hdr", &header), ("a.img", &samples)], "a.hdr").unwrap();
    assert_eq!(values(&v)[23], 23.0);
}

#[test]
fn pair_of_several_times_gives_the_picked_one() {
    let (header, samples) = nifti_pair(false, 4, [4, 3, 2]);
    let mut series = header.clone();
    series[40..42].copy_from_slice(&4i16.to_le_bytes());
    series[48..50].copy_from_slice(&2i16.to_le_bytes());
    let later: Vec<u8> = (100..124i16).flat_map(i16::to_le_bytes).collect();
    let both = [&samples[..], &later].concat();
    let (v, notes) = open(&[("a.hdr", &series), ("a.img", &both)], "a.hdr").unwrap();
    assert_eq!(v.summary.range(), (0.0, 23.0));
    assert!(notes.contains("the first of 2 times was read; --time takes another"), "{notes}");
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.hdr"), &series).unwrap();
    std::fs::write(folder.path().join("a.img"), &both).unwrap();
    let pick = crate::Pick { time: Some(1), ..crate::Pick::default() };
    let hints = crate::Hints { pick, ..crate::Hints::default() };
    for name in ["a.hdr", "a.img"] {
        let opened = crate::open_with(&folder.path().join(name), &hints).unwrap();
        assert_eq!(opened.volume.summary.range(), (100.0, 123.0), "{name}");
    }
}

#[test]
fn analyze_lies_to_the_left_and_says_so() {
    let (_, samples) = nifti_pair(false, 4, [4, 3, 2]);
    let header = analyze(false, 4, [4, 3, 2]);
    let (v, notes) = open(&[("a.hdr", &header), ("a.img", &samples)], "a.img").unwrap();
    assert_eq!(values(&v), (0..24).map(f64::from).collect::<Vec<_>>());
    // The middle of 4 x 3 x 2 samples in steps of 1, 2 and 3 is the origin.
    assert_eq!(v.lattice.steps, [DVec3::NEG_X, DVec3::Y * 2.0, DVec3::Z * 3.0]);
    assert_eq!(v.lattice.origin, DVec3::new(1.5, -2.0, -1.5));
    assert!(v.anatomical && notes.contains("x was taken to the left"), "{notes}");
    assert!(notes.contains("the origin in the middle"), "{notes}");
    let mut spm = header.clone();
    for (a, n) in [2i16, 3, 1].into_iter().enumerate() {
        spm[253 + 2 * a..255 + 2 * a].copy_from_slice(&n.to_le_bytes());
    }
    let (v, notes) = open(&[("a.hdr", &spm), ("a.img", &samples)], "a.hdr").unwrap();
    assert_eq!(v.lattice.origin, DVec3::new(1.0, -4.0, 0.0));
    assert!(notes.contains("the origin as in SPM's originator"), "{notes}");
    let mut coronal = header;
    coronal[252] = 1;
    let (v, notes) = open(&[("a.hdr", &coronal), ("a.img", &samples)], "a.hdr").unwrap();
    assert!(!v.anatomical && notes.contains("orient 1"), "{notes}");
    assert_eq!(v.lattice.steps[0], DVec3::X);
}

#[test]
fn pair_errors_name_file_field_and_remedy() {
    let (header, samples) = nifti_pair(false, 4, [4, 3, 2]);
    let e = open(&[("a.hdr", &header)], "a.hdr").unwrap_err();
    assert!(e.contains("magic: is the header of a pair, and `a.img` is not beside it; put"), "{e}");
    let e = open(&[("a.nii", &header)], "a.nii").unwrap_err();
    assert!(e.contains("is the header of a pair (.hdr with .img), and the file is not called"));
    let e = open(&[("a.hdr", &header), ("a.img", &samples[..40])], "a.hdr").unwrap_err();
    assert!(e.contains("`a.img` data: truncated: 48 bytes are needed and 40 are there"), "{e}");
    let mut far = header.clone();
    far[108..112].copy_from_slice(&100f32.to_le_bytes());
    let e = open(&[("a.hdr", &far), ("a.img", &samples)], "a.hdr").unwrap_err();
    assert!(e.contains("`a.img`") && e.contains("truncated"), "{e}");
    far[108..112].copy_from_slice(&(-4f32).to_le_bytes());
    let e = open(&[("a.hdr", &far), ("a.img", &samples)], "a.hdr").unwrap_err();
    assert!(e.contains("vox_offset: -4.0 is no position in the .img file"), "{e}");
    let mut colours = analyze(false, 128, [4, 3, 2]);
    colours[0..4].copy_from_slice(&348u32.to_le_bytes());
    let e = open(&[("a.hdr", &colours), ("a.img", &samples)], "a.hdr").unwrap_err();
    assert!(e.contains("datatype: a voxel is 3 colours (RGB)"), "{e}");
}
