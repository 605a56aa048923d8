//! Cost of a master in this process: times `render`, and threads that draw the path without a
//! master, both to the same files.

use super::*;
use slabcast_common::image::Picture;
use slabcast_common::stats::FrameStats;
use slabcast_common::volume::Digest32;
use slabcast_master::finish::view_sha256;
use slabcast_scene::path::{Turntable, ViewPath};
use slabcast_session::direct::Cut;
use slabcast_session::figure::Figure;
use slabcast_session::output::Frame;
use std::collections::BTreeMap;
use std::sync::mpsc::sync_channel;

/// File, axis that is up, transfer function, edge of the picture, and frames to time.
type Scene = (&'static str, &'static str, &'static str, u32, u32);

const SCENES: [Scene; 4] = [
    ("mri256.nrrd", "-y", "peer-semi", 1024, 36),
    ("mri256.nrrd", "-y", "peer-opaque", 512, 240),
    ("mouse_skull.nrrd", "+z", "peer-skull", 512, 240),
    ("aneurism.nrrd", "+z", "peer-vessels", 512, 240),
];

/// Frames that are not timed: reading, cutting the volume into bricks and the first views.
const WARM: u32 = 12;

/// Returns a run of `frames` frames, a degree apart, as PNGs into a folder.
fn run(tf: &str, edge: u32, frames: u32, folder: &Path) -> Run {
    let turn = Turntable { frames, step: 1.0, ..Turntable::default() };
    let path = ViewPath::from_turntable([edge, edge], turn);
    let mut request = RenderRequest::for_preset(path, tf).expect("a request");
    request.hashed = false;
    let args = OutputArgs {
        output: Some(folder.to_path_buf()),
        format: None,
        fps: None,
        contact_sheet: None,
        force: true,
        figure: Figure::default(),
    };
    let looked = Output::look(&args, "frame", &request, &[]);
    Run::bare(request, looked.expect("a folder").0, true)
}

/// Statistics of a frame as a master gives them.
async fn told(run: &mut Run, volume: Arc<Volume>, orientation: Orientation) -> Box<FrameStats> {
    let crew = WorkerGroup::new(1, None).expect("a crew");
    let cluster = Cluster::start(volume, orientation, crew, None).expect("a cluster");
    let handle = cluster.handle();
    let message = run.request(&cluster.volume().info);
    let mut source = embedded::submit(&handle, &run.request, message).await.expect("a job");
    loop {
        match source.updates.recv().await.expect("a frame").expect("no trouble") {
            Update::Frame { stats, .. } => {
                source.cancel.now().await;
                cluster.end().await;
                return stats.expect("statistics");
            }
            Update::Step(_) => {}
            Update::FrameFailed { .. } | Update::Done => panic!("no frame came"),
        }
    }
}

/// Threads that share the tiles of one frame after the other. Another encodes what is drawn
/// meanwhile, and what comes out is written as `render` does, with the provenance of a frame of
/// which all else is `told`.
async fn plain(
    mut run: Run,
    volume: Arc<Volume>,
    orientation: Orientation,
    (threads, told): (usize, Box<FrameStats>),
) -> Result<(), Fail> {
    let info = volume.info(volume.digest());
    let recipe = run.ready(&info, orientation, volume.anatomical)?;
    let stage = PathScenes::new(&volume, &info, &run.request, orientation)?;
    let (to, updates) = mpsc::channel(1);
    let (drawn, pictures) = sync_channel::<(Picture, Digest32)>(1);
    let (frames, background) = (run.request.path.frames(), run.request.background);
    let format = run.output.takes(1, background);
    let draw = std::thread::spawn(move || {
        for i in 0..frames {
            let frame = stage.frame(i).expect("a frame");
            let view = view_sha256(&stage.spec(i), &frame.view);
            let cut = Cut { tile: 64, ..Cut::on(threads) };
            let picture = slabcast_session::direct::draw(&frame, &stage.bricks, cut);
            if drawn.send((picture, view)).is_err() {
                return;
            }
        }
    });
    let encode = std::thread::spawn(move || {
        for (number, (picture, view)) in (0..).zip(pictures) {
            let bytes = picture.encode(format, background).into();
            let frame = Frame { number, size: picture.size, format, bytes };
            let facts =
                FrameStats { frame: number, view_sha256: view.to_string(), ..(*told).clone() };
            let (stats_json, trace_json) = (String::new(), String::new());
            let update =
                Update::Frame { frame, stats: Some(Box::new(facts)), stats_json, trace_json };
            if to.blocking_send(Ok(update)).is_err() {
                return;
            }
        }
        let _ = to.blocking_send(Ok(Update::Done));
    });
    let source = Source { updates, cancel: Cancel::none(), framing: None };
    let done = run.go(source, "", (&info, orientation), &recipe).await;
    for thread in [draw, encode] {
        thread.join().expect("a thread that draws or encodes");
    }
    done
}

/// Measures ms from frame to frame by threads alone and by a master and a worker, in turn.
#[test]
#[ignore = "measures; cargo test --release -p slabcast --bin slabcast what_a_master -- --ignored --nocapture"]
fn what_a_master_in_the_process_takes() {
    let threads = slabcast_session::machine::cores();
    for (file, axis, tf, edge, frames) in SCENES {
        let Some((volume, orientation)) = slabcast_session::testing::data_volume(file, axis) else {
            continue;
        };
        let volume = Arc::new(volume);
        let runtime = runtime::start_embedded().expect("a runtime");
        let folder = tempfile::tempdir().expect("a folder");
        let mut one = run(tf, edge, 1, folder.path());
        let told = runtime.block_on(told(&mut one, volume.clone(), orientation));
        runtime::end(runtime);
        let timed = |frames: u32, with_master: bool| {
            let folder = tempfile::tempdir().expect("a folder");
            let run = run(tf, edge, frames, folder.path());
            let volume = volume.clone();
            let runtime = runtime::start_embedded().expect("a runtime");
            let began = Instant::now();
            let done = match with_master {
                true => {
                    let crew = WorkerGroup::new(1, Some(threads)).expect("a crew");
                    runtime.block_on(embedded(
                        run,
                        Arc::new(MemorySource::of(volume)),
                        orientation,
                        crew,
                        None,
                    ))
                }
                false => {
                    let how = (threads as usize, told.clone());
                    runtime.block_on(plain(run, volume, orientation, how))
                }
            };
            let took = began.elapsed().as_secs_f64() * 1e3;
            runtime::end(runtime);
            done.expect("pictures");
            let files = std::fs::read_dir(folder.path()).expect("a folder").flatten();
            let read =
                |f: std::fs::DirEntry| (f.file_name(), std::fs::read(f.path()).expect("a file"));
            let files: BTreeMap<_, _> = files.map(read).collect();
            assert_eq!(files.len(), frames as usize);
            (took, files)
        };
        let each = |with_master: bool| {
            let (start, _) = timed(WARM, with_master);
            let (all, files) = timed(WARM + frames, with_master);
            ((all - start) / f64::from(frames), files)
        };
        let mut ratios = Vec::new();
        for _ in 0..5 {
            let ((alone, theirs), (cluster, ours)) = (each(false), each(true));
            assert!(theirs == ours, "the same files to the byte");
            ratios.push(cluster / alone);
            println!(
                "{tf} at {edge}, {threads} threads: {alone:.2} ms, with a master {cluster:.2}"
            );
        }
        ratios.sort_by(f64::total_cmp);
        println!("{tf} at {edge}: {:.3} times, median of {ratios:.2?}", ratios[2]);
    }
}
