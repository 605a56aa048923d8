//! Stories: one world, one change, and what comes of it.

use crate::pattern;
use crate::world::{Story, World, new_world, typical};
use slabcast_common::brick::BrickInfo;
use slabcast_common::ids::{FrameId, SceneId, WorkerId};
use slabcast_common::quality::{Quality, Schedule, Work};
use slabcast_common::stats::FrameStats;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_schedule::{Config, FrameJob, Micros};
use slabcast_sim::{Faults, Incident, Rng, WorkerProfile};
use std::collections::BTreeMap;
use std::sync::Arc;

pub(crate) const DIMS: [u32; 3] = [48, 48, 48];
pub(crate) const BOTH: [Schedule; 2] = [Schedule::Slab, Schedule::Region];

/// Work under the paper's schedule.
pub(crate) fn slab() -> Work {
    Work { schedule: Schedule::Slab, ..Work::default() }
}

pub(crate) fn bricks() -> Arc<[BrickInfo]> {
    pattern::bricks(&mut Rng::new(1), DIMS, 6)
}

pub(crate) fn job_with(frame: u64, work: Work, quality: Quality) -> Box<FrameJob> {
    let scene = pattern::scene(0, pattern::key(0), DIMS, quality);
    pattern::job(&mut Rng::new(5 + frame), frame, &scene, &bricks(), [128, 128], work)
}

fn job(frame: u64) -> Box<FrameJob> {
    job_by(frame, Schedule::Slab)
}

pub(crate) fn job_by(frame: u64, schedule: Schedule) -> Box<FrameJob> {
    let work = Work { tile: Some(32), schedule, ..slab() };
    job_with(frame, work, Quality { thickness: 2.0, ..Quality::before() })
}

pub(crate) fn world() -> World {
    new_world(0, Config::default())
}

fn workers(w: &mut World, n: usize) -> Vec<WorkerId> {
    (0..n).map(|_| w.add_worker(typical())).collect()
}

/// Lets time pass until all frames are over. Returns how long that took, in microseconds.
fn time(w: &mut World) -> Micros {
    let start = w.now();
    w.until(|w| w.scheduler().is_idle());
    w.now() - start
}

/// Number of leases of each worker.
fn leases(w: &World) -> Vec<u32> {
    w.scheduler().workers().iter().map(|v| v.leases).collect()
}

#[test]
fn picture_bytes_do_not_depend_on_workers_tiles_slabs_or_culling() {
    let quality = Quality { thickness: 2.0, eps: 0.2, ..Quality::before() };
    let want = pattern::serial(&job_with(0, slab(), quality)).sha256();
    for n in [1, 3, 7] {
        for tile in [None, Some(16), Some(128), Some(256)] {
            for slabs in [1, 3, 40] {
                for cull in [true, false] {
                    let mut w = world();
                    for i in 0..n {
                        w.add_worker(WorkerProfile { threads: 1 + i % 3, ..typical() });
                    }
                    let work = Work { tile, slabs, ..slab() };
                    w.add_frame(job_with(0, work, Quality { cull, ..quality }));
                    if slabs == 1 {
                        let work = Work { schedule: Schedule::Region, ..work };
                        w.add_frame(job_with(1, work, Quality { cull, ..quality }));
                    }
                    w.finish();
                    assert_eq!(
                        w.observer.done[&FrameId(0)].picture.as_ref().map(|p| p.sha256()),
                        Some(want)
                    );
                }
            }
        }
    }
}

#[test]
fn leases_go_to_every_thread_first_and_the_last_tiles_are_held_back() {
    let mut w = world();
    w.add_worker(WorkerProfile { threads: 1, ..typical() });
    w.add_worker(WorkerProfile { threads: 3, ..typical() });
    w.add_frame(job(0));
    // 16 tiles at most; 4 threads. 8 leases fill both threads and the places behind them.
    assert_eq!(leases(&w), [2, 6]);

    let mut w = world();
    workers(&mut w, 7);
    w.add_frame(job(0));
    // 16 tiles (all of them have bricks): 7 in the threads, 2 ahead, 7 held back.
    assert_eq!(leases(&w), [2, 2, 1, 1, 1, 1, 1]);

    let mut w = world();
    workers(&mut w, 20);
    w.add_frame(job(0));
    let got = leases(&w);
    assert_eq!((got.iter().max(), got.iter().sum::<u32>()), (Some(&1), 16));
}

#[test]
fn frame_without_workers_waits_and_retries_only_lost_leases() {
    let mut w = world();
    w.add_frame(job(0));
    w.run_for(10_000_000);
    assert!(w.observer.done.is_empty() && !w.scheduler().is_idle() && !w.scheduler().has_workers());
    let id = w.add_worker(typical());
    w.until(|w| w.observer.audit.leases_given > 9);
    w.kill(id);
    w.run_for(10_000_000);
    w.add_worker(typical());
    w.finish();
    let stats = &w.observer.done[&FrameId(0)].stats;
    assert!((1..=2).contains(&stats.retries), "what it had, and no more: {}", stats.retries);
}

#[test]
fn late_joiner_gets_bricks_and_leases_at_once() {
    for schedule in BOTH {
        let mut w = world();
        workers(&mut w, 1);
        w.add_frame(job_by(0, schedule));
        w.until(|w| w.observer.audit.leases_given > 3);
        let id = w.add_worker(typical());
        let view = w.scheduler().workers().pop().expect("it joined");
        assert_eq!((view.id, view.leases > 0), (id, true));
        w.finish();
        let stats = &w.observer.done[&FrameId(0)].stats;
        assert!(stats.workers.iter().all(|w| w.render_ms > 0.0 && w.bricks_sent > 0));
    }
}

#[test]
fn partition_is_found_in_three_seconds_and_late_results_are_dropped() {
    let mut w = world();
    workers(&mut w, 2);
    w.add_frame(job(0));
    // While it has two leases.
    w.run_for(500);
    let start = w.now();
    w.schedule(start, Incident::Partition(WorkerId(1), 8_000_000));
    w.until(|w| !w.observer.audit.drops.is_empty());
    let found = w.now() - start;
    assert!((2_000_000..=3_000_000).contains(&found), "{found} us");
    w.finish();
    // Its neighbour did not wait for that: it ran the tasks twice.
    assert!(w.observer.done[&FrameId(0)].at - start < 1_000_000);
    w.run_for(9_000_000);
    let dropped = w.scheduler().totals().dropped_results;
    assert!(dropped <= 2, "{dropped}");
    assert_eq!(w.observer.audit.drops.len(), 1);
}

#[test]
fn heartbeat_keeps_a_worker_that_is_busy_for_minutes() {
    let mut w = world();
    w.add_worker(WorkerProfile { time_factor: 1000.0, ..typical() });
    w.add_frame(job(0));
    w.finish();
    assert!(w.now() > 60_000_000, "tiles of half a minute");
    assert!(w.observer.audit.drops.is_empty());
}

#[test]
fn killed_workers_leave_the_same_bytes_and_no_failed_frame() {
    // Promise R1, in virtual time, with the default poison rule.
    for seed in 0..200 {
        let mut rng = Rng::new(seed);
        let mut w = new_world(seed, Config::default());
        workers(&mut w, 8);
        let schedule = BOTH[seed as usize % 2];
        let work = Work { tile: Some(16), schedule, ..slab() };
        w.add_frame(job_with(0, work, Quality { thickness: 2.0, ..Quality::before() }));
        let kills = rng.pick(&[1, 4, 7]);
        for id in 1..=kills {
            let when = 1_000 + rng.below(25_000);
            w.schedule(when, Incident::Kill(WorkerId(id)));
        }
        w.finish();
        assert!(w.observer.done.contains_key(&FrameId(0)), "seed {seed}: no frame");
    }
}

#[test]
fn hanging_thread_costs_one_speculative_copy_of_its_tile() {
    for schedule in BOTH {
        let mut w = world();
        workers(&mut w, 2);
        w.add_worker(WorkerProfile {
            faults: Faults { hanging_tile: Some([64, 64]), ..Faults::default() },
            ..typical()
        });
        w.add_frame(job_by(0, schedule));
        w.finish();
        let at = w.observer.done[&FrameId(0)].at;
        assert!(at < 1_000_000, "nobody waited for the lease's 60 s: {at} us");
    }
}

#[test]
fn lease_expires_and_goes_to_another_worker() {
    // One tile, so that nothing is known of how long tiles take.
    let mut w = world();
    w.add_worker(WorkerProfile {
        faults: Faults { hanging_tile: Some([0, 0]), ..Faults::default() },
        ..typical()
    });
    workers(&mut w, 1);
    let work = Work { tile: Some(256), slabs: 1, ..slab() };
    w.add_frame(job_with(0, work, Quality::before()));
    let time = time(&mut w);
    assert!((60_000_000..61_500_000).contains(&time), "{time} us");
    assert_eq!(w.observer.done[&FrameId(0)].stats.retries, 1);
    w.finish();
}

#[test]
fn straggler_delays_a_frame_by_less_than_a_third() {
    // Promise R4: one of 8 workers at a tenth of the speed, against 7 healthy ones. Few tiles are
    // drawn twice for it.
    let run = |slow: bool, tile: Option<u32>, schedule: Schedule| {
        let mut w = world();
        workers(&mut w, 7);
        if slow {
            w.add_worker(WorkerProfile { time_factor: 5.0, ..typical() });
        }
        let work = Work { tile, schedule, ..slab() };
        w.add_frame(job_with(0, work, Quality { thickness: 1.0, ..Quality::before() }));
        let time = time(&mut w);
        w.finish();
        let stats = &w.observer.done[&FrameId(0)].stats;
        let tiles: usize = stats.slabs.iter().map(|s| s.tiles.len()).sum();
        (time, stats.retries as f64 / tiles as f64)
    };
    let mut worst = 0.0f64;
    for (tile, schedule) in
        [Some(16), Some(32)].into_iter().zip([BOTH; 2]).flat_map(|(t, b)| b.map(|b| (t, b)))
    {
        let ((healthy, _), (slow, twice)) = (run(false, tile, schedule), run(true, tile, schedule));
        let ratio = slow as f64 / healthy as f64;
        println!(
            "straggler: {schedule:?}, {tile:?}, {slow} us, healthy {healthy} us, {ratio:.2} x, \
             {:.1} % twice",
            100.0 * twice
        );
        worst = worst.max(ratio);
        // At the end of each of three slabs, others also draw the tiles of the slow one.
        let most = if schedule == Schedule::Region { 0.1 } else { 0.15 };
        assert!(twice <= most, "{:.1} % of the tiles", 100.0 * twice);
    }
    assert!(worst <= 1.3, "{worst:.2} x");
}

#[test]
fn only_missing_bricks_are_sent() {
    let mut w = world();
    workers(&mut w, 2);
    w.add_frame(job(0));
    w.until(|w| w.scheduler().is_idle());
    let first = w.observer.done[&FrameId(0)].stats.clone();
    assert!(first.workers.iter().all(|w| w.bricks_sent == first.bricks.needed));
    assert!(first.workers.iter().all(|w| w.bricks_held == w.bricks_sent));

    // The view is drawn once more; then a worker dies and rejoins with most of its bricks.
    let mut again = job(0);
    again.frame = FrameId(1);
    w.add_frame(again.clone());
    w.until(|w| w.scheduler().is_idle());
    assert!(w.observer.done[&FrameId(1)].stats.workers.iter().all(|w| w.bricks_sent == 0));
    let mut held = w.held_bricks(WorkerId(1));
    w.kill(WorkerId(1));
    let lost = held[0].1.split_off(5);
    let now = w.now();
    w.schedule(now, Incident::Rejoin(Box::new(typical()), held));
    w.until(|w| w.scheduler().workers().len() == 2);
    again.frame = FrameId(2);
    w.add_frame(again);
    w.finish();
    let last = &w.observer.done[&FrameId(2)].stats;
    let back = last.workers.iter().find(|w| w.id == "w3").expect("the third to join");
    assert_eq!(back.bricks_sent, lost.len() as u64);
}

#[test]
fn cancelled_frame_ends_at_once_in_any_state() {
    for (when, schedule) in (0..40_000).step_by(250).zip(BOTH.into_iter().cycle()) {
        let mut w = world();
        workers(&mut w, 2);
        w.add_frame(job_by(0, schedule));
        w.add_frame(job_by(1, schedule));
        w.schedule(when, Incident::Cancel(FrameId(0)));
        w.schedule(when, Incident::EndScene(SceneId(0)));
        w.finish();
        assert!(w.observer.done.contains_key(&FrameId(1)), "cancelled at {when}");
    }
    let mut w = world();
    w.add_frame(job(0));
    w.add_frame(job(1));
    let now = w.now();
    w.schedule(now, Incident::Cancel(FrameId(1)));
    w.schedule(now, Incident::Cancel(FrameId(0)));
    w.finish();
    assert!(w.scheduler().is_idle());
}

#[test]
fn regions_get_the_bricks_they_ask_for_and_hardly_more() {
    let mut w = world();
    for _ in 0..2 {
        // No tile takes so long that a piece of it is handed over.
        w.add_worker(WorkerProfile { time_factor: 0.02, ..typical() });
    }
    w.add_frame(job_by(0, Schedule::Region));
    w.until(|w| w.scheduler().is_idle());
    let first = w.observer.done[&FrameId(0)].stats.clone();
    assert!(first.workers.iter().all(|w| w.stalls > 0 && w.parked_ms > 0.0), "{first:?}");
    assert!(first.bricks.needed <= first.workers.iter().map(|w| w.bricks_held).sum());
    assert_eq!(first.slabs.len(), 1);
    // In the same view again, each worker draws the same tiles and holds their bricks. A brick that
    // also lies over the other worker's tiles is sent there once: nobody knows that it is hidden.
    for number in 1..3 {
        let mut again = job_by(0, Schedule::Region);
        again.frame = FrameId(number);
        w.add_frame(again);
        w.until(|w| w.scheduler().is_idle());
        let stats = &w.observer.done[&FrameId(number)].stats;
        assert_eq!(stats.bricks.needed, first.bricks.needed);
        for worker in &stats.workers {
            assert_eq!(worker.stalls, 0, "{worker:?}");
            let ahead = if number == 1 { worker.bricks_held / 20 } else { 0 };
            assert!(worker.bricks_sent <= ahead, "{worker:?}");
        }
    }
    w.finish();
    let second = &w.observer.done[&FrameId(1)].stats;
    let owners = |s: &FrameStats| -> BTreeMap<(u32, u32), String> {
        s.slabs[0].tiles.iter().map(|t| ((t.x, t.y), t.worker.clone())).collect()
    };
    assert_eq!(owners(second), owners(&first));
    let guesses = |s: &FrameStats| s.slabs[0].tiles.iter().map(|t| t.est).collect::<Vec<_>>();
    assert_ne!(guesses(second), guesses(&first), "their times are known");
}

#[test]
fn prefetch_sends_bricks_that_turn_into_another_workers_tiles() {
    let frame = |frame: u64, upside_down: bool| {
        let mut job = job_by(0, Schedule::Region);
        let side = if upside_down { -1.0 } else { 1.0 };
        let camera = Camera {
            to_eye: [0.3, 1.0, 0.1].into(),
            up: [0.0, 0.0, side].into(),
            target: [0.0; 3].into(),
            projection: CameraProjection::Ortho { height: 60.0 },
        };
        let scene = &job.scene;
        let view = View::new(&scene.volume.lattice, &camera, [128, 128], &scene.quality);
        (job.frame, job.number, job.view) = (FrameId(frame), frame, view.expect("a view"));
        job
    };
    // Two workers draw the upper and the lower half; the second frame swaps their bricks.
    let mut w = world();
    for _ in 0..2 {
        w.add_worker(WorkerProfile { time_factor: 0.02, ..typical() });
    }
    let (mut sent, mut wanted) = (Vec::new(), 0);
    for (number, upside_down) in [(0, false), (1, true), (2, false)] {
        w.add_frame(frame(number, upside_down));
        w.until(|w| w.scheduler().is_idle());
        let stats = &w.observer.done[&FrameId(number)].stats;
        let of = stats.workers.iter().map(|w| w.bricks_sent).sum::<u64>();
        sent.push((of, w.bricks_wanted() - wanted, stats.bricks.needed));
        wanted = w.bricks_wanted();
    }
    w.finish();
    let [(first, all, needed), (second, asked, _), (third, last, _)] = sent[..] else {
        unreachable!("three frames")
    };
    assert_eq!(all, first, "nothing is prefetched for a first frame");
    assert!(10 * second > 6 * needed, "{second} of {needed} swap");
    assert!(4 * asked < second, "{asked} of {second} were asked for");
    assert_eq!((third, last), (0, 0), "everybody has what it draws from");
}

#[test]
fn frames_of_a_path_overlap_and_end_in_order() {
    let mut w = world();
    workers(&mut w, 3);
    for frame in 0..4 {
        w.add_frame(job_by(frame, Schedule::Region));
    }
    // All three have as many leases as they are lent, of several frames: more, where they are known
    // to be short.
    w.until(|w| w.observer.audit.leases_given > 16);
    assert!(w.observer.done.is_empty() && leases(&w).iter().all(|n| (2..=8).contains(n)));
    w.finish();
    let all = w.now();
    let mut alone = world();
    workers(&mut alone, 3);
    for frame in 0..4 {
        alone.queue(job_by(frame, Schedule::Region));
        alone.run_until(|w| w.scheduler().is_idle());
    }
    assert!(all < alone.now(), "{all} us, one after the other {} us", alone.now());
}

/// Draws frames of one view, one at a time, in which nothing hides anything. Returns how long each
/// took, in microseconds.
fn one_by_one(w: &mut World, frames: std::ops::Range<u64>, work: Work) -> Vec<Micros> {
    let quality = Quality { thickness: 1.0, eps: 0.0, ..Quality::before() };
    let scene = pattern::scene(0, pattern::key(0), DIMS, quality);
    let took = frames.map(|frame| {
        let mut job = pattern::job(&mut Rng::new(5), 0, &scene, &bricks(), [256, 256], work);
        (job.frame, job.number) = (FrameId(frame), frame);
        w.add_frame(job);
        time(w)
    });
    took.collect()
}

#[test]
fn sole_worker_is_lent_all_short_tiles_at_once() {
    // 16 tiles, of which others might have some to take.
    let lent = |n| {
        let mut w = world();
        for _ in 0..n {
            w.add_worker(WorkerProfile { time_factor: 0.002, ..typical() });
        }
        let work = Work { tile: Some(64), schedule: Schedule::Region, ..slab() };
        one_by_one(&mut w, 0..2, work);
        let before = w.observer.audit.leases_given;
        let quality = Quality { thickness: 1.0, eps: 0.0, ..Quality::before() };
        let scene = pattern::scene(0, pattern::key(0), DIMS, quality);
        let mut job = pattern::job(&mut Rng::new(5), 0, &scene, &bricks(), [256, 256], work);
        (job.frame, job.number) = (FrameId(2), 2);
        w.add_frame(job);
        w.until(|w| w.observer.audit.leases_given > before);
        let most = leases(&w).into_iter().max();
        let tiles = w.observer.done[&FrameId(1)].stats.slabs[0].tiles.len();
        w.finish();
        (most.map(|n| n as usize), tiles)
    };
    let (most, tiles) = lent(1);
    assert!(tiles > 8 && most == Some(tiles), "{most:?} of {tiles}");
    let (most, tiles) = lent(2);
    assert!(most < Some(tiles), "{most:?} of {tiles}");
}

/// Number of tiles of a frame by their size.
fn sizes(w: &World, frame: u64) -> BTreeMap<u32, usize> {
    let mut sizes = BTreeMap::new();
    for t in &w.observer.done[&FrameId(frame)].stats.slabs[0].tiles {
        *sizes.entry(t.size).or_insert(0) += 1;
    }
    sizes
}

#[test]
fn sole_frame_with_few_long_tiles_is_cut_so_that_threads_end_together() {
    // 16 tiles of 64 pixels at most for 12 threads: four of them would have all others wait.
    let run = |tile| {
        let mut w = world();
        for _ in 0..12 {
            w.add_worker(WorkerProfile { time_factor: 0.1, ..typical() });
        }
        let work = Work { tile, tiles_per_worker: 1.0, schedule: Schedule::Region, ..slab() };
        let took = one_by_one(&mut w, 0..12, work);
        w.finish();
        // It is chance which tile is late in a frame.
        (took[2..].iter().sum::<Micros>(), w)
    };
    let (whole, _) = run(Some(64));
    let (cut, w) = run(None);
    assert_eq!(sizes(&w, 0).keys().copied().collect::<Vec<_>>(), [64], "nothing is known yet");
    let both = sizes(&w, 3);
    assert!(both.contains_key(&64) && both.contains_key(&32), "{both:?}");
    assert!(10 * cut < 9 * whole, "{cut} us, in tiles of 64 {whole}");
}

/// Three workers draw a frame that they know; 3 ms into it, `what` happens to the first of them.
/// Returns how long the frame took, in microseconds, and the world.
fn as_they_draw(what: Option<fn(WorkerId) -> Incident>) -> (Micros, World) {
    let mut w = world();
    let ids: Vec<WorkerId> =
        (0..3).map(|_| w.add_worker(WorkerProfile { time_factor: 0.1, ..typical() })).collect();
    let work = Work { tile: Some(64), schedule: Schedule::Region, ..slab() };
    one_by_one(&mut w, 0..2, work);
    if let Some(what) = what {
        let soon = w.now() + 3_000;
        w.schedule(soon, what(ids[0]));
    }
    let took = one_by_one(&mut w, 2..3, work)[0];
    w.finish();
    (took, w)
}

#[test]
fn work_stealing_shares_a_region_that_takes_longer_than_expected() {
    let (healthy, _) = as_they_draw(None);
    let (slow, w) = as_they_draw(Some(|id| Incident::Slow(id, 10.0)));
    let stats = &w.observer.done[&FrameId(2)].stats;
    assert!(w.handed_over() > 0 && stats.handed_over > 0, "{stats:?}");
    assert!(2 * slow < 5 * healthy, "{slow} us, and {healthy} where nobody is slow");
    // Nothing that it began is drawn twice.
    assert_eq!(stats.dropped_results, 0);
    let render = |stats: &FrameStats| stats.workers.iter().map(|w| w.render_ms).sum::<f64>();
    assert!(render(stats) < 1.5 * render(&w.observer.done[&FrameId(1)].stats), "{stats:?}");
    // Statistics are of whole tiles.
    assert_eq!(sizes(&w, 2).keys().copied().collect::<Vec<_>>(), [64]);
}

#[test]
fn work_stealing_survives_the_loss_of_either_worker() {
    // Any of the workers is lost at any time: the picture is whole.
    let (mut lost_pieces, mut n) = (0, 0);
    for victim in 1..=3 {
        for after in (500..60_000).step_by(12_100) {
            let mut w = world();
            for _ in 0..3 {
                w.add_worker(WorkerProfile { time_factor: 0.1, ..typical() });
            }
            let work = Work { tile: Some(64), schedule: Schedule::Region, ..slab() };
            one_by_one(&mut w, 0..2, work);
            let now = w.now();
            w.schedule(now + 3_000, Incident::Slow(WorkerId(1), 10.0));
            w.schedule(now + 3_000 + after, Incident::Kill(WorkerId(victim)));
            one_by_one(&mut w, 2..3, work);
            w.finish();
            let stats = &w.observer.done[&FrameId(2)].stats;
            n += 1;
            lost_pieces += usize::from(stats.handed_over > 0 && stats.retries > 0);
        }
    }
    assert!(lost_pieces > n / 4, "{lost_pieces} of {n} worlds");
}

#[test]
fn work_stealing_shares_the_last_tile_of_a_slow_worker() {
    // Two tiles each; then a worker slows down by half.
    let run = |slow: f64| {
        let mut w = world();
        for _ in 0..8 {
            w.add_worker(WorkerProfile { time_factor: 0.1, ..typical() });
        }
        let work = Work { tiles_per_worker: 1.0, schedule: Schedule::Region, ..slab() };
        let before = one_by_one(&mut w, 0..3, work);
        let now = w.now();
        w.schedule(now, Incident::Slow(WorkerId(2), slow));
        w.run_for(1);
        let took = one_by_one(&mut w, 3..4, work)[0];
        w.finish();
        let parts = sizes(&w, 3).get(&32).copied().unwrap_or(0) as u64;
        (before[2], took, parts + w.observer.done[&FrameId(3)].stats.handed_over)
    };
    let (before, steady, _) = run(1.0);
    assert!(steady < before + before / 10, "{steady} us after {before}");
    // Others draw parts of its second tile, or pieces of its first.
    let (before, late, parts) = run(1.5);
    assert!(parts > 0);
    assert!(10 * late < 13 * before, "{late} us after {before}");
}

#[test]
fn overlapping_frames_keep_the_tile_owners_of_the_first() {
    let mut w = world();
    workers(&mut w, 8);
    for frame in 0..4 {
        // One view, frame after frame.
        let work = Work { tile: Some(16), schedule: Schedule::Region, ..slab() };
        let quality = Quality { thickness: 1.0, ..Quality::before() };
        let mut job = job_with(0, work, quality);
        (job.frame, job.number) = (FrameId(frame), frame);
        w.add_frame(job);
    }
    w.finish();
    let sent = |frame| {
        w.observer.done[&FrameId(frame)].stats.workers.iter().map(|v| v.bricks_sent).sum::<u64>()
    };
    let sent: Vec<u64> = (0..4).map(sent).collect();
    // The times of the first three tiles are known when the second frame begins. Later frames know
    // enough to move some tiles.
    assert!(10 * sent[1] < sent[0], "{sent:?}");
}

#[test]
fn workers_get_shares_of_a_path_by_their_speed() {
    // Time of a frame times the sum of all speeds, in tiles of 16 pixels, of which a frame has up
    // to
    // 64. If speeds were not known it would be 7 % more than among equals.
    let run = |speeds: &[f64]| {
        let mut w = world();
        for speed in speeds {
            w.add_worker(WorkerProfile { time_factor: 0.5 / speed, ..typical() });
        }
        let work = Work { tile: Some(16), schedule: Schedule::Region, ..slab() };
        for frame in 0..80 {
            let quality = Quality { thickness: 1.0, ..Quality::before() };
            w.add_frame(job_with(frame, work, quality));
        }
        w.until(|w| w.observer.done.len() >= 8);
        let (from, done) = (w.now(), w.observer.done.len());
        // Over 16 frames it would vary by 6 %, by chance.
        w.until(|w| w.observer.done.len() >= 72);
        let each = (w.now() - from) as f64 / (w.observer.done.len() - done) as f64;
        w.finish();
        each * speeds.iter().sum::<f64>()
    };
    let healthy = run(&[1.0; 8]);
    for speeds in [
        [1.0, 1.0, 1.0, 0.1, 1.0, 1.0, 1.0, 1.0],
        [1.0, 0.3, 1.0, 0.3, 1.0, 0.3, 1.0, 1.0],
        [1.0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2],
    ] {
        let ratio = run(&speeds) / healthy;
        assert!(
            ratio <= 1.04,
            "{speeds:?}: {ratio:.3} times as long as equals of the same strength"
        );
    }
}

#[test]
fn bricks_follow_a_tile_to_its_new_owner() {
    let mut w = world();
    let gone = w.add_worker(typical());
    w.add_frame(job_by(0, Schedule::Region));
    w.until(|w| w.scheduler().is_idle());
    w.kill(gone);
    w.add_worker(typical());
    let mut again = job_by(0, Schedule::Region);
    again.frame = FrameId(1);
    w.add_frame(again);
    w.finish();
    let [first, second] = [0, 1].map(|f| &w.observer.done[&FrameId(f)].stats.workers[0]);
    assert!(second.bricks_sent > 0 && second.stalls < first.stalls / 2, "{first:?} {second:?}");
}

#[test]
fn memory_budget_makes_a_region_worker_evict_bricks_itself() {
    let mut w = world();
    let all: u64 = bricks().iter().map(|b| u64::from(b.bytes)).sum();
    w.add_worker(WorkerProfile { memory_budget_bytes: all / 3, ..typical() });
    w.add_worker(WorkerProfile { threads: 2, memory_budget_bytes: 1, ..typical() });
    for frame in 0..4 {
        w.add_frame(job_by(frame, Schedule::Region));
    }
    w.finish();
    let view = &w.scheduler().workers()[0];
    assert!(view.bytes_held <= all / 3, "{view:?}");
    assert_eq!(w.observer.done.len(), 4);
}

#[test]
fn broken_bricks_are_sent_again_and_no_others() {
    let mut w = world();
    w.add_worker(WorkerProfile {
        faults: Faults { broken_one_in: 5, ..Faults::default() },
        ..typical()
    });
    w.add_frame(job(0));
    w.finish();
    let stats = &w.observer.done[&FrameId(0)].stats;
    assert!(w.observer.done[&FrameId(0)].at < 10_000_000, "no lease had to wait for its deadline");
    let one = &stats.workers[0];
    assert_eq!(one.bricks_held, stats.bricks.needed);
    assert!(one.bricks_sent > one.bricks_held, "some went twice");
    assert!(one.bricks_sent < 2 * one.bricks_held);
}

#[test]
fn malformed_results_drop_their_worker_and_others_draw_its_tiles() {
    for schedule in BOTH {
        let mut w = world();
        workers(&mut w, 1);
        w.add_worker(WorkerProfile {
            faults: Faults { lie_one_in: 1, ..Faults::default() },
            ..typical()
        });
        w.add_frame(job_by(0, schedule));
        w.finish();
        assert_eq!(w.observer.audit.drops.len(), 1);
        assert!(w.observer.audit.drops[0].1.contains("plane"), "{}", w.observer.audit.drops[0].1);
        assert!(w.observer.done.contains_key(&FrameId(0)), "the other worker drew its tile");
    }
}

#[test]
fn leaving_worker_finishes_the_tasks_it_has_begun() {
    let mut w = world();
    workers(&mut w, 2);
    w.add_frame(job(0));
    w.until(|w| w.observer.audit.leases_given > 7);
    let now = w.now();
    w.schedule(now, Incident::Leave(WorkerId(1)));
    w.finish();
    let stats = &w.observer.done[&FrameId(0)].stats;
    assert!(stats.retries <= 1, "what it had not begun: {}", stats.retries);
    assert_eq!(w.observer.done[&FrameId(0)].stats.dropped_results, 0);
}

#[test]
fn memory_budget_of_a_slab_worker_holds_the_bricks_of_its_leases() {
    // One slab, so that all bricks are needed at once and fit into neither worker.
    let mut w = world();
    let all: u64 = bricks().iter().map(|b| u64::from(b.bytes)).sum();
    w.add_worker(WorkerProfile { memory_budget_bytes: all / 2, ..typical() });
    w.add_worker(WorkerProfile { threads: 2, memory_budget_bytes: all * 2 / 3, ..typical() });
    let work = Work { tile: Some(32), slabs: 1, ..slab() };
    for frame in 0..4 {
        w.add_frame(job_with(frame, work, Quality { thickness: 2.0, ..Quality::before() }));
    }
    w.finish();
    assert_eq!(w.scheduler().totals().over_budget, 0);
    let sent = |f: u64| w.observer.done[&FrameId(f)].stats.workers.iter().all(|s| s.bytes_sent > 0);
    assert!((0..4).all(sent), "bricks come and go");
    for (view, budget) in w.scheduler().workers().iter().zip([all / 2, all * 2 / 3]) {
        assert!(view.bytes_held <= budget);
    }
}
