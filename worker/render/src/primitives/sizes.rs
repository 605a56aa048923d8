//! Fixed sizes that tables and kernels share.

/// Edge of a tile part in pixels. 64 makes a row of the open mask one word, and open sheets fit a
/// second-level cache of 512 KiB. At 32 a head takes 12 % more splats (286 k instead of 256 k a
/// frame) for their overlap and no less time (docs/measurements/accuracy.md); at 128 a row would
/// need two words, and the sheets 1.5 MiB.
pub const PART: i32 = 64;
const _: () = assert!(PART == slabcast_common::region::PART_EDGE);

/// Largest number of sheets in one pixel record.
pub const MOST: usize = 8;

/// Largest number of a footprint's pixels along one axis for which weights are read as one
/// register.
pub const LINE: usize = 16;

/// Largest number of pixel rows that all sections of a sheared voxel have together, and least
/// number of zeros around a phase's weights. A lattice of slices twice as thick as its pixels, seen
/// at two pixels a voxel from 30 degrees above, has some 20.
pub const SHEAR_ROWS: usize = 32;

/// Largest number of columns that all sections of a sheared voxel have together in one pixel row.
pub const SHEAR_COLUMNS: usize = 24;

/// Largest number of lattice rows that reach a pixel: kernels with a radius of seven lattice steps.
pub const REACHING: usize = 16;

/// Most lattice rows of a part of 64 pixels, with those that reach in from outside. It needs 104;
/// a power of two makes the division cheap.
pub const LATTICE_ROWS: usize = 128;
