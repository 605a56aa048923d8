//! Start of pages (transfer functions, volumes) and limits of several at once: real processes, real
//! WebSockets. `live.rs` tests the pictures of one page.

#[path = "support/live_client.rs"]
mod live_client;
#[path = "support/processes.rs"]
mod processes;

use live_client::{Live, SIZE, view};
use processes::{exit_within, slabcast};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

const VOLUME: &str = "formula:spheres:40";

/// Runs the program and returns what it printed.
fn run(dir: &Path, words: &[&str]) -> String {
    let out = slabcast(dir, words).output().expect("slabcast runs");
    assert!(out.status.success(), "{words:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).expect("text")
}

/// Returns the SHA-256 of a PNG's pixels as `done` has it.
fn rgba_hash(file: &Path) -> String {
    let file = std::io::BufReader::new(std::fs::File::open(file).expect("a picture"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut rgb = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut rgb).expect("a PNG");
    let rgba: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
    Sha256::digest(rgba).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn page_begins_with_the_function_of_a_file_as_render_draws_it() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    // Half as opaque: no preset has these numbers.
    let mut own: Value = serde_json::from_str(&run(dir, &["tf", "bone", VOLUME])).expect("JSON");
    for point in own["opacities"].as_array_mut().expect("points") {
        point[1] = json!(point[1].as_f64().expect("an opacity") / 2.0);
    }
    std::fs::write(dir.join("ours.json"), own.to_string()).expect("a file");
    run(dir, &["tf", "ours.json", VOLUME, "--paraview", "-o", "paraview.json"]);
    for file in ["ours.json", "paraview.json"] {
        let (_view, port) = view(dir, &[VOLUME, "--tf", file]);
        let mut page = Live::dial(port, json!({"codecs": ["png"]})).await;
        let volume = page.until("volume").await;
        let home = &volume["home"];
        assert!(home["tf"]["colors"].is_array(), "{file}: {home}");
        let first = page.still(0).await;
        let path = json!({"version": 1, "size": SIZE,
            "keyframes": {"frames": 1, "keys": [home["camera"]]}});
        std::fs::write(dir.join("path.json"), path.to_string()).expect("a file");
        let drawn = ["render", VOLUME, "-q", "--force", "--path", "path.json", "-o", "out.png"];
        run(dir, &[&drawn[..], &["--tf", file]].concat());
        assert_eq!(first["sha256"], json!(rgba_hash(&dir.join("out.png"))), "{file}");
        page.send(json!({"type": "scene", "rev": 1, "tf": home["tf"]})).await;
        assert_eq!(page.still(1).await["sha256"], first["sha256"], "sent back, {file}");
        // It is of this volume: another begins as usual.
        run(dir, &["put", "formula:blob:24", "--master", &format!("127.0.0.1:{port}")]);
        page.send(json!({"type": "open", "volume": "formula:blob:24"})).await;
        let other = page.until("volume").await;
        assert_eq!((&other["home"]["tf"], &other["file"]), (&json!("auto"), &other["name"]));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn links_of_workers_and_slopes_of_volumes_are_told() {
    let dir = tempfile::tempdir().expect("a folder");
    let (_view, port) = view(dir.path(), &[VOLUME]);
    let mut page = Live::dial(port, json!({"watch": ["workers"]})).await;
    let volume = page.until("volume").await;
    let gradients = &volume["gradients"];
    assert!(gradients["to"].as_f64().is_some_and(|to| to > 0.0), "{gradients}");
    let counts = gradients["counts"].as_array().expect("counts").iter();
    let counts: Vec<u64> = counts.map(|n| n.as_u64().expect("a count")).collect();
    assert_eq!((counts.len(), counts.iter().sum::<u64>()), (64, 40 * 40 * 40));
    // Pings are answered within a moment.
    loop {
        let news = page.until("workers").await;
        let Some(worker) = news["changed"].get(0) else { continue };
        assert_eq!(worker["last_error"], Value::Null, "{worker}");
        if let Some(ms) = worker["rtt_ms"].as_f64() {
            assert!((0.0..60_000.0).contains(&ms), "{worker}");
            break;
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn sessions_beyond_the_limit_are_told_so() {
    let dir = tempfile::tempdir().expect("a folder");
    let (_view, port) = view(dir.path(), &["formula:blob:8"]);
    let mut held = Vec::new();
    for _ in 0..64 {
        held.push(Live::dial(port, json!({"size": [16, 16]})).await);
    }
    let (code, words) = Live::dial(port, json!({})).await.closed().await;
    assert_eq!(code, 4429);
    assert!(words.contains("as many pages are open as this master takes"), "{words}");
    held[0].until("welcome").await;
}

#[test]
fn functions_that_can_not_be_used_are_refused_before_a_page_is_served() {
    let dir = tempfile::tempdir().expect("a folder");
    let dir = dir.path();
    std::fs::write(dir.join("none.json"), "{\"version\": 1}").expect("a file");
    let unsorted = r#"{"version": 1, "domain": "unit", "colors": [[0, 1, 1, 1]],
        "opacities": [[1, 0], [0, 1]]}"#;
    std::fs::write(dir.join("unsorted.json"), unsorted).expect("a file");
    for (tf, code, says) in [
        ("none.json", 1, "none.json"),
        ("unsorted.json", 1, "unsorted.json: opacities"),
        ("missing.json", 1, "missing.json"),
        ("bome", 2, "did you mean `bone`"),
    ] {
        let mut process = slabcast(dir, &["view", VOLUME, "--tf", tf])
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("slabcast runs");
        assert_eq!(exit_within(&mut process, Duration::from_secs(30)), Some(code), "{tf}");
        let mut said = String::new();
        let stderr = process.stderr.as_mut().expect("a pipe");
        std::io::Read::read_to_string(stderr, &mut said).expect("text");
        assert!(said.contains(says), "{tf}: {said}");
    }
}
