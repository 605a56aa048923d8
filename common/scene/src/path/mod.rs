//! View paths: what a client submits and the cameras that follow from it
//! (docs/design/contracts.md).
//!
//! A path is one of four: explicit [`views`](ViewPath::views), a [`Turntable`], [`KeyFrames`], a
//! [`FlyThrough`]. Beside it stand what holds for all frames: a [`Crop`], and a range of frames
//! that keep their numbers.

mod crop;
mod fly;
mod framing;
mod keys;
mod turn;

pub use crop::{Crop, CropBox, CropUnit};
pub use fly::FlyThrough;
pub use framing::{FILL, Fit, Framing};
pub use keys::{Easing, Key, KeyFrames, MAX_KEYS, Side};

use crate::presets::Levels;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slabcast_common::quality::{InvalidField, json_error};
use slabcast_common::view::{Camera, CameraProjection};
use slabcast_common::volume::{Lattice, ValueSummary};

/// Largest number of frames that one path may have; a path with more is refused.
pub const MAX_FRAMES: usize = 100_000;

/// A world axis with a sign, written `+z`, `z` or `-y`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Axis {
    /// Index of the axis: 0, 1 or 2 for x, y or z.
    pub index: usize,
    /// Whether the axis points the negative way.
    pub negative: bool,
}

impl Axis {
    /// Returns +x, +y or +z for index 0, 1 or 2.
    pub const fn positive(index: usize) -> Self {
        Axis { index, negative: false }
    }

    /// Returns the axis as a unit vector.
    ///
    /// # Panics
    /// If the index is above 2.
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

/// Kind of projection: `ortho` or `persp`.
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
    /// Position of the eye in world units.
    pub eye: [f64; 3],
    /// Point that the eye looks at, in world units.
    pub target: [f64; 3],
    /// Up direction of the picture in world axes, of any length.
    pub up: [f64; 3],
    /// Kind of projection: parallel or central.
    pub projection: ProjectionKind,
    /// World height shown (`ortho`); default 1.25 times the largest extent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
    /// Vertical full field of view in degrees (`persp`); default 30.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fov: Option<f64>,
}

/// A turn about the up axis through the target.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Turntable {
    /// Azimuth of the first frame in degrees from the front.
    pub start: f64,
    /// Angle between neighbouring frames, in degrees of azimuth.
    pub step: f64,
    /// Number of frames, 1 to [`MAX_FRAMES`].
    pub frames: u32,
    /// Elevation of the eye in degrees towards up, -90 to 90.
    pub elevation: f64,
    /// Point that the eye looks at, in world units; default as [`ViewPath::fit`] says.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<[f64; 3]>,
    /// World height shown at the target; default as [`ViewPath::fit`] says.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
    /// Kind of projection: parallel or central.
    pub projection: ProjectionKind,
    /// Vertical full field of view in degrees (`persp`).
    pub fov: f64,
    /// Up axis; default that of the volume.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<Axis>,
    /// Front axis, at azimuth 0; default that of the volume.
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
            target: None,
            height: None,
            projection: ProjectionKind::Ortho,
            fov: 30.0,
            up: None,
            front: None,
        }
    }
}

/// A view path: exactly one of `views`, `turntable`, `keyframes` and `flythrough`, and what holds
/// for all its frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewPath {
    /// Version of the path format; 1 is the only one.
    pub version: u32,
    /// Width and height of the pictures in pixels.
    pub size: [u32; 2],
    /// Explicit cameras, one for each frame; empty where another field makes the path.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub views: Vec<PathView>,
    /// Turn about the up axis; `None` where another field makes the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub turntable: Option<Turntable>,
    /// Key frames joined by curves; `None` where another field makes the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub keyframes: Option<KeyFrames>,
    /// Flight through points; `None` where another field makes the path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flythrough: Option<FlyThrough>,
    /// Box outside of which the volume counts as empty; `None` for the whole volume.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub crop: Option<Crop>,
    /// Content that a turntable or keys without target and height frame.
    #[serde(default, skip_serializing_if = "Fit::is_volume")]
    pub fit: Fit,
    /// First and last frame that are wanted, both included; all if `None`. Frames keep their
    /// numbers on the whole path.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[u32; 2]>,
}

/// Up and front axes of a volume.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Orientation {
    /// World axis that points up in pictures.
    pub up: Axis,
    /// Axis that points to the front of the volume: anterior, for anatomical files.
    pub front: Axis,
}

impl Orientation {
    /// Fills in what is missing: up +z; front +y for up along z, else +z
    /// (docs/design/contracts.md).
    ///
    /// # Errors
    /// Names `front` if it lies along up.
    pub fn new(up: Option<Axis>, front: Option<Axis>) -> Result<Self, InvalidField> {
        let up = up.unwrap_or(Axis::positive(2));
        let front = front.unwrap_or(Axis::positive(if up.index == 2 { 1 } else { 2 }));
        if front.index == up.index {
            return Err(InvalidField::new(
                "front",
                format!("{front} lies along up ({up}); give another axis"),
            ));
        }
        Ok(Orientation { up, front })
    }

    /// Fills in what is missing as [`Orientation::new`], for a volume with values `summary`.
    /// `anatomical` says whether its file knows how the patient lies.
    ///
    /// A CT whose file does not know is taken as scanners store slices (patient on the back, rows
    /// from anterior to posterior, DICOM's axes): its front is -y. Seen from +y, a couch hides the
    /// patient.
    ///
    /// # Errors
    /// Names `front` if it lies along up.
    pub fn for_volume(
        up: Option<Axis>,
        front: Option<Axis>,
        summary: &ValueSummary,
        anatomical: bool,
    ) -> Result<Self, InvalidField> {
        let upright = up.is_none_or(|up| up == Axis::positive(2));
        let scanned = !anatomical && upright && Levels::from_summary(summary).water.is_some();
        let usual = scanned.then_some(Axis { index: 1, negative: true });
        Orientation::new(up, front.or(usual))
    }

    /// Returns these axes, unless a path has others of its own.
    fn or_else(self, up: Option<Axis>, front: Option<Axis>) -> Result<Self, InvalidField> {
        let same_up = up.is_none_or(|up| up == self.up);
        Orientation::new(up.or(Some(self.up)), front.or(same_up.then_some(self.front)))
    }
}

impl ViewPath {
    /// Returns a path of explicit cameras, for pictures of `size` (width, height) pixels.
    pub fn from_views(size: [u32; 2], views: Vec<PathView>) -> Self {
        ViewPath {
            version: 1,
            size,
            views,
            turntable: None,
            keyframes: None,
            flythrough: None,
            crop: None,
            fit: Fit::Volume,
            range: None,
        }
    }

    /// Returns the path of a turntable, for pictures of `size` (width, height) pixels.
    pub fn from_turntable(size: [u32; 2], turntable: Turntable) -> Self {
        ViewPath { turntable: Some(turntable), ..ViewPath::from_views(size, Vec::new()) }
    }

    /// Reads and checks the JSON of docs/design/contracts.md.
    ///
    /// # Errors
    /// If the text is not such JSON, or as [`ViewPath::check`].
    pub fn from_json(text: &str) -> Result<Self, InvalidField> {
        let path: ViewPath = serde_json::from_str(text).map_err(|e| json_error("view path", &e))?;
        path.check()?;
        Ok(path)
    }

    /// Checks version, counts, and whatever needs no volume.
    ///
    /// # Errors
    /// Names the field that is missing, given twice, out of range or not finite.
    pub fn check(&self) -> Result<(), InvalidField> {
        if self.version != 1 {
            return Err(InvalidField::new("version", "this program knows version 1; set it to 1"));
        }
        let kinds = [
            ("views", !self.views.is_empty()),
            ("turntable", self.turntable.is_some()),
            ("keyframes", self.keyframes.is_some()),
            ("flythrough", self.flythrough.is_some()),
        ];
        let given: Vec<&str> = kinds.iter().filter(|k| k.1).map(|k| k.0).collect();
        match given[..] {
            [] => {
                return Err(InvalidField::new(
                    "views",
                    "no view; give views, a turntable, keyframes or a flythrough",
                ));
            }
            [first, second, ..] => {
                let problem = format!("given beside {first}; leave one of them out");
                return Err(InvalidField::new(second, problem));
            }
            [_] => {}
        }
        let n = self.all_frames();
        if n > MAX_FRAMES && !self.views.is_empty() {
            return Err(InvalidField::new(
                "views",
                format!("{n} views; give at most {MAX_FRAMES}"),
            ));
        }
        if n == 0 || n > MAX_FRAMES {
            return Err(InvalidField::new("frames", format!("{n} frames; give 1 to {MAX_FRAMES}")));
        }
        self.keyframes.as_ref().map_or(Ok(()), KeyFrames::check)?;
        self.flythrough.as_ref().map_or(Ok(()), FlyThrough::check)?;
        self.crop.as_ref().map_or(Ok(()), Crop::check)?;
        if self.fit == Fit::Visible && self.turntable.is_none() && self.keyframes.is_none() {
            let problem = "goes with a turntable or keyframes: views and flights say themselves \
                           where they look; leave it out";
            return Err(InvalidField::new("fit", problem));
        }
        if let Some([first, last]) = self.range
            && (first > last || last as usize >= self.all_frames())
        {
            return Err(InvalidField::new(
                "range",
                format!("{first}..{last}; the path has frames 0 to {}", self.all_frames() - 1),
            ));
        }
        Ok(())
    }

    /// Returns the number of frames of the whole path.
    fn all_frames(&self) -> usize {
        let counts = [
            self.turntable.map(|t| t.frames),
            self.keyframes.as_ref().map(|k| k.frames),
            self.flythrough.as_ref().map(|f| f.frames),
        ];
        counts.into_iter().flatten().next().map_or(self.views.len(), |n| n as usize)
    }

    /// Returns the number of frames that are wanted of the path.
    pub fn frames(&self) -> usize {
        self.range.map_or(self.all_frames(), |[first, last]| (last - first) as usize + 1)
    }

    /// Returns the number of the first wanted frame on the whole path.
    pub fn first_frame(&self) -> usize {
        self.range.map_or(0, |[first, _]| first as usize)
    }

    /// Returns whether frames of the path may be views from sides of the body.
    pub fn has_sides(&self) -> bool {
        self.keyframes.as_ref().is_some_and(|k| k.keys.iter().any(|key| key.view.is_some()))
    }

    /// Returns the name of the side of the body that a frame is seen from, by its number on the
    /// whole path; `None` for frames between keys and from elsewhere.
    pub fn side_name(&self, number: usize) -> Option<&'static str> {
        let side = self.keyframes.as_ref()?.key_at(number)?.view?;
        Side::NAMES.iter().find(|(_, s)| *s == side).map(|(name, _)| *name)
    }

    /// Returns the path of one frame alone, by its number on the whole path: the same view, to the
    /// bit.
    ///
    /// # Panics
    /// If that frame is not wanted.
    pub fn single_frame(&self, number: usize) -> ViewPath {
        let first = self.first_frame();
        assert!((first..first + self.frames()).contains(&number), "frame {number}");
        let one = ViewPath { range: None, ..self.clone() };
        match self.turntable {
            // The azimuth that `camera` computes for this frame becomes the start of a turntable of
            // one frame.
            Some(t) => {
                let start = t.start + t.step * number as f64;
                ViewPath { turntable: Some(Turntable { start, frames: 1, ..t }), ..one }
            }
            None if !self.views.is_empty() => ViewPath { views: vec![self.views[number]], ..one },
            // A frame between keys depends on all of them.
            None => ViewPath { range: Some([number as u32; 2]), ..one },
        }
    }

    /// Returns the camera of wanted frame `i` (counted from 0) of a volume on `lattice`.
    ///
    /// # Errors
    /// Names the field that is not finite or has no meaning.
    pub fn camera(
        &self,
        i: usize,
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<Camera, InvalidField> {
        self.prepare(lattice, orientation)?.camera(i)
    }

    /// Prepares the cameras of all frames once, for a volume on `lattice`.
    ///
    /// # Errors
    /// Names the field that has no meaning.
    pub fn prepare(
        &self,
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<Cameras<'_>, InvalidField> {
        let curve = if let Some(keys) = &self.keyframes {
            Curve::Keys(keys.prepare(lattice, orientation)?)
        } else if let Some(f) = &self.flythrough {
            Curve::Flight(f.prepare(lattice, orientation)?, f.frames as usize)
        } else {
            Curve::None
        };
        Ok(Cameras { path: self, prepared: Prepared { lattice: *lattice, orientation, curve } })
    }
}

enum Curve {
    None,
    Keys(keys::KeyedPath),
    Flight(fly::Flight, usize),
}

/// The cameras of a path, in any order.
pub struct Cameras<'a> {
    path: &'a ViewPath,
    prepared: Prepared,
}

impl Cameras<'_> {
    /// Returns the camera of wanted frame `i` (counted from 0).
    ///
    /// # Errors
    /// Names the field that is not finite or has no meaning.
    pub fn camera(&self, i: usize) -> Result<Camera, InvalidField> {
        self.prepared.camera(self.path, i)
    }

    /// Returns what was prepared, without the path: for whoever keeps both.
    pub fn into_prepared(self) -> Prepared {
        self.prepared
    }
}

/// Lattice, orientation and curve from which the camera of each frame of a path is made. Its size
/// grows with the number of keys or points, not with the number of frames.
pub struct Prepared {
    lattice: Lattice,
    orientation: Orientation,
    curve: Curve,
}

impl Prepared {
    /// Returns the camera of wanted frame `i` (counted from 0) of `path`, for which this was
    /// prepared ([`ViewPath::prepare`]).
    ///
    /// # Errors
    /// Names the field that is not finite or has no meaning.
    pub fn camera(&self, path: &ViewPath, i: usize) -> Result<Camera, InvalidField> {
        let i = path.first_frame() + i;
        match (&self.curve, &path.turntable) {
            (Curve::Keys(keys), _) => Ok(keys.at(i as f64)),
            (Curve::Flight(flight, frames), _) => Ok(flight.frame(i, *frames)),
            (Curve::None, Some(t)) => t.camera(i, &self.lattice, self.orientation),
            (Curve::None, None) => path.views[i].camera(i, &self.lattice),
        }
    }

    /// Returns the bytes that it takes beside its own size.
    pub fn held_bytes(&self) -> usize {
        match &self.curve {
            Curve::None => 0,
            Curve::Keys(keys) => keys.held_bytes(),
            Curve::Flight(flight, _) => flight.held_bytes(),
        }
    }
}

impl PathView {
    fn camera(&self, i: usize, lattice: &Lattice) -> Result<Camera, InvalidField> {
        let name = |f: &str| format!("views[{i}].{f}");
        let finite = |field: &str, x: [f64; 3]| {
            let v = DVec3::from_array(x);
            if v.is_finite() {
                Ok(v)
            } else {
                Err(InvalidField::new(name(field), "must be finite numbers"))
            }
        };
        let (eye, target) = (finite("eye", self.eye)?, finite("target", self.target)?);
        let up = finite("up", self.up)?;
        let to_eye = eye - target;
        let projection = match self.projection {
            ProjectionKind::Ortho => CameraProjection::Ortho {
                height: self.height.unwrap_or(1.25 * lattice.largest_extent()),
            },
            ProjectionKind::Persp => {
                CameraProjection::Persp { fov: self.fov.unwrap_or(30.0), distance: to_eye.length() }
            }
        };
        if to_eye.length() == 0.0 {
            return Err(InvalidField::new(name("eye"), "is the target; move one of them"));
        }
        Ok(Camera { to_eye, up, target: target - lattice.centre(), projection })
    }
}

impl Turntable {
    fn camera(
        &self,
        i: usize,
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<Camera, InvalidField> {
        let t = self;
        for (field, x) in [("start", t.start), ("step", t.step)] {
            if x.is_nan() || x.abs() > 1e9 {
                return Err(InvalidField::new(field, format!("{x} degrees; give a finite angle")));
            }
        }
        if t.elevation.is_nan() || t.elevation.abs() > 90.0 {
            return Err(InvalidField::new(
                "elevation",
                format!("{} degrees; give -90 to 90", t.elevation),
            ));
        }
        let o = orientation.or_else(t.up, t.front)?;
        let height = t.height.unwrap_or(1.25 * lattice.largest_extent());
        let projection = match t.projection {
            ProjectionKind::Ortho => CameraProjection::Ortho { height },
            ProjectionKind::Persp => CameraProjection::Persp {
                fov: t.fov,
                distance: height / 2.0 / libm::tan(t.fov.to_radians() / 2.0),
            },
        };
        let (to_eye, up) = direction(o, t.start + t.step * i as f64, t.elevation);
        let target = match t.target.map(DVec3::from_array) {
            None => DVec3::ZERO,
            Some(target) if target.is_finite() => target - lattice.centre(),
            Some(_) => return Err(InvalidField::new("target", "must be finite numbers")),
        };
        Ok(Camera { to_eye, up, target, projection })
    }
}

/// Returns the direction to the eye and the picture's up for an azimuth and an elevation in
/// degrees.
fn direction(o: Orientation, azimuth: f64, elevation: f64) -> (DVec3, DVec3) {
    let side = Axis::positive(3 - o.up.index - o.front.index).vector();
    let (front, up) = (o.front.vector(), o.up.vector());
    // Whole turns are taken off in degrees, where that is exact.
    let (sin_a, cos_a) = sin_cos_degrees(libm::fmod(azimuth, 360.0));
    let (sin_e, cos_e) = sin_cos_degrees(elevation);
    let level = front * cos_a + side * sin_a;
    // Up is at right angles to the eye's direction: no pole.
    (level * cos_e + up * sin_e, up * cos_e - level * sin_e)
}

/// Returns sine and cosine of an angle in degrees, exact at multiples of 90.
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
mod tests;
