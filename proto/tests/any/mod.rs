//! Any message that master, worker and client can mean, for the tests of the wire.
#![allow(dead_code, unreachable_pub, reason = "each test file uses its share")]

use glam::{DMat3, DVec3};
use proptest::collection::vec;
use proptest::prelude::*;
use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::*;
use slabcast_common::image::{Background, PixelFormat, TilePixels, TileState};
use slabcast_common::kernel::Lean;
use slabcast_common::leaves::{Finish, Leaves};
use slabcast_common::message::*;
use slabcast_common::occlusion::Rect;
use slabcast_common::path::{
    Axis, Crop, CropUnit, Easing, FlyThrough, Key, KeyFrames, Orientation, PathView,
    ProjectionKind, Side, Turntable, ViewPath,
};
use slabcast_common::quality::{Borders, Compositing, Keep, Kernel, Quality, Schedule, Sums, Work};
use slabcast_common::region::parts;
use slabcast_common::shade::{Light, Shading};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::{ColorSpace, Domain, NanLook, OpacityUnit, TransferFunction};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::{
    Digest32, Lattice, SampleKind, Samples, ValueMap, ValueSummary, VolumeInfo,
};
use slabcast_proto::model;
use std::sync::Arc;

/// Finite numbers of every size, both zeros included.
pub fn number() -> impl Strategy<Value = f64> {
    use proptest::num::f64::*;
    POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO
}

fn triple() -> impl Strategy<Value = [f64; 3]> {
    [number(), number(), number()]
}

fn vector() -> impl Strategy<Value = DVec3> {
    triple().prop_map(DVec3::from_array)
}

fn above_zero() -> impl Strategy<Value = f64> {
    proptest::num::f64::POSITIVE | proptest::num::f64::NORMAL
}

fn matrix() -> impl Strategy<Value = DMat3> {
    (vector(), vector(), vector()).prop_map(|(a, b, c)| DMat3::from_cols(a, b, c))
}

fn spread() -> impl Strategy<Value = DVec3> {
    [above_zero(), above_zero(), above_zero()].prop_map(DVec3::from_array)
}

pub fn size() -> impl Strategy<Value = [u32; 2]> {
    [1u32..=8192, 1u32..=8192]
}

pub fn view() -> impl Strategy<Value = View> {
    let projection = prop_oneof![
        above_zero().prop_map(|scale| Projection::Ortho { scale }),
        (above_zero(), above_zero())
            .prop_map(|(focal, distance)| Projection::Persp { focal, distance }),
    ];
    (
        (size(), matrix(), vector(), matrix(), projection),
        (above_zero(), spread(), spread(), vector(), above_zero()),
    )
        .prop_map(|((size, eye_from_index, eye_origin, eye_from_world, projection), rest)| {
            let (thickness, kernel_std, kernel_radius, lean, cell) = rest;
            View {
                size,
                eye_from_index,
                eye_origin,
                eye_from_world,
                projection,
                thickness,
                kernel_std,
                kernel_radius,
                kernel_lean: Lean::from_array(lean.to_array()),
                cell,
            }
        })
}

pub fn key() -> impl Strategy<Value = BrickSetKey> {
    any::<[u8; 32]>().prop_map(|d| BrickSetKey(Digest32(d)))
}

pub fn ids(most: usize) -> impl Strategy<Value = Vec<BrickId>> {
    vec((0u32..1 << 27).prop_map(BrickId), 0..most)
}

fn ascending(most: usize) -> impl Strategy<Value = Vec<BrickId>> {
    prop::collection::btree_set((0u32..1 << 27).prop_map(BrickId), 0..most)
        .prop_map(|s| s.into_iter().collect())
}

pub fn info() -> impl Strategy<Value = VolumeInfo> {
    let lattice = ([1u32..600, 1u32..600, 1u32..600], [0.01..20.0f64, 0.01..20.0, 0.01..20.0])
        .prop_flat_map(|(dims, spacing)| {
            (vector(), -0.2..0.2f64).prop_map(move |(origin, skew)| {
                let mut lattice = Lattice::from_spacing(dims, spacing);
                lattice.steps[1].x = skew * spacing[1];
                lattice.steps[0].z = -0.0;
                Lattice { origin, ..lattice }
            })
        });
    let summary = (
        prop_oneof![Just(SampleKind::U8), Just(SampleKind::U16), Just(SampleKind::F32)],
        number(),
        number(),
        (0u32..=255, 0u32..=255),
        vec(0u64..1 << 50, 256),
        0u64..9,
    )
        .prop_map(|(kind, scale, offset, (a, b), histogram, odd)| ValueSummary {
            kind,
            map: ValueMap { scale, offset },
            min_code: f64::from(a.min(b)),
            max_code: f64::from(a.max(b)),
            histogram,
            nan: odd,
            infinite: odd / 2,
        });
    (any::<[u8; 32]>(), lattice, summary).prop_map(|(digest, lattice, summary)| VolumeInfo {
        digest: Digest32(digest),
        lattice,
        summary,
    })
}

pub fn transfer() -> impl Strategy<Value = TransferFunction> {
    let unit = || 0.0..=1.0f64;
    (
        vec((number(), unit(), unit(), unit()), 1..8),
        vec((number(), unit()), 1..8),
        (any::<[bool; 4]>(), unit(), unit()),
        [0.5..2.0f64, -2.0..2.0, -2.0..2.0],
    )
        .prop_map(|(mut colors, mut opacities, (yes, ambient, nan), light)| {
            colors.sort_by(|a, b| a.0.total_cmp(&b.0));
            opacities.sort_by(|a, b| a.0.total_cmp(&b.0));
            let shading = Shading::default();
            TransferFunction {
                version: 1,
                domain: if yes[0] { Domain::Value } else { Domain::Unit },
                colors: colors.into_iter().map(|(x, r, g, b)| [x, r, g, b]).collect(),
                opacities: opacities.into_iter().map(|(x, a)| [x, a]).collect(),
                color_space: if yes[1] { ColorSpace::Srgb } else { ColorSpace::Linear },
                opacity_unit: if yes[2] {
                    OpacityUnit::AlphaPerVox
                } else {
                    OpacityUnit::Extinction
                },
                nan: NanLook { color: [nan; 3], opacity: nan },
                gradient_opacity: vec![],
                shading: Shading {
                    on: yes[0],
                    ambient,
                    light: if yes[3] { Light::Direction(light) } else { shading.light },
                    ..shading
                },
            }
        })
}

pub fn quality(sums: impl Strategy<Value = Sums>) -> impl Strategy<Value = Quality> {
    let compositing = prop_oneof![
        Just(Compositing::Linear),
        Just(Compositing::Constant),
        Just(Compositing::Paper)
    ];
    let d = Quality::default();
    let kernel = prop_oneof![
        (Just(Kernel::Gaussian), 0.4..1.0f64, 1.0..3.0f64),
        (prop_oneof![Just(Kernel::Bspline), Just(Kernel::Tent)], Just(d.std), Just(d.radius)),
    ];
    (0.02..100.0f64, 0.0..=0.5f64, kernel, compositing, sums, any::<bool>()).prop_map(
        |(thickness, eps, (kernel, std, radius), compositing, sums, cull)| Quality {
            thickness,
            eps,
            kernel,
            std,
            radius,
            compositing,
            sums,
            cull,
            ..Quality::default()
        },
    )
}

fn scene() -> impl Strategy<Value = SceneSpec> {
    let sums = prop_oneof![Just(Sums::I32), Just(Sums::F32)];
    (any::<u64>(), info(), transfer(), quality(sums), key()).prop_map(
        |(id, volume, transfer, quality, bricks)| SceneSpec {
            id: SceneId(id),
            volume,
            transfer,
            quality,
            bricks,
        },
    )
}

/// Words of `n` pixels: all the same, few, or all of them, with every pattern of bits.
fn words<const W: usize>(n: usize) -> impl Strategy<Value = Vec<[u32; W]>> {
    (vec(any::<[u32; W]>(), n), 0u8..4, any::<u32>()).prop_map(|(mut pixels, how, salt)| {
        for (i, p) in pixels.iter_mut().enumerate() {
            match how {
                0 => *p = [0; W],
                1 => *p = [salt; W],
                2 if i % 7 != salt as usize % 7 => *p = [0; W],
                _ => {}
            }
        }
        pixels
    })
}

fn planes(n: usize) -> impl Strategy<Value = (Vec<f32>, Option<Vec<[u32; 4]>>)> {
    (words::<1>(n), prop::option::of(words::<4>(n)))
        .prop_map(|(a, last)| (a.into_iter().map(|[w]| f32::from_bits(w)).collect(), last))
}

pub fn lease() -> impl Strategy<Value = Lease> {
    (1u32..24, 1u32..24, 0u32..8000, 0u32..8000).prop_flat_map(|(w, h, x, y)| {
        let ids = (any::<u64>(), any::<u32>(), any::<u64>());
        let slab = (any::<i32>(), any::<i32>());
        (ids, slab, ascending(40), planes((w * h) as usize)).prop_map(
            move |((task, epoch, frame), (s, t), bricks, (a, last))| Lease {
                task: TaskId(task),
                epoch: Epoch(epoch),
                frame: FrameId(frame),
                tile: Rect::new(x as i32, y as i32, (x + w) as i32, (y + h) as i32),
                slab: SheetRange::new(s.min(t).min(i32::MAX - 1), s.max(t).max(s.min(t) + 1)),
                bricks,
                state: TileState { a, last },
            },
        )
    })
}

pub fn region() -> impl Strategy<Value = RegionLease> {
    (lease(), any::<bool>(), any::<u8>()).prop_map(|(l, estimate, sheets)| {
        let (task, epoch, frame, tile) = (l.task, l.epoch, l.frame, l.tile);
        let begun = (sheets % 2 == 0).then(|| Arc::new(begun(&l, sheets)));
        RegionLease { task, epoch, frame, tile, estimate, begun }
    })
}

/// A lease's tile as somebody left it.
fn begun(lease: &Lease, sheets: u8) -> Begun {
    let Lease { state, tile, slab, .. } = lease;
    let (a, last) = (state.a.clone(), state.last.clone());
    let colour = a.iter().map(|a| [a.to_bits(), 0, a.to_bits() >> 3]).collect();
    let part = |i: u32| (u32::from(sheets) >> (i % 8) & 1 == 0).then_some(slab.first);
    let sheets = parts(*tile).zip(0..).map(|(_, i)| part(i)).collect();
    Begun { sheets, pixels: TilePixels { a, colour, last } }
}

pub fn handed_over() -> impl Strategy<Value = HandedOver> {
    (lease(), lease(), any::<u8>()).prop_map(|(l, other, sheets)| HandedOver {
        task: l.task,
        epoch: l.epoch,
        kept: other.tile,
        given: l.tile,
        begun: begun(&l, sheets),
    })
}

/// Some bricks of a grid of 7 x 9 x 11.
pub fn directory() -> impl Strategy<Value = ToWorker> {
    let grid = BrickGrid { dims: [7, 9, 11] };
    let boxes = vec((any::<[[u32; 2]; 3]>(), 1u16..=512, 1u32..=3595), 1..60);
    (key(), boxes, 0u32..600, any::<[u32; 2]>()).prop_map(
        move |(set, boxes, from, [first, more])| {
            let bricks: Vec<BrickInfo> = (from..)
                .zip(boxes)
                .map(|(id, (ends, voxels, bytes))| {
                    let corner = grid.corner(BrickId(id));
                    let [lo, hi] = [true, false].map(|low| {
                        std::array::from_fn(|a| {
                            let [x, y] = ends[a].map(|x| x % 8);
                            corner[a] + if low { x.min(y) } else { x.max(y) }
                        })
                    });
                    BrickInfo { id: BrickId(id), tight: TightBox { lo, hi }, voxels, bytes }
                })
                .collect();
            let first = first % (1 << 20);
            let total = first + bricks.len() as u32 + more % (1 << 20);
            ToWorker::Directory { set, grid, first, total, bricks: bricks.into() }
        },
    )
}

/// Some leaves of a tile of one row or more, from words that mean nothing.
fn leaves(pixels: &TilePixels, format: u64) -> Leaves {
    let n = pixels.a.len() as u32;
    let rows = if n.is_multiple_of(7) { 7 } else { 1 };
    let formats =
        [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F];
    let mut leaves = Leaves::blank([n / rows, rows], formats[format as usize]);
    let columns = (n / rows).div_ceil(16);
    for (i, word) in (0..columns as usize).zip(pixels.colour.iter().flatten()) {
        leaves.mask[i / 8] |= (word.count_ones() as u8 & 1) << (i % 8);
    }
    let bytes = pixels.colour.iter().flatten().flat_map(|w| w.to_le_bytes()).cycle();
    leaves.data.extend(bytes.take(Leaves::data_len(leaves.size, leaves.format, &leaves.mask)));
    leaves.alpha_most = n as f32 * 1e-3;
    leaves
}

/// What frames are finished to.
fn finish() -> impl Strategy<Value = Finish> {
    let background = prop_oneof![
        Just(Background::Transparent),
        [0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0].prop_map(Background::Colour)
    ];
    (format(), background).prop_map(|(format, background)| Finish { format, background })
}

pub fn result() -> impl Strategy<Value = TileResult> {
    (1usize..600).prop_flat_map(|n| {
        let ids = (any::<u64>(), any::<u32>());
        let cost = (ascending(40), any::<[u32; 5]>(), any::<[u64; 6]>()).prop_map(
            |(touched, [stalls, pixels @ ..], [parked_us, idle_us, squares @ ..])| RegionCost {
                touched: touched.into_iter().map(|id| id.0).collect(),
                stalls,
                parked_us,
                idle_us,
                sampled: Sampling::of(std::array::from_fn(|i| Sampled {
                    pixels: pixels[i],
                    squares: squares[i],
                })),
            },
        );
        let more = (any::<u32>(), prop::option::of(cost));
        (ids, planes(n), words::<3>(n), any::<[u64; 7]>(), more).prop_map(
            |((task, epoch), (a, last), colour, c, (thread, region))| TileResult {
                task: TaskId(task),
                epoch: Epoch(epoch),
                // What a message says of itself, nobody writes.
                bytes: None,
                pixels: match c[6] % 2 {
                    0 => Pixels::Sums(TilePixels { a, colour, last }),
                    _ => Pixels::Finished(leaves(&TilePixels { a, colour, last }, c[5] % 4)),
                },
                counters: Counters { tossed: c[0], splatted: c[1], culled: c[2] },
                times: TaskTimes {
                    received_us: c[3],
                    ready_us: c[4],
                    start_us: c[5],
                    end_us: c[6],
                    thread,
                },
                region,
            },
        )
    })
}

pub fn hello() -> impl Strategy<Value = Hello> {
    (
        any::<[u32; 2]>(),
        "[a-z0-9:. ]{1,40}",
        1u32..=65536,
        any::<u64>(),
        "[a-z0-9]{0,9}",
        "[0-9a-f]{64}",
    )
        .prop_flat_map(|(versions, name, threads, memory, simd, hash)| {
            vec((key(), ids(50)), 0..4).prop_map(move |held| Hello {
                protocol_version: versions[0],
                pixels_version: versions[1],
                name: name.clone(),
                threads,
                memory_budget_bytes: memory,
                simd: simd.clone(),
                self_test_sha256: hash.clone(),
                held,
                rehearses: threads % 5 == 0,
                machine: simd.clone(),
            })
        })
}

pub fn to_master() -> impl Strategy<Value = ToMaster> {
    prop_oneof![
        hello().prop_map(ToMaster::Hello),
        result().prop_map(|r| ToMaster::Result(Box::new(r))),
        (any::<u64>(), any::<u32>(), ".{0,50}").prop_map(|(t, e, reason)| ToMaster::Failed {
            task: TaskId(t),
            epoch: Epoch(e),
            reason
        }),
        (key(), any::<u32>()).prop_map(|(set, bricks)| ToMaster::BricksIn { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksBroken { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksWanted { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksForgotten { set, bricks }),
        handed_over().prop_map(|piece| ToMaster::HandedOver(Box::new(piece))),
        any::<[u64; 2]>().prop_map(|[nonce, clock_us]| ToMaster::Pong { nonce, clock_us }),
        ".{0,50}".prop_map(|reason| ToMaster::Leaving { reason }),
    ]
}

pub fn to_worker() -> impl Strategy<Value = ToWorker> {
    prop_oneof![
        (any::<u64>(), 1u32..=600_000).prop_map(|(w, heartbeat_ms)| {
            ToWorker::Welcome { worker: WorkerId(w), heartbeat_ms }
        }),
        ".{0,50}".prop_map(|reason| ToWorker::Refused { reason }),
        scene().prop_map(|s| ToWorker::Scene(Arc::new(s))),
        (any::<[u64; 2]>(), view(), prop::option::of(finish()), any::<bool>()).prop_map(
            |([f, s], view, finish, plain)| {
                ToWorker::Frame { frame: FrameId(f), scene: SceneId(s), view, finish, plain }
            }
        ),
        lease().prop_map(|l| ToWorker::Lease(Box::new(l))),
        directory(),
        region().prop_map(ToWorker::Region),
        (any::<[u64; 2]>(), any::<u32>(), 1u32..=999).prop_map(|([f, t], e, share)| {
            let (frame, task, epoch) = (FrameId(f), TaskId(t), Epoch(e));
            ToWorker::HandOver { frame, task, epoch, share }
        }),
        any::<u64>().prop_map(|f| ToWorker::EndFrame { frame: FrameId(f) }),
        any::<u64>().prop_map(|s| ToWorker::EndScene { scene: SceneId(s) }),
        (key(), vec((0u32..1 << 27).prop_map(BrickId), 1..60))
            .prop_map(|(set, bricks)| ToWorker::DropBricks { set, bricks }),
        any::<u64>().prop_map(|nonce| ToWorker::Ping { nonce }),
        ".{0,50}".prop_map(|reason| ToWorker::Leave { reason }),
    ]
}

pub fn brick() -> impl Strategy<Value = Brick> {
    (0u32..1 << 27, prop::collection::btree_set(0u16..512, 1..512), any::<bool>()).prop_map(
        |(id, index, normals)| {
            let index: Vec<u16> = index.into_iter().collect();
            let n = index.len();
            let values = Samples::U8(index.iter().map(|i| *i as u8).collect());
            let gradients = (id % 2 == 1).then(|| vec![9; n]);
            Brick::new(BrickId(id), index, values, normals.then(|| vec![7; n]))
                .with_gradients(gradients)
        },
    )
}

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
        (prop::option::of(number()), projection(), number()),
        (prop::option::of(axis()), prop::option::of(axis())),
    )
        .prop_map(
            |((start, step, frames, elevation), (height, projection, fov), (up, front))| {
                Turntable { start, step, frames, elevation, height, projection, fov, up, front }
            },
        );
    let path = (
        size(),
        prop_oneof![
            vec(view, 1..5).prop_map(|views| ViewPath::of_views([1, 1], views)),
            turntable.prop_map(|t| ViewPath::turn([1, 1], t)),
            keyframes().prop_map(|k| {
                ViewPath { keyframes: Some(k), ..ViewPath::of_views([1, 1], vec![]) }
            }),
            flythrough().prop_map(|f| {
                ViewPath { flythrough: Some(f), ..ViewPath::of_views([1, 1], vec![]) }
            }),
        ],
        prop::option::of(crop()),
        any::<bool>(),
    )
        .prop_map(|(size, path, crop, range)| {
            let last = path.frames() as u32 - 1;
            let range = range.then_some([last / 3, last]);
            ViewPath { size, crop, range, ..path }
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
        any::<[bool; 6]>(),
    )
        .prop_map(|(slabs, tiles_per_worker, tile, schedule, flags)| {
            let [empty, normals, gradients, colours, equal, estimate] = flags;
            Work {
                slabs,
                tiles_per_worker,
                tile,
                schedule,
                keep: Keep { empty, normals, gradients, colours },
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
        ("[A-Za-z0-9-]{1,60}", path, transfer, quality(sums)),
        (work, format(), background, any::<[bool; 2]>()),
    )
        .prop_map(
            |((client_key, path, transfer, quality), (work, format, background, [trace, hash]))| {
                PathRequest {
                    client_key,
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

fn state() -> impl Strategy<Value = model::JobState> {
    use model::JobState::*;
    prop_oneof![
        Just(Queued),
        Just(WaitingForWorkers),
        Just(Running),
        Just(Done),
        Just(Failed),
        Just(Cancelled)
    ]
}

pub fn notice() -> impl Strategy<Value = model::JobNotice> {
    (state(), any::<[u64; 2]>(), any::<u32>(), ".{0,50}").prop_map(
        |(state, [frames_done, frames_total], workers, message)| model::JobNotice {
            state,
            frames_done,
            frames_total,
            workers,
            message,
        },
    )
}

pub fn job() -> impl Strategy<Value = model::Job> {
    (("job-[0-9]{1,9}", "[a-z]{1,9}", ".{0,50}"), notice(), size(), format(), any::<[i64; 2]>())
        .prop_map(|((job_id, client_key, message), n, size, format, times)| model::Job {
            job_id,
            client_key,
            state: n.state,
            message,
            frames_done: n.frames_done,
            frames_total: n.frames_total,
            size,
            format,
            submitted_unix_ms: times[0],
            finished_unix_ms: times[1],
        })
}

pub fn volume() -> impl Strategy<Value = model::VolumeDescription> {
    (info(), axis(), 1usize..3, any::<(bool, u32, u32)>()).prop_map(
        |(info, up, turn, (a, p, q))| {
            let front = Axis { index: (up.index + turn) % 3, negative: a };
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
        silent_ms: n[5],
        here_ms: n[6],
        in_reserve: m[0] % 2 == 1,
    })
}
