//! `slabcast view`: a page to look at a volume, turn, colour and cut it.
//!
//! A master and workers run inside this process, as `render` has them, and serve the page of every
//! master on a port of this machine until Ctrl-C. With `--master` the page is that master's
//! ([`there`]).

mod there;

use crate::master::{bind, listen, local, reader};
use crate::page::{self, PageArgs};
use slabcast_common::transfer::TransferFunction;
use slabcast_common::volume::VolumeInfo;
use slabcast_live::Home;
use slabcast_master::library::{Source, UploadConfig};
use slabcast_master::memory::available;
use slabcast_master::{Library, LibraryConfig};
use slabcast_session::embedded::{Cluster, SHARED, WorkerGroup};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress;
use slabcast_session::request::AxisArgs;
use slabcast_session::transfer::{NameOrFile, Transfer};
use slabcast_session::{parse, runtime, signals, volume};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use tokio::sync::watch;

/// Bytes that files dropped on the page may take on disk.
const UPLOADS: u64 = 16 << 30;

/// Shows a volume in a web browser.
///
/// To turn, colour and cut it with the mouse, and to take pictures, movies and commands from there.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast view brain.nii.gz --open
  slabcast view ct.nrrd --tf bone
  slabcast view ct.nrrd --tf bone.json
  slabcast view head.raw --up=-y
  On the page of a master, which has the volume or gets it:
      slabcast view knee --master node1:7433 --open
  On another machine, through a tunnel (ssh -L 7444:127.0.0.1:7444 node):
      slabcast view ct.nrrd --listen 127.0.0.1:7444

The page has the command that draws each of its pictures. A master serves the same page for all of
its volumes, on its own port (see `slabcast master --help`).")]
pub(crate) struct ViewArgs {
    #[arg(help = volume::VOLUME, required_unless_present = "master")]
    volume: Option<PathBuf>,
    #[command(flatten)]
    input: volume::InputArgs,
    #[command(flatten)]
    axes: AxisArgs,
    /// Colours of the first picture: a preset, a colour map, or a JSON file of ours or ParaView's
    /// [default: auto]
    #[arg(long, value_name = "NAME|FILE", value_parser = NameOrFile::TRANSFER, hide_possible_values = true)]
    tf: Option<String>,
    /// Open the page in this machine's browser
    #[arg(long)]
    open: bool,
    /// Show a volume on the page of this master: print its address, and end
    ///
    /// VOLUME is then a name (`slabcast volumes`), or a file, which is put on the master unless it has it.
    /// Without VOLUME the page shows the master's own, or its first.
    #[arg(long, value_name = "HOST:PORT", value_parser = parse::master)]
    master: Option<String>,
    /// Address of the page; port 0 takes any free one [default: 127.0.0.1:0]
    #[arg(long, value_name = "HOST:PORT", value_parser = parse::listen)]
    listen: Option<String>,
    /// Listen beyond this machine although nothing is encrypted
    #[arg(long, value_parser = clap::builder::FalseyValueParser::new(), hide_short_help = true)]
    insecure: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Workers inside this process [default: 1]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=64),
          hide_short_help = true)]
    workers: Option<u32>,
    /// Render threads of each worker [default: all cores]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
}

/// Runs the command.
pub(crate) fn run(args: &ViewArgs) -> Result<(), Fail> {
    args.axes.orientation()?;
    if let Some(master) = &args.master {
        return there::run(args, master);
    }
    let Some(volume) = &args.volume else { unreachable!("clap asks for VOLUME without --master") };
    let crew = WorkerGroup::new(args.workers.unwrap_or(1), args.threads)?;
    let transfer = Transfer::read(args.tf.as_deref().unwrap_or("auto"))?;
    let mut config = args.page.config(Home::default())?;
    let runtime = runtime::start()?;
    // A port in use is told before a large file is read.
    let listen_at = args.listen.as_deref().unwrap_or("127.0.0.1:0");
    let socket = runtime.block_on(bind(listen_at, args.insecure))?;
    let opened = args.input.open_source(volume)?;
    let orientation = args.axes.for_info(opened.info())?;
    function(&transfer, opened.info())?;
    let file = volume.to_string_lossy().into_owned();
    config.home = Home { tf: Some(transfer.choice(opened.info())), file: Some(file) };
    // Workers share the master's bricks of a volume in memory; of a file both drop what exceeds
    // their memory.
    let brick_bytes = match opened.source.whole(0) {
        Some(_) => SHARED,
        None => available().map_or(SHARED, |free| free / 4 / u64::from(crew.workers)),
    };
    // Files that are dropped on the page live as long as the page.
    let uploads = tempfile::Builder::new().prefix("slabcast-view-").tempdir();
    let uploads = uploads.map_err(|e| Fail::failed(format!("making a folder failed: {e}")))?;
    let result = runtime.block_on(async {
        let listener = listen(socket, listen_at)?;
        let address = local(&listener)?;
        let url = page::url(address, &config);
        let library = library(args, (opened.source, orientation), uploads.path())?;
        let mut cluster = Cluster::with_library(library, crew, brick_bytes, None)?;
        signals::listen();
        let (stop, stopped) = watch::channel(false);
        let mut served = page::serve(cluster.handle(), listener, config, &stopped);
        say(&format!("{url}\n"))?;
        if args.open {
            open(&url);
        } else {
            progress::note("open this address in a browser; Ctrl-C ends");
        }
        let ended = tokio::select! {
            _ = signals::stopped() => Ok(()),
            trouble = cluster.trouble() => Err(trouble),
            ended = &mut served => Err(match ended {
                Ok(Ok(())) => Fail::failed("serving the page stopped by itself"),
                Ok(Err(e)) => Fail::failed(format!("serving the page failed: {e}")),
                Err(e) => Fail::failed(format!("serving the page failed: {e}")),
            }),
        };
        let _ = stop.send(true);
        cluster.end().await;
        if ended.is_ok() {
            let _ = served.await;
        }
        ended
    });
    runtime::end(runtime);
    result
}

/// Returns the function of `--tf` in full for a volume.
///
/// # Errors
/// It doesn't fit the volume; a file is named with its field.
fn function(transfer: &Transfer, info: &VolumeInfo) -> Result<TransferFunction, Fail> {
    transfer.function(info).map_err(|e| match transfer.file() {
        Some(file) => Fail::field(file, "transfer function", &e),
        None => Fail::flag(&e),
    })
}

/// Returns the library of the page: the volume that was given, and files that are dropped on the page.
fn library(args: &ViewArgs, given: Source, uploads: &Path) -> Result<Library, Fail> {
    let uploads = UploadConfig { folder: uploads.to_owned(), quota_bytes: UPLOADS };
    let config = LibraryConfig {
        given: Some(given),
        folder: None,
        uploads: Some(uploads),
        memory_bytes: available().map_or(u64::MAX, |free| free / 2),
        read: reader(args.input.clone(), args.axes.clone()),
    };
    Library::new(config).map_err(Fail::failed)
}

/// Opens an address in the browser of this machine's user.
fn open(url: &str) {
    let programs: &[&str] = if cfg!(target_os = "macos") {
        &["open"]
    } else if cfg!(windows) {
        &["explorer"]
    } else {
        &["xdg-open", "gio", "sensible-browser"]
    };
    for program in programs {
        let mut command = Command::new(program);
        if *program == "gio" {
            command.arg("open");
        }
        let quiet =
            command.arg(url).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
        if quiet.spawn().is_ok() {
            return;
        }
    }
    progress::note("no program to open a browser was found; open the address yourself");
}
