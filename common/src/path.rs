//! View paths: what a client submits and the cameras that follow from it (CONTRACTS.md).

use crate::quality::Refused;
use crate::view::{Camera, CameraProjection};
use crate::volume::Lattice;
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Most frames of one path.
pub const MAX_FRAMES: usize = 100_000;

/// A world axis with a sign, written `+z`, `z` or `-y`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Axis {
    /// 0, 1 or 2.
    pub index: usize,
    /// Whether it points the negative way.
    pub negative: bool,
}

impl Axis {
    /// +x, +y or +z.
    pub const fn positive(index: usize) -> Self {
        Axis { index, negative: false }
    }

    /// As a unit vector.
    pub fn vector(self) -> DVec3 {
        let mut v = [0.0; 3];
        v[self.index] = if self.negative { -1.0 } else { 1.0 };
        DVec3::from_array(v)
    }
}

impl std::str::FromStr for Axis {
    type Err = String;
    fn from_str(s: &str) -> Result<Self, String> {
        let (negative, letter) = match s.as_bytes() {
            [b'-', l] => (true, *l),
            [b'+', l] | [l] => (false, *l),
            _ => (false, b'?'),
        };
        let index = match letter {
            b'x' => 0,
            b'y' => 1,
            b'z' => 2,
            _ => return Err(format!("`{s}` is not an axis; give x, y or z with + or -")),
        };
        Ok(Axis { index, negative })
    }
}

impl std::fmt::Display for Axis {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{}", if self.negative { '-' } else { '+' }, ['x', 'y', 'z'][self.index])
    }
}

impl TryFrom<String> for Axis {
    type Error = String;
    fn try_from(s: String) -> Result<Self, String> {
        s.parse()
    }
}

impl From<Axis> for String {
    fn from(a: Axis) -> String {
        a.to_string()
    }
}

/// `ortho` or `persp`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ProjectionKind {
    /// Parallel.
    #[default]
    Ortho,
    /// Central.
    Persp,
}

/// One explicit camera, in world units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PathView {
    /// Where the eye is.
    pub eye: [f64; 3],
    /// Where it looks.
    pub target: [f64; 3],
    /// What is up.
    pub up: [f64; 3],
    /// Projection.
    pub projection: ProjectionKind,
    /// World height shown (`ortho`; default 1.25 times the largest extent).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
    /// Vertical full field of view in degrees (`persp`; default 30).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fov: Option<f64>,
}

/// A turn about the up axis through the volume's centre.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Turntable {
    /// Azimuth of the first frame, degrees from the front.
    pub start: f64,
    /// Degrees a frame.
    pub step: f64,
    /// Frames.
    pub frames: u32,
    /// Degrees towards up.
    pub elevation: f64,
    /// World height shown at the target; default 1.25 times the largest extent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
    /// Projection.
    pub projection: ProjectionKind,
    /// Vertical full field of view in degrees.
    pub fov: f64,
    /// Up; default what the volume was opened with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<Axis>,
    /// Front; default what the volume was opened with.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub front: Option<Axis>,
}

impl Default for Turntable {
    fn default() -> Self {
        Turntable {
            start: 20.0,
            step: 5.0,
            frames: 18,
            elevation: 0.0,
            height: None,
            projection: ProjectionKind::Ortho,
            fov: 30.0,
            up: None,
            front: None,
        }
    }
}

/// A view path: either views or a turntable.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewPath {
    /// Format version, 1.
    pub version: u32,
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Explicit cameras.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub views: Vec<PathView>,
    /// Or a turn.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turntable: Option<Turntable>,
}

/// Which axes of a volume are up and front.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Orientation {
    /// Up.
    pub up: Axis,
    /// Front.
    pub front: Axis,
}

impl Orientation {
    /// Checks a choice and fills in what is missing: up +z; front +y for up along z, else +z
    /// (CONTRACTS.md; the front of measuring protocols).
    pub fn new(up: Option<Axis>, front: Option<Axis>) -> Result<Self, Refused> {
        let up = up.unwrap_or(Axis::positive(2));
        let front = front.unwrap_or(Axis::positive(if up.index == 2 { 1 } else { 2 }));
        if front.index == up.index {
            return Err(Refused::new(
                "front",
                format!("{front} lies along up ({up}); give another axis"),
            ));
        }
        Ok(Orientation { up, front })
    }
}

impl ViewPath {
    /// A turntable.
    pub fn turn(size: [u32; 2], turntable: Turntable) -> Self {
        ViewPath { version: 1, size, views: Vec::new(), turntable: Some(turntable) }
    }

    /// Reads the JSON of CONTRACTS.md.
    pub fn from_json(text: &str) -> Result<Self, Refused> {
        let path: ViewPath = serde_json::from_str(text)
            .map_err(|e| Refused::new("view path", format!("not valid: {e}")))?;
        path.check()?;
        Ok(path)
    }

    /// Checks version and counts.
    pub fn check(&self) -> Result<(), Refused> {
        if self.version != 1 {
            return Err(Refused::new("version", "this program knows version 1; set it to 1"));
        }
        match (&self.turntable, self.views.len()) {
            (None, 0) => Err(Refused::new("views", "no view; give views or a turntable")),
            (Some(_), 1..) => {
                Err(Refused::new("turntable", "given beside views; leave one of them out"))
            }
            (Some(t), _) if t.frames == 0 || t.frames as usize > MAX_FRAMES => {
                Err(Refused::new("frames", format!("{} frames; give 1 to {MAX_FRAMES}", t.frames)))
            }
            (None, n) if n > MAX_FRAMES => {
                Err(Refused::new("views", format!("{n} views; give at most {MAX_FRAMES}")))
            }
            _ => Ok(()),
        }
    }

    /// Number of frames.
    pub fn frames(&self) -> usize {
        self.turntable.map_or(self.views.len(), |t| t.frames as usize)
    }

    /// The path of frame `i` alone: the same view, to the bit.
    ///
    /// # Panics
    /// If there is no such frame.
    pub fn only(&self, i: usize) -> ViewPath {
        assert!(i < self.frames(), "frame {i} of {}", self.frames());
        match self.turntable {
            // What `camera` adds up for this frame; nothing is added to it for the first.
            Some(t) => {
                let start = t.start + t.step * i as f64;
                ViewPath::turn(self.size, Turntable { start, frames: 1, ..t })
            }
            None => ViewPath { views: vec![self.views[i]], ..self.clone() },
        }
    }

    /// The camera of frame `i`.
    ///
    /// # Errors
    /// Names the field that is not finite or has no meaning.
    pub fn camera(
        &self,
        i: usize,
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<Camera, Refused> {
        let whole = 1.25 * lattice.largest_extent();
        let Some(t) = &self.turntable else {
            let v = &self.views[i];
            let name = |f: &str| format!("views[{i}].{f}");
            let finite = |field: &str, x: [f64; 3]| {
                let v = DVec3::from_array(x);
                if v.is_finite() {
                    Ok(v)
                } else {
                    Err(Refused::new(name(field), "must be finite numbers"))
                }
            };
            let (eye, target) = (finite("eye", v.eye)?, finite("target", v.target)?);
            let up = finite("up", v.up)?;
            let to_eye = eye - target;
            let projection = match v.projection {
                ProjectionKind::Ortho => {
                    CameraProjection::Ortho { height: v.height.unwrap_or(whole) }
                }
                ProjectionKind::Persp => CameraProjection::Persp {
                    fov: v.fov.unwrap_or(30.0),
                    distance: to_eye.length(),
                },
            };
            if to_eye.length() == 0.0 {
                return Err(Refused::new(name("eye"), "is the target; move one of them"));
            }
            return Ok(Camera { to_eye, up, target: target - lattice.centre(), projection });
        };
        for (field, x) in [("start", t.start), ("step", t.step)] {
            if x.is_nan() || x.abs() > 1e9 {
                return Err(Refused::new(field, format!("{x} degrees; give a finite angle")));
            }
        }
        if t.elevation.is_nan() || t.elevation.abs() > 90.0 {
            return Err(Refused::new(
                "elevation",
                format!("{} degrees; give -90 to 90", t.elevation),
            ));
        }
        let o = Orientation::new(
            t.up.or(Some(orientation.up)),
            t.front
                .or((t.up.is_none() || t.up == Some(orientation.up)).then_some(orientation.front)),
        )?;
        let side = Axis::positive(3 - o.up.index - o.front.index).vector();
        let (front, up) = (o.front.vector(), o.up.vector());
        // Whole turns are taken off in degrees, where that is exact.
        let azimuth = libm::fmod(t.start + t.step * i as f64, 360.0);
        let (sin_a, cos_a) = sin_cos_degrees(azimuth);
        let (sin_e, cos_e) = sin_cos_degrees(t.elevation);
        let level = front * cos_a + side * sin_a;
        let height = t.height.unwrap_or(whole);
        let projection = match t.projection {
            ProjectionKind::Ortho => CameraProjection::Ortho { height },
            ProjectionKind::Persp => CameraProjection::Persp {
                fov: t.fov,
                distance: height / 2.0 / libm::tan(t.fov.to_radians() / 2.0),
            },
        };
        Ok(Camera {
            to_eye: level * cos_e + up * sin_e,
            // At right angles to the eye's direction: no pole.
            up: up * cos_e - level * sin_e,
            target: DVec3::ZERO,
            projection,
        })
    }
}

/// Sine and cosine of an angle in degrees, exact at multiples of 90.
fn sin_cos_degrees(degrees: f64) -> (f64, f64) {
    let quarter = libm::round(degrees / 90.0);
    let rest = (degrees - quarter * 90.0).to_radians();
    let (s, c) = (libm::sin(rest), libm::cos(rest));
    match (quarter as i64).rem_euclid(4) {
        0 => (s, c),
        1 => (c, -s),
        2 => (-s, -c),
        _ => (-c, s),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cameras(t: Turntable, up: Option<Axis>) -> Camera {
        let l = Lattice::from_spacing([256; 3], [1.0; 3]);
        let o = Orientation::new(up, None).unwrap();
        ViewPath::turn([512, 512], t).camera(0, &l, o).unwrap()
    }

    #[test]
    fn one_frame_of_a_path_is_the_same_view_to_the_bit() {
        let l = Lattice::from_spacing([9; 3], [1.0; 3]);
        let o = Orientation::new(None, None).unwrap();
        let turn = Turntable { start: 20.1, step: 5.3, frames: 40, ..Turntable::default() };
        let path = ViewPath::turn([4, 4], turn);
        for i in 0..40 {
            let one = path.only(i);
            assert_eq!(one.frames(), 1);
            assert_eq!(path.camera(i, &l, o), one.camera(0, &l, o), "{i}");
            assert_eq!(one.only(0), one);
        }
    }

    #[test]
    fn the_turntable_is_the_measuring_protocols() {
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
    fn perspective_shows_the_same_height_at_the_target() {
        let t = Turntable { projection: ProjectionKind::Persp, ..Turntable::default() };
        let CameraProjection::Persp { fov, distance } = cameras(t, None).projection else {
            panic!("asked for perspective")
        };
        assert!((2.0 * distance * libm::tan(fov.to_radians() / 2.0) - 320.0).abs() < 1e-9);
    }

    #[test]
    fn the_pole_has_an_up() {
        let c = cameras(Turntable { elevation: 90.0, start: 0.0, ..Turntable::default() }, None);
        assert_eq!((c.to_eye, c.up), (DVec3::Z, -DVec3::Y));
    }

    #[test]
    fn json_names_what_is_wrong() {
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
}
