//! The wire, and the only door between its messages and our types.
//!
//! `slabcast/render/v1/*.proto` (clients) and `slabcast/cluster/v1/*.proto` (workers) are the
//! specification; [`render_v1`] and [`cluster_v1`] are what the compiler made of them. Nobody past
//! this crate handles those messages: [`convert`] turns them into our own types or refuses,
//! naming the field, and turns our types into them. [`status`] does the same for errors, and
//! [`sealed`] and [`checked`] find messages that were damaged on their way, before anybody decodes
//! them: on a worker's streams, and between a client and its master.
//!
//! ```
//! use slabcast_common::message::ToMaster;
//! use slabcast_proto::{cluster_v1, convert};
//!
//! // A worker writes,
//! let pong = ToMaster::Pong { nonce: 7, clock_us: 1_000 };
//! let sent: cluster_v1::ControlRequest = convert::from_worker_to_wire(&pong);
//! // and a master reads, or refuses by the name of the field.
//! assert_eq!(convert::from_worker_from_wire(sent), Ok(pong));
//! let empty = cluster_v1::ControlRequest { message: None };
//! let refused = convert::from_worker_from_wire(empty).unwrap_err();
//! assert_eq!(refused.field(), "message");
//! ```
//!
//! This crate refuses to know sockets, tasks and time. What a `.proto` promises about reconnects
//! and silence is kept by `master`, `worker` and `client`.

pub mod checked;
pub mod convert;
pub mod model;
pub mod sealed;
pub mod status;

/// Generated from `slabcast.render.v1`: master and clients.
#[allow(
    missing_docs,
    unreachable_pub,
    clippy::all,
    rustdoc::all,
    reason = "generated; its documentation is the .proto files"
)]
pub mod render_v1 {
    tonic::include_proto!("slabcast.render.v1");
}

/// Generated from `slabcast.cluster.v1`: master and workers.
#[allow(
    missing_docs,
    unreachable_pub,
    clippy::all,
    rustdoc::all,
    reason = "generated; its documentation is the .proto files"
)]
pub mod cluster_v1 {
    tonic::include_proto!("slabcast.cluster.v1");
}

/// Bytes of the compiled `.proto` files with their comments, an encoded `FileDescriptorSet`, for
/// server reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] =
    include_bytes!(concat!(env!("OUT_DIR"), "/slabcast_descriptor.bin"));

/// Largest message of the Control stream in bytes, for `max_decoding_message_size` and
/// `max_encoding_message_size` at both ends.
///
/// The largest is a lease or a result of a full tile: its planes and its bricks. A list of `n`
/// ascending bricks takes a byte each and one more for each gap above 63, of which there are
/// fewer than 2^27 / 64 (and a sixty-fourth of that for gaps above 8191). A scene's transfer
/// function of 65,536 colours and opacities takes 4 MiB. With half of it, a 256x256 tile over two
/// million bricks would be refused; with double, a stranger's hello would be held in twice the
/// memory before it is looked at.
pub const MAX_CONTROL_MESSAGE: usize = {
    let planes = convert::MAX_TILE_PIXELS * 4 * (1 + 3 + 4) + 3 * convert::MAX_TILE_PIXELS / 8;
    let gaps = slabcast_common::brick::MAX_BRICKS as usize / 64;
    let bricks = convert::MAX_BRICK_LIST + gaps + gaps / 64;
    let largest = planes + bricks + 4096;
    assert!(largest < 8 << 20, "a lease of a full tile fits");
    8 << 20
};

/// Largest message of the Bricks stream in bytes: one HTTP/2 frame of 64 KiB with room for headers
/// (docs/design/transport.md section 3: 65,536 bytes are one full frame and a tail of 20 bytes).
pub const MAX_BRICKS_MESSAGE: usize = slabcast_common::link::MAX_BRICK_BATCH_BYTES;

/// Largest message of RenderService in bytes, requests and responses: a path of 38,000 explicit
/// views, or a transfer function of 65,536 points.
///
/// A message costs up to 70 times its bytes in memory when it is made of empty keys, hence no more
/// than this for strangers; turntables and several jobs have no such limit.
pub const MAX_RENDER_MESSAGE: usize = 4 << 20;

/// Largest [`render_v1::WatchFramesResponse`] in bytes that a master sends: a quarter of what
/// `render.proto` promises, since it holds up to three of them for each watcher that reads slowly.
pub const MAX_FRAME_CHUNK: usize = 1 << 18;
