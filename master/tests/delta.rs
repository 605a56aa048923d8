//! Time that the master takes to encode a large delta of bricks.

use slabcast_common::quality::Quality;
use slabcast_common::volume::Volume;
use slabcast_proto::convert::BrickBatches;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::presets;
use slabcast_volumes::BrickStore;
use std::time::Instant;

/// Encodes a delta of 10,000 bricks for 16 workers, as [`slabcast_master`]'s brick streams do. A
/// measurement, not a test:
/// `cargo test --release -p slabcast-master --test delta -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement, by hand"]
fn encoding_ten_thousand_bricks_for_sixteen_workers() {
    let edge = 184;
    let volume = Volume::from_fn_u8("noise", [edge; 3], |i, j, k| {
        (i.wrapping_mul(73) ^ j.wrapping_mul(151) ^ k.wrapping_mul(29)) as u8 | 1
    });
    let transfer = presets::by_name("peer-opaque", &volume.summary).expect("a preset");
    let info = volume.info(volume.digest());
    let wanted = BrickNeeds::for_transfer(&transfer, &info, &Quality::before());
    let store = BrickStore::build(&volume, info.digest, &wanted);
    let ids: Vec<_> = store.infos().iter().map(|b| b.id).take(10_000).collect();
    assert_eq!(ids.len(), 10_000);
    for round in 0..3 {
        let began = Instant::now();
        let mut bytes = 0;
        let mut queues = Vec::new();
        for _ in 0..16 {
            let encoded = ids.iter().filter_map(|id| store.encoded(*id));
            queues.push(BrickBatches::new(&store.key(), encoded).collect::<Vec<_>>());
        }
        let ms = began.elapsed().as_secs_f64() * 1e3;
        for message in queues.iter().flatten() {
            bytes += prost::Message::encoded_len(message);
        }
        println!(
            "round {round}: {ms:.1} ms for {} messages, {:.1} MiB",
            queues.iter().map(Vec::len).sum::<usize>(),
            bytes as f64 / f64::from(1 << 20)
        );
    }
}
