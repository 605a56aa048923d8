//! Volumes computed from formulas, for tests, checks and demos whose results can be worked out on
//! paper. [`open`](crate::open) takes `formula:NAME` or `formula:NAME:SIZE`, where SIZE is `N` or
//! `AxBxC` samples.
//!
//! Golden frames depend on the digests, so a formula never changes; a better one gets a new name.
//! All arithmetic is exact or by `libm`, and gives the same volume on every machine.

use crate::error::{Problem, quoted};
use slabcast_common::volume::{Lattice, Samples, ValueMap, Volume};

/// Prefix that marks a path as a formula: `formula:`.
pub const PREFIX: &str = "formula:";

/// Names of all formulas, each with a line for a person on what the volume shows.
pub const NAMES: [(&str, &str); 11] = [
    ("wall", "a block of 200 in the middle half: closed form of every ray"),
    ("two-walls", "two plates across y, 100 in front of 200: the first hides the second"),
    ("ramp", "float: the value is i, the gradient (1, 0, 0) everywhere"),
    ("blob", "16-bit: one gaussian, 255 at its peak, sigma a sixth of the size"),
    ("bell", "float: one gaussian, 1 at its peak, sigma a twelfth: not cut by the box"),
    ("marker", "a body with a ball at +x, a cube at +y and a cross at +z: shows mirrored axes"),
    ("spheres", "balls beside and inside each other in a shell cut open"),
    ("fog", "low values everywhere, no air"),
    ("full", "200 everywhere: the ripple of a kernel on a constant field"),
    ("one", "1x1x1"),
    ("line", "4096x1x1"),
];

/// Most samples of a formula volume. `spheres`, the slowest, then takes 9 s and 256 MiB.
const SAMPLES_MAX: u64 = 1 << 28;

/// Computes the volume that `text` names, with or without the prefix.
pub(crate) fn open(text: &str) -> Result<Volume, Problem> {
    let mut parts = text.strip_prefix(PREFIX).unwrap_or(text).splitn(2, ':');
    let name = parts.next().unwrap_or_default();
    let dims = match parts.next() {
        None => default_dims(name),
        Some(size) => match parse_size(name, size) {
            Some(dims) => dims,
            None => {
                return Err(Problem::malformed(
                    "size",
                    format!("{} is not a size of `{name}`", quoted(size)),
                    format!(
                        "give N or AxBxC, at most 16384 along an axis and {SAMPLES_MAX} samples \
                         (`one` has one size)"
                    ),
                ));
            }
        },
    };
    volume(name, dims, text).ok_or_else(|| {
        let names: Vec<&str> = NAMES.iter().map(|(n, _)| *n).collect();
        Problem::malformed(
            "name",
            format!("there is no formula {}", quoted(name)),
            format!("give one of {}", names.join(", ")),
        )
    })
}

fn default_dims(name: &str) -> [u32; 3] {
    match name {
        "one" => [1, 1, 1],
        "line" => [4096, 1, 1],
        _ => [64, 64, 64],
    }
}

fn parse_size(name: &str, size: &str) -> Option<[u32; 3]> {
    let numbers: Vec<u32> = size.split('x').map(str::parse).collect::<Result<_, _>>().ok()?;
    let dims = match (name, numbers[..].try_into()) {
        (_, Ok(dims)) => dims,
        ("line", Err(_)) if numbers.len() == 1 => [numbers[0], 1, 1],
        (_, Err(_)) if numbers.len() == 1 => [numbers[0]; 3],
        _ => return None,
    };
    let fits = dims.iter().all(|&n| (1..=16384).contains(&n))
        && dims.iter().map(|&n| u64::from(n)).product::<u64>() <= SAMPLES_MAX
        && (name != "one" || dims == [1, 1, 1]);
    fits.then_some(dims)
}

/// Computes the formula `name` with `dims` samples on a unit lattice as a volume called `title`;
/// `None` if there is no such formula.
fn volume(name: &str, dims: [u32; 3], title: &str) -> Option<Volume> {
    let [nx, ny, nz] = dims;
    let u8s = |f: &dyn Fn(u32, u32, u32) -> u8| Some(Volume::from_fn_u8(title, dims, f));
    // Positions of voxel centres, -1 to 1 over each axis.
    let p = |i: u32, n: u32| (2.0 * f64::from(i) + 1.0) / f64::from(n) - 1.0;
    let position = |i, j, k| [p(i, nx), p(j, ny), p(k, nz)];
    let in_ball = |q: [f64; 3], c: [f64; 3], r: f64| {
        let d = [q[0] - c[0], q[1] - c[1], q[2] - c[2]];
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2] < r * r
    };
    let in_box = |q: [f64; 3], c: [f64; 3], h: [f64; 3]| (0..3).all(|a| (q[a] - c[a]).abs() < h[a]);
    match name {
        // Not in the list: for tests of large volumes, of which it is a small one.
        "cells" => u8s(&|i, j, k| crate::blocks::FormulaSource::sample(dims, [i, j, k])),
        "wall" => u8s(&|i, j, k| {
            let middle = |i: u32, n: u32| n / 4 <= i && i < n - n / 4;
            if middle(i, nx) && middle(j, ny) && middle(k, nz) { 200 } else { 0 }
        }),
        "two-walls" => u8s(&|i, j, k| {
            let across = |i: u32, n: u32| n / 8 <= i && i < n - n / 8;
            if !across(i, nx) || !across(k, nz) {
                return 0;
            }
            // The default eye looks from +y (docs/design/contracts.md): the weaker plate is in
            // front.
            match 16 * j / ny {
                10..12 => 100,
                4..6 => 200,
                _ => 0,
            }
        }),
        "ramp" => {
            let n = dims.iter().map(|&n| n as usize).product();
            let v = (0..n).map(|i| (i % nx as usize) as f32).collect();
            let lattice = Lattice::from_spacing(dims, [1.0; 3]);
            let samples = Samples::F32(v);
            Some(Volume::new(title, "float32", false, lattice, samples, ValueMap::IDENTITY))
        }
        "blob" => {
            // exp(-18 r^2) is a product of one factor per axis: three small tables.
            let tables = dims.map(|n| {
                let factor = |i| libm::exp(-4.5 * p(i, n) * p(i, n));
                (0..n).map(factor).collect::<Vec<f64>>()
            });
            let mut v = Vec::with_capacity(dims.iter().map(|&n| n as usize).product());
            for z in &tables[2] {
                for y in &tables[1] {
                    v.extend(tables[0].iter().map(|x| (x * y * z * 65535.0 + 0.5) as u16));
                }
            }
            let lattice = Lattice::from_spacing(dims, [1.0; 3]);
            let map = ValueMap { scale: 1.0 / 257.0, offset: 0.0 };
            Some(Volume::new(title, "uint16", false, lattice, Samples::U16(v), map))
        }
        "bell" => {
            // exp(-r^2 / 2 s^2) with s = n / 12 is 1.5e-8 at the middle of a face, below the last
            // bit of a float at the peak.
            let tables = dims.map(|n| {
                let factor = |i| libm::exp(-18.0 * p(i, n) * p(i, n));
                (0..n).map(factor).collect::<Vec<f64>>()
            });
            let mut v = Vec::with_capacity(dims.iter().map(|&n| n as usize).product());
            for z in &tables[2] {
                for y in &tables[1] {
                    v.extend(tables[0].iter().map(|x| (x * y * z) as f32));
                }
            }
            let lattice = Lattice::from_spacing(dims, [1.0; 3]);
            let samples = Samples::F32(v);
            Some(Volume::new(title, "float32", false, lattice, samples, ValueMap::IDENTITY))
        }
        "marker" => u8s(&|i, j, k| {
            let q = position(i, j, k);
            if in_ball(q, [0.7, 0.0, 0.0], 0.2) {
                160
            } else if in_box(q, [0.0, 0.7, 0.0], [0.16; 3]) {
                200
            } else if in_box(q, [0.0, 0.0, 0.7], [0.24, 0.07, 0.07])
                || in_box(q, [0.0, 0.0, 0.7], [0.07, 0.07, 0.24])
            {
                250
            } else if in_ball(q, [0.0; 3], 0.4) {
                100
            } else {
                0
            }
        }),
        "spheres" => u8s(&|i, j, k| {
            let q = position(i, j, k);
            // Smooth edges two samples wide, so that gradients are those of balls.
            let ball = |c: [f64; 3], r: f64, value: f64| {
                let d = [q[0] - c[0], q[1] - c[1], q[2] - c[2]];
                let depth = r - (d[0] * d[0] + d[1] * d[1] + d[2] * d[2]).sqrt();
                let n = f64::from(nx.min(ny).min(nz));
                value * (depth * n / 4.0 + 0.5).clamp(0.0, 1.0)
            };
            // A shell with its upper front right eighth cut out, and balls inside and outside.
            let shell = ball([0.0; 3], 0.7, 110.0) - ball([0.0; 3], 0.55, 110.0);
            let open = q[0] > 0.0 && q[1] > 0.0 && q[2] > 0.0;
            let shell = if open { 0.0 } else { shell };
            [
                shell,
                ball([0.1, 0.1, 0.1], 0.3, 240.0),
                ball([-0.25, -0.2, -0.2], 0.2, 180.0),
                ball([0.7, -0.6, 0.55], 0.22, 150.0),
                ball([-0.68, 0.6, -0.6], 0.25, 200.0),
            ]
            .into_iter()
            .fold(0.0, f64::max) as u8
        }),
        // Sums of triangle waves in integers, 2 to 14.
        "fog" => u8s(&|i, j, k| {
            let wave = |x: u32, period: u32| {
                let x = x % period;
                (x.min(period - x) * 8 / period) as u8
            };
            2 + wave(i + j, 46) + wave(j + 2 * k, 58) + wave(k + i, 34)
        }),
        "full" => u8s(&|_, _, _| 200),
        "one" => u8s(&|_, _, _| 255),
        "line" => u8s(&|i, _, _| 64 + (i / 32 % 192) as u8),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
