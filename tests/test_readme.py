"""README's Python blocks run, in order, as a reader would paste them; what it names and links exists."""

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


def test_it_is_short():
    assert len(README.splitlines()) <= 120


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
