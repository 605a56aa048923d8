//! A TCP proxy whose connections can be cut, and that can stay closed for a while.

use std::io;
use std::net::{Shutdown, TcpListener, TcpStream};
use std::sync::{Arc, Mutex};

/// Passes bytes on to an address until it is cut.
pub(crate) struct CutProxy {
    /// Its own address.
    pub(crate) address: String,
    streams: Arc<Mutex<(bool, Vec<TcpStream>)>>,
}

impl CutProxy {
    /// A proxy of an address on a free port.
    pub(crate) fn new(to: &str) -> CutProxy {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = listener.local_addr().expect("an address").to_string();
        let streams = Arc::new(Mutex::new((true, Vec::new())));
        let (to, kept) = (to.to_string(), streams.clone());
        std::thread::spawn(move || {
            for client in listener.incoming().map_while(Result::ok) {
                let mut kept = kept.lock().expect("no thread panics");
                let Ok(server) = TcpStream::connect(&to) else { continue };
                if !kept.0 {
                    continue;
                }
                for (from, to) in [(&client, &server), (&server, &client)] {
                    let (mut from, mut to) = (twin(from), twin(to));
                    kept.1.push(twin(&from));
                    std::thread::spawn(move || {
                        let _ = io::copy(&mut from, &mut to);
                        let _ = to.shutdown(Shutdown::Both);
                    });
                }
            }
        });
        CutProxy { address, streams }
    }

    /// Cuts what is open. While it is closed, new connections end at once.
    pub(crate) fn cut(&self) {
        let mut streams = self.streams.lock().expect("no thread panics");
        streams.0 = false;
        for stream in streams.1.drain(..) {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Takes connections again.
    pub(crate) fn join(&self) {
        self.streams.lock().expect("no thread panics").0 = true;
    }
}

fn twin(stream: &TcpStream) -> TcpStream {
    stream.try_clone().expect("a handle")
}
