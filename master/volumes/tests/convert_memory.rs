//! Tests that a conversion takes the memory of some planes of each level, and not of the volume.
//!
//! A test program of its own, since it measures the peak memory of the process.
#![cfg(all(feature = "zarr", target_os = "linux"))]

use slabcast_volumes::Hints;
use slabcast_volumes::blocks::ome_zarr::convert;
use std::io::Write;

/// Returns a memory figure of this process in MiB.
fn memory_mib(figure: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").expect("a status");
    let line = status.lines().find(|l| l.starts_with(figure)).expect("the figure is there");
    let kib = line.split_ascii_whitespace().nth(1).and_then(|n| n.parse::<u64>().ok());
    kib.expect("a number") / 1024
}

#[test]
fn long_volume_is_converted_in_the_memory_of_its_planes() {
    let dir = tempfile::tempdir().expect("a folder");
    let from = dir.path().join("long_512x512x1024_uint16.raw");
    let mut file = std::fs::File::create(&from).expect("a file");
    for z in 0..1024u32 {
        let plane: Vec<u8> = (0..512 * 512u32)
            .flat_map(|i| ((i * 7 + z * 13) as u16 % 5000).to_le_bytes())
            .collect();
        file.write_all(&plane).expect("room for 512 MiB");
    }
    drop(file);
    std::fs::write("/proc/self/clear_refs", "5").expect("the peak can be begun anew");
    let before = memory_mib("VmRSS:");
    convert(&from, &dir.path().join("x.ome.zarr"), &Hints::default(), false, &mut |_, _| Ok(()))
        .expect("a pyramid");
    let grew = memory_mib("VmHWM:").saturating_sub(before);
    // 64 planes of half a MiB, one and a half times, and what is on its way.
    println!("512 MiB of samples, grew by {grew} MiB");
    assert!(grew <= 48 + 192, "grew by {grew} MiB");
}
