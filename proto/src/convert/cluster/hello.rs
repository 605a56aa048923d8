//! The hello of a worker and the master's welcome.

use super::bricks::{
    brick_ids_from_wire, brick_ids_to_wire, key_from_wire, key_to_wire, session_from_wire,
};
use super::{WorkerId, wire};
use crate::convert::{MAX_BRICK_LIST, WireError, name_from_wire, optional_name_from_wire};
use prost::Message as _;
use slabcast_common::message::{Hello, ToWorker};
use slabcast_common::protocol::{MAX_THREADS, ProtocolVersions};

pub(super) fn to_wire(hello: &Hello) -> wire::Hello {
    let mut room = MAX_BRICK_LIST;
    let held = hello
        .held
        .iter()
        .map(|(set, bricks)| {
            let named = &bricks[..bricks.len().min(room)];
            room -= named.len();
            wire::HeldBricks { set: key_to_wire(set), bricks: Some(brick_ids_to_wire(named)) }
        })
        .collect();
    let mut written = wire::Hello {
        min_protocol_version: hello.protocol_versions.oldest,
        max_protocol_version: hello.protocol_versions.newest,
        pixels_version: hello.pixels_version,
        name: hello.name.clone(),
        threads: hello.threads,
        memory_budget_bytes: hello.memory_budget_bytes,
        simd: hello.simd.clone(),
        self_test_sha256: hello.self_test_sha256.clone(),
        held,
        rehearses: hello.rehearses,
        machine: hello.machine.clone(),
        crc32c: 0,
    };
    written.crc32c = crc32c::crc32c(&written.encode_to_vec());
    written
}

/// First version of the protocol whose hello has a checksum.
const CHECKED_SINCE: u32 = 8;

pub(super) fn from_wire(mut hello: wire::Hello) -> Result<Hello, WireError> {
    let crc32c = std::mem::take(&mut hello.crc32c);
    // Fields that a later version adds are not covered, and were dropped when it was decoded.
    let is_checked = hello.max_protocol_version >= CHECKED_SINCE || crc32c != 0;
    if is_checked && crc32c != crc32c::crc32c(&hello.encode_to_vec()) {
        return Err(WireError::value("crc32c", "is false: the hello was damaged on its way"));
    }
    if hello.min_protocol_version > hello.max_protocol_version {
        return Err(WireError::value("max_protocol_version", "is below min_protocol_version"));
    }
    if !(1..=MAX_THREADS).contains(&hello.threads) {
        let problem = format!("{}; give 1 to {MAX_THREADS}", hello.threads);
        return Err(WireError::value("threads", problem));
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
        let bricks = brick_ids_from_wire(&name("bricks"), set.bricks)?;
        bricks_in_all += bricks.len();
        if bricks_in_all > MAX_BRICK_LIST {
            return Err(WireError::too_long("held", bricks_in_all, MAX_BRICK_LIST));
        }
        held.push((key_from_wire(&name("set"), &set.set)?, bricks));
    }
    Ok(Hello {
        protocol_versions: ProtocolVersions {
            oldest: hello.min_protocol_version,
            newest: hello.max_protocol_version,
        },
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

/// The welcome and the session.
pub(super) fn welcome_from_wire(welcome: wire::Welcome) -> Result<(ToWorker, u64), WireError> {
    let wire::Welcome { worker, heartbeat_ms, session, protocol_version } = welcome;
    if !(1..=600_000).contains(&heartbeat_ms) {
        return Err(WireError::value("heartbeat_ms", format!("{heartbeat_ms}; give 1 to 600000")));
    }
    let worker = WorkerId(worker);
    let welcome = ToWorker::Welcome { worker, heartbeat_ms, protocol_version };
    Ok((welcome, session_from_wire("session", session)?))
}
