//! `--record` and `slabcast lab replay` on real runs.

use crate::program::{end, good, names, run, signal, slabcast, text, wait_for_text, wait_until};
use std::process::Stdio;
use std::time::Duration;

#[test]
fn recorded_render_replays_identically() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let views = ["render", "formula:spheres:40", "--size", "150x130", "--frames", "3", "-q"];
    let more = ["--workers", "3", "--tile", "32", "--record", "events.log", "--stats", "s.jsonl"];
    good(dir, &[&views[..], &more].concat());
    assert_eq!(names(dir), ["events.log", "s.jsonl", "slabcast-out"], "no .part is left");
    let said = good(dir, &["lab", "replay", "events.log"]);
    assert!(said.ends_with(" decisions, 3 frames: identical\n"), "{said}");
    let json: serde_json::Value =
        serde_json::from_str(&good(dir, &["lab", "replay", "events.log", "--json"])).unwrap();
    assert_eq!(json["identical"], true);
    assert!(json["events"].as_u64().unwrap() > 60, "{json}");
    // A frame says what it waited for.
    for (n, line) in std::fs::read_to_string(dir.join("s.jsonl")).unwrap().lines().enumerate() {
        let stats: serde_json::Value = serde_json::from_str(line).unwrap();
        let path = stats["critical_path"].as_str().unwrap();
        assert!(path.starts_with(&format!("frame {n}: ")) && path.contains(" ms"), "{path}");
    }
    // One digit of one decision.
    let record = std::fs::read_to_string(dir.join("events.log")).unwrap();
    let at = record.match_indices(": region t").nth(20).unwrap().0;
    let line = record[..at].lines().count();
    let bad = format!("{}{}", &record[..at], record[at..].replacen(" e0 of", " e1 of", 1));
    std::fs::write(dir.join("bad.log"), bad).unwrap();
    let out = run(dir, &["lab", "replay", "bad.log"]);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{said}");
    assert!(said.contains(&format!("bad.log: line {line}: ")), "{line}: {said}");
    assert!(said.contains("recorded `") && said.contains(" e1 of"), "{said}");
    std::fs::write(dir.join("broken.log"), record[..record.len() / 2].replace("\"t\"", "\"u\""))
        .unwrap();
    let out = run(dir, &["lab", "replay", "broken.log"]);
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(
        said.contains("broken.log: line ") && said.contains("is not a line of a record"),
        "{said}"
    );
    let out = run(dir, &["lab", "replay", "slabcast-out/frame_0000.png"]);
    assert!(text(&out.stderr).contains("line 1: is not a record's first line"));
}

#[test]
fn recorded_master_replays_identically_after_sigterm() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (mut master, address) =
        crate::program::master(dir, "formula:spheres:24", &["--record", "events.log"]);
    let worker = |name: &str| {
        let args = ["worker", "--master", &address, "--threads", "1", "--name", name];
        slabcast(dir, &args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
    };
    let mut workers = [worker("one"), worker("two")];
    // A worker that is killed before it joined is never lost.
    wait_until("two workers join", || {
        let record = std::fs::read_to_string(dir.join("events.log.part")).unwrap_or_default();
        record.matches("\"joined\"").count() >= 2
    });
    let render = ["render", "--master", &address, "--size", "120x120", "--frames", "4", "-q"];
    good(dir, &render);
    let out = run(dir, &[&render[..], &["--record", "x.log"]].concat());
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("give --record to `slabcast master`"));
    // One goes in the middle of nothing; the other is told to leave.
    workers[0].kill().unwrap();
    workers[0].wait().unwrap();
    wait_for_text(&dir.join("events.log.part"), "\"lost\"");
    assert!(names(dir).contains(&"events.log.part".to_string()), "{:?}", names(dir));
    signal(&master.0, "-TERM");
    assert_eq!(end(&mut master.0, Duration::from_secs(12)), 0);
    workers[1].kill().unwrap();
    workers[1].wait().unwrap();
    let said = good(dir, &["lab", "replay", "events.log"]);
    assert!(said.ends_with(" decisions, 4 frames: identical\n"), "{said}");
    let record = std::fs::read_to_string(dir.join("events.log")).unwrap();
    assert!(record.contains("\"joined\"") && record.contains("\"lost\""));
}
