//! What this machine is called.

/// Its processor, as the system names it; where that is not to be had, the architecture.
pub(crate) fn cpu() -> String {
    let listed = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let name = listed.lines().find_map(|l| l.strip_prefix("model name")?.split_once(": "));
    match name {
        Some((_, name)) if !name.trim().is_empty() => crate::fail::one_line(name),
        _ => std::env::consts::ARCH.to_string(),
    }
}
