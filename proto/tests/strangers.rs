//! What strangers send: refused with the field's name, never a panic, and what is let in can be
//! worked with.

mod any;

use proptest::prelude::*;
use prost::Message;
use slabcast_common::brick::{BrickGrid, TightBox};
use slabcast_common::message::ToWorker;
use slabcast_common::wanted::Wanted;
use slabcast_proto::convert::{self, Bricks, Down};
use slabcast_proto::{FILE_DESCRIPTOR_SET, v1};

/// Through every door, whatever the bytes are.
fn all_doors(bytes: &[u8]) {
    macro_rules! door {
        ($message:ty, $open:expr) => {
            if let Ok(message) = <$message>::decode(bytes) {
                let _ = $open(message);
            }
        };
    }
    door!(v1::FromWorker, convert::from_worker_from_wire);
    door!(v1::BricksUp, convert::bricks_open_from_wire);
    door!(v1::BricksDown, convert::bricks_from_wire);
    door!(v1::PathRequest, convert::path_request_from_wire);
    door!(v1::FrameChunk, convert::chunk_from_wire);
    door!(v1::JobNotice, convert::notice_from_wire);
    door!(v1::Job, convert::job_from_wire);
    door!(v1::VolumeDescription, convert::volume_from_wire);
    door!(v1::Worker, convert::worker_from_wire);
    door!(v1::Scene, convert::scene_from_wire);
    door!(v1::View, convert::view_from_wire);
    door!(v1::ToWorker, |m| convert::to_worker_from_wire(m).map(|(m, _)| work_with(m)));
}

/// What was let in must hold what later code relies on.
fn work_with(message: ToWorker) {
    match message {
        ToWorker::Scene(scene) => {
            let volume = &scene.volume;
            let _ =
                Wanted::of(&scene.transfer, volume, scene.quality.compositing).key(volume.digest);
            let _ = (volume.summary.total(), volume.summary.range(), volume.summary.bin(0.0));
            assert!(BrickGrid::of(volume.lattice.dims).len() <= 1 << 27);
        }
        ToWorker::Frame { view, .. } => {
            let lattice = slabcast_common::volume::Lattice::from_spacing([100, 90, 80], [1.0; 3]);
            if convert::check_view(&lattice, &view).is_ok() {
                let _ = view.project(&TightBox { lo: [0; 3], hi: [7; 3] });
                let _ = view.project(&TightBox { lo: [96, 80, 72], hi: [99, 89, 79] });
                let _ = view.scale_at(0);
            }
        }
        ToWorker::Directory { grid, first, total, bricks, .. } => {
            assert!(first as usize + bricks.len() <= total as usize);
            for b in bricks.iter() {
                let corner = grid.corner(b.id);
                let inside = |p: [u32; 3]| (0..3).all(|a| p[a] / 8 == corner[a] / 8);
                assert!(inside(b.tight.lo) && inside(b.tight.hi) && b.voxels <= 512, "{b:?}");
            }
        }
        _ => {}
    }
}

/// Flips, cuts, repeats: what a bug or a bad link makes of a message.
fn spoil(mut bytes: Vec<u8>, how: &[(prop::sample::Index, u8, u8)]) -> Vec<u8> {
    for (at, what, by) in how {
        if bytes.is_empty() {
            break;
        }
        let at = at.index(bytes.len());
        match what % 5 {
            0 | 1 => bytes[at] ^= by,
            2 => bytes.truncate(at),
            3 => bytes.insert(at, *by),
            _ => drop(bytes.remove(at)),
        }
    }
    bytes
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn any_bytes_go_through_every_door(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        all_doors(&bytes);
    }

    #[test]
    fn spoiled_messages_go_through_every_door(
        from_worker in any::to_master(), to_worker in any::to_worker(),
        request in any::path_request(), volume in any::volume(),
        how in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<u8>()), 1..6),
    ) {
        all_doors(&spoil(convert::from_worker_to_wire(&from_worker).encode_to_vec(), &how));
        let bytes = match convert::to_worker_to_wire(&to_worker, 5) {
            Down::Control(m) => m.encode_to_vec(),
            Down::Parts(m) => m[0].encode_to_vec(),
            Down::Bricks(m) => m[0].encode_to_vec(),
        };
        all_doors(&spoil(bytes, &how));
        all_doors(&spoil(convert::path_request_to_wire(&request).encode_to_vec(), &how));
        all_doors(&spoil(convert::volume_to_wire(&volume).encode_to_vec(), &how));
    }

    #[test]
    fn a_scene_can_be_worked_with(message in any::to_worker()) {
        work_with(message);
    }
}

fn lease() -> v1::Lease {
    v1::Lease { width: 16, height: 16, end_sheet: 1, ..v1::Lease::default() }
}

fn refused_lease(lease: v1::Lease) -> String {
    let message = v1::ToWorker { message: Some(v1::to_worker::Message::Lease(lease)) };
    convert::to_worker_from_wire(message).unwrap_err().field().to_owned()
}

#[test]
fn leases_are_refused_by_field_before_memory_is_set_aside() {
    let huge = v1::Lease { width: 8192, height: 8192, ..lease() };
    assert_eq!(refused_lease(huge), "lease.width, height");
    assert_eq!(refused_lease(v1::Lease { x: u32::MAX, ..lease() }), "lease.x");
    assert_eq!(refused_lease(v1::Lease { y: 8180, ..lease() }), "lease.height");
    assert_eq!(refused_lease(v1::Lease { width: 0, ..lease() }), "lease.width");
    assert_eq!(refused_lease(v1::Lease { first_sheet: 1, ..lease() }), "lease.end_sheet");
    let bricks = |differences| Some(v1::BrickIds { differences });
    assert_eq!(refused_lease(v1::Lease { bricks: bricks(vec![-1]), ..lease() }), "lease.bricks");
    assert_eq!(refused_lease(v1::Lease { bricks: bricks(vec![9, 0]), ..lease() }), "lease.bricks");
    let plane =
        |bytes: usize| Some(v1::Plane { values: vec![1; bytes].into(), ..v1::Plane::default() });
    assert_eq!(refused_lease(v1::Lease { a: plane(1000), ..lease() }), "lease.a.values");
    assert_eq!(refused_lease(v1::Lease { last: plane(4), ..lease() }), "lease.last.values");
}

#[test]
fn directories_are_refused_by_field() {
    let good = v1::Directory {
        set: vec![0; 32].into(),
        grid: vec![2, 3, 4],
        first: 1,
        total: 3,
        bricks: Some(v1::BrickIds { differences: vec![3, 20] }),
        boxes: vec![0; 8].into(),
        sizes: vec![15, 3595],
    };
    let open = |directory: v1::Directory| {
        let message = Some(v1::to_worker::Message::Directory(directory));
        convert::to_worker_from_wire(v1::ToWorker { message })
    };
    assert!(open(good.clone()).is_ok());
    let field = |directory| open(directory).unwrap_err().field().to_owned();
    let ids = |differences| Some(v1::BrickIds { differences });
    let word = |word: u32| [word.to_le_bytes(), [0; 4]].concat();
    assert_eq!(field(v1::Directory { grid: vec![2, 3], ..good.clone() }), "directory.grid");
    assert_eq!(field(v1::Directory { grid: vec![1 << 30; 3], ..good.clone() }), "directory.grid");
    assert_eq!(field(v1::Directory { grid: vec![2, 3, 0], ..good.clone() }), "directory.grid");
    assert_eq!(field(v1::Directory { total: u32::MAX, ..good.clone() }), "directory.total");
    assert_eq!(field(v1::Directory { first: 2, ..good.clone() }), "directory.first");
    assert_eq!(field(v1::Directory { first: u32::MAX, ..good.clone() }), "directory.first");
    assert_eq!(
        field(v1::Directory { bricks: ids(vec![3, 0]), ..good.clone() }),
        "directory.bricks"
    );
    assert_eq!(
        field(v1::Directory { bricks: ids(vec![3, 21]), ..good.clone() }),
        "directory.bricks"
    );
    assert_eq!(field(v1::Directory { bricks: ids(vec![3]), ..good.clone() }), "directory.boxes");
    // The smallest index behind the largest; 1024 voxels.
    let boxed = |word: Vec<u8>| v1::Directory { boxes: word.into(), ..good.clone() };
    assert_eq!(field(boxed(word(1))), "directory.boxes");
    assert_eq!(field(boxed(word(1023 << 18))), "directory.boxes");
    assert_eq!(field(v1::Directory { sizes: vec![15, 0], ..good.clone() }), "directory.sizes");
    assert_eq!(field(v1::Directory { sizes: vec![15, 3596], ..good.clone() }), "directory.sizes");
    assert_eq!(field(v1::Directory { sizes: vec![15], ..good }), "directory.sizes");
}

#[test]
fn matrices_that_are_not_finite_are_refused_by_field() {
    let good = v1::View {
        width: 9,
        height: 9,
        eye_from_index: vec![1.0; 9],
        eye_origin: vec![0.0; 3],
        eye_from_world: vec![1.0; 9],
        projection: Some(v1::view::Projection::Ortho(v1::Ortho { scale: 1.0 })),
        thickness: 1.0,
        kernel_std: vec![1.0; 3],
        kernel_radius: vec![1.0; 3],
        cell: 1.0,
        kernel_lean: vec![0.0; 3],
    };
    assert!(convert::view_from_wire(good.clone()).is_ok());
    let field = |v: v1::View| convert::view_from_wire(v).unwrap_err().field().to_owned();
    let nan = |n| {
        let mut numbers = vec![1.0; n];
        numbers[n - 1] = f64::NAN;
        numbers
    };
    assert_eq!(field(v1::View { eye_from_index: nan(9), ..good.clone() }), "eye_from_index");
    assert_eq!(field(v1::View { eye_from_world: vec![1.0; 8], ..good.clone() }), "eye_from_world");
    assert_eq!(field(v1::View { eye_origin: nan(3), ..good.clone() }), "eye_origin");
    assert_eq!(field(v1::View { kernel_std: vec![0.0; 3], ..good.clone() }), "kernel_std");
    assert_eq!(field(v1::View { kernel_lean: vec![0.0; 2], ..good.clone() }), "kernel_lean");
    assert_eq!(field(v1::View { kernel_lean: nan(3), ..good.clone() }), "kernel_lean");
    assert_eq!(field(v1::View { thickness: -1.0, ..good.clone() }), "thickness");
    assert_eq!(field(v1::View { width: 8193, ..good.clone() }), "width");
    assert_eq!(field(v1::View { projection: None, ..good.clone() }), "projection");
    let far = v1::View { eye_origin: vec![0.0, 0.0, 1e12], ..good };
    let far = convert::view_from_wire(far).unwrap();
    let lattice = slabcast_common::volume::Lattice::from_spacing([9; 3], [1.0; 3]);
    assert_eq!(convert::check_view(&lattice, &far).unwrap_err().field(), "frame.view.eye_origin");
}

#[test]
fn a_path_names_the_field_as_the_proto_writes_it() {
    let good = || v1::PathRequest {
        client_key: "k".into(),
        path: Some(v1::ViewPath {
            width: 64,
            height: 64,
            turntable: Some(v1::Turntable::default()),
            ..v1::ViewPath::default()
        }),
        ..v1::PathRequest::default()
    };
    let request = convert::path_request_from_wire(good()).expect("all else has defaults");
    assert_eq!(request.path.turntable, Some(Default::default()));
    assert_eq!(request.quality, Default::default());
    assert_eq!(request.work, Default::default());
    let field = |spoil: &dyn Fn(&mut v1::PathRequest)| {
        let mut request = good();
        spoil(&mut request);
        convert::path_request_from_wire(request).unwrap_err().to_string()
    };
    let starts = |text: String, with: &str| assert!(text.starts_with(with), "{text}");
    starts(field(&|r| r.client_key.clear()), "client_key: missing");
    starts(field(&|r| r.client_key = "a\nb".into()), "client_key: has control");
    starts(field(&|r| r.path = None), "path: missing");
    starts(field(&|r| r.path.as_mut().unwrap().width = 0), "path.width: 0 pixels");
    starts(field(&|r| r.path.as_mut().unwrap().turntable = None), "path.views: no view");
    starts(field(&|r| r.format = 99), "format: 99 has no meaning");
    starts(
        field(&|r| r.quality = Some(v1::Quality { eps: Some(f64::NAN), ..Default::default() })),
        "quality.eps: NaN is out of range",
    );
    starts(
        field(&|r| r.transfer = Some(v1::path_request::Transfer::TransferJson("{".into()))),
        "transfer_json: not valid",
    );
    starts(
        field(&|r| {
            let path = r.path.as_mut().unwrap();
            path.turntable = None;
            let view = v1::PathView {
                eye: vec![0.0, f64::INFINITY, 0.0],
                target: vec![0.0; 3],
                up: vec![0.0; 3],
                ..v1::PathView::default()
            };
            path.views = vec![view];
        }),
        "path.views[0].eye: has a number that is not finite",
    );
    let status = tonic::Status::from(
        convert::path_request_from_wire(v1::PathRequest::default()).unwrap_err(),
    );
    assert_eq!(status.code(), tonic::Code::InvalidArgument);
}

#[test]
fn bricks_beyond_the_largest_grid_are_refused() {
    let list = v1::BrickIds { differences: vec![1 << 27] };
    let drop = v1::DropBricks { set: vec![0; 32].into(), bricks: Some(list) };
    let message = v1::BricksDown { message: Some(v1::bricks_down::Message::Drop(drop)) };
    assert_eq!(convert::bricks_from_wire(message).unwrap_err().field(), "drop.bricks");
    let empty = v1::DropBricks { set: vec![0; 32].into(), bricks: None };
    let message = v1::BricksDown { message: Some(v1::bricks_down::Message::Drop(empty)) };
    assert!(matches!(convert::bricks_from_wire(message), Ok(Bricks::Message(_))));
}

/// The promise of `cluster.proto`: whatever becomes of the other messages, a master of any
/// version can read who calls. If this fails, the change must be taken back.
#[test]
fn the_bytes_of_a_hello_never_change() {
    let bytes = v1::FromWorker {
        message: Some(v1::from_worker::Message::Hello(v1::Hello {
            protocol_version: 1,
            pixels_version: 2,
            name: "n".into(),
            threads: 3,
            memory_budget_bytes: 4,
            simd: "s".into(),
            self_test_sha256: "h".into(),
            held: vec![v1::HeldBricks {
                set: vec![9].into(),
                bricks: Some(v1::BrickIds { differences: vec![5, 1, -1] }),
            }],
            rehearses: false,
            machine: "m".into(),
        })),
    }
    .encode_to_vec();
    let golden = [
        0x0a, 32, // FromWorker.hello = 1, 32 bytes
        0x08, 1, // protocol_version = 1, varint
        0x10, 2, // pixels_version = 2, varint
        0x1a, 1, b'n', // name = 3
        0x20, 3, // threads = 4, varint
        0x28, 4, // memory_budget_bytes = 5, varint
        0x32, 1, b's', // simd = 6
        0x3a, 1, b'h', // self_test_sha256 = 7
        0x42, 10, // held = 8
        0x0a, 1, 9, // HeldBricks.set = 1
        0x12, 5, // HeldBricks.bricks = 2
        0x0a, 3, 10, 2, 1, // BrickIds.differences = 1, packed, zigzag
        0x52, 1, b'm', // machine = 10
    ];
    assert_eq!(bytes, golden);
}

#[test]
fn reflection_has_both_services_with_their_comments() {
    let has = |text: &str| FILE_DESCRIPTOR_SET.windows(text.len()).any(|w| w == text.as_bytes());
    for text in ["slabcast.v1", "WatchFrames", "Cluster", "MUST set client_key"] {
        assert!(has(text), "{text}");
    }
}
