//! What a user asks for, before it is cut into work: transfer functions by name and between keys,
//! colour maps, view paths, cropping boxes, the bricks that a job needs, and the job's request.
//!
//! The command, the client, the master and the wire share this crate; workers and the renderer
//! never see it. They get one transfer function, one view and a set of bricks. Like `common` it
//! has no clock, socket, file or thread.

pub mod brick_needs;
pub mod colour;
pub mod paraview;
pub mod path;
pub mod presets;
pub mod request;
pub mod transfer;
pub mod tween;
