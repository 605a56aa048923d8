//! One master, workers over every kind of link, one picture.
//!
//! One job runs over the embedded link, over an embedded link with the codec of the wire in its
//! middle, and over TCP with two connections a worker; each gives the bytes of the serial renderer.
//! Nothing here sleeps to wait for something: channels say when.

use slabcast_common::ids::SceneId;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::{SceneSpec, ToWorker};
use slabcast_common::quality::{Borders, Quality, Schedule, Sums, Work};
use slabcast_common::stats::FrameStats;
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::Volume;
use slabcast_master::jobs::{FinishedFrame, JobState, WatchItem};
use slabcast_master::{Handle, Master, MasterConfig};
use slabcast_proto::cluster_v1;
use slabcast_proto::convert::{self, BrickBatches, Bricks, Down};
use slabcast_render::Simd;
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::path::{Orientation, ProjectionKind, Turntable, ViewPath};
use slabcast_scene::presets;
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_scene::tween::Tween;
use slabcast_volumes::BrickStore;
use slabcast_worker::{BrickCache, Config, Link};
use std::sync::Arc;
use tokio::sync::{mpsc, watch};

fn volume() -> Volume {
    slabcast_volumes::open("formula:spheres:40".as_ref()).expect("a volume by formula")
}

fn request(key: &str, projection: ProjectionKind, work: Work) -> PathRequest {
    let turn = Turntable { frames: 3, elevation: 20.0, projection, ..Turntable::default() };
    PathRequest {
        client_key: key.into(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path: ViewPath::from_turntable([150, 110], turn),
        transfer: TransferChoice::Name("auto".into()),
        quality: Quality::before(),
        work,
        format: PixelFormat::Rgba32F,
        background: Background::Transparent,
        want_trace: true,
        want_hash: true,
    }
}

fn orientation() -> Orientation {
    Orientation::new(None, None).expect("the defaults")
}

/// Returns the hashes of the frames as the serial renderer draws them.
fn truth(request: &PathRequest) -> Vec<String> {
    let volume = volume();
    let digest = volume.digest();
    let info = volume.info(digest);
    let transfer = presets::by_name("auto", &info.summary).unwrap();
    let quality = Quality { sums: Sums::I32, ..request.quality };
    let wanted = BrickNeeds::for_transfer(&transfer, &info, &quality);
    let store = BrickStore::build(&volume, digest, &wanted);
    let bricks: Vec<_> = store.infos().iter().map(|i| store.brick(i.id).unwrap()).collect();
    let spec = SceneSpec {
        id: SceneId(1),
        volume: info,
        transfer,
        quality,
        crop: None,
        bricks: store.key(),
    };
    let scene = Arc::new(Scene::new(&spec));
    (0..request.path.frames())
        .map(|i| {
            let camera = request.path.camera(i, &volume.lattice, orientation()).unwrap();
            let view = View::new(&volume.lattice, &camera, request.path.size, &quality).unwrap();
            serial::render(&Frame::new(scene.clone(), view), &bricks).sha256().to_string()
        })
        .collect()
}

fn config(name: &str, threads: u32) -> Config {
    Config {
        name: name.into(),
        threads,
        memory_budget_bytes: 64 << 20,
        simd: Simd::detect(),
        rehearsal: None,
        machine: String::new(),
    }
}

fn master() -> Master {
    Master::start(MasterConfig::new(volume(), orientation())).expect("a master")
}

/// Runs a job to its end. Returns the statistics of its frames in order.
async fn run(handle: &Handle, request: PathRequest) -> Vec<FrameStats> {
    let job = handle.submit(request).await.expect("a good request");
    let mut watch = handle.watch(job, 0).expect("a job that was just submitted");
    let mut frames = Vec::new();
    while let Some(item) = watch.next().await {
        if let WatchItem::Frame(f) = item {
            assert_eq!(f.number, frames.len() as u64, "frames come in order");
            assert_eq!(f.bytes.len(), 150 * 110 * 16);
            assert!(f.trace_json.as_ref().is_some_and(|t| t.contains("\"ph\":\"X\"")));
            frames.push(f.stats.clone());
        }
    }
    assert_eq!(handle.job(job).map(|j| j.state), Some(JobState::Done));
    frames
}

fn hashes(frames: &[FrameStats]) -> Vec<String> {
    frames.iter().map(|f| f.pixels_sha256.clone()).collect()
}

fn embed(handle: &Handle, config: Config) -> watch::Sender<bool> {
    let end = slabcast_master::link::embedded(handle.clone());
    let (stop, stopped) = watch::channel(false);
    let link = Link { control: end.control, replies: end.replies, bricks: end.bricks };
    tokio::spawn(async move {
        let mut cache = BrickCache::default();
        slabcast_worker::run(&config, link, &mut cache, stopped).await
    });
    stop
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn embedded_workers_give_the_serial_bytes_and_true_statistics() {
    let master = master();
    let handle = master.handle();
    let _stops = [embed(&handle, config("a", 1)), embed(&handle, config("b", 2))];
    // Equal borders give three slabs; borders by data may find that two hide as much.
    let (schedule, borders) = (Schedule::Slab, Borders::Equal);
    let slab = Work { schedule, borders, ..Work::default() };
    let ask = request("1", ProjectionKind::Persp, slab);
    let want = truth(&ask);
    let frames = run(&handle, ask).await;
    assert_eq!(hashes(&frames), want);

    let first = &frames[0];
    assert!(first.bricks.needed > 0 && first.bricks.needed <= first.bricks.relevant);
    assert!(first.voxels.splatted > 0 && first.voxels.culled > 0);
    assert!(first.ms.total > 0.0 && first.ms.render > 0.0);
    assert_eq!(first.slabs.len(), 3);
    for w in &first.workers {
        assert!(w.bricks_sent > 0 && w.bytes_sent > 0, "{} got bricks", w.id);
        assert!(w.bricks_held >= w.bricks_sent);
    }
    // The second view is near: only what it newly sees is sent.
    let sent = |f: &FrameStats| f.workers.iter().map(|w| w.bricks_sent).sum::<u64>();
    assert!(sent(&frames[1]) * 4 < sent(first), "{} then {}", sent(first), sent(&frames[1]));

    // Another light or colour needs no new brick; neither does the same path again.
    let again = run(&handle, request("2", ProjectionKind::Persp, slab)).await;
    assert_eq!(hashes(&again), want);
    assert_eq!(again.iter().map(sent).sum::<u64>(), 0, "bricks are kept from job to job");

    // And a path in regions, which draws from fewer, and from none that the slabs did not.
    let regions = run(&handle, request("3", ProjectionKind::Persp, Work::default())).await;
    assert_eq!(hashes(&regions), want);
    assert_eq!(regions.iter().map(sent).sum::<u64>(), 0, "slabs need no less");
    for (by_region, by_slab) in regions.iter().zip(&frames) {
        let (r, s) = (by_region.bricks, by_slab.bricks);
        assert!(0 < r.needed && r.needed <= s.needed && r.relevant == s.relevant, "{r:?} {s:?}");
        assert_eq!((by_region.schedule, by_region.slabs.len()), (Schedule::Region, 1));
        assert!(by_region.workers.iter().all(|w| w.stalls == 0));
    }
    master.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn regions_request_missing_bricks_over_an_embedded_link() {
    let master = master();
    let handle = master.handle();
    let _stop = embed(&handle, config("a", 2));
    let ask = request("1", ProjectionKind::Ortho, Work::default());
    let want = truth(&ask);
    let frames = run(&handle, ask).await;
    assert_eq!(hashes(&frames), want);
    let sent = |f: &FrameStats| f.workers.iter().map(|w| w.bricks_sent).sum::<u64>();
    let first = &frames[0];
    assert!(first.workers[0].stalls > 0 && first.workers[0].parked_ms > 0.0);
    assert!(sent(first) >= first.bricks.needed && first.bricks.needed > 0);
    let again = run(&handle, request("2", ProjectionKind::Ortho, Work::default())).await;
    assert_eq!(hashes(&again), want);
    assert_eq!(again.iter().map(sent).sum::<u64>(), 0, "bricks are kept from job to job");
    master.shutdown().await;
}

/// An embedded link with the codec of the wire in its middle, both ways.
fn through_codec(handle: &Handle) -> Link {
    use prost::Message;
    let mut end = slabcast_master::link::embedded(handle.clone());
    let (control_tx, control) = mpsc::unbounded_channel();
    let (replies, mut reply_rx) = mpsc::channel(64);
    let (bricks_tx, bricks) = mpsc::channel(8);
    let to_bricks = bricks_tx.clone();
    tokio::spawn(async move {
        while let Some(message) = end.control.recv().await {
            let wires = match convert::to_worker_to_wire(&message, 7) {
                Down::Control(wire) => vec![wire],
                Down::Parts(wires) => wires,
                Down::Bricks(_) => panic!("only bricks go on the other stream"),
            };
            for wire in wires {
                let wire = cluster_v1::ControlResponse::decode(&wire.encode_to_vec()[..]).unwrap();
                let (message, _) = convert::to_worker_from_wire(wire).expect("our own message");
                if control_tx.send(message).is_err() {
                    return;
                }
            }
        }
    });
    tokio::spawn(async move {
        while let Some(bricks) = end.bricks.recv().await {
            let wires = match bricks {
                Bricks::Batch(batch) => {
                    let encoded = batch.bricks.iter().map(|b| {
                        let mut bytes = Vec::new();
                        b.encode(&mut bytes);
                        bytes.into()
                    });
                    BrickBatches::new(&batch.set, encoded).collect()
                }
                Bricks::Message(message @ ToWorker::DropBricks { .. }) => {
                    match convert::to_worker_to_wire(&message, 7) {
                        Down::Bricks(wires) => wires,
                        _ => panic!("keeps its place among the bricks"),
                    }
                }
                Bricks::Message(m) => panic!("{m:?} among bricks"),
            };
            for wire in wires {
                let wire = cluster_v1::BricksResponse::decode(&wire.encode_to_vec()[..]).unwrap();
                let bricks = convert::bricks_from_wire(wire).expect("our own message");
                if to_bricks.send(bricks).await.is_err() {
                    return;
                }
            }
        }
    });
    drop(bricks_tx);
    tokio::spawn(async move {
        while let Some(message) = reply_rx.recv().await {
            let wire = convert::from_worker_to_wire(&message).encode_to_vec();
            let wire = cluster_v1::ControlRequest::decode(&wire[..]).unwrap();
            let message = convert::from_worker_from_wire(wire).expect("our own message");
            if end.replies.send(message).await.is_err() {
                return;
            }
        }
    });
    Link { control, replies, bricks }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn wire_codec_inside_an_embedded_link_changes_no_byte() {
    let master = master();
    let handle = master.handle();
    let link = through_codec(&handle);
    let (_stop, stopped) = watch::channel(false);
    tokio::spawn(async move {
        let mut cache = BrickCache::default();
        slabcast_worker::run(&config("codec", 2), link, &mut cache, stopped).await
    });
    for schedule in [Schedule::Slab, Schedule::Region] {
        let work = Work { slabs: 5, tile: Some(32), schedule, ..Work::default() };
        let ask = request(&format!("{schedule:?}"), ProjectionKind::Ortho, work);
        let want = truth(&ask);
        assert_eq!(hashes(&run(&handle, ask).await), want);
    }
    master.shutdown().await;
}

/// Runs a job to its end. Returns its frames in order.
async fn frames(handle: &Handle, request: PathRequest) -> Vec<Arc<FinishedFrame>> {
    let job = handle.submit(request).await.expect("a good request");
    let mut watch = handle.watch(job, 0).expect("a job that was just submitted");
    let mut frames = Vec::new();
    while let Some(item) = watch.next().await {
        if let WatchItem::Frame(f) = item {
            frames.push(f);
        }
    }
    frames
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tiles_finished_on_workers_give_the_bytes_of_tiles_sent_as_sums() {
    let formats =
        [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F];
    let (mut of_sums, mut of_finished) = (0, 0);
    for over_codec in [false, true] {
        let master = master();
        let handle = master.handle();
        let (_stop, stopped) = watch::channel(false);
        let _embedded = (!over_codec).then(|| embed(&handle, config("a", 2)));
        if over_codec {
            let link = through_codec(&handle);
            tokio::spawn(async move {
                let mut cache = BrickCache::default();
                slabcast_worker::run(&config("codec", 2), link, &mut cache, stopped).await
            });
        }
        for (i, format) in formats.into_iter().enumerate() {
            let backgrounds = [
                Background::Transparent,
                Background::Colour([0.0; 3]),
                Background::Colour([0.3, 0.9, 0.1]),
            ];
            for (j, background) in backgrounds.into_iter().enumerate() {
                let ask = |schedule: Schedule, want_hash: bool| {
                    let key = format!("{over_codec} {i} {j} {schedule:?} {want_hash}");
                    let work = Work { schedule, ..Work::default() };
                    let ask = request(&key, ProjectionKind::Ortho, work);
                    PathRequest { format, background, want_hash, ..ask }
                };
                let sums = frames(&handle, ask(Schedule::Region, true)).await;
                let finished = frames(&handle, ask(Schedule::Region, false)).await;
                let slabs = frames(&handle, ask(Schedule::Slab, false)).await;
                assert_eq!(sums.len(), 3);
                for ((sums, finished), slabs) in sums.iter().zip(&finished).zip(&slabs) {
                    assert_eq!(sums.bytes.len(), 150 * 110 * format.bytes());
                    assert!(sums.bytes == finished.bytes, "{format:?} over {background:?}");
                    assert!(sums.bytes == slabs.bytes, "{format:?} over {background:?}");
                    assert_eq!(sums.stats.pixels_sha256.len(), 64);
                    assert_eq!(finished.stats.pixels_sha256, "");
                    assert_eq!(slabs.stats.pixels_sha256, "");
                    assert_eq!(finished.stats.view_sha256, sums.stats.view_sha256);
                    assert_eq!(finished.stats.error, sums.stats.error, "bounds know A's most");
                    let bytes = [&sums.stats, &finished.stats].map(|s| s.result_bytes);
                    assert!(bytes.iter().all(|b| b.is_some() == over_codec), "{bytes:?}");
                    if format == PixelFormat::Rgb8 {
                        of_sums += bytes[0].unwrap_or(0);
                        of_finished += bytes[1].unwrap_or(0);
                    }
                }
            }
        }
        master.shutdown().await;
    }
    assert!(of_finished * 3 < of_sums, "{of_finished} bytes, and {of_sums} of sums");
}

/// Returns the hashes of the serial renderer when each frame is a job of its own, with the bricks
/// of its own transfer function and no more.
fn truth_of_each(path: &ViewPath, default: &TransferFunction) -> Vec<String> {
    let volume = volume();
    let info = volume.info(volume.digest());
    let tween = Tween::from_path(path, &info.summary).unwrap();
    let cameras = path.prepare(&info.lattice, orientation()).unwrap();
    let frame = |i: usize| {
        let at = (path.first_frame() + i) as f64;
        let transfer = tween.as_ref().map_or(default.clone(), |t| t.transfer_at(at));
        let classifier = Classifier::new(&transfer, &info, Quality::before().compositing);
        let sums = classifier.choose_sums(&Quality::before(), &info.lattice).unwrap();
        let quality = Quality { sums, ..Quality::before() };
        let crop = path.crop.map(|c| c.resolve(&info.lattice).unwrap());
        let wanted = BrickNeeds { crop, ..BrickNeeds::for_transfer(&transfer, &info, &quality) };
        let store = BrickStore::build(&volume, info.digest, &wanted);
        let bricks: Vec<_> = store.infos().iter().map(|i| store.brick(i.id).unwrap()).collect();
        let volume = info.clone();
        let spec = SceneSpec {
            id: SceneId(1),
            volume,
            transfer,
            quality,
            crop: None,
            bricks: store.key(),
        };
        let view = View::new(&info.lattice, &cameras.camera(i).unwrap(), path.size, &quality);
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view.unwrap());
        serial::render(&frame, &bricks).sha256().to_string()
    };
    (0..path.frames()).map(frame).collect()
}

/// Three transfer functions on one set of bricks, a cropping box, a range of frames, and opacity by
/// gradient: every frame has the bytes of a job of that frame alone.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tween_crop_and_gradients_give_each_frame_the_bytes_of_its_own_job() {
    let path = ViewPath::from_json(
        r#"{"version":1,"size":[150,110],"crop":{"x":[null,25],"z":[8,null]},"range":[1,5],
        "keyframes":{"frames":7,"keys":[{"view":"left","tf":"bone"},
        {"azimuth":80,"elevation":30,"height":30,"tf":"glass"},
        {"azimuth":120,"target":[20,20,24],"tf":"grey"}]}}"#,
    )
    .unwrap();
    let grey = presets::by_name("grey", &volume().summary).unwrap();
    let want = truth_of_each(&path, &grey);
    assert_eq!(want.len(), 5);
    assert!((1..5).all(|i| want[i] != want[i - 1]), "each frame differs");
    let whole = ViewPath { crop: None, ..path.clone() };
    assert_ne!(truth_of_each(&whole, &grey)[0], want[0], "the box cuts something away");

    let master = master();
    let handle = master.handle();
    let _embedded = embed(&handle, config("embedded", 1));
    let link = through_codec(&handle);
    let (_stop, stopped) = watch::channel(false);
    tokio::spawn(async move {
        let mut cache = BrickCache::default();
        slabcast_worker::run(&config("codec", 1), link, &mut cache, stopped).await
    });
    let ask = PathRequest { path, ..request("tween", ProjectionKind::Ortho, Work::default()) };
    let frames = run(&handle, ask).await;
    assert_eq!(hashes(&frames), want);
    let numbers: Vec<u64> = frames.iter().map(|f| f.frame).collect();
    assert_eq!(numbers, [1, 2, 3, 4, 5], "people count on the whole path");
    let views: std::collections::BTreeSet<&str> =
        frames.iter().map(|f| f.view_sha256.as_str()).collect();
    assert_eq!(views.len(), 5);
    master.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn tcp_workers_and_an_embedded_worker_share_a_frame() {
    let master = master();
    let handle = master.handle();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (stop, stopped) = watch::channel(false);
    let serving =
        tokio::spawn(slabcast_master::serve::serve(handle.clone(), listener, stopped.clone()));
    let dialled: Vec<_> = ["tcp-a", "tcp-b"]
        .map(|name| {
            tokio::spawn(slabcast_worker::dial::run(
                config(name, 1),
                address.clone(),
                stopped.clone(),
            ))
        })
        .into();
    let _embedded = embed(&handle, config("in", 1));
    let work = Work { tile: Some(16), ..Work::default() };
    let ask = request("1", ProjectionKind::Persp, work);
    let want = truth(&ask);
    let mut seen = std::collections::BTreeSet::new();
    // Workers join when they are there; whoever is late renders the next path.
    for key in 0..20 {
        let frames = run(&handle, request(&key.to_string(), ProjectionKind::Persp, work)).await;
        assert_eq!(hashes(&frames), want);
        let workers = frames.iter().flat_map(|f| &f.slabs).flat_map(|s| &s.tiles);
        seen.extend(workers.map(|t| t.worker.clone()));
        if seen.len() == 3 {
            break;
        }
    }
    assert_eq!(seen.len(), 3, "all three rendered: {seen:?}");
    stop.send(true).unwrap();
    for worker in dialled {
        assert_eq!(worker.await.unwrap(), Ok(slabcast_worker::Ended::Stopped));
    }
    serving.await.unwrap().unwrap();
    master.shutdown().await;
}

#[tokio::test]
async fn bad_requests_are_refused_by_field() {
    let master = master();
    let handle = master.handle();
    let refused = async |change: &dyn Fn(&mut PathRequest)| {
        let mut r = request("x", ProjectionKind::Ortho, Work::default());
        change(&mut r);
        match handle.submit(r).await {
            Err(slabcast_master::SubmitError::Refused(r)) => r.field,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(refused(&|r| r.path.size = [0, 5]).await, "size");
    assert_eq!(refused(&|r| r.quality.thickness = f64::NAN).await, "thickness");
    assert_eq!(refused(&|r| r.work.slabs = 0).await, "slabs");
    assert_eq!(refused(&|r| r.transfer = TransferChoice::Name("nope".into())).await, "tf");
    assert_eq!(refused(&|r| r.client_key = String::new()).await, "client_key");
    let good = request("same", ProjectionKind::Ortho, Work::default());
    let id = handle.submit(good.clone()).await.unwrap();
    assert_eq!(handle.submit(good.clone()).await.unwrap(), id, "the same key is the same job");
    let other = PathRequest { want_trace: false, ..good };
    assert!(matches!(handle.submit(other).await, Err(slabcast_master::SubmitError::KeyTaken)));
    assert!(handle.cancel(id).await);
    assert!(!handle.cancel(id).await);
    assert_eq!(handle.job(id).map(|j| j.state), Some(JobState::Cancelled));
    master.shutdown().await;
}
