//! The flags of a request: views, picture, quality and work.
//!
//! The first paragraph of a flag's help is the line that `-h` shows; what few need shows in
//! `--help` alone.

use super::{KeepArgs, RenderRequest};
use crate::fail::Fail;
use crate::parse::{self, Frames, Tile};
use crate::quality_target::QualityTarget;
use crate::transfer::{NameOrFile, Transfer, TransferFlags, read_json};
use crate::volume::InputArgs;
use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser, ValueParser};
use slabcast_common::image::Background;
use slabcast_common::quality::{
    Borders, Classify, Compositing, Kernel, Quality, Schedule, Splat, Sums, Work,
};
use slabcast_common::volume::{ValueSummary, Volume, VolumeInfo};
use slabcast_scene::path::{
    Axis, Crop, Fit, Key, KeyFrames, Orientation, ProjectionKind, Side, Turntable, ViewPath,
};
use std::path::{Path, PathBuf};

/// Returns a parser of one word of a closed list into its value.
fn words<T: Copy + Send + Sync + 'static>(list: &'static [(&'static str, T)]) -> ValueParser {
    let names = PossibleValuesParser::new(list.iter().map(|(name, _)| *name));
    ValueParser::new(names.map(move |word: String| {
        list.iter().find(|(name, _)| *name == word).expect("clap lets only these through").1
    }))
}

/// Sides of the body to draw, in the order of the user.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Sides(Vec<Side>);

/// Parses `--view`: names with commas between, or `all`.
#[derive(Clone)]
struct SidesParser;

impl TypedValueParser for SidesParser {
    type Value = Sides;

    fn parse_ref(
        &self,
        command: &clap::Command,
        arg: Option<&clap::Arg>,
        value: &std::ffi::OsStr,
    ) -> Result<Sides, clap::Error> {
        let known = Side::NAMES.map(|(name, _)| name);
        let one = PossibleValuesParser::new(known.iter().copied().chain(["all"]));
        let mut sides = Vec::new();
        for word in value.to_string_lossy().split(',') {
            let name = one.parse_ref(command, arg, word.trim().as_ref())?;
            let found = Side::NAMES.iter().find(|(known, _)| *known == name).map(|(_, side)| side);
            sides.extend(found.map_or(Side::NAMES.map(|(_, side)| side).to_vec(), |s| vec![*s]));
        }
        Ok(Sides(sides))
    }

    /// For completions.
    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let names = Side::NAMES.iter().map(|(name, _)| *name).chain(["all"]);
        Some(Box::new(names.map(PossibleValue::new)))
    }
}

/// Turn of a command without `--frames` and `--step`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct UsualTurn {
    /// Number of frames.
    pub frames: u32,
    /// Degrees from the first frame to where the next after the last would be. A number of frames
    /// without `--step` divides them.
    pub degrees: f64,
    /// Degrees from frame to frame, however many there are; `None` divides `degrees`.
    pub step: Option<f64>,
}

impl UsualTurn {
    /// Returns a full turn of `frames` frames.
    pub const fn full(frames: u32) -> UsualTurn {
        UsualTurn { frames, degrees: 360.0, step: None }
    }

    /// Turn for measurements: 18 frames of 5 degrees. Neighbouring frames share most bricks, as in
    /// a movie.
    pub const LAB: UsualTurn = UsualTurn { frames: 18, degrees: 90.0, step: Some(5.0) };

    /// Returns the degrees from frame to frame, for a number of frames or a range.
    fn step(&self, frames: Frames) -> f64 {
        let count = match frames {
            Frames::Count(n) if n > 1 => n,
            _ => self.frames.max(36),
        };
        self.step.unwrap_or(self.degrees / f64::from(count))
    }
}

/// `--up` and `--front`.
#[derive(clap::Args, Clone, Debug)]
pub struct AxisArgs {
    /// World axis that is up: x, y or z with + or - [default: +z]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    pub up: Option<Axis>,
    /// World axis that faces the eye at azimuth 0 [default: +y]
    ///
    /// +z where up lies along y; -y of a CT whose file has no anatomical axes, as slices are
    /// stored.
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true, hide_short_help = true)]
    pub front: Option<Axis>,
}

impl AxisArgs {
    /// Returns both axes, with general defaults.
    ///
    /// # Errors
    /// The axes are parallel.
    pub fn orientation(&self) -> Result<Orientation, Fail> {
        Orientation::new(self.up, self.front).map_err(|e| Fail::flag(&e))
    }

    /// Returns both axes, with the defaults that fit a volume.
    ///
    /// # Errors
    /// The axes are parallel.
    pub fn for_volume(&self, volume: &Volume) -> Result<Orientation, Fail> {
        self.for_summary(&volume.summary)
    }

    /// Returns both axes, with the defaults that fit a volume of which only the description is
    /// known.
    ///
    /// # Errors
    /// Both flags name one axis.
    pub fn for_info(&self, info: &VolumeInfo) -> Result<Orientation, Fail> {
        self.for_summary(&info.summary)
    }

    fn for_summary(&self, summary: &ValueSummary) -> Result<Orientation, Fail> {
        Orientation::for_volume(self.up, self.front, summary, summary.anatomical)
            .map_err(|e| Fail::flag(&e))
    }
}

/// Flags of the view path.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "View path (a turn about the volume, unless --path)")]
pub struct ViewArgs {
    /// Azimuth of the first frame; 0 looks at the front
    #[arg(long, value_name = "DEG", default_value = "20", value_parser = parse::number,
          allow_negative_numbers = true)]
    start: f64,
    /// Degrees from frame to frame [default: a full turn; lab: 5]
    #[arg(long, value_name = "DEG", value_parser = parse::number, allow_negative_numbers = true)]
    step: Option<f64>,
    /// Number of frames, or a range of a path [default: 36; lab: 18]
    ///
    /// Of a path the default is all; 30..60 draws frames 30 to 60, which keep their numbers. One
    /// picture (-o front.png) is the first frame; a video (mp4, webm) has 180.
    #[arg(long, value_name = "N|A..B", value_parser = parse::frames)]
    frames: Option<Frames>,
    /// One frame at this azimuth
    #[arg(long, value_name = "DEG", value_parser = parse::number, allow_negative_numbers = true,
          conflicts_with_all = ["start", "step", "frames"])]
    azimuth: Option<f64>,
    /// One frame from a side (anterior, left, superior, ...), several, or all
    ///
    /// anterior, left, superior, posterior, right, inferior; several with commas between, or all.
    /// In one picture (-o sides.png) several are a grid with their names. Where the file has no
    /// anatomical axes, --front is anterior and --up superior.
    #[arg(long, value_name = "SIDE,...|all", value_parser = SidesParser,
          hide_possible_values = true,
          conflicts_with_all = ["start", "step", "frames", "azimuth", "elevation"])]
    view: Option<Sides>,
    /// Degrees towards up, -90 to 90
    #[arg(long, value_name = "DEG", default_value = "0", value_parser = parse::number,
          allow_negative_numbers = true)]
    elevation: f64,
    /// Content to frame: visible or volume [default: visible]
    ///
    /// visible: what the transfer function shows within --crop is in the middle and fills 85 % of
    /// the picture; a turn has one framing for all frames. volume: the volume's centre, and 1.25
    /// times its largest extent. The default is volume beside --height, and what the file says
    /// beside --path.
    #[arg(long, value_name = "WHAT", hide_possible_values = true,
          value_parser = words(&[("visible", Fit::Visible), ("volume", Fit::Volume)]))]
    fit: Option<Fit>,
    /// World height of the picture [default: as --fit says]
    ///
    /// In mm where the file says so. The picture then shows the volume's centre, unless --fit
    /// visible is given, too.
    #[arg(long, value_name = "H", value_parser = parse::positive, allow_negative_numbers = true)]
    height: Option<f64>,
    /// Parallel or perspective: ortho or persp
    #[arg(long, value_name = "KIND", default_value = "ortho", hide_possible_values = true,
          value_parser = words(&[("ortho", ProjectionKind::Ortho),
                                 ("persp", ProjectionKind::Persp)]))]
    projection: ProjectionKind,
    /// Vertical, full field of view of --projection persp, in degrees [default: 30]
    #[arg(long, value_name = "DEG", value_parser = parse::positive, allow_negative_numbers = true,
          hide_short_help = true)]
    fov: Option<f64>,
    /// World axes that are up and front.
    #[command(flatten)]
    pub axes: AxisArgs,
    /// Views, turntable, key frames or a flight from a file
    ///
    /// The file's size holds unless --size is given.
    #[arg(long, value_name = "FILE.json", conflicts_with_all = [
        "start", "step", "azimuth", "view", "elevation", "height", "projection", "fov"])]
    pub path: Option<PathBuf>,
    /// Draw only what lies in a box, such as -40:40,:,50:
    ///
    /// FROM:TO along x, y and z, in mm or in percent of the volume's box; an empty end does not
    /// crop.
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    crop: Option<Crop>,
}

/// Flags of what the picture shows.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Picture")]
pub struct PictureArgs {
    /// Transfer function: a preset, colour map or JSON file
    ///
    /// A preset (auto, skin, bone, vessels, ...), a colour map (viridis, ...) or a JSON file, ours
    /// or ParaView's. `slabcast tf --list` has all names, `slabcast info VOLUME` shows what each
    /// preset would draw.
    #[arg(long, value_name = "NAME|FILE", default_value = "auto", hide_possible_values = true,
          value_parser = NameOrFile::TRANSFER)]
    tf: String,
    #[command(flatten)]
    transfer: TransferFlags,
    /// Size in pixels [default: 512x512]
    #[arg(long, value_name = "WxH", value_parser = parse::size)]
    size: Option<[u32; 2]>,
    /// transparent, black, white, R,G,B or #rrggbb
    ///
    /// R, G and B are sRGB numbers from 0 to 1.
    #[arg(long, value_name = "COLOUR", default_value = "black", value_parser = parse::background,
          allow_hyphen_values = true)]
    pub background: Background,
}

/// Flags of what decides the pixels.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Quality (part of the pixels)")]
pub struct QualityArgs {
    /// Thickness of a sheet in vox (smallest sample spacing) [default: 2/3]
    ///
    /// With `--classify before` the default is 1.
    #[arg(long, value_name = "VOX", value_parser = parse::fraction,
          allow_negative_numbers = true)]
    thickness: Option<f64>,
    /// Transmittance below which a pixel is shut
    ///
    /// 0 shuts no pixel.
    #[arg(long, value_name = "E", default_value = "1/512", value_parser = parse::fraction,
          allow_negative_numbers = true, hide_short_help = true)]
    eps: f64,
    /// Reconstruction kernel: bspline, interpolating (sharpest), gaussian or tent [default:
    /// bspline]
    ///
    /// With `--classify before` the default is gaussian. B-splines add up to one along the
    /// lattice's axes; the tent ripples by up to 39 % from other sides.
    #[arg(long, value_name = "KERNEL", hide_short_help = true,
          value_parser = words(&[("gaussian", Kernel::Gaussian), ("bspline", Kernel::Bspline),
                                 ("tent", Kernel::Tent),
                                 ("interpolating", Kernel::Interpolating)]))]
    kernel: Option<Kernel>,
    /// Standard deviation of the Gaussian kernel, in lattice steps: 0.5 sharp, 0.7 smooth
    #[arg(long, value_name = "STEPS", default_value = "0.6", value_parser = parse::number,
          allow_negative_numbers = true, hide_short_help = true)]
    std: f64,
    /// Radius of the Gaussian kernel, in lattice steps
    #[arg(long, value_name = "STEPS", default_value = "2.0", value_parser = parse::number,
          allow_negative_numbers = true, hide_short_help = true)]
    radius: f64,
    /// Classify values after or before the kernel reconstructs them [default: after]
    ///
    /// `after` gives sharp surfaces; `before` blurs classified voxels, as in the paper.
    #[arg(long, value_name = "ORDER", hide_short_help = true,
          value_parser = words(&[("after", Classify::After), ("before", Classify::Before)]))]
    classify: Option<Classify>,
    /// How sheets are composited
    ///
    /// `paper` is the paper's additive opacity.
    #[arg(long, default_value = "linear", value_name = "RULE", hide_short_help = true,
          value_parser = words(&[("linear", Compositing::Linear),
                                 ("constant", Compositing::Constant),
                                 ("paper", Compositing::Paper)]))]
    compositing: Compositing,
    /// How a voxel reaches its sheets; `deposit` was slower and is not in this version
    #[arg(long, default_value = "direct", value_name = "SPLAT", hide_short_help = true,
          value_parser = words(&[("direct", Splat::Direct), ("deposit", Splat::Deposit)]))]
    splat: Splat,
    /// Number type that sheets are summed in
    ///
    /// `auto` takes 16 bits, which are twice as fast, where they round away next to nothing
    /// (translucent scenes), floats where extinctions have no cap, and else 32 bits.
    #[arg(long, default_value = "auto", value_name = "SUMS", hide_short_help = true,
          value_parser = words(&[("auto", Sums::Auto), ("i16", Sums::I16), ("i32", Sums::I32),
                                 ("f32", Sums::F32)]))]
    sums: Sums,
    /// Skip hidden bricks and voxels: on or off (changes time, never pixels)
    #[arg(long, default_value = "on", value_name = "on|off", value_parser = parse::on_off,
          action = clap::ArgAction::Set, hide_short_help = true)]
    cull: bool,
    #[command(flatten)]
    target: QualityTarget,
}

impl QualityArgs {
    /// Returns the quality that the flags ask for; `usual` is the default order of classification.
    fn quality(&self, usual: Classify) -> Result<Quality, Fail> {
        let classify = self.classify.unwrap_or(usual);
        let default = Quality::of(classify);
        let q = Quality {
            thickness: self.thickness.unwrap_or(default.thickness),
            eps: self.eps,
            kernel: self.kernel.unwrap_or(default.kernel),
            std: self.std,
            radius: self.radius,
            classify,
            compositing: self.compositing,
            splat: self.splat,
            sums: self.sums,
            cull: self.cull,
        };
        q.check().map_err(|e| Fail::flag(&e))?;
        Ok(q)
    }
}

/// Views, picture and quality: everything that decides the picture of a given volume.
#[derive(clap::Args, Clone, Debug)]
pub struct SceneArgs {
    /// Views or path.
    #[command(flatten)]
    pub view: ViewArgs,
    #[command(flatten)]
    picture: PictureArgs,
    #[command(flatten)]
    quality: QualityArgs,
}

impl SceneArgs {
    /// Returns the request of a command that draws in the quality that is given.
    ///
    /// # Errors
    /// A flag or file is wrong in itself, or a quality target is given.
    pub fn request(&self, work: Work) -> Result<RenderRequest, Fail> {
        self.request_in(Classify::After, work)
    }

    /// Returns the request of a command about the paper's order, classification before
    /// reconstruction.
    ///
    /// # Errors
    /// A flag or file is wrong in itself, or asks for the other order or a quality target.
    pub fn request_before(&self, work: Work) -> Result<RenderRequest, Fail> {
        if self.quality.classify == Some(Classify::After) {
            return Err(Fail::usage(
                "--classify: this command is about `before`, the paper's order; leave it out",
            ));
        }
        self.request_in(Classify::Before, work)
    }

    fn request_in(&self, usual: Classify, work: Work) -> Result<RenderRequest, Fail> {
        let target = &self.quality.target;
        if target.is_empty() {
            return self.any_request(usual, work, UsualTurn::LAB);
        }
        Err(Fail::usage(format!(
            "{}: this command compares qualities that are given; leave it out (render, lab bench \
             and lab error choose by it)",
            target.flags()
        )))
    }

    /// Returns the request of a command that can choose the quality by a target
    /// (`slabcast_lab::autotune`).
    ///
    /// # Errors
    /// A flag or file is wrong in itself.
    pub fn request_with_target(&self, work: Work) -> Result<RenderRequest, Fail> {
        self.any_request(Classify::After, work, UsualTurn::LAB)
    }

    /// Returns the request of a command that makes pictures for people. It draws `turn` unless
    /// flags ask for other views.
    ///
    /// # Errors
    /// A flag or file is wrong in itself.
    pub fn request_with_turn(&self, work: Work, turn: UsualTurn) -> Result<RenderRequest, Fail> {
        self.any_request(Classify::After, work, turn)
    }

    fn any_request(
        &self,
        usual: Classify,
        work: Work,
        turn: UsualTurn,
    ) -> Result<RenderRequest, Fail> {
        let SceneArgs { view, picture, quality: flags } = self;
        let quality = flags.quality(usual)?;
        view.axes.orientation()?;
        let mut path = match &view.path {
            Some(file) => view.path_from_file(file, picture)?,
            None => view.path_from_flags(picture.size.unwrap_or([512, 512]), turn)?,
        };
        path.crop = view.crop.or(path.crop);
        let usual = match (&view.path, view.height) {
            (Some(_), _) => path.fit,
            (None, Some(_)) => Fit::Volume,
            (None, None) => Fit::Visible,
        };
        path.fit = view.fit.unwrap_or(usual);
        path.check().map_err(|e| match &view.path {
            Some(file) if e.field != "fit" || view.fit.is_none() => {
                Fail::field(file, "view path", &e)
            }
            _ => Fail::flag(&e),
        })?;
        let transfer = Transfer::parse(&picture.tf, &picture.transfer)?;
        Ok(RenderRequest {
            path_file: view.path.clone(),
            side: view.view.is_some().then(|| view.axes.clone()),
            quality,
            asks_after: flags.classify == Some(Classify::After),
            target: flags.target,
            work,
            background: picture.background,
            ..RenderRequest::with_defaults(path, transfer)
        })
    }
}

/// A volume and all that decides its picture, for commands that look closely at one.
#[derive(clap::Args, Clone, Debug)]
pub struct VolumeSceneArgs {
    /// File, folder or formula of the volume.
    #[arg(help = crate::volume::VOLUME)]
    pub volume: PathBuf,
    /// Views, colours and quality.
    #[command(flatten)]
    pub scene: SceneArgs,
    #[command(flatten)]
    input: InputArgs,
}

impl VolumeSceneArgs {
    /// Returns whether no flag says what is in the file.
    pub fn input_is_empty(&self) -> bool {
        self.input.is_empty()
    }

    /// Returns the request of a command that draws in the quality that is given.
    ///
    /// # Errors
    /// A flag or file is wrong in itself, or a quality target is given.
    pub fn request(&self, work: Work) -> Result<RenderRequest, Fail> {
        Ok(RenderRequest { level: self.input.level(), ..self.scene.request(work)? })
    }

    /// Returns the request of a command about the paper's order, classification before
    /// reconstruction, with the level of detail that the flags ask for.
    ///
    /// # Errors
    /// A flag or file is wrong in itself, or asks for the other order or a quality target.
    pub fn request_before(&self, work: Work) -> Result<RenderRequest, Fail> {
        Ok(RenderRequest { level: self.input.level(), ..self.scene.request_before(work)? })
    }

    /// Returns the request of a command that can choose the quality by a target.
    ///
    /// # Errors
    /// A flag or file is wrong in itself.
    pub fn request_with_target(&self, work: Work) -> Result<RenderRequest, Fail> {
        Ok(RenderRequest { level: self.input.level(), ..self.scene.request_with_target(work)? })
    }

    /// Opens the volume and makes the request fit it ([`RenderRequest::fit`]).
    ///
    /// # Errors
    /// The file can't be read, or the request doesn't fit the volume.
    pub fn open(&self, request: &mut RenderRequest) -> Result<OpenedVolume, Fail> {
        let volume = self.input.open(&self.volume)?;
        let orientation = self.scene.view.axes.for_volume(&volume)?;
        let info = volume.info(volume.digest());
        request.fit(&info, orientation, volume.anatomical)?;
        Ok(OpenedVolume { volume, info, orientation })
    }
}

/// A volume that fits a request.
pub struct OpenedVolume {
    /// Volume that was opened, with its voxels.
    pub volume: Volume,
    /// Lattice, value range and SHA-256 digest of the opened volume.
    pub info: VolumeInfo,
    /// Axes that are up and front, flags and defaults resolved.
    pub orientation: Orientation,
}

/// `--threads` of commands that draw in this process alone.
#[derive(clap::Args, Clone, Debug)]
pub struct ThreadArgs {
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

impl ThreadArgs {
    /// Returns the number of threads, by default one a core.
    pub fn count(&self) -> usize {
        self.threads.unwrap_or_else(crate::machine::cores) as usize
    }
}

/// Flags of how the work is cut.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Work (never changes a pixel)")]
pub struct WorkArgs {
    /// Slabs a frame is cut into
    #[arg(long, value_name = "N", default_value = "3", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    slabs: u32,
    /// Wanted ratio of macrotiles to render threads; by region only while bricks still arrive,
    /// later frames are cut by measured times
    #[arg(long, alias = "tiles-per-worker", value_name = "RATIO", default_value = "2.5",
          value_parser = parse::positive, allow_negative_numbers = true, hide_short_help = true)]
    tiles_per_thread: f64,
    /// Edge of a macrotile in pixels: auto, 16, 32, 64, 128 or 256
    #[arg(long, value_name = "EDGE", default_value = "auto", value_parser = parse::tile,
          hide_short_help = true)]
    tile: Tile,
    /// How tasks are handed out: by image region, or slab after slab as in the paper
    #[arg(long, default_value = "auto", value_name = "NAME", hide_short_help = true,
          value_parser = words(&[("auto", Schedule::Auto), ("region", Schedule::Region),
                                 ("slab", Schedule::Slab)]))]
    schedule: Schedule,
    /// Where slabs of the slab schedule end
    ///
    /// data: where what hides the rest has been passed; equal: all of one thickness, as in the
    /// paper.
    #[arg(long, default_value = "data", value_name = "NAME", hide_short_help = true,
          value_parser = words(&[("data", Borders::Data), ("equal", Borders::Equal)]))]
    slab_borders: Borders,
    #[command(flatten)]
    keep: KeepArgs,
}

impl WorkArgs {
    /// Returns the schedule and the cut of the work that the flags ask for.
    ///
    /// # Errors
    /// A value is out of its range; the error names the flag.
    pub fn work(&self) -> Result<Work, Fail> {
        let w = Work {
            slabs: self.slabs,
            tiles_per_worker: self.tiles_per_thread,
            tile: self.tile.0,
            schedule: self.schedule,
            keep: self.keep.keep(),
            borders: self.slab_borders,
            ..Work::default()
        };
        w.check().map_err(|e| Fail::flag(&e))?;
        Ok(w)
    }
}

impl ViewArgs {
    /// Reads the path of a file and applies the flags that may change it.
    fn path_from_file(&self, file: &Path, picture: &PictureArgs) -> Result<ViewPath, Fail> {
        let mut path = ViewPath::from_json(&read_json(file)?)
            .map_err(|e| Fail::field(file, "view path", &e))?;
        path.size = picture.size.unwrap_or(path.size);
        match self.frames {
            None => {}
            Some(Frames::Range(range)) => path.range = Some(range),
            Some(Frames::Count(_)) => {
                return Err(Fail::usage(format!(
                    "--frames, --path: {} says how many; give the first and last wanted, as in 0..9",
                    file.display()
                )));
            }
        }
        if let Some(t) = &mut path.turntable {
            t.up = self.axes.up.or(t.up);
            t.front = self.axes.front.or(t.front);
        } else if let Some(k) = &mut path.keyframes {
            k.up = self.axes.up.or(k.up);
            k.front = self.axes.front.or(k.front);
        } else if self.axes.up.is_some() || self.axes.front.is_some() {
            return Err(Fail::usage(format!(
                "--up, --front: {} has an `up` of its own; leave them out",
                file.display()
            )));
        }
        Ok(path)
    }

    /// Returns the turntable or single view of the flags.
    fn path_from_flags(&self, size: [u32; 2], turn: UsualTurn) -> Result<ViewPath, Fail> {
        let persp = self.projection == ProjectionKind::Persp;
        if self.fov.is_some() && !persp {
            return Err(Fail::usage(
                "--fov: a parallel view has no field of view; add --projection persp",
            ));
        }
        let fov = self.fov.unwrap_or(30.0);
        if let Some(Sides(sides)) = &self.view {
            let key = |side: &Side| Key {
                view: Some(*side),
                projection: self.projection,
                height: self.height,
                fov: persp.then_some(fov),
                ..Key::default()
            };
            let all = KeyFrames {
                frames: sides.len() as u32,
                easing: Default::default(),
                up: self.axes.up,
                front: self.axes.front,
                keys: sides.iter().map(key).collect(),
            };
            return Ok(ViewPath { keyframes: Some(all), ..ViewPath::from_views(size, Vec::new()) });
        }
        let (start, frames) = match (self.azimuth, self.frames) {
            (Some(azimuth), _) => (azimuth, Frames::Count(1)),
            (None, frames) => (self.start, frames.unwrap_or(Frames::Count(turn.frames))),
        };
        let step = self.step.unwrap_or_else(|| turn.step(frames));
        // A turn has no last frame: a range of it is a range of one that is long enough.
        let (frames, range) = match frames {
            Frames::Count(n) => (n, None),
            Frames::Range([first, last]) => (last + 1, Some([first, last])),
        };
        let turntable = Turntable {
            start,
            step,
            frames,
            elevation: self.elevation,
            target: None,
            height: self.height,
            projection: self.projection,
            fov,
            up: self.axes.up,
            front: self.axes.front,
        };
        Ok(ViewPath { range, ..ViewPath::from_turntable(size, turntable) })
    }
}
