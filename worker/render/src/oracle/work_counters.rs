//! The work of each pixel of a picture: sheets, sections, and the sheet in which it was shut.
//!
//! The serial renderer draws once more and counts ([`crate::oracle::serial`]). So the numbers are
//! the model's, the same on every machine, and not those of one schedule. Culling saves work beyond
//! them; tiles and sheets that nobody reads cost some that is not in them. `crate::work` gets the
//! same numbers fast.

use crate::oracle::serial;
pub use crate::primitives::work_counters::WorkCounters;
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::image::Picture;
use std::sync::Arc;

/// Renders `frame` with the serial oracle from `bricks`, all bricks of its scene, and counts the
/// work of each pixel.
pub fn count_work(frame: &Frame, bricks: &[Arc<Brick>]) -> (Picture, WorkCounters) {
    let mut counters = WorkCounters::new(frame.view.size.map(|n| n as usize));
    let picture = serial::render_counting(frame, bricks, Some(&mut counters));
    (picture, counters)
}
