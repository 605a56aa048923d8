//! Pixels are exact: golden frames, and one hash whatever the cluster looks like. In one program
//! with [`extremes`], since each has a long test that leaves a processor free now and then.

mod extremes;

use std::process::Command;

fn check(arguments: &[&str]) {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .current_dir(root)
        .args(["lab", "check"])
        .args(arguments)
        .output()
        .expect("slabcast runs");
    let text = String::from_utf8_lossy(&out.stdout);
    println!("{text}");
    assert!(out.status.success(), "{text}\n{}", String::from_utf8_lossy(&out.stderr));
}

/// A failure here means other pixels than every other build draws. If that is meant, raise
/// `PIXELS_VERSION`, make the file anew and say why in CHANGELOG.md.
#[test]
fn golden_frames_have_their_hashes() {
    check(&["golden", "--verify", "tests/golden.txt"]);
}

/// Every pair of workers, tile size, slabs, threads, culling and link; `slabcast lab check matrix`
/// runs all combinations.
#[test]
fn every_cluster_gives_the_serial_pixels() {
    check(&["matrix", "--pairwise", "--size", "100x76"]);
}
