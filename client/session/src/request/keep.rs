//! `--keep`: what is kept although the scene does not need it.

use slabcast_common::quality::Keep;

/// The flag.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct KeepArgs {
    /// Keep what the scene does not need: empty, normals, gradients
    ///
    /// To see what leaving it out saves. In bricks: empty (voxels that nothing shows), normals
    /// (that nothing shades), gradients (that modulate nothing).
    #[arg(
        long,
        value_name = "WHAT,...",
        value_delimiter = ',',
        value_enum,
        hide_possible_values = true,
        hide_short_help = true
    )]
    keep: Vec<Kept>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Kept {
    Empty,
    Normals,
    Gradients,
}

impl KeepArgs {
    /// Returns the data to keep although the scene does not need them.
    pub fn keep(&self) -> Keep {
        let has = |kept| self.keep.contains(&kept);
        Keep {
            empty: has(Kept::Empty),
            normals: has(Kept::Normals),
            gradients: has(Kept::Gradients),
        }
    }
}
