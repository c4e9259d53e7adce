"""The Kim 2019 experiment: what it must show, from its own parts in their fast form; and its page."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.kim2019 import alpha, linear, order, page, repaired, stability, tables
from experiments.report import Report

ROOT = Path(__file__).parents[1]

HERE = ROOT / "experiments" / "kim2019"
COMMITTED = json.loads((HERE / "kim2019.json").read_text())


@pytest.fixture
def report(tmp_path):
    return Report("kim2019", tmp_path)


@pytest.mark.slow
def test_stability_regions_equal_the_closed_form(report):
    methods = stability.run(report, fast=True)["methods"]
    assert len(methods) == 5
    for name, found in methods.items():
        assert found["deviation_of_characteristic_polynomial"] < 1e-12, name
        assert found["deviation_of_spectral_radius"] < 1e-12, name
        assert found["largest_radius_in_left_half_plane"] < 1, name
    assert methods["non-iterative HHT, alpha = -0.3"]["unstable_on_real_axis_until"] == pytest.approx(2 / 0.12)
    assert methods["conventional HHT, alpha = -0.3"]["unstable_on_real_axis_until"] == pytest.approx(1 / 0.12)
    assert methods["implicit Euler, alpha = 0"]["unstable_on_real_axis_until"] == pytest.approx(2.0)


@pytest.mark.slow
def test_damping_and_period_of_the_runs_equal_theory(report):
    numbers = linear.run(report, fast=True)
    for entry in numbers["damped"]:
        assert entry["factor_per_step"] == pytest.approx(entry["closed_form"], rel=1e-12)
    for entry in numbers["oscillator"]:
        assert entry["largest_difference_of_decrement_to_theory"] < 1e-12
        assert entry["largest_difference_of_phase_to_theory_rad"] < 1e-12
    kim, hht = (page.find(numbers["oscillator"], method=m, alpha=-0.05) for m in ("Kim's step", "hht"))
    assert kim["damping_ratio_at_wh_0.1"] == pytest.approx(0.1 * 0.05 * 0.9 / 4, rel=2e-2)  # -(alpha/2 + alpha^2) w h/2
    assert hht["damping_ratio_at_wh_0.1"] == pytest.approx(5.6e-6, rel=1e-2)  # theory.md, section 9


@pytest.mark.slow
def test_orders_and_the_modified_equation(report):
    entries = order.run(report, fast=True)["entries"]
    expected = {"conventional HHT, Eq. 5 with t~": 1, "non-iterative HHT, Eq. 13": 1, "hht, refreshed": 2}
    assert [e["method"] for e in entries] == list(expected)
    for e in entries:
        assert e["order"] == pytest.approx(expected[e["method"]], abs=0.1)
        assert e["order_after_subtracting_the_modified_motion"] == pytest.approx(2, abs=0.1)
        if expected[e["method"]] == 1:
            assert e["error_over_predicted_at_finest"] == pytest.approx(1, abs=0.05)


@pytest.mark.slow
def test_tables_alpha_and_repaired_forms(report):
    """One test, because the three share their runs."""
    entries = tables.run(report, fast=True)["Table 5"]
    assert len(entries) == 18
    for e in entries:
        assert e["deviation_from_reproduced"] < 1e-4
        if e["reference_error_rad"] is None:
            assert abs(e["relative_difference"]) < 2e-3
        else:
            assert e["reference_error_rad"] == pytest.approx(2.43e-5 if e["angle"] == "q1" else 2.19e-5, rel=1e-2)
    for e in alpha.run(report, fast=True)["entries"]:
        assert np.argmin(e["deviation"]) == 0
        assert e["deviation"][0] < 1e-3 < 5 * e["deviation"][1]
    for e in repaired.run(report, fast=True)["entries"]:
        literal = e["method"] in repaired.METHODS[:2]
        if e["alpha"] == 0 or not literal:
            assert e["order"] == pytest.approx(2, abs=0.1)
        elif e["alpha"] == -0.3:
            assert e["order"] == pytest.approx(1, abs=0.1)
        if e["method"] == "refreshed":
            assert max(e["error_over_converged"]) < 1  # on the free pendulum


def test_the_committed_numbers_hold_what_the_page_says():
    entries = COMMITTED["tables"]["Table 2"] + COMMITTED["tables"]["Table 5"]
    assert len(entries) == 48
    for e in entries:
        assert e["deviation_from_reproduced"] < (1e-4 if e["ours_rad"] >= 1e-6 else 1e-3)
    for e in COMMITTED["order"]["entries"]:
        literal, varying, drive = "hht," not in e["method"], "M(q)" in e["case"], "explicit" in e["case"]
        kim = "non-iterative" in e["method"]
        fictive = "t~" in e["method"]
        first = literal and ((e["alpha"] and (varying or kim or (fictive and drive))) or (kim and drive))
        assert e["order"] == pytest.approx(1 if first else 2, abs=0.1), e
        assert e["order_after_subtracting_the_modified_motion"] == pytest.approx(2, abs=0.1), e
    vehicle = COMMITTED["vehicle"]["methods"]["HHT, predictor"]
    assert vehicle["error_at_it_mm"] < 1
    assert vehicle["real_time_factor_at_it"] >= 1000
