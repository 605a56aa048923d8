//! A TCP proxy that knows HTTP/2 as far as its frames: it flips bits of DATA frames, or swallows
//! those of one connection while the others live.

#![allow(dead_code, reason = "each test program uses a part of it")]

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

/// Bytes of a stream that are damaged.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Place {
    /// Bytes of gRPC messages.
    Messages,
    /// The five bytes before each gRPC message: whether it is compressed, and its length.
    Lengths,
}

/// Bit flips in the DATA frames of one direction of a proxy.
#[derive(Debug)]
pub(crate) struct Noise {
    /// One frame in so many has a bit flipped; 0: none.
    pub(crate) one_in: AtomicU64,
    /// Flips that are left; none is made after that.
    pub(crate) left: AtomicU64,
    /// Flips that were made.
    pub(crate) flips: AtomicU64,
    /// Which bytes.
    pub(crate) place: Place,
    seed: AtomicU64,
}

impl Noise {
    /// At most `flips` flips, each in one frame of `one_in`.
    pub(crate) fn new(seed: u64, one_in: u64, flips: u64, place: Place) -> Arc<Noise> {
        Arc::new(Noise {
            one_in: one_in.into(),
            left: flips.into(),
            flips: 0.into(),
            place,
            seed: (0x9e37_79b9_7f4a_7c15 ^ seed).into(),
        })
    }

    /// No flips at all.
    pub(crate) fn none() -> Arc<Noise> {
        Noise::new(0, 0, 0, Place::Messages)
    }

    fn random(&self) -> u64 {
        let next = |mut x: u64| {
            x ^= x << 13;
            x ^= x >> 7;
            Some(x ^ (x << 17))
        };
        self.seed.fetch_update(Relaxed, Relaxed, next).expect("it is always some")
    }

    fn spoil(&self, payload: &mut [u8], message: &mut Grpc) {
        let lengths = message.lengths(payload);
        let one_in = self.one_in.load(Relaxed);
        let places: Vec<usize> = match self.place {
            Place::Messages => (0..payload.len()).filter(|at| !lengths.contains(at)).collect(),
            Place::Lengths => lengths,
        };
        if one_in == 0 || places.is_empty() || !self.random().is_multiple_of(one_in) {
            return;
        }
        if self.left.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1)).is_err() {
            return;
        }
        let at = places[(self.random() % places.len() as u64) as usize];
        payload[at] ^= 1 << (self.random() % 8);
        self.flips.fetch_add(1, Relaxed);
    }
}

/// Position of a stream within its gRPC messages.
#[derive(Default)]
struct Grpc {
    head: Vec<u8>,
    left: usize,
}

impl Grpc {
    /// Takes in a piece of the stream. Returns the places in it of the bytes before messages.
    fn lengths(&mut self, payload: &[u8]) -> Vec<usize> {
        let (mut places, mut at) = (Vec::new(), 0);
        while at < payload.len() {
            if self.left > 0 {
                let n = self.left.min(payload.len() - at);
                self.left -= n;
                at += n;
                continue;
            }
            places.push(at);
            self.head.push(payload[at]);
            at += 1;
            if let [_, length @ ..] = &self.head[..]
                && let Ok(length) = <[u8; 4]>::try_from(length)
            {
                self.left = u32::from_be_bytes(length) as usize;
                self.head.clear();
            }
        }
        places
    }
}

/// See the head of the file.
pub(crate) struct Proxy {
    pub(crate) address: String,
    /// Connections so far.
    pub(crate) connections: Arc<AtomicUsize>,
}

/// Whether the DATA frames that the target sends on a connection are swallowed, by the number of
/// the connection from 0.
pub(crate) type Swallows = fn(usize) -> bool;

impl Proxy {
    /// Starts a proxy of `target` that treats what goes `up` to it and comes `down` from it.
    pub(crate) async fn start(
        target: String,
        (up, down): (Arc<Noise>, Arc<Noise>),
        swallows: Swallows,
    ) -> Proxy {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a port");
        let address = listener.local_addr().expect("it has one").to_string();
        let connections = Arc::new(AtomicUsize::new(0));
        let count = connections.clone();
        tokio::spawn(async move {
            while let Ok((near, _)) = listener.accept().await {
                let n = count.fetch_add(1, Relaxed);
                let (target, up, down) = (target.clone(), up.clone(), down.clone());
                tokio::spawn(async move {
                    let Ok(far) = TcpStream::connect(target).await else { return };
                    let _ = (near.set_nodelay(true), far.set_nodelay(true));
                    let (near_read, near_write) = near.into_split();
                    let (far_read, far_write) = far.into_split();
                    // When one direction ends, so does the other.
                    tokio::select! {
                        _ = pass(near_read, far_write, 24, &up, false) => {}
                        _ = pass(far_read, near_write, 0, &down, swallows(n)) => {}
                    }
                });
            }
        });
        Proxy { address, connections }
    }
}

/// Passes a preface of `preface` bytes, and then frame by frame.
async fn pass(
    mut from: tokio::net::tcp::OwnedReadHalf,
    mut to: tokio::net::tcp::OwnedWriteHalf,
    preface: usize,
    noise: &Noise,
    swallows: bool,
) -> std::io::Result<()> {
    const DATA: u8 = 0;
    let mut first = vec![0; preface];
    from.read_exact(&mut first).await?;
    to.write_all(&first).await?;
    let mut from = tokio::io::BufReader::with_capacity(1 << 17, from);
    let mut streams: BTreeMap<[u8; 4], Grpc> = BTreeMap::new();
    loop {
        let mut head = [0; 9];
        from.read_exact(&mut head).await?;
        let length = u32::from_be_bytes([0, head[0], head[1], head[2]]) as usize;
        let mut frame = head.to_vec();
        frame.resize(9 + length, 0);
        from.read_exact(&mut frame[9..]).await?;
        if head[3] == DATA {
            if swallows {
                continue;
            }
            let stream = [head[5], head[6], head[7], head[8]];
            noise.spoil(&mut frame[9..], streams.entry(stream).or_default());
        }
        to.write_all(&frame).await?;
    }
}
