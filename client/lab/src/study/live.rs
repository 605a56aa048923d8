//! Runs the paper's schedule for real: a master and workers of one thread each inside this process,
//! as far as this machine has cores.
//!
//! The master has no core of its own: with as many workers as cores, it takes time from theirs.

use crate::check::cluster::{embedded_frames, joined};
use slabcast_common::image::PixelFormat;
use slabcast_common::quality::Work;
use slabcast_common::stats::FrameStats;
use slabcast_session::embedded::{Cluster, WorkerGroup};
use slabcast_session::fail::Fail;
use slabcast_session::request::{OpenedVolume, RenderRequest};
use slabcast_session::runtime;

/// Renders the path with `workers` workers, once for each of `works`. Returns the statistics of the
/// frames.
pub(super) fn run(
    opened: &OpenedVolume,
    request: &RenderRequest,
    workers: u32,
    works: &[Work],
) -> Result<Vec<Vec<FrameStats>>, Fail> {
    let runtime = runtime::start()?;
    let (volume, info) = (opened.volume.clone(), &opened.info);
    let all = runtime.block_on(async {
        let crew = WorkerGroup::new(workers, Some(1))?;
        let mut cluster = Cluster::start(volume, opened.orientation, crew, None)?;
        joined(&cluster.handle(), workers).await?;
        let mut all = Vec::new();
        for &work in works {
            let mut request = request.clone();
            request.work = work;
            let message = request.to_message(info, PixelFormat::Rgb8, false);
            let frames = embedded_frames(cluster.handle(), message, |f| Ok(f.stats.clone()));
            all.push(tokio::select! {
                frames = frames => frames?,
                trouble = cluster.trouble() => return Err(trouble),
            });
        }
        cluster.end().await;
        Ok(all)
    });
    runtime::end(runtime);
    all
}
