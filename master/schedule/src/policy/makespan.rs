//! A frame that is alone in the making: which of its tiles are cut, and who draws what, so that all
//! are done at once.
//!
//! While several frames are in the making, whoever is done with one goes on with the next. Alone, a
//! frame is there when its last tile is, and threads that are done before wait. So what counts is
//! its *end*: how late the last thread is done. Tiles of 64 pixels may be too coarse for that
//! (mri256 `peer-semi` at 1024x1024 has 115 of them for 64 threads, and the longest takes longer
//! than a 64th of the frame), and tiles of 32 take a quarter longer altogether. Neither is right
//! for all tiles of a frame: those that are longer than a thread's share have to be cut, most
//! others need not be.
//!
//! **Which are cut** ([`which`]) is tried on paper before the frame, with what the frames before
//! taught: the longest tile goes to whoever is free first, and so on, for a growing number of tiles
//! cut, the longest first, and then for a growing number of the shortest. The least end counts.
//!
//! **Who draws them** ([`balance`]): who drew them last. From there tiles move, or change places,
//! as long as the end comes earlier by more than the bricks that go along are worth.
//!
//! Views turn, and what a tile took in the view before is some percent off. What is late then is
//! cut as it is lent (`frame::late`).
//!
//! It refuses to know frames, tiles' places and bricks: it sees times.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// What a tile costs its thread beyond drawing, in microseconds: a result and a lease (`plan`
/// charges a worker 28 for waking and some more for the messages). At nothing or at 100 the figures
/// of [`WORTH`] change by their noise.
const EACH: f64 = 40.0;

/// What a tile costs everybody, in microseconds, since the master hears of one after the other. At
/// nothing small scenes and large ones alike are cut into more tiles than pay: mri256 `peer-semi`
/// on 64 workers has 61 % where it has 66.
const LEASE: f64 = 10.0;

/// What is left of the end where more tiles are cut. Estimates are no better than that: mri256
/// `peer-semi` at 1024x1024 on 15, 32 and 64 workers has 89, 82, 68 % with this, and 89, 81, 66
/// with each tile cut that seems to win anything.
const WORTH: f64 = 0.99;

/// An end that is so much later is not followed by one that is earlier, since all that is cut takes
/// longer. Trying on costs the master 10 us each.
const FAR: f64 = 1.1;

/// Who is done last is later than the mean by so little that nothing moves.
const EVEN: f64 = 1.01;

/// The least that a move has to win, as a part of the mean.
const LEAST: f64 = 0.002;

/// What bricks cost those who share the link with them, as a part of what they cost who waits for
/// them. At nothing a third more bricks move, and at 1 no more than a tenth fewer, for a later end.
const PAYS: f64 = 0.2;

/// Which tiles are cut for the frame to end first, on so many threads. They take so many
/// microseconds whole; what the parts of one take is asked for only where whole tiles are not fine
/// enough.
pub(crate) fn which(us: &[f64], parts: impl Fn(usize) -> Vec<f64>, threads: usize) -> Vec<bool> {
    let n = us.len();
    let whole: Vec<u64> = us.iter().map(|us| item(*us)).collect();
    let (mut least, mut long, mut short) = (end(&mut whole.clone(), threads), 0, 0);
    let share = us.iter().sum::<f64>() / threads.max(1) as f64;
    if WORTH * WORTH * least <= share {
        return vec![false; n];
    }
    let parts = |i: usize| parts(i).into_iter().map(item).collect();
    let parts: Vec<Vec<u64>> = (0..n).map(parts).collect();
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&a, &b| us[b].total_cmp(&us[a]));
    // What it adds to cut so many of the longest: to the time of all tiles, and to their number.
    let mut added = vec![(0.0, 0)];
    for (&i, rank) in order.iter().zip(0..) {
        let (time, tiles): (f64, usize) = added[rank];
        let parts = &parts[i];
        let more = parts.iter().sum::<u64>() as f64 - whole[i] as f64;
        added.push((time + more, tiles + parts.len()));
    }
    let all = whole.iter().sum::<u64>() as f64;
    // When all would be done if no thread waited.
    let soonest = |long: usize, short: usize| {
        let [a, b, c] = [long, n, n - short].map(|rank| added[rank]);
        let (time, tiles) = (all + a.0 + b.0 - c.0, n - long - short + a.1 + b.1 - c.1);
        time / (16.0 * threads as f64) + LEASE * tiles as f64
    };
    let mut items = Vec::new();
    let mut end_with = |(long, short): (usize, usize), least: f64| {
        // What can't be sooner by enough is not tried.
        let soonest = soonest(long, short);
        if soonest >= WORTH * least {
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
        end(&mut items, threads)
    };
    for count in counts(n) {
        let end = end_with((count, 0), least);
        if end < WORTH * least {
            (least, long) = (end, count);
        } else if end > FAR * least {
            break;
        }
    }
    for count in counts(n - long) {
        let end = end_with((long, count), least);
        if end < WORTH * least {
            (least, short) = (end, count);
        } else if end > FAR * least {
            break;
        }
    }
    let mut cut = vec![false; n];
    for (rank, &i) in order.iter().enumerate() {
        cut[i] = rank < long || rank + short >= n;
    }
    cut
}

/// How many tiles are tried: each time half as many again, and all.
fn counts(n: usize) -> impl Iterator<Item = usize> {
    let next = move |&c: &usize| (c < n).then(|| (c + 1).max(c * 3 / 2).min(n));
    std::iter::successors((n > 0).then_some(1), next)
}

/// What a tile takes its thread, in sixteenths of a microsecond, which have an order and are sorted
/// in a third of the time.
fn item(us: f64) -> u64 {
    (16.0 * (us + EACH)) as u64
}

/// When the last thread is done, if each that is free takes the longest that is left; with what the
/// master needs.
fn end(items: &mut [u64], threads: usize) -> f64 {
    items.sort_unstable();
    let mut free: BinaryHeap<Reverse<u64>> = (0..threads).map(|_| Reverse(0)).collect();
    let mut last = 0;
    for item in items.iter().rev() {
        let Some(mut first) = free.peek_mut() else { break };
        first.0 += item;
        last = last.max(first.0);
    }
    last as f64 / 16.0 + LEASE * items.len() as f64
}

/// Moves tiles from who is done last, and has them change places, while that pays. `owners` says
/// whose each tile is, `cost` what it takes a worker, and `price` what its bricks take one that it
/// comes to.
pub(crate) fn balance(
    owners: &mut [usize],
    workers: usize,
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
        // A tile that leaves a slow worker takes less.
        let mean = load.iter().sum::<f64>() / workers as f64;
        if load[most] <= EVEN * mean {
            break;
        }
        // What is won, what goes there, what comes back, and to whom. Between two that are as fast
        // no more is won than half of what one is later by than the other; so who has most time
        // comes first, and most others are not looked at.
        let mut best: Option<(f64, usize, Option<usize>, usize)> = None;
        let mut others: Vec<usize> = (0..workers).filter(|&to| to != most).collect();
        others.sort_by(by);
        for to in others {
            if best.is_some_and(|b| b.0 >= 0.5 * (load[most] - load[to])) {
                break;
            }
            for &i in &owned[most] {
                let mut consider = |from: f64, here: f64, back: Option<usize>, paid: f64| {
                    let gain = load[most] - from.max(here) - PAYS * paid.max(0.0);
                    if gain > LEAST * mean && best.is_none_or(|b| gain > b.0) {
                        best = Some((gain, i, back, to));
                    }
                };
                let (from, here) = (load[most] - takes(i, most), load[to] + takes(i, to));
                let paid = price(i, to) - price(i, most);
                consider(from, here, None, paid);
                for &j in owned[to].iter().filter(|&&j| cost(j, to) < cost(i, to)) {
                    let (from, here) = (from + takes(j, most), here - takes(j, to));
                    consider(from, here, Some(j), paid + price(j, most) - price(j, to));
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

    /// Which are cut of tiles whose parts take a quarter longer.
    fn cut(us: &[f64], threads: usize) -> Vec<bool> {
        which(us, |i| vec![0.31 * us[i]; 4], threads)
    }

    #[test]
    fn a_tile_longer_than_a_share_is_cut_and_the_others_are_not() {
        // 41 ms for four threads, one tile of 20.
        let us = [3000.0, 20_000.0, 3000.0, 3000.0, 3000.0, 3000.0, 3000.0, 3000.0];
        let cut = cut(&us, 4);
        assert!(cut[1], "20 ms of a share of 10");
        assert!(cut.iter().filter(|c| **c).count() <= 3, "{cut:?}");
    }

    #[test]
    fn nothing_is_cut_where_tiles_are_fine_enough_or_short() {
        let many: Vec<f64> = (0..100).map(|i| 2000.0 + 10.0 * f64::from(i)).collect();
        assert!(!cut(&many, 4).contains(&true));
        // Of 50 us each, cutting would only have the master hear more of them.
        assert!(!cut(&[50.0; 8], 6).contains(&true));
        assert!(cut(&[], 4).is_empty());
        assert_eq!(cut(&[1000.0], 0), [false]);
    }

    #[test]
    fn equal_tiles_a_few_more_than_threads_are_cut_where_that_ends_sooner() {
        // Five tiles for four threads: whole, the fifth has everybody wait for as long again.
        let cut = cut(&[10_000.0; 5], 4);
        let n = cut.iter().filter(|c| **c).count();
        assert!((1..5).contains(&n), "{cut:?}");
    }

    #[test]
    fn tiles_move_and_change_places_until_all_are_done_at_once() {
        let us = [8.0, 7.0, 6.0, 5.0, 3.0, 1.0].map(|ms| 1000.0 * ms);
        let load = |owners: &[usize]| {
            let of = |w| (0..us.len()).filter(|&i| owners[i] == w).map(|i| us[i]).sum::<f64>();
            [0, 1, 2].map(of)
        };
        // 15, 11 and 4 ms; with 10 each nobody waits, which takes a swap.
        let mut owners = [0, 0, 1, 1, 2, 2];
        balance(&mut owners, 3, |i, _| us[i], |_, _| 0.0);
        let all = load(&owners);
        assert!(all.iter().all(|l| (8_900.0..11_100.0).contains(l)), "{all:?}");
        // Bricks that take longer than what is won keep all where they are.
        let mut owners = [0, 0, 1, 1, 2, 2];
        let home = owners;
        balance(&mut owners, 3, |i, _| us[i], |i, w| if home[i] == w { 0.0 } else { 9_000.0 });
        assert_eq!(owners, home);
    }
}
