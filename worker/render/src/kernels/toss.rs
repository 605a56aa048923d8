//! The bucket toss (paper, section 3) of orthographic views: which voxels of a brick may show in a
//! part, with all that drawing them takes.
//!
//! Voxels are positioned by an addition, tested against the part's sheets and one bit of its mask,
//! and those that are left are packed. That is done for sixteen local indices at a time with
//! AVX-512, eight with AVX2 and four with NEON, whether a voxel is there or not, and voxels that
//! can't show never leave the registers. The plain loops are for the baseline, and the lanes must
//! equal them.

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod wide;

use super::pixel_records::Splat;
use super::{Level, Simd};
use crate::primitives::footprint::{Phases, Sections};
use crate::primitives::positions::{FlatCorner, Places};
use crate::primitives::sizes::PART;
use crate::visibility::open_mask::OpenMask;
use slabcast_common::brick::{BRICK_VOXELS, Brick};
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
use slabcast_common::volume::Samples;

/// Test that the voxels of a brick must pass.
pub struct Sieve<'a> {
    /// Integer positions of voxels in the view.
    pub places: &'a Places,
    /// Origin of the brick's positions, by [`Places::from`].
    pub from: FlatCorner,
    /// Open pixels of the part.
    pub open: &'a OpenMask,
    /// Whether voxels around which nothing is open are left out.
    pub cull: bool,
    /// Sections of the kernel by depth phase.
    pub sections: &'a Sections,
    /// The first sheet of the slab and the one behind its last, counted from where depths are.
    pub sheets: [i32; 2],
}

/// Numbers of a brick's voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Sifted {
    /// Voxels that may touch the part in the slab's sheets.
    pub reached: usize,
    /// Voxels of these that were kept.
    pub kept: usize,
}

/// Scratch memory of a toss: up to 512 voxels of a brick, one array a property.
pub struct Tossing {
    /// Positions x, y in subpixels from the part's corner, and depths in phases.
    at: [[i32; 512]; 3],
    /// Numbers of the voxels' first sheets.
    first: [i32; 512],
    /// Whether a voxel may touch the part or an open pixel ([`OpenMask::near_all`]).
    fate: [u32; 512],
    cells: [u32; 512],
    samples: [u32; 512],
    normals: [u32; 512],
    /// First pixels of footprints, and where weights begin.
    windows: [[u32; 512]; 4],
    /// Kept voxels, packed for their buckets.
    ready: [Splat; 512],
}

impl Default for Tossing {
    fn default() -> Self {
        Tossing {
            at: [[0; 512]; 3],
            first: [0; 512],
            fate: [0; 512],
            cells: [0; 512],
            samples: [0; 512],
            normals: [0; 512],
            windows: [[0; 512]; 4],
            ready: [Splat::default(); 512],
        }
    }
}

impl Tossing {
    /// The first `kept` voxels of a flat view, with their first sheets.
    #[inline(always)]
    pub fn ready(&self, kept: usize) -> impl Iterator<Item = (&i32, &Splat)> {
        self.first[..kept].iter().zip(&self.ready[..kept])
    }
}

/// Has the memory of a brick that is sifted next come nearer: samples and normals of most bricks
/// were last looked at a frame ago.
#[inline(always)]
pub fn prefetch(brick: &Brick) {
    let Brick { values, normals, .. } = brick;
    match values {
        Samples::U8(v) => prefetch_all(v),
        Samples::U16(v) => prefetch_all(v),
        Samples::F32(v) => prefetch_all(v),
    }
    if let Some(normals) = normals {
        prefetch_all(normals);
    }
}

#[inline(always)]
fn prefetch_all<T>(items: &[T]) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let at: *const i8 = items.as_ptr().cast();
        for line in (0..size_of_val(items)).step_by(64) {
            // SAFETY: baseline instructions, which never fault.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(at.wrapping_add(line)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = items;
}

impl Sieve<'_> {
    /// Puts place, first sheet, cell, sample and normal of the voxels that are kept beside each
    /// other.
    #[inline(always)]
    fn sift_plain(&self, brick: &Brick, tossing: &mut Tossing) -> Sifted {
        let Tossing { at, first, fate, cells, samples, normals, .. } = tossing;
        let n = brick.len().min(BRICK_VOXELS);
        self.places.all(self.from, &brick.index[..n], at);
        let [x, y, z] = at;
        self.open.near_all(&x[..n], &y[..n], cells, fate);
        let [begin, end] = self.sheets;
        for i in 0..n {
            let (sheet, count) = self.sections.span(z[i]);
            first[i] = sheet;
            let here = u32::from(sheet < end) & u32::from(sheet + count as i32 > begin);
            fate[i] *= here;
        }
        let reached = fate[..n].iter().map(|&fate| usize::from(fate != 0)).sum();
        let wanted = if self.cull { 3 } else { 1 };
        brick.values.write_bits(samples);
        match &brick.normals {
            Some(of) => normals.iter_mut().zip(of).for_each(|(to, &of)| *to = of.into()),
            None => normals[..n].fill(NO_NORMAL.into()),
        }
        // From the front on, nothing is overwritten that is still to be moved.
        let mut kept = 0;
        for i in 0..n {
            (x[kept], y[kept], z[kept], first[kept]) = (x[i], y[i], z[i], first[i]);
            (cells[kept], samples[kept], normals[kept]) = (cells[i], samples[i], normals[i]);
            kept += usize::from(fate[i] >= wanted);
        }
        Sifted { reached, kept }
    }

    /// Sifts the voxels of `brick` into `tossing`, and packs those that are kept for footprints
    /// whose weights across and down lie as `across` says.
    #[inline(always)]
    pub fn sift(
        &self,
        simd: Simd,
        brick: &Brick,
        across: &[Phases; 2],
        tossing: &mut Tossing,
    ) -> Sifted {
        match simd.0 {
            // SAFETY: the value proves that the instructions are there (`Simd::all`).
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => unsafe { wide::avx512(self, brick, across, tossing) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => unsafe { wide::avx2(self, brick, across, tossing) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            Level::Neon => unsafe { wide::neon(self, brick, across, tossing) },
            Level::Plain => {
                let sifted = self.sift_plain(brick, tossing);
                make_ready(self.sections, across, sifted.kept, tossing);
                sifted
            }
        }
    }
}

/// Packs the first `kept`.
#[inline(always)]
fn make_ready(sections: &Sections, across: &[Phases; 2], kept: usize, tossing: &mut Tossing) {
    let Tossing { at: [x, y, z], cells, samples, normals, windows, ready, .. } = tossing;
    let [x0, from_x, y0, from_y] = windows;
    move_inside(&across[0], &x[..kept], x0, from_x);
    move_inside(&across[1], &y[..kept], y0, from_y);
    let phases = sections.phases();
    for (j, ready) in ready[..kept].iter_mut().enumerate() {
        ready.place = x0[j] | y0[j] << 8 | cells[j] << 16;
        ready.rows = from_x[j] | from_y[j] << 16;
        ready.deep = (z[j] & (phases - 1)) as u32 | normals[j] << 16;
        ready.sample = samples[j];
    }
}

/// First pixels of the footprints of some voxels along an axis, moved inside the part, and where
/// their weights then begin: below 2^16, since rows of a padded table are at most three times 63
/// long.
#[inline(always)]
fn move_inside(phases: &Phases, at: &[i32], inside: &mut [u32; 512], from: &mut [u32; 512]) {
    let len = phases.len as i32;
    for ((&at, inside), from) in at.iter().zip(inside).zip(from) {
        let (pixel, phase) = (at >> SUBPIXEL_BITS, at & (SUBPIXELS - 1));
        let first = pixel + phases.first(phase);
        let moved = first.clamp(0, PART - len);
        *inside = moved as u32;
        // Moved farther than a footprint is long, it reads zeros only.
        let begin = phases.begin(phase as usize) as i32;
        *from = (begin + (moved - first).clamp(-len, len)) as u32;
    }
}
