"""The experiment on export: what its committed numbers must show."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.export.real_time import TURNS, chance, explained

COMMITTED = json.loads((Path(__file__).parents[1] / "experiments" / "export" / "export.json").read_text())


def test_the_committed_numbers_hold_what_is_claimed():
    fitted, speed, real = (COMMITTED[part] for part in ("pendulum", "speed", "real_time"))
    assert fitted["difference_rad"] < 1e-12
    assert fitted["flags"] == 0
    assert fitted["num_steps"] == 10_000
    assert speed["time_over_by_hand"] <= 1.1
    assert len(speed["scenes"]) >= 15
    assert all(row["c_time_over_xla"] <= 1.5 for row in speed["scenes"])
    assert {row["form"] for row in real["deadlines"]} >= {"step", "waits as long", "empty loop", "Python, step"}
    assert all(x >= 0.05 for x in real["chance_of_not_explained"].values())
    assert set(real["chance_of_not_explained"]) == {"1 kHz", "10 kHz"}
    assert real["back_to_back"][0]["calls"] == 10_000_000


@pytest.mark.parametrize(
    ("woke", "own", "causes", "holds"),
    [
        (20_000, 2_000, (0, 0, 0), True),
        (150_000, 2_000, (1, 0, 0), True),  # stopped until after the deadline
        (99_000, 2_000, (0, 1, 0), True),  # or until just before it
        (20_000, 120_000, (0, 0, 1), True),  # one long step may be an interruption that the kernel does not see
    ],
)
def test_what_a_missed_deadline_comes_from(woke, own, causes, holds):
    """Of loops that wake after 20 to 30 us and work for 2; in one period the step's does otherwise."""
    usual = np.stack([np.linspace(20e3, 30e3, 1000), np.linspace(22e3, 32e3, 1000), np.full(1000, 2e3)], axis=1)
    step = usual.copy()
    step[500] = woke, woke + own, own
    rows, likely = explained({"step": step, "waits as long": usual, "empty loop": usual}, 100_000)
    found = rows["step"]
    assert tuple(found[f"{key}_count"] for key in ("woke_too_late", "interrupted", "not_explained")) == causes
    assert (likely >= 0.05) is holds
    assert rows["waits as long"]["missed_count"] == 0


def test_a_step_that_is_too_long_is_not_explained():
    usual = np.stack([np.full(1000, 20e3), np.full(1000, 22e3), np.full(1000, 2e3)], axis=1)
    long = usual + np.array([0, 120e3, 120e3])
    rows, likely = explained({"step": long, "waits as long": long, "empty loop": usual}, 100_000)
    assert rows["step"]["not_explained_count"] == 1000
    assert likely == 0


def test_more_than_chance_allows():
    none = np.zeros(TURNS, int)
    one_burst = np.concatenate([[500], none[1:]])
    assert chance(none, none) == 1
    assert chance(one_burst, none) == 0.5  # a stop says nothing of the step, however long
    assert chance(one_burst, one_burst) == 1
    assert chance(none + 1, none) == 2.0**-TURNS  # in each turn
    assert chance(none, none + 1) == 1
