//! Small worlds for the renderer's tests.
#![allow(dead_code, reason = "each test file uses its part")]

use slabcast_common::brick::{Brick, BrickGrid, BrickInfo, local};
use slabcast_common::ids::BrickId;
use slabcast_common::shade::encode_normal;
use slabcast_common::volume::{Samples, Volume};
use std::sync::Arc;

/// Every voxel that is not zero, with its normal.
#[allow(unreachable_pub, reason = "a module of several test programs")]
pub fn bricks_of(volume: &Volume) -> Vec<Arc<Brick>> {
    let grid = BrickGrid::of(volume.lattice.dims);
    let [nx, ny, _] = volume.lattice.dims.map(|n| n as usize);
    let matrix = volume.gradient_matrix();
    let mut out = Vec::new();
    for id in 0..grid.len() as u32 {
        let corner = grid.corner(BrickId(id));
        let (mut index, mut normals) = (Vec::new(), Vec::new());
        let mut values = Samples::empty(volume.samples.kind());
        for l in 0..512u16 {
            let p: [u32; 3] = std::array::from_fn(|a| corner[a] + local(l)[a]);
            if (0..3).any(|a| p[a] >= volume.lattice.dims[a]) {
                continue;
            }
            let i = (p[2] as usize * ny + p[1] as usize) * nx + p[0] as usize;
            if volume.samples.code(i) != 0.0 {
                index.push(l);
                values.push_from(&volume.samples, i);
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
#[allow(unreachable_pub, reason = "a module of several test programs")]
pub fn infos_of(bricks: &[Arc<Brick>], grid: &BrickGrid) -> Vec<BrickInfo> {
    let info = |b: &Arc<Brick>| BrickInfo {
        id: b.id,
        tight: b.tight(grid),
        voxels: b.len() as u16,
        bytes: b.encoded_len() as u32,
    };
    bricks.iter().map(info).collect()
}
