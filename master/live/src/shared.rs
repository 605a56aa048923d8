//! State shared by all sessions and HTTP calls of a master's page.

use crate::descriptions::Descriptions;
use crate::files::Files;
use crate::guard::Guard;
use crate::places::Places;
use crate::volume::Home;
use slabcast_master::Handle;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Instant, SystemTime};
use tokio::sync::{Semaphore, watch};

/// Largest edge of a live picture, pixels.
pub(crate) const LIVE_EDGE: u32 = 4096;
/// Most pixels of a live picture.
pub(crate) const LIVE_PIXELS: u64 = 4 << 20;
/// Sessions of one address unless the settings say otherwise.
const SESSIONS_OF_PEER: usize = 16;

/// Pictures to keep that are made at a time: one of 8192x8192 takes 0.5 GiB.
const PICTURES: usize = 4;

/// Settings of a master's page.
#[derive(Clone, Debug, Default)]
pub struct LiveConfig {
    /// Name of the master for people; empty for the machine's.
    pub name: String,
    /// Name of this machine, accepted as `Host`.
    pub machine: String,
    /// Other accepted host names, such as a proxy's.
    pub allowed_hosts: Vec<String>,
    /// Token that pages must send; `None`: no token.
    pub token: Option<String>,
    /// Scene of the first picture.
    pub home: Home,
    /// Sessions that one address other than this machine's may have at a time; default 16.
    pub sessions_of_peer: Option<usize>,
}

/// See the head of the file.
pub(crate) struct Shared {
    pub(crate) handle: Handle,
    pub(crate) config: LiveConfig,
    pub(crate) guard: Guard,
    pub(crate) sessions: Places,
    /// Places of pictures to keep that are drawn and written now.
    pub(crate) pictures: Semaphore,
    pub(crate) stop: watch::Receiver<bool>,
    pub(crate) files: Arc<dyn Files>,
    pub(crate) states: crate::http::States,
    pub(crate) results: crate::http::Results,
    pub(crate) uploads: crate::uploads::Uploads,
    pub(crate) descriptions: Descriptions,
    started: Instant,
    last_id: AtomicU64,
}

impl Shared {
    pub(crate) fn new(
        handle: Handle,
        config: LiveConfig,
        files: Arc<dyn Files>,
        stop: watch::Receiver<bool>,
    ) -> Shared {
        Shared {
            guard: Guard::new(&config.machine, &config.allowed_hosts, config.token.as_deref()),
            handle,
            sessions: Places::new(config.sessions_of_peer.unwrap_or(SESSIONS_OF_PEER)),
            config,
            pictures: Semaphore::new(PICTURES),
            stop,
            files,
            states: Default::default(),
            results: Default::default(),
            uploads: Default::default(),
            descriptions: Default::default(),
            started: Instant::now(),
            last_id: AtomicU64::new(0),
        }
    }

    /// Returns a number that is unique within this master's page.
    pub(crate) fn fresh_id(&self) -> u64 {
        self.last_id.fetch_add(1, Ordering::Relaxed) + 1
    }

    /// Returns a key for a request of this page.
    pub(crate) fn fresh_key(&self) -> String {
        format!("live-{:x}-{}", unix_ms(), self.fresh_id())
    }

    /// Returns microseconds on a clock that never goes back.
    pub(crate) fn now(&self) -> u64 {
        self.started.elapsed().as_micros() as u64
    }

    /// Returns the moment of a time of [`Shared::now`].
    pub(crate) fn moment(&self, at: u64) -> tokio::time::Instant {
        (self.started + std::time::Duration::from_micros(at)).into()
    }
}

/// Returns the time of day in Unix milliseconds.
pub(crate) fn unix_ms() -> u64 {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since.map_or(0, |since| since.as_millis() as u64)
}
