//! Defaults and shorthands of `render`: numbered output folders, formats by file name, figures, grids.

use crate::program::{good, names, run, slabcast, text};
use std::path::Path;

const SMALL: [&str; 4] = ["render", "formula:spheres:24", "--size", "48x36"];

fn render(dir: &Path, more: &[&str]) -> String {
    good(dir, &[&SMALL[..], more].concat())
}

fn pixels(path: &Path) -> ([usize; 2], Vec<u8>) {
    let file = std::io::BufReader::new(std::fs::File::open(path).unwrap());
    let mut png = png::Decoder::new(file).read_info().unwrap();
    let mut bytes = vec![0; png.output_buffer_size().unwrap()];
    png.next_frame(&mut bytes).unwrap();
    ([png.info().width as usize, png.info().height as usize], bytes)
}

#[test]
fn the_same_command_a_second_time_works_beside_the_first() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let said = render(dir, &["--frames", "3"]);
    assert!(said.starts_with("3 frames in slabcast-out/ ("), "{said}");
    let first = std::fs::read(dir.join("slabcast-out/frame_0000.png")).unwrap();
    let out = run(dir, &[&SMALL[..], &["--frames", "3", "--tf", "fog"]].concat());
    assert!(text(&out.stdout).starts_with("3 frames in slabcast-out-2/ ("));
    let said = text(&out.stderr);
    let notes = said.lines().filter(|l| l.starts_with("note: slabcast-out/ holds")).count();
    assert_eq!(notes, 1, "{said}");
    assert_eq!(std::fs::read(dir.join("slabcast-out/frame_0000.png")).unwrap(), first);
    // A part of the path that is missing goes where the rest is.
    let said = render(dir, &["--frames", "3..4"]);
    assert!(said.starts_with("2 frames in slabcast-out/ ("), "{said}");
    // Who names the folder is asked.
    let out = run(dir, &[&SMALL[..], &["--frames", "3", "-o", "slabcast-out"]].concat());
    assert!(out.status.code() == Some(1) && text(&out.stderr).contains("--force"));
    // Replaced as a whole: no frame of the longer path stays, and nothing else goes.
    std::fs::write(dir.join("slabcast-out/notes.txt"), "mine").unwrap();
    render(dir, &["--frames", "2", "--force"]);
    let want = ["frame_0000.png", "frame_0001.png", "notes.txt"];
    assert_eq!(names(&dir.join("slabcast-out")), want);
}

#[test]
fn a_name_of_one_picture_is_one_picture() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    render(dir, &["-o", "a.png"]);
    render(dir, &["--frames", "4", "-o", "turn"]);
    let read = |name: &str| pixels(&dir.join(name));
    // The first view, framed for itself.
    assert_eq!(read("a.png").0, [48, 36]);
    render(dir, &["--azimuth", "20", "-o", "b.png"]);
    assert_eq!(read("a.png"), read("b.png"));
    for (name, bytes) in [("a.tif", &b"II*\0"[..]), ("a.jpg", &[0xff, 0xd8, 0xff])] {
        render(dir, &["-o", name, "--dpi", "300"]);
        assert!(std::fs::read(dir.join(name)).unwrap().starts_with(bytes), "{name}");
        let said = good(dir, &["rerender", name, "formula:spheres:24", "-q", "--force"]);
        assert!(said.contains("the same "), "{said}");
    }
    // A folder may have a dot if it says that it is one.
    let said = render(dir, &["--frames", "2", "-o", "v1.pdf/"]);
    assert!(said.starts_with("2 frames in v1.pdf/ ("), "{said}");
}

#[test]
fn frames_share_a_full_turn() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let step = |more: &[&str]| {
        let out = [&["-o", "x", "--force"], more].concat();
        render(dir, &out);
        let said = good(dir, &["rerender", "x/frame_0000.png", "--show"]);
        let said: serde_json::Value = serde_json::from_str(&said).unwrap();
        (names(&dir.join("x")).len(), said["path"]["turntable"]["step"].as_f64().unwrap())
    };
    assert_eq!(step(&[]), (36, 10.0));
    assert_eq!(step(&["--frames", "8"]), (8, 45.0));
    assert_eq!(step(&["--frames", "8", "--step", "5"]), (8, 5.0));
    assert_eq!(step(&["--turn", "90", "--frames", "9"]), (9, 10.0));
    assert_eq!(step(&["--turn", "180", "--seconds", "1", "--fps", "6"]), (6, 30.0));
}

#[test]
fn marks_cover_a_part_and_leave_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let view = ["--azimuth", "30", "--size", "200x150"];
    let plain = [&["render", "formula:spheres:24", "-o", "plain.png"], &view[..]].concat();
    good(dir, &plain);
    let marks = ["--scale-bar=um", "--color-bar", "--caption", "Two words \u{b5}", "--dpi", "300"];
    for (name, format) in
        [("m.png", "png"), ("m16.png", "png16"), ("m.tif", "tif"), ("m.jpg", "jpg")]
    {
        let line = ["render", "formula:spheres:24", "-o", name, "--format", format];
        good(dir, &[&line, &view[..], &marks[..]].concat());
        let said = good(dir, &["rerender", name, "formula:spheres:24", "-q", "--force"]);
        assert!(said.contains("the same "), "{said}");
    }
    let ((size, before), (_, after)) = (pixels(&dir.join("plain.png")), pixels(&dir.join("m.png")));
    let changed: Vec<usize> =
        (0..before.len() / 3).filter(|i| before[i * 3..][..3] != after[i * 3..][..3]).collect();
    assert!((500..9000).contains(&changed.len()), "{}", changed.len());
    // The middle has no marks.
    let middle =
        |i: &&usize| (75..105).contains(&(*i % size[0])) && (30..110).contains(&(*i / size[0]));
    assert_eq!(changed.iter().filter(middle).count(), 0);
    // All but the marks are in the recipe, too.
    let show = |name: &str| -> serde_json::Value {
        serde_json::from_str(&good(dir, &["rerender", name, "--show"])).unwrap()
    };
    let (plain, marked) = (show("plain.png"), show("m.png"));
    assert_eq!(plain.get("figure"), None);
    assert_eq!(marked["figure"]["dpi"], 300);
    assert_eq!(plain["view_sha256"], marked["view_sha256"]);
}

#[test]
fn several_views_are_a_grid_with_their_names() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let sides = ["--up", "+z", "--front", "+y", "--view"];
    render(dir, &[&sides[..], &["all", "-o", "all.png"]].concat());
    assert_eq!(pixels(&dir.join("all.png")).0, [3 * 48, 2 * 36]);
    let said = good(dir, &["rerender", "all.png", "formula:spheres:24", "-q"]);
    assert!(said.contains("the same "), "{said}");
    render(
        dir,
        &[&sides[..], &["left,superior", "-o", "two", "--contact-sheet", "c.png"]].concat(),
    );
    assert_eq!(names(&dir.join("two")), ["frame_0000.png", "frame_0001.png"]);
    render(dir, &[&sides[..], &["left", "-o", "left.png"]].concat());
    assert_eq!(pixels(&dir.join("left.png")).0, [48, 36]);
    let out = run(dir, &[&SMALL[..], &sides, &["left,front"]].concat());
    assert!(text(&out.stderr).contains("front") && out.status.code() == Some(2));
}

#[test]
fn two_volumes_stand_side_by_side_under_one_look() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let pair = ["compare", "formula:spheres:24", "formula:blob:24", "--size", "60x40"];
    let said = good(dir, &[&pair[..], &["--scale-bar=vox", "--color-bar"]].concat());
    assert!(said.contains("compare.png"), "{said}");
    let (size, _) = pixels(&dir.join("compare.png"));
    assert!(size[0] > 120 && size[1] == 40, "{size:?}");
    assert!(good(dir, &pair).contains("compare-2.png"));
    let out = run(dir, &[&pair[..], &["-o", "compare.png"]].concat());
    assert!(text(&out.stderr).contains("--force") && out.status.code() == Some(1));
    // The first is the picture that render draws, framed by the larger of both.
    good(
        dir,
        &["compare", "formula:spheres:24", "formula:spheres:24", "--size", "60x40", "-o", "s.png"],
    );
    let (_, both) = pixels(&dir.join("s.png"));
    let row = |y: usize, x: usize| &both[(y * 120 + x) * 3..][..60 * 3];
    assert!((20..40).all(|y| row(y, 0) == row(y, 60)), "below their names both are the same");
}

#[test]
fn a_look_is_fitted_to_another_volume() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    render(dir, &["--tf", "skin", "-o", "own.png"]);
    render(dir, &["--tf", "skin", "--like", "formula:ramp:16", "-o", "like.png"]);
    render(dir, &["--tf", "skin", "--like", "formula:spheres:24", "-o", "same.png"]);
    let read = |name: &str| pixels(&dir.join(name)).1;
    assert_ne!(read("own.png"), read("like.png"));
    let off = read("own.png").iter().zip(read("same.png")).map(|(a, b)| a.abs_diff(b)).max();
    assert!(off <= Some(1), "{off:?}");
}

#[test]
fn a_printed_preset_draws_the_same_picture() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    for name in ["glass", "skin", "viridis", "peer-skull"] {
        for volume in ["formula:spheres:24", "formula:ramp:16"] {
            good(dir, &["tf", name, volume, "-o", "tf.json", "--force"]);
            for (tf, to) in [(name, "a.png"), ("tf.json", "b.png")] {
                let line = ["render", volume, "--tf", tf, "-o", to, "--force", "-q"];
                good(dir, &[&line[..], &["--size", "48x36"]].concat());
            }
            let [a, b] = ["a.png", "b.png"].map(|name| pixels(&dir.join(name)));
            assert_eq!(a, b, "{name} of {volume}");
        }
    }
}

#[test]
fn a_volume_that_stands_somehow_is_guessed() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    good(dir, &["info", "formula:spheres:24", "--orient"]);
    let (size, _) = pixels(&dir.join("orient.png"));
    assert_eq!(size, [4 * 192, 6 * 192]);
    good(dir, &["info", "formula:spheres:24", "--orient"]);
    assert_eq!(names(dir), ["orient-2.png", "orient.png"]);
    let out = run(dir, &["info", "formula:spheres:24", "--orient=orient.png"]);
    assert!(out.status.code() == Some(1) && text(&out.stderr).contains("is there already"));
}

#[test]
fn small_things_are_said_where_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    // Uneven steps, and nobody gave a height.
    std::fs::write(dir.join("r_8x8x8_uint8.raw"), [7; 512]).unwrap();
    let out = run(dir, &["render", "r_8x8x8_uint8.raw", "--spacing", "1x1x1e-6"]);
    let said = text(&out.stderr);
    assert!(said.contains("error: spacing: ") && !said.contains("--height"), "{said}");
    let line = ["--projection", "persp", "--fov", "120", "--height", "9", "-o", "a.png"];
    let said = text(&run(dir, &[&SMALL[..], &line].concat()).stderr);
    assert!(said.contains("--fov 120: the eye is 2.598 from the target, inside"), "{said}");
    // A fraction, as of --eps.
    render(dir, &["--thickness", "1/4", "-o", "thin.png"]);
    let said = good(dir, &["completions", "bash"]);
    assert!(said.contains("auto skin bone vessels"), "completions know presets");
}

/// A program called `ffmpeg` that keeps what it is told, for machines that have none.
#[cfg(unix)]
fn with_ffmpeg(dir: &Path, script: &str) -> std::path::PathBuf {
    use std::os::unix::fs::PermissionsExt;
    let bin = dir.join("bin");
    std::fs::create_dir_all(&bin).unwrap();
    let program = bin.join("ffmpeg");
    std::fs::write(&program, format!("#!/bin/sh\n{script}\n")).unwrap();
    std::fs::set_permissions(&program, std::fs::Permissions::from_mode(0o755)).unwrap();
    bin
}

#[cfg(unix)]
#[test]
fn videos_go_through_ffmpeg_and_are_whole_or_not_there() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let path = |bin: &Path| format!("{}:/usr/bin:/bin", bin.display());
    let turn = [&SMALL[..], &["--seconds", "0.1", "-o", "turn.mp4"]].concat();
    // None: the whole command is told, and nothing is drawn.
    let out = slabcast(dir, &turn).env("PATH", dir).output().unwrap();
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(1), "{said}");
    for part in ["turn.mp4: ffmpeg makes mp4", "ffmpeg -i turn.y4m", "yuv420p", "bt709"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    // One that copies: frames arrive as Y4M.
    let keep = "for last; do :; done; echo \"$@\" > args; exec cat > \"${last#file:}\"";
    let bin = with_ffmpeg(dir, keep);
    let out = slabcast(dir, &turn).env("PATH", path(&bin)).output().unwrap();
    assert!(out.status.success(), "{}", text(&out.stderr));
    assert!(text(&out.stdout).starts_with("3 frames in turn.mp4, "));
    let video = std::fs::read(dir.join("turn.mp4")).unwrap();
    let head = b"YUV4MPEG2 W48 H36 F30:1 ";
    assert!(video.starts_with(head));
    let args = std::fs::read_to_string(dir.join("args")).unwrap();
    for part in ["yuv420p", "setparams=color_primaries=bt709", "pad=ceil(iw/2)*2", "-f mp4"] {
        assert!(args.contains(part), "{part}: {args}");
    }
    assert_eq!(names(dir), ["args", "bin", "turn.mp4"]);
    // One that fails: its reason, and no file.
    let bin = with_ffmpeg(dir, "cat > /dev/null; echo 'Unknown encoder libx264' >&2; exit 8");
    let again = [&turn[..], &["--force"]].concat();
    let out = slabcast(dir, &again).env("PATH", path(&bin)).output().unwrap();
    let said = text(&out.stderr);
    assert!(out.status.code() == Some(1) && said.contains("nknown encoder libx264"), "{said}");
    assert!(said.contains("ffmpeg -i turn.y4m"), "{said}");
    assert_eq!(names(dir), ["args", "bin", "turn.mp4"]);
    assert_eq!(std::fs::read(dir.join("turn.mp4")).unwrap(), video, "the old one is kept");
    // One that dies at once.
    let bin = with_ffmpeg(dir, "echo 'no' >&2; exit 1");
    let out = slabcast(dir, &again).env("PATH", path(&bin)).output().unwrap();
    assert_eq!(out.status.code(), Some(1), "{}", text(&out.stderr));
    assert_eq!(names(dir), ["args", "bin", "turn.mp4"]);
}

/// With a real ffmpeg: tags, and colours within two steps of the PNGs.
#[test]
fn a_real_video_has_the_colours_of_the_pictures() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let there = std::process::Command::new("ffmpeg").arg("-version").output();
    if !there.is_ok_and(|out| out.status.success()) {
        eprintln!("skipped: there is no ffmpeg");
        return;
    }
    let draw = |size: &str, to: &str| {
        good(dir, &["render", "formula:spheres:24", "--size", size, "--frames", "3", "-o", to]);
    };
    let line =
        ["render", "formula:spheres:24", "--size", "65x49", "--frames", "2", "-o", "odd.mp4"];
    let said = text(&run(dir, &line).stderr);
    assert!(said.contains("note: odd.mp4: video has even edges: 65x49 becomes 66x50"), "{said}");
    for name in ["turn.mp4", "turn.webm", "turn.gif"] {
        draw("65x49", name);
        let probe =
            std::process::Command::new("ffmpeg").args(["-i", name]).current_dir(dir).output();
        let said = text(&probe.unwrap().stderr);
        if name == "turn.gif" {
            assert!(said.contains("65x49"), "{said}");
        } else {
            assert!(said.contains("yuv420p(tv, bt709/bt709/iec61966-2-1"), "{said}");
            assert!(said.contains("66x50"), "{said}");
        }
    }
    draw("64x48", "even.mp4");
    draw("64x48", "still");
    let line = ["-i", "even.mp4", "-frames:v", "1", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"];
    let out = std::process::Command::new("ffmpeg").args(line).current_dir(dir).output().unwrap();
    let (_, want) = pixels(&dir.join("still/frame_0000.png"));
    assert_eq!(out.stdout.len(), want.len());
    for c in 0..3 {
        let mean = |bytes: &[u8]| {
            bytes.iter().skip(c).step_by(3).map(|b| f64::from(*b)).sum::<f64>() / (64.0 * 48.0)
        };
        let off = mean(&out.stdout) - mean(&want);
        assert!(off.abs() < 2.0, "channel {c} is off by {off}");
    }
}
