//! Shared by the NRRD and MetaImage readers: header lines, and samples from one data file or a list
//! of them, with skips and encodings.

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::limit::ByteCap;
use crate::pick::Part;
use crate::samples::{self, DIM_MAX, Layout, SKIP_MAX_BYTES, Supply};
use crate::source::{self, Folder, Notes, Source};
use crate::unpack::{Encoding, wrapped};
use slabcast_common::volume::{Samples, ValueMap};
use std::collections::VecDeque;
use std::io::{BufRead, Read, Seek, SeekFrom};
use std::path::Path;

/// Longest header: room for ten thousand lines, since some programs write thousands of DICOM fields
/// into one. Bounds the memory for a header that does not end.
const HEADER_MAX_BYTES: u64 = 1 << 20;

/// Iterates over the lines of a header.
pub(crate) struct HeaderLines<'a> {
    source: &'a mut Source,
    /// Remedy for a header without an end, for error messages.
    remedy: &'static str,
    /// Lines read so far.
    number: usize,
    consumed_bytes: u64,
    line: Vec<u8>,
}

impl<'a> HeaderLines<'a> {
    /// Reads lines from the current position of `source`.
    pub(crate) fn new(source: &'a mut Source, remedy: &'static str) -> Self {
        HeaderLines { source, remedy, number: 0, consumed_bytes: 0, line: Vec::new() }
    }

    /// Returns the number (from 1) and text of the next line, without its line end; `None` at the
    /// end of the file.
    pub(crate) fn next(&mut self) -> Result<Option<(usize, String)>, Problem> {
        self.line.clear();
        let left = HEADER_MAX_BYTES - self.consumed_bytes;
        let mut reader = self.source.reader.by_ref().take(left);
        let n = reader.read_until(b'\n', &mut self.line).map_err(|e| Problem::io("header", &e))?;
        self.consumed_bytes += n as u64;
        self.number += 1;
        if self.consumed_bytes == HEADER_MAX_BYTES {
            return Err(Problem::malformed(
                "header",
                format!("does not end within {HEADER_MAX_BYTES} bytes"),
                self.remedy,
            ));
        }
        let text = String::from_utf8_lossy(&self.line);
        let text = text.trim_end_matches(['\n', '\r']);
        Ok((n > 0).then(|| (self.number, text.to_string())))
    }

    /// Returns the bytes of the lines read so far.
    pub(crate) fn consumed_bytes(&self) -> u64 {
        self.consumed_bytes
    }
}

/// Number of bytes to skip before the samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Skip {
    /// Bytes of the file if the data are raw, else bytes of the decoded data.
    Bytes(u64),
    /// The samples are the last bytes of the file.
    FromEnd,
}

/// Storage of the samples in a file: encoding and bytes to skip.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Storage {
    pub(crate) encoding: Encoding,
    pub(crate) line_skip: u64,
    pub(crate) byte_skip: Skip,
    /// Name of the format's field for `byte_skip`, for error messages.
    pub(crate) skip_field: &'static str,
}

/// Reads the samples from a source at the start of its `len` bytes of data. `part` says which of
/// the file's samples they are, if they are not all.
pub(crate) fn read(
    source: Source,
    len: u64,
    storage: &Storage,
    layout: &Layout,
    part: Option<&Part>,
) -> Result<(Samples, ValueMap), Problem> {
    let cap = source.cap.clone();
    let layout_of_file = storage.decoded_layout(layout);
    let Some(part) = part else {
        let (mut reader, supply) = open(source, len, storage, layout, layout.bytes())?;
        return samples::read(&mut *reader, supply, &layout_of_file, cap);
    };
    let whole = part.whole_bytes();
    if storage.encoding == Encoding::Raw && part.is_run() {
        // Bytes before the part are not read.
        let start = part.start();
        let skip = match storage.byte_skip {
            Skip::Bytes(skip) if len.saturating_sub(skip) < part.end() => {
                return Err(samples::truncated(part.end(), len.saturating_sub(skip)));
            }
            Skip::Bytes(skip) => Skip::Bytes(skip + start),
            Skip::FromEnd => Skip::FromEnd,
        };
        let storage = Storage { byte_skip: skip, ..*storage };
        // `FromEnd` leaves as many bytes as are asked for.
        let share = if skip == Skip::FromEnd { whole - start } else { layout.bytes() };
        let (mut reader, supply) = open(source, len, &storage, layout, share)?;
        return samples::read(&mut *reader, supply, &layout_of_file, cap);
    }
    let (reader, supply) = open(source, len, storage, layout, whole)?;
    read_part(reader, supply, part, &layout_of_file, cap)
}

/// Reads a part of the samples that `reader` gives.
pub(crate) fn read_part(
    reader: impl Read + Send,
    supply: Supply,
    part: &Part,
    layout: &Layout,
    cap: ByteCap,
) -> Result<(Samples, ValueMap), Problem> {
    if let Some(stream) = cap.beside.stream() {
        stream.forget_place();
    }
    let (end, need) = (part.end(), layout.bytes());
    let supply = match supply {
        Supply::Plain { have } if have < end => return Err(samples::truncated(end, have)),
        Supply::Plain { .. } => Supply::Plain { have: need },
        Supply::Encoded { bytes, ratio, .. } if end / ratio > bytes => {
            return Err(samples::truncated(end, bytes.saturating_mul(ratio)));
        }
        encoded => encoded,
    };
    samples::read(&mut part.reader(reader), supply, layout, cap)
}

/// Reads the samples from files in the header's folder or below it; each holds an equal share.
/// `field` is the header's name for the files, `cap` the limit of their bytes together; notes on
/// padding go to `notes`. `part` says which of the files' samples are read, if not all.
pub(crate) fn read_files(
    folder: &Path,
    (names, field): (&[String], &str),
    (cap, notes): (ByteCap, &Notes),
    storage: &Storage,
    (layout, part): (&Layout, Option<&Part>),
) -> Result<(Samples, ValueMap), Problem> {
    let in_file = |name: &str| format!("{field} {}", quoted(name));
    let folder = Folder::open(folder, field)?;
    if let [name] = names {
        let source = Source { cap, notes: notes.clone(), ..folder.named(name, field)? };
        let len = source.len;
        return read(source, len, storage, layout, part).map_err(|mut p| {
            p.field = in_file(name);
            p
        });
    }
    let need = part.map_or(layout.bytes(), Part::whole_bytes);
    if names.is_empty() || names.len() as u64 > DIM_MAX || !need.is_multiple_of(names.len() as u64)
    {
        return Err(Problem::malformed(
            field,
            format!("{} files can't share {need} bytes evenly", names.len()),
            "correct the list or the sizes",
        ));
    }
    let share = need / names.len() as u64;
    // Check all files before taking memory.
    let mut parts = VecDeque::with_capacity(names.len());
    let mut total: Option<Supply> = None;
    for name in names {
        let source = folder.named(name, field)?;
        let len = source.len;
        let name_file = |mut p: Problem| {
            p.field = in_file(name);
            p
        };
        let (_, supply) = open(source, len, storage, layout, share).map_err(name_file)?;
        total = Some(match (total, supply) {
            (_, Supply::Plain { have }) if have < share => {
                return Err(name_file(samples::truncated(share, have)));
            }
            (None, Supply::Plain { .. }) => Supply::Plain { have: share },
            (Some(Supply::Plain { have }), _) => Supply::Plain { have: have + share },
            (None, encoded) => encoded,
            (
                Some(Supply::Encoded { bytes: before, .. }),
                Supply::Encoded { name, bytes, ratio },
            ) => Supply::Encoded { name, bytes: before + bytes, ratio },
            (Some(encoded), Supply::Plain { .. }) => encoded,
        });
        parts.push_back(ListedFile { shown: in_file(name), name });
    }
    let supply = total.expect("there is a file");
    let mut files =
        FileChain { folder: &folder, parts, storage, layout, share, notes, current: None };
    let layout = storage.decoded_layout(layout);
    if let Some(stream) = cap.beside.stream() {
        stream.forget_place();
    }
    let read = match part {
        Some(part) => read_part(files, supply, part, &layout, cap),
        None => samples::read(&mut files, supply, &layout, cap),
    };
    read.map_err(|mut p| {
        if p.field == "data" {
            p.field = field.into();
        }
        p
    })
}

impl Storage {
    /// Returns the layout with the byte order that the encoding's reader gives.
    fn decoded_layout(&self, layout: &Layout) -> Layout {
        match self.encoding.has_order() {
            true => *layout,
            false => Layout { endian: samples::Endian::Little, ..*layout },
        }
    }
}

/// Opens a reader of `share` bytes of samples, at the first of them.
fn open<'a>(
    mut source: Source,
    len: u64,
    storage: &Storage,
    layout: &Layout,
    share: u64,
) -> Result<(Box<dyn Read + Send + 'a>, Supply), Problem> {
    let skips_past_end = |field: &str| {
        Problem::malformed(field, "skips past the end of the data", "correct the skip")
    };
    let io = |e: std::io::Error| Problem::io("data", &e);
    let skipped = source::skip_lines(&mut source.reader, storage.line_skip)
        .map_err(io)?
        .ok_or_else(|| skips_past_end("line skip"))?;
    let left = len.saturating_sub(skipped);
    if storage.encoding == Encoding::Raw {
        let skip = match storage.byte_skip {
            Skip::Bytes(skip) if skip > left => return Err(skips_past_end(storage.skip_field)),
            Skip::Bytes(skip) => skip,
            Skip::FromEnd => left.saturating_sub(share),
        };
        if skip > 0 {
            source.reader.seek(SeekFrom::Current(skip as i64)).map_err(io)?;
        }
        if let Some(stream) = source.cap.beside.stream() {
            stream.set_place(source.reader.get_ref().file(), source.reader.stream_position());
        }
        return Ok((Box::new(source.reader), Supply::Plain { have: left - skip }));
    }
    let Skip::Bytes(skip) = storage.byte_skip else {
        return Err(Problem::malformed(
            storage.skip_field,
            "-1 counts from the end, which is known of raw data alone",
            "give the number of bytes, or save it uncompressed",
        ));
    };
    if skip > SKIP_MAX_BYTES {
        return Err(Problem::unsupported(
            storage.skip_field,
            format!("{skip} is more than the {SKIP_MAX_BYTES} that are skipped inside packed data"),
            "save it again without a skip",
        ));
    }
    let (mut reader, supply) = storage
        .encoding
        .open(Box::new(source.reader), left, layout.number, &source.notes)
        .map_err(io)?;
    if skip > 0 {
        match source::skip_bytes(&mut *reader, skip) {
            Ok(true) => {}
            Ok(false) => return Err(skips_past_end(storage.skip_field)),
            Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
                return Err(skips_past_end(storage.skip_field));
            }
            Err(e) => {
                return Err(Problem::new(
                    OpenErrorKind::Damaged,
                    "data",
                    format!("is damaged before the first sample ({e})"),
                    "get the file again",
                ));
            }
        }
    }
    Ok((reader, supply))
}

struct ListedFile<'a> {
    /// The field and the file's name, for messages.
    shown: String,
    /// Name in the folder.
    name: &'a str,
}

/// Reads files one after another; each is opened when its turn comes.
struct FileChain<'a> {
    folder: &'a Folder,
    parts: VecDeque<ListedFile<'a>>,
    storage: &'a Storage,
    layout: &'a Layout,
    /// Bytes of samples in each file.
    share: u64,
    notes: &'a Notes,
    /// The current file: its name, its reader, and the bytes still to come.
    current: Option<(String, Box<dyn Read + Send>, u64)>,
}

impl Read for FileChain<'_> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        loop {
            let Some((name, reader, left)) = &mut self.current else {
                let Some(ListedFile { shown: name, name: file }) = self.parts.pop_front() else {
                    return Ok(0);
                };
                let name_file = |mut p: Problem| {
                    p.field = name.clone();
                    wrapped(p)
                };
                let source = self.folder.named(file, "data").map_err(name_file)?;
                let source = Source { notes: self.notes.clone(), ..source };
                let len = source.len;
                let (reader, _) =
                    open(source, len, self.storage, self.layout, self.share).map_err(name_file)?;
                self.current = Some((name, reader, self.share));
                continue;
            };
            let want = (buf.len() as u64).min(*left) as usize;
            if want == 0 && *left > 0 {
                return Ok(0);
            }
            let damaged = |what: String, remedy: &str| {
                wrapped(Problem::new(OpenErrorKind::Damaged, name.clone(), what, remedy))
            };
            if *left == 0 {
                let packed = self.storage.encoding != Encoding::Raw;
                let end = match reader.read(&mut [0]) {
                    Err(e) if packed && e.kind() == std::io::ErrorKind::UnexpectedEof => {
                        return Err(damaged(
                            "ends before the checksum of its stream".into(),
                            "get the whole file",
                        ));
                    }
                    end => end,
                };
                if packed && end? > 0 {
                    return Err(damaged(
                        format!("goes on after its share of {} bytes", self.share),
                        "correct the list or the sizes",
                    ));
                }
                self.current = None;
                continue;
            }
            return match reader.read(&mut buf[..want]) {
                Ok(0) => Err(damaged(
                    format!("ends before its share of {} bytes", self.share),
                    "get the whole file, or correct the list or the sizes",
                )),
                Ok(n) => {
                    *left -= n as u64;
                    Ok(n)
                }
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => Err(e),
                Err(e) if e.get_ref().is_some_and(|inner| inner.is::<Problem>()) => Err(e),
                Err(e) => Err(damaged(format!("can't be read ({e})"), "get the file again")),
            };
        }
    }
}

/// Returns the file names that printf would make of `pattern` and `min`, `min + step`, ... up to
/// `max`. `None` unless the pattern has exactly one integer conversion, such as `%d` or `%03d`.
pub(crate) fn numbered_names(pattern: &str, min: i64, max: i64, step: i64) -> Option<Vec<String>> {
    let (before, after) = pattern.split_once('%')?;
    let digits = after.find(|c: char| !c.is_ascii_digit())?;
    let (width, after) = after.split_at(digits);
    let after = after.strip_prefix(['d', 'i', 'u'])?;
    if step == 0 || before.contains('%') || after.contains('%') || width.len() > 2 {
        return None;
    }
    let zeros = width.starts_with('0');
    let width: usize = if width.is_empty() { 0 } else { width.parse().ok()? };
    let mut names = Vec::new();
    let mut n = min;
    // At most one more than the limit, so that the caller sees that there are too many.
    while (if step > 0 { n <= max } else { n >= max }) && names.len() as u64 <= DIM_MAX {
        names.push(match zeros {
            true => format!("{before}{n:0width$}{after}"),
            false => format!("{before}{n:width$}{after}"),
        });
        n = n.checked_add(step)?;
    }
    Some(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbered_file_names_follow_printf() {
        let some = |list: &[&str]| Some(list.iter().map(|s| s.to_string()).collect::<Vec<_>>());
        assert_eq!(
            numbered_names("a%03d.raw", 8, 12, 2),
            some(&["a008.raw", "a010.raw", "a012.raw"])
        );
        assert_eq!(numbered_names("%d", 1, -1, -1), some(&["1", "0", "-1"]));
        assert_eq!(numbered_names("s/%2i.z", 9, 10, 1), some(&["s/ 9.z", "s/10.z"]));
        assert_eq!(numbered_names("%d", 3, 1, 1), some(&[]));
        for bad in ["a.raw", "%s", "%5.1f", "%", "%d%d", "%%d", "%999d", "%"] {
            assert_eq!(numbered_names(bad, 1, 2, 1), None, "{bad}");
        }
        assert_eq!(numbered_names("%d", 1, 2, 0), None);
        assert_eq!(numbered_names("%d", i64::MAX - 1, i64::MAX, 1), None);
        assert_eq!(numbered_names("%d", 0, i64::MAX, 1).unwrap().len() as u64, DIM_MAX + 1);
    }
}
