//! The renderer written plainly, as a reference for the fast one to equal byte for byte.

pub mod explain;
pub mod explain_field;
mod field;
pub mod serial;
pub mod work_counters;
