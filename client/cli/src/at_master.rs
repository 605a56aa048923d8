//! The volume of a command that asks a master: one that the master has, by name, or a file of this
//! machine, which is put there.

use slabcast_client::{Client, VolumeDescription};
use slabcast_scene::request::VolumeChoice;
use slabcast_session::fail::Fail;
use slabcast_session::progress::Progress;
use slabcast_session::request::AxisArgs;
use slabcast_session::volume::InputArgs;
use slabcast_session::{remote, signals};
use std::path::Path;
use tokio::runtime::Runtime;

/// Returns whether VOLUME means a file, a folder or a formula of this machine, and not a volume of
/// the master by name. Names have no `/`, so a path to a missing file is reported as one.
pub(crate) fn is_here(volume: &Path) -> bool {
    let text = volume.to_string_lossy();
    volume.exists() || text.contains('/') || text.starts_with("formula:")
}

/// What a command line says of its volume.
pub(crate) struct VolumeWords<'a> {
    /// `None`: the master's only one.
    pub(crate) volume: Option<&'a Path>,
    pub(crate) input: &'a InputArgs,
    pub(crate) axes: &'a AxisArgs,
    /// Whether no progress is shown.
    pub(crate) quiet: bool,
}

/// Returns the volume at the master that the command means. A file is read here, and put there
/// unless the master has it.
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
