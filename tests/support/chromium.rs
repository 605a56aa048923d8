//! A real Chromium for tests, driven by its own protocol (Chrome DevTools Protocol) over a WebSocket:
//! pages that are opened, asked in JavaScript, touched by mouse, keys and fingers.
//!
//! Calls block. Waiting is asking again, with a deadline: a page that nobody asks does not repaint.

use crate::processes::Process;
use serde_json::{Value, json};
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use tokio_tungstenite::tungstenite::{self, Message, WebSocket};

/// Names under which distributions install it.
const PROGRAMS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];
/// No answer of the browser takes as long.
const PATIENCE: Duration = Duration::from_secs(60);

/// A browser without a window, with a profile of its own. Both go when it is dropped.
pub(crate) struct Chromium {
    _process: Process,
    _profile: tempfile::TempDir,
    /// `HOST:PORT/PATH` of the browser's own socket.
    address: String,
}

/// Screen of a page.
#[derive(Clone, Copy)]
pub(crate) struct Screen {
    /// Width and height in CSS pixels.
    pub(crate) size: (u32, u32),
    /// Screen pixels a CSS pixel.
    pub(crate) scale: f64,
    /// It has fingers in place of a mouse.
    pub(crate) touch: bool,
}

/// A key: its name in events, its code, and its number on Windows, which decides what Chromium does.
pub(crate) type Key = (&'static str, &'static str, u32);
pub(crate) const TAB: Key = ("Tab", "Tab", 9);
pub(crate) const ENTER: Key = ("Enter", "Enter", 13);
pub(crate) const ESCAPE: Key = ("Escape", "Escape", 27);
pub(crate) const RIGHT: Key = ("ArrowRight", "ArrowRight", 39);

impl Chromium {
    /// Starts the browser; `None`, said aloud, where this machine has none.
    pub(crate) fn start() -> Option<Chromium> {
        let profile = tempfile::tempdir().expect("a folder for the profile");
        let started = PROGRAMS.iter().find_map(|program| {
            Command::new(program)
                .args(["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run"])
                .args([
                    "--disable-background-networking",
                    "--disable-dev-shm-usage",
                    "--hide-scrollbars",
                ])
                .args(["--remote-debugging-port=0", "about:blank"])
                .arg(format!("--user-data-dir={}", profile.path().display()))
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .stderr(Stdio::piped())
                .spawn()
                .ok()
        });
        let Some(mut child) = started else {
            // Not captured, as what `println!` writes would be.
            let _ =
                writeln!(std::io::stderr(), "skipped: needs chromium (apt-get install chromium)");
            return None;
        };
        let mut lines = BufReader::new(child.stderr.take().expect("piped")).lines();
        let process = Process(child);
        let said = lines.find_map(|line| {
            Some(line.ok()?.strip_prefix("DevTools listening on ws://")?.trim().to_string())
        });
        let address = said.expect("chromium says where it listens");
        // It writes on; a full pipe would stop it.
        std::thread::spawn(move || lines.for_each(drop));
        Some(Chromium { _process: process, _profile: profile, address })
    }

    /// Opens an address in a page with storage of its own.
    pub(crate) fn open(&self, url: &str, screen: Screen) -> Page {
        let host = self.address.split('/').next().expect("a host");
        let stream = TcpStream::connect(host).expect("chromium takes connections");
        stream.set_read_timeout(Some(PATIENCE)).expect("a timeout");
        stream.set_nodelay(true).expect("no delay");
        let (socket, _) =
            tungstenite::client(format!("ws://{}", self.address), stream).expect("a WebSocket");
        let mut page = Page { socket, session: None, calls: 0, troubles: Vec::new() };
        let context = page.call("Target.createBrowserContext", json!({}));
        let context = &context["browserContextId"];
        let target = page.call(
            "Target.createTarget",
            json!({"url": "about:blank", "browserContextId": context}),
        );
        let attach = json!({"targetId": target["targetId"], "flatten": true});
        let session = page.call("Target.attachToTarget", attach);
        page.session = Some(session["sessionId"].as_str().expect("a session").to_string());
        for domain in ["Page.enable", "Runtime.enable"] {
            page.call(domain, json!({}));
        }
        let (width, height) = screen.size;
        let metrics = json!({"width": width, "height": height, "deviceScaleFactor": screen.scale,
            "mobile": screen.touch});
        page.call("Emulation.setDeviceMetricsOverride", metrics);
        page.call(
            "Emulation.setTouchEmulationEnabled",
            json!({"enabled": screen.touch, "maxTouchPoints": 5}),
        );
        page.call("Page.navigate", json!({"url": url}));
        page
    }
}

/// A page.
pub(crate) struct Page {
    socket: WebSocket<TcpStream>,
    session: Option<String>,
    calls: u64,
    /// Exceptions that nothing caught.
    troubles: Vec<String>,
}

impl Page {
    /// Calls a method of the protocol and returns its result.
    ///
    /// # Panics
    /// If the browser refuses it.
    pub(crate) fn call(&mut self, method: &str, params: Value) -> Value {
        self.calls += 1;
        let mut message = json!({"id": self.calls, "method": method, "params": params});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.socket.send(Message::text(message.to_string())).expect("chromium listens");
        loop {
            let text = self.socket.read().expect("chromium answers").into_text().expect("text");
            let answer: Value = serde_json::from_str(&text).expect("JSON");
            if answer["method"] == "Runtime.exceptionThrown" {
                self.troubles.push(answer["params"]["exceptionDetails"].to_string());
            }
            if answer["id"] == self.calls {
                assert!(answer["error"].is_null(), "{method}: {}", answer["error"]);
                return answer["result"].clone();
            }
        }
    }

    /// The value of an expression, awaited if it is a promise.
    ///
    /// # Panics
    /// If it throws.
    pub(crate) fn ask(&mut self, js: &str) -> Value {
        let params = json!({"expression": js, "awaitPromise": true, "returnByValue": true});
        let result = self.call("Runtime.evaluate", params);
        let thrown = &result["exceptionDetails"];
        assert!(thrown.is_null(), "{js}: {thrown}");
        result["result"]["value"].clone()
    }

    /// The number of an expression.
    pub(crate) fn number(&mut self, js: &str) -> f64 {
        let value = self.ask(js);
        value.as_f64().unwrap_or_else(|| panic!("{js} is {value}"))
    }

    /// The words of an expression.
    pub(crate) fn words(&mut self, js: &str) -> String {
        let value = self.ask(js);
        value.as_str().unwrap_or_else(|| panic!("{js} is {value}")).to_string()
    }

    /// Asks until an expression holds. One that throws, as before the page is there, does not.
    ///
    /// # Panics
    /// If it does not hold in time.
    pub(crate) fn until(&mut self, js: &str) {
        let end = Instant::now() + PATIENCE;
        let asked =
            format!("(() => {{ try {{ return Boolean({js}); }} catch {{ return false; }} }})()");
        while self.ask(&asked) != true {
            assert!(Instant::now() < end, "in time: {js}; {:?}", self.troubles);
            std::thread::sleep(Duration::from_millis(20));
        }
    }

    /// Middle of what a selector names, in CSS pixels, moved by a share of its size.
    pub(crate) fn place(&mut self, selector: &str, by: (f64, f64)) -> (f64, f64) {
        let found = self.ask(&format!(
            "(b => [b.x + b.width / 2, b.y + b.height / 2, b.width, b.height])\
             (document.querySelector({selector:?}).getBoundingClientRect())"
        ));
        let at = |i: usize| found[i].as_f64().expect("a number");
        (at(0) + by.0 * at(2), at(1) + by.1 * at(3))
    }

    /// Sends an event of the mouse, with its left button or none.
    pub(crate) fn mouse(&mut self, kind: &str, (x, y): (f64, f64), down: bool) {
        let button = if down { "left" } else { "none" };
        let params = json!({"type": kind, "x": x, "y": y, "button": button, "buttons": u8::from(down),
            "clickCount": 1});
        self.call("Input.dispatchMouseEvent", params);
    }

    /// Drags with the left button, in steps of a screen frame.
    pub(crate) fn drag(&mut self, (x, y): (f64, f64), (dx, dy): (f64, f64)) {
        self.mouse("mouseMoved", (x, y), false);
        self.mouse("mousePressed", (x, y), true);
        for i in 1..=12 {
            let k = f64::from(i) / 12.0;
            self.mouse("mouseMoved", (x + k * dx, y + k * dy), true);
            std::thread::sleep(Duration::from_millis(16));
        }
        self.mouse("mouseReleased", (x + dx, y + dy), true);
    }

    /// Presses and releases the left button.
    pub(crate) fn click(&mut self, at: (f64, f64)) {
        self.mouse("mouseMoved", at, false);
        self.mouse("mousePressed", at, true);
        self.mouse("mouseReleased", at, true);
    }

    /// Presses a key that writes nothing.
    pub(crate) fn key(&mut self, (key, code, number): Key) {
        for kind in ["keyDown", "keyUp"] {
            let mut params =
                json!({"type": kind, "key": key, "code": code, "windowsVirtualKeyCode": number});
            if key == "Enter" && kind == "keyDown" {
                params["text"] = json!("\r");
            }
            self.call("Input.dispatchKeyEvent", params);
        }
    }

    /// Types letters and digits.
    pub(crate) fn write(&mut self, text: &str) {
        for letter in text.chars() {
            let text = letter.to_string();
            let press = json!({"type": "keyDown", "key": text, "text": text});
            self.call("Input.dispatchKeyEvent", press);
            self.call("Input.dispatchKeyEvent", json!({"type": "keyUp", "key": text}));
        }
    }

    /// Lays fingers on the screen, moves or lifts them.
    pub(crate) fn touch(&mut self, kind: &str, fingers: &[(f64, f64)]) {
        let points: Vec<Value> = fingers
            .iter()
            .enumerate()
            .map(|(id, (x, y))| json!({"x": x, "y": y, "id": id}))
            .collect();
        self.call("Input.dispatchTouchEvent", json!({"type": kind, "touchPoints": points}));
    }

    /// Says that nothing failed in the page.
    pub(crate) fn end(&mut self) {
        self.ask("1");
        assert!(self.troubles.is_empty(), "{:?}", self.troubles);
    }
}
