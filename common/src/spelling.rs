//! Spelling help: the known word that a mistyped one probably means.

/// Returns the word of `list` that is at most two edits from `word`; of several the nearest, then
/// one with the same first letter.
pub fn nearest<'a>(word: &str, list: &[&'a str]) -> Option<&'a str> {
    let near = list.iter().filter(|n| distance(word, n) <= 2);
    near.min_by_key(|n| (distance(word, n), word.chars().next() != n.chars().next())).copied()
}

/// Returns the number of edits between two short words (Levenshtein).
pub fn distance(a: &str, b: &str) -> usize {
    let b: Vec<char> = b.chars().collect();
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, ca) in a.chars().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, cb) in b.iter().enumerate() {
            let change = diagonal + usize::from(ca != *cb);
            diagonal = row[j + 1];
            row[j + 1] = change.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}
