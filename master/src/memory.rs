//! Memory of a master: what it may hold, and what a picture takes.
//!
//! Three things take memory because somebody asks: the requests of open jobs, brick sets, and
//! frames (in the making, and finished ones that wait to be taken). Each has a share, and what
//! does not fit its share waits or is refused with both figures.
//!
//! A picture's sums and its finished pixels exist side by side while it is encoded. At 512x512 they
//! take 6 MB, which matters to nobody; at 8192x8192 they take up to 4.5 GB, which may end the
//! machine or every other job of this master.

use crate::library::OpenVolume;
use slabcast_common::image::{FrameState, PixelFormat};
use slabcast_common::quality::{InvalidField, Schedule};
use slabcast_common::volume::VolumeInfo;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::request::PathRequest;

/// Bytes of finished frames and frames in the making: 64 frames of 1024x1024 RGBA8. At half, four
/// frames of 2048x2048 are no longer drawn side by side; at twice this, strangers' frames that
/// nobody takes fill half a gigabyte.
const FRAMES: u64 = 256 << 20;

/// Bytes of frames in the making of a master that has no limit: four of 2 GiB, as a picture of
/// 4096x4096 takes under the `slab` schedule.
const UNLIMITED_FLIGHTS: u64 = 8 << 30;

/// Bytes of the requests of all open jobs, and of the jobs that are remembered. A turntable takes
/// some 3 KiB, a path of 10,000 views 1.2 MiB.
const REQUESTS: usize = 64 << 20;

/// Bytes that a master may hold at most, by what takes them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shares {
    /// Finished frames, together with those in the making where it is limited.
    pub frames: u64,
    /// Frames in the making; one alone may take more.
    pub flights: u64,
    /// The largest frame that is taken; `None`: whatever this machine has free.
    pub largest_frame: Option<u64>,
    /// Brick sets; one alone may take more.
    pub bricks: u64,
    /// Requests of open jobs.
    pub requests: usize,
}

impl Default for Shares {
    /// The shares of a master that serves its own process: what its machine has.
    fn default() -> Self {
        Shares {
            frames: FRAMES,
            flights: UNLIMITED_FLIGHTS,
            largest_frame: None,
            bricks: u64::MAX,
            requests: REQUESTS,
        }
    }
}

impl Shares {
    /// Returns the shares of a master that may hold `bytes` beside its volume.
    pub fn of(bytes: u64) -> Self {
        let frames = (bytes / 4).min(FRAMES);
        Shares {
            frames,
            flights: frames,
            largest_frame: Some(bytes / 2),
            bricks: bytes / 4,
            requests: REQUESTS.min((bytes / 16) as usize),
        }
    }

    /// Returns the bytes of a set's contents that are kept in memory: all of a volume in memory if the
    /// master has no limit, and a quarter of the free memory of a file.
    pub(crate) fn bricks_kept(&self, open: &OpenVolume) -> u64 {
        if self.bricks < u64::MAX || open.source.whole(open.level).is_some() {
            return self.bricks;
        }
        available().map_or(u64::MAX, |free| free / 4)
    }

    /// Checks that the master has memory for the frames of a request.
    ///
    /// # Errors
    /// Names `size`, with what a frame takes and what there is.
    pub(crate) fn check(&self, request: &PathRequest) -> Result<(), InvalidField> {
        let (need, size) = (making_bytes(request), request.path.size);
        let free = available();
        let most = [free, self.largest_frame].into_iter().flatten().min();
        most.map_or(Ok(()), |most| fits(size, need, most))
    }
}

/// Returns the bytes that a frame of this request takes at most while it is made: its sums, and its
/// finished pixels.
pub(crate) fn making_bytes(request: &PathRequest) -> u64 {
    let [w, h] = request.path.size.map(u64::from);
    w * h * (sums_bytes(request.work.schedule, request.want_hash) + finished_bytes(request.format))
}

fn finished_bytes(format: PixelFormat) -> u64 {
    format.bytes() as u64
}

/// Bytes of a pixel before it is encoded. Under `region` each pixel comes once, as opacity and
/// three colours, or finished.
fn sums_bytes(schedule: Schedule, hashed: bool) -> u64 {
    match (schedule, hashed) {
        (Schedule::Slab, _) => FrameState::BYTES_A_PIXEL,
        (_, true) => 16,
        // Tiles that wait to be laid into the picture.
        (_, false) => 4,
    }
}

/// Returns an upper bound of the bytes of a brick set.
pub(crate) fn brick_set_bytes(volume: &VolumeInfo, needs: &BrickNeeds) -> u64 {
    let voxels: u64 = volume.lattice.dims.iter().map(|&n| u64::from(n)).product();
    let sample = volume.summary.code_kind().bytes() as u64;
    // A voxel's index within its brick takes up to two bytes.
    voxels * (2 + sample + 2 * u64::from(needs.normals) + u64::from(needs.gradients))
}

fn fits(size: [u32; 2], need: u64, most: u64) -> Result<(), InvalidField> {
    if need <= most {
        return Ok(());
    }
    Err(InvalidField::new(
        "size",
        format!(
            "{}x{} pixels take the master {:.1} GiB, and it has {:.1} GiB for a frame; give a \
             smaller size",
            size[0],
            size[1],
            gib(need),
            gib(most)
        ),
    ))
}

fn gib(n: u64) -> f64 {
    n as f64 / f64::from(1 << 30)
}

/// Returns bytes for people: `256 MiB`.
pub(crate) fn mib(n: u64) -> String {
    format!("{} MiB", n.div_ceil(1 << 20))
}

/// Returns the bytes that this process may still take: the system's available memory, or the memory
/// left to its control group if that is less. `None` if neither is known; then nothing is refused.
pub fn available() -> Option<u64> {
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let system = read("/proc/meminfo").as_deref().and_then(parse_meminfo);
    let number = |path: String| read(&path)?.trim().parse::<u64>().ok();
    let groups = read("/proc/self/cgroup").unwrap_or_default();
    // The mount's own root is the group inside of a container.
    let paths = group_folders(&groups).into_iter().chain([
        ("/sys/fs/cgroup".to_string(), ["memory.max", "memory.current"]),
        ("/sys/fs/cgroup/memory".to_string(), ["memory.limit_in_bytes", "memory.usage_in_bytes"]),
    ]);
    let left = paths.filter_map(|(folder, [max, used])| {
        let max = number(format!("{folder}/{max}"))?;
        Some(max.saturating_sub(number(format!("{folder}/{used}"))?))
    });
    system.into_iter().chain(left).min()
}

/// Returns the folders of the groups of /proc/self/cgroup that limit memory, with the names of
/// their limit and their use.
fn group_folders(text: &str) -> Vec<(String, [&'static str; 2])> {
    let folder = |line: &str| {
        let mut parts = line.splitn(3, ':').skip(1);
        let (controllers, path) = (parts.next()?, parts.next()?.trim_end_matches('/'));
        if controllers.is_empty() {
            return Some((format!("/sys/fs/cgroup{path}"), ["memory.max", "memory.current"]));
        }
        controllers.split(',').any(|c| c == "memory").then(|| {
            let folder = format!("/sys/fs/cgroup/memory{path}");
            (folder, ["memory.limit_in_bytes", "memory.usage_in_bytes"])
        })
    };
    text.lines().filter_map(folder).collect()
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
        let e = fits([8192, 8192], (8192 * 8192) * 68, 4 << 30).unwrap_err();
        assert_eq!(e.field, "size");
        assert_eq!(
            e.problem,
            "8192x8192 pixels take the master 4.2 GiB, and it has 4.0 GiB for a frame; give a \
             smaller size"
        );
        assert!(fits([8192, 8192], (8192 * 8192) * 68, 5 << 30).is_ok());
        assert!(fits([1, 1], 80, 79).is_err() && fits([1, 1], 80, 80).is_ok());
    }

    #[test]
    fn shares_are_parts_of_what_a_master_may_hold() {
        for bytes in [64 << 20, 512 << 20, 2 << 30, 64 << 30u64] {
            let s = Shares::of(bytes);
            let frame = s.largest_frame.unwrap();
            assert!(frame + s.bricks + s.requests as u64 <= bytes && s.frames <= bytes / 4);
        }
        assert_eq!(Shares::of(2 << 30).frames, 256 << 20);
    }

    #[test]
    fn available_memory_is_read_or_unknown() {
        let text = "MemTotal:       24000000 kB\nMemAvailable:   1024 kB\n";
        assert_eq!(parse_meminfo(text), Some(1 << 20));
        assert_eq!(parse_meminfo("MemTotal: 3 kB\nMemAvailable: some\n"), None);
        assert_eq!(
            group_folders("4:cpu,cpuacct:/a\n3:memory:/job\n0::/system.slice/slabcast.service\n"),
            [
                (
                    "/sys/fs/cgroup/memory/job".to_string(),
                    ["memory.limit_in_bytes", "memory.usage_in_bytes"]
                ),
                (
                    "/sys/fs/cgroup/system.slice/slabcast.service".to_string(),
                    ["memory.max", "memory.current"]
                ),
            ]
        );
    }
}
