//! WebSocket client of the live page for tests, and `slabcast view` processes to connect to.

#![allow(dead_code, reason = "each test program uses a part of it")]

use crate::processes::{Process, first_line};
use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Duration;
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;

/// Size of pictures unless a test asks for another.
pub(crate) const SIZE: [u32; 2] = [96, 80];

/// Longest that anything may take: machines of CI are busy.
const PATIENCE: Duration = Duration::from_secs(60);

/// Starts `slabcast view` with these arguments at a free port. Returns the process and the port.
pub(crate) fn view(dir: &Path, words: &[&str]) -> (Process, u16) {
    let (process, url) = first_line(dir, &[&["view", "--threads", "2"], words].concat());
    let place = url.split('#').next().unwrap_or_default().trim_end_matches('/');
    let port = place.rsplit(':').next().and_then(|port| port.parse().ok());
    (process, port.unwrap_or_else(|| panic!("no port in {url:?}")))
}

/// WebSocket of one session, as a browser has it.
pub(crate) struct Live(WebSocketStream<TcpStream>);

impl Live {
    /// Opens a session whose `hello` has these fields beside those that it needs.
    pub(crate) async fn dial(port: u16, hello: Value) -> Live {
        let stream = TcpStream::connect(("127.0.0.1", port)).await.expect("the page listens");
        let address = format!("ws://localhost:{port}/v1/live");
        let (socket, _) =
            tokio_tungstenite::client_async(address, stream).await.expect("a session");
        let mut all = json!({
            "type": "hello", "protocol": [1, 1], "size": SIZE, "codecs": ["jpeg", "webp", "png"],
        });
        for (field, value) in hello.as_object().expect("an object") {
            all[field] = value.clone();
        }
        let mut live = Live(socket);
        live.send(all).await;
        live
    }

    pub(crate) async fn send(&mut self, message: Value) {
        // A session that is refused may be closed on the way.
        let _ = self.0.send(Message::text(message.to_string())).await;
    }

    /// Waits for a message of text of a type; others are skipped.
    pub(crate) async fn until(&mut self, kind: &str) -> Value {
        loop {
            let message = tokio::time::timeout(PATIENCE, self.0.next()).await;
            match message.expect("in time").expect("no end").expect("no error") {
                Message::Text(text) => {
                    let message: Value = serde_json::from_str(&text).expect("JSON");
                    assert!(message["type"] != "refused" || kind == "refused", "{message}");
                    if message["type"] == kind {
                        return message;
                    }
                }
                Message::Close(frame) => panic!("closed: {frame:?}"),
                _ => {}
            }
        }
    }

    /// Acknowledges passes until a still of scene `rev` is there. Returns its `done`.
    pub(crate) async fn still(&mut self, rev: u64) -> Value {
        loop {
            let done = self.until("done").await;
            self.send(json!({
                "type": "ack", "seq": done["seq"], "scene": done["scene"], "pass": done["pass"],
                "painted_ms": 1,
            }))
            .await;
            if done["pass"] == "still" && done["scene"] == rev {
                return done;
            }
        }
    }

    /// Waits for the close code and its words.
    pub(crate) async fn closed(mut self) -> (u16, String) {
        loop {
            let message = tokio::time::timeout(PATIENCE, self.0.next()).await;
            match message.expect("in time") {
                Some(Ok(Message::Close(Some(frame)))) => {
                    return (frame.code.into(), frame.reason.to_string());
                }
                Some(Ok(_)) => {}
                other => panic!("closed without a code: {other:?}"),
            }
        }
    }
}
