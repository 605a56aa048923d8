//! Streams a file's numbers in order, without holding them.
//!
//! Every reader of a format ends in [`crate::samples::read`], which makes a list of samples. With a
//! [`NumberStream`], that function sends the bytes on as they are read, and the reader returns a
//! volume without samples, with the file's lattice, names and rescale. So every format that is read
//! in the order of its samples can be streamed. A reader that needs all samples at once refuses
//! ([`NumberStream::refuse`]).

use crate::error::Problem;
use crate::samples::Layout;
use slabcast_common::volume::{Lattice, SampleKind, Samples, ValueMap, ValueSummary, Volume};
use std::fs::File;
#[cfg(feature = "zarr")]
use std::sync::mpsc::Sender;
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// Chunks of 128 KiB that a reader may be ahead of the receiver: 64 MiB, so that the disk has work
/// while planes are surveyed.
#[cfg(feature = "zarr")]
pub(crate) const CHUNKS_AHEAD: usize = 512;

/// Stream of the numbers of one file. Clones share it.
#[derive(Clone, Debug, Default)]
pub(crate) struct NumberStream(Arc<Mutex<State>>);

#[derive(Debug, Default)]
struct State {
    layout: Option<Layout>,
    place: Option<(File, u64)>,
    /// Whether the format can't be read in order.
    refused: bool,
    sender: Option<ChunkSender>,
}

/// Sends chunks of numbers, and gets spare ones back.
#[derive(Debug)]
pub(crate) struct ChunkSender {
    pub(crate) to: SyncSender<Vec<u8>>,
    pub(crate) spare: Receiver<Vec<u8>>,
}

/// Receives chunks of numbers, in the file's byte order, and returns them for the next.
#[cfg(feature = "zarr")]
pub(crate) struct ChunkReceiver {
    pub(crate) from: Receiver<Vec<u8>>,
    pub(crate) spare: Sender<Vec<u8>>,
}

impl ChunkSender {
    /// Sends the next bytes.
    ///
    /// # Errors
    /// The receiver was dropped.
    pub(crate) fn send(&mut self, bytes: &[u8]) -> Result<(), Problem> {
        let mut chunk = self.spare.try_recv().unwrap_or_default();
        chunk.clear();
        chunk.extend_from_slice(bytes);
        self.to.send(chunk).map_err(|_| Problem::malformed("data", "are not wanted any more", ""))
    }
}

impl NumberStream {
    /// Returns a stream for all numbers of a file, or without a sender for its header alone.
    #[cfg(feature = "zarr")]
    pub(crate) fn new(sender: Option<ChunkSender>) -> NumberStream {
        NumberStream(Arc::new(Mutex::new(State { sender, ..State::default() })))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the layout of the numbers that follow. Returns their sender; `None` if only the header
    /// is wanted.
    ///
    /// # Errors
    /// The file has a second list of numbers, such as a mask.
    pub(crate) fn begin(&self, layout: &Layout) -> Result<Option<ChunkSender>, Problem> {
        let mut state = self.state();
        if state.layout.replace(*layout).is_some() {
            drop(state);
            return Err(self.refuse());
        }
        Ok(state.sender.take())
    }

    /// Marks the file as one that can't be read in order, and returns the error for it.
    pub(crate) fn refuse(&self) -> Problem {
        self.state().refused = true;
        Problem::unsupported(
            "data",
            "can't be read slice by slice",
            "convert it on a machine with more memory than it takes",
        )
    }

    /// Returns whether the file can't be read in order.
    #[cfg(feature = "zarr")]
    pub(crate) fn refused(&self) -> bool {
        self.state().refused
    }

    /// Sets the place at which the numbers begin, in a file that stores them uncompressed.
    pub(crate) fn set_place(&self, file: Option<File>, at: std::io::Result<u64>) {
        self.state().place = file.zip(at.ok());
    }

    /// Removes the place, since the numbers do not lie in one piece.
    pub(crate) fn forget_place(&self) {
        self.state().place = None;
    }

    /// Returns the layout of the numbers, and their place if a file stores them uncompressed.
    #[cfg(feature = "zarr")]
    pub(crate) fn found(&self) -> (Option<Layout>, Option<(File, u64)>) {
        let mut state = self.state();
        (state.layout, state.place.take())
    }
}

/// Returns a volume of `samples`; a volume without samples if a stream took them.
pub(crate) fn volume(
    name: impl Into<String>,
    file_type: impl Into<String>,
    anatomical: bool,
    lattice: Lattice,
    samples: Samples,
    map: ValueMap,
) -> Volume {
    if !samples.is_empty() || lattice.is_empty() {
        return Volume::new(name, file_type, anatomical, lattice, samples, map);
    }
    let summary = ValueSummary {
        kind: SampleKind::U8,
        map,
        min_code: 0.0,
        max_code: 0.0,
        histogram: Vec::new(),
        nan: 0,
        infinite: 0,
        anatomical,
        core: None,
        palette: None,
    };
    let (name, file_type) = (name.into(), file_type.into());
    Volume { name, file_type, anatomical, lattice, samples, summary, coarse: None, places: None }
}
