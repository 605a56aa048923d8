//! Links between the driver and its workers.
//!
//! The driver speaks to every worker through a [`WorkerLink`] and can't tell whether a network
//! lies behind it. The embedded link passes the same messages over channels, and bricks as shared
//! pointers; the TCP link ([`crate::serve`]) encodes both.

use crate::driver::Event;
use crate::handle::unix_ms;
use crate::hooks::Stage;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, WorkerId};
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{BrickBatch, Hello, ToMaster, ToWorker};
use slabcast_proto::convert::Bricks;
use slabcast_volumes::{BrickStore, Problem};
use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};
use tokio::sync::{Semaphore, mpsc};
use tracing::warn;

/// An order for one worker's bricks. Orders are carried out in the order in which they are sent.
pub enum BrickOrder {
    /// Sends bricks.
    Send {
        /// The brick set.
        set: BrickSetKey,
        /// The set's bricks.
        store: Arc<BrickStore>,
        /// Ids of the bricks to send.
        bricks: Vec<BrickId>,
        /// Takes the bricks that can't be read.
        losses: Losses,
    },
    /// Has the worker forget bricks. Travels here and not among the control messages, since
    /// "forget 5" and a new brick 5 must not change places on the way.
    Drop {
        /// The brick set.
        set: BrickSetKey,
        /// Ids of the bricks to forget.
        bricks: Vec<BrickId>,
    },
}

/// Tells the driver which bricks of an order were not sent, since their volume can't be read.
pub struct Losses {
    inbox: mpsc::Sender<Event>,
    worker: WorkerId,
    set: BrickSetKey,
}

impl Losses {
    pub(crate) fn new(inbox: mpsc::Sender<Event>, worker: WorkerId, set: BrickSetKey) -> Losses {
        Losses { inbox, worker, set }
    }

    /// Reports bricks that were not sent, and why.
    pub(crate) async fn report(&self, bricks: &[BrickId], reason: String) {
        let Losses { worker, set, .. } = *self;
        let lost = Event::BricksLost { worker, set, bricks: bricks.to_vec(), reason };
        let _ = self.inbox.send(lost).await;
    }
}

/// Returns bricks of a store, in the form that `get` gives. Files are read on a thread for blocking
/// work.
///
/// # Errors
/// A file can't be read, for people.
pub(crate) async fn bricks_of<T: Send + 'static>(
    store: &Arc<BrickStore>,
    ids: &[BrickId],
    get: fn(&BrickStore, BrickId) -> Result<Option<T>, Problem>,
) -> Result<Vec<T>, String> {
    let collect = move |store: &BrickStore, ids: &[BrickId]| {
        let found: Result<Vec<Option<T>>, Problem> = ids.iter().map(|id| get(store, *id)).collect();
        found.map(|found| found.into_iter().flatten().collect()).map_err(|e| e.to_string())
    };
    if !store.may_read() {
        return collect(store, ids);
    }
    let (store, ids) = (store.clone(), ids.to_vec());
    let read = tokio::task::spawn_blocking(move || collect(&store, &ids)).await;
    read.unwrap_or_else(|e| Err(format!("reading bricks: {e}; this is a bug of slabcast")))
}

/// The driver's end of a link to a worker. The link closes when the driver drops it.
///
/// Both channels are unbounded, since the driver never waits for a worker. Their contents are
/// bounded by what the driver sends:
pub struct WorkerLink {
    /// Control messages: at most the leases that the scheduler has lent the worker and, until
    /// silence ends the link, its pings (`4 * Config::silence / Config::unresponsive_after`, 12 by
    /// default).
    pub control: mpsc::UnboundedSender<ToWorker>,
    /// Orders for bricks: at most one for each brick that the worker lacks, as no brick is ordered
    /// twice.
    pub bricks: mpsc::UnboundedSender<BrickOrder>,
    /// Messages that were damaged on the link.
    pub damaged: Damaged,
}

/// Counter of messages that arrived damaged on a link, in either direction, with the time of the last. The
/// first one of a link is logged.
#[derive(Clone, Debug, Default)]
pub struct Damaged(Arc<Counter>);

#[derive(Debug, Default)]
struct Counter {
    messages: AtomicU64,
    /// Milliseconds since 1970 UTC.
    last_unix_ms: AtomicI64,
    worker: String,
    address: String,
}

impl Damaged {
    /// Counts for a worker by its name and address.
    pub(crate) fn of(worker: String, address: String) -> Damaged {
        Damaged(Arc::new(Counter { worker, address, ..Counter::default() }))
    }

    /// Adds `messages`.
    pub(crate) fn add(&self, messages: u64) {
        let Counter { messages: all, last_unix_ms, worker, address } = &*self.0;
        if messages > 0 {
            last_unix_ms.store(unix_ms(), Ordering::Relaxed);
        }
        if messages > 0 && all.fetch_add(messages, Ordering::Relaxed) == 0 {
            warn!(
                worker,
                address,
                "a message was damaged on its way and is sent again; ListWorkers counts more of them"
            );
        }
    }

    /// Returns when the last message was damaged, in milliseconds since 1970 UTC; `None` if none was.
    pub(crate) fn last_unix_ms(&self) -> Option<i64> {
        (self.get() > 0).then(|| self.0.last_unix_ms.load(Ordering::Relaxed))
    }

    /// Returns the number of damaged messages.
    pub fn get(&self) -> u64 {
        self.0.messages.load(Ordering::Relaxed)
    }
}

/// Places of one worker in the driver's inbox: a turn of the driver handles no more of it, and
/// whoever else has something to say waits for no more. At a quarter of it, the driver would have
/// to wake a link within a turn to have the results of 64 threads in one turn.
const PLACES: usize = 64;

/// Places that a message takes: one, and one more for each 128 bricks that it names (12 us of the
/// driver).
fn places_of(message: &ToMaster) -> u32 {
    let named = match message {
        ToMaster::BricksWanted { bricks, .. }
        | ToMaster::BricksEvicted { bricks, .. }
        | ToMaster::BricksBroken { bricks, .. } => bricks.len(),
        _ => 0,
    };
    (1 + named / 128).min(PLACES) as u32
}

/// Why a link ended before its worker closed it.
pub(crate) struct Broken {
    /// Reason, for logs.
    pub(crate) reason: String,
    /// Whether the line is at fault, and not what the worker was drawing.
    pub(crate) is_damage: bool,
}

/// The place that a worker calls from.
#[derive(Clone, Debug, Default)]
pub struct Caller {
    /// Address of the worker (`IP:PORT`); empty for a worker of this process.
    pub address: String,
    /// Whether the address is one of this machine, or the worker is of this process.
    pub is_local: bool,
}

impl Caller {
    /// The machine that a caller runs on, as far as the master can tell: `machine`, if it names
    /// one, or its address without the port, so that the next connection has the same.
    pub(crate) fn host(&self, machine: &str) -> String {
        if !machine.is_empty() {
            return machine.into();
        }
        let socket = self.address.parse::<std::net::SocketAddr>();
        socket.map_or_else(|_| self.address.clone(), |s| s.ip().to_string())
    }

    /// Whether a caller that says to be on `machine` shares the processors of a master on `own`.
    /// If one of them does not know its machine's name, the address decides: a caller from the
    /// address that it calls is on the machine that it calls. An address alone would not do, as
    /// each container has one of its own and both ends of a tunnel may have the same.
    pub(crate) fn is_on(&self, machine: &str, own: &str) -> bool {
        if machine.is_empty() || own.is_empty() { self.is_local } else { machine == own }
    }

    /// Whether a caller that says to be on `machine` is surely on that of a master on `own`, so
    /// that its pixels need no audit: it is of this process, or calls from the address that it
    /// calls and names the machine. Either alone can be had by a stranger: the address through a
    /// tunnel or a published port, the name from whoever knows it.
    pub(crate) fn is_surely_on(&self, machine: &str, own: &str) -> bool {
        self.address.is_empty() || self.is_local && !own.is_empty() && machine == own
    }
}

/// Bricks of one embedded batch: some 64 KiB, as over TCP, so that tiles start while the other
/// bricks are on their way.
const BATCH_BRICKS: usize = 64;

/// The worker's end of an embedded link: the three channels of a `slabcast_worker::Link`.
pub struct EmbeddedEnd {
    /// Control messages from the master; bounded as [`WorkerLink::control`] is.
    pub control: mpsc::UnboundedReceiver<ToWorker>,
    /// Messages to the master. The first must be the hello.
    pub replies: mpsc::Sender<ToMaster>,
    /// Bricks from the master, and orders to forget some.
    pub bricks: mpsc::Receiver<Bricks>,
}

/// Links a worker of this process to the master over channels. The worker is let in when it has
/// sent its hello.
///
/// # Panics
/// Outside a tokio runtime, which carries the messages.
pub fn embedded(handle: crate::Handle) -> EmbeddedEnd {
    let (control_tx, control_rx) = mpsc::unbounded_channel();
    let (reply_tx, mut reply_rx) = mpsc::channel::<ToMaster>(64);
    let (order_tx, mut order_rx) = mpsc::unbounded_channel::<BrickOrder>();
    let (batch_tx, batch_rx) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
    let hooks = handle.hooks().clone();
    let sending = tokio::spawn(async move {
        while let Some(order) = order_rx.recv().await {
            hooks.reach(Stage::SendBricks);
            match order {
                BrickOrder::Drop { set, bricks } => {
                    let message = ToWorker::DropBricks { set, bricks };
                    if batch_tx.send(Bricks::Message(message)).await.is_err() {
                        return;
                    }
                }
                BrickOrder::Send { set, store, bricks, losses } => {
                    for (i, ids) in bricks.chunks(BATCH_BRICKS).enumerate() {
                        let found = match bricks_of(&store, ids, BrickStore::try_brick).await {
                            Ok(found) => found,
                            Err(reason) => {
                                losses.report(&bricks[i * BATCH_BRICKS..], reason).await;
                                break;
                            }
                        };
                        let batch = BrickBatch { set, bricks: found, broken: Vec::new() };
                        if batch_tx.send(Bricks::Batch(batch)).await.is_err() {
                            return;
                        }
                    }
                }
            }
        }
    });
    tokio::spawn(async move {
        let Some(ToMaster::Hello(hello)) = reply_rx.recv().await else { return };
        let link =
            WorkerLink { control: control_tx, bricks: order_tx, damaged: Damaged::default() };
        let caller = Caller { address: String::new(), is_local: true };
        let broken = async {
            match sending.await {
                Err(e) if e.is_panic() => {
                    Broken { reason: "sending bricks to it panicked".into(), is_damage: false }
                }
                // The driver dropped the link, or the worker has gone: the replies tell.
                _ => std::future::pending().await,
            }
        };
        serve_until(handle, hello, caller, link, &mut reply_rx, broken).await;
    });
    EmbeddedEnd { control: control_rx, replies: reply_tx, bricks: batch_rx }
}

/// Lets a worker in and carries its messages to the driver until either side ends, or `broken` says
/// why it can't go on. A worker that is not let in gets the reason as [`ToWorker::Refused`].
pub(crate) async fn serve_until(
    handle: crate::Handle,
    hello: Hello,
    caller: Caller,
    link: WorkerLink,
    replies: &mut mpsc::Receiver<ToMaster>,
    broken: impl Future<Output = Broken>,
) {
    let control = link.control.clone();
    let worker = match handle.attach(hello, caller, link).await {
        Ok(worker) => worker,
        Err(refused) => {
            let _ = control.send(ToWorker::Refused { reason: refused.to_string() });
            return;
        }
    };
    // The driver holds the other sender: when it drops that, the link is over.
    drop(control);
    let places = Arc::new(Semaphore::new(PLACES));
    let carry = async {
        while let Some(message) = replies.recv().await {
            // The driver gives the place back when it has handled the message.
            let Ok(place) = places.clone().acquire_many_owned(places_of(&message)).await else {
                return None;
            };
            if !handle.worker_said(worker, message, place).await {
                return None;
            }
        }
        Some(Broken { reason: "its link closed".into(), is_damage: false })
    };
    let broken = tokio::select! {
        // First why it broke, since the replies end then as well.
        biased;
        broken = broken => Some(broken),
        broken = carry => broken,
    };
    if let Some(Broken { reason, is_damage }) = broken {
        handle.detach(worker, reason, is_damage).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn host_of_a_caller_is_the_same_for_all_its_connections() {
        let from = |address: &str| Caller { address: address.into(), is_local: false };
        assert_eq!(from("10.0.0.1:5").host(""), from("10.0.0.1:77").host(""));
        assert_eq!(from("[fe80::1]:5").host(""), "fe80::1");
        assert_eq!(from("10.0.0.1:5").host("boot-7"), from("10.0.0.2:5").host("boot-7"));
        assert_eq!(from("").host(""), "");
    }

    #[test]
    fn worker_is_on_the_masters_machine_by_machine_name_or_else_by_address() {
        let caller = |is_local| Caller { address: "10.0.0.1:5".into(), is_local };
        for (is_local, machine, own, want) in [
            (true, "a", "a", true),
            // A container, which has an address of its own.
            (false, "a", "a", true),
            // The other end of a tunnel.
            (true, "b", "a", false),
            (false, "b", "a", false),
            (true, "", "a", true),
            (false, "", "a", false),
            (true, "a", "", true),
            (false, "a", "", false),
            (true, "", "", true),
        ] {
            let caller = caller(is_local);
            assert_eq!(caller.is_on(machine, own), want, "{machine:?} on {own:?}");
            let is_sure = is_local && machine == "a" && own == "a";
            assert_eq!(caller.is_surely_on(machine, own), is_sure, "{machine:?} on {own:?}");
        }
        assert!(Caller::default().is_surely_on("", "a"), "of this process");
    }
}
