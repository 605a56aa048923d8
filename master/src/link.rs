//! A worker's end at the master.
//!
//! The driver speaks to every worker through a [`WorkerLink`] and can't tell whether a network
//! lies behind it. The embedded link passes the very messages over channels, and bricks as
//! shared pointers; the TCP link ([`crate::serve`]) encodes both.

use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::BrickId;
use slabcast_common::message::{BrickBatch, Hello, ToMaster, ToWorker};
use slabcast_volumes::BrickStore;
use std::sync::Arc;
use tokio::sync::mpsc;

/// Bricks that are to go to one worker, in this order.
pub struct BrickOrder {
    /// Of which set.
    pub set: BrickSetKey,
    /// Where they are.
    pub store: Arc<BrickStore>,
    /// Which.
    pub bricks: Vec<BrickId>,
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

/// Bytes of one batch of bricks: a gRPC data frame of 64 KiB with its headers.
pub const BATCH_BYTES: usize = 65_000;

/// Batches on their way to one worker: enough to keep a stream busy, little enough that a
/// dropped worker's bricks don't pile up.
pub const BATCHES_IN_FLIGHT: usize = 8;

/// Cuts an order into batches of about [`BATCH_BYTES`].
pub fn batches(order: &BrickOrder) -> impl Iterator<Item = &[BrickId]> {
    let mut rest = &order.bricks[..];
    std::iter::from_fn(move || {
        let (mut bytes, mut n) = (0, 0);
        for id in rest {
            let len = order.store.brick(*id).map_or(0, |b| b.encoded_len() + 5);
            if n > 0 && bytes + len > BATCH_BYTES {
                break;
            }
            bytes += len;
            n += 1;
        }
        let (batch, after) = rest.split_at(n);
        rest = after;
        (n > 0).then_some(batch)
    })
}

/// The worker's end of an embedded link: what `slabcast_worker::Link` is made of.
pub struct EmbeddedEnd {
    /// From the master.
    pub control: mpsc::UnboundedReceiver<ToWorker>,
    /// To the master; the first message must be the hello.
    pub replies: mpsc::Sender<ToMaster>,
    /// Bricks.
    pub bricks: mpsc::Receiver<BrickBatch>,
}

/// Lets a worker in over channels of this process. Must be called inside a tokio runtime, which
/// then carries the messages.
pub fn embedded(handle: crate::Handle) -> EmbeddedEnd {
    let (control_tx, control_rx) = mpsc::unbounded_channel();
    let (reply_tx, mut reply_rx) = mpsc::channel::<ToMaster>(64);
    let (order_tx, mut order_rx) = mpsc::unbounded_channel::<BrickOrder>();
    let (batch_tx, batch_rx) = mpsc::channel(BATCHES_IN_FLIGHT);
    tokio::spawn(async move {
        while let Some(order) = order_rx.recv().await {
            for ids in batches(&order) {
                let bricks =
                    ids.iter().filter_map(|id| order.store.brick(*id).cloned()).collect();
                let batch = BrickBatch { set: order.set, bricks, broken: Vec::new() };
                if batch_tx.send(batch).await.is_err() {
                    return;
                }
            }
        }
    });
    tokio::spawn(async move {
        let Some(ToMaster::Hello(hello)) = reply_rx.recv().await else { return };
        let link = WorkerLink { control: control_tx, bricks: order_tx };
        serve_link(handle, hello, link, &mut reply_rx).await;
    });
    EmbeddedEnd { control: control_rx, replies: reply_tx, bricks: batch_rx }
}

/// Carries a worker's messages to the driver until either side ends.
pub async fn serve_link(
    handle: crate::Handle,
    hello: Hello,
    link: WorkerLink,
    replies: &mut mpsc::Receiver<ToMaster>,
) {
    let control = link.control.clone();
    let worker = match handle.attach(hello, link).await {
        Ok(worker) => worker,
        Err(reason) => {
            let _ = control.send(ToWorker::Refused { reason });
            return;
        }
    };
    // The driver holds the other senders; this one would keep the link open.
    drop(control);
    while let Some(message) = replies.recv().await {
        if !handle.worker_said(worker, message).await {
            return;
        }
    }
    handle.detach(worker, "its link closed".into()).await;
}
