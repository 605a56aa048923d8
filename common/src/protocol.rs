//! Versions of the protocol between master and worker, and limits that both sides keep.

use std::fmt;

/// Newest version of `slabcast.cluster.v1` that this program speaks. Every change that an older
/// peer would not survive raises it (`cluster.proto`, Versions).
pub const PROTOCOL_VERSION: u32 = 9;

/// Versions of `slabcast.cluster.v1` that this program speaks.
pub const PROTOCOL_VERSIONS: ProtocolVersions =
    ProtocolVersions { oldest: 9, newest: PROTOCOL_VERSION };

/// Most render threads of one worker: five times those of the largest machine sold. More are a
/// mistake, or a peer that lies.
pub const MAX_THREADS: u32 = 4096;

/// Versions of a protocol that a program speaks: from `oldest` to `newest`, both included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ProtocolVersions {
    /// Oldest protocol version that is spoken.
    pub oldest: u32,
    /// Newest protocol version that is spoken; not below the oldest.
    pub newest: u32,
}

impl ProtocolVersions {
    /// Returns whether `version` is spoken.
    pub fn contains(self, version: u32) -> bool {
        (self.oldest..=self.newest).contains(&version)
    }

    /// Returns the newest version that both speak, if there is one.
    ///
    /// ```
    /// use slabcast_common::protocol::ProtocolVersions;
    ///
    /// let master = ProtocolVersions { oldest: 7, newest: 8 };
    /// let old_worker = ProtocolVersions { oldest: 6, newest: 7 };
    /// let new_worker = ProtocolVersions { oldest: 9, newest: 10 };
    /// assert_eq!(master.newest_common(old_worker), Some(7));
    /// assert_eq!(master.newest_common(new_worker), None);
    /// ```
    pub fn newest_common(self, other: ProtocolVersions) -> Option<u32> {
        let newest = self.newest.min(other.newest);
        (self.contains(newest) && other.contains(newest)).then_some(newest)
    }
}

/// `7`, or `7 to 8`.
impl fmt::Display for ProtocolVersions {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.oldest == self.newest {
            true => write!(f, "{}", self.newest),
            false => write!(f, "{} to {}", self.oldest, self.newest),
        }
    }
}
