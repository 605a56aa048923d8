"""How docs/measurements/scripts/peers.py runs each renderer, and what it takes for a time and for an error.

A contender is run by its kind: `slabcast` (slabcast lab bench, in one process), `cluster` (slabcast
master and workers as processes), `vtk`, `volpack`, `paraview`. Whatever can't run raises Missing
with the reason; nothing else in the measurement stops for it.
"""

import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import types

import measure

HERE = pathlib.Path(__file__).resolve().parent
# The slowest run known is VTK at 512^3 and 2048 pixels with the machine busy: some 6 minutes.
PATIENCE_S = 1200
VOLUMES = {"mri256": ("mri256.nrrd", "--up=-y"), "aneurism": ("aneurism.nrrd", "--up=z")}
# VolPack's finest: 4 times the samples along each axis. 1024^3 voxels took 8.8 GiB and 5 minutes.
VOLPACK_FINER, VOLPACK_BYTES = 4, 10 << 30
# `finer` in common.py's place: opacities of a shorter step. Under the name `semi` volpack_peer.py
# keeps voxels of 0.002 and up, where it would drop those under 0.02 of any other preset.
FINER_PROTOCOL = """
import os
exec(open(os.environ["PEERS_PROTOCOL"]).read())
_p, _n = PRESETS[os.environ["PEERS_PRESET"]], float(os.environ["PEERS_FINER"])
_alpha = [np.interp(v, *zip(*_p["alpha"])) for v in range(256)]
PRESETS = {"semi": {"color": _p["color"],
                    "alpha": [(v, 1 - (1 - float(a)) ** (1 / _n)) for v, a in enumerate(_alpha)]}}
"""


class Missing(Exception):
    """A contender that can't run, and why."""


def execute(words, env=None):
    """Standard output of a command; Missing with its own words if it fails."""
    try:
        r = subprocess.run([str(w) for w in words], stdin=subprocess.DEVNULL, capture_output=True,
                           text=True, timeout=PATIENCE_S, env=dict(os.environ, **(env or {})))
    except (OSError, subprocess.TimeoutExpired) as e:
        raise Missing(str(e)) from e
    if r.returncode:
        lines = [x.strip() for x in (r.stderr + "\n" + r.stdout).splitlines() if x.strip("- \t")]
        told = [x for x in lines if "error" in x.lower() or "ERR|" in x]
        told = told or lines[-1:] or ["it said nothing"]
        raise Missing(f"{told[0][:300]} (exit code {r.returncode})")
    return r.stdout


class Bench:
    """Where things are; runs contenders of rows."""

    def __init__(self, options):
        self.o, self.keep = options, pathlib.Path(options.keep).resolve()
        self.python = pathlib.Path(options.venv).absolute() / "bin" / "python"
        for folder in ("rows", "out", "finest", "pictures"):
            (self.keep / folder).mkdir(parents=True, exist_ok=True)
        # A copy: volpack_peer.py compiles beside itself, and --peers is not ours to write in.
        self.scripts = self.keep / "peers"
        self.protocol, self.no_peers = None, None
        try:
            shutil.copytree(options.peers, self.scripts, dirs_exist_ok=True,
                            ignore=shutil.ignore_patterns("out", "venv", "__pycache__"))
            self.protocol = json.loads(self.helper("presets", self.scripts))
        except (OSError, shutil.Error, Missing) as e:
            self.no_peers = f"--peers and --venv don't make a peer that runs: {e}"

    def helper(self, *words):
        return execute([self.python, HERE / "peers_pictures.py", *words])

    def volume(self, name):
        """Path and axes of a volume; `mri256/512` is mri256 with 512 samples an edge."""
        name, _, edge = name.partition("/")
        file, axes = VOLUMES[name]
        path = pathlib.Path(self.o.data).absolute() / file
        if not path.exists():
            raise Missing(f"no {file} in {self.o.data}")
        if edge and edge != "256":
            source, path = path, self.keep / f"{name}-{edge}.nrrd"
            if not path.exists():
                part = path.with_suffix(".part")
                self.helper("resample", self.scripts, source, part, edge)
                part.replace(path)
        return path, axes

    # -- times ----------------------------------------------------------------------------------

    def run(self, row, contender, judge):
        """Milliseconds of every frame, the first one too, and what the renderer says of itself."""
        return getattr(self, contender.kind)(row, judge=judge, **contender.flags)

    def frames(self, row):
        return row.frames or self.o.frames

    def slabcast(self, row, judge, threads=1, **flags):
        path, axes = self.volume(row.volume)
        flags = {"eps": row.eps, **flags}
        said = json.loads(execute([
            self.o.slabcast, "lab", "bench", path, axes, "--tf", f"peer-{row.preset}", "--json",
            "--size", f"{row.size}x{row.size}", "--projection", row.projection,
            "--frames", self.frames(row), "--threads", threads,
            "--pixels", self.o.pixels if judge else 0, *[f"--{k}={v}" for k, v in flags.items()]]))
        return said["each_ms"], said

    def cluster(self, row, judge, workers, **flags):
        """Real processes over TCP: a master and workers of one thread, timed by the client.

        Several frames are in the making at a time, so what counts is how often one is there, as a
        file: the first, and from then on the mean. Without statistics, which nobody asks a peer for.
        """
        path, axes = self.volume(row.volume)
        options = types.SimpleNamespace(
            memory="512MiB", size=f"{row.size}x{row.size}", frames=self.frames(row),
            extra=["--projection", row.projection, *[f"--{k}={v}" for k, v in flags.items()]])
        with tempfile.TemporaryDirectory(dir=self.keep) as folder:
            try:
                r = measure.run(self.o.slabcast, path, f"peer-{row.preset}", [axes], workers, options,
                                pathlib.Path(folder), told=False)
            except SystemExit as e:
                raise Missing(" ".join(str(e).split())[:300]) from e
        said = re.search(r"([0-9.]+) (ms|s): the first after ([0-9.]+) (ms|s)", r["said"])
        if not said:
            raise Missing(f"slabcast render said: {r['said']}")
        total, first = (float(said[i]) * (1 if said[i + 1] == "ms" else 1000) for i in (1, 3))
        frames = options.frames
        each = (total - first) / max(frames - 1, 1)
        return [first] + [each] * (frames - 1), {"worker_mib": r["worker_mib"]}

    def peer(self, script, row, *more, out="out", env=None, **changed):
        if self.no_peers:
            raise Missing(self.no_peers)
        path, axes = self.volume(row.volume)
        out = self.keep / out
        flags = {"volume": path, "preset": row.preset, "size": row.size, "frames": self.frames(row),
                 "out": out, **changed}
        text = execute([self.python, self.scripts / script, axes,
                        *[f"--{k}={v}" for k, v in flags.items()],
                        *(["--persp"] if row.persp else []), *more], env)
        lines = [json.loads(x) for x in text.splitlines() if x.startswith("{")]
        said = lines[-1]
        said["picture"] = str(out / (said["summary"] + ".png"))
        return [x["ms"] for x in lines if "frame" in x], said

    def vtk(self, row, judge, threads=1):
        return self.peer("vtk_peer.py", row, threads=threads)

    def volpack(self, row, judge):
        return self.peer("volpack_peer.py", row)

    def paraview(self, row, judge, ranks):
        for tool in ("pvbatch", "mpirun", "Xvfb"):
            if shutil.which(tool) is None:
                raise Missing(f"`{tool}` is not installed")
        # pv_peer.py would start an X server that resets itself when its last client leaves, and
        # ParaView leaves once before it draws: on a busy machine it met the server in mid-reset
        # and died in 4 of 5 runs. With -noreset it never did.
        get, put = os.pipe()
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(put), "-noreset", "-screen", "0", "1280x1100x24"],
            pass_fds=[put], stdin=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(put)
        try:
            with os.fdopen(get) as told:
                display = told.readline().strip()
            if not display:
                raise Missing("Xvfb did not start")
            return self.peer("pv_peer.py", row, threads=1, ranks=ranks, env={"DISPLAY": f":{display}"})
        finally:
            server.terminate()
            server.wait()

    # -- pictures -------------------------------------------------------------------------------

    def own_picture(self, row, name, transfer, **flags):
        """slabcast's first view, in the peers' colours: their numbers are what is composited."""
        path, axes = self.volume(row.volume)
        folder = self.keep / "finest" / f"{row.name}-{name}".replace(" ", "-")
        folder.mkdir(exist_ok=True)
        tf = folder / "tf.json"
        tf.write_text(json.dumps(transfer))
        execute([self.o.slabcast, "render", path, axes, "--tf", tf, "--size", f"{row.size}x{row.size}",
                 "--projection", row.projection, "--azimuth", self.protocol["start"],
                 "-o", folder, "--force", *[f"--{k}={v}" for k, v in flags.items()]])
        return f"srgb:1:{folder / 'frame_0000.png'}"

    def transfer(self, row, ambient, one_colour=False):
        preset, shading = self.protocol["presets"][row.preset], self.protocol["shading"]
        colors = preset["color"]
        if one_colour:  # volpack_peer.py takes the colour of the value 100
            below = max((c for c in colors if c[0] <= 100), key=lambda c: c[0])
            above = min((c for c in colors if c[0] > 100), key=lambda c: c[0])
            part = (100 - below[0]) / (above[0] - below[0])
            mixed = [a + (b - a) * part for a, b in zip(below[1:], above[1:])]
            colors = [[0, *mixed], [255, *mixed]]
        return {"version": 1, "domain": "value", "color_space": "linear", "colors": colors,
                "opacities": preset["alpha"], "shading": {**shading, "ambient": ambient}}

    def finest(self, row, kind):
        """The first view by a peer's own finest setting; made once, since peers don't change."""
        kept = self.keep / "finest" / f"{kind}-{row.name}.json"
        if kept.exists():
            return json.loads(kept.read_text())["picture"]
        if kind == "vtk":
            _, said = self.peer("vtk_peer.py", row, out=f"finest/{row.name}", step=1 / 16, frames=1,
                                threads=os.cpu_count())
            picture = f"raw:1:{said['picture']}"
        else:
            n = VOLPACK_FINER
            memory = pathlib.Path("/proc/meminfo").read_text().split()
            free = int(memory[memory.index("MemAvailable:") + 1]) << 10
            if free < VOLPACK_BYTES:
                raise Missing(f"VolPack's finest wants {VOLPACK_BYTES >> 30} GiB, {free >> 30} are "
                              "free")
            path, _ = self.volume(f"{row.volume}/{256 * n}")
            shim = self.keep / "peers-finer"
            shutil.copytree(self.scripts, shim, dirs_exist_ok=True)
            (shim / "common.py").write_text(FINER_PROTOCOL)
            env = {"PEERS_PROTOCOL": str(self.scripts / "common.py"), "PEERS_PRESET": row.preset,
                   "PEERS_FINER": str(n)}
            _, said = self.peer(shim / "volpack_peer.py", row, "--max-ray-opacity=0.999", env=env,
                                out=f"finest/{row.name}", volume=path, preset="semi", size=row.size * n, frames=1)
            path.unlink()
            picture = f"raw:{n}:{said['picture']}"
        kept.write_text(json.dumps({"picture": picture}))
        return picture

    def compare(self, name, a, b):
        out = self.keep / "pictures" / f"{name.replace(' ', '-')}.png"
        return json.loads(self.helper("compare", out, a, b))

    def pictures(self, row, contenders, got):
        """Each contender against its own finest setting, and slabcast beside each peer."""
        if self.protocol is None:
            raise Missing(self.no_peers)
        ambient = self.protocol["shading"]["ambient"]
        own, beside, missing = {}, {}, {}
        # VTK's headlight has a black ambient colour: it draws no ambient term, whatever the
        # material says. Against VTK slabcast leaves it out, too.
        finest = None
        for c in contenders:
            if c.kind not in row.finest or "missing" in got[c.name]:
                continue
            print(f"{row.name}: pictures of {c.name} ...", file=sys.stderr, flush=True)
            try:
                if c.kind == "slabcast":
                    transfer = self.transfer(row, 0.0)
                    if finest is None:
                        finest = self.own_picture(row, "finest", transfer, thickness="0.0625",
                                                  eps="1/65536", sums="auto")
                    picture = self.own_picture(
                        row, c.name, transfer, **{"eps": row.eps, **c.flags, "threads": os.cpu_count()})
                    own[c.name] = self.compare(f"{row.name} {c.name}", picture, finest)
                    continue
                picture = f"raw:1:{got[c.name]['said']['picture']}"
                same = self.transfer(row, 0.0 if c.kind == "vtk" else ambient, c.kind == "volpack")
                ours = self.own_picture(row, f"like {c.kind}", same)
                beside[c.name] = self.compare(f"{row.name} slabcast beside {c.name}", ours, picture)
                own[c.name] = self.compare(f"{row.name} {c.name}", picture, self.finest(row, c.kind))
            except Missing as e:
                missing[c.name] = str(e)
                print(f"    no pictures: {e}", file=sys.stderr)
        return {"own": own, "beside": beside, "missing": missing}
