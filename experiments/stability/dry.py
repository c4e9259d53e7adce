"""Dry friction: the gallery's two scenes of it with their tanh, beside the set-valued law, by the exact dry motion.

The law that tanh stands for, F sign(s) with any force up to F at s = 0, is solved from one switch to the next, and all
columns are graded by that motion. The set-valued step is `hht(alpha)` on `System(..., friction=F)`: one solve a step,
linearised at the predictor, as always with friction.
"""

from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from experiments.cells import SAMPLES, Reference, relative_error, rms, solve_reference
from experiments.dry_motion import dry_motion
from experiments.report import side_by_side
from experiments.stability.gallery import HALVINGS, METHODS, assess
from experiments.stability.grades import ALPHAS, GOOD, LETTERS, cells, page, plain
from experiments.stability.scenes import all_cases
from hhtjax import System

SET_VALUED, STEPPER = "set-valued", "HHT\nauto"
CAUSES = {
    "tanh friction": "The set-valued step resolves each switch inside it; the others must resolve the slope of tanh.",
    "stick-slip": "As above; and tanh creeps where the law sticks, an error that smaller steps do not take away.",
}


class Dry(NamedTuple):
    """force, limit, sliding: without tanh, as a System takes them; the same for `dry_motion`: load, limit_at, belt."""

    force: Any
    limit: Any
    sliding: Any
    load: Any
    limit_at: Any
    belt: float


def driven_force(q, v, t, params):
    """Of "tanh friction"."""
    return 40.0 * jnp.cos(6.0 * t) - 100.0 * q


def driven_limit(q, v, t, params):
    """F, constant."""
    return params["limit"] + 0 * q


def spring(q, v, t, params):
    """Of "stick-slip"."""
    return -params["k"] * q


def belt_sliding(q, v, t, params):
    """Past a belt of 1 m/s."""
    return v - 1.0


def belt_limit(q, v, t, params):
    """F, 10 N at rest, falling to 5 N."""
    return 5.0 + 5.0 * jnp.exp(-((1.0 - v) ** 2))


LAWS = {
    "tanh friction": Dry(
        driven_force, driven_limit, None, lambda t, y: 40 * np.cos(6 * t) - 100 * y[0], lambda s: 20.0, 0.0
    ),
    "stick-slip": Dry(
        spring, belt_limit, belt_sliding, lambda t, y: -100 * y[0], lambda s: 5 + 5 * np.exp(-(s**2)), 1.0
    ),
}


def dry_case(case):
    """The same scene with the law itself."""
    law, mass = LAWS[case.name], case.scene.system.mass
    system = System(mass, law.force, friction=law.limit, sliding=law.sliding)
    return case._replace(scene=case.scene._replace(system=system))


def dry_reference(case):
    """The exact motion of the law, and how often it switches."""
    law, scene = LAWS[case.name], case.scene
    start = np.array([scene.q0[0], scene.v0[0]])
    times = np.linspace(0, scene.duration, SAMPLES + 1)
    path, switches = dry_motion(law.load, law.limit_at, start, times, belt=law.belt)
    q = path[:, None]
    return Reference(q[1:], rms(q - q.mean(axis=0), (0, 1)), np.abs(q - q[0]).max()), len(switches)


def fewest_accurate(scene):
    """{method: steps from which on every run is accurate, None if the finest is not}, with alpha = -0.05 or none.

    scene: an entry of `cells`.
    """
    found = {}
    for method, rows in scene["grades"].items():
        row = rows[ALPHAS.index(-0.05) if len(rows) > 1 else 0]
        found[method] = dict(enumerate(scene["num_steps"])).get(len(row.rstrip(LETTERS[GOOD])))
    return found


def run(report, fast):
    """Both scenes; the smoke run has one method with tanh."""
    methods = [STEPPER] if fast else list(METHODS)
    outcomes, sizes, facts = {}, {}, {}
    for case in all_cases():
        if case.name not in LAWS:
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 2 if fast else 1]
        reference, switches = dry_reference(case)
        grades = side_by_side([partial(assess, case, steps, reference, method) for method in methods])
        set_valued = assess(dry_case(case), steps, reference, STEPPER)
        outcomes[case.name] = {SET_VALUED: set_valued} | dict(zip(methods, grades, strict=True))
        sizes[case.name] = steps
        smooth = relative_error(solve_reference(case).q, SAMPLES, reference)
        facts[case.name] = {"switches": switches, "tanh_motion_error": float(smooth)}
        report.progress(f"dry: {case.name}")
    scenes = cells(outcomes, sizes)
    shown = [plain(m) for m in (SET_VALUED, *methods) if m == SET_VALUED or METHODS[m].damped]
    some = {name: {"grades": {m: scene["grades"][m] for m in shown}} for name, scene in scenes.items()}
    report.figure("stability_dry", page(some, CAUSES))
    return {
        "motions": facts,
        "fewest_accurate_steps": {name: fewest_accurate(scene) for name, scene in scenes.items()},
        "scenes": scenes,
    }
