//! Records in lanes of NEON: registers of sixteen bytes, written once for all kinds of sums.
//!
//! Whether weights are of one pixel and all slots or of a slot each, what is added is a row times
//! as many weights as a register has sums, rounded by one instruction: for 16-bit sums the
//! product's upper half, for 32-bit sums the nearest whole number. Those are not clamped
//! ([`super::long`] says why).

use crate::kernels::lanes::Four;
use crate::kernels::pixel_records::sheet_offsets::lines::{self, Lines};
use crate::kernels::pixel_records::sheet_offsets::{
    self, Apart, ApartAt, BATCH, LINE, Layers, Woven,
};
use crate::kernels::pixel_records::{
    Across, BySlot, MOST, Record, Recorded, RowAt, STRIDE, Splat, Tables, weave as weave_plain,
};
use crate::kernels::{Grey, Simd, Tap};
use std::arch::aarch64::*;

/// Registers of a record at most: one slot each.
const PARTS: usize = MOST;

/// A number for each sum of a record.
type Parts<S> = [<S as InLanes>::Lanes; PARTS];

/// Sums in registers.
pub(in super::super) trait InLanes: Recorded {
    /// Numbers of a register.
    type Lanes: Copy;
    /// Number of lanes of a register.
    const LANES: usize;

    /// # Safety
    /// For machines with NEON, as are all functions here.
    unsafe fn nothing() -> Self::Lanes;
    /// The numbers that sixteen bytes are.
    unsafe fn of(bytes: uint8x16_t) -> Self::Lanes;
    /// One weight in all lanes.
    unsafe fn all(w: Self::Weight) -> Self::Lanes;
    /// The channels of a payload, again and again.
    unsafe fn channels(payload: Self::Payload) -> Self::Lanes;
    /// `a * b`, rounded as sums of the kind are.
    unsafe fn times(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    /// A section: `payload * wz`, or nothing where that is negative.
    unsafe fn cut_by(payload: Self::Lanes, wz: Self::Lanes) -> Self::Lanes;
    /// Adds `row * w` to the sums at `at`, which nobody else looks at.
    unsafe fn add_to(at: *mut uint8x16_t, row: Self::Lanes, w: Self::Lanes);
    /// Weights of N slots, the first ones in the first register: each once for every sum of its
    /// slot.
    unsafe fn spread<const N: usize>(weights: [Self::Lanes; 2]) -> Parts<Self>;
    /// Weights from `from` on, all of which can be read; zero where they have no bit in `present`.
    unsafe fn some(present: u32, from: *const Self::Weight) -> Self::Lanes;
    /// Writes the first numbers of N registers, then the second ones, and so on.
    unsafe fn store_woven<const N: usize>(to: *mut Self::Weight, slots: Parts<Self>);
}

impl InLanes for i16 {
    type Lanes = int16x8_t;
    const LANES: usize = 8;

    with! { "neon"
        fn nothing() -> int16x8_t { vdupq_n_s16(0) }
        fn of(bytes: uint8x16_t) -> int16x8_t { vreinterpretq_s16_u8(bytes) }
        fn all(w: i16) -> int16x8_t { vdupq_n_s16(w) }
        fn channels(payload: u64) -> int16x8_t { vreinterpretq_s16_u64(vdupq_n_u64(payload)) }
        fn times(a: int16x8_t, b: int16x8_t) -> int16x8_t { vqrdmulhq_s16(a, b) }
        fn cut_by(payload: int16x8_t, wz: int16x8_t) -> int16x8_t { vqrdmulhq_s16(payload, wz) }
        fn add_to(at: *mut uint8x16_t, row: int16x8_t, w: int16x8_t) {
            // SAFETY: the caller has eight sums there.
            unsafe { vst1q_s16(at.cast(), vqaddq_s16(vld1q_s16(at.cast()), vqrdmulhq_s16(row, w))) }
        }
    }

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn spread<const N: usize>([weights, _]: [int16x8_t; 2]) -> Parts<i16> {
        let mut parts = [weights; PARTS];
        for (four, parts) in parts[..N / 2].chunks_mut(2).enumerate() {
            let twice = match four {
                0 => vzip1q_s16(weights, weights),
                _ => vzip2q_s16(weights, weights),
            };
            let twice = vreinterpretq_s32_s16(twice);
            parts[0] = vreinterpretq_s16_s32(vzip1q_s32(twice, twice));
            parts[1] = vreinterpretq_s16_s32(vzip2q_s32(twice, twice));
        }
        parts
    }

    with! { "neon"
        fn some(present: u32, from: *const i16) -> int16x8_t {
            let each = [1, 2, 4, 8, 16, 32, 64, 128];
            // SAFETY: sixteen bytes each; the caller has eight weights there.
            let (each, some) = unsafe { (vld1q_s16(each.as_ptr()), vld1q_s16(from)) };
            let present = vtstq_s16(vdupq_n_s16(present as i16), each);
            vandq_s16(some, vreinterpretq_s16_u16(present))
        }
    }

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn store_woven<const N: usize>(to: *mut i16, slots: Parts<i16>) {
        let [a, b, c, d, e, f, g, h] = slots;
        if N == 4 {
            // SAFETY: the caller has room for eight times four weights.
            return unsafe { vst4q_s16(to, int16x8x4_t(a, b, c, d)) };
        }
        let low = |a, b| vreinterpretq_s32_s16(vzip1q_s16(a, b));
        let high = |a, b| vreinterpretq_s32_s16(vzip2q_s16(a, b));
        // SAFETY: the caller has room for eight times eight weights.
        unsafe {
            vst4q_s32(to.cast(), int32x4x4_t(low(a, b), low(c, d), low(e, f), low(g, h)));
            let to = to.add(32).cast();
            vst4q_s32(to, int32x4x4_t(high(a, b), high(c, d), high(e, f), high(g, h)));
        }
    }
}

/// Implements the members that all 32-bit sums share.
macro_rules! four_lanes {
    () => {
        type Lanes = float32x4_t;
        const LANES: usize = 4;

        with! { "neon"
            fn nothing() -> float32x4_t { vdupq_n_f32(0.0) }
            fn of(bytes: uint8x16_t) -> float32x4_t { vreinterpretq_f32_u8(bytes) }
            fn all(w: Tap) -> float32x4_t { vdupq_n_f32(w.get()) }
            fn times(a: float32x4_t, b: float32x4_t) -> float32x4_t { vmulq_f32(a, b) }
            fn cut_by(payload: float32x4_t, wz: float32x4_t) -> float32x4_t {
                // Of nothing and what is not a number, nothing.
                vmaxnmq_f32(vmulq_f32(payload, wz), vdupq_n_f32(0.0))
            }
            fn add_to(at: *mut uint8x16_t, row: float32x4_t, w: float32x4_t) {
                let add = vcvtnq_s32_f32(vmulq_f32(row, w));
                // SAFETY: the caller has four sums there.
                unsafe { vst1q_s32(at.cast(), vaddq_s32(vld1q_s32(at.cast()), add)) }
            }
            fn some(present: u32, from: *const Tap) -> float32x4_t {
                // SAFETY: sixteen bytes each, and a tap is a float; the caller has four of them
                // there.
                let (each, some) = unsafe { (vld1q_u32([1, 2, 4, 8].as_ptr()), vld1q_u32(from.cast())) };
                vreinterpretq_f32_u32(vandq_u32(some, vtstq_u32(vdupq_n_u32(present), each)))
            }
        }

        #[target_feature(enable = "neon")]
        #[inline]
        unsafe fn store_woven<const N: usize>(to: *mut Tap, slots: Parts<Self>) {
            let [a, b, c, d, e, f, g, h] = slots;
            if N == 4 {
                // SAFETY: the caller has room for four times four weights, and none is negative.
                return unsafe { vst4q_f32(to.cast(), float32x4x4_t(a, b, c, d)) };
            }
            let low = |a, b| vreinterpretq_s64_f32(vzip1q_f32(a, b));
            let high = |a, b| vreinterpretq_s64_f32(vzip2q_f32(a, b));
            // SAFETY: the caller has room for four times eight weights, and none is negative.
            unsafe {
                vst4q_s64(to.cast(), int64x2x4_t(low(a, b), low(c, d), low(e, f), low(g, h)));
                let to = to.add(16).cast();
                vst4q_s64(to, int64x2x4_t(high(a, b), high(c, d), high(e, f), high(g, h)));
            }
        }
    };
}

impl InLanes for i32 {
    four_lanes!();

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn channels(payload: [f32; 4]) -> float32x4_t {
        // SAFETY: four floats are sixteen bytes.
        unsafe { vld1q_f32(payload.as_ptr()) }
    }

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn spread<const N: usize>(weights: [float32x4_t; 2]) -> Parts<i32> {
        let mut parts = [weights[0]; PARTS];
        for (parts, weights) in parts[..N].chunks_mut(4).zip(weights) {
            parts[0] = vdupq_laneq_f32::<0>(weights);
            parts[1] = vdupq_laneq_f32::<1>(weights);
            parts[2] = vdupq_laneq_f32::<2>(weights);
            parts[3] = vdupq_laneq_f32::<3>(weights);
        }
        parts
    }
}

/// Two slots a register.
impl InLanes for Grey {
    four_lanes!();

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn channels([sigma, grey]: [f32; 2]) -> float32x4_t {
        // SAFETY: four floats are sixteen bytes.
        unsafe { vld1q_f32([sigma, grey, sigma, grey].as_ptr()) }
    }

    #[target_feature(enable = "neon")]
    #[inline]
    unsafe fn spread<const N: usize>(weights: [float32x4_t; 2]) -> Parts<Grey> {
        let mut parts = [weights[0]; PARTS];
        for (parts, weights) in parts[..N / 2].chunks_mut(2).zip(weights) {
            parts[0] = vzip1q_f32(weights, weights);
            parts[1] = vzip2q_f32(weights, weights);
        }
        parts
    }
}

/// Registers of a record.
#[inline(always)]
const fn parts<S: InLanes, const N: usize>() -> usize {
    const { assert!((N == 4 || N == MOST) && size_of::<Record<S, N>>() / 16 <= PARTS) };
    size_of::<Record<S, N>>() / 16
}

/// Weights of N slots in registers.
///
/// # Safety
/// They are there.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn load<const N: usize, W>(weights: *const W) -> [uint8x16_t; 2] {
    let from: *const u8 = weights.cast();
    // SAFETY: the caller's.
    unsafe {
        match N * size_of::<W>() {
            8 => [vcombine_u8(vld1_u8(from), vcreate_u8(0)); 2],
            16 => [vld1q_u8(from); 2],
            _ => [vld1q_u8(from), vld1q_u8(from.add(16))],
        }
    }
}

/// The weights of a pixel or a row, for every sum of a record.
#[target_feature(enable = "neon")]
#[inline]
fn by_slot<S: InLanes, const N: usize>(weights: &BySlot<S::Weight, N>) -> Parts<S> {
    // SAFETY: these are the instructions, and so many weights.
    unsafe {
        let [low, high] = load::<N, S::Weight>(weights.as_ptr());
        S::spread::<N>([S::of(low), S::of(high)])
    }
}

/// Bytes of weights in depth that belong to slots, where the first weight belongs to `slot`.
#[inline(always)]
fn turn<S: InLanes, const N: usize>(slot: usize) -> [[u8; 16]; 2] {
    let size = size_of::<S::Depth>();
    [0, 1].map(|part| {
        std::array::from_fn(|byte| {
            let at = 16 * part + byte;
            ((at / size + 2 * N - slot) % N * size + at % size) as u8
        })
    })
}

/// The sections of a voxel in all slots, by its first weights in depth and [`turn`].
#[target_feature(enable = "neon")]
#[inline]
fn section<S: InLanes, const N: usize>(
    payload: S::Payload,
    z: &[S::Depth],
    turn: &[[u8; 16]; 2],
) -> Parts<S> {
    let mut few = [S::Depth::default(); N];
    let z = match z.first_chunk::<N>() {
        Some(z) => z,
        None => {
            few[..z.len()].copy_from_slice(z);
            &few
        }
    };
    // SAFETY: these are the instructions; so many weights, and sixteen bytes.
    unsafe {
        let z = load::<N, S::Depth>(z.as_ptr());
        let turn = [vld1q_u8(turn[0].as_ptr()), vld1q_u8(turn[1].as_ptr())];
        let z = if N * size_of::<S::Depth>() <= 16 {
            [S::of(vqtbl1q_u8(z[0], turn[0])); 2]
        } else {
            let both = uint8x16x2_t(z[0], z[1]);
            [S::of(vqtbl2q_u8(both, turn[0])), S::of(vqtbl2q_u8(both, turn[1]))]
        };
        let payload = S::channels(payload);
        let mut sections = S::spread::<N>(z);
        for section in &mut sections[..parts::<S, N>()] {
            *section = S::cut_by(payload, *section);
        }
        sections
    }
}

#[target_feature(enable = "neon")]
#[inline]
fn times<S: InLanes, const N: usize>(a: &Parts<S>, b: &Parts<S>) -> Parts<S> {
    let mut all = *a;
    for i in 0..parts::<S, N>() {
        // SAFETY: these are the instructions.
        all[i] = unsafe { S::times(a[i], b[i]) };
    }
    all
}

/// Adds `row * w`, register by register, to a record.
#[target_feature(enable = "neon")]
#[inline]
fn add<S: InLanes, const N: usize>(record: &mut Record<S, N>, row: &Parts<S>, w: &Parts<S>) {
    let at: *mut uint8x16_t = record.as_mut_ptr().cast();
    for i in 0..parts::<S, N>() {
        // SAFETY: these are the instructions; so many registers are the record, borrowed for us
        // alone.
        unsafe { S::add_to(at.add(i), row[i], w[i]) };
    }
}

/// Arguments of [`splat_all`], in one.
type At<'a, S, const N: usize> = (
    &'a mut [Record<S, N>],
    (&'a [Splat], &'a [<S as Recorded>::Payload]),
    usize,
    &'a Tables<'a, S>,
);

/// [`Recorded::splat_all`] with NEON.
#[target_feature(enable = "neon")]
pub(super) fn splat_all<S: InLanes, const N: usize>(
    records: &mut [Record<S, N>],
    voxels: (&[Splat], &[S::Payload]),
    slot: usize,
    tables: &Tables<'_, S>,
) {
    let at = (records, voxels, slot, tables);
    by_width!(tables.across[0].len, all[S, N], at, all::<0, S, N>(at))
}

/// Splats sums of [`Grey`], with the tables of the sums that it equals bit for bit.
#[target_feature(enable = "neon")]
pub(super) fn splat_grey<const N: usize>(
    records: &mut [Record<Grey, N>],
    voxels: (&[Splat], &[[f32; 2]]),
    slot: usize,
    tables: &Tables<'_, i32>,
) {
    let Tables { across, deep } = *tables;
    splat_all::<Grey, N>(records, voxels, slot, &Tables { across, deep });
}

/// Footprints of `WIDE` columns, or of any number where that is 0.
#[target_feature(enable = "neon")]
#[inline]
fn all<const WIDE: usize, S: InLanes, const N: usize>(
    (records, (voxels, payloads), slot, tables): At<'_, S, N>,
) {
    let turn = turn::<S, N>(slot);
    for (v, &payload) in voxels.iter().zip(payloads) {
        let (x, y, z) = v.weights(tables);
        let section = section::<S, N>(payload, z, &turn);
        // SAFETY: these are the instructions.
        let mut wx = unsafe { [S::nothing(); WIDE] };
        for (wx, &w) in wx.iter_mut().zip(x) {
            // SAFETY: as above.
            *wx = unsafe { S::all(w) };
        }
        for (row, &wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
            // SAFETY: as above.
            let wy = unsafe { S::all(wy) };
            let of_row = times::<S, N>(&section, &[wy; PARTS]);
            if WIDE == 0 {
                for (record, &wx) in row[..x.len()].iter_mut().zip(x) {
                    // SAFETY: as above.
                    let wx = unsafe { S::all(wx) };
                    add::<S, N>(record, &of_row, &[wx; PARTS]);
                }
            } else {
                let row = row.first_chunk_mut::<WIDE>().expect("a footprint inside the part");
                for i in 0..WIDE {
                    add::<S, N>(&mut row[i], &of_row, &[wx[i]; PARTS]);
                }
            }
        }
    }
}

/// [`Recorded::splat_deep`] with NEON.
#[target_feature(enable = "neon")]
pub(super) fn splat_deep<S: InLanes, const N: usize>(
    records: &mut [Record<S, N>],
    at: usize,
    (x, y): Across<'_, S::Weight, N>,
    payload: S::Payload,
    z: &BySlot<S::Depth, N>,
) {
    let section = section::<S, N>(payload, z, &turn::<S, N>(0));
    for (row, wy) in records[at..].chunks_mut(STRIDE).zip(y) {
        let of_row = times::<S, N>(&section, &by_slot::<S, N>(wy));
        for (record, wx) in row[..x.len()].iter_mut().zip(x) {
            add::<S, N>(record, &of_row, &by_slot::<S, N>(wx));
        }
    }
}

/// Puts weights of N rows beside each other in the first `n` columns and some more: those that have
/// a bit in `present`. Rows begin at `from`.
///
/// # Safety
/// [`LINE`] weights are there in each, and no more columns are asked for.
#[target_feature(enable = "neon")]
#[inline]
unsafe fn weave_some<S: InLanes, const N: usize>(
    present: &[u32; N],
    from: &[*const S::Weight; N],
    n: usize,
    to: &mut [BySlot<S::Weight, N>; LINE],
) {
    for (i, to) in to.chunks_exact_mut(S::LANES).take(n.div_ceil(S::LANES)).enumerate() {
        // SAFETY: these are the instructions; there is room for so many columns, and the caller has
        // as many weights.
        unsafe {
            let mut slots = [S::nothing(); PARTS];
            for slot in 0..N {
                let from = from[slot].add(S::LANES * i);
                slots[slot] = S::some(present[slot] >> (S::LANES * i), from);
            }
            S::store_woven::<N>(to.as_mut_ptr().cast(), slots);
        }
    }
}

/// [`Recorded::weave`] with NEON.
#[target_feature(enable = "neon")]
pub(super) fn weave<S: InLanes, const N: usize>(
    rows: [RowAt<'_, S::Weight>; N],
    wide: usize,
    to: &mut [BySlot<S::Weight, N>],
) {
    let mut present = [0; N];
    let mut from = [std::ptr::null(); N];
    let mut inside = wide <= LINE;
    for (slot, at) in rows.iter().enumerate() {
        let (bits, first) = at.columns();
        (present[slot], from[slot]) = (bits.into(), first);
        // What lies around the row in its table is read, too.
        let around = usize::try_from(at.from as isize - at.column as isize);
        inside &= around.is_ok_and(|around| around + LINE <= at.table.len());
    }
    match to.first_chunk_mut() {
        // SAFETY: as was just seen.
        Some(to) if inside => unsafe { weave_some::<S, N>(&present, &from, wide, to) },
        _ => weave_plain(rows, wide, to),
    }
}

/// [`Recorded::splat_apart`] with NEON.
#[target_feature(enable = "neon")]
pub(super) fn splat_apart<S: InLanes, const N: usize>(
    simd: Simd,
    records: &mut [Record<S, N>],
    (apart, payloads): (&Apart, &[S::Payload]),
    layers: &Layers<'_, S, N>,
    woven: &mut Woven<S::Weight, N>,
) {
    let kept = &apart.kept[..payloads.len()];
    let Some(wide) = lines::widest(apart, kept, 1) else {
        return sheet_offsets::splat_apart(simd, records, (apart, payloads), layers, woven);
    };
    let at = (records, (apart, payloads), layers, &mut woven.spans);
    by_window_alike!(wide, side_by_side[S, N], at)
}

/// Weights of voxel `i`, pixel by pixel, of at least the first `n` pixels.
#[target_feature(enable = "neon")]
#[inline]
fn line<S: InLanes, const N: usize>(
    lines: &Lines<'_, S::Weight, N>,
    i: usize,
    n: usize,
    to: &mut [BySlot<S::Weight, N>; LINE],
) {
    let mut present = [0; N];
    let mut from = [std::ptr::null(); N];
    let mut inside = true;
    for slot in 0..N {
        (present[slot], from[slot]) = lines.of(slot, i);
        inside &= lines.around(slot, i).1.is_some();
    }
    if inside {
        // SAFETY: as was just seen.
        return unsafe { weave_some::<S, N>(&present, &from, n, to) };
    }
    for slot in 0..N {
        for (to, w) in to.iter_mut().zip(lines.one_by_one(slot, i)) {
            to[slot] = w;
        }
    }
}

/// Windows of `WIDE` columns.
#[target_feature(enable = "neon")]
#[inline]
fn side_by_side<const WIDE: usize, S: InLanes, const N: usize, const ALIKE: bool>(
    (records, (apart, payloads), layers, spans): ApartAt<'_, S, N>,
) {
    let turn = turn::<S, N>(layers.slot);
    let kept = &apart.kept[..payloads.len()];
    // SAFETY: these are the instructions.
    let [across, down] = unsafe { Lines::both::<Four, _>(apart, kept, layers, spans, (WIDE, 1)) };
    let [mut columns, mut rows] = [[[S::Weight::default(); N]; LINE]; 2];
    for (&i, &payload) in kept.iter().zip(payloads) {
        let i = i as usize % BATCH;
        let ([x, y], [_, high]) = apart.window(i, 1);
        let x = lines::inside(x, WIDE);
        let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
        let section = section::<S, N>(payload, z, &turn);
        line::<S, N>(&down, i, high, &mut rows);
        // SAFETY: these are the instructions.
        let mut wx = unsafe { [[S::nothing(); PARTS]; WIDE] };
        if ALIKE {
            for (wx, &w) in wx.iter_mut().zip(&across.one_by_one(layers.slot, i)) {
                // SAFETY: as above.
                *wx = unsafe { [S::all(w); PARTS] };
            }
        } else {
            line::<S, N>(&across, i, WIDE, &mut columns);
            for (wx, w) in wx.iter_mut().zip(&columns) {
                *wx = by_slot::<S, N>(w);
            }
        }
        for (row, wy) in records[y * STRIDE + x..].chunks_mut(STRIDE).zip(&rows).take(high) {
            let of_row = times::<S, N>(&section, &by_slot::<S, N>(wy));
            let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
            for c in 0..WIDE {
                add::<S, N>(&mut row[c], &of_row, &wx[c]);
            }
        }
    }
}
