//! Pairwise testing: few settings that cover every pair of values.
//!
//! Most mistakes show when two settings meet (D. Cohen et al. 1997, "The AETG system"): with
//! every value of each setting beside every value of every other one, 30 rows stand for 576.

/// Returns rows of value indices, one a setting, in which any two values of two settings occur
/// together; `levels` has the number of values of each setting. Greedy and deterministic: each row
/// is the first of those that cover most new pairs. Among those it prefers rows that repeat an
/// earlier combination of the settings `shared`: a cluster is started for each combination.
pub(crate) fn rows(levels: &[usize], shared: &[usize]) -> Vec<Vec<usize>> {
    let all = product(levels);
    let combination = |row: &[usize]| shared.iter().map(|&i| row[i]).collect::<Vec<usize>>();
    let mut started = std::collections::BTreeSet::new();
    let mut open: std::collections::BTreeSet<[usize; 4]> = std::collections::BTreeSet::new();
    for row in &all {
        open.extend(pairs(row));
    }
    let mut chosen = Vec::new();
    while !open.is_empty() {
        let news = |row: &&Vec<usize>| {
            let fresh = pairs(row).filter(|p| open.contains(p)).count();
            (fresh, started.contains(&combination(row)))
        };
        // The first of the best: max_by_key would take the last.
        let Some(best) = all.iter().rev().max_by_key(news).cloned() else { break };
        for pair in pairs(&best) {
            open.remove(&pair);
        }
        started.insert(combination(&best));
        chosen.push(best);
    }
    chosen
}

/// Returns every combination, the last setting changing fastest.
pub(crate) fn product(levels: &[usize]) -> Vec<Vec<usize>> {
    levels.iter().fold(vec![Vec::new()], |rows, &n| {
        rows.iter()
            .flat_map(|row| (0..n).map(|v| row.iter().copied().chain([v]).collect()))
            .collect()
    })
}

/// `[setting, value, setting, value]` of all pairs in a row.
fn pairs(row: &[usize]) -> impl Iterator<Item = [usize; 4]> + use<'_> {
    (0..row.len()).flat_map(move |a| (a + 1..row.len()).map(move |b| [a, row[a], b, row[b]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pairwise_rows_cover_every_pair_in_few_rows() {
        let levels = [4, 6, 3, 2, 2, 2];
        let (all, some) = (product(&levels), rows(&levels, &[]));
        assert_eq!(all.len(), 576);
        assert!((24..=32).contains(&some.len()), "{} rows", some.len());
        let covered: std::collections::BTreeSet<_> = some.iter().flat_map(|r| pairs(r)).collect();
        for row in &all {
            for pair in pairs(row) {
                assert!(covered.contains(&pair), "{pair:?} never meets");
            }
        }
        assert_eq!(some, rows(&levels, &[]), "the same every time");
    }

    #[test]
    fn shared_settings_take_few_combinations() {
        let (levels, shared) = ([4, 6, 3, 2, 2, 3, 2], [0, 3, 5]);
        let rows = rows(&levels, &shared);
        let combinations: std::collections::BTreeSet<_> =
            rows.iter().map(|r| shared.map(|i| r[i])).collect();
        // The 24 rows take no more combinations than four workers on three links have alone.
        assert_eq!((rows.len(), combinations.len()), (24, 12));
    }
}
