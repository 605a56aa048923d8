//! Ablation of a scene, for `slabcast lab explain` without a pixel: what the renderer leaves out,
//! and what that saves.
//!
//! Each row is measured. The scene is drawn as it is and with the thing kept (or the test switched
//! off), in turn, and the two pictures are compared to the bit.

use slabcast_common::brick::Brick;
use slabcast_common::image::{Background, Picture};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Keep, Quality, Work};
use slabcast_common::view::Projection;
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_render::{Frame, Scene};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::{OpenedVolume, RenderRequest, VolumeSceneArgs};
use std::fmt::Write;
use std::sync::Arc;
use std::time::Instant;

/// Timed frames of each of the two variants.
const TURNS: usize = 5;

/// Largest number of voxels of a volume that is cut again with its empty voxels, some 5 bytes each.
const MOST_VOXELS: u64 = 1 << 26;

/// One thing that a scene may leave out: a row of the table.
struct Row {
    name: &'static str,
    left_out: bool,
    why: String,
    /// Bytes saved in one copy of the bricks, or in a picture.
    bytes: Option<u64>,
    /// Time saved of a frame, in ms.
    ms: Option<f64>,
    /// Time saved when the bricks are cut, in ms, once a volume.
    cut_ms: Option<f64>,
    /// Whether the picture stays the same, to the bit.
    same: Option<bool>,
    /// Flag that keeps the thing, or empty.
    force: &'static str,
}

/// Savings of a scene.
pub(crate) struct Savings {
    scene: String,
    size: [u32; 2],
    /// Level of detail that is drawn.
    level: u32,
    threads: usize,
    /// Median time of a frame as it is drawn.
    ms: f64,
    relevant: u64,
    bytes: u64,
    rows: Vec<Row>,
}

/// One variant of the scene, ready to draw, and the time of cutting its bricks.
struct Variant {
    scenes: PathScenes,
    quality: Quality,
    cut_ms: f64,
}

impl Variant {
    fn new(
        volume: &Volume,
        info: &VolumeInfo,
        request: &RenderRequest,
        o: Orientation,
        keep: Keep,
    ) -> Result<Variant, Fail> {
        let mut request = request.clone();
        request.work.keep = keep;
        let request = request;
        let began = Instant::now();
        let scenes = PathScenes::new(volume, info, &request, o)?;
        let cut_ms = began.elapsed().as_secs_f64() * 1e3;
        let quality = scenes.spec(0).quality;
        Ok(Variant { scenes, quality, cut_ms })
    }

    fn bytes(&self) -> u64 {
        self.scenes.bricks.iter().map(|b| b.encoded_len() as u64).sum()
    }

    fn voxels(&self) -> u64 {
        self.scenes.bricks.iter().map(|b: &Arc<Brick>| b.len() as u64).sum()
    }
}

/// Draws two variants in turn. Returns their median times in ms, and whether the pictures are the
/// same.
fn in_turn(variants: [(&Variant, Quality); 2], threads: usize) -> Result<([f64; 2], bool), Fail> {
    let cut = Cut { tile: 64, ..Cut::on(threads) };
    let variants = variants.map(|(variant, quality)| {
        let spec = SceneSpec { quality, ..variant.scenes.spec(0) };
        (variant, Arc::new(Scene::new(&spec)))
    });
    let mut ms = [Vec::new(), Vec::new()];
    let mut pictures: [Option<Picture>; 2] = [None, None];
    for turn in 0..=TURNS {
        for i in 0..2 {
            let (variant, scene) = &variants[i];
            let view = variant.scenes.view(0, &scene.quality)?;
            let began = Instant::now();
            let frame = Frame::new(scene.clone(), view);
            let picture = direct::draw(&frame, &variant.scenes.bricks, cut);
            // The first frame fills tables and caches.
            if turn > 0 {
                ms[i].push(began.elapsed().as_secs_f64() * 1e3);
            }
            pictures[i] = Some(picture);
        }
    }
    let median = |mut ms: Vec<f64>| {
        ms.sort_by(f64::total_cmp);
        ms[ms.len() / 2]
    };
    let [a, b] = pictures.map(|p| p.map(|p| p.sha256()));
    Ok((ms.map(median), a == b))
}

/// Measures what the scene leaves out and what that saves.
pub(crate) fn measure(of: &VolumeSceneArgs, threads: usize) -> Result<Savings, Fail> {
    let mut request = of.request(Work::default())?;
    let OpenedVolume { volume, info, orientation } = of.open(&mut request)?;
    let mut progress = Progress::new(false);
    progress.phase("drawing with and without");
    let variant = |keep| Variant::new(&volume, &info, &request, orientation, keep);
    let base = variant(Keep::default())?;
    let spec = base.scenes.spec(0);
    let quality = base.quality;
    let (voxels, bytes) = (base.voxels(), base.bytes());
    let all: u64 = spec.volume.lattice.dims.iter().map(|&n| u64::from(n)).product();
    let mut rows = Vec::new();

    // All detail, if a coarser level is drawn.
    if spec.volume.level > info.level {
        let request = request.in_all_detail();
        let with = Variant::new(&volume, &info, &request, orientation, Keep::default())?;
        let ([less, more], _) = in_turn([(&base, quality), (&with, with.quality)], threads)?;
        let [x, y, z] = spec.volume.lattice.dims;
        rows.push(Row {
            name: "detail",
            left_out: true,
            why: format!(
                "level {} of {x} x {y} x {z} samples is drawn, {} of {}; `lab error --level {}` says \
                 what that costs",
                spec.volume.level,
                base.voxels(),
                with.voxels(),
                spec.volume.level
            ),
            bytes: Some(with.bytes().saturating_sub(bytes)),
            ms: Some(more - less),
            cut_ms: Some(with.cut_ms - base.cut_ms),
            same: None,
            force: "--level 0",
        });
    }

    // Things left out of the bricks.
    let mut kept = |name, why: String, keep: Keep, force| -> Result<(), Fail> {
        let with = variant(keep)?;
        let ([less, more], same) = in_turn([(&base, quality), (&with, quality)], threads)?;
        rows.push(Row {
            name,
            left_out: true,
            why,
            bytes: Some(with.bytes().saturating_sub(bytes)),
            ms: Some(more - less),
            cut_ms: Some(with.cut_ms - base.cut_ms),
            same: Some(same),
            force,
        });
        Ok(())
    };
    let needed = |name, why: &str| Row {
        name,
        left_out: false,
        why: why.into(),
        bytes: None,
        ms: None,
        cut_ms: None,
        same: None,
        force: "",
    };
    let empty = format!("{voxels} of {all} voxels are visible under this transfer function");
    let mut later = Vec::new();
    if all <= MOST_VOXELS {
        kept("empty", empty, Keep { empty: true, ..Keep::default() }, "--keep empty")?;
    } else {
        let estimate = (all - voxels) as f64 * bytes as f64 / voxels.max(1) as f64;
        later.push(Row {
            left_out: true,
            bytes: Some(estimate as u64),
            force: "--keep empty",
            ..needed("empty", &(empty + "; not drawn with them, the volume is large"))
        });
    }
    if spec.transfer.shading.on {
        later.push(needed("normals", "the scene is shaded"));
    } else {
        let keep = Keep { normals: true, ..Keep::default() };
        kept("normals", "no light falls on the scene".into(), keep, "--keep normals")?;
    }
    if spec.transfer.gradient_opacity.is_empty() {
        let keep = Keep { gradients: true, ..Keep::default() };
        kept("gradients", "no opacity depends on them".into(), keep, "--keep gradients")?;
    } else {
        later.push(needed("gradients", "they modulate opacity"));
    }
    rows.append(&mut later);

    // Hidden bricks.
    let look = Quality { cull: false, ..quality };
    let ([ms, blind], same) = in_turn([(&base, quality), (&base, look)], threads)?;
    let frame = base.scenes.frame(0)?;
    let picture = direct::draw(&frame, &base.scenes.bricks, Cut::on(threads));
    let shut = picture.pixels.iter().filter(|p| 1.0 - p[3] < quality.eps as f32).count();
    let covered = picture.pixels.iter().filter(|p| p[3] > 0.0).count();
    if shut > 0 {
        rows.push(Row {
            name: "hidden",
            left_out: true,
            why: format!(
                "{:.0} % of the pixels that show anything are shut before their last voxel",
                100.0 * shut as f64 / covered.max(1) as f64
            ),
            bytes: None,
            ms: Some(blind - ms),
            cut_ms: None,
            same: Some(same),
            force: "--cull off",
        });
    } else {
        let most = picture.pixels.iter().fold(0.0, |m, p| p[3].max(m));
        let why = format!(
            "nothing is hidden: the most opaque pixel lets {:.1} % through; looking costs {:.1} ms",
            100.0 * (1.0 - most),
            ms - blind
        );
        rows.push(Row { same: Some(same), force: "--cull off", ..needed("hidden", &why) });
    }
    let view = base.scenes.view(0, &quality)?;
    let flat = matches!(view.projection, Projection::Ortho { .. });
    rows.push(Row {
        left_out: flat,
        ..needed(
            "scale",
            if flat {
                "rays are parallel: all footprints of a frame are of one size"
            } else {
                "footprints shrink with depth in perspective"
            },
        )
    });
    let opaque = request.background != Background::Transparent;
    rows.push(Row {
        left_out: opaque,
        bytes: opaque.then(|| view.size.iter().map(|&n| u64::from(n)).product()),
        force: "--background transparent",
        ..needed(
            "alpha",
            if opaque { "the background is opaque" } else { "the background is transparent" },
        )
    });
    rows.push(Row {
        left_out: true,
        bytes: Some(bytes),
        force: "slabcast worker",
        ..needed("transfer", "workers inside the master's process share its bricks")
    });
    progress.end();
    Ok(Savings {
        scene: format!("{}, {}", volume.name, request.transfer.name()),
        size: view.size,
        level: spec.volume.level,
        threads,
        ms,
        relevant: voxels,
        bytes,
        rows,
    })
}

/// Returns the savings as a table.
pub(crate) fn text(savings: &Savings) -> String {
    let [w, h] = savings.size;
    let mut out = format!(
        "{}, {w}x{h}, level {}: {:.1} ms a frame on {} thread{}; {} visible voxels in {} of bricks\n\n",
        savings.scene,
        savings.level,
        savings.ms,
        savings.threads,
        if savings.threads == 1 { "" } else { "s" },
        savings.relevant,
        progress::bytes(savings.bytes)
    );
    out.push_str("left out      saves, ms a frame      bytes   ms of cutting  same picture\n");
    for r in savings.rows.iter().filter(|r| r.left_out) {
        let number = |x: Option<f64>| x.map_or_else(|| "-".into(), |x| format!("{x:.1}"));
        let _ = writeln!(
            out,
            "{:<13} {:>17} {:>10} {:>15}  {:<12}  {}{}",
            r.name,
            number(r.ms),
            r.bytes.map_or_else(|| "-".into(), progress::bytes),
            number(r.cut_ms),
            match r.same {
                Some(true) => "to the bit",
                Some(false) => "NO",
                None => "-",
            },
            r.why,
            if r.force.is_empty() { String::new() } else { format!(" ({})", r.force) }
        );
    }
    out.push_str("\nneeded, or not left out\n");
    for r in savings.rows.iter().filter(|r| !r.left_out) {
        let _ = writeln!(out, "{:<13} {}", r.name, r.why);
    }
    out.push_str(
        "\nIn brackets: what keeps it all the same. Times are medians of five frames, drawn in turn\n\
         with and without; differences below some percent of a frame are noise.\n",
    );
    out
}

/// Returns the savings as JSON.
pub(crate) fn json(savings: &Savings) -> String {
    let rows: Vec<_> = savings
        .rows
        .iter()
        .map(|r| {
            serde_json::json!({
                "name": r.name, "left_out": r.left_out, "why": r.why, "saved_bytes": r.bytes,
                "saved_ms": r.ms, "saved_cut_ms": r.cut_ms, "same_pixels": r.same,
                "force": if r.force.is_empty() { None } else { Some(r.force) },
            })
        })
        .collect();
    serde_json::json!({
        "scene": savings.scene, "size": savings.size, "level": savings.level, "threads": savings.threads, "ms": savings.ms,
        "voxels": savings.relevant, "bytes": savings.bytes, "rows": rows,
    })
    .to_string()
        + "\n"
}
