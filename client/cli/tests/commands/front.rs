//! `slabcast lab report`, `--error` and `--budget` as a user runs them: figures that are what they
//! say, words that are kept.

use crate::program::{Process, master, slabcast};
use serde_json::Value;
use std::path::Path;
use std::process::Output;

fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).expect("a file")).expect("JSON")
}

/// Runs the program with its measurements kept in `dir`.
fn run(dir: &Path, words: &[&[&str]]) -> Output {
    let mut command = slabcast(dir, &words.concat());
    command.env("SLABCAST_CACHE", dir.join("cache")).output().expect("the program starts")
}

const SCENE: [&str; 5] = ["formula:spheres:40", "--tf", "skin", "--size", "96x96"];

#[test]
fn report_writes_all_files_and_marks_front_and_default() {
    let dir = tempfile::tempdir().unwrap();
    let only =
        ["--only", "thickness,eps,sums,shading,work", "--pixels", "900", "--seconds", "0.01"];
    let order = ["--classify", "before", "-o", "r"];
    let out = run(dir.path(), &[&["lab", "report"], &SCENE, &only, &order]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let said = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(said.contains("all the same picture, to the bit"), "{said}");
    let folder = dir.path().join("r");
    let report = json(&folder.join("report.json"));
    let settings = report["settings"].as_array().unwrap();
    assert_eq!(report["complete"], true);
    let error = |s: &Value| s["error"]["rmse"].as_f64().unwrap();
    let ms = |s: &Value| s["ms"]["all"]["median"].as_f64().unwrap();
    let named = |name: &str| {
        settings.iter().find(|s| s["name"] == name).unwrap_or_else(|| panic!("{name}"))
    };
    assert!(error(named("thickness 2")) > 2.0 * error(named("thickness 0.5")));
    assert!(error(named("eps 1/16")) > 2.0 * error(named("eps 1/1024")));
    assert!(
        error(named("unshaded")) > 5.0
            && named("unshaded")["own_error"]["rmse"].as_f64().unwrap() < 1.0
    );
    assert!(named("unshaded")["bytes"].as_u64() < named("as asked")["bytes"].as_u64());
    assert_eq!(settings.iter().filter(|s| s["default"] == true).count(), 1);
    // Nothing of quality is faster and nearer than a point of the front.
    let quality = || settings.iter().filter(|s| s["group"] != "work");
    assert!(quality().any(|s| s["front"] == true));
    for point in quality().filter(|s| s["front"] == true) {
        let beaten = quality().any(|s| ms(s) < ms(point) && error(s) < error(point));
        assert!(!beaten, "{}", point["name"]);
    }
    let csv = std::fs::read_to_string(folder.join("report.csv")).unwrap();
    assert_eq!(csv.lines().count(), settings.len() + 1);
    let columns = csv.lines().next().unwrap().split(',').count();
    for line in csv.lines().skip(1) {
        let name = line.split('"').nth(1).unwrap();
        assert_eq!(line.replace(name, "").split(',').count(), columns, "{line}");
    }
    for name in ["report", "report-dark"] {
        let svg = std::fs::read_to_string(folder.join(name).with_extension("svg")).unwrap();
        assert!(svg.contains("as asked") && svg.contains("knee") && !svg.contains("NaN"));
        let png = std::fs::read(folder.join(name).with_extension("png")).unwrap();
        let info = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
        assert_eq!((info.info().width, info.info().height), (2160, 1400));
    }
    // Existing files stay, unless --force is given.
    let again = run(dir.path(), &[&["lab", "report"], &SCENE, &only, &["-o", "r"]]);
    assert_eq!(again.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&again.stderr).contains("--force"));
}

/// Draws with flags and says what it came to: (RMSE, 99.9 %, quality, magnified, notes).
fn bench(dir: &Path, flags: &[&str]) -> (f64, f64, Value, u64, String) {
    let how = ["--frames", "3", "--seed", "7", "--pixels", "9216", "--json"];
    let out = run(dir, &[&["lab", "bench"], &SCENE, &how, flags]);
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(out.status.success(), "{said}");
    let b: Value = serde_json::from_slice(&out.stdout).unwrap();
    let limit = |what: &str| b["limit"][what].as_f64().unwrap();
    (limit("rmse"), limit("most_999"), b["quality"].clone(), b["magnify"].as_u64().unwrap(), said)
}

#[test]
fn error_target_is_kept_and_measurements_are_cached() {
    let dir = tempfile::tempdir().unwrap();
    let (loose, _, coarse, _, said) = bench(dir.path(), &["--error", "2/255"]);
    assert!(loose <= 2.0 && said.contains("measured first"), "{loose}: {said}");
    let (tight, _, fine, _, _) = bench(dir.path(), &["--error", "0.2/255"]);
    assert!(tight <= 0.2, "{tight}");
    let eps = |q: &Value| q["eps"].as_f64().unwrap();
    assert!(coarse != fine && eps(&fine) <= eps(&coarse), "{coarse} {fine}");
    let (_, most, ..) = bench(dir.path(), &["--error-max", "3/255"]);
    assert!(most <= 3.0, "{most}");
    let (again, _, same, _, said) = bench(dir.path(), &["--error", "2/255"]);
    assert_eq!((again, same), (loose, coarse));
    assert!(said.contains("as measured before"), "{said}");
}

#[test]
fn unreachable_quality_target_is_refused_with_a_reachable_one() {
    let dir = tempfile::tempdir().unwrap();
    for (flags, says) in [
        (["--error", "1e-9"], "--error: no setting comes so near"),
        (["--budget", "0.001ms"], "--budget: the fastest setting"),
    ] {
        let out = run(dir.path(), &[&["render"], &SCENE, &["--azimuth", "0"], &flags]);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(2), "{said}");
        assert!(said.contains(says) && said.contains("or more"), "{said}");
    }
    assert!(!dir.path().join("slabcast-out").exists());
}

/// A picture that was drawn small says so, is as large as was asked for, and can be made again.
#[test]
fn magnified_picture_is_rerendered_byte_by_byte() {
    let dir = tempfile::tempdir().unwrap();
    // Figures by which only a picture of half the size is fast enough.
    let cache = dir.path().join("cache");
    let render =
        |rest: &[&str]| run(dir.path(), &[&["render"], &SCENE, &["--azimuth", "10"], rest]);
    let out = render(&["--budget", "10s", "-o", "full.png"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let kept = std::fs::read_dir(cache.join("fronts")).unwrap().next().unwrap().unwrap().path();
    let mut file = json(&kept);
    for entry in file["entries"].as_array_mut().unwrap() {
        let shrink = entry["setting"]["shrink"].as_u64().unwrap();
        entry["ms"] = (if shrink == 2 { 10.0 } else { 1000.0 }).into();
        entry["off"] = serde_json::json!({"rmse": 1.0 / entry["setting"]["quality"]["eps"].as_f64().unwrap(),
            "max": 9.0, "most_999": 9.0, "share_above_1": 0.5, "rmse_srgb8": 9.0, "pixels": 99});
    }
    std::fs::write(&kept, file.to_string()).unwrap();
    let out = render(&["--budget", "20ms", "-o", "half.png"]);
    let said = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(out.status.success() && said.contains("drawn at 48x48"), "{said}");
    let png = std::fs::read(dir.path().join("half.png")).unwrap();
    let info = png::Decoder::new(std::io::Cursor::new(&png)).read_info().unwrap();
    assert_eq!((info.info().width, info.info().height), (96, 96));
    let out = run(dir.path(), &[&["rerender", "half.png", SCENE[0], "-o", "again.png"]]);
    let said = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(out.status.success() && said.contains("the same"), "{said}");
}

/// The volume is at the master: errors are found by comparing its pictures.
#[test]
#[ignore = "takes half a minute; tests/nightly.sh runs it"]
fn error_target_is_kept_on_a_cluster() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let (_master, address) = master(dir, SCENE[0], &[]);
    let worker = ["worker", "--master", &address, "--threads", "1", "--log-level", "error"];
    let _worker = Process(slabcast(dir, &worker).spawn().unwrap());
    let render = |rest: &[&str]| {
        let how =
            ["render", "--master", &address, "--frames", "2", "--force", "--stats", "s.jsonl"];
        let out = run(dir, &[&how, &SCENE[1..], rest]);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.success(), "{said}");
        let stats = std::fs::read_to_string(dir.join("s.jsonl")).unwrap();
        let first: Value = serde_json::from_str(stats.lines().next().unwrap()).unwrap();
        (first["quality"].clone(), said)
    };
    for asked in [2.0, 0.3] {
        let (quality, said) = render(&["--error", &format!("{asked}/255")]);
        assert!(said.contains("RMSE"), "{said}");
        // Judged where the volume is.
        let flags = [("--thickness", "thickness"), ("--eps", "eps")]
            .map(|(flag, name)| [flag.to_string(), quality[name].to_string()]);
        let sums = quality["sums"].as_str().unwrap();
        let words = [flags.as_flattened(), &["--sums".into(), sums.into()]].concat();
        let (rmse, ..) = bench(dir, &words.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(rmse <= asked, "{rmse} of {asked}: {said}");
    }
    let (_, said) = render(&["--error", "2/255"]);
    assert!(!said.contains("measured first"), "errors are kept, times are not: {said}");
    let (quality, said) = render(&["--budget", "100s"]);
    assert!(said.contains("ms a frame"), "{said}");
    assert!(quality["thickness"].as_f64().unwrap() <= 0.25, "all the time in the world: {quality}");
}

/// A frame's statistics estimate the RMSE of each error source within a factor of two of the f64
/// reference's, and no pixel is off by more than their bounds.
#[test]
fn statistics_contain_error_estimates_by_source() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let sources =
        [("thickness", "thickness"), ("rounding", "rounding_positions"), ("ripple", "ripple")];
    let (mut near, mut all, mut bounded) = ([0; 3], 0, 0);
    for (volume, tf, thickness) in
        [("formula:spheres:48", "skin", "1"), ("formula:spheres:48", "fog", "2")]
    {
        let scene = [volume, "--tf", tf, "--thickness", thickness, "--size", "256x256"];
        // The bound of 16-bit sums, which `auto` takes for fog, says nothing.
        let scene = [&scene[..], &["--sums", "i32"]].concat();
        // A frame of a turn and the same azimuth alone have another framing each.
        let scene = [&scene[..], &["--fit", "volume", "--classify", "before"]].concat();
        let draw = |out: &str, more: &[&str]| {
            let how = ["--start", "33", "--step", "77", "--frames", "2", "-o", out];
            let done = run(dir, &[&["render"], &scene, &how, more]);
            assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
            std::fs::read(dir.join(out).join("frame_0001.png")).unwrap()
        };
        let out = format!("{tf}{thickness}");
        let with = draw(&out, &["--stats", "s.jsonl"]);
        let without = draw(&format!("{out}-plain"), &[]);
        assert!(with == without, "an estimate changes no byte");
        let stats = std::fs::read_to_string(dir.join("s.jsonl")).unwrap();
        for (line, azimuth) in stats.lines().zip(["33", "110"]) {
            let stats: Value = serde_json::from_str(line).unwrap();
            let said = &stats["error"];
            let how = ["--azimuth", azimuth, "--model-pixels", "1024", "--json"];
            let judged = run(dir, &[&["lab", "error"], &scene, &how]);
            let judged: Value = serde_json::from_slice(&judged.stdout).unwrap();
            all += 1;
            for (near, (name, found)) in near.iter_mut().zip(sources) {
                let estimate = said[name]["estimate"].as_f64().unwrap();
                let truth = judged[found]["rmse"].as_f64().unwrap();
                *near += usize::from(estimate < 2.0 * truth && truth < 2.0 * estimate);
                println!("{tf} {thickness} {azimuth} {name}: {estimate} of {truth}");
            }
            let edges = said["truncation"]["estimate"].as_f64();
            assert!(if tf == "fog" { edges > Some(0.0) } else { edges.is_none() }, "{said}");
            for (name, found) in [
                ("cutoff", "cutoff"),
                ("quantisation", "quantisation"),
                ("rounding", "rounding_positions"),
                ("truncation", "truncation"),
            ] {
                let Some(bound) = said[name]["bound"].as_f64() else { continue };
                let found = judged[found]["max"].as_f64().unwrap();
                println!("{tf} {thickness} {azimuth} {name}: {found} of at most {bound}");
                // The integers' error is measured with floats, which round, too.
                assert!(found <= bound + 1e-4, "{name}: {found} of at most {bound}");
                bounded += 1;
            }
        }
        draw(&format!("{out}-slab"), &["--stats", "s.jsonl", "--schedule", "slab"]);
        let stats = std::fs::read_to_string(dir.join("s.jsonl")).unwrap();
        let stats: Value = serde_json::from_str(stats.lines().next().unwrap()).unwrap();
        for (name, _) in sources {
            assert!(stats["error"][name]["estimate"].is_null(), "never a number of nothing");
        }
    }
    // Rounded positions show at edges, of which few are looked at in so small a picture.
    let [thickness, rounding, ripple] = near;
    assert_eq!((thickness, ripple, all), (4, 4, 4), "of four frames within a factor of two");
    assert!(rounding >= 3, "{rounding} of four frames within a factor of two");
    assert!(bounded >= 12, "fog has all four, an opaque skin two: {bounded}");
}
