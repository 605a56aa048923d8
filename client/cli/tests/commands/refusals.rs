//! Everything that a person can get wrong: each ends with the right exit code and one line that
//! names what and what to do, and leaves no file behind.
//!
//! The real program runs, each time in a folder of its own.

use crate::program::{run, slabcast};
use std::collections::BTreeSet;
use std::io::Write;
use std::net::TcpListener;
use std::path::Path;

/// Names of all files and folders beneath, hidden ones too.
fn tree(dir: &Path) -> BTreeSet<String> {
    let mut all = BTreeSet::new();
    let mut open = vec![dir.to_path_buf()];
    while let Some(dir) = open.pop() {
        for entry in std::fs::read_dir(&dir).expect("a folder of ours") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                open.push(path.clone());
            }
            all.insert(path.display().to_string());
        }
    }
    all
}

/// An 8-bit NRRD of `n` cubed samples.
fn nrrd(n: usize) -> Vec<u8> {
    let head = format!(
        "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {n} {n} {n}\nspacings: 1 1 1\nencoding: raw\n\n"
    );
    let mut bytes = head.into_bytes();
    bytes.extend((0..n * n * n).map(|i| (i % 251) as u8));
    bytes
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
    packed.write_all(bytes).expect("memory");
    packed.finish().expect("memory")
}

/// A NIfTI-1 file of 8-bit samples, in memory.
fn nifti(n: i16) -> Vec<u8> {
    let mut b = vec![0u8; 352];
    b[0..4].copy_from_slice(&348i32.to_le_bytes());
    for (i, d) in [3, n, n, n, 1, 1, 1, 1].into_iter().enumerate() {
        b[40 + 2 * i..42 + 2 * i].copy_from_slice(&d.to_le_bytes());
    }
    b[70..72].copy_from_slice(&2i16.to_le_bytes());
    b[72..74].copy_from_slice(&8i16.to_le_bytes());
    for i in 0..4 {
        b[76 + 4 * i..80 + 4 * i].copy_from_slice(&1f32.to_le_bytes());
    }
    b[108..112].copy_from_slice(&352f32.to_le_bytes());
    b[344..348].copy_from_slice(b"n+1\0");
    b.extend((0..n as usize * n as usize * n as usize).map(|i| (i % 200) as u8));
    b
}

/// A grey 8-bit TIFF picture.
fn tiff(width: u16, height: u16) -> Vec<u8> {
    let mut b = b"II*\0\x08\0\0\0".to_vec();
    let pixels = u32::from(width) * u32::from(height);
    let entries: [(u16, u32); 8] = [
        (256, width.into()),
        (257, height.into()),
        (258, 8),
        (259, 1),
        (262, 1),
        (273, 8 + 2 + 8 * 12 + 4),
        (278, height.into()),
        (279, pixels),
    ];
    b.extend((entries.len() as u16).to_le_bytes());
    for (tag, value) in entries {
        b.extend(tag.to_le_bytes());
        b.extend(4u16.to_le_bytes());
        b.extend(1u32.to_le_bytes());
        b.extend(value.to_le_bytes());
    }
    b.extend([0; 4]);
    b.extend((0..pixels).map(|i| i as u8));
    b
}

/// Files of every format with one thing wrong.
fn files_of_other_formats(put: &dyn Fn(&str, &[u8])) {
    let nrrd = |more: &str, data: &[u8]| {
        let head = format!("NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2 2 2\n{more}");
        [head.as_bytes(), data].concat()
    };
    put("hex.nrrd", &nrrd("encoding: hex\n\n", b"00zz"));
    put("ascii.nrrd", &nrrd("encoding: ascii\n\n", b"1 2 3 4 5 6 7 300"));
    put("bzip2.nrrd", &nrrd("encoding: bzip2\n\n", b"no bzip2"));
    put("zrl.nrrd", &nrrd("encoding: zrl\n\n", b""));
    put("list.nhdr", &nrrd("encoding: raw\ndata file: LIST\nok.raw\nlost.raw\n", b""));
    put("count.nhdr", &nrrd("encoding: raw\ndata file: x%d.raw 1 9 1\n", b""));
    put("out.nhdr", &nrrd("encoding: raw\ndata file: ../../etc/passwd\n", b""));
    put("ok.raw", &[0; 4]);
    let meta = |more: &str, data: &[u8]| {
        let head = format!("ObjectType = Image\nNDims = 3\nDimSize = 2 2 2\n{more}");
        [head.as_bytes(), data].concat()
    };
    put("type.mha", &meta("ElementType = MET_STRING\nElementDataFile = LOCAL\n", b""));
    put("end.mha", &meta("ElementType = MET_UCHAR\n", b""));
    put("short.mha", &meta("ElementType = MET_SHORT\nElementDataFile = LOCAL\n", &[0; 8]));
    put("lost.mhd", &meta("ElementType = MET_UCHAR\nElementDataFile = lost.raw\n", b""));
    put(
        "channels.mha",
        &meta(
            "ElementNumberOfChannels = 3\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n",
            b"",
        ),
    );
    let vti = |file: &str, image: &str, array: &str| {
        format!(
            "<VTKFile type=\"{file}\" byte_order=\"LittleEndian\"><ImageData {image}><Piece>\
             <PointData><DataArray type=\"UInt8\" Name=\"v\" {array}</DataArray>"
        )
    };
    let extent = "WholeExtent=\"0 1 0 1 0 1\"";
    put("poly.vti", vti("PolyData", extent, "format=\"ascii\">").as_bytes());
    put("extent.vti", vti("ImageData", "", "format=\"ascii\">").as_bytes());
    put("word.vti", vti("ImageData", extent, "format=\"ascii\">1 2 x").as_bytes());
    put("offset.vti", vti("ImageData", extent, "format=\"appended\" offset=\"9\">").as_bytes());
    put("base64.vti", vti("ImageData", extent, "format=\"binary\">CAAAAA==?").as_bytes());
    put("size_4x4x4_uint8.raw", &[0; 128]);
    put("type_4x4x4.raw", &[0; 128]);
    put("bare.raw", &[0; 27]);
    put("cut.tif", &tiff(4, 4)[..60]);
    put("good.tif", &tiff(4, 4));
}

/// A folder with everything that the table below speaks of.
fn world() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a temporary folder");
    let put = |name: &str, bytes: &[u8]| std::fs::write(dir.path().join(name), bytes).expect(name);
    put("good.nrrd", &nrrd(16));
    put("short.nrrd", &nrrd(16)[..2000]);
    put("empty.nrrd", b"");
    put("text.txt", b"hello\n");
    put("text", b"hello\n");
    let packed = gzip(&nifti(24));
    put("cut.nii.gz", &packed[..packed.len() / 2]);
    put(
        "huge.nrrd",
        b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4000000000 4000000000 4000000000\nencoding: raw\n\nx",
    );
    put("bad-tf.json", b"{\"version\":1,\"domain\":\"value\",\"colours\":[]}");
    put(
        "nan-tf.json",
        b"{\"version\":1,\"domain\":\"value\",\"colors\":[[0,1,1,1]],\"opacities\":[[0,2]]}",
    );
    put("bad-path.json", b"{\"version\":1,\"size\":[9,9],\"views\":[{\"eye\":[0,0,1]}]}");
    put("no-views.json", b"{\"version\":1,\"size\":[9,9]}");
    let view = |eye: &str| {
        format!(
            "{{\"version\":1,\"size\":[9,9],\"views\":[{{\"eye\":{eye},\"target\":[0,0,0],\
             \"up\":[0,0,1],\"projection\":\"ortho\"}}]}}"
        )
    };
    put("nan-eye.json", view("[NaN,0,0]").as_bytes());
    put("endless-eye.json", view("[1e999,0,0]").as_bytes());
    put("eye-is-target.json", view("[0,0,0]").as_bytes());
    let path = |rest: &str| format!("{{\"version\":1,\"size\":[9,9],{rest}}}");
    put("near-key.json", path("\"keyframe\":{}").as_bytes());
    put(
        "two-kinds.json",
        path(r#""turntable":{},"keyframes":{"frames":2,"keys":[{}]}"#).as_bytes(),
    );
    put(
        "bad-keys.json",
        path(r#""keyframes":{"frames":2,"keys":[{},{"eye":[0,0,99],"target":[0,0,0],"up":[0,0,1]}]}"#)
            .as_bytes(),
    );
    put("bad-fly.json", path(r#""flythrough":{"frames":2,"eyes":[[0,0,0],[0,0,0]]}"#).as_bytes());
    put("bad-tween.json", path(r#""keyframes":{"frames":2,"keys":[{"tf":"bonee"}]}"#).as_bytes());
    put("short.json", path(r#""turntable":{"frames":5}"#).as_bytes());
    put(
        "slope.json",
        br#"{"version":1,"domain":"unit","colors":[[0,1,1,1]],"opacities":[[0,1]],"gradient_opacity":[[-1,0]]}"#,
    );
    put("pv-log.json", br#"[{"RGBPoints":[0,0,0,1],"UseLogScale":1}]"#);
    put("pv-map.json", br#"[{"RGBPoints":[0,0,0,1]}]"#);
    put("pv-space.json", br#"[{"RGBPoints":[0,0,0,1],"ColorSpace":"Prolab"}]"#);
    put("big.json", br#"{"version":1,"size":[99999,9],"turntable":{}}"#);
    files_of_other_formats(&put);
    for folder in ["full", "none", "mixed", "scans", "array", "group"] {
        std::fs::create_dir(dir.path().join(folder)).expect("a folder");
    }
    put("mixed/a.tif", &tiff(2, 2));
    put("mixed/b.tif", &tiff(3, 2));
    put("none/notes.txt", b"hello");
    put("none/good.nrrd", b"");
    put(
        "scans/1.dcm",
        &[&[0; 128][..], b"DICM\x02\0\x10\0UI\x18\x001.2.840.10008.1.2.4.201\0"].concat(),
    );
    put("array/.zarray", br#"{"zarr_format":2,"shape":[9,9,9],"chunks":[9,9,9],"dtype":"<c8"}"#);
    put("group/.zgroup", b"{}");
    put("full/frame_0000.png", b"mine");
    put("full/frame_0003.png", b"mine");
    put("there.png", b"\x89PNG, but no more of it");
    put("there.y4m", b"mine");
    dir
}

/// Runs and checks: exit code, one line, what it names, nothing left.
#[track_caller]
fn refused(dir: &Path, args: &[&str], code: i32, names: &[&str]) {
    let before = tree(dir);
    let out = run(dir, args);
    let stderr = String::from_utf8_lossy(&out.stderr);
    let what = format!("slabcast {}\n{stderr}", args.join(" "));
    assert_eq!(out.status.code(), Some(code), "exit code of {what}");
    let lines: Vec<&str> = stderr.lines().collect();
    assert!(lines.len() == 1 && lines[0].starts_with("error: "), "one line from {what}");
    for name in names {
        assert!(stderr.contains(name), "`{name}` is not named by {what}");
    }
    assert!(out.stdout.is_empty(), "results from {what}");
    assert_eq!(tree(dir), before, "files are left by {what}");
}

/// Bad files: what is typed, and what the one line names. Each ends with code 1.
fn files() -> Vec<(&'static [&'static str], &'static [&'static str])> {
    vec![
        (&["render", "missing.nrrd"][..], &["missing.nrrd"][..]),
        (&["render", "."], &["."]),
        (&["render", "text.txt"], &["text.txt", "NRRD"]),
        (&["render", "empty.nrrd"], &["empty.nrrd"]),
        (&["render", "short.nrrd"], &["short.nrrd"]),
        (&["render", "cut.nii.gz"], &["cut.nii.gz"]),
        (&["render", "huge.nrrd"], &["huge.nrrd", "sizes"]),
        (&["render", "formula:nothing"], &["formula:nothing", "spheres"]),
        (&["info", "missing.nrrd"], &["missing.nrrd"]),
        (&["master", "--volume", "missing.nrrd", "--listen", "127.0.0.1:0"], &["missing.nrrd"]),
        (&["render", "good.nrrd", "--tf", "missing.json"], &["missing.json"]),
        (&["render", "good.nrrd", "--tf", "bad-tf.json"], &["bad-tf.json", "colours"]),
        (&["render", "good.nrrd", "--tf", "nan-tf.json"], &["nan-tf.json", "opacities[0]"]),
        (&["render", "good.nrrd", "--path", "missing.json"], &["missing.json"]),
        (&["render", "good.nrrd", "--path", "bad-path.json"], &["bad-path.json", "target"]),
        (&["render", "good.nrrd", "--path", "no-views.json"], &["no-views.json", "views"]),
        (&["render", "good.nrrd", "--path", "nan-eye.json"], &["nan-eye.json", "line 1"]),
        (&["render", "good.nrrd", "--path", "endless-eye.json"], &["endless-eye.json"]),
        (&["render", "good.nrrd", "--path", "eye-is-target.json"], &["views[0].eye", "move"]),
        (&["render", "good.nrrd", "--path", "big.json"], &["big.json", "size"]),
        (&["render", "good.nrrd", "--path", "text.txt"], &["text.txt"]),
        (&["render", "good.nrrd", "--path", "near-key.json"], &["near-key.json", "`keyframes`"]),
        (&["render", "good.nrrd", "--path", "two-kinds.json"], &["two-kinds.json", "turntable"]),
        (&["render", "good.nrrd", "--path", "bad-keys.json"], &["bad-keys.json", "keys[1].up"]),
        (&["render", "good.nrrd", "--path", "bad-fly.json"], &["bad-fly.json", "eyes[1]"]),
        (
            &["render", "good.nrrd", "--path", "bad-tween.json"],
            &["bad-tween.json", "keys[0].tf", "bone"],
        ),
        (
            &["render", "good.nrrd", "--path", "short.json", "--frames", "3..9"],
            &["short.json", "range"],
        ),
        (&["render", "good.nrrd", "--tf", "slope.json"], &["slope.json", "gradient_opacity[0]"]),
        (&["render", "good.nrrd", "--tf", "pv-log.json"], &["pv-log.json", "UseLogScale"]),
        (&["render", "good.nrrd", "--tf", "pv-map.json"], &["pv-map.json", "Points", "--colors"]),
        (
            &["render", "good.nrrd", "--colors", "pv-space.json"],
            &["pv-space.json", "ColorSpace", "Lab"],
        ),
        (&["render", "good.nrrd", "--colors", "bad-tf.json"], &["bad-tf.json", "--tf"]),
        (&["tf", "bone", "-o", "big.json"], &["big.json", "--force"]),
        (&["tf", "missing.json"], &["missing.json"]),
        (&["render", "good.nrrd", "-o", "full"], &["full", "frame_0000.png", "--force"]),
        (&["render", "good.nrrd", "-o", "text"], &["text", "-o"]),
        (&["render", "good.nrrd", "-o", "/proc/slabcast/out"], &["/proc/slabcast"]),
        (&["render", "good.nrrd", "--stats", "nowhere/s.jsonl"], &["nowhere/s.jsonl"]),
        (&["render", "good.nrrd", "--trace", "full"], &["full"]),
        (&["lab", "check", "golden", "--verify", "text.txt"], &["text.txt", "line 1"]),
        (&["lab", "check", "golden", "--sample", "missing.nii.gz"], &["missing.nii.gz"]),
        (&["lab", "check", "matrix", "missing.nrrd"], &["missing.nrrd"]),
        (&["info", "hex.nrrd"], &["hex.nrrd", "data", "hexadecimal", "correct"]),
        (&["info", "ascii.nrrd"], &["ascii.nrrd", "number 8", "300", "uint8"]),
        (&["info", "bzip2.nrrd"], &["bzip2.nrrd", "bzip2", "get the file again"]),
        (&["info", "zrl.nrrd"], &["zrl.nrrd", "encoding (line 5)", "save it again"]),
        (&["info", "list.nhdr"], &["list.nhdr", "data file", "lost.raw", "beside its header"]),
        (&["info", "count.nhdr"], &["count.nhdr", "9 files where the sizes want 2"]),
        (&["info", "out.nhdr"], &["out.nhdr", "data file", "put the data file beside"]),
        (&["info", "type.mha"], &["type.mha", "ElementType (line 4)", "MET_STRING", "MET_UCHAR"]),
        (&["info", "end.mha"], &["end.mha", "ElementDataFile", "LOCAL"]),
        (&["info", "short.mha"], &["short.mha", "16 bytes are needed and 8 are there"]),
        (&["info", "lost.mhd"], &["lost.mhd", "ElementDataFile", "lost.raw"]),
        (
            &["info", "channels.mha"],
            &["channels.mha", "ElementNumberOfChannels", "--channel 0 to 2"],
        ),
        (&["info", "poly.vti"], &["poly.vti", "VTKFile type", "Resample To Image"]),
        (&["info", "extent.vti"], &["extent.vti", "ImageData WholeExtent", "is missing"]),
        (&["info", "word.vti"], &["word.vti", "DataArray `v`", "number 3 is `x`"]),
        (&["info", "offset.vti"], &["offset.vti", "AppendedData", "whole file"]),
        (&["info", "base64.vti"], &["base64.vti", "DataArray `v`", "get the whole file"]),
        (&["info", "size_4x4x4_uint8.raw"], &["size", "128 bytes", "--type uint16"]),
        (&["info", "type_4x4x4.raw"], &["--type", "4x4x4", "uint16"]),
        (&["info", "bare.raw"], &["bare.raw", "--dims 3x3x3 --type uint8"]),
        (&["info", "bare.raw", "--dims", "3x3x4", "--type", "uint8"], &["--dims 3x3x3 would fit"]),
        (&["info", "good.nrrd", "--type", "uint8"], &["good.nrrd", "--type", "leave them out"]),
        (&["info", "cut.tif"], &["cut.tif", "truncated", "get the whole file"]),
        (&["info", "mixed"], &["mixed", "`b.tif`", "3 x 2 uint8", "2 x 2 uint8"]),
        (&["info", "none"], &["none", "folder", "`good.nrrd`"]),
        (&["info", "scans"], &["scans", "1.dcm", "TransferSyntaxUID", "JPEG", "dcm2niix"]),
        (&["info", "array"], &["array", "dtype", "<i2"]),
        (&["info", "group"], &["group", "multiscales", "give the folder of an array"]),
        (&["convert", "missing.nrrd", "new.nii"], &["missing.nrrd"]),
        (&["lab", "report", "missing.nrrd"], &["missing.nrrd"]),
        (&["lab", "study", "missing.nrrd"], &["missing.nrrd"]),
        (&["lab", "study", "good.nrrd", "-o", "good.nrrd/x"], &["good.nrrd/x"]),
        (&["convert", "good.tif", "good.nrrd"], &["good.nrrd", "--force"]),
        (&["convert", "good.tif", "nowhere/x.nrrd"], &["nowhere/x.nrrd", "check the path"]),
    ]
}

#[test]
fn bad_files_are_named_with_the_remedy() {
    let dir = world();
    for (args, names) in files() {
        refused(dir.path(), args, 1, names);
    }
}

/// Bad flags, likewise. Each ends with code 2.
fn flags() -> Vec<(Vec<&'static str>, &'static [&'static str])> {
    let with = |more: &[&'static str]| [&["render", "good.nrrd"], more].concat();
    vec![
        (vec!["render"], &["VOLUME", "--master"][..]),
        (vec!["render", "knee", "--master", "127.0.0.1:1", "--skip", "4"], &["--dims", "VOLUME"]),
        (vec!["render", "--master", "127.0.0.1:1", "--workers", "2"], &["--workers"]),
        (vec!["render", "--master", "nowhere:"], &["--master", "HOST:PORT"]),
        (vec!["rendr"], &["rendr", "render"]),
        (vec!["convert", "good.nrrd"], &["OUT"]),
        (vec!["convert", "good.nrrd", "x.png"], &["OUT", "x.png", ".nii.gz"]),
        (vec!["convert", "good.nrrd", "good.nrrd"], &["OUT", "is the volume itself"]),
        (vec!["convert", "good.nrrd", "x.nii", "--encoding", "gzip"], &["--encoding", ".nii.gz"]),
        (
            vec!["convert", "good.nrrd", "x.ome.zarr", "--encoding", "raw"],
            &["--encoding", "OME-Zarr"],
        ),
        (with(&["--dims", "3x3"]), &["--dims", "256x256x128"]),
        (with(&["--dims", "0x3x3"]), &["--dims", "from 1"]),
        (with(&["--type", "colour"]), &["--type", "uint8, int8"]),
        (with(&["--spacing", "1x1x0"]), &["--spacing", "0.5x0.5x1.25"]),
        (with(&["--byte-order", "middle"]), &["--byte-order", "little or big"]),
        (with(&["--skip", "-1"]), &["--skip"]),
        (vec!["render", "--master", "a:1", "--dims", "1x1x1"], &["--dims", "--master"]),
        (with(&["--elevatoin", "3"]), &["--elevatoin", "--elevation"]),
        (with(&["--tf", "bonee"]), &["--tf", "did you mean `bone`"]),
        (with(&["--tf", "/tmp"]), &["--tf", "preset"]),
        (with(&["--size", "0x0"]), &["--size", "512x512"]),
        (with(&["--size", "8193x1"]), &["--size", "8192"]),
        (with(&["--size", "99999999999x9"]), &["--size"]),
        (with(&["--frames", "0"]), &["--frames", "1..=100000"]),
        (with(&["--frames", "1000000000"]), &["--frames"]),
        (with(&["--frames", "9..3"]), &["--frames", "30..60"]),
        (with(&["--frames", "3", "--path", "short.json"]), &["--frames", "short.json"]),
        (with(&["--view", "top"]), &["--view", "superior"]),
        (with(&["--view", "left"]), &["--view", "--up", "--azimuth"]),
        (with(&["--view", "left", "--azimuth", "3"]), &["--view", "--azimuth"]),
        (with(&["--crop", "1:2"]), &["--crop", "FROM:TO"]),
        (with(&["--crop", "99:,:,:"]), &["--crop", "outside"]),
        (with(&["--light", "up"]), &["--light", "key", "head", "X,Y,Z"]),
        (with(&["--shading", "maybe"]), &["--shading"]),
        (with(&["--nan", "red"]), &["--nan", "#rrggbb"]),
        (with(&["--colors", "virids"]), &["--colors", "did you mean `viridis`"]),
        (vec!["tf"], &["TF"]),
        (vec!["tf", "bonee"], &["--tf", "did you mean `bone`"]),
        (with(&["--error", "0"]), &["--error", "1/255"]),
        (with(&["--error", "2"]), &["--error", "at most 1"]),
        (with(&["--error-max", "none"]), &["--error-max", "1/512"]),
        (with(&["--budget", "100"]), &["--budget", "100ms"]),
        (with(&["--budget", "-5ms"]), &["--budget", "above 0"]),
        (with(&["--budget", "0s"]), &["--budget", "0.5s"]),
        (with(&["--budget", "1s", "--thickness", "2"]), &["--budget", "--thickness"]),
        (with(&["--error", "0.1", "--show", "work"]), &["--error", "--show"]),
        (
            vec!["lab", "explain", "good.nrrd", "--pixel", "1,1", "--error", "0.1"],
            &["--error", "render"],
        ),
        (vec!["lab", "report", "good.nrrd", "--only", "colour"], &["--only", "thickness"]),
        (vec!["lab", "report", "good.nrrd", "--seconds", "0"], &["--seconds", "above 0"]),
        (vec!["lab", "report", "good.nrrd", "--elevation", "91"], &["--elevation", "90"]),
        (vec!["lab", "plan", "good.nrrd", "-o", "p", "--elevation", "91"], &["--elevation", "90"]),
        (vec!["lab", "study", "good.nrrd", "-o", "p", "--elevation", "91"], &["--elevation", "90"]),
        (vec!["lab", "study", "good.nrrd", "--latency", "5"], &["--latency", "50us"]),
        (vec!["lab", "study", "good.nrrd", "--repeats", "0"], &["--repeats", "1..=100"]),
        (vec!["lab", "study", "good.nrrd", "--error", "1/255"], &["--error", "leave it out"]),
        (with(&["--eps", "1/0"]), &["--eps", "1/512"]),
        (with(&["--eps", "tiny"]), &["--eps", "1/512"]),
        (with(&["--eps", "2"]), &["--eps", "0.5"]),
        (with(&["--thickness", "nan"]), &["--thickness"]),
        (with(&["--thickness", "0"]), &["--thickness"]),
        (with(&["--kernel", "box"]), &["--kernel", "gaussian"]),
        (with(&["--kernel", "tent", "--std", "0.5"]), &["--std", "gaussian"]),
        (with(&["--kernel", "bspline", "--radius", "1"]), &["--radius", "gaussian"]),
        (with(&["--kernel", "tent", "--sums", "i16"]), &["--sums", "i32"]),
        (with(&["--elevation", "91"]), &["--elevation", "90"]),
        (with(&["--projection", "persp", "--fov", "180"]), &["--fov", "179"]),
        (with(&["--height", "-3"]), &["--height"]),
        (with(&["--height", "1e300"]), &["--height"]),
        (with(&["--up", "z", "--front", "-z"]), &["--front", "--front"]),
        (with(&["--up", "w"]), &["--up", "x, y or z"]),
        (with(&["--tile", "48"]), &["--tile", "64"]),
        (with(&["--slabs", "0"]), &["--slabs"]),
        (with(&["--workers", "65"]), &["--workers", "64"]),
        (with(&["--threads", "0"]), &["--threads", "1024"]),
        (with(&["--workers", "64", "--threads", "1024"]), &["--workers", "--threads", "4096"]),
        (with(&["--background", "300,0,0"]), &["--background"]),
        (with(&["--background", "255,0,0"]), &["--background", "#ff0000"]),
        (with(&["--azimuth", "3", "--frames", "4"]), &["--azimuth", "--frames"]),
        (with(&["--path", "big.json", "--frames", "4"]), &["--path", "--frames"]),
        (with(&["--stats", "good.nrrd"]), &["--stats", "good.nrrd"]),
        (with(&["--log-level", "loud"]), &["--log-level", "info"]),
        (
            vec!["master", "--volume", "good.nrrd", "--listen", "0.0.0.0:0"],
            &["--listen", "127.0.0.1", "--insecure"],
        ),
        (vec!["master", "--volume", "good.nrrd", "--listen", "7433"], &["--listen", "HOST:PORT"]),
        (vec!["master", "--upload-quota", "1"], &["--upload-quota", "16MiB", "0 for none"]),
        (vec!["worker"], &["--master"]),
        (vec!["worker", "--master", "a:1", "--memory", "1"], &["--memory", "512MiB"]),
        (
            vec!["worker", "--master", "a:1", "--memory", "40MiB", "--threads", "2"],
            &["--memory", "40.0 MiB", "too little", "with 2 threads", "give at least 52MiB"],
        ),
        (vec!["worker", "--master", "a:1", "--threads", "9999"], &["--threads", "1024"]),
    ]
}

#[test]
fn bad_flags_are_named_with_the_remedy() {
    let dir = world();
    for (args, names) in flags() {
        refused(dir.path(), &args, 2, names);
    }
}

/// Bad places and formats to write to: code, flags of `render`, and what the line names.
const OUTPUTS: &[(i32, &[&str], &[&str])] = &[
    (2, &["-o", "a.png", "--frames", "5"], &["a.png", "5 views", "--azimuth"]),
    (2, &["-o", "a.pdf"], &["-o: a.pdf", ".png, .tif", "/ for a folder"]),
    (2, &["-o", "a.exr", "--azimuth", "0", "--format", "png"], &["--format", ".png"]),
    (2, &["-o", "a.png", "--azimuth", "0", "--format", "y4m"], &["--format", ".y4m"]),
    (2, &["-o", "out", "--format", "y4m"], &["-o turn.y4m"]),
    (2, &["-o", "out", "--format", "gif"], &["-o turn.gif"]),
    (2, &["-o", "out", "--format", "bmp"], &["--format", "apng"]),
    (2, &["-o", "a.BMP", "--azimuth", "0"], &["-o", "a.BMP", ".png"]),
    (2, &["-o", "a.jpg", "--background", "transparent"], &["--background", ".png"]),
    (2, &["-o", "a.exr", "--caption", "x"], &["--caption", "EXR", "tif"]),
    (2, &["-o", "a.y4m", "--dpi", "300"], &["--dpi", "leave it out"]),
    (2, &["-o", "a.png", "--caption", "\u{6f22}"], &["--caption", "no letter"]),
    (2, &["-o", "a.png", "--orientation"], &["--orientation", "leave it out"]),
    (2, &["-o", "a.png", "--scale-bar", "--projection", "persp"], &["--scale-bar", "perspective"]),
    (
        2,
        &["-o", "a.exr", "--view", "all", "--up", "+z", "--front", "+y"],
        &["grid", "png, tif or jpg"],
    ),
    (2, &["--seconds", "1e9"], &["--seconds", "100000"]),
    (2, &["--seconds", "1", "--frames", "3"], &["--seconds", "--frames"]),
    (2, &["--show", "depth", "--scale-bar"], &["--scale-bar", "--show"]),
    (2, &["-o", "-", "--format", "png"], &["--format", "pipe"]),
    (2, &["-o", "-", "--stats", "-"], &["--stats", "stdout"]),
    (2, &["--no-hash"], &["--stats"]),
    (2, &["-o", "a.y4m", "--background", "transparent"], &["--background", "colour"]),
    (2, &["-o", "a.exr", "--azimuth", "0", "--background", "1,0,0"], &["--background", "EXR"]),
    (2, &["-o", "good.nrrd", "--format", "y4m"], &["-o: good.nrrd", ".y4m"]),
    (2, &["--fps", "0"], &["--fps", "240"]),
    (2, &["--contact-sheet", "all.txt"], &["--contact-sheet", ".png"]),
    (1, &["--contact-sheet", "nowhere/all.png"], &["nowhere/all.png"]),
    (1, &["-o", "nowhere/a.png", "--azimuth", "0"], &["nowhere/a.png"]),
    (1, &["-o", "there.png", "--azimuth", "0"], &["there.png", "--force"]),
    (1, &["-o", "there.y4m"], &["there.y4m", "--force"]),
    (2, &["--show", "dept"], &["--show", "depth"]),
    (2, &["--show", "depth", "--format", "exr"], &["--format", "--show"]),
    (2, &["--show", "work", "--stats", "s.jsonl"], &["--stats", "--show"]),
    (2, &["--show", "error", "--thickness", "0.016"], &["--thickness"]),
];

#[test]
fn bad_outputs_are_named_with_the_remedy() {
    let dir = world();
    for (code, more, names) in OUTPUTS {
        refused(dir.path(), &[&["render", "good.nrrd"], *more].concat(), *code, names);
    }
}

/// Bad pictures to make again, and other commands: code, line, and what the answer names.
const OTHERS: &[(i32, &[&str], &[&str])] = &[
    (2, &["good.nrrd"], &["good.nrrd", "`slabcast render good.nrrd`"]),
    (2, &["tf", "bone", "--dims", "4x4x4"], &["VOLUME", "give the file"]),
    (1, &["info", "text.txt", "--dims", "2x2x2"], &["--type", "is missing", "2x2x2", "uint8"]),
    (2, &["rerender"], &["PICTURE"]),
    (2, &["rerender", "there.png"], &["VOLUME"]),
    (1, &["rerender", "missing.png", "good.nrrd"], &["missing.png"]),
    (1, &["rerender", "full", "good.nrrd"], &["full", "folder"]),
    (1, &["rerender", "text.txt", "good.nrrd"], &["text.txt", "PNG"]),
    (1, &["rerender", "there.png", "good.nrrd"], &["there.png", "damaged"]),
    (2, &["config", "show", "check"], &["check", "render"]),
    (2, &["config", "show", "render", "--sise", "3x3"], &["--sise", "--size"]),
    (2, &["doctor", "--master", "nowhere:"], &["--master", "HOST:PORT"]),
    (1, &["demo", "-o", "text"], &["text", "-o"]),
    (2, &["completions", "tcsh"], &["tcsh", "bash"]),
    (1, &["man", "text.txt"], &["text.txt"]),
];

#[test]
fn other_bad_lines_are_named_with_the_remedy() {
    let dir = world();
    for (code, line, names) in OTHERS {
        refused(dir.path(), line, *code, names);
    }
}

/// Bad files of values, and what the line names. Each ends with code 1.
const VALUES: &[(&str, &[&str])] = &[
    ("[render]\nthicknes = 1\n", &["[render] thicknes", "did you mean `thickness`"]),
    ("[rendr]\nsize = \"9x9\"\n", &["rendr", "did you mean [render]"]),
    ("[status]\n", &["status", "[worker]"]),
    ("size = \"9x9\"\n", &["size", "[render]"]),
    ("render = 3\n", &["render", "section"]),
    ("[render]\nsize = [9, 9]\n", &["[render] size", "quotes"]),
    ("[render]\nsize = 9\n", &["`size`", "512x512"]),
    ("[render]\nthickness = -1\n", &["--thickness", "`thickness` in c.toml"]),
    ("[render]\nkernel = \"box\"\n", &["`kernel`", "gaussian"]),
    ("[render]\nforce = \"maybe\"\n", &["`force`", "true"]),
    ("[render]\nframes = 3\nazimuth = 2\n", &["`frames`", "`azimuth`", "exclude"]),
    ("[render]\nsize = \n", &["line 2"]),
    ("[render]\ntf = \"a\"\ntf = \"b\"\n", &["line 3"]),
];

#[test]
fn bad_values_of_a_file_are_named_with_section_and_key() {
    let dir = world();
    for (text, names) in VALUES {
        std::fs::write(dir.path().join("c.toml"), text).expect("a file");
        let line = ["render", "good.nrrd", "--config", "c.toml"];
        refused(dir.path(), &line, 1, &[&["c.toml"], *names].concat());
    }
    refused(dir.path(), &["render", "good.nrrd", "--config", "missing.toml"], 1, &["missing.toml"]);
    refused(dir.path(), &["worker", "--config", "full"], 1, &["full", "TOML"]);
    std::fs::write(dir.path().join("c.toml"), "[master]\nvolume = \"missing.nrrd\"\n").unwrap();
    let line = ["master", "--config", "c.toml", "--listen", "127.0.0.1:0"];
    refused(dir.path(), &line, 1, &["missing.nrrd"]);
}

/// Bad variables of the environment. Each ends with code 2.
const VARIABLES: &[(&str, &str, &[&str])] = &[
    ("SLABCAST_SIZE", "9", &["SLABCAST_SIZE", "512x512"]),
    ("SLABCAST_FRAMES", "many", &["SLABCAST_FRAMES", "many"]),
    ("SLABCAST_KERNEL", "box", &["SLABCAST_KERNEL", "gaussian"]),
    ("SLABCAST_FORCE", "maybe", &["SLABCAST_FORCE", "true"]),
    ("SLABCAST_EPS", "0.9", &["--eps", "SLABCAST_EPS"]),
    ("SLABCAST_LOG", "loud", &["--log-level", "SLABCAST_LOG"]),
];

#[test]
fn bad_variables_are_named() {
    let dir = world();
    for (name, value, names) in VARIABLES {
        let out = slabcast(dir.path(), &["render", "good.nrrd"]).env(name, value).output().unwrap();
        let said = String::from_utf8_lossy(&out.stderr);
        assert_eq!((out.status.code(), said.lines().count()), (Some(2), 1), "{name}: {said}");
        assert!(names.iter().all(|n| said.contains(n)), "{name}: {said}");
    }
    // A variable that only looks like one of slabcast's is mentioned, and the command succeeds.
    let line = ["render", "formula:one", "--azimuth", "0", "--size", "8x8", "-o", "a.png", "-q"];
    let out = slabcast(dir.path(), &line).env("SLABCAST_THREDS", "2").output().unwrap();
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success() && said.contains("did you mean SLABCAST_THREADS?"), "{said}");
}

#[test]
fn refusal_tables_are_large_enough() {
    let rows = files().len() + flags().len() + OUTPUTS.len() + OTHERS.len();
    let rows = rows + VALUES.len() + VARIABLES.len();
    assert!(rows >= 60, "at least 60 bad inputs were promised, {rows} are there");
}

#[test]
fn network_failures_are_named_with_the_remedy() {
    let dir = world();
    // Held and never listened to again: whoever calls is turned away.
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    for args in [
        &["render", "--master", &free][..],
        &["status", "--master", &free],
        &["jobs", "--master", &free],
        &["cancel", "job-1", "--master", &free],
    ] {
        refused(dir.path(), args, 1, &[&free, "slabcast master"]);
    }
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = taken.local_addr().map(|a| (taken, a.to_string())).unwrap();
    let args = ["master", "--volume", "good.nrrd", "--listen", &taken.1];
    refused(dir.path(), &args, 1, &[&taken.1, "in use", "another port"]);
}

#[test]
fn existing_frames_are_not_replaced_without_force() {
    let dir = world();
    refused(dir.path(), &["render", "good.nrrd", "-o", "full"], 1, &["--force"]);
    assert_eq!(std::fs::read(dir.path().join("full/frame_0000.png")).unwrap(), b"mine");
    let args =
        ["render", "good.nrrd", "-o", "full", "--force", "--frames", "2", "--size", "20x20", "-q"];
    let out = run(dir.path(), &args);
    let stderr = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{stderr}");
    assert!(
        stderr.contains("frame_0003.png of an earlier run, not written by slabcast, stays"),
        "{stderr}"
    );
    let png = std::fs::read(dir.path().join("full/frame_0000.png")).unwrap();
    assert!(png.starts_with(b"\x89PNG"));
    let names = tree(&dir.path().join("full"));
    assert_eq!(names.len(), 3, "{names:?}");
}

#[test]
fn bad_environment_variable_is_refused_like_its_flag() {
    let dir = world();
    let args = ["worker", "--master", "127.0.0.1:1"];
    let out = slabcast(dir.path(), &args).env("SLABCAST_THREADS", "none").output().unwrap();
    assert_eq!(out.status.code(), Some(2));
    let args = ["master", "--volume", "good.nrrd"];
    let out = slabcast(dir.path(), &args).env("SLABCAST_LISTEN", "0.0.0.0:1").output().unwrap();
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&out.stderr).contains("--insecure"));
    let out = slabcast(dir.path(), &["render"]).env("SLABCAST_MASTER", "x:").output().unwrap();
    assert_eq!(out.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&out.stderr).contains("SLABCAST_MASTER"));
}
