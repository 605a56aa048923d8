//! The bricks of one volume that a transfer function can see, each held once.
//!
//! A store is built once and what it says never changes, so an [`std::sync::Arc`] of it is shared by
//! all that send. Bricks are packed as they are cut: a worker elsewhere gets these bytes, and sending
//! to sixty copies a pointer sixty times. A brick that a worker of this process asks for is unpacked
//! then, and shared from then on. Both forms beside each other would take 10 bytes a voxel of 8 bits
//! where the promise is 8, so a brick has one or the other; a master with workers of both kinds
//! packs a brick anew for each that is elsewhere.

use bytes::Bytes;
use rayon::prelude::*;
use slabcast_common::brick::{
    BRICK_EDGE, BRICK_VOXELS, Brick, BrickGrid, BrickInfo, BrickSetKey, TightBox,
};
use slabcast_common::gradient::encode_magnitude;
use slabcast_common::ids::BrickId;
use slabcast_common::shade::encode_normal;
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Digest32, Samples, Volume};
use slabcast_scene::brick_needs::BrickNeeds;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The relevant bricks of a volume for one support, in ascending id.
pub struct BrickStore {
    key: BrickSetKey,
    wanted: BrickNeeds,
    infos: Arc<[BrickInfo]>,
    /// The bricks, in the order of `infos`.
    held: Vec<Mutex<Held>>,
    relevant_voxels: u64,
    bytes: u64,
    extent: Option<TightBox>,
}

/// A brick in the form in which it was last wanted.
enum Held {
    /// Encoded.
    Packed(Bytes),
    /// As workers of this process share it.
    Open(Arc<Brick>),
}

impl BrickStore {
    /// Cuts a volume on all cores. `digest` is [`Volume::digest`]; bricks without a relevant
    /// voxel are left out, and so is all that `wanted` does not ask for.
    pub fn build(volume: &Volume, digest: Digest32, wanted: &BrickNeeds) -> Self {
        let support = &wanted.support;
        let cut = match &volume.samples {
            Samples::U8(v) => {
                let relevant = table(support, 256);
                cut(volume, v, wanted, Samples::U8, |c| relevant[usize::from(c)])
            }
            Samples::U16(v) => {
                let relevant = table(support, 65536);
                cut(volume, v, wanted, Samples::U16, |c| relevant[usize::from(c)])
            }
            Samples::F32(v) => {
                cut(volume, v, wanted, Samples::F32, |c| support.contains(f64::from(c)))
            }
        };
        let (infos, held): (Vec<BrickInfo>, Vec<Mutex<Held>>) = cut.into_iter().unzip();
        BrickStore {
            key: wanted.set_key(digest),
            wanted: wanted.clone(),
            relevant_voxels: infos.iter().map(|b| u64::from(b.voxels)).sum(),
            bytes: infos.iter().map(|b| u64::from(b.bytes)).sum(),
            extent: infos.iter().map(|info| info.tight).reduce(TightBox::union),
            infos: infos.into(),
            held,
        }
    }

    /// Which bricks these are.
    pub fn key(&self) -> BrickSetKey {
        self.key
    }

    /// What the bricks hold.
    pub fn wanted(&self) -> &BrickNeeds {
        &self.wanted
    }

    /// The directory of bricks, in ascending id.
    pub fn infos(&self) -> &Arc<[BrickInfo]> {
        &self.infos
    }

    /// A brick, if it has a relevant voxel: unpacked once, then shared.
    pub fn brick(&self, id: BrickId) -> Option<Arc<Brick>> {
        let mut held = self.held(id)?;
        let brick = match &*held {
            Held::Open(brick) => return Some(brick.clone()),
            Held::Packed(bytes) => Brick::decode(bytes).expect("we packed it ourselves"),
        };
        let brick = Arc::new(brick);
        *held = Held::Open(brick.clone());
        Some(brick)
    }

    /// A brick's encoding ([`Brick::encode`]): shared, unless a worker of this process has asked for
    /// the brick itself.
    pub fn encoded(&self, id: BrickId) -> Option<Bytes> {
        Some(match &*self.held(id)? {
            Held::Packed(bytes) => bytes.clone(),
            Held::Open(brick) => packed(brick),
        })
    }

    /// Voxels in all bricks.
    pub fn relevant_voxels(&self) -> u64 {
        self.relevant_voxels
    }

    /// Where they are; `None` without bricks.
    pub fn extent(&self) -> Option<TightBox> {
        self.extent
    }

    /// Bytes of all encodings.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn held(&self, id: BrickId) -> Option<MutexGuard<'_, Held>> {
        let at = self.infos.binary_search_by_key(&id, |b| b.id).ok()?;
        Some(self.held[at].lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl std::fmt::Debug for BrickStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BrickStore")
            .field("key", &self.key)
            .field("bricks", &self.held.len())
            .field("relevant_voxels", &self.relevant_voxels)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

/// A brick's encoding.
fn packed(brick: &Brick) -> Bytes {
    let mut out = Vec::new();
    brick.encode(&mut out);
    out.into()
}

/// Which of `codes` codes are relevant. Filled by interval: asking for each code would take
/// codes times intervals, 2^31 steps for a 16-bit comb.
fn table(support: &Support, codes: usize) -> Vec<bool> {
    let mut relevant = vec![false; codes];
    for &(a, b) in &support.intervals {
        let (from, to) = (a.ceil().max(0.0), b.floor().min(codes as f64 - 1.0));
        if from <= to {
            relevant[from as usize..=to as usize].fill(true);
        }
    }
    relevant
}

/// All bricks with a relevant voxel. One task is a row of bricks along x: a 256^3 volume has
/// 1024 of them with 16 Ki samples each, which keeps any number of cores evenly busy.
fn cut<T: Copy + Into<f64> + Sync>(
    volume: &Volume,
    codes: &[T],
    wanted: &BrickNeeds,
    samples: fn(Vec<T>) -> Samples,
    relevant: impl Fn(T) -> bool + Sync,
) -> Vec<(BrickInfo, Mutex<Held>)> {
    let field = Field { codes, dims: volume.lattice.dims };
    let grid = BrickGrid::new(field.dims);
    let gradient_matrix = volume.gradient_matrix();
    let row = |row: u32| {
        let mut bricks = Vec::new();
        let (y, z) = (row % grid.dims[1], row / grid.dims[1]);
        let mut found = Found::default();
        for x in 0..grid.dims[0] {
            let id = grid.id([x, y, z]);
            found.clear();
            let inside = |at| wanted.crop.is_none_or(|c| c.contains(&volume.lattice, at));
            field.search([x, y, z].map(|n| n * BRICK_EDGE), &relevant, &inside, &mut found);
            let index = &found.index[..found.voxels];
            if index.is_empty() {
                continue;
            }
            let offsets = &found.offset[..found.voxels];
            let corner = grid.corner(id);
            let gradient = |(&i, &offset)| {
                let local = slabcast_common::brick::local_position(i);
                let at = std::array::from_fn(|a| corner[a] + local[a]);
                gradient_matrix * field.difference(at, offset)
            };
            let all = || index.iter().zip(offsets).map(gradient);
            let normals = wanted.normals.then(|| all().map(encode_normal).collect());
            let magnitude = |g: glam::DVec3| encode_magnitude(g.length(), &volume.summary);
            let gradients = wanted.gradients.then(|| all().map(magnitude).collect());
            let values = samples(offsets.iter().map(|&o| codes[o]).collect());
            let brick = Brick::new(id, index.to_vec(), values, normals).with_gradients(gradients);
            let info = BrickInfo {
                id,
                tight: found.tight(),
                voxels: found.voxels as u16,
                bytes: brick.encoded_len() as u32,
            };
            bricks.push((info, Mutex::new(Held::Packed(packed(&brick)))));
        }
        bricks
    };
    let rows = grid.dims[1] * grid.dims[2];
    let rows: Vec<Vec<_>> = (0..rows).into_par_iter().map(row).collect();
    rows.into_iter().flatten().collect()
}

/// The relevant voxels of one brick, in ascending local index.
struct Found {
    voxels: usize,
    index: [u16; BRICK_VOXELS],
    /// Where each lies in the volume's samples.
    offset: [usize; BRICK_VOXELS],
    lo: [u32; 3],
    hi: [u32; 3],
}

impl Default for Found {
    fn default() -> Self {
        Found {
            voxels: 0,
            index: [0; BRICK_VOXELS],
            offset: [0; BRICK_VOXELS],
            lo: [u32::MAX; 3],
            hi: [0; 3],
        }
    }
}

impl Found {
    fn clear(&mut self) {
        (self.voxels, self.lo, self.hi) = (0, [u32::MAX; 3], [0; 3]);
    }

    fn tight(&self) -> TightBox {
        TightBox { lo: self.lo, hi: self.hi }
    }
}

/// A volume's codes by their own type, so that the compiler sees through them.
struct Field<'a, T> {
    codes: &'a [T],
    dims: [u32; 3],
}

impl<T: Copy + Into<f64>> Field<'_, T> {
    fn search(
        &self,
        corner: [u32; 3],
        relevant: &impl Fn(T) -> bool,
        inside: &impl Fn([u32; 3]) -> bool,
        found: &mut Found,
    ) {
        let [nx, ny, _] = self.dims.map(|n| n as usize);
        let end: [u32; 3] = std::array::from_fn(|a| (corner[a] + BRICK_EDGE).min(self.dims[a]));
        for z in corner[2]..end[2] {
            for y in corner[1]..end[1] {
                let start = (z as usize * ny + y as usize) * nx + corner[0] as usize;
                let run = &self.codes[start..start + (end[0] - corner[0]) as usize];
                let row = (y - corner[1]) * 8 + (z - corner[2]) * 64;
                let before = found.voxels;
                // Each is put there and counted if it is to stay: no branch hangs on the data.
                for (x, &code) in run.iter().enumerate() {
                    found.index[found.voxels] = (row + x as u32) as u16;
                    found.offset[found.voxels] = start + x;
                    let stays = relevant(code) && inside([corner[0] + x as u32, y, z]);
                    found.voxels += usize::from(stays);
                }
                if found.voxels > before {
                    let x = |i: usize| corner[0] + u32::from(found.index[i] & 7);
                    let (first, last) = ([x(before), y, z], [x(found.voxels - 1), y, z]);
                    for a in 0..3 {
                        found.lo[a] = found.lo[a].min(first[a]);
                        found.hi[a] = found.hi[a].max(last[a]);
                    }
                }
            }
        }
    }

    /// Differences along the index axes at `at`, whose sample lies at `offset`: the same
    /// arithmetic as [`Volume::gradient`], bit for bit (a test compares).
    #[inline]
    fn difference(&self, at: [u32; 3], offset: usize) -> glam::DVec3 {
        let [nx, ny, nz] = self.dims;
        let along = |p: u32, n: u32, stride: usize| {
            let below = usize::from(p > 0);
            let above = usize::from(p + 1 < n);
            if below + above == 0 {
                return 0.0;
            }
            let hi: f64 = self.codes[offset + above * stride].into();
            let lo: f64 = self.codes[offset - below * stride].into();
            // A product with a half is that quotient to the bit.
            (hi - lo) * if below + above == 2 { 0.5 } else { 1.0 }
        };
        glam::DVec3::new(
            along(at[0], nx, 1),
            along(at[1], ny, nx as usize),
            along(at[2], nz, nx as usize * ny as usize),
        )
    }
}

#[cfg(test)]
mod tests;
