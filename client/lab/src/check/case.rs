//! One case of the table of `slabcast lab check`, and the rows that it returns.

use super::shot::Tools;
use slabcast_session::fail::Fail;
use std::time::Duration;

/// The work of a case: draws, compares and returns rows.
pub(crate) type Work = Box<dyn Fn(&Tools) -> Result<Vec<Row>, Fail> + Send + Sync>;

/// One scene, or a few that are compared with each other.
pub(crate) struct Case {
    /// The scene's name, unique in its group.
    pub(crate) name: String,
    /// Whether it takes so long that only `--long` runs it.
    pub(crate) long: bool,
    /// Draws and compares.
    pub(crate) work: Work,
}

impl Case {
    /// Makes a case that every run includes.
    pub(crate) fn new(
        name: impl Into<String>,
        work: impl Fn(&Tools) -> Result<Vec<Row>, Fail> + Send + Sync + 'static,
    ) -> Case {
        Case { name: name.into(), long: false, work: Box::new(work) }
    }

    /// Marks the case as one for `--long` alone.
    pub(crate) fn long(self) -> Case {
        Case { long: true, ..self }
    }
}

/// One property that must hold.
#[derive(Clone, Debug)]
pub(crate) struct Row {
    /// The property: `max against the limit`, `bytes that differ`.
    pub(crate) what: String,
    /// The error found, in 1/255 unless `what` says otherwise. NaN never holds.
    pub(crate) error: f64,
    /// The largest error allowed, in the unit of `error`.
    pub(crate) bound: f64,
    /// A failure besides the error (hashes that differ, values that are not finite).
    pub(crate) trouble: Option<String>,
}

impl Row {
    /// Makes a row without other trouble.
    pub(crate) fn new(what: impl Into<String>, error: f64, bound: f64) -> Row {
        Row { what: what.into(), error, bound, trouble: None }
    }

    /// Adds a failure besides the error.
    pub(crate) fn with(self, trouble: Option<String>) -> Row {
        let all: Vec<String> = self.trouble.iter().cloned().chain(trouble).collect();
        Row { trouble: (!all.is_empty()).then(|| all.join("; ")), ..self }
    }

    /// Whether the property held.
    pub(crate) fn held(&self) -> bool {
        self.trouble.is_none() && self.error <= self.bound
    }

    /// Formats the row as one line of text.
    pub(super) fn text(&self, group: &str, case: &str) -> String {
        format!(
            "{group:<11} {case:<44} {:<34} {:>9} <= {:<9} {}{}\n",
            self.what,
            number(self.error),
            number(self.bound),
            if self.held() { "held" } else { "NOT HELD" },
            self.trouble.as_ref().map(|t| format!(": {t}")).unwrap_or_default(),
        )
    }

    /// Formats the row as one line of JSON.
    pub(super) fn json(&self, group: &str, case: &str, took: Duration) -> String {
        let row = serde_json::json!({
            "group": group, "case": case, "what": self.what, "error": self.error,
            "bound": self.bound, "held": self.held(), "trouble": self.trouble,
            "case_ms": took.as_secs_f64() * 1e3
        });
        format!("{row}\n")
    }
}

/// Formats a number with three significant digits.
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
