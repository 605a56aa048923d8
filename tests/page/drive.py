"""Drives a real Chromium over the page and the mock, and says what holds.

    python3 tests/page/mock_server.py --slabcast BIN VOLUME -- --up=-y &
    python3 tests/page/drive.py --slabcast BIN VOLUME [--url http://127.0.0.1:7490/]

Or over the page of a master: `slabcast view VOLUME --listen 127.0.0.1:7490 &`, and `--real`. Needs
playwright and axe-playwright-python from PyPI and Debian's chromium. The page forbids `eval`, so
waiting is done here by asking again.
"""

import argparse
import hashlib
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import axe_playwright_python
from PIL import Image
from playwright.sync_api import sync_playwright

AXE = (Path(axe_playwright_python.__file__).parent / "axe.min.js").read_text()
RULES = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
TABS = ["colour", "cut", "view", "save", "shown", "jobs", "workers", "volumes"]
counts = {"passed": 0, "failed": 0}


def claim(name, holds, detail=""):
    """Counts and prints one claim."""
    counts["passed" if holds else "failed"] += 1
    print(f"{'ok    ' if holds else 'FAILED'} {name}{f': {detail}' if detail or not holds else ''}", flush=True)


class Page:
    """A page in a browser of its own."""

    def __init__(self, browser, url, **context):
        self.context = browser.new_context(**context)
        self.page = self.context.new_page()
        self.errors = []
        self.page.on("pageerror", lambda e: self.errors.append(str(e)))
        self.page.on("console", lambda m: m.type == "error" and "Failed to load" not in m.text
                     and "WebSocket" not in m.text and self.errors.append(m.text))
        self.page.goto(url)

    def ask(self, js):
        return self.page.evaluate(js)

    def until(self, js, seconds=90):
        end = time.time() + seconds
        while time.time() < end:
            if self.ask(js):
                return True
            time.sleep(0.05)
        return False

    def rest(self):
        """Waits for the still of the latest view and returns its hash, 8 digits, if it is the file's."""
        time.sleep(0.15)
        if not self.until("slabcast.viewer.atRest"):
            return None
        words = self.ask("document.querySelector('[data-part=hash]').textContent")
        return words[:8] if "=" in words else None

    def change(self, js):
        self.ask(f"(s => slabcast.core.change({js}, ''))(slabcast.core.state)")

    def cam(self):
        return self.ask("slabcast.core.state.cam")

    def stage(self):
        b = self.page.query_selector("#stage").bounding_box()
        return b["x"] + b["width"] / 2, b["y"] + b["height"] / 2

    def drag(self, dx, dy, button="left", steps=12):
        x, y = self.stage()
        mouse = self.page.mouse
        mouse.move(x, y)
        mouse.down(button=button)
        for i in range(steps + 1):
            mouse.move(x + dx * i / steps, y + dy * i / steps)
            time.sleep(0.01)
        mouse.up(button=button)

    def tab(self, name):
        if self.ask(f"document.querySelector('#tab-{name}').getAttribute('aria-selected')") != "true":
            self.page.click(f"#tab-{name}")

    def close(self):
        claim("nothing failed in the page", not self.errors, "; ".join(self.errors)[:300])
        self.context.close()


def mouse_and_keys(p):
    p.rest()
    before = p.cam()
    p.drag(120, 40)
    after = p.cam()
    claim("a drag turns", after["azimuth"] != before["azimuth"] and after["elevation"] > 0)
    p.page.mouse.move(*p.stage())
    p.page.mouse.wheel(0, -300)
    time.sleep(0.2)
    claim("the wheel zooms", p.cam()["height"] < before["height"])
    p.drag(40, 20, "middle")
    claim("the middle button pans", p.cam()["target"] != before["target"])
    window = "slabcast.core.state.tf.opacities.map(p => p[0]).join()"
    was = p.ask(window)
    p.drag(60, 30, "right")
    claim("a right drag is window and level", p.ask(window) != was)
    p.page.keyboard.press("z")
    claim("Z takes it back", p.ask(window) == was)
    p.page.keyboard.press("ArrowRight")
    p.page.keyboard.press("2")
    claim("keys show sides", p.cam()["azimuth"] == 180)
    p.page.keyboard.press("1")
    p.rest()
    x, y = p.stage()
    p.page.mouse.click(x, y)
    claim("a click tells which values made the pixel", p.until("!document.querySelector('#picked').hidden && document.querySelectorAll('#picked li').length > 0", 20))
    target = p.cam()["target"]
    time.sleep(0.5)
    p.page.mouse.dblclick(x + 30, y)
    claim("a double click makes its surface the target", p.until(f"slabcast.core.state.cam.target.join() !== '{','.join(map(str, target))}'", 20))


def strip(p):
    """The line below the picture, while previews and stills take turns."""
    p.page.focus("#stage")
    parts = "JSON.stringify([...document.querySelectorAll('#strip span')].map(e => Math.round(e.getBoundingClientRect().x)))"
    words = "document.querySelector('#strip').textContent"
    p.drag(40, 0)
    p.rest()
    places, seen = {p.ask(parts)}, set()
    x, y = p.stage()
    p.page.mouse.move(x, y)
    p.page.mouse.down()
    for i in range(25):
        p.page.mouse.move(x + 4 * i, y)
        time.sleep(0.04)
        places.add(p.ask(parts))
        seen.add(p.ask(words))
    p.page.mouse.up()
    while not p.ask("slabcast.viewer.atRest"):
        places.add(p.ask(parts))
        seen.add(p.ask(words))
    claim("a preview says its size and how far it is off", any("preview " in w and "/255 off" in w for w in seen), str(sorted(seen)[-1:]))
    claim("a still says how much of it is there", any("% sharp" in w for w in seen))
    claim("nothing moves in the line", len(places) == 1, str(places))


def steps_and_escape(p):
    count = "slabcast.core.steps.past.length"
    before = p.ask(count)
    p.drag(30, 0)
    p.drag(30, 0)
    claim("two drags are two steps", p.ask(count) == before + 2)
    p.page.keyboard.press("1")
    now = p.ask(count)
    p.page.keyboard.press("1")
    claim("what changes nothing is no step", p.ask(count) == now)
    p.tab("view")
    for _ in range(2):
        p.page.keyboard.press("Escape")
    claim("Escape closes the panel", p.ask("document.querySelector('#panel').hidden"))


def curve(p):
    p.tab("colour")
    n = lambda: p.ask("[slabcast.core.state.tf.opacities.length, slabcast.core.state.tf.colors.length].join()")
    first = n()
    b = p.page.query_selector(".tf-view").bounding_box()
    at = lambda u, v: (b["x"] + b["width"] * u, b["y"] + b["height"] * v)
    p.page.mouse.click(*at(0.65, 0.5))
    claim("a press adds a point", n() != first)
    time.sleep(0.5)
    p.page.mouse.dblclick(*at(0.65, 0.5))
    claim("a double press removes it", n() == first)
    p.page.mouse.dblclick(*at(0.4, 0.82))
    claim("a double press on the strip adds a colour", n() != first)
    p.page.focus(".tf-view")
    p.page.keyboard.press("Delete")
    claim("Delete removes it", n() == first)
    p.page.click("text=All points as a table")
    cell = p.page.locator("[aria-label='Opacity of point 1']")
    cell.fill("0.125")
    cell.press("Enter")
    claim("the table changes the curve", p.ask("slabcast.core.state.tf.opacities[0][1]") == 0.125)
    p.page.click("text=All points as a table")
    fields = {name: p.page.locator(f"#panel-colour label:has-text('{name}') input").first for name in ("From", "To", "Width", "Level")}
    fields["Level"].fill("100")
    fields["Level"].press("Enter")
    of = {name: float(f.input_value()) for name, f in fields.items()}
    claim("the window has a level and a width", abs(of["From"] + of["To"] - 200) < 1 and abs(of["To"] - of["From"] - of["Width"]) < 0.1, str(of))
    fields["Level"].fill("7")
    fields["Level"].press("Escape")
    claim("Escape puts a number back", float(fields["Level"].input_value()) == of["Level"])


def same_pixels(p, slabcast, volume):
    """What the page shows is what its command draws, byte for byte."""
    p.page.keyboard.press("Escape")
    cases = [
        ("turned", "{cam: {...s.cam, azimuth: -63.37, elevation: 22.11}}"),
        ("moved and leaning", "{cam: {...s.cam, roll: 25, target: s.cam.target.map(x => x + 7)}}"),
        ("perspective", "{cam: {...s.cam, projection: 'persp', fov: 40, roll: 0}}"),
        ("cut", "{crop: [[null, slabcast.core.volume.box[1][0] * 0.5], [null, null], [null, null]]}"),
        ("other colours and ground", "{background: '#204060', tf: {...s.tf, colors: s.tf.colors.map(c => [c[0], c[3], c[2], c[1]])}}"),
    ]
    p.tab("save")
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / Path(volume).name).symlink_to(Path(volume).resolve())
        for name, patch in cases:
            p.change(patch)
            shown = p.rest()
            words = p.ask("document.querySelector('#panel-save pre').textContent").replace("slabcast render", f"{Path(slabcast).resolve()} render --force")
            made = subprocess.run(["sh", "-c", words], cwd=folder, capture_output=True, text=True)
            drawn = made.stderr[-200:]
            if made.returncode == 0:
                pixels = Image.open(Path(folder) / "picture.png").convert("RGBA").tobytes()
                drawn = hashlib.sha256(pixels).hexdigest()[:8]
            claim(f"the command draws the same bytes, {name}", shown is not None and shown == drawn, f"{shown} {drawn}")


def address(p):
    shown = p.rest()
    time.sleep(1.2)
    p.page.reload()
    claim("a reload draws the same bytes", p.rest() == shown, str(shown))
    p.page.focus("#stage")
    p.page.keyboard.press("1")
    p.rest()
    time.sleep(1.3)
    p.page.keyboard.press("3")
    p.rest()
    time.sleep(1.3)
    p.ask("history.back()")
    claim("back is the view before", p.until("slabcast.core.state.cam.azimuth === 0", 5))
    p.rest()


def faults(p, url):
    fault = lambda what: urllib.request.urlopen(f"{url}mock/{what}").read()
    fault("stall?s=3")
    p.drag(100, 10)
    want = p.cam()
    claim("after a stall the last view arrives", p.rest() is not None and p.cam() == want)
    fault("drop")
    claim("a lost connection is seen and dialled again", p.until("document.body.dataset.link !== 'live'", 5) and p.until("document.body.dataset.link === 'live'", 15))
    claim("and the view is the same", p.rest() is not None and p.cam() == want)
    fault("jobs?n=5000")
    p.tab("jobs")
    claim("5000 jobs are few elements", p.until("document.querySelector('#panel-jobs .aside').textContent.includes('5000')", 20) and p.ask("document.querySelectorAll('.job').length") < 60)


def accessible(p, name):
    p.context.new_cdp_session(p.page).send("Page.setBypassCSP", {"enabled": True})
    p.page.reload()
    p.rest()
    p.page.add_script_tag(content=AXE)
    found = []
    for tab in TABS:
        p.tab(tab)
        time.sleep(0.5)
        violations = p.ask(f"axe.run(document, {{runOnly: {RULES}}}).then(r => r.violations.map(v => v.id + ' ' + v.nodes[0].html.slice(0, 80)))")
        found += [f"{tab} {v}" for v in violations]
        if p.ask("document.documentElement.scrollWidth > innerWidth"):
            found.append(f"{tab} is wider than the screen")
    claim(f"axe finds nothing, {name}", not found, "; ".join(found)[:400])


def touch(p):
    p.rest()
    cdp = p.context.new_cdp_session(p.page)
    send = lambda kind, points: cdp.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]})
    before = p.cam()
    send("touchStart", [(150, 250)])
    for i in range(10):
        send("touchMove", [(150 + 7 * i, 250)])
    send("touchEnd", [])
    turned = p.cam()
    claim("one finger turns", turned["azimuth"] != before["azimuth"] and turned["height"] == before["height"])
    send("touchStart", [(120, 250), (240, 250)])
    for i in range(10):
        send("touchMove", [(120 - 5 * i, 250 - 4 * i), (240 + 5 * i, 250 + 4 * i)])
    send("touchEnd", [])
    pinched = p.cam()
    claim("two fingers zoom and lean", pinched["height"] < turned["height"] and pinched["roll"] > 0)
    claim("and it comes to rest", p.rest() is not None)


def upload(p):
    p.tab("volumes")
    files = "#panel-volumes input[type=file]"
    p.page.set_input_files(files, [{"name": "note.txt", "mimeType": "text/plain", "buffer": b"hello"}])
    claim("a refused upload says why", p.until("document.querySelector('.upload .bad')?.textContent.includes('no volume file')", 10))
    p.page.set_input_files(files, [{"name": "new.nrrd", "mimeType": "", "buffer": bytes(1_500_000)}])
    claim("an upload goes through in chunks", p.until("[...document.querySelectorAll('.volume b')].some(b => b.textContent === 'new.nrrd')", 20))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--url", default="http://127.0.0.1:7490/")
    parser.add_argument("--slabcast", default="slabcast")
    parser.add_argument("--chromium", default="/usr/bin/chromium")
    parser.add_argument("--real", action="store_true", help="the page is a master's: leave out what a mock alone can do")
    parser.add_argument("volume")
    args = parser.parse_args()
    sizes = {"360x740": (360, 740), "1280x800": (1280, 800), "3840x2160": (3840, 2160)}
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=args.chromium, args=["--no-sandbox"])
        p = Page(browser, args.url, viewport={"width": 900, "height": 620}, color_scheme="dark")
        requests = p.ask("performance.getEntriesByType('resource').length + 1")
        claim("at most 8 requests", requests <= 8, str(requests))
        for part in (mouse_and_keys, curve, steps_and_escape, *([] if args.real else [strip])):
            part(p)
        same_pixels(p, args.slabcast, args.volume)
        address(p)
        if not args.real:
            faults(p, args.url)
            upload(p)
        p.close()
        phone = Page(browser, args.url, viewport={"width": 360, "height": 740}, has_touch=True, device_scale_factor=2)
        touch(phone)
        phone.close()
        for name, (w, h) in sizes.items():
            for scheme in ("dark", "light"):
                if w == 3840 and scheme == "light":
                    continue
                q = Page(browser, args.url, viewport={"width": w, "height": h}, color_scheme=scheme)
                q.rest()
                accessible(q, f"{name} {scheme}")
                q.close()
        browser.close()
    print(f"{counts['passed']} passed, {counts['failed']} failed")
    return counts["failed"] > 0


if __name__ == "__main__":
    sys.exit(main())
