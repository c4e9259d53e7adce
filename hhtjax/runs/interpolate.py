"""Dense output: what a run does between its saved times."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.description.presentation import shown
from hhtjax.systems import kinematics


@shown
class Interpolant(NamedTuple):
    """Position and velocity between the saved times; made by `interpolate`.

    Attributes:
        q, v: with the times asked for as leading axes; of a first-order system y and None.
    """

    q: Any
    v: Any


def interpolate(solution, times) -> Interpolant:
    """Dense output: q and v at arbitrary times inside the run, differentiable in all.

    Cubic Hermite polynomials between the saved times: q through (q, v), v through (v, acceleration); for a rotation, of
    the rotation vector from the saved one before. Their error is O(H^4), H the spacing of the saved times.

    Args:
        solution: of one run (vmap this function for a batch).
        times: scalar or array, inside [solution.t[0], solution.t[-1]] up to rounding.

    Returns:
        An `Interpolant`.

    Raises:
        TypeError, ValueError: times that are not real; a solution of several runs; a time outside the run, where the
            result is NaN for tracers.

    >>> import jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: 0 * q - 9.81)
    >>> run = hhtjax.simulate(ball, hhtjax.hht(), jnp.array([0.0]), jnp.array([10.0]), dt=0.1, num_steps=10)
    >>> round(float(hhtjax.interpolate(run, 0.25).q[0]), 5)                 # 10 t - 9.81 t^2/2
    2.19344
    """
    t = solution.t
    if t.ndim != 1:
        raise ValueError(f"interpolate: `solution` must be of one run (vmap over a batch); received t of {t.shape}.")
    times = times if is_array(times) else np.asarray(times)
    if not is_real(times):
        raise TypeError(f"interpolate: `times` must be real numbers; received {times!r}.")
    times = jnp.asarray(times).astype(t.dtype)
    start, end = t[0], t[-1]
    slack = 16 * float(jnp.finfo(t.dtype).eps) * jnp.maximum(jnp.abs(start), jnp.abs(end))
    outside = ~((times >= start - slack) & (times <= end + slack))
    if is_concrete(outside) and np.any(outside):
        bad = np.asarray(times)[np.asarray(outside)].flat[0]
        raise ValueError(f"interpolate: `times` must lie in [{start:.6g}, {end:.6g}]; received {bad:.6g}.")
    if jnp.ndim(solution.dt):  # intervals of any lengths
        i = jnp.clip(jnp.searchsorted(t, times, side="right") - 1, 0, t.shape[0] - 2)
        H = t[i + 1] - t[i]
    else:
        i = jnp.clip(jnp.floor((times - start) / (t[1] - t[0])).astype(jnp.int32), 0, t.shape[0] - 2)
        H = jnp.full_like(times, t[1] - t[0])
    x = jnp.where(outside, jnp.nan, (times - t[i]) / H)

    def on_axes(x, y):
        return x.reshape(x.shape + (1,) * (y.ndim - 1))

    def hermite(y, slope):
        s, h = on_axes(x, y), on_axes(H, y)
        return y[i] + kinematics.hermite(y[i + 1] - y[i], h * slope[i], h * slope[i + 1], s)

    def position(q, v):
        if not kinematics.is_rotation(q.shape, v.shape):
            return hermite(q, v)
        s, h = on_axes(x, v), on_axes(H, v)
        return kinematics.interpolate_rotation(q[i], q[i + 1], h * v[i], h * v[i + 1], s)

    first_order = solution.acceleration is None
    v = None if first_order else jax.tree.map(hermite, solution.v, solution.acceleration)
    return Interpolant(jax.tree.map(position, solution.q, solution.v), v)
