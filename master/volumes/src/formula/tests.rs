use super::*;
use slabcast_common::volume::SampleKind;

fn formula(text: &str) -> Volume {
    open(text).unwrap_or_else(|e| panic!("{text}: {e}"))
}

#[test]
fn formula_volumes_open_in_awkward_sizes() {
    for (name, _) in NAMES {
        let v = formula(&format!("formula:{name}"));
        assert_eq!(v.name, format!("formula:{name}"));
        assert_eq!(v.lattice.check(), Ok(()));
        let (lo, hi) = v.summary.range();
        assert!(hi > lo || matches!(name, "full" | "one"), "{name} is empty");
        if name == "one" {
            continue;
        }
        for n in [1, 2, 3, 7, 33] {
            let dims = formula(&format!("formula:{name}:{n}")).lattice.dims;
            assert_eq!(dims, if name == "line" { [n, 1, 1] } else { [n; 3] });
        }
        let awkward = formula(&format!("formula:{name}:5x1x17"));
        assert_eq!(awkward.lattice.dims, [5, 1, 17]);
    }
}

#[test]
fn formula_refuses_unknown_names_and_bad_sizes() {
    let blown = format!("formula:wall:{}", "9".repeat(400));
    for text in [
        "formula:",
        "formula:nope",
        "formula:nope:4",
        "formula:wall:",
        "formula:wall:0",
        "formula:wall:-4",
        "formula:wall:4x4",
        "formula:wall:4x4x4x4",
        "formula:wall:16385x1x1",
        "formula:wall:4096",
        "formula:wall:4:4",
        "formula:one:2",
        &blown,
    ] {
        let e = open(text).unwrap_err().to_string();
        assert!(e.contains("; give ") && e.len() < 300, "{text}: {e}");
    }
}

#[test]
fn formula_marker_distinguishes_all_axes_and_directions() {
    let v = formula("formula:marker:40");
    let at = |x: f64, y: f64, z: f64| {
        let i = [x, y, z].map(|c| ((c + 1.0) * 20.0) as usize);
        v.samples.code(i[0] + 40 * (i[1] + 40 * i[2]))
    };
    assert_eq!(at(0.0, 0.0, 0.0), 100.0);
    assert_eq!((at(0.7, 0.0, 0.0), at(-0.7, 0.0, 0.0)), (160.0, 0.0));
    assert_eq!((at(0.0, 0.7, 0.0), at(0.0, -0.7, 0.0)), (200.0, 0.0));
    assert_eq!((at(0.0, 0.0, 0.7), at(0.0, 0.0, -0.7)), (250.0, 0.0));
}

#[test]
fn formula_values_match_hand_computed_answers() {
    let count =
        |v: &Volume, code: f64| (0..v.samples.len()).filter(|&i| v.samples.code(i) == code).count();
    assert_eq!(count(&formula("formula:wall:16"), 200.0), 8 * 8 * 8);
    let two = formula("formula:two-walls:16");
    assert_eq!((count(&two, 100.0), count(&two, 200.0)), (12 * 12 * 2, 12 * 12 * 2));
    let ramp = formula("formula:ramp:9");
    let m = ramp.gradient_matrix();
    for p in [[0, 0, 0], [4, 4, 4], [8, 0, 8]] {
        assert_eq!(ramp.gradient(p, &m), glam::DVec3::X);
    }
    let blob = formula("formula:blob:33");
    assert_eq!(blob.samples.code(16 * (1 + 33 + 33 * 33)), 65535.0);
    assert_eq!(blob.summary.range().1, 255.0);
    let fog = formula("formula:fog");
    assert!(fog.summary.min_code >= 2.0 && fog.summary.max_code <= 14.0);
    let kinds = ["wall", "blob", "ramp"].map(|n| formula(&format!("formula:{n}")).summary.kind);
    assert_eq!(kinds, [SampleKind::U8, SampleKind::U16, SampleKind::F32]);
}

#[test]
fn formula_digests_are_the_same_on_every_machine() {
    // Golden frames depend on these digests.
    for (name, start) in [
        ("wall", "cb8666f2e156c6f1"),
        ("two-walls", "ed4e5af521a120fc"),
        ("ramp", "89e6a2614988cdc2"),
        ("blob", "863c70f158798fb5"),
        ("bell", "3d77739b8a1aa35e"),
        ("marker", "e69074140a777661"),
        ("spheres", "fe81a76a7a131a28"),
        ("fog", "759719e53f09e1d3"),
        ("full", "6759ffc8bcf8986e"),
        ("one", "1fef9f02ad4d6c51"),
        ("line", "8ef13b398290d1df"),
    ] {
        let digest = formula(&format!("formula:{name}")).digest().to_string();
        assert_eq!(&digest[..16], start, "{name}");
    }
}
