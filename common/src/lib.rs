//! The paper's words as types.
//!
//! This crate refuses to know clocks, sockets, files and threads. What it holds is shared by the
//! deciding crates (`render`, `schedule`, `volumes`) and by the wire (`proto`): a volume on its
//! lattice, bricks, transfer functions, one camera as a [`view::View`], sheets and slabs, the
//! occlusion map, pictures in the making, and the messages between master and worker.
//!
//! Everything here that ends up in a pixel has one result on every machine: no fused multiply-add,
//! no platform maths library, sums in one order or in integers.
//!
//! ```
//! use slabcast_common::quality::Quality;
//! use slabcast_common::view::{Camera, CameraProjection, View};
//! use slabcast_common::{brick::TightBox, volume::Volume};
//!
//! // A ball of 32 voxels, seen from the front.
//! let volume = Volume::from_fn_u8("ball", [32; 3], |i, j, k| {
//!     let d = [i, j, k].map(|x| x as i32 - 16);
//!     (255 - d.iter().map(|x| x * x).sum::<i32>()).clamp(0, 255) as u8
//! });
//! let camera = Camera {
//!     to_eye: glam::DVec3::Y,
//!     up: glam::DVec3::Z,
//!     target: glam::DVec3::ZERO,
//!     projection: CameraProjection::Ortho { height: 40.0 },
//! };
//! let view = View::new(&volume.lattice, &camera, [64, 64], &Quality::default()).unwrap();
//! // Pixels and sheets that the volume may touch.
//! let projected = view.project(&TightBox::whole(volume.lattice.dims)).unwrap();
//! assert!(projected.rect.width() < 64 && projected.sheets.len() >= 32);
//! ```

pub mod block_set;
pub mod blocks;
pub mod bounds;
pub mod brick;
pub mod crop;
pub mod gradient;
pub mod ids;
pub mod image;
pub mod kernel;
pub mod level;
pub mod link;
pub mod lookahead;
pub mod math;
pub mod message;
pub mod occlusion;
pub mod protocol;
pub mod quality;
pub mod region;
pub mod shade;
pub mod slab;
pub mod spelling;
pub mod stats;
pub mod transfer;
pub mod value_bins;
pub mod view;
pub mod volume;

/// Version of the arithmetic behind the pixels. Two programs that agree on it give the same
/// bytes for the same view; a change of any golden hash raises it (docs/design/contracts.md,
/// Exactness).
pub const PIXELS_VERSION: u32 = 14;

pub use protocol::PROTOCOL_VERSION;

/// SHA-256 of the self-test tile that every worker draws before it says hello
/// (`slabcast_render::selftest`, which also has the test that keeps this constant true).
pub const SELF_TEST_SHA256: &str =
    "ef65e221cc19af0af60a72185a04324d40cf01752986e83fc2176c6a0722d454";
