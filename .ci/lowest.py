"""Prints pip constraints that pin every dependency to its lower bound in pyproject.toml."""

import re
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
extras = project["optional-dependencies"]
for requirement in [
    *project["dependencies"],
    *extras["plot"],
    *extras["experiments"],
    *extras["interop"],
    *extras["cluster"],
    *extras["test"],
]:
    match = re.fullmatch(r"([a-z-]+)>=([\d.]+)", requirement)
    if match:
        print(f"{match[1]}=={match[2]}")
