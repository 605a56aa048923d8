//! The lines of a header, and the samples of its data file or files: skips, encoding, and lists of
//! files. What NRRD and MetaImage have in common.

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::{self, DIM_MAX, Layout, SKIP_MAX_BYTES, Supply};
use crate::source::{self, Source};
use crate::unpack::{Encoding, wrapped};
use slabcast_common::volume::{Samples, ValueMap};
use std::collections::VecDeque;
use std::io::{BufRead, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Longest header: room for ten thousand lines; some programs write thousands of DICOM fields into
/// one. It bounds the memory that a file whose header does not end can take.
const HEADER_MAX_BYTES: u64 = 1 << 20;

/// The lines of a header.
pub(crate) struct HeaderLines<'a> {
    source: &'a mut Source,
    /// How a header is ended, for messages.
    remedy: &'static str,
    number: usize,
    consumed: u64,
    line: Vec<u8>,
}

impl<'a> HeaderLines<'a> {
    /// Those of `source`, from where it stands.
    pub(crate) fn of(source: &'a mut Source, remedy: &'static str) -> Self {
        HeaderLines { source, remedy, number: 0, consumed: 0, line: Vec::new() }
    }

    /// The next line without its end, and its number from 1; `None` at the end of the file.
    pub(crate) fn next(&mut self) -> Result<Option<(usize, String)>, Problem> {
        self.line.clear();
        let left = HEADER_MAX_BYTES - self.consumed;
        let mut reader = self.source.reader.by_ref().take(left);
        let n = reader.read_until(b'\n', &mut self.line).map_err(|e| Problem::io("header", &e))?;
        self.consumed += n as u64;
        self.number += 1;
        if self.consumed == HEADER_MAX_BYTES {
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

    /// Bytes of the lines so far.
    pub(crate) fn consumed(&self) -> u64 {
        self.consumed
    }
}

/// Bytes before the samples.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Skip {
    /// Of the file where the data are raw, else of what is unpacked.
    Bytes(u64),
    /// The samples are the last bytes of the file.
    FromEnd,
}

/// How the samples stand in a file.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Form {
    pub(crate) encoding: Encoding,
    pub(crate) line_skip: u64,
    pub(crate) byte_skip: Skip,
    /// What the format calls its skips, for messages.
    pub(crate) skip_field: &'static str,
}

/// Reads the samples from a source that stands at the first of its `len` bytes of data.
pub(crate) fn read(
    source: Source,
    len: u64,
    form: &Form,
    layout: &Layout,
) -> Result<(Samples, ValueMap), Problem> {
    let (mut reader, supply) = open(source, len, form, layout, layout.bytes())?;
    samples::read(&mut *reader, supply, &form.in_order(layout))
}

/// Reads the samples from files beside a header or below it, each with the same share of them.
/// `field` is what the header calls them.
pub(crate) fn read_files(
    folder: &Path,
    names: &[String],
    field: &str,
    form: &Form,
    layout: &Layout,
) -> Result<(Samples, ValueMap), Problem> {
    let in_file = |name: &str| format!("{field} {}", quoted(name));
    if let [name] = names {
        let source = Source::open(&source::beside(folder, name, field)?, field)?;
        let len = source.len;
        return read(source, len, form, layout).map_err(|mut p| {
            p.field = in_file(name);
            p
        });
    }
    let need = layout.bytes();
    if names.is_empty() || names.len() as u64 > DIM_MAX || !need.is_multiple_of(names.len() as u64)
    {
        return Err(Problem::malformed(
            field,
            format!("{} files can't share {need} bytes evenly", names.len()),
            "correct the list or the sizes",
        ));
    }
    let share = need / names.len() as u64;
    // All are looked at before memory is taken.
    let mut parts = VecDeque::with_capacity(names.len());
    let mut total: Option<Supply> = None;
    for name in names {
        let path = source::beside(folder, name, field)?;
        let source = Source::open(&path, field)?;
        let len = source.len;
        let here = |mut p: Problem| {
            p.field = in_file(name);
            p
        };
        let (_, supply) = open(source, len, form, layout, share).map_err(here)?;
        total = Some(match (total, supply) {
            (_, Supply::Plain { have }) if have < share => {
                return Err(here(samples::short(share, have)));
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
        parts.push_back(Part { name: in_file(name), path });
    }
    let supply = total.expect("there is a file");
    let mut files = Files { parts, form, layout, share, open: None };
    samples::read(&mut files, supply, &form.in_order(layout)).map_err(|mut p| {
        if p.field == "data" {
            p.field = field.into();
        }
        p
    })
}

impl Form {
    /// The layout with the order in which the encoding hands numbers out.
    fn in_order(&self, layout: &Layout) -> Layout {
        match self.encoding.has_order() {
            true => *layout,
            false => Layout { endian: samples::Endian::Little, ..*layout },
        }
    }
}

/// A reader of the samples and what is behind it; `share` is how many bytes of them are wanted.
fn open<'a>(
    mut source: Source,
    len: u64,
    form: &Form,
    layout: &Layout,
    share: u64,
) -> Result<(Box<dyn Read + Send + 'a>, Supply), Problem> {
    let ends_early = |field: &str| {
        Problem::malformed(field, "skips past the end of the data", "correct the skip")
    };
    let io = |e: std::io::Error| Problem::io("data", &e);
    let skipped = source::skip_lines(&mut source.reader, form.line_skip)
        .map_err(io)?
        .ok_or_else(|| ends_early("line skip"))?;
    let left = len.saturating_sub(skipped);
    if form.encoding == Encoding::Raw {
        let skip = match form.byte_skip {
            Skip::Bytes(skip) if skip > left => return Err(ends_early(form.skip_field)),
            Skip::Bytes(skip) => skip,
            Skip::FromEnd => left.saturating_sub(share),
        };
        if skip > 0 {
            source.reader.seek(SeekFrom::Current(skip as i64)).map_err(io)?;
        }
        return Ok((Box::new(source.reader), Supply::Plain { have: left - skip }));
    }
    let Skip::Bytes(skip) = form.byte_skip else {
        return Err(Problem::malformed(
            form.skip_field,
            "-1 counts from the end, which is known of raw data alone",
            "give the number of bytes, or save it uncompressed",
        ));
    };
    if skip > SKIP_MAX_BYTES {
        return Err(Problem::unsupported(
            form.skip_field,
            format!("{skip} is more than the {SKIP_MAX_BYTES} that are skipped inside packed data"),
            "save it again without a skip",
        ));
    }
    let (mut reader, supply) =
        form.encoding.open(Box::new(source.reader), left, layout.number).map_err(io)?;
    if skip > 0 {
        match source::skip_bytes(&mut *reader, skip) {
            Ok(true) => {}
            Ok(false) => return Err(ends_early(form.skip_field)),
            Err(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => {
                return Err(ends_early(form.skip_field));
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

struct Part {
    /// The field and the file's name, for messages.
    name: String,
    path: PathBuf,
}

/// Files one after another, each opened when its turn comes.
struct Files<'a> {
    parts: VecDeque<Part>,
    form: &'a Form,
    layout: &'a Layout,
    share: u64,
    /// The file that is read: its name, its reader, and how many bytes are still to come.
    open: Option<(String, Box<dyn Read + Send>, u64)>,
}

impl Read for Files<'_> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        loop {
            let Some((name, reader, left)) = &mut self.open else {
                let Some(Part { name, path }) = self.parts.pop_front() else { return Ok(0) };
                let here = |mut p: Problem| {
                    p.field = name.clone();
                    wrapped(p)
                };
                let source = Source::open(&path, "data").map_err(here)?;
                let len = source.len;
                let (reader, _) =
                    open(source, len, self.form, self.layout, self.share).map_err(here)?;
                self.open = Some((name, reader, self.share));
                continue;
            };
            let want = (buf.len() as u64).min(*left) as usize;
            if want == 0 && *left > 0 {
                return Ok(0);
            }
            let say = |what: String, remedy: &str| {
                wrapped(Problem::new(OpenErrorKind::Damaged, name.clone(), what, remedy))
            };
            if *left == 0 {
                let packed = self.form.encoding != Encoding::Raw;
                if packed && reader.read(&mut [0])? > 0 {
                    return Err(say(
                        format!("goes on after its share of {} bytes", self.share),
                        "correct the list or the sizes",
                    ));
                }
                self.open = None;
                continue;
            }
            return match reader.read(&mut buf[..want]) {
                Ok(0) => Err(say(
                    format!("ends before its share of {} bytes", self.share),
                    "get the whole file, or correct the list or the sizes",
                )),
                Ok(n) => {
                    *left -= n as u64;
                    Ok(n)
                }
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => Err(e),
                Err(e) if e.get_ref().is_some_and(|inner| inner.is::<Problem>()) => Err(e),
                Err(e) => Err(say(format!("can't be read ({e})"), "get the file again")),
            };
        }
    }
}

/// The file names that `pattern` makes of `min`, `min + step` and so on up to `max`, as printf
/// does: one conversion of an integer, such as `%d` or `%03d`. `None` where it has none or
/// another one.
pub(crate) fn numbered(pattern: &str, min: i64, max: i64, step: i64) -> Option<Vec<String>> {
    let (before, after) = pattern.split_once('%')?;
    let at = after.find(|c: char| !c.is_ascii_digit())?;
    let (width, after) = after.split_at(at);
    let after = after.strip_prefix(['d', 'i', 'u'])?;
    if step == 0 || before.contains('%') || after.contains('%') || width.len() > 2 {
        return None;
    }
    let zeros = width.starts_with('0');
    let width: usize = if width.is_empty() { 0 } else { width.parse().ok()? };
    let mut names = Vec::new();
    let mut n = min;
    // One more than are ever taken, so that too many are told apart.
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
    fn names_are_numbered_as_printf_does() {
        let some = |list: &[&str]| Some(list.iter().map(|s| s.to_string()).collect::<Vec<_>>());
        assert_eq!(numbered("a%03d.raw", 8, 12, 2), some(&["a008.raw", "a010.raw", "a012.raw"]));
        assert_eq!(numbered("%d", 1, -1, -1), some(&["1", "0", "-1"]));
        assert_eq!(numbered("s/%2i.z", 9, 10, 1), some(&["s/ 9.z", "s/10.z"]));
        assert_eq!(numbered("%d", 3, 1, 1), some(&[]));
        for bad in ["a.raw", "%s", "%5.1f", "%", "%d%d", "%%d", "%999d", "%"] {
            assert_eq!(numbered(bad, 1, 2, 1), None, "{bad}");
        }
        assert_eq!(numbered("%d", 1, 2, 0), None);
        assert_eq!(numbered("%d", i64::MAX - 1, i64::MAX, 1), None);
        assert_eq!(numbered("%d", 0, i64::MAX, 1).unwrap().len() as u64, DIM_MAX + 1);
    }
}
