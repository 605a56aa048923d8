//! Streams the numbers of a volume in order, as often as needed; each pass reads the file again.
//!
//! Formats with their samples in order are read in pieces of 128 KiB, by a thread of its own.
//! Others (DICOM, masks of VTK, Zarr) are read as a whole first.

use super::coding::{Coding, Form};
use crate::error::Problem;
use crate::numbers::{Beside, FileNumbers};
use crate::samples::{Endian, Number};
use crate::stream::{CHUNKS_AHEAD, ChunkReceiver, ChunkSender, NumberStream};
use crate::{Hints, formula};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::mpsc;

/// Numbers for each call of `each` in a pass over a volume in memory.
const STEP: usize = 1 << 16;

/// A volume whose numbers can be streamed in order, any number of times.
pub(crate) struct Planes {
    /// Name for people, without folders.
    pub(crate) name: String,
    /// Number type of the samples in the file, for people.
    pub(crate) file_type: String,
    /// Whether the file says where the patient's right, anterior and superior are.
    pub(crate) anatomical: bool,
    pub(crate) lattice: Lattice,
    /// Type of the numbers.
    pub(crate) number: Number,
    /// Map from numbers to values.
    pub(crate) rescale: ValueMap,
    /// Place of the numbers in the file, if they are stored uncompressed and in one piece.
    pub(crate) place: Option<Place>,
    /// Choices that the reader made, one sentence each.
    pub(crate) notes: Vec<String>,
    from: From,
}

/// A file, the byte at which its numbers begin, and their byte order.
pub(crate) type Place = (File, u64, Endian);

enum From {
    File { path: PathBuf, hints: Hints, endian: Endian },
    Codes(Samples, Coding),
    Numbers(FileNumbers),
}

impl Planes {
    /// Opens a file, a folder or a formula; reads its header alone where the format allows it.
    pub(crate) fn open(path: &Path, hints: &Hints) -> Result<Planes, Problem> {
        let whole = path.to_string_lossy().starts_with(formula::PREFIX)
            || (path.is_dir() && crate::zarr::is_node(path));
        if !whole {
            let stream = NumberStream::new(None);
            let beside = Beside::streaming(stream.clone());
            let header = Hints { beside: beside.clone(), ..hints.clone() };
            match crate::open_file(path, &header) {
                Err(_) if stream.refused() => {}
                Err(problem) => return Err(problem),
                Ok(mut opened) => {
                    opened.notes.extend(beside.take_notes());
                    if let (Some(layout), place) = stream.found()
                        && opened.volume.samples.is_empty()
                    {
                        let place = place.map(|(file, at)| (file, at, layout.endian));
                        let from = From::File {
                            path: path.into(),
                            hints: hints.clone(),
                            endian: layout.endian,
                        };
                        let rescale = opened.volume.summary.map;
                        let number = (layout.number, rescale);
                        let beside = (place, opened.notes);
                        return Ok(Planes::new(&opened.volume, number, beside, from));
                    }
                }
            }
        }
        let (opened, numbers) =
            crate::open_numbers(path, hints).map_err(|opening| opening.problem)?;
        if opened.volume.places.is_some() {
            return Err(Problem::unsupported(
                "content",
                "is in colours, which have no coarser levels",
                "take one of them with --channel, or write NRRD or NIfTI",
            ));
        }
        Ok(Planes::in_memory(opened.volume, numbers, opened.notes))
    }

    fn new(
        volume: &Volume,
        (number, rescale): (Number, ValueMap),
        (place, notes): (Option<Place>, Vec<String>),
        from: From,
    ) -> Planes {
        Planes {
            name: volume.name.clone(),
            file_type: volume.file_type.clone(),
            anatomical: volume.anatomical,
            lattice: volume.lattice,
            number,
            rescale,
            place,
            notes,
            from,
        }
    }

    /// Returns planes of a volume in memory. Their numbers are the file's own if `numbers` has
    /// them, else the volume's codes as [`number_form`] writes them.
    pub(crate) fn in_memory(
        volume: Volume,
        numbers: Option<FileNumbers>,
        notes: Vec<String>,
    ) -> Planes {
        let map = volume.summary.map;
        if let Some(numbers) = numbers.filter(|numbers| numbers.belong_to(map)) {
            let number = (numbers.number(), numbers.rescale);
            return Planes::new(&volume, number, (None, notes), From::Numbers(numbers));
        }
        let (number, form, rescale) = number_form(&volume);
        let samples = volume.samples.clone();
        let coding = Coding { number, form, rescale };
        Planes::new(&volume, (number, rescale), (None, notes), From::Codes(samples, coding))
    }

    /// Returns the size of all numbers, in bytes.
    pub(crate) fn bytes(&self) -> u64 {
        let samples: u64 = self.lattice.dims.iter().map(|&n| u64::from(n)).product();
        samples * self.number.bytes()
    }

    /// Calls `each` with all numbers in order, i fastest, as little-endian bytes.
    ///
    /// # Errors
    /// `each` returned an error; the file can't be read, is damaged, or changed since it was
    /// opened.
    pub(crate) fn pass(
        &self,
        each: &mut dyn FnMut(&[u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        match &self.from {
            From::Numbers(numbers) => numbers.for_each(STEP, false, each),
            From::Codes(codes, coding) => {
                let count = codes.len();
                for first in (0..count).step_by(STEP) {
                    each(&coding.numbers(&piece(codes, first..count.min(first + STEP))))?;
                }
                Ok(())
            }
            From::File { path, hints, endian } => self.read(path, hints, *endian, each),
        }
    }

    fn read(
        &self,
        path: &Path,
        hints: &Hints,
        endian: Endian,
        each: &mut dyn FnMut(&[u8]) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        let (to, from) = mpsc::sync_channel(CHUNKS_AHEAD);
        let (returned, spare) = mpsc::channel();
        let stream = NumberStream::new(Some(ChunkSender { to, spare }));
        let chunks = ChunkReceiver { from, spare: returned };
        let hints = Hints { beside: Beside::streaming(stream), ..hints.clone() };
        std::thread::scope(|scope| {
            let open = move || {
                let open = std::panic::AssertUnwindSafe(|| crate::open_file(path, &hints));
                std::panic::catch_unwind(open)
                    .unwrap_or_else(|panic| Err(Problem::panicked("data", &*panic)))
            };
            let builder = std::thread::Builder::new().name("slabcast-read".into());
            let reader = builder.spawn_scoped(scope, open).map_err(|e| Problem::io("data", &e))?;
            let size = self.number.bytes() as usize;
            let mut received = 0;
            while let Ok(mut chunk) = chunks.from.recv() {
                if endian == Endian::Big {
                    chunk.chunks_exact_mut(size).for_each(<[u8]>::reverse);
                }
                received += chunk.len() as u64;
                if received > self.bytes() {
                    break;
                }
                each(&chunk)?;
                let _ = chunks.spare.send(chunk);
            }
            // Dropping the receiver stops a reader that still has chunks to send.
            drop(chunks);
            let opened = reader.join().expect("panics were caught")?;
            let same = opened.volume.lattice == self.lattice && received == self.bytes();
            if same { Ok(()) } else { Err(changed()) }
        })
    }
}

/// Returns the error for a file whose content changed between two passes.
pub(crate) fn changed() -> Problem {
    Problem::new(
        crate::error::OpenErrorKind::Damaged,
        "file",
        "changed while it was read",
        "try again when nobody writes it",
    )
}

/// Returns a copy of a range of samples.
pub(crate) fn piece(samples: &Samples, range: std::ops::Range<usize>) -> Samples {
    match samples {
        Samples::U8(v) => Samples::U8(v[range].to_vec()),
        Samples::U16(v) => Samples::U16(v[range].to_vec()),
        Samples::F32(v) => Samples::F32(v[range].to_vec()),
    }
}

/// Returns the number type, the form of the codes and the map from numbers to values with which a
/// volume in memory is written: the file's own integers if its codes are shifted integers, else the
/// codes themselves.
fn number_form(volume: &Volume) -> (Number, Form, ValueMap) {
    let map = volume.summary.map;
    let kept = ValueMap::IDENTITY;
    match (&volume.samples, map) {
        (Samples::U8(_), ValueMap { scale: 1.0, offset: -128.0 }) => {
            (Number::I8, Form::Flipped, kept)
        }
        (Samples::U16(_), ValueMap { scale: 1.0, offset: -32768.0 }) => {
            (Number::I16, Form::Flipped, kept)
        }
        (Samples::U16(_), ValueMap { scale: 1.0, offset })
            if offset != 0.0 && offset.fract() == 0.0 && offset.abs() < 1e15 =>
        {
            let (lo, hi) = volume.summary.range();
            let holds = |n: &Number| n.limits().is_some_and(|(a, b)| a <= lo && hi <= b);
            let own = Number::named(&volume.file_type);
            let number = own.into_iter().chain(Number::INTEGERS).find(holds);
            let min = offset as i128;
            let form = Form::Integers { min, max: min + i128::from(u16::MAX) };
            (number.unwrap_or(Number::I64), form, kept)
        }
        (Samples::U8(_), map) => (Number::U8, Form::Same, map),
        (Samples::U16(_), map) => (Number::U16, Form::Same, map),
        (Samples::F32(_), map) => (Number::F32, Form::Floats { limit: None }, map),
    }
}

/// Copies a box out of a volume of `dims` numbers of `size` bytes, i fastest.
pub(crate) fn cut_bytes(
    all: &[u8],
    size: usize,
    dims: [u32; 3],
    lo: [u32; 3],
    hi: [u32; 3],
) -> Vec<u8> {
    let [nx, ny, _] = dims.map(|n| n as usize);
    let count: usize = (0..3).map(|a| (hi[a] - lo[a]) as usize).product();
    let mut to = Vec::with_capacity(count * size);
    for z in lo[2] as usize..hi[2] as usize {
        for y in lo[1] as usize..hi[1] as usize {
            let row = (z * ny + y) * nx;
            to.extend_from_slice(
                &all[(row + lo[0] as usize) * size..(row + hi[0] as usize) * size],
            );
        }
    }
    to
}
