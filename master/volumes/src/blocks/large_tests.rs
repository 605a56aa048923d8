//! Sources of any size, and files that are read by offsets.

use super::*;
#[cfg(feature = "zarr")]
use crate::Hints;

#[cfg(feature = "zarr")]
fn silent(_: u64, _: u64) -> Result<(), Problem> {
    Ok(())
}

fn whole_level(source: &dyn BlockSource, level: usize) -> Samples {
    source.read_box(level, [0; 3], source.levels()[level].lattice.dims).expect("all samples")
}

#[test]
fn formula_by_blocks_is_the_formula_in_memory_at_all_levels() {
    for size in ["130x67x200", "1x1x700", "64", "1x300x2", "1"] {
        let name = format!("formula:cells:{size}");
        let source = FormulaSource::open(&name).expect("a formula");
        let mut volume = crate::open(name.as_ref()).expect("a volume");
        for level in 0..source.levels().len() {
            let digest = volume.digest();
            let info = volume.info(digest);
            assert_eq!(source.levels()[level], info, "{size} level {level}");
            assert_eq!(whole_level(&source, level), volume.samples, "{size} level {level}");
            let blocks = source.summaries(level).expect("blocks");
            let found = MemorySource::new(&volume, digest).summaries(0).expect("blocks");
            assert_eq!(*blocks, *found, "{size} level {level}");
            if level + 1 < source.levels().len() {
                volume = coarser(&volume).expect("another level");
            }
        }
    }
}

#[test]
fn volumes_of_more_than_2_to_the_32_samples_are_read_at_their_far_end() {
    for (dims, levels) in [
        ([2048, 1024, 1024], 6),
        ([2048, 2048, 2048], 6),
        ([1, 1, 100_000], 12),
        ([64, 64, 5_000_000], 18),
    ] {
        let [nx, ny, nz] = dims;
        let source = FormulaSource::open(&format!("formula:cells:{nx}x{ny}x{nz}")).expect("it");
        assert_eq!(source.levels().len(), levels, "{dims:?}");
        assert_eq!(
            source.levels()[0].summary.total(),
            dims.iter().map(|&n| u64::from(n)).product::<u64>()
        );
        let lo = dims.map(|n: u32| n.saturating_sub(9));
        let Ok(Samples::U8(end)) = source.read_box(0, lo, dims) else { panic!("bytes") };
        assert_eq!(end.last(), Some(&FormulaSource::sample(dims, dims.map(|n| n - 1))));
        // A coarse sample is the mean of the fine ones, far out too.
        for level in 1..levels {
            let (fine, coarse) =
                (&source.levels()[level - 1].lattice, &source.levels()[level].lattice);
            let lo = coarse.dims.map(|n| n.saturating_sub(3));
            let Ok(mean) = source.read_box(level, lo, coarse.dims) else { panic!("bytes") };
            let fine_lo =
                std::array::from_fn(
                    |a| if fine.dims[a] > coarse.dims[a] { 2 * lo[a] } else { lo[a] },
                );
            let under = source.read_box(level - 1, fine_lo, fine.dims).expect("samples");
            let side = std::array::from_fn(|a| fine.dims[a] - fine_lo[a]);
            assert_eq!(halved(fine, side, &under), mean, "{dims:?} level {level}");
        }
        let blocks = source.summaries(levels - 1).expect("blocks");
        assert!(blocks.all.iter().all(|block| block.bins != 0));
    }
    assert!(FormulaSource::open("formula:cells:0x1x1").is_err());
    assert!(FormulaSource::open("formula:cells:99999999x99999999x9").is_err());
}

#[cfg(feature = "zarr")]
#[test]
fn raw_file_is_read_by_offsets_and_known_the_second_time() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("x.nrrd");
    let header = "NRRD0004\ntype: ushort\ndimension: 3\nsizes: 130 70 3\nspacings: 1 1 2\nendian: big\n\
                  encoding: raw\n\n";
    let code = |i: u32| (i * 7 % 3001) as u16;
    let bytes: Vec<u8> =
        header.bytes().chain((0..130 * 70 * 3).flat_map(|i| code(i).to_be_bytes())).collect();
    std::fs::write(&path, &bytes).expect("a file");
    let volume = crate::open(&path).expect("a volume");
    let cache = folder.path().join("cache");
    let mut calls = 0;
    for known in [false, true] {
        let before = calls;
        let mut count = |_, _| {
            calls += 1;
            Ok(())
        };
        let source = open(&path, Some(&cache), Packed::Refused, &mut count).expect("it");
        assert_eq!(calls == before, known, "the sidecar is used");
        assert_eq!(source.levels(), [volume.info(volume.digest())]);
        assert_eq!(whole_level(&*source, 0), volume.samples);
        for (lo, hi) in
            [([3, 5, 1], [9, 60, 3]), ([0, 2, 0], [130, 3, 1]), ([129, 69, 2], [130, 70, 3])]
        {
            let found = source.read_box(0, lo, hi).expect("a box");
            assert_eq!(found, copy_box(&volume.samples, [130, 70, 3], lo, hi));
        }
        let blocks = source.summaries(0).expect("blocks");
        assert_eq!(*blocks, summaries_of(&*source, 0, blocks.bins).expect("blocks"));
        if known {
            std::fs::write(&path, &bytes[..bytes.len() - 2]).expect("a file");
            let e = source.read_box(0, [0; 3], [1; 3]).expect_err("cut off");
            assert!(e.to_string().contains("replaced or changed"), "{e}");
        }
    }
    let packed = folder.path().join("y.nrrd");
    let text = header.replace("raw", "gzip");
    let all = crate::fuzz::gzip(&bytes[header.len()..]);
    std::fs::write(&packed, [text.as_bytes(), &all].concat()).expect("a file");
    let e = open(&packed, Some(&cache), Packed::Refused, &mut silent).err().expect("packed");
    assert!(e.to_string().contains("slabcast convert"), "{e}");
}

#[cfg(feature = "zarr")]
fn open(
    path: &std::path::Path,
    cache: Option<&std::path::Path>,
    packed: Packed,
    on_progress: &mut ome_zarr::OnProgress<'_>,
) -> Result<Arc<dyn BlockSource>, crate::OpenError> {
    open_source(path, &Hints::default(), cache, packed, &mut Vec::new(), on_progress)
}

#[cfg(feature = "zarr")]
#[test]
fn packed_file_is_converted_into_the_cache_once_and_anew_when_it_changes() {
    let folder = tempfile::tempdir().expect("a folder");
    let (path, cache) = (folder.path().join("x.nrrd"), folder.path().join("cache"));
    let header = "NRRD0004\ntype: ushort\ndimension: 3\nsizes: 70 66 5\nspacings: 1 1 2\n\
                  endian: little\nencoding: gzip\n\n";
    let write = |seed: u32| {
        let numbers = (0..70 * 66 * 5u32).flat_map(|i| ((i * seed % 3001) as u16).to_le_bytes());
        let all = crate::fuzz::gzip(&numbers.collect::<Vec<u8>>());
        std::fs::write(&path, [header.as_bytes(), &all].concat()).expect("a file");
        crate::open(&path).expect("a volume")
    };
    let pictures = || {
        let entries = std::fs::read_dir(cache.join("volumes")).expect("the cache");
        entries.map(|e| e.expect("an entry").path()).collect::<Vec<_>>()
    };
    let volume = write(7);
    for _ in 0..2 {
        let source = open(&path, Some(&cache), Packed::Converted, &mut silent).expect("it");
        assert_eq!((source.name(), source.file_type()), ("x.nrrd", &*volume.file_type));
        assert_eq!(source.levels()[0].digest, volume.digest());
        assert_eq!(whole_level(&*source, 0), volume.samples);
        assert_eq!(pictures().len(), 1);
    }
    // A picture that was damaged is made anew.
    std::fs::remove_file(pictures()[0].join("zarr.json")).expect("its metadata");
    let source = open(&path, Some(&cache), Packed::Converted, &mut silent).expect("it");
    assert_eq!(whole_level(&*source, 0), volume.samples);
    let other = write(11);
    let source = open(&path, Some(&cache), Packed::Converted, &mut silent).expect("it");
    assert_eq!(whole_level(&*source, 0), other.samples);
    assert_eq!(pictures().len(), 2);
}
