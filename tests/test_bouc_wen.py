"""The Bouc-Wen experiment: its committed numbers, the records of the benchmark where they are, and generated ones."""

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.identification import bouc_wen_data as data
from hhtjax.scenes.bouc_wen import BENCHMARK

NUMBERS = json.loads((Path(data.__file__).parent / "bouc_wen.json").read_text())


def test_the_committed_numbers_are_those_of_the_whole_benchmark():
    assert NUMBERS["data"] == "benchmark"
    assert not NUMBERS["fast"]
    assert min(row["multisine_m"] for row in NUMBERS["true_parameters"]) < 3e-7
    assert NUMBERS["multisine_error_m"] < 2e-6
    assert NUMBERS["sinesweep_error_m"] < 5e-6
    assert max(map(abs, NUMBERS["off_by_percent"].values())) < 3


@pytest.mark.slow
def test_the_true_parameters_reproduce_the_multisine():
    if not (data.data_folder() / "bouc_wen").is_dir():
        pytest.skip("the Bouc-Wen records are not here: set HHTJAX_DATA to the folder that holds bouc_wen/")
    record = data.load(fast=True).tests["multisine"]
    _, error = data.score(BENCHMARK, record, data.FINEST)
    assert error == pytest.approx(1.82e-7, rel=0.02)


@pytest.mark.slow
def test_generated_records_have_the_same_shape():
    made = data.generate(128, 200)
    assert {name: len(made[name]) for name in data.STORED} == {
        "train_u": 640, "train_y": 640, "multisine_u": 128, "multisine_y": 128, "sinesweep_u": 200, "sinesweep_y": 200,
    }  # fmt: skip
    record = data.Record(made["multisine_u"], made["multisine_y"], 128)
    output, error = data.score(BENCHMARK, record, data.FINEST)
    assert error < 1e-12
    assert np.std(output) > 1e-4
