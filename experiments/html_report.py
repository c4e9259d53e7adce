"""One page of all results, in one file: figures inside it, tables that sort, no network.

Its looks and its script are in report.html beside this file.
"""

import base64
import re
import time
from html import escape
from pathlib import Path
from string import Template

import hhtjax
from experiments.html_tables import Markup, breakable, count, folded, render, table
from experiments.results import Result

HERE = Path(__file__).parent
TYPES = {".png": "image/png", ".gif": "image/gif"}
DATA = {
    "measured": "measured data",
    "benchmark": "benchmark, simulated by its makers",
    "generated": "generated data",
    "": "simulations",
}
TOLD = ("made_by", "machine", "data", "fast", "mode")  # above the figures, in words
MODES = {"fast": "smoke run, less data", "part": "a part of it"}


def in_words(text: str) -> str:
    """Escaped, with code between backticks."""
    return re.sub("`([^`]+)`", r"<code>\1</code>", escape(text))


def badges(result: Result) -> str:
    """What kind of data, and whether the run was less than a full one."""
    found = [f'<span class="b {result.data}">{DATA[result.data]}</span>']
    if result.mode in MODES:
        found.append(f'<span class="b warn">{MODES[result.mode]}</span>')
    return " ".join(found)


def made_by(result: Result) -> str:
    """Command, versions and hardware; of the parts that were run later, theirs."""
    numbers = result.numbers or {}
    known = dict(numbers.get("made_by", {}))
    parts = known.pop("parts", {})
    first = {"command": f"python -m experiments {result.name}"} | known
    lines = [words_of(first, numbers.get("machine")), *(words_of(part, None) for part in parts.values())]
    return "".join(dict.fromkeys(lines))


def words_of(known: dict, machine) -> str:
    """One run: its command, and on what; machine: where the run itself has not recorded it."""
    known = {k.replace("_", " "): v for k, v in known.items() if k != "mode" and v not in ("", None)}
    command = known.pop("command")
    machine = known or machine or "versions and hardware were not recorded"
    if isinstance(machine, dict):
        machine = " · ".join(f"{k.replace('_', ' ')} {v}" for k, v in machine.items() if v not in ("", None))
    return f'<p class="m"><code>{escape(command)}</code> {escape(machine)}</p>'


def figure(path: Path, caption: str) -> str:
    """The picture itself, in the page."""
    data = base64.b64encode(path.read_bytes()).decode()
    text = escape(caption)
    image = f'<img loading="lazy" alt="{text}" src="data:{TYPES[path.suffix]};base64,{data}">'
    return f'<figure><button title="larger, smaller">{image}</button><figcaption>{text}</figcaption></figure>'


def section(result: Result) -> str:
    """An experiment: its words, what made it, figures, numbers."""
    first, _, rest = result.text.partition("\n")
    more = "".join(f"<p>{in_words(p)}</p>" for p in rest.strip().split("\n\n") if p.strip())
    numbers = {k: v for k, v in (result.numbers or {}).items() if k not in TOLD}
    return "\n".join(
        [
            f'<section id="{escape(result.name)}"><h2>{escape(result.name)}</h2><p>{badges(result)}</p>',
            f'<p class="lead">{in_words(first)}</p>{more}{made_by(result)}',
            f'<div class="f">{"".join(figure(*f) for f in result.figures)}</div>' if result.figures else "",
            folded(f"Numbers <small>{count(numbers)}</small>", render(numbers), unfold=count(numbers) <= 400)
            if numbers
            else "<p>No numbers here: this experiment has not been run.</p>",
            "</section>",
        ]
    )


def link(name: str) -> Markup:
    """To an experiment's section."""
    return Markup(f'<a href="#{escape(name)}">{breakable(name)}</a>')


def overview(results: list[Result]) -> str:
    """All experiments in a table."""
    rows = [
        [link(r.name), r.text.partition("\n")[0], DATA[r.data], MODES.get(r.mode, "full" if r.mode else "not recorded"),
         len(r.figures), count(r.numbers or {})]
        for r in results
    ]  # fmt: skip
    return table(["experiment", "question", "data", "run", "figures", "numbers"], rows)


def page(results: list[Result]) -> str:
    """The whole file."""
    links = "".join(f"<li>{link(r.name)}</li>" for r in results)
    return Template((HERE / "report.html").read_text(encoding="utf-8")).substitute(
        version=escape(hhtjax.__version__),
        date=time.strftime("%Y-%m-%d", time.gmtime()),
        links=links,
        overview=overview(results),
        sections="\n".join(map(section, results)),
    )
