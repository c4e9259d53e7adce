"""Error against time, beside exudyn and C: the spin-up, 20 s, and the falling beam, 2 s, of 32 elements.

The error is that of the steps alone, RMS over the tip's places each 50 ms, against C with steps of 5e-5 s.
"""

from __future__ import annotations

import importlib.util
import time
from typing import Any

import jax
import numpy as np

import hhtjax
from experiments.benchmarks.measure import least_seconds
from experiments.flexible import figures, models
from experiments.flexible.beam import Beam, pendulum
from experiments.flexible.native_beam import PLAIN, Run, library

DTS, FINE, SAMPLE, ELEMENTS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4), 5e-5, 0.05, 32  # s, s, s
STEPPERS = {
    "hhtjax, one solve": hhtjax.hht(linearize="predictor", start="simple"),
    "hhtjax, Newton": hhtjax.hht(iterations=None, tolerance=1e-6, start="simple"),
}


def rms(tip: Any, exact: Any) -> float:
    """Of the places, m."""
    return float(np.sqrt(np.mean(np.sum((np.asarray(tip)[:, :2] - exact[:, :2]) ** 2, axis=1))))


def ours(described: Beam, stepper: Any, dt: float, duration: float):
    """The tip at the samples, and the least seconds of two runs."""
    model = models.beam(described)
    steps, every, seconds = round(duration / dt), round(SAMPLE / dt), []
    for factor in (1 + 1e-12, 1 - 1e-12, 1.0):
        params = jax.tree.map(lambda x, factor=factor: factor * x, model.params)
        begun = time.perf_counter()
        run = hhtjax.simulate(
            model.system, stepper, model.q0, model.v0, params, dt=dt, num_steps=steps, save_every=every
        )
        tip = np.asarray(run.q["r"][1:, -1])
        seconds.append(time.perf_counter() - begun)
    return tip, min(seconds[1:]), not np.any(np.asarray(run.failure.step))


def points(described: Beam, duration: float, dts: tuple[float, ...], fast: bool) -> list[dict]:
    """A row for each way and step."""
    found = library(PLAIN, "plain_beam")
    if found is None:
        return []
    exact = Run(found, described, FINE, round(duration / FINE)).tip(round(SAMPLE / FINE))
    rows = []
    for way, stepper in list(STEPPERS.items())[: 1 if fast else None]:
        for dt in dts:
            tip, seconds, good = ours(described, stepper, dt, duration)
            rows.append({"way": way, "dt_s": dt, "seconds": seconds, "tip_error_m": rms(tip, exact) if good else None})
    for dt in dts:
        run = Run(found, described, dt, round(duration / dt))
        tip = run.tip(round(SAMPLE / dt))
        rows.append({"way": "C, plain", "dt_s": dt, "seconds": least_seconds({"C": run}, 3)["C"]})
        rows[-1]["tip_error_m"] = rms(tip, exact)
    return rows


def peers(scene: str) -> list[dict]:
    """exudyn's."""
    if not importlib.util.find_spec("exudyn"):
        return []
    from experiments.flexible import by_exudyn

    rows = {"spin-up": by_exudyn.spin_up, "falling beam": by_exudyn.fall}[scene]()
    keep = "dt_s", "seconds", "tip_error_m", "iterations_per_step", "tolerance"
    return [{"way": f"exudyn, {row['newton']} Newton"} | {key: row.get(key) for key in keep} for row in rows]


def run(report: Any, fast: bool) -> dict:
    """Both scenes."""
    found = {}
    elements = 4 if fast else ELEMENTS
    both = [("spin-up", Beam(elements), 0.5 if fast else 20.0), ("falling beam", pendulum(elements), 2.0)]
    for scene, described, duration in both[: 1 if fast else None]:
        found[scene] = points(described, duration, DTS[:1] if fast else DTS, fast) + ([] if fast else peers(scene))
        report.progress(scene)
        report.table(
            [scene, "h (s)", "time (s)", "error (m)"],
            [[row["way"], row["dt_s"], row["seconds"] or 0.0, row["tip_error_m"] or 0.0]
             for row in found[scene] if row.get("seconds")],
        )  # fmt: skip
    figures.accuracy(report, found)
    return found
