use super::*;
use slabcast_common::brick::{Brick, BrickGrid};
use slabcast_common::volume::{Digest32, Samples};

const SET: BrickSetKey = BrickSetKey(Digest32([5; 32]));
const GRID: BrickGrid = BrickGrid { dims: [12, 1, 1] };

fn brick(id: u32) -> Arc<Brick> {
    Arc::new(Brick::new(BrickId(id), (0..512).collect(), Samples::U8(vec![1; 512]), None))
}

/// Twelve bricks of one size, and a budget of so many.
struct World {
    cache: BrickCache,
    stalls: Stalls,
}

fn key(n: u64) -> RegionKey {
    (FrameId(n / 10), TaskId(n))
}

fn forgotten(ids: &[u32]) -> BrickRequest {
    BrickRequest::Forgotten(SET, ids.iter().map(|&i| BrickId(i)).collect())
}

fn wanted(ids: &[u32]) -> BrickRequest {
    BrickRequest::Wanted(SET, ids.iter().map(|&i| BrickId(i)).collect())
}

impl World {
    fn new(budget: u64) -> World {
        let info = |id| {
            let b = brick(id);
            let bytes = b.encoded_len() as u32;
            let tight = b.tight_box(&GRID);
            slabcast_common::brick::BrickInfo { id: b.id, tight, voxels: 512, bytes }
        };
        let mut cache = BrickCache::default();
        let bricks = (0..12).map(info).collect();
        assert!(cache.directory(SET, GRID, (0, 12), bricks).is_ok());
        let stalls = Stalls::new(budget * brick(0).encoded_len() as u64);
        World { cache, stalls }
    }

    fn enter(&mut self, n: u64) {
        let table = self.cache.table(SET).expect("its directory came").clone();
        self.stalls.add(key(n), SET, table);
    }

    fn ask(&mut self) -> Vec<BrickRequest> {
        self.stalls.requests(&mut self.cache)
    }

    /// Bricks come; who goes on.
    fn come(&mut self, ids: &[u32]) -> Vec<RegionKey> {
        let mut on = Vec::new();
        for &id in ids {
            self.cache.put(SET, brick(id));
            let table = self.cache.table(SET).expect("its directory came").clone();
            self.stalls.brick_arrived(SET, &table, BrickId(id), &mut on);
        }
        on
    }

    fn held(&self) -> Vec<u32> {
        self.cache.held().iter().flat_map(|(_, ids)| ids.iter().map(|b| b.0)).collect()
    }
}

#[test]
fn each_brick_that_stalled_regions_lack_is_requested_once() {
    let mut w = World::new(12);
    (1..=3).for_each(|n| w.enter(n));
    w.come(&[7]);
    assert!(!w.stalls.stall(key(1), &[0, 1], true));
    assert!(!w.stalls.stall(key(2), &[1, 2, 7], true));
    assert!(w.stalls.stall(key(3), &[7], true), "it came meanwhile");
    assert_eq!(w.ask(), [wanted(&[0, 1, 2])]);
    assert!(w.ask().is_empty());
    assert_eq!(w.come(&[1]), []);
    assert_eq!(w.come(&[0, 2]), [key(1), key(2)]);
    // A brick that nobody waits for any more may be asked for again.
    w.stalls.stall(key(1), &[4], true);
    assert_eq!(w.ask(), [wanted(&[4])]);
    w.stalls.remove(key(1), &[]);
    w.stalls.stall(key(2), &[4], true);
    assert_eq!(w.ask(), [wanted(&[4])]);
}

#[test]
fn prefetch_requests_each_brick_once_and_never_evicts() {
    let mut w = World::new(5);
    w.enter(1);
    w.come(&[7]);
    let prefetch = |w: &mut World, places: &[u32]| {
        let table = w.cache.table(SET).expect("its directory came").clone();
        let ids = w.stalls.prefetch(SET, &table, places, &w.cache);
        ids.iter().map(|b| b.0).collect::<Vec<_>>()
    };
    assert_eq!(prefetch(&mut w, &[1, 2, 7]), [1, 2]);
    assert!(!w.stalls.stall(key(1), &[1, 3], true));
    assert_eq!(w.ask(), [wanted(&[3])], "1 is on its way");
    assert_eq!(w.come(&[1, 3]), [key(1)]);
    // One here, three, and one on its way: no more than that.
    assert_eq!(prefetch(&mut w, &[2, 4, 5, 6]), [4]);
    assert_eq!(w.come(&[2, 4]), []);
    assert_eq!(prefetch(&mut w, &[8]), [0u32; 0]);
    assert_eq!(w.held(), [1, 2, 3, 4, 7], "nothing is forgotten for it");
}

#[test]
fn least_recently_drawn_bricks_are_evicted_first() {
    let mut w = World::new(4);
    w.enter(1);
    w.come(&[0, 1, 2, 3]);
    w.stalls.remove(key(1), &[0, 2]);
    w.enter(2);
    w.stalls.stall(key(2), &[8], true);
    // One, and what is spared beyond it.
    assert_eq!(w.ask(), [forgotten(&[1, 3]), wanted(&[8])]);
    assert_eq!(w.held(), [0, 2]);
    assert_eq!(w.come(&[8]), [key(2)]);
    assert_eq!(w.stalls.over_budget, 0);
}

#[test]
fn bricks_that_arrive_unrequested_are_evicted_to_the_budget() {
    let mut w = World::new(3);
    w.come(&[0, 1, 2, 3, 4]);
    assert!(w.ask().is_empty(), "no region is here: the master keeps the budget");
    w.enter(1);
    let BrickRequest::Forgotten(_, gone) = &w.ask()[0] else { panic!("room is made") };
    assert_eq!(gone[0], BrickId(0));
    assert!(w.held().len() <= 3);
}

#[test]
fn requests_beyond_the_memory_budget_wait_except_the_oldest_region() {
    let mut w = World::new(4);
    w.enter(1);
    w.enter(2);
    w.stalls.stall(key(2), &[5, 6, 7], true);
    assert_eq!(w.ask(), [wanted(&[5, 6, 7])]);
    w.come(&[5, 6]);
    w.stalls.stall(key(1), &[0, 1], true);
    assert_eq!(w.ask(), [wanted(&[0, 1])], "all that is here is kept");
    assert_eq!(w.stalls.over_budget, 1);
    w.enter(3);
    w.stalls.stall(key(3), &[9], true);
    assert!(w.ask().is_empty(), "it can wait");
    assert_eq!(w.come(&[0, 1, 7]), [key(1), key(2)]);
    w.stalls.remove(key(1), &[0, 1]);
    w.stalls.remove(key(2), &[5, 6, 7]);
    let requests = w.ask();
    assert!(
        matches!(&requests[..], [BrickRequest::Forgotten(..), BrickRequest::Wanted(..)]),
        "{requests:?}"
    );
    assert_eq!(w.come(&[9]), [key(3)]);
    assert_eq!(w.stalls.over_budget, 1);
}

#[test]
fn region_stalled_twice_at_one_sheet_keeps_the_bricks_it_waited_for() {
    // One brick fits, its sheet needs three: it must not lose one for the other for ever.
    let mut w = World::new(1);
    w.enter(1);
    w.stalls.stall(key(1), &[0], true);
    assert_eq!(w.ask(), [wanted(&[0])]);
    w.come(&[0]);
    w.stalls.stall(key(1), &[1], false);
    assert_eq!(w.ask(), [wanted(&[1])]);
    w.come(&[1]);
    w.stalls.stall(key(1), &[2], false);
    assert_eq!(w.ask(), [wanted(&[2])]);
    assert_eq!(w.come(&[2]), [key(1)]);
    assert_eq!(w.held(), [0, 1, 2]);
    // Farther on they are not kept any longer.
    w.stalls.stall(key(1), &[3], true);
    assert_eq!(w.ask(), [forgotten(&[0, 1, 2]), wanted(&[3])]);
}

#[test]
fn end_of_frame_removes_its_stalled_regions() {
    let mut w = World::new(2);
    [1, 2, 11].iter().for_each(|&n| w.enter(n));
    w.stalls.stall(key(1), &[0], true);
    w.stalls.stall(key(11), &[0, 1], true);
    assert_eq!(w.ask(), [wanted(&[0, 1])]);
    assert_eq!(w.stalls.end_frame(FrameId(0)), [key(1)], "the second is being drawn");
    w.stalls.remove(key(2), &[]);
    assert_eq!(w.come(&[0, 1]), [key(11)]);
    w.stalls.remove(key(11), &[0, 1]);
    assert!(w.stalls.kept.is_empty() && w.stalls.requested.is_empty());
    assert_eq!((w.stalls.requested_bytes, w.stalls.regions.len()), (0, 0));
}

#[test]
fn search_for_room_is_spared_until_a_brick_may_be_dropped() {
    let mut w = World::new(2);
    w.enter(1);
    w.enter(2);
    w.stalls.stall(key(1), &[0, 1, 2], false);
    w.stalls.stall(key(2), &[3], false);
    assert_eq!(w.ask(), [wanted(&[0, 1, 2])], "the oldest goes over the budget");
    assert_eq!(w.come(&[0, 1, 2]), [key(1)]);
    assert_eq!(w.ask(), []);
    assert_eq!(w.stalls.droppable_bytes, 0, "the first region keeps all that is here");
    w.stalls.remove(key(1), &[0, 1, 2]);
    assert_eq!(w.stalls.droppable_bytes, 3 * brick(0).encoded_len() as u64);
    assert_eq!(w.ask(), [forgotten(&[0, 1]), wanted(&[3])]);
}
