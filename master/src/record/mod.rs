//! A scheduler's events and decisions as a file, and their replay.
//!
//! The scheduler is pure: the same events at the same times give the same actions. So a run that
//! went wrong on forty machines can be examined on one: `--record` writes down each event with
//! every reading of the clock that was taken while it was handled, and each decision; [`replay()`]
//! hands the events to a new scheduler and compares its decisions.
//!
//! # The file
//!
//! Lines of JSON, so that a person can read, cut and search it:
//!
//! | line | what |
//! |--|--|
//! | `{"record":{..}}` | first: version of this format, of the program, the scheduler's settings |
//! | `{"bricks":{..}}` | a brick set, before its first frame |
//! | `{"scene":{..}}` | a scene as workers get it (`proto`, hexadecimal), before its first frame |
//! | `{"event":{"t":[..],"e":{..}}}` | an event, and the readings of the clock in microseconds |
//! | `{"out":[..]}` | the decisions since the line before, as text |
//! | `{"end":{..}}` | last: how many of both; `cut` where the file could not keep up |
//!
//! The first reading of the clock in `t` is in full, the others are differences.
//!
//! **Pixels are not stored.** The scheduler looks at two properties of a result's planes: whether
//! they have the tile's size and are finite, and which pixels are shut. So the record keeps their
//! lengths and one bit a pixel, as runs; of finished pixels it keeps size and format. Pixels inside
//! leases are not compared either: a decision is which worker gets which tile, with which bricks,
//! and when.
//!
//! **The driver never waits for the disk.** It queues entries and goes on; a thread writes them. If
//! the disk falls behind by `QUEUE_ENTRIES`, the record ends there and says so, and rendering goes
//! on.

mod legacy;
mod read;
#[cfg(test)]
mod tests;
mod write;

pub use read::{Difference, RecordError, ReplaySummary, replay};
pub(crate) use write::RecordedScheduler;
pub use write::{RecordSummary, Recorder, start};

use serde::{Deserialize, Serialize};
use slabcast_common::brick::BrickInfo;
use slabcast_common::image::{PixelEncoding, PixelFormat};
use slabcast_common::message::{ErrorsBySource, Pixels, RegionSplit, TileResult, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{Action, Event};
use std::fmt;

/// Version of the file's format. Since 2 results may be finished, and statistics count their
/// bytes; since 3 regions may be handed over in part; since 4 scenes have their transfer function
/// as a message ([`legacy`] reads those of 3); since 5 workers are known over their links.
const VERSION: u32 = 5;

/// Oldest version that is read.
const OLDEST_VERSION: u32 = 3;

/// Entries between driver and disk: those of some twenty frames of 512x512, 4 MiB if tiles are shut
/// in patterns. At a tenth, one slow `fsync` of another program cuts the record.
const QUEUE_ENTRIES: usize = 16384;

/// One line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Line {
    Record(Head),
    Bricks { set: String, bricks: Vec<[u32; 9]> },
    Scene { id: u64, wire: String },
    Event { t: Vec<u64>, e: Noted },
    Out(Vec<String>),
    End { events: u64, decisions: u64, cut: Option<String> },
}

/// The first line.
#[derive(Debug, Serialize, Deserialize)]
struct Head {
    version: u32,
    program: String,
    pixels_version: u32,
    protocol_version: u32,
    heartbeat: u64,
    silence: u64,
    /// Off before version 5.
    #[serde(default)]
    unresponsive_after: u64,
    lease: u64,
    poison_after: u32,
    queue_ahead: u32,
    /// Audits: share in millionths, how many tiles of a new worker, and the seed.
    #[serde(default)]
    audits: (u32, u32, u64),
}

/// An event without its pixels.
#[derive(Debug, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Noted {
    Joined(NotedWorker),
    Heard { w: u64 },
    Lost { w: u64, reason: String },
    Leaving { w: u64 },
    Queued(NotedJob),
    Cancelled { frame: u64 },
    SceneEnded { scene: u64 },
    Result(NotedResult),
    Failed { w: u64, task: u64, epoch: u32, reason: String },
    HandedOver(NotedPiece),
    BricksIn { w: u64, set: String, bricks: u32 },
    BricksBroken { w: u64, set: String, bricks: Vec<u32> },
    BricksWanted { w: u64, set: String, bricks: Vec<u32> },
    BricksForgotten { w: u64, set: String, bricks: Vec<u32> },
    Pong { w: u64, nonce: u64, clock_us: u64 },
    Tick,
}

#[derive(Debug, Serialize, Deserialize)]
struct NotedWorker {
    w: u64,
    name: String,
    /// Host and name of the worker. `None` in records before version 5, in which each link counts as a
    /// worker of its own.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    who: Option<(String, String)>,
    threads: u32,
    /// Whether its pixels are not believed without audits.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    audited: bool,
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    here: bool,
    memory: u64,
    held: Vec<(String, Vec<u32>)>,
}

#[derive(Debug, Serialize, Deserialize)]
struct NotedJob {
    frame: u64,
    number: u64,
    scene: u64,
    view: String,
    work: slabcast_common::quality::Work,
    /// Format and background for regions that are finished on workers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    finish: Option<PixelEncoding>,
    /// Number of the client; 0 where all frames are one client's.
    #[serde(default, skip_serializing_if = "is_nobody")]
    client: u64,
}

fn is_nobody(client: &u64) -> bool {
    *client == 0
}

#[derive(Debug, Serialize, Deserialize)]
struct NotedResult {
    w: u64,
    task: u64,
    epoch: u32,
    /// Lengths of its planes in pixels: a, colour, last (`None`: it has none). Finished pixels have
    /// the first only.
    planes: (usize, usize, Option<usize>),
    /// Whether all opacities are finite.
    finite: bool,
    /// Runs of open and shut pixels in turn, the open first, as varints in hexadecimal; empty
    /// where all are open.
    shut: String,
    /// Voxels tossed, splatted, culled.
    voxels: [u64; 3],
    /// Received, ready, start and end, on the worker's clock.
    us: [u64; 4],
    thread: u32,
    /// Costs of a region: places that it touched, stalls, time stalled and idle time (us).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    region: Option<(Vec<u32>, u32, u64, u64)>,
    /// For each source of error: pixels sampled, and the sum of their squared errors.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    sampled: Option<Box<[(u32, u64); 4]>>,
    /// A number that differs where pixels do, so that replayed audits compare alike.
    #[serde(default, skip_serializing_if = "is_zero")]
    mark: u32,
    /// Bytes of its message.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    bytes: Option<u32>,
    /// Finished pixels: columns and rows, format, and whether their parts fit each other.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    finished: Option<([u32; 2], PixelFormat, bool)>,
}

/// A piece of a region that a worker split off.
#[derive(Debug, Serialize, Deserialize)]
struct NotedPiece {
    w: u64,
    task: u64,
    epoch: u32,
    kept: Rect,
    given: Rect,
    sheets: Vec<Option<i32>>,
    /// Lengths of its planes in pixels, as in [`NotedResult::planes`].
    planes: (usize, usize, Option<usize>),
    finite: bool,
}

fn is_zero(n: &u32) -> bool {
    *n == 0
}

/// Returns a number below 2^23 that differs where pixels do, but for one case in millions.
fn mark(pixels: &Pixels) -> u32 {
    let word = |x: u32| x.to_le_bytes();
    let hash = match pixels {
        Pixels::Sums(p) => {
            let a = p.a.iter().flat_map(|a| word(a.to_bits()));
            let colour = p.colour.iter().flatten().flat_map(|c| word(*c));
            let last = p.last.iter().flatten().flatten().flat_map(|c| word(*c));
            hash(a.chain(colour).chain(last))
        }
        Pixels::Finished(tile) => {
            let most = word(tile.max_alpha.to_bits());
            hash(tile.mask.iter().chain(&tile.data).copied().chain(most))
        }
    };
    (hash ^ (hash >> 32)) as u32 & 0x7f_ffff
}

impl NotedPiece {
    fn new(worker: u64, piece: &RegionSplit) -> Self {
        let p = &piece.begun.pixels;
        NotedPiece {
            w: worker,
            task: piece.task.0,
            epoch: piece.epoch.0,
            kept: piece.kept,
            given: piece.given,
            sheets: piece.begun.sheets.clone(),
            planes: (p.a.len(), p.colour.len(), p.last.as_ref().map(Vec::len)),
            finite: p.a.iter().all(|a| a.is_finite()),
        }
    }
}

impl NotedResult {
    fn new(worker: u64, result: &TileResult, is_shut: impl Fn(f32) -> bool) -> Self {
        let (c, t) = (&result.counters, &result.times);
        let (planes, finite, shut, finished) = match &result.pixels {
            Pixels::Sums(p) => (
                (p.a.len(), p.colour.len(), p.last.as_ref().map(Vec::len)),
                p.a.iter().all(|a| a.is_finite()),
                runs(p.a.iter().map(|&a| is_shut(a))),
                None,
            ),
            Pixels::Finished(leaves) => {
                let noted = (leaves.size, leaves.format, leaves.check().is_ok());
                ((leaves.pixels(), 0, None), true, String::new(), Some(noted))
            }
        };
        NotedResult {
            w: worker,
            task: result.task.0,
            epoch: result.epoch.0,
            planes,
            finite,
            shut,
            voxels: [c.tossed, c.splatted, c.culled],
            us: [t.received_us, t.ready_us, t.start_us, t.end_us],
            thread: t.thread,
            region: result
                .region
                .as_ref()
                .map(|r| (r.touched.clone(), r.stalls, r.parked_us, r.idle_us)),
            sampled: result
                .region
                .as_ref()
                .filter(|r| r.sampled != ErrorsBySource::default())
                .map(|r| Box::new(r.sampled.to_array().map(|s| (s.pixels, s.squares)))),
            mark: mark(&result.pixels),
            bytes: result.bytes,
            finished,
        }
    }
}

/// A decision of the scheduler, as far as it is compared.
#[derive(Debug)]
enum Decision {
    Message { worker: u64, what: String },
    Lease { worker: u64, lease: LeaseDecision },
    Bricks { worker: u64, count: usize, hash: u64 },
    Drop { worker: u64, reason: String },
    Progress { frame: u64, tiles: (u32, u32), slab: (u32, u32) },
    Finished { frame: u64, tiles: usize },
    Done { frame: u64, stats: Box<FrameStats> },
    Failed { frame: u64, reason: String },
    Paused { worker: u64, pause_us: u64 },
    ShutOut { worker: u64, frame: u64 },
    Tainted { frame: u64 },
}

#[derive(Debug)]
struct LeaseDecision {
    task: u64,
    epoch: u32,
    frame: u64,
    tile: [i32; 4],
    sheets: [i32; 2],
    bricks: usize,
    hash: u64,
}

/// Returns the FNV-1a hash of bytes, which tells lists of bricks apart.
fn hash(bytes: impl IntoIterator<Item = u8>) -> u64 {
    bytes
        .into_iter()
        .fold(0xcbf2_9ce4_8422_2325, |h, b| (h ^ u64::from(b)).wrapping_mul(0x0000_0100_0000_01b3))
}

fn hash_bricks(bricks: &[slabcast_common::ids::BrickId]) -> u64 {
    hash(bricks.iter().flat_map(|b| b.0.to_le_bytes()))
}

impl Decision {
    fn new(action: &Action) -> Self {
        match action {
            Action::Send { worker, message } => match message {
                ToWorker::Lease(l) => Decision::Lease {
                    worker: worker.0,
                    lease: LeaseDecision {
                        task: l.task.0,
                        epoch: l.epoch.0,
                        frame: l.frame.0,
                        tile: [l.tile.x0, l.tile.y0, l.tile.x1, l.tile.y1],
                        sheets: [l.slab.first, l.slab.end],
                        bricks: l.bricks.len(),
                        hash: hash_bricks(&l.bricks),
                    },
                },
                other => Decision::Message { worker: worker.0, what: describe(other) },
            },
            Action::SendBricks { worker, bricks, .. } => {
                let (count, hash) = (bricks.len(), hash_bricks(bricks));
                Decision::Bricks { worker: worker.0, count, hash }
            }
            Action::Drop { worker, reason } => {
                Decision::Drop { worker: worker.0, reason: reason.clone() }
            }
            Action::Progress { frame, done, total, slab, slabs } => {
                Decision::Progress { frame: frame.0, tiles: (*done, *total), slab: (*slab, *slabs) }
            }
            Action::Finished { frame, tiles } => {
                Decision::Finished { frame: frame.0, tiles: tiles.len() }
            }
            Action::FrameDone { frame, stats, .. } => {
                Decision::Done { frame: frame.0, stats: stats.clone() }
            }
            Action::FrameFailed { frame, reason, .. } => {
                Decision::Failed { frame: frame.0, reason: reason.clone() }
            }
            Action::ShutOut { worker, frame, .. } => {
                Decision::ShutOut { worker: worker.0, frame: frame.0 }
            }
            Action::FrameTainted { frame } => Decision::Tainted { frame: frame.0 },
            Action::Paused { worker, pause_us, .. } => {
                Decision::Paused { worker: worker.0, pause_us: *pause_us }
            }
        }
    }
}

/// Describes a message other than a lease.
fn describe(message: &ToWorker) -> String {
    match message {
        ToWorker::Scene(scene) => format!("{}", scene.id),
        ToWorker::Frame { frame, scene, plain, .. } => {
            let plain = if *plain { ", results as they are" } else { "" };
            format!("{frame} of {scene}{plain}")
        }
        ToWorker::EndFrame { frame } => format!("end of {frame}"),
        ToWorker::EndScene { scene } => format!("end of {scene}"),
        ToWorker::Region(l) => {
            let ([x0, y0], [x1, y1]) = ([l.tile.x0, l.tile.y0], [l.tile.x1, l.tile.y1]);
            let (task, epoch, frame) = (l.task, l.epoch, l.frame);
            let begun = if l.begun.is_some() { ", as it was left" } else { "" };
            format!("region {task} {epoch} of {frame}, ({x0},{y0}) to ({x1},{y1}){begun}")
        }
        ToWorker::Directory { set, bricks, .. } => {
            let ids: Vec<_> = bricks.iter().map(|b| b.id).collect();
            let set = &set.0.to_string()[..16];
            format!("directory of {set}, {} bricks {:016x}", ids.len(), hash_bricks(&ids))
        }
        ToWorker::DropBricks { bricks, .. } => {
            format!("forget {} bricks {:016x}", bricks.len(), hash_bricks(bricks))
        }
        ToWorker::SplitRegion { frame, task, epoch, share } => {
            format!("hand over {share} of 1000 of {task} {epoch} of {frame}")
        }
        ToWorker::Ping { nonce } => format!("ping {nonce}"),
        ToWorker::Lease(_) | ToWorker::Welcome { .. } | ToWorker::Refused { .. } => {
            unreachable!("leases are decisions of their own, and the driver welcomes and refuses")
        }
        ToWorker::MasterEnding { .. } => "leave".into(),
    }
}

impl fmt::Display for Decision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Decision::Message { worker, what } => write!(f, "w{worker}: {what}"),
            Decision::Lease { worker, lease: l } => write!(
                f,
                "w{worker}: lease t{} e{} of f{}, ({},{}) to ({},{}), sheets {}..{}, {} bricks \
                 {:016x}",
                l.task,
                l.epoch,
                l.frame,
                l.tile[0],
                l.tile[1],
                l.tile[2],
                l.tile[3],
                l.sheets[0],
                l.sheets[1],
                l.bricks,
                l.hash
            ),
            Decision::Bricks { worker, count, hash } => {
                write!(f, "w{worker}: {count} bricks {hash:016x}")
            }
            Decision::Drop { worker, reason } => write!(f, "w{worker}: dropped, {reason}"),
            Decision::Progress { frame, tiles, slab } => {
                write!(f, "f{frame}: {}/{} of slab {}/{}", tiles.0, tiles.1, slab.0, slab.1)
            }
            Decision::Finished { frame, tiles } => {
                write!(f, "f{frame}: {tiles} finished tiles for its picture")
            }
            Decision::Done { frame, stats } => {
                let text = serde_json::to_string(stats);
                let text = text.expect("statistics have no map keys but strings");
                let (ms, hash) = (stats.ms.total, hash(text.bytes()));
                write!(f, "f{frame}: done in {ms} ms, statistics {hash:016x}")
            }
            Decision::Failed { frame, reason } => write!(f, "f{frame}: failed, {reason}"),
            Decision::ShutOut { worker, frame } => write!(f, "w{worker}: shut out by f{frame}"),
            Decision::Tainted { frame } => write!(f, "f{frame}: has tiles of a liar"),
            Decision::Paused { worker, pause_us } => write!(f, "w{worker}: pauses {pause_us} us"),
        }
    }
}

fn brick_to_line(b: &BrickInfo) -> [u32; 9] {
    let (lo, hi) = (b.tight.lo, b.tight.hi);
    [b.id.0, lo[0], lo[1], lo[2], hi[0], hi[1], hi[2], u32::from(b.voxels), b.bytes]
}

/// Returns the lengths of runs of equal bits, the first of `false`, as varints in hexadecimal.
fn runs(bits: impl Iterator<Item = bool>) -> String {
    let (mut bytes, mut at, mut run) = (Vec::new(), false, 0u32);
    let mut put = |mut n: u32| {
        while n >= 0x80 {
            bytes.push(n as u8 | 0x80);
            n >>= 7;
        }
        bytes.push(n as u8);
    };
    for bit in bits {
        if bit != at {
            put(run);
            (at, run) = (bit, 0);
        }
        run += 1;
    }
    // A last run of open pixels is left out: the number of pixels tells it.
    if at {
        put(run);
    }
    to_hex(&bytes)
}

/// Returns the `n` bits that [`runs`] encoded; `None` if they are more.
fn bits(runs: &str, n: usize) -> Option<Vec<bool>> {
    let (mut out, mut at) = (Vec::with_capacity(n), false);
    let bytes = from_hex(runs)?;
    let mut bytes = bytes.iter();
    while let Some(&first) = bytes.next() {
        let (mut byte, mut run, mut shift) = (first, 0u64, 0);
        loop {
            run |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                break;
            }
            shift += 7;
            byte = *bytes.next().filter(|_| shift < 35)?;
        }
        if run > (n - out.len()) as u64 {
            return None;
        }
        out.resize(out.len() + run as usize, at);
        at = !at;
    }
    out.resize(n, false);
    Some(out)
}

fn to_hex(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 16] = b"0123456789abcdef";
    bytes
        .iter()
        .flat_map(|b| [DIGITS[usize::from(b >> 4)], DIGITS[usize::from(b & 15)]])
        .map(char::from)
        .collect()
}

fn from_hex(text: &str) -> Option<Vec<u8>> {
    let digit = |b: u8| char::from(b).to_digit(16).map(|d| d as u8);
    let bytes = text.as_bytes();
    if !bytes.len().is_multiple_of(2) {
        return None;
    }
    bytes.chunks_exact(2).map(|p| Some(digit(p[0])? << 4 | digit(p[1])?)).collect()
}

/// Returns an event without its pixels; `None` for a queued frame, whose scene and bricks are
/// written once. `is_shut` tells of a pixel of a result whether it is shut.
fn noted(event: &Event, is_shut: impl Fn(&TileResult, f32) -> bool) -> Option<Noted> {
    let set = |key: &slabcast_common::brick::BrickSetKey| key.0.to_string();
    Some(match event {
        Event::WorkerJoined {
            worker,
            name,
            identity,
            threads,
            is_trusted,
            is_local,
            memory_budget_bytes,
            held,
        } => Noted::Joined(NotedWorker {
            w: worker.0,
            name: name.clone(),
            who: Some((identity.host.clone(), identity.name.clone())),
            threads: *threads,
            audited: !*is_trusted,
            here: *is_local,
            memory: *memory_budget_bytes,
            held: held
                .iter()
                .map(|(key, ids)| (set(key), ids.iter().map(|b| b.0).collect()))
                .collect(),
        }),
        Event::WorkerHeard { worker } => Noted::Heard { w: worker.0 },
        Event::WorkerLost { worker, reason } => Noted::Lost { w: worker.0, reason: reason.clone() },
        Event::WorkerLeaving { worker } => Noted::Leaving { w: worker.0 },
        // The thread that writes knows which scenes and bricks it has written.
        Event::FrameQueued(_) => return None,
        Event::CancelFrame { frame } => Noted::Cancelled { frame: frame.0 },
        Event::SceneEnded { scene } => Noted::SceneEnded { scene: scene.0 },
        Event::Result { worker, result } => {
            Noted::Result(NotedResult::new(worker.0, result, |a| is_shut(result, a)))
        }
        Event::Failed { worker, task, epoch, reason } => {
            Noted::Failed { w: worker.0, task: task.0, epoch: epoch.0, reason: reason.clone() }
        }
        Event::HandedOver { worker, piece } => Noted::HandedOver(NotedPiece::new(worker.0, piece)),
        Event::BricksIn { worker, set: key, bricks } => {
            Noted::BricksIn { w: worker.0, set: set(key), bricks: *bricks }
        }
        Event::BricksBroken { worker, set: key, bricks } => Noted::BricksBroken {
            w: worker.0,
            set: set(key),
            bricks: bricks.iter().map(|b| b.0).collect(),
        },
        Event::BricksWanted { worker, set: key, bricks } => Noted::BricksWanted {
            w: worker.0,
            set: set(key),
            bricks: bricks.iter().map(|b| b.0).collect(),
        },
        Event::BricksForgotten { worker, set: key, bricks } => Noted::BricksForgotten {
            w: worker.0,
            set: set(key),
            bricks: bricks.iter().map(|b| b.0).collect(),
        },
        Event::Pong { worker, nonce, clock_us } => {
            Noted::Pong { w: worker.0, nonce: *nonce, clock_us: *clock_us }
        }
        Event::Tick => Noted::Tick,
    })
}
