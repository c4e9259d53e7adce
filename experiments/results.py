"""Where the results of experiments lie: in the folder of a run, or committed beside the experiments."""

import ast
import json
import re
from pathlib import Path
from typing import Any, NamedTuple

HERE = Path(__file__).parent
RECORDS = {"stiff_joint": "generated", "vehicle": "generated", "squeezer": "generated"}  # records known to their makers


class Result(NamedTuple):
    """What an experiment has shown. numbers: its JSON, None where there is none; figures: (path, caption)."""

    name: str
    text: str
    numbers: dict[str, Any] | None
    figures: list[tuple[Path, str]]

    @property
    def data(self) -> str:
        """measured, benchmark, generated, or an empty string for simulations alone."""
        return (self.numbers or {}).get("data") or RECORDS.get(self.name, "")

    @property
    def mode(self) -> str:
        """full, fast or part; an empty string where that was not recorded."""
        return (self.numbers or {}).get("made_by", {}).get("mode", "")


def baseline(module: str, name: str) -> Path:
    """Where an experiment's committed numbers are."""
    return HERE / module.partition(".")[0] / f"{name}.json"


def read(path: Path) -> dict[str, Any] | None:
    """The numbers in a file, None where there is none."""
    return json.loads(path.read_text()) if path.is_file() else None


def docstring(module: str) -> str:
    """An experiment's own words, without importing it."""
    return ast.get_docstring(ast.parse((HERE / f"{module.replace('.', '/')}.py").read_text())) or ""


def captions(module: str) -> dict[str, str]:
    """{file name: caption} of the figures on the experiment's page."""
    page = HERE / module.partition(".")[0] / "README.md"
    text = page.read_text() if page.is_file() else ""
    return {file: caption for caption, file in re.findall(r"!\[([^]]*)\]\(([^)]+)\)", text)}


def owner(file: str, names) -> str:
    """The experiment whose figure this is: the longest name that it begins with."""
    return max((n for n in names if f"{file}_".startswith(f"{n}_")), key=len, default="")


def of_experiments(experiments: dict[str, str], out: Path | None) -> list[Result]:
    """Results of those that have any, from a run's folder, or, where out is None, as committed."""
    found = []
    for name, module in experiments.items():
        folder = out or baseline(module, name).parent
        known = captions(module)
        files = sorted(p for p in folder.iterdir() if p.suffix in (".png", ".gif")) if folder.is_dir() else []
        figures = [
            (p, known.get(p.name) or p.stem.removeprefix(name).strip("_").replace("_", " ") or name)
            for p in files
            if owner(p.stem, experiments) == name
        ]
        numbers = read(folder / f"{name}.json")
        if numbers is not None or figures:
            found.append(Result(name, docstring(module), numbers, figures))
    return found
