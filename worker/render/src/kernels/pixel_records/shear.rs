//! Voxels of parallel views whose sections lie aside of each other, as those of thick slices seen
//! at a slant.
//!
//! How far a section lies from its voxel hangs on the phase of the voxel's depth alone, and how far
//! a row does from its section's middle on how far it is above or below that
//! ([`Leaning`](crate::primitives::footprint::Leaning)). Thus where weights begin is found when a
//! voxel is added, of all eight sections in a register; nothing is kept by voxel and sheet, as it
//! is of sections that lie anywhere ([`super::sheet_offsets`]). Where the odd axis of the lattice
//! stands upright, as CT is looked at, sections are *stacked*: they have the same columns, and
//! weights across are looked up once a voxel. Else the voxel is *skewed*: its footprint is a
//! parallelogram, and weights across are looked up row by row, from the first column of any section
//! in that row on. That is written for AVX2 and AVX-512; elsewhere these are voxels like any
//! others.

/// Calls a function for rows of as many columns as the voxels have, or of a few more, and for
/// skewed voxels or not.
#[cfg(target_arch = "x86_64")]
macro_rules! by_columns {
    ($slanted:ident[$n:ident], $at:expr) => {
        match ($at.3.skewed, $at.3.wide) {
            (false, 0..=4) => $slanted::<false, 4, $n>($at),
            (false, 5) => $slanted::<false, 5, $n>($at),
            (false, 6) => $slanted::<false, 6, $n>($at),
            (false, 7 | 8) => $slanted::<false, 8, $n>($at),
            (false, 9 | 10) => $slanted::<false, 10, $n>($at),
            (false, 11 | 12) => $slanted::<false, 12, $n>($at),
            (false, _) => $slanted::<false, 16, $n>($at),
            (true, 0..=6) => $slanted::<true, 6, $n>($at),
            (true, 7 | 8) => $slanted::<true, 8, $n>($at),
            (true, 9 | 10) => $slanted::<true, 10, $n>($at),
            (true, 11 | 12) => $slanted::<true, 12, $n>($at),
            (true, 13..=16) => $slanted::<true, 16, $n>($at),
            (true, 17..=20) => $slanted::<true, 20, $n>($at),
            (true, _) => $slanted::<true, 24, $n>($at),
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
use super::sheet_offsets::Apart;
#[cfg(target_arch = "x86_64")]
use crate::kernels::Level;
use crate::kernels::Simd;
pub use crate::primitives::footprint::Slant;
pub use crate::primitives::sizes::{SHEAR_COLUMNS as COLUMNS, SHEAR_ROWS as ROWS};

/// Returns whether sheared voxels of sums `S` are added in lanes; their places in each sheet need
/// then not be known.
#[inline(always)]
pub fn in_lanes<S: Recorded>(simd: Simd) -> bool {
    let are_there = match simd.0 {
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 | Level::Avx512 => true,
        _ => false,
    };
    are_there && S::SLANTED
}

/// Finds the windows of the first `n` voxels, which are skewed, where [that is done in
/// lanes](in_lanes).
///
/// # Panics
/// If it is not.
#[inline(always)]
pub fn windows(simd: Simd, slant: &Slant<'_>, apart: &mut Apart, n: usize) {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there: where AVX-512 is, AVX2 is, too.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 | Level::Avx512 => unsafe { avx2::windows(slant, apart, n) },
        _ => {
            let _ = (slant, apart, n);
            unreachable!("skewed voxels are looked up in lanes")
        }
    }
}
