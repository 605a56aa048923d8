//! Tries settings in this process, which has the volume and the reference.

use super::cluster_bed::ClusterRun;
use super::setting::Setting;
use super::test_bed::{TestBed, VIEWS, check_not_stopped};
use super::trial::{Deviation, Effort, Trial, Truth};
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::machine;
use slabcast_session::progress::Progress;

/// Pixels judged of each view. With half as many the RMSE differed by a tenth between samples.
const PIXELS: usize = 3072;
/// Seconds for which frames of a setting are timed, once there are enough for a median.
const SECONDS: f64 = 0.25;

/// Method of timing the frames of a setting.
pub enum Clock<'a> {
    /// By plain drawing without a scheduler, as `slabcast lab bench` does.
    Plain(Cut),
    /// By a cluster in this process, as `slabcast render` has.
    Cluster(Box<ClusterRun<'a>>),
}

/// A test bed in this process, judged by the reference.
pub struct LocalBed<'a> {
    trial: Trial,
    clock: Clock<'a>,
    truths: Vec<Truth>,
}

impl<'a> LocalBed<'a> {
    /// Returns a test bed in this process; `clock` times its frames.
    pub fn new(trial: Trial, clock: Clock<'a>) -> LocalBed<'a> {
        LocalBed { trial, clock, truths: Vec::new() }
    }
}

impl TestBed for LocalBed<'_> {
    fn base(&self) -> Setting {
        self.trial.base
    }

    fn size(&self) -> [u32; 2] {
        self.trial.size()
    }

    fn description(&self) -> String {
        match &self.clock {
            Clock::Plain(cut) => format!("{} threads", cut.threads),
            Clock::Cluster(run) => run.description.clone(),
        }
    }

    fn identity(&self) -> String {
        let clock = match &self.clock {
            Clock::Plain(cut) => format!("{cut:?}"),
            Clock::Cluster(run) => run.description.clone(),
        };
        format!("{} {} {clock}", self.trial.identity(), machine::cpu())
    }

    fn keeps_times(&self) -> bool {
        true
    }

    fn deviation(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail> {
        if self.truths.is_empty() {
            let views = self.trial.views();
            let n = VIEWS.min(views);
            progress.frames((n * PIXELS) as u64, "");
            for i in 0..n {
                let view = (2 * i + 1) * views / (2 * n);
                let counter = (&mut *progress, i * PIXELS);
                self.truths.push(self.trial.truth(view, PIXELS, 1, counter)?);
                check_not_stopped()?;
            }
            progress.phase("trying settings");
        }
        Ok(self.trial.judge(setting, &self.truths, None)?.deviation)
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        match &self.clock {
            Clock::Plain(cut) => {
                let effort = Effort { cut: *cut, seconds: SECONDS };
                Ok(self.trial.time(setting, effort)?.median)
            }
            Clock::Cluster(run) => run.ms(setting),
        }
    }
}
