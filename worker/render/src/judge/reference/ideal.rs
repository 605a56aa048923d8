//! Two ideals beside the limit: without truncation and without ripple.
//!
//! The limit is defined with the model's kernel, which is cut at its radius and does not add up
//! to a constant. So what these two cost is no part of a picture's distance from the limit: it is
//! the distance of the limit itself from an ideal, an error of the model. Sheets do not make
//! it, and thinner sheets do not mend it.
//!
//! - *Truncation*: against the limit with the whole Gaussian of the same deviation, neither cut
//!   nor lowered by its edge value.
//! - *Ripple*: against the limit of a field whose two kernel sums are divided by what the sum
//!   would be at that point if every place of an endless lattice held a one. A constant field
//!   then comes back constant. The divisor is summed where it is needed, place by place: it is
//!   periodic and could be a table, but a table would have an error of its own, and for the
//!   few hundred pixels that one asks for the sum takes less time than filling the table.

use super::Reference;
use super::walk::{Near, Ray};
use glam::DVec3;

impl Reference {
    /// Returns this reference with the whole Gaussian instead of the truncated kernel. Its tail is
    /// cut where less than 1e-9 is left, times the largest extinction: 3.7 lattice steps for a
    /// deviation of 0.6 and ordinary opacities. Changes [`Reference::pixel`] alone; sheets keep the
    /// model's kernel.
    #[must_use]
    pub fn without_truncation(self) -> Reference {
        let most = self.looks.payload_max();
        Reference { kernel: self.kernel.each_ref().map(|k| k.untruncated(most)), ..self }
    }

    /// Returns this reference with kernel sums divided by the kernel's sum over the infinite
    /// lattice, so that a constant field comes back constant. Changes [`Reference::pixel`] alone.
    #[must_use]
    pub fn without_ripple(self) -> Reference {
        Reference { level: true, ..self }
    }

    /// Every place of the endless lattice whose kernel the ray meets between two depths, with a
    /// payload of one.
    pub(super) fn places(&self, ray: &Ray, from: f64, to: f64, out: &mut Vec<Near>) {
        out.clear();
        let m = self.index_from_eye;
        let at = |z: f64| {
            let eye = DVec3::new(ray.at[0] + ray.slope[0] * z, ray.at[1] + ray.slope[1] * z, z);
            m * (eye - self.origin)
        };
        let radius = self.kernel.each_ref().map(|k| k.radius);
        let reach =
            m.x_axis.abs() * radius[0] + m.y_axis.abs() * radius[1] + m.z_axis.abs() * radius[2];
        let (p, q) = (at(from), at(to));
        let first = (p.min(q) - reach).to_array().map(|x| libm::floor(x) as i64);
        let last = (p.max(q) + reach).to_array().map(|x| libm::ceil(x) as i64);
        let (steps, origin) = (self.steps, self.origin);
        for k in first[2]..=last[2] {
            for j in first[1]..=last[1] {
                for i in first[0]..=last[0] {
                    let eye = origin + steps * DVec3::new(i as f64, j as f64, k as f64);
                    let Some((enter, leave)) = ray.inside(eye, eye, radius) else { continue };
                    if enter >= to || leave <= from {
                        continue;
                    }
                    let (x, y) = (ray.at[0] - eye.x, ray.at[1] - eye.y);
                    let mut one = self.view.cell;
                    if ray.parallel {
                        one *= self.kernel[0].at(x) * self.kernel[1].at(y);
                    }
                    let payload = [one, 0.0, 0.0, 0.0];
                    out.push(Near { enter, leave, x, y, z: eye.z, payload });
                }
            }
        }
    }
}
