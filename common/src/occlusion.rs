//! The occlusion map: which pixels are shut, and whether a whole rectangle is.
//!
//! The paper keeps accumulated opacities in a summed-area table and compares an average with
//! one (section 4.2). Float sums drift, and an average close to one hides an open pixel. Here
//! the table counts shut pixels in integers: a rectangle is shut when the count equals its area,
//! exactly, in four reads.

/// A half-open rectangle of pixels, in absolute image coordinates.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize,
)]
pub struct Rect {
    /// Left column in pixels; inside the rectangle.
    pub x0: i32,
    /// Top row in pixels; inside the rectangle.
    pub y0: i32,
    /// Column in pixels just right of the rectangle.
    pub x1: i32,
    /// Row in pixels just below the rectangle.
    pub y1: i32,
}

impl Rect {
    /// Returns the rectangle of columns `x0` up to but without `x1` and rows `y0` up to but without
    /// `y1`, in pixels.
    pub fn new(x0: i32, y0: i32, x1: i32, y1: i32) -> Self {
        Rect { x0, y0, x1, y1 }
    }

    /// Returns the rectangle of a whole picture of `size` (width, height) pixels.
    pub fn from_size(size: [u32; 2]) -> Self {
        Rect::new(0, 0, size[0] as i32, size[1] as i32)
    }

    /// Returns the number of columns; 0 if empty.
    pub fn width(&self) -> usize {
        (self.x1 - self.x0).max(0) as usize
    }

    /// Returns the number of rows; 0 if empty.
    pub fn height(&self) -> usize {
        (self.y1 - self.y0).max(0) as usize
    }

    /// Returns the number of pixels in the rectangle.
    pub fn area(&self) -> usize {
        self.width() * self.height()
    }

    /// Returns whether the rectangle holds no pixel.
    pub fn is_empty(&self) -> bool {
        self.x1 <= self.x0 || self.y1 <= self.y0
    }

    /// Returns the pixels that both share (may be empty).
    pub fn intersect(&self, o: &Rect) -> Rect {
        Rect::new(self.x0.max(o.x0), self.y0.max(o.y0), self.x1.min(o.x1), self.y1.min(o.y1))
    }

    /// Returns the smallest rectangle that holds both; an empty one counts as nothing.
    pub fn union(&self, o: &Rect) -> Rect {
        if self.is_empty() {
            *o
        } else if o.is_empty() {
            *self
        } else {
            Rect::new(self.x0.min(o.x0), self.y0.min(o.y0), self.x1.max(o.x1), self.y1.max(o.y1))
        }
    }
}

/// Shut pixels of a rectangle of the image, with a summed-area table over their count (paper
/// section 4.2).
#[derive(Clone, Debug)]
pub struct ShutMap {
    rect: Rect,
    /// `(w + 1) x (h + 1)`: shut pixels above and left of each corner.
    count: Vec<u32>,
    shut: Vec<bool>,
    stale: bool,
}

impl ShutMap {
    /// Returns a map of `rect` with every pixel open.
    pub fn open(rect: Rect) -> Self {
        let (w, h) = (rect.width(), rect.height());
        ShutMap { rect, count: vec![0; (w + 1) * (h + 1)], shut: vec![false; w * h], stale: false }
    }

    /// Returns the rectangle that the map covers.
    pub fn rect(&self) -> Rect {
        self.rect
    }

    /// Opens every pixel and moves the map to `rect`, keeping its memory.
    pub fn reset(&mut self, rect: Rect) {
        self.rect = rect;
        let (w, h) = (rect.width(), rect.height());
        self.count.clear();
        self.count.resize((w + 1) * (h + 1), 0);
        self.shut.clear();
        self.shut.resize(w * h, false);
        self.stale = false;
    }

    /// Shuts pixel `i` (row-major in the map's rectangle). Counts are stale until
    /// [`ShutMap::refresh`].
    #[inline]
    pub fn shut(&mut self, i: usize) {
        self.shut[i] = true;
        self.stale = true;
    }

    /// Returns whether pixel `i` (row-major in the map's rectangle) is shut.
    #[inline]
    pub fn is_shut(&self, i: usize) -> bool {
        self.shut[i]
    }

    /// Brings the summed-area counts up to date after [`ShutMap::shut`].
    pub fn refresh(&mut self) {
        if !self.stale {
            return;
        }
        self.stale = false;
        let (w, h) = (self.rect.width(), self.rect.height());
        for y in 0..h {
            let (above, row) = self.count[y * (w + 1)..(y + 2) * (w + 1)].split_at_mut(w + 1);
            let shut = &self.shut[y * w..(y + 1) * w];
            let mut run = 0u32;
            for x in 0..w {
                run += u32::from(shut[x]);
                row[x + 1] = above[x + 1] + run;
            }
        }
    }

    /// Returns the number of shut pixels in the part of `r` that the map covers, as of the last
    /// refresh.
    #[inline]
    pub fn shut_in(&self, r: &Rect) -> u32 {
        debug_assert!(!self.stale, "the counts are asked for before a refresh");
        let r = r.intersect(&self.rect);
        if r.is_empty() {
            return 0;
        }
        let stride = self.rect.width() + 1;
        let at = |x: i32, y: i32| {
            self.count[(y - self.rect.y0) as usize * stride + (x - self.rect.x0) as usize]
        };
        at(r.x1, r.y1) + at(r.x0, r.y0) - at(r.x1, r.y0) - at(r.x0, r.y1)
    }

    /// Returns whether every pixel of `r` that the map covers is shut; true if it covers none.
    #[inline]
    pub fn all_shut(&self, r: &Rect) -> bool {
        let r = r.intersect(&self.rect);
        self.shut_in(&r) as usize == r.area()
    }

    /// Returns the number of open pixels in the part of `r` that the map covers, as of the last
    /// refresh.
    pub fn open_in(&self, r: &Rect) -> u32 {
        let r = r.intersect(&self.rect);
        r.area() as u32 - self.shut_in(&r)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn summed_area_counts_equal_plain_counting(
            w in 1i32..40, h in 1i32..40, x0 in -9i32..9, y0 in -9i32..9,
            bits in prop::collection::vec(any::<bool>(), 1600),
            q in (-20i32..60, -20i32..60, 0i32..50, 0i32..50),
        ) {
            let rect = Rect::new(x0, y0, x0 + w, y0 + h);
            let mut map = ShutMap::open(rect);
            for i in 0..(w * h) as usize {
                if bits[i] { map.shut(i); }
            }
            map.refresh();
            let query = Rect::new(q.0, q.1, q.0 + q.2, q.1 + q.3);
            let mut want = 0;
            let inside = query.intersect(&rect);
            for y in inside.y0..inside.y1 {
                for x in inside.x0..inside.x1 {
                    want += u32::from(bits[((y - y0) * w + (x - x0)) as usize]);
                }
            }
            prop_assert_eq!(map.shut_in(&query), want);
            prop_assert_eq!(map.all_shut(&query), want as usize == inside.area());
        }
    }
}
