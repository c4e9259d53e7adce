"""Constraint drift over long runs: of the steps none, of the index-1 ODE without end."""

import jax
import numpy as np

from experiments.cardona_geradin1989.index_1 import unconstrained, violation
from experiments.report import COLOURS, MARKERS
from hhtjax import hht, rk4, simulate
from hhtjax.plot import subplots
from hhtjax.scenes import pendulum, slider_crank

ALPHA = -0.05
WINDOWS = 50
SCENES = {  # scene, step size, number of steps
    "pendulum": (pendulum.cartesian(), 5e-3, 1_000_000),
    "slider-crank": (slider_crank.driven(), 1e-3, 1_000_000),
}
METHODS = {
    "HHT, converged, index 3": hht(ALPHA, formulation="index3", iterations=None),
    "HHT, non-iterative, index 3": hht(ALPHA, formulation="index3"),
    "HHT, non-iterative, GGL": hht(ALPHA),
    "index 1, RK4": rk4(),
}
FAST_METHODS, FAST_STEPS = tuple(METHODS)[2:], 5000


def largest_violations(scene, stepper, h, num_steps):
    """Of Phi and dPhi/dt, (WINDOWS,) each: the largest in each window, or, for an ODE, those at the ends of windows."""
    system, params, q0, v0, _ = scene
    every = num_steps // WINDOWS
    if stepper.solves_constraints:
        info = simulate(system, stepper, q0, v0, params, dt=h, num_steps=num_steps, save_every=every).info
        return [np.asarray(x) for x in (info.constraint, info.constraint_rate)]
    ode = unconstrained(system, q0.size)
    path = simulate(ode, stepper, q0, v0, params, dt=h, num_steps=num_steps, save_every=every)
    both = jax.vmap(lambda q, v, t: violation(system, q, v, t, params))(path.q, path.v, path.t)
    return [np.abs(x).max(axis=1)[1:] for x in both]


def run(report, fast):
    """Largest violations of windows of long runs."""
    scenes = {"pendulum": (*SCENES["pendulum"][:2], FAST_STEPS)} if fast else SCENES
    entries = []
    for scene_name, (scene, h, num_steps) in scenes.items():
        for method in FAST_METHODS if fast else METHODS:
            position, rate = largest_violations(scene, METHODS[method], h, num_steps)
            first, last = slice(0, WINDOWS // 10), slice(-WINDOWS // 10, None)
            entries.append(
                {
                    "scene": scene_name,
                    "method": method,
                    "h_s": h,
                    "num_steps": num_steps,
                    "position_first_tenth": float(position[first].max()),
                    "position_last_tenth": float(position[last].max()),
                    "rate_first_tenth": float(rate[first].max()),
                    "rate_last_tenth": float(rate[last].max()),
                    "position": [float(f"{x:.3g}") for x in position],
                    "rate": [float(f"{x:.3g}") for x in rate],
                }
            )
            report.progress(f"drift: {scene_name}, {method}")
    print("Largest |Phi| and |dPhi/dt| in the first and the last tenth of a long run\n")
    keys = [f"{x}_{y}_tenth" for x in ("position", "rate") for y in ("first", "last")]
    rows = [[f"{e['scene']}, {e['method']}", e["num_steps"], *(e[key] for key in keys)] for e in entries]
    report.table(["scene, method", "steps", "Phi, first", "last", "dPhi/dt, first", "last"], rows)
    if not fast:
        report.figure("cardona_geradin1989_drift", figure(entries))
    return {"alpha": ALPHA, "entries": entries}


def figure(entries):
    """Largest violations by window."""
    drawn, panels = subplots(2, len(SCENES), width=175, height=120, sharex=True)
    units = {"pendulum": "m$^2$", "slider-crank": "m"}
    for column, scene in zip(panels.T, SCENES, strict=True):
        for i, e in enumerate(e for e in entries if e["scene"] == scene):
            steps = e["num_steps"] / WINDOWS * np.arange(1, WINDOWS + 1)
            style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "lw": 1, "markevery": 7, "label": e["method"]}
            for axes, key in zip(column, ("position", "rate"), strict=True):
                axes.semilogy(steps, e[key], **style)
        column[0].set(title=f"{scene}, h = {1e3 * SCENES[scene][1]:g} ms", ylabel=f"max |$\\Phi$| ({units[scene]})")
        column[1].set(xlabel="number of steps", ylabel=f"max |d$\\Phi$/dt| ({units[scene]}/s)")
    drawn.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return drawn
