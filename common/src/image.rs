//! Pictures in the making and finished ones.
//!
//! A slab image is a continuation, not a picture of its own (DESIGN.md section 1): a task gets
//! its tile's A and the last sheet's raw sums and goes on; its colour is fixed point and is
//! added to what stood there. So any cut into slabs and tiles gives the same integers.

use crate::leaves::{Finish, LEAF, Leaves, Mosaic};
use crate::math::{linear_from_srgb, srgb_from_linear};
use crate::occlusion::Rect;
use crate::volume::Digest32;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::sync::OnceLock;

/// Unit of fixed-point premultiplied colour.
pub const COLOUR_UNIT: f32 = 1.0 / (1u32 << 28) as f32;

/// Raw sums of one sheet at one pixel: extinction and the three sigma-weighted colours, as
/// bits (of i32, or of f32 when the scene's sums are f32).
pub type RawSums = [u32; 4];

/// What a task starts from: its tile's pixels as the slabs before left them.
#[derive(Clone, Debug, PartialEq)]
pub struct TileState {
    /// A, accumulated opacity, row-major in the tile.
    pub a: Vec<f32>,
    /// Raw sums of the last sheet before the slab; `None` when they are all zero.
    pub last: Option<Vec<RawSums>>,
}

/// What a task gives back.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TilePixels {
    /// A after the slab, row-major in the tile.
    pub a: Vec<f32>,
    /// Premultiplied colour that the slab adds, in units of [`COLOUR_UNIT`].
    pub colour: Vec<[u32; 3]>,
    /// Raw sums of the slab's last sheet; `None` when they are all zero.
    pub last: Option<Vec<RawSums>>,
}

/// A finished pixel: linear premultiplied RGBA.
#[inline(always)]
pub(crate) fn finished(a: f32, colour: [u32; 3]) -> [f32; 4] {
    let [r, g, b] = colour;
    [r as f32 * COLOUR_UNIT, g as f32 * COLOUR_UNIT, b as f32 * COLOUR_UNIT, a]
}

impl TilePixels {
    /// Those of a piece of `tile`, which they are the pixels of.
    ///
    /// # Panics
    /// If the piece is not inside the tile.
    pub fn piece(&self, tile: Rect, piece: Rect) -> TilePixels {
        fn rows<T: Copy>(plane: &[T], tile: Rect, piece: Rect) -> Vec<T> {
            let from = (piece.x0 - tile.x0) as usize;
            let rows = plane.chunks(tile.width()).skip((piece.y0 - tile.y0) as usize);
            let rows = rows.take(piece.height()).map(|row| &row[from..from + piece.width()]);
            rows.flatten().copied().collect()
        }
        assert_eq!(tile.union(&piece), tile, "a piece lies in its tile");
        TilePixels {
            a: rows(&self.a, tile, piece),
            colour: rows(&self.colour, tile, piece),
            last: self.last.as_ref().map(|last| rows(last, tile, piece)),
        }
    }

    /// Writes the pixels of `tile`, which one slab made, into the rows of a picture of `size`.
    ///
    /// # Panics
    /// If the tile leaves the picture.
    pub fn write(&self, tile: Rect, size: [u32; 2], pixels: &mut [[f32; 4]]) {
        for (y, (a, colour)) in
            self.a.chunks(tile.width()).zip(self.colour.chunks(tile.width())).enumerate()
        {
            let row = (tile.y0 as usize + y) * size[0] as usize + tile.x0 as usize;
            draw(&mut pixels[row..row + a.len()], a, colour);
        }
    }
}

/// A frame while its tiles are rendered: slab after slab ([`FrameState::put`]), or each tile at once, as
/// sums ([`FrameState::lay`]) or finished ([`FrameState::lay_finished`]).
#[derive(Clone, Debug)]
pub struct FrameState {
    size: [u32; 2],
    /// Tiles that one task made whole, in the order in which they came; nothing was put where they are.
    laid: Vec<(Rect, TilePixels)>,
    /// Tiles that came finished, likewise. A frame that has some has no others.
    done: Vec<(Rect, Leaves)>,
    /// Whether some of them were taken out ([`FrameState::take_finished`]), and the largest opacity of all that came.
    taken: bool,
    done_most: f32,
    /// Of all pixels; none before something was put.
    a: Vec<f32>,
    colour: Vec<[u32; 3]>,
    /// Sums of the last sheet of the slab before this one; no pixels while all are zero, which they
    /// stay where one task goes through all sheets.
    last: Vec<RawSums>,
    /// Sums of the last sheet of this slab, as its tiles come in; likewise.
    next: Vec<RawSums>,
}

impl FrameState {
    /// What a pixel takes at most: A, three colours, and two sheets' sums.
    pub const BYTES_A_PIXEL: u64 = 4 + 12 + 2 * 16;

    /// Nothing drawn yet.
    pub fn new(size: [u32; 2]) -> Self {
        let (laid, done, taken, done_most, a, colour, last, next) = Default::default();
        FrameState { size, laid, done, taken, done_most, a, colour, last, next }
    }

    fn pixels(&self) -> usize {
        self.size[0] as usize * self.size[1] as usize
    }

    /// Width and height in pixels.
    pub fn size(&self) -> [u32; 2] {
        self.size
    }

    /// A of every pixel as the slabs that were put left it, row-major.
    pub fn a(&self) -> impl ExactSizeIterator<Item = f32> {
        (0..self.pixels()).map(|i| self.a.get(i).copied().unwrap_or(0.0))
    }

    /// The largest opacity of any pixel.
    pub fn alpha_most(&self) -> f32 {
        let laid = self.laid.iter().flat_map(|(_, tile)| &tile.a);
        self.a.iter().chain(laid).fold(self.done_most, |most, &a| a.max(most))
    }

    fn rows(&self, r: Rect) -> impl Iterator<Item = std::ops::Range<usize>> + use<> {
        let w = self.size[0] as usize;
        (r.y0..r.y1).map(move |y| {
            let row = y as usize * w;
            row + r.x0 as usize..row + r.x1 as usize
        })
    }

    /// What a task on `tile` starts from.
    pub fn tile(&self, tile: Rect) -> TileState {
        let mut a = Vec::with_capacity(tile.area());
        if self.a.is_empty() {
            a.resize(tile.area(), 0.0);
        } else {
            for row in self.rows(tile) {
                a.extend_from_slice(&self.a[row]);
            }
        }
        let mut last = Vec::new();
        if !self.last.is_empty() {
            last.reserve_exact(tile.area());
            for row in self.rows(tile) {
                last.extend_from_slice(&self.last[row]);
            }
        }
        let blank = last.iter().all(|s| *s == [0; 4]);
        TileState { a, last: (!blank).then_some(last) }
    }

    /// Takes in a task's result.
    ///
    /// # Panics
    /// If the planes do not have the tile's size; whoever talks to strangers checks before.
    pub fn put(&mut self, tile: Rect, pixels: &TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        let w = tile.width();
        if self.a.is_empty() {
            self.a = vec![0.0; self.pixels()];
            self.colour = vec![[0; 3]; self.pixels()];
        }
        if pixels.last.is_some() && self.next.is_empty() {
            self.next = vec![[0; 4]; self.a.len()];
        }
        for (i, row) in self.rows(tile).enumerate() {
            let from = i * w..(i + 1) * w;
            self.a[row.clone()].copy_from_slice(&pixels.a[from.clone()]);
            for (to, c) in self.colour[row.clone()].iter_mut().zip(&pixels.colour[from.clone()]) {
                for ch in 0..3 {
                    to[ch] = to[ch].wrapping_add(c[ch]);
                }
            }
            if let Some(last) = &pixels.last {
                self.next[row].copy_from_slice(&last[from]);
            }
        }
    }

    /// Takes in a tile that one task drew through all sheets. Nothing is copied: its pixels are read
    /// when the picture is.
    ///
    /// # Panics
    /// As [`FrameState::put`], and if the tile leaves the picture.
    pub fn lay(&mut self, tile: Rect, pixels: TilePixels) {
        let n = tile.area();
        assert!(pixels.a.len() == n && pixels.colour.len() == n, "planes of the tile's size");
        assert!(tile.intersect(&Rect::of_size(self.size)) == tile, "inside the picture");
        self.laid.push((tile, pixels));
    }

    /// Takes in a tile that came finished.
    ///
    /// # Panics
    /// If its parts do not fit each other ([`Leaves::check`]) or the tile, or if the tile leaves the
    /// picture.
    pub fn lay_finished(&mut self, tile: Rect, leaves: Leaves) {
        let [w, h] = leaves.size.map(|n| n as usize);
        assert!([w, h] == [tile.width(), tile.height()], "leaves of the tile's size");
        assert_eq!(leaves.check(), Ok(()));
        assert!(tile.intersect(&Rect::of_size(self.size)) == tile, "inside the picture");
        self.done_most = self.done_most.max(leaves.alpha_most);
        self.done.push((tile, leaves));
    }

    /// Tiles that came finished and were not taken.
    pub fn finished(&self) -> &[(Rect, Leaves)] {
        &self.done
    }

    /// Takes them, for whoever lays them into the picture while others are drawn. The last ones stay for
    /// [`FrameState::encode_on`].
    pub fn take_finished(&mut self) -> Vec<(Rect, Leaves)> {
        self.taken = true;
        std::mem::take(&mut self.done)
    }

    /// Ends a slab: what came in as last sums is what the next slab starts from. A pixel that
    /// no task touched had an empty last sheet.
    pub fn end_slab(&mut self) {
        std::mem::swap(&mut self.last, &mut self.next);
        self.next.fill([0; 4]);
    }

    /// The finished picture.
    ///
    /// # Panics
    /// If tiles came finished: sums can't be had from them.
    pub fn finish(&self) -> Picture {
        assert!(self.done.is_empty() && !self.taken, "tiles as sums");
        let mut pixels = Vec::with_capacity(self.pixels());
        self.each_row(|row| pixels.extend_from_slice(row));
        Picture { size: self.size, pixels }
    }

    /// The finished picture's bytes, and its hash if it is to be `hashed`, without a picture in between.
    ///
    /// # Panics
    /// If tiles came finished and it is to be hashed or some were taken, or some came in another format or as sums.
    pub fn encode(&self, finish: &Finish, hashed: bool) -> Encoded {
        assert!(!self.taken, "all tiles are here");
        if !self.done.is_empty() {
            assert!(!hashed, "the hash is of the linear picture");
            return self.encode_on(Mosaic::new(self.size, finish));
        }
        let mut encoding = Encoding::new(self.pixels(), finish, hashed);
        self.each_row(|row| encoding.put(row));
        encoding.end()
    }

    /// The finished picture's bytes, where all tiles came finished and those that were taken are laid.
    ///
    /// # Panics
    /// If some came as sums, and as [`Mosaic::lay`].
    pub fn encode_on(&self, mut begun: Mosaic) -> Encoded {
        assert!(self.laid.is_empty() && self.a.is_empty(), "all tiles came finished");
        begun.lay(&self.done);
        Encoded { sha256: None, bytes: begun.end() }
    }

    /// Makes the picture row by row, from the top.
    fn each_row(&self, mut take: impl FnMut(&[[f32; 4]])) {
        let width = self.size[0] as usize;
        let mut row = vec![[0.0; 4]; width];
        // By their first rows; those that have begun and not ended.
        let mut coming: Vec<&(Rect, TilePixels)> = self.laid.iter().collect();
        coming.sort_by_key(|(tile, _)| std::cmp::Reverse(tile.y0));
        let mut here: Vec<&(Rect, TilePixels)> = Vec::new();
        for y in 0..self.size[1] as usize {
            if self.a.is_empty() {
                row.fill([0.0; 4]);
            } else {
                let of = y * width..(y + 1) * width;
                draw(&mut row, &self.a[of.clone()], &self.colour[of]);
            }
            here.retain(|(tile, _)| y < tile.y1 as usize);
            while let Some(tile) = coming.pop_if(|(tile, _)| tile.y0 as usize <= y) {
                here.push(tile);
            }
            for (tile, pixels) in &here {
                let from = (y - tile.y0 as usize) * tile.width();
                let of = from..from + tile.width();
                let to = &mut row[tile.x0 as usize..tile.x1 as usize];
                draw(to, &pixels.a[of.clone()], &pixels.colour[of]);
            }
            take(&row);
        }
    }
}

/// Pixels of a row.
fn draw(row: &mut [[f32; 4]], a: &[f32], colour: &[[u32; 3]]) {
    for ((to, &a), &colour) in row.iter_mut().zip(a).zip(colour) {
        *to = finished(a, colour);
    }
}

/// A finished picture: linear premultiplied RGBA, row-major from the top left, before any
/// background.
#[derive(Clone, Debug, PartialEq)]
pub struct Picture {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Linear premultiplied RGBA.
    pub pixels: Vec<[f32; 4]>,
}

/// What lies behind the volume.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Background {
    /// Nothing: the picture has straight alpha.
    Transparent,
    /// A colour, sRGB numbers in `[0, 1]`.
    Colour([f64; 3]),
}

/// How pixels leave the master.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PixelFormat {
    /// 8-bit sRGB over the background.
    Rgb8,
    /// 8-bit sRGB, straight alpha (opaque over a background).
    Rgba8,
    /// 16-bit sRGB, straight alpha, little endian.
    Rgba16,
    /// Linear premultiplied floats, little endian, without background.
    Rgba32F,
}

impl PixelFormat {
    /// Bytes a pixel.
    pub fn bytes(self) -> usize {
        match self {
            PixelFormat::Rgb8 => 3,
            PixelFormat::Rgba8 => 4,
            PixelFormat::Rgba16 => 8,
            PixelFormat::Rgba32F => 16,
        }
    }
}

impl Picture {
    /// The hash of CONTRACTS.md: over row-major linear premultiplied RGBA f32, little endian.
    pub fn sha256(&self) -> Digest32 {
        let mut h = Sha256::new();
        hash(&mut h, &self.pixels);
        Digest32(h.finalize().into())
    }

    /// The pixels in `format`.
    pub fn encode(&self, format: PixelFormat, background: Background) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.pixels.len() * format.bytes());
        Encoder::new(format, background).put(&self.pixels, &mut out);
        out
    }
}

/// A picture as it leaves the master.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Encoded {
    /// As [`Picture::sha256`]; `None` where nobody asked.
    pub sha256: Option<Digest32>,
    /// As [`Picture::encode`].
    pub bytes: Vec<u8>,
}

/// A picture that is encoded, and perhaps hashed, as its pixels come.
struct Encoding {
    hash: Option<Sha256>,
    encoder: Encoder,
    bytes: Vec<u8>,
}

impl Encoding {
    fn new(pixels: usize, finish: &Finish, hashed: bool) -> Encoding {
        let bytes = Vec::with_capacity(pixels * finish.format.bytes());
        let encoder = Encoder::new(finish.format, finish.background);
        Encoding { hash: hashed.then(Sha256::new), encoder, bytes }
    }

    fn put(&mut self, pixels: &[[f32; 4]]) {
        if let Some(h) = &mut self.hash {
            hash(h, pixels);
        }
        self.encoder.put(pixels, &mut self.bytes);
    }

    fn end(self) -> Encoded {
        let sha256 = self.hash.map(|h| Digest32(h.finalize().into()));
        Encoded { sha256, bytes: self.bytes }
    }
}

fn hash(h: &mut Sha256, pixels: &[[f32; 4]]) {
    if cfg!(target_endian = "little") {
        h.update(bytemuck::cast_slice::<[f32; 4], u8>(pixels));
    } else {
        pixels.iter().flatten().for_each(|x| h.update(x.to_le_bytes()));
    }
}

/// Pixels to bytes of a format, over a background.
pub(crate) struct Encoder {
    format: PixelFormat,
    /// The background's linear light.
    background: Option<[f64; 3]>,
}

impl Encoder {
    pub(crate) fn new(format: PixelFormat, background: Background) -> Encoder {
        let background = match background {
            Background::Colour(colour) => Some(colour.map(linear_from_srgb)),
            Background::Transparent => None,
        };
        Encoder { format, background }
    }

    pub(crate) fn put(&self, pixels: &[[f32; 4]], out: &mut Vec<u8>) {
        let first = out.len();
        out.resize(first + pixels.len() * self.format.bytes(), 0);
        let out = &mut out[first..];
        match self.format {
            PixelFormat::Rgb8 => self.each(pixels, out, |srgb, [r, g, b, _]| {
                [srgb.encode(r), srgb.encode(g), srgb.encode(b)]
            }),
            PixelFormat::Rgba8 => self.each(pixels, out, |srgb, [r, g, b, a]| {
                [srgb.encode(r), srgb.encode(g), srgb.encode(b), (a * 255.0 + 0.5) as u8]
            }),
            PixelFormat::Rgba16 => self.each(pixels, out, |_, [r, g, b, a]| {
                let to16 = |x: f64| ((x * 65535.0 + 0.5) as u16).to_le_bytes();
                let light = |c: f64| to16(srgb_from_linear(c));
                let [[r0, r1], [g0, g1], [b0, b1]] = [light(r), light(g), light(b)];
                let [a0, a1] = to16(a);
                [r0, r1, g0, g1, b0, b1, a0, a1]
            }),
            PixelFormat::Rgba32F => {
                for (to, x) in out.chunks_exact_mut(4).zip(pixels.iter().flatten()) {
                    to.copy_from_slice(&x.to_le_bytes());
                }
            }
        }
    }

    /// The same of rows of sums.
    pub(crate) fn put_sums<'a>(
        &self,
        rows: impl Iterator<Item = (&'a [f32], &'a [[u32; 3]])>,
        out: &mut Vec<u8>,
    ) {
        let black = self.background == Some([0.0; 3]);
        match self.format {
            PixelFormat::Rgb8 if black => over_black(rows, out, |rgb| rgb),
            PixelFormat::Rgba8 if black => over_black(rows, out, |[r, g, b]| [r, g, b, u8::MAX]),
            _ => {
                let mut pixels = Vec::with_capacity(LEAF * LEAF);
                for (a, colour) in rows {
                    pixels.extend(a.iter().zip(colour).map(|(&a, &colour)| finished(a, colour)));
                }
                self.put(&pixels, out);
            }
        }
    }

    #[inline(always)]
    fn each<const N: usize>(
        &self,
        pixels: &[[f32; 4]],
        out: &mut [u8],
        bytes: impl Fn(&Srgb8, [f64; 4]) -> [u8; N],
    ) {
        let srgb = Srgb8::get();
        let blank = bytes(srgb, self.over([0.0; 4]));
        for (to, &p) in out.as_chunks_mut::<N>().0.iter_mut().zip(pixels) {
            *to = if p == [0.0; 4] { blank } else { bytes(srgb, self.over(p)) };
        }
    }

    /// Linear light over the background, straight, and its alpha.
    #[inline(always)]
    fn over(&self, p: [f32; 4]) -> [f64; 4] {
        // f64 from here on: these are the last roundings of the picture. Channels one by one, since
        // `map` of an array is a call in builds without link-time optimisation.
        let [r, g, b, a] = [f64::from(p[0]), f64::from(p[1]), f64::from(p[2]), f64::from(p[3])];
        match self.background {
            Some(bg) => {
                let over = |c: f64, b: f64| (c + (1.0 - a) * b).clamp(0.0, 1.0);
                [over(r, bg[0]), over(g, bg[1]), over(b, bg[2]), 1.0]
            }
            None if a > 0.0 => {
                let straight = |c: f64| (c / a).clamp(0.0, 1.0);
                [straight(r), straight(g), straight(b), a]
            }
            None => [0.0; 4],
        }
    }
}

/// Rows of sums over black, of which nothing shines through: what is in front of it is all that there is.
fn over_black<'a, const N: usize>(
    rows: impl Iterator<Item = (&'a [f32], &'a [[u32; 3]])>,
    out: &mut Vec<u8>,
    bytes: impl Fn([u8; 3]) -> [u8; N],
) {
    let srgb = SumsSrgb8::get();
    for (_, colour) in rows {
        let first = out.len();
        out.resize(first + colour.len() * N, 0);
        let to = out[first..].as_chunks_mut::<N>().0;
        // All of many rows are empty, and that is seen four numbers at once.
        if colour.as_flattened().iter().fold(0, |any, sum| any | sum) == 0 {
            to.fill(bytes([0; 3]));
            continue;
        }
        for (to, &[r, g, b]) in to.iter_mut().zip(colour) {
            *to = bytes([srgb.encode(r), srgb.encode(g), srgb.encode(b)]);
        }
    }
}

/// Linear to 8-bit sRGB by thresholds: what rounding the formula gives, without its power.
struct Srgb8 {
    /// Linear value from which level `i + 1` is the nearest; none for level 256.
    thresholds: [f64; 256],
    /// The level at the beginning of each part of linear light; at most one threshold is in it. Part i is what
    /// rounds to `i / PARTS`; those beyond one are there so that no place needs to be checked.
    start: [u8; 2 * Srgb8::PARTS],
}

impl Srgb8 {
    /// The curve's steepest slope is 12.92, at black: 0.81 levels a part.
    const PARTS: usize = 4096;

    fn get() -> &'static Srgb8 {
        static TABLE: OnceLock<Srgb8> = OnceLock::new();
        TABLE.get_or_init(|| {
            let light = |i: usize| match i {
                255 => f64::INFINITY,
                i => linear_from_srgb((i as f64 + 0.5) / 255.0),
            };
            let thresholds: [f64; 256] = std::array::from_fn(light);
            let start = std::array::from_fn(|i| {
                let from = (i as f64 - 0.5) / Srgb8::PARTS as f64;
                thresholds.partition_point(|&t| t <= from) as u8
            });
            Srgb8 { thresholds, start }
        })
    }

    /// `linear` in `[0, 1]`.
    #[inline(always)]
    fn encode(&self, linear: f64) -> u8 {
        // From here on the last bit of a number is a one: what is added to it is rounded to a whole number,
        // which are its last bits. That is quicker than a conversion, which looks at what no number can hold.
        const WHOLE: f64 = (1u64 << 52) as f64;
        let part = (linear * Srgb8::PARTS as f64 + WHOLE).to_bits() as usize;
        let level = self.start[part % (2 * Srgb8::PARTS)];
        level + u8::from(self.thresholds[usize::from(level)] <= linear)
    }
}

/// [`Srgb8`] of sums in units of [`COLOUR_UNIT`], without a float: what [`finished`] rounds them to is in the thresholds.
/// Through floats three channels go in and out of a register together, which takes twice as long as looking them up.
struct SumsSrgb8 {
    /// The least sum of level `i + 1`; none for level 256.
    thresholds: [u32; 256],
    /// The level at the beginning of each part; at most one threshold is in it.
    start: [u8; SumsSrgb8::PARTS + 1],
}

impl SumsSrgb8 {
    const PARTS: usize = Srgb8::PARTS;
    /// Full intensity.
    const ONE: u32 = 1 << 28;

    fn get() -> &'static SumsSrgb8 {
        static TABLE: OnceLock<SumsSrgb8> = OnceLock::new();
        TABLE.get_or_init(|| {
            let start = std::array::from_fn(|i| {
                SumsSrgb8::level((i * (SumsSrgb8::ONE as usize / SumsSrgb8::PARTS)) as u32)
            });
            let threshold = |i: usize| {
                // No sum up to the first has that level, the second has.
                let (mut below, mut above) = (0, SumsSrgb8::ONE);
                while above - below > 1 {
                    let middle = below + (above - below) / 2;
                    let side = if usize::from(SumsSrgb8::level(middle)) > i {
                        &mut above
                    } else {
                        &mut below
                    };
                    *side = middle;
                }
                if i < 255 { above } else { u32::MAX }
            };
            SumsSrgb8 { thresholds: std::array::from_fn(threshold), start }
        })
    }

    /// By way of floats.
    fn level(sum: u32) -> u8 {
        let [light, ..] = finished(1.0, [sum; 3]);
        Srgb8::get().encode(f64::from(light).clamp(0.0, 1.0))
    }

    #[inline(always)]
    fn encode(&self, sum: u32) -> u8 {
        let sum = sum.min(SumsSrgb8::ONE);
        let level = self.start[sum as usize / (SumsSrgb8::ONE as usize / SumsSrgb8::PARTS)];
        level + u8::from(self.thresholds[usize::from(level)] <= sum)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_give_what_their_floats_do() {
        let s = SumsSrgb8::get();
        let near = |at: u32| [at.saturating_sub(1), at, at.saturating_add(1)];
        let parts = (0..=SumsSrgb8::PARTS as u32).map(|i| i << 16);
        let marks = s.thresholds.iter().copied().chain(parts).chain([SumsSrgb8::ONE, u32::MAX]);
        let even = (0..=1_000_000).map(|i| i * 270);
        for sum in marks.flat_map(near).chain(even) {
            assert_eq!(s.encode(sum), SumsSrgb8::level(sum), "{sum}");
        }
    }

    #[test]
    fn thresholds_give_what_the_formula_rounds_to() {
        let s = Srgb8::get();
        let even = (0..=100_000).map(|i| f64::from(i) / 100_000.0);
        let next = s.thresholds[..255].iter().flat_map(|t| [t.next_down(), *t, t.next_up()]);
        // Where parts have their middle and where one ends.
        let halves = 2 * Srgb8::PARTS;
        let parts = (0..=halves).map(|i| i as f64 / halves as f64);
        for l in parts.clone().chain(even) {
            let want = (srgb_from_linear(l) * 255.0 + 0.5).floor() as u8;
            assert_eq!(s.encode(l), want, "{l}");
        }
        for l in next.chain(parts) {
            assert_eq!(usize::from(s.encode(l)), s.thresholds.partition_point(|&t| t <= l), "{l}");
        }
    }

    #[test]
    fn a_frame_is_encoded_as_its_picture_is() {
        // Two portions and some, of every kind of pixel.
        let size = [90, 13];
        let mut f = FrameState::new(size);
        let (tile, mut x) = (Rect::new(7, 2, 83, 13), 7u32);
        let mut next = || {
            x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            x >> 4
        };
        let n = tile.area();
        let a: Vec<f32> = (0..n).map(|i| [0.0, 1.0, next() as f32 * COLOUR_UNIT][i % 3]).collect();
        let colour = a.iter().map(|a| [0; 3].map(|_: u32| (next() as f32 * a) as u32)).collect();
        let pixels = TilePixels { a, colour, last: None };
        f.put(tile, &pixels);
        let picture = f.finish();
        let mut laid = FrameState::new(size);
        laid.lay(tile, pixels.clone());
        assert_eq!(laid.finish(), picture);
        for format in
            [PixelFormat::Rgb8, PixelFormat::Rgba8, PixelFormat::Rgba16, PixelFormat::Rgba32F]
        {
            for background in [Background::Transparent, Background::Colour([0.2, 0.5, 1.0])] {
                let finish = Finish { format, background };
                let encoded = f.encode(&finish, true);
                assert_eq!(encoded, laid.encode(&finish, true));
                assert_eq!(encoded.sha256, Some(picture.sha256()));
                assert_eq!(encoded.bytes, picture.encode(format, background));
                assert_eq!(encoded.bytes.len(), picture.pixels.len() * format.bytes());
            }
        }
    }

    #[test]
    fn tiles_lie_where_they_belong_in_whatever_order_they_come() {
        let size = [7, 5];
        // Edges of 3: whole tiles and cut ones, and one that never came.
        let tiles: Vec<Rect> = [(0, 0), (3, 0), (6, 0), (0, 3), (6, 3)]
            .map(|(x, y)| Rect::new(x, y, (x + 3).min(7), (y + 3).min(5)))
            .into();
        let mark = |x: i32, y: i32| (1 + x + 7 * y) as f32;
        let pixels = |t: &Rect| TilePixels {
            a: (t.y0..t.y1).flat_map(|y| (t.x0..t.x1).map(move |x| mark(x, y))).collect(),
            colour: vec![[1 << 28; 3]; t.area()],
            last: None,
        };
        for order in [[0, 1, 2, 3, 4], [4, 3, 2, 1, 0], [2, 4, 0, 3, 1]] {
            let mut f = FrameState::new(size);
            order.iter().for_each(|&i| f.lay(tiles[i], pixels(&tiles[i])));
            let picture = f.finish();
            for (i, p) in picture.pixels.iter().enumerate() {
                let (x, y) = (i as i32 % 7, i as i32 / 7);
                let missing = (3..6).contains(&x) && y >= 3;
                let want = if missing { [0.0; 4] } else { [1.0, 1.0, 1.0, mark(x, y)] };
                assert_eq!(*p, want, "{x},{y}");
            }
        }
    }

    #[test]
    fn a_pixel_no_task_touched_has_no_last_sheet() {
        let mut f = FrameState::new([4, 2]);
        let tile = Rect::new(0, 0, 2, 2);
        let pixels = TilePixels {
            a: vec![0.5; 4],
            colour: vec![[1 << 27; 3]; 4],
            last: Some(vec![[7; 4]; 4]),
        };
        f.put(tile, &pixels);
        f.end_slab();
        assert_eq!(f.tile(tile).last, Some(vec![[7; 4]; 4]));
        f.end_slab();
        assert_eq!(f.tile(tile).last, None);
        assert_eq!(f.tile(tile).a, vec![0.5; 4]);
        f.put(tile, &pixels);
        assert_eq!(f.finish().pixels[0], [1.0, 1.0, 1.0, 0.5]);
        assert_eq!(f.finish().pixels[3], [0.0; 4]);
    }

    #[test]
    fn encodings_composite_over_the_background() {
        let p = Picture { size: [2, 1], pixels: vec![[0.25, 0.0, 0.0, 0.5], [0.0; 4]] };
        assert_eq!(p.encode(PixelFormat::Rgba8, Background::Transparent)[..4], [188, 0, 0, 128]);
        let over = p.encode(PixelFormat::Rgb8, Background::Colour([1.0, 1.0, 1.0]));
        assert_eq!(over, [225, 188, 188, 255, 255, 255]);
        assert_eq!(p.encode(PixelFormat::Rgba32F, Background::Transparent).len(), 32);
        assert_eq!(p.encode(PixelFormat::Rgba16, Background::Transparent).len(), 16);
    }
}
