//! The laboratory: how far pictures are from the truth, what they cost, and what a cluster would do.
//!
//! - [`error`] measures one picture against the limit, [`explain`] tells why a pixel is as it is,
//!   [`check`] compares pictures with the oracle over every way to make them.
//! - [`bench`] times one scene, [`report`] sweeps quality for error against time, and [`autotune`]
//!   chooses the quality for `--error` and `--budget`.
//! - [`plan`] predicts clusters that are not there, [`study`] repeats the paper's evaluation,
//!   [`replay`] makes a recorded scheduler's decisions again.
//!
//! It sees all other crates but the command. Nothing that renders pictures for a user depends on
//! it, except that `render --error` and `--budget` ask [`autotune`].

mod ablation;
pub mod autotune;
pub mod bench;
mod chart;
pub mod check;
pub mod error;
pub mod explain;
pub mod plan;
mod plot;
pub mod replay;
pub mod report;
mod single_frame;
mod statistics;
pub mod study;
