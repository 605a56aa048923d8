//! OME-Zarr pyramids: [`convert`] writes them, [`OmeZarrSource`] reads them by chunks.

mod convert;
mod meta;
mod source;
mod write;

pub use convert::{Converted, OnProgress, convert};
pub(crate) use convert::{blocks_again, infos, walk, write as write_pyramid};
pub use source::{OmeZarrSource, level_sizes};
pub(crate) use write::{LevelWriter, packed};

/// Path of the sidecar in a pyramid that slabcast wrote. It is in an array's folder, where programs
/// look only for metadata and chunks.
const SIDECAR: &str = "0/.slabcast-blocks";

#[cfg(test)]
mod tests;
