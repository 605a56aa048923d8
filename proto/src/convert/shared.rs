//! Messages that both packages have, in the shape that both have today: quality, transfer
//! functions, backgrounds.
//!
//! This file is compiled once for each package, which the module around it names `wire`. On the
//! day that one of the two packages changes one of these messages, that package takes a copy.

use super::wire;
use crate::convert::numbers::finite_all;
use crate::convert::{WireError, enum_conversions};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::quality::{Classify, Compositing, Kernel, Quality, Splat, Sums};
use slabcast_common::shade::{Light, Shading};
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::volume::{ColourValue, Palette, SampleKind, ValueMap, ValueSummary};
use std::sync::Arc;

enum_conversions!(kernel_to_wire, kernel_from_wire, Kernel, wire::Kernel, None,
    { Gaussian <=> Gaussian, Bspline <=> Bspline, Tent <=> Tent,
      Interpolating <=> Interpolating });
enum_conversions!(classify_to_wire, classify_from_wire, Classify, wire::Classify,
    None,
    { After <=> After, Before <=> Before });
enum_conversions!(compositing_to_wire, compositing_from_wire, Compositing, wire::Compositing,
    Some(Compositing::Linear),
    { Linear <=> Linear, Constant <=> Constant, Paper <=> Paper });
enum_conversions!(splat_to_wire, splat_from_wire, Splat, wire::Splat, Some(Splat::Direct),
    { Direct <=> Direct, Deposit <=> Deposit });
enum_conversions!(sums_to_wire, sums_from_wire, Sums, wire::Sums, Some(Sums::Auto),
    { Auto <=> Auto, I16 <=> I16, I32 <=> I32, F32 <=> F32 });
enum_conversions!(kind_to_wire, kind_from_wire, SampleKind, wire::SampleKind, None,
    { U8 <=> U8, U16 <=> U16, F32 <=> F32 });
enum_conversions!(format_to_wire, format_from_wire, PixelFormat, wire::PixelFormat, None,
    { Rgb8 <=> Rgb8, Rgba8 <=> Rgba8, Rgba16 <=> Rgba16, Rgba32F <=> Rgba32f });
enum_conversions!(domain_to_wire, domain_from_wire, Domain, wire::TransferDomain, None,
    { Value <=> Value, Unit <=> Unit });
enum_conversions!(space_to_wire, space_from_wire, ColorSpace, wire::ColorSpace,
    Some(ColorSpace::Srgb),
    { Srgb <=> Srgb, Linear <=> Linear });
enum_conversions!(unit_to_wire, unit_from_wire, OpacityUnit, wire::OpacityUnit,
    Some(OpacityUnit::AlphaPerVox),
    { AlphaPerVox <=> AlphaPerVox, Extinction <=> Extinction });

/// A quality; every field is written.
pub(super) fn quality_to_wire(q: &Quality) -> wire::Quality {
    wire::Quality {
        thickness: Some(q.thickness),
        eps: Some(q.eps),
        kernel: kernel_to_wire(q.kernel),
        std: Some(q.std),
        radius: Some(q.radius),
        compositing: compositing_to_wire(q.compositing),
        splat: splat_to_wire(q.splat),
        sums: sums_to_wire(q.sums),
        cull: Some(q.cull),
        classify: classify_to_wire(q.classify),
    }
}

/// A quality; fields that are left out have their defaults. `classify` is the order that a message
/// without one means.
pub(super) fn quality_from_wire(
    q: wire::Quality,
    classify: Classify,
) -> Result<Quality, WireError> {
    let classify = match q.classify {
        0 => classify,
        given => classify_from_wire("classify", given)?,
    };
    let d = Quality::of(classify);
    let quality = Quality {
        thickness: q.thickness.unwrap_or(d.thickness),
        eps: q.eps.unwrap_or(d.eps),
        kernel: match q.kernel {
            0 => d.kernel,
            given => kernel_from_wire("kernel", given)?,
        },
        std: q.std.unwrap_or(d.std),
        radius: q.radius.unwrap_or(d.radius),
        classify,
        compositing: compositing_from_wire("compositing", q.compositing)?,
        splat: splat_from_wire("splat", q.splat)?,
        sums: sums_from_wire("sums", q.sums)?,
        cull: q.cull.unwrap_or(d.cull),
    };
    quality.check()?;
    Ok(quality)
}

pub(super) fn palette_to_wire(palette: &Palette) -> wire::Palette {
    wire::Palette {
        colours: palette.to_bytes().into(),
        has_alpha: palette.has_alpha(),
        value_is_alpha: palette.value() == ColourValue::Alpha,
    }
}

/// Adds the palette, if there is one, to the values of a volume.
pub(super) fn with_palette(
    summary: ValueSummary,
    palette: Option<wire::Palette>,
) -> Result<ValueSummary, WireError> {
    let Some(palette) = palette else { return Ok(summary) };
    let wire::Palette { colours, has_alpha, value_is_alpha } = palette;
    if summary.kind != SampleKind::U8 || summary.map != ValueMap::IDENTITY {
        let problem = "is there, but the values of colours are 8-bit codes without map";
        return Err(WireError::value("palette", problem));
    }
    let value = if value_is_alpha { ColourValue::Alpha } else { ColourValue::Luminance };
    let palette = Palette::from_bytes(&colours, has_alpha, value)
        .map_err(|e| WireError::value("palette.colours", e.to_string()))?;
    Ok(ValueSummary { palette: Some(Arc::new(palette)), ..summary })
}

pub(super) fn vec3_to_wire([x, y, z]: [f64; 3]) -> wire::Vec3 {
    wire::Vec3 { x: Some(x), y: Some(y), z: Some(z) }
}

/// A vector of finite numbers.
pub(super) fn vec3_from_wire(field: &str, v: wire::Vec3) -> Result<[f64; 3], WireError> {
    let numbers = [v.x, v.y, v.z].map(|x| x.unwrap_or(0.0));
    finite_all(field, &numbers)?;
    Ok(numbers)
}

fn rgb_to_wire([r, g, b]: [f64; 3]) -> wire::Rgb {
    wire::Rgb { r: Some(r), g: Some(g), b: Some(b) }
}

fn rgb_from_wire(rgb: wire::Rgb) -> [f64; 3] {
    [rgb.r, rgb.g, rgb.b].map(|x| x.unwrap_or(0.0))
}

pub(super) fn background_to_wire(background: Background) -> wire::Background {
    use wire::background::Kind;
    let kind = match background {
        Background::Transparent => Kind::Transparent(wire::Transparent {}),
        Background::Colour(colour) => Kind::Colour(rgb_to_wire(colour)),
    };
    wire::Background { kind: Some(kind) }
}

/// A background; one without a kind is black.
pub(super) fn background_from_wire(background: wire::Background) -> Result<Background, WireError> {
    use wire::background::Kind;
    match background.kind {
        None => Ok(Background::Colour([0.0; 3])),
        Some(Kind::Transparent(wire::Transparent {})) => Ok(Background::Transparent),
        Some(Kind::Colour(rgb)) => {
            let colour = rgb_from_wire(rgb);
            for (field, x) in ["r", "g", "b"].into_iter().zip(colour) {
                if !(0.0..=1.0).contains(&x) {
                    let field = format!("background.colour.{field}");
                    return Err(WireError::value(field, format!("{x}; give 0 to 1")));
                }
            }
            Ok(Background::Colour(colour))
        }
    }
}

/// A transfer function; every number is written, so that every bit arrives.
pub(super) fn transfer_to_wire(tf: &TransferFunction) -> wire::TransferFunction {
    let color = |&[x, r, g, b]: &[f64; 4]| wire::ColorPoint {
        x: Some(x),
        r: Some(r),
        g: Some(g),
        b: Some(b),
    };
    let opacity = |&[x, a]: &[f64; 2]| wire::OpacityPoint { x: Some(x), opacity: Some(a) };
    let gradient = |&[g, a]: &[f64; 2]| wire::GradientPoint { magnitude: Some(g), factor: Some(a) };
    let s = &tf.shading;
    wire::TransferFunction {
        domain: domain_to_wire(tf.domain),
        colors: tf.colors.iter().map(color).collect(),
        opacities: tf.opacities.iter().map(opacity).collect(),
        color_space: space_to_wire(tf.color_space),
        opacity_unit: unit_to_wire(tf.opacity_unit),
        nan: Some(wire::NanLook {
            color: Some(rgb_to_wire(tf.nan.color)),
            opacity: Some(tf.nan.opacity),
        }),
        gradient_opacity: tf.gradient_opacity.iter().map(gradient).collect(),
        shading: Some(wire::Shading {
            on: Some(s.on),
            ambient: Some(s.ambient),
            diffuse: Some(s.diffuse),
            specular: Some(s.specular),
            power: Some(s.power),
            light: Some(match s.light {
                Light::Key => wire::shading::Light::Key(wire::Keylight {}),
                Light::Head => wire::shading::Light::Head(wire::Headlight {}),
                Light::Direction(d) => wire::shading::Light::Direction(vec3_to_wire(d)),
            }),
        }),
    }
}

/// A transfer function, or the field that is wrong (`colors[3]`).
pub(super) fn transfer_from_wire(
    tf: wire::TransferFunction,
) -> Result<TransferFunction, WireError> {
    let number = |x: Option<f64>| x.unwrap_or(0.0);
    let pair = |x: Option<f64>, y: Option<f64>| [number(x), number(y)];
    let nan = tf.nan.unwrap_or_default();
    let (s, d) = (tf.shading.unwrap_or_default(), Shading::default());
    let transfer = TransferFunction {
        // The JSON's version; here the package has it.
        version: 1,
        domain: domain_from_wire("domain", tf.domain)?,
        colors: tf.colors.iter().map(|p| [p.x, p.r, p.g, p.b].map(number)).collect(),
        opacities: tf.opacities.iter().map(|p| pair(p.x, p.opacity)).collect(),
        color_space: space_from_wire("color_space", tf.color_space)?,
        opacity_unit: unit_from_wire("opacity_unit", tf.opacity_unit)?,
        nan: NanColour {
            color: rgb_from_wire(nan.color.unwrap_or_default()),
            opacity: number(nan.opacity),
        },
        gradient_opacity: tf.gradient_opacity.iter().map(|p| pair(p.magnitude, p.factor)).collect(),
        shading: Shading {
            on: s.on.unwrap_or(d.on),
            ambient: s.ambient.unwrap_or(d.ambient),
            diffuse: s.diffuse.unwrap_or(d.diffuse),
            specular: s.specular.unwrap_or(d.specular),
            power: s.power.unwrap_or(d.power),
            light: match s.light {
                None => d.light,
                Some(wire::shading::Light::Key(wire::Keylight {})) => Light::Key,
                Some(wire::shading::Light::Head(wire::Headlight {})) => Light::Head,
                Some(wire::shading::Light::Direction(v)) => {
                    Light::Direction(vec3_from_wire("shading.direction", v)?)
                }
            },
        },
    };
    transfer.check()?;
    Ok(transfer)
}
