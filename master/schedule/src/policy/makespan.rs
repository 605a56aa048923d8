//! Makespan of a sole frame: splits long tiles and assigns tiles to workers so that all workers end
//! at once.
//!
//! While several frames overlap, a worker that is done with one goes on with the next. A sole frame
//! is complete with its last tile, and threads that are done before wait. So its *makespan* counts.
//! Tiles of 64 pixels may be too coarse (mri256 `peer-semi` at 1024x1024 has 115 of them for 64
//! threads, and the longest takes longer than a 64th of the frame), and tiles of 32 take a quarter
//! longer altogether. Neither is right for all tiles: those longer than a thread's share have to be
//! split, most others need not be.
//!
//! - [`choose_splits`] predicts the makespan before the frame for a growing number of tiles split,
//!   the longest first, then for a growing number of the shortest. The least prediction wins.
//! - [`rebalance`] starts from the owners of the frame before and moves or swaps tiles as long as
//!   the makespan shrinks by more than the bricks that come along are worth.
//!
//! Views turn, and a tile takes some percent more or less than in the frame before. Work stealing
//! (`dispatch::steal`) mends that while the frame is drawn.
//!
//! It refuses to know frames, positions and bricks: it sees times.

use super::cost_model::{CostModel, WORTHWHILE_RATIO, predict_end};

/// Tuning (ratio): price of bricks for those who share the link with them, to that for the worker
/// that waits for them. At nothing a third more bricks move; at 1 a tenth fewer, for a later end.
const SHARED_LINK_RATIO: f64 = 0.2;

/// Limit: a prediction worse by this ratio ends a search, since more splits only take longer.
const GIVE_UP_RATIO: f64 = 1.1;

/// Returns which tiles to split for the earliest end on `threads` threads.
///
/// `us`: rendering time of each whole tile. `parts`: rendering times of a tile's parts, asked for
/// only where whole tiles are too coarse.
pub(crate) fn choose_splits(
    costs: &CostModel,
    us: &[f64],
    parts: impl Fn(usize) -> Vec<f64>,
    threads: usize,
) -> Vec<bool> {
    let n = us.len();
    let better = 1.0 - WORTHWHILE_RATIO;
    let whole: Vec<u64> = us.iter().map(|us| costs.item(*us)).collect();
    let (mut least, mut long, mut short) = (predict_end(&mut whole.clone(), threads), 0, 0);
    let share = us.iter().sum::<f64>() / threads.max(1) as f64;
    if better * better * least <= share {
        return vec![false; n];
    }
    let parts = |i: usize| parts(i).into_iter().map(|us| costs.item(us)).collect();
    let parts: Vec<Vec<u64>> = (0..n).map(parts).collect();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| us[b].total_cmp(&us[a]));
    // Entry n: time and tiles that splitting the n longest tiles adds.
    let mut added = vec![(0.0, 0)];
    for (&i, rank) in order.iter().zip(0..) {
        let (time, tiles): (f64, usize) = added[rank];
        let parts = &parts[i];
        let more = parts.iter().sum::<u64>() as f64 - whole[i] as f64;
        added.push((time + more, tiles + parts.len()));
    }
    let all = whole.iter().sum::<u64>() as f64;
    // The end if no thread waited: what can't be better is not predicted.
    let soonest = |long: usize, short: usize| {
        let [a, b, c] = [long, n, n - short].map(|rank| added[rank]);
        let (time, tiles) = (all + a.0 + b.0 - c.0, n - long - short + a.1 + b.1 - c.1);
        time / (16.0 * threads as f64) + costs.master_us(tiles)
    };
    let mut items = Vec::new();
    let mut end_with = |(long, short): (usize, usize), least: f64| {
        let soonest = soonest(long, short);
        if soonest >= better * least {
            return soonest;
        }
        items.clear();
        for (rank, &i) in order.iter().enumerate() {
            if rank < long || rank + short >= n {
                items.extend_from_slice(&parts[i]);
            } else {
                items.push(whole[i]);
            }
        }
        predict_end(&mut items, threads)
    };
    for count in counts(n) {
        let end = end_with((count, 0), least);
        if end < better * least {
            (least, long) = (end, count);
        } else if end > GIVE_UP_RATIO * least {
            break;
        }
    }
    for count in counts(n - long) {
        let end = end_with((long, count), least);
        if end < better * least {
            (least, short) = (end, count);
        } else if end > GIVE_UP_RATIO * least {
            break;
        }
    }
    let mut split = vec![false; n];
    for (rank, &i) in order.iter().enumerate() {
        split[i] = rank < long || rank + short >= n;
    }
    split
}

/// Returns the numbers of tiles that are tried: each half as large again as the one before, up to
/// `n`.
fn counts(n: usize) -> impl Iterator<Item = usize> {
    let next = move |&c: &usize| (c < n).then(|| (c + 1).max(c * 3 / 2).min(n));
    std::iter::successors((n > 0).then_some(1), next)
}

/// Moves tiles away from the worker that ends last, or swaps them, while the end gets earlier by
/// enough.
///
/// `slack`: part of the mean by which a worker may end late. `owners`: index of each tile's worker,
/// changed in place. `cost`: time that a tile takes a worker. `price`: time that its bricks take a
/// worker that gets it.
pub(crate) fn rebalance(
    owners: &mut [usize],
    workers: usize,
    slack: f64,
    cost: impl Fn(usize, usize) -> f64,
    price: impl Fn(usize, usize) -> f64,
) {
    let takes = |i: usize, w: usize| cost(i, w) + price(i, w);
    let mut load = vec![0.0; workers];
    let mut owned: Vec<Vec<usize>> = vec![Vec::new(); workers];
    for (i, &w) in owners.iter().enumerate() {
        load[w] += takes(i, w);
        owned[w].push(i);
    }
    for _ in 0..2 * owners.len() + workers {
        let by = |a: &usize, b: &usize| load[*a].total_cmp(&load[*b]);
        let Some(most) = (0..workers).max_by(by) else { break };
        // A tile that leaves a slow worker takes less, so the mean is taken anew.
        let mean = load.iter().sum::<f64>() / workers as f64;
        if load[most] <= (1.0 + slack) * mean {
            break;
        }
        // Gain, tile that goes, tile that comes back, receiver. Between two equally fast workers no
        // more is gained than half of what one is later by; so workers with most time come first,
        // and most others are not looked at.
        let mut best: Option<(f64, usize, Option<usize>, usize)> = None;
        let mut others: Vec<usize> = (0..workers).filter(|&to| to != most).collect();
        others.sort_by(by);
        for to in others {
            if best.is_some_and(|b| b.0 >= 0.5 * (load[most] - load[to])) {
                break;
            }
            for &i in &owned[most] {
                // A fifth, since it takes several moves to level all.
                let least_gain = 0.2 * slack * mean;
                let can_gain = |us: f64, best: Option<(f64, usize, Option<usize>, usize)>| {
                    us > best.map_or(least_gain, |b| b.0)
                };
                let mut consider = |from: f64, here: f64, back: Option<usize>, paid: f64| {
                    let gain = load[most] - from.max(here) - SHARED_LINK_RATIO * paid.max(0.0);
                    if can_gain(gain, best) {
                        best = Some((gain, i, back, to));
                    }
                    best
                };
                let leaves = takes(i, most);
                let (from, here) = (load[most] - leaves, load[to] + takes(i, to));
                let paid = price(i, to) - price(i, most);
                let mut best = consider(from, here, None, paid);
                let cost_here = cost(i, to);
                for &j in &owned[to] {
                    // No more is gained than the worker gets rid of, so most are not looked at.
                    let comes = takes(j, most);
                    if !can_gain(leaves - comes, best) || cost(j, to) >= cost_here {
                        continue;
                    }
                    let (from, here) = (from + comes, here - takes(j, to));
                    let paid = paid + price(j, most) - price(j, to);
                    best = consider(from, here, Some(j), paid);
                }
            }
        }
        let Some((_, i, back, to)) = best else { break };
        let mut moves = |i: usize, from: usize, to: usize| {
            load[from] -= takes(i, from);
            load[to] += takes(i, to);
            owned[from].retain(|&k| k != i);
            owned[to].push(i);
            owners[i] = to;
        };
        moves(i, most, to);
        if let Some(j) = back {
            moves(j, to, most);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::cost_model::TEST_COSTS;

    /// Splits tiles whose parts take a quarter longer.
    fn cut(us: &[f64], threads: usize) -> Vec<bool> {
        choose_splits(&TEST_COSTS, us, |i| vec![0.31 * us[i]; 4], threads)
    }

    #[test]
    fn makespan_splits_a_tile_longer_than_a_threads_share_and_few_others() {
        // 41 ms for four threads, one tile of 20.
        let us = [3000.0, 20_000.0, 3000.0, 3000.0, 3000.0, 3000.0, 3000.0, 3000.0];
        let cut = cut(&us, 4);
        assert!(cut[1], "20 ms of a share of 10");
        assert!(cut.iter().filter(|c| **c).count() <= 3, "{cut:?}");
    }

    #[test]
    fn makespan_splits_nothing_where_tiles_are_fine_enough_or_short() {
        let many: Vec<f64> = (0..100).map(|i| 2000.0 + 10.0 * f64::from(i)).collect();
        assert!(!cut(&many, 4).contains(&true));
        // Tiles of 50 us stay whole: cutting them would only give the master more messages.
        assert!(!cut(&[50.0; 8], 6).contains(&true));
        assert!(cut(&[], 4).is_empty());
        assert_eq!(cut(&[1000.0], 0), [false]);
    }

    #[test]
    fn makespan_splits_equal_tiles_a_few_more_than_threads() {
        // Five tiles for four threads: whole, the fifth has everybody wait for as long again.
        let cut = cut(&[10_000.0; 5], 4);
        let n = cut.iter().filter(|c| **c).count();
        assert!((1..5).contains(&n), "{cut:?}");
    }

    #[test]
    fn rebalance_moves_and_swaps_tiles_until_all_workers_end_at_once() {
        let us = [8.0, 7.0, 6.0, 5.0, 3.0, 1.0].map(|ms| 1000.0 * ms);
        let load = |owners: &[usize]| {
            let of = |w| (0..us.len()).filter(|&i| owners[i] == w).map(|i| us[i]).sum::<f64>();
            [0, 1, 2].map(of)
        };
        // 15, 11 and 4 ms; with 10 each nobody waits, which takes a swap.
        let mut owners = [0, 0, 1, 1, 2, 2];
        rebalance(&mut owners, 3, WORTHWHILE_RATIO, |i, _| us[i], |_, _| 0.0);
        let all = load(&owners);
        assert!(all.iter().all(|l| (8_900.0..11_100.0).contains(l)), "{all:?}");
        // Bricks that take longer than what is won keep all where they are.
        let mut owners = [0, 0, 1, 1, 2, 2];
        let home = owners;
        rebalance(
            &mut owners,
            3,
            WORTHWHILE_RATIO,
            |i, _| us[i],
            |i, w| if home[i] == w { 0.0 } else { 9_000.0 },
        );
        assert_eq!(owners, home);
    }
}
