//! One view of one volume, for the commands about a single picture: `error` and `explain`.

use crate::autotune::choose::settle;
use slabcast_common::image::{Background, Picture};
use slabcast_common::level::LevelChoice;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Quality, Work};
use slabcast_common::view::View;
use slabcast_render::judge::reference::Reference;
use slabcast_render::{Frame, Scene};
use slabcast_session::direct::{self, Bricks, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::magnify::magnified;
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::request::{OpenedVolume, VolumeSceneArgs};
use std::sync::Arc;

/// The first view of a path, ready to be drawn and judged.
pub(crate) struct SingleFrame {
    /// Scene, with the arithmetic of its sums decided.
    pub(crate) spec: SceneSpec,
    /// View of the picture at full size.
    pub(crate) view: View,
    /// View that is drawn, and the factor it is magnified by.
    drawn_view: View,
    magnify: u32,
    pub(crate) bricks: Bricks,
    pub(crate) background: Background,
}

impl SingleFrame {
    /// Reads the volume and cuts its bricks. `check` may refuse the size of the picture, in pixels,
    /// before anything is read.
    pub(crate) fn read(
        args: &VolumeSceneArgs,
        threads: usize,
        check: impl FnOnce([u32; 2]) -> Result<(), Fail>,
    ) -> Result<SingleFrame, Fail> {
        let mut request = args.request_with_target(Work::default())?;
        check(request.path.size)?;
        let OpenedVolume { volume, info, orientation } = args.open(&mut request)?;
        let volume = Arc::new(volume);
        settle(&volume, &info, &mut request, orientation, threads)?;
        let scenes = PathScenes::new(&volume, &info, &request, orientation)?;
        let (spec, drawn_view) = (scenes.spec(0), scenes.view(0, &request.quality)?);
        let view = scenes.view_at_size(0, &request.quality, request.size())?;
        let (background, magnify) = (request.background, request.magnify);
        Ok(SingleFrame { spec, view, drawn_view, magnify, bricks: scenes.bricks, background })
    }

    /// Returns the same view in all detail; `None` if that is what is drawn.
    pub(crate) fn in_all_detail(
        &self,
        args: &VolumeSceneArgs,
    ) -> Result<Option<SingleFrame>, Fail> {
        let mut request = args.request_with_target(Work::default())?;
        let OpenedVolume { volume, info, orientation } = args.open(&mut request)?;
        if self.spec.volume.level == info.level {
            return Ok(None);
        }
        request.level = LevelChoice::default();
        let scenes = PathScenes::new(&volume, &info, &request, orientation)?;
        let spec = scenes.spec(0);
        let view = scenes.view_at_size(0, &spec.quality, self.view.size)?;
        let background = self.background;
        let bricks = scenes.bricks;
        Ok(Some(SingleFrame { spec, view, drawn_view: view, magnify: 1, bricks, background }))
    }

    /// Returns the frame at another quality with the same sheets and kernel.
    pub(crate) fn frame(&self, quality: Quality) -> Frame {
        let spec = SceneSpec { quality, ..self.spec.clone() };
        Frame::new(Arc::new(Scene::new(&spec)), self.drawn_view)
    }

    /// Draws the picture at another quality with the same sheets and kernel.
    pub(crate) fn draw(&self, quality: Quality, threads: usize) -> Picture {
        self.draw_frame(&self.frame(quality), threads)
    }

    /// Draws the picture in another quality, with sheets as thick as that says.
    pub(crate) fn draw_thick(&self, quality: Quality, threads: usize) -> Picture {
        let spec = SceneSpec { quality, ..self.spec.clone() };
        let view = self.drawn_view.with_thickness_of(&quality);
        self.draw_frame(&Frame::new(Arc::new(Scene::new(&spec)), view), threads)
    }

    /// Draws the picture with no pixel ever shut.
    pub(crate) fn draw_open(&self, threads: usize) -> Picture {
        self.draw_frame(&self.frame(self.spec.quality).never_shut(), threads)
    }

    fn draw_frame(&self, frame: &Frame, threads: usize) -> Picture {
        let picture = direct::draw(frame, &self.bricks, Cut::on(threads));
        magnified(picture, self.magnify, threads)
    }

    /// Returns the reference for the picture at full size.
    pub(crate) fn reference(&self) -> Reference {
        Reference::new(&self.spec, self.view, &self.bricks)
    }
}
