#!/usr/bin/env python3
"""Draws docs/pictures/beside-others.svg from the tables of docs/measurements/performance.md.

    python3 docs/measurements/scripts/peers_chart.py

A bar says how many times as long VTK, or ParaView with two ranks, takes for the same frame. The
sums are those that `auto` takes: 16 bits in translucent scenes, 32 bits in opaque ones.
"""

import pathlib

ROOT = pathlib.Path(__file__).resolve().parents[3]
PAGE = ROOT / "docs/measurements/performance.md"
# Row of the first table, its label, whether `auto` takes 16-bit sums there.
VTK = [
    ("mri256 `peer-opaque`", "head, opaque", False),
    ("at 1024x1024", "head, 1024x1024", False),
    ("in perspective", "head, perspective", False),
    ("mri256 `peer-semi`", "head, translucent", True),
    ("aneurism `peer-vessels`", "vessels", False),
]
PARAVIEW = [("mri256 `peer-opaque`", "head, opaque"), ("aneurism `peer-vessels`", "vessels")]


def tables():
    """The tables of the page: their header, and rows by the first cell."""
    found, rows = [], None
    for line in PAGE.read_text().splitlines():
        if not line.startswith("|"):
            rows = None
            continue
        cells = [c.strip() for c in line.strip("|").split("|")]
        if rows is None:
            rows = {}
            found.append((cells, rows))
        elif not set(line) <= set("|-: "):
            rows[cells[0]] = cells
    return found


def number(text):
    return float(text.split()[0])


def bars():
    for header, rows in tables():
        if "VTK" in header:
            ours, theirs = {s: header.index(s) for s in ("slabcast i16", "i32")}, header.index("VTK")
            vtk = [(label, number(rows[name][theirs])
                    / number(rows[name][ours["slabcast i16" if short else "i32"]]))
                   for name, label, short in VTK]
        if "ParaView, 2 ranks" in header:
            theirs, ours = header.index("ParaView, 2 ranks"), header.index("slabcast, workers")
            paraview = [(label, number(rows[name][theirs]) / number(rows[name][ours]))
                        for name, label in PARAVIEW]
    return [("VTK, one thread", vtk), ("ParaView, two processes", paraview)]


def svg(groups):
    left, width, row, y = 190, 300, 20, 34
    most = max(value for _, values in groups for _, value in values)
    out = ['<text class="b" x="12" y="18">Time of the same frame, slabcast = 1</text>']
    for (name, values), shade in zip(groups, ("#4c78a8", "#e1812c")):
        out.append(f'<text x="12" y="{y + 13}">{name}</text>')
        y += row
        for label, value in values:
            long = width * value / most
            out.append(f'<text class="r" x="{left - 8}" y="{y + 13}">{label}</text>'
                       f'<rect x="{left}" y="{y + 2}" width="{long:.1f}" height="{row - 6}" fill="{shade}"/>'
                       f'<text x="{left + long + 6:.1f}" y="{y + 13}">{value:.1f}</text>')
            y += row
        y += 6
    x = left + width / most
    out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="30" y2="{y}" class="l"/>')
    style = ("text{font:12px sans-serif;fill:#24292f}.b{font-weight:bold}.r{text-anchor:end}"
             ".l{stroke:#24292f;stroke-dasharray:2 3}"
             "@media(prefers-color-scheme:dark){text{fill:#e6edf3}.l{stroke:#e6edf3}}")
    return (f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 540 {y + 6}" width="540" '
            f'height="{y + 6}"><style>{style}</style>{"".join(out)}</svg>\n')


if __name__ == "__main__":
    (ROOT / "docs/pictures/beside-others.svg").write_text(svg(bars()))
