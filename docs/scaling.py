"""Tables of docs/scaling.md: `python3 docs/scaling.py SLABCAST DATA [--frames N] [--rehearse LIST]`.

For the three scenes of the paper's kind, `slabcast plan` measures tiles once and predicts both
schedules at 1 and 10 Gbit/s and without limit; with --rehearse, processes on this machine are compared
with what is predicted for them. Prints Markdown. DATA is the folder with mri256.nrrd and the others.
"""

import argparse
import json
import os
import subprocess
import tempfile

SCENES = [
    ("mri256", "mri256.nrrd", "-y", "peer-opaque"),
    ("mouse_skull", "mouse_skull.nrrd", "z", "peer-skull"),
    ("aneurism", "aneurism.nrrd", "z", "peer-vessels"),
]
LINKS = ["1gbit", "10gbit", "unlimited"]
WORKERS = [1, 2, 4, 8, 15, 16, 32, 64]


def plan(args, scene, trace, more):
    name, file, up, tf = scene
    command = [args.slabcast, "plan", os.path.join(args.data, file), f"--up={up}", "--tf", tf,
               "--frames", str(args.frames), "--workers", ",".join(map(str, WORKERS)),
               "--trace", trace, "-q", "--json", *more]
    out = subprocess.run(command, capture_output=True, text=True)
    if out.returncode != 0:
        raise SystemExit(f"{' '.join(command)}\n{out.stderr}")
    return json.loads(out.stdout)


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("slabcast")
    parser.add_argument("data")
    parser.add_argument("--frames", type=int, default=18)
    parser.add_argument("--rehearse")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for scene in SCENES:
            trace = os.path.join(folder, scene[0] + ".trace")
            print(f"**{scene[0]} `{scene[3]}`**", flush=True)
            for i, link in enumerate(LINKS):
                got = plan(args, scene, trace, ["--link", link])
                if i == 0:
                    print(f"(measured: {got['measured']['alone_ms']:.1f} ms alone on one core)\n")
                    print("| link | schedule | " + " | ".join(map(str, WORKERS)) + " |")
                    print("|---|---|" + "---|" * len(WORKERS))
                for schedule in ["region", "slab"]:
                    rows = [r for r in got["predicted"] if r["schedule"] == schedule]
                    cells = [f"{100 * r['latency_efficiency']:.0f} / "
                             f"{100 * r['throughput_efficiency']:.0f} {r['bound_by']}" for r in rows]
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
                          f"{r['predicted_each_ms']:.1f} | {off:+.0f} % | {r['master_cpu_ms']:.1f} | "
                          f"{r['workers_cpu_ms']:.1f} | {100 * r['busy']:.0f} % |", flush=True)
                print(flush=True)


main()
