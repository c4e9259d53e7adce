"""double_pendulum.c in Python for numba, one trajectory: what stands in for C where there is no compiler."""

import importlib.util
from functools import cache
from math import cos, sin

import numpy as np

from experiments.benchmarks.native import numbers_of


def installed():
    """Whether numba is there."""
    return importlib.util.find_spec("numba") is not None


@cache
def compiled_run():
    """`run` of the C source."""
    import numba  # pyright: ignore[reportMissingImports]  # of an extra of its own

    @numba.njit
    def run(p, h, alpha, steps, y):
        m1, m2, l1, l2, k1, k2, c1, c2, g, r = p
        M11, M22, coupling, G1, G2 = l1 * l1 * (m1 + m2), l2 * l2 * m2, l1 * l2 * m2, l1 * (m1 + m2) * g, l2 * m2 * g
        beta, gamma, f = (1 - alpha) ** 2 / 4, 0.5 - alpha, 1 + alpha
        Kq, Kv = f * h * h * beta, f * h * gamma
        q1, q2, v1, v2, w1, w2, a1, a2 = y
        for _ in range(steps):
            q1 += h * v1 + h * h * ((0.5 - beta) * a1 + beta * w1)
            q2 += h * v2 + h * h * ((0.5 - beta) * a2 + beta * w2)
            v1 += h * ((1 - gamma) * a1 + gamma * w1)
            v2 += h * ((1 - gamma) * a2 + gamma * w2)
            s, M12 = coupling * sin(q1 - q2), coupling * cos(q1 - q2)
            x1, x2 = M12 * v1 * v1, M12 * v2 * v2
            torque = -k2 * (q2 - q1) - c2 * (v2 - v1)
            r1 = M11 * w1 + M12 * w2 + G1 * cos(q1) + s * v2 * v2 + k1 * q1 + c1 * v1 + r * torque
            r2 = M12 * w1 + M22 * w2 + G2 * cos(q2) - s * v1 * v1 - torque
            A11 = M11 + Kq * (-s * w2 - G1 * sin(q1) + x2 + k1 + r * k2) + Kv * (c1 + r * c2)
            A12 = M12 + Kq * (s * w2 - x2 - r * k2) + Kv * (2 * s * v2 - r * c2)
            A21 = M12 + Kq * (-s * w1 - x1 - k2) - Kv * (2 * s * v1 + c2)
            A22 = M22 + Kq * (s * w1 - G2 * sin(q2) + x1 + k2) + Kv * c2
            inverse = -1 / (A11 * A22 - A12 * A21)
            d1, d2 = (A22 * r1 - A12 * r2) * inverse, (A11 * r2 - A21 * r1) * inverse
            q1, q2, v1, v2 = q1 + Kq * d1, q2 + Kq * d2, v1 + Kv * d1, v2 + Kv * d2
            a1, a2 = w1 + f * d1, w2 + f * d2
            w1, w2 = w1 + d1, w2 + d2
        return np.array([q1, q2, v1, v2, w1, w2, a1, a2])

    return run


class Run:
    """Like `native.Run` of one trajectory."""

    def __init__(self, scene, q0, dt, num_steps, alpha):
        q0, v0 = np.asarray(q0, float), np.zeros(2)
        w = np.linalg.solve(scene.system.mass(q0, scene.params), scene.system.force(q0, v0, 0.0, scene.params))
        self.arguments = numbers_of(scene), float(dt), float(alpha), int(num_steps), np.concatenate([q0, v0, w, w])

    def __call__(self):
        return compiled_run()(*self.arguments)
