//! Dialling servers that are no master for this worker.

use slabcast_render::Simd;
use slabcast_worker::{Config, Ended, dial};
use tokio::net::TcpListener;
use tokio::sync::watch;
use tokio_stream::wrappers::TcpListenerStream;
use tonic::service::Routes;
use tonic::transport::Server;

/// A gRPC server without our service, as a master of an older version is: the worker says which
/// protocol it wants, and does not dial again.
#[tokio::test]
async fn worker_gives_up_a_server_that_does_not_speak_its_protocol() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = listener.local_addr().unwrap().to_string();
    let server = Server::builder().add_routes(Routes::default());
    tokio::spawn(server.serve_with_incoming(TcpListenerStream::new(listener)));
    let config = Config {
        name: "early".into(),
        threads: 1,
        memory_budget_bytes: 1 << 20,
        simd: Simd::detect(),
        rehearsal: None,
        machine: String::new(),
    };
    let (_stop, stopped) = watch::channel(false);
    let ended = dial::run(config, address, stopped).await.unwrap();
    let Ended::Refused(reason) = ended else { panic!("{ended:?}") };
    assert!(reason.contains("slabcast.cluster.v1"), "{reason}");
}
