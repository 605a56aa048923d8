//! Scenes whose hashes are compared: volumes, transfer functions and two cameras, with the serial
//! renderer's hash of each.

use super::{cluster, looks};
use glam::DVec3;
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{Compositing, Kernel, Quality, Sums, Work};
use slabcast_common::transfer::{OpacityUnit, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::{Digest32, Volume, VolumeInfo};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use slabcast_scene::levels::quality_at_level;
use slabcast_scene::path::{Orientation, PathView, ProjectionKind, ViewPath};
use slabcast_scene::presets;
use slabcast_scene::request::PathRequest;
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::{SceneBricks, at_level as at_level_of};
use slabcast_session::volume;
use std::path::Path;
use std::sync::Arc;

/// Names of the two views of every case.
pub(crate) const VIEWS: [&str; 2] = ["ortho", "persp"];

/// A volume, a transfer function and a quality; drawn from both cameras.
pub(crate) struct Case {
    /// Name as in `tests/golden.txt`, such as `spheres/auto`.
    pub(crate) name: String,
    pub(crate) volume: Arc<Volume>,
    pub(crate) info: VolumeInfo,
    pub(crate) transfer: TransferFunction,
    pub(crate) quality: Quality,
    /// Level of detail that is drawn.
    pub(crate) level: u32,
    pub(crate) size: [u32; 2],
}

/// Changes a default quality for a case.
type Tweak = fn(&mut Quality);

/// A formula volume, the case's name, the transfer function, and the change of quality.
type Formula = (&'static str, &'static str, &'static str, Tweak);

/// Classification after reconstruction, as pictures have it by default.
fn after(quality: &mut Quality) {
    *quality = Quality::default();
}

/// Formula volumes and what each covers: lit and opaque; classified after reconstruction; faint and unlit, where nothing hides
/// anything; 16-bit; float with a ramp of opacity; step edges in thin sheets; one voxel; a line
/// longer than any picture; each compositing rule; sums in floats; nothing shut at all; 16-bit
/// sums; each kernel.
const FORMULAS: [Formula; 15] = [
    ("formula:spheres", "spheres/auto", "auto", |_| {}),
    ("formula:spheres", "spheres/peer-vessels/after", "peer-vessels", after),
    ("formula:fog", "fog/grey", "grey", |_| {}),
    ("formula:blob", "blob/extinction", "extinction", |_| {}),
    ("formula:ramp", "ramp/peer-semi/constant", "peer-semi", |q| {
        q.compositing = Compositing::Constant;
    }),
    ("formula:marker", "marker/peer-opaque/thin", "peer-opaque", |q| q.thickness = 0.25),
    ("formula:two-walls", "two-walls/peer-semi/f32", "peer-semi", |q| {
        q.sums = Sums::F32;
        q.eps = 0.0;
    }),
    ("formula:spheres", "spheres/auto/i16", "auto", |q| q.sums = Sums::I16),
    // Bricks that hold gradients.
    ("formula:spheres", "spheres/glass", "glass", |_| {}),
    ("formula:wall", "wall/peer-vessels/paper", "peer-vessels", |q| {
        q.compositing = Compositing::Paper;
    }),
    ("formula:full", "full/peer-opaque/thick", "peer-opaque", |q| {
        q.thickness = 3.5;
        q.std = 0.5;
    }),
    ("formula:line", "line/bone", "bone", |_| {}),
    ("formula:one", "one/peer-opaque", "peer-opaque", |_| {}),
    ("formula:spheres", "spheres/auto/bspline", "auto", |q| q.kernel = Kernel::Bspline),
    ("formula:spheres", "spheres/auto/tent", "auto", |q| q.kernel = Kernel::Tent),
];

/// A level of detail: the case's name, a formula volume, the transfer function, the level, and the
/// change of quality.
type Leveled = (&'static str, &'static str, &'static str, u32, Tweak);

/// Coarser levels: lit and opaque in both orders of classification, of a volume with odd sides, with
/// the paper's opacities, with opacity by gradient, and of floats.
const LEVELS: [Leveled; 6] = [
    ("spheres/auto/level1", "formula:spheres", "auto", 1, |_| {}),
    ("spheres/auto/after/level2", "formula:spheres", "auto", 2, after),
    ("spheres/auto/after/odd/level1", "formula:spheres:45", "auto", 1, after),
    ("wall/peer-vessels/paper/level1", "formula:wall", "peer-vessels", 1, |q| {
        q.compositing = Compositing::Paper;
    }),
    ("spheres/glass/level1", "formula:spheres", "glass", 1, |_| {}),
    ("ramp/peer-semi/after/level3", "formula:ramp", "peer-semi", 3, after),
];

/// Number of [`LEVELS`] in the matrix.
const LEVELS_IN_MATRIX: usize = 1;

/// Number of [`FORMULAS`] in the matrix: those that take different code paths. The others differ in
/// arithmetic alone, which golden frames cover.
const IN_MATRIX: usize = 9;

/// A lattice that is not cubic: the case's name, the lattice's steps, and the change of quality.
type Leaning = (&'static str, [[f64; 3]; 3], Tweak);

/// Spheres whose kernels lean: with three oblique steps, where rows lean as well, in both orders of
/// classification, and with thick slices.
const LEANING: [Leaning; 3] = [
    ("spheres/auto/oblique", [[1.1, 0.0, 0.1], [0.5, 1.3, 0.0], [-0.4, 0.6, 1.9]], |_| {}),
    ("spheres/after/oblique", [[1.1, 0.0, 0.1], [0.5, 1.3, 0.0], [-0.4, 0.6, 1.9]], after),
    ("spheres/auto/slices", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.8]], |q| {
        q.sums = Sums::I16;
    }),
];

/// Returns the cases of the matrix: the volume of `file` (if any) and formula volumes.
pub(crate) fn matrix_cases(file: Option<&Path>, size: [u32; 2]) -> Result<Vec<Case>, Fail> {
    let mut cases = Vec::new();
    if let Some(file) = file {
        let volume = Arc::new(volume::open(file)?);
        let name = format!("{}/auto", short(&volume.name));
        cases.push(Case::new(name, volume, "auto", |_| {}, size)?);
    }
    for formula in &FORMULAS[..IN_MATRIX] {
        cases.push(formula_case(formula, size)?);
    }
    cases.push(leaning(&LEANING[0], size)?);
    for level in &LEVELS[..LEVELS_IN_MATRIX] {
        cases.push(at_level(level, size)?);
    }
    Ok(cases)
}

/// Returns the cases of golden frames: the sample with four transfer functions, and formula
/// volumes.
pub(crate) fn golden_cases(sample: &Path) -> Result<Vec<Case>, Fail> {
    const SIZE: [u32; 2] = [256, 208];
    let volume = Arc::new(volume::open(sample)?);
    let mut cases = Vec::new();
    let looks: [(&str, &str, Tweak); 6] = [
        ("auto", "auto", |_| {}),
        ("peer-opaque/after", "peer-opaque", after),
        ("peer-semi/after", "peer-semi", after),
        ("grey", "grey", |_| {}),
        ("peer-opaque", "peer-opaque", |_| {}),
        ("peer-opaque/paper", "peer-opaque", |q| q.compositing = Compositing::Paper),
    ];
    for (name, tf, tweak) in looks {
        let name = format!("{}/{name}", short(&volume.name));
        cases.push(Case::new(name, volume.clone(), tf, tweak, SIZE)?);
    }
    for formula in &FORMULAS {
        cases.push(formula_case(formula, SIZE)?);
    }
    for lattice in &LEANING {
        cases.push(leaning(lattice, SIZE)?);
    }
    for level in &LEVELS {
        cases.push(at_level(level, SIZE)?);
    }
    Ok(cases)
}

fn formula_case((file, name, tf, tweak): &Formula, size: [u32; 2]) -> Result<Case, Fail> {
    Case::new((*name).into(), Arc::new(volume::open(file.as_ref())?), tf, tweak, size)
}

fn leaning((name, steps, tweak): &Leaning, size: [u32; 2]) -> Result<Case, Fail> {
    let mut volume = volume::open("formula:spheres".as_ref())?;
    volume.lattice.steps = steps.map(DVec3::from_array);
    Case::new((*name).into(), Arc::new(volume), "auto", tweak, size)
}

fn at_level((name, file, tf, level, tweak): &Leveled, size: [u32; 2]) -> Result<Case, Fail> {
    let volume = Arc::new(volume::open(file.as_ref())?);
    Ok(Case { level: *level, ..Case::new((*name).into(), volume, tf, tweak, size)? })
}

/// A file's name without its endings.
fn short(name: &str) -> &str {
    name.split('.').next().filter(|n| !n.is_empty()).unwrap_or(name)
}

impl Case {
    fn new(
        name: String,
        volume: Arc<Volume>,
        tf: &str,
        tweak: impl Fn(&mut Quality),
        size: [u32; 2],
    ) -> Result<Case, Fail> {
        let info = volume.info(volume.digest());
        let transfer = match tf {
            "extinction" => uncapped(),
            tf => match looks::golden_transfer(&name) {
                Some(fixed) => fixed,
                None => presets::by_name(tf, &info.summary).map_err(|e| Fail::flag(&e))?,
            },
        };
        let mut quality = Quality::before();
        tweak(&mut quality);
        Ok(Case { name, volume, info, transfer, quality, level: 0, size })
    }

    /// Name of view `i`.
    pub(crate) fn view_name(&self, i: usize) -> String {
        format!("{}/{}", self.name, VIEWS[i])
    }

    /// The path of both cameras. The second is near enough for the picture's edge to cut the
    /// volume.
    fn path(&self) -> ViewPath {
        let (centre, extent) = (self.info.lattice.centre(), self.info.lattice.largest_extent());
        let view = |to_eye: DVec3, projection| PathView {
            eye: (centre + to_eye * extent).to_array(),
            target: centre.to_array(),
            up: [0.0, 0.0, 1.0],
            projection,
            height: None,
            fov: (projection == ProjectionKind::Persp).then_some(40.0),
        };
        let views = vec![
            view(DVec3::new(0.75, 1.5, 0.625), ProjectionKind::Ortho),
            view(DVec3::new(-0.75, 0.625, -0.375), ProjectionKind::Persp),
        ];
        ViewPath::from_views(self.size, views)
    }

    /// The request that has a cluster draw both views.
    pub(crate) fn request(&self, cull: bool, work: Work) -> PathRequest {
        let quality = Quality { cull, ..self.quality };
        let request = cluster::request(self.path(), &self.transfer, quality, work);
        PathRequest { level: LevelChoice::At(self.level), ..request }
    }

    /// Renders both views with the serial renderer and returns their hashes.
    pub(crate) fn truth(&self) -> Result<Vec<Digest32>, Fail> {
        let coarse = at_level_of(&self.volume, self.level);
        let volume = coarse.as_ref().unwrap_or(&self.volume);
        let info = volume.info(volume.digest());
        let to_level = self.info.lattice.to_centre_of(&info.lattice);
        let SceneBricks { spec, bricks } = SceneBricks::new(
            volume,
            &info,
            &self.transfer,
            quality_at_level(self.quality, self.level),
        )?;
        let scene = Arc::new(Scene::new(&spec));
        let orientation = Orientation::new(None, None).map_err(|e| Fail::flag(&e))?;
        let path = self.path();
        (0..path.frames())
            .map(|i| {
                let view = path
                    .camera(i, &self.info.lattice, orientation)
                    .and_then(|mut camera| {
                        camera.target -= to_level;
                        View::new(&info.lattice, &camera, self.size, &spec.quality)
                    })
                    .map_err(|e| Fail::failed(format!("{}: {e}", self.view_name(i))))?;
                Ok(serial::render(&Frame::new(scene.clone(), view), &bricks).sha256())
            })
            .collect()
    }
}

/// Extinctions far beyond the cap of opacities, so that sums are floats.
pub(super) fn uncapped() -> TransferFunction {
    let grey = looks::grey(vec![[0.0, 0.0], [0.2, 0.0], [0.6, 0.8], [0.9, 5.0], [1.0, 400.0]]);
    TransferFunction {
        opacity_unit: OpacityUnit::Extinction,
        shading: slabcast_common::shade::Shading::default(),
        ..grey
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_matrix_case_renders_two_different_views() {
        for case in matrix_cases(None, [24, 20]).unwrap() {
            let truth = case.truth().unwrap();
            assert_eq!(truth.len(), VIEWS.len());
            assert_ne!(truth[0], truth[1], "{}", case.name);
        }
    }
}
