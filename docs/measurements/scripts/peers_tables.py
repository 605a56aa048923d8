"""The tables of docs/measurements/scripts/peers.py, from what its rows gave.

A row's result has, for each renderer (`got`), milliseconds of every view of every round; what the
renderer said of its first run (`said`); or why it is missing. Everything here is arithmetic on
that: no renderer runs.
"""

import collections
import statistics

import measure

# OSPRay 3.1 with Open VKL is in no package registry, so it is not run. These are its times over
# VTK's, one thread, on another machine (AMD Zen 5, gradient-shaded scivis renderer).
OSPRAY_TO_VTK = {"opaque-512": 85.7 / 80.2, "opaque-1024": 303.4 / 285.6, "semi-512": 345.0 / 400.3,
                 "vessels-512": 140.8 / 110.0}


def later(run):
    """The first view builds what all views use, at peers and at us; it is left out."""
    return run[1:] or run


def median(entry):
    """Milliseconds: of a run's views, then of the rounds."""
    return statistics.median(statistics.median(later(r)) for r in entry["rounds"])


def calm(entry):
    """Milliseconds: of the views, each in its fastest round."""
    return statistics.median(min(view) for view in zip(*map(later, entry["rounds"])))


def ratio(theirs, ours):
    """How many times faster: in each round, then the median of rounds; and calm over calm."""
    rounds = [statistics.median(later(a)) / statistics.median(later(b))
              for a, b in zip(theirs["rounds"], ours["rounds"])]
    return statistics.median(rounds), calm(theirs) / calm(ours), min(rounds), max(rounds)


def times(x):
    return f"{x:.2f}" if x < 9.995 else f"{x:.1f}" if x < 99.5 else f"{x:.0f}"


def ms(x):
    return f"{x:.2f}" if x < 9.995 else f"{x:.1f}" if x < 999.5 else f"{x:.0f}"


def table(head, rows):
    out = ["| " + " | ".join(head) + " |",
           "|" + "|".join("---" if i < 2 else "--:" for i in range(len(head))) + "|"]
    return out + ["| " + " | ".join(r) + " |" for r in rows] + [""]


def there(result, names):
    """Those of the names that were measured, slabcast first."""
    names = [n for n in names if n in result["got"] and result["got"][n]["rounds"]]
    return sorted(names, key=lambda n: not n.startswith("slabcast"))


def error(figures):
    if not figures:
        return "-"
    text = f"{figures['rmse']:.2f} ({figures['max']:.1f})"
    if figures.get("shift", [0, 0]) != [0, 0]:
        text += f"; {figures['rmse_shifted']:.2f} moved by {figures['shift'][0]}, {figures['shift'][1]}"
    return text


def main_table(rows, results):
    lines = []
    for row in rows:
        result = results.get(row.name)
        if not result:
            continue
        got, own = result["got"], result.get("pictures", {}).get("own", {})
        peers = there(result, ["VTK", "VolPack"])
        for name in there(result, got):
            entry, said = got[name], got[name].get("said", {})
            each = [x for r in entry["rounds"] for x in later(r)]
            faster = {p: ratio(got[p], entry) for p in peers}
            goal, held = "", ""
            for peer, least in row.reach:
                if name.startswith("slabcast") and peer in faster:
                    goal = f"{times(least)} of {peer}"
                    held = "yes" if faster[peer][0] >= least else "no"
            show = ["-" if p not in faster or p == name else
                    "{} ({} to {}; calm {})".format(
                        *map(times, (faster[p][0], *faster[p][2:], faster[p][1])))
                    for p in ("VTK", "VolPack")]
            lines.append([row.scene(), name, ms(median(entry)), ms(calm(entry)),
                          f"{ms(min(each))} to {ms(max(each))}", *show, goal, held,
                          error(said.get("limit")), error(said.get("same_thickness")),
                          error(own.get(name))])
    return table(["scene", "renderer, one thread", "ms", "calm ms", "views", "VTK's time / its",
                  "VolPack's / its", "to reach", "reached", "RMSE (max) of the limit",
                  "of the same thickness", "of its own finest"], lines) if lines else []


def ospray_lines(rows, results):
    told = []
    for name, against in OSPRAY_TO_VTK.items():
        row = next(r for r in rows if r.name == name)
        ours = there(results.get(name, {"got": {}}), [c.name for c in row.contenders])
        ours = [n for n in ours if n.startswith("slabcast")]
        if "VTK" in there(results.get(name, {"got": {}}), ["VTK"]) and ours:
            got = results[name]["got"]
            what = ", ".join(f"{times(ratio(got['VTK'], got[n])[0] * against)} times ({n})"
                             for n in ours)
            told.append(f"- {row.scene()}: OSPRay took {against:.2f} of VTK's time there; if it does "
                        f"here, slabcast is faster by {what}")
    return (["OSPRay can't be installed from a package and was **not run here**. Its ratio to VTK is "
             "that of another machine (AMD Zen 5, one thread):", "", *told, ""] if told else [])


def threads_table(row, results):
    result = results.get(row.name)
    if not result:
        return []
    got, lines = result["got"], []
    for one in there(result, got):
        two = next((n for n in (f"{one}, 2 threads",) if there(result, [n])), None)
        if two:
            r = ratio(got[one], got[two])
            lines.append([row.scene(), one, ms(median(got[one])), ms(median(got[two])),
                          f"{r[0]:.2f} ({r[2]:.2f} to {r[3]:.2f})", f"{r[1]:.2f}"])
    return table(["scene", "renderer", "ms, 1 thread", "ms, 2 threads", "speed-up", "calm"], lines)


def culling_table(row, results):
    result = results.get(row.name)
    if not result:
        return []
    got, lines = result["got"], []
    for on in there(result, [n for n in got if n.endswith("1/512")]):
        for off in there(result, [on.replace("1/512", "0")]):
            r, said = ratio(got[off], got[on]), [got[n]["said"] for n in (on, off)]
            lines.append([row.scene(), on.split(",")[0], ms(median(got[on])), ms(median(got[off])),
                          f"{r[0]:.2f} ({r[2]:.2f} to {r[3]:.2f})", f"{r[1]:.2f}",
                          f"{said[0]['splatted']} / {said[1]['splatted']}"])
    return table(["scene", "quality", "ms, eps 1/512", "ms, eps 0", "off / on", "calm",
                  "voxels splatted, on / off"], lines)


def processes_table(rows, results):
    lines = []
    for row in rows:
        result = results.get(row.name)
        if not result:
            continue
        got = result["got"]
        theirs = there(result, ["ParaView, 2 ranks"])
        for name in there(result, got):
            entry = got[name]
            faster = times(ratio(got[theirs[0]], entry)[0]) if theirs and name not in theirs else "-"
            lines.append([row.scene(), name, ms(median(entry)), ms(calm(entry)),
                          ms(statistics.median(r[0] for r in entry["rounds"])), faster])
    return table(["scene", "who", "ms", "calm ms", "first view", "ParaView's with 2 ranks / its"],
                 lines) if lines else []


def sizes_table(rows, results):
    """Times, and growth against the first row (256^3 at 512) beside that of surface times pixels."""
    base, lines = results.get(rows[0].name), []
    for row in rows:
        result, edge = results.get(row.name), int(row.volume.split("/")[1])
        for name in there(result, result["got"]) if result else []:
            entry, said = result["got"][name], result["got"][name].get("said", {})
            grown = "-"
            if base and name in there(base, [name]):
                grown = f"{median(entry) / median(base['got'][name]):.2f}"
            faster = "-"
            if there(result, ["VTK"]) and name != "VTK":
                faster = times(ratio(result["got"]["VTK"], entry)[0])
            lines.append([f"{edge}^3, {row.size} px", name, ms(median(entry)), grown,
                          f"{(edge / 256) ** 2 * (row.size / 512) ** 2:g}",
                          str(said.get("splatted", "-")), faster])
    return table(["volume, picture", "renderer", "ms", "against 256^3 at 512",
                  "surface x pixels", "voxels splatted", "VTK's time / its"], lines) if lines else []


def beside_table(rows, results):
    lines = []
    for row in rows:
        pictures = (results.get(row.name) or {}).get("pictures", {})
        for peer, f in pictures.get("beside", {}).items():
            lines.append([row.scene(), peer, f"{f['rmse']:.1f}", f"{f['bias']:+.1f}",
                          f"{f['psnr']:.1f}" if f["psnr"] else "-", f"{f['shift'][0]}, {f['shift'][1]}",
                          f"{f['rmse_shifted']:.1f}"])
    return table(["scene", "slabcast beside", "RMSE, covered pixels", "bias", "PSNR, all pixels",
                  "best shift, pixels", "RMSE there"], lines) if lines else []


def left_out(rows, results):
    told = collections.defaultdict(list)
    for row in rows:
        result = results.get(row.name)
        if not result:
            told["not measured"].append(row.name)
            continue
        for name, entry in result["got"].items():
            if "missing" in entry:
                told[f"{name}: {entry['missing']}"].append(row.name)
        for name, why in result.get("pictures", {}).get("missing", {}).items():
            told[f"pictures of {name}: {why}"].append(row.name)
    return [f"- {why} ({', '.join(rows)})" for why, rows in sorted(told.items())]


def report(groups, results):
    """All tables, as Markdown. `groups`: the rows by what they are for."""
    kept, some = list(results.values()), next(iter(results.values()))
    dates, loads = sorted(r["date"] for r in kept), sorted(x for r in kept for x in r["load"])
    runs = sorted({f"{r['rounds']} rounds of {r['frames']} frames" for r in kept})
    out = [f"{measure.machine()}; {', '.join(runs)}; slabcast "
           f"{some['version']}, binary {some['binary'][:12]}; {dates[0]} to {dates[-1]}; load "
           f"{loads[0]:.1f} to {loads[-1]:.1f}; {sum(r['stolen_s'] for r in kept):.0f} s stolen by "
           f"other machines in {sum(r['timed_s'] for r in kept):.0f} s of timing.", ""]
    if len({r["binary"] for r in kept}) > 1:
        out += ["**Rows are of different binaries.**", ""]
    main, every = groups["main"], [r for rows in groups.values() for r in rows]
    for title, lines in (
            ("Scenes", main_table(main, results) + ospray_lines(main, results)),
            ("Two threads", threads_table(groups["threads"][0], results)),
            ("Culling on and off", culling_table(groups["culling"][0], results)),
            ("Two processes, against ParaView", processes_table(groups["processes"], results)),
            ("Sizes", sizes_table(groups["sizes"], results)),
            ("The same picture?", beside_table(main, results)),
            ("Left out", left_out(every, results))):
        if lines:
            out += [f"### {title}", "", *lines, *([""] if title == "Left out" else [])]
    return "\n".join(out)
