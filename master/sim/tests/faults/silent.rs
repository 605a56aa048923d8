//! Stories of workers that say nothing for a while: others get their tasks after a second, and
//! nothing is drawn twice for a network that paused for everybody.

use crate::stories::{BOTH, job_by, job_with, slab, world};
use crate::world::{Story, World, typical};
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::quality::{Quality, Work};
use slabcast_schedule::Micros;
use slabcast_sim::{Incident, WorkerProfile};

/// Draws a frame on three workers and, if told so, silences one of them early in the next frame for
/// ten seconds. Returns how long the second frame took, in microseconds, and the world.
fn second_frame(work: Work, is_silenced: bool) -> (Micros, World) {
    let mut w = world();
    for _ in 0..3 {
        w.add_worker(WorkerProfile { time_factor: 2.0, ..typical() });
    }
    let quality = Quality { thickness: 2.0, ..Quality::before() };
    w.add_frame(job_with(0, work, quality));
    w.until(|w| w.scheduler().is_idle());
    w.add_frame(job_with(1, work, quality));
    let began = w.now();
    if is_silenced {
        w.schedule(began + 10_000, Incident::Partition(WorkerId(1), 10_000_000));
    }
    w.until(|w| w.scheduler().is_idle());
    let took = w.now() - began;
    (took, w)
}

#[test]
fn worker_that_falls_silent_costs_a_frame_a_second_and_not_three() {
    // With many tiles, and with so few that nobody knows how long tiles take.
    for (schedule, tile) in BOTH.into_iter().flat_map(|s| [16, 64].map(|t| (s, t))) {
        let work = Work { tile: Some(tile), slabs: 1, schedule, ..slab() };
        let (healthy, _) = second_frame(work, false);
        let (took, mut w) = second_frame(work, true);
        assert!(took < 2 * healthy + 1_050_000, "{schedule:?} {tile}: {took} us, else {healthy}");
        assert_eq!(w.scheduler().workers().len(), 3, "it is not lost yet");
        w.finish();
    }
}

#[test]
fn frame_of_one_tile_passes_from_a_silent_worker_to_an_idle_one() {
    for schedule in BOTH {
        let mut w = world();
        for _ in 0..2 {
            w.add_worker(WorkerProfile { time_factor: 2.0, ..typical() });
        }
        let work = Work { tile: Some(256), slabs: 1, schedule, ..slab() };
        w.add_frame(job_with(0, work, Quality { thickness: 2.0, ..Quality::before() }));
        let has_it = w.scheduler().workers().iter().find(|v| v.leases > 0).map(|v| v.id);
        let has_it = has_it.expect("somebody has the tile");
        let began = w.now();
        w.schedule(began + 1_000, Incident::Partition(has_it, 20_000_000));
        w.until(|w| w.observer.audit.leases_given > 1);
        let waited = w.now() - began;
        assert!((1_000_000..1_300_000).contains(&waited), "{schedule:?}: {waited} us");
        w.finish();
        assert_eq!(w.observer.done[&FrameId(0)].stats.retries, 1);
    }
}

#[test]
fn silence_of_all_workers_at_once_has_nothing_drawn_twice() {
    for schedule in BOTH {
        let mut w = world();
        for _ in 0..3 {
            w.add_worker(WorkerProfile { time_factor: 40.0, ..typical() });
        }
        w.add_frame(job_by(0, schedule));
        let began = w.now();
        for id in 1..=3 {
            w.schedule(began + 10_000, Incident::Partition(WorkerId(id), 1_600_000));
        }
        w.run_for(2_000_000);
        w.finish();
        assert!(w.observer.audit.drops.is_empty());
        // Those that are heard first may take what the others had for a moment.
        let retries = w.observer.done[&FrameId(0)].stats.retries;
        assert!(retries <= 2, "{schedule:?}: {retries} tiles drawn twice");
    }
}
