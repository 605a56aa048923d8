//! Tables and positions that kernels and geometries share: tables of weights, integer positions,
//! fixed sizes.
//!
//! Imports nothing of this crate but itself.

pub mod field_taps;
pub mod footprint;
pub mod positions;
pub mod profile_table;
pub mod sections;
pub mod sizes;
mod tap;
pub mod work_counters;

pub use tap::Tap;
