//! `slabcast lab study`: repeats the paper's evaluation with any volume.
//!
//! Every figure keeps measured and simulated results apart.
//!
//! - [`bench`] runs all measurements in order: `live` on real clusters of this machine,
//!   `simulate` on virtual ones.
//! - `order` is Figure 1, `nodes` Figure 3 and Table 1, `runs` Figures 4, 5 and 7,
//!   `effects`
//!   the effects that section 5.1 states without numbers.
//! - `paper` has the numbers of the paper, `verdict` judges its sentences.
//! - `write` writes the files: `tables`, `charts` (drawn by `draw`) and the
//!   `page`
//!   with its `parts`.

mod bench;
mod charts;
mod draw;
mod effects;
mod live;
mod nodes;
pub(crate) mod order;
mod page;
mod paper;
mod parts;
mod runs;
mod simulate;
mod tables;
mod verdict;
mod write;

use runs::Run;
use serde::Serialize;
use slabcast_session::fail::{Fail, say};
use slabcast_session::output::OutputFolder;
use slabcast_session::request::VolumeSceneArgs;
use slabcast_session::{parse, signals};
use std::path::PathBuf;

/// Repeats the paper's evaluation with a volume of yours.
///
/// Makes its Table 1, Figures 1, 3, 4, 5 and 7 and the effects of section 5.1, beside the paper's
/// numbers, and judges which of its sentences hold.
///
/// Every macrotile of the path is drawn and timed here, on one core. Clusters of at most as many
/// workers as this machine has cores are run for real; the paper's 3 to 16 nodes are simulated by
/// the scheduler itself with these times. Each figure says which it is. Ctrl-C ends the study and
/// keeps the finished parts.
#[derive(clap::Args, Clone, Debug)]
#[command(after_long_help = "\
Examples:
  slabcast lab study head.nrrd --up=-y --tf peer-opaque -o study/
  slabcast lab study ct.nrrd --tf bone --quick
  slabcast lab study ct.nrrd --tf vessels --link 1gbit --latency 100us -o study/ --force

Files: index.html (self-contained), study.json, a CSV for each table and figure, and charts as SVG
and PNG, light and dark.
The paper: A Parallel Splatting Algorithm With Occlusion Culling (Huang, Shareef, Crawfis,
Sadayappan, Mueller, 2000). Its setup is the subject: slab after slab in 3 and 5 slabs of equal
thickness, 18 views 5 degrees apart, 512x512, a master and 2 to 15 rendering nodes.")]
pub struct StudyArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Folder for the files; it is created
    #[arg(short, long, value_name = "DIR", default_value = "slabcast-study")]
    out: PathBuf,
    /// Replace the files of an earlier study
    #[arg(long)]
    force: bool,
    /// Link of every simulated node: 1gbit, 10gbit, 100mbit or unlimited; the default is the
    /// paper's
    #[arg(long, value_name = "RATE", default_value = paper::LINK, value_parser = parse::link)]
    link: parse::Rate,
    /// One-way latency between nodes
    #[arg(long, value_name = "TIME", default_value = "50us", value_parser = parse::latency)]
    latency: u64,
    /// Times each tile is drawn; the shortest time counts
    #[arg(long, value_name = "N", default_value = "2",
          value_parser = clap::value_parser!(u32).range(1..=100))]
    repeats: u32,
    /// First look: six views at most, each tile drawn once, no picture of four times the size
    #[arg(long)]
    quick: bool,
    /// Print the study as JSON
    #[arg(long)]
    json: bool,
}

/// The machine that the study ran on.
#[derive(Clone, Debug, Serialize)]
struct Machine {
    cpu: String,
    cores: usize,
    simd: &'static str,
}

/// Effects of section 5.1.
#[derive(Clone, Debug, Default, Serialize)]
struct Effects {
    bricks: Vec<effects::Bricks>,
    radii: Vec<effects::Setting>,
    sizes: Vec<effects::Setting>,
    culling: Option<effects::Culling>,
}

/// All results of a study, as written to study.json.
#[derive(Clone, Debug, Serialize)]
struct Study {
    version: u32,
    slabcast: &'static str,
    pixels_version: u32,
    /// Command line as it was typed.
    command: String,
    volume: String,
    digest: String,
    tf: String,
    size: [u32; 2],
    views: usize,
    kernel: String,
    machine: Machine,
    /// Link of the simulated nodes.
    link: String,
    latency_us: f64,
    /// Times that each tile was drawn.
    repeats: u32,
    /// Number of relevant voxels.
    voxels: u64,
    /// Bytes of all bricks as sent.
    bytes: u64,
    /// Time of a frame on one core here, in ms.
    alone_ms: f64,
    /// Factor from tile times here to those at the paper's pace.
    stretch: f64,
    /// False if the study was stopped early.
    complete: bool,
    /// Parts that are missing, and why.
    left_out: Vec<String>,
    verdicts: Vec<verdict::Verdict>,
    table_1: Vec<nodes::Tiles>,
    table_1_of_the_paper: [paper::Tiles; 3],
    figure_1: Option<order::Order>,
    figure_3: Vec<nodes::Breakdown>,
    figure_4: Vec<runs::Data>,
    /// Runs of Figures 5 and 7, and of Figure 4 frame by frame.
    runs: Vec<Run>,
    effects: Effects,
}

/// Runs `slabcast lab study`: writes its files and prints a summary, or JSON with `--json`.
///
/// # Errors
/// The arguments or the volume are refused, the folder has a study already, fewer than two views
/// were drawn before Ctrl-C, no view shows anything, or a file can't be written.
pub fn run(args: &StudyArgs) -> Result<(), Fail> {
    write::check(args)?;
    let made = OutputFolder::new(&args.out)?;
    let args = args.clone();
    signals::run_to_end(move || {
        // Removes the folder on drop, if it is still empty.
        let _made = made;
        let study = bench::Bench::open(&args)?.study()?;
        write::files(&args.out, &study)?;
        if args.json {
            return say(&write::json(&study));
        }
        say(&write::text(&study, &args.out))
    })
}
