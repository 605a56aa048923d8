//! A frame's critical path: what it waited for, from its last pixel back to its first event.
//!
//! Why did a frame take as long as it did? Sums over workers don't tell: a frame of 40 ms with 300
//! ms of rendering on ten workers may have waited for one tile or for bricks. So each phase (a
//! slab, or the whole frame where there are no barriers) is walked back from the result that ended
//! it: its message, its rendering, what its thread rendered before, until the phase began. The gap
//! between two tiles counts as bricks in flight, as far as the worker says that the tile
//! lacked_bricks_us some, and else as messages and queues. All of it is on the master's clock
//! ([`place_in_time`](crate::account::ledger::place_in_time)), so the parts add up to the frame's
//! time.

use crate::Micros;
use crate::account::ledger::ms;
use slabcast_common::ids::WorkerId;

/// A tile whose result was accepted.
#[derive(Clone, Debug)]
pub(crate) struct RenderedTile {
    /// Left column and top row, in pixels.
    pub(crate) corner: [i32; 2],
    pub(crate) edge: u32,
    /// The worker and its render thread.
    pub(crate) thread: (WorkerId, u32),
    /// Time the task waited at the worker for bricks.
    pub(crate) lacked_bricks_us: Micros,
    pub(crate) start: Micros,
    pub(crate) end: Micros,
    /// When its result arrived.
    pub(crate) arrived: Micros,
}

/// The tile on the path that rendered longest.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Longest {
    corner: [i32; 2],
    edge: u32,
    phase: usize,
    worker: String,
    us: Micros,
}

/// The critical path of a frame, phase after phase.
#[derive(Debug, Default)]
pub(crate) struct CriticalPath {
    phases: usize,
    render: Micros,
    bricks: Micros,
    messages: Micros,
    longest: Option<Longest>,
}

impl CriticalPath {
    /// Adds a phase that ended. `name` returns a worker's display name.
    pub(crate) fn add_phase(
        &mut self,
        pieces: &[RenderedTile],
        began: Micros,
        name: impl Fn(WorkerId) -> String,
    ) {
        let phase = self.phases;
        self.phases += 1;
        let Some(last) = pieces.iter().max_by_key(|p| p.arrived) else { return };
        self.messages += last.arrived.saturating_sub(last.end.max(began));
        let mut piece = last;
        loop {
            let us = piece.end.saturating_sub(piece.start.max(began));
            self.render += us;
            if self.longest.as_ref().is_none_or(|l| us > l.us) {
                let (corner, edge, worker) = (piece.corner, piece.edge, name(piece.thread.0));
                self.longest = Some(Longest { corner, edge, phase, worker, us });
            }
            let before = pieces
                .iter()
                .filter(|p| p.thread == piece.thread && p.end <= piece.start && p.start < p.end)
                .max_by_key(|p| p.end);
            let since = before.map_or(began, |p| p.end.max(began));
            let gap = piece.start.saturating_sub(since);
            let bricks = gap.min(piece.lacked_bricks_us);
            self.bricks += bricks;
            self.messages += gap - bricks;
            match before {
                Some(before) if before.end > began => piece = before,
                _ => return,
            }
        }
    }

    /// Describes the path in one sentence. `total`: the frame's time; `cull`: the master's time for
    /// culling and queues while nobody rendered.
    pub(crate) fn sentence(&self, total: Micros, cull: Micros) -> String {
        let mut parts = Vec::new();
        let mut part = |us: Micros, what: &str| {
            if us >= 50 {
                parts.push(format!("{:.1} ms {what}", ms(us)));
            }
        };
        let where_ = self.longest.as_ref().map_or(String::new(), |l| {
            let slab =
                if self.phases > 1 { format!(" of slab {}", l.phase) } else { String::new() };
            let [x, y] = l.corner;
            format!(
                " (longest: tile ({x},{y}) {} px{slab} on {}, {:.1} ms)",
                l.edge,
                l.worker,
                ms(l.us)
            )
        });
        part(self.render, &format!("rendering{where_}"));
        part(self.bricks, "bricks on their way");
        part(self.messages, "messages and queues");
        part(cull, "culling at the master");
        let known = self.render + self.bricks + self.messages + cull;
        part(total.saturating_sub(known), "the master's other work or no worker there");
        let of = if parts.is_empty() { String::new() } else { ", of which ".to_string() };
        format!("{:.1} ms{of}{}", ms(total), parts.join(", "))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(
        w: u64,
        x: i32,
        lacked_bricks_us: Micros,
        start: Micros,
        end: Micros,
        arrived: Micros,
    ) -> RenderedTile {
        let thread = (WorkerId(w), 0);
        RenderedTile { corner: [x, 64], edge: 64, thread, lacked_bricks_us, start, end, arrived }
    }

    #[test]
    fn critical_path_names_the_tile_a_frame_waited_for() {
        let mut path = CriticalPath::default();
        let name = |w: WorkerId| format!("host-{}", w.0);
        // Worker 1 ends early; worker 2 lacks bricks for 3 ms, then renders two tiles.
        let first = [
            piece(1, 0, 0, 1_200, 6_000, 6_200),
            piece(2, 64, 3_000, 4_200, 9_200, 9_400),
            piece(2, 128, 0, 9_300, 39_300, 39_500),
        ];
        path.add_phase(&first, 1_000, name);
        path.add_phase(&[piece(1, 0, 0, 41_600, 42_600, 42_700)], 41_500, name);
        assert_eq!(
            path.sentence(43_000, 3_000),
            "43.0 ms, of which 36.0 ms rendering (longest: tile (128,64) 64 px of slab 0 on \
             host-2, 30.0 ms), 3.0 ms bricks on their way, 0.7 ms messages and queues, 3.0 ms \
             culling at the master, 0.3 ms the master's other work or no worker there"
        );
    }

    #[test]
    fn critical_path_of_an_empty_frame_or_a_bad_clock_is_a_sentence() {
        let mut path = CriticalPath::default();
        path.add_phase(&[], 5, |_| String::new());
        assert_eq!(path.sentence(400, 400), "0.4 ms, of which 0.4 ms culling at the master");
        // Tiles of no duration on one thread: no cycle.
        let odd = [piece(1, 0, 9, 7, 7, 7), piece(1, 1, 9, 7, 7, 7), piece(1, 2, 9, 3, 3, 8)];
        path.add_phase(&odd, 5, |_| "w".into());
        assert!(path.sentence(8, 0).starts_with("0.0 ms"));
    }
}
