//! Writing a record beside a scheduler that runs.

use super::{Decision, Head, Line, Noted, NotedJob, ROOM, VERSION, brick_to_line, noted, to_hex};
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
use std::time::Duration;
use tracing::warn;

/// What was written is on its way to the disk after this long at the latest: a second of a run
/// that somebody kills is lost, no more.
const FLUSH: Duration = Duration::from_secs(1);

/// What goes from the driver to the thread that writes.
enum Entry {
    Begin(Config),
    Event(Vec<Micros>, Noted),
    Queued(Vec<Micros>, Box<FrameJob>),
    Out(Vec<Decision>),
    End,
}

/// The driver's end of a record: [`crate::MasterConfig::record`].
pub struct Recorder {
    to: SyncSender<Entry>,
}

/// What was written.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Events.
    pub events: u64,
    /// Decisions.
    pub decisions: u64,
    /// Why it ends early, if it does.
    pub cut: Option<String>,
}

/// Starts a thread that writes a record to `out`. It ends, and says what it wrote, when the
/// master that was given the [`Recorder`] has ended.
///
/// # Errors
/// If the system gives no thread.
pub fn start(
    out: impl Write + Send + 'static,
) -> std::io::Result<(Recorder, JoinHandle<std::io::Result<Written>>)> {
    let (to, entries) = sync_channel(ROOM);
    let thread = std::thread::Builder::new()
        .name("slabcast-record".into())
        .spawn(move || write(BufWriter::with_capacity(1 << 18, out), &entries))?;
    Ok((Recorder { to }, thread))
}

fn put(out: &mut impl Write, line: &Line) -> std::io::Result<()> {
    serde_json::to_writer(&mut *out, line)?;
    out.write_all(b"\n")
}

fn write(mut out: impl Write, entries: &Receiver<Entry>) -> std::io::Result<Written> {
    let mut written =
        Written { events: 0, decisions: 0, cut: Some("the disk fell behind the master".into()) };
    let (mut sets, mut scenes) = (BTreeSet::<BrickSetKey>::new(), BTreeSet::<SceneId>::new());
    loop {
        let entry = match entries.recv_timeout(FLUSH) {
            Ok(entry) => entry,
            Err(RecvTimeoutError::Timeout) => {
                out.flush()?;
                continue;
            }
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
    let Written { events, decisions, cut } = written.clone();
    put(&mut out, &Line::End { events, decisions, cut })?;
    out.flush()?;
    Ok(written)
}

/// The first line.
fn head(config: &Config) -> Head {
    let &Config { heartbeat, silence, lease, poison_after, queue_ahead, mixed: _ } = config;
    Head {
        version: VERSION,
        program: env!("CARGO_PKG_VERSION").into(),
        pixels_version: PIXELS_VERSION,
        protocol_version: PROTOCOL_VERSION,
        heartbeat,
        silence,
        lease,
        poison_after,
        queue_ahead,
    }
}

/// The first in full, the others as differences to the one before.
fn differences(mut t: Vec<Micros>) -> Vec<Micros> {
    for i in (1..t.len()).rev() {
        t[i] = t[i].saturating_sub(t[i - 1]);
    }
    t
}

/// A clock whose readings are kept.
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

/// What a record needs to know on the way.
struct Tape {
    to: SyncSender<Entry>,
    /// Cut-offs of the frames that were queued.
    eps: BTreeMap<FrameId, f64>,
    /// Which frame a task belongs to.
    frames: BTreeMap<TaskId, FrameId>,
    pending: Vec<Decision>,
}

impl Tape {
    fn decided(&mut self, action: &Action) {
        self.pending.push(Decision::of(action));
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

/// A scheduler, and perhaps a record of it.
pub(crate) struct Watched {
    scheduler: Scheduler,
    tape: Option<Tape>,
}

impl Deref for Watched {
    type Target = Scheduler;

    fn deref(&self) -> &Scheduler {
        &self.scheduler
    }
}

impl Watched {
    pub(crate) fn new(config: Config, recorder: Option<Recorder>) -> Self {
        let tape = recorder.map(|Recorder { to }| Tape {
            to,
            eps: BTreeMap::new(),
            frames: BTreeMap::new(),
            pending: Vec::new(),
        });
        let mut watched = Watched { scheduler: Scheduler::new(config), tape };
        watched.send(Entry::Begin(config));
        watched
    }

    /// [`Scheduler::handle`].
    pub(crate) fn handle(&mut self, clock: &dyn Clock, event: Event) {
        let Some(tape) = &mut self.tape else { return self.scheduler.handle(clock, event) };
        if let Event::FrameQueued(job) = &event {
            tape.eps.insert(job.frame, job.scene.quality.eps);
        }
        if let Event::CancelFrame { frame } = &event {
            tape.forget(*frame);
        }
        let note = noted(&event, |result, a| {
            // A task that nobody knows is one whose result is dropped.
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

    /// [`Scheduler::next_action`].
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
                warn!("the record ends here: the disk fell behind the master");
                self.tape = None;
            }
            // Writing failed; whoever waits for the thread says why.
            Err(TrySendError::Disconnected(_)) => {
                warn!("the record ends here: it could not be written");
                self.tape = None;
            }
        }
    }
}

impl Drop for Watched {
    /// A record whose last line says that it is whole. What nobody asked for any more (a master that
    /// ends carries nothing out) is in it.
    fn drop(&mut self) {
        if self.tape.is_some() {
            while self.next_action().is_some() {}
        }
        if let Some(tape) = self.tape.take() {
            let _ = tape.to.send(Entry::End);
        }
    }
}
