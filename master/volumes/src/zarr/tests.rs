//! Tests with Zarr folders written in both versions.

use super::*;
use ruzstd::encoding::{CompressionLevel, compress_to_vec};
use serde_json::json;
use slabcast_common::volume::Samples;
use std::path::PathBuf;

/// 5 x 4 x 3 (x, y, z) samples 0, 1, 2, ... of int16.
fn sample(x: u64, y: u64, z: u64) -> i16 {
    (x + 5 * (y + 4 * z)) as i16
}

fn put(folder: &Path, name: &str, bytes: &[u8]) {
    let path = folder.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap();
}

/// The samples of a chunk of `shape` (z, y, x) at `corner`; 99 outside of the array.
fn chunk(corner: [u64; 3], shape: [u64; 3], big: bool, fortran: bool) -> Vec<u8> {
    let mut cells = Vec::new();
    for z in 0..shape[0] {
        for y in 0..shape[1] {
            for x in 0..shape[2] {
                let [z, y, x] = [corner[0] + z, corner[1] + y, corner[2] + x];
                let inside = x < 5 && y < 4 && z < 3;
                cells.push(([x, y, z], if inside { sample(x, y, z) } else { 99 }));
            }
        }
    }
    if fortran {
        // z fastest.
        cells.sort_by_key(|(at, _)| *at);
    }
    cells.iter().flat_map(|(_, v)| if big { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
}

fn packed(bytes: &[u8], how: &str) -> Vec<u8> {
    match how {
        "zstd" => compress_to_vec(bytes, CompressionLevel::Fastest),
        "gzip" => crate::fuzz::gzip(bytes),
        "zlib" => crate::fuzz::zlib(bytes),
        "lz4" => {
            let block = lz4_flex::block::compress(bytes);
            [&(bytes.len() as u32).to_le_bytes()[..], &block].concat()
        }
        "crc32c" => [bytes, &crc32c::crc32c(bytes).to_le_bytes()].concat(),
        "blosc" => {
            let mut head = vec![2, 1, 2, 2];
            for n in [bytes.len(), bytes.len(), bytes.len() + 16] {
                head.extend((n as u32).to_le_bytes());
            }
            [&head[..], bytes].concat()
        }
        _ => bytes.to_vec(),
    }
}

/// An array of version 2.
pub(crate) fn version_2(folder: &Path, how: &str, big: bool, fortran: bool) {
    let compressor = if how == "none" { json!(null) } else { json!({"id": how}) };
    let meta = json!({
        "zarr_format": 2, "shape": [3, 4, 5], "chunks": [2, 2, 3],
        "dtype": if big { ">i2" } else { "<i2" },
        "compressor": compressor, "fill_value": 0, "filters": null,
        "order": if fortran { "F" } else { "C" }, "dimension_separator": "/",
    });
    put(folder, ".zarray", meta.to_string().as_bytes());
    for z in 0..2 {
        for y in 0..2 {
            for x in 0..2 {
                let bytes = chunk([2 * z, 2 * y, 3 * x], [2, 2, 3], big, fortran);
                put(folder, &format!("{z}/{y}/{x}"), &packed(&bytes, how));
            }
        }
    }
}

fn meta_3(codecs: serde_json::Value, grid: [u64; 3]) -> serde_json::Value {
    json!({
        "zarr_format": 3, "node_type": "array", "shape": [3, 4, 5], "data_type": "int16",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": grid}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": -7, "codecs": codecs, "attributes": {},
    })
}

/// An array of version 3 in one shard of chunks of 1 x 2 x 5.
pub(crate) fn sharded(folder: &Path) {
    let bytes = |endian: &str| json!({"name": "bytes", "configuration": {"endian": endian}});
    let codecs = json!([{"name": "sharding_indexed", "configuration": {
        "chunk_shape": [1, 2, 5],
        "codecs": [
            bytes("little"),
            {"name": "zstd", "configuration": {"level": 1, "checksum": false}},
        ],
        "index_codecs": [bytes("little"), {"name": "crc32c"}],
        "index_location": "end",
    }}]);
    put(folder, "zarr.json", meta_3(codecs, [4, 4, 5]).to_string().as_bytes());
    let (mut file, mut index) = (Vec::new(), Vec::new());
    for z in 0..4u64 {
        for y in 0..2 {
            // The last layer is outside, and was never written; nor was one chunk inside.
            if z == 3 || (z, y) == (1, 0) {
                index.extend([0xff; 16]);
                continue;
            }
            let bytes = packed(&chunk([z, 2 * y, 0], [1, 2, 5], false, false), "zstd");
            index.extend((file.len() as u64).to_le_bytes());
            index.extend((bytes.len() as u64).to_le_bytes());
            file.extend(bytes);
        }
    }
    file.extend(packed(&index, "crc32c"));
    put(folder, "c/0/0/0", &file);
}

fn values(v: &Volume) -> Vec<i16> {
    (0..v.samples.len()).map(|i| v.summary.map.value(v.samples.code(i)) as i16).collect()
}

#[test]
fn zarr_version_2_is_read_in_every_compression_and_order() {
    for (how, big, fortran) in [
        ("none", false, false),
        ("none", true, true),
        ("zlib", false, false),
        ("gzip", false, false),
        ("zstd", true, false),
        ("lz4", false, true),
        ("blosc", false, false),
    ] {
        let dir = tempfile::tempdir().unwrap();
        version_2(dir.path(), how, big, fortran);
        let v = crate::open(dir.path()).unwrap_or_else(|e| panic!("{how}: {e}"));
        assert_eq!((v.lattice.dims, v.file_type.as_str()), ([5, 4, 3], "int16"));
        assert_eq!(values(&v), (0..60).collect::<Vec<i16>>(), "{how} {big} {fortran}");
    }
}

#[test]
fn zarr_version_3_is_read_with_codecs_shards_and_missing_chunks() {
    let dir = tempfile::tempdir().unwrap();
    sharded(dir.path());
    let want: Vec<i16> = (0..60).map(|i| if (20..30).contains(&i) { -7 } else { i }).collect();
    assert_eq!(values(&crate::open(dir.path()).unwrap()), want);
    let dir = tempfile::tempdir().unwrap();
    let codecs = json!([
        {"name": "transpose", "configuration": {"order": [2, 1, 0]}},
        {"name": "bytes", "configuration": {"endian": "big"}},
        {"name": "gzip", "configuration": {"level": 1}},
        {"name": "crc32c"},
    ]);
    put(dir.path(), "zarr.json", meta_3(codecs, [3, 4, 5]).to_string().as_bytes());
    let bytes = packed(&packed(&chunk([0; 3], [3, 4, 5], true, true), "gzip"), "crc32c");
    put(dir.path(), "c/0/0/0", &bytes);
    assert_eq!(values(&crate::open(dir.path()).unwrap()), (0..60).collect::<Vec<i16>>());
}

/// A pyramid of two levels with a channel axis.
pub(crate) fn pyramid(folder: &Path) {
    let level = |name: &str, shape: [u64; 4], value: u8| {
        let meta = json!({
            "zarr_format": 2, "shape": shape, "chunks": [1, 64, 64, 64], "dtype": "|u1",
            "compressor": null, "fill_value": value, "filters": null, "order": "C",
        });
        put(folder, &format!("{name}/.zarray"), meta.to_string().as_bytes());
    };
    level("0", [2, 4, 6, 8], 10);
    level("1", [2, 2, 3, 4], 20);
    let step = |s: f64| {
        json!([{"type": "scale", "scale": [1, 3.0 * s, 2.0 * s, s]},
                               {"type": "translation", "translation": [0, 0, 0, 5]}])
    };
    let attributes = json!({"multiscales": [{"version": "0.4", "name": "cells", "axes": [
        {"name": "c", "type": "channel"}, {"name": "z", "type": "space", "unit": "micrometer"},
        {"name": "y", "type": "space", "unit": "micrometer"},
        {"name": "x", "type": "space", "unit": "micrometer"}],
        "datasets": [{"path": "0", "coordinateTransformations": step(1.0)},
                     {"path": "1", "coordinateTransformations": step(2.0)}]}]});
    put(folder, ".zattrs", attributes.to_string().as_bytes());
    put(folder, ".zgroup", b"{\"zarr_format\":2}");
}

#[test]
fn zarr_pyramid_opens_the_finest_level_that_fits_and_notes_it() {
    let dir = tempfile::tempdir().unwrap();
    pyramid(dir.path());
    let open = |hints: Hints| crate::open_with(dir.path(), &hints);
    let opened = open(Hints::default()).unwrap();
    assert_eq!(opened.volume.lattice.dims, [8, 6, 4]);
    let near = |a: [f64; 3], b: [f64; 3]| (0..3).all(|i| (a[i] - b[i]).abs() < 1e-12);
    assert!(near(opened.volume.lattice.spacing(), [1e-3, 2e-3, 3e-3]));
    assert!(near(opened.volume.lattice.origin.to_array(), [5e-3, 0.0, 0.0]));
    assert!(
        opened.notes[0].contains("level 0 of 0 to 1 was read (8 x 6 x 4)"),
        "{:?}",
        opened.notes
    );
    assert!(opened.notes[1].contains("the first of 2 along `c`"), "{:?}", opened.notes);
    let small = Hints { max_bytes: Some(100), ..Hints::default() };
    assert_eq!(open(small).unwrap().volume.samples, Samples::U8(vec![20; 24]));
    let asked = Hints { level: Some(1), ..Hints::default() };
    assert_eq!(open(asked).unwrap().volume.lattice.dims, [4, 3, 2]);
    let e = open(Hints { level: Some(2), ..Hints::default() }).unwrap_err().to_string();
    assert!(e.contains("--level: 2 is not there: the picture has 2 levels"), "{e}");
    let e = open(Hints { max_bytes: Some(3), ..Hints::default() }).unwrap_err().to_string();
    assert!(e.contains("no level of") && e.contains("--max-bytes"), "{e}");
}

#[test]
fn zarr_errors_name_field_and_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let at = |name: &str| -> PathBuf { dir.path().join(name) };
    let array = |name: &str, from: &str, to: &str| {
        version_2(&at(name), "zlib", false, false);
        let meta = std::fs::read_to_string(at(name).join(".zarray")).unwrap();
        assert!(meta.contains(from), "{meta}");
        put(&at(name), ".zarray", meta.replace(from, to).as_bytes());
    };
    array("type", "<i2", "<c8");
    array("codec", "\"zlib\"", "\"lzma\"");
    array("chunk", "[2,2,3]", "[2,0,3]");
    array("large", "[2,2,3]", "[2000,2000,300]");
    array("long", "[3,4,5]", "[3,4,99999]");
    array("order", "\"C\"", "\"D\"");
    array("rank", "[2,2,3]", "[2,3]");
    array("json", "{", "");
    array("cut", "<i2", "<i4");
    pyramid(&at("out"));
    let text = std::fs::read_to_string(at("out/.zattrs")).unwrap();
    put(&at("out"), ".zattrs", text.replace("\"path\":\"0\"", "\"path\":\"../type\"").as_bytes());
    pyramid(&at("axes"));
    put(&at("axes"), ".zattrs", text.replace("\"name\":\"x\"", "\"name\":\"w\"").as_bytes());
    put(&at("group"), ".zgroup", b"{}");
    sharded(&at("shard"));
    put(&at("shard"), "c/0/0/0", b"short");
    for (name, say) in [
        ("type", ".zarray dtype: `\\\"<c8\\\"` is not read here; it should be"),
        ("codec", ".zarray compressor id: `\\\"lzma"),
        ("chunk", "chunk_shape"),
        ("large", "write the array again with smaller chunks"),
        ("long", "shape: 99999 x 4 x 3 is longer than 16384"),
        ("order", ".zarray order: `\\\"D"),
        ("rank", "shape: has 3 axes and chunks of 2"),
        ("json", ".zarray: is no JSON"),
        ("cut", "chunk 0/0/0 data: has 24 bytes of samples, not 48"),
        ("out", "datasets path: `../type` lies outside"),
        ("axes", "has no x and y"),
        ("group", "is no OME-Zarr picture"),
        ("shard", "chunk c/0/0/0 data: has 5 bytes, less than its index"),
    ] {
        let e = crate::open(&at(name)).unwrap_err().to_string();
        assert!(e.contains(say), "{name}: want {say:?} in {e}");
    }
}
