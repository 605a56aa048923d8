//! Files of several frames: what the functional groups of enhanced CT, MR and PET say of each
//! frame, or the offsets of a dose, and where its pixels are. Each frame then counts as a slice.

use super::elements::{ElementReader, File, KEPT, Pixels, Syntax, Tag, UNDEFINED, VALUE_MAX_BYTES};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::Endian;
use crate::source::Source;
use glam::DVec3;
use std::collections::BTreeMap;
use std::io::{BufReader, Read, Seek, SeekFrom};

/// Sequences of a functional group whose values are kept: FrameContent, PlanePosition,
/// PlaneOrientation, PixelMeasures and PixelValueTransformation.
const MACROS: [Tag; 5] =
    [(0x0020, 0x9111), (0x0020, 0x9113), (0x0020, 0x9116), (0x0028, 0x9110), (0x0028, 0x9145)];
/// Sequences of the groups that all frames share, and of those of each.
pub(super) const SHARED: Tag = (0x5200, 0x9229);
pub(super) const PER_FRAME: Tag = (0x5200, 0x9230);
/// Most frames of a file: 16 for each slice.
const FRAMES_MAX: usize = 1 << 18;
/// An item without bytes, and the delimiter after the last item.
const EMPTY_ITEM: [u8; 8] = [0xfe, 0xff, 0x00, 0xe0, 0, 0, 0, 0];
const DELIMITER: [u8; 8] = [0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0];

type Values = BTreeMap<Tag, Vec<u8>>;

/// The values of the functional groups.
#[derive(Default)]
pub(super) struct Groups {
    shared: Values,
    frames: Vec<Values>,
}

/// A frame's place in its file.
#[derive(Clone, Debug)]
pub(super) struct Frame {
    /// Number of the frame, from 0.
    pub(super) index: usize,
    /// First byte of its pixels, or of their first fragment's item.
    at: u64,
    /// Bytes of the pixels, or of the fragments with their items.
    bytes: u64,
    pixels: Pixels,
    endian: Endian,
}

fn malformed(what: impl Into<String>) -> Problem {
    Problem::malformed("PerFrameFunctionalGroupsSequence", what, "get the file again")
}

impl ElementReader {
    /// Reads the functional groups of a sequence of `bytes` bytes.
    pub(super) fn groups(&mut self, s: Syntax, bytes: u32, tag: Tag) -> Result<(), Problem> {
        let end = self.end_of(bytes);
        while let Some(bytes) = self.next_item(s, end)? {
            let mut values = Values::new();
            let end = self.end_of(bytes);
            while let Some((tag, bytes)) = self.next_in_item(s, end)? {
                match MACROS.contains(&tag) {
                    true => self.group(s, bytes, &mut values)?,
                    false => self.skip_value(s, bytes)?,
                }
            }
            if tag == SHARED {
                self.groups.shared = values;
            } else if self.groups.frames.len() < FRAMES_MAX {
                self.groups.frames.push(values);
            } else {
                return Err(malformed(format!("has more than {FRAMES_MAX} frames")));
            }
        }
        Ok(())
    }

    /// Reads the values of one group.
    fn group(&mut self, s: Syntax, bytes: u32, values: &mut Values) -> Result<(), Problem> {
        let end = self.end_of(bytes);
        while let Some(bytes) = self.next_item(s, end)? {
            let end = self.end_of(bytes);
            while let Some((tag, bytes)) = self.next_in_item(s, end)? {
                match KEPT.iter().any(|(kept, _)| *kept == tag) && bytes <= VALUE_MAX_BYTES {
                    true => {
                        let value = self.value(bytes)?;
                        values.insert(tag, value);
                    }
                    false => self.skip_value(s, bytes)?,
                }
            }
        }
        Ok(())
    }

    /// Returns where a sequence or item of `bytes` bytes ends; `None` if a delimiter ends it.
    fn end_of(&self, bytes: u32) -> Option<u64> {
        (bytes != UNDEFINED).then(|| self.consumed_bytes + u64::from(bytes))
    }

    /// Returns the bytes of a sequence's next item.
    fn next_item(&mut self, s: Syntax, end: Option<u64>) -> Result<Option<u32>, Problem> {
        if end.is_some_and(|end| self.consumed_bytes >= end) {
            return Ok(None);
        }
        match self.head(s)? {
            ((0xfffe, 0xe000), bytes, _) => Ok(Some(bytes)),
            ((0xfffe, 0xe0dd), ..) => Ok(None),
            _ => Err(malformed("has something else than items")),
        }
    }

    /// Returns tag and bytes of an item's next element.
    fn next_in_item(&mut self, s: Syntax, end: Option<u64>) -> Result<Option<(Tag, u32)>, Problem> {
        if end.is_some_and(|end| self.consumed_bytes >= end) {
            return Ok(None);
        }
        let (tag, bytes, _) = self.head(s)?;
        Ok((tag != (0xfffe, 0xe00d)).then_some((tag, bytes)))
    }

    fn skip_value(&mut self, s: Syntax, bytes: u32) -> Result<(), Problem> {
        match bytes {
            UNDEFINED => self.skip_undefined(s, 1),
            bytes => self.skip(bytes.into()),
        }
    }
}

/// Gives the frames of a dose their places: along the normal, by GridFrameOffsetVector.
fn place_doses(file: &mut File) -> Result<(), Problem> {
    const FIELD: &str = "GridFrameOffsetVector";
    let (position, directions) =
        (file.numbers::<3>((0x0020, 0x0032))?, file.numbers::<6>((0x0020, 0x0037))?);
    let (Some(text), Some(position), Some(d)) = (file.text((0x3004, 0x000c)), position, directions)
    else {
        return Ok(());
    };
    let offsets: Option<Vec<f64>> =
        text.split('\\').map(|w| w.trim().parse().ok().filter(|x: &f64| x.is_finite())).collect();
    let Some(offsets) = offsets else {
        return Err(Problem::malformed(FIELD, "is not numbers", "get the file again"));
    };
    let normal = DVec3::new(d[0], d[1], d[2]).cross(DVec3::new(d[3], d[4], d[5]));
    // They count from the first frame, or from the origin of the patient.
    file.groups.frames = offsets
        .iter()
        .map(|offset| {
            let at = DVec3::from_array(position) + normal * (offset - offsets[0]);
            let text = format!("{}\\{}\\{}", at.x, at.y, at.z);
            Values::from([((0x0020, 0x0032), text.into_bytes())])
        })
        .collect();
    Ok(())
}

/// Returns the frames of a file that has functional groups or is a dose; none for any other file.
pub(super) fn frames(file: &mut File) -> Result<Vec<Frame>, Problem> {
    if file.groups.frames.is_empty() {
        place_doses(file)?;
    }
    let count = file.groups.frames.len();
    if count == 0 {
        return Ok(Vec::new());
    }
    let said = file.text((0x0028, 0x0008)).and_then(|n| n.parse::<usize>().ok()).unwrap_or(1);
    if said != count {
        let field = match file.text((0x3004, 0x000c)) {
            Some(_) => "GridFrameOffsetVector",
            None => "PerFrameFunctionalGroupsSequence",
        };
        return Err(Problem::malformed(
            field,
            format!("has {count} frames, where NumberOfFrames says {said}"),
            "get the file again",
        ));
    }
    let Some(start) = file.pixels_at else {
        return Err(Problem::unsupported(
            "TransferSyntaxUID",
            "is deflated, with several frames in the file",
            "convert it, for instance with dcm2niix, or gdcmconv --raw",
        ));
    };
    let (pixels, endian) = (file.pixels, file.endian);
    let frame = |(index, (at, bytes))| Frame { index, at, bytes, pixels, endian };
    let places = match pixels {
        Pixels::Native { bytes: have, .. } => {
            let get = |tag| u64::from(file.short(tag).unwrap_or(0));
            let (rows, columns) = (get((0x0028, 0x0010)), get((0x0028, 0x0011)));
            let bytes = rows * columns * (get((0x0028, 0x0100)) / 8);
            let need = bytes.saturating_mul(count as u64);
            if need > have {
                return Err(crate::samples::truncated(need, have));
            }
            (0..count as u64).map(|i| (start + i * bytes, bytes)).collect()
        }
        Pixels::Packed(_) => fragments(&mut *file.rest, start, count)?,
    };
    Ok(places.into_iter().enumerate().map(frame).collect())
}

/// Returns first byte and length of each frame's fragments, by the table of offsets, or if there is
/// a fragment for each. `start` is the place of the first item.
fn fragments(rest: &mut dyn Read, start: u64, count: usize) -> Result<Vec<(u64, u64)>, Problem> {
    let bad =
        |what: &str| Problem::new(OpenErrorKind::Damaged, "PixelData", what, "get the file again");
    let mut at = start;
    let next = |rest: &mut dyn Read| -> Result<Option<u32>, Problem> {
        let mut head = [0; 8];
        rest.read_exact(&mut head).map_err(|_| bad("is truncated inside its fragments"))?;
        let bytes = u32::from_le_bytes([head[4], head[5], head[6], head[7]]);
        match head[..4] {
            [0xfe, 0xff, 0x00, 0xe0] => Ok(Some(bytes)),
            [0xfe, 0xff, 0xdd, 0xe0] => Ok(None),
            _ => Err(bad("has something else than fragments")),
        }
    };
    let bytes = next(rest)?.ok_or_else(|| bad("has no table of offsets"))?;
    if !(bytes as usize == 4 * count || bytes == 0) {
        return Err(bad("has a table of offsets of another number of frames"));
    }
    let mut table = Vec::new();
    rest.take(bytes.into()).read_to_end(&mut table).map_err(|e| Problem::io("PixelData", &e))?;
    at += 8 + u64::from(bytes);
    let first = at;
    // Offset of each item, and the end of the last one.
    let mut items = vec![first];
    while let Some(bytes) = next(rest)? {
        match crate::source::skip_bytes(rest, bytes.into()) {
            Ok(true) => {}
            _ => return Err(bad("is truncated inside its fragments")),
        }
        at += 8 + u64::from(bytes);
        items.push(at);
        if items.len() > FRAMES_MAX {
            return Err(bad("has too many fragments"));
        }
    }
    let starts: Vec<u64> = match table.is_empty() {
        false => table
            .chunks_exact(4)
            .map(|w| first + u64::from(u32::from_le_bytes([w[0], w[1], w[2], w[3]])))
            .collect(),
        true if items.len() == count + 1 => items[..count].to_vec(),
        true => {
            return Err(Problem::unsupported(
                "PixelData",
                format!("has {} fragments for {count} frames, and no table", items.len() - 1),
                "convert it, for instance with dcm2niix, or gdcmconv --raw",
            ));
        }
    };
    let ends = starts.iter().skip(1).copied().chain([at]);
    let places: Vec<(u64, u64)> =
        starts.iter().zip(ends).map(|(a, b)| (*a, b.saturating_sub(*a))).collect();
    match places.iter().all(|(at, bytes)| *bytes > 0 && items.binary_search(at).is_ok()) {
        true => Ok(places),
        false => Err(bad("has a table of offsets that fits no fragments")),
    }
}

impl File {
    /// Sets the file's values to a frame's.
    pub(super) fn select(&mut self, frame: &Frame) {
        let groups = &self.groups;
        let own = groups.frames.get(frame.index).into_iter().flatten();
        for (tag, value) in groups.shared.iter().chain(own) {
            self.values.insert(*tag, value.clone());
        }
        self.values.remove(&(0x0028, 0x0008));
        // The order of frames without a place.
        self.values.insert((0x0020, 0x0013), (frame.index + 1).to_string().into_bytes());
    }

    /// Returns a frame of a source as a file of its own, at its pixels and without values.
    pub(super) fn of_frame(mut source: Source, frame: &Frame) -> Result<File, Problem> {
        let io = |e: std::io::Error| Problem::io("PixelData", &e);
        source.reader.seek(SeekFrom::Start(frame.at)).map_err(io)?;
        let body = source.reader.take(frame.bytes);
        let (pixels, rest): (_, Box<dyn std::io::BufRead>) = match frame.pixels {
            Pixels::Native { words, .. } => {
                (Pixels::Native { bytes: frame.bytes, words }, Box::new(body))
            }
            packed => (
                packed,
                Box::new(BufReader::new((&EMPTY_ITEM[..]).chain(body).chain(&DELIMITER[..]))),
            ),
        };
        Ok(File {
            values: Values::new(),
            endian: frame.endian,
            pixels,
            rest,
            groups: Groups::default(),
            pixels_at: None,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests;
