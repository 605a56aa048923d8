//! From the bricks that are to go to a worker to the actions that send them.

use crate::account::ledger::Ledger;
use crate::state::cluster::Cluster;
use crate::state::residency::ResidencyAction;
use crate::{Action, Micros};
use slabcast_common::ids::WorkerId;
use slabcast_common::message::ToWorker;

/// Sends a worker the bricks it is to be sent, and tells it which to drop.
pub(crate) fn send_bricks(
    cluster: &mut Cluster,
    mut ledger: Option<&mut Ledger>,
    id: WorkerId,
    now: Micros,
) {
    let roster = &mut cluster.roster;
    let mut is_first = cluster.residency.transfer(id).is_none();
    let actions = cluster.residency.flush(id, now, &mut || roster.ping(id, now));
    for action in actions {
        match action {
            ResidencyAction::Drop { set, bricks, nonce } => {
                cluster.send(id, ToWorker::DropBricks { set, bricks });
                cluster.send(id, ToWorker::Ping { nonce });
            }
            ResidencyAction::Send { set, bricks, bytes, over_budget } => {
                cluster.link_use.bricks_sent(bytes, std::mem::take(&mut is_first), now);
                if let Some(ledger) = &mut ledger {
                    ledger.bricks_sent(id, bricks.len() as u64, bytes);
                }
                cluster.totals.over_budget += u64::from(over_budget);
                cluster.out.push_back(Action::SendBricks { worker: id, set, bricks });
            }
        }
    }
}
