//! Writing a record beside a running scheduler.

use super::{
    Decision, Head, Line, Noted, NotedJob, QUEUE_ENTRIES, VERSION, brick_to_line, noted, to_hex,
};
use prost::Message;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{FrameId, SceneId, TaskId};
use slabcast_common::message::ToWorker;
use slabcast_common::{PIXELS_VERSION, PROTOCOL_VERSION};
use slabcast_proto::convert;
use slabcast_schedule::{Action, Clock, Config, Event, FrameJob, Micros, Scheduler, is_shut};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufWriter, Write};
use std::ops::Deref;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TrySendError, sync_channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};
use tracing::warn;

/// Longest time that an entry waits in the writer's buffer: of a run that is killed, no more than a
/// second is lost.
const FLUSH: Duration = Duration::from_secs(1);

/// An entry from the driver to the thread that writes.
enum Entry {
    Begin(Config),
    Event(Vec<Micros>, Noted),
    Queued(Vec<Micros>, Box<FrameJob>),
    Out(Vec<Decision>),
    End,
}

/// The driver's end of a record, for [`crate::MasterConfig::record`].
pub struct Recorder {
    to: SyncSender<Entry>,
}

/// Summary of a record that was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordSummary {
    /// Number of events that the record holds.
    pub events: u64,
    /// Number of decisions that the record holds.
    pub decisions: u64,
    /// Reason why the record ends early, if it does.
    pub cut: Option<String>,
}

/// Starts a thread that writes a record to `out`. The thread ends when the master that was given
/// the [`Recorder`] has ended, and returns the record's summary, or the error of a write that
/// failed.
///
/// # Errors
/// If the system gives no thread.
pub fn start(
    out: impl Write + Send + 'static,
) -> std::io::Result<(Recorder, JoinHandle<std::io::Result<RecordSummary>>)> {
    let (to, entries) = sync_channel(QUEUE_ENTRIES);
    let thread = std::thread::Builder::new()
        .name("slabcast-record".into())
        .spawn(move || write(BufWriter::with_capacity(1 << 18, out), &entries))?;
    Ok((Recorder { to }, thread))
}

fn put(out: &mut impl Write, line: &Line) -> std::io::Result<()> {
    serde_json::to_writer(&mut *out, line)?;
    out.write_all(b"\n")
}

fn write(mut out: impl Write, entries: &Receiver<Entry>) -> std::io::Result<RecordSummary> {
    let mut written = RecordSummary {
        events: 0,
        decisions: 0,
        cut: Some("the disk fell behind the master".into()),
    };
    let (mut sets, mut scenes) = (BTreeSet::<BrickSetKey>::new(), BTreeSet::<SceneId>::new());
    let mut flushed = Instant::now();
    loop {
        // Pings come all the time: what was written is flushed in between them too.
        if flushed.elapsed() >= FLUSH {
            out.flush()?;
            flushed = Instant::now();
        }
        let entry = match entries.recv_timeout(FLUSH) {
            Ok(entry) => entry,
            Err(RecvTimeoutError::Timeout) => continue,
            Err(RecvTimeoutError::Disconnected) => break,
        };
        match entry {
            Entry::Begin(config) => put(&mut out, &Line::Record(head(&config)))?,
            Entry::Event(t, e) => {
                written.events += 1;
                put(&mut out, &Line::Event { t: differences(t), e })?;
            }
            Entry::Queued(t, job) => {
                let set = job.scene.bricks;
                if sets.insert(set) {
                    let bricks = job.bricks.iter().map(brick_to_line).collect();
                    put(&mut out, &Line::Bricks { set: set.0.to_string(), bricks })?;
                }
                if scenes.insert(job.scene.id) {
                    let wire = to_hex(&convert::scene_to_wire(&job.scene).encode_to_vec());
                    put(&mut out, &Line::Scene { id: job.scene.id.0, wire })?;
                }
                let queued = NotedJob {
                    frame: job.frame.0,
                    number: job.number,
                    scene: job.scene.id.0,
                    view: to_hex(&convert::view_to_wire(&job.view).encode_to_vec()),
                    work: job.work,
                    finish: job.finish,
                    client: job.client,
                };
                written.events += 1;
                put(&mut out, &Line::Event { t: differences(t), e: Noted::Queued(queued) })?;
            }
            Entry::Out(decisions) => {
                written.decisions += decisions.len() as u64;
                put(&mut out, &Line::Out(decisions.iter().map(Decision::to_string).collect()))?;
            }
            Entry::End => {
                written.cut = None;
                break;
            }
        }
    }
    let RecordSummary { events, decisions, cut } = written.clone();
    put(&mut out, &Line::End { events, decisions, cut })?;
    out.flush()?;
    Ok(written)
}

/// Returns the first line of a record.
fn head(config: &Config) -> Head {
    let &Config {
        heartbeat, silence, unresponsive_after, lease, poison_after, queue_ahead, ..
    } = config;
    let audits = (config.audit_ppm, config.audit_first, config.audit_seed);
    Head {
        version: VERSION,
        program: env!("CARGO_PKG_VERSION").into(),
        pixels_version: PIXELS_VERSION,
        protocol_version: PROTOCOL_VERSION,
        heartbeat,
        silence,
        unresponsive_after,
        lease,
        poison_after,
        queue_ahead,
        audits,
    }
}

/// Returns the first time as it is, the others as differences to the one before.
fn differences(mut t: Vec<Micros>) -> Vec<Micros> {
    for i in (1..t.len()).rev() {
        t[i] = t[i].saturating_sub(t[i - 1]);
    }
    t
}

/// A clock that notes its readings.
struct Readings<'a> {
    clock: &'a dyn Clock,
    taken: RefCell<Vec<Micros>>,
}

impl Clock for Readings<'_> {
    fn now(&self) -> Micros {
        let now = self.clock.now();
        self.taken.borrow_mut().push(now);
        now
    }
}

/// The state of a record while it is written.
struct Tape {
    to: SyncSender<Entry>,
    /// Termination thresholds of the frames in progress.
    eps: BTreeMap<FrameId, f64>,
    /// Frames of the tasks in progress.
    frames: BTreeMap<TaskId, FrameId>,
    pending: Vec<Decision>,
}

impl Tape {
    fn decided(&mut self, action: &Action) {
        self.pending.push(Decision::new(action));
        match action {
            Action::Send { message: ToWorker::Lease(lease), .. } => {
                self.frames.insert(lease.task, lease.frame);
            }
            Action::Send { message: ToWorker::Region(lease), .. } => {
                self.frames.insert(lease.task, lease.frame);
            }
            Action::FrameDone { frame, .. } | Action::FrameFailed { frame, .. } => {
                self.forget(*frame);
            }
            _ => {}
        }
    }

    fn forget(&mut self, frame: FrameId) {
        self.eps.remove(&frame);
        self.frames.retain(|_, f| *f != frame);
    }
}

/// A scheduler that may be recorded.
pub(crate) struct RecordedScheduler {
    scheduler: Scheduler,
    tape: Option<Tape>,
}

impl Deref for RecordedScheduler {
    type Target = Scheduler;

    fn deref(&self) -> &Scheduler {
        &self.scheduler
    }
}

impl RecordedScheduler {
    pub(crate) fn new(config: Config, recorder: Option<Recorder>) -> Self {
        let tape = recorder.map(|Recorder { to }| Tape {
            to,
            eps: BTreeMap::new(),
            frames: BTreeMap::new(),
            pending: Vec::new(),
        });
        let mut watched = RecordedScheduler { scheduler: Scheduler::new(config), tape };
        watched.send(Entry::Begin(config));
        watched
    }

    /// Calls [`Scheduler::handle`] and records the event.
    pub(crate) fn handle(&mut self, clock: &dyn Clock, event: Event) {
        let Some(tape) = &mut self.tape else { return self.scheduler.handle(clock, event) };
        if let Event::FrameQueued(job) = &event {
            tape.eps.insert(job.frame, job.scene.quality.eps);
        }
        if let Event::CancelFrame { frame } = &event {
            tape.forget(*frame);
        }
        let note = noted(&event, |result, a| {
            // The result of an unknown task is dropped.
            let eps = tape.frames.get(&result.task).and_then(|f| tape.eps.get(f));
            eps.is_some_and(|&eps| is_shut(a, eps))
        });
        let queued = match (&event, &note) {
            (Event::FrameQueued(job), None) => Some(job.clone()),
            _ => None,
        };
        let readings = Readings { clock, taken: RefCell::new(Vec::with_capacity(8)) };
        self.scheduler.handle(&readings, event);
        let t = readings.taken.into_inner();
        match (note, queued) {
            (Some(note), _) => self.send(Entry::Event(t, note)),
            (None, Some(job)) => self.send(Entry::Queued(t, job)),
            (None, None) => {}
        }
    }

    /// Calls [`Scheduler::next_action`] and records the decision.
    pub(crate) fn next_action(&mut self) -> Option<Action> {
        let action = self.scheduler.next_action();
        let Some(tape) = &mut self.tape else { return action };
        match &action {
            Some(action) => tape.decided(action),
            None if tape.pending.is_empty() => {}
            None => {
                let pending = std::mem::take(&mut tape.pending);
                self.send(Entry::Out(pending));
            }
        }
        action
    }

    fn send(&mut self, entry: Entry) {
        let Some(tape) = &self.tape else { return };
        match tape.to.try_send(entry) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => {
                warn!("recording stopped: the disk fell behind the master");
                self.tape = None;
            }
            // Writing failed; the thread returns why.
            Err(TrySendError::Disconnected(_)) => {
                warn!("recording stopped: the record could not be written");
                self.tape = None;
            }
        }
    }
}

impl Drop for RecordedScheduler {
    /// Writes the last line, which says that the record is whole. Decisions that a master which
    /// ends did not carry out are in it.
    fn drop(&mut self) {
        if self.tape.is_some() {
            while self.next_action().is_some() {}
        }
        if let Some(tape) = self.tape.take() {
            let _ = tape.to.send(Entry::End);
        }
    }
}
