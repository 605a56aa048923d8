//! The `region` schedule's own part of a frame: where the picture is cut, who takes which tile, and
//! what the frames before teach about both (DESIGN.md section 3).
//!
//! A task is one tile through all depths. There is no barrier, and the master culls nothing:
//! workers do, sheet by sheet, and ask for the bricks that they lack; only what others' tiles tell
//! of, it sends ahead (`foresight`). What is left to decide is how much work a tile is and who gets
//! it.
//!
//! **How much.** The paper's workload, pixels under bricks, is the first guess; here those of
//! blocks of 4x4x4 bricks and of whole leaves, since nothing hangs on it but the order of the first
//! frame. From then on a tile's estimate is what it took in the frame before (half of that, half of
//! what was estimated then: one disturbed measurement moves nothing), which knows what hides what,
//! and which worker was slow.
//!
//! **Who.** At first each worker gets a band of rows: bricks at a border are sent to both sides,
//! and when a path turns about the upright axis, bricks stay in their rows. Who was given a tile in
//! the frame that was cut before holds its bricks, or is sent them, so it gets it again, whoever
//! drew it then. A tile moves only when one worker would else be done more than [`SLACK`] later
//! than the mean and the frame is shorter by more than its bricks take; those go along at once.
//! When all of a worker's tiles are lent it takes tiles of the next frames of the path; another's
//! tile only where there is none and its owner has work for longer than two such tiles. Where a
//! path's frames have few tiles for so many threads, and the link bears it (`traffic`), each is one
//! [`Crew`]'s.
//!
//! **Alone.** A frame that no other is in the making beside and none waits behind is there when its
//! last tile is. Its tiles are dealt out so that all are done at once, and some are cut for that
//! ([`makespan`]), before it and as they are lent (`frame::late`); where bricks take most of such
//! frames' time (`traffic`) none are, since who draws what was cut otherwise before lacks bricks.
//! So what is known is of tiles of 64 pixels in one frame and of parts of 32 in the next, and each
//! tells of the other ([`CostHistory::recall`]).
//!
//! It refuses to know what time it is and which copy of a result counts.

use crate::policy::macrotile::{Cut, Macrotile, Through};
use crate::policy::makespan;
use crate::state::tile_map::TileMap;
use crate::state::worker_map::WorkerMap;
use crate::state::workers::Roster;
use crate::{FrameJob, Micros};
use slabcast_common::blocks::{Block, Blocks};
use slabcast_common::brick::{BrickInfo, BrickSetKey};
use slabcast_common::ids::WorkerId;
use slabcast_common::occlusion::Rect;
use std::collections::BTreeMap;

/// How much later than the mean a worker may be done before a tile of it moves, as a fraction.
/// Tiles of 64 pixels are 2 % of a frame of 512 each. At half, noise of the measurement moves tiles
/// and their bricks to and fro; at double, 15 workers wait for the slowest for a tenth of a frame.
const SLACK: f64 = 0.06;

/// Above this a worker is late enough for many tiles to move at once; below, one does. A worker of
/// half the speed among four is late by 60 %; what the system does on the side makes one late by a
/// tenth.
const LATE: f64 = 0.25;

/// What moving a brick costs a frame, in microseconds: 1.2 KB of it at 1 Gbit/s take 9, once, and
/// what is gained is gained in each frame until the view has turned away; so a third. A tile of 64
/// pixels is drawn from some 100 in 0.6 ms, and moves when a frame is shorter by half of that. At 9
/// no tile ever moved where 15 workers have 1.6 ms each of a frame: it took 3.3 ms (mri256
/// `peer-opaque`, 512x512), and 2.9 at this, for 8 % more bricks.
const BRICK: f64 = 3.0;

/// How long an owner that says nothing keeps its tiles from those who have nothing to do, beyond
/// twice what the tile takes: the scheduling of two busy machines, as for tasks that are late.
const FORBEARANCE: Micros = 5_000;

/// Tiles for a thread beyond which a coarser cut is taken: to draw, one of 128 pixels takes what
/// four of 64 do, but each result costs the core that draws some 40 us of its own. Frames a second
/// of 2 and 4 workers of mri256 at 1024x1024: 70 and 141 in tiles of 64 pixels, 77 and 158 in such
/// of 128 (`plan`); a real worker that has a processor to itself takes 15.3 and 14.4 ms a frame at
/// 512x512, 37 and 34 at 1024x1024 (docs/scaling.md).
const MANY: f64 = 6.0;

/// The same of a frame that is alone, which is there when the last is done with its last tile, if
/// there are others: at 6.5 for each of 8 workers mri256 `peer-semi` at 1280x1280 takes 44.4 ms a
/// frame, and 43.4 in tiles of 64 pixels; at ten for each of 4 `peer-opaque` at 1024x1024 takes 7.4
/// ms, and 8.0 in tiles of 64.
const MANY_ALONE: f64 = 9.0;

/// The coarsest tiles of workers that are not on the master's machine: where each of few lacks
/// bricks, nothing is drawn until some come. One worker at 1 Gbit/s has 88 % of what it could in
/// tiles of 128 pixels (mri256 at 1024x1024), and 77 in such of 256.
const COARSEST: u32 = 128;

/// A frame beside others may have so many tiles of those that are asked for, where threads that
/// draw share the master's processors: each result then takes some 100 us of what they could draw
/// in, and while there are tiles of four frames nobody lacks any. Two processes of a thread each on
/// two processors take 12.9 ms a frame in tiles of 256 pixels, where they took 15.1 in such of 64
/// (mri256 `peer-opaque`, 512x512; docs/scaling.md).
const SHARED: f64 = 0.6;

/// The edge at which tiles are counted for that.
const PLAIN: u32 = 64;

/// A frame that is alone is cut into so many tiles of those that are asked for, one a thread where
/// 2.5 are, before more are cut where that pays ([`makespan`]); never into such of 16 pixels while
/// those of 32 are as many. mri256 `peer-opaque` at 512x512 on 64 workers, which began with 480
/// tiles of 16, takes 2.2 ms a frame where it took 3.6.
const BEGIN: f64 = 0.4;

/// The same for tiles of 64 pixels, where a picture has so many. What the first frame is cut into
/// the next ones of a path go on with, and small scenes (24 to 41 tiles) have up to a tenth fewer
/// frames a second if that is coarse; mri256 `peer-semi` at 1024x1024 (122 tiles) on 64 workers has
/// 68 % with one in flight where it has 66 after tiles of 32.
const LARGE: usize = 64;

/// Of a path's frames for the same threads, tiles stay as large as those of the frame before where
/// a tenth more or less of those that are asked for would be cut into such. Where a picture of a
/// path has 40 tiles of 64 pixels and the next one 41, and 40 are asked for, everybody would be
/// sent most bricks anew (mri256 on 16 workers at 1 Gbit/s: 1.2 MB, 13 ms).
const STAY: f64 = 0.1;

/// Of tiles that are asked for, a crew's frame has so many: one a thread where 2.5 are. Who is done
/// with his draws one of the crew's next frame meanwhile, and 130 tiles of 32 pixels are three
/// times as many messages as 40 of 64: mri256 at 512x512 on 40 workers has 1190 frames a second so,
/// and 800 at twice as many.
const CREW_ASKS: f64 = 0.4;

/// How much longer the parts of a tile of 64 pixels take together than the tile: 17 to 30 %, 24 of
/// mri256 `peer-semi` at 1024x1024.
const MORE: f64 = 1.24;

/// Tiles that take less say nothing of who drew them, in microseconds: tables, a block that is
/// opened, a message on the same core.
const LEAST_TOLD: f64 = 500.0;

/// Crews that share out the frames of a path ([`Crew`]).
pub(crate) const CREWS: u32 = 2;

/// With fewer tiles of 64 pixels for a thread, crews draw frames in turn. At 2.6 tiles (mri256 at
/// 512x512 on 15 workers) crews have 79 % of n times one worker's frames, and all together 68; at
/// 4.8 (8 workers) and 8.8 (at 1024x1024, 15 workers) one has as many as the other, and a frame is
/// there in half the time without.
const FEW: f64 = 4.0;

/// Most blocks that stand for bricks: 60 us to project. Twice as many know the outline better by
/// half a leaf and cost twice that on the master's one thread.
const BLOCKS: usize = 2048;

/// Edge of the smallest, four bricks, as a power of two.
const SMALLEST: u32 = 5;

/// What is known of a tile from the frame before.
#[derive(Clone, Debug)]
struct TileCost {
    /// Which frame taught it, in their order.
    frame: u64,
    /// Who drew it last.
    owner: WorkerId,
    /// What it takes its owner.
    us: f64,
    /// Places of the bricks that it was drawn from.
    touched: Vec<u32>,
}

/// What frames of one kind (a brick set, a size of pictures) teach the next one.
#[derive(Debug)]
struct ViewHistory {
    kind: Kind,
    tiles: TileMap<TileCost>,
    /// Whose each was to be in the frame that was cut last, drawn or not. Who has nothing to do
    /// takes a tile for once: next time it is drawn where its neighbours are, lest borders, and
    /// with them bricks that two workers hold, become more and more.
    homes: TileMap<WorkerId>,
    /// And its tiles' edge, for so many threads; none if it was alone.
    edge: Option<(u64, u32)>,
}

impl ViewHistory {
    fn of(kind: Kind) -> ViewHistory {
        let size = kind.1;
        ViewHistory { kind, tiles: TileMap::new(size), homes: TileMap::new(size), edge: None }
    }
}

/// What is known of a tile, and what it takes by that.
enum CostSource<'a> {
    /// It was drawn.
    Itself(&'a TileCost),
    /// The whole tile was, that it is a part of.
    Whole(&'a TileCost, f64),
    /// Its parts were.
    Parts([Option<&'a TileCost>; 4], f64),
}

/// What is recalled of a tile.
enum Recall<'a> {
    /// As it was learnt: it was drawn as it is.
    Itself(&'a TileCost),
    /// As it follows from other tiles: those that it was cut into, or the one that it is a part of.
    Others(TileCost),
}

impl Recall<'_> {
    fn known(&self) -> &TileCost {
        match self {
            Recall::Itself(known) => known,
            Recall::Others(known) => known,
        }
    }

    /// What follows from other tiles, and can't be looked up.
    fn told(&self) -> Option<&TileCost> {
        match self {
            Recall::Itself(_) => None,
            Recall::Others(known) => Some(known),
        }
    }

    /// How many bricks go along with the tile. Of a part of what was whole it is those that it lies
    /// under: some half.
    fn bricks_along(&self) -> f64 {
        let part = if self.told().is_some() { 0.5 } else { 1.0 };
        part * self.known().touched.len() as f64
    }
}

/// What the schedule remembers.
#[derive(Debug, Default)]
pub(crate) struct CostHistory {
    blocks: Option<(BrickSetKey, Blocks)>,
    lessons: Vec<ViewHistory>,
    /// Frames that were cut.
    frames: u64,
    /// How many times longer than others workers take, as far as tiles tell that were drawn by one
    /// and then by another.
    slow: WorkerMap<f64>,
}

impl CostHistory {
    /// Boxes around neighbouring bricks, together around all: where anything may be seen.
    fn blocks(&mut self, key: BrickSetKey, bricks: &[BrickInfo]) -> &[Block] {
        if self.blocks.as_ref().is_none_or(|(k, _)| *k != key) {
            self.blocks = Some((key, Blocks::new(bricks, SMALLEST, BLOCKS)));
        }
        self.blocks.as_ref().map_or(&[], |(_, blocks)| blocks.all())
    }

    /// The blocks of a set whose frames were the last to be cut.
    pub(crate) fn blocks_of(&self, key: BrickSetKey) -> Option<&Blocks> {
        self.blocks.as_ref().filter(|(k, _)| *k == key).map(|(_, blocks)| blocks)
    }

    fn known(&self, kind: Kind, tile: &Rect) -> Option<&TileCost> {
        let lessons = self.lessons.iter().find(|l| l.kind == kind)?;
        lessons.tiles.get(tile)
    }

    /// What is known of a tile of [`PLAIN`] pixels, or of a quarter of one, however the last frame
    /// cut it.
    fn recall(&self, kind: Kind, tile: &Rect) -> Option<Recall<'_>> {
        Some(match self.taught(kind, tile)? {
            CostSource::Itself(known) => Recall::Itself(known),
            CostSource::Whole(whole, us) => Recall::Others(TileCost { us, ..whole.clone() }),
            CostSource::Parts(parts, us) => {
                let most = parts.iter().flatten().max_by(|a, b| a.us.total_cmp(&b.us))?;
                let touched = parts.iter().flatten().flat_map(|k| k.touched.iter().copied());
                let mut touched: Vec<u32> = touched.collect();
                touched.sort_unstable();
                touched.dedup();
                Recall::Others(TileCost { us, touched, ..(*most).clone() })
            }
        })
    }

    /// How long it takes, as far as that is known.
    fn recall_us(&self, kind: Kind, tile: &Rect) -> Option<f64> {
        Some(match self.taught(kind, tile)? {
            CostSource::Itself(known) => known.us,
            CostSource::Whole(_, us) | CostSource::Parts(_, us) => us,
        })
    }

    /// The same of each of the parts of a whole tile.
    fn recall_parts_us(&self, kind: Kind, whole: &Rect) -> [Option<f64>; 4] {
        let Some(lessons) = self.lessons.iter().find(|l| l.kind == kind) else { return [None; 4] };
        let get = |r: &Rect| lessons.tiles.get(r);
        let (rects, one) = (quarters(whole), get(whole));
        let parts = rects.map(|r| get(&r?));
        std::array::from_fn(|i| {
            let (tile, known) = (rects[i]?, parts[i]);
            match one.filter(|one| one.frame > known.map_or(0, |k| k.frame)) {
                Some(one) => Some(part_of((one, whole), (known, &tile), &parts)),
                None => known.map(|k| k.us),
            }
        })
    }

    /// What the last frame that drew it taught of a tile: of one that it cut the sum of its parts,
    /// of parts of one that it drew whole their share of it.
    fn taught(&self, kind: Kind, tile: &Rect) -> Option<CostSource<'_>> {
        let lessons = &self.lessons.iter().find(|l| l.kind == kind)?.tiles;
        let whole = whole_of(tile, kind.1);
        let known = lessons.get(tile);
        let frame = known.map_or(0, |k| k.frame);
        let parts = || quarters(&whole).map(|part| lessons.get(&part?));
        if *tile != whole {
            let Some(one) = lessons.get(&whole).filter(|one| one.frame > frame) else {
                return known.map(CostSource::Itself);
            };
            return Some(CostSource::Whole(one, part_of((one, &whole), (known, tile), &parts())));
        }
        let parts = parts();
        let last = parts.iter().flatten().map(|k| k.frame).max().unwrap_or(0);
        if last <= frame {
            return known.map(CostSource::Itself);
        }
        let parts = parts.map(|k| k.filter(|k| k.frame == last));
        let us = parts.iter().flatten().map(|k| k.us).sum::<f64>() / MORE;
        Some(CostSource::Parts(parts, us))
    }

    /// The bricks that a tile was drawn from in the frame before, if by another worker.
    pub(crate) fn moving<'a>(
        &'a self,
        regions: &'a Regions,
        (place, tile): (u32, &Rect),
        worker: WorkerId,
    ) -> Option<&'a [u32]> {
        let known = regions.known((place, tile), self)?;
        (known.owner != worker).then_some(&known.touched[..])
    }

    /// A tile was drawn.
    pub(crate) fn learn(
        &mut self,
        regions: &Regions,
        (place, tile): (u32, &Rect),
        owner: WorkerId,
        us: Micros,
        touched: &[u32],
    ) {
        let us = us as f64;
        let before = regions.known((place, tile), self);
        let before = before.map(|k| (k.owner, k.us));
        let us = match before {
            Some((last, before)) if last == owner => 0.5 * (before + us),
            Some((last, before)) => {
                self.compare((owner, us), (last, before));
                us
            }
            None => us,
        };
        let known = TileCost { frame: regions.frame, owner, us, touched: touched.to_vec() };
        self.of_kind(regions.kind).tiles.insert(tile, known);
    }

    fn of_kind(&mut self, kind: Kind) -> &mut ViewHistory {
        let at = self.lessons.iter().position(|l| l.kind == kind).unwrap_or_else(|| {
            if self.lessons.len() == KINDS {
                self.lessons.remove(0);
            }
            self.lessons.push(ViewHistory::of(kind));
            self.lessons.len() - 1
        });
        &mut self.lessons[at]
    }

    /// Whose a tile was to be in the frame that was cut last.
    fn home(&self, kind: Kind, tile: &Rect) -> Option<WorkerId> {
        let lessons = self.lessons.iter().find(|l| l.kind == kind)?;
        lessons.homes.get(tile).copied()
    }

    /// A tile took one worker so long, and another before it: a quarter of what that says beyond
    /// what is known already is believed of either.
    fn compare(&mut self, (one, here): (WorkerId, f64), (other, there): (WorkerId, f64)) {
        // Of what takes no longer than a message nothing can be said.
        if here.min(there) < LEAST_TOLD {
            return;
        }
        let (a, b) = (self.slow(one), self.slow(other));
        let beyond = ((here / there) / (a / b)).clamp(0.1, 10.0).sqrt().sqrt();
        self.slow.insert(one, (a * beyond).clamp(0.01, 100.0));
        self.slow.insert(other, (b / beyond).clamp(0.01, 100.0));
    }

    /// How slow a worker is, beside others.
    fn slow(&self, id: WorkerId) -> f64 {
        self.slow.get(id).copied().unwrap_or(1.0)
    }

    /// How many times longer a worker takes than another, as far as that is believed.
    pub(crate) fn slower(&self, one: WorkerId, other: WorkerId) -> f64 {
        believed(self.slow(one) / self.slow(other))
    }

    /// A worker is gone.
    pub(crate) fn forget(&mut self, id: WorkerId) {
        self.slow.remove(id);
    }
}

/// Which workers draw a frame: all, or one crew of several, while the others draw the frames beside
/// it.
///
/// A frame in the making alone is everybody's, and soonest there. Of a path of which several are in
/// the making it matters how many are done in a second, and there each worker of half of them does
/// with half as many frames twice as much of each: it makes its tables and opens its blocks half as
/// often, has twice as many tiles to choose from, so that they may be larger, and the master has
/// half as many leases and messages. What it costs is a frame that takes twice as long, and bricks:
/// both crews hold what the view needs.
///
/// Whose crew a worker is in hangs on its name alone, so that nobody changes sides when another
/// leaves.
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
        let threads = roster.active().map(|(id, w)| (id, u64::from(w.threads)));
        threads.filter(move |(id, _)| self.has(*id))
    }

    /// Whether most of its threads are on the master's machine.
    fn is_local(self, roster: &Roster) -> bool {
        let here = |(id, n): (WorkerId, u64)| match roster.get(id).is_some_and(|w| w.is_local) {
            true => n as i64,
            false => -(n as i64),
        };
        self.members(roster).map(here).sum::<i64>() > 0
    }

    /// They, by their names, with the threads of each.
    fn staying(self, roster: &Roster) -> Vec<(WorkerId, f64)> {
        self.members(roster).map(|(id, threads)| (id, threads as f64)).collect()
    }

    /// Whose a frame is that comes to so many tiles of 64 pixels: the `beside`th crew's, where
    /// there is more than one frame.
    fn of_frame(beside: Option<u32>, tiles: usize, roster: &Roster) -> Crew {
        let Some(index) = beside else { return Crew::ALL };
        let few = (tiles as f64) < FEW * roster.threads() as f64;
        let crew = |index| Crew { index, of: CREWS };
        // A crew of one has nobody to share with, and frames come in their order: a weak crew would
        // hold the strong one up. Names that are odd and even need not come in equal numbers.
        let all = (0..CREWS).all(|i| crew(i).members(roster).count() > 1);
        let strong = || (0..CREWS).map(|i| crew(i).members(roster).map(|m| m.1).sum::<u64>());
        let (least, most) = (strong().min().unwrap_or(0), strong().max().unwrap_or(0));
        if few && all && 5 * least >= 3 * most { crew(index) } else { Crew::ALL }
    }
}

/// The edge of as few tiles as are enough: so many are `wanted`, for so many `threads`. `beside`:
/// other frames are in the making; `here`: the threads share the master's processors.
fn edge(through: &Through, (wanted, threads): (f64, f64), beside: bool, here: bool) -> u32 {
    let shared = beside && here;
    let for_each = if beside || threads <= 1.0 { MANY } else { MANY_ALONE };
    let many = if shared { SHARED * wanted } else { wanted.max(for_each * threads) };
    let edge = through.edge((wanted.ceil() as u64, many.ceil() as u64));
    if shared { edge } else { edge.min(COARSEST) }
}

/// The tiles' edge of a frame beside others, where the one before it had the `last`, if it was for
/// as many threads.
fn edge_beside(
    through: &Through,
    (wanted, threads): (f64, u64),
    here: bool,
    last: Option<u32>,
) -> u32 {
    // Of so many times what is asked for.
    let edge = |part: f64| edge(through, (part * wanted, part * threads as f64), true, here);
    match last {
        Some(last) => last.clamp(edge(1.0 + STAY), edge(1.0 - STAY)),
        None => edge(1.0),
    }
}

/// The tiles' edge of a frame that is alone, before any is cut in parts.
fn edge_alone(through: &Through, (wanted, threads): (f64, u64)) -> u32 {
    let edge = |wanted: f64| edge(through, (wanted, threads as f64), false, false);
    let finest = edge(wanted);
    if finest >= PLAIN {
        return finest;
    }
    let coarsest = if through.count(PLAIN) < LARGE { PLAIN / 2 } else { PLAIN };
    edge(BEGIN * wanted).min(coarsest).max(finest)
}

/// What a part takes of a tile that was drawn whole after it: as it was among the others, if they
/// were known then.
fn part_of(
    (one, whole): (&TileCost, &Rect),
    (known, part): (Option<&TileCost>, &Rect),
    parts: &[Option<&TileCost>; 4],
) -> f64 {
    let all = parts.iter().flatten().map(|k| k.us).sum::<f64>();
    let share = match known {
        Some(known) if all > 0.0 => known.us / all,
        _ => part.area() as f64 / whole.area() as f64,
    };
    MORE * share * one.us
}

/// Where a worker is among those who stay; of one in reserve, where its neighbour is, who takes its
/// place.
fn place_of(staying: &[(WorkerId, f64)], id: WorkerId, roster: &Roster) -> Option<usize> {
    let beside = |at: usize| roster.has_in_reserve(id).then(|| at.saturating_sub(1));
    staying.binary_search_by_key(&id, |s| s.0).or_else(|at| beside(at).ok_or(())).ok()
}

/// What frames learn from each other by: a brick set, a size of pictures, and who draws.
type Kind = (BrickSetKey, [u32; 2], Crew);

/// The tile of [`PLAIN`] pixels that a tile is a part of, or is, in a picture of this size.
fn whole_of(tile: &Rect, size: [u32; 2]) -> Rect {
    let edge = PLAIN as i32;
    let corner = |at: i32| at / edge * edge;
    let (x0, y0) = (corner(tile.x0), corner(tile.y0));
    Rect::new(x0, y0, x0 + edge, y0 + edge).intersect(&Rect::from_size(size))
}

/// The parts that a tile is cut into, of half of [`PLAIN`]; at the picture's border there may be
/// fewer.
fn quarters(tile: &Rect) -> [Option<Rect>; 4] {
    let half = PLAIN as i32 / 2;
    [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(x, y)| {
        let (x0, y0) = (tile.x0 + x * half, tile.y0 + y * half);
        let part = Rect::new(x0, y0, x0 + half, y0 + half).intersect(tile);
        Some(part).filter(|r| !r.is_empty())
    })
}

/// Kinds that are remembered: crews each, and everybody, at the beginning or the end of a path.
const KINDS: usize = 1 + CREWS as usize;

/// A part that a waiting tile may be cut into.
#[derive(Debug)]
pub(crate) struct Part {
    pub(crate) tile: Macrotile,
    /// What it takes, and what its bricks take who has not drawn it, in microseconds.
    pub(crate) us: f64,
    pub(crate) price: f64,
    /// What is known of it, if the frame before did not draw it as it is.
    told: Option<TileCost>,
}

/// A frame's regions.
#[derive(Debug)]
pub(crate) struct Regions {
    kind: Kind,
    /// Its number among frames that were cut.
    frame: u64,
    /// What is known of tiles that the frame before cut in another way, by their place in the
    /// queue.
    told: BTreeMap<u32, TileCost>,
    /// Whose each tile is, by its place in the queue.
    owners: Vec<WorkerId>,
    /// Places of each worker's, ascending where nothing moved.
    owned: WorkerMap<Vec<u32>>,
    /// What each took its last owner, if that is known.
    took: Vec<Option<(WorkerId, f64)>>,
    /// All that of all tiles together, and of the longest, when it was cut.
    all_us: f64,
    longest_us: f64,
    /// Microseconds that a guessed unit takes, in the mean.
    unit: f64,
    /// What a brick takes who is sent it, in microseconds.
    brick: f64,
    /// Parts that tiles can be cut into while the frame is drawn; of a frame that is alone.
    fine: Parts,
}

impl Regions {
    /// Cuts a frame's picture, estimates its tiles and shares them out among those who stay, or
    /// among the `beside`th crew of them. With where each block of bricks lies
    /// ([`CostHistory::blocks_of`]). `alone`: no other frame is in the making or waits; `bind`:
    /// bricks are what such frames wait for.
    pub(crate) fn cut(
        job: &FrameJob,
        (beside, alone): (Option<u32>, bool),
        (rate, bind): (Option<f64>, bool),
        roster: &Roster,
        history: &mut CostHistory,
    ) -> (Cut, Regions, Vec<Rect>) {
        let (key, size) = (job.scene.bricks, job.view.size);
        history.frames += 1;
        let frame = history.frames;
        let blocks = history.blocks(key, &job.bricks);
        let outline = |b: &Block| job.view.project_rect(&b.tight).unwrap_or_default();
        let outlines: Vec<Rect> = blocks.iter().map(outline).collect();
        let rects: Vec<Rect> = outlines.iter().filter(|r| !r.is_empty()).copied().collect();
        let through = Through::new(size, &rects);
        let plain = through.count(PLAIN);
        let crew = Crew::of_frame(beside, plain, roster);
        let threads = crew.members(roster).map(|m| m.1).sum::<u64>();
        let wanted = job.work.tiles_per_worker * threads as f64;
        let kind = (key, size, crew);
        let lessons = history.of_kind(kind);
        let edge = job.work.tile.unwrap_or_else(|| {
            let last = lessons.edge.filter(|(of, _)| *of == threads).map(|(_, edge)| edge);
            match alone {
                true => edge_alone(&through, (wanted, threads)),
                false => {
                    let here = crew.is_local(roster);
                    let wanted = if crew.of > 1 { CREW_ASKS * wanted } else { wanted };
                    edge_beside(&through, (wanted, threads), here, last)
                }
            }
        });
        lessons.edge = (!alone).then_some((threads, edge));
        let mut cut = through.cut(edge);
        let bytes = job.bricks.iter().map(|b| u64::from(b.bytes)).sum::<u64>();
        let wire = rate.map_or(0.0, |rate| bytes as f64 / job.bricks.len().max(1) as f64 / rate);
        let brick = BRICK + wire;
        // Whoever chose a size has it.
        let either = job.work.tile.is_none() && (PLAIN / 2..=PLAIN).contains(&cut.edge);
        let leveled = alone && either;
        let mut fine = Parts::new(size);
        // Which tiles are cut changes from frame to frame, and who is given a whole one lacks the
        // bricks of parts that others drew. So where bricks bind all are of one size, and none is
        // cut late.
        if leveled
            && !bind
            && let Some(mixed) = mixed(&through, threads as usize, (history, kind))
        {
            (cut, fine) = mixed;
        }
        let recall = |t: &Macrotile| match either {
            true => history.recall(kind, &t.rect),
            false => history.known(kind, &t.rect).map(Recall::Itself),
        };
        let mut taught = TileMap::new(size);
        for t in &cut.tiles {
            if let Some(recalled) = recall(t) {
                taught.insert(&t.rect, recalled);
            }
        }
        let recalled = |t: &Macrotile| taught.get(&t.rect);
        let of = |t: &Macrotile| recalled(t).map(Recall::known);
        let known = |t: &Macrotile| of(t).map(|k| (k.owner, k.us));
        let unit = unit(&cut.tiles, &known);
        for t in &mut cut.tiles {
            if let Some((_, us)) = known(t) {
                t.est = in_units(us, unit);
            }
        }
        cut.sort(size);
        let bricks = |t: &Macrotile| of(t).map_or(0, |k| k.touched.len());
        let slow = |id: WorkerId| history.slow(id);
        let owners = if leveled && !taught.is_empty() {
            let price = |t: &Macrotile| recalled(t).map_or(0.0, |k| brick * k.bricks_along());
            level(&cut.tiles, roster, crew, (unit, &slow), &known, &price)
        } else {
            let there = |id: &WorkerId| roster.get(*id).is_some_and(|w| !w.leaving);
            let home = |t: &Macrotile| {
                let home = history.home(kind, &t.rect).filter(there);
                home.or_else(|| Some(known(t)?.0))
            };
            share(&cut.tiles, roster, crew, (unit, &slow), &known, (&home, &bricks))
        };
        let took: Vec<Option<(WorkerId, f64)>> = cut.tiles.iter().map(known).collect();
        let us = || took.iter().flatten().map(|t| t.1);
        let (all_us, longest_us) = (us().sum(), us().fold(0.0, f64::max));
        let mut owned = WorkerMap::<Vec<u32>>::default();
        for (&owner, place) in owners.iter().zip(0..) {
            owned.or_default(owner).push(place);
        }
        let told = |(t, place): (&Macrotile, u32)| {
            let known = recalled(t)?.told()?;
            Some((place, known.clone()))
        };
        let told = cut.tiles.iter().zip(0..).filter_map(told).collect();
        drop(taught);
        let homes = &mut history.of_kind(kind).homes;
        homes.clear();
        for (t, owner) in cut.tiles.iter().zip(&owners) {
            homes.insert(&t.rect, *owner);
        }
        let regions = Regions {
            kind,
            frame,
            told,
            owners,
            owned,
            took,
            all_us,
            longest_us,
            unit,
            brick,
            fine,
        };
        (cut, regions, outlines)
    }

    /// What is known of one of its tasks, by itself or by other tiles.
    fn known<'a>(
        &'a self,
        (place, tile): (u32, &Rect),
        history: &'a CostHistory,
    ) -> Option<&'a TileCost> {
        self.told.get(&place).or_else(|| history.known(self.kind, tile))
    }

    /// Who draws it.
    pub(crate) fn crew(&self) -> Crew {
        self.kind.2
    }

    /// Those whose tiles these are and who are gone, leave, or are held in reserve.
    pub(crate) fn orphaning(&self, roster: &Roster) -> Vec<WorkerId> {
        let gone = |id: &WorkerId| roster.get(*id).is_none_or(|w| !w.is_active());
        self.owned.ids().filter(gone).collect()
    }

    /// Whose a task is.
    pub(crate) fn owner(&self, place: u32) -> WorkerId {
        self.owners[place as usize]
    }

    /// All that are a worker's.
    pub(crate) fn owned(&self, id: WorkerId) -> &[u32] {
        self.owned.get(id).map_or(&[], Vec::as_slice)
    }

    /// The parts of a waiting tile, what is guessed of each, and what they take, as far as that is
    /// known; none of what can't be cut.
    pub(crate) fn parts(&self, place: u32, tile: &Rect, history: &CostHistory) -> Vec<Part> {
        if *tile != whole_of(tile, self.kind.1)
            || tile.width().max(tile.height()) <= PLAIN as usize / 2
        {
            return Vec::new();
        }
        let there = |r: Rect| Some((r, *self.fine.get(&r)?));
        let parts: Vec<(Rect, u64)> =
            quarters(tile).into_iter().flatten().filter_map(there).collect();
        let all: u64 = parts.iter().map(|p| p.1).sum();
        let Some((_, whole)) = self.took[place as usize] else { return Vec::new() };
        let part = |(rect, est): (Rect, u64)| {
            let recalled = history.recall(self.kind, &rect);
            let guess = || MORE * whole * est as f64 / all.max(1) as f64;
            let us = recalled.as_ref().map_or_else(guess, |k| k.known().us);
            let price = recalled.as_ref().map_or(0.0, |k| self.brick * k.bricks_along());
            let told = recalled.as_ref().and_then(Recall::told).cloned();
            let est = in_units(us, self.unit);
            Part { tile: Macrotile { rect, est }, us, price, told }
        };
        parts.into_iter().map(part).collect()
    }

    /// A waiting tile's parts are these workers' from now on, at the places behind all others.
    pub(crate) fn split_waiting(&mut self, place: u32, parts: Vec<(Part, WorkerId)>) {
        let owner = self.owners[place as usize];
        let last = self.took[place as usize].map_or(owner, |t| t.0);
        self.owned.or_default(owner).retain(|p| *p != place);
        for (part, to) in parts {
            let at = self.owners.len() as u32;
            self.owners.push(to);
            self.took.push(Some((last, part.us)));
            self.owned.or_default(to).push(at);
            if let Some(known) = part.told {
                self.told.insert(at, known);
            }
        }
    }

    /// How long bricks of a piece are on the link that is given away of a tile, in microseconds: of
    /// those that the tile was drawn from before some half lies over it.
    pub(crate) fn price_of_piece(&self, place: u32, tile: &Rect, history: &CostHistory) -> f64 {
        let known = self.known((place, tile), history);
        0.5 * (self.brick - BRICK) * known.map_or(0, |k| k.touched.len()) as f64
    }

    /// Of a tile that is being drawn a piece is given away, and is this worker's, at the place
    /// behind all others. What the tile takes in all from now on, and what the piece does.
    pub(crate) fn hand_over(
        &mut self,
        (place, tile): (u32, &Rect),
        (kept, given): (f64, f64),
        taker: WorkerId,
        history: &CostHistory,
    ) {
        let (last, _) = self.took[place as usize].unwrap_or((self.owner(place), 0.0));
        self.took[place as usize] = Some((last, kept));
        let known = self.known((place, tile), history).cloned();
        let at = self.owners.len() as u32;
        self.owners.push(taker);
        self.took.push(Some((last, given)));
        self.owned.or_default(taker).push(at);
        if let Some(known) = known {
            self.told.insert(at, known);
        }
    }

    /// Whether what is known of a task is known of other tiles.
    pub(crate) fn is_told(&self, place: u32) -> bool {
        self.told.contains_key(&place)
    }

    /// What a task took its last owner, in microseconds.
    pub(crate) fn took(&self, place: u32) -> Option<f64> {
        self.took[place as usize].map(|(_, us)| us)
    }

    /// How long each of so many threads has to draw, in microseconds, as far as that was known when
    /// it was cut.
    pub(crate) fn us_a_thread(&self, threads: u64) -> f64 {
        self.all_us / threads.max(1) as f64
    }

    /// How long the longest of its tiles was to take, likewise; infinitely long, where nothing was
    /// known.
    pub(crate) fn longest_us(&self) -> f64 {
        if self.all_us > 0.0 { self.longest_us } else { f64::INFINITY }
    }

    /// How long each worker has to do with what of these tasks is its own, in microseconds.
    pub(crate) fn left(&self, open: impl Iterator<Item = u32>, roster: &Roster) -> WorkerMap<f64> {
        let mut left = WorkerMap::default();
        for place in open {
            if let Some((_, us)) = self.took[place as usize] {
                let owner = self.owners[place as usize];
                let threads = roster.get(owner).map_or(1, |w| w.threads);
                *left.or_default(owner) += us / f64::from(threads);
            }
        }
        left
    }

    /// Whether a worker without work should take another's task, whose owner has to do for so long.
    /// Of what was never drawn nobody holds the bricks.
    pub(crate) fn is_worth_taking(
        &self,
        place: u32,
        worker: WorkerId,
        left: &WorkerMap<f64>,
        history: &CostHistory,
    ) -> bool {
        let Some((last, us)) = self.took[place as usize] else { return true };
        let owner = self.owners[place as usize];
        let here = us * history.slower(worker, last);
        left.get(owner).is_none_or(|left| *left > 2.0 * here)
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
            self.owned.or_default(before).retain(|p| *p != place);
            self.owned.or_default(worker).push(place);
        }
    }
}

/// Parts that tiles can be cut into, with what is guessed of each.
type Parts = TileMap<u64>;

/// The tiles of a frame that is alone, some of them cut ([`makespan::which`]), and all parts that
/// there may be. `None`: of too few it is known what they take.
fn mixed(
    through: &Through,
    threads: usize,
    (history, kind): (&CostHistory, Kind),
) -> Option<(Cut, Parts)> {
    let plain = through.cut(PLAIN);
    let known: Vec<Option<f64>> =
        plain.tiles.iter().map(|t| history.recall_us(kind, &t.rect)).collect();
    let told = || plain.tiles.iter().zip(&known).filter_map(|(t, us)| Some((t.est, (*us)?)));
    let (units, us) = told().fold((0, 0.0), |(a, b), (est, us)| (a + est, b + us));
    if 2 * told().count() < plain.tiles.len() || units == 0 {
        return None;
    }
    let unit = us / units as f64;
    let fine = through.cut(PLAIN / 2);
    let mut parts = Parts::new(kind.1);
    for t in &fine.tiles {
        parts.insert(&t.rect, t.est);
    }
    let whole = |(t, us): (&Macrotile, &Option<f64>)| us.unwrap_or(t.est as f64 * unit);
    let us: Vec<f64> = plain.tiles.iter().zip(&known).map(whole).collect();
    let takes = |i: usize| {
        let t = &plain.tiles[i];
        let guess = |est: u64| MORE * us[i] * est as f64 / t.est.max(1) as f64;
        let part = |(r, us): (Option<Rect>, Option<f64>)| {
            let est = *parts.get(&r?)?;
            Some(us.unwrap_or_else(|| guess(est)))
        };
        let known = history.recall_parts_us(kind, &t.rect);
        quarters(&t.rect).into_iter().zip(known).filter_map(part).collect()
    };
    let cut = makespan::which(&us, takes, threads);
    Some((through.mixed(&plain, &fine, &cut), parts))
}

/// Whose each tile of a frame that is alone is: whoever drew it last, unless the frame ends earlier
/// if another does ([`makespan::balance`]).
fn level(
    tiles: &[Macrotile],
    roster: &Roster,
    crew: Crew,
    (unit, slow): (f64, &impl Fn(WorkerId) -> f64),
    known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    price: &impl Fn(&Macrotile) -> f64,
) -> Vec<WorkerId> {
    let staying = crew.staying(roster);
    if staying.is_empty() {
        return vec![WorkerId(0); tiles.len()];
    }
    let times = Times::of(tiles, &staying, (unit, slow), known);
    let cost = |i: usize, w: usize| times.of_tile(i, w);
    let held: Vec<Option<usize>> =
        tiles.iter().map(|t| place_of(&staying, known(t)?.0, roster)).collect();
    let prices: Vec<f64> = tiles.iter().map(price).collect();
    let order: Vec<usize> = (0..tiles.len()).collect();
    let (mut owners, _) = times.deal(&held, &order);
    let price = |i: usize, w: usize| if held[i].is_none_or(|h| h == w) { 0.0 } else { prices[i] };
    makespan::balance(&mut owners, staying.len(), cost, price);
    owners.into_iter().map(|w| staying[w].0).collect()
}

/// How much slower or faster than another a worker must look before that is believed: what a tile
/// takes differs from frame to frame, and a core shared with somebody is slower by half.
const BELIEVED: f64 = 2.0;

fn believed(slower: f64) -> f64 {
    if (1.0 / BELIEVED..=BELIEVED).contains(&slower) { 1.0 } else { slower }
}

/// Microseconds that a guessed unit takes, in the mean of tiles that are known; 1 before any is.
fn unit(tiles: &[Macrotile], known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>) -> f64 {
    let known = tiles.iter().filter_map(|t| Some((t.est as f64, known(t)?.1)));
    let (units, us) = known.fold((0.0, 0.0), |(a, b), (units, us)| (a + units, b + us));
    if units > 0.0 && us > 0.0 { us / units } else { 1.0 }
}

/// What a tile took, in the units that others are guessed in: so the two can stand beside each
/// other.
fn in_units(us: f64, unit: f64) -> u64 {
    ((us / unit) as u64).max(1)
}

/// What tiles take those who stay.
struct Times {
    /// What each takes who drew it, or is guessed to, in microseconds, and how slow that one is. It
    /// is looked up once: what follows asks for it again and again.
    takes: Vec<(f64, f64)>,
    /// Of each who stays, how slow it is and how many threads it has.
    slows: Vec<f64>,
    threads: Vec<f64>,
}

impl Times {
    fn of(
        tiles: &[Macrotile],
        staying: &[(WorkerId, f64)],
        (unit, slow): (f64, &impl Fn(WorkerId) -> f64),
        known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    ) -> Times {
        let takes = |t: &Macrotile| match known(t) {
            Some((owner, us)) => (us, slow(owner)),
            None => (t.est as f64 * unit, 1.0),
        };
        Times {
            takes: tiles.iter().map(takes).collect(),
            slows: staying.iter().map(|s| slow(s.0)).collect(),
            threads: staying.iter().map(|s| s.1).collect(),
        }
    }

    /// How much longer a worker is busy with a tile, by their places.
    fn of_tile(&self, tile: usize, worker: usize) -> f64 {
        let (us, slow) = self.takes[tile];
        us * believed(self.slows[worker] / slow) / self.threads[worker]
    }

    /// Whose each tile is, and how long each worker has to do: whose it was, or else, in this
    /// order, whoever is done with it soonest.
    fn deal(&self, held: &[Option<usize>], order: &[usize]) -> (Vec<usize>, Vec<f64>) {
        let mut load = vec![0.0; self.threads.len()];
        let mut owners: Vec<usize> = held.iter().map(|w| w.unwrap_or(0)).collect();
        for &i in order {
            if let Some(w) = held[i] {
                load[w] += self.of_tile(i, w);
            }
        }
        for &i in order.iter().filter(|&&i| held[i].is_none()) {
            let after = |w: &usize| load[*w] + self.of_tile(i, *w);
            let least = (0..load.len()).min_by(|a, b| after(a).total_cmp(&after(b)));
            owners[i] = least.unwrap_or(0);
            load[owners[i]] += self.of_tile(i, owners[i]);
        }
        (owners, load)
    }
}

/// Whose each tile is: at first in bands, then whose it was in the frame that was cut before,
/// unless that one would be done late; a new one's whoever is done with it soonest. Loads are
/// times.
fn share(
    tiles: &[Macrotile],
    roster: &Roster,
    crew: Crew,
    (unit, slow): (f64, &impl Fn(WorkerId) -> f64),
    known: &impl Fn(&Macrotile) -> Option<(WorkerId, f64)>,
    (home, bricks): (&impl Fn(&Macrotile) -> Option<WorkerId>, &impl Fn(&Macrotile) -> usize),
) -> Vec<WorkerId> {
    let staying = crew.staying(roster);
    if staying.is_empty() {
        return vec![WorkerId(0); tiles.len()];
    }
    let times = Times::of(tiles, &staying, (unit, slow), known);
    let cost = |i: usize, w: usize| times.of_tile(i, w);
    let mut homes: Vec<Option<usize>> =
        tiles.iter().map(|t| place_of(&staying, home(t)?, roster)).collect();
    // In the order of rows.
    let mut order: Vec<usize> = (0..tiles.len()).collect();
    order.sort_by_key(|&i| (tiles[i].rect.y0, tiles[i].rect.x0));
    if homes.iter().all(Option::is_none) {
        // Bands of rows, as high as each is fast.
        let fast = |w: usize| staying[w].1 / believed(times.slows[w]);
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
            homes[i] = Some(w);
        }
    }
    let (mut owners, mut load) = times.deal(&homes, &order);
    // While the first frame is drawn, others begin beside it: most of what loads are made of is
    // guessed then.
    let drawn = tiles.iter().filter(|t| known(t).is_some()).count();
    let moves = if drawn > 0 && 2 * drawn < tiles.len() { 0 } else { tiles.len() };
    for moved in 0..moves {
        let by = |a: &usize, b: &usize| load[*a].total_cmp(&load[*b]);
        let ends = ((0..load.len()).max_by(by), (0..load.len()).min_by(by));
        let (Some(most), Some(least)) = ends else { break };
        let mean = load.iter().sum::<f64>() / load.len() as f64;
        let late = load[most] / mean - 1.0;
        // Not a number where nothing takes time.
        if !(late > LATE || late > SLACK && moved == 0) {
            break;
        }
        // Of those that leave both earlier than the later one was, by enough to be worth it and to
        // pay for the bricks that move, the one nearest to what the other has; else the largest.
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
    use slabcast_common::volume::Digest32;

    fn roster(threads: &[u32]) -> Roster {
        let mut roster = Roster::default();
        for (i, &threads) in threads.iter().enumerate() {
            roster.join(WorkerId(i as u64 + 1), format!("w{i}"), (threads, false), 0);
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
        let told = (unit(tiles, known), &|_| 1.0);
        share(tiles, roster, Crew::ALL, told, known, (&at_home(known), &|_| 0))
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
    fn tiles_are_as_large_as_there_are_enough_of_where_threads_share_the_masters_processors() {
        // As a head lies in a picture.
        let through = Through::new([512, 512], &[Rect::new(90, 40, 430, 480)]);
        let edge = |threads: u64, here| {
            let asked = (2.5 * threads as f64, threads as f64);
            edge(&through, asked, true, here)
        };
        assert_eq!([1, 2, 4, 8, 16, 32].map(|n| edge(n, true)), [256, 256, 128, 128, 64, 32]);
        // There are 24 of 128 pixels, 56 of 64.
        assert_eq!([1, 2, 4, 8, 16, 32].map(|n| edge(n, false)), [128, 128, 64, 64, 64, 32]);
        // A tile of theirs is everybody's who has most of the threads.
        let here = |crew: &[(u32, bool)]| {
            let mut roster = Roster::default();
            for (&who, id) in crew.iter().zip(1..) {
                roster.join(WorkerId(id), format!("w{id}"), who, 0);
            }
            Crew::ALL.is_local(&roster)
        };
        assert!(here(&[(2, true)]) && here(&[(1, false), (2, true)]));
        assert!(!here(&[(1, true), (1, false)]) && !here(&[(8, false)]) && !here(&[]));
    }

    #[test]
    fn tiles_stay_as_large_as_they_are_where_either_size_would_do() {
        // So many tiles of 64 pixels of 64, and four times as many of 32.
        let picture = |n: i32| {
            let tile = |i: i32| {
                let (x, y) = (64 * (i % 8), 64 * (i / 8));
                Rect::new(x, y, x + 64, y + 64)
            };
            Through::new([512, 512], &(0..n).map(tile).collect::<Vec<_>>())
        };
        let mut last = None;
        let mut edge = |n| {
            let edge = edge_beside(&picture(n), (40.0, 16), false, last);
            last = Some(edge);
            edge
        };
        assert_eq!(
            [40, 41, 44, 45, 41, 40, 37, 36, 40].map(&mut edge),
            [32, 32, 32, 64, 64, 64, 64, 32, 32]
        );
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
        let slow = |id: WorkerId| if id.0 == 2 { 10.0 } else { 1.0 };
        let told = (unit(&tiles, &known), &slow);
        let again = share(&tiles, &roster, Crew::ALL, told, &known, (&at_home(&known), &|_| 0));
        assert_eq!(shares(&again), [20, 2, 20]);
    }

    #[test]
    fn what_few_tiles_took_moves_none() {
        let (tiles, roster) = (tiles(24), roster(&[1, 1, 1]));
        let bands = among_all(&tiles, &roster, &|_| None);
        let at = |t: &Macrotile| (t.rect.x0 / 64) as usize;
        // The first tiles that are drawn lie at the edge of what is to be seen, and take a
        // hundredth of what is guessed.
        let shared = |drawn: usize| {
            let known = |t: &Macrotile| {
                let us = if at(t) < 4 { 10.0 } else { 1000.0 };
                (at(t) < drawn).then(|| (bands[at(t)], us))
            };
            let told = (unit(&tiles, &known), &|_| 1.0);
            let home = |t: &Macrotile| Some(bands[at(t)]);
            share(&tiles, &roster, Crew::ALL, told, &known, (&home, &|_| 0))
        };
        assert_eq!([1, 4, 11].map(shared), [(); 3].map(|()| bands.clone()));
        assert_ne!(shared(24), bands, "all are known, and the first worker has half as much to do");
    }

    #[test]
    fn a_tile_moves_only_if_that_pays_for_its_bricks() {
        let (tiles, roster) = (tiles(12), roster(&[1, 1]));
        let at = |t: &Macrotile| t.rect.x0 / 64;
        // Seven tiles of 1 ms against five: half of a millisecond is won by moving one.
        let known = |t: &Macrotile| Some((WorkerId(if at(t) < 7 { 1 } else { 2 }), 1000.0));
        let told = (unit(&tiles, &known), &|_| 1.0);
        let moved = |bricks: usize| {
            let whose = (&at_home(&known), &|_: &Macrotile| bricks);
            let owners = share(&tiles, &roster, Crew::ALL, told, &known, whose);
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

    /// What is known of a tile after frames of which each drew some tiles in so many microseconds.
    fn after(frames: &[&[(Rect, f64, &[u32])]]) -> (CostHistory, Kind) {
        let kind = (BrickSetKey(Digest32([0; 32])), [512, 512], Crew::ALL);
        let mut tiles = TileMap::new(kind.1);
        for (frame, drawn) in (1..).zip(frames) {
            for (rect, us, touched) in *drawn {
                let (owner, touched) = (WorkerId(frame), touched.to_vec());
                let known = TileCost { frame, owner, us: *us, touched };
                tiles.insert(rect, known);
            }
        }
        let lessons = vec![ViewHistory { tiles, ..ViewHistory::of(kind) }];
        (CostHistory { lessons, ..CostHistory::default() }, kind)
    }

    #[test]
    fn a_tile_is_known_by_its_parts_and_parts_by_their_tile_whichever_came_last() {
        let whole = Rect::new(64, 0, 128, 64);
        let part = |x, y| Rect::new(64 + 32 * x, 32 * y, 96 + 32 * x, 32 + 32 * y);
        let near = |k: Option<Recall<'_>>, us: f64| {
            let k = k.expect("it is known");
            let k = k.known();
            assert!((k.us - us).abs() < 1e-6, "{} for {us}", k.us);
            (k.owner.0, k.touched.clone())
        };
        let (m, kind) = after(&[&[(whole, 1000.0, &[1, 2])]]);
        assert_eq!(near(m.recall(kind, &whole), 1000.0), (1, vec![1, 2]));
        assert_eq!(near(m.recall(kind, &part(1, 1)), MORE * 250.0), (1, vec![1, 2]), "a quarter");
        assert!(m.recall(kind, &Rect::new(0, 0, 64, 64)).is_none());
        // In the frame after it was cut, and nothing lay under two of its parts.
        let parts: &[_] = &[(part(0, 0), 310.0, &[1, 3][..]), (part(1, 0), 930.0, &[2, 3])];
        let (m, kind) = after(&[&[(whole, 1000.0, &[7])], parts]);
        assert_eq!(near(m.recall(kind, &whole), 1240.0 / MORE), (2, vec![1, 2, 3]));
        assert_eq!(near(m.recall(kind, &part(0, 0)), 310.0), (2, vec![1, 3]));
        // Whole again: its parts share what it took now as they did then.
        let (m, kind) = after(&[parts, &[(whole, 2000.0, &[8])]]);
        assert_eq!(near(m.recall(kind, &whole), 2000.0), (2, vec![8]));
        assert_eq!(near(m.recall(kind, &part(1, 0)), MORE * 1500.0), (2, vec![8]));
        // All at once they are known as they are one by one.
        let all = quarters(&whole).map(|p| m.recall_us(kind, &p?));
        assert_eq!(m.recall_parts_us(kind, &whole), all);
    }

    #[test]
    fn a_tile_that_two_workers_drew_says_which_of_them_is_slow() {
        let mut m = CostHistory::default();
        for _ in 0..12 {
            m.compare((WorkerId(1), 9000.0), (WorkerId(2), 900.0));
        }
        let ratio = m.slow[WorkerId(1)] / m.slow[WorkerId(2)];
        assert!((8.0..=10.1).contains(&ratio), "{ratio}");
        m.compare((WorkerId(3), 5.0), (WorkerId(2), 900.0));
        assert!(m.slow.get(WorkerId(3)).is_none(), "5 us say nothing");
        m.forget(WorkerId(1));
        assert!(m.slow.get(WorkerId(1)).is_none());
    }

    #[test]
    fn a_slow_workers_tiles_go_to_others_and_come_back_to_it_no_more() {
        let (tiles, roster) = (tiles(12), roster(&[1, 1]));
        let at = |t: &Macrotile| t.rect.x0 / 64;
        // Six each; the second worker takes ten times as long.
        let known =
            |t: &Macrotile| Some(if at(t) < 6 { (WorkerId(1), 1e3) } else { (WorkerId(2), 1e4) });
        let slow = |id: WorkerId| if id.0 == 2 { 10.0 } else { 1.0 };
        let owners = level(&tiles, &roster, Crew::ALL, (1.0, &slow), &known, &|_| 0.0);
        assert_eq!(owners.iter().filter(|o| o.0 == 2).count(), 1);
    }

    #[test]
    fn estimates_are_corrected_in_units_of_the_guess() {
        let tiles = tiles(3);
        let known = |t: &Macrotile| match t.rect.x0 {
            0 => Some((WorkerId(1), 300.0)),
            64 => Some((WorkerId(1), 100.0)),
            _ => None,
        };
        let unit = unit(&tiles, &known);
        assert_eq!([300.0, 100.0, 200.0].map(|us| in_units(us, unit)), [6144, 2048, 4096]);
        assert_eq!(in_units(0.0, unit), 1);
    }
}
