//! Error against run time: what a picture may be drawn with, what that costs, and which of it is
//! worth having.
//!
//! [`setting`] names one way to draw a scene, [`lab`] draws it, times it and has the reference judge
//! it ([`mod@magnify`] for pictures that are drawn small), [`pareto`] says which of many no other
//! beats, and where more time stops to pay. `report` sweeps all of it; `--error` and `--budget`
//! [`choose`](mod@choose) from a ladder of settings and keep what they measured ([`kept`]). They do so
//! in a [`place`]: this process, or a [`cluster`], whose volume may be elsewhere.

pub(crate) mod choose;
pub(crate) mod cluster;
mod kept;
pub(crate) mod lab;
pub(crate) mod magnify;
pub(crate) mod pareto;
pub(crate) mod place;
pub(crate) mod setting;
