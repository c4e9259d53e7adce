"""README's Python blocks run, in order, as a reader would paste them; and what it names exists."""

import re
from pathlib import Path

import jax
import pytest

README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.mark.slow
def test_the_code_blocks_run(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len(blocks) == 10
    namespace = {}
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        for block in blocks:
            exec(compile(block, "README.md", "exec"), namespace)
    printed = capsys.readouterr().out
    assert "(501,) (501, 1) (501, 1)" in printed
    assert "converged" in printed
    assert "loop 1: one kernel" in printed
    assert "nan" not in printed


def test_the_two_commands_are_there():
    commands = re.findall(r"```sh\npython3 -m venv (.*?)```", README, flags=re.DOTALL)
    assert len(commands) == 2
    assert commands[0].endswith("-m experiments silverbox\n")
    assert commands[1].endswith("-m pytest\n")
