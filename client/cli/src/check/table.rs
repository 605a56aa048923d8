//! The table of `slabcast check`: one row a case, with error, bound and verdict.

use crate::fail::{Fail, say};

/// One case and what became of it.
pub(crate) struct Row {
    /// Which part of the check it belongs to: `extreme`, `closed form`, `invariance`.
    pub(crate) group: &'static str,
    /// What was drawn.
    pub(crate) case: String,
    /// What the error is of: `max against the limit`, `bytes that differ`.
    pub(crate) what: String,
    /// What was found, in 1/255 unless `what` says otherwise. Not a number: not held.
    pub(crate) error: f64,
    /// What it may be at most, in the same unit.
    pub(crate) bound: f64,
    /// What else went wrong (hashes that differ, values that are not finite), if anything did.
    pub(crate) trouble: Option<String>,
}

impl Row {
    /// Whether the case held.
    pub(crate) fn held(&self) -> bool {
        self.trouble.is_none() && self.error <= self.bound
    }

    /// Prints the row as one line.
    pub(crate) fn print(&self) -> Result<(), Fail> {
        say(&format!(
            "{:<11} {:<44} {:<28} {:>9} <= {:<9} {}{}\n",
            self.group,
            self.case,
            self.what,
            number(self.error),
            number(self.bound),
            if self.held() { "held" } else { "NOT HELD" },
            self.trouble.as_ref().map(|t| format!(": {t}")).unwrap_or_default(),
        ))
    }
}

/// Three digits, wherever they begin.
pub(crate) fn number(x: f64) -> String {
    if x == 0.0 {
        "0".into()
    } else if !(1e-3..1e4).contains(&x.abs()) {
        format!("{x:.1e}")
    } else if x.abs() < 1.0 {
        format!("{x:.4}")
    } else {
        format!("{x:.3}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_not_a_number_is_not_held() {
        let row = |error, trouble: Option<&str>| Row {
            group: "extreme",
            case: "one".into(),
            what: "max".into(),
            error,
            bound: 1.0,
            trouble: trouble.map(String::from),
        };
        assert!(row(1.0, None).held());
        assert!(!row(1.1, None).held());
        assert!(!row(f64::NAN, None).held());
        assert!(!row(0.0, Some("hashes differ")).held());
    }
}
