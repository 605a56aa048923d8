//! Touched pixels of a closing sheet: lists of them, and gathering and scattering of their sums.
//!
//! A row of lanes takes sixteen pixels from anywhere, so that no lane is spent on a pixel that
//! nothing was added to. Loops are written plainly, and once for all register widths; both give the
//! same bytes.

use super::Simd;
use super::pixel_records::{Record, Recorded, STRIDE};
use crate::kernels::composite::{LANES, Row};

/// Pixels of a part at most, and as many lanes behind them as are stored at once.
const MOST: usize = 64 * 64 + LANES;

/// Number of places in a part: 64 rows of [`STRIDE`] places.
pub const PART: usize = 64 * STRIDE;

/// Places of pixels in a part: `row * STRIDE + column`.
pub struct Places {
    at: Box<[u32; MOST]>,
    n: usize,
    /// Memory for places that are dropped.
    dropped: Box<[u32; MOST]>,
}

impl Default for Places {
    fn default() -> Self {
        Places { at: Box::new([0; MOST]), n: 0, dropped: Box::new([0; MOST]) }
    }
}

/// Sixteen places, each inside a part: that only [`Places`] makes them is the proof.
#[derive(Clone, Copy)]
pub struct Some16<'a> {
    at: &'a [u32; LANES],
    n: usize,
}

#[expect(clippy::len_without_is_empty, reason = "callers only loop over it")]
impl<'a> Some16<'a> {
    /// Returns all sixteen places, each inside a part; only the first [`Some16::len`] count.
    #[inline(always)]
    pub fn at(self) -> &'a [u32; LANES] {
        self.at
    }

    /// Returns how many of the sixteen places count, from the first on.
    #[inline(always)]
    pub fn len(self) -> usize {
        self.n
    }
}

#[expect(clippy::len_without_is_empty, reason = "callers only loop over it")]
impl Places {
    /// Lists the places whose bits are set in `rows`: bit x of word y is column x of row y.
    #[inline(always)]
    pub fn list(&mut self, simd: Simd, rows: &[u64; 64]) {
        self.n = 0;
        match simd.0 {
            super::Level::Plain => self.list_plain(rows),
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            super::Level::Avx2 => unsafe { wide::avx2::list(self, rows) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            super::Level::Avx512 => unsafe { wide::avx512::list(self, rows) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            super::Level::Neon => unsafe { wide::neon::list(self, rows) },
        }
    }

    /// Lists as [`Places::list`] does, in plain code.
    pub fn list_plain(&mut self, rows: &[u64; 64]) {
        for (y, row) in rows.iter().enumerate() {
            let mut row = *row;
            while row != 0 {
                self.at[self.n] = y as u32 * STRIDE as u32 + row.trailing_zeros();
                self.n += 1;
                row &= row - 1;
            }
        }
    }

    /// Drops the places where the sheet of `slot` has no extinction. Such a pixel's sheet is over:
    /// its sums become those of the sheet before, and the slot is empty.
    ///
    /// # Panics
    /// If there are fewer records or sums than a part has.
    #[inline(always)]
    pub fn sift<S: Recorded, const N: usize>(
        &mut self,
        simd: Simd,
        sums: SumsOf<'_, S, N>,
        slot: usize,
    ) {
        match simd.0 {
            super::Level::Plain => self.sift_plain::<S, N>(sums, slot),
            // SAFETY: the value proves that the instructions are there.
            #[cfg(target_arch = "x86_64")]
            super::Level::Avx2 => unsafe { wide::avx2::sift::<S, N>(self, sums, slot) },
            // SAFETY: as above.
            #[cfg(target_arch = "x86_64")]
            super::Level::Avx512 => unsafe { wide::avx512::sift::<S, N>(self, sums, slot) },
            // SAFETY: as above.
            #[cfg(target_arch = "aarch64")]
            super::Level::Neon => unsafe { wide::neon::sift::<S, N>(self, sums, slot) },
        }
    }

    fn sift_plain<S: Recorded, const N: usize>(
        &mut self,
        (records, before): SumsOf<'_, S, N>,
        slot: usize,
    ) {
        let n = std::mem::take(&mut self.n);
        for i in 0..n {
            let at = self.at[i];
            let sums = &mut records[at as usize][slot];
            if first_word(sums) == 0 {
                before[at as usize] = std::mem::take(sums);
            } else {
                self.at[self.n] = at;
                self.n += 1;
            }
        }
    }

    /// Returns all listed places, each `row * STRIDE + column`.
    pub fn all(&self) -> &[u32] {
        &self.at[..self.n]
    }

    /// Returns the number of listed places.
    pub fn len(&self) -> usize {
        self.n
    }

    /// Returns up to sixteen places from number `i` on. Lanes behind the last hold valid places,
    /// too.
    #[inline(always)]
    pub fn from(&self, i: usize) -> Some16<'_> {
        let at = self.at[i..].first_chunk().expect("room behind the last");
        Some16 { at, n: (self.n - i).min(LANES) }
    }
}

/// Returns the column and row of a place in a part, in pixels.
#[inline(always)]
pub fn column_and_row(place: u32) -> [usize; 2] {
    let place = place as usize;
    [place % STRIDE, place / STRIDE]
}

/// Returns a pixel's first 32 bits: its extinction, and at most one colour beside it. Zero means
/// that the pixel has no extinction.
#[inline(always)]
pub fn first_word<P: bytemuck::Pod>(pixel: &P) -> u32 {
    bytemuck::pod_read_unaligned(&bytemuck::bytes_of(pixel)[..4])
}

/// Records of open sheets, and sums of the sheet before.
pub(crate) type SumsOf<'a, S, const N: usize> = (&'a mut [Record<S, N>], &'a mut [[S; 4]]);

/// Takes the sums of sheet k, which `slot` holds, at some places for a row that is to be closed:
/// those of the sheet before, of the sheet itself, and of the one behind, and the opacity so far.
/// Leaves those of sheet k as the ones before and nothing in the slot.
///
/// # Panics
/// If there are fewer records, sums or pixels than a part has.
#[inline(always)]
pub fn take<S: Recorded, const N: usize>(
    simd: Simd,
    sums: SumsOf<'_, S, N>,
    pixels: &[[u32; 4]],
    places: Some16<'_>,
    slot: usize,
    row: &mut Row,
) {
    match simd.0 {
        super::Level::Plain => take_plain::<S, N>(sums, pixels, places, slot, row),
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx2 => unsafe {
            wide::avx2::take::<S, N>(sums, pixels, places, slot, row);
        },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx512 => unsafe {
            wide::avx512::take::<S, N>(sums, pixels, places, slot, row);
        },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        super::Level::Neon => unsafe {
            wide::neon::take::<S, N>(sums, pixels, places, slot, row);
        },
    }
}

fn take_plain<S: Recorded, const N: usize>(
    (records, before): SumsOf<'_, S, N>,
    pixels: &[[u32; 4]],
    Some16 { at, n }: Some16<'_>,
    slot: usize,
    row: &mut Row,
) {
    for (i, &at) in at[..n].iter().enumerate() {
        let (at, behind) = (at as usize, (slot + 1) % N);
        let sheets = [before[at], records[at][slot], records[at][behind]];
        let to = [&mut row.before, &mut row.here, &mut row.behind];
        for (to, sums) in to.into_iter().zip(sheets) {
            for (to, sum) in to.iter_mut().zip(sums) {
                to[i] = sum.value();
            }
        }
        row.a[i] = f32::from_bits(pixels[at][0]);
        before[at] = std::mem::take(&mut records[at][slot]);
    }
}

/// Writes the opacity and light of a closed row's first pixels to their places `at` in a part.
///
/// # Panics
/// If a place is none of the part.
#[inline(always)]
pub fn put(simd: Simd, row: &Row, at: &[u32], pixels: &mut [[u32; 4]]) {
    let mut fours = [[0; 4]; LANES];
    match simd.0 {
        super::Level::Plain => {
            for (i, four) in fours.iter_mut().enumerate() {
                let [r, g, b] = row.light.each_ref().map(|light| light[i]);
                *four = [row.a[i].to_bits(), r, g, b];
            }
        }
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx2 => unsafe { wide::avx2::fours(row, &mut fours) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx512 => unsafe { wide::avx512::fours(row, &mut fours) },
        // SAFETY: as above.
        #[cfg(target_arch = "aarch64")]
        super::Level::Neon => unsafe { wide::neon::fours(row, &mut fours) },
    }
    match at.first_chunk::<LANES>().filter(|at| follow(at)) {
        // Beside each other, as most are where few pixels are shut: in whole registers.
        Some(at) => {
            let pixels = pixels[at[0] as usize..].first_chunk_mut::<LANES>();
            let pixels = pixels.expect("places are of the part");
            for (pixel, four) in pixels.iter_mut().zip(&fours) {
                put_one(pixel, four);
            }
        }
        None => {
            for (&at, four) in at.iter().zip(&fours) {
                put_one(&mut pixels[at as usize], four);
            }
        }
    }
}

/// The opacity anew, and colours added.
#[inline(always)]
fn put_one(pixel: &mut [u32; 4], four: &[u32; 4]) {
    for (c, keep) in [0, u32::MAX, u32::MAX, u32::MAX].into_iter().enumerate() {
        pixel[c] = (pixel[c] & keep).wrapping_add(four[c]);
    }
}

/// Whether places, which ascend, follow each other.
#[inline(always)]
fn follow(at: &[u32; LANES]) -> bool {
    at[LANES - 1] - at[0] == LANES as u32 - 1
}

#[cfg(any(target_arch = "x86_64", target_arch = "aarch64"))]
mod wide {
    use super::{LANES, PART, Places, Record, Recorded, Row, STRIDE, Some16, SumsOf};
    #[cfg(target_arch = "aarch64")]
    use crate::kernels::lanes::Four;
    use crate::kernels::lanes::Lanes;
    #[cfg(target_arch = "x86_64")]
    use crate::kernels::lanes::{Eight, Sixteen};

    /// The functions here for one instruction set.
    macro_rules! compiled {
        ($set:ident, $features:literal, $lanes:ty) => {
            pub(super) mod $set {
                use super::*;

                #[target_feature(enable = $features)]
                pub(in super::super) fn list(places: &mut Places, rows: &[u64; 64]) {
                    // SAFETY: these are the instructions.
                    unsafe { super::list::<$lanes>(places, rows) }
                }

                #[target_feature(enable = $features)]
                pub(in super::super) fn sift<S: Recorded, const N: usize>(
                    places: &mut Places,
                    sums: SumsOf<'_, S, N>,
                    slot: usize,
                ) {
                    // SAFETY: these are the instructions.
                    unsafe { super::sift::<$lanes, S, N>(places, sums, slot) }
                }

                #[target_feature(enable = $features)]
                pub(in super::super) fn take<S: Recorded, const N: usize>(
                    sums: SumsOf<'_, S, N>,
                    pixels: &[[u32; 4]],
                    places: Some16<'_>,
                    slot: usize,
                    row: &mut Row,
                ) {
                    // SAFETY: these are the instructions.
                    unsafe { super::take::<$lanes, S, N>(sums, pixels, places, slot, row) }
                }

                #[target_feature(enable = $features)]
                #[inline]
                pub(in super::super) fn fours(row: &Row, to: &mut [[u32; 4]; LANES]) {
                    // SAFETY: these are the instructions.
                    unsafe { super::fours::<$lanes>(row, to) }
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

    #[inline(always)]
    unsafe fn list<L: Lanes>(places: &mut Places, rows: &[u64; 64]) {
        let (to, mut n) = (places.at.as_mut_ptr(), 0);
        for (y, &row) in rows.iter().enumerate() {
            let mut row = row;
            while row != 0 {
                // Lanes that begin with the first bit's group.
                let group = row.trailing_zeros() as usize / L::LANES * L::LANES;
                let bits = (row >> group) as u32 & ((1 << L::LANES) - 1);
                row &= u64::MAX.checked_shl((group + L::LANES) as u32).unwrap_or(0);
                // SAFETY: the caller's. Rows have 64 times 64 bits, so as many lanes as there are
                // fit behind those that were found.
                unsafe {
                    let at = L::from((y * STRIDE + group) as i32);
                    L::store(to.add(n), L::beside(bits, at));
                }
                n += bits.count_ones() as usize;
            }
        }
        places.n = n;
    }

    #[inline(always)]
    unsafe fn sift<L: Lanes, S: Recorded, const N: usize>(
        places: &mut Places,
        (records, before): SumsOf<'_, S, N>,
        slot: usize,
    ) {
        const { assert!(size_of::<Record<S, N>>() == N * size_of::<[S; 4]>()) };
        let words = (size_of::<Record<S, N>>() / 4) as i32;
        let (records, before) = (&mut records[..PART], &mut before[..PART]);
        let first: *mut [S; 4] = records.as_mut_ptr().cast();
        let (all, mut kept) = (places.at.as_mut_ptr(), 0);
        let (empty, mut dropped) = (places.dropped.as_mut_ptr(), 0);
        // SAFETY: the caller's. A record has N pixels, and all places are below PART. So many lanes
        // as there are fit behind the last place, and what is kept of some is stored where they or
        // those before them lay.
        unsafe {
            let now = first.add(slot % N);
            for from in (0..places.n).step_by(L::LANES) {
                let there = (1u32 << (places.n - from).min(L::LANES)) - 1;
                let at = L::load(all.add(from));
                let sums = L::times(at, L::set(words));
                let sums = L::look_up(L::marks(there), now.cast_const().cast(), sums);
                let none = L::bits(L::at_most(sums, L::set(0))) & there;
                L::store(empty.add(dropped), L::beside(none, at));
                dropped += none.count_ones() as usize;
                L::store(all.add(kept), L::beside(there & !none, at));
                kept += (there & !none).count_ones() as usize;
            }
            for &at in &places.dropped[..dropped] {
                let sums = now.add(N * at as usize);
                before[at as usize] = *sums;
                *sums = [S::default(); 4];
            }
        }
        places.n = kept;
    }

    #[inline(always)]
    unsafe fn take<L: Lanes, S: Recorded, const N: usize>(
        (records, before): SumsOf<'_, S, N>,
        pixels: &[[u32; 4]],
        Some16 { at, n }: Some16<'_>,
        slot: usize,
        row: &mut Row,
    ) {
        const { assert!(LANES.is_multiple_of(L::LANES)) };
        const { assert!(matches!(size_of::<[S; 4]>(), 8 | 16)) };
        const { assert!(size_of::<Record<S, N>>() == N * size_of::<[S; 4]>()) };
        let words = size_of::<[S; 4]>() / 4;
        let (records, before) = (&mut records[..PART], &mut before[..PART]);
        let (pixels, slot, behind) = (&pixels[..PART], slot % N, (slot + 1) % N);
        let old: *mut [S; 4] = before.as_mut_ptr();
        let first: *mut [S; 4] = records.as_mut_ptr().cast();
        // SAFETY: the caller's. A record has N pixels. All places are below PART, and there are as
        // many lanes in a row's arrays from `lanes` on.
        unsafe {
            let [now, next] = [first.add(slot), first.add(behind)];
            for lanes in (0..n).step_by(L::LANES) {
                let some = lanes..lanes + L::LANES;
                let at = at[some.clone()].as_ptr();
                let [a, ..] = L::fours(pixels.as_ptr().cast(), 4, at);
                L::store(row.a[some.clone()].as_mut_ptr().cast(), a);
                let [old, now, next] = [old, now, next].map(|from| from.cast_const().cast());
                let sheets = if words == 4 {
                    [
                        L::fours(old, words, at),
                        L::fours(now, N * words, at),
                        L::fours(next, N * words, at),
                    ]
                } else {
                    let [a, b] = L::pairs(old, at);
                    let [c, d, e, f] = L::twos([now, next], N * words, at);
                    [shorts::<L>(a, b), shorts::<L>(c, d), shorts::<L>(e, f)]
                };
                let to = [&mut row.before, &mut row.here, &mut row.behind];
                for (to, sums) in to.into_iter().zip(sheets) {
                    for (to, sums) in to.iter_mut().zip(sums) {
                        L::store_floats(to[some.clone()].as_mut_ptr(), sums);
                    }
                }
            }
            for &at in &at[..n] {
                let now = now.add(N * at as usize);
                *old.add(at as usize) = *now;
                *now = [S::default(); 4];
            }
        }
    }

    /// The channels of pixels of two words: four 16-bit sums.
    #[inline(always)]
    unsafe fn shorts<L: Lanes>(a: L::Ints, b: L::Ints) -> [L::Ints; 4] {
        // SAFETY: the caller's.
        unsafe {
            let [low, high] = [a, b].map(|word| L::down(L::up(word, 16), 16));
            [low, L::down(a, 16), high, L::down(b, 16)]
        }
    }

    #[inline(always)]
    unsafe fn fours<L: Lanes>(row: &Row, to: &mut [[u32; 4]; LANES]) {
        let [r, g, b] = &row.light;
        for lanes in (0..LANES).step_by(L::LANES) {
            let some = lanes..lanes + L::LANES;
            // SAFETY: the caller's, and as many lanes begin at each.
            unsafe {
                let a = L::load(row.a[some.clone()].as_ptr().cast());
                let [r, g, b] = [r, g, b].map(|light| L::load(light[some.clone()].as_ptr()));
                L::store_fours(to[some].as_mut_ptr().cast(), [a, r, g, b]);
            }
        }
    }
}
