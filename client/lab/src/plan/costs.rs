//! The processor time of messages.
//!
//! The time has two parts. Converting pixels to messages and back is timed here. The time of gRPC,
//! TCP and the kernel follows from the pings of the machine that drew the tiles
//! ([`pings`](super::pings)).

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

/// Pings of a known machine, for systems that do not tell the time of threads: an EPYC of 2.45 GHz
/// (Zen 3, 2 vCPU), on which waking a processor costs 20 us.
const KNOWN_PINGS: Pings =
    Pings { alone_ns: [22_400, 40_100, 35_500], company_ns: [2_000, 7_600, 7_000] };
/// gRPC's share of a message's time without waking; the rest is the socket's. On that machine 0.8
/// us (docs/design/transport.md, answer 1) of 3.65 us a message at either end.
const GRPC_SHARE: f64 = 0.22;
/// Share of the driver's time for a ping that is the message and not a decision. In a rehearsal
/// (mri256 at 1024x1024, four workers, that machine) 15 % of 1.85 ms a frame were neither decisions
/// nor waking: 0.8 us for each of 333 messages.
const DRIVER_MESSAGE_SHARE: f64 = 0.8;
/// Time of a byte of a message, in ns: 4.4 us for 16 KiB without waking (docs/design/transport.md).
const BYTE_NS: f64 = 0.3;
/// Time to send a pixel of three bytes to the client and to receive it, in ns: 14 and 17 us for
/// 64 KiB (docs/design/transport.md, answer 1).
const DELIVER_PIXEL_NS: [f64; 2] = [0.65, 0.8];

/// Fixed costs of a message whatever its content, in ns.
struct FixedCosts {
    /// Waking a stream thread of the master, and of a worker.
    woken: [f64; 2],
    /// Waking the driver thread, which has no socket.
    driver_woken: f64,
    /// The driver takes a message from its queue, or puts one into that of a link.
    driver_each: f64,
    /// One read or write of a socket.
    call: f64,
    /// A message passes through gRPC.
    each: f64,
}

impl FixedCosts {
    fn from_pings(pings: &Pings) -> FixedCosts {
        let [driver, streams, worker] = pings.company_ns.map(|ns| ns as f64);
        let waking = |i: usize| pings.alone_ns[i].saturating_sub(pings.company_ns[i]) as f64;
        // A ping and its pong each wake the driver and the streams, but the worker is woken for the
        // ping alone. Each of the two messages is written at one end and read at the other.
        let message = (streams + worker) / 4.0;
        FixedCosts {
            woken: [waking(1) / 2.0, waking(2)],
            driver_woken: waking(0) / 2.0,
            driver_each: DRIVER_MESSAGE_SHARE * driver / 2.0,
            call: (1.0 - GRPC_SHARE) * message,
            each: GRPC_SHARE * message,
        }
    }
}

/// Returns the processor time of the fastest of 15 runs, in ns.
fn fastest_ns(mut run: impl FnMut()) -> f64 {
    let mut timed = || {
        let began = cpu_ns();
        run();
        (cpu_ns() - began) as f64
    };
    (0..15).map(|_| timed()).fold(f64::INFINITY, f64::min)
}

/// Measures the costs of messages here under a schedule: the tiles of slabs are sums, those of
/// regions finished pixels. They are filled like the average tile of the trace.
pub(super) fn messages(trace: &Trace, schedule: Schedule) -> Costs {
    let by_region = schedule != Schedule::Slab;
    let tiles = trace.frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.levels);
    let (mut bytes, mut pixels) = (0u64, 0u64);
    for level in tiles {
        bytes += level.tiles.iter().map(|t| u64::from(t.result_bytes)).sum::<u64>();
        pixels += level.tiles.len() as u64 * u64::from(level.edge) * u64::from(level.edge);
    }
    // Share of the 64x64 pixels that are filled.
    let filled = (bytes as f64 / pixels.max(1) as f64 / 32.0).clamp(0.05, 1.0);
    let n = 64 * 64;
    let pixel = |i: usize| (i as f64) < filled * n as f64;
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
        true => Pixels::Finished(sample_region(trace)),
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
    // Uncompressed: the trace has the time of compression.
    let up = |m: &ToMaster| convert::from_worker_to_wire_as(m, Compression::None).encode_to_vec();
    let (lease_bytes, result_bytes) = (down(&lease), up(&result));
    let price = FixedCosts::from_pings(trace.about.pings.as_ref().unwrap_or(&KNOWN_PINGS));
    let byte = |ns: f64, bytes: &[u8]| BYTE_NS + ns / bytes.len().max(1) as f64;
    let send = fastest_ns(|| drop(down(&lease)));
    let worker_send = fastest_ns(|| drop(up(&result)));
    let receive = fastest_ns(|| {
        let message = ControlRequest::decode(&result_bytes[..]).expect("written above");
        drop(convert::from_worker_from_wire(message));
    });
    let worker_receive = fastest_ns(|| {
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
            bricks: each(BYTE_NS),
        },
        worker: MessageCosts {
            wake_ns: price.woken[1],
            call_ns: price.call,
            send: each(byte(worker_send, &result_bytes)),
            receive: each(byte(worker_receive, &lease_bytes)),
            // Decoding bricks into the cache takes some 3 ns a byte
            // (docs/measurements/performance.md).
            bricks: each(BYTE_NS + 3.0),
        },
        pack_byte_ns: trace.about.packing.pack_ns,
        unpack_byte_ns: trace.about.packing.unpack_ns,
        finish_pixel_ns: finish_pixel_ns(trace, by_region),
        mark_pixel_ns: mark_pixel_ns(trace.about.size),
        deliver_pixel_ns: DELIVER_PIXEL_NS[0],
        client_pixel_ns: DELIVER_PIXEL_NS[1],
        placeholder: LinearCost { fixed_ns: 0.0, per_unit_ns: placeholder_pixel_ns(by_region) },
        late_wake_ns: late_wake_ns(),
        driver_wake_ns: price.driver_woken,
        driver_message_ns: price.driver_each,
        ..Costs::default()
    }
}

/// Returns the mean bytes of a region's result for each pixel; `None` for a trace of slabs alone.
fn region_bytes(trace: &Trace) -> Option<f64> {
    let levels = trace.frames.iter().filter_map(|f| f.regions.first());
    let (mut bytes, mut pixels) = (0.0, 0.0);
    for level in levels {
        bytes += level.tiles.iter().map(|t| f64::from(t.result_bytes)).sum::<f64>();
        pixels += level.tiles.len() as f64 * f64::from(level.edge).powi(2);
    }
    (pixels > 0.0).then(|| bytes / pixels)
}

/// Returns a region of 64x64 pixels with as many bytes as the average of the trace after
/// compression to a half, as drawn pixels compress.
fn sample_region(trace: &Trace) -> SparseTile {
    let bytes = region_bytes(trace).unwrap_or(0.5) * 64.0 * 64.0;
    let tile = Rect::new(0, 0, 64, 64);
    let mut leaves = trace::placeholder_finished(&tile, (2.0 * bytes) as u32, &FINISH);
    leaves.data.iter_mut().skip(1).step_by(2).for_each(|b| *b = 0);
    let mid = leaves.data.len() / 2;
    let (first, rest) = leaves.data.split_at_mut(mid);
    rest[..mid].copy_from_slice(first);
    leaves
}

/// Returns the ns to finish a pixel, of pictures as full as those of the trace.
fn finish_pixel_ns(trace: &Trace, by_region: bool) -> f64 {
    use slabcast_common::image::{FrameState, TilePixels};
    let size = trace.about.size;
    let mut state = FrameState::new(size);
    let whole = Rect::from_size(size);
    if by_region {
        let leaves = sample_region(trace);
        for y in (0..whole.y1 - 63).step_by(64) {
            for x in (0..whole.x1 - 63).step_by(64) {
                state.place_encoded(Rect::new(x, y, x + 64, y + 64), leaves.clone());
            }
        }
    } else {
        // Slab traces lack the number of filled pixels; half is assumed.
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

/// Returns the ns to mark and encode a pixel of a picture of a rehearsal.
fn mark_pixel_ns(size: [u32; 2]) -> f64 {
    let ns = fastest_ns(|| {
        let pixels = vec![[0.5; 4]; size[0] as usize * size[1] as usize];
        drop(Picture { size, pixels }.encode(FINISH.format, FINISH.background));
    });
    ns / (f64::from(size[0]) * f64::from(size[1]))
}

/// Returns the ns to fill a pixel of a placeholder result.
fn placeholder_pixel_ns(by_region: bool) -> f64 {
    let (rect, size) = (Rect::new(0, 0, 64, 64), [64, 64]);
    let shut = vec![false; 64 * 64];
    let sums = || drop(std::hint::black_box(trace::placeholder_slab(&rect, &shut, size, 100_000)));
    let finished =
        || drop(std::hint::black_box(trace::placeholder_finished(&rect, 4_000, &FINISH)));
    (if by_region { fastest_ns(finished) } else { fastest_ns(sums) }) / 4096.0
}

/// Returns the ns by which a thread wakes late that sleeps for a tile's time.
fn late_wake_ns() -> f64 {
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
    fn wake_cost_is_the_difference_of_lone_and_busy_pings() {
        let price = FixedCosts::from_pings(&KNOWN_PINGS);
        assert_eq!((price.woken, price.driver_woken), ([16_250.0, 28_500.0], 10_200.0));
        assert!((price.call + price.each - 3_650.0).abs() < 1.0, "a message without waking");
        // Noise may make busy pings look dearer: then waking costs nothing.
        let odd = Pings { alone_ns: KNOWN_PINGS.company_ns, company_ns: KNOWN_PINGS.alone_ns };
        assert_eq!(FixedCosts::from_pings(&odd).woken, [0.0; 2]);
    }
}
