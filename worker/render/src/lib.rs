//! Image-aligned sheet-based splatting with occlusion culling (paper section 3), on one tile.
//!
//! Two renderers stand side by side:
//! - [`serial`] is the paper's listing, plainly, over a whole frame: every voxel into every
//!   bucket, sheet after sheet, nothing culled. It is the oracle for bytes.
//! - [`tile`] is what workers run: lazy bucket toss, a ring of open sheets, bricks and voxels
//!   tested against the occlusion map. It must give the oracle's bytes, always.
//!
//! [`region`] takes a tile through all depths while bricks are still coming; [`outlook`] looks at no brick
//! that no tile needs.
//!
//! Beside them [`mod@reference`] judges how far both are from the limit: a gather along true rays
//! in f64 that shares none of their arithmetic, and [`closed`] has the pictures that can be
//! worked out on paper, with derived bounds of what rounding may do to them. [`mod@explain`]
//! shows one pixel of theirs sheet by sheet, and [`mod@survey`] what each pixel took.
//!
//! The two share what a pixel *is*: the kernel's profile and sections ([`footprint`]) and the
//! arithmetic of a closing sheet ([`sheet`]). This crate refuses to know threads, networks and
//! clocks; whoever calls it has those.

mod batch;
pub mod closed;
mod deep;
pub mod depths;
pub mod estimate;
pub mod explain;
mod flat;
pub mod footprint;
mod general;
mod leaning;
mod level;
mod mask;
mod model;
pub mod outlook;
mod place;
mod planes;
pub mod reference;
pub mod region;
pub mod scene;
pub mod selftest;
pub mod serial;
pub mod sheet;
pub mod splat;
mod stack;
mod storeys;
pub mod survey;
pub mod tile;

pub use scene::{Frame, Scene};
