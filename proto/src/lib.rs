//! The wire, and the only door from wire to types.
//!
//! `slabcast/v1/render.proto` (clients) and `slabcast/v1/cluster.proto` (workers) are the
//! specification; [`v1`] is what the compiler made of them. Nobody past this crate handles
//! those messages: [`convert`] turns them into our own types or refuses, naming the field, and
//! turns our types into them. A link therefore reads as
//! `stream.message() -> convert::from_worker -> master`.
//!
//! This crate refuses to know sockets, tasks and time. What a `.proto` promises about
//! reconnects and silence is kept by `master`, `worker` and `client`.

pub mod convert;
pub mod model;

/// What the compiler made of `slabcast.v1`.
#[allow(
    missing_docs,
    unreachable_pub,
    clippy::all,
    rustdoc::all,
    reason = "generated; its documentation is the .proto files"
)]
pub mod v1 {
    tonic::include_proto!("slabcast.v1");
}

/// The compiled `.proto` files with their comments, for server reflection.
pub const FILE_DESCRIPTOR_SET: &[u8] =
    include_bytes!(concat!(env!("OUT_DIR"), "/slabcast_descriptor.bin"));

/// Largest message of the Control stream, for `max_decoding_message_size` and
/// `max_encoding_message_size` at both ends.
///
/// The largest is a lease or a result of a full tile: its planes and its bricks. A list of `n`
/// ascending bricks takes a byte each and one more for each gap above 63, of which there are
/// fewer than 2^27 / 64 (and a sixty-fourth of that for gaps above 8191). A scene's transfer
/// function is shorter than that for all but some 50,000 points at full precision; more are
/// refused by this limit. With half of it, a 256x256 tile over two million bricks would be
/// refused; with double, a stranger's hello would be held in twice the memory before it is
/// looked at.
pub const MAX_CONTROL_MESSAGE: usize = {
    let planes = convert::MAX_TILE_PIXELS * 4 * (1 + 3 + 4) + 3 * convert::MAX_TILE_PIXELS / 8;
    let gaps = slabcast_common::brick::MAX_BRICKS as usize / 64;
    let bricks = convert::MAX_BRICK_LIST + gaps + gaps / 64;
    let largest = planes + bricks + 4096;
    assert!(largest < 8 << 20, "a lease of a full tile fits");
    8 << 20
};

/// Largest message of the Bricks stream: one HTTP/2 frame of 64 KiB with room for headers
/// (TRANSPORT.md section 3: 65,536 bytes are one full frame and a tail of 20 bytes).
pub const MAX_BRICKS_MESSAGE: usize = slabcast_common::link::MAX_BRICK_BATCH_BYTES;

/// Largest message of the Render service, requests and replies: a path of 38,000 explicit views,
/// or a transfer function of 25,000 points at full precision. A message costs up to 60 times
/// its bytes in memory when it is made of empty views, hence no more than this for strangers;
/// turntables and several jobs have no such limit.
pub const MAX_RENDER_MESSAGE: usize = 4 << 20;

/// Largest [`v1::FrameChunk`], as promised in `render.proto`.
pub const MAX_FRAME_CHUNK: usize = 1 << 20;
