"""README.md beside this file, made from page.md, before.json and reported.json.

`python -m experiments.reported.page`
"""

import json
from pathlib import Path

from experiments.page import table
from experiments.reported.reported import shown
from experiments.reported.starts import LIGHT

HERE = Path(__file__).parent


def page(numbers):
    """The text of README.md."""
    before = json.loads((HERE / "before.json").read_text())
    earlier = {row["what"]: row["found"] for row in before["cases"]}
    rows = [
        [row["what"], *(cell(x) for x in (row["right"], earlier.get(row["what"], "-"), row["found"]))]
        for row in numbers["cases"]
    ]
    kinds = list(numbers["worst_error"])
    steppers = list(next(iter(numbers["worst_error"].values())))
    worst = [
        [
            name,
            *(both(of_light(before["starts"], kind, name), numbers["worst_error"][kind].get(name)) for kind in kinds),
        ]
        for name in steppers
    ]
    order = [[name, *(f"{x:.2f}" for x in by_mass.values())] for name, by_mass in numbers["order"].items()]
    masses = list(next(iter(numbers["order"].values())))
    errors_before = [x for kind in kinds for x in light_errors(before["starts"], kind) if x is not None]
    return (
        (HERE / "page.md")
        .read_text()
        .format(
            problems=len(rows),
            worst_before=f"{max(errors_before):.0e} F/k",
            worst_now=f"{max(x for by_name in numbers['worst_error'].values() for x in by_name.values()):.0e} F/k",
            cases=table(["problem", "right answer", "before", "now"], rows),
            worst=table(["before -> now", *kinds], worst),
            order=table(["method", *(f"m = {m} kg" for m in masses)], order),
        )
    )


def of_light(told, kind, name):
    """The largest error of a stepper for light masses."""
    errors = told["error_over_F_by_k"][kind].get(name)
    return None if errors is None else max(x for x, m in zip(errors, told["m_kg"], strict=True) if m <= LIGHT)


def light_errors(told, kind):
    """The largest errors of all steppers for light masses."""
    return [of_light(told, kind, name) for name in told["error_over_F_by_k"][kind]]


def both(before, now):
    """An error before and now."""
    return "-" if now is None else f"{'-' if before is None else f'{before:.1e}'} -> {now:.1e}"


def cell(x):
    """A number or a text, in a table of Markdown."""
    return shown(x, most=240).replace("|", "\\|").replace("*", "\\*")


if __name__ == "__main__":
    (HERE / "README.md").write_text(page(json.loads((HERE / "reported.json").read_text())))
