//! A watcher: a cursor over the frames of a job.

use super::{FinishedFrame, JobState, JobView, Jobs};
use crate::driver::Event;
use slabcast_common::ids::JobId;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc::{self, error::TrySendError};
use tokio::sync::watch::{self, error::RecvError};
use tokio::time::Instant;

/// An item that a watcher of a job gets.
#[derive(Clone, Debug)]
pub enum WatchItem {
    /// The job changed; also sent before the first frame.
    Notice(Box<JobView>),
    /// The next frame, in order.
    Frame(Arc<FinishedFrame>),
    /// The next frame failed; others come after it.
    Failed {
        /// Number of the frame in its job, from 0.
        number: u64,
        /// Why it could not be drawn, for users.
        reason: Arc<str>,
    },
}

/// Shortest time between two notices that tell of tiles alone. A frame of 64 tiles may take 20 ms:
/// a notice for each tile woke a thread some 3000 times a second, 3 % of a processor.
pub(crate) const TILE_NEWS: Duration = Duration::from_millis(40);

/// The facts that a notice tells, to be compared with the next notice.
#[derive(Clone, Debug, PartialEq, Eq)]
struct News {
    state: JobState,
    frames_done: u64,
    frames_failed: u64,
    workers: u32,
    tiles: (u32, u32),
    slab: (u32, u32),
}

impl News {
    fn new(view: &JobView) -> News {
        News {
            state: view.state.clone(),
            frames_done: view.frames_done,
            frames_failed: view.frames_failed,
            workers: view.workers,
            tiles: view.tiles,
            slab: view.slab,
        }
    }

    /// Whether `next` tells something else, apart from tiles and slabs.
    fn differs_beyond_tiles(&self, next: &News) -> bool {
        let facts = |n: &News| (n.frames_done, n.frames_failed, n.workers);
        self.state != next.state || facts(self) != facts(next)
    }
}

/// A cursor over a job's frames, from [`crate::Handle::watch`].
pub struct Watch {
    jobs: Arc<Jobs>,
    job: JobId,
    /// Number of the next frame.
    next: u64,
    bell: watch::Receiver<u64>,
    tile_bell: watch::Receiver<u64>,
    last_notice: Option<News>,
    /// Until when it does not listen to tiles.
    quiet_until: Option<Instant>,
    driver: mpsc::Sender<Event>,
    is_over: bool,
    /// The frame that it waits for, as the table knows.
    waits_for: Option<u64>,
    /// The frame that it took last, as the table knows.
    in_hand: Option<u64>,
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.let_go();
        self.wait_no_more();
    }
}

impl Watch {
    /// A watcher of `job` from frame `next` on.
    pub(crate) fn new(
        jobs: Arc<Jobs>,
        job: JobId,
        next: u64,
        driver: mpsc::Sender<Event>,
    ) -> Watch {
        let (bell, tile_bell) = jobs.listen();
        Watch {
            jobs,
            job,
            next,
            bell,
            tile_bell,
            last_notice: None,
            quiet_until: None,
            driver,
            is_over: false,
            waits_for: None,
            in_hand: None,
        }
    }

    /// Tells the table that the frame that was taken last is no longer needed.
    fn let_go(&mut self) {
        if let Some(number) = self.in_hand.take() {
            self.jobs.lock().put_back(self.job, number);
        }
    }

    /// Has the driver look at the table. If its queue is full it will do so without being told.
    /// Returns false if it has ended.
    fn wake_driver(&self) -> bool {
        !matches!(self.driver.try_send(Event::FrameTaken), Err(TrySendError::Closed(_)))
    }

    /// Tells the table that no frame is waited for.
    fn wait_no_more(&mut self) {
        if let Some(number) = self.waits_for.take() {
            self.jobs.lock().waits_no_more(self.job, number);
        }
    }

    /// Waits for a frame that was taken before and is needed again, in part. It is rendered again
    /// if it was dropped meanwhile. Returns `None` if that can't be.
    pub(crate) async fn again(&mut self, number: u64) -> Option<Arc<FinishedFrame>> {
        self.let_go();
        let found = loop {
            let must_wake = {
                self.bell.borrow_and_update();
                let mut table = self.jobs.lock();
                if let Some(frame) = table.look_at(self.job, number) {
                    break Some(frame);
                }
                match table.get(self.job) {
                    Some(job) if !job.retired && job.view.state.may_render() => {}
                    _ => break None,
                }
                let is_new = self.waits_for.is_none();
                is_new && {
                    self.waits_for = Some(number);
                    table.wait_for(self.job, number)
                }
            };
            if must_wake && !self.wake_driver() {
                break None;
            }
            if self.bell.changed().await.is_err() {
                break None;
            }
        };
        self.wait_no_more();
        found
    }

    /// Waits for the next notice or frame. Returns `None` after the last frame, or after the
    /// notice which says that there will be no more. Frames come in order; each is marked as
    /// taken, which lets the master drop it when it needs room.
    pub async fn next(&mut self) -> Option<WatchItem> {
        self.let_go();
        let item = self.find_next().await;
        self.wait_no_more();
        item
    }

    async fn find_next(&mut self) -> Option<WatchItem> {
        loop {
            if self.is_over {
                return None;
            }
            let wake_driver = {
                // Marked as seen before the table is read, so that no ring is missed.
                self.bell.borrow_and_update();
                let is_quiet = self.quiet_until.is_some_and(|until| Instant::now() < until);
                if !is_quiet {
                    self.tile_bell.borrow_and_update();
                }
                let mut table = self.jobs.lock();
                if let Some(frame) = table.take(self.job, self.next) {
                    drop(table);
                    self.in_hand = Some(self.next);
                    self.next += 1;
                    // It may render ahead again.
                    self.wake_driver();
                    return Some(WatchItem::Frame(frame));
                }
                if let Some(reason) = table.failure(self.job, self.next) {
                    self.next += 1;
                    return Some(WatchItem::Failed { number: self.next - 1, reason });
                }
                let Some(job) = table.get(self.job) else {
                    self.is_over = true;
                    return None;
                };
                let view = &job.view;
                // One that came late may have all of its frames before those ahead of them are done.
                if (self.next >= view.frames_total && view.state.is_over())
                    || matches!(view.state, JobState::Failed(_) | JobState::Cancelled)
                    || job.retired
                {
                    self.is_over = true;
                    return Some(WatchItem::Notice(Box::new(view.clone())));
                }
                let news = News::new(view);
                let is_new = self.last_notice.as_ref().is_none_or(|last| {
                    last.differs_beyond_tiles(&news) || !is_quiet && *last != news
                });
                if is_new {
                    self.last_notice = Some(news);
                    self.quiet_until = Some(Instant::now() + TILE_NEWS);
                    return Some(WatchItem::Notice(Box::new(view.clone())));
                }
                // A notice ends the call and the wait, so that the next call begins to wait anew.
                self.waits_for.is_none() && {
                    self.waits_for = Some(self.next);
                    table.wait_for(self.job, self.next)
                }
            };
            if wake_driver && !self.wake_driver() {
                self.is_over = true;
                return None;
            }
            if self.rung().await.is_err() {
                self.is_over = true;
                return None;
            }
        }
    }

    /// Waits for a bell; for the one of tiles only after the quiet time.
    async fn rung(&mut self) -> Result<(), RecvError> {
        let quiet_until = self.quiet_until;
        let tile = async {
            if let Some(until) = quiet_until {
                tokio::time::sleep_until(until).await;
            }
            self.tile_bell.changed().await
        };
        tokio::select! {
            rung = self.bell.changed() => rung,
            rung = tile => rung,
        }
    }
}
