//! A region's parts, where a region is cut of which others are to draw a piece, and how far ahead one looks that lacks
//! bricks.
//!
//! A tile is drawn in parts, squares of the picture of [`PART`] pixels, one after the other through all sheets. What
//! is left of it when somebody else has time are parts that nobody came to yet, and a part that is some
//! sheets deep. A cut is one straight line, so that both pieces are rectangles; it lies between leaves of 16x16
//! pixels, where finished pixels may be cut.

use crate::leaves::LEAF;
use crate::occlusion::Rect;

/// Edge of the parts that tiles are drawn in.
pub const PART: i32 = 64;

/// Sheets beyond the one at which a region lacks a brick that it looks for more. With as many as a brick is thick, 8, a head's
/// regions are sent bricks that what lies in front of them then hides: of mri256 26.8 % were held after 18 views, with 5 25.4,
/// with 4 25.1. In exchange they ask 322 times for the first view instead of 228, with 4 372 times, while others of their
/// worker's are drawn. In later views they expect most of what they need beforehand (docs/scaling.md).
pub const AHEAD: u32 = 4;

/// As [`AHEAD`], of a worker that waits for bricks; twice as far each time that the same region stands still again, up to
/// [`FARTHEST`]. mri256 on 15 workers of one machine, real ones: with 4 always they were sent 7.7 % of the set a later frame, and
/// regions stood still 48 times; so 8.3 % and 27 times; with 8 to begin with 7.4 % and 31; with 16 and four times as far 9.7 % and 26
/// (docs/scaling.md).
const FAR: u32 = 16;
const FARTHEST: u32 = 1024;

/// A worker waits for bricks whose threads did so for one part of this many of the last [`LATELY`]. At half and twice this
/// frames take as long.
const PARTS: u64 = 50;

/// After this time, in ns, what was before counts half. Of less than half of it a single wait would say too much: one worker,
/// which has mri256 to itself and is hardly ever without something to draw, then held up to 26.4 % where it holds 25.9.
const LATELY: u64 = 60_000_000;

/// How far a worker's regions look beyond the sheet at which they lack a brick: for more bricks that nothing hides yet, which
/// are asked for along with it.
///
/// Who looks far asks for bricks that what lies in front of them then hides, and who does not stands still
/// again some sheets on. One whose other regions keep his threads busy meanwhile loses nothing by that, and looks
/// [`AHEAD`]. One whose threads wait looks far, and farther each time that the same region stands still: mouse_skull on 15
/// workers had tiles that stood still 15 times in a frame, for 0.16 ms each (docs/scaling.md). A scene's first frame
/// does not count and looks as near as can be, since all is lacked there.
#[derive(Clone, Copy, Debug, Default)]
pub struct Lookahead {
    /// From when on counts what was waited, in ns.
    from: u64,
    /// What threads waited, in sum.
    waited: u64,
}

impl Lookahead {
    /// Threads had nothing to do for so many nanoseconds, in sum, while regions lacked bricks.
    pub fn waited(&mut self, ns: u64) {
        self.waited = self.waited.saturating_add(ns);
    }

    /// How many sheets a region looks ahead that is drawn at this time, in ns, on a worker of so many threads: one that stood
    /// still so many times before, and is of its scene's first frame or not.
    pub fn sheets(&mut self, now: u64, threads: u32, (stalls, first): (u32, bool)) -> u32 {
        if first {
            *self = Lookahead { from: now, waited: 0 };
            return AHEAD;
        }
        let lately = now.saturating_sub(self.from);
        let waits = self.waited > 0
            && PARTS.saturating_mul(self.waited)
                >= lately.max(LATELY / 2).saturating_mul(u64::from(threads));
        if lately > LATELY {
            self.from = now - lately / 2;
            self.waited /= 2;
        }
        if waits { FAR.saturating_mul(2u32.saturating_pow(stalls)).min(FARTHEST) } else { AHEAD }
    }
}

/// A tile's parts: no part of it lies in two of the picture's.
pub fn parts(tile: Rect) -> impl Iterator<Item = Rect> {
    let cut = |from: i32, to: i32| {
        let parts = from.div_euclid(PART)..=(to - 1).div_euclid(PART);
        parts.map(move |i| ((i * PART).max(from), ((i + 1) * PART).min(to)))
    };
    cut(tile.y0, tile.y1).flat_map(move |(y0, y1)| {
        cut(tile.x0, tile.x1).map(move |(x0, x1)| Rect::new(x0, y0, x1, y1))
    })
}

/// The square of a picture of that size that a part of a tile lies in.
pub fn square_of(part: &Rect, size: [u32; 2]) -> Rect {
    let at = |x: i32| x.div_euclid(PART) * PART;
    let (x0, y0) = (at(part.x0), at(part.y0));
    Rect::new(x0, y0, x0 + PART, y0 + PART).intersect(&Rect::of_size(size))
}

/// Cuts a tile in two, so that about `share` of what is left to do lies in the second piece. `left` says how much that is
/// in a rectangle, in whatever unit. `None`: it can't be cut so that there is something to do in both.
///
/// Of lines that do as well the first one across the picture is taken: rows stay as long as they are.
pub fn cut(tile: Rect, share: f64, left: impl Fn(&Rect) -> f64) -> Option<(Rect, Rect)> {
    let all = left(&tile);
    let lines = |from: i32, to: i32| {
        let leaf = LEAF as i32;
        let first = (from.div_euclid(leaf) + 1) * leaf;
        (first..to).step_by(LEAF)
    };
    let rows = lines(tile.y0, tile.y1).map(|y| {
        (Rect::new(tile.x0, tile.y0, tile.x1, y), Rect::new(tile.x0, y, tile.x1, tile.y1))
    });
    let columns = lines(tile.x0, tile.x1).map(|x| {
        (Rect::new(tile.x0, tile.y0, x, tile.y1), Rect::new(x, tile.y0, tile.x1, tile.y1))
    });
    let mut best: Option<(f64, (Rect, Rect))> = None;
    for (one, other) in rows.chain(columns) {
        for (kept, given) in [(one, other), (other, one)] {
            let (here, there) = (left(&kept), left(&given));
            let off = (there - share * all).abs();
            if here > 0.0 && there > 0.0 && best.is_none_or(|(least, _)| off < least) {
                best = Some((off, (kept, given)));
            }
        }
    }
    best.map(|(_, pieces)| pieces)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_of_a_tile_are_those_of_the_picture() {
        let got: Vec<Rect> = parts(Rect::new(48, 64, 130, 100)).collect();
        let of = |x0, x1| Rect::new(x0, 64, x1, 100);
        assert_eq!(got, [of(48, 64), of(64, 128), of(128, 130)]);
    }

    #[test]
    fn who_waits_for_bricks_looks_far() {
        const MS: u64 = 1_000_000;
        let mut look = Lookahead::default();
        assert_eq!(look.sheets(10 * MS, 1, (3, false)), AHEAD, "who never waited");
        look.waited(MS / 2);
        assert_eq!(look.sheets(20 * MS, 1, (0, false)), AHEAD, "half a millisecond of 30 at least");
        look.waited(MS / 2);
        assert_eq!(
            [0, 1, 2, 5, 6, 99].map(|n| look.sheets(20 * MS, 1, (n, false))),
            [16, 32, 64, 512, 1024, 1024]
        );
        assert_eq!(look.sheets(20 * MS, 8, (0, false)), AHEAD, "a millisecond of 160");
        // What was waited long ago is forgotten by and by.
        assert_eq!(look.sheets(40 * MS, 1, (0, false)), FAR);
        assert_eq!(look.sheets(100 * MS, 1, (0, false)), AHEAD);
        look.waited(50 * MS);
        assert_eq!(look.sheets(110 * MS, 8, (0, false)), FAR);
        assert_eq!(look.sheets(110 * MS, 8, (0, true)), AHEAD);
        assert_eq!(look.sheets(111 * MS, 1, (0, false)), AHEAD, "a first frame");
    }

    #[test]
    fn the_pieces_make_up_the_tile_and_the_share_is_as_near_as_leaves_allow() {
        let area = |r: &Rect| r.area() as f64;
        for tile in
            [Rect::new(64, 128, 128, 192), Rect::new(0, 0, 40, 64), Rect::new(0, 64, 17, 80)]
        {
            for share in [0.1, 0.25, 0.5, 0.7] {
                let (kept, given) = cut(tile, share, area).expect("it has a line");
                assert_eq!(kept.union(&given), tile);
                assert_eq!(kept.area() + given.area(), tile.area());
                let lines = [given.x0, given.y0, given.x1, given.y1];
                let inner = [
                    given.x0 > tile.x0,
                    given.y0 > tile.y0,
                    given.x1 < tile.x1,
                    given.y1 < tile.y1,
                ];
                assert!(
                    lines.iter().zip(inner).all(|(at, inner)| !inner || at % 16 == 0),
                    "{given:?}"
                );
            }
        }
        let (kept, given) = cut(Rect::new(64, 0, 128, 64), 0.5, area).expect("it has a line");
        assert_eq!(
            (kept, given),
            (Rect::new(64, 0, 128, 32), Rect::new(64, 32, 128, 64)),
            "by rows"
        );
        assert_eq!(cut(Rect::new(64, 0, 80, 16), 0.5, area), None, "a leaf");
    }

    #[test]
    fn what_is_done_stays_with_whoever_did_it() {
        // Of four parts the first two are done and the third is half way.
        let tile = Rect::new(0, 0, 128, 128);
        let todo = [0.0, 0.0, 0.5, 1.0];
        let left = |r: &Rect| {
            let of = |(part, todo): (Rect, f64)| {
                let both = part.intersect(r);
                if both.is_empty() { 0.0 } else { todo * both.area() as f64 }
            };
            parts(tile).zip(todo).map(of).sum::<f64>()
        };
        let (kept, given) = cut(tile, 0.5, left).expect("it has a line");
        assert!((left(&given) / left(&tile) - 0.5).abs() <= 0.2, "{given:?}");
        assert!(left(&kept) > 0.0);
        assert_eq!(cut(tile, 0.5, |_| 0.0), None, "nothing is left");
    }
}
