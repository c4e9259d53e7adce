"""How-to pages: what they name is there, every message of `check()` is explained, and their code runs."""

import re
import shutil
import subprocess
import sys
import tempfile
from functools import reduce
from pathlib import Path

import jax
import pytest

import hhtjax
from hhtjax.runs import error_control, solution

PAGES = sorted((Path(__file__).parents[1] / "docs" / "howto").glob("*.md"))
RUN = "ground_motion", "driven_joint", "other_optimisers"  # whose blocks are one script, quick enough
TROUBLE = next(page for page in PAGES if page.stem == "troubleshooting").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_is_named_is_there(page):
    text = page.read_text()
    for name in re.findall(r"hhtjax((?:\.[A-Za-z_]\w*)+)", text):
        parts = name[1:].split(".")
        if parts[0] not in ("git", "cluster"):
            assert reduce(lambda x, part: getattr(x, part, None), parts, hhtjax) is not None, name
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        compile(block, page.name, "exec")


def test_every_message_of_check_is_explained():
    messages = [what for what, _ in solution.EVENTS.values()]
    messages += [*error_control.WHY.values(), *solution.CONTACT.values()]
    for words in messages:
        for piece in re.split(r"\{[^}]*\}", words.split(". ")[0]):  # around what is filled in
            assert piece.strip(" ,;") in TROUBLE, words


NUMBER = re.compile(r"-?\d+\.?\d*(?:e[-+]?\d+)?")


def last_place(number):
    """What one unit in the last shown digit is worth."""
    mantissa, _, exponent = number.partition("e")
    return 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))


def assert_shown(shown, printed):
    """The same words, and numbers that differ by a unit in the last place, or by a hundredth, at most.

    What the page leaves out behind a last line "..." may be anything.
    """
    if shown.endswith("...\n"):
        lines = shown.splitlines()[:-1]
        shown, printed = "\n".join(lines), "\n".join(printed.splitlines()[: len(lines)])
    assert NUMBER.sub("#", " ".join(printed.split())) == NUMBER.sub("#", " ".join(shown.split()))
    for told, found in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True):
        assert abs(float(told) - float(found)) <= max(1.01 * last_place(told), 0.01 * abs(float(told))), (told, found)


def test_outputs_that_differ_are_told_apart():
    assert_shown("angle 1.23 [0.5  2.]", "angle 1.24 [0.5 2.]\n")
    assert_shown("angle 1.23\n...\n", "angle 1.24\nlength 5\n")
    for printed in ("angle 1.33 [0.5 2.]", "length 1.23 [0.5 2.]", "angle 1.23 [0.5 2. 3.]"):
        with pytest.raises(AssertionError):
            assert_shown("angle 1.23 [0.5 2.]", printed)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [page for page in PAGES if "\n```\n\n```\n" in page.read_text()], ids=lambda page: page.stem
)
def test_the_code_prints_what_the_page_shows(page, capsys, monkeypatch, tmp_path):
    text = page.read_text()
    if page.stem == "robot":
        pytest.importorskip("mujoco")
    if page.stem == "controller" and shutil.which("cc") is None:
        pytest.skip("there is no C compiler on this machine")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    code = "\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL))
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        exec(compile(code, page.name, "exec"), {"__name__": "__main__"})
    shown = "\n".join(re.findall(r"\n```\n\n```\n(.*?)```", text, flags=re.DOTALL))
    assert_shown(shown, capsys.readouterr().out)


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_the_code_runs(name, tmp_path):
    text = next(page for page in PAGES if page.stem == name).read_text()
    script = tmp_path / "script.py"
    script.write_text("\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)))
    done = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True, timeout=300)
    assert "nan" not in done.stdout
    expected = {"ground_motion": "10.4", "driven_joint": "14.4"}
    expected["other_optimisers"] = "{'c': 0.1, 'k': 4.0}\n" * 4
    assert expected[name] in done.stdout
