//! Promises of docs/reference/transfer-functions.md, held by the program itself: its example files
//! are drawn, names and ranges mean what they say, files for ParaView come back.

use crate::program::{run, slabcast};
use slabcast_common::stats::FrameStats;
use std::path::{Path, PathBuf};

fn example(name: &str) -> String {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples").join(name);
    path.canonicalize().expect("an example of the docs").display().to_string()
}

fn draw(dir: &Path, args: &[&str]) -> Vec<FrameStats> {
    let all =
        [&["render", "formula:spheres:24", "-q", "--force", "--stats", "-"][..], args].concat();
    let out = run(dir, &all);
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success(), "{args:?}: {said}");
    let text = String::from_utf8(out.stdout).expect("JSON");
    text.lines().map(|l| serde_json::from_str(l).expect("a line of statistics")).collect()
}

fn hashes(frames: &[FrameStats]) -> Vec<&str> {
    frames.iter().map(|f| f.pixels_sha256.as_str()).collect()
}

#[test]
fn every_example_file_of_the_docs_is_rendered() {
    let dir = tempfile::tempdir().unwrap();
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/examples");
    let mut files: Vec<PathBuf> =
        std::fs::read_dir(folder).expect("examples").map(|e| e.unwrap().path()).collect();
    files.sort();
    assert!(files.len() >= 6);
    for file in files {
        let text = std::fs::read_to_string(&file).unwrap();
        let name = file.display().to_string();
        let small = ["--size", "40x30"];
        let path = ["--path", &name, "--frames", "0..2"];
        let tf = ["--tf", &name, "--frames", "1"];
        let args = if text.contains("\"size\"") { &path[..] } else { &tf[..] };
        let frames = draw(dir.path(), &[args, &small].concat());
        // Example cameras are for a head; whether they meet small spheres does not matter.
        assert!(!frames.is_empty(), "{name}");
        if args[0] == "--tf" {
            assert!(frames[0].voxels.splatted > 0, "{name} shows nothing");
        }
    }
}

#[test]
fn a_range_of_frames_keeps_its_numbers_and_bytes() {
    let dir = tempfile::tempdir().unwrap();
    for path in [&["--start", "10", "--step", "20"][..], &["--path", &example("keyframes.json")]] {
        let small = ["--size", "40x30"];
        let whole = draw(dir.path(), &[path, &small, &["--frames", "0..5"]].concat());
        std::fs::remove_dir_all(dir.path().join("slabcast-out")).unwrap();
        let part = draw(dir.path(), &[path, &small, &["--frames", "3..5"]].concat());
        assert_eq!(hashes(&part), hashes(&whole)[3..], "{path:?}");
        assert_eq!(part.iter().map(|f| f.frame).collect::<Vec<_>>(), [3, 4, 5]);
        let mut names: Vec<String> = std::fs::read_dir(dir.path().join("slabcast-out"))
            .unwrap()
            .map(|e| e.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        assert_eq!(names, ["frame_0003.png", "frame_0004.png", "frame_0005.png"]);
        // One frame of the middle of a path, once more from what it says of itself.
        let again = ["rerender", "slabcast-out/frame_0004.png", "formula:spheres:24", "--force"];
        let out = run(dir.path(), &again);
        let said = String::from_utf8_lossy(&out.stdout).into_owned();
        assert!(out.status.success() && said.contains("the same"), "{path:?}: {said}");
    }
}

#[test]
fn anatomical_view_equals_its_azimuth() {
    let dir = tempfile::tempdir().unwrap();
    let standing = ["--up=z", "--front=y", "--size", "40x30"];
    let by =
        |more: &[&str]| draw(dir.path(), &[&standing[..], more].concat()).remove(0).pixels_sha256;
    let mut seen = std::collections::BTreeSet::new();
    for (side, azimuth, elevation) in [
        ("anterior", "0", "0"),
        ("right", "90", "0"),
        ("posterior", "180", "0"),
        ("left", "-90", "0"),
        ("superior", "180", "90"),
        ("inferior", "0", "-90"),
    ] {
        let named = by(&["--view", side]);
        assert_eq!(named, by(&["--azimuth", azimuth, "--elevation", elevation]), "{side}");
        seen.insert(named);
    }
    assert_eq!(seen.len(), 6);
}

#[test]
fn crop_removes_voxels_outside_the_box() {
    let dir = tempfile::tempdir().unwrap();
    let one = ["--azimuth", "30", "--size", "40x30"];
    let of = |more: &[&str]| draw(dir.path(), &[&one[..], more].concat()).remove(0);
    let (whole, half) = (of(&[]), of(&["--crop", "50%:,:,:"]));
    assert!(half.voxels.relevant < whole.voxels.relevant && half.voxels.relevant > 0);
    let sent = |f: &FrameStats| f.workers.iter().map(|w| w.bytes_sent).sum::<u64>();
    assert!(sent(&half) < sent(&whole), "what is cut away is not sent");
    assert_ne!(half.view_sha256, whole.view_sha256);
    // The middle of 24 samples is at 11.5: the same box in mm.
    assert_eq!(of(&["--crop", "11.5:,:,:"]).pixels_sha256, half.pixels_sha256);
    assert_eq!(of(&["--crop", ":,:,:"]).pixels_sha256, whole.pixels_sha256);
}

/// The cluster, and this process alone, whose picture the reference then judges.
#[test]
fn gradient_opacity_has_small_error_and_same_bytes_on_clusters() {
    let dir = tempfile::tempdir().unwrap();
    let glass = example("glass.json");
    let look = ["--tf", &glass, "--azimuth", "30", "--size", "64x48", "--classify", "before"];
    let cluster = [&look[..], &["--workers", "2", "--tile", "16", "--slabs", "5"]].concat();
    let drawn = draw(dir.path(), &cluster).remove(0);
    let out =
        run(dir.path(), &[&["lab", "error", "formula:spheres:24", "--json"][..], &look].concat());
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let judged: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(judged["pixels_sha256"], serde_json::json!(drawn.pixels_sha256));
    let off = judged["same_thickness"]["rmse"].as_f64().unwrap();
    assert!(off < 0.2, "{off}/255 from the same sheets in f64");
    // Without modulation it is another picture.
    let plain = dir.path().join("plain.json");
    let text = std::fs::read_to_string(&glass).unwrap();
    let mut tf: serde_json::Value = serde_json::from_str(&text).unwrap();
    tf.as_object_mut().unwrap().remove("gradient_opacity");
    std::fs::write(&plain, tf.to_string()).unwrap();
    let plain = draw(dir.path(), &["--tf", "plain.json", "--azimuth", "30", "--size", "64x48"]);
    assert_ne!(plain[0].pixels_sha256, drawn.pixels_sha256);
}

#[test]
fn paraview_colour_map_round_trips() {
    let dir = tempfile::tempdir().unwrap();
    let small = ["--azimuth", "30", "--size", "40x30"];
    let tf = |args: &[&str]| {
        let out = run(dir.path(), &[&["tf"][..], args].concat());
        assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
        String::from_utf8(out.stdout).unwrap()
    };
    tf(&["vessels", "formula:spheres:24", "--paraview", "-o", "a.json"]);
    tf(&["a.json", "--paraview", "-o", "b.json"]);
    let read = |name: &str| std::fs::read_to_string(dir.path().join(name)).unwrap();
    assert!(read("a.json").contains("\"Name\": \"slabcast vessels\""));
    assert_eq!(read("a.json"), read("b.json"));
    let through = |tf: &str| draw(dir.path(), &[&small[..], &["--tf", tf]].concat()).remove(0);
    assert_eq!(through("a.json").pixels_sha256, through("b.json").pixels_sha256);
    assert_eq!(through("vessels").voxels.relevant, through("a.json").voxels.relevant);
    // Ours is the preset itself, but for the rounding of x.
    tf(&["vessels", "formula:spheres:24", "-o", "ours.json"]);
    assert_eq!(through("ours.json").voxels.relevant, through("vessels").voxels.relevant);
    let list = tf(&["--list"]);
    for name in ["auto", "skin", "engine", "viridis", "cool-warm", "peer-skull"] {
        assert!(list.contains(name), "{name} is not listed");
    }
}

#[test]
fn colors_light_shading_and_nan_flags_change_the_transfer_function() {
    let dir = tempfile::tempdir().unwrap();
    let of = |more: &[&str]| {
        let one = ["--azimuth", "30", "--size", "40x30"];
        draw(dir.path(), &[&one[..], more].concat()).remove(0)
    };
    let base = of(&[]);
    for flags in [
        &["--colors", "viridis"][..],
        &["--light", "1,0,1"],
        &["--light", "head"],
        &["--shading", "off"],
        &["--tf", "turbo"],
        &["--tf", "bone", "--colors", &example("paraview.json")],
    ] {
        assert_ne!(of(flags).pixels_sha256, base.pixels_sha256, "{flags:?}");
    }
    assert_eq!(of(&["--light", "key"]).pixels_sha256, base.pixels_sha256);
    // Other colours need no other bricks.
    assert_eq!(of(&["--colors", "viridis"]).voxels.relevant, base.voxels.relevant);
}

/// A blank picture says why, whichever look is asked for.
#[test]
fn blank_picture_gives_a_note_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    for (args, why) in [
        (&["formula:full:9"][..], "every value of the volume is 200"),
        (&["formula:spheres:24", "--crop", "0%:1%,0%:1%,0%:1%"], "cropping box"),
    ] {
        let all = [&["render", "--azimuth", "0", "--size", "40x30", "--force"][..], args].concat();
        let out = slabcast(dir.path(), &all).output().expect("the program starts");
        let said = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.success() && said.contains(why), "{args:?}: {said}");
    }
}
