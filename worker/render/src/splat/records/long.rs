//! Records of 32-bit sums in lanes.
//!
//! What is added is `(section * wy) * wx + 1/2`, cut off, as the plain loop has it, but without its
//! clamps: a payload times weights stays below 2^31 (`bounds::raw_per_payload`), and what would not
//! turns into i32's smallest number here and its largest there.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use crate::sheet::{LANES, Row};
    use crate::splat::Tap;
    use crate::splat::records::{Record, SLOTS, STRIDE, STRIP, Splat, Strip, Tables};
    use std::arch::x86_64::*;

    /// The section of a voxel in two sheets a register.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn sections(payload: &[f32; 4], z: &[f32], slot: usize) -> [__m256; SLOTS / 2] {
        let mut wz = [[0f32; 4]; SLOTS];
        for (i, &w) in z.iter().enumerate() {
            wz[(slot + i) % SLOTS] = [w; 4];
        }
        // SAFETY: four floats are 16 bytes.
        let payload = unsafe { _mm_loadu_ps(payload.as_ptr()) };
        let payload = _mm256_set_m128(payload, payload);
        let mut sections = [_mm256_setzero_ps(); SLOTS / 2];
        for i in 0..SLOTS / 2 {
            // SAFETY: two slots are 32 bytes. Negative sections there are none.
            let w = unsafe { _mm256_loadu_ps(wz[2 * i].as_ptr()) };
            sections[i] = _mm256_max_ps(_mm256_mul_ps(payload, w), _mm256_setzero_ps());
        }
        sections
    }

    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_all(
        records: &mut [Record<i32>],
        (voxels, payloads): (&[Splat], &[[f32; 4]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        let half = _mm256_set1_ps(0.5);
        for (v, payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let sections = sections(payload, z, slot);
            for (row, wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
                let wy = _mm256_set1_ps(wy.get());
                let mut rows = sections;
                for row in &mut rows {
                    *row = _mm256_mul_ps(*row, wy);
                }
                for (record, wx) in row[..x.len()].iter_mut().zip(x) {
                    let wx = _mm256_set1_ps(Tap::get(*wx));
                    let at: *mut __m256i = std::ptr::from_mut(record).cast();
                    for (i, row) in rows.iter().enumerate() {
                        let add = _mm256_add_ps(_mm256_mul_ps(*row, wx), half);
                        // SAFETY: a record is 128 bytes, aligned to 64, and borrowed for us alone.
                        unsafe {
                            let sums = _mm256_load_si256(at.add(i));
                            let sums = _mm256_add_epi32(sums, _mm256_cvttps_epi32(add));
                            _mm256_store_si256(at.add(i), sums);
                        }
                    }
                }
            }
        }
    }

    /// Four by four in each half, turned over.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn turned(p: [__m256i; 4]) -> [__m256i; 4] {
        let low = [_mm256_unpacklo_epi32(p[0], p[1]), _mm256_unpacklo_epi32(p[2], p[3])];
        let high = [_mm256_unpackhi_epi32(p[0], p[1]), _mm256_unpackhi_epi32(p[2], p[3])];
        [
            _mm256_unpacklo_epi64(low[0], low[1]),
            _mm256_unpackhi_epi64(low[0], low[1]),
            _mm256_unpacklo_epi64(high[0], high[1]),
            _mm256_unpackhi_epi64(high[0], high[1]),
        ]
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn take(
        (records, before): (&mut [Record<i32>], &mut [[i32; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        const { assert!(LANES == 2 * STRIP) };
        let behind = (slot + 1) % SLOTS;
        let twice = strips[0].pixel == strips[1].pixel;
        for (half, strip) in strips.iter().enumerate() {
            let lane = half * STRIP;
            row.a[lane..lane + STRIP].copy_from_slice(&a[strip.pixel..strip.pixel + STRIP]);
            let records = &mut records[strip.record..strip.record + STRIP];
            let before = &mut before[strip.pixel..strip.pixel + STRIP];
            // SAFETY: four sums are 16 bytes.
            let load = |sums: &[i32; 4]| unsafe { _mm_loadu_si128(sums.as_ptr().cast()) };
            // Pixel i, and above it pixel i + 4.
            let mut sheets = [[_mm256_setzero_si256(); 4]; 3];
            for i in 0..4 {
                sheets[0][i] = _mm256_set_m128i(load(&before[i + 4]), load(&before[i]));
                let pair = [&records[i + 4].0, &records[i].0];
                sheets[1][i] = _mm256_set_m128i(load(&pair[0][slot]), load(&pair[1][slot]));
                sheets[2][i] = _mm256_set_m128i(load(&pair[0][behind]), load(&pair[1][behind]));
            }
            if !(twice && half == 0) {
                for (before, record) in before.iter_mut().zip(records) {
                    *before = record.0[slot];
                    record.0[slot] = [0; 4];
                }
            }
            let to = [&mut row.before, &mut row.here, &mut row.behind];
            for (to, sheet) in to.into_iter().zip(sheets) {
                let sums = turned(sheet);
                for (to, sums) in to.iter_mut().zip(sums) {
                    let to = to[lane..].first_chunk_mut::<STRIP>().expect("a strip");
                    // SAFETY: eight floats are 32 bytes.
                    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), _mm256_cvtepi32_ps(sums)) };
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use crate::splat::records::{Record, SLOTS, STRIDE, Splat, Tables};
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_all(
        records: &mut [Record<i32>],
        voxels: (&[Splat], &[[f32; 4]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        match tables.across[0].len {
            4 => all::<4>(records, voxels, slot, tables),
            5 => all::<5>(records, voxels, slot, tables),
            6 => all::<6>(records, voxels, slot, tables),
            7 => all::<7>(records, voxels, slot, tables),
            8 => all::<8>(records, voxels, slot, tables),
            9 => all::<9>(records, voxels, slot, tables),
            13 => all::<13>(records, voxels, slot, tables),
            14 => all::<14>(records, voxels, slot, tables),
            _ => super::avx2::splat_all(records, voxels, slot, tables),
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn all<const N: usize>(
        records: &mut [Record<i32>],
        (voxels, payloads): (&[Splat], &[[f32; 4]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        // Which of a row's weights each of the 16 lanes of four slots takes: that of its slot.
        let turn = |from: usize| {
            let mut turn = [0i32; 16];
            for (lane, turn) in turn.iter_mut().enumerate() {
                *turn = ((from + lane / 4 + SLOTS - slot) % SLOTS) as i32;
            }
            turn
        };
        // SAFETY: 64 bytes each.
        let turns = unsafe {
            [
                _mm512_loadu_si512(turn(0).as_ptr().cast()),
                _mm512_loadu_si512(turn(4).as_ptr().cast()),
            ]
        };
        let present = (1u16 << tables.deep.len.min(SLOTS)).wrapping_sub(1);
        let (half, zero) = (_mm512_set1_ps(0.5), _mm512_setzero_ps());
        for (v, payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let x = x.first_chunk::<N>().expect("a row of the table");
            // SAFETY: lanes that are not present are not read; four floats are 16 bytes.
            let (z, payload) = unsafe {
                (_mm512_maskz_loadu_ps(present, z.as_ptr()), _mm_loadu_ps(payload.as_ptr()))
            };
            let payload = _mm512_broadcast_f32x4(payload);
            let cut =
                |turn| _mm512_max_ps(_mm512_mul_ps(payload, _mm512_permutexvar_ps(turn, z)), zero);
            let (low, high) = (cut(turns[0]), cut(turns[1]));
            let mut wx = [zero; N];
            for i in 0..N {
                wx[i] = _mm512_set1_ps(x[i].get());
            }
            for (row, wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
                let wy = _mm512_set1_ps(wy.get());
                let (low, high) = (_mm512_mul_ps(low, wy), _mm512_mul_ps(high, wy));
                let row = row.first_chunk_mut::<N>().expect("a footprint inside the part");
                for i in 0..N {
                    let at: *mut __m512i = std::ptr::from_mut(&mut row[i]).cast();
                    let [l, h] = [
                        _mm512_cvttps_epi32(_mm512_add_ps(_mm512_mul_ps(low, wx[i]), half)),
                        _mm512_cvttps_epi32(_mm512_add_ps(_mm512_mul_ps(high, wx[i]), half)),
                    ];
                    // SAFETY: a record is 128 bytes, aligned to 64, and borrowed for us alone.
                    unsafe {
                        _mm512_store_si512(at, _mm512_add_epi32(_mm512_load_si512(at), l));
                        let at = at.add(1);
                        _mm512_store_si512(at, _mm512_add_epi32(_mm512_load_si512(at), h));
                    }
                }
            }
        }
    }
}
