//! Volume by formula for tests of large volumes: it has any size, and its samples are computed when
//! they are read, at every level.
//!
//! The formula `cells` has cells of 64^3 samples. Seven of eight cells are 0 throughout. Each other
//! cell has a value of its own; its samples are alternately 16 above and 16 below it, like a
//! chessboard in space. The mean of two samples along each axis is the cell's value. So levels 1 to
//! 6 are known without the finer ones; level 6 has one sample a cell. Levels after it are means of
//! level 6.

use super::mean::{halved, level_lattices};
use super::{BLOCK_EDGE, BlockSource, BlockSummaries, BlockSummary, ValueBins, block_dims};
use crate::error::{Problem, quoted};
use rayon::prelude::*;
use slabcast_common::volume::{
    Digest32, Lattice, SampleKind, Samples, ValueMap, ValueSummary, VolumeHasher, VolumeInfo,
};
use std::sync::Arc;

/// Levels at which a cell has more than one sample: 64 = 2^6.
const CELL_LEVELS: usize = 6;
/// Difference of a sample of level 0 from its cell's value.
const DETAIL: u8 = 16;
/// Most samples of level 0 for which the digest is computed from the samples; it takes 0.1 s.
const HASHED_MAX: u64 = 1 << 26;
/// Most cells. One byte of each is kept in memory.
const CELLS_MAX: u64 = 1 << 24;

/// The formula `cells` at all levels.
pub struct FormulaSource {
    name: String,
    levels: Vec<VolumeInfo>,
    /// Samples of level 6 and of each level after it. The first entry, the values of the cells, is
    /// there even if the volume has fewer levels.
    coarse: Vec<Samples>,
    /// Cells along each axis.
    cells: [u32; 3],
}

impl FormulaSource {
    /// Prefix of the names that [`FormulaSource::open`] takes; the size follows it.
    pub const PREFIX: &str = "formula:cells:";

    /// Parses a name such as `formula:cells:2048x2048x4096`; one number is the edge of a cube.
    ///
    /// The digest of a volume of at most 2^26 samples is computed from its samples. For larger
    /// ones, which would take seconds, it is a digest of the size and the formula's name.
    ///
    /// # Errors
    /// The size can't be parsed or has a zero, or there are more than 2^24 cells.
    pub fn open(text: &str) -> Result<FormulaSource, Problem> {
        let size = text.strip_prefix(Self::PREFIX).unwrap_or(text);
        let numbers: Result<Vec<u32>, _> = size.split('x').map(str::parse).collect();
        let dims = match numbers.as_deref() {
            Ok(&[n]) => Some([n; 3]),
            Ok(&[x, y, z]) => Some([x, y, z]),
            _ => None,
        };
        let fits = |dims: &[u32; 3]| {
            let cells = block_dims(*dims).iter().try_fold(1u64, |n, &d| n.checked_mul(d.into()));
            dims.iter().all(|&n| n > 0) && cells.is_some_and(|n| n <= CELLS_MAX)
        };
        let dims = dims.filter(fits).ok_or_else(|| {
            Problem::malformed(
                "size",
                format!("{} is not a size of `cells`", quoted(size)),
                format!("give N or AxBxC, of at most {CELLS_MAX} cells of 64^3 samples"),
            )
        })?;
        Ok(FormulaSource::new(text, dims))
    }

    fn new(name: &str, dims: [u32; 3]) -> FormulaSource {
        let lattices = level_lattices(&Lattice::from_spacing(dims, [1.0; 3]));
        let cells = block_dims(dims);
        let [cx, cy, _] = cells;
        let count: usize = cells.iter().map(|&n| n as usize).product();
        let value = |i: usize| {
            let (x, rest) = (i % cx as usize, i / cx as usize);
            cell_value([x, rest % cy as usize, rest / cy as usize].map(|n| n as u32))
        };
        let mut coarse = vec![Samples::U8((0..count).into_par_iter().map(value).collect())];
        for fine in lattices.iter().skip(CELL_LEVELS).take(lattices.len().saturating_sub(7)) {
            let last = coarse.last().expect("pushed before");
            coarse.push(halved(fine, fine.dims, last));
        }
        let mut source = FormulaSource { name: name.into(), levels: Vec::new(), coarse, cells };
        let summary = source.summary(dims);
        let finest_vox = lattices[0].vox();
        source.levels = (0..)
            .zip(&lattices)
            .map(|(level, lattice)| VolumeInfo {
                digest: Digest32::default(),
                lattice: *lattice,
                summary: summary.clone(),
                level,
                finest_vox,
            })
            .collect();
        for level in 0..source.levels.len() {
            source.levels[level].digest = source.digest(level);
        }
        source
    }

    /// Returns the code of a sample of level 0 of a volume of `dims` samples.
    pub fn sample(dims: [u32; 3], at: [u32; 3]) -> u8 {
        let value = cell_value(at.map(|n| n / BLOCK_EDGE));
        detailed(value, dims, at)
    }

    fn cell(&self, [x, y, z]: [u32; 3]) -> u8 {
        let [cx, cy, _] = self.cells.map(|n| n as usize);
        let Samples::U8(values) = &self.coarse[0] else { unreachable!("bytes") };
        values[(z as usize * cy + y as usize) * cx + x as usize]
    }

    fn summary(&self, dims: [u32; 3]) -> ValueSummary {
        let mut counts = vec![0u64; 256];
        let [cx, cy, cz] = self.cells;
        for z in 0..cz {
            for y in 0..cy {
                for x in 0..cx {
                    let side = |a: usize| (dims[a] - [x, y, z][a] * BLOCK_EDGE).min(BLOCK_EDGE);
                    let all: u64 = (0..3).map(|a| u64::from(side(a))).product();
                    let pairs = |a: usize| if dims[a] > 1 { side(a) & !1 } else { 1 };
                    let paired: u64 = (0..3).map(|a| u64::from(pairs(a))).product();
                    let value = usize::from(self.cell([x, y, z]));
                    let paired = if value == 0 || dims == [1; 3] { 0 } else { paired };
                    counts[value] += all - paired;
                    if paired > 0 {
                        counts[value + usize::from(DETAIL)] += paired / 2;
                        counts[value - usize::from(DETAIL)] += paired / 2;
                    }
                }
            }
        }
        ValueSummary::from_code_counts(SampleKind::U8, &counts, ValueMap::IDENTITY)
    }

    fn digest(&self, level: usize) -> Digest32 {
        let info = &self.levels[level];
        let [nx, ny, nz] = info.lattice.dims;
        let mut hasher = VolumeHasher::new(&info.lattice, ValueMap::IDENTITY, SampleKind::U8);
        let size = |l: &Lattice| l.dims.iter().map(|&n| u64::from(n)).product::<u64>();
        if size(&self.levels[0].lattice) > HASHED_MAX {
            hasher.update(b"formula cells");
            return info.finish(hasher);
        }
        for z in 0..nz {
            if let Samples::U8(plane) = self.computed(level, [0, 0, z], [nx, ny, z + 1]) {
                hasher.update(&plane);
            }
        }
        info.finish(hasher)
    }

    fn computed(&self, level: usize, lo: [u32; 3], hi: [u32; 3]) -> Samples {
        let dims = self.levels[level].lattice.dims;
        if level >= CELL_LEVELS {
            return super::copy_box(&self.coarse[level - CELL_LEVELS], dims, lo, hi);
        }
        let shift = CELL_LEVELS - level;
        let count = (0..3).map(|a| (hi[a] - lo[a]) as usize).product();
        let mut all = Vec::with_capacity(count);
        for z in lo[2]..hi[2] {
            for y in lo[1]..hi[1] {
                for x in lo[0]..hi[0] {
                    let value = self.cell([x, y, z].map(|n| n >> shift));
                    all.push(if level == 0 { detailed(value, dims, [x, y, z]) } else { value });
                }
            }
        }
        Samples::U8(all)
    }

    /// Returns the summary of one block of a level, at block position `at`.
    fn block(&self, level: usize, at: [u32; 3], bins: &ValueBins) -> BlockSummary {
        let dims = self.levels[level].lattice.dims;
        let lo = at.map(|n| n * BLOCK_EDGE);
        let hi: [u32; 3] = std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(dims[a]));
        if level == 0 {
            // A block of even sides has all its codes in a corner of two samples an edge. Odd ends
            // have samples without detail, so the whole block is computed.
            let size = |a: usize| hi[a] - lo[a];
            if (0..3).all(|a| dims[a] == 1 || size(a).is_multiple_of(2)) {
                let corner = std::array::from_fn(|a| lo[a] + size(a).min(2));
                return BlockSummary::of(&self.computed(0, lo, corner), bins);
            }
            return BlockSummary::of(&self.computed(0, lo, hi), bins);
        }
        if level >= CELL_LEVELS {
            return BlockSummary::of(&self.computed(level, lo, hi), bins);
        }
        let shift = CELL_LEVELS - level;
        let (first, last) = (lo.map(|n| n >> shift), hi.map(|n| (n - 1) >> shift));
        let after = std::array::from_fn(|a| last[a] + 1);
        BlockSummary::of(&super::copy_box(&self.coarse[0], self.cells, first, after), bins)
    }
}

impl BlockSource for FormulaSource {
    fn name(&self) -> &str {
        &self.name
    }

    fn file_type(&self) -> &str {
        "uint8"
    }

    fn levels(&self) -> &[VolumeInfo] {
        &self.levels
    }

    fn read_box(&self, level: usize, lo: [u32; 3], hi: [u32; 3]) -> Result<Samples, Problem> {
        let dims = self.levels[level].lattice.dims;
        assert!((0..3).all(|a| lo[a] < hi[a] && hi[a] <= dims[a]), "a box inside");
        Ok(self.computed(level, lo, hi))
    }

    fn summaries(&self, level: usize) -> Result<Arc<BlockSummaries>, Problem> {
        let info = &self.levels[level];
        let (dims, bins) = (block_dims(info.lattice.dims), ValueBins::of(&info.summary));
        let count: usize = dims.iter().map(|&n| n as usize).product();
        let [nx, ny, _] = dims.map(|n| n as usize);
        let of = |i: usize| {
            self.block(level, [i % nx, i / nx % ny, i / nx / ny].map(|n| n as u32), &bins)
        };
        let all = (0..count).into_par_iter().map(of).collect();
        Ok(Arc::new(BlockSummaries { dims, bins, all }))
    }

    fn memory_bytes(&self) -> u64 {
        self.coarse.iter().map(|level| (level.len() * level.kind().bytes()) as u64).sum()
    }
}

/// Returns the value of a cell: 0, or 40 to 199.
fn cell_value(cell: [u32; 3]) -> u8 {
    // SplitMix64 over the three numbers.
    let mix = |mut h: u64| {
        h = h.wrapping_add(0x9e37_79b9_7f4a_7c15);
        h = (h ^ h >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ h >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        h ^ h >> 31
    };
    let h = cell.iter().fold(0, |h, &n| mix(h ^ u64::from(n)));
    if h & 7 == 0 { 40 + ((h >> 8) % 160) as u8 } else { 0 }
}

/// Returns the sample of level 0 at `at`, in a cell of this value. A sample at an odd end, without
/// a neighbour in its pair, is the cell's value itself, so that every mean is the cell's value.
fn detailed(value: u8, dims: [u32; 3], at: [u32; 3]) -> u8 {
    let halved = |a: &usize| dims[*a] > 1;
    let paired = (0..3).filter(halved).all(|a| at[a] | 1 < dims[a]);
    if value == 0 || !paired || dims == [1; 3] {
        return value;
    }
    let odd = (0..3).filter(halved).fold(0, |odd, a| odd ^ at[a] & 1);
    if odd == 1 { value + DETAIL } else { value - DETAIL }
}
