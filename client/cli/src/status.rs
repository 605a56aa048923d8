//! `slabcast status`: a master's volumes, its workers and the jobs that are not over.

use crate::master_client::{MasterArg, ask, job_json, job_table, table};
use crate::volumes::{entry_json, volume_table};
use slabcast_client::{Job, VolumeDescription, VolumeOrigin, Worker};
use slabcast_scene::path::Orientation;
use slabcast_scene::request::VolumeChoice;
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{bytes, time};
use std::fmt::Write;
use std::time::Duration;

/// Shows a master's volumes, its workers and its open jobs.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast status
  slabcast status --master node1:7433 --json")]
pub(crate) struct StatusArgs {
    #[command(flatten)]
    master: MasterArg,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Runs `slabcast status`.
pub(crate) fn run(args: &StatusArgs) -> Result<(), Fail> {
    let (list, given, workers, jobs) = ask(&args.master.address, async |client| {
        let list = client.volumes().await?;
        // The volume of the start is in memory; to describe another, its file might have to be read.
        let given = match list.volumes.iter().any(|v| v.origin == VolumeOrigin::Given) {
            true => Some(client.volume(&VolumeChoice::Default).await?),
            false => None,
        };
        Ok((list, given, client.workers().await?, client.jobs(1000).await?))
    })?;
    if args.json {
        return say(&format!(
            "{:#}\n",
            serde_json::json!({
                "master": args.master.address,
                "volume": given.as_ref().map(volume_json),
                "volumes": list.volumes.iter().map(entry_json).collect::<Vec<_>>(),
                "pixels_version": list.pixels_version,
                "protocol_version": list.protocol_version,
                "workers": workers.iter().map(worker_json).collect::<Vec<_>>(),
                "jobs": jobs.iter().map(job_json).collect::<Vec<_>>(),
            })
        ));
    }
    let mut out = String::new();
    // Writing to a string does not fail.
    let _ = writeln!(out, "master   {}", args.master.address);
    match &given {
        Some(volume) => {
            let [x, y, z] = volume.info.lattice.dims;
            let Orientation { up, front } = volume.orientation;
            let _ = writeln!(
                out,
                "volume   {}, {x} x {y} x {z} {}, up {up}, front {front}",
                volume.name, volume.file_type
            );
        }
        None if list.volumes.is_empty() => {
            let _ = writeln!(
                out,
                "volumes  none: put one there with `slabcast put FILE --master {}`",
                args.master.address
            );
        }
        None => {}
    }
    if list.volumes.len() > usize::from(given.is_some()) {
        let _ = writeln!(out, "volumes  {}", list.volumes.len());
        volume_table(&mut out, &list.volumes);
    }
    if workers.is_empty() {
        let _ = writeln!(
            out,
            "workers  none: start some with `slabcast worker --master {}`",
            args.master.address
        );
    } else {
        let _ = writeln!(out, "workers  {}", workers.len());
        let mut rows = vec![
            ["", "name", "threads", "bricks", "of memory", "tasks done", "now", "here for"]
                .map(String::from),
        ];
        rows.extend(workers.iter().map(|w| {
            [
                w.id.to_string(),
                w.name.clone(),
                w.threads.to_string(),
                bytes(w.held_bytes),
                bytes(w.memory_budget_bytes),
                w.tasks_done.to_string(),
                if w.in_reserve { "in reserve".into() } else { w.tasks_lent.to_string() },
                time(w.connected),
            ]
        }));
        table(&mut out, &rows);
        for w in workers.iter().filter(|w| w.damaged_messages > 0) {
            let (n, name) = (w.damaged_messages, &w.name);
            let _ = writeln!(
                out,
                "damaged  {n} messages to or from {name} were damaged on their way and sent again: \
                 look at its network card, cables and switches"
            );
        }
    }
    let open: Vec<&Job> = jobs.iter().filter(|j| !j.state.is_final()).collect();
    if open.is_empty() {
        let _ = writeln!(out, "jobs     none in progress, {} over", jobs.len());
    } else {
        let _ =
            writeln!(out, "jobs     {} in progress, {} over", open.len(), jobs.len() - open.len());
        job_table(&mut out, &open);
    }
    say(&out)
}

fn volume_json(v: &VolumeDescription) -> serde_json::Value {
    serde_json::json!({
        "name": v.name, "file_type": v.file_type, "anatomical": v.anatomical,
        "dims": v.info.lattice.dims, "spacing": v.info.lattice.spacing(),
        "digest": v.info.digest.to_string(),
        "up": v.orientation.up, "front": v.orientation.front,
        "pixels_version": v.pixels_version, "protocol_version": v.protocol_version,
    })
}

fn worker_json(w: &Worker) -> serde_json::Value {
    let ms = |duration: Duration| duration.as_millis() as u64;
    serde_json::json!({
        "id": w.id.to_string(), "name": w.name, "address": w.address, "threads": w.threads,
        "simd": w.simd, "memory_budget_bytes": w.memory_budget_bytes,
        "held_bytes": w.held_bytes, "held_bricks": w.held_bricks, "tasks_lent": w.tasks_lent,
        "tasks_done": w.tasks_done, "silent_ms": ms(w.silent), "here_ms": ms(w.connected),
        "in_reserve": w.in_reserve, "damaged_messages": w.damaged_messages,
        "round_trip_ms": w.round_trip.map(|trip| trip.as_secs_f64() * 1e3),
        "last_error": w.last_error.as_ref().map(|error| {
            serde_json::json!({"unix_ms": error.at_unix_ms, "reason": error.reason})
        }),
    })
}
