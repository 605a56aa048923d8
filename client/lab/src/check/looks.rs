//! Transfer functions of golden frames: fixed, while presets improve.
//!
//! A golden frame watches the arithmetic behind pixels. If it were drawn with a preset by name, a
//! better rule for where air ends would look like a broken renderer. So these functions are what
//! `auto`, `grey` and `bone` gave for these volumes when the first golden frames were made.

use slabcast_common::shade::Shading;
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};

/// Returns the transfer function of the golden case `case`, if its preset may change.
pub(super) fn golden_transfer(case: &str) -> Option<TransferFunction> {
    let tf = match case {
        "mni152_t1/auto" => surface(
            [0.2147058823529412, 0.392_114_571_318_718_6, 0.569523260284506, 0.9215686274509803],
            [0.3220588235294118, 0.536764705882353],
        ),
        "spheres/auto" | "spheres/auto/i16" | "spheres/auto/bspline" | "spheres/auto/tent" => {
            surface(
                [0.178125, 0.38439950980392157, 0.5906740196078432, 1.0],
                [0.2671875, 0.4453125],
            )
        }
        "mni152_t1/grey" => fog([0.3220588235294118, 0.9215686274509803]),
        "fog/grey" => fog([0.28125, 0.8333333333333334]),
        "spheres/glass" => TransferFunction {
            gradient_opacity: vec![[0.02, 0.0], [0.12, 0.25], [0.3, 1.0]],
            ..surface([0.0, 0.3, 0.6, 1.0], [0.1, 0.4])
        },
        "line/bone" => TransferFunction {
            colors: vec![
                [0.5, 0.78, 0.70, 0.58],
                [0.7509803921568627, 0.93, 0.89, 0.80],
                [1.0, 1.0, 0.99, 0.96],
            ],
            ..surface([0.0; 4], [0.7130000000000001, 0.8250000000000001])
        },
        _ => return None,
    };
    Some(tf)
}

/// Opaque and lit, in warm colours at four places.
fn surface(at: [f64; 4], [from, to]: [f64; 2]) -> TransferFunction {
    let warm = [[0.90, 0.68, 0.55], [0.93, 0.73, 0.60], [0.97, 0.86, 0.76], [1.0, 0.97, 0.92]];
    TransferFunction {
        colors: at.iter().zip(warm).map(|(&x, [r, g, b])| [x, r, g, b]).collect(),
        shading: Shading::default(),
        ..grey(vec![[0.0, 0.0], [from, 0.0], [to, 1.0], [1.0, 1.0]])
    }
}

/// Translucent grey.
fn fog([from, to]: [f64; 2]) -> TransferFunction {
    grey(vec![[0.0, 0.0], [from, 0.0], [to, 0.06], [1.0, 0.06]])
}

/// Unlit grey with these opacities.
pub(super) fn grey(opacities: Vec<[f64; 2]>) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Unit,
        colors: vec![[0.0, 0.35, 0.35, 0.35], [1.0, 1.0, 1.0, 1.0]],
        opacities,
        color_space: ColorSpace::Srgb,
        opacity_unit: OpacityUnit::AlphaPerVox,
        nan: NanColour::default(),
        gradient_opacity: Vec::new(),
        shading: Shading { on: false, ..Shading::default() },
    }
}
