//! A cluster, seen through the client library.

use crate::fail::Fail;
use crate::output::Frame;
use crate::progress::Step;
use crate::request::RenderRequest;
use crate::source::{Cancel, Source, Update};
use slabcast_client::{
    Client, ClientError, JobState, PATIENCE, Submitted, VolumeDescription, local_field,
};
use slabcast_common::quality::InvalidField;
use slabcast_common::volume::Digest32;
use slabcast_scene::request::PathRequest;
use std::time::{Duration, Instant};
use tokio::sync::{mpsc, watch};

/// From how long on silence is worth a word. A large frame on few workers may take a while; a
/// master that is away is dialled again meanwhile.
const SILENCE: Duration = Duration::from_secs(5);

/// Times that a job is submitted anew which a restarted master has forgotten. Frames are a pure
/// function of the request, so the rest of them fits what is there; a master that forgets more
/// often than this is not well.
const ANEW: u32 = 3;

/// Returns a client's error as the failure of a command.
pub fn client_failure(e: &ClientError) -> Fail {
    match e {
        ClientError::Address { .. } => Fail::usage(format!("--master: {e}")),
        _ => Fail::failed(e.to_string()),
    }
}

/// Connects to a master at `HOST:PORT`.
///
/// # Errors
/// The address is wrong or nobody answers.
pub async fn connect(master: &str) -> Result<Client, Fail> {
    Client::connect(master).await.map_err(|e| client_failure(&e))
}

/// Returns the volume that a master serves; warns if its pixels are of another version.
///
/// # Errors
/// The master doesn't answer.
pub async fn describe(client: &Client) -> Result<VolumeDescription, Fail> {
    let served = client.volume().await.map_err(|e| client_failure(&e))?;
    if served.pixels_version != slabcast_common::PIXELS_VERSION {
        crate::progress::warn(&format!(
            "{} draws pixels of version {}, this program those of {}: hashes will differ; run the \
             same version of slabcast on both",
            client.address(),
            served.pixels_version,
            slabcast_common::PIXELS_VERSION
        ));
    }
    Ok(served)
}

/// Submits a path to a master behind a network and returns its updates.
///
/// # Errors
/// The master refuses the request, serves another volume than the one with this digest, or doesn't
/// answer.
pub async fn submit(
    client: Client,
    request: &RenderRequest,
    message: PathRequest,
    volume: Digest32,
) -> Result<Source, Fail> {
    let submitted = client.submit_framed(&message).await.map_err(|e| match &e {
        ClientError::InvalidField { field, problem } => {
            request.blame(&InvalidField::new(local_field(field), problem))
        }
        _ => client_failure(&e),
    })?;
    let Submitted { job, framing } = submitted;
    check_volume(&client, &job, volume).await?;
    let (name, job_now) = watch::channel(job);
    let (to, updates) = mpsc::channel(1);
    let cancel = Cancel::new(cancel(client.clone(), job_now));
    tokio::spawn(async move {
        if let Err(e) = pump(&client, message, volume, name, &to).await {
            let _ = to.send(Err(e)).await;
        }
    });
    Ok(Source { updates, cancel, framing })
}

/// Checks that a master serves the volume with digest `volume`, and cancels `job` if not. To be called
/// after the job was submitted: a master that restarts with another volume later doesn't know the job.
///
/// # Errors
/// The master serves another volume, or doesn't answer.
async fn check_volume(client: &Client, job: &str, volume: Digest32) -> Result<(), Fail> {
    let served = client.volume().await.map_err(|e| client_failure(&e))?;
    if served.info.digest == volume {
        return Ok(());
    }
    let _ = client.cancel(job).await;
    let (was, is) = (volume.to_string(), served.info.digest.to_string());
    Err(Fail::failed(format!(
        "the master at {} serves another volume now: {} ({}...), and the pictures are of {}...; frames \
         that are written show that one. Start the master with it again, or draw the new one into \
         another folder",
        client.address(),
        served.name,
        &is[..8],
        &was[..8],
    )))
}

/// Passes a job's updates on until its last frame.
async fn pump(
    client: &Client,
    mut message: PathRequest,
    volume: Digest32,
    job: watch::Sender<String>,
    to: &mpsc::Sender<Result<Update, Fail>>,
) -> Result<(), Fail> {
    let (mut next, mut anew) = (0, 0);
    loop {
        let name = job.borrow().clone();
        match follow(client, &name, &mut next, to).await {
            Ok(()) => return Ok(()),
            Err(ClientError::NotFound { .. }) if anew < ANEW => {
                anew += 1;
                tracing::warn!(
                    job = name,
                    "the master does not know the job any more; submitting it again"
                );
                message.client_key = crate::request::client_key();
                let name = client.submit(&message).await.map_err(|e| client_failure(&e))?;
                check_volume(client, &name, volume).await?;
                job.send_replace(name);
            }
            Err(e) => return Err(client_failure(&e)),
        }
    }
}

async fn follow(
    client: &Client,
    job: &str,
    next: &mut u64,
    to: &mpsc::Sender<Result<Update, Fail>>,
) -> Result<(), ClientError> {
    let mut frames = client.follow(job, *next, PATIENCE).await?;
    let mut heard = Instant::now();
    let mut latest = Step { frames: *next, ..Step::default() };
    let (mut queued, mut failed) = (false, false);
    loop {
        let update = match tokio::time::timeout(SILENCE, frames.next()).await {
            Err(_) => {
                let s = heard.elapsed().as_secs();
                Update::Step(Step {
                    waiting: if queued {
                        "waiting: other jobs come first".into()
                    } else if latest.waiting.is_empty() && s > 10 {
                        format!("no news from {} for {s} s", client.address())
                    } else {
                        latest.waiting.clone()
                    },
                    ..latest.clone()
                })
            }
            Ok(update) => {
                heard = Instant::now();
                let update = match update {
                    // The frames that failed were told one by one, and all others came.
                    Err(ClientError::JobFailed { .. }) if failed => None,
                    update => update?,
                };
                match update {
                    Some(slabcast_client::Update::FrameFailed { number, reason }) => {
                        *next = number + 1;
                        failed = true;
                        Update::FrameFailed { number, reason }
                    }
                    Some(slabcast_client::Update::Notice(n)) => {
                        latest = step(&n, client.address());
                        queued = n.state == JobState::Queued;
                        Update::Step(latest.clone())
                    }
                    Some(slabcast_client::Update::Frame(f)) => {
                        *next = f.number + 1;
                        latest.frames = *next;
                        Update::Frame {
                            frame: Frame {
                                number: f.number,
                                size: f.size,
                                format: f.format,
                                bytes: f.bytes.into(),
                            },
                            stats: Some(Box::new(f.stats)),
                            stats_json: f.stats_json,
                            trace_json: f.trace_json.unwrap_or_default(),
                        }
                    }
                    None => Update::Done,
                }
            }
        };
        let done = matches!(update, Update::Done);
        if to.send(Ok(update)).await.is_err() || done {
            return Ok(());
        }
    }
}

/// A notice as a step of the bar.
fn step(n: &slabcast_client::JobNotice, master: &str) -> Step {
    let message = n.message.trim();
    let waiting = match n.state {
        JobState::WaitingForWorkers => {
            format!("waiting for workers: start `slabcast worker --master {master}`")
        }
        // The master says why nothing is drawn.
        JobState::Running if message.starts_with("waiting: ") => message.into(),
        _ => String::new(),
    };
    let detail = match n.state {
        // "frame 3: slab 1 of 3, ...": the bar has the frame already.
        JobState::Running => message.split_once(": ").map_or(message, |(_, rest)| rest).into(),
        // For a moment every job is: worth a word only when it lasts.
        JobState::Queued => "queued".into(),
        JobState::Preparing => message.into(),
        _ => String::new(),
    };
    Step { waiting, detail, frames: n.frames_done, ..Step::default() }
}

/// Cancels a job of a cluster. Its name changes when it is submitted anew; the last one counts.
async fn cancel(client: Client, job: watch::Receiver<String>) {
    let job = job.borrow().clone();
    if let Err(e) = client.cancel(&job).await {
        tracing::warn!(job, error = %e, "cancelling the job failed");
    }
}
