//! `slabcast lab error`: measures the error of a picture and the share of each source.
//!
//! The truth is the reference (a gather in f64 along true rays, which shares nothing with the
//! splatter) at a stratified sample of pixels, or at all. Each row of the table compares two
//! pictures that differ in one source of error alone.
//!
//! There are two kinds of sources. Thickness, cut-off, slivers, quantisation and rounding lie
//! between the picture and the limit, and add up to its error. Truncation and ripple lie between
//! the limit and an ideal. They are errors of the model, no part of the sum, and depend on the
//! kernel only.
//!
//! `report` prints the result as text or JSON, `map` draws it.

mod map;
mod report;

use crate::single_frame::SingleFrame;
use slabcast_common::image::Picture;
use slabcast_common::quality::{Classify, Quality, Sums};
use slabcast_render::judge::reference::{ErrorFigures, SheetOptions, stratified};
use slabcast_session::direct;
use slabcast_session::fail::{Fail, say};
use slabcast_session::parse::Pixels;
use slabcast_session::progress::Progress;
use slabcast_session::request::{ThreadArgs, VolumeSceneArgs};
use slabcast_session::{parse, signals};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Tolerance of the reference for truncation and ripple, 100 times the judge's own. It halves the
/// kernel values for errors of some 0.001/255, where truncation and ripple begin at 0.01.
const MODEL_TOLERANCE: f64 = 1e-5;

/// Measures how far a picture is from the truth.
///
/// Prints the error in 1/255 and the share of each source.
///
/// The first view of the path is rendered and compared, at a stratified sample of pixels, with a
/// reference that integrates along true rays in double precision. Errors are of linear
/// premultiplied RGBA over the pixels where either is not blank; the last column is the RMSE of
/// the 8-bit sRGB pictures.
///
/// Between the picture and the limit of infinitely thin sheets lie thickness, cut-off (--eps),
/// slivers (of kernels, which the sheet beside theirs gets), quantisation (sums of integers; in 16
/// bits with their slivers) and rounding (of positions, and f32 arithmetic). Between the limit and
/// an ideal lie two errors of the model, which are no part of that sum: truncation (the limit with
/// the whole Gaussian, neither cut at the radius nor lowered by its edge value) and ripple (the
/// limit of a field in which a constant comes back constant). With --level the limit is that of all
/// detail, and the level is a source of its own.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab error brain.nii.gz
  slabcast lab error brain.nii.gz --tf peer-semi --thickness 0.5 --azimuth 30
  slabcast lab error brain.nii.gz --map error.png                  where it is, cell by cell
  slabcast lab error brain.nii.gz --map error.png --pixels all     pixel by pixel (minutes)
  slabcast lab error brain.nii.gz --compositing paper --pixels 16384 --json

JSON: one object. Each of limit, same_thickness, level (of a coarser one), thickness, cutoff, slivers, quantisation, rounding,
rounding_positions, rounding_arithmetic, truncation and ripple is {rmse, max, most_999,
share_above_1, rmse_srgb8, pixels}: 1/255 (most_999 is kept by 99.9 % of the pixels), the share from
0 to 1, and the pixels that are not blank; what is not finite is null. sum: {squares, plain,
measured}, of thickness to rounding against limit. sampled and sampled_model: pixels looked at,
blank ones included, for the sum and for truncation and ripple. size; pixels_sha256 of the picture; quality; draw_ms, judge_ms, total_ms; map: the file,
if any.")]
pub struct ErrorArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Pixels to compare, one at random in each of as many cells; or all
    #[arg(long, value_name = "N|all", default_value = "4096", value_parser = parse::pixels)]
    pixels: Pixels,
    /// Pixels at which truncation and ripple are measured, at most as many as --pixels. The
    /// whole Gaussian meets seven times as many voxels, so these are fewer. Where little is
    /// translucent they are a rough estimate: truncation is large on silhouettes alone
    #[arg(long, value_name = "N|all", default_value = "512", value_parser = parse::pixels)]
    model_pixels: Pixels,
    /// Seed of the sample of pixels
    #[arg(long, value_name = "N", default_value = "1")]
    seed: u64,
    /// Writes the picture and, beside it, where its error is: in colours from 0.01 to 10 of 1/255
    /// (blank pixels grey), each cell of the sample as one block
    #[arg(long, value_name = "FILE.png", value_parser = parse::png)]
    map: Option<PathBuf>,
    #[command(flatten)]
    threads: ThreadArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// One comparison of two pictures: a row of the table.
struct Row {
    name: &'static str,
    what: &'static str,
    figures: ErrorFigures,
}

/// Result of the command.
struct ErrorResult {
    scene: SingleFrame,
    picture: Picture,
    /// Coordinates of the pixels compared, and the limit at each.
    sample: Vec<[u32; 2]>,
    limit: Vec<[f64; 4]>,
    /// Errors against the limit, and against sheets of the same thickness.
    whole: Vec<Row>,
    /// Sources of error between picture and limit, which add up to the error against the limit.
    sources: Vec<Row>,
    /// The two parts of rounding; none where values are classified after reconstruction.
    rounding: Vec<Row>,
    /// Errors of the model, between the limit and an ideal; none where values are classified after
    /// reconstruction.
    model: Vec<Row>,
    /// Number of pixels compared for `model`.
    sampled_model: usize,
    drawn: Duration,
    judged: Duration,
    total: Duration,
}

/// Runs `slabcast lab error`: prints the table, or JSON with `--json`, and writes the map.
///
/// # Errors
/// The arguments or the volume are refused, the map can't be written, or the user stopped it.
pub fn run(args: &ErrorArgs) -> Result<(), Fail> {
    if let Some(map) = &args.map {
        map::check(map, &args.of.volume)?;
    }
    let result = {
        let args = args.clone();
        signals::run_unless_stopped(move || measure(&args))?
    };
    if let Some(path) = &args.map {
        map::write(path, &result)?;
    }
    say(&if args.json {
        report::json(&result, args.map.as_deref())
    } else {
        report::text(&result)
    })?;
    match &args.map {
        Some(path) if !args.json => say(&map::caption(path, &result)),
        _ => Ok(()),
    }
}

/// Returns whether any pixel was shut, by its final opacity, since opacity never falls.
fn any_shut(picture: &Picture, eps: f64) -> bool {
    picture.pixels.iter().any(|p| 1.0 - p[3] < eps as f32)
}

fn measure(args: &ErrorArgs) -> Result<ErrorResult, Fail> {
    let threads = args.threads.count();
    let scene = SingleFrame::read(&args.of, threads, |_| Ok(()))?;
    let detailed = scene.in_all_detail(&args.of)?;
    let classify = scene.spec.quality.classify;
    let mut result = match classify {
        Classify::Before => measure_before(args, scene, threads),
        Classify::After => measure_after(args, scene, threads),
    }?;
    if let Some(detailed) = detailed {
        add_level(&mut result, &detailed, threads);
    }
    Ok(result)
}

/// Adds the error of a coarser level to a result that was measured against the level's own limit.
/// The error is the difference of the limits of the level and of level 0; the latter becomes the
/// truth.
fn add_level(result: &mut ErrorResult, detailed: &SingleFrame, threads: usize) {
    let mut progress = Progress::new(false).counting("pixel");
    let pixels = format!("{} pixels of level 0", result.sample.len());
    progress.frames(result.sample.len() as u64, &pixels);
    let reference = detailed.reference();
    let (sample, judging) = (&result.sample, Instant::now());
    let truth =
        direct::map_pixels(sample, threads, (&mut progress, 0), |[x, y]| reference.pixel(x, y));
    progress.end();
    let width = result.picture.size[0] as usize;
    let pixel = |&[x, y]: &[u32; 2]| result.picture.pixels[y as usize * width + x as usize];
    let got: Vec<[f32; 4]> = sample.iter().map(pixel).collect();
    let own: Vec<[f32; 4]> = result.limit.iter().map(|c| c.map(|x| x as f32)).collect();
    let background = result.scene.background;
    let row = |name, what, got: &[[f32; 4]]| Row {
        name,
        what,
        figures: ErrorFigures::compare(got, &truth, background),
    };
    let whole = row("limit", "against the limit in all detail: all of it", &got);
    let level = row("level", "the limit at this level, against all detail", &own);
    result.whole[0] = whole;
    result.sources.insert(0, level);
    result.judged += judging.elapsed();
    result.total += judging.elapsed();
    result.limit = truth;
}

/// Thickness of the picture's sheets over that of the sheets which its planes are compared with.
const THIN: f64 = 4.0;

/// Compares a picture of reconstructed values: cut-off and quantisation by pictures without them,
/// planes by thinner ones, and all else by the limit.
fn measure_after(
    args: &ErrorArgs,
    scene: SingleFrame,
    threads: usize,
) -> Result<ErrorResult, Fail> {
    let size = scene.view.size;
    let mut progress = Progress::new(false).counting("pixel");
    let began = Instant::now();
    progress.phase("drawing");
    let quality = scene.spec.quality;
    let picture = scene.draw(quality, threads);
    let drawn = began.elapsed();
    let opened = any_shut(&picture, quality.eps)
        .then(|| scene.draw(Quality { eps: 0.0, ..quality }, threads));
    let opened = opened.as_ref().unwrap_or(&picture);
    let long = Quality { eps: 0.0, sums: Sums::I32, ..quality };
    let longs = (quality.sums != Sums::I32).then(|| scene.draw(long, threads));
    let longs = longs.as_ref().unwrap_or(opened);
    let thickness = (quality.thickness / THIN).max(1.0 / 64.0);
    let thin = scene.draw_thick(Quality { thickness, ..long }, threads);

    let sample = stratified(size, args.pixels.count(size), args.seed);
    progress.frames(sample.len() as u64, &format!("{} pixels of the reference", sample.len()));
    let reference = scene.reference();
    let judging = Instant::now();
    let limit =
        direct::map_pixels(&sample, threads, (&mut progress, 0), |[x, y]| reference.pixel(x, y));
    let judged = judging.elapsed();
    progress.end();

    let sampled = |p: &Picture| -> Vec<[f32; 4]> {
        sample.iter().map(|&[x, y]| p.pixels[y as usize * size[0] as usize + x as usize]).collect()
    };
    let widen = |p: &[[f32; 4]]| -> Vec<[f64; 4]> { p.iter().map(|c| c.map(f64::from)).collect() };
    let row = |name, what, got: &[[f32; 4]], want: &[[f64; 4]]| Row {
        name,
        what,
        figures: ErrorFigures::compare(got, want, scene.background),
    };
    let (got, opened, longs, thin) =
        (sampled(&picture), sampled(opened), sampled(longs), sampled(&thin));
    Ok(ErrorResult {
        whole: vec![row("limit", "against the limit: all of it", &got, &limit)],
        sources: vec![
            row("thickness", "planes against planes of a quarter", &longs, &widen(&thin)),
            row("cutoff", "pixels shut before they are opaque", &got, &widen(&opened)),
            row("quantisation", "sums of integers", &opened, &widen(&longs)),
            row("ripple", "of kernel sums, and rounding of positions", &thin, &limit),
        ],
        rounding: Vec::new(),
        model: Vec::new(),
        sampled_model: 0,
        total: began.elapsed(),
        scene,
        picture,
        sample,
        limit,
        drawn,
        judged,
    })
}

/// Compares a picture of voxels that were classified before they were splatted.
fn measure_before(
    args: &ErrorArgs,
    scene: SingleFrame,
    threads: usize,
) -> Result<ErrorResult, Fail> {
    let size = scene.view.size;

    let mut progress = Progress::new(false).counting("pixel");
    let began = Instant::now();
    progress.phase("drawing");
    let quality = scene.spec.quality;
    let picture = scene.draw(quality, threads);
    let drawn = began.elapsed();
    // Pictures that cannot differ are drawn once.
    let open = Quality { eps: 0.0, ..quality };
    let floats = Quality { sums: Sums::F32, ..open };
    let opened = any_shut(&picture, quality.eps).then(|| scene.draw_open(threads));
    let opened = opened.as_ref().unwrap_or(&picture);
    // With eps 0, sums of 32 bits move no sliver to the next sheet.
    let entire = (open != quality && quality.sums == Sums::I32).then(|| scene.draw(open, threads));
    let entire = entire.as_ref().unwrap_or(opened);
    let floated = (floats != open).then(|| scene.draw(floats, threads));
    let floated = floated.as_ref().unwrap_or(entire);

    let sample = stratified(size, args.pixels.count(size), args.seed);
    let model = stratified(size, sample.len().min(args.model_pixels.count(size)), args.seed);
    let all = (sample.len() + model.len()) as u64;
    progress.frames(all, &format!("{} pixels of the reference", sample.len()));
    let reference = scene.reference();
    let judging = Instant::now();
    let rounded = SheetOptions { rounded: true, ..SheetOptions::default() };
    let truth = direct::map_pixels(&sample, threads, (&mut progress, 0), |[x, y]| {
        let limit = reference.pixel(x, y);
        [limit, reference.at_same_thickness(x, y), reference.by_sheets(x, y, rounded)]
    });
    let judge = || scene.reference().with_tolerance(MODEL_TOLERANCE);
    let (limit, whole, level) = (judge(), judge().without_truncation(), judge().without_ripple());
    let ideals = direct::map_pixels(&model, threads, (&mut progress, sample.len()), |[x, y]| {
        [limit.pixel(x, y), whole.pixel(x, y), level.pixel(x, y)]
    });
    let judged = judging.elapsed();
    progress.end();

    let plane =
        |all: &[[[f64; 4]; 3]], i: usize| -> Vec<[f64; 4]> { all.iter().map(|t| t[i]).collect() };
    let [limit, sheets, rounded] = [0, 1, 2].map(|i| plane(&truth, i));
    let [model_limit, whole_kernel, level] = [0, 1, 2].map(|i| plane(&ideals, i));
    let sampled = |p: &Picture| -> Vec<[f32; 4]> {
        sample.iter().map(|&[x, y]| p.pixels[y as usize * size[0] as usize + x as usize]).collect()
    };
    let narrow =
        |p: &[[f64; 4]]| -> Vec<[f32; 4]> { p.iter().map(|c| c.map(|x| x as f32)).collect() };
    let widen = |p: &[[f32; 4]]| -> Vec<[f64; 4]> { p.iter().map(|c| c.map(f64::from)).collect() };
    let row = |name, what, got: &[[f32; 4]], want: &[[f64; 4]]| Row {
        name,
        what,
        figures: ErrorFigures::compare(got, want, scene.background),
    };
    let (got, opened, entire, floated) =
        (sampled(&picture), sampled(opened), sampled(entire), sampled(floated));
    let result = ErrorResult {
        whole: vec![
            row("limit", "against the limit: all of it", &got, &limit),
            row("same_thickness", "against the same sheets in f64, nothing shut", &got, &sheets),
        ],
        sources: vec![
            row("thickness", "sheets of finite thickness", &narrow(&sheets), &limit),
            row("cutoff", "pixels shut before they are opaque", &got, &widen(&opened)),
            row("slivers", "of kernels, in the sheet beside theirs", &opened, &widen(&entire)),
            row("quantisation", "sums of integers", &entire, &widen(&floated)),
            row("rounding", "of positions and in f32", &floated, &sheets),
        ],
        rounding: vec![
            row("rounding_positions", "of which subpixels and phases", &narrow(&rounded), &sheets),
            row("rounding_arithmetic", "of which f32 and its tables", &floated, &rounded),
        ],
        model: vec![
            row("truncation", "the kernel's cut", &narrow(&model_limit), &whole_kernel),
            row("ripple", "a constant field is not constant", &narrow(&model_limit), &level),
        ],
        sampled_model: model.len(),
        total: began.elapsed(),
        scene,
        picture,
        sample,
        limit,
        drawn,
        judged,
    };
    Ok(result)
}
