//! The frames of a path, to be drawn by this process alone: what `bench`, `error`, `explain` and
//! `render --show` share. Each frame is what a cluster would draw, also where transfer functions
//! change on the way.

use crate::direct::Bricks;
use crate::fail::Fail;
use crate::request::RenderRequest;
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::level::LevelChoice;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::Quality;
use slabcast_common::transfer::{Classifier, TransferFunction};
use slabcast_common::view::View;
use slabcast_common::volume::{Lattice, Volume, VolumeInfo};
use slabcast_render::{Frame, Scene};
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_scene::levels::quality_at_level;
use slabcast_scene::path::{Framing, Orientation};
use slabcast_scene::tween::Tween;
use slabcast_volumes::auto_level::AutoLevel;
use slabcast_volumes::blocks::coarser;
use slabcast_volumes::{BrickStore, framing};
use std::sync::Arc;

/// A scene's specification and all its bricks.
#[derive(Clone)]
pub struct SceneBricks {
    /// Specification of the scene, with the number type of its sums decided.
    pub spec: SceneSpec,
    /// All bricks of the scene, with their directory.
    pub bricks: Bricks,
}

impl SceneBricks {
    /// Cuts the bricks that `transfer` needs and decides the number type of sums, as a master
    /// does.
    ///
    /// # Errors
    /// The sums asked for can't hold the scene.
    pub fn new(
        volume: &Volume,
        info: &VolumeInfo,
        transfer: &TransferFunction,
        quality: Quality,
    ) -> Result<SceneBricks, Fail> {
        let wanted = BrickNeeds::for_transfer(transfer, info, &quality);
        SceneBricks::with_requirements(volume, info, transfer, quality, &wanted)
    }

    /// Cuts the bricks with the content that `wanted` names and decides the number type of
    /// sums.
    ///
    /// # Errors
    /// The sums asked for can't hold the scene.
    pub fn with_requirements(
        volume: &Volume,
        info: &VolumeInfo,
        transfer: &TransferFunction,
        quality: Quality,
        wanted: &BrickNeeds,
    ) -> Result<SceneBricks, Fail> {
        let classifier = Classifier::new(transfer, info, quality.compositing);
        let sums = classifier.choose_sums(&quality, &info.lattice).map_err(|e| Fail::flag(&e))?;
        let store = BrickStore::build(volume, info.digest, wanted);
        let bricks = Bricks::from_store(&store);
        let spec = SceneSpec {
            id: SceneId(0),
            volume: info.clone(),
            transfer: transfer.clone(),
            quality: Quality { sums, ..quality },
            crop: wanted.crop,
            bricks: store.key(),
        };
        Ok(SceneBricks { spec, bricks })
    }
}

/// Bricks, scenes and views of a path, ready to be drawn.
pub struct PathScenes {
    request: RenderRequest,
    orientation: Orientation,
    /// Scene of all frames. With a tween, each frame replaces its transfer function.
    base: SceneSpec,
    tween: Option<Tween>,
    /// Scene of all frames if there is no tween; it caches footprints.
    shared: Arc<Scene>,
    /// Lattice of the volume that was asked for, to which paths are relative.
    asked: Lattice,
    /// World vector from its centre to that of the level that is drawn.
    to_level: DVec3,
    /// Times that the volume was halved.
    halvings: u32,
    /// Bricks that serve all frames of the path.
    pub bricks: Bricks,
    /// Target and height that the path was given, if it asked for them.
    pub framing: Option<Framing>,
}

impl PathScenes {
    /// Cuts the bricks of a volume that fits the request.
    ///
    /// # Errors
    /// The request doesn't fit the volume; the error names the flag or file.
    pub fn new(
        volume: &Volume,
        info: &VolumeInfo,
        request: &RenderRequest,
        orientation: Orientation,
    ) -> Result<PathScenes, Fail> {
        let blame = |e| request.blame(&e);
        let transfer = request.transfer.function(info).map_err(blame)?;
        let tween = Tween::from_path(&request.path, &info.summary).map_err(blame)?;
        let framing =
            framing::framing(&request.path, volume, info, &transfer, orientation).map_err(blame)?;
        let mut request = request.clone();
        if let Some(framing) = &framing {
            request.path = request.path.framed(framing);
        }
        let level = match request.level {
            LevelChoice::At(level) => level,
            LevelChoice::Auto => auto_level(info, &request, orientation)?,
        };
        let coarse = at_level(volume, level);
        let coarse_info = coarse.as_ref().map(|coarse| coarse.info(coarse.digest()));
        let drawn = coarse_info.as_ref().unwrap_or(info);
        let to_level = info.lattice.to_centre_of(&drawn.lattice);
        request.quality = quality_at_level(request.quality, drawn.level - info.level);
        let wanted =
            BrickNeeds::for_path(&request.path, &transfer, tween.as_ref(), info, &request.quality)
                .map_err(|e| request.blame(&e))?
                .with_kept(request.work.keep)
                .at_centre(to_level);
        let SceneBricks { spec: base, bricks } = SceneBricks::with_requirements(
            coarse.as_ref().unwrap_or(volume),
            drawn,
            &transfer,
            request.quality,
            &wanted,
        )?;
        let shared = Arc::new(Scene::new(&base));
        let halvings = drawn.level - info.level;
        let asked = info.lattice;
        Ok(PathScenes {
            request,
            orientation,
            base,
            tween,
            shared,
            asked,
            to_level,
            halvings,
            bricks,
            framing,
        })
    }

    /// Returns the scene of the `i`-th wanted frame, with the number type of its sums decided.
    pub fn spec(&self, i: usize) -> SceneSpec {
        let Some(tween) = &self.tween else { return self.base.clone() };
        let at = (self.request.path.first_frame() + i) as f64;
        tween.scene_at(&self.base, self.request.quality.sums, at)
    }

    /// Returns the scene of the `i`-th wanted frame with its tables.
    pub fn scene(&self, i: usize) -> Arc<Scene> {
        match self.tween {
            None => self.shared.clone(),
            Some(_) => Arc::new(Scene::new(&self.spec(i))),
        }
    }

    /// Returns the view of the `i`-th wanted frame at a quality.
    ///
    /// # Errors
    /// The quality doesn't fit the view.
    pub fn view(&self, i: usize, quality: &Quality) -> Result<View, Fail> {
        self.view_at_size(i, quality, self.request.path.size)
    }

    /// Returns the view of the `i`-th wanted frame in a picture of `size` pixels.
    ///
    /// # Errors
    /// The quality or the size doesn't fit the view.
    pub fn view_at_size(&self, i: usize, quality: &Quality, size: [u32; 2]) -> Result<View, Fail> {
        let lattice = &self.base.volume.lattice;
        let camera = self.request.path.camera(i, &self.asked, self.orientation);
        let view = camera.and_then(|mut camera| {
            camera.target -= self.to_level;
            View::new(lattice, &camera, size, quality)
        });
        view.map_err(|e| self.request.blame(&e))
    }

    /// Returns the quality in which the level is drawn where `asked` is wanted.
    pub fn quality_of_level(&self, asked: Quality) -> Quality {
        quality_at_level(asked, self.halvings)
    }

    /// Returns the level of detail that is drawn.
    pub fn level(&self) -> u32 {
        self.base.volume.level
    }

    /// Returns whether each frame has a transfer function of its own, between those of the keys.
    pub fn is_tween(&self) -> bool {
        self.tween.is_some()
    }

    /// Returns the `i`-th wanted frame, ready for the renderer.
    ///
    /// # Errors
    /// The quality doesn't fit the view.
    pub fn frame(&self, i: usize) -> Result<Frame, Fail> {
        Ok(Frame::new(self.scene(i), self.view(i, &self.base.quality)?))
    }

    /// Returns the `i`-th wanted frame at a changed quality.
    ///
    /// # Errors
    /// The quality doesn't fit the view.
    pub fn frame_with(
        &self,
        i: usize,
        change: impl FnOnce(Quality) -> Quality,
    ) -> Result<Frame, Fail> {
        let spec = self.spec(i);
        let quality = change(spec.quality);
        let scene = Arc::new(Scene::new(&SceneSpec { quality, ..spec }));
        Ok(Frame::new(scene, self.view(i, &quality)?))
    }
}

/// Returns the level that `--level auto` stands for in a request that fits the volume.
///
/// # Errors
/// The request doesn't fit the volume; the error names the flag or file.
pub fn coarsest_level(
    volume: &Volume,
    info: &VolumeInfo,
    request: &RenderRequest,
    orientation: Orientation,
) -> Result<u32, Fail> {
    let blame = |e| request.blame(&e);
    let transfer = request.transfer.function(info).map_err(blame)?;
    let framing =
        framing::framing(&request.path, volume, info, &transfer, orientation).map_err(blame)?;
    let mut request = request.clone();
    if let Some(framing) = &framing {
        request.path = request.path.framed(framing);
    }
    auto_level(info, &request, orientation)
}

/// Returns the level that `auto` stands for, as a master finds it. The path of `request` is framed.
fn auto_level(
    info: &VolumeInfo,
    request: &RenderRequest,
    orientation: Orientation,
) -> Result<u32, Fail> {
    let cameras =
        request.path.prepare(&info.lattice, orientation).map_err(|e| request.blame(&e))?;
    let mut finest = AutoLevel::new(info);
    for i in 0..request.path.frames() {
        let view = cameras.camera(i).and_then(|camera| {
            View::new(&info.lattice, &camera, request.path.size, &request.quality)
        });
        finest.see(&view.map_err(|e| request.blame(&e))?);
    }
    Ok(finest.level())
}

/// Returns a level of a volume, or its coarsest; `None` if that is the volume itself.
pub fn at_level(volume: &Volume, level: u32) -> Option<Volume> {
    let own = volume.coarse.map_or(0, |coarse| coarse.level);
    let mut coarse: Option<Volume> = None;
    for _ in own..level {
        let Some(next) = coarser(coarse.as_ref().unwrap_or(volume)) else { break };
        coarse = Some(next);
    }
    coarse
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::direct::{self, Cut};
    use slabcast_scene::path::ViewPath;

    #[test]
    fn each_frame_of_a_tween_is_drawn_with_its_own_function() {
        let volume = crate::volume::open("formula:spheres:32".as_ref()).unwrap();
        let info = volume.info(volume.digest());
        let o = Orientation::new(None, None).unwrap();
        let picture = |path: &str, tf: &str, i: usize| {
            let mut request =
                RenderRequest::for_preset(ViewPath::from_json(path).unwrap(), tf).unwrap();
            // The voxels of all functions are kept, which changes the last bits of a field.
            request.quality = Quality::before();
            let stage = PathScenes::new(&volume, &info, &request, o).unwrap();
            direct::draw(&stage.frame(i).unwrap(), &stage.bricks, Cut::on(2)).sha256()
        };
        let path = |range: &str| {
            format!(
                r#"{{"version":1,"size":[48,48]{range},"keyframes":{{"frames":3,"keys":[
                {{"azimuth":0,"tf":"fog"}},{{"azimuth":40,"tf":"bone"}}]}}}}"#
            )
        };
        let plain = r#"{"version":1,"size":[48,48],"keyframes":{"frames":3,"keys":[
            {"azimuth":0},{"azimuth":40}]}}"#;
        let of_tween: Vec<_> = (0..3).map(|i| picture(&path(""), "skin", i)).collect();
        assert_eq!(of_tween[0], picture(plain, "fog", 0));
        assert_eq!(of_tween[2], picture(plain, "bone", 2));
        assert!(!of_tween[..1].contains(&of_tween[1]) && of_tween[1] != of_tween[2]);
        // Frames of a range keep their place in the tween.
        assert_eq!(of_tween[2], picture(&path(r#","range":[2,2]"#), "skin", 0));
    }
}
