//! A session: the master's end of one page's WebSocket.
//!
//! One task owns the state. It reads messages, begins passes, and queues what goes out; a second task
//! writes to the socket, so that a slow link never keeps messages from being read. What is slow
//! (opening a volume, drawing, encoding) runs in tasks of its own and comes back as an [`Outcome`].

mod asks;
mod passes;
mod thumbs;

use crate::descriptions::Described;
use crate::messages::{Ack, Head, Hello, LONGEST, Open, Ping, Scene, View, WatchAsk};
use crate::picture::{Drawn, Early, check_size};
use crate::preview::Preview;
use crate::problem::Problem;
use crate::server::stopped;
use crate::shared::{LIVE_EDGE, LIVE_PIXELS, Shared, unix_ms};
use crate::slot::{Pair, Pass, Slot, Step};
use crate::tile::Codecs;
use crate::volume::{Shown, describe};
use axum::extract::ws::{CloseFrame, Message, WebSocket};
use futures_util::stream::{SplitSink, SplitStream};
use futures_util::{SinkExt, StreamExt};
use serde::de::DeserializeOwned;
use serde_json::{Value, json};
use slabcast_master::jobs::FinishedFrame;
use slabcast_master::library::Viewer;
use slabcast_scene::request::{PathRequest, VolumeChoice};
use std::collections::VecDeque;
use std::net::IpAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::sync::mpsc;
use tokio::task::JoinSet;
use tracing::debug;

/// Time for the first message.
const HELLO: Duration = Duration::from_secs(5);

/// Interval of WebSocket pings.
const PING: Duration = Duration::from_secs(20);

/// Time for a client to take the close code and close.
const FAREWELL: Duration = Duration::from_secs(1);

/// Messages that wait for the socket's writer. Others wait in the session's own queue, where those
/// of an old pass can be dropped.
const WRITING: usize = 4;

/// Messages of any kind that wait in the session's queue before it is given up.
const MOST_QUEUED: usize = 4096;

/// Messages that wait to be written beyond which no news is looked for.
const NEWS_WAITING: usize = 8;

/// Requests of a page that are answered at a time, its pictures included.
const MOST_TASKS: usize = 32;

/// Messages a second that a client may send, and at once.
const RATE: f64 = 500.0;
const BURST: f64 = 1000.0;

/// Number of the notice that no worker is there.
const NO_WORKER: u32 = 1;

/// Close codes of docs/reference/live.md.
pub(crate) mod code {
    pub(crate) const GOING: u16 = 1001;
    pub(crate) const RULE: u16 = 1008;
    pub(crate) const TOO_LONG: u16 = 1009;
    pub(crate) const PROTOCOL: u16 = 4400;
    pub(crate) const TOKEN: u16 = 4401;
    pub(crate) const FULL: u16 = 4429;
}

/// Why a session ends: a close code, and words.
struct End(u16, String);

/// Result of a task that a session started.
pub(super) enum Outcome {
    /// A volume was opened, or not.
    Opened { open: Box<Opening>, result: Result<Option<Described>, Problem> },
    /// A pass was drawn. `number`: which.
    Drawn { number: u64, result: Result<Box<Drawn>, Problem> },
    /// The present state of what is watched.
    News(crate::news::Snapshot),
    /// A moving picture of a scene was compared with its still: its rung, and how far it was off.
    Compared { scene: u32, rung: usize, off: f32 },
    /// A thumbnail was drawn, or not.
    Thumb { id: u32, result: Result<Message, String> },
    /// Messages to be sent.
    Say(Vec<Message>),
}

/// A volume that is being opened.
pub(super) struct Opening {
    /// Newer ones have higher numbers.
    number: u64,
    /// Name that was asked for; `None`: the master's own, or its first.
    name: Option<String>,
    /// Whether in answer to the first message.
    hello: bool,
    id: u64,
    then: First,
}

/// View and scene that come with a volume.
#[derive(Clone, Debug, Default)]
pub(super) struct First {
    view: Option<View>,
    scene: Option<Scene>,
}

/// A message that waits to be written, and the pass that it belongs to.
struct Queued {
    message: Message,
    pass: Option<(Pair, Pass)>,
}

struct Session {
    shared: Arc<Shared>,
    id: u64,
    viewer: Viewer,
    codecs: Codecs,
    shown: Option<Arc<Shown>>,
    /// Number of the volume that is being opened.
    opening: Option<u64>,
    opened: u64,
    size: [u32; 2],
    view: View,
    scene: Scene,
    /// Whether the last moving input was a change of the scene.
    edited: bool,
    slot: Slot,
    preview: Preview,
    asked_at: Instant,
    drawing: Option<passes::Drawing>,
    passes: u64,
    /// Tiles of the still that is being drawn.
    early: (mpsc::Sender<Early>, mpsc::Receiver<Early>),
    /// The last moving picture: its rung, request and frame.
    previewed: Option<(usize, PathRequest, Arc<FinishedFrame>)>,
    /// The last still, and its request: the same again need not be drawn.
    frame: Option<(PathRequest, Arc<FinishedFrame>)>,
    /// Passes with the time at which each was sent; acknowledgements give the client's pace.
    sent: VecDeque<(Pair, Pass, Instant)>,
    painted_at: Option<Instant>,
    queue: VecDeque<Queued>,
    tasks: JoinSet<Outcome>,
    thumbs: Vec<thumbs::Wanted>,
    thumb: Option<thumbs::InHand>,
    watched: Vec<String>,
    news: crate::news::News,
    news_asked: bool,
    /// Render threads of all workers, as the last news had them.
    threads: u32,
    /// Whether the client was told that no worker is there.
    lacks_worker: bool,
    /// Whether the client was told that its quality is not drawn.
    told_quality: bool,
}

/// Makes a text message.
pub(super) fn text(value: &Value) -> Message {
    Message::Text(value.to_string().into())
}

/// Runs a session until either side closes.
pub(crate) async fn run(shared: Arc<Shared>, socket: WebSocket, peer: Option<IpAddr>) {
    let _place = match shared.sessions.take(peer) {
        Ok(place) => place,
        Err(words) => {
            let mut socket = socket;
            let close = CloseFrame { code: code::FULL, reason: words.into() };
            let _ = socket.send(Message::Close(Some(close))).await;
            return;
        }
    };
    let (sink, mut stream) = socket.split();
    let (to_writer, from_session) = mpsc::channel(WRITING);
    let writer = tokio::spawn(write(sink, from_session));
    let end = match begin(&shared, &mut stream, peer).await {
        Ok((mut session, hello)) => session.live(hello, &mut stream, &to_writer).await,
        Err(end) => end,
    };
    let End(code, reason) = end;
    debug!(?peer, code, reason, "live session ended");
    if code != 0 {
        let mut stop = shared.stop.clone();
        if code == code::GOING && *stop.borrow_and_update() {
            let bye = text(&json!({"type": "bye", "text": reason, "retry_ms": 1000}));
            let _ = tokio::time::timeout(Duration::from_millis(200), to_writer.send(bye)).await;
        }
        // A reason has 123 bytes at most.
        let reason: String = reason.chars().take(60).collect();
        let close = Message::Close(Some(CloseFrame { code, reason: reason.into() }));
        let _ = tokio::time::timeout(Duration::from_secs(1), to_writer.send(close)).await;
    }
    drop(to_writer);
    // What the client still sends is read: a socket that is closed over unread bytes is reset, and the
    // close code is lost on its way.
    let rest = async { while let Some(Ok(_)) = stream.next().await {} };
    let _ = tokio::time::timeout(FAREWELL, rest).await;
    // The writer ends when it has written, or is stuck.
    let _ = tokio::time::timeout(FAREWELL, writer).await;
}

/// Writes messages to the socket until there are no more, and pings.
async fn write(mut sink: SplitSink<WebSocket, Message>, mut messages: mpsc::Receiver<Message>) {
    let mut ping = tokio::time::interval_at(tokio::time::Instant::now() + PING, PING);
    loop {
        let message = tokio::select! {
            message = messages.recv() => message,
            _ = ping.tick() => Some(Message::Ping(bytes::Bytes::new())),
        };
        let Some(message) = message else { break };
        let is_last = matches!(message, Message::Close(_));
        // A client that takes no byte for a minute loses its connection (`write_limit`).
        match sink.send(message).await {
            Ok(()) if !is_last => {}
            _ => return,
        }
    }
    let _ = tokio::time::timeout(Duration::from_secs(1), sink.close()).await;
}

/// Takes the text of a message; what is no text of ours ends the session.
fn text_of(received: Option<Result<Message, axum::Error>>) -> Result<Option<String>, End> {
    match received {
        None | Some(Ok(Message::Close(_))) => Err(End(0, "the client closed".into())),
        Some(Ok(Message::Text(text))) if text.len() > LONGEST => {
            Err(End(code::TOO_LONG, "a message is longer than 64 KiB".into()))
        }
        Some(Ok(Message::Text(text))) => Ok(Some(text.as_str().to_owned())),
        Some(Ok(Message::Binary(_))) => {
            Err(End(code::RULE, "messages from clients are text".into()))
        }
        Some(Ok(Message::Ping(_) | Message::Pong(_))) => Ok(None),
        Some(Err(e)) if e.to_string().to_lowercase().contains("too long") => {
            Err(End(code::TOO_LONG, "a message is longer than 64 KiB".into()))
        }
        Some(Err(e)) => Err(End(0, e.to_string())),
    }
}

/// Waits for the first message and checks it.
async fn begin(
    shared: &Arc<Shared>,
    stream: &mut SplitStream<WebSocket>,
    peer: Option<IpAddr>,
) -> Result<(Session, Hello), End> {
    let first = async {
        loop {
            if let Some(text) = text_of(stream.next().await)? {
                return Ok(text);
            }
        }
    };
    let no_hello = |_| End(code::RULE, "no hello within 5 s".into());
    let first = tokio::time::timeout(HELLO, first).await.map_err(no_hello)??;
    let no_json = |e: serde_json::Error| End(code::RULE, format!("hello: {e}"));
    let head: Head = serde_json::from_str(&first).map_err(no_json)?;
    if head.kind != "hello" {
        return Err(End(code::RULE, "the first message is no hello".into()));
    }
    let hello: Hello = serde_json::from_str(&first).map_err(no_json)?;
    let [oldest, newest] = hello.protocol;
    if oldest > 1 || newest < 1 {
        let words = format!("this master speaks 1, the page {oldest} to {newest}");
        return Err(End(code::PROTOCOL, words));
    }
    if !shared.guard.knows_token(hello.token.as_deref()) {
        return Err(End(code::TOKEN, "the token is missing or unknown".into()));
    }
    check_size(hello.size).map_err(|e| End(code::RULE, e.to_string()))?;
    let takes = |codec: &str| hello.codecs.iter().any(|c| c == codec);
    let session = Session {
        id: shared.fresh_id(),
        viewer: shared.handle.viewer(peer),
        codecs: Codecs { jpeg: takes("jpeg"), webp: takes("webp") },
        shown: None,
        opening: None,
        opened: 0,
        size: hello.size,
        view: View { seq: 0, camera: Default::default(), size: hello.size, moving: false },
        scene: Scene::home(0),
        edited: false,
        slot: Slot::default(),
        preview: Preview::default(),
        asked_at: Instant::now(),
        drawing: None,
        passes: 0,
        early: mpsc::channel(passes::EARLY_BATCHES),
        previewed: None,
        frame: None,
        sent: VecDeque::new(),
        painted_at: None,
        queue: VecDeque::new(),
        tasks: JoinSet::new(),
        thumbs: Vec::new(),
        thumb: None,
        watched: Vec::new(),
        news: Default::default(),
        news_asked: false,
        threads: 0,
        lacks_worker: false,
        told_quality: false,
        shared: shared.clone(),
    };
    Ok((session, hello))
}

/// Event for which a session's loop waits.
enum Woken {
    Received(Option<Result<Message, axum::Error>>),
    Done(Option<Result<Outcome, tokio::task::JoinError>>),
    Early(Option<Early>),
    MayWrite,
    Time,
    News,
    Stop,
    WriterGone,
}

impl Session {
    /// Runs until the session's end, and says why.
    async fn live(
        &mut self,
        hello: Hello,
        stream: &mut SplitStream<WebSocket>,
        writer: &mpsc::Sender<Message>,
    ) -> End {
        self.welcome().await;
        self.watch(hello.watch);
        let first = First { view: hello.view, scene: hello.scene };
        self.open(hello.volume, true, 0, first);
        let mut allowance = (BURST, Instant::now());
        let mut stop = self.shared.stop.clone();
        let mut news = tokio::time::interval(crate::news::EVERY);
        news.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        loop {
            let until = match self.advance() {
                Step::Wait(until) => until.map(|at| self.shared.moment(at)),
                Step::Begin(..) | Step::Drop => None,
            };
            let timer = async {
                match until {
                    Some(until) => tokio::time::sleep_until(until).await,
                    None => std::future::pending().await,
                }
            };
            let has_queue = !self.queue.is_empty();
            let takes_early = self.queue.len() < passes::EARLY_WAITING;
            let woken = tokio::select! {
                received = stream.next() => Woken::Received(received),
                early = self.early.1.recv(), if takes_early => Woken::Early(early),
                done = self.tasks.join_next(), if !self.tasks.is_empty() => Woken::Done(done),
                place = writer.reserve(), if has_queue => match place {
                    Ok(place) => {
                        if let Some(queued) = self.queue.pop_front() {
                            place.send(queued.message);
                        }
                        Woken::MayWrite
                    }
                    Err(_) => Woken::WriterGone,
                },
                () = timer => Woken::Time,
                _ = news.tick(), if !self.watched.is_empty() || self.shown.is_none() => Woken::News,
                () = stopped(&mut stop) => Woken::Stop,
            };
            match woken {
                Woken::Received(received) => match text_of(received) {
                    Ok(Some(text)) => {
                        let (left, since) = &mut allowance;
                        *left = (*left + RATE * since.elapsed().as_secs_f64()).min(BURST) - 1.0;
                        *since = Instant::now();
                        if *left < 0.0 {
                            return End(code::RULE, "more than 500 messages a second".into());
                        }
                        if let Err(end) = self.take(&text) {
                            return end;
                        }
                    }
                    Ok(None) => {}
                    Err(end) => return end,
                },
                Woken::Done(Some(Ok(outcome))) => self.finish(outcome),
                Woken::Early(early) => self.show_early(early),
                // An aborted pass.
                Woken::Done(_) | Woken::MayWrite | Woken::Time => {}
                Woken::News => self.ask_news(),
                Woken::Stop => return End(code::GOING, "the master ends".into()),
                Woken::WriterGone => return End(0, "the socket takes nothing".into()),
            }
            if self.queue.len() > MOST_QUEUED {
                return End(code::RULE, "the client reads too slowly".into());
            }
        }
    }

    /// Queues a message that belongs to no pass.
    pub(super) fn send(&mut self, message: Option<Message>) {
        self.queue.extend(message.map(|message| Queued { message, pass: None }));
    }

    fn say(&mut self, value: &Value) {
        self.queue.push_back(Queued { message: text(value), pass: None });
    }

    fn refuse(&mut self, problem: &Problem, re: &str, id: u64) {
        self.say(&problem.message(re, id));
    }

    async fn welcome(&mut self) {
        let (shared, viewer) = (self.shared.clone(), self.viewer);
        let listed = shared.handle.looking(move |library| library.list(viewer).is_empty()).await;
        let limits = json!({
            "live_edge": LIVE_EDGE, "live_pixels": LIVE_PIXELS,
            "picture_edge": crate::http::PICTURE_EDGE, "upload_bytes": crate::http::UPLOAD_BYTES,
            "chunk_bytes": crate::http::CHUNK_BYTES, "state_bytes": crate::http::STATE_BYTES,
            "frames": crate::http::MOVIE_FRAMES,
        });
        let name = if shared.config.name.is_empty() {
            &shared.config.machine
        } else {
            &shared.config.name
        };
        self.say(&json!({
            "type": "welcome", "protocol": 1, "server": name,
            "version": env!("CARGO_PKG_VERSION"),
            "pixels_version": slabcast_common::PIXELS_VERSION, "now_ms": unix_ms(),
            "empty": listed.unwrap_or(true),
            "roles": ["view", "submit", "upload", "cancel"],
            "movies": shared.files.movies(), "limits": limits,
        }));
    }

    /// Has a volume opened on a thread of its own. It replaces one that is being opened.
    fn open(&mut self, name: Option<String>, hello: bool, id: u64, then: First) {
        self.opened += 1;
        self.opening = Some(self.opened);
        let open = Box::new(Opening { number: self.opened, name, hello, id, then });
        let (shared, viewer, size) = (self.shared.clone(), self.viewer, self.size);
        self.tasks.spawn(async move {
            let result = opened(&shared, open.name.clone(), viewer, size).await;
            Outcome::Opened { open, result }
        });
    }

    fn finish(&mut self, outcome: Outcome) {
        match outcome {
            Outcome::Opened { open, .. } if self.opening != Some(open.number) => {}
            Outcome::Opened { open, result } => {
                self.opening = None;
                match result {
                    Ok(Some(described)) => self.show(described, *open),
                    // A master without volumes waits for the first.
                    Ok(None) => {}
                    Err(problem) => {
                        let re = if open.hello { "hello" } else { "open" };
                        self.refuse(&problem, re, open.id);
                        if self.shown.is_none() && open.name.is_some() {
                            // Its own volume, and the home view.
                            self.open(None, true, 0, First::default());
                        }
                        // Views that came meanwhile are of the volume that stays.
                        self.changed();
                    }
                }
            }
            Outcome::Drawn { number, result } => self.drawn(number, result),
            Outcome::News(snapshot) => {
                self.news_asked = false;
                self.tell_workers(snapshot.threads);
                for message in self.news.changes(snapshot) {
                    self.say(&message);
                }
                if self.shown.is_none() && self.opening.is_none() {
                    self.open(None, true, 0, First::default());
                }
            }
            Outcome::Compared { scene, rung, off } => {
                if scene == self.scene.rev {
                    self.preview.compared(rung, off);
                }
            }
            Outcome::Thumb { id, result } => self.thumb_drawn(id, result),
            Outcome::Say(messages) => {
                let queued = messages.into_iter().map(|message| Queued { message, pass: None });
                self.queue.extend(queued);
            }
        }
    }

    /// Tells when the last worker left, and when one is there again.
    fn tell_workers(&mut self, threads: u32) {
        self.threads = threads;
        let has_worker = threads > 0;
        if std::mem::replace(&mut self.lacks_worker, !has_worker) != has_worker {
            return;
        }
        if has_worker {
            self.say(&json!({"type": "notice_over", "id": NO_WORKER}));
            return;
        }
        self.say(&json!({
            "type": "notice", "level": "warning", "until": "over", "id": NO_WORKER,
            "text": "No worker is there, so the picture stays as it is.",
            "remedy": "Start one: slabcast worker --master HOST:PORT",
        }));
    }

    /// Watches other things, and has their present state told.
    fn watch(&mut self, of: Vec<String>) {
        self.watched = of;
        self.news = Default::default();
        self.ask_news();
    }

    /// Has the present state of what is watched looked at, unless that is under way.
    fn ask_news(&mut self) {
        // A client that reads slowly gets the state of the moment at which it has read.
        let waiting = self.queue.iter().filter(|queued| queued.pass.is_none()).count();
        if self.news_asked || waiting > NEWS_WAITING {
            return;
        }
        self.news_asked = true;
        let (shared, viewer, watched) = (self.shared.clone(), self.viewer, self.watched.clone());
        self.tasks.spawn(async move {
            Outcome::News(crate::news::look(&shared, viewer, &watched).await)
        });
    }

    /// Shows a volume that was opened.
    fn show(&mut self, described: Described, open: Opening) {
        let Described { shown, message } = described;
        let Opening { hello, id, then: First { view, scene }, .. } = open;
        self.drop_pass();
        self.drop_thumb();
        self.slot.clear();
        self.preview = Preview::default();
        self.previewed = None;
        self.frame = None;
        self.send(Some(Message::Text(message)));
        self.shown = Some(shown.clone());
        let re = if hello { "hello" } else { "open" };
        // The home view has the numbers of the latest view and scene.
        let (seq, size) = (self.view.seq, self.size);
        self.view = View { seq, camera: shown.home.clone(), size, moving: false };
        self.scene = Scene::home(self.scene.rev);
        if let Some(view) = view {
            match check_size(view.size) {
                Ok(()) => {
                    self.size = view.size;
                    self.view = view;
                }
                Err(e) => self.refuse(&Problem::field(&e), re, id),
            }
        }
        if let Some(scene) = scene {
            match scene.quality.check() {
                Ok(()) => self.scene = scene,
                Err(e) => self.refuse(&Problem::field(&e), re, id),
            }
        }
        self.changed();
    }

    /// Tells the slot of the latest pair.
    fn changed(&mut self) {
        self.asked_at = Instant::now();
        let is_moving = self.view.moving || self.scene.moving;
        if self.shown.is_some() && self.opening.is_none() {
            self.slot.change(self.pair(), is_moving, self.shared.now());
            self.withdraw_old_still();
        }
    }

    /// Drops what of a still that is no longer wanted was not written yet. Moving passes go on: on a
    /// slow link each would be dropped for the next, and none would ever be whole.
    fn withdraw_old_still(&mut self) {
        let latest = self.pair();
        let mut withdrawn = None;
        self.queue.retain(|queued| match queued.pass {
            Some((pair, Pass::Still)) if pair != latest => {
                withdrawn = Some(pair);
                false
            }
            _ => true,
        });
        if let Some(pair) = withdrawn {
            self.slot.withdrawn(pair);
            self.sent.retain(|(of, pass, _)| (*of, *pass) != (pair, Pass::Still));
        }
    }

    fn pair(&self) -> Pair {
        Pair { seq: self.view.seq, scene: self.scene.rev }
    }

    /// Takes a message.
    fn take(&mut self, text: &str) -> Result<(), End> {
        let head: Head = serde_json::from_str(text).map_err(|e| {
            End(code::RULE, format!("a message is no JSON object with a type: {e}"))
        })?;
        let (kind, id) = (head.kind.clone(), head.id());
        if let Err(problem) = self.act(&head, text) {
            self.refuse(&problem, &kind, id);
        }
        Ok(())
    }

    fn act(&mut self, head: &Head, text: &str) -> Result<(), Problem> {
        match head.kind.as_str() {
            "view" => {
                let view: View = read(text)?;
                check_size(view.size).map_err(|e| Problem::field(&e))?;
                self.edited &= !view.moving;
                (self.size, self.view) = (view.size, view);
                self.changed();
            }
            "scene" => {
                let scene: Scene = read(text)?;
                scene.quality.check().map_err(|e| Problem::field(&e))?;
                if scene.tf != self.scene.tf || scene.crop != self.scene.crop {
                    self.preview.scene_changed(scene.moving);
                }
                self.edited = scene.moving;
                self.tell_quality(&scene);
                self.scene = scene;
                self.changed();
            }
            "ack" => self.acknowledged(&read(text)?),
            "ping" => {
                let Ping { t } = read(text)?;
                self.say(&json!({"type": "pong", "t": t}));
            }
            "open" => {
                let Open { volume, scene, view } = read(text)?;
                let then = First { view, scene };
                self.open(Some(volume), false, head.id(), then);
            }
            "watch" => {
                let WatchAsk { of } = read(text)?;
                self.watch(of);
            }
            _ if self.tasks.len() >= MOST_TASKS => {
                let busy = "as many requests as a page may have are being answered; wait";
                return Err(Problem::new("busy", busy));
            }
            _ => self.ask(head, text)?,
        }
        Ok(())
    }

    /// Tells once that live pictures have one quality.
    fn tell_quality(&mut self, scene: &Scene) {
        if scene.quality.is_usual() || std::mem::replace(&mut self.told_quality, true) {
            return;
        }
        self.say(&json!({
            "type": "notice", "level": "info", "until": "dismissed",
            "text": "This master shows pictures in the usual quality.",
            "remedy": "The command line that the page gives draws in the quality that you chose.",
        }));
    }

    fn acknowledged(&mut self, ack: &Ack) {
        let pair = Pair { seq: ack.seq, scene: ack.scene };
        let pass = if ack.pass == "still" { Pass::Still } else { Pass::Moving };
        if !self.slot.painted(pair, pass) {
            return;
        }
        let now = Instant::now();
        while let Some((of, kind, at)) = self.sent.pop_front() {
            if (of, kind) == (pair, pass) {
                if pass == Pass::Moving {
                    let late_ms = (now - at).as_secs_f64() * 1e3;
                    let since = self.painted_at.map_or(at, |painted| painted.max(at));
                    self.preview.painted(late_ms, (now - since).as_secs_f64() * 1e3);
                }
                break;
            }
        }
        self.painted_at = Some(now);
    }

    /// Begins and drops passes until there is nothing to do now. Returns for what to wait.
    fn advance(&mut self) -> Step {
        loop {
            let Some(shown) = self.shown.clone().filter(|_| self.opening.is_none()) else {
                return Step::Wait(None);
            };
            match self.slot.step(self.preview.is_slow(), self.shared.now()) {
                Step::Drop => self.drop_pass(),
                Step::Begin(pair, pass) => self.begin_pass(&shown, pair, pass),
                wait @ Step::Wait(_) => {
                    self.next_thumb();
                    return wait;
                }
            }
        }
    }
}

/// Reads a message.
pub(super) fn read<T: DeserializeOwned>(text: &str) -> Result<T, Problem> {
    serde_json::from_str(text).map_err(|e| Problem::json(&e))
}

/// Picture size in pixels for which `slabcast view` describes its volume at start: the page on a common
/// screen. Other sizes reuse the size-independent facts, which take most of the time.
const USUAL_SIZE: [u32; 2] = [1280, 960];

/// Warms the cache of descriptions for `slabcast view`, so that its first page doesn't wait. Does nothing on
/// other masters, whose page may never be opened.
pub(crate) async fn prepare(shared: Arc<Shared>) {
    if shared.config.home.file.is_none() {
        return;
    }
    if let Err(problem) = opened(&shared, None, Viewer::own(), USUAL_SIZE).await {
        debug!(problem = problem.problem, "the volume can't be described yet");
    }
}

/// Opens a volume and describes it, on a blocking thread. Without a name: the master's own, or its first
/// that can be read; `None` if there is none.
async fn opened(
    shared: &Arc<Shared>,
    name: Option<String>,
    viewer: Viewer,
    size: [u32; 2],
) -> Result<Option<Described>, Problem> {
    let of_page = shared.clone();
    let described = shared.handle.reading(move |library| {
        let choice = match name {
            Some(name) => VolumeChoice::Name(name),
            None if library.default_volume().is_some() => VolumeChoice::Default,
            None => {
                let listed = library.list(viewer).into_iter();
                match listed.map(|entry| (entry.problem, entry.name)).min() {
                    Some((_, first)) => VolumeChoice::Name(first),
                    None => return Ok(None),
                }
            }
        };
        let open = library.open(&choice, viewer)?;
        let digest = open.served.info.digest;
        let name = library.name_of(digest, viewer);
        let is_own = library.default_volume().is_some_and(|own| own.info.digest == digest);
        let home = &of_page.config.home;
        let home = if is_own { home.clone() } else { home.of_another() };
        describe(&of_page.descriptions, &open, &name, size, &home).map(Some)
    });
    described.await.ok_or_else(Problem::ending)?
}
