//! Volumes that are read block by block: the same pictures whatever memory there is, refusals with
//! figures, and files that go away while they are served.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_master::jobs::WatchItem;
use slabcast_master::memory::Shares;
use slabcast_master::{Handle, Library, Master, MasterConfig, link};
use slabcast_render::Simd;
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_volumes::blocks::{BlockSource, FormulaSource};
use slabcast_worker::{BrickCache, Config, Link};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;

/// Longest time that any step may take.
const PATIENT: Duration = Duration::from_secs(120);

fn orientation() -> Orientation {
    Orientation::new(None, None).expect("the defaults")
}

/// Starts a master of one source and a worker in this process, with at most `brick_bytes` of bricks
/// each.
fn start(source: Arc<dyn BlockSource>, brick_bytes: u64, stop: &watch::Receiver<bool>) -> Master {
    let mut config = MasterConfig::of(Library::of_source(source, orientation()));
    config.shares = Shares { bricks: brick_bytes, ..Shares::default() };
    let master = Master::start(config).expect("a master");
    let end = link::embedded(master.handle());
    let link = Link { control: end.control, replies: end.replies, bricks: end.bricks };
    let config = Config {
        name: "worker".into(),
        threads: 2,
        memory_budget_bytes: brick_bytes.min(1 << 30),
        simd: Simd::detect(),
        rehearsal: None,
        machine: String::new(),
    };
    let stop = stop.clone();
    tokio::spawn(async move {
        let _ = slabcast_worker::run(&config, link, &mut BrickCache::default(), stop).await;
    });
    master
}

/// Returns the request of a turn around a volume; `height` is the part of it in view.
fn request(key: &str, height: Option<f64>, level: LevelChoice) -> PathRequest {
    let turn = Turntable { frames: 4, step: 35.0, elevation: 20.0, height, ..Turntable::default() };
    PathRequest {
        client_key: key.into(),
        volume: VolumeChoice::Default,
        level,
        path: ViewPath::from_turntable([96, 80], turn),
        transfer: TransferChoice::Name("grey".into()),
        quality: Quality::default(),
        work: Work::default(),
        format: PixelFormat::Rgba32F,
        background: Background::Transparent,
        want_trace: false,
        want_hash: true,
    }
}

/// Hashes of the frames of a job, or why it failed.
async fn draw(handle: &Handle, request: PathRequest) -> Result<Vec<String>, String> {
    let job = handle.submit(request).await.map_err(|e| e.to_string())?;
    let mut watch = handle.watch(job, 0).expect("it was just submitted");
    let (mut hashes, mut failures) = (Vec::new(), Vec::new());
    while let Some(item) = tokio::time::timeout(PATIENT, watch.next()).await.expect("in time") {
        match item {
            WatchItem::Frame(frame) => hashes.push(frame.stats.pixels_sha256.clone()),
            WatchItem::Failed { reason, .. } => failures.push(reason.to_string()),
            WatchItem::Notice(_) => {}
        }
    }
    match failures.pop() {
        None => Ok(hashes),
        Some(reason) => Err(reason),
    }
}

/// Returns the formula volume `cells`: sparse cells of 64 samples an edge, each of one value with
/// detail.
fn cells(size: &str) -> Arc<dyn BlockSource> {
    let text = format!("{}{size}", FormulaSource::PREFIX);
    Arc::new(FormulaSource::open(&text).expect("a size"))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn pictures_are_the_same_with_all_bricks_in_memory_and_with_hardly_any() {
    let (stop, stopped) = watch::channel(false);
    let rich = start(cells("448x320x384"), u64::MAX, &stopped);
    let poor = start(cells("448x320x384"), 6 << 20, &stopped);
    // Half of what all bricks take: blocks are cut again and again.
    for (height, level) in [(None, 0), (Some(100.0), 0), (None, 1)] {
        let key = format!("{height:?} {level}");
        let request = || request(&key, height, LevelChoice::At(level));
        let all = draw(&rich.handle(), request()).await.expect("pictures");
        assert_eq!(all.len(), 4);
        assert!(all[0] != all[1], "something is seen");
        assert_eq!(draw(&poor.handle(), request()).await.as_ref(), Ok(&all), "{key}");
    }
    let _ = stop.send(true);
    rich.shutdown().await;
    poor.shutdown().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn picture_that_can_not_fit_is_refused_with_figures_and_a_coarser_one_is_drawn() {
    let (stop, stopped) = watch::channel(false);
    // 2^33 samples.
    let master = start(cells("2048x2048x2048"), 64 << 20, &stopped);
    let refused = draw(&master.handle(), request("all", None, LevelChoice::At(0))).await;
    let reason = refused.expect_err("it has 16 Mi bricks");
    assert!(reason.starts_with("level: at level 0 this shows "), "{reason}");
    assert!(reason.contains("MiB") && reason.contains("--level auto"), "{reason}");
    let auto = draw(&master.handle(), request("auto", None, LevelChoice::Auto)).await;
    assert_eq!(auto.expect("it is small enough").len(), 4);
    // A few blocks in the middle of the whole.
    let mut cropped = request("crop", None, LevelChoice::At(0));
    cropped.path.crop = Some("48%:52%,48%:52%,48%:52%".parse().expect("a box"));
    assert_eq!(draw(&master.handle(), cropped).await.expect("it is small enough").len(), 4);
    let near = draw(&master.handle(), request("near", Some(70.0), LevelChoice::At(0))).await;
    assert_eq!(near.expect("few blocks are in view").len(), 4);
    let _ = stop.send(true);
    master.shutdown().await;
}
