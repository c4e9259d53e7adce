"""README's Python blocks run, in order, as a reader would paste them; what it names and links exists."""

import json
import re
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
import pytest

import hhtjax

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()


@pytest.mark.slow
def test_the_code_blocks_run(capsys, monkeypatch, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) == 2
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    namespace = {}
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        for block in blocks:
            exec(compile(block, "README.md", "exec"), namespace)
    plt.close("all")
    printed = capsys.readouterr().out
    shown = re.search(r"```\n(converged.*?)\.\.\.\n```", README, flags=re.DOTALL)[1]
    assert shown.splitlines()[1:] == printed.splitlines()[1:4]
    assert "converged" in printed
    assert "resolves the mode" in printed
    assert "nan" not in printed
    result = namespace["result"]
    assert abs(result.params["k"] - 2.0) < 5 * result.standard_errors["k"] < 0.1
    assert (tmp_path / "pendulum.png").stat().st_size > 5000
    q, dt = np.asarray(namespace["runs"].q), np.asarray(namespace["runs"].dt)
    error = abs(q - q[0]).max(axis=(1, 2))[3:-1]
    assert np.allclose(np.diff(np.log(error)) / np.diff(np.log(dt[3:-1])), 2.0, atol=0.1)  # "they fall as dt^2"


def test_the_two_commands_are_there():
    commands = re.findall(r"```sh\npython3 -m venv (.*?)```", README, flags=re.DOTALL)
    assert len(commands) == 2
    assert commands[0].endswith("-m experiments silverbox\n")
    assert commands[1].endswith("-m pytest\n")


def test_the_times_of_other_packages_are_those_of_their_page():
    """Of the best of their methods at 1e-6, to the digits that are printed, and how often ours take theirs."""
    times = json.loads((ROOT / "experiments/work_precision/work_precision.json").read_text())["times"]
    beside = README[README.index("## Beside other packages") : README.index("## Two commands")]

    def least(scene, package, level="1e-06"):
        every = [x["time_s"][level] for x in times[scene] if x["package"] == package]
        return min(t for t in every if t is not None)

    def ours(scene, name, level="1e-06"):
        return next(x["time_s"][level] for x in times[scene] if x["method"] == name)

    stiff = "stiff double pendulum"
    told = re.findall(r"`(rodas5p|hht)`(?: takes|, of order 2,) ([\d.]+) ms", beside)
    assert told == [(name, f"{1e3 * ours(stiff, name):.3g}") for name in ("rodas5p", "hht")]
    rows = re.findall(r"^\| \[(\w+)\].*\(([\d.]+) ms\)", beside, flags=re.MULTILINE)
    rows += re.findall(r"(numbalsoda|CasADi|Drake) ([\d.]+) ms", beside)
    assert len(rows) == 7
    assert rows == [(name, f"{1e3 * least(stiff, name):.3g}") for name, _ in rows]
    squeezer, top = re.search(r"to 1e-6 (\d+) times as fast on a squeezer, (\d+) on a top", beside).groups()
    for scene, ratio in (("squeezer", squeezer), ("top", top)):
        assert ratio == f"{ours(scene, 'hht') / least(scene, 'diffrax'):.0f}"
    lost = []
    for scene, entries in times.items():
        best = min(t for x in entries if x["package"] != "ours" if (t := x["time_s"]["1e-08"]) is not None)
        lost += [ratio] if (ratio := least(scene, "ours", "1e-08") / best) > 1 else []
    few, many, count = re.search(r"to 1e-8 ([\d.]+) to ([\d.]+) times as fast .* on (\d) of 8 scenes", beside).groups()
    assert (few, many, int(count)) == (f"{min(lost):.1f}", f"{max(lost):.1f}", len(lost))


def test_first_calls_are_those_of_their_pages():
    compiled = json.loads((ROOT / "experiments/benchmarks/benchmarks.json").read_text())["compile_time"]["rows"]
    told = re.search(r"([\d.]+) s for `hht`, ([\d.]+) s for diffrax", README).groups()
    runs = {x["method"]: x["compile_s"] for x in compiled if x["compiled"] == "run"}
    assert told == tuple(f"{runs[name]:.2f}" for name in ("hht, auto", "diffrax Kvaerno3"))
    fit = json.loads((ROOT / "experiments/identification/silverbox.json").read_text())["models"]["10 parameters"]
    told = re.search(r"in ([\d.]+) s \(([\d.]+) s\nwith compiling\)", README).groups()
    assert told == (f"{fit['fit_time_s']:.2f}", f"{fit['fit_with_compilation_s']:.1f}")


def test_it_is_short():
    assert len(README.splitlines()) <= 150


def test_what_it_links_to_exists():
    for link in re.findall(r"\]\((?!https?:)([^)#]+)", README):
        assert (ROOT / link).exists(), link


def test_every_function_it_tells_of_exists():
    """Of the table "I want to": the names in its second column."""
    rows = re.findall(r"^\| [a-z].*?\| (.*?) \|", README, flags=re.MULTILINE)
    names = [name for row in rows for name in re.findall(r"`([\w.]+)(?:\(.*?\))?`", row)]
    assert len(names) > 25
    for name in names:
        x = jax if name.startswith("jax.") else hhtjax
        for part in name.removeprefix("jax.").split("."):
            x = getattr(x, part)
