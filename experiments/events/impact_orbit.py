"""The periodic orbit of the impact oscillator with one impact in n periods of its drive, by closed forms.

Between impacts w + c v + k q = A cos(W t), m = 1. With d = c/2, w_d = sqrt(k - d^2), T = 2 pi n/W, and t from behind an
impact on, q = exp(-d t) (a cos w_d t + b sin w_d t) + C cos W t - S sin W t. That q is at the wall at 0 and T, with the
velocities -e V and V, is linear in a, b, S and V over a; C^2 + S^2 is the square of the response: a quadratic for a.

The Jacobian of the map from one impact to the next (of a period) is S exp(F T), with the saltation matrix
S = [[-e, 0], [(w+ + e w-)/V, -e]], w before and after the impact, and has

    det = e^2 exp(-2 d T),    tr = exp(-d T) (-2 e cos w_d T + (w+ + e w-)/V sin(w_d T)/w_d)

The period doubles where an eigenvalue is -1: 1 + tr + det = 0. (Shaw, Holmes 1983; Thompson, Ghaffari 1982.)
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar


class Orbit(NamedTuple):
    """speed: V, before the impact; phase: W t at the impact; trace, determinant: of the Jacobian; highest: q - wall."""

    speed: float
    phase: float
    trace: float
    determinant: float
    highest: float

    @property
    def eigenvalues(self):
        """Of the Jacobian."""
        return np.roots([1.0, -self.trace, self.determinant])


def orbits(p, W, n=1):
    """Those with V > 0, of params p, driven at W."""
    d, e, wall, T = p["c"] / 2, p["e"], p["wall"], 2 * np.pi * n / W
    w_d = np.sqrt(p["k"] - d**2)
    E, cos, sin = np.exp(-d * T), np.cos(w_d * T), np.sin(w_d * T)
    r = (1 / E - cos) / sin  # b/a
    start = -d + w_d * r  # rates of the free part at 0 and T, over a
    end = E * (start * cos - (d * r + w_d) * sin)
    V, S = (end - start) / (1 + e), (start + e * (end - start) / (1 + e)) / W
    response = p["A"] ** 2 / ((p["k"] - W**2) ** 2 + (p["c"] * W) ** 2)
    roots = np.roots([1 + S**2, -2 * wall, wall**2 - response])
    return [_orbit(p, W, T, (a.real, r, V, S, w_d)) for a in roots if np.isreal(a) and a.real * V > 0]


def _orbit(p, W, T, numbers):
    a, r, V, S, w_d = numbers
    d, e, wall = p["c"] / 2, p["e"], p["wall"]
    V, S, C = a * V, a * S, wall - a
    drive = (p["k"] - W**2) * C - p["c"] * W * S  # A cos(phase)
    quarter = -p["c"] * W * C - (p["k"] - W**2) * S  # -A sin(phase), the drive a quarter of a period later
    before, after = (drive - p["k"] * wall - p["c"] * v for v in (V, -e * V))
    trace = np.exp(-d * T) * (-2 * e * np.cos(w_d * T) + (after + e * before) / V * np.sin(w_d * T) / w_d)
    t = np.linspace(0, T, 2001)[1:-1]
    q = np.exp(-d * t) * a * (np.cos(w_d * t) + r * np.sin(w_d * t)) + C * np.cos(W * t) - S * np.sin(W * t)
    phase = float(np.arctan2(-quarter, drive)) % (2 * np.pi)
    return Orbit(float(V), phase, float(trace), float(e**2 * np.exp(-2 * d * T)), float(np.max(q) - wall))


def doubling(p, lower, upper, n=1):
    """W between the two where the period of the orbit first doubles: 1 + tr + det = 0."""

    def condition(W):
        (orbit,) = orbits(p, W, n)
        return 1 + orbit.trace + orbit.determinant

    return float(root_scalar(condition, bracket=(lower, upper), xtol=1e-15).root)
