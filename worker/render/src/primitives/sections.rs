//! Sections of the kernel in depth, and its samples at planes.

use crate::primitives::field_taps::FieldTaps;
use slabcast_common::kernel::Profile;

/// Sections by depth phase: which sheets a voxel touches and how much of it lies in each.
///
/// A kernel that is m sheets long lies in m + 1 of them wherever it does not begin at a plane, and
/// of one of the outermost it has a sliver. Where slivers hold next to nothing each may be given to
/// the sheet beside it: every voxel then lies in m sheets, its weights still add up to one, and at
/// sheets of a vox a pixel's four fit a record where five do not ([`Sections::given_away`] says
/// what that may cost).
#[derive(Clone, Debug)]
pub struct Sections {
    pub(super) phases: i32,
    shift: u32,
    /// A voxel at depth z reaches from the sheet of z - front to that of z + back, both by integer
    /// division.
    front: i32,
    back: i32,
    /// Row of `stride` weights a phase; those that a phase does not need are zero.
    weights: Vec<f32>,
    /// Weights over the thickness, in lattice steps, as [`fixed`] point.
    fixed: Vec<i16>,
    /// Weights for the four channels of a field, value and derivatives; empty if sheets hold
    /// sections.
    pub(super) field: FieldTaps,
    pub(super) stride: usize,
}

/// The share of a voxel beyond the m - 1 sheets in its middle up to which slivers are given away:
/// the default kernel has 0.0045 beyond 1.5 vox from its centre, which is as much as a sliver can
/// be at sheets of 1 vox; at 2 vox it would be 0.05, and the picture of other sheets.
pub const SLIVER: f64 = 0.005;

/// By how much of a sheet the sheets that are kept lie before a voxel's middle, as a divisor. What
/// is in front of an opaque voxel's first sheet is seen whole, what is behind its last one through
/// all of the voxel: with a quarter, the default kernel loses 0.0007 in front at most and 0.016
/// behind, with none 0.0045 on either side, and the picture of mri256 (`peer-opaque`) is off by
/// 0.16 of 1/255 instead of 0.04.
const AHEAD: i32 = 4;

/// A weight from 0 to 1 in 16-bit fixed point: 2^-15 a unit, rounded to nearest.
pub(super) fn fixed(w: f64) -> i16 {
    libm::floor(w * 32768.0 + 0.5).clamp(0.0, 32767.0) as i16
}

/// Reach of a kernel in phases.
fn whole_phases(profile: &Profile, thickness: f64, phases: i32) -> i32 {
    // A rounding error above an integer does not count as another phase.
    libm::ceil(profile.radius / thickness * f64::from(phases) * (1.0 - 1e-12)) as i32
}

/// Reach of a voxel before and behind its depth, in phases, if slivers are dropped;
/// `None` where they are no slivers.
fn kept(profile: &Profile, thickness: f64, phases: i32) -> Option<(i32, i32)> {
    let radius = whole_phases(profile, thickness, phases);
    // The whole sheets that fit into the kernel's middle.
    let inner = (2 * radius - 1) / phases * (phases / 2);
    let beyond = profile.integral_to(-f64::from(inner) / f64::from(phases) * thickness);
    let ahead = (phases / AHEAD).min(radius - inner);
    (beyond <= SLIVER).then_some((inner + ahead, inner - ahead))
}

impl Sections {
    /// Integrates a kernel's profile along the view axis over sheets of `thickness`, both in vox,
    /// at `phases` depths a sheet. `merged` gives slivers to the sheets beside them.
    pub fn new(profile: &Profile, thickness: f64, phases: i32, merged: bool) -> Self {
        let radius = whole_phases(profile, thickness, phases);
        let (front, back) = match kept(profile, thickness, phases) {
            Some(kept) if merged => kept,
            _ => (radius, radius - 1),
        };
        let shift = phases.trailing_zeros();
        let mut sections = Sections {
            phases,
            shift,
            front,
            back,
            weights: vec![],
            fixed: vec![],
            field: FieldTaps::default(),
            stride: 1,
        };
        let most = (0..phases).map(|p| sections.span(p).1).max().unwrap_or(1);
        sections.stride = most as usize;
        for p in 0..phases {
            let (first, count) = sections.span(p);
            let at = f64::from(p) / f64::from(phases);
            // Weight beyond the outermost planes belongs to them.
            let up_to = |plane: u32| match plane {
                0 => 0.0,
                n if n >= count => 1.0,
                n => profile.integral_to((f64::from(first) + f64::from(n) - at) * thickness),
            };
            for s in 0..most {
                let w = up_to(s + 1) - up_to(s);
                sections.weights.push(w as f32);
                sections.fixed.push(fixed(w * profile.spread / thickness));
            }
        }
        sections
    }

    /// Samples a kernel's profile at planes `thickness` vox apart, the middles of sheets, at
    /// `phases` depths a sheet: planes of a field and not sections.
    pub fn planes(profile: &Profile, thickness: f64, phases: i32) -> Self {
        let radius = whole_phases(profile, thickness, phases);
        let (front, back) = (radius - phases / 2, radius - phases / 2 - 1);
        let mut planes = Sections {
            phases,
            shift: phases.trailing_zeros(),
            front,
            back,
            weights: vec![],
            fixed: vec![],
            field: FieldTaps::default(),
            stride: 1,
        };
        let most = (0..phases).map(|p| planes.span(p).1).max().unwrap_or(1).max(1);
        planes.stride = most as usize;
        for p in 0..phases {
            let at = f64::from(p) / f64::from(phases);
            for plane in 0..most {
                let u = (f64::from(planes.first(p)) + f64::from(plane) + 0.5 - at) * thickness;
                planes.weights.push(profile.at(u) as f32);
                planes.fixed.push(fixed(profile.at(u) * profile.spread));
                planes.field.push(2, profile, u);
            }
        }
        planes
    }

    /// Weights of the planes of a field, [`Sections::most`] a phase.
    pub(crate) fn field(&self) -> &FieldTaps {
        &self.field
    }

    /// Returns the largest share of a pixel's light, 0 to 1, that may change its sheet where
    /// slivers are given away, for voxels of extinction up to `most` per vox. In front that is a
    /// sliver's opacity; behind, what shows of it through its voxel, `t exp(-t)` of the sliver for
    /// an optical depth t of the voxel.
    pub fn given_away(profile: &Profile, thickness: f64, phases: i32, most: f64) -> f64 {
        let Some((front, back)) = kept(profile, thickness, phases) else { return 0.0 };
        let beyond = |reach: i32| {
            profile.integral_to(-f64::from(reach) / f64::from(phases) * thickness).max(0.0)
        };
        let shows = most.min(1.0) * libm::exp(-most.min(1.0));
        (beyond(front) * most).max(beyond(back) * shows)
    }

    /// Returns the first sheet of a voxel at depth `z` (in phases), and the voxel's weights (shares
    /// of its kernel, 0 to 1) in the sheets from there.
    #[inline]
    pub fn of(&self, z: i32) -> (i32, &[f32]) {
        let (row, count) = self.row(z);
        (self.first(z), &self.weights[row..row + count])
    }

    /// Returns [`Sections::of`] in fixed point: weights over the thickness, in steps of the
    /// lattice, in units of 2^-15.
    #[inline]
    pub fn of_fixed(&self, z: i32) -> (i32, &[i16]) {
        let (row, count) = self.row(z);
        (self.first(z), &self.fixed[row..row + count])
    }

    /// Returns the index at which the weights of depth `z` begin, and their number.
    #[inline(always)]
    pub(crate) fn row(&self, z: i32) -> (usize, usize) {
        ((z & (self.phases - 1)) as usize * self.stride, self.span(z).1 as usize)
    }

    /// Returns the first sheet of a voxel at depth `z` (in phases), and the number of sheets that
    /// it lies in.
    #[inline(always)]
    pub fn span(&self, z: i32) -> (i32, u32) {
        let first = self.first(z);
        (first, (((z + self.back) >> self.shift) - first + 1) as u32)
    }

    /// Phases that a voxel reaches to the front and to the back, and phases of a sheet as a shift:
    /// see [`Sections::span`].
    #[inline(always)]
    pub(crate) fn reach(&self) -> (i32, i32, u32) {
        (self.front, self.back, self.shift)
    }

    /// Returns the number of the first sheet of a voxel at depth `z` (in phases).
    #[inline(always)]
    pub fn first(&self, z: i32) -> i32 {
        (z - self.front) >> self.shift
    }

    /// Returns the weights of [`Sections::of`] (shares, 0 to 1) of all depth phases, one phase
    /// after the other, [`Sections::most`] weights each. Weights that a phase does not need are
    /// zero.
    pub fn all(&self) -> &[f32] {
        &self.weights
    }

    /// Returns the weights of [`Sections::of_fixed`] (units of 2^-15) of all depth phases, one
    /// phase after the other, [`Sections::most`] weights each. Weights that a phase does not need
    /// are zero.
    pub fn all_fixed(&self) -> &[i16] {
        &self.fixed
    }

    /// Phases of a sheet.
    #[inline(always)]
    pub(crate) fn phases(&self) -> i32 {
        self.phases
    }

    /// Returns the largest number of sheets that one voxel touches.
    pub fn most(&self) -> usize {
        self.stride
    }
}
