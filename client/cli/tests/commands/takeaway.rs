//! Results that people keep: pictures of every format that can be made again, moving ones, video in
//! a pipe, and what becomes of them when the disk is full or Ctrl-C is pressed.

use crate::program::{end, good, names, run, signal, slabcast, text};
use std::io::{Read, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const VIEWS: [&str; 4] = ["--size", "40x30", "--tf", "skin"];

fn render(dir: &Path, more: &[&str]) -> String {
    good(dir, &[&["render", "formula:spheres:24", "-q"], &VIEWS[..], more].concat())
}

#[test]
fn rerender_gives_the_same_file_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    std::fs::write(
        dir.join("p.json"),
        r#"{"version":1,"size":[30,20],"views":[
        {"eye":[60,80,20],"target":[12,12,12],"up":[0,0,1],"projection":"persp","fov":31.7},
        {"eye":[61.1,80,20],"target":[12,12,12],"up":[0,0,1],"projection":"ortho","height":40}]}"#,
    )
    .unwrap();
    std::fs::write(
        dir.join("t.json"),
        r#"{"version":1,"domain":"unit","colors":[[0,0.1,0.3,0.7]],"opacities":[[0,0],[0.3,0.123]]}"#,
    )
    .unwrap();
    for (name, picture, more) in [
        ("turn", "turn/frame_0002.png", &["--frames", "3", "--start", "7.3", "--step", "3.1"][..]),
        ("axes", "axes/frame_0001.png", &["--frames", "2", "--up=-y", "--front=+x"]),
        ("path", "path/frame_0001.png", &["--path", "p.json", "--background", "transparent"]),
        ("deep", "deep/frame_0000.png", &["--azimuth", "3", "--format", "png16", "--tf", "t.json"]),
        ("sums.png", "sums.png", &["--azimuth", "3", "--sums", "i16", "--background", "#123456"]),
        ("light.exr", "light.exr", &["--azimuth", "3", "--thickness", "0.7", "--cull", "off"]),
        ("turn.apng", "turn.apng", &["--frames", "3", "--fps", "7", "--workers", "2"]),
    ] {
        let views = ["render", "formula:spheres:24", "-q", "--size", "40x30", "-o", name];
        good(dir, &[&views[..], more].concat());
        let said = good(dir, &["rerender", picture, "formula:spheres:24", "-q", "--force"]);
        let again = Path::new("again").with_extension(Path::new(picture).extension().unwrap());
        assert!(said.contains("the same") && said.lines().count() == 1, "{said}");
        let read = |path: &Path| std::fs::read(dir.join(path)).unwrap();
        assert_eq!(read(&again), read(Path::new(picture)), "{name}");
        assert!(read(&again).len() > 200, "{name}");
    }
    // The recipe in the picture is JSON and names no file.
    let said = good(dir, &["rerender", "deep/frame_0000.png", "--show"]);
    let json: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(json["pixels_version"], slabcast_common::PIXELS_VERSION);
    assert_eq!((&json["format"], &json["quality"]["sums"]), (&"png16".into(), &"i16".into()));
    assert!(!said.contains("spheres") && !said.contains("t.json"), "{said}");
}

#[test]
fn picture_file_does_not_depend_on_hashing() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    for (ending, format) in [("png", "png"), ("png", "png16"), ("exr", "exr")] {
        let file = |name: &str| format!("{format}-{name}.{ending}");
        let view = ["--azimuth", "7", "--format", format, "--stats"];
        let hashed = file("hashed");
        render(dir, &[&view[..], &["s.jsonl", "-o", &hashed]].concat());
        let plain = file("plain");
        render(dir, &[&view[..4], &["-o", &plain]].concat());
        let by_slabs = file("slabs");
        render(dir, &[&view[..4], &["--schedule", "slab", "-o", &by_slabs]].concat());
        let read = |name: &str| std::fs::read(dir.join(name)).unwrap();
        assert!(read(&hashed) == read(&plain) && read(&plain) == read(&by_slabs), "{format}");
        let stats: serde_json::Value = serde_json::from_slice(&read("s.jsonl")).unwrap();
        assert_eq!(stats["pixels_sha256"].as_str().map(str::len), Some(64));
        // Nothing crossed a network.
        assert_eq!(stats["result_bytes"], serde_json::Value::Null);
        let said = good(dir, &["rerender", &plain, "--show"]);
        let said: serde_json::Value = serde_json::from_str(&said).unwrap();
        assert_eq!(said["picture_sha256"].as_str().map(str::len), Some(64));
        assert_eq!(said.get("pixels_sha256"), None);
        // Floats are what the linear picture's hash is over.
        if format == "exr" {
            assert_eq!(said["picture_sha256"], stats["pixels_sha256"]);
        }
    }
}

#[test]
fn rerender_refuses_another_volume_with_both_digests() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    render(dir, &["--azimuth", "0", "-o", "a.png"]);
    let digest = |volume: &str| {
        let json: serde_json::Value =
            serde_json::from_str(&good(dir, &["info", volume, "--json"])).unwrap();
        json["digest"].as_str().unwrap().to_string()
    };
    let out = run(dir, &["rerender", "a.png", "formula:marker:24"]);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{said}");
    for name in ["a.png", &digest("formula:spheres:24"), &digest("formula:marker:24")] {
        assert!(said.contains(name), "{name}: {said}");
    }
    assert_eq!((said.lines().count(), names(dir)), (1, vec!["a.png".to_string()]));
}

#[test]
fn rerender_tells_missing_provenance_from_changed_pixels() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    render(dir, &["--azimuth", "0", "-o", "a.png"]);
    // A copy of the picture, saved by a program that drops text.
    let decode = |path: &Path| {
        let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
        let mut png = png::Decoder::new(file).read_info().unwrap();
        let mut pixels = vec![0; png.output_buffer_size().unwrap()];
        png.next_frame(&mut pixels).unwrap();
        pixels
    };
    let pixels = decode(&dir.join("a.png"));
    let mut encoder = png::Encoder::new(std::fs::File::create(dir.join("b.png")).unwrap(), 40, 30);
    encoder.set_color(png::ColorType::Rgb);
    encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
    let said = text(&run(dir, &["rerender", "b.png", "formula:spheres:24"]).stderr);
    assert!(said.contains("b.png") && said.contains("does not say what made it"), "{said}");
    // A byte behind the end: the pixels are the same, the file is not.
    let mut bytes = std::fs::read(dir.join("a.png")).unwrap();
    bytes.push(0);
    std::fs::write(dir.join("c.png"), bytes).unwrap();
    let out = run(dir, &["rerender", "c.png", "formula:spheres:24", "-q"]);
    let said = text(&out.stderr);
    assert!(out.status.code() == Some(1) && said.contains("the same pixels as c.png"), "{said}");
    let again = decode(&dir.join("again.png"));
    assert_eq!(again, pixels);
}

#[test]
fn apng_and_contact_sheet_hold_all_frames() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    render(dir, &["--frames", "4", "-o", "turn.apng", "--contact-sheet", "all.png"]);
    render(dir, &["--frames", "4", "-o", "still"]);
    let open = |path: &str| {
        let file = std::io::BufReader::new(std::fs::File::open(dir.join(path)).unwrap());
        png::Decoder::new(file).read_info().unwrap()
    };
    let mut moving = open("turn.apng");
    assert_eq!(moving.info().animation_control().unwrap().num_frames, 4);
    for n in 0..4 {
        let mut still = open(&format!("still/frame_{n:04}.png"));
        let mut want = vec![0; still.output_buffer_size().unwrap()];
        still.next_frame(&mut want).unwrap();
        let mut got = vec![0; moving.output_buffer_size().unwrap()];
        moving.next_frame(&mut got).unwrap();
        assert_eq!(got, want, "frame {n}");
    }
    let sheet = open("all.png");
    assert!(sheet.info().width > 2 * 40 && sheet.info().height > 30);
    assert_eq!(names(dir), ["all.png", "still", "turn.apng"]);
}

#[test]
fn y4m_on_stdout_is_alone_there() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let args = ["render", "formula:spheres:24", "--size", "40x30", "--frames", "3", "-o", "-"];
    let out = run(dir, &args);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let head = b"YUV4MPEG2 W40 H30 F12:1 Ip A1:1 C444 XYSCSS=444 XCOLORRANGE=LIMITED\n";
    assert!(out.stdout.starts_with(head));
    assert_eq!(out.stdout.len(), head.len() + 3 * (6 + 3 * 40 * 30));
    assert!(text(&out.stderr).contains("3 frames in stdout"), "{}", text(&out.stderr));
    good(
        dir,
        &["render", "formula:spheres:24", "-q", "--size", "40x30", "--frames", "3", "-o", "a.y4m"],
    );
    assert_eq!(std::fs::read(dir.join("a.y4m")).unwrap(), out.stdout);
    // Who reads it goes away after the head.
    let args = ["render", "formula:spheres:24", "--size", "400x300", "--frames", "500", "-o", "-"];
    let mut child =
        slabcast(dir, &args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut pipe = child.stdout.take().unwrap();
    pipe.read_exact(&mut [0; 20]).unwrap();
    drop(pipe);
    assert_eq!(end(&mut child, Duration::from_secs(60)), 1);
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(said.contains("error: stdout: whoever read the frames has gone away"), "{said}");
}

/// Stopped when some frames are there: the moving picture has those, and is whole.
#[cfg(unix)]
#[test]
fn ctrl_c_keeps_the_frames_of_an_apng() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let args = [
        "render",
        "formula:spheres:48",
        "--size",
        "160x160",
        "--frames",
        "5000",
        "--thickness",
        "0.25",
        "-o",
        "turn.apng",
    ];
    let mut child =
        slabcast(dir, &args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let until = Instant::now() + Duration::from_secs(60);
    let size = || {
        let entries = std::fs::read_dir(dir).unwrap().filter_map(Result::ok);
        entries.map(|e| e.metadata().map_or(0, |m| m.len())).sum::<u64>()
    };
    while size() < 50_000 {
        assert!(Instant::now() < until, "no frames: {:?}", child.try_wait());
        std::thread::sleep(Duration::from_millis(5));
    }
    signal(&child, "-INT");
    assert_eq!(end(&mut child, Duration::from_secs(30)), 130);
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    let bytes = std::fs::read(dir.join("turn.apng")).unwrap();
    let mut png = png::Decoder::new(std::io::Cursor::new(&bytes)).read_info().unwrap();
    let kept = png.info().animation_control().unwrap().num_frames;
    assert!(said.contains(&format!("stopped: kept {kept} of 5000 frames in turn.apng")), "{said}");
    for n in 0..kept {
        let mut pixels = vec![0; png.output_buffer_size().unwrap()];
        png.next_frame(&mut pixels).unwrap_or_else(|e| panic!("frame {n}: {e}"));
    }
    assert_eq!(names(dir), ["turn.apng"]);
}

/// A file system of its own, so small that some frames fill it.
struct Small(tempfile::TempDir);

impl Small {
    /// `None` where this user may not mount.
    fn mount(size: &str) -> Option<Small> {
        let dir = tempfile::tempdir().unwrap();
        let options = format!("size={size}");
        let out = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &options, "tmpfs"])
            .arg(dir.path())
            .output();
        match out {
            Ok(out) if out.status.success() => Some(Small(dir)),
            Ok(out) => {
                eprintln!("skipped: mounting a small file system: {}", text(&out.stderr).trim());
                None
            }
            Err(e) => {
                eprintln!("skipped: mounting a small file system: {e}");
                None
            }
        }
    }
}

impl Drop for Small {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg(self.0.path()).status();
    }
}

/// Lines of a child's stderr as they come.
fn listen(child: &mut std::process::Child) -> std::sync::mpsc::Receiver<String> {
    use std::io::BufRead;
    let (to, lines) = std::sync::mpsc::channel();
    let from = std::io::BufReader::new(child.stderr.take().unwrap());
    std::thread::spawn(move || {
        for line in from.lines().map_while(Result::ok) {
            if to.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

#[cfg(target_os = "linux")]
#[test]
fn full_disk_pauses_the_job_until_there_is_room() {
    let Some(small) = Small::mount("1m") else { return };
    let room = small.0.path();
    let patience = Duration::from_secs(60);
    for output in ["out/", "turn.apng"] {
        let elsewhere = tempfile::tempdir().unwrap();
        let path = room.join(output);
        let path = path.to_str().unwrap();
        std::fs::write(room.join("ballast"), vec![1; 990_000]).unwrap();
        let args = [
            "render",
            "formula:spheres:32",
            "--size",
            "120x90",
            "--frames",
            "8",
            "-o",
            path,
            "--stats",
            "s.jsonl",
        ];
        let mut child = slabcast(elsewhere.path(), &args)
            .stderr(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        let lines = listen(&mut child);
        let mut said = Vec::new();
        while !said.iter().any(|l: &String| l.contains("paused")) {
            said.push(lines.recv_timeout(patience).unwrap_or_else(|_| panic!("{said:?}")));
        }
        let paused = said.last().unwrap();
        assert!(paused.starts_with("warning: paused: no room to write "), "{paused}");
        assert!(paused.contains("when there is room"), "{paused}");
        // It waits; whatever has its final name is whole.
        assert!(child.try_wait().unwrap().is_none());
        for name in names(&room.join("out")) {
            if let Some(whole) = name.strip_suffix(".png") {
                let file = std::fs::File::open(room.join("out").join(&name)).unwrap();
                let mut png = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
                let mut pixels = vec![0; png.output_buffer_size().unwrap()];
                png.next_frame(&mut pixels).unwrap_or_else(|e| panic!("{whole}: {e}"));
            }
        }
        std::fs::remove_file(room.join("ballast")).unwrap();
        assert_eq!(end(&mut child, patience), 0, "{said:?}");
        said.extend(lines.iter());
        let count = |part: &str| said.iter().filter(|l| l.contains(part)).count();
        assert_eq!((count("paused"), count("there is room again")), (1, 1), "{said:?}");
        if output == "out/" {
            let frames: Vec<String> = (0..8).map(|n| format!("frame_{n:04}.png")).collect();
            assert_eq!(names(&room.join("out")), frames);
            std::fs::remove_dir_all(room.join("out")).unwrap();
        }
    }
    assert_eq!(names(room), ["turn.apng"]);
}

/// Starts a run of 40 frames into `out/` and takes that folder away, to `to`, after the first.
fn run_whose_folder_goes(
    folder: &Path,
    to: &str,
) -> (std::process::Child, Vec<String>, std::sync::mpsc::Receiver<String>) {
    let args = ["render", "formula:spheres:32", "--size", "120x90", "--frames", "40", "-o", "out/"];
    let mut child =
        slabcast(folder, &args).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let lines = listen(&mut child);
    let patience = Duration::from_secs(60);
    let since = Instant::now();
    while !folder.join("out/frame_0000.png").exists() {
        assert!(since.elapsed() < patience, "no frame comes");
        std::thread::sleep(Duration::from_millis(1));
    }
    std::fs::rename(folder.join("out"), folder.join(to)).unwrap();
    let mut said = Vec::new();
    while !said.iter().any(|l: &String| l.contains("paused")) {
        said.push(lines.recv_timeout(patience).unwrap_or_else(|_| panic!("{said:?}")));
    }
    let paused = said.last().unwrap();
    assert!(paused.starts_with("warning: paused: the folder is gone to write "), "{paused}");
    assert!(paused.contains("when the folder is back"), "{paused}");
    assert!(child.try_wait().unwrap().is_none(), "it waits");
    (child, said, lines)
}

#[test]
fn folder_that_is_gone_pauses_the_job_until_it_is_back() {
    let dir = tempfile::tempdir().unwrap();
    let (mut child, mut said, lines) = run_whose_folder_goes(dir.path(), "away");
    std::fs::rename(dir.path().join("away"), dir.path().join("out")).unwrap();
    assert_eq!(end(&mut child, Duration::from_secs(60)), 0, "{said:?}");
    said.extend(lines.iter());
    assert!(said.iter().any(|l| l.contains("the folder is back: going on")), "{said:?}");
    let frames = names(&dir.path().join("out"));
    assert_eq!(frames.iter().filter(|n| n.starts_with("frame_")).count(), 40, "{frames:?}");
}

#[test]
fn frames_that_went_with_their_folder_are_not_said_to_be_kept() {
    let dir = tempfile::tempdir().unwrap();
    let (mut child, mut said, lines) = run_whose_folder_goes(dir.path(), "away");
    std::fs::create_dir(dir.path().join("out")).unwrap();
    assert_eq!(end(&mut child, Duration::from_secs(60)), 1, "{said:?}");
    said.extend(lines.iter());
    let there = names(&dir.path().join("out")).len();
    assert!(there < 40, "{there}");
    let gone = format!("out/: {} of 40 frames were taken away after they were written", 40 - there);
    assert!(said.iter().any(|l| l.contains(&gone)), "want {gone:?} in {said:?}");
    assert!(said.iter().any(|l| l.contains(&format!("kept {there} of 40 frames"))), "{said:?}");
}

#[cfg(target_os = "linux")]
#[test]
fn ctrl_c_ends_a_paused_job_and_keeps_whole_files() {
    let Some(small) = Small::mount("400k") else { return };
    let room = small.0.path();
    let mut ballast = std::fs::File::create(room.join("ballast")).unwrap();
    ballast.write_all(&vec![1; 340_000]).unwrap();
    let args = ["render", "formula:spheres:32", "--size", "120x90", "--frames", "200", "-o", "out"];
    let mut child =
        slabcast(room, &args).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let lines = listen(&mut child);
    let patience = Duration::from_secs(60);
    while !lines.recv_timeout(patience).expect("it pauses").contains("paused") {}
    signal(&child, "-INT");
    assert_eq!(end(&mut child, Duration::from_secs(20)), 130);
    let said: Vec<String> = lines.iter().collect();
    let kept = names(&room.join("out"));
    assert!(kept.iter().all(|n| n.ends_with(".png")), "{kept:?}");
    let told =
        if kept.is_empty() { "nothing".into() } else { format!("kept {} of 200", kept.len()) };
    assert!(said.iter().any(|l| l.starts_with("stopped: ") && l.contains(&told)), "{said:?}");
}
