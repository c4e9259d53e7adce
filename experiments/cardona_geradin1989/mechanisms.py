"""Through singular positions: a chain of four-bar loops, with the library's solve and with one of least squares.

The benchmark A02 of Gonzalez et al. (2006), see `hhtjax.scenes.four_bars`: 10 s, in which all bars align again and
again. There the multipliers are not unique, and the loops could fold.
"""

import numpy as np

from hhtjax import hht, simulate
from hhtjax.scenes import four_bars

ALPHA = -0.05
LOOPS = 2
STEP_SIZES = 1e-2, 2e-3  # s
FOLDED = 0.01  # m, between the directions of unit cranks
FORMULATIONS = "index3", "ggl"


SOLVES = {"LU": None, "least squares": "least_squares"}


def energies(scene, q, v):
    """Mechanical energy in J at each time."""
    M = np.asarray(four_bars.mass(scene.q0, scene.params))
    weight = -np.asarray(four_bars.force(scene.q0, scene.v0, 0.0, scene.params))
    v = v.reshape(len(v), -1)
    return np.sum(v @ M * v, axis=1) / 2 + np.sum(weight * q, axis=(1, 2))


def assess(scene, formulation, solve, h):
    """One run."""
    system, params, q0, v0, duration = scene
    stepper = hht(ALPHA, formulation=formulation, redundant=SOLVES[solve])
    path = simulate(system, stepper, q0, v0, params, dt=h, num_steps=round(duration / h))
    path.check()
    q, v = np.asarray(path.q), np.asarray(path.v)
    energy = energies(scene, q, v)
    cranks = q - np.stack([np.arange(LOOPS + 1.0), np.zeros(LOOPS + 1)], axis=1)
    return {
        "formulation": formulation,
        "solve": solve,
        "h_s": h,
        "largest_energy_error_J": float(np.abs(energy - energy[0]).max()),
        "largest_violation_m2": float(path.info.constraint.max()),
        "largest_multiplier_N_m": float(abs(np.asarray(path.multipliers)).max()),
        "folded": bool(np.abs(cranks - cranks[:, :1]).max() > FOLDED),
        "passages": int(np.sum(np.diff(np.sign(q[:, 0, 1])) != 0)),
    }


def run(report, fast):
    """Both formulations and solves, at two step sizes."""
    scene = four_bars.four_bars(LOOPS)
    cases = [(form, solve, h) for form in FORMULATIONS for solve in SOLVES for h in STEP_SIZES]
    entries = [assess(scene, *case) for case in (cases[:1] if fast else cases)]
    print(f"{LOOPS} four-bar loops, {scene.duration:g} s, through singular positions\n")
    header = [
        "formulation",
        "solve",
        "h (s)",
        "energy error (J)",
        "|Phi| (m2)",
        "multiplier (N/m)",
        "folded",
        "passages",
    ]
    report.table(header, [list(e.values()) for e in entries])
    return {"alpha": ALPHA, "loops": LOOPS, "duration_s": scene.duration, "entries": entries}
