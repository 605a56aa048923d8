//! Scenes of the invariance tests: four scenes from four views, bounds of their roundings, and
//! comparisons and turns of pictures.

use super::case::Row;
use super::cases;
use super::shot::{Shot, Tools};
use glam::DVec3;
use slabcast_common::image::Picture;
use slabcast_common::quality::{Classify, Quality};
use slabcast_common::shade::Light;
use slabcast_common::transfer::SIGMA_MAX;
use slabcast_common::volume::Lattice;
use slabcast_scene::path::PathView;
use slabcast_scene::path::ProjectionKind::{self, Ortho, Persp};
use slabcast_scene::presets;
use slabcast_session::direct::Cut;
use slabcast_session::fail::Fail;
use slabcast_session::volume;
use std::sync::Arc;

/// Largest difference of two ways to sum one field, in 1/255: the transfer function's table begins and
/// ends within one code of what is visible, so it has other cells for other types of samples; 32-bit
/// sums have other units. 0.016 was the largest seen.
pub(super) const FIELD_SUMS: f64 = 0.05;

/// Size of the test scenes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Effort {
    /// Samples along each axis of a volume.
    pub(super) samples: u32,
    pub(super) size: [u32; 2],
    /// Pixels that are compared with the reference.
    pub(super) pixels: usize,
    /// Stride through the 47 turns.
    pub(super) every: usize,
}

/// One scene with its effort and tools.
pub(super) struct InvarianceCase<'a> {
    pub(super) scene: Scene,
    pub(super) effort: Effort,
    pub(super) shot: Shot,
    pub(super) tools: &'a Tools,
}

/// A test scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scene {
    /// Lit and opaque.
    Opaque,
    /// Unlit and translucent, so that nothing is hidden.
    Translucent,
    /// Extinctions far beyond the cap of opacities: the sums are floats.
    Stiff,
    /// Samples that are not cubes, lit from aside.
    Boxes,
}

impl Scene {
    pub(super) fn name(self) -> &'static str {
        match self {
            Scene::Opaque => "opaque",
            Scene::Translucent => "translucent",
            Scene::Stiff => "float sums",
            Scene::Boxes => "boxes",
        }
    }

    /// Returns the scene in the default quality of an order of classification.
    ///
    /// # Errors
    /// The formula or the preset is refused.
    pub(super) fn shot(self, effort: Effort, order: Classify) -> Result<Shot, Fail> {
        let n = effort.samples;
        let (formula, n, tf) = match self {
            Scene::Opaque => ("spheres", n, "peer-opaque"),
            Scene::Translucent => ("marker", n - 1, "peer-semi"),
            Scene::Stiff => ("blob", n / 2, "grey"),
            Scene::Boxes => ("spheres", n / 2, "peer-vessels"),
        };
        let mut volume = volume::open(format!("formula:{formula}:{n}").as_ref())?;
        let mut transfer = presets::by_name(tf, &volume.summary).map_err(|e| Fail::flag(&e))?;
        match self {
            Scene::Opaque => {}
            Scene::Translucent => transfer.shading.on = false,
            Scene::Stiff => transfer = cases::uncapped(),
            Scene::Boxes => {
                volume.lattice = Lattice::from_spacing([n; 3], [0.75, 1.0, 2.25]);
                transfer.shading.light = Light::Direction([0.5, 1.0, 0.25]);
            }
        }
        if self == Scene::Stiff {
            transfer.shading.on = false;
        }
        let view = view(&volume.lattice, [0.0, 2.0, 0.0], Ortho);
        let (volume, quality) = (Arc::new(volume), Quality::of(order));
        Ok(Shot { volume, transfer, quality, size: effort.size, view, crop: None })
    }
}

/// Directions to the eye in extents of the volume. All coordinates are multiples of 1/8: they
/// stay exact when the origin is far away.
pub(super) const VIEWS: [(&str, [f64; 3], ProjectionKind); 4] = [
    ("oblique", [0.75, 1.5, 0.625], Ortho),
    ("along an axis", [0.0, 2.0, 0.0], Ortho),
    ("perspective", [-0.75, 0.625, -0.375], Persp),
    ("perspective along an axis", [0.0, 1.5, 0.0], Persp),
];

fn view(lattice: &Lattice, to_eye: [f64; 3], projection: ProjectionKind) -> PathView {
    let (centre, extent) = (lattice.centre(), lattice.largest_extent());
    PathView {
        eye: (centre + DVec3::from_array(to_eye) * extent).to_array(),
        target: centre.to_array(),
        up: [0.0, 0.0, 1.0],
        projection,
        height: (projection == Ortho).then_some(1.25 * extent),
        fov: (projection == Persp).then_some(40.0),
    }
}

pub(super) const BYTES: &str = "pixels whose bytes differ";
pub(super) const LARGEST: &str = "largest difference";

impl InvarianceCase<'_> {
    pub(super) fn picture(&self, shot: &Shot) -> Result<Picture, Fail> {
        Ok(shot.ready()?.picture(Cut::on(self.tools.threads)))
    }

    /// Returns the shot from each view, with its picture.
    pub(super) fn views(&self) -> Result<Vec<(Shot, Picture)>, Fail> {
        VIEWS
            .iter()
            .map(|(name, to_eye, projection)| {
                let view = view(&self.shot.volume.lattice, *to_eye, *projection);
                let shot = Shot { view, ..self.shot.clone() };
                let picture = self.picture(&shot)?;
                if picture.pixels.iter().all(|p| p[3] == 0.0) {
                    return Err(Fail::failed(format!("{name}: there is nothing to be seen")));
                }
                Ok((shot, picture))
            })
            .collect()
    }

    /// Returns a row with the largest number of pixels in which any of `others` differs, over all
    /// views.
    pub(super) fn same_bytes(
        &self,
        what: &str,
        others: impl Fn(&Shot) -> Vec<Shot>,
    ) -> Result<Row, Fail> {
        let mut most = 0;
        for (shot, want) in self.views()? {
            for other in others(&shot) {
                most = most.max(pixels_that_differ(&want, &self.picture(&other)?));
            }
        }
        Ok(Row::new(format!("{BYTES}: {what}"), most as f64, 0.0))
    }

    /// Whether values are reconstructed first and classified then.
    pub(super) fn is_field(&self) -> bool {
        self.shot.quality.classify == Classify::After
    }

    /// Largest difference, in 1/255, of sums that are added in another order.
    pub(super) fn other_order(&self) -> f64 {
        match self.scene {
            _ if self.is_field() => FIELD_SUMS,
            Scene::Stiff => 255.0 * 2.0 * self.rounding(),
            _ => 0.0,
        }
    }

    /// Returns the number of sheets that the volume takes at most.
    pub(super) fn sheets(&self) -> f64 {
        let l = &self.shot.volume.lattice;
        let n = l.dims.map(f64::from);
        let extent: DVec3 = DVec3::from_array(std::array::from_fn(|a| l.spacing()[a] * n[a]));
        extent.length() / l.vox() / self.shot.quality.thickness + 8.0
    }

    /// Largest error of sums and closing sheets by rounding, as a share of full light; what
    /// two ways to add the same numbers differ by is at most twice that.
    ///
    /// In a sheet a pixel gets at most (2 R + 1)^2 (2 R + 1 + d) contributions, R = 2 and d = 1:
    /// 150. Each is off by half a unit of an integer sum, of which 2^30 are 1.05 times a sheet
    /// full of the largest extinction; a sum of floats has 150 roundings instead. Products have 3
    /// roundings of f32, a closing sheet has some 8, and colour one of 2^-29. Relative errors of an
    /// optical depth count for all sheets together (tau exp(-tau) <= 0.37), absolute ones in
    /// each.
    pub(super) fn rounding(&self) -> f64 {
        let f32s = 2f64.powi(-24);
        let unit = 1.05 * SIGMA_MAX * self.shot.quality.thickness * 2f64.powi(-30);
        let (a_sheet, in_all) =
            if self.scene == Scene::Stiff { (0.0, 150.0) } else { (75.0 * unit, 3.0) };
        self.sheets() * (a_sheet + 8.0 * f32s) + in_all * f32s
    }

    /// Largest error of a picture with other codes for its normals, as a share of full light.
    ///
    /// A code's coordinates are off by up to 1/254 in x and y and twice that in z, of a vector
    /// at least 1/sqrt 3 long: 0.0167 rad, and twice that between two codes of one normal. Light
    /// changes by at most 0.7 a radian (diffuse 0.7; where the highlight is steep, Lambert is
    /// flat), so a voxel's colour by 0.0234. A pixel is a mean of colours of weight A, and the
    /// colour rule adds differences to both neighbours by its gains, of which A / 2 shows.
    pub(super) fn normals(&self) -> f64 {
        let voxel = 0.7 * 2.0 * (6f64.sqrt() / 254.0) * 3f64.sqrt();
        let y = self.shot.quality.thickness / self.shot.quality.std;
        voxel * (1.0 + (0.5 + 0.2 * y) + (0.5 - 0.07 * y).max(0.25))
    }
}

pub(super) fn pixels_that_differ(a: &Picture, b: &Picture) -> usize {
    let differ = |(p, q): &(&[f32; 4], &[f32; 4])| p.map(f32::to_bits) != q.map(f32::to_bits);
    a.pixels.iter().zip(&b.pixels).filter(differ).count()
}

/// Returns the largest difference over all channels, in 1/255; NaN if any channel is.
pub(super) fn largest(a: &Picture, b: &Picture) -> f64 {
    let want: Vec<[f64; 4]> = b.pixels.iter().map(|p| p.map(f64::from)).collect();
    super::shot::largest(&a.pixels, &want)
}

/// Returns the picture with left and right exchanged.
pub(super) fn mirrored(p: &Picture) -> Picture {
    let mut p = p.clone();
    let width = p.size[0] as usize;
    p.pixels.chunks_mut(width).for_each(<[_]>::reverse);
    p
}

/// Returns a square picture turned by a quarter.
pub(super) fn rolled(p: &Picture) -> Picture {
    let n = p.size[0] as usize;
    let at = |i: usize| p.pixels[(i % n) * n + (n - 1 - i / n)];
    Picture { size: p.size, pixels: (0..n * n).map(at).collect() }
}

pub(super) fn cropped(p: &Picture, corner: [u32; 2], size: [u32; 2]) -> Picture {
    let rows = (0..size[1]).map(|y| ((corner[1] + y) * p.size[0] + corner[0]) as usize);
    let pixels = rows.flat_map(|at| p.pixels[at..at + size[0] as usize].iter().copied());
    Picture { size, pixels: pixels.collect() }
}
