//! A virtual cluster for the stories and campaigns: they add workers and frames, let time pass, and
//! compare pictures with those of one thread.

use crate::pattern::{self, Patterns};
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::image::FrameAssembler;
use slabcast_common::image::{FrameState, Picture};
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{Action, Config, Event, FrameJob, Micros, Span, Spans};
use slabcast_sim::{Audit, Incident, Master, Observer, VirtualCluster, WorkerProfile};
use std::collections::BTreeMap;

/// A frame that is done.
pub(crate) struct Done {
    /// Picture of the frame, if results were sums.
    pub(crate) picture: Option<Picture>,
    /// Encoded picture of the frame, if workers may finish pixels.
    pub(crate) bytes: Option<Vec<u8>>,
    pub(crate) stats: FrameStats,
    pub(crate) spans: Vec<Span>,
    pub(crate) at: Micros,
}

/// Keeps pictures, and audits the scheduler.
pub(crate) struct Seen {
    pub(crate) seed: u64,
    pub(crate) audit: Audit,
    pub(crate) done: BTreeMap<FrameId, Done>,
    /// Pictures of frames whose tiles come finished, as far as they have come.
    mosaics: BTreeMap<FrameId, FrameAssembler>,
    now: Micros,
}

impl Observer for Seen {
    fn event(&mut self, now: Micros, event: &Event) {
        self.audit.event(now, event);
    }

    fn action(&mut self, now: Micros, action: &Action) {
        self.now = now;
        self.audit.action(now, action);
        if let Action::Finished { frame, tiles } = action {
            let job = self.audit.job(*frame).expect("a frame that was queued");
            let finish = job.finish.expect("its tiles come finished");
            let begun = || FrameAssembler::new(job.view.size, &finish);
            self.mosaics.entry(*frame).or_insert_with(begun).place(tiles);
        }
    }

    fn frame_done(
        &mut self,
        frame: FrameId,
        state: Box<FrameState>,
        stats: FrameStats,
        spans: Spans,
    ) {
        let finish = self.audit.job(frame).expect("a frame that was queued").finish;
        let bytes = finish.map(|finish| match self.mosaics.remove(&frame) {
            Some(begun) => state.encode_onto(begun).bytes,
            None => state.encode(&finish, false).bytes,
        });
        let picture = finish.is_none().then(|| state.to_picture());
        let done = Done { picture, bytes, stats, spans: spans.to_vec(), at: self.now };
        self.done.insert(frame, done);
    }

    fn bricks_held(&mut self, worker: WorkerId, bytes: u64) {
        self.audit.bricks_held(worker, bytes);
    }
}

pub(crate) type World = VirtualCluster<Patterns, Seen>;

/// A worker of one thread: half a microsecond a pixel and sheet, 50 us a run, 100 us a message.
pub(crate) fn typical() -> WorkerProfile {
    WorkerProfile {
        time_factor: 0.5,
        time_jitter: 0.25,
        run_overhead_ns: 50_000,
        latency_ns: [100_000; 2],
        brick_bytes_per_s: Some(16e6),
        clock_ahead_us: 1_000_000,
        ..WorkerProfile::default()
    }
}

/// Returns a world of a seed, whose master takes no time.
pub(crate) fn new_world(seed: u64, config: Config) -> World {
    let master = Master { scheduler: config, random_batches: true, ..Master::default() };
    let (audit, done, mosaics) = (Audit::new(seed), BTreeMap::new(), BTreeMap::new());
    let seen = Seen { seed, audit, done, mosaics, now: 0 };
    VirtualCluster::new(master, Patterns::default(), seen, seed)
}

/// Steps of a story.
pub(crate) trait Story {
    /// Lets a worker join at once.
    fn add_worker(&mut self, profile: WorkerProfile) -> WorkerId;

    /// Queues a frame at once.
    fn add_frame(&mut self, job: Box<FrameJob>);

    /// Lets time pass until `until` says so. Panics when nothing happens any more.
    fn until(&mut self, until: impl FnMut(&World) -> bool);

    /// Lets so many microseconds pass.
    fn run_for(&mut self, us: Micros);

    /// Lets time pass until all frames are over and no incident is left, and checks what is left.
    fn finish(&mut self);
}

impl Story for World {
    fn add_worker(&mut self, profile: WorkerProfile) -> WorkerId {
        let id = self.join(profile);
        self.settle();
        id
    }

    fn add_frame(&mut self, job: Box<FrameJob>) {
        self.queue(job);
        self.settle();
    }

    fn until(&mut self, until: impl FnMut(&World) -> bool) {
        if !self.run_until(until) {
            panic!(
                "seed {}: stuck at {} us: {} of {} frames done, workers {:#?}",
                self.observer.seed,
                self.now(),
                self.observer.done.len(),
                self.jobs().count(),
                self.scheduler().workers(),
            );
        }
    }

    fn run_for(&mut self, us: Micros) {
        let end = self.now() + us;
        self.schedule(end, Incident::Nothing);
        self.until(|w| w.now() >= end);
    }

    fn finish(&mut self) {
        self.until(|w| w.is_idle() && !w.has_incidents());
        let seed = self.observer.seed;
        self.observer.audit.assert_all_ended();
        for w in self.scheduler().workers() {
            assert_eq!((w.leases, w.busy), (0, 0), "seed {seed}: leases of {} left", w.id);
        }
        for (frame, done) in &self.observer.done {
            let job = self.observer.audit.job(*frame).expect("a frame that was queued");
            let want = pattern::serial(job);
            if let Some(picture) = done.picture.as_ref().filter(|picture| **picture != want) {
                let bad = picture.pixels.iter().zip(&want.pixels).filter(|(a, b)| a != b);
                panic!("seed {seed}: {frame} differs in {} pixels", bad.count());
            }
            let bytes = job.finish.map(|finish| want.encode(finish.format, finish.background));
            assert!(done.bytes == bytes, "seed {seed}: {frame} has other bytes");
            check_stats(seed, job, done);
        }
    }
}

/// Checks that statistics add up.
fn check_stats(seed: u64, job: &FrameJob, done: &Done) {
    let (s, frame) = (&done.stats, job.frame);
    let [w, h] = job.view.size;
    let mut area = 0;
    for slab in &s.slabs {
        let sorted = slab.tiles.windows(2).all(|p| p[0].est >= p[1].est);
        assert!(sorted, "seed {seed}: the queue of {frame} is not sorted");
        for t in slab.tiles.iter().filter(|t| !t.worker.is_empty()) {
            area += u64::from((w - t.x).min(t.size)) * u64::from((h - t.y).min(t.size));
        }
    }
    assert_eq!(s.voxels.splatted, area, "seed {seed}: {frame} counts each tile once");
    assert_eq!(s.voxels.tossed, 2 * area, "seed {seed}");
    assert!(s.bricks.needed <= s.bricks.relevant, "seed {seed}");
    assert!(s.bricks.needed_voxels <= s.voxels.relevant, "seed {seed}");
    let m = &s.ms;
    assert!(m.overlap <= m.distribute + 1e-6, "seed {seed}: {m:?}");
    assert!(m.distribute <= m.total + 1e-6, "seed {seed}: {m:?}");
    let render: f64 = s.workers.iter().map(|w| w.render_ms).sum();
    let tiles: f64 = s.slabs.iter().flat_map(|s| &s.tiles).map(|t| t.ms).sum();
    assert!((render - m.render).abs() < 1e-6 && (tiles - render).abs() < 1e-6, "seed {seed}");
    for w in &s.workers {
        assert!(w.distribute_ms <= m.distribute + 1e-6, "seed {seed}: {w:?}");
        assert!(w.wait_ms >= 0.0 && w.p2p_ms >= 0.0, "seed {seed}: {w:?}");
        assert!((w.bricks_sent > 0) == (w.bytes_sent > 0), "seed {seed}: {w:?}");
    }
    for span in &done.spans {
        assert!(span.start <= span.end && span.end <= done.at, "seed {seed}: {span:?}");
    }
}
