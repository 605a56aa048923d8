//! Messages of strangers: wrong ones are refused with the field's name and never panic, and those
//! that are let in can be worked with.

mod any;

use proptest::prelude::*;
use prost::Message;
use slabcast_common::brick::{BrickGrid, TightBox};
use slabcast_common::image::PixelFormat;
use slabcast_common::message::ToWorker;
use slabcast_proto::convert::{self, Bricks, Down, StatisticsParts};
use slabcast_proto::model::{FrameChunk, WatchMessage};
use slabcast_proto::{cluster_v1, render_v1};
use slabcast_scene::brick_needs::BrickNeeds;

/// Through every door, whatever the bytes are.
fn all_doors(bytes: &[u8]) {
    macro_rules! door {
        ($message:ty, $open:expr) => {
            if let Ok(message) = <$message>::decode(bytes) {
                let _ = $open(message);
            }
        };
    }
    door!(cluster_v1::ControlRequest, convert::from_worker_from_wire);
    door!(cluster_v1::BricksRequest, convert::bricks_open_from_wire);
    door!(cluster_v1::BricksResponse, convert::bricks_from_wire);
    door!(cluster_v1::Scene, convert::scene_from_wire);
    door!(cluster_v1::View, convert::view_from_wire);
    door!(cluster_v1::ControlResponse, |m| {
        convert::to_worker_from_wire(m).map(|(m, _)| work_with(m))
    });
    door!(render_v1::SubmitPathRequest, convert::submit_from_wire);
    door!(render_v1::WatchFramesResponse, |m| convert::watch_from_wire(m).map(take_apart));
    door!(render_v1::Job, convert::job_from_wire);
    door!(render_v1::DescribeVolumeResponse, convert::volume_from_wire);
    door!(render_v1::Worker, convert::worker_from_wire);
    door!(render_v1::ListVolumesResponse, convert::volume_list_from_wire);
    door!(render_v1::PutVolumeRequest, convert::upload_from_wire);
}

/// Statistics are read when the last of them is there.
fn take_apart(message: WatchMessage) {
    if let WatchMessage::Chunk(FrameChunk { statistics: Some(part), .. }) = message {
        let mut parts = StatisticsParts::default();
        if parts.add(part.clone()).and_then(|()| parts.add(part)).is_ok() {
            let _ = parts.finish();
        }
    }
}

/// Uses a message that was let in as later code does.
fn work_with(message: ToWorker) {
    match message {
        ToWorker::Scene(scene) => {
            let volume = &scene.volume;
            let _ = BrickNeeds::for_transfer(&scene.transfer, volume, &scene.quality)
                .set_key(volume.digest);
            let _ = (volume.summary.total(), volume.summary.range(), volume.summary.bin(0.0));
            assert!(BrickGrid::new(volume.lattice.dims).len() <= 1 << 27);
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
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..400)) {
        all_doors(&bytes);
    }

    #[test]
    fn damaged_messages_never_panic(
        from_worker in any::to_master(), to_worker in any::to_worker(),
        request in any::path_request(), volume in any::volume(), stats in any::stats(),
        how in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<u8>()), 1..6),
    ) {
        all_doors(&spoil(convert::from_worker_to_wire(&from_worker).encode_to_vec(), &how));
        let bytes = match convert::to_worker_to_wire(&to_worker, 5) {
            Down::Control(m) => m.encode_to_vec(),
            Down::Parts(m) => m[0].encode_to_vec(),
            Down::Bricks(m) => m[0].encode_to_vec(),
        };
        all_doors(&spoil(bytes, &how));
        all_doors(&spoil(convert::submit_to_wire(&request).encode_to_vec(), &how));
        all_doors(&spoil(convert::volume_to_wire(&volume).encode_to_vec(), &how));
        let pixels = vec![1; 3].into();
        let frame = convert::frame_to_wire(0, [1, 1], PixelFormat::Rgb8, &pixels, &stats, "");
        all_doors(&spoil(frame[0].encode_to_vec(), &how));
    }

    #[test]
    fn damaged_uploads_and_lists_never_panic(
        upload in any::upload(), list in any::volume_list(),
        how in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<u8>()), 1..6),
    ) {
        all_doors(&spoil(convert::upload_to_wire(&upload).encode_to_vec(), &how));
        let list = convert::volume_list_to_wire(&list, String::new());
        all_doors(&spoil(list.encode_to_vec(), &how));
    }

    #[test]
    fn good_messages_can_be_worked_with(message in any::to_worker()) {
        work_with(message);
    }
}

fn lease() -> cluster_v1::Lease {
    let tile = Some(cluster_v1::Rect { x: 0, y: 0, width: 16, height: 16 });
    cluster_v1::Lease { tile, end_sheet: 1, ..cluster_v1::Lease::default() }
}

fn refused_lease(lease: cluster_v1::Lease) -> String {
    let message = Some(cluster_v1::control_response::Message::Lease(lease));
    let refused = convert::to_worker_from_wire(cluster_v1::ControlResponse { message });
    refused.unwrap_err().field().to_owned()
}

#[test]
fn wrong_lease_is_refused_by_field_before_memory_is_set_aside() {
    use cluster_v1::{BrickIds, Lease, Plane, Rect};
    let tile = |x, y, width, height| Lease { tile: Some(Rect { x, y, width, height }), ..lease() };
    assert_eq!(refused_lease(Lease { tile: None, ..lease() }), "lease.tile");
    assert_eq!(refused_lease(tile(0, 0, 8192, 8192)), "lease.tile");
    assert_eq!(refused_lease(tile(u32::MAX, 0, 16, 16)), "lease.tile.x");
    assert_eq!(refused_lease(tile(0, 8180, 16, 16)), "lease.tile.height");
    assert_eq!(refused_lease(tile(0, 0, 0, 16)), "lease.tile.width");
    assert_eq!(refused_lease(Lease { first_sheet: 1, ..lease() }), "lease.end_sheet");
    let bricks = |differences| Some(BrickIds { differences });
    assert_eq!(refused_lease(Lease { bricks: bricks(vec![-1]), ..lease() }), "lease.bricks");
    assert_eq!(refused_lease(Lease { bricks: bricks(vec![9, 0]), ..lease() }), "lease.bricks");
    let plane = |bytes: usize| Some(Plane { values: vec![1; bytes].into(), ..Plane::default() });
    let opacity = Lease { opacity: plane(1000), ..lease() };
    assert_eq!(refused_lease(opacity), "lease.opacity.values");
    let last_sheet = Lease { last_sheet: plane(4), ..lease() };
    assert_eq!(refused_lease(last_sheet), "lease.last_sheet.values");
}

#[test]
fn wrong_directory_is_refused_by_field() {
    let good = cluster_v1::Directory {
        set: vec![0; 32].into(),
        grid: vec![2, 3, 4],
        first: 1,
        total: 3,
        bricks: Some(cluster_v1::BrickIds { differences: vec![3, 20] }),
        boxes: vec![0; 8].into(),
        sizes: vec![15, 3595],
    };
    let open = |directory: cluster_v1::Directory| {
        let message = Some(cluster_v1::control_response::Message::Directory(directory));
        convert::to_worker_from_wire(cluster_v1::ControlResponse { message })
    };
    assert!(open(good.clone()).is_ok());
    let field = |directory| open(directory).unwrap_err().field().to_owned();
    let ids = |differences| Some(cluster_v1::BrickIds { differences });
    let word = |word: u32| [word.to_le_bytes(), [0; 4]].concat();
    assert_eq!(field(cluster_v1::Directory { grid: vec![2, 3], ..good.clone() }), "directory.grid");
    assert_eq!(
        field(cluster_v1::Directory { grid: vec![1 << 30; 3], ..good.clone() }),
        "directory.grid"
    );
    assert_eq!(
        field(cluster_v1::Directory { grid: vec![2, 3, 0], ..good.clone() }),
        "directory.grid"
    );
    assert_eq!(field(cluster_v1::Directory { total: u32::MAX, ..good.clone() }), "directory.total");
    assert_eq!(field(cluster_v1::Directory { first: 2, ..good.clone() }), "directory.first");
    assert_eq!(field(cluster_v1::Directory { first: u32::MAX, ..good.clone() }), "directory.first");
    assert_eq!(
        field(cluster_v1::Directory { bricks: ids(vec![3, 0]), ..good.clone() }),
        "directory.bricks"
    );
    assert_eq!(
        field(cluster_v1::Directory { bricks: ids(vec![3, 21]), ..good.clone() }),
        "directory.bricks"
    );
    assert_eq!(
        field(cluster_v1::Directory { bricks: ids(vec![3]), ..good.clone() }),
        "directory.boxes"
    );
    // The smallest index behind the largest; 1024 voxels.
    let boxed = |word: Vec<u8>| cluster_v1::Directory { boxes: word.into(), ..good.clone() };
    assert_eq!(field(boxed(word(1))), "directory.boxes");
    assert_eq!(field(boxed(word(1023 << 18))), "directory.boxes");
    assert_eq!(
        field(cluster_v1::Directory { sizes: vec![15, 0], ..good.clone() }),
        "directory.sizes"
    );
    assert_eq!(
        field(cluster_v1::Directory { sizes: vec![15, 3596], ..good.clone() }),
        "directory.sizes"
    );
    assert_eq!(field(cluster_v1::Directory { sizes: vec![15], ..good }), "directory.sizes");
}

#[test]
fn view_with_wrong_numbers_is_refused_by_field() {
    let good = cluster_v1::View {
        width: 9,
        height: 9,
        eye_from_index: vec![1.0; 9],
        eye_origin: vec![0.0; 3],
        eye_from_world: vec![1.0; 9],
        projection: Some(cluster_v1::view::Projection::Ortho(cluster_v1::Ortho { scale: 1.0 })),
        thickness: 1.0,
        kernel_std: vec![1.0; 3],
        kernel_radius: vec![1.0; 3],
        cell: 1.0,
        kernel_lean: vec![0.0; 3],
    };
    assert!(convert::view_from_wire(good.clone()).is_ok());
    let field = |v: cluster_v1::View| convert::view_from_wire(v).unwrap_err().field().to_owned();
    let nan = |n| {
        let mut numbers = vec![1.0; n];
        numbers[n - 1] = f64::NAN;
        numbers
    };
    assert_eq!(
        field(cluster_v1::View { eye_from_index: nan(9), ..good.clone() }),
        "eye_from_index"
    );
    assert_eq!(
        field(cluster_v1::View { eye_from_world: vec![1.0; 8], ..good.clone() }),
        "eye_from_world"
    );
    assert_eq!(field(cluster_v1::View { eye_origin: nan(3), ..good.clone() }), "eye_origin");
    assert_eq!(field(cluster_v1::View { kernel_std: vec![0.0; 3], ..good.clone() }), "kernel_std");
    assert_eq!(
        field(cluster_v1::View { kernel_lean: vec![0.0; 2], ..good.clone() }),
        "kernel_lean"
    );
    assert_eq!(field(cluster_v1::View { kernel_lean: nan(3), ..good.clone() }), "kernel_lean");
    assert_eq!(field(cluster_v1::View { thickness: -1.0, ..good.clone() }), "thickness");
    assert_eq!(field(cluster_v1::View { width: 8193, ..good.clone() }), "width");
    assert_eq!(field(cluster_v1::View { projection: None, ..good.clone() }), "projection");
    let far = cluster_v1::View { eye_origin: vec![0.0, 0.0, 1e12], ..good };
    let far = convert::view_from_wire(far).unwrap();
    let lattice = slabcast_common::volume::Lattice::from_spacing([9; 3], [1.0; 3]);
    assert_eq!(convert::check_view(&lattice, &far).unwrap_err().field(), "frame.view.eye_origin");
}

#[test]
fn wrong_path_is_refused_by_its_field_in_the_proto() {
    use render_v1::view_path::Cameras;
    use render_v1::{
        Quality, SubmitPathRequest, TransferChoice, TransferFunction, Turntable, Vec3, ViewPath,
        transfer_choice::Choice,
    };
    let good = || SubmitPathRequest {
        client_key: "k".into(),
        path: Some(ViewPath {
            width: 64,
            height: 64,
            cameras: Some(Cameras::Turntable(Turntable::default())),
            ..ViewPath::default()
        }),
        ..SubmitPathRequest::default()
    };
    let request = convert::submit_from_wire(good()).expect("all else has defaults");
    assert_eq!(request.path.turntable, Some(Default::default()));
    assert_eq!(request.quality, Default::default());
    assert_eq!(request.work, Default::default());
    assert_eq!(request.level, Default::default());
    let field = |spoil: &dyn Fn(&mut SubmitPathRequest)| {
        let mut request = good();
        spoil(&mut request);
        convert::submit_from_wire(request).unwrap_err().to_string()
    };
    let cameras =
        |cameras: Option<Cameras>| field(&|r| r.path.as_mut().unwrap().cameras = cameras.clone());
    let starts = |text: String, with: &str| assert!(text.starts_with(with), "{text}");
    starts(field(&|r| r.client_key.clear()), "client_key: missing");
    starts(field(&|r| r.client_key = "a\nb".into()), "client_key: has control");
    starts(field(&|r| r.path = None), "path: missing");
    starts(field(&|r| r.path.as_mut().unwrap().width = 0), "path.width: 0 pixels");
    starts(cameras(None), "path.cameras: missing");
    starts(cameras(Some(Cameras::Views(Default::default()))), "path.views: no view");
    starts(field(&|r| r.format = 99), "format: 99 has no meaning");
    starts(
        field(&|r| r.quality = Some(Quality { eps: Some(f64::NAN), ..Default::default() })),
        "quality.eps: NaN is out of range",
    );
    let tile_edge = Some(17);
    starts(
        field(&|r| r.work = Some(render_v1::Work { tile_edge, ..Default::default() })),
        "work.tile_edge: 17 is not",
    );
    let level = |number| render_v1::LevelChoice {
        choice: Some(render_v1::level_choice::Choice::Number(number)),
    };
    starts(field(&|r| r.level = Some(level(64))), "level.number: 64; give 0");
    let function = TransferFunction { domain: 1, ..Default::default() };
    starts(
        field(&|r| {
            let choice = Some(Choice::Function(function.clone()));
            r.transfer = Some(TransferChoice { choice });
        }),
        "transfer.function.colors: no point",
    );
    let vec3 = |x| Some(Box::new(Vec3 { x: Some(x), ..Vec3::default() }));
    let view = render_v1::PathView {
        eye: vec3(f64::INFINITY),
        target: vec3(0.0),
        up: vec3(0.0),
        ..Default::default()
    };
    let views = render_v1::Views { views: vec![view] };
    starts(
        cameras(Some(Cameras::Views(views))),
        "path.views.views[0].eye: has a number that is not finite",
    );
    let frames = Some(0);
    starts(
        cameras(Some(Cameras::Turntable(Turntable { frames, ..Default::default() }))),
        "path.turntable.frames: 0 frames",
    );
    let refused = convert::submit_from_wire(SubmitPathRequest::default()).unwrap_err();
    let status = tonic::Status::from(refused);
    assert_eq!(status.code(), tonic::Code::InvalidArgument);
    let details = slabcast_proto::status::Details::from_status(&status);
    assert_eq!(details.field.map(|(field, _)| field).as_deref(), Some("client_key"));
}

/// The promise of `MAX_RENDER_MESSAGE`: an empty message in a list takes two bytes on the wire, and
/// at most 70 times that in memory.
#[test]
fn empty_messages_in_lists_are_small_in_memory() {
    use render_v1::{ColorPoint, GradientPoint, Key, OpacityPoint, PathView, Vec3};
    for (name, bytes) in [
        ("PathView", size_of::<PathView>()),
        ("Key", size_of::<Key>()),
        ("Vec3", size_of::<Vec3>()),
        ("ColorPoint", size_of::<ColorPoint>()),
        ("OpacityPoint", size_of::<OpacityPoint>()),
        ("GradientPoint", size_of::<GradientPoint>()),
    ] {
        assert!(bytes <= 140, "{name} takes {bytes} bytes; put its messages into boxes (build.rs)");
    }
}

#[test]
fn brick_ids_beyond_the_largest_grid_are_refused() {
    let list = cluster_v1::BrickIds { differences: vec![1 << 27] };
    let drop = cluster_v1::DropBricks { set: vec![0; 32].into(), bricks: Some(list) };
    let message = cluster_v1::BricksResponse {
        message: Some(cluster_v1::bricks_response::Message::Drop(drop)),
    };
    assert_eq!(convert::bricks_from_wire(message).unwrap_err().field(), "drop.bricks");
    let empty = cluster_v1::DropBricks { set: vec![0; 32].into(), bricks: None };
    let message = cluster_v1::BricksResponse {
        message: Some(cluster_v1::bricks_response::Message::Drop(empty)),
    };
    assert!(matches!(convert::bricks_from_wire(message), Ok(Bricks::Message(_))));
}

/// The promise of `cluster.proto`: whatever becomes of the other messages, a master of any
/// version can read who calls, and a worker of any version can read why it is refused. If this
/// fails, the change must be taken back.
#[test]
fn bytes_of_hello_and_refused_never_change() {
    use cluster_v1::{
        BrickIds, ControlRequest, ControlResponse, HeldBricks, Hello, Refused, control_request,
        control_response,
    };
    let hello = control_request::Message::Hello(Hello {
        min_protocol_version: 1,
        max_protocol_version: 2,
        pixels_version: 3,
        name: "n".into(),
        threads: 4,
        memory_budget_bytes: 5,
        simd: "s".into(),
        self_test_sha256: "h".into(),
        held: vec![HeldBricks {
            set: vec![9].into(),
            bricks: Some(BrickIds { differences: vec![5, 1, -1] }),
        }],
        rehearses: true,
        machine: "m".into(),
        crc32c: 0x0403_0201,
    });
    let golden = [
        0x0a, 41, // ControlRequest.hello = 1, 41 bytes
        0x08, 1, // min_protocol_version = 1, varint
        0x10, 2, // max_protocol_version = 2, varint
        0x18, 3, // pixels_version = 3, varint
        0x22, 1, b'n', // name = 4
        0x28, 4, // threads = 5, varint
        0x30, 5, // memory_budget_bytes = 6, varint
        0x3a, 1, b's', // simd = 7
        0x42, 1, b'h', // self_test_sha256 = 8
        0x4a, 10, // held = 9
        0x0a, 1, 9, // HeldBricks.set = 1
        0x12, 5, // HeldBricks.bricks = 2
        0x0a, 3, 10, 2, 1, // BrickIds.differences = 1, packed, zigzag
        0x50, 1, // rehearses = 10, varint
        0x5a, 1, b'm', // machine = 11
        0x65, 1, 2, 3, 4, // crc32c = 12, since protocol 8
    ];
    assert_eq!(ControlRequest { message: Some(hello) }.encode_to_vec(), golden);

    let refused = control_response::Message::Refused(Refused { reason: "r".into() });
    let golden = [
        0x12, 3, // ControlResponse.refused = 2, 3 bytes
        0x0a, 1, b'r', // reason = 1
    ];
    assert_eq!(ControlResponse { message: Some(refused) }.encode_to_vec(), golden);
}

#[test]
fn wrong_palette_is_refused_by_field_before_memory_is_set_aside() {
    use slabcast_common::volume::{ColourValue, Lattice, Palette, Volume};
    let palette =
        Palette::sorted(vec![[1, 2, 3, 255], [9, 8, 7, 255]], false, ColourValue::Luminance);
    let lattice = Lattice::from_spacing([2, 1, 1], [1.0; 3]);
    let volume =
        Volume::coloured("c", "RGB uint8", false, lattice, palette.unwrap().into(), vec![0, 1]);
    let volume = volume.unwrap();
    let header = slabcast_proto::model::VolumeHeader {
        name: "c".into(),
        file_type: "RGB uint8".into(),
        info: volume.info(volume.digest()),
        orientation: slabcast_scene::path::Orientation::new(None, None).unwrap(),
    };
    let good = convert::volume_header_to_wire(&header);
    assert_eq!(convert::volume_header_from_wire(good.clone()).unwrap().info, header.info);
    let refused = |change: &dyn Fn(&mut render_v1::Volume)| {
        let mut wrong = good.clone();
        change(wrong.volume.as_mut().unwrap());
        convert::volume_header_from_wire(wrong).unwrap_err().to_string()
    };
    let colours = |bytes: Vec<u8>| {
        refused(&move |v| v.palette.as_mut().unwrap().colours = bytes.clone().into())
    };
    assert!(colours(vec![]).contains("volume.palette.colours: has 0 colours"));
    assert!(colours(vec![1, 2, 3]).contains("3 bytes, which are not four a colour"));
    assert!(colours(vec![0; 4 * 65_537]).contains("has 65537 colours"));
    assert!(colours(vec![9, 8, 7, 255, 1, 2, 3, 255]).contains("colour 1 is not above"));
    assert!(colours(vec![1, 2, 3, 4]).contains("has alphas"));
    let by_alpha = refused(&|v| v.palette.as_mut().unwrap().value_is_alpha = true);
    assert!(by_alpha.contains("has alphas"), "{by_alpha}");
    let kind = refused(&|v| v.sample_kind = render_v1::SampleKind::U16 as i32);
    assert!(kind.contains("volume.palette: is there, but"), "{kind}");
    let map = refused(&|v| v.value_scale = Some(2.0));
    assert!(map.contains("volume.palette: is there, but"), "{map}");
}
