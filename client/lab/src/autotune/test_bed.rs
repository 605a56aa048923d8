//! Where settings are tried: this process, which has the volume and the reference, or a cluster.

use super::setting::Setting;
use super::trial::Deviation;
use slabcast_session::fail::Fail;
use slabcast_session::progress::Progress;
use slabcast_session::signals;

/// Views that are judged. By three, sheets of 4 vox were taken for bonsai in `peer-semi`, whose error
/// is twice as large from other sides.
pub const VIEWS: usize = 5;
/// Draws a scene in one setting after another and says what comes of it.
pub trait TestBed {
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
    fn off(&mut self, setting: &Setting, progress: &mut Progress) -> Result<Deviation, Fail>;
    /// Milliseconds of a frame.
    fn ms(&mut self, setting: &Setting) -> Result<f64, Fail>;
}

/// Refuses to go on when somebody pressed Ctrl-C.
pub(super) fn stopped() -> Result<(), Fail> {
    if signals::stop_requested() { Err(Fail::failed("stopped while choosing")) } else { Ok(()) }
}
