//! A tile's geometry under the `region` schedule: the parts in which it is drawn, and how it is
//! split.
//!
//! A tile is drawn part by part: squares of [`PART_EDGE`] pixels, aligned to the picture, each
//! through all sheets. When an idle worker steals work, what is left are parts not yet begun and
//! one part that is some sheets deep. A split is one straight line, so both pieces are rectangles.
//! It lies on a multiple of [`LEAF_EDGE`] pixels, where finished tiles may be cut.

use crate::image::LEAF_EDGE;
use crate::occlusion::Rect;

/// Edge in pixels of the parts in which a tile is drawn.
pub const PART_EDGE: i32 = 64;

/// Returns the parts of a tile, row by row: the tile cut along the picture's grid of [`PART_EDGE`]
/// pixels. Parts at the tile's border may be smaller.
pub fn parts(tile: Rect) -> impl Iterator<Item = Rect> {
    let intervals = |start: i32, end: i32| {
        let parts = start.div_euclid(PART_EDGE)..=(end - 1).div_euclid(PART_EDGE);
        parts.map(move |i| ((i * PART_EDGE).max(start), ((i + 1) * PART_EDGE).min(end)))
    };
    intervals(tile.y0, tile.y1).flat_map(move |(y0, y1)| {
        intervals(tile.x0, tile.x1).map(move |(x0, x1)| Rect::new(x0, y0, x1, y1))
    })
}

/// Returns the square of the picture's [`PART_EDGE`] grid that holds `part`, clipped to a picture
/// of `size` (width and height in pixels).
pub fn enclosing_square(part: &Rect, size: [u32; 2]) -> Rect {
    let grid_line = |x: i32| x.div_euclid(PART_EDGE) * PART_EDGE;
    let (x0, y0) = (grid_line(part.x0), grid_line(part.y0));
    Rect::new(x0, y0, x0 + PART_EDGE, y0 + PART_EDGE).intersect(&Rect::from_size(size))
}

/// Splits a tile in two rectangles, (kept, given), so that about `share` (0 to 1) of the remaining
/// work lies in the second. `work_left` returns the work left in a rectangle, in any unit.
///
/// Returns `None` if no line leaves work on both sides. Of lines that do equally well, the first
/// horizontal one wins: rows keep their length.
pub fn split_tile(
    tile: Rect,
    share: f64,
    work_left: impl Fn(&Rect) -> f64,
) -> Option<(Rect, Rect)> {
    let total = work_left(&tile);
    let lines = |start: i32, end: i32| {
        let leaf = LEAF_EDGE as i32;
        let first = (start.div_euclid(leaf) + 1) * leaf;
        (first..end).step_by(LEAF_EDGE)
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
            let (kept_work, given_work) = (work_left(&kept), work_left(&given));
            let off = (given_work - share * total).abs();
            if kept_work > 0.0 && given_work > 0.0 && best.is_none_or(|(least, _)| off < least) {
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
    fn parts_of_a_tile_lie_on_the_pictures_grid() {
        let got: Vec<Rect> = parts(Rect::new(48, 64, 130, 100)).collect();
        let of = |x0, x1| Rect::new(x0, 64, x1, 100);
        assert_eq!(got, [of(48, 64), of(64, 128), of(128, 130)]);
    }

    #[test]
    fn split_pieces_make_up_the_tile_and_meet_the_share_within_a_leaf() {
        let area = |r: &Rect| r.area() as f64;
        for tile in
            [Rect::new(64, 128, 128, 192), Rect::new(0, 0, 40, 64), Rect::new(0, 64, 17, 80)]
        {
            for share in [0.1, 0.25, 0.5, 0.7] {
                let (kept, given) = split_tile(tile, share, area).expect("it has a line");
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
        let (kept, given) =
            split_tile(Rect::new(64, 0, 128, 64), 0.5, area).expect("it has a line");
        assert_eq!(
            (kept, given),
            (Rect::new(64, 0, 128, 32), Rect::new(64, 32, 128, 64)),
            "by rows"
        );
        assert_eq!(split_tile(Rect::new(64, 0, 80, 16), 0.5, area), None, "a leaf");
    }

    #[test]
    fn split_gives_away_only_unfinished_work() {
        // The first two of four parts are done; the third is half done.
        let tile = Rect::new(0, 0, 128, 128);
        let todo = [0.0, 0.0, 0.5, 1.0];
        let left = |r: &Rect| {
            let of = |(part, todo): (Rect, f64)| {
                let both = part.intersect(r);
                if both.is_empty() { 0.0 } else { todo * both.area() as f64 }
            };
            parts(tile).zip(todo).map(of).sum::<f64>()
        };
        let (kept, given) = split_tile(tile, 0.5, left).expect("it has a line");
        assert!((left(&given) / left(&tile) - 0.5).abs() <= 0.2, "{given:?}");
        assert!(left(&kept) > 0.0);
        assert_eq!(split_tile(tile, 0.5, |_| 0.0), None, "nothing is left");
    }
}
