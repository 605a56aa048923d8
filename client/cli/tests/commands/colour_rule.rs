//! `slabcast lab check colour-rule` as a user runs it.

use std::process::{Command, Output};

fn colour_rule(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .args(["lab", "check", "colour-rule", "formula:spheres:24", "--tf", "peer-opaque"])
        .args([
            "--size",
            "56x48",
            "--pixels",
            "700",
            "--steps",
            "4",
            "--eps",
            "0",
            "--azimuth",
            "35",
        ])
        .args(arguments)
        .output()
        .expect("slabcast runs")
}

#[test]
fn linear_compositing_has_smaller_error_and_paper_compositing_its_own_limit() {
    let out = colour_rule(&["--json"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let text = String::from_utf8(out.stdout).expect("text");
    let lines: Vec<serde_json::Value> =
        text.lines().map(|l| serde_json::from_str(l).expect("JSON")).collect();
    assert_eq!(lines.len(), 12);
    let at = |rule: &str, thickness: f64| {
        let found = lines.iter().find(|l| l["rule"] == rule && l["thickness"] == thickness);
        found.unwrap_or_else(|| panic!("{rule} at {thickness}"))
    };
    let rmse = |l: &serde_json::Value, limit: &str| l[limit]["rmse"].as_f64().expect("a figure");
    for d in [2.0, 1.0, 0.5, 0.25] {
        // Both have the same opacities: what differs is colour.
        let (linear, constant) = (at("linear", d), at("constant", d));
        assert!(rmse(linear, "limit") < rmse(constant, "limit"), "{linear} {constant}");
        let paper = at("paper", d);
        assert!(rmse(paper, "own_limit") < 0.5 * rmse(paper, "limit"), "{paper}");
        assert!(linear["own_limit"].is_null() && linear["ms"].is_null());
    }
    // Nothing is shut, so sheets half as thick move less of the picture.
    let pop = |d| at("linear", d)["pop"].as_f64().expect("a figure");
    assert!(pop(0.5) < 0.5 * pop(1.0) && pop(1.0) < 0.5 * pop(2.0));
}

#[test]
fn colour_rule_refuses_flags_that_it_sweeps() {
    for flag in ["--thickness=2", "--compositing=paper", "--steps=3"] {
        let out = colour_rule(&[flag]);
        assert_eq!(out.status.code(), Some(2), "{flag}");
        let said = String::from_utf8_lossy(&out.stderr);
        let name = flag.split('=').next().expect("a name");
        assert!(said.contains(name), "{flag} says: {said}");
    }
}
