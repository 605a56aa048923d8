//! Records of seeded runs: workers join, leave, lie, fall silent and answer late.

use super::{
    Difference, RecordError, RecordSummary, RecordedScheduler, ReplaySummary, bits, replay, runs,
    start,
};
use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId, WorkerId};
use slabcast_common::image::{Background, PixelEncoding, PixelFormat, SparseTile, TilePixels};
use slabcast_common::message::{
    Checkpoint, Counters, ErrorsBySource, Pixels, RegionCost, RegionSplit, SampledError, SceneSpec,
    TaskTimes, TileResult, ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Quality, Schedule, Sums, Work};
use slabcast_common::region::{parts, split_tile};
use slabcast_common::view::View;
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::path::Orientation;
use slabcast_scene::path::{Turntable, ViewPath};
use slabcast_scene::presets;
use slabcast_schedule::{Action, Clock, Config, Event, FrameJob, Micros, WorkerIdentity};
use std::cell::Cell;
use std::io::Write;
use std::sync::{Arc, Mutex};

struct Virtual(Cell<Micros>);

impl Clock for Virtual {
    fn now(&self) -> Micros {
        // Time goes on while the scheduler thinks, as it does in a master.
        self.0.set(self.0.get() + 3);
        self.0.get()
    }
}

#[derive(Clone, Default)]
struct Shared(Arc<Mutex<Vec<u8>>>);

impl Write for Shared {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("no panic").extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

struct Rng(u64);

impl Rng {
    fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) % n
    }
}

/// Format of every other frame, which workers finish.
fn finish(frame: FrameId) -> Option<PixelEncoding> {
    let (format, background) = (PixelFormat::Rgb8, Background::Colour([0.5; 3]));
    frame.0.is_multiple_of(2).then_some(PixelEncoding { format, background })
}

fn jobs(rng: &mut Rng, schedule: Schedule) -> Vec<FrameJob> {
    let volume = Volume::from_fn_u8("v", [40, 32, 24], |i, j, k| (i * 3 + j + k) as u8);
    let info = volume.info(Digest32([3; 32]));
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    let quality = Quality { sums: Sums::I32, ..Quality::before() };
    let set = BrickSetKey(Digest32([9; 32]));
    let grid = BrickGrid::new(info.lattice.dims);
    let bricks: Arc<[BrickInfo]> = (0..grid.len() as u32)
        .map(|id| {
            let lo = grid.corner(BrickId(id));
            let tight = TightBox { lo, hi: lo.map(|x| x + BRICK_EDGE - 1) };
            BrickInfo { id: BrickId(id), tight, voxels: 512, bytes: 1547 }
        })
        .collect();
    let scene = Arc::new(SceneSpec {
        id: SceneId(4),
        volume: info.clone(),
        transfer,
        quality,
        crop: None,
        bricks: set,
    });
    let path = ViewPath::from_turntable([96, 80], Turntable { frames: 3, ..Turntable::default() });
    let orientation = Orientation::new(None, None).expect("the default");
    (0..3)
        .map(|i| {
            let camera = path.camera(i, &info.lattice, orientation).expect("a camera");
            let view = View::new(&info.lattice, &camera, [96, 80], &quality).expect("a view");
            let slabs = 1 + rng.below(4) as u32;
            let work = Work { slabs, schedule, ..Work::default() };
            let (frame, number) = (FrameId(i as u64 + 1), i as u64);
            let (scene, bricks) = (scene.clone(), bricks.clone());
            let finish = finish(frame);
            FrameJob { frame, number, scene, bricks, view, work, finish, client: 0 }
        })
        .collect()
}

fn area(r: &Rect) -> f64 {
    r.area() as f64
}

/// A run of one seed, recorded.
fn recorded(seed: u64, schedule: Schedule) -> (Vec<u8>, RecordSummary) {
    let mut rng = Rng(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1);
    let out = Shared::default();
    let (recorder, thread) = start(out.clone()).expect("a thread");
    let config = Config { silence: 400_000, heartbeat: 100_000, ..Config::default() };
    let mut s = RecordedScheduler::new(config, Some(recorder));
    let clock = Virtual(Cell::new(1000));
    let mut workers: Vec<WorkerId> = Vec::new();
    let mut next = 1;
    let by_region = schedule == Schedule::Region;
    // Task, epoch and pixels.
    let mut leases = Vec::new();
    let mut coming: Vec<Event> = jobs(&mut rng, schedule)
        .into_iter()
        .rev()
        .map(|job| Event::FrameQueued(Box::new(job)))
        .collect();
    let mut over = 0;
    for step in 0..20_000 {
        clock.0.set(clock.0.get() + rng.below(3_000));
        let event = match rng.below(16) {
            0 | 1 if !coming.is_empty() => coming.pop(),
            2 if workers.len() < 3 || step > 15_000 && workers.is_empty() => {
                let worker = WorkerId(next);
                next += 1;
                workers.push(worker);
                let (name, threads) = (format!("n{next}"), 1 + rng.below(3) as u32);
                let held = vec![(BrickSetKey(Digest32([9; 32])), vec![BrickId(1), BrickId(7)])];
                let budget = if rng.below(3) == 0 { 20_000 } else { u64::MAX };
                let (is_local, memory_budget_bytes) = (rng.below(2) == 0, budget);
                Some(Event::WorkerJoined {
                    worker,
                    is_trusted: next % 4 != 0,
                    identity: WorkerIdentity { host: "here".into(), name: name.clone() },
                    name,
                    threads,
                    is_local,
                    memory_budget_bytes,
                    held,
                })
            }
            3 if rng.below(40) == 0 && !workers.is_empty() => {
                let worker = workers.remove(rng.below(workers.len() as u64) as usize);
                Some(Event::WorkerLost { worker, reason: "its link closed".into() })
            }
            4 => Some(Event::Tick),
            5 if by_region && !workers.is_empty() => {
                let worker = workers[rng.below(workers.len() as u64) as usize];
                let set = BrickSetKey(Digest32([9; 32]));
                let bricks = vec![BrickId(rng.below(70) as u32), BrickId(rng.below(20) as u32)];
                Some(match rng.below(3) {
                    0 => Event::BricksForgotten { worker, set, bricks },
                    _ => Event::BricksWanted { worker, set, bricks },
                })
            }
            _ if !leases.is_empty() => {
                let which = rng.below(leases.len() as u64) as usize;
                let (worker, (task, epoch), tile, finish): (
                    WorkerId,
                    _,
                    Rect,
                    Option<PixelEncoding>,
                ) = leases.remove(which);
                let n = tile.area();
                let mut pixels = TilePixels {
                    a: (0..n).map(|i| ((i as u64 + rng.0) % 7) as f32 / 6.0).collect(),
                    colour: vec![[5; 3]; n],
                    last: (rng.below(2) == 0).then(|| vec![[1; 4]; n]),
                };
                match rng.below(60) {
                    0 => pixels.a[0] = f32::NAN,
                    1 => pixels.colour.truncate(3),
                    _ => {}
                }
                let pixels = match finish {
                    Some(finish) => {
                        let size = [tile.width() as u32, tile.height() as u32];
                        let mut leaves = SparseTile::blank(size, finish.format);
                        leaves.mask[0] = 1;
                        let len = SparseTile::data_len(size, finish.format, &leaves.mask);
                        leaves.data.resize(len, 7);
                        match rng.below(60) {
                            0 => leaves.max_alpha = f32::NAN,
                            1 => leaves = SparseTile::blank([3, 1], finish.format),
                            2 => leaves = SparseTile::blank(size, PixelFormat::Rgba8),
                            _ => {}
                        }
                        Pixels::Finished(leaves)
                    }
                    None => Pixels::Sums(pixels),
                };
                let start_us = clock.0.get().saturating_sub(900);
                let times = TaskTimes { start_us, end_us: start_us + 700, ..TaskTimes::default() };
                let touched =
                    (0..60).filter(|i| (i + rng.0).is_multiple_of(5)).map(|i| i as u32).collect();
                let region =
                    by_region.then_some(RegionCost {
                        touched,
                        stalls: 1,
                        parked_us: 20,
                        idle_us: 5,
                        sampled: ErrorsBySource::from_array([0, 1, 2, 3].map(|i| SampledError {
                            pixels: 9 - i,
                            squares: 1 << 50 | rng.below(99),
                        })),
                    });
                let counters = Counters { tossed: 3, splatted: 2, culled: 1 };
                if rng.below(50) == 0 {
                    Some(Event::Failed { worker, task, epoch, reason: "no \"reason\"".into() })
                } else {
                    let bytes = (rng.below(2) == 0).then_some(99 + n as u32);
                    let result = TileResult { task, epoch, pixels, bytes, counters, times, region };
                    Some(Event::Result { worker, result: Box::new(result) })
                }
            }
            _ => workers.first().map(|&worker| Event::WorkerHeard { worker }),
        };
        let Some(event) = event else { continue };
        s.handle(&clock, event);
        // A master handles all that is there before it acts.
        if rng.below(4) == 0 {
            continue;
        }
        let mut arrived = Vec::new();
        while let Some(action) = s.next_action() {
            match action {
                Action::Send { worker, message: ToWorker::Lease(l) } => {
                    leases.push((worker, (l.task, l.epoch), l.tile, None));
                }
                Action::Send { worker, message: ToWorker::Region(l) } => {
                    leases.push((worker, (l.task, l.epoch), l.tile, finish(l.frame)));
                }
                Action::Send {
                    worker,
                    message: ToWorker::SplitRegion { task, epoch, share, .. },
                } => {
                    let name = (task, epoch);
                    let lease = leases.iter_mut().find(|l| l.0 == worker && l.1 == name);
                    let share = f64::from(share) / 1000.0;
                    let pieces = lease.and_then(|l| Some((split_tile(l.2, share, area)?, l)));
                    if let Some(((kept, given), lease)) = pieces {
                        let n = given.area();
                        let mut pixels = TilePixels {
                            a: vec![0.5; n],
                            colour: vec![[5; 3]; n],
                            last: (rng.below(2) == 0).then(|| vec![[1; 4]; n]),
                        };
                        if rng.below(20) == 0 {
                            pixels.a[0] = f32::NAN;
                        }
                        let sheets = parts(given).map(|_| (rng.below(9) > 0).then_some(-3));
                        let begun = Checkpoint { sheets: sheets.collect(), pixels };
                        lease.2 = kept;
                        let piece = Box::new(RegionSplit { task, epoch, kept, given, begun });
                        arrived.push(Event::HandedOver { worker, piece });
                    }
                }
                Action::SendBricks { worker, set, bricks } => {
                    let bricks = bricks.len() as u32;
                    arrived.push(Event::BricksIn { worker, set, bricks });
                }
                Action::Send { worker, message: ToWorker::Ping { nonce } } => {
                    let clock_us = clock.0.get() + 77;
                    arrived.push(Event::Pong { worker, nonce, clock_us });
                }
                Action::Drop { worker, .. } | Action::ShutOut { worker, .. } => {
                    workers.retain(|w| *w != worker);
                }
                Action::FrameDone { .. }
                | Action::FrameFailed { .. }
                | Action::FrameTainted { .. } => over += 1,
                _ => {}
            }
        }
        arrived.into_iter().for_each(|e| s.handle(&clock, e));
        if over == 3 {
            break;
        }
    }
    assert_eq!(over, 3, "seed {seed}: every frame ends");
    drop(s);
    let written = thread.join().expect("no panic").expect("it can be written");
    let bytes = out.0.lock().expect("no panic").clone();
    (bytes, written)
}

#[test]
fn recorded_runs_replay_identically() {
    let (mut frames, mut dropped, mut dropped_finished) = (0, 0, [0; 3]);
    let (mut pieces, mut shut_out) = (0, 0);
    for seed in 0..96 {
        let schedule = if seed % 2 == 0 { Schedule::Slab } else { Schedule::Region };
        let (bytes, written) = recorded(seed, schedule);
        let done = replay(&bytes[..]).unwrap_or_else(|e| panic!("seed {seed}: {e}"));
        assert_eq!(done.difference, None, "seed {seed}");
        assert_eq!((done.events, done.decisions), (written.events, written.decisions));
        assert_eq!(done.cut, None, "seed {seed}");
        frames += done.frames;
        let text = String::from_utf8_lossy(&bytes);
        dropped += text.matches("plane has").count();
        shut_out += text.matches(": shut out by").count();
        pieces += text.matches(", as it was left").count();
        let lies = ["do not fit", "its tile has", "a result in Rgba8"];
        for (n, lie) in dropped_finished.iter_mut().zip(lies) {
            *n += text.matches(lie).count();
        }
    }
    let all = dropped > 0 && pieces > 0 && shut_out > 0 && dropped_finished.iter().all(|n| *n > 0);
    assert!(
        frames > 120 && all,
        "{frames} frames, {dropped} and {dropped_finished:?} liars, {pieces} pieces, {shut_out} shut out"
    );
}

/// A record with one line changed.
fn tampered(
    bytes: &[u8],
    is: impl Fn(&str) -> bool,
    change: impl Fn(&str) -> String,
) -> (u64, Vec<u8>) {
    let text = std::str::from_utf8(bytes).expect("JSON");
    let (mut at, mut out) = (0, String::new());
    for (n, line) in text.lines().enumerate() {
        if at == 0 && is(line) {
            at = n as u64 + 1;
            out += &change(line);
        } else {
            out += line;
        }
        out.push('\n');
    }
    assert!(at > 0, "a line of that kind");
    (at, out.into_bytes())
}

#[test]
fn replay_finds_a_changed_decision_at_its_line() {
    let (bytes, _) = recorded(3, Schedule::Slab);
    let lease = |l: &str| l.starts_with("{\"out\"") && l.contains("lease t");
    let (line, changed) = tampered(&bytes, lease, |l| l.replacen("lease t", "lease t9", 1));
    let ReplaySummary { difference: Some(d), .. } = replay(&changed[..]).expect("it can be read")
    else {
        panic!("nothing was found");
    };
    let Difference { line: at, recorded, replayed } = d;
    assert_eq!(at, line);
    assert!(recorded.contains("lease t9") && !replayed.contains("lease t9"), "{replayed}");
}

#[test]
fn replay_finds_changed_events_by_their_decisions() {
    let (bytes, _) = recorded(5, Schedule::Slab);
    let result = |l: &str| l.contains("\"result\"") && l.contains("\"shut\":\"0");
    let (line, changed) = tampered(&bytes, result, |l| {
        let at = l.find("\"shut\":\"").expect("it has one") + 8;
        let end = at + l[at..].find('"').expect("it ends");
        format!("{}{}", &l[..at], &l[end..])
    });
    let done = replay(&changed[..]).expect("it can be read");
    assert!(done.difference.is_some_and(|d| d.line > line), "other pixels are shut");
    let time = |l: &str| l.starts_with("{\"event\"") && l.contains("\"result\"");
    let (line, changed) = tampered(&bytes, time, |l| l.replacen("{\"t\":[", "{\"t\":[1,", 1));
    match replay(&changed[..]) {
        Ok(done) => assert!(done.difference.is_some_and(|d| d.line >= line)),
        Err(RecordError { line: at, problem }) => assert!(at == line && problem.contains("time")),
    }
}

#[test]
fn replay_names_the_line_of_a_broken_file() {
    let (bytes, _) = recorded(1, Schedule::Slab);
    let says = |bytes: &[u8]| replay(bytes).expect_err("it is broken").to_string();
    assert!(says(b"").starts_with("line 1: is not a record's first line"));
    assert!(says(b"PNG\n").starts_with("line 1: is not a record's first line"));
    assert!(says(b"{\"out\":[]}\n").starts_with("line 1: is not"));
    let any = |l: &str| l.starts_with("{\"event\"");
    let (line, bad) = tampered(&bytes, any, |_| "{\"event\":5}".into());
    assert!(says(&bad).starts_with(&format!("line {line}: is not a line of a record")));
    let head = |l: &str| l.starts_with("{\"record\"");
    let (_, bad) = tampered(&bytes, head, |l| l.replace("\"version\":5", "\"version\":7"));
    assert!(says(&bad).contains("version 7"), "{}", says(&bad));
    let scene = |l: &str| l.starts_with("{\"scene\"");
    let (line, bad) = tampered(&bytes, scene, |l| l.replace("\"wire\":\"", "\"wire\":\"ff"));
    assert!(says(&bad).starts_with(&format!("line {line}: `wire`")), "{}", says(&bad));
    let joined = |l: &str| l.contains("\"joined\"");
    let (line, bad) = tampered(&bytes, joined, |l| format!("{l}\n{l}"));
    let said = says(&bad);
    assert!(said.starts_with(&format!("line {}: w1 joined before", line + 1)), "{said}");
    let end = |l: &str| l.starts_with("{\"end\"");
    let (line, bad) = tampered(&bytes, end, |l| l.replacen("events\":", "events\":1", 1));
    assert!(says(&bad).starts_with(&format!("line {line}: counts")));
    // A run that was killed: all that is there is compared.
    let cut = replay(&bytes[..bytes.len() / 2]).expect("it can be read");
    assert!(cut.cut.is_some() && cut.difference.is_none() && cut.decisions > 0);
}

#[test]
fn run_lengths_round_trip_for_every_pattern() {
    for n in [0usize, 1, 5, 64, 300, 70_000] {
        for pattern in 0..5 {
            let of = |i: usize| match pattern {
                0 => false,
                1 => true,
                2 => i.is_multiple_of(2),
                3 => i > n / 3,
                _ => (i * i / 7) % 5 == 1,
            };
            let text = runs((0..n).map(of));
            assert_eq!(bits(&text, n).unwrap(), (0..n).map(of).collect::<Vec<_>>());
        }
    }
    assert_eq!(runs([false; 4096].into_iter()), "", "all open: nothing to say");
    for bad in ["0", "zz", "ff", "ffffffffffff01", "05"] {
        assert_eq!(bits(bad, 4), None, "{bad}");
    }
}
