//! `slabcast render --show`: pictures of how a picture came about.
//!
//! Depth, work and sheets are counts of each pixel ([`slabcast_render::work`]), the error is an estimate
//! from sheets of half the thickness, and tiles with their owners are in a frame's statistics. Each is
//! drawn over the same view as the frame would be, with a legend below that says what the colours mean.

use slabcast_common::image::{Picture, PixelFormat};
use slabcast_common::quality::{Compositing, Quality};
use slabcast_common::stats::FrameStats;
use slabcast_render::work::WorkCounters;
use slabcast_session::canvas::{Canvas, LINE, WHITE, viridis, width};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::output::Frame;
use slabcast_session::path_scenes::PathScenes;

/// The debug view of `--show`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum DebugView {
    /// Where pixels were shut, from near to far
    Depth,
    /// Which worker drew which tile of which slab
    Owner,
    /// Sections of voxels that were added at each pixel
    Work,
    /// Sheets that were read at each pixel
    Sheets,
    /// How far each pixel is off, by an estimate
    Error,
}

impl DebugView {
    /// Stem of the file names.
    pub(crate) fn stem(self) -> &'static str {
        match self {
            DebugView::Depth => "depth",
            DebugView::Owner => "owner",
            DebugView::Work => "work",
            DebugView::Sheets => "sheets",
            DebugView::Error => "error",
        }
    }
}

/// Sheets of half the thickness.
fn half(quality: Quality) -> Quality {
    Quality { thickness: quality.thickness / 2.0, ..quality }
}

/// Checks that an error can be estimated at this quality.
pub(crate) fn can_estimate(quality: &Quality) -> Result<(), Fail> {
    half(*quality).check().map_err(|_| {
        Fail::usage(format!(
            "--thickness: --show error compares with sheets of half the thickness, and half of {} \
             is too thin; give a larger one",
            quality.thickness
        ))
    })
}

/// Seen, but without a number: open pixels. No grey is on the scale.
const NEUTRAL: [u8; 3] = [96; 3];
/// Nothing is there.
const BLANK: [u8; 3] = [0; 3];
/// Narrower pictures get room beside them for the words.
const LEAST: usize = 330;
const MARGIN: usize = 6;
const BAR: usize = 10;
/// Ends of the error's scale in 1/255, as in `slabcast lab error --map`.
const ERRORS: [f64; 2] = [0.01, 10.0];

/// The picture about frame `i` of a path.
pub(crate) fn draw(
    stage: &PathScenes,
    show: DebugView,
    i: usize,
    threads: usize,
) -> Result<Frame, Fail> {
    let tables = stage.frame(i)?;
    let quality = tables.scene.quality;
    let canvas = if show == DebugView::Error {
        let picture = direct::draw(&tables, &stage.bricks, Cut::on(threads));
        let finer = direct::draw(&stage.frame_with(i, half)?, &stage.bricks, Cut::on(threads));
        error(&picture, &estimate(&picture, &finer, quality.compositing))
    } else {
        let sections = show == DebugView::Work;
        let (picture, notes) =
            direct::draw_with_work(&tables, &stage.bricks, Cut::on(threads), sections);
        match show {
            DebugView::Depth => depth(&picture, &notes, quality.thickness),
            DebugView::Sheets => {
                counted(&picture, &notes.sheets, "Sheets read at each pixel until it was shut")
            }
            _ => counted(
                &picture,
                &notes.sections,
                "Work: voxel sections added at each pixel until it was shut",
            ),
        }
    };
    Ok(frame(i as u64, canvas))
}

fn frame(number: u64, canvas: Canvas) -> Frame {
    let size = canvas.size.map(|n| n as u32);
    Frame { number, size, format: PixelFormat::Rgb8, bytes: canvas.bytes.into() }
}

/// The ends of a scale and what stands beside it.
struct Legend<'a> {
    title: &'a str,
    ends: [String; 2],
    notes: Vec<([u8; 3], &'a str)>,
}

/// Pixels in colours, and the legend below.
fn board([w, h]: [usize; 2], colours: impl Fn(usize) -> [u8; 3], legend: &Legend<'_>) -> Canvas {
    let wide = w.max(LEAST);
    let rows = 1 + legend.notes.len();
    let high = h + 2 * MARGIN + LINE + BAR + (rows + 1) * (LINE + 2);
    let mut canvas = Canvas::new([wide, high]);
    let left = (wide - w) / 2;
    let rgb: Vec<u8> = (0..w * h).flat_map(&colours).collect();
    canvas.put([left, 0], w, &rgb);
    let mut y = h + MARGIN;
    canvas.text([MARGIN, y], 1, legend.title, WHITE);
    y += LINE + 3;
    let long = wide - 2 * MARGIN;
    for x in 0..long {
        canvas.fill([MARGIN + x, y], [1, BAR], viridis((x as f64 + 0.5) / long as f64));
    }
    y += BAR + 3;
    let [from, to] = &legend.ends;
    canvas.text([MARGIN, y], 1, from, WHITE);
    canvas.text([wide.saturating_sub(MARGIN + width(to, 1)), y], 1, to, WHITE);
    for (colour, note) in &legend.notes {
        y += LINE + 2;
        canvas.fill([MARGIN, y - 1], [LINE, LINE], WHITE);
        canvas.fill([MARGIN + 1, y], [LINE - 2, LINE - 2], *colour);
        canvas.text([MARGIN + LINE + 4, y], 1, note, WHITE);
    }
    canvas
}

fn size(picture: &Picture) -> [usize; 2] {
    picture.size.map(|n| n as usize)
}

fn nothing(p: &[f32; 4]) -> bool {
    p[3] <= 0.0
}

/// Draws the depth at which pixels were shut, counted from the first sheet that held anything.
fn depth(picture: &Picture, notes: &WorkCounters, thickness: f64) -> Canvas {
    let first = notes.first.unwrap_or(0);
    let far = notes.shut_in.iter().flatten().max().map_or(0, |k| k - first).max(1);
    let share = |k: i32| 1.0 - f64::from(k - first) / f64::from(far);
    let colours = |i: usize| match notes.shut_in[i] {
        Some(k) => viridis(share(k)),
        None if nothing(&picture.pixels[i]) => BLANK,
        None => NEUTRAL,
    };
    let vox = |sheets: i32| f64::from(sheets) * thickness;
    let legend = Legend {
        title: "Depth at which each pixel was shut",
        ends: [
            format!("far: {:.0} vox behind the foremost", vox(far)),
            "near: the foremost".into(),
        ],
        notes: vec![(NEUTRAL, "never shut: light still comes through"), (BLANK, "nothing there")],
    };
    board(size(picture), colours, &legend)
}

/// Numbers from none to the most.
fn counted(picture: &Picture, counts: &[u32], title: &str) -> Canvas {
    let most = counts.iter().copied().max().unwrap_or(0).max(1);
    let some: Vec<u64> = counts.iter().filter(|&&n| n > 0).map(|&n| n.into()).collect();
    let mean = some.iter().sum::<u64>() as f64 / some.len().max(1) as f64;
    let colours = |i: usize| match counts[i] {
        0 => BLANK,
        n => viridis(f64::from(n) / f64::from(most)),
    };
    let mean = format!("none; where there are some, {mean:.0} on average");
    let legend = Legend {
        title,
        ends: ["few".into(), format!("{most}, the most")],
        notes: vec![(BLANK, &mean)],
    };
    board(size(picture), colours, &legend)
}

/// Estimates the error of each pixel from the thickness of sheets, in 1/255: from the difference to
/// sheets of half the thickness. Where the error falls with the square of the thickness, the finer
/// picture has a quarter of it left, so that the whole is 4/3 of the difference; the linear rule
/// does better and is overrated by a quarter at most. The paper's rule has an error of first order
/// (to a limit of its own): twice the difference.
fn estimate(picture: &Picture, finer: &Picture, rule: Compositing) -> Vec<Option<f64>> {
    let factor = if rule == Compositing::Paper { 2.0 } else { 4.0 / 3.0 };
    let one = |(a, b): (&[f32; 4], &[f32; 4])| {
        if nothing(a) && nothing(b) {
            return None;
        }
        let off = |c: usize| f64::from((a[c] - b[c]).abs()) * 255.0 * factor;
        Some((0..4).map(off).fold(0.0, f64::max))
    };
    picture.pixels.iter().zip(&finer.pixels).map(one).collect()
}

fn error(picture: &Picture, errors: &[Option<f64>]) -> Canvas {
    let [lo, hi] = ERRORS;
    let some: Vec<f64> = errors.iter().flatten().copied().collect();
    let n = some.len().max(1) as f64;
    let rms = (some.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    let most = some.iter().copied().fold(0.0, f64::max);
    let colours = |i: usize| match errors[i] {
        None => BLANK,
        Some(e) => viridis(libm::log(e.max(lo) / lo) / libm::log(hi / lo)),
    };
    let said = format!("nothing there; elsewhere {rms:.3} RMS, {most:.2} at most");
    let legend = Legend {
        title: "Estimated error of finite sheets, of 1/255",
        ends: [format!("{lo} or less"), format!("{hi} or more")],
        notes: vec![(BLANK, &said)],
    };
    board(size(picture), colours, &legend)
}

/// Colours of workers: far apart, also for the colour-blind (Okabe and Ito).
const OWNERS: [[u8; 3]; 7] = [
    [230, 159, 0],
    [86, 180, 233],
    [0, 158, 115],
    [240, 228, 66],
    [0, 114, 178],
    [213, 94, 0],
    [204, 121, 167],
];
/// Workers that the legend names; the others share colours and are counted.
const NAMED: usize = 14;

/// Slab beside slab, each tile in the colour of the worker that drew it, over the frame in grey.
pub(crate) fn owner(picture: &Frame, stats: &FrameStats) -> Frame {
    let [w, h] = picture.size.map(|n| n as usize);
    let rgb = picture.rgb8();
    let grey: Vec<u8> = rgb
        .chunks_exact(3)
        .map(|p| ((u32::from(p[0]) * 3 + u32::from(p[1]) * 6 + u32::from(p[2])) / 10) as u8)
        .collect();
    let mut names: Vec<&str> =
        stats.slabs.iter().flat_map(|s| &s.tiles).map(|t| t.worker.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    let slabs = stats.slabs.len().max(1);
    let columns = slabs.min(4);
    let rows = slabs.div_ceil(columns);
    let cell = [w + MARGIN, h + LINE + MARGIN];
    let wide = (columns * cell[0] + MARGIN).max(LEAST);
    let lines = 2 + names.len().min(NAMED) + usize::from(names.len() > NAMED);
    let mut canvas = Canvas::new([wide, rows * cell[1] + MARGIN + lines * (LINE + 2)]);
    for (n, slab) in stats.slabs.iter().enumerate() {
        let at = [MARGIN + n % columns * cell[0], MARGIN + n / columns * cell[1]];
        let mut bytes: Vec<u8> = grey.iter().flat_map(|&g| [g / 4; 3]).collect();
        for tile in &slab.tiles {
            let who = names.binary_search(&tile.worker.as_str()).unwrap_or(0);
            let colour = OWNERS[who % OWNERS.len()].map(u32::from);
            let (x0, y0, edge) = (tile.x as usize, tile.y as usize, tile.size as usize);
            for y in y0..(y0 + edge).min(h) {
                for x in x0..(x0 + edge).min(w) {
                    let i = y * w + x;
                    // A tile's rim is its plain colour; inside, the frame shows through.
                    let rim = x == x0 || y == y0;
                    let light = if rim { 255 } else { 110 + u32::from(grey[i]) * 120 / 255 };
                    for c in 0..3 {
                        bytes[i * 3 + c] = (colour[c] * light / 255) as u8;
                    }
                }
            }
        }
        canvas.put(at, w, &bytes);
        let tiles = slab.tiles.len();
        let word = format!("slab {} of {slabs}: {tiles} tiles", n + 1);
        let word = if width(&word, 1) > w { format!("{}: {tiles}", n + 1) } else { word };
        canvas.text([at[0], at[1] + h + 1], 1, &word, WHITE);
    }
    let mut y = rows * cell[1] + MARGIN;
    canvas.text([MARGIN, y], 1, "Who drew each tile; dark: empty or shut before, nobody", WHITE);
    for (n, name) in names.iter().take(NAMED).enumerate() {
        y += LINE + 2;
        canvas.fill([MARGIN, y], [LINE, LINE - 2], OWNERS[n % OWNERS.len()]);
        let tiles = stats.slabs.iter().flat_map(|s| &s.tiles).filter(|t| t.worker == *name);
        let (count, ms) = tiles.fold((0, 0.0), |(n, ms), t| (n + 1, ms + t.ms));
        let line = format!("{name}: {count} tiles, {ms:.0} ms");
        canvas.text([MARGIN + LINE + 4, y], 1, &line, WHITE);
    }
    if names.len() > NAMED {
        let line = format!("and {} others", names.len() - NAMED);
        canvas.text([MARGIN, y + LINE + 2], 1, &line, WHITE);
    }
    frame(picture.number, canvas)
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_render::judge::reference::{Reference, stratified};
    use slabcast_scene::path::{Orientation, ViewPath};
    use slabcast_session::request::RenderRequest;

    fn stage(tf: &str) -> PathScenes {
        let volume = slabcast_session::volume::open("formula:spheres:48".as_ref()).unwrap();
        let info = volume.info(volume.digest());
        let path = r#"{"version":1,"size":[64,64],"turntable":{"frames":1}}"#;
        let request = RenderRequest::for_preset(ViewPath::from_json(path).unwrap(), tf).unwrap();
        let o = Orientation::new(None, None).unwrap();
        PathScenes::new(&volume, &info, &request, o).unwrap()
    }

    #[test]
    fn the_estimate_is_of_the_size_of_the_error() {
        // Sheets so thick that rounding is nothing beside them.
        for tf in ["peer-opaque", "skin"] {
            let stage = stage(tf);
            let quality = Quality { eps: 0.0, ..stage.spec(0).quality };
            let draw = |thickness: f64| {
                let tables = stage.frame_with(0, |_| Quality { thickness, ..quality }).unwrap();
                direct::draw(&tables, &stage.bricks, Cut::on(2))
            };
            let (picture, finer) = (draw(2.0), draw(1.0));
            let guess = estimate(&picture, &finer, quality.compositing);
            let view = stage.view(0, &quality).unwrap();
            let reference = Reference::new(&stage.spec(0), view, &stage.bricks);
            let (mut guessed, mut true_) = (0.0, 0.0);
            for [x, y] in stratified([64, 64], 400, 1) {
                let i = (y * 64 + x) as usize;
                let want = reference.pixel(x, y);
                let off = |c: usize| (f64::from(picture.pixels[i][c]) - want[c]).abs() * 255.0;
                let off = (0..4).map(off).fold(0.0, f64::max);
                true_ += off * off;
                guessed += guess[i].unwrap_or(0.0) * guess[i].unwrap_or(0.0);
            }
            let ratio = f64::sqrt(guessed / true_);
            assert!((0.5..2.0).contains(&ratio), "{tf}: estimate over error {ratio}");
        }
    }

    #[test]
    fn every_kind_has_a_picture_with_a_legend_below() {
        let stage = stage("skin");
        for show in [DebugView::Depth, DebugView::Work, DebugView::Sheets, DebugView::Error] {
            let f = draw(&stage, show, 0, 2).unwrap();
            assert!(f.size[0] as usize == LEAST && f.size[1] > 64 + 30, "{show:?}: {:?}", f.size);
            let colours: std::collections::BTreeSet<_> = f.bytes.chunks_exact(3).collect();
            assert!(colours.len() > 40, "{show:?}: {}", colours.len());
        }
    }
}
