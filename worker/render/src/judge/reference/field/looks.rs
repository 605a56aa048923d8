//! What a value looks like: where the transfer function bends, and light.
//!
//! Between two points a transfer function is smooth. So what f could look like on a stretch is
//! known from its ends and the points between: extinctions and colours are monotone from point to
//! point.

use glam::DVec3;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Compositing;
use slabcast_common::shade::{Light, Shading};
use slabcast_common::transfer::{Classifier, Domain};
use slabcast_common::view::View;

/// Least and most of extinction and the three colours.
type Span = [[f64; 4]; 2];

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
    /// `spans[l][i]`: of the bends from `i` on, `2^l` of them.
    spans: Vec<Vec<Span>>,
    /// How far from a bend its two sides are looked at, in codes; more than the rounding of its
    /// code.
    beside: f64,
}

fn union(a: Span, b: Span) -> Span {
    [std::array::from_fn(|c| a[0][c].min(b[0][c])), std::array::from_fn(|c| a[1][c].max(b[1][c]))]
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
        let colours = spec.transfer.colors.iter().map(|p| code_of(p[0]));
        let opacities = spec.transfer.opacities.iter().map(|p| code_of(p[0]));
        let mut bends: Vec<f64> = colours.chain(opacities).chain([lo, hi]).collect();
        bends.retain(|code| (lo..=hi).contains(code));
        bends.sort_by(f64::total_cmp);
        bends.dedup();
        let beside = 1e-10 * lo.abs().max(hi.abs()).max(hi - lo);
        let span = |&code: &f64| {
            let at = |code: f64| [of.optics_at(code); 2];
            union(at(code), union(at(code - beside), at(code + beside)))
        };
        let mut spans: Vec<Vec<Span>> = vec![bends.iter().map(span).collect()];
        let mut reach = 1;
        while 2 * reach <= bends.len() {
            let last = &spans[spans.len() - 1];
            let next = (0..=bends.len() - 2 * reach).map(|i| union(last[i], last[i + reach]));
            let next = next.collect();
            spans.push(next);
            reach *= 2;
        }
        let mut looks =
            Looks { of, min_code: lo, max_code: hi, sigma_max: 0.0, bends, spans, beside };
        looks.sigma_max = looks.bends(lo, hi).map_or(0.0, |[_, most]| most[0]);
        looks
    }

    /// Extinction per vox and linear colour at a code; nothing at NaN.
    #[inline]
    pub(super) fn at(&self, code: f64) -> [f64; 4] {
        self.of.optics_at(code)
    }

    /// What bends between two codes look like; `None` if there are none.
    pub(super) fn bends(&self, lo: f64, hi: f64) -> Option<Span> {
        let from = self.bends.partition_point(|&b| b < lo - self.beside);
        let to = self.bends.partition_point(|&b| b <= hi + self.beside);
        let level = to.checked_sub(from)?.checked_ilog2()?;
        let level_spans = &self.spans[level as usize];
        Some(union(level_spans[from], level_spans[to - (1 << level)]))
    }

    /// Whether anything between two codes is visible.
    pub(super) fn visible(&self, lo: f64, hi: f64) -> bool {
        let (lo, hi) = (lo - self.beside, hi + self.beside);
        self.at(lo)[0] > 0.0
            || self.at(hi)[0] > 0.0
            || self.bends(lo, hi).is_some_and(|[_, most]| most[0] > 0.0)
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
    /// How much of the direction to the eye is added to a gradient, in codes per vox.
    to_face: f64,
}

impl Lamp {
    /// `None` if the scene is unlit. `range` is the difference of the largest and the smallest
    /// code.
    pub(super) fn new(shading: &Shading, view: &View, range: f64) -> Option<Lamp> {
        let to_light = match shading.light {
            Light::Head(_) => None,
            Light::Direction(d) => {
                let d = DVec3::from_array(d);
                Some(view.eye_from_world * (d / d.length()))
            }
        };
        shading.on.then_some(Lamp {
            ambient: shading.ambient,
            diffuse: shading.diffuse,
            specular: shading.specular,
            power: shading.power,
            to_light,
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
        let lambert = self.ambient + self.diffuse * normal.dot(to_light).max(0.0);
        let gloss = self.specular * libm::pow(normal.dot(half).max(0.0), self.power);
        rgb.map(|c| (c * lambert + gloss).clamp(0.0, 1.0))
    }
}

/// The direction of `v`, or `otherwise` if it has none.
fn unit(v: DVec3, otherwise: DVec3) -> DVec3 {
    let length = v.length();
    if length > 0.0 { v / length } else { otherwise }
}
