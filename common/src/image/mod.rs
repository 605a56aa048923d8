//! Pictures in the making and finished ones.
//!
//! A slab image is a continuation, not a picture of its own (DESIGN.md section 1): a task gets
//! its tile's A and the last sheet's raw sums and goes on; its colour is fixed point and is
//! added to what stood there. So any cut into slabs and tiles gives the same integers.

mod encode;
mod frame;
mod picture;
mod sparse;
mod tile;

pub use encode::{Background, PixelEncoding, PixelFormat};
pub use frame::FrameState;
pub use picture::{Encoded, Picture};
pub use sparse::{FrameAssembler, SparseTile};
pub use tile::{COLOUR_UNIT, LEAF_EDGE, RawSums, TilePixels, TileState};
