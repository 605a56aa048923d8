//! Row records in registers: the loops that all instruction sets share.
//!
//! A footprint spans a few registers of its tier. Its weights are repeated over the channels of
//! each column, as many registers at a time as a chunk of weights fills, and each section is added
//! to these registers.

use super::{EDGE, ENOUGH, Ends, FOUR, Folded, Shape, Tiers, Weights, a_line, firsts_of, groups};
use crate::kernels::composite::LANES;
use crate::kernels::pixel_records::sheet_offsets::{Apart, BATCH, Each, Layers};
use crate::kernels::pixel_records::{Line, MOST, Recorded, STRIDE, Splat, Table};

/// Registers in which sums of one kind are added to tiers.
///
/// # Safety
/// All functions are for machines with the instructions of who implements them.
pub(super) trait Wide<S: Recorded> {
    /// Weights of some columns or a section, each for all channels.
    type Register: Copy;
    /// Sums of the pixels of a register.
    type Sums: Pixels;
    /// A weight down the picture, for all channels.
    type Down: Copy;
    /// Registers of a line of the cache.
    const OF_LINE: usize;
    /// Registers whose weights are read at once, at most: two or four.
    const CHUNK: usize;
    /// Whether voxels with sections of their own are added sheet by sheet: else each to all of its
    /// sheets.
    const BY_SHEET: bool;

    /// A payload, over and over.
    unsafe fn payload(payload: &S::Payload) -> Self::Register;

    /// A payload times a weight in depth.
    unsafe fn section(payload: Self::Register, wz: S::Depth) -> Self::Register;

    /// The weights of a footprint of `table` from `from` on, of the `chunk`th `GROUPS` registers
    /// from the one in whose column `shift` it begins; nothing around it.
    unsafe fn spread<const GROUPS: usize>(
        table: &Table<'_, S::Weight>,
        from: usize,
        shift: usize,
        chunk: usize,
    ) -> [Self::Register; GROUPS];

    /// Adds `section * w` to the registers of `lines` from the `at`th on, which are there.
    unsafe fn add<const GROUPS: usize>(
        lines: *mut Line,
        at: usize,
        section: Self::Register,
        w: &[Self::Register; GROUPS],
    );

    /// `w` for all channels.
    unsafe fn weight(w: S::Weight) -> Self::Down;

    /// Returns the sum of register `at` of [`FOUR`] tiers' lines, each times its weight. The lines
    /// of tiers lie `a_tier` apart.
    unsafe fn down(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[Self::Down; FOUR],
    ) -> Self::Sums;

    /// Returns the sum that [`Self::down`] returns, over as many tiers as there are weights.
    unsafe fn down_all(
        lines: *const Line,
        at: usize,
        a_tier: usize,
        weights: &[S::Weight],
    ) -> Self::Sums;

    /// A bit for each pixel that has any extinction.
    unsafe fn filled(sums: Self::Sums) -> u32;
}

/// Registers of pixels of two or four words each, whatever kind of sums these are.
///
/// # Safety
/// As that of [`Wide`].
pub(super) trait Pixels: Copy {
    /// Puts these pixels, of so many words, instead of those of `to`; which were there, of those
    /// that `which` has bits for.
    unsafe fn exchange(self, words: usize, to: *mut u32, which: u32) -> Self;

    /// Stores those of `which` beside each other.
    unsafe fn store_beside(self, words: usize, to: *mut u32, which: u32);

    /// The first numbers of as many fours as a register has such pixels, and whole numbers from
    /// `at` on, beside each other.
    unsafe fn store_places(
        words: usize,
        which: u32,
        fours: *const [u32; 4],
        opacities: *mut f32,
        at: u32,
        places: *mut u32,
    );
}

/// Compiles the loops for some instructions.
macro_rules! compiled {
    ($features:literal) => {
        /// [`super::wide::add_flat`] in lanes.
        #[target_feature(enable = $features)]
        pub(super) fn add_flat<W: Wide<S>, S: Recorded, const N: usize>(
            tiers: &mut Tiers<'_, S, N>,
            voxels: (&[Splat], &[S::Payload]),
            slot: usize,
            weights: &Weights<'_, S>,
        ) {
            // SAFETY: these are the instructions.
            unsafe { super::wide::add_flat::<W, S, N>(tiers, voxels, slot, weights) }
        }

        /// [`super::wide::add_apart`] in lanes.
        #[target_feature(enable = $features)]
        pub(super) fn add_apart<W: Wide<S>, S: Recorded, const N: usize>(
            tiers: &mut Tiers<'_, S, N>,
            voxels: (&Apart, &[S::Payload]),
            places: &[Each<u32>; MOST],
            layers: &Layers<'_, S, N>,
        ) {
            // SAFETY: these are the instructions.
            unsafe { super::wide::add_apart::<W, S, N>(tiers, voxels, places, layers) }
        }

        /// [`super::wide::fold`] in lanes.
        #[target_feature(enable = $features)]
        pub(super) fn fold<W: Wide<S>, S: Recorded, const N: usize>(
            tiers: &Tiers<'_, S, N>,
            ends: Ends<'_, S>,
            rows: usize,
            to: &mut Folded<S>,
        ) -> usize {
            // SAFETY: these are the instructions.
            unsafe { super::wide::fold::<W, S, N>(tiers, ends, rows, to) }
        }
    };
}
pub(super) use compiled;

/// Calls a function for as many groups a chunk, and says how many chunks there are.
macro_rules! by_groups {
    ($groups:expr, $most:expr, $add:ident[$($of:ident),*]($($arg:expr),*)) => {
        match $groups {
            1 => $add::<1, $($of),*>($($arg),*, 1),
            2 => $add::<2, $($of),*>($($arg),*, 1),
            3 if $most >= 3 => $add::<3, $($of),*>($($arg),*, 1),
            4 if $most >= 4 => $add::<4, $($of),*>($($arg),*, 1),
            n if $most >= 4 => $add::<4, $($of),*>($($arg),*, n.div_ceil(4)),
            n => $add::<2, $($of),*>($($arg),*, n.div_ceil(2)),
        }
    };
}

/// Columns of a register.
const fn columns<W: Wide<S>, S: Recorded>() -> usize {
    a_line::<S>() / W::OF_LINE
}

/// Registers of a tier and of a sheet.
///
/// # Panics
/// If not all sheets have memory.
#[inline(always)]
fn registers<W: Wide<S>, S: Recorded, const N: usize>(tiers: &Tiers<'_, S, N>) -> [usize; 2] {
    let Shape { rows, wide, .. } = tiers.shape;
    assert!(tiers.lines.len() >= N * rows * wide, "tiers of all sheets");
    [W::OF_LINE * wide, W::OF_LINE * rows * wide]
}

/// [`super::Tiered::add_flat`] in lanes.
///
/// # Safety
/// For machines with the instructions of `W`.
#[inline(always)]
pub(super) unsafe fn add_flat<W: Wide<S>, S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    voxels: (&[Splat], &[S::Payload]),
    slot: usize,
    weights: &Weights<'_, S>,
) {
    let groups = groups(tiers.shape.len, columns::<W, S>());
    // SAFETY: the caller's.
    unsafe { by_groups!(groups, W::CHUNK, flat[W, S, N](tiers, voxels, slot, weights)) }
}

#[inline(always)]
unsafe fn flat<const GROUPS: usize, W: Wide<S>, S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    (voxels, payloads): (&[Splat], &[S::Payload]),
    slot: usize,
    Weights { across, deep }: &Weights<'_, S>,
    chunks: usize,
) {
    let [a_tier, sheet] = registers::<W, S, N>(tiers);
    let offsets: [usize; N] = std::array::from_fn(|i| (slot + i) % N * sheet);
    let lines = tiers.lines.as_mut_ptr();
    for (v, of) in voxels.iter().zip(payloads) {
        let [place, row] = v.first();
        let columns = columns::<W, S>();
        let (at, shift) = (row * a_tier + place / columns, place % columns);
        assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
        let from = (v.rows & 0xffff) as usize;
        let wz = deep.row(v.phase() as usize * deep.len);
        // SAFETY: the caller's, and registers are the slot's, as shown above.
        unsafe {
            let payload = W::payload(of);
            for chunk in 0..chunks {
                let w = W::spread::<GROUPS>(across, from, shift, chunk);
                let at = at + chunk * GROUPS;
                // Loops without closures: what is compiled for `W` is inlined into nothing else.
                match wz.first_chunk::<N>() {
                    // One of known length.
                    Some(wz) => {
                        for (offset, wz) in offsets.iter().zip(wz) {
                            W::add(lines, offset + at, W::section(payload, *wz), &w);
                        }
                    }
                    None => {
                        for (offset, wz) in offsets.iter().zip(wz) {
                            W::add(lines, offset + at, W::section(payload, *wz), &w);
                        }
                    }
                }
            }
        }
    }
}

/// [`super::Tiered::add_apart`] in lanes.
///
/// # Safety
/// For machines with the instructions of `W`.
#[inline(always)]
pub(super) unsafe fn add_apart<W: Wide<S>, S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    voxels: (&Apart, &[S::Payload]),
    places: &[Each<u32>; MOST],
    layers: &Layers<'_, S, N>,
) {
    let groups = groups(tiers.shape.len, columns::<W, S>());
    // SAFETY: the caller's.
    unsafe { by_groups!(groups, W::CHUNK, apart[W, S, N](tiers, voxels, places, layers)) }
}

#[inline(always)]
unsafe fn apart<const GROUPS: usize, W: Wide<S>, S: Recorded, const N: usize>(
    tiers: &mut Tiers<'_, S, N>,
    (apart, payloads): (&Apart, &[S::Payload]),
    places: &[Each<u32>; MOST],
    layers: &Layers<'_, S, N>,
    chunks: usize,
) {
    let [_, sheet] = registers::<W, S, N>(tiers);
    let to = To { lines: tiers.lines.as_mut_ptr(), sheet, chunks };
    // SAFETY: the caller's, and registers are as many.
    unsafe {
        if W::BY_SHEET {
            for slot in 0..N {
                for (&i, of) in apart.kept.iter().zip(payloads) {
                    let voxel = (i as usize % BATCH, W::payload(of));
                    section::<GROUPS, W, S, N>(&to, slot, voxel, apart, places, layers);
                }
            }
        } else {
            for (&i, of) in apart.kept.iter().zip(payloads) {
                let voxel = (i as usize % BATCH, W::payload(of));
                for slot in 0..N {
                    section::<GROUPS, W, S, N>(&to, slot, voxel, apart, places, layers);
                }
            }
        }
    }
}

/// Target of sections: registers of all sheets, how many each, and in how many chunks.
struct To {
    lines: *mut Line,
    sheet: usize,
    chunks: usize,
}

/// Adds the section that a voxel has in a slot, if it reaches that.
#[inline(always)]
unsafe fn section<const GROUPS: usize, W: Wide<S>, S: Recorded, const N: usize>(
    &To { lines, sheet, chunks }: &To,
    slot: usize,
    (i, payload): (usize, W::Register),
    apart: &Apart,
    places: &[Each<u32>; MOST],
    layers: &Layers<'_, S, N>,
) {
    let after = layers.after(slot);
    if after >= apart.left[i] {
        return;
    }
    let (place, columns) = (places[slot][i] as usize, columns::<W, S>());
    let (at, shift) = (place / columns, place % columns);
    assert!(at + chunks * GROUPS <= sheet, "a footprint inside its tier");
    let wz = layers.deep.weights[apart.deep[i] as usize + after as usize];
    let (across, from) = (&layers.across[0][slot], apart.from[0][slot][i] as usize);
    // SAFETY: the caller's, and registers are the slot's, as shown above.
    unsafe {
        let section = W::section(payload, wz);
        for chunk in 0..chunks {
            let w = W::spread::<GROUPS>(across, from, shift, chunk);
            W::add(lines, slot * sheet + at + chunk * GROUPS, section, &w);
        }
    }
}

/// [`super::Tiered::fold`] in lanes.
///
/// # Safety
/// For machines with the instructions of `W`.
#[inline(always)]
pub(super) unsafe fn fold<W: Wide<S>, S: Recorded, const N: usize>(
    tiers: &Tiers<'_, S, N>,
    Ends { open, slots, by_row, before, was, pixels }: Ends<'_, S>,
    rows: usize,
    to: &mut Folded<S>,
) -> usize {
    const { assert!(columns::<W, S>() <= LANES) };
    let (columns, words) = (columns::<W, S>(), size_of::<S::Pixel>() / 4);
    let all = (1u32 << columns) - 1;
    let [a_tier, _] = registers::<W, S, N>(tiers);
    assert!(by_row[0].end.max(by_row[1].end) <= tiers.shape.rows, "tiers that are there");
    // Which register is the first of the part in the first tier of each sheet.
    let first = slots.map(|slot| W::OF_LINE * tiers.begin(slot % N, 0) as usize);
    let (before, pixels) = (&mut before[..EDGE * STRIDE], &pixels[..EDGE * STRIDE]);
    let Folded { places: all_places, sheets, opacities } = to;
    // SAFETY: places of the part are stored there.
    let places = unsafe { all_places.room().as_mut_ptr() };
    let opacities = opacities.as_mut_ptr();
    let [sums_before, sums_here, sums_behind] = sheets.each_mut();
    let (sums_before, sums_here, sums_behind) =
        (sums_before.as_mut_ptr(), sums_here.as_mut_ptr(), sums_behind.as_mut_ptr());
    let lines = tiers.lines.as_ptr();
    let (mut next, mut n) = (rows, 0);
    while next < EDGE && n < ENOUGH {
        let y = next;
        next += 1;
        let (open, had) = (open[y], std::mem::take(&mut was[y]));
        if open == 0 {
            continue;
        }
        let ((above_here, w_here), (above_behind, w_behind)) = (by_row[0].row(y), by_row[1].row(y));
        let (here, behind) = (first[0] + above_here * a_tier, first[1] + above_behind * a_tier);
        // SAFETY: the caller's.
        let four = unsafe { four::<W, S>(w_here, w_behind) };
        let mut left = firsts_of(open, columns);
        while left != 0 {
            let x = left.trailing_zeros() as usize;
            left &= left - 1;
            let at = y * STRIDE + x;
            let (here, behind) = (here + x / columns, behind + x / columns);
            // SAFETY: the caller's; so many tiers are there, and registers from their first in the
            // part on. Each pixel of the part is come to once at most, and of ENOUGH and a row
            // there is room.
            unsafe {
                let (here, behind) = match &four {
                    // Loops of known length.
                    Some([a, b]) => {
                        (W::down(lines, here, a_tier, a), W::down(lines, behind, a_tier, b))
                    }
                    None => (
                        W::down_all(lines, here, a_tier, w_here),
                        W::down_all(lines, behind, a_tier, w_behind),
                    ),
                };
                let some = W::filled(here) & (open >> x) as u32 & all;
                let had = (had >> x) as u32 & all;
                let old = here.exchange(words, before.as_mut_ptr().add(at).cast(), had);
                old.store_beside(words, sums_before.add(n).cast(), some);
                here.store_beside(words, sums_here.add(n).cast(), some);
                behind.store_beside(words, sums_behind.add(n).cast(), some);
                let (opacities, places) = (opacities.add(n), places.add(n));
                let fours = pixels.as_ptr().add(at);
                W::Sums::store_places(words, some, fours, opacities, at as u32, places);
                n += some.count_ones() as usize;
                was[y] |= u64::from(some) << x;
            }
        }
    }
    all_places.set_len(n);
    next
}

/// Weights of two sheets, each for all channels, if both have four.
#[inline(always)]
unsafe fn four<W: Wide<S>, S: Recorded>(
    here: &[S::Weight],
    behind: &[S::Weight],
) -> Option<[[W::Down; FOUR]; 2]> {
    let (Ok([a, b, c, d]), Ok([e, f, g, h])) =
        (<[S::Weight; FOUR]>::try_from(here), <[S::Weight; FOUR]>::try_from(behind))
    else {
        return None;
    };
    // SAFETY: the caller's. Without closures: what is compiled for `W` is inlined into nothing
    // else.
    unsafe {
        Some([
            [W::weight(a), W::weight(b), W::weight(c), W::weight(d)],
            [W::weight(e), W::weight(f), W::weight(g), W::weight(h)],
        ])
    }
}
