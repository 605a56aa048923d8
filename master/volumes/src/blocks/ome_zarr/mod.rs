//! OME-Zarr: the file with a pyramid. [`convert`] writes it, [`OmeZarrSource`] reads it by chunks.

mod convert;
mod meta;
mod source;
mod write;

pub use convert::{Converted, OnProgress, convert};
pub(crate) use convert::{blocks_again, infos, walk, write as write_pyramid};
pub use source::{OmeZarrSource, level_sizes};
pub(crate) use write::{LevelWriter, packed};

/// Sidecar in the folder of a pyramid that we wrote. It is in an array's folder, whose other files no
/// program looks at.
const SIDECAR: &str = "0/.slabcast-blocks";

#[cfg(test)]
mod tests;
