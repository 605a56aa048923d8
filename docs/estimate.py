#!/usr/bin/env python3
"""Holds the estimate in a frame's statistics against the reference.

    python3 docs/estimate.py --slabcast target/release/slabcast --data ../shared/data [--scene mri256]

Each volume is drawn in two views under two looks and three thicknesses with --stats; the same views are
judged by `slabcast error`. A row has the estimate of what the thickness costs (RMSE in 1/255), what it
costs against the limit, and their ratio.
"""

import argparse
import json
import pathlib
import subprocess
import sys
import tempfile

UP = {"mri256": ["--up=-y"], "chris_t1": ["--up=-y"]}
AZIMUTHS = (33, 110)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slabcast", required=True)
    parser.add_argument("--data", required=True, type=pathlib.Path)
    parser.add_argument("--scene", help="volumes whose name has this in it")
    parser.add_argument("--looks", default="peer-opaque,peer-semi")
    parser.add_argument("--thickness", default="0.5,1,2")
    args = parser.parse_args()
    ratios = []
    print("| volume | look | thickness | azimuth | estimate | error | ratio |")
    print("|---|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        stats = pathlib.Path(folder) / "stats.jsonl"
        for file in sorted(args.data.glob("*.nrrd")):
            if args.scene and args.scene not in file.stem:
                continue
            for look in args.looks.split(","):
                for thickness in args.thickness.split(","):
                    scene = [str(file), *UP.get(file.stem, []), "--tf", look, "--thickness", thickness]
                    step = str(AZIMUTHS[1] - AZIMUTHS[0])
                    subprocess.run(
                        [args.slabcast, "render", *scene, "--frames", "2", "--start", str(AZIMUTHS[0]),
                         "--step", step, "-o", folder, "--force", "--stats", str(stats), "--quiet"],
                        check=True, capture_output=True)
                    for line, azimuth in zip(stats.read_text().splitlines(), AZIMUTHS):
                        estimate = json.loads(line)["error"]["thickness"]["estimate"]
                        judged = subprocess.run(
                            [args.slabcast, "error", *scene, "--azimuth", str(azimuth), "--json"],
                            check=True, capture_output=True)
                        truth = json.loads(judged.stdout)["thickness"]["rmse"]
                        row = [file.stem, look, thickness, azimuth]
                        if not estimate or not truth:
                            print(f"| {' | '.join(map(str, row))} | {estimate} | {truth} | |", flush=True)
                            continue
                        ratios.append(estimate / truth)
                        row += [f"{estimate:.4f}", f"{truth:.4f}", f"{ratios[-1]:.2f}"]
                        print(f"| {' | '.join(map(str, row))} |", flush=True)
    ratios.sort()
    good = sum(0.5 <= r <= 2.0 for r in ratios)
    print(f"\n{good} of {len(ratios)} within a factor of 2; ratios {ratios[0]:.2f} to {ratios[-1]:.2f}, "
          f"median {ratios[len(ratios) // 2]:.2f}", file=sys.stderr)


if __name__ == "__main__":
    main()
