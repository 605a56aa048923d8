//! Reading a record and replaying it.
//!
//! A record may come from anywhere: every line is checked before the scheduler sees it, and an
//! error names its line.

use super::{
    Decision, Head, Line, Noted, NotedJob, NotedPiece, NotedResult, NotedWorker, OLDEST_VERSION,
    VERSION, bits, from_hex, legacy,
};
use prost::Message;
use slabcast_common::PIXELS_VERSION;
use slabcast_common::brick::{BRICK_VOXELS, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::image::{SparseTile, TilePixels};
use slabcast_common::message::{
    Checkpoint, Counters, ErrorsBySource, Pixels, RegionCost, RegionSplit, SampledError, SceneSpec,
    TaskTimes, TileResult,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::volume::Digest32;
use slabcast_proto::{cluster_v1, convert};
use slabcast_schedule::{Clock, Config, Event, FrameJob, Micros, Scheduler, WorkerIdentity};
use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::io::{BufRead, Read};
use std::sync::Arc;

/// Bytes of the longest line: the bricks of a volume of 2048^3 that is relevant everywhere take
/// 0.9 GB. A longer line is of no record.
const MAX_LINE_BYTES: u64 = 1 << 30;

/// Error of a file that is not a record, or a damaged one.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("line {line}: {problem}")]
pub struct RecordError {
    /// Number of the line in the record, counted from 1.
    pub line: u64,
    /// Problem of the line, and the remedy.
    pub problem: String,
}

/// The first decision of a replay that differs from the record.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// Number of the decision's line in the record, counted from 1.
    pub line: u64,
    /// Decision as the record has it, in words for people.
    pub recorded: String,
    /// Decision of the scheduler that replays, in words for people.
    pub replayed: String,
}

/// Outcome of replaying a record through a fresh scheduler.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ReplaySummary {
    /// Number of events that were handed to the scheduler.
    pub events: u64,
    /// Number of decisions that are the same as in the record.
    pub decisions: u64,
    /// Number of frames that were finished.
    pub frames: u64,
    /// Version of the program that recorded the file.
    pub program: String,
    /// Reason why the record ends early, if it does.
    pub cut: Option<String>,
    /// The first difference, if there is one.
    pub difference: Option<Difference>,
}

/// A clock that gives the recorded readings.
struct RecordedClock {
    left: RefCell<VecDeque<Micros>>,
    last: Cell<Micros>,
    too_many: Cell<bool>,
}

impl Clock for RecordedClock {
    fn now(&self) -> Micros {
        match self.left.borrow_mut().pop_front() {
            Some(now) => self.last.set(now),
            None => self.too_many.set(true),
        }
        self.last.get()
    }
}

struct Reader<R> {
    from: R,
    line: u64,
    text: Vec<u8>,
}

impl<R: BufRead> Reader<R> {
    fn broken(&self, problem: impl Into<String>) -> RecordError {
        RecordError { line: self.line, problem: problem.into() }
    }

    /// The next line; `None` at the end of the file.
    fn next(&mut self) -> Result<Option<Line>, RecordError> {
        self.line += 1;
        self.text.clear();
        let read = (&mut self.from).take(MAX_LINE_BYTES).read_until(b'\n', &mut self.text);
        let n = read.map_err(|e| self.broken(format!("reading failed: {e}")))?;
        if n == 0 {
            return Ok(None);
        }
        if self.text.last() != Some(&b'\n') {
            let problem = if n as u64 == MAX_LINE_BYTES {
                "is longer than a record's lines are; give a file of --record"
            } else {
                "ends in the middle; the recording was cut off there"
            };
            return Err(self.broken(problem));
        }
        match serde_json::from_slice(&self.text) {
            Ok(line) => Ok(Some(line)),
            Err(_) if self.line == 1 => {
                Err(self.broken("is not a record's first line; give a file of --record"))
            }
            Err(e) => {
                let (said, _) = split_place(&e.to_string());
                Err(self
                    .broken(format!("is not a line of a record: {said}, column {}", e.column())))
            }
        }
    }
}

/// serde's message without its own idea of the place.
fn split_place(text: &str) -> (String, String) {
    match text.rsplit_once(" at line ") {
        Some((said, place)) => (said.into(), place.into()),
        None => (text.into(), String::new()),
    }
}

/// Things that earlier lines named and later lines refer to.
#[derive(Default)]
struct Seen {
    sets: BTreeMap<BrickSetKey, Arc<[BrickInfo]>>,
    scenes: BTreeMap<SceneId, Arc<SceneSpec>>,
    workers: BTreeSet<u64>,
    frames: BTreeSet<u64>,
    now: Micros,
}

/// Hands the events of a record to a new scheduler and compares its decisions with the recorded
/// ones, until the first difference.
///
/// # Errors
/// If a line is not as the recorder writes it, or reading fails.
pub fn replay(from: impl BufRead) -> Result<ReplaySummary, RecordError> {
    let mut reader = Reader { from, line: 0, text: Vec::new() };
    let head = match reader.next()? {
        Some(Line::Record(head)) => head,
        Some(_) | None => {
            return Err(reader.broken("is not a record's first line; give a file of --record"));
        }
    };
    let mut scheduler = Scheduler::new(config(&head).map_err(|e| reader.broken(e))?);
    let mut seen = Seen::default();
    let mut done = ReplaySummary {
        events: 0,
        decisions: 0,
        frames: 0,
        program: head.program,
        cut: Some("its last line is missing".into()),
        difference: None,
    };
    loop {
        let line = match reader.next() {
            Ok(Some(line)) => line,
            Ok(None) => return Ok(done),
            // A recorder that was killed in the middle of a line wrote all before it.
            Err(e) if e.problem.contains("was cut off there") => {
                done.cut = Some(format!("line {} {}", e.line, e.problem));
                return Ok(done);
            }
            Err(e) => return Err(e),
        };
        match line {
            Line::Record(_) => return Err(reader.broken("is a first line, and not the first")),
            Line::Bricks { set, bricks } => {
                let set = key(&set).map_err(|e| reader.broken(e))?;
                let infos = infos(&bricks).map_err(|e| reader.broken(e))?;
                if seen.sets.insert(set, infos).is_some() {
                    return Err(reader.broken("names a brick set that came before"));
                }
            }
            Line::Scene { id, wire } => {
                let scene = scene(SceneId(id), &wire).map_err(|e| reader.broken(e))?;
                if seen.scenes.insert(SceneId(id), scene).is_some() {
                    return Err(reader.broken("names a scene that came before"));
                }
            }
            Line::Event { t, e } => {
                let event = event(e, &mut seen).map_err(|e| reader.broken(e))?;
                let clock = recorded_clock(t, &mut seen).map_err(|e| reader.broken(e))?;
                scheduler.handle(&clock, event);
                done.events += 1;
                let left = clock.left.borrow().len();
                if clock.too_many.get() || left > 0 {
                    let more = if clock.too_many.get() { "more" } else { "fewer" };
                    done.difference = Some(Difference {
                        line: reader.line,
                        recorded: "the clock readings of this line".into(),
                        replayed: format!("{more} readings"),
                    });
                    return Ok(done);
                }
            }
            Line::Out(recorded) => {
                let mut recorded = recorded.into_iter();
                loop {
                    let action = scheduler.next_action();
                    let replayed = action.as_ref().map(|a| Decision::new(a).to_string());
                    let recorded = recorded.next();
                    if replayed.is_none() && recorded.is_none() {
                        break;
                    }
                    if recorded != replayed {
                        let or_nothing = |d: Option<String>| d.unwrap_or("nothing".into());
                        done.difference = Some(Difference {
                            line: reader.line,
                            recorded: or_nothing(recorded),
                            replayed: or_nothing(replayed),
                        });
                        return Ok(done);
                    }
                    done.decisions += 1;
                    if matches!(action, Some(slabcast_schedule::Action::FrameDone { .. })) {
                        done.frames += 1;
                    }
                }
            }
            Line::End { events, decisions, cut } => {
                if (events, decisions) != (done.events, done.decisions) {
                    return Err(reader.broken(format!(
                        "counts {events} events and {decisions} decisions, before it stand {} and \
                         {}; lines are missing",
                        done.events, done.decisions
                    )));
                }
                if let Some(action) = scheduler.next_action().filter(|_| cut.is_none()) {
                    done.difference = Some(Difference {
                        line: reader.line,
                        recorded: "nothing".into(),
                        replayed: Decision::new(&action).to_string(),
                    });
                }
                done.cut = cut;
                if reader.next()?.is_some() {
                    return Err(reader.broken("comes after the last one"));
                }
                return Ok(done);
            }
        }
    }
}

fn config(head: &Head) -> Result<Config, String> {
    if !(OLDEST_VERSION..=VERSION).contains(&head.version) {
        return Err(format!(
            "is a record of version {}, this program reads {OLDEST_VERSION} to {VERSION}; replay \
             it with slabcast {}",
            head.version, head.program
        ));
    }
    if head.pixels_version != PIXELS_VERSION {
        return Err(format!(
            "was recorded with pixels of version {}, this program has {PIXELS_VERSION}; replay it \
             with slabcast {}",
            head.pixels_version, head.program
        ));
    }
    let &Head { heartbeat, silence, unresponsive_after, lease, poison_after, queue_ahead, .. } =
        head;
    let sane = 1..=1 << 50;
    if ![heartbeat, silence, unresponsive_after.max(1), lease].iter().all(|t| sane.contains(t))
        || queue_ahead > 1 << 20
    {
        return Err("has settings that no master has".into());
    }
    let (audit_ppm, audit_first, audit_seed) = head.audits;
    Ok(Config {
        heartbeat,
        silence,
        unresponsive_after,
        lease,
        poison_after,
        audit_ppm,
        audit_first,
        audit_seed,
        queue_ahead,
        mixed: false,
    })
}

fn key(text: &str) -> Result<BrickSetKey, String> {
    let bytes = from_hex(text).and_then(|b| <[u8; 32]>::try_from(b).ok());
    bytes
        .map(|b| BrickSetKey(Digest32(b)))
        .ok_or_else(|| "`set` is not 64 hexadecimal digits".into())
}

fn infos(bricks: &[[u32; 9]]) -> Result<Arc<[BrickInfo]>, String> {
    if !bricks.windows(2).all(|w| w[0][0] < w[1][0]) {
        return Err("its bricks do not ascend".into());
    }
    bricks
        .iter()
        .map(|&[id, lx, ly, lz, hx, hy, hz, voxels, bytes]| {
            let (lo, hi) = ([lx, ly, lz], [hx, hy, hz]);
            let voxels = u16::try_from(voxels).ok().filter(|v| usize::from(*v) <= BRICK_VOXELS);
            let sane = (0..3).all(|a| lo[a] <= hi[a] && hi[a] < 1 << 20);
            match voxels.filter(|_| sane) {
                Some(voxels) => {
                    Ok(BrickInfo { id: BrickId(id), tight: TightBox { lo, hi }, voxels, bytes })
                }
                None => Err(format!("brick {id} is none")),
            }
        })
        .collect()
}

fn scene(id: SceneId, wire: &str) -> Result<Arc<SceneSpec>, String> {
    let bytes = from_hex(wire).ok_or("`wire` is not hexadecimal")?;
    let scene = legacy::scene(&bytes).map_err(|e| format!("`wire` {e}"))?;
    if scene.id != id {
        return Err(format!("`id` is {id}, the scene says {}", scene.id));
    }
    Ok(Arc::new(scene))
}

fn recorded_clock(t: Vec<u64>, seen: &mut Seen) -> Result<RecordedClock, String> {
    let (mut at, mut left) = (0u64, VecDeque::with_capacity(t.len()));
    for t in t {
        at = at.checked_add(t).filter(|t| *t < 1 << 62).ok_or("`t` overflows")?;
        left.push_back(at);
    }
    if left.front().is_some_and(|first| *first < seen.now) {
        return Err("`t` is before the line before; time never goes back".into());
    }
    seen.now = at.max(seen.now);
    let last = Cell::new(seen.now);
    Ok(RecordedClock { left: RefCell::new(left), last, too_many: Cell::new(false) })
}

fn event(e: Noted, seen: &mut Seen) -> Result<Event, String> {
    let ids = |ids: Vec<u32>| ids.into_iter().map(BrickId).collect::<Vec<_>>();
    Ok(match e {
        Noted::Joined(NotedWorker { w, name, who, threads, audited, here, memory, held }) => {
            if !seen.workers.insert(w) {
                return Err(format!("w{w} joined before; a worker's name is never used again"));
            }
            let held = held
                .into_iter()
                .map(|(set, bricks)| Ok((key(&set)?, ids(bricks))))
                .collect::<Result<_, String>>()?;
            let worker = WorkerId(w);
            let (is_local, memory_budget_bytes) = (here, memory);
            let (host, own) = who.unwrap_or_else(|| (String::new(), format!("{name} {w}")));
            let identity = WorkerIdentity { host, name: own };
            Event::WorkerJoined {
                worker,
                name,
                identity,
                threads,
                is_trusted: !audited,
                is_local,
                memory_budget_bytes,
                held,
            }
        }
        Noted::Heard { w } => Event::WorkerHeard { worker: WorkerId(w) },
        Noted::Lost { w, reason } => Event::WorkerLost { worker: WorkerId(w), reason },
        Noted::Leaving { w } => Event::WorkerLeaving { worker: WorkerId(w) },
        Noted::Queued(job) => Event::FrameQueued(Box::new(queued(job, seen)?)),
        Noted::Cancelled { frame } => Event::CancelFrame { frame: FrameId(frame) },
        Noted::SceneEnded { scene } => Event::SceneEnded { scene: SceneId(scene) },
        Noted::Result(r) => Event::Result { worker: WorkerId(r.w), result: Box::new(result(&r)?) },
        Noted::Failed { w, task, epoch, reason } => {
            Event::Failed { worker: WorkerId(w), task: TaskId(task), epoch: Epoch(epoch), reason }
        }
        Noted::HandedOver(p) => {
            Event::HandedOver { worker: WorkerId(p.w), piece: Box::new(piece(p)?) }
        }
        Noted::BricksIn { w, set, bricks } => {
            Event::BricksIn { worker: WorkerId(w), set: key(&set)?, bricks }
        }
        Noted::BricksBroken { w, set, bricks } => {
            Event::BricksBroken { worker: WorkerId(w), set: key(&set)?, bricks: ids(bricks) }
        }
        Noted::BricksWanted { w, set, bricks } => {
            Event::BricksWanted { worker: WorkerId(w), set: key(&set)?, bricks: ids(bricks) }
        }
        Noted::BricksForgotten { w, set, bricks } => {
            Event::BricksForgotten { worker: WorkerId(w), set: key(&set)?, bricks: ids(bricks) }
        }
        Noted::Pong { w, nonce, clock_us } => Event::Pong { worker: WorkerId(w), nonce, clock_us },
        Noted::Tick => Event::Tick,
    })
}

fn queued(job: NotedJob, seen: &mut Seen) -> Result<FrameJob, String> {
    if !seen.frames.insert(job.frame) {
        return Err(format!(
            "f{} was queued before; a frame's name is never used again",
            job.frame
        ));
    }
    let scene = seen.scenes.get(&SceneId(job.scene)).cloned();
    let scene = scene.ok_or_else(|| format!("its scene {} has no line", job.scene))?;
    let bricks = seen.sets.get(&scene.bricks).cloned().ok_or("its brick set has no line")?;
    let bytes = from_hex(&job.view).ok_or("`view` is not hexadecimal")?;
    let view = cluster_v1::View::decode(&bytes[..]).map_err(|e| format!("`view` is none: {e}"))?;
    let view = convert::view_from_wire(view).map_err(|e| format!("`view`: {e}"))?;
    convert::check_view(&scene.volume.lattice, &view).map_err(|e| format!("`view`: {e}"))?;
    job.work.check().map_err(|e| format!("`work`: {}: {}", e.field, e.problem))?;
    let (frame, number, work) = (FrameId(job.frame), job.number, job.work);
    let NotedJob { finish, client, .. } = job;
    Ok(FrameJob { frame, number, scene, bricks, view, work, finish, client })
}

/// Returns blank finished pixels that the scheduler takes for the recorded ones.
fn finished(r: &NotedResult) -> Result<Option<SparseTile>, String> {
    let Some((size, format, fits)) = r.finished else { return Ok(None) };
    let n = u64::from(size[0]) * u64::from(size[1]);
    if n == 0 || n > 2 * convert::MAX_TILE_PIXELS as u64 {
        return Err("its leaves are none, or more than the wire lets through".into());
    }
    let mut leaves = SparseTile::blank(size, format);
    leaves.max_alpha = r.mark as f32 / (1 << 23) as f32;
    if !fits {
        leaves.data.push(0);
    }
    Ok(Some(leaves))
}

/// Returns a piece with clear pixels that the scheduler takes for the recorded ones.
fn piece(p: NotedPiece) -> Result<RegionSplit, String> {
    let (a, colour, last) = p.planes;
    let n = [a, colour, last.unwrap_or(0), p.sheets.len()];
    if n.iter().any(|n| *n > 2 * convert::MAX_TILE_PIXELS) {
        return Err("its planes are larger than the wire lets through".into());
    }
    let mut pixels = TilePixels {
        a: vec![0.0; a],
        colour: vec![[0; 3]; colour],
        last: last.map(|n| vec![[0; 4]; n]),
    };
    if !p.finite {
        *pixels.a.first_mut().ok_or("`finite` of a plane without pixels")? = f32::NAN;
    }
    let inside = |r: &Rect| 0 <= r.x0 && 0 <= r.y0 && r.x1 <= 1 << 16 && r.y1 <= 1 << 16;
    if ![&p.kept, &p.given].into_iter().all(|r| inside(r) && !r.is_empty()) {
        return Err("`kept` and `given` are no rectangles of a picture".into());
    }
    let begun = Checkpoint { sheets: p.sheets, pixels };
    let (task, epoch) = (TaskId(p.task), Epoch(p.epoch));
    Ok(RegionSplit { task, epoch, kept: p.kept, given: p.given, begun })
}

/// Returns a result that the scheduler takes for the recorded one: shut pixels have opacity 1, open
/// ones 0, and all are black.
fn result(r: &NotedResult) -> Result<TileResult, String> {
    let (a, colour, last) = r.planes;
    // The planes of a worker that lies have any length: the scheduler only compares it.
    if [a, colour, last.unwrap_or(0)].iter().any(|n| *n > 2 * convert::MAX_TILE_PIXELS) {
        return Err("its planes are larger than the wire lets through".into());
    }
    let shut = bits(&r.shut, a).ok_or("`shut` does not fit its plane")?;
    let mut pixels = TilePixels {
        a: shut.into_iter().map(|s| if s { 1.0 } else { 0.0 }).collect(),
        colour: vec![[0; 3]; colour],
        last: last.map(|n| vec![[0; 4]; n]),
    };
    if !r.finite {
        *pixels.a.first_mut().ok_or("`finite` of a plane without pixels")? = f32::NAN;
    }
    if let Some(first) = pixels.colour.first_mut() {
        first[0] = r.mark;
    }
    let sampled = r
        .sampled
        .as_deref()
        .copied()
        .unwrap_or_default()
        .map(|(pixels, squares)| SampledError { pixels, squares });
    let sampled = ErrorsBySource::from_array(sampled);
    let ([tossed, splatted, culled], [received_us, ready_us, start_us, end_us]) = (r.voxels, r.us);
    Ok(TileResult {
        task: TaskId(r.task),
        epoch: Epoch(r.epoch),
        pixels: finished(r)?.map_or(Pixels::Sums(pixels), Pixels::Finished),
        bytes: r.bytes,
        counters: Counters { tossed, splatted, culled },
        times: TaskTimes { received_us, ready_us, start_us, end_us, thread: r.thread },
        region: r.region.clone().map(|(touched, stalls, parked_us, idle_us)| RegionCost {
            touched,
            stalls,
            parked_us,
            idle_us,
            sampled,
        }),
    })
}
