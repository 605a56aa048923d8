//! Stories of tiles that workers fail at: no frame is done with a tile missing. A tile is tried by
//! workers that are really different, and at last its frame fails while all others go on.

use crate::pattern;
use crate::stories::{BOTH, DIMS, bricks, job_by, job_with, slab, world};
use crate::world::{Story, World, typical};
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_schedule::{FrameJob, Micros};
use slabcast_sim::{Faults, Incident, Rng, WorkerProfile};

/// A frame of one tile, at the upper left, with which nothing is wrong.
fn small_job(frame: u64, schedule: Schedule) -> Box<FrameJob> {
    let quality = Quality { thickness: 2.0, ..Quality::before() };
    let scene = pattern::scene(0, pattern::key(0), DIMS, quality);
    let work = Work { tile: Some(32), schedule, ..slab() };
    pattern::job(&mut Rng::new(5), frame, &scene, &bricks(), [32, 32], work)
}

/// A worker that dies of the tile at 32, 32.
fn dies(name: Option<&'static str>) -> WorkerProfile {
    let faults = Faults { deadly_tile: Some([32, 32]), ..Faults::default() };
    WorkerProfile { name, faults, ..typical() }
}

/// A worker that refuses all tasks.
fn refuses(name: &'static str) -> WorkerProfile {
    let faults = Faults { fail_one_in: 1, ..Faults::default() };
    WorkerProfile { name: Some(name), faults, ..typical() }
}

/// Lets time pass until all frames are over. Whoever is lost comes back `after` so many
/// microseconds, as `again` says. Returns how often somebody came back.
fn with_restarts(w: &mut World, after: Micros, mut again: impl FnMut() -> WorkerProfile) -> u64 {
    let mut restarts = 0;
    loop {
        w.until(|w| w.scheduler().is_idle() || w.scheduler().totals().lost_workers > restarts);
        if w.scheduler().is_idle() {
            return restarts;
        }
        restarts += 1;
        assert!(restarts < 1000, "they come back for ever");
        let when = w.now() + after;
        w.schedule(when, Incident::Join(Box::new(again())));
    }
}

#[test]
fn frame_fails_only_after_all_linked_workers_failed_at_a_tile_and_others_go_on() {
    for schedule in BOTH {
        let mut w = world();
        let mut names = ["a", "b", "c"].into_iter().cycle();
        for name in ["a", "b", "c"] {
            w.add_worker(dies(Some(name)));
        }
        w.add_frame(job_by(0, schedule));
        w.add_frame(small_job(1, schedule));
        w.add_frame(small_job(2, schedule));
        with_restarts(&mut w, 500_000, || dies(names.next()));
        assert_eq!(w.observer.audit.failed.keys().collect::<Vec<_>>(), [&FrameId(0)]);
        let reason = &w.observer.audit.failed[&FrameId(0)];
        assert!(reason.contains("tile of 32 pixels at 32,32: "), "{reason}");
        let told = ["a", "b", "c"].map(|name| format!("{name} was lost with it"));
        assert!(told.iter().all(|t| reason.contains(t)), "{reason}");
        assert_eq!(w.observer.done.keys().collect::<Vec<_>>(), [&FrameId(1), &FrameId(2)]);
        assert!(w.scheduler().totals().lost_workers >= 6, "each was asked twice");
    }
}

#[test]
fn worker_that_dies_of_a_tile_again_and_again_condemns_nothing_beside_a_healthy_one() {
    // Under one name, and under a new name each time.
    for (schedule, name) in BOTH.into_iter().flat_map(|s| [(s, Some("node7")), (s, None)]) {
        let mut w = world();
        w.add_worker(WorkerProfile { time_factor: 50.0, ..typical() });
        for _ in 0..3 {
            w.add_worker(dies(name));
        }
        for frame in 0..3 {
            w.add_frame(job_by(frame, schedule));
        }
        let restarts = with_restarts(&mut w, 1_000, || dies(name));
        assert!(restarts >= 3, "{restarts}");
        w.finish();
        assert_eq!(
            w.observer.done.len(),
            3,
            "{schedule:?} {name:?}: {:?}",
            w.observer.audit.failed
        );
    }
}

#[test]
fn tile_that_one_worker_refuses_waits_for_another_that_comes_later() {
    for schedule in BOTH {
        let mut w = world();
        w.add_worker(refuses("sick"));
        w.add_frame(job_by(0, schedule));
        w.run_for(3_000_000);
        assert!(w.observer.done.is_empty() && w.observer.audit.failed.is_empty());
        w.add_worker(typical());
        w.finish();
        let stats = &w.observer.done[&FrameId(0)].stats;
        let drew = stats.workers.iter().filter(|w| w.render_ms > 0.0).count();
        assert_eq!(drew, 1, "{stats:?}");
    }
}

#[test]
fn frame_whose_only_worker_refuses_it_fails_with_what_it_said() {
    for schedule in BOTH {
        let mut w = world();
        w.add_worker(refuses("sick"));
        w.add_frame(job_by(0, schedule));
        w.add_frame(job_by(1, schedule));
        w.until(|w| w.scheduler().is_idle());
        assert_eq!(w.observer.audit.failed.len(), 2);
        let reason = &w.observer.audit.failed[&FrameId(0)];
        assert!(reason.contains("sick refused it: no reason"), "{reason}");
        assert!(w.now() < 240_000_000, "a person is told within minutes: {} us", w.now());
        // Refusals of one worker pause it longer and longer.
        let pauses: Vec<Micros> = w.observer.audit.pauses.iter().map(|p| p.1).collect();
        assert_eq!(pauses.iter().max(), Some(&10_000_000));
        assert!(w.observer.done.is_empty());
    }
}

#[test]
fn worker_in_a_crash_loop_is_lent_less_and_less() {
    let mut w = world();
    w.add_worker(WorkerProfile { time_factor: 5.0, ..typical() });
    w.add_worker(dies(Some("loop")));
    let work = Work { tile: Some(32), schedule: Schedule::Region, ..slab() };
    let quality = Quality { thickness: 2.0, ..Quality::before() };
    for frame in 0..40 {
        w.add_frame(job_with(frame, work, quality));
    }
    let restarts = with_restarts(&mut w, 1_000, || dies(Some("loop")));
    w.finish();
    assert_eq!(w.observer.done.len(), 40);
    let took = w.now();
    assert!(restarts < 40, "{restarts} restarts in {took} us");
}

#[test]
fn killed_workers_that_come_back_under_their_names_cost_no_frame() {
    // All workers die at once, again and again, whatever they draw: no tile is at fault.
    for seed in 0..40 {
        let mut rng = Rng::new(seed);
        let mut w = world();
        let names = ["a", "b", "c", "d"];
        for name in names {
            w.add_worker(WorkerProfile { name: Some(name), ..typical() });
        }
        let work = Work { tile: Some(16), schedule: BOTH[seed as usize % 2], ..slab() };
        w.add_frame(job_with(0, work, Quality { thickness: 2.0, ..Quality::before() }));
        for round in 0..4 {
            let when = 5_000 + 12_000 * round + rng.below(5_000);
            for (name, id) in names.into_iter().zip(4 * round + 1..) {
                w.schedule(when, Incident::Kill(WorkerId(id)));
                let back = WorkerProfile { name: Some(name), ..typical() };
                w.schedule(when + 2_000, Incident::Join(Box::new(back)));
            }
        }
        w.finish();
        assert!(
            w.observer.done.contains_key(&FrameId(0)),
            "seed {seed}: {:?}",
            w.observer.audit.failed
        );
    }
}
