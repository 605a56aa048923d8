//! Transfer functions by name.
//!
//! For people: `auto`, named presets and perceptual colour maps, whose ranges follow the volume's
//! histogram ([`Levels`]), or Hounsfield units where the values are those of a CT. For measuring:
//! the `peer-*` ramps on raw 8-bit values (other types scaled from their smallest to their largest
//! value), the same that other renderers are measured with.
//!
//! Each preset has three parts (docs/reference/transfer-functions.md has them as a table): a *range
//! rule*, where opacity begins and how it grows; a *technique*, a surface (opaque within a few
//! voxels), layers (a translucent outside over a dense inside) or a fog (nothing hides anything);
//! and its *light*.

mod levels;
mod maps;

pub use levels::{Content, Levels};
pub use maps::{MAPS, colour_map};

use slabcast_common::quality::InvalidField;
use slabcast_common::shade::{Light, Shading};
use slabcast_common::spelling::nearest;
use slabcast_common::transfer::{
    ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction, interpolate,
};
use slabcast_common::volume::{ColourValue, SampleKind, ValueSummary};

/// Names of the presets and what each is for, in the order of the help text. [`MAPS`] has the
/// colour maps.
pub const NAMES: [(&str, &str); 20] = [
    ("auto", "cuts the air and draws what is there as surface or cloud, grey unless it is a body"),
    ("skin", "the outermost surface, in a skin's colours"),
    ("bone", "what is dense: bone of a CT, the upper half above the air else"),
    ("vessels", "bright, thin structures in red"),
    ("brain", "soft tissue, in a brain's colours"),
    ("muscle", "translucent flesh over what is dense"),
    ("lung", "what is hardly denser than air, translucent, over bone"),
    ("teeth", "translucent dentine over enamel: the densest quarter"),
    ("engine", "a translucent casting over the densest tenth in orange"),
    ("metal", "the densest tenth alone, as polished steel"),
    ("plant", "green where thin, brown where dense"),
    ("glass", "borders between materials alone, as of clear glass"),
    ("fog", "white fog, unlit: denser is whiter"),
    ("fire", "black, red, yellow, unlit: as of something that glows"),
    ("xray", "faint all through, unlit: dark bones on light film turned over"),
    ("grey", "translucent grey of everything above the air, unlit"),
    ("peer-opaque", "for measuring: opaque from 38 to 64"),
    ("peer-semi", "for measuring: at most 0.05 a voxel"),
    ("peer-vessels", "for measuring: 0 at 60, 0.8 at 120, 1 at 255"),
    ("peer-skull", "for measuring: 0 at 25, 1 at 45"),
];

/// Colour points over 0 to 255, stretched over a range.
type Colours = [[f64; 4]];

const WARM: [[f64; 4]; 4] = [
    [0.0, 0.90, 0.68, 0.55],
    [64.0, 0.93, 0.73, 0.60],
    [128.0, 0.97, 0.86, 0.76],
    [255.0, 1.0, 0.97, 0.92],
];
/// Colours for values of unknown origin.
const STONE: [[f64; 4]; 3] =
    [[0.0, 0.80, 0.77, 0.72], [128.0, 0.89, 0.87, 0.83], [255.0, 1.0, 0.99, 0.96]];
const RED: [[f64; 4]; 4] = [
    [0.0, 0.78, 0.16, 0.13],
    [60.0, 0.85, 0.25, 0.19],
    [160.0, 0.95, 0.45, 0.35],
    [255.0, 1.0, 0.9, 0.8],
];
const IVORY: [[f64; 4]; 3] =
    [[0.0, 0.89, 0.83, 0.72], [128.0, 0.95, 0.91, 0.83], [255.0, 1.0, 0.99, 0.96]];
const PINK: [[f64; 4]; 4] = [
    [0.0, 0.88, 0.66, 0.61],
    [110.0, 0.91, 0.73, 0.68],
    [190.0, 0.95, 0.84, 0.79],
    [255.0, 1.0, 0.95, 0.90],
];
const FLESH: [[f64; 4]; 4] = [
    [0.0, 0.95, 0.78, 0.55],
    [80.0, 0.80, 0.30, 0.24],
    [150.0, 0.90, 0.55, 0.45],
    [255.0, 1.0, 0.98, 0.94],
];
const BREATH: [[f64; 4]; 3] =
    [[0.0, 0.55, 0.70, 0.90], [120.0, 0.85, 0.62, 0.65], [255.0, 1.0, 0.97, 0.90]];
const DENTINE: [[f64; 4]; 3] =
    [[0.0, 0.75, 0.50, 0.32], [150.0, 0.95, 0.85, 0.62], [255.0, 1.0, 1.0, 0.98]];
const CASTING: [[f64; 4]; 4] = [
    [0.0, 0.55, 0.60, 0.66],
    [120.0, 0.72, 0.77, 0.82],
    [160.0, 0.98, 0.55, 0.12],
    [255.0, 1.0, 0.80, 0.35],
];
const STEEL: [[f64; 4]; 2] = [[0.0, 0.62, 0.65, 0.70], [255.0, 0.92, 0.94, 0.96]];
const LEAVES: [[f64; 4]; 4] = [
    [0.0, 0.30, 0.55, 0.16],
    [35.0, 0.42, 0.62, 0.21],
    [70.0, 0.58, 0.42, 0.24],
    [255.0, 0.86, 0.72, 0.54],
];
const EMBERS: [[f64; 4]; 5] = [
    [0.0, 0.10, 0.02, 0.02],
    [60.0, 0.65, 0.10, 0.03],
    [130.0, 0.95, 0.45, 0.08],
    [200.0, 1.0, 0.85, 0.35],
    [255.0, 1.0, 1.0, 0.90],
];
const GLASS: [[f64; 4]; 3] =
    [[0.0, 0.55, 0.70, 0.90], [128.0, 0.95, 0.90, 0.85], [255.0, 1.0, 1.0, 1.0]];
const MIST: [[f64; 4]; 2] = [[0.0, 0.75, 0.80, 0.86], [255.0, 1.0, 1.0, 1.0]];
const FILM: [[f64; 4]; 2] = [[0.0, 0.55, 0.62, 0.70], [255.0, 0.97, 0.99, 1.0]];
const GREY: [[f64; 4]; 2] = [[0.0, 0.35, 0.35, 0.35], [255.0, 1.0, 1.0, 1.0]];

/// Returns the transfer function called `name` (a preset or a colour map), fitted to a volume with
/// values `summary`.
///
/// # Errors
/// If there is none of that name; the error lists all, and the nearest first.
pub fn by_name(name: &str, summary: &ValueSummary) -> Result<TransferFunction, InvalidField> {
    let l = Levels::from_summary(summary);
    let at = hounsfield(summary, &l);
    let (air, solid, top) = (l.air, l.solid, l.top);
    let body = summary.anatomical || at.is_some();
    let unlit = |tf: TransferFunction| TransferFunction {
        shading: Shading { on: false, ..Shading::default() },
        ..tf
    };
    let fog = |colours: &Colours, alpha: f64| {
        unlit(look(colours, [air, top], &[[air, 0.0], [top, alpha]]))
    };
    // Start of dense matter in volumes without Hounsfield units.
    let dense = air + (top - air) * 0.55;
    // The opacity that the file gives its voxels.
    let alpha = summary.palette.as_ref().is_some_and(|p| p.value() == ColourValue::Alpha);
    let tf = match name {
        "auto" if alpha => {
            let tf = look(&STONE, [0.0, 1.0], &[]);
            let opacities = vec![[0.0, 0.0], [255.0, 1.0]];
            return Ok(TransferFunction { domain: Domain::Value, opacities, ..tf });
        }
        // Flat colours in black have no air by the histogram: each value is a peak.
        "auto" if summary.palette.is_some() && black_is_air(summary, &l) => {
            surface(&STONE, [0.0, 1.0], 0.0, FULL_COLOUR / summary.max_code.max(FULL_COLOUR))
        }
        // In a CT the skin would hide the bones, and the couch the body.
        "auto" if at.is_some() => return by_name("muscle", summary),
        // At the edge of a mask nothing is to be seen but the mask.
        "auto" if body && l.masked => return by_name("brain", summary),
        "auto" => auto(&l, if body { &WARM } else { &STONE }),
        "skin" => match &at {
            Some(hu) => surface(&WARM, [hu(-500.0), hu(400.0)], hu(-420.0), hu(-180.0)),
            None => surface(&WARM, [air, top], air, solid),
        },
        "bone" => match &at {
            Some(hu) => surface(&IVORY, [hu(100.0), hu(1400.0)], hu(140.0), hu(320.0)),
            // Bone alone, as of a skull in air: all of it.
            None if l.content == Content::Sparse => surface(&IVORY, [air, top], air, solid),
            None => surface(&IVORY, [air, top], dense * 0.92, dense + (top - air) * 0.1),
        },
        "vessels" => match (&at, l.content) {
            (Some(hu), _) => surface(&RED, [hu(80.0), hu(600.0)], hu(120.0), hu(280.0)),
            (None, Content::Sparse) => surface(&RED, [air, top], air, solid),
            (None, _) => {
                let cut = air + (top - air) * 0.2;
                look(&RED, [cut, top], &[[air, 0.0], [cut, 0.5], [top.max(cut), 0.95]])
            }
        },
        "brain" => match &at {
            Some(hu) => surface(&PINK, [hu(-20.0), hu(100.0)], hu(-10.0), hu(25.0)),
            // Between what fills the furrows and what they are in: at the end of the air stands
            // the brain's envelope.
            None => {
                let way = |share: f64| air + (l.mid - air) * share;
                surface(&PINK, [air, top], way(0.45), way(0.8))
            }
        },
        "muscle" => match &at {
            Some(hu) => layers(
                &FLESH,
                [hu(-150.0), hu(700.0)],
                [hu(-80.0), hu(20.0)],
                0.04,
                [hu(170.0), hu(320.0)],
            ),
            None => layers(&FLESH, [air, top], [air, solid], 0.04, [dense * 0.95, l.densest]),
        },
        "lung" => match &at {
            Some(hu) => look(
                &BREATH,
                [hu(-950.0), hu(500.0)],
                &[
                    [hu(-960.0), 0.0],
                    [hu(-850.0), 0.010],
                    [hu(-650.0), 0.025],
                    [hu(-450.0), 0.0],
                    [hu(150.0), 0.0],
                    [hu(400.0), 0.30],
                ],
            ),
            // A shell about the end of the air, and what is dense inside.
            None => look(
                &BREATH,
                [air * 0.5, top],
                &[
                    [air * 0.5, 0.0],
                    [air.max(0.01), 0.03],
                    [solid, 0.004],
                    [dense, 0.004],
                    [l.densest.max(dense), 0.30],
                ],
            ),
        },
        "teeth" => match &at {
            Some(hu) => layers(
                &DENTINE,
                [hu(400.0), hu(2600.0)],
                [hu(500.0), hu(900.0)],
                0.05,
                [hu(1500.0), hu(1900.0)],
            ),
            None => layers(&DENTINE, [air, top], [air, solid], 0.05, [l.dense, l.densest]),
        },
        "engine" => {
            let inside = l.densest.max(solid + (top - solid) * 0.3);
            layers(
                &CASTING,
                [air, top],
                [air, solid],
                0.04,
                [inside, inside + (top - inside) * 0.3],
            )
        }
        "metal" => {
            let cut = match &at {
                Some(hu) => hu(1800.0).min(top),
                None => l.densest,
            };
            let mut tf = surface(&STEEL, [cut, top], cut * 0.97, cut + (top - cut) * 0.2);
            let gloss = Shading { diffuse: 0.7, specular: 0.5, power: 40.0, ..Shading::default() };
            tf.shading = gloss;
            tf
        }
        "plant" => surface(&LEAVES, [air, top], air, solid),
        "glass" => TransferFunction {
            gradient_opacity: vec![[0.02, 0.0], [0.12, 0.25], [0.3, 1.0]],
            // Many faint borders behind each other: from aside their noise would be all shadows.
            shading: Shading { light: Light::Head, ..Shading::default() },
            ..look(&GLASS, [air, top], &[[air, 0.0], [solid, 0.08], [top, 0.2]])
        },
        "fog" => fog(&MIST, 0.03),
        "fire" => {
            let mid = (air + top) * 0.5;
            unlit(look(&EMBERS, [air, top], &[[air, 0.0], [mid, 0.02], [top, 0.12]]))
        }
        "xray" => fog(&FILM, 0.012),
        "grey" => fog(&GREY, 0.06),
        "peer-opaque" => {
            peer(summary, &WARM, &[[0.0, 0.0], [38.0, 0.0], [64.0, 1.0], [255.0, 1.0]])
        }
        "peer-semi" => {
            peer(summary, &WARM, &[[0.0, 0.0], [38.0, 0.0], [128.0, 0.05], [255.0, 0.05]])
        }
        "peer-vessels" => {
            peer(summary, &RED, &[[0.0, 0.0], [60.0, 0.0], [120.0, 0.8], [255.0, 1.0]])
        }
        "peer-skull" => peer(summary, &WARM, &[[0.0, 0.0], [25.0, 0.0], [45.0, 1.0], [255.0, 1.0]]),
        map => {
            let Some(colours) = colour_map(map) else { return Err(unknown_name(map)) };
            // Unlit, since light would change what a colour says; thin enough to see through.
            let mut tf = unlit(look(&[], [air, top], &[[air, 0.0], [solid, 0.03], [top, 0.10]]));
            tf.colors = stretch_colours(&colours, air, top);
            tf
        }
    };
    Ok(if name.starts_with("peer-") { tf } else { over_whole_range(tf, summary) })
}

/// Value of a colour from which on it is opaque in black.
const FULL_COLOUR: f64 = 24.0;

/// Returns whether a twentieth of the colours is black where levels find something everywhere.
fn black_is_air(summary: &ValueSummary, levels: &Levels) -> bool {
    let black = if summary.min_code == 0.0 { summary.histogram[0] } else { 0 };
    levels.content == Content::Everywhere && black.saturating_mul(20) >= summary.total()
}

/// Returns a function over the range that presets are fitted to as one over the whole volume.
fn over_whole_range(tf: TransferFunction, summary: &ValueSummary) -> TransferFunction {
    if summary.core.is_none() {
        return tf;
    }
    let ((lo, hi), (from, to)) = (summary.range(), summary.core_range());
    // In the file's values: shares of a range that ends at 1e30 would have no digits left. But
    // gradients are per mm then, which a preset does not know.
    let shares = !tf.gradient_opacity.is_empty();
    let place = |t: f64| {
        let value = from + (to - from) * t;
        if shares { ((value - lo) / (hi - lo)).clamp(0.0, 1.0) } else { value }
    };
    TransferFunction {
        domain: if shares { Domain::Unit } else { Domain::Value },
        colors: tf.colors.iter().map(|c| [place(c[0]), c[1], c[2], c[3]]).collect(),
        opacities: tf.opacities.iter().map(|o| [place(o[0]), o[1]]).collect(),
        gradient_opacity: tf
            .gradient_opacity
            .iter()
            .map(|g| [g[0] * (to - from) / (hi - lo), g[1]])
            .collect(),
        ..tf
    }
}

/// Returns the reason why the preset `name` may not show what its name says in a volume with values
/// `summary`; `None` if it does, as far as the values tell.
pub fn caveat(name: &str, summary: &ValueSummary) -> Option<&'static str> {
    let l = Levels::from_summary(summary);
    let whole = matches!(l.content, Content::Solid | Content::Cloud | Content::Everywhere);
    match (name, hounsfield(summary, &l)) {
        ("bone", None) if whole => Some(
            "the values are not those of a CT, so the upper half of them is taken for bone; of an \
             MRI that is fat and white matter, and bone can't be told from air",
        ),
        ("lung", None) => Some(
            "the values are not those of a CT, so a shell at the end of the air is drawn; it is a \
             lung only if the volume shows one",
        ),
        ("brain", Some(_)) => Some("in a CT skull and skin hide the brain; --crop cuts into them"),
        ("brain", None) if whole && !l.masked => Some(
            "skin and skull are still there and hide the brain; strip them first, or cut into them \
             by --crop",
        ),
        ("metal", Some(hu)) if hu(1800.0) >= 1.0 => Some(
            "nothing in this CT is as dense as metal (1800 HU); the densest of it is drawn instead",
        ),
        _ => None,
    }
}

/// Returns the error for a name that is neither a preset nor a map, with the nearest one.
pub fn unknown_name(name: &str) -> InvalidField {
    let names: Vec<&str> = NAMES.iter().chain(&MAPS).map(|(n, _)| *n).collect();
    let meant = nearest(name, &names).map(|n| format!("did you mean `{n}`? ")).unwrap_or_default();
    let (presets, maps) = names.split_at(NAMES.len());
    InvalidField::new(
        "tf",
        format!(
            "`{name}` is neither a preset nor a file; {meant}presets are {}; maps are {}",
            presets.join(", "),
            maps.join(", ")
        ),
    )
}

/// Returns a preset for whatever there is: a surface where there is one, else a cloud that can be
/// seen through.
fn auto(l: &Levels, colours: &Colours) -> TransferFunction {
    let (air, solid, top) = (l.air, l.solid, l.top);
    match l.content {
        Content::Solid | Content::Sparse => surface(colours, [air, top], air, solid),
        Content::Cloud => look(
            &EMBERS,
            [air, top],
            &[[air, 0.0], [l.mid, 0.02], [l.dense.max(l.mid), 0.08], [top, 0.4]],
        ),
        // Nothing is air, so everything is shown, the lowest hardly.
        Content::Everywhere => look(colours, [0.0, 1.0], &[[0.0, 0.0], [1.0, 0.08]]),
        // By `Classifier`, the one value is 0 of the range: nothing to see, and the caller says
        // so. An opaque block would be no better.
        Content::Constant => surface(colours, [0.0, 1.0], 0.25, 0.75),
    }
}

/// Returns the map from Hounsfield units to shares of the range, where the values are those of a
/// CT.
fn hounsfield(summary: &ValueSummary, l: &Levels) -> Option<impl Fn(f64) -> f64> {
    let water = l.water?;
    let (lo, hi) = summary.core_range();
    Some(move |hu: f64| ((hu + water - lo) / (hi - lo)).clamp(0.0, 1.0))
}

/// Returns a lit surface: opaque within a short ramp. Up to the ramp's end it has one colour:
/// voxels at the surface are partly full, and colours over the ramp would say how much, which draws
/// rings on everything round.
fn surface(colours: &Colours, range: [f64; 2], from: f64, to: f64) -> TransferFunction {
    look(colours, [range[0].max(to), range[1]], &[[from, 0.0], [to, 1.0]])
}

/// Returns a translucent outside of at most `alpha` over an opaque inside.
fn layers(
    colours: &Colours,
    range: [f64; 2],
    outside: [f64; 2],
    alpha: f64,
    inside: [f64; 2],
) -> TransferFunction {
    let [a, b] = outside;
    let (c, d) = (inside[0].max(b), inside[1].max(inside[0]).max(b));
    let mut tf = look(colours, range, &[[a, 0.0], [b, alpha], [c, alpha], [d, 0.9]]);
    // One colour over each ramp, as for a surface: at the outer one its first, at the inner one its
    // last, by a step. What lies between the two keeps its own.
    let at = |x: f64, place: f64| {
        let [_, r, g, b] = interpolate(&tf.colors, place);
        [x, r, g, b]
    };
    let between =
        |lo: f64, hi: f64| tf.colors.iter().copied().filter(move |p| p[0] > lo && p[0] < hi);
    let outer = [at(a, a), at(b, a)];
    let inner = [at(c, c), at(c, d), at(d, d)];
    tf.colors =
        outer.into_iter().chain(between(b, c)).chain(inner).chain(between(d, 2.0)).collect();
    tf
}

/// Returns a lit function of colours over a range and opacities, both over `[0, 1]` from the
/// smallest to the largest value.
fn look(colours: &Colours, range: [f64; 2], opacities: &[[f64; 2]]) -> TransferFunction {
    let over_bytes: Vec<[f64; 4]> =
        colours.iter().map(|c| [c[0] / 255.0, c[1], c[2], c[3]]).collect();
    let mut ascending: Vec<[f64; 2]> = vec![[0.0, opacities.first().map_or(0.0, |o| o[1])]];
    for o in opacities {
        let before = ascending.last().map_or(0.0, |o| o[0]);
        ascending.push([o[0].clamp(before, 1.0), o[1]]);
    }
    ascending.push([1.0, opacities.last().map_or(0.0, |o| o[1])]);
    TransferFunction {
        version: 1,
        domain: Domain::Unit,
        colors: stretch_colours(&over_bytes, range[0], range[1]),
        opacities: ascending,
        color_space: ColorSpace::Srgb,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanColour::default(),
        gradient_opacity: Vec::new(),
        shading: Shading::default(),
    }
}

/// Stretches colour points `[t, r, g, b]` with t from 0 to 1 over the range from `lo` to `hi`.
pub fn stretch_colours(colours: &Colours, lo: f64, hi: f64) -> Vec<[f64; 4]> {
    let width = (hi - lo).max(1e-6);
    colours.iter().map(|c| [lo + width * c[0], c[1], c[2], c[3]]).collect()
}

/// Returns a ramp for measuring: x are raw 8-bit values; other types are scaled to 0..255.
fn peer(summary: &ValueSummary, colors: &Colours, opacities: &[[f64; 2]]) -> TransferFunction {
    let raw = summary.kind == SampleKind::U8;
    let x = |x: f64| if raw { summary.map.value(x) } else { x / 255.0 };
    let mut tf = look(colors, [0.0, 1.0], &[]);
    tf.domain = if raw { Domain::Value } else { Domain::Unit };
    // The lighting of the renderers that slabcast is compared with; it never changes.
    tf.shading = Shading {
        on: true,
        ambient: 0.2,
        diffuse: 0.7,
        specular: 0.1,
        power: 20.0,
        light: Light::Head,
    };
    tf.colors = colors.iter().map(|c| [x(c[0]), c[1], c[2], c[3]]).collect();
    tf.opacities = opacities.iter().map(|o| [x(o[0]), o[1]]).collect();
    if raw && summary.map.scale < 0.0 {
        tf.colors.reverse();
        tf.opacities.reverse();
    }
    tf
}

/// Returns the value at which the air ends.
pub fn air_end(summary: &ValueSummary) -> f64 {
    let (lo, hi) = summary.core_range();
    lo + (hi - lo) * Levels::from_summary(summary).air
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Samples, ValueMap};

    #[test]
    fn presets_pass_their_check_on_every_kind_of_volume() {
        let volumes = [
            Samples::U8((0..=255).collect()),
            Samples::U8(vec![7; 100]),
            Samples::U8([vec![0; 5000], vec![200; 50]].concat()),
            Samples::U16((0..9000u16).map(|i| i.wrapping_mul(7)).collect()),
            Samples::F32(vec![f32::NAN, -3.0, 8.5, 1e30]),
            Samples::F32(vec![f32::NAN]),
        ];
        for v in volumes {
            for map in [ValueMap::IDENTITY, ValueMap { scale: -2.5, offset: 10.0 }] {
                let s = ValueSummary::from_samples(&v, map);
                for (name, _) in NAMES.iter().chain(&MAPS) {
                    let tf = by_name(name, &s).unwrap();
                    tf.check().unwrap_or_else(|e| panic!("{name} on {s:?}: {e}"));
                }
            }
        }
    }

    #[test]
    fn brain_preset_shows_furrows() {
        // An average brain: a few samples of each value in the furrows, then grey and white matter.
        let hills = [(0, 80_000), (40, 800), (170, 9_000), (220, 6_000)];
        let v = hills.iter().flat_map(|&(at, n)| (0..n).map(move |i| (at + i % 30) as u8));
        let v = v.map(|x| if x < 30 { 0 } else { x }).collect();
        let s = ValueSummary::from_samples(&Samples::U8(v), ValueMap::IDENTITY);
        let opacity = |x: f64| {
            let tf = by_name("brain", &s).unwrap();
            slabcast_common::transfer::interpolate(&tf.opacities, x / 249.0)[1]
        };
        assert_eq!((opacity(55.0), opacity(175.0)), (0.0, 1.0));
    }

    /// Air, a gap, something solid: a body if `anatomical` says so.
    fn solid(anatomical: bool, more: &[f32]) -> ValueSummary {
        let air = std::iter::repeat_n(0.0f32, 70_000);
        let rest = (0..30_000).map(|i| 400.0 + (i % 500) as f32);
        let all = air.chain(rest).chain(more.iter().copied()).collect();
        let s = ValueSummary::from_samples(&Samples::F32(all), ValueMap::IDENTITY);
        ValueSummary { anatomical, ..s }
    }

    #[test]
    fn surfaces_have_one_colour_over_the_ramp_of_their_opacity() {
        let s = solid(true, &[]);
        for name in
            ["auto", "skin", "bone", "brain", "vessels", "muscle", "teeth", "plant", "metal"]
        {
            let tf = by_name(name, &s).unwrap();
            let steep = tf.opacities.windows(2).filter(|w| w[1][1] - w[0][1] > 0.5);
            for w in steep {
                let end = w[1][0];
                let colour = |x: f64| interpolate(&tf.colors, x);
                // Just right of the step, in its middle, and just left of its end: at a step the
                // later colour holds.
                for x in [0.001, 0.5, 0.999].map(|t| w[0][0] + (end - w[0][0]) * t) {
                    let (here, there) = (colour(x), colour(end));
                    let off = (1..4).map(|c| (here[c] - there[c]).abs());
                    assert!(off.fold(0.0, f64::max) < 1e-9, "{name} at {x} of {:?}", tf.opacities);
                }
            }
        }
    }

    #[test]
    fn auto_is_grey_unless_it_draws_a_body() {
        let warmth = |anatomical| {
            let tf = by_name("auto", &solid(anatomical, &[])).unwrap();
            tf.colors[0][1] - tf.colors[0][3]
        };
        assert!(warmth(true) > 0.2 && warmth(false) < 0.1);
    }

    #[test]
    fn hot_voxels_and_padding_do_not_move_a_preset() {
        let plain = solid(false, &[]);
        let (lo, hi) = plain.range();
        for far in [vec![1e6], vec![-32768.0; 5000]] {
            let s = solid(false, &far);
            for name in ["auto", "bone", "fog", "viridis"] {
                let (a, b) = (by_name(name, &plain).unwrap(), by_name(name, &s).unwrap());
                b.check().unwrap();
                assert_eq!(b.domain, Domain::Value);
                let rise =
                    |tf: &TransferFunction| tf.opacities.iter().find(|o| o[1] > 0.0).unwrap()[0];
                let (a, b) = (lo + (hi - lo) * rise(&a), rise(&b));
                assert!((a - b).abs() < 0.2 * (hi - lo), "{name} beside {}: {a} {b}", far[0]);
            }
            assert!((10.0..400.0).contains(&air_end(&s)), "{}", air_end(&s));
        }
    }

    #[test]
    fn a_preset_says_when_the_volume_has_not_what_it_shows() {
        let mri = solid(true, &[]);
        assert!(caveat("bone", &mri).unwrap().contains("MRI"));
        assert!(caveat("lung", &mri).unwrap().contains("CT"));
        assert_eq!(caveat("skin", &mri), None);
        // Bone alone in air, and a brain that was taken out of its head.
        let sparse: Vec<u8> =
            (0..90_000u32).map(|i| if i % 50 == 0 { (i % 200) as u8 } else { 0 }).collect();
        let sparse = ValueSummary::from_samples(&Samples::U8(sparse), ValueMap::IDENTITY);
        assert_eq!(caveat("bone", &sparse), None);
        assert_eq!(caveat("brain", &mri), None, "nothing lies between it and the air");
        let skin = solid(true, &(0..9000).map(|i| 60.0 + (i % 100) as f32).collect::<Vec<_>>());
        assert!(caveat("brain", &skin).unwrap().contains("skull"));
    }

    #[test]
    fn unknown_preset_names_get_the_nearest_and_all_names() {
        let s = ValueSummary::from_samples(&Samples::U8(vec![0, 255]), ValueMap::IDENTITY);
        let e = by_name("bonee", &s).unwrap_err().to_string();
        assert!(e.contains("did you mean `bone`") && e.contains("peer-opaque"), "{e}");
        assert!(by_name("gray", &s).unwrap_err().to_string().contains("did you mean `grey`"));
        assert!(!by_name("/no/such/file", &s).unwrap_err().to_string().contains("mean"));
    }

    #[test]
    fn air_ends_before_a_thin_object_in_much_air() {
        // Less than 1 % bright voxels, as in an angiogram.
        let mut v = vec![0u8; 100_000];
        for i in 0..20_000 {
            v[i] = (i % 12) as u8;
        }
        for i in 0..600 {
            v[i] = 90 + (i % 160) as u8;
        }
        let s = ValueSummary::from_samples(&Samples::U8(v), ValueMap::IDENTITY);
        let cut = air_end(&s);
        assert!((11.0..100.0).contains(&cut), "cut at {cut}");
    }

    #[test]
    fn auto_of_colours_takes_alpha_as_it_is_and_black_for_air() {
        use slabcast_common::volume::{Lattice, Palette, Volume};
        let summary = |colours: Vec<[u8; 4]>, value, places: Vec<u16>| {
            let alpha = value == ColourValue::Alpha;
            let palette = Palette::new(colours, alpha, value).unwrap();
            let lattice = Lattice::from_spacing([places.len() as u32, 1, 1], [1.0; 3]);
            Volume::coloured("c", "c", false, lattice, palette.into(), places).unwrap().summary
        };
        let clear = vec![[0, 0, 0, 0], [9, 9, 9, 100], [1, 2, 3, 255]];
        let tf = by_name("auto", &summary(clear, ColourValue::Alpha, vec![0, 1, 2])).unwrap();
        assert_eq!((tf.domain, tf.opacities), (Domain::Value, vec![[0.0, 0.0], [255.0, 1.0]]));
        // A third is black, and the rest are flat colours.
        let flat: Vec<[u8; 4]> = (0..9).map(|i| [i * 28, i * 28, i * 28, 255]).collect();
        let places: Vec<u16> = (0..1200).map(|i| if i % 3 == 0 { 0 } else { i % 9 }).collect();
        let s = summary(flat, ColourValue::Luminance, places);
        let tf = by_name("auto", &s).unwrap();
        let at = |value: f64| interpolate(&tf.opacities, value / s.max_code)[1];
        assert_eq!((at(0.0), at(28.0), at(224.0)), (0.0, 1.0, 1.0));
    }
}
