use super::*;
use crate::blocks::{BlockSource, ValueBins, halved, halved_lattice};
use crate::error::Problem;
use crate::{Hints, open};
use slabcast_common::volume::{Samples, Volume};
use std::path::{Path, PathBuf};

fn silent(_: u64, _: u64) -> Result<(), Problem> {
    Ok(())
}

/// Bytes of 90 x 70 x 67 numbers of a type, as a raw file's name and content.
fn raw(kind: &str, value: impl Fn(usize) -> Vec<u8>) -> (String, Vec<u8>) {
    let bytes = (0..90 * 70 * 67).flat_map(value).collect();
    (format!("x_90x70x67_{kind}.raw"), bytes)
}

/// Returns number `i` of a mixture of runs, noise and far-off values.
fn mixed(i: usize) -> u64 {
    let noise = (i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40;
    if i / 90 % 70 < 20 { 7 } else { noise }
}

/// Files of all ten types, and forms of codes that depend on the range.
fn files() -> Vec<(String, Vec<u8>)> {
    let f = |i: usize| mixed(i) as f32 / 1000.0 - 3.0;
    vec![
        raw("uint8", |i| vec![mixed(i) as u8]),
        raw("int8", |i| vec![mixed(i) as u8]),
        raw("uint16", |i| (mixed(i) as u16).to_le_bytes().to_vec()),
        raw("int16", |i| (mixed(i) as u16 as i16).to_le_bytes().to_vec()),
        raw("uint32", |i| (312_782_574 + mixed(i) as u32).to_le_bytes().to_vec()),
        raw("int32_be", |i| (mixed(i) as i32 % 1000 - 500).to_be_bytes().to_vec()),
        raw("uint64", |i| (u64::MAX - mixed(i) % 999).to_le_bytes().to_vec()),
        raw("int64", |i| (mixed(i) as i64 * (1 << 37) - 5).to_le_bytes().to_vec()),
        raw("float32_be", |i| f(i).to_be_bytes().to_vec()),
        // Outliers and what is no number.
        raw("float", |i| {
            let odd = [f32::NAN, f32::INFINITY, 3e9, f32::NEG_INFINITY];
            let x = if i % 50_000 == 3 { odd[i / 50_000 % 4] } else { f(i) };
            x.to_le_bytes().to_vec()
        }),
        // Fillers.
        raw("float32le", |i| (if i % 7 == 0 { -1e30 } else { f(i) }).to_le_bytes().to_vec()),
        raw("float64", |i| (1e12 + f64::from(f(i))).to_le_bytes().to_vec()),
        raw("f64", |i| f64::from(f(i)).to_le_bytes().to_vec()),
    ]
}

fn put(folder: &Path, name: &str, bytes: &[u8]) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).expect("a file");
    path
}

fn opened(path: &Path) -> OmeZarrSource {
    let no_cache = None;
    OmeZarrSource::open(path, &Hints::default(), no_cache, &mut silent).expect("a pyramid")
}

fn whole(source: &dyn BlockSource, level: usize) -> Samples {
    let dims = source.levels()[level].lattice.dims;
    source.read_box(level, [0; 3], dims).expect("all samples")
}

/// Compares samples by their bits.
fn same(a: &Samples, b: &Samples) -> bool {
    a.kind() == b.kind() && a.len() == b.len() && a.le_bytes(0..a.len()) == b.le_bytes(0..b.len())
}

#[test]
fn all_types_come_back_with_digest_summary_blocks_and_means() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files() {
        let from = put(folder.path(), &name, &bytes);
        let to = folder.path().join(format!("{name}.ome.zarr"));
        let converted = convert(&from, &to, &Hints::default(), false, &mut silent);
        let converted = converted.unwrap_or_else(|e| panic!("{name}: {e}"));
        let volume = open(&from).expect("the raw file");
        let source = opened(&to);
        assert_eq!(converted.levels, source.levels(), "{name}");
        let info = volume.info(volume.digest());
        assert_eq!(source.levels()[0].summary, info.summary, "{name}");
        assert_eq!(source.levels()[0], info, "{name}");
        assert_eq!(source.file_type(), volume.file_type);
        assert!(same(&whole(&source, 0), &volume.samples), "{name}");
        // Each level is the means of the one before; wide types as their own type rounds them.
        let (mut lattice, mut samples) = (volume.lattice, volume.samples.clone());
        for level in 1..source.levels().len() {
            let means = halved(&lattice, lattice.dims, &samples);
            lattice = halved_lattice(&lattice).expect("another level");
            samples = whole(&source, level);
            assert_eq!(source.levels()[level].lattice, lattice, "{name}");
            // Integers of a wide range are rounded to integers, and doubles may be.
            let wide = ["uint32", "int64", "float64"].iter().any(|wide| name.contains(wide));
            let near = |i| (samples.code(i) - means.code(i)).abs() < 1e-6;
            let fits = if wide { (0..means.len()).all(near) } else { same(&samples, &means) };
            assert!(fits, "{name}: level {level}");
            let again = Volume {
                lattice,
                samples: samples.clone(),
                coarse: source.levels()[level].coarse(),
                ..volume.clone()
            };
            assert_eq!(source.levels()[level].digest, again.digest(), "{name}: level {level}");
        }
        assert_eq!(lattice.dims, [45, 35, 34], "{name}");
        let bins = ValueBins::of(&info.summary);
        for level in 0..2 {
            let blocks = source.summaries(level).expect("blocks");
            assert_eq!(blocks.bins, bins);
            let found = crate::blocks::summaries_of(&source, level, bins).expect("blocks");
            assert_eq!(*blocks, found, "{name}: level {level}");
        }
        // Read as a whole, by the other reader.
        let again = open(&to).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(again.digest(), volume.digest(), "{name}");
    }
}

/// Writes the uint16 file of [`files`] as a pyramid of ours, whose name comes with it.
fn pyramid(folder: &Path) -> PathBuf {
    let (name, bytes) = files().swap_remove(2);
    let from = put(folder, &name, &bytes);
    let to = folder.join("x.ome.zarr");
    convert(&from, &to, &Hints::default(), false, &mut silent).expect("a pyramid");
    to
}

#[test]
fn nothing_has_the_final_name_of_a_pyramid_that_was_stopped() {
    let folder = tempfile::tempdir().expect("a folder");
    let (name, bytes) = files().swap_remove(0);
    let from = put(folder.path(), &name, &bytes);
    let to = folder.path().join("x.ome.zarr");
    let mut stop = |done: u64, _: u64| match done > 300_000 {
        true => Err(Problem::stopped()),
        false => Ok(()),
    };
    let e = convert(&from, &to, &Hints::default(), false, &mut stop).expect_err("stopped");
    assert!(e.to_string().contains("was stopped"), "{e}");
    let left: Vec<_> = std::fs::read_dir(folder.path()).expect("a folder").collect();
    assert_eq!(left.len(), 1, "only the raw file: {left:?}");
    // A file that is cut off is refused before anything is written.
    std::fs::write(&from, &bytes[..bytes.len() - 1]).expect("a file");
    assert!(convert(&from, &to, &Hints::default(), false, &mut silent).is_err());
    assert!(!to.exists());
}

#[test]
fn pyramid_is_replaced_only_if_asked_and_no_other_folder_ever() {
    let folder = tempfile::tempdir().expect("a folder");
    let to = pyramid(folder.path());
    let (name, _) = files().swap_remove(2);
    let from = folder.path().join(name);
    let again = |to: &Path, replace| convert(&from, to, &Hints::default(), replace, &mut silent);
    let e = again(&to, false).expect_err("there already");
    assert!(e.to_string().contains("is there already"), "{e}");
    again(&to, true).expect("replaced");
    assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 2);
    let other = folder.path().join("mine.zarr");
    std::fs::create_dir(&other).expect("a folder");
    std::fs::write(other.join("letter"), "dear").expect("a file");
    assert!(again(&other, true).is_err());
    assert!(other.join("letter").exists());
}

/// The directions, slope and intercept of a NIfTI file come back; others see spacings.
#[test]
fn directions_slope_and_intercept_come_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let header = "NRRD0004\ntype: short\ndimension: 3\nspace: left-posterior-superior\nsizes: 70 5 3\n\
                  space directions: (-1,0,0) (0,0,2) (0.1,-1,0)\nspace origin: (1,2,3)\n\
                  endian: little\nencoding: raw\n\n";
    let codes = (0..70 * 5 * 3).flat_map(|i: i16| (i - 400).to_le_bytes());
    let bytes: Vec<u8> = header.bytes().chain(codes).collect();
    let from = put(folder.path(), "x.nrrd", &bytes);
    let to = folder.path().join("x.ome.zarr");
    convert(&from, &to, &Hints::default(), false, &mut silent).expect("a pyramid");
    let (volume, again) = (open(&from).expect("a volume"), open(&to).expect("a volume"));
    assert_eq!((again.lattice, again.anatomical), (volume.lattice, true));
    assert_eq!(again.digest(), volume.digest());
    let source = opened(&to);
    assert_eq!(source.levels()[1].lattice, halved_lattice(&volume.lattice).expect("a level"));
    // Without our attribute the picture is still one, with its spacings.
    let meta = std::fs::read_to_string(to.join("zarr.json")).expect("metadata");
    std::fs::write(to.join("zarr.json"), meta.replace("\"slabcast\":", "\"other\":")).expect("it");
    let foreign = open(&to).expect("a volume");
    assert_eq!(foreign.samples, volume.samples);
    let (a, b) = (foreign.lattice.spacing(), volume.lattice.spacing());
    assert!((0..3).all(|axis| (a[axis] - b[axis]).abs() < 1e-12), "{a:?}");
}

/// Pyramids without a sidecar of ours are looked at once, and then known.
#[test]
fn foreign_pyramid_is_read_once_and_its_sidecar_is_kept_in_the_cache() {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files() {
        let from = put(folder.path(), &name, &bytes);
        let to = folder.path().join(format!("{name}.zarr"));
        convert(&from, &to, &Hints::default(), false, &mut silent).expect("a pyramid");
        let ours = opened(&to);
        std::fs::remove_file(to.join(SIDECAR)).expect("a sidecar");
        let cache = folder.path().join("cache");
        let open = || {
            let mut calls = 0;
            let mut count = |_, _| {
                calls += 1;
                Ok(())
            };
            let source =
                OmeZarrSource::open(&to, &Hints::default(), Some(&cache), &mut count).expect("it");
            (source, calls)
        };
        let ((first, looked), (second, again)) = (open(), open());
        assert!(looked > 0 && again == 0, "{name}: known the second time");
        for source in [&first, &second] {
            assert_eq!(source.levels(), ours.levels(), "{name}");
            for level in 0..source.levels().len() {
                let blocks = |s: &OmeZarrSource| s.summaries(level).expect("blocks");
                assert_eq!(blocks(source), blocks(&ours), "{name}");
            }
        }
    }
}

#[test]
fn pyramid_that_changes_while_it_is_read_is_an_error_that_names_the_file() {
    let folder = tempfile::tempdir().expect("a folder");
    let to = pyramid(folder.path());
    let shard = to.join("0/c/0/0/0");
    let whole = std::fs::read(&shard).expect("a shard");
    let read = |source: &OmeZarrSource| match source.read_box(0, [0; 3], [64, 64, 64]) {
        Ok(_) => "read".to_string(),
        Err(e) => e.to_string(),
    };
    // Gone.
    let source = opened(&to);
    std::fs::remove_file(&shard).expect("it was there");
    assert!(read(&source).contains("chunk 0/c/0/0/0 file: was there"), "{}", read(&source));
    // Cut off after it was opened, and before.
    std::fs::write(&shard, &whole).expect("a file");
    let source = opened(&to).with_cache_bytes(0);
    assert_eq!(read(&source), "read");
    let file = std::fs::OpenOptions::new().write(true).open(&shard).expect("a file");
    file.set_len(100).expect("it is cut off");
    assert!(read(&source).contains("0/c/0/0/0 file: was cut off"), "{}", read(&source));
    // Other bytes under the same name and length: the checksum tells.
    let mut wrong = whole.clone();
    wrong[1000] ^= 1;
    std::fs::write(&shard, &wrong).expect("a file");
    assert!(read(&opened(&to)).contains("checksum"), "{}", read(&opened(&to)));
    // The metadata of another picture.
    std::fs::write(&shard, &whole).expect("a file");
    let source = opened(&to).with_cache_bytes(0);
    let meta = std::fs::read_to_string(to.join("zarr.json")).expect("metadata");
    std::fs::write(to.join("zarr.json"), meta + "\n").expect("a file");
    assert!(read(&source).contains("was replaced or changed"), "{}", read(&source));
}

#[test]
fn shape_of_chunks_that_are_not_there_is_refused_with_the_flag() {
    let folder = tempfile::tempdir().expect("a folder");
    let meta = r#"{"zarr_format": 3, "node_type": "array", "shape": [2000, 2000, 2000],
        "data_type": "uint8", "chunk_key_encoding": {"name": "default"}, "fill_value": 0,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [64, 64, 64]}},
        "codecs": [{"name": "bytes"}]}"#;
    put(folder.path(), "zarr.json", meta.as_bytes());
    let e = OmeZarrSource::open(folder.path(), &Hints::default(), None, &mut silent);
    let e = e.err().expect("too large").to_string();
    assert!(e.contains("give --max-bytes 8000000000"), "{e}");
}

/// Metadata, shards and the sidecar with bytes changed, cut off or repeated: an error, or a
/// picture; no panic.
#[test]
fn mutants_of_a_pyramid_are_refused_or_read() {
    let folder = tempfile::tempdir().expect("a folder");
    let header = "NRRD0004\ntype: short\ndimension: 3\nsizes: 70 5 3\nspacings: 1 1 1\nendian: little\n\
                  encoding: raw\n\n";
    let codes = (0..70 * 5 * 3).flat_map(|i: i16| (i * 31).to_le_bytes());
    let bytes: Vec<u8> = header.bytes().chain(codes).collect();
    let from = put(folder.path(), "x.nrrd", &bytes);
    let to = folder.path().join("x.ome.zarr");
    convert(&from, &to, &Hints::default(), false, &mut silent).expect("a pyramid");
    let digest = open(&from).expect("a volume").digest();
    let mut seed = 1u64;
    let mut below = |n: usize| {
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (seed >> 33) as usize % n
    };
    let mut known = 0;
    for name in [SIDECAR, "zarr.json", "0/zarr.json", "1/zarr.json", "0/c/0/0/0"] {
        let path = to.join(name);
        let whole = std::fs::read(&path).expect("a file");
        for _ in 0..300 {
            let mut bytes = whole.clone();
            let at = below(bytes.len());
            match below(4) {
                0 => bytes.truncate(at),
                1 => bytes[at] ^= 1 << below(8),
                2 => {
                    let digit = b"0123456789-.,\"{}[]"[below(18)];
                    bytes[at] = digit;
                }
                _ => {
                    let from = below(bytes.len());
                    let part = bytes[from.min(at)..from.max(at)].to_vec();
                    bytes.splice(at..at, part);
                }
            }
            std::fs::write(&path, &bytes).expect("a file");
            let hints = Hints { max_bytes: Some(1 << 22), ..Hints::default() };
            let source = OmeZarrSource::open(&to, &hints, None, &mut silent);
            let Ok(source) = source else { continue };
            for level in 0..source.levels().len() {
                let dims = source.levels()[level].lattice.dims;
                if dims.iter().map(|&n| u64::from(n)).product::<u64>() < 1 << 20 {
                    let _ = source.read_box(level, [0; 3], dims);
                }
            }
            // A sidecar is believed only if it is the one that was written.
            if name == SIDECAR {
                assert_eq!(source.levels()[0].digest, digest);
                known += 1;
            }
        }
        std::fs::write(&path, &whole).expect("a file");
    }
    assert_eq!(known, 300, "a damaged sidecar is as good as none");
}
