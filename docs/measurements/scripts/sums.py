#!/usr/bin/env python3
"""What 16-bit sums round away, and where `--sums auto` takes them.

    python3 docs/measurements/scripts/sums.py --slabcast target/release/slabcast VOLUME[=FLAGS] ...

Draws each volume with each transfer function in 16-bit sums, lets `slabcast lab error` say how far whole numbers
put the picture off (RMSE and maximum in 1/255), and asks `slabcast lab bench` which sums `auto` takes. Prints a
table with a row a transfer function.
"""

import argparse
import json
import pathlib
import subprocess
import tempfile


def fog(thin, solid, at):
    """Fog of one opacity from an eighth of the range, and a solid from `at` on."""
    opacities = [[0, 0], [0.12, 0], [0.12, thin]]
    if solid:
        opacities += [[at, thin], [at, solid]]
    opacities.append([1, solid or thin])
    return {"version": 1, "domain": "unit", "colors": [[0, 0.8, 0.7, 0.6], [1, 1, 1, 0.9]], "opacities": opacities}


LOOKS = {
    "`peer-semi`": "peer-semi",
    "`grey`": "grey",
    "fog of 0.01": fog(0.01, None, None),
    "fog of 0.1": fog(0.1, None, None),
    "step to 0.9": fog(0.9, None, None),
    "`peer-opaque`": "peer-opaque",
    "`auto`": "auto",
    "`bone`": "bone",
    "`peer-vessels`": "peer-vessels",
    "fog of 0.003, solid of 0.9": fog(0.003, 0.9, 0.45),
    "fog of 0.01, solid of 0.9999": fog(0.01, 0.9999, 0.45),
}


def ask(args, *flags):
    return json.loads(subprocess.run([args.slabcast, *flags, "--json"], check=True, capture_output=True, text=True).stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--slabcast", required=True)
    parser.add_argument("--pixels", default="1024")
    parser.add_argument("volumes", nargs="+")
    args = parser.parse_args()
    print("| transfer function | 16 bits in | off by, RMSE | max |\n|---|---|--:|--:|")
    with tempfile.TemporaryDirectory() as folder:
        for name, look in LOOKS.items():
            if isinstance(look, dict):
                path = pathlib.Path(folder, "tf.json")
                path.write_text(json.dumps(look))
                look = str(path)
            taken, rmse, worst = 0, [], []
            for volume in args.volumes:
                file, _, flags = volume.partition("=")
                scene = [file, *(flags and [flags] or []), "--tf", look]
                drawn = ask(args, "lab", "bench", *scene, "--frames", "1", "--pixels", "0")
                taken += drawn["quality"]["sums"] == "i16"
                off = ask(args, "lab", "error", *scene, "--sums", "i16", "--pixels", args.pixels)["quantisation"]
                rmse.append(off["rmse"])
                worst.append(off["max"])
            span = lambda n: f"{min(n):.3f} to {max(n):.3f}"
            print(f"| {name} | {taken} of {len(args.volumes)} | {span(rmse)} | {span(worst)} |", flush=True)


if __name__ == "__main__":
    main()
