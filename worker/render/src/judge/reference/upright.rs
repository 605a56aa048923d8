//! The ellipsoid of a lattice that is not cubic, by Cholesky's factors of its covariance.
//!
//! With G the covariance of a kernel of deviation one, as the eye sees it, z of a point is a third
//! of what is known of it; y has the regression `Gyz / Gzz` on z and what is left of its deviation,
//! and x those on z and on what is left of y. Less these regressions a point is *upright*: there
//! the kernel is a product.

use glam::{DMat3, DVec3};
use slabcast_common::view::View;

/// Deviations of the kernel's profiles in lattice steps, and its slopes, in `view` of a kernel of
/// `std` steps.
pub(super) fn of(view: &View, std: f64) -> ([f64; 3], [f64; 3]) {
    if view.kernel_lean.is_none() {
        // It may be cubic but for rounding, and then it is drawn as if it were.
        return ((view.kernel_std / std).to_array(), [0.0; 3]);
    }
    let g = view.eye_from_index * view.eye_from_index.transpose();
    let [xx, xy, xz] = g.row(0).to_array();
    let [_, yy, yz] = g.row(1).to_array();
    let zz = g.row(2).z;
    let left_yy = yy - yz * yz / zz;
    let left_xy = xy - xz * yz / zz;
    let left_xx = xx - xz * xz / zz - left_xy * left_xy / left_yy;
    ([left_xx, left_yy, zz].map(f64::sqrt), [xz / zz, yz / zz, left_xy / left_yy])
}

/// A point, upright.
pub(super) fn point(p: DVec3, [x, y, row]: [f64; 3]) -> DVec3 {
    let left = p.y - y * p.z;
    DVec3::new(p.x - x * p.z - row * left, left, p.z)
}

/// An upright point as the eye sees it.
pub(super) fn seen(p: DVec3, [x, y, row]: [f64; 3]) -> DVec3 {
    DVec3::new(p.x + x * p.z + row * p.y, p.y + y * p.z, p.z)
}

/// Steps of a lattice (columns), upright.
pub(super) fn steps(m: &DMat3, lean: [f64; 3]) -> DMat3 {
    let [i, j, k] = [m.x_axis, m.y_axis, m.z_axis].map(|v| point(v, lean));
    DMat3::from_cols(i, j, k)
}
