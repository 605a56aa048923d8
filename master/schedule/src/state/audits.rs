//! Audits: a tile is drawn by two workers, and their pixels are compared.
//!
//! Pixels are exact, so two honest workers never differ, and a worker that draws what it likes is
//! found by anybody who draws the same tile. All tiles of a worker are audited until it has agreed
//! with others [`Config::audit_first`](crate::Config::audit_first) times, then a share of them, drawn
//! by a secret seed so that a worker can't tell which. Workers that are trusted (those on the
//! master's machine, unless it is told otherwise) are never audited, and their word decides alone.
//!
//! ```text
//! a result of an audited tile    is held, and the tile waits for another worker   (one vote)
//! a second one                   equal: the tile is done; both have agreed
//!                                not: a trusted worker's word counts, or a third decides
//! no other worker can compare    the tile is done, unaudited; stuck workers (5 s) don't count
//! ```
//!
//! A tile that is audited is never split, so that votes are of one rectangle. Each
//! worker has one vote on a tile, also after it dialled again. The price is a tile
//! drawn twice: sixteen for each new worker, a quarter of a frame, then one in a hundred.

use crate::account::ledger::Rendered;
use crate::{Micros, WorkerIdentity};
use slabcast_common::ids::{Epoch, FrameId, WorkerId};
use slabcast_common::message::TileResult;
use slabcast_common::occlusion::Rect;
use std::sync::Arc;

/// Limit: time in microseconds for which two workers that drew different pixels wait for a third
/// to say who is right, when nobody is there.
const UNDECIDED_US: Micros = 10_000_000;

/// A task's result with all that its accounts need, whether or not its worker is still there.
#[derive(Clone, Debug)]
pub(crate) struct Drawn {
    pub(crate) worker: WorkerId,
    pub(crate) who: Arc<WorkerIdentity>,
    pub(crate) is_trusted: bool,
    pub(crate) name: Arc<str>,
    pub(crate) thread: u32,
    pub(crate) epoch: Epoch,
    pub(crate) rendered: Rendered,
    pub(crate) bricks_used: usize,
    pub(crate) result: Box<TileResult>,
}

/// The votes on a tile so far.
#[derive(Clone, Debug, Default)]
pub(crate) struct Audit {
    votes: Vec<Drawn>,
    since: Micros,
}

/// The end of an audit.
#[derive(Debug)]
pub(crate) struct Verdict {
    pub(crate) truth: Drawn,
    /// Workers that drew the same, the truth's own too, if there were several.
    pub(crate) agreed: Vec<WorkerId>,
    /// Workers that drew something else.
    pub(crate) liars: Vec<(WorkerId, Arc<WorkerIdentity>)>,
}

/// A worker that drew other pixels than others.
#[derive(Debug)]
pub(crate) struct Lie {
    pub(crate) worker: WorkerId,
    pub(crate) who: Arc<WorkerIdentity>,
    pub(crate) frame: FrameId,
    pub(crate) tile: Rect,
}

impl Audit {
    /// Adds a vote; returns the verdict if that decides.
    pub(crate) fn add(&mut self, vote: Drawn, now: Micros) -> Option<Verdict> {
        self.votes.push(vote);
        self.since = now;
        let votes = &self.votes;
        let is_same = |a: &Drawn, b: &Drawn| a.result.pixels == b.result.pixels;
        let trusted = votes.iter().position(|v| v.is_trusted);
        let pair = || {
            let agree = |a: &Drawn, b: &Drawn| a.who != b.who && is_same(a, b);
            let twice = |i: &usize| votes[i + 1..].iter().any(|v| agree(v, &votes[*i]));
            (0..votes.len()).find(twice)
        };
        let truth = trusted.or_else(pair)?;
        let (same, others): (Vec<&Drawn>, Vec<&Drawn>) =
            votes.iter().partition(|v| is_same(v, &votes[truth]));
        let agreed = match same.len() {
            1 => Vec::new(),
            _ => same.iter().map(|v| v.worker).collect(),
        };
        let liars = others.iter().map(|v| (v.worker, v.who.clone())).collect();
        Some(Verdict { truth: self.votes.swap_remove(truth), agreed, liars })
    }

    /// Forgets the votes of a worker that drew false pixels elsewhere. Returns whether any is left.
    pub(crate) fn forget(&mut self, who: &WorkerIdentity) -> bool {
        self.votes.retain(|v| *v.who != *who);
        !self.votes.is_empty()
    }

    /// Takes the only vote where nobody can add another.
    pub(crate) fn take_sole(&mut self) -> Option<Drawn> {
        if self.votes.len() == 1 { self.votes.pop() } else { None }
    }

    /// Whether a worker has voted, on this link or an earlier one.
    pub(crate) fn has_vote_of(&self, who: &WorkerIdentity) -> bool {
        self.votes.iter().any(|v| *v.who == *who)
    }

    /// Whether a worker runs on another machine than all that have voted.
    pub(crate) fn is_elsewhere(&self, who: &WorkerIdentity) -> bool {
        self.votes.iter().all(|v| v.who.host != who.host)
    }

    /// Whether workers differ and nobody has come for long to say who is right; their names.
    pub(crate) fn undecided(&self, now: Micros) -> Option<Vec<String>> {
        let is_over = self.votes.len() > 1 && now >= self.since.saturating_add(UNDECIDED_US);
        is_over.then(|| self.votes.iter().map(|v| v.who.name.clone()).collect())
    }

    /// When [`Audit::undecided`] is asked again.
    pub(crate) fn deadline(&self) -> Option<Micros> {
        (self.votes.len() > 1).then(|| self.since.saturating_add(UNDECIDED_US))
    }
}

/// Whether a task is of the share that is audited: at random by the seed, and the same in a replay.
pub(crate) fn is_in_share(seed: u64, task: u64, share_ppm: u32) -> bool {
    let mut x = seed ^ task.wrapping_mul(0x9e37_79b9_7f4a_7c15);
    for _ in 0..2 {
        x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        x ^= x >> 31;
    }
    x % 1_000_000 < u64::from(share_ppm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::ids::TaskId;
    use slabcast_common::image::TilePixels;
    use slabcast_common::message::Pixels;

    /// A result of one pixel by a stranger, over one of its links.
    fn vote(link: u64, name: &str, opacity: f32) -> Drawn {
        let pixels = TilePixels { a: vec![opacity], colour: vec![[0; 3]], last: None };
        let result = TileResult {
            task: TaskId(0),
            epoch: Epoch(0),
            pixels: Pixels::Sums(pixels),
            bytes: None,
            counters: Default::default(),
            times: Default::default(),
            region: None,
        };
        Drawn {
            worker: WorkerId(link),
            who: Arc::new(WorkerIdentity { host: "there".into(), name: name.into() }),
            is_trusted: false,
            name: name.into(),
            thread: 0,
            epoch: Epoch(0),
            rendered: Rendered { start: 0, end: 1, p2p_us: 0 },
            bricks_used: 0,
            result: Box::new(result),
        }
    }

    #[test]
    fn votes_of_one_worker_count_once_on_whatever_links() {
        let mut audit = Audit::default();
        assert!(audit.add(vote(1, "liar", 0.5), 0).is_none());
        assert!(audit.add(vote(1, "liar", 0.5), 1).is_none(), "a second result");
        assert!(audit.add(vote(2, "liar", 0.5), 2).is_none(), "it dialled again");
        assert!(audit.add(vote(3, "a", 0.25), 3).is_none());
        let end = audit.add(vote(4, "b", 0.25), 4).expect("two that differ from it");
        assert_eq!((end.truth.who.name.as_str(), end.agreed.len()), ("a", 2));
        assert!(end.liars.iter().all(|(_, who)| who.name == "liar"));
    }

    #[test]
    fn votes_of_a_worker_that_is_shut_out_are_forgotten() {
        let mut audit = Audit::default();
        audit.add(vote(1, "liar", 0.5), 0);
        audit.add(vote(2, "a", 0.25), 1);
        let who = |name: &str| WorkerIdentity { host: "there".into(), name: name.into() };
        assert!(audit.forget(&who("liar")));
        assert!(!audit.has_vote_of(&who("liar")) && audit.undecided(u64::MAX).is_none());
        assert!(!audit.forget(&who("a")), "none is left");
    }

    #[test]
    fn share_of_audited_tasks_is_as_asked_and_depends_on_the_seed() {
        let audited = |seed| (0..100_000u64).filter(move |t| is_in_share(seed, *t, 10_000));
        for seed in [0, 1, u64::MAX] {
            assert!((900..1100).contains(&audited(seed).count()), "{}", audited(seed).count());
        }
        assert!(audited(1).ne(audited(2)));
        assert_eq!((0..1000).filter(|t| is_in_share(7, *t, 0)).count(), 0);
        assert_eq!((0..1000).filter(|t| is_in_share(7, *t, 1_000_000)).count(), 1000);
    }
}
