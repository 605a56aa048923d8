//! Golden frames: hashes that are equal on every machine and build (docs/design/contracts.md,
//! Exactness).

use super::cases::{self, VIEWS};
use super::cluster::embedded_hashes;
use super::matrix::SAMPLE;
use slabcast_common::PIXELS_VERSION;
use slabcast_common::quality::Work;
use slabcast_scene::path::Orientation;
use slabcast_session::embedded::{Cluster, WorkerGroup};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Prints `NAME SHA256` lines of frames of the sample and of formula volumes, or compares them
/// with those of a file.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab check golden --verify tests/golden.txt
  slabcast lab check golden > tests/golden.txt      (raise PIXELS_VERSION and say why in CHANGELOG.md)")]
pub(crate) struct GoldenArgs {
    /// The sample volume
    #[arg(long, value_name = "FILE", default_value = SAMPLE)]
    sample: PathBuf,
    /// Compare with this file; exit 1 where a hash differs or is missing
    #[arg(long, value_name = "FILE")]
    verify: Option<PathBuf>,
}

/// Runs the command.
pub(crate) fn run(args: &GoldenArgs) -> Result<(), Fail> {
    let want = args.verify.as_deref().map(read).transpose()?;
    let began = Instant::now();
    let cases = cases::golden_cases(&args.sample)?;
    let runtime = slabcast_session::runtime::start()?;
    let mut progress = Progress::new(false);
    let total = (cases.len() * VIEWS.len()) as u64;
    progress.frames(total, &format!("{total} golden frames"));
    let mut lines: Vec<(String, String)> = Vec::new();
    for case in &cases {
        let hashes = runtime.block_on(async {
            let orientation = Orientation::new(None, None).map_err(|e| Fail::flag(&e))?;
            let crew = WorkerGroup::new(1, None)?;
            let mut cluster = Cluster::start((*case.volume).clone(), orientation, crew, None)?;
            let request = case.request(true, Work::default());
            let hashes = tokio::select! {
                hashes = embedded_hashes(cluster.handle(), request) => hashes,
                trouble = cluster.trouble() => Err(trouble),
            };
            cluster.end().await;
            hashes
        })?;
        lines.extend(hashes.into_iter().enumerate().map(|(i, h)| (case.view_name(i), h)));
        progress.step(progress::Step { frames: lines.len() as u64, ..Default::default() });
    }
    progress.end();
    runtime.shutdown_timeout(Duration::from_secs(1));
    let Some(want) = want else {
        let mut out = format!(
            "# pixels_sha256 of golden frames, PIXELS_VERSION {PIXELS_VERSION}: slabcast lab check golden\n"
        );
        for (name, hash) in &lines {
            out += &format!("{name} {hash}\n");
        }
        return say(&out);
    };
    verdict(&want, &lines, began)
}

/// Reads `NAME SHA256` lines; `#` begins a comment.
fn read(file: &Path) -> Result<BTreeMap<String, String>, Fail> {
    let text = std::fs::read_to_string(file).map_err(|e| Fail::io(file, "reading", &e))?;
    let mut want = BTreeMap::new();
    for (i, line) in text.lines().enumerate() {
        let line = line.split('#').next().unwrap_or_default().trim();
        if line.is_empty() {
            continue;
        }
        let hash = |h: &&str| h.len() == 64 && h.bytes().all(|b| b.is_ascii_hexdigit());
        let Some((name, hash)) =
            line.split_once(' ').map(|(n, h)| (n, h.trim())).filter(|(_, h)| hash(h))
        else {
            return Err(Fail::failed(format!(
                "{}: line {}: is not NAME SHA256; make the file with `slabcast lab check golden`",
                file.display(),
                i + 1
            )));
        };
        want.insert(name.to_string(), hash.to_ascii_lowercase());
    }
    Ok(want)
}

/// Returns a report of the hashes that differ, are missing or are left over, and their number.
fn compare(want: &BTreeMap<String, String>, lines: &[(String, String)]) -> (String, usize) {
    let (mut report, mut wrong) = (String::new(), 0);
    for (name, got) in lines {
        let want = match want.get(name) {
            Some(hash) if hash == got => continue,
            Some(hash) => hash,
            None => "nothing: the file lacks it",
        };
        wrong += 1;
        report += &format!("{name}\n    want {want}\n    got  {got}\n");
    }
    for name in want.keys().filter(|n| !lines.iter().any(|(l, _)| l == *n)) {
        wrong += 1;
        report += &format!("{name}\n    is in the file, but no frame of this version\n");
    }
    (report, wrong)
}

fn verdict(
    want: &BTreeMap<String, String>,
    lines: &[(String, String)],
    began: Instant,
) -> Result<(), Fail> {
    let (report, wrong) = compare(want, lines);
    say(&report)?;
    if wrong > 0 {
        return Err(Fail::failed(format!(
            "{wrong} of {} golden frames differ; a change that is meant needs PIXELS_VERSION (now \
             {PIXELS_VERSION}) raised and its reason in CHANGELOG.md",
            want.len().max(lines.len())
        )));
    }
    say(&format!(
        "golden: {} frames are as they should be; {}\n",
        lines.len(),
        progress::time(began.elapsed())
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn golden_files_have_comments_and_refuse_nonsense() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("g.txt");
        let hash = "ab".repeat(32);
        std::fs::write(&file, format!("# top\n\na/b {hash} # why\nc {}\n", hash.to_uppercase()))
            .unwrap();
        let read_back = read(&file).unwrap();
        assert_eq!(read_back.get("a/b"), Some(&hash));
        assert_eq!(read_back.get("c"), Some(&hash));
        std::fs::write(&file, "a\n").unwrap();
        assert!(read(&file).unwrap_err().line().unwrap().contains("line 1"));
    }

    #[test]
    fn golden_compare_counts_hashes_that_differ_are_missing_or_left_over() {
        let want: BTreeMap<String, String> =
            [("a", "1"), ("b", "2"), ("d", "4")].map(|(n, h)| (n.into(), h.into())).into();
        let lines = [("a", "1"), ("b", "3"), ("c", "3")].map(|(n, h)| (n.into(), h.into()));
        let (report, wrong) = compare(&want, &lines);
        assert_eq!(wrong, 3, "{report}");
        assert!(report.contains("b\n    want 2\n    got  3\n"), "{report}");
        assert_eq!(compare(&want, &[]).1, 3);
    }
}
