//! Stories of several clients: none waits for another's frame, whatever that takes and whatever
//! bricks it needs, and all pictures are as ever.

use crate::pattern;
use crate::stories::{DIMS, bricks, world};
use crate::world::{Story, World, typical};
use slabcast_common::ids::{FrameId, WorkerId};
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_schedule::{FrameJob, Micros};
use slabcast_sim::{Incident, Rng, WorkerProfile};

/// Returns a frame of a client, with a brick set of its own.
fn job_of(client: u64, frame: u64, edge: u32, thickness: f64) -> Box<FrameJob> {
    let quality = Quality { thickness, ..Quality::before() };
    let scene = pattern::scene(client, pattern::key(client as u8), DIMS, quality);
    let work = Work { schedule: Schedule::Region, ..Work::default() };
    let mut job = pattern::job(&mut Rng::new(5), frame, &scene, &bricks(), [edge, edge], work);
    (job.client, job.finish) = (client, None);
    job
}

/// Returns a frame whose tiles take minutes on a slow worker.
fn costly(client: u64, frame: u64) -> Box<FrameJob> {
    job_of(client, frame, 64, 0.25)
}

fn cheap(client: u64, frame: u64) -> Box<FrameJob> {
    job_of(client, frame, 32, 4.0)
}

/// Returns a worker of one thread that takes 0.1 ms for a pixel and sheet.
fn slow() -> WorkerProfile {
    WorkerProfile { time_factor: 100.0, time_jitter: 0.0, ..typical() }
}

/// Returns when a frame is done, from now on.
fn time_of(w: &mut World, frame: u64) -> Micros {
    let began = w.now();
    w.until(|w| w.observer.done.contains_key(&FrameId(frame)));
    w.now() - began
}

#[test]
fn frame_of_a_client_is_done_beside_one_of_another_that_takes_minutes() {
    for n in [1, 3] {
        let mut alone = world();
        for _ in 0..n {
            alone.add_worker(slow());
        }
        alone.add_frame(cheap(2, 0));
        let alone_us = time_of(&mut alone, 0);

        let mut w = world();
        for _ in 0..n {
            w.add_worker(slow());
        }
        w.add_frame(costly(1, 0));
        w.run_for(5_000_000);
        for frame in 1..4 {
            w.add_frame(cheap(2, frame));
            let us = time_of(&mut w, frame);
            assert!(us < 5 * alone_us / 2 + 300_000, "{n} workers: {us} us, alone {alone_us}");
        }
        assert!(!w.observer.audit.is_over(FrameId(0)));
        let long_us = 5_000_000 + time_of(&mut w, 0);
        assert!(long_us > 60_000_000 / n, "{n} workers: {long_us} us");
        w.finish();
    }
}

#[test]
fn clients_have_equal_shares_of_the_threads() {
    let mut w = world();
    w.add_worker(WorkerProfile { threads: 2, ..slow() });
    for frame in 0..3 {
        w.add_frame(job_of(1 + frame, frame, 64, 1.0));
    }
    let ends = [0, 1, 2].map(|frame| {
        w.until(|w| w.observer.done.contains_key(&FrameId(frame)));
        w.observer.done[&FrameId(frame)].at
    });
    let (first, last) = (ends[0].min(ends[1]).min(ends[2]), ends[0].max(ends[1]).max(ends[2]));
    assert!(10 * first > 7 * last, "equal frames end together: {ends:?}");
    w.finish();
}

#[test]
fn worker_that_dies_under_two_clients_costs_both_a_lease_and_no_frame() {
    let mut w = world();
    w.add_worker(slow());
    w.add_frame(costly(1, 0));
    w.add_frame(cheap(2, 1));
    w.run_for(500_000);
    let now = w.now();
    w.schedule(now, Incident::Kill(WorkerId(1)));
    w.schedule(now + 1_000, Incident::Join(Box::new(slow())));
    w.finish();
    assert_eq!(w.observer.done.len(), 2);
    assert!(w.observer.done.values().all(|done| done.stats.retries > 0));
}

#[test]
fn cancelled_frame_gives_its_threads_to_the_other_client_at_once() {
    let mut w = world();
    w.add_worker(slow());
    w.add_frame(costly(1, 0));
    w.run_for(1_000_000);
    let now = w.now();
    w.schedule(now, Incident::Cancel(FrameId(0)));
    w.run_for(1);
    w.add_frame(cheap(2, 1));
    let us = time_of(&mut w, 1);
    w.finish();
    let mut alone = world();
    alone.add_worker(slow());
    alone.add_frame(cheap(2, 0));
    let alone_us = time_of(&mut alone, 0);
    assert!(us < alone_us + 300_000, "{us} us, alone {alone_us}");
}
