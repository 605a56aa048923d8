//! Whether the link bears crews (`region`), each of which is sent what a view needs: most of it
//! when they are formed, and more a frame than all together. And whether bricks fill it, where
//! fewer frames are best.
//!
//! Nobody tells the scheduler how fast the link is; it sees when bricks leave and when workers say
//! that they have them. From the moment at which some are on their way to anybody until none are,
//! what has landed by now in the time since is never more than the link carries, however few they
//! are and however long words take; and where many leave at once, as for the first frame, it comes
//! near. So the **rate** is the highest that was seen. What the last frames were sent takes a
//! **share** of their time at that rate:
//!
//! | mri256 at 512x512, 15 and 32 workers | rate seen, MB/s | share, all together | share, crews |
//! |---|--:|--:|--:|
//! | 1 Gbit/s  | 86 to 101, 80 to 95   | 0.85 to 0.98, 0.87 to 1.0 | |
//! | 10 Gbit/s | 896, 990   | 0.55 to 0.6, 0.58 to 0.63 | 0.3 to 0.2, 0.8 to 0.4 |
//! | unlimited | 1487, 2304 | 0.4, 0.3                  | 0.4 to 0.2, 0.5 to 0.2 |
//!
//! What workers' results take the other way is judged at the same rate, links being alike either
//! way: until they take a good part of the time, packing them keeps render threads longer than
//! anybody waits for bytes.
//!
//! Frames that are alone are told apart: what these are sent takes another share of other time, and
//! says whether the next one may be cut in another way than the one before it (`region`).
//!
//! It refuses to forget: that a link has become slower it never learns.

use crate::Micros;

/// Crews are formed where the share is below this. At 0.7 they come and go at 1 Gbit/s, at 0.5 they
/// come late at 10 (70 % of n times one worker's frames with 15 workers, where 74 are with this).
const FORM: f64 = 0.6;

/// The same once the first frames are over, which were sent all that the view needs: the share of
/// those that follow is half as large. At 1 Gbit/s it is 0.5 to 1 on a turn, where crews come and
/// go if this is as large as [`FORM`].
const FORM_LATER: f64 = 0.3;

/// Bricks that may not be needed are sent until the share is above [`DISSOLVE`], and again when it
/// is below this. On a link of 1 Gbit/s the share goes up and down; if they were sent whenever it
/// is below 0.65, or in the first frame, paths of overlapping frames would take up to a seventh
/// longer on 15 workers (docs/scaling.md).
const SPARE: f64 = 0.1;

/// How many frames are the first.
const FIRST: u32 = 8;

/// They are dissolved where it is above this, and fewer frames are in the making
/// ([`LinkUse::is_full`]). Between the two lies what forming them is sent.
const DISSOLVE: f64 = 0.8;

/// What frames before count against one. Of four that are in the making two may be done at once.
const KEEP: f64 = 0.75;

/// Bricks bind frames that are alone where their share is above the first, until it is below the
/// second. After its first frame, which is sent all that the view needs, mri256 at 512x512 has 0.4
/// to 0.7 at 1 Gbit/s and 0.1 to 0.4 at 10; aneurism has 0.1 to 0.3 at 1 Gbit/s. If 0.35 were
/// enough, aneurism's first frames at 10 Gbit/s would be, and it takes 3 % longer; and below 0.2 or
/// 0.3 makes no difference beyond 1 %.
const BIND: [f64; 2] = [0.6, 0.3];

/// Results are packed once they take more than the first of the time at the rate that was seen,
/// until, packed, they take less than the second. On one worker and two they are not at 1 Gbit/s
/// and more, which saves 3 % of a frame of mri256; on four and more at 1 Gbit/s they are, where as
/// they are they would take 8 % more time on eight (aneurism: 23). With 0.8 and 0.5 such frames
/// take 5 to 8 % longer, with 0.4 and 0.2 one and two workers pack (docs/scaling.md).
const PACK: [f64; 2] = [0.55, 0.35];

/// What is left of what frames that were alone told once another one was: the first of them tells
/// of itself.
const KEEP_ALONE: f64 = 0.5;

/// Frames that nothing changes for after a change: bricks that it brings are sent in the first
/// four.
const SETTLE: u32 = 8;

/// What bricks on their way tell.
#[derive(Debug, Default)]
pub(crate) struct LinkUse {
    /// Workers that some are on their way to.
    aloft: usize,
    /// Since when any are, and bytes that landed since.
    since: Micros,
    landed: u64,
    /// Bytes a microsecond, the most that was seen.
    rate: f64,
    /// Bytes that left since a frame was done, or began alone, and when that was.
    sent: u64,
    done: Micros,
    /// How long what the last frames were sent takes at that rate, and how long they took, in
    /// microseconds; each frame weighs less than the one after it.
    carried: f64,
    took: f64,
    /// What bricks took of the time of frames that were alone, as far as any was; and whether they
    /// bind such.
    alone: Option<f64>,
    bind: bool,
    /// Bytes of results since a frame was done, how long those of the last frames take at that
    /// rate, and how long these frames took; and whether there is room for more.
    results: u64,
    results_took: f64,
    frames_took: f64,
    roomy: bool,
    /// How many, up to [`FIRST`].
    frames: u32,
    crews: bool,
    settling: u32,
    /// Whether there is no room for bricks that may not be needed.
    crowded: bool,
}

impl LinkUse {
    /// Bricks leave for a worker; whether none were on their way to it.
    pub(crate) fn leave(&mut self, bytes: u64, first: bool, now: Micros) {
        self.sent += bytes;
        if first {
            if self.aloft == 0 {
                (self.since, self.landed) = (now, 0);
            }
            self.aloft += 1;
        }
    }

    /// So many bytes are there; whether no more are on their way to that worker.
    pub(crate) fn land(&mut self, bytes: u64, last: bool, now: Micros) {
        self.landed += bytes;
        let time = now.saturating_sub(self.since).max(1);
        self.rate = self.rate.max(self.landed as f64 / time as f64);
        self.aloft -= usize::from(last);
    }

    /// A result came, in a message of so many bytes.
    pub(crate) fn result(&mut self, bytes: u64) {
        self.results += bytes;
    }

    /// A frame begins, and none is in the making.
    pub(crate) fn begin(&mut self, now: Micros) {
        (self.sent, self.results, self.done) = (0, 0, now);
    }

    /// A frame is done; whether others are in the making. Crews are for those that have others
    /// beside them, and learn from these alone; those that are alone learn from such.
    pub(crate) fn done(&mut self, beside: bool, now: Micros) {
        let took = now.saturating_sub(self.done) as f64;
        let carried = if self.sent == 0 { 0.0 } else { self.sent as f64 / self.rate };
        let carried = carried.min(took);
        if !beside {
            let share = carried / took.max(1.0);
            let mean = self.alone.map_or(share, |m| KEEP_ALONE * m + (1.0 - KEEP_ALONE) * share);
            self.alone = Some(mean);
            self.bind = mean > BIND[usize::from(self.bind)];
        } else {
            self.carried = KEEP * self.carried + carried;
            self.took = KEEP * self.took + took;
            let most = if self.crowded { SPARE } else { DISSOLVE };
            self.crowded = self.carried > most * self.took;
            self.settling = self.settling.saturating_sub(1);
            self.frames = FIRST.min(self.frames + 1);
            let form = if self.frames < FIRST { FORM } else { FORM_LATER };
            let bearable = if self.crews { DISSOLVE } else { form };
            if (self.carried < bearable * self.took) != self.crews && self.settling == 0 {
                self.crews = !self.crews;
                self.settling = SETTLE;
            }
        }
        if self.rate > 0.0 {
            self.results_took = KEEP * self.results_took + self.results as f64 / self.rate;
            self.frames_took = KEEP * self.frames_took + took;
            self.roomy = self.results_took < PACK[usize::from(!self.roomy)] * self.frames_took;
        }
        (self.sent, self.results, self.done) = (0, 0, now);
    }

    /// Whether results are to be packed. As long as nobody knows the link they are.
    pub(crate) fn packs(&self) -> bool {
        !self.roomy
    }

    /// Bytes a microsecond that the link carries, as far as that was seen.
    pub(crate) fn rate(&self) -> Option<f64> {
        (self.rate > 0.0).then_some(self.rate)
    }

    /// Whether crews are to draw.
    pub(crate) fn bears_crews(&self) -> bool {
        self.crews
    }

    /// Whether bricks bind frames that are alone.
    pub(crate) fn binds_alone(&self) -> bool {
        self.bind
    }

    /// Whether bricks of the last frames took nearly all the time that there was.
    pub(crate) fn is_full(&self) -> bool {
        self.carried > DISSOLVE * self.took
    }

    /// Whether frames that are alone, or such as overlap, leave room for bricks that may not be
    /// needed. Until one is done nobody knows.
    pub(crate) fn has_room(&self, alone: bool) -> bool {
        match alone {
            true => self.alone.is_some() && !self.is_full_alone(),
            false => self.took > 0.0 && !self.crowded,
        }
    }

    /// The same of frames that were alone.
    pub(crate) fn is_full_alone(&self) -> bool {
        self.alone.is_some_and(|share| share > DISSOLVE)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames of 2 ms or longer, each sent so many bytes in two halves, over a link that carries so
    /// many a microsecond and takes 100 us besides. The first is sent 3 MB. How often crews were
    /// there, and changes.
    fn frames(n: usize, bytes: u64, link: f64) -> (usize, usize) {
        let mut traffic = LinkUse::default();
        let (mut now, mut with, mut changes) = (0, 0, 0);
        traffic.begin(now);
        for i in 0..n {
            let bytes = if i == 0 { 3_000_000 } else { bytes };
            let on_way = 100 + (bytes as f64 / link) as Micros;
            traffic.leave(bytes / 2, true, now);
            traffic.leave(bytes / 2, true, now);
            traffic.land(bytes / 2, true, now + on_way / 2 + 50);
            traffic.land(bytes / 2, true, now + on_way);
            assert!(traffic.rate <= link, "{} of {link}", traffic.rate);
            now += on_way.max(2_000);
            let before = traffic.bears_crews();
            traffic.done(true, now);
            with += usize::from(traffic.bears_crews());
            changes += usize::from(before != traffic.bears_crews());
        }
        (with, changes)
    }

    #[test]
    fn crews_are_formed_where_the_link_bears_them() {
        assert_eq!(frames(40, 300_000, 120.0), (0, 0), "1 Gbit/s and full");
        let (with, changes) = frames(40, 300_000, 1200.0);
        assert!(with > 25 && changes == 1, "10 Gbit/s: {with}, {changes}");
        let (with, changes) = frames(40, 10_000, 120.0);
        assert!(with > 15 && changes == 1, "1 Gbit/s and little to carry: {with}, {changes}");
    }

    #[test]
    fn crews_are_dissolved_where_they_fill_the_link() {
        let mut traffic = LinkUse { rate: 100.0, ..LinkUse::default() };
        let mut frame = |i: u64, bytes| {
            traffic.leave(bytes, false, i * 2_000);
            traffic.done(true, (i + 1) * 2_000);
            (traffic.bears_crews(), traffic.is_full())
        };
        assert_eq!(frame(0, 50_000), (true, false));
        let filled: Vec<_> = (1..10).map(|i| frame(i, 200_000)).collect();
        let with = filled.iter().filter(|(crews, _)| *crews).count();
        assert_eq!(with, SETTLE as usize - 1, "{filled:?}");
        assert_eq!(filled.last(), Some(&(false, true)), "{filled:?}");
        assert_eq!(frame(10, 130_000), (false, true), "and between the two nothing changes");
        assert_eq!(frame(11, 20_000), (false, false));
    }

    #[test]
    fn what_may_not_be_needed_is_not_sent_where_the_link_was_full_until_it_is_all_but_empty() {
        let mut traffic = LinkUse { rate: 100.0, ..LinkUse::default() };
        assert!(!traffic.has_room(false), "of no frame is known what it was sent");
        let mut now = 0;
        let mut frames = |n: usize, bytes| {
            let mut frame = || {
                traffic.leave(bytes, false, now);
                now += 2_000;
                traffic.done(true, now);
                traffic.has_room(false)
            };
            (0..n).map(|_| frame()).collect::<Vec<_>>()
        };
        assert_eq!(frames(1, 190_000), [false], "the first is sent all that it needs");
        assert!(!frames(20, 30_000).contains(&true), "0.15 is not enough");
        assert_eq!(frames(20, 10_000).last(), Some(&true));
        assert!(!frames(20, 150_000).contains(&false), "0.75 is");
        assert_eq!(frames(20, 190_000).last(), Some(&false));
    }

    #[test]
    fn frames_alone_say_nothing() {
        let mut traffic = LinkUse::default();
        traffic.done(false, 1_000);
        assert!(!traffic.bears_crews());
        assert!(!traffic.is_full(), "of no frame is known what it was sent");
        traffic.done(true, 2_000);
        assert!(traffic.bears_crews(), "nothing had to be sent");
    }

    /// A path of frames one by one, of 2 ms and so many bytes each, over a link of 100 bytes a
    /// microsecond.
    fn alone(traffic: &mut LinkUse, n: usize, bytes: u64) -> Vec<bool> {
        let mut frame = || {
            traffic.begin(0);
            traffic.leave(bytes, false, 0);
            traffic.done(false, 2_000);
            traffic.binds_alone()
        };
        (0..n).map(|_| frame()).collect()
    }

    #[test]
    fn results_are_packed_where_they_would_fill_the_link_or_nobody_knows() {
        let mut traffic = LinkUse::default();
        let frames = |traffic: &mut LinkUse, n: usize, bytes: u64| {
            let mut frame = || {
                traffic.begin(0);
                traffic.result(bytes / 2);
                traffic.result(bytes / 2);
                traffic.done(false, 2_000);
                traffic.packs()
            };
            (0..n).map(|_| frame()).collect::<Vec<_>>()
        };
        assert_eq!(frames(&mut traffic, 3, 100), [true; 3], "nobody knows the link");
        traffic.rate = 100.0;
        assert!(!frames(&mut traffic, 20, 90_000).contains(&false), "0.45 packed");
        assert_eq!(frames(&mut traffic, 20, 60_000).last(), Some(&false), "0.3");
        assert!(!frames(&mut traffic, 20, 100_000).contains(&true), "0.5 as they are");
        assert_eq!(frames(&mut traffic, 20, 120_000).last(), Some(&true), "0.6");
    }

    #[test]
    fn bricks_bind_frames_alone_while_they_take_half_of_their_time() {
        let mut traffic = LinkUse { rate: 100.0, ..LinkUse::default() };
        let nothing = !traffic.binds_alone() && !traffic.has_room(true);
        assert!(nothing, "of no frame is known what it was sent");
        assert_eq!(alone(&mut traffic, 1, 190_000), [true], "the first is sent all that it needs");
        assert!(traffic.is_full_alone() && !traffic.has_room(true));
        assert!(!alone(&mut traffic, 9, 90_000).contains(&false), "0.45");
        assert_eq!(alone(&mut traffic, 3, 40_000), [true, false, false]);
        assert!(!alone(&mut traffic, 9, 90_000).contains(&true), "and now that is not enough");
        assert!(!traffic.is_full_alone() && traffic.has_room(true) && !traffic.has_room(false));
        assert!(
            !traffic.is_full() && !traffic.bears_crews(),
            "which says nothing of frames beside others"
        );
        traffic.leave(190_000, false, 2_000);
        traffic.done(true, 4_000);
        assert!(traffic.is_full() && !traffic.binds_alone(), "nor do these of frames alone");
    }
}
