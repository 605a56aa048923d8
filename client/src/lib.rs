//! Submit a view path to a master and stream its frames.
//!
//! 1. [`Client::connect`] to a master.
//! 2. [`Client::submit`] a path; the response names the job.
//! 3. [`Client::follow`] the job and read updates until it ends:
//!
//! ```no_run
//! # use slabcast_client::ClientError;
//! # use slabcast_scene::request::PathRequest;
//! # async fn f(request: PathRequest) -> Result<(), ClientError> {
//! use slabcast_client::{Client, PATIENCE, Update};
//! let client = Client::connect("127.0.0.1:7433").await?;
//! let job = client.submit(&request).await?;
//! let mut frames = client.follow(&job, 0, PATIENCE).await?;
//! while let Some(update) = frames.next().await? {
//!     match update {
//!         Update::Notice(notice) => eprintln!("{}: {}", notice.state, notice.message),
//!         Update::Frame(frame) => println!("frame {}: {} bytes", frame.number, frame.bytes.len()),
//!         Update::FrameFailed { number, reason } => eprintln!("frame {number}: {reason}"),
//!     }
//! }
//! # Ok(()) }
//! ```
//!
//! Dropping a client or a stream never cancels a job; [`Client::cancel`] does. Errors are told
//! apart by [`ClientError`], which reads the details of a master's status, not its text. This crate
//! refuses to know files, flags and progress bars: those are the program's.

mod address;
mod error;
mod frames;
mod volumes;

pub use address::{DEFAULT_PORT, with_default_port};
pub use error::ClientError;
pub use frames::{FrameStream, PATIENCE, ReceivedFrame, Update};
pub use slabcast_proto::convert::local_field;
pub use slabcast_proto::model::{
    Job, JobNotice, JobState, VolumeDescription, VolumeEntry, VolumeHeader, VolumeList,
    VolumeOrigin, Worker,
};
pub use slabcast_proto::status::Reason;

use prost::Message;
use slabcast_proto::checked::CHECKSUM_BYTES;
use slabcast_proto::render_v1::{self as wire, render_service_client::RenderServiceClient};
use slabcast_proto::{MAX_RENDER_MESSAGE, convert};
use slabcast_scene::path::Framing;
use slabcast_scene::request::PathRequest;
use std::error::Error as _;
use std::future::Future;
use std::sync::Arc;
use std::time::Duration;
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Request, Response, Status};

/// Time that a connection may take to be made. A host that is there answers within a round trip;
/// one that is not is found out by this.
const CONNECT: Duration = Duration::from_secs(5);

/// Time that a master may take to answer. It answers from memory; only a machine that swaps takes
/// seconds.
pub(crate) const ANSWER: Duration = Duration::from_secs(30);

/// Jobs or workers of a page: the most that a master takes.
const MAX_PAGE: usize = 1000;

/// Wait before a call is made a second time.
const AGAIN: Duration = Duration::from_millis(100);

/// Most attempts at a call whose request or response arrives damaged. On a line that damages half of
/// all attempts, one call in a million fails.
const MOST_DAMAGED: u32 = 20;

/// Streams that were reset and are remembered: of all calls that a program drops within a second, a
/// hundred bytes each.
const RESET_STREAMS: usize = 4096;

/// Longest such wait, whatever the master asks for.
const LONGEST_AGAIN: Duration = Duration::from_secs(2);

/// A connection to a master. Clones share it; when it breaks, the next call makes it again.
#[derive(Clone, Debug)]
pub struct Client {
    render: RenderServiceClient<Channel>,
    address: Arc<str>,
}

/// Answer of a master to a path.
#[derive(Clone, Debug, PartialEq)]
pub struct Submitted {
    /// Name of the job.
    pub job: String,
    /// Target and height that the path was given, if it asked for them. A master older than this
    /// program knows of no such wish: it frames the volume's box.
    pub framing: Option<Framing>,
}

impl Client {
    /// Connects to the master at `host:port`, `host` ([`DEFAULT_PORT`]) or `http://host:port`.
    ///
    /// # Errors
    /// [`ClientError::Address`], [`ClientError::Connect`] and, if what answers is no master,
    /// [`ClientError::NotAMaster`] name the address and what to do, within 10 s.
    pub async fn connect(address: &str) -> Result<Client, ClientError> {
        let address = address::authority(address)?;
        let refused = |e: &dyn std::error::Error| ClientError::Connect {
            address: address.clone(),
            cause: error::root_cause(e),
        };
        // docs/design/transport.md section 9, for the receiver of bulk on a LAN. Pings tell a
        // master that vanished from one that renders (docs/design/promises.md B4: 20 s for
        // viewers).
        let endpoint = Endpoint::from_shared(format!("http://{address}"))
            .map_err(|e| refused(&e))?
            .connect_timeout(CONNECT)
            .tcp_nodelay(true)
            .initial_stream_window_size(1 << 20)
            .initial_connection_window_size(4 << 20)
            .max_frame_size(64 * 1024)
            // Watches that are dropped, and calls, are reset, and their frames may still be on the way.
            // HTTP/2 forgets all but so many reset streams (50 by default), takes frames of forgotten
            // ones for errors, and closes the connection after 1,024 errors.
            .http2_max_concurrent_reset_streams(RESET_STREAMS)
            .http2_max_local_error_reset_streams(None)
            .http2_keep_alive_interval(Duration::from_secs(20))
            .keep_alive_timeout(Duration::from_secs(20));
        // The endpoint's own limit ends with TCP; a peer that takes the connection and says
        // nothing is met by this one.
        let channel = match tokio::time::timeout(CONNECT, endpoint.connect()).await {
            Ok(channel) => channel.map_err(|e| refused(&e))?,
            Err(late) => return Err(refused(&late)),
        };
        let render = RenderServiceClient::new(channel)
            .max_decoding_message_size(MAX_RENDER_MESSAGE)
            .max_encoding_message_size(MAX_RENDER_MESSAGE);
        let client = Client { render, address: address.into() };
        client.greet().await?;
        Ok(client)
    }

    /// Checks that the peer is a master. A connection alone proves little: a web server accepts one too.
    ///
    /// # Errors
    /// [`ClientError::NotAMaster`] if the peer is silent for [`CONNECT`] or answers otherwise.
    async fn greet(&self) -> Result<(), ClientError> {
        let mut render = self.render.clone();
        let first = wire::ListJobsRequest { page_size: 1, page_token: String::new() };
        let question = render.list_jobs(first);
        let problem = match tokio::time::timeout(CONNECT, question).await {
            Err(_) => format!("it says nothing for {} s", CONNECT.as_secs()),
            Ok(Ok(_)) => return Ok(()),
            Ok(Err(status)) => match (status.source(), status.code()) {
                (Some(source), _) => format!("it speaks no gRPC: {}", error::root_cause(source)),
                // HTTP without gRPC, and gRPC without this service.
                (None, Code::Unknown | Code::Internal | Code::Unimplemented) => {
                    format!("it answers otherwise: {}", error::one_line(status.message()))
                }
                // A master that is busy, or whose answer was damaged on its way.
                (None, _) => return Ok(()),
            },
        };
        Err(ClientError::NotAMaster { address: self.address.to_string(), problem })
    }

    /// Returns the master's address, as `host:port`.
    pub fn address(&self) -> &str {
        &self.address
    }

    /// Submits a path and returns the job's id. Calling again with the same `client_key` and
    /// the same request gives the same job; if it is over and frames of it failed, these are drawn
    /// again.
    ///
    /// # Errors
    /// [`ClientError::InvalidField`] if a field is wrong, [`ClientError::TooLong`] if the request
    /// is, [`ClientError::Full`] if the master takes no more jobs; [`ClientError::Status`] with
    /// [`Reason::ClientKeyTaken`] if the key belongs to another request.
    pub async fn submit(&self, request: &PathRequest) -> Result<String, ClientError> {
        Ok(self.submit_framed(request).await?.job)
    }

    /// Submits a path as [`Client::submit`], and returns the framing that it was given beside the
    /// job's name.
    ///
    /// # Errors
    /// See [`Client::submit`].
    pub async fn submit_framed(&self, request: &PathRequest) -> Result<Submitted, ClientError> {
        request.path.check().map_err(|e| ClientError::InvalidField {
            field: convert::wire_field(&e.field, &request.path),
            problem: e.problem,
        })?;
        let request = convert::submit_to_wire(request);
        let bytes = request.encoded_len();
        let most = MAX_RENDER_MESSAGE - CHECKSUM_BYTES;
        if bytes > most {
            return Err(ClientError::TooLong { bytes, most });
        }
        let reply = self
            .call(async |mut render, request| render.submit_path(request).await, request)
            .await?;
        if reply.job_id.is_empty() {
            return Err(self.protocol_error("job_id is empty"));
        }
        let framing = reply.framing.map(convert::framing_from_wire).transpose();
        let framing = framing.map_err(|e| self.protocol_error(&e))?;
        Ok(Submitted { job: reply.job_id, framing })
    }

    /// Streams the frames of a job from `from_frame` on, over one connection: when that breaks, so
    /// does the stream. [`Client::follow`] continues.
    ///
    /// # Errors
    /// [`ClientError::NotFound`] if the master does not know the job, [`ClientError::Lost`] if it
    /// is out of reach, [`ClientError::Full`] if it has no room for another watcher.
    pub async fn watch(&self, job: &str, from_frame: u64) -> Result<FrameStream, ClientError> {
        FrameStream::open(self.clone(), job.to_owned(), from_frame, None).await
    }

    /// Streams the frames of a job from `from_frame` on. When the connection breaks it is made
    /// again and the stream continues at the first frame that is not whole, as often as need be.
    ///
    /// # Errors
    /// [`ClientError::GaveUp`] if the master stays away for `patience`; else as [`Client::watch`],
    /// but for [`ClientError::Lost`].
    pub async fn follow(
        &self,
        job: &str,
        from_frame: u64,
        patience: Duration,
    ) -> Result<FrameStream, ClientError> {
        FrameStream::open(self.clone(), job.to_owned(), from_frame, Some(patience)).await
    }

    /// Returns the job with this id as it is now.
    ///
    /// # Errors
    /// [`ClientError::NotFound`] if the master does not know it, [`ClientError::Lost`] if the
    /// master is out of reach.
    pub async fn job(&self, job: &str) -> Result<Job, ClientError> {
        let request = wire::GetJobRequest { job_id: job.to_owned() };
        let response = self.call(async |mut r, request| r.get_job(request).await, request).await?;
        self.read_job(response.job)
    }

    /// Returns the master's jobs, newest first, at most `limit`.
    ///
    /// # Errors
    /// [`ClientError::Lost`] if the master is out of reach, [`ClientError::Protocol`] if it does
    /// not talk like one.
    pub async fn jobs(&self, limit: usize) -> Result<Vec<Job>, ClientError> {
        let mut jobs = Vec::new();
        let mut page_token = String::new();
        while jobs.len() < limit {
            let page_size = (limit - jobs.len()).min(MAX_PAGE) as u32;
            let request = wire::ListJobsRequest { page_size, page_token };
            let response =
                self.call(async |mut r, request| r.list_jobs(request).await, request).await?;
            let page = response.jobs.into_iter().map(convert::job_from_wire);
            let page = page.collect::<Result<Vec<_>, _>>().map_err(|e| self.protocol_error(&e))?;
            page_token = response.next_page_token;
            if page.is_empty() && !page_token.is_empty() {
                return Err(self.protocol_error("a page of jobs is empty and not the last"));
            }
            jobs.extend(page);
            if page_token.is_empty() {
                break;
            }
        }
        jobs.truncate(limit);
        Ok(jobs)
    }

    /// Cancels a job and returns it as it is then: one that was done before stays done.
    ///
    /// # Errors
    /// [`ClientError::NotFound`] if the master does not know it, [`ClientError::Lost`] if the
    /// master is out of reach.
    pub async fn cancel(&self, job: &str) -> Result<Job, ClientError> {
        let request = wire::CancelJobRequest { job_id: job.to_owned() };
        let response =
            self.call(async |mut r, request| r.cancel_job(request).await, request).await?;
        self.read_job(response.job)
    }

    /// Returns the master's workers, in the order in which they joined.
    ///
    /// # Errors
    /// [`ClientError::Lost`] if the master is out of reach, [`ClientError::Protocol`] if it does
    /// not talk like one.
    pub async fn workers(&self) -> Result<Vec<Worker>, ClientError> {
        let mut workers = Vec::new();
        let mut page_token = String::new();
        loop {
            let request = wire::ListWorkersRequest { page_size: MAX_PAGE as u32, page_token };
            let response =
                self.call(async |mut r, request| r.list_workers(request).await, request).await?;
            let page = response.workers.into_iter().map(convert::worker_from_wire);
            let page = page.collect::<Result<Vec<_>, _>>().map_err(|e| self.protocol_error(&e))?;
            page_token = response.next_page_token;
            if page.is_empty() && !page_token.is_empty() {
                return Err(self.protocol_error("a page of workers is empty and not the last"));
            }
            workers.extend(page);
            if page_token.is_empty() {
                return Ok(workers);
            }
        }
    }

    fn read_job(&self, job: Option<wire::Job>) -> Result<Job, ClientError> {
        let job = job.ok_or_else(|| self.protocol_error("job: missing; it is required"))?;
        convert::job_from_wire(job).map_err(|e| self.protocol_error(&e))
    }

    /// Makes a call; again when a message was damaged on its way, and once more when the connection
    /// turns out to be broken: a master that was restarted is met first on the connection to the one
    /// before. Every call may be repeated (`render.proto`).
    async fn call<Q: Clone, R, F>(
        &self,
        call: impl Fn(RenderServiceClient<Channel>, Request<Q>) -> F,
        request: Q,
    ) -> Result<R, ClientError>
    where
        F: Future<Output = Result<Response<R>, Status>>,
    {
        let once = || {
            let mut request = Request::new(request.clone());
            request.set_timeout(ANSWER);
            call(self.render.clone(), request)
        };
        let mut answer = once().await;
        for _ in 1..MOST_DAMAGED {
            match &answer {
                Err(status) if status.code() == Code::DataLoss => answer = once().await,
                _ => break,
            }
        }
        match answer {
            Err(status) if error::is_transient(&status) => {
                let lost = ClientError::from_status(&self.address, &status);
                let wait = lost.retry_after().unwrap_or(AGAIN);
                tokio::time::sleep(wait.clamp(AGAIN, LONGEST_AGAIN)).await;
                once().await
            }
            other => other,
        }
        .map(Response::into_inner)
        .map_err(|status| ClientError::from_status(&self.address, &status))
    }

    /// Makes the error of a master that breaks the rules of `render.proto`.
    pub(crate) fn protocol_error(&self, problem: &(impl ToString + ?Sized)) -> ClientError {
        ClientError::Protocol { address: self.address.to_string(), problem: problem.to_string() }
    }
}
