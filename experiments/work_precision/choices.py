"""Which method `choose_stepper` takes on each scene, and its true error: for the page, which knows the times."""

import jax
import numpy as np

import hhtjax
from experiments.work_precision.cases import SAMPLES, cases, flat, reference, rms_error

LEVELS = 1e-2, 1e-4, 1e-6, 1e-8
NAMES = {'hht(linearize="predictor")': "hht, adaptive"}  # of the page


def forms(name):
    """{form of a scene: system, q0, v0}."""
    case = cases()[name]
    given = case.scene.system, case.scene.q0, case.scene.v0
    same = case.ode[0] is case.scene.system
    return {"as it is": given} if same else {"constraints, rotations": given, "without": case.ode}


def chosen(name, form, level):
    """The choice for an error, and what it comes to."""
    case, (system, q0, v0) = cases()[name], forms(name)[form]
    exact, params = reference(name), case.scene.params
    motion = float(np.sqrt(np.mean((exact - exact.mean(axis=0)) ** 2)))
    asked = {"duration": case.scene.duration, "tolerance": level / motion, "num_samples": SAMPLES}
    choice = hhtjax.analysis.choose_stepper(system, q0, v0, params, **asked)
    run = hhtjax.simulate(system, choice.stepper, q0, v0, params, dt=choice.dt, times=case.times)
    method = str(choice).partition(", dt=")[0]
    return {
        "case": name,
        "form": form,
        "level": level,
        "method": NAMES.get(method, f"{method.removesuffix('()')}, adaptive"),
        "stiffness": choice.stiffness,
        "rms_error": rms_error(name, jax.vmap(flat)(run.q)[1:, : case.size]),
    }


def run(report, fast):
    """The choices for all scenes."""
    names, levels = (["forced Duffing"], LEVELS[:1]) if fast else (list(cases()), LEVELS)
    found = []
    for name in names:
        found += [chosen(name, form, level) for form in forms(name) for level in levels]
        report.progress(f"choices, {name}")
    rows = [[f"{x['case']}, {x['form']}", x["level"], x["method"], x["rms_error"]] for x in found]
    report.table(["scene", "error", "chosen", "its error"], rows)
    return {"choices": found}
