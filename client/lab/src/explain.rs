//! `slabcast lab explain`: explains the colour of a pixel sheet by sheet, or the savings of a scene
//! (`crate::ablation`).
//!
//! The numbers are the renderer's own ([`slabcast_render::oracle::explain`]): they lead to the
//! pixel of the picture, to the bit. Each line has the transmittance of f64 sheets for comparison,
//! and below all lines stands the limit.

mod field;

use crate::ablation;
use crate::single_frame::SingleFrame;
use slabcast_common::quality::Classify;
use slabcast_common::volume::ValueMap;
use slabcast_render::judge::reference::{ReferenceSheet, SheetOptions};
use slabcast_render::oracle::explain::{PixelExplanation, SectionAtPixel, SheetAtPixel, explain};
use slabcast_session::fail::{Fail, say};
use slabcast_session::parse;
use slabcast_session::request::{ThreadArgs, VolumeSceneArgs};
use slabcast_session::signals;
use std::collections::BTreeMap;
use std::fmt::Write;

/// Explains a pixel, or what a scene does not need.
///
/// With --pixel: each sheet at the pixel, the voxels behind it, and where the pixel was shut.
/// Without: what the scene leaves out, and what that saves.
///
/// The first view of the path is taken. Without --pixel the scene is drawn as it is and with each
/// thing kept that it leaves out, in turn, and the pictures are compared. With --pixel, each line
/// is a sheet that holds something there, front to back: its optical depth tau, its colour, the
/// transmittance T behind it, T by f64 sheets that round and shut nothing, and how many voxels of
/// how many bricks it is made of, the strongest first. All other numbers are the renderer's own, in
/// its arithmetic: they lead to the pixel of the picture to the bit. Below stand the pixel, the
/// pixel of f64 sheets, and the limit of infinitely thin sheets.
///
/// With `--classify after` each line is a plane of the reconstructed field: its value there, the
/// value in f64, the length of the gradient per vox, and optical depth and colour of the segment of
/// the ray between the plane before and this one.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab explain brain.nii.gz --tf fog
  slabcast lab explain brain.nii.gz --pixel 256,200
  slabcast lab explain brain.nii.gz --tf peer-semi --azimuth 30 --pixel 256,200 --voxels 0
  slabcast lab explain brain.nii.gz --thickness 0.5 --pixel 256,200 --json | jq .sheets[0]

Depths are in vox behind the target; sheet k lies between k and k + 1 thicknesses. Colours are
linear, from 0 to 1; pixels linear, premultiplied. A voxel's weights are those of its footprint
along x and y and of its section in the sheet.

JSON of a scene: {scene, size, threads, ms, voxels, bytes, rows: [{name, left_out, why, saved_bytes,
saved_ms, saved_cut_ms, same_pixels, force}]}: bytes of one copy of the bricks or of a picture, ms of
a frame, ms of cutting bricks once a volume, null where it is not measured; force: the flag that keeps
it all the same.
JSON of a pixel: {pixel: [x, y], size, rgba, same_thickness, limit, error: {limit, same_thickness}, shut_in,
voxels, bricks, hidden: {voxels, bricks}, sheets: [{k, depth: [from, to], tau, colour, t, light,
raw, peek, sections, bricks, reference: {tau, colour, t}, voxels: [{voxel, brick, value, weights,
tau, colour}]}]}. rgba, same_thickness and limit are linear, premultiplied; errors are the largest
of four channels in 1/255; t is what is let through by this sheet and all in front of it; shut_in is
null where the pixel stays open; reference is null where f64 sheets have nothing there.
With --classify after: planes in place of sheets, [{k, depth, value, reference, gradient, tau, colour, t,
count, bricks, voxels: [{voxel, brick, value, adds}]}].")]
pub struct ExplainArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Pixel to explain; 0,0 is at the top left
    #[arg(long, value_name = "X,Y", value_parser = parse::pixel)]
    pixel: Option<[u32; 2]>,
    /// Voxels to list for each sheet, strongest first
    #[arg(long, value_name = "N", default_value = "3")]
    voxels: usize,
    #[command(flatten)]
    threads: ThreadArgs,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// The explanation of a pixel, and its exact colours.
struct ExplainedPixel {
    pixel: [u32; 2],
    size: [u32; 2],
    thickness: f64,
    eps: f64,
    explained: PixelExplanation,
    /// Sheets of the same thickness in f64, by their index.
    sheets: BTreeMap<i64, ReferenceSheet>,
    same_thickness: [f64; 4],
    limit: [f64; 4],
    values: ValueMap,
}

/// The explanation of a pixel, by the order of classification.
enum Explained {
    /// Sheets of voxels that are classified before reconstruction.
    Sheets(ExplainedPixel),
    /// Planes of a field.
    Field(field::ExplainedField),
}

/// Runs `slabcast lab explain`: prints a table, or JSON with `--json`.
///
/// # Errors
/// The arguments or the volume are refused, or the user stopped it.
pub fn run(args: &ExplainArgs) -> Result<(), Fail> {
    let Some(pixel) = args.pixel else {
        let savings = {
            let args = args.clone();
            signals::run_unless_stopped(move || ablation::measure(&args.of, args.threads.count()))?
        };
        return say(&if args.json { ablation::json(&savings) } else { ablation::text(&savings) });
    };
    let found = {
        let args = args.clone();
        signals::run_unless_stopped(move || explain_pixel(&args, pixel))?
    };
    say(&match (&found, args.json) {
        (Explained::Sheets(found), false) => text(found),
        (Explained::Sheets(found), true) => json(found),
        (Explained::Field(found), false) => field::text(found),
        (Explained::Field(found), true) => field::json(found),
    })
}

fn explain_pixel(args: &ExplainArgs, pixel: [u32; 2]) -> Result<Explained, Fail> {
    // `request` refuses targets, since a magnified pixel has no sheets of its own.
    args.of.request(Default::default())?;
    let scene = SingleFrame::read(&args.of, 1, |[w, h]| {
        if pixel[0] < w && pixel[1] < h {
            return Ok(());
        }
        Err(Fail::usage(format!(
            "--pixel: {},{} is not in the picture, which has {w}x{h} pixels; give 0,0 to \
                 {},{}, or another --size",
            pixel[0],
            pixel[1],
            w - 1,
            h - 1
        )))
    })?;
    let [x, y] = pixel;
    let quality = scene.spec.quality;
    if quality.classify == Classify::After {
        return Ok(Explained::Field(field::explained(&scene, pixel, args.voxels)));
    }
    let explained = explain(&scene.frame(quality), &scene.bricks, pixel, args.voxels);
    let reference = scene.reference();
    let sheets = reference.sheet_by_sheet(x, y, SheetOptions::default());
    Ok(Explained::Sheets(ExplainedPixel {
        pixel,
        size: scene.view.size,
        thickness: quality.thickness,
        eps: quality.eps,
        same_thickness: sheets.last().map_or([0.0; 4], |s| s.so_far),
        limit: reference.pixel(x, y),
        sheets: sheets.into_iter().map(|s| (s.k, s)).collect(),
        values: scene.spec.volume.summary.map,
        explained,
    }))
}

/// Returns the largest difference of four channels, in 1/255.
fn largest_error(got: [f32; 4], want: [f64; 4]) -> f64 {
    (0..4).map(|c| (f64::from(got[c]) - want[c]).abs() * 255.0).fold(0.0, f64::max)
}

fn text(found: &ExplainedPixel) -> String {
    let e = &found.explained;
    let [x, y] = found.pixel;
    let [w, h] = found.size;
    let mut out = format!("pixel {x},{y} of {w}x{h}\n\n");
    out.push_str(
        "sheet     depth, vox         tau    colour                T      T in f64  made by\n",
    );
    let mut next = None;
    for s in &e.sheets {
        if next.is_some_and(|n| n < s.k) {
            out.push_str("  ...  nothing between\n");
        }
        next = Some(s.k + 1);
        put_sheet(&mut out, found, s);
    }
    if e.sheets.is_empty() {
        out.push_str("  no voxel reaches this pixel\n");
    }
    out.push('\n');
    match e.shut_in {
        Some(k) => {
            let _ = writeln!(
                out,
                "shut in sheet {k}: T is below eps ({}); {} voxels behind it were not read, and \
                 {} bricks not at all",
                number(found.eps),
                e.hidden_voxels,
                e.hidden_bricks
            );
        }
        None if !e.sheets.is_empty() => out.push_str("never shut: all that lies there was read\n"),
        None => {}
    }
    let _ = writeln!(out, "in all {} voxels; bricks: {}\n", e.voxels, e.bricks);
    let others = [("sheets in f64", found.same_thickness), ("limit", found.limit)];
    put_pixels(&mut out, e.pixel, &others);
    out
}

/// Appends a pixel and others that it is compared with, with their differences.
fn put_pixels(out: &mut String, pixel: [f32; 4], others: &[(&str, [f64; 4])]) {
    let row = |name: &str, p: [f64; 4], what: String| {
        let [r, g, b, a] = p.map(|x| format!("{x:.6}"));
        format!("{name:<15} {r}  {g}  {b}  {a}   {what}\n")
    };
    out.push_str("linear, premultiplied   R         G         B         A   off by, 1/255\n");
    *out += &row("pixel", pixel.map(f64::from), String::new());
    for (name, other) in others {
        *out += &row(name, *other, number(largest_error(pixel, *other)));
    }
}

fn put_sheet(out: &mut String, found: &ExplainedPixel, s: &SheetAtPixel) {
    let d = found.thickness;
    let [r, g, b] = s.colour.map(|c| format!("{c:.3}"));
    let t64 = found.sheets.get(&i64::from(s.k)).map(|r| number(1.0 - r.so_far[3]));
    let _ = writeln!(
        out,
        "{:>5} {:>8.2} to {:<8.2} {:>7}  {r} {g} {b}  {:>9} {:>9}  {} voxel{} of {} brick{}",
        s.k,
        f64::from(s.k) * d,
        f64::from(s.k + 1) * d,
        number(f64::from(s.tau)),
        number(f64::from(1.0 - s.a)),
        t64.as_deref().unwrap_or("-"),
        s.sections,
        if s.sections == 1 { "" } else { "s" },
        s.bricks,
        if s.bricks == 1 { "" } else { "s" },
    );
    for v in &s.strongest {
        let [i, j, k] = v.voxel;
        let [wx, wy, wz] = v.weights;
        let [r, g, b] = v.colour.map(|c| format!("{c:.3}"));
        let _ = writeln!(
            out,
            "        voxel {i},{j},{k} of brick {}: value {}, tau {}, colour {r} {g} {b}, \
             weights {wx:.3} {wy:.3} {wz:.3}",
            v.brick.0,
            plain(found.values.value(v.code)),
            number(f64::from(v.tau)),
        );
    }
}

/// Formats a value of the volume; whole numbers without decimals.
fn plain(x: f64) -> String {
    let text = format!("{x:.4}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').into() } else { text }
}

/// Formats a number with about four digits.
fn number(x: f64) -> String {
    if x == 0.0 {
        "0".into()
    } else if x.abs() < 1e-3 || x.abs() >= 1e5 {
        format!("{x:.2e}")
    } else {
        format!("{x:.4}")
    }
}

fn json(found: &ExplainedPixel) -> String {
    let e = &found.explained;
    let section = |v: &SectionAtPixel| {
        serde_json::json!({
            "voxel": v.voxel, "brick": v.brick.0, "value": found.values.value(v.code),
            "weights": v.weights, "tau": v.tau, "colour": v.colour
        })
    };
    let sheet = |s: &SheetAtPixel| {
        let reference = found
            .sheets
            .get(&i64::from(s.k))
            .map(|r| serde_json::json!({"tau": r.tau, "colour": r.colour, "t": 1.0 - r.so_far[3]}));
        let depth = [s.k, s.k + 1].map(|k| f64::from(k) * found.thickness);
        serde_json::json!({
            "k": s.k, "depth": depth, "tau": s.tau, "colour": s.colour, "t": 1.0 - s.a,
            "light": s.light, "raw": s.raw, "peek": s.peek, "sections": s.sections,
            "bricks": s.bricks, "reference": reference,
            "voxels": s.strongest.iter().map(section).collect::<Vec<_>>()
        })
    };
    let value = serde_json::json!({
        "pixel": found.pixel, "size": found.size, "rgba": e.pixel,
        "same_thickness": found.same_thickness, "limit": found.limit,
        "error": {
            "limit": largest_error(e.pixel, found.limit),
            "same_thickness": largest_error(e.pixel, found.same_thickness)
        },
        "shut_in": e.shut_in, "voxels": e.voxels, "bricks": e.bricks,
        "hidden": {"voxels": e.hidden_voxels, "bricks": e.hidden_bricks},
        "sheets": e.sheets.iter().map(sheet).collect::<Vec<_>>()
    });
    value.to_string() + "\n"
}
