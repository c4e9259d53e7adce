"""The runner, and Silverbox as a user runs it: on the measured record where there is one, else on a generated one.

The two whole runs of Silverbox are for .ci/run: `-m every`.
"""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from experiments.__main__ import EXPERIMENTS
from experiments.check import check
from experiments.parts import run_experiment
from experiments.smoke import run_beside

ROOT = Path(__file__).parents[1]
SLOW = "--xla_backend_optimization_level=0"
DATA = Path(os.environ.get("HHTJAX_DATA") or ROOT.parent / "shared" / "data")


def experiments(*arguments, **environment):
    """As on a user's machine: with XLA as fast as it comes, for runs of millions of steps, but on one core."""
    inherited = os.environ | {"XLA_FLAGS": os.environ["XLA_FLAGS"].replace(SLOW, "")}
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
    for name in (*EXPERIMENTS, "all", "page", "check"):
        assert any(line.split()[:1] == [name] and len(line) > 30 for line in result.stdout.splitlines())


def test_a_full_run_is_for_those_that_show_a_part_by_default():
    """The list says which."""
    (line,) = (line for line in experiments().stdout.splitlines() if "with --full" in line)
    assert line.split()[0] == "silverbox"
    for arguments in (["vehicle", "--full"], ["silverbox", "--full", "--fast"]):
        result = experiments(*arguments)
        assert result.returncode == 2
        assert "--full" in result.stderr


def test_how_much_is_run_and_what_the_numbers_say_of_it(monkeypatch, tmp_path):
    """Silverbox by default in part, `all` in full, with a page; experiments without --full take two arguments."""
    runner = importlib.import_module("experiments.__main__")
    monkeypatch.setattr(runner, "EXPERIMENTS", {name: EXPERIMENTS[name] for name in ("silverbox", "vehicle")})
    monkeypatch.setattr(runner, "run_alone", runner.main)  # in this process, where the stubs are
    for module in runner.EXPERIMENTS.values():
        stub = SimpleNamespace(run=lambda report, *options: report.numbers({"options": options}))
        monkeypatch.setitem(sys.modules, f"experiments.{module}", stub)

    def told(name, *arguments):
        assert runner.main([*arguments, "--out", str(tmp_path)]) == 0
        numbers = json.loads((tmp_path / f"{name}.json").read_text())
        return numbers["options"], numbers["made_by"]["mode"], numbers["made_by"]["command"].split()[3:]

    assert told("silverbox", "silverbox") == ([False, False], "part", ["silverbox"])
    assert told("silverbox", "silverbox", "--full") == ([False, True], "full", ["silverbox", "--full"])
    assert told("silverbox", "silverbox", "--fast") == ([True, False], "fast", ["silverbox", "--fast"])
    assert told("vehicle", "vehicle") == ([False], "full", ["vehicle"])
    assert told("silverbox", "all") == ([False, True], "full", ["silverbox", "--full"])
    assert "python -m experiments vehicle" in (tmp_path / "experiments.html").read_text(encoding="utf-8")


def test_a_smoke_run_that_fails_says_why_and_leaves_the_process_to_others(monkeypatch, tmp_path, capsys):
    runner = importlib.import_module("experiments.__main__")
    monkeypatch.setattr(runner, "EXPERIMENTS", {name: name for name in ("bad", "good")})
    monkeypatch.setattr(jax, "clear_caches", lambda: None)  # of these tests
    modules = {"bad": lambda report, fast: 1 / 0, "good": lambda report, fast: print("all is well")}
    for name, function in modules.items():
        monkeypatch.setitem(sys.modules, f"experiments.{name}", SimpleNamespace(run=function))
    assert [run_beside([name, "--fast", "--out", str(tmp_path)]) for name in modules] == [1, 0]
    printed = capsys.readouterr()
    assert "ZeroDivisionError" in printed.err
    assert "all is well" in printed.out


def test_a_part_is_made_anew_and_says_so(monkeypatch, tmp_path):
    """The other parts keep their numbers and what made them."""
    runner = importlib.import_module("experiments.__main__")
    first, second = (SimpleNamespace(__name__=f"here.{name}", __doc__=name, __file__=__file__) for name in ("a", "b"))
    module = SimpleNamespace(PARTS=(first, second), run=lambda report, fast: run_experiment(report, module.PARTS, fast))
    monkeypatch.setattr(runner, "EXPERIMENTS", {"stub": "stub"})
    monkeypatch.setitem(sys.modules, "experiments.stub", module)

    def told(value, *arguments):
        first.run = second.run = lambda report, fast: value
        assert runner.main(["stub", *arguments, "--out", str(tmp_path)]) == 0
        return json.loads((tmp_path / "stub.json").read_text())

    whole = told(1)
    assert (whole["a"], whole["b"], whole["made_by"]["command"]) == (1, 1, "python -m experiments stub")
    partly = told(2, "--parts", "b")
    assert (partly["a"], partly["b"]) == (1, 2)
    made_by = {**partly["made_by"]}
    assert made_by.pop("parts")["b"]["command"] == "python -m experiments stub --parts b"
    assert made_by == whole["made_by"]
    again = told(3, "--parts", "a")
    assert (again["a"], again["b"], list(again["made_by"]["parts"])) == (3, 2, ["b", "a"])
    with pytest.raises(SystemExit, match=r"stub has the parts a, b; received 'c'"):
        told(4, "--parts", "c")


@pytest.mark.parametrize("module", EXPERIMENTS.values())
def test_the_parts_of_an_experiment_can_be_told_apart(module):
    parts = getattr(importlib.import_module(f"experiments.{module}"), "PARTS", ())
    assert all(callable(part.run) and part.__doc__ for part in parts)


def test_an_unknown_name_gives_the_list_and_fails():
    result = experiments("silverbocks")
    assert result.returncode == 2
    assert "Unknown experiment 'silverbocks'" in result.stderr
    assert "silverbox" in result.stderr


@pytest.mark.slow
@pytest.mark.every
def test_silverbox_without_the_data_recovers_the_generated_parameters(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HHTJAX_DATA", str(tmp_path / "nowhere"))
    runner = importlib.import_module("experiments.__main__")
    assert runner.main(["silverbox", "--fast", "--out", str(tmp_path)]) == 0
    first = capsys.readouterr().out.splitlines()[0]
    assert first.startswith("GENERATED record, known parameters")
    assert "nonlinearbenchmark.org" in first
    numbers = json.loads((tmp_path / "silverbox.json").read_text())
    assert numbers["data"] == "generated"
    (model,) = numbers["models"].values()
    assert model["k_in_1"] == pytest.approx(1.0, rel=5e-3)
    assert model["c_in_s"] == pytest.approx(2.2e-4, rel=1e-2)
    assert numbers["multisine_mV"] < 0.5
    coarse, fine = numbers["by_step_size"]["rows"]
    assert coarse["train_mV"] > fine["train_mV"] == model["train_mV"]
    assert coarse["k/m bias %"] == pytest.approx(coarse["predicted k %"], rel=0.3)
    assert len(list(tmp_path.glob("*.png"))) == 3
    assert numbers["made_by"]["command"] == "python -m experiments silverbox --fast"
    assert check(EXPERIMENTS, tmp_path) == 2
    assert "silverbox: a smoke run (--fast) has less data" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.every
def test_silverbox_on_the_measured_record(tmp_path, capsys):
    """As README's first command runs it: the best model on the whole record, one figure; the errors that it reaches."""
    if not (DATA / "silverbox").is_dir():
        pytest.skip("the measured Silverbox record is not here: set HHTJAX_DATA to the folder that holds silverbox/")
    result = experiments("silverbox", "--out", str(tmp_path), HHTJAX_DATA=str(DATA))
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("Silverbox, the measured record")
    numbers = json.loads((tmp_path / "silverbox.json").read_text())
    expected = {"train": 0.2237, "arrow_full": 0.2778, "arrow_no_extrapolation": 0.2285, "multisine": 0.2325}
    for name, value in expected.items():
        assert numbers[f"{name}_mV"] == numbers["models"]["10 parameters"][f"{name}_mV"]
        assert numbers[f"{name}_mV"] == pytest.approx(value, abs=5e-4)
    assert [path.name for path in tmp_path.glob("*.png")] == ["silverbox_fit.png"]
    assert check(EXPERIMENTS, tmp_path) == 0
    assert capsys.readouterr().out.startswith("silverbox: 30 numbers compared that it has, 0 worse.")
