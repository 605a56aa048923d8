//! Pictures in the making and finished ones.
//!
//! A slab image is a continuation, not a picture of its own (docs/design/model.md section 1). A
//! task gets its tile's accumulated opacity and the last sheet's raw sums and goes on. Its colour
//! is fixed point and is added to what was there. So every cut into slabs and tiles gives the same
//! integers.
//!
//! From the bottom up: a tile's pixels, their encoding, a tile without its blank leaves, a finished
//! picture, a frame in the making.

mod encode;
mod frame;
mod picture;
mod sparse;
mod tile;

pub use encode::{Background, PixelEncoding, PixelFormat};
pub use frame::FrameState;
pub use picture::{Encoded, Picture};
pub use sparse::{FrameAssembler, SparseTile, SparseTileError};
pub use tile::{COLOUR_UNIT, LEAF_EDGE, RawSums, TilePixels, TileState};
