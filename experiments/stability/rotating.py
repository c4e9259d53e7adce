"""The gallery with rotations: a body spun up by a constant torque, and a top, in chart and in Lie form.

A cell is as good as the worse of the rotation R and of the angular velocity Om, and it is bounded if Om is.
"""

from functools import partial

import jax
import jax.numpy as jnp

from experiments.cells import position
from experiments.linearization.scenes import Case
from experiments.stability.pairs import Study, run_study
from hhtjax import System, conventional_hht, hht
from hhtjax.rotation import cross
from hhtjax.scenes import Scene, top

METHODS = {
    "chart\nconverged": partial(hht, iterations=None),
    "chart\nauto": partial(hht, linearize="auto"),
    "chart\npredictor": partial(hht, linearize="predictor"),
    "chart\nheld": partial(hht, linearize="held"),
    "chart\nstate": partial(hht, linearize="state"),
    "Lie\nconverged": partial(hht, iterations=None, kinematics="lie"),
    "Lie\nauto": partial(hht, linearize="auto", kinematics="lie"),
    "literal\n1989": conventional_hht,
}
CAUSES = {
    "spun up by a constant torque": "Nearly exact in Lie form; in a chart the rate bends where a step turns a radian.",
    "spinning top": "It turns 2.3 rad a step in the first column; the literal step is of order 1 for alpha < 0.",
}


def spun_up() -> Scene:
    """A body of inertia diag(3, 3, 2) kg m^2 that wobbles at 1 rad/s, with 40 N m about its axis of symmetry.

    Om3 = 20 t, exactly, while (Om1, Om2) keeps its length and turns by 10 t^2/3 rad.
    """

    def force(q, v, t, params):
        return params["moment"] - cross(v, params["inertia"] * v)

    params = {"inertia": jnp.array([3.0, 3.0, 2.0]), "moment": jnp.array([0.0, 0.0, 40.0])}
    system = System(lambda q, params: params["inertia"], force)
    return Scene(system, params, jnp.eye(3), jnp.array([1.0, 0.0, 0.0]), 2.0)


def rate(state):
    """Om."""
    return state.v


def rotation_and_rate(state):
    """What is compared."""
    return position(state), state.v


@partial(jax.jit, static_argnames="make")
def final_rate(scene, num_steps, make):
    """Om at the end, with alpha = -0.05."""
    stepper = make(-0.05)
    dt = scene.duration / num_steps
    start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, dt)
    step = partial(stepper.step, scene.system, params=scene.params, dt=dt)
    return jax.lax.fori_loop(0, num_steps, lambda _, s: step(s)[0], start).v


def spin_errors(scene, methods, counts):
    """Relative error of the rate about the axis at the end, which 40 N m/(2 kg m^2) times the duration makes."""
    exact = 20.0 * scene.duration
    return {
        method.replace("\n", " "): [float(abs(final_rate(scene, n, METHODS[method])[2] / exact - 1)) for n in counts]
        for method in methods
    }


def run(report, fast):
    """Grades every cell; how linearly the rate grows."""
    cases = [
        Case("spun up by a constant torque", spun_up(), 16, "", fast=True),
        Case("spinning top", top.minimal(), 32, ""),
    ]
    study = Study(cases, METHODS, "chart\nconverged", "Lie\nauto", 8, rotation_and_rate, rate, CAUSES)
    graded = run_study(report, study, "stability_rotating", fast)
    counts = (16, 64, 256, 1024)
    errors = {} if fast else spin_errors(cases[0].scene, METHODS, counts)
    print("Constant torque: relative error of the rate about its axis at the end\n")
    report.table(["method", *(f"{n} steps" for n in counts)], [[name, *row] for name, row in errors.items()])
    return {
        "scenes": graded,
        "spin_error": {"duration_s": cases[0].scene.duration, "num_steps": counts, "relative": errors},
    }
