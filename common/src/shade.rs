//! Normals in 16 bits and the light on them.
//!
//! A normal is stored as an octahedral code of 8 + 8 bits (255 levels a side, so that the axes are
//! exact). Code [`NO_NORMAL`] says that the gradient was zero or not finite; such voxels are drawn
//! unshaded.

use glam::{DMat3, DVec3, Vec3};
use serde::{Deserialize, Serialize};

/// Normal code of a voxel without a gradient.
pub const NO_NORMAL: u16 = 0xFFFF;

/// Returns the octahedral code of the direction of `v` (any length), or [`NO_NORMAL`] if it has
/// none.
pub fn encode_normal(v: DVec3) -> u16 {
    let largest = v.x.abs().max(v.y.abs()).max(v.z.abs());
    if largest == 0.0 || !v.is_finite() {
        return NO_NORMAL;
    }
    let v = v / largest;
    let v = v / (v.x.abs() + v.y.abs() + v.z.abs());
    let (mut x, mut y) = (v.x, v.y);
    if v.z < 0.0 {
        let sign = |a: f64| if a < 0.0 { -1.0 } else { 1.0 };
        (x, y) = ((1.0 - v.y.abs()) * sign(v.x), (1.0 - v.x.abs()) * sign(v.y));
    }
    // 0..=254, 127 is the centre; 255 never occurs, which leaves NO_NORMAL free.
    // Truncation is `floor` here: what lies below 0 (a rounding below -1) becomes 0 by either.
    let level = |a: f64| ((a * 127.0 + 127.5) as u16).min(254);
    (level(x) << 8) | level(y)
}

/// Returns the unit vector of a code other than [`NO_NORMAL`].
#[inline(always)]
pub fn decode_normal(code: u16) -> Vec3 {
    let x = ((code >> 8) as f32 - 127.0) / 127.0;
    let y = ((code & 255) as f32 - 127.0) / 127.0;
    let z = 1.0 - x.abs() - y.abs();
    let t = if z < 0.0 { -z } else { 0.0 };
    let x = if x < 0.0 { x + t } else { x - t };
    let y = if y < 0.0 { y + t } else { y - t };
    let scale = 1.0 / (x * x + y * y + z * z).sqrt();
    Vec3::new(x * scale, y * scale, z * scale)
}

/// Source of light: a key light with fill, the eye, or a direction.
///
/// With the normal n turned towards the eye, e the direction to the eye, l that to the light and h
/// half-way between both, all of unit length, a base colour c becomes
///
/// ```text
/// c (ambient + diffuse ((1 - fill) max(0, n.l) + fill max(0, n.e))) + specular max(0, n.h)^power
/// ```
///
/// in linear light, clamped to `[0, 1]`. The fill is [`FILL`] for the key light and 0 for others.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(from = "WrittenLight", into = "WrittenLight")]
pub enum Light {
    /// From up left and in front, wherever the camera is ([`KEY`]), with a fill from the eye.
    Key,
    /// From the eye: l = e.
    Head,
    /// From a direction in world axes, of any length.
    Direction([f64; 3]),
}

/// Unit direction to the key light in eye axes (right, down, away): 41 degrees to the left of the
/// eye and 33 above it, 50 from it in all.
///
/// People who aren't told take light to come from up left, and painters and map makers put it
/// there. The angle is what photographers use for faces. Of a ball, 18 % of what is seen turn away
/// from the light. At 36 degrees from the eye it is 9 % and relief is fainter, at 70 it is 33 % and
/// a third of a picture is in shadow.
pub const KEY: [f64; 3] = [-6.0 / 11.0, -6.0 / 11.0, -7.0 / 11.0];

/// Share of the key light's diffuse light that comes from the eye, so that nothing that faces the
/// camera is black.
///
/// The shadow's side has this light and the ambient alone, so both decide how deep pictures look:
/// greys at the 95th percentile are over those at the 5th (8-bit sRGB, pixels of the object;
/// presets skin, bone, brain and auto) by 3.4 in a head, 3.1 in a skull, 3.4 in a brain and 3.1 in
/// an engine block. A fill of 0.2 makes 2.8, 2.6, 2.8 and 2.5 of it; 0.06 makes 4.4, 3.8, 4.2 and
/// 3.9, and the dark side of a face is nearly black.
pub const FILL: f64 = 0.12;

/// [`Light`] in JSON.
#[derive(Serialize, Deserialize)]
#[serde(untagged, expecting = "give \"key\", \"head\" or a direction [x, y, z] in world axes")]
enum WrittenLight {
    Word(LightWord),
    Direction([f64; 3]),
}

#[derive(Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum LightWord {
    Key,
    Head,
}

impl From<WrittenLight> for Light {
    fn from(written: WrittenLight) -> Light {
        match written {
            WrittenLight::Word(LightWord::Key) => Light::Key,
            WrittenLight::Word(LightWord::Head) => Light::Head,
            WrittenLight::Direction(d) => Light::Direction(d),
        }
    }
}

impl From<Light> for WrittenLight {
    fn from(light: Light) -> WrittenLight {
        match light {
            Light::Key => WrittenLight::Word(LightWord::Key),
            Light::Head => WrittenLight::Word(LightWord::Head),
            Light::Direction(d) => WrittenLight::Direction(d),
        }
    }
}

/// Ambient, Lambert and Blinn-Phong shading by the formula of [`Light`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Shading {
    /// Whether voxels are shaded at all; if not, no normals are needed.
    pub on: bool,
    /// Share of ambient light in the base colour, 0 to 10; unitless.
    pub ambient: f64,
    /// Share of diffuse (Lambert) light in the base colour, 0 to 10; unitless.
    pub diffuse: f64,
    /// Share of specular (Blinn-Phong) light, added in white, 0 to 10; unitless.
    pub specular: f64,
    /// Exponent of the specular light, 0 to 10000; unitless.
    pub power: f64,
    /// Light source: fixed to the camera, or a direction in the world.
    pub light: Light,
}

/// White gets at most 0.98 of ambient and diffuse key light: only the highlight can blow it out.
/// Ambient light counts in linear light: 0.2 of it would be half grey on the screen, and 0.02 is a
/// seventh.
impl Default for Shading {
    fn default() -> Self {
        Shading {
            on: true,
            ambient: 0.02,
            diffuse: 1.0,
            specular: 0.1,
            power: 20.0,
            light: Light::Key,
        }
    }
}

/// Largest whole power that is multiplied out; others are looked up.
const POWER_MOST: f64 = 1024.0;

/// Steps of the table of `x^power` from 2^-24 to 1, which are 17 e-folds whatever the power; with linear
/// interpolation the error is 1e-5 of the specular term, a hundredth of an 8-bit step. Powers below 1 are
/// steep at 0: at 0.5 the error there is 0.006.
const POWER_STEPS: usize = 2048;

/// `x^power` for x from 0 to 1.
#[derive(Clone, Debug)]
enum Power {
    /// Whole powers, by squaring: nearer to the formula, and without two look-ups a voxel. Bases
    /// below `least` are raised to it: its power is 2^-120, invisible in any picture, and denormal
    /// numbers take a processor a hundred times as long.
    Whole { power: u32, least: f32 },
    /// By a table of equal steps from `least`, whose power is 2^-24, to 1.
    Table { least: f32, steps_per_unit: f32, table: Box<[f32; POWER_STEPS + 2]> },
}

impl Power {
    fn new(power: f64) -> Power {
        if (0.0..=POWER_MOST).contains(&power) && power.fract() == 0.0 {
            let least = if power > 0.0 { libm::exp2(-120.0 / power) as f32 } else { 0.0 };
            return Power::Whole { power: power as u32, least };
        }
        let least = libm::exp2(-24.0 / power) as f32;
        let steps_per_unit = POWER_STEPS as f64 / (1.0 - f64::from(least));
        let mut table = Box::new([0.0; POWER_STEPS + 2]);
        for (i, p) in table.iter_mut().enumerate() {
            let x = f64::from(least) + i as f64 / steps_per_unit;
            *p = libm::pow(x.min(1.0), power) as f32;
        }
        Power::Table { least, steps_per_unit: steps_per_unit as f32, table }
    }

    /// Raises the first `n` of `x`.
    #[inline(always)]
    fn raise_all<const MOST: usize>(&self, x: &mut [f32; MOST], n: usize) {
        let x = &mut x[..n];
        match self {
            Power::Whole { power, least } => {
                let mut squares = [1.0; MOST];
                let squares = &mut squares[..n];
                for (square, x) in squares.iter_mut().zip(&mut *x) {
                    (*square, *x) = (x.clamp(*least, 1.0), 1.0);
                }
                let mut bits = *power;
                while bits > 0 {
                    if bits & 1 == 1 {
                        x.iter_mut().zip(&*squares).for_each(|(x, square)| *x *= square);
                    }
                    bits >>= 1;
                    if bits == 0 {
                        break;
                    }
                    squares.iter_mut().for_each(|square| *square *= *square);
                }
            }
            Power::Table { least, steps_per_unit, table } => {
                for x in x {
                    // Between two steps of the table.
                    let at = (x.clamp(*least, 1.0) - least) * steps_per_unit;
                    let step = at as i32;
                    let part = at - step as f32;
                    let step = (step as usize).min(POWER_STEPS);
                    *x = table[step] * (1.0 - part) + table[step + 1] * part;
                }
            }
        }
    }
}

/// A light that is not at the eye, in one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lamp {
    /// Unit direction to the light.
    pub to_light: Vec3,
    /// Share of diffuse light that comes from the eye instead, 0 to 1.
    pub fill: f32,
}

impl Lamp {
    /// Returns the share of diffuse light on a normal with these cosines to the light and the eye.
    #[inline(always)]
    pub fn lambert(&self, n_light: f32, n_eye: f32) -> f32 {
        (1.0 - self.fill) * n_light.max(0.0) + self.fill * n_eye.max(0.0)
    }
}

/// Shading made ready for many voxels of one view: f32 factors, the light's direction, the
/// specular power.
#[derive(Clone, Debug)]
pub struct Shader {
    ambient: f32,
    diffuse: f32,
    specular: f32,
    /// The light in world axes; `None` for a head light.
    lamp: Option<Lamp>,
    power: Power,
}

impl Shader {
    /// Builds a shader from `shading`, whose values must be valid, for views of a camera with these
    /// axes ([`View::eye_from_world`](crate::view::View::eye_from_world)).
    pub fn new(shading: &Shading, eye_from_world: &DMat3) -> Self {
        let lamp = |d: DVec3, fill: f64| {
            let d = d / d.length();
            Lamp { to_light: Vec3::new(d.x as f32, d.y as f32, d.z as f32), fill: fill as f32 }
        };
        let lamp = match shading.light {
            Light::Key => {
                // A rotation: its inverse is its transpose.
                Some(lamp(eye_from_world.transpose() * DVec3::from_array(KEY), FILL))
            }
            Light::Head => None,
            Light::Direction(d) => Some(lamp(DVec3::from_array(d), 0.0)),
        };
        Shader {
            ambient: shading.ambient as f32,
            diffuse: shading.diffuse as f32,
            specular: shading.specular as f32,
            lamp,
            power: Power::new(shading.power),
        }
    }

    /// Returns the colour (linear RGB in `[0, 1]`) of a voxel with linear base colour `base` and
    /// normal code `normal`. `to_eye` is the unit direction towards the eye in world axes.
    #[inline]
    pub fn shade(&self, base: [f32; 3], normal: u16, to_eye: Vec3) -> [f32; 3] {
        let light = self.light_terms(normal, to_eye);
        base.map(|c| light.apply(c))
    }

    /// Returns the light on a voxel with normal code `normal`. `to_eye` is the unit direction
    /// towards the eye in world axes.
    #[inline]
    pub fn light_terms(&self, normal: u16, to_eye: Vec3) -> LightTerms {
        let mut lit = [[0.0]; 2];
        self.light_terms_all(&[normal], |_| to_eye, &mut lit);
        LightTerms { lambert: lit[0][0], gloss: lit[1][0] }
    }

    /// Returns the light in world axes; `None` for a head light.
    pub fn lamp(&self) -> Option<Lamp> {
        self.lamp
    }

    /// Turns the first `n` shares of diffuse light (the cosine to the light, or [`Lamp::lambert`])
    /// into factors of base colours, and cosines between normals and the half vector into what is
    /// added.
    #[inline(always)]
    pub fn terms<const MOST: usize>(
        &self,
        light: &mut [f32; MOST],
        half: &mut [f32; MOST],
        n: usize,
    ) {
        self.power.raise_all(half, n);
        for i in 0..n.min(MOST) {
            light[i] = self.ambient + self.diffuse * light[i].max(0.0);
            half[i] *= self.specular;
        }
    }

    /// Computes [`Shader::light_terms`] of many voxels. Voxel i has normal code `normals[i]` and
    /// sees the eye in unit direction `to_eye(i)`. `lit[0]` gets the factors of base colours,
    /// `lit[1]` what is added. Loops run over plain arrays of a length that compilers don't know,
    /// so that they vectorise.
    #[inline(always)]
    pub fn light_terms_all<const MOST: usize>(
        &self,
        normals: &[u16],
        to_eye: impl Fn(usize) -> Vec3,
        lit: &mut [[f32; MOST]; 2],
    ) {
        let n = normals.len().min(MOST);
        let normals = &normals[..n];
        let [light, half] = lit;
        match self.lamp {
            None => {
                for i in 0..n {
                    let (normal, to_eye) = (decode_normal(normals[i]), to_eye(i));
                    // n = -gradient/|gradient| turned towards the eye: the sign of the stored
                    // vector drops out, since it is turned anyway.
                    let n_eye = normal.x * to_eye.x + normal.y * to_eye.y + normal.z * to_eye.z;
                    light[i] = n_eye.abs();
                    half[i] = light[i];
                }
            }
            Some(lamp) => {
                let l = lamp.to_light;
                for i in 0..n {
                    let (n, to_eye) = (decode_normal(normals[i]), to_eye(i));
                    let h = l + to_eye;
                    let len2 = h.x * h.x + h.y * h.y + h.z * h.z;
                    let per_len = if len2 > 1e-12 { 1.0 / len2.sqrt() } else { 0.0 };
                    let n_eye = n.x * to_eye.x + n.y * to_eye.y + n.z * to_eye.z;
                    let side = if n_eye < 0.0 { -1.0 } else { 1.0 };
                    let n_light = (n.x * l.x + n.y * l.y + n.z * l.z) * side;
                    light[i] = lamp.lambert(n_light, n_eye.abs());
                    half[i] = (n.x * h.x + n.y * h.y + n.z * h.z) * side * per_len;
                }
            }
        }
        self.terms(light, half, n);
        for i in 0..n {
            let (diffuse, gloss) = (light[i], half[i]);
            light[i] = if normals[i] != NO_NORMAL { diffuse } else { 1.0 };
            half[i] = if normals[i] != NO_NORMAL { gloss } else { 0.0 };
        }
    }
}

/// Light on a voxel: a factor of its base colour, and white that is added.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LightTerms {
    /// Unitless factor of the base colour: ambient and diffuse light.
    pub lambert: f32,
    /// Specular light added to each component in linear light; 1 = white.
    pub gloss: f32,
}

impl LightTerms {
    /// Returns one component of the shaded linear colour, 0 to 1, given that component of the base
    /// colour.
    #[inline(always)]
    pub fn apply(self, base: f32) -> f32 {
        (base * self.lambert + self.gloss).clamp(0.0, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn normals_come_back_within_a_degree(x in -1.0..1.0f64, y in -1.0..1.0f64, z in -1.0..1.0f64) {
            let v = DVec3::new(x, y, z);
            prop_assume!(v.length() > 1e-3);
            let code = encode_normal(v);
            prop_assert_ne!(code, NO_NORMAL);
            let d = decode_normal(code);
            let dot = DVec3::new(d.x as f64, d.y as f64, d.z as f64).dot(v / v.length());
            prop_assert!(dot > 0.9998, "{v} came back as {d}: dot {dot}");
        }
    }

    #[test]
    fn axes_are_exact_and_nothing_has_no_normal() {
        for (v, want) in [
            (DVec3::X, Vec3::X),
            (-DVec3::X, -Vec3::X),
            (DVec3::Y * 1e300, Vec3::Y),
            (-DVec3::Z * 1e-300, -Vec3::Z),
            (DVec3::Z, Vec3::Z),
        ] {
            let got = decode_normal(encode_normal(v));
            assert!((got - want).length() < 1e-6, "{v}: {got}");
        }
        assert_eq!(encode_normal(DVec3::ZERO), NO_NORMAL);
        assert_eq!(encode_normal(DVec3::new(f64::NAN, 1.0, 0.0)), NO_NORMAL);
    }

    #[test]
    fn powers_are_powers_whether_they_are_multiplied_out_or_looked_up() {
        // 1000.0001 beside 1000 is the story: a table from 0 to 1 was off by 2/255, at 1e4 by 32.
        let whole = [0.0, 1.0, 2.0, 3.0, 20.0, 255.0, 1000.0, 1024.0];
        let looked_up = [0.5, 1.5, 19.5, 1000.0001, 1500.0, 1e4];
        for power in whole.into_iter().chain(looked_up) {
            let of = Power::new(power);
            let near_one = (0..=1000).map(|i| 1.0 - f64::from(i) * 1e-6);
            for x in (0..=1000).map(|i| f64::from(i) / 1000.0).chain(near_one) {
                // Bases of 32 bits, so that their rounding is not counted.
                let x = f64::from(x as f32);
                let mut raised = [x as f32, 0.5];
                of.raise_all(&mut raised, 1);
                let off = (f64::from(raised[0]) - libm::pow(x, power)).abs();
                let most = match &of {
                    Power::Whole { .. } => 1e-4 * libm::pow(x, power) + 1e-36,
                    Power::Table { .. } if power < 1.0 => 0.01,
                    Power::Table { .. } => 1e-4,
                };
                assert!(off <= most && raised[1] == 0.5, "{x}^{power} is off by {off}");
            }
        }
    }

    /// The formula of [`Light`] in f64, in world axes; `n` and `e` of unit length.
    fn formula(
        s: &Shading,
        eye_from_world: &DMat3,
        base: [f64; 3],
        [n, e]: [DVec3; 2],
    ) -> [f64; 3] {
        let n = if n.dot(e) < 0.0 { -n } else { n };
        let (l, fill) = match s.light {
            Light::Key => (eye_from_world.transpose() * DVec3::from_array(KEY), FILL),
            Light::Head => (e, 0.0),
            Light::Direction(d) => (DVec3::from_array(d).normalize(), 0.0),
        };
        let [n_l, n_e, n_h] = [l, e, (l + e).normalize()].map(|d| n.dot(d).max(0.0));
        let diffuse = s.diffuse * ((1.0 - fill) * n_l + fill * n_e);
        let gloss = s.specular * libm::pow(n_h, s.power);
        base.map(|c| (c * (s.ambient + diffuse) + gloss).clamp(0.0, 1.0))
    }

    #[test]
    fn every_light_is_the_formula_from_all_sides() {
        let base = [0.5, 0.25, 1.0];
        let turned = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(-1.9);
        for light in [Light::Key, Light::Head, Light::Direction([0.0, -3.0, 2.0])] {
            let shading = Shading { light, ambient: 0.1, power: 7.5, ..Shading::default() };
            for eye_from_world in [DMat3::IDENTITY, turned] {
                let shader = Shader::new(&shading, &eye_from_world);
                for i in 0..200 {
                    let at = f64::from(i);
                    let normal = encode_normal(DVec3::new(
                        libm::sin(at),
                        libm::cos(at * 2.3),
                        libm::sin(at * 1.7),
                    ));
                    let to_eye = DVec3::new(0.3 * libm::sin(at * 3.1), 0.2, -1.0).normalize();
                    let to_eye = eye_from_world.transpose() * to_eye;
                    let n = decode_normal(normal).as_dvec3();
                    let want = formula(&shading, &eye_from_world, base, [n, to_eye]);
                    let got = shader.shade(base.map(|c| c as f32), normal, to_eye.as_vec3());
                    for c in 0..3 {
                        let off = (f64::from(got[c]) - want[c]).abs();
                        assert!(off < 1e-4, "{light:?} on {n}: {} for {}", got[c], want[c]);
                    }
                }
                let unlit = base.map(|c| c as f32);
                assert_eq!(shader.shade(unlit, NO_NORMAL, Vec3::Z), unlit);
            }
        }
    }

    #[test]
    fn key_light_falls_from_up_left_and_fills_what_turns_away_from_it() {
        let s = Shading::default();
        let shader = Shader::new(&s, &DMat3::IDENTITY);
        let lambert = |n: DVec3| f64::from(shader.light_terms(encode_normal(n), -Vec3::Z).lambert);
        // Slanted normals are rounded to a degree.
        let near = |got: f64, want: f64| assert!((got - want).abs() < 0.01, "{got} for {want}");
        // Facing the eye, whichever side of the surface.
        for n in [-DVec3::Z, DVec3::Z] {
            near(lambert(n), s.ambient + s.diffuse * ((1.0 - FILL) * 7.0 / 11.0 + FILL));
            let gloss = shader.light_terms(encode_normal(n), -Vec3::Z).gloss;
            // The half vector is at an angle with the square of its cosine (1 + 7/11) / 2.
            near(gloss.into(), s.specular * (9.0f64 / 11.0).powi(10));
        }
        // To the left and the right, up and down, by as much towards the eye.
        let facing = |x: f64, y: f64| lambert(DVec3::new(x, y, -1.0));
        let share = |cosine: f64| (1.0 - FILL) * cosine + FILL;
        let root = 0.5f64.sqrt();
        near(facing(-1.0, 0.0), s.ambient + s.diffuse * root * share(13.0 / 11.0));
        near(facing(1.0, 0.0), s.ambient + s.diffuse * root * share(1.0 / 11.0));
        near(facing(0.0, -1.0), facing(-1.0, 0.0));
        // Down right the light is behind: the fill is left.
        let third = (1.0f64 / 3.0).sqrt();
        near(facing(1.0, 1.0), s.ambient + s.diffuse * FILL * third);
        // Edge on and away from the light: ambient alone.
        near(lambert(DVec3::X), s.ambient);
    }

    #[test]
    fn lights_have_words_in_json() {
        for (light, json) in [
            (Light::Key, "\"key\""),
            (Light::Head, "\"head\""),
            (Light::Direction([1.0, 0.0, -2.5]), "[1.0,0.0,-2.5]"),
        ] {
            assert_eq!(serde_json::to_string(&light).unwrap(), json);
            assert_eq!(serde_json::from_str::<Light>(json).unwrap(), light);
        }
        for bad in ["\"sun\"", "[1,2]", "3", "null"] {
            let said = serde_json::from_str::<Light>(bad).unwrap_err().to_string();
            assert!(said.contains("\"key\", \"head\""), "{bad}: {said}");
        }
    }
}
