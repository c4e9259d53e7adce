"""The identification experiments: what their committed numbers must show, and their page."""

import numpy as np
import pytest

from experiments.identification import page
from experiments.page import find

NUMBERS = page.read()


def test_intervals_hold_the_truth_once_the_step_size_is_taken_out():
    """Joint stiffness and damping in 93 of 100 records; with the step alone, k1 in fewer than half."""
    stiff = NUMBERS["stiff_joint"]["recovery"]
    assert stiff["records"] == stiff["converged"] == 100
    assert min(stiff["covered"]["Richardson"].values()) >= 93
    assert stiff["covered"]["h"]["k1"] < 50
    assert stiff["largest_cost_per_residual"] < 1.2
    assert max(stiff["k1_true_N_m_rad"]) / min(stiff["k1_true_N_m_rad"]) > 5e4
    for name in ("vehicle", "squeezer"):
        found = NUMBERS[name]
        assert found["converged"] >= 0.95 * found["records"]
        assert min(found["covered"]["Richardson"].values()) >= 0.85 * found["records"]


def test_gradients_are_of_second_order_for_every_alpha():
    rows = NUMBERS["stiff_joint"]["gradients"]["rows"]
    for method in {row["method"] for row in rows if "h_s" in row}:
        coarse, fine = (find(rows, method=method, h_s=h)["relative_error"] for h in (0.01, 0.005))
        assert coarse / fine == pytest.approx(4, abs=0.1)


def test_measured_systems():
    """Starts 3 times off, standard errors, Richardson's value, and predictions of an unseen trial."""
    far = NUMBERS["silverbox_comparison"]["far_starts"]
    for how in ("a growing part", "windows"):
        found = far["3 times off"][f"hhtjax.fit_progressively, {how}"]
        assert found["right"] == found["of"] == 5
        assert found["slowest_s"] <= 1
    for name in ("3 times off, others", "2 times off"):
        assert far[name]["hhtjax.fit_progressively, windows"]["right"] == 20
    for model in NUMBERS["silverbox"]["models"].values():
        ratios = [r["cluster"] for r in model["standard_error_over_scatter"].values() if isinstance(r, dict)]
        assert len(ratios) >= 6
        assert 0.8 <= min(ratios) <= max(ratios) <= 1.25
    agreement = NUMBERS["silverbox"]["by_step_size"]["richardson_agreement"]
    for name in ("alpha 0.0, 2 levels", "alpha -0.05, 3 levels"):
        assert max(map(abs, agreement[name].values())) < 3e-5
    pendulum = NUMBERS["double_pendulum_measured"]
    assert pendulum["chosen_windows_s"] == pendulum["windows_s"] == [0.25, 0.5, 1.0]
    assert np.all(np.array(list(pendulum["test_mrad"].values())) <= [1.6, 2.5, 7.0])
    assert pendulum["long_windows_mrad"]["viscous and dry, progressive horizon"] <= 1.6


def test_choices_are_by_the_parts_left_out_and_hold_on_the_test_records():
    tanks = NUMBERS["tanks"]
    chosen = min(tanks["models"], key=lambda row: row["left_out_V"])
    assert tanks["chosen"] == chosen["model"]
    assert tanks["data"] == "measured"
    assert tanks["test_V"] == chosen["test_V"] <= 0.2
    for name, (lower, upper) in tanks["interval_95"].items():
        (estimate,) = (x for key, x in tanks["estimates"].items() if key.startswith(f"{name}_in_"))
        assert lower < estimate < upper
    first, *added = NUMBERS["silverbox_terms"]["models"]
    assert first["parameters"] == 10
    for count in (11, 12):
        tried = [row for row in added if row["parameters"] == count]
        (kept,) = (row for row in tried if row["kept"])
        assert kept["left_out_mV"] == min(row["left_out_mV"] for row in tried) < first["left_out_mV"]
    assert find(added, model="+ relaxing_cubic")["arrow_full_mV"] <= 0.26 < first["arrow_full_mV"]


def test_the_page_is_made_from_the_committed_numbers():
    text = (page.HERE / "README.md").read_text()
    assert text == page.page(NUMBERS)
    for figure in page.HERE.glob("*.png"):
        assert f"({figure.name})" in text
        assert figure.stat().st_size < 200_000
