//! Statistics of frames, as messages: every number of the JSON, to the bit, both ways.
//!
//! Very large frames have more tiles than one message of a watch has room for. So statistics leave
//! in parts, which protobuf merges by its own rule (repeated fields are appended), and a receiver
//! puts them together with [`StatisticsParts`].

use super::shared::{quality_from_wire, quality_to_wire};
use super::submit::{schedule_from_wire, schedule_to_wire};
use super::wire;
use crate::convert::{WireError, required};
use prost::Message;
use slabcast_common::level::LevelStats;
use slabcast_common::quality::Classify;
use slabcast_common::stats::{
    Bound, BoundAndEstimate, BrickStats, ErrorStats, Estimate, FrameMs, FrameStats, LeftOut,
    PoisonedTile, SlabStats, TileStats, VoxelStats, WorkerStats,
};

/// Most entries (tiles, workers, slabs) of one frame's statistics: 8192 x 8192 pixels in tiles of
/// 16, in three slabs, have 800,000 tiles. Double, since an entry may take 2 bytes on the wire and
/// 100 in memory.
const MAX_ENTRIES: usize = 1 << 21;

/// A part of a frame's statistics, as it came in one message.
#[derive(Clone, Debug, PartialEq)]
pub struct StatisticsPart(Box<wire::FrameStatistics>);

impl StatisticsPart {
    pub(super) fn new(part: wire::FrameStatistics) -> Self {
        StatisticsPart(Box::new(part))
    }
}

/// Puts the statistics of a frame together from their parts.
#[derive(Debug, Default)]
pub struct StatisticsParts {
    whole: Option<wire::FrameStatistics>,
    entries: usize,
}

impl StatisticsParts {
    /// Appends the next part of the statistics.
    ///
    /// # Errors
    /// [`WireError`] if there are more entries than any frame has.
    pub fn add(&mut self, StatisticsPart(part): StatisticsPart) -> Result<(), WireError> {
        self.entries += part.tiles.len()
            + part.workers.len()
            + part.slabs.len()
            + part.left_out.len()
            + part.poisoned.len();
        if self.entries > MAX_ENTRIES {
            return Err(WireError::too_long("statistics", self.entries, MAX_ENTRIES));
        }
        match &mut self.whole {
            None => self.whole = Some(*part),
            // Protobuf's own merging.
            Some(whole) => whole
                .merge(&part.encode_to_vec()[..])
                .map_err(|e| WireError::value("statistics", e.to_string()))?,
        }
        Ok(())
    }

    /// Returns the frame's statistics, put together from all parts.
    ///
    /// # Errors
    /// [`WireError`] if none came, or names the field that is wrong.
    pub fn finish(self) -> Result<FrameStats, WireError> {
        statistics_from_wire(required("statistics", self.whole)?)
            .map_err(|e| e.within("statistics"))
    }
}

/// Writes statistics in parts of at most `room` bytes each, and at least one.
pub(super) fn statistics_to_wire(stats: &FrameStats, room: usize) -> Vec<wire::FrameStatistics> {
    let slabs = stats.slabs.iter().map(|slab| wire::SlabStatistics {
        tiles: slab.tiles.len() as u32,
        empty: slab.empty,
        shut: slab.shut,
        barrier_wait_ms: Some(slab.barrier_wait_ms),
    });
    let head = wire::FrameStatistics {
        version: stats.v,
        frame: stats.frame,
        schedule: schedule_to_wire(stats.schedule),
        view_sha256: stats.view_sha256.clone(),
        pixels_sha256: stats.pixels_sha256.clone(),
        pixels_version: stats.pixels_version,
        times: Some(times_to_wire(&stats.ms)),
        workers: Vec::new(),
        voxels: Some(wire::VoxelStatistics {
            relevant: stats.voxels.relevant,
            tossed: stats.voxels.tossed,
            splatted: stats.voxels.splatted,
            culled: stats.voxels.culled,
        }),
        bricks: Some(wire::BrickStatistics {
            relevant: stats.bricks.relevant,
            needed: stats.bricks.needed,
            needed_voxels: stats.bricks.needed_voxels,
        }),
        result_bytes: stats.result_bytes,
        slabs: slabs.collect(),
        tiles: Vec::new(),
        quality: Some(quality_to_wire(&stats.quality)),
        left_out: stats.left_out.iter().map(left_out_to_wire).collect(),
        error: Some(error_to_wire(&stats.error)),
        retries: stats.retries,
        tiles_split: stats.handed_over,
        dropped_results: stats.dropped_results,
        poisoned: Vec::new(),
        critical_path: stats.critical_path.clone(),
        rehearsed: stats.rehearsed,
        level: stats.level.map(|level| wire::LevelStatistics {
            level: level.level,
            pixels_per_vox: level.pixels_per_vox,
            samples: level.samples,
            finest_samples: level.finest_samples,
        }),
    };
    let mut parts = Parts { room, used: head.encoded_len(), parts: vec![head] };
    for worker in &stats.workers {
        parts.push(worker_to_wire(worker), |part| &mut part.workers);
    }
    for tile in stats.slabs.iter().flat_map(|slab| &slab.tiles) {
        parts.push(tile_to_wire(tile), |part| &mut part.tiles);
    }
    for tile in &stats.poisoned {
        let tile = wire::PoisonedTile {
            slab: tile.slab,
            x: tile.x,
            y: tile.y,
            size: tile.size,
            workers: tile.workers.clone(),
        };
        parts.push(tile, |part| &mut part.poisoned);
    }
    parts.parts
}

/// Parts while they are filled.
struct Parts {
    room: usize,
    /// Bytes of the last part.
    used: usize,
    parts: Vec<wire::FrameStatistics>,
}

impl Parts {
    fn push<M: Message>(
        &mut self,
        entry: M,
        list: impl Fn(&mut wire::FrameStatistics) -> &mut Vec<M>,
    ) {
        // A tag of at most two bytes, and a length.
        let bytes = entry.encoded_len();
        let bytes = 2 + prost::length_delimiter_len(bytes) + bytes;
        if self.used + bytes > self.room {
            self.parts.push(wire::FrameStatistics::default());
            self.used = 0;
        }
        self.used += bytes;
        list(self.parts.last_mut().expect("there is at least one")).push(entry);
    }
}

fn statistics_from_wire(s: wire::FrameStatistics) -> Result<FrameStats, WireError> {
    let (voxels, bricks) = (s.voxels.unwrap_or_default(), s.bricks.unwrap_or_default());
    let counted: u64 = s.slabs.iter().map(|slab| u64::from(slab.tiles)).sum();
    if counted != s.tiles.len() as u64 {
        let problem = format!("{}, but slabs count {counted}", s.tiles.len());
        return Err(WireError::value("tiles", problem));
    }
    let mut tiles = s.tiles.into_iter().map(|t| TileStats {
        x: t.x,
        y: t.y,
        size: t.size,
        est: t.estimate,
        ms: number(t.render_ms),
        worker: t.worker,
    });
    let slabs = s.slabs.into_iter().map(|slab| SlabStats {
        tiles: tiles.by_ref().take(slab.tiles as usize).collect(),
        empty: slab.empty,
        shut: slab.shut,
        barrier_wait_ms: number(slab.barrier_wait_ms),
    });
    let poisoned = s.poisoned.into_iter().map(|t| PoisonedTile {
        slab: t.slab,
        x: t.x,
        y: t.y,
        size: t.size,
        workers: t.workers,
    });
    Ok(FrameStats {
        v: s.version,
        frame: s.frame,
        schedule: schedule_from_wire("schedule", s.schedule)?,
        view_sha256: s.view_sha256,
        pixels_sha256: s.pixels_sha256,
        pixels_version: s.pixels_version,
        ms: times_from_wire(s.times.unwrap_or_default()),
        workers: s.workers.into_iter().map(worker_from_wire).collect(),
        voxels: VoxelStats {
            relevant: voxels.relevant,
            tossed: voxels.tossed,
            splatted: voxels.splatted,
            culled: voxels.culled,
        },
        bricks: BrickStats {
            relevant: bricks.relevant,
            needed: bricks.needed,
            needed_voxels: bricks.needed_voxels,
        },
        result_bytes: s.result_bytes,
        slabs: slabs.collect(),
        quality: quality_from_wire(required("quality", s.quality)?, Classify::Before)
            .map_err(|e| e.within("quality"))?,
        left_out: s
            .left_out
            .into_iter()
            .map(|l| LeftOut { name: l.name, saved_ms: l.saved_ms, saved_bytes: l.saved_bytes })
            .collect(),
        error: error_from_wire(s.error.unwrap_or_default()),
        retries: s.retries,
        handed_over: s.tiles_split,
        dropped_results: s.dropped_results,
        poisoned: poisoned.collect(),
        critical_path: s.critical_path,
        rehearsed: s.rehearsed,
        level: s.level.map(|level| LevelStats {
            level: level.level,
            pixels_per_vox: level.pixels_per_vox,
            samples: level.samples,
            finest_samples: level.finest_samples,
        }),
    })
}

/// A figure that is always there.
fn number(x: Option<f64>) -> f64 {
    x.unwrap_or(0.0)
}

fn times_to_wire(ms: &FrameMs) -> wire::FrameTimes {
    wire::FrameTimes {
        total_ms: Some(ms.total),
        cull_ms: Some(ms.cull),
        distribute_ms: Some(ms.distribute),
        render_ms: Some(ms.render),
        composite_ms: Some(ms.composite),
        wait_ms: Some(ms.wait),
        overlap_ms: Some(ms.overlap),
        stall_ms: Some(ms.stall),
    }
}

fn times_from_wire(t: wire::FrameTimes) -> FrameMs {
    FrameMs {
        total: number(t.total_ms),
        cull: number(t.cull_ms),
        distribute: number(t.distribute_ms),
        render: number(t.render_ms),
        composite: number(t.composite_ms),
        wait: number(t.wait_ms),
        overlap: number(t.overlap_ms),
        stall: number(t.stall_ms),
    }
}

fn worker_to_wire(w: &WorkerStats) -> wire::WorkerStatistics {
    wire::WorkerStatistics {
        worker: w.id.clone(),
        render_ms: Some(w.render_ms),
        distribute_ms: Some(w.distribute_ms),
        transfer_ms: Some(w.p2p_ms),
        wait_ms: Some(w.wait_ms),
        stalls: w.stalls,
        parked_ms: Some(w.parked_ms),
        stall_ms: Some(w.stall_ms),
        bricks_held: w.bricks_held,
        bytes_held: w.bytes_held,
        bricks_sent: w.bricks_sent,
        bytes_sent: w.bytes_sent,
    }
}

fn worker_from_wire(w: wire::WorkerStatistics) -> WorkerStats {
    WorkerStats {
        id: w.worker,
        render_ms: number(w.render_ms),
        distribute_ms: number(w.distribute_ms),
        p2p_ms: number(w.transfer_ms),
        wait_ms: number(w.wait_ms),
        stalls: w.stalls,
        parked_ms: number(w.parked_ms),
        stall_ms: number(w.stall_ms),
        bricks_held: w.bricks_held,
        bytes_held: w.bytes_held,
        bricks_sent: w.bricks_sent,
        bytes_sent: w.bytes_sent,
    }
}

fn tile_to_wire(t: &TileStats) -> wire::TileStatistics {
    wire::TileStatistics {
        x: t.x,
        y: t.y,
        size: t.size,
        estimate: t.est,
        render_ms: Some(t.ms),
        worker: t.worker.clone(),
    }
}

fn left_out_to_wire(l: &LeftOut) -> wire::LeftOut {
    wire::LeftOut { name: l.name.clone(), saved_ms: l.saved_ms, saved_bytes: l.saved_bytes }
}

fn error_to_wire(e: &ErrorStats) -> wire::ErrorStatistics {
    wire::ErrorStatistics {
        cutoff_bound: e.cutoff.bound,
        quantisation_bound: e.quantisation.bound,
        rounding_bound: e.rounding.bound,
        rounding_estimate: e.rounding.estimate,
        accumulation_bound: e.accumulation.bound,
        truncation_bound: e.truncation.bound,
        truncation_estimate: e.truncation.estimate,
        thickness_estimate: e.thickness.estimate,
        ripple_estimate: e.ripple.estimate,
    }
}

fn error_from_wire(e: wire::ErrorStatistics) -> ErrorStats {
    ErrorStats {
        cutoff: Bound { bound: e.cutoff_bound },
        quantisation: Bound { bound: e.quantisation_bound },
        rounding: BoundAndEstimate { bound: e.rounding_bound, estimate: e.rounding_estimate },
        accumulation: Bound { bound: e.accumulation_bound },
        truncation: BoundAndEstimate { bound: e.truncation_bound, estimate: e.truncation_estimate },
        thickness: Estimate { estimate: e.thickness_estimate },
        ripple: Estimate { estimate: e.ripple_estimate },
    }
}
