"""A fit through 1000 unknowns: bending stiffness and damping of a beam, from a noisy record of its tip.

The record is generated: a clamped beam of 400 elements falls under its weight, with steps of 1 ms. It is fitted with
334 elements and steps of 5 ms. A gradient in the stiffness of each element goes through the same run backwards.
"""

from __future__ import annotations

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.flexible import figures, models
from experiments.flexible.beam import Beam

TRUTH = {"EI": 1.4e4, "damping": 8e-3}  # N m^2, s
START = {"EI": 1.0e4, "damping": 2e-3}
DURATION, SAMPLE, DT, NOISE = 4.0, 0.02, 5e-3, 5e-3  # s, s, s, m
STEPPER = hhtjax.hht(linearize="predictor", start="simple")


def tip(model: models.Model, params: dict, dt: float) -> Any:
    """Its height at the samples, m."""
    every, steps = round(SAMPLE / dt), round(DURATION / dt)
    run = hhtjax.simulate(
        model.system, STEPPER, model.q0, model.v0, model.params | params, dt=dt, num_steps=steps, save_every=every
    )
    return run.q["r"][1:, -1, 1]


def hung(elements: int) -> models.Model:
    """The clamped beam, with damping."""
    return models.beam(Beam(elements, gravity=9.81, hub="clamped"), damping=True)


def ellipse(fit: Any, level: float = 5.991) -> np.ndarray:
    """The border of the region of 95 %, (2, points)."""
    C = np.asarray(fit.covariance)
    angle = np.linspace(0, 2 * np.pi, 100)
    centre = np.array([float(fit.params["EI"]), float(fit.params["damping"])])
    return centre[:, None] + np.sqrt(level) * np.linalg.cholesky(C) @ np.stack([np.cos(angle), np.sin(angle)])


def run(report: Any, fast: bool) -> dict:
    """The record, the fit and the gradient."""
    model, finer = (hung(4), hung(6)) if fast else (hung(334), hung(400))
    rng = np.random.default_rng(0)
    exact = np.asarray(tip(finer, TRUTH, 5e-3 if fast else 1e-3))
    record = exact + NOISE * rng.normal(size=exact.shape)
    begun = time.perf_counter()
    fit = hhtjax.fit(
        lambda params: (tip(model, params, DT) - record) / NOISE,
        START,
        transforms={"EI": hhtjax.positive, "damping": hhtjax.positive},
    )
    seconds = time.perf_counter() - begun
    errors = {name: float(x) for name, x in fit.standard_errors.items()}
    found: dict = {"unknowns": model.unknowns, "num_steps": round(DURATION / DT), "seconds": seconds}
    found |= {"iterations": int(fit.iterations), "noise_m": NOISE}
    for name, unit in (("EI", "N m^2"), ("damping", "s")):
        estimate, error = float(fit.params[name]), errors[name]
        off = (estimate - TRUTH[name]) / error
        found[name] = {"unit": unit, "truth": TRUTH[name], "start": START[name], "fitted": estimate}
        found[name] |= {"standard_error": error, "off_in_standard_errors": off}
        report.progress(f"{name}: {estimate:.5g} +- {1.96 * error:.2g} {unit}, true {TRUTH[name]:.5g}")
    if fast:
        return found
    slope, took = by_element(model, fit.params)
    found["gradient"] = {"parameters": slope.size, "sum_m": float(slope.sum()), "seconds": took}
    along = jax.jvp(lambda EI: tip(model, {**fit.params, "EI": EI}, DT)[-1], (fit.params["EI"],), (fit.params["EI"],))[
        1
    ]
    found["gradient"]["sum_less_forward_over_it"] = abs(float(slope.sum() / along) - 1)
    drawn = {
        "t_s": SAMPLE * np.arange(1, len(record) + 1),
        "record_m": record,
        "fitted_m": np.asarray(tip(model, fit.params, DT)),
        "start_m": np.asarray(tip(model, START, DT)),
        "ellipse": ellipse(fit),
        "fit": [float(fit.params[name]) for name in TRUTH],
        "truth": list(TRUTH.values()),
        "places_m": (np.arange(slope.size) + 0.5) * 10.0 / slope.size,
        "gradient": 1e3 * slope,
    }
    figures.material(report, drawn)
    return found


def by_element(model: models.Model, params: dict) -> tuple[np.ndarray, float]:
    """d (last height)/d ln EI of each element, m, by one run backwards, and the seconds that it took."""
    number = (model.unknowns) // 3
    last = jax.jit(jax.grad(lambda EI, factor: tip(model, {**params, "EI": EI * factor}, DT)[-1]))
    EI = jnp.full(number, params["EI"])
    jax.block_until_ready(last(EI, 1.001))
    begun = time.perf_counter()
    slope = np.asarray(EI * last(EI, 1.0))
    return slope, time.perf_counter() - begun
