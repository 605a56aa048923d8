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
mod tests {
    use super::*;
    use proptest::prelude::*;
    use slabcast_common::brick::local_position;
    use slabcast_common::shade::NO_NORMAL;
    use slabcast_common::volume::{Lattice, ValueMap};
    use slabcast_scene::path::{Crop, CropUnit};

    fn span(a: f64, b: f64) -> Support {
        Support { intervals: vec![(a, b)], nan: false }
    }

    /// Looks at every voxel of a volume, plainly, and compares with what the store holds.
    fn check(volume: &Volume, support: &Support, normals: bool) -> BrickStore {
        let support = support.clone();
        check_all(volume, &BrickNeeds { support, normals, gradients: false, crop: None })
    }

    fn check_all(volume: &Volume, wanted: &BrickNeeds) -> BrickStore {
        let (support, normals) = (&wanted.support, wanted.normals);
        let digest = volume.digest();
        let store = BrickStore::build(volume, digest, wanted);
        let dims = volume.lattice.dims;
        let grid = BrickGrid::new(dims);
        let m = volume.gradient_matrix();
        assert_eq!(store.key(), wanted.set_key(digest));
        assert!(store.infos().windows(2).all(|w| w[0].id < w[1].id), "ids ascend");
        let mut seen = std::collections::BTreeMap::new();
        let mut bytes = 0;
        for info in store.infos().iter() {
            let encoded = store.encoded(info.id).expect("every info has an encoding");
            assert_eq!(encoded.len(), info.bytes as usize);
            let again = store.encoded(info.id).expect("as before");
            assert_eq!(again.as_ptr(), encoded.as_ptr(), "encoded once, then shared");
            let brick = store.brick(info.id).expect("every info has a brick");
            let again = store.brick(info.id).expect("as before");
            assert!(Arc::ptr_eq(&brick, &again), "unpacked once, then shared");
            assert_eq!(store.encoded(info.id).expect("as before"), encoded, "packed anew");
            assert_eq!(brick.id, info.id);
            assert_eq!(brick.len(), usize::from(info.voxels));
            assert!(!brick.is_empty() && brick.index.windows(2).all(|w| w[0] < w[1]));
            assert_eq!(brick.tight_box(&grid), info.tight);
            assert_eq!(brick.normals.is_some(), normals);
            assert_eq!(brick.gradients.is_some(), wanted.gradients);
            // NaN is not equal to itself; its bytes are.
            let decoded = Brick::decode(&encoded).expect("our own bytes are good");
            let mut re_encoded = Vec::new();
            decoded.encode(&mut re_encoded);
            assert_eq!(re_encoded, encoded);
            bytes += encoded.len() as u64;
            let corner = grid.corner(info.id);
            for (n, &i) in brick.index.iter().enumerate() {
                let l = local_position(i);
                let at: [u32; 3] = std::array::from_fn(|a| corner[a] + l[a]);
                let normal = brick.normals.as_ref().map(|v| v[n]);
                if let Some(g) = &brick.gradients {
                    let want = volume.gradient(at, &m).length();
                    assert_eq!(g[n], encode_magnitude(want, &volume.summary), "gradient at {at:?}");
                }
                let before = seen.insert([at[2], at[1], at[0]], (brick.values.code(n), normal));
                assert_eq!(before, None, "voxel {at:?} is in two bricks");
            }
        }
        assert_eq!(bytes, store.bytes());
        let mut relevant = 0;
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    let offset = ((k * dims[1] + j) * dims[0] + i) as usize;
                    let code = volume.samples.code(offset);
                    let found = seen.remove(&[k, j, i]);
                    let inside = wanted.crop.is_none_or(|c| c.contains(&volume.lattice, [i, j, k]));
                    if !support.contains(code) || !inside {
                        assert!(found.is_none(), "({i}, {j}, {k}) is not relevant");
                        continue;
                    }
                    relevant += 1;
                    let (value, normal) =
                        found.unwrap_or_else(|| panic!("({i}, {j}, {k}) is missing"));
                    assert_eq!(value.to_bits(), code.to_bits());
                    let want = normals.then(|| encode_normal(volume.gradient([i, j, k], &m)));
                    assert_eq!(normal, want, "normal at ({i}, {j}, {k})");
                }
            }
        }
        assert!(seen.is_empty(), "voxels outside of the volume: {seen:?}");
        assert_eq!(relevant, store.relevant_voxels());
        store
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]
        #[test]
        fn every_relevant_voxel_is_in_one_brick_with_its_value_and_normal(
            dims in [1u32..20, 1u32..20, 1u32..20], kind in 0u8..3, normals in any::<bool>(),
            seed in any::<u32>(), cut in 0.0..1.2f64, shear in -0.5..0.5f64, crop in any::<bool>(),
        ) {
            let n = dims.iter().product::<u32>();
            let hash = |i: u32| (seed ^ i).wrapping_mul(2_654_435_761).rotate_left(13) >> 5;
            let (samples, top) = match kind {
                0 => (Samples::U8((0..n).map(|i| hash(i) as u8).collect()), 255.0),
                1 => (Samples::U16((0..n).map(|i| hash(i) as u16).collect()), 65535.0),
                _ => (Samples::F32((0..n).map(|i| match hash(i) % 31 {
                    0 => f32::NAN,
                    1 => f32::INFINITY,
                    _ => (hash(i) % 1000) as f32 * 1e-3,
                }).collect()), 1.0),
            };
            let mut lattice = Lattice::from_spacing(dims, [1.0, 0.7, 2.5]);
            lattice.steps[1].x = shear;
            let volume = Volume::new("v", "t", false, lattice, samples, ValueMap::IDENTITY);
            let support = Support {
                intervals: vec![(0.1 * top * cut, 0.2 * top * cut), (top * cut, top)],
                nan: seed % 2 == 0,
            };
            let crop = crop.then(|| {
                let share = Some(f64::from(seed % 7) / 10.0);
                let crop = Crop { unit: CropUnit::Unit, x: [None, share.map(|s| s + 0.2)], y: [share, None], ..Crop::default() };
                crop.resolve(&volume.lattice).unwrap()
            });
            check_all(&volume, &BrickNeeds { support, normals, gradients: seed % 3 == 0, crop });
        }
    }

    #[test]
    fn empty_and_full_and_flat_volumes() {
        let full = Volume::from_fn_u8("full", [17, 9, 8], |_, _, _| 200);
        let store = check(&full, &span(1.0, 255.0), true);
        assert_eq!((store.infos().len(), store.relevant_voxels()), (6, 17 * 9 * 8));
        let flat = store.infos().iter().all(|b| {
            let brick = store.brick(b.id).unwrap();
            brick.normals.as_ref().unwrap().iter().all(|&n| n == NO_NORMAL)
        });
        assert!(flat, "a constant field has no normals");
        let none = check(&full, &span(201.0, 255.0), true);
        assert_eq!((none.infos().len(), none.bytes()), (0, 0));
        assert!(none.brick(BrickId(0)).is_none() && none.encoded(BrickId(0)).is_none());
        let nothing = Support::default();
        assert_eq!(check(&full, &nothing, false).relevant_voxels(), 0);
        for dims in [[1, 1, 1], [4096, 1, 1], [1, 65, 1], [1, 1, 33]] {
            let line = Volume::from_fn_u8("line", dims, |i, j, k| (i + j + k) as u8 | 1);
            check(&line, &span(1.0, 255.0), true);
        }
    }

    #[test]
    fn a_set_with_normals_and_one_without_have_different_keys() {
        let v = Volume::from_fn_u8("v", [8; 3], |i, _, _| i as u8);
        let support = span(3.0, 4.0);
        let (with, without) = (check(&v, &support, true), check(&v, &support, false));
        assert_ne!(with.key(), without.key());
        assert!(with.wanted().normals && !without.wanted().normals);
        assert_eq!(with.wanted().support, support);
        assert!(with.bytes() > without.bytes());
    }

    #[test]
    fn a_table_is_what_the_support_says_for_every_code() {
        for intervals in [
            vec![],
            vec![(0.0, 255.0)],
            vec![(0.0, 0.0), (7.0, 9.0), (255.0, 255.0)],
            vec![(-5.0, 2.5), (250.2, 1e9)],
            vec![(3.2, 3.8), (f64::NEG_INFINITY, -1.0), (300.0, f64::INFINITY)],
        ] {
            let support = Support { intervals, nan: true };
            for (code, &relevant) in table(&support, 256).iter().enumerate() {
                assert_eq!(relevant, support.contains(code as f64), "{code} of {support:?}");
            }
        }
    }

    #[test]
    fn many_threads_get_the_same_bytes() {
        let v = Volume::from_fn_u8("v", [32; 3], |i, j, k| (i * j + k) as u8 | 1);
        let wanted =
            BrickNeeds { support: span(1.0, 255.0), normals: true, gradients: false, crop: None };
        let store = BrickStore::build(&v, Digest32::default(), &wanted);
        let id = store.infos()[7].id;
        let seen: Vec<usize> = std::thread::scope(|s| {
            let ask = || store.encoded(id).expect("it is relevant").as_ptr() as usize;
            let threads: Vec<_> = (0..8).map(|_| s.spawn(ask)).collect();
            threads.into_iter().map(|t| t.join().expect("no panic")).collect()
        });
        assert!(seen.windows(2).all(|w| w[0] == w[1]));
    }
}
