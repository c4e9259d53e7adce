"""Deadlines: the exported step at 1 kHz and 10 kHz beside an empty loop, and the worst of many steps back to back."""

import subprocess
import tempfile
from pathlib import Path

import jax
import numpy as np

from experiments.benchmarks import native
from experiments.export.native_model import compile_loop, exported
from experiments.export.pendulum import STEPPER, scene
from experiments.report import COLOURS
from experiments.sweeps import real_time as in_python
from hhtjax.plot import legend, subplots

TURNS = 10  # step and empty loop in turns
RATES = {"1 kHz": (1_000_000, 20_000), "10 kHz": (100_000, 200_000)}  # period in ns, number of periods
BACK_TO_BACK = 10_000_000
GRANTED = set()
FORMS = {"step": "1", "empty loop": "0"}


def printed(program, *arguments):
    """(lines, 2), the integers that it prints after the first line, which says whether it got real-time scheduling."""
    done = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, check=True)
    first, *lines = np.array(done.stdout.split(), int).reshape(-1, 2)
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
    """{form: (count, 2)}: when it woke and ended after each start of a period, in ns."""
    found = {form: [] for form in FORMS}
    for _ in range(TURNS):
        for form, steps in FORMS.items():
            found[form].append(printed(program, "paced", period, count // TURNS, steps))
    return {form: np.concatenate(parts) for form, parts in found.items()}


def back_to_back(program, count):
    """{form: lengths in ns, how many of each, and the longest}."""
    found = {}
    for form, steps in FORMS.items():
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
    rows, samples = [], {}
    with tempfile.TemporaryDirectory() as folder:
        program = build(Path(folder))
        for rate, (period, count) in RATES.items():
            count = 200 if fast else count
            for form, late in deadlines(program, period, count).items():
                samples[rate, form] = late[:, 1] / 1e3
                rows.append(
                    {
                        "rate": rate, "form": form, "calls": count, "missed_count": int((late[:, 1] > period).sum()),
                        "woke_too_late_count": int((late[:, 0] > period).sum()),
                        "median_us": float(np.median(late[:, 1]) / 1e3), "worst_us": float(late[:, 1].max() / 1e3),
                        "longest_step_us": float((late[:, 1] - late[:, 0]).max() / 1e3),
                    }
                )  # fmt: skip
                report.progress(f"{rate}, {form}: {rows[-1]['missed_count']} of {count} deadlines missed")
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
    return {"deadlines": rows, "back_to_back": steps, "real_time_scheduling": {True} == GRANTED}


def figure(samples, lengths):
    """Shares of periods that ended later, and of steps that took longer."""
    drawn, (left, right) = subplots(1, 2, width=175, height=85)
    for i, ((rate, form), late) in enumerate(samples.items()):
        x = np.sort(late)
        y = 1 - np.arange(x.size) / x.size
        left.loglog(x, y, color=COLOURS[i // 2], ls="-" if form == "step" else "--", label=f"{rate}, {form}")
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
