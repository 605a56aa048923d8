//! `slabcast error` as a user runs it: figures that make sense of each other.

use std::process::Command;

fn error(arguments: &[&str]) -> serde_json::Value {
    let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .args(["error", "formula:spheres:32", "--size", "96x80", "--pixels", "1500", "--json"])
        .args(arguments)
        .output()
        .expect("slabcast runs");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    serde_json::from_slice(&out.stdout).expect("JSON")
}

fn rmse(figures: &serde_json::Value, source: &str) -> f64 {
    figures[source]["rmse"].as_f64().expect("a figure")
}

#[test]
fn sources_add_up_to_the_whole_and_the_cutoff_keeps_its_bound() {
    let f = error(&[]);
    let whole = rmse(&f, "limit");
    assert!(whole > 0.0 && whole < 2.0, "{whole}/255");
    let squares: f64 = ["thickness", "cutoff", "quantisation", "rounding"]
        .iter()
        .map(|s| rmse(&f, s) * rmse(&f, s))
        .sum();
    let together = squares.sqrt();
    assert!((together / whole - 1.0).abs() < 0.3, "{together} of {whole}");
    let bound = 255.0 / 512.0;
    let cutoff = f["cutoff"]["max"].as_f64().unwrap();
    assert!(cutoff > 0.0 && cutoff <= bound, "{cutoff} of {bound}");
    let quantisation = f["quantisation"]["max"].as_f64().unwrap();
    assert!(quantisation < 0.01, "{quantisation}");
}

#[test]
fn thinner_sheets_are_nearer_and_the_papers_are_elsewhere() {
    let at = |thickness: &str, rule: &str| {
        rmse(&error(&["--thickness", thickness, "--compositing", rule]), "thickness")
    };
    let (coarse, fine) = (at("1", "linear"), at("0.25", "linear"));
    assert!(fine * 8.0 < coarse, "{fine} and {coarse}");
    let constant = at("1", "constant");
    assert!(coarse * 2.0 < constant, "{coarse} and {constant}");
    let paper = at("1", "paper");
    assert!(paper > 3.0 * constant, "{paper} and {constant}");
}
