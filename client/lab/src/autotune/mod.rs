//! Error against run time: what a picture may be drawn with, what that costs, and which of it is
//! worth having.
//!
//! [`setting`] names one way to draw a scene, [`trial`] draws it, times it and has the reference judge
//! it (`slabcast_session::magnify` for pictures that are drawn small), [`pareto`] says which of many no other
//! beats, and where more time stops to pay. `report` sweeps all of it; `--error` and `--budget`
//! [`choose`](mod@choose) from a ladder of settings and keep what they measured ([`cache`]). They do so
//! in a [`test_bed`]: this process ([`local_bed`]), or a cluster ([`cluster_bed`]), whose volume may be elsewhere.

mod cache;
pub mod choose;
pub mod cluster_bed;
pub mod local_bed;
pub(crate) mod pareto;
pub mod setting;
pub mod test_bed;
pub mod trial;
