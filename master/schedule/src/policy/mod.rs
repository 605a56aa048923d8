//! Policies of the scheduler: they decide where a picture is cut, who draws which tile, how many
//! workers draw, and which bricks are sent before a worker asks.

pub(crate) mod active_set;
pub(crate) mod assign;
pub(crate) mod cost_history;
pub(crate) mod cost_model;
pub(crate) mod link_use;
pub mod macrotile;
pub(crate) mod makespan;
pub(crate) mod prefetch;
pub(crate) mod signal;
pub(crate) mod slab_borders;
pub(crate) mod tile_size;
