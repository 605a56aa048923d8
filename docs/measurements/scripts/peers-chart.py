#!/usr/bin/env python3
"""Draws docs/pictures/peers.svg, the chart of README.md: milliseconds a frame beside VTK and ParaView.

    python3 docs/measurements/scripts/peers-chart.py > docs/pictures/peers.svg

The figures are those of docs/measurements/peers.md, typed here by hand: change both.
"""

BARS = [
    ("head, opaque, 512x512, 1 thread", [("slabcast", 10.3), ("VTK", 78.8)]),
    ("head, perspective, 512x512, 1 thread", [("slabcast", 16.2), ("VTK", 112.5)]),
    ("head, translucent, 512x512, 1 thread", [("slabcast", 91.6), ("VTK", 386.8)]),
    ("vessels, 512x512, 1 thread", [("slabcast", 5.89), ("VTK", 107.0)]),
    ("head, opaque, 512x512, 2 processes", [("slabcast", 10.4), ("ParaView", 205.3)]),
    ("vessels, 512x512, 2 processes", [("slabcast", 5.68), ("ParaView", 242.4)]),
]
WIDTH, LEFT, RIGHT, TOP, BAR, GAP = 760, 292, 96, 34, 13, 16


def main():
    longest = max(ms for _, pair in BARS for _, ms in pair)
    height = TOP + len(BARS) * (2 * BAR + 3 + GAP) + 4
    print(f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{height}" '
          f'viewBox="0 0 {WIDTH} {height}" font-family="system-ui, sans-serif" font-size="12.5" role="img" '
          'aria-label="Milliseconds a frame of slabcast, VTK and ParaView">')
    print("<style>.t{fill:#24292f}.m{fill:#57606a}.a{fill:#0969da}.b{fill:#afb8c1}"
          "@media(prefers-color-scheme:dark){.t{fill:#e6edf3}.m{fill:#9da7b3}.a{fill:#58a6ff}.b{fill:#57606a}}</style>")
    print(f'<text class="t" x="{LEFT}" y="18" font-weight="600">Milliseconds a frame (less is better)</text>')
    y = TOP
    for scene, pair in BARS:
        print(f'<text class="t" x="{LEFT - 12}" y="{y + BAR + 5}" text-anchor="end">{scene}</text>')
        for (who, ms), css in zip(pair, "ab"):
            length = max(2, ms / longest * (WIDTH - LEFT - RIGHT))
            print(f'<rect class="{css}" x="{LEFT}" y="{y}" width="{length:.1f}" height="{BAR}" rx="2"/>')
            print(f'<text class="m" x="{LEFT + length + 6:.1f}" y="{y + BAR - 2}">{who} {ms:g}</text>')
            y += BAR + 3
        y += GAP - 3
    print("</svg>")


if __name__ == "__main__":
    main()
