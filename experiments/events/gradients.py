"""Derivatives through impacts against formulas, at any step: a ball on a wall, under gravity, and two balls that meet.

The step is data here, so that one program does all of them: all take the same number of steps, of which those behind
the time that is asked for are unused.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.report import COLOURS, MARKERS
from hhtjax.plot import legend, subplots
from hhtjax.scenes import balls

DURATION = 0.75  # s; the ball hits at .45 s, the wall without gravity at .5 s, the two balls at .4 s
LONGEST = 16
STEPS = tuple(range(2, LONGEST + 1))  # 15: impacts on grid points


def after_one_impact(x, g):
    """q and v at the end of a ball of x = (x0, v0, e, wall), by the formula."""
    x0, v0, e, wall = x
    at = (v0 + jnp.sqrt(v0**2 + 2 * g * (x0 - wall))) / g if g else (wall - x0) / v0
    speed, left = v0 - g * at, DURATION - at
    return jnp.stack([wall - e * speed * left - g * left**2 / 2, -e * speed - g * left])


def after_collision(x, _):
    """Of the first of two equal elastic balls, x = (x1, x2, v1, v2): it goes on with the velocity of the other."""
    x1, x2, v1, v2 = x
    at = (x2 - x1 - balls.two().params["diameter"]) / (v1 - v2)
    return jnp.stack([x1 + v1 * at + v2 * (DURATION - at), v2])


def of_ball(x, g):
    """Of x = (x0, v0, e, wall): the scene."""
    scene = balls.bouncing(drag=0.0)
    params = scene.params | {"g": g, "e": x[2], "floor": x[3]}
    return scene._replace(params=params, q0=x[:1], v0=x[1:2])


def of_balls(x, _):
    """Of x = (x1, x2, v1, v2)."""
    scene = balls.two()
    return scene._replace(q0=x[:2], v0=x[2:])


CASES = {  # scene, x, g, and the formula
    "ball, gravity": (of_ball, [1.0, 0.0, 0.9, 0.0], balls.GRAVITY, after_one_impact),
    "ball, no gravity": (of_ball, [1.0, -2.0, 0.9, 0.0], 0.0, after_one_impact),
    "two balls": (of_balls, [0.0, 0.5, 1.0, 0.0], 0.0, after_collision),
}


@partial(jax.jit, static_argnames=("scene_of", "mode"))
def derivative(scene_of, x, g, steps, mode):
    """Of the first body's q and v after so many steps in all of x."""

    def end(x):
        scene = scene_of(x, g)
        run = hhtjax.simulate(
            scene.system, hhtjax.hht(), scene.q0, scene.v0, scene.params, dt=DURATION / steps, num_steps=LONGEST,
            events=scene.events, max_events=3,
        )  # fmt: skip
        return jnp.stack([run.q[steps, 0], run.v[steps, 0]])

    return {"forward": jax.jacfwd, "reverse": jax.jacrev}[mode](end)(x)


def after_the_step(x, steps):
    """The first ball at the end where velocities are changed at the end of the step in which they meet."""
    q, v, h = x[:2], x[2:], DURATION / steps
    for _ in range(steps):
        q = q + h * v
        v = jnp.where((q[1] - q[0] < 0.1) & (v[0] > v[1]), v[::-1], v)
    return q[0]


def run(report, fast):
    """Largest differences from the formulas; the smoke run has the first case, in forward mode."""
    rows, sizes = [], STEPS[::13] if fast else STEPS
    for case, (scene_of, x, g, formula) in list(CASES.items())[: 1 if fast else None]:
        x = jnp.array(x)
        wanted = np.asarray(jax.jacfwd(formula)(x, g))
        for mode in ("forward",) if fast else ("forward", "reverse"):
            found = [np.asarray(derivative(scene_of, x, g, steps, mode)) for steps in sizes]
            differences = [float(np.max(np.abs(x - wanted))) for x in found]
            rows.append({"case": case, "mode": mode, "steps": list(sizes), "difference": differences})
            report.progress(f"{case}, {mode}: {max(differences):.1e}")
    figure(report, rows)
    x = jnp.array(CASES["two balls"][1])
    wanted = jax.jacfwd(after_collision)(x, 0.0)[0]
    after = {str(n): jax.grad(after_the_step)(x, n).tolist() for n in (3, 7, 15)}
    return {"rows": rows, "two_balls": {"formula": wanted.tolist(), "after_the_step_by_steps": after}}


def figure(report, rows):
    """Differences over steps."""
    drawn, axes = subplots(width=110, height=75)
    for i, row in enumerate(rows):
        difference = np.maximum(row["difference"], 1e-17)
        style = {"color": COLOURS[i], "marker": MARKERS[i], "ms": 4, "ls": "none"}
        axes.semilogy(row["steps"], difference, label=f"{row['case']}, {row['mode']}", **style)
    axes.set(xlabel=f"steps in {DURATION} s", ylabel="largest difference from the formula", ylim=(5e-18, 1e-11))
    axes.axhline(1e-12, color="black", lw=0.8)
    legend(axes)
    report.figure("events_gradients", drawn)
