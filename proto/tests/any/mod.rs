//! Any message that master, worker and client can mean, for the tests of the wire.
#![allow(dead_code, unreachable_pub, reason = "each test file uses its share")]

mod client;
mod scene;

pub use client::*;
pub use scene::*;

use proptest::collection::vec;
use proptest::prelude::*;
use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, TightBox};
use slabcast_common::ids::*;
use slabcast_common::image::{
    Background, PixelEncoding, PixelFormat, SparseTile, TilePixels, TileState,
};
use slabcast_common::message::*;
use slabcast_common::occlusion::Rect;
use slabcast_common::protocol::ProtocolVersions;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_common::volume::Samples;
use std::sync::Arc;

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
fn begun(lease: &Lease, sheets: u8) -> Checkpoint {
    let Lease { state, tile, slab, .. } = lease;
    let (a, last) = (state.a.clone(), state.last.clone());
    let colour = a.iter().map(|a| [a.to_bits(), 0, a.to_bits() >> 3]).collect();
    let part = |i: u32| (u32::from(sheets) >> (i % 8) & 1 == 0).then_some(slab.first);
    let sheets = parts(*tile).zip(0..).map(|(_, i)| part(i)).collect();
    Checkpoint { sheets, pixels: TilePixels { a, colour, last } }
}

pub fn handed_over() -> impl Strategy<Value = RegionSplit> {
    (lease(), lease(), any::<u8>()).prop_map(|(l, other, sheets)| RegionSplit {
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
fn leaves(pixels: &TilePixels, format: u64) -> SparseTile {
    let n = pixels.a.len() as u32;
    let rows = if n.is_multiple_of(7) { 7 } else { 1 };
    let formats =
        [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F];
    let mut leaves = SparseTile::blank([n / rows, rows], formats[format as usize]);
    let columns = (n / rows).div_ceil(16);
    for (i, word) in (0..columns as usize).zip(pixels.colour.iter().flatten()) {
        leaves.mask[i / 8] |= (word.count_ones() as u8 & 1) << (i % 8);
    }
    let bytes = pixels.colour.iter().flatten().flat_map(|w| w.to_le_bytes()).cycle();
    leaves.data.extend(bytes.take(SparseTile::data_len(leaves.size, leaves.format, &leaves.mask)));
    leaves.max_alpha = n as f32 * 1e-3;
    leaves
}

/// Formats of finished frames.
fn finish() -> impl Strategy<Value = PixelEncoding> {
    let background = prop_oneof![
        Just(Background::Transparent),
        [0.0..=1.0f64, 0.0..=1.0, 0.0..=1.0].prop_map(Background::Colour)
    ];
    (format(), background).prop_map(|(format, background)| PixelEncoding { format, background })
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
                sampled: ErrorsBySource::from_array(std::array::from_fn(|i| SampledError {
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
                // The reader of a message sets its size; it is not written.
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
        1u32..=4096,
        any::<u64>(),
        "[a-z0-9]{0,9}",
        "[0-9a-f]{64}",
    )
        .prop_flat_map(|(versions, name, threads, memory, simd, hash)| {
            vec((key(), ids(50)), 0..4).prop_map(move |held| Hello {
                protocol_versions: ProtocolVersions {
                    oldest: versions[0].min(versions[1]),
                    newest: versions[0].max(versions[1]),
                },
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
        (any::<u64>(), any::<u32>(), "\\PC{0,50}").prop_map(|(t, e, reason)| ToMaster::Failed {
            task: TaskId(t),
            epoch: Epoch(e),
            reason
        }),
        (key(), any::<u32>()).prop_map(|(set, bricks)| ToMaster::BricksReceived { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksBroken { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksWanted { set, bricks }),
        (key(), ids(50)).prop_map(|(set, bricks)| ToMaster::BricksEvicted { set, bricks }),
        handed_over().prop_map(|piece| ToMaster::RegionSplit(Box::new(piece))),
        any::<[u64; 2]>().prop_map(|[nonce, clock_us]| ToMaster::Pong { nonce, clock_us }),
        "\\PC{0,50}".prop_map(|reason| ToMaster::Goodbye { reason }),
    ]
}

pub fn to_worker() -> impl Strategy<Value = ToWorker> {
    prop_oneof![
        (any::<u64>(), 1u32..=600_000, any::<u32>()).prop_map(
            |(w, heartbeat_ms, protocol_version)| {
                let worker = WorkerId(w);
                ToWorker::Welcome { worker, heartbeat_ms, protocol_version }
            }
        ),
        "\\PC{0,50}".prop_map(|reason| ToWorker::Refused { reason }),
        scene().prop_map(|s| ToWorker::Scene(Arc::new(s))),
        (any::<[u64; 3]>(), view(), prop::option::of(finish()), any::<bool>()).prop_map(
            |([f, s, client], view, finish, plain)| {
                let (frame, scene) = (FrameId(f), SceneId(s));
                ToWorker::Frame { frame, scene, view, finish, plain, client }
            }
        ),
        lease().prop_map(|l| ToWorker::Lease(Box::new(l))),
        directory(),
        region().prop_map(ToWorker::Region),
        (any::<[u64; 2]>(), any::<u32>(), 1u32..=999).prop_map(|([f, t], e, share)| {
            let (frame, task, epoch) = (FrameId(f), TaskId(t), Epoch(e));
            ToWorker::SplitRegion { frame, task, epoch, share }
        }),
        any::<u64>().prop_map(|f| ToWorker::EndFrame { frame: FrameId(f) }),
        any::<u64>().prop_map(|s| ToWorker::EndScene { scene: SceneId(s) }),
        (key(), vec((0u32..1 << 27).prop_map(BrickId), 1..60))
            .prop_map(|(set, bricks)| ToWorker::DropBricks { set, bricks }),
        any::<u64>().prop_map(|nonce| ToWorker::Ping { nonce }),
        "\\PC{0,50}".prop_map(|reason| ToWorker::MasterEnding { reason }),
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
