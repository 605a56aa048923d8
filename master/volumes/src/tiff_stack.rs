//! Reader of TIFF stacks: the pages of one file, or the files of a folder in the order of the
//! numbers in their names.
//!
//! The `tiff` crate decodes strips and tiles. This reader asks for one band of them at a time, so
//! that no page is held whole, and checks that a band is no larger than the file can account for.
//! TIFF has no field for the distance between pages: it comes from the description if ImageJ or OME
//! wrote one. Resolutions alone are ignored, since picture programs fill in 72 dpi.

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::limit::ByteCap;
use crate::raw::RawHints;
use crate::samples::{self, DIM_MAX, Endian, Layout, Number, Supply};
use crate::source::{Source, Stream};
use crate::unpack::wrapped;
use slabcast_common::volume::{Lattice, Volume};
use std::collections::VecDeque;
use std::io::{BufReader, Read};
use std::path::{Path, PathBuf};
use tiff::decoder::{ChunkType, Decoder, Limits};
use tiff::tags::Tag;
use tiff::{ColorType, TiffError};

/// Most bytes of a band, the strip or row of tiles decoded at a time: room for most whole pages,
/// and below the 64 MiB that reading may take beside the voxels.
const BAND_MAX_BYTES: u64 = 48 << 20;
/// Most bytes of a band in a small file. A larger band needs at least half as many bytes in the
/// file, so that a small file can't take much memory.
const BAND_FREE_BYTES: u64 = 8 << 20;

/// Returns whether the first bytes are TIFF or BigTIFF.
pub(crate) fn sniff(head: &[u8]) -> bool {
    [&b"II*\0"[..], b"MM\0*", b"II+\0", b"MM\0+"].iter().any(|magic| head.starts_with(magic))
}

/// Reads the pages of one file as slices.
pub(crate) fn read(source: Source, name: &str, hints: &RawHints) -> Result<Volume, Problem> {
    let (len, cap) = (source.len, source.cap);
    let mut pages = TiffFile::open(source)?;
    let first = pages.page()?;
    let mut count = 1;
    while pages.next()? {
        let page = pages.page()?;
        if page != first {
            return Err(page_differs(&format!("page {}", count + 1), &page, &first));
        }
        count += 1;
        if count > DIM_MAX {
            return Err(too_many(count));
        }
    }
    let spacing = pages.first_spacing(count)?;
    pages.rewind()?;
    let stack = Stack {
        current: Some(pages),
        files: VecDeque::new(),
        page: first,
        band: Vec::new(),
        consumed: 0,
        row: 0,
    };
    finish(stack, count, (len, cap), name, hints.spacing.or(spacing))
}

/// Reads TIFF files, in the order given, as slices of a volume called `name`, of at most `cap`.
pub(crate) fn read_files(
    files: Vec<PathBuf>,
    name: &str,
    hints: &RawHints,
    cap: ByteCap,
) -> Result<Volume, Problem> {
    let (mut first, mut spacing, mut total) = (None, None, 0);
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
        total += source.len;
        let mut file = TiffFile::open(source).map_err(name_file)?;
        let page = file.page().map_err(name_file)?;
        match &first {
            None => {
                spacing = file.first_spacing(count)?;
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
        page,
        band: Vec::new(),
        consumed: 0,
        row: page.height,
    };
    finish(stack, count, (total, cap), name, hints.spacing.or(spacing))
}

fn finish(
    mut stack: Stack,
    count: u64,
    (len, cap): (u64, ByteCap),
    name: &str,
    spacing: Option<[f64; 3]>,
) -> Result<Volume, Problem> {
    let Page { width, height, number } = stack.page;
    let endian = if cfg!(target_endian = "big") { Endian::Big } else { Endian::Little };
    let dims = [width.into(), height.into(), count];
    let layout = Layout::new(dims, number, endian, "pages")?;
    let lattice = Lattice::from_spacing(layout.dims, spacing.unwrap_or([1.0; 3]));
    lattice.check().map_err(|e| Problem::malformed("spacing", e, "give it with --spacing"))?;
    // LZW is the densest encoding read: a code of 12 bits stands for at most 4096 bytes.
    let supply = Supply::Encoded { name: "TIFF", bytes: len, ratio: 4096 };
    let (samples, map) = samples::read(&mut stack, supply, &layout, cap)?;
    Ok(Volume::new(name, number.name(), false, lattice, samples, map))
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
}

impl std::fmt::Display for Page {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} x {} {}", self.width, self.height, self.number.name())
    }
}

/// An open TIFF file, positioned at one of its pages.
struct TiffFile {
    decoder: Decoder<BufReader<Box<dyn Stream>>>,
    band_max_bytes: u64,
}

impl TiffFile {
    fn open(source: Source) -> Result<TiffFile, Problem> {
        let band_max_bytes = BAND_MAX_BYTES.min(BAND_FREE_BYTES.max(2 * source.len));
        let mut limits = Limits::unlimited();
        limits.decoding_buffer_size = band_max_bytes as usize;
        limits.intermediate_buffer_size = band_max_bytes as usize;
        limits.ifd_value_size = 1 << 20;
        let decoder =
            Decoder::new(source.reader).map_err(|e| tiff_problem(&e))?.with_limits(limits);
        Ok(TiffFile { decoder, band_max_bytes })
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
        let bits = match self.decoder.colortype().map_err(|e| tiff_problem(&e))? {
            ColorType::Gray(bits) => bits,
            other => {
                return Err(Problem::unsupported(
                    "PhotometricInterpretation",
                    format!("{other:?} is not a grey picture"),
                    "save it in shades of grey, one number a pixel",
                ));
            }
        };
        let format = self.decoder.find_tag_unsigned_vec::<u16>(Tag::SampleFormat);
        let format = format.ok().flatten().and_then(|f| f.first().copied()).unwrap_or(1);
        let number = match (bits, format) {
            (8, 1) => Number::U8,
            (16, 1) => Number::U16,
            (32, 1) => Number::U32,
            (64, 1) => Number::U64,
            (8, 2) => Number::I8,
            (16, 2) => Number::I16,
            (32, 2) => Number::I32,
            (64, 2) => Number::I64,
            (32, 3) => Number::F32,
            (64, 3) => Number::F64,
            _ => {
                return Err(Problem::unsupported(
                    "BitsPerSample",
                    format!("{bits} bits of SampleFormat {format} are not read"),
                    "save it with 8, 16 or 32 bits",
                ));
            }
        };
        // Checked here, so that the first pass refuses what the second could not read.
        Layout::new([width.into(), height.into(), 1], number, Endian::Little, "ImageWidth")?;
        let (chunk_width, chunk_height) = self.decoder.chunk_dimensions();
        let tiled = self.decoder.get_chunk_type() == ChunkType::Tile;
        let rows = u64::from(chunk_height.min(height));
        // A tile is decoded beside its band.
        let tile = if tiled { u64::from(chunk_width) * u64::from(chunk_height) } else { 0 };
        let band = (rows * u64::from(width) + tile).saturating_mul(number.bytes());
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
        Ok(Page { width, height, number })
    }

    /// Decodes the band of a page that starts at `row`, in the machine's byte order, and returns
    /// its rows.
    fn band(&mut self, page: &Page, row: u32, band: &mut Vec<u8>) -> Result<u32, Problem> {
        let (chunk_width, chunk_height) = self.decoder.chunk_dimensions();
        let rows = chunk_height.min(page.height - row);
        let size = page.number.bytes() as usize;
        let stride = page.width as usize * size;
        band.clear();
        samples::reserve(band, stride * rows as usize)?;
        band.resize(stride * rows as usize, 0);
        let across = match self.decoder.get_chunk_type() {
            ChunkType::Strip => 1,
            ChunkType::Tile => page.width.div_ceil(chunk_width),
        };
        let first = row / chunk_height * across;
        if across == 1 && chunk_width >= page.width {
            let index = first;
            self.check_chunk(index)?;
            let (w, h) = self.decoder.chunk_data_dimensions(index);
            if (w, h) == (page.width, rows) {
                self.decoder.read_chunk_bytes(index, band).map_err(|e| tiff_problem(&e))?;
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
            self.decoder.read_chunk_bytes(index, &mut tile).map_err(|e| tiff_problem(&e))?;
            for (row, tile_row) in band.chunks_exact_mut(stride).zip(tile.chunks_exact(w * size)) {
                row[left..left + w * size].copy_from_slice(tile_row);
            }
        }
        Ok(rows)
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

    /// Returns the sample distances, in mm, of the first page's description. Refuses a description
    /// with several channels or more pages than there are.
    fn first_spacing(&mut self, pages: u64) -> Result<Option<[f64; 3]>, Problem> {
        // The description is on the first page.
        self.rewind()?;
        let Ok(text) = self.decoder.get_tag_ascii_string(Tag::ImageDescription) else {
            return Ok(None);
        };
        let resolution = |d: &mut Decoder<_>, tag| match d.find_tag(tag).ok().flatten() {
            Some(tiff::decoder::ifd::Value::Rational(a, b)) if a > 0 && b > 0 => {
                Some(f64::from(b) / f64::from(a))
            }
            _ => None,
        };
        let description = Description::parse(&text);
        if description.channels > 1 || description.images > pages {
            return Err(Problem::unsupported(
                "ImageDescription",
                format!(
                    "says {} channels or times of {} pictures, and {pages} pages are there",
                    description.channels, description.images
                ),
                "save one channel and one time, a page for each slice",
            ));
        }
        let pixel_spacing = match description.pixel_spacing {
            Some(spacing) => Some(spacing),
            // OME gives no unit for the resolution; ImageJ's unit applies to it.
            None if text.contains("<OME") => None,
            None => resolution(&mut self.decoder, Tag::XResolution)
                .zip(resolution(&mut self.decoder, Tag::YResolution)),
        };
        let spacing = description
            .mm
            .zip(pixel_spacing)
            .map(|(mm, (x, y))| [x * mm, y * mm, description.page_spacing.unwrap_or(1.0) * mm]);
        Ok(spacing.filter(|s| s.iter().all(|x| x.is_finite() && *x > 0.0)))
    }
}

const RESAVE: &str = "save it again, for instance with ImageJ";

/// The description that ImageJ or OME wrote into the first page.
#[derive(Debug, Default, PartialEq)]
struct Description {
    /// Millimetres of its unit, if it names one.
    mm: Option<f64>,
    /// Distances of pixels along x and y, if it gives them, in its unit.
    pixel_spacing: Option<(f64, f64)>,
    /// Distance of pages, in its unit.
    page_spacing: Option<f64>,
    /// Channels times points in time.
    channels: u64,
    /// Number of slices.
    images: u64,
}

impl Description {
    fn parse(text: &str) -> Description {
        let mut description = Description { channels: 1, ..Description::default() };
        if text.starts_with("ImageJ=") {
            let get = |key: &str| {
                text.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix('=').map(str::trim))
            };
            let number = |key| get(key).and_then(|v| v.parse::<u64>().ok());
            description.images = number("images").unwrap_or(0);
            let product =
                number("channels").unwrap_or(1).checked_mul(number("frames").unwrap_or(1));
            description.channels = product.unwrap_or(u64::MAX);
            description.mm = get("unit").and_then(millimetres);
            description.page_spacing = get("spacing").and_then(|v| v.parse().ok());
        } else if text.contains("<OME") {
            let get = |key: &str| {
                let after = text.split_once(&format!(" {key}=\""))?.1;
                after.split_once('"').map(|(value, _)| value)
            };
            let number = |key| get(key).and_then(|v| v.parse::<u64>().ok()).unwrap_or(1);
            description.channels = number("SizeC").saturating_mul(number("SizeT"));
            description.images = number("SizeZ");
            let size = |key: &str| {
                let mm = millimetres(get(&format!("{key}Unit")).unwrap_or("um"))?;
                Some(get(key)?.parse::<f64>().ok()? * mm)
            };
            // Converted to mm, each from its own unit.
            description.pixel_spacing = size("PhysicalSizeX").zip(size("PhysicalSizeY"));
            description.page_spacing = size("PhysicalSizeZ");
            description.mm = Some(1.0);
        }
        description
    }
}

/// Returns the millimetres of a unit of length; `None` if it is unknown.
fn millimetres(unit: &str) -> Option<f64> {
    Some(match unit {
        "m" => 1000.0,
        "cm" => 10.0,
        "mm" => 1.0,
        "um" | "\u{b5}m" | "\u{3bc}m" | "\\u00B5m" | "micron" | "microns" => 1e-3,
        "nm" => 1e-6,
        _ => return None,
    })
}

/// Converts an error of the `tiff` crate.
fn tiff_problem(e: &TiffError) -> Problem {
    let short = |text: String| {
        let text: String = text.chars().take(120).collect();
        text
    };
    match e {
        TiffError::IoError(e) if e.kind() == std::io::ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "pages",
            "truncated: the file ends before its pictures",
            "get the whole file",
        ),
        TiffError::UnsupportedError(e) => Problem::unsupported(
            "TIFF",
            short(e.to_string()),
            "save it uncompressed, or with LZW or deflate",
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
    page: Page,
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
            let more = match &mut self.current {
                Some(file) if self.files.is_empty() => file.next()?,
                _ => false,
            };
            if !more {
                let Some(path) = self.files.pop_front() else { return Ok(false) };
                self.current = Some(TiffFile::open(Source::open(&path, "file")?)?);
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
        let n = (self.band.len() - self.consumed).min(buf.len());
        buf[..n].copy_from_slice(&self.band[self.consumed..self.consumed + n]);
        self.consumed += n;
        Ok(n)
    }
}

/// Compares file names in natural order: numbers in them by value, letters without case.
pub(crate) fn compare_by_number(a: &Path, b: &Path) -> std::cmp::Ordering {
    let key = |p: &Path| {
        let name = p.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let mut words: Vec<(String, String)> = Vec::new();
        let mut rest = name.as_str();
        while !rest.is_empty() {
            let digits = rest.starts_with(|c: char| c.is_ascii_digit());
            let end = rest.find(|c: char| c.is_ascii_digit() != digits).unwrap_or(rest.len());
            let word = &rest[..end];
            rest = &rest[end..];
            // Numbers compare by length, then by digits, without leading zeros.
            let bare = if digits { word.trim_start_matches('0') } else { word };
            let rank = if digits { format!("0{:04}", bare.len()) } else { "1".into() };
            words.push((rank, bare.to_string()));
        }
        words
    };
    key(a).cmp(&key(b)).then_with(|| a.cmp(b))
}

#[cfg(test)]
pub(crate) mod tests;
