"""The EMPS experiment: its committed numbers, where its records come from, and generated ones."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.io import savemat

from experiments.identification import data as silverbox
from experiments.identification import emps_data as data
from experiments.identification import tanks_data

NUMBERS = json.loads((Path(data.__file__).parent / "emps.json").read_text())
PUBLISHED = {"M": 95.1089, "Fv": 203.5034, "Fc": 20.3935, "offset": -3.1648, "delay": data.HOLD}


def test_the_committed_numbers_are_those_of_the_measured_record():
    """The model is taken by errors inside the training record; then the test record has a bar."""
    assert NUMBERS["data"] == "measured"
    assert not NUMBERS["fast"]
    models, chosen = NUMBERS["models"], NUMBERS["models"][NUMBERS["chosen"]]
    assert chosen["test_mm"] <= 5.2
    assert chosen["parameters"] <= 6
    close = {name: row for name, row in models.items() if row["behind_the_best"] <= 1}
    assert chosen["parameters"] == min(row["parameters"] for row in close.values())
    assert NUMBERS["published_parameters"]["train_mm"] == pytest.approx(6.74, abs=0.02)
    assert NUMBERS["published_parameters"]["test_mm"] == pytest.approx(9.21, abs=0.02)
    assert 1.02 < NUMBERS["other_friction"]["Fc_over_training"] < 1.06
    assert NUMBERS["other_friction"]["test_mm"] < 0.7 * chosen["test_mm"]
    assert NUMBERS["worth_independent"] < 0.01 * NUMBERS["observations"]
    for name in ("M", "Fc"):
        rows = NUMBERS["valley"][name]
        least = min(row["train_mm"] for row in rows)
        assert max(row["train_mm"] for row in rows) < 1.5 * least


@pytest.mark.slow
def test_published_parameters_leave_what_others_found():
    if not (data.data_folder() / "emps").is_dir():
        pytest.skip("the EMPS records are not here: set HHTJAX_DATA to the folder that holds emps/")
    sets = data.load(fast=False)
    assert sets.hold == data.HOLD
    scored = [data.score(PUBLISHED, getattr(sets, part))[1] for part in data.PARTS]
    np.testing.assert_allclose(scored, [6.74, 9.21], atol=0.02)


def arrays(samples=400):
    t = data.DT * np.arange(samples)
    return {"vir": np.sin(t), "qm": 0.1 * np.sin(t), "qg": 0.1 * np.sin(t)}


def package(monkeypatch, folder, **benchmarks):
    """The package that downloads, of which only the benchmarks given exist."""
    monkeypatch.setenv("HHTJAX_DATA", str(folder / "nowhere"))
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", SimpleNamespace(**benchmarks))


def test_records_are_downloaded_where_the_package_is(monkeypatch, tmp_path):
    """As MATLAB files, columns; the folder of data comes first."""
    files = [tmp_path / name for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")]
    for i, file in enumerate(files):
        savemat(file, {name: (i + 1) * x[:, None] for name, x in arrays().items()})
    package(monkeypatch, tmp_path, EMPS=lambda data_file_locations: list(map(str, files)))
    sets = data.load(fast=False)
    assert sets.measured
    np.testing.assert_array_equal(sets.train.u, arrays()["vir"])
    np.testing.assert_array_equal(sets.test.y, 2 * arrays()["qm"])
    (tmp_path / "own" / "emps").mkdir(parents=True)
    for part in data.PARTS:
        np.savez(tmp_path / "own" / "emps" / f"{part}.npz", **{n: 3 * x for n, x in arrays().items()})
    monkeypatch.setenv("HHTJAX_DATA", str(tmp_path / "own"))
    np.testing.assert_array_equal(data.load(fast=False).train.y, 3 * arrays()["qm"])


def test_silverbox_is_downloaded_too(monkeypatch, tmp_path):
    file = tmp_path / "SNLS80mV.mat"
    record = np.arange(131072.0)
    savemat(file, {"V1": record[None, :], "V2": -record[None, :]})
    other = str(tmp_path / "Schroeder80mV.mat")
    package(monkeypatch, tmp_path, Silverbox=lambda data_file_locations: (other, str(file)))
    sets = silverbox.load(fast=True)
    assert sets.measured
    assert sets.train.u[0] == 40650
    assert sets.train.y[0] == -40650


def test_tanks_are_downloaded_too(monkeypatch, tmp_path):
    file = tmp_path / "dataBenchmark.mat"
    savemat(file, {name: np.arange(1024.0)[:, None] + i for i, name in enumerate(("uEst", "uVal", "yEst", "yVal"))})
    package(monkeypatch, tmp_path, Cascaded_Tanks=lambda data_file_locations: [str(tmp_path / "about.txt"), str(file)])
    sets = tanks_data.load(fast=True)
    assert sets.measured
    assert [x[0] for record in (sets.train, sets.test) for x in record] == [0, 2, 1, 3]
    assert len(sets.test.y) == 400


def test_a_download_that_fails_says_so(monkeypatch, tmp_path, capsys):
    def unreachable(data_file_locations):
        raise ConnectionError("no network")

    package(monkeypatch, tmp_path, EMPS=unreachable)
    assert data.found() == []
    assert "nonlinear_benchmarks could not download EMPS: ConnectionError: no network" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "nonlinear_benchmarks", None)  # as where it is not installed
    assert data.found() == []
    assert "pip install -e '.[data]'" in data.HOW_TO_GET_IT
    assert "HHTJAX_DATA" in data.HOW_TO_GET_IT


@pytest.mark.slow
def test_generated_records_are_those_of_their_parameters():
    """Open loop from the recorded voltage alone, the motion under the controller comes out again."""
    train, test = data.generate(1500)
    own = data.GENERATED | {"delay": 0.0}
    assert data.score(own, train)[1] < 0.05
    assert data.score(own, test)[1] > 0.3
    assert data.score(own | {"Fc": data.OTHER_RUN * own["Fc"]}, test)[1] < 0.2
