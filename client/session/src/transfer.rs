//! The user's transfer function: a preset, a map or a file, and the changes that flags make to it.

use crate::fail::Fail;
use crate::parse;
use clap::builder::{PossibleValue, TypedValueParser};
use slabcast_common::quality::InvalidField;
use slabcast_common::shade::Light;
use slabcast_common::spelling;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, TransferFunction};
use slabcast_common::volume::VolumeInfo;
use slabcast_scene::paraview;
use slabcast_scene::presets;
use slabcast_scene::transfer::TransferChoice;
pub use slabcast_scene::values::in_values;
use slabcast_scene::values::printed_preset;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest transfer function or path file that is read: a path of 100,000 views has 20 MB.
const MAX_JSON_BYTES: u64 = 64 << 20;

/// Parses a name of a list, or any other text: what shells complete are the names.
#[derive(Clone)]
pub struct NameOrFile(&'static [&'static [(&'static str, &'static str)]]);

impl NameOrFile {
    /// Presets, colour maps, or a file.
    pub const TRANSFER: NameOrFile = NameOrFile(&[&presets::NAMES, &presets::MAPS]);
    /// Colour maps, or a file.
    pub const MAP: NameOrFile = NameOrFile(&[&presets::MAPS]);
}

impl TypedValueParser for NameOrFile {
    type Value = String;

    fn parse_ref(
        &self,
        command: &clap::Command,
        arg: Option<&clap::Arg>,
        value: &std::ffi::OsStr,
    ) -> Result<String, clap::Error> {
        clap::builder::StringValueParser::new().parse_ref(command, arg, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let names = self.0.iter().flat_map(|list| list.iter());
        Some(Box::new(names.map(|(name, what)| PossibleValue::new(*name).help(*what))))
    }
}

/// A transfer function with its origin and the changes of flags.
#[derive(clap::Args, Clone, Debug)]
pub struct TransferFlags {
    /// Colours of a colour map or ParaView file instead
    ///
    /// viridis, inferno, magma, plasma, cividis, turbo, cool-warm, greys, or a ParaView file;
    /// spread over the values that the transfer function shows.
    #[arg(long, value_name = "MAP|FILE", value_parser = NameOrFile::MAP, hide_possible_values = true)]
    colors: Option<String>,
    /// Light source: key (up left of the eye), head (the eye), or a direction in world axes
    #[arg(long, value_name = "key|head|X,Y,Z", value_parser = parse::light, allow_hyphen_values = true,
          hide_short_help = true)]
    light: Option<Light>,
    /// Light on voxels: on or off
    #[arg(long, value_name = "on|off", value_parser = parse::on_off, hide_short_help = true)]
    shading: Option<bool>,
    /// Look of NaN: a colour, and after a colon its opacity [default: invisible]
    #[arg(long, value_name = "COLOUR[:A]", value_parser = parse::nan, hide_short_help = true)]
    nan: Option<NanColour>,
}

/// A transfer function and where it came from.
#[derive(Clone, Debug)]
pub struct Transfer {
    base: TransferChoice,
    file: Option<PathBuf>,
    /// Title of the function in ParaView's file, if the file is ParaView's.
    title: Option<String>,
    /// The preset that a function came from, where only that is known.
    preset: Option<String>,
    /// Over 0 to 1, sRGB numbers.
    colours: Option<Vec<[f64; 4]>>,
    light: Option<Light>,
    shading: Option<bool>,
    nan: Option<NanColour>,
}

impl Transfer {
    /// Returns a preset or colour map by name, or reads a file that exists or whose name ends
    /// in `.json`. A preset's name means the preset even beside a file of that name; `./bone`
    /// means the file.
    ///
    /// # Errors
    /// Neither a name nor a file, or a field of the file is wrong.
    pub fn parse(text: &str, flags: &TransferFlags) -> Result<Self, Fail> {
        let colours = flags.colors.as_deref().map(colours).transpose()?;
        let TransferFlags { light, shading, nan, .. } = *flags;
        let mut title = None;
        let (base, file) = if is_name(text) {
            (TransferChoice::Name(text.into()), None)
        } else {
            let path = Path::new(text);
            if !is_file(path) {
                return Err(Fail::flag(&presets::unknown_name(text)));
            }
            let json = read_json(path)?;
            let tf = if paraview::looks_like_paraview(&json) {
                let wrong = |e| Fail::field(path, "colour map", &e);
                let mut map = paraview::parse(&json).map_err(wrong)?;
                title = map.name.take();
                map.into_function().map_err(wrong)?
            } else {
                TransferFunction::from_json(&json)
                    .map_err(|e| Fail::field(path, "transfer function", &e))?
            };
            (TransferChoice::Function(Box::new(tf)), Some(path.to_path_buf()))
        };
        Ok(Transfer { base, file, title, preset: None, colours, light, shading, nan })
    }

    /// Returns a preset or colour map by name, or reads a file, as [`Transfer::parse`] does, unchanged
    /// by flags.
    ///
    /// # Errors
    /// Neither a name nor a file, or a field of the file is wrong.
    pub fn read(text: &str) -> Result<Self, Fail> {
        let flags = TransferFlags { colors: None, light: None, shading: None, nan: None };
        Transfer::parse(text, &flags)
    }

    /// Returns the preset or colour map called `name`, unchanged by flags.
    ///
    /// # Errors
    /// No preset or colour map has that name.
    pub fn from_name(name: &str) -> Result<Self, Fail> {
        Transfer::read(name)
    }

    /// Returns a function as a picture records it, with the preset that it came from.
    pub fn from_function(tf: &TransferFunction, preset: Option<String>) -> Self {
        let base = TransferChoice::Function(Box::new(tf.clone()));
        Transfer {
            base,
            file: None,
            title: None,
            preset,
            colours: None,
            light: None,
            shading: None,
            nan: None,
        }
    }

    /// Returns the function as it is for another volume, in that volume's values, with the changes
    /// of flags.
    ///
    /// # Errors
    /// It doesn't fit that volume.
    pub fn fitted_to(&self, other: &VolumeInfo) -> Result<Self, InvalidField> {
        let tf = in_values(&self.function(other)?, other);
        Ok(Transfer::from_function(&tf, self.preset().map(String::from)))
    }

    /// Returns the transfer function without light.
    pub fn unshaded(&self) -> Self {
        Transfer { light: None, shading: Some(false), ..self.clone() }
    }

    /// Returns the preset that the function is or came from; `None` if there is none.
    pub fn preset(&self) -> Option<&str> {
        match &self.base {
            TransferChoice::Name(name) => Some(name),
            TransferChoice::Function(_) => self.preset.as_deref(),
        }
    }

    /// Returns the file that the function was read from; `None` if there is none.
    pub fn file(&self) -> Option<&Path> {
        self.file.as_deref()
    }

    /// Returns the name of the function for ParaView: the file's own title, or else that of the
    /// preset or file.
    pub fn title(&self) -> String {
        let own = || {
            let name = self.name();
            let stem = Path::new(&name).file_stem().map(|s| s.to_string_lossy().into_owned());
            format!("slabcast {}", stem.unwrap_or(name))
        };
        self.title.clone().unwrap_or_else(own)
    }

    /// Returns the name of the transfer function for messages: the preset or the file; `given`
    /// where it has neither.
    pub fn name(&self) -> String {
        match (&self.base, &self.file) {
            (TransferChoice::Name(name), _) => name.clone(),
            (_, Some(file)) => file.display().to_string(),
            (_, None) => "given".into(),
        }
    }

    /// Returns the function in full for a volume with these values.
    ///
    /// # Errors
    /// It doesn't fit the values.
    pub fn function(&self, info: &VolumeInfo) -> Result<TransferFunction, InvalidField> {
        let mut tf = match &self.base {
            TransferChoice::Name(name) => presets::by_name(name, &info.summary)?,
            TransferChoice::Function(tf) if self.file.is_some() => {
                printed_preset(tf, info).unwrap_or_else(|| (**tf).clone())
            }
            TransferChoice::Function(tf) => (**tf).clone(),
        };
        if self.colours.is_some() && info.summary.palette.is_some() {
            let problem = "the voxels have colours of their own; leave it out, or take one of their \
                           numbers with --channel";
            return Err(InvalidField::new("--colors", problem));
        }
        if let Some(colours) = &self.colours {
            let (from, to) = shown(&tf, info);
            tf.colors = presets::stretch_colours(colours, from, to);
            tf.color_space = ColorSpace::Srgb;
        }
        if let Some(light) = self.light {
            tf.shading.light = light;
            tf.shading.on = true;
        }
        tf.shading.on = self.shading.unwrap_or(tf.shading.on);
        tf.nan = self.nan.unwrap_or(tf.nan);
        tf.check()?;
        Ok(tf)
    }

    /// Returns what a request carries: the name, which the master resolves, unless flags change
    /// the function.
    pub fn choice(&self, info: &VolumeInfo) -> TransferChoice {
        let changed = self.colours.is_some()
            || self.light.is_some()
            || self.shading.is_some()
            || self.nan.is_some();
        match (self.function(info), &self.base) {
            (Ok(tf), TransferChoice::Function(_)) => TransferChoice::Function(Box::new(tf)),
            (Ok(tf), _) if changed => TransferChoice::Function(Box::new(tf)),
            // A function that can't be made is refused by the master with the error of `fit`.
            _ => self.base.clone(),
        }
    }
}

/// The x between which a function shows anything, within the volume's values.
fn shown(tf: &TransferFunction, info: &VolumeInfo) -> (f64, f64) {
    let (lo, hi) = match tf.domain {
        Domain::Unit => (0.0, 1.0),
        Domain::Value => info.summary.range(),
    };
    let seen: Vec<usize> = (0..tf.opacities.len()).filter(|&i| tf.opacities[i][1] > 0.0).collect();
    let (Some(&first), Some(&last)) = (seen.first(), seen.last()) else { return (lo, hi) };
    // From the point before, where a line begins to rise, to where colours of the function end:
    // a few bright voxels should not take half of a map.
    let from = tf.opacities[first.saturating_sub(1)][0].clamp(lo, hi);
    let to = tf.opacities[(last + 1).min(tf.opacities.len() - 1)][0].clamp(lo, hi);
    let end = tf.colors.last().map_or(to, |c| c[0]);
    let to = if end > from { to.min(end) } else { to };
    if to > from { (from, to) } else { (lo, hi) }
}

/// Returns the values of the file between which a function shows anything.
pub fn shown_values(tf: &TransferFunction, info: &VolumeInfo) -> (f64, f64) {
    let (from, to) = shown(tf, info);
    match tf.domain {
        Domain::Value => (from, to),
        Domain::Unit => {
            let (lo, hi) = info.summary.range();
            (lo + (hi - lo) * from, lo + (hi - lo) * to)
        }
    }
}

fn is_name(text: &str) -> bool {
    presets::NAMES.iter().chain(&presets::MAPS).any(|(name, _)| *name == text)
}

/// A pipe (`<(...)` of a shell) is a file, too.
fn is_file(path: &Path) -> bool {
    path.metadata().is_ok_and(|m| !m.is_dir()) || path.extension().is_some_and(|e| e == "json")
}

/// Colours of a map or a ParaView file, over 0 to 1.
fn colours(text: &str) -> Result<Vec<[f64; 4]>, Fail> {
    if let Some(colours) = presets::colour_map(text) {
        return Ok(colours);
    }
    let path = Path::new(text);
    if !is_file(path) {
        let names = presets::MAPS.map(|(name, _)| name);
        let meant = spelling::nearest(text, &names)
            .map(|n| format!("did you mean `{n}`? "))
            .unwrap_or_default();
        return Err(Fail::usage(format!(
            "--colors: `{text}` is neither a map nor a file; {meant}maps are {}",
            names.join(", ")
        )));
    }
    let json = read_json(path)?;
    if !paraview::looks_like_paraview(&json) {
        return Err(Fail::failed(format!(
            "{}: is not a colour map of ParaView; a transfer function goes with --tf",
            path.display()
        )));
    }
    let read = paraview::parse(&json).map_err(|e| Fail::field(path, "colour map", &e))?;
    Ok(read.unit_colours())
}

/// Reads a JSON file as text.
///
/// # Errors
/// The file can't be read or is larger than any path or transfer function.
pub fn read_json(path: &Path) -> Result<String, Fail> {
    let fail = |e: &std::io::Error| Fail::io(path, "reading", e);
    let file = std::fs::File::open(path).map_err(|e| fail(&e))?;
    if file.metadata().map_err(|e| fail(&e))?.is_dir() {
        return Err(Fail::failed(format!("{}: is a folder; give a JSON file", path.display())));
    }
    let mut bytes = Vec::new();
    file.take(MAX_JSON_BYTES + 1).read_to_end(&mut bytes).map_err(|e| fail(&e))?;
    if bytes.len() as u64 > MAX_JSON_BYTES {
        return Err(Fail::failed(format!(
            "{}: has more than {} MB, too many for a view path or a transfer function",
            path.display(),
            MAX_JSON_BYTES / 1_000_000
        )));
    }
    String::from_utf8(bytes)
        .map_err(|_| Fail::failed(format!("{}: is not text; give a JSON file", path.display())))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Digest32, Volume};
    use std::io::Write;

    fn round_trip(volume: &Volume, dir: &Path) {
        let info = volume.info(Digest32::default());
        for (name, _) in presets::NAMES.iter().chain(&presets::MAPS) {
            let preset = Transfer::from_name(name).unwrap().function(&info).unwrap();
            let file = dir.join("tf.json");
            std::fs::write(&file, in_values(&preset, &info).to_json()).unwrap();
            let flags = TransferFlags { colors: None, light: None, shading: None, nan: None };
            let read = Transfer::parse(file.to_str().unwrap(), &flags).unwrap();
            assert_eq!(read.function(&info).unwrap(), preset, "{name} of {}", volume.name);
            let TransferChoice::Function(sent) = read.choice(&info) else { panic!("a function") };
            assert_eq!(*sent, preset, "{name} of {}", volume.name);
        }
    }

    #[test]
    fn a_preset_that_was_printed_is_the_same_preset() {
        let dir = tempfile::tempdir().unwrap();
        let formulas = ["spheres:24", "ramp:16", "blob:24", "fog:16", "marker:24", "one", "full:8"];
        for name in formulas {
            round_trip(
                &crate::volume::open(format!("formula:{name}").as_ref()).unwrap(),
                dir.path(),
            );
        }
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
        round_trip(
            &crate::volume::open(&root.join("samples/mni152_t1.nii.gz")).unwrap(),
            dir.path(),
        );
        for name in ["tooth.nrrd", "lidc2.nrrd", "heptane.nrrd", "chris_t1.nrrd"] {
            let file = root.join("../shared/data").join(name);
            if !file.exists() {
                // A direct write: the test harness captures only what the macros print.
                let _ = writeln!(std::io::stderr(), "skipped: needs shared/data ({name})");
                continue;
            }
            round_trip(&crate::volume::open(&file).unwrap(), dir.path());
        }
    }

    #[test]
    fn a_function_in_values_is_that_in_shares() {
        use slabcast_common::quality::Compositing;
        use slabcast_common::transfer::Classifier;
        let volume = crate::volume::open("formula:spheres:24".as_ref()).unwrap();
        let info = volume.info(Digest32::default());
        for name in ["glass", "skin", "fire"] {
            let preset = presets::by_name(name, &info.summary).unwrap();
            let [a, b] = [preset.clone(), in_values(&preset, &info)]
                .map(|tf| Classifier::new(&tf, &info, Compositing::Linear));
            for i in 0..400 {
                let (share, code) = (f64::from(i) / 400.0, f64::from(i) * 0.6);
                let (fa, fb) = (a.gradient_factor(share), b.gradient_factor(share));
                assert!((fa - fb).abs() < 1e-9, "{name} at gradient {share}: {fa}, {fb}");
                let (oa, ob) = (a.optics_at(code), b.optics_at(code));
                assert!((0..4).all(|c| (oa[c] - ob[c]).abs() < 1e-9), "{name} at {code}");
            }
        }
    }

    #[test]
    fn a_look_of_another_volume_is_in_its_values() {
        let open = |name: &str| crate::volume::open(name.as_ref()).unwrap();
        let (a, b) = (open("formula:spheres:24"), open("formula:ramp:16"));
        let [a, b] = [a, b].map(|v| v.info(Digest32::default()));
        let fitted = Transfer::from_name("skin").unwrap().fitted_to(&a).unwrap();
        let (one, other) = (fitted.function(&a).unwrap(), fitted.function(&b).unwrap());
        assert_eq!((one.domain, &one), (Domain::Value, &other));
        assert_eq!(fitted.preset(), Some("skin"));
    }
}
