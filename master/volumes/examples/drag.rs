//! Drags a threshold down by one pixel of an editor, 20 times; prints how long the new bricks of each
//! step take. A pixel is 1/256 of the range.
//!
//! `cargo run --release -p slabcast-volumes --example drag -- FILE [FROM_PERCENT] [PIXELS]`

use slabcast_common::quality::Quality;
use slabcast_common::transfer::Domain;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::presets;
use slabcast_volumes::blocks::{BlockSource, MemorySource};
use slabcast_volumes::{BrickStore, open};
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

/// Steps of one drag.
const STEPS: usize = 20;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let Some(file) = args.next() else {
        eprintln!("usage: drag FILE [FROM_PERCENT] [PIXELS]");
        std::process::exit(2);
    };
    let from: f64 = args.next().map_or(Ok(40.0), |text| text.parse())?;
    let pixels: f64 = args.next().map_or(Ok(1.0), |text| text.parse())?;
    let volume = Arc::new(open(Path::new(&file))?);
    let digest = volume.digest();
    let source: Arc<dyn BlockSource> = Arc::new(MemorySource::new(volume.clone(), digest));
    let info = volume.info(digest);
    let mut tf = presets::by_name("peer-opaque", &info.summary)?;
    tf.domain = Domain::Unit;
    let mut times = Vec::new();
    let mut before: Option<BrickStore> = None;
    for step in 0..=STEPS {
        let cut = from / 100.0 - step as f64 * pixels / 256.0;
        tf.opacities = vec![[0.0, 0.0], [cut, 0.0], [cut, 0.5], [1.0, 0.5]];
        let start = Instant::now();
        let needs = BrickNeeds::for_transfer(&tf, &info, &Quality::default());
        let store = BrickStore::cut(&source, 0, &needs, before.as_ref(), u64::MAX)?;
        let ms = start.elapsed().as_secs_f64() * 1e3;
        let is_same = before.as_ref().is_some_and(|before| before.key() == store.key());
        println!("{:5.1} % {:9} voxels {ms:8.1} ms", cut * 100.0, store.relevant_voxels());
        times.push((ms, is_same));
        before = Some(store);
    }
    let (first, _) = times.remove(0);
    let median = |mut times: Vec<f64>| {
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied().unwrap_or(0.0)
    };
    let cuts: Vec<f64> = times.iter().filter(|(_, is_same)| !is_same).map(|(ms, _)| *ms).collect();
    let number = cuts.len();
    println!(
        "first {first:.1} ms; median of {STEPS} steps {:.1} ms; of the {number} with another set {:.1} ms",
        median(times.into_iter().map(|(ms, _)| ms).collect()),
        median(cuts)
    );
    Ok(())
}
