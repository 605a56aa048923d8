#!/usr/bin/env python3
"""What docs/measurements/scripts/peers.py needs numpy and Pillow for; it runs this with the python of --venv.

    presets PEERS               the peers' transfer functions and material, as JSON
    resample PEERS IN OUT N     a cube of N samples an edge as NRRD: means, or linear between samples
    compare OUT A B             RMSE, maximum, bias, PSNR and best shift of two pictures, as JSON;
                                OUT shows A, B and their difference side by side

A picture is KIND:FACTOR:PATH. KIND is `srgb` (slabcast's PNGs: decoded to the linear values that
were composited) or `raw` (peers composite in the numbers that they write). FACTOR n means that
the picture is n times too large and is averaged down.
"""

import json
import sys

import numpy as np


def peers_protocol(folder):
    sys.path.insert(0, folder)
    import common
    return common


def presets(folder):
    p = peers_protocol(folder)
    shading = {"on": True, "ambient": p.AMBIENT, "diffuse": p.DIFFUSE, "specular": p.SPECULAR,
               "power": p.POWER, "light": "head"}
    print(json.dumps({"presets": p.PRESETS, "shading": shading, "view_factor": p.VIEW_FACTOR,
                      "start": p.START_DEG, "step": p.STEP_DEG, "fov": p.FOV_DEG}))


def finer(a, factor, axis):
    """Linear between samples; a sample stands in the middle of its cell at either size."""
    n = a.shape[axis]
    at = np.clip((np.arange(n * factor) + 0.5) / factor - 0.5, 0, n - 1)
    low = np.minimum(at.astype(int), n - 2)
    shape = [1] * a.ndim
    shape[axis] = -1
    part = (at - low).astype(np.float32).reshape(shape)
    return np.take(a, low, axis) * (1 - part) + np.take(a, low + 1, axis) * part


def resample(folder, source, target, edge):
    a, _ = peers_protocol(folder).load(source)
    n, edge = a.shape[0], int(edge)
    if a.shape != (n, n, n) or (edge % n and n % edge):
        sys.exit(f"{source} has {a.shape} samples: a cube is wanted whose edge divides {edge} or is "
                 "divided by it")
    with open(target, "wb") as out:
        out.write(f"NRRD0005\ntype: uint8\ndimension: 3\nsizes: {edge} {edge} {edge}\n"
                  "encoding: raw\nspacings: 1 1 1\n\n".encode())
        if edge <= n:
            f = n // edge
            mean = a.reshape(edge, f, edge, f, edge, f).mean((1, 3, 5), dtype=np.float32)
            out.write((mean + 0.5).astype(np.uint8).tobytes())
            return
        f = edge // n
        # Layer by layer: 1024^3 floats would take 4 GiB where one layer takes 4 MiB.
        for k in range(edge):
            at = min(max((k + 0.5) / f - 0.5, 0.0), n - 1.0)
            low = min(int(at), n - 2)
            layer = a[low] * np.float32(1 - (at - low)) + a[low + 1] * np.float32(at - low)
            out.write((finer(finer(layer, f, 0), f, 1) + 0.5).astype(np.uint8).tobytes())


def picture(name):
    from PIL import Image
    Image.MAX_IMAGE_PIXELS = None
    kind, factor, path = name.split(":", 2)
    a, f = np.asarray(Image.open(path).convert("RGB")).astype(np.float64), int(factor)
    if kind == "srgb":
        a = a / 255
        a = 255 * np.where(a <= 0.04045, a / 12.92, ((a + 0.055) / 1.055) ** 2.4)
    height, width, _ = a.shape
    return a.reshape(height // f, f, width // f, f, 3).mean((1, 3)) if f > 1 else a


def compare(out, first, second):
    from PIL import Image
    a, b = picture(first), picture(second)
    if a.shape != b.shape:
        sys.exit(f"{first} has {a.shape}, {second} has {b.shape}")
    covered = (a.max(2) >= 0.5) | (b.max(2) >= 0.5)
    off = (a - b)[covered] if covered.any() else np.zeros((1, 3))

    def rms(x):
        return float(np.sqrt((x * x).mean()))

    reach = range(-2, 3)
    moved = {(dx, dy): rms(np.roll(a, (dy, dx), (0, 1)) - b) for dy in reach for dx in reach}
    best = min(moved, key=moved.get)
    whole = rms(a - b)
    still = np.roll(a, best[::-1], (0, 1))
    both = (still.max(2) >= 0.5) | (b.max(2) >= 0.5)
    side = np.hstack([a, b, np.abs(a - b)])
    Image.fromarray(side.round().clip(0, 255).astype(np.uint8)).save(out)
    print(json.dumps({
        "rmse": rms(off), "max": float(np.abs(off).max()), "bias": float(off.mean()),
        "psnr": None if whole == 0 else float(20 * np.log10(255 / whole)),
        "covered": int(covered.sum()), "shift": list(best),
        "rmse_shifted": rms((still - b)[both]) if both.any() else 0.0}))


if __name__ == "__main__":
    {"presets": presets, "resample": resample, "compare": compare}[sys.argv[1]](*sys.argv[2:])
