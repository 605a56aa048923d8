//! Reader of pairs: the header in `NAME.hdr`, the samples in `NAME.img`, either also in gzip. They
//! are NIfTI-1, NIfTI-2, or ANALYZE 7.5, from which NIfTI-1 took its fields.
//!
//! ANALYZE does not say where left is. Like nibabel, SPM and FSL this reader takes x to the left, y
//! to anterior and z to superior where the field `orient` is 0, and places the origin where SPM's
//! `originator` says, else in the middle. A note says so.

use super::{HEADER_2_BYTES, Header};
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::plain::Plain;
use crate::samples::{Endian, Layout};
use crate::source::{Folder, Inside, Notes, Source};
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};
use std::path::Path;

/// Size of a header of NIfTI-1 and ANALYZE.
const HEADER_1_BYTES: usize = 348;

/// Returns whether the first bytes, after decompression, are the header of a pair of files (NIfTI
/// or ANALYZE), and not of a single file.
pub(crate) fn sniff(start: &[u8]) -> bool {
    let Some(size) = start.first_chunk::<4>() else { return false };
    let is = |n: u32| u32::from_le_bytes(*size) == n || u32::from_be_bytes(*size) == n;
    let single = |magic: Option<&[u8]>| magic.is_none_or(|m| m.starts_with(b"n+"));
    is(348) && !single(start.get(344..348)) || is(540) && !single(start.get(4..8))
}

/// Reads the pair of a header from the header's start; `folder` holds both files.
pub(crate) fn read(
    source: Source,
    gzip: bool,
    folder: &Path,
    name: &str,
) -> Result<Volume, Problem> {
    let (cap, notes, pick) = (source.cap.clone(), source.notes.clone(), source.pick);
    let mut file = Plain::new(source, gzip);
    let mut bytes = [0; HEADER_2_BYTES];
    file.header(&mut bytes[..HEADER_1_BYTES])?;
    let endian = match u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) {
        348 | 540 => Endian::Little,
        _ => Endian::Big,
    };
    let version_2 =
        bytes.starts_with(&540u32.to_le_bytes()) || bytes.starts_with(&540u32.to_be_bytes());
    let size = if version_2 { HEADER_2_BYTES } else { HEADER_1_BYTES };
    file.header(&mut bytes[HEADER_1_BYTES..size])?;
    let bytes = &bytes[..size];
    let magic = if version_2 { &bytes[4..8] } else { &bytes[344..348] };
    let nifti = matches!(magic, b"ni1\0" | b"ni2\0");
    let data = data_beside(folder, name)?.ok_or_else(|| no_data(name, nifti, magic))?;
    let mut header = Header::fields(bytes, endian);
    if !nifti {
        // ANALYZE has fields of another meaning in the places of these.
        (header.qform_code, header.sform_code, header.inter, header.units) = (0, 0, 0.0, 2);
    }
    let (layout, part, said) = header.layout(endian, pick).map_err(|p| match nifti {
        true => p,
        // Programs wrote red, green and blue of ANALYZE beside each other, or slice by slice.
        false => Problem { colours: None, ..p },
    })?;
    said.into_iter().for_each(|note| notes.add(note));
    if !nifti && let Some((stem, _)) = stem(name) {
        let mat = format!("{stem}.mat");
        if let Ok(Inside::File(..)) = Folder::open(folder, "file")?.find(Path::new(&mat)) {
            notes.add(format!("SPM's place in {} was not read", quoted(&mat)));
        }
    }
    let (lattice, anatomical) = match nifti {
        true => header.lattice(layout.dims)?,
        false => analyze_lattice(&header, bytes, endian, &layout, &notes)?,
    };
    let offset = header.vox_offset;
    if !(offset >= 0.0 && offset.fract() == 0.0 && offset <= u64::MAX as f64) {
        return Err(Problem::malformed(
            "vox_offset",
            format!("{offset:?} is no position in the .img file"),
            "correct it (0 where the samples come first)",
        ));
    }
    let (data_name, data) = data;
    let in_data = |mut p: Problem| {
        p.field = format!("{} {}", quoted(&data_name), p.field);
        p
    };
    let beside = cap.beside.clone();
    let mut data = Source { cap, notes, ..data };
    let gzip = data.head().map_err(in_data)?.starts_with(crate::GZIP);
    let mut data = Plain::new(data, gzip);
    data.skip(offset as u64, "vox_offset").map_err(in_data)?;
    let (samples, stored, _) = data.samples(&layout, part.as_ref()).map_err(in_data)?;
    header.volume(name, anatomical, &layout, lattice, (samples, stored), &beside)
}

/// Returns a header's name without its ending, and whether the ending is in capitals; `None` if the
/// name is not a header's. The file of samples has the same stem.
fn stem(name: &str) -> Option<(&str, bool)> {
    let lower = name.to_ascii_lowercase();
    let end = [".hdr", ".hdr.gz"].iter().find(|end| lower.ends_with(**end))?;
    let (stem, end) = name.split_at(name.len() - end.len());
    Some((stem, end.starts_with(".HDR")))
}

/// Opens the samples beside a header; `None` if there are none.
fn data_beside(folder: &Path, name: &str) -> Result<Option<(String, Source)>, Problem> {
    let Some((stem, capital)) = stem(name) else { return Ok(None) };
    let within = Folder::open(folder, "file")?;
    let ends = if capital { [".IMG", ".img", ".IMG.gz"] } else { [".img", ".img.gz", ".IMG"] };
    for end in ends {
        let data = format!("{stem}{end}");
        match within.find(Path::new(&data)) {
            Ok(Inside::Missing) => {}
            _ => return within.named(&data, "file").map(|source| Some((data, source))),
        }
    }
    Ok(None)
}

fn no_data(name: &str, nifti: bool, magic: &[u8]) -> Problem {
    let (what, remedy) = match (stem(name), nifti) {
        (Some((stem, _)), _) => (
            format!(
                "is the header of a pair, and {} is not beside it",
                quoted(&format!("{stem}.img"))
            ),
            "put both files into one folder, under one name",
        ),
        (None, true) => (
            "is the header of a pair (.hdr with .img), and the file is not called .hdr".into(),
            "call the two files NAME.hdr and NAME.img, or convert them to one .nii.gz",
        ),
        (None, false) => (
            format!(
                "is {}, so this is damaged, or an ANALYZE header that is not called .hdr",
                quoted(&String::from_utf8_lossy(magic))
            ),
            "get the file again, or call it .hdr",
        ),
    };
    Problem::new(OpenErrorKind::Malformed, "magic", what, remedy)
}

/// Returns the lattice of an ANALYZE header, and whether its axes are anatomical.
fn analyze_lattice(
    header: &Header,
    bytes: &[u8],
    endian: Endian,
    layout: &Layout,
    notes: &Notes,
) -> Result<(Lattice, bool), Problem> {
    let spacing: [f64; 3] = std::array::from_fn(|a| header.pixdim[a + 1].abs());
    let orient = bytes[252];
    let mut lattice = Lattice::from_spacing(layout.dims, spacing);
    if orient == 0 {
        // Counted from 1.
        let origin: [f64; 3] = std::array::from_fn(|a| {
            let word = [bytes[253 + 2 * a], bytes[254 + 2 * a]];
            f64::from(match endian {
                Endian::Little => i16::from_le_bytes(word),
                Endian::Big => i16::from_be_bytes(word),
            })
        });
        let dims = layout.dims.map(f64::from);
        // SPM's own rule for what is no origin.
        let given = origin.iter().any(|o| *o != 0.0)
            && (0..3).all(|a| -dims[a] < origin[a] && origin[a] < 2.0 * dims[a]);
        let first: [f64; 3] = std::array::from_fn(|a| match given {
            true => origin[a] - 1.0,
            false => (dims[a] - 1.0) / 2.0,
        });
        lattice.steps[0] = -lattice.steps[0] + DVec3::ZERO;
        let middle = (0..3).map(|a| lattice.steps[a] * first[a]).sum::<DVec3>();
        lattice.origin = DVec3::ZERO - middle;
        let origin = if given { "as in SPM's originator" } else { "in the middle" };
        notes.add(format!(
            "ANALYZE does not say where left is; x was taken to the left, as nibabel, SPM and FSL \
             do, and the origin {origin}"
        ));
    } else {
        notes.add(format!(
            "the ANALYZE header has orient {orient}, so its axes were not taken as those of the body"
        ));
    }
    lattice
        .check()
        .map_err(|e| Problem::malformed("pixdim", e, "correct the header's distances"))?;
    Ok((lattice, orient == 0))
}

/// Returns the name of the header that may lie beside a file of samples.
pub(crate) fn header_names(data: &str) -> Vec<String> {
    let lower = data.to_ascii_lowercase();
    let Some(end) = [".img", ".img.gz"].iter().find(|end| lower.ends_with(**end)) else {
        return Vec::new();
    };
    let stem = &data[..data.len() - end.len()];
    [".hdr", ".hdr.gz", ".HDR"].map(|end| format!("{stem}{end}")).to_vec()
}

#[cfg(test)]
pub(crate) mod tests;
