//! `--error` and `--budget`: chooses the quality of a run before it begins.

use super::run::Run;
use slabcast_client::{Client, VolumeDescription};
use slabcast_common::volume::Volume;
use slabcast_lab::autotune::choose::{choose, trial};
use slabcast_lab::autotune::cluster_bed::{ClusterBed, ClusterRun, Connection};
use slabcast_lab::autotune::local_bed::{Clock, LocalBed};
use slabcast_scene::path::Orientation;
use slabcast_session::direct::Cut;
use slabcast_session::embedded::{Cluster, WorkerGroup};
use slabcast_session::fail::Fail;
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
    let (target, threads) = (run.request.target, (crew.workers * crew.threads) as usize);
    let trial = trial(volume, &info, &run.request, orientation, threads)?;
    if target.budget.is_none() {
        let clock = Clock::Plain(Cut { tile: 64, ..Cut::on(threads) });
        choose(&mut LocalBed::new(trial, clock), &target, quiet)?.settle(&mut run.request);
        return Ok(None);
    }
    let cluster =
        runtime.block_on(async { Cluster::start(volume.clone(), orientation, crew, None) })?;
    let (handle, request) = (cluster.handle(), run.request.clone());
    let connection = Connection::Embedded(&handle);
    let cluster_run =
        ClusterRun { runtime, connection, info, request, description: crew.to_string() };
    match choose(&mut LocalBed::new(trial, Clock::Cluster(Box::new(cluster_run))), &target, quiet) {
        // A record begins with the first worker.
        Ok(chosen) if run.record.is_none() => {
            chosen.settle(&mut run.request);
            Ok(Some(cluster))
        }
        chosen => {
            runtime.block_on(cluster.end());
            chosen?.settle(&mut run.request);
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
    let (target, request) = (run.request.target, run.request.clone());
    let description = format!("the cluster of {master}");
    let cluster_run =
        ClusterRun { runtime, connection: Connection::Remote(client), info, request, description };
    choose(&mut ClusterBed::new(cluster_run), &target, quiet)?.settle(&mut run.request);
    Ok(())
}
