//! Visibility: pixels that are still open, bricks that lie over them, and the depths at which
//! the previous frame was shut.

#[doc(hidden)]
pub mod closing_depth;
#[doc(hidden)]
pub mod open_mask;
pub(crate) mod visible_bricks;

pub use closing_depth::ClosingDepths;
pub use visible_bricks::{Directory, VisibleBricks};
