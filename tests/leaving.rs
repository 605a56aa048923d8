//! Who is told to stop leaves, and is not lost, however much the master says meanwhile.

use slabcast_common::path::Orientation;
use slabcast_master::{Master, MasterConfig};
use slabcast_render::Simd;
use slabcast_worker::{Config, Ended};
use std::io::Write;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::sync::watch;

/// What the master says of its workers.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("no writer panics").extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Log {
    fn count(&self, what: &str) -> usize {
        String::from_utf8_lossy(&self.0.lock().expect("no writer panics")).matches(what).count()
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn workers_that_stop_under_pings_leave() {
    const ROUNDS: usize = 20;
    const WORKERS: usize = 8;
    let log = Log::default();
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
        while master.handle().workers().await.len() < WORKERS {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
        leave.send_replace(true);
        for worker in workers {
            assert_eq!(worker.await.unwrap(), Ok(Ended::Stopped));
        }
        while log.count("worker left") + log.count("worker lost") < (round + 1) * WORKERS {
            tokio::time::sleep(Duration::from_millis(2)).await;
        }
    }
    stop.send_replace(true);
    master.shutdown().await;
    assert_eq!((log.count("worker left"), log.count("worker lost")), (ROUNDS * WORKERS, 0));
}
