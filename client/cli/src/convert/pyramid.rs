//! Writes OME-Zarr: a folder with all levels.

use super::ConvertArgs;
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress, Step};
use slabcast_session::signals;
use slabcast_volumes::Problem;
use slabcast_volumes::blocks::ome_zarr;
use std::path::Path;

/// Runs the command for an OUT of OME-Zarr.
pub(super) fn run(args: &ConvertArgs) -> Result<(), Fail> {
    let shown = args.output.display();
    if args.encoding.is_some() {
        return Err(Fail::usage(
            "--encoding: OME-Zarr has its own encoding; leave the flag out".to_string(),
        ));
    }
    if let (Ok(a), Ok(b)) = (args.output.canonicalize(), args.volume.canonicalize())
        && a == b
    {
        return Err(Fail::usage(format!("OUT: `{shown}` is the volume itself; give another name")));
    }
    if args.output.symlink_metadata().is_ok() {
        if !args.force {
            return Err(Fail::failed(format!(
                "{shown}: is there already; add --force to replace it, or give another name"
            )));
        }
        if ome_zarr::level_sizes(&args.output).is_none() {
            return Err(Fail::failed(format!(
                "{shown}: is no Zarr folder, and is not replaced; remove it, or give another name"
            )));
        }
    }
    let mut bar = Progress::new(args.quiet).counting("MiB");
    bar.phase(&format!("reading {}", args.volume.display()));
    let (input, from, to) = (args.input.clone(), args.volume.clone(), args.output.clone());
    let (force, what) = (args.force, format!("writing {shown}"));
    let bytes = signals::run_to_end(move || {
        let mut last = u64::MAX;
        let mut on_progress = |done: u64, total: u64| {
            // A pass over the samples begins; some types take two.
            if done < last {
                bar.frames(total.div_ceil(1 << 20).max(1), &what);
            }
            last = done;
            bar.step(Step { frames: done >> 20, ..Step::default() });
            match signals::stop_requested() {
                true => Err(Problem::stopped()),
                false => Ok(()),
            }
        };
        input.convert(&from, &to, force, &mut on_progress)?;
        bar.end();
        size(&to).map_err(|e| Fail::io(&to, "looking at it", &e))
    })?;
    if args.quiet {
        return Ok(());
    }
    let levels = ome_zarr::level_sizes(&args.output).map_or(0, |levels| levels.len());
    say(&format!("{shown}: {}, {levels} levels\n", progress::bytes(bytes)))
}

/// Returns the bytes of all files below a folder.
fn size(folder: &Path) -> std::io::Result<u64> {
    let mut bytes = 0;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let meta = entry.metadata()?;
        bytes += if meta.is_dir() { size(&entry.path())? } else { meta.len() };
    }
    Ok(bytes)
}
