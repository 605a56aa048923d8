#!/usr/bin/env python3
"""Does slabcast keep its word? Asks for errors and times on real volumes and checks what comes.

    python3 docs/measurements/scripts/word.py --slabcast target/release/slabcast --data ../shared/data [--only error|budget]

Each scene is asked for with --error, --error-max and --budget, measured once (into a folder of its
own), and then judged in views and at pixels that the choice did not see: `slabcast lab bench` at two
other azimuths with another seed, the worst of which counts. Times are medians of seven views, and
mean something on an idle machine alone. Prints a table in Markdown.
"""
import argparse
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

LOOKS = ["auto", "skin", "peer-semi"]
# Which way up, where the file does not say.
UP = {"mri256": ["--up=-y"]}
AZIMUTHS = [47, 291]


def run(command, cache):
    env = {**os.environ, "SLABCAST_CACHE": cache}
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    if done.returncode != 0:
        return None, done.stderr.strip().splitlines()[-1]
    return json.loads(done.stdout), done.stderr


def name(quality, shrink):
    eps = f"1/{round(1 / quality['eps'])}" if quality["eps"] else "0"
    small = f", size 1/{shrink}" if shrink > 1 else ""
    return f"{quality['thickness']:g}, {eps}, {quality['sums']}{small}"


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slabcast", required=True)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--only", choices=["error", "budget"])
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    parser.add_argument("--scene", help="volumes whose name has this in it")
    args = parser.parse_args()
    aims = []
    if args.only != "budget":
        aims += [("--error", "1/255"), ("--error", "0.3/255"), ("--error-max", "3/255")]
    if args.only != "error":
        aims += [("--budget", "100ms"), ("--budget", "40ms")]
    kept = asked = 0
    print("| volume | look | asked | chosen: thickness, eps, sums | came to | |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as cache:
        files = sorted(args.data.glob("*.nrrd")) + sorted(args.data.glob("large/*.nrrd"))
        for file, tf in [(f, tf) for f in files for tf in LOOKS]:
            volume, flags = file.stem, UP.get(file.stem, []) + ["--threads", str(args.threads)]
            if args.scene and args.scene not in volume:
                continue
            for flag, value in aims:
                base = [args.slabcast, "lab", "bench", str(file), *flags, "--tf", tf, "--json", flag, value]
                worst, chosen, trouble = 0.0, None, None
                if flag == "--budget":
                    # A render comes as a user has it: by a cluster in the process.
                    out = pathlib.Path(cache) / "out"
                    stats = pathlib.Path(cache) / "stats.jsonl"
                    command = [args.slabcast, "render", str(file), *flags, "--tf", tf, flag, value,
                               "-o", str(out), "--force", "--stats", str(stats), "--frames", "18",
                               "--step", "20", "--start", "47"]
                    done = subprocess.run(command, capture_output=True, text=True,
                                          env={**os.environ, "SLABCAST_CACHE": cache})
                    if done.returncode != 0:
                        trouble = done.stderr.strip().splitlines()[-1]
                    else:
                        lines = [json.loads(x) for x in stats.read_text().splitlines()]
                        # What it says itself: from one frame to the next.
                        said = re.search(r"then ([0-9.]+) (ms|s) each", done.stdout + done.stderr)
                        worst = float(said[1]) * (1.0 if said[2] == "ms" else 1e3)
                        chosen = name(lines[0]["quality"], 2 if "drawn at" in done.stderr else 1)
                        limit = float(value.removesuffix("ms")) * 1.15
                        came = f"{worst:.1f} ms"
                else:
                    for azimuth in AZIMUTHS:
                        b, said = run(base + ["--azimuth", str(azimuth), "--seed", "77",
                                              "--pixels", "4096"], cache)
                        if b is None:
                            trouble = said
                            break
                        figure = "rmse" if flag == "--error" else "most_999"
                        worst = max(worst, b["limit"][figure])
                        chosen = name(b["quality"], b["magnify"])
                    limit = 255 * eval(value, {"__builtins__": {}})
                    came = f"{worst:.3f}"
                asked += 1
                if trouble:
                    print(f"| {volume} | {tf} | {flag} {value} | | {trouble} | refused |", flush=True)
                    continue
                good = worst <= limit
                kept += good
                verdict = "" if good else "**NOT KEPT**"
                print(f"| {volume} | {tf} | {flag} {value} | {chosen} | {came} | {verdict} |", flush=True)
    print(f"\n{kept} of {asked} kept.", file=sys.stderr)


if __name__ == "__main__":
    main()
