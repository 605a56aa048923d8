//! Which pixels are open, which bricks lie over them, and how deep a picture was open before.

pub(crate) mod closing_depth;
pub(crate) mod open_mask;
pub(crate) mod visible_bricks;

pub use closing_depth::ClosingDepths;
pub use visible_bricks::{Directory, VisibleBricks};
