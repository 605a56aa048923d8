//! Image-aligned sheet-based splatting with occlusion culling (paper section 3), on one tile.
//!
//! ```
//! use glam::DVec3;
//! use slabcast_common::image::FrameState;
//! use slabcast_common::occlusion::Rect;
//! use slabcast_common::quality::Quality;
//! use slabcast_common::slab::SheetRange;
//! use slabcast_common::view::{Camera, CameraProjection, View};
//! use slabcast_common::volume::Volume;
//! use slabcast_render::{Frame, Scene, Simd, oracle, selftest, tile};
//!
//! let ball = |i: u32, j: u32, k: u32| {
//!     let r2: i32 = [i, j, k].iter().map(|&n| (n as i32 - 8).pow(2)).sum();
//!     if r2 < 36 { 200 } else { 0 }
//! };
//! let volume = Volume::from_fn_u8("ball", [16; 3], ball);
//! let (bricks, quality, size) = (selftest::bricks_of(&volume), Quality::default(), [48, 48]);
//! let projection = CameraProjection::Ortho { height: 20.0 };
//! let camera = Camera { to_eye: DVec3::Y, up: DVec3::Z, target: DVec3::ZERO, projection };
//! let view = View::new(&volume.lattice, &camera, size, &quality).expect("a valid camera");
//! let frame = Frame::new(Scene::new(&selftest::spec(&volume, quality)).into(), view);
//!
//! let (picture, mut scratch) = (Rect::from_size(size), tile::Scratch::default());
//! let (all, blank) = (SheetRange::new(-20, 20), tile::blank(picture));
//! let (pixels, voxels) =
//!     tile::render(&frame, Simd::detect(), picture, all, &bricks, &blank, &mut scratch);
//! let mut state = FrameState::new(size);
//! state.add_slab_tile(picture, &pixels);
//! assert_eq!(state.to_picture().pixels, oracle::serial::render(&frame, &bricks).pixels);
//! assert!(voxels.splatted > 0);
//! ```
//!
//! Two renderers stand side by side:
//! - [`oracle::serial`] is the paper's listing, plainly, over a whole frame: every voxel into every
//!   bucket, sheet after sheet, nothing culled. It is the oracle for bytes.
//! - [`tile`] is what workers run: lazy bucket toss, a ring of open sheets, bricks and voxels
//!   tested against the occlusion map. It must give the oracle's bytes, always.
//!
//! [`region`] takes a tile through all depths while bricks are still arriving. [`visibility`] says
//! which bricks lie over which part of the picture, and projects those alone that a tile needs.
//!
//! [`judge::reference`] judges how far both are from the limit: a gather along true rays in f64
//! that shares none of their arithmetic. [`judge::analytic`] has pictures in closed form, with
//! derived bounds of what rounding may do to them, and [`judge::error_probe`] estimates a frame's
//! error while it is drawn. [`mod@oracle::explain`] shows one pixel sheet by sheet, and
//! [`work`] counts the work of each pixel, as [`oracle::work_counters`] does plainly.
//!
//! Both renderers share what a pixel *is*: the kernel's profile, sections and footprints
//! (`primitives`) and the arithmetic of compositing a sheet (`kernels::composite`).
//!
//! **Rooms**, from the lowest up; each imports lower ones alone (`tests/render/rooms.rs`):
//! `primitives`, `visibility`, `kernels` (the only one with `unsafe`), `scene`, `part`, `geometry`,
//! `tile`, `region`, `work`; beside them `oracle` and `judge`. **This crate knows no threads, network or
//! clock**; its callers have those.

pub mod judge;
pub mod oracle;
pub mod region;
pub mod scene;
pub mod selftest;
pub mod tile;
pub mod visibility;
pub mod work;

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
