"""Nonlinear least-squares problems of More, Garbow and Hillstrom (ACM Trans. Math. Softw. 7, 1981, 17-41), in NumPy.

Each is a function of x that takes complex numbers too: the Jacobian is that of the complex step, exact to rounding.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class Problem(NamedTuple):
    """Residuals of x, where to start, and the sums of squares of its known minima."""

    residuals: Callable
    start: tuple
    minima: tuple


def jacobian(residuals, x):
    """Exact to rounding: the imaginary part of a complex step."""
    steps = 1e-30j * np.eye(x.size)
    return np.stack([residuals(x + step).imag for step in steps], axis=1) / 1e-30


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def freudenstein_roth(x):
    a, b = x
    return np.array([-13 + a + ((5 - b) * b - 2) * b, -29 + a + ((b + 1) * b - 14) * b])


def powell_badly_scaled(x):
    return np.array([1e4 * x[0] * x[1] - 1, np.exp(-x[0]) + np.exp(-x[1]) - 1.0001])


def brown_badly_scaled(x):
    return np.array([x[0] - 1e6, x[1] - 2e-6, x[0] * x[1] - 2])


def beale(x):
    return np.array([1.5, 2.25, 2.625]) - x[0] * (1 - x[1] ** np.arange(1, 4))


def jennrich_sampson(x):
    i = np.arange(1, 11)
    return 2 + 2 * i - (np.exp(i * x[0]) + np.exp(i * x[1]))


def helical_valley(x):
    angle = np.arctan(x[1] / x[0]) / (2 * np.pi) + np.where(x[0].real < 0, 0.5, 0.0)
    return np.array([10 * (x[2] - 10 * angle), 10 * (np.sqrt(x[0] ** 2 + x[1] ** 2) - 1), x[2]])


BARD = np.array([0.14, 0.18, 0.22, 0.25, 0.29, 0.32, 0.35, 0.39, 0.37, 0.58, 0.73, 0.96, 1.34, 2.1, 4.39])


def bard(x):
    u = np.arange(1, 16)
    v = 16 - u
    return BARD - (x[0] + u / (v * x[1] + np.minimum(u, v) * x[2]))


GAUSSIAN = np.array([9, 44, 175, 540, 1295, 2420, 3521, 3989, 3521, 2420, 1295, 540, 175, 44, 9]) / 1e4


def gaussian(x):
    t = (8 - np.arange(1, 16)) / 2
    return x[0] * np.exp(-x[1] * (t - x[2]) ** 2 / 2) - GAUSSIAN


MEYER = np.array(
    [34780, 28610, 23650, 19630, 16370, 13720, 11540, 9744, 8261, 7030, 6005, 5147, 4427, 3820, 3307, 2872], float
)


def meyer(x):
    t = 45 + 5 * np.arange(1, 17)
    return x[0] * np.exp(x[1] / (t + x[2])) - MEYER


def gulf(x):
    t = np.arange(1, 100) / 100
    away = 25 + (-50 * np.log(t)) ** (2 / 3) - x[1]
    return np.exp(-(np.where(away.real < 0, -away, away) ** x[2]) / x[0]) - t


def box(x):
    t = np.arange(1, 11) / 10
    return np.exp(-t * x[0]) - np.exp(-t * x[1]) - x[2] * (np.exp(-t) - np.exp(-10 * t))


def powell_singular(x):
    a, b, c, d = x
    return np.array([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2])


def wood(x):
    a, b, c, d = x
    return np.array(
        [
            10 * (b - a**2),
            1 - a,
            90**0.5 * (d - c**2),
            1 - c,
            10**0.5 * (b + d - 2),
            (b - d) / 10**0.5,
        ]
    )


KOWALIK = np.array([0.1957, 0.1947, 0.1735, 0.16, 0.0844, 0.0627, 0.0456, 0.0342, 0.0323, 0.0235, 0.0246])
DOSE = np.array([4, 2, 1, 0.5, 0.25, 0.167, 0.125, 0.1, 0.0833, 0.0714, 0.0625])


def kowalik_osborne(x):
    return KOWALIK - x[0] * (DOSE**2 + DOSE * x[1]) / (DOSE**2 + DOSE * x[2] + x[3])


def brown_dennis(x):
    t = np.arange(1, 21) / 5
    return (x[0] + t * x[1] - np.exp(t)) ** 2 + (x[2] + x[3] * np.sin(t) - np.cos(t)) ** 2


OSBORNE_1 = np.array(
    [
        0.844,
        0.908,
        0.932,
        0.936,
        0.925,
        0.908,
        0.881,
        0.85,
        0.818,
        0.784,
        0.751,
        0.718,
        0.685,
        0.658,
        0.628,
        0.603,
        0.58,
        0.558,
        0.538,
        0.522,
        0.506,
        0.49,
        0.478,
        0.467,
        0.457,
        0.448,
        0.438,
        0.431,
        0.424,
        0.42,
        0.414,
        0.411,
        0.406,
    ]
)


def osborne_1(x):
    t = 10 * np.arange(33)
    return OSBORNE_1 - (x[0] + x[1] * np.exp(-t * x[3]) + x[2] * np.exp(-t * x[4]))


def biggs_exp6(x):
    t = np.arange(1, 14) / 10
    y = np.exp(-t) - 5 * np.exp(-10 * t) + 3 * np.exp(-4 * t)
    return x[2] * np.exp(-t * x[0]) - x[3] * np.exp(-t * x[1]) + x[5] * np.exp(-t * x[4]) - y


OSBORNE_2 = np.array(
    [
        1.366,
        1.191,
        1.112,
        1.013,
        0.991,
        0.885,
        0.831,
        0.847,
        0.786,
        0.725,
        0.746,
        0.679,
        0.608,
        0.655,
        0.616,
        0.606,
        0.602,
        0.626,
        0.651,
        0.724,
        0.649,
        0.649,
        0.694,
        0.644,
        0.624,
        0.661,
        0.612,
        0.558,
        0.533,
        0.495,
        0.5,
        0.423,
        0.395,
        0.375,
        0.372,
        0.391,
        0.396,
        0.405,
        0.428,
        0.429,
        0.523,
        0.562,
        0.607,
        0.653,
        0.672,
        0.708,
        0.633,
        0.668,
        0.645,
        0.632,
        0.591,
        0.559,
        0.597,
        0.625,
        0.739,
        0.71,
        0.729,
        0.72,
        0.636,
        0.581,
        0.428,
        0.292,
        0.162,
        0.098,
        0.054,
    ]
)


def osborne_2(x):
    t = np.arange(65) / 10
    bumps = sum(x[1 + i] * np.exp(-((t - x[8 + i]) ** 2) * x[5 + i]) for i in range(3))
    return OSBORNE_2 - (x[0] * np.exp(-t * x[4]) + bumps)


def watson(x):
    t, j = np.arange(1, 30)[:, None] / 29, np.arange(x.size)
    slope = np.sum(j[1:] * x[1:] * t ** (j[1:] - 1), axis=1)
    inner = slope - np.sum(x * t**j, axis=1) ** 2 - 1
    return np.concatenate([inner, [x[0], x[1] - x[0] ** 2 - 1]])


def extended_rosenbrock(x):
    return np.concatenate([10 * (x[1::2] - x[::2] ** 2), 1 - x[::2]])


def penalty_1(x):
    return np.concatenate([1e-5**0.5 * (x - 1), [np.sum(x**2) - 0.25]])


def penalty_2(x):
    n, a = x.size, 1e-5**0.5
    i = np.arange(2, n + 1)
    y = np.exp(i / 10) + np.exp((i - 1) / 10)
    rises = a * (np.exp(x[1:] / 10) + np.exp(x[:-1] / 10) - y)
    levels = a * (np.exp(x[1:] / 10) - np.exp(-0.1))
    return np.concatenate([[x[0] - 0.2], rises, levels, [np.sum((n - np.arange(n)) * x**2) - 1]])


def variably_dimensioned(x):
    total = np.sum(np.arange(1, x.size + 1) * (x - 1))
    return np.concatenate([x - 1, [total, total**2]])


def trigonometric(x):
    n = x.size
    return n - np.sum(np.cos(x)) + np.arange(1, n + 1) * (1 - np.cos(x)) - np.sin(x)


def brown_almost_linear(x):
    return np.concatenate([x[:-1] + np.sum(x) - (x.size + 1), [np.prod(x) - 1]])


def discrete_boundary(x):
    h = 1 / (x.size + 1)
    y = np.concatenate([[0], x, [0]])
    t = h * np.arange(1, x.size + 1)
    return 2 * x - y[:-2] - y[2:] + h**2 * (x + t + 1) ** 3 / 2


def discrete_integral(x):
    h = 1 / (x.size + 1)
    t = h * np.arange(1, x.size + 1)
    cube = (x + t + 1) ** 3
    below, above = np.cumsum(t * cube), np.sum((1 - t) * cube) - np.cumsum((1 - t) * cube)
    return x + h * ((1 - t) * below + t * above) / 2


def broyden_tridiagonal(x):
    y = np.concatenate([[0], x, [0]])
    return (3 - 2 * x) * x - y[:-2] - 2 * y[2:] + 1


def broyden_banded(x):
    y = x * (1 + x)
    near = [sum(y[j] for j in range(max(0, i - 5), min(x.size, i + 2)) if j != i) for i in range(x.size)]
    return x * (2 + 5 * x**2) + 1 - np.array(near)


def chebyquad(x):
    y = 2 * x - 1
    T = [np.ones_like(y), y]
    for _ in range(x.size - 1):
        T.append(2 * y * T[-1] - T[-2])
    i = np.arange(1, x.size + 1)
    return np.mean(T[1:], axis=1) + np.where(i % 2, 0, 1 / np.maximum(i**2 - 1.0, 1))


def _equal_distances(n):
    return tuple(np.arange(1, n + 1) / (n + 1))


def _bent(n):
    t = np.arange(1, n + 1) / (n + 1)
    return tuple(t * (t - 1))


PROBLEMS = {
    "Rosenbrock": Problem(rosenbrock, (-1.2, 1), (0,)),
    "Rosenbrock, far": Problem(rosenbrock, (-12, 10), (0,)),
    "Freudenstein, Roth": Problem(freudenstein_roth, (0.5, -2), (0, 48.9842)),
    "Powell, badly scaled": Problem(powell_badly_scaled, (0, 1), (0,)),
    "Brown, badly scaled": Problem(brown_badly_scaled, (1, 1), (0,)),
    "Beale": Problem(beale, (1, 1), (0,)),
    "Jennrich, Sampson": Problem(jennrich_sampson, (0.3, 0.4), (124.362,)),
    "helical valley": Problem(helical_valley, (-1, 0, 0), (0,)),
    "Bard": Problem(bard, (1, 1, 1), (8.21487e-3, 17.4286)),
    "Gaussian": Problem(gaussian, (0.4, 1, 0), (1.12793e-8,)),
    "Meyer": Problem(meyer, (0.02, 4000, 250), (87.9458,)),
    "Gulf": Problem(gulf, (5, 2.5, 0.15), (0,)),
    "Box": Problem(box, (0, 10, 20), (0,)),
    "Powell, singular": Problem(powell_singular, (3, -1, 0, 1), (0,)),
    "Wood": Problem(wood, (-3, -1, -3, -1), (0,)),
    "Kowalik, Osborne": Problem(kowalik_osborne, (0.25, 0.39, 0.415, 0.39), (3.07505e-4, 1.02734e-3)),
    "Brown, Dennis": Problem(brown_dennis, (25, 5, -5, -1), (85822.2,)),
    "Osborne 1": Problem(osborne_1, (0.5, 1.5, -1, 0.01, 0.02), (5.46489e-5,)),
    "Biggs": Problem(biggs_exp6, (1, 2, 1, 1, 1, 1), (0, 5.65565e-3)),
    "Osborne 2": Problem(osborne_2, (1.3, 0.65, 0.65, 0.7, 0.6, 3, 5, 7, 2, 4.5, 5.5), (4.01377e-2,)),
    "Watson, 6": Problem(watson, (0,) * 6, (2.28767e-3,)),
    "Watson, 9": Problem(watson, (0,) * 9, (1.39976e-6,)),
    "Watson, 12": Problem(watson, (0,) * 12, (4.72238e-10,)),
    "extended Rosenbrock": Problem(extended_rosenbrock, (-1.2, 1) * 5, (0,)),
    "penalty 1": Problem(penalty_1, tuple(range(1, 11)), (7.08765e-5,)),
    "penalty 2": Problem(penalty_2, (0.5,) * 10, (2.93660e-4,)),
    "variably dimensioned": Problem(variably_dimensioned, tuple(1 - np.arange(1, 11) / 10), (0,)),
    "trigonometric": Problem(trigonometric, (0.1,) * 10, (0, 2.79506e-5)),
    "Brown, almost linear": Problem(brown_almost_linear, (0.5,) * 10, (0, 1)),
    "discrete boundary": Problem(discrete_boundary, _bent(10), (0,)),
    "discrete integral": Problem(discrete_integral, _bent(10), (0,)),
    "Broyden, tridiagonal": Problem(broyden_tridiagonal, (-1,) * 10, (0,)),
    "Broyden, banded": Problem(broyden_banded, (-1,) * 10, (0,)),
    "Chebyquad, 8": Problem(chebyquad, _equal_distances(8), (3.51687e-3,)),
    "Chebyquad, 10": Problem(chebyquad, _equal_distances(10), (6.50395e-3, 4.77271e-3)),
}
