//! Streams whose messages are numbered, checked and, when damaged on their way, sent again.
//!
//! TCP's own checksum has 16 bits, and each box on the way may compute it anew over what it has
//! damaged. So each message of a worker's streams travels sealed ([`Sealed`]): with its number, a
//! CRC-32C over all of it, and the number of the last message that the sender received. The seal
//! is checked before the payload is decoded, and no kind of message goes without.
//!
//! A receiver that finds a message damaged, or a number missing, drops what follows, and asks
//! (`asked` rises by one) for everything after the last message that came whole. The sender keeps
//! what is not acknowledged and sends it again, in order. So a flipped bit costs a round trip, and
//! nothing above this module learns of it: a result is neither drawn again nor waits for the end of
//! its lease. Obvious alternatives cost more. Ending the link at each damaged message costs 0.1 s,
//! all leases and the directories, and a line with one error a second would never draw a frame.
//! Asking for single messages would need a queue that puts them back in order.
//!
//! A message that can't be decoded at all is damaged like one whose checksum is false
//! ([`LenientCodec`]). A damaged length of gRPC or head of HTTP/2 ends the stream with an error, or
//! stalls it until somebody misses what was to come; then the link is made anew.
//!
//! **Bounds.** A sender keeps at most [`WINDOW_BYTES`] and one message, and stops until the peer
//! acknowledges: a peer that reads nothing is sent nothing more. A message that was asked for
//! [`MOST_TRIES`] times ends the stream. A request makes the sender begin again, it queues nothing.
//!
//! This module reads no clock: its user calls [`Incoming::ask_again`] after [`Incoming::patience`].

use crate::cluster_v1::{
    BricksRequest, BricksResponse, ControlRequest, ControlResponse, Sealed, bricks_request,
    bricks_response, control_request, control_response,
};
use bytes::{Buf, Bytes};
use prost::Message;
use std::collections::VecDeque;
use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Waker};
use std::time::Duration;
use tokio_stream::Stream;
use tonic::Status;
use tonic::codec::{Codec, DecodeBuf, Decoder};
use tonic_prost::ProstEncoder;

/// Bytes that may be on their way without an acknowledgement: twice what HTTP/2 lets a Bricks
/// stream have on its way. With half of it, links of 10 Gb/s and 1 ms would wait.
pub const WINDOW_BYTES: usize = 2 << 20;

/// Messages that may be on their way without an acknowledgement. Most are some 60 bytes long.
const WINDOW_MESSAGES: usize = 8192;

/// A receiver acknowledges at once after so many messages or bytes, and otherwise with whatever it
/// sends next.
const ACKNOWLEDGE_MESSAGES: u32 = 16;
const ACKNOWLEDGE_BYTES: usize = WINDOW_BYTES / 8;

/// Number of requests for a message after which the stream counts as hopeless. On a line that
/// damages a fifth of all messages, 40 in a row are damaged once in 10^28 messages.
pub const MOST_TRIES: u32 = 40;

/// Time without a message after which one that was asked for is asked for again. On a loopback an
/// answer takes 0.1 ms; on a full line of 10 Mb/s a megabyte stands before it, 0.8 s.
const FIRST_PATIENCE: Duration = Duration::from_millis(100);

/// Why a sealed stream can't go on; the link must be made anew.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StreamError {
    /// A message did not come whole in [`MOST_TRIES`] tries.
    #[error("message {number} arrived damaged {MOST_TRIES} times")]
    Hopeless {
        /// Number of the message.
        number: u64,
    },
    /// The peer asks for the same message for ever.
    #[error("the peer asked for message {number} {MOST_TRIES} times")]
    AskedTooOften {
        /// Number of the message.
        number: u64,
    },
    /// The peer acknowledges messages that were never sent.
    #[error("the peer acknowledges message {number}, which was never sent")]
    NeverSent {
        /// Number of the message.
        number: u64,
    },
    /// A whole message can't be decoded: the peer wrote it so.
    #[error("message {number} is whole and can't be decoded: {problem}")]
    Undecodable {
        /// Number of the message.
        number: u64,
        /// Problem, for people.
        problem: String,
    },
}

impl StreamError {
    /// Returns whether the line is at fault, and not the peer.
    pub fn is_damage(&self) -> bool {
        matches!(self, StreamError::Hopeless { .. })
    }
}

/// A message of a stream that can carry another of its kind, sealed.
pub trait Seals: Message + Default {
    /// Wraps a sealed message.
    fn of(sealed: Sealed) -> Self;
    /// Returns the sealed message; `None` for any other.
    fn sealed(self) -> Option<Sealed>;
}

macro_rules! seals {
    ($message:ty, $kind:path) => {
        impl Seals for $message {
            fn of(sealed: Sealed) -> Self {
                Self { message: Some($kind(sealed)) }
            }
            fn sealed(self) -> Option<Sealed> {
                match self.message {
                    Some($kind(sealed)) => Some(sealed),
                    _ => None,
                }
            }
        }
    };
}
seals!(ControlRequest, control_request::Message::Sealed);
seals!(ControlResponse, control_response::Message::Sealed);
seals!(BricksRequest, bricks_request::Message::Sealed);
seals!(BricksResponse, bricks_response::Message::Sealed);

/// Returns the CRC-32C of a sealed message: of its payload, and then of its four numbers as 8, 8, 4
/// and 4 bytes, little endian. `payload_crc32c`: that of the payload alone.
fn checksum(sealed: &Sealed, payload_crc32c: u32) -> u32 {
    let mut head = [0; 24];
    head[..8].copy_from_slice(&sealed.number.to_le_bytes());
    head[8..16].copy_from_slice(&sealed.received.to_le_bytes());
    head[16..20].copy_from_slice(&sealed.asked.to_le_bytes());
    head[20..].copy_from_slice(&sealed.answered.to_le_bytes());
    crc32c::crc32c_append(payload_crc32c, &head)
}

/// A message that the peer has not acknowledged.
struct Kept {
    payload: Bytes,
    crc32c: u32,
}

#[derive(Default)]
struct State {
    /// Messages that are not acknowledged; the first has the number `acknowledged + 1`.
    kept: VecDeque<Kept>,
    kept_bytes: usize,
    /// Number of messages in `kept` that were sent since the last request.
    sent: usize,
    /// Number of messages in `kept` that were ever sent.
    ever_sent: usize,
    acknowledged: u64,
    /// Requests of the peer that were answered, and how many of them in a row.
    answered: u32,
    asked_in_a_row: u32,
    /// Number of the last message that came whole and in order.
    received: u64,
    /// Requests to the peer, and how many of them in a row.
    asked: u32,
    tries: u32,
    is_waiting: bool,
    /// Messages and bytes since the last acknowledgement.
    unacknowledged: (u32, usize),
    /// Messages that arrived damaged, at either end.
    damaged: u64,
    waker: Option<Waker>,
}

impl State {
    fn has_room(&self) -> bool {
        self.kept_bytes < WINDOW_BYTES && self.kept.len() < WINDOW_MESSAGES
    }

    fn push(&mut self, payload: Bytes) {
        self.kept_bytes += payload.len();
        let crc32c = crc32c::crc32c(&payload);
        self.kept.push_back(Kept { payload, crc32c });
    }

    /// Makes sure that a message leaves, which carries the four numbers.
    fn say_something(&mut self) {
        if self.sent == self.kept.len() {
            self.push(Bytes::new());
        }
        self.wake();
    }

    fn wake(&mut self) {
        if let Some(waker) = self.waker.take() {
            waker.wake();
        }
    }

    fn next_sealed(&mut self) -> Option<Sealed> {
        let kept = self.kept.get(self.sent)?;
        self.sent += 1;
        self.ever_sent = self.ever_sent.max(self.sent);
        self.unacknowledged = (0, 0);
        let mut sealed = Sealed {
            number: self.acknowledged + self.sent as u64,
            received: self.received,
            asked: self.asked,
            answered: self.answered,
            crc32c: 0,
            payload: kept.payload.clone(),
        };
        sealed.crc32c = checksum(&sealed, kept.crc32c);
        Some(sealed)
    }

    fn ask(&mut self) -> Result<(), StreamError> {
        self.tries += 1;
        if self.tries > MOST_TRIES {
            return Err(StreamError::Hopeless { number: self.received + 1 });
        }
        self.is_waiting = true;
        self.asked = self.asked.wrapping_add(1);
        self.say_something();
        Ok(())
    }

    fn open(&mut self, sealed: Option<Sealed>) -> Result<Option<Bytes>, StreamError> {
        let whole = |s: &Sealed| s.crc32c == checksum(s, crc32c::crc32c(&s.payload));
        let Some(sealed) = sealed.filter(whole) else {
            self.damaged += 1;
            // A damaged message may have been sent before the request or after it.
            return if self.is_waiting { Ok(None) } else { self.ask().map(|()| None) };
        };
        self.hear(&sealed)?;
        if sealed.number <= self.received {
            return Ok(None);
        }
        if sealed.number > self.received + 1 {
            // A message is missing that was swallowed by another's damaged length, or damaged
            // again after it was asked for.
            if !self.is_waiting || sealed.answered == self.asked {
                self.ask()?;
            }
            return Ok(None);
        }
        self.received += 1;
        self.is_waiting = false;
        self.tries = 0;
        if sealed.payload.is_empty() {
            return Ok(None);
        }
        let (messages, bytes) = &mut self.unacknowledged;
        *messages += 1;
        *bytes += sealed.payload.len();
        if *messages >= ACKNOWLEDGE_MESSAGES || *bytes >= ACKNOWLEDGE_BYTES {
            self.say_something();
        }
        Ok(Some(sealed.payload))
    }

    /// Takes in what the peer acknowledges and asks for.
    fn hear(&mut self, sealed: &Sealed) -> Result<(), StreamError> {
        if sealed.received > self.acknowledged {
            let n = sealed.received - self.acknowledged;
            if n > self.ever_sent as u64 {
                return Err(StreamError::NeverSent { number: sealed.received });
            }
            let n = n as usize;
            self.kept_bytes -= self.kept.drain(..n).map(|k| k.payload.len()).sum::<usize>();
            self.acknowledged = sealed.received;
            self.sent = self.sent.saturating_sub(n);
            self.ever_sent -= n;
            self.asked_in_a_row = 0;
            self.wake();
        }
        // Requests are counted, so that a later message tells of one that was lost. Messages arrive
        // in the order in which they were sealed, so that any other count than the last is newer.
        if sealed.asked != self.answered {
            self.answered = sealed.asked;
            self.asked_in_a_row += 1;
            if self.asked_in_a_row > MOST_TRIES {
                return Err(StreamError::AskedTooOften { number: self.acknowledged + 1 });
            }
            self.damaged += 1;
            self.sent = 0;
            self.wake();
        }
        Ok(())
    }
}

type Shared = Arc<Mutex<State>>;

fn locked(shared: &Shared) -> MutexGuard<'_, State> {
    shared.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Makes the two halves of one end of a sealed stream: `source`'s messages leave by the first, and
/// what arrives goes through the second.
///
/// ```
/// use slabcast_proto::cluster_v1::{BricksRequest, BricksResponse};
/// use slabcast_proto::{convert, sealed};
/// use tokio_stream::StreamExt;
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), sealed::StreamError> {
/// let open: BricksRequest = convert::bricks_open_to_wire(7);
/// let (mut out, _) = sealed::ends::<_, BricksResponse>(tokio_stream::once(open.clone()));
/// let (_, inbound) = sealed::ends::<_, BricksRequest>(tokio_stream::empty::<BricksResponse>());
/// let sent: BricksRequest = out.next().await.expect("it is sent");
/// assert_eq!(inbound.open(sent)?, Some(open));
/// # Ok(())
/// # }
/// ```
pub fn ends<S: Stream<Item: Seals> + Unpin, In: Seals>(source: S) -> (Outgoing<S>, Incoming<In>) {
    let state = Shared::default();
    let outgoing = Outgoing { state: state.clone(), source, is_over: false };
    (outgoing, Incoming { state, of: PhantomData })
}

/// The messages of a source, each sealed, with those in between that are asked for again. Ends with
/// its source.
pub struct Outgoing<S> {
    state: Shared,
    source: S,
    is_over: bool,
}

impl<S: Stream<Item: Seals> + Unpin> Stream for Outgoing<S> {
    type Item = S::Item;

    fn poll_next(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<Option<S::Item>> {
        loop {
            let mut state = locked(&self.state);
            if let Some(sealed) = state.next_sealed() {
                return Poll::Ready(Some(S::Item::of(sealed)));
            }
            if self.is_over {
                return Poll::Ready(None);
            }
            state.waker = Some(cx.waker().clone());
            if !state.has_room() {
                return Poll::Pending;
            }
            // The source may take long, or wake whoever holds the other half.
            drop(state);
            match Pin::new(&mut self.source).poll_next(cx) {
                Poll::Pending => return Poll::Pending,
                Poll::Ready(Some(message)) => {
                    locked(&self.state).push(message.encode_to_vec().into());
                }
                Poll::Ready(None) => self.is_over = true,
            }
        }
    }
}

/// Opens the sealed messages that arrive at one end of a stream.
pub struct Incoming<M> {
    state: Shared,
    of: PhantomData<fn() -> M>,
}

impl<M: Seals> Incoming<M> {
    /// Opens a message. Returns `None` if it is not the next one (damaged, sent again, or an
    /// acknowledgement alone).
    ///
    /// # Errors
    /// [`StreamError`] says why the stream must end.
    pub fn open(&self, message: M) -> Result<Option<M>, StreamError> {
        let mut state = locked(&self.state);
        let Some(payload) = state.open(message.sealed())? else { return Ok(None) };
        let number = state.received;
        drop(state);
        let decoded = M::decode(payload);
        decoded.map(Some).map_err(|e| StreamError::Undecodable { number, problem: e.to_string() })
    }

    /// Returns whether a message was asked for again and has not come.
    pub fn is_waiting(&self) -> bool {
        locked(&self.state).is_waiting
    }

    /// Returns how long to wait without any message before [`Incoming::ask_again`] is called, while
    /// [`Incoming::is_waiting`]: 0.1 s, and twice as long after each request, up to 3.2 s.
    pub fn patience(&self) -> Duration {
        FIRST_PATIENCE * (1 << locked(&self.state).tries.saturating_sub(1).min(5))
    }

    /// Asks once more for a message that has not come: the request, or all that would have shown
    /// that it was needed again, may have been damaged as well.
    ///
    /// # Errors
    /// [`StreamError::Hopeless`] after [`MOST_TRIES`] requests for the same message.
    pub fn ask_again(&self) -> Result<(), StreamError> {
        locked(&self.state).ask()
    }

    /// Returns how many messages arrived damaged so far, at either end of the stream.
    pub fn damaged(&self) -> u64 {
        locked(&self.state).damaged
    }
}

/// The codec of a worker's streams. What can't be decoded is an empty message, which
/// [`Incoming::open`] takes for a damaged one; tonic's own codec would end the stream.
pub struct LenientCodec<T, U>(PhantomData<fn() -> (T, U)>);

impl<T, U> Default for LenientCodec<T, U> {
    fn default() -> Self {
        LenientCodec(PhantomData)
    }
}

/// The decoder of a [`LenientCodec`].
pub struct LenientDecoder<U>(PhantomData<fn() -> U>);

impl<T: Message + 'static, U: Message + Default + 'static> Codec for LenientCodec<T, U> {
    type Encode = T;
    type Decode = U;
    type Encoder = ProstEncoder<T>;
    type Decoder = LenientDecoder<U>;

    fn encoder(&mut self) -> Self::Encoder {
        ProstEncoder::default()
    }

    fn decoder(&mut self) -> Self::Decoder {
        LenientDecoder(PhantomData)
    }
}

impl<U: Message + Default> Decoder for LenientDecoder<U> {
    type Item = U;
    type Error = Status;

    fn decode(&mut self, buf: &mut DecodeBuf<'_>) -> Result<Option<U>, Status> {
        // All of it, so that the next message begins where it begins. No copy: it is one buffer.
        let message = buf.copy_to_bytes(buf.remaining());
        Ok(Some(U::decode(message).unwrap_or_default()))
    }
}

#[cfg(test)]
mod tests;
