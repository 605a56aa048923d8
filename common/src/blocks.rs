//! Neighbouring bricks in blocks, so that a query need not look at each brick of a volume.
//!
//! A block is a cube of the lattice and stands for its bricks by the box around theirs. What hides
//! that box hides the bricks: the pixels and sheets of its projection hold those of theirs
//! ([`crate::view::View::project`] grows with its box).

use crate::brick::{BrickInfo, TightBox};
use std::ops::Range;

/// Bricks grouped into blocks; each brick is in one.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Blocks {
    all: Vec<Block>,
    /// Places of bricks in the original list, block after block.
    places: Vec<u32>,
}

/// A block: neighbouring bricks, which a query looks at together before it looks at each.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Block {
    /// Box around the bricks' tight boxes, in index coordinates.
    pub tight: TightBox,
    /// Number of relevant voxels in all bricks of the block.
    pub voxels: u64,
    /// Bricks of the block, as a range of [`Blocks::places`].
    range: Range<usize>,
}

impl Blocks {
    /// Groups `bricks` into cubes of `2^shift` voxels an axis, doubling the edge until there are at
    /// most `most` blocks (or one).
    pub fn new(bricks: &[BrickInfo], shift: u32, most: usize) -> Blocks {
        let mut keyed: Vec<([u32; 3], u32)> = Vec::with_capacity(bricks.len());
        for shift in shift..32 {
            keyed.clear();
            let key = |b: &BrickInfo| b.tight.lo.map(|x| x >> shift);
            keyed.extend(bricks.iter().map(key).zip(0..));
            keyed.sort_unstable();
            let blocks = keyed.chunk_by(|a, b| a.0 == b.0);
            if blocks.clone().count() > most.max(1) && shift < 31 {
                continue;
            }
            let mut at = 0;
            let all = blocks
                .map(|members| {
                    let of = |m: &([u32; 3], u32)| &bricks[m.1 as usize];
                    let boxes = members.iter().map(|m| of(m).tight);
                    let tight = boxes.reduce(TightBox::union).expect("a block has a brick");
                    let voxels = members.iter().map(|m| u64::from(of(m).voxels)).sum();
                    let range = at..at + members.len();
                    at = range.end;
                    Block { tight, voxels, range }
                })
                .collect();
            return Blocks { all, places: keyed.iter().map(|k| k.1).collect() };
        }
        Blocks::default()
    }

    /// Returns all blocks, each with its box and its number of voxels.
    pub fn all(&self) -> &[Block] {
        &self.all
    }

    /// Returns the places of a block's bricks in the list given to [`Blocks::new`], ascending.
    pub fn places(&self, block: &Block) -> &[u32] {
        &self.places[block.range.clone()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::BrickId;
    use crate::quality::Quality;
    use crate::view::{Camera, CameraProjection, View};
    use crate::volume::Lattice;
    use glam::DVec3;
    use proptest::prelude::*;

    fn holds(outer: &TightBox, inner: &TightBox) -> bool {
        (0..3).all(|a| outer.lo[a] <= inner.lo[a] && inner.hi[a] <= outer.hi[a])
    }

    #[test]
    fn blocks_hold_each_brick_once_and_are_few() {
        let brick = |i: u32| {
            let lo = [i % 50 * 8, i / 50 % 50 * 8, i / 2500 * 8];
            let tight = TightBox { lo, hi: lo.map(|x| x + 7) };
            BrickInfo { id: BrickId(i), tight, voxels: 512, bytes: 99 }
        };
        let bricks: Vec<_> = (0..125_000).filter(|i| i % 3 > 0).map(brick).collect();
        let blocks = Blocks::new(&bricks, 5, 2048);
        let n = blocks.all().len();
        assert!(n <= 2048 && n > 2048 / 16, "{n}");
        let mut seen = vec![false; bricks.len()];
        for block in blocks.all() {
            let places = blocks.places(block);
            assert!(places.is_sorted());
            assert_eq!(block.voxels, 512 * places.len() as u64);
            for &place in places {
                assert!(holds(&block.tight, &bricks[place as usize].tight), "{place}");
                assert!(!std::mem::replace(&mut seen[place as usize], true), "{place} twice");
            }
        }
        assert!(seen.iter().all(|s| *s));
        assert_eq!(Blocks::new(&bricks, 5, 0).all().len(), 1);
        assert!(Blocks::new(&[], 5, 2048).all().is_empty());
    }

    proptest! {
        /// Pixels and sheets of a box hold those of every box in it, where the eye is inside, too.
        #[test]
        fn projection_of_a_block_holds_those_of_its_bricks(
            azimuth in 0.0..6.3f64, tilt in -2.0..2.0f64, d in 0.02..5.0f64,
            persp in any::<bool>(), near in 0.01..40.0f64, aniso in 1.0..4.0f64,
            target in prop::array::uniform3(-30.0..30.0f64), zoom in 0.2..60.0f64,
            boxes in prop::collection::vec(
                (prop::array::uniform3(0u32..56), prop::array::uniform3(0u32..8)), 1..9),
        ) {
            let l = Lattice::from_spacing([64; 3], [1.0, 1.0, aniso]);
            let projection = if persp {
                CameraProjection::Persp { fov: 40.0, distance: near }
            } else {
                CameraProjection::Ortho { height: zoom }
            };
            let to_eye = DVec3::new(libm::sin(azimuth), libm::cos(azimuth), tilt);
            let target = DVec3::from_array(target);
            let camera = Camera { to_eye, up: DVec3::Z, target, projection };
            let q = Quality { thickness: d, ..Quality::before() };
            let view = View::new(&l, &camera, [120, 100], &q).unwrap();
            let boxes = boxes.into_iter().map(|(lo, more)| {
                TightBox { lo, hi: std::array::from_fn(|a| lo[a] + more[a]) }
            });
            let boxes: Vec<TightBox> = boxes.collect();
            let around = boxes.iter().copied().reduce(TightBox::union).unwrap();
            let around = view.project(&around);
            for b in &boxes {
                let Some(own) = view.project(b) else { continue };
                let Some(around) = around else {
                    return Err(TestCaseError::fail("a visible box in an invisible one"));
                };
                prop_assert_eq!(own.rect.intersect(&around.rect), own.rect);
                prop_assert!(around.sheets.first <= own.sheets.first, "{:?} {:?}", around, own);
                prop_assert!(own.sheets.end <= around.sheets.end, "{:?} {:?}", around, own);
            }
        }
    }
}
