"""A uniformly sampled input as a function of time, and as data."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_number
from hhtjax.description import is_array, is_concrete, is_real


@partial(jax.tree_util.register_dataclass, data_fields=("polynomials", "dt", "t0"), meta_fields=())
@dataclass(frozen=True, eq=False)
class Sampled:
    """Piecewise polynomial through uniform samples, called with t; made by `sampled`."""

    polynomials: Any  # (intervals, order + 1, ...), of x in [0, 1]; lowest power first
    dt: Any
    t0: Any

    def __call__(self, t):
        """Value at time t, a scalar or an array; outside the samples, the nearest end value."""
        intervals, terms = self.polynomials.shape[:2]
        x = (jnp.asarray(t).astype(self.dt.dtype) - self.t0) / self.dt
        if terms == 1:  # a jump: at a sample, up to rounding, the new value
            x = x + 8 * float(jnp.finfo(x.dtype).eps) * (jnp.abs(x) + jnp.abs(self.t0 / self.dt))
        i = jnp.clip(jnp.floor(x), 0, intervals - 1)
        x = x - i
        x = jnp.where(x < 0, 0, jnp.where(x > 1, 1, x))  # at the ends the slope is the one inside
        i = i.astype(jnp.int32)
        x = x.reshape(x.shape + (1,) * (self.polynomials.ndim - 2))
        coefficients = jnp.moveaxis(self.polynomials[i], jnp.ndim(t), 0)
        value = coefficients[-1]
        for k in reversed(range(terms - 1)):
            value = value * x + coefficients[k]
        return value


def sampled(values, dt, t0=0.0, order=3) -> Sampled:
    """The function of time through `values[k]` at t0 + k dt: a pytree to put in params and call with t.

    Args:
        values: (samples,) or (samples, channels...), real; order + 1 samples at least.
        dt: sampling period, positive; t0: time of the first sample.
        order: 0, each value held until the next, as a D/A converter does; 1, linear; 3, cubic spline, twice
            continuously differentiable ("not-a-knot" ends, as in SciPy's CubicSpline).

    A run takes a held input, found in params, as constant over each step: steps that end on its jumps keep their order
    (but for `houbolt`, `park` and `operator_splitting`, which remember earlier steps). What is saved at a jump is the
    acceleration before it; `interpolate` uses it for v after it too.

    Outside [t0, t0 + (samples - 1) dt] the nearest end value is held. Differentiable in values and t.
    An input enters a simulation only through its values at the steps: with a step shorter than dt the
    reconstruction between the samples matters, and the cubic one is far better on smooth signals.

    Returns:
        A `Sampled`: t -> a number, or (channels...).

    Raises:
        ValueError, TypeError: too few samples, a non-positive dt, an unknown order, values that are not
            real or not finite.

    >>> import jax.numpy as jnp, hhtjax
    >>> u = hhtjax.sampled(jnp.array([0.0, 1.0, 4.0, 9.0, 16.0]), dt=0.5)     # u(t) = 4 t^2
    >>> float(u(0.75)), float(u(100.0))
    (2.25, 16.0)
    """
    if order not in (0, 1, 3) or isinstance(order, bool):
        raise ValueError(f"sampled: `order` must be 0 (held), 1 (linear) or 3 (cubic); received {order!r}.")
    values = values if is_array(values) else np.asarray(values)
    if not is_real(values) or values.dtype == jnp.float16:
        raise TypeError(f"sampled: `values` must be real numbers; received an array of {values.dtype}.")
    values = jnp.asarray(values)
    if not jnp.issubdtype(values.dtype, jnp.floating):
        values = values.astype(jnp.result_type(float))
    needed = order + 1
    if values.ndim == 0 or values.shape[0] < needed or values.size == 0:
        raise ValueError(
            f"sampled: `values` must hold at least {needed} samples for order={order}; received shape {values.shape}."
        )
    if is_concrete(values) and not np.all(np.isfinite(values)):
        bad = int(np.argmin(np.isfinite(values).reshape(values.shape[0], -1).all(axis=1)))
        raise ValueError(f"sampled: `values` must be finite; received {values[bad]} at sample {bad}.")
    require_number("sampled", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_number("sampled", "t0", t0, np.isfinite, "be finite")

    rise = values[1:] - values[:-1]
    if order == 0:
        polynomials = values[:, None]
    elif order == 1:
        polynomials = jnp.stack([values[:-1], rise], axis=1)
    else:
        slope = _spline_slopes(rise)
        left, right = slope[:-1], slope[1:]
        polynomials = jnp.stack([values[:-1], left, 3 * rise - 2 * left - right, left + right - 2 * rise], axis=1)
    return Sampled(polynomials, *(jnp.asarray(x).astype(values.dtype) for x in (dt, t0)))


def _spline_slopes(rise):
    """Slopes s_k, per sampling period, of the spline: s_(k-1) + 4 s_k + s_(k+1) = 3 (rise_(k-1) + rise_k)."""
    rows = rise.reshape(rise.shape[0], -1)
    rhs = 3 * (rows[1:] + rows[:-1])
    # not-a-knot: s_0 + 2 s_1 = first, subtracted from the first row to eliminate s_0; likewise at the end
    first, last = (5 * rows[0] + rows[1]) / 2, (5 * rows[-1] + rows[-2]) / 2
    rhs = jnp.concatenate([(rhs[0] - first)[None], rhs[1:-1], (rhs[-1] - last)[None]])
    n = rhs.shape[0]
    diagonal = jnp.full(n, 4.0, rhs.dtype).at[jnp.array([0, -1])].set(2.0)
    beside = jnp.ones(n, rhs.dtype)
    inner = lax.linalg.tridiagonal_solve(beside.at[0].set(0), diagonal, beside.at[-1].set(0), rhs)
    slopes = jnp.concatenate([(first - 2 * inner[0])[None], inner, (last - 2 * inner[-1])[None]])
    return slopes.reshape(-1, *rise.shape[1:])
