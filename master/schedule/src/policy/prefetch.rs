//! Bricks that workers will ask for, sent before they do.
//!
//! A region lacks three kinds of bricks: such as came out from behind others, which its worker expects by the depths at
//! which its pixels shut; such as nobody drew from yet; and such as its neighbours were drawn from in the frame before,
//! which have turned into it. Of the last kind no worker knows, since it is another's business what those were drawn
//! from. Here it is known. So
//!
//! - when a frame has begun, what was drawn from lately goes to those over whose tiles it lies now, once the frame's
//!   first leases have left ([`Outlook::lacked`]);
//! - and what is drawn from for the first time since goes to those over whose tiles of the frames in the making it lies,
//!   when they are told something anyway ([`Outlook::lacked_of`]).
//!
//! Where a block of bricks lies over one worker's tiles alone and that has what was drawn from, no brick is looked at
//! closer. For 11,056 bricks and 15 or 64 workers a frame
//! takes the master less with this than without, since workers ask half as much (docs/scaling.md).
//!
//! It refuses to know what a worker has: that is `residency`'s.

use crate::policy::macrotile::Cut;
use crate::state::residency::{Shelved, Shelves};
use slabcast_common::blocks::Blocks;
use slabcast_common::ids::WorkerId;
use slabcast_common::occlusion::Rect;

/// Whose tiles lie where in a frame's picture.
#[derive(Debug)]
pub(crate) struct Outlook {
    /// Edge of its cells as a power of two, and how many are in a row.
    shift: u32,
    columns: usize,
    /// Row-major: one more than the owner's place among the owners; 0 where nothing is drawn.
    cells: Vec<u16>,
    owners: Vec<WorkerId>,
}

impl Outlook {
    /// Of a picture of this size.
    pub(crate) fn new(size: [u32; 2], cut: &Cut, owner: impl Fn(u32) -> WorkerId) -> Outlook {
        let shift = cut.edge.ilog2();
        let [columns, rows] = size.map(|n| n.div_ceil(cut.edge) as usize);
        let mut look =
            Outlook { shift, columns, cells: vec![0; columns * rows], owners: Vec::new() };
        for (tile, place) in cut.tiles.iter().zip(0..) {
            let owner = owner(place);
            let known = look.owners.iter().position(|o| *o == owner);
            let at = known.unwrap_or_else(|| {
                look.owners.push(owner);
                look.owners.len() - 1
            });
            let mark = u16::try_from(at + 1).unwrap_or(0);
            for row in look.rows(&tile.rect) {
                look.cells[row].fill(mark);
            }
        }
        look
    }

    /// The cells that a rectangle of the picture lies over, row by row.
    #[inline]
    fn rows(&self, r: &Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let cell = |at: i32| at as usize >> self.shift;
        let (left, right) = (cell(r.x0), cell(r.x1 - 1) + 1);
        let columns = self.columns;
        (cell(r.y0)..=cell(r.y1 - 1)).map(move |y| y * columns + left..y * columns + right)
    }

    /// Places of the owners whose tiles a rectangle lies over, each once.
    #[inline]
    fn over(&self, r: &Rect, found: &mut Vec<usize>) {
        found.clear();
        let mut last = 0;
        for &mark in self.rows(r).flat_map(|row| &self.cells[row]) {
            // Of cells beside each other most are one worker's.
            if mark == last {
                continue;
            }
            last = mark;
            let at = usize::from(mark).wrapping_sub(1);
            if mark > 0 && !found.contains(&at) {
                found.push(at);
            }
        }
    }

    /// What each owner lacks of the bricks that were drawn from lately, as far as they lie over its tiles. `outlines`:
    /// where each block lies in the picture, empty where it does not; `outline`: where the brick at a place does.
    pub(crate) fn lacked(
        &self,
        shelves: &Shelves,
        (blocks, outlines): (&Blocks, &[Rect]),
        outline: impl Fn(u32) -> Option<Rect>,
    ) -> Vec<(WorkerId, Vec<u32>)> {
        let mut lists = self.lists();
        let places: Vec<_> = self.owners.iter().map(|o| shelves.of(*o)).collect();
        let (mut over, mut exactly) = (Vec::new(), Vec::new());
        for (block, rect) in blocks.all().iter().zip(outlines) {
            if rect.is_empty() {
                continue;
            }
            self.over(rect, &mut over);
            for &place in blocks.places(block) {
                if !shelves.is_late(place) {
                    continue;
                }
                // What lies over one worker's tiles alone, it has mostly drawn from.
                if let [at] = over[..]
                    && !lacks(places[at], place)
                {
                    continue;
                }
                let Some(rect) = outline(place) else { continue };
                self.over(&rect, &mut exactly);
                for &at in &exactly {
                    if lacks(places[at], place) {
                        lists[at].1.push(place);
                    }
                }
            }
        }
        lists.retain(|l| !l.1.is_empty());
        lists
    }

    /// What each owner lacks of these bricks, as far as they lie over its tiles.
    pub(crate) fn lacked_of(
        &self,
        shelves: &Shelves,
        bricks: &[u32],
        outline: impl Fn(u32) -> Option<Rect>,
    ) -> Vec<(WorkerId, Vec<u32>)> {
        let mut lists = self.lists();
        let mut over = Vec::new();
        for &place in bricks {
            let Some(rect) = outline(place) else { continue };
            self.over(&rect, &mut over);
            for &at in &over {
                if lacks(shelves.of(self.owners[at]), place) {
                    lists[at].1.push(place);
                }
            }
        }
        lists.retain(|l| !l.1.is_empty());
        lists
    }

    fn lists(&self) -> Vec<(WorkerId, Vec<u32>)> {
        self.owners.iter().map(|o| (*o, Vec::new())).collect()
    }
}

/// Whether a worker lacks a brick. Who has none of the set lacks all.
fn lacks(shelved: Option<Shelved<'_>>, place: u32) -> bool {
    shelved.is_none_or(|shelved| shelved.lacks(place))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::macrotile::cut_through;
    use crate::state::residency::Residency;
    use proptest::prelude::*;
    use slabcast_common::brick::{BRICK, BrickInfo, BrickSetKey, TightBox};
    use slabcast_common::ids::BrickId;
    use slabcast_common::quality::Quality;
    use slabcast_common::view::{Camera, CameraProjection, View};
    use slabcast_common::volume::{Digest32, Volume};
    use std::collections::BTreeSet;
    use std::sync::Arc;

    const KEY: BrickSetKey = BrickSetKey(Digest32([3; 32]));
    const SIZE: [u32; 2] = [200, 136];

    /// The bricks of a cube of 32 voxels.
    fn bricks() -> Arc<[BrickInfo]> {
        let brick = |i: u32| {
            let lo = [i % 4, i / 4 % 4, i / 16].map(|x| x * BRICK);
            let tight = TightBox { lo, hi: lo.map(|x| x + BRICK - 1) };
            BrickInfo { id: BrickId(i), tight, voxels: 512, bytes: 100 }
        };
        (0..64).map(brick).collect()
    }

    fn view(azimuth: f64, projection: CameraProjection) -> View {
        let lattice = Volume::from_fn_u8("v", [32; 3], |_, _, _| 0).lattice;
        let camera = Camera {
            to_eye: [azimuth.sin(), azimuth.cos(), 0.2].into(),
            up: [0.0, 0.0, 1.0].into(),
            target: [0.0; 3].into(),
            projection,
        };
        View::new(&lattice, &camera, SIZE, &Quality::default()).expect("a view")
    }

    type Lists = BTreeSet<(WorkerId, u32)>;

    fn flat(lists: Vec<(WorkerId, Vec<u32>)>) -> Lists {
        let all: Vec<_> = lists
            .into_iter()
            .flat_map(|(id, list)| list.into_iter().map(move |p| (id, p)))
            .collect();
        let flat: Lists = all.iter().copied().collect();
        assert_eq!(flat.len(), all.len(), "nobody is sent a brick twice");
        flat
    }

    proptest! {
        /// Each brick goes to all who lack it and over whose tiles it lies, and to nobody else.
        #[test]
        fn what_lies_over_whose_tiles_is_what_it_is_worked_out_by_hand(
            azimuth in 0.0..6.3f64,
            persp in any::<bool>(),
            height in 20.0..90.0f64,
            edge in prop::sample::select(vec![32u32, 64, 128]),
            owners in prop::collection::vec(0u64..4, 40),
            held in prop::collection::vec((0u64..3, 0u32..64), 0..150),
            drawn in prop::collection::vec((0u32..64, 0usize..3), 0..90),
            alone in any::<bool>(),
        ) {
            let bricks = bricks();
            let projection = match persp {
                true => CameraProjection::Persp { fov: 60.0, distance: 40.0 },
                false => CameraProjection::Ortho { height },
            };
            let view = view(azimuth, projection);
            let mut r = Residency::default();
            // The fourth has nothing of the set.
            for id in 0..3 {
                let has = |h: &&(u64, u32)| h.0 == id;
                let held: Vec<_> = held.iter().filter(has).map(|h| BrickId(h.1)).collect();
                r.join(WorkerId(id), u64::MAX, vec![(KEY, held)]);
            }
            let mut last = [None; 64];
            for round in 0..3 {
                r.open(KEY, &bricks, true);
                let drawn: Vec<u32> = drawn.iter().filter(|d| d.1 == round).map(|d| d.0).collect();
                r.touched(KEY, &drawn, &mut Vec::new());
                drawn.iter().for_each(|&place| last[place as usize] = Some(round));
            }
            r.open(KEY, &bricks, true);
            let outline = |place: u32| view.outline(&bricks[place as usize].tight);
            let rects: Vec<Rect> = (0..64).filter_map(outline).collect();
            let cut = cut_through(SIZE, &rects, (0, 0), Some(edge));
            let owner = |place: u32| WorkerId(owners[place as usize % owners.len()]);
            let look = Outlook::new(SIZE, &cut, owner);
            let shelves = r.shelves(KEY, alone).expect("it is open");

            let owes = |place: u32| -> Lists {
                let Some(rect) = outline(place) else { return Lists::new() };
                let over = cut.tiles.iter().zip(0..).filter(|(t, _)| !t.rect.intersect(&rect).is_empty());
                let whose = over.map(|(_, tile)| owner(tile));
                whose.filter(|id| !held.contains(&(id.0, place))).map(|id| (id, place)).collect()
            };
            let first = if alone { 2 } else { 1 };
            let lately = (0..64).filter(|p| last[*p as usize].is_some_and(|round| round >= first));
            let by_hand: Lists = lately.flat_map(owes).collect();
            for shift in [3, 4, 5] {
                let blocks = Blocks::of(&bricks, shift, 64);
                let lies = |b: &slabcast_common::blocks::Block| view.outline(&b.tight).unwrap_or_default();
                let outlines: Vec<Rect> = blocks.all().iter().map(lies).collect();
                let lists = look.lacked(&shelves, (&blocks, &outlines), outline);
                prop_assert_eq!(&flat(lists), &by_hand, "blocks of 2^{}", shift);
            }
            let some = [1, 5, 40, 63];
            let by_hand: Lists = some.into_iter().flat_map(owes).collect();
            prop_assert_eq!(flat(look.lacked_of(&shelves, &some, outline)), by_hand);
        }
    }
}
