"""Sensors: their readings along a motion, at times of their own, with gain, offset, drift and delay."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import describe, require_function, require_number, require_params
from hhtjax.description import Array, Description, PyTree, Real, is_array, is_real, thaw
from hhtjax.description.presentation import shown
from hhtjax.numerics.dense_lu import matvec
from hhtjax.runs.interpolate import interpolate, on_axes
from hhtjax.runs.output import output_at, require_output
from hhtjax.runs.solution import Solution
from hhtjax.systems import kinematics
from hhtjax.xla import Programs

if TYPE_CHECKING:
    from hhtjax.runs.interpolate import Interpolant
    from hhtjax.runs.output import Output


def measure(
    solution: Solution,
    times: Real | None,
    gain: PyTree = 1.0,
    offset: PyTree = 0.0,
    delay: PyTree = 0.0,
    *,
    drift: PyTree = 0.0,
    output: Callable | None = None,
    params: PyTree = None,
) -> Any:
    """Readings of sensors at `times` of their own clocks:

        y(t) = gain s(t - delay) + offset + drift (t - t0)

    The signal s is the position q, or `output`, a function of the motion. If the run was made with `output=`, s is its
    saved output, interpolated linearly between the saved times. Before the start t0 of the run, s has its value at t0.

    gain, offset, drift and delay can be parameters of a fit. A gain, a stiffness and a mass cannot all be fitted: the
    data determine only their ratios. Several sensors are entries of a dict that `output` returns. Each of `times`,
    gain, offset, drift and delay may be one value for all sensors, or a dict with one for each, as for the axes of
    `jax.vmap`.

    Args:
        solution: the solution of one run.
        times: (samples,), s, not after the end of the run; or one such array for each sensor.
        gain, offset, drift: numbers, or arrays with the shape of a sensor's reading; drift per second.
        delay: numbers, s.
        output: a function whose arguments have some of the names q, v, w (the acceleration), L (multipliers), z, zdot,
            friction, sticking, t, params: `output(q, w, params)`, `output(q, v, w, L, z, t, params)`. It returns any
            pytree. Arguments that the system does not have are None. Values between the saved times are those of
            `interpolate`. If events switch numbers in params, `output` still gets the params given here. See
            `accelerometer`.
        params: passed to `output`, usually the params of the run.

    Returns:
        A pytree like q, or like the result of `output`, with a leading axis of samples.

    Raises:
        TypeError, ValueError: as `interpolate`; an `output` with other arguments; a dict that does not match the
            sensors.

    Example: a falling ball, measured with a tape and with an accelerometer whose clock is late by 0.3 s. In free fall
    the accelerometer shows only its offset:

    >>> import jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, params: 0 * q - params["g"])
    >>> run = hhtjax.simulate(ball, hhtjax.hht(), jnp.zeros(1), jnp.ones(1), {"g": 9.81}, dt=0.1, num_steps=10)
    >>> def sensors(q, w, params):
    ...     return {"tape": q[0], "felt": w[0] + params["g"]}
    >>> shown = hhtjax.measure(
    ...     run, {"tape": jnp.array([0.5, 1.0]), "felt": jnp.array([0.33, 0.66, 0.99])},
    ...     offset={"tape": 0.0, "felt": 0.02}, delay={"tape": 0.0, "felt": 0.3}, output=sensors, params={"g": 9.81})
    >>> [round(float(x), 5) for x in shown["tape"]], [round(float(x), 5) for x in shown["felt"]]     # t - 9.81 t^2/2
    ([-0.72625, -3.905], [0.02, 0.02, 0.02])
    """
    if not isinstance(solution, Solution):
        raise TypeError(f"measure: `solution` must be a Solution, from simulate; received {type(solution).__name__}.")
    output = require_output("measure", output)
    if output is not None and solution.output is not None:
        raise ValueError("measure: `output` must be left out: the run was made with output=, and saved nothing else.")
    sense = partial(_sensed, solution, output, require_params("measure", params))
    times, delay = _one_or_tree(times), _one_or_tree(delay)
    t0 = solution.t[0]
    if _is_tree(times) or _is_tree(delay):
        like = jax.eval_shape(lambda: sense(t0))
        clocks = list(zip(_each("times", times, like), _each("delay", delay, like), strict=True))
        found = {(id(t), id(late)): jax.tree.leaves(sense(_clock(t, late, t0))) for t, late in clocks}
        leaves = [found[id(t), id(late)][i] for i, (t, late) in enumerate(clocks)]
        shown, times = jax.tree.structure(like).unflatten(leaves), [t for t, _ in clocks]
    else:
        shown = sense(_clock(times, delay, t0))
        times = [times] * len(jax.tree.leaves(shown))
    leaves, structure = jax.tree.flatten(shown)
    parts = [_each(name, _one_or_tree(x), shown) for name, x in (("gain", gain), ("offset", offset), ("drift", drift))]
    return structure.unflatten([
        _with_flaws(y, jnp.asarray(t) - t0, *more) for y, t, *more in zip(leaves, times, *parts, strict=True)
    ])  # fmt: skip


def _clock(times, delay, t0) -> Array:
    """The times of the motion for readings at these times: earlier by the delay, and not before the start."""
    require_number("measure", "delay", delay, np.isfinite, "be finite")
    return jnp.maximum(jnp.asarray(times) - delay, t0)


def _sensed(solution: Solution, output: Output | None, params: PyTree, times: Array) -> PyTree:
    """Readings of ideal sensors, with the times as leading axes."""
    found = interpolate(solution, times)
    if output is None:
        return found.q if solution.output is None else found.output
    return _outputs(output, found, jnp.asarray(times).astype(solution.t.dtype), params)


@Programs
def _outputs(output: Output, found: Interpolant, times: Array, params: PyTree) -> PyTree:
    """The output at each of the times. found: the interpolated motion there."""
    params = thaw(params)
    one = partial(output_at, output)
    for _ in range(times.ndim):
        one = jax.vmap(one, (0, 0, None))
    return one(found, times, params)


def _one_or_tree(x: PyTree):
    """A list of numbers as an array; anything else unchanged."""
    return np.asarray(x) if isinstance(x, (list, tuple)) and all(is_real(y) and np.ndim(y) == 0 for y in x) else x


def _is_tree(x: PyTree) -> bool:
    return not (is_array(x) or is_real(x))


def _each(name: str, x: PyTree, like: PyTree):
    """A list with one x for each leaf of the readings, from one x for all, or for whole branches."""
    try:
        return jax.tree.leaves(jax.tree.map(lambda x, part: [x] * len(jax.tree.leaves(part)), x, like))
    except (ValueError, TypeError):
        raise ValueError(
            f"measure: `{name}` must be one for all, or one for each part of what is measured, {describe(like)}; "
            f"received {describe(x)}."
        ) from None


def _with_flaws(y: Array, since: Array, gain: Real, offset: Real, drift: Real) -> Array:
    """gain y + offset + drift t, each a number or of the shape of a reading. Flags and counts are unchanged."""
    if not jnp.issubdtype(y.dtype, jnp.floating):
        return y

    def like_y(x: Real) -> Real:
        return x if jnp.ndim(x) == 0 else jnp.broadcast_to(x, y.shape)

    shown = like_y(gain) * y + like_y(offset)
    is_zero = isinstance(drift, (int, float)) and drift == 0
    return shown if is_zero else shown + like_y(drift) * on_axes(since.astype(y.dtype), y)


@dataclass(frozen=True, eq=False)
class Accelerometer(Description):
    """An accelerometer as an `output` function, made by `accelerometer`."""

    position: Any
    gravity: Any
    frame: Any

    def __call__(self, q: Array, v: Array, w: Array, t: Array, params: PyTree) -> Array:
        """f = R^T (a - g)."""
        x, unravel = ravel_pytree(q)
        rates = ravel_pytree(v)[0]
        blocks, one = kinematics.layout(q, v), jnp.ones_like(t)

        def velocity(x: Array, rates: Array, t: Array) -> Array:
            motion = kinematics.rate(blocks, x, rates), one
            return jax.jvp(lambda x, t: jnp.asarray(self.position(unravel(x), t, params)), (x, t), motion)[1]

        along = kinematics.rate(blocks, x, rates), ravel_pytree(w)[0], one
        a = jax.jvp(velocity, (x, rates, t), along)[1]
        g = jnp.asarray(self.gravity(params) if callable(self.gravity) else self.gravity)
        if a.ndim != 1 or g.shape != a.shape:
            raise ValueError(
                f"accelerometer: `gravity` must have the shape of what `position` returns, {a.shape}, (d,); received "
                f"{g.shape}."
            )
        f = a - g.astype(a.dtype)
        if self.frame is None:
            return f
        R = jnp.asarray(self.frame(q, t, params))
        if R.shape != (a.size, a.size):
            raise ValueError(f"accelerometer: `frame` must return {(a.size, a.size)}; received {R.shape}.")
        return matvec(R.T, f)


def accelerometer(position: Real, gravity: Real, frame: str | None = None) -> Accelerometer:
    """An accelerometer, as the `output` of `measure`, `simulate` and `sweep`:

        f = R^T (a - g),    a = d^2/dt^2 position(q(t), t)

    The reading f is the acceleration minus that of gravity, in the axes of the sensor (proper acceleration, or specific
    force). In free fall it is zero. At rest it points up. a is computed from q, v and w by derivatives of `position`
    along the motion. It includes the centripetal acceleration of a point on a body, and the motion of a support.

    Args:
        position: position of the sensor, `position(q, t, params)` -> (d,), m, in axes at rest; d is 1, 2 or 3.
        gravity: (d,), the acceleration of free fall, m/s^2, such as (0, 0, -9.81); or a function `gravity(params)`.
        frame: axes of the sensor, `frame(q, t, params)` -> (d, d), a rotation matrix with the axes as columns. If the
            sensor is aligned with a body, this is the rotation R of the body. Default: axes at rest.

    Returns:
        A function (q, v, w, t, params) -> (d,). Create it once: another function, even an equal one, is compiled again.

    Raises:
        TypeError: position, frame or gravity is not a function of these arguments.
        ValueError: shapes that do not match, when the returned function is first called.

    References:
        Titterton, Weston, Strapdown Inertial Navigation Technology (2004), Ch. 3; MuJoCo's sensor of that name.

    Example: on the bob of a pendulum, with axes across and along the rod. At the lowest point the reading is g + l v^2.

    >>> import jax.numpy as jnp, hhtjax
    >>> def position(q, t, params):
    ...     return params["l"] * jnp.array([jnp.sin(q[0]), -jnp.cos(q[0])])
    >>> def frame(q, t, params):
    ...     s, c = jnp.sin(q[0]), jnp.cos(q[0])
    ...     return jnp.array([[c, -s], [s, c]])                                      # across, and up along the rod
    >>> bob = hhtjax.accelerometer(position, (0.0, -9.81), frame)
    >>> shown = bob(jnp.zeros(1), jnp.full(1, 2.0), jnp.zeros(1), 0.0, {"l": 0.5})
    >>> [round(float(f), 2) for f in shown]                                          # 9.81 + 0.5 * 2^2
    [0.0, 11.81]
    """
    require_function("accelerometer", "position", position, "position(q, t, params)")
    if frame is not None:
        require_function("accelerometer", "frame", frame, "frame(q, t, params)")
    if callable(gravity):
        require_function("accelerometer", "gravity", gravity, "gravity(params)")
    else:
        gravity = np.asarray(gravity) if isinstance(gravity, (list, tuple)) else gravity
        if not is_real(gravity) or np.ndim(gravity) != 1:
            raise TypeError(
                "accelerometer: `gravity` must be (d,) real numbers, or a function gravity(params); "
                f"received {gravity!r}."
            )
    return Accelerometer(position, gravity, frame)


# ----------------------------------------------------------------------------
# Measurements: records cut into windows of one shape for `fit(..., records=...)`.


@shown
class Windows(NamedTuple):
    """Result of `windows`. Shorter windows are filled up by repeating their last sample, with `present` False.

    Attributes:
        t: (windows, samples), time in s since the first sample of the window.
        y: (windows, samples, ...), measured values.
        present: Booleans like y, to be passed to `fit` as weights.
        begin: (windows,), time of the first sample of each window on the clock of the record.
    """

    t: Array
    y: PyTree
    present: Array
    begin: Array


def windows(t: Real, y: PyTree, duration: Real, present: Real | None = None) -> Windows:
    """Cuts a record into consecutive windows of `duration`, for `fit(records=...)`. An incomplete last one is dropped.

    Args:
        t: (samples,), times in s, increasing. They need not be equally spaced: windows have equal duration, and may
            contain gaps.
        y: (samples, ...), measured values. present: Booleans like y; False marks a missing sample, which may be NaN.
        duration: duration of a window, s. The next window begins with the first sample at the end of this one, or after
            it. Without a gap there, both windows contain that sample.

    Returns:
        A `Windows`.

    Raises:
        TypeError, ValueError: unequal lengths; times that do not increase; NaN that is not declared missing; a record
            shorter than one window.

    >>> import numpy as np, hhtjax
    >>> t = np.array([0.0, 0.1, 0.2, 0.45, 0.5, 0.6, 0.8])
    >>> cut = hhtjax.windows(t, np.sin(t), duration=0.3)
    >>> cut.begin, cut.present.sum(axis=1)
    (array([0.  , 0.45]), array([3, 3]))
    """
    t, y = np.asarray(t, float), np.asarray(y, float)
    present = np.full(y.shape, True) if present is None else np.asarray(present, bool)
    if t.ndim != 1 or t.size == 0 or t.shape != y.shape[:1] or present.shape != y.shape:
        raise ValueError(
            "windows: `t`, `y` and `present` must have equal lengths, not 0, and `present` the shape of y; received "
            f"{t.shape}, {y.shape}, {present.shape}."
        )
    falls = np.flatnonzero(np.diff(t) <= 0)
    if not np.all(np.isfinite(t)) or falls.size:
        at = int(falls[0]) + 1 if falls.size else int(np.argmin(np.isfinite(t)))
        raise ValueError(f"windows: `t` must increase; received {t[at]} at sample {at}.")
    if not np.all(np.isfinite(y[present])):
        raise ValueError("windows: `y` must be finite, or declared missing by `present`; received NaN or inf.")
    require_number("windows", "duration", duration, lambda x: x > 0, "be positive")
    first = [0]
    while (following := max(first[-1] + 1, int(np.searchsorted(t, t[first[-1]] + duration * (1 - 1e-9))))) < len(t):
        first.append(following)
    if len(first) == 1:
        raise ValueError(f"windows: `duration` must be less than the record's, {t[-1] - t[0]}; received {duration}.")
    begin = t[first[:-1]]
    last = np.searchsorted(t, begin + duration * (1 + 1e-9), side="right") - 1
    steps = np.arange(np.max(last - first[:-1]) + 1)
    index = np.minimum(np.array(first[:-1])[:, None] + steps, last[:, None])
    real = (steps <= (last - first[:-1])[:, None]).reshape(*index.shape, *(1,) * (y.ndim - 1))
    y = np.where(present, y, 0)
    return Windows(t[index] - begin[:, None], y[index], present[index] & real, begin)


def wrap_angle(angle: Real) -> Any:
    """Maps an angle to [-pi, pi) by adding whole turns.

    Apply it to the difference of two angles if whole turns are missing from one of the measurements.

    Args:
        angle: rad, an array of any shape.

    Returns:
        An array shaped like angle.

    Raises:
        TypeError: angle is not real.

    >>> round(float(wrap_angle(6.0)), 4)                                          # 6 - 2 pi
    -0.2832
    """
    angle = jnp.asarray(angle)
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
