"""Reconstruction of a band-limited input between its samples, and what simpler reconstructions lose."""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_integer, require_number
from hhtjax.description import is_real
from hhtjax.systems.sampled import Sampled, sampled


def band_limited(values, dt, *, factor=8, t0=0.0) -> Sampled:
    """The function of time through `values[k]` at t0 + k dt that holds no frequency above 1/(2 dt).

    The samples less the line through the first and the last one, continued as an odd function, are a Fourier series.
    It is evaluated `factor` times as densely, and joined by a cubic spline, whose own gain error is that of
    `spline_gain_error` at dt/factor.

    Args:
        values: (samples,) or (samples, channels...), real, at least 4. dt: sampling period, positive.
        factor: points for each sample; with that many steps for each sample they are met exactly.
        t0: time of the first sample.

    Outside the samples the nearest end value is held. Near a jump or a kink, and near the ends, the series rings.

    Returns:
        A `Sampled`: t -> a number, or (channels...).

    Raises:
        TypeError, ValueError: as `sampled`; a factor that is no positive integer.

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


def band_limited_motion(values, dt, cutoff) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Position, velocity and acceleration at the samples of a measured motion, without frequencies above `cutoff`.

    The series is that of `band_limited`, cut off and differentiated. At both ends its second derivative is zero, so
    that accelerations are wrong within about one period of the cutoff.

    Args:
        values: (samples,) or (samples, channels...), real, at least 4. dt: sampling period, s.
        cutoff: Hz; noise below it is multiplied by up to (2 pi cutoff)^2 in the acceleration.

    Returns:
        Three arrays like values.

    Raises:
        TypeError, ValueError: as `sampled`; a cutoff that is not between 0 and 1/(2 dt).

    >>> t = 0.01 * jnp.arange(300.0)
    >>> q, v, a = band_limited_motion(jnp.sin(6 * t), 0.01, cutoff=5.0)
    >>> f"{float(v[100]):.2f} {float(a[100]):.1f}"                                     # 5.76 and 10.06 but for the ends
    '5.75 9.9'
    """
    sampled(values, dt)
    require_number("band_limited_motion", "cutoff", cutoff, lambda f: 0 < f * dt <= 0.5, "lie in (0, 1/(2 dt)]")
    return _motion(jnp.asarray(values), dt, cutoff)


@jax.jit
def _motion(values, dt, cutoff):
    line, spectrum = _odd_series(values)
    n = spectrum.shape[0] - 1
    frequency = (jnp.linspace(0, 0.5, n + 1) / dt).astype(line(n).dtype).reshape(-1, *(1,) * (spectrum.ndim - 1))
    kept = jnp.where(frequency <= cutoff, spectrum, 0)

    def derivative(order):
        turned = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency) ** order
        return jnp.fft.irfft(turned * kept, 2 * n, axis=0)[: n + 1]

    slope = (line(1)[1] - line(1)[0]) / (n * dt)
    return derivative(0) + line(n), derivative(1) + slope[None], derivative(2)


def _odd_series(values):
    """The line from the first sample to the last, as a function of how many equal parts it is evaluated in, and the
    spectrum of the rest, continued as an odd function; of its frequencies the highest is 0."""
    y = jnp.asarray(values)
    y = y if jnp.issubdtype(y.dtype, jnp.floating) else y.astype(jnp.result_type(float))

    def line(parts):
        ramp = jnp.linspace(0, 1, parts + 1, dtype=y.dtype).reshape(-1, *(1,) * (y.ndim - 1))
        return y[:1] + (y[-1] - y[0])[None] * ramp

    rest = y - line(y.shape[0] - 1)
    return line, jnp.fft.rfft(jnp.concatenate([rest, -rest[-2:0:-1]]), axis=0)


def spline_gain_error(frequency, dt, order=3) -> float:
    """Relative error of the amplitude of a harmonic of `frequency` that `sampled(..., order)` reconstructs.

        order 0: 1 - sinc(f dt), late by dt/2 besides,    order 1: 1 - sinc^2(f dt),
        order 3: 1 - 3 sinc^4(f dt)/(2 + cos(2 pi f dt)),    sinc x = sin(pi x)/(pi x)

    Args:
        frequency: in Hz, at most half the sampling rate. dt: sampling period in s. order: 0, 1 or 3.

    Returns:
        A number; 0.01 is an amplitude that is off by 1 %.

    Raises:
        TypeError, ValueError: an argument out of its range.

    References:
        Unser, Aldroubi, Eden, IEEE Trans. Signal Process. 41 (1993): the response of the cardinal spline.

    >>> [f"{spline_gain_error(68.0, 1 / 610.35, order):.1e}" for order in (1, 3)]     # Silverbox at its resonance
    ['4.0e-02', '3.7e-04']
    """
    require_number("spline_gain_error", "dt", dt, lambda x: x > 0, "be positive")
    require_number("spline_gain_error", "frequency", frequency, lambda f: 0 <= f * dt <= 0.5, "be below 1/(2 dt)")
    if order not in (0, 1, 3) or not is_real(order):
        raise ValueError(f"spline_gain_error: `order` must be 0, 1 or 3; received {order!r}.")
    sinc = float(np.sinc(frequency * dt))
    return 1 - sinc ** (order + 1) if order < 3 else 1 - 3 * sinc**4 / (2 + float(np.cos(2 * np.pi * frequency * dt)))
