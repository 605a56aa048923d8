//! Tests that a hostile header can't point outside its folder, block on a pipe, or cost memory and
//! time for sizes without data (docs/design/promises.md R13, R14, R15).

use flate2::Compression;
use flate2::write::GzEncoder;
use slabcast_volumes::{Hints, OpenErrorKind, open, open_with};
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

const HEADER: &str = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\n";

/// Returns kind and text of the error, which must come within 2 s.
fn refusal(path: &Path) -> (OpenErrorKind, String) {
    let start = Instant::now();
    let e = open(path).expect_err("it must be refused");
    assert!(start.elapsed() < Duration::from_secs(2), "{e} took {:?}", start.elapsed());
    let line = e.to_string();
    assert!(!line.contains('\n') && line.contains("; "), "{line}");
    (e.problem.kind, line)
}

#[test]
fn files_that_are_no_volume_are_refused_with_kind_and_reason() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    use OpenErrorKind::{Damaged, Malformed, NotAVolume, Unreadable, Unsupported};
    let empty = dir.path().join("empty");
    std::fs::create_dir(&empty).unwrap();
    for (path, kind, say) in [
        (dir.path().join("nowhere.nrrd"), Unreadable, "no such file"),
        (empty, NotAVolume, "folder: holds no slices or pictures"),
        (file("empty.nii", b""), NotAVolume, "is empty"),
        (file("a.png", b"\x89PNG\r\n\x1a\n0000"), NotAVolume, "is one PNG picture"),
        (file("a.nrrd", b"hello"), NotAVolume, "does not begin with `NRRD`"),
        (file("a.nii", b"hello"), NotAVolume, "does not begin with a NIfTI header"),
        (file("a.txt", b"some words\n"), NotAVolume, "is text"),
        (file("a.xyz", &[0xee; 99]), NotAVolume, "is not a volume that we know"),
        (file("a.bin", &[0xee; 99]), NotAVolume, "is raw numbers without a header"),
        (file("a.gz", &[0x1f, 0x8b]), NotAVolume, "is gzip, but not around a volume"),
        (file("b.nrrd", b"NRRD0004\n"), Malformed, "type: is missing"),
        (file("c.nrrd", b"NRRD"), Unsupported, "is not NRRD0001"),
        (file("b.nii", &[0x5c, 1, 0, 0, 0, 0]), Damaged, "truncated"),
    ] {
        let (got, line) = refusal(&path);
        assert_eq!(got, kind, "{line}");
        assert!(line.contains(say), "{line}");
        assert!(line.starts_with(&*path.to_string_lossy()), "{line}");
    }
}

#[test]
fn content_decides_the_format_not_the_file_name() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("head.nii.gz");
    std::fs::write(&path, [HEADER.as_bytes(), b"\n", &[7; 24]].concat()).unwrap();
    assert_eq!(open(&path).unwrap().lattice.dims, [4, 3, 2]);
}

#[test]
fn detached_data_outside_the_header_folder_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let inside = dir.path().join("study");
    std::fs::create_dir_all(inside.join("below")).unwrap();
    std::fs::write(dir.path().join("secret.raw"), [1; 24]).unwrap();
    std::fs::write(inside.join("d.raw"), [2; 24]).unwrap();
    std::fs::write(inside.join("below/d.raw"), [3; 24]).unwrap();
    let header = inside.join("v.nhdr");
    let point_at = |name: &str| std::fs::write(&header, format!("{HEADER}data file: {name}\n"));
    let absolute = dir.path().join("secret.raw");
    for name in ["../secret.raw", "below/../../secret.raw", &absolute.to_string_lossy()] {
        point_at(name).unwrap();
        let (kind, line) = refusal(&header);
        assert_eq!(kind, OpenErrorKind::Forbidden, "{line}");
        assert!(
            line.contains("data file") && line.contains("put the data file beside its header"),
            "{line}"
        );
    }
    for name in ["/etc/passwd", "/dev/zero", "nothing.raw", "below", "."] {
        point_at(name).unwrap();
        assert_eq!(refusal(&header).0, OpenErrorKind::Forbidden, "{name}");
    }
    for (name, code) in [("d.raw", 2.0), ("./below/d.raw", 3.0), ("below/../d.raw", 2.0)] {
        point_at(name).unwrap();
        assert_eq!(open(&header).unwrap().samples.code(0), code, "{name}");
    }
}

#[cfg(unix)]
#[test]
fn symlinks_out_pipes_and_devices_are_refused_unread() {
    use std::os::unix::fs::symlink;
    let dir = tempfile::tempdir().unwrap();
    let inside = dir.path().join("study");
    std::fs::create_dir_all(&inside).unwrap();
    std::fs::write(dir.path().join("secret.raw"), [1; 24]).unwrap();
    std::fs::write(inside.join("d.raw"), [2; 24]).unwrap();
    symlink(dir.path().join("secret.raw"), inside.join("out.raw")).unwrap();
    symlink(dir.path(), inside.join("up")).unwrap();
    symlink("/dev/zero", inside.join("zero.raw")).unwrap();
    symlink("d.raw", inside.join("in.raw")).unwrap();
    let header = inside.join("v.nhdr");
    let point_at = |name: &str| std::fs::write(&header, format!("{HEADER}data file: {name}\n"));
    for name in ["out.raw", "up/secret.raw", "zero.raw"] {
        point_at(name).unwrap();
        assert_eq!(refusal(&header).0, OpenErrorKind::Forbidden, "{name}");
    }
    point_at("in.raw").unwrap();
    assert!(open(&header).is_ok(), "a link that stays inside is fine");
    // A device or a pipe as the volume itself, and as its data.
    assert_eq!(refusal(Path::new("/dev/zero")).0, OpenErrorKind::Forbidden);
    let pipe = inside.join("pipe.raw");
    match std::process::Command::new("mkfifo").arg(&pipe).status() {
        Ok(status) if status.success() => {}
        _ => return println!("skipped: there is no mkfifo here"),
    }
    assert_eq!(refusal(&pipe).0, OpenErrorKind::Forbidden);
    point_at("pipe.raw").unwrap();
    let (kind, line) = refusal(&header);
    assert_eq!(kind, OpenErrorKind::Forbidden, "{line}");
    assert!(line.contains("is a folder, pipe, socket or device, and was not read"), "{line}");
}

#[cfg(unix)]
#[test]
fn refusal_does_not_tell_whether_a_file_outside_exists() {
    let dir = tempfile::tempdir().unwrap();
    let inside = dir.path().join("study");
    std::fs::create_dir_all(&inside).unwrap();
    std::fs::write(dir.path().join("secret.raw"), [1; 24]).unwrap();
    let link = |target: &str| {
        let path = inside.join("link.raw");
        let _ = std::fs::remove_file(&path);
        std::os::unix::fs::symlink(target, path).unwrap();
    };
    let header = inside.join("v.nhdr");
    let absolute = |name: &str| dir.path().join(name).to_string_lossy().into_owned();
    let ask = |name: &str| {
        std::fs::write(&header, format!("{HEADER}data file: {name}\n")).unwrap();
        let (kind, line) = refusal(&header);
        (kind, line.replace(name, "NAME"))
    };
    let missing = ask("missing.raw");
    for [there, not] in [
        ["../secret.raw".to_string(), "../nothing.raw".to_string()],
        ["/etc/passwd".into(), "/etc/nothing-of-this-name".into()],
        [absolute("secret.raw"), absolute("nothing.raw")],
        ["../secret.raw/below".into(), "../nothing/below".into()],
    ] {
        assert_eq!(ask(&there), missing, "{there}");
        assert_eq!(ask(&not), missing, "{not}");
        link(&there);
        let found = ask("link.raw");
        link(&not);
        assert_eq!(ask("link.raw"), found, "{there} and {not} behind a link");
        assert_eq!(found, missing);
        // A file of a list is missing.
        for name in [there, not] {
            let list = format!("{HEADER}data file: LIST\n{name}\n{name}\n");
            std::fs::write(&header, list).unwrap();
            let (kind, line) = refusal(&header);
            assert_eq!((kind, line.replace(&name, "NAME")), missing, "{name}");
        }
    }
}

#[cfg(unix)]
#[test]
fn folder_with_a_link_that_leads_out_is_refused_whatever_is_there() {
    let dir = tempfile::tempdir().unwrap();
    let inside = dir.path().join("stack");
    std::fs::create_dir_all(&inside).unwrap();
    std::fs::write(dir.path().join("secret.tif"), b"II*\0").unwrap();
    let link = |target: &str| {
        let path = inside.join("slice-1.tif");
        let _ = std::fs::remove_file(&path);
        std::os::unix::fs::symlink(target, path).unwrap();
        refusal(&inside)
    };
    let there = link("../secret.tif");
    assert_eq!(there.0, OpenErrorKind::Forbidden);
    assert!(there.1.contains("`slice-1.tif` is a link that leads out of it"), "{}", there.1);
    assert_eq!(link("../nothing.tif"), there);
    assert_eq!(link("/dev/zero"), there);
    assert_eq!(link("/nowhere/at/all"), there);
    // A link inside, to nothing, to itself or to the folder, is no slice.
    for target in ["nothing.tif", "slice-1.tif", "."] {
        assert!(link(target).1.contains("holds no slices or pictures"), "{target}");
    }
}

#[test]
fn small_file_that_says_it_is_large_asks_before_it_is_inflated() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("honest.nrrd");
    let header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 2048 2048 2048\nencoding: gzip\n\n";
    // 8 GiB of zeros need about so many bytes; they are not read before the size is allowed.
    let data = vec![0u8; 9 << 20];
    std::fs::write(&path, [header.as_bytes(), &data].concat()).unwrap();
    let (kind, line) = refusal(&path);
    assert_eq!(kind, OpenErrorKind::TooLarge, "{line}");
    assert!(line.contains("9437184 bytes of file become 8589934592 bytes of samples"), "{line}");
    assert!(line.contains("only 1073741824 are read unasked"), "{line}");
    assert!(line.contains("give --max-bytes 8589934592 to read it all the same"), "{line}");
    let asked = Hints { max_bytes: Some(8 << 30), ..Hints::default() };
    let e = open_with(&path, &asked).expect_err("zeros are no gzip").problem;
    assert_eq!(e.kind, OpenErrorKind::Damaged, "allowed, and then looked at: {e}");
    let less = Hints { max_bytes: Some(23), ..Hints::default() };
    std::fs::write(&path, [HEADER.as_bytes(), b"\n", &[7; 24]].concat()).unwrap();
    let e = open_with(&path, &less).expect_err("24 bytes are more than 23").to_string();
    assert!(e.contains("24 bytes of samples are more than the 23 allowed"), "{e}");
}

/// Returns the peak of resident memory in MiB; `None` where the system has no figure.
fn peak_mib() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|l| l.starts_with("VmHWM:"))?;
    Some(line.split_ascii_whitespace().nth(1)?.parse::<u64>().ok()? / 1024)
}

#[test]
fn small_files_with_large_sizes_take_neither_memory_nor_time() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("liar.nrrd");
    // 128 MiB of zeros in 128 KiB.
    let mut gz = GzEncoder::new(Vec::new(), Compression::best());
    for _ in 0..128 {
        gz.write_all(&vec![0; 1 << 20]).unwrap();
    }
    let bomb = gz.finish().unwrap();
    // 4 MiB that gzip only halves, in a file that could claim 2 GB.
    let mut gz = GzEncoder::new(Vec::new(), Compression::fast());
    let mut state = 1u32;
    let noise = (0..4 << 20).map(|_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 28) as u8
    });
    gz.write_all(&noise.collect::<Vec<u8>>()).unwrap();
    let dense = gz.finish().unwrap();
    let before = peak_mib();
    for (sizes, kind, encoding, data, say) in [
        ("16384 16384 32", "double", "raw", &b"tiny"[..], "68719476736 bytes are needed and 4"),
        ("16384 16384 16384", "double", "raw", b"tiny", "more than 68719476736 samples"),
        ("5000 5000 5000", "uint8", "raw", b"tiny", "more than 68719476736 samples"),
        ("4294967296 4294967296 1", "uint8", "raw", b"tiny", "is longer than 16384"),
        ("99999999999999999999 1 1", "uint8", "raw", b"tiny", "something else than whole"),
        ("2000 2000 2000", "uint8", "gzip", b"tiny", "can't hold so many"),
        ("2000 2000 2000", "uint8", "gzip", &bomb, "can't hold so many"),
        ("1000 1000 1000", "uint8", "gzip", &dense, "needed and 4194304 are there"),
        ("64 64 64", "uint8", "gzip", &bomb, "goes on after the 262144 bytes"),
        ("4 4 4", "double", "gzip", &bomb, "goes on after the 512 bytes"),
    ] {
        let header = format!(
            "NRRD0004\ntype: {kind}\ndimension: 3\nsizes: {sizes}\nendian: little\n\
             encoding: {encoding}\n\n"
        );
        std::fs::write(&path, [header.as_bytes(), data].concat()).unwrap();
        let (_, line) = refusal(&path);
        assert!(line.contains(say), "want {say:?} in {line}");
    }
    // A skip inside gzip drops bytes as they are decoded, up to a limit.
    let skip = format!("{}byte skip: 16000000\n\n", HEADER.replace("raw", "gzip"));
    std::fs::write(&path, [skip.as_bytes(), &bomb].concat()).unwrap();
    assert!(refusal(&path).1.contains("goes on after the 24 bytes"));
    let skip = skip.replace("16000000", "17000000");
    std::fs::write(&path, [skip.as_bytes(), &bomb].concat()).unwrap();
    assert!(refusal(&path).1.contains("is more than the 16777216 that are skipped"));
    if let (Some(before), Some(after)) = (before, peak_mib()) {
        // Twice the 4 MiB read, 16 MiB besides, and as much for tests that run beside this one.
        assert!(after - before < 48, "took {} MiB", after - before);
        println!("{} MiB more at the peak", after - before);
    }
}
