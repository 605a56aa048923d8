//! Rules of the house that a compiler does not keep.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("the workspace")
}

/// The crates and what each may see (ARCHITECTURE.md). A new arrow is rare and argued for.
///
/// `scene` is what a user asks for: presets, view paths, crops, requests. Whoever takes requests
/// sees it: the wire, the master, the brick store, the client. The renderer never does, and the
/// worker, the scheduler and the simulator in their tests alone: they get one frame's view and
/// transfer function.
const ARROWS: [(&str, &[&str]); 15] = [
    ("common", &[]),
    ("common/scene", &["common"]),
    ("common/trace", &["common"]),
    ("proto", &["common", "scene"]),
    ("worker/render", &["common"]),
    ("master/schedule", &["common"]),
    ("master/sim", &["common", "schedule", "trace"]),
    ("master/volumes", &["common", "scene"]),
    ("worker", &["common", "proto", "render", "trace"]),
    ("master", &["common", "proto", "scene", "schedule", "volumes"]),
    ("master/live", &["common", "master", "proto", "scene", "volumes"]),
    ("client", &["common", "proto", "scene"]),
    ("client/session", &["client", "common", "master", "render", "scene", "volumes", "worker"]),
    (
        "client/lab",
        &[
            "client", "common", "master", "proto", "render", "scene", "schedule", "session", "sim",
            "trace", "volumes", "worker",
        ],
    ),
    (
        "client/cli",
        &[
            "client", "common", "lab", "live", "master", "proto", "render", "scene", "schedule",
            "session", "sim", "trace", "volumes", "worker",
        ],
    ),
];

/// Arrows of tests alone.
const TEST_ARROWS: [(&str, &[&str]); 3] =
    [("master/schedule", &["scene"]), ("master/sim", &["scene"]), ("worker", &["scene"])];

/// Crates that only the libraries with a network, and the program, may use.
const NETWORKED: [&str; 3] = ["tokio", "tonic", "hyper"];

/// The dependencies of a manifest, and which of them its tests alone have.
fn dependencies(manifest: &Path) -> Vec<(String, bool)> {
    let text = std::fs::read_to_string(manifest).expect("a manifest");
    let (mut inside, mut of_tests, mut names) = (false, false, Vec::new());
    for line in text.lines() {
        if let Some(section) = line.trim().strip_prefix('[') {
            inside = section.contains("dependencies]");
            of_tests = section.contains("dev-dependencies]");
        } else if inside && let Some((name, _)) = line.split_once('=') {
            names.push((name.trim().trim_end_matches(".workspace").to_string(), of_tests));
        }
    }
    names
}

#[test]
fn arrows_between_rooms_are_those_of_the_map() {
    for (room, may_see) in ARROWS {
        let names = dependencies(&root().join(room).join("Cargo.toml"));
        for (name, of_tests) in &names {
            let Some(other) = name.strip_prefix("slabcast-") else { continue };
            let tests_may_see = TEST_ARROWS.iter().any(|(tests_of, may_see)| {
                *of_tests && *tests_of == room && may_see.contains(&other)
            });
            assert!(
                tests_may_see || may_see.contains(&other),
                "{room} sees {other}: a new arrow between rooms. If it is argued for, add it to \
                 ARCHITECTURE.md and here"
            );
        }
        if !room.starts_with("client")
            && !["worker", "master", "master/live", "proto"].contains(&room)
        {
            for banned in NETWORKED {
                assert!(
                    !names.iter().any(|(name, _)| name == banned),
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

/// Modules of a crate by their paths (`output::png`), each with its source without comments.
fn modules(room: &str) -> BTreeMap<String, String> {
    let src = root().join(room).join("src");
    let mut files = Vec::new();
    sources(&src, &mut files);
    let module = |file: &Path| {
        let inside = file.strip_prefix(&src).expect("inside").with_extension("");
        let mut words: Vec<_> = inside.iter().map(|w| w.to_string_lossy().into_owned()).collect();
        if words.last().is_some_and(|w| ["mod", "lib", "main"].contains(&w.as_str())) {
            words.pop();
        }
        words.join("::")
    };
    let text = |file: &Path| {
        let text = std::fs::read_to_string(file).expect("a source");
        let code = text.lines().map(|line| line.split("//").next().unwrap_or(""));
        code.collect::<Vec<_>>().join("\n")
    };
    files.iter().map(|file| (module(file), text(file))).collect()
}

/// Paths that code names from `crate` or `super`: of `use crate::a::{b, c::d}` both `a::b` and
/// `a::c::d`.
fn paths(code: &str, module: &str) -> Vec<String> {
    let mut found = Vec::new();
    let words = |c: char| c.is_alphanumeric() || c == '_';
    for start in ["crate::", "super::"] {
        for (n, _) in code.match_indices(start) {
            if code[..n].ends_with(|c: char| words(c) || c == ':') {
                continue;
            }
            let mut base: Vec<&str> = module.split("::").collect();
            let mut rest = &code[n..];
            if start == "crate::" {
                base.clear();
                rest = &rest[start.len()..];
            }
            while let Some(above) = rest.strip_prefix("super::") {
                base.pop();
                rest = above;
            }
            expand(&base.join("::"), rest, &mut found);
        }
    }
    found
}

/// Adds the paths of a use tree that begins at `tree` under `base`; returns the rest of the code.
fn expand<'a>(base: &str, tree: &'a str, found: &mut Vec<String>) -> &'a str {
    let join = |word: &str| if base.is_empty() { word.into() } else { format!("{base}::{word}") };
    let tree = tree.trim_start();
    if let Some(mut inner) = tree.strip_prefix('{') {
        loop {
            inner = expand(base, inner, found).trim_start();
            match inner.strip_prefix(',') {
                Some(more) => inner = more,
                None => return inner.strip_prefix('}').unwrap_or(inner),
            }
        }
    }
    let end = tree.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(tree.len());
    let (word, rest) = tree.split_at(end);
    match rest.strip_prefix("::") {
        Some(more) => expand(&join(word), more, found),
        None => {
            found.push(join(word));
            let renamed = rest.trim_start().strip_prefix("as ");
            renamed
                .map_or(rest, |r| r.trim_start_matches(|c: char| c.is_alphanumeric() || c == '_'))
        }
    }
}

/// A module may name its own parents, as a file of a folder does; those do not count.
#[test]
fn modules_of_the_client_crates_have_no_circular_imports() {
    let mut imports = 0;
    for room in ["client/session", "client/lab", "client/cli"] {
        let modules = modules(room);
        let mut sees: BTreeMap<&str, BTreeSet<&str>> = BTreeMap::new();
        for (module, code) in &modules {
            let own = sees.entry(module).or_default();
            for path in paths(code, module) {
                let known = modules
                    .keys()
                    .filter(|other| path == **other || path.starts_with(&format!("{other}::")));
                let Some(other) = known.max_by_key(|other| other.len()) else { continue };
                let parent = module == other || module.starts_with(&format!("{other}::"));
                if !parent && !other.is_empty() {
                    own.insert(other);
                }
            }
        }
        // Modules that each module reaches, found in at most as many rounds as there are modules.
        let mut reach = sees.clone();
        loop {
            let before = reach.clone();
            for all in reach.values_mut() {
                let more: Vec<&str> = all.iter().flat_map(|m| &before[m]).copied().collect();
                all.extend(more);
            }
            if reach == before {
                break;
            }
        }
        let circle: Vec<&str> =
            reach.iter().filter(|(m, all)| all.contains(*m)).map(|(m, _)| *m).collect();
        assert!(
            circle.is_empty(),
            "{room}: {circle:?} import each other in a circle. Move what they share into a module \
             of its own that sees none of them"
        );
        imports += sees.values().map(BTreeSet::len).sum::<usize>();
    }
    assert!(imports > 100, "only {imports} imports were read: the parser of this test is blind");
}

#[test]
fn use_trees_are_expanded_to_paths() {
    let code = "use crate::a::{self, b::{c, d as e}};\nfn f() { super::g::h(); not_crate::x }";
    assert_eq!(paths(code, "m::n"), ["a::self", "a::b::c", "a::b::d", "m::g::h"]);
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
    for room in
        ["common", "common/scene", "common/trace", "worker/render", "master/schedule", "master/sim"]
    {
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

/// Rooms of one purpose hold 100 to 400 lines. Past 800 a file has several.
#[test]
fn no_file_has_more_than_800_lines() {
    let mut files = Vec::new();
    for folder in ["client", "common", "master", "proto", "tests", "worker"] {
        sources(&root().join(folder), &mut files);
    }
    for file in files {
        let lines = std::fs::read_to_string(&file).expect("a source").lines().count();
        let name = file.strip_prefix(root()).expect("inside").display().to_string();
        assert!(
            lines <= 800,
            "{name} has {lines} lines: divide it, or move its tests to a file of their own"
        );
    }
}
