//! How many workers draw, where all of them would be done later than some.
//!
//! Whoever draws is sent bricks, and bricks at the border of two workers' tiles are sent to both.
//! So with more workers there is less to draw for each and more to send to all, and from some
//! number on the link binds, or the master's thread, and each one more makes frames come later:
//! mri256 `peer-opaque` at 512x512 and 1 Gbit/s, four in flight, has 430 frames a second on 8
//! workers, 397 on 15, 263 on 32 and 127 on 64 (`slabcast plan --frames 72`, a core that takes 10
//! ms a frame). So the others are **held in reserve**: they are lent nothing and sent nothing,
//! until more are wanted or somebody is lost. With that 32 have 371 and 64 have 356.
//!
//! What binds is not asked, since of the master's thread and of what results take nothing is known
//! here. What is known is how long frames take and how much of that render threads draw. Where they
//! stand still for the most part half of the workers would do, and half of them is tried
//! ([`Level`]); if frames come later then, it is taken back.
//!
//! The **first frame** of a brick set is drawn by [`FIRST`] workers at most. Nobody holds a brick
//! then, and to send a voxel takes longer than to draw it: 5 bytes are 40 ns at 1 Gbit/s, and each
//! goes to several workers. So a first picture is there sooner if few draw it: at 1 Gbit/s mri256's
//! after 44 ms from 16 workers and after 104 from 64, and without a limit after 5 and 10. If their
//! threads have nearly nothing to do all the same, the others are not called.
//!
//! Frames that are alone and frames beside others are told apart, as in `traffic`: of those that
//! are alone all ways and waking are part of the time, in which nobody draws.
//!
//! It refuses to know who is held in reserve (`roster`), and to go on with a number of workers that
//! was not tried.

use crate::Micros;
use slabcast_common::brick::BrickSetKey;

/// Where threads draw for less than this of frames' time half of the workers would do: of frames
/// beside others, and of such as are alone. Without a limit of bandwidth mri256 has 860 frames a
/// second on 64 workers, whose threads draw for 0.14 of the time, and 1340 on 32 (0.44). Of frames
/// alone it takes 1.4 ms on 64 (0.12) and would take as long on 32; at 1 Gbit/s 4.2 and 3.6 (0.04
/// and 0.09). What is less is sent to fewer, so that each change costs bricks: at 0.4 and 0.1 a
/// path of 72 frames was over before that was won back.
const IDLE: [f64; 2] = [0.2, 0.05];

/// The first of them while bricks fill the link, where bricks that a change brings are dearest.
const IDLE_ON_A_FULL_LINK: f64 = 0.15;

/// Where they draw for more than this twice as many are tried. That is far more than twice
/// [`IDLE`], lest the two take turns.
const BUSY: [f64; 2] = [0.85, 0.5];

/// Frames after a change that say nothing: those that had begun, and bricks that the change brings.
const SETTLE: [u32; 2] = [4, 2];

/// Frames that are looked at together. Two crews' frames come in pairs.
const WINDOW: u32 = 6;

/// Where threads draw for less than this part of [`IDLE`], a quarter of the workers is tried at
/// once.
const HARDLY: f64 = 0.5;

/// Fewer workers than this always draw all.
const LEAST: usize = 4;

/// Workers that draw the first frame of a set at most. Half as many would be done with it sooner at
/// 1 Gbit/s (33 ms), but a scene that takes long to draw has all others' bricks to wait for in its
/// second frame.
const FIRST: usize = 16;

/// Where they draw for more than this of the first frame all are called, unless bricks filled the
/// link: whoever is called is sent all that the view needs. Of mri256 on 16 workers it is 0.02 at 1
/// Gbit/s, and without a limit 0.15; of `peer-semi` at 1024x1024 0.07 and 0.5. Where that takes a
/// core 344 ms a frame it is 0.11 at 1 Gbit/s, and when all were called the three frames after the
/// first took 85 ms each on 32 workers and 155 on 64; now they take 28, as on 16.
const CALL: f64 = 0.1;

/// Where that much of it is drawn already they are called before it is done: of `peer-semi` at
/// 1024x1024 it is half at the end.
const CALL_NOW: f64 = 0.25;

/// Taken back is a change after which the same work takes longer by this. Two windows of one path
/// differ by some percent.
const WORSE: f64 = 1.1;

/// Most frames after which what was taken back is tried again.
const PATIENCE: u32 = 4096;

/// Most times that workers are halved: a thousandth of them draws.
const MOST: u32 = 10;

/// Frames of the other kind in a row after which it goes by these. Of a path one is alone now and
/// then, where whoever takes the pictures was late, and to call all for that one would send them
/// bricks.
const OTHERS: u32 = 4;

/// Render threads' time and work over some frames.
#[derive(Clone, Copy, Debug, Default)]
struct Span {
    frames: u32,
    took: f64,
    drew: f64,
    /// Threads that might have drawn, times how long.
    had: f64,
}

impl Span {
    /// Which part of their time threads drew.
    fn busy(&self) -> f64 {
        self.drew / self.had.max(1.0)
    }

    /// How long a frame takes for what is drawn of it.
    fn pace(&self) -> f64 {
        self.took / self.drew.max(1.0)
    }
}

/// How often the workers are halved, for one kind of frames.
#[derive(Clone, Copy, Debug, Default)]
struct Level {
    halved: u32,
    /// Frames since that changed.
    since: u32,
    span: Span,
    /// Before they were halved last, as long as it is not known whether that was good.
    before: Option<f64>,
    /// Frames to wait for before they are halved again.
    wait: u32,
    /// How many that were the last time.
    patience: u32,
}

impl Level {
    /// A frame is done, which so many workers might draw.
    fn done(&mut self, frame: Span, workers: usize, (kind, full): (usize, bool)) {
        self.wait = self.wait.saturating_sub(1);
        self.since += 1;
        if self.since <= SETTLE[kind] {
            return;
        }
        let idle = if full { IDLE[kind].min(IDLE_ON_A_FULL_LINK) } else { IDLE[kind] };
        let busy = BUSY[kind];
        let s = &mut self.span;
        s.frames += frame.frames;
        (s.took, s.drew, s.had) = (s.took + frame.took, s.drew + frame.drew, s.had + frame.had);
        if s.frames < WINDOW {
            return;
        }
        let span = std::mem::take(s);
        let before = self.before.take();
        let worse = before.is_some_and(|before| span.pace() > WORSE * before);
        if worse || self.halved > 0 && span.busy() > busy {
            // Twice as long as before, lest they come and go.
            self.patience = (2 * self.patience).clamp(2 * WINDOW, PATIENCE);
            self.wait = self.patience;
            self.change(self.halved.saturating_sub(1));
        } else if span.busy() < idle && self.wait == 0 && workers > LEAST {
            // Lest each step lose a little.
            self.before = Some(before.unwrap_or(f64::INFINITY).min(span.pace()));
            let often = if span.busy() < HARDLY * idle { 2 } else { 1 };
            self.change(self.halved + often);
        }
    }

    fn change(&mut self, halved: u32) {
        (self.halved, self.since) = (halved, 0);
    }
}

/// What frames tell of how many workers are best.
#[derive(Debug, Default)]
pub(crate) struct ActiveSet {
    set: Option<BrickSetKey>,
    /// No frame of the set is done.
    first: bool,
    /// Of frames beside others, and of those that are alone.
    levels: [Level; 2],
    /// Whether it goes by those that are alone, and how many frames in a row were of the other
    /// kind.
    alone: bool,
    others: u32,
    /// When a frame was done that is of either kind, or began alone. A path's first frame begins
    /// alone and ends beside others, so it is judged with the one after it, by the time of both:
    /// `traffic` counts each.
    since: Micros,
}

impl ActiveSet {
    /// A frame begins, and none is in the making.
    pub(crate) fn begin(&mut self, now: Micros) {
        self.since = now;
    }

    /// How often so many workers are to be halved for a frame, of which so many must be left. Of
    /// another set nothing is known.
    pub(crate) fn halved(
        &mut self,
        set: BrickSetKey,
        alone: bool,
        (workers, needed): (usize, usize),
    ) -> u32 {
        if self.set.replace(set) != Some(set) {
            let halved = (0..MOST).find(|&often| drawing(workers, often) <= FIRST).unwrap_or(MOST);
            self.levels = [Level { halved, ..Level::default() }; 2];
            self.first = true;
        }
        self.others = if alone == self.alone { 0 } else { self.others + 1 };
        if self.others >= OTHERS {
            (self.alone, self.others) = (alone, 0);
        }
        // Who is short of memory is sent the same bricks again and again.
        let halved = &mut self.levels[usize::from(self.alone)].halved;
        *halved = (0..=*halved).rev().find(|&often| drawing(workers, often) >= needed).unwrap_or(0);
        *halved
    }

    /// Whether no frame of the set is done.
    pub(crate) fn is_first(&self) -> bool {
        self.first
    }

    /// Whether all are to be called while the first frame of a set is in the making, for which so
    /// many threads drew so long by now.
    pub(crate) fn calls_all_now(&mut self, drew: Micros, threads: u64, now: Micros) -> bool {
        let had = now.saturating_sub(self.since).saturating_mul(threads);
        let calls = self.first && drew as f64 > CALL_NOW * had as f64;
        if calls {
            self.call_all();
        }
        calls
    }

    /// A frame is done, for which threads drew so long, of so many workers and threads that might
    /// have; whether it was alone.
    pub(crate) fn done(
        &mut self,
        (alone, full): (bool, bool),
        drew: Micros,
        (workers, threads): (usize, u64),
        now: Micros,
    ) {
        let took = now.saturating_sub(std::mem::replace(&mut self.since, now)) as f64;
        let span = Span { frames: 1, took, drew: drew as f64, had: took * threads as f64 };
        if std::mem::take(&mut self.first) && span.busy() > CALL && !full {
            self.levels = Default::default();
        }
        // As many drew as that kind goes by.
        if alone == self.alone {
            let kind = usize::from(alone);
            self.levels[kind].done(span, workers, (kind, full));
        }
    }

    /// A task could not be drawn: whoever is left may try.
    pub(crate) fn call_all(&mut self) {
        (self.levels, self.first) = Default::default();
    }
}

/// How many of so many workers draw when they were halved so often.
pub(crate) fn drawing(workers: usize, halved: u32) -> usize {
    workers.div_ceil(1 << halved.min(MOST)).max(LEAST.min(workers))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Digest32;

    const SET: BrickSetKey = BrickSetKey(Digest32([1; 32]));

    /// Frames beside others, each of which takes so long on so many workers of one thread. How many
    /// drew each.
    fn path(
        reserve: &mut ActiveSet,
        frames: usize,
        all: usize,
        takes: impl Fn(usize) -> f64,
    ) -> Vec<usize> {
        let (mut now, mut drew) = (reserve.since, Vec::new());
        for _ in 0..frames {
            let n = drawing(all, reserve.halved(SET, false, (all, 0)));
            now += (1000.0 * takes(n)) as Micros;
            reserve.done((false, false), 10_000, (n, n as u64), now);
            drew.push(n);
        }
        drew
    }

    /// Where the set is not a new one, so that all begin.
    fn later() -> ActiveSet {
        ActiveSet { set: Some(SET), ..ActiveSet::default() }
    }

    /// What 10 ms of drawing take, and bricks that become more with the square root of workers;
    /// milliseconds.
    fn linked(n: usize) -> f64 {
        (10.0 / n as f64).max(0.7 * (n as f64).sqrt())
    }

    #[test]
    fn where_bricks_bind_as_many_draw_as_are_good() {
        let mut reserve = later();
        let drew = path(&mut reserve, 120, 64, linked);
        assert_eq!(drew[..10], [64; 10], "the first frames say little");
        assert_eq!(drew[119], 16, "{drew:?}");
        assert!(drew.is_sorted_by(|a, b| a >= b), "{drew:?}");
        // Nothing is to be sent any more, and who draws has no pause.
        let drew = path(&mut reserve, 200, 64, |n| 10.0 / n as f64);
        assert_eq!(drew[199], 64, "{drew:?}");
    }

    #[test]
    fn few_draw_a_first_frame_and_the_others_come_if_it_is_drawing_that_takes_long() {
        let bricks = path(&mut ActiveSet::default(), 30, 64, |n| 3.0 * n as f64);
        assert!(bricks[0] == FIRST && bricks.iter().all(|n| *n <= FIRST), "{bricks:?}");
        let long = path(&mut ActiveSet::default(), 30, 64, |n| 12.0 / n as f64);
        assert_eq!((long[0], &long[1..]), (FIRST, &[64; 29][..]));
        assert_eq!(path(&mut ActiveSet::default(), 3, 16, |n| 3.0 * n as f64), [16; 3]);
        // Bricks took nearly all of the time.
        for (full, drew) in [(false, 64), (true, FIRST)] {
            let mut reserve = ActiveSet::default();
            reserve.halved(SET, true, (64, 0));
            reserve.done((true, full), 344_000, (FIRST, FIRST as u64), 200_000);
            assert_eq!(drawing(64, reserve.halved(SET, true, (64, 0))), drew, "full: {full}");
        }
        // A quarter of what 16 threads could draw by then is drawn.
        let mut reserve = ActiveSet::default();
        reserve.begin(1_000);
        assert_eq!(drawing(64, reserve.halved(SET, true, (64, 0))), FIRST);
        assert!(
            !reserve.calls_all_now(20_000, 16, 9_000) && !reserve.calls_all_now(31_000, 16, 9_000)
        );
        assert!(reserve.calls_all_now(33_000, 16, 9_000));
        assert_eq!(reserve.halved(SET, true, (64, 0)), 0);
        assert!(!reserve.calls_all_now(33_000, 16, 9_000), "they are called");
    }

    #[test]
    fn where_workers_bind_all_draw() {
        let drew = path(&mut later(), 200, 64, |n| 10.0 / n as f64 / 0.8);
        assert_eq!(drew, [64; 200]);
    }

    #[test]
    fn what_makes_frames_late_is_taken_back_and_tried_less_and_less_often() {
        // Threads stand still for some other reason, and half of them take twice as long.
        let drew = path(&mut later(), 1000, 64, |n| 64.0 / n as f64);
        let few = drew.iter().filter(|n| **n < 64).count();
        assert!((10..=100).contains(&few), "{few}");
    }

    #[test]
    fn another_set_begins_anew_and_so_do_frames_that_are_alone() {
        let mut reserve = later();
        path(&mut reserve, 120, 64, linked);
        let halved = reserve.halved(SET, false, (64, 0));
        assert!(halved > 0);
        let alone: Vec<u32> = (0..5).map(|_| reserve.halved(SET, true, (64, 0))).collect();
        assert_eq!(alone, [halved, halved, halved, 0, 0], "one alone is no kind");
        assert_eq!(reserve.halved(BrickSetKey(Digest32([2; 32])), false, (12, 0)), 0);
    }

    #[test]
    fn as_many_draw_as_have_room_for_the_bricks() {
        let mut reserve = ActiveSet::default();
        let drawn = [0, 16, 17, 33, 65, usize::MAX]
            .map(|needed| drawing(64, reserve.halved(SET, false, (64, needed))));
        assert_eq!(drawn, [16, 16, 32, 64, 64, 64]);
        // However long they stand still it does not go farther meanwhile.
        let mut reserve = later();
        for i in 1..1000 {
            reserve.halved(SET, false, (64, 33));
            reserve.done((false, false), 10, (64, 64), 1000 * i);
        }
        assert!(reserve.levels[0].halved <= 2, "{reserve:?}");
    }

    #[test]
    fn few_workers_all_draw() {
        assert_eq!([1, 3, 4, 5, 8].map(|n| drawing(n, 3)), [1, 3, 4, 4, 4]);
        assert_eq!([64, 65].map(|n| drawing(n, 2)), [16, 17]);
        assert_eq!(drawing(100_000, u32::MAX), 98);
    }
}
