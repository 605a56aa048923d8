//! Lattice rows: layers of the lattice that a level camera sees as rows of the picture.
//!
//! A *lattice row* is all voxels of one index along the lattice's upright axis. Where the camera is
//! level and that axis points up in the picture, as on a turntable, all voxels of a lattice row lie
//! in one row of the picture: at any depth in orthographic views, in each sheet in perspective
//! ones. A footprint is a product, so its second factor need not be applied voxel by voxel: a voxel
//! is added along x alone, to the sums of its lattice row, and when a sheet closes a pixel's sum is
//! that of the few lattice rows that reach it, each times its weight down the picture. Of seven
//! rows of pixels that a voxel was added to one is left (the separable footprint of the paper's
//! section 3, with its second half done once for all voxels that share it).
//!
//! ```text
//! row(k, s, x) = sum over voxels of lattice row s of (payload * wz) * wx, each rounded
//! sum(k, x, y) = sum over lattice rows, top down, of row(k, s, x) * wy, rounded by kind of sums
//! ```
//!
//! **Why pixels stay exact.** A row is a sum of integers, which has no order. A voxel that is
//! culled touches shut pixels alone, with all of its columns in all rows of its lattice row. And
//! the lattice rows of a pixel are added in one order, from the top of the picture down, which does
//! not depend on how the volume is stored.
//!
//! Float sums are not made so, since they have an order of their own. Neither are views in which
//! lattice rows lie closer than [`CLOSEST`]: there a voxel touches no more rows of pixels than a
//! pixel has lattice rows.

use crate::primitives::footprint::Footprint;
use crate::primitives::sizes::REACHING;
use slabcast_common::occlusion::Rect;
use slabcast_common::view::{SUBPIXELS, View};

/// Least number of pixels from a lattice row to the next. At one a voxel has four or five rows of
/// pixels, as a pixel has lattice rows; below, lattice rows outgrow the cache that rows of pixels
/// fit.
pub const CLOSEST: f64 = 0.75;

/// The lattice rows of a level view, from the top of the picture down.
#[derive(Clone, Debug)]
pub struct LatticeRows {
    /// Index of the lattice axis that is upright in the picture: 0, 1 or 2.
    pub axis: usize,
    /// Whether higher indices along that axis lie higher in the picture.
    pub upwards: bool,
    /// Down the picture, in vox, of each lattice row.
    eye: Vec<f64>,
    /// From one to the next, more than zero.
    step: f64,
    /// Positions in subpixels, where places are in integers.
    flat: Option<Vec<i64>>,
    /// Lattice rows that a footprint reaches to either side.
    reach: f64,
    /// Length of a step of the lattice in vox: rows are kept over it, and weights down have it as a
    /// factor, so that a solid's rows are as its sums.
    pub(crate) spread: f32,
}

impl LatticeRows {
    /// The lattice rows of `view`, if it is level and they are far enough apart in sheets up to
    /// `last`.
    pub(crate) fn new(view: &View, dims: [u32; 3], spread: f64, last: i32) -> Option<LatticeRows> {
        let m = &view.eye_from_index;
        let down = [m.x_axis.y, m.y_axis.y, m.z_axis.y];
        let axis = (0..3).find(|&a| down[a] != 0.0)?;
        if (0..3).any(|a| a != axis && down[a] != 0.0) {
            return None;
        }
        let (step, upwards) = (down[axis].abs(), down[axis] < 0.0);
        let apart = view.scale_at(last)? * step;
        let reach = view.kernel_radius.y / step;
        if apart < CLOSEST || 2.0 * reach + 2.0 > REACHING as f64 {
            return None;
        }
        let eye = vec![0.0; dims[axis] as usize];
        let mut lattice_rows =
            LatticeRows { axis, upwards, eye, step, flat: None, reach, spread: spread as f32 };
        // As a brick's corner and an offset in it, since positions are made so.
        lattice_rows.eye = lattice_rows.all(|at| {
            let [corner, offset] = [at.map(|n| n & !7), at.map(|n| n & 7)];
            view.corner_in_eye(corner).y + view.offset_in_eye(offset).y
        });
        Some(lattice_rows)
    }

    /// Returns `of` for each lattice row in order; `of` takes the index of a voxel in the row.
    fn all<T>(&self, of: impl Fn([u32; 3]) -> T) -> Vec<T> {
        let along = |n| std::array::from_fn(|a| if a == self.axis { n } else { 0 });
        let n = self.eye.len() as u32;
        (0..n).map(|s| of(along(if self.upwards { n - 1 - s } else { s }))).collect()
    }

    /// Lattice row of the voxel at `index`.
    #[inline(always)]
    pub(crate) fn of_voxel(&self, index: [u32; 3]) -> u32 {
        let n = index[self.axis];
        if self.upwards { self.eye.len() as u32 - 1 - n } else { n }
    }

    /// With positions from integers, by the index of a voxel.
    pub(crate) fn in_integers(&mut self, at: impl Fn([u32; 3]) -> i64) {
        self.flat = Some(self.all(at));
    }

    /// Number of lattice rows.
    pub(crate) fn len(&self) -> usize {
        self.eye.len()
    }

    /// Returns the screen position down the picture, in subpixels, of lattice row `s` in a sheet
    /// with `footprint`.
    #[inline(always)]
    pub fn at(&self, view: &View, s: usize, footprint: &Footprint<'_>) -> i64 {
        match &self.flat {
            Some(flat) => flat[s],
            None => view.screen_coordinate(1, self.eye[s], footprint.scale),
        }
    }

    /// Returns the lattice row, counted from the top and as a fraction, that lies at `y` vox down
    /// the eye's axis.
    #[inline(always)]
    fn of_eye(&self, y: f64) -> f64 {
        (y - self.eye[0]) / self.step
    }

    /// Returns a factor and a summand that turn an eye coordinate down the picture, in vox, into a
    /// number of lattice rows from the top.
    pub fn by_eye(&self) -> (f64, f64) {
        (1.0 / self.step, -self.eye[0] / self.step)
    }

    /// Subpixels from one to the next at `scale`.
    pub(crate) fn subpixels(&self, scale: f64) -> f64 {
        self.step * scale * f64::from(SUBPIXELS)
    }

    /// The lattice row that lies at position 0 of row `y` of pixels at `scale`, as a fraction; it
    /// need not be there.
    pub(crate) fn of_row(&self, view: &View, y: i32, scale: f64) -> f64 {
        self.of_eye((f64::from(y) - f64::from(view.size[1]) * 0.5) / scale)
    }

    /// Returns the first lattice row that row 0 of a part stands for, in a sheet of `scale` pixels
    /// a vox. Neither it nor the last of [`LatticeRows::rows`] reaches the part.
    #[inline(always)]
    pub fn base(&self, view: &View, part: &Rect, scale: f64) -> i32 {
        // A footprint reaches half a pixel less than its radius, and is placed to a subpixel.
        let first = libm::floor(self.of_row(view, part.y0, scale) - self.reach) - 1.0;
        // Far off the picture it is any that is far.
        first.clamp(-1e9, 1e9) as i32
    }

    /// Returns the number of lattice rows for a part of `high` pixels at `scale` pixels a vox; at
    /// most [`ROWS`].
    pub fn rows(&self, high: i32, scale: f64) -> usize {
        let across = f64::from(high) / (self.step * scale);
        libm::ceil(across + 2.0 * self.reach) as usize + 4
    }
}

impl LatticeRows {
    /// The lattice rows that reach row `y` of pixels in a sheet with this footprint, top down, and
    /// each one's weight there by `weight`; plainly, one by one.
    pub(crate) fn reaching<W: Copy + Default>(
        &self,
        view: &View,
        footprint: &Footprint<'_>,
        y: i32,
        mut weight: impl FnMut(i64) -> W,
    ) -> Reaching<W> {
        let mut reaching = Reaching { some: [(0, W::default()); REACHING], n: 0 };
        let middle = self.of_row(view, y, footprint.scale);
        let around = self.reach + 2.0 + 1.0 / (self.step * footprint.scale);
        let last = self.len() as i32 - 1;
        let from = (libm::floor(middle - around) as i32).clamp(0, last + 1);
        let to = (libm::ceil(middle + around) as i32).clamp(-1, last);
        for s in from..=to {
            let at = self.at(view, s as usize, footprint);
            let (first, end) = footprint.extent(1, at);
            if first <= y && y < end {
                reaching.some[reaching.n] = (s, weight(at));
                reaching.n += 1;
            }
        }
        reaching
    }
}

/// The lattice rows that reach a row of pixels in one sheet.
#[derive(Clone, Copy, Default)]
pub(crate) struct Reaching<W> {
    /// Index and weight of each.
    pub(crate) some: [(i32, W); REACHING],
    pub(crate) n: usize,
}
