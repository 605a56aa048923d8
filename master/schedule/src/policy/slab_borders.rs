//! Borders of the slabs of a frame: at equal thickness as in the paper, or where the data ask for
//! it (the paper's future work, its sections 5.3 and 6).
//!
//! Slabs in front hide bricks of those behind: a brick is needed unless every pixel under it is
//! shut where its slab begins. Shut pixels are guessed from the bricks alone: a leaf of the picture
//! is opaque a little behind the first brick in it. With that guess, the borders under which the
//! fewest voxels are needed are found exactly, by dynamic programming over borders a brick apart.
//! Borders are sheet borders, so no pixel changes, and a wrong guess costs bricks and nothing else.

use crate::policy::macrotile::LEAF;
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Borders, Work};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projected, View};

/// Tuning (vox): depth behind a leaf's front at which it becomes opaque, one and a half bricks. A
/// leaf one voxel thin is opaque within five; a skin that rises over some voxels takes ten.
const OPAQUE_DEPTH_VOX: f64 = 12.0;

/// Tuning (vox): distance between candidate borders, a brick's edge. Bricks begin no finer.
const BORDER_STEP_VOX: f64 = 8.0;

/// Limit: number of candidate borders; more are thinned out. The search takes its square.
const MAX_BORDERS: usize = 96;

/// Returns the slabs of a frame, front to back, none of them empty.
///
/// `projected`: rectangle in pixels and sheets of each brick, `None` outside the picture. `voxels`:
/// number of voxels of a brick by index.
pub fn slab_ranges(
    view: &View,
    projected: &[Option<Projected>],
    voxels: &dyn Fn(usize) -> u16,
    work: &Work,
) -> Vec<SheetRange> {
    let seen = projected.iter().flatten();
    let sheets = seen.fold(SheetRange::default(), |all, p| all.union(p.sheets));
    if work.borders == Borders::Equal || work.slabs < 2 || sheets.len() <= work.slabs {
        return sheets.slabs(work.slabs);
    }
    let deep = (OPAQUE_DEPTH_VOX / view.thickness).ceil().clamp(1.0, 1e6) as i32;
    let bricks = hidden_from(view.size, projected, voxels, deep);
    let apart = (BORDER_STEP_VOX / view.thickness).round().clamp(1.0, 1e6) as usize;
    let apart = apart.max(sheets.len() as usize / MAX_BORDERS).max(1);
    let tried: Vec<i32> = (sheets.first..sheets.end).step_by(apart).chain([sheets.end]).collect();
    let mut slabs = Vec::new();
    let mut first = sheets.first;
    for end in best(&tried, &bricks, work.slabs as usize) {
        slabs.push(SheetRange::new(first, end));
        first = end;
    }
    slabs
}

/// A brick, for the search of borders.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Guess {
    /// Number of the brick's first sheet.
    first: i32,
    /// A slab that begins at this sheet or behind needs the brick no more.
    hidden: i32,
    voxels: u64,
}

/// Returns from which sheet each brick is hidden, if every leaf is opaque `deep` sheets behind its
/// front.
fn hidden_from(
    size: [u32; 2],
    projected: &[Option<Projected>],
    voxels: &dyn Fn(usize) -> u16,
    deep: i32,
) -> Vec<Guess> {
    let leaf = LEAF as i32;
    let across = size[0].div_ceil(LEAF) as usize;
    let mut front = vec![i32::MAX; across * size[1].div_ceil(LEAF) as usize];
    let whole = Rect::from_size(size);
    let leaves = |p: &Projected| {
        let r = p.rect.intersect(&whole);
        let (y0, y1) = (r.y0.max(0) / leaf, (r.y1 - 1).max(-1));
        let rows = if r.is_empty() { 1..1 } else { y0..y1 / leaf + 1 };
        rows.map(move |y| {
            let row = y as usize * across;
            row + (r.x0 / leaf) as usize..row + ((r.x1 - 1) / leaf) as usize + 1
        })
    };
    for p in projected.iter().flatten() {
        for row in leaves(p) {
            front[row].iter_mut().for_each(|f| *f = (*f).min(p.sheets.first));
        }
    }
    let guess = |(i, p): (usize, &Option<Projected>)| {
        let p = p.as_ref()?;
        let last = leaves(p).flat_map(|row| front[row].iter().copied()).max()?;
        let hidden = last.saturating_add(deep);
        Some(Guess { first: p.sheets.first, hidden, voxels: u64::from(voxels(i)) })
    };
    projected.iter().enumerate().filter_map(guess).collect()
}

/// Returns the ends of at most `count` slabs under which the fewest voxels are needed, out of the
/// borders `tried` (the first where slabs begin, the last where they end). Of several such the one
/// with the front borders first.
fn best(tried: &[i32], bricks: &[Guess], count: usize) -> Vec<i32> {
    let n = tried.len() - 1;
    // For a slab from border `a` to `b`: voxels of the bricks that begin in it and are not hidden
    // at `a`.
    let mut needed = vec![0u64; (n + 1) * (n + 1)];
    for b in bricks {
        // The last border at or in front of it.
        let at = tried.partition_point(|&t| t <= b.first).clamp(1, n) - 1;
        // Those in front of where it is hidden; a slab may begin at any of them.
        let visible = tried.partition_point(|&t| t < b.hidden).min(at + 1);
        for a in 0..visible {
            needed[a * (n + 1) + at + 1] += b.voxels;
        }
    }
    for a in 0..n {
        for b in a + 1..=n {
            needed[a * (n + 1) + b] += needed[a * (n + 1) + b - 1];
        }
    }
    let count = count.min(n);
    // least[k][b]: of the first k + 1 slabs that end at border b, and where the last of them
    // begins.
    let mut least = vec![vec![(u64::MAX, 0usize); n + 1]; count];
    for b in 1..=n {
        least[0][b] = (needed[b], 0);
    }
    for k in 1..count {
        for b in k + 1..=n {
            for a in k..b {
                let all = least[k - 1][a].0.saturating_add(needed[a * (n + 1) + b]);
                if all < least[k][b].0 {
                    least[k][b] = (all, a);
                }
            }
        }
    }
    let k = (0..count).min_by_key(|&k| least[k][n].0).unwrap_or(0);
    let mut ends = vec![tried[n]];
    let mut at = n;
    for k in (1..=k).rev() {
        at = least[k][at].1;
        ends.push(tried[at]);
    }
    ends.reverse();
    ends
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brick(x: i32, y: i32, first: i32) -> Option<Projected> {
        Some(Projected {
            rect: Rect::new(x, y, x + 16, y + 16),
            sheets: SheetRange::new(first, first + 12),
        })
    }

    #[test]
    fn brick_is_hidden_behind_the_last_front_under_it() {
        // Two leaves with data at 0 and at 30, and a brick over both.
        let wide =
            Some(Projected { rect: Rect::new(8, 0, 24, 16), sheets: SheetRange::new(60, 72) });
        let all = [brick(0, 0, 0), brick(16, 0, 30), wide, None];
        let guess = hidden_from([32, 16], &all, &|i| i as u16, 12);
        assert_eq!(
            guess,
            [
                Guess { first: 0, hidden: 12, voxels: 0 },
                Guess { first: 30, hidden: 42, voxels: 1 },
                Guess { first: 60, hidden: 42, voxels: 2 },
            ]
        );
    }

    #[test]
    fn bricks_behind_a_wall_get_a_slab_of_their_own() {
        let wall = Guess { first: 0, hidden: 12, voxels: 10 };
        let behind = Guess { first: 40, hidden: 12, voxels: 1000 };
        let tried: Vec<i32> = (0..=10).map(|i| 8 * i).collect();
        assert_eq!(best(&tried, &[wall, behind], 1), [80]);
        let ends = best(&tried, &[wall, behind], 3);
        assert!((12..=40).contains(&ends[0]), "a border between the two: {ends:?}");
        assert_eq!(ends.last(), Some(&80));
    }

    /// Voxels that are needed under some borders, counted brick by brick.
    fn cost(first: i32, ends: &[i32], bricks: &[Guess]) -> u64 {
        let begin = |b: &Guess| {
            let before = ends.iter().filter(|&&e| e <= b.first).max();
            before.copied().unwrap_or(first).max(first)
        };
        bricks.iter().filter(|b| b.hidden > begin(b)).map(|b| b.voxels).sum()
    }

    proptest! {
        #[test]
        fn slab_borders_need_the_fewest_voxels(
            bricks in prop::collection::vec((0i32..39, 1i32..60, 1u64..9), 0..30),
        ) {
            let bricks: Vec<_> = bricks
                .iter()
                .map(|&(first, hidden, voxels)| Guess { first, hidden, voxels })
                .collect();
            let tried: Vec<i32> = (0..=10).map(|i| 4 * i).collect();
            let ends = best(&tried, &bricks, 3);
            prop_assert!(ends.len() <= 3 && ends.is_sorted() && ends[ends.len() - 1] == 40);
            let got = cost(0, &ends, &bricks);
            for i in 1..10 {
                for j in i + 1..10 {
                    prop_assert!(got <= cost(0, &[4 * i, 4 * j, 40], &bricks));
                }
            }
        }

        #[test]
        fn slabs_cover_all_sheets(
            bricks in prop::collection::vec((-40i32..120, -40i32..120, -50i32..50), 0..40),
            slabs in 1u32..9,
        ) {
            let view = view();
            let bricks: Vec<_> = bricks.iter().map(|&(x, y, f)| brick(x, y, f)).collect();
            let sheets = bricks.iter().flatten().fold(SheetRange::default(), |a, p| a.union(p.sheets));
            for borders in [Borders::Data, Borders::Equal] {
                let work = Work { slabs, borders, ..Work::default() };
                let cut = crate::policy::slab_borders::slab_ranges(&view, &bricks, &|_| 5, &work);
                prop_assert!(cut.len() <= slabs as usize);
                let mut at = sheets.first;
                for s in &cut {
                    prop_assert_eq!(s.first, at);
                    prop_assert!(!s.is_empty());
                    at = s.end;
                }
                prop_assert_eq!(at, sheets.end);
            }
        }
    }

    fn view() -> View {
        use slabcast_common::quality::Quality;
        use slabcast_common::view::{Camera, CameraProjection};
        use slabcast_common::volume::Volume;
        let lattice = Volume::from_fn_u8("v", [8; 3], |_, _, _| 0).lattice;
        let camera = Camera {
            to_eye: [0.0, 1.0, 0.0].into(),
            up: [0.0, 0.0, 1.0].into(),
            target: [0.0; 3].into(),
            projection: CameraProjection::Ortho { height: 20.0 },
        };
        View::new(&lattice, &camera, [100, 70], &Quality::before()).expect("a view")
    }
}
