"""One method over all its step sizes or tolerances: errors, times and work."""

import time

import jax
import numpy as np

from experiments.work_precision.cases import rms_error

LONGEST = 0.3  # s, of a run; nothing finer is tried after one that takes longer, or eight times as long if it is wrong
FINEST = 1e-11  # error, below which nothing finer is tried
REPEATS = 50
PATIENCE = 0.08  # s, for the repeats of a run
LEVELS = 1e-2, 1e-3, 1e-4, 1e-6, 1e-8, 1e-10


def seconds(function, compiles):
    """What it returns, and the least wall time of up to REPEATS calls; after one more, if the first one compiles."""
    if compiles:
        jax.block_until_ready(function())
    times: list = []
    while not times or (len(times) < REPEATS and sum(times) < PATIENCE):
        start = time.perf_counter()
        result = jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return result, min(times)


def enough(time_s, error):
    """Whether to stop refining."""
    if error is None or error > 0.1:
        return time_s > 8 * LONGEST
    return time_s > LONGEST or error < FINEST


def sweep(case, method, package, solve, settings, describe, each_compiles=False, read=lambda found: found):
    """Rows of a method on a case, from coarse to fine.

    solve: setting -> what `read`, whose time does not count, turns into positions at the sample times (None if it
    failed), and factorised matrices, None if not known.
    describe: setting -> its entry in the row. each_compiles: whether every setting has a program of its own, and not
    the first one alone.
    """
    rows = []
    for i, setting in enumerate(settings):
        found, time_s = seconds(lambda setting=setting: solve(setting), compiles=each_compiles or i == 0)
        positions, solves = read(found)
        row = {"case": case, "method": method, "package": package, **describe(setting)}
        error = rms_error(case, positions)
        rows.append(row | {"rms_error": error, "time_s": time_s, "solves": None if solves is None else int(solves)})
        if enough(time_s, error):
            break
    return rows


def lines(rows):
    """The rows of each method on each case as one line, their numbers as lists: for the figures, and short in JSON."""
    numbers = "h_s", "tolerance", "setting", "rms_error", "time_s", "solves"
    found: dict = {}
    for row in rows:
        same = {key: x for key, x in row.items() if key not in numbers}
        line = found.setdefault(tuple(same.values()), {**same, **{key: [] for key in numbers if key in row}})
        for key in numbers:
            if key in row:
                line[key].append(row[key])
    return list(found.values())


def time_to(rows, error):
    """Time at which a method reaches an error: along the line between its runs in a log-log plot; None if it does not.

    Of the runs with the same or a smaller error than all cheaper ones; the first of them counts as it is.
    """
    best: list = []
    for row in sorted((r for r in rows if r["rms_error"]), key=lambda r: r["time_s"]):
        if not best or row["rms_error"] < best[-1]["rms_error"]:
            best.append(row)
    for before, row in zip([None, *best], best, strict=False):
        if row["rms_error"] <= error:
            if before is None:
                return row["time_s"]
            x, y = ([np.log(r[key]) for r in (before, row)] for key in ("rms_error", "time_s"))
            return float(np.exp(np.interp(-np.log(error), -np.array(x), y)))
    return None


def times(rows, levels=LEVELS):
    """[{method, package, time to each level}] of one case."""
    found = []
    for method in dict.fromkeys(r["method"] for r in rows):
        mine = [r for r in rows if r["method"] == method]
        found.append(
            {
                "method": method,
                "package": mine[0]["package"],
                "time_s": {f"{level:g}": time_to(mine, level) for level in levels},
            }
        )
    return found


def show(report, entries, levels=LEVELS):
    """Times in ms."""
    rows = [[e["method"], *("-" if t is None else 1e3 * t for t in e["time_s"].values())] for e in entries]
    report.table(["method", *(f"{level:g}" for level in levels)], rows)
