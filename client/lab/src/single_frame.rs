//! One view of one volume, for commands that look closely at a single picture: `error` and
//! `explain`.

use crate::autotune::choose::settle;
use slabcast_common::image::{Background, Picture};
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
    /// Sums decided.
    pub(crate) spec: SceneSpec,
    pub(crate) view: View,
    /// What is drawn, and how many times it is magnified.
    small: View,
    magnify: u32,
    pub(crate) bricks: Bricks,
    pub(crate) background: Background,
}

impl SingleFrame {
    /// Reads the volume and cuts its bricks. `check` is asked before anything is read.
    pub(crate) fn read(
        of: &VolumeSceneArgs,
        threads: usize,
        check: impl FnOnce([u32; 2]) -> Result<(), Fail>,
    ) -> Result<SingleFrame, Fail> {
        let mut request = of.scene.request_with_target(Work::default())?;
        check(request.path.size)?;
        let OpenedVolume { volume, info, orientation } = of.open(&request)?;
        let volume = Arc::new(volume);
        settle(&volume, &info, &mut request, orientation, threads)?;
        let stage = PathScenes::new(&volume, &info, &request, orientation)?;
        let (spec, small) = (stage.spec(0), stage.view(0, &request.quality)?);
        let view = stage.view_at_size(0, &request.quality, request.size())?;
        let (background, magnify) = (request.background, request.magnify);
        Ok(SingleFrame { spec, view, small, magnify, bricks: stage.bricks, background })
    }

    /// The frame at another quality (the same sheets and kernel).
    pub(crate) fn frame(&self, quality: Quality) -> Frame {
        let spec = SceneSpec { quality, ..self.spec.clone() };
        Frame::new(Arc::new(Scene::new(&spec)), self.small)
    }

    /// The picture at another quality (the same sheets and kernel).
    pub(crate) fn draw(&self, quality: Quality, threads: usize) -> Picture {
        self.draw_frame(&self.frame(quality), threads)
    }

    /// The picture with no pixel ever shut.
    pub(crate) fn draw_open(&self, threads: usize) -> Picture {
        self.draw_frame(&self.frame(self.spec.quality).never_shut(), threads)
    }

    fn draw_frame(&self, frame: &Frame, threads: usize) -> Picture {
        let picture = direct::draw(frame, &self.bricks, Cut::on(threads));
        magnified(picture, self.magnify, threads)
    }

    /// What judges it.
    pub(crate) fn reference(&self) -> Reference {
        Reference::new(&self.spec, self.view, &self.bricks)
    }
}
