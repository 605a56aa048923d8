//! A worker's end at the master.
//!
//! The driver speaks to every worker through a [`WorkerLink`] and can't tell whether a network
//! lies behind it. The embedded link passes the very messages over channels, and bricks as
//! shared pointers; the TCP link ([`crate::serve`]) encodes both.

use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::BrickId;
use slabcast_common::link::BRICK_BATCHES_IN_FLIGHT;
use slabcast_common::message::{BrickBatch, Hello, ToMaster, ToWorker};
use slabcast_proto::convert::Bricks;
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use tokio::sync::mpsc;

/// What is to happen to a worker's bricks, in this order.
pub enum BrickOrder {
    /// Send some.
    Send {
        /// Of which set.
        set: BrickSetKey,
        /// Where they are.
        store: Arc<BrickStore>,
        /// Which.
        bricks: Vec<BrickId>,
    },
    /// Have some forgotten. Here and not among the control messages, since "forget 5" and a new
    /// 5 must not change places on the way.
    Drop {
        /// Of which set.
        set: BrickSetKey,
        /// Which.
        bricks: Vec<BrickId>,
    },
}

/// What the driver holds of a worker.
pub struct WorkerLink {
    /// Control messages. Unbounded, since the driver never waits; what is in it is bounded by
    /// the leases and one ping a second until silence ends the link.
    pub control: mpsc::UnboundedSender<ToWorker>,
    /// Bricks to send. Unbounded in orders, bounded by the bricks that the worker lacks: none
    /// is ordered twice.
    pub bricks: mpsc::UnboundedSender<BrickOrder>,
}

/// Where a worker calls from.
#[derive(Clone, Debug, Default)]
pub struct Caller {
    /// Its address; empty for one of this process.
    pub address: String,
    /// Whether that is an address of this machine, or it is of this process.
    pub is_local: bool,
}

impl Caller {
    /// Whether a caller that says to be on `machine` shares the processors of a master on `own`: if either does not
    /// know, whoever has the address that it calls is on the machine that is called. An address alone is
    /// another for each container, and the same at the end of a tunnel.
    pub(crate) fn is_on(&self, machine: &str, own: &str) -> bool {
        if machine.is_empty() || own.is_empty() { self.is_local } else { machine == own }
    }
}

/// Bricks of one embedded batch: some 64 KiB, as over TCP, so that tiles start while the rest
/// is on its way.
const BATCH_BRICKS: usize = 64;

/// The worker's end of an embedded link: what `slabcast_worker::Link` is made of.
pub struct EmbeddedEnd {
    /// From the master.
    pub control: mpsc::UnboundedReceiver<ToWorker>,
    /// To the master; the first message must be the hello.
    pub replies: mpsc::Sender<ToMaster>,
    /// Bricks.
    pub bricks: mpsc::Receiver<Bricks>,
}

/// Lets a worker in over channels of this process. Must be called inside a tokio runtime, which
/// then carries the messages.
pub fn embedded(handle: crate::Handle) -> EmbeddedEnd {
    let (control_tx, control_rx) = mpsc::unbounded_channel();
    let (reply_tx, mut reply_rx) = mpsc::channel::<ToMaster>(64);
    let (order_tx, mut order_rx) = mpsc::unbounded_channel::<BrickOrder>();
    let (batch_tx, batch_rx) = mpsc::channel(BRICK_BATCHES_IN_FLIGHT);
    tokio::spawn(async move {
        while let Some(order) = order_rx.recv().await {
            match order {
                BrickOrder::Drop { set, bricks } => {
                    let message = ToWorker::DropBricks { set, bricks };
                    if batch_tx.send(Bricks::Message(message)).await.is_err() {
                        return;
                    }
                }
                BrickOrder::Send { set, store, bricks } => {
                    for ids in bricks.chunks(BATCH_BRICKS) {
                        let bricks = ids.iter().filter_map(|id| store.brick(*id));
                        let batch =
                            BrickBatch { set, bricks: bricks.collect(), broken: Vec::new() };
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
        let link = WorkerLink { control: control_tx, bricks: order_tx };
        let caller = Caller { address: String::new(), is_local: true };
        serve_link(handle, hello, caller, link, &mut reply_rx).await;
    });
    EmbeddedEnd { control: control_rx, replies: reply_tx, bricks: batch_rx }
}

/// Carries a worker's messages to the driver until either side ends.
pub async fn serve_link(
    handle: crate::Handle,
    hello: Hello,
    caller: Caller,
    link: WorkerLink,
    replies: &mut mpsc::Receiver<ToMaster>,
) {
    let control = link.control.clone();
    let worker = match handle.attach(hello, caller, link).await {
        Ok(worker) => worker,
        Err(reason) => {
            let _ = control.send(ToWorker::Refused { reason });
            return;
        }
    };
    // The driver holds the other sender: when it drops that, the link is over.
    drop(control);
    while let Some(message) = replies.recv().await {
        if !handle.worker_said(worker, message).await {
            return;
        }
    }
    handle.detach(worker, "its link closed".into()).await;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn who_is_on_the_masters_machine_is_told_by_its_name_or_else_by_its_address() {
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
        ] {
            assert_eq!(caller(is_local).is_on(machine, own), want, "{machine:?} on {own:?}");
        }
    }
}
