//! Rules of the house that a compiler does not keep.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("the workspace")
}

/// The crates and what each may see (ARCHITECTURE.md). A new arrow is rare and argued for.
const ARROWS: [(&str, &[&str]); 11] = [
    ("common", &[]),
    ("common/trace", &["common"]),
    ("proto", &["common"]),
    ("worker/render", &["common"]),
    ("master/schedule", &["common"]),
    ("master/sim", &["common", "schedule", "trace"]),
    ("master/volumes", &["common"]),
    ("worker", &["common", "proto", "render", "trace"]),
    ("master", &["common", "proto", "schedule", "volumes"]),
    ("client", &["common", "proto"]),
    (
        "client/cli",
        &[
            "client", "common", "master", "proto", "render", "schedule", "sim", "trace", "volumes",
            "worker",
        ],
    ),
];

/// Crates that only the three libraries with a network, and the program, may use.
const NETWORKED: [&str; 3] = ["tokio", "tonic", "hyper"];

fn dependencies(manifest: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(manifest).expect("a manifest");
    let (mut inside, mut names) = (false, Vec::new());
    for line in text.lines() {
        if let Some(section) = line.trim().strip_prefix('[') {
            inside = section.contains("dependencies]");
        } else if inside && let Some((name, _)) = line.split_once('=') {
            names.push(name.trim().trim_end_matches(".workspace").to_string());
        }
    }
    names
}

#[test]
fn arrows_between_rooms_are_those_of_the_map() {
    for (room, may_see) in ARROWS {
        let names = dependencies(&root().join(room).join("Cargo.toml"));
        for name in &names {
            let Some(other) = name.strip_prefix("slabcast-") else { continue };
            assert!(
                may_see.contains(&other),
                "{room} sees {other}: a new arrow between rooms. If it is argued for, add it to \
                 ARCHITECTURE.md and here"
            );
        }
        if !["worker", "master", "client", "client/cli", "proto"].contains(&room) {
            for banned in NETWORKED {
                assert!(
                    !names.iter().any(|n| n == banned),
                    "{room} decides and never talks; {banned} belongs to its driver"
                );
            }
        }
    }
}

fn sources(dir: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|e| e == "rs") {
            into.push(path);
        }
    }
}

/// Words that do not belong into a deciding crate, and why.
#[test]
fn deciding_crates_have_no_clock_thread_or_unordered_map() {
    let banned: [(&str, &str); 5] = [
        ("Instant::now", "time comes in as an argument"),
        ("SystemTime", "time comes in as an argument"),
        ("std::thread", "whoever calls it has threads"),
        ("HashMap", "its order is not the same twice; use BTreeMap"),
        ("HashSet", "its order is not the same twice; use BTreeSet"),
    ];
    for room in ["common", "common/trace", "worker/render", "master/schedule", "master/sim"] {
        let mut files = Vec::new();
        sources(&root().join(room).join("src"), &mut files);
        assert!(!files.is_empty());
        for file in files {
            let text = std::fs::read_to_string(&file).expect("a source");
            for (n, line) in text.lines().enumerate() {
                let code = line.split("//").next().unwrap_or("");
                for (word, why) in banned {
                    assert!(!code.contains(word), "{}:{}: {word}: {why}", file.display(), n + 1);
                }
            }
        }
    }
}

#[test]
fn unsafe_stands_behind_one_wall() {
    let mut holders = Vec::new();
    for (room, _) in ARROWS {
        let mut files = Vec::new();
        sources(&root().join(room).join("src"), &mut files);
        for file in files {
            let text = std::fs::read_to_string(&file).expect("a source");
            let code = text.lines().filter(|l| !l.trim_start().starts_with("//"));
            if code.into_iter().any(|l| l.contains("unsafe ") || l.contains("unsafe{")) {
                holders.push(file.strip_prefix(root()).expect("inside").to_path_buf());
            }
        }
    }
    holders.sort();
    holders.dedup();
    let outside: Vec<_> =
        holders.iter().filter(|f| !f.starts_with("worker/render/src/kernels")).collect();
    assert!(
        outside.is_empty() && !holders.is_empty(),
        "only worker/render/src/kernels/ may hold `unsafe`, not {outside:?}; use a safe way or argue \
         for the wall"
    );
}

/// Golden frames: one line a frame, each name once, each a SHA-256.
#[test]
fn golden_lines_are_well_formed() {
    let text = std::fs::read_to_string(root().join("tests/golden.txt")).expect("golden frames");
    let mut names = BTreeMap::new();
    for line in text.lines().filter(|l| !l.is_empty() && !l.starts_with('#')) {
        let (name, hash) = line.rsplit_once(' ').expect("NAME SHA256");
        assert!(hash.len() == 64 && hash.bytes().all(|b| b.is_ascii_hexdigit()), "{line}");
        assert!(names.insert(name.trim(), hash).is_none(), "{name} stands twice");
    }
    assert!(names.len() >= 8, "only {} golden frames", names.len());
}
