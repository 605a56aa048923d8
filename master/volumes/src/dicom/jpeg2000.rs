//! JPEG 2000 inside DICOM (ISO/IEC 15444-1), lossless and with loss, of one number a pixel. The crate
//! `hayro-jpeg2000` decodes; this module checks before what that takes on trust: sizes, the number of
//! tiles and precincts, and that each tile is there and whole.

use crate::error::{OpenErrorKind, Problem};
use hayro_jpeg2000::{DecodeError, DecodeSettings, DecoderContext, Image};

/// Most bits of a pixel. The decoder computes in f32, which holds every step of 16 bits exactly.
const PRECISION_MAX: u8 = 16;
/// Most pixels of a picture: the decoder takes 12 bytes a pixel beside the result, of 512 MiB.
const PIXELS_MAX: u64 = 24 << 20;
/// Most pixels per byte, and the number of pixels up to which that does not matter: a flat picture
/// takes some 200 bytes at any size.
const PIXELS_A_BYTE: u64 = 8192;
const FLAT_PIXELS: u64 = 4 << 20;
/// Bytes of a tile-part without samples: its header and the marker after that.
const TILE_PART_BYTES: u64 = 14;

/// Markers, by their second byte.
const SIZ: u8 = 0x51;
const COD: u8 = 0x52;
const COC: u8 = 0x53;
const SOT: u8 = 0x90;
const SOD: u8 = 0x93;
const END: [u8; 2] = [0xff, 0xd9];

fn damaged(what: impl std::fmt::Display) -> Problem {
    let what = format!("has a JPEG 2000 picture that {what}");
    Problem::new(OpenErrorKind::Damaged, "PixelData", what, "get the file again")
}

fn unsupported(what: impl std::fmt::Display) -> Problem {
    Problem::unsupported(
        "PixelData",
        format!("is JPEG 2000 {what}, which is not read"),
        "convert it, for instance with dcm2niix, or gdcmconv --raw",
    )
}

/// Decodes a picture of `columns` x `rows` pixels, to little-endian numbers of `size` bytes each, with
/// sign if the file's numbers are `signed`. Numbers whose sign the picture states otherwise keep their
/// bits, as in pydicom.
pub(super) fn unpack(
    fragment: Vec<u8>,
    sizes: (u16, u16),
    size: usize,
    signed: bool,
) -> Result<Vec<u8>, Problem> {
    let mut stream = codestream(fragment)?;
    let header = Header::read(&stream, sizes)?;
    if usize::from(header.precision) > 8 * size {
        let (bits, allocated) = (header.precision, 8 * size);
        return Err(damaged(format!("has {bits} bits, where BitsAllocated says {allocated}")));
    }
    finish(&mut stream, &header)?;
    // With `strict` a picture that ends early is an error, and no grey area.
    let settings =
        DecodeSettings { resolve_palette_indices: false, strict: true, target_resolution: None };
    let image = Image::new(&stream, &settings).map_err(refused)?;
    let mut context = DecoderContext::default();
    let decoded = image.decode(&mut context).map_err(refused)?;
    let count = usize::from(sizes.0) * usize::from(sizes.1);
    let [component] = decoded.components() else { return Err(unsupported("of several colours")) };
    if component.samples().len() != count || component.bit_depth() != header.precision {
        return Err(damaged("has another size than its header says"));
    }
    let mut out = Vec::new();
    crate::samples::reserve(&mut out, count * size)?;
    let most = (1i32 << header.precision) - 1;
    // Samples of either sign come as if they had none.
    let shift = if header.signed { 1i32 << (header.precision - 1) } else { 0 };
    let unused = 32 - u32::from(header.precision);
    for sample in component.samples() {
        let number = (sample.round_ties_even() as i32).clamp(0, most) - shift;
        let raised = (number as u32) << unused;
        let number = if signed { raised as i32 >> unused } else { (raised >> unused) as i32 };
        out.extend_from_slice(&number.to_le_bytes()[..size]);
    }
    Ok(out)
}

/// Returns the problem of a picture that the decoder refuses.
fn refused(e: DecodeError) -> Problem {
    let text: String = e.to_string().chars().take(120).collect();
    match e {
        DecodeError::Marker(hayro_jpeg2000::MarkerError::Unsupported) => {
            unsupported("of a kind that is seldom used")
        }
        _ => damaged(format!("is damaged ({text})")),
    }
}

/// Returns the codestream of a picture: all of it, or a box of the file format JP2, which the standard
/// of DICOM forbids and some programs write.
fn codestream(mut bytes: Vec<u8>) -> Result<Vec<u8>, Problem> {
    if bytes.starts_with(&[0xff, 0x4f, 0xff, SIZ]) {
        return Ok(bytes);
    }
    if !bytes.starts_with(b"\0\0\0\x0cjP  ") {
        return Err(damaged("does not begin like one"));
    }
    let mut at = 0usize;
    loop {
        let head = bytes.get(at..).and_then(|rest| rest.first_chunk::<8>());
        let head = head.ok_or_else(|| damaged("has no codestream"))?;
        let short = be(&head[..4]) as usize;
        let (start, len) = match short {
            0 => (8, bytes.len() - at),
            1 => {
                let long = bytes.get(at + 8..at + 16).map_or(0, be);
                (16, usize::try_from(long).unwrap_or(usize::MAX))
            }
            _ => (8, short),
        };
        let end = at.checked_add(len).filter(|end| len >= start && *end <= bytes.len());
        let Some(end) = end else { return Err(damaged("has a box that ends early")) };
        if head[4..] == *b"jp2c" {
            bytes.truncate(end);
            bytes.drain(..at + start);
            return Ok(bytes);
        }
        at = end;
    }
}

/// Returns a big-endian number of up to 8 bytes.
fn be(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0, |n, b| n << 8 | u64::from(*b))
}

/// Precision, size and tiling of a picture, from its header.
struct Header {
    precision: u8,
    signed: bool,
    /// First byte after the header: the first tile-part.
    tiles_at: usize,
    tiles: u64,
    sizes: (u16, u16),
}

/// A marker with the bytes after its length.
struct Segment<'a> {
    marker: u8,
    body: &'a [u8],
    /// First byte after it.
    end: usize,
}

/// Returns the marker at a place, with its segment.
fn segment(stream: &[u8], at: usize) -> Result<Segment<'_>, Problem> {
    let early = || damaged("ends inside its header");
    let [0xff, marker] = *stream.get(at..at + 2).ok_or_else(early)? else {
        return Err(damaged("has something else than markers in its header"));
    };
    // These have no length.
    if marker == SOD || (0x30..=0x3f).contains(&marker) {
        return Ok(Segment { marker, body: &[], end: at + 2 });
    }
    let len = stream.get(at + 2..at + 4).map_or(0, be) as usize;
    let end = at + 2 + len;
    let body = stream.get(at + 4..end).filter(|_| len >= 2).ok_or_else(early)?;
    Ok(Segment { marker, body, end })
}

impl Header {
    /// Reads the header of a codestream, and checks that it is a picture of these columns and rows
    /// which the decoder may have.
    fn read(stream: &[u8], (columns, rows): (u16, u16)) -> Result<Header, Problem> {
        let siz = segment(stream, 2)?;
        let b = siz.body;
        if b.len() < 37 {
            return Err(damaged("has a header that is too short"));
        }
        let long = |i: usize| be(&b[2 + 4 * i..6 + 4 * i]);
        let [right, lower, left, upper, tile_width, tile_height, tile_left, tile_upper] =
            [0, 1, 2, 3, 4, 5, 6, 7].map(long);
        let components = be(&b[34..36]);
        if components != 1 {
            return Err(unsupported(format!("of {components} colours")));
        }
        let (precision, signed) = ((b[36] & 0x7f) + 1, b[36] & 0x80 != 0);
        let [across, down] = [37, 38].map(|i| b.get(i).map_or(0, |n| u64::from(*n)));
        if across == 0 || down == 0 || tile_width == 0 || tile_height == 0 {
            return Err(damaged("has a size of 0"));
        }
        let side = |from: u64, to: u64, by: u64| to.div_ceil(by).saturating_sub(from.div_ceil(by));
        let (width, height) = (side(left, right, across), side(upper, lower, down));
        if (width, height) != (columns.into(), rows.into()) {
            return Err(damaged(format!(
                "has {width} x {height} pixels, where Columns and Rows say {columns} x {rows}"
            )));
        }
        if precision > PRECISION_MAX {
            return Err(unsupported(format!("of {precision} bits a pixel")));
        }
        let (pixels, len) = (width * height, stream.len() as u64);
        if pixels > PIXELS_MAX {
            return Err(unsupported(format!("of {width} x {height} pixels")));
        }
        if pixels > FLAT_PIXELS && pixels / PIXELS_A_BYTE > len {
            return Err(damaged("is too short for its size"));
        }
        let number = |from: u64, to: u64, step: u64| to.saturating_sub(from).div_ceil(step);
        let tiles = number(tile_left, right, tile_width).saturating_mul(number(
            tile_upper,
            lower,
            tile_height,
        ));
        if tiles > len / TILE_PART_BYTES {
            return Err(damaged(format!("has {tiles} tiles, more than fit into its bytes")));
        }
        let mut header =
            Header { precision, signed, tiles_at: siz.end, tiles, sizes: (columns, rows) };
        loop {
            let next = segment(stream, header.tiles_at)?;
            match next.marker {
                SOT => return Ok(header),
                SOD => return Err(damaged("has samples in its header")),
                _ => header.check_coding(&next, len)?,
            }
            header.tiles_at = next.end;
        }
    }

    /// Checks the precincts of a marker of coding style; other markers pass. Each precinct has a byte
    /// in the stream of `len` bytes at least, and memory in the decoder.
    fn check_coding(&self, segment: &Segment<'_>, len: u64) -> Result<(), Problem> {
        let (style, b) = match (segment.marker, segment.body) {
            (COD, [style, _, _, _, _, rest @ ..]) => (style, rest),
            (COC, [_, style, rest @ ..]) => (style, rest),
            (COD | COC, _) => return Err(damaged("has a coding style that is too short")),
            _ => return Ok(()),
        };
        let [levels, _, _, block_style, _, precincts @ ..] = b else {
            return Err(damaged("has a coding style that is too short"));
        };
        if block_style & 0x40 != 0 {
            return Err(unsupported("of high throughput"));
        }
        if style & 1 == 0 {
            return Ok(());
        }
        let levels = u32::from(*levels).min(63);
        let halved = |side: u16, level: u32| u64::from(side).div_ceil(1 << (levels - level));
        let of_level = |(precinct, level): (&u8, u32)| {
            let (wide, high) = (precinct & 15, precinct >> 4);
            halved(self.sizes.0, level).div_ceil(1 << wide)
                * halved(self.sizes.1, level).div_ceil(1 << high)
        };
        let count: u64 = precincts.iter().zip(0..=levels).map(of_level).sum();
        if count > len {
            return Err(damaged(format!("has {count} precincts, more than fit into its bytes")));
        }
        Ok(())
    }
}

/// Checks that all tiles are there and whole, states their lengths, and ends the stream after them.
fn finish(stream: &mut Vec<u8>, header: &Header) -> Result<(), Problem> {
    let mut seen = vec![false; header.tiles as usize];
    let mut at = header.tiles_at;
    let early = || damaged("ends early");
    while stream.get(at + 1) == Some(&SOT) {
        let part = segment(stream, at)?;
        let [i0, i1, p0, p1, p2, p3, _, _] = *part.body else {
            return Err(damaged("has a tile without its length"));
        };
        let tile = seen.get_mut(usize::from(u16::from_be_bytes([i0, i1])));
        *tile.ok_or_else(|| damaged("has a tile that is outside of it"))? = true;
        let mut length = u32::from_be_bytes([p0, p1, p2, p3]);
        // The last tile-part may leave its length open, up to the marker of the end.
        if length == 0 {
            let end = stream.windows(2).rposition(|two| two == END).filter(|end| *end > at);
            length = end.and_then(|end| u32::try_from(end - at).ok()).ok_or_else(early)?;
            stream[at + 6..at + 10].copy_from_slice(&length.to_be_bytes());
        }
        let end = at + length as usize;
        if end > stream.len() {
            return Err(early());
        }
        let mut inside = segment(&stream[..end], at)?.end;
        loop {
            let next = segment(&stream[..end], inside)?;
            if next.marker == SOD {
                break;
            }
            header.check_coding(&next, stream.len() as u64)?;
            inside = next.end;
        }
        at = end;
    }
    if seen.contains(&false) {
        return Err(early());
    }
    // Some programs leave out the marker of the end; padding may follow it.
    match stream.get(at..at + 2) {
        Some(end) if end == END => {}
        _ if stream[at..].iter().all(|b| *b == 0) => {}
        _ => return Err(damaged("has something else than tiles")),
    }
    stream.truncate(at);
    stream.extend(END);
    Ok(())
}

#[cfg(test)]
pub(crate) mod tests;
