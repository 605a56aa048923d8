//! The file of an uploaded volume: its header as `VolumeHeader` of `render.proto`, and its samples.
//!
//! Clients read files, in any format and with any flags, and send samples. So a master never parses
//! files of strangers, and a volume has the digest that it had at the client.
//!
//! | bytes | |
//! |---|---|
//! | 16 | [`MAGIC`] |
//! | 4 | length of the header, little-endian |
//! | ... | the header |
//! | ... | the samples, little-endian, i fastest |

use super::{Source, Unreadable};
use prost::Message;
use slabcast_common::volume::{Samples, Volume};
use slabcast_proto::convert;
use slabcast_proto::model::VolumeHeader;
use slabcast_volumes::blocks::MemorySource;

use std::fs::File;
use std::io::{self, BufReader, Read};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// First bytes of the file.
const MAGIC: [u8; 16] = *b"slabcast volume\n";

/// Bytes of the longest header: histograms have at most 5 KiB, a palette 256.
const MAX_HEADER: u32 = 512 << 10;

/// Bytes that are read at a time.
const PIECE: usize = 1 << 20;

/// An uploaded volume's file.
pub(super) struct Stored {
    pub(super) path: PathBuf,
    /// Bytes of the whole file.
    pub(super) file_bytes: u64,
    pub(super) header: VolumeHeader,
}

/// Returns the bytes that come before the samples.
pub(super) fn head(header: &VolumeHeader) -> Vec<u8> {
    let encoded = convert::volume_header_to_wire(header).encode_to_vec();
    let length = (encoded.len() as u32).to_le_bytes();
    [&MAGIC[..], &length, &encoded].concat()
}

/// Reads the header of a file, and leaves the reader at its samples.
fn read_head(file: &mut impl Read) -> io::Result<VolumeHeader> {
    let bad = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what.to_owned());
    let mut begin = [0; 20];
    file.read_exact(&mut begin)?;
    let length = u32::from_le_bytes([begin[16], begin[17], begin[18], begin[19]]);
    if begin[..16] != MAGIC || length > MAX_HEADER {
        return Err(bad("is no uploaded volume"));
    }
    let mut encoded = vec![0; length as usize];
    file.read_exact(&mut encoded)?;
    let header = prost::Message::decode(&encoded[..]).map_err(|e| bad(&e.to_string()))?;
    convert::volume_header_from_wire(header).map_err(|e| bad(&e.to_string()))
}

/// Reads the header of an uploaded volume's file, and checks that its samples are there.
pub(super) fn find(path: &Path) -> io::Result<Stored> {
    let mut file = File::open(path)?;
    let header = read_head(&mut file)?;
    let file_bytes = file.metadata()?.len();
    let wanted = head(&header).len() as u64 + super::sample_bytes(&header.info);
    if file_bytes != wanted {
        let what = format!("has {file_bytes} bytes instead of {wanted}");
        return Err(io::Error::new(io::ErrorKind::InvalidData, what));
    }
    Ok(Stored { path: path.to_owned(), file_bytes, header })
}

/// Reads an uploaded volume whose samples take at most `most_bytes`.
pub(super) fn read(path: &Path, most_bytes: u64) -> Result<Source, Unreadable> {
    let unreadable = |reason: String, is_too_large| Unreadable { reason, is_too_large };
    let stored = find(path).map_err(|e| unreadable(format!("its file: {e}"), false))?;
    let header = stored.header;
    let bytes = super::memory_bytes(&header.info);
    if bytes > most_bytes {
        let reason = format!(
            "{}: its samples take {} MiB, and the master has {} MiB for volumes (--volume-memory)",
            header.name,
            bytes.div_ceil(1 << 20),
            most_bytes >> 20
        );
        return Err(unreadable(reason, true));
    }
    let samples = read_samples(path, &header)
        .map_err(|e| unreadable(format!("{}: its file: {e}", header.name), false))?;
    let VolumeHeader { name, file_type, info, orientation } = header;
    let (coarse, lattice, summary) = (info.coarse(), info.lattice, info.summary);
    let anatomical = summary.anatomical;
    let volume = match (summary.palette, samples) {
        (Some(palette), Samples::U16(places)) => {
            let shown = name.clone();
            Volume::coloured(name, file_type, anatomical, lattice, palette, places)
                .map_err(|e| unreadable(format!("{shown}: its palette {e}"), false))?
        }
        (_, samples) => Volume::new(name, file_type, anatomical, lattice, samples, summary.map),
    };
    let volume = Volume { coarse, ..volume };
    if volume.digest() != info.digest {
        let reason = format!(
            "{}: its file is damaged: the digest of its samples is another; remove it and upload it \
             again",
            volume.name
        );
        return Err(unreadable(reason, false));
    }
    let source = MemorySource::new(Arc::new(volume), info.digest);
    Ok((Arc::new(source), orientation))
}

fn read_samples(path: &Path, header: &VolumeHeader) -> io::Result<Samples> {
    let mut file = BufReader::with_capacity(PIECE, File::open(path)?);
    read_head(&mut file)?;
    let count = header.info.lattice.len();
    let kind = header.info.summary.code_kind();
    let no_memory = |_| io::Error::new(io::ErrorKind::OutOfMemory, "no memory for its samples");
    let mut piece = vec![0; PIECE];
    let mut samples = Samples::empty(kind);
    match &mut samples {
        Samples::U8(v) => v.try_reserve_exact(count).map_err(no_memory)?,
        Samples::U16(v) => v.try_reserve_exact(count).map_err(no_memory)?,
        Samples::F32(v) => v.try_reserve_exact(count).map_err(no_memory)?,
    }
    let mut left = count * kind.bytes();
    while left > 0 {
        let n = left.min(PIECE);
        file.read_exact(&mut piece[..n])?;
        left -= n;
        push(&mut samples, &piece[..n]);
    }
    Ok(samples)
}

/// Appends whole samples from little-endian bytes.
fn push(samples: &mut Samples, bytes: &[u8]) {
    debug_assert_eq!(bytes.len() % samples.kind().bytes(), 0);
    match samples {
        Samples::U8(v) => v.extend_from_slice(bytes),
        Samples::U16(v) => {
            v.extend(bytes.as_chunks().0.iter().map(|b: &[u8; 2]| u16::from_le_bytes(*b)));
        }
        Samples::F32(v) => {
            v.extend(bytes.as_chunks().0.iter().map(|b: &[u8; 4]| f32::from_le_bytes(*b)));
        }
    }
}

const _: () = assert!(PIECE.is_multiple_of(4), "pieces hold whole samples");
