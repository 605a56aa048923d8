//! A scene and a frame of it, made ready for drawing: tables that tiles share.

use crate::footprint::{Footprints, Profile, Sections};
use crate::sheet::Rule;
use glam::{DVec3, Vec3};
use slabcast_common::bounds::{raw_per_payload, short_per_payload};
use slabcast_common::brick::{Brick, BrickGrid, TightBox, local};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Compositing, Quality, Sums};
use slabcast_common::shade::{NO_NORMAL, Shader};
use slabcast_common::slab::SheetRange;
use slabcast_common::transfer::Classifier;
use slabcast_common::view::{Projection, View};
use std::sync::Arc;

/// A volume's looks under one transfer function and quality.
#[derive(Debug)]
pub struct Scene {
    /// Looks by code.
    pub classifier: Classifier,
    /// Light; `None` where voxels are unshaded.
    pub shader: Option<Shader>,
    /// Quality; sums decided.
    pub quality: Quality,
    /// How the volume is cut into bricks.
    pub grid: BrickGrid,
    /// Samples along the index axes.
    pub dims: [u32; 3],
    /// Largest extinction per vox (or alpha, for the paper's compositing).
    pub payload_max: f64,
}

impl Scene {
    /// Makes `spec` ready.
    pub fn new(spec: &SceneSpec) -> Self {
        let classifier = Classifier::new(&spec.transfer, &spec.volume, spec.quality.compositing);
        let payload_max = classifier.payload_max();
        Scene {
            classifier,
            shader: spec.transfer.shading.on.then(|| Shader::new(&spec.transfer.shading)),
            quality: spec.quality,
            grid: BrickGrid::of(spec.volume.lattice.dims),
            dims: spec.volume.lattice.dims,
            payload_max,
        }
    }

    /// Whether sheets add floats.
    pub fn float_sums(&self) -> bool {
        self.quality.sums == Sums::F32
    }
}

/// One view of a scene.
#[derive(Debug)]
pub struct Frame {
    /// The scene.
    pub scene: Arc<Scene>,
    /// The view.
    pub view: View,
    /// Sections in depth.
    pub sections: Sections,
    /// Footprints on the screen.
    pub footprints: Footprints,
    /// Arithmetic of a closing sheet.
    pub rule: Rule,
    /// What payloads are multiplied by: raw units of a sum for one unit of payload; for 16-bit
    /// sums that times the factors of their weights.
    pub raw_scale: f32,
    /// Eye offsets of the 512 voxels of a brick.
    offsets: Vec<DVec3>,
    /// Unit direction to the eye in world axes, where it is the same for all voxels.
    to_eye: Option<Vec3>,
}

impl Frame {
    /// Makes `view` of `scene` ready.
    pub fn new(scene: Arc<Scene>, view: View) -> Self {
        let q = &scene.quality;
        let whole = TightBox { lo: [0; 3], hi: scene.dims.map(|n| n - 1) };
        let range = view.project(&whole).map_or(SheetRange::new(0, 0), |p| p.sheets);
        // One sheet farther for the peek.
        let range = SheetRange::new(range.first, range.end + 1);
        let spread = view.kernel_std / q.std;
        let profile = Profile::new(view.kernel_std.z, view.kernel_radius.z).with_spread(spread.z);
        let d = view.thickness;
        let (raw_scale, unit) = match q.sums {
            Sums::F32 => (1.0, 1.0),
            // Weights are those per step of the lattice and over the thickness, so the payload has
            // these factors. It is at most 31,207, since a cell is no larger than the product of
            // the spreads.
            Sums::I16 => {
                let units = short_per_payload(scene.payload_max, d);
                ((units * d / (spread.x * spread.y * spread.z)) as f32, (1.0 / units) as f32)
            }
            Sums::I32 | Sums::Auto => {
                let scale = raw_per_payload(scene.payload_max, d);
                (scale, (1.0 / f64::from(scale)) as f32)
            }
        };
        let to_eye = match view.projection {
            Projection::Ortho { .. } => Some(view.to_eye(DVec3::ZERO)),
            Projection::Persp { .. } => None,
        };
        let rule = Rule::new(q.compositing, unit, d / view.kernel_std.z, q.eps as f32);
        Frame {
            sections: Sections::new(&profile, d, view.depth_phases()),
            footprints: Footprints::new(&view, range, spread),
            rule,
            raw_scale,
            offsets: (0..512).map(|i| view.offset_in_eye(local(i))).collect(),
            to_eye,
            view,
            scene,
        }
    }

    /// Whether the colour rule looks at neighbouring sheets.
    pub fn looks_at_neighbours(&self) -> bool {
        self.scene.quality.compositing == Compositing::Linear
    }

    /// Eye position of a voxel: its brick's corner and its local index.
    #[inline]
    pub fn eye(&self, corner: DVec3, local: u16) -> DVec3 {
        corner + self.offsets[local as usize]
    }

    /// What voxel `i` of `brick` at eye position `eye` adds to a sheet per unit of weight, in
    /// raw units: extinction and the three sigma-weighted shaded colours.
    #[inline]
    pub fn payload(&self, brick: &Brick, i: usize, eye: DVec3) -> [f32; 4] {
        let look = self.scene.classifier.look_of(brick, i);
        let rgb = match &self.scene.shader {
            None => look.rgb,
            Some(shader) => {
                let normal = brick.normals.as_ref().map_or(NO_NORMAL, |n| n[i]);
                let to_eye = match self.to_eye {
                    Some(d) => d,
                    None => self.view.to_eye(eye),
                };
                shader.shade(look.rgb, normal, to_eye)
            }
        };
        let sigma = (f64::from(look.sigma) * self.view.cell) as f32 * self.raw_scale;
        [sigma, sigma * rgb[0], sigma * rgb[1], sigma * rgb[2]]
    }
}
