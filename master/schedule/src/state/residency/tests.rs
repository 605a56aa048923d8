//! Broadcast, lazy and on-request residency, eviction and damaged bricks.

use super::*;
use slabcast_common::brick::TightBox;

const W: WorkerId = WorkerId(1);
const KEY: BrickSetKey = BrickSetKey(slabcast_common::volume::Digest32([3; 32]));

/// Ten bricks of 100 bytes and one worker.
fn residency(budget: u64) -> Residency {
    let tight = TightBox { lo: [0; 3], hi: [7; 3] };
    let bricks: Arc<[BrickInfo]> =
        (0..10).map(|i| BrickInfo { id: BrickId(2 * i), tight, voxels: 9, bytes: 100 }).collect();
    let mut r = Residency::default();
    r.join(W, budget, vec![(KEY, vec![BrickId(0), BrickId(0), BrickId(3)])]);
    r.open(KEY, &bricks, false, &BTreeSet::new());
    r
}

fn flush(r: &mut Residency) -> Vec<ResidencyAction> {
    r.flush(W, 5, &mut || 77)
}

fn send(ids: &[u32]) -> ResidencyAction {
    let bricks = ids.iter().map(|&i| BrickId(i)).collect();
    let bytes = 100 * ids.len() as u64;
    ResidencyAction::Send { set: KEY, bricks, bytes, over_budget: false }
}

#[test]
fn residency_counts_announced_bricks_once_and_ignores_unknown_ids() {
    let mut r = residency(1000);
    assert_eq!(r.held(W), (1, 100));
    r.begin_slab(&[0, 1]);
    r.want(W, [0, 1, 1]);
    assert_eq!(flush(&mut r), [send(&[2])]);
    assert!(flush(&mut r).is_empty());
}

#[test]
fn residency_reports_bricks_not_used_lately_as_newly_used() {
    let mut r = residency(1000);
    let bricks = r.sets[&KEY].bricks.clone();
    let newly_used = |r: &mut Residency, indices: &[u32]| {
        let mut newly_used = Vec::new();
        r.open(KEY, &bricks, true, &BTreeSet::new());
        r.mark_used(KEY, indices, &mut newly_used);
        newly_used
    };
    assert_eq!(newly_used(&mut r, &[1, 2, 1]), [1, 2]);
    assert_eq!(newly_used(&mut r, &[2, 3]), [3]);
    assert_eq!(newly_used(&mut r, &[4]), [4]);
    assert_eq!(
        newly_used(&mut r, &[3, 1, 2]),
        [1],
        "of the first round, of which others are too far"
    );
}

#[test]
fn prefetch_sends_bricks_only_where_all_of_them_fit() {
    let mut r = residency(300);
    let bricks = r.sets[&KEY].bricks.clone();
    r.open(KEY, &bricks, true, &BTreeSet::new());
    let other = WorkerId(2);
    r.join(other, 1000, Vec::new());
    let list = |indices: &[u32]| vec![(W, indices.to_vec()), (other, indices.to_vec())];
    assert_eq!(
        r.queue_prefetch(KEY, list(&[1, 2, 3])),
        [other],
        "one is held, and three do not fit"
    );
    assert!(flush(&mut r).is_empty());
    assert_eq!(r.flush(other, 5, &mut || 78), [send(&[2, 4, 6])]);
    assert_eq!(r.queue_prefetch(KEY, list(&[2, 4])), [W, other]);
    assert_eq!(flush(&mut r), [send(&[4, 8])]);
    assert_eq!(r.flush(other, 5, &mut || 79), [send(&[8])], "the first is on its way");
}

#[test]
fn damaged_bricks_are_sent_again_named_before_or_after_the_count() {
    for named_first in [true, false] {
        let mut r = residency(1000);
        r.begin_slab(&[1, 2, 3]);
        r.want(W, [1, 2, 3]);
        flush(&mut r);
        if named_first {
            assert_eq!(r.broken(W, KEY, &[BrickId(4)]), None);
            assert!(r.arrived(W, KEY, 2).is_some());
        } else {
            assert_eq!(r.arrived(W, KEY, 2), None);
            assert!(r.broken(W, KEY, &[BrickId(4)]).is_some());
        }
        assert_eq!(r.held(W), (3, 300));
        assert_eq!(flush(&mut r), [send(&[4])]);
        assert!(r.arrived(W, KEY, 1).is_some());
        assert_eq!(r.held(W), (4, 400));
    }
}

#[test]
fn dropped_brick_is_sent_again_only_after_the_pong() {
    let mut r = residency(300);
    r.begin_slab(&[1, 2]);
    r.want(W, [1, 2]);
    assert_eq!(flush(&mut r), [send(&[2, 4])]);
    r.arrived(W, KEY, 2);
    // Least recently needed: brick 0, which was never, then those of the round before.
    r.begin_slab(&[2, 3, 4]);
    r.want(W, [3, 4]);
    let drop = |ids: &[u32]| ResidencyAction::Drop {
        set: KEY,
        bricks: ids.iter().map(|&i| BrickId(i)).collect(),
        nonce: 77,
    };
    assert_eq!(flush(&mut r), [drop(&[0, 2])], "and no room until they are gone");
    assert!(flush(&mut r).is_empty());
    r.ponged(W, 76);
    assert!(flush(&mut r).is_empty());
    r.ponged(W, 77);
    assert_eq!(flush(&mut r), [send(&[6, 8])]);
}

#[test]
fn workers_needed_hold_each_brick_four_times() {
    let mut r = residency(1000);
    let bytes: u64 = r.sets[&KEY].bricks.iter().map(|b| u64::from(b.bytes)).sum();
    let needed = |budget: u64| (4 * bytes).div_ceil(budget) as usize;
    assert_eq!(r.workers_to_hold(KEY), needed(1000));
    r.join(WorkerId(99), 3000, Vec::new());
    assert_eq!(r.workers_to_hold(KEY), needed(2000), "by the mean");
    r.join(WorkerId(98), u64::MAX, Vec::new());
    assert_eq!(r.workers_to_hold(KEY), 1);
    assert!(residency(0).workers_to_hold(KEY) > 1_000);
}

#[test]
fn lease_beyond_the_budget_is_sent_alone_and_counted() {
    let mut r = residency(250);
    r.begin_slab(&[1, 2, 3, 4]);
    assert!(r.is_lazy(W));
    assert!(r.fits(W, &[1, 2]) && !r.fits(W, &[1, 2, 3]));
    r.pin(W, &[1, 2, 3]);
    r.want(W, [1, 2, 3]);
    assert!(matches!(
        &flush(&mut r)[..],
        [ResidencyAction::Drop { .. }, ResidencyAction::Send { .. }]
    ));
    r.ponged(W, 77);
    assert_eq!(flush(&mut r), [send(&[4])], "two fit into 250 bytes");
    assert!(flush(&mut r).is_empty(), "what flies may make room yet");
    r.arrived(W, KEY, 2);
    let last = flush(&mut r);
    assert!(matches!(&last[..], [ResidencyAction::Send { over_budget: true, .. }]), "{last:?}");
}
