//! `slabcast view --master`: the address at which the page of a running master shows a volume.
//!
//! Nothing is served by this process, which ends at once.

use super::{ViewArgs, open};
use crate::at_master::{self, VolumeWords, is_here};
use slabcast_live::fragment;
use slabcast_scene::transfer::TransferChoice;
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::Progress;
use slabcast_session::transfer::{Transfer, in_values};
use slabcast_session::{remote, runtime};

/// Longest address that is printed: systems hand a program at most 128 KiB as one word.
const LONGEST: usize = 100_000;

/// Prints the address, and opens it if that is asked for.
///
/// # Errors
/// Flags don't fit, the master can't be reached, or it has no such volume.
pub(super) fn run(args: &ViewArgs, master: &str) -> Result<(), Fail> {
    refuse_flags(args)?;
    let transfer = args.tf.as_deref().map(Transfer::read).transpose()?;
    let runtime = runtime::start()?;
    let mut progress = Progress::new(false);
    progress.phase(&format!("dialling {master}"));
    let asked = (|| {
        // A master that is not there is told before a long read.
        let client = runtime.block_on(remote::connect(master))?;
        let is_file = transfer.as_ref().is_some_and(|transfer| transfer.file().is_some());
        if args.volume.is_none() && !is_file {
            return Ok(None);
        }
        let words = VolumeWords {
            volume: args.volume.as_deref(),
            input: &args.input,
            axes: &args.axes,
            quiet: false,
        };
        at_master::volume(&words, &client, &runtime, &mut progress).map(Some)
    })();
    progress.end();
    runtime::end(runtime);
    let served = asked?;
    let choice = match (&transfer, &served) {
        (Some(transfer), Some(served)) if transfer.file().is_some() => {
            let tf = super::function(transfer, &served.info)?;
            Some(TransferChoice::Function(Box::new(in_values(&tf, &served.info))))
        }
        (Some(transfer), _) => Some(TransferChoice::Name(transfer.name())),
        (None, _) => None,
    };
    let name = served.as_ref().map(|served| served.name.as_str());
    let url = format!("http://{master}/{}", fragment(name, choice.as_ref()));
    if url.len() > LONGEST {
        return Err(Fail::failed(format!(
            "--tf: the function makes an address of {} characters, and programs take {LONGEST}; give one \
             with fewer points",
            url.len()
        )));
    }
    say(&format!("{url}\n"))?;
    if args.open {
        open(&url);
    }
    Ok(())
}

/// Refuses flags that say how this process would serve a page, and those that say what is in a file
/// that is not here.
fn refuse_flags(args: &ViewArgs) -> Result<(), Fail> {
    let flags = [
        ("listen", args.listen.is_some()),
        ("insecure", args.insecure),
        ("workers", args.workers.is_some()),
        ("threads", args.threads.is_some()),
    ];
    let own = flags.into_iter().find_map(|(flag, is_given)| is_given.then_some(flag));
    if let Some(flag) = own.or(args.page.given()) {
        return Err(Fail::usage(format!(
            "--{flag}: with --master the page is the master's, and nothing is served here; leave it out, or \
             give it to `slabcast master` or `slabcast worker`"
        )));
    }
    if args.volume.as_deref().is_some_and(is_here) {
        return Ok(());
    }
    if args.input != Default::default() {
        return Err(Fail::usage(
            "--dims, --type and the like say what is in a file, and with --master the master has read \
             the volume; leave them out, or give a file as VOLUME",
        ));
    }
    if args.axes.up.is_some() || args.axes.front.is_some() {
        return Err(Fail::usage(
            "--up, --front: the master knows how its volume stands; leave them out, and choose other axes \
             on the page",
        ));
    }
    Ok(())
}
