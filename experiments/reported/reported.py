"""Problems that people brought to other tools, which the library once answered wrongly or not: before, and now.

Each is a script of a few lines, as its user would write it, and has one right answer. Those of starts off the slow
manifold (light, damped coordinates) are run for every stepper, mass and place: at the start, behind an event, behind a
jump of a held input, beside a constraint.
"""

import json
from pathlib import Path

import numpy as np

from experiments.reported import starts
from experiments.reported.case import answer
from experiments.reported.cases import CASES
from hhtjax.plot import COLOURS, MARKERS, subplots

HERE = Path(__file__).parent
LIMIT = 2e-3  # of the error over F/k, of light masses


def answers(report, fast=False):
    """A row for each case: what, the right answer, what came out, and whether that holds."""
    rows = []
    for kind, cases in CASES.items():
        for case in cases[: 1 if fast else None]:
            if fast and case.is_long:
                continue
            found = answer(case.script)
            right = case.right if isinstance(case.right, str) else float(case.right)
            rows.append({"kind": kind, "what": case.what, "right": right, "found": found, "holds": case.holds(found)})
            report.progress(f"{kind}: {case.what}")
    return rows


def figure(before, now):
    """Errors over the mass, of each stepper, in each place."""
    kinds = list(now["error_over_F_by_k"])
    drawn, axes = subplots(1, len(kinds), width=175, height=90, sharex=True, sharey=True)
    for place, kind in zip(np.ravel(axes), kinds, strict=True):
        for i, name in enumerate(starts.STEPPERS):
            for told, style in ((before, ":"), (now, "-")):
                errors = told["error_over_F_by_k"][kind].get(name)
                if errors is not None:
                    label = name if told is now and place is np.ravel(axes)[0] else None
                    style = {"linestyle": style, "color": COLOURS[i % len(COLOURS)], "label": label}
                    marker = MARKERS[i % len(MARKERS)] if told is now else ""
                    place.loglog(told["m_kg"], np.maximum(errors, 1e-8), marker=marker, markersize=2.5, **style)
        place.axhline(LIMIT, color="0.5", linewidth=0.8, linestyle="--")
        place.set_title(kind)
        place.set_xlabel("m (kg)")
    np.ravel(axes)[0].set_ylabel("error of q over F/k")
    drawn.legend(loc="outside lower center", ncols=4)
    return drawn


def run(report, fast):
    """All problems."""
    found, before = starts.errors(report, fast), json.loads((HERE / "before.json").read_text())
    rows = answers(report, fast)
    earlier = {row["what"]: row["found"] for row in before["cases"]}
    report.table(
        ["what", "right", "before", "now"],
        [
            [row["what"], *(shown(x) for x in (row["right"], earlier.get(row["what"], ""), row["found"]))]
            for row in rows
        ],
    )
    light = np.array(found["m_kg"]) <= starts.LIGHT
    worst = {
        kind: {name: float(np.max(np.array(x)[light])) for name, x in by_name.items()}
        for kind, by_name in found["error_over_F_by_k"].items()
    }
    print(f"Largest error over F/k for m <= {starts.LIGHT} kg\n")
    names = list(starts.STEPPERS)
    report.table(["", *worst], [[name, *(worst[k].get(name, float("nan")) for k in worst)] for name in names])
    if not fast:
        report.figure("reported_starts", figure(before["starts"], found))
    report.numbers({"cases": rows, "starts": found, "worst_error": worst, "order": starts.orders(fast)})
    wrong = [row["what"] for row in rows if not row["holds"]]
    assert not wrong, f"wrong answers: {wrong}"


def shown(x, most=60):
    """A number to six digits, a text cut."""
    return f"{x:.6g}" if not isinstance(x, str) else x if len(x) <= most else f"{x[: most - 3]}..."
