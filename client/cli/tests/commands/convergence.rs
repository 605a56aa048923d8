//! `slabcast lab check convergence` as a user runs it.

use std::process::Command;

#[test]
fn convergence_prints_orders_and_writes_figures() {
    let dir = tempfile::tempdir().expect("a folder");
    let tf = dir.path().join("ramp.json");
    let look = r#"{"version":1,"domain":"unit","color_space":"linear","opacity_unit":"extinction",
        "colors":[[0,0,0.2,1],[1,1,0.8,0]],"opacities":[[0,0],[1,0.5]],"shading":{"on":false}}"#;
    std::fs::write(&tf, look).expect("a file");
    // Pixels that are judged; the figures want more than the words.
    let run = |order: &str, pixels: &str, more: &[&str]| {
        let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
            .args(["lab", "check", "convergence", "formula:ramp:12", "--size", "48x48", "--tf"])
            .arg(&tf)
            .args(["--azimuth", "25", "--elevation", "20", "--pixels", pixels, "--thinnest", "4"])
            .args(["--classify", order])
            .args(more)
            .output()
            .expect("slabcast runs");
        assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
        String::from_utf8(out.stdout).expect("text")
    };
    let plots = dir.path().join("plots");
    let lines = run("before", "128", &["--json", "--plot", plots.to_str().expect("a name")]);
    let sweeps: Vec<serde_json::Value> =
        lines.lines().map(|l| serde_json::from_str(l).expect("JSON")).collect();
    assert_eq!(sweeps.len(), 2, "both projections");
    let rmse = |sweep: usize, rung: usize, of: &str| {
        sweeps[sweep]["rungs"][rung][of]["rmse"].as_f64().expect("a figure")
    };
    // From 2 vox to 1/4.
    assert_eq!(sweeps[0]["rungs"].as_array().expect("rungs").len(), 4);
    let order = |sweep, rung, of| libm::log2(rmse(sweep, rung, of) / rmse(sweep, rung + 1, of));
    for sweep in 0..2 {
        for rung in 0..3 {
            let first = order(sweep, rung, "paper_f64");
            assert!((0.9..1.1).contains(&first), "the paper's sums are of first order: {first}");
        }
        // Rounded positions hide more than they show below that in so small a picture.
        assert!((1.7..2.3).contains(&order(sweep, 1, "constant_f64")));
        // The error of a rendered picture is the sum of thickness and roundings, and nothing else.
        let parts: f64 =
            ["linear_f64", "positions", "f32", "integers"].iter().map(|p| rmse(sweep, 1, p)).sum();
        assert!(rmse(sweep, 1, "linear") <= 1.001 * parts, "{parts}");
    }
    assert!(order(0, 1, "linear_f64") > 2.5 && order(0, 2, "linear_f64") > 2.8);
    let svg = std::fs::read_to_string(plots.join("ramp-12.svg")).expect("a figure");
    assert!(svg.starts_with("<svg") && svg.contains("perspective") && svg.len() < 60 << 10);

    let text = run("before", "32", &["--placement"]);
    for word in ["ortho", "persp", "order", "along the ray", "the paper's form goes to a limit"] {
        assert!(text.contains(word), "{word}: {text}");
    }

    // Both orders of classification have a sweep; fields begin at one vox.
    let lines = run("after", "128", &["--json"]);
    for line in lines.lines() {
        let sweep: serde_json::Value = serde_json::from_str(line).expect("JSON");
        let rmse = |i: usize| sweep["figures"][i]["rmse"].as_f64().expect("a figure");
        assert_eq!(sweep["figures"].as_array().expect("figures").len(), 3, "1, 1/2 and 1/4 vox");
        assert!(rmse(2) < rmse(0) && rmse(2) < 0.3, "{line}");
    }
    assert_eq!(lines.lines().count(), 2, "both projections");
    assert!(run("after", "32", &[]).contains("i16"));
}
