"""Contacts with the stop as an event: the gallery's three scenes of them, located, and as impacts, beside the force.

located: the same force with a mode in params that an event switches at the beginning and the end of a contact. impact:
an event with a reset in the place of the force. All columns are graded by the motion of the force.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import FARTHEST, SAMPLES, relative_error, solve_reference
from experiments.stability.dry import fewest_accurate
from experiments.stability.gallery import HALVINGS, METHODS, assess
from experiments.stability.grades import ALPHAS, Outcome, cells, page, plain
from experiments.stability.scenes import all_cases

SHOWN = ("HHT\nauto", "Rosenbrock", "ROWDA")
WAYS = ("located", "impact")
MAX_EVENTS = 4
CAUSES = {
    "Hertz contact": "A contact takes 11 ms. Located, it still has to be resolved; an impact has no time of contact.",
    "hard stop": "A contact takes 10 ms, and gives back all energy.",
    "dissipative contact": "The impact has the restitution of the law of Hunt and Crossley at its own speed.",
}


class Stop(NamedTuple):
    """wall: allowed is q > wall. free: the force without contact; push: of the contact, of its depth and v; rebound: the
    speed behind an impact of speed v."""

    wall: float
    free: Any
    push: Any
    rebound: Any


def hunt_crossley(speed):
    """The speed after a contact with k x^1.5 (1 + c x'), where v + log(1 - c v)/c is what it was, by Newton."""
    c = 0.2
    kept = speed - jnp.log(1 + c * speed) / c

    def improve(_, v):
        return v - (-v - jnp.log(1 - c * v) / c - kept) * (1 - c * v) / (c * v)

    return jax.lax.fori_loop(0, 8, improve, jnp.minimum(speed, 0.9 / c))


STOPS = {
    "Hertz contact": Stop(0.0, lambda q: 0 * q - 9.81, lambda x, v, p: p["k"] * x**1.5, lambda v: v),
    "hard stop": Stop(-0.5, lambda q: -10.0 * q, lambda x, v, p: p["k"] * x, lambda v: v),
    "dissipative contact": Stop(
        0.0, lambda q: 0 * q - 9.81, lambda x, v, p: p["k"] * x**1.5 * (1.0 - p["c"] * v), hunt_crossley
    ),
}


def with_stop(stop, way, case):
    """The system, its params, and its event."""

    def force(q, v, t, params):
        depth = jnp.maximum(stop.wall - q, 1e-12)  # behind the mode; the power's derivative is finite
        return stop.free(q) + params["on"] * stop.push(depth, v, params)

    def before(q, v, t, params):
        return (q[0] - stop.wall) * (1 - 2 * params["on"])

    def reset(q, v, t, params):
        return stop.rebound(-v)

    located = hhtjax.Event(before, switch=lambda params: params | {"on": 1 - params["on"]})
    event = located if way == "located" else hhtjax.Event(before, reset=reset)
    return hhtjax.System(jnp.ones(1), force), case.scene.params | {"on": 0.0}, event


def program(stop, way, method, case, longest):
    """q, of alpha and dt: one program for all sizes, whose further steps are unused."""
    system, params, event = with_stop(stop, way, case)

    def run(alpha, dt):
        return hhtjax.simulate(
            system, METHODS[method].make(alpha), case.scene.q0, case.scene.v0, params, dt=dt, num_steps=longest,
            events=[event], max_events=MAX_EVENTS, keep_events=1,
        ).q  # fmt: skip

    return jax.jit(run)


def assess_events(case, sizes, reference, method, way):
    """`gallery.assess` with events."""
    march = program(STOPS[case.name], way, method, case, sizes[-1])
    errors, bounded = [], []
    for size in sizes:
        every = max(1, size // SAMPLES)
        paths = [np.asarray(march(a, case.scene.duration / size)) for a in ALPHAS[: 3 if METHODS[method].damped else 1]]
        paths = np.stack(paths)[:, : size + 1]
        errors.append(relative_error(paths[:, every::every], size, reference))
        bounded.append(np.max(np.abs(paths - paths[:, :1]), axis=(1, 2)) <= FARTHEST * reference.reach)
    return Outcome(np.array(errors), np.array(bounded))


def run(report, fast):
    """All three scenes; the smoke run has one of them, and one method."""
    outcomes, sizes = {}, {}
    for case in all_cases():
        if case.name not in (list(STOPS)[:1] if fast else STOPS):
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 3 if fast else 1]
        reference = solve_reference(case)
        found = {}
        for method in SHOWN[:1] if fast else SHOWN:
            found[method] = assess(case, steps, reference, method)
            for way in WAYS:
                found[f"{method}\n{way}"] = assess_events(case, steps, reference, method, way)
            report.progress(f"stops: {case.name}, {plain(method)}")
        outcomes[case.name], sizes[case.name] = found, steps
    scenes = cells(outcomes, sizes)
    report.figure("stability_stops", page(scenes, CAUSES))
    accurate = {
        name: {method: sum(row.count("A") for row in rows) for method, rows in scene["grades"].items()}
        for name, scene in scenes.items()
    }
    return {
        "accurate_cells": accurate,
        "fewest_accurate_steps": {name: fewest_accurate(scene) for name, scene in scenes.items()},
        "scenes": scenes,
    }
