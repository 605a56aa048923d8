//! Where settings are tried: this process, which has the volume and the reference, or a cluster.

use super::cluster::Through;
use super::lab::{Effort, Lab, Off, Truth};
use super::setting::Setting;
use crate::fail::Fail;
use crate::local::Cut;
use crate::machine;
use crate::progress::Progress;
use crate::signals;

/// Views that are judged. By three, sheets of 4 vox were taken for bonsai in `peer-semi`, whose error
/// is twice as large from other sides.
pub(crate) const VIEWS: usize = 5;
/// Pixels of each. The RMSE of half as many differed by a tenth between samples.
const PIXELS: usize = 3072;
/// Seconds for which frames are timed, after the least that make a median.
const SECONDS: f64 = 0.25;

/// Draws a scene in one setting after another and says what comes of it.
pub(crate) trait Place {
    /// What was asked for.
    fn base(&self) -> Setting;
    /// Size of the pictures.
    fn size(&self) -> [u32; 2];
    /// What draws, for messages: `2 threads`.
    fn crew(&self) -> String;
    /// All that what is measured hangs on. What has the same identity is not measured again.
    fn identity(&self) -> String;
    /// Whether times have that identity, too.
    fn keeps_times(&self) -> bool;
    /// How far its pictures are from the truth.
    fn off(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Off, Fail>;
    /// Milliseconds of a frame.
    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail>;
}

/// Refuses to go on when somebody pressed Ctrl-C.
pub(super) fn stopped() -> Result<(), Fail> {
    if signals::told() { Err(Fail::failed("stopped while choosing")) } else { Ok(()) }
}

/// What times a frame.
pub(crate) enum Clock<'a> {
    /// Plain drawing, as `slabcast bench` does.
    Plain(Cut),
    /// A cluster of this process, as `slabcast render` has.
    Cluster(Box<Through<'a>>),
}

/// This process.
pub(crate) struct Here<'a> {
    lab: Lab,
    clock: Clock<'a>,
    truths: Vec<Truth>,
}

impl<'a> Here<'a> {
    pub(crate) fn new(lab: Lab, clock: Clock<'a>) -> Here<'a> {
        Here { lab, clock, truths: Vec::new() }
    }
}

impl Place for Here<'_> {
    fn base(&self) -> Setting {
        self.lab.base
    }

    fn size(&self) -> [u32; 2] {
        self.lab.size()
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
        format!("{} {} {clock}", self.lab.identity(), machine::cpu())
    }

    fn keeps_times(&self) -> bool {
        true
    }

    fn off(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Off, Fail> {
        if self.truths.is_empty() {
            let views = self.lab.views();
            let n = VIEWS.min(views);
            progress.frames((n * PIXELS) as u64, "");
            for i in 0..n {
                let view = (2 * i + 1) * views / (2 * n);
                let told = (&mut *progress, i * PIXELS);
                self.truths.push(self.lab.truth(view, PIXELS, 1, told)?);
                stopped()?;
            }
            progress.stage("trying settings");
        }
        Ok(self.lab.judge(setting, &self.truths, None)?.off)
    }

    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail> {
        match &self.clock {
            Clock::Plain(cut) => {
                let effort = Effort { cut: *cut, seconds: SECONDS };
                Ok(self.lab.time(setting, effort)?.median)
            }
            Clock::Cluster(through) => through.ms(setting),
        }
    }
}
