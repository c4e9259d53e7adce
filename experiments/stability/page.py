"""README.md beside this file, made from page.md and stability.json.

`python -m experiments.stability.page`
"""

import json
from collections import Counter
from pathlib import Path

from experiments.cells import geometric_mean
from experiments.page import table
from experiments.stability.dry import SET_VALUED, fewest_accurate
from experiments.stability.peers import MAX_STEPS
from experiments.stability.tolerances import HIGH, LOW
from experiments.stability.tolerances import MAX_STEPS as TRIES

HERE = Path(__file__).parent


def summary_table(rows):
    """Shares of cells."""
    cells = [[*list(row.values())[:-1], "-" if row["ratio"] is None else f"{row['ratio']:.2f}"] for row in rows]
    return table(list(rows[0]), cells)


def advice_table(summary):
    """How close the advised steps are."""
    rows = [
        [f"{100 * float(limit):g} %", e["cases"], e["within_1.5"], f"{e['least']:.2f} ... {e['largest']:.2f}"]
        for limit, e in summary.items()
    ]
    return table(["error", "cases", "within a factor 1.5", "suggested / measured"], rows)


def misses(entries):
    """The cases beyond a factor of 1.5, in words."""
    found = []
    for e in entries:
        ratio = "none suggested" if e["advised_over_measured"] is None else f"{e['advised_over_measured']:.2f}"
        alpha = "" if e["alpha"] is None else f", alpha = {e['alpha']:g}"
        found.append(f"* {e['scene']}, {e['method']}{alpha}, {100 * float(e['limit']):g} %: {ratio}")
    return "\n".join(["Beyond a factor of 1.5:\n", *found]) if found else "No case is beyond a factor of 1.5."


def exceptions(entries):
    """The silently wrong cells that no advice flags, in words."""
    words = (f"{e['cells']} of {e['scene']} with {e['method']}, alpha = {e['alpha']}" for e in entries)
    return f" (not flagged: {', '.join(words)})" if entries else ""


def both(of_scenes):
    """Of the scenes with dry friction, in words."""
    return " and ".join(map(str, of_scenes))


def dry_table(dry, gallery):
    """Fewest steps by the dry motion, and, of tanh, by its own."""
    by_scene = [(x, fewest_accurate(gallery["scenes"][name])) for name, x in dry["fewest_accurate_steps"].items()]
    header = ["method", *(x for name in dry["scenes"] for x in (name, "by its own motion"))]
    rows = [[m, *(y or "-" for x, own in by_scene for y in (x[m], own.get(m, x[m])))] for m in by_scene[0][0]]
    return table(header, rows)


def stops_table(found):
    """Accurate cells by scene and method."""
    methods = next(iter(found.values()))
    rows = [[m, *(f"{by[m]['accurate']} of {by[m]['all']}" for by in found.values())] for m in methods]
    return table(["method", *found], rows)


def adaptive_table(cells):
    """Cells by how runs are verified."""
    header = ["verify", *(name.replace("_", " ") for name in next(iter(cells.values())))]
    return table(header, [[way, *found.values()] for way, found in cells.items()])


def controller_table(found):
    """Both halves side by side."""
    tuned, held = (found[half]["table"] for half in ("tuned", "held_out"))
    kinds = "work", "steps", "median_error", "outside", "alarms"
    columns = (f"{kind.replace('_', ' ')}, {half}" for kind in kinds for half in ("tuned", "held out"))
    header = ["constant", "value", *columns]

    def shown(x):
        return f"{x:.2f}" if isinstance(x, float) else x

    rows = [
        [a["parameter"], a["value"], *(shown(x[kind]) for kind in kinds for x in (a, b))]
        for a, b in zip(tuned, held, strict=True)
    ]
    return table(header, rows)


def tolerances_table(found):
    """Errors by scene, method and tolerance."""
    shown = [[s, m, *("-" if e is None else f"{e:.2g}" for e in x["error"])] for s, x, m in _rows(found)]
    return table(["scene", "method", *(f"{rtol:g}" for rtol in found["rtol"])], shown)


def outside(found):
    """Runs, those whose error is not within the bounds by scene and method, and those that ended too early."""
    everything = [(f"{s} with {m}", e) for s, x, m in _rows(found) for e in x["error"]]
    beyond = Counter(name for name, e in everything if e is not None and not LOW <= e <= HIGH)
    return len(everything), beyond, sum(e is None for _, e in everything)


def spaced(number):
    """Its thousands apart."""
    return f"{number:,}".replace(",", " ")


def tightened(adaptive, found):
    """Those of `verify="tighten"`: cells of the gallery, and runs of the other motions."""
    cells = adaptive["cells"]
    beyond = {"silently wrong": cells["tighten"]["silently_wrong"], "beyond ten tolerances": cells["tighten"]["beyond"]}
    runs = [run for _, x, _ in _rows(found) for run in x["tightened"]]
    errors = [run["error"] for run in runs if run["error"] is not None]
    ratios = [run["stated"] / run["error"] for run in runs if run["error"] is not None]
    return {
        "adaptive_tries": spaced(adaptive["tries"]["tighten"]),
        "tight_within": cells["tighten"]["within_the_tolerance"],
        "plain_within": cells["no"]["within_the_tolerance"],
        "tight_all": sum(len(rows) for x in adaptive["scenes"].values() for rows in x["grades"].values()),
        "tight_named": cells["tighten"]["named"],
        "tight_beyond": ", ".join(f"{n or 'none'} {what}" for what, n in beyond.items()),
        "tight_least": found["tightened_rtol"][-1],
        "tight_runs": len(runs),
        "tight_runs_within": sum(e <= 1 for e in errors),
        "tight_largest": max(errors),
        "tight_stated": f"{min(ratios):.2g} to {max(ratios):.2g}",
        "tight_stated_mean": geometric_mean(ratios),
        "tight_share": min(run["share"] for run in runs),
    }


def _rows(found):
    return [(scene, x, method) for scene, by in found["scenes"].items() for method, x in by.items()]


def once_wrong(gallery, adaptive, way):
    """Silently wrong cells of the gallery by a letter: that of their scene, method and alpha, verified in a way."""
    letters = Counter()
    for name, of_scene in adaptive["scenes"].items():
        scene, found = gallery["scenes"][name], of_scene["grades"]
        for method in (m for m in scene["grades"] if m in found):
            for row, now in zip(scene["grades"][method], found[method], strict=True):
                letters[now[way]] += row.count("w")
    return letters


def drift_table(entries):
    """One row per scene and method."""
    names = list(dict.fromkeys(key for e in entries for key in e["last"]))
    rows = []
    for e in entries:
        cells = (
            "" if x not in e["last"] else "not finite" if e["last"][x] is None else f"{e['last'][x]:.1e}" for x in names
        )
        rows.append([e["scene"], e["method"], f"{1e3 * e['h_s']:g} ms", *cells])
    return table(["scene", "method", "h", *names], rows)


def dampers_table(rows):
    """Steps and differences."""
    header = ["c (N m s/rad)", "steps of hht", "difference (rad)", "steps of Tsit5", "difference (rad)"]
    cells = []
    for row in rows:
        peer = ["-", "-"]
        if "tsit5_steps" in row:
            steps, difference = row["tsit5_steps"], row["tsit5_minus_rowda_rad"]
            peer = ["stopped", "-"] if steps is None else [steps, f"{difference:.1e}"]
        cells.append([f"{row['c_N_m_s']:g}", row["hht_steps"], f"{row['hht_minus_rowda_rad']:.1e}", *peer])
    return table(header, cells)


def page(numbers):
    """The text of README.md."""
    gallery, reported, advice, peers = (numbers[part] for part in ("gallery", "reported", "advice", "peers"))
    dry, stops, adaptive, controller = (numbers[part] for part in ("dry", "stops", "adaptive", "controller"))
    tolerances = numbers["tolerances"]
    runs_at_all, beyond, too_early = outside(tolerances)
    alone, verified = (once_wrong(gallery, adaptive, way) for way in (0, 1))
    runs = {name: [row for rows in x["grades"].values() for row in rows] for name, x in adaptive["scenes"].items()}
    drifting = [name for name, rows in runs.items() if any(row[0] == "w" for row in rows)]
    fewest, motions = dry["fewest_accurate_steps"].values(), dry["motions"].values()
    drift, spin = numbers["drift"], numbers["rotating"]["spin_error"]
    scenes = gallery["scenes"]
    first = next(iter(scenes.values()))
    held = len(scenes) - gallery["tuned_scenes"]
    missing = peers["not_installed"]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            scenes=len(scenes),
            methods=len(first["grades"]),
            halvings=len(first["num_steps"]),
            cells=sum(len(row) for scene in scenes.values() for x in scene["grades"].values() for row in x),
            tuned_scenes=gallery["tuned_scenes"],
            held_scenes=held,
            tuned=summary_table(gallery["summary_tuned_on"]),
            held=summary_table(gallery["summary_held_out"]),
            dry_switches=both(x["switches"] for x in motions),
            dry_away=both(f"{100 * x['tanh_motion_error']:.2g} %" for x in motions),
            dry_set_valued=both(x[SET_VALUED] for x in fewest),
            dry_default=both(x["HHT auto"] for x in fewest),
            dry_predictor=both(x["HHT predictor"] for x in fewest),
            dry=dry_table(dry, gallery),
            stops_away=", ".join(f"{100 * x:.0f} %" for x in stops["rigid_motion_error"].values()),
            stops=stops_table(stops["cells"]),
            stops_named=sum(sum(by.values()) for by in stops["named_by_check"].values()),
            stops_blown_up=sum(
                x["blown_up"] for by in stops["cells"].values() for m, x in by.items() if m.endswith("located")
            ),
            adaptive_rtol=adaptive["rtol"],
            adaptive_atol=adaptive["atol"],
            not_controlled=" and ".join(", ".join(adaptive["not_controlled"]).rsplit(", ", 1)),
            adaptive=adaptive_table(adaptive["cells"]),
            adaptive_before=sum(alone.values()),
            adaptive_now=alone["A"],
            adaptive_verified=verified["A"] + verified["n"],
            adaptive_wrong=adaptive["cells"]["no"]["silently_wrong"],
            adaptive_scenes=f"all on: {', '.join(drifting)}",
            controller=controller_table(controller),
            controller_tuned="; ".join(controller["tuned"]["scenes"]),
            controller_held="; ".join(controller["held_out"]["scenes"]),
            controller_runs=both(controller[half]["table"][0]["runs"] for half in ("tuned", "held_out")),
            controller_best=f"{100 * (1 - min(row['work'] for row in controller['held_out']['table'])):.1f}",
            tolerances=tolerances_table(tolerances),
            **tightened(adaptive, tolerances),
            tolerances_runs=runs_at_all,
            tolerances_within=runs_at_all - sum(beyond.values()) - too_early,
            tolerances_beyond="; ".join(f"{n} of {name}" for name, n in beyond.items()),
            tolerances_early=too_early,
            tolerances_most=spaced(TRIES),
            blown_up=reported["cells"]["again"],
            once=reported["cells"]["blown_up"],
            named=reported["cells"]["named_by_check"],
            named_given_reach=reported["cells"]["named_by_check_given_reach"],
            quantities=table(["what is named", "cells"], reported["named"].items()),
            wrong=advice["totals"]["silently_wrong"],
            flagged=advice["totals"]["flagged"],
            unflagged=exceptions(advice["unflagged"]),
            flagged_by_modes=advice["totals"]["flagged_by_modes"],
            advised_methods=advice["methods"],
            advice=advice_table(advice["summary"]),
            misses=misses(advice["misses"]),
            spin_duration=spin["duration_s"],
            spin=table(
                ["method", *(f"{n} steps" for n in spin["num_steps"])],
                [
                    [name, *("not finite" if x is None else f"{x:.1e}" for x in row)]
                    for name, row in spin["relative"].items()
                ],
            ),
            drift_steps=drift["num_steps"],
            drift_alpha=drift["alpha"],
            drift=drift_table(drift["entries"]),
            not_installed=f"Not installed on this machine: {', '.join(missing)}. " if missing else "",
            omega_max=peers["omega_h"][-1],
            springs=table(
                ["method", "largest omega h"],
                [[name, "all" if x is None else f"{x:.3g}"] for name, x in peers["largest_stable_omega_h"].items()],
            ),
            max_steps=MAX_STEPS,
            dampers=dampers_table(peers["dampers"]),
            rod_duration=peers["rod"]["duration_s"],
            rods=table(
                ["method", "relative error of the length"],
                [[name, f"{x:.1e}"] for name, x in peers["rod"]["error_at_end"].items()],
            ),
        )
    )


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "stability.json").read_text())))
