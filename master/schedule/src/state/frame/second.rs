//! Audited tiles that wait for a second worker: choice of that worker, and tiles that none can draw.

use super::Frame;
use crate::Clock;
use crate::state::cluster::Cluster;
use crate::state::given_up::GivenUp;
use crate::state::workers::Worker;
use slabcast_common::ids::WorkerId;

impl Frame {
    /// Gives a task whose result waits to be compared to a second worker: a trusted one if there is
    /// one, else the one with the fewest leases.
    pub(super) fn find_second(&mut self, cluster: &Cluster, place: u32) {
        let Some(region) = self.as_region_mut() else { return };
        let Some(audit) = region.core.table.queue.tasks[place as usize].audit() else { return };
        let others = cluster.roster.active().filter(|(_, w)| !audit.has_vote_of(&w.identity));
        let key =
            |w: &Worker| (w.is_stuck, !w.is_trusted, !audit.is_elsewhere(&w.identity), w.leases);
        let second = others.min_by_key(|(_, w)| key(w)).map(|(id, _)| id);
        if let Some(id) = second {
            region.tiles.give(place, id);
        }
    }

    /// Accepts the only result of a tile, unaudited, if no linked worker can draw it a second time.
    /// Gives a tile up if workers drew different pixels and no third came within 10 s.
    pub(super) fn take_uncompared(&mut self, cluster: &mut Cluster, clock: &dyn Clock) {
        let now = clock.now();
        let (slab, _) = self.slab();
        let core = self.core_mut();
        let held: Vec<u32> = core.table.queue.held().collect();
        if !held.is_empty() {
            cluster.roster.mark_stuck(now);
        }
        for place in held {
            let core = self.core_mut();
            let task = &core.table.queue.tasks[place as usize];
            let Some(audit) = task.audit() else { continue };
            let may = |id: WorkerId, w: &Worker| {
                let comes = task.expects(id).unwrap_or(!w.leaving);
                comes && !w.is_stuck && !audit.has_vote_of(&w.identity)
            };
            if cluster.roster.iter().any(|(id, w)| may(id, w)) {
                continue;
            }
            if let Some(names) = audit.undecided(now) {
                let given_up = GivenUp::undecided(&core.table, place, slab, names);
                core.given_up.get_or_insert(Box::new(given_up));
            } else if let Some(drawn) = core.table.queue.take_sole_vote(place) {
                core.unaudited.insert(drawn.who.clone());
                self.enter(cluster, place, drawn, clock);
                // Prefetch goes by results of the worker that the event is about.
                cluster.newly_used.clear();
            }
        }
    }
}
