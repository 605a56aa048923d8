//! The request of a user, before it is cut into work: transfer functions by name and between keys,
//! colour maps, view paths, cropping boxes, the bricks that a job needs, and the job's request.
//!
//! The command, the client, the master and the wire share this crate. Workers and the renderer
//! never see it: they get one transfer function, one view and a set of bricks. Like `common` it has
//! no clock, socket, file or thread.
//!
//! ```
//! use slabcast_common::image::{Background, PixelFormat};
//! use slabcast_common::level::LevelChoice;
//! use slabcast_common::quality::{Quality, Work};
//! use slabcast_scene::path::{Turntable, ViewPath};
//! use slabcast_scene::request::{PathRequest, VolumeChoice};
//! use slabcast_scene::transfer::TransferChoice;
//!
//! let turn = Turntable { frames: 36, step: 10.0, ..Turntable::default() };
//! let request = PathRequest {
//!     client_key: "a movie for Monday".into(),
//!     volume: VolumeChoice::Name("head.nii.gz".into()),
//!     level: LevelChoice::Auto,
//!     path: ViewPath::from_turntable([640, 480], turn),
//!     transfer: TransferChoice::Name("bone".into()),
//!     quality: Quality::default(),
//!     work: Work::default(),
//!     format: PixelFormat::Rgb8,
//!     background: Background::Colour([0.0; 3]),
//!     want_trace: false,
//!     want_hash: false,
//! };
//! assert!(request.path.check().is_ok() && request.quality.check().is_ok());
//! assert_eq!(request.path.frames(), 36);
//! ```

pub mod brick_needs;
pub mod colour;
pub mod document;
pub mod levels;
pub mod paraview;
pub mod path;
pub mod presets;
pub mod request;
pub mod transfer;
pub mod tween;
pub mod values;
