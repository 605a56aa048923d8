//! Extinction, colour and light of a value, and the values at which the transfer function bends.
//!
//! Between two points a transfer function is smooth. So what f could look like on a stretch is
//! known from what was seen there and from the points between.

use glam::DVec3;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Compositing;
use slabcast_common::shade::{FILL, KEY, Light, Shading};
use slabcast_common::transfer::{Classifier, Domain};
use slabcast_common::view::View;

/// Extinction per vox, and that times the three colours.
pub(super) type Emission = [f64; 4];

/// Emission of an extinction and a colour.
pub(super) fn emission([sigma, r, g, b]: [f64; 4]) -> Emission {
    [sigma, sigma * r, sigma * g, sigma * b]
}

/// Extinction and colour at some bends of a transfer function.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bends {
    pub(super) least: Emission,
    pub(super) most: Emission,
    /// Largest difference between the two sides of a bend.
    pub(super) jump: f64,
}

impl Bends {
    fn and(&self, other: &Bends) -> Bends {
        let (a, b) = (self, other);
        Bends {
            least: std::array::from_fn(|c| a.least[c].min(b.least[c])),
            most: std::array::from_fn(|c| a.most[c].max(b.most[c])),
            jump: a.jump.max(b.jump),
        }
    }
}

/// A transfer function with its bends.
#[derive(Debug)]
pub(super) struct Looks {
    of: Classifier,
    /// Smallest and largest finite code.
    pub(super) min_code: f64,
    pub(super) max_code: f64,
    /// Largest extinction per vox of any code.
    pub(super) sigma_max: f64,
    /// Codes of the transfer function's points, ascending, and the volume's two ends.
    bends: Vec<f64>,
    /// `runs[l][i]`: the `2^l` bends from `i` on.
    runs: Vec<Vec<Bends>>,
    /// Distance from a bend at which its two sides are evaluated, in codes; more than the rounding
    /// of its code.
    beside: f64,
}

impl Looks {
    pub(super) fn new(spec: &SceneSpec) -> Looks {
        let of = Classifier::new(&spec.transfer, &spec.volume, Compositing::Linear);
        let summary = &spec.volume.summary;
        let (lo, hi) = (summary.min_code, summary.max_code);
        let code_of = |x: f64| match spec.transfer.domain {
            Domain::Value => (x - summary.map.offset) / summary.map.scale,
            Domain::Unit if summary.map.scale < 0.0 => hi - x * (hi - lo),
            Domain::Unit => lo + x * (hi - lo),
        };
        // Two points at one x make a step.
        let places = |x: Vec<f64>| {
            let step = |i: usize| [i.wrapping_sub(1), i + 1].iter().any(|&n| x.get(n) == x.get(i));
            (0..x.len()).map(|i| (code_of(x[i]), step(i))).collect::<Vec<_>>()
        };
        let mut points = places(spec.transfer.colors.iter().map(|p| p[0]).collect());
        points.extend(places(spec.transfer.opacities.iter().map(|p| p[0]).collect()));
        points.extend([(lo, false), (hi, false)]);
        points.retain(|(code, _)| (lo..=hi).contains(code));
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points.dedup_by(|next, kept| {
            let one = next.0 == kept.0;
            kept.1 |= one && next.1;
            one
        });
        let beside = 1e-10 * lo.abs().max(hi.abs()).max(hi - lo);
        let bend = |&(code, step): &(f64, bool)| {
            let at = |code: f64| emission(of.optics_at(code));
            let (before, on, behind) = (at(code - beside), at(code), at(code + beside));
            let one = |e: Emission| Bends { least: e, most: e, jump: 0.0 };
            let jump = (0..4).map(|c| (behind[c] - before[c]).abs()).fold(0.0, f64::max);
            let jump = if step { jump } else { 0.0 };
            Bends { jump, ..one(before).and(&one(on)).and(&one(behind)) }
        };
        let mut runs: Vec<Vec<Bends>> = vec![points.iter().map(bend).collect()];
        let mut length = 1;
        while 2 * length <= points.len() {
            let last = &runs[runs.len() - 1];
            let next = (0..=points.len() - 2 * length).map(|i| last[i].and(&last[i + length]));
            let next = next.collect();
            runs.push(next);
            length *= 2;
        }
        let bends = points.iter().map(|point| point.0).collect();
        let (min_code, max_code) = (lo, hi);
        let mut looks = Looks { of, min_code, max_code, sigma_max: 0.0, bends, runs, beside };
        looks.sigma_max = looks.bends(lo, hi).map_or(0.0, |bends| bends.most[0]);
        looks
    }

    /// Extinction per vox and linear colour at a code; nothing at NaN.
    #[inline]
    pub(super) fn at(&self, code: f64) -> [f64; 4] {
        self.of.optics_at(code)
    }

    /// Returns whether the extinction depends on the gradient.
    pub(super) fn is_modulated(&self) -> bool {
        self.of.is_modulated()
    }

    /// Factor of the extinction for a gradient in codes per vox.
    pub(super) fn gradient_factor(&self, gradient: DVec3) -> f64 {
        if !self.is_modulated() || gradient.is_nan() {
            return 1.0;
        }
        self.of.gradient_factor(gradient.length() / (self.max_code - self.min_code))
    }

    /// Returns extinction and colour at the bends between two codes; `None` if there are none.
    pub(super) fn bends(&self, lo: f64, hi: f64) -> Option<Bends> {
        let from = self.bends.partition_point(|&b| b < lo - self.beside);
        let to = self.bends.partition_point(|&b| b <= hi + self.beside);
        let level = to.checked_sub(from)?.checked_ilog2()?;
        let runs = &self.runs[level as usize];
        Some(runs[from].and(&runs[to - (1 << level)]))
    }

    /// Whether anything between two codes is visible.
    pub(super) fn visible(&self, lo: f64, hi: f64) -> bool {
        let (lo, hi) = (lo - self.beside, hi + self.beside);
        self.at(lo)[0] > 0.0
            || self.at(hi)[0] > 0.0
            || self.bends(lo, hi).is_some_and(|bends| bends.most[0] > 0.0)
    }
}

/// Light on the field.
#[derive(Debug)]
pub(super) struct Lamp {
    ambient: f64,
    diffuse: f64,
    specular: f64,
    power: f64,
    /// Unit direction to the light in eye axes; `None` where the eye holds it.
    to_light: Option<DVec3>,
    /// Share of diffuse light from the eye.
    fill: f64,
    /// Length of the vector to the eye that is added to a gradient, in codes per vox.
    to_face: f64,
}

impl Lamp {
    /// `None` if the scene is unlit. `range` is the difference of the largest and the smallest
    /// code.
    pub(super) fn new(shading: &Shading, view: &View, range: f64) -> Option<Lamp> {
        let (to_light, fill) = match shading.light {
            Light::Key => (Some(DVec3::from_array(KEY)), FILL),
            Light::Head => (None, 0.0),
            Light::Direction(d) => {
                let d = DVec3::from_array(d);
                (Some(view.eye_from_world * (d / d.length())), 0.0)
            }
        };
        shading.on.then_some(Lamp {
            ambient: shading.ambient,
            diffuse: shading.diffuse,
            specular: shading.specular,
            power: shading.power,
            to_light,
            fill,
            to_face: range / 1020.0,
        })
    }

    /// The colour `rgb`, lit, where the field has `gradient` (eye axes, codes per vox).
    pub(super) fn light(&self, rgb: [f64; 3], gradient: DVec3, to_eye: DVec3) -> [f64; 3] {
        let side = if gradient.dot(to_eye) < 0.0 { -1.0 } else { 1.0 };
        let normal = unit(gradient * side + to_eye * self.to_face, to_eye);
        let to_light = self.to_light.unwrap_or(to_eye);
        let half = match self.to_light {
            None => to_eye,
            // Right behind there is no gloss.
            Some(light) => unit(light + to_eye, DVec3::ZERO),
        };
        let [key, fill] = [to_light, to_eye].map(|d| normal.dot(d).max(0.0));
        let lambert = self.ambient + self.diffuse * (key + (fill - key) * self.fill);
        let gloss = self.specular * libm::pow(normal.dot(half).max(0.0), self.power);
        rgb.map(|c| (c * lambert + gloss).clamp(0.0, 1.0))
    }
}

/// The direction of `v`, or `otherwise` if it has none.
fn unit(v: DVec3, otherwise: DVec3) -> DVec3 {
    let length = v.length();
    if length > 0.0 { v / length } else { otherwise }
}
