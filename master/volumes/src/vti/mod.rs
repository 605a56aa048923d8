//! Reader of VTK's XML image data (`.vti`): ascii, base64 and appended, plain or in blocks of zlib,
//! lz4 or xz.
//!
//! With raw appended data the file is not valid XML, so it is read as a stream of tags. One array
//! is drawn: the one asked for, else the active scalars of the points, else the first array with
//! one number a point, else the first with one number a cell. Points and cells that VTK's masks
//! hide (`vtkGhostType`, `vtkValidPointMask`) become NaN.
//!
//! Binary data begin with a header of 32- or 64-bit numbers (`header_type`). Plain data have the
//! number of bytes; compressed data have the number of blocks, the size of a whole one, the size of
//! the last, and each compressed size. In base64 the header of a compressed array is encoded
//! separately from its blocks.

mod blocks;
mod tags;

use crate::error::{Problem, quoted};
use crate::limit::ByteCap;
use crate::pick::{Axis, Part};
use crate::samples::{self, Endian, Layout, Number, Supply};
use crate::source::{BUFFER_BYTES, Notes, Source, Stream};
use crate::unpack::{Base64, Encoding};
use crate::{colours, data};
use blocks::{Blocks, Compressor};
use glam::{DMat3, DVec3};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::sync::{Arc, Mutex};
use tags::{Tag, Tags};

const RESAVE: &str = "save it again as one ImageData piece with VTK or ParaView";

/// Returns whether the first bytes are VTK XML of any type.
pub(crate) fn sniff(head: &[u8]) -> bool {
    let text = &head[..head.len().min(4096)];
    let text = text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text).trim_ascii_start();
    let named = || text.windows(8).any(|w| w == b"<VTKFile");
    text.starts_with(b"<VTKFile") || text.starts_with(b"<?xml") && named()
}

/// Reads a volume from the start of a source; `dataset` names its array.
pub(crate) fn read(source: Source, name: &str, dataset: Option<&str>) -> Result<Volume, Problem> {
    let (len, cap, notes, pick) =
        (source.len, source.cap.clone(), source.notes.clone(), source.pick);
    let stream = SharedStream(Arc::new(Mutex::new(source.reader.into_inner())));
    let arrays = Arrays::find(stream.reader(0)?, dataset)?;
    let Arrays { file, image, drawn, names, .. } = &arrays;
    let (array, place) = drawn;
    let colours = colours::may_be_colours(array.components, array.number);
    let numbers = Axis::of_voxel("numbers", array.components, colours);
    let field = format!("DataArray {}", quoted(&array.name));
    let (channel, said) = pick.choose(&[numbers], &field)?;
    said.into_iter().for_each(|note| notes.add(note));
    let channel = channel[0];
    if names.len() > 1 && dataset.is_none() {
        let others: Vec<String> =
            names.iter().filter(|n| **n != array.name).take(8).map(|n| quoted(n)).collect();
        notes.add(format!(
            "the array {} was read, and {} {} not (--dataset takes another)",
            quoted(&array.name),
            others.join(", "),
            if others.len() == 1 { "was" } else { "were" }
        ));
    }
    let open = |place: &Place| -> Result<Data, Problem> {
        let (format, start) = arrays.start(place, len)?;
        Ok((format, stream.reader(start)?, len - start))
    };
    // Masks are read before the array, since its numbers can't be kept for writing if one hides
    // anything.
    let mut hidden: Vec<bool> = Vec::new();
    for (mask, place) in arrays.masks.iter().filter(|(mask, _)| mask.cells == array.cells) {
        let (dims, _) = image.dims_and_origin(mask.cells)?;
        let layout = Layout::new(dims, mask.number, file.endian, "ImageData WholeExtent")?;
        let cap = ByteCap { asked: cap.asked, ..ByteCap::default() };
        let (codes, map) =
            read_array(file, (&layout, None), open(place)?, cap).map_err(|mut p| {
                p.field = format!("DataArray {} {}", quoted(&mask.name), p.field);
                p
            })?;
        hidden.resize(codes.len(), false);
        let flags = hidden.iter_mut().enumerate();
        let count = flags.fold(0u64, |count, (i, hidden)| {
            let hides = mask.hides(map.value(codes.code(i)) as i64);
            *hidden |= hides;
            count + u64::from(hides)
        });
        if count > 0 {
            notes.add(format!(
                "{count} of {} {} are blanked by {}, and have no value",
                codes.len(),
                if mask.cells { "cells" } else { "points" },
                quoted(&mask.name)
            ));
        }
    }
    let beside = cap.beside.clone();
    let mut volume = finish(file, image, (array, channel), open(place)?, (name, cap))?;
    if hidden.contains(&true) {
        // The file's numbers are dropped: written, they would show hidden points.
        beside.take_numbers();
        let code = |(i, hidden): (usize, bool)| match hidden {
            true => f32::NAN,
            false => volume.samples.code(i) as f32,
        };
        let mut codes = Vec::new();
        samples::reserve(&mut codes, hidden.len())?;
        codes.extend(hidden.into_iter().enumerate().map(code));
        let (lattice, map) = (volume.lattice, volume.summary.map);
        volume = Volume::new(name, array.number.name(), false, lattice, Samples::F32(codes), map);
    }
    Ok(volume)
}

/// A stream that several readers share, one at a time.
#[derive(Clone)]
struct SharedStream(Arc<Mutex<Box<dyn Stream>>>);

impl SharedStream {
    /// Returns a reader from byte `start` of the file on. Readers returned earlier must not be used
    /// any more.
    fn reader(&self, start: u64) -> Result<BufReader<Box<dyn Stream>>, Problem> {
        let mut stream = self.clone();
        stream.seek(SeekFrom::Start(start)).map_err(|e| Problem::io("content", &e))?;
        Ok(BufReader::with_capacity(BUFFER_BYTES, Box::new(stream)))
    }

    fn stream(&self) -> std::sync::MutexGuard<'_, Box<dyn Stream>> {
        self.0.lock().unwrap_or_else(|e| e.into_inner())
    }
}

impl Stream for SharedStream {}

impl Read for SharedStream {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        self.stream().read(buf)
    }
}

impl Seek for SharedStream {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.stream().seek(to)
    }
}

/// Place of an array's data.
enum Place {
    /// After its tag, at this place of the file.
    Inline(DataFormat, u64),
    /// At this offset in the appended data.
    Appended(u64),
}

/// The arrays of a file that matter, and where their data are.
struct Arrays {
    file: File,
    image: Image,
    /// The array that is drawn.
    drawn: (Array, Place),
    /// Names of all arrays with one number a point, or a cell.
    names: Vec<String>,
    /// Arrays that hide points or cells.
    masks: Vec<(Array, Place)>,
    /// Format and place of the appended data.
    appended: Option<(DataFormat, u64)>,
}

impl Arrays {
    /// Goes through the tags up to the appended data. `dataset` names the array to draw.
    fn find(reader: BufReader<Box<dyn Stream>>, dataset: Option<&str>) -> Result<Arrays, Problem> {
        let mut tags = Tags::new(reader);
        let (mut file, mut image, mut section) = (None, None, None);
        let (mut drawn, mut names, mut masks): (Option<(Array, Place)>, _, _) =
            (None, Vec::new(), Vec::new());
        // The first array of several numbers a point, if no other is there.
        let mut several: Option<(Array, Place)> = None;
        let mut appended = None;
        let outside = |tag: &Tag| {
            Problem::malformed(tag.name.as_str(), "does not stand inside ImageData", RESAVE)
        };
        loop {
            let tag = match tags.next() {
                Ok(Some(tag)) => tag,
                Ok(None) => break,
                // A damaged tag does no harm once the drawn array is found.
                Err(_) if matches!(drawn, Some((_, Place::Inline(..)))) => break,
                Err(p) => return Err(p),
            };
            match tag.name.as_str() {
                "VTKFile" => file = Some(File::from_tag(&tag)?),
                "ImageData" => image = Some(Image::from_tag(&tag)?),
                "Piece" => image.as_mut().ok_or_else(|| outside(&tag))?.check_piece(&tag)?,
                "PointData" => section = Some(Section::from_tag(&tag, false)),
                "CellData" => section = Some(Section::from_tag(&tag, true)),
                "/PointData" | "/CellData" => section = None,
                "DataArray" => {
                    let Some(section) = &section else { continue };
                    let name = tag.get("Name").unwrap_or_default();
                    let is_mask = MASKS.contains(&name);
                    if !is_mask && is_single(&tag) && names.len() < NAMES_MAX {
                        names.push(name.to_string());
                    }
                    let found = match is_mask {
                        true => Some(section.array(&tag)?),
                        false if drawn.is_none() => section.select(&tag, dataset)?,
                        false => None,
                    };
                    let spare = drawn.is_none() && several.is_none() && dataset.is_none();
                    let found = match found {
                        None if spare && !is_mask && !is_single(&tag) => Some(section.array(&tag)?),
                        found => found,
                    };
                    let Some(array) = found else { continue };
                    if file.is_none() || image.is_none() {
                        return Err(outside(&tag));
                    }
                    let place = match tag.required("format")? {
                        "appended" => {
                            tag.required("offset")?;
                            let [offset] = tag.numbers::<u64, 1>("offset")?.unwrap_or_default();
                            Place::Appended(offset)
                        }
                        "ascii" => Place::Inline(DataFormat::Text, tags.offset),
                        "binary" => Place::Inline(DataFormat::Base64, tags.offset),
                        _ => return Err(tag.bad("format", "ascii, binary or appended")),
                    };
                    match is_mask {
                        true if masks.len() < MASKS.len() => masks.push((array, place)),
                        true => {}
                        false
                            if array.components > 1
                                && dataset.is_none()
                                && !section.is_active(&array) =>
                        {
                            several = Some((array, place));
                        }
                        false => drawn = Some((array, place)),
                    }
                }
                "AppendedData" => {
                    let format = match tag.required("encoding")? {
                        "raw" => DataFormat::Raw,
                        "base64" => DataFormat::Base64,
                        _ => return Err(tag.bad("encoding", "raw or base64")),
                    };
                    let start = if tags.skip_past(b'_')? { tags.offset } else { u64::MAX };
                    appended = Some((format, start));
                    break;
                }
                _ => {}
            }
        }
        match (file, image, drawn.or(several)) {
            (Some(file), Some(image), Some(drawn)) => {
                Ok(Arrays { file, image, drawn, names, masks, appended })
            }
            (None, ..) => Err(Problem::malformed("VTKFile", "is missing", RESAVE)),
            (Some(_), Some(_), None) if dataset.is_some() => {
                let list: Vec<String> = names.iter().take(6).map(|n| quoted(n)).collect();
                let list = if list.is_empty() { "no arrays".into() } else { list.join(", ") };
                Err(Problem::malformed(
                    "--dataset",
                    format!(
                        "there is no {} with one number a point or cell among {list}",
                        quoted(dataset.unwrap_or_default())
                    ),
                    "name one of them",
                ))
            }
            _ => Err(Problem::unsupported(
                "DataArray",
                "there is none that can be drawn",
                "save a volume of numbers",
            )),
        }
    }

    /// Returns the format and the place in the file, of `len` bytes, of an array's data.
    fn start(&self, place: &Place, len: u64) -> Result<(DataFormat, u64), Problem> {
        let offset = match place {
            Place::Inline(format, start) => return Ok((*format, (*start).min(len))),
            Place::Appended(offset) => *offset,
        };
        let Some((format, start)) = self.appended else {
            return Err(Problem::malformed("AppendedData", "is missing", "get the whole file"));
        };
        match start.checked_add(offset) {
            Some(start) if start < len => Ok((format, start)),
            _ => Err(Problem::malformed(
                format!("DataArray {} offset", quoted(&self.drawn.0.name)),
                format!("{offset} lies past the end of the file"),
                "get the whole file",
            )),
        }
    }
}

/// Names of the arrays in which VTK marks hidden points and cells, and those that another piece
/// has. They are never the volume.
const MASKS: [&str; 4] =
    ["vtkGhostType", "vtkValidPointMask", "vtkValidCellMask", "vtkGhostLevels"];
/// Most names kept for the note on other arrays.
const NAMES_MAX: usize = 64;

/// Attributes of the `VTKFile` element.
struct File {
    endian: Endian,
    /// Bytes of a number in a data header, 4 or 8.
    header_word_bytes: usize,
    /// Compression of the blocks of binary data; `None` for uncompressed data.
    compressor: Option<Compressor>,
}

impl File {
    fn from_tag(tag: &Tag) -> Result<File, Problem> {
        if tag.required("type")? != "ImageData" {
            return Err(Problem::unsupported(
                "VTKFile type",
                format!("{} is no ImageData", quoted(tag.get("type").unwrap_or_default())),
                "resample it to an image (ParaView: Resample To Image)",
            ));
        }
        let endian = match tag.get("byte_order") {
            None | Some("LittleEndian") => Endian::Little,
            Some("BigEndian") => Endian::Big,
            Some(_) => return Err(tag.bad("byte_order", "LittleEndian or BigEndian")),
        };
        let header_word_bytes = match tag.get("header_type") {
            None | Some("UInt32") => 4,
            Some("UInt64") => 8,
            Some(_) => return Err(tag.bad("header_type", "UInt32 or UInt64")),
        };
        let compressor = match tag.get("compressor") {
            None | Some("") => None,
            Some("vtkZLibDataCompressor") => Some(Compressor::Zlib),
            Some("vtkLZ4DataCompressor") => Some(Compressor::Lz4),
            Some("vtkLZMADataCompressor") => Some(Compressor::Xz),
            Some(_) => {
                return Err(tag.bad("compressor", "VTK's ZLib, LZ4 or LZMA, or left out"));
            }
        };
        Ok(File { endian, header_word_bytes, compressor })
    }
}

/// Attributes of `ImageData` and its piece: the grid of points.
struct Image {
    /// First and last index along x, y and z.
    extent: [i64; 6],
    /// Pieces seen so far.
    pieces: u32,
    origin: DVec3,
    /// Linear map from index to world, without the origin.
    steps: DMat3,
}

impl Image {
    fn from_tag(tag: &Tag) -> Result<Image, Problem> {
        tag.required("WholeExtent")?;
        let extent = tag.numbers("WholeExtent")?.unwrap_or_default();
        let spacing = DVec3::from_array(tag.numbers("Spacing")?.unwrap_or([1.0; 3]));
        let origin = DVec3::from_array(tag.numbers("Origin")?.unwrap_or([0.0; 3]));
        let mut steps = DMat3::from_diagonal(spacing);
        if let Some(rows) = tag.numbers::<f64, 9>("Direction")? {
            steps = DMat3::from_cols_array(&rows).transpose() * steps;
        }
        Ok(Image { extent, pieces: 0, origin, steps })
    }

    /// Refuses a second piece, or one that is not the whole image.
    fn check_piece(&mut self, tag: &Tag) -> Result<(), Problem> {
        self.pieces += 1;
        let whole = tag.numbers::<i64, 6>("Extent")?.is_none_or(|e| e == self.extent);
        if self.pieces > 1 || !whole {
            return Err(Problem::unsupported("Piece", "is one of several", RESAVE));
        }
        Ok(())
    }

    /// Returns the number of samples along each axis and the position of the first, for points or
    /// cells.
    fn dims_and_origin(&self, cells: bool) -> Result<([u64; 3], DVec3), Problem> {
        let e = self.extent;
        let (mut dims, mut first) = ([0; 3], DVec3::ZERO);
        for a in 0..3 {
            let points = e[2 * a + 1].checked_sub(e[2 * a]).and_then(|n| n.checked_add(1));
            let Some(points) = points.and_then(|n| u64::try_from(n).ok()) else {
                return Err(Problem::malformed(
                    "ImageData WholeExtent",
                    format!("{} to {} has no points", e[2 * a], e[2 * a + 1]),
                    "save a volume that is not empty",
                ));
            };
            // A flat image has one layer of cells. A cell's value belongs to its middle.
            let halved = cells && points > 1;
            dims[a] = points - u64::from(halved);
            first[a] = e[2 * a] as f64 + if halved { 0.5 } else { 0.0 };
        }
        Ok((dims, self.origin + self.steps * first))
    }
}

/// An open `PointData` or `CellData` element.
struct Section {
    /// Name of the active scalars.
    scalars: Option<String>,
    cells: bool,
}

/// An array that can be drawn.
struct Array {
    name: String,
    number: Number,
    /// Numbers of each point or cell.
    components: u64,
    cells: bool,
}

impl Section {
    fn from_tag(tag: &Tag, cells: bool) -> Section {
        let scalars = tag.get("Scalars").filter(|s| !s.is_empty()).map(String::from);
        Section { scalars, cells }
    }

    /// Returns whether an array has the name of the active scalars.
    fn is_active(&self, array: &Array) -> bool {
        self.scalars.as_ref() == Some(&array.name)
    }

    /// Returns the array of a `DataArray` tag if it is the one to draw. `dataset` names that.
    fn select(&self, tag: &Tag, dataset: Option<&str>) -> Result<Option<Array>, Problem> {
        let name = tag.get("Name").unwrap_or_default();
        let one = is_single(tag);
        if let Some(asked) = dataset {
            return (asked == name).then(|| self.array(tag)).transpose();
        }
        match &self.scalars {
            // Active scalars that are a mask don't choose an array.
            Some(scalars) if scalars != name && !MASKS.contains(&scalars.as_str()) => {
                return Ok(None);
            }
            Some(scalars) if scalars == name && !MASKS.contains(&name) => {}
            _ if !one => return Ok(None),
            _ => {}
        }
        self.array(tag).map(Some)
    }

    /// Returns the array of a `DataArray` tag.
    fn array(&self, tag: &Tag) -> Result<Array, Problem> {
        let name = tag.get("Name").unwrap_or_default();
        let number = match tag.required("type")? {
            "Int8" => Number::I8,
            "UInt8" => Number::U8,
            "Int16" => Number::I16,
            "UInt16" => Number::U16,
            "Int32" => Number::I32,
            "UInt32" => Number::U32,
            "Int64" => Number::I64,
            "UInt64" => Number::U64,
            "Float32" => Number::F32,
            "Float64" => Number::F64,
            _ => return Err(tag.bad("type", "an integer or float type such as UInt8 or Float32")),
        };
        let components = match is_single(tag) {
            true => 1,
            false => tag.numbers::<u64, 1>("NumberOfComponents")?.map_or(1, |[n]| n),
        };
        Ok(Array { name: name.to_string(), number, components, cells: self.cells })
    }
}

/// Returns whether an array has one number a point or cell.
fn is_single(tag: &Tag) -> bool {
    matches!(tag.get("NumberOfComponents"), None | Some("" | "0" | "1"))
}

impl Array {
    /// Returns whether a mask's value hides its point or cell: bits of vtkDataSetAttributes, or 0.
    fn hides(&self, value: i64) -> bool {
        const HIDDEN_POINT: i64 = 2;
        const HIDDEN_CELL: i64 = 32;
        match (self.name.as_str(), self.cells) {
            ("vtkGhostType", false) => value & HIDDEN_POINT != 0,
            ("vtkGhostType", true) => value & HIDDEN_CELL != 0,
            ("vtkValidPointMask" | "vtkValidCellMask", _) => value == 0,
            _ => false,
        }
    }
}

/// An array's data: their encoding, a reader at the first byte, and the bytes left in the file.
type Data = (DataFormat, BufReader<Box<dyn Stream>>, u64);

/// Encoding of an array's data in the file.
#[derive(Clone, Copy, PartialEq)]
enum DataFormat {
    Text,
    Base64,
    Raw,
}

/// Reads the array and makes the volume.
fn finish(
    file: &File,
    image: &Image,
    (array, channel): (&Array, u64),
    (format, reader, left): Data,
    (name, cap): (&str, ByteCap),
) -> Result<Volume, Problem> {
    let (dims, origin) = image.dims_and_origin(array.cells)?;
    let layout = Layout::new(dims, array.number, file.endian, "ImageData WholeExtent")?;
    let steps = [image.steps.x_axis, image.steps.y_axis, image.steps.z_axis];
    // Adding zero turns -0.0 into 0.0, which the digest would distinguish.
    let lattice = Lattice {
        dims: layout.dims,
        steps: steps.map(|s| s + DVec3::ZERO),
        origin: origin + DVec3::ZERO,
    };
    lattice.check().map_err(|e| {
        Problem::malformed("ImageData Spacing", e, "correct the spacing or the axes")
    })?;
    let in_array = |mut p: Problem| {
        p.field = format!("DataArray {} {}", quoted(&array.name), p.field);
        p
    };
    let [ni, nj, nk] = layout.dims.map(u64::from);
    let part = Part::new(
        &[array.components, ni, nj, nk],
        vec![Some(channel), None, None, None],
        array.number.bytes(),
    );
    let Some(part) = part.filter(|part| part.whole_bytes() > 0) else {
        return Err(in_array(Problem::malformed(
            "NumberOfComponents",
            format!("{} are more than can be", array.components),
            "correct it",
        )));
    };
    let part = (array.components > 1).then_some(&part);
    let (samples, map) =
        read_array(file, (&layout, part), (format, reader, left), cap).map_err(in_array)?;
    Ok(crate::stream::volume(name, array.number.name(), false, lattice, samples, map))
}

/// Reads an array, or with `part` one of its components.
fn read_array(
    file: &File,
    (layout, part): (&Layout, Option<&Part>),
    (format, reader, left): Data,
    cap: ByteCap,
) -> Result<(Samples, ValueMap), Problem> {
    let read = |reader: &mut (dyn Read + Send), supply: Supply, layout: &Layout| match part {
        None => samples::read(reader, supply, layout, cap),
        Some(part) => data::read_part(reader, supply, part, layout, cap),
    };
    if format == DataFormat::Text {
        let text = Box::new(blocks::UntilTag { inner: reader });
        let (mut reader, supply) = Encoding::Ascii
            .open(text, left, layout.number, &Notes::default())
            .map_err(|e| Problem::io("data", &e))?;
        return read(&mut *reader, supply, &Layout { endian: Endian::Little, ..*layout });
    }
    let mut data = match format {
        DataFormat::Raw => Bytes::Raw(reader),
        _ => Bytes::Base64(Base64::new(reader)),
    };
    let need = part.map_or(layout.bytes(), Part::whole_bytes);
    let word = |data: &mut Bytes| -> Result<u64, Problem> {
        let mut bytes = [0; 8];
        data.read_exact(&mut bytes[..file.header_word_bytes])
            .map_err(|_| Problem::malformed("header", "is cut off", "get the whole file"))?;
        Ok(match (file.header_word_bytes, file.endian) {
            (4, Endian::Big) => u64::from_be_bytes(bytes) >> 32,
            (_, Endian::Big) => u64::from_be_bytes(bytes),
            (_, Endian::Little) => u64::from_le_bytes(bytes),
        })
    };
    let differs = |got: u64| {
        Problem::malformed(
            "header",
            format!("says {got} bytes, where the extent and the type want {need}"),
            "get the file again, or correct header_type",
        )
    };
    let Some(compressor) = file.compressor else {
        let bytes = word(&mut data)?;
        if bytes != need {
            return Err(differs(bytes));
        }
        let supply = match format {
            DataFormat::Raw => {
                Supply::Plain { have: left.saturating_sub(file.header_word_bytes as u64) }
            }
            _ => Supply::Encoded { name: "base64", bytes: left, ratio: 1 },
        };
        return read(&mut data.take(need), supply, layout);
    };
    let [count, size, last] = [word(&mut data)?, word(&mut data)?, word(&mut data)?];
    let whole = if last == 0 { count } else { count.saturating_sub(1) };
    let total = whole.saturating_mul(size).saturating_add(last);
    if total != need {
        return Err(differs(total));
    }
    // The list of sizes must exist before it takes memory.
    if count.saturating_mul(file.header_word_bytes as u64) > left {
        return Err(Problem::malformed("header", "is cut off", "get the whole file"));
    }
    let mut packed = Vec::new();
    for _ in 0..count {
        packed.push(word(&mut data)?);
    }
    if let Bytes::Base64(data) = &mut data {
        data.restart();
    }
    let bytes = packed.iter().fold(0u64, |sum, &n| sum.saturating_add(n));
    if bytes > left {
        return Err(samples::truncated(bytes, left));
    }
    let mut blocks = Blocks::new(compressor, Box::new(data), packed, [size, last]);
    read(&mut blocks, compressor.supply(bytes), layout)
}

/// Binary data, raw or in base64.
enum Bytes {
    Raw(BufReader<Box<dyn Stream>>),
    Base64(Base64<BufReader<Box<dyn Stream>>>),
}

impl Read for Bytes {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        match self {
            Bytes::Raw(data) => data.read(buf),
            Bytes::Base64(data) => data.read(buf),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
