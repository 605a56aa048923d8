//! Store of the bricks of one volume that a transfer function can see.
//!
//! A store does not change after it was built, so all senders share it in an [`std::sync::Arc`].
//! Bricks are encoded as they are cut; remote workers are sent these bytes, and sending to sixty
//! copies a pointer sixty times. A brick that an embedded worker asks for is decoded then, and
//! shared from then on. Keeping both forms would take 10 bytes for a voxel of 8 bits where the
//! promise is 8, so a brick has one or the other: with workers of both kinds, the master encodes a
//! brick anew for each remote worker.

use crate::prefilter;
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

/// The bricks of a volume that hold a relevant voxel, in ascending id. Each is kept once, encoded
/// or decoded. A voxel is relevant if the transfer function shows its value and it lies inside the
/// cropping box.
pub struct BrickStore {
    key: BrickSetKey,
    needs: BrickNeeds,
    infos: Arc<[BrickInfo]>,
    /// Contents of the bricks, in the order of `infos`.
    contents: Vec<Mutex<Content>>,
    relevant_voxels: u64,
    bytes: u64,
    extent: Option<TightBox>,
}

/// A brick in the form in which it was last asked for.
enum Content {
    /// Encoded for remote workers ([`Brick::encode`]).
    Encoded(Bytes),
    /// Decoded, and shared by the embedded workers.
    Decoded(Arc<Brick>),
}

impl BrickStore {
    /// Cuts a volume into bricks on all cores of rayon's pool.
    ///
    /// `digest` is [`Volume::digest`] of `volume`. Bricks without a relevant voxel are left out,
    /// and so are normals and gradients that `needs` does not ask for.
    pub fn build(volume: &Volume, digest: Digest32, needs: &BrickNeeds) -> Self {
        let support = &needs.support;
        let coefficients = needs.coefficients.then(|| prefilter::coefficients(volume));
        let coefficients = coefficients.as_deref();
        let bricks = match volume.codes() {
            Samples::U8(v) => {
                let relevant = relevance_table(support, 256);
                cut(volume, (v, coefficients), needs, Samples::U8, |c| relevant[usize::from(c)])
            }
            Samples::U16(v) => {
                let relevant = relevance_table(support, 65536);
                cut(volume, (v, coefficients), needs, Samples::U16, |c| relevant[usize::from(c)])
            }
            Samples::F32(v) => cut(volume, (v, coefficients), needs, Samples::F32, |c| {
                support.contains(f64::from(c))
            }),
        };
        let (infos, contents): (Vec<BrickInfo>, Vec<Mutex<Content>>) = bricks.into_iter().unzip();
        BrickStore {
            key: needs.set_key(digest),
            needs: needs.clone(),
            relevant_voxels: infos.iter().map(|b| u64::from(b.voxels)).sum(),
            bytes: infos.iter().map(|b| u64::from(b.bytes)).sum(),
            extent: infos.iter().map(|info| info.tight).reduce(TightBox::union),
            infos: infos.into(),
            contents,
        }
    }

    /// Returns the key of this set of bricks: of the volume's digest and the needs.
    pub fn key(&self) -> BrickSetKey {
        self.key
    }

    /// Returns the needs that the bricks were cut for: visible values, normals, gradients and crop.
    pub fn needs(&self) -> &BrickNeeds {
        &self.needs
    }

    /// Returns the directory: id, tight box, voxels and encoded bytes of each brick, in ascending
    /// id.
    pub fn infos(&self) -> &Arc<[BrickInfo]> {
        &self.infos
    }

    /// Returns a decoded brick; `None` if it has no relevant voxel. It is decoded at the first
    /// call, and shared and kept decoded from then on.
    pub fn brick(&self, id: BrickId) -> Option<Arc<Brick>> {
        let mut content = self.content(id)?;
        let brick = match &*content {
            Content::Decoded(brick) => return Some(brick.clone()),
            Content::Encoded(bytes) => Brick::decode(bytes).expect("the store encoded it"),
        };
        let brick = Arc::new(brick);
        *content = Content::Decoded(brick.clone());
        Some(brick)
    }

    /// Returns the encoding of a brick ([`Brick::encode`]); `None` if it has no relevant voxel. The
    /// bytes are shared, unless [`BrickStore::brick`] was called for it: then they are encoded
    /// anew.
    pub fn encoded(&self, id: BrickId) -> Option<Bytes> {
        Some(match &*self.content(id)? {
            Content::Encoded(bytes) => bytes.clone(),
            Content::Decoded(brick) => encode(brick),
        })
    }

    /// Returns the number of voxels in all bricks.
    pub fn relevant_voxels(&self) -> u64 {
        self.relevant_voxels
    }

    /// Returns the smallest box, in voxel indices of the volume, that holds all relevant voxels;
    /// `None` if there are none.
    pub fn extent(&self) -> Option<TightBox> {
        self.extent
    }

    /// Returns the size of all bricks in encoded form, in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn content(&self, id: BrickId) -> Option<MutexGuard<'_, Content>> {
        let i = self.infos.binary_search_by_key(&id, |b| b.id).ok()?;
        Some(self.contents[i].lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl std::fmt::Debug for BrickStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BrickStore")
            .field("key", &self.key)
            .field("bricks", &self.contents.len())
            .field("relevant_voxels", &self.relevant_voxels)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

fn encode(brick: &Brick) -> Bytes {
    let mut out = Vec::new();
    brick.encode(&mut out);
    out.into()
}

/// Returns for each of `codes` codes whether it is relevant. Filled by interval: a test of each
/// code would take codes times intervals, 2^31 steps for a 16-bit comb.
pub(crate) fn relevance_table(support: &Support, codes: usize) -> Vec<bool> {
    let mut relevant = vec![false; codes];
    for &(a, b) in &support.intervals {
        let (first, last) = (a.ceil().max(0.0), b.floor().min(codes as f64 - 1.0));
        if first <= last {
            relevant[first as usize..=last as usize].fill(true);
        }
    }
    relevant
}

/// Cuts all bricks with a relevant voxel, which hold `coefficients` in place of codes if there are any.
/// Gradients are those of the samples, which are the codes unless voxels have colours of their own.
/// A task is a row of bricks along x: a 256^3 volume has
/// 1024 rows of 16 Ki samples, which keeps any number of cores evenly busy.
fn cut<T: Copy + Into<f64> + Sync>(
    volume: &Volume,
    (codes, coefficients): (&[T], Option<&[f32]>),
    needs: &BrickNeeds,
    samples: fn(Vec<T>) -> Samples,
    relevant: impl Fn(T) -> bool + Sync,
) -> Vec<(BrickInfo, Mutex<Content>)> {
    let field = Codes { codes, dims: volume.lattice.dims };
    let near = (needs.halo > 0).then(|| {
        // A voxel shows within one step of it: those beside the box count.
        let beside = needs.crop.map(|crop| crop.grown(&volume.lattice, 1.0));
        let inside = |voxel| beside.is_none_or(|c| c.contains(&volume.lattice, voxel));
        let visible = |voxel, offset: usize| relevant(codes[offset]) && inside(voxel);
        VoxelMask::new(field.dims, visible).dilated(needs.halo)
    });
    let grid = BrickGrid::new(field.dims);
    let gradient_matrix = volume.gradient_matrix();
    // The luminance or alpha of colours, whose codes are places in a palette.
    let values = match (&volume.places, &volume.samples) {
        (Some(_), Samples::U8(values)) => Some(Codes { codes: values, dims: field.dims }),
        _ => None,
    };
    let row = |row: u32| {
        let mut bricks = Vec::new();
        let (y, z) = (row % grid.dims[1], row / grid.dims[1]);
        let mut found = RelevantVoxels::default();
        for x in 0..grid.dims[0] {
            let id = grid.id([x, y, z]);
            found.clear();
            let corner = [x, y, z].map(|n| n * BRICK_EDGE);
            match &near {
                Some(near) => field.collect(corner, &|_| true, &|v| near.get(v), &mut found),
                None => {
                    let inside = |v| needs.crop.is_none_or(|c| c.contains(&volume.lattice, v));
                    field.collect(corner, &relevant, &inside, &mut found);
                }
            }
            let index = &found.index[..found.voxels];
            if index.is_empty() {
                continue;
            }
            let offsets = &found.offset[..found.voxels];
            let corner = grid.corner(id);
            let gradient = |(&i, &offset)| {
                let local = slabcast_common::brick::local_position(i);
                let voxel = std::array::from_fn(|a| corner[a] + local[a]);
                gradient_matrix
                    * match &values {
                        Some(values) => values.central_difference(voxel, offset),
                        None => field.central_difference(voxel, offset),
                    }
            };
            let all = || index.iter().zip(offsets).map(gradient);
            let normals = needs.normals.then(|| all().map(encode_normal).collect());
            let magnitude = |g: glam::DVec3| encode_magnitude(g.length(), &volume.summary);
            let gradients = needs.gradients.then(|| all().map(magnitude).collect());
            let values = match coefficients {
                Some(all) => Samples::F32(offsets.iter().map(|&o| all[o]).collect()),
                None => samples(offsets.iter().map(|&o| codes[o]).collect()),
            };
            let brick = Brick::new(id, index.to_vec(), values, normals).with_gradients(gradients);
            let info = BrickInfo {
                id,
                tight: found.tight(),
                voxels: found.voxels as u16,
                bytes: brick.encoded_len() as u32,
            };
            bricks.push((info, Mutex::new(Content::Encoded(encode(&brick)))));
        }
        bricks
    };
    let rows = grid.dims[1] * grid.dims[2];
    let rows: Vec<Vec<_>> = (0..rows).into_par_iter().map(row).collect();
    rows.into_iter().flatten().collect()
}

/// A bit for each voxel of a volume, in rows along x of whole words.
struct VoxelMask {
    dims: [u32; 3],
    /// Words of a row.
    words: usize,
    bits: Vec<u64>,
}

impl VoxelMask {
    /// Marks the voxels, given by index and offset in the volume's samples, for which `marked` holds.
    fn new(dims: [u32; 3], marked: impl Fn([u32; 3], usize) -> bool + Sync) -> Self {
        let [nx, ny, nz] = dims.map(|n| n as usize);
        let words = nx.div_ceil(64);
        let mut bits = vec![0u64; words * ny * nz];
        bits.par_chunks_mut(words).enumerate().for_each(|(row, bits)| {
            let (y, z) = ((row % ny) as u32, (row / ny) as u32);
            for x in 0..nx {
                let bit = u64::from(marked([x as u32, y, z], row * nx + x));
                bits[x / 64] |= bit << (x % 64);
            }
        });
        VoxelMask { dims, words, bits }
    }

    /// Returns the mask of voxels within `steps` index steps of a marked one along each axis.
    fn dilated(mut self, steps: u32) -> Self {
        let [ny, nz] = [self.dims[1], self.dims[2]].map(|n| n as usize);
        let words = self.words;
        for _ in 0..steps {
            self.bits.par_chunks_mut(words).for_each(|row| {
                let mut before = 0;
                for i in 0..words {
                    let (here, after) = (row[i], row.get(i + 1).copied().unwrap_or(0));
                    row[i] = here | here << 1 | before >> 63 | here >> 1 | after << 63;
                    before = here;
                }
            });
        }
        // Rows along y, then layers along z: each is the union of its neighbours.
        for (n, stride) in [(ny, 1), (nz, ny)] {
            let from = &self.bits;
            let mut to = vec![0u64; from.len()];
            to.par_chunks_mut(words).enumerate().for_each(|(row, to)| {
                let at = row / stride % n;
                let (first, last) =
                    (at.saturating_sub(steps as usize), (at + steps as usize).min(n - 1));
                for other in first..=last {
                    let other = (row + other * stride - at * stride) * words;
                    for (to, from) in to.iter_mut().zip(&from[other..other + words]) {
                        *to |= from;
                    }
                }
            });
            self.bits = to;
        }
        self
    }

    fn get(&self, [x, y, z]: [u32; 3]) -> bool {
        let row = z as usize * self.dims[1] as usize + y as usize;
        self.bits[row * self.words + x as usize / 64] >> (x % 64) & 1 == 1
    }
}

/// The relevant voxels of one brick, in ascending local index.
struct RelevantVoxels {
    /// Number of voxels found.
    voxels: usize,
    index: [u16; BRICK_VOXELS],
    /// Offset of each in the volume's samples.
    offset: [usize; BRICK_VOXELS],
    /// Corners of their box in the volume, both inclusive.
    lo: [u32; 3],
    hi: [u32; 3],
}

impl Default for RelevantVoxels {
    fn default() -> Self {
        RelevantVoxels {
            voxels: 0,
            index: [0; BRICK_VOXELS],
            offset: [0; BRICK_VOXELS],
            lo: [u32::MAX; 3],
            hi: [0; 3],
        }
    }
}

impl RelevantVoxels {
    fn clear(&mut self) {
        (self.voxels, self.lo, self.hi) = (0, [u32::MAX; 3], [0; 3]);
    }

    fn tight(&self) -> TightBox {
        TightBox { lo: self.lo, hi: self.hi }
    }
}

/// A volume's codes in their own type, so that the compiler specialises the loops.
struct Codes<'a, T> {
    codes: &'a [T],
    dims: [u32; 3],
}

impl<T: Copy + Into<f64>> Codes<'_, T> {
    /// Adds the relevant voxels of the brick at `corner` to `found`.
    fn collect(
        &self,
        corner: [u32; 3],
        relevant: &impl Fn(T) -> bool,
        inside: &impl Fn([u32; 3]) -> bool,
        found: &mut RelevantVoxels,
    ) {
        let [nx, ny, _] = self.dims.map(|n| n as usize);
        let end: [u32; 3] = std::array::from_fn(|a| (corner[a] + BRICK_EDGE).min(self.dims[a]));
        for z in corner[2]..end[2] {
            for y in corner[1]..end[1] {
                let start = (z as usize * ny + y as usize) * nx + corner[0] as usize;
                let run = &self.codes[start..start + (end[0] - corner[0]) as usize];
                let row = (y - corner[1]) * 8 + (z - corner[2]) * 64;
                let before = found.voxels;
                // Each voxel is stored, and counted only if relevant: no branch depends on the
                // data.
                for (x, &code) in run.iter().enumerate() {
                    found.index[found.voxels] = (row + x as u32) as u16;
                    found.offset[found.voxels] = start + x;
                    let counts = relevant(code) && inside([corner[0] + x as u32, y, z]);
                    found.voxels += usize::from(counts);
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

    /// Returns the differences along the index axes at `voxel`, whose sample lies at `offset`, with
    /// the arithmetic of [`Volume::gradient`] bit for bit (a test compares).
    #[inline]
    fn central_difference(&self, voxel: [u32; 3], offset: usize) -> glam::DVec3 {
        let [nx, ny, nz] = self.dims;
        let along = |p: u32, n: u32, stride: usize| {
            let below = usize::from(p > 0);
            let above = usize::from(p + 1 < n);
            if below + above == 0 {
                return 0.0;
            }
            let hi: f64 = self.codes[offset + above * stride].into();
            let lo: f64 = self.codes[offset - below * stride].into();
            // Exact: a product with 0.5 equals the quotient by 2.
            (hi - lo) * if below + above == 2 { 0.5 } else { 1.0 }
        };
        glam::DVec3::new(
            along(voxel[0], nx, 1),
            along(voxel[1], ny, nx as usize),
            along(voxel[2], nz, nx as usize * ny as usize),
        )
    }
}

#[cfg(test)]
mod tests;
