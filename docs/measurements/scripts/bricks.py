#!/usr/bin/env python3
"""Which bricks a path needs, holds and is sent, under either schedule (docs/measurements/scaling.md).

bricks.py SLABCAST FOLDER: renders 18 views of the three volumes of FOLDER, and prints Markdown.
Shares of voxels are counted; shares of bytes are of the encoded set, as `--log-level info` says.
"""

import json
import re
import subprocess
import sys
import tempfile

SCENES = [
    ("mri256.nrrd", "-y", "peer-opaque"),
    ("mouse_skull.nrrd", "z", "peer-skull"),
    ("aneurism.nrrd", "z", "peer-vessels"),
]


def run(slabcast, folder, scene, schedule, workers):
    name, up, tf = scene
    with tempfile.TemporaryDirectory() as out:
        args = [slabcast, "render", f"{folder}/{name}", f"--up={up}", "--tf", tf]
        args += ["--start", "20", "--step", "5", "--frames", "18", "--schedule", schedule]
        args += ["--workers", str(workers), "--threads", "1", "-o", f"{out}/frames"]
        args += ["--stats", f"{out}/stats.jsonl", "--log-level", "info"]
        said = subprocess.run(args, check=True, capture_output=True, text=True).stderr
        with open(f"{out}/stats.jsonl", encoding="utf-8") as f:
            frames = [json.loads(line) for line in f]
    return frames, int(re.search(r"bricks made.* bytes=(\d+)", said).group(1))


def main():
    slabcast, folder = sys.argv[1:]
    print("| | schedule, workers | needed, voxels | held at the end | sent a later frame (most) "
          "| stood still, a later frame |")
    print("|---|---|---|---|---|---|")
    for scene in SCENES:
        for schedule, workers in [("slab", 1), ("region", 1), ("region", 2), ("region", 4)]:
            frames, all_bytes = run(slabcast, folder, scene, schedule, workers)
            later = frames[1:]
            need = sum(f["bricks"]["needed_voxels"] / f["voxels"]["relevant"] for f in frames)
            held = sum(w["bytes_held"] for w in frames[-1]["workers"])
            sent = [sum(w["bytes_sent"] for w in f["workers"]) / all_bytes for f in later]
            stalls = sum(w["stalls"] for f in later for w in f["workers"]) / len(later)
            print(f"| {scene[0]} `{scene[2]}` | {schedule}, {workers} "
                  f"| {100 * need / len(frames):.1f} % | {100 * held / all_bytes:.1f} % "
                  f"| {100 * sum(sent) / len(sent):.2f} % ({100 * max(sent):.2f} %) "
                  f"| {stalls:.1f} times |", flush=True)


if __name__ == "__main__":
    main()
