//! What tiles took: the measured half of a prediction.
//!
//! A trace has, for each frame of a path, what each macrotile of each level took to draw on one
//! core, what its lease and its result weigh on the wire, and which pixels are shut after each
//! slab. With that the scheduler can run without anything being drawn: against virtual workers
//! (`slabcast_sim`), or against real ones that hold each tile for its time
//! (`slabcast worker --rehearse`). It refuses to know how the times were taken and what is made of
//! them.
//!
//! Times are those of one core that nothing else disturbs. Tiles that are drawn side by side on
//! one machine share its memory and may take longer; a trace does not know that.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use slabcast_common::image::TilePixels;
use slabcast_common::leaves::{Finish, LEAF, Leaves};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::Digest32;
use std::borrow::Cow;

mod course;

pub use course::{Course, Has, Sees};

/// Version of the format. Since 2 regions' results weigh what finished pixels do, since 3 their times have
/// no look at bricks in them, since 4 they say when they come to each brick, since 5 what messages take is in it, since 6
/// what packing results takes and saves.
pub const VERSION: u32 = 6;

/// Largest trace that is read, in bytes: 1000 frames with tiles of 16 pixels.
pub const MAX_BYTES: u64 = 1 << 30;

/// A path's tiles.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trace {
    /// [`VERSION`].
    pub version: u32,
    /// What was drawn.
    pub about: About,
    /// Its frames, in the order of the path.
    pub frames: Vec<FrameTrace>,
}

/// What traces of all versions have.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

/// What a trace is of.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct About {
    /// The volume's name, for people.
    pub volume: String,
    /// Transfer function, for people.
    pub transfer: String,
    /// Instruction set of the splat loops.
    pub simd: String,
    /// `PIXELS_VERSION` of the program that drew.
    pub pixels_version: u32,
    /// Version of the program.
    pub program: String,
    /// Width and height.
    pub size: [u32; 2],
    /// Slabs that a frame is cut into.
    pub slabs: u32,
    /// How often each tile was drawn; the shortest time counts.
    pub repeats: u32,
    /// What messages take there; of a machine that does not say it nothing.
    pub pings: Option<Pings>,
    /// What packing its regions' results takes there.
    pub packing: Packing,
}

/// What lz4 takes of a processor for a byte of finished pixels, in nanoseconds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Packing {
    /// A worker, to pack it.
    pub pack_ns: f64,
    /// The master, to unpack it.
    pub unpack_ns: f64,
}

/// What a ping and its pong take of the processors, between a real master and real workers that TCP joins on one machine, in
/// nanoseconds: the master's driver, the master's streams, the worker.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pings {
    /// Of a worker by itself: everybody on the way is woken.
    pub alone_ns: [u64; 3],
    /// In company, where many are pinged at once: next to nobody is.
    pub company_ns: [u64; 3],
}

/// One frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameTrace {
    /// [`view_sha256`] of its scene and view, in hexadecimal.
    pub view: String,
    /// Tables that each worker makes once a frame, in nanoseconds.
    pub setup_ns: u64,
    /// Sum of the times of its best cut on one core through all depths, tables included, in
    /// nanoseconds: what more workers are compared with.
    pub alone_ns: u64,
    /// Edge of the tiles of that cut.
    pub alone_edge: u32,
    /// Its slabs, front to back: for the `slab` schedule.
    pub slabs: Vec<SlabTrace>,
    /// To look at the directory's blocks of bricks, which each worker does once a frame under the `region`
    /// schedule, in nanoseconds.
    #[serde(default)]
    pub outlook_ns: u64,
    /// To look at one block's bricks, in nanoseconds: a mean. A worker does so for each block that its
    /// tiles open, once a frame.
    #[serde(default)]
    pub block_ns: u64,
    /// Tiles through all depths: for the `region` schedule.
    #[serde(default)]
    pub regions: Vec<RegionLevel>,
}

/// One slab.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlabTrace {
    /// First sheet.
    pub first: i32,
    /// One past its last sheet.
    pub end: i32,
    /// Lengths of runs of open and shut pixels in turn, the open ones first, row-major over the
    /// picture: how the slab leaves them. What is beyond the last run is open.
    pub shut: Vec<u32>,
    /// Levels of the quadtree that were drawn.
    pub levels: Vec<Level>,
}

/// Tiles of one edge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Level {
    /// Edge in pixels.
    pub edge: u32,
    /// Those that are drawn, by row and column.
    pub tiles: Vec<TileTrace>,
}

/// Tiles of one edge through all depths.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionLevel {
    /// Edge in pixels.
    pub edge: u32,
    /// Those that anything lies in, by row and column.
    pub tiles: Vec<RegionTile>,
}

/// A tile as it is written: places as differences to the one before.
type Written = (u32, u32, u64, [u32; 2], Vec<u32>, Vec<u32>, Vec<u16>, Vec<u32>);

/// One tile through all depths: `[x, y, ns, [result bytes, plain bytes], touched, opened, needed, expected]`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "Written", into = "Written")]
pub struct RegionTile {
    /// Left column.
    pub x: u32,
    /// Top row.
    pub y: u32,
    /// Time to draw it where its blocks were looked at before, in nanoseconds.
    pub ns: u64,
    /// Its result on the wire, as finished pixels that are packed.
    pub result_bytes: u32,
    /// The same if they are not.
    pub plain_bytes: u32,
    /// Places of the bricks that it is drawn from, in the list of the set's bricks; ascending.
    pub touched: Vec<u32>,
    /// Numbers of the blocks whose bricks it looks at, front to back in its frame; ascending.
    pub opened: Vec<u32>,
    /// Of a tile of one part: when drawing comes to each of its bricks, in thousandths of its time. Of others their
    /// parts say it, which are tiles themselves; where nobody does, all are needed at once.
    pub needed: Vec<u16>,
    /// Places of the bricks that who drew the frame before would ask for beforehand (`render::depths`), if he had none;
    /// ascending.
    pub expected: Vec<u32>,
}

impl RegionTile {
    /// Its result on the wire.
    pub fn bytes(&self, plain: bool) -> u32 {
        if plain { self.plain_bytes } else { self.result_bytes }
    }
}

impl From<Written> for RegionTile {
    fn from(written: Written) -> Self {
        let (x, y, ns, bytes, mut touched, mut opened, needed, mut expected) = written;
        let [result_bytes, plain_bytes] = bytes;
        for places in [&mut touched, &mut opened, &mut expected] {
            for i in 1..places.len() {
                places[i] = places[i].saturating_add(places[i - 1]);
            }
        }
        RegionTile { x, y, ns, result_bytes, plain_bytes, touched, opened, needed, expected }
    }
}

impl From<RegionTile> for Written {
    fn from(t: RegionTile) -> Self {
        let RegionTile { x, y, ns, result_bytes, plain_bytes, .. } = t;
        let RegionTile { mut touched, mut opened, needed, mut expected, .. } = t;
        for places in [&mut touched, &mut opened, &mut expected] {
            for i in (1..places.len()).rev() {
                places[i] -= places[i - 1];
            }
        }
        (x, y, ns, [result_bytes, plain_bytes], touched, opened, needed, expected)
    }
}

/// One tile: `[x, y, ns, lease bytes, result bytes]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[u64; 5]", into = "[u64; 5]")]
pub struct TileTrace {
    /// Left column.
    pub x: u32,
    /// Top row.
    pub y: u32,
    /// Time to draw it, in nanoseconds.
    pub ns: u64,
    /// Its lease on the wire.
    pub lease_bytes: u32,
    /// Its result on the wire.
    pub result_bytes: u32,
}

impl From<[u64; 5]> for TileTrace {
    fn from([x, y, ns, lease, result]: [u64; 5]) -> Self {
        let n = |n: u64| u32::try_from(n).unwrap_or(u32::MAX);
        TileTrace { x: n(x), y: n(y), ns, lease_bytes: n(lease), result_bytes: n(result) }
    }
}

impl From<TileTrace> for [u64; 5] {
    fn from(t: TileTrace) -> Self {
        [t.x.into(), t.y.into(), t.ns, t.lease_bytes.into(), t.result_bytes.into()]
    }
}

/// Why text is no trace.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct NoTrace(String);

impl Trace {
    /// Reads one.
    ///
    /// # Errors
    /// What is wrong with it, and the remedy.
    pub fn from_json(bytes: &[u8]) -> Result<Trace, NoTrace> {
        let no = |why: String| Err(NoTrace(why));
        let other = |version: u32| {
            no(format!(
                "is a trace of version {version}, this program reads {VERSION}; measure it again"
            ))
        };
        let trace: Trace = match serde_json::from_slice(bytes) {
            Ok(trace) => trace,
            // One of another version may have tiles of other lengths.
            Err(e) => match serde_json::from_slice::<Versioned>(bytes) {
                Ok(Versioned { version }) if version != VERSION => return other(version),
                _ => {
                    return no(format!("is no trace: {e}; give a file of `slabcast plan --trace`"));
                }
            },
        };
        if trace.version != VERSION {
            return other(trace.version);
        }
        if trace.about.pixels_version != slabcast_common::PIXELS_VERSION {
            return no(format!(
                "was measured with pixels of version {}, this program draws {}; measure it again",
                trace.about.pixels_version,
                slabcast_common::PIXELS_VERSION
            ));
        }
        let [w, h] = trace.about.size;
        if !(1..=8192).contains(&w) || !(1..=8192).contains(&h) {
            return no(format!("about.size: {w}x{h} is no size of a picture"));
        }
        let pings = trace.about.pings.iter().flat_map(|p| [p.alone_ns, p.company_ns]).flatten();
        if pings.max() > Some(1_000_000_000) {
            return no("about.pings: one takes longer than a second".into());
        }
        let Packing { pack_ns, unpack_ns } = trace.about.packing;
        if ![pack_ns, unpack_ns].iter().all(|ns| (0.0..=1e6).contains(ns)) {
            return no("about.packing: no time of a byte".into());
        }
        let pixels = u64::from(w) * u64::from(h);
        for (i, frame) in trace.frames.iter().enumerate() {
            // A minute for each is beyond any tile; sums of a million stay far inside 64 bits.
            const LONG: u64 = 60_000_000_000;
            let times = frame.slabs.iter().flat_map(|s| &s.levels).flat_map(|l| &l.tiles);
            let through = frame.regions.iter().flat_map(|l| &l.tiles).map(|t| t.ns);
            let setup = [frame.setup_ns, frame.outlook_ns, frame.block_ns];
            if times.map(|t| t.ns).chain(through).chain(setup).any(|ns| ns > LONG) {
                return no(format!("frames[{i}]: a time is longer than a minute"));
            }
            if frame.regions.iter().any(|l| !l.tiles.is_sorted_by_key(|t| (t.y, t.x))) {
                return no(format!("frames[{i}].regions: tiles are not by row and column"));
            }
            let tiles = || frame.regions.iter().flat_map(|l| &l.tiles);
            if tiles().any(|t| !t.needed.is_empty() && t.needed.len() != t.touched.len()) {
                return no(format!("frames[{i}].regions: not every brick says when it is needed"));
            }
            for (s, slab) in frame.slabs.iter().enumerate() {
                if slab.shut.iter().map(|r| u64::from(*r)).sum::<u64>() > pixels {
                    return no(format!("frames[{i}].slabs[{s}].shut: more pixels than {w}x{h}"));
                }
                let level =
                    slab.levels.iter().find(|l| !matches!(l.edge, 16 | 32 | 64 | 128 | 256));
                if let Some(level) = level {
                    return no(format!(
                        "frames[{i}].slabs[{s}]: {} is no edge of a macrotile",
                        level.edge
                    ));
                }
                if slab.levels.iter().any(|l| !l.tiles.is_sorted_by_key(|t| (t.y, t.x))) {
                    return no(format!("frames[{i}].slabs[{s}]: tiles are not by row and column"));
                }
            }
        }
        Ok(trace)
    }

    /// Writes one.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("plain numbers and texts")
    }

    /// The frame with this view.
    pub fn frame(&self, view: &Digest32) -> Option<&FrameTrace> {
        let name = view.to_string();
        self.frames.iter().find(|f| f.view == name)
    }
}

impl FrameTrace {
    /// The slab that begins at these sheets.
    pub fn slab(&self, sheets: SheetRange) -> Option<&SlabTrace> {
        self.slabs.iter().find(|s| s.first == sheets.first && s.end == sheets.end)
    }

    /// What is known of a tile through all depths; one that nothing lies in takes no time. `size` is
    /// the picture's.
    pub fn region(&self, rect: &Rect, size: [u32; 2]) -> Option<Cow<'_, RegionTile>> {
        self.regions.iter().find_map(|level| {
            if !is_of(rect, level.edge, size) {
                return None;
            }
            let (x, y) = (rect.x0 as u32, rect.y0 as u32);
            Some(match level.tiles.binary_search_by_key(&(y, x), |t| (t.y, t.x)) {
                Ok(at) => Cow::Borrowed(&level.tiles[at]),
                Err(_) => {
                    let (result_bytes, plain_bytes) = (40, 40);
                    let tile =
                        RegionTile { x, y, result_bytes, plain_bytes, ..RegionTile::default() };
                    Cow::Owned(tile)
                }
            })
        })
    }
}

/// Whether a rectangle is a tile of this edge, cut at the picture's border.
fn is_of(rect: &Rect, edge: u32, size: [u32; 2]) -> bool {
    let edge = edge as i32;
    let whole = Rect::new(rect.x0, rect.y0, rect.x0 + edge, rect.y0 + edge);
    let cut = whole.intersect(&Rect::of_size(size));
    cut == *rect && rect.x0 % edge == 0 && rect.y0 % edge == 0
}

impl SlabTrace {
    /// What is known of a tile; `size` is the picture's.
    pub fn tile(&self, rect: &Rect, size: [u32; 2]) -> Option<&TileTrace> {
        self.levels.iter().find_map(|level| {
            if !is_of(rect, level.edge, size) {
                return None;
            }
            let key = (rect.y0 as u32, rect.x0 as u32);
            let at = level.tiles.binary_search_by_key(&key, |t| (t.y, t.x)).ok()?;
            Some(&level.tiles[at])
        })
    }

    /// Which pixels are shut behind the slab, row-major over a picture of this size.
    pub fn shut(&self, size: [u32; 2]) -> Vec<bool> {
        let n = size[0] as usize * size[1] as usize;
        let (mut bits, mut at) = (Vec::with_capacity(n), false);
        for &run in &self.shut {
            bits.resize((bits.len() + run as usize).min(n), at);
            at = !at;
        }
        bits.resize(n, false);
        bits
    }

    /// The runs of [`SlabTrace::shut`].
    pub fn runs(bits: impl IntoIterator<Item = bool>) -> Vec<u32> {
        let (mut runs, mut at, mut run) = (Vec::new(), false, 0);
        for bit in bits {
            if bit != at {
                runs.push(run);
                (at, run) = (bit, 0);
            }
            run += 1;
        }
        if at {
            runs.push(run);
        }
        runs
    }
}

/// Pixels for a result of a tile that was not drawn: shut where it would have left them shut, and
/// otherwise so filled that it weighs about `bytes` on the wire. Nobody may take them for a
/// picture's.
pub fn filled(rect: &Rect, shut: &[bool], size: [u32; 2], bytes: u32) -> TilePixels {
    let n = rect.area();
    let mut pixels = TilePixels { a: Vec::with_capacity(n), colour: vec![[0; 3]; n], last: None };
    for y in rect.y0..rect.y1 {
        let row = y as usize * size[0] as usize;
        for x in rect.x0..rect.x1 {
            pixels.a.push(if shut[row + x as usize] { 1.0 } else { 0.0 });
        }
    }
    let closed = pixels.a.iter().filter(|a| **a > 0.0).count();
    // Planes leave out pixels that are zero, at a bit a pixel: 4, 12 and 16 bytes for those that
    // are not. Colour and sums go together, which is what a slab in the middle does.
    let left = (bytes as usize).saturating_sub(60 + 3 * n.div_ceil(8) + 4 * closed);
    let touched = (left / 28).min(n);
    // Open pixels with some opacity come first, so that all three planes have the same pixels.
    let extra = left.saturating_sub(28 * touched);
    let open = pixels.a.iter_mut().filter(|a| **a == 0.0);
    for a in open.take(extra / 4) {
        *a = 0.25;
    }
    let mut last = vec![[0; 4]; if touched > 0 { n } else { 0 }];
    for i in 0..touched {
        let word = (i as u32).wrapping_mul(0x9e37_79b9) | 1;
        pixels.colour[i] = [word & 0xffff | 1; 3];
        last[i] = [word; 4];
    }
    pixels.last = (touched > 0).then_some(last);
    pixels
}

/// Pixels for a result of a tile through all depths that was not drawn: they weigh about `bytes` on the
/// wire. Nobody may take them for a picture's.
pub fn filled_through(rect: &Rect, bytes: u32) -> TilePixels {
    let n = rect.area();
    let mut pixels = TilePixels { a: vec![0.0; n], colour: vec![[0; 3]; n], last: None };
    // Two planes of 4 and 12 bytes a pixel, and a bit for each pixel of both.
    let left = (bytes as usize).saturating_sub(60 + 2 * n.div_ceil(8));
    for i in 0..(left / 16).min(n) {
        let word = (i as u32).wrapping_mul(0x9e37_79b9) & 0xffff | 1;
        pixels.a[i] = 0.25 + word as f32 * 1e-6;
        pixels.colour[i] = [word; 3];
    }
    pixels
}

/// The same of a result of finished pixels.
///
/// Leaves come one after the other until they weigh enough; their bytes have no pattern, so that nothing
/// packs them, and the rest of the last leaf is zeros, which pack to nearly nothing.
pub fn finished_through(rect: &Rect, bytes: u32, finish: &Finish) -> Leaves {
    let size = [rect.width() as u32, rect.height() as u32];
    let mut leaves = Leaves::blank(size, finish.format);
    let left = (bytes as usize).saturating_sub(70 + leaves.mask.len());
    let columns = (size[0] as usize).div_ceil(LEAF);
    for i in 0..columns * (size[1] as usize).div_ceil(LEAF) {
        if Leaves::data_len(size, finish.format, &leaves.mask) >= left {
            break;
        }
        leaves.mask[i / 8] |= 1 << (i % 8);
    }
    let mut x = 0x9e37_79b9_7f4a_7c15u64;
    let noise = std::iter::repeat_with(|| {
        x ^= x << 13;
        x ^= x >> 7;
        x ^= x << 17;
        (x >> 32) as u8
    });
    leaves.data.extend(noise.take(left));
    leaves.data.resize(Leaves::data_len(size, finish.format, &leaves.mask), 0);
    leaves.alpha_most = if left > 0 { 0.25 } else { 0.0 };
    leaves
}

/// What a frame's times hang on: transfer function, quality and view. (Not the hash in a frame's
/// statistics, which knows the cropping box and not whether culling is on.)
pub fn view_sha256(scene: &SceneSpec, view: &View) -> Digest32 {
    let mut h = Sha256::new();
    h.update(b"slabcast trace 1");
    h.update(scene.volume.digest.0);
    h.update(scene.bricks.0.0);
    h.update(scene.transfer.to_json());
    h.update(serde_json::to_string(&scene.quality).unwrap_or_default());
    h.update(view.size[0].to_le_bytes());
    h.update(view.size[1].to_le_bytes());
    let projection = match view.projection {
        Projection::Ortho { scale } => [0.0, scale, 0.0],
        Projection::Persp { focal, distance } => [1.0, focal, distance],
    };
    let numbers = view
        .eye_from_index
        .to_cols_array()
        .into_iter()
        .chain(view.eye_origin.to_array())
        .chain(projection)
        .chain([view.thickness, view.cell]);
    for x in numbers {
        h.update(x.to_le_bytes());
    }
    Digest32(h.finalize().into())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn trace() -> Trace {
        let tile = |x, y, ns| TileTrace { x, y, ns, lease_bytes: 300, result_bytes: 16_000 };
        let levels = vec![
            Level { edge: 64, tiles: vec![tile(0, 0, 500), tile(64, 0, 700), tile(0, 64, 3)] },
            Level { edge: 128, tiles: vec![tile(0, 0, 900)] },
        ];
        let shut = SlabTrace::runs((0..100 * 70).map(|i| i % 100 > 40 && i % 3 > 0));
        let slabs = vec![SlabTrace { first: -5, end: 9, shut, levels }];
        Trace {
            version: VERSION,
            about: About {
                volume: "head".into(),
                transfer: "bone".into(),
                simd: "avx2".into(),
                pixels_version: slabcast_common::PIXELS_VERSION,
                program: "0.1.0".into(),
                size: [100, 70],
                slabs: 1,
                repeats: 2,
                pings: Some(Pings { alone_ns: [9, 21, 20], company_ns: [1, 5, 4] }),
                packing: Packing { pack_ns: 1.5, unpack_ns: 0.25 },
            },
            frames: vec![FrameTrace {
                view: Digest32([7; 32]).to_string(),
                setup_ns: 10,
                alone_ns: 800,
                alone_edge: 128,
                slabs,
                outlook_ns: 40,
                block_ns: 3,
                regions: vec![RegionLevel {
                    edge: 64,
                    tiles: vec![
                        RegionTile {
                            x: 0,
                            y: 0,
                            ns: 1500,
                            result_bytes: 900,
                            plain_bytes: 1200,
                            touched: vec![3, 4, 70],
                            opened: vec![0, 9],
                            needed: vec![0, 250, 40],
                            expected: vec![2, 3, 71],
                        },
                        RegionTile { x: 64, ns: 7, result_bytes: 40, ..RegionTile::default() },
                    ],
                }],
            }],
        }
    }

    #[test]
    fn a_trace_comes_back_and_knows_its_tiles() {
        let trace = trace();
        assert_eq!(Trace::from_json(trace.to_json().as_bytes()), Ok(trace.clone()));
        let frame = trace.frame(&Digest32([7; 32])).expect("it is there");
        assert!(trace.frame(&Digest32([8; 32])).is_none());
        let slab = frame.slab(SheetRange::new(-5, 9)).expect("it is there");
        assert!(frame.slab(SheetRange::new(-5, 8)).is_none());
        let ns = |x0, y0, x1, y1| slab.tile(&Rect::new(x0, y0, x1, y1), [100, 70]).map(|t| t.ns);
        assert_eq!(ns(0, 0, 64, 64), Some(500));
        // Cut by the picture's border.
        assert_eq!(ns(64, 0, 100, 64), Some(700));
        assert_eq!(ns(0, 64, 64, 70), Some(3));
        assert_eq!(ns(0, 0, 100, 70), Some(900));
        assert_eq!(ns(64, 64, 100, 70), None, "it is empty");
        assert_eq!(ns(0, 0, 63, 64), None);
        let region = |x0, y0, x1, y1| frame.region(&Rect::new(x0, y0, x1, y1), [100, 70]);
        let tile = region(0, 0, 64, 64).expect("it is there");
        assert_eq!((tile.bytes(false), tile.bytes(true)), (900, 1200));
        assert_eq!(tile.touched, [3, 4, 70]);
        assert_eq!(region(64, 0, 100, 64).expect("it is there").ns, 7);
        assert_eq!(region(0, 64, 64, 70).expect("nothing lies in it").ns, 0);
        assert!(region(0, 0, 100, 70).is_none(), "a level that was not drawn");
    }

    #[test]
    fn shut_pixels_come_back_from_runs() {
        let slab = &trace().frames[0].slabs[0];
        let bits = slab.shut([100, 70]);
        assert_eq!(bits.len(), 7000);
        assert!((0..7000).all(|i| bits[i] == (i % 100 > 40 && i % 3 > 0)));
        assert_eq!(SlabTrace::runs([false; 9]), [0u32; 0]);
    }

    #[test]
    fn what_is_no_trace_is_refused_in_words() {
        let says = |text: &str| Trace::from_json(text.as_bytes()).unwrap_err().to_string();
        let good = trace().to_json();
        assert!(says("{}").contains("slabcast plan --trace"));
        assert!(says(&good.replacen("\"version\":6", "\"version\":7", 1)).contains("version 7"));
        let old = good.replace("\"version\":6", "\"version\":3").replace(",[2,1,68]]", "]");
        assert!(old.len() < good.len() && says(&old).contains("version 3"), "{old}");
        assert!(says(&good.replace(",[2,1,68]]", "]")).contains("invalid length"));
        assert!(says(&good.replace("[100,70]", "[100,0]")).starts_with("about.size"));
        assert!(says(&good.replace("[9,21,20]", "[9,2000000000,20]")).starts_with("about.pings"));
        assert!(
            says(&good.replace("\"pack_ns\":1.5", "\"pack_ns\":-1.5")).starts_with("about.packing")
        );
        assert!(says(&good.replace("[100,70]", "[10,7]")).contains("more pixels"));
        assert!(says(&good.replace("\"edge\":64", "\"edge\":65")).contains("65 is no edge"));
        assert!(says(&good.replace("[64,0,700", "[64,99,700")).contains("by row and column"));
        assert!(says(&good.replace("[0,250,40]", "[0,250]")).contains("when it is needed"));
        let pixels = format!("\"pixels_version\":{}", slabcast_common::PIXELS_VERSION);
        assert!(says(&good.replace(&pixels, "\"pixels_version\":0")).contains("measure it again"));
    }

    #[test]
    fn filled_pixels_are_shut_where_they_were() {
        let slab = &trace().frames[0].slabs[0];
        let (rect, size) = (Rect::new(64, 0, 100, 64), [100, 70]);
        let shut = slab.shut(size);
        let pixels = filled(&rect, &shut, size, 30_000);
        for (i, a) in pixels.a.iter().enumerate() {
            let (x, y) = (64 + i % 36, i / 36);
            assert_eq!(*a == 1.0, shut[y * 100 + x]);
        }
        assert_eq!((pixels.a.len(), pixels.colour.len()), (2304, 2304));
        assert!(filled(&rect, &shut, size, 0).last.is_none());
    }

    #[test]
    fn finished_pixels_that_nobody_drew_fit_their_tile() {
        use slabcast_common::image::{Background, PixelFormat};
        for format in [PixelFormat::Rgb8, PixelFormat::Rgba32F] {
            let finish = Finish { format, background: Background::Transparent };
            for (w, h) in [(64, 64), (37, 5)] {
                let rect = Rect::new(100, 0, 100 + w, h);
                for bytes in [0, 60, 100, 3_000, 12_000, 10_000_000] {
                    let leaves = finished_through(&rect, bytes, &finish);
                    assert_eq!(leaves.check(), Ok(()));
                    assert_eq!(leaves.pixels(), rect.area());
                    let all = rect.area() * format.bytes();
                    let leaf = LEAF * LEAF * format.bytes();
                    let most = (bytes as usize + leaf).min(all);
                    assert!(leaves.data.len() <= most, "{} of {bytes}", leaves.data.len());
                    assert!(leaves.data.len() + 80 >= all.min(bytes as usize));
                }
            }
        }
    }
}
