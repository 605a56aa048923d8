//! Distance, in sheets, that a stalled region looks ahead when it asks for bricks.
//!
//! A region that reaches a sheet for which it lacks bricks asks for those and, in the same message,
//! for bricks of the next sheets that nothing hides yet. Looking far fetches bricks that nearer
//! ones then hide; looking near stalls again a few sheets on. A worker whose other regions keep its
//! threads busy loses nothing by another stall and looks [`AHEAD_SHEETS`] ahead. A worker whose
//! threads idle looks further, and doubles the distance each time the same region stalls:
//! mouse_skull on 15 workers had tiles that stalled 15 times in a frame, for 0.16 ms each
//! (docs/measurements/scaling.md). A scene's first frame lacks every brick; it looks as near as
//! possible, and its waits don't count.

/// Sheets beyond the one that lacks a brick, for a worker whose threads are busy. A brick is 8
/// sheets thick: at 8, regions of mri256 were sent bricks that others then hid (26.8 % of the set
/// held after 18 views; 25.4 % at 5, 25.1 % at 4). In exchange the first view asks 322 times
/// instead of 228.
pub const AHEAD_SHEETS: u32 = 4;

/// First distance in sheets of a worker whose threads idle; doubles with each stall of a region, up
/// to [`MAX_AHEAD_IDLE_SHEETS`]. mri256 on 15 workers of one machine, a later frame: with 4 always,
/// 7.7 % of the set sent and 48 stalls; with 8, 7.4 % and 31; with 16, 8.3 % and 27; with 16 and a
/// factor of four a stall, 9.7 % and 26 (docs/measurements/scaling.md).
const AHEAD_IDLE_SHEETS: u32 = 16;
const MAX_AHEAD_IDLE_SHEETS: u32 = 1024;

/// A worker counts as idle when its threads idled for at least one part in this many of the time
/// that the average remembers. At half and at twice this, frames take as long.
const IDLE_ONE_IN: u64 = 50;

/// Span of the moving average in ns: older waits count half. Below half of it a single wait would
/// weigh too much: one worker alone with mri256, which hardly ever idles, then held up to 26.4 % of
/// the set instead of 25.9 %.
const AVERAGE_NS: u64 = 60_000_000;

/// A worker's look-ahead: a moving average of how long its threads idled for lack of bricks.
#[derive(Clone, Copy, Debug, Default)]
pub struct Lookahead {
    /// Start of the averaging span, on the worker's clock.
    since_ns: u64,
    /// Idle time of all threads within the span, summed.
    idle_ns: u64,
}

impl Lookahead {
    /// Adds `ns` thread-nanoseconds during which threads had nothing to draw while regions lacked
    /// bricks.
    pub fn add_idle_ns(&mut self, ns: u64) {
        self.idle_ns = self.idle_ns.saturating_add(ns);
    }

    /// Returns how many sheets beyond the stalled one a region asks for.
    ///
    /// `now_ns` is the worker's clock, `threads` its render threads, `stalls` how often this region
    /// stalled before. In a scene's first frame (`first_frame`) the average starts anew.
    pub fn sheets(&mut self, now_ns: u64, threads: u32, stalls: u32, first_frame: bool) -> u32 {
        if first_frame {
            *self = Lookahead { since_ns: now_ns, idle_ns: 0 };
            return AHEAD_SHEETS;
        }
        let span_ns = now_ns.saturating_sub(self.since_ns);
        let idles = self.idle_ns > 0
            && IDLE_ONE_IN.saturating_mul(self.idle_ns)
                >= span_ns.max(AVERAGE_NS / 2).saturating_mul(u64::from(threads));
        if span_ns > AVERAGE_NS {
            self.since_ns = now_ns - span_ns / 2;
            self.idle_ns /= 2;
        }
        if idles {
            let doubled = AHEAD_IDLE_SHEETS.saturating_mul(2u32.saturating_pow(stalls));
            doubled.min(MAX_AHEAD_IDLE_SHEETS)
        } else {
            AHEAD_SHEETS
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn idle_workers_look_further_ahead_and_double_it_with_each_stall() {
        const MS: u64 = 1_000_000;
        let mut look = Lookahead::default();
        assert_eq!(look.sheets(10 * MS, 1, 3, false), AHEAD_SHEETS, "never idle");
        look.add_idle_ns(MS / 2);
        assert_eq!(look.sheets(20 * MS, 1, 0, false), AHEAD_SHEETS, "0.5 ms of at least 30");
        look.add_idle_ns(MS / 2);
        assert_eq!(
            [0, 1, 2, 5, 6, 99].map(|n| look.sheets(20 * MS, 1, n, false)),
            [16, 32, 64, 512, 1024, 1024]
        );
        assert_eq!(look.sheets(20 * MS, 8, 0, false), AHEAD_SHEETS, "1 ms of 160");
        // The average forgets.
        assert_eq!(look.sheets(40 * MS, 1, 0, false), AHEAD_IDLE_SHEETS);
        assert_eq!(look.sheets(100 * MS, 1, 0, false), AHEAD_SHEETS);
        look.add_idle_ns(50 * MS);
        assert_eq!(look.sheets(110 * MS, 8, 0, false), AHEAD_IDLE_SHEETS);
        assert_eq!(look.sheets(110 * MS, 8, 0, true), AHEAD_SHEETS);
        assert_eq!(look.sheets(111 * MS, 1, 0, false), AHEAD_SHEETS, "a first frame");
    }
}
