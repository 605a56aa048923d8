//! Sifting and making ready with lanes: four (NEON), eight (AVX2) or sixteen (AVX-512) voxels at
//! once, from one generic source.

use super::{Sieve, Sifted, Tossing};
#[cfg(target_arch = "aarch64")]
use crate::kernels::lanes::Four;
use crate::kernels::lanes::Lanes;
#[cfg(target_arch = "x86_64")]
use crate::kernels::lanes::{Eight, Sixteen};
use crate::primitives::footprint::{Phases, Sections};
use crate::primitives::positions::FINER_BITS;
use crate::primitives::sizes::PART;
use slabcast_common::brick::Brick;
use slabcast_common::shade::NO_NORMAL;
use slabcast_common::view::{SUBPIXEL_BITS, SUBPIXELS};
use slabcast_common::volume::Samples;

/// Compiles [`Sieve::sift`] for an instruction set. All functions that it calls are inlined into
/// it.
macro_rules! compiled {
    ($name:ident, $features:literal, $lanes:ty) => {
        #[target_feature(enable = $features)]
        pub(super) fn $name(
            sieve: &Sieve<'_>,
            brick: &Brick,
            across: &[Phases; 2],
            tossing: &mut Tossing,
        ) -> Sifted {
            // SAFETY: this function is compiled for the instructions that the lanes need.
            unsafe {
                let sifted = match &brick.values {
                    Samples::U8(v) => voxels::<$lanes, _>(sieve, brick, v, tossing),
                    Samples::U16(v) => voxels::<$lanes, _>(sieve, brick, v, tossing),
                    Samples::F32(v) => voxels::<$lanes, _>(sieve, brick, v, tossing),
                };
                make_ready::<$lanes>(sieve.sections, across, sifted.kept, tossing);
                sifted
            }
        }
    };
}

#[cfg(target_arch = "aarch64")]
compiled!(neon, "neon", Four);
#[cfg(target_arch = "x86_64")]
compiled!(avx2, "avx2,popcnt,lzcnt,bmi1,bmi2", Eight);
#[cfg(target_arch = "x86_64")]
compiled!(avx512, "avx512f,avx512vl,avx512dq,avx512bw,popcnt,lzcnt,bmi1,bmi2", Sixteen);

/// Returns x, y (subpixels) and depth (phases) of `L::LANES` voxels from index `local` on.
#[inline(always)]
unsafe fn some<L: Lanes>(sieve: &Sieve<'_>, local: usize) -> [L::Ints; 3] {
    let [x, y, z] = sieve.places.offsets().each_ref();
    let at = [x, y, z].map(|of| of[local..local + L::LANES].as_ptr());
    let [x, y, z] = sieve.from;
    // SAFETY: the caller has the instructions; each slice above has so many offsets.
    unsafe {
        [
            L::bits_of_sums(x, at[0], FINER_BITS),
            L::bits_of_sums(y, at[1], FINER_BITS),
            L::bits_of_sums(z, at[2], FINER_BITS),
        ]
    }
}

/// [`super::move_inside`] in lanes.
#[inline(always)]
unsafe fn move_inside<L: Lanes>(phases: &Phases, at: L::Ints) -> (L::Ints, L::Ints) {
    let len = phases.len as i32;
    let (near, more_from) = (phases.first(0), phases.more_from());
    let (begin, stride) = (phases.begin(0) as i32, (phases.begin(1) - phases.begin(0)) as i32);
    // SAFETY: the caller has the instructions.
    unsafe {
        let phase = L::and(at, L::set(SUBPIXELS - 1));
        let first = L::plus(L::down(at, SUBPIXEL_BITS), L::set(near));
        let first = L::one_more(L::less(L::set(more_from - 1), phase), first);
        let from = L::plus(L::times(phase, L::set(stride)), L::set(begin));
        let moved = L::min(L::max(first, L::set(0)), L::set(PART - len));
        let by = L::min(L::max(L::minus(moved, first), L::set(-len)), L::set(len));
        (moved, L::plus(from, by))
    }
}

#[inline(always)]
unsafe fn make_ready<L: Lanes>(
    sections: &Sections,
    across: &[Phases; 2],
    kept: usize,
    tossing: &mut Tossing,
) {
    let Tossing { at: [x, y, z], cells, samples, normals, ready, .. } = tossing;
    for i in (0..kept).step_by(L::LANES) {
        // Each array has 512 entries, of which a whole vector lies from `i` on.
        let ready = &mut ready[i..i + L::LANES];
        // SAFETY: as the line above shows; a voxel that is ready is four numbers.
        unsafe {
            let (x, y) = (L::load(x.as_ptr().add(i).cast()), L::load(y.as_ptr().add(i).cast()));
            let (x0, from_x) = move_inside::<L>(&across[0], x);
            let (y0, from_y) = move_inside::<L>(&across[1], y);
            let place = L::or(x0, L::up(y0, 8));
            let place = L::or(place, L::up(L::load(cells.as_ptr().add(i)), 16));
            let rows = L::or(from_x, L::up(from_y, 16));
            let z = L::load(z.as_ptr().add(i).cast());
            let normal = L::up(L::load(normals.as_ptr().add(i)), 16);
            let deep = L::or(L::and(z, L::set(sections.phases() - 1)), normal);
            let sample = L::load(samples.as_ptr().add(i));
            L::store_fours(ready.as_mut_ptr().cast(), [place, rows, deep, sample]);
        }
    }
}

/// An item of the samples' or normals' arrays that lanes load as 32-bit integers.
trait Wide: Sized {
    /// Loads the first `L::LANES` items.
    unsafe fn load<L: Lanes>(items: &[Self]) -> L::Ints;
}

impl Wide for u8 {
    #[inline(always)]
    unsafe fn load<L: Lanes>(items: &[u8]) -> L::Ints {
        // SAFETY: the caller's.
        unsafe { L::bytes(items) }
    }
}

impl Wide for u16 {
    #[inline(always)]
    unsafe fn load<L: Lanes>(items: &[u16]) -> L::Ints {
        // SAFETY: the caller's.
        unsafe { L::shorts(items) }
    }
}

impl Wide for f32 {
    #[inline(always)]
    unsafe fn load<L: Lanes>(items: &[f32]) -> L::Ints {
        // SAFETY: the caller's.
        unsafe { L::floats(items) }
    }
}

#[inline(always)]
unsafe fn voxels<L: Lanes, T: Wide>(
    sieve: &Sieve<'_>,
    brick: &Brick,
    values: &[T],
    tossing: &mut Tossing,
) -> Sifted {
    let Sieve { open, cull, sections, sheets, .. } = sieve;
    let Tossing { at: [x_to, y_to, z_to], first: first_to, cells: cells_to, .. } = tossing;
    let Tossing { samples: samples_to, normals: normals_to, .. } = tossing;
    let (grown, reach) = open.grown();
    let (front, back, shift) = sections.reach();
    let (mut rank, mut reached, mut kept) = (0, 0, 0);
    for (group, present) in brick.occupancy().iter().enumerate() {
        for part in 0..64 / L::LANES {
            let present = (present >> (L::LANES * part)) as u32 & ((1 << L::LANES) - 1);
            if present == 0 {
                continue;
            }
            let here = rank;
            rank += present.count_ones() as usize;
            let local = 64 * group + L::LANES * part;
            // SAFETY: the caller's, and what is said below.
            let mark = unsafe {
                let [x, y, z] = some::<L>(sieve, local);
                // In the slab's sheets, and near enough to the part.
                let first = L::down(L::minus(z, L::set(front)), shift);
                let behind = L::down(L::plus(z, L::set(back)), shift);
                let near = L::both(L::marks(present), L::less(first, L::set(sheets[1])));
                let near = L::both(near, L::less(L::set(sheets[0] - 1), behind));
                let [px, py] = [L::down(x, SUBPIXEL_BITS), L::down(y, SUBPIXEL_BITS)];
                let [across, down] = reach.map(|reach| (L::set(reach), L::set(63 + 2 * reach)));
                let near = L::both(near, L::at_most(L::plus(px, across.0), across.1));
                let near = L::both(near, L::at_most(L::plus(py, down.0), down.1));
                let mut mark = L::bits(near);
                if mark == 0 {
                    continue;
                }
                reached += mark.count_ones() as usize;
                let (zero, last) = (L::set(0), L::set(63));
                let [px, py] = [L::min(L::max(px, zero), last), L::min(L::max(py, zero), last)];
                let cell = L::or(L::up(py, 6), px);
                if *cull {
                    // The mask in words of 32 bits; a cell is below 64 times 64, so its word is
                    // one of the mask's 128. The bit that is asked for goes where a sign is.
                    let words = L::look_up(near, grown.as_ptr().cast(), L::down(cell, 5));
                    let words = L::up_each(words, L::without(px, L::set(31)));
                    mark &= L::bits(L::less(words, zero));
                    if mark == 0 {
                        continue;
                    }
                }
                let sample = L::spread(present, T::load::<L>(&values[here..]));
                let normal = match &brick.normals {
                    Some(normals) => L::spread(present, Wide::load::<L>(&normals[here..])),
                    None => L::set(NO_NORMAL.into()),
                };
                // No more are kept than were gone through, so as many lanes from there on are
                // among an array's 512.
                L::store(x_to.as_mut_ptr().add(kept).cast(), L::beside(mark, x));
                L::store(y_to.as_mut_ptr().add(kept).cast(), L::beside(mark, y));
                L::store(z_to.as_mut_ptr().add(kept).cast(), L::beside(mark, z));
                L::store(first_to.as_mut_ptr().add(kept).cast(), L::beside(mark, first));
                L::store(cells_to.as_mut_ptr().add(kept), L::beside(mark, cell));
                L::store(samples_to.as_mut_ptr().add(kept), L::beside(mark, sample));
                L::store(normals_to.as_mut_ptr().add(kept), L::beside(mark, normal));
                mark
            };
            kept += mark.count_ones() as usize;
        }
    }
    Sifted { reached, kept }
}
