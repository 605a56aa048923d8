//! Memory, descriptors and threads of processes while a test runs, from /proc, as a table
//! and as lines through its figures.

#![allow(dead_code, reason = "each test program uses a part of it")]

use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

/// Memory, descriptors and threads of one process at one time.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    /// Time since the table began.
    pub(crate) at: Duration,
    /// Resident memory (VmRSS), in MiB.
    pub(crate) rss_mib: f64,
    /// The most resident memory so far (VmHWM), in MiB.
    pub(crate) most_mib: f64,
    /// Open descriptors.
    pub(crate) descriptors: f64,
    /// Threads.
    pub(crate) threads: f64,
}

/// Reads what process `pid` takes now; `None` if it is gone.
fn look(pid: u32, at: Duration) -> Option<Sample> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).ok()?;
    let number = |name: &str| -> Option<f64> {
        let line = status.lines().find_map(|line| line.strip_prefix(name))?;
        line.split_whitespace().next()?.parse().ok()
    };
    Some(Sample {
        at,
        rss_mib: number("VmRSS:")? / 1024.0,
        most_mib: number("VmHWM:")? / 1024.0,
        descriptors: std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?.count() as f64,
        threads: number("Threads:")?,
    })
}

/// A table of samples, which is also written to a file row by row.
pub(crate) struct Usage {
    begin: Instant,
    file: std::fs::File,
    samples: BTreeMap<String, Vec<Sample>>,
}

impl Usage {
    /// An empty table whose rows go to `file` as comma-separated values.
    pub(crate) fn new(file: &Path, begin: Instant) -> Usage {
        let mut file = std::fs::File::create(file).expect("a file for the table");
        writeln!(file, "seconds,process,pid,rss_mib,most_mib,descriptors,threads,jobs")
            .expect("room for a row");
        Usage { begin, file, samples: BTreeMap::new() }
    }

    /// Adds a row for each process that lives, by name and id. `jobs` is a column of the file.
    pub(crate) fn take(&mut self, processes: &BTreeMap<String, u32>, jobs: u64) {
        for (name, &pid) in processes {
            let Some(s) = look(pid, self.begin.elapsed()) else { continue };
            let (at, rss, most) = (s.at.as_secs_f64(), s.rss_mib, s.most_mib);
            let (descriptors, threads) = (s.descriptors, s.threads);
            writeln!(
                self.file,
                "{at:.1},{name},{pid},{rss:.2},{most:.2},{descriptors},{threads},{jobs}"
            )
            .expect("room for a row");
            self.samples.entry(name.clone()).or_default().push(s);
        }
    }

    /// Samples of a process, in the order of time.
    pub(crate) fn of(&self, process: &str) -> &[Sample] {
        self.samples.get(process).map_or(&[], Vec::as_slice)
    }
}

/// Slope of the line through a figure of samples by least squares, per hour; 0 of fewer than two
/// samples.
pub(crate) fn slope(samples: &[Sample], figure: impl Fn(&Sample) -> f64) -> f64 {
    let n = samples.len() as f64;
    let hours = |s: &Sample| s.at.as_secs_f64() / 3600.0;
    let mean = |of: &dyn Fn(&Sample) -> f64| samples.iter().map(of).sum::<f64>() / n;
    let (x, y) = (mean(&hours), mean(&figure));
    let (above, below) = samples.iter().fold((0.0, 0.0), |(above, below), s| {
        let dx = hours(s) - x;
        (above + dx * (figure(s) - y), below + dx * dx)
    });
    if below > 0.0 { above / below } else { 0.0 }
}

/// Returns the rise, from the first sample to the last, of the line fitted to a figure of samples.
pub(crate) fn growth(samples: &[Sample], figure: impl Fn(&Sample) -> f64) -> f64 {
    let [first, .., last] = samples else { return 0.0 };
    slope(samples, figure) * (last.at - first.at).as_secs_f64() / 3600.0
}

#[test]
fn growth_is_that_of_a_line() {
    let sample = |i: u32| {
        let rss_mib = 100.0 + 0.5 * f64::from(i) + f64::from(i % 2);
        let at = Duration::from_secs(36) * i;
        Sample { at, rss_mib, most_mib: 0.0, descriptors: 19.0, threads: 6.0 }
    };
    let samples: Vec<Sample> = (0..=100).map(sample).collect();
    assert!((slope(&samples, |s| s.rss_mib) - 50.0).abs() < 0.1);
    assert!((growth(&samples, |s| s.rss_mib) - 50.0).abs() < 0.1);
    assert_eq!(growth(&samples, |s| s.descriptors), 0.0);
    assert_eq!(growth(&samples[..1], |s| s.rss_mib), 0.0);
}
