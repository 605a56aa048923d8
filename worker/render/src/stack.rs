//! The open sheets of a part in records, and the walk through them, front to back.
//!
//! What differs between views is how voxels get there: [`crate::flat`] and [`crate::deep`] toss and
//! splat; this room closes. Rows of strips of eight pixels that something was added to are known by
//! a bit each; a sheet that closes looks at those alone, four strips at a time.

use crate::mask::OpenMask;
use crate::sheet::Row;
use crate::splat::Simd;
use crate::splat::close::close_rows;
use crate::splat::records::{Line, Record, Recorded, STRIDE, STRIP, Strip};
use crate::tile::{Io, PART, Part, Pixels, keep_last};
use slabcast_common::message::Counters;
use slabcast_common::view::Projection;

pub(crate) const EDGE: usize = PART as usize;
/// Strips of a row.
const STRIPS: usize = EDGE / STRIP;

/// Memory for sums of one kind.
pub(crate) struct Store<S: Recorded> {
    /// Records of any number of sheets; nothing in them between parts.
    records: Vec<Line>,
    /// Sums of the sheet before, where it was touched.
    before: Vec<S::Pixel>,
}

impl<S: Recorded> Default for Store<S> {
    fn default() -> Self {
        Store { records: Vec::new(), before: Vec::new() }
    }
}

/// Voxels that wait.
pub(crate) struct Queues<V> {
    pub(crate) buckets: Vec<Vec<V>>,
    /// Voxels that begin before the slab, and where.
    pub(crate) carried: Vec<(V, i32)>,
}

impl<V> Default for Queues<V> {
    fn default() -> Self {
        Queues { buckets: Vec::new(), carried: Vec::new() }
    }
}

/// How voxels of one kind of view get into sheets.
pub(crate) trait Stage<S: Recorded, const N: usize> {
    /// A voxel waiting in the bucket of its first sheet.
    type Voxel: Copy;

    /// Pixels that a footprint reaches at most from the one that holds its centre.
    fn reach(&self) -> i32;
    /// Tests brick `which` of the part, then its voxels, and tosses what is left into buckets.
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<Self::Voxel>,
        counters: &mut Counters,
    );
    /// Shades the voxels that begin at sheet `k` and adds them to their sheets.
    fn splat(
        &mut self,
        bucket: &[Self::Voxel],
        k: i32,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    );
    /// Adds voxels that begin before the slab, with their first sheets, to those of their sheets that
    /// are left.
    fn splat_carried(
        &mut self,
        carried: &[(Self::Voxel, i32)],
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    );
}

/// Walks through the sheets of `part`'s slab.
#[inline(always)]
pub(crate) fn walk<S: Recorded, const N: usize, T: Stage<S, N>>(
    part: &Part<'_>,
    mut stage: T,
    (simd, store): (Simd, &mut Store<S>),
    queues: &mut Queues<T::Voxel>,
    pixels: &mut Pixels,
    (out, counters): Io<'_>,
) {
    let mut sheets = Sheets::<S, N>::new(simd, store, part.frame.sections.most());
    let slab = part.slab;
    let mut open = part.begin(pixels, out);
    if let Some(last) = &out.last {
        part.each_pixel(|x, y, tile| {
            sheets.before[y * EDGE + x] = S::from_raw(last[tile]);
        });
        sheets.was = [u64::MAX; STRIPS];
    }
    if queues.buckets.len() < slab.len() as usize {
        queues.buckets.resize_with(slab.len() as usize, Vec::new);
    }
    open.grow(stage.reach());
    let mut any_open = open.count() > 0;
    let (mut next, mut k) = (0, slab.first);
    let mut stopped = false;
    while k < slab.end && any_open {
        if !part.is_supplied(k, &open, counters) {
            stopped = true;
            break;
        }
        while part.begins(next, k) {
            stage.toss(next, &open, queues, counters);
            next += 1;
        }
        sheets.added[slot::<N>(k)] = [0; STRIPS];
        if !queues.carried.is_empty() {
            stage.splat_carried(&queues.carried, &mut sheets, &open, counters);
            queues.carried.clear();
        }
        let bucket = &mut queues.buckets[(k - slab.first) as usize];
        stage.splat(bucket, k, &mut sheets, &open, counters);
        bucket.clear();
        if sheets.close(k, part, &mut open, pixels) {
            any_open = open.count() > 0;
            open.grow(stage.reach());
        }
        k += 1;
    }
    // Whatever the part did not come to is hidden, unless it goes on later.
    let hidden = u64::from(!stopped);
    counters.culled += hidden * part.voxels_from(next);
    queues.carried.clear();
    for bucket in &mut queues.buckets {
        counters.culled += hidden * bucket.len() as u64;
        bucket.clear();
    }
    part.end(pixels, out);
    if let Some(last) = keep_last(part, stopped, out) {
        // Nobody reads a shut pixel's sums; they may be anything, so they are none.
        part.each_pixel(|x, y, tile| {
            let touched = sheets.was[x / STRIP] >> y & open.row(y) >> x & 1 == 1;
            last[tile] = if touched { S::raw(&sheets.before[y * EDGE + x]) } else { [0; 4] };
        });
    }
    sheets.empty(k);
}

/// Rows of each strip that something was added to, one bit each.
type Rows = [u64; STRIPS];

/// The open sheets of a part.
pub(crate) struct Sheets<'a, S: Recorded, const N: usize> {
    pub(crate) simd: Simd,
    pub(crate) records: &'a mut [Record<S, N>],
    before: &'a mut [S::Pixel],
    /// By slot of their first sheet: rows that voxels touch.
    added: [Rows; N],
    /// Rows of `before` that may not be zero.
    was: Rows,
    /// Rows with records of shut pixels that are not zero.
    dead: Rows,
    /// Sheets that a voxel touches at most.
    most: usize,
}

#[inline(always)]
pub(crate) fn slot<const N: usize>(k: i32) -> usize {
    k as usize % N
}

impl<'a, S: Recorded, const N: usize> Sheets<'a, S, N> {
    fn new(simd: Simd, store: &'a mut Store<S>, most: usize) -> Self {
        let lines = STRIDE * EDGE * size_of::<Record<S, N>>() / size_of::<Line>();
        if store.records.len() < lines {
            store.records.resize(lines, Line::ZERO);
        }
        store.before.resize(EDGE * EDGE, S::Pixel::default());
        Sheets {
            simd,
            records: bytemuck::cast_slice_mut(&mut store.records[..lines]),
            before: &mut store.before,
            added: [[0; STRIPS]; N],
            was: [0; STRIPS],
            dead: [0; STRIPS],
            most,
        }
    }

    /// Notes that a voxel that begins at sheet `k` touches so many columns and rows from (x, y).
    #[inline(always)]
    pub(crate) fn touch(&mut self, k: i32, [x, y]: [usize; 2], [wide, high]: [usize; 2]) {
        let rows = (u64::MAX >> (64 - high)) << (y & 63);
        let added = &mut self.added[slot::<N>(k)];
        let (first, last) = (x / STRIP % STRIPS, (x + wide - 1) / STRIP % STRIPS);
        added[first] |= rows;
        added[last] |= rows;
        for strip in first + 1..last {
            added[strip] |= rows;
        }
    }

    /// Rows that voxels which begin at sheets `from` to `k` touch.
    fn touched(&self, from: i32, k: i32) -> Rows {
        let mut rows = [0; STRIPS];
        for first in from..=k {
            for (row, added) in rows.iter_mut().zip(self.added[slot::<N>(first)]) {
                *row |= added;
            }
        }
        rows
    }

    /// Closes sheet `k` where it was touched; whether pixels were shut.
    #[inline(always)]
    fn close(&mut self, k: i32, part: &Part<'_>, open: &mut OpenMask, pixels: &mut Pixels) -> bool {
        let touched = self.touched(k + 1 - self.most as i32, k);
        for strip in 0..STRIPS {
            // What the sheet before has where this one has nothing.
            let mut stale = self.was[strip] & !touched[strip];
            while stale != 0 {
                let y = stale.trailing_zeros() as usize;
                stale &= stale - 1;
                self.before[y * EDGE + strip * STRIP..][..STRIP].fill(S::Pixel::default());
            }
        }
        self.was = touched;
        let mut closing = Closing {
            simd: self.simd,
            k,
            part,
            open,
            pixels,
            rows: Default::default(),
            any_shut: false,
        };
        let mut pending = [(0, 0); 4];
        let mut some = 0;
        for strip in 0..STRIPS {
            let mut rows = touched[strip];
            while rows != 0 {
                let y = rows.trailing_zeros() as usize;
                rows &= rows - 1;
                if closing.open.row(y) >> (strip * STRIP) & 0xff == 0 {
                    // Nobody looks at these pixels again in this part.
                    self.dead[strip] |= 1 << y;
                    continue;
                }
                pending[some] = (strip, y);
                some += 1;
                if some == 4 {
                    let [a, b, c, d] = pending;
                    self.take([a, b], &mut closing, 0);
                    self.take([c, d], &mut closing, 1);
                    closing.close::<S, 2>([[a, b], [c, d]]);
                    some = 0;
                }
            }
        }
        for two in pending[..some].chunks(2) {
            // One alone is its own neighbour.
            let two = [two[0], two[two.len() - 1]];
            self.take(two, &mut closing, 0);
            closing.close::<S, 1>([two]);
        }
        closing.any_shut
    }

    #[inline(always)]
    fn take(&mut self, strips: [(usize, usize); 2], to: &mut Closing<'_>, row: usize) {
        let strips = strips.map(|(strip, y)| Strip {
            record: y * STRIDE + strip * STRIP,
            pixel: y * EDGE + strip * STRIP,
        });
        let sums = (&mut *self.records, &mut *self.before);
        S::take(self.simd, sums, &to.pixels.a, strips, slot::<N>(to.k), &mut to.rows[row]);
    }

    /// Leaves nothing behind, where sheets before `k` are closed.
    fn empty(&mut self, k: i32) {
        let left = self.touched(k + 1 - self.most as i32, k - 1);
        for strip in 0..STRIPS {
            for y in 0..EDGE {
                let at = strip * STRIP;
                if (left[strip] | self.dead[strip]) >> y & 1 == 1 {
                    self.records[y * STRIDE + at..][..STRIP].fill([S::Pixel::default(); N]);
                }
                if self.was[strip] >> y & 1 == 1 {
                    self.before[y * EDGE + at..][..STRIP].fill(S::Pixel::default());
                }
            }
        }
    }
}

/// A sheet that is being closed.
struct Closing<'a> {
    simd: Simd,
    k: i32,
    part: &'a Part<'a>,
    open: &'a mut OpenMask,
    pixels: &'a mut Pixels,
    rows: [Row; 2],
    any_shut: bool,
}

impl Closing<'_> {
    /// Composites strips, two a row, whose sums are in the first rows.
    #[inline(always)]
    fn close<S: Recorded, const ROWS: usize>(&mut self, strips: [[(usize, usize); 2]; ROWS]) {
        let Closing { simd, part, open, pixels, rows, .. } = self;
        let rows = rows.first_chunk_mut::<ROWS>().expect("two rows at most");
        let mut live = [0; ROWS];
        for (live, two) in live.iter_mut().zip(&strips) {
            for (half, &(strip, y)) in two.iter().enumerate() {
                *live |= ((open.row(y) >> (strip * STRIP) & 0xff) << (half * STRIP)) as u32;
            }
        }
        // Where rays are parallel, the row's secants stay 1.
        if let Projection::Persp { .. } = part.frame.view.projection {
            for (row, two) in rows.iter_mut().zip(&strips) {
                for (half, &(strip, y)) in two.iter().enumerate() {
                    let secants = &pixels.secants[y * EDGE + strip * STRIP..][..STRIP];
                    for (i, secant) in secants.iter().enumerate() {
                        let lane = half * STRIP + i;
                        (row.secant[lane], row.cosine[lane]) = (*secant, 1.0 / secant);
                    }
                }
            }
        }
        let shut = close_rows::<S, ROWS>(*simd, &part.frame.rule, rows, live);
        for ((row, two), shut) in rows.iter().zip(&strips).zip(shut) {
            // One alone is there twice.
            let halves = if two[0] == two[1] { 1 } else { 2 };
            for (half, &(strip, y)) in two[..halves].iter().enumerate() {
                pixels.put(y * EDGE + strip * STRIP, row, half * STRIP);
                let shut = u64::from(shut >> (half * STRIP) & 0xff);
                open.close(y, shut << (strip * STRIP));
                self.any_shut |= shut != 0;
            }
        }
    }
}
