//! Directories: the bricks of a set, in parts.

use super::bricks::{ascending_from_wire, brick_ids_to_wire, key_from_wire, key_to_wire};
use super::wire;
use crate::convert::WireError;
use slabcast_common::brick::{
    BRICK_EDGE, BRICK_VOXELS, BrickGrid, BrickInfo, BrickSetKey, MAX_BRICKS, TightBox,
};
use slabcast_common::ids::BrickId;
use slabcast_common::message::ToWorker;

/// Bricks of one message of a directory: some 100 KB, a millisecond at 1 Gb/s. At double, pings and
/// leases wait twice as long behind it; at half it is twice as many messages of a job's first
/// frame.
const DIRECTORY_PART: usize = 8192;

/// Bytes of the longest encoding: a head of 7, 512 voxels of value (4), normal (2) and gradient
/// (1), and a checksum of 4.
const MAX_BRICK_BYTES: u32 = 7 + 512 * (4 + 2 + 1) + 4;

/// Writes `bricks`, which begin at place `first` of a set of `total`.
pub(super) fn to_wire(
    set: &BrickSetKey,
    grid: BrickGrid,
    (first, total): (u32, u32),
    bricks: &[BrickInfo],
) -> Vec<wire::ControlResponse> {
    let word = |b: &BrickInfo| {
        let local =
            |place: [u32; 3]| place.iter().rev().fold(0, |word, x| (word << 3) | (x % BRICK_EDGE));
        local(b.tight.lo) | local(b.tight.hi) << 9 | (u32::from(b.voxels) - 1) << 18
    };
    let part = |(i, bricks): (usize, &[BrickInfo])| {
        let ids: Vec<BrickId> = bricks.iter().map(|b| b.id).collect();
        let boxes: Vec<u8> = bricks.iter().flat_map(|b| word(b).to_le_bytes()).collect();
        let directory = wire::Directory {
            set: key_to_wire(set),
            grid: grid.dims.to_vec(),
            first: first + (i * DIRECTORY_PART) as u32,
            total,
            bricks: Some(brick_ids_to_wire(&ids)),
            boxes: boxes.into(),
            sizes: bricks.iter().map(|b| b.bytes).collect(),
        };
        let message = wire::control_response::Message::Directory(directory);
        wire::ControlResponse { message: Some(message) }
    };
    bricks.chunks(DIRECTORY_PART).enumerate().map(part).collect()
}

pub(super) fn from_wire(directory: wire::Directory) -> Result<ToWorker, WireError> {
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
    let ids = ascending_from_wire("bricks", directory.bricks)?;
    let n = ids.len();
    if n > DIRECTORY_PART {
        return Err(WireError::too_long("bricks", n, DIRECTORY_PART));
    }
    if u64::from(directory.first) + n as u64 > u64::from(directory.total) {
        return Err(WireError::value("first", "goes beyond total"));
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
            |bit: u32| std::array::from_fn(|a| corner[a] + (word >> (bit + 3 * a as u32) & 7));
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
