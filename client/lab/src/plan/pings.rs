//! Measures the processor time of a message on this machine: a real master and real workers with
//! TCP between them, in this process.
//!
//! The pings of one worker are alone: every thread on the way sleeps before each. The pings of many
//! workers go together, and the master's threads are awake for all but the first. The two times
//! tell the cost of waking from that of the message itself (see [`costs`](super::costs)). Waking
//! differs between machines by a factor of three and more: in a virtual machine, the host wakes a
//! processor.

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

/// Number of workers that ping together.
pub(super) const COMPANY: usize = 32;
/// Time from one ping of a worker to the next.
const PING_INTERVAL: Duration = Duration::from_micros(1000);
/// Duration of one measurement.
const MEASURE_TIME: Duration = Duration::from_millis(250);
/// Number of measurements, of which the cheapest counts.
const REPEATS: usize = 5;
/// Pause after all workers joined, for the end of their greetings.
const SETTLE: Duration = Duration::from_millis(100);
/// Longest time until all workers have joined.
const JOIN_TIMEOUT: Duration = Duration::from_secs(10);
/// Longest time until all workers have left.
const LEAVE_TIMEOUT: Duration = Duration::from_secs(2);

/// Names of the threads that are measured: the driver of the master, its streams, the workers.
const THREAD_NAMES: [&str; 3] = ["slabcast-master", "plan-m-io", "plan-w-io"];

/// Measures the pings of one worker and of [`COMPANY`], in some four seconds.
///
/// # Errors
/// There are no sockets, or the system does not tell the time of threads.
pub(super) fn measure() -> Result<Pings, String> {
    let least = |workers: usize| -> Result<[u64; 3], String> {
        let mut best = [u64::MAX / 4; 3];
        for _ in 0..REPEATS {
            let took = ping_ns(workers)?;
            if took.iter().sum::<u64>() < best.iter().sum() {
                best = took;
            }
        }
        Ok(best)
    };
    Ok(Pings { alone_ns: least(1)?, company_ns: least(COMPANY)? })
}

/// Returns the cheaper of two measurements: disturbances only ever lengthen the times.
pub(super) fn least(one: Pings, other: Pings) -> Pings {
    let less = |a: [u64; 3], b: [u64; 3]| {
        if a.iter().sum::<u64>() <= b.iter().sum() { a } else { b }
    };
    Pings {
        alone_ns: less(one.alone_ns, other.alone_ns),
        company_ns: less(one.company_ns, other.company_ns),
    }
}

/// Returns the ns of a ping and its pong for each of [`THREAD_NAMES`].
fn ping_ns(workers: usize) -> Result<[u64; 3], String> {
    // Threads as in `runtime.rs`: of a master on more than two processors, of a small worker.
    let (master_runtime, worker_runtime) =
        (runtime(THREAD_NAMES[1], 2)?, runtime(THREAD_NAMES[2], 1)?);
    let took = run_cluster(workers, &master_runtime, &worker_runtime);
    for runtime in [master_runtime, worker_runtime] {
        runtime.shutdown_timeout(Duration::from_millis(200));
    }
    took
}

/// Starts a master and workers and measures their threads.
fn run_cluster(
    workers: usize,
    master_runtime: &Runtime,
    worker_runtime: &Runtime,
) -> Result<[u64; 3], String> {
    let volume = slabcast_volumes::open("formula:spheres:16".as_ref()).map_err(to_text)?;
    let mut config = MasterConfig::new(volume, Orientation::new(None, None).map_err(to_text)?);
    config.schedule.heartbeat = PING_INTERVAL.as_micros() as u64;
    let (stop, stopped) = watch::channel(false);
    let (master, address) = master_runtime.block_on(async {
        let listener = TcpListener::bind("127.0.0.1:0").await.map_err(to_text)?;
        let address = listener.local_addr().map_err(to_text)?.to_string();
        let master = Master::start(config).map_err(to_text)?;
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
            worker_runtime.handle(),
        );
    }
    let all_joined = master_runtime.block_on(async {
        let began = Instant::now();
        while master.handle().workers().await.len() < workers {
            if began.elapsed() > JOIN_TIMEOUT {
                return false;
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        tokio::time::sleep(SETTLE).await;
        true
    });
    let took =
        if all_joined { measure_threads(workers) } else { Err("the workers did not join".into()) };
    // Workers stop first: one that loses its master would log that and dial again.
    leave.send_replace(true);
    master_runtime.block_on(async {
        let all = async { while running.join_next().await.is_some() {} };
        let _ = tokio::time::timeout(LEAVE_TIMEOUT, all).await;
        stop.send_replace(true);
        master.shutdown().await;
    });
    took
}

/// Returns the ns of a ping and its pong for each of [`THREAD_NAMES`], of a running cluster.
fn measure_threads(workers: usize) -> Result<[u64; 3], String> {
    let (before, began) = (threads_cpu_ns()?, Instant::now());
    std::thread::sleep(MEASURE_TIME);
    let (after, looked) = (threads_cpu_ns()?, began.elapsed());
    let pings = looked.as_secs_f64() / PING_INTERVAL.as_secs_f64() * workers as f64;
    Ok(std::array::from_fn(|i| (after[i].saturating_sub(before[i]) as f64 / pings) as u64))
}

fn runtime(name: &str, threads: usize) -> Result<Runtime, String> {
    let mut builder = Builder::new_multi_thread();
    builder.worker_threads(threads).thread_name(name).enable_all().build().map_err(to_text)
}

/// Returns the processor time of the threads of each name so far, in ns.
fn threads_cpu_ns() -> Result<[u64; 3], String> {
    let mut ns = [0; 3];
    for task in std::fs::read_dir("/proc/self/task").map_err(to_text)?.flatten() {
        let read = |file: &str| std::fs::read_to_string(task.path().join(file)).ok();
        // A thread that ended meanwhile has neither file.
        let (Some(name), Some(stat)) = (read("comm"), read("schedstat")) else { continue };
        if let Some(i) = THREAD_NAMES.iter().position(|n| name.trim_end() == *n) {
            let took = stat.split(' ').next().and_then(|n| n.parse::<u64>().ok());
            ns[i] += took.ok_or("/proc/self/task/*/schedstat has no times")?;
        }
    }
    if ns[0] == 0 {
        return Err("the system does not tell the time of threads".into());
    }
    Ok(ns)
}

fn to_text(e: impl Display) -> String {
    e.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg_attr(not(target_os = "linux"), ignore = "reads the times of threads from Linux")]
    fn ping_times_are_between_100_ns_and_a_millisecond() {
        let (one, many) = (ping_ns(1).unwrap(), ping_ns(8).unwrap());
        assert!(
            one.iter().chain(&many).all(|ns| (100..1_000_000).contains(ns)),
            "{one:?} {many:?}"
        );
    }

    #[test]
    fn least_takes_the_cheaper_measurement() {
        let pings = |a, c| Pings { alone_ns: [a, 20, 20], company_ns: [c, 5, 5] };
        assert_eq!(least(pings(14, 2), pings(20, 1)), pings(14, 1));
        assert_eq!(least(pings(20, 1), pings(14, 2)), pings(14, 1));
    }

    /// `cargo test --release -p slabcast-lab what_a_message -- --ignored --nocapture`,
    /// on a machine with nothing else to do.
    #[test]
    #[ignore = "measures: wants the machine for itself"]
    fn what_a_message_costs() {
        println!("us of processor time for a ping and its pong\nworkers  driver  streams  worker");
        for workers in [1, 2, 4, 8, 16, COMPANY] {
            let best = (0..REPEATS).map(|_| ping_ns(workers).unwrap());
            let [driver, streams, worker] =
                best.min_by_key(|ns| ns.iter().sum::<u64>()).unwrap().map(|ns| ns as f64 / 1e3);
            println!("{workers:>7} {driver:>7.1} {streams:>8.1} {worker:>7.1}");
        }
    }
}
