//! Chooses the number of workers that draw. The others are held in reserve: they are lent nothing
//! and sent nothing.
//!
//! Each worker that draws is sent bricks, bricks at the border of two workers' tiles go to both,
//! and each tile takes the master's time. So with `n` workers a frame takes about
//!
//! ```text
//! work / n + serial * n
//! ```
//!
//! where `work` is the rendering time of the frame and `serial` the time that one worker's bricks
//! take on the link and its tiles at the master. Both are measured with each frame, and the number
//! of workers that minimises the sum draws: a worker is worthwhile while it renders longer than it
//! keeps the link and the master busy. mri256 `peer-opaque` at 512x512 and 1 Gbit/s with four
//! frames in flight reaches 430 frames a second on 8 workers, and 127 if all of 64 draw.
//!
//! The **first frame** of a brick set is drawn by [`FIRST_FRAME_WORKERS`] at most. No worker holds
//! a brick then, and sending a voxel takes longer than drawing it: 5 bytes are 40 ns at 1 Gbit/s,
//! and each goes to several workers. mri256's first picture is there after 44 ms from 16 workers
//! and after 104 from 64.
//!
//! Sole and overlapping frames are told apart, since round trips are part of a sole frame's time.
//! It refuses to know which workers are held in reserve (`state::workers`).

use super::cost_model::SWITCH_GAIN_RATIO;
use slabcast_common::brick::BrickSetKey;

/// Limit: fewer workers always all draw.
const ALWAYS_ACTIVE_WORKERS: usize = 4;

/// Tuning (workers): most that draw the first frame of a set.
const FIRST_FRAME_WORKERS: usize = 16;

/// Tuning (frames): frames after a change that say nothing: those that had begun, and the bricks
/// that the change brings. As many are then judged together, since overlapping ones may end at
/// once.
pub(crate) const SETTLE_FRAMES: u32 = 5;

/// Tuning (frames): the first frame is sent as many bricks as so many later ones. A change of the
/// active set brings as many again, and has to pay for them within as many frames.
const FRAMES_PER_VIEW: f64 = 25.0;

/// Times of a frame that ended, and the workers that drew it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct FrameCost {
    /// No other frame was in flight.
    pub(crate) sole: bool,
    /// Rendering time of all threads, in microseconds.
    pub(crate) work_us: f64,
    /// Time of its bricks on the link and of its tiles at the master, in microseconds.
    pub(crate) serial_us: f64,
    /// Time since the frame before ended, in microseconds.
    pub(crate) frame_us: f64,
    /// Active workers, and their threads.
    pub(crate) workers: usize,
    pub(crate) threads: u64,
}

/// Sums over frames of one kind, and the number of workers that follows.
#[derive(Clone, Copy, Debug, Default)]
struct Level {
    /// Number of times that the workers are halved.
    halvings: u32,
    /// Frames since that changed.
    frames: u32,
    /// Rendering time divided by the threads of a worker, in microseconds.
    work_us: f64,
    /// Serial time divided by the workers, in microseconds.
    serial_us: f64,
    /// Time of the frames that neither explains: round trips, and threads that wait.
    rest_us: f64,
}

impl Level {
    fn frame_ended(&mut self, cost: FrameCost, available: usize, first_us: f64) {
        self.frames += 1;
        if self.frames <= SETTLE_FRAMES {
            return;
        }
        self.add(cost);
        if self.frames >= 2 * SETTLE_FRAMES {
            self.choose(available, first_us, f64::from(SETTLE_FRAMES));
            let halvings = self.halvings;
            *self = Level { halvings, frames: self.frames.min(SETTLE_FRAMES), ..Level::default() };
        }
    }

    fn add(&mut self, cost: FrameCost) {
        let workers = cost.workers.max(1) as f64;
        let threads = (cost.threads as f64 / workers).max(1.0);
        self.work_us += cost.work_us / threads;
        self.serial_us += cost.serial_us / workers;
        self.rest_us += cost.frame_us - cost.work_us / threads / workers - cost.serial_us;
    }

    /// Takes the number of workers with the least predicted time, if it wins enough. `first_us`:
    /// serial time of the first frame, which a change causes again.
    fn choose(&mut self, available: usize, first_us: f64, frames: f64) {
        let frames_us = |halvings: u32| {
            let n = active(available, halvings) as f64;
            let bricks = if halvings == self.halvings { 0.0 } else { first_us / FRAMES_PER_VIEW };
            self.work_us / n + self.serial_us * n + self.rest_us.max(0.0) + frames * bricks
        };
        let most = available.max(1).ilog2();
        let best = (0..=most).min_by(|a, b| frames_us(*a).total_cmp(&frames_us(*b)));
        if let Some(best) = best
            && frames_us(best) < (1.0 - SWITCH_GAIN_RATIO) * frames_us(self.halvings)
        {
            *self = Level { halvings: best, ..Level::default() };
        }
    }
}

/// Decides how many workers draw.
#[derive(Debug, Default)]
pub(crate) struct ActiveSet {
    set: Option<BrickSetKey>,
    /// No frame of the set has ended.
    is_first: bool,
    /// Workers that draw the first frame.
    first_workers: usize,
    /// Serial time of the first frame, in microseconds.
    first_us: f64,
    /// Levels of overlapping frames, and of sole ones.
    levels: [Level; 2],
}

impl ActiveSet {
    /// Returns how many of `available` workers draw a frame that begins.
    ///
    /// `needed`: workers whose memory the set needs. Below that, bricks would be sent again and
    /// again.
    pub(crate) fn workers(
        &mut self,
        set: BrickSetKey,
        sole: bool,
        available: usize,
        needed: usize,
    ) -> usize {
        if self.set.replace(set) != Some(set) {
            self.levels = Default::default();
            self.is_first = true;
            self.first_workers = FIRST_FRAME_WORKERS;
        }
        let chosen = match self.is_first {
            true => self.first_workers,
            false => active(available, self.levels[usize::from(sole)].halvings),
        };
        chosen.max(needed).min(available)
    }

    /// Whether no frame of the set has ended.
    pub(crate) fn is_first(&self) -> bool {
        self.is_first
    }

    /// Learns from a frame that ended, while so many workers could draw.
    pub(crate) fn frame_ended(&mut self, cost: FrameCost, available: usize) {
        if self.is_first {
            self.is_first = false;
            self.levels = [self.after_first(cost, available); 2];
            return;
        }
        self.levels[usize::from(cost.sole)].frame_ended(cost, available, self.first_us);
    }

    /// Takes what the first frame of a set cost so far. Returns whether more workers are to draw
    /// it: rendering takes longer than sending bricks.
    pub(crate) fn first_frame_goes_on(&mut self, cost: FrameCost, available: usize) -> bool {
        let workers = active(available, self.after_first(cost, available).halvings);
        let grows = self.is_first && workers > self.first_workers;
        if grows {
            self.first_workers = workers;
        }
        grows
    }

    /// Returns the level that follows from the first frame, or from a part of it.
    fn after_first(&mut self, cost: FrameCost, available: usize) -> Level {
        self.first_us = cost.serial_us;
        let serial_us = cost.serial_us / FRAMES_PER_VIEW;
        let halvings = halvings_to(available, self.first_workers);
        let mut level = Level { halvings, ..Level::default() };
        level.add(FrameCost { serial_us, frame_us: 0.0, ..cost });
        level.choose(available, self.first_us, 1.0);
        Level { halvings: level.halvings, ..Level::default() }
    }

    /// Activates all workers: one of them could not draw a task.
    pub(crate) fn activate_all(&mut self) {
        *self = ActiveSet { set: self.set, ..ActiveSet::default() };
    }
}

/// Returns how many of so many workers draw after so many halvings.
fn active(available: usize, halvings: u32) -> usize {
    available.div_ceil(1 << halvings.min(31)).max(ALWAYS_ACTIVE_WORKERS.min(available))
}

/// Returns how often to halve for at most so many workers.
fn halvings_to(available: usize, workers: usize) -> u32 {
    (0..32).find(|&h| available.div_ceil(1 << h) <= workers).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Digest32;

    const SET: BrickSetKey = BrickSetKey(Digest32([1; 32]));

    /// Draws frames of so much work, of which each worker takes the link and the master so long.
    /// Returns how many workers drew each.
    fn path(
        active: &mut ActiveSet,
        frames: usize,
        all: usize,
        work: f64,
        serial: f64,
    ) -> Vec<usize> {
        let frame = |_| {
            let n = active.workers(SET, false, all, 0);
            let serial_us = serial * n as f64;
            let cost = FrameCost {
                sole: false,
                work_us: work,
                serial_us,
                frame_us: 0.0,
                workers: n,
                threads: n as u64,
            };
            active.frame_ended(cost, all);
            n
        };
        (0..frames).map(frame).collect()
    }

    #[test]
    fn active_set_shrinks_to_the_workers_that_shorten_the_frame() {
        let mut active = ActiveSet::default();
        let drew = path(&mut active, 40, 64, 10_000.0, 120.0);
        assert!(
            drew[0] == FIRST_FRAME_WORKERS && drew[39] == 8,
            "sqrt(10000 / 120) is 9: {drew:?}"
        );
        let drew = path(&mut active, 90, 64, 10_000.0, 1.0);
        assert_eq!(drew[89], 64, "nothing is sent any more: {drew:?}");
    }

    #[test]
    fn active_set_keeps_all_workers_where_rendering_binds() {
        let drew = path(&mut ActiveSet::default(), 10, 64, 300_000.0, 20.0);
        assert_eq!((drew[0], &drew[1..]), (FIRST_FRAME_WORKERS, &[64; 9][..]));
    }

    #[test]
    fn active_set_has_room_for_the_bricks() {
        let mut active = ActiveSet::default();
        let needed = [0, 17, 33, usize::MAX].map(|n| active.workers(SET, false, 64, n));
        assert_eq!(needed, [16, 17, 33, 64]);
    }

    #[test]
    fn active_set_of_few_workers_is_all() {
        assert_eq!([1, 3, 4, 5, 8].map(|n| super::active(n, 3)), [1, 3, 4, 4, 4]);
        let mut active = ActiveSet::default();
        path(&mut active, 20, 64, 10_000.0, 500.0);
        active.activate_all();
        assert_eq!(active.workers(SET, false, 64, 0), 64, "a task could not be drawn");
    }
}
