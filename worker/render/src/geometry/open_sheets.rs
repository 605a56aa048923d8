//! The open sheets of a part in pixel records, and the walk through them, front to back.
//!
//! Views differ in how voxels get into the sheets ([`Stage`]: toss and splat); the walk and the
//! compositing of sheets are here. Touched pixels are known by a bit each. A sheet that closes
//! reads only the open ones among them, sixteen at a time from wherever they lie.

use crate::kernels::composite::{LANES, Row};
use crate::kernels::pixel_records::{Line, Record, Recorded, STRIDE};
use crate::kernels::touched::{Places, Some16, column_and_row, put, take};
use crate::kernels::{Simd, Work};
use crate::part::{Io, Part, Pixels, keep_last};
use crate::primitives::sizes::PART;
use crate::visibility::open_mask::{OpenMask, doubling};
use slabcast_common::message::Counters;
use slabcast_common::view::Projection;

/// Edge of a part in pixels, as an index.
pub const EDGE: usize = PART as usize;

/// Memory of a render thread for the sums of one number type: records, and sums of closed sheets.
pub struct Store<S: Recorded> {
    /// Records of any number of sheets; nothing in them between parts.
    lines: Vec<Line>,
    closes: Closes<S>,
}

/// Memory for sheets that close: the sums of the sheet in front and the places of closing pixels.
struct Closes<S: Recorded> {
    /// Sums of the sheet before, where it was touched; elsewhere anything.
    before: Vec<[S; 4]>,
    /// Pixels of `before` that the sheet in front has sums of, a bit each.
    was: Rows,
    places: Places,
    sifting: Sifting,
}

impl<S: Recorded> Default for Store<S> {
    fn default() -> Self {
        Store { lines: Vec::new(), closes: Closes::default() }
    }
}

impl<S: Recorded> Store<S> {
    /// Returns whether no sums are left of any part.
    pub fn is_empty(&self) -> bool {
        let records: &[u64] = bytemuck::cast_slice(&self.lines);
        records.iter().all(|sums| *sums == 0)
    }
}

impl<S: Recorded> Default for Closes<S> {
    fn default() -> Self {
        Closes {
            before: Vec::new(),
            was: [0; EDGE],
            places: Places::default(),
            sifting: Sifting::default(),
        }
    }
}

/// Voxels of one bucket: the first `n` items; what is behind them is there from before, so that a
/// voxel is added by one store.
pub struct Bucket<V> {
    items: Vec<V>,
    n: usize,
}

impl<V> Default for Bucket<V> {
    fn default() -> Self {
        Bucket { items: Vec::new(), n: 0 }
    }
}

impl<V: Copy> Bucket<V> {
    #[inline(always)]
    pub(crate) fn push(&mut self, voxel: &V) {
        let Bucket { items, n } = self;
        match items.get_mut(*n) {
            Some(to) => *to = *voxel,
            None => items.push(*voxel),
        }
        *n += 1;
    }

    #[inline(always)]
    fn voxels(&self) -> &[V] {
        &self.items[..self.n]
    }

    fn is_bare(&self) -> bool {
        self.items.capacity() == 0
    }
}

/// Voxels of a part that wait for the sheets at which they begin.
///
/// A brick reaches over some twenty sheets, a slab has a thousand and more. So buckets of sheets
/// that are done pass their memory on to those in front: a bucket of each sheet would keep as much
/// as its fullest part needed, 60 to 130 MiB a thread in a CT's soft tissue.
pub struct Queues<V> {
    /// Waiting voxels by their first sheet, counted from the slab's first.
    pub buckets: Vec<Bucket<V>>,
    /// Voxels that begin before the slab, and where.
    pub(crate) carried: Vec<(V, i32)>,
    /// All buckets before this one that are not done have memory.
    bare: usize,
    /// Voxels of the fullest bucket so far. All memory holds as many in the end, whichever bucket
    /// has it, so that drawing the same again allocates nothing.
    fullest: usize,
}

impl<V> Default for Queues<V> {
    fn default() -> Self {
        Queues { buckets: Vec::new(), carried: Vec::new(), bare: 0, fullest: 0 }
    }
}

impl<V: Copy> Queues<V> {
    /// Empties bucket `at`, whose sheet is done, and passes its memory on to the next bucket that
    /// has none.
    #[inline(always)]
    fn pass_on(&mut self, at: usize) {
        let bucket = &mut self.buckets[at];
        self.fullest = self.fullest.max(bucket.n);
        bucket.n = 0;
        if bucket.is_bare() {
            return;
        }
        let items = std::mem::take(&mut bucket.items);
        self.bare = self.bare.max(at + 1);
        while self.buckets.get(self.bare).is_some_and(|b| !b.is_bare()) {
            self.bare += 1;
        }
        // Behind the last sheet nothing is needed.
        let to = if self.bare < self.buckets.len() { self.bare } else { at };
        self.buckets[to].items = items;
    }

    /// Empties all buckets and moves their memory to the first ones. Returns how many voxels were
    /// in them.
    fn end(&mut self) -> u64 {
        let (mut voxels, mut filled) = (0, 0);
        for at in 0..self.buckets.len() {
            let bucket = &mut self.buckets[at];
            self.fullest = self.fullest.max(bucket.n);
            voxels += std::mem::take(&mut bucket.n) as u64;
            if !bucket.is_bare() {
                self.buckets.swap(filled, at);
                filled += 1;
            }
        }
        for bucket in &mut self.buckets[..filled] {
            let more = self.fullest.saturating_sub(bucket.items.len());
            bucket.items.reserve(more);
        }
        self.bare = filled;
        self.carried.clear();
        voxels
    }
}

/// Stage that brings voxels of one kind of view into sheets.
pub trait Stage<S: Recorded, const N: usize> {
    /// A voxel waiting in the bucket of its first sheet.
    type Voxel: Copy;

    /// Pixels along x and y that a footprint reaches at most from the one that holds its centre.
    fn reach(&self) -> [i32; 2];
    /// Tests brick `which` of the part, then its voxels, and tosses what is left into buckets.
    fn toss(
        &mut self,
        which: usize,
        open: &OpenMask,
        queues: &mut Queues<Self::Voxel>,
        counters: &mut Counters,
    );
    /// Shades voxels that are due at sheet `k`, and adds them to those of their sheets that are
    /// left.
    fn splat(
        &mut self,
        due: &Due<'_, Self::Voxel>,
        k: i32,
        sheets: &mut Sheets<'_, S, N>,
        open: &OpenMask,
        counters: &mut Counters,
    );
}

/// Voxels that are drawn from some sheet on: those that begin there, and those that began before
/// the slab, with their first sheets.
pub struct Due<'a, V> {
    here: &'a [V],
    before: &'a [(V, i32)],
}

/// Some of the voxels that are due at a sheet, all of one kind: they begin there, or before the
/// slab.
pub enum Chunk<'a, V> {
    Here(&'a [V]),
    Before(&'a [(V, i32)]),
}

impl<'a, V> Due<'a, V> {
    #[inline(always)]
    pub(crate) fn is_empty(&self) -> bool {
        self.here.is_empty() && self.before.is_empty()
    }

    /// At most `n` at a time: one loop over both, since what draws them is a lot of code.
    #[inline(always)]
    pub(crate) fn chunks(&self, n: usize) -> impl Iterator<Item = Chunk<'a, V>> + use<'a, V> {
        let before = self.before.chunks(n).map(Chunk::Before);
        before.chain(self.here.chunks(n).map(Chunk::Here))
    }
}

impl<V> Chunk<'_, V> {
    /// Returns the number of voxels.
    #[inline(always)]
    pub(crate) fn len(&self) -> usize {
        match self {
            Chunk::Here(some) => some.len(),
            Chunk::Before(some) => some.len(),
        }
    }

    /// Has each taken over as the `n`th of those that are kept so far, with as many of its sheets
    /// gone at sheet `k`, unless it is told not to keep it; says how many are kept.
    #[inline(always)]
    pub(crate) fn keep(&self, k: i32, mut take: impl FnMut(usize, &V, i32) -> bool) -> usize {
        let mut n = 0;
        match self {
            Chunk::Here(some) => {
                for v in *some {
                    n += usize::from(take(n, v, 0));
                }
            }
            Chunk::Before(some) => {
                for (v, first) in *some {
                    n += usize::from(take(n, v, k - first));
                }
            }
        }
        n
    }
}

/// Walks through the sheets of `part`'s slab.
#[inline(always)]
pub fn walk<S: Recorded, const N: usize, T: Stage<S, N>>(
    part: &Part<'_>,
    mut stage: T,
    mut sheets: Sheets<'_, S, N>,
    queues: &mut Queues<T::Voxel>,
    pixels: &mut Pixels,
    (out, counters): Io<'_>,
) {
    let slab = part.slab;
    let mut open = part.begin(pixels, out);
    if let Some(last) = &out.last {
        let Closes { before, was, .. } = &mut *sheets.closes;
        part.each_pixel(|x, y, tile| {
            before[y * STRIDE + x] = last[tile].map(S::from_bits);
        });
        *was = [u64::MAX; EDGE];
    }
    if queues.buckets.len() < slab.len() as usize {
        queues.buckets.resize_with(slab.len() as usize, Bucket::default);
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
        sheets.begin(k);
        let bucket = &queues.buckets[(k - slab.first) as usize];
        let due = Due { here: bucket.voxels(), before: &queues.carried };
        if !due.is_empty() {
            stage.splat(&due, k, &mut sheets, &open, counters);
        }
        queues.pass_on((k - slab.first) as usize);
        queues.carried.clear();
        if sheets.close(k, part, &mut open, pixels) {
            any_open = open.count() > 0;
            open.grow(stage.reach());
        }
        k += 1;
    }
    // Whatever the part did not come to is hidden, unless it goes on later.
    let hidden = u64::from(!stopped);
    counters.culled += hidden * (part.voxels_from(next) + queues.end());
    part.end(pixels, out);
    if let Some(last) = keep_last(part, stopped, out) {
        let Closes { before, was, .. } = &*sheets.closes;
        // The sums of a shut pixel are never read. They are handed on as zeros.
        part.each_pixel(|x, y, tile| {
            let touched = (was[y] & open.row(y)) >> x & 1 == 1;
            last[tile] = if touched { before[y * STRIDE + x].map(S::bits) } else { [0; 4] };
        });
    }
    sheets.empty(k);
}

/// Pixels of a part, one bit each: bit x of word y is column x of row y.
pub type Rows = [u64; EDGE];

/// When to look for touched pixels that nothing reached. In 16-bit sums a footprint's corners and
/// much of its outermost sections round to nothing: of mri256 a quarter of what is touched, of
/// aneurism more than a third; of fog a thirtieth, and in 32-bit sums half as much.
#[derive(Default)]
struct Sifting {
    /// Sheets until it is looked at again whether it pays.
    rest: u32,
}

impl Sifting {
    /// Sifting pays from one dropped pixel in this many: it takes a tenth of what closing does, and
    /// a pixel by itself.
    const PAYS: usize = 5;

    /// Sheets that go by where it does not.
    const REST: u32 = 7;

    #[inline(always)]
    fn is_due(&mut self) -> bool {
        let due = self.rest == 0;
        self.rest = self.rest.saturating_sub(1);
        due
    }

    /// Notes that `none` of `n` pixels had nothing to composite; sifting rests if that is too few
    /// to pay.
    #[inline(always)]
    fn found(&mut self, none: usize, n: usize) {
        if none * Sifting::PAYS < n {
            self.rest = Sifting::REST;
        }
    }
}

impl<S: Recorded> Closes<S> {
    /// Begins a part.
    #[inline(always)]
    fn begin(&mut self) {
        self.before.resize(STRIDE * EDGE, [S::default(); 4]);
        self.was = [0; EDGE];
        self.sifting = Sifting::default();
    }

    /// Closes sheet `k`, which `records` hold, at the pixels of `closing`, of those that it
    /// was `touched` at; whether pixels were shut.
    #[inline(always)]
    fn close<const N: usize>(
        &mut self,
        simd: Simd,
        (records, k): (&mut [Record<S, N>], i32),
        (closing, touched): (&Rows, &Rows),
        part: &Part<'_>,
        open: &mut OpenMask,
        pixels: &mut Pixels,
    ) -> bool {
        let slot = slot::<N>(k);
        self.begin_sheet(closing, touched);
        let Closes { before, places, sifting, .. } = self;
        places.list(simd, closing);
        if sifting.is_due() {
            let n = places.len();
            places.sift::<S, N>(simd, (records, before), slot);
            sifting.found(n - places.len(), n);
        }
        let mut row = Row::default();
        let mut any_shut = false;
        for i in (0..places.len()).step_by(LANES) {
            let places = places.from(i);
            take::<S, N>(simd, (&mut *records, &mut *before), &pixels.all, places, slot, &mut row);
            // With parallel rays, the row's secants stay 1.
            if let Projection::Persp { .. } = part.frame.view.projection {
                for (lane, &at) in places.at().iter().enumerate() {
                    row.secant[lane] = pixels.secants[at as usize];
                    row.cosine[lane] = 1.0 / row.secant[lane];
                }
            }
            let mut shut = simd.run(Close { part, k, row: &mut row, places });
            let at = &places.at()[..places.len()];
            put(simd, &row, at, &mut pixels.all);
            if let Some(work) = &mut pixels.work {
                part.count_sheet(work, k, (&row, at), [u32::MAX, shut]);
            }
            any_shut |= shut != 0;
            while shut != 0 {
                let [x, y] = column_and_row(places.at()[shut.trailing_zeros() as usize % LANES]);
                open.close(y, 1 << x);
                shut &= shut - 1;
            }
        }
        any_shut
    }

    /// Clears the sums before a sheet where it closes and the sheet in front had nothing; notes
    /// where it was touched.
    #[inline(always)]
    fn begin_sheet(&mut self, closing: &Rows, touched: &Rows) {
        let Closes { before, was, .. } = self;
        for (y, (closing, was)) in closing.iter().zip(&*was).enumerate() {
            // Pixels at which this sheet has something and the one before had nothing.
            let mut fresh = closing & !was;
            while fresh != 0 {
                let x = fresh.trailing_zeros();
                let run = (fresh >> x).trailing_ones();
                before[y * STRIDE + x as usize..][..run as usize].fill([S::default(); 4]);
                // Adding carries through the run.
                fresh &= fresh.wrapping_add(1 << x);
            }
        }
        *was = *touched;
    }
}

/// Open sheets of a part whose sums are kept in one record a pixel.
pub struct Sheets<'a, S: Recorded, const N: usize> {
    pub(crate) simd: Simd,
    pub(crate) records: &'a mut [Record<S, N>],
    closes: &'a mut Closes<S>,
    /// By slot of their first sheet: pixels that voxels touch.
    added: [Rows; N],
    /// Shut pixels with records that may not be zero.
    dead: Rows,
    /// Sheets that a voxel touches at most.
    most: usize,
}

/// Returns the slot, 0 to N - 1, in which records of `N` sheets keep sheet `k`.
#[inline(always)]
pub fn slot<const N: usize>(k: i32) -> usize {
    k as usize % N
}

impl<S: Recorded, const N: usize> Sheets<'_, S, N> {
    /// From now on voxels begin at sheet `k`.
    #[inline(always)]
    fn begin(&mut self, k: i32) {
        self.added[slot::<N>(k)] = [0; EDGE];
    }

    /// Closes sheet `k` where it was touched; whether pixels were shut.
    #[inline(always)]
    fn close(&mut self, k: i32, part: &Part<'_>, open: &mut OpenMask, pixels: &mut Pixels) -> bool {
        let touched = self.touched(k + 1 - self.most as i32, k);
        let mut closing = touched;
        for (y, (closing, dead)) in closing.iter_mut().zip(&mut self.dead).enumerate() {
            // A shut pixel is not read again in this part.
            *dead |= *closing & !open.row(y);
            *closing &= open.row(y);
        }
        self.closes.close(
            self.simd,
            (&mut *self.records, k),
            (&closing, &touched),
            part,
            open,
            pixels,
        )
    }

    /// Leaves nothing behind, where sheets before `k` are closed.
    #[inline(always)]
    fn empty(&mut self, k: i32) {
        let left = self.touched(k + 1 - self.most as i32, k - 1);
        for (y, (left, dead)) in left.iter().zip(&self.dead).enumerate() {
            let some = left | dead;
            if some != 0 {
                let [from, to] = [some.trailing_zeros(), 64 - some.leading_zeros()];
                let [from, to] = [from, to].map(|x| y * STRIDE + x as usize);
                self.records[from..to].fill([[S::default(); 4]; N]);
            }
        }
    }
}

impl<'a, S: Recorded, const N: usize> Sheets<'a, S, N> {
    /// Takes `store` as memory, for voxels that touch at most `most` sheets.
    pub fn new(simd: Simd, store: &'a mut Store<S>, most: usize) -> Self {
        let Store { lines: all, closes, .. } = store;
        let lines = STRIDE * EDGE * size_of::<Record<S, N>>() / size_of::<Line>();
        if all.len() < lines {
            all.resize(lines, Line::ZERO);
        }
        closes.begin();
        Sheets {
            simd,
            records: bytemuck::cast_slice_mut(&mut all[..lines]),
            closes,
            added: [[0; EDGE]; N],
            dead: [0; EDGE],
            most,
        }
    }

    /// Notes the pixels that voxels touch which begin at sheet `k`: `wide` columns and `high` rows
    /// from each pixel whose bit is set in `corners`.
    #[inline(always)]
    pub fn touch_all(&mut self, k: i32, corners: &Rows, [wide, high]: [usize; 2]) {
        let added = &mut self.added[slot::<N>(k)];
        let mut grown = *corners;
        // Columns and rows double until so many are there, or the part ends.
        for done in doubling(wide) {
            for row in &mut grown {
                *row |= *row << done;
            }
        }
        for done in doubling(high) {
            let was = grown;
            for (row, was) in grown[done..].iter_mut().zip(&was) {
                *row |= was;
            }
        }
        for (added, grown) in added.iter_mut().zip(&grown) {
            *added |= grown;
        }
    }

    /// Notes that a voxel which begins at sheet `k` touches columns `x` and rows `y` of the part.
    #[inline(always)]
    pub(crate) fn touch(&mut self, k: i32, x: std::ops::Range<usize>, y: std::ops::Range<usize>) {
        let bits = (u64::MAX >> (EDGE - x.len())) << x.start;
        self.added[slot::<N>(k)][y].iter_mut().for_each(|row| *row |= bits);
    }

    /// Returns the pixels that voxels touch which begin at sheets `from` to `k`.
    #[inline(always)]
    pub fn touched(&self, from: i32, k: i32) -> Rows {
        let mut rows = [0; EDGE];
        for first in from..=k {
            for (row, added) in rows.iter_mut().zip(&self.added[slot::<N>(first)]) {
                *row |= added;
            }
        }
        rows
    }
}

/// Composites some pixels of sheet k, compiled by itself and not with all that calls it. Returns
/// those that are shut now.
struct Close<'a, 'b> {
    part: &'a Part<'a>,
    k: i32,
    row: &'a mut Row,
    places: Some16<'b>,
}

impl Work for Close<'_, '_> {
    type Out = u32;
    #[inline(always)]
    fn run(self, simd: Simd) -> u32 {
        let Close { part, k, row, places } = self;
        let live = (1 << places.len()) - 1;
        if !part.frame.is_field() {
            // Records have whole-number sums.
            return part.frame.rule.close_row::<i32>(row, live);
        }
        let mut pixels = [[0; 2]; LANES];
        for (pixel, &place) in pixels.iter_mut().zip(places.at()) {
            let [x, y] = column_and_row(place);
            *pixel = [part.rect.x0 + x as i32, part.rect.y0 + y as i32];
        }
        part.frame.close_field_row(simd, row, (&pixels, k), live)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Draws a part of `sheets` sheets whose voxels come five sheets before theirs, `each` a sheet.
    fn walk_through(queues: &mut Queues<u32>, sheets: usize, each: u32) {
        if queues.buckets.len() < sheets {
            queues.buckets.resize_with(sheets, Bucket::default);
        }
        for k in 0..sheets {
            let to = (k + 5).min(sheets - 1);
            (0..each).for_each(|v| queues.buckets[to].push(&v));
            if k >= 5 && k + 1 < sheets {
                assert_eq!(queues.buckets[k].voxels(), (0..each).collect::<Vec<_>>());
            }
            queues.pass_on(k);
        }
        assert_eq!(queues.end(), 0);
    }

    #[test]
    fn buckets_that_are_done_pass_their_memory_on() {
        let mut queues = Queues::default();
        walk_through(&mut queues, 900, 100);
        let with_memory = |q: &Queues<u32>| q.buckets.iter().filter(|b| !b.is_bare()).count();
        assert_eq!(with_memory(&queues), 6, "of 900");
        assert!(queues.buckets[..6].iter().all(|b| b.items.capacity() >= 100));
        walk_through(&mut queues, 900, 100);
        walk_through(&mut queues, 40, 300);
        assert_eq!(with_memory(&queues), 6);
    }

    #[test]
    fn voxels_of_a_part_that_ends_early_are_counted_and_gone() {
        let mut queues = Queues::default();
        queues.buckets.resize_with(50, Bucket::default);
        for at in [0, 7, 7, 40] {
            queues.buckets[at].push(&1);
        }
        queues.pass_on(0);
        assert_eq!(queues.end(), 3);
        assert!(queues.buckets.iter().all(|b| b.voxels().is_empty()));
    }
}
