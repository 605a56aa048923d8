//! What each pixel of a picture took: where it was shut, its sheets and its sections.
//!
//! The serial renderer walks once more and notes what it meets ([`crate::oracle::serial`]): so the numbers
//! are the model's, the same on every machine, and not those of one schedule. Culling saves work
//! beyond them, tiles and sheets that nobody reads cost some that is not in them.

use crate::oracle::serial;
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::image::Picture;
use slabcast_common::occlusion::Rect;
use std::sync::Arc;

/// Notes about every pixel, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkCounters {
    width: usize,
    /// The sheet after which the pixel was shut; `None` where it stayed open.
    pub shut_in: Vec<Option<i32>>,
    /// Sheets that held something there, until it was shut.
    pub sheets: Vec<u32>,
    /// Sections of voxels that were added there, until it was shut.
    pub sections: Vec<u32>,
    /// The first sheet that held something anywhere.
    pub first: Option<i32>,
}

/// Draws a frame from all bricks of its scene, plainly, and takes notes.
pub fn count_work(frame: &Frame, bricks: &[Arc<Brick>]) -> (Picture, WorkCounters) {
    let [w, h] = frame.view.size.map(|n| n as usize);
    let mut notes = WorkCounters {
        width: w,
        shut_in: vec![None; w * h],
        sheets: vec![0; w * h],
        sections: vec![0; w * h],
        first: None,
    };
    let picture = serial::watched(frame, bricks, Some(&mut notes));
    (picture, notes)
}

impl WorkCounters {
    /// A section was added to the pixels of `rect`.
    pub(crate) fn section(&mut self, rect: Rect) {
        for y in rect.y0 as usize..rect.y1 as usize {
            for i in y * self.width + rect.x0 as usize..y * self.width + rect.x1 as usize {
                self.sections[i] += u32::from(self.shut_in[i].is_none());
            }
        }
    }

    /// Sheet `k`, which held something at pixel `i`, was closed there.
    pub(crate) fn closed(&mut self, i: usize, k: i32, shut: bool) {
        self.sheets[i] += 1;
        self.first.get_or_insert(k);
        if shut {
            self.shut_in[i] = Some(k);
        }
    }
}
