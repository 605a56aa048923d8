//! Levels of detail: which one a client asks for, and what a frame says of the one that was drawn
//! (docs/design/model.md, Levels of detail).

use crate::brick::TightBox;
use crate::quality::InvalidField;
use crate::view::View;
use crate::volume::VolumeInfo;
use serde::{Deserialize, Serialize};

/// Highest number of a level. Each level has half as many samples as the one before along an axis
/// of at most 2^32 samples at least.
pub const MAX_LEVEL: u32 = 63;

/// Most pixels that a vox may cover at the level that [`LevelChoice::Auto`] draws. Chosen by
/// measured error and time (docs/measurements/performance.md, Levels of detail).
pub const AUTO_PIXELS: f64 = 1.0;

/// Level of detail that a client asks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LevelChoice {
    /// Level of this number, 0 for all detail. If the volume does not have it, the nearest level.
    At(u32),
    /// Coarsest level at which a vox covers at most [`AUTO_PIXELS`] in every view of the job.
    Auto,
}

impl Default for LevelChoice {
    fn default() -> Self {
        LevelChoice::At(0)
    }
}

impl std::fmt::Display for LevelChoice {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            LevelChoice::At(level) => write!(f, "{level}"),
            LevelChoice::Auto => f.write_str("auto"),
        }
    }
}

impl std::str::FromStr for LevelChoice {
    type Err = InvalidField;

    fn from_str(text: &str) -> Result<Self, InvalidField> {
        let level = match text {
            "auto" => return Ok(LevelChoice::Auto),
            number => number.parse().ok().filter(|&level| level <= MAX_LEVEL),
        };
        level.map(LevelChoice::At).ok_or_else(|| {
            let problem =
                format!("`{text}` is no level; give auto, or 0 (all detail) to {MAX_LEVEL}");
            InvalidField::new("level", problem)
        })
    }
}

/// Level of detail of a frame, and what drawing it saved.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LevelStats {
    /// Number of the level; 0 is all detail.
    pub level: u32,
    /// Pixels that a vox of the level covers where the view shows it largest; `null` where the eye
    /// is inside the volume.
    pub pixels_per_vox: Option<f64>,
    /// Number of samples of the level.
    pub samples: u64,
    /// Number of samples of level 0.
    pub finest_samples: u64,
}

impl LevelStats {
    /// Returns the figures of a view of a volume's level.
    pub fn of(volume: &VolumeInfo, view: &View) -> LevelStats {
        let samples = volume.lattice.len() as u64;
        LevelStats {
            level: volume.level,
            pixels_per_vox: view.largest_scale(&TightBox::whole(volume.lattice.dims)),
            samples,
            // Counts are those of level 0.
            finest_samples: if volume.level == 0 { samples } else { volume.summary.total() },
        }
    }
}
