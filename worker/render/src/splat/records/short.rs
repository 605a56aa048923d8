//! Records of 16-bit sums in lanes.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use crate::sheet::{LANES, Row};
    use crate::splat::records::{
        Across, BySlot, Record, SLOTS, STRIDE, STRIP, Splat, Strip, Tables,
    };
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_all(
        records: &mut [Record<i16>],
        (voxels, payloads): (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        for (v, &payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            // Each slot's weight four times, beside the payload twice.
            let mut wz = [[0i16; 4]; SLOTS];
            for (i, &w) in z.iter().enumerate() {
                wz[(slot + i) % SLOTS] = [w; 4];
            }
            let payload = _mm256_set1_epi64x(payload as i64);
            // SAFETY: 64 bytes, two loads of 32.
            let wz = unsafe {
                let at: *const __m256i = wz.as_ptr().cast();
                [_mm256_loadu_si256(at), _mm256_loadu_si256(at.add(1))]
            };
            let sections =
                [_mm256_mulhrs_epi16(payload, wz[0]), _mm256_mulhrs_epi16(payload, wz[1])];
            let at = v.at();
            match x.len() {
                4 => columns::<4>(records, at, x, y, sections),
                5 => columns::<5>(records, at, x, y, sections),
                6 => columns::<6>(records, at, x, y, sections),
                7 => columns::<7>(records, at, x, y, sections),
                8 => columns::<8>(records, at, x, y, sections),
                _ => {
                    // Columns in groups whose weights stay in registers.
                    let (fours, rest) = x.as_chunks::<4>();
                    for (i, four) in fours.iter().enumerate() {
                        columns::<4>(records, at + 4 * i, four, y, sections);
                    }
                    for (i, one) in rest.iter().enumerate() {
                        columns::<1>(records, at + 4 * fours.len() + i, &[*one], y, sections);
                    }
                }
            }
        }
    }

    /// Each slot's weight for its four channels: slots 0 to 3, and 4 to 7.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn spread(weights: &BySlot<i16>) -> [__m256i; 2] {
        // SAFETY: eight weights are 16 bytes.
        let weights = unsafe { _mm_loadu_si128(weights.as_ptr().cast()) };
        let weights = _mm256_broadcastsi128_si256(weights);
        let low = _mm256_setr_epi8(
            0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 4, 5, 4, 5, 4, 5, 4, 5, 6, 7, 6, 7, 6,
            7, 6, 7,
        );
        let high = _mm256_add_epi8(low, _mm256_set1_epi8(8));
        [_mm256_shuffle_epi8(weights, low), _mm256_shuffle_epi8(weights, high)]
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn splat_deep(
        records: &mut [Record<i16>],
        at: usize,
        (x, y): Across<'_, i16>,
        payload: u64,
        z: &BySlot<i16>,
    ) {
        let payload = _mm256_set1_epi64x(payload as i64);
        let [low, high] = spread(z);
        let section = [_mm256_mulhrs_epi16(payload, low), _mm256_mulhrs_epi16(payload, high)];
        for (row, wy) in records[at..].chunks_mut(STRIDE).zip(y) {
            let [low, high] = spread(wy);
            let low = _mm256_mulhrs_epi16(section[0], low);
            let high = _mm256_mulhrs_epi16(section[1], high);
            for (record, wx) in row[..x.len()].iter_mut().zip(x) {
                let wx = spread(wx);
                let at: *mut __m256i = std::ptr::from_mut(record).cast();
                // SAFETY: a record is 64 bytes, aligned to 64, and borrowed for us alone.
                unsafe {
                    let [l, h] = [_mm256_load_si256(at), _mm256_load_si256(at.add(1))];
                    _mm256_store_si256(at, _mm256_adds_epi16(l, _mm256_mulhrs_epi16(low, wx[0])));
                    let h = _mm256_adds_epi16(h, _mm256_mulhrs_epi16(high, wx[1]));
                    _mm256_store_si256(at.add(1), h);
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn columns<const N: usize>(
        records: &mut [Record<i16>],
        at: usize,
        x: &[i16],
        y: &[i16],
        [low, high]: [__m256i; 2],
    ) {
        let mut wx = [_mm256_setzero_si256(); N];
        for i in 0..N {
            wx[i] = _mm256_set1_epi16(x[i]);
        }
        for (j, &wy) in y.iter().enumerate() {
            let wy = _mm256_set1_epi16(wy);
            let (low, high) = (_mm256_mulhrs_epi16(low, wy), _mm256_mulhrs_epi16(high, wy));
            let row = at + j * STRIDE;
            let row = &mut records[row..row + N];
            for i in 0..N {
                let at: *mut __m256i = std::ptr::from_mut(&mut row[i]).cast();
                // SAFETY: a record is 64 bytes, aligned to 64, and borrowed for us alone.
                unsafe {
                    let [l, h] = [_mm256_load_si256(at), _mm256_load_si256(at.add(1))];
                    _mm256_store_si256(at, _mm256_adds_epi16(l, _mm256_mulhrs_epi16(low, wx[i])));
                    let h = _mm256_adds_epi16(h, _mm256_mulhrs_epi16(high, wx[i]));
                    _mm256_store_si256(at.add(1), h);
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn take(
        sums: (&mut [Record<i16>], &mut [[i16; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        let sheets = turned(sums, strips, slot);
        for (to, sheet) in [&mut row.before, &mut row.here, &mut row.behind].into_iter().zip(sheets)
        {
            for (to, sums) in to.iter_mut().zip(sheet) {
                let halves = [_mm256_castsi256_si128(sums), _mm256_extracti128_si256::<1>(sums)];
                for (to, half) in to.as_chunks_mut::<8>().0.iter_mut().zip(halves) {
                    let floats = _mm256_cvtepi32_ps(_mm256_cvtepi16_epi32(half));
                    // SAFETY: eight floats are 32 bytes.
                    unsafe { _mm256_storeu_ps(to.as_mut_ptr(), floats) };
                }
            }
        }
        for (to, strip) in row.a.as_chunks_mut::<8>().0.iter_mut().zip(strips) {
            *to = *a[strip.pixel..].first_chunk().expect("a strip");
        }
    }

    /// Sums of two strips in the sheet before, in that of `slot` and in the one behind, channel by
    /// channel: sixteen pixels a register. Leaves what [`super::take`] says.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn turned(
        (records, before): (&mut [Record<i16>], &mut [[i16; 4]]),
        [a, b]: [Strip; 2],
        slot: usize,
    ) -> [[__m256i; 4]; 3] {
        const { assert!(LANES == 2 * STRIP) };
        let records_a = &records[a.record..a.record + STRIP];
        let records_b = &records[b.record..b.record + STRIP];
        // Slots k and k+1 of pixel i, side by side, strip b above strip a.
        let behind = (slot + 1) % SLOTS;
        let one = |record: &Record<i16>| -> __m128i {
            // SAFETY: four sums are 8 bytes.
            let sums = |slot: usize| unsafe { _mm_loadl_epi64(record.0[slot].as_ptr().cast()) };
            _mm_unpacklo_epi64(sums(slot), sums(behind))
        };
        let mut here = [_mm256_setzero_si256(); STRIP];
        for i in 0..STRIP {
            here[i] = _mm256_set_m128i(one(&records_b[i]), one(&records_a[i]));
        }
        // The sheet before is eight pixels of four sums: two pixels a register half.
        let two = |s: &Strip| -> [__m128i; 4] {
            let pixels = before[s.pixel..].first_chunk::<STRIP>().expect("a strip");
            // SAFETY: eight pixels are four times 16 bytes.
            [0, 1, 2, 3]
                .map(|i| unsafe { _mm_loadu_si128(pixels.as_ptr().cast::<__m128i>().add(i)) })
        };
        let (was_a, was_b) = (two(&a), two(&b));
        let mut was = [_mm256_setzero_si256(); 4];
        let mut now = [_mm256_setzero_si256(); 4];
        for i in 0..4 {
            was[i] = _mm256_set_m128i(was_b[i], was_a[i]);
            now[i] = _mm256_unpacklo_epi64(here[2 * i], here[2 * i + 1]);
        }
        for (strip, high) in [(a, false), (b, true)] {
            let to = before[strip.pixel..].first_chunk_mut::<STRIP>().expect("a strip");
            for i in 0..4 {
                let half = _mm256_castsi256_si128(now[i]);
                let half = if high { _mm256_extracti128_si256::<1>(now[i]) } else { half };
                // SAFETY: eight pixels are four times 16 bytes.
                unsafe { _mm_storeu_si128(to.as_mut_ptr().cast::<__m128i>().add(i), half) };
            }
            for record in &mut records[strip.record..strip.record + STRIP] {
                record.0[slot] = [0; 4];
            }
        }
        // Eight by eight, turned over: pairs, quadruples, all eight.
        let pairs = |o: usize| {
            [
                _mm256_unpacklo_epi16(here[o], here[o + 1]),
                _mm256_unpacklo_epi16(here[o + 2], here[o + 3]),
                _mm256_unpackhi_epi16(here[o], here[o + 1]),
                _mm256_unpackhi_epi16(here[o + 2], here[o + 3]),
            ]
        };
        let (p, q) = (pairs(0), pairs(4));
        let eight = |o: usize| {
            let low =
                [_mm256_unpacklo_epi32(p[o], p[o + 1]), _mm256_unpackhi_epi32(p[o], p[o + 1])];
            let high =
                [_mm256_unpacklo_epi32(q[o], q[o + 1]), _mm256_unpackhi_epi32(q[o], q[o + 1])];
            [
                _mm256_unpacklo_epi64(low[0], high[0]),
                _mm256_unpackhi_epi64(low[0], high[0]),
                _mm256_unpacklo_epi64(low[1], high[1]),
                _mm256_unpackhi_epi64(low[1], high[1]),
            ]
        };
        // Two pixels a register: 0 1, 2 3, 4 5, 6 7; first 0 2 and 1 3, 4 6 and 5 7.
        let even = [_mm256_unpacklo_epi16(was[0], was[1]), _mm256_unpacklo_epi16(was[2], was[3])];
        let odd = [_mm256_unpackhi_epi16(was[0], was[1]), _mm256_unpackhi_epi16(was[2], was[3])];
        let p = [_mm256_unpacklo_epi16(even[0], odd[0]), _mm256_unpackhi_epi16(even[0], odd[0])];
        let q = [_mm256_unpacklo_epi16(even[1], odd[1]), _mm256_unpackhi_epi16(even[1], odd[1])];
        let was = [
            _mm256_unpacklo_epi64(p[0], q[0]),
            _mm256_unpackhi_epi64(p[0], q[0]),
            _mm256_unpacklo_epi64(p[1], q[1]),
            _mm256_unpackhi_epi64(p[1], q[1]),
        ];
        [was, eight(0), eight(2)]
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use super::avx2::turned;
    use crate::sheet::Row;
    use crate::splat::records::{Across, BySlot, Record, SLOTS, STRIDE, Splat, Strip, Tables};
    use std::arch::x86_64::*;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_all(
        records: &mut [Record<i16>],
        voxels: (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        // Which of a row's weights each of the 32 lanes takes: that of its slot.
        let mut turn = [0i16; 4 * SLOTS];
        for (lane, from) in turn.iter_mut().enumerate() {
            *from = ((lane / 4 + SLOTS - slot) % SLOTS) as i16;
        }
        // SAFETY: 64 bytes.
        let turn = unsafe { _mm512_loadu_si512(turn.as_ptr().cast()) };
        let present = (1u32 << tables.deep.len) - 1;
        match tables.across[0].len {
            4 => all::<4>(records, voxels, tables, turn, present),
            5 => all::<5>(records, voxels, tables, turn, present),
            6 => all::<6>(records, voxels, tables, turn, present),
            7 => all::<7>(records, voxels, tables, turn, present),
            8 => all::<8>(records, voxels, tables, turn, present),
            9 => all::<9>(records, voxels, tables, turn, present),
            10 => all::<10>(records, voxels, tables, turn, present),
            11 => all::<11>(records, voxels, tables, turn, present),
            12 => all::<12>(records, voxels, tables, turn, present),
            13 => all::<13>(records, voxels, tables, turn, present),
            14 => all::<14>(records, voxels, tables, turn, present),
            // A footprint of ten pixels a voxel and more: loops of AVX2.
            _ => super::avx2::splat_all(records, voxels, slot, tables),
        }
    }

    /// Each slot's weight for its four channels.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread(weights: &BySlot<i16>) -> __m512i {
        // SAFETY: eight weights are 16 bytes.
        let weights = unsafe { _mm_loadu_si128(weights.as_ptr().cast()) };
        // Words 0 0 0 0 1 1 1 1 and so on, from the lowest up.
        let turn = _mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0);
        let turn = _mm512_mullo_epi64(turn, _mm512_set1_epi64(0x0001_0001_0001_0001));
        _mm512_permutexvar_epi16(turn, _mm512_castsi128_si512(weights))
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn splat_deep(
        records: &mut [Record<i16>],
        at: usize,
        (x, y): Across<'_, i16>,
        payload: u64,
        z: &BySlot<i16>,
    ) {
        let section = _mm512_mulhrs_epi16(_mm512_set1_epi64(payload as i64), spread(z));
        // Columns in groups whose weights stay in registers.
        for (i, x) in x.chunks(8).enumerate() {
            let mut columns = [_mm512_setzero_si512(); 8];
            for (column, x) in columns.iter_mut().zip(x) {
                *column = spread(x);
            }
            for (row, wy) in records[at + 8 * i..].chunks_mut(STRIDE).zip(y) {
                let section = _mm512_mulhrs_epi16(section, spread(wy));
                for (record, wx) in row[..x.len()].iter_mut().zip(columns) {
                    let at: *mut __m512i = std::ptr::from_mut(record).cast();
                    // SAFETY: a record is 64 bytes, aligned to 64, and borrowed for us alone.
                    unsafe {
                        let add = _mm512_mulhrs_epi16(section, wx);
                        _mm512_store_si512(at, _mm512_adds_epi16(_mm512_load_si512(at), add));
                    }
                }
            }
        }
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn take(
        sums: (&mut [Record<i16>], &mut [[i16; 4]]),
        a: &[f32],
        strips: [Strip; 2],
        slot: usize,
        row: &mut Row,
    ) {
        let sheets = turned(sums, strips, slot);
        for (to, sheet) in [&mut row.before, &mut row.here, &mut row.behind].into_iter().zip(sheets)
        {
            for (to, sums) in to.iter_mut().zip(sheet) {
                let floats = _mm512_cvtepi32_ps(_mm512_cvtepi16_epi32(sums));
                // SAFETY: sixteen floats are 64 bytes. Two stores of 32 would have whoever loads
                // them wait.
                unsafe { _mm512_storeu_ps(to.as_mut_ptr(), floats) };
            }
        }
        let half = |s: Strip| -> __m256 {
            let a = a[s.pixel..].first_chunk::<8>().expect("a strip");
            // SAFETY: eight floats are 32 bytes.
            unsafe { _mm256_loadu_ps(a.as_ptr()) }
        };
        let both = _mm512_castps256_ps512(half(strips[0]));
        let both = _mm512_insertf32x8::<1>(both, half(strips[1]));
        // SAFETY: sixteen floats are 64 bytes.
        unsafe { _mm512_storeu_ps(row.a.as_mut_ptr(), both) };
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn all<const N: usize>(
        records: &mut [Record<i16>],
        (voxels, payloads): (&[Splat], &[u64]),
        tables: &Tables<'_, i16>,
        turn: __m512i,
        present: u32,
    ) {
        for (v, &payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let x = x.first_chunk::<N>().expect("a row of the table");
            // SAFETY: lanes that are not present are not read.
            let z = unsafe { _mm512_maskz_loadu_epi16(present, z.as_ptr()) };
            let wz = _mm512_permutexvar_epi16(turn, z);
            let section = _mm512_mulhrs_epi16(_mm512_set1_epi64(payload as i64), wz);
            let mut wx = [_mm512_setzero_si512(); N];
            for i in 0..N {
                wx[i] = _mm512_set1_epi16(x[i]);
            }
            let rows = records[v.at()..].chunks_mut(STRIDE);
            for (row, &wy) in rows.zip(y) {
                let section = _mm512_mulhrs_epi16(section, _mm512_set1_epi16(wy));
                let row = row.first_chunk_mut::<N>().expect("a footprint inside the part");
                for i in 0..N {
                    let at: *mut __m512i = std::ptr::from_mut(&mut row[i]).cast();
                    // SAFETY: a record is 64 bytes, aligned to 64, and borrowed for us alone.
                    unsafe {
                        let sums = _mm512_load_si512(at);
                        let add = _mm512_mulhrs_epi16(section, wx[i]);
                        _mm512_store_si512(at, _mm512_adds_epi16(sums, add));
                    }
                }
            }
        }
    }
}
