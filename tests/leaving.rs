//! Workers that are told to stop leave in order and are not taken for lost, whatever the master
//! says meanwhile.

use slabcast_master::{Master, MasterConfig};
use slabcast_render::Simd;
use slabcast_scene::path::Orientation;
use slabcast_worker::{Config, Ended};
use std::io::Write;
use std::time::Duration;
use tokio::sync::watch;

/// The master's log, which wakes whoever waits for a line.
#[derive(Clone)]
struct Log(watch::Sender<Vec<u8>>);

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.send_modify(|all| all.extend_from_slice(bytes));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

fn count(log: &[u8], what: &str) -> usize {
    String::from_utf8_lossy(log).matches(what).count()
}

impl Log {
    /// Waits until so many lines have one of these words.
    async fn until(&self, words: &[&str], lines: usize) {
        let mut log = self.0.subscribe();
        let there = log.wait_for(|log| words.iter().map(|w| count(log, w)).sum::<usize>() >= lines);
        let in_time = tokio::time::timeout(Duration::from_secs(60), there).await;
        assert!(in_time.is_ok(), "{lines} lines with one of {words:?} in time");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn stopping_workers_leave_in_order_while_the_master_pings() {
    const ROUNDS: usize = 20;
    const WORKERS: usize = 8;
    let log = Log(watch::channel(Vec::new()).0);
    let to = log.clone();
    // The driver has a thread of its own.
    tracing_subscriber::fmt().with_ansi(false).with_writer(move || to.clone()).init();
    let volume = slabcast_volumes::open("formula:spheres:16".as_ref()).unwrap();
    let mut config = MasterConfig::new(volume, Orientation::new(None, None).unwrap());
    config.schedule.heartbeat = 200;
    let master = Master::start(config).unwrap();
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let (stop, stopped) = watch::channel(false);
    tokio::spawn(slabcast_master::serve::serve(master.handle(), listener, stopped));
    for round in 0..ROUNDS {
        let (leave, left) = watch::channel(false);
        let workers = (0..WORKERS).map(|i| {
            let config = Config {
                name: format!("w{i}"),
                threads: 1,
                memory_budget_bytes: 1 << 20,
                simd: Simd::detect(),
                rehearsal: None,
                machine: String::new(),
            };
            tokio::spawn(slabcast_worker::dial::run(config, address.clone(), left.clone()))
        });
        let workers: Vec<_> = workers.collect();
        log.until(&["worker joined"], (round + 1) * WORKERS).await;
        leave.send_replace(true);
        for worker in workers {
            assert_eq!(worker.await.unwrap(), Ok(Ended::Stopped));
        }
        log.until(&["worker left", "worker lost"], (round + 1) * WORKERS).await;
    }
    stop.send_replace(true);
    master.shutdown().await;
    let log = log.0.borrow();
    assert_eq!((count(&log, "worker left"), count(&log, "worker lost")), (ROUNDS * WORKERS, 0));
}
