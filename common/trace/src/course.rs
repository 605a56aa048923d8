//! How far a tile of a trace is, and where it stands still for want of bricks.
//!
//! A worker draws a tile's parts one after the other, each up to the first sheet that lacks a brick, and then puts the tile
//! away until what it asked for is there (`render::region`). A trace says when drawing came to each brick; so virtual
//! workers, and those that rehearse, go as far and ask as late as those that draw. It refuses to know who has which bricks
//! and what time it is.

use super::{FrameTrace, RegionTile};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::{parts, square_of};
use slabcast_common::view::Projected;

/// How far a tile's footprints reach beyond it on both sides together, in pixels: tiles of 32 pixels take 1.24 times what
/// those of 64 do (mri256 `peer-semi` at 1024x1024).
const BORDER: f64 = 8.2;

/// What sums of times are off by at most, in nanoseconds.
const ROUND: f64 = 0.5;

/// What a frame sees of the brick at a place of its set's list; `None`: nothing.
pub type Sees<'a> = &'a dyn Fn(u32) -> Option<Projected>;

/// Whether the brick at a place is here.
pub type Has<'a> = &'a dyn Fn(u32) -> bool;

/// A brick, when drawing comes to it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Need {
    /// Nanoseconds after its part was begun.
    at: f64,
    place: u32,
}

/// A part of a tile.
#[derive(Clone, Debug, PartialEq)]
struct Strand {
    rect: Rect,
    /// What it takes, and how much of that is done, in nanoseconds.
    ns: f64,
    done: f64,
    /// In the order of time.
    needs: Vec<Need>,
}

impl Strand {
    /// The first brick that is lacked.
    fn lacked(&self, has: Has<'_>) -> Option<&Need> {
        let past = self.needs.partition_point(|n| n.at < self.done);
        self.needs[past..].iter().find(|n| !has(n.place))
    }

    fn stop(&self, has: Has<'_>) -> f64 {
        self.lacked(has).map_or(self.ns, |n| n.at)
    }

    fn left(&self) -> f64 {
        self.ns - self.done
    }

    /// What of it lies in a piece of the tile, if anything, which takes so many times its share of the pixels.
    fn within(&self, piece: &Rect, more: f64, sees: Sees<'_>) -> Option<Strand> {
        let rect = self.rect.intersect(piece);
        if rect.is_empty() {
            return None;
        }
        let share = if rect == self.rect {
            more
        } else {
            more * rect.area() as f64 / self.rect.area() as f64
        };
        let over = |n: &&Need| {
            rect == self.rect || sees(n.place).is_some_and(|p| !p.rect.intersect(&rect).is_empty())
        };
        let needs = self.needs.iter().filter(over).map(|n| Need { at: share * n.at, ..*n });
        let needs = needs.collect();
        Some(Strand { rect, ns: share * self.ns, done: share * self.done, needs })
    }
}

/// A tile on its way through a frame that was traced.
#[derive(Clone, Debug, PartialEq)]
pub struct Course {
    strands: Vec<Strand>,
    /// The strand that is drawn now.
    at: usize,
}

/// How many times longer a piece takes than its share of a tile: it is drawn with a border of its own.
fn more(piece: &Rect, tile: &Rect) -> f64 {
    let border = |r: &Rect| (r.width() as f64 + BORDER) * (r.height() as f64 + BORDER);
    border(piece) / piece.area() as f64 * tile.area() as f64 / border(tile)
}

/// A traced tile of one part.
fn strand(rect: Rect, tile: &RegionTile) -> Strand {
    let ns = tile.ns as f64;
    let mut needs: Vec<Need> = (tile.touched.iter().enumerate())
        .map(|(i, &place)| {
            let part = f64::from(tile.needed.get(i).copied().unwrap_or(0)) / 1000.0;
            // Before its end: who is there has all that it was drawn from.
            Need { at: (part * ns).clamp(0.0, (ns - 1.0).max(0.0)), place }
        })
        .collect();
    needs.sort_by(|a, b| a.at.total_cmp(&b.at).then(a.place.cmp(&b.place)));
    Strand { rect, ns, done: 0.0, needs }
}

/// The sheet at which a brick begins; one that is not seen begins before all.
fn first_sheet(sees: Sees<'_>, place: u32) -> i32 {
    sees(place).map_or(i32::MIN, |p| p.sheets.first)
}

impl Course {
    /// A tile before its first sheet. `None`: the trace knows nothing of it. One that was not traced takes what the squares
    /// of the picture do that its parts lie in. `size` is the picture's.
    pub fn of(traced: &FrameTrace, tile: &Rect, size: [u32; 2], sees: Sees<'_>) -> Option<Course> {
        let whole = traced.region(tile, size);
        let part = |rect: Rect| {
            if let Some(known) = traced.region(&rect, size) {
                return Some(strand(rect, &known));
            }
            let square = square_of(&rect, size);
            let known = traced.region(&square, size)?;
            strand(square, &known).within(&rect, more(&rect, &square), sees)
        };
        let known: Option<Vec<Strand>> = parts(*tile).map(part).collect();
        let mut strands = match (known, &whole) {
            (Some(strands), _) => strands,
            // Only tiles of this edge were traced: when each brick is needed nobody knows.
            (None, Some(whole)) => vec![strand(*tile, whole)],
            (None, None) => return None,
        };
        if let (Some(whole), [_, _, ..]) = (&whole, &strands[..]) {
            let all: f64 = strands.iter().map(|s| s.ns).sum();
            let times = if all > 0.0 { whole.ns as f64 / all } else { 0.0 };
            for s in &mut strands {
                s.ns *= times;
                s.needs.iter_mut().for_each(|n| n.at *= times);
            }
        }
        Some(Course { strands, at: 0 })
    }

    /// A thread takes it: parts that stopped are gone on with.
    pub fn take(&mut self) {
        self.at = 0;
    }

    /// How long it goes from here without a brick that is not here, in nanoseconds.
    pub fn goes(&self, has: Has<'_>) -> f64 {
        self.strands[self.at..].iter().map(|s| s.stop(has) - s.done).sum()
    }

    /// It goes on for so many nanoseconds, or as far as it can.
    pub fn go(&mut self, ns: f64, has: Has<'_>) {
        let mut ns = ns;
        while let Some(s) = self.strands.get_mut(self.at) {
            let stop = s.stop(has);
            if ns + ROUND < stop - s.done {
                s.done += ns;
                return;
            }
            ns = (ns - (stop - s.done)).max(0.0);
            s.done = stop;
            if ns <= 0.0 {
                // What it stops for may come before the next part is begun.
                return;
            }
            self.at += 1;
        }
    }

    /// Whether it is at its end.
    pub fn is_over(&self) -> bool {
        self.strands.iter().all(|s| s.done >= s.ns)
    }

    /// What it lacks where its parts stand, and up to so many sheets beyond, each brick once.
    pub fn lacks(&self, has: Has<'_>, ahead: u32, sees: Sees<'_>) -> Vec<u32> {
        let mut lacks = Vec::new();
        let sheet = |n: &Need| first_sheet(sees, n.place);
        for s in self.strands.iter().filter(|s| s.done < s.ns) {
            let Some(first) = s.lacked(has).filter(|n| n.at <= s.done) else { continue };
            let until = sheet(first).saturating_add_unsigned(ahead);
            for n in s.needs.iter().filter(|n| n.at >= s.done && !has(n.place)) {
                if sheet(n) <= until && !lacks.contains(&n.place) {
                    lacks.push(n.place);
                }
            }
        }
        lacks
    }

    /// What it takes in all, and what is left of that, in nanoseconds.
    pub fn takes(&self) -> (f64, f64) {
        let sum = |of: fn(&Strand) -> f64| self.strands.iter().map(of).sum();
        (sum(|s| s.ns), sum(Strand::left))
    }

    /// What is left of it in a rectangle.
    pub fn left_in(&self, piece: &Rect) -> f64 {
        let share = |s: &Strand| {
            let both = s.rect.intersect(piece);
            let area = if both.is_empty() { 0 } else { both.area() };
            s.left() * area as f64 / s.rect.area() as f64
        };
        self.strands.iter().map(share).sum()
    }

    /// A piece of it, as it stands.
    pub fn piece(&self, tile: &Rect, piece: &Rect, sees: Sees<'_>) -> Course {
        let more = more(piece, tile);
        let now = self.strands.get(self.at).map(|s| s.rect);
        let strands: Vec<Strand> =
            self.strands.iter().filter_map(|s| s.within(piece, more, sees)).collect();
        let at = now.map_or(strands.len(), |now| {
            let later = |s: &Strand| (s.rect.y0, s.rect.x0) >= (now.y0, now.x0);
            strands.iter().position(later).unwrap_or(strands.len())
        });
        Course { strands, at }
    }

    /// The sheets before which a piece's parts stand; `None` of one at its end. `tile` is the piece.
    pub fn sheets(&self, tile: Rect, sees: Sees<'_>) -> Vec<Option<i32>> {
        let of = |part: Rect| {
            let s = self.strands.iter().find(|s| !s.rect.intersect(&part).is_empty())?;
            let next = s.needs.iter().find(|n| n.at >= s.done).or(s.needs.last());
            (s.done < s.ns).then(|| next.map_or(0, |n| first_sheet(sees, n.place)))
        };
        parts(tile).map(of).collect()
    }

    /// Places of the bricks that are still to come, ascending.
    pub fn needs(&self) -> Vec<u32> {
        let of = |s: &Strand| {
            let done = s.done;
            s.needs.iter().filter(move |n| n.at >= done).map(|n| n.place).collect::<Vec<_>>()
        };
        let mut places: Vec<u32> = self.strands.iter().flat_map(of).collect();
        places.sort_unstable();
        places.dedup();
        places
    }
}

#[cfg(test)]
mod tests {
    use super::super::RegionLevel;
    use super::*;
    use proptest::prelude::*;
    use slabcast_common::slab::SheetRange;
    use std::collections::BTreeSet;

    const SIZE: [u32; 2] = [128, 128];

    /// Brick `place` lies over the column of parts `place % 2`, `place` sheets deep, four sheets long.
    fn sees(place: u32) -> Option<Projected> {
        let x0 = place as i32 % 2 * 64;
        let sheets = SheetRange::new(place as i32, place as i32 + 4);
        Some(Projected { rect: Rect::new(x0, 0, x0 + 64, 128), sheets })
    }

    fn tile(x: u32, y: u32, ns: u64, touched: &[u32], needed: &[u16]) -> RegionTile {
        let (touched, needed) = (touched.to_vec(), needed.to_vec());
        RegionTile { x, y, ns, result_bytes: 9, touched, needed, ..RegionTile::default() }
    }

    /// Two parts to the left that take bricks 0, 4 and 20, two to the right that take 1 and 9.
    fn traced() -> FrameTrace {
        let left = |y| tile(0, y, 1000, &[0, 4, 20], &[0, 100, 700]);
        let right = |y| tile(64, y, 500, &[1, 9], &[0, 500]);
        let small = vec![left(0), right(0), left(64), right(64)];
        let large = vec![tile(0, 0, 6000, &[0, 1, 4, 9, 20], &[])];
        FrameTrace {
            view: String::new(),
            setup_ns: 0,
            alone_ns: 0,
            alone_edge: 64,
            slabs: vec![],
            outlook_ns: 0,
            block_ns: 0,
            regions: vec![
                RegionLevel { edge: 64, tiles: small },
                RegionLevel { edge: 128, tiles: large },
            ],
        }
    }

    fn course(tile: Rect) -> Course {
        Course::of(&traced(), &tile, SIZE, &sees).expect("it is traced")
    }

    const LEFT: Rect = Rect { x0: 0, y0: 0, x1: 64, y1: 64 };
    const ALL: Rect = Rect { x0: 0, y0: 0, x1: 128, y1: 128 };

    #[test]
    fn a_tile_goes_as_far_as_its_bricks_and_asks_a_few_sheets_ahead() {
        let mut c = course(LEFT);
        assert_eq!(c.lacks(&|_| false, 5, &sees), [0, 4], "20 is deeper");
        assert_eq!(
            (c.goes(&|_| false), c.goes(&|p| p == 0), c.goes(&|_| true)),
            (0.0, 100.0, 1000.0)
        );
        c.go(60.0, &|p| p == 0);
        assert_eq!(c.takes(), (1000.0, 940.0));
        assert_eq!(c.lacks(&|p| p == 0, 5, &sees), [0u32; 0], "it does not stand still");
        // The next one comes meanwhile.
        assert_eq!(c.goes(&|p| p < 9), 640.0);
        c.go(640.0, &|p| p < 9);
        assert!(!c.is_over());
        assert_eq!((c.lacks(&|p| p < 9, 5, &sees), c.needs()), (vec![20], vec![20]));
        assert_eq!(c.sheets(LEFT, &sees), [Some(20)]);
        c.take();
        c.go(f64::INFINITY, &|_| true);
        assert!(c.is_over());
        assert_eq!(c.sheets(LEFT, &sees), [None]);
    }

    #[test]
    fn parts_stop_each_by_itself_and_are_gone_on_with_when_it_is_taken_again() {
        let mut c = course(ALL);
        assert_eq!(c.takes(), (6000.0, 6000.0), "twice what its parts take");
        let has = |p: u32| p != 4;
        assert_eq!(c.goes(&has), 2.0 * (100.0 + 500.0 + 100.0 + 500.0));
        c.go(f64::INFINITY, &has);
        assert_eq!(c.lacks(&has, 5, &sees), [4], "once for both");
        assert_eq!(c.goes(&|_| true), 0.0, "that they could go on it finds when it is taken");
        c.take();
        assert_eq!(c.goes(&|_| true), 3600.0);
    }

    #[test]
    fn what_nobody_traced_takes_what_its_squares_say() {
        let mut only = traced();
        only.regions.remove(0);
        let c = Course::of(&only, &ALL, SIZE, &sees).expect("the tile itself is traced");
        assert_eq!(c.takes().0, 6000.0);
        assert_eq!(c.lacks(&|_| false, 5, &sees), [0, 1, 4], "all are needed at once");
        assert_eq!(Course::of(&only, &LEFT, SIZE, &sees), None);
        let half = course(Rect::new(0, 0, 64, 32));
        assert!((500.0..600.0).contains(&half.takes().0), "with a border of its own: {half:?}");
    }

    proptest! {
        /// Bricks come in any order, and some of what is left is given away.
        #[test]
        fn it_ends_whatever_comes_when(
            order in Just(vec![0u32, 1, 4, 9, 20]).prop_shuffle(), steps in prop::collection::vec(0.0..900.0f64, 5),
            cut in 1i32..7, across in any::<bool>(),
        ) {
            let mut c = course(ALL);
            let mut here = BTreeSet::new();
            let mut gone = 0.0;
            for (brick, step) in order.into_iter().zip(steps) {
                let has = |p: u32| here.contains(&p);
                let goes = c.goes(&has).min(step);
                c.go(goes, &has);
                gone += goes;
                let (all, left) = c.takes();
                prop_assert!((all - left - gone).abs() < 20.0, "{gone} of {all}, {left} left");
                if c.goes(&has) <= 0.0 {
                    c.take();
                    prop_assert!(c.goes(&has) > 0.0 || c.is_over() || !c.lacks(&has, 5, &sees).is_empty());
                }
                here.insert(brick);
            }
            let at = cut * 16;
            let (kept, given) = match across {
                true => (Rect::new(0, 0, 128, at), Rect::new(0, at, 128, 128)),
                false => (Rect::new(0, 0, at, 128), Rect::new(at, 0, 128, 128)),
            };
            let left = c.takes().1;
            prop_assert!((c.left_in(&kept) + c.left_in(&given) - left).abs() < 1.0);
            let pieces = [kept, given].map(|piece| c.piece(&ALL, &piece, &sees));
            let both: f64 = pieces.iter().map(|p| p.takes().1).sum();
            prop_assert!(both >= left * 0.99 && both <= left * 1.7 + 1.0, "{both} for {left}");
            for (mut piece, tile) in pieces.into_iter().zip([kept, given]) {
                prop_assert_eq!(piece.sheets(tile, &sees).len(), parts(tile).count());
                piece.take();
                piece.go(f64::INFINITY, &|_| true);
                prop_assert!(piece.is_over());
            }
        }
    }
}
