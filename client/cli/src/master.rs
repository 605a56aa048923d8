//! `slabcast master`: serves volumes to workers and takes jobs from clients.
//!
//! Says READY to systemd, answers its watchdog, and on SIGTERM or Ctrl-C stops gracefully within
//! ten seconds and ends with 0. Every flag has a variable of the environment ([`crate::config`]),
//! so that a unit file needs none.

use crate::page::{self, PageArgs};
use crate::systemd::{self, DRAIN};
use slabcast_live::Home;
use slabcast_master::library::{ReadFile, Source, Unreadable, UploadConfig, Viewer};
use slabcast_master::memory::{Shares, available};
use slabcast_master::{Library, LibraryConfig, MasterConfig, PeerLimits};
use slabcast_scene::path::Axis;
use slabcast_session::embedded::start_master;
use slabcast_session::fail::{Fail, reason, say};
use slabcast_session::machine::boot_id;
use slabcast_session::progress::bytes;
use slabcast_session::request::AxisArgs;
use slabcast_session::volume::OpenedSource;
use slabcast_session::{parse, record, runtime, signals, volume};
use slabcast_volumes::{OpenError, OpenErrorKind};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::net::{TcpListener, TcpSocket};
use tokio::sync::watch;
use tracing::{info, warn};

const MASTER_EXAMPLES: &str = "\
Examples:
  slabcast master --volumes scans/
  slabcast worker --master 127.0.0.1:7433        (as often as you like, here or elsewhere)
  slabcast volumes
  slabcast render knee --master 127.0.0.1:7433 -o out/

  One volume, which needs no name:
  slabcast master --volume brain.nii.gz
  slabcast render --master 127.0.0.1:7433 -o out/

  No volumes yet; clients put theirs:
  slabcast master
  slabcast render knee.nrrd --master 127.0.0.1:7433 -o out/

  For workers on other machines, on a network that you trust:
  slabcast master --volume brain.nii.gz --listen 0.0.0.0:7433 --insecure";

/// Least memory that a master takes for itself unless it is told: a frame of 2048x2048 and two
/// brick sets of mri256.
const MEMORY: u64 = 512 << 20;

/// Serves volumes to workers and takes jobs from clients.
#[derive(clap::Args, Clone, Debug)]
// `--volume` is the file here.
#[command(after_help = MASTER_EXAMPLES, mut_arg("nth_volume", |a| a.long("nth-volume")))]
pub(crate) struct MasterArgs {
    #[arg(long, value_name = "FILE", help = volume::VOLUME)]
    volume: Option<PathBuf>,
    /// Folder whose files are served by name, read when they are needed
    #[arg(long, value_name = "FOLDER")]
    volumes: Option<PathBuf>,
    /// Folder for volumes that clients put here [default: the state folder, for each port]
    #[arg(long, value_name = "FOLDER")]
    uploads: Option<PathBuf>,
    /// Bytes that volumes of clients may take on disk; 0 takes none
    #[arg(long, value_name = "BYTES", default_value = "16GiB", value_parser = parse::memory_or_none,
          hide_short_help = true)]
    upload_quota: u64,
    /// Memory for volumes of folders and clients [default: half of what is free]
    #[arg(long, value_name = "BYTES", value_parser = parse::memory, hide_short_help = true)]
    volume_memory: Option<u64>,
    #[command(flatten)]
    input: volume::InputArgs,
    /// World axis that is up: x, y or z with + or - [default: +z]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    up: Option<Axis>,
    /// World axis that faces the eye at azimuth 0 [default: +y, or +z where up lies along y; -y of
    /// a CT whose file has no anatomical axes, as slices are stored]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    front: Option<Axis>,
    /// Address for workers and clients; port 0 takes any free one and prints it
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7433", value_parser = parse::listen)]
    listen: String,
    /// Listen beyond this machine although nothing is encrypted or authenticated
    #[arg(long,
          value_parser = clap::builder::FalseyValueParser::new())]
    insecure: bool,
    /// Memory for frames, brick sets and requests, beside volumes [default: half of what is free]
    #[arg(long, value_name = "BYTES", value_parser = parse::memory)]
    memory: Option<u64>,
    /// Jobs in progress that one address may have
    #[arg(long, value_name = "N", default_value = "100", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=200))]
    peer_jobs: u32,
    /// Watchers that one address may have
    #[arg(long, value_name = "N", default_value = "128", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=256))]
    peer_watchers: u32,
    /// Connections that one address may have; a worker takes two
    #[arg(long, value_name = "N", default_value = "1024", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=4096))]
    peer_connections: u32,
    /// Tell clients on other machines the names of volumes, which may be patients'
    #[arg(long, value_parser = clap::builder::FalseyValueParser::new())]
    show_names: bool,
    #[command(flatten)]
    page: PageArgs,
    /// Events and decisions of the scheduler, for `slabcast lab replay`; some 25 KB a frame
    #[arg(long, value_name = "FILE")]
    record: Option<PathBuf>,
    /// Share of each worker's tiles that another draws too, to compare; 0 for none [default: 1% of
    /// workers on other machines]
    ///
    /// Of a new worker the first sixteen tiles are compared. Given a share, workers on the master's
    /// machine are compared, too. One that drew something else than two others, or than one on the
    /// master's machine that is not compared, is shut out. A worker alone can't be compared.
    #[arg(long, value_name = "SHARE", value_parser = parse::share)]
    audit: Option<f64>,
    /// Minutes for which a worker that drew false pixels is shut out, by name and address
    #[arg(long, value_name = "MINUTES", default_value = "60", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=525_600))]
    shut_out: u32,
    /// Take workers that hold tiles for recorded times (`slabcast worker --rehearse`), and no
    /// others; pictures are marked all over
    #[arg(long, value_parser = clap::builder::FalseyValueParser::new())]
    rehearse: bool,
}

/// Runs `slabcast master`.
pub(crate) fn run(args: &MasterArgs) -> Result<(), Fail> {
    let axes = AxisArgs { up: args.up, front: args.front };
    axes.orientation()?;
    let page_config = args.page.config(Home::default())?;
    let runtime = runtime::start()?;
    // The address is taken before the volume is read, so that a port in use is told at once;
    // it is opened after, so that whoever gets through gets an answer.
    let socket = runtime.block_on(bind(&args.listen, args.insecure))?;
    let address = runtime.block_on(async { socket.local_addr() });
    let port = address.map_or(0, |address| address.port());
    let given = match &args.volume {
        Some(path) => {
            let opened = args.input.open_source(path)?;
            let orientation = axes.for_info(opened.info())?;
            Some((opened.source, orientation))
        }
        None => None,
    };
    let name = given.as_ref().map_or_else(|| "volumes".to_owned(), |(s, _)| s.name().to_owned());
    let dims = given.as_ref().map(|(source, _)| source.levels()[0].lattice.dims);
    let volume_bytes = given.as_ref().map_or(0, |(source, _)| source.memory_bytes());
    let library = library(args, given, port)?;
    let volumes = library.list(Viewer::own()).len();
    let mut config = MasterConfig::of(library);
    config.shares = shares(args.memory);
    tell_memory(volume_bytes, args.volume_memory(), &config.shares);
    config.peer_limits = PeerLimits {
        jobs: args.peer_jobs as usize,
        watchers: args.peer_watchers as usize,
        connections: args.peer_connections as usize,
        ..PeerLimits::default()
    };
    config.show_names = args.show_names;
    raise_files();
    config.rehearse = args.rehearse;
    config.audit_ppm = args.audit.map(|share| (share * 1e6).ceil() as u32);
    config.shut_out = Duration::from_secs(60 * u64::from(args.shut_out));
    config.machine = boot_id();
    if args.rehearse {
        warn!("--rehearse: this master's pictures are stripes, whatever is asked for");
    }
    if let Some(path) = &args.record {
        let inputs: Vec<&Path> = args.volume.iter().map(PathBuf::as_path).collect();
        record::check_path(path, &inputs)?;
    }
    let mut recording = None;
    let result = runtime.block_on(async {
        let listener = listen(socket, &args.listen)?;
        let address = local(&listener)?;
        if let Some(path) = &args.record {
            let (recorder, begun) = record::start(path)?;
            config.record = Some(recorder);
            recording = Some(begun);
        }
        let master = start_master(config)?;
        let handle = master.handle();
        signals::listen();
        let (stop, stopped) = watch::channel(false);
        let url = page::url(address, &page_config);
        let mut served = page::serve(handle.clone(), listener, page_config, &stopped);
        if args.insecure && !address.ip().is_loopback() {
            warn!("--insecure: whoever reaches {address} may read the volume and submit jobs");
        }
        info!(%address, volumes, volume = name, ?dims, "listening");
        // Nobody may read stdout (systemd closes it): that is no reason to end.
        let _ = say(&format!("listening on {address}\npage {url}\n"));
        systemd::ready(&format!("serving {name} on {address}"));
        let beat = tokio::spawn(systemd::watchdog(Some(handle)));
        let result = tokio::select! {
            ended = &mut served => Err(ended),
            code = signals::stopped() => Ok(code),
        };
        beat.abort();
        let code = match result {
            Ok(code) => code,
            Err(ended) => {
                let why = match ended {
                    Ok(Ok(())) => "it stopped by itself".into(),
                    Ok(Err(e)) => reason(&e),
                    Err(e) => e.to_string(),
                };
                return Err(Fail::failed(format!("serving {address} failed: {why}")));
            }
        };
        info!(signal = code - 128, "stopping: workers are asked to leave, jobs end");
        systemd::stopping();
        let _ = stop.send(true);
        let drained = async {
            master.shutdown().await;
            let _ = served.await;
        };
        if tokio::time::timeout(DRAIN, drained).await.is_err() {
            warn!("connections did not end in time");
        }
        Ok(())
    });
    runtime::end(runtime);
    // The driver has ended, or has given up within its time: then its record is not whole.
    let recorded = recording.map_or(Ok(()), record::Recording::end);
    result?;
    recorded?;
    info!("stopped");
    Ok(())
}

/// Returns the shares of the master's memory budget in bytes. The budget is `memory`, or half of the free
/// memory of the machine or control group.
fn shares(memory: Option<u64>) -> Shares {
    let half = || available().map(|free| (free / 2).max(MEMORY));
    memory.or_else(half).map_or_else(Shares::default, Shares::of)
}

impl MasterArgs {
    /// Bytes of samples of volumes that are read when they are needed.
    fn volume_memory(&self) -> u64 {
        let half = || available().map_or(u64::MAX, |free| (free / 2).max(MEMORY));
        self.volume_memory.unwrap_or_else(half)
    }
}

/// Returns the volumes of the master: the one that was `given`, those of folders, and those of clients.
fn library(args: &MasterArgs, given: Option<Source>, port: u16) -> Result<Library, Fail> {
    let axes = AxisArgs { up: args.up, front: args.front };
    let read = reader(args.input.clone(), axes);
    let folder = match &args.uploads {
        _ if args.upload_quota == 0 => None,
        Some(folder) => Some(folder.clone()),
        None => uploads_folder(port),
    };
    let config = |folder: Option<PathBuf>| LibraryConfig {
        given: given.clone(),
        folder: args.volumes.clone(),
        uploads: folder.map(|folder| UploadConfig { folder, quota_bytes: args.upload_quota }),
        memory_bytes: args.volume_memory(),
        read: read.clone(),
    };
    match Library::new(config(folder)) {
        Ok(library) => Ok(library),
        // Nobody asked for the default folder.
        Err(e) if args.uploads.is_none() && e.starts_with("--uploads") => {
            warn!("no volumes of clients are taken: {e}");
            Library::new(config(None)).map_err(|e| Fail::failed(format!("--volumes {e}")))
        }
        Err(e) if e.starts_with("--uploads") => Err(Fail::failed(e)),
        Err(e) => Err(Fail::failed(format!("--volumes {e}"))),
    }
}

/// Returns the reader of files of folders and pages: what `input` says of files holds for each.
pub(crate) fn reader(input: volume::InputArgs, axes: AxisArgs) -> ReadFile {
    Arc::new(move |path, most_bytes| {
        let opened = input.read(path, most_bytes);
        // Clients are told the file's name, not its folder.
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let (OpenedSource { source, .. }, notes) = opened.map_err(|e| {
            let is_too_large = e.problem.kind == OpenErrorKind::TooLarge;
            Unreadable { reason: OpenError { file: name, ..e }.to_string(), is_too_large }
        })?;
        for note in notes {
            info!(volume = source.name(), "{note}");
        }
        let orientation = axes.for_info(&source.levels()[0]).map_err(|e| {
            let reason = e.line().unwrap_or_default().to_owned();
            Unreadable { reason, is_too_large: false }
        })?;
        Ok((source, orientation))
    })
}

/// Returns where volumes of clients go by default: a folder for each port, so that two masters of one
/// user don't share it. `None` of a port that was not chosen, or a user without a home.
fn uploads_folder(port: u16) -> Option<PathBuf> {
    let variable = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let state = || {
        variable("XDG_STATE_HOME")
            .or_else(|| variable("HOME").map(|home| home.join(".local/state")))
            .map(|folder| folder.join("slabcast"))
    };
    let folder = variable("STATE_DIRECTORY").or_else(state)?;
    (port > 0).then(|| folder.join(format!("volumes-{port}")))
}

/// Says what the master will hold at most.
fn tell_memory(volume_bytes: u64, volume_memory: u64, shares: &Shares) {
    let largest = shares.largest_frame.map_or_else(|| "all that is free".into(), bytes);
    info!(
        volume = bytes(volume_bytes),
        other_volumes = if volume_memory == u64::MAX { "any".into() } else { bytes(volume_memory) },
        frames = bytes(shares.frames),
        largest_frame = largest,
        brick_sets = if shares.bricks == u64::MAX { "any".into() } else { bytes(shares.bricks) },
        requests = bytes(shares.requests as u64),
        "memory at most"
    );
}

/// Files that a master may have open at best: 4096 connections, and some.
#[cfg(unix)]
const FILES: u64 = 8192;

/// Raises the limit of open files: a shell's default of 1024 is 1000 connections.
#[cfg(unix)]
fn raise_files() {
    use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
    let Rlimit { current, maximum } = getrlimit(Resource::Nofile);
    let most = maximum.unwrap_or(u64::MAX).min(FILES.max(current.unwrap_or(u64::MAX)));
    let raised = setrlimit(Resource::Nofile, Rlimit { current: Some(most), maximum });
    let files = if raised.is_ok() { Some(most) } else { current };
    if files.is_some_and(|files| files < FILES) {
        warn!(
            files,
            needed = FILES,
            "the limit of open files is low: connections beyond it are turned away; raise it with \
             `ulimit -Hn`, or LimitNOFILE in the unit"
        );
    }
}

/// Systems without such a limit have nothing to raise.
#[cfg(not(unix))]
fn raise_files() {}

/// Takes the address without opening it. Refuses what others can reach, unless `insecure`.
pub(crate) async fn bind(text: &str, insecure: bool) -> Result<TcpSocket, Fail> {
    let found = tokio::net::lookup_host(text).await.map_err(|e| {
        Fail::failed(format!("--listen {text}: looking up the host failed: {}", reason(&e)))
    })?;
    let addresses: Vec<SocketAddr> = found.collect();
    let Some(&address) = addresses.first() else {
        return Err(Fail::failed(format!("--listen {text}: the host has no address")));
    };
    if !address.ip().is_loopback() && !insecure {
        let port = match address.port() {
            0 => "PORT".into(),
            port => port.to_string(),
        };
        return Err(Fail::usage(format!(
            "--listen {text}: other machines could reach it, and this version neither encrypts nor \
             asks who calls; listen on 127.0.0.1:{port} (and reach it through a tunnel, like ssh -L \
             {port}:127.0.0.1:{port}), or add --insecure on a network that you trust"
        )));
    }
    let socket = if address.is_ipv4() { TcpSocket::new_v4() } else { TcpSocket::new_v6() };
    let taken = socket.and_then(|socket| {
        // A port whose last connections still linger can be taken again at once.
        socket.set_reuseaddr(true)?;
        socket.bind(address)?;
        Ok(socket)
    });
    taken.map_err(|e| cannot_listen(text, &e))
}

/// Opens an address that was taken.
pub(crate) fn listen(socket: TcpSocket, text: &str) -> Result<TcpListener, Fail> {
    socket.listen(1024).map_err(|e| cannot_listen(text, &e))
}

fn cannot_listen(text: &str, e: &std::io::Error) -> Fail {
    use std::io::ErrorKind;
    Fail::failed(match e.kind() {
        ErrorKind::AddrInUse => format!(
            "--listen {text}: the port is in use; stop who has it (ss -ltnp shows that), or give \
             another port (0 takes any free one)"
        ),
        ErrorKind::PermissionDenied => {
            format!("--listen {text}: not allowed; ports below 1024 are root's, give a higher one")
        }
        ErrorKind::AddrNotAvailable => {
            format!(
                "--listen {text}: this machine does not have that address; give one that it has"
            )
        }
        _ => format!("--listen {text}: {}", reason(e)),
    })
}

/// Returns the address that a listener has.
pub(crate) fn local(listener: &TcpListener) -> Result<SocketAddr, Fail> {
    listener.local_addr().map_err(|e| Fail::failed(format!("listening failed: {}", reason(&e))))
}
