//! Requests, paths, jobs, statistics.

use super::scene::{info, number, quality, size, transfer, triple};
use proptest::collection::vec;
use proptest::prelude::*;
use slabcast_common::ids::WorkerId;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::{LevelChoice, LevelStats};
use slabcast_common::quality::{Borders, Keep, Schedule, Sums, Work};
use slabcast_common::stats::*;
use slabcast_common::volume::{Digest32, SampleKind, ValueCore, ValueSummary, VolumeInfo};
use slabcast_proto::model;
use slabcast_scene::path::{
    Axis, Crop, CropUnit, Easing, Fit, FlyThrough, Key, KeyFrames, Orientation, PathView,
    ProjectionKind, Side, Turntable, ViewPath,
};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use std::time::Duration;

fn axis() -> impl Strategy<Value = Axis> {
    (0usize..3, any::<bool>()).prop_map(|(index, negative)| Axis { index, negative })
}

fn projection() -> impl Strategy<Value = ProjectionKind> {
    prop_oneof![Just(ProjectionKind::Ortho), Just(ProjectionKind::Persp)]
}

pub fn format() -> impl Strategy<Value = PixelFormat> {
    prop_oneof![
        Just(PixelFormat::Rgb8),
        Just(PixelFormat::Rgba8),
        Just(PixelFormat::Rgba16),
        Just(PixelFormat::Rgba32F)
    ]
}

/// Keys that pass their own check: whole ones, each of its kind.
fn keyframes() -> impl Strategy<Value = KeyFrames> {
    let point = || prop::option::of(triple());
    let side = prop::sample::select(Side::NAMES.map(|(_, side)| side).to_vec());
    let place = prop_oneof![
        side.prop_map(|side| Key { view: Some(side), ..Key::default() }),
        (number(), number()).prop_map(|(a, e)| Key {
            azimuth: Some(a),
            elevation: Some(e),
            ..Key::default()
        }),
        (triple(), point()).prop_map(|(eye, up)| Key { eye: Some(eye), up, ..Key::default() }),
    ];
    let tf = prop_oneof![
        Just(None),
        "[a-z]{1,9}".prop_map(|n| Some(TransferChoice::Name(n))),
        transfer().prop_map(|t| Some(TransferChoice::Function(Box::new(t)))),
    ];
    let key = (place, point(), number(), tf);
    let axes = || prop::option::of(axis());
    (vec(key, 1..5), projection(), any::<bool>(), any::<bool>(), axes(), axes()).prop_map(
        |(keys, projection, timed, smooth, up, front)| {
            let keys = keys.into_iter().enumerate().map(|(i, (key, target, x, tf))| Key {
                at: timed.then_some(i as f64 * 1.5),
                target,
                projection,
                height: (projection == ProjectionKind::Ortho).then_some(x),
                fov: (projection == ProjectionKind::Persp).then_some(x),
                tf,
                ..key
            });
            let easing = if smooth { Easing::Smooth } else { Easing::Linear };
            KeyFrames { frames: 9, easing, up, front, keys: keys.collect() }
        },
    )
}

fn flythrough() -> impl Strategy<Value = FlyThrough> {
    let eyes = vec(triple(), 3..6)
        .prop_filter("points apart", |p| (0..p.len()).all(|i| p[i] != p[(i + 1) % p.len()]));
    let point = || prop::option::of(triple().prop_filter("a direction", |p| *p != [0.0; 3]));
    (1u32..=100_000, eyes, point(), point(), prop::option::of(0.01..179.0f64), any::<bool>())
        .prop_map(|(frames, eyes, target, up, fov, closed)| FlyThrough {
            frames,
            eyes,
            target,
            up,
            fov,
            closed,
        })
}

fn crop() -> impl Strategy<Value = Crop> {
    let axis = || {
        (prop::option::of(-9.0..0.0f64), prop::option::of(0.5..9.0f64)).prop_map(|(a, b)| [a, b])
    };
    (axis(), axis(), axis(), any::<bool>()).prop_map(|(x, y, z, unit)| Crop {
        unit: if unit { CropUnit::Unit } else { CropUnit::World },
        x,
        y,
        z,
    })
}

pub fn path_request() -> impl Strategy<Value = PathRequest> {
    let view = (triple(), triple(), triple(), projection(), prop::option::of(number())).prop_map(
        |(eye, target, up, projection, x)| PathView {
            eye,
            target,
            up,
            projection,
            height: x,
            fov: x,
        },
    );
    let turntable = (
        (number(), number(), 1u32..=100_000, number()),
        (prop::option::of(triple()), prop::option::of(number()), projection(), number()),
        (prop::option::of(axis()), prop::option::of(axis())),
    )
        .prop_map(
            |((start, step, frames, elevation), (target, height, projection, fov), (up, front))| {
                Turntable {
                    start,
                    step,
                    frames,
                    elevation,
                    target,
                    height,
                    projection,
                    fov,
                    up,
                    front,
                }
            },
        );
    let path = (
        size(),
        prop_oneof![
            vec(view, 1..5).prop_map(|views| ViewPath::from_views([1, 1], views)),
            turntable.prop_map(|t| ViewPath::from_turntable([1, 1], t)),
            keyframes().prop_map(|k| {
                ViewPath { keyframes: Some(k), ..ViewPath::from_views([1, 1], vec![]) }
            }),
            flythrough().prop_map(|f| {
                ViewPath { flythrough: Some(f), ..ViewPath::from_views([1, 1], vec![]) }
            }),
        ],
        prop::option::of(crop()),
        any::<bool>(),
        any::<bool>(),
    )
        .prop_map(|(size, path, crop, range, visible)| {
            let fitted = path.turntable.is_some() || path.keyframes.is_some();
            let fit = if visible && fitted { Fit::Visible } else { Fit::Volume };
            let last = path.frames() as u32 - 1;
            let range = range.then_some([last / 3, last]);
            ViewPath { size, crop, range, fit, ..path }
        });
    let transfer = prop_oneof![
        "[a-z-]{1,20}".prop_map(TransferChoice::Name),
        transfer().prop_map(|t| TransferChoice::Function(Box::new(t)))
    ];
    let work = (
        1u32..=1000,
        0.1..1000.0f64,
        prop::option::of((4u32..=8).prop_map(|p| 1 << p)),
        prop_oneof![Just(Schedule::Auto), Just(Schedule::Slab)],
        any::<[bool; 5]>(),
    )
        .prop_map(|(slabs, tiles_per_worker, tile, schedule, flags)| {
            let [empty, normals, gradients, equal, estimate] = flags;
            Work {
                slabs,
                tiles_per_worker,
                tile,
                schedule,
                keep: Keep { empty, normals, gradients },
                borders: if equal { Borders::Equal } else { Borders::Data },
                estimate,
            }
        });
    let background = prop_oneof![
        Just(Background::Transparent),
        [0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0].prop_map(Background::Colour)
    ];
    let sums = prop_oneof![Just(Sums::Auto), Just(Sums::I32), Just(Sums::F32)];
    (
        (
            ("[A-Za-z0-9-]{1,60}", volume_choice().boxed(), level().boxed()),
            path,
            transfer,
            quality(sums),
        ),
        (work, format(), background, any::<[bool; 2]>()),
    )
        .prop_map(
            |(
                ((client_key, volume, level), path, transfer, quality),
                (work, format, background, [trace, hash]),
            )| {
                PathRequest {
                    client_key,
                    volume,
                    level,
                    path,
                    transfer,
                    quality,
                    work,
                    format,
                    background,
                    want_trace: trace,
                    want_hash: hash,
                }
            },
        )
}

fn level() -> impl Strategy<Value = LevelChoice> {
    prop_oneof![Just(LevelChoice::Auto), (0u32..=63).prop_map(LevelChoice::At)]
}

fn volume_choice() -> impl Strategy<Value = VolumeChoice> {
    prop_oneof![
        Just(VolumeChoice::Default),
        "[a-z0-9._-]{1,40}".prop_map(VolumeChoice::Name),
        any::<[u8; 32]>().prop_map(|bytes| VolumeChoice::Digest(Digest32(bytes))),
    ]
}

fn state() -> impl Strategy<Value = model::JobState> {
    use model::JobState::*;
    prop_oneof![
        Just(Queued),
        Just(Preparing),
        Just(WaitingForWorkers),
        Just(Running),
        Just(Done),
        Just(Failed),
        Just(Cancelled)
    ]
}

pub fn notice() -> impl Strategy<Value = model::JobNotice> {
    (state(), any::<[u64; 3]>(), any::<u32>(), "\\PC{0,50}").prop_map(
        |(state, [frames_done, frames_failed, frames_total], render_threads, message)| {
            model::JobNotice {
                state,
                frames_done,
                frames_failed,
                frames_total,
                render_threads,
                message,
            }
        },
    )
}

/// Times in milliseconds since 1970, from the year 0 to 9999; 0 is none.
fn time() -> impl Strategy<Value = i64> {
    -62_135_596_800_000i64..253_402_300_800_000
}

pub fn job() -> impl Strategy<Value = model::Job> {
    (("job-[0-9]{1,9}", "[a-z]{1,9}", "\\PC{0,50}"), notice(), size(), format(), [time(), time()])
        .prop_map(|((job_id, client_key, message), n, size, format, times)| model::Job {
            job_id,
            client_key,
            state: n.state,
            message,
            frames_done: n.frames_done,
            frames_failed: n.frames_failed,
            frames_total: n.frames_total,
            size,
            format,
            submitted_unix_ms: times[0],
            finished_unix_ms: times[1],
            volume: Some((Digest32([n.frames_done as u8; 32]), "head.nii.gz".into())),
        })
}

pub fn volume() -> impl Strategy<Value = model::VolumeDescription> {
    (info(), axis(), 1usize..3, any::<(bool, u32, u32)>()).prop_map(
        |(info, up, turn, (a, p, q))| {
            let front = Axis { index: (up.index + turn) % 3, negative: a };
            let core = (p % 2 == 0).then(|| ValueCore {
                min_code: f64::from(q),
                max_code: f64::from(q) + 1.5,
                histogram: vec![u64::from(p); 256],
            });
            let summary = ValueSummary { anatomical: a, core, ..info.summary };
            let info = VolumeInfo { summary, ..info };
            model::VolumeDescription {
                name: "head.nii.gz".into(),
                file_type: "int16".into(),
                anatomical: a,
                info,
                orientation: Orientation { up, front },
                pixels_version: p,
                protocol_version: q,
                now_unix_ms: i64::from(p) * 1_000_003,
            }
        },
    )
}

pub fn upload() -> impl Strategy<Value = model::UploadPart> {
    let begin = ("[a-z0-9_-]{1,30}", volume()).prop_map(|(name, v)| {
        model::UploadPart::Begin(Box::new(model::VolumeHeader {
            name,
            file_type: v.file_type,
            info: v.info,
            orientation: v.orientation,
        }))
    });
    let chunk = (any::<[u8; 32]>(), any::<u64>(), vec(any::<u8>(), 0..99));
    let chunk = chunk.prop_map(|(digest, offset, data)| model::UploadPart::Chunk {
        digest: Digest32(digest),
        offset,
        data: data.into(),
    });
    prop_oneof![begin, chunk]
}

pub fn volume_list() -> impl Strategy<Value = model::VolumeList> {
    let read = proptest::option::of((any::<[u8; 32]>(), any::<[u32; 3]>()))
        .prop_map(|read| read.map(|(digest, dims)| (Digest32(digest), dims, SampleKind::U16)));
    let origin = prop_oneof![
        Just(model::VolumeOrigin::Given),
        Just(model::VolumeOrigin::Folder),
        Just(model::VolumeOrigin::Upload)
    ];
    let entry = ("\\PC{0,40}", read, any::<u64>(), origin, any::<bool>(), "\\PC{0,50}");
    let entry = entry.prop_map(|(name, read, bytes, origin, in_memory, problem)| {
        model::VolumeEntry { name, read, bytes, origin, in_memory, problem }
    });
    (vec(entry, 0..4), any::<[u32; 2]>(), time()).prop_map(|(volumes, [p, q], now_unix_ms)| {
        model::VolumeList { volumes, pixels_version: p, protocol_version: q, now_unix_ms }
    })
}

pub fn worker() -> impl Strategy<Value = model::Worker> {
    ("[a-z]{1,9}", any::<[u64; 7]>(), any::<[u32; 2]>()).prop_map(|(name, n, m)| model::Worker {
        id: WorkerId(n[0]),
        name,
        address: "10.0.0.7:50000".into(),
        threads: m[0],
        simd: "avx2".into(),
        memory_budget_bytes: n[1],
        held_bytes: n[2],
        held_bricks: n[3],
        tasks_lent: m[1],
        tasks_done: n[4],
        silent: Duration::from_nanos(n[5]),
        connected: Duration::from_nanos(n[6]),
        in_reserve: m[0] % 2 == 1,
        damaged_messages: m[0].into(),
        round_trip: (m[0] % 3 > 0).then(|| Duration::from_nanos(n[5])),
        last_error: (m[0] % 5 > 0).then(|| model::WorkerError {
            at_unix_ms: i64::from(m[1]),
            reason: "tile failed: out of memory".into(),
        }),
    })
}

fn worker_stats() -> impl Strategy<Value = WorkerStats> {
    ("[a-z0-9:]{1,30}", vec(number(), 6), any::<[u64; 5]>()).prop_map(|(id, x, n)| WorkerStats {
        id,
        render_ms: x[0],
        distribute_ms: x[1],
        p2p_ms: x[2],
        wait_ms: x[3],
        stalls: n[0],
        parked_ms: x[4],
        stall_ms: x[5],
        bricks_held: n[1],
        bytes_held: n[2],
        bricks_sent: n[3],
        bytes_sent: n[4],
    })
}

fn slab_stats() -> impl Strategy<Value = SlabStats> {
    let tile = (any::<[u32; 3]>(), any::<u64>(), number(), "[a-z0-9]{0,9}")
        .prop_map(|([x, y, size], est, ms, worker)| TileStats { x, y, size, est, ms, worker });
    (vec(tile, 0..9), any::<[u64; 2]>(), number()).prop_map(
        |(tiles, [empty, shut], barrier_wait_ms)| SlabStats { tiles, empty, shut, barrier_wait_ms },
    )
}

fn error_stats() -> impl Strategy<Value = ErrorStats> {
    vec(prop::option::of(number()), 9).prop_map(|x| ErrorStats {
        cutoff: Bound { bound: x[0] },
        quantisation: Bound { bound: x[1] },
        rounding: BoundAndEstimate { bound: x[2], estimate: x[3] },
        accumulation: Bound { bound: x[4] },
        truncation: BoundAndEstimate { bound: x[5], estimate: x[6] },
        thickness: Estimate { estimate: x[7] },
        ripple: Estimate { estimate: x[8] },
    })
}

/// Statistics as a master could make them, and more.
pub fn stats() -> impl Strategy<Value = FrameStats> {
    let schedule = prop_oneof![Just(Schedule::Region), Just(Schedule::Slab)];
    let left_out = ("[a-z]{1,9}", prop::option::of(number()), any::<Option<u64>>())
        .prop_map(|(name, saved_ms, saved_bytes)| LeftOut { name, saved_ms, saved_bytes });
    let poisoned = (any::<[u32; 4]>(), vec("[a-z0-9]{1,9}", 0..4))
        .prop_map(|([slab, x, y, size], workers)| PoisonedTile { slab, x, y, size, workers });
    (
        (any::<u64>(), schedule, "[0-9a-f]{64}", "([0-9a-f]{64})?", any::<[u32; 2]>()),
        (vec(number(), 8), vec(worker_stats(), 0..5), any::<[u64; 10]>(), any::<Option<u64>>()),
        (vec(slab_stats(), 0..4), quality(Just(Sums::I32)), vec(left_out, 0..3), error_stats()),
        (vec(poisoned, 0..3), prop::option::of("\\PC{0,40}"), any::<bool>()),
    )
        .prop_map(|(head, counts, lists, rest)| {
            let (frame, schedule, view_sha256, pixels_sha256, [v, pixels_version]) = head;
            let (t, workers, n, result_bytes) = counts;
            let (slabs, quality, left_out, error) = lists;
            let (poisoned, critical_path, rehearsed) = rest;
            FrameStats {
                v,
                frame,
                schedule,
                view_sha256,
                pixels_sha256,
                pixels_version,
                ms: FrameMs {
                    total: t[0],
                    cull: t[1],
                    distribute: t[2],
                    render: t[3],
                    composite: t[4],
                    wait: t[5],
                    overlap: t[6],
                    stall: t[7],
                },
                workers,
                voxels: VoxelStats { relevant: n[0], tossed: n[1], splatted: n[2], culled: n[3] },
                bricks: BrickStats { relevant: n[4], needed: n[5], needed_voxels: n[6] },
                result_bytes,
                slabs,
                quality,
                left_out,
                error,
                retries: n[7],
                handed_over: n[8],
                dropped_results: n[9],
                poisoned,
                critical_path,
                rehearsed,
                level: rehearsed.then_some(LevelStats {
                    level: pixels_version % 64,
                    pixels_per_vox: (n[8] % 2 == 0).then_some(t[0]),
                    samples: n[0],
                    finest_samples: n[1],
                }),
            }
        })
}
