//! Behaviour of the program without errors: where its output goes, which files it leaves, and how
//! it stops.

use crate::program::{Process, end, master, names, run, signal, slabcast, text, wait_until};
use slabcast_common::stats::FrameStats;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::Stdio;
use std::time::{Duration, Instant};

#[test]
fn render_says_where_pictures_are_and_how_long_it_took() {
    let dir = tempfile::tempdir().unwrap();
    let out =
        run(dir.path(), &["render", "formula:spheres:24", "--size", "40x30", "--frames", "3"]);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let said = text(&out.stdout);
    assert!(
        said.starts_with("3 frames in slabcast-out/ (frame_0000.png ... frame_0002.png), "),
        "{said}"
    );
    assert!(said.contains("the first after") && said.lines().count() == 1, "{said}");
    assert_eq!(
        names(&dir.path().join("slabcast-out")),
        ["frame_0000.png", "frame_0001.png", "frame_0002.png"]
    );
    assert_eq!(names(dir.path()), ["slabcast-out"]);
}

#[test]
fn statistics_on_stdout_equal_those_in_a_file() {
    let dir = tempfile::tempdir().unwrap();
    let views = ["render", "formula:spheres:24", "--size", "40x30", "--frames", "2", "-q"];
    let out = run(dir.path(), &[&views[..], &["--stats", "-", "-o", "a"]].concat());
    let lines = |text: &str| -> Vec<FrameStats> {
        text.lines().map(|l| serde_json::from_str(l).expect("a line of statistics")).collect()
    };
    let a = lines(&text(&out.stdout));
    assert!(text(&out.stderr).contains("2 frames in a/"), "{}", text(&out.stderr));
    let more = ["--stats", "s.jsonl", "--trace", "t.json", "-o", "b", "--workers", "3"];
    let out = run(dir.path(), &[&views[..], &more].concat());
    assert!(out.status.success(), "{}", text(&out.stderr));
    let b = lines(&std::fs::read_to_string(dir.path().join("s.jsonl")).unwrap());
    let hashes =
        |s: &[FrameStats]| -> Vec<String> { s.iter().map(|f| f.pixels_sha256.clone()).collect() };
    assert_eq!(hashes(&a), hashes(&b));
    assert_eq!(
        std::fs::read(dir.path().join("a/frame_0001.png")).unwrap(),
        std::fs::read(dir.path().join("b/frame_0001.png")).unwrap(),
        "one worker or three"
    );
    let trace: serde_json::Value =
        serde_json::from_slice(&std::fs::read(dir.path().join("t.json")).unwrap()).unwrap();
    assert!(trace["traceEvents"].as_array().unwrap().len() > 4);
    assert_eq!(names(dir.path()), ["a", "b", "s.jsonl", "t.json"]);
}

#[test]
fn path_file_and_transfer_function_file_are_rendered() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(
        dir.path().join("p.json"),
        r#"{"version":1,"size":[20,10],"views":[
        {"eye":[60,80,20],"target":[12,12,12],"up":[0,0,1],"projection":"persp","fov":30},
        {"eye":[60,80,20],"target":[12,12,12],"up":[0,0,1],"projection":"ortho","height":40}]}"#,
    )
    .unwrap();
    std::fs::write(
        dir.path().join("t.json"),
        r#"{"version":1,"domain":"unit","colors":[[0,1,0,0]],"opacities":[[0,0],[1,1]]}"#,
    )
    .unwrap();
    let args = [
        "render",
        "formula:spheres:24",
        "--path",
        "p.json",
        "--tf",
        "t.json",
        "--background",
        "transparent",
        "-q",
    ];
    let out = run(dir.path(), &args);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let file = std::fs::File::open(dir.path().join("slabcast-out/frame_0001.png")).unwrap();
    let mut png = png::Decoder::new(BufReader::new(file)).read_info().unwrap();
    assert_eq!(png.output_color_type().0, png::ColorType::Rgba);
    let mut pixels = vec![0; png.output_buffer_size().unwrap()];
    png.next_frame(&mut pixels).unwrap();
    assert_eq!((png.info().width, png.info().height), (20, 10));
    assert!(pixels.chunks_exact(4).any(|p| p[0] > 100 && p[1] == 0 && p[3] > 200));
    assert!(pixels.chunks_exact(4).any(|p| p == [0; 4]));
}

#[test]
fn blank_picture_gives_a_note_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(
        dir.path().join("t.json"),
        r#"{"version":1,"domain":"value","colors":[[0,1,0,0]],"opacities":[[1000,0],[2000,1]]}"#,
    )
    .unwrap();
    let args = ["render", "formula:wall:16", "--tf", "t.json", "--azimuth", "0", "--size", "9x9"];
    let out = run(dir.path(), &args);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let said = text(&out.stderr);
    assert!(said.contains("warning: frame 0 is blank: no voxel is visible"), "{said}");
    assert!(said.contains("0 to 200") && said.contains("t.json"), "{said}");
}

#[test]
fn closed_stdout_ends_the_command_quietly() {
    let dir = tempfile::tempdir().unwrap();
    let mut child = slabcast(dir.path(), &["completions", "bash"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let code = end(&mut child, Duration::from_secs(20));
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert!(said.is_empty() && code == 0, "{code}: {said}");
    if Path::new("/dev/full").exists() {
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let out = slabcast(dir.path(), &["info", "formula:one"]).stdout(full).output().unwrap();
        assert_eq!(out.status.code(), Some(1));
        assert!(text(&out.stderr).starts_with("error: stdout: "), "{}", text(&out.stderr));
    }
}

#[test]
fn info_prints_text_and_json() {
    let dir = tempfile::tempdir().unwrap();
    let said = text(&run(dir.path(), &["info", "formula:spheres"]).stdout);
    for part in ["64 x 64 x 64", "world box", "histogram", "peer-skull", "turntable"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    let out = run(dir.path(), &["info", "formula:blob", "--json"]);
    let json: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(json["dims"], serde_json::json!([64, 64, 64]));
    assert!(json["presets"].as_array().unwrap().len() >= 20);
}

#[test]
fn logs_are_json_on_request_and_plain_under_systemd() {
    let dir = tempfile::tempdir().unwrap();
    let args =
        ["render", "formula:blob", "--azimuth", "0", "--size", "8x8", "-q", "--log-level", "info"];
    let out = run(dir.path(), &[&args[..], &["--log", "json", "-o", "a"]].concat());
    let said = text(&out.stderr);
    let mut logs = said.lines().map(serde_json::from_str::<serde_json::Value>);
    assert!(logs.all(|l| l.is_ok_and(|l| l["level"].is_string())), "{said}");
    let out = slabcast(dir.path(), &[&args[..], &["-o", "b"]].concat())
        .env("JOURNAL_STREAM", "8:1")
        .output()
        .unwrap();
    let said = text(&out.stderr);
    assert!(said.lines().count() > 0 && said.lines().all(|l| l.starts_with('<')), "{said}");
    assert!(!said.contains('\u{1b}'), "{said}");
}

/// Started so that its first frame is a while away, and stopped when two are there.
#[cfg(unix)]
#[test]
fn ctrl_c_keeps_whole_frames() {
    let dir = tempfile::tempdir().unwrap();
    let args = [
        "render",
        "formula:spheres:64",
        "--size",
        "200x200",
        "--frames",
        "5000",
        "--thickness",
        "0.25",
        "--stats",
        "s.jsonl",
    ];
    let mut child =
        slabcast(dir.path(), &args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let folder = dir.path().join("slabcast-out");
    let until = Instant::now() + Duration::from_secs(60);
    while !folder.join("frame_0001.png").exists() {
        assert!(Instant::now() < until, "no frames: {:?}", child.try_wait());
        std::thread::sleep(Duration::from_millis(5));
    }
    signal(&child, "-INT");
    assert_eq!(end(&mut child, Duration::from_secs(20)), 130);
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    let kept = names(&folder);
    assert!(kept.iter().all(|n| n.ends_with(".png")), "{kept:?}");
    assert!(said.contains(&format!("stopped: kept {} of 5000 frames", kept.len())), "{said}");
    for name in &kept {
        let file = BufReader::new(std::fs::File::open(folder.join(name)).unwrap());
        let mut png = png::Decoder::new(file).read_info().unwrap();
        let mut pixels = vec![0; png.output_buffer_size().unwrap()];
        png.next_frame(&mut pixels).unwrap_or_else(|e| panic!("{name} is not whole: {e}"));
    }
    assert_eq!(names(dir.path()), ["s.jsonl", "slabcast-out"]);
}

/// The render is stopped for as long as a cluster needs to lose a silent worker.
#[cfg(unix)]
#[test]
fn render_survives_sigstop_longer_than_worker_silence() {
    let dir = tempfile::tempdir().unwrap();
    let (_master, address) = master(dir.path(), "formula:one", &[]);
    let name = "sleeper";
    let worker = ["worker", "--master", &address, "--threads", "1", "--name", name];
    let worker = slabcast(dir.path(), &worker).stderr(Stdio::null()).spawn().unwrap();
    let worker = Process(worker);
    let status = ["status", "--master", &address];
    let is_there = || text(&run(dir.path(), &status).stdout).contains(name);
    wait_until("the worker joined", is_there);
    let args = ["render", "formula:spheres:48", "--size", "160x160", "--frames", "40"];
    let args = [&args[..], &["--thickness", "0.25"]].concat();
    let mut child =
        slabcast(dir.path(), &args).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let until = Instant::now() + Duration::from_secs(60);
    while !dir.path().join("slabcast-out/frame_0000.png").exists() {
        assert!(Instant::now() < until, "no frames: {:?}", child.try_wait());
        std::thread::sleep(Duration::from_millis(5));
    }
    signal(&child, "-STOP");
    worker.signal("-STOP");
    // The master drops a worker that is silent for 3 s.
    wait_until("the master dropped the worker", || !is_there());
    signal(&child, "-CONT");
    let code = end(&mut child, Duration::from_secs(60));
    let mut said = String::new();
    child.stderr.take().unwrap().read_to_string(&mut said).unwrap();
    assert_eq!(code, 0, "{said}");
}

#[cfg(unix)]
#[test]
fn master_and_worker_print_address_and_stop_on_sigterm() {
    let dir = tempfile::tempdir().unwrap();
    let mut master = slabcast(
        dir.path(),
        &["master", "--volume", "formula:spheres:24", "--listen", "127.0.0.1:0"],
    )
    .stdout(Stdio::piped())
    .stderr(Stdio::null())
    .spawn()
    .unwrap();
    let mut line = String::new();
    BufReader::new(master.stdout.take().unwrap()).read_line(&mut line).unwrap();
    let address = line.trim().strip_prefix("listening on ").unwrap().to_string();
    let mut worker = slabcast(
        dir.path(),
        &["worker", "--master", &address, "--threads", "1", "--name", "helper"],
    )
    .stderr(Stdio::null())
    .spawn()
    .unwrap();
    let args = ["render", "--master", &address, "--frames", "2", "--size", "30x30", "-q"];
    let out = run(dir.path(), &args);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let status = text(&run(dir.path(), &["status", "--master", &address]).stdout);
    assert!(status.contains("helper") && status.contains("formula:spheres:24"), "{status}");
    let jobs = text(&run(dir.path(), &["jobs", "--master", &address]).stdout);
    assert!(jobs.contains("done") && jobs.contains("2/2"), "{jobs}");
    // A cluster's pictures say what made them, too; and its master has the time.
    let again = ["rerender", "slabcast-out/frame_0001.png", "formula:spheres:24", "-o", "a.png"];
    assert!(crate::program::good(dir.path(), &again).contains("a.png: the same "));
    std::fs::remove_file(dir.path().join("a.png")).unwrap();
    let said = crate::program::good(dir.path(), &["doctor", "--master", &address, "--json"]);
    let said: serde_json::Value = serde_json::from_str(&said).unwrap();
    for name in ["master", "versions", "clock"] {
        let checks = said["checks"].as_array().unwrap();
        let check = checks.iter().find(|c| c["name"] == name).unwrap();
        assert_eq!(check["state"], "ok", "{said}");
    }
    // A flag that the master's volume makes wrong is named like one that is wrong in itself.
    let out = run(dir.path(), &["render", "--master", &address, "--elevation", "95", "-o", "x"]);
    assert!(text(&out.stderr).starts_with("error: --elevation:"), "{}", text(&out.stderr));
    signal(&worker, "-TERM");
    assert_eq!(end(&mut worker, Duration::from_secs(10)), 0);
    signal(&master, "-TERM");
    assert_eq!(end(&mut master, Duration::from_secs(10)), 0);
    assert_eq!(names(dir.path()), ["slabcast-out"]);
}

#[cfg(target_os = "linux")]
#[test]
fn systemd_gets_ready_watchdog_and_stopping() {
    use std::os::unix::net::UnixDatagram;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("notify");
    let socket = UnixDatagram::bind(&path).unwrap();
    socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let hear = || {
        let mut buffer = [0; 4096];
        let n = socket.recv(&mut buffer).expect("a word in time");
        text(&buffer[..n])
    };
    let mut master =
        slabcast(dir.path(), &["master", "--volume", "formula:one", "--listen", "127.0.0.1:0"])
            .env("NOTIFY_SOCKET", &path)
            .env("WATCHDOG_USEC", "200000")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
    assert!(hear().contains("READY=1"));
    assert!(hear().contains("WATCHDOG=1"));
    assert!(hear().contains("WATCHDOG=1"));
    signal(&master, "-TERM");
    let mut word = hear();
    while word.contains("WATCHDOG=1") {
        word = hear();
    }
    assert!(word.contains("STOPPING=1"), "{word}");
    assert_eq!(end(&mut master, Duration::from_secs(10)), 0);
}
