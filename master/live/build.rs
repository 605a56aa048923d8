//! Joins the modules of `master/page` into one script and packs the four files that a browser gets, by
//! the rules of master/page/README.md.

use flate2::Compression;
use flate2::write::GzEncoder;
use sha2::{Digest, Sha256};
use std::fmt::Write as _;
use std::io::Write as _;
use std::path::{Path, PathBuf};

fn main() {
    let page =
        PathBuf::from(std::env::var("CARGO_MANIFEST_DIR").expect("cargo sets it")).join("../page");
    let out = PathBuf::from(std::env::var("OUT_DIR").expect("cargo sets it"));
    println!("cargo::rerun-if-changed={}", page.display());
    let read =
        |name: &str| std::fs::read(page.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
    let files = [
        ("index.html", "text/html; charset=utf-8", read("index.html")),
        ("main.css", "text/css; charset=utf-8", read("main.css")),
        ("icon.svg", "image/svg+xml", read("icon.svg")),
        ("app.js", "text/javascript; charset=utf-8", bundle(&page)),
    ];
    let mut table =
        String::from("/// The files of the page.\npub(crate) static ASSETS: [Asset; 4] = [\n");
    for (name, kind, bytes) in files {
        let mut packed = GzEncoder::new(Vec::new(), Compression::best());
        packed.write_all(&bytes).expect("memory");
        std::fs::write(out.join(name), &bytes).expect("OUT_DIR can be written");
        let packed = packed.finish().expect("memory");
        std::fs::write(out.join(format!("{name}.gz")), packed).expect("OUT_DIR can be written");
        let hash: String =
            Sha256::digest(&bytes).iter().take(12).fold(String::new(), |mut text, byte| {
                let _ = write!(text, "{byte:02x}");
                text
            });
        let _ = writeln!(
            table,
            "    Asset {{ name: {name:?}, kind: {kind:?}, etag: \"\\\"{hash}\\\"\", packed_etag: \
             \"\\\"{hash}-gz\\\"\", bytes: include_bytes!({name:?}), packed: \
             include_bytes!(\"{name}.gz\") }},"
        );
    }
    table += "];\n";
    std::fs::write(out.join("assets.rs"), table).expect("OUT_DIR can be written");
}

/// Returns the modules of bundle.txt, one after another.
fn bundle(page: &Path) -> Vec<u8> {
    let list = std::fs::read_to_string(page.join("bundle.txt")).expect("bundle.txt");
    let mut joined = String::new();
    for name in list.split_whitespace() {
        let text =
            std::fs::read_to_string(page.join(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        for line in plain(&text) {
            let is_left = ["import", "export"].iter().any(|word| {
                line.strip_prefix(word).is_some_and(|rest| rest.starts_with([' ', '{']))
            });
            assert!(!is_left, "{name}: an import or export of a kind that can't be joined: {line}");
            joined += &line;
            joined.push('\n');
        }
    }
    joined.into_bytes()
}

/// Returns the lines of a module without imports, the word `export` and lines of comments.
fn plain(text: &str) -> Vec<String> {
    let mut lines = Vec::new();
    let mut until: Option<&str> = None;
    for line in text.lines() {
        let bare = line.trim();
        if let Some(end) = until {
            until = if bare.ends_with(end) { None } else { until };
        } else if line.starts_with("import ") {
            until = if bare.ends_with("\";") { None } else { Some("\";") };
        } else if bare.starts_with("/*") {
            // A cast may begin a line of code.
            if bare.starts_with("/** @") && !bare.ends_with("*/") && bare.contains("*/") {
                lines.push(without_casts(line));
            } else {
                until = if bare.ends_with("*/") { None } else { Some("*/") };
            }
        } else if bare.starts_with("//") || bare.is_empty() || line == "export {};" {
        } else {
            lines.push(without_casts(line.strip_prefix("export ").unwrap_or(line)));
        }
    }
    lines
}

/// Leaves `/** @...*/` and one space behind it out of a line.
fn without_casts(line: &str) -> String {
    let (mut kept, mut rest) = (String::new(), line);
    while let Some(begin) = rest.find("/** @") {
        let Some(end) = rest[begin..].find("*/") else { break };
        kept += &rest[..begin];
        rest = &rest[begin + end + 2..];
        rest = rest.strip_prefix(' ').unwrap_or(rest);
    }
    kept + rest
}
