//! Volumes in colours, as a user draws, describes, converts and uploads them.

use crate::program::{good, master, run, text, worker};
use std::path::Path;

/// Returns the colour of voxel `at` of a ball of 24 voxels in eight colours, in black.
fn ball(at: [u32; 3]) -> [u8; 3] {
    let d = at.map(|x| f64::from(x) - 11.5);
    if d.iter().map(|x| x * x).sum::<f64>() > 100.0 {
        return [0; 3];
    }
    let side = |a: usize| if d[a] < 0.0 { 240 } else { 60 };
    [side(0), side(1), side(2)]
}

fn write_ball(dir: &Path) {
    let head = "NRRD0004\ntype: uint8\ndimension: 4\nsizes: 3 24 24 24\nencoding: raw\n\
                kinds: RGB-color domain domain domain\n\n";
    let n = 24u32;
    let voxels = (0..n * n * n).flat_map(|at| ball([at % n, at / n % n, at / n / n]));
    let bytes: Vec<u8> = head.bytes().chain(voxels).collect();
    std::fs::write(dir.join("rgb.nrrd"), bytes).unwrap();
}

const VIEW: [&str; 7] = ["--azimuth", "30", "--elevation", "20", "--size", "96x80", "-q"];

fn hash(dir: &Path, volume: &str, more: &[&str]) -> String {
    let args = [&["render", volume, "--stats", "-", "--force"], &VIEW[..], more].concat();
    let stats: serde_json::Value = serde_json::from_str(good(dir, &args).trim()).unwrap();
    assert_eq!(stats["quality"]["classify"], "before");
    stats["pixels_sha256"].as_str().unwrap().to_string()
}

#[test]
fn colours_are_drawn_alike_by_any_cut_and_by_a_cluster_and_are_colours() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    write_ball(dir);
    let want = hash(dir, "rgb.nrrd", &["-o", "here.png"]);
    for more in [
        &["--workers", "1", "--threads", "1", "--tile", "16", "-o", "a.png"][..],
        &["--workers", "2", "--tile", "64", "-o", "a.png"],
        &["--schedule", "slab", "--slabs", "5", "-o", "a.png"],
        &["--cull", "off", "--keep", "empty", "-o", "a.png"],
        // They have one level.
        &["--level", "auto", "-o", "a.png"],
        &["--level", "2", "-o", "a.png"],
    ] {
        assert_eq!(hash(dir, "rgb.nrrd", more), want, "{more:?}");
    }
    let decoder = png::Decoder::new(std::io::BufReader::new(
        std::fs::File::open(dir.join("here.png")).unwrap(),
    ));
    let mut reader = decoder.read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    let each = info.color_type.samples();
    let most = |c: usize| {
        let over = |p: &&[u8]| (0..3).all(|o| o == c || p[c] > p[o].saturating_add(60));
        pixels.chunks(each).filter(over).count()
    };
    // Faces that are all of red, green or blue lie on the ball's side.
    assert!((0..3).filter(|&c| most(c) > 20).count() >= 2, "{:?}", [most(0), most(1), most(2)]);

    good(dir, &["convert", "formula:spheres:16", "other.nrrd", "-q"]);
    let (_master, address) = master(dir, "other.nrrd", &["--uploads", "uploads"]);
    let _worker = worker(dir, &address, "w", &["--threads", "1"]);
    let there = ["--master", address.as_str(), "-o", "there.png"];
    assert_eq!(hash(dir, "rgb.nrrd", &there), want);
    let read = |name: &str| std::fs::read(dir.join(name)).unwrap();
    assert!(read("here.png") == read("there.png"));
    good(dir, &["put", "rgb.nrrd", "--master", &address, "-q"]);
    let listed = good(dir, &["volumes", "--master", &address]);
    assert!(listed.contains("rgb"), "{listed}");
    let again = good(dir, &["rerender", "there.png", "rgb.nrrd"]);
    assert!(again.contains("the same"), "{again}");
}

#[test]
fn colours_are_described_converted_and_picked() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    write_ball(dir);
    let said = good(dir, &["info", "rgb.nrrd"]);
    assert!(said.contains("colours      RGB, 8 bits; 9 of them"), "{said}");
    assert!(said.contains("the luminance that opacity follows"), "{said}");
    let json: serde_json::Value =
        serde_json::from_str(&good(dir, &["info", "rgb.nrrd", "--json"])).unwrap();
    assert_eq!(json["colours"]["channels"], "RGB");
    assert_eq!(json["colours"]["count"], 9);
    let digest = |file: &str| {
        let json = good(dir, &["info", file, "--json"]);
        serde_json::from_str::<serde_json::Value>(&json).unwrap()["digest"].clone()
    };
    for file in ["b.nrrd", "b.nii", "b.nii.gz"] {
        good(dir, &["convert", "rgb.nrrd", file, "-q"]);
        assert_eq!(digest(file), digest("rgb.nrrd"), "{file}");
    }
    good(dir, &["convert", "rgb.nrrd", "raw.nrrd", "--encoding", "raw", "-q"]);
    let [want, got] = ["rgb.nrrd", "raw.nrrd"].map(|f| std::fs::read(dir.join(f)).unwrap());
    let bytes = 3 * 24 * 24 * 24;
    assert!(want[want.len() - bytes..] == got[got.len() - bytes..]);
    let red = good(dir, &["info", "rgb.nrrd", "--channel", "0"]);
    assert!(red.contains("24 x 24 x 24 uint8") && !red.contains("colours  "), "{red}");
}

#[test]
fn what_colours_can_not_have_is_refused_with_a_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    write_ball(dir);
    for (more, say) in [
        (&["--classify", "after"][..], "--classify: the voxels have colours of their own"),
        (&["--kernel", "interpolating"], "--kernel: `interpolating`"),
        (&["--colors", "viridis"], "--colors: the voxels have colours of their own"),
        (&["--color-bar"], "--color-bar: the voxels have colours of their own"),
        (&["--channel", "3"], "--channel: 3 is not there: the file has 3 channels"),
    ] {
        let out = run(dir, &[&["render", "rgb.nrrd", "-o", "x.png"], more].concat());
        let said = text(&out.stderr);
        assert!(said.contains(say), "{more:?}: {said}");
        assert!(!dir.join("x.png").exists());
    }
    let out = run(dir, &["convert", "rgb.nrrd", "rgb.ome.zarr"]);
    let said = text(&out.stderr);
    assert!(said.contains("take one of them with --channel"), "{said}");
    assert!(!out.status.success() && !dir.join("rgb.ome.zarr").exists());
    let out = run(dir, &["lab", "error", "rgb.nrrd", "--azimuth", "30", "--size", "40x40"]);
    assert!(out.status.success(), "{}", text(&out.stderr));
}
