//! Image-aligned sheet-based splatting with occlusion culling (paper section 3), on one tile.
//!
//! Two renderers stand side by side:
//! - [`oracle::serial`] is the paper's listing, plainly, over a whole frame: every voxel into every
//!   bucket, sheet after sheet, nothing culled. It is the oracle for bytes.
//! - [`tile`] is what workers run: lazy bucket toss, a ring of open sheets, bricks and voxels
//!   tested against the occlusion map. It must give the oracle's bytes, always.
//!
//! [`region`] takes a tile through all depths while bricks are still coming; [`visibility`] looks at no brick
//! that no tile needs.
//!
//! Beside them [`judge::reference`] judges how far both are from the limit: a gather along true rays
//! in f64 that shares none of their arithmetic, and [`judge::analytic`] has the pictures that can be
//! worked out on paper, with derived bounds of what rounding may do to them. [`oracle::explain`]
//! shows one pixel of theirs sheet by sheet, and [`oracle::work_counters`] what each pixel took.
//!
//! The two share what a pixel *is*: the kernel's profile and sections ([`primitives::footprint`]) and the
//! arithmetic of a closing sheet (`kernels::composite`). This crate refuses to know threads, networks and
//! clocks; whoever calls it has those.

pub mod judge;
pub mod oracle;
pub mod region;
pub mod scene;
pub mod selftest;
pub mod tile;
pub mod visibility;

// The rooms below are public for this crate's tests alone.
#[doc(hidden)]
pub mod geometry;
#[doc(hidden)]
pub mod kernels;
#[doc(hidden)]
pub mod part;
#[doc(hidden)]
pub mod primitives;

pub use kernels::Simd;
pub use scene::{Frame, Scene};
