//! Cutting one block of samples into bricks.
//!
//! A block's bricks depend on its samples and those within [`margin`] of it, so a block is cut from a
//! box of samples alone, whatever else of the volume is in memory.

use super::mask::VoxelMask;
use bytes::Bytes;
use slabcast_common::brick::{
    BRICK_EDGE, BRICK_VOXELS, Brick, BrickGrid, BrickInfo, TightBox, local_position,
};
use slabcast_common::crop::CropBox;
use slabcast_common::gradient::encode_magnitude;
use slabcast_common::shade::encode_normal;
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Lattice, SampleKind, Samples, VolumeInfo};
use slabcast_scene::brick_needs::BrickNeeds;

/// Returns the steps around a block whose samples its bricks depend on.
pub(super) fn margin(needs: &BrickNeeds) -> u32 {
    needs.halo.max(u32::from(needs.normals || needs.gradients))
}

/// Data that all blocks of a set are cut with.
pub(super) struct Cutter<'a> {
    info: &'a VolumeInfo,
    needs: &'a BrickNeeds,
    grid: BrickGrid,
    gradient_matrix: glam::DMat3,
    /// Whether each code of an integer volume is visible; empty for floats.
    visible: Vec<bool>,
    /// Box outside of which nothing is visible.
    crop: Option<CropBox>,
}

/// Samples of a box of a volume.
pub(super) struct SampleBox<'a> {
    /// The samples, i fastest.
    pub(super) samples: &'a Samples,
    /// Corner of the box in the volume.
    pub(super) lo: [u32; 3],
    /// End of the box, exclusive.
    pub(super) hi: [u32; 3],
}

/// Numbers of the same box beside its samples.
#[derive(Clone, Copy)]
struct Beside<'a> {
    /// Coefficients that bricks hold in place of samples.
    coefficients: Option<&'a SampleBox<'a>>,
    /// Values of which gradients are, where samples are places in a palette.
    values: Option<&'a [u8]>,
}

impl<'a> Cutter<'a> {
    pub(super) fn new(info: &'a VolumeInfo, needs: &'a BrickNeeds) -> Cutter<'a> {
        let codes = match info.summary.code_kind() {
            SampleKind::U8 => 256,
            SampleKind::U16 => 65536,
            SampleKind::F32 => 0,
        };
        // A voxel shows within one step of it: with a halo those beside the box count.
        let beside =
            |crop: CropBox| if needs.halo > 0 { crop.grown(&info.lattice, 1.0) } else { crop };
        Cutter {
            info,
            needs,
            grid: BrickGrid::new(info.lattice.dims),
            gradient_matrix: info.lattice.gradient_matrix(),
            visible: relevance_table(&needs.support, codes),
            crop: needs.crop.map(beside),
        }
    }

    /// Cuts the voxels from `lo` to `hi` (exclusive), a box of whole bricks, into bricks with their
    /// encodings, in ascending id. `samples` holds the box and [`margin`] steps around it, as far as
    /// the volume goes. `coefficients`, if there are any, are of the same box, and are what the
    /// bricks hold.
    pub(super) fn cut(
        &self,
        samples: &SampleBox<'_>,
        coefficients: Option<&SampleBox<'_>>,
        lo: [u32; 3],
        hi: [u32; 3],
    ) -> Vec<(BrickInfo, Bytes)> {
        let SampleBox { lo: from, hi: to, .. } = *samples;
        let (bounds, block) = ((from, to), (lo, hi));
        let visible = &self.visible[..];
        let mut beside = Beside { coefficients, values: None };
        match samples.samples {
            Samples::U8(v) => {
                let seen = |c: u8| visible[usize::from(c)];
                self.cut_codes(v, bounds, beside, block, Samples::U8, seen)
            }
            Samples::U16(v) => {
                let seen = |c: u16| visible[usize::from(c)];
                let values: Option<Vec<u8>> = match &self.info.summary.palette {
                    Some(palette) if self.needs.normals || self.needs.gradients => {
                        Some(v.iter().map(|&place| palette.value_of(place)).collect())
                    }
                    _ => None,
                };
                beside.values = values.as_deref();
                self.cut_codes(v, bounds, beside, block, Samples::U16, seen)
            }
            Samples::F32(v) => {
                let seen = |c: f32| self.needs.support.contains(f64::from(c));
                self.cut_codes(v, bounds, beside, block, Samples::F32, seen)
            }
        }
    }

    fn cut_codes<T: Copy + Into<f64>>(
        &self,
        codes: &[T],
        (from, to): ([u32; 3], [u32; 3]),
        Beside { coefficients, values }: Beside<'_>,
        (lo, hi): ([u32; 3], [u32; 3]),
        samples: fn(Vec<T>) -> Samples,
        relevant: impl Fn(T) -> bool,
    ) -> Vec<(BrickInfo, Bytes)> {
        let needs = self.needs;
        let size = std::array::from_fn(|a| (to[a] - from[a]) as usize);
        let lattice: &Lattice = &self.info.lattice;
        let field = Codes { codes, lo: from, size, dims: lattice.dims };
        let values = values.map(|codes| Codes { codes, lo: from, size, dims: lattice.dims });
        let is_inside = |voxel| self.crop.is_none_or(|c| c.contains(lattice, voxel));
        let near = (needs.halo > 0).then(|| {
            let first = std::array::from_fn(|a| lo[a].saturating_sub(needs.halo));
            let end = std::array::from_fn(|a| (hi[a] + needs.halo).min(lattice.dims[a]));
            let row = |first| &codes[field.offset(first)..];
            let mut mask = VoxelMask::new(first, end, row, &relevant);
            if self.crop.is_some() {
                mask.keep(is_inside);
            }
            mask
        });
        if near.as_ref().is_some_and(VoxelMask::is_empty) {
            return Vec::new();
        }
        let near = near.map(|mask| mask.dilated(needs.halo));
        let mut bricks = Vec::new();
        let mut found = RelevantVoxels::default();
        let steps = |a: usize| (lo[a]..hi[a]).step_by(BRICK_EDGE as usize);
        for corner in
            steps(2).flat_map(|z| steps(1).flat_map(move |y| steps(0).map(move |x| [x, y, z])))
        {
            found.clear();
            match &near {
                Some(near) => {
                    let end = std::array::from_fn(|a| (corner[a] + BRICK_EDGE).min(hi[a]));
                    near.collect(corner, end, |voxel| field.offset(voxel), &mut found);
                }
                None => field.collect(corner, &relevant, &is_inside, &mut found),
            }
            let index = &found.index[..found.voxels];
            if index.is_empty() {
                continue;
            }
            let offsets = &found.offset[..found.voxels];
            let gradient = |(&i, &offset)| {
                let local = local_position(i);
                let voxel = std::array::from_fn(|a| corner[a] + local[a]);
                self.gradient_matrix
                    * match &values {
                        Some(values) => values.central_difference(voxel, offset),
                        None => field.central_difference(voxel, offset),
                    }
            };
            let all = || index.iter().zip(offsets).map(gradient);
            let normals = needs.normals.then(|| all().map(encode_normal).collect());
            let magnitude = |g: glam::DVec3| encode_magnitude(g.length(), &self.info.summary);
            let gradients = needs.gradients.then(|| all().map(magnitude).collect());
            let values = match coefficients {
                Some(SampleBox { samples: Samples::F32(all), .. }) => {
                    Samples::F32(offsets.iter().map(|&o| all[o]).collect())
                }
                _ => samples(offsets.iter().map(|&o| codes[o]).collect()),
            };
            let id = self.grid.id(corner.map(|n| n / BRICK_EDGE));
            let brick = Brick::new(id, index.to_vec(), values, normals).with_gradients(gradients);
            let info = BrickInfo {
                id,
                tight: TightBox { lo: found.lo, hi: found.hi },
                voxels: found.voxels as u16,
                bytes: brick.encoded_len() as u32,
            };
            bricks.push((info, super::encode(&brick)));
        }
        bricks
    }
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

/// The relevant voxels of one brick, in ascending local index.
pub(super) struct RelevantVoxels {
    /// Number of voxels found.
    voxels: usize,
    index: [u16; BRICK_VOXELS],
    /// Offset of each in the box's samples.
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

    /// Adds a voxel; its box is grown by [`RelevantVoxels::reach`].
    #[inline]
    pub(super) fn add(&mut self, index: u16, offset: usize) {
        self.index[self.voxels] = index;
        self.offset[self.voxels] = offset;
        self.voxels += 1;
    }

    /// Grows the box by the run of voxels from `first` to `last`.
    pub(super) fn reach(&mut self, first: [u32; 3], last: [u32; 3]) {
        for a in 0..3 {
            self.lo[a] = self.lo[a].min(first[a]);
            self.hi[a] = self.hi[a].max(last[a]);
        }
    }
}

/// Codes of a box in their own type, so that the compiler specialises the loops.
struct Codes<'a, T> {
    codes: &'a [T],
    /// Corner of the box in the volume.
    lo: [u32; 3],
    /// Samples of the box along each axis.
    size: [usize; 3],
    /// Samples of the volume along each axis.
    dims: [u32; 3],
}

impl<T: Copy + Into<f64>> Codes<'_, T> {
    /// Returns the offset of a voxel of the volume in the box's samples.
    #[inline]
    fn offset(&self, voxel: [u32; 3]) -> usize {
        let [x, y, z]: [usize; 3] = std::array::from_fn(|a| (voxel[a] - self.lo[a]) as usize);
        (z * self.size[1] + y) * self.size[0] + x
    }

    /// Adds the relevant voxels of the brick at `corner` to `found`.
    fn collect(
        &self,
        corner: [u32; 3],
        relevant: &impl Fn(T) -> bool,
        inside: &impl Fn([u32; 3]) -> bool,
        found: &mut RelevantVoxels,
    ) {
        let end: [u32; 3] = std::array::from_fn(|a| (corner[a] + BRICK_EDGE).min(self.dims[a]));
        for z in corner[2]..end[2] {
            for y in corner[1]..end[1] {
                let start = self.offset([corner[0], y, z]);
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
                    found.reach([x(before), y, z], [x(found.voxels - 1), y, z]);
                }
            }
        }
    }

    /// Returns the differences along the index axes at `voxel`, whose sample lies at `offset`, with
    /// the arithmetic of [`slabcast_common::volume::Volume::gradient`] bit for bit (a test compares).
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
            along(voxel[1], ny, self.size[0]),
            along(voxel[2], nz, self.size[0] * self.size[1]),
        )
    }
}
