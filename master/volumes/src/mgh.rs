//! Reader of FreeSurfer's `.mgh` and `.mgz`: a big-endian header of 284 bytes, the samples, and a
//! footer of scan parameters, which is ignored. Axes are RAS+ by definition.

use crate::error::Problem;
use crate::pick::{Axis, Kind, Part};
use crate::plain::Plain;
use crate::samples::{Endian, Layout, Number};
use crate::source::Source;
use glam::DVec3;
use slabcast_common::volume::{Lattice, Volume};

/// Bytes before the first sample.
const HEADER_BYTES: usize = 284;

fn word(bytes: &[u8], at: usize) -> i32 {
    i32::from_be_bytes(*bytes[at..].first_chunk().expect("offsets lie inside the header"))
}

fn float(bytes: &[u8], at: usize) -> f64 {
    f32::from_bits(word(bytes, at) as u32).into()
}

/// Returns whether the first bytes, after decompression, are such a header. It has no magic but its
/// version, so the sizes, the type and the unused bytes have to fit, too.
pub(crate) fn sniff(start: &[u8]) -> bool {
    let Some(h) = start.get(..HEADER_BYTES) else { return false };
    word(h, 0) == 1
        && (1..=4).all(|i| (1..=1 << 20).contains(&word(h, 4 * i)))
        && (0..=20).contains(&word(h, 20))
        && matches!(i16::from_be_bytes([h[28], h[29]]), -1..=1)
        && h[90..].iter().all(|b| *b == 0)
}

/// Reads a volume from the start of a source; `gzip` says that it is compressed.
pub(crate) fn read(source: Source, gzip: bool, name: &str) -> Result<Volume, Problem> {
    let mut file = Plain::new(source, gzip);
    let notes = file.notes.clone();
    let mut h = [0; HEADER_BYTES];
    file.header(&mut h)?;
    let number = match word(&h, 20) {
        0 => Number::U8,
        1 => Number::I32,
        3 => Number::F32,
        4 => Number::I16,
        10 => Number::U16,
        code => {
            return Err(Problem::unsupported(
                "type",
                format!("{code} is not one of 0, 1, 3, 4 and 10, one number a voxel"),
                "convert it with mri_convert -odt float",
            ));
        }
    };
    let sizes = [4, 8, 12].map(|at| u64::try_from(word(&h, at)).unwrap_or(0));
    let layout = Layout::new(sizes, number, Endian::Big, "width, height, depth")?;
    let frames = u64::try_from(word(&h, 16)).unwrap_or(1);
    let (at, said) = file.pick.choose(&[Axis::new(Kind::Time, "frames", frames)], "nframes")?;
    said.into_iter().for_each(|note| notes.add(note));
    let part = match frames {
        1 => None,
        _ => Part::new(
            &[&sizes[..], &[frames]].concat(),
            vec![None, None, None, Some(at[0])],
            number.bytes(),
        ),
    };
    let placed = i16::from_be_bytes([h[28], h[29]]) == 1;
    let v = |at: usize| DVec3::new(float(&h, at), float(&h, at + 4), float(&h, at + 8));
    let (spacing, directions, centre) = match placed {
        true => (v(30), [v(42), v(54), v(66)], v(78)),
        false => {
            notes.add(
                "the file has no directions (goodRASFlag is not 1); FreeSurfer's coronal ones and \
                 1 mm were taken",
            );
            (DVec3::ONE, [DVec3::NEG_X, DVec3::NEG_Z, DVec3::Y], DVec3::ZERO)
        }
    };
    // Adding zero turns -0.0 into 0.0, which the volume's digest would distinguish.
    let steps: [DVec3; 3] = std::array::from_fn(|a| directions[a] * spacing[a] + DVec3::ZERO);
    let middle = (0..3).map(|a| steps[a] * (f64::from(layout.dims[a]) / 2.0)).sum::<DVec3>();
    let lattice = Lattice { dims: layout.dims, steps, origin: centre - middle + DVec3::ZERO };
    lattice.check().map_err(|e| {
        Problem::malformed("delta, Mdc", e, "correct them with mri_convert, or get the file again")
    })?;
    let (samples, map, _) = file.samples(&layout, part.as_ref())?;
    Ok(crate::stream::volume(name, number.name(), true, lattice, samples, map))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::fuzz::gzip;
    use std::path::Path;

    /// Returns a volume of 4 x 3 x 2 samples 0, 1, 2, ..., with FreeSurfer's directions and a
    /// footer.
    pub(crate) fn mgh(kind: i32, placed: bool) -> Vec<u8> {
        let mut out = Vec::new();
        for n in [1, 4, 3, 2, 1, kind, 0] {
            out.extend(i32::to_be_bytes(n));
        }
        out.extend(i16::from(placed).to_be_bytes());
        let directions = [-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0];
        let floats = [1.0, 2.0, 3.0].into_iter().chain(directions).chain([10.0, 20.0, 30.0]);
        floats.for_each(|x: f32| out.extend(x.to_be_bytes()));
        out.resize(HEADER_BYTES, 0);
        for i in 0..24u8 {
            match kind {
                0 => out.push(i),
                1 => out.extend(i32::from(i).to_be_bytes()),
                3 => out.extend(f32::from(i).to_be_bytes()),
                _ => out.extend(i16::from(i).to_be_bytes()),
            }
        }
        [2000.0f32, 0.1].into_iter().for_each(|x| out.extend(x.to_be_bytes()));
        out
    }

    fn open(bytes: Vec<u8>) -> Result<(Volume, String), Problem> {
        let source = Source::from_bytes(bytes);
        let notes = source.notes.clone();
        let volume = crate::read(source, Path::new("."), "test.mgz", &crate::Hints::default())?;
        Ok((volume, notes.take().join("\n")))
    }

    #[test]
    fn mgh_and_mgz_open_with_type_and_place() {
        for kind in [0, 1, 3, 4, 10] {
            let (v, notes) = open(mgh(kind, true)).unwrap();
            let (packed, _) = open(gzip(&mgh(kind, true))).unwrap();
            assert_eq!(v.digest(), packed.digest());
            assert_eq!((v.lattice.dims, notes.as_str()), ([4, 3, 2], ""));
            assert!(v.anatomical);
            let values: Vec<f64> =
                (0..24).map(|i| v.summary.map.value(v.samples.code(i))).collect();
            assert_eq!(values, (0..24).map(f64::from).collect::<Vec<_>>(), "type {kind}");
            // The centre, 10 20 30, is at index 2 1.5 1.
            let steps = [DVec3::new(-1.0, 0.0, 0.0), DVec3::new(0.0, 0.0, -2.0), DVec3::Y * 3.0];
            assert_eq!(v.lattice.steps, steps);
            assert_eq!(v.lattice.origin, DVec3::new(12.0, 17.0, 33.0));
        }
    }

    #[test]
    fn mgh_of_several_frames_gives_the_picked_one() {
        let mut two = mgh(4, true);
        let (mut frame, footer) = (two.split_off(HEADER_BYTES), 8);
        frame.truncate(frame.len() - footer);
        let second: Vec<u8> = frame.chunks(2).flat_map(|w| [w[0] + 1, w[1]]).collect();
        two[16..20].copy_from_slice(&2i32.to_be_bytes());
        let two = [two, frame, second, vec![0; footer]].concat();
        let (v, notes) = open(two.clone()).unwrap();
        assert_eq!(v.digest(), open(mgh(4, true)).unwrap().0.digest());
        assert!(notes.contains("the first of 2 frames was read; --time takes another"), "{notes}");
        for bytes in [two.clone(), gzip(&two)] {
            let pick = crate::Pick { time: Some(1), ..crate::Pick::default() };
            let hints = crate::Hints { pick, ..crate::Hints::default() };
            let v = crate::read(Source::from_bytes(bytes), Path::new("."), "a", &hints).unwrap();
            assert_eq!(v.summary.range(), (256.0, 279.0));
        }
    }

    #[test]
    fn mgh_without_directions_has_those_of_freesurfer_and_says_so() {
        let (v, notes) = open(mgh(0, false)).unwrap();
        assert_eq!(v.lattice.steps, [DVec3::NEG_X, DVec3::NEG_Z, DVec3::Y]);
        assert!(notes.contains("goodRASFlag is not 1"), "{notes}");
    }

    #[test]
    fn mgh_errors_name_field_and_remedy() {
        let put = |at: usize, n: i32| {
            let mut bytes = mgh(4, true);
            bytes[at..at + 4].copy_from_slice(&n.to_be_bytes());
            open(bytes).unwrap_err().to_string()
        };
        for (at, n, say) in [
            (20, 2, "type: 2 is not one of"),
            (4, 100, "data: truncated: 1200 bytes are needed and 56 are there"),
            (30, 0, "delta, Mdc: a spacing is zero"),
        ] {
            let e = put(at, n);
            assert!(e.contains(say), "{e}");
        }
        let mut cut = gzip(&mgh(4, true));
        cut.truncate(cut.len() - 6);
        let e = open(cut).unwrap_err().to_string();
        assert!(e.contains("ends before its checksum"), "{e}");
    }
}
