//! Checks that pictures fit in memory before any memory is taken.
//!
//! A picture's sums and its finished pixels exist side by side while it is encoded. At 512x512 they
//! take 18 MB, which matters to nobody; at 8192x8192 they take 4.5 GB, which may end the machine or
//! every other job of this master.

use slabcast_common::image::{FrameState, PixelFormat};
use slabcast_common::quality::InvalidField;

/// Frames of more bytes than this are rendered one at a time, not four: workers then idle between
/// two frames while one is encoded, seconds of minutes. At half, pictures of 4096x4096 lose their
/// overlap; four frames of just under this take 8.6 GB, and at twice this, twice as much.
const ONE_AT_A_TIME_BYTES: u64 = 2 << 30;

/// Returns the bytes of a picture's sums and of its finished pixels.
fn frame_bytes(size: [u32; 2], format: PixelFormat) -> u64 {
    const FINISHED: u64 = 16;
    let pixels = u64::from(size[0]) * u64::from(size[1]);
    pixels * (FrameState::BYTES_A_PIXEL + FINISHED + format.bytes() as u64)
}

/// Returns whether frames of this size may be in flight with others.
pub(crate) fn beside_others(size: [u32; 2], format: PixelFormat) -> bool {
    frame_bytes(size, format) <= ONE_AT_A_TIME_BYTES
}

/// Checks that this machine has memory for a picture now.
pub(crate) fn check(size: [u32; 2], format: PixelFormat) -> Result<(), InvalidField> {
    available().map_or(Ok(()), |free| fits(size, format, free))
}

fn fits(size: [u32; 2], format: PixelFormat, free: u64) -> Result<(), InvalidField> {
    let need = frame_bytes(size, format);
    if need <= free {
        return Ok(());
    }
    let gib = |n: u64| n as f64 / f64::from(1 << 30);
    Err(InvalidField::new(
        "size",
        format!(
            "{}x{} pixels take the master {:.1} GiB, and it has {:.1} GiB free; give a smaller size",
            size[0],
            size[1],
            gib(need),
            gib(free)
        ),
    ))
}

/// Returns the bytes that this process may still take: the system's available memory, or the memory
/// left to its control group if that is less. `None` if neither is known; then nothing is refused.
fn available() -> Option<u64> {
    let number = |path: &str| std::fs::read_to_string(path).ok()?.trim().parse::<u64>().ok();
    let system = std::fs::read_to_string("/proc/meminfo").ok().as_deref().and_then(parse_meminfo);
    let group = number("/sys/fs/cgroup/memory.max")
        .zip(number("/sys/fs/cgroup/memory.current"))
        .map(|(max, current)| max.saturating_sub(current));
    system.into_iter().chain(group).min()
}

/// Returns `MemAvailable` of /proc/meminfo in bytes.
fn parse_meminfo(text: &str) -> Option<u64> {
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn picture_beyond_memory_is_refused_with_both_figures() {
        let e = fits([8192, 8192], PixelFormat::Rgba8, 4 << 30).unwrap_err();
        assert_eq!(e.field, "size");
        assert_eq!(
            e.problem,
            "8192x8192 pixels take the master 4.2 GiB, and it has 4.0 GiB free; give a smaller size"
        );
        assert!(fits([8192, 8192], PixelFormat::Rgba8, 5 << 30).is_ok());
        assert!(fits([1, 1], PixelFormat::Rgba32F, 79).is_err());
        assert!(fits([1, 1], PixelFormat::Rgba32F, 80).is_ok());
    }

    #[test]
    fn only_huge_frames_are_rendered_one_at_a_time() {
        assert!(beside_others([4096, 4096], PixelFormat::Rgba32F));
        assert!(!beside_others([8192, 8192], PixelFormat::Rgb8));
    }

    #[test]
    fn available_memory_is_read_or_unknown() {
        let text = "MemTotal:       24000000 kB\nMemAvailable:   1024 kB\n";
        assert_eq!(parse_meminfo(text), Some(1 << 20));
        assert_eq!(parse_meminfo("MemTotal: 3 kB\nMemAvailable: some\n"), None);
    }
}
