//! `--trace`: the time lines of all frames in one file.

use slabcast_session::fail::Fail;
use slabcast_session::output::Lines;

/// A file of trace events in the format of Perfetto and chrome://tracing.
pub(super) struct TraceFile {
    lines: Lines,
    any: bool,
}

impl TraceFile {
    /// Returns a trace that is written to `lines`.
    pub(super) fn new(lines: Lines) -> Self {
        TraceFile { lines, any: false }
    }

    /// Adds a frame's events (a JSON array).
    pub(super) fn put(&mut self, array: &str) -> Result<(), Fail> {
        let events = array.trim().trim_start_matches('[').trim_end_matches(']').trim();
        if !self.lines.wanted() || events.is_empty() {
            return Ok(());
        }
        let before =
            if self.any { ",\n" } else { "{\"displayTimeUnit\":\"ms\",\"traceEvents\":[\n" };
        self.any = true;
        self.lines.put(before)?;
        self.lines.put(events)
    }

    /// Ends the JSON and gives the file its name.
    pub(super) fn keep(mut self) -> Result<(), Fail> {
        if self.lines.wanted() {
            let begin = if self.any { "" } else { "{\"displayTimeUnit\":\"ms\",\"traceEvents\":[" };
            self.lines.put(&format!("{begin}\n]}}\n"))?;
        }
        self.lines.keep()
    }
}
