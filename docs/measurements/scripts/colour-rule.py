"""Measures what rules of compositing and thicknesses of sheets buy and cost (../colour-rule.md).

    cargo build --release --locked
    python3 docs/measurements/scripts/colour-rule.py --data DIR --keep DIR --times

runs `slabcast lab check colour-rule` on five volumes and the sample, once with the default eps and once
with eps 0, and prints the tables. Results are kept as JSON lines in --keep; what is there already is not measured again, so an interrupted run
goes on. Without --times frames are drawn on all cores and the column stays empty.
"""

import argparse
import json
import pathlib
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[3]
SCENES = [
    ("mri256", "mri256.nrrd", ["--up=-y", "--tf", "peer-opaque"]),
    ("mouse_skull", "mouse_skull.nrrd", ["--up=z", "--tf", "peer-skull"]),
    ("aneurism", "aneurism.nrrd", ["--up=z", "--tf", "peer-vessels"]),
    ("heptane", "heptane.nrrd", ["--up=x", "--tf", "peer-semi"]),
    ("bonsai", "bonsai.nrrd", ["--up=y", "--tf", "peer-opaque"]),
    ("sample", None, ["--tf", "auto"]),
]


def number(x):
    if x is None:
        return "-"
    return "0" if x == 0 else f"{x:.3f}" if x >= 0.01 else f"{x:.1e}"


def table(name, eps, lines):
    out = [f"### {name}, eps {eps}", ""]
    own = any(line["own_limit"] for line in lines)
    out.append("| rule | vox | RMSE | max | " + ("own RMSE | own max | " if own else "")
               + "pop | pop max | ms |")
    out.append("|---|--:|--:|--:|" + ("--:|--:|" if own else "") + "--:|--:|--:|")
    for line in lines:
        limit, mine = line["limit"], line["own_limit"] or {}
        cells = [line["rule"], f"{line['thickness']:g}", number(limit["rmse"]), number(limit["max"])]
        if own:
            cells += [number(mine.get("rmse")), number(mine.get("max"))]
        ms = "" if line["ms"] is None else f"{line['ms']:.0f}"
        cells += [number(line["pop"]), number(line["pop_max"]), ms]
        out.append("| " + " | ".join(cells) + " |")
    return out + [""]


def main():
    p = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    p.add_argument("--data", required=True, help="folder with the volumes")
    p.add_argument("--keep", required=True, help="folder for results")
    p.add_argument("--binary", default=str(ROOT / "target/release/slabcast"))
    p.add_argument("--kept", action="store_true", help="measure nothing: tables of what is kept")
    p.add_argument("--steps", default="8", help="in which the sheets move by one sheet")
    p.add_argument("--times", action="store_true", help="one thread, with times; quiet machines only")
    a = p.parse_args()
    keep = pathlib.Path(a.keep)
    keep.mkdir(parents=True, exist_ok=True)
    timed = "one thread" if a.times else "no times"
    out = [f"Paths of {a.steps} steps a sheet, {timed} (`--steps {a.steps}`).", ""]
    for eps in ["1/512", "0"]:
        for name, file, flags in SCENES:
            volume = pathlib.Path(a.data) / file if file else ROOT / "samples/mni152_t1.nii.gz"
            timed = a.times and eps != "0"
            result = keep / f"{name}-{eps.replace('/', '_')}{'-times' if timed else ''}.jsonl"
            if a.kept and not result.exists():
                continue
            if not result.exists():
                command = [a.binary, "lab", "check", "colour-rule", str(volume), *flags,
                           "--azimuth", "20", "--eps", eps, "--steps", a.steps, "--json"]
                done = subprocess.run(command + (["--times"] if timed else []),
                                      check=True, stdout=subprocess.PIPE, text=True)
                result.write_text(done.stdout)
            out += table(name, eps, [json.loads(x) for x in result.read_text().splitlines()])
    print("\n".join(out))


if __name__ == "__main__":
    main()
