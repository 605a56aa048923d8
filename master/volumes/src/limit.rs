//! Limit on the bytes of samples that a file may become without `--max-bytes`.
//!
//! A size in a header is checked against the bytes that are there ([`crate::samples::Supply`]), so
//! no header lies for long. But a file of 8 MB may say honestly that it becomes 8 GiB: zeros shrink
//! a thousandfold. Nobody who opens a file of 8 MB expects that, so it takes a flag.
//!
//! Two figures, and the smaller holds. *The file's*: 1 GiB or 64 times the file, whichever is more.
//! Scans shrink to a half or a tenth and segmentations to a hundredth; 1 GiB is a label map of
//! 1024^3, which any file may become. At half, such label maps would need the flag; at twice, a
//! stranger's file of some KB takes 2 GiB and 15 s. *The machine's*: three quarters of the memory
//! that is free, since bricks and pictures need room beside the samples. `--max-bytes` stands in
//! place of both.

use crate::error::{OpenErrorKind, Problem};
use crate::numbers::Beside;

/// Bytes of samples that any file may become, however small it is.
pub(crate) const ANY_FILE_BYTES: u64 = 1 << 30;
/// Bytes of samples for each byte of a file, beyond [`ANY_FILE_BYTES`].
pub(crate) const FILE_RATIO: u64 = 64;
/// Samples of fewer bytes fit everywhere; the system is not asked for its memory.
const SMALL_BYTES: u64 = 64 << 20;
/// Free memory to assume where the system does not tell.
const FREE_MEMORY_BYTES: u64 = 4 << 30;

/// The limit that the user gave, or the default, and where numbers go that codes do not hold.
#[derive(Clone, Debug, Default)]
pub(crate) struct ByteCap {
    /// `--max-bytes`; `None` for the default.
    pub(crate) asked: Option<u64>,
    /// Numbers and notes that readers leave beside the samples.
    pub(crate) beside: Beside,
}

impl ByteCap {
    /// Checks samples of `need` bytes, out of `stored` bytes of files. `field` is the file's name
    /// for the size.
    ///
    /// # Errors
    /// [`OpenErrorKind::TooLarge`], with the figures and the flag.
    pub(crate) fn check(&self, need: u64, stored: u64, field: &str) -> Result<(), Problem> {
        self.check_within(need, stored, field, free_memory)
    }

    /// Checks samples of `need` bytes against the limit that the user gave, if there is one: what
    /// is read in parts is more than each of them.
    ///
    /// # Errors
    /// [`OpenErrorKind::TooLarge`], with the figures and the flag.
    pub(crate) fn check_asked(&self, need: u64, field: &str) -> Result<(), Problem> {
        match self.asked {
            Some(_) => self.check_within(need, u64::MAX, field, free_memory),
            None => Ok(()),
        }
    }

    /// Returns the bytes of files that are enough for samples of `need` bytes: more would change
    /// nothing. 0 if any file may become so much.
    #[cfg(feature = "zarr")]
    pub(crate) fn stored_for(&self, need: u64) -> u64 {
        match self.asked.is_some() || need <= ANY_FILE_BYTES {
            true => 0,
            false => need.div_ceil(FILE_RATIO),
        }
    }

    fn check_within(
        &self,
        need: u64,
        stored: u64,
        field: &str,
        free: impl Fn() -> u64,
    ) -> Result<(), Problem> {
        let refused = |why: String| {
            Err(Problem::new(
                OpenErrorKind::TooLarge,
                field,
                why,
                format!("give --max-bytes {need} to read it all the same, or crop it"),
            ))
        };
        if let Some(most) = self.asked {
            return match need > most {
                true => {
                    refused(format!("{need} bytes of samples are more than the {most} allowed"))
                }
                false => Ok(()),
            };
        }
        let most = ANY_FILE_BYTES.max(stored.saturating_mul(FILE_RATIO));
        if need > most {
            return refused(format!(
                "{stored} bytes of file become {need} bytes of samples, and only {most} are read \
                 unasked"
            ));
        }
        let room = if need > SMALL_BYTES { free() / 4 * 3 } else { u64::MAX };
        // Kept numbers lie beside as many codes of half their bytes, or as many.
        let held = if self.beside.keeps() { need.saturating_mul(2) } else { need };
        if held > room {
            return refused(format!(
                "{held} bytes of samples are more than the {room} that are three quarters of the \
                 free memory"
            ));
        }
        Ok(())
    }
}

/// Returns the memory that this process may still take, in bytes.
pub(crate) fn free_memory() -> u64 {
    let system = std::fs::read_to_string("/proc/meminfo").ok().and_then(|text| available(&text));
    system.into_iter().chain(left_to_group()).min().unwrap_or(FREE_MEMORY_BYTES)
}

/// Returns `MemAvailable` of /proc/meminfo in bytes.
fn available(meminfo: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kib| kib * 1024)
}

/// Returns the bytes left to this process's control group (version 2), or to a group around it if
/// that has less. The page cache counts as free: it makes way.
fn left_to_group() -> Option<u64> {
    let own = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let own = own.lines().find_map(|l| l.strip_prefix("0::/"))?;
    let root = std::path::Path::new("/sys/fs/cgroup");
    root.join(own).ancestors().take_while(|group| group.starts_with(root)).filter_map(left_in).min()
}

fn left_in(group: &std::path::Path) -> Option<u64> {
    let text = |name: &str| std::fs::read_to_string(group.join(name)).ok();
    let number = |name: &str| text(name)?.trim().parse::<u64>().ok();
    let used = number("memory.current")?.saturating_sub(cached(&text("memory.stat")?));
    Some(number("memory.max")?.saturating_sub(used))
}

/// Returns the bytes of the page cache in a group's `memory.stat`.
fn cached(stat: &str) -> u64 {
    let lines = stat.lines().filter_map(|l| l.split_once(' '));
    let files = lines.filter(|(name, _)| ["inactive_file", "active_file"].contains(name));
    files.filter_map(|(_, bytes)| bytes.parse::<u64>().ok()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;
    const GIB: u64 = 1 << 30;

    #[test]
    fn small_file_that_becomes_gigabytes_is_refused_with_figure_and_flag() {
        let cap = |asked| ByteCap { asked, ..ByteCap::default() };
        let check = |asked, need, stored| {
            cap(asked).check_within(need, stored, "sizes", || 20 * GIB).map_err(|p| p.to_string())
        };
        let e = check(None, 8 * GIB, 8 * MIB).unwrap_err();
        assert_eq!(
            e,
            "sizes: 8388608 bytes of file become 8589934592 bytes of samples, and only 1073741824 \
             are read unasked; give --max-bytes 8589934592 to read it all the same, or crop it"
        );
        assert_eq!(check(Some(8 * GIB), 8 * GIB, 8 * MIB), Ok(()), "as asked");
        assert_eq!(check(None, GIB, 300), Ok(()), "a label map of 1024^3");
        assert_eq!(check(None, 8 * GIB, 128 * MIB), Ok(()), "64 times smaller");
        assert_eq!(check(None, 8 * GIB, 8 * GIB), Ok(()), "not packed");
        let e = check(None, 16 * GIB, 16 * GIB).unwrap_err();
        assert!(e.contains("more than the 16106127360 that are three quarters"), "{e}");
        assert_eq!(check(Some(16 * GIB), 16 * GIB, 16 * GIB), Ok(()), "memory as asked");
        let e = check(Some(100), 101, 1).unwrap_err();
        assert!(e.contains("101 bytes of samples are more than the 100 allowed"), "{e}");
    }

    #[test]
    fn memory_is_read_from_the_system_and_from_its_group() {
        let text = "MemTotal:       24000000 kB\nMemAvailable:   1024 kB\n";
        assert_eq!(available(text), Some(MIB));
        assert_eq!(available("MemTotal: 3 kB\nMemAvailable: some\n"), None);
        let stat = "anon 5\nfile 900\ninactive_file 300\nactive_file 400\nslab 7\n";
        assert_eq!(cached(stat), 700);
        assert!(free_memory() > 0);
        let group = tempfile::tempdir().unwrap();
        let put = |name: &str, text: &str| std::fs::write(group.path().join(name), text).unwrap();
        put("memory.current", "1000\n");
        put("memory.stat", stat);
        put("memory.max", "max\n");
        assert_eq!(left_in(group.path()), None);
        put("memory.max", "2000\n");
        assert_eq!(left_in(group.path()), Some(1700));
    }
}
