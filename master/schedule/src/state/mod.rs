//! State of the scheduler: frames in the making, leases, workers, and which worker holds which
//! brick.

pub(crate) mod audits;
pub(crate) mod brick_orders;
pub(crate) mod cluster;
pub(crate) mod frame;
pub(crate) mod given_up;
pub(crate) mod leases;
pub(crate) mod region_frame;
pub(crate) mod region_tiles;
pub(crate) mod reputation;
pub(crate) mod residency;
pub(crate) mod result_checks;
pub(crate) mod slab_frame;
pub(crate) mod task_queue;
pub(crate) mod worker_map;
pub(crate) mod workers;
