//! Help for tests: volumes that are too large for the repository.

use crate::volume;
use slabcast_common::volume::Volume;
use slabcast_scene::path::Orientation;
use std::io::Write;
use std::path::{Path, PathBuf};

/// Returns the path of a file in the data folder beside the repository, `shared/data`.
///
/// If the file is missing, it prints so on stderr, even when the output of tests is captured, and
/// returns `None`: the test ends early.
pub fn data_file(name: &str) -> Option<PathBuf> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data").join(name);
    if file.exists() {
        return Some(file);
    }
    // A direct write: the test harness captures only what the macros print.
    let _ = writeln!(std::io::stderr(), "skipped: needs shared/data ({name})");
    None
}

/// Opens a volume of the data folder with the axis `up` upwards.
///
/// # Panics
/// The file is there but no volume, or `up` is no axis.
pub fn data_volume(name: &str, up: &str) -> Option<(Volume, Orientation)> {
    let file = data_file(name)?;
    let up = up.parse().expect("an axis");
    let orientation = Orientation::new(Some(up), None).expect("axes");
    Some((volume::open(&file).expect("a volume"), orientation))
}
