//! Which pixels are open, which bricks lie over them, and how deep a picture was open before.

#[doc(hidden)]
pub mod closing_depth;
#[doc(hidden)]
pub mod open_mask;
pub(crate) mod visible_bricks;

pub use closing_depth::ClosingDepths;
pub use visible_bricks::{Directory, VisibleBricks};
