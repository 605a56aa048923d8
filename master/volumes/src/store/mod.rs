//! Store of the bricks of one volume with voxels that a transfer function shows.
//!
//! A volume is cut block by block ([`crate::blocks::BLOCK_EDGE`]), each from the samples in and
//! around it. A block whose values the transfer function does not show is not read. A block that an
//! earlier store cut for the same values is shared with that store, so that an edit of the function
//! cuts only the blocks it changes.
//!
//! A store does not change after it was built, so all senders share it in an [`std::sync::Arc`].
//! Bricks are encoded as they are cut; remote workers are sent these bytes, and sending to sixty
//! copies a pointer sixty times. A brick that an embedded worker asks for is decoded then, and
//! shared from then on. Keeping both forms would take 10 bytes for a voxel of 8 bits where the
//! promise is 8, so a brick has one or the other: with workers of both kinds, the master encodes a
//! brick anew for each remote worker.

mod cut;
mod mask;
mod same;

use crate::blocks::{BLOCK_EDGE, BlockSource, MemorySource, block_dims, copy_box};
use crate::error::{OpenErrorKind, Problem};
use crate::prefilter;
use bytes::Bytes;
pub(crate) use cut::relevance_table;
use cut::{Cutter, SampleBox, margin};
use rayon::prelude::*;
use same::SameBlocks;
use slabcast_common::brick::{BRICK_EDGE, Brick, BrickGrid, BrickInfo, BrickSetKey, TightBox};
use slabcast_common::ids::BrickId;
use slabcast_common::volume::{Digest32, Samples, Volume, VolumeInfo};
use slabcast_scene::brick_needs::BrickNeeds;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// The bricks of a volume that hold a relevant voxel. Each is kept once, encoded or decoded. A
/// voxel is relevant if the transfer function shows its value and it lies inside the cropping box,
/// or near such a voxel ([`BrickNeeds::halo`]).
pub struct BrickStore {
    key: BrickSetKey,
    needs: BrickNeeds,
    grid: BrickGrid,
    /// All bricks in ascending id.
    infos: Arc<[BrickInfo]>,
    /// Bricks of each block of the volume, i fastest; `None` for a block without bricks.
    blocks: Vec<Option<Arc<CutBlock>>>,
    /// Source to cut dropped contents from again; `None` if all contents are kept.
    again: Option<Again>,
    relevant_voxels: u64,
    bytes: u64,
    extent: Option<TightBox>,
}

/// The bricks of one block, in ascending id.
struct CutBlock {
    infos: Vec<BrickInfo>,
    /// Contents of the bricks; `None` if they were dropped, to be cut again on request.
    contents: Mutex<Option<Contents>>,
}

/// Contents of a block's bricks, in the order of their infos.
type Contents = Arc<[Mutex<Content>]>;

/// A brick in the form in which it was last asked for.
enum Content {
    /// Encoded for remote workers ([`Brick::encode`]).
    Encoded(Bytes),
    /// Decoded, and shared by the embedded workers.
    Decoded(Arc<Brick>),
}

impl CutBlock {
    fn new(bricks: Vec<(BrickInfo, Bytes)>) -> Option<Arc<CutBlock>> {
        let (infos, contents) = split(bricks);
        (!infos.is_empty())
            .then(|| Arc::new(CutBlock { infos, contents: Mutex::new(Some(contents)) }))
    }

    fn bytes(&self) -> u64 {
        self.infos.iter().map(|info| u64::from(info.bytes)).sum()
    }

    fn held(&self) -> MutexGuard<'_, Option<Contents>> {
        self.contents.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Splits encoded bricks into their infos and their contents.
fn split(bricks: Vec<(BrickInfo, Bytes)>) -> (Vec<BrickInfo>, Contents) {
    let content = |(info, bytes)| (info, Mutex::new(Content::Encoded(bytes)));
    let (infos, contents): (_, Vec<_>) = bricks.into_iter().map(content).unzip();
    (infos, contents.into())
}

impl BrickStore {
    /// Cuts a volume in memory into bricks on all cores of rayon's pool.
    ///
    /// `digest` is [`Volume::digest`] of `volume`. Bricks without a relevant voxel are left out,
    /// and so are normals and gradients that `needs` does not ask for.
    pub fn build(volume: &Volume, digest: Digest32, needs: &BrickNeeds) -> Self {
        let source = MemorySource::new(volume, digest);
        let blocks = cut_blocks(&source, 0, needs, None, |_, _| {});
        let info = &source.levels()[0];
        BrickStore::from_blocks(info, needs, blocks.expect("samples in memory can be read"), None)
    }

    /// Cuts a level of a volume into bricks on all cores of rayon's pool. Bricks without a relevant
    /// voxel are left out. Blocks that are the same in `before`, a store of the same level, are
    /// shared with it. About `keep_bytes` of contents are kept; the least recently used ones beyond
    /// are dropped, and cut again on request.
    ///
    /// # Errors
    /// A file can't be read or is damaged, or bricks shall hold coefficients of a level that is not
    /// in memory as a whole.
    pub fn cut(
        source: &Arc<dyn BlockSource>,
        level: usize,
        needs: &BrickNeeds,
        before: Option<&BrickStore>,
        keep_bytes: u64,
    ) -> Result<Self, Problem> {
        let again = Again { source: source.clone(), level, keep_bytes, kept: Mutex::default() };
        let blocks = cut_blocks(&**source, level, needs, before, |block, cut: &CutBlock| {
            let too_many = again.keep(block, cut.bytes(), true);
            if !too_many.is_empty() {
                *cut.held() = None;
            }
        })?;
        Ok(BrickStore::from_blocks(&source.levels()[level], needs, blocks, Some(again)))
    }

    fn from_blocks(
        info: &VolumeInfo,
        needs: &BrickNeeds,
        blocks: Vec<Option<Arc<CutBlock>>>,
        again: Option<Again>,
    ) -> BrickStore {
        let all = || blocks.iter().flatten().flat_map(|block| &block.infos).copied();
        let mut infos: Vec<BrickInfo> = all().collect();
        infos.sort_unstable_by_key(|info| info.id);
        BrickStore {
            key: needs.set_key(info.digest),
            needs: needs.clone(),
            grid: BrickGrid::new(info.lattice.dims),
            relevant_voxels: infos.iter().map(|b| u64::from(b.voxels)).sum(),
            bytes: infos.iter().map(|b| u64::from(b.bytes)).sum(),
            extent: infos.iter().map(|info| info.tight).reduce(TightBox::union),
            infos: infos.into(),
            blocks,
            again,
        }
    }

    /// Returns the key of this set of bricks, made from the volume's digest and the needs.
    pub fn key(&self) -> BrickSetKey {
        self.key
    }

    /// Returns the needs that the bricks were cut for: visible values, normals, gradients and crop.
    pub fn needs(&self) -> &BrickNeeds {
        &self.needs
    }

    /// Returns the directory: id, tight box, voxels and encoded bytes of each brick, in ascending
    /// id.
    pub fn infos(&self) -> &Arc<[BrickInfo]> {
        &self.infos
    }

    /// Returns a decoded brick; `None` if it has no relevant voxel. It is decoded at the first
    /// call, and shared and kept decoded from then on.
    ///
    /// # Errors
    /// Its contents were dropped and its file can't be read any more, or has changed.
    pub fn try_brick(&self, id: BrickId) -> Result<Option<Arc<Brick>>, Problem> {
        self.with_content(id, |content| {
            let brick = match content {
                Content::Decoded(brick) => return brick.clone(),
                Content::Encoded(bytes) => Brick::decode(bytes).expect("the store encoded it"),
            };
            let brick = Arc::new(brick);
            *content = Content::Decoded(brick.clone());
            brick
        })
    }

    /// Returns the encoding of a brick ([`Brick::encode`]); `None` if it has no relevant voxel. The
    /// bytes are shared, unless the brick was decoded: then they are encoded anew.
    ///
    /// # Errors
    /// Its contents were dropped and its file can't be read any more, or has changed.
    pub fn try_encoded(&self, id: BrickId) -> Result<Option<Bytes>, Problem> {
        self.with_content(id, |content| match content {
            Content::Encoded(bytes) => bytes.clone(),
            Content::Decoded(brick) => encode(brick),
        })
    }

    /// Returns a decoded brick of a store in memory; `None` if it has no relevant voxel
    /// ([`BrickStore::try_brick`]).
    ///
    /// # Panics
    /// If the store reads a file that can't be read any more.
    pub fn brick(&self, id: BrickId) -> Option<Arc<Brick>> {
        self.try_brick(id).expect("samples in memory can be read")
    }

    /// Returns the encoding of a brick of a store in memory; `None` if it has no relevant voxel
    /// ([`BrickStore::try_encoded`]).
    ///
    /// # Panics
    /// If the store reads a file that can't be read any more.
    pub fn encoded(&self, id: BrickId) -> Option<Bytes> {
        self.try_encoded(id).expect("samples in memory can be read")
    }

    /// Returns the most bytes of contents that are kept in memory.
    pub fn kept_bytes(&self) -> u64 {
        self.again.as_ref().map_or(self.bytes, |again| self.bytes.min(again.keep_bytes))
    }

    /// Returns whether a request for a brick may read a file.
    pub fn may_read(&self) -> bool {
        self.again.as_ref().is_some_and(|again| self.bytes > again.keep_bytes)
    }

    /// Returns the number of voxels in all bricks.
    pub fn relevant_voxels(&self) -> u64 {
        self.relevant_voxels
    }

    /// Returns the smallest box, in voxel indices of the volume, that holds all relevant voxels;
    /// `None` if there are none.
    pub fn extent(&self) -> Option<TightBox> {
        self.extent
    }

    /// Returns the size of all bricks in encoded form, in bytes.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    fn with_content<T>(
        &self,
        id: BrickId,
        get: impl FnOnce(&mut Content) -> T,
    ) -> Result<Option<T>, Problem> {
        let Some((block, cut)) = self.block_of(id) else { return Ok(None) };
        let Ok(i) = cut.infos.binary_search_by_key(&id, |b| b.id) else { return Ok(None) };
        let contents = self.contents(block, cut)?;
        let mut content = contents[i].lock().unwrap_or_else(PoisonError::into_inner);
        Ok(Some(get(&mut content)))
    }

    /// Returns the block that a brick lies in, and its index; `None` if it has no bricks.
    fn block_of(&self, id: BrickId) -> Option<(usize, &CutBlock)> {
        if id.0 as usize >= self.grid.len() {
            return None;
        }
        let bricks = BLOCK_EDGE / BRICK_EDGE;
        let at = self.grid.corner(id).map(|n| (n / BLOCK_EDGE) as usize);
        let dims = self.grid.dims.map(|n| n.div_ceil(bricks) as usize);
        let block = (at[2] * dims[1] + at[1]) * dims[0] + at[0];
        Some((block, self.blocks[block].as_deref()?))
    }

    /// Returns the contents of a block's bricks; cuts the block again if they were dropped.
    fn contents(&self, block: usize, cut: &CutBlock) -> Result<Contents, Problem> {
        let mut held = cut.held();
        let contents = match &*held {
            Some(contents) => contents.clone(),
            None => {
                let again = self.again.as_ref().expect("only a store that cuts again drops any");
                let bricks = cut_block(&*again.source, again.level, &self.needs, block)?;
                let (infos, contents) = split(bricks);
                if infos != cut.infos {
                    return Err(Problem::new(
                        OpenErrorKind::Damaged,
                        again.source.name(),
                        "its samples are others than they were",
                        "put the file back as it was, or ask for the picture again",
                    ));
                }
                *held = Some(contents.clone());
                contents
            }
        };
        drop(held);
        if let Some(again) = &self.again {
            for other in again.keep(block, cut.bytes(), false) {
                if let Some(cut) = &self.blocks[other] {
                    *cut.held() = None;
                }
            }
        }
        Ok(contents)
    }
}

/// Source of dropped contents, and the record of which contents are kept.
struct Again {
    source: Arc<dyn BlockSource>,
    level: usize,
    /// Budget of contents in bytes.
    keep_bytes: u64,
    kept: Mutex<Kept>,
}

/// Blocks whose contents are kept.
#[derive(Default)]
struct Kept {
    bytes: u64,
    clock: u64,
    /// Time of each block's last use, and its bytes.
    used: BTreeMap<usize, (u64, u64)>,
    /// Blocks by the time of their last use.
    order: BTreeMap<u64, usize>,
}

impl Again {
    /// Notes that a block of `bytes` is used, and returns the blocks to drop. A `new` block without
    /// room is among them.
    fn keep(&self, block: usize, bytes: u64, new: bool) -> Vec<usize> {
        let kept = &mut *self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.clock += 1;
        let before = kept.used.get(&block).copied();
        if before.is_none() && new && kept.bytes + bytes > self.keep_bytes {
            return vec![block];
        }
        match before {
            Some((when, _)) => drop(kept.order.remove(&when)),
            None => kept.bytes += bytes,
        }
        kept.used.insert(block, (kept.clock, bytes));
        kept.order.insert(kept.clock, block);
        let mut dropped = Vec::new();
        while kept.bytes > self.keep_bytes
            && let Some((&when, &oldest)) = kept.order.first_key_value()
            && oldest != block
        {
            kept.order.remove(&when);
            let (_, bytes) = kept.used.remove(&oldest).expect("it is in both");
            kept.bytes -= bytes;
            dropped.push(oldest);
        }
        dropped
    }
}

/// Blocks that are cut side by side: some milliseconds of work for each of 16 threads.
const BLOCKS_AT_A_TIME: usize = 64;

/// Cuts all blocks of a level that may hold bricks, and calls `done` with each that does.
fn cut_blocks(
    source: &dyn BlockSource,
    level: usize,
    needs: &BrickNeeds,
    before: Option<&BrickStore>,
    done: impl Fn(usize, &CutBlock) + Sync,
) -> Result<Vec<Option<Arc<CutBlock>>>, Problem> {
    let summaries = source.summaries(level)?;
    let same = SameBlocks::new(&summaries, needs, before.map(|b| &b.needs));
    let cutting = Cutting::new(source, level, needs)?;
    let one = |block: usize| {
        if !same.may_hold(block) {
            return Ok(None);
        }
        // A block outside of the former window was not cut.
        let was_cut = |before: &&BrickStore| {
            before.needs.window.as_ref().is_none_or(|window| window.contains(block))
        };
        let cut = match before.filter(|_| same.is_same(block)).filter(was_cut) {
            Some(before) => before.blocks[block].clone(),
            None => CutBlock::new(cutting.block(block)?),
        };
        if let Some(cut) = &cut {
            done(block, cut);
        }
        Ok(cut)
    };
    // In order, so that neighbouring blocks find decoded chunks in the source's cache.
    let mut cut = Vec::with_capacity(summaries.all.len());
    for first in (0..summaries.all.len()).step_by(BLOCKS_AT_A_TIME) {
        let together = first..(first + BLOCKS_AT_A_TIME).min(summaries.all.len());
        let blocks: Result<Vec<_>, Problem> = together.into_par_iter().map(one).collect();
        cut.extend(blocks?);
    }
    Ok(cut)
}

/// Upper bound of the size of a brick set, from the summaries of its blocks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Estimate {
    /// Number of blocks to read.
    pub blocks: u64,
    /// Number of bricks.
    pub bricks: u64,
    /// Bytes of the bricks, encoded.
    pub bytes: u64,
}

/// Estimates the size of the brick set with `needs` of a level, without reading samples.
///
/// # Errors
/// A file can't be read, or is damaged.
pub fn estimate(
    source: &dyn BlockSource,
    level: usize,
    needs: &BrickNeeds,
) -> Result<Estimate, Problem> {
    let info = &source.levels()[level];
    let summaries = source.summaries(level)?;
    let same = SameBlocks::new(&summaries, needs, None);
    let sample = if needs.coefficients { 4 } else { info.summary.code_kind().bytes() as u64 };
    let voxel = sample + 2 * u64::from(needs.normals) + u64::from(needs.gradients);
    let mut all = Estimate::default();
    for block in (0..summaries.all.len()).filter(|&block| same.may_hold(block)) {
        let lo = block_corner(summaries.dims, block);
        let size: [u32; 3] =
            std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(info.lattice.dims[a]) - lo[a]);
        let bricks: u64 = size.iter().map(|&n| u64::from(n.div_ceil(BRICK_EDGE))).product();
        let voxels: u64 = size.iter().map(|&n| u64::from(n)).product();
        let most = same.most(block, needs.halo);
        let (bricks, voxels) = (bricks.min(most.0), voxels.min(most.1));
        all.blocks += 1;
        all.bricks += bricks;
        all.bytes += bricks * BRICK_HEAD_BYTES + voxels * voxel;
    }
    Ok(all)
}

/// Bytes of an encoded brick beside its voxels, at most: head, mask of voxels and checksum.
const BRICK_HEAD_BYTES: u64 = 7 + 64 + 4;

/// Cuts one block of a level; returns its bricks in ascending id.
fn cut_block(
    source: &dyn BlockSource,
    level: usize,
    needs: &BrickNeeds,
    block: usize,
) -> Result<Vec<(BrickInfo, Bytes)>, Problem> {
    Cutting::new(source, level, needs)?.block(block)
}

/// Inputs that all blocks of a level share while it is cut.
struct Cutting<'a> {
    source: &'a dyn BlockSource,
    level: usize,
    cutter: Cutter<'a>,
    dims: [u32; 3],
    margin: u32,
    /// Coefficients of all samples, if bricks hold coefficients.
    coefficients: Option<Samples>,
}

impl<'a> Cutting<'a> {
    fn new(
        source: &'a dyn BlockSource,
        level: usize,
        needs: &'a BrickNeeds,
    ) -> Result<Cutting<'a>, Problem> {
        let info = &source.levels()[level];
        let whole = || {
            source.whole(level).ok_or_else(|| {
                Problem::unsupported(
                    "kernel",
                    "interpolating needs all samples of the volume in memory",
                    "take another kernel, or a coarser level with --level",
                )
            })
        };
        let coefficients = needs.coefficients.then(whole).transpose()?;
        Ok(Cutting {
            source,
            level,
            cutter: Cutter::new(info, needs),
            dims: info.lattice.dims,
            margin: margin(needs),
            coefficients: coefficients.map(|whole| Samples::F32(prefilter::coefficients(whole))),
        })
    }

    fn block(&self, block: usize) -> Result<Vec<(BrickInfo, Bytes)>, Problem> {
        let lo = block_corner(block_dims(self.dims), block);
        let hi = std::array::from_fn(|a| (lo[a] + BLOCK_EDGE).min(self.dims[a]));
        let first = lo.map(|n| n.saturating_sub(self.margin));
        let end = std::array::from_fn(|a| (hi[a] + self.margin).min(self.dims[a]));
        let samples = self.source.read_box(self.level, first, end)?;
        let of = |samples| SampleBox { samples, lo: first, hi: end };
        let part = self.coefficients.as_ref().map(|all| copy_box(all, self.dims, first, end));
        Ok(self.cutter.cut(&of(&samples), part.as_ref().map(of).as_ref(), lo, hi))
    }
}

/// Returns the first voxel of a block, by its index among `dims` blocks, i fastest.
fn block_corner(dims: [u32; 3], block: usize) -> [u32; 3] {
    let [nx, ny, _] = dims.map(|n| n as usize);
    [block % nx, block / nx % ny, block / nx / ny].map(|n| n as u32 * BLOCK_EDGE)
}

impl std::fmt::Debug for BrickStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BrickStore")
            .field("key", &self.key)
            .field("bricks", &self.infos.len())
            .field("relevant_voxels", &self.relevant_voxels)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

fn encode(brick: &Brick) -> Bytes {
    let mut out = Vec::new();
    brick.encode(&mut out);
    out.into()
}

#[cfg(test)]
mod tests;
