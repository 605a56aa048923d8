//! Resolves VOLUME of a command that runs with `--master`: the name of a volume at the master, or a local
//! file, which is uploaded unless the master has it.

use slabcast_client::{Client, VolumeDescription};
use slabcast_scene::request::VolumeChoice;
use slabcast_session::fail::Fail;
use slabcast_session::progress::Progress;
use slabcast_session::request::AxisArgs;
use slabcast_session::volume::InputArgs;
use slabcast_session::{remote, signals};
use std::path::Path;
use tokio::runtime::Runtime;

/// Returns whether VOLUME is a local file, folder or formula, and not the name of a volume at the master.
/// Names have no `/`, so a path with one is local even if the file is missing.
pub(crate) fn is_here(volume: &Path) -> bool {
    let text = volume.to_string_lossy();
    volume.exists() || text.contains('/') || text.starts_with("formula:")
}

/// Arguments of a command line that choose a volume and say how to read it.
pub(crate) struct VolumeWords<'a> {
    /// Name or path; `None` for the master's default volume.
    pub(crate) volume: Option<&'a Path>,
    pub(crate) input: &'a InputArgs,
    pub(crate) axes: &'a AxisArgs,
    /// Whether the upload shows no progress bar.
    pub(crate) quiet: bool,
}

/// Returns the description of the command's volume at the master. A local file is read, and uploaded
/// unless the master has a volume of the same digest.
///
/// # Errors
/// The master has no such volume, doesn't answer or refuses the file; the file can't be read.
pub(crate) fn volume(
    words: &VolumeWords<'_>,
    client: &Client,
    runtime: &Runtime,
    progress: &mut Progress,
) -> Result<VolumeDescription, Fail> {
    let Some(volume) = words.volume else {
        return runtime.block_on(remote::describe(client, &VolumeChoice::Default));
    };
    if !is_here(volume) {
        let name = volume.to_string_lossy().into_owned();
        return runtime.block_on(remote::describe(client, &VolumeChoice::Name(name)));
    }
    progress.phase(&format!("reading {}", volume.display()));
    let volume = words.input.open(volume)?;
    let orientation = words.axes.for_volume(&volume)?;
    let name = (volume.name.as_str(), false);
    // Nothing is sent and no progress is shown if the master has the volume already.
    let mut sending = None;
    let told = |there, total| {
        if there < total || sending.is_some() {
            let bar = sending.get_or_insert_with(|| Progress::new(words.quiet).counting("MiB"));
            bar.bytes_done(
                there,
                total,
                &format!("sending {} to {}", volume.name, client.address()),
            );
        }
    };
    let put = runtime.block_on(async {
        signals::listen();
        tokio::select! {
            put = remote::put(client, &volume, orientation, name, told) => put,
            code = signals::stopped() => Err(Fail::silent(code)),
        }
    });
    if let Some(bar) = sending {
        bar.end();
    }
    put
}
