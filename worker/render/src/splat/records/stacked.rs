//! Voxels whose sections are stacked: they have the same columns, and lie above each other in the picture.
//!
//! So it is where the odd axis of a lattice stands upright, as CT is looked at. How far a section lies from its voxel
//! hangs on the phase of the voxel's depth alone ([`Leaning`](crate::footprint::Leaning)). Thus where the rows of its
//! sections lie, and what they weigh, is found when the voxel is added, of all eight in a register; nothing is kept by
//! voxel and sheet, as it is of sections that lie anywhere ([`super::apart`]). That is written for AVX2 and AVX-512;
//! elsewhere these are voxels like any others.

/// Calls a function for footprints of as many columns as the stacked voxels have, or of a few more.
#[cfg(target_arch = "x86_64")]
macro_rules! by_columns {
    ($stacked:ident[$n:ident], $at:expr) => {
        match $at.2.across[0][$at.2.slot].len {
            0..=4 => $stacked::<4, $n>($at),
            5 => $stacked::<5, $n>($at),
            6 => $stacked::<6, $n>($at),
            7 | 8 => $stacked::<8, $n>($at),
            9 | 10 => $stacked::<10, $n>($at),
            11 | 12 => $stacked::<12, $n>($at),
            _ => $stacked::<16, $n>($at),
        }
    };
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2;
#[cfg(target_arch = "x86_64")]
pub(super) mod avx512;
#[cfg(target_arch = "x86_64")]
mod voxel;

use super::Recorded;
use super::apart::LINE;
use crate::footprint::Phases;
#[cfg(target_arch = "x86_64")]
use crate::splat::Level;
use crate::splat::Simd;

/// Rows that all sections of a voxel have together, at most, and zeros that tables have around a phase's weights, at
/// least. A lattice of slices twice as thick as its pixels, seen at two pixels a voxel from 30 degrees above, has some 20.
pub(crate) const ROWS: usize = 32;

/// Columns at most: weights of them are looked at as one register.
pub(crate) const COLUMNS: usize = LINE;

/// Where the rows of stacked sections lie.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Stacked<'a> {
    /// [`Leaning::subpixels`](crate::footprint::Leaning::subpixels) down the picture.
    pub(crate) subpixels: &'a [i32],
    /// Where weights down lie.
    pub(crate) down: Phases,
}

/// Whether these are added in lanes, so that where they lie in each sheet need not be known.
#[inline(always)]
pub(crate) fn in_lanes<S: Recorded>(simd: Simd) -> bool {
    #[cfg(target_arch = "x86_64")]
    let are_there = matches!(simd.0, Level::Avx2 | Level::Avx512);
    #[cfg(not(target_arch = "x86_64"))]
    let are_there = {
        let _ = simd;
        false
    };
    are_there && S::STACKED
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::batch::Axes;
    use crate::scene::{Frame, Scene};
    use crate::selftest;
    use crate::splat::records::apart::{Apart, BATCH, Woven};
    use crate::splat::records::{MOST, Record, STRIDE};
    use crate::stack::EDGE;
    use glam::DVec3;
    use proptest::prelude::*;
    use slabcast_common::quality::{Quality, Sums};
    use slabcast_common::view::{Camera, CameraProjection, SUBPIXELS, View};
    use slabcast_common::volume::{Lattice, Volume};
    use std::sync::Arc;

    /// A view of a lattice whose upright axis is `odd` times as coarse as the others, from above.
    fn frame(sums: Sums, odd: f64, up: f64, height: f64) -> Frame {
        let dims = [20, 16, 24];
        let mut volume = Volume::from_fn_u8("any", dims, |i, j, k| (i + 3 * j + 7 * k) as u8);
        volume.lattice = Lattice::from_spacing(dims, [1.0, 1.0, odd]);
        let quality = Quality { sums, ..Quality::default() };
        let projection = CameraProjection::Ortho { height };
        let to_eye = DVec3::new(0.4, 1.0, up);
        let camera = Camera { to_eye, up: DVec3::Z, target: DVec3::ZERO, projection };
        let view = View::new(&volume.lattice, &camera, [100, 90], &quality).expect("a view");
        Frame::new(Arc::new(Scene::new(&selftest::spec(&volume, quality))), view)
    }

    /// A voxel: where it is, the phase of its depth, and how many of its sheets it has left.
    type Somewhere = ([i32; 2], u32, usize);

    /// Whether voxels were added in lanes: then as sections that lie anywhere are.
    fn as_any_others<S: Recorded>(
        frame: &Frame,
        voxels: &[Somewhere],
        slot: usize,
    ) -> Result<bool, TestCaseError> {
        let footprint = frame.footprints.at(0).expect("a parallel view");
        let mut axes = Axes::<S, MOST>::new(frame, 0, &footprint);
        axes.layers.slot = slot;
        let leaning = frame.leaning.as_ref().expect("a kernel that leans");
        let phases = axes.phases.each_ref().map(|phases| phases[0]);
        let Some(stacked) = leaning.stacked(phases) else { return Ok(false) };
        let most = frame.sections.most();
        let (mut apart, mut payloads) = (Apart::default(), vec![]);
        for (i, &(at, phase, left)) in voxels.iter().enumerate() {
            let left = 1 + left % most;
            (apart.left[i], apart.deep[i]) =
                (left as i32, phase * most as u32 + (most - left) as u32);
            let aside = |sheet| stacked.subpixels[apart.deep[i] as usize + sheet];
            for (axis, phases) in phases.iter().enumerate() {
                apart.at[axis][i] = at[axis];
                let (mut lo, mut hi) = (i32::MAX, i32::MIN);
                for sheet in 0..left {
                    let at = at[axis] + if axis == 1 { aside(sheet) } else { 0 };
                    let (which, first) = ((slot + sheet) % MOST, phases.first_at(at));
                    let begin = phases.begin((at & (SUBPIXELS - 1)) as usize);
                    (apart.first[axis][which][i], apart.from[axis][which][i]) =
                        (first, begin as u32);
                    (lo, hi) = (lo.min(first), hi.max(first + phases.len as i32));
                }
                prop_assert!(axis == 0 || hi - lo <= ROWS as i32, "{} rows", hi - lo);
                (apart.lo[axis][i], apart.hi[axis][i]) = (lo.max(0), hi.min(EDGE as i32));
            }
            if (0..2).all(|axis| apart.lo[axis][i] < apart.hi[axis][i]) {
                apart.kept[payloads.len()] = i as u32;
                payloads.push(S::payload([31_000.0 - i as f32, 17_003.4, 77.7, i as f32]));
            }
        }
        let mut run = |simd, stacked| {
            axes.layers.stacked = stacked;
            let mut records: Vec<Record<S, MOST>> =
                vec![[S::from_raw([11; 4]); MOST]; STRIDE * EDGE];
            let voxels = (&apart, &payloads[..]);
            S::splat_apart(simd, &mut records, voxels, &axes.layers, &mut Woven::default());
            records
        };
        let want = run(Simd::plain(), None);
        for simd in Simd::all().into_iter().filter(|&simd| in_lanes::<S>(simd)) {
            prop_assert!(run(simd, Some(stacked)) == want, "{}", simd.name());
        }
        Ok(true)
    }

    #[test]
    fn sections_are_stacked_where_the_odd_axis_stands_upright_and_footprints_are_small() {
        let is_stacked = |height, odd, up| {
            as_any_others::<i16>(&frame(Sums::I16, odd, up, height), &[], 0)
                .expect("nothing to compare")
        };
        assert!(is_stacked(60.0, 1.3, 0.5) && is_stacked(60.0, 2.5, -0.7));
        assert!(!is_stacked(12.0, 2.5, 0.5));
    }

    proptest! {
        #[test]
        fn they_are_added_as_any_others(
            voxels in prop::collection::vec(
                (prop::array::uniform2(-2000..18_500i32), 0..256u32, 0..MOST), 0..BATCH),
            slot in 0..MOST, odd in 1.1..3.0f64, up in 0.1..1.5f64, below in any::<bool>(),
            height in 30.0..90.0f64,
        ) {
            let up = if below { -up } else { up };
            as_any_others::<i16>(&frame(Sums::I16, odd, up, height), &voxels, slot)?;
            as_any_others::<i32>(&frame(Sums::I32, odd, up, height), &voxels, slot)?;
        }
    }
}
