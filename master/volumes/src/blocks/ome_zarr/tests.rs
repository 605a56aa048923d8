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

/// A mixture that has runs, noise and far-off values.
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
