"""On paper: many workers of one executor, by a queue that is simulated with the times that were measured.

A caller hands out a task each `task_s`. A worker compiles at its first one; tasks take `seconds` each, give or take a
fifth; a worker dies after an exponentially distributed time, is replaced after a minute, and its task is done again.
"""

import heapq
import sys

import numpy as np

from experiments.parts import earlier
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots

WORKERS = 10, 100, 1000
SECONDS = 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0
ROUNDS = 100  # tasks for each worker
COMPILING, LIFE, REPLACED = 5.0, 86_400.0, 60.0  # s; a worker a day dies
SPREAD = 0.2
SOURCE = "workers"  # the part with the measured time of a task


def simulated(workers, seconds, task_s, rng, life=LIFE):
    """The time of all tasks by so many workers, over what their work alone would take; and how many were done again."""
    tasks = ROUNDS * workers
    free = [(0.0, i) for i in range(workers)]  # when a worker can take a task
    compiled, dies = np.zeros(workers, bool), rng.exponential(life, workers)
    handed_out = end = 0.0
    left, again = tasks, 0
    work = 0.0
    while left:
        ready, i = heapq.heappop(free)
        handed_out = max(handed_out + task_s, ready)
        start = handed_out + (0 if compiled[i] else COMPILING)
        takes = seconds * rng.normal(1, SPREAD)
        takes = max(takes, 0.1 * seconds)
        if dies[i] < start + takes:
            again += 1
            compiled[i] = False
            back = max(dies[i], handed_out) + REPLACED
            dies[i] = back + rng.exponential(life)
            heapq.heappush(free, (back, i))
            continue
        compiled[i] = True
        left -= 1
        work += takes
        end = max(end, start + takes)
        heapq.heappush(free, (start + takes, i))
    return end * workers / work, again


def run(report, fast):
    """Shares of the time in which workers work, and a chart."""
    measured = {} if fast else earlier(report, sys.modules[__name__]).get(SOURCE, {})
    rows = measured.get("rows", {})
    task_s = next((x["task_s"] for name, x in rows.items() if name == "Dask, 2"), 1e-3)
    workers, seconds = ((10,), (1.0, 10.0)) if fast else (WORKERS, SECONDS)
    rng = np.random.default_rng(0)
    share = {n: [] for n in workers}
    again = dict.fromkeys(workers, 0)
    for n in workers:
        for each in seconds:
            over, repeated = simulated(n, each, task_s, rng)
            share[n].append(float(1 / over))
            again[n] = max(again[n], repeated)
        report.progress(f"on paper: {n} workers, shares {[round(x, 2) for x in share[n]]}")
    if not fast:
        report.figure("sweeps_on_paper", figure(seconds, share))
    return {
        "task_s": task_s,
        "compiling_s": COMPILING,
        "life_s": LIFE,
        "seconds": list(seconds),
        "share": {str(n): x for n, x in share.items()},
        "done_again": {str(n): x for n, x in again.items()},
        "rounds": ROUNDS,
    }


def figure(seconds, share):
    """A line for each number of workers."""
    drawn, axes = subplots(1, 1, width=110, height=80)
    for (n, shares), colour, marker in zip(share.items(), COLOURS, MARKERS, strict=False):
        axes.semilogx(seconds, shares, color=colour, marker=marker, label=f"{n} workers")
    axes.set(xlabel="work in a task (s)", ylabel="share of time in which workers work", ylim=(0, 1.02))
    legend(axes)
    return drawn
