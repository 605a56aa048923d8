//! The work of each pixel of a picture: sheets, sections, and the sheet in which it was shut.
//!
//! The serial renderer draws once more and counts ([`crate::oracle::serial`]). So the numbers are
//! the model's, the same on every machine, and not those of one schedule. Culling saves work beyond
//! them; tiles and sheets that nobody reads cost some that is not in them.

use crate::oracle::serial;
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::image::Picture;
use slabcast_common::occlusion::Rect;
use std::sync::Arc;

/// Work counts of every pixel, row-major, top row first.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkCounters {
    width: usize,
    /// Number of the sheet after which each pixel was shut; `None` where it stayed open.
    pub shut_in: Vec<Option<i32>>,
    /// Number of sheets that held something at the pixel, up to the one in which it was shut.
    pub sheets: Vec<u32>,
    /// Number of voxel sections added at the pixel, up to the sheet in which it was shut.
    pub sections: Vec<u32>,
    /// Number of the first sheet that held something at any pixel.
    pub first: Option<i32>,
}

/// Renders `frame` with the serial oracle from `bricks`, all bricks of its scene, and counts the
/// work of each pixel.
pub fn count_work(frame: &Frame, bricks: &[Arc<Brick>]) -> (Picture, WorkCounters) {
    count_band(frame, bricks, (0, frame.view.size[1] as i32))
}

/// Returns bands of rows (first, and end) that can be counted apart, `most` at most: one where voxels
/// are classified first.
pub fn bands(frame: &Frame, most: usize) -> Vec<(i32, i32)> {
    let h = frame.view.size[1] as usize;
    let n = if frame.is_field() { most.clamp(1, h) } else { 1 };
    (0..n).map(|i| ((i * h / n) as i32, ((i + 1) * h / n) as i32)).collect()
}

/// Renders a band of [`bands`] and counts the work of its pixels; the others stay empty.
pub fn count_band(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    band: (i32, i32),
) -> (Picture, WorkCounters) {
    let [w, h] = frame.view.size.map(|n| n as usize);
    let mut counters = WorkCounters {
        width: w,
        shut_in: vec![None; w * h],
        sheets: vec![0; w * h],
        sections: vec![0; w * h],
        first: None,
    };
    let picture = serial::render_counting(frame, bricks, Some(&mut counters), band);
    (picture, counters)
}

/// Joins all bands of a frame, given with their rows from the top.
///
/// # Panics
/// There is no band.
pub fn join_bands(bands: Vec<((i32, i32), (Picture, WorkCounters))>) -> (Picture, WorkCounters) {
    let mut bands = bands.into_iter();
    let (_, (mut picture, mut all)) = bands.next().expect("a band");
    for ((first, end), (part, counters)) in bands {
        let rows = first as usize * all.width..end as usize * all.width;
        picture.pixels[rows.clone()].copy_from_slice(&part.pixels[rows.clone()]);
        all.shut_in[rows.clone()].copy_from_slice(&counters.shut_in[rows.clone()]);
        all.sheets[rows.clone()].copy_from_slice(&counters.sheets[rows.clone()]);
        all.sections[rows.clone()].copy_from_slice(&counters.sections[rows]);
        all.first = [all.first, counters.first].into_iter().flatten().min();
    }
    (picture, all)
}

impl WorkCounters {
    /// Returns whether all pixels of `rect` were shut.
    pub(crate) fn all_shut(&self, rect: Rect) -> bool {
        (rect.y0 as usize..rect.y1 as usize).all(|y| {
            let row = &self.shut_in[y * self.width..][rect.x0 as usize..rect.x1 as usize];
            row.iter().all(Option::is_some)
        })
    }

    /// Counts a section that was added to the pixels of `rect`.
    pub(crate) fn add_section(&mut self, rect: Rect) {
        for y in rect.y0 as usize..rect.y1 as usize {
            for i in y * self.width + rect.x0 as usize..y * self.width + rect.x1 as usize {
                self.sections[i] += u32::from(self.shut_in[i].is_none());
            }
        }
    }

    /// Counts sheet `k`, which held something at pixel `i`, as composited there.
    pub(crate) fn add_sheet(&mut self, i: usize, k: i32, shut: bool) {
        self.sheets[i] += 1;
        self.first.get_or_insert(k);
        if shut {
            self.shut_in[i] = Some(k);
        }
    }
}
