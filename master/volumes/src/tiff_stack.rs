//! Reader of TIFF stacks: the pages of one file, or the files of a folder in the order of the
//! numbers in their names.
//!
//! The `tiff` crate decodes strips and tiles. This reader asks for one band of them at a time, so
//! that no page is held whole, and checks that a band is no larger than the file can account for.
//! TIFF has no field for the distance between pages: it comes from the description if ImageJ or OME
//! wrote one. Resolutions alone are ignored, since picture programs fill in 72 dpi. Channels
//! and times are pages, too. The description tells them from slices, and the first of each is read.

mod as_stored;
mod by_number;
mod description;

use crate::colours::may_be_colours;
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::limit::ByteCap;
use crate::pick::{Axis, Pick};
use crate::plain::f32_of_half;
use crate::raw::RawHints;
use crate::samples::{self, DIM_MAX, Endian, Layout, Number, Supply};
use crate::source::Source;
use crate::units::steps_in_mm;
use crate::unpack::{copy_on, wrapped};
use crate::{Hints, Opened};
use as_stored::AsStored;
pub(crate) use by_number::compare_by_number;
use description::{Description, Slices, Writer};
use slabcast_common::volume::{Lattice, Volume};
use std::collections::VecDeque;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::PathBuf;
use tiff::decoder::{ChunkType, Decoder, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

/// Most bytes of a band, the strip or row of tiles decoded at a time: room for most whole pages,
/// and below the 64 MiB that reading may take beside the voxels.
const BAND_MAX_BYTES: u64 = 48 << 20;
/// Most bytes of a band in a small file. A larger band needs at least half as many bytes in the
/// file, so that a small file can't take much memory.
const BAND_FREE_BYTES: u64 = 8 << 20;
/// Most pages of a file with several channels or times: 16 of each slice.
const PAGES_MAX: u64 = 16 * DIM_MAX;

/// Names of the numbers of a pixel that are colours to draw.
const RGB: &str = "colours (RGB)";
const RGBA: &str = "colours (RGBA)";

/// Returns whether the first bytes are TIFF or BigTIFF.
pub(crate) fn sniff(head: &[u8]) -> bool {
    [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| head.starts_with(magic))
}

/// Reads the pages of one file as slices.
pub(crate) fn read(source: Source, name: &str, hints: &RawHints) -> Result<Opened, Problem> {
    let (len, cap, pick) = (source.len, source.cap.clone(), source.pick);
    let mut pages = TiffFile::open(source)?;
    let first = pages.page()?;
    let mut description = pages.description(&first)?;
    let said = description.slices(&first.pick_of_pages(pick))?;
    // Pictures after the first of an OME or tifffile file are volumes of their own.
    let several = match description.writer {
        Writer::Ome => description.pictures > 1,
        Writer::Shaped => said.is_some_and(|s| s.total > 1),
        Writer::ImageJ | Writer::None => false,
    };
    let first_picture = said.filter(|_| several).map(|s| s.total);
    let most = if said.is_some_and(|s| s.total > s.count) { PAGES_MAX } else { DIM_MAX };
    let mut count = 1;
    while pages.next()? {
        if first_picture == Some(count) {
            description.notes.push("the first of several pictures in the file was read".into());
            break;
        }
        let page = pages.page()?;
        if page != first {
            return Err(page_differs(&format!("page {}", count + 1), &page, &first));
        }
        count += 1;
        if count > most {
            return Err(too_many(count));
        }
    }
    pages.rewind()?;
    let mut planes_start = None;
    let slices = match said {
        None => Slices { first: 0, count, stride: 1, total: count },
        Some(said) if said.total == count => said,
        // A program may have changed the pages and kept the text.
        Some(said) if said.total < count && said.total == said.count => {
            Slices { first: 0, count, stride: 1, total: count }
        }
        Some(said) => {
            planes_start = match description.writer {
                Writer::ImageJ | Writer::Shaped if count == 1 => {
                    pages.planes_start(&first, said.total, len)
                }
                _ => None,
            };
            if planes_start.is_none() {
                return Err(too_few(said, count));
            }
            said
        }
    };
    let mut notes = std::mem::take(&mut description.notes);
    notes.extend(pages.notes());
    let spacing = match hints.spacing {
        Some(spacing) => Some(spacing),
        None => pages.spacing(description, &mut notes),
    };
    let volume = match planes_start {
        Some(start) => {
            let endian = match pages.decoder.byte_order() {
                tiff::tags::ByteOrder::LittleEndian => Endian::Little,
                tiff::tags::ByteOrder::BigEndian => Endian::Big,
            };
            let bytes = first.bytes();
            let supply = Supply::Plain { have: slices.total * bytes };
            let planes = Planes { pages, start, bytes, slices, plane: 0, left: 0 };
            finish(planes, supply, (first, slices.count, endian), cap, name, spacing)?
        }
        None => {
            for _ in 0..slices.first {
                // They were counted.
                pages.next()?;
            }
            let stack = Stack {
                current: Some(pages),
                files: VecDeque::new(),
                pick,
                page: first,
                stride: slices.stride,
                left: slices.count - 1,
                band: Vec::new(),
                consumed: 0,
                row: 0,
            };
            finish(stack, encoded(len), (first, slices.count, NATIVE), cap, name, spacing)?
        }
    };
    Ok(Opened { volume, notes })
}

/// Byte order of bands: the `tiff` crate decodes them to the machine's.
const NATIVE: Endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };

/// Returns the supply of pages in files of `len` bytes. LZW is the densest encoding read: a code of
/// 12 bits stands for at most 4096 bytes.
fn encoded(len: u64) -> Supply {
    Supply::Encoded { name: "TIFF", bytes: len, ratio: 4096 }
}

fn too_few(said: Slices, pages: u64) -> Problem {
    Problem::unsupported(
        "ImageDescription",
        format!(
            "says {} channels or times of {} slices, so {} pictures, and {pages} pages are there",
            said.total / said.count,
            said.count,
            said.total
        ),
        "save one channel and one time, a page for each slice",
    )
}

/// Reads TIFF files, in the order given, as slices of a volume called `name`, of at most `cap`.
pub(crate) fn read_files(
    files: Vec<PathBuf>,
    name: &str,
    hints: &Hints,
) -> Result<Opened, Problem> {
    let (mut first, mut spacing, mut total) = (None, hints.raw.spacing, 0);
    let mut notes = Vec::new();
    let count = files.len() as u64;
    if count > DIM_MAX {
        return Err(too_many(count));
    }
    for path in &files {
        let shown = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let name_file = |mut p: Problem| {
            p.field = format!("{} {}", quoted(&shown), p.field);
            p
        };
        let source = Source::open(path, "file").map_err(name_file)?;
        let source = Source { pick: hints.pick, ..source };
        total += source.len;
        let mut file = TiffFile::open(source).map_err(name_file)?;
        let page = file.page().map_err(name_file)?;
        match &first {
            None => {
                let mut description = file.description(&page).map_err(name_file)?;
                if let Some(said) =
                    description.slices(&page.pick_of_pages(hints.pick)).map_err(name_file)?
                    && (said.total > count || said.total != said.count)
                {
                    return Err(name_file(too_few(said, count)));
                }
                notes.extend(file.notes());
                if spacing.is_none() {
                    spacing = file.spacing(description, &mut notes);
                }
                first = Some(page);
            }
            Some(first) if page != *first => {
                return Err(page_differs(&quoted(&shown), &page, first));
            }
            Some(_) => {}
        }
        if file.next().map_err(name_file)? {
            return Err(Problem::unsupported(
                quoted(&shown),
                "has several pages, and is not the only file of its folder",
                "give one file with all pages, or files of one page each",
            ));
        }
    }
    let page = first.expect("the caller passes a file");
    let stack = Stack {
        current: None,
        files: files.into(),
        pick: hints.pick,
        page,
        stride: 1,
        left: 0,
        band: Vec::new(),
        consumed: 0,
        row: page.height,
    };
    let volume = finish(stack, encoded(total), (page, count, NATIVE), hints.cap(), name, spacing)?;
    Ok(Opened { volume, notes })
}

fn finish(
    mut samples: impl Read + Send,
    supply: Supply,
    (page, count, endian): (Page, u64, Endian),
    cap: ByteCap,
    name: &str,
    spacing: Option<[f64; 3]>,
) -> Result<Volume, Problem> {
    let Page { width, height, number, .. } = page;
    let dims = [width.into(), height.into(), count];
    let layout = Layout::new(dims, number, endian, "pages")?;
    let lattice = Lattice::from_spacing(layout.dims, spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("spacing", e, "give it with --spacing"))?;
    let (samples, map) = samples::read(&mut samples, supply, &layout, cap)?;
    Ok(crate::stream::volume(name, page.kind(), false, lattice, samples, map))
}

fn too_many(count: u64) -> Problem {
    Problem::new(
        OpenErrorKind::TooLarge,
        "pages",
        format!("{count} or more are more than {DIM_MAX}"),
        "leave some out",
    )
}

fn page_differs(which: &str, page: &Page, first: &Page) -> Problem {
    Problem::malformed(
        which,
        format!("is {page}, where the first is {first}"),
        "make all of one size and type, or leave it out",
    )
}

/// Size and type of a page, the same for all pages of a stack.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Page {
    width: u32,
    height: u32,
    number: Number,
    /// Bits of a number in the file.
    bits: u32,
    /// Numbers of a pixel: 3 or more if it has colours.
    channels: u32,
    /// The one of them that is read.
    channel: u32,
    /// Whether the channels lie one after another, each a picture of its own.
    planar: bool,
}

impl Page {
    /// Returns whether its numbers are 16-bit floats, which become 32-bit ones.
    fn is_half(&self) -> bool {
        self.number == Number::F32 && self.bits == 16
    }

    /// Returns the bytes of a number as decoded.
    fn decoded_bytes(&self) -> usize {
        if self.is_half() { 2 } else { self.number.bytes() as usize }
    }

    /// Returns the numbers that lie beside each other for each pixel.
    fn interleaved(&self) -> usize {
        if self.planar { 1 } else { self.channels as usize }
    }

    /// Returns the name of the type.
    fn kind(&self) -> &'static str {
        if self.is_half() { "float16" } else { self.number.name() }
    }

    /// Returns the choice among pages: a channel within the pixels is none of them.
    fn pick_of_pages(&self, pick: Pick) -> Pick {
        if self.channels > 1 { Pick { channel: None, ..pick } } else { pick }
    }

    /// Leaves in a decoded band the numbers of the channel that is read, in their type.
    fn take_channel(&self, band: &mut Vec<u8>) -> Result<(), Problem> {
        if self.interleaved() == 1 && !self.is_half() {
            return Ok(());
        }
        let (size, pixel) = (self.decoded_bytes(), self.decoded_bytes() * self.interleaved());
        let at = if self.planar { 0 } else { self.channel as usize * size };
        let decoded = std::mem::take(band);
        samples::reserve(band, decoded.len() / pixel * self.number.bytes() as usize)?;
        for pixel in decoded.chunks_exact(pixel) {
            let number = &pixel[at..at + size];
            match self.is_half() {
                true => {
                    let half = u16::from_ne_bytes([number[0], number[1]]);
                    band.extend(f32_of_half(half).to_ne_bytes());
                }
                false => band.extend_from_slice(number),
            }
        }
        Ok(())
    }

    fn bytes(&self) -> u64 {
        u64::from(self.width) * u64::from(self.height) * self.number.bytes()
    }
}

impl std::fmt::Display for Page {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} x {} {}", self.width, self.height, self.kind())?;
        match self.channels {
            1 => Ok(()),
            n => write!(f, " of {n} channels"),
        }
    }
}

/// An open TIFF file, positioned at one of its pages.
struct TiffFile {
    decoder: Decoder<BufReader<AsStored>>,
    band_max_bytes: u64,
    /// Bytes of the file.
    len: u64,
    white_is_zero: bool,
    palette: bool,
    pick: Pick,
}

impl TiffFile {
    fn open(source: Source) -> Result<TiffFile, Problem> {
        let band_max_bytes = BAND_MAX_BYTES.min(BAND_FREE_BYTES.max(2 * source.len));
        let mut limits = Limits::unlimited();
        limits.decoding_buffer_size = band_max_bytes as usize;
        limits.intermediate_buffer_size = band_max_bytes as usize;
        limits.ifd_value_size = 1 << 20;
        let stream = AsStored::new(source.reader.into_inner(), source.len)
            .map_err(|e| Problem::io("file", &e))?;
        let pick = source.pick;
        let (white_is_zero, palette) = (stream.white_is_zero, stream.palette);
        let decoder =
            Decoder::new(BufReader::new(stream)).map_err(|e| tiff_problem(&e))?.with_limits(limits);
        Ok(TiffFile { decoder, band_max_bytes, len: source.len, white_is_zero, palette, pick })
    }

    /// Moves to the next page that is no thumbnail; false if there is none.
    fn next(&mut self) -> Result<bool, Problem> {
        while self.decoder.more_images() {
            self.decoder.next_image().map_err(|e| tiff_problem(&e))?;
            if !self.is_reduced() {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// Returns whether the page is a smaller version of another one.
    fn is_reduced(&mut self) -> bool {
        let kind = self.decoder.find_tag_unsigned::<u32>(Tag::NewSubfileType);
        kind.ok().flatten().is_some_and(|kind| kind & 1 == 1)
    }

    fn rewind(&mut self) -> Result<(), Problem> {
        self.decoder.seek_to_image(0).map_err(|e| tiff_problem(&e))
    }

    /// Returns size and type of the page; fails if it can't be a slice of a volume.
    fn page(&mut self) -> Result<Page, Problem> {
        let (width, height) = self.decoder.dimensions().map_err(|e| tiff_problem(&e))?;
        let (bits, channels, what) = match self.decoder.colortype().map_err(|e| tiff_problem(&e))? {
            ColorType::Gray(bits) => (bits, 1, ""),
            ColorType::GrayA(bits) => (bits, 2, "numbers (grey and opacity)"),
            ColorType::RGB(bits) => (bits, 3, RGB),
            ColorType::RGBA(bits) => (bits, 4, RGBA),
            ColorType::CMYK(bits) => (bits, 4, "colours (CMYK)"),
            ColorType::Multiband { bit_depth, num_samples } => {
                (bit_depth, u32::from(num_samples).max(1), "channels")
            }
            _ => {
                return Err(Problem::unsupported(
                    "PhotometricInterpretation",
                    "is of colours that are not read",
                    "save it in shades of grey, one number a pixel",
                ));
            }
        };
        let planar = self.decoder.find_tag_unsigned::<u16>(Tag::PlanarConfiguration);
        let planar = channels > 1 && planar.ok().flatten() == Some(2);
        let format = self.decoder.find_tag_unsigned_vec::<u16>(Tag::SampleFormat);
        let format = format.ok().flatten().and_then(|f| f.first().copied()).unwrap_or(1);
        let number = match (bits, format) {
            (1 | 2 | 4, 1) => Number::U8,
            (8, 1) => Number::U8,
            (16, 1) => Number::U16,
            (32, 1) => Number::U32,
            (64, 1) => Number::U64,
            (8, 2) => Number::I8,
            (16, 2) => Number::I16,
            (32, 2) => Number::I32,
            (64, 2) => Number::I64,
            (16 | 32, 3) => Number::F32,
            (64, 3) => Number::F64,
            _ => {
                return Err(Problem::unsupported(
                    "BitsPerSample",
                    format!("{bits} bits of SampleFormat {format} are not read"),
                    "save it with 1, 2, 4, 8, 16 or 32 bits",
                ));
            }
        };
        let mut channel = 0;
        if channels > 1 {
            let colours = matches!(what, RGB | RGBA) && may_be_colours(channels.into(), number);
            let axis = Axis::of_voxel(what, channels.into(), colours);
            let pick = Pick { channel: self.pick.channel, ..Pick::default() };
            channel = pick.choose(&[axis], "PhotometricInterpretation")?.0[0] as u32;
        }
        // Checked here, so that the first pass refuses what the second could not read.
        Layout::new([width.into(), height.into(), 1], number, Endian::Little, "ImageWidth")?;
        let (chunk_width, chunk_height) = self.decoder.chunk_dimensions();
        let tiled = self.decoder.get_chunk_type() == ChunkType::Tile;
        if (tiled || channels > 1) && bits < 8 {
            return Err(Problem::unsupported(
                "BitsPerSample",
                format!("{bits} bits in tiles or of several channels are not read"),
                "save it with 8 bits, or in strips",
            ));
        }
        let rows = u64::from(chunk_height.min(height));
        // A tile is decoded beside its band.
        let tile = if tiled { u64::from(chunk_width) * u64::from(chunk_height) } else { 0 };
        let page = Page { width, height, number, bits: bits.into(), channels, channel, planar };
        // The decoded band, and beside it the numbers that are read of it.
        let decoded = page.decoded_bytes() as u64 * page.interleaved() as u64;
        let direct = page.interleaved() == 1 && !page.is_half();
        let beside = if direct { 0 } else { rows * u64::from(width) * number.bytes() };
        let band = (rows * u64::from(width) + tile).saturating_mul(decoded).saturating_add(beside);
        if chunk_width == 0 || chunk_height == 0 || band > self.band_max_bytes {
            return Err(Problem::new(
                OpenErrorKind::TooLarge,
                if tiled { "TileLength" } else { "RowsPerStrip" },
                format!(
                    "bands of {band} bytes are more than the {} that are read",
                    self.band_max_bytes
                ),
                "save it with smaller strips or tiles",
            ));
        }
        Ok(page)
    }

    /// Decodes the band of a page that starts at `row`, in the machine's byte order, and returns
    /// its rows.
    fn band(&mut self, page: &Page, row: u32, band: &mut Vec<u8>) -> Result<u32, Problem> {
        let (chunk_width, chunk_height) = self.decoder.chunk_dimensions();
        let rows = chunk_height.min(page.height - row);
        let size = page.decoded_bytes() * page.interleaved();
        let stride = page.width as usize * size;
        band.clear();
        samples::reserve(band, stride * rows as usize)?;
        band.resize(stride * rows as usize, 0);
        let across = match self.decoder.get_chunk_type() {
            ChunkType::Strip => 1,
            ChunkType::Tile => page.width.div_ceil(chunk_width),
        };
        let mut first = row / chunk_height * across;
        if page.planar {
            first += page.channel * across * page.height.div_ceil(chunk_height);
        }
        if page.bits < 8 {
            self.check_chunk(first)?;
            return self.few_bits(page, first, rows, band);
        }
        if across == 1 && chunk_width >= page.width {
            let index = first;
            self.check_chunk(index)?;
            let (w, h) = self.decoder.chunk_data_dimensions(index);
            if (w, h) == (page.width, rows) {
                self.decoder.read_chunk_bytes(index, band).map_err(|e| self.tile_problem(&e))?;
                page.take_channel(band)?;
                return Ok(rows);
            }
        }
        let mut tile = Vec::new();
        for x in 0..across {
            let index = first + x;
            self.check_chunk(index)?;
            let (w, h) = self.decoder.chunk_data_dimensions(index);
            let (w, h) = (w as usize, h as usize);
            let left = (x * chunk_width) as usize * size;
            if h < rows as usize || left + w * size > stride {
                return Err(Problem::malformed("TileLength", "does not fit the page", RESAVE));
            }
            tile.clear();
            samples::reserve(&mut tile, w * h * size)?;
            tile.resize(w * h * size, 0);
            self.decoder.read_chunk_bytes(index, &mut tile).map_err(|e| self.tile_problem(&e))?;
            for (row, tile_row) in band.chunks_exact_mut(stride).zip(tile.chunks_exact(w * size)) {
                row[left..left + w * size].copy_from_slice(tile_row);
            }
        }
        page.take_channel(band)?;
        Ok(rows)
    }

    /// Decodes a strip whose pixels have fewer than 8 bits, the first in the highest ones.
    fn few_bits(
        &mut self,
        page: &Page,
        index: u32,
        rows: u32,
        band: &mut [u8],
    ) -> Result<u32, Problem> {
        let (width, bits) = (page.width as usize, page.bits as usize);
        let stride = (width * bits).div_ceil(8);
        let mut packed = Vec::new();
        samples::reserve(&mut packed, stride * rows as usize)?;
        packed.resize(stride * rows as usize, 0);
        self.decoder.read_chunk_bytes(index, &mut packed).map_err(|e| self.tile_problem(&e))?;
        let mask = (1u8 << bits) - 1;
        for (row, stored) in band.chunks_exact_mut(width).zip(packed.chunks_exact(stride)) {
            for (x, value) in row.iter_mut().enumerate() {
                *value = stored[x * bits / 8] >> (8 - bits - x * bits % 8) & mask;
            }
        }
        Ok(rows)
    }

    /// Converts an error of decoding a chunk. The `tiff` crate (0.11.3, its issue 395) stops before
    /// the end of some tiles in LZW that are whole, as if the file were cut off.
    fn tile_problem(&mut self, e: &TiffError) -> Problem {
        let ends = matches!(e, TiffError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof);
        let tiled = self.decoder.get_chunk_type() == ChunkType::Tile;
        let lzw = self.decoder.find_tag_unsigned::<u16>(Tag::Compression).ok().flatten();
        let list = |d: &mut Decoder<_>, tag| d.get_tag_u64_vec(tag).unwrap_or_default();
        let starts = list(&mut self.decoder, Tag::TileOffsets);
        let sizes = list(&mut self.decoder, Tag::TileByteCounts);
        let whole = starts.iter().zip(&sizes).all(|(at, n)| at.saturating_add(*n) <= self.len);
        if !(ends && tiled && lzw == Some(5) && whole) {
            return tiff_problem(e);
        }
        Problem::unsupported(
            "Compression",
            "is LZW in tiles, some of which this version can't decode",
            "save it with deflate, uncompressed, or in strips, for instance with \
             `tiffcp -c zip -s IN OUT`",
        )
    }

    /// Refuses a chunk that the file does not list; the `tiff` crate would panic.
    fn check_chunk(&mut self, index: u32) -> Result<(), Problem> {
        let count = match self.decoder.get_chunk_type() {
            ChunkType::Strip => self.decoder.strip_count(),
            ChunkType::Tile => self.decoder.tile_count(),
        };
        if index < count.map_err(|e| tiff_problem(&e))? {
            return Ok(());
        }
        Err(Problem::malformed("StripOffsets", "has fewer entries than the page needs", RESAVE))
    }

    /// Returns notes on how stored values were taken.
    fn notes(&self) -> Vec<String> {
        let palette = "its colours come from a palette; the stored indices were read";
        let white = "in its pictures 0 is white; the stored values were read";
        let notes = [(self.palette, palette), (self.white_is_zero, white)];
        notes.iter().filter(|n| n.0).map(|n| n.1.to_string()).collect()
    }

    /// Returns the first page's description, an empty one if there is none.
    fn description(&mut self, page: &Page) -> Result<Description, Problem> {
        self.rewind()?;
        match self.decoder.get_tag_ascii_string(Tag::ImageDescription) {
            Ok(text) => Description::parse(&text, page),
            Err(_) => Ok(Description::default()),
        }
    }

    /// Returns the sample distances, in mm, by the first page's description.
    fn spacing(
        &mut self,
        mut description: Description,
        notes: &mut Vec<String>,
    ) -> Option<[f64; 3]> {
        let steps = &mut description.steps;
        if description.writer == Writer::ImageJ {
            // Its unit applies to the resolution. Without a unit that is in pixels, or not
            // ImageJ's.
            let unit = self.decoder.find_tag_unsigned::<u16>(Tag::ResolutionUnit).ok().flatten();
            let used = steps[0].unit.is_some() || unit == Some(1);
            for (step, tag) in steps.iter_mut().zip([Tag::XResolution, Tag::YResolution]) {
                step.number = match self.decoder.find_tag(tag).ok().flatten() {
                    Some(tiff::decoder::ifd::Value::Rational(a, b)) if used && a > 0 && b > 0 => {
                        Some(f64::from(b) / f64::from(a))
                    }
                    _ if used => None,
                    _ => Some(1.0),
                };
            }
            if steps[2].number.is_none() || steps[0].number.is_none() {
                return None;
            }
        }
        if steps.iter().all(|s| s.number.is_none()) {
            return None;
        }
        let (spacing, _) = steps_in_mm(steps, notes);
        Some(spacing).filter(|s| s.iter().all(|x| x.is_finite() && *x > 0.0))
    }

    /// Returns where `total` planes begin that lie one after another, though only the first has a
    /// page: ImageJ writes stacks of 4 GiB and more so, tifffile those it calls truncated. `None`
    /// if the planes can't be there.
    fn planes_start(&mut self, page: &Page, total: u64, len: u64) -> Option<u64> {
        let compression = self.decoder.find_tag_unsigned::<u16>(Tag::Compression).ok()?;
        if compression.is_some_and(|c| c != 1) || page.channels > 1 || page.is_half() {
            return None;
        }
        let starts = self.decoder.get_tag_u64_vec(Tag::StripOffsets).ok()?;
        let sizes = self.decoder.get_tag_u64_vec(Tag::StripByteCounts).ok()?;
        let start = *starts.first()?;
        let mut end = start;
        for (strip, size) in starts.iter().zip(&sizes) {
            if *strip != end {
                return None;
            }
            end = end.checked_add(*size)?;
        }
        // Some writers count all planes in the page's one strip.
        let whole = start.checked_add(total.checked_mul(page.bytes())?)?;
        // A program that drops pages may keep the text; what follows are then no planes.
        let directories = &self.decoder.inner().get_ref().directories;
        let free = !directories.iter().any(|at| (start..whole).contains(at));
        (free && end >= start.checked_add(page.bytes())? && whole <= len).then_some(start)
    }
}

const RESAVE: &str = "save it again, for instance with ImageJ";

/// Converts an error of the `tiff` crate.
fn tiff_problem(e: &TiffError) -> Problem {
    let short = |text: String| {
        let text: String = text.chars().take(120).collect();
        text
    };
    match e {
        TiffError::IoError(e) if e.kind() == ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "pages",
            "truncated: the file ends before its pictures",
            "get the whole file",
        ),
        TiffError::UnsupportedError(e) => Problem::unsupported(
            "TIFF",
            short(e.to_string()),
            "save it in greys, uncompressed or with LZW or deflate, such as `tiffcp -c zip IN OUT`",
        ),
        TiffError::LimitsExceeded => Problem::new(
            OpenErrorKind::TooLarge,
            "TIFF",
            "asks for more memory than the file can account for",
            RESAVE,
        ),
        e => Problem::new(
            OpenErrorKind::Damaged,
            "TIFF",
            format!("is damaged ({})", short(e.to_string())),
            "get the file again",
        ),
    }
}

/// Reads the samples of all pages, one after another.
struct Stack {
    current: Option<TiffFile>,
    /// Files not yet opened.
    files: VecDeque<PathBuf>,
    pick: Pick,
    page: Page,
    /// Pages from one slice to the next of the current file.
    stride: u64,
    /// Slices of the current file after this one.
    left: u64,
    band: Vec<u8>,
    /// Bytes of the band already handed out.
    consumed: usize,
    /// First row of the page not yet decoded.
    row: u32,
}

impl Stack {
    /// Decodes the next band; false at the end.
    fn fill(&mut self) -> Result<bool, Problem> {
        if self.row >= self.page.height {
            if let Some(file) = &mut self.current
                && self.left > 0
            {
                self.left -= 1;
                for _ in 0..self.stride {
                    if !file.next()? {
                        return Ok(false);
                    }
                }
            } else {
                let Some(path) = self.files.pop_front() else { return Ok(false) };
                let source = Source { pick: self.pick, ..Source::open(&path, "file")? };
                self.current = Some(TiffFile::open(source)?);
            }
            self.row = 0;
        }
        let Some(file) = &mut self.current else { return Ok(false) };
        // The file may have changed since the first pass.
        let page = file.page()?;
        if page != self.page {
            return Err(page_differs("a page", &page, &self.page));
        }
        self.row += file.band(&page, self.row, &mut self.band)?;
        self.consumed = 0;
        Ok(true)
    }
}

impl Read for Stack {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        if self.consumed == self.band.len() && !self.fill().map_err(wrapped)? {
            return Ok(0);
        }
        Ok(copy_on(&self.band, &mut self.consumed, buf))
    }
}

/// Reads planes that lie one after another, without pages of their own.
struct Planes {
    pages: TiffFile,
    /// Place of the first plane in the file.
    start: u64,
    /// Bytes of a plane.
    bytes: u64,
    slices: Slices,
    /// Next slice.
    plane: u64,
    /// Bytes of the current slice that are still to be read.
    left: u64,
}

impl Read for Planes {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let file = self.pages.decoder.inner();
        if self.left == 0 {
            if self.plane == self.slices.count {
                return Ok(0);
            }
            let plane = self.slices.first + self.plane * self.slices.stride;
            let at = self.start + plane * self.bytes;
            file.seek(SeekFrom::Start(at))?;
            self.plane += 1;
            self.left = self.bytes;
        }
        let n = file.take(self.left).read(buf)?;
        self.left -= n as u64;
        Ok(n)
    }
}

#[cfg(test)]
pub(crate) mod tests;
