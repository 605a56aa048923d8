//! One case of the table of `slabcast lab check`, and the rows that it gives back.

use super::shot::Tools;
use slabcast_session::fail::Fail;
use std::time::Duration;

/// What a case does.
pub(crate) type Work = Box<dyn Fn(&Tools) -> Result<Vec<Row>, Fail> + Send + Sync>;

/// One scene, or a few that are compared with each other.
pub(crate) struct Case {
    /// What is drawn, unique in its group.
    pub(crate) name: String,
    /// Whether it takes so long that only `--long` runs it.
    pub(crate) long: bool,
    /// Draws and compares.
    pub(crate) work: Work,
}

impl Case {
    /// A case that every run has.
    pub(crate) fn new(
        name: impl Into<String>,
        work: impl Fn(&Tools) -> Result<Vec<Row>, Fail> + Send + Sync + 'static,
    ) -> Case {
        Case { name: name.into(), long: false, work: Box::new(work) }
    }

    /// The same, for `--long` only.
    pub(crate) fn long(self) -> Case {
        Case { long: true, ..self }
    }
}

/// One thing that must hold.
#[derive(Clone, Debug)]
pub(crate) struct Row {
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
    /// A row without other trouble.
    pub(crate) fn new(what: impl Into<String>, error: f64, bound: f64) -> Row {
        Row { what: what.into(), error, bound, trouble: None }
    }

    /// The same with what else went wrong.
    pub(crate) fn with(self, trouble: Option<String>) -> Row {
        let all: Vec<String> = self.trouble.iter().cloned().chain(trouble).collect();
        Row { trouble: (!all.is_empty()).then(|| all.join("; ")), ..self }
    }

    /// Whether it held.
    pub(crate) fn held(&self) -> bool {
        self.trouble.is_none() && self.error <= self.bound
    }

    /// As one line.
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

    /// As one line of JSON.
    pub(super) fn json(&self, group: &str, case: &str, took: Duration) -> String {
        let row = serde_json::json!({
            "group": group, "case": case, "what": self.what, "error": self.error,
            "bound": self.bound, "held": self.held(), "trouble": self.trouble,
            "case_ms": took.as_secs_f64() * 1e3
        });
        format!("{row}\n")
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
