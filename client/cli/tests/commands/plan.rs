//! `slabcast lab plan`: what is measured, what is predicted, and what is refused.

use crate::program::{good, names, run, text};
use serde_json::Value;

const SMALL: [&str; 8] =
    ["lab", "plan", "formula:spheres:32", "--size", "128x128", "--frames", "3", "--quiet"];

fn json(text: &str) -> Value {
    serde_json::from_str(text).expect("JSON")
}

#[test]
fn plan_separates_measured_from_predicted() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let cluster = ["--workers", "1..3,8", "--link", "1gbit", "--latency", "100us"];
    // The trace may lie in the folder that is yet to be made.
    let files = ["--trace", "out/s.trace", "-o", "out"];
    let said = good(dir, &[&SMALL[..], &cluster, &files].concat());
    assert!(said.contains("measured here: ") && said.contains("alone, one core takes"), "{said}");
    assert!(said.contains("predicted from that"), "{said}");
    assert!(said.contains("links of 1 Gbit/s, 100 us one way"), "{said}");
    let rows: Vec<&str> = said.lines().filter(|l| l.trim_end().ends_with(" %")).collect();
    assert_eq!(rows.len(), 8, "both schedules: {said}");
    assert!(said.contains("region schedule") && said.contains("slab schedule, 3 slabs"), "{said}");
    assert!(!said.contains("render threads' time"), "three frames are too few to tell: {said}");
    assert!(
        said.contains("frames/s: can't be told of 3 frames; give --frames 16 or more"),
        "{said}"
    );
    assert_eq!(
        names(&dir.join("out")),
        ["plan.csv", "plan.json", "plan.png", "plan.svg", "s.trace"]
    );
    let svg = std::fs::read_to_string(dir.join("out/plan.svg")).unwrap();
    assert!(svg.contains("predicted efficiency") && svg.contains("<circle"));
    let csv = std::fs::read_to_string(dir.join("out/plan.csv")).unwrap();
    assert_eq!(csv.lines().count(), 9);
    let plan = json(&std::fs::read_to_string(dir.join("out/plan.json")).unwrap());
    assert_eq!(plan["measured"]["frames"], 3);
    let workers: Vec<u64> = plan["predicted"]
        .as_array()
        .unwrap()
        .iter()
        .map(|r| r["workers"].as_u64().unwrap())
        .collect();
    assert_eq!(workers, [1, 2, 3, 8, 1, 2, 3, 8]);
    for row in plan["predicted"].as_array().unwrap() {
        let n = |key: &str| row[key].as_f64().unwrap();
        assert!(n("frame_ms") > 0.0 && n("first_ms") > 0.0 && n("bytes_up") > 0.0, "{row}");
        // Nobody is faster than all cores, but for what two measurements differ by on a busy
        // machine.
        assert!(n("latency_efficiency") <= 1.5, "{row}");
        let named = ["cores", "straggler", "link", "master"];
        assert!(named.contains(&row["bound_by"].as_str().unwrap()), "{row}");
        assert!(row["render_threads"].is_null() && row["master_busy"].is_null(), "{row}");
        assert!(row["frames_per_s"].is_null() && row["throughput_efficiency"].is_null(), "{row}");
    }
    // The saved measurements are read again; with a slow link, the link is the bound.
    let slow = [
        "--workers",
        "8",
        "--link",
        "1mbit",
        "--trace",
        "out/s.trace",
        "--json",
        "--schedule",
        "slab",
    ];
    let plan = json(&good(dir, &[&SMALL[..], &slow].concat()));
    assert_eq!(plan["predicted"][0]["bound_by"], "link", "{plan}");
    // And is not taken for another picture's.
    let other = ["--tf", "bone", "--trace", "out/s.trace"];
    let out = run(dir, &[&SMALL[..], &other].concat());
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("s.trace: frame 0 was measured of another volume, view"), "{said}");
    std::fs::write(dir.join("bad.trace"), "{}").unwrap();
    let out = run(dir, &[&SMALL[..], &["--trace", "bad.trace"]].concat());
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stderr).contains("bad.trace: is not a trace"), "{}", text(&out.stderr));
}

#[test]
fn plan_of_many_frames_lists_where_thread_time_goes() {
    let dir = tempfile::tempdir().unwrap();
    let frames =
        ["lab", "plan", "formula:spheres:32", "--size", "128x128", "--frames", "16", "--quiet"];
    let cluster = ["--workers", "2", "--schedule", "region", "--trace", "s.trace", "--no-pings"];
    let said = good(dir.path(), &[&frames[..], &cluster].concat());
    assert!(said.contains("four in flight: % of the render threads' time"), "{said}");
    assert!(!said.contains("can't be told"), "{said}");
    let plan = json(&good(dir.path(), &[&frames[..], &cluster, &["--json"]].concat()));
    let row = &plan["predicted"][0];
    let parts = row["render_threads"].as_object().unwrap();
    let lost: f64 = parts.values().map(|part| part.as_f64().unwrap()).sum();
    let alone = row["throughput_efficiency"].as_f64().unwrap();
    assert!((lost + alone - 1.0).abs() < 1e-6, "all of it, and once: {row}");
    assert!(row["master_busy"]["driver"].as_f64().unwrap() > 0.0, "{row}");
}

#[test]
fn plan_refuses_bad_flags_with_name_and_remedy() {
    let dir = tempfile::tempdir().unwrap();
    for (flag, value, remedy) in [
        ("--workers", "4..1", "1..64"),
        ("--workers", "0", "1..64"),
        ("--link", "1gb", "10gbit"),
        ("--latency", "5", "50us"),
        ("--threads", "0", "1..=1024"),
        ("--repeats", "0", "1..=100"),
    ] {
        let out = run(dir.path(), &["lab", "plan", "formula:spheres:16", flag, value]);
        let said = text(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{flag} {value}: {said}");
        assert!(said.contains(flag) && said.contains(remedy), "{flag} {value}: {said}");
        assert_eq!(said.lines().count(), 1, "{said}");
    }
    let many = ["lab", "plan", "formula:spheres:16", "--workers", "1000", "--threads", "1000"];
    let out = run(dir.path(), &many);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("--workers, --threads"), "{}", text(&out.stderr));
    // Before anything is opened, let alone drawn for minutes.
    let nowhere = ["lab", "plan", "missing.nrrd", "--trace", "nowhere/s.trace"];
    let out = run(dir.path(), &nowhere);
    assert_eq!(out.status.code(), Some(1));
    let said = text(&out.stderr);
    assert!(said.contains("nowhere/s.trace: making the file failed"), "{said}");
    assert!(names(dir.path()).is_empty());
}
