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
    parking: Parking,
}

fn who(n: u64) -> Who {
    (FrameId(n / 10), TaskId(n))
}

fn forgotten(ids: &[u32]) -> Say {
    Say::Forgotten(SET, ids.iter().map(|&i| BrickId(i)).collect())
}

fn wanted(ids: &[u32]) -> Say {
    Say::Wanted(SET, ids.iter().map(|&i| BrickId(i)).collect())
}

impl World {
    fn new(budget: u64) -> World {
        let info = |id| {
            let b = brick(id);
            let bytes = b.encoded_len() as u32;
            let tight = b.tight(&GRID);
            slabcast_common::brick::BrickInfo { id: b.id, tight, voxels: 512, bytes }
        };
        let mut cache = BrickCache::default();
        let bricks = (0..12).map(info).collect();
        assert!(cache.directory(SET, GRID, (0, 12), bricks).is_ok());
        let parking = Parking::new(budget * brick(0).encoded_len() as u64);
        World { cache, parking }
    }

    fn enter(&mut self, n: u64) {
        let shelf = self.cache.shelf(SET).expect("its directory came").clone();
        self.parking.enter(who(n), SET, shelf);
    }

    fn ask(&mut self) -> Vec<Say> {
        self.parking.ask(&mut self.cache)
    }

    /// Bricks come; who goes on.
    fn come(&mut self, ids: &[u32]) -> Vec<Who> {
        let mut on = Vec::new();
        for &id in ids {
            self.cache.put(SET, brick(id));
            let shelf = self.cache.shelf(SET).expect("its directory came").clone();
            self.parking.came(SET, &shelf, BrickId(id), &mut on);
        }
        on
    }

    fn held(&self) -> Vec<u32> {
        self.cache.held().iter().flat_map(|(_, ids)| ids.iter().map(|b| b.0)).collect()
    }
}

#[test]
fn wishes_are_put_together_and_a_brick_is_asked_for_once() {
    let mut w = World::new(12);
    (1..=3).for_each(|n| w.enter(n));
    w.come(&[7]);
    assert!(!w.parking.park(who(1), &[0, 1], true));
    assert!(!w.parking.park(who(2), &[1, 2, 7], true));
    assert!(w.parking.park(who(3), &[7], true), "it came meanwhile");
    assert_eq!(w.ask(), [wanted(&[0, 1, 2])]);
    assert!(w.ask().is_empty());
    assert_eq!(w.come(&[1]), []);
    assert_eq!(w.come(&[0, 2]), [who(1), who(2)]);
    // A brick that nobody waits for any more may be asked for again.
    w.parking.park(who(1), &[4], true);
    assert_eq!(w.ask(), [wanted(&[4])]);
    w.parking.leave(who(1), &[]);
    w.parking.park(who(2), &[4], true);
    assert_eq!(w.ask(), [wanted(&[4])]);
}

#[test]
fn what_is_expected_is_asked_for_once_and_never_makes_room() {
    let mut w = World::new(5);
    w.enter(1);
    w.come(&[7]);
    let expect = |w: &mut World, places: &[u32]| {
        let shelf = w.cache.shelf(SET).expect("its directory came").clone();
        let ids = w.parking.expect(SET, &shelf, places, &w.cache);
        ids.iter().map(|b| b.0).collect::<Vec<_>>()
    };
    assert_eq!(expect(&mut w, &[1, 2, 7]), [1, 2]);
    assert!(!w.parking.park(who(1), &[1, 3], true));
    assert_eq!(w.ask(), [wanted(&[3])], "1 is on its way");
    assert_eq!(w.come(&[1, 3]), [who(1)]);
    // One here, three, and one on its way: no more than that.
    assert_eq!(expect(&mut w, &[2, 4, 5, 6]), [4]);
    assert_eq!(w.come(&[2, 4]), []);
    assert_eq!(expect(&mut w, &[8]), [0u32; 0]);
    assert_eq!(w.held(), [1, 2, 3, 4, 7], "nothing is forgotten for it");
}

#[test]
fn what_was_drawn_longest_ago_makes_room() {
    let mut w = World::new(4);
    w.enter(1);
    w.come(&[0, 1, 2, 3]);
    w.parking.leave(who(1), &[0, 2]);
    w.enter(2);
    w.parking.park(who(2), &[8], true);
    // One, and what is spared beyond it.
    assert_eq!(w.ask(), [forgotten(&[1, 3]), wanted(&[8])]);
    assert_eq!(w.held(), [0, 2]);
    assert_eq!(w.come(&[8]), [who(2)]);
    assert_eq!(w.parking.over_budget, 0);
}

#[test]
fn what_comes_unasked_makes_room_for_itself() {
    let mut w = World::new(3);
    w.come(&[0, 1, 2, 3, 4]);
    assert!(w.ask().is_empty(), "no region is here: the master keeps the budget");
    w.enter(1);
    let Say::Forgotten(_, gone) = &w.ask()[0] else { panic!("room is made") };
    assert_eq!(gone[0], BrickId(0));
    assert!(w.held().len() <= 3);
}

#[test]
fn wishes_beyond_the_budget_are_put_off_but_for_the_oldest() {
    let mut w = World::new(4);
    w.enter(1);
    w.enter(2);
    w.parking.park(who(2), &[5, 6, 7], true);
    assert_eq!(w.ask(), [wanted(&[5, 6, 7])]);
    w.come(&[5, 6]);
    w.parking.park(who(1), &[0, 1], true);
    assert_eq!(w.ask(), [wanted(&[0, 1])], "all that is here is kept");
    assert_eq!(w.parking.over_budget, 1);
    w.enter(3);
    w.parking.park(who(3), &[9], true);
    assert!(w.ask().is_empty(), "it can wait");
    assert_eq!(w.come(&[0, 1, 7]), [who(1), who(2)]);
    w.parking.leave(who(1), &[0, 1]);
    w.parking.leave(who(2), &[5, 6, 7]);
    let says = w.ask();
    assert!(matches!(&says[..], [Say::Forgotten(..), Say::Wanted(..)]), "{says:?}");
    assert_eq!(w.come(&[9]), [who(3)]);
    assert_eq!(w.parking.over_budget, 1);
}

#[test]
fn a_region_that_comes_to_the_same_sheet_again_keeps_what_it_waited_for() {
    // One brick fits, its sheet needs three: it must not lose one for the other for ever.
    let mut w = World::new(1);
    w.enter(1);
    w.parking.park(who(1), &[0], true);
    assert_eq!(w.ask(), [wanted(&[0])]);
    w.come(&[0]);
    w.parking.park(who(1), &[1], false);
    assert_eq!(w.ask(), [wanted(&[1])]);
    w.come(&[1]);
    w.parking.park(who(1), &[2], false);
    assert_eq!(w.ask(), [wanted(&[2])]);
    assert_eq!(w.come(&[2]), [who(1)]);
    assert_eq!(w.held(), [0, 1, 2]);
    // Farther on they are not kept any longer.
    w.parking.park(who(1), &[3], true);
    assert_eq!(w.ask(), [forgotten(&[0, 1, 2]), wanted(&[3])]);
}

#[test]
fn a_frame_takes_its_parked_regions_along() {
    let mut w = World::new(2);
    [1, 2, 11].iter().for_each(|&n| w.enter(n));
    w.parking.park(who(1), &[0], true);
    w.parking.park(who(11), &[0, 1], true);
    assert_eq!(w.ask(), [wanted(&[0, 1])]);
    assert_eq!(w.parking.end_frame(FrameId(0)), [who(1)], "the second is being drawn");
    w.parking.leave(who(2), &[]);
    assert_eq!(w.come(&[0, 1]), [who(11)]);
    w.parking.leave(who(11), &[0, 1]);
    assert!(w.parking.kept.is_empty() && w.parking.coming.is_empty());
    assert_eq!((w.parking.coming_bytes, w.parking.stays.len()), (0, 0));
}
