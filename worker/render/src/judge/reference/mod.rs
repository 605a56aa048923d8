//! The judge of error: what a pixel would be with no approximation at all.
//!
//! The picture in the limit (docs/design/model.md) is an integral along a ray,
//!
//! ```text
//! I = int sigma(s) C(s) exp(-int sigma) ds,     alpha = 1 - exp(-int sigma)
//! ```
//!
//! with sigma and sigma C the sums of the voxels' kernels at s. The splatter gets there by
//! sheets, tables, rounded positions and integers. What judges it must not lean on any of these,
//! else both could be wrong together. So this is a *gather*: for one pixel it walks along the true
//! ray, collects the voxels whose kernels the ray meets, and integrates by step halving in f64.
//! It shares with the splatter what the model is (the numbers of a [`View`], looks, light, voxels)
//! and writes everything else down anew: the profile, projection, neighbour search, quadrature.
//!
//! Two pixels can be asked for. [`Reference::pixel`] is the limit. [`Reference::at_same_thickness`]
//! is what sheets of the view's thickness would give in f64 with nothing shut: between it and a
//! rendered pixel lie cut-off, quantisation and rounding, between it and the limit the thickness.
//!
//! The limit is that of the model, with its kernel as it is. What the kernel's cut and its ripple
//! cost, two more references say: [`Reference::without_truncation`], [`Reference::without_ripple`].
//!
//! All that is the limit of [`Classify::Before`]. Where
//! values are reconstructed first, [`FieldReference`] judges.
//!
//! The price: 4096 pixels of mri256 at 512x512 take from half a second (opaque) to about ten
//! (translucent, in perspective) on two cores. So one takes a [`stratified`] sample of a picture
//! and lets [`ErrorFigures`] say how far off it is. Nothing is shared between pixels; callers
//! split them among their threads.
//!
//! On lattices that are not cubic the kernel is an ellipsoid that leans against the eye's axes. All
//! here is then in coordinates that lean along, where it is a product of three profiles again and
//! rays are straight still (`upright`).

mod field;
mod figures;
mod ideal;
#[doc(hidden)]
pub mod profile;
#[doc(hidden)]
pub mod quadrature;
mod sample;
mod sheets;
mod upright;
#[doc(hidden)]
pub mod walk;

pub use field::FieldReference;
pub use figures::ErrorFigures;
pub use sample::{grid_cells, stratified};
pub use sheets::{ReferenceSheet, SectionPlacement, SheetOptions};

use glam::{DMat3, DVec3};
use profile::Profile;
use quadrature::{DEEP, Field, Gauss, HALVINGS, Light};
use slabcast_common::brick::{Brick, BrickGrid, local_position};
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Compositing};
use slabcast_common::shade::Shader;
use slabcast_common::transfer::Classifier;
use slabcast_common::view::View;
use std::sync::Arc;
use walk::Walk;

/// Tolerance of halving: two levels must agree to this on a panel, as a share of the opacity so
/// far. Against a tolerance of 1e-11 pixels are then off by at most 7e-5/255 (mri256 with
/// peer-opaque and peer-semi, 400 to 1024 pixels, both projections); ten times as much makes
/// 3e-4/255 for two thirds of the kernel values, a tenth makes 4e-5/255 for twice as many.
const TOLERANCE: f64 = 1e-7;

/// One view of a scene in f64, as reference for rendered pixels. Any number of threads may ask for
/// pixels.
#[derive(Debug)]
pub struct Reference {
    view: View,
    grid: BrickGrid,
    /// Extinctions, whatever the quality's compositing: the limit knows no other.
    looks: Classifier,
    /// Payloads that the sheets of the quality's compositing add.
    sheet_looks: Classifier,
    compositing: Compositing,
    shader: Option<Shader>,
    kernel: [Profile; 3],
    /// The kernel's deviations in vox along the eye's axes.
    std: DVec3,
    /// Shear of the kernel: slopes of x and y over depth, and of x over y.
    lean: [f64; 3],
    /// Steps of the lattice, sample (0, 0, 0), and back to the index, upright.
    steps: DMat3,
    origin: DVec3,
    index_from_eye: DMat3,
    /// In ascending id, each with its tight box, upright.
    bricks: Vec<(Arc<Brick>, EyeBox)>,
    /// Upright offsets of the 512 voxels of a brick.
    offsets: Vec<DVec3>,
    rule: Gauss,
    tolerance: f64,
    /// Whether kernel sums are divided by the sum over the endless lattice.
    level: bool,
    /// The limit of values that are classified after reconstruction, in place of all above.
    field: Option<FieldReference>,
}

#[derive(Clone, Copy, Debug)]
struct EyeBox {
    lo: DVec3,
    hi: DVec3,
}

impl Reference {
    /// Prepares `view` of the scene that `spec` describes; `bricks` are all bricks of the scene, in
    /// any order.
    pub fn new(spec: &SceneSpec, view: View, bricks: &[Arc<Brick>]) -> Reference {
        let after = spec.quality.classify == Classify::After;
        let field = after.then(|| FieldReference::new(spec, view, bricks));
        let grid = BrickGrid::new(spec.volume.lattice.dims);
        let [std, radius] = spec.quality.kernel_shape();
        let (spread, lean) = upright::of(&view, std);
        let m = upright::steps(&view.eye_from_index, lean);
        let origin = upright::point(view.eye_origin, lean);
        let mut bricks: Vec<_> = bricks
            .iter()
            .map(|brick| {
                let tight = brick.tight_box(&grid);
                let lo = DVec3::from_array(tight.lo.map(f64::from));
                let hi = DVec3::from_array(tight.hi.map(f64::from));
                let (centre, half) = (origin + m * ((lo + hi) * 0.5), (hi - lo) * 0.5);
                let reach =
                    m.x_axis.abs() * half.x + m.y_axis.abs() * half.y + m.z_axis.abs() * half.z;
                // Two ways to compute a position may differ by this much.
                let reach = reach + DVec3::splat(1e-9 * (1.0 + centre.abs().max_element()));
                (brick.clone(), EyeBox { lo: centre - reach, hi: centre + reach })
            })
            .collect();
        bricks.sort_by_key(|(brick, _)| brick.id);
        let kernel = spec.quality.kernel;
        let classifier = |c| Classifier::new(&spec.transfer, &spec.volume, c);
        let shading = &spec.transfer.shading;
        Reference {
            view,
            grid,
            looks: classifier(Compositing::Linear),
            sheet_looks: classifier(spec.quality.compositing),
            compositing: spec.quality.compositing,
            shader: shading.on.then(|| Shader::new(shading, &view.eye_from_world)),
            kernel: spread.map(|spread| Profile::new(kernel, std * spread, radius * spread)),
            std: DVec3::from_array(spread) * std,
            lean,
            steps: m,
            origin,
            index_from_eye: m.inverse(),
            bricks,
            offsets: (0..512)
                .map(|i| m * DVec3::from_array(local_position(i).map(f64::from)))
                .collect(),
            rule: Gauss::four_nodes(),
            tolerance: TOLERANCE,
            level: false,
            field,
        }
    }

    /// Returns this reference with another tolerance of the integration, per panel and relative to
    /// the opacity so far (1e-7 by default): to see whether the integration itself is exact enough.
    #[must_use]
    pub fn with_tolerance(self, tolerance: f64) -> Reference {
        let field = self.field.map(|field| field.with_tolerance(tolerance));
        Reference { tolerance, field, ..self }
    }

    /// Returns this reference with the payloads that the sheets of the quality's compositing add
    /// instead of extinctions. Under the paper's compositing these are alphas, and thin sheets that
    /// add alphas converge to `1 - exp(-int alpha)`, which [`Reference::pixel`] then returns.
    #[must_use]
    pub fn with_sheet_payloads(self) -> Reference {
        Reference { looks: self.sheet_looks.clone(), ..self }
    }

    /// Returns the limit at pixel (x, y), counted from the top left: linear premultiplied RGBA.
    /// With classification after reconstruction, [`FieldReference`] computes it. Sheets and ideals
    /// of this reference are for classification before reconstruction even then.
    pub fn pixel(&self, x: u32, y: u32) -> [f64; 4] {
        if let Some(field) = &self.field {
            return field.pixel(x, y);
        }
        let ray = self.ray(x, y);
        let mut walk = Walk::new(self, &ray, &self.looks, self.kernel[2].radius);
        let mut sum = Light::default();
        let (mut panel, mut places) = (Vec::new(), Vec::new());
        let mut z = f64::NEG_INFINITY;
        while sum.depth < DEEP {
            // On to the next voxel, or panel on panel while there are any.
            let Some(start) = walk.next_depth(z) else { break };
            let end = start + ray.step;
            walk.reach(end);
            panel.clear();
            panel.extend(walk.voxels.iter().filter(|v| v.enter < end && v.leave > start));
            if !panel.is_empty() {
                if self.level {
                    self.places(&ray, start, end, &mut places);
                }
                let lattice = self.level.then_some(&places[..]);
                let field = Field { kernel: &self.kernel, ray: &ray, voxels: &panel, lattice };
                let whole = self.rule.panel(&field, start, ray.step);
                self.halve(&field, start, ray.step, &whole, HALVINGS, &mut sum);
            }
            z = end;
        }
        let [r, g, b] = sum.light;
        [r, g, b, -libm::expm1(-sum.depth)]
    }

    /// Returns the limit ([`Reference::pixel`]) at each of `pixels`.
    pub fn pixels(&self, pixels: &[[u32; 2]]) -> Vec<[f64; 4]> {
        pixels.iter().map(|&[x, y]| self.pixel(x, y)).collect()
    }
}
