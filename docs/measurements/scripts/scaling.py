"""Tables of docs/measurements/scaling.md: `python3 docs/measurements/scripts/scaling.py SLABCAST DATA [--frames N] [--large] [--rehearse LIST] [--hidden]`.

For the three scenes of the paper's kind, or the two large ones, `slabcast lab plan` measures tiles once and
predicts both schedules at 1 and 10 Gbit/s and without limit; with --rehearse, processes on this machine
are compared with what is predicted for them. With --hidden, how much of what bricks take on a link of
1 Gbit/s is hidden behind drawing once the first frame is there, instead. Prints Markdown. DATA is the folder with mri256.nrrd and the
others.
"""

import argparse
import json
import os
import subprocess
import tempfile

SCENES = [
    ("mri256", "mri256.nrrd", ["--up=-y", "--tf", "peer-opaque"]),
    ("mouse_skull", "mouse_skull.nrrd", ["--up=z", "--tf", "peer-skull"]),
    ("aneurism", "aneurism.nrrd", ["--up=z", "--tf", "peer-vessels"]),
]
LARGE = [
    ("mri256 at 1024", "mri256.nrrd",
     ["--up=-y", "--tf", "peer-semi", "--size", "1024x1024", "--repeats", "1"]),
    ("lidc0314_ct at 2048", "large/lidc0314_ct.nrrd",
     ["--tf", "skin", "--size", "2048x2048", "--repeats", "1"]),
]
LINKS = [("1gbit", 0.94e9 / 8), ("10gbit", 9.4e9 / 8), ("unlimited", float("inf"))]
WORKERS = [1, 2, 4, 8, 15, 16, 32, 64]


def plan(args, scene, trace, more, workers=WORKERS):
    _, file, flags = scene
    command = [args.slabcast, "lab", "plan", os.path.join(args.data, file), *flags,
               "--frames", str(args.frames), "--workers", ",".join(map(str, workers)),
               "--trace", trace, "-q", "--json", *more]
    out = subprocess.run(command, capture_output=True, text=True)
    if out.returncode != 0:
        raise SystemExit(f"{' '.join(command)}\n{out.stderr}")
    return json.loads(out.stdout)


def cell(row, alone, rate, large):
    """Latency beside what is asked for, throughput, and what binds."""
    n = row["workers"]
    part = row["throughput_efficiency"]
    through = "-" if part is None else f"{100 * part:.0f} %"
    if large:
        return f"{100 * row['latency_efficiency']:.0f} % / {through} {row['bound_by']}"
    asked = alone / n + 1.2 + 1e3 * (row["bytes_down"] + row["bytes_up"] + row["brick_bytes"]) / rate
    limit = f" ({asked:.1f})" if n <= 15 else ""
    return f"{row['frame_ms']:.1f}{limit} / {through} {row['bound_by']}"


def hidden(args, scene, trace):
    """How long a thread waits for bricks, against what a frame's take on the link."""
    got = plan(args, scene, trace, ["--link", "1gbit", "--schedule", "region"], [*range(1, 11), 15])
    rate = LINKS[0][1]
    print("| workers | " + " | ".join(str(r["workers"]) for r in got["predicted"]) + " |")
    print("|---|" + "--:|" * len(got["predicted"]))
    rows = {"waits, % of a thread's time": [], "bricks of a frame, ms of the link": [], "hidden, %": []}
    for r in got["predicted"]:
        waits = r["render_threads"]["bricks"]
        link = 1e3 * r["brick_bytes"] / rate
        part = 1 - 1e3 * waits / r["frames_per_s"] / link
        for to, value in zip(rows.values(), [f"{100 * waits:.1f}", f"{link:.2f}", f"{100 * part:.0f}"]):
            to.append(value)
    for name, cells in rows.items():
        print(f"| {name} | " + " | ".join(cells) + " |")
    print(flush=True)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("slabcast")
    parser.add_argument("data")
    parser.add_argument("--frames", type=int, default=18)
    parser.add_argument("--large", action="store_true")
    parser.add_argument("--rehearse")
    parser.add_argument("--hidden", action="store_true")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for scene in LARGE if args.large else SCENES:
            trace = os.path.join(folder, "trace")
            if os.path.exists(trace):
                os.remove(trace)
            print(f"**{scene[0]}** `{' '.join(scene[2])}`", flush=True)
            if args.hidden:
                hidden(args, scene, trace)
                continue
            for i, (link, rate) in enumerate(LINKS):
                got = plan(args, scene, trace, ["--link", link])
                alone = got["measured"]["alone_ms"]
                if i == 0:
                    order = got["rank_correlation"] or {"plain": float("nan"), "learned": float("nan")}
                    region = [r for r in got["predicted"] if r["schedule"] == "region"]
                    kb = {r["workers"]: (r["bytes_down"] + r["bytes_up"]) / 1e3 for r in region}
                    print(f"(measured: {alone:.1f} ms alone on one core; {kb[15]:.0f} KB a frame at 15 "
                          f"workers; rank correlation {order['plain']:.2f} plain, "
                          f"{order['learned']:.2f} learned)\n")
                    print("| link | schedule | " + " | ".join(map(str, WORKERS)) + " |")
                    print("|---|---|" + "---|" * len(WORKERS))
                for schedule in ["region", "slab"]:
                    rows = [r for r in got["predicted"] if r["schedule"] == schedule]
                    cells = [cell(r, alone, rate, args.large) for r in rows]
                    print(f"| {link} | {schedule} | " + " | ".join(cells) + " |", flush=True)
            print(flush=True)
            if args.rehearse:
                got = plan(args, scene, trace, ["--rehearse", args.rehearse])
                print("| schedule | workers | ms from frame to frame | predicted | off | master's CPU "
                      "ms a frame | workers' CPU | cores busy |")
                print("|---|---|---|---|---|---|---|---|")
                for r in got["rehearsed"]:
                    off = 100 * (r["predicted_each_ms"] / r["each_ms"] - 1)
                    print(f"| {r['schedule']} | {r['workers']} | {r['each_ms']:.1f} | "
                          f"{r['predicted_each_ms']:.1f} | {off:+.0f} % | {r['master_cpu_ms']:.1f} "
                          f"({r['predicted_master_cpu_ms']:.1f}) | {r['workers_cpu_ms']:.1f} "
                          f"({r['predicted_workers_cpu_ms']:.1f}) | {100 * r['busy']:.0f} % |", flush=True)
                print(flush=True)


main()
