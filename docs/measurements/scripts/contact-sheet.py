#!/usr/bin/env python3
r"""Puts PNGs side by side into one: docs/measurements/scripts/contact-sheet.py OUT.png COLUMNS IN.png...

8 bits, RGB or RGBA over black, all of one size. Python's standard library is all it needs.
For example eight views of the sample, in two rows:

    slabcast render samples/mni152_t1.nii.gz --tf brain --size 290x240 --height 205 \
        --elevation 8 --frames 8 --start 20 --step 45 -o turn
    python3 docs/measurements/scripts/contact-sheet.py turn.png 4 turn/frame_*.png
"""

import struct
import sys
import zlib


def read(path):
    data = open(path, "rb").read()
    assert data[:8] == b"\x89PNG\r\n\x1a\n", f"{path} is not a PNG"
    at, pixels = 8, b""
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at:at + 8])
        body = data[at + 8:at + 8 + length]
        if kind == b"IHDR":
            width, height, depth, colour, _, _, interlace = struct.unpack(">IIBBBBB", body)
            assert depth == 8 and colour in (2, 6) and not interlace, f"{path}: 8 bits RGB(A) only"
        elif kind == b"IDAT":
            pixels += body
        at += length + 12
    raw, n = zlib.decompress(pixels), 3 if colour == 2 else 4
    rows, before = [], bytearray(width * n)
    for y in range(height):
        rule, row = raw[y * (width * n + 1)], bytearray(raw[y * (width * n + 1) + 1:(y + 1) * (width * n + 1)])
        for i in range(len(row)):
            a, b = (row[i - n] if i >= n else 0), before[i]
            c = before[i - n] if i >= n else 0
            if rule == 1:
                row[i] = row[i] + a & 255
            elif rule == 2:
                row[i] = row[i] + b & 255
            elif rule == 3:
                row[i] = row[i] + (a + b) // 2 & 255
            elif rule == 4:
                p = a + b - c
                pa, pb, pc = abs(p - a), abs(p - b), abs(p - c)
                row[i] = row[i] + (a if pa <= pb and pa <= pc else b if pb <= pc else c) & 255
        before = row
        if n == 4:
            row = bytearray(row[i] * row[i // 4 * 4 + 3] // 255 for i in range(len(row)) if i % 4 < 3)
        rows.append(bytes(row))
    return width, height, rows


def write(path, width, rows):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    lines, before = [], bytes(width * 3)
    for row in rows:
        # The filter whose bytes are smallest in sum, as encoders choose.
        none = row
        sub = bytes((row[i] - (row[i - 3] if i >= 3 else 0)) & 255 for i in range(len(row)))
        up = bytes((x - y) & 255 for x, y in zip(row, before))
        cost = lambda line: sum(min(x, 256 - x) for x in line)
        rule, line = min(((0, none), (1, sub), (2, up)), key=lambda f: cost(f[1]))
        lines.append(bytes([rule]) + line)
        before = row
    packed = zlib.compress(b"".join(lines), 9)
    with open(path, "wb") as f:
        f.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, len(rows), 8, 2, 0, 0, 0))
                + chunk(b"sRGB", b"\0") + chunk(b"IDAT", packed) + chunk(b"IEND", b""))


def main():
    out, columns, names = sys.argv[1], int(sys.argv[2]), sys.argv[3:]
    pictures = [read(name) for name in names]
    width, height, _ = pictures[0]
    assert all(p[:2] == (width, height) for p in pictures), "all of one size"
    blank, rows = bytes(width * 3), []
    for first in range(0, len(pictures), columns):
        line = pictures[first:first + columns]
        for y in range(height):
            rows.append(b"".join(p[2][y] for p in line) + blank * (columns - len(line)))
    write(out, width * columns, rows)


if __name__ == "__main__":
    main()
