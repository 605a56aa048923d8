#!/usr/bin/env python3
"""Counts what docs/design/house.md tabulates: words of the docs, lines by room, tuning constants of the
scheduler, and public items whose doc lacks units or errors. Run it in the root of a checkout:

    python3 docs/measurements/scripts/house.py
"""
import re
import subprocess
import sys

UNIT_IN_NAME = re.compile(
    r"_(us|ms|ns|s|secs?|bytes|mib|pixels?|px|vox|mm|deg|degrees|fps|rate|per_\w+|hz|share|fraction|ratio|count|"
    r"index|id|number|millis|micros|nanos|bits)$")
UNIT_IN_DOC = re.compile(
    r"\b(us|ms|ns|seconds?|microseconds?|milliseconds?|nanoseconds?|bytes?|MiB|GiB|pixels?|vox|mm|degrees?|radians?|"
    r"fraction|share|ratio|number of|count|counts|index|indices|position in|steps?|sheets?|tiles?|bricks?|voxels?|"
    r"frames?|threads?|workers?|slabs?|unitless|dimensionless|percent|bits?|version|0 to 1|0\.\.|1/|world units?|"
    r"per|columns?|rows?|nonce|epoch|code|linear|samples?|lattice|levels?|views?|lines?|messages?|leases?|"
    r"jobs?|events?|attempts?|times|points?|opacity|transmittance|optical depth|extinction|numbers?)\b", re.I)
NUMERIC = re.compile(r"^(Option<)?&?(\[)?(f32|f64|u8|u16|u32|u64|u128|i8|i16|i32|i64|usize|isize|Micros|Nanos)\b")
BACK_REFERENCE = re.compile(r"^(The same|Those|These|They|What|Who|Whose|Which|Where|It\b|Its\b|That\b|So\b|As )")


def files(suffix):
    out = subprocess.run(["git", "ls-files"], capture_output=True, text=True, check=True).stdout
    return [f for f in out.splitlines() if f.endswith(suffix)]


def words(name):
    return len(open(name, encoding="utf-8").read().split())


def public_items(name):
    """(kind, name, signature, doc) of the public items and fields of a file, its tests left out."""
    lines = open(name, encoding="utf-8").read().splitlines()
    doc, i = [], 0
    while i < len(lines):
        line = lines[i].strip()
        if line.startswith("#[cfg(test)]") and i + 1 < len(lines) and "mod tests" in lines[i + 1]:
            if lines[i + 1].strip().endswith("{"):
                break
        if line.startswith("///"):
            doc.append(line[3:].strip())
        elif line.startswith("#["):
            while line.count("[") > line.count("]") and i + 1 < len(lines):
                i += 1
                line += lines[i].strip()
        elif m := re.match(r"pub (?:async |const |unsafe )*(fn|struct|enum|trait|const|static|type|mod) (\w+)", line):
            sig = line
            while m[1] == "fn" and not re.search(r"[{;]\s*$", sig) and i + 1 < len(lines):
                i += 1
                sig += " " + lines[i].strip()
            if m[1] != "mod":
                yield m[1], m[2], sig, doc
            doc = []
        elif m := re.match(r"pub (\w+): (.+?),?$", line):
            yield "field", m[1], m[2], doc
            doc = []
        else:
            doc = []
        i += 1


def main():
    readme, architecture = words("README.md"), words("ARCHITECTURE.md")
    docs = sum(words(f) for f in files(".md") if f.startswith("docs/"))
    print(f"words: README {readme}, ARCHITECTURE {architecture}, docs {docs}")

    rooms = {}
    largest = (0, "")
    over = 0
    for f in files(".rs"):
        n = len(open(f, encoding="utf-8").read().splitlines())
        parts = f.split("/src/")[0] if "/src/" in f else f.rsplit("/", 1)[0]
        if "/src/" in f and f.split("/src/")[0] == "master/schedule":
            rest = f.split("/src/")[1].split("/")
            parts += "/" + (rest[0] if len(rest) > 1 else "")
        if "/src/" in f and f.split("/src/")[0] == "worker/render":
            rest = f.split("/src/")[1].split("/")
            parts += "/" + (rest[0] if len(rest) > 1 else "")
        rooms[parts] = rooms.get(parts, 0) + n
        largest = max(largest, (n, f))
        over += n > 800
    for room, n in sorted(rooms.items()):
        print(f"lines: {room:36} {n:7}")
    print(f"lines: all {sum(rooms.values())}, largest file {largest[0]} ({largest[1]}), files past 800: {over}")

    total = short = back = results = no_errors = numbers = no_unit = undocumented = 0
    missing = []
    for f in files(".rs"):
        if "/src/" not in f or f.endswith("/tests.rs") or "/tests/" in f:
            continue
        for kind, name, sig, doc in public_items(f):
            text = " ".join(doc)
            total += 1
            undocumented += not doc
            short += 0 < len(text.split()) <= 5
            back += bool(BACK_REFERENCE.match(text))
            if kind == "fn" and re.search(r"-> .*Result<", sig):
                results += 1
                if "# Errors" not in text:
                    no_errors += 1
                    missing.append(f"no # Errors: {f} {name}")
            returns = re.search(r"-> ([^{]+)", sig) if kind == "fn" else None
            value = sig if kind == "field" else returns[1] if returns else ""
            if kind == "const" and (m := re.search(r": ([^=]+)=", sig)):
                value = m[1]
            if NUMERIC.match(value.strip()) and not re.search(r"\b(Micros|Nanos)\b", value):
                numbers += 1
                if not UNIT_IN_NAME.search(name.lower()) and not UNIT_IN_DOC.search(text):
                    no_unit += 1
                    missing.append(f"no unit: {f} {name}: {text[:70]}")
    print(f"public: {total} items and fields, {undocumented} without a doc, {short} of at most five words, "
          f"{back} that begin with a back-reference")
    print(f"public: {no_errors} of {results} functions that return Result lack # Errors")
    print(f"public: {no_unit} of {numbers} numbers name no unit")
    if "-v" in sys.argv:
        print("\n".join(missing))


if __name__ == "__main__":
    main()
