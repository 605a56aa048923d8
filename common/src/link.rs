//! Constants of the links between a master and its workers.
//!
//! The real links (`slabcast-proto`, `slabcast-master`, `slabcast-worker`) and the simulated ones
//! (`slabcast-sim`) read them here, so that a prediction follows when one of them changes.

/// Bytes of the largest message that carries bricks. It fits one HTTP/2 frame of 64 KiB, and
/// tiles start while later bricks are on their way.
pub const MAX_BRICK_BATCH_BYTES: usize = 65_000;

/// Messages with bricks that may wait at either end of one worker's link: enough to keep a
/// stream busy, little enough that the bricks of a dropped worker don't pile up.
pub const BRICK_BATCHES_IN_FLIGHT: usize = 8;

/// Frames that a master has in hand: being drawn, or being hashed and encoded. Frames of the
/// `region` schedule are drawn side by side, so that a thread without tiles of one frame goes on
/// with the next.
///
/// With two, threads run dry at the end of a frame unless the next one's tiles are shared as
/// evenly. 15 workers that draw mri256 at 512x512 deliver 58 % of the frames that 15 times one
/// worker would with two, and 68 % with four; at 1024x1024 it is 79 and 89 %. A frame takes 28
/// bytes a pixel.
pub const FRAMES_IN_FLIGHT: usize = 4;

/// Limit: frames in flight of all clients together. Beside [`FRAMES_IN_FLIGHT`] frames of others, a
/// client without a frame in flight may begin one, up to this number.
pub const MOST_FRAMES_IN_FLIGHT: usize = 8;

/// Limit: frames of live sessions in flight beside [`MOST_FRAMES_IN_FLIGHT`] of others: they wait for no
/// job. As many sessions as a master takes have one each.
pub const MOST_LIVE_FRAMES: usize = 64;

/// Threads of a master that hash and encode frames, one frame at a time each. A frame of 512x512
/// takes 3 ms. With one thread, 15 workers that draw a frame in 3 ms wait for it; a third would
/// have no frame to finish.
pub const FINISHER_THREADS: usize = 2;

/// Threads that carry a master's streams on a machine with this many cores: two, or one on up to
/// two cores, where a second is woken for much of what the first could do at once.
///
/// On two cores and two workers, streams take 3.1 to 3.4 ms of a worker and 2.3 to 2.4 ms of the
/// master for a frame of mri256 with two threads, 2.5 and 2.0 ms with one.
pub const fn stream_threads(cores: u32) -> usize {
    if cores > 2 { 2 } else { 1 }
}
