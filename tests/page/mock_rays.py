"""Quick pictures for the mock: rays through a coarse copy of the volume, in numpy.

The camera is written from docs/reference/view-paths.md, apart from the page's and the program's, so
that a picture that jumps when it becomes sharp shows a mistake in one of them.
"""

import gzip
import math

import numpy as np


def read_nrrd(path):
    data = path.read_bytes()
    head, body = data.split(b"\n\n", 1)
    fields = dict(line.split(": ", 1) for line in head.decode().split("\n")[1:] if ": " in line)
    kind = {"uint8": "u1", "uchar": "u1", "unsigned char": "u1", "uint16": "<u2", "int16": "<i2", "float": "<f4"}[fields["type"]]
    if fields["encoding"] in ("gzip", "gz"):
        body = gzip.decompress(body)
    sizes = [int(n) for n in fields["sizes"].split()]
    return np.frombuffer(body, kind).reshape(sizes[::-1])


def axis(text):
    v = np.zeros(3)
    v["xyz".index(text[-1])] = -1 if text[0] == "-" else 1
    return v


def camera_axes(key, up, front):
    """Returns right, down and ahead of a key's camera, and its distance (None: parallel)."""
    up_v, front_v = axis(up), axis(front)
    side = axis("xyz".replace(up[-1], "").replace(front[-1], ""))
    target = np.array(key["target"], float)
    if "eye" in key:
        away = np.array(key["eye"], float) - target
        to_eye, picture_up = away / np.linalg.norm(away), np.array(key.get("up", up_v), float)
    else:
        a, e = math.radians(key.get("azimuth", 0)), math.radians(key.get("elevation", 0))
        level = front_v * math.cos(a) + side * math.sin(a)
        to_eye = level * math.cos(e) + up_v * math.sin(e)
        picture_up = up_v * math.cos(e) - level * math.sin(e)
    ahead = -to_eye
    right = np.cross(ahead, picture_up)
    right /= np.linalg.norm(right)
    distance, height = None, key.get("height")
    if key.get("projection") == "persp":
        tan = math.tan(math.radians(key.get("fov", 30)) / 2)
        if "eye" in key:
            distance = float(np.linalg.norm(away))
            height = 2 * distance * tan
        else:
            distance = height / 2 / tan
    return right, np.cross(ahead, right), ahead, target, height, distance


class Rays:
    """A volume of bytes, every second sample."""

    def __init__(self, file, info, up, front):
        samples = read_nrrd(file)
        lo, hi = info["presets_by"]["range"]
        samples = np.clip((samples.astype(np.float32) - lo) * (255 / (hi - lo)), 0, 255).astype(np.uint8)
        self.values = np.ascontiguousarray(samples[::2, ::2, ::2])
        self.range = (lo, hi)
        self.info, self.up, self.front = info, up, front
        steps = np.array(info["steps"]).T * 2
        self.index_from_world = np.linalg.inv(steps)
        self.origin = np.array(info["origin"])
        self.presets = {}

    def tables(self, tf):
        if isinstance(tf, str):
            import json
            import tempfile
            from pathlib import Path
            cache = Path(tempfile.gettempdir()) / f"slabcast-mock-{self.info['digest'][:12]}.json"
            tf = next(p["tf"] for p in json.loads(cache.read_text()) if p["name"] == tf)
        lo, hi = self.range
        x = lo + np.arange(256) * (hi - lo) / 255
        o, c = np.array(tf["opacities"]), np.array(tf["colors"])
        alpha = np.interp(x, o[:, 0], o[:, 1])
        sigma = -np.log1p(-np.minimum(alpha, 0.99998))
        linear = lambda v: np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
        colour = np.stack([np.interp(x, c[:, 0], linear(c[:, i])) for i in (1, 2, 3)], 1)
        return sigma.astype(np.float32), colour.astype(np.float32), tf.get("shading", {}).get("on", True)

    def march(self, scene, key, size, steps=110, only=None):
        """Returns values, depths and crops along the rays of a picture (or of one pixel)."""
        right, down, ahead, target, height, distance = camera_axes(key, scene.get("up") or self.up, scene.get("front") or self.front)
        w, h = size
        xs, ys = np.meshgrid(np.arange(w) + 0.5 - w / 2, np.arange(h) + 0.5 - h / 2)
        if only:
            xs, ys = np.array([[only[0] + 0.5 - w / 2]]), np.array([[only[1] + 0.5 - h / 2]])
        mm = height / h
        lo, hi = map(np.array, self.info["world_box"])
        corners = np.array([[(lo, hi)[c >> a & 1][a] for a in range(3)] for c in range(8)])
        along = (corners - target) @ ahead
        depth = np.linspace(along.min(), along.max(), steps)
        if distance:
            depth = depth[depth > -0.98 * distance]
        k = np.ones(len(depth)) if distance is None else (distance + depth) / distance
        flat = xs[..., None] * right * mm + ys[..., None] * down * mm
        points = target + depth[:, None, None, None] * ahead + flat[None] * k[:, None, None, None]
        index = np.rint((points - self.origin) @ self.index_from_world.T).astype(np.int32)
        d, hgt, wid = self.values.shape
        inside = ((index >= 0) & (index < [wid, hgt, d])).all(-1)
        if scene.get("crop"):
            c = scene["crop"]
            for a, name in enumerate("xyz"):
                a0, a1 = c[name]
                if c.get("unit") == "unit":
                    a0, a1 = [None if e is None else lo[a] + e * (hi - lo)[a] for e in (a0, a1)]
                if a0 is not None:
                    inside &= points[..., a] >= a0
                if a1 is not None:
                    inside &= points[..., a] <= a1
        index[~inside] = 0
        values = self.values[index[..., 2], index[..., 1], index[..., 0]]
        return np.where(inside, values, 0), inside, points, depth, (depth[1] - depth[0])

    def weights(self, scene, key, size, only=None, steps=110):
        sigma, colour, lit = self.tables(scene["tf"])
        values, inside, points, depth, step = self.march(scene, key, size, steps, only)
        tau = np.where(inside, sigma[values], 0) * step
        before = np.exp(-np.concatenate([np.zeros((1, *tau.shape[1:]), np.float32), np.cumsum(tau, 0)[:-1]]))
        return values, before * (1 - np.exp(-tau)), colour, points, depth, lit

    def draw(self, scene, key, size):
        """Returns a picture, (h, w, 3) bytes."""
        values, weight, colour, _, depth, lit = self.weights(scene, key, size)
        rgb = np.einsum("nhw,nhwc->hwc", weight, colour[values])
        alpha = weight.sum(0)
        if lit:
            z = np.einsum("nhw,n->hw", weight, depth) / np.maximum(alpha, 1e-3)
            gy, gx = np.gradient(z)
            px = key.get("height", 200) / size[1]
            n = np.stack([gx, gy, -np.full_like(z, px)], -1)
            n /= np.linalg.norm(n, axis=-1, keepdims=True)
            light = np.clip(n @ np.array([-6 / 11, -6 / 11, -7 / 11]), 0, 1) * 0.88 + np.clip(-n[..., 2], 0, 1) * 0.12 + 0.02
            rgb *= light[..., None]
        back = scene.get("background") or "#000000"
        ground = np.array([int(back[i:i + 2], 16) / 255 for i in (1, 3, 5)]) ** 2.2
        rgb = rgb + ground * (1 - alpha)[..., None]
        return (np.clip(rgb, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)

    def pick(self, scene, view, x, y):
        values, weight, colour, points, depth, _ = self.weights(scene, view["camera"], view["size"], (x, y), 400)
        w, v, p = weight[:, 0, 0], values[:, 0, 0], points[:, 0, 0]
        total = float(w.sum())
        if total < 0.02:
            return {"hit": None, "depth": None, "value": None, "ranges": [], "alpha": total}
        n = int(np.searchsorted(np.cumsum(w), total / 2))
        lo, hi = self.range
        value = lambda code: lo + code * (hi - lo) / 255
        ranges = []
        for k in range(16):
            mine = (v >= k * 16) & (v < k * 16 + 16)
            share = float(w[mine].sum())
            if share > 0.02 * total:
                mean = colour[v[mine]].mean(0) ** (1 / 2.2)
                ranges.append({"from": round(value(k * 16), 1), "to": round(value(k * 16 + 16), 1), "share": share / total,
                               "color": "#" + "".join(f"{int(c * 255):02x}" for c in mean)})
        ranges.sort(key=lambda r: -r["share"])
        return {"hit": [round(float(c), 2) for c in p[n]], "depth": float(depth[n]), "value": float(value(v[n])), "ranges": ranges[:6], "alpha": total}

    def fit(self, scene, camera, size):
        lo, hi = map(np.array, self.info["world_box"])
        key = {**camera, "target": list((lo + hi) / 2), "height": float((hi - lo).max() * 1.4)}
        _, weight, *_ = self.weights(scene, key, (200, 200))
        ys, xs = np.nonzero(weight.sum(0) > 0.1)
        if not len(xs):
            return key["target"], key["height"]
        right, down, *_ = camera_axes(key, scene.get("up") or self.up, scene.get("front") or self.front)
        mm = key["height"] / 200
        mid = np.array(key["target"]) + right * ((xs.min() + xs.max() + 1) / 2 - 100) * mm + down * ((ys.min() + ys.max() + 1) / 2 - 100) * mm
        tall, wide = (np.ptp(ys) + 1) * mm, (np.ptp(xs) + 1) * mm * size[1] / size[0]
        return [round(float(c), 2) for c in mid], round(float(max(tall, wide) / 0.85), 2)
