"""What all experiments share: progress, tables, figures and JSON, written to one folder."""

import json
import os
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from hhtjax.plot import COLOURS, MARKERS, PARAMETERS, save

__all__ = ["COLOURS", "MARKERS", "Report", "side_by_side"]  # charts of experiments look like those of the library

plt.rcParams.update(PARAMETERS)


def side_by_side(functions):
    """Calls them on all cores and returns their results in order: XLA compiles several programs at a time.

    Not for functions that are timed, or that draw.
    """
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda function: function(), functions))


def as_json(x, indent=0):
    """JSON with lists of numbers, and dicts of few, on one line each."""
    line = json.dumps(x)
    if not isinstance(x, (dict, list)) or not x:
        return line
    leaves = not any(isinstance(y, (dict, list)) for y in (x.values() if isinstance(x, dict) else x))
    if leaves and (isinstance(x, list) or indent + len(line) <= 120):
        return line
    inner, outer = "\n" + (indent + 1) * " ", "\n" + indent * " "
    if isinstance(x, list):
        return f"[{inner}{f',{inner}'.join(as_json(y, indent + 1) for y in x)}{outer}]"
    lines = (f"{json.dumps(key)}: {as_json(y, indent + 1)}" for key, y in x.items())
    return f"{{{inner}{f',{inner}'.join(lines)}{outer}}}"


def reduce_colours(path):
    """A PNG of 256 colours, a third as large: it lies in the repository."""
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        dpi = image.info["dpi"]
    small.save(path, optimize=True, dpi=dpi)


class Report:
    """Collects what an experiment has to show."""

    def __init__(
        self,
        name: str,
        out: Path,
        mode: str = "full",
        command: str = "",
        formats: Sequence[str] = ("png",),
        parts: Sequence[str] = (),
    ):
        """mode: full, fast (a smoke run) or part (less than the experiment has); command: what was typed.

        parts: those that are run, of an experiment in parts; all of them if none is named.
        """
        self.name, self.out, self.formats, self.parts = name, out, formats, parts
        self.mode, self.command = mode, command or f"python -m experiments {name}"
        self.start = time.perf_counter()
        self.written: list[Path] = []
        out.mkdir(parents=True, exist_ok=True)

    def progress(self, text: str):
        """A line on stderr with the time since the start."""
        print(f"[{time.perf_counter() - self.start:6.1f} s] {text}", file=sys.stderr, flush=True)

    def table(self, header, rows):
        """A table on stdout; numbers to four digits."""
        cells = [[x if isinstance(x, str) else f"{x:.4g}" for x in row] for row in rows]
        widths = [max(len(row[i]) for row in [list(header), *cells]) for i in range(len(header))]
        for row in [list(header), ["-" * w for w in widths], *cells]:
            print("  ".join(x.rjust(w) if i else x.ljust(w) for i, (x, w) in enumerate(zip(row, widths, strict=True))))
        print(flush=True)

    def figure(self, name: str, figure):
        """Saves a figure as NAME.png, and in other formats asked for."""
        paths = save(figure, self.out / name, self.formats)
        plt.close(figure)
        for path in paths:
            if path.suffix == ".png":
                reduce_colours(path)
            self.progress(f"figure {path}")
        self.written += paths

    def numbers(self, values: dict, before: dict | None = None):
        """Saves numbers as JSON, named after the experiment, with what they were made by.

        before: the numbers of an earlier run, of which values hold all but the parts that are run now.
        """
        from experiments.provenance import provenance  # imports JAX, whose seconds belong to the run

        made_by = provenance(self.command, self.mode, time.perf_counter() - self.start)
        if before is not None:
            earlier = before.get("made_by", {})
            made_by = earlier | {"parts": earlier.get("parts", {}) | dict.fromkeys(self.parts, made_by)}
        path = self.out / f"{self.name}.json"
        path.write_text(as_json({**values, "made_by": made_by}) + "\n")
        self.written.append(path)

    def close(self):
        """Says where everything is."""
        print("Written:", *(f"  {path}" for path in self.written), sep="\n", flush=True)
