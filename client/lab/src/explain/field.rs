//! A pixel of a scene that is classified after reconstruction, plane by plane.

use super::{largest_error, number, plain, put_pixels};
use crate::single_frame::SingleFrame;
use slabcast_common::volume::ValueMap;
use slabcast_render::judge::reference::FieldReference;
use slabcast_render::oracle::explain_field::{
    FieldExplanation, PlaneAtPixel, VoxelAtPixel, explain_field,
};
use std::fmt::Write;

/// The explanation of a pixel, and the exact field and colour.
pub(super) struct ExplainedField {
    pixel: [u32; 2],
    size: [u32; 2],
    eps: f64,
    explained: FieldExplanation,
    /// Sample code of the f64 field at each plane of `explained`.
    codes: Vec<f64>,
    limit: [f64; 4],
    values: ValueMap,
}

/// Explains a pixel of `scene`, with at most `voxels` voxels a plane.
pub(super) fn explained(scene: &SingleFrame, pixel: [u32; 2], voxels: usize) -> ExplainedField {
    let quality = scene.spec.quality;
    let explained = explain_field(&scene.frame(quality), &scene.bricks, pixel, voxels);
    let reference = FieldReference::new(&scene.spec, scene.view, &scene.bricks);
    let codes = explained.planes.iter().map(|p| reference.value_on_ray(pixel, p.depth));
    ExplainedField {
        pixel,
        size: scene.view.size,
        eps: quality.eps,
        codes: codes.collect(),
        limit: reference.pixel(pixel[0], pixel[1]),
        values: scene.spec.volume.summary.map,
        explained,
    }
}

/// Returns the explanation as a table.
pub(super) fn text(found: &ExplainedField) -> String {
    let e = &found.explained;
    let ([x, y], [w, h]) = (found.pixel, found.size);
    let mut out = format!("pixel {x},{y} of {w}x{h}\n\n");
    out.push_str(
        "plane  depth, vox       value      in f64   gradient        tau    colour                T  made by\n",
    );
    let mut next = None;
    for (plane, code) in e.planes.iter().zip(&found.codes) {
        if next.is_some_and(|n| n < plane.k) {
            out.push_str("  ...  nothing between\n");
        }
        next = Some(plane.k + 1);
        put_plane(&mut out, found, plane, *code);
    }
    if e.planes.is_empty() {
        out.push_str("  no voxel reaches this pixel\n");
    }
    out.push('\n');
    match e.shut_in {
        Some(k) => {
            let _ = writeln!(
                out,
                "shut at plane {k}: T is below eps ({}); {} voxels behind it were not read",
                number(found.eps),
                e.hidden_voxels
            );
        }
        None if !e.planes.is_empty() => out.push_str("never shut: all that lies there was read\n"),
        None => {}
    }
    let _ = writeln!(out, "in all {} voxels; bricks: {}\n", e.voxels, e.bricks);
    put_pixels(&mut out, e.pixel, &[("limit", found.limit)]);
    out
}

fn put_plane(out: &mut String, found: &ExplainedField, p: &PlaneAtPixel, code: f64) {
    let value =
        |code: f64| if code.is_nan() { "-".into() } else { plain(found.values.value(code)) };
    let [r, g, b] = p.colour.map(|c| format!("{c:.3}"));
    let _ = writeln!(
        out,
        "{:>5} {:>11.2} {:>11} {:>11} {:>10} {:>10}  {r} {g} {b} {:>10}  {} voxel{} of {} brick{}",
        p.k,
        p.depth,
        value(p.code),
        value(code),
        number(p.gradient * found.values.scale.abs()),
        number(p.tau),
        number(f64::from(1.0 - p.a)),
        p.voxels,
        if p.voxels == 1 { "" } else { "s" },
        p.bricks,
        if p.bricks == 1 { "" } else { "s" },
    );
    for v in &p.strongest {
        let [i, j, k] = v.voxel;
        let _ = writeln!(
            out,
            "        voxel {i},{j},{k} of brick {}: value {}, adds {}",
            v.brick.0,
            value(v.code),
            number(v.adds * found.values.scale),
        );
    }
}

/// Returns the explanation as JSON.
pub(super) fn json(found: &ExplainedField) -> String {
    let e = &found.explained;
    let value = |code: f64| found.values.value(code);
    let voxel = |v: &VoxelAtPixel| {
        serde_json::json!({
            "voxel": v.voxel, "brick": v.brick.0, "value": value(v.code),
            "adds": v.adds * found.values.scale
        })
    };
    let plane = |(p, code): (&PlaneAtPixel, &f64)| {
        serde_json::json!({
            "k": p.k, "depth": p.depth, "value": value(p.code),
            "reference": Some(value(*code)).filter(|v| v.is_finite()),
            "gradient": p.gradient * found.values.scale.abs(), "tau": p.tau, "colour": p.colour,
            "t": 1.0 - p.a, "count": p.voxels, "bricks": p.bricks,
            "voxels": p.strongest.iter().map(voxel).collect::<Vec<_>>()
        })
    };
    let value = serde_json::json!({
        "pixel": found.pixel, "size": found.size, "rgba": e.pixel, "limit": found.limit,
        "error": {"limit": largest_error(e.pixel, found.limit)},
        "shut_in": e.shut_in, "voxels": e.voxels, "bricks": e.bricks,
        "hidden": {"voxels": e.hidden_voxels},
        "planes": e.planes.iter().zip(&found.codes).map(plane).collect::<Vec<_>>()
    });
    value.to_string() + "\n"
}
