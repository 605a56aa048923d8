//! Transfer functions over a volume's values: presets as people read and change them, and back.

use crate::presets;
use crate::transfer::TransferChoice;
use slabcast_common::transfer::{Domain, TransferFunction};
use slabcast_common::volume::VolumeInfo;

/// Returns a function over shares of a volume's range as one over its values, for people to change.
///
/// Points are off by what a rounding of the last digit makes of them. [`printed_preset`] knows a preset
/// that was not changed by its numbers.
pub fn in_values(tf: &TransferFunction, info: &VolumeInfo) -> TransferFunction {
    if tf.domain == Domain::Value {
        return tf.clone();
    }
    let (lo, hi) = info.summary.range();
    let x = |x: f64| lo + x * (hi - lo);
    // Shares of the range over one vox become values over a unit of length.
    let slope = (hi - lo) / info.lattice.vox();
    TransferFunction {
        domain: Domain::Value,
        colors: tf.colors.iter().map(|c| [x(c[0]), c[1], c[2], c[3]]).collect(),
        opacities: tf.opacities.iter().map(|o| [x(o[0]), o[1]]).collect(),
        gradient_opacity: tf.gradient_opacity.iter().map(|g| [g[0] * slope, g[1]]).collect(),
        ..tf.clone()
    }
}

/// Returns the preset whose numbers, in this volume's values, are exactly those of `tf`, to the bit;
/// `None` if there is none. A function that was printed and read again is off by roundings of last
/// digits, which would change pixels.
pub fn printed_preset(tf: &TransferFunction, info: &VolumeInfo) -> Option<TransferFunction> {
    if tf.domain != Domain::Value {
        return None;
    }
    let names = presets::NAMES.iter().chain(&presets::MAPS);
    let mut all = names.filter_map(|(name, _)| presets::by_name(name, &info.summary).ok());
    all.find(|preset| in_values(preset, info) == *tf)
}

/// Returns the choice that draws the same bytes as `slabcast render --tf` with `choice` as the name
/// or the file: a function whose numbers are a preset's is that preset.
pub fn as_read_from_file(choice: TransferChoice, info: &VolumeInfo) -> TransferChoice {
    match choice {
        TransferChoice::Function(tf) => {
            TransferChoice::Function(printed_preset(&tf, info).map_or(tf, Box::new))
        }
        name @ TransferChoice::Name(_) => name,
    }
}
