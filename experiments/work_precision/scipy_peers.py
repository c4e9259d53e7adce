"""SciPy's LSODA, Radau, BDF and DOP853, with right-hand sides compiled by JAX, by the C compiler, and in Python."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import hhtjax
from experiments.benchmarks import native
from experiments.work_precision.cases import cases
from experiments.work_precision.timing import sweep

SOLVERS = "LSODA", "Radau", "BDF", "DOP853"
TOLERANCES = tuple(10.0**-n for n in range(3, 14))
Makers = dict[str, Callable[[Any], Callable]]


def by_jax(case):
    """Compiled from the same functions as ours; a call costs some microseconds of JAX's."""
    system, q0, v0 = case.ode
    return hhtjax.interop.scipy_rhs(system, q0, v0, case.scene.params).fun


def by_c(case):
    """The C source's right-hand side, called by ctypes without any checks."""
    found: Any = native.library()
    p, y, dy = native.numbers_of(case.scene), np.zeros(4), np.zeros(4)
    call: Any = found["rate"]  # a second function object, without the argument types of the first
    addresses = [native.ctypes.c_void_p(x.ctypes.data) for x in (p, y, dy)]

    def rate(t, state, _keep=p):
        y[:] = state
        call(*addresses)
        return dy.copy()

    return rate


def by_python(case):
    """What one writes down without a compiler: floats and the module math."""
    m1, m2, l1, l2, k1, k2, c1, c2, g, reaction = native.numbers_of(case.scene).tolist()
    M11, M22, coupling, G1, G2 = l1**2 * (m1 + m2), l2**2 * m2, l1 * l2 * m2, l1 * (m1 + m2) * g, l2 * m2 * g

    def rate(t, y):
        q1, q2, v1, v2 = y.tolist()
        s, M12 = coupling * math.sin(q1 - q2), coupling * math.cos(q1 - q2)
        torque = -k2 * (q2 - q1) - c2 * (v2 - v1)
        Q1 = -G1 * math.cos(q1) - s * v2**2 - k1 * q1 - c1 * v1 - reaction * torque
        Q2 = -G2 * math.cos(q2) + s * v1**2 + torque
        D = M11 * M22 - M12**2
        return [v1, v2, (M22 * Q1 - M12 * Q2) / D, (M11 * Q2 - M12 * Q1) / D]

    return rate


def entries(name, tolerances=TOLERANCES, only=None):
    """Rows of all solvers on a case; with C's right-hand side where there is one, and LSODA with Python's too."""
    case = cases()[name]
    kinds: Makers = {"jitted": by_jax}
    if "double pendulum" in name:
        kinds = {"C": by_c} if native.library() else kinds
        kinds["Python"] = by_python
    rows = []
    for kind, make in kinds.items():
        rate = make(case)
        for solver in SOLVERS[:1] if kind == "Python" else SOLVERS:
            if only is not None and solver not in only:
                continue

            def solve(tolerance, rate=rate, solver=solver):
                span = 0.0, case.scene.duration
                run = solve_ivp(rate, span, case.y0, solver, case.times, rtol=tolerance, atol=1e-2 * tolerance)
                if not run.success:
                    return None, None
                return run.y[: case.size].T, run.nfev + run.nlu

            tried = partial(sweep, name, f"SciPy {solver}, {kind} rhs", "SciPy")
            rows += tried(solve, tolerances, lambda tolerance: {"tolerance": tolerance})
    return rows
