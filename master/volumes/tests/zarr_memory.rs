//! Tests that reading a Zarr array takes only a few chunks of memory beside the voxels, since
//! chunks are decoded straight to their place.
//!
//! A test program of its own, since it measures the peak memory of the process.
#![cfg(all(feature = "zarr", target_os = "linux"))]

use flate2::Compression;
use flate2::write::GzEncoder;
use slabcast_common::volume::{Samples, Volume};
use slabcast_volumes::open;
use std::io::Write;
use std::path::Path;

/// Most memory beside the samples in the file's type.
const BESIDE_MIB: u64 = 64;

fn put(folder: &Path, name: &str, bytes: &[u8]) {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
    std::fs::write(path, bytes).expect("a file");
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gz = GzEncoder::new(Vec::new(), Compression::fast());
    gz.write_all(bytes).expect("memory takes all");
    gz.finish().expect("memory takes all")
}

fn meta(kind: &str, shape: [u64; 3], grid: [u64; 3], codecs: &str) -> String {
    format!(
        r#"{{"zarr_format": 3, "node_type": "array", "shape": {shape:?}, "data_type": "{kind}",
        "chunk_grid": {{"name": "regular", "configuration": {{"chunk_shape": {grid:?}}}}},
        "chunk_key_encoding": {{"name": "default"}}, "fill_value": 0, "codecs": {codecs}}}"#
    )
}

/// The codecs of a chunk.
const PACKED: &str = r#"[{"name": "bytes", "configuration": {"endian": "little"}},
    {"name": "gzip", "configuration": {"level": 1}}]"#;

/// 512 x 512 x 256 uint16 in chunks of 64^3: sample (x, y, z) is the same in each.
fn chunked(folder: &Path) {
    put(folder, "zarr.json", meta("uint16", [256, 512, 512], [64; 3], PACKED).as_bytes());
    let chunk: Vec<u8> = (0..64u32.pow(3)).flat_map(|i| (i as u16).to_le_bytes()).collect();
    put(folder, "chunk", &gzip(&chunk));
    for z in 0..4 {
        for y in 0..8 {
            std::fs::create_dir_all(folder.join(format!("c/{z}/{y}"))).expect("a folder");
            for x in 0..8 {
                let to = folder.join(format!("c/{z}/{y}/{x}"));
                std::fs::hard_link(folder.join("chunk"), to).expect("a link");
            }
        }
    }
}

/// 256 x 256 x 512 float64 in one shard of chunks of 64^3, which all lie at the same place.
fn sharded(folder: &Path) {
    let shard = format!(
        r#"[{{"name": "sharding_indexed", "configuration": {{"chunk_shape": [64, 64, 64],
        "codecs": {PACKED}, "index_codecs": [{{"name": "bytes"}}]}}}}]"#
    );
    let shape = [512, 256, 256];
    put(folder, "zarr.json", meta("float64", shape, shape, &shard).as_bytes());
    let chunk: Vec<u8> = (0..64u32.pow(3)).flat_map(|i| f64::from(i).to_le_bytes()).collect();
    let mut file = gzip(&chunk);
    let entry = [0, file.len() as u64].map(u64::to_le_bytes).concat();
    file.extend(entry.repeat(8 * 4 * 4));
    put(folder, "c/0/0/0", &file);
}

/// Returns a memory figure of this process in MiB.
fn memory_mib(figure: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("a status");
    let line = status.lines().find(|l| l.starts_with(figure)).expect("the figure is there");
    let kib = line.split_ascii_whitespace().nth(1).and_then(|n| n.parse::<u64>().ok());
    kib.expect("a number") / 1024
}

/// Opens an array and returns with it by how many MiB the process grew at its peak.
fn opened(folder: &Path) -> (Volume, u64) {
    // Resets the peak (proc(5)).
    std::fs::write("/proc/self/clear_refs", "5").expect("the peak can be begun anew");
    let before = memory_mib("VmRSS:");
    let volume = open(folder).expect("an array");
    (volume, memory_mib("VmHWM:").saturating_sub(before))
}

#[test]
fn zarr_array_is_never_in_memory_twice() {
    let dir = tempfile::tempdir().expect("a folder");
    let (plain, shard) = (dir.path().join("chunked"), dir.path().join("sharded"));
    chunked(&plain);
    sharded(&shard);

    let (volume, grew) = opened(&plain);
    let stored = (512 * 512 * 256 * 2) >> 20;
    println!("uint16 in chunks: {stored} MiB of samples, grew by {grew} MiB");
    assert!(grew <= stored + BESIDE_MIB, "grew by {grew} MiB for {stored} MiB of samples");
    let Samples::U16(codes) = &volume.samples else { panic!("{:?}", volume.samples.kind()) };
    let in_chunk = |i: usize| [i % 512, i / 512 % 512, i / (512 * 512)].map(|n| n % 64);
    assert!(
        codes
            .iter()
            .enumerate()
            .all(|(i, &c)| usize::from(c) == number_in_chunk(in_chunk(i)) % 65536)
    );
    drop(volume);

    let (volume, grew) = opened(&shard);
    let stored = (256 * 256 * 512 * 8) >> 20;
    println!("float64 in a shard: {stored} MiB of samples, grew by {grew} MiB");
    assert!(grew <= stored + BESIDE_MIB, "grew by {grew} MiB for {stored} MiB of samples");
    let Samples::F32(codes) = &volume.samples else { panic!("{:?}", volume.samples.kind()) };
    let in_chunk = |i: usize| [i % 256, i / 256 % 256, i / (256 * 256)].map(|n| n % 64);
    assert!(codes.iter().enumerate().all(|(i, &c)| c as usize == number_in_chunk(in_chunk(i))));
}

/// Returns the sample at a position of a chunk.
fn number_in_chunk([x, y, z]: [usize; 3]) -> usize {
    (z * 64 + y) * 64 + x
}
