//! Every message comes back from the wire as it was, to the last bit.

mod any;

use bytes::Bytes;
use proptest::prelude::*;
use prost::Message;
use slabcast_common::brick::Brick;
use slabcast_common::ids::BrickId;
use slabcast_common::image::{PixelFormat, RawSums};
use slabcast_common::message::{Pixels, ToMaster, ToWorker};
use slabcast_common::quality::{Quality, Schedule};
use slabcast_common::stats::{FrameStats, SlabStats, TileStats};
use slabcast_common::volume::Samples;
use slabcast_proto::convert::{self, BrickBatches, Bricks, Down, StatisticsParts};
use slabcast_proto::model::WatchMessage;
use slabcast_proto::{MAX_BRICKS_MESSAGE, MAX_CONTROL_MESSAGE, MAX_FRAME_CHUNK, cluster_v1};

/// Over the wire: encoded, decoded.
fn wire<M: Message + Default>(message: M) -> M {
    M::decode(&message.encode_to_vec()[..]).expect("what was encoded can be decoded")
}

/// `==` takes -0.0 for 0.0; this does not. (It does take every NaN for NaN: planes are compared
/// by [`bits`].)
fn shown(value: &impl std::fmt::Debug) -> String {
    format!("{value:?}")
}

fn bits(a: &[f32]) -> Vec<u32> {
    a.iter().map(|a| a.to_bits()).collect()
}

fn same_planes(
    (a, last): (&[f32], &Option<Vec<RawSums>>),
    (b, there): (&[f32], &Option<Vec<RawSums>>),
) -> Result<(), TestCaseError> {
    prop_assert_eq!(bits(a), bits(b));
    prop_assert_eq!(last, there);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(192))]

    #[test]
    fn worker_messages_arrive_unchanged(message in any::to_master()) {
        let back = convert::from_worker_from_wire(wire(convert::from_worker_to_wire(&message)));
        let mut back = back.map_err(|e| TestCaseError::fail(e.to_string()))?;
        if let ToMaster::Result(b) = &mut back {
            let bytes = convert::from_worker_to_wire(&message).encoded_len() as u32;
            prop_assert_eq!(b.bytes.take(), Some(bytes));
        }
        prop_assert_eq!(shown(&back), shown(&message));
        if let (ToMaster::Result(b), ToMaster::Result(m)) = (&back, &message)
            && let (Pixels::Sums(b), Pixels::Sums(m)) = (&b.pixels, &m.pixels)
        {
            same_planes((&b.a, &b.last), (&m.a, &m.last))?;
        }
    }

    #[test]
    fn master_messages_arrive_unchanged(message in any::to_worker(), session in 1u64..) {
        let is_welcome = matches!(message, ToWorker::Welcome { .. });
        let back = match convert::to_worker_to_wire(&message, session) {
            Down::Control(m) => {
                let (back, got) = convert::to_worker_from_wire(wire(m))
                    .map_err(|e| TestCaseError::fail(e.to_string()))?;
                prop_assert_eq!(got, is_welcome.then_some(session));
                back
            }
            Down::Parts(m) => {
                prop_assert_eq!(m.len(), 1);
                let (back, got) = convert::to_worker_from_wire(wire(m[0].clone()))
                    .map_err(|e| TestCaseError::fail(e.to_string()))?;
                prop_assert_eq!(got, None);
                back
            }
            Down::Bricks(m) => {
                prop_assert_eq!(m.len(), 1);
                let m = wire(m[0].clone());
                match convert::bricks_from_wire(m).map_err(|e| TestCaseError::fail(e.to_string()))? {
                    Bricks::Message(back) => back,
                    Bricks::Batch(_) => return Err(TestCaseError::fail("a batch")),
                }
            }
        };
        prop_assert_eq!(shown(&back), shown(&message));
        if let (ToWorker::Lease(b), ToWorker::Lease(m)) = (&back, &message) {
            same_planes((&b.state.a, &b.state.last), (&m.state.a, &m.state.last))?;
        }
    }

    #[test]
    fn submit_requests_arrive_unchanged(request in any::path_request()) {
        let back = convert::submit_from_wire(wire(convert::submit_to_wire(&request)));
        prop_assert_eq!(shown(&back.map_err(|e| TestCaseError::fail(e.to_string()))?), shown(&request));
    }

    #[test]
    fn jobs_notices_volumes_and_workers_arrive_unchanged(
        job in any::job(), notice in any::notice(), volume in any::volume(), worker in any::worker(),
    ) {
        prop_assert_eq!(convert::job_from_wire(wire(convert::job_to_wire(&job))), Ok(job));
        let chunk = convert::watch_from_wire(wire(convert::notice_to_wire(&notice)));
        prop_assert_eq!(chunk, Ok(WatchMessage::Notice(notice)));
        prop_assert_eq!(convert::worker_from_wire(wire(convert::worker_to_wire(&worker))), Ok(worker));
        let back = convert::volume_from_wire(wire(convert::volume_to_wire(&volume)));
        prop_assert_eq!(shown(&back), shown(&Ok::<_, ()>(volume)));
    }

    #[test]
    fn uploads_and_lists_of_volumes_arrive_unchanged(
        upload in any::upload(), list in any::volume_list(),
    ) {
        let back = convert::upload_from_wire(wire(convert::upload_to_wire(&upload)));
        prop_assert_eq!(shown(&back), shown(&Ok::<_, ()>(upload)));
        let sent = convert::volume_list_to_wire(&list, "after-3".into());
        let back = convert::volume_list_from_wire(wire(sent));
        prop_assert_eq!(back, Ok((list, "after-3".to_owned())));
    }

    /// Statistics cross as messages, and the JSON on the other side is the same to the byte.
    #[test]
    fn statistics_arrive_unchanged(stats in any::stats(), pixels in 1usize..99) {
        let bytes = Bytes::from(vec![1; pixels]);
        let size = [pixels as u32, 1];
        let mut parts = StatisticsParts::default();
        for chunk in convert::frame_to_wire(7, size, PixelFormat::Rgb8, &bytes, &stats, "") {
            let Ok(WatchMessage::Chunk(chunk)) = convert::watch_from_wire(wire(chunk)) else {
                return Err(TestCaseError::fail("refused"));
            };
            if let Some(part) = chunk.statistics {
                parts.add(part).map_err(|e| TestCaseError::fail(e.to_string()))?;
            }
        }
        let back = parts.finish().map_err(|e| TestCaseError::fail(e.to_string()))?;
        prop_assert_eq!(shown(&back), shown(&stats));
        let [there, here] = [&back, &stats].map(|s| serde_json::to_string(s).unwrap());
        prop_assert_eq!(there, here);
    }

    #[test]
    fn brick_batches_arrive_unchanged(set in any::key(), bricks in prop::collection::vec(any::brick(), 1..90)) {
        let encoded = bricks.iter().map(|b| {
            let mut bytes = Vec::new();
            b.encode(&mut bytes);
            Bytes::from(bytes)
        });
        let mut back: Vec<Brick> = Vec::new();
        for message in BrickBatches::new(&set, encoded) {
            prop_assert!(message.encoded_len() <= MAX_BRICKS_MESSAGE);
            let Ok(Bricks::Batch(batch)) = convert::bricks_from_wire(wire(message)) else {
                return Err(TestCaseError::fail("refused"));
            };
            prop_assert!(batch.set == set && batch.broken.is_empty());
            back.extend(batch.bricks.iter().map(|b| (**b).clone()));
        }
        prop_assert_eq!(back, bricks);
    }
}

#[test]
fn broken_brick_is_named_and_the_others_are_taken() {
    let encode = |id| {
        let mut bytes = Vec::new();
        let values = Samples::U8(vec![8, 9]);
        let brick = Brick::new(BrickId(id), vec![3, 4], values, None);
        brick.encode(&mut bytes);
        bytes
    };
    let (good, mut flipped, mut short) = (encode(1), encode(2), encode(3));
    flipped[8] ^= 1;
    short.truncate(9);
    let batch = [good, flipped, short].map(Bytes::from);
    let message = BrickBatches::new(&Default::default(), batch).next().unwrap();
    let Ok(Bricks::Batch(batch)) = convert::bricks_from_wire(message) else { panic!("refused") };
    assert_eq!(batch.bricks.iter().map(|b| b.id).collect::<Vec<_>>(), [BrickId(1)]);
    assert_eq!(batch.broken, [BrickId(2), BrickId(3)]);
    let nameless = BrickBatches::new(&Default::default(), [Bytes::from_static(b"ab")]);
    let e = convert::bricks_from_wire(nameless.last().unwrap()).unwrap_err();
    assert_eq!(e.field(), "batch.bricks[0]");
}

#[test]
fn brick_batches_fit_one_http2_frame_each() {
    let brick = Bytes::from(vec![5; 3595]);
    let batches: Vec<_> =
        BrickBatches::new(&Default::default(), vec![brick.clone(); 100]).collect();
    assert!(batches.iter().all(|b| b.encoded_len() <= MAX_BRICKS_MESSAGE));
    assert_eq!(batches.len(), 6, "18 bricks of 3598 bytes fit into 65,000");
    let Some(cluster_v1::bricks_response::Message::Batch(first)) = &batches[0].message else {
        panic!()
    };
    assert_eq!(first.bricks[0].as_ptr(), brick.as_ptr(), "passed on, not copied");
    assert!(BrickBatches::new(&Default::default(), []).next().is_none());

    let drop = ToWorker::DropBricks {
        set: Default::default(),
        bricks: (0..40_000u32).map(|i| BrickId(i.wrapping_mul(2_654_435_761) >> 5)).collect(),
    };
    let Down::Bricks(messages) = convert::to_worker_to_wire(&drop, 0) else { panic!() };
    assert!(messages.iter().all(|m| m.encoded_len() <= MAX_BRICKS_MESSAGE));
}

#[test]
fn largest_lease_and_result_fit_a_control_message() {
    use slabcast_common::ids::*;
    use slabcast_common::image::{TilePixels, TileState};
    use slabcast_common::message::{Lease, TileResult};
    let n = convert::MAX_TILE_PIXELS;
    let a: Vec<f32> = (0..n).map(|i| if i % 8 == 0 { 0.0 } else { i as f32 }).collect();
    let last: Vec<RawSums> =
        (0..n as u32).map(|i| if i % 9 == 0 { [0; 4] } else { [i; 4] }).collect();
    // A gap of 64 before each brick: two bytes each.
    let most = convert::MAX_BRICK_LIST as u32;
    let lease = Lease {
        task: TaskId(u64::MAX),
        epoch: Epoch(u32::MAX),
        frame: FrameId(u64::MAX),
        tile: slabcast_common::occlusion::Rect::new(7936, 7936, 8192, 8192),
        slab: slabcast_common::slab::SheetRange::new(i32::MIN, i32::MAX),
        bricks: (0..most).map(|i| BrickId(i * 64)).collect(),
        state: TileState { a: a.clone(), last: Some(last.clone()) },
    };
    let Down::Control(m) = convert::to_worker_to_wire(&ToWorker::Lease(Box::new(lease)), 0) else {
        panic!()
    };
    assert!(m.encoded_len() < MAX_CONTROL_MESSAGE, "{}", m.encoded_len());
    assert!(convert::to_worker_from_wire(wire(m)).is_ok());
    let colour = last.iter().map(|l| [l[0], l[1], l[2]]).collect();
    let result = TileResult {
        task: TaskId(1),
        epoch: Epoch(1),
        pixels: Pixels::Sums(TilePixels { a, colour, last: Some(last) }),
        bytes: None,
        counters: Default::default(),
        times: Default::default(),
        region: None,
    };
    let m = convert::from_worker_to_wire(&ToMaster::Result(Box::new(result)));
    assert!(m.encoded_len() < 2_100_000, "{}", m.encoded_len());
    assert!(convert::from_worker_from_wire(wire(m)).is_ok());
}

#[test]
fn large_directory_is_sent_in_parts_without_gaps() {
    use slabcast_common::brick::{BrickGrid, BrickInfo, BrickSetKey, TightBox};
    let grid = BrickGrid { dims: [40, 40, 40] };
    let info = |id: u32| {
        let lo = grid.corner(BrickId(id));
        BrickInfo { id: BrickId(id), tight: TightBox { lo, hi: lo }, voxels: 1, bytes: 15 }
    };
    let all: Vec<BrickInfo> = (0..20_000).map(|i| info(3 * i)).collect();
    let set = BrickSetKey::default();
    let message =
        ToWorker::Directory { set, grid, first: 0, total: 20_000, bricks: all.clone().into() };
    let Down::Parts(parts) = convert::to_worker_to_wire(&message, 0) else { panic!() };
    let mut back = Vec::new();
    for part in parts {
        assert!(part.encoded_len() < 120_000, "{}", part.encoded_len());
        let (part, _) = convert::to_worker_from_wire(wire(part)).expect("it is good");
        let ToWorker::Directory { first, total, bricks, .. } = part else { panic!() };
        assert_eq!((first as usize, total), (back.len(), 20_000));
        back.extend_from_slice(&bricks);
    }
    assert_eq!(back, all);
}

#[test]
fn frame_of_any_length_is_cut_into_chunks_and_put_together() {
    let put_together = |pixels: usize, tiles: usize, trace: &str| {
        let size = [pixels as u32 / 4096 + 1, 1024];
        let bytes = Bytes::from((0..pixels).map(|i| (i % 251) as u8).collect::<Vec<_>>());
        let stats = stats_with(tiles);
        let chunks = convert::frame_to_wire(7, size, PixelFormat::Rgba8, &bytes, &stats, trace);
        let (mut data, mut parts, mut t) = (Vec::new(), StatisticsParts::default(), String::new());
        for (i, chunk) in chunks.iter().enumerate() {
            assert!(chunk.encoded_len() <= MAX_FRAME_CHUNK, "{}", chunk.encoded_len());
            let Ok(WatchMessage::Chunk(p)) = convert::watch_from_wire(wire(chunk.clone())) else {
                panic!("refused")
            };
            assert_eq!((p.frame, p.size, p.offset), (7, size, data.len() as u64));
            assert_eq!(p.last, i + 1 == chunks.len());
            data.extend_from_slice(&p.data);
            p.statistics.map_or(Ok(()), |part| parts.add(part)).unwrap();
            t += &p.trace_json;
        }
        assert!(data == bytes && t == trace);
        let back = parts.finish().unwrap();
        assert_eq!(serde_json::to_string(&back).unwrap(), serde_json::to_string(&stats).unwrap());
        chunks.len()
    };
    assert_eq!(put_together(3, 1, ""), 1);
    assert_eq!(put_together(MAX_FRAME_CHUNK - 256 - 2000, 1, ""), 1);
    assert_eq!(put_together(MAX_FRAME_CHUNK - 256, 1, "[]"), 2);
    assert_eq!(put_together(MAX_FRAME_CHUNK - 255, 1, "[]"), 2);
    let long = "\u{20ac}\"a".repeat(600_000);
    assert_eq!(put_together(5, 100_000, &long), 24);
}

/// Statistics of a frame with one slab of so many tiles.
fn stats_with(tiles: usize) -> FrameStats {
    let tile = |i| TileStats { x: i, y: i / 2, size: 16, est: 7, ms: 0.1, worker: "node:1".into() };
    let slab = SlabStats { tiles: (0..tiles as u32).map(tile).collect(), ..Default::default() };
    FrameStats {
        v: 1,
        frame: 7,
        schedule: Schedule::Region,
        view_sha256: "0".repeat(64),
        pixels_sha256: "1".repeat(64),
        pixels_version: 10,
        ms: Default::default(),
        workers: vec![],
        voxels: Default::default(),
        bricks: Default::default(),
        result_bytes: None,
        slabs: vec![slab],
        quality: Quality::before(),
        left_out: vec![],
        error: Default::default(),
        retries: 0,
        handed_over: 0,
        dropped_results: 0,
        poisoned: vec![],
        critical_path: None,
        rehearsed: false,
        level: None,
    }
}

#[test]
fn checksum_finds_every_flipped_bit_of_a_brick() {
    let mut state = 0x9e37_79b9_7f4a_7c15u64;
    let mut next = move |below: usize| {
        state =
            state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) % below as u64) as usize
    };
    let bricks: Vec<Brick> = (0..9u32)
        .map(|i| {
            let n = [1, 17, 512][i as usize % 3];
            let voxels = (0..n as u16).collect();
            let values = Samples::U8((0..n).map(|_| next(256) as u8).collect());
            let normals = (i % 2 == 0).then(|| (0..n).map(|_| next(1 << 16) as u16).collect());
            Brick::new(BrickId(700 + i), voxels, values, normals)
        })
        .collect();
    let encoded: Vec<Bytes> = bricks
        .iter()
        .map(|b| {
            let mut bytes = Vec::new();
            b.encode(&mut bytes);
            bytes.into()
        })
        .collect();
    for flip in 0..100_000 {
        let which = next(bricks.len());
        let mut spoilt = encoded[which].to_vec();
        let at = next(spoilt.len() * 8);
        spoilt[at / 8] ^= 1 << (at % 8);
        let mut batch = encoded.clone();
        batch[which] = spoilt.into();
        let message = BrickBatches::new(&Default::default(), batch).next().unwrap();
        let Ok(Bricks::Batch(batch)) = convert::bricks_from_wire(message) else {
            panic!("flip {flip}: all bricks were refused for one")
        };
        assert!(batch.bricks.iter().all(|b| b.id != bricks[which].id), "flip {flip} was not seen");
        assert_eq!(batch.bricks.len(), bricks.len() - 1, "flip {flip}: the others are taken");
        assert_eq!(batch.broken, [bricks[which].id], "flip {flip}");
    }
}

#[test]
fn reasons_of_peers_lose_what_moves_a_cursor() {
    let reason = "no \u{1b}[2Jtile\r\nWARN forged\u{7f}".to_string();
    let wire = convert::from_worker_to_wire(&ToMaster::Goodbye { reason });
    let Ok(ToMaster::Goodbye { reason }) = convert::from_worker_from_wire(wire) else {
        panic!("it is a goodbye")
    };
    assert_eq!(reason, "no  [2Jtile  WARN forged ");
}
