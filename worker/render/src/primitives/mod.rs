//! What kernels and every geometry work with: tables of weights, integer positions, fixed sizes.
//!
//! Imports nothing of this crate but itself.

pub mod footprint;
pub(crate) mod lattice_rows;
pub(crate) mod positions;
pub(crate) mod profile_table;
pub(crate) mod sizes;
mod tap;

pub use tap::Tap;
