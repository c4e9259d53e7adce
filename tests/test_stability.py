"""How large a step each method survives: pinned, so that it cannot shrink unseen."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.cells import FARTHEST
from experiments.stability.gallery import METHODS, simulate_all
from experiments.stability.grades import plain
from experiments.stability.scenes import all_cases

ROOT = Path(__file__).parents[1]

# "boundaries" of stability.json, from `python -m experiments stability`: for each scene and method, and for alpha = 0,
# -0.05 and -0.3, the fewest steps from which on every run stays bounded; null where the finest does not
PINNED = json.loads((ROOT / "tests" / "data" / "stability.json").read_text())
CASES = {case.name: case for case in all_cases()}
CHECKED = [  # all would take minutes to compile: the default where it fails first, and its rivals where they do
    ("hardening spring", "HHT\nauto"),
    ("hardening spring", "HHT\nheld"),
    ("cubic damper", "HHT\nauto"),
    ("tanh friction", "HHT\nauto"),
    ("elastic pendulum, k = 1e6", "HHT\nauto"),
    ("stick-slip", "HHT\nauto"),
    ("hardening spring", "Rosenbrock\nL-stable"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "method"), CHECKED)
def test_a_step_that_was_survived_still_is(scene, method):
    pinned = PINNED[scene]
    fewest = pinned["fewest_steps"][plain(method)]
    for num_steps in sorted({x for x in fewest if x is not None}):
        for factor in (1, 2, 4):
            _, farthest, _ = simulate_all(CASES[scene].scene, factor * num_steps, method)
            due = [x is not None and x <= num_steps for x in fewest]
            assert np.all(np.asarray(farthest)[due] <= FARTHEST * pinned["reach"]), (factor * num_steps, farthest)


def test_every_method_and_scene_is_pinned():
    assert set(PINNED) == set(CASES)
    for pinned in PINNED.values():
        assert set(pinned["fewest_steps"]) == {plain(method) for method in METHODS}
