#!/usr/bin/env python3
"""Runs the paper's protocol with real processes and prints the tables of docs/measurements/paper-protocol.md.

    python3 docs/measurements/scripts/measure.py --data DIR [--binary PATH] [--only mri256] [--keep DIR]

For each volume: a master, then 1 and 2 workers of one thread each, then `slabcast render
--master` with 18 frames of 512x512. Times come from --stats (the master's clock, picture
finished, no PNG in it), memory from /proc/PID/status (VmHWM, the peak), wall time from the
client. Python's standard library is all it needs. Linux only.
"""

import argparse
import json
import os
import pathlib
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time

# name, file, transfer function, axes: the paper's head, skull and blood vessels (section 5).
SCENES = [
    ("mri256", "mri256.nrrd", "peer-opaque", ["--up=-y"]),
    ("mouse_skull", "mouse_skull.nrrd", "peer-skull", ["--up=z"]),
    ("aneurism", "aneurism.nrrd", "peer-vessels", ["--up=z"]),
]


def free_port():
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def wait_for_port(port, process, seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if process.poll() is not None:
            sys.exit(f"the master ended with exit code {process.returncode} before it listened")
        try:
            socket.create_connection(("127.0.0.1", port), timeout=0.2).close()
            return
        except OSError:
            time.sleep(0.05)
    sys.exit(f"nothing listens on port {port} after {seconds} s")


def peak_mib(process):
    for line in pathlib.Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return float("nan")


def run(binary, volume, tf, axes, workers, options, folder, told=True):
    """One job on a cluster of its own; gives statistics of its frames and of its processes. Not `told`: none of
    frames, whose hashes and estimates of errors take time."""
    address = f"127.0.0.1:{free_port()}"
    log = open(folder / "log.txt", "a")
    processes = []

    def start(*words):
        p = subprocess.Popen([binary, *words], stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        processes.append(p)
        return p

    try:
        master = start("master", "--volume", volume, "--listen", address, *axes)
        wait_for_port(int(address.split(":")[1]), master)
        crew = [
            start("worker", "--master", address, "--threads", "1", "--memory", options.memory)
            for _ in range(workers)
        ]
        time.sleep(1.0)  # they say hello
        stats = folder / f"{workers}.jsonl"
        out = folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        begin = time.monotonic()
        client = subprocess.run(
            [binary, "render", "--master", address, "--tf", tf, "--size", options.size,
             "--frames", str(options.frames), *([] if "--step" in options.extra else ["--step", "5"]), *(["--stats", stats] if told else []), "-o", out,
             *options.extra],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=log, text=True)
        wall = time.monotonic() - begin
        log.write(client.stdout)
        if client.returncode != 0:
            log.flush()
            sys.exit(f"render failed with exit code {client.returncode}:\n"
                     + "\n".join((folder / "log.txt").read_text().splitlines()[-20:]))
        lines = stats.read_text().splitlines() if told else []
        frames = [json.loads(line) for line in lines if line.strip()]
        frames.sort(key=lambda f: f["frame"])
        png = sum(p.stat().st_size for p in out.glob("*.png"))
        return {
            "workers": workers,
            "frames": frames,
            "wall_s": wall,
            "said": client.stdout,
            "png_bytes": png,
            "master_mib": peak_mib(master),
            "worker_mib": [peak_mib(w) for w in crew],
        }
    finally:
        for p in reversed(processes):
            if p.poll() is None:
                p.terminate()
        for p in processes:
            try:
                p.wait(15)
            except subprocess.TimeoutExpired:
                p.kill()
        log.close()


def share(part, whole):
    return f"{100 * part / whole:.1f} %" if whole else "-"


def median(values):
    values = [v for v in values if v is not None]
    return statistics.median(values) if values else float("nan")


def digest(r):
    """The figures of one run: the first frame apart, medians of the rest."""
    first, rest = r["frames"][0], r["frames"][1:] or r["frames"]
    total = [f["ms"]["total"] for f in rest]

    def voxels(frames):
        culled = sum(f["voxels"]["culled"] for f in frames)
        return culled, culled + sum(f["voxels"]["splatted"] for f in frames)

    def sent(frames, field):
        return sum(w[field] for f in frames for w in f["workers"])

    held = [w for w in r["frames"][-1]["workers"]]
    distribute = sum(f["ms"]["distribute"] for f in r["frames"])
    overlap = sum(f["ms"].get("overlap") or 0 for f in r["frames"])
    return {
        "first": first["ms"]["total"],
        "median": median(total),
        "low": min(total),
        "high": max(total),
        "cull": median([f["ms"]["cull"] for f in rest]),
        "composite": median([f["ms"]["composite"] for f in rest]),
        "wait": median([f["ms"]["wait"] for f in rest]),
        "render": median([f["ms"]["render"] for f in rest]),
        "relevant_bricks": first["bricks"]["relevant"],
        "relevant_voxels": first["voxels"]["relevant"],
        "needed_bricks": median([f["bricks"]["needed"] / f["bricks"]["relevant"] for f in r["frames"]]),
        "needed_voxels": median(
            [f["bricks"]["needed_voxels"] / f["voxels"]["relevant"] for f in r["frames"]]),
        "needed_first": first["bricks"]["needed"] / first["bricks"]["relevant"],
        "held": max((w["bricks_held"] for w in held), default=0) / first["bricks"]["relevant"],
        "held_mib": max((w["bytes_held"] for w in held), default=0) / 2**20,
        "sent_first": sent([first], "bricks_sent") / r["workers"] / first["bricks"]["relevant"],
        "sent_rest": sent(rest, "bricks_sent") / len(rest) / r["workers"] / first["bricks"]["relevant"],
        "sent_first_mib": sent([first], "bytes_sent") / r["workers"] / 2**20,
        "sent_rest_kib": sent(rest, "bytes_sent") / len(rest) / r["workers"] / 2**10,
        "culled": voxels(r["frames"]),
        "overlap": (overlap, distribute),
        "own_s": sum(f["ms"]["total"] for f in r["frames"]) / 1000,
        "retries": sum(f.get("retries", 0) for f in r["frames"]),
        "hashes": [f["pixels_sha256"] for f in r["frames"]],
    }


def machine():
    cpu = "unknown CPU"
    for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.split(":", 1)[1].strip()
            break
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{cpu}, {os.cpu_count()} cores, {memory:.0f} GiB"


def table(head, rows):
    print("| " + " | ".join(head) + " |")
    print("|" + "|".join("---" if i == 0 else "--:" for i in range(len(head))) + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |")
    print()


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    p.add_argument("--data", required=True, help="folder with mri256.nrrd, mouse_skull.nrrd, aneurism.nrrd")
    p.add_argument("--binary", default=os.path.join(
        os.environ.get("CARGO_TARGET_DIR", "target"), "release", "slabcast"))
    p.add_argument("--only", action="append", help="one scene by name (may be given again)")
    p.add_argument("--size", default="512x512")
    p.add_argument("--frames", type=int, default=18)
    p.add_argument("--workers", default="1,2", help="numbers of workers to try, e.g. 1,2")
    p.add_argument("--memory", default="512MiB", help="brick budget of a worker")
    p.add_argument("--keep", help="keep statistics and logs in this folder")
    p.add_argument("extra", nargs="*", help="more flags for render, after --")
    options = p.parse_args()
    if not os.access(options.binary, os.X_OK):
        sys.exit(f"no binary at {options.binary}; run `cargo build --release` or give --binary")
    base = pathlib.Path(options.keep or tempfile.mkdtemp(prefix="slabcast-measure-"))

    results = []
    for name, file, tf, axes in SCENES:
        volume = pathlib.Path(options.data) / file
        if options.only and name not in options.only:
            continue
        if not volume.exists():
            print(f"{name}: no {file} in {options.data}, left out", file=sys.stderr)
            continue
        folder = base / name
        folder.mkdir(parents=True, exist_ok=True)
        for workers in (int(n) for n in options.workers.split(",")):
            print(f"{name}: {workers} worker(s) ...", file=sys.stderr, flush=True)
            r = run(options.binary, volume, tf, axes, workers, options, folder)
            results.append((name, r, digest(r)))
    if not options.keep:
        shutil.rmtree(base, ignore_errors=True)
    if not results:
        sys.exit("nothing measured")

    print(f"{machine()}; {options.size}, {options.frames} frames"
          + (f", {' '.join(options.extra)}" if options.extra else "") + "\n")
    one = {name: d["median"] for name, r, d in results if r["workers"] == 1}

    print("### Time, ms a frame\n")
    table(["scene, workers", "first", "median of the rest", "min to max", "speed-up", "render (sum)",
           "cull", "composite", "wait (sum)"],
          [[f"{n}, {r['workers']}", f"{d['first']:.0f}", f"{d['median']:.0f}",
            f"{d['low']:.0f} to {d['high']:.0f}",
            f"{one[n] / d['median']:.2f}" if n in one else "-",
            f"{d['render']:.0f}", f"{d['cull']:.1f}", f"{d['composite']:.1f}", f"{d['wait']:.1f}"]
           for n, r, d in results])

    print("### Bricks (shares of the relevant ones; held and sent: for each worker)\n")
    table(["scene, workers", "relevant bricks", "needed by a view", "its voxels", "held at the end",
           "sent, first frame", "sent, later frames", "voxel candidates culled",
           "sending beside rendering"],
          [[f"{n}, {r['workers']}", f"{d['relevant_bricks']}", share(d["needed_bricks"], 1),
            share(d["needed_voxels"], 1), f"{share(d['held'], 1)} ({d['held_mib']:.1f} MiB)",
            f"{share(d['sent_first'], 1)} ({d['sent_first_mib']:.1f} MiB)",
            f"{share(d['sent_rest'], 1)} ({d['sent_rest_kib']:.0f} KiB)",
            share(*d["culled"]), share(*d["overlap"])]
           for n, r, d in results])

    print("### Processes (peak RSS, MiB) and pictures\n")
    table(["scene, workers", "master", "workers", "wall time", "frames' own time",
           "the rest, ms a frame", "PNGs", "leases again"],
          [[f"{n}, {r['workers']}", f"{r['master_mib']:.0f}",
            ", ".join(f"{m:.0f}" for m in r["worker_mib"]), f"{r['wall_s']:.2f} s",
            f"{d['own_s']:.2f} s",
            f"{1000 * (r['wall_s'] - d['own_s']) / len(r['frames']):.0f}",
            f"{r['png_bytes'] / 2**20:.1f} MiB", f"{d['retries']}"]
           for n, r, d in results])

    by_scene = {}
    for name, _, d in results:
        by_scene.setdefault(name, set()).add(tuple(d["hashes"]))
    for name, hashes in by_scene.items():
        print(f"{name}: " + ("same pixels for every number of workers"
                             if len(hashes) == 1 else "PIXELS DIFFER between numbers of workers"))
    sys.exit(0 if all(len(h) == 1 for h in by_scene.values()) else 1)


if __name__ == "__main__":
    main()
