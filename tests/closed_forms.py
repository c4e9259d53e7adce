"""Amplification factors of the methods on a linear oscillator, by closed forms that share no code with the library."""

from functools import partial

import numpy as np
from zoo import as_data

import hhtjax


def refined_roots(polynomial):
    """Roots in extended precision, by Newton from those of NumPy: close ones lose half of the digits otherwise."""
    roots, slope = np.roots(polynomial.astype(float)).astype(np.clongdouble), np.polyder(polynomial)
    for _ in range(12):
        value = np.polyval(polynomial, roots)
        roots = roots - np.where(value == 0, 0, value) / np.where(value == 0, 1, np.polyval(slope, roots))
    return roots


def family_roots(alpha_m, alpha_f, beta, gamma, W, zeta):
    """Of the three-step form: Newmark's formulas, the weights, and w = -2 zeta W v - W^2 q, with (q, v, a) ~ mu^n."""
    alpha_m, alpha_f, beta, gamma, W, zeta = map(np.longdouble, (alpha_m, alpha_f, beta, gamma, W, zeta))
    difference, v = np.array([1, -1], np.longdouble), np.array([gamma, 1 - gamma])
    q = np.polyadd(v, np.polymul([beta, 0.5 - beta], difference))
    load = np.polyadd(2 * zeta * W * np.polymul(v, difference), W**2 * q)
    inertia = np.polymul(np.polymul([1 - alpha_m, alpha_m], difference), difference)
    return refined_roots(np.polyadd(inertia, np.polymul([1 - alpha_f, alpha_f], load)) / max(1, W**2))


def kim_roots(alpha, W, zeta):
    """Of Eq. 10-14, on (q, v, a); characteristic polynomial by Faddeev and LeVerrier."""
    alpha, W, zeta = map(np.longdouble, (alpha, W, zeta))
    beta, gamma = (1 - alpha) ** 2 / 4, np.longdouble(0.5) - alpha
    q, v, a = eye = np.eye(3, dtype=np.longdouble)
    Jq, Jv = -(1 + alpha) * W**2, -(1 + alpha) * 2 * zeta * W
    drift = v + (1 - 2 * beta / gamma) / 2 * a
    dv = (-2 * zeta * W * v - W**2 * q + gamma * Jq * drift) / (1 - gamma * Jv - beta * Jq)
    A = np.array([q + drift + beta / gamma * dv, v + dv, dv / gamma + (1 - 1 / gamma) * a])
    polynomial, B = [np.longdouble(1)], 0 * eye
    for k in range(1, 4):
        B = A @ B + polynomial[-1] * eye
        polynomial.append(-np.trace(A @ B) / k)
    return refined_roots(np.array(polynomial))


def first_order_roots(stability_function, W, zeta):
    """R(z) at the two z = W (-zeta +- i sqrt(1 - zeta^2))."""
    return stability_function(np.clongdouble(W * (-zeta + 1j * np.sqrt(1 - zeta**2))))[None]


def hht_roots(alpha):
    return partial(family_roots, 0, -alpha, (1 - alpha) ** 2 / 4, 0.5 - alpha)


RHO = 0.8
CLOSED_FORMS = {
    "hht(0)": (as_data(hhtjax.hht(0.0)), hht_roots(0.0)),
    "hht(-.05)": (as_data(hhtjax.hht(-0.05)), hht_roots(-0.05)),
    "hht(-.3)": (as_data(hhtjax.hht(-0.3)), hht_roots(-0.3)),
    "newmark(.3025, .6)": (as_data(hhtjax.newmark(0.3025, 0.6)), partial(family_roots, 0, 0, 0.3025, 0.6)),
    "bossak(-.1)": (as_data(hhtjax.bossak(-0.1)), partial(family_roots, -0.1, 0, 1.1**2 / 4, 0.6)),
    "generalized_alpha(.8)": (
        as_data(hhtjax.generalized_alpha(RHO)),
        partial(
            family_roots, (2 * RHO - 1) / (RHO + 1), RHO / (RHO + 1), 1 / (RHO + 1) ** 2, (3 - RHO) / (RHO + 1) / 2
        ),
    ),
    "operator_splitting(-.1)": (hhtjax.operator_splitting(-0.1), hht_roots(-0.1)),
    "kim_hht(-.1)": (hhtjax.kim_hht(-0.1), partial(kim_roots, -0.1)),
    "implicit_euler": (hhtjax.implicit_euler(), partial(first_order_roots, lambda z: 1 / (1 - z))),
    "rk4": (
        hhtjax.rk4(),
        partial(first_order_roots, lambda z: 1 + z * (1 + z / 2 * (1 + z / 3 * (1 + z / 4)))),
    ),
}
