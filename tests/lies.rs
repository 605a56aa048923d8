//! A worker that lies about its pixels, on a real link: its lie is found in the first frame, the
//! picture is true, and it is shut out.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::{Pixels, ToMaster};
use slabcast_common::quality::{Quality, Work};
use slabcast_master::jobs::WatchItem;
use slabcast_master::{Handle, Master, MasterConfig};
use slabcast_proto::cluster_v1::BricksResponse;
use slabcast_proto::cluster_v1::cluster_service_client::ClusterServiceClient;
use slabcast_proto::{convert, sealed};
use slabcast_render::Simd;
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_worker::{BrickCache, Config, Link};
use std::time::Duration;
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;

/// Longest time that any step may take.
const PATIENT: Duration = Duration::from_secs(60);

/// A master that draws one tile in a hundred twice, after each worker's first ones.
fn master() -> Master {
    let volume = slabcast_volumes::open("formula:spheres:40".as_ref()).expect("a formula");
    let orientation = Orientation::new(None, None).expect("the defaults");
    let mut config = MasterConfig::new(volume, orientation);
    config.audit_ppm = Some(10_000);
    Master::start(config).expect("a master")
}

fn request() -> PathRequest {
    let turn = Turntable { frames: 3, elevation: 20.0, ..Turntable::default() };
    PathRequest {
        client_key: "lies".into(),
        volume: VolumeChoice::Default,
        level: LevelChoice::default(),
        path: ViewPath::from_turntable([150, 110], turn),
        transfer: TransferChoice::Name("auto".into()),
        quality: Quality::default(),
        work: Work { tile: Some(32), ..Work::default() },
        format: PixelFormat::Rgba32F,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    }
}

fn config(name: &str) -> Config {
    Config {
        name: name.into(),
        threads: 1,
        memory_budget_bytes: 64 << 20,
        simd: Simd::detect(),
        rehearsal: None,
        machine: name.into(),
    }
}

/// Hashes of the frames of one job.
async fn run(handle: &Handle) -> Vec<String> {
    let job = handle.submit(request()).await.expect("a good request");
    let mut watch = handle.watch(job, 0).expect("it was just submitted");
    let mut hashes = Vec::new();
    while let Some(item) = tokio::time::timeout(PATIENT, watch.next()).await.expect("in time") {
        if let WatchItem::Frame(frame) = item {
            hashes.push(frame.stats.pixels_sha256.clone());
        }
    }
    hashes
}

/// Makes a result false: where it shows something, less red; black where it shows nothing.
fn lie(message: ToMaster) -> ToMaster {
    let ToMaster::Result(mut result) = message else { return message };
    if let Pixels::Sums(sums) = &mut result.pixels {
        for colour in &mut sums.colour {
            colour[0] /= 2;
        }
        for a in &mut sums.a {
            *a = a.max(0.5);
        }
    }
    ToMaster::Result(result)
}

/// A worker like any other whose results are false, on a link of its own. Returns when the master
/// ends the link.
async fn liar(address: String, stop: watch::Receiver<bool>) {
    let (reply_tx, replies) = mpsc::channel(64);
    let (control_tx, control) = mpsc::unbounded_channel();
    let (bricks_tx, bricks) = mpsc::channel(4);
    let link = Link { control, replies: reply_tx, bricks };
    let drawing = tokio::spawn(async move {
        slabcast_worker::run(&config("liar"), link, &mut BrickCache::default(), stop).await
    });
    let mut said = ReceiverStream::new(replies).map(|m| convert::from_worker_to_wire(&lie(m)));
    let connect = || ClusterServiceClient::connect(format!("http://{address}"));
    let hello = said.next().await.expect("a hello");
    let (sealed_out, opener) = sealed::ends(said);
    let outbound = tokio_stream::once(hello).chain(sealed_out);
    let mut control = connect().await.expect("a master");
    let mut inbound = control.control(outbound).await.expect("a stream").into_inner();
    let mut carrying = None;
    while let Ok(Some(message)) = inbound.message().await {
        let Some(message) = opener.open(message).expect("no damage") else { continue };
        let (message, session) = convert::to_worker_from_wire(message).expect("a good message");
        if let Some(session) = session {
            let open = tokio_stream::once(convert::bricks_open_to_wire(session));
            let (open, opener) =
                sealed::ends::<_, BricksResponse>(open.chain(tokio_stream::pending()));
            let mut client = connect().await.expect("a master");
            let mut inbound = client.bricks(open).await.expect("a stream").into_inner();
            let bricks = bricks_tx.clone();
            carrying = Some(tokio::spawn(async move {
                while let Ok(Some(message)) = inbound.message().await {
                    let Some(message) = opener.open(message).expect("no damage") else { continue };
                    let message = convert::bricks_from_wire(message).expect("a good message");
                    if bricks.send(message).await.is_err() {
                        return;
                    }
                }
            }));
        }
        if control_tx.send(message).is_err() {
            break;
        }
    }
    drop((control_tx, bricks_tx));
    if let Some(carrying) = carrying {
        carrying.abort();
    }
    let _ = tokio::time::timeout(PATIENT, drawing).await.expect("a worker ends with its link");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn worker_that_lies_is_found_in_its_first_frame_and_shut_out() {
    let (stop, stopped) = watch::channel(false);
    let quiet = master();
    let end = slabcast_master::link::embedded(quiet.handle());
    let link = Link { control: end.control, replies: end.replies, bricks: end.bricks };
    let until = stopped.clone();
    tokio::spawn(async move {
        slabcast_worker::run(&config("embedded"), link, &mut BrickCache::default(), until).await
    });
    let truth = run(&quiet.handle()).await;
    assert_eq!(truth.len(), 3);

    let master = master();
    let handle = master.handle();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
    let address = listener.local_addr().expect("it has one").to_string();
    tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped.clone()));
    for name in ["honest", "upright"] {
        let until = stopped.clone();
        tokio::spawn(slabcast_worker::dial::run(config(name), address.clone(), until));
    }
    let mut lying = tokio::spawn(liar(address.clone(), stopped.clone()));
    let all_are_there = async {
        while handle.workers().await.len() < 3 {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    tokio::time::timeout(PATIENT, all_are_there).await.expect("three workers join");

    assert_eq!(run(&handle).await, truth);
    tokio::time::timeout(PATIENT, &mut lying).await.expect("it is shut out").expect("no panic");
    let names: Vec<String> = handle.workers().await.into_iter().map(|w| w.name).collect();
    assert!(!names.iter().any(|name| name.contains("liar")), "{names:?}");

    // Its name and machine are not let in again.
    tokio::time::timeout(PATIENT, liar(address, stopped)).await.expect("it is refused");
    let names: Vec<String> = handle.workers().await.into_iter().map(|w| w.name).collect();
    assert_eq!(names.len(), 2, "{names:?}");
    drop(stop);
}
