//! `slabcast lab error --classify before` as a user runs it: figures that make sense of each other.
//! The other order has its test in `after.rs`.

use std::process::Command;

fn error(arguments: &[&str]) -> serde_json::Value {
    let mut command = Command::new(env!("CARGO_BIN_EXE_slabcast"));
    command.args(["lab", "error", "formula:spheres:32", "--json", "--classify", "before"]);
    command.args(arguments);
    for (flag, value) in [("--size", "96x80"), ("--pixels", "1500")] {
        if !arguments.contains(&flag) {
            command.args([flag, value]);
        }
    }
    let out = command.output().expect("slabcast runs");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    serde_json::from_slice(&out.stdout).expect("JSON")
}

fn rmse(figures: &serde_json::Value, source: &str) -> f64 {
    figures[source]["rmse"].as_f64().expect("a figure")
}

#[test]
fn error_sources_add_up_and_cutoff_keeps_its_bound() {
    let f = error(&[]);
    let whole = rmse(&f, "limit");
    assert!(whole > 0.0 && whole < 2.0, "{whole}/255");
    let squares: f64 = ["thickness", "cutoff", "slivers", "quantisation", "rounding"]
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
    let slivers = |f: &serde_json::Value| f["slivers"]["max"].as_f64().unwrap();
    assert!((0.01..1.0).contains(&slivers(&f)), "{}", slivers(&f));
    assert_eq!(slivers(&error(&["--eps", "0"])), 0.0, "nothing is to be lost");
}

#[test]
fn error_falls_with_thickness_except_for_paper_compositing() {
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

/// Each pixel once is all pixels, however one asks for it.
#[test]
fn error_over_all_pixels_counts_the_whole_picture() {
    let figures = |pixels: &str| {
        let mut f = error(&["--size", "40x30", "--pixels", pixels, "--model-pixels", "100"]);
        for time in ["draw_ms", "judge_ms", "total_ms"] {
            assert!(f[time].as_f64().is_some_and(|t| t > 0.0), "{time}: {}", f[time]);
            f[time] = 0.into();
        }
        f
    };
    let all = figures("all");
    assert_eq!(all["sampled"], 1200);
    assert_eq!(all["sampled_model"], 100);
    assert_eq!(all["size"], serde_json::json!([40, 30]));
    assert_eq!(all, figures("1200"));
    assert_eq!(all, figures("99999"));
    assert_ne!(all["limit"], figures("600")["limit"]);
}

/// Rounding parts into positions and arithmetic, of which positions are nearly all; truncation
/// and ripple are those of the kernel: a wider cut mends the one, a narrower kernel ripples more.
#[test]
fn error_splits_rounding_and_model_in_two_parts_each() {
    let f = error(&[]);
    let (positions, arithmetic) = (rmse(&f, "rounding_positions"), rmse(&f, "rounding_arithmetic"));
    assert!(arithmetic > 0.0 && arithmetic < 1e-3, "{arithmetic}");
    assert!((positions / rmse(&f, "rounding") - 1.0).abs() < 0.05, "{positions}");
    let wide = error(&["--radius", "3"]);
    assert!(10.0 * rmse(&wide, "truncation") < rmse(&f, "truncation"));
    let narrow = error(&["--std", "0.45"]);
    assert!(4.0 * rmse(&f, "ripple") < rmse(&narrow, "ripple"));
    assert!(rmse(&f, "ripple") > 0.0);
    // Neither has anything to do with sheets.
    let thin = error(&["--thickness", "0.25"]);
    for source in ["truncation", "ripple"] {
        assert_eq!(thin[source], f[source]);
    }
}

/// A map has the picture left, its error right and says its scale; blank pixels are grey.
#[test]
fn error_map_shows_where_the_error_is() {
    let dir = tempfile::tempdir().expect("a folder");
    let path = dir.path().join("map.png");
    let f = error(&["--pixels", "all", "--map", path.to_str().expect("text")]);
    assert_eq!(f["map"], path.to_str().expect("text"));
    let file = std::io::BufReader::new(std::fs::File::open(&path).expect("the map"));
    let mut reader = png::Decoder::new(file).read_info().expect("a PNG");
    let mut bytes = vec![0; reader.output_buffer_size().expect("fits")];
    reader.next_frame(&mut bytes).expect("pixels");
    let info = reader.info();
    let (w, h) = (info.width as usize, info.height as usize);
    assert!(w == 2 * 96 + 8 && h > 80, "{w}x{h}");
    let text: Vec<_> = info.uncompressed_latin1_text.iter().map(|t| &t.text[..]).collect();
    assert!(text.iter().any(|t| t.contains("of 1/255 or less")), "{text:?}");
    let at = |x: usize, y: usize| &bytes[(y * w + x) * 3..][..3];
    // The map has as many coloured pixels as were compared, all where the picture shows something.
    let blank = |x: usize, y: usize| at(96 + 8 + x, y) == [96; 3];
    let all = (0..80).flat_map(|y| (0..96).map(move |x| (x, y)));
    let seen = all.clone().filter(|&(x, y)| !blank(x, y)).count();
    assert_eq!(seen as u64, f["limit"]["pixels"].as_u64().expect("a number"));
    assert!(all.clone().all(|(x, y)| !blank(x, y) || at(x, y) == [0; 3]), "a picture where blank");
    // Only the map is there.
    assert_eq!(std::fs::read_dir(dir.path()).expect("the folder").count(), 1);
}

#[test]
fn error_map_never_replaces_the_volume_and_must_be_a_png() {
    let refused = |arguments: &[&str]| {
        let out = Command::new(env!("CARGO_BIN_EXE_slabcast"))
            .args(["lab", "error"])
            .args(arguments)
            .output()
            .expect("slabcast runs");
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(2), "{said}");
        said
    };
    let dir = tempfile::tempdir().expect("a folder");
    let volume = dir.path().join("v.png");
    std::fs::write(&volume, "x").expect("a file");
    let volume = volume.to_str().expect("text");
    assert!(refused(&[volume, "--map", volume]).contains("is the volume"));
    assert!(refused(&["formula:spheres", "--map", "brain.nrrd"]).contains(".png"));
    assert!(refused(&["formula:spheres", "--pixels", "some"]).contains("or all"));
}

/// Ctrl-C ends a long run at once, with its code and no map.
#[cfg(unix)]
#[test]
fn ctrl_c_ends_an_error_measurement_at_once() {
    use std::io::{BufRead, BufReader};
    use std::time::{Duration, Instant};
    let dir = tempfile::tempdir().expect("a folder");
    let map = dir.path().join("map.png");
    let mut child = Command::new(env!("CARGO_BIN_EXE_slabcast"))
        .args(["lab", "error", "formula:spheres:64", "--size", "512x512", "--pixels", "all"])
        .args(["--map", map.to_str().expect("text")])
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("slabcast runs");
    let mut said = BufReader::new(child.stderr.take().expect("piped")).lines();
    let begins = said.find(|l| l.as_ref().is_ok_and(|l| l.contains("pixels of the reference")));
    assert!(begins.is_some(), "the measurement never began");
    let told = Instant::now();
    let killed =
        Command::new("kill").args(["-INT", &child.id().to_string()]).status().expect("kill runs");
    assert!(killed.success());
    let code = child.wait().expect("a child").code();
    assert_eq!(code, Some(130));
    assert!(told.elapsed() < Duration::from_secs(5), "{:?}", told.elapsed());
    assert_eq!(std::fs::read_dir(dir.path()).expect("the folder").count(), 0);
}
