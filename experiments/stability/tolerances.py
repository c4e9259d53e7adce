"""Errors over the tolerance on five scenes that nothing was tuned on: other motions than the gallery's. SI units."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from experiments.cells import SAMPLES
from experiments.linearization.scenes import unit_mass
from experiments.report import COLOURS, MARKERS, side_by_side
from hhtjax.plot import subplots
from hhtjax.rotation import cross
from hhtjax.scenes import Scene

RTOLS = tuple(10.0**-n for n in range(2, 9))
ATOL = 1e-3  # over rtol
TIGHTENED = RTOLS[:5]  # below, methods of order 2 take millions of steps
MAX_STEPS = 400_000
LOW, HIGH = 0.02, 10.0  # of errors, over the tolerance
METHODS = {
    "hht": hhtjax.hht(),
    "rosenbrock": hhtjax.rosenbrock(),
    "rowda": hhtjax.rowda(),
    "dopri5": hhtjax.dopri5(),
}


def kepler() -> Scene:
    """One revolution about the sun, of eccentricity 0.5, from the nearest point on."""

    def force(q, v, t, params):
        return -params["mu"] * q / jnp.sum(q**2) ** 1.5

    return unit_mass(force, {"mu": 1.0}, [0.5, 0.0], [0.0, 3**0.5], 2 * np.pi)


def mirror() -> Scene:
    """A charge between two magnetic mirrors: it gyrates, and turns back where the field is strong."""

    def force(q, v, t, params):
        x, y, z = q
        b = params["b"]
        field = jnp.stack([-b * x * z, -b * y * z, 1 + b * z**2])
        return params["charge"] * cross(v, field)

    return unit_mass(force, {"charge": 5.0, "b": 0.5}, [0.2, 0.0, 0.0], [0.0, 1.0, 0.7], 6.0)


def building() -> Scene:
    """Five storeys, damped, on ground that shakes: an acceleration sampled every 20 ms, by cubic splines between."""
    noise = np.random.default_rng(1940).standard_normal(309)
    values = np.sin(np.pi * np.arange(301) / 300) * np.convolve(noise, np.ones(9) / 3, "valid")
    ground = hhtjax.sampled(jnp.asarray(values), dt=0.02)

    def force(q, v, t, params):
        def pull(x):
            stretch = jnp.diff(x, prepend=0.0)
            return jnp.diff(stretch, append=0.0)

        return params["k"] * pull(q) + params["c"] * pull(v) - params["ground"](t)

    return unit_mass(force, {"k": 900.0, "c": 3.0, "ground": ground}, [0.0] * 5, [0.0] * 5, 6.0)


def crane() -> Scene:
    """A trolley that a smooth pulse drives, with drag, and a load that swings below it."""

    def mass(q, params):
        c = params["m"] * params["l"] * jnp.cos(q[1])
        return jnp.array([[params["M"] + params["m"], c], [c, params["m"] * params["l"] ** 2]])

    def force(q, v, t, params):
        m, length = params["m"], params["l"]
        push = params["F"] * jnp.exp(-(((t - 1.5) / 0.5) ** 2))
        swing = m * length * jnp.sin(q[1])
        return jnp.stack([push + swing * v[1] ** 2 - params["c"] * v[0], -9.81 * swing - 0.2 * v[1]])

    params = {"M": 2.0, "m": 1.0, "l": 0.8, "F": 30.0, "c": 1.5}
    return Scene(hhtjax.System(mass, force), params, jnp.array([0.0, 0.3]), jnp.zeros(2), 6.0)


def beads() -> Scene:
    """Four charged beads on a ring of 1 m, by their angles: they repel one another, with drag, and settle."""

    def force(q, v, t, params):
        apart = q[:, None] - q[None, :]
        near = jnp.eye(4)
        chord = 2 * jnp.abs(jnp.sin(apart / 2)) + near
        push = jnp.where(near > 0, 0.0, jnp.cos(apart / 2) * jnp.sign(jnp.sin(apart / 2)) / chord**2)
        return params["charge"] * jnp.sum(push, axis=1) - params["c"] * v

    return unit_mass(force, {"charge": 2.0, "c": 0.8}, [0.0, 0.5, 1.5, 4.0], [0.0] * 4, 5.0)


SCENES = {
    "Kepler, e = 0.5": kepler,
    "magnetic mirror": mirror,
    "building": building,
    "crane": crane,
    "charged beads": beads,
}


def reference(scene):
    """q at the sample times, by DOP853."""
    rhs = hhtjax.interop.scipy_rhs(scene.system, scene.q0, scene.v0, scene.params)
    times = np.linspace(0, scene.duration, SAMPLES + 1)[1:]
    run = solve_ivp(rhs.fun, (0, scene.duration), rhs.y0, "DOP853", times, rtol=1e-13, atol=1e-15)
    return run.y[: scene.q0.size].T


@partial(jax.jit, static_argnames=("method", "verify"))
def controlled(scene, rtol, method, verify=False):
    """A run under error control."""
    system, params, q0, v0, duration = scene
    times = duration * jnp.arange(1, SAMPLES + 1) / SAMPLES
    control = hhtjax.adaptive(rtol, ATOL * rtol, max_steps=MAX_STEPS, verify=verify)
    return hhtjax.simulate(system, METHODS[method], q0, v0, params, dt=control, times=times)


def assess(scene, q, method, rtols):
    """For each tolerance the error over rtol max|q| + atol, None where steps end too early, and the tries of steps.

    tightened: the same with `verify="tighten"`, what is stated of the error, and for which share steps were chosen.
    """
    found: dict = {"error": [], "tries": [], "tightened": []}
    for rtol in rtols:
        run = controlled(scene, rtol, method)
        allowed = rtol * (np.abs(q).max() + ATOL)
        found["error"].append(error_over(allowed, run, q))
        found["tries"].append(int(run.steps.accepted + run.steps.rejected))
        if rtol in TIGHTENED:
            run = controlled(scene, rtol, method, "tighten")
            found["tightened"].append(
                {
                    "error": error_over(allowed, run, q),
                    "stated": float(np.max(run.error) / allowed),
                    "steps": int(run.steps.accepted),
                    "share": float(run.steps.tightened),
                }
            )
    return found


def error_over(allowed, run, q):
    """The largest, None where steps end too early."""
    return None if int(run.steps.stop) else float(np.abs(np.asarray(run.q)[1:] - q).max() / allowed)


def draw(rtols, scenes):
    """Errors against the tolerance, a panel for each scene, with and without `verify`."""
    figure, axes = subplots(1, len(scenes), width=175, height=70, sharey=True, squeeze=False)
    for ax, (name, by_method) in zip(axes[0], scenes.items(), strict=True):
        ax.axhspan(LOW, HIGH, color="0.93", zorder=0)
        ax.axhline(1, color="0.6", linewidth=0.6, zorder=0)
        for (method, found), colour, marker in zip(by_method.items(), COLOURS, MARKERS, strict=False):
            style = {"color": colour, "marker": marker, "markersize": 3}
            errors = [np.nan if e is None else e for e in found["error"]]
            ax.loglog(rtols, errors, "--", markerfacecolor="none", linewidth=0.7, **style)
            tight = [np.nan if x["error"] is None else x["error"] for x in found["tightened"]]
            ax.loglog(rtols[: len(tight)], tight, "-", label=method, **style)
        ax.set_title(name, fontsize="medium")
        ax.set_xlabel("rtol (1)")
    axes[0, 0].set_ylabel("error of q over the tolerance (1)")
    axes[0, 0].plot([], [], "--", color="0.3", label="plain")
    axes[0, 0].plot([], [], "-", color="0.3", label='verify="tighten"')
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=6)
    return figure


def run(report, fast):
    """All scenes."""
    names, methods = (list(x)[:1] if fast else list(x) for x in (SCENES, METHODS))
    rtols, scenes = RTOLS[:3] if fast else RTOLS, {}
    for name in names:
        scene = SCENES[name]()
        q = reference(scene)
        found = side_by_side([partial(assess, scene, q, method, rtols) for method in methods])
        scenes[name] = dict(zip(methods, found, strict=True))
        jax.clear_caches()  # programs of other scenes are of no use
        report.progress(f"tolerances: {name}")
    print("Errors over the tolerance\n")
    rows = [[s, m, *map(str, x["error"])] for s, by in scenes.items() for m, x in by.items()]
    report.table(["scene", "method", *(f"{x:g}" for x in rtols)], rows)
    report.figure("stability_tolerances", draw(rtols, scenes))
    return {"rtol": rtols, "tightened_rtol": TIGHTENED, "scenes": scenes}
