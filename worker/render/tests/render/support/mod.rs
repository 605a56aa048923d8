//! Small worlds for the renderer's tests.
#![allow(dead_code, unreachable_pub, reason = "several test programs use a part each")]

use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, local_position};
use slabcast_common::ids::BrickId;
use slabcast_common::shade::{Shading, encode_normal};
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::volume::{Samples, Volume};
use slabcast_render::Simd;
use std::sync::Arc;

/// Instruction sets to test, plain first: plain and the widest of this machine, or, with
/// `SLABCAST_TEST_ALL_SIMD=1` in the environment (as in `tests/nightly.sh`), those between as well.
pub fn simds() -> Vec<Simd> {
    let mut all = Simd::all();
    if std::env::var_os("SLABCAST_TEST_ALL_SIMD").is_none_or(|all| all != "1") {
        let last = all.len() - 1;
        all.drain(1.min(last)..last);
    }
    all
}

/// An unlit transfer function over values, with `colors` (value, linear RGB) and `opacities`
/// (value, opacity in `unit`).
pub fn transfer(
    colors: Vec<[f64; 4]>,
    opacities: Vec<[f64; 2]>,
    unit: OpacityUnit,
) -> TransferFunction {
    TransferFunction {
        version: 1,
        domain: Domain::Value,
        colors,
        opacities,
        color_space: ColorSpace::Linear,
        opacity_unit: unit,
        nan: NanColour::default(),
        gradient_opacity: vec![],
        shading: Shading { on: false, ..Shading::default() },
    }
}

/// Deviation of the default kernel in lattice steps.
pub const STD: f64 = 0.6;
/// Radius at which the default kernel is cut, in lattice steps.
pub const RADIUS: f64 = 2.0;

/// A Gaussian of deviation [`STD`] with a peak of one.
pub fn bell(u: f64) -> f64 {
    (-u * u / (2.0 * STD * STD)).exp()
}

/// The default kernel's profile at `u` lattice steps (docs/design, the model), written down anew.
pub fn g(u: f64) -> f64 {
    let root = STD * (2.0 * std::f64::consts::PI).sqrt();
    let norm = root * libm::erf(RADIUS / (STD * 2f64.sqrt())) - 2.0 * RADIUS * bell(RADIUS);
    if u.abs() < RADIUS { (bell(u) - bell(RADIUS)) / norm } else { 0.0 }
}

/// The sum at `u` of [`g`] about the lattice points `range`.
pub fn sum(u: f64, range: std::ops::Range<i32>) -> f64 {
    range.map(|i| g(u - f64::from(i))).sum()
}

/// The bricks of `volume` with every voxel that is not zero, and its normal.
pub fn bricks_of(volume: &Volume) -> Vec<Arc<Brick>> {
    let grid = BrickGrid::new(volume.lattice.dims);
    let [nx, ny, _] = volume.lattice.dims.map(|n| n as usize);
    let matrix = volume.gradient_matrix();
    let mut out = Vec::new();
    for id in 0..grid.len() as u32 {
        let corner = grid.corner(BrickId(id));
        let (mut index, mut normals) = (Vec::new(), Vec::new());
        let mut values = Samples::empty(volume.codes().kind());
        for l in 0..512u16 {
            let p: [u32; 3] = std::array::from_fn(|a| corner[a] + local_position(l)[a]);
            if (0..3).any(|a| p[a] >= volume.lattice.dims[a]) {
                continue;
            }
            let i = (p[2] as usize * ny + p[1] as usize) * nx + p[0] as usize;
            if volume.samples.code(i) != 0.0 {
                index.push(l);
                values.push_from(volume.codes(), i);
                normals.push(encode_normal(volume.gradient(p, &matrix)));
            }
        }
        if !index.is_empty() {
            out.push(Arc::new(Brick::new(BrickId(id), index, values, Some(normals))));
        }
    }
    out
}

/// The directory of these bricks.
pub fn infos_of(bricks: &[Arc<Brick>], grid: &BrickGrid) -> Vec<BrickInfo> {
    let info = |b: &Arc<Brick>| BrickInfo {
        id: b.id,
        tight: b.tight_box(grid),
        voxels: b.len() as u16,
        bytes: b.encoded_len() as u32,
    };
    bricks.iter().map(info).collect()
}
