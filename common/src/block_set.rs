//! Sets of blocks of a volume: cubes of [`BLOCK_EDGE`] samples.
//!
//! The master decides block by block which part of a large volume a picture needs. A block outside
//! the picture, or whose values the transfer function does not show, is neither read nor cut into
//! bricks.

use crate::brick::TightBox;
use crate::view::View;

/// Edge of a block in samples: eight bricks.
pub const BLOCK_EDGE: u32 = 64;

/// Blocks along each axis of a group. A group that misses the picture is skipped as a whole.
const GROUP: u32 = 8;

/// Returns the number of blocks along each axis of a volume of `dims` samples.
pub fn block_dims(dims: [u32; 3]) -> [u32; 3] {
    dims.map(|n| n.div_ceil(BLOCK_EDGE))
}

/// A set of blocks of one volume. Blocks are numbered i fastest.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BlockSet {
    /// Samples of the volume along each axis.
    dims: [u32; 3],
    bits: Vec<u64>,
}

impl BlockSet {
    /// Returns an empty set of blocks of a volume of `dims` samples.
    pub fn new(dims: [u32; 3]) -> BlockSet {
        let count: usize = block_dims(dims).iter().map(|&n| n as usize).product();
        BlockSet { dims, bits: vec![0; count.div_ceil(64)] }
    }

    /// Returns whether a block is in the set, by its number.
    pub fn contains(&self, block: usize) -> bool {
        self.bits[block / 64] >> (block % 64) & 1 == 1
    }

    /// Adds a block, by its number.
    pub fn insert(&mut self, block: usize) {
        self.bits[block / 64] |= 1 << (block % 64);
    }

    /// Returns the number of blocks in the set.
    pub fn len(&self) -> usize {
        self.bits.iter().map(|word| word.count_ones() as usize).sum()
    }

    /// Returns whether the set has no block.
    pub fn is_empty(&self) -> bool {
        self.bits.iter().all(|&word| word == 0)
    }

    /// Returns a bit for each block, in words of 64. Two sets of one volume are equal if their
    /// words are.
    pub fn words(&self) -> &[u64] {
        &self.bits
    }

    /// Adds the blocks with a voxel that may touch the picture of `view`.
    pub fn add_visible(&mut self, view: &View) {
        let dims = block_dims(self.dims);
        let box_of = |lo: [u32; 3], edge: u32| TightBox {
            lo: lo.map(|n| n * BLOCK_EDGE),
            hi: std::array::from_fn(|a| ((lo[a] + edge) * BLOCK_EDGE).min(self.dims[a]) - 1),
        };
        let mut seen = Vec::new();
        for group in boxes([0; 3], dims, GROUP) {
            if view.project(&box_of(group, GROUP)).is_none() {
                continue;
            }
            let end = std::array::from_fn(|a| (group[a] + GROUP).min(dims[a]));
            seen.extend(boxes(group, end, 1).filter_map(|[x, y, z]| {
                let block = ((z as usize * dims[1] as usize) + y as usize) * dims[0] as usize;
                let block = block + x as usize;
                let is_new = !self.contains(block) && view.project(&box_of([x, y, z], 1)).is_some();
                is_new.then_some(block)
            }));
        }
        seen.into_iter().for_each(|block| self.insert(block));
    }
}

/// Returns the corners from `lo` to `hi` (exclusive) in steps along each axis, i fastest.
fn boxes(lo: [u32; 3], hi: [u32; 3], step: u32) -> impl Iterator<Item = [u32; 3]> {
    let steps = move |a: usize| (lo[a]..hi[a]).step_by(step as usize);
    steps(2).flat_map(move |z| steps(1).flat_map(move |y| steps(0).map(move |x| [x, y, z])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::quality::Quality;
    use crate::view::{Camera, CameraProjection};
    use crate::volume::Lattice;
    use glam::DVec3;

    #[test]
    fn visible_blocks_are_those_whose_box_projects_into_the_picture() {
        let lattice = Lattice::from_spacing([1300, 200, 650], [1.0, 0.5, 1.0]);
        let dims = block_dims(lattice.dims);
        for (height, at) in [(4000.0, 0.0), (150.0, 0.0), (150.0, 0.7), (40.0, 2.1)] {
            let camera = Camera {
                target: DVec3::new(170.0, 0.0, 40.0),
                to_eye: DVec3::new(libm::sin(at), libm::cos(at), 0.3),
                up: DVec3::Z,
                projection: CameraProjection::Ortho { height },
            };
            let view = View::new(&lattice, &camera, [64, 64], &Quality::default()).expect("a view");
            let mut set = BlockSet::new(lattice.dims);
            set.add_visible(&view);
            let count: usize = dims.iter().map(|&n| n as usize).product();
            for block in 0..count {
                let [nx, ny, _] = dims.map(|n| n as usize);
                let lo = [block % nx, block / nx % ny, block / nx / ny].map(|n| n as u32 * 64);
                let hi = std::array::from_fn(|a| (lo[a] + 64).min(lattice.dims[a]) - 1);
                let is_visible = view.project(&TightBox { lo, hi }).is_some();
                assert_eq!(set.contains(block), is_visible, "block {block} at height {height}");
            }
            // Even in a view of the whole volume, a few blocks touch no pixel's centre.
            let is_most = 10 * set.len() > 9 * count;
            assert!(!set.is_empty() && (height > 1000.0) == is_most, "{}", set.len());
            let before = set.clone();
            set.add_visible(&view);
            assert_eq!(set, before);
        }
    }
}
