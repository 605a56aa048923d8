//! A set of frame numbers.
//!
//! A job of 100,000 frames has an entry for each frame that was ever finished. A bit each is 12
//! KiB; a tree of numbers takes two megabytes, a thousand times over for the jobs that are
//! remembered.

/// See the head of the file.
#[derive(Clone, Debug, Default)]
pub(crate) struct Numbers {
    words: Vec<u64>,
    len: u64,
}

impl Numbers {
    /// Adds a number. Returns whether it is new.
    pub(crate) fn insert(&mut self, n: u64) -> bool {
        let (word, bit) = (n as usize / 64, 1 << (n % 64));
        if word >= self.words.len() {
            self.words.resize(word + 1, 0);
        }
        let is_new = self.words[word] & bit == 0;
        self.words[word] |= bit;
        self.len += u64::from(is_new);
        is_new
    }

    /// Removes a number.
    pub(crate) fn remove(&mut self, n: u64) {
        if self.contains(n) {
            self.words[n as usize / 64] &= !(1 << (n % 64));
            self.len -= 1;
        }
    }

    /// Whether the number is in the set.
    pub(crate) fn contains(&self, n: u64) -> bool {
        self.words.get(n as usize / 64).is_some_and(|word| word & (1 << (n % 64)) != 0)
    }

    /// Returns the number of numbers in the set.
    pub(crate) fn len(&self) -> u64 {
        self.len
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_counted_once() {
        let mut numbers = Numbers::default();
        for n in [0, 63, 64, 99_999, 63] {
            numbers.insert(n);
        }
        numbers.insert(7);
        numbers.remove(7);
        numbers.remove(1 << 40);
        assert_eq!(numbers.len(), 4);
        assert!([0, 63, 64, 99_999].into_iter().all(|n| numbers.contains(n)));
        assert!([1, 7, 62, 65, 1 << 40].into_iter().all(|n| !numbers.contains(n)));
    }
}
