"""The identification experiments: what their committed numbers must show, and their page."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from experiments.identification import page  # noqa: E402
from experiments.page import find  # noqa: E402

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


def test_the_page_is_made_from_the_committed_numbers():
    text = (page.HERE / "README.md").read_text()
    assert text == page.page(NUMBERS)
    for name in ("stiff_joint", "stiff_joint_gradients", "vehicle", "squeezer"):
        assert f"({name}.png)" in text
        assert (page.HERE / f"{name}.png").stat().st_size < 200_000
