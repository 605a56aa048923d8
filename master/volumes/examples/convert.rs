//! Converts a volume to OME-Zarr and says how long it took, and how much memory.
//!
//! `cargo run --release -p slabcast-volumes --features zarr --example convert -- FROM TO.ome.zarr`

use slabcast_volumes::Hints;
use slabcast_volumes::blocks::ome_zarr::convert;
use std::time::Instant;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [from, to] = &args[..] else { panic!("give FROM and TO") };
    let (began, mut bytes) = (Instant::now(), 0);
    let mut on_progress = |_, total| {
        bytes = total;
        Ok(())
    };
    let hints = Hints { max_bytes: Some(u64::MAX), ..Hints::default() };
    match convert(from.as_ref(), to.as_ref(), &hints, true, &mut on_progress) {
        Ok(converted) => converted.levels.iter().for_each(|level| {
            println!("level {}: {:?}, {}", level.level, level.lattice.dims, level.digest);
        }),
        Err(e) => {
            eprintln!("{e}");
            std::process::exit(1);
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap_or_default();
    println!("{seconds:.2} s, {:.0} MB/s, {peak}", bytes as f64 / 1e6 / seconds);
}
