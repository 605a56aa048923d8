//! Survey of a level: one pass that finds its digest, the counts of its values, and the bins that
//! each block holds.

use super::memory::copy_box;
use super::{BLOCK_EDGE, BlockSummaries, BlockSummary, ValueBins, block_dims};
use crate::error::Problem;
use crate::samples::reserve;
use rayon::prelude::*;
use slabcast_common::volume::{
    CoarseLevel, Digest32, Lattice, SampleKind, Samples, ValueMap, ValueSummary, VolumeHasher,
};
use std::sync::{Mutex, PoisonError};

/// Most bytes for the sets of 16-bit codes that blocks hold. A block of noise takes 8 KiB, a block
/// of a scan some 500 bytes.
const WORDS_MAX_BYTES: usize = 64 << 20;

/// Counts of the values of level 0.
pub(crate) enum Counter {
    /// One count for each code of 8 or 16 bits.
    Codes { kind: SampleKind, counts: Vec<u64> },
    /// Histogram of floats between the smallest and the largest code.
    Floats { summary: ValueSummary },
}

impl Counter {
    /// Returns an empty counter. `range` is the smallest and the largest finite code; only floats
    /// need it.
    pub(crate) fn new(kind: SampleKind, map: ValueMap, range: (f64, f64)) -> Counter {
        match kind {
            SampleKind::F32 => Counter::Floats {
                summary: ValueSummary {
                    kind,
                    map,
                    min_code: range.0,
                    max_code: range.1,
                    histogram: vec![0; 256],
                    nan: 0,
                    infinite: 0,
                    anatomical: false,
                    core: None,
                    palette: None,
                },
            },
            _ => Counter::Codes { kind, counts: vec![0; 1 << (8 * kind.bytes())] },
        }
    }

    fn add_floats(&mut self, part: &FloatCounts) {
        if let Counter::Floats { summary } = self {
            summary.histogram.iter_mut().zip(&part.histogram).for_each(|(all, n)| *all += n);
            summary.nan += part.nan;
            summary.infinite += part.infinite;
        }
    }

    /// Returns the summary of all values that were counted. `recount` counts the finite codes
    /// between two codes in another pass, for [`ValueSummary::find_core`].
    pub(crate) fn summary(
        self,
        map: ValueMap,
        anatomical: bool,
        recount: impl FnMut(f64, f64) -> Result<Vec<u64>, Problem>,
    ) -> Result<ValueSummary, Problem> {
        let summary = match self {
            Counter::Codes { kind, counts } => ValueSummary::from_code_counts(kind, &counts, map),
            Counter::Floats { mut summary } => {
                summary.find_core(recount)?;
                summary
            }
        };
        Ok(ValueSummary { anatomical, ..summary })
    }
}

/// Adds the finite codes of a piece to `histogram`, in the bins of [`ValueSummary::core_bin`]
/// between two codes.
pub(crate) fn count_between(codes: &Samples, lo: f64, hi: f64, histogram: &mut [u64]) {
    let mut count = |code: f64| histogram[ValueSummary::core_bin(code, lo, hi)] += 1;
    match codes {
        Samples::U8(v) => v.iter().for_each(|&c| count(c.into())),
        Samples::U16(v) => v.iter().for_each(|&c| count(c.into())),
        Samples::F32(v) => v.iter().filter(|c| c.is_finite()).for_each(|&c| count(c.into())),
    }
}

struct FloatCounts {
    histogram: [u64; 256],
    nan: u64,
    infinite: u64,
}

/// Set of the codes that a block holds, kept until the bins are known.
enum Held {
    /// 8-bit codes: one bit for each.
    Bytes([u64; 4]),
    /// 16-bit codes: one bit for each, beginning with code 64 `first`.
    Words { first: u16, bits: Box<[u64]> },
    /// Floats: their summary in the guessed bins.
    Floats(BlockSummary),
}

/// Scratch memory of a thread that looks at blocks.
pub(crate) struct Scratch(Vec<u32>);

impl Scratch {
    pub(crate) fn new() -> Scratch {
        Scratch(Vec::new())
    }
}

/// Survey of a level in progress. Slabs of 64 planes are added in order.
pub(crate) struct Survey {
    lattice: Lattice,
    hasher: VolumeHasher,
    /// Blocks seen so far, i fastest; `None` once they take too much memory.
    held: Option<Vec<Held>>,
    words_bytes: usize,
    guess: ValueBins,
    counter: Option<Mutex<Counter>>,
}

/// Result of the survey of a level.
pub(crate) struct Surveyed {
    hasher: VolumeHasher,
    held: Option<Vec<Held>>,
    guess: ValueBins,
    dims: [u32; 3],
    counter: Option<Counter>,
}

impl Survey {
    /// Begins the survey of a level on `lattice`. `guess` are the likely bins of floats. Level 0
    /// has a counter.
    pub(crate) fn new(
        lattice: Lattice,
        (map, kind): (ValueMap, SampleKind),
        guess: ValueBins,
        counter: Option<Counter>,
    ) -> Survey {
        Survey {
            lattice,
            hasher: VolumeHasher::new(&lattice, map, kind),
            held: Some(Vec::new()),
            words_bytes: 0,
            guess,
            counter: counter.map(Mutex::new),
        }
    }

    /// Surveys the next slab of the level: 64 planes, or the rest.
    ///
    /// Calls `beside` with the box of each block within the slab and its samples, on several
    /// threads. Then calls `take` with the results of each square of [`SQUARE`] x `SQUARE` blocks:
    /// the square's position, and the results, i fastest.
    ///
    /// # Errors
    /// `take` returned an error, or memory ran out.
    pub(crate) fn slab<T: Send>(
        &mut self,
        codes: &Samples,
        beside: impl Fn([u32; 3], [u32; 3], Samples) -> T + Sync,
        mut take: impl FnMut([u32; 2], Vec<T>) -> Result<(), Problem> + Send,
    ) -> Result<(), Problem> {
        let [nx, ny, _] = self.lattice.dims;
        let planes = (codes.len() / (nx as usize * ny as usize)) as u32;
        let dims = [nx, ny, planes];
        let grid = block_dims(dims);
        let Survey { hasher, guess, counter, .. } = self;
        let look = |cell: [u32; 2], scratch: &mut Scratch| {
            let lo = [cell[0] * BLOCK_EDGE, cell[1] * BLOCK_EDGE, 0];
            let hi = std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(dims[a]));
            let part = copy_box(codes, dims, lo, hi);
            let held = held(&part, guess, counter.as_ref(), scratch);
            (held, beside(lo, hi, part))
        };
        let mut all: Vec<Option<Held>> = Vec::new();
        all.resize_with(grid[0] as usize * grid[1] as usize, || None);
        let blocks = || -> Result<(), Problem> {
            // One square at a time, so that few results are in memory.
            for y in (0..grid[1]).step_by(SQUARE as usize) {
                for x in (0..grid[0]).step_by(SQUARE as usize) {
                    let (w, h) = (SQUARE.min(grid[0] - x), SQUARE.min(grid[1] - y));
                    let cell = |n: u32| [x + n % w, y + n / w];
                    let found: Vec<(Held, T)> = (0..w * h)
                        .into_par_iter()
                        .map_init(Scratch::new, |scratch, n| look(cell(n), scratch))
                        .collect();
                    let mut given = Vec::with_capacity(found.len());
                    for (n, (held, of_block)) in (0..).zip(found) {
                        let [x, y] = cell(n);
                        all[(y * grid[0] + x) as usize] = Some(held);
                        given.push(of_block);
                    }
                    take([x / SQUARE, y / SQUARE], given)?;
                }
            }
            Ok(())
        };
        let ((), done) = rayon::join(|| hash(hasher, codes), blocks);
        done?;
        self.words_bytes += all
            .iter()
            .map(|held| match held {
                Some(Held::Words { bits, .. }) => 8 * bits.len(),
                _ => 0,
            })
            .sum::<usize>();
        if self.words_bytes > WORDS_MAX_BYTES {
            self.held = None;
        }
        if let Some(held) = &mut self.held {
            reserve_more(held, all.len())?;
            held.extend(all.into_iter().flatten());
        }
        Ok(())
    }

    /// Ends the survey after the last slab.
    pub(crate) fn finish(self) -> Surveyed {
        Surveyed {
            hasher: self.hasher,
            held: self.held,
            guess: self.guess,
            dims: block_dims(self.lattice.dims),
            counter: self.counter.map(|c| c.into_inner().unwrap_or_else(PoisonError::into_inner)),
        }
    }
}

/// Blocks along an edge of a square of results, and of a shard.
pub(crate) const SQUARE: u32 = 8;

fn reserve_more<T>(to: &mut Vec<T>, more: usize) -> Result<(), Problem> {
    if to.capacity() - to.len() < more {
        let room = more.max(to.len());
        reserve(to, room)?;
    }
    Ok(())
}

impl Surveyed {
    /// Returns the digest of the level, number `level` of its volume. `finest_vox` and `summary`
    /// are the vox and the summary of level 0.
    pub(crate) fn digest(&self, level: u32, finest_vox: f64, summary: &ValueSummary) -> Digest32 {
        let hasher = self.hasher.clone();
        match level {
            0 => hasher.finish(),
            _ => hasher.finish_level(&CoarseLevel { level, finest_vox }, summary),
        }
    }

    /// Takes the counter of level 0; `None` for other levels and after the first call.
    pub(crate) fn take_counter(&mut self) -> Option<Counter> {
        self.counter.take()
    }

    /// Returns the block summaries in `bins`. `None` if floats were put into other, guessed bins,
    /// or the sets of codes took too much memory.
    pub(crate) fn blocks(&self, bins: ValueBins) -> Option<BlockSummaries> {
        let table: Vec<u8> = match self.held.as_ref()?.first() {
            Some(Held::Bytes(_)) => (0..256).map(|c| bins.bin(c.into()) as u8).collect(),
            Some(Held::Words { .. }) => (0..65536).map(|c| bins.bin(c.into()) as u8).collect(),
            _ if bins == self.guess => Vec::new(),
            _ => return None,
        };
        let of = |held: &Held| {
            let mut mask = 0;
            let mut set = |first: usize, words: &[u64]| {
                for (i, word) in words.iter().enumerate() {
                    let mut left = *word;
                    while left != 0 {
                        let code = 64 * (first + i) + left.trailing_zeros() as usize;
                        mask |= 1 << table[code];
                        left &= left - 1;
                    }
                }
            };
            match held {
                Held::Bytes(bits) => set(0, bits),
                Held::Words { first, bits } => set((*first).into(), bits),
                Held::Floats(summary) => return *summary,
            }
            BlockSummary { bins: mask, nan: false }
        };
        let all = self.held.as_ref()?.iter().map(of).collect();
        Some(BlockSummaries { dims: self.dims, bins, all })
    }
}

fn held(
    samples: &Samples,
    guess: &ValueBins,
    counter: Option<&Mutex<Counter>>,
    scratch: &mut Scratch,
) -> Held {
    let lock = |c: &Mutex<Counter>, add: &dyn Fn(&mut Counter)| {
        add(&mut c.lock().unwrap_or_else(PoisonError::into_inner));
    };
    match samples {
        Samples::U8(v) => {
            // Four tables, since in a run of equal codes (air) each count would wait for the one
            // before.
            let mut tables = [[0u32; 256]; 4];
            let mut fours = v.chunks_exact(4);
            for four in &mut fours {
                for (table, &c) in tables.iter_mut().zip(four) {
                    table[usize::from(c)] += 1;
                }
            }
            fours.remainder().iter().for_each(|&c| tables[0][usize::from(c)] += 1);
            let count = |c: usize| tables.iter().map(|t| u64::from(t[c])).sum::<u64>();
            let mut bits = [0u64; 4];
            (0..256).filter(|&c| count(c) > 0).for_each(|c| bits[c / 64] |= 1 << (c % 64));
            if let Some(counter) = counter {
                lock(counter, &|all| {
                    if let Counter::Codes { counts, .. } = all {
                        (0..256).for_each(|c| counts[c] += count(c));
                    }
                });
            }
            Held::Bytes(bits)
        }
        Samples::U16(v) => {
            let counts = &mut scratch.0;
            counts.resize(2 << 16, 0);
            let mut pairs = v.chunks_exact(2);
            for pair in &mut pairs {
                counts[2 * usize::from(pair[0])] += 1;
                counts[2 * usize::from(pair[1]) + 1] += 1;
            }
            pairs.remainder().iter().for_each(|&c| counts[2 * usize::from(c)] += 1);
            let (lo, hi) = v.iter().fold((u16::MAX, 0), |(lo, hi), &c| (lo.min(c), hi.max(c)));
            let (first, last) = (usize::from(lo) / 64, usize::from(hi.max(lo)) / 64);
            let mut bits = vec![0u64; last - first + 1].into_boxed_slice();
            let all = &counts[128 * first..128 * (last + 1)];
            for (c, n) in all.chunks_exact(2).enumerate() {
                if n[0] + n[1] > 0 {
                    bits[c / 64] |= 1 << (c % 64);
                }
            }
            if let Some(counter) = counter {
                lock(counter, &|to| {
                    if let Counter::Codes { counts, .. } = to {
                        let to = counts[64 * first..].iter_mut();
                        to.zip(all.chunks_exact(2))
                            .for_each(|(to, n)| *to += u64::from(n[0]) + u64::from(n[1]));
                    }
                });
            }
            counts[128 * first..128 * (last + 1)].fill(0);
            Held::Words { first: first as u16, bits }
        }
        Samples::F32(v) => {
            let Some(counter) = counter else {
                return Held::Floats(BlockSummary::of(samples, guess));
            };
            let summary = match &*counter.lock().unwrap_or_else(PoisonError::into_inner) {
                Counter::Floats { summary } => {
                    ValueSummary { histogram: Vec::new(), core: None, ..summary.clone() }
                }
                Counter::Codes { .. } => return Held::Floats(BlockSummary::of(samples, guess)),
            };
            let mut found = FloatCounts { histogram: [0; 256], nan: 0, infinite: 0 };
            for &c in v {
                if c.is_finite() {
                    found.histogram[summary.bin(c.into())] += 1;
                } else if c.is_nan() {
                    found.nan += 1;
                } else {
                    found.infinite += 1;
                }
            }
            lock(counter, &|all| all.add_floats(&found));
            Held::Floats(BlockSummary::of(samples, guess))
        }
    }
}

/// Adds samples to a digest.
fn hash(hasher: &mut VolumeHasher, codes: &Samples) {
    let mut bytes = Vec::new();
    macro_rules! words {
        ($v:expr, $size:literal) => {
            for part in $v.chunks(1 << 15) {
                bytes.resize($size * part.len(), 0);
                let words = bytes.chunks_exact_mut($size).zip(part);
                words.for_each(|(to, c)| to.copy_from_slice(&c.to_le_bytes()));
                hasher.update(&bytes);
            }
        };
    }
    match codes {
        Samples::U8(v) => hasher.update(v),
        Samples::U16(v) => words!(v, 2),
        Samples::F32(v) => words!(v, 4),
    }
}
