//! The `region` schedule's own part of a frame: where the picture is cut, who takes which tile, and
//! what the frames before teach about both (DESIGN.md section 3).
//!
//! A task is one tile through all depths. There is no barrier, the master culls nothing and sends no
//! brick that was not asked for: workers do both, sheet by sheet. What is left to decide is how much
//! work a tile is and who gets it.
//!
//! **How much.** The paper's workload, pixels under bricks, is the first guess; here those of blocks
//! of 4x4x4 bricks and of whole leaves, since nothing hangs on it but the order of the first frame. From
//! then on a tile's estimate is what it took in the frame before (half of that, half of what was
//! estimated then: one disturbed measurement moves nothing), which knows what hides what, and which
//! worker was slow.
//!
//! **Who.** At first each worker gets a band of rows: bricks at a border are sent to both sides, and when
//! a path turns about the upright axis, bricks stay in their rows. Whoever drew a tile last holds its
//! bricks, so it gets it again, unless it took it from another for once. A tile moves only when one worker would else be done more than
//! [`SLACK`] later than the mean and the frame is shorter by more than its bricks take; those go along at
//! once. When all of a
//! worker's tiles are lent it takes tiles of the next frames of the path; another's tile only where there
//! is none and its owner has work for longer than two such tiles. Where a path's frames have few tiles for so
//! many threads, and the link bears it (`traffic`), each is one [`Crew`]'s.
//!
//! It refuses to know what time it is and which copy of a result counts.

use crate::macrotile::{Cut, Macrotile, Through};
use crate::roster::Roster;
use crate::{FrameJob, Micros};
use slabcast_common::blocks::{Block, Blocks};
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::WorkerId;
use slabcast_common::occlusion::Rect;
use std::collections::BTreeMap;

/// How much later than the mean a worker may be done before a tile of it moves, as a fraction. Tiles of
/// 64 pixels are 2 % of a frame of 512 each. At half, noise of the measurement moves tiles and their
/// bricks to and fro; at double, 15 workers wait for the slowest for a tenth of a frame.
const SLACK: f64 = 0.06;

/// Above this a worker is late enough for many tiles to move at once; below, one does. A worker of half
/// the speed among four is late by 60 %; what the system does on the side makes one late by a tenth.
const LATE: f64 = 0.25;

/// What moving a brick costs a frame, in microseconds: 1.2 KB of it at 1 Gbit/s take 9, once, and what is gained is
/// gained in each frame until the view has turned away; so a third. A tile of 64 pixels is drawn from some 100 in
/// 0.6 ms, and moves when a frame is shorter by half of that. At 9 no tile ever moved where 15 workers have 1.6 ms
/// each of a frame: it took 3.3 ms (mri256 `peer-opaque`, 512x512), and 2.9 at this, for 8 % more bricks.
const BRICK: f64 = 3.0;

/// How long an owner that says nothing keeps its tiles from those who have nothing to do, beyond twice
/// what the tile takes: the scheduling of two busy machines, as for tasks that are late.
const FORBEARANCE: Micros = 5_000;

/// Tiles for a thread beyond which a coarser cut is taken. Messages of a tile of 64 pixels cost a thread some
/// 40 us of its 600; one of 128 takes a tenth longer to draw than four of 64 (mri256 `peer-opaque`, EPYC). At 12 one
/// worker drew that in tiles of 128, at 84 % of what it could; now at 89.
const MANY: u64 = 64;

/// The edge at which tiles are counted for that.
const PLAIN: u32 = 64;

/// Crews that share out the frames of a path ([`Crew`]).
pub(crate) const CREWS: u32 = 2;

/// With fewer tiles of 64 pixels for a thread, crews draw frames in turn. At 2.6 tiles (mri256 at 512x512 on 15
/// workers) crews have 79 % of n times one worker's frames, and all together 68; at 4.8 (8 workers) and 8.8 (at
/// 1024x1024, 15 workers) one has as many as the other, and a frame is there in half the time without.
const FEW: f64 = 4.0;

/// Most blocks that stand for bricks: 60 us to project. Twice as many know the outline better by half a
/// leaf and cost twice that on the master's one thread.
const BLOCKS: usize = 2048;

/// Edge of the smallest, four bricks, as a power of two.
const SMALLEST: u32 = 5;

/// What is known of a tile from the frame before.
#[derive(Clone, Debug)]
struct Known {
    /// Who drew it last.
    owner: WorkerId,
    /// Whose it was to be. Who has nothing to do takes a tile for once: next time it is drawn where its
    /// neighbours are, lest borders, and with them bricks that two workers hold, become more and more.
    home: WorkerId,
    /// What it takes its owner.
    us: f64,
    /// Places of the bricks that it was drawn from.
    touched: Vec<u32>,
}

/// What frames of one kind (a brick set, a size of pictures, a size of tiles) teach the next one.
#[derive(Debug)]
struct Lessons {
    kind: Kind,
    tiles: BTreeMap<(i32, i32), Known>,
}

/// What the schedule remembers.
#[derive(Debug, Default)]
pub(crate) struct Memory {
    blocks: Option<(BrickSetKey, Blocks)>,
    lessons: Vec<Lessons>,
}

impl Memory {
    /// Boxes around neighbouring bricks, together around all: where anything may be seen.
    fn blocks(&mut self, key: BrickSetKey, bricks: &[BrickInfo]) -> &[Block] {
        if self.blocks.as_ref().is_none_or(|(k, _)| *k != key) {
            self.blocks = Some((key, Blocks::of(bricks, SMALLEST, BLOCKS)));
        }
        self.blocks.as_ref().map_or(&[], |(_, blocks)| blocks.all())
    }

    fn known(&self, kind: Kind, tile: &Rect) -> Option<&Known> {
        let lessons = self.lessons.iter().find(|l| l.kind == kind)?;
        lessons.tiles.get(&(tile.x0, tile.y0))
    }

    /// The bricks that a tile was drawn from in the frame before, if by another worker.
    pub(crate) fn moving(
        &self,
        regions: &Regions,
        tile: &Rect,
        worker: WorkerId,
    ) -> Option<&[u32]> {
        let known = self.known(regions.kind, tile)?;
        (known.owner != worker).then_some(&known.touched[..])
    }

    /// A tile was drawn.
    pub(crate) fn learn(
        &mut self,
        regions: &Regions,
        tile: &Rect,
        (owner, home): (WorkerId, WorkerId),
        us: Micros,
        touched: &[u32],
    ) {
        let before = self.known(regions.kind, tile).filter(|k| k.owner == owner).map(|k| k.us);
        let us = us as f64;
        let us = before.map_or(us, |before| 0.5 * (before + us));
        let at = self.lessons.iter().position(|l| l.kind == regions.kind).unwrap_or_else(|| {
            if self.lessons.len() == KINDS {
                self.lessons.remove(0);
            }
            self.lessons.push(Lessons { kind: regions.kind, tiles: BTreeMap::new() });
            self.lessons.len() - 1
        });
        let lessons = &mut self.lessons[at];
        let known = Known { owner, home, us, touched: touched.to_vec() };
        lessons.tiles.insert((tile.x0, tile.y0), known);
    }
}

/// Which workers draw a frame: all, or one crew of several, while the others draw the frames beside it.
///
/// A frame in the making alone is everybody's, and soonest there. Of a path of which several are in the making it
/// matters how many are done in a second, and there each worker of half of them does with half as many frames
/// twice as much of each: it makes its tables and opens its blocks half as often, has twice as many tiles to choose
/// from, so that they may be larger, and the master has half as many leases and messages. What it costs is a
/// frame that takes twice as long, and bricks: both crews hold what the view needs.
///
/// Whose crew a worker is in hangs on its name alone, so that nobody changes sides when another leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Crew {
    index: u32,
    of: u32,
}

impl Crew {
    /// Everybody.
    const ALL: Crew = Crew { index: 0, of: 1 };

    /// Whether a worker is in it.
    fn has(self, id: WorkerId) -> bool {
        id.0 % u64::from(self.of) == u64::from(self.index)
    }

    /// Whether it is, or has in it, the crew of this number.
    pub(crate) fn is_busy_as(self, index: u32) -> bool {
        self.of == 1 || self.index == index
    }

    /// Who stays of it.
    fn members(self, roster: &Roster) -> impl Iterator<Item = (WorkerId, u64)> {
        let threads = roster.staying().map(|(id, w)| (id, u64::from(w.threads)));
        threads.filter(move |(id, _)| self.has(*id))
    }

    /// Whose a frame is that comes to so many tiles of 64 pixels: the `beside`th crew's, where there is more than
    /// one frame.
    fn of_frame(beside: Option<u32>, tiles: usize, roster: &Roster) -> Crew {
        let Some(index) = beside else { return Crew::ALL };
        let few = (tiles as f64) < FEW * roster.threads() as f64;
        let crew = |index| Crew { index, of: CREWS };
        // A crew of one has nobody to share with, and frames come in their order: a weak crew would hold the
        // strong one up. Names that are odd and even need not come in equal numbers.
        let all = (0..CREWS).all(|i| crew(i).members(roster).count() > 1);
        let strong = || (0..CREWS).map(|i| crew(i).members(roster).map(|m| m.1).sum::<u64>());
        let (least, most) = (strong().min().unwrap_or(0), strong().max().unwrap_or(0));
        if few && all && 5 * least >= 3 * most { crew(index) } else { Crew::ALL }
    }
}

/// What frames learn from each other by: a brick set, a size of pictures and one of tiles, and who draws.
type Kind = (BrickSetKey, [u32; 2], u32, Crew);

/// Kinds that are remembered: crews each, and everybody, at the beginning or the end of a path.
const KINDS: usize = 1 + CREWS as usize;

/// A frame's regions.
#[derive(Debug)]
pub(crate) struct Regions {
    kind: Kind,
    /// Whose each tile is, by its place in the queue.
    owners: Vec<WorkerId>,
    /// Places of each worker's, ascending where nothing moved.
    owned: BTreeMap<WorkerId, Vec<u32>>,
    /// Whose it was before anybody took it from them.
    homes: Vec<WorkerId>,
    /// What each took its last owner, if that is known.
    took: Vec<Option<(WorkerId, f64)>>,
    pace: Pace,
}

impl Regions {
    /// Cuts a frame's picture, estimates its tiles and shares them out among those who stay, or among the
    /// `beside`th crew of them.
    pub(crate) fn cut(
        job: &FrameJob,
        beside: Option<u32>,
        roster: &Roster,
        memory: &mut Memory,
    ) -> (Cut, Regions) {
        let (key, size) = (job.scene.bricks, job.view.size);
        let blocks = memory.blocks(key, &job.bricks);
        let rects: Vec<Rect> =
            blocks.iter().filter_map(|b| Some(job.view.project(&b.tight)?.rect)).collect();
        let through = Through::new(size, &rects);
        let plain = through.count(PLAIN);
        let crew = Crew::of_frame(beside, plain, roster);
        let threads = crew.members(roster).map(|m| m.1).sum::<u64>();
        let wanted = (job.work.tiles_per_worker * threads as f64).ceil() as u64;
        let many = wanted.max(MANY * threads);
        let mut cut = through.cut((wanted, many), job.work.tile);
        let kind = (key, size, cut.edge, crew);
        let known = |t: &Macrotile| memory.known(kind, &t.rect).map(|k| (k.owner, k.us));
        let pace = Pace::of(&cut.tiles, &known);
        pace.correct(&mut cut.tiles, &known);
        cut.sort(size);
        let bricks = |t: &Macrotile| memory.known(kind, &t.rect).map_or(0, |k| k.touched.len());
        let home = |t: &Macrotile| memory.known(kind, &t.rect).map(|k| k.home);
        let owners = share(&cut.tiles, roster, crew, &pace, &known, (&home, &bricks));
        let took = cut.tiles.iter().map(known).collect();
        let mut owned = BTreeMap::<WorkerId, Vec<u32>>::new();
        for (&owner, place) in owners.iter().zip(0..) {
            owned.entry(owner).or_default().push(place);
        }
        (cut, Regions { kind, homes: owners.clone(), owners, owned, took, pace })
    }

    /// Who draws it.
    pub(crate) fn crew(&self) -> Crew {
        self.kind.3
    }

    /// Those whose tiles these are and who are gone, or leave.
    pub(crate) fn orphaning(&self, roster: &Roster) -> Vec<WorkerId> {
        let gone = |id: &WorkerId| roster.get(*id).is_none_or(|w| w.leaving);
        self.owned.keys().copied().filter(gone).collect()
    }

    /// Whose a task is next time, if this worker drew it now.
    pub(crate) fn home(&self, place: u32, drew: WorkerId, roster: &Roster) -> WorkerId {
        let home = self.homes[place as usize];
        if roster.get(home).is_some_and(|w| !w.leaving) { home } else { drew }
    }

    /// Whose a task is.
    pub(crate) fn owner(&self, place: u32) -> WorkerId {
        self.owners[place as usize]
    }

    /// All that are a worker's.
    pub(crate) fn owned(&self, id: WorkerId) -> &[u32] {
        self.owned.get(&id).map_or(&[], Vec::as_slice)
    }

    /// What a task took its last owner, in microseconds.
    pub(crate) fn took(&self, place: u32) -> Option<f64> {
        self.took[place as usize].map(|(_, us)| us)
    }

    /// How long each worker has to do with what of these tasks is its own, in microseconds.
    pub(crate) fn left(
        &self,
        open: impl Iterator<Item = u32>,
        roster: &Roster,
    ) -> BTreeMap<WorkerId, f64> {
        let mut left = BTreeMap::new();
        for place in open {
            if let Some((_, us)) = self.took[place as usize] {
                let owner = self.owners[place as usize];
                let threads = roster.get(owner).map_or(1, |w| w.threads);
                *left.entry(owner).or_default() += us / f64::from(threads);
            }
        }
        left
    }

    /// Whether a worker without work should take another's task, whose owner has to do for so long. Of
    /// what was never drawn nobody holds the bricks.
    pub(crate) fn is_worth_taking(
        &self,
        place: u32,
        worker: WorkerId,
        left: &BTreeMap<WorkerId, f64>,
    ) -> bool {
        let Some((last, us)) = self.took[place as usize] else { return true };
        let owner = self.owners[place as usize];
        let here = us * self.pace.slowness(worker) / self.pace.slowness(last);
        left.get(&owner).is_none_or(|left| *left > 2.0 * here)
    }

    /// Whose a task is, and how long its owner may be silent before it is anybody's.
    pub(crate) fn forbearance(&self, place: u32) -> (WorkerId, Micros) {
        let us = self.took[place as usize].map_or(0.0, |(_, us)| us);
        (self.owners[place as usize], FORBEARANCE + (2.0 * us) as Micros)
    }

    /// Another worker takes a task.
    pub(crate) fn moves(&mut self, place: u32, worker: WorkerId) {
        let before = std::mem::replace(&mut self.owners[place as usize], worker);
        if before != worker {
            // Who owned one stays among those whose loss is looked for.
            self.owned.entry(before).or_default().retain(|p| *p != place);
            self.owned.entry(worker).or_default().push(place);
        }
    }
}

/// How long guessed units take.
#[derive(Debug)]
struct Pace {
    /// Of each worker whose tiles are known: guessed units and microseconds.
    workers: BTreeMap<WorkerId, (f64, f64)>,
    /// Microseconds that a unit takes, in the mean; 1 before anything is known.
    mean: f64,
}

/// How much slower or faster than the mean a worker must look before that is believed. The guess alone
/// makes equal workers look different by a third; a core shared with somebody is slower by half.
const BELIEVED: f64 = 2.0;

impl Pace {
    fn of(tiles: &[Macrotile], known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>) -> Pace {
        let mut workers = BTreeMap::<WorkerId, (f64, f64)>::new();
        for t in tiles {
            if let Some((owner, us)) = known(t) {
                let (units, took) = workers.entry(owner).or_default();
                *units += t.est as f64;
                *took += us;
            }
        }
        let (units, us) =
            workers.values().fold((0.0, 0.0), |(a, b), (units, us)| (a + units, b + us));
        let mean = if units > 0.0 && us > 0.0 { us / units } else { 1.0 };
        Pace { workers, mean }
    }

    /// How many times longer than in the mean it takes a worker, as far as that is believed.
    fn slowness(&self, worker: WorkerId) -> f64 {
        let Some(&(units, us)) = self.workers.get(&worker) else { return 1.0 };
        let slow = if units > 0.0 { us / units / self.mean } else { 1.0 };
        if (1.0 / BELIEVED..=BELIEVED).contains(&slow) { 1.0 } else { slow.clamp(0.01, 100.0) }
    }

    /// Puts what tiles took in the place of what they are guessed to take: in guessed units, so that
    /// the two can stand beside each other.
    fn correct(
        &self,
        tiles: &mut [Macrotile],
        known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    ) {
        let mean = self.mean;
        for t in tiles {
            if let Some((_, us)) = known(t) {
                t.est = ((us / mean) as u64).max(1);
            }
        }
    }
}

/// Whose each tile is: at first in bands, then its last owner's, unless that one would be done late; a
/// new one's the least loaded worker's. Loads are times.
fn share(
    tiles: &[Macrotile],
    roster: &Roster,
    crew: Crew,
    pace: &Pace,
    known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    (home, bricks): (&impl Fn(&Macrotile) -> Option<WorkerId>, &impl Fn(&Macrotile) -> usize),
) -> Vec<WorkerId> {
    let staying: Vec<(WorkerId, f64)> =
        crew.members(roster).map(|(id, threads)| (id, threads as f64)).collect();
    if staying.is_empty() {
        return vec![WorkerId(0); tiles.len()];
    }
    let place = |id: WorkerId| staying.binary_search_by_key(&id, |s| s.0).ok();
    let mean = pace.mean;
    let slowness: Vec<f64> = staying.iter().map(|s| pace.slowness(s.0)).collect();
    // What is known of each tile is looked up once: the loops below ask for it again and again.
    let takes = |t: &Macrotile| match known(t) {
        Some((owner, us)) => (us, pace.slowness(owner)),
        None => (t.est as f64 * mean, 1.0),
    };
    let takes: Vec<(f64, f64)> = tiles.iter().map(takes).collect();
    let homes: Vec<Option<usize>> = tiles.iter().map(|t| home(t).and_then(place)).collect();
    let cost = |i: usize, w: usize| takes[i].0 * slowness[w] / takes[i].1 / staying[w].1;
    let mut load = vec![0.0; staying.len()];
    // In the order of rows.
    let mut order: Vec<usize> = (0..tiles.len()).collect();
    order.sort_by_key(|&i| (tiles[i].rect.y0, tiles[i].rect.x0));
    let mut owners = vec![0; tiles.len()];
    if homes.iter().all(Option::is_none) {
        // Bands of rows, as high as each is fast.
        let fast = |w: usize| staying[w].1 / slowness[w];
        let all = (0..staying.len()).map(fast).sum::<f64>();
        let work = tiles.iter().map(|t| t.est as f64).sum::<f64>();
        let (mut w, mut until, mut done) = (0, fast(0) / all * work, 0.0);
        for &i in &order {
            let half = 0.5 * tiles[i].est as f64;
            while done + half > until && w + 1 < staying.len() {
                w += 1;
                until += fast(w) / all * work;
            }
            done += 2.0 * half;
            owners[i] = w;
            load[w] += cost(i, w);
        }
    } else {
        for &i in &order {
            if let Some(w) = homes[i] {
                owners[i] = w;
                load[w] += cost(i, w);
            }
        }
        for &i in order.iter().filter(|&&i| homes[i].is_none()) {
            let after = |w: &usize| load[*w] + cost(i, *w);
            let least = (0..staying.len()).min_by(|a, b| after(a).total_cmp(&after(b)));
            owners[i] = least.unwrap_or(0);
            load[owners[i]] += cost(i, owners[i]);
        }
    }
    for moved in 0..tiles.len() {
        let by = |a: &usize, b: &usize| load[*a].total_cmp(&load[*b]);
        let ends = ((0..load.len()).max_by(by), (0..load.len()).min_by(by));
        let (Some(most), Some(least)) = ends else { break };
        let mean = load.iter().sum::<f64>() / load.len() as f64;
        let late = load[most] / mean - 1.0;
        // Not a number where nothing takes time.
        if !(late > LATE || late > SLACK && moved == 0) {
            break;
        }
        // Of those that leave both earlier than the later one was, by enough to be worth it and to pay for
        // the bricks that move, the one nearest to what the other has; else the largest.
        let better = |i: &usize| {
            if owners[*i] != most {
                return false;
            }
            let (from, to) = (cost(*i, most), cost(*i, least));
            let after = (load[most] - from).max(load[least] + to);
            load[least] + to < load[most] - 0.5 * from
                && load[most] - after > BRICK * bricks(&tiles[*i]) as f64
        };
        let apart = |i: usize| {
            let near = |j: usize| {
                let (a, b) = (&tiles[i].rect, &tiles[j].rect);
                a.x0.abs_diff(b.x0) + a.y0.abs_diff(b.y0)
            };
            (0..tiles.len()).filter(|&j| owners[j] == least).map(near).min().unwrap_or(0)
        };
        let Some(i) = (0..tiles.len()).filter(better).min_by_key(|&i| apart(i)) else { break };
        load[most] -= cost(i, most);
        load[least] += cost(i, least);
        owners[i] = least;
    }
    owners.into_iter().map(|w| staying[w].0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn roster(threads: &[u32]) -> Roster {
        let mut roster = Roster::default();
        for (i, &threads) in threads.iter().enumerate() {
            roster.join(WorkerId(i as u64 + 1), format!("w{i}"), threads, 0);
        }
        roster
    }

    fn tiles(n: i32) -> Vec<Macrotile> {
        let rect = |i| Rect::new(64 * i, 0, 64 * i + 64, 64);
        (0..n).map(|i| Macrotile { rect: rect(i), est: 4096 }).collect()
    }

    /// Each was drawn where it belongs.
    fn at_home(
        known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    ) -> impl Fn(&Macrotile) -> Option<WorkerId> {
        |t| known(t).map(|k| k.0)
    }

    /// Shared among everybody, of whom this much is known; nobody has bricks.
    fn among_all(
        tiles: &[Macrotile],
        roster: &Roster,
        known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    ) -> Vec<WorkerId> {
        let pace = Pace::of(tiles, known);
        share(tiles, roster, Crew::ALL, &pace, known, (&at_home(known), &|_| 0))
    }

    fn shares(owners: &[WorkerId]) -> Vec<usize> {
        let count = |w: u64| owners.iter().filter(|o| o.0 == w).count();
        (1..=3).map(count).collect()
    }

    #[test]
    fn first_shares_are_as_threads_and_later_ones_stay() {
        let (tiles, roster) = (tiles(24), roster(&[1, 2, 3]));
        let owners = among_all(&tiles, &roster, &|_| None);
        assert_eq!(shares(&owners), [4, 8, 12]);
        assert!(owners.is_sorted(), "in bands");
        let at = |t: &Macrotile| (t.rect.x0 / 64) as usize;
        // Each took what it was guessed to, or nearly.
        let known = |t: &Macrotile| Some((owners[at(t)], 1000.0 + at(t) as f64));
        let again = among_all(&tiles, &roster, &known);
        assert_eq!(again, owners);
    }

    #[test]
    fn a_frame_is_a_crews_only_beside_others_and_where_crews_are_as_strong() {
        let of = |threads: &[u32], beside, tiles| Crew::of_frame(beside, tiles, &roster(threads));
        let odd = Crew { index: 1, of: CREWS };
        assert_eq!(of(&[1; 15], Some(1), 38), odd);
        assert_eq!(of(&[1; 15], None, 38), Crew::ALL, "alone, it is everybody's");
        assert_eq!(of(&[1; 9], Some(1), 38), Crew::ALL, "tiles enough for all");
        assert_eq!(of(&[4, 4, 4, 4], Some(1), 38), odd, "threads count");
        assert_eq!(of(&[8, 1, 8, 1], Some(1), 38), Crew::ALL, "one crew is weak");
        assert_eq!(of(&[9, 9], Some(1), 38), Crew::ALL, "a crew of one");
        let members: Vec<u64> = odd.members(&roster(&[1; 5])).map(|m| m.0.0).collect();
        assert_eq!(members, [1, 3, 5]);
    }

    #[test]
    fn a_tenth_of_the_speed_gets_a_tenth_of_the_work() {
        let (tiles, roster) = (tiles(42), roster(&[1, 1, 1]));
        let owners = among_all(&tiles, &roster, &|_| None);
        assert_eq!(shares(&owners), [14, 14, 14]);
        let at = |t: &Macrotile| (t.rect.x0 / 64) as usize;
        let known = |t: &Macrotile| {
            let owner = owners[at(t)];
            Some((owner, if owner.0 == 2 { 10_000.0 } else { 1000.0 }))
        };
        let again = among_all(&tiles, &roster, &known);
        assert_eq!(shares(&again), [20, 2, 20]);
    }

    #[test]
    fn a_tile_moves_only_if_that_pays_for_its_bricks() {
        let (tiles, roster) = (tiles(12), roster(&[1, 1]));
        let at = |t: &Macrotile| t.rect.x0 / 64;
        // Seven tiles of 1 ms against five: half of a millisecond is won by moving one.
        let known = |t: &Macrotile| Some((WorkerId(if at(t) < 7 { 1 } else { 2 }), 1000.0));
        let pace = Pace::of(&tiles, &known);
        let moved = |bricks: usize| {
            let owners =
                share(&tiles, &roster, Crew::ALL, &pace, &known, (&at_home(&known), &|_| bricks));
            owners.iter().filter(|o| o.0 == 1).count()
        };
        assert_eq!([moved(0), moved(300), moved(360)], [6, 6, 7]);
    }

    #[test]
    fn whose_owner_is_gone_is_shared_and_who_comes_gets_a_share() {
        let tiles = tiles(30);
        let at = |t: &Macrotile| t.rect.x0 / 64;
        let known = |t: &Macrotile| Some((WorkerId(if at(t) < 20 { 1 } else { 9 }), 500.0));
        let owners = among_all(&tiles, &roster(&[1, 1, 1]), &known);
        let counts = shares(&owners);
        assert!(counts.iter().all(|n| (9..=12).contains(n)), "{counts:?}");
        let kept = owners[..20].iter().filter(|o| o.0 == 1).count();
        assert_eq!(kept, counts[0], "it keeps of its own");
    }

    #[test]
    fn estimates_are_corrected_in_units_of_the_guess() {
        let mut tiles = tiles(3);
        let known = |t: &Macrotile| match t.rect.x0 {
            0 => Some((WorkerId(1), 300.0)),
            64 => Some((WorkerId(1), 100.0)),
            _ => None,
        };
        Pace::of(&tiles, &known).correct(&mut tiles, &known);
        assert_eq!(tiles.iter().map(|t| t.est).collect::<Vec<_>>(), [6144, 2048, 4096]);
    }
}
