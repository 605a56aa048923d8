//! `slabcast volumes`, `put` and `rm`: the volumes of a master.

use crate::master_client::{MasterArg, ask, table};
use slabcast_client::{VolumeEntry, VolumeOrigin};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{Progress, bytes};
use slabcast_session::request::AxisArgs;
use slabcast_session::{remote, runtime, signals, volume};
use std::path::PathBuf;

/// Lists the volumes that a master has.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
A volume that was not read yet shows `-` for its size; it is read when somebody renders it.

Examples:
  slabcast volumes
  slabcast volumes --master node1:7433 --json")]
pub(crate) struct VolumesArgs {
    #[command(flatten)]
    master: MasterArg,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Puts a volume on a master.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
The file is read here, whatever its format, and its samples are sent. What the master has is not sent
again; an upload that broke off goes on where it was.

Examples:
  slabcast put brain.nii.gz
  slabcast put series/ --name knee --master node1:7433
  slabcast render knee --master node1:7433")]
pub(crate) struct PutArgs {
    #[arg(help = volume::VOLUME)]
    volume: PathBuf,
    #[command(flatten)]
    input: volume::InputArgs,
    #[command(flatten)]
    axes: AxisArgs,
    /// Name that the volume gets [default: the file's]
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    #[command(flatten)]
    master: MasterArg,
    /// No progress, only warnings and the result
    #[arg(short, long)]
    quiet: bool,
}

/// Removes a volume that was put on a master.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Files of the master's own folder are not removed.

Examples:
  slabcast rm knee
  slabcast rm knee --master node1:7433")]
pub(crate) struct RmArgs {
    /// The volume, as `slabcast volumes` names it
    name: String,
    #[command(flatten)]
    master: MasterArg,
}

/// Runs `slabcast volumes`.
pub(crate) fn list(args: &VolumesArgs) -> Result<(), Fail> {
    let volumes = ask(&args.master.address, async |client| client.volumes().await)?.volumes;
    if args.json {
        let volumes: Vec<_> = volumes.iter().map(entry_json).collect();
        return say(&format!("{:#}\n", serde_json::Value::Array(volumes)));
    }
    if volumes.is_empty() {
        return say("no volumes yet; put one there with `slabcast put FILE`\n");
    }
    let mut out = String::new();
    volume_table(&mut out, &volumes);
    say(&out)
}

/// Runs `slabcast put`.
pub(crate) fn put(args: &PutArgs) -> Result<(), Fail> {
    let runtime = runtime::start()?;
    let address = &args.master.address;
    let mut progress = Progress::new(args.quiet).counting("MiB");
    // A master that is not there is told before a long read.
    let client = runtime.block_on(remote::connect(address))?;
    progress.phase(&format!("reading {}", args.volume.display()));
    let volume = args.input.open(&args.volume)?;
    let orientation = args.axes.for_volume(&volume)?;
    let name = args.name.clone().unwrap_or_else(|| volume.name.clone());
    // The line says nothing of what the master has already.
    let mut is_sending = false;
    let told = |there, total| {
        is_sending |= there < total;
        if is_sending {
            progress.bytes_done(there, total, &format!("sending {name} to {address}"));
        }
    };
    let put = runtime.block_on(async {
        signals::listen();
        tokio::select! {
            put = remote::put(&client, &volume, orientation, (&name, args.name.is_some()), told) => put,
            code = signals::stopped() => Err(Fail::silent(code)),
        }
    });
    progress.end();
    runtime::end(runtime);
    let put = put?;
    say(&format!(
        "{} is on the master: slabcast render {} --master {address}\n",
        put.name, put.name
    ))
}

/// Runs `slabcast rm`.
pub(crate) fn remove(args: &RmArgs) -> Result<(), Fail> {
    ask(&args.master.address, async |client| client.remove_volume(&args.name).await)?;
    say(&format!("{} removed\n", args.name))
}

/// Adds a table of volumes to `out`.
pub(crate) fn volume_table(out: &mut String, volumes: &[VolumeEntry]) {
    let mut rows = vec![["volume", "samples", "bytes", "digest", "from", ""].map(String::from)];
    rows.extend(volumes.iter().map(|v| {
        let (samples, digest) = match &v.read {
            Some((digest, [x, y, z], kind)) => {
                let kind = format!("{kind:?}").to_lowercase();
                (format!("{x}x{y}x{z} {kind}"), digest.to_string()[..8].to_owned())
            }
            None => ("-".into(), "-".into()),
        };
        let state = match (v.problem.is_empty(), v.in_memory) {
            (false, _) => v.problem.clone(),
            (true, true) => "in memory".into(),
            (true, false) => String::new(),
        };
        let size = if v.bytes > 0 { bytes(v.bytes) } else { "-".into() };
        [v.name.clone(), samples, size, digest, origin(v.origin).into(), state]
    }));
    table(out, &rows);
}

fn origin(origin: VolumeOrigin) -> &'static str {
    match origin {
        VolumeOrigin::Given => "start",
        VolumeOrigin::Folder => "folder",
        VolumeOrigin::Upload => "upload",
    }
}

/// Returns a volume of a list as JSON.
pub(crate) fn entry_json(v: &VolumeEntry) -> serde_json::Value {
    serde_json::json!({
        "name": v.name,
        "digest": v.read.as_ref().map(|(digest, ..)| digest.to_string()),
        "dims": v.read.as_ref().map(|(_, dims, _)| dims),
        "sample_kind": v.read.as_ref().map(|(.., kind)| kind),
        "bytes": v.bytes, "from": origin(v.origin), "in_memory": v.in_memory,
        "problem": v.problem,
    })
}
