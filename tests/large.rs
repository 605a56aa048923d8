//! Volumes that are read block by block: the same pictures whatever memory there is, refusals with
//! figures, and files that go away while they are served.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::volume::{Samples, Volume};
use slabcast_master::jobs::{JobState, WatchItem};
use slabcast_master::library::{LibraryConfig, ReadFile, Unreadable};
use slabcast_master::memory::Shares;
use slabcast_master::{Handle, Library, Master, MasterConfig, link};
use slabcast_render::Simd;
use slabcast_scene::path::{Orientation, Turntable, ViewPath};
use slabcast_scene::request::{PathRequest, VolumeChoice};
use slabcast_scene::transfer::TransferChoice;
use slabcast_volumes::Hints;
use slabcast_volumes::blocks::ome_zarr::{OmeZarrSource, convert};
use slabcast_volumes::blocks::{BlockSource, FormulaSource};
use slabcast_worker::{BrickCache, Config, Link};
use std::path::{Path, PathBuf};
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
    serve(Library::of_source(source, orientation()), brick_bytes, stop)
}

/// Starts a master of a library and a worker in this process.
fn serve(library: Library, brick_bytes: u64, stop: &watch::Receiver<bool>) -> Master {
    let mut config = MasterConfig::of(library);
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
            WatchItem::Notice(view) => match view.state {
                JobState::Failed(reason) | JobState::Incomplete(reason) => {
                    failures.push(reason.to_string());
                }
                _ => {}
            },
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

/// Writes a volume of 96x80x72 samples as OME-Zarr at `to`.
fn write_picture(to: &Path, seed: u32) {
    let volume = Volume::from_fn_u8("x", [96, 80, 72], |i, j, k| {
        let far =
            [i.abs_diff(48), j.abs_diff(40), k.abs_diff(36)].map(|d| d * d).iter().sum::<u32>();
        if far < 900 { (100 + (i * seed + j * 3 + k) % 60) as u8 } else { 0 }
    });
    let file = to.with_extension("nrrd");
    let header = "NRRD0004\ntype: uchar\ndimension: 3\nsizes: 96 80 72\nencoding: raw\n\n";
    let Samples::U8(codes) = &volume.samples else { panic!("they are bytes") };
    std::fs::write(&file, [header.as_bytes(), codes].concat()).expect("a file");
    convert(&file, to, &Hints::default(), true, &mut |_, _| Ok(())).expect("a picture");
    std::fs::remove_file(file).expect("it is there");
}

/// Files of level 0 of a picture that hold samples.
fn chunks(of: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![of.join("0/c")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() { folders.push(path) } else { found.push(path) }
        }
    }
    found
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn files_that_change_while_they_are_served_fail_their_own_jobs_alone() {
    let folder = tempfile::tempdir().expect("a folder");
    let [good, bad] = ["good.ome.zarr", "bad.ome.zarr"].map(|name| folder.path().join(name));
    write_picture(&good, 5);
    write_picture(&bad, 7);
    let read: ReadFile = Arc::new(|path, _| {
        match OmeZarrSource::open(path, &Hints::default(), None, &mut |_, _| Ok(())) {
            Ok(source) => Ok((Arc::new(source), orientation())),
            Err(e) => Err(Unreadable { reason: e.to_string(), is_too_large: false }),
        }
    });
    let library = Library::new(LibraryConfig {
        given: None,
        folder: Some(folder.path().into()),
        uploads: None,
        memory_bytes: u64::MAX,
        read,
    });
    let (stop, stopped) = watch::channel(false);
    let master = serve(library.expect("a library"), 64 << 20, &stopped);
    let handle = master.handle();
    let of = |name: &str, key: &str| PathRequest {
        volume: VolumeChoice::Name(format!("{name}.ome.zarr")),
        ..request(key, None, LevelChoice::At(0))
    };
    let first = draw(&handle, of("good", "first")).await.expect("pictures");
    // It is opened while it is whole.
    let coarse = PathRequest { level: LevelChoice::At(1), ..of("bad", "coarse") };
    draw(&handle, coarse).await.expect("pictures");
    let kept: Vec<(PathBuf, Vec<u8>)> = chunks(&bad)
        .into_iter()
        .map(|path| (path.clone(), std::fs::read(path).expect("a chunk")))
        .collect();
    assert!(!kept.is_empty(), "its samples are in files");
    type Harm = fn(&Path, &[u8]) -> std::io::Result<()>;
    let harms: [(&str, Harm); 3] = [
        ("gone", |path, _| std::fs::remove_file(path)),
        ("truncated", |path, bytes| std::fs::write(path, &bytes[..bytes.len() / 2])),
        ("damaged", |path, bytes| {
            let mut bytes = bytes.to_vec();
            bytes.iter_mut().skip(16).step_by(7).for_each(|b| *b ^= 0x55);
            std::fs::write(path, bytes)
        }),
    ];
    for (name, harm) in harms {
        for (path, bytes) in &kept {
            harm(path, bytes).expect("the file is ours");
        }
        let reason = draw(&handle, of("bad", name)).await.expect_err("its samples are not there");
        assert!(reason.contains("0/c"), "{name}: {reason}");
        let again = draw(&handle, of("good", &format!("beside {name}"))).await;
        assert_eq!(again.as_ref(), Ok(&first), "beside a file that is {name}");
        for (path, bytes) in &kept {
            std::fs::write(path, bytes).expect("the file is ours");
        }
    }
    // The master opens the picture anew.
    let whole = draw(&handle, of("bad", "whole again")).await.expect("all chunks are back");
    assert!(whole != first);
    write_picture(&bad, 9);
    let replaced = draw(&handle, of("bad", "replaced")).await.expect("another picture");
    assert!(replaced != whole);
    let _ = stop.send(true);
    master.shutdown().await;
}
