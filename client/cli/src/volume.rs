//! Opening volumes, and the sentence for each way in which that fails.

use crate::fail::Fail;
use slabcast_common::volume::Volume;
use std::path::Path;

/// Opens a file or a `formula:` volume.
pub(crate) fn open(path: &Path) -> Result<Volume, Fail> {
    slabcast_volumes::open(path).map_err(|e| Fail::failed(e.to_string()))
}
