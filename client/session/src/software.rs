//! Name and version of this program, as output files carry them.

use std::io::Error;

/// Name and version of this program, for programs that show who wrote a file.
pub const SOFTWARE: &str = concat!("slabcast ", env!("CARGO_PKG_VERSION"));

/// Returns an encoder's error as the system's own where there is one, so that a full disk is
/// still known as one.
pub fn io_error(e: png::EncodingError) -> Error {
    match e {
        png::EncodingError::IoError(e) => e,
        other => Error::other(other),
    }
}
