//! A bit for each voxel of a box.

use super::cut::RelevantVoxels;
use slabcast_common::brick::BRICK_EDGE;

/// A bit for each voxel of a box, in rows along x of whole words.
pub(super) struct VoxelMask {
    /// Corner of the box in the volume.
    lo: [u32; 3],
    /// Voxels along each axis.
    size: [usize; 3],
    /// Words of a row.
    words: usize,
    bits: Vec<u64>,
}

impl VoxelMask {
    /// Marks the voxels of the box from `lo` to `hi` (exclusive) whose codes are relevant. `row` gives
    /// the codes of a row along x, by the index of its first voxel.
    pub(super) fn new<'a, T: Copy + 'a>(
        lo: [u32; 3],
        hi: [u32; 3],
        row: impl Fn([u32; 3]) -> &'a [T],
        relevant: impl Fn(T) -> bool,
    ) -> Self {
        let size: [usize; 3] = std::array::from_fn(|a| (hi[a] - lo[a]) as usize);
        let words = size[0].div_ceil(64);
        let mut bits = vec![0u64; words * size[1] * size[2]];
        for (i, bits) in bits.chunks_mut(words).enumerate() {
            let first = [lo[0], lo[1] + (i % size[1]) as u32, lo[2] + (i / size[1]) as u32];
            for (word, codes) in bits.iter_mut().zip(row(first)[..size[0]].chunks(64)) {
                let bits = codes.iter().zip(0..).map(|(&code, x)| u64::from(relevant(code)) << x);
                *word = bits.fold(0, |word, bit| word | bit);
            }
        }
        VoxelMask { lo, size, words, bits }
    }

    /// Keeps the marks of voxels for which `inside` holds.
    pub(super) fn keep(&mut self, inside: impl Fn([u32; 3]) -> bool) {
        for (row, bits) in self.bits.chunks_mut(self.words).enumerate() {
            let y = self.lo[1] + (row % self.size[1]) as u32;
            let z = self.lo[2] + (row / self.size[1]) as u32;
            for (word, first) in bits.iter_mut().zip((self.lo[0]..).step_by(64)) {
                let marked = *word;
                for x in (0..64).filter(|x| marked >> x & 1 == 1) {
                    *word &= !(u64::from(!inside([first + x, y, z])) << x);
                }
            }
        }
    }

    /// Returns whether no voxel is marked.
    pub(super) fn is_empty(&self) -> bool {
        self.bits.iter().all(|&word| word == 0)
    }

    /// Returns the mask of voxels within `steps` index steps of a marked one along each axis.
    pub(super) fn dilated(mut self, steps: u32) -> Self {
        let words = self.words;
        for _ in 0..steps {
            for row in self.bits.chunks_mut(words) {
                let mut before = 0;
                for i in 0..words {
                    let (here, after) = (row[i], row.get(i + 1).copied().unwrap_or(0));
                    row[i] = here | here << 1 | before >> 63 | here >> 1 | after << 63;
                    before = here;
                }
            }
        }
        // Rows along y within their layer, then layers along z: each is the union of its neighbours.
        for (n, stride) in [(self.size[1], words), (self.size[2], words * self.size[1])] {
            let from = self.bits.clone();
            for (to, from) in self.bits.chunks_mut(n * stride).zip(from.chunks(n * stride)) {
                for far in (1..=(steps as usize).min(n - 1)).map(|step| step * stride) {
                    let len = to.len() - far;
                    let unite = |(to, from): (&mut u64, &u64)| *to |= from;
                    to[far..].iter_mut().zip(&from[..len]).for_each(unite);
                    to[..len].iter_mut().zip(&from[far..]).for_each(unite);
                }
            }
        }
        self
    }

    /// Adds the marked voxels of the brick at `corner`, which ends before `end`, to `found`. `offset`
    /// gives the offset of a voxel in the samples.
    pub(super) fn collect(
        &self,
        corner: [u32; 3],
        end: [u32; 3],
        offset: impl Fn([u32; 3]) -> usize,
        found: &mut RelevantVoxels,
    ) {
        // Marks spread beyond the end of a row, and a brick may lie across two words.
        let valid = (1u64 << (end[0] - corner[0])) - 1;
        debug_assert!(end[0] - corner[0] <= BRICK_EDGE);
        let at = (corner[0] - self.lo[0]) as usize;
        let (word, shift) = (at / 64, at % 64);
        for z in corner[2]..end[2] {
            for y in corner[1]..end[1] {
                let row = (z - self.lo[2]) as usize * self.size[1] + (y - self.lo[1]) as usize;
                let row = &self.bits[row * self.words..][..self.words];
                let beyond =
                    if shift == 0 { 0 } else { row.get(word + 1).map_or(0, |w| w << (64 - shift)) };
                let mut bits = (row[word] >> shift | beyond) & valid;
                if bits == 0 {
                    continue;
                }
                let (first, last) = (bits.trailing_zeros(), 63 - bits.leading_zeros());
                let local = (y - corner[1]) * 8 + (z - corner[2]) * 64;
                let start = offset([corner[0], y, z]);
                while bits != 0 {
                    let x = bits.trailing_zeros();
                    found.add((local + x) as u16, start + x as usize);
                    bits &= bits - 1;
                }
                found.reach([corner[0] + first, y, z], [corner[0] + last, y, z]);
            }
        }
    }
}
