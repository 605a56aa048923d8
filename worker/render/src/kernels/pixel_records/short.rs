//! Records of 16-bit sums in lanes.

#[cfg(target_arch = "x86_64")]
pub(super) mod avx2 {
    use crate::kernels::Simd;
    use crate::kernels::lanes::Eight;
    use crate::kernels::pixel_records::sheet_offsets::lines::{self, Lines};
    use crate::kernels::pixel_records::sheet_offsets::{
        self, Apart, ApartAt, BATCH, LINE, Layers, Woven,
    };
    use crate::kernels::pixel_records::{
        Across, BySlot, MOST, Record, RowAt, STRIDE, Splat, Tables, shear,
    };
    use std::arch::x86_64::*;

    /// Registers of a record at most: four sheets each.
    pub(in super::super) const PARTS: usize = MOST / 4;

    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_all<const N: usize>(
        records: &mut [Record<i16, N>],
        (voxels, payloads): (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        let turns = turns::<N>(slot);
        for (v, &payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let z = match z.first_chunk::<N>() {
                // SAFETY: four weights are 8 bytes, eight 16.
                Some(z) if N == 4 => unsafe { _mm_loadl_epi64(z.as_ptr().cast()) },
                // SAFETY: as above.
                Some(z) => unsafe { _mm_loadu_si128(z.as_ptr().cast()) },
                None => {
                    let mut all = [0i16; 8];
                    all[..z.len()].copy_from_slice(z);
                    // SAFETY: eight weights are 16 bytes.
                    unsafe { _mm_loadu_si128(all.as_ptr().cast()) }
                }
            };
            let z = _mm256_broadcastsi128_si256(z);
            let payload = _mm256_set1_epi64x(payload as i64);
            let mut sections = [_mm256_setzero_si256(); PARTS];
            for (section, turn) in sections[..N / 4].iter_mut().zip(turns) {
                *section = _mm256_mulhrs_epi16(payload, _mm256_shuffle_epi8(z, turn));
            }
            let at = v.at();
            match x.len() {
                4 => columns::<4, N>(records, at, x, y, sections),
                5 => columns::<5, N>(records, at, x, y, sections),
                6 => columns::<6, N>(records, at, x, y, sections),
                7 => columns::<7, N>(records, at, x, y, sections),
                8 => columns::<8, N>(records, at, x, y, sections),
                _ => {
                    // Columns in groups whose weights stay in registers.
                    let (fours, rest) = x.as_chunks::<4>();
                    for (i, four) in fours.iter().enumerate() {
                        columns::<4, N>(records, at + 4 * i, four, y, sections);
                    }
                    for (i, one) in rest.iter().enumerate() {
                        let at = at + 4 * fours.len() + i;
                        columns::<1, N>(records, at, &[*one], y, sections);
                    }
                }
            }
        }
    }

    /// Returns which of a voxel's weights in depth each lane takes, by bytes: that of its slot.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn turns<const N: usize>(slot: usize) -> [__m256i; PARTS] {
        let mut turns = [_mm256_setzero_si256(); PARTS];
        for (part, turn) in turns[..N / 4].iter_mut().enumerate() {
            let bytes: [u8; 32] = std::array::from_fn(|byte| {
                let weight = (4 * part + byte / 8 + 2 * N - slot) % N;
                (2 * weight + byte % 2) as u8
            });
            // SAFETY: 32 bytes.
            *turn = unsafe { _mm256_loadu_si256(bytes.as_ptr().cast()) };
        }
        turns
    }

    /// Each slot's weight for its four channels: four slots a register.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn spread<const N: usize>(weights: &BySlot<i16, N>) -> [__m256i; PARTS] {
        let mut spread = [_mm256_setzero_si256(); PARTS];
        for (i, spread) in spread[..N / 4].iter_mut().enumerate() {
            // SAFETY: four weights are 8 bytes.
            let weights = unsafe { _mm_loadl_epi64(weights[4 * i..4 * i + 4].as_ptr().cast()) };
            let weights = _mm256_broadcastsi128_si256(weights);
            let turn = _mm256_setr_epi8(
                0, 1, 0, 1, 0, 1, 0, 1, 2, 3, 2, 3, 2, 3, 2, 3, 4, 5, 4, 5, 4, 5, 4, 5, 6, 7, 6, 7,
                6, 7, 6, 7,
            );
            *spread = _mm256_shuffle_epi8(weights, turn);
        }
        spread
    }

    /// Four rows of sixteen columns, written column by column.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn by_column(lines: [__m256i; 4], to: &mut [i16; 64]) {
        let low =
            [_mm256_unpacklo_epi16(lines[0], lines[1]), _mm256_unpacklo_epi16(lines[2], lines[3])];
        let high =
            [_mm256_unpackhi_epi16(lines[0], lines[1]), _mm256_unpackhi_epi16(lines[2], lines[3])];
        // Two columns a half: 0 1 and 8 9, 2 3 and 10 11, and so on.
        let pairs = [
            _mm256_unpacklo_epi32(low[0], low[1]),
            _mm256_unpackhi_epi32(low[0], low[1]),
            _mm256_unpacklo_epi32(high[0], high[1]),
            _mm256_unpackhi_epi32(high[0], high[1]),
        ];
        let (low, high) = to.as_chunks_mut::<8>().0.split_at_mut(4);
        for (i, pair) in pairs.into_iter().enumerate() {
            // SAFETY: eight weights are 16 bytes.
            unsafe {
                _mm_storeu_si128(low[i].as_mut_ptr().cast(), _mm256_castsi256_si128(pair));
                let pair = _mm256_extracti128_si256::<1>(pair);
                _mm_storeu_si128(high[i].as_mut_ptr().cast(), pair);
            }
        }
    }

    /// Eight rows of sixteen columns, written column by column.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn eight_by_column(lines: [__m256i; 8], to: &mut [i16; 128]) {
        let zero = _mm256_setzero_si256();
        let [mut twos, mut fours] = [[zero; 8]; 2];
        for i in 0..4 {
            let (a, b) = (lines[2 * i], lines[2 * i + 1]);
            // Columns 0 to 3 and 8 to 11, then the others.
            (twos[i], twos[4 + i]) = (_mm256_unpacklo_epi16(a, b), _mm256_unpackhi_epi16(a, b));
        }
        for i in 0..2 {
            for half in 0..2 {
                let (a, b) = (twos[4 * half + 2 * i], twos[4 * half + 2 * i + 1]);
                fours[4 * half + i] = _mm256_unpacklo_epi32(a, b);
                fours[4 * half + 2 + i] = _mm256_unpackhi_epi32(a, b);
            }
        }
        let (low, high) = to.as_chunks_mut::<8>().0.split_at_mut(8);
        for i in 0..4 {
            let (a, b) = (fours[2 * i], fours[2 * i + 1]);
            let pair = [_mm256_unpacklo_epi64(a, b), _mm256_unpackhi_epi64(a, b)];
            for (j, column) in pair.into_iter().enumerate() {
                let (low, high) = (&mut low[2 * i + j], &mut high[2 * i + j]);
                // SAFETY: eight weights are 16 bytes.
                unsafe {
                    _mm_storeu_si128(low.as_mut_ptr().cast(), _mm256_castsi256_si128(column));
                    let column = _mm256_extracti128_si256::<1>(column);
                    _mm_storeu_si128(high.as_mut_ptr().cast(), column);
                }
            }
        }
    }

    /// Whether [`by_sixteen`] takes windows of `wide` columns.
    #[inline]
    pub(super) fn fits<const N: usize>(wide: usize, to: &[BySlot<i16, N>]) -> bool {
        (N == 4 || N == 8) && wide <= 16 && to.len() >= 16
    }

    /// Sixteen columns of four rows or of eight, written column by column.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(super) fn by_sixteen<const N: usize>(lines: [__m256i; 8], to: &mut [BySlot<i16, N>]) {
        let to = to.as_flattened_mut();
        if N == 4 {
            by_column([0, 1, 2, 3].map(|i| lines[i]), to.first_chunk_mut().expect("it fits"));
        } else {
            eight_by_column(lines, to.first_chunk_mut().expect("it fits"));
        }
    }

    /// Four or eight rows and sixteen columns at a time.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn weave<const N: usize>(
        rows: [RowAt<'_, i16>; N],
        wide: usize,
        to: &mut [BySlot<i16, N>],
    ) {
        if !fits(wide, to) {
            return super::super::weave(rows, wide, to);
        }
        let columns = _mm256_setr_epi16(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
        let mut lines = [_mm256_setzero_si256(); 8];
        for (line, at) in lines.iter_mut().zip(rows) {
            let (begin, end) = (at.column, at.column + at.len as i32);
            if begin >= 16 || end <= 0 || at.len == 0 {
                continue;
            }
            // What lies around the row in its table is read, too, and cut off.
            let from = at.from as isize - begin as isize;
            let around = usize::try_from(from).ok().and_then(|from| at.table.get(from..from + 16));
            let Some(around) = around else { return super::super::weave(rows, wide, to) };
            let behind = _mm256_cmpgt_epi16(columns, _mm256_set1_epi16((begin - 1).max(-1) as i16));
            let before = _mm256_cmpgt_epi16(_mm256_set1_epi16(end.min(16) as i16), columns);
            // SAFETY: sixteen weights are 32 bytes.
            let around = unsafe { _mm256_loadu_si256(around.as_ptr().cast()) };
            *line = _mm256_and_si256(around, _mm256_and_si256(behind, before));
        }
        by_sixteen(lines, to);
    }

    /// Adds `row * w`, register by register, to a record.
    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn add<const N: usize>(
        record: &mut Record<i16, N>,
        row: &[__m256i; PARTS],
        w: &[__m256i; PARTS],
    ) {
        let at: *mut __m256i = record.as_mut_ptr().cast();
        for i in 0..N / 4 {
            // SAFETY: four slots are 32 bytes, and borrowed for us alone.
            unsafe {
                let at = at.add(i);
                let sums = _mm256_loadu_si256(at);
                let sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(row[i], w[i]));
                _mm256_storeu_si256(at, sums);
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn times<const N: usize>(
        a: &[__m256i; PARTS],
        b: &[__m256i; PARTS],
    ) -> [__m256i; PARTS] {
        let mut all = [_mm256_setzero_si256(); PARTS];
        for i in 0..N / 4 {
            all[i] = _mm256_mulhrs_epi16(a[i], b[i]);
        }
        all
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    pub(in super::super) fn splat_deep<const N: usize>(
        records: &mut [Record<i16, N>],
        at: usize,
        (x, y): Across<'_, i16, N>,
        payload: u64,
        z: &BySlot<i16, N>,
    ) {
        let payload = [_mm256_set1_epi64x(payload as i64); PARTS];
        let section = times::<N>(&payload, &spread(z));
        for (row, wy) in records[at..].chunks_mut(STRIDE).zip(y) {
            let section = times::<N>(&section, &spread(wy));
            for (record, wx) in row[..x.len()].iter_mut().zip(x) {
                add(record, &section, &spread(wx));
            }
        }
    }

    /// [`sheet_offsets::splat_apart`] into 16-bit sums with AVX2.
    #[target_feature(enable = "avx2")]
    pub(in super::super) fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        (apart, payloads): (&Apart, &[u64]),
        layers: &Layers<'_, i16, N>,
        woven: &mut Woven<i16, N>,
    ) {
        let kept = &apart.kept[..payloads.len()];
        if let Some(slant) = layers.slant {
            return shear::avx2::shorts((records, (apart, payloads), layers, slant));
        }
        // Columns are alike in records of eight sheets.
        let four = N == 4 && !layers.alike;
        let Some(wide) = lines::widest(apart, kept, 1).filter(|_| four) else {
            return sheet_offsets::splat_apart(simd, records, (apart, payloads), layers, woven);
        };
        let at = (records, (apart, payloads), layers, &mut woven.spans);
        by_window!(wide, side_by_side[N], at)
    }

    /// Weights of voxel `i` in four slots, pixel by pixel.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn line<const N: usize>(lines: &Lines<'_, i16, N>, i: usize, to: &mut [i16; 64]) {
        const { assert!(LINE == 16) };
        let each = _mm256_setr_epi16(
            1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024, 2048, 4096, 8192, 16384, -32768,
        );
        let mut slots = [_mm256_setzero_si256(); 4];
        for (slot, line) in slots.iter_mut().enumerate() {
            let (present, around) = lines.around(slot, i);
            *line = match around {
                Some(around) => {
                    // SAFETY: sixteen weights are 32 bytes.
                    let around = unsafe { _mm256_loadu_si256(around.as_ptr().cast()) };
                    let present = _mm256_and_si256(_mm256_set1_epi16(present as i16), each);
                    _mm256_and_si256(around, _mm256_cmpeq_epi16(present, each))
                }
                // SAFETY: as above.
                None => unsafe { _mm256_loadu_si256(lines.one_by_one(slot, i).as_ptr().cast()) },
            };
        }
        by_column(slots, to);
    }

    /// Windows of `WIDE` columns.
    #[target_feature(enable = "avx2")]
    #[inline]
    fn side_by_side<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, spans): ApartAt<'_, i16, N>,
    ) {
        let zero = _mm256_setzero_si256();
        let [turn, _] = turns::<N>(layers.slot);
        let kept = &apart.kept[..payloads.len()];
        // SAFETY: these are the instructions.
        let [across, down] =
            unsafe { Lines::both::<Eight, _>(apart, kept, layers, spans, (WIDE, 1)) };
        let [mut columns, mut rows] = [[0; 64]; 2];
        for (&i, &payload) in kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let ([x, y], [_, high]) = apart.window(i, 1);
            let x = lines::inside(x, WIDE);
            let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
            let deep: [i16; 4] = match z.first_chunk() {
                Some(four) => *four,
                None => std::array::from_fn(|sheet| z.get(sheet).copied().unwrap_or(0)),
            };
            // SAFETY: four weights are 8 bytes.
            let z = _mm256_broadcastsi128_si256(unsafe { _mm_loadl_epi64(deep.as_ptr().cast()) });
            let section = _mm256_set1_epi64x(payload as i64);
            let section = _mm256_mulhrs_epi16(section, _mm256_shuffle_epi8(z, turn));
            let mut wx = [zero; WIDE];
            line(&across, i, &mut columns);
            for (wx, w) in wx.iter_mut().zip(columns.as_chunks::<4>().0) {
                [*wx, _] = spread::<4>(w);
            }
            line(&down, i, &mut rows);
            let of_rows = records[y * STRIDE + x..].chunks_mut(STRIDE).zip(rows.as_chunks::<4>().0);
            for (row, wy) in of_rows.take(high) {
                let [wy, _] = spread::<4>(wy);
                let section = _mm256_mulhrs_epi16(section, wy);
                let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
                for c in 0..WIDE {
                    add::<N>(&mut row[c], &[section, zero], &[wx[c], zero]);
                }
            }
        }
    }

    #[target_feature(enable = "avx2")]
    #[inline]
    fn columns<const C: usize, const N: usize>(
        records: &mut [Record<i16, N>],
        at: usize,
        x: &[i16],
        y: &[i16],
        sections: [__m256i; PARTS],
    ) {
        let mut wx = [_mm256_setzero_si256(); C];
        for i in 0..C {
            wx[i] = _mm256_set1_epi16(x[i]);
        }
        for (row, &wy) in records[at..].chunks_mut(STRIDE).zip(y) {
            let section = times::<N>(&sections, &[_mm256_set1_epi16(wy); PARTS]);
            let row = row.first_chunk_mut::<C>().expect("a footprint inside the part");
            for i in 0..C {
                add(&mut row[i], &section, &[wx[i]; PARTS]);
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
pub(super) mod avx512 {
    use super::avx2::{by_sixteen, eight_by_column, fits};
    use crate::kernels::Simd;
    use crate::kernels::lanes::Sixteen;
    use crate::kernels::pixel_records::sheet_offsets::lines::{self, Lines};
    use crate::kernels::pixel_records::sheet_offsets::{
        self, Apart, ApartAt, BATCH, LINE, Layers, Woven,
    };
    use crate::kernels::pixel_records::{
        Across, BySlot, Record, Recorded, RowAt, STRIDE, Splat, Tables, shear,
    };
    use std::arch::x86_64::*;

    /// 16-bit numbers of a register.
    const WORDS: usize = 32;

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_all<const N: usize>(
        records: &mut [Record<i16, N>],
        voxels: (&[Splat], &[u64]),
        slot: usize,
        tables: &Tables<'_, i16>,
    ) {
        let at = (records, voxels, slot, tables);
        // Registers of a row: where two records share one, a footprint that begins in the middle of
        // the first ends in the middle of the last.
        let units = if N == 8 { tables.across[0].len } else { tables.across[0].len / 2 + 1 };
        match units {
            2 => all::<2, N>(at),
            3 => all::<3, N>(at),
            4 => all::<4, N>(at),
            5 => all::<5, N>(at),
            6 => all::<6, N>(at),
            7 => all::<7, N>(at),
            8 => all::<8, N>(at),
            9 => all::<9, N>(at),
            10 => all::<10, N>(at),
            11 => all::<11, N>(at),
            12 => all::<12, N>(at),
            13 => all::<13, N>(at),
            14 => all::<14, N>(at),
            // A footprint of ten pixels a voxel and more: loops of AVX2.
            _ => {
                let (records, voxels, slot, tables) = at;
                super::avx2::splat_all(records, voxels, slot, tables);
            }
        }
    }

    /// A register of 16-bit numbers.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn words(of: impl Fn(usize) -> usize) -> __m512i {
        let mut words = [0i16; WORDS];
        for (lane, word) in words.iter_mut().enumerate() {
            *word = of(lane) as i16;
        }
        // SAFETY: 64 bytes.
        unsafe { _mm512_loadu_si512(words.as_ptr().cast()) }
    }

    /// The first of `weights`, at most 32, and zeros.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn load(weights: &[i16]) -> __m512i {
        let present = (1u64 << weights.len().min(WORDS)) - 1;
        // SAFETY: lanes that are not present are not read.
        unsafe { _mm512_maskz_loadu_epi16(present as u32, weights.as_ptr()) }
    }

    /// Adds `row * w` to the register at `at`.
    ///
    /// # Safety
    /// The 64 bytes from `at` may be written.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) unsafe fn add(at: *mut __m512i, row: __m512i, w: __m512i) {
        // SAFETY: see above.
        unsafe {
            let sums = _mm512_loadu_si512(at);
            let sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(row, w));
            _mm512_storeu_si512(at, sums);
        }
    }

    /// [`add`] to the first `WIDE` records of eight sheets of a row.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn add_row<const WIDE: usize, const N: usize>(
        row: &mut [Record<i16, N>],
        section: __m512i,
        wx: &[__m512i; WIDE],
    ) {
        let row = row.first_chunk_mut::<WIDE>().expect("a window inside the part");
        let at: *mut __m512i = row.as_mut_ptr().cast();
        for (i, &wx) in wx.iter().enumerate() {
            // SAFETY: so many registers are the records of `row`, borrowed for us alone.
            unsafe { add(at.add(i), section, wx) };
        }
    }

    type At<'a, const N: usize> =
        (&'a mut [Record<i16, N>], (&'a [Splat], &'a [u64]), usize, &'a Tables<'a, i16>);

    /// Rows of `U` registers, of one record of eight sheets or of two of four.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn all<const U: usize, const N: usize>((records, (voxels, payloads), slot, tables): At<'_, N>) {
        let pixels = 8 / N;
        // Which of a voxel's weights in depth each lane takes: that of its slot.
        let turn = words(|lane| (lane / 4 + 2 * N - slot) % N);
        // Which weights across: the two records' of a register, moved where a footprint begins with
        // the second of them. What is before the first comes from the last lane, which is zero.
        let across = [0, 1].map(|odd| words(|lane| (lane / (4 * N) + WORDS - odd) % WORDS));
        for (v, &payload) in voxels.iter().zip(payloads) {
            let (x, y, z) = v.weights(tables);
            let section = _mm512_set1_epi64(payload as i64);
            let section = _mm512_mulhrs_epi16(section, _mm512_permutexvar_epi16(turn, load(z)));
            let mut wx = [_mm512_setzero_si512(); U];
            let odd = if N == 8 { 0 } else { v.at() % 2 };
            if N == 8 {
                for i in 0..U {
                    wx[i] = _mm512_set1_epi16(x[i]);
                }
            } else {
                let (x, mut from) = (load(x), across[odd]);
                for wx in &mut wx {
                    *wx = _mm512_permutexvar_epi16(from, x);
                    from = _mm512_add_epi16(from, _mm512_set1_epi16(2));
                }
            }
            let rows = records[v.at() - odd..].chunks_mut(STRIDE);
            for (row, &wy) in rows.zip(y) {
                let section = _mm512_mulhrs_epi16(section, _mm512_set1_epi16(wy));
                let row = &mut row[..U * pixels];
                let at: *mut __m512i = row.as_mut_ptr().cast();
                for (i, wx) in wx.into_iter().enumerate() {
                    // SAFETY: so many registers are the records of `row`, borrowed for us alone.
                    unsafe { add(at.add(i), section, wx) };
                }
            }
        }
    }

    /// Four or eight rows and sixteen columns at a time.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn weave<const N: usize>(
        rows: [RowAt<'_, i16>; N],
        wide: usize,
        to: &mut [BySlot<i16, N>],
    ) {
        if !fits(wide, to) {
            return super::super::weave(rows, wide, to);
        }
        let mut lines = [_mm256_setzero_si256(); 8];
        for (line, at) in lines.iter_mut().zip(rows) {
            let (present, from) = at.columns();
            // SAFETY: lanes that are not present are not read; those that are lie in the row.
            *line = unsafe { _mm256_maskz_loadu_epi16(present, from) };
        }
        by_sixteen(lines, to);
    }

    /// Each slot's weight for its four channels, of one pixel of eight sheets or two of four.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread(weights: &[i16]) -> __m512i {
        // Words 0 0 0 0 1 1 1 1 and so on, from the lowest up.
        let turn = _mm512_set_epi64(7, 6, 5, 4, 3, 2, 1, 0);
        let turn = _mm512_mullo_epi64(turn, _mm512_set1_epi64(0x0001_0001_0001_0001));
        let weights = weights.first_chunk::<8>().expect("the weights of a register");
        // SAFETY: eight weights are 16 bytes.
        let weights = unsafe { _mm_loadu_si128(weights.as_ptr().cast()) };
        _mm512_permutexvar_epi16(turn, _mm512_castsi128_si512(weights))
    }

    /// Returns a register in which all pixels have the same weights.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn spread_same<const N: usize>(weights: &BySlot<i16, N>) -> __m512i {
        let mut both = [0; 8];
        for part in both.chunks_mut(N) {
            part.copy_from_slice(weights);
        }
        spread(&both)
    }

    /// Columns come in registers: an even number of them from an even one, where there are two in
    /// one.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    pub(in super::super) fn splat_deep<const N: usize>(
        records: &mut [Record<i16, N>],
        at: usize,
        (x, y): Across<'_, i16, N>,
        payload: u64,
        z: &BySlot<i16, N>,
    ) {
        let pixels = 8 / N;
        if x.len() % pixels != 0 {
            return super::avx2::splat_deep(records, at, (x, y), payload, z);
        }
        let section = _mm512_mulhrs_epi16(_mm512_set1_epi64(payload as i64), spread_same(z));
        // Columns in groups whose weights stay in registers.
        for (i, x) in x.chunks(8 * pixels).enumerate() {
            let mut columns = [_mm512_setzero_si512(); 8];
            let units = x.len() / pixels;
            for (column, x) in columns.iter_mut().zip(x.as_flattened().chunks(8)) {
                *column = spread(x);
            }
            let rows = records[at + 8 * pixels * i..].chunks_mut(STRIDE);
            for (row, wy) in rows.zip(y) {
                let section = _mm512_mulhrs_epi16(section, spread_same(wy));
                let row = &mut row[..x.len()];
                let at: *mut __m512i = row.as_mut_ptr().cast();
                for (i, wx) in columns[..units].iter().enumerate() {
                    // SAFETY: so many registers are the records of `row`, borrowed for us alone.
                    unsafe { add(at.add(i), section, *wx) };
                }
            }
        }
    }

    /// [`sheet_offsets::splat_apart`] into 16-bit sums with AVX-512.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(in super::super) fn splat_apart<const N: usize>(
        simd: Simd,
        records: &mut [Record<i16, N>],
        (apart, payloads): (&Apart, &[u64]),
        layers: &Layers<'_, i16, N>,
        woven: &mut Woven<i16, N>,
    ) {
        let kept = &apart.kept[..payloads.len()];
        if let Some(slant) = layers.slant {
            return shear::avx512::shorts((records, (apart, payloads), layers, slant));
        }
        // Columns that are alike are added above, but for windows that are too large for lanes.
        let wide = lines::widest(apart, kept, i16::step::<N>()).filter(|_| !layers.alike);
        let Some(wide) = wide else {
            return sheet_offsets::splat_apart(simd, records, (apart, payloads), layers, woven);
        };
        let at = (records, (apart, payloads), layers, &mut woven.spans);
        if const { N == 8 } {
            by_window!(wide, eight_slots[N], at)
        } else {
            by_window!(wide, four_slots[N], at)
        }
    }

    /// Weights of voxel `i` in four slots, two of sixteen pixels a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn line<const N: usize>(lines: &Lines<'_, i16, N>, i: usize) -> [__m512i; 2] {
        const { assert!(LINE == WORDS / 2) };
        let mut both = [_mm512_setzero_si512(); 2];
        for (two, both) in both.iter_mut().enumerate() {
            let (low, low_at) = lines.of(2 * two, i);
            let (high, high_at) = lines.of(2 * two + 1, i);
            // SAFETY: lanes that are not present are not read, and those that are lie in the table.
            unsafe {
                *both = _mm512_maskz_loadu_epi16(low, low_at);
                *both = _mm512_mask_loadu_epi16(*both, high << LINE, high_at.wrapping_sub(LINE));
            }
        }
        both
    }

    /// Weights of voxel `i` in eight slots, pixel by pixel.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn line_of_eight<const N: usize>(lines: &Lines<'_, i16, N>, i: usize, to: &mut [i16; 128]) {
        let mut slots = [_mm256_setzero_si256(); 8];
        for (slot, line) in slots[..N].iter_mut().enumerate() {
            let (present, at) = lines.of(slot, i);
            // SAFETY: lanes that are not present are not read, and those that are lie in the table.
            *line = unsafe { _mm256_maskz_loadu_epi16(present as u16, at) };
        }
        eight_by_column(slots, to);
    }

    /// Weights of voxel `i` in eight slots, of eight pixels: slot by slot, four slots a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn eights<const N: usize>(lines: &Lines<'_, i16, N>, i: usize) -> [__m512i; 2] {
        let mut slots = [_mm_setzero_si128(); 8];
        for (slot, line) in slots[..N].iter_mut().enumerate() {
            let (present, at) = lines.of(slot, i);
            // SAFETY: lanes that are not present are not read, and those that are lie in the table.
            *line = unsafe { _mm_maskz_loadu_epi16(present as u8, at) };
        }
        let [a, b, c, d, e, f, g, h] = slots;
        [[a, b, c, d], [e, f, g, h]].map(|[a, b, c, d]| {
            let low = _mm256_inserti128_si256::<1>(_mm256_castsi128_si256(a), b);
            let high = _mm256_inserti128_si256::<1>(_mm256_castsi128_si256(c), d);
            _mm512_inserti64x4::<1>(_mm512_castsi256_si512(low), high)
        })
    }

    /// Windows of `WIDE` columns, of eight slots: a register a record.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn eight_slots<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, spans): ApartAt<'_, i16, N>,
    ) {
        let turn = words(|lane| (lane / 4 + 2 * N - layers.slot) % N);
        let kept = &apart.kept[..payloads.len()];
        // SAFETY: these are the instructions.
        let [across, down] = unsafe {
            Lines::both::<Sixteen, _>(apart, kept, layers, spans, (WIDE, i16::step::<N>()))
        };
        let [mut columns, mut rows] = [[0; 128]; 2];
        // Which of [`eights`] lanes take in the first row: those of their slots.
        let first = words(|lane| lane / 4 * 8);
        for (&i, &payload) in kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let ([x, y], [_, high]) = apart.window(i, i16::step::<N>());
            let x = lines::inside(x, WIDE);
            let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
            let section = _mm512_set1_epi64(payload as i64);
            let section = _mm512_mulhrs_epi16(section, _mm512_permutexvar_epi16(turn, load(z)));
            let mut wx = [_mm512_setzero_si512(); WIDE];
            line_of_eight(&across, i, &mut columns);
            for (wx, w) in wx.iter_mut().zip(columns.as_chunks::<8>().0) {
                *wx = spread(w);
            }
            let of_rows = records[y * STRIDE + x..].chunks_mut(STRIDE).take(high);
            if high <= 8 {
                let ([low, behind], mut from) = (eights(&down, i), first);
                for row in of_rows {
                    let wy = _mm512_permutex2var_epi16(low, from, behind);
                    from = _mm512_add_epi16(from, _mm512_set1_epi16(1));
                    add_row(row, _mm512_mulhrs_epi16(section, wy), &wx);
                }
            } else {
                line_of_eight(&down, i, &mut rows);
                for (row, wy) in of_rows.zip(rows.as_chunks::<8>().0) {
                    add_row(row, _mm512_mulhrs_epi16(section, spread(wy)), &wx);
                }
            }
        }
    }

    /// Windows of `WIDE` columns, of four slots: two a register.
    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    #[inline]
    fn four_slots<const WIDE: usize, const N: usize>(
        (records, (apart, payloads), layers, spans): ApartAt<'_, i16, N>,
    ) {
        let turn = words(|lane| (lane / 4 + 2 * N - layers.slot) % N);
        // Which weight of a line's 64 a lane takes: that of its slot for its column, or for the
        // row.
        let column = words(|lane| lane / 4 % N * LINE + lane / (4 * N));
        let row = words(|lane| lane / 4 % N * LINE);
        let kept = &apart.kept[..payloads.len()];
        // SAFETY: these are the instructions.
        let [across, down] = unsafe {
            Lines::both::<Sixteen, _>(apart, kept, layers, spans, (WIDE, i16::step::<N>()))
        };
        for (&i, &payload) in kept.iter().zip(payloads) {
            let i = i as usize % BATCH;
            let ([x, y], [_, high]) = apart.window(i, i16::step::<N>());
            let x = lines::inside(x, WIDE);
            let z = &layers.deep.weights[apart.deep[i] as usize..][..apart.left[i] as usize];
            let section = _mm512_set1_epi64(payload as i64);
            let section = _mm512_mulhrs_epi16(section, _mm512_permutexvar_epi16(turn, load(z)));
            let (mut wx, mut from) = ([_mm512_setzero_si512(); WIDE], column);
            let [low, behind] = line(&across, i);
            for wx in &mut wx[..WIDE / 2] {
                *wx = _mm512_permutex2var_epi16(low, from, behind);
                from = _mm512_add_epi16(from, _mm512_set1_epi16(2));
            }
            let [low, behind] = line(&down, i);
            let mut from = row;
            for row in records[y * STRIDE + x..].chunks_mut(STRIDE).take(high) {
                let wy = _mm512_permutex2var_epi16(low, from, behind);
                from = _mm512_add_epi16(from, _mm512_set1_epi16(1));
                let section = _mm512_mulhrs_epi16(section, wy);
                let row = &mut row[..WIDE];
                let at: *mut __m512i = row.as_mut_ptr().cast();
                for (i, &wx) in wx[..WIDE / 2].iter().enumerate() {
                    // SAFETY: so many registers are the records of `row`, borrowed for us alone.
                    unsafe { add(at.add(i), section, wx) };
                }
            }
        }
    }
}
