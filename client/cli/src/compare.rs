//! `slabcast compare`: two volumes side by side under one look.
//!
//! One look is one transfer function, fitted to the first volume, and one scale. If both files say
//! where they lie, and they overlap, both are seen from the same place; else each is in the middle
//! of its half.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::quality::Work;
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_scene::path::{Fit, Framing, Orientation};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::{Fail, say};
use slabcast_session::figure::{Figure, Marker};
use slabcast_session::output::{self, Format, Frame, Grid};
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress;
use slabcast_session::request::{RenderRequest, SceneArgs, ThreadArgs, UsualTurn};
use slabcast_session::volume;
use slabcast_volumes::framing;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Most views, one below the other.
const MOST_VIEWS: usize = 24;
/// Largest edge of one of the pictures.
const LARGEST: u32 = 4096;

/// Draws two volumes side by side under one look.
///
/// --tf is fitted to A and used for both, and both are shown at one scale. Several --view's stand
/// below each other.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast compare before.nii.gz after.nii.gz
  slabcast compare a.nrrd b.nrrd --tf bone --view anterior,left --scale-bar -o both.png")]
pub(crate) struct CompareArgs {
    /// The first volume, to which --tf is fitted
    a: PathBuf,
    /// The second volume
    b: PathBuf,
    #[command(flatten)]
    input: volume::InputArgs,
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    threads: ThreadArgs,
    /// Picture to write: png, tif or jpg [default: compare.png, then compare-2.png]
    #[arg(short, long, value_name = "FILE", help_heading = "Output")]
    output: Option<PathBuf>,
    /// Replace a file that is there already
    #[arg(long, help_heading = "Output")]
    force: bool,
    #[command(flatten)]
    figure: Figure,
}

/// One of the two volumes.
struct Half {
    name: String,
    volume: Arc<Volume>,
    info: VolumeInfo,
    orientation: Orientation,
    request: RenderRequest,
    transfer: TransferFunction,
}

/// Runs the command.
pub(crate) fn run(args: &CompareArgs) -> Result<(), Fail> {
    let own = PathBuf::from("compare.png");
    let own = || if args.force { own.clone() } else { output::free_name(&own) };
    let path = args.output.clone().unwrap_or_else(own);
    let format = match output::named(&path)? {
        Some(format @ (Format::Png | Format::Tif | Format::Jpg)) => format,
        _ => {
            return Err(Fail::usage(format!(
                "-o: {}: a comparison is one picture; end its name in .png, .tif or .jpg",
                path.display()
            )));
        }
    };
    args.figure.check(false, true)?;
    let mut request = args.scene.request_with_turn(Work::default(), UsualTurn::full(1))?;
    request.level = args.input.level();
    if !request.target.is_empty() {
        return Err(Fail::usage(format!(
            "{}: both pictures are drawn in the quality that is given; leave it out",
            request.target.flags()
        )));
    }
    if request.path.frames() > MOST_VIEWS || request.size().iter().any(|edge| *edge > LARGEST) {
        return Err(Fail::usage(format!(
            "--frames, --size: a comparison has at most {MOST_VIEWS} views of {LARGEST}x{LARGEST} \
             pixels; give fewer or smaller ones"
        )));
    }
    if format == Format::Jpg && request.background == Background::Transparent {
        return Err(Fail::usage(
            "--background: a JPEG has no transparency; give a colour, or a name that ends in .png",
        ));
    }
    output::refuse_input(&path, "output", &[&args.a, &args.b])?;
    if path.exists() && !args.force {
        return Err(Fail::failed(format!(
            "{}: is there already; add --force to replace it, or give another file",
            path.display()
        )));
    }
    output::probe(&path)?;
    let mut halves = halves(args, request)?;
    frame(&mut halves)?;
    let behind = output::background_bytes(halves[0].request.background);
    let mut grid = Grid::new(Some(2), behind);
    let mut whole = None;
    let pixels = match halves[0].request.background {
        Background::Transparent => PixelFormat::Rgba8,
        Background::Colour(_) => PixelFormat::Rgb8,
    };
    for (i, half) in halves.iter().enumerate() {
        let stage = PathScenes::new(&half.volume, &half.info, &half.request, half.orientation)?;
        let request = &half.request;
        let path = request.path.clone();
        let (info, orientation) = (&half.info, half.orientation);
        let marker = Marker::new(&args.figure, request, path, info, orientation, true)?;
        for n in 0..request.path.frames() {
            let picture =
                direct::draw(&stage.frame(n)?, &stage.bricks, Cut::on(args.threads.count()));
            let mut bytes = picture.encode(pixels, request.background);
            let number = (n + request.path.first_frame()) as u64;
            if let Some(marker) = &marker {
                bytes = marker.draw(number, picture.size, pixels, bytes);
            }
            // View by view, the first volume at the left.
            let number = (2 * n + i) as u64;
            let frame = Frame { number, size: picture.size, format: pixels, bytes: bytes.into() };
            grid.add(frame, if n == 0 { &half.name } else { "" });
        }
        whole = whole.or(marker);
    }
    let (picture, _) = grid.draw(whole.as_ref());
    output::write_picture(&path, &picture, args.figure.dpi, format)?;
    say(&format!("{} beside {} in {}\n", halves[0].name, halves[1].name, path.display()))
}

/// Opens both volumes; the second has the look of the first.
fn halves(args: &CompareArgs, mut request: RenderRequest) -> Result<[Half; 2], Fail> {
    let stem = |path: &Path| {
        let name = path.file_name().map(|n| n.to_string_lossy().into_owned());
        let name = name.unwrap_or_else(|| path.display().to_string());
        name.trim_end_matches(".gz").rsplit_once('.').map_or(name.clone(), |(stem, _)| stem.into())
    };
    let mut both = Vec::new();
    for (file, other) in [(&args.a, &args.b), (&args.b, &args.a)] {
        let volume = args.input.open(file)?;
        let info = volume.info(volume.digest());
        let orientation = args.scene.view.axes.for_volume(&volume)?;
        let mut own = request.clone();
        own.fit(&info, orientation, volume.anatomical)?;
        let transfer = request.transfer.function(&info).map_err(|e| request.blame(&e))?;
        let name = if stem(file) == stem(other) { file.display().to_string() } else { stem(file) };
        let volume = Arc::new(volume);
        if both.is_empty() {
            request.transfer = request.transfer.fitted_to(&info).map_err(|e| request.blame(&e))?;
        }
        both.push(Half { name, volume, info, orientation, request: own, transfer });
    }
    let [a, b]: [Half; 2] = both.try_into().unwrap_or_else(|_| unreachable!("two files"));
    let (vox, other) = (a.info.lattice.vox(), b.info.lattice.vox());
    if (vox - other).abs() > 0.01 * vox {
        progress::note(&format!(
            "samples of {} are {vox} apart, those of {} {other}: opacities are those of one step, so \
             what is translucent looks denser where steps are shorter",
            a.name, b.name
        ));
    }
    Ok([a, b])
}

/// Gives both paths one scale, and one target where both lie in one space.
fn frame(halves: &mut [Half; 2]) -> Result<(), Fail> {
    let mut found = Vec::new();
    for half in halves.iter() {
        let Half { request, volume, info, transfer, orientation, .. } = half;
        let one = framing::framing(&request.path, volume, info, transfer, *orientation);
        // If nothing is visible, the whole volume is framed.
        let lattice = &info.lattice;
        let (target, height) = (lattice.centre().to_array(), 1.25 * lattice.largest_extent());
        let usual = Framing { target, height };
        found.push(one.map_err(|e| request.blame(&e))?.unwrap_or(usual));
    }
    let placed = halves.iter().all(|half| half.volume.anatomical);
    let apart =
        (0..3).map(|a| found[0].target[a] - found[1].target[a]).map(|d| d * d).sum::<f64>().sqrt();
    let height = found[0].height.max(found[1].height);
    let shared = placed && apart < 0.5 * height;
    let middle = std::array::from_fn(|a| (found[0].target[a] + found[1].target[a]) / 2.0);
    for (half, own) in halves.iter_mut().zip(&found) {
        if half.request.path.turntable.is_none() && half.request.path.keyframes.is_none() {
            continue;
        }
        let framing = if shared {
            // High enough for either half about the common middle.
            Framing { target: middle, height: height + apart }
        } else {
            Framing { target: own.target, height }
        };
        half.request.path = half.request.path.framed(&framing);
        half.request.path.fit = Fit::Volume;
    }
    Ok(())
}
