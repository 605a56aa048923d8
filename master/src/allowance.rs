//! Rate limit of a worker's messages: each link has an account that its messages draw on.
//!
//! Each message of a worker takes time of the driver's one thread and of the threads that read
//! streams, and a list of bricks takes as much more as it is long. An honest worker answers: it says
//! one thing for each lease, batch of bricks and ping, and wants a brick because a region needs it.
//! A worker that asks for all bricks again and again says lawful things, too, and made everybody
//! else wait for half a second.
//!
//! So each link has an account. What the master sends it fills the account, by what an honest
//! answer to that costs; each message empties it. A link whose account is empty is not read until a
//! slow trickle has filled it again: it waits in its own TCP connection, where it costs nobody
//! anything. A worker that reads the bricks it asks for pays with its own line; one that does not
//! read gets none, and has the first sum and the trickle.
//!
//! A limit on messages a second would be simpler. It would have to admit what a large worker on a
//! fast line says in its first frame, and so a flood from each of ten strangers.

use slabcast_common::message::ToMaster;
use slabcast_common::message::ToWorker;
use slabcast_common::occlusion::Rect;
use std::time::Duration;

/// The account of a new link, and the most that is in one. A brick that is named costs one, some 100
/// ns of the driver: 26 ms in all. A worker that begins a frame of a large volume wants some 100,000
/// bricks at once.
const MOST: u64 = 1 << 18;

/// Credit that an account gains each second: 1.3 % of the driver for a link that sends no results.
const TRICKLE_PER_SEC: u64 = 1 << 17;

/// Cost of a message, beside what is in it: 1.6 us of the driver.
const MESSAGE: u64 = 16;

/// Bytes of a result that cost one: 0.1 us of decoding.
const BYTES: u64 = 64;

/// Credit for a brick that the master sent. It pays for one message that asks for the brick and one that
/// reports its eviction.
const BRICK_SENT: u64 = 2 * MESSAGE + 2;

/// Credit for a batch of bricks that the master sent. It pays for two messages that acknowledge the bricks
/// or report them broken.
const BATCH_SENT: u64 = 2 * MESSAGE;

/// The account of one link. See the head of the file.
#[derive(Debug)]
pub(crate) struct Account {
    left: u64,
    /// Time that filled the account, since the link began.
    filled: Duration,
    /// Bricks that were sent and that the worker has not named as received or broken.
    unconfirmed: u64,
}

impl Account {
    pub(crate) fn new() -> Account {
        Account { left: MOST, filled: Duration::ZERO, unconfirmed: 0 }
    }

    /// Adds what an honest answer to a control message costs.
    pub(crate) fn sent(&mut self, message: &ToWorker) {
        // A result or a split has a pixel for each of the tile, of at most 36 bytes.
        let pixels = |tile: &Rect| tile.area() as u64;
        let answer = match message {
            ToWorker::Lease(lease) => pixels(&lease.tile),
            ToWorker::Region(lease) => pixels(&lease.tile),
            _ => 0,
        };
        self.add(2 * MESSAGE + answer);
    }

    /// Adds what honest answers to a batch of bricks cost.
    pub(crate) fn sent_bricks(&mut self, bricks: u64) {
        self.unconfirmed += bricks;
        self.add(BATCH_SENT + BRICK_SENT * bricks);
    }

    /// Notes which bricks a worker says to have received. Returns false if it was never sent as many:
    /// what it evicts and wants anew would then cost the master memory that it never filled.
    pub(crate) fn confirms(&mut self, message: &ToMaster) -> bool {
        let bricks = match message {
            ToMaster::BricksReceived { bricks, .. } => u64::from(*bricks),
            ToMaster::BricksBroken { bricks, .. } => bricks.len() as u64,
            _ => 0,
        };
        match self.unconfirmed.checked_sub(bricks) {
            Some(left) => self.unconfirmed = left,
            None => return false,
        }
        true
    }

    fn add(&mut self, worth: u64) {
        self.left = (self.left + worth).min(MOST);
    }

    /// Takes what a message costs, `since` the link began. Returns how long to wait before it is
    /// passed on and the next one is read.
    pub(crate) fn take(&mut self, message: &ToMaster, since: Duration) -> Duration {
        let parts = (since.saturating_sub(self.filled)).as_micros() as u64 * TRICKLE_PER_SEC;
        self.filled = since;
        self.add(parts / 1_000_000);
        let cost = cost(message);
        if cost <= self.left {
            self.left -= cost;
            return Duration::ZERO;
        }
        let lacks = cost - self.left;
        self.left = 0;
        let wait = Duration::from_micros(lacks * 1_000_000 / TRICKLE_PER_SEC);
        // The wait is paid for: it does not fill the account a second time.
        self.filled += wait;
        wait
    }
}

/// Returns the credit that a message draws.
fn cost(message: &ToMaster) -> u64 {
    MESSAGE
        + match message {
            ToMaster::BricksWanted { bricks, .. }
            | ToMaster::BricksEvicted { bricks, .. }
            | ToMaster::BricksBroken { bricks, .. } => bricks.len() as u64,
            ToMaster::Result(result) => u64::from(result.bytes.unwrap_or(0)) / BYTES,
            ToMaster::RegionSplit(split) => split.begun.pixels.a.len() as u64,
            _ => 0,
        }
}

/// Most bricks that one event of the driver names: 0.4 ms of it. Longer lists are cut in pieces, so
/// that whoever else has something to say comes in between.
const PIECE: usize = 4096;

/// Cuts a message with a long list of bricks into pieces, in its order.
pub(crate) fn pieces(message: ToMaster) -> Vec<ToMaster> {
    match message {
        ToMaster::BricksWanted { set, bricks } if bricks.len() > PIECE => {
            let piece = |b: &[_]| ToMaster::BricksWanted { set, bricks: b.to_vec() };
            bricks.chunks(PIECE).map(piece).collect()
        }
        ToMaster::BricksEvicted { set, bricks } if bricks.len() > PIECE => {
            let piece = |b: &[_]| ToMaster::BricksEvicted { set, bricks: b.to_vec() };
            bricks.chunks(PIECE).map(piece).collect()
        }
        ToMaster::BricksBroken { set, bricks } if bricks.len() > PIECE => {
            let piece = |b: &[_]| ToMaster::BricksBroken { set, bricks: b.to_vec() };
            bricks.chunks(PIECE).map(piece).collect()
        }
        message => vec![message],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::brick::BrickSetKey;
    use slabcast_common::ids::BrickId;

    fn wanted(bricks: u32) -> ToMaster {
        let bricks = (0..bricks).map(BrickId).collect();
        ToMaster::BricksWanted { set: BrickSetKey::default(), bricks }
    }

    #[test]
    fn worker_that_asks_for_everything_again_and_again_gets_the_first_sum_and_the_trickle() {
        let mut account = Account::new();
        let (mut now, mut named) = (Duration::ZERO, 0);
        while now < Duration::from_secs(60) {
            now += account.take(&wanted(4096), now);
            named += 4096;
        }
        let bound = MOST + 61 * TRICKLE_PER_SEC;
        assert!(named <= bound && named > bound / 2, "{named} of {bound}");
    }

    #[test]
    fn worker_that_is_sent_what_it_asks_for_never_waits() {
        let mut account = Account::new();
        for round in 0..100_000 {
            // Bricks come one by one, the worst case, and each makes room for itself.
            let mut take = |message| assert!(account.take(&message, Duration::ZERO).is_zero());
            take(wanted(1));
            let (set, bricks) = (BrickSetKey::default(), vec![BrickId(round)]);
            take(ToMaster::BricksEvicted { set, bricks });
            take(ToMaster::BricksReceived { set, bricks: 1 });
            account.sent_bricks(1);
            assert!(account.confirms(&ToMaster::BricksReceived { set, bricks: 1 }));
            let nonce = u64::from(round);
            assert!(account.take(&ToMaster::Pong { nonce, clock_us: 0 }, Duration::ZERO).is_zero());
            account.sent(&ToWorker::Ping { nonce });
        }
    }

    #[test]
    fn worker_that_received_more_than_it_was_sent_is_found() {
        let mut account = Account::new();
        let set = BrickSetKey::default();
        account.sent_bricks(3);
        assert!(account.confirms(&ToMaster::BricksReceived { set, bricks: 2 }));
        assert!(account.confirms(&ToMaster::BricksBroken { set, bricks: vec![BrickId(1)] }));
        assert!(!account.confirms(&ToMaster::BricksReceived { set, bricks: 1 }));
    }

    #[test]
    fn long_lists_are_cut_and_keep_their_order() {
        let all: Vec<BrickId> = pieces(wanted(10_000))
            .into_iter()
            .flat_map(|piece| match piece {
                ToMaster::BricksWanted { bricks, .. } => {
                    assert!(bricks.len() <= PIECE);
                    bricks
                }
                other => panic!("{other:?}"),
            })
            .collect();
        assert!(all.into_iter().eq((0..10_000).map(BrickId)));
        assert_eq!(pieces(wanted(5)), [wanted(5)]);
    }
}
