//! The laboratory: measures the error of pictures, their cost, and the behaviour of clusters.
//!
//! One module per subcommand of `slabcast lab`; each has its arguments and a `run` function:
//!
//! - [`error`] measures the error of one picture against the limit of thin sheets.
//! - [`explain`] shows how the samples along one pixel's ray add up to its colour.
//! - [`check`] compares pictures with the oracle over every way to render them.
//! - [`mod@bench`] times the renderer on one scene.
//! - [`report`] sweeps the quality settings and reports error against time.
//! - [`plan`] predicts the frame times of a cluster that does not exist yet.
//! - [`study`] repeats the evaluation of the paper.
//! - [`replay`] repeats the decisions of a recorded scheduler and compares them.
//!
//! [`autotune`] chooses the quality for `render --error` and `--budget`.
//!
//! The crate may use every crate except the command. Of what renders pictures for a user, only
//! `render --error` and `--budget` depend on it.

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
