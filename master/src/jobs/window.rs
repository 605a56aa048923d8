//! Restricts a job on a large volume to the blocks that its frames show.
//!
//! A brick set that fits the master's budget is cut whole, so that all jobs share it. A larger set
//! is cut only at the blocks that some frame of the job shows. Bricks beyond the budget are
//! dropped, and read again when a worker asks for them. The directory of bricks stays in memory at
//! the master and at each worker; a job whose directory would not fit is refused before anything is
//! read.

use super::submit::SubmitError;
use crate::library::{OpenVolume, VolumeError};
use crate::memory::{Shares, brick_set_bytes, mib};
use glam::DVec3;
use slabcast_common::block_set::{BLOCK_EDGE, BlockSet, block_dims};
use slabcast_common::crop::CropBox;
use slabcast_common::quality::InvalidField;
use slabcast_common::view::View;
use slabcast_common::volume::Lattice;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_volumes::store::{Estimate, estimate};
use std::sync::Arc;

/// Returns the blocks of a set that may have a voxel in a cropping box.
fn within(blocks: &BlockSet, crop: &CropBox, lattice: &Lattice) -> BlockSet {
    let mut inside = BlockSet::new(lattice.dims);
    let [nx, ny, nz] = block_dims(lattice.dims).map(|n| n as usize);
    for block in (0..nx * ny * nz).filter(|&block| blocks.contains(block)) {
        let at = [block % nx, block / nx % ny, block / nx / ny];
        let ends = [0, 1].map(|end| {
            let at = at.map(|n| ((n + end) as f64) * f64::from(BLOCK_EDGE));
            DVec3::from_array(at) - lattice.centre_index()
        });
        let corners = (0..8).map(|i| {
            let corner = DVec3::new(ends[i & 1].x, ends[i >> 1 & 1].y, ends[i >> 2].z);
            lattice.world_from_index() * corner
        });
        let none = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let (lo, hi) = corners.fold(none, |(lo, hi), p| (lo.min(p), hi.max(p)));
        if lo.cmple(crop.hi).all() && hi.cmpge(crop.lo).all() {
            inside.insert(block);
        }
    }
    inside
}

/// Bytes of memory that a brick takes beside its contents, at the master and at each worker: its
/// entry in the directory, its places in the tables of workers, and the record of its use.
const DIRECTORY_BYTES: u64 = 160;

/// Returns the needs of a job, restricted to the blocks that its frames show if the whole brick set
/// does not fit the master's budget. `views` calls its argument with each view of the path.
///
/// # Errors
/// Even the directory of the restricted set does not fit; the kernel interpolates, which needs all
/// samples in memory; a view is invalid; or a file can't be read.
pub(super) fn fit(
    needs: BrickNeeds,
    open: &OpenVolume,
    shares: &Shares,
    views: impl FnOnce(&mut dyn FnMut(&View)) -> Result<(), InvalidField>,
) -> Result<BrickNeeds, SubmitError> {
    let info = &open.served.info;
    if needs.coefficients && open.source.whole(open.level).is_none() {
        let problem = "interpolating filters all samples of a volume, and this one is too large to be in \
                       memory; take another";
        return Err(InvalidField::new("kernel", problem).into());
    }
    let budget = shares.bricks_kept(open);
    if brick_set_bytes(info, &needs) <= budget || needs.coefficients {
        return Ok(needs);
    }
    let count = |needs: &BrickNeeds| {
        estimate(&*open.source, open.level, needs)
            .map_err(|e| SubmitError::Volume(VolumeError::NotReadable(e.to_string())))
    };
    if count(&needs)?.bytes <= budget {
        return Ok(needs);
    }
    let mut window = BlockSet::new(info.lattice.dims);
    views(&mut |view| window.add_visible(view))?;
    if let Some(crop) = &needs.crop {
        window =
            within(&window, &crop.grown(&info.lattice, f64::from(needs.halo + 1)), &info.lattice);
    }
    let needs = BrickNeeds { window: Some(Arc::new(window)), ..needs };
    let Estimate { blocks, bricks, bytes } = count(&needs)?;
    let directory = bricks * DIRECTORY_BYTES;
    if directory > budget {
        let problem = format!(
            "at level {} this shows {blocks} blocks of 64x64x64 samples, up to {bricks} bricks of {} in \
             all; their directory alone takes the master and each worker {}, and the master has {} for \
             bricks (--memory); draw a coarser level (--level auto), less of the volume (--crop, or \
             nearer), or fewer frames at a time",
            info.level,
            mib(bytes),
            mib(directory),
            mib(budget)
        );
        return Err(InvalidField::new("level", problem).into());
    }
    Ok(needs)
}
