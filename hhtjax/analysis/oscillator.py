"""Numbers and regions from the amplification matrix: radius, damping, period, overshoot, stability."""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.analysis.amplification import (
    OSCILLATOR,
    TEST_EQUATION,
    amplification_matrix,
    at_rest,
    oscillator_params,
    oscillator_roots,
)
from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.steppers.stepper import begun, require_stepper


def _principal_rate(caller, stepper, frequency, damping):
    """log of the root that decays slowest, of those that oscillate; NaN where none does."""
    roots = oscillator_roots(caller, stepper, frequency, damping)
    slowest = jnp.argmax(jnp.where(roots.imag > 0, jnp.abs(roots), -1), axis=-1)
    principal = jnp.take_along_axis(roots, slowest[..., None], axis=-1)[..., 0]
    return jnp.log(jnp.where(principal.imag > 0, principal, jnp.nan))


def spectral_radius(stepper, frequency, damping=0.0) -> jax.Array:
    """Largest modulus of the eigenvalues of `oscillator_matrix`: of the shape of frequency and damping, broadcast.

    To 1e-10, up to W = 1e6. But at W > 1e4 three roots of `generalized_alpha` and of `kim_hht(0.0)` come close to each
    other, and rounding in A leaves 1e-8 (1e-5 for rho_inf = 0); and a linearisation at the "state" rounds w to W^2 q.
    At infinity, where roots meet (those of HHT in two), `jordan_structure` tells them to rounding.

    Args:
        stepper, frequency, damping: as in `oscillator_matrix`, or arrays of the last two.

    Returns:
        Of the shape of frequency and damping, broadcast.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.spectral_radius(hhtjax.hht(alpha=-0.1), jnp.array([0.1, 10.0, jnp.inf])).round(6))
    [0.999999 0.837803 0.818182]
    """
    return jnp.max(jnp.abs(oscillator_roots("spectral_radius", stepper, frequency, damping)), axis=-1)


def damping_ratio(stepper, frequency, damping=0.0) -> jax.Array:
    """The damping ratio that the discrete oscillator has, -Re(r)/|r| with r = log(principal eigenvalue).

    For damping = 0 all of it is the method's. Of the eigenvalues that oscillate the principal one decays slowest; NaN
    where none oscillates, as with the strongly damping methods at large frequencies.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        Of the shape of frequency and damping, broadcast; NaN where none oscillates.

    Raises:
        TypeError, ValueError: as `spectral_radius`.

    References:
        Hughes (1987), Sec. 9.1.3.

    >>> import hhtjax
    >>> f"{hhtjax.analysis.damping_ratio(hhtjax.hht(alpha=-0.05), 0.1):.1e}"
    '5.6e-06'
    """
    rate = _principal_rate("damping_ratio", stepper, frequency, damping)
    return -rate.real / jnp.abs(rate)


def period_elongation(stepper, frequency, damping=0.0) -> jax.Array:
    """Relative error of the natural period, W/|r| - 1 with r = log(principal eigenvalue) as in `damping_ratio`.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        Of the shape of frequency and damping, broadcast; NaN where none oscillates.

    Raises:
        TypeError, ValueError: as `spectral_radius`.

    >>> import hhtjax
    >>> round(float(hhtjax.analysis.period_elongation(hhtjax.hht(alpha=-0.05), 0.1)), 6)        # 0.000833 for alpha = 0
    0.000948
    """
    rate = _principal_rate("period_elongation", stepper, frequency, damping)
    return jnp.asarray(frequency).astype(rate.real.dtype) / jnp.abs(rate) - 1


def overshoot(stepper, frequency, damping=0.0) -> jax.Array:
    """Largest factor by which the first step, from a start as in `simulate`, raises |(W q, h v)|, the root of energy.

    At most 1 for the motion itself and for the trapezoidal rule. HHT overshoots in velocity, in proportion to W; such
    a peak decays with the next steps, unlike what a spectral radius above 1 raises.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        Of the shape of frequency and damping, broadcast.

    Raises:
        TypeError, ValueError: as `spectral_radius`.

    References:
        Hilber, Hughes, Earthquake Eng. Struct. Dyn. 6 (1978) 99-117.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.overshoot(hhtjax.hht(alpha=-0.3), jnp.array([0.1, 10.0, 100.0])).round(4))
    [1.     1.2136 5.4732]
    """
    require_stepper("overshoot", stepper)
    return _overshoot(stepper, *oscillator_params("overshoot", frequency, damping))


@jax.jit
def _overshoot(stepper, c, k):
    def factor(c, k):
        W = jnp.sqrt(k)

        def step(x):
            state = begun("overshoot", OSCILLATOR, stepper, x[:1] / W, x[1:], None, (c, k), 1.0)
            state, _ = stepper.step(OSCILLATOR, state, (c, k), 1.0)
            return jnp.concatenate([W * state.q, state.v])

        return jnp.linalg.norm(jax.jacfwd(step)(jnp.zeros(2, c.dtype)), 2)

    return jnp.vectorize(factor)(c, k)


def stability_region(stepper, z) -> jax.Array:
    """Spectral radius of the step for y' = lambda y at z = h lambda, complex; stable where it is <= 1. Shaped like z.

    Of what y feels: not of the a of `kim_hht`, for example, whose recursion y never meets.

    Args:
        stepper: any.
        z: complex or real numbers, an array of any shape.

    Returns:
        Shaped like z.

    Raises:
        TypeError, ValueError: no stepper; z not of finite numbers.

    References:
        Kim et al. (2019), Eq. 15-22, Fig. 1-2.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.stability_region(hhtjax.kim_hht(alpha=0.0), jnp.array([-1.0, 1j, 1.0 + 1j])).round(6))
    [0.333333 1.       2.236068]
    """
    require_stepper("stability_region", stepper)
    z = z if is_array(z) else np.asarray(z)
    if not (is_real(z) or jnp.issubdtype(z.dtype, jnp.complexfloating)):
        raise TypeError(f"stability_region: `z` must be numbers; received {z!r}.")
    if is_concrete(z) and not np.all(np.isfinite(z)):
        raise ValueError(f"stability_region: `z` must be finite; received {z!r}.")
    z = jnp.asarray(z)
    if not jnp.iscomplexobj(z):
        real = z if jnp.issubdtype(z.dtype, jnp.floating) else z.astype(jnp.result_type(float))
        z = jax.lax.complex(real, jnp.zeros_like(real))
    return _stability_region(stepper, z)


@jax.jit
def _stability_region(stepper, z):
    def radius(z):
        state = at_rest(TEST_EQUATION, stepper, jnp.zeros(2, z.real.dtype), z, 1.0)
        A = amplification_matrix(TEST_EQUATION, stepper, state, z, dt=1.0)
        A = jax.lax.complex(A[::2, ::2], A[1::2, ::2])  # the real form of complex numbers, undone
        felt = jnp.arange(len(A)) == 0  # by y
        for _ in A:
            felt = felt | jnp.any(felt[:, None] & (jnp.abs(A) > 1e-12), axis=0)
        return jnp.max(jnp.abs(jnp.linalg.eigvals(jnp.where(felt[:, None] & felt[None, :], A, 0))))

    return jnp.vectorize(radius)(z)
