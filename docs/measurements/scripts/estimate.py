#!/usr/bin/env python3
"""Holds what a frame's statistics say of errors against the reference.

    python3 docs/measurements/scripts/estimate.py --slabcast target/release/slabcast --data ../shared/data [--scene mri256]

Each volume is drawn in two views under two looks with --stats; the same views are judged by
`slabcast lab error`. A row has, for each source, what the statistics estimate (RMSE in 1/255), what the
reference finds, and their ratio; of bounds, how many times the largest error that was found they are.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

UP = {"mri256": ["--up=-y"], "chris_t1": ["--up=-y"]}
AZIMUTHS = (33, 110)
# Name in the statistics, and in what `slabcast lab error` says.
ESTIMATES = {"thickness": "thickness", "rounding": "rounding_positions", "truncation": "truncation",
             "ripple": "ripple"}
BOUNDS = {"cutoff": "cutoff", "quantisation": "quantisation", "rounding": "rounding_positions",
          "truncation": "truncation"}


def run(*command):
    return subprocess.run(command, check=True, capture_output=True).stdout


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--slabcast", required=True)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--scene", help="volumes whose name has this in it")
    parser.add_argument("--looks", default="peer-opaque,peer-semi")
    parser.add_argument("--thickness", default="1")
    parser.add_argument("--projection", default="ortho")
    parser.add_argument("--model-pixels", default="512", help="pixels for the model's own errors")
    args = parser.parse_args()
    ratios = {name: [] for name in ESTIMATES}
    widths = {name: [] for name in BOUNDS}
    broken = 0
    head = [*ESTIMATES, *(f"bound of {name}" for name in BOUNDS)]
    print(f"| scene | {' | '.join(head)} |\n|---|{'--:|' * len(head)}")
    with tempfile.TemporaryDirectory() as folder:
        stats = pathlib.Path(folder) / "stats.jsonl"
        for file in sorted(args.data.glob("*.nrrd")):
            if args.scene and args.scene not in file.stem:
                continue
            for look in args.looks.split(","):
                for thickness in args.thickness.split(","):
                    scene = [str(file), *UP.get(file.stem, []), "--tf", look, "--thickness", thickness,
                             "--projection", args.projection]
                    run(args.slabcast, "render", *scene, "--frames", "2", "--start", str(AZIMUTHS[0]),
                        "--step", str(AZIMUTHS[1] - AZIMUTHS[0]), "-o", folder, "--force",
                        "--stats", str(stats), "--quiet")
                    for line, azimuth in zip(stats.read_text().splitlines(), AZIMUTHS):
                        said = json.loads(line)["error"]
                        found = json.loads(run(args.slabcast, "lab", "error", *scene, "--azimuth", str(azimuth),
                                               "--model-pixels", args.model_pixels, "--json"))
                        row = [f"{file.stem} {look} {thickness} {azimuth}"]
                        for name, truth in ESTIMATES.items():
                            estimate, truth = said[name]["estimate"], found[truth]["rmse"]
                            if not estimate or not truth:
                                row.append(f"{estimate} of {truth}")
                                continue
                            ratios[name].append(estimate / truth)
                            row.append(f"{estimate:.4f} of {truth:.4f}: {estimate / truth:.2f}")
                        for name, truth in BOUNDS.items():
                            bound, truth = said[name]["bound"], found[truth]["max"]
                            # What is found of integers is below what is found of floats.
                            if not bound or truth < 1e-6:
                                row.append(f"{bound} of {truth:.2g}")
                                continue
                            broken += truth > bound
                            widths[name].append(bound / truth)
                            row.append(f"{bound:.3g} of {truth:.3g}: {bound / truth:.0f}")
                        print(f"| {' | '.join(row)} |", flush=True)
    for name, all_of in ratios.items():
        if all_of:
            all_of.sort()
            good = sum(0.5 <= r <= 2.0 for r in all_of)
            print(f"{name}: {good} of {len(all_of)} within a factor of 2; ratios {all_of[0]:.2f} to "
                  f"{all_of[-1]:.2f}, median {all_of[len(all_of) // 2]:.2f}", file=sys.stderr)
    for name, all_of in widths.items():
        if all_of:
            all_of.sort()
            print(f"bound of {name}: {all_of[0]:.0f} to {all_of[-1]:.0f} times the largest found, median "
                  f"{all_of[len(all_of) // 2]:.0f}", file=sys.stderr)
    print(f"{broken} bounds were exceeded", file=sys.stderr)


if __name__ == "__main__":
    main()
