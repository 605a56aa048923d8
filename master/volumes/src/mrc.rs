//! Reader of MRC and CCP4 maps (`.mrc`, `.map`, `.rec`, `.st`, `.ccp4`), after the MRC2014 format
//! (Cheng et al., J. Struct. Biol. 192, 146): a header of 1024 bytes, an extended one, the samples.
//!
//! MAPC, MAPR and MAPS say which axis of the cell columns, rows and sections run along. The samples
//! stay as they are, and the lattice's steps are turned instead. Lengths are in angstrom.

use crate::error::Problem;
use crate::pick::{Axis, Kind, Part};
use crate::plain::Plain;
use crate::samples::{Endian, Layout, Number};
use crate::source::{Notes, Source};
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};

/// Bytes of the header.
const HEADER_BYTES: usize = 1024;
/// Millimetres of an angstrom.
const ANGSTROM: f64 = 1e-7;
/// IMOD's mark in a header, "IMOD" as a number.
const IMOD_STAMP: i32 = 0x444f_4d49;

/// The header's numbers, in the file's byte order.
struct Header {
    bytes: [u8; HEADER_BYTES],
    endian: Endian,
}

impl Header {
    /// Returns the 32-bit number with this index, counted from 1 as in the format's description.
    fn word(&self, index: usize) -> i32 {
        let word = *self.bytes[4 * index - 4..].first_chunk().expect("it lies inside the header");
        match self.endian {
            Endian::Little => i32::from_le_bytes(word),
            Endian::Big => i32::from_be_bytes(word),
        }
    }

    fn float(&self, index: usize) -> f64 {
        f32::from_bits(self.word(index) as u32).into()
    }

    fn words(&self, first: usize) -> [i32; 3] {
        [0, 1, 2].map(|a| self.word(first + a))
    }

    fn floats(&self, first: usize) -> [f64; 3] {
        [0, 1, 2].map(|a| self.float(first + a))
    }

    /// Returns the axes of the cell along columns, rows and sections, 0 for x; `None` if they are
    /// not three different ones. Zeros, which some programs leave, mean x, y and z.
    fn axes(&self) -> Option<[usize; 3]> {
        let axes = self.words(17);
        if axes == [0; 3] {
            return Some([0, 1, 2]);
        }
        let mut sorted = axes;
        sorted.sort_unstable();
        (sorted == [1, 2, 3]).then(|| axes.map(|a| a as usize - 1))
    }

    /// Returns whether the numbers make sense in this byte order.
    fn is_plausible(&self) -> bool {
        self.words(1).iter().all(|n| (1..=1 << 24).contains(n))
            && matches!(self.word(4), 0..=4 | 6 | 12 | 16 | 101)
            && self.axes().is_some()
    }

    /// Returns the header of a map; `None` if the bytes are none.
    fn new(start: &[u8]) -> Option<Header> {
        let bytes = *start.first_chunk::<HEADER_BYTES>()?;
        let marked = &bytes[208..212] == b"MAP " || &bytes[208..212] == b"MAP\0";
        let order = [Endian::Little, Endian::Big].into_iter().find_map(|endian| {
            let header = Header { bytes, endian };
            header.is_plausible().then_some(header)
        });
        // Before 2000 there was no mark; then the axes have to be told, and the rest to fit.
        order.filter(|h| marked || h.words(17) != [0; 3] && h.has_old_fields())
    }

    /// Returns whether the cell and the extended header are those of a map without a mark.
    fn has_old_fields(&self) -> bool {
        let angle = |a: &f64| (0.0..180.0).contains(a);
        let length = |a: &f64| (0.0..1e7).contains(a);
        self.floats(11).iter().all(length)
            && self.floats(14).iter().all(angle)
            && self.words(8).iter().all(|n| (0..=1 << 24).contains(n))
            && (0..=1 << 24).contains(&self.word(24))
    }
}

/// Returns whether the first bytes, after decompression, are a map.
pub(crate) fn sniff(start: &[u8]) -> bool {
    Header::new(start).is_some()
}

/// Reads a volume from the start of a source; `gzip` says that it is compressed.
pub(crate) fn read(source: Source, gzip: bool, name: &str) -> Result<Volume, Problem> {
    let mut file = Plain::new(source, gzip);
    let notes = file.notes.clone();
    let mut bytes = [0; HEADER_BYTES];
    file.header(&mut bytes)?;
    let Some(header) = Header::new(&bytes) else {
        return Err(Problem::malformed(
            "header",
            "is not that of an MRC map",
            "get the file again",
        ));
    };
    let mut sizes: [u64; 3] = header.words(1).map(|n| n.unsigned_abs().into());
    let group = header.word(23);
    let per_volume = u64::from(header.word(10).unsigned_abs());
    let mut volumes = 1;
    // A stack of volumes has MZ sections in each.
    if group >= 401 && per_volume > 0 && sizes[2].is_multiple_of(per_volume) {
        volumes = sizes[2] / per_volume;
        sizes[2] = per_volume;
    }
    let axes = [Axis::new(Kind::Other, "volumes", volumes)];
    let (at, said) = file.pick.choose(&axes, "ISPG")?;
    said.into_iter().for_each(|note| notes.add(note));
    let mode = header.word(4);
    let number = match mode {
        0 => byte_type(&header, &notes),
        1 => Number::I16,
        2 => Number::F32,
        6 => Number::U16,
        // 16-bit floats.
        12 => Number::F32,
        _ => {
            let what = match mode {
                3 | 4 => "complex numbers, a transform",
                16 => "colours",
                101 => "numbers of four bits",
                _ => "no type that is read",
            };
            return Err(Problem::unsupported(
                "MODE",
                format!("{mode} is {what}"),
                "save it in mode 2 (float32), for instance with IMOD's newstack -mode 2",
            ));
        }
    };
    let half = mode == 12;
    let endian = if half { Endian::Little } else { header.endian };
    let layout = Layout::new(sizes, number, endian, "NX, NY, NZ")?;
    let part = match volumes {
        1 => None,
        _ => Part::new(
            &[&sizes[..], &[volumes]].concat(),
            vec![None, None, None, Some(at[0])],
            if half { 2 } else { number.bytes() },
        ),
    };
    let lattice = lattice(&header, layout.dims, &notes)?;
    let extended = header.word(24);
    let extended = u64::try_from(extended).map_err(|_| {
        Problem::malformed("NSYMBT", format!("is {extended}"), "get the file again")
    })?;
    file.skip(extended, "NSYMBT")?;
    let (kind, (samples, map, after)) = match half {
        true => ("float16", file.halves(&layout, header.endian, part.as_ref())?),
        false => (number.name(), file.samples(&layout, part.as_ref())?),
    };
    if after > 0 {
        notes.add(format!("{after} bytes after the samples were not read"));
    }
    Ok(crate::stream::volume(name, kind, false, lattice, samples, map))
}

/// Returns the type of mode 0, which is signed since 2014 and was unsigned in IMOD before.
fn byte_type(header: &Header, notes: &Notes) -> Number {
    if header.word(39) == IMOD_STAMP {
        return if header.word(40) & 1 == 1 { Number::I8 } else { Number::U8 };
    }
    let (least, most) = (header.float(20), header.float(21));
    let (number, why) = match (least < 0.0, most > 127.0) {
        (false, true) => (Number::U8, "since DMAX is above 127"),
        (true, _) => (Number::I8, "since DMIN is below 0"),
        (false, false) => (Number::I8, "as MRC2014 says; older programs meant uint8"),
    };
    notes.add(format!("mode 0 was read as {}, {why}", number.name()));
    number
}

/// Returns the lattice of a map, in mm.
fn lattice(header: &Header, dims: [u32; 3], notes: &Notes) -> Result<Lattice, Problem> {
    let axes = header.axes().expect("checked with the header");
    let (cell, samples) = (header.floats(11), header.words(8));
    // Steps along the axes of the cell: its sides, divided by the samples along them.
    let mut lengths: [Option<f64>; 3] = std::array::from_fn(|a| {
        let step = cell[a] / f64::from(samples[a]);
        (samples[a] > 0 && step.is_finite() && step > 0.0).then_some(step)
    });
    let section = axes[2];
    // A stack of pictures is one section deep.
    if header.word(23) == 0 && samples[section] == 1 && dims[2] > 1 {
        lengths[section] = None;
    }
    let given = lengths.iter().flatten().next().copied();
    let unit = match given {
        Some(step) => {
            for a in 0..3 {
                if lengths[a].is_none() {
                    lengths[a] = Some(step);
                    notes.add(format!(
                        "the file does not say the step along {}; that of another axis was taken",
                        ["x", "y", "z"][a]
                    ));
                }
            }
            ANGSTROM
        }
        None => {
            notes.add("the header has no cell, so no spacing; 1 mm was taken");
            1.0
        }
    };
    let lengths = lengths.map(|l| l.unwrap_or(1.0) * unit);
    let directions = directions(header.floats(14))?;
    let along = |a: usize| directions[a] * lengths[a];
    let (origin, start) = (header.floats(50), header.words(5));
    // The header has two fields for the place. ORIGIN is that of MRC2014 and in angstrom; the first
    // index is that of crystallography.
    let marked = &header.bytes[208..211] == b"MAP";
    let origin = match marked && origin.iter().any(|x| *x != 0.0) {
        true => DVec3::from_array(origin) * ANGSTROM,
        false => (0..3).map(|i| along(axes[i]) * f64::from(start[i])).sum::<DVec3>(),
    };
    let steps = axes.map(|a| along(a) + DVec3::ZERO);
    let lattice = Lattice { dims, steps, origin: origin + DVec3::ZERO };
    lattice
        .check()
        .map_err(|e| Problem::malformed("CELLA", e, "correct the cell in the header"))?;
    Ok(lattice)
}

/// Returns the directions of a cell's axes by the angles between them, in degrees: x along a, y in
/// the plane of a and b. Zeros mean right angles.
fn directions([alpha, beta, gamma]: [f64; 3]) -> Result<[DVec3; 3], Problem> {
    let right = |a: f64| a == 0.0 || a == 90.0;
    if right(alpha) && right(beta) && right(gamma) {
        return Ok([DVec3::X, DVec3::Y, DVec3::Z]);
    }
    let cosine = |a: f64| if right(a) { 0.0 } else { libm::cos(a.to_radians()) };
    let (ca, cb, cg) = (cosine(alpha), cosine(beta), cosine(gamma));
    let sg = (1.0 - cg * cg).sqrt();
    let y = (ca - cb * cg) / sg;
    let z = (1.0 - cb * cb - y * y).sqrt();
    if !(sg > 0.0 && z > 0.0) {
        return Err(Problem::malformed(
            "CELLB",
            format!("{alpha} {beta} {gamma} are not the angles of a cell"),
            "correct the cell in the header",
        ));
    }
    Ok([DVec3::X, DVec3::new(cg, sg, 0.0), DVec3::new(cb, y, z)])
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::fuzz::gzip;
    use std::path::Path;

    /// Returns a map of 4 x 3 x 2 samples 0, 1, 2, ... in steps of 1, 2 and 3 angstrom.
    pub(crate) fn mrc(big: bool, mode: i32, axes: [i32; 3], marked: bool) -> Vec<u8> {
        let mut out = vec![0; HEADER_BYTES];
        let mut put = |index: usize, n: i32| {
            let word = if big { n.to_be_bytes() } else { n.to_le_bytes() };
            out[4 * index - 4..4 * index].copy_from_slice(&word);
        };
        // Columns, rows and sections, and how many of them lie along x, y and z.
        let sizes = [4, 3, 2];
        for i in 0..3 {
            put(1 + i, sizes[i]);
            put(17 + i, axes[i]);
            let a = axes[i] as usize - 1;
            put(8 + a, sizes[i]);
            put(11 + a, ((a as f32 + 1.0) * sizes[i] as f32).to_bits() as i32);
            put(14 + i, 90f32.to_bits() as i32);
        }
        put(4, mode);
        put(21, 23f32.to_bits() as i32);
        put(23, 1);
        // An extended header.
        put(24, 160);
        if marked {
            out[208..212].copy_from_slice(b"MAP ");
            out[212..214].copy_from_slice(if big { &[0x11, 0x11] } else { &[0x44, 0x44] });
        }
        out.resize(HEADER_BYTES + 160, b'x');
        for i in 0..24u16 {
            let float = f32::from(i);
            let half = if i == 0 { 0 } else { ((float.to_bits() >> 13) - (112 << 10)) as u16 };
            let mut word = match mode {
                0 => vec![i as u8],
                2 => float.to_le_bytes().to_vec(),
                12 => half.to_le_bytes().to_vec(),
                _ => i.to_le_bytes().to_vec(),
            };
            if big {
                word.reverse();
            }
            out.extend(word);
        }
        out
    }

    fn open(bytes: Vec<u8>) -> Result<(Volume, String), Problem> {
        let source = Source::from_bytes(bytes);
        let notes = source.notes.clone();
        let volume = crate::read(source, Path::new("."), "test.map", &crate::Hints::default())?;
        Ok((volume, notes.take().join("\n")))
    }

    fn near(got: DVec3, want: DVec3) {
        assert!((got - want).length() < 1e-12, "{got} against {want}");
    }

    #[test]
    fn mrc_modes_open_in_both_byte_orders_with_and_without_mark() {
        for mode in [0, 1, 2, 6, 12] {
            let (first, _) = open(mrc(false, mode, [1, 2, 3], true)).unwrap();
            let values: Vec<f64> =
                (0..24).map(|i| first.summary.map.value(first.samples.code(i))).collect();
            assert_eq!(values, (0..24).map(f64::from).collect::<Vec<_>>(), "mode {mode}");
            for big in [false, true] {
                for marked in [false, true] {
                    let bytes = mrc(big, mode, [1, 2, 3], marked);
                    let (v, notes) = open(bytes.clone()).unwrap();
                    assert_eq!(v.digest(), first.digest(), "mode {mode} big {big}");
                    assert_eq!(open(gzip(&bytes)).unwrap().0.digest(), first.digest());
                    assert_eq!(notes.is_empty(), mode != 0, "{notes}");
                }
            }
        }
    }

    #[test]
    fn mrc_axes_turn_the_lattice_and_not_the_samples() {
        let step = |a: i32| {
            let mut step = DVec3::ZERO;
            step[a as usize - 1] = f64::from(a) * 1e-7;
            step
        };
        for axes in [[1, 2, 3], [3, 2, 1], [2, 1, 3], [3, 1, 2], [2, 3, 1], [1, 3, 2]] {
            let (v, _) = open(mrc(false, 1, axes, true)).unwrap();
            assert_eq!(v.lattice.dims, [4, 3, 2]);
            for i in 0..3 {
                near(v.lattice.steps[i], step(axes[i]));
            }
        }
    }

    fn put(bytes: &mut [u8], index: usize, n: i32) {
        bytes[4 * index - 4..4 * index].copy_from_slice(&n.to_le_bytes());
    }

    #[test]
    fn mrc_is_placed_by_origin_or_first_index() {
        let mut bytes = mrc(false, 1, [3, 2, 1], true);
        for (i, n) in [5, -6, 7].into_iter().enumerate() {
            put(&mut bytes, 5 + i, n);
        }
        // The first index counts along columns, which run along z here.
        near(open(bytes.clone()).unwrap().0.lattice.origin, DVec3::new(7.0, -12.0, 15.0) * 1e-7);
        for (i, x) in [10f32, 20.0, 30.0].into_iter().enumerate() {
            put(&mut bytes, 50 + i, x.to_bits() as i32);
        }
        near(open(bytes).unwrap().0.lattice.origin, DVec3::new(10.0, 20.0, 30.0) * 1e-7);
        let mut hexagonal = mrc(false, 1, [1, 2, 3], true);
        put(&mut hexagonal, 16, 120f32.to_bits() as i32);
        let (v, _) = open(hexagonal).unwrap();
        near(v.lattice.steps[1], DVec3::new(-1.0, 3f64.sqrt(), 0.0) * 1e-7);
    }

    #[test]
    fn mrc_bytes_are_signed_or_not_by_what_the_file_says() {
        for (stamp, most, signed, note) in [
            (Some(0), 1f32, false, ""),
            (Some(1), 1.0, true, ""),
            (None, 200.0, false, "read as uint8, since DMAX is above 127"),
            (None, 100.0, true, "read as int8, as MRC2014 says"),
        ] {
            let mut bytes = mrc(false, 0, [1, 2, 3], true);
            put(&mut bytes, 21, most.to_bits() as i32);
            if let Some(flags) = stamp {
                put(&mut bytes, 39, IMOD_STAMP);
                put(&mut bytes, 40, flags);
            }
            *bytes.last_mut().unwrap() = 255;
            let (v, notes) = open(bytes).unwrap();
            assert_eq!(v.summary.range().0 < 0.0, signed, "{notes}");
            assert!(notes.contains(note) && notes.is_empty() == note.is_empty(), "{notes}");
        }
    }

    #[test]
    fn mrc_without_cell_or_with_pictures_says_what_it_took() {
        let mut bytes = mrc(false, 1, [1, 2, 3], true);
        (11..=13).for_each(|i| put(&mut bytes, i, 0));
        let (v, notes) = open(bytes).unwrap();
        assert_eq!(v.lattice.spacing(), [1.0; 3]);
        assert!(notes.contains("no cell, so no spacing; 1 mm was taken"), "{notes}");
        let mut stack = mrc(false, 1, [1, 2, 3], true);
        put(&mut stack, 10, 1);
        put(&mut stack, 23, 0);
        let (v, notes) = open(stack).unwrap();
        assert!((v.lattice.spacing()[2] - 1e-7).abs() < 1e-12);
        assert!(notes.contains("does not say the step along z"), "{notes}");
    }

    #[test]
    fn mrc_errors_name_field_and_remedy() {
        for (index, n, say) in [
            (4, 4, "MODE: 4 is complex numbers, a transform; save it in mode 2"),
            (4, 16, "MODE: 16 is colours"),
            (24, -1, "NSYMBT: is -1"),
            (24, 1 << 25, "NSYMBT: 33554432 bytes before the samples"),
            (1, 400, "data: truncated: 4800 bytes are needed and 48 are there"),
            (14, 170f32.to_bits() as i32, "CELLB: 170 90 90 are not"),
        ] {
            let mut bytes = mrc(false, 1, [1, 2, 3], true);
            put(&mut bytes, index, n);
            if index == 14 {
                put(&mut bytes, 15, 30f32.to_bits() as i32);
            }
            let e = open(bytes).map(|(_, notes)| notes).unwrap_err().to_string();
            assert!(e.contains(say) || index == 14 && e.contains("CELLB"), "{e}");
        }
    }

    #[test]
    fn mrc_stack_of_volumes_gives_the_picked_one() {
        for mode in [1, 12] {
            let mut several = mrc(false, mode, [1, 2, 3], true);
            put(&mut several, 23, 401);
            put(&mut several, 10, 1);
            let (v, notes) = open(several.clone()).unwrap();
            assert_eq!((v.lattice.dims, v.summary.range()), ([4, 3, 1], (0.0, 11.0)));
            assert!(notes.contains("the first of 2 volumes was read; --volume takes"), "{notes}");
            let pick = crate::Pick { volume: Some(1), ..crate::Pick::default() };
            let hints = crate::Hints { pick, ..crate::Hints::default() };
            let source = Source::from_bytes(several);
            let v = crate::read(source, Path::new("."), "a.mrcs", &hints).unwrap();
            assert_eq!(v.summary.range(), (12.0, 23.0), "mode {mode}");
        }
    }
}
