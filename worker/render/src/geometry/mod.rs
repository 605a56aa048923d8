//! The fast paths and the general one: how voxels of each kind of view get into open sheets.
//!
//! | module | views | sums |
//! |---|---|---|
//! | [`ortho`] | orthographic; all sections of a voxel share one footprint | whole numbers |
//! | [`sheared`] | orthographic; the kernel leans, since the lattice is not cubic | whole numbers |
//! | [`perspective`] | perspective | whole numbers |
//! | [`shared_rows`] | level camera: lattice layers are rows of the picture | whole numbers |
//! | [`general`] | all | all |
//!
//! Each fast path says which views it accepts (`ortho::accepts`); `crate::tile` takes the first
//! that does. [`open_sheets`] and [`batch`] are shared by the fast ones.

pub mod batch;
pub mod field;
pub mod general;
pub mod open_sheets;
pub mod ortho;
pub mod perspective;
pub mod shared_rows;
pub mod sheared;
