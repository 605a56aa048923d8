//! The threads that finish frames, beside the driver.
//!
//! A panic on one of them fails the frame at hand and its job, with the panic's message; the
//! thread goes on with the next task.

use crate::driver::Event;
use crate::finish::{self, Assembly, FrameSums};
use crate::hooks::{Hooks, Stage};
use crate::panics::caught;
use slabcast_common::ids::FrameId;
use slabcast_common::link::FINISHER_THREADS;
use std::sync::{Arc, Mutex, PoisonError, mpsc};

/// A task of a finisher.
pub(crate) enum FinishTask {
    /// Composes the tiles that came finished into the picture of a frame that is still drawn.
    Compose(FrameId, Arc<Assembly>),
    /// Encodes a frame.
    Finish(Box<FrameSums>),
}

impl FinishTask {
    fn frame(&self) -> FrameId {
        match self {
            FinishTask::Compose(frame, _) => *frame,
            FinishTask::Finish(sums) => sums.frame,
        }
    }
}

/// The threads' queue. They end when it is dropped.
pub(crate) struct Finishers {
    /// Unbounded: each frame in flight has one task to finish it, and one for each batch of
    /// finished tiles, whose bytes the scheduler has bounded by its leases.
    tasks: mpsc::Sender<FinishTask>,
}

/// Every finisher has ended.
#[derive(Debug, thiserror::Error)]
#[error("the threads that finish frames have ended")]
pub(crate) struct Ended;

impl Finishers {
    /// Starts the threads. Frames come back to `driver` as [`Event::Finished`] or
    /// [`Event::FinishFailed`].
    ///
    /// # Errors
    /// If the system gives no thread.
    pub(crate) fn start(
        driver: &tokio::sync::mpsc::Sender<Event>,
        hooks: &Hooks,
    ) -> std::io::Result<Finishers> {
        let (tasks, queue) = mpsc::channel::<FinishTask>();
        let queue = Arc::new(Mutex::new(queue));
        for _ in 0..FINISHER_THREADS {
            let (queue, driver, hooks) = (queue.clone(), driver.clone(), hooks.clone());
            let next = move || queue.lock().unwrap_or_else(PoisonError::into_inner).recv();
            std::thread::Builder::new().name("slabcast-finish".into()).spawn(move || {
                while let Ok(task) = next() {
                    let frame = task.frame();
                    let event = match run(task, &hooks) {
                        Ok(None) => continue,
                        Ok(Some(event)) => event,
                        Err(panicked) => {
                            Event::FinishFailed { frame, reason: panicked.to_string() }
                        }
                    };
                    if driver.blocking_send(event).is_err() {
                        return;
                    }
                }
            })?;
        }
        Ok(Finishers { tasks })
    }

    /// Queues a task.
    ///
    /// # Errors
    /// If there is no thread left.
    pub(crate) fn push(&self, task: FinishTask) -> Result<(), Ended> {
        self.tasks.send(task).map_err(|_| Ended)
    }
}

/// Does a task. Returns the event that tells of a finished frame, if it was the frame's last.
fn run(task: FinishTask, hooks: &Hooks) -> Result<Option<Event>, crate::panics::Panicked> {
    match task {
        FinishTask::Compose(_, assembly) => caught("composing tiles", || {
            hooks.reach(Stage::Compose);
            assembly.compose();
            None
        }),
        FinishTask::Finish(sums) => caught("finishing the frame", || {
            hooks.reach(Stage::Finish);
            let (job, frame) = (sums.job, sums.frame);
            Some(Event::Finished { job, flight: frame, frame: finish::finish(*sums) })
        }),
    }
}
