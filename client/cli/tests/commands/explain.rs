//! `slabcast lab explain` as a user runs it.

use std::process::{Command, Output};

fn run(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .args(["lab", "explain"])
        .args(arguments)
        .output()
        .expect("slabcast runs")
}

#[test]
fn explain_pixel_as_json_lists_sheets_that_composite_to_it() {
    for arguments in [&["--projection", "persp"][..], &["--thickness", "0.5", "--eps", "0"]] {
        let mut line = vec!["formula:spheres:32", "--size", "64x64", "--pixel", "30,32"];
        line.extend(["--classify", "before", "--json", "--voxels", "2"].iter().chain(arguments));
        let out = run(&line);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let e: serde_json::Value = serde_json::from_slice(&out.stdout).expect("JSON");
        assert_eq!(e["pixel"], serde_json::json!([30, 32]));
        assert_eq!(e["shut_in"].is_null(), arguments.contains(&"0"));
        let sheets = e["sheets"].as_array().expect("sheets");
        assert!(sheets.len() > 2, "{e}");
        for c in 0..3 {
            let light: f64 = sheets.iter().map(|s| s["light"][c].as_f64().unwrap()).sum();
            assert!((light - e["rgba"][c].as_f64().unwrap()).abs() < 1e-6, "{e}");
        }
        let t = sheets.last().unwrap()["t"].as_f64().unwrap();
        assert!((1.0 - t - e["rgba"][3].as_f64().unwrap()).abs() < 1e-6);
        for s in sheets {
            let off = s["t"].as_f64().unwrap() - s["reference"]["t"].as_f64().unwrap();
            assert!(off.abs() < 0.01, "f64 sheets are near: {s}");
            assert!((1..=2).contains(&s["voxels"].as_array().unwrap().len()), "{s}");
        }
        // One for thickness 1 and a cut-off of 1/512; the rest is a matter of `error`.
        assert!(e["error"]["limit"].as_f64().unwrap() < 5.0, "{e}");
    }
}

#[test]
fn explain_pixel_as_text_says_where_it_was_shut_and_its_limit() {
    let scene = ["formula:spheres:32", "--size", "64x64", "--classify", "before"];
    let out = run(&[&scene[..], &["--pixel", "32,32"]].concat());
    let text = String::from_utf8_lossy(&out.stdout);
    for part in ["pixel 32,32 of 64x64", "shut in sheet", "of brick", "T in f64", "limit  "] {
        assert!(text.contains(part), "{part}: {text}");
    }
    let out = run(&[&scene[..], &["--pixel", "0,0"]].concat());
    assert!(out.status.success());
    assert!(String::from_utf8_lossy(&out.stdout).contains("no voxel reaches this pixel"));
}

#[test]
fn explain_refuses_pixels_outside_and_unsupported_flags() {
    for (arguments, want) in [
        (&["no-such-file.nrrd", "--pixel", "512,0"][..], "which has 512x512 pixels"),
        (&["formula:spheres", "--pixel", "3"], "X,Y"),
    ] {
        let out = run(arguments);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(2), "{said}");
        assert!(said.contains(want), "{said}");
    }
}

#[test]
fn ablation_of_unneeded_brick_content_changes_no_pixel() {
    for (scene, left_out, needed) in [
        (
            &["--tf", "fog"][..],
            &["empty", "normals", "gradients", "scale", "alpha"][..],
            &["hidden"][..],
        ),
        (
            &["--tf", "skin", "--projection", "persp", "--background", "transparent"],
            &["empty", "gradients", "hidden"],
            &["normals", "scale", "alpha"],
        ),
    ] {
        let line = [&["formula:spheres:40", "--size", "80x80", "--json"], scene].concat();
        let out = run(&line);
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let e: serde_json::Value = serde_json::from_slice(&out.stdout).expect("JSON");
        let row = |name: &str| {
            let mut rows = e["rows"].as_array().unwrap().iter();
            rows.find(|r| r["name"] == name).unwrap_or_else(|| panic!("{name}: {e}"))
        };
        for name in left_out {
            assert_eq!(row(name)["left_out"], true, "{name}: {e}");
        }
        for name in needed {
            assert_eq!(row(name)["left_out"], false, "{name}: {e}");
        }
        for name in ["empty", "gradients", "hidden"] {
            assert_eq!(row(name)["same_pixels"], true, "{name}: {e}");
        }
        assert!(row("empty")["saved_bytes"].as_u64().unwrap() > e["bytes"].as_u64().unwrap() / 4);
    }
}

/// `--keep NAME` turns an optimisation off at the master and its workers: a frame's statistics
/// don't list it under `left_out`, and the picture stays the same.
#[test]
fn keep_flag_is_not_reported_as_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let frame = |keep: &[&str]| -> serde_json::Value {
        let line = ["render", "formula:spheres:40", "--tf", "grey", "--azimuth", "30"];
        let rest = [
            "--classify",
            "before",
            "--size",
            "80x80",
            "--stats",
            "s.jsonl",
            "--force",
            "-o",
            "a.png",
        ];
        let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
            .args(line)
            .args(rest)
            .args(keep)
            .current_dir(dir.path())
            .output()
            .expect("slabcast runs");
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        let text = std::fs::read_to_string(dir.path().join("s.jsonl")).unwrap();
        serde_json::from_str(&text).expect("JSON")
    };
    let names = |frame: &serde_json::Value| -> Vec<String> {
        let list = frame["left_out"].as_array().unwrap();
        list.iter().map(|l| l["name"].as_str().unwrap().to_string()).collect()
    };
    let (lean, full) = (frame(&[]), frame(&["--keep", "empty,normals,gradients"]));
    assert_eq!(lean["pixels_sha256"], full["pixels_sha256"]);
    let (lean, full) = (names(&lean), names(&full));
    for name in ["empty", "normals", "gradients"] {
        assert!(
            lean.iter().any(|n| n == name) && !full.iter().any(|n| n == name),
            "{lean:?} {full:?}"
        );
    }
    assert!(full.iter().any(|n| n == "alpha"));
}
