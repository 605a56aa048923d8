//! A bit for each voxel of a box.

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
    /// Marks the voxels of the box from `lo` to `hi` (exclusive) for which `marked` holds.
    pub(super) fn new(lo: [u32; 3], hi: [u32; 3], marked: impl Fn([u32; 3]) -> bool) -> Self {
        let size: [usize; 3] = std::array::from_fn(|a| (hi[a] - lo[a]) as usize);
        let words = size[0].div_ceil(64);
        let mut bits = vec![0u64; words * size[1] * size[2]];
        for (row, bits) in bits.chunks_mut(words).enumerate() {
            let (y, z) = (lo[1] + (row % size[1]) as u32, lo[2] + (row / size[1]) as u32);
            for x in 0..size[0] {
                bits[x / 64] |= u64::from(marked([lo[0] + x as u32, y, z])) << (x % 64);
            }
        }
        VoxelMask { lo, size, words, bits }
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
        // Rows along y, then layers along z: each is the union of its neighbours.
        for (n, stride) in [(self.size[1], 1), (self.size[2], self.size[1])] {
            let from = &self.bits;
            let mut to = vec![0u64; from.len()];
            for (row, to) in to.chunks_mut(words).enumerate() {
                let at = row / stride % n;
                let (first, last) =
                    (at.saturating_sub(steps as usize), (at + steps as usize).min(n - 1));
                for other in first..=last {
                    let other = (row + other * stride - at * stride) * words;
                    for (to, from) in to.iter_mut().zip(&from[other..other + words]) {
                        *to |= from;
                    }
                }
            }
            self.bits = to;
        }
        self
    }

    /// Returns whether a voxel of the box is marked, by its index in the volume.
    #[inline]
    pub(super) fn get(&self, voxel: [u32; 3]) -> bool {
        let [x, y, z]: [usize; 3] = std::array::from_fn(|a| (voxel[a] - self.lo[a]) as usize);
        let row = z * self.size[1] + y;
        self.bits[row * self.words + x / 64] >> (x % 64) & 1 == 1
    }
}
