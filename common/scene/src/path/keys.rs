//! Key frames: cameras that a path passes, and what lies between.
//!
//! A camera is taken apart into what people move: the turn of the eye's axes (a quaternion), the
//! target, and the logarithm of the world height shown there, so that a zoom from 400 to 4 mm takes
//! as long for each halving. `smooth` joins them by curves whose speed does not jump at a key,
//! `linear` by arcs and lines of constant speed. Keys themselves are drawn exactly as they are
//! written. Between two keys the eye turns the short way: a whole turn takes three keys.

use super::{Axis, Orientation, ProjectionKind, turn};
use crate::transfer::TransferChoice;
use glam::{DMat3, DQuat, DVec3};
use serde::{Deserialize, Serialize};
use slabcast_common::quality::InvalidField;
use slabcast_common::view::{Camera, CameraProjection};
use slabcast_common::volume::Lattice;

/// Largest number of keys that one path may have; [`KeyFrames`] with more are refused.
pub const MAX_KEYS: usize = 10_000;

/// Kind of motion between two keys of a path.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Easing {
    /// Curves whose speed does not jump at keys.
    #[default]
    Smooth,
    /// Arcs and lines of constant speed.
    Linear,
}

/// Side of the body that the eye looks from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Side {
    /// From the front.
    Anterior,
    /// From behind.
    Posterior,
    /// From the body's own left.
    Left,
    /// From its right.
    Right,
    /// From above, front up.
    Superior,
    /// From below, front up.
    Inferior,
}

impl Side {
    /// All six sides of an anatomical volume, each with the name that a user writes.
    pub const NAMES: [(&'static str, Side); 6] = [
        ("anterior", Side::Anterior),
        ("left", Side::Left),
        ("superior", Side::Superior),
        ("posterior", Side::Posterior),
        ("right", Side::Right),
        ("inferior", Side::Inferior),
    ];

    /// Returns azimuth and elevation in degrees for a volume of this orientation. Front is anterior
    /// and up is superior; right is then to the right hand of the body.
    pub fn angles(self, o: Orientation) -> (f64, f64) {
        // Azimuths grow towards the positive side axis, which is the right only if front, up
        // and side are turned like anterior, superior and right.
        let right = o.front.vector().cross(o.up.vector());
        let towards_right = if right.max_element() > 0.5 { 90.0 } else { -90.0 };
        match self {
            Side::Anterior => (0.0, 0.0),
            Side::Posterior => (180.0, 0.0),
            Side::Right => (towards_right, 0.0),
            Side::Left => (-towards_right, 0.0),
            Side::Superior => (180.0, 90.0),
            Side::Inferior => (0.0, -90.0),
        }
    }
}

/// One key: a camera, and perhaps a transfer function.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Key {
    /// Frame at which the path passes the key; need not be whole. Either all keys have it, or none:
    /// then they lie evenly between the first and the last frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub at: Option<f64>,
    /// Side from which the volume is seen. Excludes `azimuth` and `elevation`, and `eye`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub view: Option<Side>,
    /// Azimuth of the eye in degrees from the front.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub azimuth: Option<f64>,
    /// Elevation of the eye in degrees towards up, -90 to 90.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub elevation: Option<f64>,
    /// Position of the eye in world units.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub eye: Option<[f64; 3]>,
    /// Point that the eye looks at, in world units; default the volume's centre.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub target: Option<[f64; 3]>,
    /// Up direction of the picture in world axes, of any length; only beside `eye`. `None` takes
    /// the volume's up.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
    /// Kind of projection, the same for all keys.
    pub projection: ProjectionKind,
    /// World height shown at the target; default 1.25 times the largest extent. Not beside `eye` in
    /// perspective, where the distance determines it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<f64>,
    /// Vertical full field of view in degrees (`persp`); default 30.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fov: Option<f64>,
    /// Transfer function from here on, tweened to the next key that has one; default the path's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tf: Option<TransferChoice>,
}

/// Key frames: cameras that the path passes, and the motion between.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyFrames {
    /// Number of frames of the path.
    pub frames: u32,
    /// Kind of motion between neighbouring keys: smooth or at constant speed.
    #[serde(default)]
    pub easing: Easing,
    /// Axis that points up in pictures; `None` takes the volume's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<Axis>,
    /// Axis that faces the eye at azimuth 0; `None` takes the volume's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub front: Option<Axis>,
    /// The keys, ascending in time; 1 to [`MAX_KEYS`].
    pub keys: Vec<Key>,
}

impl KeyFrames {
    /// Checks counts, times, and which fields go together.
    ///
    /// # Errors
    /// Names the key and its field.
    pub fn check(&self) -> Result<(), InvalidField> {
        let refuse = |field: String, problem: String| Err(InvalidField::new(field, problem));
        if self.keys.is_empty() || self.keys.len() > MAX_KEYS {
            return refuse(
                "keyframes.keys".into(),
                format!("{} keys; give 1 to {MAX_KEYS}", self.keys.len()),
            );
        }
        let timed = self.keys.iter().filter(|k| k.at.is_some()).count();
        if timed != 0 && timed != self.keys.len() {
            return refuse(
                "keyframes.keys".into(),
                "some have `at`, some not; give it to all or to none".into(),
            );
        }
        let kind = self.keys[0].projection;
        for (i, k) in self.keys.iter().enumerate() {
            let field = |name: &str| format!("keyframes.keys[{i}].{name}");
            if let Some(at) = k.at
                && !(at.is_finite() && at >= 0.0 && at <= f64::from(self.frames.max(1) - 1))
            {
                return refuse(
                    field("at"),
                    format!("{at}; give a frame from 0 to {}", self.frames.max(1) - 1),
                );
            }
            if i > 0 && k.at.is_some() && k.at <= self.keys[i - 1].at {
                return refuse(field("at"), "is not after the key before; sort them".into());
            }
            if k.projection != kind {
                return refuse(
                    field("projection"),
                    "differs from the first key's; give one projection".into(),
                );
            }
            let angles = k.azimuth.is_some() || k.elevation.is_some();
            if [k.view.is_some(), angles, k.eye.is_some()].iter().filter(|&&x| x).count() > 1 {
                return refuse(field("eye"), "give one of view, azimuth and elevation, eye".into());
            }
            if k.up.is_some() && k.eye.is_none() {
                return refuse(field("up"), "goes with `eye`; leave it out".into());
            }
            if k.fov.is_some() && kind == ProjectionKind::Ortho {
                return refuse(
                    field("fov"),
                    "goes with \"projection\": \"persp\"; leave it out".into(),
                );
            }
            if k.height.is_some() && k.eye.is_some() && kind == ProjectionKind::Persp {
                return refuse(field("height"), "the eye's distance says it; leave it out".into());
            }
        }
        Ok(())
    }

    /// Returns the time of key `i` in frames.
    pub(crate) fn time(&self, i: usize) -> f64 {
        let last = f64::from(self.frames.max(1) - 1);
        self.keys[i].at.unwrap_or_else(|| match self.keys.len() {
            1 => 0.0,
            n => last * i as f64 / (n - 1) as f64,
        })
    }

    /// Returns the key that a frame of this number is exactly at.
    pub(super) fn key_at(&self, number: usize) -> Option<&Key> {
        let (wanted, mut first, mut end) = (number as f64, 0, self.keys.len());
        while first < end {
            let middle = (first + end) / 2;
            if self.time(middle) < wanted { first = middle + 1 } else { end = middle }
        }
        self.keys.get(first).filter(|_| self.time(first) == wanted)
    }

    /// Makes all cameras ready.
    ///
    /// # Errors
    /// Names the key and its field.
    pub(super) fn prepare(
        &self,
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<KeyedPath, InvalidField> {
        let orientation = orientation.or_else(self.up, self.front)?;
        let mut keys = Vec::with_capacity(self.keys.len());
        for (i, k) in self.keys.iter().enumerate() {
            let camera = k.camera(lattice, orientation).map_err(|e| {
                InvalidField::new(format!("keyframes.keys[{i}].{}", e.field), e.problem)
            })?;
            let pose = Pose::of(&camera).ok_or_else(|| {
                InvalidField::new(
                    format!("keyframes.keys[{i}].up"),
                    "lies along the line of sight; give another",
                )
            })?;
            keys.push(Stop { time: self.time(i), camera, pose });
        }
        // Each turn has two quaternions; the one nearer to the key before avoids flips.
        for i in 1..keys.len() {
            if keys[i].pose.turn.dot(keys[i - 1].pose.turn) < 0.0 {
                keys[i].pose.turn = -keys[i].pose.turn;
            }
        }
        Ok(KeyedPath { easing: self.easing, keys })
    }
}

impl Key {
    fn camera(&self, lattice: &Lattice, o: Orientation) -> Result<Camera, InvalidField> {
        let finite = |field: &str, x: [f64; 3]| match DVec3::from_array(x) {
            v if v.is_finite() => Ok(v),
            _ => Err(InvalidField::new(field, "must be finite numbers")),
        };
        let target = match self.target {
            Some(t) => finite("target", t)? - lattice.centre(),
            None => DVec3::ZERO,
        };
        let height = self.height.unwrap_or(1.25 * lattice.largest_extent());
        if !(height.is_finite() && height > 0.0) {
            return Err(InvalidField::new("height", "must be finite and above zero"));
        }
        let fov = self.fov.unwrap_or(30.0);
        if !(0.01..=179.0).contains(&fov) {
            return Err(InvalidField::new("fov", format!("{fov} degrees; give 0.01 to 179")));
        }
        let mut distance = height / 2.0 / libm::tan(fov.to_radians() / 2.0);
        let (to_eye, up) = match self.eye {
            Some(eye) => {
                let to_eye = finite("eye", eye)? - lattice.centre() - target;
                distance = to_eye.length();
                if distance == 0.0 {
                    return Err(InvalidField::new("eye", "is the target; move one of them"));
                }
                let up = self.up.map_or(Ok(o.up.vector()), |up| finite("up", up))?;
                (to_eye, up)
            }
            None => {
                let (azimuth, elevation) = match self.view {
                    Some(side) => side.angles(o),
                    None => (self.azimuth.unwrap_or(0.0), self.elevation.unwrap_or(0.0)),
                };
                if !azimuth.is_finite() || azimuth.abs() > 1e9 {
                    return Err(InvalidField::new("azimuth", "must be a finite angle in degrees"));
                }
                if !(-90.0..=90.0).contains(&elevation) {
                    return Err(InvalidField::new(
                        "elevation",
                        format!("{elevation} degrees; give -90 to 90"),
                    ));
                }
                super::direction(o, azimuth, elevation)
            }
        };
        let projection = match self.projection {
            ProjectionKind::Ortho => CameraProjection::Ortho { height },
            ProjectionKind::Persp => CameraProjection::Persp { fov, distance },
        };
        Ok(Camera { to_eye, up, target, projection })
    }
}

/// A camera taken apart.
#[derive(Clone, Copy, Debug)]
struct Pose {
    /// From world to eye axes.
    turn: DQuat,
    target: DVec3,
    /// Logarithm of the world height shown at the target.
    size: f64,
    /// Logarithm of the tangent of half the field of view; nothing for parallel rays.
    lens: Option<f64>,
}

impl Pose {
    /// `None` if up lies along the line of sight.
    fn of(c: &Camera) -> Option<Pose> {
        let unit = |v: DVec3| v / v.abs().max_element();
        let forward = -unit(c.to_eye) / unit(c.to_eye).length();
        let up = unit(c.up) / unit(c.up).length();
        let right = forward.cross(up);
        if right.is_nan() || right.length() < 1e-9 {
            return None;
        }
        let right = right / right.length();
        let down = forward.cross(right);
        let turn = turn::of_matrix(&DMat3::from_cols(right, down, forward).transpose());
        let (size, lens) = match c.projection {
            CameraProjection::Ortho { height } => (libm::log(height), None),
            CameraProjection::Persp { fov, distance } => {
                let tan = libm::tan(fov.to_radians() / 2.0);
                (libm::log(2.0 * distance * tan), Some(libm::log(tan)))
            }
        };
        Some(Pose { turn, target: c.target, size, lens })
    }

    fn camera(&self) -> Camera {
        // Rows of the rotation are the eye's axes in the world.
        let world_from_eye = self.turn.conjugate();
        let projection = match self.lens {
            None => CameraProjection::Ortho { height: libm::exp(self.size) },
            Some(lens) => {
                let tan = libm::exp(lens);
                CameraProjection::Persp {
                    fov: (2.0 * libm::atan(tan)).to_degrees(),
                    distance: libm::exp(self.size) / (2.0 * tan),
                }
            }
        };
        Camera {
            to_eye: world_from_eye * -DVec3::Z,
            up: world_from_eye * -DVec3::Y,
            target: self.target,
            projection,
        }
    }
}

struct Stop {
    time: f64,
    camera: Camera,
    pose: Pose,
}

/// A path through key frames, ready to be asked for any time.
pub(super) struct KeyedPath {
    easing: Easing,
    keys: Vec<Stop>,
}

impl KeyedPath {
    /// Bytes of the keys.
    pub(super) fn held_bytes(&self) -> usize {
        self.keys.len() * size_of::<Stop>()
    }

    /// The camera at a time in frames.
    pub(super) fn at(&self, time: f64) -> Camera {
        let after = self.keys.partition_point(|k| k.time <= time);
        let Some(i) = after.checked_sub(1) else { return self.keys[0].camera };
        let a = &self.keys[i];
        let Some(b) = self.keys.get(after).filter(|_| a.time < time) else { return a.camera };
        let width = b.time - a.time;
        let t = (time - a.time) / width;
        let (p, q) = (&a.pose, &b.pose);
        if let Easing::Linear = self.easing {
            let mix = |x: f64, y: f64| x * (1.0 - t) + y * t;
            return Pose {
                turn: turn::slerp(p.turn, q.turn, t),
                target: p.target * (1.0 - t) + q.target * t,
                size: mix(p.size, q.size),
                lens: p.lens.zip(q.lens).map(|(x, y)| mix(x, y)),
            }
            .camera();
        }
        let (from, to) = (self.speed(i), self.speed(i + 1));
        Pose {
            turn: turn::curve(p.turn, q.turn, from.turn * width, to.turn * width, t),
            target: hermite(p.target, q.target, from.target * width, to.target * width, t),
            size: hermite(p.size, q.size, from.size * width, to.size * width, t),
            lens: p
                .lens
                .zip(q.lens)
                .map(|(x, y)| hermite(x, y, from.lens * width, to.lens * width, t)),
        }
        .camera()
    }

    /// Returns the speed of all quantities at key `i`, per frame: the speed of the parabola through
    /// the key and its neighbours. The first and the last key have the speed of their only side. A
    /// key that repeats its neighbour is a halt.
    fn speed(&self, i: usize) -> Speed {
        let side = |a: usize, b: usize| {
            let (p, q) = (&self.keys[a].pose, &self.keys[b].pose);
            let width = self.keys[b].time - self.keys[a].time;
            Speed {
                turn: turn::from_to(p.turn, q.turn) / width,
                target: (q.target - p.target) / width,
                size: (q.size - p.size) / width,
                lens: (q.lens.unwrap_or(0.0) - p.lens.unwrap_or(0.0)) / width,
            }
        };
        match (i > 0, i + 1 < self.keys.len()) {
            (false, false) => Speed::default(),
            (false, true) => side(i, i + 1),
            (true, false) => side(i - 1, i),
            (true, true) => {
                let (before, after) = (side(i - 1, i), side(i, i + 1));
                let [w, v] = [i, i + 1].map(|k| self.keys[k].time - self.keys[k - 1].time);
                // The nearer neighbour counts more.
                let mix = v / (w + v);
                Speed {
                    turn: halt(before.turn, after.turn, mix),
                    target: halt(before.target, after.target, mix),
                    size: halt_1d(before.size, after.size, mix),
                    lens: halt_1d(before.lens, after.lens, mix),
                }
            }
        }
    }
}

#[derive(Clone, Copy, Debug, Default)]
struct Speed {
    turn: DVec3,
    target: DVec3,
    size: f64,
    lens: f64,
}

/// The mean of two speeds; none where one of them is none, so that what rests stays at rest.
fn halt(before: DVec3, after: DVec3, mix: f64) -> DVec3 {
    if before == DVec3::ZERO || after == DVec3::ZERO {
        DVec3::ZERO
    } else {
        before * mix + after * (1.0 - mix)
    }
}

/// Mixes the speeds of a number before and after a key; the number also turns round without running
/// over.
fn halt_1d(before: f64, after: f64, mix: f64) -> f64 {
    if before * after <= 0.0 {
        return 0.0;
    }
    let mean = before * mix + after * (1.0 - mix);
    // Three times the slower side at most: beyond that a cubic overshoots (Fritsch and Carlson).
    let most = 3.0 * before.abs().min(after.abs());
    mean.clamp(-most, most)
}

/// A cubic from `a` to `b` with the speeds `from` and `to` (over its whole width).
fn hermite<T>(a: T, b: T, from: T, to: T, t: f64) -> T
where
    T: Copy + std::ops::Add<Output = T> + std::ops::Mul<f64, Output = T>,
{
    let u = 1.0 - t;
    a * (u * u * (1.0 + 2.0 * t))
        + b * (t * t * (1.0 + 2.0 * u))
        + from * (t * u * u)
        + to * (-t * t * u)
}

#[cfg(test)]
mod tests;
