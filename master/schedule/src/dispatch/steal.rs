//! Work stealing (`region` schedule): an idle worker takes a waiting tile of the worker that would
//! end later, or, at the end of a sole frame, a piece of a tile that is being rendered
//! (docs/design/cluster.md section 3: take-over with its state).
//!
//! ```text
//! a thread is idle                    takes a waiting tile of another worker      (steal_waiting)
//! no tile waits                       the longest running region is to be split   (find_pieces)
//! its worker cuts it at a sheet       it keeps a part; the rest comes as a state  (take_piece)
//! the piece is a task like any other  lent with its state to an idle worker
//! ```
//!
//! Before the frame tiles are assigned by what they took in the frame before. What that does not
//! know is mended here: a view in which a tile takes longer, a worker that is slower than it was.
//! Pieces render nothing twice but the voxels at their border and at the cut sheet. So they come
//! before a speculative copy, which is left for workers that do not answer.
//!
//! The first lease goes on, for what is left of its tile. A worker that has finished its region
//! when the question arrives has nothing to give, and its result counts as ever. If it is lost
//! after it gave a piece away, the piece is not; what it kept is rendered again from the front. The
//! price is that a task's tile may shrink while it is lent, so it must not be lent twice then:
//! where another worker was lent it meanwhile, the piece is dropped, and so is what its giver
//! sends.
//!
//! Statistics and the cost history are of the whole tile ([`SplitGroup`]).

use crate::Micros;
use crate::dispatch::lend::NewLeases;
use crate::dispatch::speculate::patience_us;
use crate::policy::cost_history::WHOLE_PX;
use crate::policy::macrotile::Macrotile;
use crate::state::cluster::Cluster;
use crate::state::frame::StepContext;
use crate::state::region_frame::RegionFrame;
use crate::state::result_checks::check_sums;
use crate::state::task_queue::{End, Lease, TaskQueue};
use crate::state::worker_map::WorkerMap;
use slabcast_common::ids::{Epoch, WorkerId};
use slabcast_common::image::LEAF_EDGE;
use slabcast_common::message::{RegionSplit, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Tuning (us): time until a piece that is asked for now is rendered: the question, the piece to
/// the master and on to an idle worker, and bricks that nobody prefetched. At 300 and 800 frames
/// change by their noise.
const PIECE_TRANSFER_US: f64 = 500.0;

/// Tuning (us): what stealing has to win, to be worth its messages. At 150 twice as many pieces are
/// asked for, and 64 workers win nothing by them (mri256 `peer-semi` at 1536x1536).
const STEAL_GAIN_US: f64 = 300.0;

/// Tuning (ratio): rendering time of the pieces of a region to that of the region.
const PIECE_TIME_RATIO: f64 = 1.1;

/// Limit: bytes of a piece's state, which pass the link twice: 64x32 pixels in a scene that fills
/// them.
const PIECE_STATE_BYTES: f64 = 48_000.0;

/// Limit: least and largest part that is asked for, of what is left of a region.
const PIECE_SHARE: [f64; 2] = [0.15, 0.95];

/// A lease that is to be split: index of its task, worker, attempt.
type Victim = (u32, WorkerId, Epoch);

/// Leases to split, and how many thousandths of what is left to ask for.
pub(super) type Questions = Vec<(Victim, u32)>;

/// A tile of which pieces were given away, with all its pieces.
#[derive(Debug)]
pub(crate) struct SplitGroup {
    /// The whole tile, and its first owner.
    pub(crate) tile: Rect,
    pub(crate) owner: WorkerId,
    /// Tasks without a result.
    open: u32,
    /// Rendering time of all tasks, and the bricks they used.
    us: Micros,
    bricks: Vec<u32>,
}

impl SplitGroup {
    /// Returns the rendering time of all tasks, and the bricks they used.
    pub(crate) fn cost(&self) -> (Micros, &[u32]) {
        (self.us, &self.bricks)
    }
}

/// The pieces of a frame.
#[derive(Debug, Default)]
pub(crate) struct Splits {
    /// Tasks whose workers were asked for a piece, and when.
    asked: BTreeMap<u32, (WorkerId, Micros)>,
    /// The task of the whole tile that each piece comes from.
    roots: BTreeMap<u32, u32>,
    /// Groups with tasks that have no result, by root.
    groups: BTreeMap<u32, SplitGroup>,
}

impl Splits {
    /// Forgets that a task's worker was asked for a piece. Returns the worker.
    pub(crate) fn forget_question(&mut self, place: u32) -> Option<WorkerId> {
        self.asked.remove(&place).map(|asked| asked.0)
    }

    /// Forgets all questions to a worker.
    pub(crate) fn forget_worker(&mut self, id: WorkerId) {
        self.asked.retain(|_, (asked, _)| *asked != id);
    }

    /// Returns until when to wait for a piece of a task; 0 if none was asked for.
    pub(crate) fn asked_until(&self, place: u32) -> Micros {
        let patience = patience_us(0.0);
        self.asked.get(&place).map_or(0, |(_, asked)| asked.saturating_add(patience))
    }

    /// Returns until when to wait for each piece that is asked for now.
    pub(crate) fn open_questions(&self, now: Micros) -> Vec<Micros> {
        let until = self.asked.keys().map(|place| self.asked_until(*place));
        until.filter(|until| *until > now).collect()
    }

    /// Notes a result. `None`: the task's tile was not split. `Some(None)`: other tasks of the tile
    /// have no result. Otherwise the group, which is complete.
    pub(crate) fn rendered(
        &mut self,
        place: u32,
        us: Micros,
        bricks: &[u32],
    ) -> Option<Option<SplitGroup>> {
        let root = self.roots.get(&place).copied().unwrap_or(place);
        let group = self.groups.get_mut(&root)?;
        group.open -= 1;
        group.us += us;
        group.bricks.extend_from_slice(bricks);
        if group.open > 0 {
            return Some(None);
        }
        let mut group = self.groups.remove(&root)?;
        group.bricks.sort_unstable();
        group.bricks.dedup();
        Some(Some(group))
    }

    /// Returns tiles whose pieces were rendered, by root: the whole tile, its estimate, and the
    /// rendering time of the pieces.
    pub(crate) fn whole_tiles(&self, queue: &TaskQueue) -> BTreeMap<u32, (Rect, u64, Micros)> {
        let mut whole = BTreeMap::new();
        let rendered = self.roots.iter().filter(|(at, _)| self.is_part_of_a_whole(queue, **at));
        for (place, root) in rendered {
            let [task, piece] = [*root, *place].map(|place| &queue.tasks[place as usize]);
            let tile = whole.entry(*root).or_insert((task.tile.rect, task.tile.est, 0));
            tile.0 = tile.0.union(&piece.tile.rect);
            tile.1 += piece.tile.est;
            if let End::Done { render_us, .. } = piece.end {
                tile.2 += render_us;
            }
        }
        whole
    }

    /// Whether a task is a piece that counts as part of its whole tile: both were rendered.
    pub(crate) fn is_part_of_a_whole(&self, queue: &TaskQueue, place: u32) -> bool {
        let done = |at: u32| matches!(queue.tasks[at as usize].end, End::Done { .. });
        self.roots.get(&place).is_some_and(|root| done(*root) && done(place))
    }
}

/// Returns the remaining time of a region that was predicted to take `us`. One that takes longer
/// than predicted is slower than was known, by as much as it is over so far.
fn remaining_us(us: f64, elapsed: f64) -> f64 {
    (us - elapsed).abs()
}

/// Returns which share of what is left of a region to give away, for both pieces to end at once.
///
/// `quicker`: how many times quicker other workers are. `away`: time until the piece is rendered.
/// `None`: it does not pay.
fn piece_share(left: f64, quicker: f64, away: f64) -> Option<f64> {
    let share = (1.0 - away / (PIECE_TIME_RATIO * left)) / (1.0 + 1.0 / quicker);
    let ends = PIECE_TIME_RATIO * left * (1.0 - share);
    let pays = share >= PIECE_SHARE[0] && ends + STEAL_GAIN_US <= left;
    pays.then(|| share.min(PIECE_SHARE[1]))
}

/// Returns the least remaining time for which [`piece_share`] pays where others are as quick.
fn least_to_split(away: f64) -> f64 {
    (0.5 * away + STEAL_GAIN_US) / (1.0 - 0.5 * PIECE_TIME_RATIO)
}

/// A region that is probably being rendered by exactly one worker.
struct Running {
    victim: Victim,
    /// Predicted rendering time in microseconds.
    us: f64,
    /// When it began.
    since: Micros,
}

/// A worker that is idle soon.
struct IdleSoon {
    in_us: f64,
    id: WorkerId,
    threads: u64,
}

impl RegionFrame {
    /// Time until a piece that is asked for now is rendered, by the link's rate.
    fn piece_transfer_us(&self) -> f64 {
        PIECE_TRANSFER_US + 2.0 * PIECE_STATE_BYTES * self.costs.byte_us
    }

    /// Lends idle threads tasks that other workers own.
    pub(super) fn steal_waiting(
        &mut self,
        cluster: &mut Cluster,
        context: StepContext,
        now: Micros,
    ) -> NewLeases {
        let mut leases = Vec::new();
        // An owner that is heard is waited for longer, and none shorter: the time that was found
        // last is looked at when it has come.
        let is_known = context.freed_worker.is_some() && self.steal_at.is_some_and(|at| now < at);
        if !is_known {
            self.steal_at = None;
        }
        if !cluster.roster.any_idle_thread() {
            return leases;
        }
        let mut refused = BTreeSet::new();
        let mut left = None;
        while self.core.table.queue.waiting() > 0 {
            let may = |id: &WorkerId| {
                !refused.contains(id) && context.freed_worker.is_none_or(|freed| freed == *id)
            };
            let idle = cluster.roster.active().filter(|(id, w)| w.has_idle_thread() && may(id));
            let Some((id, _)) = idle.min_by_key(|(_, w)| w.leases) else { break };
            let queue = &self.core.table.queue;
            let left = left.get_or_insert_with(|| {
                let tasks = queue.tasks.iter().zip(0..);
                let open = tasks.filter(|(t, _)| t.end == End::Open).map(|(_, place)| place);
                self.tiles.left_us(open, &cluster.roster)
            });
            let suits = |place| {
                let task = &queue.tasks[place as usize];
                task.was_leased()
                    || task.begun.is_some()
                    || self.pays_to_steal(cluster, place, id, left)
                    || self.owner_keeps_until(place) <= now
            };
            match self.core.next_for(cluster, id, |_| true, suits) {
                Some(place) => {
                    self.give(cluster, place, id, now);
                    leases.push((id, place));
                }
                None => {
                    refused.insert(id);
                }
            }
        }
        if !is_known && !refused.is_empty() {
            let waiting = self.core.table.queue.all_waiting();
            let until = waiting.map(|place| self.owner_keeps_until(place)).min();
            self.steal_at = until.filter(|at| *at > now);
        }
        leases
    }

    /// Whether an idle worker ends earlier with a waiting task than its owner, which has so much
    /// left. Nobody holds the bricks of a tile that was never rendered.
    fn pays_to_steal(
        &self,
        cluster: &Cluster,
        place: u32,
        id: WorkerId,
        left: &WorkerMap<f64>,
    ) -> bool {
        let Some(predicted) = self.tiles.predicted(place) else { return true };
        let here = predicted.us * cluster.history.rates.ratio(id, predicted.worker);
        left.get(self.tiles.owner(place)).is_none_or(|left| *left > 2.0 * here)
    }

    /// Returns until when an owner that says nothing keeps a task from idle workers.
    fn owner_keeps_until(&self, place: u32) -> Micros {
        let heard = self.core.table.answered(self.tiles.owner(place)).max(self.core.phase_began);
        heard.saturating_add(patience_us(self.tiles.us(place).unwrap_or(0.0)))
    }

    /// Predicted rendering time of a region: as in the frame before, or by what other tasks of this
    /// frame took.
    fn expected_us(&self, place: u32) -> Option<f64> {
        let est = self.core.table.cut.tiles[place as usize].est;
        let guess = || self.core.pace.median().map(|pace| pace.render_us(est) as f64);
        self.tiles.us(place).or_else(guess)
    }

    /// Chooses which regions to split, those with most time left: one for each thread that is idle
    /// soon.
    pub(super) fn find_pieces(&mut self, cluster: &Cluster, now: Micros) -> Questions {
        let queue = &self.core.table.queue;
        if !self.core.sole || queue.waiting() > 0 || cluster.link_use.bricks_bind() {
            return Vec::new();
        }
        // If all tiles are short, none is worth splitting.
        if self.tiles.longest_us() < least_to_split(PIECE_TRANSFER_US) {
            return Vec::new();
        }
        let away = self.piece_transfer_us();
        let mut running: Vec<(f64, f64, Victim)> = self
            .running(cluster)
            .map(|r| {
                let elapsed = now.saturating_sub(r.since) as f64;
                let quicker = (elapsed / r.us.max(1.0)).max(1.0);
                (remaining_us(r.us, elapsed), quicker, r.victim)
            })
            .collect();
        running.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.2.cmp(&b.2)));
        let pays = |(left, quicker, victim): (f64, f64, Victim)| {
            // The price of its bricks is looked up only where it pays without.
            piece_share(left, quicker, away)?;
            let share = piece_share(left, quicker, away + self.piece_bricks_us(cluster, victim.0))?;
            Some((victim, (1000.0 * share) as u32))
        };
        let victims: Questions = running.into_iter().filter_map(pays).collect();
        let idle = self.idle_soon(cluster, now);
        let threads = idle.iter().filter(|i| i.in_us <= away).map(|i| i.threads).sum::<u64>();
        let ids = self.core.table.spare_ids.saturating_sub(self.splits.roots.len() as u64);
        let room = threads.min(ids).saturating_sub(self.splits.asked.len() as u64) as usize;
        // Looks again when the next worker is idle soon; or, if one is now, when a region is late
        // enough.
        self.steal_at = if victims.len() < room {
            let enough = 1.0 + least_to_split(away);
            let late = |r: Running| r.since.saturating_add((r.us + enough).min(1e15) as Micros);
            self.running(cluster).map(late).filter(|at| *at > now).min()
        } else {
            let next = idle.iter().find(|i| i.in_us > away).filter(|_| victims.len() > room);
            next.map(|i| now.saturating_add((i.in_us - away).ceil() as Micros).max(now + 1))
        };
        let asked: Questions = victims.into_iter().take(room).collect();
        let questions = asked.iter().map(|((place, id, _), _)| (*place, (*id, now)));
        self.splits.asked.extend(questions);
        asked
    }

    /// Time that the bricks of a piece take on the link: half of those of its tile overlap it.
    fn piece_bricks_us(&self, cluster: &Cluster, place: u32) -> f64 {
        let history = cluster.history.view(self.key);
        let bricks = history.map_or(0, |h| h.bricks(&self.core.table.tile(place)));
        let bytes = bricks as f64 * cluster.residency.brick_bytes(self.core.job.scene.bricks);
        0.5 * self.costs.byte_us * bytes
    }

    /// Sends the questions; the leases have left.
    pub(super) fn ask_for_pieces(&self, cluster: &mut Cluster, questions: Questions) {
        for ((place, id, epoch), share) in questions {
            let (frame, task) = (self.core.job.frame, self.core.table.queue.id(place));
            cluster.send(id, ToWorker::SplitRegion { frame, task, epoch, share });
        }
    }

    /// Returns the workers that have nothing more to do soon, earliest first. A worker that takes
    /// longer than predicted is none of them.
    fn idle_soon(&self, cluster: &Cluster, now: Micros) -> Vec<IdleSoon> {
        let table = &self.core.table;
        let mut idle = Vec::new();
        for (id, worker) in cluster.roster.active() {
            let threads = u64::from(worker.threads);
            let free = threads.saturating_sub(worker.leases);
            if free > 0 {
                idle.push(IdleSoon { in_us: 0.0, id, threads: free });
                continue;
            }
            let us = table.lent(id).iter().enumerate().map(|(i, lent)| {
                let us = self.expected_us(table.queue.place(lent.task)?)?;
                let is_running = (i as u64) < threads;
                let since = if is_running { table.started(id, lent.sent) } else { now };
                Some(us - now.saturating_sub(since) as f64).filter(|us| *us >= 0.0)
            });
            if let Some(us) = us.sum::<Option<f64>>() {
                idle.push(IdleSoon { in_us: us / threads as f64, id, threads: 1 });
            }
        }
        idle.sort_by(|a, b| a.in_us.total_cmp(&b.in_us).then(a.id.cmp(&b.id)));
        idle
    }

    /// Returns the regions that are probably being rendered by exactly one worker, and that were
    /// not asked for a piece.
    fn running<'a>(&'a self, cluster: &'a Cluster) -> impl Iterator<Item = Running> + 'a {
        let table = &self.core.table;
        table.all_lent().flat_map(move |(id, lent)| {
            let threads = cluster.roster.get(id).map_or(0, |w| w.threads);
            lent.iter().take(threads as usize).filter_map(move |lent| {
                let place = table.queue.place(lent.task)?;
                let is_asked = self.splits.asked.contains_key(&place);
                // The state of a larger tile takes longer than it saves.
                let is_small = table.tile(place).area() <= (WHOLE_PX * WHOLE_PX) as usize;
                let may = !is_asked && is_small && table.queue.is_only_lease(place, id, lent.epoch);
                let us = self.expected_us(place).filter(|_| may)?;
                let (victim, since) = ((place, id, lent.epoch), table.started(id, lent.sent));
                Some(Running { victim, us, since })
            })
        })
    }

    /// Takes a piece that a worker gave away. Returns whether it is used.
    ///
    /// # Errors
    /// The worker's message is a lie; what is wrong with it.
    pub(crate) fn take_piece(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        place: u32,
        lease: Lease,
        piece: RegionSplit,
        now: Micros,
    ) -> Result<bool, String> {
        if self.splits.forget_question(place) != Some(worker) {
            return Err("it gave away a piece of a tile that nobody asked for".into());
        }
        let tile = self.core.table.tile(place);
        check_piece(tile, &piece)?;
        let RegionSplit { kept, given, begun, .. } = piece;
        if !self.core.table.queue.is_only_lease(place, worker, lease.epoch) {
            // Another worker was lent the tile as it was.
            self.core.table.queue.release(place, worker, lease.epoch);
            return Ok(false);
        }
        let since = self.core.table.started(worker, lease.sent);
        let elapsed = now.saturating_sub(since) as f64;
        let us = self.expected_us(place).unwrap_or(0.0);
        let taker = self.taker(cluster, worker, &given, now);
        let part = given.area() as f64 / tile.area() as f64;
        let us = PIECE_TIME_RATIO * remaining_us(us, elapsed);
        self.tiles.split(place, elapsed + us * (1.0 - part), us * part, taker);
        let table = &mut self.core.table;
        let est = table.cut.tiles[place as usize].est;
        let part_of = |rect: Rect| {
            let est = (est as f64 * rect.area() as f64 / tile.area() as f64) as u64;
            Macrotile { rect, est: est.max(1) }
        };
        table.cut.tiles[place as usize] = part_of(kept);
        let task = &mut table.queue.tasks[place as usize];
        task.tile = part_of(kept);
        task.begun = task.begun.as_ref().map(|begun| Arc::new(begun.crop(tile, kept)));
        let new = table.queue.add_piece(part_of(given), Arc::new(begun));
        table.cut.add(vec![part_of(given)]);
        let root = self.splits.roots.get(&place).copied().unwrap_or(place);
        self.splits.roots.insert(new, root);
        let whole = SplitGroup { tile, owner: worker, open: 1, us: 0, bricks: Vec::new() };
        self.splits.groups.entry(root).or_insert(whole).open += 1;
        self.core.ledger.handed_over += 1;
        Ok(true)
    }

    /// Returns who is to render a piece: of the workers that can begin as soon as it is there, the
    /// one whose own tiles are nearest, which lacks least bricks.
    fn taker(&self, cluster: &Cluster, giver: WorkerId, piece: &Rect, now: Micros) -> WorkerId {
        let distance = |id: WorkerId| {
            let owned = self.tiles.owned(id).iter().map(|place| self.core.table.tile(*place));
            owned.map(|tile| distance_px(&tile, piece)).min().unwrap_or(i32::MAX)
        };
        let away = self.piece_transfer_us();
        let idle = self.idle_soon(cluster, now);
        let others = || idle.iter().filter(|i| i.id != giver);
        let soon = others().filter(|i| i.in_us <= away);
        let nearest = soon.min_by_key(|i| (distance(i.id), i.id));
        nearest.or_else(|| others().next()).map_or(giver, |i| i.id)
    }
}

/// Returns the distance of two tiles in pixels, along the axis where it is larger.
fn distance_px(a: &Rect, b: &Rect) -> i32 {
    let gap = |a: (i32, i32), b: (i32, i32)| (a.0 - b.1).max(b.0 - a.1).max(0);
    gap((a.x0, a.x1), (b.x0, b.x1)).max(gap((a.y0, a.y1), (b.y0, b.y1)))
}

/// Checks that a peer's piece and what it keeps make up a tile.
fn check_piece(tile: Rect, piece: &RegionSplit) -> Result<(), String> {
    let (kept, given) = (piece.kept, piece.given);
    let whole = !kept.is_empty() && !given.is_empty() && kept.union(&given) == tile;
    if !whole || kept.area() + given.area() != tile.area() {
        return Err("what it keeps and what it gives away do not make up its tile".into());
    }
    let lines = |r: &Rect| [r.x0, r.y0, r.x1, r.y1];
    let mut cuts = lines(&given).into_iter().zip(lines(&tile)).filter(|(at, end)| at != end);
    if cuts.any(|(at, _)| at % LEAF_EDGE as i32 != 0) {
        return Err("it cut its tile through a leaf".into());
    }
    if piece.begun.sheets.len() != parts(given).count() {
        return Err("a piece has other parts than its tile".into());
    }
    check_sums(given, &piece.begun.pixels, None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_stealing_splits_a_region_where_both_pieces_end_sooner() {
        let away = PIECE_TRANSFER_US;
        let too_late = [0.0, 400.0, 1000.0].map(|us| piece_share(us, 1.0, away));
        assert_eq!(too_late, [None; 3]);
        for us in [2500.0, 5000.0, 50_000.0] {
            for quicker in [1.0, 1.5, 8.0] {
                let share = piece_share(us, quicker, away).expect("it pays");
                let kept = PIECE_TIME_RATIO * us * (1.0 - share);
                let given = PIECE_TIME_RATIO * us * share / quicker;
                assert!((kept - (away + given)).abs() < 1.0 && kept < us, "{us}: {kept}, {given}");
            }
        }
        let least = least_to_split(away);
        assert!(piece_share(least - 1.0, 1.0, away).is_none());
        assert!(piece_share(least + 1.0, 1.0, away).is_some());
    }

    #[test]
    fn work_stealing_takes_a_late_region_for_as_late_again() {
        assert!((remaining_us(1000.0, 400.0) - 600.0).abs() < 1e-9);
        assert!((remaining_us(1000.0, 4000.0) - 3000.0).abs() < 1e-9);
    }

    #[test]
    fn work_stealing_measures_distance_between_tiles() {
        let tile = |x, y| Rect::new(x, y, x + 64, y + 64);
        let distances = [tile(64, 0), tile(64, 64), tile(192, 64), tile(0, 128)]
            .map(|r| distance_px(&tile(0, 0), &r));
        assert_eq!(distances, [0, 0, 128, 64]);
    }
}
