//! Voxels added to tiers in registers, whatever these are: the loops that all instruction sets share.
//!
//! A footprint reaches a few registers of its tier. Its weights are spread out over the channels of columns, as many
//! registers at a time as a chunk of weights fills, and each section is added to those by them.

use super::{Above, Folded, PART, Shape, Tiers, Weights, a_line, groups};
use crate::splat::records::apart::{Apart, BATCH, Each, Layers};
use crate::splat::records::{Line, MOST, Recorded, Splat, Table};

/// Registers in which sums of one kind are added to tiers.
///
/// # Safety
/// All functions are for machines with the instructions of who implements them.
pub(super) trait Wide<S: Recorded> {
    /// Weights of some columns or a section, each for all channels.
    type Register: Copy;
    /// Registers of a line of the cache.
    const OF_LINE: usize;
    /// Registers whose weights are read at once, at most: two or four.
    const CHUNK: usize;
    /// Whether voxels with sections of their own are added sheet by sheet: else each to all of its sheets.
    const BY_SHEET: bool;

    /// A payload, over and over.
    unsafe fn payload(payload: &S::Payload) -> Self::Register;

    /// A payload times a weight in depth.
    unsafe fn section(payload: Self::Register, wz: S::Depth) -> Self::Register;

    /// The weights of a footprint of `table` from `from` on, of the `chunk`th `GROUPS` registers from the one in whose
    /// column `shift` it begins; nothing around it.
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

    /// [`super::Tiered::fold`].
    unsafe fn fold<const N: usize>(
        tiers: &Tiers<'_, S, N>,
        above: [Above<'_, S::Weight>; 2],
        spread: f32,
        open: u64,
        to: &mut Folded<S>,
    ) -> u64;
}

/// Compiles the loops for some instructions.
macro_rules! compiled {
    ($features:literal) => {
        /// [`super::wide::add_flat`].
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

        /// [`super::wide::add_apart`].
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

        /// [`Wide::fold`].
        #[target_feature(enable = $features)]
        pub(super) fn fold<W: Wide<S>, S: Recorded, const N: usize>(
            tiers: &Tiers<'_, S, N>,
            above: [Above<'_, S::Weight>; 2],
            spread: f32,
            open: u64,
            to: &mut Folded<S>,
        ) -> u64 {
            // SAFETY: these are the instructions.
            unsafe { W::fold(tiers, above, spread, open, to) }
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

/// [`super::Tiered::add_flat`].
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

/// [`super::Tiered::add_apart`].
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

/// What sections are added to: registers of all sheets, so many each, and in how many chunks.
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

/// The lines of tiers, all of which are there from the part's first column to its last.
#[inline(always)]
pub(super) fn lines_of<S: Recorded, const N: usize>(
    tiers: &Tiers<'_, S, N>,
    above: &[Above<'_, S::Weight>; 2],
) -> *const Line {
    let there = tiers.lines.len() - PART as usize / a_line::<S>();
    let last = |(begin, weights): &Above<'_, S::Weight>| {
        *begin as usize + weights.len().saturating_sub(1) * tiers.shape.wide
    };
    assert!(last(&above[0]).max(last(&above[1])) <= there, "a tier is longer than a part is wide");
    tiers.lines.as_ptr()
}
