//! Integer positions of voxels in orthographic views.
//!
//! In an orthographic view a voxel's screen position is that of its brick's corner plus an offset
//! that 512 local indices share, and so is its depth. Both are kept to 2^-24 of a subpixel or
//! phase; the rest is integer addition, the same in every lane width. Against arithmetic in f64 a
//! position is off by at most 2^-32 pixel. With 8 bits instead of 24 it would do for the picture
//! (1/65536 pixel), but how a volume is cut into bricks, or stored, would show: one voxel in a
//! hundred would be rounded the other way.

use glam::DVec3;
use slabcast_common::brick::local_position;
use slabcast_common::view::{Projection, SUBPIXELS, View, round_i64};

/// Parts of a subpixel, and of a phase of depth, that corners and offsets are kept in.
pub(crate) const FINER_BITS: u32 = 24;
const FINER: f64 = (1u32 << FINER_BITS) as f64;

/// Summand that rounds a corner plus an offset to the nearest subpixel or phase. A little more than
/// half: positions half-way between two are common (a voxel on a pixel's edge), and the last bits
/// of corner and offset must not say where those go.
const HALF: i64 = (1 << (FINER_BITS - 1)) + 64;

/// The nearest whole number: beyond 2^50 there is no other.
fn whole(x: f64) -> i64 {
    if x.abs() < (1u64 << 50) as f64 { round_i64(x) } else { x as i64 }
}

/// Integer positions of voxels in an orthographic view.
#[derive(Clone, Debug)]
pub struct Places {
    /// Pixels a vox.
    scale: f64,
    /// Finer units a vox of depth.
    deep: f64,
    /// Half the picture in pixels.
    middle: [f64; 2],
    /// Offsets of the 512 voxels of a brick, as corners.
    offsets: Box<[[i64; 512]; 3]>,
}

/// A brick's corner: x and y in 2^-24 subpixels of absolute image coordinates, depth in 2^-24
/// phases.
pub type FlatCorner = [i64; 3];

impl Places {
    /// The positions of `view`, if it is orthographic.
    pub(crate) fn new(view: &View) -> Option<Places> {
        let Projection::Ortho { scale } = view.projection else { return None };
        let deep = f64::from(view.depth_phases()) * FINER / view.thickness;
        let mut offsets = Box::new([[0; 512]; 3]);
        for i in 0..512u16 {
            let v = view.offset_in_eye(local_position(i));
            let across = scale * f64::from(SUBPIXELS) * FINER;
            for (axis, at) in [v.x * across, v.y * across, v.z * deep].into_iter().enumerate() {
                offsets[axis][i as usize] = whole(at);
            }
        }
        Some(Places { scale, deep, middle: view.size.map(|n| f64::from(n) * 0.5), offsets })
    }

    /// The corner at eye position `eye`.
    pub(crate) fn corner(&self, eye: DVec3) -> FlatCorner {
        // 2^18 pixels off the picture is farther than a footprint of a flat view reaches.
        const FAR: f64 = (1u64 << 18) as f64;
        let across = |v: f64, middle: f64| {
            whole((v * self.scale + middle).clamp(-FAR, FAR) * f64::from(SUBPIXELS) * FINER)
        };
        // `View::new` keeps depths below 2^30 phases.
        let z = whole(eye.z * self.deep);
        [across(eye.x, self.middle[0]), across(eye.y, self.middle[1]), z]
    }

    /// Returns a voxel's screen position in subpixels and its depth in phases; `local` is its index
    /// in the brick, 0 to 511.
    pub fn at(&self, corner: FlatCorner, local: u16) -> ([i64; 2], i32) {
        let at = |axis: usize| {
            let offset = self.offsets[axis][usize::from(local & 511)];
            (corner[axis] + offset + HALF) >> FINER_BITS
        };
        ([at(0), at(1)], at(2) as i32)
    }

    /// Returns the corner to which a voxel's offset is added for [`Places::at`] counted from
    /// `origin` (subpixels and phases); with an origin nearby, positions fit i32.
    #[inline(always)]
    pub fn from(corner: FlatCorner, origin: [i64; 3]) -> FlatCorner {
        std::array::from_fn(|axis| corner[axis] - (origin[axis] << FINER_BITS) + HALF)
    }

    /// Offsets of the 512 voxels of a brick, along each axis.
    #[inline(always)]
    pub(crate) fn offsets(&self) -> &[[i64; 512]; 3] {
        &self.offsets
    }

    /// [`Places::at`] for some voxels of a brick, counted from [what](Places::from) `from` is
    /// counted from.
    #[inline(always)]
    pub(crate) fn all(&self, from: FlatCorner, locals: &[u16], at: &mut [[i32; 512]; 3]) {
        // The lower half of a sum is the same for a shift with and without a sign.
        let rounded = |sum: i64| (sum as u64 >> FINER_BITS) as i32;
        for (axis, from) in from.into_iter().enumerate() {
            let offsets = &self.offsets[axis];
            if locals.len() == 512 {
                // All voxels of a brick are in order: no look-up.
                for (at, offset) in at[axis].iter_mut().zip(offsets) {
                    *at = rounded(from + offset);
                }
                continue;
            }
            for (at, local) in at[axis].iter_mut().zip(locals) {
                *at = rounded(from + offsets[usize::from(local & 511)]);
            }
        }
    }
}
