//! Messages between master and worker (`slabcast.cluster.v1`).

mod bricks;
mod directory;
mod finished;
mod hello;
mod plane;
mod scene;
#[path = "../shared.rs"]
#[allow(clippy::duplicate_mod, reason = "compiled once for each package, as it says")]
mod shared;
mod task;

pub use bricks::{
    BrickBatches, Bricks, bricks_from_wire, bricks_open_from_wire, bricks_open_to_wire,
};
pub use finished::Compression;
pub use scene::{check_view, scene_from_wire, scene_to_wire, view_from_wire, view_to_wire};
pub use task::check_result;

use super::{WireError, digest_from_wire, reason_from_wire, reason_to_wire, required};
use crate::cluster_v1 as wire;
use bricks::{brick_ids_from_wire, brick_ids_to_wire, key_from_wire, key_to_wire};
use prost::Message as _;
use slabcast_common::ids::{Epoch, FrameId, SceneId, TaskId, WorkerId};
use slabcast_common::message::{ToMaster, ToWorker};
use std::sync::Arc;

/// Problem of a message that is sealed where it should have been opened (`crate::sealed`).
const SEALED_TWICE: &str = "is sealed twice, or was not to be sealed";

/// A message for a worker, by the stream that it goes on.
#[expect(clippy::large_enum_variant, reason = "it is taken apart and sent where it is made")]
#[derive(Clone, Debug, PartialEq)]
pub enum Down {
    /// One message on Control.
    Control(wire::ControlResponse),
    /// Messages on Control, one after the other.
    Parts(Vec<wire::ControlResponse>),
    /// Messages on Bricks, in this order: bricks to drop keep their place among the bricks that
    /// are sent.
    Bricks(Vec<wire::BricksResponse>),
}

// ---------------------------------------------------------------------------------------------
// Worker to master

/// Writes a worker's message; finished pixels are compressed where that makes them fewer bytes.
///
/// A hello names at most [`MAX_BRICK_LIST`](super::MAX_BRICK_LIST) held bricks; those beyond are
/// left out, and will be sent again.
///
/// # Panics
/// If a result's planes differ in size: such a result is our own mistake.
pub fn from_worker_to_wire(message: &ToMaster) -> wire::ControlRequest {
    from_worker_to_wire_as(message, Compression::Lz4)
}

/// Writes a worker's message; `compress` says how finished pixels are written. All else is as in
/// [`from_worker_to_wire`].
///
/// # Panics
/// If a result's planes differ in size: such a result is our own mistake.
pub fn from_worker_to_wire_as(message: &ToMaster, compress: Compression) -> wire::ControlRequest {
    use wire::control_request::Message;
    let message = match message {
        ToMaster::Hello(hello) => Message::Hello(hello::to_wire(hello)),
        ToMaster::Result(result) => Message::Result(task::result_to_wire(result, compress)),
        ToMaster::Failed { task, epoch, reason } => Message::Failed(wire::TaskFailed {
            task: task.0,
            epoch: epoch.0,
            reason: reason_to_wire(reason),
        }),
        ToMaster::BricksReceived { set, bricks } => {
            Message::BricksReceived(wire::BricksReceived { set: key_to_wire(set), bricks: *bricks })
        }
        ToMaster::BricksBroken { set, bricks } => Message::BricksBroken(wire::BricksBroken {
            set: key_to_wire(set),
            bricks: Some(brick_ids_to_wire(bricks)),
        }),
        ToMaster::BricksWanted { set, bricks } => Message::BricksWanted(wire::BricksWanted {
            set: key_to_wire(set),
            bricks: Some(brick_ids_to_wire(bricks)),
        }),
        ToMaster::BricksEvicted { set, bricks } => Message::BricksEvicted(wire::BricksEvicted {
            set: key_to_wire(set),
            bricks: Some(brick_ids_to_wire(bricks)),
        }),
        ToMaster::RegionSplit(split) => Message::RegionSplit(task::split_to_wire(split)),
        ToMaster::Pong { nonce, clock_us } => {
            Message::Pong(wire::Pong { nonce: *nonce, clock_us: *clock_us })
        }
        ToMaster::Goodbye { reason } => {
            Message::Goodbye(wire::Goodbye { reason: reason_to_wire(reason) })
        }
    };
    wire::ControlRequest { message: Some(message) }
}

/// Reads a worker's message. A result says how many bytes its message has.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn from_worker_from_wire(message: wire::ControlRequest) -> Result<ToMaster, WireError> {
    use wire::control_request::Message;
    let bytes = message.encoded_len() as u32;
    Ok(match required("message", message.message)? {
        Message::Hello(hello) => {
            ToMaster::Hello(hello::from_wire(hello).map_err(|e| e.within("hello"))?)
        }
        Message::Result(result) => ToMaster::Result(Box::new(
            task::result_from_wire(result, bytes).map_err(|e| e.within("result"))?,
        )),
        Message::Failed(failed) => ToMaster::Failed {
            task: TaskId(failed.task),
            epoch: Epoch(failed.epoch),
            reason: reason_from_wire("failed.reason", failed.reason)?,
        },
        Message::BricksReceived(received) => ToMaster::BricksReceived {
            set: key_from_wire("bricks_received.set", &received.set)?,
            bricks: received.bricks,
        },
        Message::BricksBroken(broken) => ToMaster::BricksBroken {
            set: key_from_wire("bricks_broken.set", &broken.set)?,
            bricks: brick_ids_from_wire("bricks_broken.bricks", broken.bricks)?,
        },
        Message::BricksWanted(wanted) => ToMaster::BricksWanted {
            set: key_from_wire("bricks_wanted.set", &wanted.set)?,
            bricks: brick_ids_from_wire("bricks_wanted.bricks", wanted.bricks)?,
        },
        Message::BricksEvicted(evicted) => ToMaster::BricksEvicted {
            set: key_from_wire("bricks_evicted.set", &evicted.set)?,
            bricks: brick_ids_from_wire("bricks_evicted.bricks", evicted.bricks)?,
        },
        Message::RegionSplit(split) => ToMaster::RegionSplit(Box::new(
            task::split_from_wire(split).map_err(|e| e.within("region_split"))?,
        )),
        Message::Pong(pong) => ToMaster::Pong { nonce: pong.nonce, clock_us: pong.clock_us },
        Message::Goodbye(goodbye) => {
            ToMaster::Goodbye { reason: reason_from_wire("goodbye.reason", goodbye.reason)? }
        }
        Message::Sealed(_) => return Err(WireError::value("sealed", SEALED_TWICE)),
    })
}

// ---------------------------------------------------------------------------------------------
// Master to worker

/// Writes a message for a worker and says which stream it goes on. `session` is written into
/// `Welcome`; other messages do not carry it.
///
/// # Panics
/// If a lease's planes do not have its tile's size: such a lease is our own mistake.
pub fn to_worker_to_wire(message: &ToWorker, session: u64) -> Down {
    use wire::control_response::Message;
    let message = match message {
        ToWorker::Welcome { worker, heartbeat_ms, protocol_version } => {
            Message::Welcome(wire::Welcome {
                worker: worker.0,
                heartbeat_ms: *heartbeat_ms,
                session,
                protocol_version: *protocol_version,
            })
        }
        ToWorker::Refused { reason } => {
            Message::Refused(wire::Refused { reason: reason_to_wire(reason) })
        }
        ToWorker::Scene(scene) => Message::Scene(scene_to_wire(scene)),
        ToWorker::Frame { frame, scene, view, finish, plain, client } => Message::Frame(
            scene::frame_to_wire((*frame, *scene), view, finish.as_ref(), *plain, *client),
        ),
        ToWorker::Directory { set, grid, first, total, bricks } => {
            return Down::Parts(directory::to_wire(set, *grid, (*first, *total), bricks));
        }
        ToWorker::Lease(lease) => Message::Lease(task::lease_to_wire(lease)),
        ToWorker::Region(lease) => Message::Region(task::region_to_wire(lease)),
        ToWorker::SplitRegion { frame, task, epoch, share } => {
            Message::SplitRegion(wire::SplitRegion {
                frame: frame.0,
                task: task.0,
                epoch: epoch.0,
                share_permille: *share,
            })
        }
        ToWorker::EndFrame { frame } => Message::EndFrame(wire::EndFrame { frame: frame.0 }),
        ToWorker::EndScene { scene } => Message::EndScene(wire::EndScene { scene: scene.0 }),
        ToWorker::DropBricks { set, bricks } => {
            return Down::Bricks(bricks::drop_to_wire(set, bricks));
        }
        ToWorker::Ping { nonce } => Message::Ping(wire::Ping { nonce: *nonce }),
        ToWorker::MasterEnding { reason } => {
            Message::MasterEnding(wire::MasterEnding { reason: reason_to_wire(reason) })
        }
    };
    Down::Control(wire::ControlResponse { message: Some(message) })
}

/// Reads a message of the master from Control. The session comes with `Welcome` and only with it.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn to_worker_from_wire(
    message: wire::ControlResponse,
) -> Result<(ToWorker, Option<u64>), WireError> {
    use wire::control_response::Message;
    let message = match required("message", message.message)? {
        Message::Welcome(welcome) => {
            let (welcome, session) =
                hello::welcome_from_wire(welcome).map_err(|e| e.within("welcome"))?;
            return Ok((welcome, Some(session)));
        }
        Message::Refused(refused) => {
            ToWorker::Refused { reason: reason_from_wire("refused.reason", refused.reason)? }
        }
        Message::Scene(scene) => {
            ToWorker::Scene(Arc::new(scene_from_wire(scene).map_err(|e| e.within("scene"))?))
        }
        Message::Frame(frame) => scene::frame_from_wire(frame).map_err(|e| e.within("frame"))?,
        Message::Lease(lease) => {
            ToWorker::Lease(Box::new(task::lease_from_wire(lease).map_err(|e| e.within("lease"))?))
        }
        Message::Directory(directory) => {
            directory::from_wire(directory).map_err(|e| e.within("directory"))?
        }
        Message::Region(region) => {
            ToWorker::Region(task::region_from_wire(region).map_err(|e| e.within("region"))?)
        }
        Message::SplitRegion(split) => {
            let share = split.share_permille;
            if !(1..=999).contains(&share) {
                let field = "split_region.share_permille";
                return Err(WireError::value(field, format!("{share}; give 1 to 999")));
            }
            ToWorker::SplitRegion {
                frame: FrameId(split.frame),
                task: TaskId(split.task),
                epoch: Epoch(split.epoch),
                share,
            }
        }
        Message::EndFrame(end) => ToWorker::EndFrame { frame: FrameId(end.frame) },
        Message::EndScene(end) => ToWorker::EndScene { scene: SceneId(end.scene) },
        Message::Ping(ping) => ToWorker::Ping { nonce: ping.nonce },
        Message::MasterEnding(ending) => ToWorker::MasterEnding {
            reason: reason_from_wire("master_ending.reason", ending.reason)?,
        },
        Message::Sealed(_) => return Err(WireError::value("sealed", SEALED_TWICE)),
    };
    Ok((message, None))
}
