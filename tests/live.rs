//! A browser's view of `slabcast view` and `slabcast master`: real processes, a real WebSocket.

use futures_util::{SinkExt, StreamExt};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream as Plain;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use tokio::net::TcpStream;
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;
use tokio_tungstenite::tungstenite::{Error, Message};

const SLABCAST: &str = env!("CARGO_BIN_EXE_slabcast");
const VOLUME: &str = "formula:spheres:40";
const SIZE: [u32; 2] = [96, 80];

/// Longest that anything may take: machines of CI are busy.
const PATIENCE: Duration = Duration::from_secs(60);

/// A page that does not outlive its test.
struct Page {
    process: Child,
    port: u16,
}

impl Drop for Page {
    fn drop(&mut self) {
        // In order, so that its folder goes too.
        let id = self.process.id().to_string();
        let _ = Command::new("kill").args(["-INT", &id]).status();
        for _ in 0..200 {
            if matches!(self.process.try_wait(), Ok(Some(_))) {
                return;
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Starts `slabcast` with these words, and finds the page's port on its standard output.
fn start(words: &[&str]) -> Page {
    let mut command = Command::new(SLABCAST);
    command.args(words).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut process = command.spawn().expect("slabcast runs");
    let mut lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
    let url = lines.find_map(|line| {
        let line = line.expect("text");
        line.find("http://").map(|at| line[at..].to_owned())
    });
    // Whoever writes to a closed pipe dies of it.
    std::thread::spawn(move || lines.for_each(drop));
    let url = url.expect("the address of the page");
    // The address may end in a token.
    let place = url.split('#').next().unwrap_or_default().trim_end_matches('/');
    let port = place.rsplit(':').next().and_then(|port| port.parse().ok());
    Page { process, port: port.expect("a port") }
}

fn view(words: &[&str]) -> Page {
    start(&[&["view", VOLUME, "--threads", "2", "--listen", "127.0.0.1:0"], words].concat())
}

impl Page {
    /// Makes a call, and returns status, headers in lower case, and body.
    fn call(&self, method: &str, path: &str, headers: &str, body: &[u8]) -> (u16, String, Vec<u8>) {
        let mut stream = Plain::connect(("127.0.0.1", self.port)).expect("the page answers");
        stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
        let host = if headers.contains("Host:") { "" } else { "Host: localhost\r\n" };
        let head = format!(
            "{method} {path} HTTP/1.1\r\n{host}{headers}Content-Length: {}\r\nConnection: \
             close\r\n\r\n",
            body.len()
        );
        stream.write_all(head.as_bytes()).expect("it reads");
        stream.write_all(body).expect("it reads");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("it answers");
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a head");
        let head = String::from_utf8_lossy(&answer[..end]).to_lowercase();
        let status = head.split(' ').nth(1).and_then(|s| s.parse().ok()).expect("a status");
        (status, head, answer[end + 4..].to_vec())
    }

    fn post(&self, path: &str, body: &Value) -> (u16, Value) {
        let (status, _, body) = self.call("POST", path, "", body.to_string().as_bytes());
        (status, serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    async fn dial(&self) -> Result<WebSocketStream<TcpStream>, Error> {
        self.dial_as("localhost", None).await
    }

    async fn dial_as(
        &self,
        host: &str,
        origin: Option<&str>,
    ) -> Result<WebSocketStream<TcpStream>, Error> {
        let stream = TcpStream::connect(("127.0.0.1", self.port)).await.expect("the page listens");
        let mut request = format!("ws://{host}:{}/any/prefix/v1/live", self.port)
            .into_client_request()
            .expect("an address");
        if let Some(origin) = origin {
            request.headers_mut().insert("origin", origin.parse().expect("a header"));
        }
        tokio_tungstenite::client_async(request, stream).await.map(|(socket, _)| socket)
    }

    async fn session(&self, hello: Value) -> Session {
        let mut socket = self.dial().await.expect("a session");
        let mut all = json!({
            "type": "hello", "protocol": [1, 1], "size": SIZE, "codecs": ["jpeg", "webp", "png"],
        });
        for (field, value) in hello.as_object().expect("an object") {
            all[field] = value.clone();
        }
        socket.send(Message::text(all.to_string())).await.expect("it reads");
        Session { socket, tiles: Vec::new(), came: Vec::new(), passes: Vec::new() }
    }
}

/// A client's end of a socket.
struct Session {
    socket: WebSocketStream<TcpStream>,
    /// Tiles of the pass that comes, and when each came.
    tiles: Vec<Vec<u8>>,
    came: Vec<Instant>,
    /// Views whose passes came, and which pass.
    passes: Vec<(u64, String)>,
}

impl Session {
    async fn send(&mut self, message: Value) {
        self.socket.send(Message::text(message.to_string())).await.expect("it reads");
    }

    /// Waits for the next message of text; tiles on the way are kept.
    async fn next(&mut self) -> Value {
        loop {
            if let Some(text) = self.wait_for_a_message().await {
                return text;
            }
        }
    }

    /// Waits for a message of any kind, and returns it if it is text; a tile is kept.
    async fn wait_for_a_message(&mut self) -> Option<Value> {
        let message = tokio::time::timeout(PATIENCE, self.socket.next()).await;
        match message.expect("in time").expect("no end").expect("no error") {
            Message::Text(text) => return Some(serde_json::from_str(&text).expect("JSON")),
            Message::Binary(bytes) => {
                self.tiles.push(bytes.to_vec());
                self.came.push(Instant::now());
            }
            Message::Close(frame) => panic!("closed: {frame:?}"),
            _ => {}
        }
        None
    }

    /// Counts the batches in which the tiles of the last pass came: those with at least `pause` between
    /// them.
    fn batches(&self, pause: Duration) -> usize {
        let came = &self.came[self.came.len() - self.tiles.len()..];
        came.windows(2).filter(|pair| pair[1] - pair[0] >= pause).count() + 1
    }

    /// Waits for a message of a type.
    async fn until(&mut self, kind: &str) -> Value {
        loop {
            let message = self.next().await;
            assert!(message["type"] != "refused" || kind == "refused", "{message}");
            if message["type"] == kind {
                return message;
            }
        }
    }

    /// Takes passes and acknowledges them until the still of view `seq` is there. Returns its `done`.
    async fn still(&mut self, seq: u64) -> Value {
        loop {
            self.tiles.clear();
            let done = self.until("done").await;
            let pass = done["pass"].as_str().expect("a pass").to_owned();
            self.check_tiles(&done);
            self.passes.push((done["seq"].as_u64().expect("a number"), pass.clone()));
            self.send(json!({
                "type": "ack", "seq": done["seq"], "scene": done["scene"], "pass": pass,
                "painted_ms": 1,
            }))
            .await;
            if pass == "still" && done["seq"] == seq {
                return done;
            }
        }
    }

    /// Checks that the tiles of a pass cover its picture once and have its numbers.
    fn check_tiles(&self, done: &Value) {
        let number =
            |tile: &[u8], at: usize| u64::from(u16::from_le_bytes([tile[at], tile[at + 1]]));
        let long = |tile: &[u8], at: usize| {
            u64::from(u32::from_le_bytes(tile[at..at + 4].try_into().expect("four")))
        };
        let is_still = done["pass"] == "still";
        // Those of an older pass that was dropped on its way come before.
        let first = self.tiles.iter().rposition(|tile| number(tile, 2) & 2 != 0);
        let tiles = &self.tiles[first.expect("a first tile")..];
        let mut area = 0;
        for tile in tiles {
            assert_eq!((tile[0], number(tile, 2) & 1), (1, u64::from(is_still)));
            assert_eq!(json!([long(tile, 4), long(tile, 20)]), json!([done["seq"], done["scene"]]));
            assert_eq!(json!([number(tile, 16), number(tile, 18)]), done["size"]);
            assert!(number(tile, 8) + number(tile, 12) <= number(tile, 16));
            assert!(number(tile, 10) + number(tile, 14) <= number(tile, 18));
            assert!(number(tile, 8).is_multiple_of(16) && number(tile, 10).is_multiple_of(16));
            area += number(tile, 12) * number(tile, 14);
        }
        let [w, h] = [0, 1].map(|i| done["size"][i].as_u64().expect("a size"));
        assert_eq!(area, w * h);
    }

    /// Decodes the last still, and checks that its pixels have the hash that the master tells.
    fn pixels(&self, done: &Value) -> Vec<u8> {
        let [w, h] = [0, 1].map(|i| done["size"][i].as_u64().expect("a size") as usize);
        let mut rgba = vec![255; w * h * 4];
        for tile in &self.tiles {
            let at = |at: usize| usize::from(u16::from_le_bytes([tile[at], tile[at + 1]]));
            assert_eq!(tile[1], 3, "this client asked for PNG");
            let mut reader = png::Decoder::new(std::io::Cursor::new(&tile[28..])).read_info();
            let reader = reader.as_mut().expect("a PNG");
            let mut rgb = vec![0; at(12) * at(14) * 3];
            reader.next_frame(&mut rgb).expect("a PNG");
            for (i, pixel) in rgb.chunks(3).enumerate() {
                let (x, y) = (at(8) + i % at(12), at(10) + i / at(12));
                rgba[(y * w + x) * 4..][..3].copy_from_slice(pixel);
            }
        }
        assert_eq!(hex(&Sha256::digest(&rgba)), done["sha256"].as_str().expect("a hash"));
        rgba
    }

    /// Waits for the close code.
    async fn closed(mut self) -> u16 {
        loop {
            let message = tokio::time::timeout(PATIENCE, self.socket.next()).await;
            match message.expect("in time") {
                Some(Ok(Message::Close(Some(frame)))) => return frame.code.into(),
                Some(Ok(_)) => {}
                other => panic!("closed without a code: {other:?}"),
            }
        }
    }
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn camera(azimuth: f64) -> Value {
    json!({"azimuth": azimuth, "elevation": 15, "target": [3, -2, 1], "height": 46})
}

/// Draws with `slabcast render` what a document says, and returns the file's bytes.
fn rendered(dir: &Path, path: &Value, flags: &[&str]) -> Vec<u8> {
    let (views, file) = (dir.join("path.json"), dir.join("picture.png"));
    std::fs::write(&views, path.to_string()).expect("a file");
    let mut command = Command::new(SLABCAST);
    command.args(["render", VOLUME, "-q", "--force", "--path"]).arg(&views);
    let out = command.args(flags).arg("-o").arg(&file).output().expect("slabcast runs");
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    std::fs::read(file).expect("a picture")
}

fn rgba_hash(file: &[u8]) -> String {
    let mut reader = png::Decoder::new(std::io::Cursor::new(file)).read_info().expect("a PNG");
    let mut rgb = vec![0; reader.output_buffer_size().expect("a size")];
    reader.next_frame(&mut rgb).expect("a PNG");
    let rgba: Vec<u8> = rgb.chunks(3).flat_map(|p| [p[0], p[1], p[2], 255]).collect();
    hex(&Sha256::digest(rgba))
}

#[tokio::test(flavor = "multi_thread")]
async fn stills_have_the_pixels_of_the_file_in_every_view_and_colour() {
    let page = view(&["--tf", "skin"]);
    let dir = tempfile::tempdir().expect("a folder");
    let mut session = page.session(json!({"codecs": ["png"]})).await;
    let welcome = session.until("welcome").await;
    assert_eq!((&welcome["protocol"], &welcome["empty"]), (&json!(1), &json!(false)));
    let volume = session.until("volume").await;
    assert_eq!((&volume["dims"], &volume["home"]["tf"]), (&json!([40, 40, 40]), &json!("skin")));
    let counts: u64 = volume["histogram"]["counts"]
        .as_array()
        .expect("counts")
        .iter()
        .map(|n| n.as_u64().expect("a count"))
        .sum();
    assert_eq!(counts, 64_000);
    // The first picture is the master's own.
    let done = session.still(0).await;
    assert_eq!((&done["scene"], &done["level"]), (&json!(0), &json!(0)));
    let presets = volume["presets"].as_array().expect("presets").clone();
    let full = |name: &str| {
        presets.iter().find(|p| p["name"] == name).map(|p| p["tf"].clone()).expect("a preset")
    };
    let crop = json!({"unit": "world", "x": [null, 0], "y": [null, null], "z": [-18, null]});
    let mut edited = full("fog");
    edited["opacities"][1][0] = json!(edited["opacities"][1][0].as_f64().expect("a value") + 3.25);
    let scenes = [
        (json!("skin"), Value::Null, "#000000"),
        (full("glass"), crop, "#204060"),
        (edited, Value::Null, "#ffffff"),
    ];
    let mut seq = 0;
    for (i, (tf, crop, background)) in scenes.iter().enumerate() {
        session
            .send(json!({"type": "scene", "rev": i + 1, "tf": tf, "crop": crop,
            "background": background, "quality": {}}))
            .await;
        for azimuth in [0.0, 33.5] {
            seq += 1;
            session
                .send(json!({"type": "view", "seq": seq, "camera": camera(azimuth),
                "size": SIZE, "moving": false}))
                .await;
            let done = session.still(seq).await;
            let mut path = json!({"version": 1, "size": SIZE,
                "keyframes": {"frames": 1, "keys": [camera(azimuth)]}});
            if !crop.is_null() {
                path["crop"] = crop.clone();
            }
            let tf_file = dir.path().join("tf.json");
            let tf = match tf {
                Value::String(name) => name.clone(),
                function => {
                    std::fs::write(&tf_file, function.to_string()).expect("a file");
                    tf_file.display().to_string()
                }
            };
            let flags = ["--tf", &tf, "--background", background];
            let file = rendered(dir.path(), &path, &flags);
            assert_eq!(json!(rgba_hash(&file)), done["sha256"], "scene {i}, azimuth {azimuth}");
            session.pixels(&done);
        }
    }
}

/// A still that takes long comes in batches while it is drawn, and none of them after a newer view's.
#[tokio::test(flavor = "multi_thread")]
async fn slow_still_comes_tile_by_tile_until_another_view_does() {
    let slow = [1400u64, 1000];
    let words = ["view", VOLUME, "--threads", "1", "--listen", "127.0.0.1:0"];
    let page = start(&words);
    let dir = tempfile::tempdir().expect("a folder");
    let fog = json!({"rev": 1, "tf": "fog", "background": "#204060"});
    let slow_view = |seq: u64| {
        json!({"type": "view", "seq": seq, "camera": camera(7.0 * seq as f64), "size": slow,
            "moving": false})
    };
    let hello = json!({"codecs": ["png"], "size": slow, "view": slow_view(1), "scene": fog});
    let mut session = page.session(hello).await;
    let done = session.still(1).await;
    assert!(done["ms"]["draw"].as_f64().is_some_and(|ms| ms > 250.0), "not slow: {done}");
    let tiles = &session.tiles;
    let batches = session.batches(Duration::from_millis(25));
    assert!(batches > 2, "{batches} batches of {} tiles", tiles.len());
    let bytes: usize = tiles.iter().map(Vec::len).sum();
    assert_eq!(json!(bytes), done["bytes"]);
    session.pixels(&done);
    let path = json!({"version": 1, "size": slow,
        "keyframes": {"frames": 1, "keys": [camera(7.0)]}});
    let file = rendered(dir.path(), &path, &["--tf", "fog", "--background", "#204060"]);
    assert_eq!(json!(rgba_hash(&file)), done["sha256"]);

    // Another view comes when the first tiles of a still are there.
    session.passes.clear();
    session.send(slow_view(2)).await;
    let is_second_still = |tile: &Vec<u8>| tile[4] == 2 && tile[2] & 1 == 1;
    while !session.tiles.last().is_some_and(is_second_still) {
        session.wait_for_a_message().await;
    }
    session
        .send(json!({"type": "view", "seq": 3, "camera": camera(50.0), "size": SIZE,
        "moving": false}))
        .await;
    let done = session.still(3).await;
    let seqs: Vec<u8> = session.tiles.iter().map(|tile| tile[4]).collect();
    assert!(seqs.is_sorted(), "tiles of an older view after those of a newer: {seqs:?}");
    assert!(!session.passes.contains(&(2, "still".into())), "it was dropped: {:?}", session.passes);
    session.tiles.retain(|tile| tile[4] == 3);
    session.pixels(&done);
}

/// A tile's `bound`.
fn bound(tile: &[u8]) -> f32 {
    f32::from_le_bytes(tile[24..28].try_into().expect("four"))
}

#[tokio::test(flavor = "multi_thread")]
async fn moving_tiles_tell_how_far_the_last_one_was_off_its_still() {
    let page = view(&["--tf", "fog"]);
    let mut session = page.session(json!({})).await;
    // The first picture comes quickly first: nobody knows how long its still takes.
    let done = session.until("done").await;
    assert_eq!((&done["pass"], &done["seq"]), (&json!("moving"), &json!(0)));
    assert!(session.tiles.iter().all(|tile| bound(tile).is_nan()), "no still was there");
    session.send(json!({"type": "ack", "seq": 0, "scene": 0, "pass": "moving"})).await;
    session.still(0).await;
    assert!(session.tiles.iter().all(|tile| bound(tile) == 0.0));
    // The comparison ends a moment after the still.
    let off = async {
        let (mut off, mut seq) = (f32::NAN, 0u64);
        while off.is_nan() {
            seq += 1;
            session
                .send(json!({"type": "view", "seq": seq, "camera": camera(20.0), "size": SIZE,
                "moving": true}))
                .await;
            session.tiles.clear();
            let done = session.until("done").await;
            assert_eq!((&done["pass"], &done["seq"]), (&json!("moving"), &json!(seq)));
            off = session.tiles.first().map_or(f32::NAN, |tile| bound(tile));
            let ack = json!({"type": "ack", "seq": seq, "scene": 0, "pass": "moving"});
            session.send(ack).await;
            session.still(seq).await;
        }
        off
    };
    let off = tokio::time::timeout(PATIENCE, off).await.expect("in time");
    assert!(off > 0.0 && off < 0.5, "{off}");
}

#[tokio::test(flavor = "multi_thread")]
async fn latest_view_wins_and_its_still_always_comes() {
    let page = view(&[]);
    let mut session = page.session(json!({})).await;
    session.still(0).await;
    for seq in 1..=200u64 {
        let camera = camera(seq as f64);
        session
            .send(json!({"type": "view", "seq": seq, "camera": camera, "size": SIZE,
            "moving": true}))
            .await;
        tokio::time::sleep(Duration::from_millis(3)).await;
    }
    // Nothing said that the hand has left: the still comes by itself.
    session.passes.clear();
    session.still(200).await;
    let moving = session.passes.iter().filter(|(_, pass)| pass == "moving").count();
    let stills = session.passes.len() - moving;
    // Nobody acknowledged while the views came, so two were in flight and one of the last view came.
    assert!((1..=4).contains(&moving) && stills == 1, "{:?}", session.passes);
    assert!(session.passes.windows(2).all(|pair| pair[0].0 <= pair[1].0), "{:?}", session.passes);
}

#[tokio::test(flavor = "multi_thread")]
async fn two_sessions_have_their_own_views_and_a_wrong_message_harms_nobody() {
    let page = view(&[]);
    let mut one = page.session(json!({})).await;
    let mut two = page
        .session(json!({
            "view": {"seq": 9, "camera": camera(90.0), "size": [64, 64]},
            "scene": {"rev": 4, "tf": "bone"},
        }))
        .await;
    let (first, second) = (one.still(0).await, two.still(9).await);
    assert_eq!((&second["scene"], &second["size"]), (&json!(4), &json!([64, 64])));
    assert_ne!(first["sha256"], second["sha256"]);
    for (message, field) in [
        (json!({"type": "scene", "rev": 5, "tf": "no such"}), "no such"),
        (json!({"type": "view", "seq": 2, "camera": {"azimut": 1}, "size": SIZE}), "azimut"),
        (json!({"type": "view", "seq": 3, "camera": {}, "size": [0, 7]}), "size"),
        (json!({"type": "pick", "id": 1, "x": 1000, "y": 0}), "1000"),
        (json!({"type": "thumbs", "id": 1, "names": [], "size": 96}), "names"),
        (json!({"type": "cancel_job", "id": 1, "job": "job-1"}), "job-1"),
    ] {
        one.send(message.clone()).await;
        let refused = one.until("refused").await;
        assert_eq!(refused["re"], message["type"], "{refused}");
        let said = refused.to_string();
        assert!(said.contains(field) && refused["problem"].as_str().is_some_and(|p| p.len() > 9));
    }
    one.send(json!({"type": "unheard_of", "id": 1})).await;
    one.send(json!({"type": "scene", "rev": 6, "tf": "bone"})).await;
    one.send(json!({"type": "view", "seq": 7, "camera": camera(90.0), "size": [64, 64]})).await;
    assert_eq!(one.still(7).await["sha256"], second["sha256"]);
    one.send(json!({"type": "ping", "t": 12345})).await;
    assert_eq!(one.until("pong").await["t"], 12345);
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_beside_the_picture_are_answered() {
    let page = view(&["--tf", "skin"]);
    let mut session = page.session(json!({"watch": ["jobs", "workers", "volumes"]})).await;
    let mut kinds = vec!["jobs", "workers", "volumes"];
    while !kinds.is_empty() {
        let message = session.next().await;
        kinds.retain(|kind| message["type"] != *kind || message["reset"] != true);
    }
    session.still(0).await;
    session.send(json!({"type": "fit", "id": 1, "camera": {"azimuth": 0}})).await;
    let fitted = session.until("fitted").await;
    let height = fitted["height"].as_f64().expect("a height");
    assert!(height > 5.0 && height < 80.0, "{fitted}");
    session.send(json!({"type": "pick", "id": 2, "x": SIZE[0] / 2, "y": SIZE[1] / 2})).await;
    let picked = session.until("picked").await;
    assert!(picked["alpha"].as_f64().is_some_and(|a| a > 0.5), "{picked}");
    assert!(picked["ranges"].as_array().is_some_and(|r| !r.is_empty()), "{picked}");
    session.tiles.clear();
    session
        .send(json!({"type": "thumbs", "id": 77, "of": "presets", "size": 48,
        "names": ["bone", "nothing of that name", "fog"]}))
        .await;
    let done = session.until("thumbs_done").await;
    assert_eq!(done["failed"].as_array().map(Vec::len), Some(1), "{done}");
    let indices: Vec<u8> = session.tiles.iter().map(|tile| tile[8]).collect();
    assert_eq!(indices, [0, 2]);
    assert!(session.tiles.iter().all(|tile| (tile[2], tile[4], tile[12]) == (4, 77, 48)));
    session.send(json!({"type": "open", "volume": "nowhere"})).await;
    assert_eq!(session.until("refused").await["reason"], "volume_not_found");
}

#[tokio::test(flavor = "multi_thread")]
async fn strangers_and_rule_breakers_are_turned_away() {
    let page = view(&["--allowed-host", "portal.example"]);
    let status = |result: Result<WebSocketStream<TcpStream>, Error>| match result {
        Ok(_) => 101,
        Err(Error::Http(answer)) => answer.status().as_u16(),
        Err(other) => panic!("{other}"),
    };
    let port = page.port;
    assert_eq!(status(page.dial_as("evil.example", None).await), 403);
    assert_eq!(status(page.dial_as("127.evil.example", None).await), 403);
    assert_eq!(status(page.dial_as("localhost", Some("http://evil.example")).await), 403);
    assert_eq!(status(page.dial_as("localhost", Some("http://localhost:1")).await), 403);
    let own = format!("http://localhost:{port}");
    assert_eq!(status(page.dial_as("localhost", Some(&own)).await), 101);
    assert_eq!(status(page.dial_as("portal.example", Some("https://portal.example")).await), 101);
    let (status, ..) = page.call("GET", "/", "Host: evil.example\r\n", b"");
    assert_eq!(status, 403);
    let (status, ..) = page.call("POST", "/v1/states", "Origin: http://evil.example\r\n", b"{}");
    assert_eq!(status, 403);

    let mut long = page.session(json!({})).await;
    long.still(0).await;
    let name = "x".repeat(70_000);
    long.send(json!({"type": "open", "volume": name})).await;
    assert_eq!(long.closed().await, 1009);
    let mut huge = page.session(json!({})).await;
    huge.send(json!({"type": "open", "volume": "x".repeat(1 << 20)})).await;
    assert_eq!(huge.closed().await, 1009);
    let other = page.session(json!({"protocol": [2, 3]})).await;
    assert_eq!(other.closed().await, 4400);
    let mut socket = page.dial().await.expect("a session");
    socket.send(Message::text("{\"type\": \"view\"}")).await.expect("it reads");
    let silent = Session { socket, tiles: Vec::new(), came: Vec::new(), passes: Vec::new() };
    assert_eq!(silent.closed().await, 1008);
    let mut flood = page.session(json!({})).await;
    for t in 0..3000 {
        // It may be closed on the way.
        let ping = json!({"type": "ping", "t": t}).to_string();
        if flood.socket.send(Message::text(ping)).await.is_err() {
            break;
        }
    }
    assert_eq!(flood.closed().await, 1008);
}

#[tokio::test(flavor = "multi_thread")]
async fn tokens_are_asked_for_in_the_first_message_and_in_calls() {
    let dir = tempfile::tempdir().expect("a folder");
    let file = dir.path().join("token");
    std::fs::write(&file, "a-long-enough-token\n").expect("a file");
    let words = ["--page-token", file.to_str().expect("text")];
    let page = view(&words);
    let refused = page.session(json!({})).await;
    assert_eq!(refused.closed().await, 4401);
    let mut session = page.session(json!({"token": "a-long-enough-token"})).await;
    session.still(0).await;
    assert_eq!(page.call("GET", "/v1/states/x", "", b"").0, 401);
    let bearer = "Authorization: Bearer a-long-enough-token\r\n";
    assert_eq!(page.call("GET", "/v1/states/x", bearer, b"").0, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn live_pictures_come_beside_a_job_which_goes_on() {
    let page = view(&["--tf", "skin"]);
    let mut session = page.session(json!({"watch": ["jobs"]})).await;
    session.still(0).await;
    let movie = json!({"version": 1, "volume": {"name": VOLUME}, "tf": "fog", "format": "zip",
        "fps": 10, "path": {"version": 1, "size": [256, 256],
        "turntable": {"start": 0, "step": 1, "frames": 300}}});
    let (status, answer) = page.post("/v1/movie", &movie);
    assert_eq!(status, 202, "{answer}");
    let mut begun = 0;
    while begun < 3 {
        let news = session.until("jobs").await;
        let entries = news["changed"].as_array().expect("entries");
        assert!(
            entries.iter().all(|entry| entry["job"] == answer["job"]),
            "live jobs are nobody's"
        );
        begun = entries.first().and_then(|job| job["frames_done"].as_u64()).unwrap_or(begun);
    }
    for seq in 1..=20u64 {
        let camera = camera(seq as f64 * 7.0);
        session.send(json!({"type": "view", "seq": seq, "camera": camera, "size": SIZE})).await;
        session.still(seq).await;
    }
    // The job is not over: else the pictures came behind it. A time would tell of the machine.
    let last = loop {
        let news = session.until("jobs").await;
        if let Some(job) = news["changed"].as_array().and_then(|jobs| jobs.first()) {
            break job.clone();
        }
    };
    assert_eq!((&last["state"], &last["frames_total"]), (&json!("running"), &json!(300)), "{last}");
    assert!(last["frames_done"].as_u64().is_some_and(|n| n > begun), "it goes on: {last}");
    session.send(json!({"type": "cancel_job", "id": 5, "job": answer["job"]})).await;
    assert_eq!(session.until("ok").await["id"], 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn page_comes_back_to_a_master_that_was_restarted() {
    let page = view(&[]);
    let port = page.port;
    let hello = json!({
        "view": {"seq": 12, "camera": camera(45.0), "size": SIZE, "moving": false},
        "scene": {"rev": 3, "tf": "bone", "background": "#112233"},
    });
    let before = page.session(hello.clone()).await.still(12).await;
    drop(page);
    let address = format!("127.0.0.1:{port}");
    let page = start(&["view", VOLUME, "--threads", "2", "--listen", &address]);
    let after = page.session(hello).await.still(12).await;
    assert_eq!((&after["sha256"], &after["scene"]), (&before["sha256"], &json!(3)));
}

#[test]
fn pictures_to_keep_are_the_files_of_render_and_movies_are_made() {
    let page = view(&[]);
    let dir = tempfile::tempdir().expect("a folder");
    let path = json!({"version": 1, "size": SIZE,
        "keyframes": {"frames": 1, "keys": [camera(20.0)]}});
    let document = json!({"version": 1, "volume": {"name": VOLUME}, "tf": "bone",
        "path": path, "background": "#102030"});
    let (status, head, file) =
        page.call("POST", "/x/v1/picture", "", document.to_string().as_bytes());
    assert_eq!(status, 200, "{}", String::from_utf8_lossy(&file));
    assert!(head.contains("content-type: image/png") && head.contains("etag: \""), "{head}");
    let flags = ["--tf", "bone", "--background", "#102030"];
    assert!(file == rendered(dir.path(), &path, &flags), "the same bytes as the command's");

    let (status, answer) = page.post("/v1/states", &document);
    assert_eq!(status, 201);
    let id = answer["id"].as_str().expect("an id").to_owned();
    assert_eq!(page.post("/v1/states", &document).1, answer, "the same id");
    let (_, _, kept) = page.call("GET", &format!("/v1/states/{id}"), "", b"");
    assert_eq!(kept, document.to_string().as_bytes());
    let (_, _, small) = page.call("GET", &format!("/v1/picture?state={id}&w=48"), "", b"");
    let reader = png::Decoder::new(std::io::Cursor::new(small)).read_info().expect("a PNG");
    assert_eq!((reader.info().width, reader.info().height), (48, 40));

    let mut movie = document.clone();
    movie["path"] = json!({"version": 1, "size": [32, 32],
        "turntable": {"start": 0, "step": 90, "frames": 4}});
    for (format, magic) in [("apng", &b"\x89PNG"[..]), ("zip", b"PK\x03\x04")] {
        (movie["format"], movie["fps"]) = (json!(format), json!(12));
        let (status, answer) = page.post("/v1/movie", &movie);
        assert_eq!(status, 202, "{answer}");
        let job = answer["job"].as_str().expect("a job").to_owned();
        let address = format!("/v1/jobs/{job}/result");
        let began = Instant::now();
        let whole = loop {
            let (status, _, body) = page.call("GET", &address, "", b"");
            if status == 200 {
                break body;
            }
            assert!(began.elapsed() < PATIENCE, "no movie in time");
            std::thread::sleep(Duration::from_millis(50));
        };
        assert!(whole.starts_with(magic), "{format}");
        let (status, head, part) = page.call("GET", &address, "Range: bytes=2-9\r\n", b"");
        assert_eq!((status, &part[..]), (206, &whole[2..10]), "{head}");
    }
    (movie["format"], movie["fps"]) = (json!("avi"), json!(12));
    let (status, answer) = page.post("/v1/movie", &movie);
    assert_eq!((status, &answer["field"]), (400, &json!("format")));
    let mut elsewhere = document.clone();
    elsewhere["volume"] = json!({"name": VOLUME, "digest": "00".repeat(32)});
    assert_eq!(page.post("/v1/picture", &elsewhere).0, 404, "never another volume");
}

#[test]
fn uploads_go_on_where_they_were_and_are_refused_in_words() {
    let page = view(&[]);
    let dir = tempfile::tempdir().expect("a folder");
    let file = dir.path().join("blob.nrrd");
    let mut convert = Command::new(SLABCAST);
    convert.args(["convert", "formula:blob:24"]).arg(&file);
    assert!(convert.output().expect("slabcast runs").status.success());
    let bytes = std::fs::read(&file).expect("a file");
    let begin =
        json!({"name": "blob.nrrd", "files": [{"name": "blob.nrrd", "bytes": bytes.len()}]});
    let (status, answer) = page.post("/v1/uploads", &begin);
    assert_eq!(status, 201, "{answer}");
    let upload = answer["upload"].as_str().expect("an id").to_owned();
    let put = |offset: usize, piece: &[u8]| {
        let address = format!("/v1/uploads/{upload}/0?offset={offset}");
        let (status, _, body) = page.call("PUT", &address, "", piece);
        (status, serde_json::from_slice::<Value>(&body).expect("JSON"))
    };
    let half = bytes.len() / 2;
    assert_eq!(put(0, &bytes[..half]), (200, json!({"received": half})));
    let (status, answer) = put(0, &bytes[..half]);
    assert_eq!((status, &answer["received"]), (409, &json!(half)));
    let (status, answer) = page.post(&format!("/v1/uploads/{upload}/done"), &json!({}));
    assert_eq!(status, 400, "{answer}");
    assert_eq!(put(half, &bytes[half..]).0, 200);
    let (status, entry) = page.post(&format!("/v1/uploads/{upload}/done"), &json!({}));
    assert_eq!(
        (status, &entry["name"], &entry["origin"]),
        (201, &json!("blob.nrrd"), &json!("upload"))
    );
    // It can be drawn at once.
    let document = json!({"version": 1, "volume": {"name": "blob.nrrd"}, "tf": "auto",
        "path": {"version": 1, "size": [16, 16], "keyframes": {"frames": 1, "keys": [{"azimuth": 0}]}}});
    assert_eq!(page.post("/v1/picture", &document).0, 200);
    let (_, answer) = page
        .post("/v1/uploads", &json!({"name": "x.txt", "files": [{"name": "x.txt", "bytes": 4}]}));
    let upload = answer["upload"].as_str().expect("an id");
    page.call("PUT", &format!("/v1/uploads/{upload}/0?offset=0"), "", b"text");
    let (status, answer) = page.post(&format!("/v1/uploads/{upload}/done"), &json!({}));
    assert_eq!(status, 422);
    assert!(answer["problem"].as_str().is_some_and(|p| p.contains("x.txt")), "{answer}");
    for bad in ["../x", "a/b", ""] {
        let begin = json!({"name": bad, "files": [{"name": "x", "bytes": 1}]});
        assert_eq!(page.post("/v1/uploads", &begin).0, 400, "{bad}");
    }
    let large = json!({"name": "x", "files": [{"name": "x", "bytes": 1u64 << 50}]});
    assert_eq!(page.post("/v1/uploads", &large).0, 413);
}

#[test]
fn master_serves_the_page_and_grpc_on_one_port() {
    let dir = tempfile::tempdir().expect("a folder");
    let uploads = dir.path().join("uploads");
    let page =
        start(&["master", "--listen", "127.0.0.1:0", "--uploads", uploads.to_str().expect("text")]);
    let (status, head, body) = page.call("GET", "/", "", b"");
    assert_eq!(status, 200);
    assert!(String::from_utf8_lossy(&body).contains("<title>slabcast</title>"));
    for header in [
        "content-security-policy: default-src 'none'",
        "x-content-type-options: nosniff",
        "referrer-policy: no-referrer",
        "cross-origin-opener-policy: same-origin",
    ] {
        assert!(head.contains(header), "{header} in {head}");
    }
    let (_, head, packed) = page.call("GET", "/p/app.js", "Accept-Encoding: gzip\r\n", b"");
    assert!(head.contains("content-encoding: gzip"), "{head}");
    let mut script = String::new();
    flate2::read::GzDecoder::new(&packed[..]).read_to_string(&mut script).expect("gzip");
    assert!(script.contains("class Wire"));
    let etag = head.lines().find_map(|line| line.strip_prefix("etag: ")).expect("a tag");
    let again = format!("Accept-Encoding: gzip\r\nIf-None-Match: {etag}\r\n");
    assert_eq!(page.call("GET", "/p/app.js", &again, b"").0, 304);
    let address = format!("127.0.0.1:{}", page.port);
    let status = Command::new(SLABCAST).args(["status", "--master", &address]).output();
    let status = status.expect("slabcast runs");
    assert!(status.status.success(), "{}", String::from_utf8_lossy(&status.stderr));
}
