//! Exactness: one hash a view over workers, tiles, slabs, threads, culling and links.

use super::cases::{self, Case};
use super::cluster::{Link, TestCluster};
use super::pairwise;
use slabcast_common::quality::{Schedule, Work};
use slabcast_common::volume::Digest32;
use slabcast_session::embedded::WorkerGroup;
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Path of the sample in a checkout.
pub(crate) const SAMPLE: &str = "samples/mni152_t1.nii.gz";

const WORKERS: [u32; 4] = [1, 2, 3, 5];
const TILES: [Option<u32>; 6] = [Some(16), Some(32), Some(64), Some(128), Some(256), None];
const SLABS: [u32; 3] = [1, 3, 5];
const THREADS: [u32; 2] = [1, 2];
const CULL: [bool; 2] = [true, false];
const LINKS: [Link; 3] = [Link::Embedded, Link::Tcp, Link::TcpShort];
/// Indices of workers, threads and links among the levels of [`Setting::all`]: a cluster is started
/// for each combination of them.
const CLUSTER: [usize; 3] = [0, 3, 5];
const SCHEDULES: [Schedule; 2] = [Schedule::Slab, Schedule::Region];

/// Compares pixels over workers (1, 2, 3, 5), tiles (16 to 256, auto), slabs (1, 3, 5) or regions,
/// threads (1, 2), culling (on, off) and links (embedded, TCP, TCP to workers of 32 KiB) with those
/// of the serial renderer.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab check matrix --pairwise
  slabcast lab check matrix brain.nii.gz")]
pub(crate) struct MatrixArgs {
    /// A volume to check beside formula volumes [default: samples/mni152_t1.nii.gz, if there]
    volume: Option<PathBuf>,
    /// Fewer settings, in which every two values still meet
    #[arg(long)]
    pairwise: bool,
    /// Size of the pictures
    #[arg(long, value_name = "WxH", default_value = "320x272", value_parser = slabcast_session::parse::size)]
    size: [u32; 2],
}

/// One way to divide and carry the work of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Setting {
    // A cluster is started for each of the first three, so rows are sorted by them.
    link: Link,
    workers: u32,
    threads: u32,
    by_region: bool,
    tile: Option<u32>,
    slabs: u32,
    cull: bool,
}

impl Setting {
    fn all(pairwise: bool) -> Vec<Setting> {
        let levels = [
            WORKERS.len(),
            TILES.len(),
            SLABS.len(),
            THREADS.len(),
            CULL.len(),
            LINKS.len(),
            SCHEDULES.len(),
        ];
        let rows =
            if pairwise { pairwise::rows(&levels, &CLUSTER) } else { pairwise::product(&levels) };
        let mut settings: Vec<Setting> = rows
            .iter()
            .map(|r| {
                let by_region = SCHEDULES[r[6]] == Schedule::Region;
                Setting {
                    workers: WORKERS[r[0]],
                    tile: TILES[r[1]],
                    // Regions go through all depths.
                    slabs: if by_region { SLABS[0] } else { SLABS[r[2]] },
                    threads: THREADS[r[3]],
                    cull: CULL[r[4]],
                    link: LINKS[r[5]],
                    by_region,
                }
            })
            .collect();
        settings.sort_unstable();
        settings.dedup();
        settings
    }

    fn crew(&self) -> WorkerGroup {
        WorkerGroup { workers: self.workers, threads: self.threads }
    }

    fn work(&self) -> Work {
        let schedule = SCHEDULES[usize::from(self.by_region)];
        Work { slabs: self.slabs, tile: self.tile, schedule, ..Work::default() }
    }
}

impl std::fmt::Display for Setting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(
            f,
            "workers {} threads {} tile {} {} cull {} {}",
            self.workers,
            self.threads,
            self.tile.map_or("auto".into(), |t| t.to_string()),
            if self.by_region { "regions".into() } else { format!("slabs {}", self.slabs) },
            if self.cull { "on" } else { "off" },
            self.link
        )
    }
}

/// The results of one view.
struct Verdict {
    want: Digest32,
    pictures: usize,
    /// Settings with another hash, and the hash.
    wrong: Vec<(Setting, String)>,
}

impl Verdict {
    fn new(want: Digest32) -> Verdict {
        Verdict { want, pictures: 0, wrong: Vec::new() }
    }

    /// Adds results of the same view.
    fn add(&mut self, more: Verdict) {
        self.pictures += more.pictures;
        self.wrong.extend(more.wrong);
    }
}

/// Runs the command.
pub(crate) fn run(args: &MatrixArgs) -> Result<(), Fail> {
    let sample = Path::new(SAMPLE);
    let file = args.volume.as_deref().or_else(|| sample.is_file().then_some(sample));
    if file.is_none() {
        progress::note(&format!("no {SAMPLE} here: formula volumes alone are checked"));
    }
    let cases = cases::matrix_cases(file, args.size)?;
    let settings = Setting::all(args.pairwise);
    let began = Instant::now();
    let runtime = slabcast_session::runtime::start()?;
    let progress = RefCell::new(Progress::new(false).counting("setting"));
    let done = Cell::new(0);
    let step = || {
        done.set(done.get() + 1);
        progress.borrow_mut().step(progress::Step { frames: done.get(), ..Default::default() });
    };
    let total = (cases.len() * settings.len()) as u64;
    progress.borrow_mut().frames(
        total,
        &format!("{} volumes under {} settings, two views each", cases.len(), settings.len()),
    );
    let mut wrong = 0;
    let mut pictures = 0;
    for case in &cases {
        let case_began = Instant::now();
        let truth = case.truth()?;
        let mut groups: BTreeMap<(Link, u32, u32), Vec<Setting>> = BTreeMap::new();
        for s in &settings {
            groups.entry((s.link, s.workers, s.threads)).or_default().push(*s);
        }
        // Two clusters at a time: one alone leaves a processor free while its messages are on their
        // way.
        let queue = RefCell::new(groups.values());
        let lane = || async {
            let mut verdicts: Vec<Verdict> = truth.iter().map(|&want| Verdict::new(want)).collect();
            loop {
                let next = queue.borrow_mut().next();
                let Some(group) = next else { return Ok::<_, Fail>(verdicts) };
                check(case, group, &mut verdicts, step).await?;
            }
        };
        let (mut verdicts, other) = runtime.block_on(async { tokio::try_join!(lane(), lane()) })?;
        verdicts.iter_mut().zip(other).for_each(|(all, more)| all.add(more));
        for (i, v) in verdicts.iter().enumerate() {
            let outcome = match v.wrong.len() {
                0 => "exact".to_string(),
                n => format!("{n} DIFFER"),
            };
            let time = if i == 0 { progress::time(case_began.elapsed()) } else { String::new() };
            progress.borrow().suspend(|| {
                say(&format!(
                    "{:<32} {}  {:>4} pictures  {outcome:<10} {time}\n",
                    case.view_name(i),
                    &v.want.to_string()[..16],
                    v.pictures
                ))?;
                v.wrong.iter().take(10).try_for_each(|(setting, got)| {
                    say(&format!("    {setting}: {}\n", &got[..got.len().min(16)]))
                })
            })?;
            wrong += v.wrong.len();
            pictures += v.pictures;
        }
    }
    progress.borrow().end();
    runtime.shutdown_timeout(Duration::from_secs(1));
    let views = cases.len() * cases::VIEWS.len();
    let time = progress::time(began.elapsed());
    if wrong == 0 {
        return say(&format!(
            "exact: {pictures} pictures under {} settings, one hash for each of {views} views, that \
             of the serial renderer; {time}\n",
            settings.len()
        ));
    }
    Err(Fail::failed(format!(
        "pixels are not exact: {wrong} of {pictures} pictures differ from the serial renderer's; \
         {time}"
    )))
}

/// Renders a case under settings of one cluster.
async fn check(
    case: &Case,
    settings: &[Setting],
    verdicts: &mut [Verdict],
    done: impl Fn(),
) -> Result<(), Fail> {
    let Some(first) = settings.first() else { return Ok(()) };
    let mut cluster = TestCluster::start(&case.volume, first.link, first.crew()).await?;
    for setting in settings {
        let request = case.request(setting.cull, setting.work());
        let hashes = cluster
            .hashes(request)
            .await
            .map_err(|e| with_place(e, &format!("{}, {setting}", case.name)))?;
        if hashes.len() != verdicts.len() {
            return Err(Fail::failed(format!(
                "{}, {setting}: {} frames came instead of {}",
                case.name,
                hashes.len(),
                verdicts.len()
            )));
        }
        for (verdict, got) in verdicts.iter_mut().zip(hashes) {
            verdict.pictures += 1;
            if got != verdict.want.to_string() {
                verdict.wrong.push((*setting, got));
            }
        }
        done();
    }
    cluster.end().await;
    Ok(())
}

fn with_place(e: Fail, place: &str) -> Fail {
    Fail::failed(format!("{place}: {}", e.line().unwrap_or("stopped")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrix_has_every_combination_of_settings() {
        let all = Setting::all(false);
        assert_eq!(all.len(), 4 * 6 * (3 + 1) * 2 * 2 * 3);
        let few = Setting::all(true);
        assert!(few.len() < 40 && few.iter().all(|s| all.contains(s)));
        assert!(few.iter().any(|s| s.link == Link::Tcp && s.workers == 5));
        assert!(few.iter().any(|s| s.by_region && s.link == Link::TcpShort));
    }
}
