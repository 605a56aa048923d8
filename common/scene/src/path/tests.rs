use super::*;
use slabcast_common::volume::{Samples, ValueMap};

fn cameras(t: Turntable, up: Option<Axis>) -> Camera {
    let l = Lattice::from_spacing([256; 3], [1.0; 3]);
    let o = Orientation::new(up, None).unwrap();
    ViewPath::from_turntable([512, 512], t).camera(0, &l, o).unwrap()
}

#[test]
fn single_frame_of_a_path_is_the_same_view_to_the_bit() {
    let l = Lattice::from_spacing([9; 3], [1.0; 3]);
    let o = Orientation::new(None, None).unwrap();
    let turn = Turntable { start: 20.1, step: 5.3, frames: 40, ..Turntable::default() };
    let path = ViewPath::from_turntable([4, 4], turn);
    for i in 0..40 {
        let one = path.single_frame(i);
        assert_eq!(one.frames(), 1);
        assert_eq!(path.camera(i, &l, o), one.camera(0, &l, o), "{i}");
        assert_eq!(one.single_frame(0), one);
    }
}

#[test]
fn orientation_of_a_ct_without_axes_has_its_front_at_minus_y() {
    // Air, soft tissue and bone in Hounsfield units.
    let values = [(-1000.0, 500), (-40.0, 250), (60.0, 250), (900.0, 40)];
    let ct: Vec<f32> =
        values.iter().flat_map(|&(hu, n)| std::iter::repeat_n(hu as f32, n)).collect();
    let summary = |v: Vec<f32>| ValueSummary::from_samples(&Samples::F32(v), ValueMap::IDENTITY);
    let mr = summary(ct.iter().map(|v| v + 5000.0).collect());
    let ct = summary(ct);
    let front = |up: Option<&str>, summary, anatomical| {
        let up = up.map(|a| a.parse().unwrap());
        Orientation::for_volume(up, None, summary, anatomical).unwrap().front.to_string()
    };
    assert_eq!(front(None, &ct, false), "-y");
    assert_eq!(front(Some("z"), &ct, false), "-y");
    // Who says what is up, or knows, has no scanner's slices; other values are no CT's.
    assert_eq!(front(Some("-z"), &ct, false), "+y");
    assert_eq!(front(Some("y"), &ct, false), "+z");
    assert_eq!(front(None, &ct, true), "+y");
    assert_eq!(front(None, &mr, false), "+y");
    let given = Orientation::for_volume(None, Some(Axis::positive(0)), &ct, false).unwrap();
    assert_eq!(given.front, Axis::positive(0));
}

#[test]
fn turntable_starts_as_in_the_measuring_protocol() {
    // Direction sin t on the first remaining axis, cos t on the second; height 320.
    let (s, c) = (libm::sin(20f64.to_radians()), libm::cos(20f64.to_radians()));
    for (up, want) in [
        (None, DVec3::new(s, c, 0.0)),
        (Some("-y"), DVec3::new(s, 0.0, c)),
        (Some("x"), DVec3::new(0.0, s, c)),
    ] {
        let got = cameras(Turntable::default(), up.map(|a| a.parse().unwrap()));
        assert!((got.to_eye - want).length() < 1e-12, "{up:?}: {}", got.to_eye);
        assert_eq!(got.projection, CameraProjection::Ortho { height: 320.0 });
    }
}

#[test]
fn perspective_turntable_shows_its_height_at_the_target() {
    let t = Turntable { projection: ProjectionKind::Persp, ..Turntable::default() };
    let CameraProjection::Persp { fov, distance } = cameras(t, None).projection else {
        panic!("asked for perspective")
    };
    assert!((2.0 * distance * libm::tan(fov.to_radians() / 2.0) - 320.0).abs() < 1e-9);
}

#[test]
fn turntable_has_an_up_at_the_pole() {
    let c = cameras(Turntable { elevation: 90.0, start: 0.0, ..Turntable::default() }, None);
    assert_eq!((c.to_eye, c.up), (DVec3::Z, -DVec3::Y));
}

#[test]
fn path_json_errors_name_the_field() {
    let bad = |text: &str| ViewPath::from_json(text).unwrap_err().to_string();
    assert!(bad(r#"{"version":1,"size":[9,9]}"#).contains("views"));
    assert!(bad(r#"{"version":1,"size":[9,9],"turntabel":{}}"#).contains("turntabel"));
    assert!(bad(r#"{"version":1,"size":[9,9],"turntable":{"frames":0}}"#).contains("frames"));
    let path = ViewPath::from_json(
        r#"{"version":1,"size":[9,9],"views":[{"eye":[0,0,0],"target":[0,0,0],"up":[0,0,1],
        "projection":"persp","fov":30}]}"#,
    )
    .unwrap();
    let l = Lattice::from_spacing([4; 3], [1.0; 3]);
    let o = Orientation::new(None, None).unwrap();
    assert_eq!(path.camera(0, &l, o).unwrap_err().field, "views[0].eye");
    assert!(Orientation::new(Some(Axis::positive(1)), Some(Axis::positive(1))).is_err());
}
