//! Measures the rate of the link, and the share of its time that bricks and results take.
//!
//! Nobody tells the scheduler how fast the link is; it sees when bricks leave and when workers
//! acknowledge them. From the moment at which some are in flight to any worker until none are, the
//! bytes acknowledged divided by the time are never more than the link carries, and where many
//! leave at once, as for the first frame, they come near. So the **rate** is the highest that was
//! seen: 80 to 101 MB/s at 1 Gbit/s and 900 to 990 at 10, for mri256 on 15 and 32 workers. The
//! bytes of the last frames take a **share** of their time at that rate.
//!
//! Results travel the other way and are judged at the same rate, links being alike either way:
//! until they take a good part of the time, packing them keeps render threads longer than anybody
//! waits for bytes.
//!
//! Sole frames (no other in flight) and overlapping frames are told apart: the time of a sole frame
//! has round trips in it, in which nobody draws.
//!
//! It refuses to forget: it never learns that a link has become slower.

use super::active_set::SETTLE_FRAMES;
use super::signal::{Hysteresis, MovingRatio};
use crate::Micros;

/// Tuning (share of the time): something takes a good part of the link above the first value, until
/// its share falls below the second.
///
/// - Bricks bind sole frames. Then tiles keep one size, since a worker that draws other tiles than
///   before lacks bricks. mri256 at 512x512 has shares of 0.4 to 0.7 at 1 Gbit/s after its first
///   frame and 0.1 to 0.4 at 10.
/// - Results are packed. One and two workers do not pack at 1 Gbit/s, which saves 3 % of a frame of
///   mri256; four and more do, which saves 8 %.
const BUSY_SHARE: [f64; 2] = [0.6, 0.3];

/// Tuning (share of the time): overlapping frames saturate the link above the first value: fewer of
/// them overlap then. Below the second value there is room for prefetch again. At 0.65, paths of
/// overlapping frames take up to a seventh longer on 15 workers.
const SATURATED_SHARE: [f64; 2] = [0.8, 0.1];

/// Observations of the link.
#[derive(Debug)]
pub(crate) struct LinkUse {
    /// Workers with bricks in flight.
    receivers: usize,
    /// Since when any bricks are in flight, and bytes acknowledged since.
    since: Micros,
    acknowledged: u64,
    /// Highest rate seen, in bytes a microsecond.
    rate: f64,
    /// Bytes of bricks and of results since `frame_began`.
    brick_bytes: u64,
    result_bytes: u64,
    /// When the last frame ended, or a sole frame began.
    frame_began: Micros,
    /// Bricks of overlapping frames, bricks of sole frames, results of all.
    overlapping: MovingRatio,
    sole: MovingRatio,
    results: MovingRatio,
    bricks_bind: Hysteresis,
    packs_results: Hysteresis,
    no_room: Hysteresis,
    no_lanes: Hysteresis,
}

impl Default for LinkUse {
    fn default() -> Self {
        let switch = |[on, off]: [f64; 2], is_on| Hysteresis::new(on, off, 0, is_on);
        LinkUse {
            receivers: 0,
            since: 0,
            acknowledged: 0,
            rate: 0.0,
            brick_bytes: 0,
            result_bytes: 0,
            frame_began: 0,
            overlapping: MovingRatio::default(),
            sole: MovingRatio::default(),
            results: MovingRatio::default(),
            bricks_bind: switch(BUSY_SHARE, false),
            // Until the link is known.
            packs_results: switch(BUSY_SHARE, true),
            no_room: switch(SATURATED_SHARE, false),
            no_lanes: Hysteresis::new(SATURATED_SHARE[0], BUSY_SHARE[1], SETTLE_FRAMES, true),
        }
    }
}

/// Load of the link since the frame before ended, or since the frame began if none was in flight.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameLoad {
    /// Time in microseconds.
    pub(crate) frame_us: f64,
    /// Time that bricks sent meanwhile take on the link.
    pub(crate) bricks_us: f64,
}

impl LinkUse {
    /// Notes bricks that leave for a worker. `is_first`: none were in flight to it.
    pub(crate) fn bricks_sent(&mut self, bytes: u64, is_first: bool, now: Micros) {
        self.brick_bytes += bytes;
        if is_first {
            if self.receivers == 0 {
                (self.since, self.acknowledged) = (now, 0);
            }
            self.receivers += 1;
        }
    }

    /// Notes bricks that a worker acknowledged. `is_last`: no more are in flight to it.
    pub(crate) fn bricks_arrived(&mut self, bytes: u64, is_last: bool, now: Micros) {
        self.acknowledged += bytes;
        let time = now.saturating_sub(self.since).max(1);
        self.rate = self.rate.max(self.acknowledged as f64 / time as f64);
        self.receivers -= usize::from(is_last);
    }

    /// Notes the message of a result, by its bytes.
    pub(crate) fn result_arrived(&mut self, bytes: u64) {
        self.result_bytes += bytes;
    }

    /// A frame begins while none is in flight.
    pub(crate) fn frame_begins(&mut self, now: Micros) {
        (self.brick_bytes, self.result_bytes, self.frame_began) = (0, 0, now);
    }

    /// A frame ended. `sole`: no other is in flight.
    pub(crate) fn frame_ended(&mut self, sole: bool, now: Micros) -> FrameLoad {
        let frame_us = now.saturating_sub(self.frame_began) as f64;
        let carried = |bytes: u64| if bytes == 0 { 0.0 } else { bytes as f64 / self.rate };
        let bricks_us = carried(self.brick_bytes).min(frame_us);
        let results_us = carried(self.result_bytes);
        if sole {
            // Each sole frame weighs the same: the first, which is sent all of the view, is long.
            self.sole.add(bricks_us / frame_us.max(1.0), 1.0);
            self.bricks_bind.update(self.sole.value().unwrap_or(0.0));
        } else {
            self.overlapping.add(bricks_us, frame_us);
            let share = self.overlapping.value().unwrap_or(0.0);
            self.no_room.update(share);
            self.no_lanes.update(share);
        }
        if self.rate > 0.0 {
            self.results.add(results_us, frame_us);
            self.packs_results.update(self.results.value().unwrap_or(0.0));
        }
        (self.brick_bytes, self.result_bytes, self.frame_began) = (0, 0, now);
        FrameLoad { frame_us, bricks_us }
    }

    /// Returns the time in microseconds that the bricks sent since the last frame ended take.
    pub(crate) fn bricks_us(&self) -> f64 {
        if self.rate > 0.0 { self.brick_bytes as f64 / self.rate } else { 0.0 }
    }

    /// Whether workers pack their results. They do until the link is known.
    pub(crate) fn packs_results(&self) -> bool {
        self.packs_results.is_on()
    }

    /// Returns the link's rate in bytes a microsecond, if any bricks were acknowledged.
    pub(crate) fn rate(&self) -> Option<f64> {
        (self.rate > 0.0).then_some(self.rate)
    }

    /// Whether sole frames wait for bricks before all.
    pub(crate) fn bricks_bind(&self) -> bool {
        self.bricks_bind.is_on()
    }

    /// Whether bricks of overlapping frames took nearly all of the last frames' time.
    pub(crate) fn is_saturated(&self) -> bool {
        self.overlapping.value().is_some_and(|share| share > SATURATED_SHARE[0])
    }

    /// Whether the link bears that overlapping frames are rendered by lanes of workers in turn.
    pub(crate) fn bears_lanes(&self) -> bool {
        !self.no_lanes.is_on()
    }

    /// Whether there is room for bricks that may not be needed. Unknown, and so false, until a
    /// frame ended.
    pub(crate) fn has_room(&self, sole: bool) -> bool {
        match sole {
            true => self.sole.value().is_some_and(|share| share <= SATURATED_SHARE[0]),
            false => self.overlapping.value().is_some() && !self.no_room.is_on(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ends `n` frames of 2 ms and so many bytes of bricks each on a link of 100 bytes/us.
    fn frames(link: &mut LinkUse, n: usize, bytes: u64, sole: bool) {
        for _ in 0..n {
            link.frame_begins(0);
            link.bricks_sent(bytes, false, 0);
            link.frame_ended(sole, 2_000);
        }
    }

    #[test]
    fn link_rate_never_exceeds_the_link() {
        let (mut link, carries) = (LinkUse::default(), 120.0);
        let mut now = 0;
        for bytes in [3_000_000, 40_000, 300_000] {
            let transfer = 100 + (bytes as f64 / carries) as Micros;
            link.bricks_sent(bytes / 2, true, now);
            link.bricks_sent(bytes / 2, true, now);
            link.bricks_arrived(bytes / 2, true, now + transfer / 2 + 50);
            link.bricks_arrived(bytes / 2, true, now + transfer);
            now += transfer;
        }
        let rate = link.rate().expect("bricks were acknowledged");
        assert!((0.9 * carries..=carries).contains(&rate), "{rate}");
    }

    #[test]
    fn prefetch_stops_on_a_saturated_link_until_it_is_nearly_free() {
        let mut link = LinkUse { rate: 100.0, ..LinkUse::default() };
        assert!(!link.has_room(false) && !link.is_saturated(), "nothing is known");
        frames(&mut link, 1, 190_000, false);
        assert!(!link.has_room(false) && link.is_saturated());
        frames(&mut link, 20, 30_000, false);
        assert!(!link.has_room(false) && !link.is_saturated(), "a share of 0.15 is not enough");
        frames(&mut link, 20, 10_000, false);
        assert!(link.has_room(false));
        frames(&mut link, 20, 150_000, false);
        assert!(link.has_room(false), "a share of 0.75 does not saturate it");
    }

    #[test]
    fn sole_and_overlapping_frames_are_told_apart() {
        let mut link = LinkUse { rate: 100.0, ..LinkUse::default() };
        frames(&mut link, 1, 190_000, true);
        assert!(link.bricks_bind() && !link.has_room(true) && !link.is_saturated());
        frames(&mut link, 9, 90_000, true);
        assert!(link.bricks_bind(), "a share of 0.45 keeps them binding");
        frames(&mut link, 9, 40_000, true);
        assert!(!link.bricks_bind() && link.has_room(true) && !link.has_room(false));
        frames(&mut link, 9, 190_000, false);
        assert!(link.is_saturated() && !link.bricks_bind());
    }

    #[test]
    fn results_are_packed_while_the_link_is_unknown_or_busy() {
        let mut link = LinkUse::default();
        let result = |link: &mut LinkUse, bytes: u64| {
            for _ in 0..20 {
                link.frame_begins(0);
                link.result_arrived(bytes);
                link.frame_ended(true, 2_000);
            }
            link.packs_results()
        };
        assert!(result(&mut link, 100), "the link is unknown");
        link.rate = 100.0;
        assert!(result(&mut link, 90_000), "a share of 0.45, packed");
        assert!(!result(&mut link, 50_000));
        assert!(!result(&mut link, 100_000), "a share of 0.5, as they are");
        assert!(result(&mut link, 130_000));
    }
}
