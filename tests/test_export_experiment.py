"""The experiment on export: what its committed numbers must show."""

import json
from pathlib import Path

COMMITTED = json.loads((Path(__file__).parents[1] / "experiments" / "export" / "export.json").read_text())


def test_the_committed_numbers_hold_what_is_claimed():
    fitted, speed, real = (COMMITTED[part] for part in ("pendulum", "speed", "real_time"))
    assert fitted["difference_rad"] < 1e-12
    assert fitted["flags"] == 0
    assert fitted["num_steps"] == 10_000
    assert speed["time_over_by_hand"] <= 1.1
    assert len(speed["scenes"]) >= 15
    assert all(row["c_time_over_xla"] <= 1.5 for row in speed["scenes"])
    assert {row["form"] for row in real["deadlines"]} >= {"step", "empty loop", "Python, step"}
    assert real["back_to_back"][0]["calls"] == 10_000_000
