//! `slabcast worker`: renders for a master.
//!
//! It reports its state to systemd, and stops gracefully on SIGTERM or Ctrl-C, as a master does. If
//! its master is away, it dials until the master is back.

use crate::systemd::{self, DRAIN};
use slabcast_lab::plan;
use slabcast_render::Simd;
use slabcast_session::fail::Fail;
use slabcast_session::machine::{boot_id, cores};
use slabcast_session::progress::bytes;
use slabcast_session::{parse, runtime, signals};
use slabcast_worker::{BrickCache, Config, Ended, Rehearsal, memory};
use std::path::PathBuf;
use std::sync::Arc;
use tokio::sync::watch;
use tracing::{info, warn};

const WORKER_EXAMPLES: &str = "\
Examples:
  slabcast worker --master node1:7433
  slabcast worker --master node1:7433 --threads 8 --memory 4GiB --name node2
  slabcast worker --master 127.0.0.1:7433 --threads 1 --rehearse ct.trace

A worker may come and go at any time, also in mid-frame. When its master is away it dials again
until the master is back.";

/// Renders for a master.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = WORKER_EXAMPLES)]
pub(crate) struct WorkerArgs {
    /// The master
    #[arg(long, value_name = "HOST:PORT", value_parser = parse::master)]
    master: String,
    /// A name for people [default: host and process number]
    #[arg(long, value_name = "NAME", value_parser = parse::worker_name)]
    name: Option<String>,
    /// Render threads [default: all cores]
    #[arg(long, value_name = "N",
          value_parser = clap::value_parser!(u32).range(1..=1024))]
    threads: Option<u32>,
    /// Memory for the whole process; bricks get what the rest leaves
    #[arg(long, value_name = "BYTES", default_value = "512MiB",
          value_parser = parse::memory)]
    memory: u64,
    /// Draw nothing, but hold each tile for the time that this file of `slabcast lab plan --trace`
    /// says; for a master with --rehearse
    #[arg(long, value_name = "TRACE")]
    rehearse: Option<PathBuf>,
}

/// Runs `slabcast worker`.
pub(crate) fn run(args: &WorkerArgs) -> Result<(), Fail> {
    let rehearsal = match &args.rehearse {
        Some(file) => Some(Arc::new(Rehearsal::new(plan::read_trace(file)?))),
        None => None,
    };
    let threads = args.threads.unwrap_or_else(cores);
    let least = memory::least_bytes(threads);
    if args.memory < least {
        return Err(Fail::usage(format!(
            "--memory: {} is too little to draw with {threads} threads; give at least {}MiB, or \
             fewer --threads",
            bytes(args.memory),
            least.div_ceil(1 << 20),
        )));
    }
    let config = Config {
        rehearsal,
        name: args.name.clone().unwrap_or_else(host_and_process),
        threads,
        memory_budget_bytes: memory::encoded_share(args.memory, threads),
        simd: Simd::detect(),
        machine: boot_id(),
    };
    let runtime = runtime::start_worker(config.threads)?;
    let result = runtime.block_on(async {
        signals::listen();
        let (stop, stopped) = watch::channel(false);
        info!(
            name = config.name,
            master = args.master,
            threads = config.threads,
            memory = args.memory,
            simd = config.simd.name(),
            "worker starts"
        );
        let cache = BrickCache::within(args.memory, config.threads);
        let dialling = slabcast_worker::dial::run_with(config, cache, args.master.clone(), stopped);
        let mut running = tokio::spawn(dialling);
        systemd::ready(&format!("rendering for {}", args.master));
        let beat = tokio::spawn(systemd::watchdog(None));
        let ended = tokio::select! {
            ended = &mut running => ended,
            _ = signals::stopped() => {
                systemd::stopping();
                let _ = stop.send(true);
                match tokio::time::timeout(DRAIN, &mut running).await {
                    Ok(ended) => ended,
                    Err(_) => {
                        warn!("tasks did not end in time");
                        return Ok(());
                    }
                }
            }
        };
        beat.abort();
        match ended {
            Ok(Ok(Ended::Stopped)) => Ok(()),
            Ok(Ok(Ended::Refused(why))) => Err(Fail::failed(format!(
                "the master at {} refuses this worker: {why}",
                args.master
            ))),
            Ok(Ok(Ended::Lost(why) | Ended::MasterLeft(why))) => {
                Err(Fail::failed(format!("master at {}: {why}", args.master)))
            }
            Ok(Err(e)) => Err(Fail::failed(format!("master at {}: {e}", args.master))),
            Err(e) => Err(Fail::failed(format!("the worker failed: {e}"))),
        }
    });
    // Render threads end after the tile at hand; nobody waits for it.
    runtime::end(runtime);
    result
}

fn host_and_process() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname")
        .ok()
        .or_else(|| std::env::var("HOSTNAME").ok())
        .unwrap_or_default();
    let host: String = host.trim().chars().filter(|c| !c.is_control()).take(64).collect();
    let host = if host.is_empty() { "worker".into() } else { host };
    format!("{host}-{}", std::process::id())
}
