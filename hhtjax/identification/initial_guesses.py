"""Initial guesses for a fit: from the equations of motion, and from fits to longer and longer parts of a record."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import evaluate, require_function
from hhtjax.description import Array, PyTree, Real, is_concrete
from hhtjax.identification.identify import fit
from hhtjax.identification.result import FitResult
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.friction import directions
from hhtjax.systems.sampled import Sampled, band_limited_motion, sampled
from hhtjax.systems.system import (
    AnySystem,
    System,
    mass_at,
    require_system,
)

ARGUMENTS = set(inspect.signature(fit).parameters) - {"params0"}
SLOW = 0.02  # part of the largest sliding velocity, below which a place is taken as possibly sticking
NOISE = 3.0  # standard deviations of the noise of a sliding velocity, below which it may stick, too
MARGIN = 1.0  # periods of the cutoff left out at both ends


def equation_error(
    system: AnySystem,
    values: Real,
    dt: Real = None,
    cutoff: Real | None = None,
    t0: Real = 0.0,
    *,
    times: Real | None = None,
) -> Callable[[Any], Any]:
    """Residuals of the equations of motion for a measured motion q: the function params -> M(q) a - Q(q, v, t, params).

    Pass this function to `fit`. It simulates nothing: velocities v and accelerations a come from the filtered
    measurement. Most parameters enter linearly, so the fit converges from almost any guess. Use its estimate as the
    initial guess of a fit through the simulation. Noise and the filter bias it, so it is not a final result.

    For a `FirstOrderSystem` the function is params -> y' - f(y, t, params), with a measured y.

    With dry friction the residual includes H^T F sign(s). The friction force of a joint that may stick is unknown, so
    the rows in which it appears are left out. A joint counts as possibly sticking if it slides slower than a fiftieth
    of its largest velocity, or slower than three standard deviations of the noise of its velocity. This noise is
    assumed to be white; its size is estimated from the part of the values above the cutoff.

    Args:
        system: a system without constraints and rotations. All its coordinates must be measured.
        values: positions, a pytree like q with a leading axis of samples. dt: sampling period, s.
        cutoff: Hz, between the frequencies of the motion and those of the noise.
        t0: time of the first sample.
        times: (samples,), sample times at any distances, instead of dt and t0. The values are then resampled at equal
            distances, as many as the samples, from the cubic spline `sampled(values, times=)`. The cutoff must stay
            well below half the sampling rate of the sparsest part.

    Returns:
        A function of params with values (samples without both ends, n), in units of force. With dry friction it returns
        a list of n arrays, the remaining rows of each coordinate. If `sliding` reads params, or the values are traced,
        these rows are not known in advance. The rows left out are then 0, and count as samples.

    Raises:
        TypeError, ValueError: not a system; as `band_limited_motion` and `sampled`; no samples left between the ends;
            dry friction, and no joint that slides.
        NotImplementedError: a system with constraints, internal states or contact; rotations, when the returned
            function is called.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -params["k"] * q - params["c"] * v)
    >>> t = 0.01 * jnp.arange(1000.0)
    >>> q = jnp.exp(-0.1 * t) * jnp.cos(3.0 * t)                                        # k = 9.01, c = 0.2
    >>> found = hhtjax.fit(hhtjax.equation_error(spring, q[:, None], 0.01, cutoff=5.0), {"k": 1.0, "c": 1.0})
    >>> f"{float(found.params['k']):.1f} {float(found.params['c']):.1f}"
    '9.0 0.2'
    """
    require_system("equation_error", system)
    if system.constraint is not None:
        raise NotImplementedError("equation_error: `system` has a constraint, whose forces are not measured.")
    if system.internal is not None:
        raise NotImplementedError("equation_error: `system` has internal states, which are not measured.")
    if system.contact is not None:
        raise NotImplementedError("equation_error: `system` has contact, whose forces are not measured.")
    if times is not None:
        values, dt, t0 = _at_equal_distances(values, dt, t0, times)
    motion = jax.tree.map(lambda y: band_limited_motion(y, dt, cutoff), values)
    q, v, a = jax.tree.transpose(jax.tree.structure(values), jax.tree.structure((0, 0, 0)), motion)
    samples = jax.tree.leaves(q)[0].shape[0]
    left_out = math.ceil(MARGIN / float(cutoff * dt))
    if samples <= 2 * left_out:
        raise ValueError(
            f"equation_error: `values` must have more than {2 * left_out} samples, because at both ends a period of "
            f"the cutoff is left out; received {samples}."
        )
    t = t0 + jnp.linspace(0, dt * (samples - 1), samples)
    inside = jax.tree.map(lambda y: y[left_out : samples - left_out], (q, v, a, t))
    rubs = getattr(system, "friction", None) is not None
    noise = _noise_of_rates(values, q, float(cutoff * dt)) / dt if rubs else None
    kept = _rows_that_slide(system, inside, noise) if rubs else None

    def residuals(params: PyTree) -> Any:
        def one(q: PyTree, v: PyTree, a: PyTree, t: Array) -> Array:
            _require_no_rotations(system, q, t, params)
            flat, x, rate = flatten("equation_error", system, q, v, t, params)
            t = t.astype(rate.dtype)
            left = flat.residual(x, rate, ravel_pytree(a if flat.positions else v)[0], t, params)
            return _with_friction(flat, left, x, rate, t, params) if rubs else left

        rows = jax.vmap(one)(*inside)
        if not rubs:
            return rows
        if kept is not None:
            return [column[numbers] for column, numbers in zip(rows.T, kept, strict=True)]
        return list(jnp.where(_slides(system, inside, noise, params), rows, 0).T)

    return residuals


def _with_friction(flat, left: Array, q: Array, v: Array, t: Array, params: PyTree) -> Array:
    """The rows with H^T tau, tau = F sign(s)."""
    s, H = flat.friction.sliding(q, v, t, params), directions(flat, q, t, params)
    return left + H.T @ (flat.friction.limit(q, v, None, t, params) * jnp.sign(s))


def _noise_of_rates(values: PyTree, smooth: PyTree, cutoff: float) -> Array:
    """Standard deviation of the noise of filtered rates, times the sampling period: (n,).

    cutoff: in cycles per sample. The noise is estimated from the values above the cutoff. White noise sigma has the
    part sqrt(1 - 2 cutoff) sigma above the cutoff. The rates of the part below it have 2 pi cutoff sqrt(2 cutoff/3)
    sigma.
    """

    def rms(y: Real, smooth: Array) -> Array:
        return jnp.sqrt(jnp.mean((jnp.asarray(y) - smooth) ** 2, axis=0)).ravel()

    sizes = jnp.concatenate(jax.tree.leaves(jax.tree.map(rms, values, smooth)))
    above = max(1 - 2 * cutoff, 1e-12)  # with a cutoff at half the sampling rate nothing tells
    return sizes * float(2 * np.pi * cutoff * np.sqrt(2 * cutoff / 3 / above))


class _NotKnown:
    """Placeholder for params that raises an error when it is read."""

    def __getattr__(self, name: str):
        raise TypeError("the params are not known yet")

    __getitem__ = __iter__ = __bool__ = __len__ = __getattr__


def _rows_that_slide(system, motion: tuple, noise: Real) -> list | None:
    """For each row, the indices of samples at which no joint of it may stick; None if this depends on params."""
    if not all(map(is_concrete, jax.tree.leaves((motion, noise)))):
        return None
    try:
        slides = np.asarray(jax.jit(lambda motion: _slides(system, motion, noise, _NotKnown()))(motion))
    except Exception:  # whatever a user's function does with params that are none; it is called again with some
        return None
    if not slides.any():
        raise ValueError("equation_error: in `values` some joint with dry friction must slide; none does.")
    return [np.flatnonzero(column) for column in slides.T]


def _slides(system, motion: tuple, noise: Real, params: PyTree) -> Array:
    """(samples, n): whether no joint that enters the row is so slow that it may stick."""
    q, v, _, t = motion

    def one(q: PyTree, v: PyTree, t: Array):
        rate, unravel = ravel_pytree(v)

        def sliding(rate: Array) -> Array:
            return rate if system.sliding is None else jnp.asarray(system.sliding(q, unravel(rate), t, params))

        return jnp.abs(sliding(rate)), jnp.abs(jax.jacfwd(sliding)(rate))

    s, H = jax.vmap(one)(q, v, t)
    of_noise = jnp.sqrt(jnp.sum((H * noise[None, None, :]) ** 2, axis=-1))
    slow = s <= jnp.maximum(SLOW * jnp.max(s, axis=0)[None, :], NOISE * of_noise)
    return ~jnp.any(slow[:, :, None] & (H > 0), axis=1)


def _require_no_rotations(system, q: PyTree, t: Array, params: PyTree):
    """Raises an error for positions (3, 3) that are rotations: the mass is then that of angular velocities (3,)."""
    turning = sum(x.size for x in jax.tree.leaves(q) if x.shape[-2:] == (3, 3))
    if turning and isinstance(system, System):
        M = evaluate("equation_error", "mass", partial(mass_at, system), q, t, params)
        rows = sum(x.size for x in jax.tree.leaves(q)) - turning + turning // 3
        if getattr(M, "shape", None) in ((rows,), (rows, rows)):
            raise NotImplementedError(
                "equation_error: `system` has rotations, whose angular velocities are not derivatives of `values`."
            )


def _at_equal_distances(values: np.ndarray, dt: Real, t0: Real, times: np.ndarray):
    """The values resampled at as many equally spaced times, the sampling period, and the time of the first."""
    splines = jax.tree.map(lambda y: sampled(y, dt, t0, times=times), values)
    t0, end, count = float(times[0]), float(times[-1]), len(times)
    dt = (end - t0) / (count - 1)
    return jax.tree.map(lambda u: u(t0 + dt * np.arange(count)), splines, is_leaf=_is_spline), dt, t0


def _is_spline(x: Sampled) -> bool:
    return isinstance(x, Sampled)


def fit_progressively(
    problem_at: Callable[[Any, FitResult | None], dict[str, Any]], params0: PyTree, horizons: Any, **options: Any
) -> FitResult:
    """Fits longer and longer parts of the data. Each fit starts at the estimate of the previous one.

    Over a short time a motion depends almost linearly on its parameters. Over a long or chaotic one the cost has many
    minima, and only the lowest is right. The early fits are also cheap.

    Args:
        problem_at: (horizon, before) -> the arguments of `fit` for this horizon, a dict with "residuals" and optionally
            "records", "starts", "weights". before: the `FitResult` of the previous horizon, None for the first. With
            `windows` of that duration this is multiple shooting.
        params0: as in `fit`. horizons: a sequence of values for problem_at, the shortest first.
        options: options of every fit, unless problem_at returns them. Only the last fit computes a covariance.

    Returns:
        The last `FitResult`.

    Raises:
        TypeError, ValueError: problem_at is not a function of two arguments, or does not return arguments of `fit`; no
            horizon.

    >>> import jax.numpy as jnp, hhtjax
    >>> t = jnp.linspace(0.0, 30.0, 600)
    >>> measured = jnp.sin(3.0 * t)
    >>> def problem_at(n, before):
    ...     return {"residuals": lambda w: jnp.sin(w * t[:n]) - measured[:n]}
    >>> [round(float(hhtjax.fit_progressively(problem_at, 1.5, h).params), 3) == 3.0 for h in ([600], [20, 600])]
    [False, True]
    """
    require_function("fit_progressively", "problem_at", problem_at, "problem_at(horizon, before)")
    try:
        horizons = list(horizons)
    except TypeError:
        raise TypeError(f"fit_progressively: `horizons` must be a sequence; received {horizons!r}.") from None
    if not horizons:
        raise ValueError("fit_progressively: `horizons` must hold at least one; received none.")
    params, result = params0, None
    for i, horizon in enumerate(horizons):
        last = i == len(horizons) - 1
        rest: dict[str, Any] = options if last else options | {"covariance": False}
        result = fit(**{"params0": params} | rest | _problem(problem_at(horizon, result), horizon))
        params = result.params
    assert result is not None
    return result


def _problem(found: PyTree, horizon: int):
    """The arguments that problem_at returned, checked."""
    where = f"fit_progressively: `problem_at` must return a dict of arguments of `fit`; received at horizon {horizon!r}"
    if not isinstance(found, dict):
        raise TypeError(f"{where} a {type(found).__name__}.")
    if wrong := [name for name in found if name not in ARGUMENTS]:
        raise ValueError(f"{where} {wrong[0]!r}, which is not an argument of `fit`.")
    if "residuals" not in found:
        raise ValueError(f"{where} {', '.join(found) or 'an empty one'}, without residuals.")
    return found
