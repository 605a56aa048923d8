//! Looks at each frame for what a person should hear of: blank pictures, failures, rehearsals.

use slabcast_common::stats::FrameStats;
use slabcast_common::volume::{ValueSummary, VolumeInfo};
use slabcast_session::fail::Fail;
use slabcast_session::output::Frame;
use slabcast_session::progress;
use slabcast_session::request::RenderRequest;

/// Watches for blank frames, so that a note can give the reason.
#[derive(Default)]
pub(super) struct FrameCheck {
    blank: Vec<u64>,
    why: Option<String>,
    failed: Vec<u64>,
    rehearsed: bool,
}

impl FrameCheck {
    /// Looks at one frame and its statistics.
    pub(super) fn look(
        &mut self,
        frame: &Frame,
        stats: &FrameStats,
        info: &VolumeInfo,
        request: &RenderRequest,
    ) {
        self.rehearsed |= stats.rehearsed;
        let pixel = frame.format.bytes();
        // Each pixel is the one before it.
        let all_same = frame.bytes.len() < pixel
            || frame.bytes[pixel..] == frame.bytes[..frame.bytes.len() - pixel];
        let (lo, hi) = info.summary.range();
        let tf = request.transfer.name();
        let summary = &info.summary;
        let coarse = stats.level.map(|drawn| drawn.level).filter(|&level| level > info.level);
        let why = if summary.nan + summary.infinite == summary.total() {
            no_value(summary)
        } else if stats.voxels.relevant == 0 && lo == hi {
            let value = number(lo);
            format!("every value of the volume is {value}, and `--tf {tf}` leaves that invisible")
        } else if stats.voxels.relevant == 0 && request.path.crop.is_some() {
            format!("no voxel in the cropping box is visible under `--tf {tf}`; widen --crop")
        } else if let (0, Some(level)) = (stats.voxels.relevant, coarse) {
            format!("no voxel of level {level} is visible under `--tf {tf}`; give a finer --level")
        } else if stats.voxels.relevant == 0 {
            let (lo, hi) = (number(lo), number(hi));
            format!(
                "no voxel is visible under `--tf {tf}` (values go from {lo} to {hi}); try another \
                 --tf, `slabcast info` shows what each would draw"
            )
        } else if !all_same {
            return;
        } else if stats.voxels.splatted == 0 {
            "the volume lies outside the view, or between its pixels; check eye, target and height, or ask for a larger --size".into()
        } else if request.background == slabcast_common::image::Background::Transparent
            || frame.bytes[..pixel.div_ceil(4) * 3].iter().all(|&b| b == 0)
        {
            format!("what is in view is too faint to see; raise the opacities of `--tf {tf}`")
        } else {
            // Filled by one colour, or hidden by a background of its own colour: no mistake of
            // ours to guess.
            return;
        };
        self.blank.push(frame.number);
        self.why.get_or_insert(why);
    }

    /// Warns of blank and rehearsed frames.
    pub(super) fn warn(&self) {
        if self.rehearsed {
            progress::warn(
                "the master rehearses: nothing was drawn, and the pictures are stripes; render on a \
                 master without --rehearse",
            );
        }
        if let Some(why) = &self.why {
            let which = match &self.blank[..] {
                [one] => format!("frame {one} is"),
                many => format!("{} frames are", many.len()),
            };
            progress::warn(&format!("{which} blank: {why}"));
        }
    }

    /// Notes that a frame failed, by its number on the whole path.
    pub(super) fn failed(&mut self, number: u64) {
        self.failed.push(number);
    }

    /// Returns a failure if frames failed.
    pub(super) fn verdict(&self) -> Result<(), Fail> {
        let (first, last) = match &self.failed[..] {
            [] => return Ok(()),
            [first, .., last] => (first, last),
            [one] => (one, one),
        };
        let which = match self.failed.len() {
            1 => format!("frame {first}"),
            n => format!("{n} frames, {first} the first and {last} the last of them,"),
        };
        Err(Fail::failed(format!(
            "{which} failed, and the others are kept; see the workers' logs, then draw what is missing \
             with `--frames {first}..{last} --force`"
        )))
    }
}

/// Returns a number for people: not 300 digits of one.
fn number(x: f64) -> String {
    match x.abs() {
        0.0 | 1e-4..1e9 => format!("{x}"),
        _ => format!("{x:.4e}"),
    }
}

/// Says that a volume has no finite value.
fn no_value(s: &ValueSummary) -> String {
    let what = match (s.nan, s.infinite) {
        (_, 0) => "all voxels are NaN (no value)".to_string(),
        (0, _) => "all voxels are infinite".to_string(),
        (nan, infinite) => format!("{nan} voxels are NaN (no value) and {infinite} infinite"),
    };
    format!("{what}, so there is nothing to draw; look at how the file was made")
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Samples, ValueMap};

    #[test]
    fn volume_without_a_finite_value_is_said_to_have_none() {
        let say = |v: Vec<f32>| {
            no_value(&ValueSummary::from_samples(&Samples::F32(v), ValueMap::IDENTITY))
        };
        assert!(say(vec![f32::NAN; 3]).starts_with("all voxels are NaN (no value), so"));
        assert!(say(vec![f32::INFINITY; 3]).starts_with("all voxels are infinite, so"));
        let both = say(vec![f32::NAN, f32::NEG_INFINITY, f32::NAN]);
        assert!(both.starts_with("2 voxels are NaN (no value) and 1 infinite, so"), "{both}");
    }

    #[test]
    fn numbers_have_few_digits() {
        let texts = [0.0, -3.5, 200.0, 1e300, -2.5e-8].map(number);
        assert_eq!(texts, ["0", "-3.5", "200", "1.0000e300", "-2.5000e-8"]);
    }
}
