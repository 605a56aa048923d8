//! `slabcast status`, `jobs` and `cancel`: questions to a running master.

use slabcast_client::{Client, ClientError, Job, JobState, VolumeDescription, Worker};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{bytes, time};
use slabcast_session::remote::{connect, fail};
use std::fmt::Write;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// Which master is asked.
#[derive(clap::Args, Clone, Debug)]
struct MasterArg {
    /// The master
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7433",
          env = "SLABCAST_MASTER", hide_env_values = true, value_parser = slabcast_session::parse::master)]
    master: String,
}

/// Shows what a master serves, its workers, and the jobs that are not over.
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

/// Lists the jobs that a master remembers, newest first.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast jobs
  slabcast jobs --master node1:7433 --limit 100 --json")]
pub(crate) struct JobsArgs {
    #[command(flatten)]
    master: MasterArg,
    /// At most so many
    #[arg(long, value_name = "N", default_value = "20",
          value_parser = clap::value_parser!(u32).range(1..=1000))]
    limit: u32,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Cancels a job.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast cancel job-7
  slabcast cancel job-7 --master node1:7433")]
pub(crate) struct CancelArgs {
    /// The job, as `slabcast jobs` names it (job-7)
    job: String,
    #[command(flatten)]
    master: MasterArg,
}

fn ask<T>(
    master: &str,
    question: impl AsyncFnOnce(Client) -> Result<T, ClientError>,
) -> Result<T, Fail> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|e| Fail::failed(format!("starting threads failed: {e}")))?;
    let answer = runtime.block_on(async {
        let client = connect(master).await?;
        question(client).await.map_err(|e| match &e {
            ClientError::NotFound { .. } => Fail::failed(format!(
                "{master} knows no such job; `slabcast jobs --master {master}` lists those that it \
                 knows"
            )),
            _ => fail(&e),
        })
    });
    runtime.shutdown_timeout(Duration::from_millis(200));
    answer
}

/// Runs `slabcast status`.
pub(crate) fn status(args: &StatusArgs) -> Result<(), Fail> {
    let (volume, workers, jobs) = ask(&args.master.master, async |client| {
        Ok((client.volume().await?, client.workers().await?, client.jobs(1000).await?))
    })?;
    if args.json {
        return say(&format!(
            "{:#}\n",
            serde_json::json!({
                "master": args.master.master,
                "volume": volume_json(&volume),
                "workers": workers.iter().map(worker_json).collect::<Vec<_>>(),
                "jobs": jobs.iter().map(job_json).collect::<Vec<_>>(),
            })
        ));
    }
    let mut out = String::new();
    let [x, y, z] = volume.info.lattice.dims;
    // Writing to a string does not fail.
    let _ = writeln!(
        out,
        "master   {}\nvolume   {}, {x} x {y} x {z} {}, up {}, front {}",
        args.master.master,
        volume.name,
        volume.file_type,
        volume.orientation.up,
        volume.orientation.front
    );
    if workers.is_empty() {
        let _ = writeln!(
            out,
            "workers  none: start some with `slabcast worker --master {}`",
            args.master.master
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

/// Runs `slabcast jobs`.
pub(crate) fn jobs(args: &JobsArgs) -> Result<(), Fail> {
    let jobs = ask(&args.master.master, async |client| client.jobs(args.limit as usize).await)?;
    if args.json {
        let jobs: Vec<_> = jobs.iter().map(job_json).collect();
        return say(&format!("{:#}\n", serde_json::Value::Array(jobs)));
    }
    if jobs.is_empty() {
        return say("no jobs yet\n");
    }
    let mut out = String::new();
    job_table(&mut out, &jobs.iter().collect::<Vec<_>>());
    say(&out)
}

/// Runs `slabcast cancel`.
pub(crate) fn cancel(args: &CancelArgs) -> Result<(), Fail> {
    let (before, after) = ask(&args.master.master, async |client| {
        let before = client.job(&args.job).await?;
        Ok((before, client.cancel(&args.job).await?))
    })?;
    let frames = format!("{} of {} frames done", after.frames_done, after.frames_total);
    if before.state.is_final() {
        return Err(Fail::failed(format!(
            "{} is over already ({}, {frames}); there is nothing to cancel",
            args.job, after.state
        )));
    }
    say(&format!("{} {}, {frames}\n", args.job, after.state))
}

fn job_table(out: &mut String, jobs: &[&Job]) {
    let mut rows = vec![["job", "state", "frames", "size", "age", ""].map(String::from)];
    let now = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |d| d.as_millis() as i64);
    rows.extend(jobs.iter().map(|j| {
        let age = Duration::from_millis((now - j.submitted_unix_ms).max(0) as u64);
        let message = match j.state {
            JobState::WaitingForWorkers | JobState::Failed => j.message.clone(),
            _ => String::new(),
        };
        [
            j.job_id.clone(),
            j.state.to_string(),
            format!("{}/{}", j.frames_done, j.frames_total),
            format!("{}x{}", j.size[0], j.size[1]),
            // A master that does not say when has 1970.
            if j.submitted_unix_ms > 0 { time(age) } else { "-".into() },
            message,
        ]
    }));
    table(out, &rows);
}

/// Rows with columns as wide as their widest cell.
fn table<const N: usize>(out: &mut String, rows: &[[String; N]]) {
    let width = |c: usize| rows.iter().map(|r| r[c].chars().count()).max().unwrap_or(0);
    let widths: [usize; N] = std::array::from_fn(width);
    for row in rows {
        let cells = row.iter().zip(widths).map(|(cell, w)| format!("{cell:<w$}"));
        let line = cells.collect::<Vec<_>>().join("  ");
        out.push_str("  ");
        out.push_str(line.trim_end());
        out.push('\n');
    }
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
        "in_reserve": w.in_reserve,
    })
}

fn job_json(j: &Job) -> serde_json::Value {
    serde_json::json!({
        "job": j.job_id, "client_key": j.client_key, "state": j.state.to_string(),
        "message": j.message, "frames_done": j.frames_done, "frames_total": j.frames_total,
        "size": j.size, "submitted_unix_ms": j.submitted_unix_ms,
        "finished_unix_ms": j.finished_unix_ms,
    })
}
