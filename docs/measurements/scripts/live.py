"""Measures the live page in a real Chromium and prints a Markdown table.

    python3 docs/measurements/scripts/live.py SLABCAST VOLUME [--minutes 10] [--views 100] [-- --up=-y]

Needs playwright from PyPI and Debian's chromium. Starts `SLABCAST view VOLUME` with the flags behind
`--`. Times are taken inside the page, by its own clock: from the time stamp of the event that moved
the hand to the end of the screen frame in which the picture of that very view was drawn. Events are
sent by the browser's protocol at 60 a second. The browser takes its share of the same processors; its
process and this one's are in every figure.
"""

import argparse
import asyncio
import base64
import hashlib
import json
import os
import random
import statistics
import struct
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

from playwright.sync_api import sync_playwright

EDGE = 512
FRAME_S = 1 / 60
SLOW_BYTES_S = 64_000 // 8
VIEWERS = 32
# Edge of the pictures of many viewers: as many as these ask two processors for less than they can.
CROWD_EDGE = 256

# When the first picture was on the screen, in milliseconds after the page was asked for.
FIRST = """
globalThis.firstMs = null;
const look = () => {
  if (globalThis.slabcast?.core.done) { firstMs = performance.now(); return; }
  requestAnimationFrame(look);
};
requestAnimationFrame(look);
"""

# Each pass that was painted: what of, how long after the hand, bytes.
HOOK = """(() => {
  const { core } = slabcast;
  let input = 0;
  const sent = { view: new Map(), scene: new Map() };
  globalThis.passes = [];
  addEventListener("pointermove", (e) => { if (e.buttons) input = e.timeStamp; }, true);
  const send = core.wire.send.bind(core.wire);
  core.wire.send = (m) => {
    if (m.type === "view") sent.view.set(m.seq, [input, m.moving]);
    if (m.type === "scene") sent.scene.set(m.rev, [input, m.moving]);
    return send(m);
  };
  core.on("painted", (m) => {
    const drawn = performance.now();
    const of = [sent.view.get(m.seq), sent.scene.get(m.scene)].filter(Boolean).sort((a, b) => b[0] - a[0])[0];
    const entry = { seq: m.seq, rev: m.scene, pass: m.pass, size: m.size, level: m.level, bytes: m.bytes, ms: m.ms,
      hand: of?.[1] ?? false, input: of?.[0] ?? 0, drawn, shown: 0 };
    passes.push(entry);
    // Older ones are of no use, and would grow the heap that is measured.
    for (const seq of sent.view.keys()) if (seq < m.seq) sent.view.delete(seq);
    for (const rev of sent.scene.keys()) if (rev < m.scene) sent.scene.delete(rev);
    requestAnimationFrame(() => {
      const after = new MessageChannel();
      after.port1.onmessage = () => { entry.shown = performance.now(); };
      after.port2.postMessage(0);
    });
  });
})()"""


class View:
    """A `slabcast view`, and how to ask the system about it."""

    def __init__(self, slabcast, volume, flags):
        self.slabcast, self.volume = slabcast, volume
        self.process = subprocess.Popen([slabcast, "view", volume, *flags], stdout=subprocess.PIPE,
                                        stderr=subprocess.DEVNULL, text=True)
        self.url = self.process.stdout.readline().strip()

    def rss_mib(self):
        with open(f"/proc/{self.process.pid}/status") as f:
            return next(int(line.split()[1]) / 1024 for line in f if line.startswith("VmRSS"))

    def cpu_s(self):
        total = 0
        for task in os.listdir(f"/proc/{self.process.pid}/task"):
            with open(f"/proc/{self.process.pid}/task/{task}/schedstat") as f:
                total += int(f.read().split()[0])
        return total / 1e9

    def end(self):
        self.process.kill()
        self.process.wait()


class Page:
    """A page whose picture is EDGE pixels square."""

    def __init__(self, browser, view):
        self.context = browser.new_context(viewport={"width": 1000, "height": 700}, color_scheme="dark")
        self.page = self.context.new_page()
        self.page.add_init_script(FIRST)
        self.slabcast, self.volume = view.slabcast, view.volume
        self.page.goto(view.url)
        self.until("slabcast.core.done")
        w, h = self.ask("slabcast.core.size")
        self.page.set_viewport_size({"width": 1000 + EDGE - w, "height": 700 + EDGE - h})
        self.until(f"slabcast.core.size.join() === '{EDGE},{EDGE}'")
        self.rest()
        self.cdp = self.context.new_cdp_session(self.page)
        self.ask(HOOK)

    def ask(self, js):
        return self.page.evaluate(js)

    def until(self, js, seconds=60):
        end = time.time() + seconds
        while not self.ask(f"Boolean({js})"):
            if time.time() > end:
                sys.exit(f"in {seconds} s not: {js}")
            time.sleep(0.02)

    def rest(self):
        """Waits for the still of the latest view; returns its hash, or nothing if it is not the master's."""
        time.sleep(0.1)
        self.until("slabcast.viewer.atRest")
        words = self.ask("document.querySelector('[data-part=hash]').textContent")
        return words[:8] if "=" in words else None

    def change(self, js):
        self.ask(f"(s => slabcast.core.change({js}, ''))(slabcast.core.state)")

    def middle(self, selector, u=0.5, v=0.5):
        b = self.page.query_selector(selector).bounding_box()
        return b["x"] + b["width"] * u, b["y"] + b["height"] * v

    def colour(self, preset):
        """Colours by a preset of measurements, which the page does not offer, and waits for the picture."""
        words = subprocess.run([self.slabcast, "tf", preset, self.volume], capture_output=True, text=True, check=True)
        self.change(f"{{tf: {words.stdout}, preset: null}}")
        self.rest()

    def event(self, kind, x, y, buttons=1):
        self.cdp.send("Input.dispatchMouseEvent", {"type": kind, "x": x, "y": y, "button": "left",
                                                   "buttons": buttons, "clickCount": 1})

    def drag(self, start, place, seconds):
        """Holds the left button and follows `place(t)` for so long; returns the passes that were painted."""
        self.ask("passes.length = 0")
        self.event("mouseMoved", *start, 0)
        self.event("mousePressed", *start)
        begin, i = time.perf_counter(), 0
        while (t := time.perf_counter() - begin) < seconds:
            self.event("mouseMoved", *place(t))
            i += 1
            time.sleep(max(0, begin + i * FRAME_S - time.perf_counter()))
        self.event("mouseReleased", *place(seconds), 0)
        self.rest()
        time.sleep(0.1)
        return self.ask("passes")

    def turn(self, seconds):
        x, y = self.middle("#stage")
        return self.drag((x, y), lambda t: (x + 200 * wave(t, 4), y + 40 * wave(t, 7)), seconds)

    def steps(self, n):
        """Moves the hand once and waits for rest, `n` times; returns the passes."""
        x, y = self.middle("#stage")
        self.event("mouseMoved", x, y, 0)
        self.event("mousePressed", x, y)
        self.event("mouseMoved", x + 6, y)
        self.rest()
        self.ask("passes.length = 0")
        for i in range(n):
            self.event("mouseMoved", x + 6 + (i % 2 * 2 - 1) * (20 + i % 7), y)
            self.rest()
        self.event("mouseReleased", x, y, 0)
        time.sleep(0.2)
        return self.ask("passes")


def wave(t, period):
    """A hand that goes to and fro with an even speed: -1 to 1."""
    k = t / period % 1
    return 4 * k if k < 0.25 else 2 - 4 * k if k < 0.75 else 4 * k - 4


def percentiles(values):
    """Median and 95th percentile."""
    if not values:
        return float("nan"), float("nan")
    values = sorted(values)
    return statistics.median(values), values[min(len(values) - 1, int(0.95 * len(values)))]


def late(passes):
    return [p["shown"] - p["input"] for p in passes if p["shown"] and p["input"]]


def whole(p):
    return p["level"] == 0 and p["size"] == [EDGE, EDGE]


rows = []


def row(what, goal, there, note=""):
    rows.append(f"| {what} | {goal} | {there} | {note} |")
    print(rows[-1], file=sys.stderr, flush=True)


def two(values):
    a, b = percentiles(values)
    return f"{a:.1f}, {b:.1f}"


def cost_of_the_page(browser, view):
    total = 0
    for name in ("", "main.css", "icon.svg", "app.js"):
        ask = urllib.request.Request(view.url + name, headers={"Accept-Encoding": "gzip"})
        total += len(urllib.request.urlopen(ask).read())
    first, requests = [], 0
    for _ in range(20):
        context = browser.new_context(viewport={"width": 842, "height": 584})
        page = context.new_page()
        page.add_init_script(FIRST)
        page.goto(view.url)
        while (ms := page.evaluate("globalThis.firstMs")) is None:
            time.sleep(0.01)
        first.append(ms)
        # The page itself and its socket are not among its resources.
        requests = page.evaluate("performance.getEntriesByType('resource').length") + 2
        context.close()
    row("page, gzip (KiB)", "≤ 80", f"{total / 1024:.1f}")
    row("requests to the first picture, the socket among them", "≤ 8", requests)
    row("first picture after the page's request, 20 loads (ms)", "400", two(first), "median, p95")


def turning(page, seconds):
    page.colour("peer-opaque")
    passes = page.turn(seconds)
    moving = [p for p in passes if p["hand"]]
    sharp = [p for p in moving if whole(p)]
    n = len(moving) / seconds
    note = f"{len(moving)} pictures, {n:.0f} a second, {len(sharp)} of them whole and at full level"
    row("opaque, drag → sharp painted, hand moving (ms)", "45, 70", two(late(sharp)), note)
    row("drag → any picture painted, hand moving (ms)", "", two(late(moving)))
    sent = [p["bytes"] / 1024 for p in moving if p["pass"] == "moving"]
    if sent:
        row("bytes of a moving frame (KiB)", "≤ 20", two(sent), "median, p95")
    still = [p["bytes"] / 1024 for p in passes if p["pass"] == "still"]
    row("bytes of a still (KiB)", "≤ 100", two(still), f"{len(still)} of them")
    draw = [p["ms"]["draw"] for p in moving]
    encode = [p["ms"]["encode"] for p in moving]
    row("of which drawing; encoding, as the master says (ms)", "", f"{two(draw)}; {two(encode)}")
    passes = page.steps(60)
    firsts = {}
    for p in passes:
        firsts.setdefault(p["seq"], p)
    row("one step of the hand → first picture painted (ms)", "", two(late([p for p in firsts.values() if p["hand"]])))
    # The still of a hand that rests shows the view that `settle` sent, whose input is the same event.
    row("one step of the hand → lossless picture painted (ms)", "",
        two(late([p for p in passes if p["pass"] == "still"])), "of which 80 wait for the hand")


def semi(page, seconds):
    page.colour("peer-semi")
    passes = page.turn(seconds)
    moving = [p for p in passes if p["hand"]]
    sizes = sorted({(tuple(p["size"]), p["level"]) for p in moving})
    note = f"{len(moving) / seconds:.0f} a second; size and level " + ", ".join(f"{s[0]}x{s[1]} {l}" for s, l in sizes[:6])
    row("translucent, drag → preview painted, hand moving (ms)", "60", two(late(moving)), note)
    passes = page.steps(30)
    row("translucent, one step → sharp painted (ms)", "300", two(late([p for p in passes if p["pass"] == "still"])),
        "of which 80 wait for the hand")


def colouring(page, seconds):
    tab = "#tab-colour"
    if page.ask(f"document.querySelector('{tab}').getAttribute('aria-selected')") != "true":
        page.page.click(tab)
    start = page.middle(".tf-view .points > :nth-child(3)")
    passes = page.drag(start, lambda t: (start[0] + 20 + 20 * wave(t, 3), start[1]), seconds)
    moving = [p for p in passes if p["hand"]]
    row("transfer function's point dragged → painted (ms)", "100 (p95)", two(late(moving)),
        f"{len(moving) / seconds:.0f} a second")


def endurance(browser, view, minutes):
    page = Page(browser, view)
    found = []
    page.cdp.send("HeapProfiler.enable")
    begin = time.time()
    page.turn(5)
    while True:
        page.ask("passes.length = 0")
        page.cdp.send("HeapProfiler.collectGarbage")
        used = page.cdp.send("Runtime.getHeapUsage")["usedSize"] / 2**20
        found.append((time.time() - begin, used, view.rss_mib()))
        if time.time() - begin > minutes * 60:
            break
        page.turn(min(30, max(5, minutes * 15)))
    fmt = lambda k: f"{found[0][k]:.1f}, {found[len(found) // 2][k]:.1f}, {found[-1][k]:.1f}"
    row(f"page's heap, {minutes:g} minutes of turning (MiB)", "flat", fmt(1), "after 5 s, half, all")
    row("memory of `slabcast view` (RSS, MiB)", "flat", fmt(2), "after 5 s, half, all")
    page.context.close()


class Socket:
    """A viewer without a browser: what WebSocket 13 needs, and no more."""

    def __init__(self, url, slow=False):
        self.host, self.slow, self.times, self.seq, self.sent = url.split("/")[2], slow, [], 0, {}
        self.camera, self.first = None, False

    async def dial(self):
        host, port = self.host.split(":")
        # A slow reader's system holds little for it, so that the master feels it.
        self.reader, self.writer = await asyncio.open_connection(host, int(port), limit=16384 if self.slow else 2**20)
        if self.slow:
            self.writer.get_extra_info("socket").setsockopt(1, 8, 16384)
        key = base64.b64encode(os.urandom(16)).decode()
        self.writer.write((f"GET /v1/live HTTP/1.1\r\nHost: {self.host}\r\nOrigin: http://{self.host}\r\nUpgrade: websocket\r\n"
                           f"Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n\r\n").encode())
        await self.reader.readuntil(b"\r\n\r\n")
        self.say({"type": "hello", "protocol": [1, 1], "size": [CROWD_EDGE] * 2, "codecs": ["jpeg", "webp", "png"]})

    def frame(self, opcode, data):
        n = len(data)
        head = bytes([128 | opcode]) + (bytes([128 | n]) if n < 126 else bytes([254]) + struct.pack(">H", n))
        self.writer.write(head + bytes(4) + data)

    def say(self, message):
        self.frame(1, json.dumps(message).encode())

    async def take(self, n):
        """Bytes of the socket; a slow reader takes its time."""
        if not self.slow:
            return await self.reader.readexactly(n)
        got = b""
        while len(got) < n:
            part = await self.reader.read(min(n - len(got), 800))
            if not part:
                raise ConnectionError
            got += part
            await asyncio.sleep(len(part) / SLOW_BYTES_S)
        return got

    async def read(self):
        while True:
            a, b = await self.take(2)
            n = b & 127
            if n > 125:
                n = int.from_bytes(await self.take(2 if n == 126 else 8), "big")
            data = await self.take(n)
            if a & 15 == 9:
                self.frame(10, data)
            if a & 15 == 8:
                raise ConnectionError(data)
            if a & 15 != 1:
                continue
            m = json.loads(data)
            if m["type"] == "volume":
                self.camera = m["home"]["camera"]
            if m["type"] == "done":
                self.first = True
                self.say({"type": "ack", "seq": m["seq"], "scene": m["scene"], "pass": m["pass"], "painted_ms": 5})
                at = self.sent.pop(m["seq"], None)
                if at:
                    self.times.append((time.perf_counter() - at) * 1000)

    async def turn(self, seconds, every, everybody):
        """Waits for the first picture, of everybody, and then turns. Says whether the connection was lost."""
        reading = asyncio.ensure_future(self.read())
        while not self.first:
            if reading.done():
                reading.result()
            await asyncio.sleep(0.02)
        await everybody.wait()
        await asyncio.sleep(random.random() * every)
        end = time.perf_counter() + seconds
        while time.perf_counter() < end and not reading.done():
            self.seq += 1
            self.camera["azimuth"] = self.camera.get("azimuth", 0) + 3
            self.sent[self.seq] = time.perf_counter()
            self.say({"type": "view", "seq": self.seq, "camera": self.camera, "size": [CROWD_EDGE] * 2, "moving": True})
            await asyncio.sleep(every)
        ended = reading.done()
        reading.cancel()
        self.writer.close()
        return ended


async def crowd(url, slow, seconds, every):
    """Milliseconds from a view sent to its picture there, of all viewers but the last one, and of the
    last, which sends ten views a second and may read slowly."""
    viewers = [Socket(url) for _ in range(VIEWERS - 1)] + [Socket(url, slow=slow)]
    for v in viewers:
        await v.dial()
    everybody = asyncio.Barrier(len(viewers))
    ended = await asyncio.gather(*(v.turn(seconds, 0.1 if v is viewers[-1] else every, everybody) for v in viewers))
    if any(ended):
        print(f"{sum(ended)} viewers lost their connection", file=sys.stderr)
    return [t for v in viewers[:-1] for t in v.times], viewers[-1].times


def viewers(view, seconds, every):
    before = view.rss_mib()
    # One after the other, twice, so that what else the machine does meets both.
    without, with_slow, slow = [], [], []
    for _ in range(2):
        without += asyncio.run(crowd(view.url, False, seconds, every))[0]
        fast, of_slow = asyncio.run(crowd(view.url, True, seconds, every))
        with_slow += fast
        slow += of_slow
    a, b = percentiles(without), percentiles(with_slow)
    row(f"{VIEWERS} viewers of {CROWD_EDGE}x{CROWD_EDGE}, each a view every {every:g} s and its still, one ten a second; view sent → picture there (ms)", "", f"{a[0]:.1f}, {a[1]:.1f}",
        f"{len(without)} pictures")
    row("the same, that one reading 64 kbit/s: the others", "p95 + 10 %", f"{b[0]:.1f}, {b[1]:.1f}",
        f"p95 {100 * (b[1] / a[1] - 1):+.0f} %; the slow one saw {len(slow)} pictures")
    row(f"memory of {VIEWERS} viewers (RSS, MiB a viewer)", "≤ 1", f"{(view.rss_mib() - before) / VIEWERS:.2f}")


def same_bytes(page, slabcast, volume, n):
    """What the page shows at rest, and what its command draws."""
    rand = random.Random(54)
    page.page.click("#tab-save")
    same = 0
    presets = page.ask("slabcast.core.volume.presets.filter(p => p.share > 0.001).map(p => p.name)")
    names = [p for p in presets if not p.startswith("peer")]
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / Path(volume).name).symlink_to(Path(volume).resolve())
        for i in range(n):
            patch = [f"cam: {{...s.cam, azimuth: {rand.uniform(-180, 180):.3f}, elevation: {rand.uniform(-80, 80):.3f}, "
                     f"roll: {rand.choice([0, 0, 17.5])}, projection: '{rand.choice(['ortho', 'persp'])}'}}"]
            if i % 5 == 1:
                patch.append(f"preset: '{(name := rand.choice(names))}', "
                             f"tf: {{...s.tf, ...slabcast.core.volume.presets.find(p => p.name === '{name}').tf}}")
            if i % 7 == 2:
                patch.append(f"crop: [[null, slabcast.core.volume.box[1][0] * {rand.uniform(0.4, 0.9):.3f}], [null, null], [null, null]]")
            if i % 7 == 5:
                patch.append(f"crop: [[null, null], [null, null], [null, null]], background: '#{rand.randrange(1 << 24):06x}'")
            page.change("{" + ", ".join(patch) + "}")
            shown = page.rest()
            words = page.ask("document.querySelector('#panel-save pre').textContent")
            words = words.replace("slabcast render", f"{slabcast} render --force")
            made = subprocess.run(["sh", "-c", words], cwd=folder, capture_output=True, text=True)
            drawn = pixels_hash(Path(folder) / "picture.png") if made.returncode == 0 else made.stderr[-300:]
            same += shown is not None and shown == drawn
            if shown != drawn:
                print(f"view {i}: {shown} on the page, {drawn} by the command\n{words}", file=sys.stderr)
    row("pictures at rest with the bytes of their command", f"{n} of {n}", f"{same} of {n}",
        "random cameras, presets, cuts, backgrounds")


def pixels_hash(file):
    from PIL import Image
    return hashlib.sha256(Image.open(file).convert("RGBA").tobytes()).hexdigest()[:8]


def main():
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[:own.index("--")], own[own.index("--") + 1:]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("slabcast")
    parser.add_argument("volume")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--seconds", type=float, default=20, help="of each drag [20]")
    parser.add_argument("--minutes", type=float, default=10, help="of endurance [10]")
    parser.add_argument("--views", type=int, default=100, help="compared with the command [100]")
    parser.add_argument("--every", type=float, default=4.0, help="seconds between views of one of many [4]")
    parser.add_argument("--only", default="page,turn,semi,colour,bytes,viewers,endurance")
    args = parser.parse_args(own)
    slabcast = str(Path(args.slabcast).resolve())
    only = args.only.split(",")
    volume = str(Path(args.volume).resolve())
    view = View(slabcast, volume, flags)
    try:
        with sync_playwright() as play:
            browser = play.chromium.launch(executable_path=args.chromium, args=["--no-sandbox"])
            if "page" in only:
                cost_of_the_page(browser, view)
            if {"turn", "semi", "colour", "bytes"} & set(only):
                page = Page(browser, view)
                if "turn" in only:
                    turning(page, args.seconds)
                if "colour" in only:
                    colouring(page, args.seconds)
                if "bytes" in only:
                    same_bytes(page, slabcast, volume, args.views)
                page.context.close()
            if "semi" in only:
                page = Page(browser, view)
                semi(page, args.seconds)
                page.context.close()
            if "endurance" in only:
                endurance(browser, view, args.minutes)
            browser.close()
        if "viewers" in only:
            viewers(view, args.seconds, args.every)
    finally:
        view.end()
    print("| | wanted | there is | |\n|---|--:|--:|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
