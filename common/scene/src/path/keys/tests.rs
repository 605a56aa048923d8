use super::*;
use crate::path::ViewPath;
use proptest::prelude::*;

fn lattice() -> Lattice {
    Lattice::from_spacing([64; 3], [1.0; 3])
}

fn standing() -> Orientation {
    Orientation::new(None, None).unwrap()
}

fn path(frames: u32, easing: Easing, keys: Vec<Key>) -> ViewPath {
    ViewPath {
        keyframes: Some(KeyFrames { frames, easing, up: None, front: None, keys }),
        ..ViewPath::from_views([64; 2], vec![])
    }
}

fn turned(azimuth: f64, elevation: f64) -> Key {
    Key { azimuth: Some(azimuth), elevation: Some(elevation), ..Key::default() }
}

fn cameras(p: &ViewPath) -> Vec<Camera> {
    p.check().unwrap();
    let ready = p.prepare(&lattice(), standing()).unwrap();
    (0..p.frames()).map(|i| ready.camera(i).unwrap()).collect()
}

#[test]
fn frames_at_keys_from_a_side_have_its_name() {
    let side = |view| Key { view: Some(view), ..Key::default() };
    let keys = vec![side(Side::Left), turned(10.0, 0.0), side(Side::Superior)];
    let all = path(3, Easing::Smooth, keys.clone());
    let names = |p: &ViewPath, n: usize| (0..n).map(|i| p.side_name(i)).collect::<Vec<_>>();
    assert_eq!(names(&all, 4), [Some("left"), None, Some("superior"), None]);
    // Between keys nothing has a name.
    let long = path(5, Easing::Smooth, keys);
    assert_eq!(names(&long, 5), [Some("left"), None, None, None, Some("superior")]);
    assert!(long.has_sides() && !path(2, Easing::Linear, vec![turned(0.0, 0.0)]).has_sides());
}

fn pose(c: &Camera) -> Pose {
    Pose::of(c).unwrap()
}

fn any_key() -> impl Strategy<Value = Key> {
    (-400.0..400.0f64, -80.0..80.0f64, [-9.0..9.0f64, -9.0..9.0, -9.0..9.0], 1.0..500.0f64)
        .prop_map(|(azimuth, elevation, target, height)| Key {
            target: Some(target),
            height: Some(height),
            ..turned(azimuth, elevation)
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn keys_are_hit_exactly_and_nothing_flips_or_jumps(
        keys in prop::collection::vec(any_key(), 2..6), smooth in any::<bool>(), persp in any::<bool>(),
    ) {
        let projection = if persp { ProjectionKind::Persp } else { ProjectionKind::Ortho };
        let keys: Vec<Key> = keys.into_iter().map(|k| Key { projection, ..k }).collect();
        let easing = if smooth { Easing::Smooth } else { Easing::Linear };
        let (n, each) = (keys.len(), 60);
        let frames = each * (n as u32 - 1) + 1;
        let all = cameras(&path(frames, easing, keys.clone()));
        for (i, k) in keys.iter().enumerate() {
            let want = k.camera(&lattice(), standing()).unwrap();
            prop_assert_eq!(all[each as usize * i], want, "key {}", i);
        }
        for pair in all.windows(2) {
            let (a, b) = (pose(&pair[0]), pose(&pair[1]));
            // Half a turn in 60 frames is 3 degrees each; a curve is at most a few times
            // faster. A flip would be half a turn at once.
            prop_assert!(turn::angle(a.turn, b.turn) < 0.6);
            prop_assert!((a.size - b.size).abs() < 0.6 && (a.target - b.target).length() < 4.0);
        }
    }

    #[test]
    fn linear_paths_turn_and_zoom_at_constant_speed(a in any_key(), b in any_key()) {
        let all: Vec<Pose> = cameras(&path(33, Easing::Linear, vec![a, b])).iter().map(pose).collect();
        let steps: Vec<(f64, f64)> = all.windows(2)
            .map(|w| (turn::angle(w[0].turn, w[1].turn), w[1].size - w[0].size)).collect();
        for s in &steps {
            prop_assert!((s.0 - steps[0].0).abs() < 1e-8, "{steps:?}");
            prop_assert!((s.1 - steps[0].1).abs() < 1e-9, "{steps:?}");
        }
    }
}

#[test]
fn a_smooth_path_has_no_jump_of_speed_at_its_keys() {
    let keys = vec![turned(0.0, 0.0), turned(90.0, 30.0), turned(120.0, -20.0), turned(260.0, 0.0)];
    let all: Vec<Pose> = cameras(&path(601, Easing::Smooth, keys)).iter().map(pose).collect();
    let speed = |i: usize| turn::from_to(all[i].turn, all[i + 1].turn);
    for key in [200, 400] {
        let (before, after) = (speed(key - 1), speed(key));
        assert!((before - after).length() < 0.1 * before.length(), "{before} {after}");
    }
}

#[test]
fn a_key_that_repeats_is_a_halt_and_a_zoom_does_not_overshoot() {
    let near = |h: f64| Key { height: Some(h), ..turned(10.0, 0.0) };
    let all =
        cameras(&path(91, Easing::Smooth, vec![near(400.0), near(4.0), near(4.0), near(40.0)]));
    let height = |c: &Camera| match c.projection {
        CameraProjection::Ortho { height } => height,
        CameraProjection::Persp { .. } => panic!("parallel"),
    };
    assert!(all[30..=60].iter().all(|c| (height(c) - 4.0).abs() < 1e-9));
    assert!(all.iter().all(|c| (3.999..=400.001).contains(&height(c))));
    // Half of the zoom in logarithms is done half-way, but for the curve's ends.
    assert!(libm::log(height(&all[15]) / 40.0).abs() < 0.7, "{}", height(&all[15]));
}

#[test]
fn times_may_be_given_and_hold_outside() {
    let at = |at: f64, azimuth: f64| Key { at: Some(at), ..turned(azimuth, 0.0) };
    let p = path(11, Easing::Linear, vec![at(2.0, 0.0), at(6.0, 40.0)]);
    let all = cameras(&p);
    assert_eq!(all[0], all[2]);
    assert_eq!(all[6], all[10]);
    let turn_of = |i: usize| turn::angle(pose(&all[2]).turn, pose(&all[i]).turn).to_degrees();
    assert!((turn_of(3) - 10.0).abs() < 1e-9 && (turn_of(5) - 30.0).abs() < 1e-9);
    let one = path(3, Easing::Smooth, vec![turned(5.0, 6.0)]);
    assert!(cameras(&one).windows(2).all(|w| w[0] == w[1]));
}

#[test]
fn sides_are_those_of_the_body_whichever_way_it_lies() {
    let axis = |a: &str| a.parse::<Axis>().unwrap();
    // RAS, then a head that lies with its crown towards -y and its face towards +z.
    for (up, front) in [("z", "y"), ("-y", "z"), ("x", "-z"), ("-z", "-y"), ("y", "x")] {
        let o = Orientation::new(Some(axis(up)), Some(axis(front))).unwrap();
        let right = o.front.vector().cross(o.up.vector());
        for (side, eye, top) in [
            (Side::Anterior, o.front.vector(), o.up.vector()),
            (Side::Posterior, -o.front.vector(), o.up.vector()),
            (Side::Right, right, o.up.vector()),
            (Side::Left, -right, o.up.vector()),
            (Side::Superior, o.up.vector(), o.front.vector()),
            (Side::Inferior, -o.up.vector(), o.front.vector()),
        ] {
            let (azimuth, elevation) = side.angles(o);
            let (to_eye, up) = super::super::direction(o, azimuth, elevation);
            assert!((to_eye - eye).length() < 1e-12, "{side:?} of {o:?}: {to_eye}");
            assert!((up - top).length() < 1e-12, "{side:?} of {o:?}: {up}");
        }
    }
    let ras = standing();
    let right = ras.front.vector().cross(ras.up.vector());
    assert_eq!(right, DVec3::X, "+x is the right of RAS");
}

#[test]
fn wrong_keys_are_named() {
    let bad = |keys: &str| {
        let text =
            format!(r#"{{"version":1,"size":[9,9],"keyframes":{{"frames":9,"keys":[{keys}]}}}}"#);
        match ViewPath::from_json(&text) {
            Err(e) => e.to_string(),
            Ok(p) => p.prepare(&lattice(), standing()).err().expect("refused").to_string(),
        }
    };
    for (keys, says) in [
        ("", "keyframes.keys"),
        (r#"{"view":"top"}"#, "top"),
        (r#"{"azimut":3}"#, "did you mean `azimuth`"),
        (r#"{"view":"left","eye":[0,0,1]}"#, "keys[0].eye"),
        (r#"{"at":0},{}"#, "`at`"),
        (r#"{"at":5},{"at":5}"#, "keys[1].at"),
        (r#"{"at":9}"#, "keys[0].at"),
        (r#"{},{"projection":"persp"}"#, "keys[1].projection"),
        (r#"{"up":[0,0,1]}"#, "keys[0].up"),
        (r#"{"eye":[0,0,99],"target":[0,0,0],"up":[0,0,1]}"#, "keys[0].up"),
        (r#"{"eye":[1,1,1],"target":[1,1,1]}"#, "keys[0].eye"),
        (r#"{"height":-3}"#, "keys[0].height"),
        (r#"{"elevation":100}"#, "keys[0].elevation"),
        (r#"{"fov":30}"#, "keys[0].fov"),
        (r#"{"tf":3}"#, "tf"),
    ] {
        let said = bad(keys);
        assert!(said.contains(says), "{keys}: {said}");
    }
}
