#!/usr/bin/env python3
"""Where a frame's time goes, in nanoseconds and cycles a unit of work, and how near adding is to the roof.

    python3 docs/measurements/scripts/roofline.py --slabcast target/profiling/slabcast -- VOLUME --tf NAME [flags of bench]

(`cargo build --profile profiling` keeps the line numbers that it needs.)

Runs `slabcast lab bench` on one thread under `perf record` (by the clock: virtual machines count no cycles), asks
llvm-addr2line which functions each sample was in, those inlined included, and adds them up by stage. Units
are bench's own counts. Cycles are those of the frequency that --ghz says or /proc/cpuinfo names.

Then docs/measurements/scripts/roof.rs is compiled by rustc and says how many bytes a second this machine reads, adds to and writes
back: in as much memory as a part's sums take, and in 16 KiB. That is the roof over adding, whatever the clock.
"""

import argparse
import collections
import json
import pathlib
import re
import subprocess
import sys
import tempfile

HERTZ = 2000
# The first that a function's chain of callers has in it; what is left is not of a frame's stages.
STAGES = [
    ("toss", r"\btoss\b|open_brick|near_all|move_inside|FlatStage.*::toss"),
    ("close", r"\bclose|touched::wide"),
    ("light", r"payloads|light_all"),
    ("add", r"pixel_records::"),
    ("look again, place sections", r"\bsplat\b|splat::records|\btouch\b|render_records"),
    ("project", r"Seen|\btight\b|overlaps|View::project|front_to_back|slabcast::local|\bcorner\b|render_into|each_pixel|Part::end"),
]


def addresses(perf, exe):
    """Samples by address in the program, and all of them."""
    maps, samples, total = [], collections.Counter(), 0
    text = subprocess.run(["perf", "script", "-i", perf, "-F", "ip,dso", "--show-mmap-events"],
                          check=True, capture_output=True, text=True).stdout
    for line in text.splitlines():
        m = re.search(r"\[0x([0-9a-f]+)\(0x([0-9a-f]+)\) @ 0x([0-9a-f]+) .*r-xp (\S+)", line)
        if m:
            if m[4] == exe:
                maps.append([int(x, 16) for x in m.groups()[:3]])
            continue
        m = re.search(r"([0-9a-f]{6,})\s+\((\S+)\)", line)
        if m:
            total += 1
            if m[2] == exe:
                samples[int(m[1], 16)] += 1
    loads = [[int(x, 16) for x in m] for m in re.findall(
        r"^\s+LOAD\s+0x([0-9a-f]+) 0x([0-9a-f]+) 0x[0-9a-f]+ 0x([0-9a-f]+)",
        subprocess.run(["readelf", "-lW", exe], check=True, capture_output=True, text=True).stdout, re.M)]
    found = collections.Counter()
    for ip, n in samples.items():
        for base, size, offset in maps:
            at = ip - base + offset
            if base <= ip < base + size:
                found.update({at - o + v: n for o, v, s in loads if o <= at < o + s})
    return found, total


def chains(exe, found):
    """The functions of each address, the innermost first."""
    text = subprocess.run(["llvm-addr2line", "-f", "-i", "-C", "-a", "-e", exe], check=True, text=True,
                          input="\n".join(map(hex, found)), capture_output=True).stdout
    out, at = {}, None
    for line in text.splitlines():
        if re.fullmatch(r"0x[0-9a-f]+", line):
            at = int(line, 16)
            out[at] = []
        else:
            out[at].append(line)
    return out


def roofed(bench, seconds):
    """Says how many bytes adding moves in so many seconds a frame, beside what the machine can."""
    adds = bench["adds"]
    if not adds or not seconds:
        print("\nadding: each voxel has footprints of its own, so bytes are not counted")
        return
    across, down = adds["pixels"]
    each = 2 * across * down * adds["bytes"]
    # Rows of a part are 66 pixels apart.
    part = 64 * 66 * adds["bytes"]
    source = pathlib.Path(__file__).with_name("roof.rs")
    with tempfile.TemporaryDirectory() as folder:
        roof = f"{folder}/roof"
        subprocess.run(["rustc", "--edition", "2024", "-O", "-o", roof, str(source)], check=True)
        roof = json.loads(subprocess.run([roof, "16384", str(part)], check=True, capture_output=True, text=True).stdout)
    top, near = roof["gb_a_second"][str(part)], roof["gb_a_second"]["16384"]
    moved = each * bench["splatted"] / 1e9
    print(f"\nadding: {across}x{down} pixels of {adds['bytes']} bytes, read and written: {each:,} bytes a voxel, "
          f"{moved:.2f} GB a frame, {moved / seconds:.0f} GB/s\n"
          f"the roof, {roof['registers']}: {top:.0f} GB/s in a part's {part // 1024} KiB, {near:.0f} in 16 KiB; "
          f"adding reaches {100 * moved / seconds / top:.0f} %, and the frame {100 * moved / (bench['median_ms'] / 1e3) / top:.0f} %")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--slabcast", required=True, type=pathlib.Path)
    parser.add_argument("--ghz", type=float)
    parser.add_argument("--functions", action="store_true", help="list what no stage has, too")
    parser.add_argument("scene", nargs="+")
    args = parser.parse_args()
    exe = str(args.slabcast.resolve())
    ghz = args.ghz or float(re.search(r"cpu MHz\s*: ([0-9.]+)", open("/proc/cpuinfo").read())[1]) / 1e3
    with tempfile.TemporaryDirectory() as folder:
        perf = f"{folder}/perf.data"
        bench = json.loads(subprocess.run(
            ["perf", "record", "-q", "-F", str(HERTZ), "-o", perf, exe, "lab", "bench", *args.scene, "--threads", "1",
             "--pixels", "0", "--json"], check=True, capture_output=True, text=True).stdout)
        found, total = addresses(perf, exe)
    frames = len(bench["each_ms"])
    stages, rest = collections.Counter(), collections.Counter()
    for at, chain in chains(exe, found).items():
        # Of names as of functions alone: all that runs on lanes is called from splat's dispatch.
        names = re.sub(r"splat::(run_avx\w+|Simd)", "", " < ".join(chain[::2]))
        stage = next((s for s, pattern in STAGES if re.search(pattern, names)), "else")
        stages[stage] += found[at]
        if stage == "else":
            rest[" < ".join(chain[::2][:3])[:110]] += found[at]
    of_frame = sum(stages[s] for s, _ in STAGES)
    print(f"{bench['simd']}, {bench['quality']['sums']} sums; {frames} frames, median {bench['median_ms']:.1f} ms; "
          f"{ghz:.2f} GHz; {total} samples, of which {of_frame} in the stages of frames\n")
    print("| stage | ms a frame | share | units a frame | ns a unit | cycles a unit |\n|---|--:|--:|---|--:|--:|")
    splatted = ("voxels splatted", bench["splatted"])
    units = {"toss": ("voxels tossed", bench["tossed"]), "add": splatted, "look again, place sections": splatted, "light": splatted}
    for stage, _ in STAGES:
        ms = stages[stage] * 1e3 / HERTZ / frames
        unit, n = units.get(stage, ("", 0))
        each = f"{ms * 1e6 / n:.0f} | {ms * 1e6 / n * ghz:.0f}" if n else " | "
        print(f"| {stage} | {ms:.1f} | {100 * stages[stage] / of_frame:.0f} % | {f'{n:,} {unit}' if n else ''} | {each} |")
    roofed(bench, stages["add"] / HERTZ / frames)
    if args.functions:
        for name, n in rest.most_common(25):
            print(f"{n:6} {name}")


if __name__ == "__main__":
    main()
