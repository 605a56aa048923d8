//! Results of a rehearsal carry placeholder pixels that weigh what the trace says.

use prost::Message;
use slabcast_common::ids::{Epoch, TaskId};
use slabcast_common::image::{Background, PixelEncoding, PixelFormat};
use slabcast_common::message::{Pixels, TaskTimes, TileResult, ToMaster};
use slabcast_common::occlusion::Rect;
use slabcast_proto::convert;
use slabcast_trace::placeholder_finished;

#[test]
fn placeholder_pixels_have_the_traced_size_on_the_wire() {
    let us = 1 << 33;
    let times = TaskTimes { received_us: us, ready_us: us, start_us: us, end_us: us, thread: 0 };
    for (format, edge) in
        [(PixelFormat::Rgb8, 64), (PixelFormat::Rgb8, 256), (PixelFormat::Rgba32F, 32)]
    {
        let finish = PixelEncoding { format, background: Background::Transparent };
        let whole = (edge * edge) as usize * format.bytes();
        for bytes in [100, 300, 1_000, 7_777, whole / 2, whole] {
            if bytes > whole {
                continue;
            }
            let rect = Rect::new(0, 0, edge, edge);
            let result = ToMaster::Result(Box::new(TileResult {
                task: TaskId(5000),
                epoch: Epoch(0),
                pixels: Pixels::Finished(placeholder_finished(&rect, bytes as u32, &finish)),
                bytes: None,
                counters: Default::default(),
                times,
                region: None,
            }));
            let weighs = convert::from_worker_to_wire(&result).encoded_len();
            let off = weighs.abs_diff(bytes);
            assert!(off <= 40 + bytes / 50, "{format:?}, {edge}: {weighs} bytes for {bytes}");
        }
    }
}
