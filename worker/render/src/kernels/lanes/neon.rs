//! Four lanes of NEON, which every 64-bit ARM has.

use super::{BESIDE, Lanes, SPREAD, first};
use std::arch::aarch64::*;

/// Four lanes.
pub(crate) struct Four;

/// The first sixteen of a table in bytes of lanes: what one look-up of bytes takes.
const fn by_bytes(table: &[u64; 256]) -> [[u8; 16]; 16] {
    let mut all = [[0; 16]; 16];
    let mut bits = 0;
    while bits < 16 {
        let mut byte = 0;
        while byte < 16 {
            let lane = (table[bits] >> (8 * (byte / 4))) as u8;
            all[bits][byte] = 4 * lane + byte as u8 % 4;
            byte += 1;
        }
        bits += 1;
    }
    all
}

impl Four {
    const BESIDE: [[u8; 16]; 16] = by_bytes(&BESIDE);
    const SPREAD: [[u8; 16]; 16] = by_bytes(&SPREAD);

    /// Lanes of `a` in the order that a table says.
    #[target_feature(enable = "neon")]
    #[inline]
    fn ordered(table: &'static [[u8; 16]; 16], bits: u32, a: int32x4_t) -> int32x4_t {
        // SAFETY: sixteen bytes.
        let order = unsafe { vld1q_u8(table[bits as usize % 16].as_ptr()) };
        vreinterpretq_s32_u8(vqtbl1q_u8(vreinterpretq_u8_s32(a), order))
    }

    /// A bit for each lane.
    #[target_feature(enable = "neon")]
    #[inline]
    fn each() -> uint32x4_t {
        // SAFETY: sixteen bytes.
        unsafe { vld1q_u32([1, 2, 4, 8].as_ptr()) }
    }

    /// Four by four, turned over.
    #[target_feature(enable = "neon")]
    #[inline]
    fn turned(p: [int32x4_t; 4]) -> [int32x4_t; 4] {
        let wide = vreinterpretq_s64_s32;
        let low = [wide(vzip1q_s32(p[0], p[1])), wide(vzip1q_s32(p[2], p[3]))];
        let high = [wide(vzip2q_s32(p[0], p[1])), wide(vzip2q_s32(p[2], p[3]))];
        let narrow = vreinterpretq_s32_s64;
        [
            narrow(vzip1q_s64(low[0], low[1])),
            narrow(vzip2q_s64(low[0], low[1])),
            narrow(vzip1q_s64(high[0], high[1])),
            narrow(vzip2q_s64(high[0], high[1])),
        ]
    }
}

impl Lanes for Four {
    const LANES: usize = 4;
    type Ints = int32x4_t;
    /// All bits of a lane, or none.
    type Marks = uint32x4_t;

    with! { "neon"
        fn set(n: i32) -> int32x4_t { vdupq_n_s32(n) }
        fn from(n: i32) -> int32x4_t {
            // SAFETY: sixteen bytes.
            vaddq_s32(vdupq_n_s32(n), unsafe { vld1q_s32([0, 1, 2, 3].as_ptr()) })
        }
        fn load(at: *const u32) -> int32x4_t {
            // SAFETY: the caller has four numbers there.
            unsafe { vld1q_s32(at.cast()) }
        }
        fn store(to: *mut u32, a: int32x4_t) {
            // SAFETY: the caller has room for four there.
            unsafe { vst1q_s32(to.cast(), a) }
        }
        fn plus(a: int32x4_t, b: int32x4_t) -> int32x4_t { vaddq_s32(a, b) }
        fn minus(a: int32x4_t, b: int32x4_t) -> int32x4_t { vsubq_s32(a, b) }
        fn times(a: int32x4_t, b: int32x4_t) -> int32x4_t { vmulq_s32(a, b) }
        fn and(a: int32x4_t, b: int32x4_t) -> int32x4_t { vandq_s32(a, b) }
        fn without(a: int32x4_t, b: int32x4_t) -> int32x4_t { vbicq_s32(b, a) }
        fn or(a: int32x4_t, b: int32x4_t) -> int32x4_t { vorrq_s32(a, b) }
        fn min(a: int32x4_t, b: int32x4_t) -> int32x4_t { vminq_s32(a, b) }
        fn max(a: int32x4_t, b: int32x4_t) -> int32x4_t { vmaxq_s32(a, b) }
        fn up(a: int32x4_t, bits: u32) -> int32x4_t { vshlq_s32(a, vdupq_n_s32(bits as i32)) }
        fn down(a: int32x4_t, bits: u32) -> int32x4_t { vshlq_s32(a, vdupq_n_s32(-(bits as i32))) }
        fn up_each(a: int32x4_t, b: int32x4_t) -> int32x4_t { vshlq_s32(a, b) }
        fn less(a: int32x4_t, b: int32x4_t) -> uint32x4_t { vcltq_s32(a, b) }
        fn at_most(a: int32x4_t, b: int32x4_t) -> uint32x4_t {
            vcleq_u32(vreinterpretq_u32_s32(a), vreinterpretq_u32_s32(b))
        }
        fn both(a: uint32x4_t, b: uint32x4_t) -> uint32x4_t { vandq_u32(a, b) }
        fn bits(marks: uint32x4_t) -> u32 { vaddvq_u32(vandq_u32(marks, Four::each())) }
        fn marks(bits: u32) -> uint32x4_t { vtstq_u32(vdupq_n_u32(bits), Four::each()) }
        fn one_more(marks: uint32x4_t, a: int32x4_t) -> int32x4_t {
            vsubq_s32(a, vreinterpretq_s32_u32(marks))
        }
        fn look_up(marks: uint32x4_t, table: *const u32, at: int32x4_t) -> int32x4_t {
            let at = vandq_u32(marks, vreinterpretq_u32_s32(at));
            let [a, b, c, d] = [
                vgetq_lane_u32::<0>(at),
                vgetq_lane_u32::<1>(at),
                vgetq_lane_u32::<2>(at),
                vgetq_lane_u32::<3>(at),
            ].map(|at| table.wrapping_add(at as usize));
            // SAFETY: the caller says that the table has what is looked up, and a first number.
            let found = unsafe { [*a, *b, *c, *d] };
            // SAFETY: sixteen bytes.
            unsafe { vld1q_s32(found.as_ptr().cast()) }
        }
        fn beside(bits: u32, a: int32x4_t) -> int32x4_t { Four::ordered(&Four::BESIDE, bits, a) }
        fn spread(bits: u32, a: int32x4_t) -> int32x4_t { Four::ordered(&Four::SPREAD, bits, a) }
        fn bytes(items: &[u8]) -> int32x4_t {
            let items = vcreate_u8(u32::from_le_bytes(first(items)).into());
            vreinterpretq_s32_u32(vmovl_u16(vget_low_u16(vmovl_u8(items))))
        }
        fn shorts(items: &[u16]) -> int32x4_t {
            // SAFETY: four numbers are eight bytes.
            let items = unsafe { vld1_u16(first::<_, 4>(items).as_ptr()) };
            vreinterpretq_s32_u32(vmovl_u16(items))
        }
        fn floats(items: &[f32]) -> int32x4_t {
            // SAFETY: four numbers are sixteen bytes.
            unsafe { vld1q_s32(first::<_, 4>(items).as_ptr().cast()) }
        }
        fn store_fours(to: *mut u32, fours: [int32x4_t; 4]) {
            let [a, b, c, d] = fours;
            // SAFETY: the caller has room for four times four numbers.
            unsafe { vst4q_s32(to.cast(), int32x4x4_t(a, b, c, d)) };
        }
        fn fours(from: *const u32, stride: usize, at: *const u32) -> [int32x4_t; 4] {
            let mut places = [vdupq_n_s32(0); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has four numbers at each place.
                *places = unsafe { vld1q_s32(from.add(*at.add(i) as usize * stride).cast()) };
            }
            Four::turned(places)
        }
        fn pairs(from: *const u32, at: *const u32) -> [int32x4_t; 2] {
            let mut places = [vdupq_n_s32(0); 2];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let [a, b] = [2 * i, 2 * i + 1].map(|i| from.add(*at.add(i) as usize * 2).cast());
                    vcombine_s32(vld1_s32(a), vld1_s32(b))
                };
            }
            let [low, high] = places;
            [vuzp1q_s32(low, high), vuzp2q_s32(low, high)]
        }
        fn twos(from: [*const u32; 2], stride: usize, at: *const u32) -> [int32x4_t; 4] {
            let mut places = [vdupq_n_s32(0); 4];
            for (i, places) in places.iter_mut().enumerate() {
                // SAFETY: the caller has two numbers at each place.
                *places = unsafe {
                    let [a, b] = from.map(|from| from.add(*at.add(i) as usize * stride).cast());
                    vcombine_s32(vld1_s32(a), vld1_s32(b))
                };
            }
            Four::turned(places)
        }
        fn store_floats(to: *mut f32, a: int32x4_t) {
            // SAFETY: the caller has room for four there.
            unsafe { vst1q_f32(to, vcvtq_f32_s32(a)) }
        }
        fn bits_of_sums(n: i64, at: *const i64, from: u32) -> int32x4_t {
            let (n, from) = (vdupq_n_s64(n), vdupq_n_s64(-i64::from(from)));
            // SAFETY: the caller has four numbers there.
            let (low, high) = unsafe { (vld1q_s64(at), vld1q_s64(at.add(2))) };
            let low = vreinterpretq_s32_s64(vshlq_s64(vaddq_s64(n, low), from));
            let high = vreinterpretq_s32_s64(vshlq_s64(vaddq_s64(n, high), from));
            // The lower halves.
            vuzp1q_s32(low, high)
        }
    }
}
