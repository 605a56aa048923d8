//! `--classify after` from the command line.

use crate::program::{good, run, text};

const SHARP: [&str; 6] = ["--classify", "after", "--kernel", "bspline", "--thickness", "0.5"];

#[test]
fn reconstructed_pictures_are_the_same_bytes_for_any_workers_and_schedule() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let views = ["render", "formula:spheres:40", "--azimuth", "30", "--size", "150x130", "-q"];
    let draw = |name: &str, more: &[&str]| {
        let stats = format!("{name}.jsonl");
        good(dir, &[&views[..], &["-o", name, "--stats", &stats], more].concat());
        let stats = std::fs::read_to_string(dir.join(stats)).unwrap();
        let stats: serde_json::Value = serde_json::from_str(&stats).unwrap();
        stats["pixels_sha256"].as_str().unwrap().to_string()
    };
    let sharp = |name: &str, more: &[&str]| draw(name, &[&SHARP[..], more].concat());
    let one = sharp("one.png", &["--workers", "1", "--threads", "1", "--tile", "128"]);
    let many = sharp("many.png", &["--workers", "3", "--tile", "16"]);
    let slabs = sharp("slabs.png", &["--schedule", "slab", "--slabs", "5", "--workers", "2"]);
    assert_eq!((&many, &slabs), (&one, &one));
    assert_ne!(one, draw("before.png", &["--classify", "before"]), "it is another picture");
}

#[test]
fn reconstructed_pictures_are_within_one_255th_of_their_limit() {
    let dir = tempfile::tempdir().unwrap();
    let what = ["lab", "error", "formula:spheres:48", "--azimuth", "30", "--size", "160x160"];
    let said = good(dir.path(), &[&what[..], &SHARP, &["--pixels", "900", "--json"]].concat());
    let json: serde_json::Value = serde_json::from_str(&said).unwrap();
    let rmse = |source: &str| json[source]["rmse"].as_f64().unwrap_or_else(|| panic!("{json}"));
    assert!(rmse("limit") > 0.0 && rmse("limit") < 1.0, "{json}");
    assert!(rmse("thickness") > 0.0, "{json}");
    for source in ["thickness", "cutoff", "quantisation", "ripple"] {
        assert!(rmse(source) < 1.0, "{source}: {json}");
    }
    assert!(json.get("truncation").is_none(), "an error of voxels classified before: {json}");
}

#[test]
fn what_reconstruction_does_not_take_is_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    let render = ["render", "formula:spheres:24", "--azimuth", "0", "--classify", "after"];
    let cases: [(&[&str], &str); 3] = [
        (&["--thickness", "2"], "--thickness: 2 is too thick"),
        (&["--compositing", "paper"], "--compositing: is a rule for voxels"),
        (&["--sums", "f32"], "--sums: `--classify after` adds whole numbers"),
    ];
    for (more, said) in cases {
        let out = run(dir.path(), &[&render[..], more].concat());
        assert_eq!(out.status.code(), Some(2), "{more:?}");
        assert!(text(&out.stderr).contains(said), "{more:?}: {}", text(&out.stderr));
    }
}

#[test]
fn pixels_of_a_field_are_explained_plane_by_plane() {
    let dir = tempfile::tempdir().unwrap();
    let scene = ["formula:spheres:24", "--size", "48x48", "--azimuth", "30"];
    let explain =
        |more: &[&str]| good(dir.path(), &[&["lab", "explain"], &scene[..], more].concat());
    let json: serde_json::Value =
        serde_json::from_str(&explain(&["--pixel", "24,24", "--json"])).unwrap();
    let planes = json["planes"].as_array().unwrap();
    assert!(planes.len() > 2, "{json}");
    for plane in planes {
        assert!(plane["voxels"].as_array().unwrap().len() <= 3, "{plane}");
    }
    let last = planes.last().unwrap()["t"].as_f64().unwrap();
    assert!((1.0 - last - json["rgba"][3].as_f64().unwrap()).abs() < 1e-6, "{json}");
    assert!(json["error"]["limit"].as_f64().unwrap() < 5.0, "{json}");
    let said = explain(&["--pixel", "24,24"]);
    for part in ["pixel 24,24 of 48x48", "gradient", "of brick", "limit  "] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(explain(&["--pixel", "0,0"]).contains("no voxel reaches this pixel"));
    for show in ["depth", "work", "sheets"] {
        let draw = [&["render"], &scene[..], &["--show", show, "-o", show]].concat();
        good(dir.path(), &draw);
    }
}
