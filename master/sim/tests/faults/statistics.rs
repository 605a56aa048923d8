//! Statistics of a frame, worked out by hand.

use crate::pattern;
use crate::stories::{job_with, slab};
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::quality::{Quality, Work};
use slabcast_schedule::{Action, Clock, Config, Event, Micros, Scheduler, WorkerIdentity};
use std::cell::Cell;

/// A clock on which each look costs a millisecond.
struct Stepping(Cell<Micros>);

impl Clock for Stepping {
    fn now(&self) -> Micros {
        self.0.set(self.0.get() + 1000);
        self.0.get()
    }
}

#[test]
fn statistics_of_a_frame_worked_out_by_hand() {
    // One worker, one thread, a clock of our own; one tile over the whole picture, two slabs.
    let clock = Stepping(Cell::new(0));
    let mut s = Scheduler::new(Config::default());
    let worker = WorkerId(1);
    let (name, held) = ("one".to_string(), Vec::new());
    let joined = Event::WorkerJoined {
        worker,
        name,
        identity: WorkerIdentity::default(),
        is_trusted: true,
        threads: 1,
        is_local: false,
        memory_budget_bytes: u64::MAX,
        held,
    };
    s.handle(&clock, joined);
    let work = Work { tile: Some(256), slabs: 2, ..slab() };
    let job = job_with(3, work, Quality { thickness: 2.0, eps: 0.0, ..Quality::before() });
    let projections = pattern::projections(&job);
    s.handle(&clock, Event::FrameQueued(job.clone()));
    let (mut done, mut sent, mut results) = (None, 0, 0);
    while done.is_none() {
        let mut events = Vec::new();
        while let Some(action) = s.next_action() {
            match action {
                Action::SendBricks { worker, set, bricks } => {
                    sent += bricks.len() as u64;
                    events.push(Event::BricksIn { worker, set, bricks: bricks.len() as u32 });
                }
                Action::Send { message: slabcast_common::message::ToWorker::Lease(l), .. } => {
                    clock.0.set(clock.0.get() + 50_000);
                    let pixels = pattern::render(
                        &projections,
                        &job.scene.quality,
                        l.tile,
                        l.slab,
                        &l.bricks,
                        &l.state,
                    );
                    // It arrived 2 ms before it was begun, and took 40.
                    let times = slabcast_common::message::TaskTimes {
                        received_us: 1_000,
                        ready_us: 2_000,
                        start_us: 3_000,
                        end_us: 43_000,
                        thread: 0,
                    };
                    let counters = Default::default();
                    let (task, epoch) = (l.task, l.epoch);
                    let result = slabcast_common::message::TileResult {
                        task,
                        epoch,
                        pixels: slabcast_common::message::Pixels::Sums(pixels),
                        bytes: None,
                        counters,
                        times,
                        region: None,
                    };
                    results += 1;
                    events.push(Event::Result { worker, result: Box::new(result) });
                }
                Action::FrameDone { stats, frame, .. } => done = Some((frame, stats)),
                _ => {}
            }
        }
        for event in events {
            s.handle(&clock, event);
        }
    }
    let (frame, stats) = done.expect("the loop ended");
    assert_eq!((frame, stats.frame, stats.v), (FrameId(3), 3, 1));
    assert_eq!((stats.slabs.len(), results), (2, 2));
    assert_eq!(stats.ms.render, 80.0);
    assert_eq!(stats.ms.cull, 1.0 + 2.0 * 1.0, "one look apart: projecting, and each slab");
    assert_eq!(stats.ms.composite, 2.0);
    let one = &stats.workers[0];
    assert_eq!((one.id.as_str(), one.render_ms), ("one", 80.0));
    assert_eq!((one.bricks_sent, one.bricks_held), (sent, sent));
    assert_eq!(one.wait_ms, stats.ms.total - 80.0);
    assert!(one.p2p_ms >= 2.0 * 8.0 && one.p2p_ms < 40.0, "{}", one.p2p_ms);
    assert!(stats.ms.distribute > 0.0 && stats.ms.wait > 0.0);
    assert_eq!(stats.bricks.needed, projections.len() as u64);
    assert_eq!(stats.bricks.relevant, job.bricks.len() as u64);
    let voxels: u64 = job.bricks.iter().map(|b| u64::from(b.voxels)).sum();
    assert_eq!(stats.voxels.relevant, voxels);
    assert_eq!(stats.slabs[0].tiles[0].worker, "one");
    assert_eq!(stats.slabs[0].tiles[0].ms, 40.0);
    assert_eq!((stats.slabs[0].empty, stats.slabs[0].shut), (0, 0));
}
