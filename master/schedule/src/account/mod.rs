//! Accounting of a frame: its statistics, its critical path and its spans for a trace.

pub(crate) mod critical_path;
pub(crate) mod ledger;
pub(crate) mod spans;
