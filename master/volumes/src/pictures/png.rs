//! Decoder of a PNG picture, row by row; an interlaced one is decoded whole.

use super::{Channel, Shape, check_whole, push};
use crate::error::{OpenErrorKind, Problem};
use crate::samples::{self, Number};
use crate::source::{Notes, Source, Stream};
use png::{BitDepth, ColorType, Decoder, DecodingError, Limits, Reader};
use std::io::{BufReader, ErrorKind};

/// Most bytes that the decoder may take beside a row: chunks of text and colour profiles.
const CHUNKS_MAX_BYTES: usize = 4 << 20;

/// An open picture, at one of its rows.
pub(super) struct Png {
    reader: Reader<BufReader<Box<dyn Stream>>>,
    pub(super) shape: Shape,
    /// Colours by index, three bytes each, if they are not all grey.
    pub(super) palette: Option<Vec<u8>>,
    /// Values of the indices, if all colours are grey.
    greys: Option<Vec<u8>>,
    colour: ColorType,
    depth: BitDepth,
    /// The whole picture as stored, and the bytes of it that were used, if it is interlaced.
    whole: Option<(Vec<u8>, usize)>,
    /// Bytes of the file.
    len: u64,
    notes: Notes,
}

impl Png {
    pub(super) fn open(source: Source) -> Result<Png, Problem> {
        let Source { reader, len, notes, .. } = source;
        let limits = Limits { bytes: CHUNKS_MAX_BYTES };
        let mut decoder = Decoder::new_with_limits(reader, limits);
        decoder.set_ignore_text_chunk(true);
        decoder.set_ignore_iccp_chunk(true);
        let reader = decoder.read_info().map_err(|e| problem(&e))?;
        let info = reader.info();
        let (colour, depth) = (info.color_type, info.bit_depth);
        let number = if depth == BitDepth::Sixteen { Number::U16 } else { Number::U8 };
        let shape = Shape { width: info.width, height: info.height, number };
        let (mut palette, mut greys) = (None, None);
        if colour == ColorType::Indexed {
            let colours = info.palette.as_deref().unwrap_or_default();
            match colours.chunks_exact(3).all(|c| c[0] == c[1] && c[1] == c[2]) {
                true => greys = Some(colours.chunks_exact(3).map(|c| c[0]).collect()),
                false => {
                    palette = Some(colours.to_vec());
                    notes.add("colours come from a palette; the stored indices were read");
                }
            }
        }
        if info.trns.is_some() {
            notes.add("transparency of pixels was not read");
        }
        let whole = info.interlaced.then(|| (Vec::new(), 0));
        Ok(Png { reader, shape, palette, greys, colour, depth, whole, len, notes })
    }

    /// Returns the numbers of a pixel that are colours and opacity: 1 to 4.
    pub(super) fn channels(&self) -> u64 {
        self.colour.samples() as u64
    }

    /// Writes the samples of the next row, big-endian: of one channel, or of all that are grey.
    pub(super) fn row(
        &mut self,
        channel: Option<Channel>,
        out: &mut Vec<u8>,
    ) -> Result<(), Problem> {
        let Png { reader, shape, greys, colour, depth, whole, len, notes, .. } = self;
        let row = match whole {
            None => {
                let row = reader.next_row().map_err(|e| problem(&e))?;
                row.map(|row| row.data()).unwrap_or_default()
            }
            Some((all, used)) => {
                if all.is_empty() {
                    let bytes = reader.output_buffer_size().unwrap_or(usize::MAX);
                    check_whole(bytes as u64, *len)?;
                    samples::reserve(all, bytes)?;
                    all.resize(bytes, 0);
                    reader.next_frame(all).map_err(|e| problem(&e))?;
                }
                let bytes = reader.output_line_size(shape.width).unwrap_or(usize::MAX);
                let row = all.get(*used..used.saturating_add(bytes)).unwrap_or_default();
                *used += row.len();
                row
            }
        };
        let width = shape.width as usize;
        let indices = out.len();
        let opaque = match depth {
            BitDepth::Sixteen => push(row, (colour.samples(), 2), channel, out)?,
            BitDepth::Eight => push(row, (colour.samples(), 1), channel, out)?,
            // The first pixel is in the highest bits.
            BitDepth::One | BitDepth::Two | BitDepth::Four => {
                let bits = *depth as usize;
                let mask = (1u8 << bits) - 1;
                out.extend((0..width).filter_map(|x| {
                    let byte = row.get(x * bits / 8)?;
                    Some(byte >> (8 - bits - x * bits % 8) & mask)
                }));
                true
            }
        };
        if !opaque {
            notes.add("transparency of pixels was not read");
        }
        if let Some(greys) = greys {
            for index in &mut out[indices..] {
                *index = *greys.get(usize::from(*index)).ok_or_else(|| {
                    Problem::malformed("PLTE", "has no colour of an index", "get the file again")
                })?;
            }
        }
        Ok(())
    }
}

fn problem(e: &DecodingError) -> Problem {
    match e {
        DecodingError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "picture",
            "truncated: the file ends before its last row",
            "get the whole file",
        ),
        DecodingError::IoError(e) => Problem::io("picture", e),
        DecodingError::LimitsExceeded => Problem::new(
            OpenErrorKind::TooLarge,
            "picture",
            format!("needs more than {CHUNKS_MAX_BYTES} bytes beside its rows"),
            "save it again without texts and profiles",
        ),
        e => {
            let text: String = e.to_string().chars().take(120).collect();
            Problem::new(
                OpenErrorKind::Damaged,
                "picture",
                format!("is damaged ({text})"),
                "get the file again",
            )
        }
    }
}
