//! What of a volume that does not fit into memory a job needs: blocks in view with visible values.
//!
//! A set that fits the master's budget is cut whole, so that all jobs share it. Of a larger one only the
//! blocks that some frame shows are cut. Contents beyond the budget are read again when a worker asks
//! for them; the directory of bricks stays in memory at the master and at each worker, and a job whose
//! directory would not fit is refused before anything is read.

use super::submit::SubmitError;
use crate::library::{OpenVolume, VolumeError};
use crate::memory::{Shares, brick_set_bytes, mib};
use slabcast_common::block_set::BlockSet;
use slabcast_common::quality::InvalidField;
use slabcast_common::view::View;
use slabcast_scene::brick_needs::BrickNeeds;
use slabcast_volumes::store::{Estimate, estimate};
use std::sync::Arc;

/// Bytes of memory that a brick takes beside its contents, at the master and at each worker: its entry
/// in the directory, its places in the tables of workers, and what is known of its use.
const DIRECTORY_BYTES: u64 = 160;

/// Returns the needs of a job, restricted to what its frames show if the whole set does not fit.
/// `views` calls its argument with each view of the path.
///
/// # Errors
/// Not even that fits, or a file can't be read.
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
