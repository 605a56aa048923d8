//! Reader of NIfTI-1 and NIfTI-2 in one file (`.nii`, `.nii.gz`), in both byte orders.
//!
//! The header is a C struct, read by a table of offsets; [`Header::parse`] has the tables of both
//! versions. World axes are RAS+ by definition. The affine is the sform if its code is above zero,
//! else the qform, else the spacings alone (methods 3, 2 and 1 of nifti1.h), as in nibabel. [`pair`]
//! reads a header and its samples in two files.

pub(crate) mod pair;

use crate::colours;
use crate::data;
use crate::error::{OpenErrorKind, Problem};
use crate::members::{Members, Packing};
use crate::numbers::Beside;
use crate::pick::{Axis, Kind, Part, Pick};
use crate::samples::{self, Endian, Layout, Number, SKIP_MAX_BYTES, Supply};
use crate::source::{self, Source};
use glam::{DMat3, DVec3};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use std::io::Read;

/// Size of a NIfTI-2 header.
const HEADER_2_BYTES: usize = 540;

/// Returns whether the first bytes, after decompression, are a header: of one file, of a pair or of
/// ANALYZE.
pub(crate) fn sniff(head: &[u8]) -> bool {
    let Some(size) = head.first_chunk::<4>() else { return false };
    matches!(u32::from_le_bytes(*size), 348 | 540) || matches!(u32::from_be_bytes(*size), 348 | 540)
}

/// Reads a volume from the start of a source.
pub(crate) fn read(source: Source, gzip: bool, name: &str) -> Result<Volume, Problem> {
    let (source_pick, said) = (source.pick, source.notes.clone());
    let (len, cap, beside) = (source.len, source.cap.clone(), source.cap.beside);
    let file = if gzip { None } else { source.reader.get_ref().file() };
    let mut reader: Box<dyn Read + Send> = match gzip {
        true => Box::new(Members::new(Packing::Gzip, source.reader, source.notes.clone())),
        false => Box::new(source.reader),
    };
    let reader = &mut *reader;
    let mut bytes = [0u8; HEADER_2_BYTES];
    fill(reader, &mut bytes[..4])?;
    let size = *bytes.first_chunk::<4>().expect("four bytes");
    let (size, endian) = match (u32::from_le_bytes(size), u32::from_be_bytes(size)) {
        (size @ (348 | 540), _) => (size as usize, Endian::Little),
        (_, size @ (348 | 540)) => (size as usize, Endian::Big),
        (size, _) => {
            return Err(Problem::malformed(
                "sizeof_hdr",
                format!("is {size}, not 348 (NIfTI-1) or 540 (NIfTI-2)"),
                "convert it to NIfTI-1",
            ));
        }
    };
    fill(reader, &mut bytes[4..size])?;
    let header = Header::parse(&bytes[..size], endian)?;
    let (layout, part, notes) = header.layout(endian, source_pick)?;
    notes.into_iter().for_each(|note| said.add(note));
    let (lattice, anatomical) = header.lattice(layout.dims)?;
    let skip = header.skip_bytes(size as u64)?;
    if !source::skip_bytes(reader, skip).map_err(|e| broken(&e))? {
        return Err(Problem::malformed(
            "vox_offset",
            format!("{:?} lies past the end of the data", header.vox_offset),
            "get the whole file",
        ));
    }
    let supply = match gzip {
        true => Supply::deflate("gzip", len),
        false => Supply::Plain { have: len.saturating_sub(size as u64 + skip) },
    };
    if let Some(stream) = cap.beside.stream() {
        stream.set_place(file, Ok(size as u64 + skip));
    }
    let (samples, stored) = match &part {
        Some(part) => data::read_part(reader, supply, part, &layout, cap)?,
        None => samples::read(reader, supply, &layout, cap)?,
    };
    header.volume(name, anatomical, &layout, lattice, (samples, stored), &beside)
}

fn fill(reader: &mut dyn Read, bytes: &mut [u8]) -> Result<(), Problem> {
    reader.read_exact(bytes).map_err(|e| broken(&e))
}

fn broken(e: &std::io::Error) -> Problem {
    // Our own readers wrap a problem in the error; pass it on unchanged.
    if let Some(problem) = e.get_ref().and_then(|inner| inner.downcast_ref::<Problem>()) {
        return problem.clone();
    }
    match e.kind() {
        std::io::ErrorKind::UnexpectedEof => Problem::new(
            OpenErrorKind::Damaged,
            "header",
            "truncated: the file ends before the samples",
            "get the whole file",
        ),
        std::io::ErrorKind::InvalidInput | std::io::ErrorKind::InvalidData => Problem::new(
            OpenErrorKind::Damaged,
            "header",
            format!("the gzip stream is damaged ({e})"),
            "get the file again",
        ),
        _ => Problem::io("header", e),
    }
}

/// Reads numbers at offsets of the header, in the file's byte order.
struct HeaderBytes<'a> {
    bytes: &'a [u8],
    endian: Endian,
}

macro_rules! getters {
    ($($name:ident: $t:ty),*) => {$(
        fn $name(&self, offset: usize) -> $t {
            let word = *self.bytes[offset..].first_chunk().expect("offsets lie inside the header");
            match self.endian {
                Endian::Little => <$t>::from_le_bytes(word),
                Endian::Big => <$t>::from_be_bytes(word),
            }
        }
    )*};
}

impl HeaderBytes<'_> {
    getters!(i16: i16, i32: i32, i64: i64, f32: f32, f64: f64);
}

/// The header fields that are used, named as in nifti1.h.
struct Header {
    /// `dim[0]` to `dim[7]`.
    dim: [i64; 8],
    datatype: i16,
    pixdim: [f64; 8],
    vox_offset: f64,
    slope: f64,
    inter: f64,
    units: u8,
    qform_code: i32,
    sform_code: i32,
    quatern: [f64; 3],
    qoffset: [f64; 3],
    srow: [[f64; 4]; 3],
}

impl Header {
    fn parse(bytes: &[u8], endian: Endian) -> Result<Header, Problem> {
        let version_2 = bytes.len() == HEADER_2_BYTES;
        let magic = if version_2 { &bytes[4..8] } else { &bytes[344..348] };
        match magic {
            b"n+1\0" | b"n+2\0" => {}
            _ => {
                return Err(Problem::unsupported(
                    "magic",
                    format!(
                        "is {}, so this is damaged",
                        crate::error::quoted(&String::from_utf8_lossy(magic),)
                    ),
                    "get the file again",
                ));
            }
        }
        Ok(Header::fields(bytes, endian))
    }

    /// Reads the fields, whatever the magic is.
    fn fields(bytes: &[u8], endian: Endian) -> Header {
        let b = HeaderBytes { bytes, endian };
        use std::array::from_fn;
        if bytes.len() == HEADER_2_BYTES {
            Header {
                dim: from_fn(|i| b.i64(16 + 8 * i)),
                datatype: b.i16(12),
                pixdim: from_fn(|i| b.f64(104 + 8 * i)),
                vox_offset: b.i64(168) as f64,
                slope: b.f64(176),
                inter: b.f64(184),
                units: b.i32(500) as u8,
                qform_code: b.i32(344),
                sform_code: b.i32(348),
                quatern: from_fn(|i| b.f64(352 + 8 * i)),
                qoffset: from_fn(|i| b.f64(376 + 8 * i)),
                srow: from_fn(|r| from_fn(|c| b.f64(400 + 32 * r + 8 * c))),
            }
        } else {
            let f = |offset| f64::from(b.f32(offset));
            Header {
                dim: from_fn(|i| b.i16(40 + 2 * i).into()),
                datatype: b.i16(70),
                pixdim: from_fn(|i| f(76 + 4 * i)),
                vox_offset: f(108),
                slope: f(112),
                inter: f(116),
                units: bytes[123],
                qform_code: b.i16(252).into(),
                sform_code: b.i16(254).into(),
                quatern: from_fn(|i| f(256 + 4 * i)),
                qoffset: from_fn(|i| f(268 + 4 * i)),
                srow: from_fn(|r| from_fn(|c| f(280 + 16 * r + 4 * c))),
            }
        }
    }

    /// Returns the layout of the volume that is read, which part of the samples it is, if not all,
    /// and notes.
    fn layout(
        &self,
        endian: Endian,
        pick: Pick,
    ) -> Result<(Layout, Option<Part>, Vec<String>), Problem> {
        let number = match self.datatype {
            2 => Number::U8,
            4 => Number::I16,
            8 => Number::I32,
            16 => Number::F32,
            64 => Number::F64,
            256 => Number::I8,
            512 => Number::U16,
            768 => Number::U32,
            1024 => Number::I64,
            1280 => Number::U64,
            // Components of 8 bits beside each other.
            128 | 2304 => Number::U8,
            code => {
                let name = match code {
                    1 => "one bit a voxel",
                    32 | 1792 | 2048 => "complex numbers",
                    1536 => "128-bit floats",
                    _ => "not a type of the NIfTI format",
                };
                return Err(Problem::unsupported(
                    "datatype",
                    format!("{code} is {name}"),
                    "convert it to one number a voxel, such as int16 or float32",
                ));
            }
        };
        let axes = match self.dim[0] {
            n @ 3..=7 => n as usize,
            2 => {
                let [width, height] = [1, 2].map(|a| self.dim[a].try_into().unwrap_or(0));
                return Err(Problem::flat("dim[0]", width, height));
            }
            n => {
                return Err(Problem::malformed(
                    "dim[0]",
                    format!("is {n}; a volume has 3 axes"),
                    "convert it to a volume with three axes",
                ));
            }
        };
        let dims: [u64; 3] = std::array::from_fn(|a| self.dim[a + 1].try_into().unwrap_or(0));
        let layout = Layout::new(dims, number, endian, "dim")?;
        let colours = match self.datatype {
            128 => Some(("RGB", 3)),
            2304 => Some(("RGBA", 4)),
            _ => None,
        };
        let mut more = Vec::new();
        if let Some((name, size)) = colours {
            more.push(Axis::of_voxel(format!("colours ({name})"), size, true));
        }
        for a in 4..=axes {
            let Ok(size @ 1..) = u64::try_from(self.dim[a]) else {
                return Err(Problem::malformed(
                    format!("dim[{a}]"),
                    format!("is {}", self.dim[a]),
                    "correct it (1 if there is one volume)",
                ));
            };
            more.push(match a {
                4 => Axis::new(Kind::Time, "times", size),
                // The standard's place for the components of vectors.
                5 => Axis::of_voxel("components", size, colours::may_be_colours(size, number)),
                _ => Axis::new(Kind::Other, format!("along dim[{a}]"), size),
            });
        }
        if more.iter().all(|axis| axis.size == 1) {
            more.clear();
        }
        let field = match (colours, more.iter().any(|a| a.of_voxel && a.size > 1)) {
            (Some(_), _) => "datatype",
            (None, true) => "dim[5]",
            _ => "dim[4]",
        };
        let (at, notes) = pick.choose(&more, field)?;
        if more.is_empty() {
            return Ok((layout, None, notes));
        }
        let mut sizes: Vec<u64> = more.iter().map(|axis| axis.size).collect();
        let mut at: Vec<Option<u64>> = at.into_iter().map(Some).collect();
        let first = usize::from(colours.is_some());
        sizes.splice(first..first, dims);
        at.splice(first..first, [None; 3]);
        let part = Part::new(&sizes, at, number.bytes()).ok_or_else(|| {
            Problem::malformed("dim", "has more samples than can be", "correct it")
        })?;
        Ok((layout, Some(part), notes))
    }

    /// Returns the bytes between the header and the first sample.
    fn skip_bytes(&self, header_bytes: u64) -> Result<u64, Problem> {
        let offset = self.vox_offset;
        // Some programs leave it zero; samples then follow the four bytes of the extender.
        if offset == 0.0 {
            return Ok(4);
        }
        let first = header_bytes as f64;
        if !(first..=first + SKIP_MAX_BYTES as f64).contains(&offset) || offset.fract() != 0.0 {
            return Err(Problem::malformed(
                "vox_offset",
                format!("{offset:?} is not a position between {first} and 16 MiB behind it"),
                "correct it (352 where there are no extensions)",
            ));
        }
        Ok(offset as u64 - header_bytes)
    }

    /// Returns the lattice, and whether its axes are anatomical.
    fn lattice(&self, dims: [u32; 3]) -> Result<(Lattice, bool), Problem> {
        let mm = match self.units & 7 {
            1 => 1000.0,
            3 => 1e-3,
            _ => 1.0,
        };
        // Some programs write a spacing with the sign of its axis.
        let spacing: [f64; 3] = std::array::from_fn(|a| self.pixdim[a + 1].abs());
        let (steps, origin, field) = if self.sform_code > 0 {
            let column = |c: usize| DVec3::from_array(self.srow.map(|row| row[c]));
            ([column(0), column(1), column(2)], column(3), "srow")
        } else if self.qform_code > 0 {
            let r = self.rotation()?;
            let sign = if self.pixdim[0] < 0.0 { -1.0 } else { 1.0 };
            let steps =
                [r.x_axis * spacing[0], r.y_axis * spacing[1], r.z_axis * spacing[2] * sign];
            (steps, DVec3::from_array(self.qoffset), "pixdim")
        } else {
            (Lattice::from_spacing(dims, spacing).steps, DVec3::ZERO, "pixdim")
        };
        // Adding zero turns -0.0 into 0.0, which the volume's digest would distinguish.
        let steps = steps.map(|s| s * mm + DVec3::ZERO);
        let lattice = Lattice { dims, steps, origin: origin * mm + DVec3::ZERO };
        lattice.check().map_err(|e| Problem::malformed(field, e, "correct the header's affine"))?;
        Ok((lattice, self.sform_code > 0 || self.qform_code > 0))
    }

    /// Returns the rotation of the qform's unit quaternion (a, b, c, d), whose a is not in the
    /// file.
    fn rotation(&self) -> Result<DMat3, Problem> {
        let [b, c, d] = self.quatern;
        let rest = b * b + c * c + d * d;
        if !rest.is_finite() {
            return Err(Problem::malformed(
                "quatern",
                "is not finite",
                "correct the header's qform",
            ));
        }
        // Rounding to f32 may leave (b, c, d) slightly longer than 1; then a is 0, as in
        // nifti1_io.c.
        let (a, b, c, d) = if rest > 1.0 - 1e-7 {
            let s = 1.0 / rest.sqrt();
            (0.0, b * s, c * s, d * s)
        } else {
            ((1.0 - rest).sqrt(), b, c, d)
        };
        Ok(DMat3::from_cols(
            DVec3::new(a * a + b * b - c * c - d * d, 2.0 * (b * c + a * d), 2.0 * (b * d - a * c)),
            DVec3::new(2.0 * (b * c - a * d), a * a + c * c - b * b - d * d, 2.0 * (c * d + a * b)),
            DVec3::new(2.0 * (b * d + a * c), 2.0 * (c * d - a * b), a * a + d * d - c * c - b * b),
        ))
    }

    /// Returns the volume of these samples, whose codes `stored` maps to numbers.
    fn volume(
        &self,
        name: &str,
        anatomical: bool,
        layout: &Layout,
        lattice: Lattice,
        (samples, stored): (Samples, ValueMap),
        beside: &Beside,
    ) -> Result<Volume, Problem> {
        let map = self.value_map(stored);
        if let Some(rescale) = self.rescale() {
            beside.rescale(rescale);
        }
        let volume =
            crate::stream::volume(name, layout.number.name(), anatomical, lattice, samples, map);
        let (lo, hi) = volume.summary.range();
        if !(lo.is_finite() && hi.is_finite() && map.scale.is_normal()) {
            return Err(Problem::malformed(
                "scl_slope",
                format!("{:?} takes the values out of the range of numbers", self.slope),
                "correct scl_slope and scl_inter",
            ));
        }
        Ok(volume)
    }

    /// Returns slope and intercept, if the header has them.
    fn rescale(&self) -> Option<ValueMap> {
        // "If the scl_slope field is nonzero" (nifti1.h); SPM writes NaN for none.
        if self.slope == 0.0 || !self.slope.is_finite() {
            return None;
        }
        let offset = if self.inter.is_finite() { self.inter } else { 0.0 };
        Some(ValueMap { scale: self.slope, offset })
    }

    /// Returns the map from codes to values: `stored`, then the header's slope and intercept.
    fn value_map(&self, stored: ValueMap) -> ValueMap {
        let Some(ValueMap { scale, offset }) = self.rescale() else { return stored };
        ValueMap { scale: scale * stored.scale, offset: scale * stored.offset + offset }
    }
}

#[cfg(test)]
pub(crate) mod tests;
