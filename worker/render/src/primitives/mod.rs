//! Tables and positions that kernels and geometries share: tables of weights, integer positions,
//! lattice rows, fixed sizes.
//!
//! Imports nothing of this crate but itself.

pub mod field_taps;
pub mod footprint;
pub mod lattice_rows;
pub mod positions;
pub mod profile_table;
pub mod sections;
pub mod sizes;
mod tap;

pub use tap::Tap;
