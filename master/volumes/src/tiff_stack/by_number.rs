//! The order of files in a folder: by the numbers in their names.

use std::path::Path;

/// Compares file names in natural order: numbers in them by value, letters without case.
pub(crate) fn compare_by_number(a: &Path, b: &Path) -> std::cmp::Ordering {
    let key = |p: &Path| {
        let name = p.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
        let mut words: Vec<(String, String)> = Vec::new();
        let mut rest = name.as_str();
        while !rest.is_empty() {
            let digits = rest.starts_with(|c: char| c.is_ascii_digit());
            let end = rest.find(|c: char| c.is_ascii_digit() != digits).unwrap_or(rest.len());
            let word = &rest[..end];
            rest = &rest[end..];
            // Numbers compare by length, then by digits, without leading zeros.
            let bare = if digits { word.trim_start_matches('0') } else { word };
            let rank = if digits { format!("0{:04}", bare.len()) } else { "1".into() };
            words.push((rank, bare.to_string()));
        }
        words
    };
    key(a).cmp(&key(b)).then_with(|| a.cmp(b))
}
