//! A flight: the eye along a smooth curve through given points, at constant speed.
//!
//! The curve is a centripetal Catmull-Rom spline: it passes every point and makes no loops between
//! near ones. Speed along it is constant to some 10^-3, by a table of lengths. The eye looks ahead,
//! or at a target. Level flight stays level: up is carried along the curve without turning about
//! the line of sight, so that a climb through the vertical flips nothing, and is drawn back to `up`
//! where the flight is level.

use super::Orientation;
use glam::DVec3;
use serde::{Deserialize, Serialize};
use slabcast_common::quality::InvalidField;
use slabcast_common::view::{Camera, CameraProjection};
use slabcast_common::volume::Lattice;

/// Most points of a flight.
pub(super) const MAX_POINTS: usize = 10_000;

/// Pieces of the curve between two points. With 64 the speed is right within 10^-3; with half of
/// them it is off by four times that.
const PIECES: usize = 64;

/// A flight: a path whose eye passes through given points on a smooth curve.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlyThrough {
    /// Number of frames of the path.
    pub frames: u32,
    /// Positions that the eye passes, in world units; at least two, three if closed.
    pub eyes: Vec<[f64; 3]>,
    /// Point that the eye looks at, in world units; `None` looks ahead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub target: Option<[f64; 3]>,
    /// Up direction of the picture in world axes, of any length; `None` takes the volume's up.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub up: Option<[f64; 3]>,
    /// Vertical full field of view in degrees; default 60.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fov: Option<f64>,
    /// Whether the flight goes on from the last point to the first. The frame after the last would
    /// then be the first again.
    #[serde(default)]
    pub closed: bool,
}

impl FlyThrough {
    /// Checks the numbers of frames and points, and every coordinate.
    ///
    /// # Errors
    /// Names the field, or the point that is not finite or equals the one before.
    pub fn check(&self) -> Result<(), InvalidField> {
        let refuse = |field: &str, problem: &str| {
            Err(InvalidField::new(format!("flythrough.{field}"), problem))
        };
        let least = if self.closed { 3 } else { 2 };
        if self.eyes.len() < least || self.eyes.len() > MAX_POINTS {
            return refuse(
                "eyes",
                &format!("{} points; give {least} to {MAX_POINTS}", self.eyes.len()),
            );
        }
        for (i, e) in self.eyes.iter().enumerate() {
            if !e.iter().all(|x| x.is_finite()) {
                return refuse(&format!("eyes[{i}]"), "must be finite numbers");
            }
            let next = (i + 1) % self.eyes.len();
            if (next > 0 || self.closed) && *e == self.eyes[next] {
                return refuse(&format!("eyes[{next}]"), "is the point before; leave one out");
            }
        }
        for (field, v) in [("target", self.target), ("up", self.up)] {
            if v.is_some_and(|v| !v.iter().all(|x| x.is_finite())) {
                return refuse(field, "must be finite numbers");
            }
        }
        if self.up == Some([0.0; 3]) {
            return refuse("up", "must not be zero");
        }
        if let Some(fov) = self.fov
            && !(0.01..=179.0).contains(&fov)
        {
            return refuse("fov", &format!("{fov} degrees; give 0.01 to 179"));
        }
        Ok(())
    }

    /// Makes the curve ready.
    ///
    /// # Errors
    /// If it comes to its target.
    pub(super) fn prepare(
        &self,
        lattice: &Lattice,
        o: Orientation,
    ) -> Result<Flight, InvalidField> {
        let centre = lattice.centre();
        // In vox from the centre: neither unit nor origin matters.
        let vox = lattice.vox();
        let place = |p: [f64; 3]| (DVec3::from_array(p) - centre) / vox;
        let points: Vec<DVec3> = self.eyes.iter().map(|&p| place(p)).collect();
        let spans = if self.closed { points.len() } else { points.len() - 1 };
        let mut nodes = Vec::with_capacity(spans * PIECES + 1);
        for span in 0..spans {
            let p = self.around(&points, span);
            nodes.extend((0..PIECES).map(|i| on_curve(&p, i as f64 / PIECES as f64)));
        }
        nodes.push(points[spans % points.len()]);
        let mut lengths = Vec::with_capacity(nodes.len());
        let mut length = 0.0;
        for (i, node) in nodes.iter().enumerate() {
            if i > 0 {
                length += (*node - nodes[i - 1]).length();
            }
            lengths.push(length);
        }
        let target = self.target.map(place);
        let ahead = |i: usize| match target {
            Some(t) => t - nodes[i],
            None => {
                let (a, b) = match (self.closed, nodes.len() - 1) {
                    (true, last) => ((i + last - 1) % last, (i + 1) % last),
                    (false, last) => (i.saturating_sub(1), (i + 1).min(last)),
                };
                nodes[b] - nodes[a]
            }
        };
        let level = self.up.map_or(o.up.vector(), DVec3::from_array);
        let level = level / level.length();
        let mut looks: Vec<DVec3> = Vec::with_capacity(nodes.len());
        let mut ups: Vec<DVec3> = Vec::with_capacity(nodes.len());
        for i in 0..nodes.len() {
            let look = ahead(i);
            if look.length() < 1e-9 {
                let what = if target.is_some() {
                    "the flight passes its target"
                } else {
                    "the flight turns on the spot"
                };
                return Err(InvalidField::new(
                    "flythrough.eyes",
                    format!("{what} after point {}; move it", i / PIECES),
                ));
            }
            let look = look / look.length();
            let carried = ups.last().map_or(level, |&up: &DVec3| {
                let before = looks[i - 1];
                carry(up, before, look)
            });
            // The part of `level` across the line of sight pulls `up` towards it, more strongly the
            // more level the flight is.
            let across = level - look * look.dot(level);
            let drawn = if i == 0 { across } else { carried + across * (0.1 * across.length()) };
            let up = drawn - look * look.dot(drawn);
            let up = if up.length() > 1e-6 { up } else { look.any_orthogonal_vector() };
            ups.push(up / up.length());
            looks.push(look);
        }
        Ok(Flight {
            nodes,
            lengths,
            looks,
            ups,
            vox,
            target,
            // In a flight that looks ahead, only the near plane depends on the distance.
            ahead: 0.5 * lattice.largest_extent() / vox,
            fov: self.fov.unwrap_or(60.0),
            closed: self.closed,
        })
    }

    /// The two points of a span, the one before and the one behind; mirrored at the ends.
    fn around(&self, p: &[DVec3], span: usize) -> [DVec3; 4] {
        let n = p.len();
        let (b, c) = (p[span], p[(span + 1) % n]);
        let a = match (self.closed, span) {
            (true, _) => p[(span + n - 1) % n],
            (false, 0) => b * 2.0 - c,
            (false, _) => p[span - 1],
        };
        let d = match (self.closed, span + 2 < n) {
            (true, _) => p[(span + 2) % n],
            (false, true) => p[span + 2],
            (false, false) => c * 2.0 - b,
        };
        [a, b, c, d]
    }
}

/// `up` turned as little as turns one direction into another.
fn carry(up: DVec3, from: DVec3, to: DVec3) -> DVec3 {
    // Two mirrors make a turn; the second one is at half the angle.
    let half = from + to;
    let len2 = half.length_squared();
    if len2 < 1e-12 {
        return up;
    }
    let mirrored = up - from * (2.0 * up.dot(from));
    mirrored - half * (2.0 * mirrored.dot(half) / len2)
}

/// Barry and Goldman's pyramid: knots at square roots of distances.
fn on_curve([a, b, c, d]: &[DVec3; 4], t: f64) -> DVec3 {
    if t <= 0.0 {
        return *b;
    }
    let knot = |p: DVec3, q: DVec3| libm::sqrt((q - p).length());
    let t1 = knot(*a, *b);
    let t2 = t1 + knot(*b, *c);
    let t3 = t2 + knot(*c, *d);
    let t = t1 + (t2 - t1) * t;
    let mix =
        |p: DVec3, q: DVec3, from: f64, to: f64| (p * (to - t) + q * (t - from)) / (to - from);
    let (x, y, z) = (mix(*a, *b, 0.0, t1), mix(*b, *c, t1, t2), mix(*c, *d, t2, t3));
    mix(mix(x, y, 0.0, t2), mix(y, z, t1, t3), t1, t2)
}

/// A flight, ready to be asked for any part of its length.
pub(super) struct Flight {
    /// In vox from the volume's centre.
    nodes: Vec<DVec3>,
    lengths: Vec<f64>,
    looks: Vec<DVec3>,
    ups: Vec<DVec3>,
    vox: f64,
    target: Option<DVec3>,
    ahead: f64,
    fov: f64,
    closed: bool,
}

impl Flight {
    /// Bytes of the nodes.
    pub(super) fn held_bytes(&self) -> usize {
        self.nodes.len() * (3 * size_of::<DVec3>() + size_of::<f64>())
    }

    /// The camera of frame `i` of `frames`.
    pub(super) fn frame(&self, i: usize, frames: usize) -> Camera {
        let last = if self.closed { frames } else { frames.max(2) - 1 };
        self.at(i as f64 / last as f64)
    }

    /// The camera at a share of the length.
    fn at(&self, share: f64) -> Camera {
        let whole = self.lengths[self.lengths.len() - 1];
        let s = whole * share;
        let b = self.lengths.partition_point(|&l| l <= s).clamp(1, self.nodes.len() - 1);
        let a = b - 1;
        let t = ((s - self.lengths[a]) / (self.lengths[b] - self.lengths[a])).clamp(0.0, 1.0);
        let mix = |v: &[DVec3]| v[a] * (1.0 - t) + v[b] * t;
        let (eye, up) = (mix(&self.nodes), mix(&self.ups));
        let look = match self.target {
            Some(target) => target - eye,
            None => {
                let look = mix(&self.looks);
                look / look.length() * self.ahead
            }
        };
        Camera {
            to_eye: -look,
            up,
            target: (eye + look) * self.vox,
            projection: CameraProjection::Persp {
                fov: self.fov,
                distance: look.length() * self.vox,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn lattice() -> Lattice {
        Lattice::from_spacing([65; 3], [2.0; 3])
    }

    fn flight(f: &FlyThrough) -> Vec<Camera> {
        f.check().unwrap();
        let ready = f.prepare(&lattice(), Orientation::new(None, None).unwrap()).unwrap();
        (0..f.frames as usize).map(|i| ready.frame(i, f.frames as usize)).collect()
    }

    fn through(eyes: Vec<[f64; 3]>, frames: u32) -> FlyThrough {
        FlyThrough { frames, eyes, target: None, up: None, fov: None, closed: false }
    }

    fn eye(c: &Camera) -> DVec3 {
        // The eye in world units: from the target back along the line of sight.
        let CameraProjection::Persp { distance, .. } = c.projection else { panic!("perspective") };
        c.target + lattice().centre() + c.to_eye / c.to_eye.length() * distance
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn flights_pass_their_ends_keep_their_speed_and_flip_nothing(
            eyes in prop::collection::vec([-90.0..90.0f64, -90.0..90.0, -90.0..90.0], 2..7),
        ) {
            let d = |a: [f64; 3], b: [f64; 3]| (DVec3::from_array(a) - DVec3::from_array(b)).length();
            prop_assume!(eyes.windows(2).all(|w| d(w[0], w[1]) > 10.0));
            // A flight that turns round on the spot looks the other way, whoever steers.
            let way = |w: &[[f64; 3]]| (DVec3::from_array(w[1]) - DVec3::from_array(w[0])).normalize();
            prop_assume!(eyes.windows(3).all(|w| way(&w[..2]).dot(way(&w[1..])) > -0.3));
            let all = flight(&through(eyes.clone(), 801));
            prop_assert!((eye(&all[0]) - DVec3::from_array(eyes[0])).length() < 1e-9);
            prop_assert!((eye(&all[800]) - DVec3::from_array(eyes[eyes.len() - 1])).length() < 1e-9);
            for e in &eyes {
                let e = DVec3::from_array(*e);
                let near = all.iter().map(|c| (eye(c) - e).length()).fold(f64::INFINITY, f64::min);
                prop_assert!(near < 2.0, "{e} is passed at {near}");
            }
            let steps: Vec<f64> = all.windows(2).map(|w| (eye(&w[1]) - eye(&w[0])).length()).collect();
            let mean = steps.iter().sum::<f64>() / steps.len() as f64;
            // Chords of sharp bends are shorter than their arcs.
            let good = steps.iter().filter(|s| (*s / mean - 1.0).abs() < 0.01).count();
            prop_assert!(good as f64 > 0.97 * steps.len() as f64, "{steps:?}");
            for w in all.windows(2) {
                let turned = w[0].up.dot(w[1].up) / (w[0].up.length() * w[1].up.length());
                prop_assert!(turned > 0.5, "up flips from {} to {}", w[0].up, w[1].up);
                prop_assert!(w[1].up.dot(w[1].to_eye).abs() < 0.05 * w[1].to_eye.length());
            }
        }
    }

    #[test]
    fn level_flight_stays_level_and_looks_ahead() {
        let circle: Vec<[f64; 3]> = (0..12)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / 12.0;
                [64.0 + 50.0 * libm::cos(a), 64.0 + 50.0 * libm::sin(a), 64.0]
            })
            .collect();
        let f = FlyThrough { closed: true, ..through(circle, 48) };
        let all = flight(&f);
        for c in &all {
            let up = c.up / c.up.length();
            assert!((up - DVec3::Z).length() < 1e-9, "{up}");
            let out = eye(c) - DVec3::splat(64.0);
            assert!((out.length() - 50.0).abs() < 0.5);
            assert!(
                out.dot(c.to_eye).abs() < 0.05 * out.length() * c.to_eye.length(),
                "along the circle"
            );
        }
        // The frame after the last is the first: the same step as all others.
        let step = |a: &Camera, b: &Camera| (eye(b) - eye(a)).length();
        assert!((step(&all[47], &all[0]) / step(&all[3], &all[4]) - 1.0).abs() < 0.01);
    }

    #[test]
    fn a_climb_through_the_vertical_flips_nothing() {
        let f = through(
            vec![
                [0.0, 0.0, 0.0],
                [60.0, 0.0, 10.0],
                [80.0, 0.0, 60.0],
                [60.0, 0.0, 110.0],
                [0.0, 0.0, 120.0],
            ],
            200,
        );
        let all = flight(&f);
        for w in all.windows(2) {
            assert!(w[0].up.dot(w[1].up) > 0.9, "{} {}", w[0].up, w[1].up);
        }
    }

    #[test]
    fn a_target_is_looked_at() {
        let f = FlyThrough {
            target: Some([64.0; 3]),
            ..through(vec![[0.0, 0.0, 0.0], [0.0, 99.0, 0.0]], 5)
        };
        for c in flight(&f) {
            assert!((c.target + lattice().centre() - DVec3::splat(64.0)).length() < 1e-9);
        }
        let through_it = FlyThrough {
            target: Some([0.0, 50.0, 0.0]),
            ..through(vec![[0.0; 3], [0.0, 100.0, 0.0]], 5)
        };
        let e =
            through_it.prepare(&lattice(), Orientation::new(None, None).unwrap()).err().unwrap();
        assert!(e.to_string().contains("passes its target"), "{e}");
    }

    #[test]
    fn wrong_flights_are_named() {
        let ok = through(vec![[0.0; 3], [1.0; 3]], 9);
        let field = |f: FlyThrough| f.check().unwrap_err().field;
        assert_eq!(field(through(vec![[0.0; 3]], 9)), "flythrough.eyes");
        assert_eq!(field(FlyThrough { closed: true, ..ok.clone() }), "flythrough.eyes");
        assert_eq!(field(through(vec![[0.0; 3], [0.0; 3]], 9)), "flythrough.eyes[1]");
        assert_eq!(field(through(vec![[0.0; 3], [f64::NAN; 3]], 9)), "flythrough.eyes[1]");
        assert_eq!(field(FlyThrough { fov: Some(0.0), ..ok.clone() }), "flythrough.fov");
        assert_eq!(field(FlyThrough { up: Some([0.0; 3]), ..ok }), "flythrough.up");
    }
}
