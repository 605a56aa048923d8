//! A recorded path: what each of its tiles took to draw.
//!
//! A [`Trace`] has, for each frame of a path, what each macrotile of each size took on one core,
//! what its lease and its result weigh on the wire, and which pixels are shut after each slab. With
//! it the scheduler runs without anything being drawn: against virtual workers (`slabcast-sim`), or
//! against real ones that hold each tile for its time (`slabcast worker --rehearse`).
//! [`RegionProgress`] says how far a worker comes through a recorded tile with the bricks it holds,
//! and the `placeholder` functions make results of the recorded size.
//!
//! This crate refuses to know how times were measured, who holds which bricks and what time it is.
//!
//! Times are those of one core that nothing else disturbs. Tiles that are drawn side by side on one
//! machine share its memory and may take longer; a trace does not know that.

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use slabcast_common::message::SceneSpec;
use slabcast_common::occlusion::Rect;
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::Digest32;
use std::borrow::Cow;

mod placeholder;
mod progress;
mod read;

pub use placeholder::{placeholder_finished, placeholder_slab, placeholder_sums};
pub use progress::{HasBrick, ProjectBrick, RegionProgress};
pub use read::TraceError;

/// Version of the file format. Version 2 weighs regions' results as finished pixels, 3 takes the
/// look at bricks out of tiles' times, 4 says when drawing comes to each brick, 5 has what messages
/// take, 6 what packing results takes and saves.
pub const VERSION: u32 = 6;

/// Largest trace that is read, in bytes: 1000 frames with tiles of 16 pixels.
pub const MAX_BYTES: u64 = 1 << 30;

/// A recorded path: one [`FrameTrace`] a frame, and the scene, machine and program behind them.
///
/// Read one with [`Trace::from_json`], write it with [`Trace::to_json`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Trace {
    /// Version of the file's format; a program reads [`VERSION`] alone.
    pub version: u32,
    /// Scene, machine and program that were recorded.
    pub about: About,
    /// Frames in the order of the path.
    pub frames: Vec<FrameTrace>,
}

/// Scene, machine and program of a [`Trace`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct About {
    /// Name of the volume, for people.
    pub volume: String,
    /// Name of the transfer function, for people.
    pub transfer: String,
    /// Instruction set of the splat loops.
    pub simd: String,
    /// Version of the pixels, `PIXELS_VERSION`, of the program that drew.
    pub pixels_version: u32,
    /// Version of the program that drew.
    pub program: String,
    /// Width and height of the frames, in pixels.
    pub size: [u32; 2],
    /// Slabs that a frame is cut into.
    pub slabs: u32,
    /// Times each tile was drawn; the shortest time counts.
    pub repeats: u32,
    /// Processor time of a ping on the recording machine; `None` if it was not measured.
    pub pings: Option<Pings>,
    /// Processor time of packing regions' results on the recording machine.
    pub packing: Packing,
}

/// Processor time of lz4 for a byte of finished pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Packing {
    /// Nanoseconds that a worker takes to pack a byte.
    pub pack_ns: f64,
    /// Nanoseconds that the master takes to unpack a byte.
    pub unpack_ns: f64,
}

/// Processor time of a ping and its pong between a master and workers that TCP joins on one
/// machine.
///
/// Each field lists the master's driver, the master's streams and the worker, in nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Pings {
    /// Nanoseconds of a ping while one worker is pinged, so that every thread on the way has to be
    /// woken: the master's driver, the master's streams, the worker.
    pub alone_ns: [u64; 3],
    /// Nanoseconds of a ping while many workers are pinged at once, so that hardly any thread has
    /// to be woken: the master's driver, the master's streams, the worker.
    pub company_ns: [u64; 3],
}

/// Times of one recorded frame: tables, slabs and regions.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameTrace {
    /// [`view_sha256`] of the frame's scene and view, in hexadecimal.
    pub view: String,
    /// Nanoseconds of the tables that each worker makes once a frame.
    pub setup_ns: u64,
    /// Nanoseconds of the whole frame on one core in its best cut, tables included: the basis for
    /// the speed-up of more workers.
    pub alone_ns: u64,
    /// Edge in pixels of the tiles in the cut of `alone_ns`.
    pub alone_edge: u32,
    /// Slabs, front to back: for the `slab` schedule.
    pub slabs: Vec<SlabTrace>,
    /// Nanoseconds each worker takes once a frame to look at the directory's blocks of bricks,
    /// under the `region` schedule.
    #[serde(default)]
    pub outlook_ns: u64,
    /// Mean nanoseconds to look at the bricks of one block, which a worker does once a frame for
    /// each block that its tiles open.
    #[serde(default)]
    pub block_ns: u64,
    /// Tiles through all sheets, by size: for the `region` schedule.
    #[serde(default)]
    pub regions: Vec<RegionLevel>,
}

/// One slab of a recorded frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SlabTrace {
    /// Number of the slab's first sheet.
    pub first: i32,
    /// Number one past the slab's last sheet.
    pub end: i32,
    /// Pixels behind the slab as run lengths, row-major over the picture: open, shut, open and so
    /// on. Pixels beyond the last run are open.
    pub shut: Vec<u32>,
    /// Tiles of the slab, grouped by size.
    pub levels: Vec<Level>,
}

/// Tiles of one size in a slab.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Level {
    /// Edge in pixels: 16, 32, 64, 128 or 256.
    pub edge: u32,
    /// Tiles with something to draw, by row and column.
    pub tiles: Vec<TileTrace>,
}

/// Tiles of one size through all sheets.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RegionLevel {
    /// Edge of the tiles in pixels, before the picture clips them.
    pub edge: u32,
    /// Tiles with something to draw in them, by row and column.
    pub tiles: Vec<RegionTile>,
}

/// A [`RegionTile`] in a file: lists of places and blocks hold differences to the entry before.
type WrittenRegionTile = (u32, u32, u64, [u32; 2], Vec<u32>, Vec<u32>, Vec<u16>, Vec<u32>);

/// A tile through all sheets. A *place* is an index into the brick list of the frame's set.
///
/// In a file it is `[x, y, ns, [result bytes, plain bytes], touched, opened, needed, expected]`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "WrittenRegionTile", into = "WrittenRegionTile")]
pub struct RegionTile {
    /// Left column of the tile, in pixels of the picture.
    pub x: u32,
    /// Top row of the tile, in pixels of the picture.
    pub y: u32,
    /// Nanoseconds to draw the tile once its blocks of bricks are known.
    pub ns: u64,
    /// Bytes of the tile's result on the wire: finished pixels, packed.
    pub result_bytes: u32,
    /// Bytes of the tile's result on the wire: finished pixels, not packed.
    pub plain_bytes: u32,
    /// Places of the bricks that the tile is drawn from, ascending.
    pub touched: Vec<u32>,
    /// Numbers of the blocks whose bricks the tile looks at, ascending; blocks are numbered front
    /// to back.
    pub opened: Vec<u32>,
    /// Moment at which drawing comes to each brick of `touched`, in thousandths of the tile's
    /// drawing time. Only tiles of one part have moments; larger tiles take them from their parts.
    /// Empty: all bricks are needed at once.
    pub needed: Vec<u16>,
    /// Places of the bricks that a worker without any would prefetch for the tile, judging by the
    /// frame before; ascending.
    pub expected: Vec<u32>,
}

impl RegionTile {
    /// Returns the bytes of the tile's result on the wire, `plain` or packed.
    pub fn wire_bytes(&self, plain: bool) -> u32 {
        if plain { self.plain_bytes } else { self.result_bytes }
    }
}

impl From<WrittenRegionTile> for RegionTile {
    fn from(written: WrittenRegionTile) -> Self {
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

impl From<RegionTile> for WrittenRegionTile {
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

/// A tile of one slab. In a file it is `[x, y, ns, lease bytes, result bytes]`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(from = "[u64; 5]", into = "[u64; 5]")]
pub struct TileTrace {
    /// Left column of the tile, in pixels of the picture.
    pub x: u32,
    /// Top row of the tile, in pixels of the picture.
    pub y: u32,
    /// Nanoseconds to draw the tile.
    pub ns: u64,
    /// Bytes of the tile's lease on the wire.
    pub lease_bytes: u32,
    /// Bytes of the tile's result on the wire.
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

impl Trace {
    /// Returns the frame with this [`view_sha256`], if it was recorded.
    pub fn frame(&self, view: &Digest32) -> Option<&FrameTrace> {
        let name = view.to_string();
        self.frames.iter().find(|f| f.view == name)
    }
}

impl FrameTrace {
    /// Returns the slab of these sheets, if the frame was cut there.
    pub fn slab(&self, sheets: SheetRange) -> Option<&SlabTrace> {
        self.slabs.iter().find(|s| s.first == sheets.first && s.end == sheets.end)
    }

    /// Returns what was recorded of a tile through all sheets in a picture of `size` pixels. A tile
    /// with nothing in it takes no time. `None`: no tile of this size was recorded there.
    pub fn region(&self, rect: &Rect, size: [u32; 2]) -> Option<Cow<'_, RegionTile>> {
        self.regions.iter().find_map(|level| {
            if !is_tile(rect, level.edge, size) {
                return None;
            }
            let (x, y) = (rect.x0 as u32, rect.y0 as u32);
            Some(match level.tiles.binary_search_by_key(&(y, x), |t| (t.y, t.x)) {
                Ok(i) => Cow::Borrowed(&level.tiles[i]),
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
fn is_tile(rect: &Rect, edge: u32, size: [u32; 2]) -> bool {
    let edge = edge as i32;
    let whole = Rect::new(rect.x0, rect.y0, rect.x0 + edge, rect.y0 + edge);
    let cut = whole.intersect(&Rect::from_size(size));
    cut == *rect && rect.x0 % edge == 0 && rect.y0 % edge == 0
}

impl SlabTrace {
    /// Returns what was recorded of a tile in a picture of `size` pixels; `None` if it was not.
    pub fn tile(&self, rect: &Rect, size: [u32; 2]) -> Option<&TileTrace> {
        self.levels.iter().find_map(|level| {
            if !is_tile(rect, level.edge, size) {
                return None;
            }
            let key = (rect.y0 as u32, rect.x0 as u32);
            let i = level.tiles.binary_search_by_key(&key, |t| (t.y, t.x)).ok()?;
            Some(&level.tiles[i])
        })
    }

    /// Returns which pixels are shut behind the slab, row-major over a picture of `size` pixels.
    pub fn shut(&self, size: [u32; 2]) -> Vec<bool> {
        let n = size[0] as usize * size[1] as usize;
        let (mut bits, mut shut) = (Vec::with_capacity(n), false);
        for &run in &self.shut {
            bits.resize((bits.len() + run as usize).min(n), shut);
            shut = !shut;
        }
        bits.resize(n, false);
        bits
    }

    /// Returns the run lengths from which [`SlabTrace::shut`] makes these bits.
    pub fn runs(bits: impl IntoIterator<Item = bool>) -> Vec<u32> {
        let (mut runs, mut shut, mut run) = (Vec::new(), false, 0);
        for bit in bits {
            if bit != shut {
                runs.push(run);
                (shut, run) = (bit, 0);
            }
            run += 1;
        }
        if shut {
            runs.push(run);
        }
        runs
    }
}

/// Returns a hash of everything that a frame's times depend on: transfer function, quality and
/// view.
///
/// The hash in a frame's statistics is another one: it covers the cropping box and not whether
/// culling is on.
pub fn view_sha256(scene: &SceneSpec, view: &View) -> Digest32 {
    let mut h = Sha256::new();
    h.update(b"slabcast trace 1");
    h.update(scene.volume.digest.0);
    h.update(scene.bricks.0.0);
    h.update(scene.transfer.to_json());
    h.update(serde_json::to_string(&scene.quality).expect("plain numbers"));
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
mod tests;
