//! What messages cost a processor.
//!
//! Two parts: what is done to bytes here (planes to messages and back) is timed by the command; what
//! gRPC, TCP and the kernel take follows from what pings took where the tiles were drawn ([`pings`](super::pings)).

use super::clock::cpu_ns;
use super::measure::FINISH;
use prost::Message;
use slabcast_common::ids::{Epoch, FrameId, TaskId};
use slabcast_common::image::{Picture, SparseTile, TilePixels, TileState};
use slabcast_common::message::{
    Counters, Lease, Pixels, TaskTimes, TileResult, ToMaster, ToWorker,
};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Schedule;
use slabcast_common::slab::SheetRange;
use slabcast_proto::cluster_v1::{ControlRequest, ControlResponse};
use slabcast_proto::convert::{self, Compression, Down};
use slabcast_sim::{Costs, LinearCost, MessageCosts};
use slabcast_trace::{self as trace, Pings, Trace};
use std::time::Instant;

/// Of a machine that does not say what threads take: an EPYC of 2.45 GHz (Zen 3, 2 vCPU), on which waking a
/// processor costs 20 us.
const KNOWN: Pings =
    Pings { alone_ns: [22_400, 40_100, 35_500], company_ns: [2_000, 7_600, 7_000] };
/// What of a message in company is gRPC's, and not the socket's: there 3.65 us a message at either end, of which
/// TRANSPORT.md, answer 1, has 0.8 for gRPC.
const GRPC: f64 = 0.22;
/// What of the driver's work for a ping or a pong is the message, and not what it decides: of a rehearsal (mri256 at 1024x1024,
/// four workers, that machine) 15 % of 1.85 ms a frame are neither decisions nor waking, 0.8 us of each of 333 messages.
const QUEUED: f64 = 0.8;
/// A byte of a message: TRANSPORT.md has 4.4 us for 16 KiB in company.
const BYTE: f64 = 0.3;
/// To send a pixel of three bytes to the client, and to receive it: TRANSPORT.md, answer 1, has 14 and 17
/// us for 64 KiB.
const DELIVER: [f64; 2] = [0.65, 0.8];

/// What each message costs, in ns, whatever is in it.
struct Prices {
    /// A thread of the master's streams, and of a worker's, that slept begins to work.
    woken: [f64; 2],
    /// The driver, which has no socket, does.
    driver_woken: f64,
    /// It takes a message from its queue or puts one into a link's, and counts it.
    driver_each: f64,
    /// A socket is read from or written to.
    call: f64,
    /// A message goes through gRPC.
    each: f64,
}

impl Prices {
    fn of(pings: &Pings) -> Prices {
        let [driver, streams, worker] = pings.company_ns.map(|ns| ns as f64);
        let waking = |i: usize| pings.alone_ns[i].saturating_sub(pings.company_ns[i]) as f64;
        // Of a ping and its pong the driver and the streams are woken for either, a worker for the ping. Either is a
        // message that is written at one end and read at the other.
        let message = (streams + worker) / 4.0;
        Prices {
            woken: [waking(1) / 2.0, waking(2)],
            driver_woken: waking(0) / 2.0,
            driver_each: QUEUED * driver / 2.0,
            call: (1.0 - GRPC) * message,
            each: GRPC * message,
        }
    }
}

/// Nanoseconds of the best of some runs.
fn best(mut run: impl FnMut()) -> f64 {
    let mut timed = || {
        let began = cpu_ns();
        run();
        (cpu_ns() - began) as f64
    };
    (0..15).map(|_| timed()).fold(f64::INFINITY, f64::min)
}

/// What messages cost here under a schedule: tiles of slabs are sums, regions come finished. They are
/// filled as those of the trace are, on average.
pub(super) fn messages(trace: &Trace, schedule: Schedule) -> Costs {
    let by_region = schedule != Schedule::Slab;
    let tiles = trace.frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.levels);
    let (mut bytes, mut pixels) = (0u64, 0u64);
    for level in tiles {
        bytes += level.tiles.iter().map(|t| u64::from(t.result_bytes)).sum::<u64>();
        pixels += level.tiles.len() as u64 * u64::from(level.edge) * u64::from(level.edge);
    }
    // 64x64 pixels of which as many are there.
    let there = (bytes as f64 / pixels.max(1) as f64 / 32.0).clamp(0.05, 1.0);
    let n = 64 * 64;
    let pixel = |i: usize| (i as f64) < there * n as f64;
    let pixels = TilePixels {
        a: (0..n).map(|i| if pixel(i) { 0.5 + i as f32 * 1e-5 } else { 0.0 }).collect(),
        colour: (0..n).map(|i| if pixel(i) { [i as u32 + 9; 3] } else { [0; 3] }).collect(),
        last: Some((0..n).map(|i| if pixel(i) { [i as u32 + 9; 4] } else { [0; 4] }).collect()),
    };
    let lease = ToWorker::Lease(Box::new(Lease {
        task: TaskId(5),
        epoch: Epoch(0),
        frame: FrameId(1),
        tile: Rect::new(0, 0, 64, 64),
        slab: SheetRange::new(0, 90),
        bricks: Vec::new(),
        state: TileState { a: pixels.a.clone(), last: pixels.last.clone() },
    }));
    let pixels = match by_region {
        true => Pixels::Finished(region(trace)),
        false => Pixels::Sums(pixels),
    };
    let result = ToMaster::Result(Box::new(TileResult {
        task: TaskId(5),
        epoch: Epoch(0),
        pixels,
        bytes: None,
        counters: Counters::default(),
        times: TaskTimes::default(),
        region: None,
    }));
    let down = |m: &ToWorker| match convert::to_worker_to_wire(m, 0) {
        Down::Control(m) => m.encode_to_vec(),
        Down::Parts(_) | Down::Bricks(_) => Vec::new(),
    };
    // What packing takes the trace says.
    let up = |m: &ToMaster| convert::from_worker_to_wire_as(m, Compression::None).encode_to_vec();
    let (lease_bytes, result_bytes) = (down(&lease), up(&result));
    let price = Prices::of(trace.about.pings.as_ref().unwrap_or(&KNOWN));
    let byte = |ns: f64, bytes: &[u8]| BYTE + ns / bytes.len().max(1) as f64;
    let send = best(|| drop(down(&lease)));
    let worker_send = best(|| drop(up(&result)));
    let receive = best(|| {
        let message = ControlRequest::decode(&result_bytes[..]).expect("written above");
        drop(convert::from_worker_from_wire(message));
    });
    let worker_receive = best(|| {
        let message = ControlResponse::decode(&lease_bytes[..]).expect("written above");
        drop(convert::to_worker_from_wire(message));
    });
    let each = |per_unit_ns| LinearCost { fixed_ns: price.each, per_unit_ns };
    Costs {
        master: MessageCosts {
            wake_ns: price.woken[0],
            call_ns: price.call,
            send: each(byte(send, &lease_bytes)),
            receive: each(byte(receive, &result_bytes)),
            bricks: each(BYTE),
        },
        worker: MessageCosts {
            wake_ns: price.woken[1],
            call_ns: price.call,
            send: each(byte(worker_send, &result_bytes)),
            receive: each(byte(worker_receive, &lease_bytes)),
            // Bricks are decoded and put into the cache: some 3 ns a byte (docs/performance.md).
            bricks: each(BYTE + 3.0),
        },
        pack_byte_ns: trace.about.packing.pack_ns,
        unpack_byte_ns: trace.about.packing.unpack_ns,
        finish_pixel_ns: finish(trace, by_region),
        mark_pixel_ns: mark(trace.about.size),
        deliver_pixel_ns: DELIVER[0],
        client_pixel_ns: DELIVER[1],
        placeholder: LinearCost { fixed_ns: 0.0, per_unit_ns: fill(by_region) },
        late_wake_ns: late(),
        driver_wake_ns: price.driver_woken,
        driver_message_ns: price.driver_each,
        ..Costs::default()
    }
}

/// Bytes of regions' results a pixel of their tiles; `None` of a trace of slabs alone.
fn region_bytes(trace: &Trace) -> Option<f64> {
    let levels = trace.frames.iter().filter_map(|f| f.regions.first());
    let (mut bytes, mut pixels) = (0.0, 0.0);
    for level in levels {
        bytes += level.tiles.iter().map(|t| f64::from(t.result_bytes)).sum::<f64>();
        pixels += level.tiles.len() as f64 * f64::from(level.edge).powi(2);
    }
    (pixels > 0.0).then(|| bytes / pixels)
}

/// A region of 64x64 pixels that weighs what those of the trace do, half of it packed away: what is
/// inside the outline of what is drawn packs to some half.
fn region(trace: &Trace) -> SparseTile {
    let bytes = region_bytes(trace).unwrap_or(0.5) * 64.0 * 64.0;
    let tile = Rect::new(0, 0, 64, 64);
    let mut leaves = trace::placeholder_finished(&tile, (2.0 * bytes) as u32, &FINISH);
    leaves.data.iter_mut().skip(1).step_by(2).for_each(|b| *b = 0);
    let mid = leaves.data.len() / 2;
    let (first, rest) = leaves.data.split_at_mut(mid);
    rest[..mid].copy_from_slice(first);
    leaves
}

/// To finish a pixel, in nanoseconds, of pictures as full as those of the trace.
fn finish(trace: &Trace, by_region: bool) -> f64 {
    use slabcast_common::image::{FrameState, TilePixels};
    let size = trace.about.size;
    let mut state = FrameState::new(size);
    let whole = Rect::from_size(size);
    if by_region {
        let leaves = region(trace);
        for y in (0..whole.y1 - 63).step_by(64) {
            for x in (0..whole.x1 - 63).step_by(64) {
                state.place_encoded(Rect::new(x, y, x + 64, y + 64), leaves.clone());
            }
        }
    } else {
        // Slabs do not say how many pixels are there: half.
        let full = |i: usize| i < whole.area() / 2;
        let a = (0..whole.area()).map(|i| if full(i) { 0.5 } else { 0.0 }).collect();
        let colour =
            (0..whole.area()).map(|i| if full(i) { [1 << 27; 3] } else { [0; 3] }).collect();
        state.place_sums(whole, TilePixels { a, colour, last: None });
    }
    let ns = (0..3)
        .map(|_| {
            let began = cpu_ns();
            std::hint::black_box(state.encode(&FINISH, false));
            (cpu_ns() - began) as f64
        })
        .fold(f64::INFINITY, f64::min);
    ns / (f64::from(size[0]) * f64::from(size[1]))
}

/// To mark a pixel of a picture that nobody drew, and to encode it.
fn mark(size: [u32; 2]) -> f64 {
    let ns = best(|| {
        let pixels = vec![[0.5; 4]; size[0] as usize * size[1] as usize];
        drop(Picture { size, pixels }.encode(FINISH.format, FINISH.background));
    });
    ns / (f64::from(size[0]) * f64::from(size[1]))
}

/// To fill a pixel of a result that is held, in nanoseconds.
fn fill(by_region: bool) -> f64 {
    let (rect, size) = (Rect::new(0, 0, 64, 64), [64, 64]);
    let shut = vec![false; 64 * 64];
    let sums = || drop(std::hint::black_box(trace::placeholder_slab(&rect, &shut, size, 100_000)));
    let finished =
        || drop(std::hint::black_box(trace::placeholder_finished(&rect, 4_000, &FINISH)));
    (if by_region { best(finished) } else { best(sums) }) / 4096.0
}

/// How late a thread wakes that sleeps for a tile's time, in nanoseconds.
fn late() -> f64 {
    let nap = std::time::Duration::from_micros(200);
    let sum: f64 = (0..50)
        .map(|_| {
            let began = Instant::now();
            std::thread::sleep(nap);
            (began.elapsed() - nap).as_nanos() as f64
        })
        .sum();
    sum / 50.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn waking_is_what_company_saves() {
        let price = Prices::of(&KNOWN);
        assert_eq!((price.woken, price.driver_woken), ([16_250.0, 28_500.0], 10_200.0));
        assert!((price.call + price.each - 3_650.0).abs() < 1.0, "a message in company");
        // Noise may have company look dearer: then nobody is woken.
        let odd = Pings { alone_ns: KNOWN.company_ns, company_ns: KNOWN.alone_ns };
        assert_eq!(Prices::of(&odd).woken, [0.0; 2]);
    }
}
