//! Levels of a volume's histogram: where its air ends, where its solid begins, how dense it gets.
//!
//! A preset that knew only the smallest and the largest value would show nothing of most files:
//! scanners leave noise around the body, saturated voxels at the top, a background of 77. Otsu's
//! threshold, the usual answer, cuts in the middle of what is there: at 100 of 255 in a flame whose
//! cloud begins at 5, and through the skin of a head. So the end of the air is looked for where the
//! eye finds it: at the foot of the background's peak, or in the valley behind it if there is one.
//!
//! 1. The background is the fullest bin; its foot is where counts have fallen to a hundredth, or,
//!    where a hill rises before that, in the middle of the valley's floor. (Noise around the body
//!    of an MR falls off slowly and is still above a hundredth where the body begins: the foot
//!    would be behind nearly all of it.)
//! 2. Behind the foot, the smoothed histogram has valleys. Of those with half of the foreground
//!    above them the deepest counts (half: so that leaves are not cut off with the air because the
//!    trunk is denser). There the content is *solid*: a surface can be drawn.
//! 3. Without a valley, but with a wide gap behind the foot, the content is whole, too. With neither
//!    the histogram falls all the way. Little foreground is *sparse*: vessels, a wire, a shell; much
//!    of it is a *cloud*, which an opaque surface would hide.
//!
//! All numbers are shares of the range that presets are fitted to ([`ValueSummary::core_range`]): 0
//! its lower end, 1 its upper one. Mostly that is the whole range; it leaves out what one hot voxel
//! or the padding around a scan would add to it.

use slabcast_common::volume::{SampleKind, ValueSummary};
use std::ops::Range;

/// Half width, as a share of the range, over which bins are averaged when valleys are looked for.
/// At half of it the noise of 8-bit histograms has valleys of its own; at double the gap between
/// the leaves and the air of a plant is gone.
const SMOOTH: f64 = 0.015;

/// Least ratio of the counts on both sides of a valley to its floor.
const DEPTH: f64 = 1.5;

/// Factor of the lowest bin below which a bin belongs to the valley's floor.
const FLOOR: f64 = 1.25;

/// Width of a gap, as a share of the range, behind which something whole begins: a label of a
/// segmentation, an object in an air that was set to zero. Tails of scans have gaps of a bin or
/// two.
const GAP: f64 = 0.1;

/// Share of the volume above which foreground without a valley is a cloud.
const CLOUD: f64 = 0.15;

/// Kind of foreground that a histogram shows, by which presets choose their shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Content {
    /// A valley of the histogram separates it from the air.
    Solid,
    /// No valley, and less than 15 % of the volume.
    Sparse,
    /// No valley, and 15 % of the volume or more.
    Cloud,
    /// No bin stands out as air: something is everywhere.
    Everywhere,
    /// One value, or none.
    Constant,
}

impl Content {
    /// Returns the kind as one word.
    pub fn name(self) -> &'static str {
        match self {
            Content::Solid => "solid",
            Content::Sparse => "sparse",
            Content::Cloud => "cloud",
            Content::Everywhere => "everywhere",
            Content::Constant => "constant",
        }
    }

    /// Returns the kind in words for people.
    pub fn what(self) -> &'static str {
        match self {
            Content::Solid => "something solid, apart from the air",
            Content::Sparse => "a little in much air",
            Content::Cloud => "a cloud that thins out into the air",
            Content::Everywhere => "no air, something everywhere",
            Content::Constant => "one value",
        }
    }
}

/// Levels of a histogram, as shares of the value range (0 to 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Levels {
    /// Kind of foreground that the histogram shows.
    pub content: Content,
    /// Upper end of the air, as a share of the value range (0 to 1): nothing is drawn below.
    pub air: f64,
    /// Value at which a surface becomes opaque, as a share of the value range (0 to 1); above
    /// `air`.
    pub solid: f64,
    /// Median of the samples above the air, as a share of the value range (0 to 1).
    pub mid: f64,
    /// Third quartile of the samples above the air, as a share of the value range (0 to 1).
    pub dense: f64,
    /// Ninth decile of the samples above the air, as a share of the value range (0 to 1).
    pub densest: f64,
    /// End of the colours, as a share of the value range (0 to 1): 0.2 % of the samples above the
    /// air exceed it.
    pub top: f64,
    /// Whether somebody has cut out what is drawn (a brain without its skull): much of the volume
    /// has one value, and next to nothing lies between that and the content.
    pub masked: bool,
    /// Value of water in the file's units, where values are Hounsfield units but for an offset;
    /// else `None`.
    pub water: Option<f64>,
}

impl Levels {
    /// Finds the levels of a volume's histogram.
    pub fn from_summary(summary: &ValueSummary) -> Levels {
        let bins = unit_histogram(summary);
        let nothing = Levels {
            content: Content::Constant,
            air: 0.0,
            solid: 0.5,
            mid: 0.5,
            dense: 0.75,
            densest: 0.9,
            top: 1.0,
            masked: false,
            water: None,
        };
        if bins.len() < 2 {
            return nothing;
        }
        let (content, air, solid) = ramp(&bins);
        let above = |share: f64| quantile(&bins, air, share);
        Levels {
            content,
            air,
            solid,
            mid: above(0.5).max(air),
            dense: above(0.75).max(solid),
            densest: above(0.9).max(solid),
            top: above(0.998).max(air + 0.02).max(solid).min(1.0),
            masked: content == Content::Solid && masked(&bins, above(0.5)),
            water: water(summary),
        }
    }
}

/// Histogram in unit coordinates, ascending, without empty bins: `(centre, count)`.
fn unit_histogram(s: &ValueSummary) -> Vec<(f64, f64)> {
    let span = s.max_code - s.min_code;
    // Codes have a bin each if they have 8 bits; others lie somewhere in theirs.
    let place = |b: usize| {
        if s.core.is_none() && s.kind == SampleKind::U8 {
            if span > 0.0 { (s.bin_code(b) - s.min_code) / span } else { 0.0 }
        } else if span > 0.0 {
            (b as f64 + 0.5) / 256.0
        } else {
            0.0
        }
    };
    let counts = s.core.as_ref().map_or(&s.histogram, |core| &core.histogram);
    let mut bins: Vec<(f64, f64)> = (0..256)
        .filter(|&b| counts[b] > 0)
        .map(|b| (if s.map.scale < 0.0 { 1.0 - place(b) } else { place(b) }, counts[b] as f64))
        .collect();
    bins.sort_by(|a, b| a.0.total_cmp(&b.0));
    bins
}

/// Returns the value that `share` of the samples at or above `from` do not exceed.
fn quantile(bins: &[(f64, f64)], from: f64, share: f64) -> f64 {
    let above = || bins.iter().filter(|b| b.0 >= from);
    let all: f64 = above().map(|b| b.1).sum();
    let mut seen = 0.0;
    for (x, n) in above() {
        seen += n;
        if seen >= all * share {
            return *x;
        }
    }
    1.0
}

/// Returns the kind of foreground, where the air ends and where a surface is opaque. There must be
/// two bins or more.
fn ramp(bins: &[(f64, f64)]) -> (Content, f64, f64) {
    let total: f64 = bins.iter().map(|b| b.1).sum();
    // Saturated samples pile up in the last bin and are no hill of their own.
    let mut n: Vec<f64> = bins.iter().map(|b| b.1).collect();
    let last = n.len() - 1;
    if n.len() > 2 {
        n[last] = n[last].min(2.0 * n[last - 1]);
    }
    let x = |i: usize| bins[i].0;
    let mut peak = 0;
    for i in 1..n.len() {
        if n[i] > n[peak] {
            peak = i;
        }
    }
    let fallen = (peak + 1..n.len()).find(|&i| n[i] <= n[peak] * 0.01);
    let slope = smooth(bins, &n, peak..fallen.unwrap_or(n.len()));
    let foot = deepest(&slope, slope.len()).map(|at| peak + middle_of_floor(&slope, at));
    let Some(foot) = foot.or(fallen) else {
        // Counts never fall: there is no air, or two values alone.
        return if n.len() == 2 {
            (Content::Solid, x(0) + (x(1) - x(0)) * 0.25, x(0) + (x(1) - x(0)) * 0.75)
        } else {
            (Content::Everywhere, 0.0, 1.0)
        };
    };
    let below: f64 = bins[..foot].iter().map(|b| b.1).sum();
    if below < 0.1 * total {
        return (Content::Everywhere, 0.0, 1.0);
    }
    let foreground = total - below;
    // Smoothed counts behind the foot, and how much is above.
    let tail = smooth(bins, &n, foot..n.len());
    let top = quantile(bins, x(foot), 0.98);
    if let Some((valley, hill)) = valley(&tail, &bins[foot..], foreground) {
        // Opaque halfway up to what lies behind the valley, and soon: a wide ramp would show a
        // body as a haze.
        let step = (0.5 * (hill - valley)).min(0.12 * (top - valley)).max(0.004);
        return (Content::Solid, valley, valley + step);
    }
    let gap = x(foot) - x(foot - 1);
    if gap > GAP {
        // Nothing in between: what lies behind it is whole, and not the tail of anything.
        let content = if foreground > CLOUD * total { Content::Solid } else { Content::Sparse };
        return (content, x(foot) - 0.75 * gap, x(foot) - 0.25 * gap);
    }
    if foreground > CLOUD * total {
        return (Content::Cloud, x(foot), quantile(bins, x(foot), 0.5).max(x(foot) + 0.01));
    }
    // A little way up the tail: what is just above the foot is noise.
    let from = x(foot) + 0.02;
    let (a, b) = (quantile(bins, from, 0.35), quantile(bins, from, 0.6));
    if b <= a {
        return (Content::Sparse, x(foot), (x(foot) + 0.02).max(a));
    }
    (Content::Sparse, a, b)
}

/// Some of the counts `n`, each the mean of those near it: `(centre, count)`.
fn smooth(bins: &[(f64, f64)], n: &[f64], part: Range<usize>) -> Vec<(f64, f64)> {
    let of = |i: usize| {
        let near = part.clone().filter(|&j| (bins[j].0 - bins[i].0).abs() <= SMOOTH);
        let (sum, count) = near.fold((0.0, 0.0), |(s, c), j| (s + n[j], c + 1.0));
        (bins[i].0, sum / count)
    };
    part.clone().map(of).collect()
}

/// Returns the deepest valley among the first `among` of the smoothed counts. The very first is one
/// where counts rise from there.
fn deepest(counts: &[(f64, f64)], among: usize) -> Option<usize> {
    let mut best: Option<(f64, usize)> = None;
    let mut left = f64::INFINITY;
    for i in 0..among {
        let right = counts[i..].iter().map(|t| t.1).fold(0.0, f64::max);
        let depth = left.min(right) / counts[i].1;
        if depth >= DEPTH && best.is_none_or(|(d, _)| depth > d) {
            best = Some((depth, i));
        }
        left = if left.is_finite() { left.max(counts[i].1) } else { counts[i].1 };
    }
    best.map(|(_, at)| at)
}

/// Returns the middle bin of the floor of a valley, whose lowest bin may be anywhere on the floor.
/// `counts` are bins with their counts; `lowest` is the index of the lowest.
fn middle_of_floor(counts: &[(f64, f64)], lowest: usize) -> usize {
    let floor = |t: &&(f64, f64)| t.1 <= FLOOR * counts[lowest].1;
    let before = counts[..lowest].iter().rev().take_while(floor).count();
    let behind = counts[lowest + 1..].iter().take_while(floor).count();
    (2 * lowest + behind - before) / 2
}

/// The deepest valley of a smoothed tail with half of the foreground above it, and the highest
/// hill behind it.
fn valley(tail: &[(f64, f64)], raw: &[(f64, f64)], foreground: f64) -> Option<(f64, f64)> {
    let mut above = foreground;
    let enough = |bin: &&(f64, f64)| {
        let here = above >= 0.5 * foreground;
        above -= bin.1;
        here
    };
    let at = deepest(tail, raw.iter().take_while(enough).count())?;
    let hill = tail[at..].iter().fold(
        (0.0, 0.0),
        |best: (f64, f64), t| {
            if t.1 > best.1 { *t } else { best }
        },
    );
    Some((tail[at].0, hill.0))
}

/// Whether content with its median at `mid` was cut out of what was around it. At the sharp edge of
/// a mask 1 to 2 % of what is drawn lies in the lower third below the median; the skin, fat and
/// bone of a whole head are 10 to 30 %.
fn masked(bins: &[(f64, f64)], mid: f64) -> bool {
    let total: f64 = bins.iter().map(|b| b.1).sum();
    let (lowest, nothing) = bins[0];
    let count = |from: f64, to: f64| -> f64 {
        bins.iter().filter(|b| b.0 > from && b.0 < to).map(|b| b.1).sum()
    };
    nothing > 0.4 * total
        && count(lowest, lowest + (mid - lowest) / 3.0) < 0.03 * count(lowest, 1.1)
}

/// The value of water, if the values are those of a CT: Hounsfield units, or these with 1000 or
/// 1024 added, as older files store them. Told by three hills: air, soft tissue, and little
/// between the two. 8-bit volumes have lost their scale.
fn water(s: &ValueSummary) -> Option<f64> {
    let (lo, hi) = s.core_range();
    if s.kind == SampleKind::U8 || hi - lo < 1200.0 || hi - lo > 20_000.0 {
        return None;
    }
    let bins = unit_histogram(s);
    let total: f64 = bins.iter().map(|b| b.1).sum();
    let share = |from: f64, to: f64| {
        let inside = bins.iter().filter(|b| (from..=to).contains(&(lo + (hi - lo) * b.0)));
        inside.map(|b| b.1).sum::<f64>() / total.max(1.0)
    };
    [0.0, 1000.0, 1024.0].into_iter().find(|water| {
        let between = |from: f64, to: f64| share(water + from, water + to);
        let (air, soft, gap) =
            (between(-1060.0, -900.0), between(-160.0, 120.0), between(-600.0, -300.0));
        lo >= water - 3100.0
            && lo <= water - 900.0
            && hi >= water + 300.0
            && air >= 0.03
            && soft >= 0.05
            && gap < 0.5 * soft
            && gap < air
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Samples, ValueMap};

    fn levels(samples: Samples) -> Levels {
        Levels::from_summary(&ValueSummary::from_samples(&samples, ValueMap::IDENTITY))
    }

    /// `n` samples spread evenly over a span.
    fn spread(from: u32, to: u32, n: u32) -> impl Iterator<Item = u16> {
        (0..n).map(move |i| (from + (to - from) * i / n.max(1)) as u16)
    }

    fn bytes(parts: &[(u32, u32, u32)]) -> Samples {
        let all = parts.iter().flat_map(|&(a, b, n)| spread(a, b, n)).map(|x| x as u8);
        Samples::U8(all.collect())
    }

    #[test]
    fn solid_body_in_air_is_cut_in_the_valley() {
        // Air at 0, a little noise, a gap, tissue from 60 on.
        let l = levels(bytes(&[(0, 1, 70_000), (1, 40, 800), (60, 140, 29_000), (255, 256, 1)]));
        assert_eq!(l.content, Content::Solid);
        let at = |t: f64| t * 255.0;
        assert!((1.0..60.0).contains(&at(l.air)), "{l:?}");
        assert!(l.air < l.solid && at(l.solid) < 90.0 && l.solid < l.top, "{l:?}");
        assert!((100.0..150.0).contains(&at(l.top)), "one bright voxel is not the top: {l:?}");
    }

    #[test]
    fn background_above_zero_counts_as_air() {
        // A tooth's scan: background about 77, dark streaks below it.
        let l = levels(bytes(&[
            (0, 70, 200),
            (72, 83, 60_000),
            (83, 130, 600),
            (140, 190, 30_000),
            (230, 250, 5_000),
        ]));
        assert_eq!(l.content, Content::Solid);
        let air = l.air * 249.0;
        assert!((83.0..140.0).contains(&air), "{l:?} cuts at {air}");
    }

    #[test]
    fn little_foreground_is_sparse_and_much_is_a_cloud() {
        let tail = |each: u32| -> Samples {
            let mut v = vec![0u8; 90_000];
            for x in 1..255u32 {
                v.extend(std::iter::repeat_n(x as u8, (each * 8 / (x + 7)) as usize));
            }
            Samples::U8(v)
        };
        let thin = levels(tail(20));
        assert_eq!(thin.content, Content::Sparse);
        assert!((5.0..80.0).contains(&(thin.air * 254.0)), "{thin:?}");
        assert!(thin.solid > thin.air && thin.solid < 0.6, "{thin:?}");
        let cloud = levels(tail(800));
        assert_eq!(cloud.content, Content::Cloud);
        assert!(cloud.air < 0.1, "{cloud:?}");
    }

    #[test]
    fn air_ends_where_noise_meets_the_body() {
        // A series of MR slices: noise falls off to a twentieth of its peak, and no further before
        // tissue rises.
        let noise = (0..14).map(|i| (i, i + 1, 50_000 >> (i / 3)));
        let floor = [(14, 40, 26 * 3_000)];
        let tissue = (40..80).map(|i| (i, i + 1, 12_000 - 400 * 20u32.abs_diff(i - 40)));
        let tail = (80..255).map(|i| (i, i + 1, 4 * (255 - i)));
        let parts: Vec<_> = noise.chain(floor).chain(tissue).chain(tail).collect();
        let l = levels(bytes(&parts));
        let at = |t: f64| t * 254.0;
        assert_eq!(l.content, Content::Solid);
        assert!((14.0..42.0).contains(&at(l.air)), "{l:?} cuts at {}", at(l.air));
        assert!(at(l.solid) < 60.0, "{l:?}");
    }

    #[test]
    fn even_histograms_have_no_air_and_one_value_is_constant() {
        assert_eq!(levels(bytes(&[(0, 256, 25_600)])).content, Content::Everywhere);
        assert_eq!(levels(bytes(&[(9, 10, 500)])).content, Content::Constant);
        assert_eq!(levels(Samples::F32(vec![f32::NAN; 9])).content, Content::Constant);
        let two = levels(bytes(&[(0, 1, 900), (200, 201, 100)]));
        assert_eq!(two.content, Content::Solid);
        assert!(two.air > 0.0 && two.solid < 1.0, "{two:?}");
    }

    #[test]
    fn ct_values_are_recognised_with_any_usual_offset() {
        let ct = |water: f64| {
            let mut v = Vec::new();
            v.extend(spread(0, 40, 50_000).map(|x| f64::from(x) - 1010.0));
            v.extend(spread(0, 100, 3_000).map(|x| f64::from(x) - 500.0));
            v.extend(spread(0, 220, 40_000).map(|x| f64::from(x) - 120.0));
            v.extend(spread(200, 1500, 3_000).map(f64::from));
            Samples::F32(v.into_iter().map(|x| (x + water) as f32).collect())
        };
        for water in [0.0, 1000.0, 1024.0] {
            let found = levels(ct(water)).water.expect("a CT");
            assert!((found - water).abs() <= 24.0, "{found} for {water}");
        }
        // An MR of the same range: nothing at the place of water.
        let mr: Vec<f32> =
            spread(0, 30, 50_000).chain(spread(200, 700, 40_000)).map(f32::from).collect();
        assert_eq!(levels(Samples::F32([mr, vec![2000.0]].concat())).water, None);
    }

    #[test]
    fn values_that_fall_with_the_code_are_turned_first() {
        let up = levels(bytes(&[(0, 1, 70_000), (60, 140, 30_000)]));
        let down = ValueSummary::from_samples(
            &bytes(&[(255, 256, 70_000), (116, 196, 30_000)]),
            ValueMap { scale: -1.0, offset: 255.0 },
        );
        let down = Levels::from_summary(&down);
        assert_eq!(down.content, up.content);
        assert!((down.air - up.air).abs() < 0.02, "{down:?} {up:?}");
    }
}
