"""Writes before.json: the answers of the version before these problems were mended.

Run with that version of the package (2026-11-27, commit f1b2f32) in the place of this one:
`python -m experiments.reported.before FILE`
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import jax

jax.config.update("jax_enable_x64", True)

from experiments.report import as_json  # noqa: E402
from experiments.reported import reported, starts  # noqa: E402


def main(path):
    """The answers, without what is right."""
    report = SimpleNamespace(progress=lambda text: print(text, file=sys.stderr, flush=True))
    cases = [{"what": row["what"], "found": row["found"]} for row in reported.answers(report)]
    told = {"cases": cases, "starts": starts.errors(report, fast=False), "order": starts.orders(fast=False)}
    json.loads(json.dumps(told))  # as it will be read
    Path(path).write_text(as_json(told) + "\n")


if __name__ == "__main__":
    main(sys.argv[1])
