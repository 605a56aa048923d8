//! Which level of detail is enough for the views of a path.

use crate::blocks::halved_lattice;
use slabcast_common::brick::TightBox;
use slabcast_common::level::AUTO_PIXELS;
use slabcast_common::view::View;
use slabcast_common::volume::VolumeInfo;

/// Finds the coarsest level at which a vox covers at most [`AUTO_PIXELS`] in every view of a path.
///
/// One level serves all frames of a job, so that nothing pops from one to the next, and bricks are
/// cut once. The frame that is nearest decides.
#[derive(Debug)]
pub struct AutoLevel<'a> {
    info: &'a VolumeInfo,
    /// Pixels that a vox of `info` covers where a view shows it largest.
    pixels: f64,
}

impl<'a> AutoLevel<'a> {
    /// Begins with no view of the volume `info`.
    pub fn new(info: &'a VolumeInfo) -> Self {
        AutoLevel { info, pixels: 0.0 }
    }

    /// Takes a view of the volume into account.
    pub fn see(&mut self, view: &View) {
        let whole = TightBox::whole(self.info.lattice.dims);
        let pixels = view.largest_scale(&whole).unwrap_or(f64::INFINITY);
        self.pixels = self.pixels.max(pixels);
    }

    /// Returns the level among those that a file has, the finest first; of a volume with one level
    /// [`AutoLevel::level`].
    pub fn level_of(&self, levels: &[VolumeInfo]) -> u32 {
        if levels.len() < 2 {
            return self.level();
        }
        let vox = self.info.lattice.vox();
        let fits = |level: &&VolumeInfo| self.pixels * (level.lattice.vox() / vox) <= AUTO_PIXELS;
        levels.iter().rfind(fits).map_or(self.info.level, |level| level.level.max(self.info.level))
    }

    /// Returns the level, at least that of the volume itself. Colours have no other.
    pub fn level(&self) -> u32 {
        let (vox, mut lattice) = (self.info.lattice.vox(), self.info.lattice);
        let mut level = self.info.level;
        let has_levels = self.info.summary.palette.is_none();
        while has_levels
            && let Some(coarse) = halved_lattice(&lattice)
            && self.pixels * (coarse.vox() / vox) <= AUTO_PIXELS
        {
            (lattice, level) = (coarse, level + 1);
        }
        level
    }
}
