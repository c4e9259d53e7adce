"""Deadlines: the exported step at 1 and 10 kHz beside loops that wait as long, or do nothing; many steps back to back.

A loop that is stopped by others misses deadlines, whatever it does. So of each miss it is asked whether it would have
been one if the loop had woken as the empty one usually does, and had only its own work to do, for as long as the kernel
says it ran. What remains is the step's, unless the loop that waits for as long as the step takes has as much of it: the
kernel does not know of all that interrupts.
"""

import os
import subprocess
import tempfile
from itertools import product
from pathlib import Path

import jax
import numpy as np

from experiments.benchmarks import native
from experiments.export.native_model import compile_loop, exported
from experiments.export.pendulum import STEPPER, scene
from experiments.report import COLOURS
from experiments.sweeps import real_time as in_python
from hhtjax.plot import legend, subplots

TURNS = 10  # of the forms, one after the other
RATES = {"1 kHz": (1_000_000, 20_000), "10 kHz": (100_000, 200_000)}  # period in ns, number of periods
BACK_TO_BACK = 10_000_000
GRANTED = set()
FORMS = "step", "waits as long", "empty loop"
USUALLY, OWN = 0.99, 0.999  # shares of periods: how late a loop wakes at most, and how long a step takes at most


def printed(program, *arguments):
    """(lines, columns), the integers that it prints after the first line: whether it is scheduled in real time."""
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=True)
    first, *lines = np.array([line.split() for line in done.stdout.splitlines()], int)
    if arguments[0] == "paced":
        GRANTED.add(bool(first[0]))
    return np.array(lines)


def build(folder):
    """The program: the double pendulum with its step."""
    own = scene()
    starts = [f"-D{name}={','.join(map(repr, np.asarray(x).tolist()))}" for name, x in
              (("STARTS", own.q0), ("SPEEDS", own.v0))]  # fmt: skip
    return compile_loop(exported(own, STEPPER), folder, "loop", *starts)


def deadlines(program, period, count):
    """{form: (count, 3)}: when it woke and ended after each start of a period, and how long it ran itself, in ns."""
    wait = int(np.median(printed(program, "paced", period, max(count // TURNS, 20), "step")[:, 2]))
    work = dict(zip(FORMS, ("step", wait, 0), strict=True))
    found = {form: [] for form in FORMS}
    for _ in range(TURNS):
        for form in FORMS:
            found[form].append(printed(program, "paced", period, count // TURNS, work[form]))
    return {form: np.concatenate(parts) for form, parts in found.items()}


def explained(found, period):
    """{form: what its misses come from}, of what `deadlines` gives; and how likely the step, were it no other than the
    loop that waits, had as many that nothing explains: 0 if it does not fit into a period that begins as half of them
    do. (Where the empty loop itself often wakes a period late, nothing explains a miss; so all are compared.)
    """
    usual = np.quantile(found["empty loop"][:, 0], USUALLY)
    rows, in_turns = {}, {}
    for form, (woke, ended, own) in ((form, x.T) for form, x in found.items()):
        missed, late, slow = ended > period, woke > period, usual + own > period
        in_turns[form] = (missed & slow).reshape(TURNS, -1).sum(axis=1)
        rows[form] = {
            "missed_count": int(missed.sum()), "woke_too_late_count": int((missed & late & ~slow).sum()),
            "interrupted_count": int((missed & ~late & ~slow).sum()), "not_explained_count": int((missed & slow).sum()),
            "usually_awake_us": float(usual / 1e3), "own_us": float(np.quantile(own, OWN) / 1e3),
        }  # fmt: skip
    fits = np.median(found["empty loop"][:, 0]) + np.quantile(found["step"][:, 2], OWN) <= period
    return rows, chance(in_turns["step"], in_turns["waits as long"]) if fits else 0.0


def chance(counts, others):
    """How likely so many more are, or still more, of two that do not differ: the share of all ways to exchange turns.

    Stops come in bursts, so that periods are not independent; turns are.
    """
    more = np.asarray(counts) - others
    exchanged = np.array(list(product((1, -1), repeat=more.size)))
    return float(np.mean(exchanged @ more >= more.sum()))


def back_to_back(program, count):
    """{form: lengths in ns, how many of each, and the longest}."""
    found = {}
    for form, steps in (("step", 1), ("empty loop", 0)):
        (worst, _), *lengths = printed(program, "turns", count, steps)
        found[form] = np.array(lengths), int(worst)
    return found


def quantile(lengths, share):
    """Of lengths (ns, how many)."""
    total = np.cumsum(lengths[:, 1])
    return int(lengths[np.searchsorted(total, share * total[-1]), 0])


def python_rows(calls):
    """The same step from Python at 1 kHz, and an empty call."""
    step, first, command = in_python.step_of(scene(), 1e-3, STEPPER)
    programs = {
        "Python, step": jax.jit(step).lower(first, command).compile(),
        "Python, empty call": jax.jit(lambda state, command: state + 0).lower(first, command).compile(),
    }
    rows = []
    for form, program in programs.items():
        taken, missed = in_python.paced(program, first, command, calls)
        worst = {f"{key}_us": float(1e6 * np.quantile(taken, x)) for key, x in (("median", 0.5), ("worst", 1.0))}
        rows.append({"rate": "1 kHz", "form": form, "calls": calls, "missed_count": missed} | worst)
    return rows


def run(report, fast):
    """All of it."""
    if native.compiler() is None:
        print("No C compiler: no deadlines.", flush=True)
        return {}
    rows, samples, chances, load = [], {}, {}, os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        for rate, (period, count) in RATES.items():
            count = 200 if fast else count
            found = deadlines(program, period, count)
            causes, chances[rate] = explained(found, period)
            for form, late in found.items():
                samples[rate, form] = late[:, 1] / 1e3
                rows.append(
                    {
                        "rate": rate, "form": form, "calls": count, **causes[form],
                        "median_us": float(np.median(late[:, 1]) / 1e3), "worst_us": float(late[:, 1].max() / 1e3),
                        "longest_step_us": float((late[:, 1] - late[:, 0]).max() / 1e3),
                    }
                )  # fmt: skip
                report.progress(f"{rate}, {form}: {causes[form]} of {count}")
        lengths = back_to_back(program, 100_000 if fast else BACK_TO_BACK)
    steps = [
        {
            "form": form, "calls": int(found[:, 1].sum()), "median_ns": quantile(found, 0.5),
            "p999999_ns": quantile(found, 0.999999), "worst_ns": worst,
            "worst_time_over_median": worst / quantile(found, 0.5),
        }
        for form, (found, worst) in lengths.items()
    ]  # fmt: skip
    rows += python_rows(200 if fast else 10_000)
    header = ["rate, form", "calls", "missed", "median (us)", "worst (us)"]
    keys = "calls", "missed_count", "median_us", "worst_us"
    report.table(header, [[f"{r['rate']}, {r['form']}", *(r[key] for key in keys)] for r in rows])
    report.table(["back to back", *list(steps[0])[1:]], [list(row.values()) for row in steps])
    report.figure("export_real_time", figure(samples, lengths))
    return {
        "deadlines": rows, "chance_of_not_explained": chances, "back_to_back": steps,
        "real_time_scheduling": {True} == GRANTED, "load_at_start": load,
    }  # fmt: skip


def figure(samples, lengths):
    """Shares of periods that ended later, and of steps that took longer."""
    drawn, (left, right) = subplots(1, 2, width=175, height=85)
    for i, ((rate, form), late) in enumerate(samples.items()):
        x = np.sort(late)
        y = 1 - np.arange(x.size) / x.size
        left.loglog(x, y, color=COLOURS[i // 3], ls=("-", "-.", "--")[i % 3], label=f"{rate}, {form}")
    for i, (period, _) in enumerate(RATES.values()):
        left.axvline(period / 1e3, color=COLOURS[i], lw=0.8, ls=":")
    left.set(xlabel="end of the step after its due time (µs)", ylabel="share of periods that ended later")
    legend(left)
    for i, (form, (found, _)) in enumerate(lengths.items()):
        share = 1 - (np.cumsum(found[:, 1]) - found[:, 1]) / found[:, 1].sum()
        right.loglog(found[:, 0], share, color=COLOURS[i], label=form)
    right.set(xlabel="time of one turn (ns)", ylabel="share of turns that took longer")
    legend(right)
    return drawn
