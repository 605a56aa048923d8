//! Simulated clusters whose times can be worked out by hand.

use slabcast_common::brick::{BRICK_EDGE, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::{BrickId, FrameId, SceneId};
use slabcast_common::image::PixelEncoding;
use slabcast_common::image::{Background, FrameState, PixelFormat};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::{Rect, ShutMap};
use slabcast_common::quality::{Borders, Quality, Schedule, Work};
use slabcast_common::stats::FrameStats;
use slabcast_common::view::{Camera, CameraProjection, Projected, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::presets;
use slabcast_schedule::{FrameJob, Span, Spans, macrotile, slab_ranges};
use slabcast_sim::{
    self as sim, Cluster, Costs, LinearCost, Link, MessageCosts, NoObserver, Outcome, Unpredictable,
};
use slabcast_trace::{
    About, FrameTrace, Level, Packing, RegionLevel, RegionTile, SlabTrace, TileTrace, Trace,
    VERSION, view_sha256,
};
use std::collections::BTreeSet;
use std::sync::Arc;

const SIZE: [u32; 2] = [256, 200];
const BRICK_BYTES: u32 = 1000;

/// Frames of a solid cube and their trace: a pixel takes 10 ns to draw and two bytes each way. Half
/// of the picture is shut behind the first slab.
fn world(frames: usize) -> (Vec<FrameJob>, Trace) {
    let dims = [64; 3];
    let info = Volume::from_fn_u8("v", dims, |i, _, _| i as u8).info(Digest32([1; 32]));
    let transfer = presets::by_name("grey", &info.summary).expect("a known name");
    let quality = Quality::before();
    let grid = BrickGrid::new(dims);
    let bricks: Arc<[BrickInfo]> = (0..grid.len() as u32)
        .map(|id| {
            let lo = grid.corner(BrickId(id));
            let tight = TightBox { lo, hi: lo.map(|x| x + BRICK_EDGE - 1) };
            BrickInfo { id: BrickId(id), tight, voxels: 512, bytes: BRICK_BYTES }
        })
        .collect();
    let set = BrickSetKey(Digest32([2; 32]));
    let scene =
        SceneSpec { id: SceneId(1), volume: info, transfer, quality, crop: None, bricks: set };
    let scene = Arc::new(scene);
    let jobs: Vec<FrameJob> = (0..frames)
        .map(|i| {
            let camera = Camera {
                to_eye: [0.1 * i as f64, 0.3, 1.0].into(),
                up: [0.0, 1.0, 0.0].into(),
                target: [0.0; 3].into(),
                projection: CameraProjection::Ortho { height: 90.0 },
            };
            let lattice = &scene.volume.lattice;
            let view = View::new(lattice, &camera, SIZE, &quality).expect("drawable");
            let (frame, number) = (FrameId(i as u64 + 1), i as u64);
            // The new bricks of the cube's second view can be worked out for equal slabs only.
            let (schedule, borders) = (Schedule::Slab, Borders::Equal);
            let work = Work { schedule, borders, ..Work::default() };
            let (scene, bricks) = (scene.clone(), bricks.clone());
            FrameJob { frame, number, scene, bricks, view, work, finish: None, client: 0 }
        })
        .collect();
    let frames = jobs.iter().map(|job| frame(job, &quality)).collect();
    let about = About {
        volume: "v".into(),
        transfer: "grey".into(),
        simd: "none".into(),
        pixels_version: slabcast_common::PIXELS_VERSION,
        program: "0".into(),
        size: SIZE,
        slabs: 3,
        repeats: 1,
        pings: None,
        packing: Packing::default(),
    };
    (jobs, Trace { version: VERSION, about, frames })
}

fn frame(job: &FrameJob, quality: &Quality) -> FrameTrace {
    let projected: Vec<_> = job.bricks.iter().map(|b| job.view.project(&b.tight)).collect();
    let mut shut = ShutMap::open(Rect::from_size(SIZE));
    let mut slabs = Vec::new();
    for (n, range) in slab_ranges(&job.view, &projected, &|i| job.bricks[i].voxels, &job.work)
        .into_iter()
        .enumerate()
    {
        let rects: Vec<Rect> = projected
            .iter()
            .flatten()
            .filter(|p| p.sheets.overlaps(range) && !shut.all_shut(&p.rect))
            .map(|p| p.rect)
            .collect();
        let levels = [16, 32, 64, 128, 256].map(|edge| {
            let cut = macrotile::cut(SIZE, &rects, &shut, quality.cull, 0, Some(edge));
            let mut tiles: Vec<TileTrace> = cut
                .tiles
                .iter()
                .map(|t| TileTrace {
                    x: t.rect.x0 as u32,
                    y: t.rect.y0 as u32,
                    ns: 10 * t.rect.area() as u64,
                    lease_bytes: 2 * t.rect.area() as u32,
                    result_bytes: 2 * t.rect.area() as u32,
                })
                .collect();
            tiles.sort_by_key(|t| (t.y, t.x));
            Level { edge, tiles }
        });
        if n == 0 {
            (0..SIZE[0] as usize * 100).for_each(|i| shut.shut(i));
            shut.refresh();
        }
        let bits = (0..SIZE[0] as usize * SIZE[1] as usize).map(|i| shut.is_shut(i));
        let runs = SlabTrace::runs(bits);
        slabs.push(SlabTrace {
            first: range.first,
            end: range.end,
            shut: runs,
            levels: levels.into(),
        });
    }
    let rects: Vec<Rect> = projected.iter().flatten().map(|p| p.rect).collect();
    let regions = [32, 64, 128, 256].map(|edge| through(edge, &rects, &projected));
    FrameTrace {
        outlook_ns: 2_000,
        block_ns: 0,
        regions: regions.into(),
        view: view_sha256(&job.scene, &job.view).to_string(),
        setup_ns: 5_000,
        alone_ns: 300_000,
        alone_edge: 128,
        slabs,
    }
}

/// Tiles through all depths, at 20 ns a pixel, from the front half of the bricks over them.
fn through(edge: u32, rects: &[Rect], projected: &[Option<Projected>]) -> RegionLevel {
    let cut = macrotile::cut_through(SIZE, rects, (0, 0), Some(edge));
    let mut tiles: Vec<RegionTile> = cut
        .tiles
        .iter()
        .map(|t| {
            let over = |p: &Projected| !p.rect.intersect(&t.rect).is_empty() && p.sheets.first < 0;
            let touched = (0u32..).zip(projected).filter(|(_, p)| p.is_some_and(|p| over(&p)));
            RegionTile {
                x: t.rect.x0 as u32,
                y: t.rect.y0 as u32,
                ns: 20 * t.rect.area() as u64,
                result_bytes: 2 * t.rect.area() as u32,
                plain_bytes: 3 * t.rect.area() as u32,
                touched: touched.map(|(i, _)| i).collect(),
                // A block to the left, and one for all.
                opened: vec![t.rect.x0 as u32 / 128, 7],
                ..RegionTile::default()
            }
        })
        .collect();
    tiles.sort_by_key(|t| (t.y, t.x));
    RegionLevel { edge, tiles }
}

/// Jobs under another schedule.
fn under(schedule: Schedule, jobs: &[FrameJob]) -> Vec<FrameJob> {
    let work = |job: &FrameJob| Work { schedule, ..job.work };
    jobs.iter().map(|job| FrameJob { work: work(job), ..job.clone() }).collect()
}

fn cluster(workers: u32) -> Cluster {
    Cluster {
        workers,
        threads: 1,
        link: Link::UNLIMITED,
        costs: Costs::default(),
        shared_cores: None,
        frames_in_flight: 1,
        stretch: 1.0,
        mixed: false,
    }
}

fn run(jobs: &[FrameJob], trace: &Trace, cluster: &Cluster) -> Outcome {
    sim::run(jobs, trace, cluster, &mut NoObserver).expect("it can be predicted").0
}

#[test]
fn one_worker_without_costs_takes_the_sum_of_its_tiles() {
    let (jobs, trace) = world(3);
    let outcome = run(&jobs, &trace, &cluster(1));
    for f in &outcome.frames {
        assert_eq!(f.done - f.began, f.render);
        assert_eq!(f.delivered, f.done);
        // Each pixel of a drawn tile costs 10 ns and 2 bytes; a frame's tables 5 us.
        let pixels = (f.render - 5_000) / 10;
        assert!(f.up >= 2 * pixels && f.up < 2 * pixels + 64 * 200, "{f:?}");
    }
    // Bricks behind the shut half are never sent.
    let sent = outcome.frames[0].bricks / u64::from(BRICK_BYTES);
    assert!((257..512).contains(&sent), "{sent} of 512 bricks");
    let later = outcome.frames[1].bricks / u64::from(BRICK_BYTES);
    assert!(later < 10, "they are held from then on, but {later} came with the new view");
}

#[test]
fn cost_of_the_first_frame_delays_no_later_one() {
    let (jobs, trace) = world(3);
    let times = |first_brick_ns| {
        let costs = Costs { first_brick_ns, frame_brick_ns: 10.0, ..Costs::default() };
        let outcome = run(&jobs, &trace, &Cluster { costs, ..cluster(2) });
        outcome.frames.iter().map(|f| f.done - f.began).collect::<Vec<_>>()
    };
    let (as_others, dear) = (times(10.0), times(1010.0));
    assert_eq!(dear[0], as_others[0] + 1000 * 512, "the first has 512 bricks");
    assert_eq!(dear[1..], as_others[1..]);
}

#[test]
fn speedup_never_exceeds_the_number_of_workers() {
    let (jobs, trace) = world(3);
    let mut before = u64::MAX;
    for workers in [1, 2, 4, 8] {
        let outcome = run(&jobs, &trace, &cluster(workers));
        let f = outcome.frames[1];
        let took = f.done - f.began;
        assert!(took * u64::from(workers) >= f.render, "{workers}: {f:?}");
        assert!(took < before, "{workers} workers: {took} ns, {before} with half as many");
        before = took;
    }
}

#[test]
fn all_workers_share_the_masters_link() {
    let (jobs, trace) = world(2);
    let at = |workers, bytes_per_s| {
        let link = Link { bytes_per_s: Some(bytes_per_s), latency_ns: 20_000 };
        run(&jobs, &trace, &Cluster { link, ..cluster(workers) }).frames[0]
    };
    // 384 kB of bricks for each worker at 10 MB/s: 38 ms each, one after another.
    let (two, four) = (at(2, 1e7), at(4, 1e7));
    assert_eq!([two.bricks, four.bricks], [768_000, 1_536_000]);
    let ms = |f: &sim::FrameOutcome| (f.done - f.began) as f64 / 1e6;
    assert!((77.0..120.0).contains(&ms(&two)), "{two:?}");
    assert!((154.0..220.0).contains(&ms(&four)), "{four:?}");
    assert!(ms(&at(4, 1e8)) < 0.2 * ms(&four));
}

#[test]
fn costs_of_the_master_show_and_overlap_with_later_frames() {
    let (jobs, trace) = world(4);
    let free = run(&jobs, &trace, &cluster(4));
    let master = MessageCosts {
        receive: LinearCost { fixed_ns: 30_000.0, per_unit_ns: 0.0 },
        ..MessageCosts::default()
    };
    let costs = Costs { finish_pixel_ns: 20.0, master, ..Costs::default() };
    let one = run(&jobs, &trace, &Cluster { costs, ..cluster(4) });
    let three = run(&jobs, &trace, &Cluster { costs, frames_in_flight: 3, ..cluster(4) });
    assert!(one.frame_ms() > free.frame_ms());
    assert_eq!(free.later_work(), [0, 0]);
    // Three later pictures are finished, and each tile's result is received.
    let later: u64 = one.frames[1..].iter().map(|f| f.leases).sum();
    assert!(one.later_work()[0] >= 3 * 20 * 256 * 200 + later * 30_000);
    // 51,200 pixels at 20 ns are finished while the next frame is drawn.
    assert!(one.interval_ms() > one.frame_ms() + 1.0, "{} {}", one.interval_ms(), one.frame_ms());
    assert!(three.interval_ms() < one.interval_ms() - 0.5);
    // On one machine with two cores there is less to overlap with.
    let rehearsal = run(
        &jobs,
        &trace,
        &Cluster { costs, frames_in_flight: 3, shared_cores: Some(1), ..cluster(4) },
    );
    assert!(rehearsal.interval_ms() > three.interval_ms());
}

/// A worker of one thread has one core: while it sends it does not draw.
#[test]
fn sending_a_result_takes_time_from_the_next_tile() {
    let (jobs, trace) = world(3);
    let jobs = under(Schedule::Region, &jobs);
    let last = |ns: f64| {
        let worker = MessageCosts {
            send: LinearCost { fixed_ns: ns, per_unit_ns: 0.0 },
            ..MessageCosts::default()
        };
        let costs = Costs { worker, ..Costs::default() };
        run(&jobs, &trace, &Cluster { costs, ..cluster(1) }).frames[2]
    };
    let (free, dear) = (last(0.0), last(30_000.0));
    let took = |f: &sim::FrameOutcome| f.done - f.began;
    assert!(dear.leases > 3);
    assert!(took(&dear) >= took(&free) + 30_000 * dear.leases, "{free:?} {dear:?}");
}

#[test]
fn results_are_packed_only_on_a_slow_link() {
    let (jobs, trace) = world(6);
    let finish =
        PixelEncoding { format: PixelFormat::Rgb8, background: Background::Colour([0.0; 3]) };
    let jobs = under(Schedule::Region, &jobs)
        .into_iter()
        .map(|job| FrameJob { finish: Some(finish), ..job })
        .collect::<Vec<_>>();
    let at = |bytes_per_s| {
        let link = Link { bytes_per_s, latency_ns: 20_000 };
        let costs = Costs { pack_byte_ns: 1.0, ..Costs::default() };
        run(&jobs, &trace, &Cluster { link, costs, ..cluster(2) })
    };
    // Two bytes a pixel if they are packed, three if not.
    let a_pixel = |f: &sim::FrameOutcome| {
        let pixels = (f.render - 2 * 7_000) as f64 / 20.0;
        f.up as f64 / pixels
    };
    let (fast, slow) = (at(Some(1e9)), at(Some(1e7)));
    assert!(a_pixel(&fast.frames[0]) < 2.5, "the link is not known yet: {fast:?}");
    assert!(a_pixel(&fast.frames[5]) > 2.9, "{fast:?}");
    assert!(a_pixel(&slow.frames[5]) < 2.5, "{slow:?}");
}

/// Work on a picture, where all share cores, delays short work by a turn and not by all of it.
#[test]
fn work_on_pictures_hardly_delays_messages() {
    let (jobs, trace) = world(40);
    let jobs = under(Schedule::Region, &jobs);
    let each_ms = |pixel: f64| {
        let toll = MessageCosts {
            wake_ns: 2_000.0,
            receive: LinearCost { fixed_ns: 500.0, per_unit_ns: 0.0 },
            ..MessageCosts::default()
        };
        let costs = Costs {
            master: toll,
            worker: toll,
            mark_pixel_ns: pixel,
            deliver_pixel_ns: pixel,
            client_pixel_ns: pixel,
            ..Costs::default()
        };
        let cluster = Cluster { shared_cores: Some(2), frames_in_flight: 4, costs, ..cluster(2) };
        run(&jobs, &trace, &cluster).interval_ms()
    };
    // A frame takes two workers half a millisecond, and its picture three times 0.2 of two cores.
    let [free, dear] = [0.0, 4.0].map(each_ms);
    assert!(dear < 1.1 * free, "{free} ms a frame without, {dear} with");
}

#[test]
fn simulation_is_deterministic() {
    let (jobs, trace) = world(3);
    let costs = Costs {
        master: MessageCosts {
            wake_ns: 15_000.0,
            call_ns: 5_000.0,
            send: LinearCost { fixed_ns: 900.0, per_unit_ns: 0.7 },
            receive: LinearCost { fixed_ns: 800.0, per_unit_ns: 0.4 },
            bricks: LinearCost { fixed_ns: 700.0, per_unit_ns: 0.3 },
        },
        worker: MessageCosts {
            send: LinearCost { fixed_ns: 1_000.0, per_unit_ns: 1.1 },
            ..MessageCosts::default()
        },
        result: LinearCost { fixed_ns: 0.0, per_unit_ns: 1.3 },
        slab_brick_ns: 30.0,
        ..Costs::default()
    };
    let link = Link { bytes_per_s: Some(1.2e8), latency_ns: 50_000 };
    let c = Cluster { costs, link, threads: 2, frames_in_flight: 3, ..cluster(7) };
    assert_eq!(run(&jobs, &trace, &c), run(&jobs, &trace, &c));
}

#[test]
fn unrecorded_tile_is_named() {
    let (jobs, mut trace) = world(1);
    trace.frames[0].slabs[1].levels.retain(|l| l.edge > 64);
    let c = cluster(30);
    match sim::run(&jobs, &trace, &c, &mut NoObserver) {
        Err(Unpredictable::Tile { frame: 0, first, .. }) => {
            assert_eq!(first, trace.frames[0].slabs[1].first);
        }
        other => panic!("{other:?}"),
    }
    let (two, _) = world(2);
    let none = sim::run(&two, &trace, &c, &mut NoObserver);
    assert_eq!(none.unwrap_err(), Unpredictable::Frames { have: 1, need: 2 });
}

#[test]
fn regions_have_no_barrier_and_get_the_bricks_they_ask_for() {
    let (slab, trace) = world(5);
    let region = under(Schedule::Region, &slab);
    let alone = run(&region, &trace, &cluster(1));
    for f in &alone.frames[1..] {
        // Each pixel of a drawn tile costs 20 ns; a frame's tables and outlook 7 us.
        assert_eq!((f.render - 7_000) % 20, 0, "{f:?}");
        assert!(f.done - f.began >= f.render, "{f:?}");
    }
    // The front half of the bricks, and each of them once.
    let sent = alone.frames.iter().map(|f| f.bricks).sum::<u64>() / u64::from(BRICK_BYTES);
    assert!((100..512).contains(&sent), "{sent} bricks");
    // Several workers get what their tiles need, not all that the frame needs.
    let eight = run(&region, &trace, &cluster(8));
    let all = eight.frames[0].bricks / u64::from(BRICK_BYTES);
    assert!(all < 8 * sent && all >= sent, "{all} bricks for eight, {sent} for one");
    assert_eq!(eight, run(&region, &trace, &cluster(8)));
    // Several frames in the making leave nobody waiting at the end of one.
    let (slab, trace) = world(40);
    let mut region = under(Schedule::Region, &slab);
    // All tiles have one size: here a tile's time is its area, whatever lies in it.
    region.iter_mut().for_each(|job| job.work.tile = Some(32));
    let ms = |in_flight| {
        let c = Cluster { frames_in_flight: in_flight, ..cluster(8) };
        run(&region, &trace, &c).steady_interval_ms(in_flight)
    };
    let each = [1, 2, 4].map(ms);
    assert!(each[1] < each[0] && each[2] < each[0], "{each:?}");
}

#[test]
fn region_stalls_at_each_missing_brick_unless_it_was_prefetched() {
    let (slab, mut trace) = world(12);
    let region = under(Schedule::Region, &slab);
    let link = Link { bytes_per_s: Some(1e8), latency_ns: 100_000 };
    let ran = |trace: &Trace| {
        let c = Cluster { link, ..cluster(4) };
        let outcome = run(&region, trace, &c);
        let drawn: u64 = outcome.frames[1..].iter().map(|f| f.render).sum();
        let took: u64 = outcome.frames[1..].iter().map(|f| f.done - f.began).sum();
        (drawn, took, outcome)
    };
    let (drawn, _, _) = ran(&trace);
    let each = |trace: &mut Trace, what: &dyn Fn(&mut RegionTile)| {
        let levels = trace.frames.iter_mut().flat_map(|f| &mut f.regions);
        levels.filter(|l| l.edge <= 64).flat_map(|l| &mut l.tiles).for_each(what);
    };
    // In the order of the list, a brick after the other.
    each(&mut trace, &|t| {
        let n = t.touched.len().max(1) as u16;
        t.needed = (0..t.touched.len() as u16).map(|i| 1000 / n * i).collect();
    });
    let (stopping, long, stopped) = ran(&trace);
    assert_eq!(stopping, drawn, "stopping is no work");
    assert_eq!(stopped, ran(&trace).2);
    for level in trace.frames.iter_mut().flat_map(|f| &mut f.regions) {
        level.tiles.iter_mut().for_each(|t| t.expected = t.touched.clone());
    }
    let (expecting, short, expected) = ran(&trace);
    assert_eq!(expecting, drawn);
    assert!(short < long, "{short} ns for {long}");
    let waited = [&expected, &stopped].map(|o| o.thread_time.bricks);
    assert!(20 * waited[0] < 19 * waited[1], "{waited:?}");
    let sent = |o: &Outcome| o.frames.iter().map(|f| f.bricks).sum::<u64>();
    assert!(sent(&expected) <= sent(&stopped) * 5 / 4, "only where it draws");
}

#[test]
fn lanes_render_overlapping_frames_in_turn_where_tiles_are_few() {
    let (slab, trace) = world(24);
    let mut region = under(Schedule::Region, &slab);
    region.iter_mut().for_each(|job| job.work.tile = Some(64));
    let drew = |in_flight, bytes_per_s| {
        let mut heard = Listener::default();
        let link = Link { bytes_per_s, latency_ns: 50_000 };
        let c = Cluster { frames_in_flight: in_flight, link, ..cluster(8) };
        sim::run(&region, &trace, &c, &mut heard).expect("it can be predicted");
        let busy = |s: &FrameStats| s.workers.iter().filter(|w| w.render_ms > 0.0).count();
        heard.0[12..].iter().map(|(stats, _)| busy(stats)).collect::<Vec<_>>()
    };
    let lanes = |drew: &[usize]| drew.iter().filter(|n| **n <= 5).count();
    let (sole, four) = (drew(1, None), drew(4, None));
    assert_eq!(lanes(&sole), 0, "all workers render a sole frame: {sole:?}");
    assert!(lanes(&four) > four.len() / 2, "a lane renders an overlapping one: {four:?}");
}

#[test]
fn active_set_leaves_superfluous_workers_in_reserve() {
    let (slab, trace) = world(120);
    let mut region = under(Schedule::Region, &slab);
    region.iter_mut().for_each(|job| job.work.tile = Some(32));
    // A message costs the master 30 us, and a turn by six degrees brings bricks to all workers.
    let master = MessageCosts {
        send: LinearCost { fixed_ns: 15_000.0, per_unit_ns: 0.0 },
        receive: LinearCost { fixed_ns: 15_000.0, per_unit_ns: 0.0 },
        ..MessageCosts::default()
    };
    let costs = Costs { master, ..Costs::default() };
    let drew = |workers, bytes_per_s| {
        let mut heard = Listener::default();
        let link = Link { bytes_per_s: Some(bytes_per_s), latency_ns: 50_000 };
        let c = Cluster { costs, link, frames_in_flight: 4, ..cluster(workers) };
        sim::run(&region, &trace, &c, &mut heard).expect("it can be predicted");
        let drew = |some: &[(FrameStats, Vec<Span>)]| {
            let stats = some.iter().map(|(stats, _)| stats);
            let drew = stats.flat_map(|s| s.workers.iter().filter(|w| w.render_ms > 0.0));
            drew.map(|w| w.id.clone()).collect::<BTreeSet<_>>().len()
        };
        let ends = |i: usize| heard.0[i].1.iter().map(|s| s.end).max().expect("a span");
        (drew(&heard.0[..6]), drew(&heard.0[100..]), ends(119) - ends(100))
    };
    let (all, few) = (drew(32, 2e7), drew(8, 2e7));
    assert!(all.0 <= 16 && all.1 <= 8, "{all:?} of 32 draw at first and at last, {few:?} of 8");
    assert!(all.2 < few.2 * 6 / 5, "{all:?} of 32, {few:?} of 8");
}

/// The second frame of a path ends soon after the first, which waited for all bricks. Judged by
/// itself it shows threads that draw all the time, and all workers would be activated.
#[test]
fn active_set_judges_a_first_frame_together_with_the_second() {
    let (slab, trace) = world(24);
    let mut region = under(Schedule::Region, &slab);
    region.iter_mut().for_each(|job| job.work.tile = Some(32));
    for workers in [32, 64] {
        let mut heard = Listener::default();
        let link = Link { bytes_per_s: Some(1e9), latency_ns: 50_000 };
        let c = Cluster { link, frames_in_flight: 4, ..cluster(workers) };
        sim::run(&region, &trace, &c, &mut heard).expect("it can be predicted");
        let frames = heard.0.iter().map(|(stats, _)| &stats.workers);
        let drew: Vec<usize> =
            frames.map(|some| some.iter().filter(|w| w.render_ms > 0.0).count()).collect();
        assert!(drew[..8].iter().all(|n| *n <= 16), "of {workers}: {drew:?}");
    }
}

#[test]
fn fewer_frames_overlap_while_bricks_fill_the_link() {
    let (slab, trace) = world(12);
    let region = under(Schedule::Region, &slab);
    let most = |bytes_per_s| {
        let mut heard = Listener::default();
        let link = Link { bytes_per_s, latency_ns: 50_000 };
        let c = Cluster { frames_in_flight: 4, link, ..cluster(8) };
        sim::run(&region, &trace, &c, &mut heard).expect("it can be predicted");
        let spans = heard.0.iter().flat_map(|(_, spans)| spans);
        let made: Vec<_> = spans.filter(|s| s.category == "frame").collect();
        let beside = |at| made.iter().filter(|s| s.start <= at && at < s.end).count();
        // The first begin before the link is known; late ones find their bricks there.
        let beside = made[4..].iter().map(|s| beside(s.start));
        beside.clone().min().zip(beside.max())
    };
    assert_eq!(most(None).map(|(_, most)| most), Some(4));
    for bytes_per_s in [1e5, 3e5, 1e6] {
        let (least, _) = most(Some(bytes_per_s)).expect("frames");
        assert!(least <= 2, "{least} frames at {bytes_per_s} bytes a second");
    }
}

#[test]
fn thread_time_adds_up_to_the_whole() {
    let (slab, trace) = world(9);
    let region = under(Schedule::Region, &slab);
    let toll = MessageCosts {
        wake_ns: 5_000.0,
        call_ns: 500.0,
        send: LinearCost { fixed_ns: 300.0, per_unit_ns: 0.1 },
        receive: LinearCost { fixed_ns: 300.0, per_unit_ns: 0.1 },
        bricks: LinearCost { fixed_ns: 300.0, per_unit_ns: 0.1 },
    };
    let costs = Costs {
        master: toll,
        worker: toll,
        result: LinearCost { fixed_ns: 2_000.0, per_unit_ns: 0.0 },
        ..Costs::default()
    };
    let link = Link { bytes_per_s: Some(1.2e8), latency_ns: 50_000 };
    for (workers, threads, in_flight) in [(1, 1, 1), (3, 2, 4), (8, 1, 4)] {
        let c = Cluster { costs, link, threads, frames_in_flight: in_flight, ..cluster(workers) };
        let outcome = run(&region, &trace, &c);
        let frames = sim::Outcome::steady_frames(9, in_flight);
        let ms =
            outcome.steady_interval_ms(in_flight) * frames as f64 * f64::from(workers * threads);
        let all = outcome.thread_time.total() as f64 / 1e6;
        assert!((all / ms - 1.0).abs() < 0.02, "{workers}x{threads}: {all} of {ms}");
        let drawn =
            outcome.thread_time.tiles + outcome.thread_time.tables + outcome.thread_time.blocks;
        assert!(drawn > 0 && outcome.thread_time.bricks > 0, "{:?}", outcome.thread_time);
    }
}

#[test]
fn worker_looks_at_a_block_once_a_frame() {
    let (slab, mut trace) = world(3);
    let region = under(Schedule::Region, &slab);
    let render = |trace: &Trace, n: u32| {
        let outcome = run(&region, trace, &cluster(n));
        outcome.frames.iter().map(|f| f.render).collect::<Vec<_>>()
    };
    let drawn = [1, 4].map(|n| render(&trace, n));
    for frame in &mut trace.frames {
        frame.block_ns = 100;
    }
    let looked = [1, 4].map(|n| render(&trace, n));
    let more = |i: usize| looked[i].iter().zip(&drawn[i]).map(|(l, d)| l - d).collect::<Vec<_>>();
    let columns = SIZE[0].div_ceil(128) as u64;
    assert!(more(0).iter().all(|ns| *ns == 100 * (columns + 1)), "{:?}", more(0));
    // Each of four looks at some of them.
    let (least, most) = (100 * (columns + 4), 400 * (columns + 1));
    assert!(more(1).iter().all(|ns| (least..=most).contains(ns)), "{:?}", more(1));
}

/// Keeps statistics and timelines of frames.
#[derive(Default)]
struct Listener(Vec<(FrameStats, Vec<Span>)>);

impl sim::Observer for Listener {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, spans: Spans) {
        self.0.push((stats, spans.to_vec()));
    }
}

#[test]
fn mixed_queue_begins_with_whole_tiles_and_goes_on_with_quarters() {
    let (mut jobs, trace) = world(2);
    for job in &mut jobs {
        job.work.tile = Some(64);
    }
    let mut heard = Listener::default();
    let mixed = Cluster { mixed: true, ..cluster(4) };
    sim::run(&jobs, &trace, &mixed, &mut heard).expect("it can be predicted");
    assert_eq!(heard.0.len(), 2);
    for (stats, spans) in &heard.0 {
        for slab in &stats.slabs {
            let edges: Vec<u32> = slab.tiles.iter().map(|t| t.size).collect();
            assert_eq!(edges[..4], [64; 4], "a whole tile for each thread");
            assert!(edges.len() > 4 && edges[4..].iter().all(|e| *e == 32), "{edges:?}");
        }
        let tiles: usize = stats.slabs.iter().map(|s| s.tiles.len()).sum();
        assert_eq!(spans.iter().filter(|s| s.category == "tile").count(), tiles);
    }
}
