"""The comparison of a run's numbers with the committed ones: what is a loss, what is not."""

import copy
import json

import pytest

from experiments.__main__ import EXPERIMENTS
from experiments.check import check, compare, kind
from experiments.results import baseline

COMMITTED = {name: path for name, module in EXPERIMENTS.items() if (path := baseline(module, name)).is_file()}
SILVERBOX = json.loads(COMMITTED["silverbox"].read_text())


def in_folder(tmp_path, numbers):
    """The exit code of the check of a run that wrote these numbers of Silverbox."""
    (tmp_path / "silverbox.json").write_text(json.dumps(numbers))
    return check(EXPERIMENTS, tmp_path)


def changed(change):
    numbers = copy.deepcopy(SILVERBOX)
    change(numbers["models"]["8 parameters"])
    return numbers


def test_a_planted_loss_is_named_and_fails(tmp_path, capsys):
    assert in_folder(tmp_path, changed(lambda model: model.update(multisine_mV=0.26))) == 1
    told = capsys.readouterr().out.splitlines()
    assert told[0].endswith("1 worse.")
    assert told[1].strip() == "models/8 parameters/multisine_mV: 0.238119 -> 0.26 (limit 0.250025)"


@pytest.mark.parametrize(
    ("change", "lost"),
    [
        ({"multisine_mV": 0.1, "fit_time_s": 99.0, "fit_with_compilation_s": 99.0, "iterations": 99}, []),
        ({"train_mV": 0.2281884 * 1.04}, []),
        ({"train_mV": None}, ["train_mV"]),
        ({"m_in_s^2": 5.0e-6}, ["m_in_s^2"]),  # an estimate may move neither down nor up
        ({"m_in_s^2": 5.7e-6}, ["m_in_s^2"]),
        ({"standard_error_k_in_1": 1e-6}, ["standard_error_k_in_1"]),
    ],
)
def test_better_numbers_and_times_pass_and_estimates_stay(change, lost):
    _, bad = compare(SILVERBOX, changed(lambda model: model.update(change)))
    assert [x.path for x in bad] == [f"models/8 parameters/{name}" for name in lost]


def test_a_missing_number_is_named_unless_the_run_leaves_it_out_on_purpose(tmp_path, capsys):
    without = changed(lambda model: model.pop("train_mV"))
    assert in_folder(tmp_path, without) == 1
    assert "models/8 parameters/train_mV: 0.228188 -> is missing" in capsys.readouterr().out
    assert in_folder(tmp_path, {**without, "made_by": {"mode": "part"}}) == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [({"made_by": {"mode": "fast"}}, "a smoke run (--fast) has less data"), ({"data": "generated"}, "generated data")],
)
def test_what_cannot_be_compared_is_not_taken_for_a_pass(tmp_path, capsys, change, words):
    assert in_folder(tmp_path, {**SILVERBOX, **change}) == 2
    assert words in capsys.readouterr().out


def test_rows_belong_together_by_name_and_setting():
    rows = [{"method": m, "h_s": h, "error_m": h**2, "seconds": 1.0} for m in "ab" for h in (0.1, 0.2)]
    assert compare({"rows": rows}, {"rows": rows[::-1]}) == (4, [])
    (missing,) = compare({"rows": rows}, {"rows": rows[1:]})[1]
    assert missing.path == "rows/[method=a, h_s=0.1]/error_m"
    alike = [{"method": "a", "error_m": x} for x in (1.0, 2.0)]
    assert len(compare({"rows": alike}, {"rows": [{"method": "a", "error_m": 1.5}, alike[1]]})[1]) == 1


def test_rounding_is_no_loss():
    assert compare({"difference_rad": 1e-15}, {"difference_rad": 9e-15}) == (1, [])
    assert len(compare({"difference_rad": 1e-10}, {"difference_rad": 9e-10})[1]) == 1


def test_what_a_number_is_by_its_key():
    expected = {
        "error": ["rms_error_rad", "test_mrad/0.25 s", "k/m bias %", "cost_in_V^2", "held_out_mrad/[0]", "wrong %"],
        "success": ["order", "covered/Richardson/k1", "accurate %", "slopes/free double pendulum, hht, converged/[0]"],
        "estimate": ["k_in_1", "over_truth_with_interval/k1/[0]", "standard_error_over_scatter/k/naive"],
        "ignored": [
            "fit_time_s", "compile_s", "us_per_step", "h_s", "stiff_ns_per_step/converged", "rows/[order=2]/alpha",
            "error_times_time_rad_s", "time_s/0.001", "made up", "iterations",
        ],
    }  # fmt: skip
    for name, keys in expected.items():
        for key in keys:
            path = ("k/m bias %",) if "k/m" in key else tuple(key.split("/"))
            assert kind(path) == name, key


@pytest.mark.slow
@pytest.mark.parametrize("name", COMMITTED)
def test_committed_numbers_compare_with_themselves(name):
    """And every one that counts is needed."""
    numbers = json.loads(COMMITTED[name].read_text())
    count, bad = compare(numbers, numbers)
    assert count >= (5 if name == "export" else 20)  # of export, nearly all are times
    assert not bad
    assert len(compare(numbers, {})[1]) == count
