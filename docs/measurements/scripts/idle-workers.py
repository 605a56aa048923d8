"""What a master pays for workers that have nothing to do: `python3 docs/measurements/scripts/idle-workers.py SLABCAST [N]`.

Starts a master that rehearses and N (256) idle workers as processes of this machine, waits until all
have come, and prints, over 20 seconds, the master's processor time, its memory, and how many workers
it still has: one that misses its heartbeat for three seconds is dropped and dials again, so names
with a number behind them would show.
"""

import json
import os
import subprocess
import sys
import tempfile
import time


def cpu(pid):
    """Seconds that all threads of a process were on a processor."""
    total = 0
    for task in os.listdir(f"/proc/{pid}/task"):
        with open(f"/proc/{pid}/task/{task}/schedstat") as f:
            total += int(f.read().split()[0])
    return total / 1e9


def memory(pid):
    with open(f"/proc/{pid}/status") as f:
        return next(int(line.split()[1]) / 1024 for line in f if line.startswith("VmRSS"))


def main():
    slabcast = os.path.abspath(sys.argv[1])
    n = int(sys.argv[2]) if len(sys.argv) > 2 else 256
    started = []
    with tempfile.TemporaryDirectory() as folder:
        trace = os.path.join(folder, "s.trace")
        scene = ["formula:spheres:16", "--size", "64x64", "--frames", "1", "--workers", "1,8"]
        subprocess.run([slabcast, "lab", "plan", *scene, "--trace", trace, "-q"], check=True,
                       stdout=subprocess.DEVNULL)
        try:
            master = subprocess.Popen(
                [slabcast, "master", "--volume", "formula:spheres:16", "--listen", "127.0.0.1:0",
                 "--rehearse", "--log-level", "error"],
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            started.append(master)
            address = master.stdout.readline().split()[-1]
            for i in range(n):
                started.append(subprocess.Popen(
                    [slabcast, "worker", "--master", address, "--threads", "1", "--rehearse", trace,
                     "--name", f"idle-{i}", "--log-level", "error"],
                    stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))

            def workers():
                out = subprocess.run([slabcast, "status", "--master", address, "--json"],
                                     capture_output=True, text=True, check=True).stdout
                return json.loads(out)["workers"]

            until = time.time() + 300
            while len(workers()) < n and time.time() < until:
                time.sleep(1)
            time.sleep(3)
            before = {w["id"] for w in workers()}
            began, spent = time.time(), cpu(master.pid)
            silent = 0
            while time.time() < began + 20:
                time.sleep(5)
                silent = max([silent] + [w["silent_ms"] for w in workers()])
            took, spent = time.time() - began, cpu(master.pid) - spent
            after = {w["id"] for w in workers()}
            print(f"{len(before)} workers, after {took:.0f} s the same: {before == after}; longest "
                  f"silence {silent} ms; the master took {100 * spent / took:.2f} % of a core and "
                  f"{memory(master.pid):.0f} MiB")
        finally:
            for process in started:
                process.kill()
            for process in started:
                process.wait()


main()
