"""How-to pages: what they name is there, every message of `check()` is explained, and their code runs."""

import re
import subprocess
import sys
from functools import reduce
from pathlib import Path

import pytest

import hhtjax
from hhtjax.runs import error_control, solution

PAGES = sorted((Path(__file__).parents[1] / "docs" / "howto").glob("*.md"))
RUN = "ground_motion", "driven_joint", "design", "other_optimisers"  # whose blocks are one script, quick enough
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


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_the_code_runs(name, tmp_path):
    text = next(page for page in PAGES if page.stem == name).read_text()
    script = tmp_path / "script.py"
    script.write_text("\n".join(re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)))
    done = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True, timeout=300)
    assert "nan" not in done.stdout
    expected = {"ground_motion": "10.4", "driven_joint": "14.4", "design": "after"}
    expected["other_optimisers"] = "{'c': 0.1, 'k': 4.0}\n" * 4
    assert expected[name] in done.stdout
