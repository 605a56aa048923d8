//! Stories of workers that draw what they like: audits find them, and no false pixel is in a frame
//! that was audited.

use crate::stories::{BOTH, job_by, world};
use crate::world::{Story, World, typical};
use slabcast_common::ids::FrameId;
use slabcast_common::quality::Schedule;
use slabcast_schedule::Config;
use slabcast_sim::{Faults, WorkerProfile};

/// A worker that is audited and whose results are false, one in so many.
fn stranger(false_one_in: u64) -> WorkerProfile {
    let faults = Faults { false_one_in, ..Faults::default() };
    WorkerProfile { is_trusted: false, faults, ..typical() }
}

fn draw(w: &mut World, frames: std::ops::Range<u64>, schedule: Schedule) {
    for frame in frames {
        w.add_frame(job_by(frame, schedule));
        w.until(|w| w.scheduler().is_idle());
    }
}

#[test]
fn worker_that_lies_in_all_its_tiles_is_shut_out_within_its_first_frame() {
    // Against a trusted worker, and against two strangers that are honest.
    for (schedule, honest) in BOTH.into_iter().flat_map(|s| [true, false].map(|h| (s, h))) {
        let mut w = world();
        if honest {
            w.add_worker(typical());
        } else {
            w.add_worker(stranger(0));
            w.add_worker(stranger(0));
        }
        let liar = w.add_worker(stranger(1));
        draw(&mut w, 0..1, schedule);
        assert_eq!(w.observer.audit.shut_out, [liar], "{schedule:?} {honest}");
        assert!(w.observer.audit.tainted.is_empty(), "all its tiles were compared");
        draw(&mut w, 1..3, schedule);
        // Compares all pictures with those of one thread.
        w.finish();
        assert_eq!(w.observer.done.len(), 3);
    }
}

/// Answers a hundred times as fast as the others, so that they look silent and it is lent copies of
/// their tasks, of its own audited ones too.
#[test]
fn liar_that_answers_at_once_votes_once_and_is_the_only_one_shut_out() {
    let fast = || WorkerProfile { time_factor: 0.005, ..stranger(1) };
    let slow = |w: WorkerProfile| WorkerProfile { time_factor: 10.0, ..w };
    // Beside a trusted worker, and beside two and three strangers that are honest.
    for (schedule, strangers) in BOTH.into_iter().flat_map(|s| [0, 2, 3].map(|n| (s, n))) {
        let mut w = world();
        if strangers == 0 {
            w.add_worker(slow(typical()));
        }
        for _ in 0..strangers {
            w.add_worker(slow(stranger(0)));
        }
        let liar = w.add_worker(fast());
        draw(&mut w, 0..3, schedule);
        assert_eq!(w.observer.audit.shut_out, [liar], "{schedule:?} {strangers}");
        // Compares all pictures with those of one thread.
        w.finish();
        assert_eq!(w.observer.done.len(), 3);
    }
}

#[test]
fn worker_that_lies_now_and_then_is_found_by_the_share() {
    // It is honest while it is new, and then lies in every tile.
    for schedule in BOTH {
        let config = Config { audit_ppm: 100_000, audit_seed: 7, ..Config::default() };
        let mut w = crate::world::new_world(3, config);
        w.add_worker(typical());
        let liar = w.add_worker(stranger(9));
        for frame in 0..40 {
            w.add_frame(job_by(frame, schedule));
            w.until(|w| w.scheduler().is_idle());
            if !w.observer.audit.shut_out.is_empty() {
                break;
            }
        }
        assert_eq!(w.observer.audit.shut_out, [liar], "{schedule:?}");
    }
}

#[test]
fn honest_strangers_agree_and_cost_a_few_tiles_drawn_twice() {
    for schedule in BOTH {
        // Tiles drawn twice in the first four of twelve frames, and in the last four.
        let run = |worker: fn() -> WorkerProfile| {
            let mut w = world();
            for _ in 0..3 {
                w.add_worker(worker());
            }
            draw(&mut w, 0..12, schedule);
            w.finish();
            assert!(w.observer.audit.shut_out.is_empty() && w.observer.audit.tainted.is_empty());
            let retries = |frame| w.observer.done[&FrameId(frame)].stats.retries;
            [0..4, 8..12].map(|frames| frames.map(retries).sum::<u64>())
        };
        let (trusted, strangers) = (run(typical), run(|| stranger(0)));
        assert!(strangers[0] >= trusted[0] + 16, "{schedule:?}: {strangers:?}, else {trusted:?}");
        assert!(strangers[1] <= trusted[1] + 5, "{schedule:?}: {strangers:?}, else {trusted:?}");
    }
}

#[test]
fn sole_stranger_is_not_audited_and_does_not_wait_for_anybody() {
    for schedule in BOTH {
        let mut w = world();
        w.add_worker(stranger(0));
        draw(&mut w, 0..2, schedule);
        w.finish();
        assert_eq!(w.observer.done[&FrameId(0)].stats.retries, 0);
    }
}

#[test]
fn result_that_waits_for_a_second_worker_counts_when_that_one_is_gone() {
    for schedule in BOTH {
        let mut w = world();
        w.add_worker(stranger(0));
        let other = w.add_worker(WorkerProfile { time_factor: 1e6, ..stranger(0) });
        w.add_frame(job_by(0, schedule));
        w.run_for(200_000);
        assert!(w.observer.done.is_empty());
        w.kill(other);
        w.finish();
        assert_eq!(w.observer.done.len(), 1);
    }
}

#[test]
fn stranger_that_answers_pings_and_draws_nothing_delays_one_frame_by_seconds() {
    for schedule in BOTH {
        let mut w = world();
        w.add_worker(stranger(0));
        w.add_worker(WorkerProfile { time_factor: 1e9, ..stranger(0) });
        w.add_frame(job_by(0, schedule));
        w.run_for(6_000_000);
        assert_eq!(w.observer.done.len(), 1, "{schedule:?}");
        w.add_frame(job_by(1, schedule));
        w.run_for(1_000_000);
        assert_eq!(w.observer.done.len(), 2, "{schedule:?}: it is not waited for again");
        w.finish();
    }
}

#[test]
fn two_strangers_that_differ_fail_the_frame_unless_a_third_comes() {
    for (schedule, comes) in BOTH.into_iter().flat_map(|s| [true, false].map(|c| (s, c))) {
        let mut w = world();
        w.add_worker(stranger(0));
        let liar = w.add_worker(stranger(1));
        w.add_frame(job_by(0, schedule));
        w.run_for(3_000_000);
        assert!(w.observer.done.is_empty() && w.observer.audit.failed.is_empty());
        if comes {
            w.add_worker(typical());
            w.finish();
            assert_eq!(w.observer.audit.shut_out, [liar]);
            assert_eq!(w.observer.done.len(), 1);
        } else {
            w.until(|w| w.scheduler().is_idle());
            let reason = &w.observer.audit.failed[&FrameId(0)];
            assert!(reason.contains("drew different pixels"), "{reason}");
        }
    }
}

#[test]
fn trusted_workers_are_never_audited() {
    let mut w = world();
    for _ in 0..3 {
        w.add_worker(typical());
    }
    draw(&mut w, 0..3, Schedule::Region);
    w.finish();
    let retries: u64 = w.observer.done.values().map(|d| d.stats.retries).sum();
    assert!(retries <= 3, "speculative copies at most: {retries}");
}
