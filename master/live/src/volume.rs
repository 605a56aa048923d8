//! The message `volume`: all that an editor needs, and the home view.

use crate::descriptions::{Described, Descriptions};
use crate::gradients::{Gradients, gradients};
use crate::problem::Problem;
use serde_json::{Value, json};
use slabcast_common::quality::Compositing;
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::volume::{Lattice, VolumeInfo};
use slabcast_master::ServedVolume;
use slabcast_master::library::OpenVolume;
use slabcast_scene::path::{Fit, Framing, Key, KeyFrames, Orientation, ViewPath};
use slabcast_scene::presets::{self, Levels};
use slabcast_scene::request::VolumeChoice;
use slabcast_scene::transfer::TransferChoice;
use slabcast_scene::values::{as_read_from_file, in_values};
use slabcast_volumes::framing::framing_of;
use std::sync::Arc;

/// Azimuth of the home view in degrees: where `slabcast render` begins.
const HOME_AZIMUTH: f64 = 20.0;

/// A volume that sessions show.
pub(crate) struct Shown {
    pub(crate) served: Arc<ServedVolume>,
    /// Whether stills are drawn at the level that fits: a file too large for memory.
    pub(crate) is_large: bool,
    pub(crate) home: Key,
    pub(crate) home_tf: TransferChoice,
}

impl Shown {
    /// Returns the description of the volume.
    pub(crate) fn info(&self) -> &VolumeInfo {
        &self.served.info
    }

    /// Returns the choice of a request.
    pub(crate) fn choice(&self) -> VolumeChoice {
        VolumeChoice::Digest(self.served.info.digest)
    }
}

/// The box of the volume's cells (N samples count as N spacings), in world units.
fn world_box(lattice: &Lattice) -> [[f64; 3]; 2] {
    let half = lattice.steps.iter().zip(lattice.dims).map(|(s, n)| s.abs() * f64::from(n) / 2.0);
    let half = half.fold(glam::DVec3::ZERO, |sum, h| sum + h);
    [lattice.centre() - half, lattice.centre() + half].map(|v| v.to_array())
}

/// Returns the share of the samples that a function shows, by the histogram: each bin counts as its
/// middle.
fn visible_share(tf: &TransferFunction, info: &VolumeInfo) -> f64 {
    let summary = &info.summary;
    let classifier = Classifier::new(tf, info, Compositing::Linear);
    let (from, to, counts) = histogram(info);
    let bins = counts.len() as f64;
    let (mut seen, mut all) = (0, 0);
    for (i, &count) in counts.iter().enumerate() {
        let value = from + (to - from) * (i as f64 + 0.5) / bins;
        let code = (value - summary.map.offset) / summary.map.scale;
        all += count;
        seen += if classifier.optics_at(code)[0] > 0.0 { count } else { 0 };
    }
    seen as f64 / all.max(1) as f64
}

/// Returns the values between which the histogram lies, and its counts.
fn histogram(info: &VolumeInfo) -> (f64, f64, &[u64]) {
    let summary = &info.summary;
    let value = |code: f64| summary.map.offset + summary.map.scale * code;
    match &summary.core {
        Some(core) => (value(core.min_code), value(core.max_code), &core.histogram),
        // Bins of 8-bit volumes are codes.
        None if summary.kind == slabcast_common::volume::SampleKind::U8 => {
            (value(-0.5), value(255.5), &summary.histogram)
        }
        None => (value(summary.min_code), value(summary.max_code), &summary.histogram),
    }
}

/// Presets and colour maps as the message lists them, each fitted to the volume.
fn presets_of(info: &VolumeInfo) -> Vec<Value> {
    let maps = presets::MAPS.iter().map(|preset| (preset, true));
    let named = presets::NAMES.iter().map(|preset| (preset, false));
    let fitted = named.chain(maps).filter_map(|((name, words), is_map)| {
        let tf = presets::by_name(name, &info.summary).ok()?;
        let share = visible_share(&tf, info);
        let tf = told(&tf, info);
        Some(json!({"name": name, "for": words, "share": share, "map": is_map, "tf": tf}))
    });
    fitted.collect()
}

/// Returns a function as messages tell it: over the values of the file.
fn told(tf: &TransferFunction, info: &VolumeInfo) -> Value {
    serde_json::to_value(in_values(tf, info)).unwrap_or_default()
}

/// Returns a choice's function in full.
///
/// # Errors
/// There is no such preset, or the function is wrong in itself.
pub(crate) fn function(
    choice: &TransferChoice,
    info: &VolumeInfo,
) -> Result<TransferFunction, Problem> {
    match choice {
        TransferChoice::Name(name) => {
            presets::by_name(name, &info.summary).map_err(|e| Problem::field(&e))
        }
        TransferChoice::Function(tf) => {
            tf.check().map_err(|e| Problem::field(&e))?;
            Ok((**tf).clone())
        }
    }
}

/// Returns target and height for which what a function shows fills the picture; `None` if it shows
/// nothing.
///
/// # Errors
/// A field of the path doesn't fit the volume, or its file can't be read.
pub(crate) fn framed(
    open: &OpenVolume,
    path: &ViewPath,
    tf: &TransferFunction,
) -> Result<Option<Framing>, Problem> {
    let path = ViewPath { fit: Fit::Visible, ..path.clone() };
    framing_of(&path, &*open.source, &open.served.outlines, tf, open.served.orientation).map_err(
        |e| match e {
            slabcast_volumes::framing::FramingError::Field(field) => Problem::field(&field),
            slabcast_volumes::framing::FramingError::File(problem) => {
                Problem::new("volume_not_readable", problem.to_string())
            }
        },
    )
}

/// Returns the decimals to which numbers of a view are rounded whose picture is `height` high; below 0
/// where tens do.
fn rounding(height: f64) -> i32 {
    -(libm::log10(height.max(f64::MIN_POSITIVE) * 1e-4).floor() as i32)
}

/// Returns the number nearest to `x` with so many decimals, as its text is read.
fn rounded(x: f64, decimals: i32) -> f64 {
    if decimals >= 0 {
        let text = format!("{x:.*}", decimals.min(300) as usize);
        return text.parse().unwrap_or(x) + 0.0;
    }
    let unit = 10f64.powi(-decimals);
    (x / unit).round() * unit
}

/// Scene that a page shows first.
#[derive(Clone, Debug, Default)]
pub struct Home {
    /// Preset or function of the first picture; default `auto`. A preset is that of all volumes, a
    /// function that of the volume with which the master was started: others begin with `auto`.
    pub tf: Option<TransferChoice>,
    /// Path that command lines give for the volume with which the master was started; `None`: its name.
    pub file: Option<String>,
}

impl Home {
    /// Returns the scene of another volume than that with which the master was started.
    pub(crate) fn of_another(&self) -> Home {
        let preset = self.tf.clone().filter(|tf| matches!(tf, TransferChoice::Name(_)));
        Home { tf: preset, file: None }
    }
}

/// Fields of the message `volume` that don't depend on the picture's size, as the text of a JSON object.
pub(crate) struct Facts(String);

/// Finds the facts of an open volume.
fn facts(open: &OpenVolume) -> Facts {
    let served = &open.served;
    let info = &served.info;
    let (summary, lattice) = (&info.summary, &info.lattice);
    let Orientation { up, front } = served.orientation;
    let (from, to, counts) = histogram(info);
    let (lowest, highest) = summary.range();
    let (core_from, core_to) = summary.core_range();
    let kind = serde_json::to_value(summary.kind).unwrap_or_default();
    let gradients = open.source.whole(open.level).and_then(gradients);
    let fields = json!({
        "digest": info.digest.to_string(),
        "dims": lattice.dims,
        "steps": lattice.steps.map(|v| v.to_array()),
        "box": world_box(lattice),
        "unit": if served.anatomical { "mm" } else { "" },
        "anatomical": served.anatomical,
        "up": up.to_string(),
        "front": front.to_string(),
        "sample_kind": kind,
        "range": [lowest, highest],
        "core": [core_from, core_to],
        "histogram": {"from": from, "to": to, "counts": counts},
        "gradients": gradients.map(|Gradients { to, counts }| json!({"to": to, "counts": counts})),
        "hounsfield": Levels::from_summary(summary).water.is_some(),
        "nan": summary.nan,
        "presets": presets_of(info),
    });
    Facts(fields.to_string())
}

/// Merges the texts of two non-empty JSON objects into the text of one.
fn joined(a: &Value, b: &str) -> String {
    let mut text = a.to_string();
    text.pop();
    text.push(',');
    text.push_str(b.strip_prefix('{').unwrap_or(b));
    text
}

/// Returns the description of an open volume for a picture of `size`. The first of a volume and size
/// takes a tenth of a second: what can be seen is looked for.
///
/// # Errors
/// The volume's file can't be read, or no camera fits it.
pub(crate) fn describe(
    known: &Descriptions,
    open: &OpenVolume,
    name: &str,
    size: [u32; 2],
    home: &Home,
) -> Result<Described, Problem> {
    known.get(&open.served, name, size, || {
        let facts = known.facts(&open.served, || facts(open));
        describe_anew(open, name, size, home, &facts)
    })
}

fn describe_anew(
    open: &OpenVolume,
    name: &str,
    size: [u32; 2],
    home: &Home,
    facts: &Facts,
) -> Result<Described, Problem> {
    let served = &open.served;
    let info = &served.info;
    let lattice = &info.lattice;
    let home_tf = home.tf.clone().unwrap_or_else(|| TransferChoice::Name("auto".into()));
    let tf = function(&as_read_from_file(home_tf.clone(), info), info)?;
    let told_tf = match &home_tf {
        TransferChoice::Name(preset) => preset.as_str().into(),
        TransferChoice::Function(tf) => told(tf, info),
    };
    let key = Key { azimuth: Some(HOME_AZIMUTH), elevation: Some(0.0), ..Key::default() };
    let keyframes = KeyFrames {
        frames: 1,
        easing: Default::default(),
        up: None,
        front: None,
        keys: vec![key.clone()],
    };
    let path = ViewPath { keyframes: Some(keyframes), ..ViewPath::from_views(size, Vec::new()) };
    let framing = framed(open, &path, &tf)?;
    let [lo, hi] = world_box(lattice);
    let extent = (0..3).map(|a| hi[a] - lo[a]).fold(0.0, f64::max);
    let (target, height) = match framing {
        Some(framing) => (framing.target, framing.height),
        None => (lattice.centre().to_array(), 1.25 * extent),
    };
    // Short numbers for command lines and addresses: a ten-thousandth of the picture is no pixel.
    let digits = rounding(height);
    let short = |x: f64| rounded(x, digits);
    let target = target.map(short);
    let height = if short(height) > 0.0 { short(height) } else { height };
    let camera = Key { target: Some(target), height: Some(height), ..key };
    let own = json!({
        "type": "volume",
        "name": name,
        "file": home.file.as_deref().unwrap_or(name),
        "home": {"camera": camera, "tf": told_tf},
    });
    let shown = Shown {
        served: served.clone(),
        is_large: open.source.whole(open.level).is_none(),
        home: camera,
        home_tf,
    };
    Ok(Described { shown: Arc::new(shown), message: joined(&own, &facts.0).into() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Volume;
    use slabcast_master::Library;
    use slabcast_master::library::Viewer;

    #[test]
    fn pages_of_one_size_share_a_description() {
        let ball = Volume::from_fn_u8("ball", [16; 3], |i, j, k| (i * j * k / 16) as u8);
        let library = Library::of(ball, Orientation::new(None, None).expect("defaults"));
        let open = library.open(&VolumeChoice::Default, Viewer::own()).expect("it is there");
        let known = Descriptions::default();
        let home = Home::default();
        let of = |size| describe(&known, &open, "ball", size, &home).expect("it fits");
        let (one, same, wide) = (of([64, 64]), of([64, 64]), of([128, 64]));
        assert!(Arc::ptr_eq(&one.shown, &same.shown));
        assert_eq!(one.message.as_ptr(), same.message.as_ptr(), "the same bytes");
        assert!(!Arc::ptr_eq(&one.shown, &wide.shown), "another picture is framed anew");
        let message: Value = serde_json::from_str(&one.message).expect("JSON");
        assert_eq!((&message["type"], &message["name"]), (&json!("volume"), &json!("ball")));
        assert_eq!(
            (&message["dims"], &message["home"]["tf"]),
            (&json!([16, 16, 16]), &json!("auto"))
        );
        assert_eq!(message["presets"][0]["name"], "auto");
        let counts = message["gradients"]["counts"].as_array().expect("a histogram");
        assert_eq!((counts.len(), message["gradients"]["to"].as_f64() > Some(0.0)), (64, true));
    }

    #[test]
    fn home_views_have_short_numbers() {
        let decimals = rounding(265.882_352_977_647_1);
        assert_eq!(decimals, 2);
        assert_eq!(rounded(133.991_509_318_351_75, decimals), 133.99);
        assert_eq!(rounded(143.000_000_015_5, decimals), 143.0);
        assert_eq!(rounded(0.012_345, rounding(0.5)), 0.012_35);
        assert_eq!(rounded(123_456.0, rounding(5e7)), 123_000.0);
        assert_eq!(rounded(-0.000_1, 2).to_string(), "0");
    }
}
