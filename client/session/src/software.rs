//! What files say of the program that wrote them.

use std::io::Error;

/// Name and version of this program, for programs that show who wrote a file.
pub const SOFTWARE: &str = concat!("slabcast ", env!("CARGO_PKG_VERSION"));

/// The system's own error where there is one: the crate's conversion forgets its kind, and a full
/// disk would be no full disk any more.
pub fn io_error(e: png::EncodingError) -> Error {
    match e {
        png::EncodingError::IoError(e) => e,
        other => Error::other(other),
    }
}
