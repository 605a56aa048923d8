//! Parser of the data elements of a DICOM file. It keeps a few short values, skips all others, and
//! stops at the pixels.
//!
//! The `dicom-object` crate is not used: it holds whole files as trees, took 4.08 GiB and 10 s for
//! a file of 323 bytes, and depends on a crate with an advisory (`encoding`, unmaintained). A
//! volume needs twenty elements, all short and in ASCII, and the position of the pixels.

use super::frames::{Groups, PER_FRAME, SHARED};
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::samples::Endian;
use crate::source::Source;
use flate2::bufread::DeflateDecoder;
use std::collections::BTreeMap;
use std::io::{BufRead, Read};

/// Group and element number.
pub(super) type Tag = (u16, u16);

/// Elements whose values are kept, with their names.
pub(super) const KEPT: [(Tag, &str); 28] = [
    ((0x0002, 0x0010), "TransferSyntaxUID"),
    ((0x0008, 0x0008), "ImageType"),
    ((0x0008, 0x0060), "Modality"),
    ((0x0008, 0x103e), "SeriesDescription"),
    ((0x0018, 0x0050), "SliceThickness"),
    ((0x0018, 0x0088), "SpacingBetweenSlices"),
    ((0x0018, 0x1164), "ImagerPixelSpacing"),
    ((0x0020, 0x000e), "SeriesInstanceUID"),
    ((0x0020, 0x0011), "SeriesNumber"),
    ((0x0020, 0x0013), "InstanceNumber"),
    ((0x0020, 0x0032), "ImagePositionPatient"),
    ((0x0020, 0x0037), "ImageOrientationPatient"),
    ((0x0028, 0x0002), "SamplesPerPixel"),
    ((0x0028, 0x0004), "PhotometricInterpretation"),
    ((0x0028, 0x0008), "NumberOfFrames"),
    ((0x0028, 0x0010), "Rows"),
    ((0x0028, 0x0011), "Columns"),
    ((0x0028, 0x0030), "PixelSpacing"),
    ((0x0028, 0x0100), "BitsAllocated"),
    ((0x0028, 0x0101), "BitsStored"),
    ((0x0028, 0x0102), "HighBit"),
    ((0x0028, 0x0103), "PixelRepresentation"),
    ((0x0028, 0x1052), "RescaleIntercept"),
    ((0x0028, 0x1053), "RescaleSlope"),
    ((0x0028, 0x3000), "ModalityLUTSequence"),
    ((0x3004, 0x000c), "GridFrameOffsetVector"),
    ((0x3004, 0x000e), "DoseGridScaling"),
    ((0x7fe0, 0x0010), "PixelData"),
];

/// Longest value that is kept; six numbers of 16 characters take 101 bytes.
pub(super) const VALUE_MAX_BYTES: u32 = 1024;
/// Longest GridFrameOffsetVector: 16 characters for each of 4096 frames, the most of 16 bits of
/// length.
const OFFSETS_MAX_BYTES: u32 = 1 << 16;
/// Most bytes before the pixels: private elements can hold whole reports.
const HEADER_MAX_BYTES: u64 = 64 << 20;
/// Most elements of a file, since empty ones take few bytes.
const ELEMENTS_MAX: u32 = 1 << 20;
/// Deepest nesting of sequences.
const DEPTH_MAX: u32 = 64;
/// Length of an element that a delimiter ends.
pub(super) const UNDEFINED: u32 = u32::MAX;

/// Storage of pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pixels {
    /// Uncompressed.
    Native {
        /// Bytes of the element.
        bytes: u64,
        /// Whether the pixels are 16-bit words (VR OW), whose bytes are swapped in big-endian
        /// files.
        words: bool,
    },
    /// Encoded, in fragments.
    Packed(Packing),
}

/// Encoding of pixels in fragments.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Packing {
    /// Run lengths.
    Rle,
    Jpeg,
    JpegLs,
    Jpeg2000,
}

/// A file read up to its pixels.
pub(super) struct File {
    pub(super) values: BTreeMap<Tag, Vec<u8>>,
    pub(super) endian: Endian,
    pub(super) pixels: Pixels,
    /// Reader at the first byte of the pixels.
    pub(super) rest: Box<dyn BufRead>,
    /// Functional groups of an enhanced file: shared, and of each frame.
    pub(super) groups: Groups,
    /// Place of the pixels, or of the first item of fragments; `None` inside deflate.
    pub(super) pixels_at: Option<u64>,
}

/// Returns whether the first bytes are DICOM: with the preamble of 128 bytes and `DICM`, or
/// without, as some old programs write it.
pub(crate) fn sniff(head: &[u8]) -> bool {
    let bare = head.starts_with(&[8, 0, 0, 0]) || head.starts_with(&[8, 0, 5, 0]);
    head.get(128..132) == Some(b"DICM") || bare && head.len() > 8
}

/// Encoding of elements: with or without their types, and the byte order.
#[derive(Clone, Copy)]
pub(super) struct Syntax {
    explicit: bool,
    endian: Endian,
}

/// Position in the elements of a file, with the counts that are limited.
pub(super) struct ElementReader {
    inner: Box<dyn BufRead>,
    /// Bytes read or skipped so far.
    pub(super) consumed_bytes: u64,
    /// Elements read so far.
    elements: u32,
    pub(super) groups: Groups,
}

impl File {
    /// Reads a file up to its pixels.
    pub(super) fn open(mut source: Source) -> Result<File, Problem> {
        let part10 = source.head()?.get(128..132) == Some(b"DICM");
        let len = source.len;
        let mut reader = ElementReader {
            inner: Box::new(source.reader),
            consumed_bytes: 0,
            elements: 0,
            groups: Groups::default(),
        };
        let mut values = BTreeMap::new();
        let mut syntax = Syntax { explicit: false, endian: Endian::Little };
        let (mut packing, mut deflated) = (None, false);
        if part10 {
            reader.skip(132)?;
            let meta = Syntax { explicit: true, endian: Endian::Little };
            // The group of file meta information is always explicit little-endian.
            while reader.peek()? == [2, 0] {
                reader.element(meta, &mut values, len)?;
            }
            let uid = values.get(&(0x0002, 0x0010)).map(|v| text(v)).unwrap_or_default();
            (syntax, packing, deflated) = match uid.as_str() {
                "1.2.840.10008.1.2" | "" => (syntax, None, false),
                "1.2.840.10008.1.2.1" => (meta, None, false),
                "1.2.840.10008.1.2.1.99" => (meta, None, true),
                "1.2.840.10008.1.2.2" => {
                    (Syntax { explicit: true, endian: Endian::Big }, None, false)
                }
                "1.2.840.10008.1.2.5" => (meta, Some(Packing::Rle), false),
                "1.2.840.10008.1.2.4.50"
                | "1.2.840.10008.1.2.4.51"
                | "1.2.840.10008.1.2.4.57"
                | "1.2.840.10008.1.2.4.70" => (meta, Some(Packing::Jpeg), false),
                "1.2.840.10008.1.2.4.80" | "1.2.840.10008.1.2.4.81" => {
                    (meta, Some(Packing::JpegLs), false)
                }
                "1.2.840.10008.1.2.4.90" | "1.2.840.10008.1.2.4.91" => {
                    (meta, Some(Packing::Jpeg2000), false)
                }
                other => {
                    let name = match other.strip_prefix("1.2.840.10008.1.2.4.") {
                        Some("52" | "53" | "54" | "55" | "56") => "JPEG of a kind that is not used",
                        Some("92" | "93") => "JPEG 2000 of several components",
                        Some("201" | "202" | "203") => "JPEG 2000 of high throughput",
                        Some("100" | "101" | "102" | "103" | "104" | "105" | "106") => "video",
                        _ => "not an encoding that is known",
                    };
                    return Err(Problem::unsupported(
                        "TransferSyntaxUID",
                        format!("{} is {name}", quoted(other)),
                        "convert it, for instance with dcm2niix, or gdcmconv --raw",
                    ));
                }
            };
        } else if reader
            .inner
            .fill_buf()
            .is_ok_and(|b| b.len() > 6 && b[4].is_ascii_uppercase() && b[5].is_ascii_uppercase())
        {
            syntax.explicit = true;
        }
        // Some programs write the pixels in JPEG and the elements without types, unlike the
        // standard.
        if part10 && syntax.endian == Endian::Little && !deflated {
            syntax.explicit = reader.has_types()?.unwrap_or(syntax.explicit);
        }
        let mut len = len;
        if deflated {
            // The limits on elements and the pixels' own size bound the inflated data.
            let inner = std::mem::replace(&mut reader.inner, Box::new(std::io::empty()));
            reader.inner = Box::new(std::io::BufReader::new(DeflateDecoder::new(inner)));
            len = len.saturating_mul(1032);
        }
        let (bytes, words) = loop {
            if reader.inner.fill_buf().map_err(|e| broken(&e))?.is_empty() {
                return Err(Problem::new(
                    OpenErrorKind::NotAVolume,
                    "PixelData",
                    "is missing: this is DICOM without a picture",
                    "leave the file out",
                ));
            }
            if let Some(pixels) = reader.element(syntax, &mut values, len)? {
                break pixels;
            }
        };
        let pixels = match (packing, bytes) {
            (Some(packing), UNDEFINED) => Pixels::Packed(packing),
            (None, n) if n != UNDEFINED => {
                let left = len.saturating_sub(reader.consumed_bytes);
                if u64::from(n) > left {
                    return Err(crate::samples::truncated(n.into(), left));
                }
                Pixels::Native { bytes: n.into(), words }
            }
            _ => {
                return Err(Problem::malformed(
                    "PixelData",
                    "is not stored as the transfer syntax says",
                    "get the file again",
                ));
            }
        };
        let pixels_at = (!deflated).then_some(reader.consumed_bytes);
        let ElementReader { inner: rest, groups, .. } = reader;
        Ok(File { values, endian: syntax.endian, pixels, rest, groups, pixels_at })
    }

    /// Returns a kept value as trimmed text; `None` if it is absent or empty.
    pub(super) fn text(&self, tag: Tag) -> Option<String> {
        self.values.get(&tag).map(|v| text(v)).filter(|t| !t.is_empty())
    }

    /// Parses `N` decimal numbers separated by backslashes; `None` if the element is absent.
    pub(super) fn numbers<const N: usize>(&self, tag: Tag) -> Result<Option<[f64; N]>, Problem> {
        let Some(text) = self.text(tag) else { return Ok(None) };
        let numbers: Option<Vec<f64>> = text
            .split('\\')
            .map(|w| w.trim().parse().ok().filter(|x: &f64| x.is_finite()))
            .collect();
        match numbers.and_then(|n| <[f64; N]>::try_from(n).ok()) {
            Some(numbers) => Ok(Some(numbers)),
            None => Err(Problem::malformed(
                name(tag),
                format!("{} is not {N} numbers", quoted(&text)),
                "get the file again",
            )),
        }
    }

    /// Returns a kept value as a 16-bit binary number.
    pub(super) fn short(&self, tag: Tag) -> Option<u16> {
        let bytes = *self.values.get(&tag)?.first_chunk::<2>()?;
        Some(match self.endian {
            Endian::Little => u16::from_le_bytes(bytes),
            Endian::Big => u16::from_be_bytes(bytes),
        })
    }
}

/// Returns the name of a kept element.
pub(super) fn name(tag: Tag) -> &'static str {
    KEPT.iter().find(|(t, _)| *t == tag).map_or("element", |(_, name)| name)
}

fn text(value: &[u8]) -> String {
    String::from_utf8_lossy(value).trim_matches([' ', '\0']).to_string()
}

fn broken(e: &std::io::Error) -> Problem {
    match e.kind() {
        std::io::ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "elements",
            "truncated: the file ends inside them",
            "get the whole file",
        ),
        std::io::ErrorKind::InvalidInput | std::io::ErrorKind::InvalidData => Problem::new(
            OpenErrorKind::Damaged,
            "elements",
            format!("are damaged ({e})"),
            "get the file again",
        ),
        _ => Problem::io("elements", e),
    }
}

fn malformed(what: impl Into<String>) -> Problem {
    Problem::malformed("elements", what, "get the file again")
}

impl ElementReader {
    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], Problem> {
        let mut bytes = [0; N];
        self.inner.read_exact(&mut bytes).map_err(|e| broken(&e))?;
        self.consumed_bytes += N as u64;
        Ok(bytes)
    }

    /// Returns the next two bytes without consuming them.
    fn peek(&mut self) -> Result<[u8; 2], Problem> {
        let chunk = self.inner.fill_buf().map_err(|e| broken(&e))?;
        // At a buffer's end the second byte may be missing and reads as 0; the group of meta
        // information lies within the first buffer.
        Ok([chunk.first().copied().unwrap_or(0), chunk.get(1).copied().unwrap_or(0)])
    }

    /// Returns whether the next element has its type beside its tag; `None` at the end of the file.
    fn has_types(&mut self) -> Result<Option<bool>, Problem> {
        let chunk = self.inner.fill_buf().map_err(|e| broken(&e))?;
        Ok(chunk.get(4..6).map(|kind| kind.iter().all(u8::is_ascii_uppercase)))
    }

    pub(super) fn skip(&mut self, bytes: u64) -> Result<(), Problem> {
        self.consumed_bytes = self.consumed_bytes.saturating_add(bytes);
        if self.consumed_bytes > HEADER_MAX_BYTES {
            return Err(malformed(format!("take more than {HEADER_MAX_BYTES} bytes")));
        }
        match crate::source::skip_bytes(&mut *self.inner, bytes) {
            Ok(true) => Ok(()),
            Ok(false) => Err(broken(&std::io::ErrorKind::UnexpectedEof.into())),
            Err(e) => Err(broken(&e)),
        }
    }

    fn short(&mut self, endian: Endian) -> Result<u16, Problem> {
        let bytes = self.bytes()?;
        Ok(match endian {
            Endian::Little => u16::from_le_bytes(bytes),
            Endian::Big => u16::from_be_bytes(bytes),
        })
    }

    fn long(&mut self, endian: Endian) -> Result<u32, Problem> {
        let bytes = self.bytes()?;
        Ok(match endian {
            Endian::Little => u32::from_le_bytes(bytes),
            Endian::Big => u32::from_be_bytes(bytes),
        })
    }

    /// Reads tag and length of the next element, and whether it has the type OW.
    pub(super) fn head(&mut self, s: Syntax) -> Result<(Tag, u32, bool), Problem> {
        self.elements += 1;
        if self.elements > ELEMENTS_MAX {
            return Err(malformed(format!("are more than {ELEMENTS_MAX}")));
        }
        let tag = (self.short(s.endian)?, self.short(s.endian)?);
        // Items and delimiters carry no type in any syntax.
        if tag.0 == 0xfffe || !s.explicit {
            return Ok((tag, self.long(s.endian)?, false));
        }
        let kind: [u8; 2] = self.bytes()?;
        let long = matches!(
            &kind,
            b"OB"
                | b"OD"
                | b"OF"
                | b"OL"
                | b"OV"
                | b"OW"
                | b"SQ"
                | b"SV"
                | b"UC"
                | b"UN"
                | b"UR"
                | b"UT"
                | b"UV"
        );
        let len = match long {
            true => {
                self.bytes::<2>()?;
                self.long(s.endian)?
            }
            false => self.short(s.endian)?.into(),
        };
        Ok((tag, len, &kind == b"OW"))
    }

    /// Reads an element, and keeps or skips its value. Returns the length of the pixels, and
    /// whether they are 16-bit words, if they come next. `len` is the most bytes that the file can
    /// have.
    fn element(
        &mut self,
        s: Syntax,
        values: &mut BTreeMap<Tag, Vec<u8>>,
        len: u64,
    ) -> Result<Option<(u32, bool)>, Problem> {
        let (tag, bytes, words) = self.head(s)?;
        if tag == (0x7fe0, 0x0010) {
            return Ok(Some((bytes, words)));
        }
        if tag == SHARED || tag == PER_FRAME {
            self.groups(s, bytes, tag)?;
            return Ok(None);
        }
        if tag == (0x0028, 0x3000) && bytes > 0 {
            // That it is there is enough.
            values.insert(tag, b"1".to_vec());
        }
        if bytes == UNDEFINED {
            self.skip_undefined(s, 1)?;
            return Ok(None);
        }
        if u64::from(bytes) > len.saturating_sub(self.consumed_bytes) {
            return Err(broken(&std::io::ErrorKind::UnexpectedEof.into()));
        }
        let sequence = tag == (0x0028, 0x3000);
        let most = if tag == (0x3004, 0x000c) { OFFSETS_MAX_BYTES } else { VALUE_MAX_BYTES };
        if KEPT.iter().any(|(kept, _)| *kept == tag) && bytes <= most && !sequence {
            let value = self.value(bytes)?;
            values.insert(tag, value);
        } else {
            self.skip(bytes.into())?;
        }
        Ok(None)
    }

    /// Reads a value of a few bytes.
    pub(super) fn value(&mut self, bytes: u32) -> Result<Vec<u8>, Problem> {
        let mut value = vec![0; bytes as usize];
        self.inner.read_exact(&mut value).map_err(|e| broken(&e))?;
        self.consumed_bytes += u64::from(bytes);
        Ok(value)
    }

    /// Skips a sequence or item of undefined length, up to its delimiter.
    pub(super) fn skip_undefined(&mut self, s: Syntax, depth: u32) -> Result<(), Problem> {
        if depth > DEPTH_MAX {
            return Err(malformed(format!("stand in more than {DEPTH_MAX} sequences")));
        }
        loop {
            let (tag, bytes, _) = self.head(s)?;
            match (tag, bytes) {
                ((0xfffe, 0xe00d | 0xe0dd), _) => return Ok(()),
                (_, UNDEFINED) => self.skip_undefined(s, depth + 1)?,
                (_, bytes) => self.skip(bytes.into())?,
            }
        }
    }
}
