//! The Pareto front of settings by time and error, and its knee.

/// Time and error of a setting; less is better in both.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Point {
    /// Frame time in ms.
    pub(crate) ms: f64,
    /// Error in 1/255.
    pub(crate) error: f64,
}

/// Least share by which a slower setting has to lower the error. Smaller differences are those
/// between samples of pixels, and a front would follow them for ever (eight times the time for
/// half a percent, on mri256 in `peer-semi`).
pub(crate) const WORTH: f64 = 0.02;

/// Returns the indices of the Pareto front, from fast to slow: each point's error is lower than
/// that of every faster one by [`WORTH`] or more. Of equal points the first is taken; points that
/// are not finite are left out.
pub(crate) fn front(points: &[Point]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..points.len())
        .filter(|&i| points[i].ms.is_finite() && points[i].error.is_finite())
        .collect();
    order.sort_by(|&a, &b| {
        let (a, b) = (&points[a], &points[b]);
        a.ms.total_cmp(&b.ms).then(a.error.total_cmp(&b.error))
    });
    let mut least = f64::INFINITY;
    order.retain(|&i| {
        let better = points[i].error < least * (1.0 - WORTH);
        if better {
            least = points[i].error;
        }
        better
    });
    order
}

/// Returns the index of a front's knee: the point farthest below the straight line between the ends
/// of the front, with both axes logarithmic ("kneedle", Satopaa et al. 2011). `None` for fewer than
/// three points, or where none lies below that line.
pub(crate) fn knee(points: &[Point], front: &[usize]) -> Option<usize> {
    let logs = |i: usize| [libm::log(points[i].ms), libm::log(points[i].error.max(1e-9))];
    let (first, last) = (logs(*front.first()?), logs(*front.last()?));
    let run = [last[0] - first[0], last[1] - first[1]];
    let below = |i: usize| {
        let [x, y] = logs(i);
        // Along the line as far as the point, then down.
        first[1] + run[1] * (x - first[0]) / run[0] - y
    };
    let inner = front.get(1..front.len() - 1)?;
    inner.iter().copied().filter(|&i| below(i) > 0.0).max_by(|&a, &b| below(a).total_cmp(&below(b)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn points(of: &[(f64, f64)]) -> Vec<Point> {
        of.iter().map(|&(ms, error)| Point { ms, error }).collect()
    }

    #[test]
    fn front_and_knee_of_known_points() {
        let p = points(&[
            (10.0, 1.0),
            (1.0, 10.0),
            (2.0, 0.9),
            (2.0, 0.9),
            (3.0, 5.0),
            (100.0, 0.5),
            (f64::NAN, 0.1),
        ]);
        let f = front(&p);
        assert_eq!(f, [1, 2, 5], "from fast to slow, each better than all faster ones");
        assert_eq!(knee(&p, &f), Some(2));
        assert_eq!(knee(&p, &f[..2]), None);
        assert!(front(&[]).is_empty());
        let line = points(&[(1.0, 1.0), (2.0, 0.9), (4.0, 0.25)]);
        assert_eq!(knee(&line, &[0, 1, 2]), None, "nothing below the line");
    }

    proptest! {
        #[test]
        fn no_point_beats_the_front(of in prop::collection::vec((0.1f64..1e3, 1e-3f64..1e2), 0..60)) {
            let p = points(&of);
            let f = front(&p);
            for i in 0..p.len() {
                let as_near = |j: usize| p[j].error * (1.0 - WORTH) <= p[i].error;
                let beaten = f.iter().any(|&j| p[j].ms <= p[i].ms && as_near(j));
                prop_assert!(beaten, "a point is on the front or has one before it");
            }
            for pair in f.windows(2) {
                prop_assert!(p[pair[0]].ms < p[pair[1]].ms && p[pair[0]].error > p[pair[1]].error);
            }
        }
    }
}
