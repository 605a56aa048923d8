//! Makes all levels of a volume in one pass over its numbers.
//!
//! A level collects 64 planes, surveys and writes them, halves them, and adds the result to the
//! planes of the next level. So each level holds at most 64 of its planes. With nx x ny samples a
//! plane, `c` bytes a code and `n` bytes a number in the file (0 unless codes round the numbers, so
//! that both are held), a pass takes at most
//!
//! ```text
//! 64 nx ny (1.5 c + n) + 192 MiB
//! ```
//!
//! bytes: four thirds for all levels, an eighth for the planes that were just halved, 64 MiB for
//! the sets of codes of blocks, and the rest for pieces that are read or written
//! ([`memory_bytes`]).

use super::coding::Coding;
use super::ome_zarr::LevelWriter;
use super::planes::cut_bytes;
use super::survey::{Counter, Survey, Surveyed};
use super::{BLOCK_EDGE, ValueBins, halved};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::reserve;
use slabcast_common::volume::{Lattice, Samples};

/// Bytes of memory that a pass takes beside the planes.
const BESIDE_BYTES: u64 = 192 << 20;

/// Returns the most memory that one pass takes, in bytes; `levels` tells whether there are coarser
/// levels.
pub(crate) fn memory_bytes(lattice: &Lattice, coding: &Coding, levels: bool) -> u64 {
    let [nx, ny, nz] = lattice.dims.map(u64::from);
    let code = coding.kind().bytes() as u64;
    let number = if coding.rounds() { coding.number.bytes() } else { 0 };
    // In halves of bytes.
    let halves = if levels { 3 * code } else { 2 * code } + 2 * number;
    let planes = nz.min(BLOCK_EDGE.into());
    nx.saturating_mul(ny).saturating_mul(planes * halves / 2).saturating_add(BESIDE_BYTES)
}

/// A level that is being made.
struct Level {
    lattice: Lattice,
    survey: Survey,
    writer: Option<LevelWriter>,
    /// Planes that wait to be surveyed, as codes: fewer than 64.
    codes: Samples,
    /// The waiting planes as the file's own numbers, if codes round them.
    own: Vec<u8>,
    /// Number of samples in 64 planes.
    full: usize,
    /// Number of planes surveyed.
    done: u32,
}

/// All levels of a volume that are made while its numbers arrive in order.
pub(crate) struct Cascade<'a> {
    coding: &'a Coding,
    levels: Vec<Level>,
}

impl<'a> Cascade<'a> {
    /// Begins levels on these lattices. `writers` has one for each level; `None` surveys the levels
    /// without writing them.
    pub(crate) fn new(
        lattices: &[Lattice],
        coding: &'a Coding,
        guess: ValueBins,
        counter: Counter,
        writers: Option<Vec<LevelWriter>>,
    ) -> Result<Cascade<'a>, Problem> {
        let mut writers = writers.map(Vec::into_iter);
        let mut counter = Some(counter);
        let mut levels = Vec::new();
        for (level, &lattice) in lattices.iter().enumerate() {
            let plane = lattice.dims[0] as usize * lattice.dims[1] as usize;
            let full = plane * BLOCK_EDGE as usize;
            let room = plane * lattice.dims[2].min(BLOCK_EDGE) as usize;
            let mut codes = Samples::empty(coding.kind());
            match &mut codes {
                Samples::U8(v) => reserve(v, room)?,
                Samples::U16(v) => reserve(v, room)?,
                Samples::F32(v) => reserve(v, room)?,
            }
            let mut own = Vec::new();
            if level == 0 && coding.rounds() {
                reserve(&mut own, room * coding.number.bytes() as usize)?;
            }
            let form = (coding.map(), coding.kind());
            let survey = Survey::new(lattice, form, guess, counter.take());
            let writer = writers.as_mut().and_then(Iterator::next);
            levels.push(Level { lattice, survey, writer, codes, own, full, done: 0 });
        }
        Ok(Cascade { coding, levels })
    }

    /// Adds the next numbers of level 0, as little-endian bytes that end between numbers.
    ///
    /// # Errors
    /// There are more numbers than the volume has, or a level can't be written.
    pub(crate) fn push(&mut self, mut bytes: &[u8]) -> Result<(), Problem> {
        let size = self.coding.number.bytes() as usize;
        while !bytes.is_empty() {
            let first = &mut self.levels[0];
            if first.done >= first.lattice.dims[2] {
                return Err(super::planes::changed());
            }
            let room = (first.full - first.codes.len()) * size;
            let (now, rest) = bytes.split_at(room.min(bytes.len()));
            self.coding.encode(now, &mut first.codes);
            if self.coding.rounds() {
                first.own.extend_from_slice(now);
            }
            bytes = rest;
            self.flush_full(0)?;
        }
        Ok(())
    }

    /// Surveys, writes and halves the waiting planes of a level if there are 64, or if they are the
    /// last.
    fn flush_full(&mut self, level: usize) -> Result<(), Problem> {
        let this = &self.levels[level];
        let [nx, ny, nz] = this.lattice.dims;
        let planes = this.codes.len() / (nx as usize * ny as usize);
        let whole = planes * nx as usize * ny as usize == this.codes.len();
        if this.codes.len() == this.full || (whole && this.done + planes as u32 == nz) {
            self.flush(level, planes as u32)?;
        }
        Ok(())
    }

    fn flush(&mut self, level: usize, planes: u32) -> Result<(), Problem> {
        let coding = self.coding;
        let (these, next) = self.levels.split_at_mut(level + 1);
        let Level { lattice, survey, writer, codes, own, done, .. } = &mut these[level];
        let [nx, ny, _] = lattice.dims;
        let dims = [nx, ny, planes];
        let size = coding.number.bytes() as usize;
        let codes_seen: &Samples = codes;
        let own_seen: &[u8] = own;
        let z = *done / BLOCK_EDGE;
        let halve =
            || (!next.is_empty()).then(|| coding.as_stored(halved(lattice, dims, codes_seen)));
        let look = || match writer {
            None => survey.slab(codes_seen, |_, _, _| (), |_, _| Ok(())),
            Some(writer) => {
                let shape = writer.chunk_shape();
                let pack = |lo: [u32; 3], hi: [u32; 3], part: Samples| {
                    let numbers = match own_seen.is_empty() {
                        true => coding.numbers_of(part),
                        false => cut_bytes(own_seen, size, dims, lo, hi),
                    };
                    let box_dims = std::array::from_fn(|a| hi[a] - lo[a]);
                    super::ome_zarr::packed(numbers, size, box_dims, shape)
                };
                survey.slab(codes_seen, pack, |square, chunks| writer.add(square, z, chunks))
            }
        };
        let (coarse, looked) = rayon::join(halve, look);
        looked?;
        *done += planes;
        clear(codes);
        own.clear();
        if let Some(coarse) = coarse {
            append(&mut next[0].codes, coarse);
            self.flush_full(level + 1)?;
        }
        Ok(())
    }

    /// Ends all levels and returns the results of their surveys, the finest first.
    ///
    /// # Errors
    /// Numbers are missing, or a level can't be written.
    pub(crate) fn finish(self) -> Result<Vec<Surveyed>, Problem> {
        let mut found = Vec::new();
        for level in self.levels {
            if level.done != level.lattice.dims[2] {
                return Err(super::planes::changed());
            }
            if let Some(writer) = level.writer {
                writer.finish()?;
            }
            found.push(level.survey.finish());
        }
        Ok(found)
    }
}

fn clear(samples: &mut Samples) {
    match samples {
        Samples::U8(v) => v.clear(),
        Samples::U16(v) => v.clear(),
        Samples::F32(v) => v.clear(),
    }
}

fn append(to: &mut Samples, from: Samples) {
    match (to, from) {
        (Samples::U8(to), Samples::U8(from)) => to.extend(from),
        (Samples::U16(to), Samples::U16(from)) => to.extend(from),
        (Samples::F32(to), Samples::F32(from)) => to.extend(from),
        _ => panic!("levels of one type"),
    }
}

/// Checks that a pass of `need` bytes of memory fits into `most`. `remedy` ends the error message.
pub(crate) fn check_memory(need: u64, most: u64, remedy: &str) -> Result<(), Problem> {
    match need <= most {
        true => Ok(()),
        false => Err(Problem::new(
            OpenErrorKind::TooLarge,
            "memory",
            format!("{} MiB are needed and {} MiB are there", need >> 20, most >> 20),
            remedy,
        )),
    }
}
