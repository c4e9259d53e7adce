"""What a step does to a linear motion: damping, periods, stability, order. All from the step itself, by autodiff.

The tangent of one step, in increments scaled by the step size h so that its entries stay of order one for every h,

    x = (q, h v, h^2 w, h^2 a, h^2 L, memory),    x1 = A x,

has what a stepper carries: those fields of its `State` that are not None. On the test oscillator

    w = -2 zeta W v - W^2 q,    W = (natural frequency) h,  zeta: damping ratio,  h = 1,

A depends on W and zeta only. A component that no later one depends on adds a column and an eigenvalue of zeros: w of
the steppers with alpha_f = 0, for example. Without it, A is the matrix on (q, h v, h^2 a) of the literature.

Eigenvalues come from LAPACK, so these functions run on the CPU.

H. Hilber, T. Hughes, R. Taylor, Earthquake Eng. Struct. Dyn. 5, 1977; A. Cardona, M. Geradin, Computers & Structures
33, 1989, Sec. 2; T. Hughes, The Finite Element Method, 1987, Ch. 9.
"""

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax import kinematics
from hhtjax.boundary import require_number
from hhtjax.constraints import acceleration_and_multipliers, jacobian
from hhtjax.description import is_array, is_concrete, is_real
from hhtjax.flat_system import flatten, initial_values
from hhtjax.steppers.stepper import State, Stepper, require_capable
from hhtjax.system import FirstOrderSystem, LinearSystem, System

INFINITE = 1e17  # a frequency whose inverse is lost in rounding, and whose square fits into float32

# of suggest_step_size
GRID = np.geomspace(1e-5, 1e6, 600)  # |lambda| h
NYQUIST = 3.0  # |lambda| h beyond which no motion is followed
STABLE_RADIUS = 1 + 1e-5  # what rounding makes of a double eigenvalue 1 stays below
RIGID = 1e-7  # |lambda| relative to the largest that counts as zero


def _oscillator_force(q, v, t, params):
    c, k = params
    return -c * v - k * q


def _nothing(q, v, t, params):
    return jnp.zeros_like(v)


def _itself(q, t, params):
    return q


def _complex_product(y, t, z):
    """z y, with y = (Re, Im)."""
    return jnp.stack([z.real * y[0] - z.imag * y[1], z.imag * y[0] + z.real * y[1]])


OSCILLATOR = System(np.ones(1), _oscillator_force)
CONSTRAINT = System(np.ones(1), _nothing, _itself)
TEST_EQUATION = FirstOrderSystem(_complex_product)


def amplification_matrix(stepper, system, state, params=None, *, dt):
    """A, the derivative of one step at a state, with respect to x = (q, h v, h^2 w, h^2 a, h^2 L, memory): (k, k).

    Constrained or not: of a nonlinear system it is the tangent of the flow of the step, which near an equilibrium, or
    for a small dt, tells how perturbations of the run grow. There each constraint adds the eigenvalues of infinite
    frequency, whatever dt is. Fields that are None are left out, and so is memory that a step hands on unchanged, like
    the tangent that `operator_splitting` keeps. Of a rotation, q is the displacement: R exp(q).

    Args:
        stepper, system, params, dt: as in `simulate`.
        state: a `State`, of `stepper.init` or `stepper.step`.

    Differentiable; goes under jit and vmap.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.LinearSystem(M=jnp.ones(1), K=jnp.full(1, 4.0))
    >>> euler = hhtjax.implicit_euler()
    >>> state = euler.init(spring, jnp.zeros(1), jnp.zeros(1), None, dt=0.5)
    >>> A = hhtjax.analysis.amplification_matrix(euler, spring, state, dt=0.5)
    >>> print(A[:2, :2])                                             # of (q, h v): 1/(1 + (2 h)^2) [[1, 1], [-1, 1]]
    [[ 0.5  0.5]
     [-0.5  0.5]]
    """
    _require_stepper("amplification_matrix", stepper)
    if not isinstance(system, (System, LinearSystem, FirstOrderSystem)):
        raise TypeError(
            f"amplification_matrix: `system` must be a System, LinearSystem or FirstOrderSystem; received {system!r}."
        )
    if not isinstance(state, State):
        raise TypeError(f"amplification_matrix: `state` must be a State, as of stepper.init; received {state!r}.")
    require_number("amplification_matrix", "dt", dt, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    return _amplification_matrix(stepper, system, jax.tree.map(jnp.asarray, state), params, dt)


@jax.jit
def _amplification_matrix(stepper, system, state, params, dt):
    q, unravel_q = ravel_pytree(state.q)
    blocks = kinematics.layout(state.q, state.v)
    x, unravel = ravel_pytree(state._replace(t=None, q=jax.tree.map(jnp.zeros_like, state.v)))

    def step(state):
        return stepper.step(system, state, params, dt)[0]

    def increments(x):
        s = unravel(x)
        dq, _ = ravel_pytree(s.q)
        s1 = step(s._replace(t=state.t, q=unravel_q(kinematics.move(blocks, q, dq) if blocks else q + dq)))
        q1, _ = ravel_pytree(s1.q)
        return ravel_pytree(s1._replace(t=None, q=_tangent_part(blocks, q1, dq) if blocks else q1))[0]

    h = jnp.asarray(dt).astype(q.dtype)
    weights = (1, h, h, h, h, 1) if isinstance(system, FirstOrderSystem) else (1, h, h**2, h**2, h**2, 1)
    sizes = [ravel_pytree(field)[0].size for field in unravel(x)[1:]]
    scale = jnp.concatenate([jnp.full(n, w, q.dtype) for n, w in zip(sizes, weights, strict=True)])
    A = scale[:, None] * jax.jacfwd(increments)(x) / scale[None, :]
    if state.memory is None:
        return A
    kept = _carried(step, state, unravel(x))
    return A[kept][:, kept]


def _tangent_part(blocks, q1, like):
    """A linear function of q1 whose derivative is the displacement of q1, through the transpose of `rate`."""
    at = jax.lax.stop_gradient(q1)
    rate = partial(kinematics.rate, blocks, at)
    transpose = jax.linear_transpose(rate, like)
    (norms,) = transpose(rate(jnp.ones_like(like)))  # 1, and 2 for rotations
    return transpose(q1)[0] / norms


def _carried(step, state, increments):
    """Which increments belong to fields that a step changes: (k,), bool."""
    jaxpr = jax.make_jaxpr(step)(state).jaxpr
    changed = [after is not before for before, after in zip(jaxpr.invars, jaxpr.outvars, strict=True)]
    leaves = jax.tree.leaves(increments)
    return np.concatenate([np.full(x.size, c) for x, c in zip(leaves, changed[1:], strict=True)])  # without t


def oscillator_matrix(stepper, frequency, damping=0.0):
    """A of the test oscillator, on (q, h v, h^2 w, h^2 a, memory) as far as the stepper carries them: (k, k).

    Args:
        frequency: W = (natural frequency) h, positive; jnp.inf for the limit.
        damping: zeta, the damping ratio.

    Differentiable; goes under jit and vmap.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    References:
        Cardona, Geradin (1989), Eq. 36-41. The limit for alpha = 0, on (q, h v, h^2 a), whose powers are Eq. 48:

    >>> import jax.numpy as jnp, hhtjax
    >>> A = hhtjax.analysis.oscillator_matrix(hhtjax.newmark(), jnp.inf)
    >>> print(A[jnp.ix_(jnp.array([0, 1, 3]), jnp.array([0, 1, 3]))] + 0.0)
    [[ 0.  0.  0.]
     [-2. -1.  0.]
     [-4. -4. -1.]]
    """
    _require_stepper("oscillator_matrix", stepper)
    return _oscillator(stepper, *_oscillator_params("oscillator_matrix", frequency, damping))


@jax.jit
def _oscillator(stepper, c, k):
    zero = jnp.zeros(1, c.dtype)
    state = stepper.init(OSCILLATOR, zero, zero, (c, k), 1.0)
    return amplification_matrix(stepper, OSCILLATOR, state, (c, k), dt=1.0)


def _oscillator_params(caller, frequency, damping):
    """c = 2 zeta W, k = W^2."""
    W = _real(caller, "frequency", frequency, lambda x: x > 0, "be positive")
    zeta = _real(caller, "damping", damping, np.isfinite, "be finite").astype(W.dtype)
    W = jnp.minimum(W, INFINITE)
    return 2 * zeta * W, W**2


def constraint_matrix(stepper):
    """A of one coordinate that a constraint holds, q = 0, on (q, h v, h^2 w, h^2 a, h^2 L): (5, 5), the same for all h.

    On B q, B v, B w, B a any constrained system at an equilibrium has this matrix, once for each constraint. In the
    index-3 form it is the limit of `oscillator_matrix`, with L = w. For HHT its eigenvalues are

        index3    alpha/(1 + alpha), and -(1 + alpha)/(1 - alpha) twice in one Jordan block: multipliers overshoot,
                  and grow linearly for alpha = 0
        ggl       alpha/(1 + alpha), and -(1 - gamma)/gamma = -(1/2 + alpha)/(1/2 - alpha) once

    and zeros.

    Raises:
        TypeError: no stepper. NotImplementedError: one that cannot solve constraints.

    References:
        Cardona, Geradin (1989), Eq. 42.

    >>> import hhtjax
    >>> A = hhtjax.analysis.constraint_matrix(hhtjax.hht(alpha=-0.1, formulation="index3"))
    >>> [(round(x.value.real, 6) + 0.0, x.blocks) for x in hhtjax.analysis.jordan_structure(A)]
    [(-0.818182, (2,)), (-0.111111, (1,)), (0.0, (1, 1))]
    """
    _require_stepper("constraint_matrix", stepper)
    return _constraint(stepper)


@jax.jit
def _constraint(stepper):
    zero = jnp.zeros(1)
    state = stepper.init(CONSTRAINT, zero, zero, None, 1.0)
    return amplification_matrix(stepper, CONSTRAINT, state, dt=1.0)


@jax.jit
def _roots(stepper, c, k):
    """Eigenvalues for each c and k, broadcast: (..., size)."""
    return jnp.vectorize(lambda c, k: jnp.linalg.eigvals(_oscillator(stepper, c, k)), signature="(),()->(n)")(c, k)


def _oscillator_roots(caller, stepper, frequency, damping):
    _require_stepper(caller, stepper)
    return _roots(stepper, *_oscillator_params(caller, frequency, damping))


def _principal_rate(caller, stepper, frequency, damping):
    """log of the root that oscillates fastest; NaN where none oscillates."""
    roots = _oscillator_roots(caller, stepper, frequency, damping)
    principal = jnp.take_along_axis(roots, jnp.argmax(roots.imag, axis=-1)[..., None], axis=-1)[..., 0]
    return jnp.log(jnp.where(principal.imag > 0, principal, jnp.nan))


def spectral_radius(stepper, frequency, damping=0.0):
    """Largest modulus of the eigenvalues of `oscillator_matrix`: of the shape of frequency and damping, broadcast.

    To 1e-10, up to W = 1e6. But at W > 1e4 three roots of `generalized_alpha` and of `kim_hht(0.0)` come close to each
    other, and rounding in A leaves 1e-8 (1e-5 for rho_inf = 0); and a linearisation at the "state" rounds w to W^2 q.
    At infinity, where roots meet (those of HHT in two), `jordan_structure` tells them to rounding.

    Args:
        frequency, damping: as in `oscillator_matrix`, or arrays of them.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.spectral_radius(hhtjax.hht(alpha=-0.1), jnp.array([0.1, 10.0, jnp.inf])).round(6))
    [0.999999 0.837803 0.818182]
    """
    return jnp.max(jnp.abs(_oscillator_roots("spectral_radius", stepper, frequency, damping)), axis=-1)


def damping_ratio(stepper, frequency, damping=0.0):
    """The damping ratio that the discrete oscillator has, -Re(r)/|r| with r = log(principal eigenvalue).

    For damping = 0 all of it is the method's. The principal eigenvalue is the one that oscillates fastest; NaN where
    none oscillates, as with the strongly damping methods at large frequencies.

    Args, raises: as in `spectral_radius`.

    References:
        Hughes (1987), Sec. 9.1.3.

    >>> import hhtjax
    >>> f"{hhtjax.analysis.damping_ratio(hhtjax.hht(alpha=-0.05), 0.1):.1e}"
    '5.6e-06'
    """
    rate = _principal_rate("damping_ratio", stepper, frequency, damping)
    return -rate.real / jnp.abs(rate)


def period_elongation(stepper, frequency, damping=0.0):
    """Relative error of the natural period, W/|r| - 1 with r = log(principal eigenvalue) as in `damping_ratio`.

    Args, raises: as in `spectral_radius`.

    >>> import hhtjax
    >>> round(float(hhtjax.analysis.period_elongation(hhtjax.hht(alpha=-0.05), 0.1)), 6)        # 0.000833 for alpha = 0
    0.000948
    """
    rate = _principal_rate("period_elongation", stepper, frequency, damping)
    return jnp.asarray(frequency).astype(rate.real.dtype) / jnp.abs(rate) - 1


def overshoot(stepper, frequency, damping=0.0):
    """Largest factor by which the first step, from a start as in `simulate`, raises |(W q, h v)|, the root of energy.

    At most 1 for the motion itself and for the trapezoidal rule. HHT overshoots in velocity, in proportion to W; such
    a peak decays with the next steps, unlike what a spectral radius above 1 raises.

    Args, raises: as in `spectral_radius`.

    References:
        Hilber, Hughes, Earthquake Eng. Struct. Dyn. 6 (1978) 99-117.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.overshoot(hhtjax.hht(alpha=-0.3), jnp.array([0.1, 10.0, 100.0])).round(4))
    [1.     1.2136 5.4732]
    """
    _require_stepper("overshoot", stepper)
    return _overshoot(stepper, *_oscillator_params("overshoot", frequency, damping))


@jax.jit
def _overshoot(stepper, c, k):
    def factor(c, k):
        W = jnp.sqrt(k)

        def step(x):
            state = stepper.init(OSCILLATOR, x[:1] / W, x[1:], (c, k), 1.0)
            state, _ = stepper.step(OSCILLATOR, state, (c, k), 1.0)
            return jnp.concatenate([W * state.q, state.v])

        return jnp.linalg.norm(jax.jacfwd(step)(jnp.zeros(2, c.dtype)), 2)

    return jnp.vectorize(factor)(c, k)


def stability_region(stepper, z):
    """Spectral radius of the step for y' = lambda y at z = h lambda, complex; stable where it is <= 1. Shaped like z.

    Of what y feels: not of the a of `kim_hht`, for example, whose recursion y never meets.

    Raises:
        TypeError, ValueError: no stepper; z not of finite numbers.

    References:
        Kim et al. (2019), Eq. 15-22, Fig. 1-2.

    >>> import jax.numpy as jnp, hhtjax
    >>> print(hhtjax.analysis.stability_region(hhtjax.kim_hht(alpha=0.0), jnp.array([-1.0, 1j, 1.0 + 1j])).round(6))
    [0.333333 1.       2.236068]
    """
    _require_stepper("stability_region", stepper)
    z = z if is_array(z) else np.asarray(z)
    if not (is_real(z) or jnp.issubdtype(z.dtype, jnp.complexfloating)):
        raise TypeError(f"stability_region: `z` must be numbers; received {z!r}.")
    if is_concrete(z) and not np.all(np.isfinite(z)):
        raise ValueError(f"stability_region: `z` must be finite; received {z!r}.")
    z = jnp.asarray(z)
    return _stability_region(stepper, z if jnp.iscomplexobj(z) else jax.lax.complex(*2 * [z]))


@jax.jit
def _stability_region(stepper, z):
    def radius(z):
        state = stepper.init(TEST_EQUATION, jnp.zeros(2, z.real.dtype), None, z, 1.0)
        A = amplification_matrix(stepper, TEST_EQUATION, state, z, dt=1.0)
        A = jax.lax.complex(A[::2, ::2], A[1::2, ::2])  # the real form of complex numbers, undone
        felt = jnp.arange(len(A)) == 0  # by y
        for _ in A:
            felt = felt | jnp.any(felt[:, None] & (jnp.abs(A) > 1e-12), axis=0)
        return jnp.max(jnp.abs(jnp.linalg.eigvals(jnp.where(felt[:, None] & felt[None, :], A, 0))))

    return jnp.vectorize(radius)(z)


class Eigenvalue(NamedTuple):
    """value; blocks: the sizes of its Jordan blocks, the largest first. Only blocks of 1: as many eigenvectors."""

    value: complex
    blocks: tuple[int, ...]


def jordan_structure(matrix, tolerance=1e-3) -> tuple[Eigenvalue, ...]:
    """The distinct eigenvalues with their Jordan blocks, the largest modulus first; NumPy, on concrete values.

    Rounding scatters an eigenvalue with a block of size k by a k-th root of itself, but not the mean of what it
    becomes. Eigenvalues closer than `tolerance` count as one, their mean mu, and the ranks of (A - mu I)^j tell the
    blocks; a singular value counts as zero below tolerance^2 times the largest possible.

    Raises:
        TypeError, ValueError: no real square matrix; a tolerance that is not in (0, 1); eigenvalues within the
            tolerance of each other that the ranks do not confirm as one.

    >>> A = [[2.0, 1.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 2.0]]
    >>> [(round(x.value.real, 6), x.blocks) for x in jordan_structure(A)]
    [(2.0, (2, 1))]
    """
    A = _require_matrix("jordan_structure", matrix)
    require_number("jordan_structure", "tolerance", tolerance, lambda x: 0 < x < 1, "lie in (0, 1)")
    found, values = [], list(np.linalg.eigvals(A))
    while values:
        cluster = [max(values, key=abs)]
        for x in cluster:  # grows as it goes: neighbours of neighbours
            near = [y for y in values if abs(y - x) <= tolerance * max(1, abs(x)) and y not in cluster]
            cluster += near
        members = [x for x in values if x in cluster]
        values = [x for x in values if x not in cluster]
        found.append(Eigenvalue(complex(np.mean(members)), _blocks(A, members, tolerance)))
    return tuple(found)


def _blocks(A, members, tolerance):
    N = A - np.mean(members) * np.eye(len(A))
    nullities, power = [0], np.eye(len(A))
    while nullities[-1] < len(members) and len(nullities) <= len(members):
        power = power @ N
        small = tolerance**2 * np.linalg.norm(N, 2) ** len(nullities)
        nullities.append(int(np.sum(np.linalg.svd(power, compute_uv=False) <= small)))
    at_least = np.diff(nullities)  # number of blocks of size 1, 2, ... and more
    if nullities[-1] != len(members) or np.any(np.diff(at_least) > 0):
        raise ValueError(
            f"jordan_structure: the eigenvalues {np.array(members)} lie within tolerance={tolerance:g} of each other, "
            "but are not one; take a smaller tolerance."
        )
    return tuple(int(np.sum(at_least > i)) for i in range(at_least[0]))


def transient_growth(matrix, num_steps, near=None):
    """|D23| of Cardona, Geradin (1989), Fig. 1, from the powers of A, for n = 0 .. num_steps: (num_steps + 1,).

    What A^n does in the invariant subspace of an eigenvalue mu beyond multiplying by mu^n, relative to the first step:
    |A^n - mu^n I|/|A - mu I| there. For Jordan blocks of size 2 this is n |mu|^(n-1), which peaks near n = -1/ln|mu|;
    without a block it is zero.

    Args:
        matrix, num_steps: A; n at the end. near: mu is the eigenvalue nearest to it, by default the largest.

    Raises: as `jordan_structure`, and ValueError for a num_steps that is not a positive integer.

    >>> import hhtjax
    >>> A = hhtjax.analysis.constraint_matrix(hhtjax.hht(alpha=-0.1, formulation="index3"))
    >>> growth = transient_growth(A, 20)
    >>> int(growth.argmax()), round(float(growth.max()), 3)
    (5, 2.241)
    """
    A = _require_matrix("transient_growth", matrix)
    if not isinstance(num_steps, (int, np.integer)) or isinstance(num_steps, bool) or num_steps < 1:
        raise ValueError(f"transient_growth: `num_steps` must be a positive integer; received {num_steps!r}.")
    found = jordan_structure(A)
    value, blocks = found[0] if near is None else min(found, key=lambda x: abs(x.value - near))
    if blocks[0] == 1:
        return np.zeros(num_steps + 1)
    N = A - value * np.eye(len(A))
    _, _, Vh = np.linalg.svd(np.linalg.matrix_power(N, blocks[0]))
    V = Vh[-sum(blocks) :].conj().T  # an orthonormal basis of the invariant subspace
    growth, x = np.zeros(num_steps + 1), V
    for n in range(1, num_steps + 1):
        x = A @ x
        growth[n] = np.linalg.norm(V.conj().T @ x - value**n * np.eye(V.shape[1]), 2)
    return growth / growth[1]


class ObservedOrder(NamedTuple):
    """dt: step sizes (k,); error: 2-norms of the error of q at the end, or of its change; slope between neighbours."""

    dt: Any
    error: Any
    slope: Any


def observed_order(
    system, stepper, q0, v0=None, params=None, *, duration, num_steps, reference=None, t0=0.0
) -> ObservedOrder:
    """Order of convergence of q at t0 + duration, from runs with each of `num_steps` steps.

    Args:
        system, stepper, q0, v0, params, t0: as in `simulate`.
        duration: s. num_steps: increasing integers, such as (100, 200, 400).
        reference: q at the end, like q0. Without it, what counts is the change from each run to the next, one number
            less, with the same slope; num_steps must then be a geometric sequence.

    Returns:
        An `ObservedOrder`. Slopes are dlog(error)/dlog(dt); they are worth something where dt resolves the motion and
        the error is well above rounding.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    >>> found = hhtjax.analysis.observed_order(
    ...     spring, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), duration=1.0, num_steps=(10, 20, 40))
    >>> print(found.slope.round(2))
    [3.95]
    """
    _require_stepper("observed_order", stepper)
    require_number("observed_order", "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    counts, fewest = np.asarray(num_steps), 3 if reference is None else 2
    if (
        counts.ndim != 1
        or counts.dtype.kind != "i"
        or len(counts) < fewest
        or counts[0] < 1
        or np.any(np.diff(counts) < 1)
    ):
        raise ValueError(
            f"observed_order: `num_steps` must be increasing positive integers, {fewest} or more; received {num_steps}."
        )
    ratios = counts[1:] / counts[:-1]
    if reference is None and np.ptp(ratios) > 1e-9:
        raise ValueError(
            "observed_order: `num_steps` must be a geometric sequence where there is no `reference`; "
            f"received {num_steps!r}."
        )
    q0, v0 = initial_values("observed_order", system, q0, v0)
    ends = [
        np.asarray(_end(system, stepper, q0, v0, params, float(t0), float(duration) / n, n)) for n in counts.tolist()
    ]
    if reference is None:
        error = np.array([np.linalg.norm(x - y) for x, y in pairwise(ends)])
    else:
        exact = np.asarray(ravel_pytree(reference)[0])
        if exact.shape != ends[0].shape:
            raise ValueError(
                f"observed_order: `reference` must hold q at the end, {ends[0].size} numbers; received {exact.size}."
            )
        error = np.array([np.linalg.norm(x - exact) for x in ends])
    slope = np.diff(np.log(error)) / -np.log(ratios[: len(error) - 1])
    return ObservedOrder(float(duration) / counts[: len(error)], error, slope)


@jax.jit
def _end(system, stepper, q0, v0, params, t0, dt, num_steps):
    """q at the end as a vector; one compilation for all numbers of steps."""
    state = stepper.init(system, q0, v0, params, dt, t0)
    state = jax.lax.fori_loop(0, num_steps, lambda _, s: stepper.step(system, s, params, dt)[0], state)
    return ravel_pytree(state.q)[0]


class Mode(NamedTuple):
    """A mode of the linearised system, and what the stepper makes of it at the suggested step.

    frequency: |lambda|, natural frequency in rad/s, or rate of a motion that does not oscillate; damping_ratio: -1 for
    pure growth, 1 for pure decay.
    largest_dt: up to which the stepper keeps to the tolerance.
    numerical_damping_ratio, period_elongation: of the discrete mode; NaN where one of the two does not oscillate.
    resolved: whether the suggested step is below largest_dt.
    """

    frequency: float
    damping_ratio: float
    largest_dt: float
    numerical_damping_ratio: float
    period_elongation: float
    resolved: bool


class StepSize(NamedTuple):
    """dt in s; reason: what limits it; modes: slowest first. As text, a table."""

    dt: float
    reason: str
    modes: tuple[Mode, ...]

    def __str__(self):
        rows = [["rad/s", "damping ratio", "largest dt", "w h", "its damping ratio", "its period", ""]]
        for mode in self.modes:
            swings = mode.period_elongation == mode.period_elongation  # no NaN
            rows.append(
                [
                    f"{mode.frequency:.4g}",
                    f"{mode.damping_ratio:.3g}",
                    f"{mode.largest_dt:.3g} s",
                    f"{mode.frequency * self.dt:.3g}",
                    f"{mode.numerical_damping_ratio:.3g}" if swings else "-",
                    f"{100 * mode.period_elongation:+.3g} %" if swings else "-",
                    "resolved" if mode.resolved else "not resolved",
                ]
            )
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(x.rjust(w) for x, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        return "\n".join([f"dt = {self.dt:.3g} s: {self.reason}", *lines])


def suggest_step_size(system, stepper, q0, v0, params=None, *, tolerance=1e-2, highest=None, t0=0.0) -> StepSize:
    """A step size that resolves the modes of the system linearised at a state, with what each mode then suffers.

    Small motions x about the state obey  M xddot + C xdot + K x = 0,  C = -Q_v,  K = (M w - Q - B^T L)_q,  and B x = 0
    where there are constraints. Each solution exp(lambda t) becomes powers of an eigenvalue mu of the stepper's
    oscillator, and counts as resolved where |log(mu)/(lambda h) - 1| <= tolerance: the errors of period and of
    damping ratio together. (A real lambda is put into xddot = lambda xdot.) The step is the largest that resolves

        highest = None    every mode that oscillates or grows, or where none does, the slowest decay;
        highest           every mode of |lambda| <= highest, in rad/s,

    and for which no mode that decays grows in the steps, resolved or not.

    Args:
        system, stepper, q0, v0, params, t0: as in `simulate`; no `FirstOrderSystem`. Modes change along the way, so
            take the stiffest state of the motion. They are those of the frozen state: where it moves fast, they also
            depend on the choice of coordinates.
        tolerance: in (0, 1).

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; a system without a time scale of its own; a
            tolerance out of reach; JAX in single precision.
        NotImplementedError: constraints or rotations that the stepper does not know.

    Example: masses on a soft and on a stiff spring. The stiff one dictates, unless it is given up.

    >>> import jax.numpy as jnp, hhtjax
    >>> system = hhtjax.LinearSystem(M=jnp.ones(2), C=jnp.array([0.1, 0.0]), K=jnp.array([1.0, 1e4]))
    >>> found = suggest_step_size(system, hhtjax.hht(alpha=-0.05), jnp.zeros(2), jnp.zeros(2), highest=10.0)
    >>> print(found)
    dt = 0.316 s: resolves the mode at 1 rad/s to 0.01
    rad/s  damping ratio  largest dt    w h  its damping ratio  its period
        1           0.05     0.316 s  0.316             0.0492    +0.934 %      resolved
      100              0   0.00316 s   31.6             0.0329      +949 %  not resolved
    """
    caller = "suggest_step_size"
    _require_stepper(caller, stepper)
    if not isinstance(system, (System, LinearSystem)):
        raise TypeError(f"{caller}: `system` must be a System or LinearSystem; received {system!r}.")
    require_number(caller, "tolerance", tolerance, lambda x: 0 < x < 1, "lie in (0, 1)")
    if highest is not None:
        require_number(caller, "highest", highest, lambda x: x > 0, "be positive")
    if jnp.result_type(float) != jnp.float64:
        raise ValueError(f"{caller}: needs double precision: call jax.config.update('jax_enable_x64', True) first.")
    q0, v0 = initial_values(caller, system, q0, v0)
    require_capable(caller, system, stepper, q0, v0)
    rates = _rates(*map(np.asarray, _linearize(system, q0, v0, params, t0)))
    if not len(rates):
        raise ValueError(f"{caller}: the `system` has no time scale of its own at q0, v0: take another state.")
    size, moves = np.abs(rates), (rates.imag > 0) | (rates.real > 0)
    chosen = size <= highest if highest is not None else moves if moves.any() else size == size[0]
    if not chosen.any():
        raise ValueError(f"{caller}: `highest` must reach the slowest mode, {size[0]:.4g} rad/s; received {highest}.")

    reach = []
    for rate in rates:
        error, radius = _errors(stepper, rate / abs(rate))
        reach.append((_reach(error > tolerance), _reach(radius > STABLE_RADIUS) if rate.real <= 0 else np.inf))
    resolved, stable = np.transpose(reach) / size
    limits = np.concatenate([np.where(chosen, resolved, np.inf), stable])
    which = int(np.argmin(limits))
    dt, mode = float(limits[which]), f"the mode at {size[which % len(size)]:.4g} rad/s"
    if not dt:
        raise ValueError(f"{caller}: no step keeps {mode} within tolerance={tolerance:g}, or stable.")
    reason = f"resolves {mode} to {tolerance:g}" if which < len(size) else f"with more, {mode} grows"

    modes = []
    for rate, largest in zip(rates, resolved, strict=True):
        W, zeta = abs(rate), -rate.real / abs(rate) + 0.0
        fake, late = (
            float(f(stepper, W * dt, zeta)) if rate.imag else np.nan for f in (damping_ratio, period_elongation)
        )
        modes.append(Mode(float(W), float(zeta), float(largest), fake, late, bool(dt <= largest)))
    return StepSize(dt, reason, tuple(modes))


@jax.jit
def _linearize(system, q0, v0, params, t0):
    """Derivatives of w in displacement and velocity, (n, n), and B, (m, n)."""
    flat, q, v = flatten("suggest_step_size", system, q0, v0, t0, params)
    t = jnp.asarray(t0).astype(q.dtype)

    def acceleration(x, v):
        at = flat.move(q, x), v, t, params
        return acceleration_and_multipliers(flat, *at)[0] if flat.num_constraints else flat.acceleration(*at)

    B = jacobian(flat, q, t, params) if flat.num_constraints else jnp.zeros((0, v.size), v.dtype)
    return *jax.jacfwd(acceleration, argnums=(0, 1))(jnp.zeros_like(v), v), B


def _rates(w_x, w_v, B):
    """lambda of the motions that satisfy B x = 0, one of each conjugate pair, slowest first; without rigid motions."""
    N = np.linalg.svd(B)[2][len(B) :].T if len(B) else np.eye(len(w_x))
    zero = np.zeros((N.shape[1], N.shape[1]))
    A = np.block([[zero, np.eye(len(zero))], [N.T @ w_x @ N, N.T @ w_v @ N]])
    rates = np.linalg.eigvals(A)
    swings = abs(np.imag(rates)) > 1e-6 * abs(rates)
    rates = np.where(swings, rates, np.real(rates))
    rates = rates[(np.imag(rates) >= 0) & (abs(rates) > RIGID * abs(rates).max(initial=0))]
    return rates[np.argsort(abs(rates))]


def _errors(stepper, direction):
    """|log(mu)/(lambda h) - 1| and the spectral radius for lambda of unit modulus on GRID: (grid,) each."""
    lambda_h, followed = direction * GRID, GRID <= NYQUIST
    c, k = (-2 * lambda_h.real, GRID**2) if direction.imag else (-lambda_h.real, 0 * GRID)
    roots = np.asarray(_roots(stepper, c, k))
    nearest = np.argmin(abs(roots - np.exp(np.where(followed, lambda_h, 0))[:, None]), axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = abs(np.log(roots[np.arange(len(GRID)), nearest]) / lambda_h - 1)
    return np.where(followed, error, np.inf), abs(roots).max(axis=-1)


def _reach(bad):
    """The last of GRID before the first bad one; 0 if that is the first, inf if none is."""
    first = bad.argmax()
    return np.inf if not bad.any() else GRID[first - 1] if first else 0.0


def _real(caller, name, value, valid, expectation):
    """A real scalar or array, of a float dtype, its values checked unless it is a tracer."""
    value = value if is_array(value) else np.asarray(value)
    if not is_real(value):
        raise TypeError(f"{caller}: `{name}` must be real; received {value!r}.")
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        raise ValueError(f"{caller}: `{name}` must {expectation}; received {value!r}.")
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))


def _require_stepper(caller, stepper):
    if not isinstance(stepper, Stepper):
        raise TypeError(f"{caller}: `stepper` must be a stepper such as hht(); received {stepper!r}.")


def _require_matrix(caller, matrix):
    A = np.asarray(matrix)
    if not is_real(A):
        raise TypeError(f"{caller}: `matrix` must be real; received {matrix!r}.")
    if A.ndim != 2 or A.shape[0] != A.shape[1] or not A.size or not np.all(np.isfinite(A)):
        raise ValueError(f"{caller}: `matrix` must be square and finite; received shape {A.shape}: {matrix!r}.")
    return A
