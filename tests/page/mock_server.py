"""A stand-in for a master's page: serves master/page and speaks docs/reference/live.md.

    python3 tests/page/mock_server.py --slabcast target/debug/slabcast VOLUME [flags of slabcast]

Stills are drawn by `slabcast render` from the page's own path and colours, so what the page shows is
what the command draws. Moving pictures are rays through every second voxel in numpy, by a camera
written here a second time. Needs numpy, Pillow and aiohttp. For faults: GET mock/stall?s=6,
mock/drop, mock/delay?ms=200, mock/jobs?n=5000, mock/notice.
"""

import argparse
import asyncio
import hashlib
import io
import json
import math
import random
import struct
import tempfile
import time
from pathlib import Path

import numpy as np
from aiohttp import WSMsgType, web
from PIL import Image

import bundle
from mock_rays import Rays

CSP = ("default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
       "connect-src 'self' ws://{host} wss://{host}; base-uri 'none'; form-action 'none'; "
       "frame-ancestors 'self'")
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
MAPS = ["viridis", "inferno", "magma", "plasma", "cividis", "turbo", "cool-warm", "greys"]
STILL, FIRST, THUMB = 1, 2, 4


class Master:
    """What all sessions share: the volume, jobs, workers, faults."""

    def __init__(self, args):
        self.args = args
        self.sessions = set()
        self.delay = 0.0
        self.stalled_until = 0.0
        self.uploads = {}
        self.scratch = Path(tempfile.mkdtemp(prefix="slabcast-mock-"))
        self.drawing = asyncio.Lock()
        self.states = {}

    async def call(self, *words):
        """Runs slabcast and returns its standard output; raises with its last line of errors."""
        process = await asyncio.create_subprocess_exec(
            self.args.slabcast, *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE)
        try:
            out, err = await process.communicate()
        except asyncio.CancelledError:
            process.kill()
            await process.wait()
            raise
        if process.returncode:
            raise RuntimeError(err.decode().strip().split("\n")[-1])
        return out

    async def load(self):
        """Reads the volume's description, presets and samples."""
        file, flags = self.args.volume, self.args.flags
        plain = [f for f in flags if not f.startswith(("--up", "--front"))]
        info = json.loads(await self.call("info", file, "--json", *plain))
        cache = Path(tempfile.gettempdir()) / f"slabcast-mock-{info['digest'][:12]}.json"
        if cache.exists():
            presets = json.loads(cache.read_text())
        else:
            entries = [(p["name"], p["for"], p["share"]) for p in info["presets"]]
            names = {name for name, *_ in entries}
            entries += [(m, "colour map, as fog", 0) for m in MAPS if m not in names]
            presets = []
            for name, words, share in entries:
                tf = json.loads(await self.call("tf", name, file, *plain))
                presets.append({"name": name, "for": words, "share": share, "map": name in MAPS, "tf": tf})
            cache.write_text(json.dumps(presets))
        up, front = "+z", "+y"
        for flag in flags:
            if flag.startswith("--up="):
                up = flag[5:]
                front = "+z" if up[-1] == "y" else "+y"
            if flag.startswith("--front="):
                front = flag[8:]
        lo, hi = info["presets_by"]["range"]
        box = info["world_box"]
        middle = [(a + b) / 2 for a, b in zip(*box)]
        extent = max(b - a for a, b in zip(*box))
        self.volume = {
            "type": "volume", "name": info["name"], "digest": info["digest"], "file": info["name"],
            "dims": info["dims"], "steps": info["steps"], "box": box, "unit": "mm",
            "anatomical": info["anatomical"], "up": up, "front": front,
            "sample_kind": info["stored_as"], "range": [lo, hi], "core": [lo, hi],
            "histogram": {"from": lo, "to": hi, "counts": info["values"]["histogram"]},
            "gradients": None, "hounsfield": False, "nan": 0, "presets": presets,
            "home": {"camera": {"azimuth": 20, "elevation": 0, "target": middle, "height": extent}, "tf": "auto"},
        }
        samples = self.scratch / "samples.nrrd"
        await self.call("convert", file, str(samples), *plain)
        self.rays = Rays(samples, info, up, front)
        now = time.time() * 1000
        self.jobs = {j["job"]: j for j in (job(i, now, info["name"]) for i in range(40))}
        self.workers = {w["worker"]: w for w in (worker(i, now) for i in range(6))}
        self.volumes = {info["name"]: {
            "name": info["name"], "digest": info["digest"], "dims": info["dims"], "sample_kind": info["stored_as"],
            "bytes": math.prod(info["dims"]), "origin": "given", "in_memory": True, "problem": ""}}
        for name, problem in (("knee_pd.nii.gz", ""), ("thorax_ct_venous_phase_1mm_B30f.nrrd", ""),
                              ("broken.nrrd", "header line 4: `sizes` has 2 numbers; give 3")):
            self.volumes[name] = {"name": name, "digest": "", "dims": [], "sample_kind": "", "bytes": 31_457_280,
                                  "origin": "folder", "in_memory": False, "problem": problem}

    async def live(self):
        """Makes jobs and workers change, twice a second."""
        while True:
            await asyncio.sleep(0.5)
            changed = []
            for j in list(self.jobs.values())[:60]:
                if j["state"] == "running":
                    j["frames_done"] = min(j["frames_done"] + 1, j["frames_total"])
                    j["left_ms"] = (j["frames_total"] - j["frames_done"]) * 500
                    if j["frames_done"] == j["frames_total"]:
                        done = {"state": "done", "finished_ms": time.time() * 1000}
                        if j["format"] == "mp4":
                            done["result"] = {"name": f"{j['job']}.mp4", "format": "mp4", "bytes": 2_400_000}
                        j.update(done)
                    changed.append(j)
            for w in self.workers.values():
                w["busy"] = random.randint(0, w["threads"]) if not w["in_reserve"] else 0
            for s in list(self.sessions):
                if "jobs" in s.watched and changed:
                    await s.send({"type": "jobs", "changed": changed, "total": len(self.jobs)})
                if "workers" in s.watched:
                    await s.send({"type": "workers", "changed": list(self.workers.values())})


def job(i, now, volume):
    """Returns a job that was submitted `i` minutes ago."""
    states = ["running", "queued", "done", "failed", "done", "done", "cancelled", "done"]
    state = states[i] if i < len(states) else "done"
    total = [180, 36, 1, 300, 72][i % 5]
    done = {"running": 63, "queued": 0, "failed": 120, "cancelled": 9}.get(state, total)
    return {"job": f"job-{400 - i}", "key": f"key-{i}", "owner": ["mira", "jonas", "li", ""][i % 4], "state": state,
            "message": "tile 3 of frame 120: no worker could draw it" if state == "failed" else "",
            "frames_done": min(done, total), "frames_total": total, "frames_failed": 1 if state == "failed" else 0,
            "size": [1080, 1080], "format": "mp4" if i % 3 == 0 else "png", "volume": volume,
            "submitted_ms": now - i * 61_000, "finished_ms": now - i * 50_000 if state in ("done", "failed", "cancelled") else None,
            "left_ms": 58_000 if state == "running" else None,
            "waits_for": "job-400 comes first" if state == "queued" else "",
            "result": {"name": f"job-{400 - i}.mp4", "format": "mp4", "bytes": 2_400_000} if state == "done" and i % 3 == 0 else None}


def worker(i, now):
    """Returns worker number `i`."""
    return {"worker": f"w{i}", "name": f"node{i:02}/7{i}31", "address": f"10.0.3.{10 + i}:50{i}44", "threads": 16, "busy": 12,
            "simd": "avx2", "memory_bytes": 8 << 30, "held_bytes": (i + 1) * 300_000_000, "tasks_lent": 4,
            "tasks_done": 12_000 + i, "silent_ms": 5200 if i == 3 else 80, "joined_ms": now - 3.6e6 * (i + 1),
            "in_reserve": i == 5, "rtt_ms": 0.4 + i / 10, "damaged": 0,
            "last_error": {"at_ms": now - 400_000, "text": "link lost: connection reset"} if i == 3 else None}


class Session:
    """One page: its slot, and the passes in flight."""

    def __init__(self, master, socket):
        self.master, self.socket = master, socket
        self.view = self.scene = None
        self.watched = set()
        self.inflight = 0
        self.wake = asyncio.Event()
        self.drawn = None
        self.still_task = None
        self.changed_at = 0.0
        self.preview = None
        self.off = {}

    async def send(self, message):
        m = self.master
        wait = max(m.stalled_until - time.monotonic(), 0) + m.delay
        if wait:
            await asyncio.sleep(wait)
        if not self.socket.closed:
            try:
                await (self.socket.send_bytes(message) if isinstance(message, bytes) else self.socket.send_str(json.dumps(message)))
            except ConnectionError:
                pass

    def pair(self):
        return (self.view["seq"], self.scene["rev"])

    def home(self):
        v = self.master.volume
        self.view = {"seq": 0, "camera": v["home"]["camera"], "size": self.size, "moving": False}
        self.scene = {"rev": 0, "tf": v["home"]["tf"], "crop": None, "background": "#000000", "quality": {}, "up": None, "front": None, "moving": False}

    async def take(self, m):
        kind = m["type"]
        if kind == "hello":
            self.size = m["size"]
            self.watched = set(m.get("watch", []))
            await self.send({"type": "welcome", "protocol": 1, "server": "mock", "version": "0.1.0", "pixels_version": 1,
                             "now_ms": time.time() * 1000, "roles": ["view", "submit", "upload", "cancel"],
                             "movies": ["mp4", "gif", "apng", "zip"],
                             "limits": {"live_edge": 4096, "live_pixels": 4 << 20, "picture_edge": 8192, "upload_bytes": 4 << 30,
                                        "chunk_bytes": 4 << 20, "state_bytes": 1 << 20, "frames": 100_000}})
            await self.send(self.master.volume)
            self.home()
            if m.get("view"):
                self.view = m["view"]
            if m.get("scene"):
                self.scene = m["scene"]
            await self.news()
            self.poke()
        elif kind == "view":
            self.view = m
            self.poke()
        elif kind == "scene":
            self.scene = {**m, "tf": m.get("tf") or "auto"}
            self.poke()
        elif kind == "open":
            if m["volume"] != self.master.volume["name"]:
                await self.send({"type": "refused", "re": "open", "id": 0, "reason": "volume_not_readable", "field": "volume",
                                 "problem": f"{m['volume']} is only a name in this mock.", "remedy": "Open the first volume."})
                return
            await self.send(self.master.volume)
            self.home()
            self.poke()
        elif kind == "ack":
            self.inflight = max(0, self.inflight - 1)
            self.wake.set()
        elif kind == "watch":
            self.watched = set(m["of"])
            await self.news()
        elif kind == "fit":
            target, height = self.master.rays.fit(self.scene, m["camera"], self.view["size"])
            await self.send({"type": "fitted", "id": m["id"], "target": target, "height": height})
        elif kind == "pick":
            await self.send({"type": "picked", "id": m["id"], "x": m["x"], "y": m["y"],
                             **self.master.rays.pick(self.scene, self.view, m["x"], m["y"])})
        elif kind == "thumbs":
            asyncio.create_task(self.thumbs(m))
        elif kind == "cancel_job":
            j = self.master.jobs.get(m["job"])
            if j:
                j.update(state="cancelled", finished_ms=time.time() * 1000)
                await self.send({"type": "jobs", "changed": [j], "total": len(self.master.jobs)})
            await self.send({"type": "ok", "re": kind, "id": m["id"]})
        elif kind == "ping":
            await self.send({"type": "pong", "t": m["t"]})

    async def news(self):
        for of in self.watched:
            entries = list(getattr(self.master, of).values())
            for i in range(0, max(len(entries), 1), 200):
                await self.send({"type": of, "reset": i == 0, "changed": entries[i:i + 200], "total": len(entries)})

    def poke(self):
        self.changed_at = time.monotonic()
        self.wake.set()

    async def draw(self):
        """Draws the latest pair, again and again, as the slot rules say."""
        while not self.socket.closed:
            await self.wake.wait()
            self.wake.clear()
            if not self.view or self.inflight >= 2:
                continue
            moving = self.view.get("moving") or self.scene.get("moving")
            pair = self.pair()
            if self.drawn != (pair, "moving") and self.drawn != (pair, "still") and (moving or self.master.args.preview):
                self.drawn = (pair, "moving")
                if self.still_task:
                    self.still_task.cancel()
                await self.moving(pair)
                self.wake.set()
            elif not moving and self.drawn != (pair, "still"):
                self.drawn = (pair, "still")
                if self.still_task:
                    self.still_task.cancel()
                self.still_task = asyncio.create_task(self.still(pair))

    def setting(self):
        """What the distance of previews from their stills goes by: all but the camera."""
        return json.dumps([{k: v for k, v in self.scene.items() if k not in ("rev", "moving")}, self.view["size"]])

    async def moving(self, pair):
        size, (w, h) = self.view["size"], self.view["size"]
        k = min(1, 150 / h)
        small = (max(16, round(w * k)), max(16, round(h * k)))
        start = time.monotonic()
        pixels = await asyncio.to_thread(self.master.rays.draw, self.scene, self.view["camera"], small)
        drawn = time.monotonic()
        self.preview = pair, pixels
        bound = self.off.get(self.setting(), math.nan)
        self.inflight += 1
        sent = 0
        for n, (x, y, part) in enumerate(tiles(pixels, 128)):
            data = io.BytesIO()
            Image.fromarray(part).save(data, "JPEG", quality=80)
            sent += data.tell()
            await self.send(header(1, FIRST * (n == 0), pair, x, y, part, small, bound) + data.getvalue())
        end = time.monotonic()
        await self.send({"type": "done", "seq": pair[0], "scene": pair[1], "pass": "moving", "size": small, "level": 2, "bytes": sent,
                         "ms": {"wait": 0.3, "draw": (drawn - start) * 1e3, "encode": (end - drawn) * 1e3, "total": (end - start) * 1e3},
                         "view_sha256": "", "thickness": 1.333, "error": {}, "left_out": [], "workers": 6, "threads": 92})

    async def still(self, pair):
        start = time.monotonic()
        view, scene = self.view, self.scene
        try:
            pixels = await self.render(scene, view["camera"], view["size"])
        except RuntimeError as e:
            await self.send({"type": "refused", "re": "scene", "id": pair[1], "reason": "invalid_field", "field": "tf", "problem": str(e), "remedy": ""})
            return
        drawn = time.monotonic()
        if self.preview and self.preview[0] == pair:
            stretched = np.asarray(Image.fromarray(self.preview[1]).resize(pixels.shape[1::-1], Image.BILINEAR), np.float32)
            self.off[self.setting()] = float(np.sqrt(np.mean((stretched - pixels) ** 2))) / 255
        rgba = np.dstack([pixels, np.full(pixels.shape[:2], 255, np.uint8)])
        sha = hashlib.sha256(rgba.tobytes()).hexdigest()
        sent, w, h = 0, pixels.shape[1], pixels.shape[0]
        self.inflight += 1
        for n, (x, y, part) in enumerate(tiles(pixels, 256)):
            data = io.BytesIO()
            kind = 3 if n == 0 else 2
            Image.fromarray(part).save(data, "PNG" if kind == 3 else "WEBP", **({} if kind == 3 else {"lossless": True, "method": 0, "exact": True}))
            sent += data.tell()
            await self.send(header(kind, STILL | FIRST * (n == 0), pair, x, y, part, (w, h), 0.0) + data.getvalue())
            await asyncio.sleep(self.master.args.tile_ms / 1000)
        end = time.monotonic()
        await self.send({"type": "done", "seq": pair[0], "scene": pair[1], "pass": "still", "size": [w, h], "level": 0, "bytes": sent,
                         "ms": {"wait": 0.2, "draw": (drawn - start) * 1e3, "encode": (end - drawn) * 1e3, "total": (end - start) * 1e3},
                         "sha256": sha, "view_sha256": hashlib.sha256(json.dumps([scene, view], sort_keys=True).encode()).hexdigest(),
                         "thickness": 2 / 3, "workers": 6, "threads": 92,
                         "error": {"thickness": {"value": 0.43, "kind": "estimate"}, "cutoff": {"value": 0.5, "kind": "bound"},
                                   "quantisation": {"value": 0.18, "kind": "bound"}, "rounding": {"value": 0.03, "kind": "both"},
                                   "truncation": {"value": 0.05, "kind": "both"}, "ripple": None},
                         "left_out": [{"name": "gradient magnitudes", "saved_ms": 1.2, "saved_bytes": 3_541_715},
                                      {"name": "NaN test", "saved_ms": 0.1, "saved_bytes": 0}]})

    async def render(self, scene, camera, size):
        """Returns the pixels that `slabcast render` draws."""
        m = self.master
        async with m.drawing:
            tf = scene["tf"]
            if isinstance(tf, dict):
                file = m.scratch / "tf.json"
                file.write_text(json.dumps(tf))
                tf = str(file)
            frames = {"frames": 1, "keys": [camera]}
            for axis in ("up", "front"):
                if scene.get(axis):
                    frames[axis] = scene[axis]
            path = {"version": 1, "size": size, "keyframes": frames}
            if scene.get("crop"):
                path["crop"] = scene["crop"]
            (m.scratch / "path.json").write_text(json.dumps(path))
            out = m.scratch / "still.png"
            quality = scene.get("quality") or {}
            words = [f"--error={quality['error']}"] if quality.get("error") else [f"--budget={quality['budget_ms']}ms"] if quality.get("budget_ms") else []
            await m.call("render", m.args.volume, *m.args.flags, "--tf", tf, "--path", str(m.scratch / "path.json"), *words,
                         "--background", scene.get("background") or "black", "-o", str(out), "--force", "-q")
            return np.asarray(Image.open(out).convert("RGB"))

    async def thumbs(self, m):
        for i, name in enumerate(m["names"]):
            tf = name if m["of"] == "presets" else ["skin", "brain", "vessels", "fog"][i % 4]
            camera = m.get("camera") or self.master.volume["home"]["camera"]
            pixels = await asyncio.to_thread(self.master.rays.draw, {**self.scene, "tf": tf}, camera, (m["size"],) * 2)
            data = io.BytesIO()
            Image.fromarray(pixels).save(data, "JPEG", quality=85)
            await self.send(header(1, THUMB, (m["id"], 0), i, 0, pixels, (m["size"],) * 2, 0.1) + data.getvalue())
        await self.send({"type": "thumbs_done", "id": m["id"], "failed": []})


def header(kind, flags, pair, x, y, part, full, bound):
    h, w = part.shape[:2]
    return struct.pack("<BBHIHHHHHHIf", 1, kind, flags, pair[0], x, y, w, h, full[0], full[1], pair[1], bound)


def tiles(pixels, edge):
    for y in range(0, pixels.shape[0], edge):
        for x in range(0, pixels.shape[1], edge):
            yield x, y, np.ascontiguousarray(pixels[y:y + edge, x:x + edge])


def serve(args):
    master = Master(args)
    app = web.Application(client_max_size=8 << 20)
    routes = web.RouteTableDef()
    base = args.prefix.rstrip("/")

    async def asset(request):
        name = request.match_info.get("name") or "index.html"
        if args.modules and name == "app.js":
            name = "main.js"
        served = {f.name: f.read_bytes() for f in bundle.PAGE.glob("*.js")} if args.modules else {}
        data = {**bundle.files(), **served}.get(name)
        tests = Path(__file__).parent / name
        if data is None and name.startswith("test") and tests.exists():
            data = tests.read_bytes()
        if data is None:
            raise web.HTTPNotFound()
        answer = web.Response(body=data, content_type=TYPES[name.rsplit(".", 1)[-1]], headers={
            "Content-Security-Policy": CSP.format(host=request.host), "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer", "Cross-Origin-Opener-Policy": "same-origin", "Cache-Control": "no-cache"})
        answer.enable_compression()
        return answer

    async def live(request):
        socket = web.WebSocketResponse(max_msg_size=64 << 10, compress=False)
        await socket.prepare(request)
        session = Session(master, socket)
        master.sessions.add(session)
        drawer = asyncio.create_task(session.draw())
        async for message in socket:
            if message.type == WSMsgType.TEXT:
                await session.take(json.loads(message.data))
        drawer.cancel()
        master.sessions.discard(session)
        return socket

    async def picture(request):
        doc = await request.json()
        session = Session(master, None)
        frames = doc["path"]["keyframes"]
        scene = {"tf": doc["tf"], "crop": doc["path"].get("crop"), "background": doc["background"], "quality": doc["quality"],
                 "up": frames.get("up"), "front": frames.get("front")}
        await session.render(scene, frames["keys"][0], doc["path"]["size"])
        return web.Response(body=(master.scratch / "still.png").read_bytes(), content_type="image/png")

    async def movie(request):
        doc = await request.json()
        (master.scratch / "movie.json").write_text(json.dumps(doc))
        number = f"job-{401 + len(master.jobs)}"
        part = doc["path"].get("turntable") or doc["path"]["keyframes"]
        j = {**job(0, time.time() * 1000, master.volume["name"]), "job": number, "state": "running", "frames_done": 0,
             "frames_total": part["frames"], "format": doc["format"], "size": doc["path"]["size"]}
        master.jobs = {number: j, **master.jobs}
        return web.json_response({"job": number}, status=202)

    async def state(request):
        doc = await request.read()
        key = hashlib.sha256(doc).hexdigest()[:12]
        master.states[key] = doc
        return web.json_response({"id": key}, status=201)

    async def state_of(request):
        return web.Response(body=master.states[request.match_info["id"]], content_type="application/json")

    async def upload(request):
        doc = await request.json()
        if doc["name"].endswith(".txt"):
            return web.json_response({"reason": "invalid_field", "field": "name", "problem": f"{doc['name']} is no volume file.",
                                      "remedy": "Give NIfTI, NRRD, MetaImage, TIFF, VTK, DICOM or another format of docs/reference/files.md."}, status=422)
        key = f"up-{len(master.uploads)}"
        master.uploads[key] = doc
        return web.json_response({"upload": key, "chunk_bytes": 1 << 18, "received": [0] * len(doc["files"])}, status=201)

    async def chunk(request):
        data = await request.read()
        await asyncio.sleep(0.05)
        return web.json_response({"received": int(request.query["offset"]) + len(data)})

    async def upload_done(request):
        doc = master.uploads.pop(request.match_info["id"])
        entry = {"name": doc["name"], "digest": "", "dims": [64, 64, 64], "sample_kind": "u8", "bytes": 262144, "origin": "upload", "in_memory": True, "problem": ""}
        master.volumes[doc["name"]] = entry
        for s in master.sessions:
            await s.send({"type": "volumes", "changed": [entry]})
        return web.json_response(entry, status=201)

    async def fault(request):
        what = request.match_info["what"]
        if what == "stall":
            master.stalled_until = time.monotonic() + float(request.query["s"])
        elif what == "delay":
            master.delay = float(request.query["ms"]) / 1000
        elif what == "drop":
            for s in list(master.sessions):
                await s.socket.close(code=1011)
        elif what == "jobs":
            now = time.time() * 1000
            master.jobs = {j["job"]: j for j in (job(i, now, master.volume["name"]) for i in range(int(request.query["n"])))}
            for s in master.sessions:
                await s.news()
        elif what == "notice":
            for s in master.sessions:
                await s.send({"type": "notice", "level": "warning", "text": "No worker is there, so the picture stays as it is.",
                              "remedy": "Start one: slabcast worker --master HOST:7433", "until": "over", "id": 1})
        return web.Response(text="ok")

    app.router.add_get(f"{base}/v1/live", live)
    app.router.add_post(f"{base}/v1/picture", picture)
    app.router.add_post(f"{base}/v1/movie", movie)
    app.router.add_post(f"{base}/v1/states", state)
    app.router.add_get(f"{base}/v1/states/{{id}}", state_of)
    app.router.add_post(f"{base}/v1/uploads", upload)
    app.router.add_put(f"{base}/v1/uploads/{{id}}/{{n}}", chunk)
    app.router.add_post(f"{base}/v1/uploads/{{id}}/done", upload_done)
    app.router.add_get(f"{base}/mock/{{what}}", fault)
    app.router.add_get(f"{base}/{{name:[\\w.-]*}}", asset)
    app.add_routes(routes)

    async def begin(app):
        await master.load()
        app["live"] = asyncio.create_task(master.live())

    app.on_startup.append(begin)
    web.run_app(app, host="127.0.0.1", port=args.port, print=lambda *_: print(f"http://127.0.0.1:{args.port}{base}/", flush=True))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--slabcast", default="slabcast")
    parser.add_argument("--port", type=int, default=7490)
    parser.add_argument("--prefix", default="", help="path under which the page lies, such as /node/7/")
    parser.add_argument("--modules", action="store_true", help="serve modules one by one")
    parser.add_argument("--no-preview", dest="preview", action="store_false", help="no moving pass where nothing moves")
    parser.add_argument("--tile-ms", type=float, default=15, help="pause between tiles of a still")
    parser.add_argument("volume")
    parser.add_argument("flags", nargs="*")
    serve(parser.parse_args())
