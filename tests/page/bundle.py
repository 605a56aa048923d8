"""Joins the page's modules into one, by the rules of master/page/README.md.

python3 tests/page/bundle.py [FOLDER]    writes what a master serves; without FOLDER tells sizes
"""

import gzip
import re
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[2] / "master/page"


def plain(text):
    """Returns a module without imports, exports and comments."""
    out, skip = [], None
    for line in text.split("\n"):
        bare = line.strip()
        if skip:
            skip = None if bare.endswith(skip) else skip
        elif line.startswith("import "):
            skip = None if bare.endswith('";') else '";'
        elif bare.startswith("/*"):
            # A cast may begin a line of code.
            if bare.startswith("/** @") and not bare.endswith("*/") and "*/" in bare:
                out.append(re.sub(r"/\*\* @.*?\*/ ?", "", line))
            else:
                skip = None if bare.endswith("*/") else "*/"
        elif bare.startswith("//") or bare == "" or line == "export {};":
            continue
        else:
            out.append(re.sub(r"/\*\* @.*?\*/ ?", "", line.removeprefix("export ")))
    return "\n".join(out)


def bundle():
    """Returns app.js. Fails if two modules have one top-level name."""
    owner, parts = {}, []
    for name in (PAGE / "bundle.txt").read_text().split():
        text = plain((PAGE / name).read_text())
        if re.search(r"^export\b|^import\b|\bas [a-z]\w* *[,}]", text, re.M):
            sys.exit(f"{name}: an import or export of a kind that can't be joined")
        for top in re.findall(r"^(?:async )?(?:const|let|class|function\*?) +(\w+)", text, re.M):
            if top in owner:
                sys.exit(f"{name}: {top} is a name of {owner[top]} already")
            owner[top] = name
        parts.append(text)
    return "\n".join(parts) + "\n"


def files():
    """Returns the files that a master serves, by name."""
    served = {n: (PAGE / n).read_bytes() for n in ("index.html", "main.css", "icon.svg")}
    return {**served, "app.js": bundle().encode()}


if __name__ == "__main__":
    total = 0
    for name, data in files().items():
        packed = len(gzip.compress(data, 9))
        total += packed
        print(f"{name:12} {len(data):7} bytes, {packed:6} gzip")
        if len(sys.argv) > 1:
            Path(sys.argv[1]).mkdir(parents=True, exist_ok=True)
            (Path(sys.argv[1]) / name).write_bytes(data)
    print(f"{'all':12} {total / 1024:.1f} KiB gzip in {len(files())} requests")
