//! What a message costs on this machine: the real master, real workers, and TCP between them, in this process.
//!
//! Pings go as often as is asked for, and pongs come. One worker's all come alone: everybody on the way
//! slept. Those of many go and come together, and the master's threads are awake for all but the
//! first. So the two say what waking costs, and what the message itself does
//! ([`costs`](super::costs) has how). Waking differs between machines by a factor of three and more: in a virtual one it is
//! the host that wakes a processor.

use slabcast_master::{Master, MasterConfig};
use slabcast_render::Simd;
use slabcast_scene::path::Orientation;
use slabcast_trace::Pings;
use slabcast_worker::Config;
use std::fmt::Display;
use std::time::{Duration, Instant};
use tokio::net::TcpListener;
use tokio::runtime::{Builder, Runtime};
use tokio::sync::watch;
use tokio::task::JoinSet;

/// So many workers keep each other company.
pub(super) const COMPANY: usize = 32;
/// From one ping of a worker to the next.
const EVERY: Duration = Duration::from_micros(1000);
/// How long they are looked at, and how often; the time that costs least counts.
const LOOK: Duration = Duration::from_millis(250);
const TIMES: usize = 5;
/// What is left of greetings when all are there.
const SETTLE: Duration = Duration::from_millis(100);
/// How long they may take to come.
const COME: Duration = Duration::from_secs(10);
/// How long they may take to go.
const LEAVE: Duration = Duration::from_secs(2);

/// Threads: the master's driver by the name it gives itself, its streams, the workers'.
const NAMES: [&str; 3] = ["slabcast-master", "plan-m-io", "plan-w-io"];

/// Measures it, in some four seconds.
///
/// # Errors
/// What does not let itself be measured here: no sockets, or a system that does not say what threads take.
pub(super) fn measure() -> Result<Pings, String> {
    let least = |workers: usize| -> Result<[u64; 3], String> {
        let mut best = [u64::MAX / 4; 3];
        for _ in 0..TIMES {
            let took = look(workers)?;
            if took.iter().sum::<u64>() < best.iter().sum() {
                best = took;
            }
        }
        Ok(best)
    };
    Ok(Pings { alone_ns: least(1)?, company_ns: least(COMPANY)? })
}

/// What was measured twice: the times that cost less. What disturbs a machine for some seconds only makes them longer.
pub(super) fn least(one: Pings, other: Pings) -> Pings {
    let less = |a: [u64; 3], b: [u64; 3]| {
        if a.iter().sum::<u64>() <= b.iter().sum() { a } else { b }
    };
    Pings {
        alone_ns: less(one.alone_ns, other.alone_ns),
        company_ns: less(one.company_ns, other.company_ns),
    }
}

/// Nanoseconds for a ping and its pong, of each of [`NAMES`].
fn look(workers: usize) -> Result<[u64; 3], String> {
    // As they have them (`runtime.rs`): a master where it has more than two processors, a worker of a few threads.
    let (here, there) = (runtime(NAMES[1], 2)?, runtime(NAMES[2], 1)?);
    let took = pinged(workers, &here, &there);
    for runtime in [here, there] {
        runtime.shutdown_timeout(Duration::from_millis(200));
    }
    took
}

fn pinged(workers: usize, here: &Runtime, there: &Runtime) -> Result<[u64; 3], String> {
    let volume = slabcast_volumes::open("formula:spheres:16".as_ref()).map_err(why)?;
    let mut config = MasterConfig::new(volume, Orientation::new(None, None).map_err(why)?);
    config.schedule.heartbeat = EVERY.as_micros() as u64;
    let (stop, stopped) = watch::channel(false);
    let (master, address) = here.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await.map_err(why)?;
        let address = listener.local_addr().map_err(why)?.to_string();
        let master = Master::start(config).map_err(why)?;
        tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped.clone()));
        Ok::<_, String>((master, address))
    })?;
    let (leave, left) = watch::channel(false);
    let mut running = JoinSet::new();
    for i in 0..workers {
        let config = Config {
            name: format!("ping{i}"),
            threads: 1,
            memory_budget_bytes: 1 << 20,
            simd: Simd::detect(),
            rehearsal: None,
            machine: String::new(),
        };
        running.spawn_on(
            slabcast_worker::dial::run(config, address.clone(), left.clone()),
            there.handle(),
        );
    }
    let all_there = here.block_on(async {
        let began = Instant::now();
        while master.handle().workers().await.len() < workers {
            if began.elapsed() > COME {
                return false;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        tokio::time::sleep(SETTLE).await;
        true
    });
    let took = if all_there { watched(workers) } else { Err("workers do not come".into()) };
    // Workers first: one whose master goes dials again, and says so.
    leave.send_replace(true);
    here.block_on(async {
        let all = async { while running.join_next().await.is_some() {} };
        let _ = tokio::time::timeout(LEAVE, all).await;
        stop.send_replace(true);
        master.shutdown().await;
    });
    took
}

/// What the threads take while it looks.
fn watched(workers: usize) -> Result<[u64; 3], String> {
    let (before, began) = (cpu()?, Instant::now());
    std::thread::sleep(LOOK);
    let (after, looked) = (cpu()?, began.elapsed());
    let pings = looked.as_secs_f64() / EVERY.as_secs_f64() * workers as f64;
    Ok(std::array::from_fn(|i| (after[i].saturating_sub(before[i]) as f64 / pings) as u64))
}

fn runtime(name: &str, threads: usize) -> Result<Runtime, String> {
    let mut builder = Builder::new_multi_thread();
    builder.worker_threads(threads).thread_name(name).enable_all().build().map_err(why)
}

/// Processor time so far of this process's threads, in ns.
fn cpu() -> Result<[u64; 3], String> {
    let mut ns = [0; 3];
    for task in std::fs::read_dir("/proc/self/task").map_err(why)?.flatten() {
        let read = |file: &str| std::fs::read_to_string(task.path().join(file)).ok();
        // One that ended meanwhile has neither.
        let (Some(name), Some(stat)) = (read("comm"), read("schedstat")) else { continue };
        if let Some(i) = NAMES.iter().position(|n| name.trim_end() == *n) {
            let took = stat.split(' ').next().and_then(|n| n.parse::<u64>().ok());
            ns[i] += took.ok_or("/proc/self/task/*/schedstat has no times")?;
        }
    }
    if ns[0] == 0 {
        return Err("the system does not say what threads take".into());
    }
    Ok(ns)
}

fn why(e: impl Display) -> String {
    e.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg_attr(not(target_os = "linux"), ignore = "asks Linux what threads take")]
    fn company_is_cheaper_than_being_alone() {
        let (one, many) = (look(1).unwrap(), look(8).unwrap());
        // Each end does something for each; a millisecond is beyond any ping.
        assert!(
            one.iter().chain(&many).all(|ns| (100..1_000_000).contains(ns)),
            "{one:?} {many:?}"
        );
    }

    #[test]
    fn the_cheaper_of_two_counts() {
        let of = |a, c| Pings { alone_ns: [a, 20, 20], company_ns: [c, 5, 5] };
        assert_eq!(least(of(14, 2), of(20, 1)), of(14, 1));
        assert_eq!(least(of(20, 1), of(14, 2)), of(14, 1));
    }

    /// `cargo test --release -p slabcast --bin slabcast what_a_message -- --ignored --nocapture`, on a machine with
    /// nothing else to do.
    #[test]
    #[ignore = "measures: wants the machine for itself"]
    fn what_a_message_costs() {
        println!("us of processor time for a ping and its pong\nworkers  driver  streams  worker");
        for workers in [1, 2, 4, 8, 16, COMPANY] {
            let best = (0..TIMES).map(|_| look(workers).unwrap());
            let [driver, streams, worker] =
                best.min_by_key(|ns| ns.iter().sum::<u64>()).unwrap().map(|ns| ns as f64 / 1e3);
            println!("{workers:>7} {driver:>7.1} {streams:>8.1} {worker:>7.1}");
        }
    }
}
