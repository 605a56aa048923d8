//! A cluster, seen through the client library.

use crate::fail::Fail;
use crate::output::Frame;
use crate::progress::Step;
use crate::request::RenderRequest;
use crate::source::{Cancel, Source, Update};
use slabcast_client::{
    Client, ClientError, JobState, PATIENCE, Reason, Submitted, VolumeDescription, VolumeHeader,
    local_field,
};
use slabcast_common::quality::InvalidField;
use slabcast_common::volume::Volume;
use slabcast_scene::path::Orientation;
use slabcast_scene::request::{PathRequest, VolumeChoice};
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

/// Returns a volume of a master; warns if its pixels are of another version.
///
/// # Errors
/// The master has no such volume, or doesn't answer.
pub async fn describe(client: &Client, choice: &VolumeChoice) -> Result<VolumeDescription, Fail> {
    let served = client.volume(choice).await.map_err(|e| match &e {
        ClientError::InvalidField { field, problem } if field == "volume" => {
            Fail::usage(format!("VOLUME: {problem}"))
        }
        _ => client_failure(&e),
    })?;
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

/// Uploads a volume to a master that does not have it yet. If the master has another volume of this
/// name, digits of the digest are added to it. `told` is called with the bytes that the master has
/// and the bytes of all samples.
///
/// # Errors
/// The master refuses the volume, or can't be reached for too long.
pub async fn put(
    client: &Client,
    volume: &Volume,
    orientation: Orientation,
    (name, is_chosen): (&str, bool),
    mut told: impl FnMut(u64, u64),
) -> Result<VolumeDescription, Fail> {
    let info = volume.info(volume.digest());
    let digest = info.digest;
    let codes = volume.codes();
    let total = (codes.len() * codes.kind().bytes()) as u64;
    let file_type = volume.file_type.clone();
    let mut header = VolumeHeader { name: name.to_owned(), file_type, info, orientation };
    let mut put = client.put_volume(&header, codes, |there| told(there, total)).await;
    if let Err(ClientError::Volume { reason: Reason::VolumeNameTaken, .. }) = put
        && !is_chosen
    {
        header.name = format!("{name}-{}", &digest.to_string()[..8]);
        put = client.put_volume(&header, codes, |there| told(there, total)).await;
    }
    put.map_err(|e| client_failure(&e))?;
    describe(client, &VolumeChoice::Digest(digest)).await
}

/// Submits a path to a master behind a network and returns its updates.
///
/// # Errors
/// The master refuses the request, or doesn't answer.
pub async fn submit(
    client: Client,
    request: &RenderRequest,
    message: PathRequest,
) -> Result<Source, Fail> {
    let submitted = client.submit_framed(&message).await.map_err(|e| match &e {
        ClientError::InvalidField { field, problem } => {
            request.blame(&InvalidField::new(local_field(field), problem))
        }
        _ => client_failure(&e),
    })?;
    let Submitted { job, framing } = submitted;
    let (name, job_now) = watch::channel(job);
    let (to, updates) = mpsc::channel(1);
    let cancel = Cancel::new(cancel(client.clone(), job_now));
    tokio::spawn(async move {
        if let Err(e) = pump(&client, message, name, &to).await {
            let _ = to.send(Err(e)).await;
        }
    });
    Ok(Source { updates, cancel, framing })
}

/// Passes a job's updates on until its last frame.
async fn pump(
    client: &Client,
    mut message: PathRequest,
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
                // The volume is named by its digest, so no other can take its place.
                let name = client.submit(&message).await.map_err(|e| match &e {
                    ClientError::Volume { reason: Reason::VolumeNotFound, message } => {
                        Fail::failed(format!(
                            "the master at {} was restarted, and has another volume now: {message}, \
                             and render again; the frames that are written stay right",
                            client.address()
                        ))
                    }
                    _ => client_failure(&e),
                })?;
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
