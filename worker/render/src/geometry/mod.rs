//! How voxels of each kind of view get into open sheets: one room a kind.
//!
//! | room | views | sums |
//! |---|---|---|
//! | [`ortho`] | orthographic, all sections of a voxel with one footprint | whole numbers |
//! | [`sheared`] | orthographic, kernel leans (lattice not cubic) | whole numbers |
//! | [`perspective`] | perspective | whole numbers |
//! | [`shared_rows`] | the camera level: layers of the lattice are rows of the picture | whole numbers |
//! | [`general`] | all | all |
//!
//! [`open_sheets`] and [`batch`] are shared by the fast ones.

pub mod batch;
pub mod general;
pub mod open_sheets;
pub mod ortho;
pub mod perspective;
pub mod shared_rows;
pub mod sheared;
