"""The effect of a step on a linear motion: damping, periods, stability. All from the real step, by autodiff.

The amplification matrix A is the derivative of one step. Increments are scaled by the step size h, so that the entries
of A stay of order one for every h:

    x = (q, h v, h^2 w, h^2 a, h^2 L, memory, z, h zdot, h za),    x1 = A x.

x has the fields of the stepper's `State` that are not None. On the test oscillator

    w = -2 zeta W v - W^2 q,    W = (natural frequency) h,  zeta: damping ratio,  h = 1,

A depends only on W and zeta. A component on which the next step does not depend adds a zero column and a zero
eigenvalue, for example w of the steppers with alpha_f = 0. Without it, A is the matrix on (q, h v, h^2 a) of the
literature.

Eigenvalues come from LAPACK, so these functions run on the CPU.

H. Hilber, T. Hughes, R. Taylor, Earthquake Eng. Struct. Dyn. 5, 1977; A. Cardona, M. Geradin, Computers & Structures
33, 1989, Sec. 2; T. Hughes, The Finite Element Method, 1987, Ch. 9.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_number, require_params
from hhtjax.description import Array, PyTree, Real, is_array, is_concrete, is_real
from hhtjax.steppers.stepper import State, Stepper, begun, require_stepper, require_system
from hhtjax.systems import kinematics
from hhtjax.systems.system import AnySystem, FirstOrderSystem, System

INFINITE = 1e17  # a frequency whose inverse is lost in rounding, and whose square fits into float32


def _oscillator_force(q: Array, v: Array, t: Array, params: PyTree) -> Array:
    c, k = params
    return -c * v - k * q


def _nothing(q: Array, v: Array, t: Array, params: PyTree) -> Array:
    return jnp.zeros_like(v)


def _itself(q: Array, t: Array, params: PyTree) -> Array:
    return q


def _complex_product(y: Array, t: Array, z: Array) -> Array:
    """z y, with y = (Re, Im)."""
    return jnp.stack([z.real * y[0] - z.imag * y[1], z.imag * y[0] + z.real * y[1]])


OSCILLATOR = System(np.ones(1), _oscillator_force)
CONSTRAINT = System(np.ones(1), _nothing, _itself)
TEST_EQUATION = FirstOrderSystem(_complex_product)


def amplification_matrix(
    system: AnySystem, stepper: Stepper, state: State, params: PyTree = None, *, dt: Real
) -> jax.Array:
    """The amplification matrix A, (k, k): the derivative of one step at a state with respect to x,

        x = (q, h v, h^2 w, h^2 a, h^2 L, memory, z, h zdot, h za);    for a first-order system (q, h v, h a, memory).

    The system may be nonlinear or constrained. Near an equilibrium, or for a small dt, A shows how perturbations of a
    run grow. Each constraint adds the eigenvalues of infinite frequency, for every dt. Fields that are None are left
    out. So is memory that a step does not change, like the tangent that `operator_splitting` keeps. For a rotation, q
    is the displacement: R exp(q).

    Args:
        system, stepper, params, dt: as in `simulate`.
        state: a `State`, from `stepper.init` or `stepper.step`. The first two steps of `houbolt` and `park` are those
            of another method.

    The function is differentiable, and can be used under jit and vmap.

    Returns:
        A, (k, k).

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.LinearSystem(M=jnp.ones(1), K=jnp.full(1, 4.0))
    >>> euler = hhtjax.implicit_euler()
    >>> state = euler.init(spring, jnp.zeros(1), jnp.zeros(1), None, dt=0.5)
    >>> A = hhtjax.analysis.amplification_matrix(spring, euler, state, dt=0.5)
    >>> print(A[:2, :2])                                             # of (q, h v): 1/(1 + (2 h)^2) [[1, 1], [-1, 1]]
    [[ 0.5  0.5]
     [-0.5  0.5]]
    """
    require_system("amplification_matrix", system)
    require_stepper("amplification_matrix", stepper)
    if not isinstance(state, State):
        raise TypeError(f"amplification_matrix: `state` must be a State, as of stepper.init; received {state!r}.")
    require_number("amplification_matrix", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    params = require_params("amplification_matrix", params)
    return _amplification_matrix(system, stepper, jax.tree.map(jnp.asarray, state), params, dt)


@jax.jit
def _amplification_matrix(system: AnySystem, stepper: Stepper, state: State, params: PyTree, dt: Array) -> Array:
    q, unravel_q = ravel_pytree(state.q)
    blocks = kinematics.layout(state.q, state.v)
    x, unravel = _floats(state._replace(t=None, q=jax.tree.map(jnp.zeros_like, state.v)))

    def step(state: State) -> State:
        return stepper.step(system, state, params, dt)[0]

    def increments(x: Array) -> Array:
        s = unravel(x)
        dq, _ = ravel_pytree(s.q)
        s1 = step(s._replace(t=state.t, q=unravel_q(kinematics.move(blocks, q, dq))))
        q1, _ = ravel_pytree(s1.q)
        return _floats(s1._replace(t=None, q=_tangent_part(blocks, q1, dq)))[0]

    h = jnp.asarray(dt).astype(q.dtype)
    weights = (1, h, h, h, h, 1) if isinstance(system, FirstOrderSystem) else (1, h, h**2, h**2, h**2, 1)
    weights = weights if state.z is None else (*weights, 1, h, h)
    sizes = [_floats(field)[0].size for field in unravel(x)[1 : len(weights) + 1]]
    scale = jnp.concatenate([jnp.full(n, w, q.dtype) for n, w in zip(sizes, weights, strict=True)])
    A = scale[:, None] * jax.jacfwd(increments)(x) / scale[None, :]
    if state.memory is None:
        return A
    kept = _carried(step, state, unravel(x))
    return A[kept][:, kept]


def _floats(tree: PyTree):
    """All floating numbers of a pytree as a vector, and the function that inserts such a vector again."""
    leaves, structure = jax.tree.flatten(tree)
    at = [i for i, x in enumerate(leaves) if jnp.issubdtype(x.dtype, jnp.floating)]
    x, unravel = ravel_pytree([leaves[i] for i in at])

    def beside(x: Array) -> State:
        changed = dict(zip(at, unravel(x), strict=True))
        return structure.unflatten([changed.get(i, leaf) for i, leaf in enumerate(leaves)])

    return x, beside


def _tangent_part(blocks: tuple, q1: Array, like: PyTree) -> Array:
    """A linear function of q1 whose derivative is the displacement of q1; computed with the transpose of `rate`."""
    at = jax.lax.stop_gradient(q1)
    rate = partial(kinematics.rate, blocks, at)
    transpose = jax.linear_transpose(rate, like)
    (norms,) = transpose(rate(jnp.ones_like(like)))  # 1, and 2 for rotations
    return transpose(q1)[0] / norms


def _carried(step: Callable, state: State, increments: State) -> np.ndarray:
    """Which increments belong to fields that a step changes: (k,), bool."""
    jaxpr = jax.make_jaxpr(step)(state).jaxpr
    changed = [after is not before for before, after in zip(jaxpr.invars, jaxpr.outvars, strict=True)]
    fields = zip(jax.tree.leaves(increments), changed[1:], strict=True)  # without t
    return np.concatenate([np.full(x.size, c) for x, c in fields if jnp.issubdtype(x.dtype, jnp.floating)])


def oscillator_matrix(stepper: Stepper, frequency: Real, damping: Real = 0.0) -> jax.Array:
    """A of the test oscillator, (k, k), on those of (q, h v, h^2 w, h^2 a, memory) that the stepper's state has.

    Args:
        stepper: any stepper.
        frequency: W = (natural frequency) h, positive; jnp.inf for the limit.
        damping: zeta, the damping ratio.

    The function is differentiable, and can be used under jit and vmap.

    Returns:
        A, (k, k).

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    References:
        Cardona, Geradin (1989), Eq. 36-41. The limit for alpha = 0, on (q, h v, h^2 a), whose powers are Eq. 48:

    >>> import jax.numpy as jnp, hhtjax
    >>> A = hhtjax.analysis.oscillator_matrix(hhtjax.newmark(), jnp.inf)
    >>> print(A[jnp.ix_(jnp.array([0, 1, 3]), jnp.array([0, 1, 3]))].round(6) + 0.0)
    [[ 0.  0.  0.]
     [-2. -1.  0.]
     [-4. -4. -1.]]
    """
    require_stepper("oscillator_matrix", stepper)
    return oscillator_tangent(stepper, *oscillator_params("oscillator_matrix", frequency, damping))


def at_rest(system: AnySystem, stepper: Stepper, zero: Array, params: PyTree, dt: Real) -> State:
    """The state at rest, after the first steps if the stepper begins with another method."""
    v = None if isinstance(system, FirstOrderSystem) else zero
    state = begun("at_rest", system, stepper, zero, v, None, params, dt)
    for _ in range(stepper.first_steps):
        state, _ = stepper.step(system, state, params, dt)
    return state


@jax.jit
def oscillator_tangent(stepper: Stepper, c: Array, k: Array) -> Array:
    """A of the oscillator with damping c and stiffness k, at rest; h = 1."""
    state = at_rest(OSCILLATOR, stepper, jnp.zeros(1, c.dtype), (c, k), 1.0)
    return amplification_matrix(OSCILLATOR, stepper, state, (c, k), dt=1.0)


def oscillator_params(caller: str, frequency: Real, damping: Real):
    """c = 2 zeta W, k = W^2."""
    W = require_real(caller, "frequency", frequency, lambda x: x > 0, "be positive")
    zeta = require_real(caller, "damping", damping, np.isfinite, "be finite").astype(W.dtype)
    W = jnp.minimum(W, INFINITE)
    return 2 * zeta * W, W**2


def constraint_matrix(stepper: Stepper) -> jax.Array:
    """A of one coordinate with the constraint q = 0, on (q, h v, h^2 w, h^2 a, h^2 L): (5, 5), the same for all h.

    Every constrained system at an equilibrium has this matrix on B q, B v, B w, B a, once for each constraint. In the
    index-3 form it is the limit of `oscillator_matrix`, with L = w. For HHT its eigenvalues are

        index3    alpha/(1 + alpha), and -(1 + alpha)/(1 - alpha) twice in one Jordan block: multipliers overshoot,
                  and grow linearly for alpha = 0
        ggl       alpha/(1 + alpha), and -(1 - gamma)/gamma = -(1/2 + alpha)/(1/2 - alpha) once

    and zeros.

    Args:
        stepper: one of the `hht` family, or `conventional_hht`.

    Returns:
        A, (5, 5).

    Raises:
        TypeError: not a stepper. NotImplementedError: a stepper that does not support constraints.

    References:
        Cardona, Geradin (1989), Eq. 42.

    >>> import hhtjax
    >>> A = hhtjax.analysis.constraint_matrix(hhtjax.hht(alpha=-0.1, formulation="index3"))
    >>> [(round(x.value.real, 6) + 0.0, x.blocks) for x in hhtjax.analysis.jordan_structure(A)]
    [(-0.818182, (2,)), (-0.111111, (1,)), (0.0, (1, 1))]
    """
    require_stepper("constraint_matrix", stepper)
    return _constraint(stepper)


@jax.jit
def _constraint(stepper: Stepper) -> Array:
    zero = jnp.zeros(1)
    state = begun("constraint_matrix", CONSTRAINT, stepper, zero, zero, None, None, 1.0)
    return amplification_matrix(CONSTRAINT, stepper, state, dt=1.0)


@jax.jit
def eigenvalues(stepper: Stepper, c: Array, k: Array) -> Array:
    """Eigenvalues for each c and k, broadcast: (..., size)."""

    def single(c: Array, k: Array) -> Array:
        return jnp.linalg.eigvals(oscillator_tangent(stepper, c, k))

    return jnp.vectorize(single, signature="(),()->(n)")(c, k)


def oscillator_roots(caller: str, stepper: Stepper, frequency: Real, damping: Real) -> Array:
    """Eigenvalues of `oscillator_matrix`, after a check of the arguments."""
    require_stepper(caller, stepper)
    return eigenvalues(stepper, *oscillator_params(caller, frequency, damping))


# ----------------------------------------------------------------------------
# Checks of arguments.


def require_real(caller: str, name: str, value: Real, valid: Callable, expectation: str) -> Array:
    """A real scalar or array, of a float dtype, its values checked unless it is a tracer."""
    value = value if is_array(value) else np.asarray(value)
    if not is_real(value):
        raise TypeError(f"{caller}: `{name}` must be real; received {value!r}.")
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value!r}.")
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))


def require_matrix(caller: str, matrix: Array) -> np.ndarray:
    """A square, finite matrix of real numbers, as a NumPy array."""
    A = np.asarray(matrix)
    if not is_real(A):
        raise TypeError(f"{caller}: `matrix` must be real; received {matrix!r}.")
    if A.ndim != 2 or A.shape[0] != A.shape[1] or not A.size or not np.all(np.isfinite(A)):
        raise ValueError(f"{caller}: `matrix` must be square and finite; received shape {A.shape}: {matrix!r}.")
    return A


# ----------------------------------------------------------------------------
# Quantities from the amplification matrix: spectral radius, damping, period, overshoot, stability region.


def _principal_rate(caller: str, stepper: Stepper, frequency: Real, damping: Real) -> Array:
    """log of the slowest decaying eigenvalue among those that oscillate; NaN if none oscillates."""
    roots = oscillator_roots(caller, stepper, frequency, damping)
    slowest = jnp.argmax(jnp.where(roots.imag > 0, jnp.abs(roots), -1), axis=-1)
    principal = jnp.take_along_axis(roots, slowest[..., None], axis=-1)[..., 0]
    return jnp.log(jnp.where(principal.imag > 0, principal, jnp.nan))


def spectral_radius(stepper: Stepper, frequency: Real, damping: Real = 0.0) -> jax.Array:
    """Spectral radius: the largest modulus of the eigenvalues of `oscillator_matrix`.

    In the long run it is the factor by which each step multiplies an oscillation. Above 1 the stepper is unstable.

    It is accurate to 1e-10 up to W = 1e6, with exceptions. At W > 1e4 three eigenvalues of `generalized_alpha` and of
    `kim_hht(0.0)` are close to each other, and rounding in A leaves an error of 1e-8 (1e-5 for rho_inf = 0). With a
    linearisation at the "state", w is rounded to W^2 q. At infinity eigenvalues coincide (two for HHT):
    `jordan_structure` computes them to rounding.

    Args:
        stepper, frequency, damping: as in `oscillator_matrix`; frequency and damping may be arrays.

    Returns:
        An array with the broadcast shape of frequency and damping.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.spectral_radius(hhtjax.hht(alpha=-0.1), jnp.array([0.1, 10.0, jnp.inf])).round(6))
    [0.999999 0.837803 0.818182]
    """
    return jnp.max(jnp.abs(oscillator_roots("spectral_radius", stepper, frequency, damping)), axis=-1)


def damping_ratio(stepper: Stepper, frequency: Real, damping: Real = 0.0) -> jax.Array:
    """Damping ratio of the oscillator in the steps: -Re(r)/|r| with r = log(principal eigenvalue).

    For damping = 0 it is the numerical damping of the method. The principal eigenvalue is the slowest decaying one of
    those that oscillate. The result is NaN if none oscillates, as for strongly damping methods at large frequencies.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        An array with the broadcast shape of frequency and damping; NaN where no eigenvalue oscillates.

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


def period_elongation(stepper: Stepper, frequency: Real, damping: Real = 0.0) -> jax.Array:
    """Relative error of the natural period, W/|r| - 1 with r = log(principal eigenvalue) as in `damping_ratio`.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        An array with the broadcast shape of frequency and damping; NaN where no eigenvalue oscillates.

    Raises:
        TypeError, ValueError: as `spectral_radius`.

    >>> import hhtjax
    >>> round(float(hhtjax.analysis.period_elongation(hhtjax.hht(alpha=-0.05), 0.1)), 6)        # 0.000833 for alpha = 0
    0.000948
    """
    rate = _principal_rate("period_elongation", stepper, frequency, damping)
    return jnp.asarray(frequency).astype(rate.real.dtype) / jnp.abs(rate) - 1


def overshoot(stepper, frequency, damping=0.0) -> jax.Array:
    """Largest factor by which the first step raises |(W q, h v)|, the square root of the energy.

    The step starts from a state as in `simulate`. For the exact motion and for the trapezoidal rule the factor is at
    most 1. HHT overshoots in velocity, in proportion to W. Such a peak decays in the next steps, unlike growth due to a
    spectral radius above 1.

    Args:
        stepper, frequency, damping: as in `spectral_radius`.

    Returns:
        An array with the broadcast shape of frequency and damping.

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
    """Spectral radius of the step for y' = lambda y at the complex numbers z = h lambda. It is stable where this is <=
    1.

    Components that do not influence y are left out, for example the a of `kim_hht`.

    Args:
        stepper: any stepper.
        z: complex or real numbers, an array of any shape.

    Returns:
        An array shaped like z.

    Raises:
        TypeError, ValueError: not a stepper; z has numbers that are not finite.

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
def _stability_region(stepper: Stepper, z: Array) -> Array:
    def radius(z: Array) -> Array:
        state = at_rest(TEST_EQUATION, stepper, jnp.zeros(2, z.real.dtype), z, 1.0)
        A = amplification_matrix(TEST_EQUATION, stepper, state, z, dt=1.0)
        A = jax.lax.complex(A[::2, ::2], A[1::2, ::2])  # the real form of complex numbers, undone
        felt = jnp.arange(len(A)) == 0  # by y
        for _ in A:
            felt = felt | jnp.any(felt[:, None] & (jnp.abs(A) > 1e-12), axis=0)
        return jnp.max(jnp.abs(jnp.linalg.eigvals(jnp.where(felt[:, None] & felt[None, :], A, 0))))

    return jnp.vectorize(radius)(z)
