"""Time to trace and compile: a run of the double pendulum and its gradient, ours and diffrax's Kvaerno3."""

import importlib
import importlib.util
from functools import partial

import jax
import jax.numpy as jnp

import hhtjax
from experiments import diffrax_run
from experiments.benchmarks.measure import compiled, dashed
from hhtjax.scenes import double_pendulum

NUM_STEPS = 1000
DURATION = 1.0


def ours(stepper, k):
    """Sum of squares of the saved angles, as a function of the stiffness."""
    scene = double_pendulum.stiff()
    params = {**scene.params, "k": (k, k)}
    run = hhtjax.simulate(
        scene.system, stepper, scene.q0, scene.v0, params, dt=DURATION / NUM_STEPS, num_steps=NUM_STEPS
    )
    return jnp.sum(run.q**2)


def kvaerno(k):
    """The same by diffrax with step-size control."""
    scene = double_pendulum.stiff()
    saveat = importlib.import_module("diffrax").SaveAt(ts=jnp.linspace(0.0, DURATION, NUM_STEPS + 1))
    params = {**scene.params, "k": (k, k)}
    found = diffrax_run.solve(scene, "Kvaerno3", params, DURATION, saveat=saveat, max_steps=4096)
    return jnp.sum(found.ys[0] ** 2)


def run(report, fast):
    """The least of several compilations in turns, all caches empty each time."""
    losses: dict = {
        "hht, predictor": partial(ours, hhtjax.hht(linearize="predictor")),
        "hht, auto": partial(ours, hhtjax.hht()),
        "hht, converged": partial(ours, hhtjax.hht(iterations=None)),
    }
    missing = [] if importlib.util.find_spec("diffrax") else ["diffrax"]
    if fast:
        losses = dict(list(losses.items())[:1])
    elif missing:
        print("Not installed: diffrax, whose Kvaerno3 would be compiled too.", flush=True)
    else:
        losses["diffrax Kvaerno3"] = kvaerno
    seconds: dict = {}
    for _ in range(1 if fast else 2):
        for name, loss in losses.items():
            for kind, function in (("run", loss), ("gradient", jax.value_and_grad(loss))):
                if fast and kind == "gradient":
                    continue
                _, s = compiled(function, 300.0)
                seconds[name, kind] = min(s, seconds.get((name, kind), s))
    rows = []
    for (name, kind), s in seconds.items():
        peer = seconds.get(("diffrax Kvaerno3", kind))
        rows.append({"method": name, "compiled": kind, "compile_s": s, "over_kvaerno3": s / peer if peer else None})
    report.table(list(rows[0]), [dashed(row.values()) for row in rows])
    return {"not_installed": missing, "num_steps": NUM_STEPS, "rows": rows}
