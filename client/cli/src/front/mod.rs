//! Error against run time: what a picture may be drawn with, what that costs, and which of it is
//! worth having.
//!
//! [`setting`] names one way to draw a scene, [`lab`] draws it, times it and has the reference judge
//! it ([`mod@magnify`] for pictures that are drawn small), [`pareto`] says which of many no other
//! beats, and where more time stops to pay. `report` sweeps all of it; `--error` and `--budget`
//! [`choose`](mod@choose) from a ladder of settings and keep what they measured ([`kept`]).
//!
//! It refuses to know clusters: what is timed is this machine.

pub(crate) mod choose;
mod kept;
pub(crate) mod lab;
pub(crate) mod magnify;
pub(crate) mod pareto;
pub(crate) mod setting;
