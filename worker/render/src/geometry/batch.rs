//! A batch of voxels on its way from a bucket to the pixel records, each section with weights of
//! its own.

use crate::geometry::open_sheets::{EDGE, Sheets, slot};
use crate::kernels::pixel_records::sheet_offsets::{
    Apart, BATCH, Each, Layers, Woven, splat_skewed,
};
use crate::kernels::pixel_records::{Recorded, Table};
use crate::kernels::toss::any_in_rows;
use crate::kernels::{Simd, whole_registers};
use crate::part::Part;
use crate::primitives::footprint::{Footprint, Leaning, Phases};
use crate::scene::Frame;
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;

/// Up to 64 voxels of one bucket with their samples and normals, and the places of their sections.
pub struct Batch {
    pub(crate) samples: Each<u32>,
    pub(crate) normals: Each<u16>,
    pub(crate) apart: Apart,
    /// Open pixels where the sections of each voxel lie: 0 if there are none.
    pub(crate) near: Each<u64>,
    light: [Each<f32>; 4],
}

impl Default for Batch {
    fn default() -> Self {
        Batch {
            samples: [0; BATCH],
            normals: [0; BATCH],
            apart: Apart::default(),
            near: [0; BATCH],
            light: [[0.0; BATCH]; 4],
        }
    }
}

/// Footprints by slot of an open sheet: their weights, and the layouts of those across and down.
pub struct Axes<'a, S: Recorded, const N: usize> {
    /// Weight tables by slot: across, down and in depth.
    pub layers: Layers<'a, S, N>,
    /// Layouts of the weight tables by axis (across, down) and slot.
    pub phases: [[Phases; N]; 2],
}

impl<'a, S: Recorded, const N: usize> Axes<'a, S, N> {
    /// Puts one footprint into all slots, for voxels that begin in sheet `k`.
    #[inline(always)]
    pub fn new(frame: &'a Frame, k: i32, footprint: &Footprint<'a>) -> Self {
        let [(x, phases_x), (y, phases_y)] = [along::<S>(footprint, 0), along::<S>(footprint, 1)];
        let deep = Table { weights: S::deep(&frame.sections), len: frame.sections.most() };
        let alike = frame.has_columns_alike();
        let (across, slot) = ([[x; N], [y; N]], slot::<N>(k));
        let layers = Layers { across, deep, slot, alike, slant: None };
        Axes { layers, phases: [[phases_x; N], [phases_y; N]] }
    }

    /// Has another footprint in a slot.
    #[inline(always)]
    pub(crate) fn put(&mut self, slot: usize, footprint: &Footprint<'a>) {
        for axis in 0..2 {
            let (table, phases) = along::<S>(footprint, axis);
            (self.layers.across[axis][slot], self.phases[axis][slot]) = (table, phases);
        }
    }
}

/// Weights of a footprint along an axis, and where they lie.
#[inline(always)]
fn along<'a, S: Recorded>(
    footprint: &Footprint<'a>,
    axis: usize,
) -> (Table<'a, S::Weight>, Phases) {
    let table = footprint.phases(axis).zip(S::across(footprint, axis));
    let (phases, weights) = table.expect("footprints have tables");
    (Table { weights, len: phases.len }, phases)
}

impl Batch {
    /// Looks whether anything is open in the windows of the first `n` voxels.
    #[inline(always)]
    fn look(&mut self, (simd, part, open): (Simd, &Part<'_>, &OpenMask), n: usize) {
        let cull = part.frame.scene.quality.cull;
        let Apart { lo, hi, .. } = &self.apart;
        for (i, near) in self.near[..n].iter_mut().enumerate() {
            let ([x0, y0], [x1, y1]) = ([lo[0][i], lo[1][i]], [hi[0][i], hi[1][i]]);
            *near = 0;
            if x0 < x1 && y0 < y1 {
                let columns = (u64::MAX >> (64 - (x1 - x0))) << x0;
                let rows = [y0, y1].map(|y| y as usize);
                *near = u64::from(!cull || any_in_rows(simd, open.rows(), rows, columns));
            }
        }
    }

    /// Keeps of the first `n` voxels those that [anything is open](Batch::near) near, and has light
    /// fall on them; says how many there are. `eyes`: eye coordinates by axis, where each voxel
    /// sees the eye in a direction of its own. Of `of` voxels that there were, what is added and
    /// what not is counted.
    #[inline(always)]
    pub(crate) fn light<S: Recorded>(
        &mut self,
        (simd, frame): (Simd, &Frame),
        n: usize,
        mut eyes: Option<&mut [Each<f64>; 3]>,
        payloads: &mut [S::Payload; BATCH],
        (of, counters): (usize, &mut Counters),
    ) -> usize {
        let Batch { samples, normals, apart, near, light } = self;
        let kept = &mut apart.kept;
        let mut some = 0;
        for i in 0..n {
            kept[some] = i as u32;
            for eye in eyes.iter_mut().flat_map(|eyes| eyes.iter_mut()) {
                eye[some] = eye[i];
            }
            (samples[some], normals[some]) = (samples[i], normals[i]);
            some += usize::from(near[i] != 0);
        }
        let all = whole_registers::<BATCH>(some);
        let eyes = eyes.map(|eyes| eyes.each_ref().map(|eye| &eye[..all]));
        frame.payloads(simd, &samples[..some], &normals[..all], eyes, light);
        let [sigma, r, g, b] = light;
        for (j, payload) in payloads[..some].iter_mut().enumerate() {
            *payload = S::payload([sigma[j], r[j], g[j], b[j]]);
        }
        counters.splatted += some as u64;
        counters.culled += (of - some) as u64;
        some
    }

    /// Adds those of the first `n` voxels that [are kept](Batch::light) to their sheets from `k`
    /// on, which have these footprints.
    #[inline(always)]
    pub(crate) fn add<S: Recorded, const N: usize>(
        &mut self,
        (part, open): (&Part<'_>, &OpenMask),
        (n, k): (usize, i32),
        Axes { layers, phases: [phases, _] }: &Axes<'_, S, N>,
        eyes: Option<&mut [Each<f64>; 3]>,
        woven: &mut Woven<S::Weight, N>,
        sheets: &mut Sheets<'_, S, N>,
        counted: (usize, &mut Counters),
    ) {
        let mut payloads = [S::Payload::default(); BATCH];
        self.look((sheets.simd, part, open), n);
        let asked = (sheets.simd, part.frame);
        let some = self.light::<S>(asked, n, eyes, &mut payloads, counted);
        let apart = &self.apart;
        // All windows as wide and high as the largest: they are alike but for a pixel or two, and
        // pixels that nothing was added to are found out when they close.
        let (mut corners, mut columns, mut rows) = ([0; EDGE], 1, 1);
        for &i in &apart.kept[..some] {
            let ([x, y], [wide, high]) = apart.window(i as usize % BATCH, S::step::<N>());
            corners[y % EDGE] |= 1 << x;
            (columns, rows) = (columns.max(wide), rows.max(high));
        }
        sheets.touch_all(k, &corners, [columns, rows]);
        let row = part.frame.leaning.as_ref().map_or(0, Leaning::row);
        let voxels = (apart, &payloads[..some]);
        if row == 0 || layers.slant.is_some() {
            S::splat_apart(sheets.simd, sheets.records, voxels, layers, woven);
        } else {
            let layers = (layers, (row, phases));
            splat_skewed::<S, N>(sheets.simd, sheets.records, voxels, layers, woven);
        }
    }
}
