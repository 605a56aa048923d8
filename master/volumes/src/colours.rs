//! Volumes of colours: voxels of three or four numbers that are red, green, blue and alpha.
//!
//! Readers know volumes of one number a voxel, and take one of several with `--channel`. So a file
//! of colours is refused by its reader, and the refusal says that the numbers are colours
//! ([`Problem::colours`]). It is then read once for each of them, and a palette is made of the
//! numbers: up to 65,536 colours are kept as they are. Of more, each channel loses bits, one
//! channel after the other, until they are few enough; a colour is then the mean of those that
//! became one. This is even over the cube of colours and needs no order of voxels, so the same file
//! has the same palette everywhere. Clustering (median cut) would round the common colours less, by
//! a level or two.
//!
//! Reading a compressed file three times takes three times as long. That was chosen over a second
//! kind of samples in every reader.

use crate::error::{OpenErrorKind, Problem};
use crate::numbers::{Beside, Pieces};
use crate::pick::Pick;
use crate::samples::{self, Number};
use crate::{Hints, Opened};
use slabcast_common::volume::{
    COLOURS_MAX, ColourValue, Palette, SampleKind, Samples, ValueMap, Volume,
};
use std::path::Path;

/// Reads one volume with hints.
type Read<'a> = &'a dyn Fn(&Path, &Hints) -> Result<Opened, Problem>;

/// Reads the volume of colours that a reader refused with `refusal`; passes other refusals on.
pub(crate) fn instead(
    refusal: Problem,
    path: &Path,
    hints: &Hints,
    open: Read<'_>,
) -> Result<Opened, Problem> {
    let Some(channels @ 3..=4) = refusal.colours else { return Err(refusal) };
    // A stream takes one number a voxel.
    if hints.beside.stream().is_some() {
        return Err(Problem { colours: None, ..refusal });
    }
    let mut notes = Vec::new();
    let mut planes: Vec<Samples> = Vec::new();
    let mut first: Option<Volume> = None;
    for channel in 0..u64::from(channels) {
        let pick = Pick { channel: Some(channel), ..hints.pick };
        // The numbers are kept by this module.
        let hints = Hints { pick, beside: Beside::new(false), ..hints.clone() };
        let mut opened = open(path, &hints)?;
        let samples = std::mem::replace(&mut opened.volume.samples, Samples::U8(Vec::new()));
        match &first {
            None => {
                if samples.kind() == SampleKind::F32
                    || opened.volume.summary.map != ValueMap::IDENTITY
                {
                    // Signed numbers and floats are no shares of light.
                    return Err(Problem { colours: None, ..refusal });
                }
                let voxels = samples.len() as u64 * samples.kind().bytes() as u64;
                hints.cap().check_asked(voxels * u64::from(channels), "size")?;
                notes.append(&mut opened.notes);
                notes.extend(hints.beside.take_notes());
                first = Some(opened.volume);
            }
            Some(first) => {
                let same = first.lattice == opened.volume.lattice
                    && planes[0].kind() == samples.kind()
                    && planes[0].len() == samples.len();
                if !same {
                    return Err(Problem::new(
                        OpenErrorKind::Damaged,
                        "content",
                        "changed while it was read",
                        "open it again when it is written",
                    ));
                }
            }
        }
        planes.push(samples);
    }
    let first = first.expect("there are three channels or more");
    let (bytes, scaled) = to_bytes(&planes)?;
    notes.extend(scaled);
    if hints.beside.keeps() {
        hints.beside.leave_colours(interleaved(&planes)?, planes.len());
    }
    let file_type = first.file_type.clone();
    drop(planes);
    let made = Made::of(&bytes)?;
    notes.extend(made.notes(hints.beside.keeps()));
    let Made { palette, places, .. } = made;
    let name = format!("{} {file_type}", palette.channels_name());
    let volume =
        Volume::coloured(first.name, name, first.anatomical, first.lattice, palette.into(), places);
    let volume = volume.expect("places are those of the palette");
    Ok(Opened { volume, notes })
}

/// Returns channels of 8 bits, and a note if they had 16.
fn to_bytes(planes: &[Samples]) -> Result<(Vec<Vec<u8>>, Option<String>), Problem> {
    let largest = planes.iter().map(|plane| match plane {
        Samples::U16(v) => v.iter().copied().max().unwrap_or(0),
        _ => 255,
    });
    let largest = largest.max().unwrap_or(255);
    // Cameras write 10, 12 and 14 bits into 16.
    let bits = [8, 10, 12, 14, 16].into_iter().find(|bits| u32::from(largest) >> bits == 0);
    let full = (1u32 << bits.unwrap_or(16)) - 1;
    let wide = planes.iter().any(|plane| matches!(plane, Samples::U16(_)));
    let note = wide.then(|| {
        format!("colours of 16 bits are drawn with 8: 0 to {full} was scaled to 0 to 255")
    });
    let mut all = Vec::new();
    for plane in planes {
        let mut bytes = Vec::new();
        samples::reserve(&mut bytes, plane.len())?;
        match plane {
            Samples::U16(v) => {
                bytes.extend(v.iter().map(|&x| ((u32::from(x) * 255 + full / 2) / full) as u8));
            }
            Samples::U8(v) => bytes.extend_from_slice(v),
            Samples::F32(_) => unreachable!("refused above"),
        }
        all.push(bytes);
    }
    Ok((all, note))
}

/// Interleaves the numbers of all channels, so that the numbers of a voxel lie beside each other.
fn interleaved(planes: &[Samples]) -> Result<Pieces, Problem> {
    macro_rules! all {
        ($kind:ident) => {{
            let each = planes.iter().filter_map(|plane| match plane {
                Samples::$kind(v) => Some(v),
                _ => None,
            });
            let each: Vec<_> = each.collect();
            let mut out = Vec::new();
            samples::reserve(&mut out, each.len() * each[0].len())?;
            for i in 0..each[0].len() {
                out.extend(each.iter().map(|v| v[i]));
            }
            Pieces::$kind(vec![out])
        }};
    }
    Ok(match &planes[0] {
        Samples::U16(_) => all!(U16),
        _ => all!(U8),
    })
}

/// A palette and the places of voxels in it.
struct Made {
    palette: Palette,
    places: Vec<u16>,
    /// Largest difference of a number from the file's; 0 if all colours are kept.
    rounded: u8,
    /// The alpha of all voxels, if it is the same everywhere.
    even_alpha: Option<u8>,
}

/// Order in which channels lose a bit: the eye sees blue worst. Alpha keeps the most.
const COARSER: [usize; 4] = [2, 0, 1, 3];

impl Made {
    /// Makes the palette of three or four channels of the same length.
    fn of(planes: &[Vec<u8>]) -> Result<Made, Problem> {
        let (has_alpha, count) = (planes.len() == 4, planes[0].len());
        let even_alpha = planes.get(3).and_then(|alphas| {
            let first = *alphas.first()?;
            alphas.iter().all(|&a| a == first).then_some(first)
        });
        let value = match has_alpha && even_alpha.is_none() {
            true => ColourValue::Alpha,
            false => ColourValue::Luminance,
        };
        let colour = |i: usize| -> [u8; 4] {
            [planes[0][i], planes[1][i], planes[2][i], planes.get(3).map_or(255, |a| a[i])]
        };
        let mut lost = [0u32; 4];
        let mut turn = 0;
        let mut places = Vec::new();
        samples::reserve(&mut places, count)?;
        let cells = loop {
            if Cells::place(count, colour, lost, &mut places) {
                break Cells::means(count, colour, &places);
            }
            let channel = COARSER[turn % COARSER.len()];
            lost[channel] += u32::from(channel < planes.len());
            turn += 1;
        };
        let mut order: Vec<u16> = (0..cells.len()).map(|i| i as u16).collect();
        order.sort_unstable_by_key(|&i| {
            let colour = cells[usize::from(i)];
            (value.of(colour), colour)
        });
        let mut rank = vec![0u16; cells.len()];
        for (to, &from) in order.iter().enumerate() {
            rank[usize::from(from)] = to as u16;
        }
        places.iter_mut().for_each(|place| *place = rank[usize::from(*place)]);
        let colours: Vec<[u8; 4]> = order.iter().map(|&i| cells[usize::from(i)]).collect();
        let mut rounded = 0;
        if lost != [0; 4] {
            for (i, &place) in places.iter().enumerate() {
                let (a, b) = (colour(i), colours[usize::from(place)]);
                let apart = (0..4).map(|c| a[c].abs_diff(b[c])).max();
                rounded = rounded.max(apart.unwrap_or(0));
            }
        }
        let palette = Palette::new(colours, has_alpha, value).expect("distinct cells in order");
        Ok(Made { palette, places, rounded, even_alpha })
    }

    /// Returns what was decided, one sentence each. `kept` says that the file's own numbers are
    /// kept.
    fn notes(&self, kept: bool) -> Vec<String> {
        let mut notes = Vec::new();
        if self.rounded > 0 && !kept {
            notes.push(format!(
                "its more than {COLOURS_MAX} colours were rounded to {}, by up to {} of 255; \
                 `slabcast convert` keeps them",
                self.palette.colours().len(),
                self.rounded
            ));
        }
        if let (Some(alpha), false) = (self.even_alpha, kept) {
            notes.push(format!("alpha is {alpha} everywhere, so opacity follows luminance"));
        }
        notes
    }
}

/// Cells of colours, numbered in the order in which voxels come: a table of open addresses, since
/// it is asked for every voxel.
struct Cells {
    /// Key and number of each cell; numbers above [`COLOURS_MAX`] are free places.
    slots: Vec<(u32, u32)>,
    len: u32,
}

/// Places of the table: twice the cells.
const SLOTS_BITS: u32 = 17;
const FREE: u32 = u32::MAX;

impl Cells {
    /// Writes the cell of each colour without its lowest `lost` bits; false if there are more than
    /// [`COLOURS_MAX`]. What has no opacity at all stays so.
    fn place(
        count: usize,
        colour: impl Fn(usize) -> [u8; 4],
        lost: [u32; 4],
        places: &mut Vec<u16>,
    ) -> bool {
        let mut cells = Cells { slots: vec![(0, FREE); 1 << SLOTS_BITS], len: 0 };
        places.clear();
        let (mut last_key, mut last) = (0, FREE);
        for i in 0..count {
            let c = colour(i);
            let mut cell: [u8; 4] = std::array::from_fn(|channel| c[channel] >> lost[channel]);
            // At most 128 of 7 bits, so there is room for one more.
            cell[3] += u8::from(lost[3] > 0 && c[3] > 0);
            let key = u32::from_le_bytes(cell);
            if last == FREE || key != last_key {
                let Some(number) = cells.number(key) else { return false };
                (last_key, last) = (key, number);
            }
            places.push(last as u16);
        }
        true
    }

    fn number(&mut self, key: u32) -> Option<u32> {
        let mut at = (key.wrapping_mul(0x9e37_79b1) >> (32 - SLOTS_BITS)) as usize;
        loop {
            match &mut self.slots[at] {
                (_, FREE) if self.len as usize == COLOURS_MAX => return None,
                slot @ (_, FREE) => {
                    *slot = (key, self.len);
                    self.len += 1;
                    return Some(self.len - 1);
                }
                (there, number) if *there == key => return Some(*number),
                _ => at = (at + 1) % self.slots.len(),
            }
        }
    }

    /// Returns the mean colour of each cell, rounded.
    fn means(count: usize, colour: impl Fn(usize) -> [u8; 4], places: &[u16]) -> Vec<[u8; 4]> {
        let cells = places.iter().max().map_or(0, |&most| usize::from(most) + 1);
        let mut sums = vec![([0u64; 4], 0u64); cells];
        for (i, &place) in places.iter().enumerate().take(count) {
            let (sum, n) = &mut sums[usize::from(place)];
            sum.iter_mut().zip(colour(i)).for_each(|(sum, c)| *sum += u64::from(c));
            *n += 1;
        }
        sums.iter().map(|(sum, n)| sum.map(|s| ((s + n / 2) / n) as u8)).collect()
    }
}

/// Returns whether the numbers of a voxel, all of one type, are colours unless the file says that
/// they are not: three or four of 8 or 16 bits without sign.
pub(crate) fn may_be_colours(count: u64, number: Number) -> bool {
    matches!(count, 3..=4) && matches!(number, Number::U8 | Number::U16)
}

#[cfg(test)]
pub(crate) mod tests;
