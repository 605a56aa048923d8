//! A tile that no worker could draw, in words for users.

use crate::state::leases::LeaseTable;
use crate::state::task_queue::Failure;
use slabcast_common::stats::PoisonedTile;

/// Limit: workers whose failures the reason of a failed frame tells.
const TOLD_WORKERS: usize = 8;

/// A tile that no worker could draw.
#[derive(Debug)]
pub(crate) struct GivenUp {
    pub(crate) tile: PoisonedTile,
    /// Which tile, and what became of each worker that tried it, for users.
    pub(crate) reason: String,
}

impl GivenUp {
    /// Tells of the task at an index, of a slab, that workers drew differently.
    pub(crate) fn undecided(
        table: &LeaseTable,
        place: u32,
        slab: usize,
        names: Vec<String>,
    ) -> GivenUp {
        let rect = table.tile(place);
        let (size, x, y) = (table.cut.edge_of(&rect), rect.x0 as u32, rect.y0 as u32);
        let workers: Vec<String> = names.iter().map(|n| printable(n)).collect();
        let reason = format!(
            "{} drew different pixels of the tile of {size} pixels at {x},{y}, and no other worker is \
             there to say who is right; start one, best on the master's machine",
            workers.join(" and ")
        );
        GivenUp { tile: PoisonedTile { slab: slab as u32, x, y, size, workers }, reason }
    }

    /// Tells of the task at an index, of a slab.
    pub(crate) fn new(table: &LeaseTable, place: u32, slab: usize) -> GivenUp {
        let task = &table.queue.tasks[place as usize];
        let rect = task.tile.rect;
        let size = table.cut.edge_of(&rect);
        let tried = |f: &Failure| {
            let name: String = printable(&f.who.name);
            match (&f.said, f.times) {
                (Some(said), _) => format!("{name} refused it: {}", printable(said)),
                (None, 1) => format!("{name} was lost with it"),
                (None, times) => format!("{name} was lost with it {times} times"),
            }
        };
        let told: Vec<String> = task.failures.iter().take(TOLD_WORKERS).map(tried).collect();
        let more = match task.failures.len().saturating_sub(TOLD_WORKERS) {
            0 => String::new(),
            more => format!("; and {more} more workers"),
        };
        let (x, y) = (rect.x0, rect.y0);
        let reason = format!(
            "no worker could draw the tile of {size} pixels at {x},{y}: {}{more}; see the workers' logs",
            told.join("; ")
        );
        let workers = task.failures.iter().map(|f| printable(&f.who.name)).collect();
        let (slab, x, y) = (slab as u32, x as u32, y as u32);
        let tile = PoisonedTile { slab, x, y, size, workers };
        GivenUp { tile, reason }
    }
}

/// Returns a peer's text without control characters, at most 200 characters of it.
fn printable(text: &str) -> String {
    text.chars().take(200).map(|c| if c.is_control() { ' ' } else { c }).collect()
}
