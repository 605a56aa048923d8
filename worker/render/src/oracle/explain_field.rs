//! One pixel of a field, plane by plane: the values along its ray, what each segment between two
//! planes adds, and the voxels behind them.
//!
//! Every number is the renderer's, in its own arithmetic, and the resulting pixel equals the
//! rendered one bit for bit. Nothing is culled; voxels behind the plane at which the pixel is shut
//! are counted.

use crate::kernels::field::{FieldSum, planes_of, weighted};
use crate::oracle::explain::finish;
use crate::oracle::field::close;
use crate::scene::Frame;
use slabcast_common::brick::{Brick, local_position};
use slabcast_common::ids::BrickId;
use slabcast_common::image::{COLOUR_UNIT, TilePixels};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::Sums;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// Explanation of one pixel of a field.
#[derive(Clone, Debug, PartialEq)]
pub struct FieldExplanation {
    /// Linear premultiplied RGBA, equal to the rendered pixel bit for bit.
    pub pixel: [f32; 4],
    /// Planes that hold a value at the pixel, front to back, up to the one at which it was shut.
    pub planes: Vec<PlaneAtPixel>,
    /// Number of the plane at which the pixel was shut; `None` if it stayed open.
    pub shut_in: Option<i32>,
    /// Number of voxels that add to one of `planes`.
    pub voxels: usize,
    /// Number of bricks that hold these voxels.
    pub bricks: usize,
    /// Number of voxels that cover the pixel but add to planes behind these only.
    pub hidden_voxels: usize,
}

/// Account of one plane at one pixel, and of the segment of the ray that ends there.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaneAtPixel {
    /// Number of the plane.
    pub k: i32,
    /// Depth behind the target in vox.
    pub depth: f64,
    /// The field's value as a sample code that need not be whole.
    pub code: f64,
    /// Length of the field's gradient in codes per vox.
    pub gradient: f64,
    /// Optical depth of the segment between the plane in front and this one.
    pub tau: f64,
    /// Mean linear red, green and blue of the segment's light, 0 to 1; zero if it adds none.
    pub colour: [f64; 3],
    /// Accumulated opacity behind the segment, 0 to 1; transmittance is `1 - a`.
    pub a: f32,
    /// Number of voxels that add to the plane at the pixel.
    pub voxels: usize,
    /// Number of bricks that hold these voxels.
    pub bricks: usize,
    /// Voxels with the largest contributions to the value, largest first.
    pub strongest: Vec<VoxelAtPixel>,
}

/// One voxel's contribution to one plane at one pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct VoxelAtPixel {
    /// Index of the voxel in the volume.
    pub voxel: [u32; 3],
    /// Number of the brick that holds the voxel.
    pub brick: BrickId,
    /// Sample code of the voxel.
    pub code: f64,
    /// Contribution to the plane's value in codes, counted from the background.
    pub adds: f64,
}

/// Explains pixel (x, y) of `frame`, whose sheets hold planes of a field, counted from the top left,
/// from `bricks`, all bricks of its scene. Each plane lists at most `strongest` voxels.
///
/// # Panics
/// If the pixel is not in the picture, or the scene classifies before reconstruction.
pub fn explain_field(
    frame: &Frame,
    bricks: &[Arc<Brick>],
    pixel: [u32; 2],
    strongest: usize,
) -> FieldExplanation {
    let [w, h] = frame.view.size;
    assert!(pixel[0] < w && pixel[1] < h, "a pixel of the picture");
    match frame.scene.quality.sums {
        Sums::I16 => Planes::<i16>::gather(frame, bricks, pixel).explain(frame, bricks, strongest),
        _ => Planes::<i32>::gather(frame, bricks, pixel).explain(frame, bricks, strongest),
    }
}

/// A voxel of a brick, by their indices, and its term of a plane's value.
type Term = (u32, u16, f32);

/// The planes at one pixel, and the voxels that add to each.
struct Planes<S> {
    pixel: [u32; 2],
    planes: BTreeMap<i32, ([S; 4], Vec<Term>)>,
}

impl<S: FieldSum> Planes<S> {
    fn gather(frame: &Frame, bricks: &[Arc<Brick>], pixel: [u32; 2]) -> Planes<S> {
        let rule = frame.field.as_ref().expect("a field's frame");
        let [x, y] = pixel.map(|p| p as i32);
        let here = Rect::new(x, y, x + 1, y + 1);
        let mut planes: BTreeMap<i32, ([S; 4], Vec<Term>)> = BTreeMap::new();
        let (mut bx, mut by) = (Vec::new(), Vec::new());
        for (b, brick) in bricks.iter().enumerate() {
            // Never too small, so nothing is missed.
            let projected = frame.view.project(&brick.tight_box(&frame.scene.grid));
            if projected.is_none_or(|p| p.rect.intersect(&here).is_empty()) {
                continue;
            }
            let corner = frame.corner(brick.id);
            for (i, &local) in brick.index.iter().enumerate() {
                let placed = frame.place(&corner, local);
                let (first, _) = frame.sections.span(placed.z);
                let payload = S::payload_of(frame.field_payload(rule, brick, i));
                for (n, &wz) in planes_of::<S>(&frame.sections, placed.z).iter().enumerate() {
                    let k = first + n as i32;
                    let Some(footprint) = frame.footprints.at(k) else { continue };
                    let at = frame.screen(&placed, k, &footprint);
                    let (_, wy) = S::window(&footprint, 1, at[1], (y, y + 1), &mut by);
                    let along = frame.along_row(at, y);
                    let (_, wx) = S::window(&footprint, 0, along, (x, x + 1), &mut bx);
                    let (&[wx], &[wy]) = (wx, wy) else { continue };
                    let row = weighted::<S>(weighted::<S>([payload; 4], wz), wy);
                    let term = weighted::<S>(row, wx);
                    let (sums, terms) = planes.entry(k).or_default();
                    for c in 0..4 {
                        sums[c] = sums[c].with(term[c]);
                    }
                    let adds = S::default().with(term[0]).value();
                    if adds != 0.0 {
                        terms.push((b as u32, i as u16, adds));
                    }
                }
            }
        }
        Planes { pixel, planes }
    }

    fn explain(&self, frame: &Frame, bricks: &[Arc<Brick>], strongest: usize) -> FieldExplanation {
        let (Some(rule), Some(scene)) = (&frame.field, &frame.scene.field) else {
            unreachable!("a frame whose sheets hold planes")
        };
        let at = self.pixel.map(|p| p as usize);
        let mut out = TilePixels { a: vec![0.0], colour: vec![[0; 3]], last: None };
        let mut planes = Vec::new();
        let mut shut_in = None;
        for (&k, (here, terms)) in &self.planes {
            if here[0].value() == 0.0 {
                continue;
            }
            let before = self.planes.get(&(k - 1)).map_or([S::default(); 4], |plane| plane.0);
            let (a, light) = (out.a[0], out.colour[0]);
            close(frame, (rule, scene), [before, *here], (at, k), 0, &mut out);
            let open = f64::from(1.0 - a);
            let seen = f64::from(out.a[0]) - f64::from(a);
            let colour = [0, 1, 2].map(|c| {
                let light = f64::from(out.colour[0][c].wrapping_sub(light[c]));
                if seen > 0.0 { light * f64::from(COLOUR_UNIT) / seen } else { 0.0 }
            });
            let (code, gradient) = rule.field_at(scene, here.map(S::value), at, k);
            let mut largest = terms.clone();
            // The sort is stable: of equals the first in order.
            largest.sort_by(|a, b| b.2.total_cmp(&a.2));
            let voxel = |&(b, i, adds): &Term| {
                let brick = &bricks[b as usize];
                let local = local_position(brick.index[usize::from(i)]);
                let corner = frame.scene.grid.corner(brick.id);
                VoxelAtPixel {
                    voxel: [0, 1, 2].map(|axis| corner[axis] + local[axis]),
                    brick: brick.id,
                    code: brick.values.code(i.into()),
                    adds: rule.codes(scene, adds),
                }
            };
            planes.push(PlaneAtPixel {
                k,
                depth: (f64::from(k) + 0.5) * frame.view.thickness,
                code,
                gradient,
                tau: -libm::log1p(-(seen / open).min(1.0)),
                colour,
                a: out.a[0],
                voxels: terms.len(),
                bricks: terms.iter().map(|term| term.0).collect::<BTreeSet<_>>().len(),
                strongest: largest.iter().take(strongest).map(voxel).collect(),
            });
            if frame.rule.is_shut(out.a[0]) {
                shut_in = Some(k);
                break;
            }
        }
        let last = shut_in.unwrap_or(i32::MAX);
        let voxels = |planes: &mut dyn Iterator<Item = &Vec<Term>>| -> BTreeSet<(u32, u16)> {
            planes.flatten().map(|&(b, i, _)| (b, i)).collect()
        };
        let read = voxels(&mut self.planes.range(..=last).map(|(_, plane)| &plane.1));
        let all = voxels(&mut self.planes.values().map(|plane| &plane.1));
        FieldExplanation {
            pixel: finish(out.a[0], out.colour[0]),
            planes,
            shut_in,
            voxels: read.len(),
            bricks: read.iter().map(|voxel| voxel.0).collect::<BTreeSet<_>>().len(),
            hidden_voxels: all.len() - read.len(),
        }
    }
}
