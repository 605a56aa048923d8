//! The interface to try settings, in this process or on a cluster.

use super::setting::Setting;
use super::trial::Deviation;
use slabcast_session::fail::Fail;
use slabcast_session::progress::Progress;
use slabcast_session::signals;

/// Views that are judged. With three, sheets of 4 vox were chosen for bonsai in `peer-semi`, whose
/// error is twice as large from other sides.
pub(crate) const VIEWS: usize = 5;

/// Draws one scene at one setting after another, and measures error and time.
pub trait TestBed {
    /// Returns the setting that the user asked for.
    fn base(&self) -> Setting;
    /// Returns the size of the pictures in pixels: width, height.
    fn size(&self) -> [u32; 2];
    /// Returns a description of what draws, for messages: `2 threads`.
    fn description(&self) -> String;
    /// Returns a text of everything the measurements depend on. Measurements are kept by it.
    fn identity(&self) -> String;
    /// Returns whether frame times, too, may be kept by [`TestBed::identity`].
    fn keeps_times(&self) -> bool;
    /// Returns the error of a setting's pictures against the truth; draws the truth first.
    ///
    /// # Errors
    /// The scene can't be drawn at this setting, the job fails, or the user stopped it.
    fn deviation(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail>;
    /// Returns the median time of a frame in ms.
    ///
    /// # Errors
    /// The scene can't be drawn at this setting, the job fails, or the user stopped it.
    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail>;
}

/// Fails if the user pressed Ctrl-C.
pub(super) fn check_not_stopped() -> Result<(), Fail> {
    if signals::stop_requested() { Err(Fail::failed("stopped while choosing")) } else { Ok(()) }
}
