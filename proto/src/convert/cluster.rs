//! Messages between master and worker (`cluster.proto`).

use super::render::{background_from_wire, background_to_wire, format_from_wire, format_to_wire};
use super::{
    MAX_TILE_PIXELS, WireError, bricks_list_from_wire, bricks_to_wire, digest_from_wire, leaves,
    name_from_wire, optional_name_from_wire, plane, reason_from_wire, reason_to_wire, required,
    scene_from_wire, scene_to_wire, view_from_wire, view_to_wire,
};
use crate::{MAX_BRICKS_MESSAGE, v1};
use bytes::Bytes;
use prost::Message as _;
use slabcast_common::brick::{
    BRICK, BRICK_VOXELS, Brick, BrickGrid, BrickInfo, BrickSetKey, MAX_BRICKS, TightBox,
};
use slabcast_common::ids::{BrickId, Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::image::{RawSums, TilePixels, TileState};
use slabcast_common::leaves::Finish;
use slabcast_common::message::{
    Begun, BrickBatch, Counters, HandedOver, Hello, Lease, Pixels, RegionCost, RegionLease,
    Sampled, Sampling, TaskTimes, TileResult, ToMaster, ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::region::parts;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::MAX_EDGE;
use std::sync::Arc;

/// Where a message for a worker goes.
#[expect(clippy::large_enum_variant, reason = "it is taken apart and sent where it is made")]
#[derive(Clone, Debug, PartialEq)]
pub enum Down {
    /// On Control.
    Control(v1::ToWorker),
    /// On Control, one after the other.
    Parts(Vec<v1::ToWorker>),
    /// On Bricks, in this order: bricks to forget keep their place among the bricks that are
    /// sent.
    Bricks(Vec<v1::BricksDown>),
}

/// What comes down the Bricks stream.
#[expect(clippy::large_enum_variant, reason = "it is taken apart where it comes")]
#[derive(Clone, Debug)]
pub enum Bricks {
    /// Bricks.
    Batch(BrickBatch),
    /// A message that keeps its place among them ([`ToWorker::DropBricks`]).
    Message(ToWorker),
}

fn key_to_wire(set: &BrickSetKey) -> Bytes {
    Bytes::copy_from_slice(&set.0.0)
}

fn key_from_wire(field: &str, set: &[u8]) -> Result<BrickSetKey, WireError> {
    Ok(BrickSetKey(digest_from_wire(field, set)?))
}

// ---------------------------------------------------------------------------------------------
// Worker to master

/// A worker's message.
///
/// A hello names at most [`MAX_BRICK_LIST`](super::MAX_BRICK_LIST) held bricks; those beyond are
/// left out, and will be sent again.
///
/// # Panics
/// If a result's planes differ in size: such a result is our own mistake.
pub fn from_worker_to_wire(message: &ToMaster) -> v1::FromWorker {
    from_worker_to_wire_as(message, true)
}

/// The same, where finished pixels are packed if that makes them fewer bytes (`packs`), or go as they are.
///
/// # Panics
/// As that.
pub fn from_worker_to_wire_as(message: &ToMaster, packs: bool) -> v1::FromWorker {
    use v1::from_worker::Message;
    let message = match message {
        ToMaster::Hello(hello) => Message::Hello(hello_to_wire(hello)),
        ToMaster::Result(result) => Message::Result(result_to_wire(result, packs)),
        ToMaster::Failed { task, epoch, reason } => Message::Failed(v1::TaskFailed {
            task: task.0,
            epoch: epoch.0,
            reason: reason_to_wire(reason),
        }),
        ToMaster::BricksIn { set, bricks } => {
            Message::BricksIn(v1::BricksIn { set: key_to_wire(set), bricks: *bricks })
        }
        ToMaster::BricksBroken { set, bricks } => Message::BricksBroken(v1::BricksBroken {
            set: key_to_wire(set),
            bricks: Some(bricks_to_wire(bricks)),
        }),
        ToMaster::BricksWanted { set, bricks } => Message::BricksWanted(v1::BricksWanted {
            set: key_to_wire(set),
            bricks: Some(bricks_to_wire(bricks)),
        }),
        ToMaster::BricksForgotten { set, bricks } => {
            Message::BricksForgotten(v1::BricksForgotten {
                set: key_to_wire(set),
                bricks: Some(bricks_to_wire(bricks)),
            })
        }
        ToMaster::HandedOver(piece) => Message::HandedOver(handed_over_to_wire(piece)),
        ToMaster::Pong { nonce, clock_us } => {
            Message::Pong(v1::Pong { nonce: *nonce, clock_us: *clock_us })
        }
        ToMaster::Leaving { reason } => {
            Message::Leaving(v1::Leaving { reason: reason_to_wire(reason) })
        }
    };
    v1::FromWorker { message: Some(message) }
}

/// A worker's message, or the field that is wrong. A result says how many bytes its message has.
pub fn from_worker_from_wire(message: v1::FromWorker) -> Result<ToMaster, WireError> {
    use v1::from_worker::Message;
    let bytes = message.encoded_len() as u32;
    Ok(match required("message", message.message)? {
        Message::Hello(hello) => {
            ToMaster::Hello(hello_from_wire(hello).map_err(|e| e.within("hello"))?)
        }
        Message::Result(result) => ToMaster::Result(Box::new(
            result_from_wire(result, bytes).map_err(|e| e.within("result"))?,
        )),
        Message::Failed(failed) => ToMaster::Failed {
            task: TaskId(failed.task),
            epoch: Epoch(failed.epoch),
            reason: reason_from_wire("failed.reason", failed.reason)?,
        },
        Message::BricksIn(bricks) => ToMaster::BricksIn {
            set: key_from_wire("bricks_in.set", &bricks.set)?,
            bricks: bricks.bricks,
        },
        Message::BricksBroken(broken) => ToMaster::BricksBroken {
            set: key_from_wire("bricks_broken.set", &broken.set)?,
            bricks: bricks_list_from_wire("bricks_broken.bricks", broken.bricks)?,
        },
        Message::BricksWanted(wanted) => ToMaster::BricksWanted {
            set: key_from_wire("bricks_wanted.set", &wanted.set)?,
            bricks: bricks_list_from_wire("bricks_wanted.bricks", wanted.bricks)?,
        },
        Message::BricksForgotten(gone) => ToMaster::BricksForgotten {
            set: key_from_wire("bricks_forgotten.set", &gone.set)?,
            bricks: bricks_list_from_wire("bricks_forgotten.bricks", gone.bricks)?,
        },
        Message::HandedOver(piece) => ToMaster::HandedOver(Box::new(
            handed_over_from_wire(piece).map_err(|e| e.within("handed_over"))?,
        )),
        Message::Pong(pong) => ToMaster::Pong { nonce: pong.nonce, clock_us: pong.clock_us },
        Message::Leaving(leaving) => {
            ToMaster::Leaving { reason: reason_from_wire("leaving.reason", leaving.reason)? }
        }
    })
}

fn hello_to_wire(hello: &Hello) -> v1::Hello {
    let mut room = super::MAX_BRICK_LIST;
    let held = hello
        .held
        .iter()
        .map(|(set, bricks)| {
            let named = &bricks[..bricks.len().min(room)];
            room -= named.len();
            v1::HeldBricks { set: key_to_wire(set), bricks: Some(bricks_to_wire(named)) }
        })
        .collect();
    v1::Hello {
        protocol_version: hello.protocol_version,
        pixels_version: hello.pixels_version,
        name: hello.name.clone(),
        threads: hello.threads,
        memory_budget_bytes: hello.memory_budget_bytes,
        simd: hello.simd.clone(),
        self_test_sha256: hello.self_test_sha256.clone(),
        held,
        rehearses: hello.rehearses,
        machine: hello.machine.clone(),
    }
}

fn hello_from_wire(hello: v1::Hello) -> Result<Hello, WireError> {
    if !(1..=65536).contains(&hello.threads) {
        return Err(WireError::value("threads", format!("{}; give 1 to 65536", hello.threads)));
    }
    let hash = hello.self_test_sha256;
    if hash.len() != 64 {
        return Err(WireError::length("self_test_sha256", hash.len(), 64));
    }
    if !hash.bytes().all(|b| b.is_ascii_hexdigit()) {
        return Err(WireError::value("self_test_sha256", "is not hexadecimal"));
    }
    let mut held = Vec::new();
    let mut bricks_in_all = 0;
    for (i, set) in hello.held.into_iter().enumerate() {
        let name = |f: &str| format!("held[{i}].{f}");
        let bricks = bricks_list_from_wire(&name("bricks"), set.bricks)?;
        bricks_in_all += bricks.len();
        if bricks_in_all > super::MAX_BRICK_LIST {
            return Err(WireError::too_long("held", bricks_in_all, super::MAX_BRICK_LIST));
        }
        held.push((key_from_wire(&name("set"), &set.set)?, bricks));
    }
    Ok(Hello {
        protocol_version: hello.protocol_version,
        pixels_version: hello.pixels_version,
        name: name_from_wire("name", hello.name)?,
        threads: hello.threads,
        memory_budget_bytes: hello.memory_budget_bytes,
        simd: optional_name_from_wire("simd", hello.simd)?,
        self_test_sha256: hash,
        held,
        rehearses: hello.rehearses,
        machine: optional_name_from_wire("machine", hello.machine)?,
    })
}

fn a_to_wire(a: &[f32]) -> v1::Plane {
    plane::to_wire(a.len(), |i| [a[i].to_bits()])
}

fn a_from_wire(a: Option<v1::Plane>, n: usize) -> Result<Vec<f32>, WireError> {
    // A plane whose every field is zero is an empty message, and a writer may leave it out.
    plane::from_wire(Some(a.unwrap_or_default()), n, |[w]: [u32; 1]| f32::from_bits(w))
        .map_err(|e| e.within("a"))
}

fn last_to_wire(last: &Option<Vec<RawSums>>, n: usize) -> Option<v1::Plane> {
    last.as_ref().map(|sums| {
        assert_eq!(sums.len(), n, "raw sums have their tile's size");
        plane::to_wire(n, |i| sums[i])
    })
}

fn last_from_wire(last: Option<v1::Plane>, n: usize) -> Result<Option<Vec<RawSums>>, WireError> {
    last.map(|sums| plane::from_wire(Some(sums), n, |p: RawSums| p).map_err(|e| e.within("last")))
        .transpose()
}

fn result_to_wire(result: &TileResult, packs: bool) -> v1::TileResult {
    let (c, t) = (&result.counters, &result.times);
    let n = result.pixels.len();
    let (a, colour, last, finished) = match &result.pixels {
        Pixels::Sums(p) => {
            assert_eq!(p.colour.len(), n, "colour has its tile's size");
            let colour = plane::to_wire(n, |i| p.colour[i]);
            (Some(a_to_wire(&p.a)), Some(colour), last_to_wire(&p.last, n), None)
        }
        Pixels::Finished(tile) => (None, None, None, Some(leaves::to_wire(tile, packs))),
    };
    v1::TileResult {
        task: result.task.0,
        epoch: result.epoch.0,
        pixels: n as u32,
        a,
        colour,
        last,
        finished,
        tossed: c.tossed,
        splatted: c.splatted,
        culled: c.culled,
        received_us: t.received_us,
        ready_us: t.ready_us,
        start_us: t.start_us,
        end_us: t.end_us,
        thread: t.thread,
        region: result.region.as_ref().map(|r| v1::RegionCost {
            // Figures, not pixels: those beyond what fits are left out.
            touched: Some(bricks_to_wire(
                &r.touched
                    .iter()
                    .take(super::MAX_BRICK_LIST)
                    .map(|&i| BrickId(i))
                    .collect::<Vec<_>>(),
            )),
            stalls: r.stalls,
            parked_us: r.parked_us,
            idle_us: r.idle_us,
            thickness: sampled_to_wire(r.sampled.thickness),
            positions: sampled_to_wire(r.sampled.positions),
            truncation: sampled_to_wire(r.sampled.truncation),
            ripple: sampled_to_wire(r.sampled.ripple),
        }),
    }
}

/// `None` where nothing was looked at.
fn sampled_to_wire(s: Sampled) -> Option<v1::Sampled> {
    (s != Sampled::default()).then_some(v1::Sampled { pixels: s.pixels, squares: s.squares })
}

fn region_cost_from_wire(cost: v1::RegionCost) -> Result<RegionCost, WireError> {
    let touched = bricks_list_from_wire("touched", cost.touched)?;
    if touched.windows(2).any(|w| w[0] >= w[1]) {
        return Err(WireError::value("touched", "do not ascend"));
    }
    let touched = touched.into_iter().map(|id| id.0).collect();
    let v1::RegionCost { stalls, parked_us, idle_us, .. } = cost;
    let each = [cost.thickness, cost.positions, cost.truncation, cost.ripple];
    let sampled = Sampling::of(each.map(|s| {
        s.map_or_else(Sampled::default, |s| Sampled { pixels: s.pixels, squares: s.squares })
    }));
    Ok(RegionCost { touched, stalls, parked_us, idle_us, sampled })
}

fn result_from_wire(result: v1::TileResult, bytes: u32) -> Result<TileResult, WireError> {
    let n = result.pixels as usize;
    if n == 0 || n > MAX_TILE_PIXELS {
        return Err(WireError::value("pixels", format!("{n}; give 1 to {MAX_TILE_PIXELS}")));
    }
    let pixels = match result.finished {
        Some(finished) => {
            let leaves = leaves::from_wire(finished).map_err(|e| e.within("finished"))?;
            if leaves.pixels() != n {
                return Err(WireError::length("pixels", n, leaves.pixels()));
            }
            Pixels::Finished(leaves)
        }
        None => {
            let colour = result.colour.unwrap_or_default();
            let colour = plane::from_wire(Some(colour), n, |p: [u32; 3]| p)
                .map_err(|e| e.within("colour"))?;
            let (a, last) = (a_from_wire(result.a, n)?, last_from_wire(result.last, n)?);
            Pixels::Sums(TilePixels { a, colour, last })
        }
    };
    Ok(TileResult {
        task: TaskId(result.task),
        epoch: Epoch(result.epoch),
        pixels,
        bytes: Some(bytes),
        counters: Counters {
            tossed: result.tossed,
            splatted: result.splatted,
            culled: result.culled,
        },
        times: TaskTimes {
            received_us: result.received_us,
            ready_us: result.ready_us,
            start_us: result.start_us,
            end_us: result.end_us,
            thread: result.thread,
        },
        region: result
            .region
            .map(|cost| region_cost_from_wire(cost).map_err(|e| e.within("region")))
            .transpose()?,
    })
}

/// Whether a result has its lease's size. A message alone can't tell; who knows the lease MUST
/// ask before the planes are put into a frame. Costs nothing.
pub fn check_result(tile: Rect, result: &TileResult) -> Result<(), WireError> {
    let have = result.pixels.len();
    if have != tile.area() {
        return Err(WireError::length("result.pixels", have, tile.area()));
    }
    Ok(())
}

// ---------------------------------------------------------------------------------------------
// Master to worker

/// A message for a worker, and the stream it goes on. `session` is written into `Welcome`; other
/// messages do not carry it.
///
/// # Panics
/// If a lease's planes do not have its tile's size: such a lease is our own mistake.
pub fn to_worker_to_wire(message: &ToWorker, session: u64) -> Down {
    use v1::to_worker::Message;
    let message = match message {
        ToWorker::Welcome { worker, heartbeat_ms } => {
            let (worker, heartbeat_ms) = (worker.0, *heartbeat_ms);
            Message::Welcome(v1::Welcome { worker, heartbeat_ms, session })
        }
        ToWorker::Refused { reason } => {
            Message::Refused(v1::Refused { reason: reason_to_wire(reason) })
        }
        ToWorker::Scene(scene) => Message::Scene(scene_to_wire(scene)),
        ToWorker::Frame { frame, scene, view, finish, plain } => Message::Frame(v1::Frame {
            frame: frame.0,
            scene: scene.0,
            view: Some(view_to_wire(view)),
            finish: finish.map(|finish| v1::Finish {
                format: format_to_wire(finish.format),
                background: Some(background_to_wire(finish.background)),
            }),
            plain: *plain,
        }),
        ToWorker::Directory { set, grid, first, total, bricks } => {
            return Down::Parts(directory_to_wire(set, *grid, (*first, *total), bricks));
        }
        ToWorker::Lease(lease) => Message::Lease(lease_to_wire(lease)),
        ToWorker::Region(lease) => Message::Region(region_to_wire(lease)),
        ToWorker::HandOver { frame, task, epoch, share } => Message::HandOver(v1::HandOver {
            frame: frame.0,
            task: task.0,
            epoch: epoch.0,
            share: *share,
        }),
        ToWorker::EndFrame { frame } => Message::EndFrame(v1::EndFrame { frame: frame.0 }),
        ToWorker::EndScene { scene } => Message::EndScene(v1::EndScene { scene: scene.0 }),
        ToWorker::DropBricks { set, bricks } => return Down::Bricks(drop_to_wire(set, bricks)),
        ToWorker::Ping { nonce } => Message::Ping(v1::Ping { nonce: *nonce }),
        ToWorker::Leave { reason } => Message::Leave(v1::Leave { reason: reason_to_wire(reason) }),
    };
    Down::Control(v1::ToWorker { message: Some(message) })
}

/// A message of the master from Control, or the field that is wrong. The session comes with
/// `Welcome` and only with it.
pub fn to_worker_from_wire(message: v1::ToWorker) -> Result<(ToWorker, Option<u64>), WireError> {
    use v1::to_worker::Message;
    let message = match required("message", message.message)? {
        Message::Welcome(welcome) => {
            let v1::Welcome { worker, heartbeat_ms, session } = welcome;
            if !(1..=600_000).contains(&heartbeat_ms) {
                return Err(WireError::value(
                    "welcome.heartbeat_ms",
                    format!("{heartbeat_ms}; give 1 to 600000"),
                ));
            }
            let message = ToWorker::Welcome { worker: WorkerId(worker), heartbeat_ms };
            return Ok((message, Some(session_from_wire("welcome.session", session)?)));
        }
        Message::Refused(refused) => {
            ToWorker::Refused { reason: reason_from_wire("refused.reason", refused.reason)? }
        }
        Message::Scene(scene) => {
            ToWorker::Scene(Arc::new(scene_from_wire(scene).map_err(|e| e.within("scene"))?))
        }
        Message::Frame(frame) => ToWorker::Frame {
            frame: FrameId(frame.frame),
            scene: SceneId(frame.scene),
            view: view_from_wire(required("frame.view", frame.view)?)
                .map_err(|e| e.within("frame.view"))?,
            finish: frame
                .finish
                .map(|finish| finish_from_wire(finish).map_err(|e| e.within("frame.finish")))
                .transpose()?,
            plain: frame.plain,
        },
        Message::Lease(lease) => {
            ToWorker::Lease(Box::new(lease_from_wire(lease).map_err(|e| e.within("lease"))?))
        }
        Message::Directory(directory) => {
            directory_from_wire(directory).map_err(|e| e.within("directory"))?
        }
        Message::Region(lease) => {
            ToWorker::Region(region_from_wire(lease).map_err(|e| e.within("region"))?)
        }
        Message::HandOver(hand) => {
            let v1::HandOver { frame, task, epoch, share } = hand;
            if !(1..=999).contains(&share) {
                return Err(WireError::value("hand_over.share", format!("{share}; give 1 to 999")));
            }
            let (frame, task, epoch) = (FrameId(frame), TaskId(task), Epoch(epoch));
            ToWorker::HandOver { frame, task, epoch, share }
        }
        Message::EndFrame(end) => ToWorker::EndFrame { frame: FrameId(end.frame) },
        Message::EndScene(end) => ToWorker::EndScene { scene: SceneId(end.scene) },
        Message::Ping(ping) => ToWorker::Ping { nonce: ping.nonce },
        Message::Leave(leave) => {
            ToWorker::Leave { reason: reason_from_wire("leave.reason", leave.reason)? }
        }
    };
    Ok((message, None))
}

fn finish_from_wire(finish: v1::Finish) -> Result<Finish, WireError> {
    Ok(Finish {
        format: format_from_wire("format", finish.format)?,
        background: background_from_wire(required("background", finish.background)?)?,
    })
}

fn lease_to_wire(lease: &Lease) -> v1::Lease {
    let n = lease.tile.area();
    assert_eq!(lease.state.a.len(), n, "A has its tile's size");
    assert!(lease.tile.x0 >= 0 && lease.tile.y0 >= 0, "tiles lie inside the picture");
    v1::Lease {
        task: lease.task.0,
        epoch: lease.epoch.0,
        frame: lease.frame.0,
        x: lease.tile.x0 as u32,
        y: lease.tile.y0 as u32,
        width: lease.tile.width() as u32,
        height: lease.tile.height() as u32,
        first_sheet: lease.slab.first,
        end_sheet: lease.slab.end,
        bricks: Some(bricks_to_wire(&lease.bricks)),
        a: Some(a_to_wire(&lease.state.a)),
        last: last_to_wire(&lease.state.last, n),
    }
}

/// A tile that lies inside some picture.
fn tile_from_wire(x: u32, y: u32, width: u32, height: u32) -> Result<Rect, WireError> {
    for (from, length, at, n) in [("x", "width", x, width), ("y", "height", y, height)] {
        if at >= MAX_EDGE {
            return Err(WireError::value(from, format!("{at}; pictures have {MAX_EDGE} pixels")));
        }
        if n == 0 || n > MAX_EDGE - at {
            return Err(WireError::value(length, format!("{n}; give 1 to {}", MAX_EDGE - at)));
        }
    }
    let n = width as usize * height as usize;
    if n > MAX_TILE_PIXELS {
        return Err(WireError::too_long("width, height", n, MAX_TILE_PIXELS));
    }
    let (x0, y0) = (x as i32, y as i32);
    Ok(Rect::new(x0, y0, x0 + width as i32, y0 + height as i32))
}

fn lease_from_wire(lease: v1::Lease) -> Result<Lease, WireError> {
    let tile = tile_from_wire(lease.x, lease.y, lease.width, lease.height)?;
    let n = tile.area();
    if lease.first_sheet >= lease.end_sheet {
        return Err(WireError::value("end_sheet", "is not behind first_sheet"));
    }
    let bricks = bricks_list_from_wire("bricks", lease.bricks)?;
    if bricks.windows(2).any(|w| w[0] >= w[1]) {
        return Err(WireError::value("bricks", "do not ascend"));
    }
    Ok(Lease {
        task: TaskId(lease.task),
        epoch: Epoch(lease.epoch),
        frame: FrameId(lease.frame),
        tile,
        slab: SheetRange::new(lease.first_sheet, lease.end_sheet),
        bricks,
        state: TileState { a: a_from_wire(lease.a, n)?, last: last_from_wire(lease.last, n)? },
    })
}

fn region_to_wire(lease: &RegionLease) -> v1::Region {
    assert!(lease.tile.x0 >= 0 && lease.tile.y0 >= 0, "tiles lie inside the picture");
    v1::Region {
        task: lease.task.0,
        epoch: lease.epoch.0,
        frame: lease.frame.0,
        x: lease.tile.x0 as u32,
        y: lease.tile.y0 as u32,
        width: lease.tile.width() as u32,
        height: lease.tile.height() as u32,
        estimate: lease.estimate,
        begun: lease.begun.as_ref().map(|begun| begun_to_wire(begun)),
    }
}

fn region_from_wire(lease: v1::Region) -> Result<RegionLease, WireError> {
    let tile = tile_from_wire(lease.x, lease.y, lease.width, lease.height)?;
    let begun = lease.begun.map(|begun| begun_from_wire(begun, tile));
    Ok(RegionLease {
        task: TaskId(lease.task),
        epoch: Epoch(lease.epoch),
        frame: FrameId(lease.frame),
        tile,
        estimate: lease.estimate,
        begun: begun.transpose().map_err(|e| e.within("begun"))?.map(Arc::new),
    })
}

fn begun_to_wire(begun: &Begun) -> v1::Begun {
    let (p, n) = (&begun.pixels, begun.pixels.a.len());
    assert_eq!(p.colour.len(), n, "colour has its tile's size");
    v1::Begun {
        parts: begun.sheets.iter().map(|&sheet| v1::PartBegun { sheet }).collect(),
        a: Some(a_to_wire(&p.a)),
        colour: Some(plane::to_wire(n, |i| p.colour[i])),
        last: last_to_wire(&p.last, n),
    }
}

fn begun_from_wire(begun: v1::Begun, tile: Rect) -> Result<Begun, WireError> {
    let (n, of_tile) = (tile.area(), parts(tile).count());
    if begun.parts.len() != of_tile {
        return Err(WireError::length("parts", begun.parts.len(), of_tile));
    }
    let colour = plane::from_wire(Some(begun.colour.unwrap_or_default()), n, |p: [u32; 3]| p)
        .map_err(|e| e.within("colour"))?;
    let (a, last) = (a_from_wire(begun.a, n)?, last_from_wire(begun.last, n)?);
    let sheets = begun.parts.iter().map(|part| part.sheet).collect();
    Ok(Begun { sheets, pixels: TilePixels { a, colour, last } })
}

fn handed_over_to_wire(piece: &HandedOver) -> v1::HandedOver {
    let rect = |r: Rect| v1::Piece {
        x: r.x0 as u32,
        y: r.y0 as u32,
        width: r.width() as u32,
        height: r.height() as u32,
    };
    v1::HandedOver {
        task: piece.task.0,
        epoch: piece.epoch.0,
        kept: Some(rect(piece.kept)),
        given: Some(rect(piece.given)),
        begun: Some(begun_to_wire(&piece.begun)),
    }
}

fn handed_over_from_wire(piece: v1::HandedOver) -> Result<HandedOver, WireError> {
    let rect = |name, rect: Option<v1::Piece>| {
        let v1::Piece { x, y, width, height } = required(name, rect)?;
        tile_from_wire(x, y, width, height).map_err(|e| e.within(name))
    };
    let (kept, given) = (rect("kept", piece.kept)?, rect("given", piece.given)?);
    let begun = begun_from_wire(required("begun", piece.begun)?, given);
    Ok(HandedOver {
        task: TaskId(piece.task),
        epoch: Epoch(piece.epoch),
        kept,
        given,
        begun: begun.map_err(|e| e.within("begun"))?,
    })
}

/// Bricks of one message of a directory: some 100 KB, a millisecond at 1 Gb/s. At double, pings and
/// leases wait twice as long behind it; at half it is twice as many messages of a job's first frame.
const DIRECTORY_PART: usize = 8192;

fn directory_to_wire(
    set: &BrickSetKey,
    grid: BrickGrid,
    (first, total): (u32, u32),
    bricks: &[BrickInfo],
) -> Vec<v1::ToWorker> {
    let word = |b: &BrickInfo| {
        let local = |at: [u32; 3]| at.iter().rev().fold(0, |word, x| (word << 3) | (x % BRICK));
        local(b.tight.lo) | local(b.tight.hi) << 9 | (u32::from(b.voxels) - 1) << 18
    };
    let part = |(i, bricks): (usize, &[BrickInfo])| {
        let ids: Vec<BrickId> = bricks.iter().map(|b| b.id).collect();
        let boxes: Vec<u8> = bricks.iter().flat_map(|b| word(b).to_le_bytes()).collect();
        let directory = v1::Directory {
            set: key_to_wire(set),
            grid: grid.dims.to_vec(),
            first: first + (i * DIRECTORY_PART) as u32,
            total,
            bricks: Some(bricks_to_wire(&ids)),
            boxes: boxes.into(),
            sizes: bricks.iter().map(|b| b.bytes).collect(),
        };
        v1::ToWorker { message: Some(v1::to_worker::Message::Directory(directory)) }
    };
    bricks.chunks(DIRECTORY_PART).enumerate().map(part).collect()
}

fn directory_from_wire(directory: v1::Directory) -> Result<ToWorker, WireError> {
    let Ok(dims) = <[u32; 3]>::try_from(directory.grid.as_slice()) else {
        return Err(WireError::length("grid", directory.grid.len(), 3));
    };
    let cells = dims.iter().try_fold(1u64, |n, &d| n.checked_mul(d.into()));
    if !cells.is_some_and(|n| (1..=MAX_BRICKS).contains(&n)) {
        return Err(WireError::value("grid", format!("{dims:?}; give 1 to 2^27 bricks")));
    }
    let grid = BrickGrid { dims };
    if u64::from(directory.total) > MAX_BRICKS {
        return Err(WireError::too_long("total", directory.total as usize, MAX_BRICKS as usize));
    }
    let ids = bricks_list_from_wire("bricks", directory.bricks)?;
    let n = ids.len();
    if n > DIRECTORY_PART {
        return Err(WireError::too_long("bricks", n, DIRECTORY_PART));
    }
    if u64::from(directory.first) + n as u64 > u64::from(directory.total) {
        return Err(WireError::value("first", "goes beyond total"));
    }
    if ids.windows(2).any(|w| w[0] >= w[1]) {
        return Err(WireError::value("bricks", "do not ascend"));
    }
    if ids.last().is_some_and(|id| id.0 as usize >= grid.len()) {
        return Err(WireError::value("bricks", "lie outside the grid"));
    }
    let boxes = &directory.boxes;
    if boxes.len() != 4 * n {
        return Err(WireError::length("boxes", boxes.len(), 4 * n));
    }
    if directory.sizes.len() != n {
        return Err(WireError::length("sizes", directory.sizes.len(), n));
    }
    let words = boxes.as_chunks::<4>().0.iter().map(|b| u32::from_le_bytes(*b));
    let bricks = ids.into_iter().zip(words).zip(directory.sizes).map(|((id, word), bytes)| {
        let corner = grid.corner(id);
        let local =
            |from: u32| std::array::from_fn(|a| corner[a] + (word >> (from + 3 * a as u32) & 7));
        let tight = TightBox { lo: local(0), hi: local(9) };
        let voxels = (word >> 18) + 1;
        if voxels as usize > BRICK_VOXELS || (0..3).any(|a| tight.lo[a] > tight.hi[a]) {
            return Err(WireError::value("boxes", format!("brick {id} has a box that is none")));
        }
        if !(1..=MAX_BRICK_BYTES).contains(&bytes) {
            let problem = format!("brick {id} of {bytes} bytes; give 1 to {MAX_BRICK_BYTES}");
            return Err(WireError::value("sizes", problem));
        }
        Ok(BrickInfo { id, tight, voxels: voxels as u16, bytes })
    });
    Ok(ToWorker::Directory {
        set: key_from_wire("set", &directory.set)?,
        grid,
        first: directory.first,
        total: directory.total,
        bricks: bricks.collect::<Result<Vec<_>, _>>()?.into(),
    })
}

// ---------------------------------------------------------------------------------------------
// Bricks

/// Bytes of the longest encoding: a head of 7, 512 voxels of value (4), normal (2) and gradient (1),
/// and a checksum of 4.
const MAX_BRICK_BYTES: u32 = 7 + 512 * (4 + 2 + 1) + 4;

fn session_from_wire(field: &str, session: u64) -> Result<u64, WireError> {
    match session {
        0 => Err(WireError::missing(field)),
        session => Ok(session),
    }
}

/// The first message of a worker's Bricks stream.
pub fn bricks_open_to_wire(session: u64) -> v1::BricksUp {
    v1::BricksUp { message: Some(v1::bricks_up::Message::Open(v1::BricksOpen { session })) }
}

/// The session that a Bricks stream belongs to.
pub fn bricks_open_from_wire(message: v1::BricksUp) -> Result<u64, WireError> {
    let v1::bricks_up::Message::Open(open) = required("message", message.message)?;
    session_from_wire("open.session", open.session)
}

fn down(message: v1::bricks_down::Message) -> v1::BricksDown {
    v1::BricksDown { message: Some(message) }
}

/// Encoded bricks of a set (`Brick::encode`) as messages of at most
/// [`MAX_BRICKS_MESSAGE`] bytes. Bricks are passed on, not copied.
pub fn brick_batches_to_wire(
    set: &BrickSetKey,
    bricks: impl IntoIterator<Item = Bytes>,
) -> Vec<v1::BricksDown> {
    // Of the batch: one tag and three bytes of length in `BricksDown`, 2 + 32 of the set. Of a
    // brick: a tag and at most two bytes of length (a brick has at most 3595 bytes).
    const OF_BATCH: usize = 4 + 34;
    const OF_BRICK: usize = 3;
    let set = key_to_wire(set);
    let mut batches: Vec<v1::BrickBatch> = Vec::new();
    let mut bytes = MAX_BRICKS_MESSAGE;
    for brick in bricks {
        let more = OF_BRICK + brick.len();
        if bytes + more > MAX_BRICKS_MESSAGE {
            batches.push(v1::BrickBatch { set: set.clone(), bricks: Vec::new() });
            bytes = OF_BATCH;
        }
        bytes += more;
        batches.last_mut().expect("one was begun").bricks.push(brick);
    }
    batches.into_iter().map(|b| down(v1::bricks_down::Message::Batch(b))).collect()
}

fn drop_to_wire(set: &BrickSetKey, bricks: &[BrickId]) -> Vec<v1::BricksDown> {
    // A difference takes at most five bytes.
    const AT_ONCE: usize = (MAX_BRICKS_MESSAGE - 100) / 5;
    let set = key_to_wire(set);
    let message = |bricks| {
        let bricks = Some(bricks_to_wire(bricks));
        down(v1::bricks_down::Message::Drop(v1::DropBricks { set: set.clone(), bricks }))
    };
    bricks.chunks(AT_ONCE).map(message).collect()
}

/// What came down the Bricks stream, or the field that is wrong.
///
/// A brick whose bytes are not whole is no error of the message: its id goes to `broken`, so
/// that it is sent again. (Should the id be what broke, the brick that it was is missed by the
/// lease that waits for it, which comes back by its deadline.) Bytes too short for an id are
/// refused.
pub fn bricks_from_wire(message: v1::BricksDown) -> Result<Bricks, WireError> {
    use v1::bricks_down::Message;
    match required("message", message.message)? {
        Message::Batch(batch) => {
            let set = key_from_wire("batch.set", &batch.set)?;
            let most = MAX_BRICKS_MESSAGE / 16;
            if batch.bricks.len() > most {
                return Err(WireError::too_long("batch.bricks", batch.bricks.len(), most));
            }
            let mut bricks = Vec::with_capacity(batch.bricks.len());
            let mut broken = Vec::new();
            for (i, bytes) in batch.bricks.iter().enumerate() {
                let wrong =
                    |problem: &str| Err(WireError::value(format!("batch.bricks[{i}]"), problem));
                let decoded = Brick::decode(bytes);
                let name = decoded.as_ref().map_or_else(|_| Brick::name(bytes), |b| Some(b.id));
                match (name, decoded) {
                    (None, _) => return wrong("is too short to have an id"),
                    (Some(id), _) if u64::from(id.0) >= MAX_BRICKS => {
                        return wrong("has an id beyond 2^27");
                    }
                    (Some(_), Ok(brick)) => bricks.push(Arc::new(brick)),
                    (Some(id), Err(_)) => broken.push(id),
                }
            }
            Ok(Bricks::Batch(BrickBatch { set, bricks, broken }))
        }
        Message::Drop(drop) => Ok(Bricks::Message(ToWorker::DropBricks {
            set: key_from_wire("drop.set", &drop.set)?,
            bricks: bricks_list_from_wire("drop.bricks", drop.bricks)?,
        })),
    }
}
