//! One pixel, sheet by sheet: what the renderer did there and which voxels made it.
//!
//! The paper's listing once more, for one pixel: its voxels in the order in which float sums are
//! defined, their sections put into sheets, sheets composited by the renderer's own rule. Every
//! number is the renderer's, in its own arithmetic, and the resulting pixel equals the rendered one
//! bit for bit (a test keeps it). Like [`crate::oracle::serial`] it culls nothing; what lies behind
//! the sheet in which the pixel was shut is counted, not drawn.

use crate::kernels::{Accumulate, Weight};
use crate::scene::Frame;
use slabcast_common::brick::Brick;
use slabcast_common::ids::BrickId;
use slabcast_common::image::{COLOUR_UNIT, FrameState, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Sums;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Explanation of one pixel: its sheets, their strongest voxels, and what was hidden.
#[derive(Clone, Debug, PartialEq)]
pub struct PixelExplanation {
    /// Linear premultiplied RGBA, equal to the rendered pixel bit for bit.
    pub pixel: [f32; 4],
    /// Sheets that hold something at the pixel and were composited, front to back.
    pub sheets: Vec<SheetAtPixel>,
    /// The sheet after which the pixel was shut; `None` if it stayed open.
    pub shut_in: Option<i32>,
    /// Number of voxels with a section in one of the composited sheets.
    pub voxels: usize,
    /// Number of bricks that hold the voxels counted in `voxels`.
    pub bricks: usize,
    /// Number of voxels that cover the pixel but begin behind the sheet in which it was shut.
    pub hidden_voxels: usize,
    /// Number of bricks all of whose voxels at the pixel are hidden so.
    pub hidden_bricks: usize,
}

/// Account of one sheet at one pixel: its sums and what they add.
#[derive(Clone, Debug, PartialEq)]
pub struct SheetAtPixel {
    /// Number of the sheet, which lies between `k` and `k + 1` thicknesses behind the target.
    pub k: i32,
    /// The sheet's sums in raw units: extinction, then the three colours times extinction.
    pub raw: [f32; 4],
    /// Raw sums of the sheet behind when this one was composited, half filled: the colour rule's
    /// peek.
    pub peek: [f32; 4],
    /// Optical depth of the sheet along the ray (sum of opacities, for the paper's compositing).
    pub tau: f32,
    /// Mean linear red, green and blue of the sheet, 0 to 1, weighted by extinction.
    pub colour: [f32; 3],
    /// Accumulated opacity in front of the sheet, 0 to 1.
    pub a_before: f32,
    /// Accumulated opacity behind the sheet, 0 to 1; transmittance is `1 - a`.
    pub a: f32,
    /// Light that the sheet adds to the pixel: linear, premultiplied, one rounding to 2^-28.
    pub light: [f64; 3],
    /// Number of voxel sections that are not zero at the pixel.
    pub sections: usize,
    /// Number of bricks that hold the sections counted in `sections`.
    pub bricks: usize,
    /// Sections with the largest optical depths, largest first.
    pub strongest: Vec<SectionAtPixel>,
}

/// One voxel's contribution to one sheet at one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionAtPixel {
    /// Index of the voxel in the volume.
    pub voxel: [u32; 3],
    /// Number of the brick that holds the voxel.
    pub brick: BrickId,
    /// Sample code of the voxel, before the map from codes to values.
    pub code: f64,
    /// Weights of the voxel, unitless: of the footprint along x and y, and of the section in depth.
    pub weights: [f32; 3],
    /// Optical depth that the voxel adds along the ray.
    pub tau: f32,
    /// Linear red, green and blue of the voxel after shading, 0 to 1.
    pub colour: [f32; 3],
}

/// Explains pixel (x, y) of `frame`, counted from the top left, from `bricks`, all bricks of its
/// scene. Each sheet lists at most `strongest` voxels.
///
/// # Panics
/// If the pixel is not in the picture.
pub fn explain(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    [x, y]: [u32; 2],
    strongest: usize,
) -> PixelExplanation {
    let [w, h] = frame.view.size;
    assert!(x < w && y < h, "pixel {x},{y} of a picture of {w}x{h}");
    let at = [x as i32, y as i32];
    match frame.scene.quality.sums {
        Sums::F32 => Pixel::<f32>::gather(frame, bricks, at).explain(strongest),
        Sums::I16 => Pixel::<i16>::gather(frame, bricks, at).explain(strongest),
        Sums::I32 | Sums::Auto => Pixel::<i32>::gather(frame, bricks, at).explain(strongest),
    }
}

/// A voxel that covers the pixel in at least one sheet.
struct Voxel {
    first: i32,
    brick: u32,
    i: u16,
    payload: [f32; 4],
}

/// A section at the pixel.
struct Part<S: Accumulate> {
    voxel: u32,
    /// Along x and y, and in depth, as real numbers.
    weights: [f32; 3],
    /// In the arithmetic of the sums.
    section: [S::Section; 4],
    wx: S::Weight,
    wy: S::Weight,
}

impl<S: Accumulate> Part<S> {
    /// Adds the section to `sums` in the renderer's arithmetic.
    fn add_to(&self, sums: &mut [S; 4]) {
        for c in 0..4 {
            sums[c] = sums[c].plus(S::row(self.section[c], self.wy), self.wx);
        }
    }
}

struct Pixel<'a, S: Accumulate> {
    frame: &'a Frame,
    bricks: &'a [Arc<Brick>],
    at: [i32; 2],
    /// In the order of float sums: first sheet, brick, voxel.
    voxels: Vec<Voxel>,
    /// The sections of each sheet, in the order of voxels.
    sheets: BTreeMap<i32, Vec<Part<S>>>,
}

impl<'a, S: Accumulate> Pixel<'a, S> {
    fn gather(frame: &'a Frame, bricks: &'a [Arc<Brick>], at: [i32; 2]) -> Pixel<'a, S> {
        let view = &frame.view;
        let here = Rect::new(at[0], at[1], at[0] + 1, at[1] + 1);
        let mut found = Vec::new();
        for (b, brick) in bricks.iter().enumerate() {
            // Never too small, so nothing is missed.
            let Some(p) = view.project(&brick.tight_box(&frame.scene.grid)) else { continue };
            if p.rect.intersect(&here).is_empty() {
                continue;
            }
            let corner = frame.corner(brick.id);
            for (i, &local) in brick.index.iter().enumerate() {
                let placed = frame.place(&corner, local);
                let (first, _) = frame.sections.of(placed.z);
                found.push((first, brick.id, i as u16, b as u32, placed));
            }
        }
        found.sort_unstable_by_key(|&(first, id, i, ..)| (first, id, i));
        let mut pixel = Pixel { frame, bricks, at, voxels: Vec::new(), sheets: BTreeMap::new() };
        let (mut bx, mut by) = (Vec::new(), Vec::new());
        let (mut tx, mut ty) = (Vec::new(), Vec::new());
        let (columns, rows) = ((at[0], at[0] + 1), (at[1], at[1] + 1));
        for (first, _, i, b, placed) in found {
            let z = placed.z;
            let (_, sections) = frame.sections.of(z);
            let mut payload = None;
            for (n, &wz) in sections.iter().enumerate() {
                let k = first + n as i32;
                let Some(f) = frame.footprints.at(k) else { continue };
                let [x, y] = frame.screen(&placed, k, &f);
                let x = frame.along_row([x, y], at[1]);
                let (_, wx) = S::Weight::of(&f, 0, x, columns, &mut bx);
                let (_, wy) = S::Weight::of(&f, 1, y, rows, &mut by);
                let (&[wx], &[wy]) = (wx, wy) else { continue };
                let (_, real_x) = f.weights(0, x, columns, &mut tx);
                let (_, real_y) = f.weights(1, y, rows, &mut ty);
                let (&[real_x], &[real_y]) = (real_x, real_y) else { continue };
                let payload = *payload.get_or_insert_with(|| {
                    frame.payload(&bricks[b as usize], i.into(), placed.eye)
                });
                if payload[0] <= 0.0 {
                    break;
                }
                if pixel.voxels.last().is_none_or(|v| (v.brick, v.i) != (b, i)) {
                    pixel.voxels.push(Voxel { first, brick: b, i, payload });
                }
                let voxel = (pixel.voxels.len() - 1) as u32;
                let parts = pixel.sheets.entry(k).or_default();
                let weights = [real_x.get(), real_y.get(), wz];
                let section = S::section(&frame.sections, z, n, &payload);
                parts.push(Part { voxel, weights, section, wx, wy });
            }
        }
        pixel
    }

    /// The sums of sheet `k` of the voxels that begin at `last` or before.
    fn sums(&self, k: i32, last: i32) -> [S; 4] {
        let mut sums = [S::default(); 4];
        for part in self.sheets.get(&k).into_iter().flatten() {
            let v = &self.voxels[part.voxel as usize];
            if v.first > last {
                // Voxels ascend by first sheet.
                break;
            }
            part.add_to(&mut sums);
        }
        sums
    }

    fn explain(&self, strongest: usize) -> PixelExplanation {
        let frame = self.frame;
        let secant = frame.view.secant(self.at[0], self.at[1]);
        let (mut a, mut colour) = (0.0f32, [0u32; 3]);
        let mut sheets = Vec::new();
        let mut shut_in = None;
        for &k in self.sheets.keys() {
            if frame.rule.is_shut(a) {
                break;
            }
            // An empty sheet in between is one with no sums.
            let before = self.sums(k - 1, k - 1);
            let here = self.sums(k, k);
            let behind = self.sums(k + 1, k);
            let (a_before, c_before) = (a, colour);
            frame.rule.close(before, here, behind, secant, &mut a, &mut colour);
            let raw = here.map(S::value);
            let light = std::array::from_fn(|c| {
                f64::from(colour[c].wrapping_sub(c_before[c])) * f64::from(COLOUR_UNIT)
            });
            let mean = |c: usize| if raw[0] > 0.0 { raw[c] / raw[0] } else { 0.0 };
            let (sections, bricks, strongest) = self.sections(k, secant, strongest);
            if sections > 0 {
                sheets.push(SheetAtPixel {
                    k,
                    raw,
                    peek: behind.map(S::value),
                    tau: frame.rule.optical_depth(raw[0], secant),
                    colour: [mean(1), mean(2), mean(3)],
                    a_before,
                    a,
                    light,
                    sections,
                    bricks,
                    strongest,
                });
            }
            if frame.rule.is_shut(a) {
                shut_in = Some(k);
            }
        }
        let last = shut_in.unwrap_or(i32::MAX);
        let (read, hidden): (Vec<&Voxel>, Vec<&Voxel>) =
            self.voxels.iter().partition(|v| v.first <= last);
        let bricks = |of: &[&Voxel]| -> BTreeSet<u32> { of.iter().map(|v| v.brick).collect() };
        let read_bricks = bricks(&read);
        PixelExplanation {
            pixel: finish(a, colour),
            sheets,
            shut_in,
            voxels: read.len(),
            bricks: read_bricks.len(),
            hidden_voxels: hidden.len(),
            hidden_bricks: bricks(&hidden).difference(&read_bricks).count(),
        }
    }

    /// Number of sections of sheet `k` that are not zero, number of their bricks, and the
    /// strongest.
    fn sections(&self, k: i32, secant: f32, n: usize) -> (usize, usize, Vec<SectionAtPixel>) {
        let mut all = Vec::new();
        for part in self.sheets.get(&k).into_iter().flatten() {
            let mut sums = [S::default(); 4];
            part.add_to(&mut sums);
            let raw = sums[0].value();
            if raw > 0.0 {
                all.push((raw, part));
            }
        }
        let bricks: BTreeSet<u32> =
            all.iter().map(|(_, p)| self.voxels[p.voxel as usize].brick).collect();
        // The sort is stable: of equals the first in order.
        all.sort_by(|a, b| b.0.total_cmp(&a.0));
        let section = |&(raw, part): &(f32, &Part<S>)| {
            let v = &self.voxels[part.voxel as usize];
            let brick = &self.bricks[v.brick as usize];
            let local = slabcast_common::brick::local_position(brick.index[v.i as usize]);
            let corner = self.frame.scene.grid.corner(brick.id);
            let [sigma, r, g, b] = v.payload;
            SectionAtPixel {
                voxel: std::array::from_fn(|a| corner[a] + local[a]),
                brick: brick.id,
                code: brick.values.code(v.i.into()),
                weights: part.weights,
                tau: self.frame.rule.optical_depth(raw, secant),
                colour: [r / sigma, g / sigma, b / sigma],
            }
        };
        (all.len(), bricks.len(), all.iter().take(n).map(section).collect())
    }
}

/// Makes a pixel of opacity and fixed-point light, as the end of a frame does.
pub(super) fn finish(a: f32, colour: [u32; 3]) -> [f32; 4] {
    let mut state = FrameState::new([1, 1]);
    let pixels = TilePixels { a: vec![a], colour: vec![colour], last: None };
    state.add_slab_tile(Rect::new(0, 0, 1, 1), &pixels);
    state.to_picture().pixels[0]
}
