"""Measures what a viewer takes of the memory of `slabcast view`, and prints a line for each number of viewers.

    python3 docs/measurements/scripts/viewer_memory.py SLABCAST VOLUME [-- --up=-y]

Viewers are sockets without a browser (live.py has them, and needs playwright). Each opens a session of
256x256, takes its first picture and rests; with `--turns N` it turns N times besides, all viewers at once.
"""

import argparse
import asyncio
import sys
import time

from live import CROWD_EDGE, Socket, View


async def turn(viewers):
    """Turns all viewers once, and waits for the pictures."""
    for v in viewers:
        v.seq += 1
        v.camera["azimuth"] = v.camera.get("azimuth", 0) + 7.3
        v.sent[v.seq] = time.perf_counter()
        v.say({"type": "view", "seq": v.seq, "camera": v.camera, "size": [CROWD_EDGE] * 2, "moving": True})
    while any(v.sent for v in viewers):
        await asyncio.sleep(0.02)


async def measure(view, counts, turns):
    viewers, reading, found = [], [], []
    for count in counts:
        while len(viewers) < count:
            v = Socket(view.url)
            await v.dial()
            viewers.append(v)
            reading.append(asyncio.ensure_future(v.read()))
            while not v.first:
                if reading[-1].done():
                    reading[-1].result()
                await asyncio.sleep(0.01)
        for _ in range(turns):
            await turn(viewers)
        # What a picture took is given back.
        await asyncio.sleep(1.5)
        found.append((count, view.rss_mib()))
        print(f"{count:3} viewers: {found[-1][1]:.1f} MiB", flush=True)
    (few, before), (many, after) = found[-2:]
    print(f"{(after - before) / (many - few):.2f} MiB a viewer, from {few} to {many}")
    for task in reading:
        task.cancel()


def main():
    own, flags = sys.argv[1:], []
    if "--" in own:
        own, flags = own[:own.index("--")], own[own.index("--") + 1:]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("slabcast")
    parser.add_argument("volume")
    parser.add_argument("--turns", type=int, default=0)
    args = parser.parse_args(own)
    view = View(args.slabcast, args.volume, flags)
    try:
        asyncio.run(measure(view, [1, 16, 48], args.turns))
    finally:
        view.end()


if __name__ == "__main__":
    main()
