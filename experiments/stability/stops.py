"""Contacts with the stop as an event: the gallery's three scenes of them, located, and as impacts, beside the force.

located: the same force, with a mode in params that an event switches at the beginning and at the end of a contact,
graded by the motion of the force. impact: an event with a reset, which the stiff force stands for, graded by the motion
of a rigid stop, solved from impact to impact. contact: `hhtjax.Contact` in the place of the force, for `hht`, with one
restitution, that of the first impact; graded as impacts are.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import FARTHEST, SAMPLES, Reference, relative_error, rms, solve_reference
from experiments.events.reference import motion_with_events
from experiments.stability.gallery import HALVINGS, METHODS, assess
from experiments.stability.grades import ALPHAS, BLOWN_UP, GOOD, LETTERS, Outcome, cells, page, plain
from experiments.stability.scenes import all_cases

SHOWN = ("HHT\nauto", "Rosenbrock", "ROWDA")
MAX_EVENTS = 4
CAUSES = {
    "Hertz contact": "A contact of 11 ms has to be resolved, located or not; an impact takes no time.",
    "hard stop": "The same, of 10 ms; beside the impacts only the slow oscillation is left to resolve.",
    "dissipative contact": "The impact has the restitution of Hunt and Crossley's law at its speed.",
}


class Stop(NamedTuple):
    """wall: allowed is q > wall. free: the force without contact; push: of the contact, of its depth, v and params;
    rebound: the speed behind an impact of speed v."""

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


def fall(stop, case):
    """The energy that the way to the stop gives, of 1 kg."""
    ways = np.linspace(stop.wall, case.scene.q0[0], 1001)
    return -np.trapezoid([float(stop.free(q)) for q in ways], ways)


def with_stop(stop, way, case):
    """The system, its params, and its event, if it has one."""

    def force(q, v, t, params):
        depth = jnp.maximum(stop.wall - q, 1e-12)  # behind the mode; the power's derivative is finite
        return stop.free(q) + params["on"] * stop.push(depth, v, params)

    def before(q, v, t, params):
        return (q[0] - stop.wall) * (1 - 2 * params["on"])

    def reset(q, v, t, params):
        return stop.rebound(-v)

    if way == "contact":
        speed = float(np.sqrt(case.scene.v0[0] ** 2 + 2 * fall(stop, case)))
        floor = hhtjax.Contact(
            gap=lambda q, t, params: q[0] - stop.wall, restitution=float(stop.rebound(speed)) / speed
        )
        return hhtjax.System(jnp.ones(1), lambda q, v, t, params: stop.free(q), contact=floor), case.scene.params, None
    located = hhtjax.Event(before, switch=lambda params: params | {"on": 1 - params["on"]})
    event = located if way == "located" else hhtjax.Event(before, reset=reset)
    return hhtjax.System(jnp.ones(1), force), case.scene.params | {"on": 0.0}, event


def rigid_reference(stop, case):
    """The motion with impacts."""
    scene = case.scene
    path, _ = motion_with_events(
        lambda t, y, _: [y[1], stop.free(y[0])],
        lambda t, y, _: [y[0] - stop.wall],
        lambda i, t, y, _: (np.array([stop.wall, float(stop.rebound(-y[1]))]), _),
        [scene.q0[0], scene.v0[0]],
        np.linspace(0, scene.duration, SAMPLES + 1),
        (0.0,),
    )
    q = path[:, :1]
    return Reference(q[1:], rms(q - q.mean(axis=0), (0, 1)), np.abs(q - q[0]).max())


def program(stop, way, method, case, longest):
    """q and the failed step, of alpha and dt: one program for all sizes, whose further steps are unused."""
    system, params, event = with_stop(stop, way, case)

    def run(alpha, dt):
        found = hhtjax.simulate(
            system, METHODS[method].make(alpha), case.scene.q0, case.scene.v0, params, dt=dt, num_steps=longest,
            **({} if event is None else {"events": [event], "max_events": MAX_EVENTS, "keep_events": 1}),
        )  # fmt: skip
        return found.q, found.failure.step

    return jax.jit(run)


def assess_events(case, sizes, reference, method, way):
    """`gallery.assess` with events, and how many runs ended in a failure that is named."""
    march = program(STOPS[case.name], way, method, case, sizes[-1])
    errors, bounded, named = [], [], 0
    alphas = ALPHAS if METHODS[method].damped else ALPHAS[:1]
    for size in sizes:
        every = max(1, size // SAMPLES)
        runs = [march(alpha, case.scene.duration / size) for alpha in alphas]
        paths = np.stack([q[: size + 1] for q, _ in runs])
        named += sum(0 < int(step) <= size for _, step in runs)
        errors.append(relative_error(paths[:, every::every], size, reference))
        bounded.append(np.max(np.abs(paths - paths[:, :1]), axis=(1, 2)) <= FARTHEST * reference.reach)
    return Outcome(np.array(errors), np.array(bounded)), named


def shown(scenes):
    """The page of the methods with alpha: more would not fit."""
    with_alpha = {
        name: {"grades": {m: rows for m, rows in x["grades"].items() if len(rows) > 1}} for name, x in scenes.items()
    }
    return page(with_alpha, CAUSES)


def run(report, fast):
    """All three scenes; the smoke run has one of them, and one method."""
    outcomes, sizes, apart, named = {}, {}, {}, {}
    for case in all_cases():
        if case.name not in (list(STOPS)[:1] if fast else STOPS):
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 3 if fast else 1]
        soft, rigid = solve_reference(case), rigid_reference(STOPS[case.name], case)
        apart[case.name] = float(relative_error(rigid.q, SAMPLES, soft))
        found = {}
        for method in SHOWN[:1] if fast else SHOWN:
            found[method] = assess(case, steps, soft, method)
            ways = {"located": soft, "impact": rigid} | ({"contact": rigid} if method.startswith("HHT") else {})
            for way, reference in ways.items():
                column = f"{method}\n{way}"
                found[column], count = assess_events(case, steps, reference, method, way)
                named.setdefault(case.name, {})[plain(column)] = count
            report.progress(f"stops: {case.name}, {plain(method)}")
        outcomes[case.name], sizes[case.name] = found, steps
    scenes = cells(outcomes, sizes)
    report.figure("stability_stops", shown(scenes))
    letters = {name: {m: "".join(rows) for m, rows in scene["grades"].items()} for name, scene in scenes.items()}
    counts = {"accurate": LETTERS[GOOD], "blown_up": LETTERS[BLOWN_UP]}
    return {
        "rigid_motion_error": apart,
        "cells": {
            name: {m: {key: x.count(letter) for key, letter in counts.items()} | {"all": len(x)} for m, x in by.items()}
            for name, by in letters.items()
        },
        "named_by_check": named,
        "scenes": scenes,
    }
