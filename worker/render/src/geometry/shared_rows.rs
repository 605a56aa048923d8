//! The open sheets of views with a level camera, and orthographic views of that kind
//! ([`crate::primitives::lattice_rows`]).
//!
//! Voxels get here as they do in [`crate::geometry::ortho`] and [`crate::geometry::perspective`],
//! and are added to row records ([`crate::kernels::row_records`]) instead of pixels. A sheet that
//! closes makes the sums of its open, touched pixels from the rows, its own and what the sheet
//! behind has by then, and packs those that have any extinction, with their sums of the sheet
//! before, for compositing.

use crate::geometry::open_sheets::{
    Chunk, Closes, Due, EDGE, Open, Queues, Rows, Stage, Store, close_folded, slot, walk,
};
use crate::geometry::ortho::{self, BATCH, Batch, Waiting, toss};
use crate::kernels::pixel_records::{MOST, Recorded, Splat, Table};
use crate::kernels::row_records::{ByRow, Ends, FOUR, Folded, Shape, Tiered, Tiers, Weights};
use crate::kernels::toss::{Packing, TIER_BITS, TierOf, Tossing};
use crate::kernels::{Simd, Weight, Work};
use crate::part::{Io, Part, Pixels};
use crate::primitives::footprint::{Footprint, Phases};
use crate::primitives::lattice_rows::LatticeRows;
use crate::primitives::sizes::LATTICE_ROWS as ROWS;
use crate::primitives::sizes::PART;
use crate::scene::{Flat, Frame};
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;
use slabcast_common::view::{Projection, SUBPIXEL_BITS, SUBPIXELS};

/// The tiers that reach each row of a part's pixels in one sheet, and what they weigh there.
struct Down<'a, W> {
    /// Number of the sheet.
    k: i32,
    base: i32,
    weights: &'a [W],
    spread: f32,
    /// Of each row: the first tier, and how many there are: four, or a few more.
    reach: [[u8; 2]; EDGE],
    /// Rows that more than four reach.
    more: u64,
    len: i32,
    /// By tier, the first row of pixels that it reaches, and where the weight of the part's first
    /// would lie.
    first: [i32; ROWS],
    from: [i32; ROWS],
    /// Rows whose tiers and weights are known, one bit each.
    known: u64,
    by_row: ByRow<W>,
}

/// Farther from a part than any of its tiers.
const FAR: i32 = 1 << 20;

impl<W: Weight> Default for Down<'_, W> {
    fn default() -> Self {
        Down {
            k: i32::MIN,
            base: 0,
            weights: &[],
            spread: 1.0,
            reach: [[0; 2]; EDGE],
            more: 0,
            len: 0,
            first: [0; ROWS],
            from: [0; ROWS],
            known: 0,
            by_row: ByRow::default(),
        }
    }
}

impl<'a, W: Weight> Down<'a, W> {
    /// Of sheet `k` with this footprint, whose weights down are `weights`.
    #[inline(always)]
    fn fill(
        &mut self,
        k: i32,
        part: &'a Part<'_>,
        lattice_rows: &LatticeRows,
        (footprint, weights): (&Footprint<'a>, &'a [W]),
        tiers: usize,
    ) {
        let phases = footprint.phases(1).expect("a table");
        let (view, rect) = (&part.frame.view, &part.rect);
        let base = lattice_rows.base(view, rect, footprint.scale);
        (self.k, self.base, self.weights, self.spread) = (k, base, weights, lattice_rows.spread);
        (self.known, self.more) = (0, 0);
        // Far away for lattice rows that there are none of.
        for tier in 0..tiers {
            let lattice_row = base + tier as i32;
            (self.first[tier], self.from[tier]) = if lattice_row < 0 {
                (-FAR, 0)
            } else if lattice_row as usize >= lattice_rows.len() {
                (FAR, 0)
            } else {
                let at = lattice_rows.at(view, lattice_row as usize, footprint);
                let at = (at - (i64::from(rect.y0) << SUBPIXEL_BITS)) as i32;
                let first = phases.first_at(at);
                (first, phases.begin((at & (SUBPIXELS - 1)) as usize) as i32 - first)
            };
        }
        // Each begins farther down than the one before, and ends so.
        let (first, len) = (&self.first, phases.len as i32);
        self.len = len;
        let (mut from, mut to) = (0, 0);
        for y in 0..EDGE {
            let row = y as i32;
            while from < tiers && first[from] + len <= row {
                from += 1;
            }
            to = to.max(from);
            while to < tiers && first[to] <= row {
                to += 1;
            }
            let begin = from.min(tiers - FOUR);
            let n = (to - begin).max(FOUR);
            self.reach[y] = [begin, n].map(|tier| tier as u8);
            self.more |= u64::from(n > FOUR) << y;
        }
    }

    /// Computes the weights of tiers, in these rows at least.
    #[inline(always)]
    fn know(&mut self, rows: u64) {
        let mut left = rows & !self.known;
        self.known |= rows;
        while left != 0 {
            let y = left.trailing_zeros() as usize;
            left &= left - 1;
            let Down { weights, spread, reach, len, first, from, by_row, .. } = self;
            let at = y as i32;
            by_row.set(y, reach[y % EDGE].map(usize::from), |tier| {
                let tier = tier % ROWS;
                let reaches = first[tier] <= at && at < first[tier] + *len;
                let weight = || weights[(from[tier] + at) as usize].of_rows(*spread);
                if reaches { weight() } else { W::default() }
            });
        }
    }

    /// Columns that the tiers were touched at that reach each row.
    #[inline(always)]
    fn touched(&self, tiers: usize, touched: &[u64; ROWS]) -> Rows {
        let mut four = [0; ROWS];
        for tier in 0..tiers - (FOUR - 1) {
            four[tier] = touched[tier..tier + FOUR].iter().fold(0, |all, columns| all | columns);
        }
        let mut rows = [0; EDGE];
        for (row, [begin, _]) in rows.iter_mut().zip(&self.reach) {
            *row = four[usize::from(*begin) % ROWS];
        }
        let mut more = self.more;
        while more != 0 {
            let y = more.trailing_zeros() as usize;
            more &= more - 1;
            let [begin, n] = self.reach[y].map(usize::from);
            rows[y] = touched[begin..begin + n].iter().fold(0, |all, columns| all | columns);
        }
        rows
    }
}

/// The open sheets of a part, in tiers.
pub struct SharedRowsSheets<'a, S: Recorded, const N: usize> {
    pub(crate) simd: Simd,
    pub(crate) tiers: Tiers<'a, S, N>,
    closes: &'a mut Closes<S>,
    /// Sums of pixels that close.
    folded: &'a mut Folded<S>,
    part: &'a Part<'a>,
    lattice_rows: &'a LatticeRows,
    /// By slot and tier: columns of the part that something was added to; and whether there are
    /// any.
    touched: [[u64; ROWS]; N],
    any: [bool; N],
    /// By slot, or one for all sheets.
    downs: [Down<'a, S::Weight>; N],
    pub(crate) hull: Hull,
}

impl<'a, S: Tiered, const N: usize> SharedRowsSheets<'a, S, N> {
    /// In memory of `store`, with tiers of this shape.
    pub(crate) fn new(
        simd: Simd,
        store: &'a mut Store<S>,
        part: &'a Part<'a>,
        lattice_rows: &'a LatticeRows,
        shape: Shape,
    ) -> Self {
        let Store { closes, level, .. } = store;
        closes.begin();
        let (tiers, folded) = level.of(shape, N);
        SharedRowsSheets {
            simd,
            tiers: Tiers::new(tiers, shape),
            closes,
            folded,
            part,
            lattice_rows,
            touched: [[0; ROWS]; N],
            any: [false; N],
            downs: std::array::from_fn(|_| Down::default()),
            hull: Hull::default(),
        }
    }

    /// Notes that voxels that begin at sheet `k` add to these columns, tier by tier, in `most`
    /// sheets.
    #[inline(always)]
    fn touch_all(&mut self, k: i32, most: usize, columns: &[u64; ROWS]) {
        let rows = self.tiers.shape().rows;
        for sheet in 0..most {
            let slot = slot::<N>(k + sheet as i32);
            self.any[slot] = true;
            let touched = &mut self.touched[slot];
            for (touched, columns) in touched.iter_mut().zip(columns).take(rows) {
                *touched |= columns;
            }
        }
    }

    /// Notes what the [hull](SharedRowsSheets::hull) was [touched](Hull::touch) at, in all of its
    /// sheets.
    #[inline(always)]
    pub(crate) fn touch_hull(&mut self) {
        let SharedRowsSheets { hull, tiers, touched, any, .. } = self;
        let rows = tiers.shape().rows;
        for (sheet, base) in hull.bases.iter().enumerate().take(hull.sheets) {
            let slot = slot::<N>(hull.k + sheet as i32);
            any[slot] = true;
            let touched = &mut touched[slot][..rows];
            let from = base.abs_diff(hull.base) as usize;
            for (touched, columns) in touched.iter_mut().zip(&hull.touched[from..]) {
                *touched |= columns;
            }
            // What lies beyond a sheet's tiers was added to the outermost.
            touched[0] |= hull.touched[..from].iter().fold(0, |all, columns| all | columns);
            let beyond = &hull.touched[from + rows..hull.n];
            touched[rows - 1] |= beyond.iter().fold(0, |all, columns| all | columns);
        }
        hull.touched[..hull.n].fill(0);
    }

    /// Where the tiers of sheet `k` lie is known from here on; says where that stands.
    #[inline(always)]
    fn down(&mut self, k: i32) -> usize {
        let part: &'a Part<'a> = self.part;
        let footprints = &part.frame.footprints;
        let parallel = matches!(part.frame.view.projection, Projection::Ortho { .. });
        // Behind the last sheet that anything reaches there is nothing, wherever it were.
        let k = if parallel { 0 } else { k.min(footprints.last()) };
        let which = slot::<N>(k);
        if self.downs[which].k != k {
            let footprint: Footprint<'a> = footprints.at(k).expect("no sheet is clipped");
            let weights = S::across(&footprint, 1).expect("a table");
            let rows = self.tiers.shape().rows;
            self.downs[which].fill(k, part, self.lattice_rows, (&footprint, weights), rows);
        }
        which
    }
}

/// Open columns where lattice rows reach in the sheets from one on, and columns that something was
/// added to.
pub(crate) struct Hull {
    /// The first of the sheets, how many there are, and the lattice row of each one's first tier.
    k: i32,
    sheets: usize,
    pub(crate) bases: [i32; MOST],
    /// Of `n` lattice rows from `base` on: columns that are open in any row that it reaches, and
    /// columns that were added to.
    base: i32,
    n: usize,
    open: [u64; 2 * ROWS],
    touched: [u64; 2 * ROWS],
}

impl Default for Hull {
    fn default() -> Self {
        Hull {
            k: i32::MIN,
            sheets: 0,
            bases: [0; MOST],
            base: 0,
            n: 1,
            open: [0; 2 * ROWS],
            touched: [0; 2 * ROWS],
        }
    }
}

impl Hull {
    /// A lattice row's place; that of the outermost, which do not reach the part, for those beyond.
    #[inline(always)]
    fn place(&self, lattice_row: i32) -> usize {
        (lattice_row - self.base).clamp(0, self.n as i32 - 1) as usize % (2 * ROWS)
    }

    /// Columns that are open in any row that a lattice row reaches.
    #[inline(always)]
    pub(crate) fn open(&self, lattice_row: i32) -> u64 {
        self.open[self.place(lattice_row)]
    }

    /// Notes that something is added to columns of a lattice row.
    #[inline(always)]
    pub(crate) fn touch(&mut self, lattice_row: i32, columns: u64) {
        self.touched[self.place(lattice_row)] |= columns;
    }
}

/// Answers which columns of a part are open in any row of a run of rows.
pub struct AnyOpen {
    /// Of the `i`th power of two of rows, from each on.
    rows: [Rows; AnyOpen::POWERS],
}

impl AnyOpen {
    const POWERS: usize = EDGE.ilog2() as usize + 1;

    /// Prepares answers for runs of at most `most` rows; `open` has a bit for each open pixel.
    #[inline(always)]
    pub fn new(open: &Rows, most: usize) -> AnyOpen {
        let mut rows = [[0; EDGE]; AnyOpen::POWERS];
        rows[0] = *open;
        for power in 1..=most.clamp(1, EDGE).ilog2() as usize {
            let step = 1 << (power - 1);
            let [from, to] = rows.get_disjoint_mut([power - 1, power]).expect("two of them");
            for (to, (a, b)) in to.iter_mut().zip(from.iter().zip(&from[step..])) {
                *to = a | b;
            }
        }
        AnyOpen { rows }
    }

    /// Returns the columns, a bit each, that are open in any row from `begin` up to but without
    /// `end`; rows outside the part are left out.
    #[inline(always)]
    pub fn of(&self, begin: i32, end: i32) -> u64 {
        let [begin, end] = [begin.max(0), end.min(PART)];
        if begin >= end {
            return 0;
        }
        let power = (end - begin).ilog2() as usize % AnyOpen::POWERS;
        let rows = &self.rows[power];
        rows[begin as usize % EDGE] | rows[(end as usize - (1 << power)) % EDGE]
    }
}

impl<S: Tiered, const N: usize> SharedRowsSheets<'_, S, N> {
    /// Returns the open pixels (without a mask all) that lattice rows reach in `most` sheets from
    /// `k` on; `most` is at most the number of slots, `N`.
    ///
    /// Perspective's windows are below 40 pixels, so a voxel's sections lie less than 20 aside of
    /// its centre. Thus its sheets' first tiers lie less than 2 * 20 /
    /// [`crate::primitives::lattice_rows`]' least distance apart, 54 lattice rows, and a table of
    /// twice the rows of a sheet holds all.
    #[inline(always)]
    pub(crate) fn hull(&mut self, k: i32, most: usize, open: Option<&OpenMask>) -> &Hull {
        if self.hull.k == k {
            return &self.hull;
        }
        let mut which = [0; N];
        for (j, which) in which.iter_mut().enumerate() {
            *which = self.down(k + j.min(most - 1) as i32);
        }
        let SharedRowsSheets { hull, downs, tiers, .. } = self;
        let rows = tiers.shape().rows;
        let (mut first, mut last) = (i32::MAX, i32::MIN);
        for (to, &which) in hull.bases.iter_mut().zip(&which) {
            *to = downs[which].base;
            (first, last) = (first.min(*to), last.max(*to));
        }
        hull.sheets = most.min(N);
        (hull.k, hull.base, hull.n) = (k, first, last.abs_diff(first) as usize + rows);
        let mut reach = [[i32::MAX; 2 * ROWS], [i32::MIN; 2 * ROWS]];
        let [lo, hi] = &mut reach;
        for &which in &which[..hull.sheets] {
            let Down { base, first: of, len, .. } = &downs[which];
            // A lattice row beyond a sheet's tiers does not reach the part in it.
            let begin = base.abs_diff(first) as usize;
            let inside = begin..begin + rows;
            for ((lo, hi), of) in lo[inside.clone()].iter_mut().zip(&mut hi[inside]).zip(of) {
                (*lo, *hi) = ((*lo).min(*of), (*hi).max(of + len));
            }
        }
        let mut high = 1;
        for (lo, hi) in lo[..hull.n].iter().zip(&hi[..hull.n]) {
            high = high.max((*hi).min(PART).saturating_sub((*lo).max(0)));
        }
        let rows = open.map_or([u64::MAX; EDGE], |open| *open.rows());
        let any = AnyOpen::new(&rows, high as usize);
        for (i, open) in hull.open[..hull.n].iter_mut().enumerate() {
            *open = any.of(lo[i], hi[i]);
        }
        hull
    }
}

impl<S: Tiered, const N: usize> Open<S> for SharedRowsSheets<'_, S, N> {
    #[inline(always)]
    fn before(&mut self) -> (&mut [S::Pixel], &mut Rows) {
        self.closes.before()
    }

    #[inline(always)]
    fn begin(&mut self, _: i32) {}

    #[inline(always)]
    fn close(&mut self, k: i32, part: &Part<'_>, open: &mut OpenMask, pixels: &mut Pixels) -> bool {
        let slots = [slot::<N>(k), slot::<N>(k + 1)];
        if !self.any[slots[0]] {
            *self.closes.before().1 = [0; EDGE];
            return false;
        }
        let [here, behind] = [self.down(k), self.down(k + 1)];
        let SharedRowsSheets { simd, tiers, folded, closes, downs, touched, .. } = self;
        let (simd, rows) = (*simd, tiers.shape().rows);
        let (mut some, mut any) = (downs[here].touched(rows, &touched[slots[0]]), 0);
        for (y, some) in some.iter_mut().enumerate() {
            *some &= open.row(y);
            any |= u64::from(*some != 0) << y;
        }
        downs[here].know(any);
        downs[behind].know(any);
        let (before, was) = closes.before();
        let by_row = [here, behind].map(|which| &downs[which].by_row);
        let (mut rows, mut shut) = (0, false);
        while rows < EDGE {
            let (before, was) = (&mut *before, &mut *was);
            let ends = Ends { open: &some, slots, by_row, before, was, pixels: &pixels.all };
            rows = S::fold(simd, tiers, ends, rows, folded);
            shut |= close_folded::<S>(simd, (*folded, k), part, open, pixels);
        }
        self.clear(slots[0]);
        shut
    }

    #[inline(always)]
    fn empty(&mut self, _: i32) {
        for slot in 0..N {
            self.clear(slot);
        }
    }
}

impl<S: Tiered, const N: usize> SharedRowsSheets<'_, S, N> {
    /// Empties a sheet.
    #[inline(always)]
    fn clear(&mut self, slot: usize) {
        if !std::mem::take(&mut self.any[slot]) {
            return;
        }
        let rows = self.tiers.shape().rows;
        for (row, columns) in self.touched[slot][..rows].iter_mut().enumerate() {
            if *columns != 0 {
                self.tiers.empty(slot, row, std::mem::take(columns));
            }
        }
    }
}

/// Work that draws one part of an orthographic view with a level camera into row records; it is
/// compiled once for each instruction set.
pub struct RenderSharedRows<'a, S: Recorded, const N: usize> {
    pub(crate) part: Part<'a>,
    pub(crate) view: SharedRowsView<'a>,
    pub(crate) store: &'a mut Store<S>,
    pub(crate) waiting: &'a mut Waiting,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

/// Constants for drawing parts of an orthographic view with a level camera.
#[derive(Clone, Copy)]
pub(crate) struct SharedRowsView<'a> {
    flat: &'a Flat,
    lattice_rows: &'a LatticeRows,
}

/// Returns what drawing parts of `frame` here takes, if they may be drawn here.
pub(crate) fn accepts(frame: &Frame) -> Option<SharedRowsView<'_>> {
    Some(SharedRowsView {
        flat: ortho::accepts(frame)?,
        lattice_rows: frame.lattice_rows.as_ref()?,
    })
}

impl<S: Tiered, const N: usize> Work for RenderSharedRows<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderSharedRows {
            part,
            view: SharedRowsView { flat, lattice_rows },
            store,
            waiting,
            pixels,
            io,
        } = self;
        let frame = part.frame;
        let footprint = frame.footprints.at(0).expect("a flat view's sheets are all drawn");
        let phases = footprint.phases(0).expect("a flat view's footprints have tables");
        let across = S::across(&footprint, 0).expect("as phases are there");
        let across = Table { weights: across, len: phases.len };
        let deep = Table { weights: S::deep(&frame.sections), len: frame.sections.most() };
        let shape = Shape::new::<S>(lattice_rows.rows(PART, footprint.scale), phases.len);
        // Where the lattice row of the first tier lies, or would.
        let apart = lattice_rows.subpixels(footprint.scale);
        let first = lattice_rows.base(&frame.view, &part.rect, footprint.scale);
        let first =
            f64::from(first) - lattice_rows.of_row(&frame.view, part.rect.y0, footprint.scale);
        let tier_of = TierOf {
            base: libm::floor(first * apart + 0.5) as i32,
            per: libm::floor(f64::from(1 << TIER_BITS) / apart + 0.5) as i32,
        };
        let Waiting { queues, tossing, batch } = waiting;
        let weights = Weights { across, deep };
        let columns = [0; ROWS];
        let stage = LevelStage {
            part: &part,
            simd,
            flat,
            phases,
            shape,
            tier_of,
            weights,
            columns,
            tossing,
            batch,
        };
        let sheets = SharedRowsSheets::<S, N>::new(simd, store, &part, lattice_rows, shape);
        walk(&part, stage, sheets, queues, pixels, io);
    }
}

struct LevelStage<'a, S: Recorded> {
    part: &'a Part<'a>,
    simd: Simd,
    flat: &'a Flat,
    /// Layout of the weights across.
    phases: Phases,
    shape: Shape,
    tier_of: TierOf,
    weights: Weights<'a, S>,
    /// By tier, columns that voxels of a bucket add to.
    columns: [u64; ROWS],
    tossing: &'a mut Tossing,
    batch: &'a mut Batch,
}

impl<S: Tiered, const N: usize> Stage<SharedRowsSheets<'_, S, N>> for LevelStage<'_, S> {
    type Voxel = Splat;

    #[inline(always)]
    fn reach(&self) -> [i32; 2] {
        self.flat.reach
    }

    #[inline(always)]
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<Splat>,
        counters: &mut Counters,
    ) {
        let asked = (which, open, queues, counters);
        let packing = Packing::Tier(&self.phases, self.shape, &self.tier_of);
        toss(self.part, self.simd, self.flat, packing, self.tossing, asked);
    }

    #[inline(always)]
    fn splat(
        &mut self,
        due: &Due<'_, Splat>,
        k: i32,
        sheets: &mut SharedRowsSheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let LevelStage { part, shape, weights, columns, batch, .. } = self;
        let Weights { across, deep } = &*weights;
        let mut payloads = [S::Payload::default(); BATCH];
        columns[..shape.rows].fill(0);
        for some in due.chunks(BATCH) {
            let note = |v: &Splat| {
                let [place, row] = v.first();
                columns[row % ROWS] |= shape.columns(place as u32, across.len);
            };
            let asked = (sheets.simd, *part, open);
            let n = batch.light::<S>(asked, (&some, k), counters, note, &mut payloads);
            let (voxels, payloads) = (&batch.voxels[..n], &payloads[..n]);
            match some {
                Chunk::Here(_) => {
                    let (voxels, tiers) = ((voxels, payloads), &mut sheets.tiers);
                    S::add_flat(sheets.simd, tiers, voxels, slot::<N>(k), weights);
                }
                Chunk::Before(_) => {
                    for ((v, gone), &payload) in voxels.iter().zip(&batch.gone).zip(payloads) {
                        let [place, row] = v.first();
                        let wx = across.row((v.rows & 0xffff) as usize);
                        let z = &deep.row(v.phase() as usize * deep.len)[*gone as usize..];
                        for (i, &wz) in z.iter().enumerate() {
                            let tier = (slot::<N>(k + i as i32), row);
                            sheets.tiers.add(tier, (place, wx), &S::cut(payload, wz));
                        }
                    }
                }
            }
        }
        sheets.touch_all(k, deep.len, columns);
    }
}
