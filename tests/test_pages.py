"""The pages of experiments are made from the committed numbers, and show their figures, which are small."""

import importlib
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LARGEST = {".png": 200_000, ".gif": 400_000}  # bytes


@pytest.mark.parametrize(
    "name",
    [
        "benchmarks",
        "cardona_geradin1989",
        "contact",
        "events",
        "export",
        "flexible",
        "friction",
        "kim2019",
        "reported",
        "robots",
        "stability",
        "sweeps",
        "work_precision",
    ],
)
def test_the_page_is_made_from_the_committed_numbers(name):
    here = ROOT / "experiments" / name
    text = (here / "README.md").read_text()
    page = importlib.import_module(f"experiments.{name}.page")
    assert text == page.page(json.loads((here / f"{name}.json").read_text()))
    for figure in here.iterdir():
        if figure.suffix in LARGEST:
            assert f"({figure.name})" in text
            assert figure.stat().st_size < LARGEST[figure.suffix]
