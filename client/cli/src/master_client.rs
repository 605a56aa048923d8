//! Client calls of `status`, `jobs` and `cancel` to a running master, and the tables they print.

use slabcast_client::{Client, ClientError, Job, JobState};
use slabcast_session::fail::Fail;
use slabcast_session::progress::time;
use slabcast_session::remote::{client_failure, connect};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

/// `--master`, with its default.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct MasterArg {
    /// The master
    #[arg(long = "master", value_name = "HOST:PORT", default_value = "127.0.0.1:7433",
          env = "SLABCAST_MASTER", hide_env_values = true, value_parser = slabcast_session::parse::master, id = "master")]
    pub(crate) address: String,
}

/// Connects to a master, asks it `question` and returns the answer.
///
/// # Errors
/// The master can't be reached, refuses, or doesn't know the job.
pub(crate) fn ask<T>(
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
            _ => client_failure(&e),
        })
    });
    runtime.shutdown_timeout(Duration::from_millis(200));
    answer
}

/// Adds a table of jobs to `out`.
pub(crate) fn job_table(out: &mut String, jobs: &[&Job]) {
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

/// Adds rows to `out`, each column as wide as its widest cell.
pub(crate) fn table<const N: usize>(out: &mut String, rows: &[[String; N]]) {
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

/// Returns a job as JSON.
pub(crate) fn job_json(j: &Job) -> serde_json::Value {
    serde_json::json!({
        "job": j.job_id, "client_key": j.client_key, "state": j.state.to_string(),
        "message": j.message, "frames_done": j.frames_done, "frames_failed": j.frames_failed,
        "frames_total": j.frames_total,
        "size": j.size, "submitted_unix_ms": j.submitted_unix_ms,
        "finished_unix_ms": j.finished_unix_ms,
    })
}
