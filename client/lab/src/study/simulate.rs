//! Simulates clusters of the paper's size: runs the scheduler itself against virtual workers and
//! links (`slabcast_sim`), with tiles that were drawn and timed here.
//!
//! There are two paces. *Here*: tiles take the time they took on this machine. *Paper*: tile times
//! are multiplied so that one node takes 17 s for a frame, as in the paper (section 1). The ratio
//! of tile times to links is then about that of 2000. The processor time of messages stays as it is
//! here.

use super::paper;
use crate::plan::predict::{self, Question};
use serde::Serialize;
use slabcast_common::ids::FrameId;
use slabcast_common::image::FrameState;
use slabcast_common::quality::{Schedule, Work};
use slabcast_common::stats::FrameStats;
use slabcast_schedule::{FrameJob, Span, Spans};
use slabcast_session::direct::map_parallel;
use slabcast_session::fail::Fail;
use slabcast_sim::{Costs, Link, Observer, one_core_ms};
use slabcast_trace::Trace;

/// Speed at which tiles are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Pace {
    /// At the speed of this machine.
    Here,
    /// At the speed of the paper's nodes: one frame on one node takes 17 s.
    Paper,
}

/// A cluster to simulate.
#[derive(Clone, Copy, Debug)]
pub(super) struct SimulatedCluster {
    pub(super) schedule: Schedule,
    /// Rendering nodes, of one thread each.
    pub(super) workers: u32,
    pub(super) pace: Pace,
    /// Edge of the tiles in pixels; `None`: the quadtree chooses.
    pub(super) tile: Option<u32>,
    /// Whether tiles after each node's first are cut in quarters.
    pub(super) mixed: bool,
}

impl SimulatedCluster {
    /// Returns a cluster whose tiles the quadtree chooses.
    pub(super) fn new(schedule: Schedule, workers: u32, pace: Pace) -> SimulatedCluster {
        SimulatedCluster { schedule, workers, pace, tile: None, mixed: false }
    }
}

/// Statistics and time spans of a frame, as a master reports them.
pub(super) type FrameReport = (FrameStats, Vec<Span>);

/// Observer that collects the report of each frame.
#[derive(Default)]
struct ReportCollector(Vec<FrameReport>);

impl Observer for ReportCollector {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, spans: Spans) {
        self.0.push((stats, spans.to_vec()));
    }
}

/// A path whose tiles were measured, ready to be simulated.
pub(super) struct MeasuredPath {
    pub(super) jobs: Vec<FrameJob>,
    pub(super) trace: Trace,
    pub(super) link: Link,
    costs: Vec<(Schedule, Costs)>,
}

impl MeasuredPath {
    /// Takes over jobs and trace, and measures the costs of decisions with `most` workers.
    pub(super) fn new(
        mut jobs: Vec<FrameJob>,
        trace: Trace,
        link: Link,
        schedules: &[Schedule],
        most: u32,
    ) -> Result<MeasuredPath, Fail> {
        // After Ctrl-C the trace has fewer frames.
        jobs.truncate(trace.frames.len());
        let mut path = MeasuredPath { jobs, trace, link, costs: Vec::new() };
        for &schedule in schedules {
            let jobs = path.jobs_for(&SimulatedCluster::new(schedule, most, Pace::Here));
            let costs = predict::measured_costs(&jobs, &path.trace, (most, 1))?;
            path.costs.push((schedule, costs));
        }
        Ok(path)
    }

    /// Returns the jobs with the schedule and tiles of a cluster.
    fn jobs_for(&self, cluster: &SimulatedCluster) -> Vec<FrameJob> {
        let work =
            |job: &FrameJob| Work { schedule: cluster.schedule, tile: cluster.tile, ..job.work };
        self.jobs.iter().map(|job| FrameJob { work: work(job), ..job.clone() }).collect()
    }

    /// Returns the time of a frame on one core, in ms.
    pub(super) fn alone_ms(&self, pace: Pace) -> f64 {
        one_core_ms(&self.trace) * self.stretch(pace)
    }

    /// Returns the factor on tile times.
    pub(super) fn stretch(&self, pace: Pace) -> f64 {
        match pace {
            Pace::Here => 1.0,
            Pace::Paper => paper::ALONE_S * 1e3 / one_core_ms(&self.trace).max(1e-6),
        }
    }

    /// Simulates the path on a cluster, one frame after another.
    pub(super) fn run(&self, cluster: &SimulatedCluster) -> Result<Vec<FrameReport>, Fail> {
        self.run_stretched(cluster, self.stretch(cluster.pace))
    }

    /// Simulates the path on a cluster with any factor on tile times.
    pub(super) fn run_stretched(
        &self,
        cluster: &SimulatedCluster,
        stretch: f64,
    ) -> Result<Vec<FrameReport>, Fail> {
        let costs = self
            .costs
            .iter()
            .find(|c| c.0 == cluster.schedule)
            .map_or_else(Costs::default, |c| c.1);
        let question =
            Question { threads: 1, link: self.link, cores: None, stretch, mixed: cluster.mixed };
        let mut reports = ReportCollector::default();
        let virtual_cluster = question.cluster(cluster.workers, costs, 1);
        predict::simulate_observed(
            &self.jobs_for(cluster),
            &self.trace,
            &virtual_cluster,
            &mut reports,
        )?;
        reports.0.sort_by_key(|t| t.0.frame);
        Ok(reports.0)
    }

    /// Simulates the path on several clusters, on `threads` threads of this machine.
    pub(super) fn run_all(
        &self,
        clusters: &[SimulatedCluster],
        threads: usize,
    ) -> Result<Vec<Vec<FrameReport>>, Fail> {
        map_parallel(clusters.len(), threads, |i, _: &mut ()| self.run(&clusters[i]))
            .into_iter()
            .collect()
    }
}
