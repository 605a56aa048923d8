//! Framing: where the cameras of a path look and how much they show, if the path does not say so.
//!
//! The box of a file says little about what can be seen in it: a head fills two thirds of its scan,
//! a stent the middle of a block of flesh. So a path may ask for [`Fit::Visible`]: its target is
//! then the middle of what can be seen, and the picture's height is chosen so that this fills
//! [`FILL`] of the picture in its tighter direction. One framing serves all frames; each on its own
//! would make a movie breathe. It depends on the volume, the transfer functions, the crop, the
//! cameras and the shape of the picture, and on nothing else: masters and programs come to the same
//! numbers.
//!
//! Visible content is given as index positions whose hull holds it
//! (`slabcast_volumes::framing::outline`). Each is projected by [`View`], as the renderer does it:
//!
//! 1. In every frame the points' extent has a middle. The target is the point whose distances from
//!    these middles have the least squares: in a single picture both are met.
//! 2. Seen from there, the largest half extent of all frames decides the height.
//! 3. In perspective the middle depends on the distance: steps 1 and 2 are repeated.
//!
//! A turn of several frames is framed for the whole circle: frames of two runs fit together,
//! whichever part of the turn each draws.

use super::{Cameras, Orientation, Turntable, ViewPath};
use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use slabcast_common::quality::{InvalidField, Quality};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::Lattice;

/// Share of the picture that what can be seen fills in the tighter direction. Other programs fill
/// some 85 %; at 0.95 the glow of a kernel's edge touches the border, at 0.7 a third of the pixels
/// of a small picture are wasted.
pub const FILL: f64 = 0.85;

/// Room around a sample's centre in vox: the kernel of an opaque one ends to the eye there. At half
/// of it a ball of 20 samples across fills 90 % of a picture.
const EDGE: f64 = 1.0;

/// Most frames of a path that are looked at; of longer ones every second, third and so on. Between
/// two of 720 frames of a turn nothing moves by more than 0.5 % of a picture.
const MOST: usize = 720;

/// Rounds of the search in perspective. The second changes the target by a hundredth of the
/// volume, the third by less than a pixel of a picture of 512.
const ROUNDS: usize = 4;

/// Content that the cameras of a path frame if the path gives no target and height.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// The volume's box: its centre, and 1.25 times its largest extent.
    #[default]
    Volume,
    /// The voxels inside the crop that the transfer function makes visible.
    Visible,
}

impl Fit {
    /// Returns whether this is the default of a path.
    pub(super) fn is_volume(&self) -> bool {
        *self == Fit::Volume
    }
}

/// Target and height that a path was given.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Framing {
    /// Point that the eye looks at, in world units.
    pub target: [f64; 3],
    /// World height shown there.
    pub height: f64,
}

impl ViewPath {
    /// Returns whether the path leaves a target or a height to be fitted to what can be seen.
    pub fn wants_framing(&self) -> bool {
        if self.fit != Fit::Visible {
            return false;
        }
        let turn = self.turntable.is_some_and(|t| t.height.is_none() || t.target.is_none());
        let open =
            |key: &super::Key| key.eye.is_none() && (key.height.is_none() || key.target.is_none());
        turn || self.keyframes.as_ref().is_some_and(|k| k.keys.iter().any(open))
    }

    /// Returns the path with the numbers of `framing` where it has none of its own. Keys with an
    /// eye of their own stay as they are.
    #[must_use]
    pub fn framed(&self, framing: &Framing) -> ViewPath {
        let mut path = ViewPath { fit: Fit::Volume, ..self.clone() };
        if let Some(t) = &mut path.turntable {
            t.target = t.target.or(Some(framing.target));
            t.height = t.height.or(Some(framing.height));
        }
        let keys = path.keyframes.iter_mut().flat_map(|k| &mut k.keys);
        for key in keys.filter(|key| key.eye.is_none()) {
            key.target = key.target.or(Some(framing.target));
            key.height = key.height.or(Some(framing.height));
        }
        path
    }

    /// Returns the framing for a volume on `lattice` of which the hull of `points` (index
    /// positions) can be seen; `None` if there are none.
    ///
    /// # Errors
    /// Names the field of a camera that has no meaning.
    pub fn framing(
        &self,
        points: &[[u32; 3]],
        lattice: &Lattice,
        orientation: Orientation,
    ) -> Result<Option<Framing>, InvalidField> {
        if points.is_empty() {
            return Ok(None);
        }
        let path = self.to_be_framed();
        let cameras = path.prepare(lattice, orientation)?;
        let step = path.all_frames().div_ceil(MOST);
        let shots = (0..path.all_frames())
            .step_by(step)
            .map(|i| Shot::new(&cameras, i, lattice, self.size))
            .collect::<Result<Vec<Shot>, InvalidField>>()?;
        Ok(Some(fit(&shots, points, lattice, self.size)))
    }

    /// The path whose frames decide: all frames, or the circle of a turn.
    fn to_be_framed(&self) -> ViewPath {
        let mut path = ViewPath { range: None, ..self.clone() };
        if let Some(t) = path.turntable.as_mut().filter(|t| t.frames > 1) {
            *t = Turntable { start: 0.0, step: 5.0, frames: 72, ..*t };
        }
        path
    }
}

/// A camera that looks at the volume's centre.
struct Shot {
    /// Eye axes (right, down, ahead) of the world, as rows.
    eye_from_world: DMat3,
    /// Eye coordinates of an index step, in vox.
    eye_from_index: DMat3,
    /// Tangent of half the field of view; `None` in parallel projection.
    tan: Option<f64>,
}

impl Shot {
    fn new(
        cameras: &Cameras<'_>,
        i: usize,
        lattice: &Lattice,
        size: [u32; 2],
    ) -> Result<Shot, InvalidField> {
        let camera = Camera { target: DVec3::ZERO, ..cameras.camera(i)? };
        let view = View::new(lattice, &camera, size, &Quality::default())?;
        let tan = match camera.projection {
            CameraProjection::Ortho { .. } => None,
            CameraProjection::Persp { fov, .. } => Some(libm::tan(fov.to_radians() / 2.0)),
        };
        Ok(Shot { eye_from_world: view.eye_from_world, eye_from_index: view.eye_from_index, tan })
    }

    /// Eye coordinates of a point relative to a target that lies `target` (world axes, vox) from
    /// the volume's centre.
    fn project<'a>(
        &'a self,
        points: &'a [[u32; 3]],
        centre: DVec3,
        target: DVec3,
    ) -> impl Iterator<Item = DVec3> + 'a {
        let target = self.eye_from_world * target;
        points.iter().map(move |p| {
            self.eye_from_index * (DVec3::from_array(p.map(f64::from)) - centre) - target
        })
    }
}

fn fit(shots: &[Shot], points: &[[u32; 3]], lattice: &Lattice, size: [u32; 2]) -> Framing {
    let vox = lattice.vox();
    let centre = lattice.centre_index();
    // Height of the picture for a half width of 1.
    let upright = f64::from(size[1]) / f64::from(size[0]);
    let mut target = DVec3::ZERO;
    let mut half_height = 0.0f64;
    for round in 0..ROUNDS {
        let mut sums = (DMat3::ZERO, DVec3::ZERO);
        for shot in shots {
            let distance = shot.tan.filter(|_| round > 0).map(|tan| half_height / tan);
            let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
            for p in shot.project(points, centre, target) {
                // Scaled by perspective to its size at the target's depth.
                let p = p * distance.map_or(1.0, |d| d / (d + p.z));
                (lo, hi) = (lo.min(p), hi.max(p));
            }
            for axis in 0..2 {
                let along = shot.eye_from_world.row(axis);
                sums.0 += DMat3::from_cols(along * along.x, along * along.y, along * along.z);
                sums.1 += along * ((lo[axis] + hi[axis]) * 0.5);
            }
        }
        // No frame says how deep the target of a single picture lies: it stays as deep as it is,
        // first in the middle of what can be seen.
        let stay = if round == 0 { middle(points, lattice) / vox } else { DVec3::ZERO };
        let weight = 1e-9 * shots.len() as f64;
        let sums = (sums.0 + DMat3::from_diagonal(DVec3::splat(weight)), sums.1 + stay * weight);
        target += sums.0.inverse() * sums.1;
        half_height = 0.0;
        for shot in shots {
            for p in shot.project(points, centre, target) {
                let wide = (p.y.abs() + EDGE).max((p.x.abs() + EDGE) * upright) / FILL;
                let here = match shot.tan {
                    None => wide,
                    // At this distance a point at depth z shows at FILL of the half height.
                    Some(tan) => (wide / tan - p.z) * tan,
                };
                half_height = half_height.max(here);
            }
        }
        if shots.iter().all(|shot| shot.tan.is_none()) {
            break;
        }
    }
    Framing {
        target: (lattice.centre() + target * vox).to_array(),
        height: 2.0 * half_height * vox,
    }
}

/// Middle of the points' box in world axes, relative to the volume's centre.
fn middle(points: &[[u32; 3]], lattice: &Lattice) -> DVec3 {
    let (world, centre) = (lattice.world_from_index(), lattice.centre_index());
    let (mut lo, mut hi) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
    for p in points {
        let p = world * (DVec3::from_array(p.map(f64::from)) - centre);
        (lo, hi) = (lo.min(p), hi.max(p));
    }
    (lo + hi) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::path::{Key, KeyFrames, ProjectionKind};

    fn corners(lo: [u32; 3], hi: [u32; 3]) -> Vec<[u32; 3]> {
        (0..8)
            .map(|i| std::array::from_fn(|a| if i >> a & 1 == 0 { lo[a] } else { hi[a] }))
            .collect()
    }

    fn turn(frames: u32, projection: ProjectionKind) -> ViewPath {
        let t = Turntable { frames, start: 0.0, projection, ..Turntable::default() };
        ViewPath { fit: Fit::Visible, ..ViewPath::from_turntable([400, 300], t) }
    }

    /// Largest extents (right, down) of the points from the picture's middle in any frame, as
    /// shares of half the picture, both ways.
    fn filled(path: &ViewPath, points: &[[u32; 3]], lattice: &Lattice) -> [[f64; 2]; 2] {
        let o = Orientation::new(None, None).unwrap();
        let mut most = [[0.0f64; 2]; 2];
        for i in 0..path.frames() {
            let camera = path.camera(i, lattice, o).unwrap();
            let view = View::new(lattice, &camera, path.size, &Quality::default()).unwrap();
            for &p in points {
                let at = view.corner_in_eye(p);
                let scale = match view.projection {
                    slabcast_common::view::Projection::Ortho { scale } => scale,
                    slabcast_common::view::Projection::Persp { focal, distance } => {
                        focal / (at.z + distance)
                    }
                };
                for a in 0..2 {
                    let x = at[a] * scale / (f64::from(path.size[a]) / 2.0);
                    most[a] = [most[a][0].max(-x), most[a][1].max(x)];
                }
            }
        }
        most
    }

    #[test]
    fn a_box_in_a_corner_is_centred_and_fills_the_picture() {
        let lattice = Lattice::from_spacing([100; 3], [1.0; 3]);
        let points = corners([60, 70, 10], [90, 80, 70]);
        let o = Orientation::new(None, None).unwrap();
        for projection in [ProjectionKind::Ortho, ProjectionKind::Persp] {
            let path = turn(1, projection);
            let framing = path.framing(&points, &lattice, o).unwrap().unwrap();
            let [wide, tall] = filled(&path.framed(&framing), &points, &lattice);
            assert!((wide[0] - wide[1]).abs() < 0.01, "{projection:?}: {wide:?}");
            assert!((tall[0] - tall[1]).abs() < 0.01, "{projection:?}: {tall:?}");
            assert!((0.81..=0.85).contains(&tall[0]), "{projection:?}: {tall:?}");
        }
    }

    #[test]
    fn a_turn_has_one_framing_for_all_its_parts() {
        let lattice = Lattice::from_spacing([100; 3], [1.0; 3]);
        let points = corners([60, 70, 10], [90, 80, 30]);
        let o = Orientation::new(None, None).unwrap();
        for projection in [ProjectionKind::Ortho, ProjectionKind::Persp] {
            let path = turn(72, projection);
            let framing = path.framing(&points, &lattice, o).unwrap();
            let part = ViewPath { range: Some([3, 4]), ..turn(18, projection) };
            assert_eq!(part.framing(&points, &lattice, o).unwrap(), framing);
            let [wide, tall] = filled(&path.framed(&framing.unwrap()), &points, &lattice);
            let most = wide.into_iter().chain(tall).fold(0.0, f64::max);
            assert!((0.75..=0.85).contains(&most), "{projection:?}: {wide:?} {tall:?}");
        }
    }

    #[test]
    fn numbers_of_the_path_stay_and_what_shows_nothing_is_not_framed() {
        let lattice = Lattice::from_spacing([50; 3], [1.0; 3]);
        let points = corners([0; 3], [20; 3]);
        let o = Orientation::new(None, None).unwrap();
        let own = Key { height: Some(7.0), ..Key::default() };
        let eye = Key { eye: Some([0.0, 90.0, 0.0]), ..Key::default() };
        let keys = vec![own, Key { azimuth: Some(90.0), ..Key::default() }, eye.clone()];
        let frames =
            KeyFrames { frames: 9, easing: Default::default(), up: None, front: None, keys };
        let path = ViewPath {
            keyframes: Some(frames),
            fit: Fit::Visible,
            ..ViewPath::from_views([64, 64], vec![])
        };
        assert!(path.wants_framing());
        let framing = path.framing(&points, &lattice, o).unwrap().unwrap();
        let framed = path.framed(&framing);
        let keys = &framed.keyframes.as_ref().unwrap().keys;
        assert_eq!((keys[0].height, keys[0].target), (Some(7.0), Some(framing.target)));
        assert_eq!(keys[1].height, Some(framing.height));
        assert_eq!(keys[2], eye);
        assert!(!framed.wants_framing());
        assert_eq!(path.framing(&[], &lattice, o).unwrap(), None);
    }
}
