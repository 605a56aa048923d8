//! Parts of any view in any kind of sums: the general path ([`crate::tile`] says what it does).
//!
//! Each section of a voxel has a footprint of its own, and sheets lie one after the other in
//! `Planes`. Voxels wait as brick and index, so that float sums can be sorted into their one
//! order.

mod planes;

use self::planes::{BLOCK, Planes, Window};
use crate::kernels::composite::{LANES, Row};
use crate::kernels::field::{FieldSum, Four, planes_of, weighted};
use crate::kernels::pixel_records::STRIDE;
use crate::kernels::touched::put;
use crate::kernels::{Accumulate, Simd, Weight, Work};
use crate::part::{Io, Part, Pixels, keep_last};
use crate::primitives::footprint::Footprint;
use crate::primitives::sizes::PART;
use crate::scene::Placed;
use crate::visibility::open_mask::OpenMask;
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::view::Projection;

/// A voxel waiting in the bucket of its first sheet.
#[derive(Clone, Copy, Default)]
pub struct Waiting {
    /// Index of the voxel's brick among the part's.
    brick: u32,
    /// Index of the voxel in its brick.
    voxel: u16,
    /// Position of the voxel.
    placed: Placed,
}

/// Memory that a render thread keeps from part to part.
#[derive(Default)]
pub struct GeneralScratch {
    pub(crate) kinds: Kinds,
    pub(crate) queues: Queues,
}

/// Memory for sums of every kind.
#[derive(Default)]
pub(crate) struct Kinds {
    pub(crate) shorts: Kind<i16>,
    pub(crate) longs: Kind<i32>,
    pub(crate) floats: Kind<f32>,
}

/// Memory of a render thread for the sums of one number type.
pub struct Kind<S: Accumulate> {
    planes: Planes<S>,
    /// For weights that are in no table.
    weights: [Vec<S::Weight>; 2],
}

impl<S: Accumulate> Default for Kind<S> {
    fn default() -> Self {
        Kind { planes: Planes::default(), weights: [Vec::new(), Vec::new()] }
    }
}

/// Voxels of a part that wait for the sheets at which they begin.
#[derive(Default)]
pub struct Queues {
    /// Waiting voxels by their first sheet, counted from the slab's first.
    pub buckets: Vec<Vec<Waiting>>,
    /// Number of buckets in use; later ones are empty. A part that stops often then doesn't look at
    /// the buckets of all sheets each time.
    pub filled: usize,
    carried: Vec<Waiting>,
    /// All buckets before this one that are not done have memory.
    bare: usize,
    /// Voxels of the fullest bucket so far: all memory holds as many in the end.
    fullest: usize,
}

impl Queues {
    /// Empties the buckets of an earlier part and makes room for `sheets` sheets.
    #[inline(always)]
    pub fn begin(&mut self, sheets: usize) {
        if self.buckets.len() < sheets {
            self.buckets.resize_with(sheets, Vec::new);
        }
        let filled = std::mem::take(&mut self.filled);
        for bucket in &mut self.buckets[..filled] {
            self.fullest = self.fullest.max(bucket.len());
            bucket.clear();
        }
        // Memory of an earlier part is where its walk ended; it is needed in front.
        let mut with_memory = 0;
        for at in 0..self.buckets.len() {
            if self.buckets[at].capacity() > 0 {
                self.buckets.swap(with_memory, at);
                with_memory += 1;
            }
        }
        self.buckets[..with_memory].iter_mut().for_each(|b| b.reserve(self.fullest));
        self.bare = with_memory;
        self.carried.clear();
    }

    /// Puts a voxel into the bucket of its first sheet, `sheet`, counted from the slab's first.
    #[inline(always)]
    pub fn put(&mut self, sheet: usize, voxel: Waiting) {
        self.buckets[sheet].push(voxel);
        self.filled = self.filled.max(sheet + 1);
    }

    /// Passes the memory of bucket `at`, whose sheet is done, on to the next bucket that has none.
    #[inline(always)]
    fn pass_on(&mut self, at: usize, memory: Vec<Waiting>) {
        if memory.capacity() == 0 {
            return;
        }
        self.bare = self.bare.max(at + 1);
        while self.buckets.get(self.bare).is_some_and(|b| b.capacity() > 0) {
            self.bare += 1;
        }
        let to = if self.bare < self.buckets.len() { self.bare } else { at };
        self.buckets[to] = memory;
    }

    /// Returns the number of voxels whose first sheet drawing has not reached.
    pub fn waiting(&self) -> u64 {
        self.buckets[..self.filled].iter().map(|b| b.len() as u64).sum()
    }
}

/// Draws one part with any kernel, view and number type. It is compiled for the baseline alone:
/// for other instruction sets it took as long (perspective views of mri256).
pub(crate) fn render<S: Accumulate>(
    part: &Part<'_>,
    kind: &mut Kind<S>,
    queues: &mut Queues,
    pixels: &mut Pixels,
    io: Io<'_>,
) {
    kind.planes.reset(part.frame.sections.most() + 1);
    General { part }.render(SectionSums, kind, queues, pixels, io);
}

/// Work that draws one part of a field with any kernel and view.
pub struct RenderGeneralField<'a, S: FieldSum> {
    pub(crate) part: Part<'a>,
    pub(crate) kind: &'a mut Kind<S>,
    pub(crate) queues: &'a mut Queues,
    pub(crate) pixels: &'a mut Pixels,
    pub(crate) io: Io<'a>,
}

impl<S: FieldSum> Work for RenderGeneralField<'_, S> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let RenderGeneralField { part, kind, queues, pixels, io } = self;
        kind.planes.reset(part.frame.sections.most() + 1);
        let planes = FieldPlanes { simd, weights: Default::default() };
        General { part: &part }.render(planes, kind, queues, pixels, io);
    }
}

/// Content of a sheet: sections of classified voxels, or planes of a field.
trait Contents<S: Accumulate> {
    /// Adds the voxels of `bucket` to their sheets from sheet `k` on.
    fn splat_all(
        &mut self,
        of: &General<'_>,
        bucket: &[Waiting],
        k: i32,
        kind: &mut Kind<S>,
        state: (&OpenMask, &mut Counters),
    );
    /// Composites sheet `k` at some pixels, given by their columns and rows in the picture.
    fn close_row(
        &self,
        part: &Part<'_>,
        row: &mut Row,
        at: (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32;
}

/// Sections of classified voxels.
struct SectionSums;

impl<S: Accumulate> Contents<S> for SectionSums {
    #[inline(always)]
    fn splat_all(
        &mut self,
        of: &General<'_>,
        bucket: &[Waiting],
        k: i32,
        kind: &mut Kind<S>,
        (open, counters): (&OpenMask, &mut Counters),
    ) {
        of.splat_all(bucket, k, kind, open, counters);
    }

    #[inline(always)]
    fn close_row(
        &self,
        part: &Part<'_>,
        row: &mut Row,
        _: (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32 {
        part.frame.rule.close_row::<S>(row, live)
    }
}

/// Planes of a field.
struct FieldPlanes<S: FieldSum> {
    simd: Simd,
    /// For weights that are in no table.
    weights: [Vec<Four<S>>; 2],
}

impl<S: FieldSum> Contents<S> for FieldPlanes<S> {
    #[inline(always)]
    fn splat_all(
        &mut self,
        of: &General<'_>,
        bucket: &[Waiting],
        k: i32,
        kind: &mut Kind<S>,
        (open, counters): (&OpenMask, &mut Counters),
    ) {
        let Part { frame, rect, slab, .. } = of.part;
        let rule = frame.field.as_ref().expect("a field's frame");
        let [bx, by] = &mut self.weights;
        for Waiting { brick, voxel, placed } in bucket {
            let (brick, _) = of.part.brick(*brick as usize);
            if frame.scene.quality.cull && of.extent(placed).is_none_or(|e| !open.any(&e)) {
                counters.culled += 1;
                continue;
            }
            let payload = S::payload_of(frame.field_payload(rule, brick, usize::from(*voxel)));
            if S::is_nothing(payload) {
                continue;
            }
            counters.splatted += 1;
            let (first, count) = frame.sections.span(placed.z);
            let planes = planes_of::<S>(&frame.sections, placed.z);
            for sheet in first.max(k).max(slab.first)..(first + count as i32).min(slab.end) {
                let Some(f) = frame.footprints.at(sheet) else { continue };
                let at = frame.screen(placed, sheet, &f);
                let section = weighted::<S>([payload; 4], planes[(sheet - first) as usize]);
                let (y0, wy) = S::window(&f, 1, at[1], (rect.y0, rect.y1), by);
                for (j, wy) in wy.iter().enumerate() {
                    // Rows of a kernel that leans lie beside each other.
                    let y = y0 + j as i32;
                    let along = frame.along_row(at, y);
                    let (x0, wx) = S::window(&f, 0, along, (rect.x0, rect.x1), bx);
                    if !wx.is_empty() {
                        let from = [(x0 - rect.x0) as usize, (y - rect.y0) as usize];
                        let row = weighted::<S>(section, *wy);
                        kind.planes.add_field_row(sheet, from, wx, row);
                    }
                }
            }
        }
    }

    #[inline(always)]
    fn close_row(
        &self,
        part: &Part<'_>,
        row: &mut Row,
        at: (&[[i32; 2]; LANES], i32),
        live: u32,
    ) -> u32 {
        part.frame.close_field_row(self.simd, row, at, live)
    }
}

struct General<'a> {
    part: &'a Part<'a>,
}

impl General<'_> {
    #[inline(always)]
    fn render<S: Accumulate>(
        &self,
        mut contents: impl Contents<S>,
        kind: &mut Kind<S>,
        queues: &mut Queues,
        pixels: &mut Pixels,
        (out, counters): Io<'_>,
    ) {
        let part = self.part;
        let Part { frame, slab, .. } = part;
        let mut open = self.part.begin(pixels, out);
        if let Some(last) = &out.last {
            self.part.each_pixel(|x, y, tile| {
                kind.planes.put(slab.first - 1, y * PART as usize + x, last[tile]);
            });
        }
        queues.begin(slab.len() as usize);

        let float_sums = frame.scene.float_sums();
        let mut next = 0;
        let mut any_open = open.count() > 0;
        let mut end = slab.end;
        for k in slab.first..slab.end {
            if !any_open {
                break;
            }
            if !part.is_supplied(k, &open, counters) {
                end = k;
                break;
            }
            while part.begins(next, k) {
                self.admit(next, &open, queues, counters);
                next += 1;
            }
            if k == slab.first && !queues.carried.is_empty() {
                // Voxels that begin before the slab come first, as they do without the cut.
                let mut carried = std::mem::take(&mut queues.carried);
                if float_sums {
                    let sections = &frame.sections;
                    let id = |v: &Waiting| part.brick(v.brick as usize).0.id;
                    carried.sort_unstable_by_key(|v| (sections.first(v.placed.z), id(v), v.voxel));
                }
                contents.splat_all(self, &carried, k, kind, (&open, counters));
                carried.clear();
                queues.carried = carried;
            }
            let mut bucket = std::mem::take(&mut queues.buckets[(k - slab.first) as usize]);
            if float_sums {
                bucket.sort_unstable_by_key(|v| (part.brick(v.brick as usize).0.id, v.voxel));
            }
            contents.splat_all(self, &bucket, k, kind, (&open, counters));
            queues.fullest = queues.fullest.max(bucket.len());
            bucket.clear();
            queues.pass_on((k - slab.first) as usize, bucket);
            if self.close(&contents, k, &kind.planes, &mut open, pixels) {
                any_open = open.count() > 0;
            }
            kind.planes.clear(k - 1);
        }
        // Whatever the part did not come to is hidden, unless it goes on later.
        let stopped = end < slab.end;
        if !stopped {
            counters.culled += part.voxels_from(next);
            counters.culled += queues.waiting();
        }
        self.part.end(pixels, out);
        if let Some(last) = keep_last(part, stopped, out) {
            // The sums of a shut pixel are never read. They are handed on as zeros.
            self.part.each_pixel(|x, y, tile| {
                if open.row(y) >> x & 1 == 1 {
                    last[tile] = kind.planes.raw(end - 1, y * PART as usize + x);
                }
            });
        }
    }

    /// Returns the rectangle of a voxel's footprints, all sections together, a pixel more at most.
    #[inline(always)]
    fn extent(&self, placed: &Placed) -> Option<Rect> {
        let frame = self.part.frame;
        let (first, count) = frame.sections.span(placed.z);
        let last = first + count as i32 - 1;
        let at = |k: i32| {
            let f = frame.footprints.at(k)?;
            let at = frame.screen(placed, k, &f);
            let (y0, y1) = f.extent(1, at[1]);
            // Rows lie one way.
            let [a, b] = [y0, y1 - 1].map(|y| f.extent(0, frame.along_row(at, y)));
            Some(Rect::new(a.0.min(b.0), y0, a.1.max(b.1), y1))
        };
        if frame.leaning.is_some() {
            let mut all = (first..=last).filter_map(at);
            let one = all.next()?;
            // Rectangles without a pixel's centre count, too, as below.
            return Some(all.fold(one, |a, b| {
                let (x0, y0) = (a.x0.min(b.x0), a.y0.min(b.y0));
                Rect::new(x0, y0, a.x1.max(b.x1), a.y1.max(b.y1))
            }));
        }
        match frame.view.projection {
            Projection::Ortho { .. } => at(first),
            Projection::Persp { .. } => {
                // Edges move one way with depth, so the first and last visible sections hold
                // the others. An end's rounding may put one a pixel farther out: grow by one.
                // One that holds no pixel's centre still says where the edges are, which
                // `Rect::union` would forget.
                let front = (first..=last).find_map(at)?;
                let back = at(last)?;
                let (x0, y0) = (front.x0.min(back.x0), front.y0.min(back.y0));
                let (x1, y1) = (front.x1.max(back.x1), front.y1.max(back.y1));
                Some(Rect::new(x0 - 1, y0 - 1, x1 + 1, y1 + 1))
            }
        }
    }

    /// Tests a brick, then its voxels, and tosses what is left into buckets.
    #[inline(always)]
    fn admit(&self, which: usize, open: &OpenMask, queues: &mut Queues, counters: &mut Counters) {
        let Part { frame, rect, slab, .. } = self.part;
        let Some((brick, corner)) = self.part.open_brick(which, open, counters) else { return };
        let cull = frame.scene.quality.cull;
        for (voxel, &local) in brick.index.iter().enumerate() {
            let placed = frame.place(corner, local);
            let (first, count) = frame.sections.span(placed.z);
            if first >= slab.end || first + count as i32 <= slab.first {
                continue;
            }
            let Some(extent) = self.extent(&placed) else { continue };
            let inside = !extent.intersect(rect).is_empty();
            if !inside || cull && !open.any(&extent) {
                counters.culled += u64::from(inside);
                continue;
            }
            counters.tossed += 1;
            let waiting = Waiting { brick: which as u32, voxel: voxel as u16, placed };
            if first < slab.first {
                queues.carried.push(waiting);
            } else {
                queues.put((first - slab.first) as usize, waiting);
            }
        }
    }

    #[inline(always)]
    fn splat_all<S: Accumulate>(
        &self,
        bucket: &[Waiting],
        k: i32,
        Kind { planes, weights }: &mut Kind<S>,
        open: &OpenMask,
        counters: &mut Counters,
    ) {
        let Part { frame, rect, slab, .. } = self.part;
        let leaning_rows = frame.leaning.as_ref().is_some_and(|l| l.row() != 0);
        let rows = (rect.y0, rect.y1);
        // The sheet behind the slab is filled as far as the colour rule peeks.
        let end = slab.end + i32::from(frame.looks_at_neighbours());
        for Waiting { brick, voxel, placed } in bucket {
            let (brick, _) = self.part.brick(*brick as usize);
            if frame.scene.quality.cull && self.extent(placed).is_none_or(|e| !open.any(&e)) {
                counters.culled += 1;
                continue;
            }
            let payload = frame.payload(brick, usize::from(*voxel), placed.eye);
            if payload[0] <= 0.0 {
                continue;
            }
            counters.splatted += 1;
            let (first, count) = frame.sections.span(placed.z);
            for sheet in first.max(k).max(slab.first)..(first + count as i32).min(end) {
                let Some(f) = frame.footprints.at(sheet) else { continue };
                let at = frame.screen(placed, sheet, &f);
                let i = (sheet - first) as usize;
                let section = || S::section(&frame.sections, placed.z, i, &payload);
                if leaning_rows {
                    // Each lies elsewhere.
                    let (y0, y1) = f.extent(1, at[1]);
                    for y in y0.max(rows.0)..y1.min(rows.1) {
                        let x = frame.along_row(at, y);
                        if let Some(row) = self.window::<S>(&f, [x, at[1]], (y, y + 1), weights) {
                            planes.add(sheet, row, section());
                        }
                    }
                } else if let Some(window) = self.window::<S>(&f, at, rows, weights) {
                    planes.add(sheet, window, section());
                }
            }
        }
    }

    /// A footprint inside the part and `rows`, or nothing.
    #[inline(always)]
    fn window<'b, S: Accumulate>(
        &self,
        f: &'b Footprint<'_>,
        [x, y]: [i64; 2],
        rows: (i32, i32),
        [bx, by]: &'b mut [Vec<S::Weight>; 2],
    ) -> Option<Window<'b, S::Weight>> {
        let rect = self.part.rect;
        let (x0, wx) = S::Weight::of(f, 0, x, (rect.x0, rect.x1), bx);
        let (y0, wy) = S::Weight::of(f, 1, y, rows, by);
        let inside = !wx.is_empty() && !wy.is_empty();
        let at = |p: i32, origin: i32| (p - origin) as usize;
        inside.then(|| ((at(x0, rect.x0), wx), (at(y0, rect.y0), wy)))
    }

    /// Closes sheet `k` where it was touched; whether pixels were shut.
    #[inline(always)]
    fn close<S: Accumulate>(
        &self,
        contents: &impl Contents<S>,
        k: i32,
        planes: &Planes<S>,
        open: &mut OpenMask,
        pixels: &mut Pixels,
    ) -> bool {
        const { assert!(LANES == 2 * BLOCK) };
        let (part, rect) = (self.part, self.part.rect);
        let mut mask = planes.touched(k);
        let mut any_shut = false;
        let mut row = Row::default();
        while mask != 0 {
            let b = mask.trailing_zeros() as usize;
            mask &= mask - 1;
            let (x0, y0) = (b % 8 * BLOCK, b / 8 * BLOCK);
            for y in (y0..y0 + BLOCK).step_by(2) {
                let live = [y, y + 1].map(|y| open.row(y) >> x0 & 0xff);
                if live == [0, 0] {
                    continue;
                }
                let mut places = [0; LANES];
                let mut at_pixel = [[0; 2]; LANES];
                for (lane, place) in places.iter_mut().enumerate() {
                    let at = (y + lane / BLOCK) * STRIDE + x0 + lane % BLOCK;
                    let secant = pixels.secants[at];
                    (row.secant[lane], row.cosine[lane]) = (secant, 1.0 / secant);
                    row.a[lane] = f32::from_bits(pixels.all[at][0]);
                    *place = at as u32;
                    let [x, y] = [x0 + lane % BLOCK, y + lane / BLOCK];
                    at_pixel[lane] = [rect.x0 + x as i32, rect.y0 + y as i32];
                }
                for half in 0..2 {
                    planes.load(k, (y + half) * PART as usize + x0, &mut row, half * BLOCK);
                }
                let live = (live[0] | live[1] << BLOCK) as u32;
                let shut = contents.close_row(part, &mut row, (&at_pixel, k), live);
                put(Simd::plain(), &row, &places, &mut pixels.all);
                if let Some(work) = &mut pixels.work {
                    part.count_sheet(work, k, (&row, &places), [live, shut]);
                }
                for half in 0..2 {
                    let shut = u64::from(shut >> (half * BLOCK) & 0xff);
                    open.close(y + half, shut << x0);
                    any_shut |= shut != 0;
                }
            }
        }
        any_shut
    }
}
