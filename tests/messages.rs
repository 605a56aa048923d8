//! What a message costs here, with the real master, the real worker and TCP between them:
//! `cargo test --release -p slabcast --test messages -- --ignored --nocapture`, on a machine with
//! nothing else to do. `client/cli/src/plan/costs.rs` has its figures.
//!
//! Pings go as often as is asked for, and pongs come. One worker's all come alone: everybody on the way
//! slept. Those of many go and come together, and the master's threads are awake for all but the
//! first. So the two say what waking costs, and what the message itself does.

use slabcast_common::path::Orientation;
use slabcast_master::{Master, MasterConfig};
use slabcast_render::splat::Simd;
use slabcast_worker::Config;
use std::collections::BTreeMap;
use std::time::Duration;
use tokio::sync::watch;

const EVERY: Duration = Duration::from_micros(1000);
const LOOK: Duration = Duration::from_millis(1500);

fn runtime(name: &str) -> tokio::runtime::Runtime {
    // As `client/cli/src/runtime.rs` has them.
    let mut builder = tokio::runtime::Builder::new_multi_thread();
    builder.worker_threads(2).thread_name(name).enable_all().build().expect("a runtime")
}

/// Processor time so far of this process's threads, by the beginnings of their names.
fn cpu(names: &[&'static str]) -> BTreeMap<&'static str, f64> {
    let mut us: BTreeMap<_, f64> = names.iter().map(|n| (*n, 0.0)).collect();
    for task in std::fs::read_dir("/proc/self/task").expect("Linux").flatten() {
        let read = |file: &str| std::fs::read_to_string(task.path().join(file)).ok();
        let (Some(name), Some(stat)) = (read("comm"), read("schedstat")) else { continue };
        let ns: f64 = stat.split(' ').next().and_then(|n| n.parse().ok()).unwrap_or(0.0);
        if let Some((_, sum)) = us.iter_mut().find(|(n, _)| name.starts_with(**n)) {
            *sum += ns / 1e3;
        }
    }
    us
}

/// Microseconds for a ping and its pong: of the driver, the master's streams, and a worker.
fn measure(workers: usize) -> [f64; 3] {
    const NAMES: [&str; 3] = ["slabcast-master", "m-io", "w-io"];
    let (here, there) = (runtime("m-io"), runtime("w-io"));
    let volume = slabcast_volumes::open("formula:spheres:16".as_ref()).expect("a volume");
    let mut config = MasterConfig::new(volume, Orientation::new(None, None).expect("the defaults"));
    config.schedule.heartbeat = EVERY.as_micros() as u64;
    let (stop, stopped) = watch::channel(false);
    let (master, address) = here.block_on(async {
        let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("bound").to_string();
        let master = Master::start(config).expect("a thread");
        tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped.clone()));
        (master, address)
    });
    for i in 0..workers {
        let config = Config {
            name: format!("w{i}"),
            threads: 1,
            memory_budget_bytes: 1 << 20,
            simd: Simd::detect(),
            rehearsal: None,
            machine: String::new(),
        };
        there.spawn(slabcast_worker::dial::run(config, address.clone(), stopped.clone()));
    }
    here.block_on(async {
        while master.handle().workers().await.len() < workers {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        tokio::time::sleep(Duration::from_millis(300)).await;
    });
    let before = cpu(&NAMES);
    std::thread::sleep(LOOK);
    let after = cpu(&NAMES);
    let pings = LOOK.as_secs_f64() / EVERY.as_secs_f64() * workers as f64;
    stop.send_replace(true);
    here.block_on(master.shutdown());
    here.shutdown_timeout(Duration::from_millis(200));
    there.shutdown_timeout(Duration::from_millis(200));
    NAMES.map(|n| (after[n] - before[n]) / pings)
}

#[test]
#[ignore = "measures: wants the machine for itself"]
fn what_a_message_costs() {
    println!("us of processor time for a ping and its pong\nworkers  driver  streams  worker");
    for workers in [1, 2, 4, 8, 16, 32] {
        let best = (0..3).map(|_| measure(workers));
        let best = best.min_by(|a, b| a.iter().sum::<f64>().total_cmp(&b.iter().sum::<f64>()));
        let [driver, streams, worker] = best.unwrap_or_default();
        println!("{workers:>7} {driver:>7.1} {streams:>8.1} {worker:>7.1}");
    }
}
