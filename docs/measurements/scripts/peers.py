#!/usr/bin/env python3
"""Runs slabcast and other renderers in turn, on the same scenes, and prints their ratios.

    cargo build --release --locked
    python3 docs/measurements/scripts/peers.py --peers DIR --data DIR --venv DIR [--only ROW] [--rounds N]

--peers has the scripts that drive the others (vtk_peer.py, volpack_peer.py, pv_peer.py, common.py),
--data the volumes, --venv a Python with vtk, numpy, pynrrd and pillow; VolPack needs libvolpack1-dev
and gcc, ParaView its Debian packages (paraview, python3-paraview, openmpi-bin, xvfb). What is not
there is left out, and the tables say so. Python's standard library is enough for this file and for
peers_*.py beside it, but for peers_pictures.py, which runs in the venv.

In a round every contender runs once, slabcast and peers in turn, and rounds alternate in
direction: a machine that drifts hits both. A time is camera set to picture in memory, the first
view left out. Rows are kept in --keep as soon as they are measured. A row that is there, from the
same binary and as many rounds and frames, is not measured again unless --only names it, so an
interrupted run goes on. The tables go to stdout and to --keep/peers.md; docs/measurements/performance.md
quotes the rows that its conclusions rest on.
"""

import argparse
import collections
import hashlib
import json
import os
import pathlib
import sys
import tempfile
import time

import peers_run
import peers_tables


Contender = collections.namedtuple("Contender", "name kind flags")


class Row:
    """A scene. `contenders` renders it, `reach` is (peer, how many times faster than it)."""

    def __init__(self, name, volume, preset, size, ours, theirs=(), projection="ortho", eps="1/512",
                 frames=None, rounds=None, reach=(), finest=()):
        self.name, self.volume, self.preset, self.size = name, volume, preset, size
        self.projection, self.persp, self.eps = projection, projection == "persp", eps
        self.frames, self.rounds, self.reach, self.finest = frames, rounds, reach, finest
        self.contenders = in_turn(ours, theirs)

    def scene(self):
        return (f"{self.volume} peer-{self.preset}, {self.projection}, {self.size}"
                + (f", eps {self.eps}" if self.eps != "1/512" else ""))


def in_turn(ours, theirs):
    """A B A B: after each of ours one of theirs, as long as there are."""
    ours, theirs, out = list(ours), list(theirs), []
    while ours or theirs:
        for queue in (ours, theirs):
            if queue:
                out.append(queue.pop(0))
    return out


def slabcast(sums=("i16", "i32"), threads=(1,), **flags):
    """slabcast in its qualities, in one process."""
    return [Contender(f"slabcast {s}" + "".join(f", {k} {v}" for k, v in flags.items())
                      + (f", {t} threads" if t > 1 else ""), "slabcast",
                      {"sums": s, "threads": t, **flags})
            for t in threads for s in sums]


def sheets():
    """slabcast in its default quality, with planes of 1 vox, and in the paper's order."""
    return (slabcast() + slabcast(("i16",), thickness="1")
            + slabcast(("i16",), classify="before"))


def cluster(workers):
    return Contender(f"slabcast, {workers} worker process" + ("es" if workers > 1 else ""), "cluster",
                     {"workers": workers, "sums": "i16"})


def paraview(ranks):
    return Contender(f"ParaView, {ranks} rank" + ("s" if ranks > 1 else ""), "paraview",
                     {"ranks": ranks})


VTK, VTK_2 = Contender("VTK", "vtk", {}), Contender("VTK, 2 threads", "vtk", {"threads": 2})
VOLPACK = Contender("VolPack", "volpack", {})
OWN_AND_VTK = ("slabcast", "vtk")
MAIN = [
    Row("opaque-512", "mri256", "opaque", 512, sheets(), [VTK, VOLPACK], finest=OWN_AND_VTK,
        reach=[("VTK", 6)]),
    Row("opaque-1024", "mri256", "opaque", 1024, sheets(), [VTK, VOLPACK], finest=OWN_AND_VTK,
        reach=[("VTK", 10)]),
    Row("persp-512", "mri256", "opaque", 512, sheets(), [VTK], "persp", finest=OWN_AND_VTK,
        reach=[("VTK", 7)]),
    Row("semi-512", "mri256", "semi", 512, sheets(), [VTK, VOLPACK], finest=OWN_AND_VTK,
        reach=[("VTK", 3.5)]),
    Row("vessels-512", "aneurism", "vessels", 512, sheets(), [VTK, VOLPACK], finest=OWN_AND_VTK,
        reach=[("VTK", 25)]),
    Row("volpack-320", "mri256", "opaque", 320, sheets(), [VOLPACK, VTK], eps="0.02",
        finest=("slabcast", "vtk", "volpack"),
        reach=[("VolPack", 1)]),
]
THREADS = Row("threads", "mri256", "opaque", 512, slabcast(("i16",), (1, 2)), [VTK, VTK_2])
CULLING = Row("culling", "mri256", "opaque", 512,
              slabcast(("i16",), eps="1/512") + slabcast(("i16",), eps="0"), frames=6)
PROCESSES = [
    Row(f"paraview-{preset}", volume, preset, 512,
        [cluster(2), *slabcast(("i16",), (2,)), cluster(1)], [paraview(2), paraview(1)])
    for volume, preset in (("mri256", "opaque"), ("aneurism", "vessels"))]
# The first is what the others are compared with.
SIZES = [Row(f"size-{edge}-{px}", f"mri256/{edge}", "opaque", px, slabcast(("i16",)), [VTK],
             frames=6, rounds=1) for edge in (256, 128, 512) for px in (512, 1024, 2048)]
GROUPS = {"main": MAIN, "threads": [THREADS], "culling": [CULLING], "processes": PROCESSES,
          "sizes": SIZES}
ROWS = [row for rows in GROUPS.values() for row in rows]


def stolen():
    """Seconds that the hypervisor gave to others since the machine started, all cores together."""
    ticks = pathlib.Path("/proc/stat").read_text().split("\n", 1)[0].split()
    return int(ticks[8]) / os.sysconf("SC_CLK_TCK")


def run_row(bench, row, stamp):
    """Times first, in turn; pictures after them."""
    rounds = min(row.rounds or bench.o.rounds, bench.o.rounds)
    got = {c.name: {"rounds": []} for c in row.contenders}
    began, steal, load = time.monotonic(), stolen(), os.getloadavg()[0]
    for r in range(rounds):
        for c in row.contenders if r % 2 == 0 else reversed(row.contenders):
            entry = got[c.name]
            if "missing" in entry:
                continue
            print(f"{row.name}, round {r + 1} of {rounds}: {c.name} ...", file=sys.stderr, flush=True)
            try:
                each, said = bench.run(row, c, judge=r == 0 and bool(row.finest))
                entry["rounds"].append(each)
                entry.setdefault("said", said)
            except peers_run.Missing as e:
                entry["missing"] = str(e)
                print(f"    left out: {e}", file=sys.stderr, flush=True)
    result = {**stamp, "row": row.name, "got": got, "date": time.strftime("%Y-%m-%d %H:%M"),
              "load": [load, os.getloadavg()[0]], "stolen_s": stolen() - steal,
              "timed_s": time.monotonic() - began}
    if row.finest and not bench.o.no_pictures:
        try:
            result["pictures"] = bench.pictures(row, row.contenders, got)
        except peers_run.Missing as e:
            result["pictures"] = {"own": {}, "beside": {}, "missing": {"every renderer": str(e)}}
    result["took_s"] = time.monotonic() - began
    return result


# -- the program --------------------------------------------------------------------------------


def save(path, text):
    part = path.with_suffix(path.suffix + ".part")
    part.write_text(text)
    part.replace(path)


def main():
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    root = peers_run.HERE.parents[2]
    p.add_argument("--peers", default=root / "../shared/peers", help="scripts that drive the peers")
    p.add_argument("--data", default=root / "../shared/data", help="mri256.nrrd, aneurism.nrrd")
    p.add_argument("--slabcast", default=pathlib.Path(
        os.environ.get("CARGO_TARGET_DIR", root / "target")) / "release" / "slabcast")
    p.add_argument("--venv", default="venv", help="Python with vtk, numpy, pynrrd, pillow")
    p.add_argument("--only", action="append", choices=[r.name for r in ROWS], metavar="ROW",
                   help="measure this row, again if need be: " + ", ".join(r.name for r in ROWS))
    p.add_argument("--rounds", type=int, default=3)
    p.add_argument("--frames", type=int, default=18, help="views of a run, the first one too")
    p.add_argument("--pixels", type=int, default=1024, help="pixels at which slabcast is judged")
    p.add_argument("--keep", default=pathlib.Path(tempfile.gettempdir()) / "slabcast-peers",
                   help="folder for results, pictures and resampled volumes")
    p.add_argument("--no-pictures", action="store_true", help="times alone")
    p.add_argument("--tables", action="store_true", help="measure nothing; tables of what is kept")
    o = p.parse_args()
    if o.rounds < 1 or o.frames < 2:
        p.error("--rounds wants 1 or more, --frames 2 or more")
    if not os.access(o.slabcast, os.X_OK):
        sys.exit(f"no program at {o.slabcast}: `cargo build --release --locked` or --slabcast PATH")
    bench = peers_run.Bench(o)
    if bench.no_peers:
        print(f"WITHOUT PEERS: {bench.no_peers}", file=sys.stderr)
    stamp = {"binary": hashlib.sha256(pathlib.Path(o.slabcast).read_bytes()).hexdigest(),
             "version": peers_run.execute([o.slabcast, "--version"]).split()[-1],
             "rounds": o.rounds, "frames": o.frames}
    results = {}
    for row in ROWS:
        kept = bench.keep / "rows" / f"{row.name}.json"
        old = json.loads(kept.read_text()) if kept.exists() else None
        asked = row.name in o.only if o.only else old is None or any(old[k] != stamp[k] for k in stamp)
        if asked and not o.tables:
            old = run_row(bench, row, stamp)
            save(kept, json.dumps(old, indent=1))
        if old:
            results[row.name] = old
    if not results:
        sys.exit("nothing measured")
    text = peers_tables.report(GROUPS, results)
    save(bench.keep / "peers.md", text)
    save(bench.keep / "peers.json", json.dumps(results, indent=1))
    print(text)
    print(f"{sum(r['took_s'] for r in results.values()) / 60:.0f} minutes in all; JSON, pictures and "
          f"this text in {bench.keep}", file=sys.stderr)


if __name__ == "__main__":
    main()
