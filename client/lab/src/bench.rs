//! `slabcast lab bench`: times frames in this process, without a cluster.
//!
//! The time of a frame runs from camera set to picture in memory: tables, projection of bricks,
//! rendering, compositing. It excludes reading and bricking the volume and writing pictures. The
//! first view warms up and is left out. All views differ, so that only what a worker keeps, too, is
//! kept from one to the next.

use crate::autotune::choose::settle;
use slabcast_common::message::Counters;
use slabcast_common::quality::{Classify, Work};
use slabcast_render::Frame;
use slabcast_render::Simd;
use slabcast_render::judge::reference::{ErrorFigures, Reference, stratified};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::{Fail, say};
use slabcast_session::magnify::magnified;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::{KeepArgs, OpenedVolume, ThreadArgs, VolumeSceneArgs};
use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

/// Times the frames of a view path in this process.
///
/// Prints time, voxel counts and error of one run.
///
/// The time of a frame runs from camera set to picture in memory. The first view warms up and is
/// left out. The error is that of the middle view, measured as by `slabcast lab error`.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab bench brain.nii.gz --threads 1
  slabcast lab bench brain.nii.gz --tf peer-semi --size 1024x1024 --projection persp --json")]
pub struct BenchArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    #[command(flatten)]
    threads: ThreadArgs,
    #[command(flatten)]
    keep: KeepArgs,
    /// Edge of the tiles that threads share, in pixels
    #[arg(long, value_name = "N", default_value = "64",
          value_parser = clap::value_parser!(u32).range(16..=256))]
    tile: u32,
    /// Pixels of the middle view to compare with the reference; 0 for none
    #[arg(long, value_name = "N", default_value = "1024",
          value_parser = clap::value_parser!(u32).range(0..=1 << 26))]
    pixels: u32,
    /// Seed of the sample of pixels
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast lab bench`: prints times, counts and error, or JSON with `--json`.
///
/// # Errors
/// The arguments or the volume are refused, or no setting meets `--error` or `--budget`.
pub fn run(args: &BenchArgs) -> Result<(), Fail> {
    let work = Work { keep: args.keep.keep(), ..Work::default() };
    let mut request = args.of.request_with_target(work)?;
    let threads = args.threads.count();
    let OpenedVolume { volume, info, orientation } = args.of.open(&mut request)?;
    let volume = Arc::new(volume);
    settle(&volume, &info, &mut request, orientation, threads)?;
    let scenes = PathScenes::new(&volume, &info, &request, orientation)?;
    // Errors are against all detail.
    let detailed = if scenes.level() > info.level && args.pixels > 0 {
        let request = request.in_all_detail();
        Some(PathScenes::new(&volume, &info, &request, orientation)?)
    } else {
        None
    };
    let detailed = detailed.as_ref().unwrap_or(&scenes);
    let bricks = &scenes.bricks;
    drop(volume);
    let cut = Cut { threads, tile: args.tile, slabs: 1 };
    let views = request.path.frames();
    let mut progress = Progress::new(false).counting("frame");
    progress.frames(views as u64, &format!("{views} views"));
    let (mut each, mut counters, mut middle) = (Vec::new(), Counters::default(), None);
    let (mut sha256, mut adds) = (String::new(), None);
    for i in 0..views {
        let (view, scene) = (scenes.view(i, &request.quality)?, scenes.scene(i));
        let began = Instant::now();
        let frame = Frame::new(scene, view);
        let (picture, counted) = direct::draw_counted(&frame, bricks, cut);
        let picture = magnified(picture, request.magnify, threads);
        let took = began.elapsed().as_secs_f64() * 1e3;
        each.push(took);
        if i > 0 || views == 1 {
            counters += counted;
        }
        if i == views / 2 {
            sha256 = picture.sha256().to_string();
            adds = frame.footprint_cost();
            middle = Some((detailed.view_at_size(i, &request.quality, request.size())?, picture));
        }
        progress.step(progress::Step { frames: i as u64 + 1, ..Default::default() });
    }
    progress.end();
    let quality = scenes.spec(views / 2).quality;
    let mut ms = each[usize::from(views > 1)..].to_vec();
    ms.sort_by(f64::total_cmp);
    let n = ms.len() as u64;
    let (median, least, most) = (ms[ms.len() / 2], ms[0], ms[ms.len() - 1]);
    let relevant: u64 = bricks.iter().map(|b| b.len() as u64).sum();
    let errors = middle.filter(|_| args.pixels > 0).map(|(view, picture)| {
        let sample = stratified(request.size(), args.pixels as usize, args.seed);
        let reference = Reference::new(&detailed.spec(views / 2), view, &detailed.bricks);
        let mut progress = Progress::new(false).counting("pixel");
        progress.frames(sample.len() as u64, "the reference");
        let after = quality.classify == Classify::After;
        let truth = direct::map_pixels(&sample, threads, (&mut progress, 0), |[x, y]| {
            // Planes of a field have no sheets to compare with, and another level has others.
            let same = (!after && scenes.level() == detailed.level())
                .then(|| reference.at_same_thickness(x, y));
            (reference.pixel(x, y), same)
        });
        progress.end();
        let (limit, same): (Vec<_>, Option<Vec<_>>) =
            (truth.iter().map(|t| t.0).collect(), truth.iter().map(|t| t.1).collect());
        let pixel = |p: &[u32; 2]| picture.pixels[(p[1] * request.size()[0] + p[0]) as usize];
        let got: Vec<_> = sample.iter().map(pixel).collect();
        let compare = |want: Vec<_>| ErrorFigures::compare(&got, &want, request.background);
        (compare(limit), same.map(compare))
    });
    let simd = Simd::detect().name();
    if args.json {
        let figures = |e: &ErrorFigures| serde_json::json!({ "rmse": e.rmse, "max": e.max, "most_999": e.most_999 });
        let json = serde_json::json!({
            "version": env!("CARGO_PKG_VERSION"),
            "pixels_version": slabcast_common::PIXELS_VERSION,
            "median_ms": median, "min_ms": least, "max_ms": most, "views": n,
            // In the order of the path, warm-up first: over several runs this tells a slow view
            // from a disturbed machine.
            "each_ms": each,
            "threads": threads, "tile": args.tile, "simd": simd, "size": request.size(),
            "magnify": request.magnify,
            "quality": quality, "level": scenes.level(), "relevant": relevant, "pixels_sha256": sha256,
            "tossed": counters.tossed / n, "splatted": counters.splatted / n,
            "culled": counters.culled / n,
            // Sums that each voxel adds to: pixels, and bytes of each. Null if voxels differ.
            "adds": adds.map(|adds| serde_json::json!({ "pixels": adds.pixels, "bytes": adds.bytes })),
            "limit": errors.as_ref().map(|e| figures(&e.0)),
            "same_thickness": errors.as_ref().and_then(|e| e.1.as_ref()).map(figures),
        });
        return say(&format!("{json}\n"));
    }
    let mut text = format!(
        "{median:.2} ms a frame: median of {n} views ({least:.2} to {most:.2}), {threads} {}, \
         {simd}, {} sums, level {}\n{relevant} relevant voxels; a frame tosses {}, splats {}, culls {}\n",
        if threads == 1 { "thread" } else { "threads" },
        format!("{:?}", quality.sums).to_lowercase(),
        scenes.level(),
        counters.tossed / n,
        counters.splatted / n,
        counters.culled / n,
    );
    if let Some((limit, same)) = errors {
        let _ = write!(
            text,
            "error of the middle view in 1/255: {:.3} (max {:.2}) against the limit",
            limit.rmse, limit.max
        );
        if let Some(same) = same {
            let _ = write!(text, ", {:.3} (max {:.2}) at the same thickness", same.rmse, same.max);
        }
        text.push('\n');
    }
    say(&text)
}
