//! A scene and one view of it, with the tables that all tiles share.

use crate::kernels::composite::field::{FieldRule, FieldScene};
use crate::kernels::composite::{LANES, Row, Rule};
use crate::kernels::{Simd, lut};
use crate::primitives::footprint::{
    Footprint, Footprints, Lean, Leaning, Profile, Sections, Shelf,
};
use crate::primitives::positions::{FlatCorner, Places};
use crate::visibility::open_mask::REACH_MOST;
use glam::{DVec3, Vec3};
use slabcast_common::bounds::{i16_units_per_payload, i32_units_per_payload};
use slabcast_common::brick::{Brick, BrickGrid, TightBox, local_position};
use slabcast_common::ids::BrickId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Compositing, Quality, Sums};
use slabcast_common::shade::{LightTerms, NO_NORMAL, Shader, Shading};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::Classifier;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS, View};
use slabcast_common::volume::Samples;
use std::sync::Arc;

/// A volume's appearance under one transfer function and quality, without its voxels. Frames of all
/// views share it.
#[derive(Debug)]
pub struct Scene {
    /// Table of extinction (per vox) and colour (linear, 0 to 1) by sample code.
    pub classifier: Classifier,
    /// Light on voxels; [`Frame::shader`] is made of it.
    pub shading: Shading,
    /// Quality of the pictures, with [`Sums::Auto`] resolved.
    pub quality: Quality,
    /// The volume's division into bricks of 8x8x8 voxels.
    pub grid: BrickGrid,
    /// Number of samples along each index axis.
    pub dims: [u32; 3],
    /// Largest extinction per vox that any code has (largest alpha, for the paper's compositing).
    pub payload_max: f64,
    /// Values and their looks, where they are classified after reconstruction.
    #[doc(hidden)]
    pub field: Option<FieldScene>,
    shelf: Arc<Shelf>,
}

impl Scene {
    /// Prepares the scene that `spec` describes: tables of appearance and light.
    pub fn new(spec: &SceneSpec) -> Self {
        let classifier = Classifier::new(&spec.transfer, &spec.volume, spec.quality.compositing);
        let payload_max = classifier.payload_max();
        let quality = spec.quality.for_volume(&spec.volume.summary);
        let after = quality.classify == Classify::After;
        Scene {
            field: after.then(|| FieldScene::new(spec, &classifier)),
            classifier,
            shading: spec.transfer.shading,
            quality,
            grid: BrickGrid::new(spec.volume.lattice.dims),
            dims: spec.volume.lattice.dims,
            payload_max,
            shelf: Arc::default(),
        }
    }

    /// Tables that frames share.
    pub(crate) fn shelf(&self) -> &Shelf {
        &self.shelf
    }

    /// Returns whether sheets add floats instead of whole numbers.
    pub fn float_sums(&self) -> bool {
        self.quality.sums == Sums::F32
    }
}

/// Share of a pixel's light that merged slivers may move to another sheet in 32-bit sums, in units
/// of eps. At the default eps this is 0.0098; the default kernel moves 0.0078 at most (at the
/// largest extinction, in sheets of a vox).
const SLIVERS_PER_EPS: f64 = 5.0;

/// One view of a scene, ready to be drawn by any number of threads. Every renderer of this crate
/// takes positions, payloads and the rule of compositing from here.
#[derive(Debug)]
pub struct Frame {
    /// Scene that is viewed: appearance of samples, quality and size.
    pub scene: Arc<Scene>,
    /// Camera, picture size in pixels and sheet thickness.
    pub view: View,
    /// Weights of a voxel's sections by depth phase (paper section 3).
    #[doc(hidden)]
    pub sections: Arc<Sections>,
    /// Footprints of the view, one scale or one for each sheet.
    #[doc(hidden)]
    pub footprints: Footprints,
    pub(crate) rule: Rule,
    /// Compositing rule of a field; `None` if voxels are classified before they are
    /// splatted.
    #[doc(hidden)]
    pub field: Option<Arc<FieldRule>>,
    /// Raw units of a sheet's sums for one unit of payload; for 16-bit sums times the factors of
    /// their weights.
    pub raw_scale: f32,
    /// Offsets of the 512 voxels of a brick from its corner, in vox, by the eye's axes.
    offsets: Box<[[f64; 512]; 3]>,
    /// Unit direction to the eye in world axes, in orthographic views.
    pub(crate) to_eye: Option<Vec3>,
    /// Light on voxels as this view has it; `None` where voxels are unlit.
    pub shader: Option<Shader>,
    /// Integer positions, where all sections of all voxels share one footprint.
    #[doc(hidden)]
    pub flat: Option<Flat>,
    /// Offsets of sections and rows, where the kernel leans.
    #[doc(hidden)]
    pub leaning: Option<Leaning>,
}

/// Integer positions of an orthographic view whose footprints are in a table and small enough for
/// masks.
#[derive(Debug)]
#[doc(hidden)]
pub struct Flat {
    /// Positions of voxels on the screen and in depth.
    pub places: Places,
    /// Most pixels along x and y from the pixel of a voxel's centre to the edge of its footprint.
    pub reach: [i32; 2],
}

/// Position of a brick's first voxel in a frame.
#[derive(Clone, Copy, Debug)]
pub struct Corner {
    /// Index position (i, j, k) of the brick's first voxel.
    #[doc(hidden)]
    pub index: [u32; 3],
    /// Eye coordinates of the brick's first voxel, in vox.
    pub eye: DVec3,
    /// Integer position of the brick's first voxel (2^-24 subpixel, 2^-24 phase); used in
    /// orthographic views alone.
    #[doc(hidden)]
    pub flat: FlatCorner,
}

/// Position of a voxel in a frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct Placed {
    /// Eye coordinates of the voxel, in vox.
    pub eye: DVec3,
    /// Depth of the voxel in phases of a sheet ([`View::depth_phases`]).
    pub z: i32,
    /// Screen position in subpixels, in orthographic views.
    screen: Option<[i64; 2]>,
}

impl Frame {
    /// Returns this frame without early ray termination: no pixel is ever shut. The difference from
    /// the frame itself is what the cut-off eps leaves out. A frame whose quality has eps 0 may
    /// differ from it in more than that: its slivers are not merged ([`Sections::given_away`]).
    #[must_use]
    pub fn never_shut(self) -> Self {
        let field = self.field.as_ref().map(|field| Arc::new(field.never_shut()));
        Frame { rule: self.rule.never_shut(), field, ..self }
    }

    /// Prepares `view` of `scene` for any number of render threads.
    pub fn new(scene: Arc<Scene>, view: View) -> Self {
        let q = &scene.quality;
        let after = scene.field.is_some();
        let whole = TightBox { lo: [0; 3], hi: scene.dims.map(|n| n - 1) };
        let range = view.project(&whole).map_or(SheetRange::new(0, 0), |p| p.sheets);
        // One sheet farther for the peek.
        let range = SheetRange::new(range.first, range.end + 1);
        let spread = view.kernel_std / q.kernel_shape()[0];
        let profile = Profile::new(q.kernel, view.kernel_std.z, view.kernel_radius.z);
        let profile = profile.with_spread(spread.z);
        let d = view.thickness;
        let phases = view.depth_phases();
        // Floats are there to be near the limit, 16 bits to be fast.
        let merged = match q.sums {
            Sums::F32 => false,
            Sums::I16 => true,
            Sums::I32 | Sums::Auto => {
                let away = Sections::given_away(&profile, d, phases, scene.payload_max);
                away <= SLIVERS_PER_EPS * q.eps
            }
        };
        let to_eye = match view.projection {
            Projection::Ortho { .. } => Some(view.direction_to_eye(DVec3::ZERO)),
            Projection::Persp { .. } => None,
        };
        let footprints =
            Footprints::new(&view, q.kernel, range, spread, scene.shelf.clone(), after);
        let reach = footprints.at(0).and_then(|f| f.reach());
        let sections = if after {
            scene.shelf.planes(&profile, d, phases)
        } else {
            scene.shelf.sections(&profile, d, phases, merged)
        };
        let largest = (range.first..range.end).find_map(|k| view.scale_at(k)).unwrap_or(1.0);
        let leans = !view.kernel_lean.is_none();
        let leaning = leans.then(|| Leaning::new(&view, &profile, &sections, largest));
        let leaning = leaning.filter(Leaning::shows);
        let (raw_scale, unit) = match q.sums {
            Sums::F32 => (1.0, 1.0),
            // Weights are those per step of the lattice and over the thickness, so the payload has
            // these factors. It is at most 31,207, since a cell is no larger than the product of
            // the spreads.
            Sums::I16 => {
                let units = i16_units_per_payload(scene.payload_max, d);
                ((units * d / (spread.x * spread.y * spread.z)) as f32, (1.0 / units) as f32)
            }
            Sums::I32 | Sums::Auto => {
                let scale = i32_units_per_payload(scene.payload_max, d);
                (scale, (1.0 / f64::from(scale)) as f32)
            }
        };
        let rule = Rule::new(q.compositing, unit, d / view.kernel_std.z, q.eps as f32);
        let reach = reach.map(|reach| match &leaning {
            Some(leaning) => {
                let aside = leaning.pixels(largest, reach);
                // A subpixel more, since what lies aside is rounded, too; what does not is nothing.
                let subpixel = 1.0 / f64::from(SUBPIXELS);
                let more = |aside| if aside > 0.0 { aside + subpixel } else { 0.0 };
                [0, 1].map(|axis| reach[axis] + libm::ceil(more(aside[axis])) as i32)
            }
            None => reach,
        });
        let reach = reach.filter(|reach| reach.iter().all(|&reach| reach <= REACH_MOST));
        let flat = reach.and_then(|reach| Some(Flat { places: Places::new(&view)?, reach }));
        let mut offsets = Box::new([[0.0; 512]; 3]);
        for i in 0..512u16 {
            let v = view.offset_in_eye(local_position(i)).to_array();
            offsets.iter_mut().zip(v).for_each(|(offsets, v)| offsets[usize::from(i)] = v);
        }
        let shading = &scene.shading;
        let shader = shading.on.then(|| Shader::new(shading, &view.eye_from_world));
        let field = scene
            .field
            .as_ref()
            .map(|field| FieldRule::new(field, shader.as_ref(), q, &view, spread).into());
        Frame {
            field,
            flat,
            leaning,
            sections,
            footprints,
            rule,
            raw_scale,
            offsets,
            to_eye,
            shader,
            view,
            scene,
        }
    }

    /// Returns whether sheets hold a field's planes, which are classified when they close.
    pub(crate) fn is_field(&self) -> bool {
        self.field.is_some()
    }

    /// Returns whether the colour rule reads the neighbouring sheets' sums, so that a slab hands
    /// its last sheet on to the next.
    pub fn looks_at_neighbours(&self) -> bool {
        self.is_field() || self.scene.quality.compositing == Compositing::Linear
    }

    /// Returns the position of the first voxel of brick `id`.
    pub fn corner(&self, id: BrickId) -> Corner {
        let index = self.scene.grid.corner(id);
        let eye = self.view.corner_in_eye(index);
        Corner { index, eye, flat: self.flat.as_ref().map_or([0; 3], |f| f.places.corner(eye)) }
    }

    /// Returns the position of the voxel with index `local` (0 to 511, x fastest) in the brick at
    /// `corner`: the one definition of a position, for every renderer.
    ///
    /// # Panics
    /// If `local` is above 511.
    #[inline]
    pub fn place(&self, corner: &Corner, local: u16) -> Placed {
        let [x, y, z] = self.offsets.each_ref().map(|o| o[usize::from(local)]);
        let eye = corner.eye + DVec3::new(x, y, z);
        match &self.flat {
            Some(flat) => {
                let (screen, z) = flat.places.at(corner.flat, local);
                Placed { eye, z, screen: Some(screen) }
            }
            None => Placed { eye, z: self.view.depth_in_phases(eye.z), screen: None },
        }
    }

    /// Returns the screen position, in 1/256 pixel of absolute image coordinates, of a voxel's
    /// footprint in sheet `k`, one of [those it touches](Sections::span).
    #[doc(hidden)]
    #[inline]
    pub fn screen(&self, placed: &Placed, k: i32, footprint: &Footprint<'_>) -> [i64; 2] {
        let leaning = self.leaning.as_ref().map(|leaning| {
            let section = (k - self.sections.first(placed.z)) as usize;
            (leaning, self.sections.row(placed.z).0 + section)
        });
        match (placed.screen, leaning) {
            (Some(at), None) => at,
            (Some([x, y]), Some((leaning, which))) => {
                let aside = [0, 1].map(|axis| i64::from(leaning.subpixels(axis)[which]));
                [x + aside[0], y + aside[1]]
            }
            (None, leaning) => {
                let aside = |axis| leaning.map_or(0.0, |(l, which)| l.aside(axis)[which]);
                let [x, y] = [placed.eye.x + aside(0), placed.eye.y + aside(1)];
                self.view.screen(x, y, footprint.scale)
            }
        }
    }

    /// Returns the x position, in 1/256 pixel, of a footprint at `at` ([`Frame::screen`]) in row
    /// `y` of pixels. Differs from row to row where the kernel leans within the picture.
    #[doc(hidden)]
    #[inline]
    pub fn along_row(&self, at: [i64; 2], y: i32) -> i64 {
        let Some(leaning) = self.leaning.as_ref().filter(|leaning| leaning.row() != 0) else {
            return at[0];
        };
        let middle = (i64::from(y) << SUBPIXEL_BITS) + i64::from(SUBPIXELS / 2);
        at[0] + Lean::along_row(leaning.row(), middle - at[1])
    }

    /// Computes [`Frame::payload`] of many voxels of an orthographic view from their samples' bits
    /// and normals; opacity by gradient is not supported. `out` gets the extinctions, then each
    /// colour. There may be more normals than samples, to fill [whole
    /// registers](crate::kernels::whole_registers); their results are unspecified. Loops have lengths
    /// unknown to the compiler, so that it vectorises them.
    ///
    /// # Panics
    /// If there are fewer normals than samples; in a perspective view.
    #[inline(always)]
    pub(crate) fn payloads<const MOST: usize>(
        &self,
        simd: Simd,
        samples: &[u32],
        normals: &[u16],
        out: &mut [[f32; MOST]; 4],
    ) {
        let n = normals.len().min(MOST);
        assert!(samples.len() <= n, "a normal a sample");
        let table = self.scene.classifier.table();
        if !table.is_empty() {
            lut::take(simd, table, samples, out);
        }
        let [sigma, colours @ ..] = out;
        for (i, &sample) in samples.iter().enumerate().take(if table.is_empty() { n } else { 0 }) {
            let look = self.scene.classifier.classify_bits(sample);
            sigma[i] = look.sigma;
            for c in 0..3 {
                colours[c][i] = look.rgb[c];
            }
        }
        if let Some(shader) = &self.shader {
            let to_eye = self.to_eye.expect("rays are parallel");
            let mut lit = [[0.0; MOST]; 2];
            shader.light_terms_all(normals, |_| to_eye, &mut lit);
            for colour in &mut *colours {
                for i in 0..n {
                    colour[i] =
                        LightTerms { lambert: lit[0][i], gloss: lit[1][i] }.apply(colour[i]);
                }
            }
        }
        for sigma in &mut sigma[..n] {
            *sigma = (f64::from(*sigma) * self.view.cell) as f32 * self.raw_scale;
        }
        for colour in colours {
            for i in 0..n {
                colour[i] *= sigma[i];
            }
        }
    }

    /// Returns what voxel `i` of `brick` adds to a plane of a field per unit of weight, in raw
    /// units.
    #[inline(always)]
    pub(crate) fn field_payload(&self, rule: &FieldRule, brick: &Brick, i: usize) -> f32 {
        rule.payload(match &brick.values {
            Samples::U8(v) => v[i].into(),
            Samples::U16(v) => v[i].into(),
            Samples::F32(v) => v[i].to_bits(),
        })
    }

    /// Composites sheet k of a field at some pixels ([`FieldRule::close_row`]).
    #[inline(always)]
    pub(crate) fn close_field_row(
        &self,
        simd: Simd,
        row: &mut Row,
        at: (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32 {
        let (Some(rule), Some(scene)) = (&self.field, &self.scene.field) else {
            unreachable!("a frame whose sheets hold planes")
        };
        rule.close_row(simd, (scene, self.shader.as_ref()), row, at, live)
    }

    /// Returns what voxel `i` of `brick`, at eye coordinates `eye` in vox, adds to a sheet per unit
    /// of weight, in raw units ([`Frame::raw_scale`]): extinction, then the three lit colours times
    /// extinction.
    ///
    /// # Panics
    /// If the brick has no voxel `i`.
    #[inline]
    pub fn payload(&self, brick: &Brick, i: usize, eye: DVec3) -> [f32; 4] {
        let look = self.scene.classifier.classify_voxel(brick, i);
        let rgb = match &self.shader {
            None => look.rgb,
            Some(shader) => {
                let normal = brick.normals.as_ref().map_or(NO_NORMAL, |n| n[i]);
                let to_eye = match self.to_eye {
                    Some(d) => d,
                    None => self.view.direction_to_eye(eye),
                };
                shader.shade(look.rgb, normal, to_eye)
            }
        };
        let sigma = self.raw_extinction(look.sigma);
        [sigma, sigma * rgb[0], sigma * rgb[1], sigma * rgb[2]]
    }

    #[inline(always)]
    fn raw_extinction(&self, sigma: f32) -> f32 {
        (f64::from(sigma) * self.view.cell) as f32 * self.raw_scale
    }

    /// Returns the extinction of [`Frame::payload`], without the colours.
    #[inline]
    pub(crate) fn extinction(&self, brick: &Brick, i: usize) -> f32 {
        self.raw_extinction(self.scene.classifier.classify_voxel(brick, i).sigma)
    }
}
