//! Dispatch of tasks to workers: leases, work stealing and speculative copies.

pub(crate) mod lend;
pub(crate) mod speculate;
pub(crate) mod steal;
