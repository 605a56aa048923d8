//! `slabcast lab study`: the paper's evaluation again, of any volume.
//!
//! What was drawn and timed here and what is simulated from it are kept apart in every figure:
//! [`simulate`] has the clusters that are not there, [`live`] those that are, [`bench`] the order in
//! which all is measured. [`order`] is Figure 1, [`nodes`] Figure 3 and Table 1, [`runs`] Figures 4, 5
//! and 7, [`effects`] what section 5.1 says without numbers. [`paper`] has the paper's numbers,
//! [`verdict`] what became of its sentences; [`write`](mod@write), [`tables`], [`charts`] (by [`draw`]),
//! [`page`] and its [`parts`] put all of it down.

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
/// Its Table 1, Figures 1, 3, 4, 5 and 7 and the effects of section 5.1, beside the paper's numbers,
/// and which of its sentences hold.
///
/// Every macrotile of the path is drawn here, on one core, and timed. Clusters as large as this
/// machine has cores are run for real; the paper's 3 to 16 nodes are simulated by the scheduler
/// itself with these times. Each figure says which it is. Ctrl-C keeps what is finished.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast lab study head.nrrd --up=-y --tf peer-opaque -o study/
  slabcast lab study ct.nrrd --tf bone --quick
  slabcast lab study ct.nrrd --tf vessels --link 1gbit --latency 100us -o study/ --force

Files: index.html (all of it, with nothing beside it), study.json, and for each table and figure a
CSV, and charts as SVG and PNG, light and dark.
The paper: A Parallel Splatting Algorithm With Occlusion Culling (Huang, Shareef, Crawfis,
Sadayappan, Mueller, 2000). Its setup is the subject: slab after slab in 3 and 5 slabs of equal
thickness, 18 views 5 degrees apart, 512x512, a master and 2 to 15 rendering nodes.")]
pub struct StudyArgs {
    #[command(flatten)]
    of: VolumeSceneArgs,
    /// Folder for the files; it is made
    #[arg(short, long, value_name = "DIR", default_value = "slabcast-study")]
    out: PathBuf,
    /// Replaces a study that is there
    #[arg(long)]
    force: bool,
    /// Every simulated node's link: 1gbit, 10gbit, 100mbit or unlimited; the default is the paper's
    #[arg(long, value_name = "RATE", default_value = paper::LINK, value_parser = parse::link)]
    link: parse::Rate,
    /// From one node to another, one way
    #[arg(long, value_name = "TIME", default_value = "50us", value_parser = parse::latency)]
    latency: u64,
    /// Times that each tile is drawn; its shortest time counts
    #[arg(long, value_name = "N", default_value = "2",
          value_parser = clap::value_parser!(u32).range(1..=100))]
    repeats: u32,
    /// Six views at most, each tile once, and no picture of four times the size: a first look
    #[arg(long)]
    quick: bool,
    /// The study as JSON on stdout, beside the files
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Debug, Serialize)]
struct Machine {
    cpu: String,
    cores: usize,
    simd: &'static str,
}

/// Section 5.1's effects.
#[derive(Clone, Debug, Default, Serialize)]
struct Effects {
    bricks: Vec<effects::Bricks>,
    radii: Vec<effects::Setting>,
    sizes: Vec<effects::Setting>,
    culling: Option<effects::Culling>,
}

/// All that was found out.
#[derive(Clone, Debug, Serialize)]
struct Study {
    version: u32,
    slabcast: &'static str,
    pixels_version: u32,
    /// As it was typed.
    command: String,
    volume: String,
    digest: String,
    tf: String,
    size: [u32; 2],
    views: usize,
    kernel: String,
    machine: Machine,
    /// Of the simulated nodes.
    link: String,
    latency_us: f64,
    /// Times that each tile was drawn.
    repeats: u32,
    /// Relevant voxels, and bytes of all bricks as they are sent.
    voxels: u64,
    bytes: u64,
    /// A frame alone on one core here, in ms, and what the paper's pace multiplies it with.
    alone_ms: f64,
    stretch: f64,
    /// Whether all of it is there.
    complete: bool,
    /// What is not, and why.
    left_out: Vec<String>,
    verdicts: Vec<verdict::Verdict>,
    table_1: Vec<nodes::Tiles>,
    table_1_of_the_paper: [paper::Tiles; 3],
    figure_1: Option<order::Order>,
    figure_3: Vec<nodes::Breakdown>,
    figure_4: Vec<runs::Data>,
    /// Figures 5 and 7, and 4 frame by frame.
    runs: Vec<Run>,
    effects: Effects,
}

/// Runs the command.
pub fn run(args: &StudyArgs) -> Result<(), Fail> {
    write::check(args)?;
    let made = OutputFolder::new(&args.out)?;
    let args = args.clone();
    signals::run_to_end(move || {
        // Held until the files are there.
        let _made = made;
        let study = bench::Bench::open(&args)?.study()?;
        write::files(&args.out, &study)?;
        if args.json {
            return say(&write::json(&study));
        }
        say(&write::text(&study, &args.out))
    })
}
