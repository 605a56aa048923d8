//! Late splits: the last tile of a worker that would be done after all others is cut as it is lent,
//! and others draw parts of it (`region` schedule; a frame that is alone in the making).
//!
//! What a frame's tiles take is known from the frame before (`region`), and shared out so that all
//! are done at once (`alone`). But the view turns, and of 64 workers one is always 20 % later than
//! the mean. When is that to be mended? A tile that is being drawn can't be cut: what is drawn of
//! it would be drawn twice, which at the end of a frame costs what it wins. When somebody runs dry
//! it is too late, too: by then all tiles are begun. But a worker that answers with all but its
//! last tile says how late it is while that tile is still here.
//!
//! Parts go to whoever is done first with them, some back to the owner. Their bricks leave at once,
//! and so do their leases where a thread is dry. mri256 `peer-semi` at 1024x1024, 9 frames on 15
//! and 64 workers: 88.3 and 67.3 % of n times one core's speed without, 89.5 and 69.5 with it
//! (docs/scaling.md, Large scenes).

use crate::Micros;
use crate::policy::region::Part;
use crate::state::cluster::Cluster;
use crate::state::frame::{Frame, Slab};
use crate::state::task_queue::End;
use crate::state::worker_map::WorkerMap;
use crate::state::workers::Roster;
use slabcast_common::ids::WorkerId;

/// How much later than the mean a worker has to be for its last tile to be cut: this part of what
/// the tile takes, and so many microseconds. In parts a tile takes a quarter longer; at half as
/// much 64 workers have 67.6 % where they have 69.5, and at double 68.0, which is little more than
/// runs differ by.
const LATE: (f64, f64) = (0.2, 400.0);

/// A tile that takes less is not cut, in microseconds: its parts take less than their messages.
const LEAST: f64 = 500.0;

/// What a part costs a worker that has not drawn it before beside its bricks, in microseconds: a
/// lease on its way. At 700 fewer move that would have won something.
const AWAY: f64 = 300.0;

/// How long each worker that stays has to do, in microseconds.
pub(crate) struct Left {
    each: WorkerMap<f64>,
    mean: f64,
}

impl Frame {
    /// Before a worker is lent a tile of its own: cuts it, if the worker would be done too late
    /// with it. Who has tiles to draw for that, the worker itself among them; nobody where the tile
    /// stays whole. `known` keeps what each has left to do while no tile is cut and no time goes
    /// by: what is lent meanwhile changes nothing of it.
    pub(crate) fn split_late(
        &mut self,
        cluster: &Cluster,
        (place, id): (u32, WorkerId),
        now: Micros,
        known: &mut Option<Left>,
    ) -> Vec<WorkerId> {
        let Some(parts) = self.late_parts(cluster, (place, id), now, known) else {
            return Vec::new();
        };
        *known = None;
        let Some(Slab { cut, queue, regions: Some(regions), .. }) = &mut self.slab else {
            return Vec::new();
        };
        let tiles: Vec<_> = parts.iter().map(|(part, _)| part.tile).collect();
        let takers: Vec<WorkerId> = parts.iter().map(|p| p.1).collect();
        let first = cut.tiles.len() as u32;
        self.gained.extend(takers.iter().copied().zip(first..));
        regions.split_waiting(place, parts);
        queue.cut(place, &tiles);
        cut.add(tiles);
        takers
    }

    /// The parts that a tile is to be cut into, and whose each is.
    fn late_parts(
        &self,
        cluster: &Cluster,
        (place, id): (u32, WorkerId),
        now: Micros,
        known: &mut Option<Left>,
    ) -> Option<Vec<(Part, WorkerId)>> {
        let slab = self.slab.as_ref()?;
        let regions = slab.regions.as_ref()?;
        let us = regions.took(place).filter(|us| *us >= LEAST)?;
        let task = &slab.queue.tasks[place as usize];
        let waits = |p: &u32| *p != place && slab.queue.any_waiting(&[*p]);
        if task.was_leased() || task.begun.is_some() || regions.owned(id).iter().any(waits) {
            return None;
        }
        if known.is_none() {
            *known = Some(self.left(slab, &cluster.roster, now)?);
        }
        let Left { each, mean } = known.as_ref()?;
        if each.get(id)? - mean <= LATE.0 * us + LATE.1 {
            return None;
        }
        let mut left = each.clone();
        let mine = left.get_mut(id)?;
        let threads = |id| f64::from(cluster.roster.get(id).map_or(1, |w| w.threads));
        *mine -= us / threads(id);
        let mut parts = regions.parts(place, &task.tile.rect, &cluster.history);
        parts.sort_by(|a, b| b.us.total_cmp(&a.us));
        let mut whose = Vec::with_capacity(parts.len());
        for part in parts {
            let away = |to: WorkerId| if to == id { 0.0 } else { AWAY + part.price };
            let after = |(to, left): (WorkerId, &f64)| left + part.us + away(to);
            let first = left.iter().min_by(|a, b| after(*a).total_cmp(&after(*b)));
            let to = first?.0;
            *left.get_mut(to)? += part.us / threads(to) + away(to);
            whose.push((part, to));
        }
        whose.iter().any(|(_, to)| *to != id).then_some(whose)
    }

    /// How long each worker that stays has to do, in microseconds, by what its tiles took before.
    fn left(&self, slab: &Slab, roster: &Roster, now: Micros) -> Option<Left> {
        let regions = slab.regions.as_ref()?;
        let tasks = slab.queue.tasks.iter().zip(0..);
        let open = tasks.filter(|(t, _)| t.end == End::Open).map(|(_, place)| place);
        let all = regions.left(open, roster);
        let mut left: WorkerMap<f64> =
            roster.active().map(|(id, _)| (id, all.get(id).copied().unwrap_or(0.0))).collect();
        // But for what is drawn by now of what threads draw.
        for (id, lent) in self.lent.iter() {
            let (Some(left), Some(worker)) = (left.get_mut(id), roster.get(id)) else { continue };
            let answered = self.answered.get(id).copied().unwrap_or(0);
            for lent in lent.iter().take(worker.threads as usize) {
                let took = slab.queue.place(lent.task).and_then(|place| regions.took(place));
                let since = now.saturating_sub(lent.sent.max(answered)) as f64;
                *left -= took.unwrap_or(0.0).min(since) / f64::from(worker.threads);
            }
            *left = left.max(0.0);
        }
        let mean = left.values().sum::<f64>() / left.len() as f64;
        Some(Left { each: left, mean })
    }
}
