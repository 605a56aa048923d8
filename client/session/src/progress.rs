//! Progress display on stderr while frames are rendered.
//!
//! On a terminal: one bar that moves with the macrotiles of the frame at hand. Elsewhere: a
//! line now and then, so that a log of a long run stays short.

use crate::terminal;
use indicatif::{MultiProgress, ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::Write;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

/// Time between two lines where stderr is no terminal. At half, a log of an hour has 1400
/// lines; at double, a person wonders whether it still runs.
const PLAIN_EVERY: Duration = Duration::from_secs(5);

/// Everything that is drawn on this terminal; others write between its lines.
fn bars() -> &'static MultiProgress {
    static ALL: OnceLock<MultiProgress> = OnceLock::new();
    ALL.get_or_init(|| {
        let target = if terminal::terminal() {
            ProgressDrawTarget::stderr_with_hz(10)
        } else {
            ProgressDrawTarget::hidden()
        };
        MultiProgress::with_draw_target(target)
    })
}

/// Writes bytes to stderr between redraws of the progress bar. A closed stderr is ignored.
pub fn write_on_stderr(bytes: &[u8]) {
    bars().suspend(|| {
        let _ = std::io::stderr().lock().write_all(bytes);
    });
}

/// Writes a line to stderr between redraws of the progress bar.
pub fn say_on_stderr(line: &str) {
    write_on_stderr(format!("{line}\n").as_bytes());
}

/// Removes all progress bars; the command ends.
pub fn end() {
    // A terminal that is gone is nobody's concern.
    let _ = bars().clear();
}

/// Writes `warning: LINE` to stderr, without control characters of `line`.
pub fn warn(line: &str) {
    say_on_stderr(&format!("{} {}", terminal::warning(), crate::terminal::one_line(line)));
}

/// Writes `note: LINE` to stderr, without control characters of `line`.
pub fn note(line: &str) {
    say_on_stderr(&format!("{} {}", terminal::note(), crate::terminal::one_line(line)));
}

/// State of a run, for its progress bar.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Step {
    /// Reason the run waits, for people ("no workers"); empty while frames are rendered.
    pub waiting: String,
    /// Number of frames that are done.
    pub frames: u64,
    /// Macrotiles of the current slab, done and in all; (0, 0) if unknown.
    pub tiles: (u32, u32),
    /// Current slab (from 0) and number of slabs of the current frame.
    pub slab: (u32, u32),
    /// State in the master's words, where there are no numbers.
    pub detail: String,
}

/// Progress of one run: a bar on a terminal, else a line every five seconds.
pub struct Progress {
    /// Unit that is counted: `frame`.
    noun: &'static str,
    total: u64,
    quiet: bool,
    bar: Option<ProgressBar>,
    began: Instant,
    first: Option<Instant>,
    said: Instant,
    step: Step,
}

impl Progress {
    /// Starts without a total. `quiet` shows warnings alone.
    pub fn new(quiet: bool) -> Self {
        let now = Instant::now();
        let bar = (terminal::terminal() && !quiet).then(|| {
            let bar = bars().add(ProgressBar::new_spinner());
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        Progress {
            noun: "frame",
            total: 0,
            quiet,
            bar,
            began: now,
            first: None,
            said: now,
            step: Step::default(),
        }
    }

    /// Returns the progress with another unit than `frame`, such as `pixel`.
    pub fn counting(mut self, noun: &'static str) -> Self {
        self.noun = noun;
        self
    }

    /// Shows what goes on before the first frame, such as `reading brain.nii.gz`.
    pub fn phase(&mut self, what: &str) {
        if let Some(bar) = &self.bar {
            bar.set_message(what.to_string());
        }
    }

    /// Starts counting to `total`; `what` is the line for a log.
    pub fn frames(&mut self, total: u64, what: &str) {
        self.total = total;
        self.began = Instant::now();
        if let Some(bar) = &self.bar {
            let template = if terminal::colours() {
                "{prefix:32} [{bar:28.cyan/dim}] {wide_msg}"
            } else {
                "{prefix:32} [{bar:28}] {wide_msg}"
            };
            let style = ProgressStyle::with_template(template)
                .expect("the template is ours")
                .progress_chars("=> ");
            bar.set_message("");
            bar.set_style(style);
            bar.set_length(total * 1000);
            self.draw();
        } else if !self.quiet {
            say_on_stderr(what);
        }
    }

    /// Shows how many of `total` bytes are done; `what` is the line for a log, such as `reading a.nrrd`.
    pub fn bytes_done(&mut self, there: u64, total: u64, what: &str) {
        let mib = |bytes: u64| bytes.div_ceil(1 << 20);
        if self.total == 0 {
            self.frames(mib(total).max(1), &format!("{what}, {}", bytes(total)));
        }
        self.step(Step { frames: there >> 20, ..Step::default() });
    }

    /// Shows how far the run has come.
    pub fn step(&mut self, step: Step) {
        if step.frames > 0 && self.first.is_none() {
            self.first = Some(Instant::now());
        }
        let news = step.waiting != self.step.waiting && !step.waiting.is_empty();
        let frame = step.frames > self.step.frames;
        self.step = step;
        if self.quiet {
            return;
        }
        if self.bar.is_some() {
            self.draw();
        } else if news {
            say_on_stderr(&self.step.waiting);
            self.said = Instant::now();
        } else if frame && self.step.frames < self.total && self.said.elapsed() >= PLAIN_EVERY {
            let left = self.left().map(|l| format!(", about {} left", time(l)));
            say_on_stderr(&format!(
                "{} {} of {}, {}{}",
                self.noun,
                self.step.frames,
                self.total,
                time(self.began.elapsed()),
                left.unwrap_or_default()
            ));
            self.said = Instant::now();
        }
    }

    /// Time that is left, by the frames after the first (which pays for bricks and tables).
    fn left(&self) -> Option<Duration> {
        let first = self.first?;
        let (done, todo) = (self.step.frames, self.total.saturating_sub(self.step.frames));
        let each = if done > 1 {
            first.elapsed().as_secs_f64() / (done - 1) as f64
        } else {
            (first - self.began).as_secs_f64()
        };
        Some(Duration::from_secs_f64(each * todo as f64))
    }

    fn draw(&self) {
        let Some(bar) = &self.bar else { return };
        let Step { waiting, frames, tiles, slab, detail } = &self.step;
        let part = if slab.1 > 0 && tiles.1 > 0 {
            (f64::from(slab.0) + f64::from(tiles.0) / f64::from(tiles.1)) / f64::from(slab.1)
        } else {
            0.0
        };
        bar.set_position(frames * 1000 + (part.clamp(0.0, 0.999) * 1000.0) as u64);
        if !waiting.is_empty() {
            bar.set_prefix(format!("{} {frames}/{}", self.noun, self.total));
            bar.set_message(waiting.clone());
            return;
        }
        let at = (frames + 1).min(self.total);
        let mut here = format!("{} {at}/{}", self.noun, self.total);
        if tiles.1 > 0 && slab.1 > 0 {
            here += &format!("  slab {}/{}  tile {}/{}", slab.0 + 1, slab.1, tiles.0, tiles.1);
        }
        bar.set_prefix(here);
        let left = self.left().map(|l| format!("{} left  ", time(l))).unwrap_or_default();
        bar.set_message(format!("{left}{detail}"));
    }

    /// Calls `write`, which may print, without tearing the bar.
    pub fn suspend<T>(&self, write: impl FnOnce() -> T) -> T {
        bars().suspend(write)
    }

    /// Removes the progress bar from the terminal.
    pub fn end(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.end();
    }
}

/// Returns a time for people: `3 ms`, `3.2 s`, `1 min 01 s`.
pub fn time(d: Duration) -> String {
    let s = d.as_secs_f64();
    match s {
        _ if s < 1.0 => format!("{:.0} ms", s * 1e3),
        _ if s < 60.0 => format!("{s:.1} s"),
        _ if s < 3600.0 => format!("{:.0} min {:02.0} s", (s / 60.0).floor(), (s % 60.0).floor()),
        _ => format!("{:.0} h {:02.0} min", (s / 3600.0).floor(), (s % 3600.0 / 60.0).floor()),
    }
}

/// Returns a number of bytes for people: `2 KiB`, `512.0 MiB`.
pub fn bytes(n: u64) -> String {
    match n {
        0..1024 => format!("{n} B"),
        1024..1_048_576 => format!("{:.0} KiB", n as f64 / 1024.0),
        1_048_576..1_073_741_824 => format!("{:.1} MiB", n as f64 / 1_048_576.0),
        _ => format!("{:.2} GiB", n as f64 / 1_073_741_824.0),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_read_well() {
        for (ms, want) in [
            (3, "3 ms"),
            (3210, "3.2 s"),
            (61_900, "1 min 01 s"),
            (3_599_900, "59 min 59 s"),
            (7_260_000, "2 h 01 min"),
        ] {
            assert_eq!(time(Duration::from_millis(ms)), want);
        }
    }

    #[test]
    fn bytes_read_well() {
        assert_eq!([bytes(5), bytes(2048), bytes(512 << 20)], ["5 B", "2 KiB", "512.0 MiB"]);
    }
}
