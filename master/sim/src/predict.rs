//! Times of a recorded path on a cluster.

use crate::cluster::VirtualCluster;
use crate::config::{Cluster, Master, WorkerProfile};
use crate::outcome::{DecisionTimes, Observer, Outcome, Unpredictable};
use crate::traced::TracedTiles;
use slabcast_schedule::{Config, FrameJob};
use slabcast_trace::Trace;

/// Simulates a path, its frames one after another, on a cluster. `jobs` are the frames of the trace
/// in its order, with frame ids from 1 and numbers from 0. Returns what came of it, and how long
/// the scheduler decided, if the observer measures that.
///
/// # Errors
/// [`Unpredictable`] if the scheduler wants a tile that was not recorded, or gives a frame up.
///
/// # Panics
/// If frames have other ids or numbers.
pub fn run(
    jobs: &[FrameJob],
    trace: &Trace,
    cluster: &Cluster,
    observer: &mut dyn Observer,
) -> Result<(Outcome, DecisionTimes), Unpredictable> {
    if jobs.len() != trace.frames.len() {
        return Err(Unpredictable::Frames { have: trace.frames.len(), need: jobs.len() });
    }
    for (i, job) in jobs.iter().enumerate() {
        assert_eq!((job.frame.0, job.number), (i as u64 + 1, i as u64), "frames in order");
    }
    let master = Master {
        link: cluster.link,
        costs: cluster.costs,
        shared_cores: cluster.shared_cores,
        frames_in_flight: cluster.frames_in_flight,
        scheduler: Config { mixed: cluster.mixed, ..Config::default() },
        random_batches: false,
    };
    let mut virtual_cluster = VirtualCluster::new(master, TracedTiles::new(trace), observer, 0);
    for _ in 0..cluster.workers {
        virtual_cluster.join(WorkerProfile {
            threads: cluster.threads,
            time_factor: cluster.stretch,
            bytes_per_s: cluster.link.bytes_per_s,
            latency_ns: [cluster.link.latency_ns; 2],
            ..WorkerProfile::default()
        });
    }
    virtual_cluster.queue_path(jobs);
    virtual_cluster.run_path()?;
    Ok(virtual_cluster.into_outcome())
}
