"""The page of reported problems: what its committed numbers must show."""

import json
from pathlib import Path

from experiments.reported.cases import CASES
from experiments.reported.reported import LIMIT

HERE = Path(__file__).parents[1] / "experiments" / "reported"
COMMITTED = json.loads((HERE / "reported.json").read_text())


def test_every_reported_problem_has_its_right_answer():
    rows = {row["what"]: row for row in COMMITTED["cases"]}
    for case in (case for cases in CASES.values() for case in cases):
        assert case.holds(rows[case.what]["found"]), case.what


def test_no_stepper_overshoots_what_is_stiffly_damped():
    for kind, by_name in COMMITTED["worst_error"].items():
        for name, error in by_name.items():
            assert error < LIMIT, (kind, name)


def test_starts_off_the_slow_manifold_are_of_order_two():
    for name, by_mass in COMMITTED["order"].items():
        for order in by_mass.values():
            assert abs(order - 2) < 0.15, name
