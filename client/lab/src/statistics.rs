//! Statistics that more than one experiment reports.

/// Returns Spearman's rank correlation of pairs, from -1 to 1. Ties share the mean of their ranks.
/// `None` for fewer than three pairs, or if all values of one side are equal.
pub(crate) fn spearman(pairs: &[(f64, f64)]) -> Option<f64> {
    let n = pairs.len();
    if n < 3 {
        return None;
    }
    let ranks = |value: &dyn Fn(usize) -> f64| {
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&a, &b| value(a).total_cmp(&value(b)));
        let mut ranks = vec![0.0; n];
        let mut i = 0;
        while i < n {
            let same = order[i..].iter().take_while(|&&j| value(j) == value(order[i])).count();
            for &j in &order[i..i + same] {
                ranks[j] = i as f64 + (same as f64 - 1.0) / 2.0;
            }
            i += same;
        }
        ranks
    };
    let (a, b) = (ranks(&|i| pairs[i].0), ranks(&|i| pairs[i].1));
    let middle = (n as f64 - 1.0) / 2.0;
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (a, b) in a.iter().zip(&b) {
        let (a, b) = (a - middle, b - middle);
        (ab, aa, bb) = (ab + a * b, aa + a * a, bb + b * b);
    }
    (aa > 0.0 && bb > 0.0).then(|| ab / libm::sqrt(aa * bb))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spearman_of_equal_reversed_and_tied_ranks() {
        let up: Vec<(f64, f64)> = (0..9).map(|i| (f64::from(i), f64::from(i * i))).collect();
        let down: Vec<(f64, f64)> = up.iter().map(|p| (p.0, -p.1)).collect();
        assert_eq!(spearman(&up), Some(1.0));
        assert_eq!(spearman(&down), Some(-1.0));
        // By hand: ranks 0.5 0.5 2 3 against 0 1 2 3, 4.5 / sqrt(4.5 * 5).
        let ties = [(1.0, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, 4.0)];
        assert!((spearman(&ties).unwrap() - 4.5 / (4.5f64 * 5.0).sqrt()).abs() < 1e-12);
        assert_eq!(spearman(&[(1.0, 2.0), (1.0, 3.0), (1.0, 4.0)]), None);
        assert_eq!(spearman(&up[..2]), None);
    }
}
