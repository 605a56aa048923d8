//! Tries settings in this process, which has the volume and the reference.

use super::cluster_bed::ClusterRun;
use super::setting::Setting;
use super::test_bed::{TestBed, VIEWS, stopped};
use super::trial::{Deviation, Effort, Trial, Truth};
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::machine;
use slabcast_session::progress::Progress;

/// Pixels of each. The RMSE of half as many differed by a tenth between samples.
const PIXELS: usize = 3072;
/// Seconds for which frames are timed, after the least that make a median.
const SECONDS: f64 = 0.25;

/// What times a frame.
pub enum Clock<'a> {
    /// Plain drawing, as `slabcast lab bench` does.
    Plain(Cut),
    /// A cluster of this process, as `slabcast render` has.
    Cluster(Box<ClusterRun<'a>>),
}

/// This process.
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

    fn crew(&self) -> String {
        match &self.clock {
            Clock::Plain(cut) => format!("{} threads", cut.threads),
            Clock::Cluster(through) => through.crew().into(),
        }
    }

    fn identity(&self) -> String {
        let clock = match &self.clock {
            Clock::Plain(cut) => format!("{cut:?}"),
            Clock::Cluster(through) => through.crew().into(),
        };
        format!("{} {} {clock}", self.trial.identity(), machine::cpu())
    }

    fn keeps_times(&self) -> bool {
        true
    }

    fn off(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail> {
        if self.truths.is_empty() {
            let views = self.trial.views();
            let n = VIEWS.min(views);
            progress.frames((n * PIXELS) as u64, "");
            for i in 0..n {
                let view = (2 * i + 1) * views / (2 * n);
                let told = (&mut *progress, i * PIXELS);
                self.truths.push(self.trial.truth(view, PIXELS, 1, told)?);
                stopped()?;
            }
            progress.phase("trying settings");
        }
        Ok(self.trial.judge(setting, &self.truths, None)?.off)
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        match &self.clock {
            Clock::Plain(cut) => {
                let effort = Effort { cut: *cut, seconds: SECONDS };
                Ok(self.trial.time(setting, effort)?.median)
            }
            Clock::Cluster(through) => through.ms(setting),
        }
    }
}
