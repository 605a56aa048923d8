use super::*;
use crate::RegionLevel;
use proptest::prelude::*;
use slabcast_common::slab::SheetRange;
use std::collections::BTreeSet;

const SIZE: [u32; 2] = [128, 128];

/// Brick `place` lies over the column of parts `place % 2`, `place` sheets deep, four sheets long.
fn project(place: u32) -> Option<Projected> {
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

fn progress(tile: Rect) -> RegionProgress {
    RegionProgress::new(&traced(), &tile, SIZE, &project).expect("it is traced")
}

const LEFT: Rect = Rect { x0: 0, y0: 0, x1: 64, y1: 64 };
const ALL: Rect = Rect { x0: 0, y0: 0, x1: 128, y1: 128 };

#[test]
fn tile_stalls_at_a_missing_brick_and_asks_a_few_sheets_ahead() {
    let mut c = progress(LEFT);
    assert_eq!(c.missing(&|_| false, 5, &project), [0, 4], "20 is deeper");
    assert_eq!(
        (c.runs_ns(&|_| false), c.runs_ns(&|p| p == 0), c.runs_ns(&|_| true)),
        (0.0, 100.0, 1000.0)
    );
    c.advance(60.0, &|p| p == 0);
    assert_eq!((c.total_ns(), c.left_ns()), (1000.0, 940.0));
    assert_eq!(c.missing(&|p| p == 0, 5, &project), [0u32; 0], "it is not stalled");
    // The next one comes meanwhile.
    assert_eq!(c.runs_ns(&|p| p < 9), 640.0);
    c.advance(640.0, &|p| p < 9);
    assert!(!c.is_done());
    assert_eq!((c.missing(&|p| p < 9, 5, &project), c.upcoming()), (vec![20], vec![20]));
    assert_eq!(c.next_sheets(LEFT, &project), [Some(20)]);
    c.resume();
    c.advance(f64::INFINITY, &|_| true);
    assert!(c.is_done());
    assert_eq!(c.next_sheets(LEFT, &project), [None]);
}

#[test]
fn parts_stall_one_by_one_and_resume_together() {
    let mut c = progress(ALL);
    assert_eq!((c.total_ns(), c.left_ns()), (6000.0, 6000.0), "twice its parts");
    let has = |p: u32| p != 4;
    assert_eq!(c.runs_ns(&has), 2.0 * (100.0 + 500.0 + 100.0 + 500.0));
    c.advance(f64::INFINITY, &has);
    assert_eq!(c.missing(&has, 5, &project), [4], "once for both");
    assert_eq!(c.runs_ns(&|_| true), 0.0, "it tries them again when it is resumed");
    c.resume();
    assert_eq!(c.runs_ns(&|_| true), 3600.0);
}

#[test]
fn unrecorded_tile_takes_its_share_of_recorded_squares() {
    let mut only = traced();
    only.regions.remove(0);
    let c = RegionProgress::new(&only, &ALL, SIZE, &project).expect("the tile itself is traced");
    assert_eq!(c.total_ns(), 6000.0);
    assert_eq!(c.missing(&|_| false, 5, &project), [0, 1, 4], "all are needed at once");
    assert_eq!(RegionProgress::new(&only, &LEFT, SIZE, &project), None);
    let half = progress(Rect::new(0, 0, 64, 32));
    assert!((500.0..600.0).contains(&half.total_ns()), "with a border of its own: {half:?}");
}

proptest! {
    /// Bricks come in any order, and a piece of the rest is handed over.
    #[test]
    fn region_ends_whatever_order_bricks_come_in(
        order in Just(vec![0u32, 1, 4, 9, 20]).prop_shuffle(),
        steps in prop::collection::vec(0.0..900.0f64, 5),
        cut in 1i32..7, across in any::<bool>(),
    ) {
        let mut c = progress(ALL);
        let mut here = BTreeSet::new();
        let mut drawn = 0.0;
        for (brick, step) in order.into_iter().zip(steps) {
            let has = |p: u32| here.contains(&p);
            let runs = c.runs_ns(&has).min(step);
            c.advance(runs, &has);
            drawn += runs;
            let (all, left) = (c.total_ns(), c.left_ns());
            prop_assert!((all - left - drawn).abs() < 20.0, "{drawn} of {all}, {left} left");
            if c.runs_ns(&has) <= 0.0 {
                c.resume();
                let is_stalled = !c.missing(&has, 5, &project).is_empty();
                prop_assert!(c.runs_ns(&has) > 0.0 || c.is_done() || is_stalled);
            }
            here.insert(brick);
        }
        let at = cut * 16;
        let (kept, given) = match across {
            true => (Rect::new(0, 0, 128, at), Rect::new(0, at, 128, 128)),
            false => (Rect::new(0, 0, at, 128), Rect::new(at, 0, 128, 128)),
        };
        let left = c.left_ns();
        prop_assert!((c.left_in_ns(&kept) + c.left_in_ns(&given) - left).abs() < 1.0);
        let pieces = [kept, given].map(|piece| c.piece(&ALL, &piece, &project));
        let both: f64 = pieces.iter().map(|p| p.left_ns()).sum();
        prop_assert!(both >= left * 0.99 && both <= left * 1.7 + 1.0, "{both} for {left}");
        for (mut piece, tile) in pieces.into_iter().zip([kept, given]) {
            prop_assert_eq!(piece.next_sheets(tile, &project).len(), parts(tile).count());
            piece.resume();
            piece.advance(f64::INFINITY, &|_| true);
            prop_assert!(piece.is_done());
        }
    }
}
