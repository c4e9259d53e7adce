"""The page of all results: one file, well formed, nothing from outside, everything escaped, all figures and numbers."""

import json
import re
from html.parser import HTMLParser

import pytest

from experiments.__main__ import EXPERIMENTS
from experiments.html_report import page
from experiments.html_tables import render
from experiments.results import Result, of_experiments

CAPTION = (  # of its page
    "Silverbox: measured and simulated output of the arrow test with its residual, a detail about the peak, and both "
    "spectra"
)
EMPTY = {"meta", "img", "wbr", "br"}


class Reader(HTMLParser):
    """Checks that tags close in order, and collects attributes and cells."""

    def __init__(self, text):
        super().__init__()
        self.open, self.tags = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def of(self, tag, attribute):
        """The values of an attribute."""
        return [attrs[attribute] for name, attrs in self.tags if name == tag and attribute in attrs]


@pytest.fixture(scope="module")
def committed():
    results = of_experiments(EXPERIMENTS, None)
    text = page(results)
    return results, text, Reader(text)


@pytest.mark.slow
def test_the_page_is_one_well_formed_file(committed):
    _, text, reader = committed
    assert not reader.open
    assert len(text) < 15e6
    assert all(source.startswith("data:image/") for source in reader.of("img", "src"))
    assert all(target.startswith("#") for target in reader.of("a", "href"))
    without_figures = re.sub(r"data:image/[a-z]+;base64,[A-Za-z0-9+/=]+", "", text)
    assert not re.search(r"https?:|@import|url\(|<link|<script ", without_figures)
    assert {target[1:] for target in reader.of("a", "href")} == set(reader.of("section", "id"))


def test_every_committed_figure_and_number_is_there(committed):
    results, _, reader = committed
    assert sum(len(r.figures) for r in results) == len(reader.of("img", "src")) >= 40
    assert {"silverbox", "kim2019", "stability", "work_precision"} <= {r.name for r in results}
    values = set(reader.of("td", "data-v"))
    for r in results:
        if r.name == "silverbox":
            assert r.numbers is not None
            assert {repr(r.numbers[f"{part}_mV"]) for part in ("train", "arrow_full", "multisine")} <= values
            assert repr(r.numbers["models"]["6 parameters"]["k_in_1"]) in values


def test_each_says_where_its_data_are_from_and_what_made_it(committed):
    results, text, _ = committed
    sections = {r.name: text.split(f'<section id="{r.name}">')[1].split("</section>")[0] for r in results}
    for name, word in {"silverbox": "measured data", "stiff_joint": "generated data", "kim2019": "simulations"}.items():
        assert f">{word}</span>" in sections[name]
    assert "python -m experiments silverbox --full" in sections["silverbox"]
    assert "jax 0." in sections["silverbox"]
    assert all("python -m experiments" in section for section in sections.values())


def test_everything_is_escaped_and_a_smoke_run_says_so():
    numbers = {"<b>": "<script>alert(1)</script>", "rows": [{"a&b": '"quoted"', "deep": [[1, "<i>"]]}]}
    part = {"command": "<command> --parts a", "jax": "0.10"}
    numbers["made_by"] = {"command": "<command>", "mode": "fast", "parts": {"a": part, "b": part}}
    text = page([Result("name", "<first>\n\n<second> `code`", numbers, [])])
    assert not Reader(text).open
    for harmful in ("<b>", "<script>alert", "<i>", "<first>", "<second>", "<command>"):
        assert harmful not in text
    assert "<code>code</code>" in text
    assert "smoke run, less data" in text
    assert text.count("--parts a</code> jax 0.10</p>") == 1  # one run


@pytest.mark.parametrize(
    "value",
    [
        {},
        [],
        1.0,
        "word",
        None,
        [1, 2],
        [[1, 2], [3]],
        [{}],
        {"a": {}},
        {"a": {"b": {"c": [{"d": [[1]]}]}}},
        [1, {"a": 2}],
    ],
)
def test_any_shape_of_numbers_is_shown(value):
    assert not Reader(render(value)).open


def test_figures_go_to_the_experiment_with_the_longest_name(tmp_path):
    for name in ("silverbox_fit", "silverbox_comparison_far", "unknown"):
        (tmp_path / f"{name}.png").write_bytes(b"")
    (tmp_path / "vehicle.json").write_text(json.dumps({"records": 1}))
    found = {r.name: [(p.name, caption) for p, caption in r.figures] for r in of_experiments(EXPERIMENTS, tmp_path)}
    assert found == {
        "silverbox": [("silverbox_fit.png", CAPTION)],
        "silverbox_comparison": [("silverbox_comparison_far.png", "far")],
        "vehicle": [],
    }
