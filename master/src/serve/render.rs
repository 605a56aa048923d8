//! RenderService: jobs, frames, the volume and the workers.

use super::Responses;
use super::peers::Counts;
use super::volumes::{self, volume_status};
use crate::jobs::{JobState, JobView, Watch, WatchItem};
use crate::library::{Library, Viewer};
use crate::{Handle, SubmitError};
use slabcast_common::ids::JobId;
use slabcast_proto::MAX_RENDER_MESSAGE;
use slabcast_proto::convert::{self, Page};
use slabcast_proto::model::{self, JobNotice};
use slabcast_proto::render_v1::render_service_server::RenderService;
use slabcast_proto::render_v1::watch_frames_response::Message;
use slabcast_proto::render_v1::{self as wire, WatchFramesResponse};
use slabcast_proto::status::{Reason, invalid_field};
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::mpsc::error::SendError;
use tokio::sync::{Semaphore, mpsc};
use tokio_stream::wrappers::ReceiverStream;
use tonic::{Request, Response, Status};
use tracing::info;

/// Watchers at a time; each holds up to three chunks of 256 KiB: one that is written, one that
/// waits, and what HTTP/2 has of one.
const MAX_WATCHERS: usize = 256;

/// Bytes of a list after which its page ends: half of what a response may have.
const LIST_BYTES: usize = MAX_RENDER_MESSAGE / 2;

/// RetryInfo of a master that has no room for another job or watcher.
const FULL_RETRY: Duration = Duration::from_secs(5);

/// RetryInfo of a master that ends.
const ENDING_RETRY: Duration = Duration::from_secs(1);

/// Interval at which a watch without news repeats its latest notice. Clients take a silence of 30 s for
/// a stalled connection.
const HEARTBEAT: Duration = Duration::from_secs(10);

/// The service.
pub(super) struct Render {
    handle: Handle,
    watchers: Arc<Semaphore>,
    of_peers: Arc<Counts>,
}

impl Render {
    pub(super) fn new(handle: Handle) -> Self {
        Render {
            handle,
            watchers: Arc::new(Semaphore::new(MAX_WATCHERS)),
            of_peers: Arc::default(),
        }
    }

    /// Who makes a request, as the library knows callers.
    fn viewer<T>(&self, request: &Request<T>) -> Viewer {
        self.handle.viewer(request.remote_addr().map(|address| address.ip()))
    }

    /// The job with an id, or NOT_FOUND.
    fn job(&self, id: &str) -> Result<(JobId, JobView), Status> {
        let job = id.strip_prefix("job-").and_then(|n| n.parse().ok()).map(JobId);
        let found = job.and_then(|job| Some((job, self.handle.job(job)?)));
        found.ok_or_else(|| job_not_found(id))
    }
}

fn job_not_found(id: &str) -> Status {
    let id: String = id.chars().take(convert::MAX_NAME).collect();
    let message = format!("no job `{id}`; ListJobs names the jobs that are known");
    Reason::JobNotFound.status(&message, &[("job_id", id)])
}

fn state(state: &JobState) -> (model::JobState, String) {
    match state {
        JobState::Queued => (model::JobState::Queued, String::new()),
        JobState::Preparing => {
            (model::JobState::Preparing, "cutting the volume into bricks".into())
        }
        JobState::WaitingForWorkers => (
            model::JobState::WaitingForWorkers,
            "no worker is there; start one with `slabcast worker --master HOST:PORT`".into(),
        ),
        JobState::Running => (model::JobState::Running, String::new()),
        JobState::Done => (model::JobState::Done, String::new()),
        JobState::Failed(reason) | JobState::Incomplete(reason) => {
            (model::JobState::Failed, reason.clone())
        }
        JobState::Cancelled => (model::JobState::Cancelled, String::new()),
    }
}

/// Makes the notice that tells clients of a job.
pub fn notice(job: &JobView) -> JobNotice {
    let (state, mut message) = state(&job.state);
    if state == model::JobState::Running && job.tiles.1 > 0 {
        message = format!(
            "frame {}: slab {} of {}, {} of {} tiles",
            job.frames_done,
            job.slab.0 + 1,
            job.slab.1,
            job.tiles.0,
            job.tiles.1
        );
    }
    if let Some(trouble) = job.trouble.as_ref().filter(|_| state == model::JobState::Running) {
        message.clone_from(trouble);
    }
    JobNotice {
        state,
        frames_done: job.frames_done,
        frames_failed: job.frames_failed,
        frames_total: job.frames_total,
        render_threads: job.workers,
        message,
    }
}

fn job_to_wire(view: &JobView, library: &Library, viewer: Viewer) -> wire::Job {
    let (state, message) = state(&view.state);
    convert::job_to_wire(&model::Job {
        job_id: view.id.to_string(),
        client_key: view.client_key.clone(),
        state,
        message,
        frames_done: view.frames_done,
        frames_failed: view.frames_failed,
        frames_total: view.frames_total,
        size: view.size,
        format: view.format,
        submitted_unix_ms: view.submitted_unix_ms,
        finished_unix_ms: view.finished_unix_ms,
        volume: Some((view.volume, library.name_of(view.volume, viewer))),
    })
}

/// Takes a page of entries, each with its number, and the token of the next one.
fn page<M: prost::Message>(
    page: Page,
    entries: impl Iterator<Item = (u64, M)>,
) -> (Vec<M>, String) {
    let (mut taken, mut bytes, mut last) = (Vec::new(), 0, 0);
    for (number, entry) in entries {
        bytes += entry.encoded_len();
        if taken.len() == page.size || bytes > LIST_BYTES {
            return (taken, convert::page_token(last));
        }
        last = number;
        taken.push(entry);
    }
    (taken, String::new())
}

#[tonic::async_trait]
impl RenderService for Render {
    type WatchFramesStream = Responses<WatchFramesResponse>;

    async fn submit_path(
        &self,
        request: Request<wire::SubmitPathRequest>,
    ) -> Result<Response<wire::SubmitPathResponse>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        let request = convert::submit_from_wire(request.into_inner())?;
        let path = request.path.clone();
        match self.handle.submit_from(request, peer).await {
            Ok(id) => {
                let framing = self.handle.job(id).and_then(|job| job.framing);
                Ok(Response::new(wire::SubmitPathResponse {
                    job_id: id.to_string(),
                    framing: framing.as_ref().map(convert::framing_to_wire),
                }))
            }
            Err(SubmitError::Refused(wrong)) => {
                Err(invalid_field(&convert::wire_field(&wrong.field, &path), &wrong.problem))
            }
            Err(SubmitError::Volume(e)) => Err(volume_status(&e)),
            Err(SubmitError::KeyTaken) => {
                let message = "client_key: belongs to another request; choose a fresh key";
                Err(Reason::ClientKeyTaken.status(message, &[]))
            }
            Err(SubmitError::Full(why)) => Err(Reason::TooManyJobs.retry(&why, FULL_RETRY)),
            Err(SubmitError::Gone) => {
                Err(Reason::MasterEnding.retry("the master ends", ENDING_RETRY))
            }
            Err(e @ SubmitError::Panicked(_)) => Err(Status::internal(e.to_string())),
        }
    }

    async fn watch_frames(
        &self,
        request: Request<wire::WatchFramesRequest>,
    ) -> Result<Response<Self::WatchFramesStream>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        let wire::WatchFramesRequest { job_id, from_frame } = request.into_inner();
        let (job, view) = self.job(&job_id)?;
        if from_frame > view.frames_total {
            let total = view.frames_total;
            let message = format!(
                "from_frame: {from_frame}, the job has {total} frames; ask for a smaller one"
            );
            let total = ("frames_total", total.to_string());
            return Err(Reason::FrameBeyondEnd.status(&message, &[total]));
        }
        let most = self.handle.peer_limits().watchers;
        let share = peer.map(|ip| self.of_peers.take(ip, most));
        if share.as_ref().is_some_and(Option::is_none) {
            let message = format!(
                "{most} watchers from your address are open, as many as one address may have \
                 (--peer-watchers of the master); end one, or wait"
            );
            return Err(Reason::TooManyWatchers.retry(&message, FULL_RETRY));
        }
        let place = self.watchers.clone().try_acquire_owned().map_err(|_| {
            let message =
                format!("the master has {MAX_WATCHERS} watchers, as many as it takes; wait");
            Reason::TooManyWatchers.retry(&message, FULL_RETRY)
        })?;
        let watch = self.handle.watch(job, from_frame).ok_or_else(|| job_not_found(&job_id))?;
        let (out, outbound) = mpsc::channel(1);
        let handle = self.handle.clone();
        tokio::spawn(async move {
            let _places = (place, share);
            // A send that fails: the watcher is gone.
            let _ = send_frames(&handle, watch, view, from_frame, &out).await;
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(outbound))))
    }

    async fn get_job(
        &self,
        request: Request<wire::GetJobRequest>,
    ) -> Result<Response<wire::GetJobResponse>, Status> {
        let viewer = self.viewer(&request);
        let (_, view) = self.job(&request.into_inner().job_id)?;
        let job = job_to_wire(&view, self.handle.library(), viewer);
        Ok(Response::new(wire::GetJobResponse { job: Some(job) }))
    }

    async fn list_jobs(
        &self,
        request: Request<wire::ListJobsRequest>,
    ) -> Result<Response<wire::ListJobsResponse>, Status> {
        let viewer = self.viewer(&request);
        let library = self.handle.library();
        let wire::ListJobsRequest { page_size, page_token } = request.into_inner();
        let wanted = convert::page_from_wire(page_size, &page_token)?;
        let all = self.handle.jobs();
        let rest = all.iter().rev().filter(|job| wanted.after.is_none_or(|a| job.id.0 < a));
        let rest = rest.map(|job| (job.id.0, job_to_wire(job, library, viewer)));
        let (jobs, next_page_token) = page(wanted, rest);
        Ok(Response::new(wire::ListJobsResponse { jobs, next_page_token }))
    }

    async fn cancel_job(
        &self,
        request: Request<wire::CancelJobRequest>,
    ) -> Result<Response<wire::CancelJobResponse>, Status> {
        let viewer = self.viewer(&request);
        let peer = request.remote_addr().map(|address| address.ip().to_string());
        let job_id = request.into_inner().job_id;
        let (job, _) = self.job(&job_id)?;
        if self.handle.cancel(job).await {
            info!(%job, peer, "job cancelled by a client");
        }
        let (_, view) = self.job(&job_id)?;
        let job = job_to_wire(&view, self.handle.library(), viewer);
        Ok(Response::new(wire::CancelJobResponse { job: Some(job) }))
    }

    async fn describe_volume(
        &self,
        request: Request<wire::DescribeVolumeRequest>,
    ) -> Result<Response<wire::DescribeVolumeResponse>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        volumes::describe(&self.handle, request.into_inner(), peer).await.map(Response::new)
    }

    async fn list_volumes(
        &self,
        request: Request<wire::ListVolumesRequest>,
    ) -> Result<Response<wire::ListVolumesResponse>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        volumes::list(&self.handle, request.into_inner(), peer).await.map(Response::new)
    }

    async fn put_volume(
        &self,
        request: Request<wire::PutVolumeRequest>,
    ) -> Result<Response<wire::PutVolumeResponse>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        volumes::put(&self.handle, request.into_inner(), peer).await.map(Response::new)
    }

    async fn remove_volume(
        &self,
        request: Request<wire::RemoveVolumeRequest>,
    ) -> Result<Response<wire::RemoveVolumeResponse>, Status> {
        let peer = request.remote_addr().map(|address| address.ip());
        volumes::remove(&self.handle, request.into_inner(), peer).await.map(Response::new)
    }

    async fn list_workers(
        &self,
        request: Request<wire::ListWorkersRequest>,
    ) -> Result<Response<wire::ListWorkersResponse>, Status> {
        let wire::ListWorkersRequest { page_size, page_token } = request.into_inner();
        let wanted = convert::page_from_wire(page_size, &page_token)?;
        let mut all = self.handle.workers().await;
        all.sort_unstable_by_key(|worker| worker.id);
        let rest = all.iter().filter(|worker| wanted.after.is_none_or(|a| worker.id.0 > a));
        let rest = rest.map(|worker| (worker.id.0, convert::worker_to_wire(worker)));
        let (workers, next_page_token) = page(wanted, rest);
        Ok(Response::new(wire::ListWorkersResponse { workers, next_page_token }))
    }
}

/// Sends the frames of a job until its end, or until the watcher is gone (an error).
async fn send_frames(
    handle: &Handle,
    mut watch: Watch,
    mut view: JobView,
    from_frame: u64,
    out: &mpsc::Sender<Result<WatchFramesResponse, Status>>,
) -> Result<(), SendError<()>> {
    let gone = |_| SendError(());
    let mut next = from_frame;
    // A stream begins with a notice, so that the caller knows that it is heard.
    out.send(Ok(convert::notice_to_wire(&notice(&view)))).await.map_err(gone)?;
    loop {
        let item = tokio::select! {
            item = watch.next() => item,
            () = out.closed() => return Ok(()),
            () = tokio::time::sleep(HEARTBEAT) => Some(WatchItem::Notice(Box::new(view.clone()))),
        };
        match item {
            None => break,
            Some(WatchItem::Notice(news)) => {
                out.send(Ok(convert::notice_to_wire(&notice(&news)))).await.map_err(gone)?;
                view = *news;
            }
            Some(WatchItem::Failed { number, reason }) => {
                next = number + 1;
                out.send(Ok(convert::frame_failed_to_wire(number, &reason))).await.map_err(gone)?;
            }
            Some(WatchItem::Frame(f)) => {
                next = f.number + 1;
                let trace = f.trace_json.as_deref().unwrap_or("");
                let mut chunks =
                    convert::frame_to_wire(f.number, f.size, f.format, &f.bytes, &f.stats, trace);
                // A slice of the pixels would keep all of them for as long as the watcher takes to
                // read. So each chunk is copied when there is room for it, from the frame as the
                // table has it then, or rendered again.
                let (number, frame) = (f.number, Arc::downgrade(&f));
                drop(f);
                let lengths: Vec<usize> = chunks.iter_mut().map(|c| take_pixels(c).len()).collect();
                for (mut chunk, length) in chunks.into_iter().zip(lengths) {
                    let room = out.reserve().await.map_err(|_| SendError(()))?;
                    if length > 0 {
                        let found = match frame.upgrade() {
                            Some(frame) => Some(frame),
                            None => watch.again(number).await,
                        };
                        let Some(frame) = found else {
                            let message = format!(
                                "frame {number} was dropped while it was read and can't be \
                                 rendered again; submit the path anew"
                            );
                            let metadata = [("frame", number.to_string())];
                            room.send(Err(Reason::FrameNotKept.status(&message, &metadata)));
                            return Ok(());
                        };
                        put_pixels(&mut chunk, &frame.bytes, length);
                    }
                    room.send(Ok(chunk));
                }
            }
        }
    }
    if matches!(view.state, JobState::Done | JobState::Incomplete(_)) && next < view.frames_total {
        let message = format!("frame {next} is no longer kept; submit the path anew");
        let mut metadata = vec![("frame", next.to_string())];
        let kept = handle.first_kept_frame(view.id, next);
        metadata.extend(kept.map(|kept| ("first_kept_frame", kept.to_string())));
        out.send(Err(Reason::FrameNotKept.status(&message, &metadata))).await.map_err(gone)?;
    }
    Ok(())
}

/// Takes the pixels out of a chunk.
fn take_pixels(response: &mut WatchFramesResponse) -> bytes::Bytes {
    match &mut response.message {
        Some(Message::Chunk(chunk)) => std::mem::take(&mut chunk.data),
        _ => bytes::Bytes::new(),
    }
}

/// Copies the `length` bytes of a chunk from the pixels of its frame.
fn put_pixels(response: &mut WatchFramesResponse, pixels: &[u8], length: usize) {
    if let Some(Message::Chunk(chunk)) = &mut response.message {
        let begin = chunk.offset as usize;
        chunk.data = bytes::Bytes::copy_from_slice(&pixels[begin..begin + length]);
    }
}
