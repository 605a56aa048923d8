//! `slabcast lab check colour-rule`: error, popping and time by compositing rule and sheet
//! thickness.
//!
//! Whole frames of one view by each rule in sheets of several thicknesses: error against the limit,
//! time, and how much the picture *pops* when its sheets move. The sheet grid depends on the
//! target's depth (docs/design/contracts.md, World and camera). So a target that moves along the
//! view axis, with the eye where it was, moves the sheets through the volume and nothing else; what
//! then changes in the picture is seen as flicker on a slow path.

use super::case::number;
use super::shot::with_precise_sums;
use slabcast_common::image::{Background, Picture};
use slabcast_common::quality::{Compositing, Quality, Work};
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_render::judge::reference::{ErrorFigures, Reference, stratified};
use slabcast_render::{Frame, Scene};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::{Fail, say};
use slabcast_session::path_scenes::SceneBricks;
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::{OpenedVolume, ThreadArgs, VolumeSceneArgs};
use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

/// Compares linear, constant and the paper's compositing at four thicknesses: error, popping and
/// time of whole frames.
///
/// Draws the first view of the path by each rule in sheets of 2, 1, 1/2 and 1/4 vox. Errors are
/// against the limit (a reference in double precision, at a stratified sample of pixels), in
/// 1/255; the paper's rule has a limit of its own too. Popping is the RMSE between frames whose
/// sheets lie half a sheet apart.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab check colour-rule brain.nii.gz
  slabcast lab check colour-rule head.nrrd --up=-y --tf peer-opaque --azimuth 20 --times
  slabcast lab check colour-rule head.nrrd --eps 0 --json")]
pub(crate) struct ColourRuleArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Pixels to compare with the reference; all of them if there are no more
    #[arg(long, value_name = "N", default_value = "8192",
          value_parser = clap::value_parser!(u32).range(1..=1 << 26))]
    pixels: u32,
    /// Steps in which the sheets move by one sheet; an even number
    #[arg(long, value_name = "N", default_value = "8", value_parser = even)]
    steps: u32,
    /// Draw on one thread and say how long a frame takes: the median of all steps. Other work on
    /// the machine shows. All else is drawn on --threads
    #[arg(long)]
    times: bool,
    #[command(flatten)]
    threads: ThreadArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

fn even(text: &str) -> Result<u32, String> {
    match text.parse() {
        Ok(n) if (2..=256).contains(&n) && n % 2 == 0 => Ok(n),
        _ => Err("give an even number from 2 to 256".into()),
    }
}

/// The rules and thicknesses that are compared.
const RULES: [(&str, Compositing); 3] = [
    ("linear", Compositing::Linear),
    ("constant", Compositing::Constant),
    ("paper", Compositing::Paper),
];
const THICKNESSES: [f64; 4] = [2.0, 1.0, 0.5, 0.25];

/// Figures of one rule and thickness.
struct Line {
    rule: &'static str,
    thickness: f64,
    /// ReferenceKind the limit.
    limit: ErrorFigures,
    /// ReferenceKind the limit of the rule itself, where that is another.
    own: Option<ErrorFigures>,
    /// Root of the mean square over all pairs of frames half a sheet apart; the largest.
    pop: f64,
    pop_max: f64,
    /// Popping between frames one step apart.
    step: f64,
    /// Time of a frame on one thread.
    ms: Option<f64>,
}

/// Runs the command.
pub(crate) fn run(args: &ColourRuleArgs) -> Result<(), Fail> {
    let mut request = args.of.request_before(Work::default())?;
    let given = Quality::before();
    for (flag, given) in [
        ("thickness", request.quality.thickness != given.thickness),
        ("compositing", request.quality.compositing != given.compositing),
    ] {
        if given {
            return Err(Fail::usage(format!("--{flag}: is what is compared; leave it out")));
        }
    }
    let threads = args.threads.count();
    let OpenedVolume { volume, info, orientation } = args.of.open(&mut request)?;
    let transfer = request.transfer.function(&info).map_err(|e| request.blame(&e))?;
    let camera =
        request.path.camera(0, &info.lattice, orientation).map_err(|e| request.blame(&e))?;
    let size = request.path.size;
    let view = |camera: &Camera, quality: &Quality| {
        View::new(&info.lattice, camera, size, quality).map_err(|e| request.blame(&e))
    };

    let mut progress = Progress::new(args.json).counting("pixel");
    let sample = stratified(size, args.pixels as usize, 1);
    progress.frames(2 * sample.len() as u64, &format!("{} pixels of the reference", sample.len()));
    let mut limits = Vec::new();
    for (_, compositing) in [RULES[0], RULES[2]] {
        let quality = Quality { compositing, ..request.quality };
        let drawn = SceneBricks::new(
            &volume,
            &info,
            &transfer,
            with_precise_sums(quality, &transfer, &info),
        )?;
        let reference = Reference::new(&drawn.spec, view(&camera, &quality)?, &drawn.bricks);
        let reference = reference.with_sheet_payloads();
        let told = (&mut progress, limits.len() * sample.len());
        limits.push(direct::map_pixels(&sample, threads, told, |[x, y]| reference.pixel(x, y)));
    }
    progress.end();

    let frames = RULES.len() * THICKNESSES.len();
    let mut progress = Progress::new(args.json).counting("rule and thickness");
    progress.frames(frames as u64, &format!("{} frames each", args.steps));
    let mut lines = Vec::new();
    for (rule, compositing) in RULES {
        for thickness in THICKNESSES {
            let quality = Quality { compositing, thickness, ..request.quality };
            let drawn = SceneBricks::new(
                &volume,
                &info,
                &transfer,
                with_precise_sums(quality, &transfer, &info),
            )?;
            let scene = Arc::new(Scene::new(&drawn.spec));
            let cut = Cut::on(if args.times { 1 } else { threads });
            let (mut pictures, mut times) = (Vec::new(), Vec::new());
            for step in 0..args.steps {
                let by = thickness * info.lattice.vox() * f64::from(step) / f64::from(args.steps);
                let view = view(&nearer(&camera, by), &drawn.spec.quality)?;
                let began = Instant::now();
                pictures.push(direct::draw(&Frame::new(scene.clone(), view), &drawn.bricks, cut));
                times.push(began.elapsed().as_secs_f64() * 1e3);
            }
            times.sort_by(f64::total_cmp);
            let got: Vec<[f32; 4]> = sample
                .iter()
                .map(|[x, y]| pictures[0].pixels[(y * size[0] + x) as usize])
                .collect();
            let compare = |want| ErrorFigures::compare(&got, want, request.background);
            let (pop, pop_max) = apart(&pictures, pictures.len() / 2);
            lines.push(Line {
                rule,
                thickness,
                limit: compare(&limits[0]),
                own: (compositing == Compositing::Paper).then(|| compare(&limits[1])),
                pop,
                pop_max,
                step: apart(&pictures, 1).0,
                ms: args.times.then(|| times[times.len() / 2]),
            });
            let done = lines.len() as u64;
            progress.step(progress::Step { frames: done, ..Default::default() });
        }
    }
    progress.end();
    say(&if args.json { json(&lines) } else { text(&lines) })
}

/// The camera with its target nearer by `by` world units and its eye where it was.
fn nearer(camera: &Camera, by: f64) -> Camera {
    let projection = match camera.projection {
        CameraProjection::Persp { fov, distance } => {
            CameraProjection::Persp { fov, distance: distance - by }
        }
        ortho @ CameraProjection::Ortho { .. } => ortho,
    };
    let target = camera.target + camera.to_eye * (by / camera.to_eye.length());
    Camera { target, projection, ..*camera }
}

/// RMSE and largest difference, in 1/255, over all pairs of frames `steps` apart.
fn apart(pictures: &[Picture], steps: usize) -> (f64, f64) {
    let (mut squares, mut n, mut max) = (0.0, 0usize, 0.0f64);
    for pair in pictures.windows(steps + 1) {
        let want: Vec<[f64; 4]> = pair[steps].pixels.iter().map(|p| p.map(f64::from)).collect();
        let black = Background::Colour([0.0; 3]);
        let f = ErrorFigures::compare(&pair[0].pixels, &want, black);
        squares += f.rmse * f.rmse * f.n_pixels as f64;
        n += f.n_pixels;
        max = max.max(f.max);
    }
    ((squares / n.max(1) as f64).sqrt(), max)
}

fn text(lines: &[Line]) -> String {
    let mut out = String::from(
        "in 1/255                   RMSE      max   own RMSE  own max      pop  pop max     step   ms\n",
    );
    for l in lines {
        let own = |f: fn(&ErrorFigures) -> f64| {
            l.own.as_ref().map_or_else(|| "-".into(), |e| number(f(e)))
        };
        let ms = l.ms.map_or_else(|| "-".into(), |ms| format!("{ms:.0}"));
        let _ = writeln!(
            out,
            "{:<9} {:>6} vox {:>10} {:>8} {:>10} {:>8} {:>8} {:>8} {:>8} {:>4}",
            l.rule,
            l.thickness,
            number(l.limit.rmse),
            number(l.limit.max),
            own(|e| e.rmse),
            own(|e| e.max),
            number(l.pop),
            number(l.pop_max),
            number(l.step),
            ms,
        );
    }
    let pixels = lines.first().map_or(0, |l| l.limit.n_pixels);
    let _ = writeln!(
        out,
        "RMSE, max: against the limit, {pixels} pixels that are not blank. own: against the rule's \
         own limit.\npop: between frames half a sheet apart; step: one step apart. ms: a frame on \
         one thread (--times)"
    );
    out
}

fn json(lines: &[Line]) -> String {
    let figures = |f: &ErrorFigures| {
        serde_json::json!({ "rmse": f.rmse, "max": f.max, "share_above_1": f.share_above_1,
            "rmse_srgb8": f.rmse_srgb8, "pixels": f.n_pixels })
    };
    lines.iter().fold(String::new(), |all, l| {
        let line = serde_json::json!({
            "rule": l.rule, "thickness": l.thickness, "limit": figures(&l.limit),
            "own_limit": l.own.as_ref().map(figures), "pop": l.pop, "pop_max": l.pop_max,
            "step": l.step, "ms": l.ms
        });
        format!("{all}{line}\n")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn moving_the_target_keeps_the_eye() {
        let projection = CameraProjection::Persp { fov: 30.0, distance: 10.0 };
        let to_eye = DVec3::new(0.0, 0.0, 5.0);
        let camera = Camera { to_eye, up: DVec3::Y, target: DVec3::ONE, projection };
        let moved = nearer(&camera, 0.5);
        assert_eq!(moved.target, DVec3::new(1.0, 1.0, 1.5));
        assert_eq!(moved.projection, CameraProjection::Persp { fov: 30.0, distance: 9.5 });
    }

    #[test]
    fn popping_compares_frames_half_a_sheet_apart() {
        let picture = |v: f32| Picture { size: [2, 1], pixels: vec![[v; 4], [0.0; 4]] };
        let pictures = [0.2, 0.4, 0.4, 0.4].map(picture);
        let (pop, max) = apart(&pictures, 2);
        let off = 255.0 * 0.2f32 as f64;
        assert!((pop - off / 2f64.sqrt()).abs() < 1e-4 && (max - off).abs() < 1e-4);
    }
}
