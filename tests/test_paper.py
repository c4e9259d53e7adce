"""The drafts of the papers: numbers are those of the committed experiments, and they keep to what journals ask."""

import re
from pathlib import Path

import pytest

from experiments.__main__ import EXPERIMENTS
from experiments.paper.page import FORMULA, PAPERS, numbers, page

HERE = Path(__file__).parents[1] / "experiments" / "paper"
TEXTS = {paper: (HERE / paper).read_text() for paper in PAPERS}
TEMPLATES = {paper: (HERE / template).read_text() for paper, template in PAPERS.items()}
SHORT, LONG = PAPERS
CLAIMS = "# Claims, each with the command that shows it"
FIELD = r"{\w+\[[^}]*}"  # taken from the JSON, not typed
MEASURED = (
    "5 Stability", "6 Constraints and multipliers", "8 Friction and contact", "9 Differentiation", "10 Benchmarks",
    "11 Identification", "12 Cold times",
)  # fmt: skip


@pytest.fixture(scope="module")
def found():
    return numbers()


def words(text):
    """Those of sentences: without the head, tables and displayed formulas."""
    body = text.split("---\n", 2)[2]
    return re.sub(r"^\|[^\n]*|\$\$.*?\$\$", "", body, flags=re.MULTILINE | re.DOTALL).split()


def section(text, title):
    """What stands under a title."""
    return text.partition(f"\n# {title}\n")[2].partition("\n# ")[0]


@pytest.mark.parametrize("paper", PAPERS)
def test_the_numbers_are_the_committed_ones(paper, found):
    assert page(paper, found) == TEXTS[paper]


def test_each_claim_has_a_command_and_a_number_of_its_own():
    for text in (TEXTS[SHORT], TEMPLATES[SHORT]):
        claims = re.split(r"\n\* ", section(text, CLAIMS.removeprefix("# ")))[1:]
        assert len(claims) == 11
        for claim in claims:
            assert re.match(r"`(\w+)`:", claim)[1] in EXPERIMENTS
            assert text == TEXTS[SHORT] or re.search(FIELD, claim)


@pytest.mark.parametrize("title", MEASURED)
def test_what_was_measured_is_not_typed(title):
    assert re.search(FIELD, FORMULA.sub("", section(TEMPLATES[LONG], title)))


@pytest.mark.parametrize(("paper", "least", "most"), [(SHORT, 750, 1000), (LONG, 3000, 4500)])
def test_it_is_of_the_length_asked_for(paper, least, most):
    assert least < len(words(TEXTS[paper])) < most


def test_the_short_one_is_of_the_form_asked_for():
    _, front, body = TEXTS[SHORT].split("---\n", 2)
    for key in ("title:", "tags:", "authors:", "affiliations:", "date:", "bibliography: paper.bib"):
        assert f"\n{key}" in f"\n{front}"
    for title in ("Summary", "Statement of need", "State of the field", "Software design", "Acknowledgements"):
        assert section(body, title).strip()
    assert body.endswith("\n# References\n")


def test_what_is_cited_is_listed_and_what_is_listed_is_cited():
    listed = re.findall(r"^@\w+{(\w+),", (HERE / "paper.bib").read_text(), flags=re.MULTILINE)
    assert len(set(listed)) == len(listed)
    assert {key for text in TEXTS.values() for key in re.findall(r"@([A-Za-z]+\d{4})", text)} == set(listed)
