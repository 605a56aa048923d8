//! Error against run time: measures quality settings and chooses the one that meets a target.
//!
//! - `setting`: one way to draw a scene (quality, size, light).
//! - `trial`: draws a setting, times it and has the reference judge it.
//! - `pareto`: the Pareto front of many settings and its knee. `report` sweeps them all.
//! - [`choose`](mod@choose): picks a setting for `--error` and `--budget` from a ladder.
//! - `cache`: keeps measurements between runs.
//! - `test_bed`: where settings are tried: this process ([`local_bed`]) or a cluster
//!   ([`cluster_bed`]), which may be the only one with the volume.

mod cache;
pub mod choose;
pub mod cluster_bed;
pub mod local_bed;
pub(crate) mod pareto;
pub(crate) mod setting;
pub(crate) mod test_bed;
pub(crate) mod trial;
