//! Messages on their way: sending, links, receiving.

use super::{BrickOrder, Occurrence, SMALL_BYTES, VirtualCluster, micros};
use crate::Nanos;
use crate::model::TileModel;
use crate::outcome::Observer;
use crate::queues::{Cores, through};
use slabcast_common::brick::BrickSetKey;
use slabcast_common::ids::{BrickId, WorkerId};
use slabcast_common::image::TilePixels;
use slabcast_common::link::{BRICK_BATCHES_IN_FLIGHT, MAX_BRICK_BATCH_BYTES};
use slabcast_common::message::ToWorker;
use slabcast_schedule::Event;

/// Batches of bricks that are on the link to one worker at once, fewer than the
/// [`BRICK_BATCHES_IN_FLIGHT`] that wait at either end of a real one.
///
/// Real bricks have a TCP connection of their own, and the link's rate is shared between both
/// connections: a lease does not wait behind the bricks that were written before it. A link here
/// serves in order, so fewer batches stand for that share. With 8, leases queue behind more bricks:
/// the first frame of a path takes 1 to 7 % longer on 1 Gbit/s (a ball on 1 to 64 workers), later
/// frames between 4 % less and 2 % more, in the mean as long. On 10 Gbit/s with 1 ms of latency 2
/// batches bound a worker's rate at 65 MB/s, and 8 do not: the first frame takes up to 17 % less.
const BATCHES_ON_LINK: usize = 2;
const _: () = assert!(BATCHES_ON_LINK <= BRICK_BATCHES_IN_FLIGHT, "no more than real links carry");

/// Bytes of a view, and of all other messages of a frame and worker.
pub(super) const FRAME_BYTES: u64 = 600;

/// Returns the bytes of a piece's state: an opacity, three colours and four sums a pixel.
pub(super) fn state_bytes(pixels: &TilePixels) -> u64 {
    // A piece that nothing was drawn into has none.
    let pixel_bytes = if pixels.last.is_some() { 32 } else { 0 };
    SMALL_BYTES + pixel_bytes * pixels.a.len() as u64
}

impl<M: TileModel, O: Observer> VirtualCluster<M, O> {
    /// Work of a thread of the master that is there at `when`. Returns when it is done.
    pub(super) fn master_works(
        &mut self,
        threads: fn(&mut Self) -> &mut Cores,
        when: Nanos,
        ns: f64,
        wake_ns: f64,
    ) -> Nanos {
        let (done, took) = threads(self).take(when, ns, wake_ns);
        self.machine.as_mut().map_or(done, |m| m.run(when, took).max(done))
    }

    /// Work of the master's streams that is there at `when`. Returns when it is done.
    pub(super) fn stream_works(&mut self, when: Nanos, ns: f64) -> Nanos {
        let wake_ns = self.master.costs.master.wake_ns;
        self.master_works(|c| &mut c.streams, when, ns, wake_ns)
    }

    /// Work of a worker besides rendering that is there at `when`. Returns when it is done.
    fn worker_works(&mut self, id: WorkerId, when: Nanos, ns: f64) -> Nanos {
        let wake_ns = self.master.costs.worker.wake_ns;
        let w = self.workers.get_mut(&id).expect("a worker that works is there");
        let (done, ns) = w.io.take(when, ns, wake_ns);
        self.worker_work += ns as Nanos;
        match &mut self.machine {
            Some(machine) => machine.run(when, ns).max(done),
            None => {
                if w.running.iter().any(Option::is_some) {
                    w.stolen += ns as Nanos;
                }
                done
            }
        }
    }

    /// The latency of a message of a worker's, in nanoseconds.
    fn latency_ns(&mut self, id: WorkerId) -> Nanos {
        let [least, most] = self.workers[&id].profile.latency_ns;
        if least == most { least } else { self.rng.between(least, most) }
    }

    /// A worker's message goes up. Messages that are there before the one before is written go with
    /// it.
    pub(super) fn up(&mut self, id: WorkerId, event: Event, bytes: u64, when: Nanos) {
        self.up_packed(id, event, bytes, 0, when);
    }

    /// A worker's message goes up, of so many bytes into which so many were packed; 0: none were.
    pub(super) fn up_packed(
        &mut self,
        id: WorkerId,
        event: Event,
        bytes: u64,
        packed: u64,
        when: Nanos,
    ) {
        let costs = self.master.costs;
        let call_ns = if when <= self.workers[&id].wrote { 0.0 } else { costs.worker.call_ns };
        let ns = call_ns + costs.worker.send.ns(bytes as f64) + costs.pack_byte_ns * packed as f64;
        let when = self.worker_works(id, when, ns);
        let latency_ns = self.latency_ns(id);
        let w = self.workers.get_mut(&id).expect("a worker that speaks is there");
        w.wrote = when;
        let sent = through(&mut w.up, &mut self.up, when, bytes);
        let arrives = (sent + latency_ns).max(w.up_arrives);
        w.up_arrives = arrives;
        if let Some(outcome) = self.traffic() {
            outcome.up += bytes;
            outcome.messages_up += 1;
        }
        let unpack_ns = costs.unpack_byte_ns * packed as f64;
        self.later(arrives, Occurrence::AtMaster { worker: id, event, bytes, unpack_ns });
    }

    /// A message is at the master's end of a link.
    pub(super) fn arrive_at_master(
        &mut self,
        id: WorkerId,
        event: Event,
        bytes: u64,
        unpack_ns: f64,
    ) {
        if self.dropped.contains(&id) && self.rng.one_in(2) {
            return;
        }
        let now = self.now_ns();
        let Some(heard) = self.workers.get(&id).map(|w| w.heard) else {
            // It left before it died.
            if self.rng.one_in(2) {
                self.inbox.push(event);
                self.drive();
            }
            return;
        };
        let costs = &self.master.costs.master;
        let call_ns = if now <= heard { 0.0 } else { costs.call_ns };
        let ns = call_ns + costs.receive.ns(bytes as f64) + unpack_ns;
        // A stream keeps its order, whichever thread reads it.
        let read = self.stream_works(now, ns).max(heard);
        self.workers.get_mut(&id).expect("just seen").heard = read;
        self.later(read, Occurrence::Inbox(event));
    }

    /// A message of the master's goes down, when the driver is done with it. Of messages that leave
    /// together to one worker only the first pays the call.
    pub(super) fn down(
        &mut self,
        id: WorkerId,
        message: ToWorker,
        bytes: u64,
        when: Nanos,
        first: bool,
    ) {
        let costs = &self.master.costs.master;
        let ns = if first { costs.call_ns } else { 0.0 } + costs.send.ns(bytes as f64);
        let when = self.stream_works(when, ns);
        if !self.workers.contains_key(&id) {
            return;
        }
        let latency_ns = self.latency_ns(id);
        let w = self.workers.get_mut(&id).expect("just seen");
        let sent = through(&mut self.down, &mut w.down, when, bytes);
        let arrives = (sent + latency_ns).max(w.down_arrives);
        w.down_arrives = arrives;
        if let Some(outcome) = self.traffic() {
            outcome.down += bytes;
            outcome.messages_down += 1;
            outcome.writes_down += u64::from(first);
        }
        self.later(arrives, Occurrence::AtWorker(id, Box::new(message)));
    }

    /// A worker reads a message. Returns when it has.
    pub(super) fn read(&mut self, id: WorkerId, bytes: u64) -> Nanos {
        let (now, costs) = (self.now_ns(), &self.master.costs.worker);
        let call_ns = if now <= self.workers[&id].read { 0.0 } else { costs.call_ns };
        let ns = call_ns + costs.receive.ns(bytes as f64);
        let read = self.worker_works(id, now, ns);
        self.workers.get_mut(&id).expect("a worker that reads is there").read = read;
        read
    }

    /// Queues bricks for a worker, in messages as full as real ones.
    pub(super) fn order_bricks(
        &mut self,
        id: WorkerId,
        set: BrickSetKey,
        bricks: Vec<BrickId>,
        when: Nanos,
    ) {
        if !self.workers.contains_key(&id) {
            return;
        }
        let infos = self.sets.get(&set).cloned().unwrap_or_default();
        let brick_bytes = |id: &BrickId| {
            let place = infos.binary_search_by_key(id, |b| b.id);
            place.map_or(0, |i| u64::from(infos[i].bytes))
        };
        let mut rest = &bricks[..];
        while !rest.is_empty() {
            let mut bytes = 0;
            let n = if self.master.random_batches {
                self.rng.between(1, 16) as usize
            } else {
                let fits = |b: &&BrickId| {
                    bytes += brick_bytes(b);
                    bytes <= MAX_BRICK_BATCH_BYTES as u64
                };
                rest.iter().take_while(fits).count()
            };
            let (batch, later) = rest.split_at(n.clamp(1, rest.len()));
            let bytes = batch.iter().map(brick_bytes).sum();
            let order = BrickOrder::Send(batch.to_vec());
            let w = self.workers.get_mut(&id).expect("just seen");
            w.brick_orders.push_back((set, order, bytes));
            rest = later;
        }
        self.send_bricks(id, when);
    }

    /// Sends messages of the bricks stream while there is room on the way.
    pub(super) fn send_bricks(&mut self, id: WorkerId, when: Nanos) {
        loop {
            let w = self.workers.get_mut(&id).expect("a worker that gets bricks is there");
            if w.batches_in_flight == BATCHES_ON_LINK {
                return;
            }
            let Some((set, order, bytes)) = w.brick_orders.pop_front() else { return };
            w.batches_in_flight += 1;
            let costs = &self.master.costs.master;
            let ns = costs.call_ns + costs.bricks.ns(bytes as f64);
            let when = self.stream_works(when, ns);
            let latency_ns = self.latency_ns(id);
            let w = self.workers.get_mut(&id).expect("as before");
            let sent = through(&mut self.down, &mut w.down, when, bytes);
            let arrives = w.bricks_down.send(sent, bytes) + latency_ns;
            let arrives = arrives.max(w.bricks_arrive);
            w.bricks_arrive = arrives;
            if let Some(outcome) = self.traffic() {
                outcome.bricks += bytes;
            }
            self.later(arrives, Occurrence::BricksAtWorker { worker: id, set, order, bytes });
        }
    }

    /// A message of the bricks stream is at a worker.
    pub(super) fn bricks_arrive(
        &mut self,
        id: WorkerId,
        set: BrickSetKey,
        order: BrickOrder,
        bytes: u64,
    ) {
        let now = self.now_ns();
        let costs = &self.master.costs.worker;
        let ns = costs.call_ns + costs.bricks.ns(bytes as f64);
        let read = self.worker_works(id, now, ns);
        let w = self.workers.get_mut(&id).expect("it is there");
        w.batches_in_flight -= 1;
        let bricks = match order {
            BrickOrder::Send(bricks) => bricks,
            BrickOrder::Drop(bricks) => {
                self.drop_bricks(id, set, &bricks);
                self.send_bricks(id, now);
                return;
            }
        };
        let one_in = w.profile.faults.broken_one_in;
        let (mut broken, mut good) = (Vec::new(), Vec::new());
        for b in bricks {
            let is_broken = one_in > 0 && self.rng.one_in(one_in);
            if is_broken { &mut broken } else { &mut good }.push(b);
        }
        self.gain_bricks(id, set, &good);
        self.send_bricks(id, now);
        let count = good.len() as u32;
        let mut reports = Vec::new();
        if count > 0 {
            reports.push(Event::BricksIn { worker: id, set, bricks: count });
        }
        if !broken.is_empty() {
            reports.push(Event::BricksBroken { worker: id, set, bricks: broken });
            if self.rng.one_in(2) {
                reports.reverse();
            }
        }
        for report in reports {
            self.up(id, report, SMALL_BYTES, read);
        }
        // After the report: the master takes an eviction only of bricks that it knows to be there.
        self.make_room(id);
        self.start_threads(id, None);
    }

    /// A control message is at a worker.
    pub(super) fn arrive_at_worker(&mut self, id: WorkerId, message: ToWorker) {
        let is_leaving = self.workers[&id].leaving;
        match message {
            ToWorker::Lease(_) | ToWorker::Region(_) if is_leaving => {}
            ToWorker::Lease(lease) => {
                let bytes = self.slab_lease_bytes(&lease);
                let read = self.read(id, bytes);
                self.later(read, Occurrence::Lease(id, super::Lent::Slab(lease)));
            }
            ToWorker::Region(lease) => {
                let bytes =
                    SMALL_BYTES + lease.begun.as_ref().map_or(0, |b| state_bytes(&b.pixels));
                let read = self.read(id, bytes);
                self.later(read, Occurrence::Lease(id, super::Lent::Region(lease)));
            }
            ToWorker::SplitRegion { task, epoch, share, .. } => {
                let read = self.read(id, SMALL_BYTES);
                self.hand_over(id, (task, epoch), f64::from(share) / 1000.0, read);
                self.start_threads(id, None);
            }
            ToWorker::EndFrame { frame } => {
                self.read(id, SMALL_BYTES);
                self.workers.get_mut(&id).expect("it is there").end_frame(frame);
            }
            ToWorker::Ping { nonce } => {
                let read = self.read(id, SMALL_BYTES);
                let clock_us = micros(read) + self.workers[&id].profile.clock_ahead_us;
                let pong = Event::Pong { worker: id, nonce, clock_us };
                self.up(id, pong, SMALL_BYTES, read);
            }
            ToWorker::Frame { frame, plain, .. } => {
                self.read(id, FRAME_BYTES);
                let w = self.workers.get_mut(&id).expect("it is there");
                w.plain = plain;
                w.frames.insert(frame);
            }
            ToWorker::Directory { .. } => {
                self.read(id, FRAME_BYTES);
                self.workers.get_mut(&id).expect("it is there").has_directory = true;
            }
            _ => {
                self.read(id, FRAME_BYTES);
            }
        }
    }
}
