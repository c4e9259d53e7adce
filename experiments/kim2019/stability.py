"""Figs. 1 and 2: stability regions for y' = lambda y, from the library's own step, on the closed form."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from experiments.report import COLOURS, side_by_side
from hhtjax import FirstOrderSystem, conventional_hht, hht, kim_hht, kim_implicit_euler
from hhtjax.plot import legend, subplots

ALPHAS = (0.0, -0.05, -0.1, -0.3)


def _times(y, t, z):
    """z y, with y = (Re, Im)."""
    return jnp.array([z[0] * y[0] - z[1] * y[1], z[1] * y[0] + z[0] * y[1]])


TEST_EQUATION = FirstOrderSystem(_times)
METHODS = {  # alpha -> stepper
    "non-iterative HHT": kim_hht,
    "conventional HHT": partial(conventional_hht, tolerance=1e-14),
    "implicit Euler": lambda alpha: kim_implicit_euler(),
    "hht": lambda alpha: hht(alpha, linearize="predictor"),
}


@partial(jax.jit, static_argnames="method")
def amplification(z, alpha, *, method):
    """A in (y, h a)_1 = A (y, h a)_0 for each z = h lambda, by differentiating the step; complex, (..., 2, 2).

    a is the algorithmic y', where the method carries one on.
    """
    stepper = METHODS[method](alpha)

    def step(x, z):
        state = stepper.init(TEST_EQUATION, x[:2], None, z, 1.0)
        if state.a is None:
            state, _ = stepper.step(TEST_EQUATION, state._replace(v=x[2:]), z, 1.0)
            return jnp.concatenate([state.q, state.v])
        state, _ = stepper.step(TEST_EQUATION, state._replace(a=x[2:]), z, 1.0)
        return jnp.concatenate([state.q, state.a])

    z = jnp.stack([z.real, z.imag], axis=-1)
    A = jnp.vectorize(lambda z: jax.jacfwd(step)(jnp.zeros(4), z), signature="(2)->(4,4)")(z)
    return jax.lax.complex(A[..., ::2, ::2], A[..., 1::2, ::2])


def characteristic(z, method, alpha):
    """Closed form of (trace, determinant) of A."""
    gamma = 0.5 - alpha
    if method == "implicit Euler":
        return 1 / (1 - z), 0 * z
    if method == "non-iterative HHT":  # Kim et al., Eq. 19; a1 does not depend on a
        return 1 + z / (1 - gamma * (1 + alpha) * z), 0 * z
    lead = 1 - gamma * (1 + alpha) * z
    return (1 - gamma * alpha * z + (1 - gamma) * (1 + alpha) * z) / lead, (1 - gamma) * alpha * z / lead


def of_step(z, method, alpha):
    """The same from the step; the part of A that y feels."""
    A = amplification(jnp.asarray(z), alpha, method=method)
    alone = method in ("implicit Euler", "non-iterative HHT")  # y1 does not depend on a
    determinant = 0 * A[..., 0, 0] if alone else A[..., 0, 0] * A[..., 1, 1] - A[..., 0, 1] * A[..., 1, 0]
    return np.asarray(A[..., 0, 0] + (0 if alone else A[..., 1, 1])), np.asarray(determinant)


def radius(trace, determinant):
    """Largest modulus of the two eigenvalues."""
    root = np.sqrt(trace**2 / 4 - determinant + 0j)
    return np.maximum(abs(trace / 2 + root), abs(trace / 2 - root))


def deviations(z, method, alpha):
    """Largest differences between step and closed form on a grid: of the characteristic polynomial, of the radius."""
    ours, theirs = of_step(z, method, alpha), characteristic(z, method, alpha)
    polynomial = max(np.max(abs(x - y) / np.maximum(1, abs(y))) for x, y in zip(ours, theirs, strict=True))
    ours, theirs = radius(*ours), radius(*theirs)
    return float(polynomial), float(np.max(abs(ours - theirs) / np.maximum(1, theirs)))


def unstable_until(method, alpha, shape):
    """The real h lambda > 0 where the step becomes stable again; inf where it never does. Asks for a grid at a time."""
    if method != "implicit Euler" and alpha == 0:
        return np.inf
    low, high = 1.5, 1e4
    for _ in range(3):
        x = np.linspace(low, high, math.prod(shape))
        unstable = radius(*of_step(x.reshape(shape) + 0j, method, alpha)).ravel() > 1
        last = np.flatnonzero(unstable)[-1]
        low, high = x[last], x[last + 1]
    return float(high)


def run(report, fast):
    """Compares on a grid, finds the end of the unstable interval, draws the regions."""
    points = 61 if fast else 241
    x, y = np.linspace(-10, 76, points) + 1e-3, np.linspace(-40, 40, points)
    z = x + 1j * y[:, None]
    methods = tuple(METHODS)[: 3 if fast else None]
    numbers = {"grid_points": points**2, "methods": {}}
    rows, radii, ends = [], {}, {}
    side_by_side([partial(of_step, z, method, ALPHAS[1]) for method in methods])
    for method in methods:
        for alpha in ALPHAS[::3] if fast else ALPHAS:
            if method == "implicit Euler" and alpha:
                continue
            polynomial, largest = deviations(z, method, alpha)
            radii[method, alpha] = radius(*of_step(z, method, alpha))
            left = float(radii[method, alpha][:, x <= 0].max())
            end = unstable_until(method, alpha, z.shape)
            ends[method, alpha] = end
            numbers["methods"][f"{method}, alpha = {alpha:g}"] = {
                "deviation_of_characteristic_polynomial": polynomial,
                "deviation_of_spectral_radius": largest,
                "largest_radius_in_left_half_plane": left,
                "unstable_on_real_axis_until": end if np.isfinite(end) else None,
            }
            rows.append([method, f"{alpha:g}", polynomial, largest, left, end])
    print("Stability for y' = lambda y: the step against the closed form, and where on h lambda > 0 instability ends")
    report.table(["method", "alpha", "polynomial", "radius", "left half plane", "unstable until"], rows)
    report.figure("kim2019_stability", figure(x, y, radii, ends))
    return numbers


def locus(method, alpha):
    """Closed-form boundary: h lambda with an eigenvalue on the unit circle."""
    mu = np.exp(1j * np.linspace(1e-6, 2 * np.pi - 1e-6, 721))
    gamma = 0.5 - alpha
    if method == "implicit Euler":
        return 1 - 1 / mu
    if method == "non-iterative HHT":
        return (mu - 1) / (1 + gamma * (1 + alpha) * (mu - 1))
    return mu * (mu - 1) / ((gamma * mu + 1 - gamma) * ((1 + alpha) * mu - alpha))


def figure(x, y, radii, ends):
    """Fig. 1, Fig. 2, and the length of the unstable interval for every alpha."""
    drawn, (left, middle, right) = subplots(1, 3, width=175, height=95, width_ratios=(1, 1, 0.85))
    alphas = [alpha for method, alpha in radii if method == "non-iterative HHT" and alpha]
    for i, alpha in enumerate(alphas):
        left.contour(x, y, radii["non-iterative HHT", alpha], [1.0], colors=COLOURS[i])
        edge = locus("non-iterative HHT", alpha)
        left.plot(edge.real, edge.imag, "k:", lw=1.2)
        left.plot([], [], color=COLOURS[i], label=f"$\\alpha$ = {alpha:g}")
    left.plot([], [], "k:", label="closed form")
    left.axvline(0, color=COLOURS[5], lw=2, label=r"$\alpha$ = 0: the axis")
    shown = (("non-iterative HHT", -0.3), ("conventional HHT", -0.3), ("implicit Euler", 0.0))
    for i, (method, alpha) in enumerate(shown):
        middle.contourf(x, y, radii[method, alpha], [1, np.inf], colors=COLOURS[i], alpha=0.35)
        edge = locus(method, alpha)
        middle.plot(edge.real, edge.imag, color=COLOURS[i], label=method)
    for axes in (left, middle):
        axes.set_xlabel(r"Re $h\lambda$")
        axes.set_ylabel(r"Im $h\lambda$")
        axes.set_aspect("equal")
        axes.set_xlim(x[0], x[-1])
        axes.set_ylim(y[0], y[-1])
    middle.set_xlim(-4, 21)
    middle.set_ylim(-12, 12)
    legend(left, title="Fig. 1, unstable inside")
    legend(middle, title=r"Fig. 2: $\alpha$ = -0.3")
    a = -np.linspace(1e-3, 1 / 3, 300)
    right.semilogy(a, -2 / (a * (1 + 2 * a)), color=COLOURS[0], label="non-iterative HHT")
    right.semilogy(a, -1 / (a * (1 + 2 * a)), color=COLOURS[1], label="conventional HHT")
    right.axhline(2, color=COLOURS[2], label="implicit Euler")
    for i, method in enumerate(("non-iterative HHT", "conventional HHT")):
        right.plot(alphas, [ends[method, alpha] for alpha in alphas], "o", color=COLOURS[i], ms=4)
    right.set_xlabel(r"$\alpha$")
    right.set_ylabel(r"unstable for 0 < $h\lambda$ < ...")
    legend(right, title="dots: the step")
    return drawn
