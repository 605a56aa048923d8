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
        "bz2" => crate::fuzz::bzip2(bytes),
        "lzma" => crate::fuzz::xz(bytes),
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

/// An array of version 3 in one shard of 2 x 2 x 1 shards, each of chunks of 1 x 2 x 5.
pub(crate) fn nested(folder: &Path) {
    let bytes = json!({"name": "bytes", "configuration": {"endian": "little"}});
    let shard = |inner: [u64; 3], codecs: serde_json::Value| {
        json!([{"name": "sharding_indexed", "configuration": {
            "chunk_shape": inner, "codecs": codecs, "index_codecs": [bytes, {"name": "crc32c"}],
        }}])
    };
    let codecs = shard([2, 2, 5], shard([1, 2, 5], json!([bytes, {"name": "gzip"}])));
    put(folder, "zarr.json", meta_3(codecs, [4, 4, 5]).to_string().as_bytes());
    let pack = |parts: Vec<Vec<u8>>| {
        let (mut file, mut index) = (Vec::new(), Vec::new());
        for part in parts {
            index.extend((file.len() as u64).to_le_bytes());
            index.extend((part.len() as u64).to_le_bytes());
            file.extend(part);
        }
        file.extend(packed(&index, "crc32c"));
        file
    };
    let inner = |z: u64, y: u64| packed(&chunk([z, 2 * y, 0], [1, 2, 5], false, false), "gzip");
    let middle = |z: u64, y: u64| pack(vec![inner(2 * z, y), inner(2 * z + 1, y)]);
    let file = pack(vec![middle(0, 0), middle(0, 1), middle(1, 0), middle(1, 1)]);
    put(folder, "c/0/0/0", &file);
}

#[test]
fn zarr_shards_in_a_shard_are_read() {
    let dir = tempfile::tempdir().unwrap();
    nested(dir.path());
    assert_eq!(values(&crate::open(dir.path()).unwrap()), (0..60).collect::<Vec<i16>>());
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
        ("bz2", false, false),
        ("lzma", true, false),
    ] {
        let dir = tempfile::tempdir().unwrap();
        version_2(dir.path(), how, big, fortran);
        let v = crate::open(dir.path()).unwrap_or_else(|e| panic!("{how}: {e}"));
        assert_eq!((v.lattice.dims, v.file_type.as_str()), ([5, 4, 3], "int16"));
        assert_eq!(values(&v), (0..60).collect::<Vec<i16>>(), "{how} {big} {fortran}");
    }
}

#[test]
fn zarr_filters_and_codecs_of_numcodecs_are_read_in_both_versions() {
    // Differences of int16 in the order of storage, shuffled or not.
    let delta = |big: bool| -> Vec<u8> {
        let mut before = 0i16;
        let differences = (0..60i16).flat_map(|i| {
            let d = i * 500 - before;
            before = i * 500;
            if big { d.to_be_bytes() } else { d.to_le_bytes() }
        });
        differences.collect()
    };
    let shuffled = |bytes: &[u8]| -> Vec<u8> {
        [0, 1].iter().flat_map(|b| bytes.iter().skip(*b).step_by(2).copied()).collect()
    };
    let want: Vec<i16> = (0..60).map(|i| i * 500).collect();
    for big in [false, true] {
        let kind = if big { ">i2" } else { "<i2" };
        let dir = tempfile::tempdir().unwrap();
        let meta = json!({
            "zarr_format": 2, "shape": [3, 4, 5], "chunks": [3, 4, 5], "dtype": kind,
            "compressor": {"id": "zlib"}, "fill_value": 0, "order": "C",
            "filters": [{"id": "delta", "dtype": kind}, {"id": "shuffle", "elementsize": 2}],
        });
        put(dir.path(), ".zarray", meta.to_string().as_bytes());
        put(dir.path(), "0.0.0", &packed(&shuffled(&delta(big)), "zlib"));
        assert_eq!(values(&crate::open(dir.path()).unwrap()), want, "{kind}");
        let dir = tempfile::tempdir().unwrap();
        let endian = if big { "big" } else { "little" };
        let codecs = json!([
            {"name": "numcodecs.delta", "configuration": {"dtype": "<i2"}},
            {"name": "bytes", "configuration": {"endian": endian}},
            {"name": "numcodecs.bz2", "configuration": {"level": 1}},
        ]);
        put(dir.path(), "zarr.json", meta_3(codecs, [3, 4, 5]).to_string().as_bytes());
        put(dir.path(), "c/0/0/0", &packed(&delta(big), "bz2"));
        assert_eq!(values(&crate::open(dir.path()).unwrap()), want, "version 3, {endian}");
    }
    let dir = tempfile::tempdir().unwrap();
    for (codec, say) in [
        (json!({"name": "numcodecs.zfpy"}), "[0] name: `numcodecs.zfpy` is not read here"),
        (
            json!({"name": "numcodecs.delta", "configuration": {"dtype": "<i4", "astype": "<i2"}}),
            "dtype: `<i4` is not read here; it should be of a number type, and `astype` the same",
        ),
        (
            json!({"name": "numcodecs.lzma", "configuration": {"format": 3}}),
            "format: `3` is not read here; it should be 1, that of xz",
        ),
    ] {
        put(dir.path(), "zarr.json", meta_3(json!([codec]), [3, 4, 5]).to_string().as_bytes());
        let e = crate::open(dir.path()).unwrap_err().to_string();
        assert!(e.contains(say), "{e}");
    }
}

#[test]
fn zarr_truth_and_half_floats_are_read() {
    let dir = tempfile::tempdir().unwrap();
    let array = |kind: &str, fill: serde_json::Value, chunk: Option<&[u8]>| {
        let _ = std::fs::remove_file(dir.path().join("0.0.0"));
        let meta = json!({
            "zarr_format": 2, "shape": [1, 2, 3], "chunks": [1, 2, 3], "dtype": kind,
            "compressor": null, "fill_value": fill, "order": "C", "filters": null,
        });
        put(dir.path(), ".zarray", meta.to_string().as_bytes());
        chunk.into_iter().for_each(|bytes| put(dir.path(), "0.0.0", bytes));
        let v = crate::open(dir.path()).unwrap();
        let codes = (0..6).map(|i| v.summary.map.value(v.samples.code(i)));
        (v.file_type.clone(), codes.collect::<Vec<f64>>())
    };
    let (kind, values) = array("|b1", json!(false), Some(&[0, 1, 1, 0, 0, 1]));
    assert_eq!((kind.as_str(), values), ("bool", vec![0.0, 1.0, 1.0, 0.0, 0.0, 1.0]));
    assert_eq!(array("|b1", json!(true), None).1, [1.0; 6]);
    for (order, big) in [("<", false), (">", true)] {
        let halves = [0x3c00u16, 0xc000, 0x0001, 0x3800, 0, 0x7bff];
        let bytes = halves.map(|h| if big { h.to_be_bytes() } else { h.to_le_bytes() }).concat();
        let (kind, values) = array(&format!("{order}f2"), json!(0.0), Some(&bytes));
        assert_eq!(kind, "float16");
        assert_eq!(values, [1.0, -2.0, 2f64.powi(-24), 0.5, 0.0, 65504.0]);
        assert_eq!(array(&format!("{order}f2"), json!(1.5), None).1, [1.5; 6]);
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
    array("codec", "\"zlib\"", "\"lzma2\"");
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
        ("type", ".zarray dtype: `<c8` is not read here; it should be"),
        ("codec", ".zarray compressor id: `lzma2`"),
        ("chunk", "chunk_shape"),
        ("large", "write the array again with smaller chunks"),
        ("long", "shape: 99999 x 4 x 3 is longer than 16384"),
        ("order", ".zarray order: `D`"),
        ("rank", "shape: has 3 axes and chunks of 2"),
        ("json", ".zarray: is no JSON"),
        ("cut", "chunk 0/0/0 data: has 24 bytes of samples, not 48"),
        ("out", "`../type/.zarray` is not there, or leads out of the folder"),
        ("axes", "has no x and y"),
        ("group", "is no OME-Zarr picture"),
        ("shard", "chunk c/0/0/0 data: has 5 bytes, less than its index"),
    ] {
        let e = crate::open(&at(name)).unwrap_err().to_string();
        assert!(e.contains(say), "{name}: want {say:?} in {e}");
    }
}

/// An array of one zstd chunk of 64^3 bytes in the folder, and its chunk.
fn one_zstd_chunk(folder: &Path, chunk: &[u8]) {
    let meta = json!({
        "zarr_format": 2, "shape": [64, 64, 64], "chunks": [64, 64, 64], "dtype": "|u1",
        "compressor": {"id": "zstd", "level": 1}, "fill_value": 0, "filters": null, "order": "C",
    });
    put(folder, ".zarray", meta.to_string().as_bytes());
    put(folder, "0.0.0", chunk);
}

/// A zstd frame whose second block repeats one match of 131,074 bytes `n` times (RUSTSEC-2026-0344:
/// ruzstd up to 0.9.0 let such a block grow to gigabytes, and panicked beyond 8).
fn growing_block(n: u16) -> Vec<u8> {
    let mut body = b"\x08A\xff".to_vec();
    body.extend((n - 0x7f00).to_le_bytes());
    body.extend(b"\x54\x00\x00\x34");
    body.extend([0xff, 0xff].repeat(n.into()));
    body.push(1);
    let block = |kind: u32, bytes: &[u8]| {
        let head = ((bytes.len() as u32) << 3 | kind).to_le_bytes();
        [&head[..3], bytes].concat()
    };
    [b"\x28\xb5\x2f\xfd\x00\x38", &block(0, b"ABCDEFGH")[..], &block(2 << 1 | 1, &body)].concat()
}

#[test]
fn zstd_chunk_that_grows_past_its_size_is_refused_small() {
    let dir = tempfile::tempdir().unwrap();
    for n in [0x7f00, 48_000, 65_000] {
        let chunk = growing_block(n);
        assert!(chunk.len() < 131_072);
        one_zstd_chunk(dir.path(), &chunk);
        let _ = std::fs::write("/proc/self/clear_refs", "5");
        let before = crate::fuzz::resident_kib("VmHWM:");
        let e = crate::open(dir.path()).unwrap_err().to_string();
        assert!(e.contains("chunk 0.0.0 data: "), "{e}");
        let grew = crate::fuzz::resident_kib("VmHWM:").saturating_sub(before) >> 10;
        // Other tests run beside this one; 4.1 GiB is what it was.
        assert!(grew < 256, "{n}: grew by {grew} MiB");
    }
}

#[test]
fn zstd_header_that_declares_more_than_a_chunk_is_refused_unread() {
    let dir = tempfile::tempdir().unwrap();
    let packed = compress_to_vec(&[7u8; 1 << 18][..], CompressionLevel::Fastest);
    let magic = b"\x28\xb5\x2f\xfd";
    // A window byte and eight bytes of content size; a single segment of four.
    for (head, say) in [
        (&b"\xc0\x38\xff\xff\xff\xff\xff\xff\xff\xff"[..], "becomes 18446744073709551615 bytes"),
        (b"\xa0\x01\x00\x04\x00", "becomes 262145 bytes, more than 262144"),
        (b"\x00\xf8", "asks for a window of"),
        (b"\xa0\x01", "no whole zstd header"),
    ] {
        one_zstd_chunk(dir.path(), &[&magic[..], head].concat());
        let e = crate::open(dir.path()).unwrap_err().to_string();
        assert!(e.contains(say), "want {say:?} in {e}");
    }
    one_zstd_chunk(dir.path(), &packed);
    assert_eq!(crate::open(dir.path()).unwrap().samples, Samples::U8(vec![7; 1 << 18]));
}

#[test]
fn zarr_of_billions_of_chunks_or_bytes_is_refused_before_it_is_looked_at() {
    let dir = tempfile::tempdir().unwrap();
    let meta = |shape: [u64; 3], chunks: [u64; 3]| {
        let meta = json!({
            "zarr_format": 2, "shape": shape, "chunks": chunks, "dtype": "|u1",
            "compressor": null, "fill_value": 0, "filters": null, "order": "C",
        });
        put(dir.path(), ".zarray", meta.to_string().as_bytes());
        let start = std::time::Instant::now();
        let result = crate::open(dir.path()).map(|v| v.lattice.dims).map_err(|e| e.to_string());
        assert!(start.elapsed().as_secs() < 5, "{shape:?} took {:?}", start.elapsed());
        result
    };
    let e = meta([1000, 2000, 2000], [1, 1, 1]).unwrap_err();
    assert!(e.contains("chunk_shape: 4000000000 chunk files are more than 1048576"), "{e}");
    let e = meta([2000, 2000, 2000], [100, 100, 100]).unwrap_err();
    assert!(e.contains("shape: 0 bytes of file become 8000000000 bytes"), "{e}");
    assert!(e.contains("--max-bytes 8000000000"), "{e}");
    // Pages that hold nothing but the fill value are not counted against small arrays.
    assert_eq!(meta([64, 64, 64], [8, 8, 8]), Ok([64; 3]));
}

#[test]
fn zarr_of_millions_of_inner_chunks_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    sharded(dir.path());
    let text = std::fs::read_to_string(dir.path().join("zarr.json")).unwrap();
    let mut meta: serde_json::Value = serde_json::from_str(&text).unwrap();
    meta["shape"] = json!([256, 256, 512]);
    meta["chunk_grid"]["configuration"]["chunk_shape"] = json!([256, 256, 512]);
    meta["codecs"][0]["configuration"]["chunk_shape"] = json!([1, 1, 1]);
    put(dir.path(), "zarr.json", meta.to_string().as_bytes());
    let e = crate::open(dir.path()).unwrap_err().to_string();
    assert!(e.contains("chunk_shape: 33554432 inner chunks are more than 4194304"), "{e}");
}

#[cfg(unix)]
#[test]
fn zarr_links_out_of_the_folder_are_refused_whatever_they_lead_to() {
    use std::os::unix::fs::symlink;
    let dir = tempfile::tempdir().unwrap();
    let outside = dir.path().join("outside");
    version_2(&outside, "none", false, false);
    // Each with its target, which exists in the first case and does not in the second.
    for exists in [true, false] {
        let target = |name: &str| match exists {
            true => outside.join(name),
            false => outside.join("nothing").join(name),
        };
        let case = |name: &str| {
            let folder = dir.path().join(format!("{exists}-{name}"));
            version_2(&folder, "none", false, false);
            folder
        };
        let refused = |folder: &Path, field: &str| {
            let e = crate::open(folder).unwrap_err();
            let (kind, line) = (e.problem.kind, e.to_string());
            assert_eq!(kind, OpenErrorKind::Forbidden, "{line}");
            let say = format!("{field} is not there, or leads out of the folder");
            assert!(line.contains(&say), "want {say:?} in {line}");
        };
        let again = |path: &Path, target: &Path| {
            let _ = std::fs::remove_file(path);
            let _ = std::fs::remove_dir_all(path);
            symlink(target, path).unwrap();
        };
        let folder = case("chunk");
        again(&folder.join("0/1/0"), &target("0/1/0"));
        refused(&folder, "chunk 0/1/0 file: its file");
        again(&folder.join("0/1/0"), Path::new("../../../outside/0/1/0"));
        refused(&folder, "chunk 0/1/0 file: its file");
        let folder = case("folder-of-chunks");
        again(&folder.join("1"), &target("1"));
        refused(&folder, "chunk 1/0/0 file: its file");
        let folder = case("metadata");
        again(&folder.join(".zarray"), &target(".zarray"));
        refused(&folder, ".zarray: `.zarray`");
        let folder = dir.path().join(format!("{exists}-level"));
        pyramid(&folder);
        again(&folder.join("0"), &target(""));
        let e = crate::open(&folder).unwrap_err().to_string();
        assert!(e.contains("is not there, or leads out of the folder"), "{e}");
    }
    // Links inside are followed, also of a whole path.
    let folder = dir.path().join("links-inside");
    version_2(&folder, "none", false, false);
    let (from, to) = (folder.join("0/1/0"), folder.join("kept"));
    std::fs::rename(&from, &to).unwrap();
    symlink("../../kept", &from).unwrap();
    assert_eq!(values(&crate::open(&folder).unwrap()), (0..60).collect::<Vec<i16>>());
    std::fs::remove_file(&from).unwrap();
    symlink(&to, &from).unwrap();
    assert_eq!(values(&crate::open(&folder).unwrap()), (0..60).collect::<Vec<i16>>());
}

/// A picture of version 0.4 with an array of uint8 of one value.
fn picture(folder: &Path, shape: &[u64], axes: serde_json::Value, scale: serde_json::Value) {
    let meta = json!({
        "zarr_format": 2, "shape": shape, "chunks": vec![8; shape.len()], "dtype": "|u1",
        "compressor": null, "fill_value": 1, "filters": null, "order": "C",
    });
    put(folder, "0/.zarray", meta.to_string().as_bytes());
    let attributes = json!({"multiscales": [{"version": "0.4", "axes": axes, "datasets": [
        {"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}]}]});
    put(folder, ".zattrs", attributes.to_string().as_bytes());
    put(folder, ".zgroup", b"{\"zarr_format\":2}");
}

#[test]
fn ome_zarr_axes_without_unit_or_z_take_those_of_x_and_say_so() {
    let um = |name: &str| json!({"name": name, "type": "space", "unit": "micrometer"});
    let with = |unit: &str| json!({"name": "z", "type": "space", "unit": unit});
    let bare = |name: &str| json!({"name": name, "type": "space"});
    for (axes, scale, want, say) in [
        (json!([bare("z"), um("y"), um("x")]), json!([0.5, 0.5, 0.5]), [0.5e-3; 3], "no unit"),
        (json!([um("y"), um("x")]), json!([0.5, 0.5]), [0.5e-3; 3], "not say the step along z"),
        (
            json!([with("furlong"), um("y"), um("x")]),
            json!([2, 1, 1]),
            [1e-3, 1e-3, 2e-3],
            "the unit `furlong`",
        ),
        (json!([with("angstrom"), um("y"), um("x")]), json!([2e4, 1, 1]), [1e-3, 1e-3, 2e-3], ""),
        (json!([with("decimeter"), um("y"), um("x")]), json!([2e-5, 1, 1]), [1e-3, 1e-3, 2e-3], ""),
        (
            json!([bare("z"), bare("y"), bare("x")]),
            json!([3, 2, 2]),
            [2.0, 2.0, 3.0],
            "along x, y, z has no unit; mm were taken",
        ),
        (json!([bare("z"), bare("y"), bare("x")]), json!([1, 1, 1]), [1.0; 3], ""),
    ] {
        let dir = tempfile::tempdir().unwrap();
        let shape = [4, 4, 4];
        picture(dir.path(), &shape[..axes.as_array().unwrap().len()], axes.clone(), scale);
        let opened = crate::open_with(dir.path(), &Hints::default()).unwrap();
        let got = opened.volume.lattice.spacing();
        assert!((0..3).all(|a| (got[a] / want[a] - 1.0).abs() < 1e-12), "{axes}: {got:?}");
        let notes = opened.notes.join("\n");
        assert!(notes.contains(say) && notes.is_empty() == say.is_empty(), "{axes}: {notes}");
    }
}

/// Opens an array of int16 0, 1, 2, ... in the order of its axes, and returns its volume and notes.
fn named(shape: &[u64], names: serde_json::Value, version: u64) -> (Volume, String) {
    picked(shape, names, version, crate::Pick::default())
}

/// Opens an array whose axes have names, of which `pick` takes a volume.
fn picked(
    shape: &[u64],
    names: serde_json::Value,
    version: u64,
    pick: crate::Pick,
) -> (Volume, String) {
    let dir = tempfile::tempdir().unwrap();
    let count = shape.iter().product::<u64>() as i16;
    let bytes: Vec<u8> = (0..count).flat_map(i16::to_le_bytes).collect();
    if version == 2 {
        let meta = json!({
            "zarr_format": 2, "shape": shape, "chunks": shape, "dtype": "<i2",
            "compressor": null, "fill_value": 0, "filters": null, "order": "C",
        });
        put(dir.path(), ".zarray", meta.to_string().as_bytes());
        let attributes = json!({"_ARRAY_DIMENSIONS": names});
        put(dir.path(), ".zattrs", attributes.to_string().as_bytes());
        put(dir.path(), &vec!["0"; shape.len()].join("."), &bytes);
    } else {
        let codecs = json!([{"name": "bytes", "configuration": {"endian": "little"}}]);
        let mut meta = meta_3(codecs, [1; 3]);
        meta["shape"] = json!(shape);
        meta["chunk_grid"]["configuration"]["chunk_shape"] = json!(shape);
        meta["dimension_names"] = names;
        put(dir.path(), "zarr.json", meta.to_string().as_bytes());
        put(dir.path(), &format!("c/{}", vec!["0"; shape.len()].join("/")), &bytes);
    }
    let opened = crate::open_with(dir.path(), &Hints { pick, ..Hints::default() }).unwrap();
    (opened.volume, opened.notes.join("\n"))
}

#[test]
fn zarr_axes_go_by_their_names_in_any_order() {
    for version in [2, 3] {
        let (v, notes) = named(&[4, 3, 2], json!(["x", "y", "z"]), version);
        assert_eq!((v.lattice.dims, notes.as_str()), ([4, 3, 2], ""));
        // x steps over 6 numbers, y over 2, z over 1.
        assert_eq!(values(&v)[..6], [0, 6, 12, 18, 2, 8]);
        assert_eq!(values(&v)[12], 1);
        let (v, notes) = named(&[2, 3, 4, 5], json!(["z", "y", "x", "c"]), version);
        assert_eq!(v.lattice.dims, [4, 3, 2]);
        assert_eq!(values(&v)[..5], [0, 5, 10, 15, 20]);
        assert!(notes.contains("the first of 5 along `c` was read"), "{notes}");
        let (v, _) = named(&[2, 3, 4], json!(["Z", "Y", "X"]), version);
        assert_eq!(v.lattice.dims, [4, 3, 2]);
        // A channel that is called so is no axis of space, whatever the others are called.
        let (v, notes) = named(&[2, 3, 4, 5], json!(["plane", "row", "col", "channel"]), version);
        assert_eq!(v.lattice.dims, [4, 3, 2]);
        assert!(notes.contains("taken to be `col`, `row`, `plane`"), "{notes}");
        let (v, notes) = named(&[2, 3, 4], json!([null, null, null]), version);
        assert_eq!((v.lattice.dims, notes.as_str()), ([4, 3, 2], ""));
    }
}

#[test]
fn zarr_takes_the_picked_channel_from_its_chunk() {
    use crate::Pick;
    let channel = |n| Pick { channel: Some(n), ..Pick::default() };
    for version in [2, 3] {
        let (v, notes) = picked(&[2, 3, 4, 5], json!(["z", "y", "x", "c"]), version, channel(3));
        assert_eq!(values(&v)[..4], [3, 8, 13, 18]);
        assert_eq!(notes, "");
    }
    // Channels 2 and 3 of five are in the second chunk.
    let dir = tempfile::tempdir().unwrap();
    let meta = json!({
        "zarr_format": 2, "shape": [5, 2, 3, 4], "chunks": [2, 2, 3, 4], "dtype": "<i2",
        "compressor": null, "fill_value": 0, "filters": null, "order": "C",
    });
    put(dir.path(), ".zarray", meta.to_string().as_bytes());
    put(
        dir.path(),
        ".zattrs",
        json!({"_ARRAY_DIMENSIONS": ["c", "z", "y", "x"]}).to_string().as_bytes(),
    );
    for chunk in 0..3i16 {
        let bytes: Vec<u8> = (0..48).flat_map(|i| (chunk * 48 + i).to_le_bytes()).collect();
        put(dir.path(), &format!("{chunk}.0.0.0"), &bytes);
    }
    for (pick, first) in [(channel(3), 72), (Pick { volume: Some(4), ..Pick::default() }, 96)] {
        let opened = crate::open_with(dir.path(), &Hints { pick, ..Hints::default() }).unwrap();
        let want: Vec<i16> = (first..first + 24).collect();
        assert_eq!(values(&opened.volume), want);
        assert!(opened.notes.is_empty(), "{:?}", opened.notes);
    }
}
