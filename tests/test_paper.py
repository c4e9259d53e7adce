"""The draft of the paper: its numbers are those of the committed experiments, and it keeps to what the journal asks."""

import re
from pathlib import Path

from experiments.__main__ import EXPERIMENTS
from experiments.paper.page import page

HERE = Path(__file__).parents[1] / "experiments" / "paper"
TEXT, TEMPLATE = (HERE / "paper.md").read_text(), (HERE / "page.md").read_text()
CLAIMS = "# Claims, each with the command that shows it"


def test_the_numbers_are_the_committed_ones():
    assert page() == TEXT


def test_each_claim_has_a_command_and_a_number_of_its_own():
    for text in (TEXT, TEMPLATE):
        claims = re.split(r"\n\* ", text.partition(CLAIMS)[2].partition("\n# ")[0])[1:]
        assert len(claims) == 7
        for claim in claims:
            names = re.findall(r"`(\w+)`", claim)
            assert names
            assert set(names) <= EXPERIMENTS.keys()
            assert text == TEXT or re.search(r"{\w+\[[^}]*}", claim)  # taken from the JSON, not typed


def test_it_is_of_the_length_and_form_asked_for():
    _, front, body = TEXT.split("---\n", 2)
    assert 250 < len(body.split()) < 1000
    for key in ("title:", "tags:", "authors:", "affiliations:", "date:", "bibliography: paper.bib"):
        assert f"\n{key}" in f"\n{front}"
    for title in ("Summary", "Statement of need", "State of the field", "Acknowledgements", "References"):
        assert f"\n# {title}\n" in body


def test_what_is_cited_is_listed_and_what_is_listed_is_cited():
    listed = re.findall(r"^@\w+{(\w+),", (HERE / "paper.bib").read_text(), flags=re.MULTILINE)
    assert len(set(listed)) == len(listed)
    assert set(re.findall(r"@([A-Za-z]+\d{4})", TEXT)) == set(listed)
