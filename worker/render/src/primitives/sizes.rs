//! Fixed sizes that tables and kernels share.

/// Edge of a tile part in pixels. 64 makes a row of the open mask one word, and open sheets fit a
/// second-level cache of 512 KiB. At 32 a head takes 12 % more splats (286 k instead of 256 k a
/// frame) for their overlap and no less time (docs/measurements/accuracy.md); at 128 a row would
/// need two words, and the sheets 1.5 MiB.
pub const PART: i32 = 64;
const _: () = assert!(PART == slabcast_common::region::PART_EDGE);

/// Largest number of sheets in one pixel record.
pub const MOST: usize = 8;
