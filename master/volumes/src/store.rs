//! The bricks of one volume that a transfer function can see, each encoded once.
//!
//! A store is built once and never changes, so an [`std::sync::Arc`] of it is shared by all
//! that send. A brick's bytes are made when the first worker asks and are the same `Bytes` for
//! every later one: sending to sixty workers copies a pointer sixty times.

use bytes::Bytes;
use rayon::prelude::*;
use slabcast_common::brick::{
    BRICK, BRICK_VOXELS, Brick, BrickGrid, BrickInfo, BrickSetKey, TightBox,
};
use slabcast_common::ids::BrickId;
use slabcast_common::shade::encode_normal;
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Digest32, Samples, Volume};
use std::sync::{Arc, OnceLock};

/// The relevant bricks of a volume for one support, in ascending id.
pub struct BrickStore {
    key: BrickSetKey,
    support: Support,
    normals: bool,
    infos: Arc<[BrickInfo]>,
    bricks: Vec<Arc<Brick>>,
    encoded: Vec<OnceLock<Bytes>>,
    relevant_voxels: u64,
    bytes: u64,
}

impl BrickStore {
    /// Cuts a volume on all cores. `digest` is [`Volume::digest`]; bricks without a relevant
    /// voxel are left out; normals are made only where `normals` asks for them.
    pub fn build(volume: &Volume, digest: Digest32, support: &Support, normals: bool) -> Self {
        let cut = match &volume.samples {
            Samples::U8(v) => {
                let relevant = table(support, 256);
                cut(volume, v, normals, Samples::U8, |c| relevant[usize::from(c)])
            }
            Samples::U16(v) => {
                let relevant = table(support, 65536);
                cut(volume, v, normals, Samples::U16, |c| relevant[usize::from(c)])
            }
            Samples::F32(v) => {
                cut(volume, v, normals, Samples::F32, |c| support.contains(f64::from(c)))
            }
        };
        let (infos, bricks): (Vec<BrickInfo>, Vec<Arc<Brick>>) = cut.into_iter().unzip();
        BrickStore {
            key: support.key(digest, normals),
            support: support.clone(),
            normals,
            relevant_voxels: infos.iter().map(|b| u64::from(b.voxels)).sum(),
            bytes: infos.iter().map(|b| u64::from(b.bytes)).sum(),
            encoded: infos.iter().map(|_| OnceLock::new()).collect(),
            infos: infos.into(),
            bricks,
        }
    }

    /// Which bricks these are.
    pub fn key(&self) -> BrickSetKey {
        self.key
    }

    /// Which codes are relevant.
    pub fn support(&self) -> &Support {
        &self.support
    }

    /// Whether the bricks hold normals.
    pub fn has_normals(&self) -> bool {
        self.normals
    }

    /// The directory of bricks, in ascending id.
    pub fn infos(&self) -> &Arc<[BrickInfo]> {
        &self.infos
    }

    /// A brick, if it has a relevant voxel.
    pub fn brick(&self, id: BrickId) -> Option<&Arc<Brick>> {
        Some(&self.bricks[self.at(id)?])
    }

    /// A brick's encoding ([`Brick::encode`]): made once, then shared.
    pub fn encoded(&self, id: BrickId) -> Option<Bytes> {
        let at = self.at(id)?;
        let bytes = self.encoded[at].get_or_init(|| {
            let mut out = Vec::new();
            self.bricks[at].encode(&mut out);
            out.into()
        });
        Some(bytes.clone())
    }

    /// Voxels in all bricks.
    pub fn relevant_voxels(&self) -> u64 {
        self.relevant_voxels
    }

    /// Bytes of all encodings.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn at(&self, id: BrickId) -> Option<usize> {
        self.infos.binary_search_by_key(&id, |b| b.id).ok()
    }
}

impl std::fmt::Debug for BrickStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BrickStore")
            .field("key", &self.key)
            .field("bricks", &self.bricks.len())
            .field("relevant_voxels", &self.relevant_voxels)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
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

/// All bricks with a relevant voxel. One task is a row of bricks along x, 2 KiB of 8-bit codes
/// in 64 runs for a volume of 256, so that 1024 tasks keep any number of cores even.
fn cut<T: Copy + Into<f64> + Sync>(
    volume: &Volume,
    codes: &[T],
    normals: bool,
    samples: fn(Vec<T>) -> Samples,
    relevant: impl Fn(T) -> bool + Sync,
) -> Vec<(BrickInfo, Arc<Brick>)> {
    let field = Field { codes, dims: volume.lattice.dims };
    let grid = BrickGrid::of(field.dims);
    let gradient_matrix = volume.gradient_matrix();
    let row = |row: u32| {
        let mut bricks = Vec::new();
        let (y, z) = (row % grid.dims[1], row / grid.dims[1]);
        for x in 0..grid.dims[0] {
            let id = grid.id([x, y, z]);
            let mut found = Found::default();
            field.search([x, y, z].map(|n| n * BRICK), &relevant, &mut found);
            let index = &found.index[..found.voxels];
            if index.is_empty() {
                continue;
            }
            let offsets = &found.offset[..found.voxels];
            let brick = Brick {
                id,
                index: index.to_vec(),
                values: samples(offsets.iter().map(|&o| codes[o]).collect()),
                normals: normals.then(|| {
                    let corner = grid.corner(id);
                    let normal = |(&i, &offset)| {
                        let local = slabcast_common::brick::local(i);
                        let at = std::array::from_fn(|a| corner[a] + local[a]);
                        encode_normal(gradient_matrix * field.difference(at, offset))
                    };
                    index.iter().zip(offsets).map(normal).collect()
                }),
            };
            let info = BrickInfo {
                id,
                tight: found.tight(),
                voxels: found.voxels as u16,
                bytes: brick.encoded_len() as u32,
            };
            bricks.push((info, Arc::new(brick)));
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
    fn search(&self, corner: [u32; 3], relevant: &impl Fn(T) -> bool, found: &mut Found) {
        let [nx, ny, _] = self.dims.map(|n| n as usize);
        let end: [u32; 3] = std::array::from_fn(|a| (corner[a] + BRICK).min(self.dims[a]));
        for z in corner[2]..end[2] {
            for y in corner[1]..end[1] {
                let start = (z as usize * ny + y as usize) * nx + corner[0] as usize;
                let run = &self.codes[start..start + (end[0] - corner[0]) as usize];
                let row = (y - corner[1]) * 8 + (z - corner[2]) * 64;
                let before = found.voxels;
                for (x, &code) in run.iter().enumerate() {
                    if relevant(code) {
                        found.index[found.voxels] = (row + x as u32) as u16;
                        found.offset[found.voxels] = start + x;
                        found.voxels += 1;
                    }
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
            (hi - lo) / (below + above) as f64
        };
        glam::DVec3::new(
            along(at[0], nx, 1),
            along(at[1], ny, nx as usize),
            along(at[2], nz, nx as usize * ny as usize),
        )
    }
}
