//! Changes of a shot that must not change its picture: unit of length, origin, storage order and
//! sample type. Each changes the volume, the camera and the transfer function consistently.

use super::shot::Shot;
use glam::DVec3;
use slabcast_common::shade::Light;
use slabcast_common::transfer::OpacityUnit;
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::sync::Arc;

/// A permutation and flip of axes: for each new axis the old one, and whether it is reversed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Turn {
    pub(crate) from: [usize; 3],
    pub(crate) flipped: [bool; 3],
}

impl Turn {
    /// Returns all 48 permutations and flips of three axes, the identity first.
    pub(crate) fn all() -> Vec<Turn> {
        const ORDERS: [[usize; 3]; 6] =
            [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]];
        let flips = (0..8usize).map(|b| [b & 1 != 0, b & 2 != 0, b & 4 != 0]);
        flips.flat_map(|flipped| ORDERS.map(|from| Turn { from, flipped })).collect()
    }

    /// Whether the turn changes handedness, so that the picture is mirrored.
    pub(crate) fn mirrors(self) -> bool {
        let odd = matches!(self.from, [0, 2, 1] | [2, 1, 0] | [1, 0, 2]);
        odd != (self.flipped.iter().filter(|&&f| f).count() % 2 == 1)
    }

    fn vector(self, v: DVec3) -> DVec3 {
        let v = v.to_array();
        DVec3::from_array(std::array::from_fn(|a| {
            if self.flipped[a] { -v[self.from[a]] } else { v[self.from[a]] }
        }))
    }
}

impl Shot {
    /// Scales the scene: every length becomes `s` times as long.
    pub(crate) fn scaled(&self, s: f64) -> Shot {
        let mut w = self.clone();
        let l = self.volume.lattice;
        let l = Lattice { steps: l.steps.map(|v| v * s), origin: l.origin * s, ..l };
        w.volume = self.on(l);
        let longer = |v: [f64; 3]| v.map(|x| x * s);
        w.view.eye = longer(w.view.eye);
        w.view.target = longer(w.view.target);
        w.view.height = w.view.height.map(|h| h * s);
        if w.transfer.opacity_unit == OpacityUnit::Extinction {
            w.transfer.opacities.iter_mut().for_each(|o| o[1] /= s);
            w.transfer.nan.opacity /= s;
        }
        w
    }

    /// Moves the scene by `by` world units.
    pub(crate) fn moved(&self, by: DVec3) -> Shot {
        let mut w = self.clone();
        let l = self.volume.lattice;
        w.volume = self.on(Lattice { origin: l.origin + by, ..l });
        let there = |v: [f64; 3]| (DVec3::from_array(v) + by).to_array();
        w.view.eye = there(w.view.eye);
        w.view.target = there(w.view.target);
        w
    }

    /// Permutes and flips the axes of samples, lattice (whose steps stay positive), camera and
    /// light.
    pub(crate) fn turned(&self, t: Turn) -> Shot {
        let mut w = self.stored(t);
        let l = w.volume.lattice;
        let steps = l.steps.map(|v| t.vector(v));
        w.volume = w.on(Lattice { steps, origin: t.vector(l.origin), ..l });
        let there = |v: [f64; 3]| t.vector(DVec3::from_array(v)).to_array();
        w.view.eye = there(w.view.eye);
        w.view.target = there(w.view.target);
        w.view.up = there(w.view.up);
        if let Light::Direction(d) = &mut w.transfer.shading.light {
            *d = there(*d);
        }
        w
    }

    /// Stores samples along other axes and from other corners; each stays at its position.
    pub(crate) fn stored(&self, t: Turn) -> Shot {
        let mut w = self.clone();
        let old = self.volume.lattice;
        let dims: [u32; 3] = std::array::from_fn(|a| old.dims[t.from[a]]);
        let mut l = Lattice { dims, ..old };
        for a in 0..3 {
            let step = old.steps[t.from[a]];
            l.steps[a] = if t.flipped[a] { -step } else { step };
            if t.flipped[a] {
                l.origin += step * f64::from(dims[a] - 1);
            }
        }
        let n = old.dims.map(|n| n as usize);
        let mut order = Vec::with_capacity(old.len());
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let mut p = [0; 3];
                    for (a, x) in [i, j, k].into_iter().enumerate() {
                        let x = if t.flipped[a] { dims[a] - 1 - x } else { x };
                        p[t.from[a]] = x as usize;
                    }
                    order.push((p[2] * n[1] + p[1]) * n[0] + p[0]);
                }
            }
        }
        w.volume = self.picked(l, &order);
        w
    }

    /// Adds `border` samples of the smallest code on every side; the camera stays.
    pub(crate) fn padded(&self, border: u32) -> Shot {
        let mut w = self.clone();
        let old = self.volume.lattice;
        let mut l = Lattice { dims: old.dims.map(|n| n + 2 * border), ..old };
        l.origin -= old.world_from_index() * DVec3::splat(f64::from(border));
        let n = old.dims.map(|n| n as usize);
        let empty = (0..old.len())
            .find(|&i| self.volume.samples.code(i) == self.volume.summary.min_code)
            .unwrap_or(0);
        let inside = |x: u32, a: usize| {
            x.checked_sub(border).filter(|&x| x < old.dims[a]).map(|x| x as usize)
        };
        let mut order = Vec::with_capacity(l.len());
        for k in 0..l.dims[2] {
            for j in 0..l.dims[1] {
                for i in 0..l.dims[0] {
                    let p = (inside(i, 0), inside(j, 1), inside(k, 2));
                    order.push(match p {
                        (Some(i), Some(j), Some(k)) => (k * n[1] + j) * n[0] + i,
                        _ => empty,
                    });
                }
            }
        }
        w.volume = self.picked(l, &order);
        w
    }

    /// Returns the volume on another lattice of as many samples.
    pub(crate) fn on(&self, lattice: Lattice) -> Arc<Volume> {
        Arc::new(Volume { lattice, ..(*self.volume).clone() })
    }

    /// Returns a volume on another lattice whose sample i is the old sample `from[i]`.
    fn picked(&self, lattice: Lattice, from: &[usize]) -> Arc<Volume> {
        let v = &self.volume;
        let mut samples = Samples::empty(v.samples.kind());
        from.iter().for_each(|&i| samples.push_from(&v.samples, i));
        let (name, kind) = (v.name.clone(), v.file_type.clone());
        Arc::new(Volume::new(name, kind, v.anatomical, lattice, samples, v.summary.map))
    }

    /// Stores 8-bit values as 16-bit codes, `per_value` codes a value.
    pub(crate) fn in_16_bits(&self, per_value: u16) -> Shot {
        let codes = self.codes().map(|c| c as u16 * per_value).collect();
        self.coded(Samples::U16(codes), 1.0 / f64::from(per_value))
    }

    /// Stores 8-bit values as floats.
    pub(crate) fn in_floats(&self) -> Shot {
        self.coded(Samples::F32(self.codes().map(|c| c as f32).collect()), 1.0)
    }

    fn codes(&self) -> impl Iterator<Item = f64> + '_ {
        (0..self.volume.samples.len()).map(|i| self.volume.samples.code(i))
    }

    fn coded(&self, samples: Samples, scale: f64) -> Shot {
        let v = &self.volume;
        let map = ValueMap { scale, offset: 0.0 };
        let volume = Volume::new(v.name.clone(), "coded", v.anatomical, v.lattice, samples, map);
        Shot { volume: Arc::new(volume), ..self.clone() }
    }
}
