//! Opens a volume, takes its digest and cuts it into bricks; prints the time of each step.
//!
//! `cargo run --release -p slabcast-volumes --example load -- FILE [PRESET]`

use slabcast_common::quality::Quality;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::presets;
use slabcast_volumes::{BrickStore, histogram_sketch, open};
use std::path::Path;
use std::time::Instant;

fn main() {
    let mut args = std::env::args().skip(1);
    let (Some(file), preset) = (args.next(), args.next()) else {
        eprintln!("usage: load FILE [PRESET]");
        std::process::exit(2);
    };
    let preset = preset.unwrap_or_else(|| "peer-opaque".into());
    let ms = |from: Instant| from.elapsed().as_secs_f64() * 1e3;
    let start = Instant::now();
    let volume = match open(Path::new(&file)) {
        Ok(volume) => volume,
        Err(e) => {
            eprintln!("{e}");
            std::process::exit(1);
        }
    };
    let opened = ms(start);
    let start = Instant::now();
    let digest = volume.digest();
    let digested = ms(start);
    let tf = match presets::by_name(&preset, &volume.summary) {
        Ok(tf) => tf,
        Err(e) => {
            eprintln!("{e}");
            std::process::exit(1);
        }
    };
    let needs = BrickNeeds::for_transfer(&tf, &volume.info(digest), &Quality::default());
    let start = Instant::now();
    let store = BrickStore::build(&volume, digest, &needs);
    let built = ms(start);
    let start = Instant::now();
    for info in store.infos().iter() {
        store.encoded(info.id);
    }
    let encoded = ms(start);
    println!(
        "{} {:?} {} anatomical {} spacing {:?}",
        volume.name,
        volume.lattice.dims,
        volume.file_type,
        volume.anatomical,
        volume.lattice.spacing()
    );
    println!("{}", histogram_sketch(&volume.summary, 64));
    println!("digest {digest}");
    println!(
        "{} bricks, {} voxels ({:.1} %), {} bytes encoded",
        store.infos().len(),
        store.relevant_voxels(),
        100.0 * store.relevant_voxels() as f64 / volume.lattice.len() as f64,
        store.bytes()
    );
    println!(
        "open {opened:.1} ms, digest {digested:.1} ms, build {built:.1} ms, encode {encoded:.1} ms"
    );
}
