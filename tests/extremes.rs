//! Stiff and extreme scenes keep their bounds: the table of `slabcast lab check`.

use std::collections::BTreeMap;
use std::process::Command;

/// Groups of cases that the table has at least.
const GROUPS: [&str; 1] = ["extreme"];

/// Number of cases in the group `extreme`, at least: a case that is removed is removed here too.
const EXTREMES: usize = 64;

/// Runs `group` of the table, of which every row must hold. Returns its cases with their numbers of
/// rows.
fn table(group: &str) -> BTreeMap<String, usize> {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .current_dir(root)
        .args(["lab", "check", "--json", "--group", group])
        .output()
        .expect("slabcast runs");
    let text = String::from_utf8_lossy(&out.stdout);
    println!("{text}");
    let mut cases = BTreeMap::new();
    for line in text.lines() {
        let row: serde_json::Value = serde_json::from_str(line).expect("a line of JSON a row");
        assert_eq!(row["held"], true, "{line}");
        assert_eq!(row["group"], group, "{line}");
        *cases.entry(row["case"].as_str().unwrap_or_default().to_string()).or_default() += 1;
    }
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    cases
}

#[test]
fn extreme_scenes_keep_their_bounds() {
    let cases = table("extreme");
    assert!(cases.len() >= EXTREMES, "{} cases of {EXTREMES}", cases.len());
    // One of each kind that was promised.
    for name in [
        "alpha 0",
        "alpha 1e-7",
        "alpha 1 - 1e-7",
        "alpha 1",
        "alpha 1e-6 over 10^4 voxels",
        "a step on a linear field",
        "extinction 1e-9 per vox, f32 sums",
        "extinction 1e9 per vox, f32 sums",
        "sheets of 1/64 vox",
        "sheets of 65536 vox",
        "10^6 sheets",
        "eye inside",
        "eye at a voxel",
        "along +z, up along it too",
        "fov 0.01 degrees",
        "fov 179 degrees",
        "1x1x1",
        "4096x1x1",
        "spacing 1:1:20",
        "spacing 1e-12",
        "spacing 1e12",
        "origin at 1e7 voxels",
        "a picture of 1x1",
        "one voxel over the whole picture",
        "NaN, infinities, denormals",
        "constant",
        "all opaque",
        "all empty",
        "int16 from end to end",
        "double up to 1e300",
        "1000 slabs",
        "eps 1/16 against eps 0",
    ] {
        assert!(cases.contains_key(name), "the table lacks `{name}`");
    }
}

#[test]
fn check_list_names_all_groups_and_the_long_cases() {
    let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .args(["lab", "check", "--list"])
        .output()
        .expect("slabcast runs");
    let text = String::from_utf8_lossy(&out.stdout);
    for group in GROUPS {
        assert!(text.contains(&format!("{group}: ")), "{text}");
    }
    assert!(text.contains("a picture of 8192x8192 (--long)"), "{text}");
}
