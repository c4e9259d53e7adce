"""The Cardona and Geradin experiment: what its committed numbers must show, its page, and a part of it, run."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.cardona_geradin1989 import page, squeezer, work_precision
from experiments.cardona_geradin1989.pendulum import exact, run_method
from experiments.page import find

ROOT = Path(__file__).parents[1]

HERE = ROOT / "experiments" / "cardona_geradin1989"
COMMITTED = json.loads((HERE / "cardona_geradin1989.json").read_text())


@pytest.mark.slow
def test_the_trapezoidal_rule_grows_but_not_with_ggl():
    """From zero initial accelerations: the error of the tension after one second, over the tension at the start."""
    times = 5e-3 * np.arange(401)
    _, _, tension = exact(2.505, times)
    late = slice(180, 201)

    def left(method):
        return np.max(np.abs(run_method(method, 2.505, 5e-3, "zero")[2] - tension)[late]) / tension[0]

    assert left("trapezoidal rule, non-iterative") > 5
    assert left("HHT, alpha = -0.1, non-iterative") < 1e-3
    assert left("trapezoidal rule, non-iterative GGL") == pytest.approx(2.505**2 / 0.5 / tension[0], rel=1e-2)


def test_the_committed_numbers_hold_what_the_page_says():
    work = COMMITTED["work_precision"]
    for h, bar in work_precision.BARS.items():
        assert find(work["entries"], method="non-iterative, GGL", h_s=pytest.approx(h))["q_error_rad"] <= bar
    for by_quantity in work["orders"].values():
        assert list(by_quantity.values()) == pytest.approx([2, 2, 2], abs=0.1)
    stops = {e["formulation"]: e for e in work["newton_tolerances"] if e["newton_tolerance_N_m"] == 1e-10}
    assert stops["index3"]["time_over_non_iterative"] > 3

    entries = COMMITTED["squeezer"]["entries"]
    for method, error in (page.HHT, 4.4e-4), (page.DAMPED, 7.8e-2):  # theory.md, section 7
        assert find(entries, method=method)["q_error_at_0.02_s_rad"] == pytest.approx(error, rel=1e-2)
    diverged, kept = (
        find(entries, method=name)["acceleration_error_at_0.06_s_rad_s2"]
        for name in (page.TRAPEZOIDAL, list(squeezer.METHODS)[-1])
    )
    assert diverged > 1000 * kept

    for e in COMMITTED["drift"]["entries"]:
        if "HHT, non-iterative" in e["method"]:
            assert e["num_steps"] == 1_000_000
            assert e["position_last_tenth"] < 1.01 * e["position_first_tenth"]
            assert e["rate_last_tenth"] < 1.01 * e["rate_first_tenth"]
