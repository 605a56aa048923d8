//! A watcher: a cursor over the frames of a job.

use super::{FinishedFrame, JobState, JobView, Jobs};
use slabcast_common::ids::JobId;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch::{self, error::RecvError};
use tokio::time::Instant;

/// What a watcher gets next.
#[derive(Clone, Debug)]
pub enum WatchItem {
    /// Something about the job changed (also before the first frame).
    Notice(JobView),
    /// The next frame, in order.
    Frame(Arc<FinishedFrame>),
}

/// How often a watcher hears of tiles. A frame of 64 tiles may take 20 ms: a notice each woke a thread
/// some 3000 times a second, and was 3 % of a processor.
pub(crate) const NEWS: Duration = Duration::from_millis(40);

/// What a notice tells: state, frames done, tiles, slab, workers.
pub(crate) type Told = (JobState, u64, (u32, u32), (u32, u32), u32);

/// A cursor over a job's frames.
pub struct Watch {
    pub(crate) jobs: Arc<Jobs>,
    pub(crate) job: JobId,
    pub(crate) next: u64,
    pub(crate) bells: (watch::Receiver<u64>, watch::Receiver<u64>),
    pub(crate) last_notice: Option<Told>,
    /// Until when it does not listen to tiles.
    pub(crate) quiet: Option<Instant>,
    pub(crate) taken: tokio::sync::mpsc::Sender<crate::driver::Event>,
    pub(crate) over: bool,
}

impl Watch {
    /// The next notice or frame; `None` after the last frame, or after the notice that says
    /// that there will be none.
    pub async fn next(&mut self) -> Option<WatchItem> {
        loop {
            if self.over {
                return None;
            }
            let poke = {
                // Seen before the table is read, so that no ring is missed.
                self.bells.0.borrow_and_update();
                let quiet = self.quiet.is_some_and(|until| Instant::now() < until);
                if !quiet {
                    self.bells.1.borrow_and_update();
                }
                let mut table = self.jobs.lock();
                let Some(job) = table.jobs.get_mut(&self.job) else {
                    self.over = true;
                    return None;
                };
                if let Some(frame) = job.frames.get(&self.next).cloned() {
                    job.taken.insert(self.next);
                    job.wanted_again.remove(&self.next);
                    self.next += 1;
                    drop(table);
                    // The driver may render ahead again. If it is busy it will see for itself.
                    let _ = self.taken.try_send(crate::driver::Event::FrameTaken);
                    return Some(WatchItem::Frame(frame));
                }
                let v = &job.view;
                let now = (v.state.clone(), v.frames_done, v.tiles, v.slab, v.workers);
                if self.next >= v.frames_total
                    || matches!(v.state, JobState::Failed(_) | JobState::Cancelled)
                    || job.retired
                {
                    self.over = true;
                    return Some(WatchItem::Notice(v.clone()));
                }
                let news = |last: &Told| {
                    let (was, is) = ((&last.0, last.1, last.4), (&now.0, now.1, now.4));
                    was != is || !quiet && (last.2, last.3) != (now.2, now.3)
                };
                if self.last_notice.as_ref().is_none_or(news) {
                    self.last_notice = Some(now);
                    self.quiet = Some(Instant::now() + NEWS);
                    return Some(WatchItem::Notice(v.clone()));
                }
                // Done once and gone since: ask for it again.
                job.ever_done.contains(&self.next) && job.wanted_again.insert(self.next)
            };
            if poke && self.taken.send(crate::driver::Event::FrameTaken).await.is_err() {
                self.over = true;
                return None;
            }
            if self.rung().await.is_err() {
                self.over = true;
                return None;
            }
        }
    }

    /// Waits until there may be something new.
    async fn rung(&mut self) -> Result<(), RecvError> {
        let (bell, tiles) = &mut self.bells;
        let quiet = self.quiet;
        let tile = async {
            if let Some(until) = quiet {
                tokio::time::sleep_until(until).await;
            }
            tiles.changed().await
        };
        tokio::select! {
            rung = bell.changed() => rung,
            rung = tile => rung,
        }
    }
}
