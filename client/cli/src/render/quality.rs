//! `--error` and `--budget`: chooses the quality of a run before it begins.

use super::run::Run;
use slabcast_client::{Client, VolumeDescription};
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_lab::autotune::choose::{at_level_that_keeps_target, choose, trial};
use slabcast_lab::autotune::cluster_bed::{ClusterBed, ClusterRun, Connection};
use slabcast_lab::autotune::local_bed::{Clock, LocalBed};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::Cut;
use slabcast_session::embedded::{Cluster, WorkerGroup};
use slabcast_session::fail::Fail;
use slabcast_session::path_scenes::coarsest_level;
use slabcast_session::request::RenderRequest;
use std::sync::Arc;
use tokio::runtime::Runtime;

/// Chooses the quality for a target: errors by the reference, times by a cluster of this process.
/// The cluster then renders, since it has the bricks.
pub(super) fn choose_here(
    run: &mut Run,
    volume: &Arc<Volume>,
    orientation: Orientation,
    crew: WorkerGroup,
    runtime: &Runtime,
    quiet: bool,
) -> Result<Option<Cluster>, Fail> {
    let info = volume.info(volume.digest());
    run.request.fit(&info, orientation, volume.anatomical)?;
    let coarsest = coarsest_level(volume, &info, &run.request, orientation)?;
    let records = run.record.is_some();
    at_level_that_keeps_target(&mut run.request, Some(coarsest), |request| {
        choose_here_at(request, volume, &info, orientation, crew, (runtime, quiet, records))
    })
}

/// Chooses at the level that the request asks for.
fn choose_here_at(
    to_draw: &mut RenderRequest,
    volume: &Arc<Volume>,
    info: &VolumeInfo,
    orientation: Orientation,
    crew: WorkerGroup,
    (runtime, quiet, records): (&Runtime, bool, bool),
) -> Result<Option<Cluster>, Fail> {
    let (target, threads) = (to_draw.target, (crew.workers * crew.threads) as usize);
    let trial = trial(volume, info, to_draw, orientation, threads)?;
    if target.budget.is_none() {
        let clock = Clock::Plain(Cut { tile: 64, ..Cut::on(threads) });
        choose(&mut LocalBed::new(trial, clock), &target, quiet)?.settle(to_draw);
        return Ok(None);
    }
    let cluster =
        runtime.block_on(async { Cluster::start(volume.clone(), orientation, crew, None) })?;
    let (handle, request, info) = (cluster.handle(), to_draw.clone(), info.clone());
    let connection = Connection::Embedded(&handle);
    let cluster_run =
        ClusterRun { runtime, connection, info, request, description: crew.to_string() };
    match choose(&mut LocalBed::new(trial, Clock::Cluster(Box::new(cluster_run))), &target, quiet) {
        // A record begins with the first worker.
        Ok(chosen) if !records => {
            chosen.settle(to_draw);
            Ok(Some(cluster))
        }
        chosen => {
            runtime.block_on(cluster.end());
            chosen?.settle(to_draw);
            Ok(None)
        }
    }
}

/// Chooses the quality by the cluster's own pictures, where only the master has the volume.
pub(super) fn choose_there(
    run: &mut Run,
    client: &Client,
    served: &VolumeDescription,
    master: &str,
    runtime: &Runtime,
    quiet: bool,
) -> Result<(), Fail> {
    let info = served.info.clone();
    run.request.fit(&info, served.orientation, served.anatomical)?;
    let target = run.request.target;
    at_level_that_keeps_target(&mut run.request, None, |to_draw| {
        let (info, request) = (info.clone(), to_draw.clone());
        let description = format!("the cluster of {master}");
        let connection = Connection::Remote(client);
        let cluster_run = ClusterRun { runtime, connection, info, request, description };
        choose(&mut ClusterBed::new(cluster_run), &target, quiet)?.settle(to_draw);
        Ok(())
    })
}
