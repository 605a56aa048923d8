//! Transfer functions by name.
//!
//! For people: `auto` and named looks, whose ranges follow the volume's histogram. For
//! measuring: the `peer-*` ramps on raw 8-bit values (other types scaled from their smallest to
//! their largest value), the same that other renderers are measured with.

use crate::quality::Refused;
use crate::shade::Shading;
use crate::transfer::{ColorSpace, Domain, NanLook, OpacityUnit, TransferFunction};
use crate::volume::{SampleKind, ValueSummary};

/// Every name and what it is for, in the order of the help text.
pub const NAMES: [(&str, &str); 10] = [
    ("auto", "cuts the air at the histogram's valley; opaque, lit"),
    ("skin", "the outermost surface, in a skin's colours"),
    ("bone", "what is dense: the upper third above the air"),
    ("vessels", "bright, thin structures in red"),
    ("brain", "soft tissue, in a brain's colours"),
    ("grey", "translucent grey fog of everything above the air, unlit"),
    ("peer-opaque", "for measuring: opaque from 38 to 64"),
    ("peer-semi", "for measuring: at most 0.05 a voxel"),
    ("peer-vessels", "for measuring: 0 at 60, 0.8 at 120, 1 at 255"),
    ("peer-skull", "for measuring: 0 at 25, 1 at 45"),
];

const WARM: [[f64; 4]; 4] = [
    [0.0, 0.90, 0.68, 0.55],
    [64.0, 0.93, 0.73, 0.60],
    [128.0, 0.97, 0.86, 0.76],
    [255.0, 1.0, 0.97, 0.92],
];
const RED: [[f64; 4]; 4] = [
    [0.0, 0.7, 0.1, 0.1],
    [60.0, 0.8, 0.2, 0.15],
    [160.0, 0.95, 0.45, 0.35],
    [255.0, 1.0, 0.9, 0.8],
];

/// The transfer function called `name`, fitted to a volume with these values.
pub fn by_name(name: &str, summary: &ValueSummary) -> Result<TransferFunction, Refused> {
    let opaque_solid = |colors: &[[f64; 4]], lo: f64, hi: f64| {
        unit_tf(colors, &[[0.0, 0.0], [lo, 0.0], [hi, 1.0], [1.0, 1.0]])
    };
    let (air, top) = (air_cut(summary), upper_bound(summary));
    // A ramp around the cut: a quarter of the way down to the air and up to the tissue, so that
    // the surface is where the field crosses the cut and its steepness follows the data.
    let (lo, hi) = (air * 0.75, (air * 1.25).min(air + (top - air) * 0.5));
    let tf = match name {
        "auto" => opaque_solid(&stretch(&WARM, air * 0.5, top), lo, hi),
        "skin" => opaque_solid(&stretch(&WARM, 0.0, top), lo * 0.8, hi * 0.9),
        "bone" => {
            let cut = air + (top - air) * 0.55;
            let ivory =
                [[0.0, 0.78, 0.70, 0.58], [128.0, 0.93, 0.89, 0.80], [255.0, 1.0, 0.99, 0.96]];
            opaque_solid(&stretch(&ivory, air, top), cut * 0.92, cut + (top - air) * 0.1)
        }
        "vessels" => {
            let cut = air + (top - air) * 0.2;
            unit_tf(
                &stretch(&RED, air, top),
                &[[0.0, 0.0], [air, 0.0], [cut, 0.5], [top.max(cut), 0.95], [1.0, 0.95]],
            )
        }
        "brain" => {
            let pink = [
                [0.0, 0.70, 0.42, 0.40],
                [110.0, 0.86, 0.62, 0.57],
                [190.0, 0.95, 0.82, 0.76],
                [255.0, 1.0, 0.95, 0.90],
            ];
            opaque_solid(&stretch(&pink, 0.0, top), lo, hi)
        }
        "grey" => {
            let mut tf = unit_tf(
                &[[0.0, 0.35, 0.35, 0.35], [1.0, 1.0, 1.0, 1.0]],
                &[[0.0, 0.0], [lo, 0.0], [top, 0.06], [1.0, 0.06]],
            );
            tf.shading.on = false;
            tf
        }
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
        _ => {
            let names: Vec<&str> = NAMES.iter().map(|(n, _)| *n).collect();
            let nearest = names
                .iter()
                .filter(|n| distance(name, n) <= 2)
                .min_by_key(|n| distance(name, n))
                .map(|n| format!("did you mean `{n}`? "))
                .unwrap_or_default();
            return Err(Refused::new(
                "tf",
                format!(
                    "`{name}` is neither a preset nor a file; {nearest}presets are {}",
                    names.join(", ")
                ),
            ));
        }
    };
    Ok(tf)
}

/// A transfer function over `[0, 1]` from the smallest to the largest value.
fn unit_tf(colors: &[[f64; 4]], opacities: &[[f64; 2]]) -> TransferFunction {
    let mut opacities = opacities.to_vec();
    for i in 0..opacities.len() {
        let before = if i == 0 { 0.0 } else { opacities[i - 1][0] };
        opacities[i][0] = opacities[i][0].clamp(before, 1.0);
    }
    TransferFunction {
        version: 1,
        domain: Domain::Unit,
        colors: colors.to_vec(),
        opacities,
        color_space: ColorSpace::Srgb,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanLook::default(),
        gradient_opacity: Vec::new(),
        shading: Shading::default(),
    }
}

/// The measuring ramps: x are raw 8-bit values; other types are scaled to 0..255.
fn peer(summary: &ValueSummary, colors: &[[f64; 4]], opacities: &[[f64; 2]]) -> TransferFunction {
    let raw = summary.kind == SampleKind::U8;
    let x = |x: f64| if raw { summary.map.value(x) } else { x / 255.0 };
    let mut tf = unit_tf(&[], &[]);
    tf.domain = if raw { Domain::Value } else { Domain::Unit };
    tf.colors = colors.iter().map(|c| [x(c[0]), c[1], c[2], c[3]]).collect();
    tf.opacities = opacities.iter().map(|o| [x(o[0]), o[1]]).collect();
    if raw && summary.map.scale < 0.0 {
        tf.colors.reverse();
        tf.opacities.reverse();
    }
    tf
}

/// Colours given over 0..255, spread from `lo` to `hi` of the unit domain.
fn stretch(colors: &[[f64; 4]], lo: f64, hi: f64) -> Vec<[f64; 4]> {
    colors.iter().map(|c| [lo + (hi - lo).max(1e-6) * c[0] / 255.0, c[1], c[2], c[3]]).collect()
}

/// Histogram in unit coordinates: `(centre, count)`.
fn unit_histogram(s: &ValueSummary) -> Vec<(f64, f64)> {
    let span = s.max_code - s.min_code;
    (0..256)
        .filter(|&b| s.histogram[b] > 0)
        .map(|b| {
            let centre =
                if s.kind == SampleKind::U8 { s.bin_code(b) } else { s.bin_code(b) + span / 512.0 };
            let t = if span > 0.0 { (centre - s.min_code) / span } else { 0.0 };
            (if s.map.scale < 0.0 { 1.0 - t } else { t }, s.histogram[b] as f64)
        })
        .collect()
}

/// Where the air ends, as a share of the range: Otsu's threshold (the cut that separates the
/// histogram into two classes of least inner variance; N. Otsu 1979), on square roots of counts,
/// so that a sea of air does not drown a thin object.
pub fn air_cut(summary: &ValueSummary) -> f64 {
    let mut h = unit_histogram(summary);
    h.sort_by(|a, b| a.0.total_cmp(&b.0));
    for p in &mut h {
        p.1 = p.1.sqrt();
    }
    let (mut total, mut sum) = (0.0, 0.0);
    for (x, n) in &h {
        total += n;
        sum += x * n;
    }
    let (mut below, mut below_sum, mut best) = (0.0, 0.0, (f64::NEG_INFINITY, 0.0));
    for i in 0..h.len().saturating_sub(1) {
        below += h[i].1;
        below_sum += h[i].0 * h[i].1;
        let above = total - below;
        let apart = below_sum / below - (sum - below_sum) / above;
        let between = below * above * apart * apart;
        if between > best.0 {
            best = (between, 0.5 * (h[i].0 + h[i + 1].0));
        }
    }
    best.1
}

/// Where bright ends: the value that 0.2 % of what is above the air exceed.
fn upper_bound(summary: &ValueSummary) -> f64 {
    let air = air_cut(summary);
    let mut h = unit_histogram(summary);
    h.sort_by(|a, b| b.0.total_cmp(&a.0));
    let solid: f64 = h.iter().filter(|p| p.0 >= air).map(|p| p.1).sum();
    let mut seen = 0.0;
    for (x, n) in h {
        seen += n;
        if seen >= solid * 0.002 {
            return x.max(air + 0.02).min(1.0);
        }
    }
    1.0
}

/// Edits between two short words (Levenshtein).
pub fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let change = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = change.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::volume::{Samples, ValueMap};

    #[test]
    fn every_preset_passes_its_own_check_on_every_kind_of_volume() {
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
                let s = ValueSummary::of(&v, map);
                for (name, _) in NAMES {
                    let tf = by_name(name, &s).unwrap();
                    tf.check().unwrap_or_else(|e| panic!("{name} on {s:?}: {e}"));
                }
            }
        }
    }

    #[test]
    fn unknown_names_are_told_what_there_is() {
        let s = ValueSummary::of(&Samples::U8(vec![0, 255]), ValueMap::IDENTITY);
        let e = by_name("bonee", &s).unwrap_err().to_string();
        assert!(e.contains("did you mean `bone`") && e.contains("peer-opaque"), "{e}");
        assert!(!by_name("/no/such/file", &s).unwrap_err().to_string().contains("mean"));
    }

    #[test]
    fn air_cut_finds_a_thin_object_in_a_sea_of_air() {
        // Less than 1 % bright voxels, as in an angiogram.
        let mut v = vec![0u8; 100_000];
        for i in 0..20_000 {
            v[i] = (i % 12) as u8;
        }
        for i in 0..600 {
            v[i] = 90 + (i % 160) as u8;
        }
        let s = ValueSummary::of(&Samples::U8(v), ValueMap::IDENTITY);
        let cut = air_cut(&s) * 249.0;
        assert!((12.0..100.0).contains(&cut), "cut at {cut}");
    }
}
