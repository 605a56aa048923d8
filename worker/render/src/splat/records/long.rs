//! Records of 32-bit sums in lanes.
//!
//! What is added is `(section * wy) * wx + 1/2`, cut off, as the plain loop has it, but without its
//! clamps: a payload times weights stays below 2^31 (`bounds::raw_per_payload`), and what would not
//! turns into i32's smallest number here and its largest there.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use crate::sheet::{LANES, Row};
    use crate::splat::Tap;
    use crate::splat::records::{MOST, Record, STRIDE, STRIP, Splat, Strip, Tables};
    use std::arch::x86_64::*;

    /// Registers of a record at most: eight sums each.
    const PARTS: usize = MOST / 2;

    /// The section of a voxel of C channels, eight sums a register.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn sections<const C: usize, const N: usize>(
        payload: &[f32; C],
        z: &[f32],
        slot: usize,
    ) -> [__m256; PARTS] {
        const { assert!(C == 2 || C == 4) };
        let mut wz = [[0f32; C]; N];
        for (i, &w) in z.iter().enumerate() {
            wz[(slot + i) % N] = [w; C];
        }
        let payload: [f32; 8] = std::array::from_fn(|i| payload[i % C]);
        // SAFETY: eight floats are 32 bytes.
        let payload = unsafe { _mm256_loadu_ps(payload.as_ptr()) };
        let mut sections = [_mm256_setzero_ps(); PARTS];
        let wz = wz.as_flattened();
        for i in 0..N * C / 8 {
            // SAFETY: eight floats are 32 bytes. Negative sections there are none.
            let w = unsafe { _mm256_loadu_ps(wz[8 * i..8 * i + 8].as_ptr()) };
            sections[i] = _mm256_max_ps(_mm256_mul_ps(payload, w), _mm256_setzero_ps());
        }
        sections
    }

    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_all<const C: usize, const N: usize>(
        records: &mut [[[i32; C]; N]],
        (voxels, payloads): (&[Splat], &[[f32; C]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        let half = _mm256_set1_ps(0.5);
        for (v, payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let sections = sections::<C, N>(payload, z, slot);
            for (row, wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
                let wy = _mm256_set1_ps(wy.get());
                let mut rows = sections;
                for row in &mut rows[..N * C / 8] {
                    *row = _mm256_mul_ps(*row, wy);
                }
                for (record, wx) in row[..x.len()].iter_mut().zip(x) {
                    let wx = _mm256_set1_ps(Tap::get(*wx));
                    let at: *mut __m256i = record.as_mut_ptr().cast();
                    for (i, row) in rows[..N * C / 8].iter().enumerate() {
                        let add = _mm256_add_ps(_mm256_mul_ps(*row, wx), half);
                        // SAFETY: eight sums are 32 bytes, and borrowed for us alone.
                        unsafe {
                            let sums = _mm256_loadu_si256(at.add(i));
                            let sums = _mm256_add_epi32(sums, _mm256_cvttps_epi32(add));
                            _mm256_storeu_si256(at.add(i), sums);
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
    pub(in super::super) fn take<const N: usize>(
        (records, before): (&mut [Record<i32, N>], &mut [[i32; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        const { assert!(LANES == 2 * STRIP) };
        let behind = (slot + 1) % N;
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
                let pair = [&records[i + 4], &records[i]];
                sheets[1][i] = _mm256_set_m128i(load(&pair[0][slot]), load(&pair[1][slot]));
                sheets[2][i] = _mm256_set_m128i(load(&pair[0][behind]), load(&pair[1][behind]));
            }
            if !(twice && half == 0) {
                for (before, record) in before.iter_mut().zip(records) {
                    *before = record[slot];
                    record[slot] = [0; 4];
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

    /// Four pixels of extinction and grey.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn four(pixel: impl Fn(usize) -> [i32; 2]) -> __m256i {
        let wide = |i: usize| bytemuck::cast::<[i32; 2], i64>(pixel(i));
        _mm256_setr_epi64x(wide(0), wide(1), wide(2), wide(3))
    }

    /// Extinction and grey of eight pixels.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn parted(low: __m256i, high: __m256i) -> [__m256; 2] {
        let (low, high) = (_mm256_castsi256_ps(low), _mm256_castsi256_ps(high));
        // Pixels 0, 1, 4, 5 and 2, 3, 6, 7: put in order by pairs.
        let of = |sums: __m256| {
            let pairs = _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_castps_si256(sums));
            _mm256_cvtepi32_ps(pairs)
        };
        [
            of(_mm256_shuffle_ps::<0b10_00_10_00>(low, high)),
            of(_mm256_shuffle_ps::<0b11_01_11_01>(low, high)),
        ]
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn take_grey<const N: usize>(
        (records, before): (&mut [[[i32; 2]; N]], &mut [[i32; 2]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        const { assert!(LANES == 2 * STRIP) };
        let behind = (slot + 1) % N;
        let twice = strips[0].pixel == strips[1].pixel;
        for (half, strip) in strips.iter().enumerate() {
            let lane = half * STRIP;
            row.a[lane..lane + STRIP].copy_from_slice(&a[strip.pixel..strip.pixel + STRIP]);
            let records = records[strip.record..].first_chunk_mut::<STRIP>().expect("a strip");
            let before = before[strip.pixel..].first_chunk_mut::<STRIP>().expect("a strip");
            let sheets = [
                parted(four(|i| before[i]), four(|i| before[i + 4])),
                parted(four(|i| records[i][slot]), four(|i| records[i + 4][slot])),
                parted(four(|i| records[i][behind]), four(|i| records[i + 4][behind])),
            ];
            if !(twice && half == 0) {
                for (before, record) in before.iter_mut().zip(records) {
                    *before = record[slot];
                    record[slot] = [0; 2];
                }
            }
            let to = [&mut row.before, &mut row.here, &mut row.behind];
            for (to, sheet) in to.into_iter().zip(sheets) {
                for (to, sums) in to.iter_mut().zip(sheet) {
                    let to = to[lane..].first_chunk_mut::<STRIP>().expect("a strip");
                    // SAFETY: eight floats are 32 bytes.
                    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), sums) };
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use crate::splat::records::{MOST, STRIDE, Splat, Tables};
    use std::arch::x86_64::*;

    /// Registers of a record at most: sixteen sums each.
    const PARTS: usize = MOST / 4;

    type At<'a, const C: usize, const N: usize> =
        (&'a mut [[[i32; C]; N]], (&'a [Splat], &'a [[f32; C]]), usize, &'a Tables<'a, i32>);

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_all<const C: usize, const N: usize>(
        records: &mut [[[i32; C]; N]],
        voxels: (&[Splat], &[[f32; C]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        let at = (records, voxels, slot, tables);
        match tables.across[0].len {
            // Half a register.
            _ if N * C < 16 => {
                let (records, voxels, slot, tables) = at;
                super::avx2::splat_all(records, voxels, slot, tables);
            }
            4 => all::<4, C, N>(at),
            5 => all::<5, C, N>(at),
            6 => all::<6, C, N>(at),
            7 => all::<7, C, N>(at),
            8 => all::<8, C, N>(at),
            9 => all::<9, C, N>(at),
            13 => all::<13, C, N>(at),
            14 => all::<14, C, N>(at),
            _ => {
                let (records, voxels, slot, tables) = at;
                super::avx2::splat_all(records, voxels, slot, tables);
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn all<const WIDE: usize, const C: usize, const N: usize>(
        (records, (voxels, payloads), slot, tables): At<'_, C, N>,
    ) {
        // Which of a row's weights each of the 16 lanes takes: that of its slot.
        let turn = |part: usize| {
            let mut turn = [0i32; 16];
            for (lane, turn) in turn.iter_mut().enumerate() {
                *turn = ((16 / C * part + lane / C + 2 * N - slot) % N) as i32;
            }
            // SAFETY: 64 bytes.
            unsafe { _mm512_loadu_si512(turn.as_ptr().cast()) }
        };
        let mut turns = [_mm512_setzero_si512(); PARTS];
        for (part, to) in turns[..N * C / 16].iter_mut().enumerate() {
            *to = turn(part);
        }
        let present = (1u16 << tables.deep.len.min(N)).wrapping_sub(1);
        let (half, zero) = (_mm512_set1_ps(0.5), _mm512_setzero_ps());
        for (v, payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let x = x.first_chunk::<WIDE>().expect("a row of the table");
            let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
            // SAFETY: lanes that are not present are not read; four floats are 16 bytes.
            let (z, payload) = unsafe {
                (_mm512_maskz_loadu_ps(present, z.as_ptr()), _mm_loadu_ps(four.as_ptr()))
            };
            let payload = _mm512_broadcast_f32x4(payload);
            let mut sections = [zero; PARTS];
            for (section, turn) in sections[..N * C / 16].iter_mut().zip(turns) {
                let wz = _mm512_permutexvar_ps(turn, z);
                *section = _mm512_max_ps(_mm512_mul_ps(payload, wz), zero);
            }
            let mut wx = [zero; WIDE];
            for i in 0..WIDE {
                wx[i] = _mm512_set1_ps(x[i].get());
            }
            for (row, wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
                let wy = _mm512_set1_ps(wy.get());
                let mut rows = sections;
                for row in &mut rows[..N * C / 16] {
                    *row = _mm512_mul_ps(*row, wy);
                }
                let row = row.first_chunk_mut::<WIDE>().expect("a footprint inside the part");
                for i in 0..WIDE {
                    let at: *mut __m512i = row[i].as_mut_ptr().cast();
                    for (part, row) in rows[..N * C / 16].iter().enumerate() {
                        let add = _mm512_add_ps(_mm512_mul_ps(*row, wx[i]), half);
                        // SAFETY: sixteen sums are 64 bytes, and borrowed for us alone.
                        unsafe {
                            let at = at.add(part);
                            let sums = _mm512_loadu_si512(at);
                            let sums = _mm512_add_epi32(sums, _mm512_cvttps_epi32(add));
                            _mm512_storeu_si512(at, sums);
                        }
                    }
                }
            }
        }
    }
}
