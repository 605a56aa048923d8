//! `--fit`: what can be seen is in the middle and fills the picture, with the same bytes wherever
//! it is drawn.

use crate::program::{good, master, run, text, worker};
use std::path::Path;

const EDGE: u32 = 96;
/// The volume's name says what is in it.
const CORNER: &str = "corner_96x96x96_uint8.raw";

/// Writes a ball in a corner of much air, with a lonely bright voxel in the opposite one.
fn corner(dir: &Path) {
    let ball = |i: u32, j: u32, k: u32| {
        let d = [i.abs_diff(70), j.abs_diff(24), k.abs_diff(68)].map(|d| d * d);
        let lonely = [i, j, k] == [2, 90, 3];
        if d.iter().sum::<u32>() <= 400 || lonely { 200u8 } else { 0 }
    };
    let each = (0..EDGE.pow(3)).map(|n| ball(n % EDGE, n / EDGE % EDGE, n / EDGE / EDGE));
    std::fs::write(dir.join(CORNER), each.collect::<Vec<u8>>()).unwrap();
}

/// The pixels of a PNG, its size and the samples of a pixel.
fn pixels(file: &Path) -> (Vec<u8>, [u32; 2], usize) {
    let file = std::io::BufReader::new(std::fs::File::open(file).expect("a picture"));
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut bytes).unwrap();
    (bytes, [info.width, info.height], info.color_type.samples())
}

/// Extent of what is bright in a PNG: first and last column, first and last row, and its size.
fn extent(file: &Path) -> ([u32; 4], [u32; 2]) {
    let (bytes, size, channels) = pixels(file);
    let bright = (0..size[0] * size[1])
        .filter(|&p| bytes[p as usize * channels..][..channels.min(3)].iter().any(|&b| b > 60));
    let mut e = [u32::MAX, 0, u32::MAX, 0];
    for p in bright {
        let (x, y) = (p % size[0], p / size[0]);
        e = [e[0].min(x), e[1].max(x), e[2].min(y), e[3].max(y)];
    }
    (e, size)
}

/// Renders one picture of the corner with more flags; gives its pixels and extent.
fn picture(dir: &Path, more: &[&str]) -> (Vec<u8>, ([u32; 4], [u32; 2])) {
    let one = ["render", CORNER, "--tf", "peer-opaque", "-q", "--force", "-o", "p.png"];
    good(dir, &[&one[..], more].concat());
    let file = dir.join("p.png");
    (pixels(&file).0, extent(&file))
}

fn assert_centred_and_filled(what: &str, (e, size): ([u32; 4], [u32; 2])) {
    for (axis, [from, to]) in [[e[0], e[1]], [e[2], e[3]]].into_iter().enumerate() {
        let middle = f64::from(from + to + 1) / 2.0 - f64::from(size[axis]) / 2.0;
        assert!(middle.abs() <= 2.0, "{what}: off by {middle} pixels along {axis}, {e:?}");
    }
    let share = |from: u32, to: u32, of: u32| f64::from(to - from + 1) / f64::from(of);
    let tighter = share(e[0], e[1], size[0]).max(share(e[2], e[3], size[1]));
    assert!((0.80..=0.90).contains(&tighter), "{what}: fills {tighter}");
}

#[test]
fn what_lies_in_a_corner_is_centred_and_fills_the_picture() {
    let dir = tempfile::tempdir().unwrap();
    corner(dir.path());
    for more in [
        &["--azimuth", "20", "--size", "200x200"][..],
        &["--azimuth", "65", "--elevation", "40", "--size", "260x200"],
        &["--azimuth", "20", "--projection", "persp", "--size", "200x240"],
        &["--view", "left", "--up=z", "--front=y", "--size", "200x200"],
        // Half a ball, and 85 % of the picture all the same.
        &["--azimuth", "0", "--crop", ":,:,:68", "--size", "200x200"],
    ] {
        assert_centred_and_filled(&format!("{more:?}"), picture(dir.path(), more).1);
    }
}

#[test]
fn frames_of_a_turn_share_their_framing_and_parts_of_it_fit_together() {
    let dir = tempfile::tempdir().unwrap();
    corner(dir.path());
    let turn = ["render", CORNER, "--tf", "peer-opaque", "-q", "--step", "60", "--size", "120x120"];
    good(dir.path(), &[&turn[..], &["--frames", "6", "-o", "whole"]].concat());
    good(dir.path(), &[&turn[..], &["--frames", "2..3", "-o", "part"]].concat());
    for n in 0..6 {
        let file = format!("frame_{n:04}.png");
        let whole = dir.path().join("whole").join(&file);
        assert_centred_and_filled(&file, extent(&whole));
        if n == 2 || n == 3 {
            let part = std::fs::read(dir.path().join("part").join(&file)).unwrap();
            assert!(part == std::fs::read(whole).unwrap(), "{file}");
        }
    }
}

#[test]
fn fit_volume_and_height_show_the_box_of_the_file() {
    let dir = tempfile::tempdir().unwrap();
    corner(dir.path());
    let of = |more: &[&str]| {
        let one = ["--azimuth", "20", "--size", "120x120"];
        picture(dir.path(), &[&one[..], more].concat()).0
    };
    let volume = of(&["--fit", "volume"]);
    // 1.25 times 96 samples.
    assert!(of(&["--height", "120"]) == volume);
    assert!(of(&[]) != volume);
    assert!(of(&["--fit", "visible"]) == of(&[]));
    assert!(of(&["--height", "120", "--fit", "visible"]) != volume, "the target is fitted");
    // A file keeps its meaning, unless the flag says otherwise.
    let path = r#"{"version":1,"size":[120,120],"turntable":{"start":20,"frames":1}}"#;
    std::fs::write(dir.path().join("path.json"), path).unwrap();
    let by_file = |more: &[&str]| picture(dir.path(), &[&["--path", "path.json"], more].concat()).0;
    assert!(by_file(&[]) == volume);
    assert!(by_file(&["--fit", "visible"]) == of(&[]));
}

#[test]
fn views_with_cameras_of_their_own_can_not_be_fitted() {
    let dir = tempfile::tempdir().unwrap();
    let path = r#"{"version":1,"size":[20,20],
        "views":[{"eye":[0,99,0],"target":[0,0,0],"up":[0,0,1],"projection":"ortho"}]}"#;
    std::fs::write(dir.path().join("views.json"), path).unwrap();
    let out = run(
        dir.path(),
        &["render", "formula:spheres:8", "--path", "views.json", "--fit", "visible"],
    );
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2), "{said}");
    assert!(said.contains("--fit") && said.contains("leave it out"), "{said}");
}

#[test]
fn a_cluster_frames_as_one_process_does_and_pictures_record_the_numbers() {
    let dir = tempfile::tempdir().unwrap();
    corner(dir.path());
    let (_master, address) = master(dir.path(), CORNER, &[]);
    let _worker = worker(dir.path(), &address, "w", &["--threads", "1", "--memory", "48MiB"]);
    let look = ["--tf", "peer-opaque", "--azimuth", "30", "--size", "90x70", "-q"];
    good(dir.path(), &[&["render", CORNER, "-o", "here.png"], &look[..]].concat());
    let there = ["render", "--master", &address, "-o", "there.png"];
    good(dir.path(), &[&there[..], &look].concat());
    let read = |name: &str| std::fs::read(dir.path().join(name)).unwrap();
    assert!(read("here.png") == read("there.png"));
    let shown = good(dir.path(), &["rerender", "there.png", "--show"]);
    assert!(shown.contains("\"height\"") && !shown.contains("\"fit\""), "{shown}");
    let again = good(dir.path(), &["rerender", "there.png", CORNER]);
    assert!(again.contains("the same"), "{again}");
}
