//! The renderer's rooms import lower ones alone.

use std::path::{Path, PathBuf};

/// Rooms from the lowest up, each with what it may import of this crate besides itself.
const ROOMS: [(&str, &[&str]); 11] = [
    ("primitives", &[]),
    ("visibility", &["primitives"]),
    ("kernels", &["primitives", "visibility::open_mask"]),
    ("scene", &["kernels", "primitives", "visibility::open_mask"]),
    ("part", &["kernels", "primitives", "scene", "visibility"]),
    ("geometry", &["kernels", "part", "primitives", "scene", "visibility"]),
    ("tile", &["geometry", "kernels", "part", "primitives", "scene"]),
    ("region", &["kernels", "part", "primitives", "scene", "tile", "visibility"]),
    ("work", &["kernels", "part", "primitives", "region", "scene", "tile", "visibility"]),
    ("oracle", &["kernels", "primitives", "scene"]),
    ("judge", &["kernels", "primitives", "scene", "tile"]),
];

fn sources(path: &Path, into: &mut Vec<PathBuf>) {
    if path.is_dir() {
        for entry in std::fs::read_dir(path).expect("a folder") {
            sources(&entry.expect("an entry").path(), into);
        }
    } else if path.extension().is_some_and(|e| e == "rs") {
        into.push(path.to_path_buf());
    }
}

#[test]
fn renderer_modules_import_only_lower_rooms() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    for (room, may_import) in ROOMS {
        let mut files = Vec::new();
        sources(&src.join(room), &mut files);
        sources(&src.join(format!("{room}.rs")), &mut files);
        files.retain(|file| file.exists());
        assert!(!files.is_empty(), "{room} has no sources");
        for file in files {
            let text = std::fs::read_to_string(&file).expect("a source");
            for (n, line) in text.lines().enumerate() {
                let code = line.split("//").next().unwrap_or("");
                for import in code.split("crate::").skip(1) {
                    let is = |room: &str| {
                        let rest = import.strip_prefix(room);
                        rest.is_some_and(|rest| !rest.starts_with(char::is_alphanumeric))
                    };
                    assert!(
                        is(room) || may_import.iter().any(|lower| is(lower)),
                        "{}:{}: {room} may import {may_import:?}, not {import:?}: pass it in, or \
                         move it down",
                        file.display(),
                        n + 1
                    );
                }
            }
        }
    }
}
