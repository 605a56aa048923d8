//! The machine that this process runs on: its processor's name and its cores.

/// Returns the processor's name as the system has it, else the architecture.
pub fn cpu() -> String {
    let listed = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = listed.lines().find_map(|l| l.strip_prefix("model name")?.split_once(": "));
    match name {
        Some((_, name)) if !name.trim().is_empty() => crate::terminal::one_line(name),
        _ => std::env::consts::ARCH.to_string(),
    }
}

/// Returns the number of cores that this process may use, at least 1 and at most 1024.
pub fn cores() -> u32 {
    std::thread::available_parallelism().map_or(1, |n| n.get().min(1024) as u32)
}

/// Returns the id of this boot of this machine, which all its processes and containers share; empty
/// where the system has none.
pub fn boot_id() -> String {
    let id = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    id.trim().to_owned()
}
