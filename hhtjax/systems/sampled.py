"""`sampled`: an input given by samples, at equal distances or at any increasing times, as a function of time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_integer, require_number
from hhtjax.description import Array, Real, is_array, is_concrete, is_real

SLOP = 8  # a time this many roundings before a sample counts as the sample's


@partial(jax.tree_util.register_dataclass, data_fields=("polynomials", "dt", "t0", "times"), meta_fields=())
@dataclass(frozen=True, eq=False)
class Sampled:
    """Piecewise polynomial through samples, called with t; made by `sampled`."""

    polynomials: Any  # (intervals, order + 1, ...), of x in [0, 1]; lowest power first
    dt: Any  # of uniform samples, else None, as t0
    t0: Any
    times: Any = None  # of the samples, where they are not uniform

    def __call__(self, t: Real) -> Array:
        """The value at time t, a scalar or an array. Outside the samples it is the nearest end value."""
        intervals, terms = self.polynomials.shape[:2]
        i, x = self._uniform(t, intervals, terms) if self.times is None else self._find(t, intervals, terms)
        x = x.reshape(x.shape + (1,) * (self.polynomials.ndim - 2))
        coefficients = jnp.moveaxis(self.polynomials[i], jnp.ndim(t), 0)
        value = coefficients[-1]
        for k in reversed(range(terms - 1)):
            value = value * x + coefficients[k]
        return value

    def _uniform(self, t: Real, intervals: int, terms: int):
        """The number of the interval that contains t, and the position in it, from 0 to 1."""
        # a division: in some copies XLA makes it a product, and one number rounds to two on both sides of a sample
        x = (jnp.asarray(t).astype(self.dt.dtype) - self.t0) * (1 / self.dt)
        if terms == 1:  # a jump: at a sample, up to rounding, the new value
            x = x + SLOP * float(jnp.finfo(x.dtype).eps) * (jnp.abs(x) + jnp.abs(self.t0 / self.dt))
        i = jnp.clip(jnp.floor(x), 0, intervals - 1)
        x = _inside(x - i)
        return i.astype(jnp.int32), x

    def _find(self, t: Real, intervals: int, terms: int):
        """As `_uniform`, by bisection. The number of halvings depends on the number of samples, not on t."""
        t = jnp.asarray(t).astype(self.times.dtype)
        if terms == 1:
            i = self._last_before(t + self._rounding(t), intervals)
            return i, t
        i = self._last_before(t, intervals)
        return i, _inside((t - self.times[i]) / (self.times[i + 1] - self.times[i]))

    def _last_before(self, t: Array, intervals: int) -> Array:
        """The number of the last of the first `intervals` samples that is not after t; 0 if all are after t."""
        i = jnp.zeros(t.shape, jnp.int32)
        for half in reversed(range((intervals - 1).bit_length())):
            further = i + (1 << half)
            good = (further < intervals) & (self.times[jnp.minimum(further, intervals - 1)] <= t)
            i = jnp.where(good, further, i)
        return i

    def _rounding(self, t: Array) -> Array:
        return SLOP * float(jnp.finfo(self.times.dtype).eps) * (jnp.abs(t) + jnp.abs(self.times[0]))

    def held_before(self, t: Array, dt: Array) -> Array:
        """For a held input, the value during a step of at most dt that ended at t."""
        return self.polynomials[self.place_before(t, dt), 0]

    def place(self, t: Array) -> Array:
        """For a held input, the index of its value at t."""
        return (self._uniform if self.times is None else self._find)(t, len(self.polynomials), 1)[0]

    def place_before(self, t: Array, dt: Array) -> Array:
        """For a held input, the index of its value during a step of at most dt that ended at t."""
        if self.times is None:
            return self.place(t - dt / 2)
        t = jnp.asarray(t).astype(self.times.dtype)
        now, before = (self._last_before(x, len(self.times)) for x in (t + self._rounding(t), t - self._rounding(t)))
        return jnp.where(now > before, before, self.place(t - dt / 2))  # steps may differ at a sample

    def jump_after(self, t: Array) -> Array:
        """For a held input, the time of its first jump after t; inf if there is none."""
        intervals = len(self.polynomials)
        if self.times is None:
            i = 1 + self._uniform(t, intervals, 1)[0]
            return jnp.where(i < intervals, self.t0 + i.astype(self.dt.dtype) * self.dt, jnp.inf)
        i = 1 + self._find(t, intervals, 1)[0]
        return jnp.where(i < intervals, self.times[jnp.minimum(i, intervals - 1)], jnp.inf)

    def jumps(self) -> np.ndarray:
        """For a held input, the times at which it may jump, as a NumPy array; not for tracers."""
        if self.times is not None:
            return np.asarray(self.times)[1:]
        return np.asarray(self.t0) + np.asarray(self.dt) * np.arange(1, len(self.polynomials))

    def constant(self, value: Array) -> Sampled:
        """A held input that has this value at all times."""
        one = jnp.ones((), self.polynomials.dtype)
        scale = {"dt": one, "t0": one - 1, "times": None} if self.times is not None else {}
        return replace(self, polynomials=value[None, None], **scale)


def _inside(x: Array):
    return jnp.where(x < 0, 0, jnp.where(x > 1, 1, x))  # at the ends the slope is the one inside


def sampled(values: Real, dt: Real = None, t0: Real = 0.0, order: int = 3, *, times: Real | None = None) -> Sampled:
    """The function of time through `values[k]` at t0 + k dt, or at times[k]: a pytree for params, called with t.

    Args:
        values: (samples,) or (samples, channels...), real; at least order + 1 samples.
        dt: sampling period, positive; t0: time of the first sample.
        times: (samples,), instead of dt and t0: strictly increasing, at any distances. A call then needs a
            bisection, too, which takes some nanoseconds in a compiled run.
        order: 0: each value is held until the next, as by a D/A converter; 1: linear; 3: cubic spline, twice
            continuously differentiable ("not-a-knot" ends, as in SciPy's CubicSpline).

    A run treats a held input (`order=0`) in params as constant over each step. Steps that end on its jumps keep their
    order. A jump within a step reduces the order to 1; outside of jit a `JumpWarning` says so. `sweep(..., times=)`
    ends steps at jumps at any distances, and `adaptive` finds the jumps by itself. At a jump, the saved acceleration
    is the one before it; `interpolate` also uses it for v after the jump.

    Outside the samples the function keeps the nearest end value. Differentiable in values, times and t. A simulation
    uses the input only at its steps. If the step is shorter than dt, the reconstruction between the samples matters;
    for smooth signals the cubic one is far better.

    Returns:
        A `Sampled`: t -> a number, or (channels...).

    Raises:
        ValueError, TypeError: too few samples; dt not positive; times that do not increase or are not as many as the
            samples; both dt and times; an unknown order; values that are not real or not finite.

    >>> import jax.numpy as jnp, hhtjax
    >>> u = hhtjax.sampled(jnp.array([0.0, 1.0, 4.0, 9.0, 16.0]), dt=0.5)     # u(t) = 4 t^2
    >>> float(u(0.75)), float(u(100.0))
    (2.25, 16.0)
    >>> times = jnp.array([0.0, 0.4, 1.1, 1.5, 2.0])
    >>> round(float(hhtjax.sampled(4 * times**2, times=times)(0.75)), 12)
    2.25
    """
    if order not in (0, 1, 3) or isinstance(order, bool):
        raise ValueError(f"sampled: `order` must be 0 (held), 1 (linear) or 3 (cubic); received {order!r}.")
    values = values if is_array(values) else np.asarray(values)
    if not is_real(values) or values.dtype in (jnp.float16, jnp.bfloat16):
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
    times, dt, t0 = _grid(values, dt, t0, times)

    widths = None if times is None else (times[1:] - times[:-1]).reshape(-1, *(1,) * (values.ndim - 1))
    rise = values[1:] - values[:-1]
    if order == 0:
        polynomials = values[:, None]
    elif order == 1:
        polynomials = jnp.stack([values[:-1], rise], axis=1)
    else:
        slope = _spline_slopes(rise) if widths is None else _uneven_spline_slopes(rise, widths)
        left, right = slope[:-1], slope[1:]
        if widths is not None:
            left, right = left * widths, right * widths
        polynomials = jnp.stack([values[:-1], left, 3 * rise - 2 * left - right, left + right - 2 * rise], axis=1)
    return Sampled(polynomials, dt, t0, times)


def _grid(values: Array, dt: Real, t0: Real, times: Real):
    """times, dt and t0, checked, in the dtype of the values: either times, or dt and t0."""
    if times is None:
        if is_array(dt) and dt.ndim and dt.shape == values.shape[:1]:
            raise TypeError("sampled: `dt` must be a number; received one for each sample: give times as `times=`.")
        require_number("sampled", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
        require_number("sampled", "t0", t0, np.isfinite, "be finite")
        return None, *(jnp.asarray(x).astype(values.dtype) for x in (dt, t0))
    if dt is not None or not (is_real(t0) and is_concrete(t0) and np.ndim(t0) == 0 and t0 == 0):
        raise ValueError(f"sampled: `times` must be given without dt and t0; received dt={dt!r}, t0={t0!r} too.")
    times = times if is_array(times) else np.asarray(times)
    if not is_real(times):
        raise TypeError(f"sampled: `times` must be real numbers; received an array of {times.dtype}.")
    if times.shape != values.shape[:1]:
        raise ValueError(
            f"sampled: `times` must have shape {values.shape[:1]}, one for each sample; received shape {times.shape}."
        )
    if is_concrete(times):
        before, after = np.asarray(times)[:-1], np.asarray(times)[1:]
        wrong = np.flatnonzero(~((before < after) & np.isfinite(before) & np.isfinite(after)))
        if wrong.size:
            k = int(wrong[0])
            raise ValueError(
                f"sampled: `times` must be finite and strictly increase; received {before[k]} and {after[k]} at "
                f"samples {k} and {k + 1}."
            )
    return jnp.asarray(times).astype(values.dtype), None, None


def _spline_slopes(rise: Array) -> Array:
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


def _uneven_spline_slopes(rise: Array, widths: Array) -> Array:
    """Slopes s_k, per time, of the spline through samples h_k apart, d_k = rise_k/h_k:

    h_k s_(k-1) + 2 (h_(k-1) + h_k) s_k + h_(k-1) s_(k+1) = 3 (h_k d_(k-1) + h_(k-1) d_k)
    """
    h = widths.reshape(-1, 1)
    d = rise.reshape(rise.shape[0], -1) / h
    rhs = 3 * (h[1:] * d[:-1] + h[:-1] * d[1:])
    both = (h[1:] + h[:-1])[:, 0]
    # not-a-knot: h_1 s_0 + (h_0 + h_1) s_1 = first, to eliminate s_0 from the first row; likewise at the end
    first = ((3 * h[0] + 2 * h[1]) * h[1] * d[0] + h[0] ** 2 * d[1]) / both[0]
    last = ((3 * h[-1] + 2 * h[-2]) * h[-2] * d[-1] + h[-1] ** 2 * d[-2]) / both[-1]
    rhs = jnp.concatenate([(rhs[0] - first)[None], rhs[1:-1], (rhs[-1] - last)[None]])
    diagonal = 2 * both
    diagonal = diagonal.at[0].set(both[0]).at[-1].set(both[-1])
    lower, upper = h[1:, 0].at[0].set(0), h[:-1, 0].at[-1].set(0)
    inner = lax.linalg.tridiagonal_solve(lower, diagonal, upper, rhs)
    start, end = (first - both[0] * inner[0]) / h[1], (last - both[-1] * inner[-1]) / h[-2]
    return jnp.concatenate([start[None], inner, end[None]]).reshape(-1, *rise.shape[1:])


# ----------------------------------------------------------------------------
# Reconstruction of a band-limited input between its samples, and what simpler reconstructions lose.


def band_limited(values: Real, dt: Real, *, factor: int = 8, t0: Real = 0.0) -> Sampled:
    """The function of time through `values[k]` at t0 + k dt that contains no frequency above 1/(2 dt).

    The line through the first and the last sample is subtracted. The rest, continued as an odd function, is a Fourier
    series. It is evaluated at `factor` points per sample, and these are joined by a cubic spline, whose own gain error
    is that of `spline_gain_error` at dt/factor.

    Args:
        values: (samples,) or (samples, channels...), real, at least 4. dt: sampling period, positive.
        factor: points per sample. A run with that many steps per sample uses these points exactly.
        t0: time of the first sample.

    Outside the samples the function keeps the nearest end value. Near a jump or a kink, and near the ends, the series
    oscillates.

    Returns:
        A `Sampled`: t -> a number, or (channels...).

    Raises:
        TypeError, ValueError: as `sampled`; a factor that is not a positive integer.

    >>> import jax.numpy as jnp, hhtjax
    >>> u = jnp.sin(2 * jnp.pi * 0.4 * jnp.arange(400.0))                        # 2.5 samples a period
    >>> t, exact = 200.3, jnp.sin(2 * jnp.pi * 0.4 * 200.3)
    >>> abs(float(hhtjax.band_limited(u, 1.0)(t) - exact)) < 0.01 < abs(float(hhtjax.sampled(u, 1.0)(t) - exact))
    True
    """
    factor = require_integer("band_limited", "factor", factor)
    sampled(values, dt, t0)  # checks them
    line, spectrum = _odd_series(values)
    n = spectrum.shape[0] - 1
    fine = factor * jnp.fft.irfft(spectrum, 2 * n * factor, axis=0)[: n * factor + 1]
    return sampled(fine + line(n * factor), dt / factor, t0)


def band_limited_motion(values: Real, dt: Real, cutoff: Real | None) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position, velocity and acceleration at the samples of a measured motion, without frequencies above `cutoff`.

    The Fourier series of `band_limited` is cut off and differentiated. Its second derivative is zero at both ends, so
    accelerations are wrong within about one period of the cutoff from the ends.

    Args:
        values: (samples,) or (samples, channels...), real, at least 4. dt: sampling period, s.
        cutoff: Hz. Noise below it is amplified by up to (2 pi cutoff)^2 in the acceleration.

    Returns:
        Three arrays like values.

    Raises:
        TypeError, ValueError: as `sampled`; a cutoff that is not between 0 and 1/(2 dt).

    >>> t = 0.01 * jnp.arange(300.0)
    >>> q, v, a = band_limited_motion(jnp.sin(6 * t), 0.01, cutoff=5.0)
    >>> f"{float(v[100]):.2f} {float(a[100]):.1f}"                                     # without the ends 5.76 and 10.06
    '5.75 9.9'
    """
    sampled(values, dt)
    require_number("band_limited_motion", "cutoff", cutoff, lambda f: 0 < f * dt <= 0.5, "lie in (0, 1/(2 dt)]")
    return _motion(jnp.asarray(values), dt, cutoff)


@jax.jit
def _motion(values: Array, dt: Array, cutoff: Array):
    line, spectrum = _odd_series(values)
    n = spectrum.shape[0] - 1
    frequency = (jnp.linspace(0, 0.5, n + 1) / dt).astype(line(n).dtype).reshape(-1, *(1,) * (spectrum.ndim - 1))
    kept = jnp.where(frequency <= cutoff, spectrum, 0)

    def derivative(order: int) -> Array:
        turned = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency) ** order
        return jnp.fft.irfft(turned * kept, 2 * n, axis=0)[: n + 1]

    slope = (line(1)[1] - line(1)[0]) / (n * dt)
    return derivative(0) + line(n), derivative(1) + slope[None], derivative(2)


def _odd_series(values: Array):
    """The line from the first sample to the last, as a function of the number of equal parts at which it is evaluated;
    and the spectrum of the rest, continued as an odd function. Its highest frequency is set to 0."""
    y = jnp.asarray(values)
    y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.result_type(float))

    def line(parts: int) -> Array:
        ramp = jnp.linspace(0, 1, parts + 1, dtype=y.dtype).reshape(-1, *(1,) * (y.ndim - 1))
        return y[:1] + (y[-1] - y[0])[None] * ramp

    rest = y - line(y.shape[0] - 1)
    return line, jnp.fft.rfft(jnp.concatenate([rest, -rest[-2:0:-1]]), axis=0)


def spline_gain_error(frequency: Real, dt: Real, order: int = 3) -> float:
    """Relative amplitude error of a harmonic of `frequency` that is reconstructed by `sampled(..., order)`.

        order 0: 1 - sinc(f dt), and a delay of dt/2,    order 1: 1 - sinc^2(f dt),
        order 3: 1 - 3 sinc^4(f dt)/(2 + cos(2 pi f dt)),    sinc x = sin(pi x)/(pi x)

    Args:
        frequency: in Hz, at most half the sampling rate. dt: sampling period in s. order: 0, 1 or 3.

    Returns:
        A number; 0.01 means that the amplitude is off by 1 %.

    Raises:
        TypeError, ValueError: an argument out of its range.

    References:
        Unser, Aldroubi, Eden, IEEE Trans. Signal Process. 41 (1993): the response of the cardinal spline.

    >>> [f"{spline_gain_error(68.0, 1 / 610.35, order):.1e}" for order in (1, 3)]     # a benchmark at its resonance
    ['4.0e-02', '3.7e-04']
    """
    require_number("spline_gain_error", "dt", dt, lambda x: x > 0, "be positive")
    require_number("spline_gain_error", "frequency", frequency, lambda f: 0 <= f * dt <= 0.5, "be below 1/(2 dt)")
    if order not in (0, 1, 3) or not is_real(order):
        raise ValueError(f"spline_gain_error: `order` must be 0, 1 or 3; received {order!r}.")
    sinc = float(np.sinc(frequency * dt))
    return 1 - sinc ** (order + 1) if order < 3 else 1 - 3 * sinc**4 / (2 + float(np.cos(2 * np.pi * frequency * dt)))
