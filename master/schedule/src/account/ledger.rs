//! A frame's costs: intervals and counts while it is made, docs/design/contracts.md's statistics at
//! its end.
//!
//! Times of two machines meet here. A worker's clock is mapped to the master's by its offset
//! (`state::workers`) and clamped to what the master knows for sure: a task was rendered between
//! sending its lease and receiving its result. So no figure is negative or longer than it can be,
//! whatever a worker's clock shows.

use crate::account::critical_path::{CriticalPath, RenderedTile};
use crate::account::spans::BrickTransfer;
use crate::state::residency::Transfer;
use crate::state::worker_map::WorkerMap;
use crate::state::workers::Worker;
use crate::{Micros, Span, Spans};
use slabcast_common::PIXELS_VERSION;
use slabcast_common::ids::WorkerId;
use slabcast_common::message::{Counters, ErrorsBySource, RegionCost, TaskTimes};
use slabcast_common::quality::{Quality, Schedule};
use slabcast_common::stats::{
    BoundAndEstimate, BrickStats, ErrorStats, Estimate, FrameMs, FrameStats, SlabStats,
    THICKNESS_EXTRAPOLATION, VoxelStats, WorkerStats,
};
use std::sync::Arc;

/// Limit: spans that memory is reserved for at first, the tiles and brick transfers of 64 workers.
const SPANS_RESERVED: usize = 512;

/// Half-open interval of times on the master's clock, in microseconds.
type Interval = (Micros, Micros);

/// One worker's share of a frame.
#[derive(Debug)]
struct Account {
    name: Arc<str>,
    threads: u32,
    from: Micros,
    until: Option<Micros>,
    render_us: Micros,
    p2p_us: Micros,
    renders: Vec<Interval>,
    transfers: Vec<Interval>,
    held: (u64, u64),
    bricks_sent: u64,
    bytes_sent: u64,
    /// Rendering time spent on other frames meanwhile.
    elsewhere_us: Micros,
    stalls: u64,
    parked_us: Micros,
    stall_us: Micros,
}

/// The account of one frame.
#[derive(Debug)]
pub(crate) struct Ledger {
    began: Micros,
    pub(crate) cull_us: Micros,
    pub(crate) composite_us: Micros,
    accounts: WorkerMap<Account>,
    pub(crate) counters: Counters,
    /// Error of sampled pixels.
    sampled: ErrorsBySource,
    result_bytes: Option<u64>,
    pub(crate) slabs: Vec<SlabStats>,
    pub(crate) spans: Spans,
    pub(crate) retries: u64,
    pub(crate) handed_over: u64,
    pub(crate) dropped_results: u64,
    path: CriticalPath,
}

/// When a task was rendered, on the master's clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Rendered {
    pub(crate) start: Micros,
    pub(crate) end: Micros,
    pub(crate) p2p_us: Micros,
}

/// Maps a task's times to the master's clock, clamped between its lease and its result.
pub(crate) fn place_in_time(
    worker: &Worker,
    times: &TaskTimes,
    sent: Micros,
    came: Micros,
) -> Rendered {
    let window = came.saturating_sub(sent);
    let lasted = times.end_us.saturating_sub(times.start_us).min(window);
    let there = times.end_us.saturating_sub(times.received_us).min(window);
    let end = worker.to_master(times.end_us).unwrap_or(came).clamp(sent + lasted, sent + window);
    Rendered { start: end - lasted, end, p2p_us: window - there }
}

impl Ledger {
    pub(crate) fn new(began: Micros) -> Self {
        Ledger {
            began,
            cull_us: 0,
            composite_us: 0,
            accounts: WorkerMap::default(),
            counters: Counters::default(),
            sampled: ErrorsBySource::default(),
            result_bytes: None,
            slabs: Vec::new(),
            spans: Spans::with_capacity(SPANS_RESERVED),
            retries: 0,
            handed_over: 0,
            dropped_results: 0,
            path: CriticalPath::default(),
        }
    }

    /// Adds the tiles of an ended phase (a slab, or all regions) to the critical path.
    pub(crate) fn end_phase(&mut self, pieces: &[RenderedTile], began: Micros) {
        let accounts = &self.accounts;
        let name = |id| accounts.get(id).map_or_else(String::new, |a| a.name.to_string());
        self.path.add_phase(pieces, began, name);
    }

    /// Opens the account of a worker.
    pub(crate) fn open_account(&mut self, id: WorkerId, worker: &Worker, now: Micros) {
        self.accounts.or_insert_with(id, || Account {
            name: worker.name.clone(),
            threads: worker.threads,
            from: now,
            until: None,
            render_us: 0,
            p2p_us: 0,
            renders: Vec::new(),
            transfers: Vec::new(),
            held: (0, 0),
            bricks_sent: 0,
            bytes_sent: 0,
            elsewhere_us: 0,
            stalls: 0,
            parked_us: 0,
            stall_us: 0,
        });
    }

    /// Closes the account of a worker.
    pub(crate) fn close_account(&mut self, id: WorkerId, now: Micros) {
        if let Some(a) = self.accounts.get_mut(id) {
            a.until = Some(now);
        }
    }

    pub(crate) fn add_rendering(&mut self, id: WorkerId, r: &Rendered, counters: &Counters) {
        self.counters += *counters;
        if let Some(a) = self.accounts.get_mut(id) {
            a.render_us += r.end - r.start;
            a.p2p_us += r.p2p_us;
            a.renders.push((r.start, r.end));
        }
    }

    /// Returns the rendering time of all threads.
    pub(crate) fn rendered_us(&self) -> Micros {
        self.accounts.values().map(|a| a.render_us).sum()
    }

    /// Counts the bytes of an accepted result; `None`: it crossed no network.
    pub(crate) fn add_result_bytes(&mut self, bytes: Option<u32>) {
        if let Some(bytes) = bytes {
            self.result_bytes = Some(self.result_bytes.unwrap_or(0) + u64::from(bytes));
        }
    }

    /// Counts time that a worker spent on another frame.
    pub(crate) fn rendered_elsewhere(&mut self, id: WorkerId, (start, end): Interval) {
        if let Some(a) = self.accounts.get_mut(id) {
            a.elsewhere_us += end.saturating_sub(start.max(a.from));
        }
    }

    /// Adds a region's stalls and sampled errors. The figures are a peer's: they are only added up.
    pub(crate) fn add_region_cost(&mut self, id: WorkerId, cost: &RegionCost) {
        if let Some(a) = self.accounts.get_mut(id) {
            a.stalls += u64::from(cost.stalls);
            a.parked_us = a.parked_us.saturating_add(cost.parked_us);
            a.stall_us = a.stall_us.saturating_add(cost.idle_us);
        }
        self.sampled.add(cost.sampled);
    }

    pub(crate) fn bricks_sent(&mut self, id: WorkerId, bricks: u64, bytes: u64) {
        if let Some(a) = self.accounts.get_mut(id) {
            a.bricks_sent += bricks;
            a.bytes_sent += bytes;
        }
    }

    /// Records a transfer of bricks that ended now.
    pub(crate) fn transfer_ended(&mut self, id: WorkerId, transfer: Transfer, now: Micros) {
        let Some(a) = self.accounts.get_mut(id) else { return };
        let start = transfer.since.max(self.began).min(now);
        a.transfers.push((start, now));
        let Transfer { bricks, bytes, .. } = transfer;
        self.spans.bricks(BrickTransfer { worker: a.name.clone(), start, end: now, bricks, bytes });
    }

    pub(crate) fn set_held(&mut self, id: WorkerId, held: (u64, u64)) {
        if let Some(a) = self.accounts.get_mut(id) {
            a.held = held;
        }
    }

    /// Closes the account: returns statistics and timeline.
    pub(crate) fn close(
        mut self,
        number: u64,
        schedule: Schedule,
        quality: Quality,
        relevant_voxels: u64,
        bricks: BrickStats,
        now: Micros,
    ) -> (FrameStats, Spans) {
        let transfers = union(self.accounts.values().flat_map(|a| &a.transfers).copied().collect());
        let renders = union(self.accounts.values().flat_map(|a| &a.renders).copied().collect());
        let mut workers: Vec<_> = self
            .accounts
            .into_values()
            .map(|a| {
                let present = a.until.unwrap_or(now).saturating_sub(a.from);
                let threads_us = present.saturating_mul(u64::from(a.threads));
                WorkerStats {
                    id: a.name.to_string(),
                    render_ms: ms(a.render_us),
                    distribute_ms: ms(length(&union(a.transfers))),
                    p2p_ms: ms(a.p2p_us),
                    wait_ms: ms(threads_us.saturating_sub(a.render_us + a.elsewhere_us)),
                    stalls: a.stalls,
                    parked_ms: ms(a.parked_us),
                    stall_ms: ms(a.stall_us),
                    bricks_held: a.held.0,
                    bytes_held: a.held.1,
                    bricks_sent: a.bricks_sent,
                    bytes_sent: a.bytes_sent,
                }
            })
            .collect();
        workers.sort_by(|a, b| a.id.cmp(&b.id));
        self.spans.push(Span {
            name: format!("frame {number}"),
            category: "frame",
            worker: None,
            thread: 0,
            start: self.began,
            end: now,
            args: Vec::new(),
        });
        let stats = FrameStats {
            v: 1,
            frame: number,
            schedule,
            view_sha256: String::new(),
            pixels_sha256: String::new(),
            pixels_version: PIXELS_VERSION,
            ms: FrameMs {
                total: ms(now.saturating_sub(self.began)),
                cull: ms(self.cull_us),
                distribute: ms(length(&transfers)),
                render: workers.iter().map(|w| w.render_ms).sum(),
                composite: ms(self.composite_us),
                wait: self.slabs.iter().map(|s| s.barrier_wait_ms).sum(),
                overlap: ms(length(&intersection(&transfers, &renders))),
                stall: workers.iter().map(|w| w.stall_ms).sum(),
            },
            workers,
            voxels: VoxelStats {
                relevant: relevant_voxels,
                tossed: self.counters.tossed,
                splatted: self.counters.splatted,
                culled: self.counters.culled,
            },
            bricks,
            result_bytes: self.result_bytes,
            slabs: self.slabs,
            quality,
            left_out: Vec::new(),
            error: ErrorStats {
                thickness: Estimate {
                    estimate: self.sampled.thickness.rmse().map(|e| e * THICKNESS_EXTRAPOLATION),
                },
                rounding: BoundAndEstimate {
                    estimate: self.sampled.positions.rmse(),
                    ..BoundAndEstimate::default()
                },
                truncation: BoundAndEstimate {
                    estimate: self.sampled.truncation.rmse(),
                    ..BoundAndEstimate::default()
                },
                ripple: Estimate { estimate: self.sampled.ripple.rmse() },
                ..ErrorStats::default()
            },
            retries: self.retries,
            handed_over: self.handed_over,
            dropped_results: self.dropped_results,
            // A frame with a tile missing fails; it has no statistics.
            poisoned: Vec::new(),
            critical_path: Some(self.path.sentence(now.saturating_sub(self.began), self.cull_us)),
            rehearsed: false,
            level: None,
        };
        (stats, self.spans)
    }
}

/// Converts microseconds to milliseconds.
pub(crate) fn ms(us: Micros) -> f64 {
    us as f64 / 1000.0
}

/// Returns the union of intervals, ascending.
fn union(mut intervals: Vec<Interval>) -> Vec<Interval> {
    intervals.sort_unstable();
    let mut out: Vec<Interval> = Vec::new();
    for (start, end) in intervals {
        match out.last_mut() {
            Some(last) if start <= last.1 => last.1 = last.1.max(end),
            _ => out.push((start, end)),
        }
    }
    out
}

/// Returns the intersection of two unions.
fn intersection(a: &[Interval], b: &[Interval]) -> Vec<Interval> {
    let (mut i, mut j) = (0, 0);
    let mut out = Vec::new();
    while i < a.len() && j < b.len() {
        let (start, end) = (a[i].0.max(b[j].0), a[i].1.min(b[j].1));
        if start < end {
            out.push((start, end));
        }
        if a[i].1 < b[j].1 { i += 1 } else { j += 1 }
    }
    out
}

fn length(intervals: &[Interval]) -> Micros {
    intervals.iter().map(|(start, end)| end - start).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interval_unions_and_intersections() {
        let a = union(vec![(5, 9), (0, 2), (1, 3), (9, 10)]);
        assert_eq!(a, [(0, 3), (5, 10)]);
        assert_eq!(intersection(&a, &[(2, 6), (7, 8), (20, 30)]), [(2, 3), (5, 6), (7, 8)]);
        assert_eq!(length(&a), 8);
    }
}
