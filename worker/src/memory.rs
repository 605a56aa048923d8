//! Share of a worker's memory that its bricks may take.
//!
//! `--memory` is for the whole process, since that is what a control group or a full machine kills.
//! So bricks are counted by the bytes that they take in memory, not by their encoded ones, and get
//! what is left beside `rest_bytes`: the program, its threads' scratch, directories, tables,
//! stalled regions, and what the allocator keeps.
//!
//! The rest is an estimate. Measuring it by the peak of the process was tried: one spike (a link
//! that is lost and dialled again) then leaves a tenth of the memory to bricks for ever.

/// Memory of a worker without bricks and threads: 17 MiB when it starts, and the directories and
/// messages of a first volume of 256 voxels a side.
const PROGRAM_BYTES: u64 = 24 << 20;

/// Memory of a render thread: its scratch for tiles of 256x256 pixels.
const THREAD_BYTES: u64 = 6 << 20;

/// Memory that directories, tables, stalled regions and holes come to take beside all that: 16
/// transfer functions of lidc0314_ct (512 x 512 x 267) left some 130 MiB that were not bricks, with
/// two threads. No more than [`REST_SHARE`] of a small limit is kept for it.
const REST_BYTES: u64 = 128 << 20;

/// Largest part of the limit that is kept free for [`REST_BYTES`]: numerator and denominator.
const REST_SHARE: (u64, u64) = (2, 5);

/// Fewest bytes of bricks to draw with: a region keeps the bricks of a few sheets, some 8 MiB of a
/// head of 512 voxels a side.
const LEAST_BRICKS_BYTES: u64 = 16 << 20;

/// Part of the limit that is left free, since render threads still hold bricks that were dropped.
const SPARE_DIVISOR: u64 = 16;

/// Bytes in memory for one byte of an encoded brick, until there are bricks to measure: 2.3 to 2.6
/// in lidc0314_ct.
const BYTES_AN_ENCODED: u64 = 3;

/// Returns the smallest memory with which a worker of so many render threads can draw, in bytes.
pub fn least_bytes(threads: u32) -> u64 {
    fixed_bytes(threads) + LEAST_BRICKS_BYTES
}

/// Returns the encoded bytes of bricks that a worker of `limit_bytes` of memory tells its master:
/// what will fit for certain.
pub fn encoded_share(limit_bytes: u64, threads: u32) -> u64 {
    bricks_bytes(limit_bytes, threads) / BYTES_AN_ENCODED
}

/// Converts a budget of `bricks_bytes` in memory to encoded bytes of bricks. `encoded` bytes are
/// here now and take `resident` bytes of memory.
pub(crate) fn encoded_budget(bricks_bytes: u64, encoded: u64, resident: u64) -> u64 {
    // With few bricks the ratio is chance.
    if resident < LEAST_BRICKS_BYTES / 16 {
        return bricks_bytes / BYTES_AN_ENCODED;
    }
    (u128::from(bricks_bytes) * u128::from(encoded) / u128::from(resident)) as u64
}

/// Returns the bytes of memory that bricks may take.
pub(crate) fn bricks_bytes(limit_bytes: u64, threads: u32) -> u64 {
    let spare = limit_bytes / SPARE_DIVISOR;
    let bricks = limit_bytes.saturating_sub(rest_bytes(limit_bytes, threads) + spare);
    bricks.max(LEAST_BRICKS_BYTES)
}

/// Returns what is kept free for all but bricks.
fn rest_bytes(limit_bytes: u64, threads: u32) -> u64 {
    let (part, whole) = REST_SHARE;
    fixed_bytes(threads) + REST_BYTES.min(limit_bytes / whole * part)
}

fn fixed_bytes(threads: u32) -> u64 {
    PROGRAM_BYTES + u64::from(threads) * THREAD_BYTES
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    #[test]
    fn bricks_get_what_the_rest_leaves_and_always_enough_to_draw() {
        let room = (512 - 36 - 128 - 32) * MIB;
        assert_eq!(bricks_bytes(512 * MIB, 2), room);
        assert_eq!(encoded_share(512 * MIB, 2), room / 3);
        assert_eq!(least_bytes(2), (24 + 2 * 6 + 16) * MIB);
        assert_eq!(bricks_bytes(least_bytes(2), 2), LEAST_BRICKS_BYTES);
        // Bricks get nearly all of a large limit.
        assert!(bricks_bytes(16 << 30, 8) > 14 << 30);
    }

    #[test]
    fn budget_in_encoded_bytes_follows_what_the_bricks_here_take() {
        assert_eq!(encoded_budget(300 * MIB, 0, 0), 100 * MIB, "nothing is here yet");
        assert_eq!(encoded_budget(300 * MIB, 100 * MIB, 200 * MIB), 150 * MIB);
        // Bricks of a few voxels each take twenty times their encoding.
        assert_eq!(encoded_budget(300 * MIB, 10 * MIB, 200 * MIB), 15 * MIB);
    }
}
