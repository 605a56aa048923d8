//! Hand-overs: a region that is being drawn is cut where it stands, and a worker that has nothing
//! left to do draws a piece of it from there (DESIGN.md section 3: take-over with its state;
//! `region` schedule, a frame that is alone).
//!
//! ```text
//! nothing waits, a thread is dry        the region that takes longest yet is asked for a piece      (ask_for_pieces)
//! its worker cuts it at the next sheet  it goes on with what it keeps; the rest comes as a state    (handed_over)
//! the piece is a task like any other    lent with that state to who is dry, again if he is lost
//! ```
//!
//! Before the frame tiles are dealt out by what they took in the view before (`alone`), and a last
//! one that would be late is cut as it is lent (`late`). What neither knows is found out here: a
//! view in which a tile takes longer, a worker that is slower than it was. Pieces cost no drawing
//! twice but the voxels at their border and at the cut sheet, three ways between machines, and
//! bricks. So they come before running a straggler's tile twice, which is left for who does not
//! answer.
//!
//! The first lease goes on, for what is left of its tile. So there is nothing to wait for: who has
//! drawn his region when the question comes has nothing to give, and his result counts as ever. If
//! he is lost after he gave a piece away, the piece is not; what he kept is drawn again from the
//! front. The price is that a task's tile may shrink while it is lent. It must not be lent to two
//! then: who has it as it was would send too many pixels. So where somebody else was lent it
//! meanwhile, the piece is dropped, and so is what its giver sends.
//!
//! Statistics and what is learnt for the next frame are of the whole tile ([`SplitGroup`]).

use crate::Micros;
use crate::dispatch::pace::Measured;
use crate::policy::macrotile::Macrotile;
use crate::policy::region::Regions;
use crate::state::cluster::Cluster;
use crate::state::frame::{Frame, Slab, check};
use crate::state::task_queue::{End, Verdict};
use slabcast_common::ids::{Epoch, WorkerId};
use slabcast_common::image::LEAF_EDGE;
use slabcast_common::message::{RegionSplit, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use std::collections::BTreeMap;
use std::sync::Arc;

/// What goes by until a piece is drawn that is asked for now, in microseconds: the question, the
/// piece to the master and on to who is dry, and those of its bricks that nobody thought of. At 300
/// and at 800 the figures of [`GAIN`] change by their noise.
const AWAY: f64 = 500.0;

/// Bytes of a piece, which pass the link twice: of 64x32 pixels in a scene that fills them.
const BYTES: f64 = 48_000.0;

/// How much longer the pieces of a region take together than it would have taken, at least.
const MORE: f64 = 1.1;

/// What a hand-over has to win, in microseconds, to be worth its messages. At 150 as many again are
/// asked for, and 64 workers win nothing by them (mri256 `peer-semi` at 1536x1536, `plan`).
const GAIN: f64 = 300.0;

/// The least and the most that is asked for, of what is left.
const SHARE: (f64, f64) = (0.15, 0.95);

/// So long a worker may take to answer before its tile is run twice, in microseconds: the
/// scheduling of two busy machines.
const PATIENCE: Micros = 5_000;

/// A lease of which a piece is to be given away: its place, whose it is, and which attempt.
type Leased = (u32, WorkerId, Epoch);

/// Leases that are to be asked for so many thousandths of what is left.
pub(crate) type Questions = Vec<(Leased, u32)>;

/// A tile of which pieces were given away, with all of them.
#[derive(Debug)]
pub(crate) struct SplitGroup {
    /// As it was cut first, and whose it was then.
    pub(crate) tile: Rect,
    pub(crate) owner: WorkerId,
    /// Of its tasks so many have no result.
    open: u32,
    /// What they took in all, and what they were drawn from.
    us: Micros,
    touched: Vec<u32>,
}

/// What a result says of a tile.
pub(crate) enum Drawn {
    /// Nothing of it was given away.
    Itself,
    /// Others have pieces of it.
    InPart,
    /// It was the last of the tile's at this place.
    Whole(u32, SplitGroup),
}

/// How long a region takes yet that was to take so long, in microseconds, and has taken some of it.
/// What takes longer than it was to is slower than was known, by how much it is over so far.
fn left(us: f64, elapsed: f64) -> f64 {
    (us - elapsed).abs()
}

/// How much of what is left of a region is to be given away for both pieces to be done at once, if
/// others are so many times quicker and what is given is `away` for so long; `None`: it does not
/// pay.
fn share(left: f64, quicker: f64, away: f64) -> Option<f64> {
    let share = (1.0 - away / (MORE * left)) / (1.0 + 1.0 / quicker);
    let ends = MORE * left * (1.0 - share);
    (share >= SHARE.0 && ends + GAIN <= left).then(|| share.min(SHARE.1))
}

/// The least that has to be left for [`share`] to pay, where others are as quick: half of it, drawn
/// as a piece, and half of the way are to be shorter by [`GAIN`].
fn least(away: f64) -> f64 {
    (0.5 * away + GAIN) / (1.0 - 0.5 * MORE)
}

/// [`AWAY`], by a link as quick as was seen.
fn away(cluster: &Cluster) -> f64 {
    AWAY + cluster.link_use.rate().map_or(0.0, |rate| 2.0 * BYTES / rate)
}

impl Frame {
    /// Of which regions, those that take longest yet, pieces are asked for: one for each thread
    /// that has nothing to do soon.
    pub(crate) fn find_pieces(&mut self, cluster: &Cluster, now: Micros) -> Questions {
        self.pieces_at = None;
        let Some(slab) = self.slab.as_ref().filter(|_| self.alone) else { return Vec::new() };
        if slab.queue.waiting() > 0 || cluster.link_use.binds_alone() {
            return Vec::new();
        }
        // Where all tiles are short nobody need be looked at.
        let longest = slab.regions.as_ref().map_or(0.0, Regions::longest_us);
        if longest < least(AWAY) {
            return Vec::new();
        }
        let away = away(cluster);
        let price = |place: u32| {
            let tile = &slab.cut.tiles[place as usize].rect;
            let regions = slab.regions.as_ref();
            regions.map_or(0.0, |regions| regions.price_of_piece(place, tile, &cluster.history))
        };
        let pays = |(left, quicker, lease): (f64, f64, Leased)| {
            // What its bricks take is looked up only where it pays without.
            share(left, quicker, away)?;
            let share = share(left, quicker, away + price(lease.0))?;
            Some((lease, (1000.0 * share) as u32))
        };
        let pace = self.pace.measure();
        let drawn = self.being_drawn((cluster, slab, pace), now).into_iter();
        let drawn: Vec<_> = drawn.filter_map(pays).collect();
        let free = self.free((cluster, slab, pace), now);
        let soon = free.iter().filter(|f| f.0 <= away).map(|f| f.2).sum::<u64>();
        let names = slab.names.saturating_sub(slab.queue.tasks.len() as u64);
        let room = soon.min(names).saturating_sub(slab.handing.len() as u64) as usize;
        // When the next one is free soon; or, if one is now, when a region is late enough.
        self.pieces_at = if drawn.len() < room {
            self.overtime((cluster, slab, pace), away, now)
        } else {
            let next = free.iter().find(|f| f.0 > away).filter(|_| drawn.len() > room);
            next.map(|f| now.saturating_add((f.0 - away).ceil() as Micros).max(now + 1))
        };
        let asked: Questions = drawn.into_iter().take(room).collect();
        if let Some(slab) = &mut self.slab {
            slab.handing.extend(asked.iter().map(|((place, id, _), _)| (*place, (*id, now))));
        }
        asked
    }

    /// Asks for them; their leases are sent.
    pub(crate) fn ask_for_pieces(&self, cluster: &mut Cluster, questions: Questions) {
        let Some(slab) = &self.slab else { return };
        for ((place, id, epoch), share) in questions {
            let (frame, task) = (self.job.frame, slab.queue.id(place));
            cluster.send(id, ToWorker::SplitRegion { frame, task, epoch, share });
        }
    }

    /// Regions that workers draw now and could give pieces of: how long they take yet, and how many
    /// times quicker others are, longest first.
    fn being_drawn(
        &self,
        of: (&Cluster, &Slab, Option<Measured>),
        now: Micros,
    ) -> Vec<(f64, f64, Leased)> {
        let left = |(lease, us, since): (Leased, f64, Micros)| {
            let elapsed = now.saturating_sub(since) as f64;
            (left(us, elapsed), (elapsed / us.max(1.0)).max(1.0), lease)
        };
        let mut drawn: Vec<_> = self.running(of).map(left).collect();
        drawn.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.2.cmp(&b.2)));
        drawn
    }

    /// Workers that take leases, by when they have nothing more to do: in how many microseconds,
    /// and how many threads of theirs. Who takes longer than he was to is none of them.
    fn free(
        &self,
        (cluster, slab, pace): (&Cluster, &Slab, Option<Measured>),
        now: Micros,
    ) -> Vec<(f64, WorkerId, u64)> {
        let mut free = Vec::new();
        for (id, worker) in cluster.roster.active() {
            let threads = u64::from(worker.threads);
            let dry = threads.saturating_sub(worker.leases);
            if dry > 0 {
                free.push((0.0, id, dry));
                continue;
            }
            let answered = self.answered.get(id).copied().unwrap_or(0);
            let lent = self.lent.get(id).into_iter().flatten();
            let us = lent.enumerate().map(|(i, lent)| {
                let place = slab.queue.place(lent.task)?;
                let us = slab.us(place, pace)?;
                let drawn = if (i as u64) < threads { lent.sent.max(answered) } else { now };
                Some(us - now.saturating_sub(drawn) as f64).filter(|us| *us >= 0.0)
            });
            if let Some(us) = us.sum::<Option<f64>>() {
                free.push((us / threads as f64, id, 1));
            }
        }
        free.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        free
    }

    /// When the first region that is drawn now will have taken so much longer than it was to that a
    /// piece of it pays.
    fn overtime(
        &self,
        of: (&Cluster, &Slab, Option<Measured>),
        away: f64,
        now: Micros,
    ) -> Option<Micros> {
        // What is over its time by so much will take as much again.
        let enough = 1.0 + least(away);
        let at = |(_, us, since): (Leased, f64, Micros)| {
            since.saturating_add((us + enough).min(1e15) as Micros)
        };
        self.running(of).map(at).filter(|at| *at > now).min()
    }

    /// What threads are probably at that one worker alone has: its place, whose, and which attempt;
    /// how long it was to take, and since when.
    fn running<'a>(
        &'a self,
        (cluster, slab, pace): (&'a Cluster, &'a Slab, Option<Measured>),
    ) -> impl Iterator<Item = (Leased, f64, Micros)> + 'a {
        self.lent.iter().flat_map(move |(id, lent)| {
            let threads = cluster.roster.get(id).map_or(0, |w| w.threads);
            let answered = self.answered.get(id).copied().unwrap_or(0);
            lent.iter().take(threads as usize).filter_map(move |lent| {
                let place = slab.queue.place(lent.task)?;
                let asked = slab.handing.contains_key(&place);
                let may = !asked && slab.queue.is_only_lease(place, id, lent.epoch);
                let us = slab.us(place, pace).filter(|_| may)?;
                Some(((place, id, lent.epoch), us, lent.sent.max(answered)))
            })
        })
    }

    /// A worker gives a piece of a region away. An error is its lie.
    pub(crate) fn handed_over(
        &mut self,
        cluster: &mut Cluster,
        worker: WorkerId,
        piece: RegionSplit,
        now: Micros,
    ) -> Result<(), String> {
        let Some(slab) = &mut self.slab else { return Ok(()) };
        let verdict = slab.queue.judge(piece.task, piece.epoch, worker);
        let Verdict::Counts(place, lease) = verdict else { return Ok(()) };
        if slab.regions.is_none()
            || slab.handing.remove(&place).map(|asked| asked.0) != Some(worker)
        {
            return Err("it gave away a piece of a tile that nobody asked for".into());
        }
        let tile = slab.cut.tiles[place as usize].rect;
        check_pieces(tile, &piece)?;
        let RegionSplit { kept, given, begun, .. } = piece;
        if !slab.queue.is_only_lease(place, worker, lease.epoch) {
            // Somebody else was lent it as it was.
            slab.queue.release(place, worker, lease.epoch);
            return Ok(());
        }
        let since = lease.sent.max(self.answered.get(worker).copied().unwrap_or(0));
        let elapsed = now.saturating_sub(since) as f64;
        let Some(slab) = &self.slab else { return Ok(()) };
        let pace = self.pace.measure();
        let us = slab.us(place, pace).unwrap_or(0.0);
        let free = self.free((cluster, slab, pace), now);
        let Some(slab) = &mut self.slab else { return Ok(()) };
        let Some(regions) = &mut slab.regions else { return Ok(()) };
        let near = |id: WorkerId| {
            let owned = regions.owned(id).iter().map(|p| slab.cut.tiles[*p as usize].rect);
            owned.map(|r| far(&r, &given)).min().unwrap_or(i32::MAX)
        };
        // Of those who can have begun it as soon as it is there, who has drawn nearest to it and
        // lacks least bricks.
        let away = away(cluster);
        let soon = free.iter().filter(|f| f.0 <= away && f.1 != worker);
        let first = || free.iter().find(|f| f.1 != worker);
        let taker = soon.min_by_key(|f| (near(f.1), f.1)).or_else(first).map_or(worker, |f| f.1);
        let part = given.area() as f64 / tile.area() as f64;
        let us = MORE * left(us, elapsed);
        regions.hand_over(
            (place, &tile),
            (elapsed + us * (1.0 - part), us * part),
            taker,
            &cluster.history,
        );
        let est = slab.cut.tiles[place as usize].est;
        let of = |rect: Rect| {
            let est = (est as f64 * rect.area() as f64 / tile.area() as f64) as u64;
            Macrotile { rect, est: est.max(1) }
        };
        slab.cut.tiles[place as usize] = of(kept);
        let task = &mut slab.queue.tasks[place as usize];
        task.tile = of(kept);
        task.begun = task.begun.as_ref().map(|begun| Arc::new(begun.crop(tile, kept)));
        let at = slab.queue.add_piece(of(given), Arc::new(begun));
        slab.cut.add(vec![of(given)]);
        let root = slab.roots.get(&place).copied().unwrap_or(place);
        slab.roots.insert(at, root);
        let whole = SplitGroup { tile, owner: worker, open: 1, us: 0, touched: Vec::new() };
        slab.split_groups.entry(root).or_insert(whole).open += 1;
        self.ledger.handed_over += 1;
        self.progress(cluster);
        Ok(())
    }
}

impl Slab {
    /// Until when it is waited for a piece of a task to be given away.
    pub(crate) fn waits_for_piece(&self, place: u32) -> Micros {
        self.handing.get(&place).map_or(0, |(_, asked)| asked.saturating_add(PATIENCE))
    }

    /// The same of each piece that is waited for now.
    pub(crate) fn waits_for_pieces(&self, now: Micros) -> Vec<Micros> {
        let until = self.handing.keys().map(|place| self.waits_for_piece(*place));
        until.filter(|until| *until > now).collect()
    }

    /// How long a region was to take: as it did in the frame before, or by what others of this one
    /// took.
    fn us(&self, place: u32, pace: Option<Measured>) -> Option<f64> {
        let guess = || pace.map(|pace| pace.expects(self.cut.tiles[place as usize].est) as f64);
        self.regions.as_ref()?.took(place).or_else(guess)
    }

    /// Tiles of which pieces were given away and that were drawn: as they were cut first, with what
    /// was expected of them then, and what their pieces took.
    pub(crate) fn whole_tiles(&self) -> BTreeMap<u32, (Rect, u64, Micros)> {
        let mut whole = BTreeMap::new();
        for (at, root) in self.roots.iter().filter(|(at, _)| self.is_told_elsewhere(**at)) {
            let (task, piece) =
                (&self.queue.tasks[*root as usize], &self.queue.tasks[*at as usize]);
            let tile = whole.entry(*root).or_insert((task.tile.rect, task.tile.est, 0));
            tile.0 = tile.0.union(&piece.tile.rect);
            tile.1 += piece.tile.est;
            if let End::Done { render_us, .. } = piece.end {
                tile.2 += render_us;
            }
        }
        whole
    }

    /// Whether a task is a piece that is told as its tile's: both were drawn.
    pub(crate) fn is_told_elsewhere(&self, place: u32) -> bool {
        let done = |at: u32| matches!(self.queue.tasks[at as usize].end, End::Done { .. });
        self.roots.get(&place).is_some_and(|root| done(*root) && done(place))
    }

    /// A task was drawn, in so long and from these bricks: what that says of the tile that it is,
    /// or is a piece of.
    pub(crate) fn drawn(&mut self, place: u32, us: Micros, touched: &[u32]) -> Drawn {
        let root = self.roots.get(&place).copied().unwrap_or(place);
        let Some(group) = self.split_groups.get_mut(&root) else { return Drawn::Itself };
        group.open -= 1;
        group.us += us;
        group.touched.extend_from_slice(touched);
        if group.open > 0 {
            return Drawn::InPart;
        }
        match self.split_groups.remove(&root) {
            Some(mut group) => {
                group.touched.sort_unstable();
                group.touched.dedup();
                Drawn::Whole(root, group)
            }
            None => Drawn::Itself,
        }
    }
}

impl SplitGroup {
    /// What its tasks took in all, and what they were drawn from.
    pub(crate) fn cost(&self) -> (Micros, &[u32]) {
        (self.us, &self.touched)
    }
}

/// How far two tiles are from each other, in pixels along one axis or the other.
fn far(a: &Rect, b: &Rect) -> i32 {
    let gap = |a: (i32, i32), b: (i32, i32)| (a.0 - b.1).max(b.0 - a.1).max(0);
    gap((a.x0, a.x1), (b.x0, b.x1)).max(gap((a.y0, a.y1), (b.y0, b.y1)))
}

/// Whether what a stranger says are two pieces of a tile.
fn check_pieces(tile: Rect, piece: &RegionSplit) -> Result<(), String> {
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
    check(given, &piece.begun.pixels, None)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_piece_is_asked_for_where_both_are_done_sooner() {
        assert_eq!(
            [0.0, 400.0, 1000.0].map(|us| share(us, 1.0, AWAY)),
            [None; 3],
            "it would come too late"
        );
        for us in [2500.0, 5000.0, 50_000.0] {
            for quicker in [1.0, 1.5, 8.0] {
                let share = share(us, quicker, AWAY).expect("it pays");
                let (kept, given) = (MORE * us * (1.0 - share), MORE * us * share / quicker);
                assert!((kept - (AWAY + given)).abs() < 1.0 && kept < us, "{us}: {kept}, {given}");
            }
        }
        let least = least(AWAY);
        assert!(share(least - 1.0, 1.0, AWAY).is_none() && share(least + 1.0, 1.0, AWAY).is_some());
        assert_eq!(left(1000.0, 400.0), 600.0);
        assert_eq!(left(1000.0, 4000.0), 3000.0, "as late again");
    }

    #[test]
    fn tiles_that_touch_are_near() {
        let at = |x, y| Rect::new(x, y, x + 64, y + 64);
        assert_eq!(
            [at(64, 0), at(64, 64), at(192, 64), at(0, 128)].map(|r| far(&at(0, 0), &r)),
            [0, 0, 128, 64]
        );
    }
}
