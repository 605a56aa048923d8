//! Unusual samples: NaN, infinities and extreme values.

use super::scene::{look, shot};
use super::{PIXELS, judge, one};
use crate::check::case::Case;
use crate::check::shot::Shot;
use slabcast_common::transfer::{Domain, NanColour, TransferFunction};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};
use slabcast_session::fail::Fail;
use slabcast_session::volume;

pub(super) fn cases() -> Vec<Case> {
    vec![
        one("constant", || float_shot(|_| 3.25)),
        one("NaN, infinities, denormals", || {
            float_shot(|i| match i % 7 {
                0 => f32::NAN,
                1 => f32::INFINITY,
                2 => f32::NEG_INFINITY,
                3 => 1e-42,
                4 => -1e-42,
                _ => (i % 11) as f32,
            })
        }),
        one("nothing but NaN", || float_shot(|_| f32::NAN)),
        one("nothing but denormals", || float_shot(|i| f32::from_bits(i % 97))),
        one("f32 from end to end", || float_shot(|i| if i % 3 == 0 { f32::MAX } else { f32::MIN })),
        one("all empty", || Shot { transfer: look(&[[0.0, 0.0]]), ..float_shot(|i| i as f32) }),
        one("all opaque", || Shot { transfer: look(&[[0.0, 1.0]]), ..float_shot(|i| i as f32) }),
        file_case("int16 from end to end", "int16", |i| match i % 5 {
            0 => i16::MIN.to_le_bytes().to_vec(),
            1 => i16::MAX.to_le_bytes().to_vec(),
            _ => (i as i16 * 31).to_le_bytes().to_vec(),
        }),
        file_case("double up to 1e300", "double", |i| {
            let x = [1e300, -1e300, 0.0, f64::NAN, 1e-300, f64::INFINITY][i as usize % 6];
            (x * f64::from(i % 11)).to_le_bytes().to_vec()
        }),
    ]
}

const DIMS: [u32; 3] = [12, 10, 8];

fn float_shot(f: impl Fn(u32) -> f32) -> Shot {
    let samples = Samples::F32((0..DIMS.iter().product()).map(f).collect());
    let lattice = Lattice::from_spacing(DIMS, [1.0; 3]);
    let volume = Volume::new("odd", "float32", false, lattice, samples, ValueMap::IDENTITY);
    shot(volume, unit())
}

/// A volume that is read from a file, with `f(i)` as the bytes of sample i.
fn file_case(name: &str, number: &'static str, f: fn(u32) -> Vec<u8>) -> Case {
    Case::new(name, move |tools| {
        let [a, b, c] = DIMS;
        let mut bytes = format!(
            "NRRD0004\ntype: {number}\ndimension: 3\nsizes: {a} {b} {c}\nspacings: 1 1 1\n\
             endian: little\nencoding: raw\n\n"
        )
        .into_bytes();
        bytes.extend((0..a * b * c).flat_map(f));
        let write = |e: std::io::Error| Fail::failed(format!("a temporary file: {e}"));
        let dir = tempfile::tempdir().map_err(write)?;
        let file = dir.path().join("odd.nrrd");
        std::fs::write(&file, bytes).map_err(write)?;
        judge(&shot(volume::open(&file)?, unit()), PIXELS, tools)
    })
}

/// A transfer function over the volume's range, with NaN in green.
fn unit() -> TransferFunction {
    TransferFunction {
        domain: Domain::Unit,
        colors: vec![[0.0, 0.1, 0.2, 0.9], [1.0, 1.0, 0.6, 0.1]],
        opacities: vec![[0.0, 0.02], [1.0, 0.9]],
        nan: NanColour { color: [0.0, 1.0, 0.0], opacity: 0.3 },
        ..look(&[[0.0, 0.0]])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::check::shot::Tools;

    #[test]
    fn constant_and_endless_values_are_drawn_alike_everywhere() {
        let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().unwrap();
        let tools = Tools { threads: 2, runtime };
        let some = ["constant", "nothing but denormals", "f32 from end to end"];
        for case in cases().iter().filter(|c| some.contains(&c.name.as_str())) {
            for row in (case.work)(&tools).unwrap() {
                assert!(row.held(), "{}: {row:?}", case.name);
            }
        }
    }
}
