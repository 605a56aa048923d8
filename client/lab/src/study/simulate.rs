//! Clusters of the paper's size: the scheduler itself against virtual workers and links
//! (`slabcast_sim`), with tiles that were drawn and timed here.
//!
//! At two paces. *Here*: tiles take what they took on this machine. *Paper's*: all tiles take so
//! many times longer that one node takes 17 s for a frame, as the paper's did (section 1), so that
//! tiles and links are to each other about as they were in 2000. What messages cost a processor
//! stays as it is here.

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

/// How fast tiles are drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Pace {
    /// As on this machine.
    Here,
    /// As on the paper's nodes, by the factor that makes one frame on one node last 17 s.
    Paper,
}

/// A cluster to be tried.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ask {
    pub(super) schedule: Schedule,
    /// Rendering nodes, of one thread each.
    pub(super) workers: u32,
    pub(super) pace: Pace,
    /// Edge of the tiles; `None`: the quadtree chooses.
    pub(super) tile: Option<u32>,
    /// Whether tiles after each node's first are cut in quarters.
    pub(super) mixed: bool,
}

impl Ask {
    /// Tiles as the quadtree chooses them.
    pub(super) fn of(schedule: Schedule, workers: u32, pace: Pace) -> Ask {
        Ask { schedule, workers, pace, tile: None, mixed: false }
    }
}

/// A frame as a master tells it.
pub(super) type Told = (FrameStats, Vec<Span>);

#[derive(Default)]
struct Listener(Vec<Told>);

impl Observer for Listener {
    fn frame_done(&mut self, _: FrameId, _: Box<FrameState>, stats: FrameStats, spans: Spans) {
        self.0.push((stats, spans.to_vec()));
    }
}

/// A path whose tiles were measured.
pub(super) struct Bed {
    pub(super) jobs: Vec<FrameJob>,
    pub(super) trace: Trace,
    pub(super) link: Link,
    costs: Vec<(Schedule, Costs)>,
}

impl Bed {
    /// Also measures what deciding costs here, on a cluster of `most` workers.
    pub(super) fn new(
        mut jobs: Vec<FrameJob>,
        trace: Trace,
        link: Link,
        schedules: &[Schedule],
        most: u32,
    ) -> Result<Bed, Fail> {
        // Whoever was told to stop has fewer frames.
        jobs.truncate(trace.frames.len());
        let mut bed = Bed { jobs, trace, link, costs: Vec::new() };
        for &schedule in schedules {
            let jobs = bed.under(&Ask::of(schedule, most, Pace::Here));
            let costs = predict::measured_costs(&jobs, &bed.trace, (most, 1))?;
            bed.costs.push((schedule, costs));
        }
        Ok(bed)
    }

    fn under(&self, ask: &Ask) -> Vec<FrameJob> {
        let work = |job: &FrameJob| Work { schedule: ask.schedule, tile: ask.tile, ..job.work };
        self.jobs.iter().map(|job| FrameJob { work: work(job), ..job.clone() }).collect()
    }

    /// A frame alone on one core, in ms.
    pub(super) fn alone_ms(&self, pace: Pace) -> f64 {
        one_core_ms(&self.trace) * self.stretch(pace)
    }

    /// What times are multiplied with.
    pub(super) fn stretch(&self, pace: Pace) -> f64 {
        match pace {
            Pace::Here => 1.0,
            Pace::Paper => paper::ALONE_S * 1e3 / one_core_ms(&self.trace).max(1e-6),
        }
    }

    /// Runs the path on a cluster, one frame after another.
    pub(super) fn run(&self, ask: &Ask) -> Result<Vec<Told>, Fail> {
        self.run_at(ask, self.stretch(ask.pace))
    }

    /// The same at any stretch.
    pub(super) fn run_at(&self, ask: &Ask, stretch: f64) -> Result<Vec<Told>, Fail> {
        let costs =
            self.costs.iter().find(|c| c.0 == ask.schedule).map_or_else(Costs::default, |c| c.1);
        let question =
            Question { threads: 1, link: self.link, cores: None, stretch, mixed: ask.mixed };
        let mut heard = Listener::default();
        let cluster = question.cluster(ask.workers, costs, 1);
        predict::simulate_observed(&self.under(ask), &self.trace, &cluster, &mut heard)?;
        heard.0.sort_by_key(|t| t.0.frame);
        Ok(heard.0)
    }

    /// Several, on some threads of this machine.
    pub(super) fn run_all(&self, asks: &[Ask], threads: usize) -> Result<Vec<Vec<Told>>, Fail> {
        map_parallel(asks.len(), threads, |i, _: &mut ()| self.run(&asks[i])).into_iter().collect()
    }
}
