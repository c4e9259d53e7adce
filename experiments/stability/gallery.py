"""The gallery: each run accurate, bounded, silently wrong or blown up, by scene, step size and numerical damping.

A run is a cell, by the largest distance of q from q0 and the RMS error of q relative to its motion about the mean:

    accurate         error below 5 %
    bounded          error below 100 %
    silently wrong   error above 100 %, yet never ten times as far from q0 as the reference
    blown up         that far, or not finite
"""

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import hhtjax
from experiments.cells import ACCURATE, FARTHEST, geometric_mean, march, relative_error, solve_reference
from experiments.report import side_by_side
from experiments.stability.grades import ALPHAS, GRADES, Outcome, boundary, cells, page, plain
from experiments.stability.scenes import all_cases, held_out

HALVINGS = 10  # step sizes: so many, each half the one before


class Method(NamedTuple):
    """make: of HHT's alpha, or of a rho_inf that damps as much at infinity; damped: whether it depends on alpha."""

    make: Any
    damped: bool = True


def rosenbrock_like(alpha):
    """`rosenbrock` with the spectral radius at infinity of `hht(alpha)`."""
    return hhtjax.rosenbrock((1 + alpha) / (1 - alpha))


METHODS = {
    "HHT\nconverged": Method(partial(hhtjax.hht, iterations=None)),
    "HHT\nauto": Method(partial(hhtjax.hht, linearize="auto")),
    "HHT\npredictor": Method(partial(hhtjax.hht, linearize="predictor")),
    "HHT\nheld": Method(partial(hhtjax.hht, linearize="held")),
    "HHT\nstate": Method(partial(hhtjax.hht, linearize="state")),
    "Kim\n2019": Method(hhtjax.kim_hht),
    "Rosenbrock": Method(rosenbrock_like),
    "Rosenbrock\nL-stable": Method(lambda _: hhtjax.rosenbrock(0.0), damped=False),
    "ROWDA": Method(lambda _: hhtjax.rowda(), damped=False),
    "Wilson\n1.4": Method(lambda _: hhtjax.wilson(1.4), damped=False),
    "Houbolt": Method(lambda _: hhtjax.houbolt(), damped=False),
    "Park": Method(lambda _: hhtjax.park(), damped=False),
    "implicit\nEuler": Method(lambda _: hhtjax.implicit_euler(), damped=False),
    "RK4": Method(lambda _: hhtjax.rk4(), damped=False),
}
REFERENCE = "HHT\nconverged"
FAST = ("HHT\nconverged", "HHT\nauto", "Rosenbrock")  # methods and scenes of the smoke run
FAST_SCENES = ("hardening spring", "negative damping")


@partial(jax.jit, static_argnames="method")
def simulate_all(scene, num_steps, method):
    """`march` for each alpha."""
    make, damped = METHODS[method]

    def simulate_one(alpha):
        stepper = make(alpha)
        start = stepper.init(scene.system, scene.q0, scene.v0, scene.params, scene.duration / num_steps)
        return march(stepper, start, scene, num_steps)

    return jax.vmap(simulate_one)(jnp.array(ALPHAS if damped else ALPHAS[:1]))


def assess(case, sizes, reference, method) -> Outcome:
    """One method on one scene."""
    errors, bounded = [], []
    for num_steps in sizes:
        path, farthest, _ = (np.asarray(x) for x in simulate_all(case.scene, num_steps, method))
        errors.append(relative_error(path, num_steps, reference))
        bounded.append(farthest <= FARTHEST * reference.reach)  # false for NaN
    return Outcome(np.array(errors), np.array(bounded))


def error_ratios(outcome, converged):
    """Error over that of the converged method, where that one is accurate; an error beyond 100 % counts as 100 %."""
    error = np.nan_to_num(outcome.error, nan=1.0).clip(max=1.0)
    return (error / converged.error)[converged.bounded & (converged.error < ACCURATE)]


def summary_rows(outcomes, names):
    """Method, alpha, then accurate, bounded, silently wrong and blown up in % of cells, and the ratio of errors."""
    rows = []
    for method in next(iter(outcomes.values())):
        for i, alpha in enumerate(ALPHAS if METHODS[method].damped else ["-"]):
            here = [Outcome(*(x[:, i] for x in outcomes[name][method])) for name in names]
            j = i if METHODS[method].damped else 1  # a method without alpha is compared with alpha = -0.05
            converged = [Outcome(*(x[:, j] for x in outcomes[name][REFERENCE])) for name in names]
            grades = np.concatenate([x.grade for x in here])
            ratios = np.concatenate([error_ratios(x, y) for x, y in zip(here, converged, strict=True)])
            shares = [round(100 * float(np.mean(grades == grade)), 1) for grade in reversed(range(len(GRADES)))]
            rows.append([plain(method), alpha, *shares, geometric_mean(ratios)])
    return rows


SUMMARY = ("method", "alpha", "accurate %", "bounded %", "wrong %", "blown up %", "ratio")


def boundaries(outcomes, sizes, references):
    """What the tests pin: how far each reference gets, and `boundary` for each method."""
    return {
        scene: {
            "reach": float(f"{references[scene].reach:.4g}"),
            "fewest_steps": {plain(m): boundary(x, sizes[scene]) for m, x in by_method.items()},
        }
        for scene, by_method in outcomes.items()
    }


SLOW = "A Jacobian at the state misses how the stiff direction turns: state, Kim, Rosenbrock, ROWDA."
CONTACT = "Contact begins within the step: at the state it is free flight still, and the push too hard."
CAUSES = {
    "Duffing, driven": "Nothing blows up; only steps of an eighth of a period and more are inaccurate.",
    "double pendulum, free": "Chaotic: steps of 0.3 s and more turn the links over and over, with Newton too.",
    "double pendulum, stiff": "RK4 is unstable: h times the damper's rate is above 2.8 even for the finest step.",
    "double pendulum, as printed": "The same: the missing reaction of the second joint changes nothing here.",
    "chain of four links": "Stiff joints at rest: followed by all but RK4, which must resolve them.",
    "elastic pendulum, k = 1e4": SLOW,
    "elastic pendulum, k = 1e6": SLOW,
    "elastic pendulum, k = 1e8": SLOW,
    "hardening spring": "The predictor overshoots to where the cubic force is huge; held and state stay nearer.",
    "cubic damper": "The predictor's velocity jumps past zero, and the cube drives it on; the state's is right.",
    "quadratic drag": "As above, for held, too. L-stable Rosenbrock, Houbolt, Park and Euler stay bounded.",
    "tanh friction": "Friction saturates and so bounds every method; accuracy needs the onset of sticking resolved.",
    "van der Pol, mu = 1000": "No step resolves the jumps: where a run goes is chance. Houbolt, Park and held last.",
    "Hertz contact": CONTACT,
    "hard stop": CONTACT,
    "dissipative contact": CONTACT,
    "elastic pendulum, ringing": "The spring's 100 rad/s carries energy: accurate only below omega h = 0.1 to 0.4.",
    "sudden stiffness": "Linear: all forms of HHT are one map. Accurate only where the new frequency is resolved.",
    "negative damping": "Linear. Coarse steps lose the phase, or damp by more than the 2 % that the motion grows by.",
    "stick-slip": "Friction bounds every method; the slip is wrong until the step resolves its onset.",
    "started far from its slow manifold": "Kim's start is the literal recursion, which overshoots; others are smooth.",
    "hardening chain": "As the hardening spring: the predictor alone blows up below the coarsest step.",
}


class Results(NamedTuple):
    """By scene: outcomes by method; numbers of steps; the reference."""

    outcomes: dict
    sizes: dict
    references: dict


@cache
def results(report, fast) -> Results:
    """All scenes, methods, alphas and step sizes."""
    found = Results({}, {}, {})
    for case in all_cases():
        if fast and case.name not in FAST_SCENES:
            continue
        steps = [case.fewest * 2**i for i in range(HALVINGS)][:: 2 if fast else 1]
        reference = solve_reference(case)
        methods = FAST if fast else METHODS
        grades = side_by_side([partial(assess, case, steps, reference, method) for method in methods])
        found.outcomes[case.name] = dict(zip(methods, grades, strict=True))
        found.sizes[case.name], found.references[case.name] = steps, reference
        report.progress(case.name)
    return found


def run(report, fast):
    """Grades every cell."""
    outcomes, sizes, references = results(report, fast)
    new = [case.name for case in held_out() if case.name in outcomes]
    tuned, untouched = (summary_rows(outcomes, names) for names in ([x for x in outcomes if x not in new], new))
    for title, rows in ("Scenes on which the default was chosen.\n", tuned), ("Held-out scenes.\n", untouched):
        print(title)
        report.table(SUMMARY, rows)
    scenes = cells(outcomes, sizes)
    figures(report, scenes)
    return {
        "alphas": ALPHAS,
        "tuned_scenes": len(outcomes) - len(new),
        "summary_tuned_on": [dict(zip(SUMMARY, row, strict=True)) for row in tuned],
        "summary_held_out": [dict(zip(SUMMARY, row, strict=True)) for row in untouched],
        "boundaries": boundaries(outcomes, sizes, references),
        "scenes": scenes,
    }


def figures(report, scenes):
    """All cells: of the methods with alpha, with a line on why they fail, and of the others."""
    methods = next(iter(scenes.values()))["grades"]
    with_alpha = [name for name, rows in methods.items() if len(rows) > 1]
    for name, shown, causes in (
        ("stability", with_alpha, CAUSES),
        ("stability_without_alpha", [x for x in methods if x not in with_alpha], {}),
    ):
        if shown:
            some = {key: {"grades": {x: scene["grades"][x] for x in shown}} for key, scene in scenes.items()}
            report.figure(name, page(some, causes))
