"""The experiment on sweeps: what its committed numbers must show, and its page."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]

HERE = ROOT / "experiments" / "sweeps"
COMMITTED = json.loads((HERE / "sweeps.json").read_text())


def test_the_committed_numbers_hold_what_is_claimed():
    for row in COMMITTED["orders"]["rows"]:
        first = row["method"] in ("operator_splitting", "implicit_euler") or (
            row["method"] == "kim_hht" and row["alpha"] != 0
        )
        expected = {"rowda": 3, "rk4": 4}.get(row["method"], 1 if first else 2)
        assert abs(row["order"] - expected) < 0.15, row["method"]
    assert COMMITTED["one_call"]["run_ratio"] <= 1.15
    assert COMMITTED["one_call"]["largest_difference_rad"] < 1e-9
    assert COMMITTED["map"]["members"] == 100_000
    assert COMMITTED["map"]["peak_MB"] <= 1000
    assert COMMITTED["devices"]["bitwise_equal"]
    workers = COMMITTED["workers"]
    assert workers["bitwise_equal"]
    assert all(x["equal"] and x["kills"] == 20 for x in workers["killed"].values())
    assert all(set(row.get("compiled_by_each", [1])) == {1} for row in workers["rows"].values())
    assert workers["fit"]["apart_in_standard_errors"] < 1e-3
    assert COMMITTED["real_time"]["median_over_empty_call"] <= 3
    for row in COMMITTED["real_time"]["rows"]:
        assert row.get("while_loops", 0) == (row["scene"] == "squeezer" and "while_loops" in row)
        assert row.get("exported_is_bitwise_equal", True)
