//! The fast paths and the general one: how voxels of each kind of view get into open sheets.
//!
//! | module | views | what sheets hold |
//! |---|---|---|
//! | [`ortho`] | orthographic; all sections of a voxel share one footprint | whole-number sums |
//! | [`field`] | most | planes of a field |
//! | [`general`] | all | all |
//!
//! Each fast path says which views it accepts (`ortho::accepts`); `crate::tile` takes the first
//! that does. [`open_sheets`] is shared by the fast ones.

pub mod field;
pub mod general;
pub mod open_sheets;
pub mod ortho;
