//! One region of a frame through all its sheets: what workers run under the `region` schedule.
//!
//! A worker knows every brick of the volume by the *directory* (tight boxes, some twenty bytes a
//! brick) and holds some of them. So it can tell by itself which bricks a region needs next, and
//! culling need not wait for slabs: a brick is asked for at the sheet at which it begins, and only
//! if it may touch a pixel that is open there. What hides it is then drawn already.
//!
//! ```text
//! Outlook::look, Outlook::new    the directory as a frame sees it: once a frame, on all threads
//! Region::new                    a tile before its first sheet
//! Region::advance                to the end, or to the first sheet that lacks a brick
//!   .. names the bricks that it lacks there and a little farther; others render meanwhile
//! Region::advance                from that sheet on
//! Region::finish                 pixels, counts, and which bricks it touched
//! ```
//!
//! **Why stopping changes no byte.** It is a cut between two slabs, made where it is needed: opacity
//! and the last sheet's raw sums are kept, colour adds up in integers, and voxels that straddle the
//! cut are tossed again ([`crate::tile`]). Where nothing is lacked there is no cut, and a region
//! costs what a tile of one slab costs.

use crate::mask::OpenMask;
use crate::scene::{Corner, Frame};
use crate::splat::Simd;
use crate::tile::{Among, PART, Part, Scratch};
use slabcast_common::brick::{Brick, BrickInfo};
use slabcast_common::ids::BrickId;
use slabcast_common::image::TilePixels;
use slabcast_common::message::Counters;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::Projected;
use std::cell::{Cell, OnceCell, RefCell};
use std::sync::Arc;

/// Where bricks are had from, by their place in the directory.
pub trait Supply {
    /// A brick, if it is here.
    fn get(&self, place: u32) -> Option<Arc<Brick>>;
}

/// A brick of the directory as a frame sees it, whether it is here or not.
#[derive(Clone, Copy, Debug)]
pub struct Sight {
    place: u32,
    id: BrickId,
    voxels: u16,
    projected: Projected,
}

/// The directory as a frame sees it: its bricks front to back, and which of them lie over each
/// part of the picture.
#[derive(Debug)]
pub struct Outlook {
    /// Those that begin together in ascending id.
    sights: Vec<Sight>,
    sheets: SheetRange,
    /// Parts in a row of the picture.
    columns: usize,
    /// Where each part's entries begin; one more than there are parts.
    starts: Vec<usize>,
    /// Places in `sights`, front to back in each part.
    entries: Vec<u32>,
}

impl Outlook {
    /// Looks at a portion of the directory, whose first brick has the place `first`. Portions may be
    /// looked at by different threads.
    pub fn look(frame: &Frame, bricks: &[BrickInfo], first: u32) -> Vec<Sight> {
        let sight = |(place, b): (u32, &BrickInfo)| {
            let projected = frame.view.project(&b.tight)?;
            Some(Sight { place, id: b.id, voxels: b.voxels, projected })
        };
        (first..).zip(bricks).filter_map(sight).collect()
    }

    /// Puts all portions, in the order of the directory, together.
    pub fn new(size: [u32; 2], portions: &[Vec<Sight>]) -> Outlook {
        let seen = || portions.iter().flatten();
        let sheets = seen().fold(SheetRange::default(), |all, s| all.union(s.projected.sheets));
        let sights = front_to_back(portions, sheets);

        let edge = PART as u32;
        let columns = size[0].div_ceil(edge) as usize;
        let parts = columns * size[1].div_ceil(edge) as usize;
        let over = |s: &Sight| {
            let r = s.projected.rect;
            let (x0, x1) = (r.x0 / PART, (r.x1 - 1) / PART);
            (r.y0 / PART..=(r.y1 - 1) / PART)
                .flat_map(move |y| (x0..=x1).map(move |x| y as usize * columns + x as usize))
        };
        let mut starts = vec![0usize; parts + 1];
        for part in sights.iter().flat_map(over) {
            starts[part + 1] += 1;
        }
        for i in 0..parts {
            starts[i + 1] += starts[i];
        }
        let mut entries = vec![0u32; starts[parts]];
        let mut next = starts.clone();
        for (s, i) in sights.iter().zip(0u32..) {
            for part in over(s) {
                entries[next[part]] = i;
                next[part] += 1;
            }
        }
        Outlook { sights, sheets, columns, starts, entries }
    }

    /// Sheets that anything lies in.
    pub fn sheets(&self) -> SheetRange {
        self.sheets
    }

    /// What lies over the part of the picture that holds the pixel (x, y), front to back.
    fn over(&self, x: i32, y: i32) -> &[u32] {
        let part = (y / PART) as usize * self.columns + (x / PART) as usize;
        &self.entries[self.starts[part]..self.starts[part + 1]]
    }
}

/// Those that begin first in front; portions ascend by id, and so do those that begin together. Where
/// sheets are not many more than bricks each counts its own, in a third of the time that sorting takes.
fn front_to_back(portions: &[Vec<Sight>], sheets: SheetRange) -> Vec<Sight> {
    let seen = || portions.iter().flatten();
    let depth = |s: &Sight| s.projected.sheets.first.abs_diff(sheets.first) as usize;
    let (n, Some(first)) = (seen().count(), seen().next()) else { return Vec::new() };
    let deepest = seen().map(depth).max().unwrap_or(0);
    if deepest > 4 * n {
        let mut sights: Vec<Sight> = seen().copied().collect();
        sights.sort_by_key(depth);
        return sights;
    }
    let mut next = vec![0usize; deepest + 2];
    for s in seen() {
        next[depth(s) + 1] += 1;
    }
    for i in 1..next.len() {
        next[i] += next[i - 1];
    }
    let mut sights = vec![*first; n];
    for s in seen() {
        let at = &mut next[depth(s)];
        sights[*at] = *s;
        *at += 1;
    }
    sights
}

/// A brick that a part took, and its corner as the frame sees it.
pub(crate) type Loaded = OnceCell<(Arc<Brick>, Corner)>;

/// Bricks of a part that come when they are looked at.
pub(crate) struct Coming<'a> {
    frame: &'a Frame,
    sights: &'a [Sight],
    supply: &'a dyn Supply,
    /// Those that came, by their place in the part.
    loaded: &'a [Loaded],
    /// How many sheets beyond the one at which something is lacked are looked at, too.
    ahead: u32,
    /// The first sheet that could not be drawn.
    stop: Cell<Option<i32>>,
    /// What was lacked: places in the directory, in order of depth.
    lacks: RefCell<Vec<u32>>,
}

impl Coming<'_> {
    #[inline]
    pub(crate) fn projected(&self, sight: usize) -> &Projected {
        &self.sights[sight].projected
    }

    pub(crate) fn voxels(&self, sight: usize) -> u64 {
        self.sights[sight].voxels.into()
    }

    pub(crate) fn is_loaded(&self, i: usize) -> bool {
        self.loaded[i].get().is_some()
    }

    pub(crate) fn loaded(&self, i: usize) -> (&Brick, &Corner) {
        let (brick, corner) = self.loaded[i].get().expect("an admitted brick is here");
        (brick, corner)
    }

    /// Takes the bricks from `next` on that begin at sheet `k` or before and may touch what is open;
    /// if one is not here, notes what is lacked.
    pub(crate) fn is_supplied(
        &self,
        part: &Part<'_>,
        next: usize,
        k: i32,
        open: &OpenMask,
    ) -> bool {
        let passes = |p: &Projected| !self.frame.scene.quality.cull || open.any(&p.rect);
        let sight = |i: usize| &self.sights[part.inside[i] as usize];
        for i in next..part.bricks() {
            let s = sight(i);
            if s.projected.sheets.first > k {
                break;
            }
            if self.is_loaded(i) || !passes(&s.projected) {
                continue;
            }
            let Some(brick) = self.supply.get(s.place) else {
                self.stop.set(Some(k));
                break;
            };
            self.loaded[i].get_or_init(|| (brick, self.frame.corner(s.id)));
        }
        if self.stop.get().is_none() {
            return true;
        }
        let mut lacks = self.lacks.borrow_mut();
        let until = k.saturating_add_unsigned(self.ahead);
        for i in next..part.bricks() {
            let s = sight(i);
            if s.projected.sheets.first > until {
                break;
            }
            let here = || self.is_loaded(i) || self.supply.get(s.place).is_some();
            if passes(&s.projected) && !here() {
                lacks.push(s.place);
            }
        }
        false
    }
}

/// A part of a region.
#[derive(Clone, Copy, Debug)]
struct Strand {
    rect: Rect,
    /// The next sheet to draw.
    at: i32,
}

/// A tile on its way through the sheets of a frame.
#[derive(Debug)]
pub struct Region {
    tile: Rect,
    /// Parts that have not come to an end.
    open: Vec<Strand>,
    pixels: TilePixels,
    counters: Counters,
    /// Places of bricks that were drawn, some of them twice.
    touched: Vec<u32>,
}

/// A region that came to its end.
#[derive(Debug)]
pub struct Finished {
    /// Its pixels. Sums of a last sheet are not among them: nobody goes on from there.
    pub pixels: TilePixels,
    /// Its voxels.
    pub counters: Counters,
    /// Places in the directory of the bricks that it touched, ascending.
    pub touched: Vec<u32>,
}

impl Region {
    /// `tile`, which lies inside the picture, before the first sheet.
    pub fn new(outlook: &Outlook, tile: Rect) -> Region {
        let next = |at: i32, end: i32| ((at / PART + 1) * PART).min(end);
        let mut open = Vec::new();
        let mut y0 = tile.y0;
        while y0 < tile.y1 {
            let y1 = next(y0, tile.y1);
            let mut x0 = tile.x0;
            while x0 < tile.x1 {
                let x1 = next(x0, tile.x1);
                open.push(Strand { rect: Rect::new(x0, y0, x1, y1), at: outlook.sheets.first });
                x0 = x1;
            }
            y0 = y1;
        }
        let n = tile.area();
        let pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
        Region { tile, open, pixels, counters: Counters::default(), touched: Vec::new() }
    }

    /// Its tile.
    pub fn tile(&self) -> Rect {
        self.tile
    }

    /// How far it has come: sheets that its parts are past, summed over those that are not at their
    /// end. `None`: it is at its end.
    pub fn depth(&self) -> Option<(usize, i64)> {
        let left = self.open.len();
        (left > 0).then(|| (left, self.open.iter().map(|s| i64::from(s.at)).sum()))
    }

    /// Goes as far as bricks are here. What it lacks to go farther, by places in the directory and
    /// without repetition: those that begin at the sheets at which its parts stand still, and those
    /// of `ahead` sheets more that are not hidden by what is drawn already. Nothing: it is at its end.
    pub fn advance(
        &mut self,
        frame: &Frame,
        simd: Simd,
        outlook: &Outlook,
        supply: &dyn Supply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        loop {
            let lacks = self.go(frame, simd, outlook, supply, ahead, scratch);
            // What was lacked may have come while the list was made.
            if self.open.is_empty() || !lacks.is_empty() {
                return lacks;
            }
        }
    }

    fn go(
        &mut self,
        frame: &Frame,
        simd: Simd,
        outlook: &Outlook,
        supply: &dyn Supply,
        ahead: u32,
        scratch: &mut Scratch,
    ) -> Vec<u32> {
        let mut lacks = Vec::new();
        let mut inside = std::mem::take(&mut scratch.inside);
        let mut loaded = std::mem::take(&mut scratch.loaded);
        let mut open = std::mem::take(&mut self.open);
        open.retain_mut(|strand| {
            let slab = SheetRange::new(strand.at, outlook.sheets.end);
            inside.clear();
            inside.extend(outlook.over(strand.rect.x0, strand.rect.y0).iter().filter(|&&s| {
                let p = &outlook.sights[s as usize].projected;
                p.sheets.overlaps(slab) && !p.rect.intersect(&strand.rect).is_empty()
            }));
            if inside.is_empty() {
                return false;
            }
            loaded.clear();
            loaded.resize_with(inside.len(), OnceCell::new);
            let coming = Coming {
                frame,
                sights: &outlook.sights,
                supply,
                loaded: &loaded,
                ahead,
                stop: Cell::new(None),
                lacks: RefCell::default(),
            };
            let among = Among::Coming(&coming);
            let part =
                Part { frame, rect: strand.rect, tile: self.tile, slab, among, inside: &inside };
            part.draw(simd, scratch, (&mut self.pixels, &mut self.counters));
            let came = loaded.iter().zip(&inside).filter(|(l, _)| l.get().is_some());
            self.touched.extend(came.map(|(_, &s)| outlook.sights[s as usize].place));
            lacks.append(&mut coming.lacks.borrow_mut());
            match coming.stop.get() {
                Some(k) => {
                    strand.at = k;
                    true
                }
                None => false,
            }
        });
        loaded.clear();
        self.open = open;
        scratch.inside = inside;
        scratch.loaded = loaded;
        if self.tile.width() > PART as usize || self.tile.height() > PART as usize {
            // Parts lack the same brick; the first to name it says how urgent it is.
            let mut named = std::collections::BTreeSet::new();
            lacks.retain(|&place| named.insert(place));
        }
        lacks
    }

    /// Ends it, at its end or before.
    pub fn finish(self) -> Finished {
        let Region { mut pixels, counters, mut touched, .. } = self;
        touched.sort_unstable();
        touched.dedup();
        pixels.last = None;
        Finished { pixels, counters, touched }
    }
}
