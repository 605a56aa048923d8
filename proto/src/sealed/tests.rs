use super::*;
use crate::cluster_v1::{BricksOpen, EndFrame, Ping, Pong};
use std::collections::VecDeque;

type End<Out, In> = (Outgoing<Queue<Out>>, Incoming<In>);

/// A source that has what was put into it.
struct Queue<M>(Arc<Mutex<VecDeque<M>>>);

impl<M: Unpin> Stream for Queue<M> {
    type Item = M;
    fn poll_next(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<M>> {
        self.0.lock().unwrap().pop_front().map_or(Poll::Pending, |m| Poll::Ready(Some(m)))
    }
}

fn end<Out: Seals + Unpin, In: Seals>(
    messages: impl IntoIterator<Item = Out>,
) -> (End<Out, In>, Arc<Mutex<VecDeque<Out>>>) {
    let queue = Arc::new(Mutex::new(messages.into_iter().collect()));
    (ends(Queue(queue.clone())), queue)
}

fn next<M: Seals + Unpin>(out: &mut Outgoing<Queue<M>>) -> Option<M> {
    match Pin::new(out).poll_next(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(message) => message,
        Poll::Pending => None,
    }
}

fn ping(nonce: u64) -> ControlResponse {
    ControlResponse { message: Some(control_response::Message::Ping(Ping { nonce })) }
}

fn pong(nonce: u64) -> ControlRequest {
    let pong = Pong { nonce, clock_us: nonce };
    ControlRequest { message: Some(control_request::Message::Pong(pong)) }
}

struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    /// Flips a bit of one message in `one_in`, anywhere. What can't be decoded then is no message.
    fn spoil<M: Seals>(&mut self, message: M, one_in: u64) -> M {
        if !self.next().is_multiple_of(one_in) {
            return message;
        }
        let mut bytes = message.encode_to_vec();
        let at = self.next() as usize % bytes.len();
        bytes[at] ^= 1 << (self.next() % 8);
        M::decode(&bytes[..]).unwrap_or_default()
    }
}

#[test]
fn messages_arrive_once_and_in_order_over_a_line_that_damages_one_in_four() {
    const MESSAGES: u64 = 3000;
    for seed in 1..=20 {
        let mut noise = Noise(0x9e37_79b9_7f4a_7c15 ^ seed);
        let ((mut master_out, master_in), _) = end((0..MESSAGES).map(ping));
        let ((mut worker_out, worker_in), _) = end((0..MESSAGES).map(pong));
        let (mut pings, mut pongs): (Vec<_>, Vec<_>) = Default::default();
        let (mut down, mut up) = (VecDeque::new(), VecDeque::new());
        let mut rounds = 0;
        while pings.len() < MESSAGES as usize || pongs.len() < MESSAGES as usize {
            rounds += 1;
            assert!(rounds < 400 * MESSAGES, "seed {seed}: {} and {}", pings.len(), pongs.len());
            // Up to 30 messages are on their way at a time.
            while down.len() < 30
                && let Some(m) = next(&mut master_out)
            {
                down.push_back(noise.spoil(m, 4));
            }
            while up.len() < 30
                && let Some(m) = next(&mut worker_out)
            {
                up.push_back(noise.spoil(m, 4));
            }
            if down.is_empty() && up.is_empty() {
                let waits = master_in.is_waiting() || worker_in.is_waiting();
                assert!(waits, "seed {seed}: nothing is on its way, and nobody asks");
                if master_in.is_waiting() {
                    master_in.ask_again().unwrap();
                }
                if worker_in.is_waiting() {
                    worker_in.ask_again().unwrap();
                }
            }
            for _ in 0..noise.next() % 30 {
                if let Some(m) = down.pop_front() {
                    pings.extend(worker_in.open(m).unwrap());
                }
                if let Some(m) = up.pop_front() {
                    pongs.extend(master_in.open(m).unwrap());
                }
            }
        }
        assert!(pings.iter().cloned().eq((0..MESSAGES).map(ping)), "seed {seed}");
        assert!(pongs.iter().cloned().eq((0..MESSAGES).map(pong)), "seed {seed}");
        assert!(master_in.damaged() > 1000 && worker_in.damaged() > 1000, "seed {seed}");
    }
}

#[test]
fn every_single_flipped_bit_is_found() {
    let end_frame = |frame| ControlResponse {
        message: Some(control_response::Message::EndFrame(EndFrame { frame })),
    };
    let ((mut out, _), _) = end::<_, ControlRequest>([end_frame(77)]);
    let bytes = next(&mut out).expect("it is sent").encode_to_vec();
    let mut whole = 0;
    for bit in 0..8 * bytes.len() {
        let mut bytes = bytes.clone();
        bytes[bit / 8] ^= 1 << (bit % 8);
        let ((_, inbound), _) = end::<ControlRequest, _>([]);
        let message = ControlResponse::decode(&bytes[..]).unwrap_or_default();
        whole += u32::from(inbound.open(message).unwrap().is_some());
        assert!(inbound.is_waiting() && inbound.damaged() == 1);
    }
    assert_eq!(whole, 0);
}

#[test]
fn sender_stops_at_the_window_until_the_peer_acknowledges() {
    let big = |session| {
        let open = bricks_request::Message::Open(BricksOpen { session });
        BricksRequest { message: Some(open) }
    };
    let ((mut out, inbound), _) =
        end::<_, BricksResponse>((0..2 * WINDOW_MESSAGES as u64).map(|i| big(i + 1)));
    let sent = std::iter::from_fn(|| next(&mut out)).collect::<Vec<_>>();
    assert_eq!(sent.len(), WINDOW_MESSAGES);
    // The peer reads one message, and then asks for all of the others again.
    let ((mut answers, peer), _) = end::<BricksResponse, _>([]);
    assert_eq!(peer.open(sent[0].clone()), Ok(Some(big(1))));
    assert_eq!(peer.open(BricksRequest::default()), Ok(None));
    inbound.open(next(&mut answers).expect("a request")).unwrap();
    assert_eq!(std::iter::from_fn(|| next(&mut out)).count(), WINDOW_MESSAGES);
}

#[test]
fn peer_that_lies_about_what_came_ends_the_stream() {
    let seal = |number, received, asked| {
        let mut sealed = Sealed { number, received, asked, ..Sealed::default() };
        sealed.crc32c = checksum(&sealed, 0);
        ControlRequest::of(sealed)
    };
    let ((mut out, inbound), _) = end::<_, ControlRequest>([ping(1), ping(2)]);
    assert_eq!(inbound.open(seal(1, 1, 0)), Err(StreamError::NeverSent { number: 1 }));
    assert!(next(&mut out).is_some());
    assert_eq!(inbound.open(seal(1, 1, 0)), Ok(None));
    for asked in 1..=MOST_TRIES {
        assert_eq!(inbound.open(seal(1 + u64::from(asked), 1, asked)), Ok(None));
    }
    let asks = seal(2 + u64::from(MOST_TRIES), 1, MOST_TRIES + 1);
    assert_eq!(inbound.open(asks), Err(StreamError::AskedTooOften { number: 2 }));
}

#[test]
fn message_that_never_comes_whole_ends_the_stream() {
    let ((_, inbound), _) = end::<ControlRequest, ControlResponse>([]);
    assert_eq!(inbound.open(ControlResponse::default()), Ok(None));
    for _ in 1..MOST_TRIES {
        assert_eq!(inbound.ask_again(), Ok(()));
    }
    let hopeless = StreamError::Hopeless { number: 1 };
    assert!(hopeless.is_damage());
    assert_eq!(inbound.ask_again(), Err(hopeless));
}
