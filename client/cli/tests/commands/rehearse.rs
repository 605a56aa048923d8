//! Workers that hold tiles instead of drawing them, and masters that know it.

use crate::program::{Process, good, run, slabcast, text};
use serde_json::Value;
use std::path::Path;
use std::process::Stdio;

/// Real pings take seconds; a plan's own test measures them.
const SCENE: [&str; 7] =
    ["formula:spheres:32", "--size", "128x128", "--frames", "4", "--quiet", "--no-pings"];

fn master(dir: &Path, more: &[&str]) -> (Process, String) {
    crate::program::master(dir, "formula:spheres:32", more)
}

#[test]
fn rehearsal_of_two_workers_stands_beside_its_prediction() {
    let dir = tempfile::tempdir().unwrap();
    let more = ["--trace", "s.trace", "--workers", "2", "--rehearse", "2", "--json"];
    let plan: Value =
        serde_json::from_str(&good(dir.path(), &[&["lab", "plan"][..], &SCENE, &more].concat()))
            .unwrap();
    for (i, schedule) in ["region", "slab"].into_iter().enumerate() {
        let row = &plan["rehearsed"][i];
        assert_eq!(row["schedule"], schedule, "{plan}");
        assert_eq!(row["workers"], 2, "{plan}");
        let n = |key: &str| row[key].as_f64().unwrap_or_else(|| panic!("{key}: {row}"));
        // Two workers hold what was measured: no frame is shorter than half of it.
        let alone = plan["measured"]["alone_ms"].as_f64().unwrap();
        assert!(n("frame_ms") > 0.3 * alone, "{row}");
        assert!(n("predicted_ms") > 0.3 * alone && n("each_ms") > 0.0, "{row}");
        if cfg!(target_os = "linux") {
            assert!(n("master_cpu_ms") > 0.0 && n("workers_cpu_ms") > 0.0, "{row}");
        }
    }
    let without = ["lab", "plan", "formula:spheres:16", "--rehearse", "2"];
    let out = run(dir.path(), &without);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("--trace"), "{}", text(&out.stderr));
}

#[test]
fn rehearsal_uses_the_given_address() {
    let dir = tempfile::tempdir().unwrap();
    // All of 127.0.0.0/8 is this machine, on Linux.
    let at = if cfg!(target_os = "linux") { "127.0.0.2" } else { "127.0.0.1" };
    let more = ["--schedule", "region", "--trace", "s.trace", "--workers", "2", "--rehearse", "2"];
    let plan =
        |over: &[&str]| run(dir.path(), &[&["lab", "plan"][..], &SCENE, &more, over].concat());
    let out = plan(&["--rehearse-at", at, "--rehearse-by", "env PASSED=1"]);
    let said = text(&out.stdout);
    assert_eq!(out.status.code(), Some(0), "{}", text(&out.stderr));
    assert!(said.contains(&format!("over the link of {at}")), "{said}");

    // The program that can't start workers is named at once, without waiting for workers.
    let out = plan(&["--rehearse-at", at, "--rehearse-by", "no-such-program far"]);
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("starting `no-such-program far slabcast worker"), "{said}");

    let out = plan(&["--rehearse-at", at, "--rehearse-by", "false"]);
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("that `false` started has ended (exit status: 1)"), "{said}");

    // An address that is not this machine's.
    let out = plan(&["--rehearse-at", "192.0.2.1"]);
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stderr).contains("192.0.2.1"), "{}", text(&out.stderr));
    let out = plan(&["--rehearse-by", "env"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("--rehearse-at"), "{}", text(&out.stderr));
}

#[test]
fn rehearsed_frames_are_marked_as_no_pictures() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let plan = ["--trace", "s.trace", "--workers", "1"];
    good(dir, &[&["lab", "plan"][..], &SCENE, &plan].concat());
    let worker = |address: &str, more: &[&str]| {
        let args = ["worker", "--master", address, "--threads", "1", "--log-level", "error"];
        slabcast(dir, &[&args[..], more].concat())
    };

    // A master that draws does not take a worker that does not.
    let (_drawing, address) = master(dir, &[]);
    let out = worker(&address, &["--rehearse", "s.trace"]).output().unwrap();
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("the worker rehearses") && said.contains("without --rehearse"), "{said}");

    // Nor the other way round.
    let (_rehearsing, address) = master(dir, &["--rehearse"]);
    let out = worker(&address, &[]).output().unwrap();
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stderr).contains("this master rehearses"), "{}", text(&out.stderr));

    // And what comes of a rehearsal says so, in words, in numbers and to the eye.
    let mut command = worker(&address, &["--rehearse", "s.trace"]);
    let _held = Process(command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap());
    let render =
        ["render", "--master", &address, "--size", "128x128", "--frames", "4", "--step", "5", "-q"];
    for schedule in ["slab", "region"] {
        let files = ["--stats", "s.jsonl", "-o", "out", "--schedule", schedule, "--force"];
        let out = run(dir, &[&render[..], &files].concat());
        assert!(out.status.success(), "{schedule}: {}", text(&out.stderr));
        assert!(text(&out.stderr).contains("the pictures are stripes"), "{}", text(&out.stderr));
        for line in std::fs::read_to_string(dir.join("s.jsonl")).unwrap().lines() {
            let stats: Value = serde_json::from_str(line).unwrap();
            assert_eq!(stats["rehearsed"], true);
            assert_eq!(stats["pixels_sha256"], "none: rehearsed");
            assert!(stats["ms"]["render"].as_f64().unwrap() > 0.0, "{schedule}");
        }
    }
    let picture = |n: u32| std::fs::read(dir.join(format!("out/frame_{n:04}.png"))).unwrap();
    let decoder = png::Decoder::new(std::io::Cursor::new(picture(2)));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    assert_eq!(pixels[..3], [255, 0, 255]);
    assert_eq!(pixels[3 * 16..3 * 17], [0, 0, 0]);

    // Another picture than the trace's can't be rehearsed.
    let other = ["render", "--master", &address, "--size", "96x96", "--frames", "1", "-q"];
    let out = run(dir, &[&other[..], &["-o", "other"]].concat());
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stderr).contains("the trace that is rehearsed"), "{}", text(&out.stderr));
}
