//! The Bricks stream, and lists of brick ids.

use super::{SEALED_TWICE, digest_from_wire, required, wire};
use crate::MAX_BRICKS_MESSAGE;
use crate::convert::{MAX_BRICK_LIST, WireError};
use bytes::Bytes;
use slabcast_common::brick::{Brick, BrickSetKey, MAX_BRICKS};
use slabcast_common::ids::BrickId;
use slabcast_common::message::{BrickBatch, ToWorker};
use std::sync::Arc;

/// A message of the master from the Bricks stream.
#[expect(clippy::large_enum_variant, reason = "it is taken apart where it comes")]
#[derive(Clone, Debug)]
pub enum Bricks {
    /// Bricks to hold.
    Batch(BrickBatch),
    /// A message that keeps its place among them ([`ToWorker::DropBricks`]).
    Message(ToWorker),
}

pub(super) fn key_to_wire(set: &BrickSetKey) -> Bytes {
    Bytes::copy_from_slice(&set.0.0)
}

pub(super) fn key_from_wire(field: &str, set: &[u8]) -> Result<BrickSetKey, WireError> {
    Ok(BrickSetKey(digest_from_wire(field, set)?))
}

pub(super) fn brick_ids_to_wire(ids: &[BrickId]) -> wire::BrickIds {
    let mut before = 0u32;
    let differences = ids
        .iter()
        .map(|id| {
            let difference = id.0.wrapping_sub(before) as i32;
            before = id.0;
            difference
        })
        .collect();
    wire::BrickIds { differences }
}

/// A list of ids. One that was left out is empty: that is how protobuf writes an empty message's
/// content.
pub(super) fn brick_ids_from_wire(
    field: &str,
    list: Option<wire::BrickIds>,
) -> Result<Vec<BrickId>, WireError> {
    let differences = list.unwrap_or_default().differences;
    if differences.len() > MAX_BRICK_LIST {
        return Err(WireError::too_long(field, differences.len(), MAX_BRICK_LIST));
    }
    let mut id = 0u32;
    differences
        .into_iter()
        .map(|d| {
            id = id.wrapping_add(d as u32);
            if u64::from(id) < MAX_BRICKS {
                Ok(BrickId(id))
            } else {
                Err(WireError::value(field, format!("brick {id}; ids are below {MAX_BRICKS}")))
            }
        })
        .collect()
}

/// A list of ids that ascend.
pub(super) fn ascending_from_wire(
    field: &str,
    list: Option<wire::BrickIds>,
) -> Result<Vec<BrickId>, WireError> {
    let ids = brick_ids_from_wire(field, list)?;
    match ids.windows(2).all(|w| w[0] < w[1]) {
        true => Ok(ids),
        false => Err(WireError::value(field, "do not ascend")),
    }
}

pub(super) fn session_from_wire(field: &str, session: u64) -> Result<u64, WireError> {
    match session {
        0 => Err(WireError::missing(field)),
        session => Ok(session),
    }
}

/// Writes the first message of a worker's Bricks stream.
pub fn bricks_open_to_wire(session: u64) -> wire::BricksRequest {
    let open = wire::bricks_request::Message::Open(wire::BricksOpen { session });
    wire::BricksRequest { message: Some(open) }
}

/// Reads the session that a Bricks stream belongs to from its first message.
///
/// # Errors
/// [`WireError`] names the field that is wrong.
pub fn bricks_open_from_wire(message: wire::BricksRequest) -> Result<u64, WireError> {
    match required("message", message.message)? {
        wire::bricks_request::Message::Open(open) => {
            session_from_wire("open.session", open.session)
        }
        wire::bricks_request::Message::Sealed(_) => Err(WireError::value("sealed", SEALED_TWICE)),
    }
}

fn down(message: wire::bricks_response::Message) -> wire::BricksResponse {
    wire::BricksResponse { message: Some(message) }
}

/// Packs encoded bricks of a set (`Brick::encode`) into messages of at most
/// [`MAX_BRICKS_MESSAGE`](crate::MAX_BRICKS_MESSAGE) bytes, one at a time: an iterator over these
/// messages that holds one of them and no more. Bricks are passed on, not copied.
///
/// ```
/// use bytes::Bytes;
/// use slabcast_proto::convert::BrickBatches;
///
/// let bricks = vec![Bytes::from(vec![5; 3595]); 100];
/// assert_eq!(BrickBatches::new(&Default::default(), bricks).count(), 6);
/// ```
pub struct BrickBatches<I> {
    set: Bytes,
    bricks: I,
    /// The brick that had no room in the message before.
    next: Option<Bytes>,
}

impl<I: Iterator<Item = Bytes>> BrickBatches<I> {
    /// Makes batches of the encoded `bricks` of `set`, in their order.
    pub fn new(set: &BrickSetKey, bricks: impl IntoIterator<IntoIter = I>) -> Self {
        BrickBatches { set: key_to_wire(set), bricks: bricks.into_iter(), next: None }
    }
}

impl<I: Iterator<Item = Bytes>> Iterator for BrickBatches<I> {
    type Item = wire::BricksResponse;

    fn next(&mut self) -> Option<wire::BricksResponse> {
        // A batch adds a tag and three bytes of length in `BricksResponse`, and 2 + 32 bytes of the
        // set. A brick adds a tag and at most two bytes of length (a brick has at most 3595 bytes).
        const OF_BATCH: usize = 4 + 34;
        const OF_BRICK: usize = 3;
        let first = self.next.take().or_else(|| self.bricks.next())?;
        let mut bytes = OF_BATCH + OF_BRICK + first.len();
        let mut batch = vec![first];
        for brick in self.bricks.by_ref() {
            bytes += OF_BRICK + brick.len();
            if bytes > MAX_BRICKS_MESSAGE {
                self.next = Some(brick);
                break;
            }
            batch.push(brick);
        }
        let batch = wire::BrickBatch { set: self.set.clone(), bricks: batch };
        Some(down(wire::bricks_response::Message::Batch(batch)))
    }
}

pub(super) fn drop_to_wire(set: &BrickSetKey, bricks: &[BrickId]) -> Vec<wire::BricksResponse> {
    // A difference takes at most five bytes.
    const AT_ONCE: usize = (MAX_BRICKS_MESSAGE - 100) / 5;
    let set = key_to_wire(set);
    let message = |bricks| {
        let bricks = Some(brick_ids_to_wire(bricks));
        let drop = wire::DropBricks { set: set.clone(), bricks };
        down(wire::bricks_response::Message::Drop(drop))
    };
    bricks.chunks(AT_ONCE).map(message).collect()
}

/// Reads a message of the Bricks stream.
///
/// A brick whose bytes are not whole is no error of the message: its id goes to
/// [`BrickBatch::broken`], so that it is sent again. (Should the id be what broke, the brick that
/// it was is missed by the lease that waits for it, which comes back by its deadline.)
///
/// # Errors
/// [`WireError`] names the field that is wrong; bytes too short for an id are.
pub fn bricks_from_wire(message: wire::BricksResponse) -> Result<Bricks, WireError> {
    use wire::bricks_response::Message;
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
                let name = decoded.as_ref().map_or_else(|_| Brick::peek_id(bytes), |b| Some(b.id));
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
            bricks: brick_ids_from_wire("drop.bricks", drop.bricks)?,
        })),
        Message::Sealed(_) => Err(WireError::value("sealed", SEALED_TWICE)),
    }
}
