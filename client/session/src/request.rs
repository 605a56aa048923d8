//! From flags and files to a request: views, colours, quality, work.
//!
//! Names are those of CONTRACTS.md. What can be refused without the volume is refused here,
//! before anything is read or dialled; what needs the lattice is refused by [`Asked::fit`],
//! which names the flag (or the file and its field) that is to blame.

use crate::fail::Fail;
use crate::parse::{self, Frames, Tile};
use crate::quality_target::QualityTarget;
use crate::transfer::{LookFlags, Transfer, read_json};
use crate::volume::InputArgs;
use clap::builder::{PossibleValuesParser, TypedValueParser, ValueParser};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::message::PathRequest;
use slabcast_common::path::{
    Axis, Crop, Key, KeyFrames, Orientation, ProjectionKind, Side, Turntable, ViewPath,
};
use slabcast_common::quality::{
    Borders, Compositing, Keep, Kernel, Quality, Refused, Schedule, Splat, Sums, Work,
};
use slabcast_common::tween::Tween;
use slabcast_common::view::View;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_common::wanted::Wanted;
use std::path::PathBuf;

/// One word of a closed list, as a value of ours.
fn words<T: Copy + Send + Sync + 'static>(list: &'static [(&'static str, T)]) -> ValueParser {
    let names = PossibleValuesParser::new(list.iter().map(|(name, _)| *name));
    ValueParser::new(names.map(move |word: String| {
        list.iter().find(|(name, _)| *name == word).expect("clap lets only these through").1
    }))
}

/// Which axes are up and front.
#[derive(clap::Args, Clone, Debug)]
pub struct AxisArgs {
    /// World axis that is up: x, y or z with + or - [default: +z]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    pub up: Option<Axis>,
    /// World axis that faces the eye at azimuth 0 [default: +y, or +z where up lies along y; -y of
    /// a CT whose file has no anatomical axes, as slices are stored]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    pub front: Option<Axis>,
}

impl AxisArgs {
    /// Both, with defaults for what is missing.
    pub fn orientation(&self) -> Result<Orientation, Fail> {
        Orientation::new(self.up, self.front).map_err(|e| Fail::flag(&e))
    }

    /// Both, with the defaults that fit a volume.
    pub fn of(&self, volume: &Volume) -> Result<Orientation, Fail> {
        Orientation::of(self.up, self.front, &volume.summary, volume.anatomical)
            .map_err(|e| Fail::flag(&e))
    }
}

/// Where the eye is.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "View path (a turn about the volume, unless --path)")]
pub struct ViewArgs {
    /// Azimuth of the first frame in degrees: 0 looks at the front
    #[arg(long, value_name = "DEG", default_value = "20", value_parser = parse::number,
          allow_negative_numbers = true)]
    start: f64,
    /// Degrees from frame to frame
    #[arg(long, value_name = "DEG", default_value = "5", value_parser = parse::number,
          allow_negative_numbers = true)]
    step: f64,
    /// Number of frames, or the first and last wanted of a path (30..60), which keep their
    /// numbers [default: 18, of a path all]
    #[arg(long, value_name = "N|A..B", value_parser = parse::frames)]
    frames: Option<Frames>,
    /// One frame at this azimuth: short for --start DEG --frames 1
    #[arg(long, value_name = "DEG", value_parser = parse::number, allow_negative_numbers = true,
          conflicts_with_all = ["start", "step", "frames"])]
    azimuth: Option<f64>,
    /// One frame from a side of the body: anterior, left, superior, posterior, right or inferior.
    /// Where the file does not say which is which, --front is anterior and --up superior
    #[arg(long, value_name = "SIDE", value_parser = words(&Side::NAMES),
          conflicts_with_all = ["start", "step", "frames", "azimuth", "elevation"])]
    view: Option<Side>,
    /// Degrees towards up, -90 to 90
    #[arg(long, value_name = "DEG", default_value = "0", value_parser = parse::number,
          allow_negative_numbers = true)]
    elevation: f64,
    /// World height shown at the volume's centre [default: 1.25 times its largest extent]
    #[arg(long, value_name = "H", value_parser = parse::positive, allow_negative_numbers = true)]
    height: Option<f64>,
    /// Parallel or central projection
    #[arg(long, value_name = "KIND", default_value = "ortho", value_parser = words(
        &[("ortho", ProjectionKind::Ortho), ("persp", ProjectionKind::Persp)]))]
    projection: ProjectionKind,
    /// Vertical, full field of view in degrees, of --projection persp [default: 30]
    #[arg(long, value_name = "DEG", value_parser = parse::positive, allow_negative_numbers = true)]
    fov: Option<f64>,
    /// Which world axes are up and front.
    #[command(flatten)]
    pub axes: AxisArgs,
    /// Views, a turntable, key frames or a flight from a file instead; its size holds unless --size
    /// is given
    #[arg(long, value_name = "FILE.json", conflicts_with_all = [
        "start", "step", "azimuth", "view", "elevation", "height", "projection", "fov"])]
    pub path: Option<PathBuf>,
    /// Only what lies in a box: FROM:TO along x, y and z, in mm or in percent of the volume's box; an
    /// empty end does not crop (-40:40,:,50:)
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    crop: Option<Crop>,
}

/// What the picture shows.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Picture")]
pub struct PictureArgs {
    /// Transfer function: a preset (auto, skin, bone, vessels, ...), a colour map (viridis, ...) or a
    /// JSON file, ours or ParaView's; `slabcast tf --list` has all names, `slabcast info VOLUME`
    /// shows what each preset would draw
    #[arg(long, value_name = "NAME|FILE", default_value = "auto")]
    tf: String,
    #[command(flatten)]
    look: LookFlags,
    /// Size in pixels [default: 512x512]
    #[arg(long, value_name = "WxH", value_parser = parse::size)]
    size: Option<[u32; 2]>,
    /// transparent, black, white, R,G,B (0 to 1) or #rrggbb
    #[arg(long, value_name = "COLOUR", default_value = "black", value_parser = parse::background,
          allow_hyphen_values = true)]
    pub background: Background,
}

/// What decides the pixels.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Quality (part of the pixels)")]
pub struct QualityArgs {
    /// Thickness of a sheet, in vox (the smallest sample spacing)
    #[arg(long, value_name = "VOX", default_value = "1.0", value_parser = parse::number,
          allow_negative_numbers = true)]
    thickness: f64,
    /// A pixel that lets through less than this is shut; 0 shuts nothing
    #[arg(long, value_name = "E", default_value = "1/512", value_parser = parse::fraction,
          allow_negative_numbers = true)]
    eps: f64,
    /// Reconstruction kernel. B-splines add up to one along the lattice's axes; the tent ripples by
    /// up to 39 % from other sides
    #[arg(long, default_value = "gaussian", value_name = "KERNEL", value_parser = words(
        &[("gaussian", Kernel::Gaussian), ("bspline", Kernel::Bspline), ("tent", Kernel::Tent)]))]
    kernel: Kernel,
    /// Standard deviation of the Gaussian kernel, in lattice steps: 0.5 sharp, 0.7 smooth
    #[arg(long, value_name = "STEPS", default_value = "0.6", value_parser = parse::number,
          allow_negative_numbers = true)]
    std: f64,
    /// Radius of the Gaussian kernel, in lattice steps
    #[arg(long, value_name = "STEPS", default_value = "2.0", value_parser = parse::number,
          allow_negative_numbers = true)]
    radius: f64,
    /// How sheets are put together; `paper` is the paper's additive opacity
    #[arg(long, default_value = "linear", value_name = "RULE", value_parser = words(
        &[("linear", Compositing::Linear), ("constant", Compositing::Constant),
          ("paper", Compositing::Paper)]))]
    compositing: Compositing,
    /// How a voxel reaches its sheets: this version has `direct` alone, since `deposit` was slower
    #[arg(long, default_value = "direct", value_name = "SPLAT", value_parser = words(
        &[("direct", Splat::Direct), ("deposit", Splat::Deposit)]))]
    splat: Splat,
    /// What sheets add in: `auto` takes 16 bits, which are twice as fast, where they round away next to
    /// nothing (translucent scenes), floats where extinctions have no cap, and else 32 bits
    #[arg(long, default_value = "auto", value_name = "SUMS", value_parser = words(
        &[("auto", Sums::Auto), ("i16", Sums::I16), ("i32", Sums::I32), ("f32", Sums::F32)]))]
    sums: Sums,
    /// Look for hidden bricks and voxels: on or off (changes time, never pixels)
    #[arg(long, default_value = "on", value_name = "on|off", value_parser = parse::on_off,
          action = clap::ArgAction::Set)]
    cull: bool,
    #[command(flatten)]
    target: QualityTarget,
}

impl QualityArgs {
    fn quality(&self) -> Result<Quality, Fail> {
        let q = Quality {
            thickness: self.thickness,
            eps: self.eps,
            kernel: self.kernel,
            std: self.std,
            radius: self.radius,
            compositing: self.compositing,
            splat: self.splat,
            sums: self.sums,
            cull: self.cull,
            ..Quality::default()
        };
        q.check().map_err(|e| Fail::flag(&e))?;
        Ok(q)
    }
}

/// Where from, what and how well: everything that decides a picture of a given volume.
#[derive(clap::Args, Clone, Debug)]
pub struct LookArgs {
    /// Views or path.
    #[command(flatten)]
    pub view: ViewArgs,
    #[command(flatten)]
    picture: PictureArgs,
    #[command(flatten)]
    quality: QualityArgs,
}

impl LookArgs {
    /// What the flags ask for, of a command that draws in the quality that is given.
    pub fn asked(&self, work: Work) -> Result<Asked, Fail> {
        let target = &self.quality.target;
        if target.is_empty() {
            return self.asked_or_target(work);
        }
        Err(Fail::usage(format!(
            "{}: this command compares qualities that are given; leave it out (render, bench and \
             error choose by it)",
            target.flags()
        )))
    }

    /// The same where quality may still have to be chosen (`front::choose::settle`).
    pub fn asked_or_target(&self, work: Work) -> Result<Asked, Fail> {
        Asked::new(&self.view, &self.picture, &self.quality, work)
    }
}

/// A picture of a volume, for commands that look closely at one.
#[derive(clap::Args, Clone, Debug)]
pub struct PictureOf {
    /// File, folder or formula of the volume.
    #[arg(help = crate::volume::VOLUME)]
    pub volume: PathBuf,
    /// Views, colours and quality.
    #[command(flatten)]
    pub look: LookArgs,
    #[command(flatten)]
    input: InputArgs,
}

impl PictureOf {
    /// Whether nothing is said of what is in the file.
    pub fn input_is_empty(&self) -> bool {
        self.input.is_empty()
    }

    /// Opens the volume and sees whether what was asked for can be drawn of it.
    pub fn open(&self, asked: &Asked) -> Result<Opened, Fail> {
        let volume = self.input.open(&self.volume)?;
        let orientation = self.look.view.axes.of(&volume)?;
        let info = volume.info(volume.digest());
        asked.fit(&info, orientation, volume.anatomical)?;
        Ok(Opened { volume, info, orientation })
    }
}

/// A volume that what was asked for can be drawn of.
pub struct Opened {
    /// The volume with its voxels.
    pub volume: Volume,
    /// With its digest.
    pub info: VolumeInfo,
    /// Axes that are up and front, flags and defaults resolved.
    pub orientation: Orientation,
}

/// `--threads` of commands that draw in this process alone.
#[derive(clap::Args, Clone, Debug)]
pub struct ThreadArg {
    /// Threads [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

impl ThreadArg {
    /// As many as asked for, or as there are cores.
    pub fn count(&self) -> usize {
        self.threads.unwrap_or_else(crate::machine::cores) as usize
    }
}

/// How the work is cut.
#[derive(clap::Args, Clone, Debug)]
#[command(next_help_heading = "Work (never changes a pixel)")]
pub struct WorkArgs {
    /// Slabs a frame is cut into
    #[arg(long, value_name = "N", default_value = "3",
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    slabs: u32,
    /// Wanted ratio of macrotiles to render threads
    #[arg(long, value_name = "RATIO", default_value = "2.5", value_parser = parse::positive,
          allow_negative_numbers = true)]
    tiles_per_worker: f64,
    /// Edge of a macrotile in pixels: auto, 16, 32, 64, 128 or 256
    #[arg(long, value_name = "EDGE", default_value = "auto", value_parser = parse::tile)]
    tile: Tile,
    /// How tasks are handed out
    #[arg(long, default_value = "auto", value_name = "NAME", value_parser = words(
        &[("auto", Schedule::Auto), ("region", Schedule::Region), ("slab", Schedule::Slab)]))]
    schedule: Schedule,
    /// Where slabs of the slab schedule end: data (where what hides the rest has been passed) or equal
    /// (all of one thickness, as in the paper)
    #[arg(long, default_value = "data", value_name = "NAME", value_parser = words(
        &[("data", Borders::Data), ("equal", Borders::Equal)]))]
    slab_borders: Borders,
    #[command(flatten)]
    keep: KeepArg,
}

/// What is kept although nothing needs it.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct KeepArg {
    /// Keeps what the scene does not need, to see what leaving it out saves: in bricks empty (voxels that
    /// nothing shows), normals (that nothing shades), gradients (that modulate nothing); of a grey
    /// scene all three colours
    #[arg(
        long,
        value_name = "WHAT,...",
        value_delimiter = ',',
        value_enum,
        hide_possible_values = true
    )]
    keep: Vec<Kept>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
enum Kept {
    Empty,
    Normals,
    Gradients,
    #[value(alias = "colors")]
    Colours,
}

impl KeepArg {
    /// Returns what is kept in bricks.
    pub fn keep(&self) -> Keep {
        let has = |kept| self.keep.contains(&kept);
        Keep {
            empty: has(Kept::Empty),
            normals: has(Kept::Normals),
            gradients: has(Kept::Gradients),
            colours: has(Kept::Colours),
        }
    }
}

impl WorkArgs {
    /// Returns how the work is cut.
    ///
    /// # Errors
    /// A value is out of its range; the error names the flag.
    pub fn work(&self) -> Result<Work, Fail> {
        let w = Work {
            slabs: self.slabs,
            tiles_per_worker: self.tiles_per_worker,
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

/// A request as far as the command line tells it.
#[derive(Clone, Debug)]
pub struct Asked {
    /// Views and size, the range of frames applied.
    pub path: ViewPath,
    /// File that the path was read from.
    pub path_file: Option<PathBuf>,
    /// The axes that were given, if a side of the body was asked for.
    side: Option<AxisArgs>,
    /// Colours and opacities.
    pub transfer: Transfer,
    /// What decides the pixels.
    pub quality: Quality,
    /// What quality is to be chosen by, if anything.
    pub target: QualityTarget,
    /// Pictures are magnified so many times; the path's size is what is drawn.
    pub magnify: u32,
    /// How the work is cut; never changes a pixel.
    pub work: Work,
    /// What lies behind transparent pixels.
    pub background: Background,
    /// Statistics are to have the hash of the linear picture.
    pub hashed: bool,
    /// Pictures are to say it of themselves, as they did once.
    pub hash_inside: bool,
}

impl Asked {
    /// Everything that the flags say; refuses what is wrong in itself.
    pub fn new(
        view: &ViewArgs,
        picture: &PictureArgs,
        parsed: &QualityArgs,
        work: Work,
    ) -> Result<Self, Fail> {
        let quality = Quality { grey: !work.keep.colours, ..parsed.quality()? };
        view.axes.orientation()?;
        let mut path = match &view.path {
            Some(file) => view.of_file(file, picture)?,
            None => view.of_flags(picture.size.unwrap_or([512, 512]))?,
        };
        path.crop = view.crop.or(path.crop);
        path.check().map_err(|e| match &view.path {
            Some(file) => Fail::field(file, "view path", &e),
            None => Fail::flag(&e),
        })?;
        Ok(Asked {
            path,
            path_file: view.path.clone(),
            side: view.view.is_some().then(|| view.axes.clone()),
            transfer: Transfer::parse(&picture.tf, &picture.look)?,
            quality,
            target: parsed.target,
            magnify: 1,
            work,
            background: picture.background,
            hashed: true,
            hash_inside: false,
        })
    }

    /// Returns a request for a path under a preset; everything else has its default.
    ///
    /// # Errors
    /// No preset or colour map has that name.
    pub fn plain(path: ViewPath, tf: &str) -> Result<Self, Fail> {
        Ok(Asked::with_defaults(path, Transfer::plain(tf)?))
    }

    /// Size of the pictures that come out.
    pub fn size(&self) -> [u32; 2] {
        self.path.size.map(|n| n * self.magnify)
    }

    /// The numbers of its frames on the whole path.
    pub fn frames(&self) -> std::ops::Range<u64> {
        let first = self.path.first_frame() as u64;
        first..first + self.path.frames() as u64
    }

    /// Returns a request for a path under a transfer function; everything else has its default.
    pub fn with_defaults(path: ViewPath, transfer: Transfer) -> Self {
        Asked {
            path,
            path_file: None,
            side: None,
            transfer,
            quality: Quality::default(),
            target: QualityTarget::default(),
            magnify: 1,
            work: Work::default(),
            background: Background::Colour([0.0; 3]),
            hashed: true,
            hash_inside: false,
        }
    }

    /// Whether all of it can be drawn of this volume; `anatomical` says whether its file knows
    /// left from right.
    pub fn fit(
        &self,
        info: &VolumeInfo,
        orientation: Orientation,
        anatomical: bool,
    ) -> Result<(), Fail> {
        if let Some(axes) = &self.side {
            let usual = Orientation::of(None, None, &info.summary, anatomical)
                .map_err(|e| Fail::flag(&e))?;
            let given = axes.up.is_some() || axes.front.is_some();
            if anatomical && orientation != usual {
                return Err(Fail::usage(
                    "--view: the volume itself says where anterior and superior are; leave --up and \
                     --front out",
                ));
            }
            if !anatomical && !given && orientation == usual {
                return Err(Fail::usage(
                    "--view: the volume does not say where anterior is; give --up and --front for \
                     superior and anterior, or --azimuth instead",
                ));
            }
        }
        let function = self.transfer.function(info).map_err(|e| self.blame(&e))?;
        let blame = |e| self.blame(&e);
        let tween = Tween::of(&self.path, &info.summary).map_err(blame)?;
        let compositing = self.quality.compositing;
        Wanted::of_path(&self.path, &function, tween.as_ref(), info, compositing).map_err(blame)?;
        let cameras = self.path.prepare(&info.lattice, orientation).map_err(blame)?;
        for i in 0..self.path.frames() {
            let camera = cameras.camera(i).map_err(blame)?;
            View::new(&info.lattice, &camera, self.path.size, &self.quality).map_err(|mut e| {
                // A view speaks of itself; a path has many.
                let n = self.path.first_frame() + i;
                if e.field != "size" && self.path_file.is_some() {
                    if !self.path.views.is_empty() {
                        e.field = format!("views[{n}].{}", e.field);
                    } else if self.path.keyframes.is_some() {
                        e.field = format!("keyframes, frame {n}: {}", e.field);
                    } else if self.path.flythrough.is_some() {
                        e.field = format!("flythrough, frame {n}: {}", e.field);
                    }
                }
                self.blame(&e)
            })?;
        }
        Ok(())
    }

    /// Puts a refusal where the user wrote what is refused: at a flag or in a file.
    pub fn blame(&self, refused: &Refused) -> Fail {
        const FLAGS: [&str; 24] = [
            "thickness",
            "eps",
            "kernel",
            "std",
            "radius",
            "compositing",
            "splat",
            "sums",
            "cull",
            "slabs",
            "tiles-per-worker",
            "tile",
            "schedule",
            "size",
            "background",
            "tf",
            "start",
            "step",
            "frames",
            "elevation",
            "height",
            "fov",
            "up",
            "front",
        ];
        // Fields of a transfer function's file.
        const TRANSFER: [&str; 8] = [
            "transfer function",
            "domain",
            "colors",
            "opacities",
            "color_space",
            "opacity_unit",
            "gradient_opacity",
            "shading",
        ];
        // A box names its axis.
        if refused.field.starts_with("crop") {
            return Fail::usage(format!("--crop: {}", refused.problem));
        }
        const OF_PATHS: [&str; 10] = [
            "range",
            "size",
            "start",
            "step",
            "frames",
            "elevation",
            "height",
            "fov",
            "up",
            "front",
        ];
        let inner = refused.field.rsplit('.').next().unwrap_or_default();
        let field = match inner {
            // A turntable's eye is as far as its height and field of view put it.
            "eye" | "target" if self.path.turntable.is_some() => "height",
            field => field,
        };
        if let Some(file) = &self.path_file
            && (["views", "keyframes", "flythrough"].iter().any(|w| refused.field.contains(w))
                || OF_PATHS.contains(&field))
        {
            return Fail::field(file, "view path", refused);
        }
        if TRANSFER.iter().any(|name| refused.field.starts_with(name))
            && let Some(file) = self.transfer.file()
        {
            return Fail::field(file, "transfer function", refused);
        }
        if FLAGS.contains(&field) {
            return Fail::flag(&Refused::new(field, &refused.problem));
        }
        Fail::usage(refused.to_string())
    }

    /// The request, under a name that no other has, for a volume with these values.
    pub fn request(&self, info: &VolumeInfo, format: PixelFormat, want_trace: bool) -> PathRequest {
        PathRequest {
            client_key: client_key(),
            path: self.path.clone(),
            transfer: self.transfer.choice(info),
            quality: self.quality,
            work: self.work,
            format,
            background: self.background,
            want_trace,
            want_hash: self.hashed,
        }
    }
}

impl ViewArgs {
    /// The path of a file, as far as flags do not change it.
    fn of_file(&self, file: &std::path::Path, picture: &PictureArgs) -> Result<ViewPath, Fail> {
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

    /// The path of the flags.
    fn of_flags(&self, size: [u32; 2]) -> Result<ViewPath, Fail> {
        let persp = self.projection == ProjectionKind::Persp;
        if self.fov.is_some() && !persp {
            return Err(Fail::usage(
                "--fov: a parallel view has no field of view; add --projection persp",
            ));
        }
        let fov = self.fov.unwrap_or(30.0);
        if let Some(side) = self.view {
            let key = Key {
                view: Some(side),
                projection: self.projection,
                height: self.height,
                fov: persp.then_some(fov),
                ..Key::default()
            };
            let one = KeyFrames {
                frames: 1,
                easing: Default::default(),
                up: self.axes.up,
                front: self.axes.front,
                keys: vec![key],
            };
            return Ok(ViewPath { keyframes: Some(one), ..ViewPath::of_views(size, Vec::new()) });
        }
        let (start, frames) = match (self.azimuth, self.frames) {
            (Some(azimuth), _) => (azimuth, Frames::Count(1)),
            (None, frames) => (self.start, frames.unwrap_or(Frames::Count(18))),
        };
        // A turn goes on for ever: a range of it is one of as many frames as it needs.
        let (frames, range) = match frames {
            Frames::Count(n) => (n, None),
            Frames::Range([first, last]) => (last + 1, Some([first, last])),
        };
        let turntable = Turntable {
            start,
            step: self.step,
            frames,
            elevation: self.elevation,
            height: self.height,
            projection: self.projection,
            fov,
            up: self.axes.up,
            front: self.axes.front,
        };
        Ok(ViewPath { range, ..ViewPath::turn(size, turntable) })
    }
}

/// A key that no other request of any client has: time, process and a counter.
pub fn client_key() -> String {
    use std::sync::atomic::{AtomicU64, Ordering};
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let now = std::time::SystemTime::now()
        .duration_since(std::time::UNIX_EPOCH)
        .map_or(0, |d| d.as_nanos());
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    // The address of a local differs from process to process where ids repeat (containers).
    let here = std::ptr::from_ref(&count) as usize;
    format!("cli-{now:x}-{}-{here:x}-{count}", std::process::id())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use slabcast_common::message::TransferChoice;
    use slabcast_common::volume::Digest32;

    #[derive(Parser)]
    struct Flags {
        #[command(flatten)]
        look: LookArgs,
        #[command(flatten)]
        work: WorkArgs,
    }

    fn asked(line: &str) -> Result<Asked, String> {
        let f = Flags::try_parse_from(std::iter::once("x").chain(line.split_whitespace()))
            .map_err(|e| e.to_string())?;
        f.work
            .work()
            .and_then(|work| f.look.asked(work))
            .map_err(|e| e.line().unwrap_or_default().to_string())
    }

    fn cube() -> VolumeInfo {
        Volume::from_fn_u8("cube", [8; 3], |i, _, _| i as u8).info(Digest32::default())
    }

    #[test]
    fn no_flag_is_the_protocol_of_the_contract() {
        let a = asked("").unwrap();
        assert_eq!(a.path, ViewPath::turn([512, 512], Turntable::default()));
        assert_eq!((a.quality, a.work), (Quality::default(), Work::default()));
        let request = a.request(&cube(), PixelFormat::Rgb8, false);
        assert_eq!(request.transfer, TransferChoice::Name("auto".into()));
        assert_eq!(request.background, Background::Colour([0.0; 3]));
    }

    #[test]
    fn flags_mean_what_they_say() {
        let a = asked(
            "--azimuth -30 --elevation=-10 --height 5 --projection persp --fov 40 --up=-y \
             --front -x --tf bone --size 64x32 --background transparent --thickness 0.5 --eps 1/256 \
             --std 0.5 --radius 2.5 --compositing paper --sums f32 --cull off --slabs 5 \
             --tiles-per-worker 3 --tile 64 --schedule slab",
        )
        .unwrap();
        let t = a.path.turntable.unwrap();
        assert_eq!((t.start, t.frames, t.elevation, t.height), (-30.0, 1, -10.0, Some(5.0)));
        assert_eq!((t.projection, t.fov), (ProjectionKind::Persp, 40.0));
        assert_eq!((t.up, t.front), ("-y".parse().ok(), "-x".parse().ok()));
        assert_eq!((a.quality.eps, a.quality.cull), (1.0 / 256.0, false));
        assert_eq!((a.work.slabs, a.work.tile), (5, Some(64)));
        assert_eq!(a.background, Background::Transparent);
    }

    #[test]
    fn refusals_name_the_flag() {
        for (line, says) in [
            ("--thickness 0", "--thickness:"),
            ("--eps 0.9", "--eps:"),
            ("--kernel tent --std 0.5", "--std:"),
            ("--splat deposit", "--splat:"),
            ("--schedule regions", "--schedule"),
            ("--std nan", "--std"),
            ("--frames 0", "--frames"),
            ("--frames 100001", "--frames"),
            ("--slabs 0", "--slabs"),
            ("--tile 24", "--tile"),
            ("--up q", "--up"),
            ("--up z --front=-z", "--front:"),
            ("--tf bonee", "did you mean `bone`"),
            ("--azimuth 3 --step 2", "--azimuth"),
            ("--path no.json --start 2", "--path"),
            ("--frames 5..3", "--frames"),
            ("--frames 3..", "--frames"),
            ("--view top", "--view"),
            ("--view left --azimuth 3", "--view"),
            ("--crop 1:2", "--crop"),
            ("--crop 9:2,:,:", "--crop"),
            ("--light 0,0,0", "--light"),
            ("--nan red", "--nan"),
            ("--colors virids", "did you mean `viridis`"),
            ("--path no.json", "no.json:"),
            ("--fov 40", "--fov:"),
            ("--view left --fov 40", "--fov:"),
        ] {
            let said = asked(line).err().unwrap_or_else(|| panic!("`{line}` was taken"));
            assert!(said.contains(says), "`{line}` says: {said}");
        }
    }

    #[test]
    fn what_the_lattice_refuses_names_the_flag_or_the_files_field() {
        let o = Orientation::new(None, None).unwrap();
        for (line, says) in [
            ("--elevation 91", "--elevation:"),
            ("--height 1e30", "--height:"),
            ("--projection persp --fov 180", "--fov:"),
            ("--projection persp --height 1e30", "--height:"),
        ] {
            let said = asked(line).unwrap().fit(&cube(), o, false).unwrap_err();
            assert!(said.line().unwrap().starts_with(says), "`{line}` says: {said:?}");
        }
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("p.json");
        std::fs::write(
            &file,
            r#"{"version":1,"size":[9,9],"views":[{"eye":[0,0,9],"target":[0,0,0],
            "up":[0,0,0],"projection":"ortho"}]}"#,
        )
        .unwrap();
        let said = asked(&format!("--path {}", file.display())).unwrap().fit(&cube(), o, false);
        let said = said.unwrap_err().line().unwrap().to_string();
        assert!(said.contains("p.json: views[0].up:"), "{said}");
    }

    #[test]
    fn keys_are_never_the_same() {
        let a: std::collections::BTreeSet<String> = (0..100).map(|_| client_key()).collect();
        assert_eq!(a.len(), 100);
    }
}
