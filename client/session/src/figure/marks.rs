//! Computes a frame's annotations: the length of its scale bar in mm and its orientation letters
//! from the camera, its colour bar from the transfer function.

use super::bar::{millimetres, number, round_below, ticks};
use super::{Board, Figure, Place};
use crate::fail::Fail;
use crate::letters;
use crate::request::RenderRequest;
use glam::DVec3;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::math::srgb_from_linear;
use slabcast_common::quality::Compositing;
use slabcast_common::transfer::Classifier;
use slabcast_common::view::{Camera, CameraProjection};
use slabcast_common::volume::VolumeInfo;
use slabcast_scene::path::{Orientation, ProjectionKind, ViewPath};

/// Longest part of a picture's width that a scale bar takes.
const LONGEST: f64 = 0.22;
/// Widths of the colour bar and of the opacities beside it, in sizes of text.
const BAR: f64 = 0.8;
const PROFILE: f64 = 1.4;
/// Lines of the colour bar whose opacity is known.
const STEPS: usize = 256;

/// Draws the marks of a run's frames.
pub struct Marker {
    figure: Figure,
    /// Path with all numbers, its cameras made one by one.
    path: ViewPath,
    info: VolumeInfo,
    orientation: Orientation,
    colours: Option<Colours>,
    /// sRGB of the background; white where there is none.
    behind: [u8; 3],
    /// Whether frames become one picture, which then has one colour bar and one caption.
    grid: bool,
}

/// Colours and opacities over a range of values.
struct Colours {
    from: f64,
    to: f64,
    /// sRGB and opacity of one voxel, evenly from `from` to `to`.
    steps: Vec<([f64; 3], f64)>,
}

/// Checks that a volume and a path have what the marks say.
///
/// # Errors
/// The projection, the path or the volume has no such mark; the error names the flag.
fn fits(figure: &Figure, request: &RenderRequest, info: &VolumeInfo) -> Result<(), Fail> {
    let refuse = |line: &str| Err(Fail::usage(line));
    let placed = info.summary.anatomical;
    let path = &request.path;
    let keys = || path.keyframes.iter().flat_map(|k| &k.keys);
    let persp = path.turntable.is_some_and(|t| t.projection == ProjectionKind::Persp)
        || keys().any(|k| k.projection == ProjectionKind::Persp)
        || path.views.iter().any(|v| v.projection == ProjectionKind::Persp)
        || path.flythrough.is_some();
    if figure.scale_bar.is_some() && persp {
        return refuse(
            "--scale-bar: in perspective a length depends on its depth; leave it out, or the \
             perspective",
        );
    }
    if placed && figure.scale_bar.as_ref().is_some_and(|unit| !unit.is_empty() && unit != "mm") {
        return refuse(
            "--scale-bar: this file is in mm, and the bar takes the prefix that suits; leave the \
             unit out",
        );
    }
    if figure.orientation && !placed {
        return refuse(
            "--orientation: the file does not say where right, anterior and superior are; leave it \
             out, or say it in the file",
        );
    }
    if figure.color_bar && keys().any(|k| k.tf.is_some()) {
        return refuse("--color-bar: colours change from key to key; leave it out");
    }
    Ok(())
}

impl Marker {
    /// Checks the marks of a run; `path` has the numbers of the framing. None if there are none.
    ///
    /// # Errors
    /// The projection, the path or the volume has no such mark; the error names the flag.
    pub fn new(
        figure: &Figure,
        request: &RenderRequest,
        path: ViewPath,
        info: &VolumeInfo,
        orientation: Orientation,
        grid: bool,
    ) -> Result<Option<Marker>, Fail> {
        if figure.flag().is_none() {
            return Ok(None);
        }
        fits(figure, request, info)?;
        let colours = if figure.color_bar { Some(Colours::new(request, info)?) } else { None };
        let behind = match request.background {
            Background::Transparent => [255; 3],
            Background::Colour(c) => c.map(|x| (x * 255.0 + 0.5) as u8),
        };
        let (figure, info) = (figure.clone(), info.clone());
        Ok(Some(Marker { figure, path, info, orientation, colours, behind, grid }))
    }

    /// Returns the pixels of a finished frame with its marks; `number` is its number on the whole
    /// path.
    pub fn draw(
        &self,
        number: u64,
        size: [u32; 2],
        format: PixelFormat,
        bytes: Vec<u8>,
    ) -> Vec<u8> {
        let mut board = Board::new(size, format, bytes, self.behind);
        let [w, h] = board.size();
        let em = board.em();
        let mut bottom = h;
        if !self.grid {
            bottom = self.draw_caption(&mut board, [0.0, w], h);
            if let Some(colours) = &self.colours {
                // In the upper corner: the middle of the edge is for a letter.
                let top = (0.05 * h).max(em);
                colours.draw(&mut board, w - 0.7 * em, [top, (0.43 * h - 1.5 * em).max(top + 1.0)]);
            }
        }
        // Frames that were drawn have a camera.
        let i = (number as usize).saturating_sub(self.path.first_frame());
        if let Ok(camera) = self.path.camera(i, &self.info.lattice, self.orientation) {
            if self.figure.orientation {
                for (place, letters) in edges(&camera) {
                    let end = if place == Place::Bottom { bottom } else { h };
                    board.text_in([0.0, 0.0, w, end], &letters, place);
                }
            }
            if let (Some(unit), CameraProjection::Ortho { height }) =
                (&self.figure.scale_bar, camera.projection)
            {
                self.draw_scale(&mut board, [0.0, 0.0, w, bottom], height / h, unit);
            }
        }
        board.ink();
        board.into_bytes()
    }

    /// Returns the pixels that a grid of views needs at its right and below for what it has once.
    pub fn room(&self, grid: [f64; 2], em: f64) -> [f64; 2] {
        let wide = self.colours.as_ref().map_or(0.0, |c| c.width(em) + 1.4 * em);
        let lines = self.caption_lines(em, grid[0]).len() as f64;
        [wide, if lines > 0.0 { 1.3 * em * lines + 0.9 * em } else { 0.0 }].map(f64::ceil)
    }

    /// Draws what a grid of views has once, at its right and below; `grid` is the size of all
    /// views.
    pub fn draw_whole(&self, board: &mut Board, grid: [f64; 2]) {
        let [w, h] = board.size();
        let em = board.em();
        self.draw_caption(board, [0.0, grid[0]], h);
        if let Some(colours) = &self.colours {
            let middle = grid[1] / 2.0;
            let half = (0.35 * grid[1]).min(14.0 * em);
            colours.draw(board, w - 0.7 * em, [middle - half, middle + half]);
        }
        board.ink();
    }

    fn caption_lines(&self, em: f64, wide: f64) -> Vec<String> {
        let caption = self.figure.caption.as_deref().unwrap_or_default();
        wrapped(caption, em, wide - 1.4 * em)
    }

    /// Draws the caption above `bottom` and returns where it begins.
    fn draw_caption(&self, board: &mut Board, [left, right]: [f64; 2], bottom: f64) -> f64 {
        let em = board.em();
        let lines = self.caption_lines(em, right - left);
        for (i, line) in lines.iter().rev().enumerate() {
            board.text([left + 0.7 * em, bottom - 0.7 * em - 1.3 * em * i as f64], em, line);
        }
        bottom - 1.3 * em * lines.len() as f64
    }

    /// Draws a bar of a round length in the corner at the bottom right.
    fn draw_scale(&self, board: &mut Board, area: [f64; 4], units_a_pixel: f64, unit: &str) {
        let em = board.em();
        let length = round_below((area[2] - area[0]) * LONGEST * units_a_pixel);
        let wide = (length / units_a_pixel).round();
        let label = match unit {
            _ if self.info.summary.anatomical => millimetres(length),
            "" => number(length),
            unit => format!("{} {unit}", number(length)),
        };
        let thick = (0.22 * em).round().max(2.0);
        let text = letters::width(&label, em);
        // The wider of bar and label ends at the margin; the other is in its middle.
        let right = (area[2] - 0.9 * em).round();
        let bar = (right - (text - wide).max(0.0) / 2.0).round();
        let y = (area[3] - 0.8 * em).round();
        board.fill([bar - wide, y - thick, bar, y], 1.0);
        board.text([bar - wide / 2.0 - text / 2.0, y - thick - 0.35 * em], em, &label);
    }
}

/// Lines of a text that are no wider than `wide`, where its words allow.
fn wrapped(text: &str, em: f64, wide: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split_whitespace() {
        match lines.last_mut() {
            Some(line) if letters::width(&format!("{line} {word}"), em) <= wide => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.into()),
        }
    }
    lines
}

/// Letters of the sides that a direction points to: one, or two if it lies well between them.
fn sides(direction: DVec3) -> String {
    const LETTERS: [[char; 2]; 3] = [['R', 'L'], ['A', 'P'], ['S', 'I']];
    let mut axes = [0, 1, 2];
    axes.sort_by(|&a, &b| direction[b].abs().total_cmp(&direction[a].abs()));
    // From 22.5 degrees off the first one.
    let second = direction[axes[1]].abs() > 0.414 * direction[axes[0]].abs();
    let letter = |axis: usize| LETTERS[axis][usize::from(direction[axis] < 0.0)];
    axes[..if second { 2 } else { 1 }].iter().map(|&axis| letter(axis)).collect()
}

/// Returns the sides of the body at the edges of a picture.
fn edges(camera: &Camera) -> [(Place, String); 4] {
    let ahead = -camera.to_eye.normalize();
    let right = ahead.cross(camera.up).normalize();
    let down = ahead.cross(right);
    [
        (Place::Left, sides(-right)),
        (Place::Right, sides(right)),
        (Place::Top, sides(-down)),
        (Place::Bottom, sides(down)),
    ]
}

impl Colours {
    fn new(request: &RenderRequest, info: &VolumeInfo) -> Result<Colours, Fail> {
        if info.summary.palette.is_some() {
            return Err(Fail::usage(
                "--color-bar: the voxels have colours of their own, which no bar shows; leave it out",
            ));
        }
        let tf = request.transfer.function(info).map_err(|e| request.blame(&e))?;
        let (from, to) = crate::transfer::shown_values(&tf, info);
        let classifier = Classifier::new(&tf, info, Compositing::Linear);
        let map = info.summary.map;
        let step = |i: usize| {
            let value = from + (to - from) * i as f64 / (STEPS - 1) as f64;
            let [sigma, r, g, b] = classifier.optics_at((value - map.offset) / map.scale);
            ([r, g, b].map(srgb_from_linear), -libm::expm1(-sigma))
        };
        Ok(Colours { from, to, steps: (0..STEPS).map(step).collect() })
    }

    fn labels(&self) -> Vec<(f64, String)> {
        ticks(self.from, self.to).into_iter().map(|t| (t, number(t))).collect()
    }

    /// Returns the width of the bar with its numbers and opacities, in pixels.
    fn width(&self, em: f64) -> f64 {
        let labels = self.labels();
        let text = labels.iter().map(|(_, l)| letters::width(l, em)).fold(0.0, f64::max);
        text + (0.6 + BAR + PROFILE) * em
    }

    /// Draws the bar upright between two heights, with its numbers left of `right`, and beside it
    /// how opacity goes.
    fn draw(&self, board: &mut Board, right: f64, [top, bottom]: [f64; 2]) {
        let em = board.em();
        let labels = self.labels();
        let text = labels.iter().map(|(_, l)| letters::width(l, em)).fold(0.0, f64::max);
        let (top, high) = (top.round(), (bottom - top).round().max(1.0));
        let right = (right - text - 0.6 * em).round();
        let left = (right - BAR * em).round();
        let line = (em * 0.07).round().max(1.0);
        // A frame; then colours inside, which need no halo.
        board.fill([left - line, top - line, right + line, top + high + line], 1.0);
        for (tick, label) in &labels {
            let share =
                if self.to > self.from { (tick - self.from) / (self.to - self.from) } else { 0.5 };
            let y = (top + high * (1.0 - share)).round();
            board.fill([right + line, y - line / 2.0, right + 0.35 * em, y + line / 2.0], 1.0);
            board.text([right + 0.6 * em, y + 0.36 * em], em, label);
        }
        let most = self.steps.iter().map(|s| s.1).fold(0.0, f64::max);
        let at = |y: usize| {
            let share = 1.0 - (y as f64 + 0.5) / high;
            self.steps[((share * STEPS as f64) as usize).min(STEPS - 1)]
        };
        let base = left - line;
        let mut before = None;
        for y in 0..high as usize {
            let edge = base - PROFILE * em * at(y).1 / most.max(f64::MIN_POSITIVE);
            let row = top + y as f64;
            board.fill([edge, row, base, row + 1.0], 0.3);
            // The curve, whole also where it is nearly level.
            let other = before.unwrap_or(edge);
            let (lo, hi) = (f64::min(edge, other) - line / 2.0, f64::max(edge, other) + line / 2.0);
            board.fill([lo, row, hi, row + 1.0], 1.0);
            before = Some(edge);
        }
        let small = (0.75 * em).max(9.0);
        let note = format!("opacity to {}", number((most * 100.0).round() / 100.0));
        let note = if most < 0.095 { format!("opacity to {}", number(most)) } else { note };
        let wide = letters::width(&note, small);
        let start = right + 0.6 * em + text - wide;
        board.text([start, top + high + line + 1.5 * small], small, &note);
        board.ink();
        for y in 0..high as usize {
            let row = top + y as f64;
            board.paint([left, row, right, row + 1.0], at(y).0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::Volume;

    fn info(anatomical: bool) -> VolumeInfo {
        let volume = Volume::from_fn_u8("v", [40; 3], |i, j, k| (i + j + k) as u8);
        let mut info = volume.info(volume.digest());
        info.summary.anatomical = anatomical;
        info
    }

    fn request(path: &str) -> RenderRequest {
        RenderRequest::for_preset(ViewPath::from_json(path).unwrap(), "skin").unwrap()
    }

    const FRONT: &str =
        r#"{"version":1,"size":[200,100],"turntable":{"start":0,"frames":1,"height":50}}"#;

    fn marker(figure: &Figure, path: &str, anatomical: bool) -> Result<Option<Marker>, String> {
        let (request, o) = (request(path), Orientation::new(None, None).unwrap());
        Marker::new(figure, &request, request.path.clone(), &info(anatomical), o, false)
            .map_err(|e| e.line().unwrap_or_default().to_string())
    }

    #[test]
    fn letters_name_the_sides_that_edges_point_to() {
        let path = |view: &str| {
            format!(
                r#"{{"version":1,"size":[9,9],"keyframes":{{"frames":1,"keys":[{{{view}}}]}}}}"#
            )
        };
        let o = Orientation::new(None, None).unwrap();
        for (view, want) in [
            // Left, right, top, bottom edge.
            (r#""view":"anterior""#, "R L S I"),
            (r#""view":"posterior""#, "L R S I"),
            (r#""view":"left""#, "A P S I"),
            (r#""view":"superior""#, "L R A P"),
            (r#""azimuth":45"#, "RP LA S I"),
            (r#""azimuth":10"#, "R L S I"),
        ] {
            let path = ViewPath::from_json(&path(view)).unwrap();
            let camera = path.camera(0, &info(true).lattice, o).unwrap();
            let said = edges(&camera).map(|(_, letters)| letters).join(" ");
            let sorted = |s: &str| {
                let words = s.split(' ').map(|w| {
                    let mut letters: Vec<char> = w.chars().collect();
                    letters.sort_unstable();
                    letters.into_iter().collect::<String>()
                });
                words.collect::<Vec<_>>()
            };
            assert_eq!(sorted(&said), sorted(want), "{view}: {said}");
        }
    }

    #[test]
    fn a_scale_bar_is_as_long_as_it_says() {
        let figure = Figure { scale_bar: Some(String::new()), ..Figure::default() };
        let marker = marker(&figure, FRONT, true).unwrap().unwrap();
        let after = marker.draw(0, [200, 100], PixelFormat::Rgb8, vec![0; 200 * 100 * 3]);
        // 0.5 mm a pixel; 22 % of the width are 22 mm: 20 mm, 40 pixels.
        let white = |y: usize| (0..200).filter(|x| after[(y * 200 + x) * 3] == 255).count();
        assert_eq!((60..100).map(white).max(), Some(40));
    }

    #[test]
    fn marks_that_would_lie_are_refused() {
        let scale = Figure { scale_bar: Some(String::new()), ..Figure::default() };
        let sides = Figure { orientation: true, ..Figure::default() };
        let bar = Figure { color_bar: true, ..Figure::default() };
        let persp = FRONT.replace("\"frames\"", "\"projection\":\"persp\",\"frames\"");
        let tween = r#"{"version":1,"size":[9,9],"keyframes":{"frames":2,"keys":[
            {"azimuth":0,"tf":"skin"},{"azimuth":9,"tf":"fog"}]}}"#;
        for (figure, path, placed, flag) in [
            (&scale, persp.as_str(), true, "--scale-bar: in perspective"),
            (&sides, FRONT, false, "--orientation: the file"),
            (&bar, tween, true, "--color-bar: colours change"),
        ] {
            let said = marker(figure, path, placed).err().unwrap_or_default();
            assert!(said.starts_with(flag), "{said}");
        }
        assert!(marker(&Figure::default(), FRONT, false).unwrap().is_none());
    }

    #[test]
    fn all_marks_fit_into_pictures_of_any_size() {
        let figure = Figure {
            scale_bar: Some(String::new()),
            color_bar: true,
            orientation: true,
            caption: Some("A caption of several words that has to be wrapped into lines".into()),
            dpi: None,
        };
        for size in [[1, 1], [7, 90], [64, 48], [700, 500]] {
            let path = FRONT.replace("[200,100]", &format!("[{},{}]", size[0], size[1]));
            let marker = marker(&figure, &path, true).unwrap().unwrap();
            let bytes = vec![40; (size[0] * size[1] * 3) as usize];
            let after = marker.draw(0, size, PixelFormat::Rgb8, bytes.clone());
            assert!(after.len() == bytes.len() && (size[0] < 60 || after != bytes), "{size:?}");
        }
    }
}
