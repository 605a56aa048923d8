//! What messages cost a processor.
//!
//! Two parts: what is done to bytes here (planes to messages and back) is timed on this machine;
//! what gRPC, TCP and the kernel take is a constant, since it needs two machines to be measured.

use super::clock::cpu_ns;
use prost::Message;
use slabcast_common::ids::{Epoch, FrameId, TaskId};
use slabcast_common::image::{TilePixels, TileState};
use slabcast_common::message::{Counters, Lease, TaskTimes, TileResult, ToMaster, ToWorker};
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::trace::{self, Trace};
use slabcast_proto::convert::{self, Down};
use slabcast_proto::v1;
use slabcast_schedule::sim::Costs;
use std::time::Instant;

/// A message through gRPC, TCP and the kernel, in ns: at a master, and at a worker, which also wakes
/// a render thread for it. A rehearsal measures both (`slabcast plan --rehearse`, [`calibrated`]); these
/// are what it found on 2 vCPU, where waking a core costs 20 us (TRANSPORT.md). At half, 32 workers
/// look a third better than they are.
const MESSAGE: (f64, f64) = (20_000.0, 45_000.0);
/// A byte of it: TRANSPORT.md has 4.4 us for 16 KiB in company.
const BYTE: f64 = 0.3;
/// From a message's coming to a thread's working on it, where it slept: TRANSPORT.md, section 7.
const WAKE: f64 = 20_000.0;

/// Nanoseconds of the best of some runs.
fn best(mut run: impl FnMut()) -> f64 {
    let mut timed = || {
        let began = cpu_ns();
        run();
        (cpu_ns() - began) as f64
    };
    (0..15).map(|_| timed()).fold(f64::INFINITY, f64::min)
}

/// What messages cost here. Tiles are filled as those of the trace are, on average.
pub(super) fn messages(trace: &Trace) -> Costs {
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
    let result = ToMaster::Result(Box::new(TileResult {
        task: TaskId(5),
        epoch: Epoch(0),
        pixels,
        counters: Counters::default(),
        times: TaskTimes::default(),
        region: None,
    }));
    let down = |m: &ToWorker| match convert::to_worker_to_wire(m, 0) {
        Down::Control(m) => m.encode_to_vec(),
        Down::Parts(_) | Down::Bricks(_) => Vec::new(),
    };
    let up = |m: &ToMaster| convert::from_worker_to_wire(m).encode_to_vec();
    let (lease_bytes, result_bytes) = (down(&lease), up(&result));
    let byte = |ns: f64, bytes: &[u8]| BYTE + ns / bytes.len().max(1) as f64;
    let send = best(|| drop(down(&lease)));
    let worker_send = best(|| drop(up(&result)));
    let receive = best(|| {
        let message = v1::FromWorker::decode(&result_bytes[..]).expect("written above");
        drop(convert::from_worker_from_wire(message));
    });
    let worker_receive = best(|| {
        let message = v1::ToWorker::decode(&lease_bytes[..]).expect("written above");
        drop(convert::to_worker_from_wire(message));
    });
    Costs {
        send: (MESSAGE.0, byte(send, &lease_bytes)),
        receive: (MESSAGE.0, byte(receive, &result_bytes)),
        bricks: (MESSAGE.0, BYTE),
        worker_receive: (MESSAGE.1, byte(worker_receive, &lease_bytes)),
        worker_send: (MESSAGE.1, byte(worker_send, &result_bytes)),
        // Bricks are decoded and put into the cache: some 3 ns a byte (docs/performance.md).
        worker_bricks: (MESSAGE.1, BYTE + 3.0),
        finish_pixel: finish(trace),
        hold: (0.0, fill()),
        late: late(),
        wake: WAKE,
        ..Costs::default()
    }
}

/// The same where a message costs so much at a master and at a worker, whatever it carries.
pub(super) fn with_messages(costs: Costs, [master, worker]: [f64; 2]) -> Costs {
    Costs {
        send: (master, costs.send.1),
        receive: (master, costs.receive.1),
        bricks: (master, costs.bricks.1),
        worker_receive: (worker, costs.worker_receive.1),
        worker_send: (worker, costs.worker_send.1),
        worker_bricks: (worker, costs.worker_bricks.1),
        ..costs
    }
}

/// What a message costs here, from the processor time that a rehearsal took of a master and its
/// workers. `predicted` says what both take if messages cost so much.
pub(super) fn calibrated(
    measured: [f64; 2],
    predicted: impl Fn([f64; 2]) -> Result<[f64; 2], crate::fail::Fail>,
) -> Result<[f64; 2], crate::fail::Fail> {
    // Both are straight lines: the work of each message is what it is, whenever it is done.
    const STEP: f64 = 10_000.0;
    let (none, some) = (predicted([0.0; 2])?, predicted([STEP; 2])?);
    Ok(std::array::from_fn(|i| {
        let slope = (some[i] - none[i]) / STEP;
        if slope > 0.0 { ((measured[i] - none[i]) / slope).clamp(1_000.0, 500_000.0) } else { STEP }
    }))
}

/// To hash and encode a pixel, in nanoseconds.
fn finish(trace: &Trace) -> f64 {
    use slabcast_common::image::{Background, FrameState, PixelFormat, TilePixels};
    let size = trace.about.size;
    let mut state = FrameState::new(size);
    let whole = Rect::of_size(size);
    let (a, colour) = (vec![0.5; whole.area()], vec![[1 << 27; 3]; whole.area()]);
    state.lay(whole, TilePixels { a, colour, last: None });
    let ns = (0..3)
        .map(|_| {
            let began = cpu_ns();
            let encoded = state.encode(PixelFormat::Rgb8, Background::Colour([0.0; 3]));
            std::hint::black_box(encoded);
            (cpu_ns() - began) as f64
        })
        .fold(f64::INFINITY, f64::min);
    ns / (f64::from(size[0]) * f64::from(size[1]))
}

/// To fill a pixel of a result that is held, in nanoseconds.
fn fill() -> f64 {
    let (rect, size) = (Rect::new(0, 0, 64, 64), [64, 64]);
    let shut = vec![false; 64 * 64];
    best(|| drop(std::hint::black_box(trace::filled(&rect, &shut, size, 100_000)))) / 4096.0
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
