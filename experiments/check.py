"""Compares the numbers of runs with the committed ones and names each accuracy that got worse.

What a number is, its key says, or the nearest key above it that does: the words below, in this order; below a key that
speaks of time, everything is time. Settings, counts of work, and whatever no word names are left alone. Rows of a list
belong together by their names and settings, not by their place.

| kind | worse if | words |
|---|---|---|
| time, setting | never | time, s per step, compile, bytes, load; h_s, alpha, steps, tolerance |
| error | larger | error, rmse, mV, mrad, deviation, difference, residual, cost, bias, agreement, wrong, failed |
| success | smaller | covered, right, converged, accurate, order, slope, largest bounded step, bitwise equal |
| estimate | elsewhere | standard errors, NAME_in_UNIT, over_truth_with_interval, parameters, ours |
"""

import math
import re
from pathlib import Path
from typing import NamedTuple

from experiments.results import baseline, read

TOLERANCE = 0.05  # relative
ROUNDING = 1e-11  # absolute, of errors: what is below is rounding, which machines and versions do differently
SETTINGS = re.compile(
    "h_s|dt_in_s|alphas?|substeps|N|members|num_steps|steps|steps_per_sample|step_sizes_s|tolerance|setting|unknowns|"
    "duration_s|windows_s|wh|scales|loops|noise|noise_rad|iterations|predicted"
)
SUCCESSES = re.compile("right|converged|covered|accurate %")
# the rest is looked for among the words of a key
TIME = re.compile("times?|seconds?|compile|compilation|compiling|slowest|us|ns|mb|bytes|load|flops|calls")
SUCCESS = re.compile("orders?|slopes?|share|bitwise")
ERROR = re.compile(
    "errors?|rmse|rms|deviation|differences?|residual|violation|cost|mv|mrad|bias|agreement|wrong|blown|failed|minus|"
    "tenth|last|fewest|remainder"
)
ESTIMATE = re.compile("over_truth|parameters|ours_rad|standard_error|_in_[^_]+$")  # k3_in_1/V^2
LARGEST = re.compile("largest_bounded|largest_h_below")


class Worse(NamedTuple):
    """A number that lost accuracy, or that is not there."""

    path: str
    committed: float
    found: float | None
    limit: str

    def __str__(self):
        found = "is missing" if self.found is None else f"{self.found:.6g}"
        return f"{self.path}: {self.committed:.6g} -> {found} (limit {self.limit})"


def is_name(key: str) -> bool:
    """Whether it is a row's label, or the name of a method or a scene: they say nothing about the number."""
    return key.startswith("[") or (" " in key and not key.endswith("%"))


def has(key: str, words: re.Pattern) -> bool:
    """Whether one of its words is among these; names have none."""
    return not is_name(key) and any(words.fullmatch(word) for word in re.split(r"[^a-z]+", key.lower()))


def kind_of_key(key: str) -> str:
    """error, success, estimate, ignored; an empty string where the key does not say.

    >>> [kind_of_key(key) for key in ("train_mV", "order", "k3_in_1/V^2", "fit_time_s", "h_s", "q")]
    ['error', 'success', 'estimate', 'ignored', 'ignored', '']
    """
    if is_name(key):
        return ""
    if SETTINGS.fullmatch(key) or has(key, TIME):
        return "ignored"
    if "standard_error" in key:
        return "estimate"
    if SUCCESSES.fullmatch(key) or LARGEST.search(key) or has(key, SUCCESS):
        return "success"
    if has(key, ERROR):
        return "error"
    return "estimate" if ESTIMATE.search(key) else ""


def kind(path: tuple[str, ...]) -> str:
    """What the number at a path is: the nearest key that says so; otherwise ignored.

    >>> kind(("test_mrad", "0.25 s")), kind(("times", "time_s", "0.001")), kind(("standard_error_over_scatter", "k"))
    ('error', 'ignored', 'estimate')
    """
    kinds = [known for key in reversed(path) if (known := kind_of_key(key))]
    return kinds[0] if kinds and not any(has(key, TIME) for key in path) else "ignored"


def label(row: dict) -> str:
    """What a row of a list is called: its names and settings."""
    own = [
        f"{k}={v}" for k, v in row.items() if isinstance(v, str) or (SETTINGS.fullmatch(k) and not isinstance(v, list))
    ]
    return f"[{', '.join(own)}]"


def flatten(values, path=()) -> dict[tuple[str, ...], float | None]:
    """{path: number} of all numbers; None for those that are not finite. Rows go by label, counted where it repeats."""
    if isinstance(values, dict):
        items = [(str(key), value) for key, value in values.items() if key != "made_by"]
    elif isinstance(values, list):
        names, seen = [], {}
        for i, value in enumerate(values):
            name = label(value) if isinstance(value, dict) else f"[{i}]"
            seen[name] = seen.get(name, 0) + 1
            names.append(name if seen[name] == 1 else f"{name}#{seen[name]}")
        items = list(zip(names, values, strict=True))
    elif values is None or isinstance(values, (int, float)):
        return {path: float(values) if values is not None and math.isfinite(values) else None}
    else:
        return {}
    return {key: x for name, value in items for key, x in flatten(value, (*path, name)).items()}


def worse(path, committed: float, found: float | None) -> Worse | None:
    """How a number got worse, or None. Errors count by their size, estimates by their distance."""
    known = kind(path)
    slack = TOLERANCE * abs(committed)
    if known == "error":
        limit = abs(committed) + slack + ROUNDING
        bad, text = found is None or abs(found) > limit, f"{limit:.6g}"
    elif known == "success":
        limit = committed - slack
        bad, text = found is None or found < limit, f"at least {limit:.6g}"
    else:
        bad, text = found is None or abs(found - committed) > slack, f"+- {slack:.2g}"
    return Worse("/".join(path), committed, found, text) if bad else None


def compare(committed: dict, found: dict, partly: bool = False) -> tuple[int, list[Worse]]:
    """How many numbers were compared, and those that got worse; partly: of a run that leaves some out on purpose.

    >>> committed = {"order": 2.0, "error_m": 1e-3, "time_s": 1.0}
    >>> compare(committed, {"order": 2.0, "error_m": 9e-4, "time_s": 9.0})
    (2, [])
    >>> [str(x) for x in compare(committed, {"order": 1.8})[1]]
    ['order: 2 -> 1.8 (limit at least 1.9)', 'error_m: 0.001 -> is missing (limit 0.00105)']
    """
    numbers = flatten(found)
    known = [(path, x) for path, x in flatten(committed).items() if x is not None and kind(path) != "ignored"]
    if partly:
        known = [(path, x) for path, x in known if path in numbers]
    return len(known), [bad for path, x in known if (bad := worse(path, x, numbers.get(path)))]


def incomparable(committed: dict | None, found: dict) -> str:
    """Why a run cannot be compared, or an empty string."""
    if committed is None:
        return "no committed numbers"
    if found.get("fast") or found.get("made_by", {}).get("mode") == "fast":
        return "a smoke run (--fast) has less data than the committed numbers: not compared"
    if found.get("data") != committed.get("data"):
        return f"{found.get('data')} data, the committed numbers are of {committed.get('data')} data: not compared"
    return ""


def check(experiments: dict[str, str], out: Path) -> int:
    """Compares every JSON in a folder; 0 if nothing got worse, 1 if something did, 2 if nothing could be compared."""
    compared, losses = 0, 0
    for name, module in experiments.items():
        found = read(out / f"{name}.json")
        if found is None:
            continue
        committed = read(baseline(module, name))
        if reason := incomparable(committed, found):
            print(f"{name}: {reason}.")
            continue
        partly = found.get("made_by", {}).get("mode") == "part" or "longest_s" in found  # which leaves out slow runs
        count, bad = compare(committed or {}, found, partly)
        print(f"{name}: {count} numbers compared{' that it has' if partly else ''}, {len(bad)} worse.")
        print(*(f"  {x}" for x in bad), sep="\n", end="\n" if bad else "")
        compared, losses = compared + count, losses + len(bad)
    if not compared:
        print(f"Nothing to compare in {out}: run an experiment first, without --fast.")
        return 2
    print(f"Worse: more than {TOLERANCE:.0%} beyond the committed number." if losses else "No accuracy was lost.")
    return 1 if losses else 0
