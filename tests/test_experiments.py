"""The runner, and Silverbox as a user runs it: on the measured record where there is one, else on a generated one."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ.get("HHTJAX_DATA") or ROOT.parent / "shared" / "data")


def experiments(*arguments, **environment):
    """As on a user's machine: with the experiments' own flags for XLA."""
    inherited = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    return subprocess.run(
        [sys.executable, "-m", "experiments", *arguments],
        cwd=ROOT,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def test_without_a_name_they_are_listed():
    result = experiments()
    assert result.returncode == 0
    for name in ("silverbox", "double_pendulum_measured", "stiff_joint", "vehicle", "squeezer", "kim2019", "all"):
        assert any(line.split()[:1] == [name] and len(line) > 30 for line in result.stdout.splitlines())


def test_an_unknown_name_gives_the_list_and_fails():
    result = experiments("silverbocks")
    assert result.returncode == 2
    assert "Unknown experiment 'silverbocks'" in result.stderr
    assert "silverbox" in result.stderr


@pytest.mark.slow
def test_silverbox_without_the_data_recovers_the_generated_parameters(tmp_path):
    result = experiments("silverbox", "--fast", "--out", str(tmp_path), HHTJAX_DATA=str(tmp_path / "nowhere"))
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[0].startswith("GENERATED record, known parameters")
    assert "nonlinearbenchmark.org" in result.stdout.splitlines()[0]
    numbers = json.loads((tmp_path / "silverbox.json").read_text())
    assert numbers["data"] == "generated"
    (model,) = numbers["models"].values()
    assert model["k_in_1"] == pytest.approx(1.0, rel=5e-3)
    assert model["c_in_s"] == pytest.approx(2.2e-4, rel=1e-2)
    assert numbers["multisine_mV"] < 0.5
    assert len(list(tmp_path.glob("*.png"))) == 3


@pytest.mark.slow
def test_silverbox_on_the_measured_record():
    """Full training record, 8 steps per sample, 6 parameters: the errors that this model reaches."""
    if not (DATA / "silverbox").is_dir():
        pytest.skip("the measured Silverbox record is not here: set HHTJAX_DATA to the folder that holds silverbox/")
    from experiments.identification import data, silverbox

    sets = data.load(fast=False)
    assert sets.measured
    result, *_ = silverbox.fit_training(sets.train, silverbox.SUBSTEPS, 0.0)
    assert result.converged
    assert silverbox.rmse(result.residual) == pytest.approx(0.2987, abs=5e-4)
    expected = {"arrow_full": 0.3894, "multisine": 0.3043}
    for name, value in expected.items():
        _, error, _ = silverbox.score(result.params[0], sets.tests[name], silverbox.SUBSTEPS, 0.0)
        assert error == pytest.approx(value, abs=5e-4)
