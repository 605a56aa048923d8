//! Records of 32-bit sums in lanes.
//!
//! A voxel adds `(section * wy) * wx + 1/2`, cut off, as in the plain loop, but without its clamps:
//! a payload times weights stays below 2^31 (`bounds::i32_units_per_payload`), and what would not
//! turns into i32's smallest number here and its largest there.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use crate::kernels::lanes::{Eight, Lanes as _};
    use crate::kernels::pixel_records::sheet_offsets::lines::{self, Lines};
    use crate::kernels::pixel_records::sheet_offsets::{
        self, Apart, ApartAt, BATCH, Layers, Woven,
    };
    use crate::kernels::pixel_records::{
        Across, BySlot, MOST, Record, Recorded as _, RowAt, STRIDE, Splat, Tables, shear,
    };
    use crate::kernels::{Simd, Tap};
    use std::arch::x86_64::*;

    /// Registers of a record at most: eight sums each.
    pub(in super::super) const PARTS: usize = MOST / 2;

    /// Returns which of a row's weights in depth each of the eight lanes of a register takes: that
    /// of its slot.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn turns<const C: usize, const N: usize>(slot: usize) -> [__m256i; PARTS] {
        const { assert!(C == 2 || C == 4) };
        let mut turns = [_mm256_setzero_si256(); PARTS];
        for (part, turn) in turns[..N * C / 8].iter_mut().enumerate() {
            let lanes: [i32; 8] =
                std::array::from_fn(|lane| (((8 * part + lane) / C + 2 * N - slot) % N) as i32);
            // SAFETY: eight numbers are 32 bytes.
            *turn = unsafe { _mm256_loadu_si256(lanes.as_ptr().cast()) };
        }
        turns
    }

    /// Arguments of `splat_all`, in one.
    pub(super) type At<'a, const C: usize, const N: usize> =
        (&'a mut [[[i32; C]; N]], (&'a [Splat], &'a [[f32; C]]), usize, &'a Tables<'a, i32>);

    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_all<const C: usize, const N: usize>(
        records: &mut [[[i32; C]; N]],
        voxels: (&[Splat], &[[f32; C]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        let at = (records, voxels, slot, tables);
        by_width!(tables.across[0].len, all[C, N], at, all::<0, C, N>(at))
    }

    /// Footprints of `WIDE` columns, or of any number where that is 0.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn all<const WIDE: usize, const C: usize, const N: usize>(
        (records, (voxels, payloads), slot, tables): At<'_, C, N>,
    ) {
        let zero = _mm256_setzero_ps();
        let turns = turns::<C, N>(slot);
        let present: [i32; 8] =
            std::array::from_fn(|i| if i < tables.deep.len.min(N) { -1 } else { 0 });
        // SAFETY: eight numbers are 32 bytes.
        let present = unsafe { _mm256_loadu_si256(present.as_ptr().cast()) };
        for (v, payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let four: [f32; 4] = std::array::from_fn(|i| payload[i % C]);
            // SAFETY: lanes that are not present are not read; four floats are 16 bytes.
            let (z, payload) =
                unsafe { (_mm256_maskload_ps(z.as_ptr(), present), _mm_loadu_ps(four.as_ptr())) };
            let payload = _mm256_set_m128(payload, payload);
            let mut sections = [zero; PARTS];
            for (section, turn) in sections[..N * C / 8].iter_mut().zip(turns) {
                let wz = _mm256_permutevar8x32_ps(z, turn);
                // Negative sections there are none.
                *section = _mm256_max_ps(_mm256_mul_ps(payload, wz), zero);
            }
            for (row, wy) in records[v.at()..].chunks_mut(STRIDE).zip(y) {
                let wy = _mm256_set1_ps(wy.get());
                let mut rows = sections;
                for row in &mut rows[..N * C / 8] {
                    *row = _mm256_mul_ps(*row, wy);
                }
                let add = |record: &mut [[i32; C]; N], wx: &Tap| {
                    let wx = _mm256_set1_ps(wx.get());
                    let at: *mut __m256i = record.as_mut_ptr().cast();
                    for (i, row) in rows[..N * C / 8].iter().enumerate() {
                        let add = _mm256_mul_ps(*row, wx);
                        // SAFETY: eight sums are 32 bytes, and borrowed for us alone.
                        unsafe {
                            let sums = _mm256_loadu_si256(at.add(i));
                            let sums = _mm256_add_epi32(sums, _mm256_cvtps_epi32(add));
                            _mm256_storeu_si256(at.add(i), sums);
                        }
                    }
                };
                if WIDE == 0 {
                    row[..x.len()].iter_mut().zip(x).for_each(|(record, wx)| add(record, wx));
                } else {
                    let row = row.first_chunk_mut::<WIDE>().expect("a footprint inside the part");
                    let x = x.first_chunk::<WIDE>().expect("a row of the table");
                    for i in 0..WIDE {
                        add(&mut row[i], &x[i]);
                    }
                }
            }
        }
    }

    /// Four or eight rows and eight columns at a time.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn weave<const N: usize>(
        rows: [RowAt<'_, Tap>; N],
        wide: usize,
        to: &mut [BySlot<Tap, N>],
    ) {
        let eights = wide.div_ceil(8);
        if !(N == 4 || N == 8) || to.len() < 8 * eights {
            return super::super::weave(rows, wide, to);
        }
        for (eight, to) in to.chunks_exact_mut(8).take(eights).enumerate() {
            let first = 8 * eight as i32;
            let columns = _mm256_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7);
            let columns = _mm256_add_epi32(columns, _mm256_set1_epi32(first));
            let mut lines = [_mm256_setzero_ps(); 8];
            for (line, at) in lines.iter_mut().zip(rows) {
                let row = at.row();
                let (begin, end) = (at.column, at.column + row.len() as i32);
                let behind = _mm256_cmpgt_epi32(columns, _mm256_set1_epi32(begin - 1));
                let before = _mm256_cmpgt_epi32(_mm256_set1_epi32(end), columns);
                let from = row.as_ptr().wrapping_offset(first as isize - begin as isize);
                // SAFETY: a tap is a float; lanes that are not present are not read, and those that
                // are lie in the row.
                *line =
                    unsafe { _mm256_maskload_ps(from.cast(), _mm256_and_si256(behind, before)) };
            }
            let to = to.as_flattened_mut();
            if N == 4 {
                by_column([0, 1, 2, 3].map(|i| lines[i]), to);
            } else {
                eight_by_column(lines, to);
            }
        }
    }

    /// Eight rows of eight columns, written column by column.
    ///
    /// # Panics
    /// If there is not room for as many.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn eight_by_column(lines: [__m256; 8], to: &mut [Tap]) {
        let [front, back] = [0, 4].map(|from| turned([0, 1, 2, 3].map(|i| lines[from + i])));
        let (low, high) = to[..64].as_chunks_mut::<8>().0.split_at_mut(4);
        for i in 0..4 {
            let columns = [
                _mm256_permute2f128_ps::<0x20>(front[i], back[i]),
                _mm256_permute2f128_ps::<0x31>(front[i], back[i]),
            ];
            // SAFETY: eight taps are eight floats, 32 bytes; no weight is negative.
            unsafe {
                _mm256_storeu_ps(low[i].as_mut_ptr().cast(), columns[0]);
                _mm256_storeu_ps(high[i].as_mut_ptr().cast(), columns[1]);
            }
        }
    }

    /// Four rows of eight columns, written column by column.
    ///
    /// # Panics
    /// If there is not room for as many.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn by_column(lines: [__m256; 4], to: &mut [Tap]) {
        let pairs = turned(lines);
        let (low, high) = to[..32].as_chunks_mut::<4>().0.split_at_mut(4);
        for (i, pair) in pairs.into_iter().enumerate() {
            // SAFETY: four taps are four floats, 16 bytes; no weight is negative.
            unsafe {
                _mm_storeu_ps(low[i].as_mut_ptr().cast(), _mm256_castps256_ps128(pair));
                _mm_storeu_ps(high[i].as_mut_ptr().cast(), _mm256_extractf128_ps::<1>(pair));
            }
        }
    }

    /// Columns 0 and 4 of four rows, 1 and 5, and so on.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn turned(lines: [__m256; 4]) -> [__m256; 4] {
        let low = [_mm256_unpacklo_ps(lines[0], lines[1]), _mm256_unpacklo_ps(lines[2], lines[3])];
        let high = [_mm256_unpackhi_ps(lines[0], lines[1]), _mm256_unpackhi_ps(lines[2], lines[3])];
        [
            _mm256_shuffle_ps::<0b01_00_01_00>(low[0], low[1]),
            _mm256_shuffle_ps::<0b11_10_11_10>(low[0], low[1]),
            _mm256_shuffle_ps::<0b01_00_01_00>(high[0], high[1]),
            _mm256_shuffle_ps::<0b11_10_11_10>(high[0], high[1]),
        ]
    }

    /// Each slot's weight for its four channels: two slots a register.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn spread<const N: usize>(weights: &[f32; N]) -> [__m256; PARTS] {
        let mut spread = [_mm256_setzero_ps(); PARTS];
        if N == 4 {
            // SAFETY: four floats are 16 bytes.
            let weights = unsafe { _mm_loadu_ps(weights.as_ptr()) };
            let weights = _mm256_set_m128(weights, weights);
            spread[0] = _mm256_permutevar_ps(weights, _mm256_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1));
            spread[1] = _mm256_permutevar_ps(weights, _mm256_setr_epi32(2, 2, 2, 2, 3, 3, 3, 3));
        } else {
            for (two, spread) in weights.as_chunks::<2>().0.iter().zip(&mut spread) {
                *spread = _mm256_set_m128(_mm_set1_ps(two[1]), _mm_set1_ps(two[0]));
            }
        }
        spread
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn splat_deep<const N: usize>(
        records: &mut [Record<i32, N>],
        at: usize,
        (x, y): Across<'_, Tap, N>,
        payload: [f32; 4],
        z: &BySlot<f32, N>,
    ) {
        let zero = _mm256_setzero_ps();
        // SAFETY: four floats are 16 bytes.
        let payload = unsafe { _mm_loadu_ps(payload.as_ptr()) };
        let payload = _mm256_set_m128(payload, payload);
        let mut sections = spread::<N>(z);
        for section in &mut sections[..N / 2] {
            // Negative sections there are none.
            *section = _mm256_max_ps(_mm256_mul_ps(payload, *section), zero);
        }
        for (row, wy) in records[at..].chunks_mut(STRIDE).zip(y) {
            let mut rows = spread::<N>(&wy.map(Tap::get));
            for (row, section) in rows[..N / 2].iter_mut().zip(sections) {
                *row = _mm256_mul_ps(section, *row);
            }
            for (record, wx) in row[..x.len()].iter_mut().zip(x) {
                let wx = spread::<N>(&wx.map(Tap::get));
                let at: *mut __m256i = record.as_mut_ptr().cast();
                for i in 0..N / 2 {
                    let add = _mm256_mul_ps(rows[i], wx[i]);
                    // SAFETY: eight sums are 32 bytes, and borrowed for us alone.
                    unsafe {
                        let sums = _mm256_loadu_si256(at.add(i));
                        let sums = _mm256_add_epi32(sums, _mm256_cvtps_epi32(add));
                        _mm256_storeu_si256(at.add(i), sums);
                    }
                }
            }
        }
    }

    /// [`sheet_offsets::splat_apart`] into 32-bit sums with AVX2.
    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        (apart, payloads): (&Apart, &[[f32; 4]]),
        layers: &Layers<'_, i32, N>,
        woven: &mut Woven<Tap, N>,
    ) {
        let kept = &apart.kept[..payloads.len()];
        if let Some(slant) = layers.slant {
            return shear::avx2::longs((records, (apart, payloads), layers, slant));
        }
        // Columns are alike in records of eight sheets.
        let four = N == 4 && !layers.alike;
        let Some(wide) = lines::widest(apart, kept, i32::step::<N>()).filter(|_| four) else {
            return sheet_offsets::splat_apart(simd, records, (apart, payloads), layers, woven);
        };
        let at = (records, (apart, payloads), layers, &mut woven.spans);
        by_window!(wide, side_by_side[N], at)
    }

    /// Weights of voxel `i` in four slots, pixel by pixel, of at least the first `n` pixels.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn line<const N: usize>(lines: &Lines<'_, Tap, N>, i: usize, n: usize, to: &mut [Tap; 64]) {
        for (eight, to) in to.as_chunks_mut::<32>().0.iter_mut().take(n.div_ceil(8)).enumerate() {
            let mut slots = [_mm256_setzero_ps(); 4];
            for (slot, line) in slots.iter_mut().enumerate() {
                let (present, from) = lines.of(slot, i);
                // SAFETY: these are the instructions. A tap is a float; lanes that are not present
                // are not read, and those that are lie in the table.
                unsafe {
                    let present = Eight::marks(present >> (8 * eight));
                    *line = _mm256_maskload_ps(from.wrapping_add(8 * eight).cast(), present);
                }
            }
            by_column(slots, to);
        }
    }

    /// Windows of `WIDE` columns.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn side_by_side<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, spans): ApartAt<'_, i32, N>,
    ) {
        let zero = _mm256_setzero_ps();
        let kept = &apart.kept[..payloads.len()];
        // SAFETY: these are the instructions.
        let [across, down] = unsafe {
            Lines::both::<Eight, _>(apart, kept, layers, spans, (WIDE, i32::step::<N>()))
        };
        let [mut columns, mut rows] = [[Tap::default(); 64]; 2];
        for (&i, payload) in kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let ([x, y], [_, high]) = apart.window(i, i32::step::<N>());
            let x = lines::inside(x, WIDE);
            let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
            let mut deep = [0.0; 4];
            for (sheet, &w) in z.iter().enumerate() {
                deep[(layers.slot + sheet) % 4] = w;
            }
            // SAFETY: four floats are 16 bytes.
            let payload = unsafe { _mm_loadu_ps(payload.as_ptr()) };
            let payload = _mm256_set_m128(payload, payload);
            let wz = spread::<4>(&deep);
            let mut sections = [zero; 2];
            for two in 0..2 {
                // Negative sections there are none.
                sections[two] = _mm256_max_ps(_mm256_mul_ps(payload, wz[two]), zero);
            }
            let mut wx = [[zero; 2]; WIDE];
            line(&across, i, WIDE, &mut columns);
            for (wx, w) in wx.iter_mut().zip(columns.as_chunks::<4>().0) {
                let [low, high, ..] = spread::<4>(&w.map(Tap::get));
                *wx = [low, high];
            }
            line(&down, i, high, &mut rows);
            let of_rows = records[y * STRIDE + x..].chunks_mut(STRIDE).zip(rows.as_chunks::<4>().0);
            for (row, wy) in of_rows.take(high) {
                let [low, high, ..] = spread::<4>(&wy.map(Tap::get));
                let of_row = [_mm256_mul_ps(sections[0], low), _mm256_mul_ps(sections[1], high)];
                let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                for c in 0..WIDE {
                    let at: *mut __m256i = row[c].as_mut_ptr().cast();
                    for two in 0..2 {
                        let add = _mm256_mul_ps(of_row[two], wx[c][two]);
                        // SAFETY: eight sums are 32 bytes, and borrowed for us alone.
                        unsafe {
                            let sums = _mm256_loadu_si256(at.add(two));
                            let sums = _mm256_add_epi32(sums, _mm256_cvtps_epi32(add));
                            _mm256_storeu_si256(at.add(two), sums);
                        }
                    }
                }
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use super::avx2::At;
    use crate::kernels::lanes::Sixteen;
    use crate::kernels::pixel_records::sheet_offsets::lines::{self, Lines};
    use crate::kernels::pixel_records::sheet_offsets::{
        self, Apart, ApartAt, BATCH, Layers, Woven,
    };
    use crate::kernels::pixel_records::{
        Across, BySlot, MOST, Record, Recorded, RowAt, STRIDE, Splat, Tables, shear,
    };
    use crate::kernels::{Simd, Tap, by_column};
    use std::arch::x86_64::*;

    /// Registers of a record at most: sixteen sums each.
    const PARTS: usize = MOST / 4;

    /// Columns whose weights stay in registers.
    const GROUP: usize = 8;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_all<const C: usize, const N: usize>(
        records: &mut [[[i32; C]; N]],
        voxels: (&[Splat], &[[f32; C]]),
        slot: usize,
        tables: &Tables<'_, i32>,
    ) {
        // Half a register.
        if N * C < 16 {
            return super::avx2::splat_all(records, voxels, slot, tables);
        }
        let at = (records, voxels, slot, tables);
        by_width!(tables.across[0].len, all[C, N], at, any_width(at))
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn any_width<const C: usize, const N: usize>((records, voxels, slot, tables): At<'_, C, N>) {
        super::avx2::splat_all(records, voxels, slot, tables);
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
        let zero = _mm512_setzero_ps();
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
                        let add = _mm512_mul_ps(*row, wx[i]);
                        // SAFETY: sixteen sums are 64 bytes, and borrowed for us alone.
                        unsafe {
                            let at = at.add(part);
                            let sums = _mm512_loadu_si512(at);
                            let sums = _mm512_add_epi32(sums, _mm512_cvtps_epi32(add));
                            _mm512_storeu_si512(at, sums);
                        }
                    }
                }
            }
        }
    }

    /// Four rows and sixteen columns at a time.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn weave<const N: usize>(
        rows: [RowAt<'_, Tap>; N],
        wide: usize,
        to: &mut [BySlot<Tap, N>],
    ) {
        if N != 4 || wide > 16 || to.len() < 16 {
            return super::avx2::weave(rows, wide, to);
        }
        let mut lines = [_mm512_setzero_si512(); 4];
        for (line, at) in lines.iter_mut().zip(rows) {
            let (present, from) = at.columns();
            // SAFETY: a tap is a float; lanes that are not present are not read, and those that are
            // lie in the row.
            *line = unsafe { _mm512_maskz_loadu_epi32(present, from.cast()) };
        }
        for (to, four) in to.chunks_exact_mut(4).zip(by_column(lines)) {
            // SAFETY: four columns of four taps are 64 bytes; no weight is negative.
            unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), four) };
        }
    }

    /// Each slot's weight for its four channels: four slots a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread<const N: usize>(weights: &[f32; N]) -> [__m512; PARTS] {
        let slot = _mm512_setr_epi32(0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3);
        let mut spread = [_mm512_setzero_ps(); PARTS];
        for (four, spread) in weights.as_chunks::<4>().0.iter().zip(&mut spread) {
            // SAFETY: four floats are 16 bytes.
            let four = unsafe { _mm_loadu_ps(four.as_ptr()) };
            *spread = _mm512_permutexvar_ps(slot, _mm512_castps128_ps512(four));
        }
        spread
    }

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn splat_deep<const N: usize>(
        records: &mut [Record<i32, N>],
        at: usize,
        (x, y): Across<'_, Tap, N>,
        payload: [f32; 4],
        z: &BySlot<f32, N>,
    ) {
        let zero = _mm512_setzero_ps();
        // SAFETY: four floats are 16 bytes.
        let payload = _mm512_broadcast_f32x4(unsafe { _mm_loadu_ps(payload.as_ptr()) });
        let mut sections = spread::<N>(z);
        for section in &mut sections[..N / 4] {
            // Negative sections there are none.
            *section = _mm512_max_ps(_mm512_mul_ps(payload, *section), zero);
        }
        // Columns in groups whose weights stay in registers.
        for (group, x) in x.chunks(GROUP).enumerate() {
            let mut columns = [[zero; PARTS]; GROUP];
            for (column, x) in columns.iter_mut().zip(x) {
                *column = spread::<N>(&x.map(Tap::get));
            }
            let columns = &columns[..x.len()];
            for (row, wy) in records[at + GROUP * group..].chunks_mut(STRIDE).zip(y) {
                let mut rows = spread::<N>(&wy.map(Tap::get));
                for (row, section) in rows[..N / 4].iter_mut().zip(sections) {
                    *row = _mm512_mul_ps(section, *row);
                }
                for (record, wx) in row[..x.len()].iter_mut().zip(columns) {
                    let at: *mut __m512i = record.as_mut_ptr().cast();
                    for i in 0..N / 4 {
                        let add = _mm512_mul_ps(rows[i], wx[i]);
                        // SAFETY: sixteen sums are 64 bytes, and borrowed for us alone.
                        unsafe {
                            let sums = _mm512_loadu_si512(at.add(i));
                            let sums = _mm512_add_epi32(sums, _mm512_cvtps_epi32(add));
                            _mm512_storeu_si512(at.add(i), sums);
                        }
                    }
                }
            }
        }
    }

    /// [`sheet_offsets::splat_apart`] into 32-bit sums with AVX-512.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i32, N>],
        (apart, payloads): (&Apart, &[[f32; 4]]),
        layers: &Layers<'_, i32, N>,
        woven: &mut Woven<Tap, N>,
    ) {
        let kept = &apart.kept[..payloads.len()];
        if let Some(slant) = layers.slant {
            return shear::avx512::longs((records, (apart, payloads), layers, slant));
        }
        // Columns that are alike are added above, but for windows that are too large for lanes.
        let wide = lines::widest(apart, kept, i32::step::<N>()).filter(|_| !layers.alike);
        let Some(wide) = wide else {
            return sheet_offsets::splat_apart(simd, records, (apart, payloads), layers, woven);
        };
        let at = (records, (apart, payloads), layers, &mut woven.spans);
        by_window!(wide, side_by_side[N], at)
    }

    /// Weights of voxel `i` in four slots, the first or the second ones, pixel by pixel: four
    /// pixels a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn four_slots<const N: usize>(lines: &Lines<'_, Tap, N>, i: usize, half: usize) -> [__m512; 4] {
        let mut slots = [_mm512_setzero_si512(); 4];
        for (slot, line) in slots.iter_mut().enumerate() {
            let (present, from) = lines.of(4 * half + slot, i);
            // SAFETY: a tap is a float; lanes that are not present are not read, and those that are
            // lie in the table.
            *line = unsafe { _mm512_maskz_loadu_epi32(present as u16, from.cast()) };
        }
        by_column(slots).map(|four| _mm512_castsi512_ps(four))
    }

    /// Weights of voxel `i` in depth, each slot's for its four channels: four slots a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn deep<const N: usize>(
        layers: &Layers<'_, i32, N>,
        apart: &Apart,
        i: usize,
        turn: __m512i,
    ) -> [__m512; PARTS] {
        if N != 4 {
            return spread::<N>(&layers.depths(apart, i));
        }
        let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
        let present = (1u16 << z.len().min(4)) - 1;
        // SAFETY: lanes that are not present are not read.
        let z = unsafe { _mm512_maskz_loadu_ps(present, z.as_ptr()) };
        [_mm512_permutexvar_ps(turn, z); PARTS]
    }

    /// Windows of `WIDE` columns, four slots after the other.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn side_by_side<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, spans): ApartAt<'_, i32, N>,
    ) {
        let zero = _mm512_setzero_ps();
        let lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let slot = _mm512_srli_epi32::<2>(lane);
        // Which of four weights in depth a lane takes: that of its slot.
        let turn = _mm512_sub_epi32(slot, _mm512_set1_epi32(layers.slot as i32));
        let turn = _mm512_and_si512(turn, _mm512_set1_epi32(3));
        let kept = &apart.kept[..payloads.len()];
        // SAFETY: these are the instructions.
        let [across, down] = unsafe {
            Lines::both::<Sixteen, _>(apart, kept, layers, spans, (WIDE, i32::step::<N>()))
        };
        for (&i, payload) in kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let ([x, y], [_, high]) = apart.window(i, i32::step::<N>());
            let x = lines::inside(x, WIDE);
            // SAFETY: four floats are 16 bytes.
            let payload = _mm512_broadcast_f32x4(unsafe { _mm_loadu_ps(payload.as_ptr()) });
            let deep = deep(layers, apart, i, turn);
            for half in 0..N / 4 {
                // Negative sections there are none.
                let section = _mm512_max_ps(_mm512_mul_ps(payload, deep[half]), zero);
                let mut wx = [zero; WIDE];
                let columns = four_slots(&across, i, half);
                for c in 0..WIDE {
                    let from = _mm512_add_epi32(slot, _mm512_set1_epi32(4 * (c as i32 % 4)));
                    wx[c] = _mm512_permutexvar_ps(from, columns[c / 4]);
                }
                let rows = four_slots(&down, i, half);
                let mut from = slot;
                let of_rows = records[y * STRIDE + x..].chunks_mut(STRIDE).take(high);
                for (j, row) in of_rows.enumerate() {
                    let wy = _mm512_permutexvar_ps(from, rows[j / 4 % 4]);
                    from = _mm512_add_epi32(from, _mm512_set1_epi32(4));
                    let of_row = _mm512_mul_ps(section, wy);
                    let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                    for c in 0..WIDE {
                        let at: *mut __m512i = row[c].as_mut_ptr().cast();
                        let add = _mm512_mul_ps(of_row, wx[c]);
                        // SAFETY: sixteen sums of four slots are 64 bytes, and borrowed for us
                        // alone.
                        unsafe {
                            let at = at.add(half);
                            let sums = _mm512_loadu_si512(at);
                            let sums = _mm512_add_epi32(sums, _mm512_cvtps_epi32(add));
                            _mm512_storeu_si512(at, sums);
                        }
                    }
                }
            }
        }
    }
}
