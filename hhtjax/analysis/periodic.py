"""Periodic motions by shooting: forced vibrations and limit cycles, with Floquet multipliers for their stability."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.analysis.roots import root
from hhtjax.checks import require_integer, require_number, require_params
from hhtjax.description import Array, PyTree, Real, all_concrete, thaw
from hhtjax.description.presentation import shown
from hhtjax.runs.inputs import Problem
from hhtjax.runs.simulate import simulate
from hhtjax.runs.solution import Solution
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems.interop import ode
from hhtjax.systems.system import AnySystem
from hhtjax.xla import Programs

CLOSED = 1e-8  # largest `left` of a motion that counts as periodic; about 1e-3 in float32
MOVES = 1e-6  # least motion of a limit cycle, relative to the size of q


@shown
class PeriodicSolution(NamedTuple):
    """Result of `periodic_solution`.

    Attributes:
        q, v, z: the state at t0, like q0, v0, z0; for a first-order system y, None, None.
        period: T.
        orbit: the motion over one period from this state, a `Solution` with every step.
        monodromy: d(state at t0 + T)/d(state at t0), (N, N); the state holds the numbers of q, then v, then z.
        left: the largest difference between the end of the period and its start, relative to the largest value during
            the period or at the given start; the largest of q, v and z.
        converged: whether `left` is at most 1e-8 (about 1e-3 in float32). With `find_period` the motion must also be
            more than an equilibrium.
        autonomous: whether the period was unknown, that is, `find_period`.
    """

    q: PyTree
    v: PyTree
    z: PyTree
    period: Array
    orbit: Solution
    monodromy: Array
    left: Array
    converged: Array
    autonomous: Any

    @property
    def multipliers(self) -> np.ndarray:
        """Floquet multipliers (N,), the eigenvalues of `monodromy`, largest modulus first: a small disturbance grows by
        these factors in each period. Values below 1e-14 times the norm of `monodromy` are rounding. A NumPy array;
        under jit use `monodromy`."""
        found = np.linalg.eigvals(np.asarray(self.monodromy))
        return np.take_along_axis(found, np.argsort(-np.abs(found), axis=-1, kind="stable"), axis=-1)

    @property
    def stable(self) -> np.ndarray:
        """Whether small disturbances die out, that is, all multipliers lie inside the unit circle. A limit cycle has
        one multiplier of 1, which is left out. Motions without damping are not stable in this sense: their multipliers
        lie on the circle."""
        found = self.multipliers
        size = np.abs(found)
        if np.any(self.autonomous):
            np.put_along_axis(size, np.argmin(np.abs(found - 1), axis=-1, keepdims=True), 0, axis=-1)
        return np.all(size < 1 - np.sqrt(np.finfo(found.dtype).eps), axis=-1)

    def check(self):
        """Raises ValueError if no periodic motion was found. Call it outside jit."""
        if np.all(self.converged):
            return
        left = np.asarray(self.left)
        if np.all(left <= _enough(left.dtype)):
            raise ValueError(
                "periodic_solution: an equilibrium was found, or a period of 0. Start from a point that the motion "
                "passes, such as the end of a run."
            )
        raise ValueError(
            f"periodic_solution: none was found: the motion misses its start by {np.max(left):.3g} of its size. "
            "Start nearer, such as from the end of a run over some periods. An angle that turns is not periodic."
        )


def periodic_solution(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    period: Real,
    num_steps: int,
    find_period: bool = False,
    t0: Real = 0.0,
    z0: PyTree = None,
) -> PeriodicSolution:
    """A motion near (q0, v0) that repeats itself after the period T, found by shooting:

        state(t0 + T) = state(t0),    and with find_period    f0 . (state(t0) - (q0, v0, z0)) = 0

    with state = (q, v, z) after num_steps steps of T/num_steps, and f0 the rate of the state at (q0, v0, z0). The
    second equation selects one point of the limit cycle as the start. The Levenberg-Marquardt method solves both with
    the exact derivative of the run. It finds unstable motions, too.

    The computed motion repeats to rounding. It differs from the exact motion by the error of the stepper: some hundred
    steps of `tsit5` or `dop853` are accurate, `hht` needs more. A run of `hht` over many periods differs from it by
    that error, too, because only the first step of such a run starts from the acceleration of the equations of motion.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`, without constraints, rotations, dry friction and
            contact.
        stepper, q0, v0, params, t0, z0: as in `simulate`. The start must be near the periodic motion. For a stable
            motion use the end of a run over several periods, at a time near t0 + k T.
        period: T. For a driven motion it is the period of the force, or a multiple for a subharmonic. It may depend on
            params. With `find_period` it is an initial guess.
        num_steps: number of steps in a period.
        find_period: whether the period is unknown, too, as for a limit cycle. The system must then not depend on time.

    Returns:
        A `PeriodicSolution`: q, v, period, `orbit` (one period, a `Solution`), `monodromy`, `multipliers`, `stable`.
        If the motion is isolated, its arrays have derivatives with respect to params and period, forward and reverse,
        by the implicit function theorem. An undamped free vibration is not isolated: it belongs to a family, and its
        derivatives have no meaning. Under jit no error is raised: check `converged`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; no periodic motion was found.
        NotImplementedError: a constraint, rotations, dry friction or contact.

    References:
        Nayfeh, Balachandran, Applied Nonlinear Dynamics, 1995, Ch. 6; Seydel, Practical Bifurcation and Stability
        Analysis, 2010, Ch. 7.

    >>> import jax.numpy as jnp, hhtjax
    >>> van_der_pol = hhtjax.System(jnp.ones(1), lambda q, v, t, params: (1 - q**2) * v - q)
    >>> found = hhtjax.analysis.periodic_solution(
    ...     van_der_pol, hhtjax.rk4(), jnp.array([2.0]), jnp.zeros(1), period=6.5, num_steps=400, find_period=True)
    >>> print(f"{found.period:.5f} {abs(found.multipliers[1]):.5f} {found.stable}")
    6.66329 0.00086 True
    """
    caller = "periodic_solution"
    problem = Problem.checked(caller, system, stepper, q0, v0, params, t0, z0)
    _require_smooth_coordinates(caller, problem)
    require_number(caller, "period", period, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    require_integer(caller, "num_steps", num_steps)
    start = problem.q0, problem.v0, problem.z0
    params = require_params(caller, params)
    found = _periodic(system, stepper, start, params, period, t0, num_steps=num_steps, find_period=bool(find_period))
    found = found._replace(autonomous=bool(find_period))
    if all_concrete(found):
        found.check()
    return found


def _require_smooth_coordinates(caller: str, problem: Problem):
    """Raises an error for a system whose state is not a vector, or may not start anywhere."""
    system = problem.system
    for name, advice in (
        ("constraint", "write it in minimal coordinates"),
        ("friction", "simulate until it repeats itself"),
        ("contact", "simulate until it repeats itself"),
    ):
        if getattr(system, name, None) is not None:
            raise NotImplementedError(f"{caller}: `system` has {name}: {advice}.")
    if problem.v0 is not None and problem.rates() != problem.numbers():
        raise NotImplementedError(f"{caller}: `q0` has rotations: write them as angles or rotation vectors.")


@partial(Programs, static_argnames=("num_steps", "find_period"))
def _periodic(
    system: AnySystem,
    stepper: Stepper,
    start: tuple,
    params: PyTree,
    period: Real,
    t0: Real,
    *,
    num_steps: int,
    find_period: bool,
) -> PeriodicSolution:
    y0, unravel = ravel_pytree(start)
    N = y0.size
    given = jnp.asarray(period).astype(y0.dtype)

    def period_of(x: Array) -> Array:
        return given * jnp.exp(x[N]) if find_period else given  # positive

    def run(x: Array, save_every: int) -> tuple[Array, Solution]:
        """The state at the end, and the run to it."""
        q, v, z = unravel(x[:N])
        steps = {"dt": period_of(x) / num_steps, "num_steps": num_steps, "save_every": save_every}
        orbit = simulate(system, stepper, q, v, thaw(params), z0=z, t0=t0, **steps)
        return jnp.concatenate(_parts(orbit, start), axis=1)[-1], orbit

    def missed(x: Array) -> Array:
        gap = run(x, num_steps)[0] - x[:N]
        return jnp.concatenate([gap, jnp.sum(flow * (x[:N] - y0))[None]]) if find_period else gap

    flow = _flow(system, start, t0, params) if find_period else y0
    x = root(missed, jnp.concatenate([y0, jnp.zeros(int(find_period), y0.dtype)]))
    monodromy, orbit = jax.jacfwd(lambda y: run(jnp.concatenate([y, x[N:]]), 1), has_aux=True)(x[:N])
    left, moves = _judged(_parts(orbit, start), start)
    converged = (left <= _enough(y0.dtype)) & ((moves > MOVES) | (not find_period))
    q, v, z = unravel(x[:N])
    return PeriodicSolution(q, v, z, period_of(x), orbit, monodromy, left, converged, find_period)


def _flow(system: AnySystem, start: tuple, t0: Real, params: PyTree) -> Array:
    """The direction in which the state moves at the start, of length 1."""
    given = [x for x in start if x is not None]
    rate, _ = ravel_pytree(ode(system)(t0, given if len(given) > 1 else given[0], thaw(params)))
    return rate / jnp.maximum(jnp.linalg.norm(rate), jnp.finfo(rate.dtype).tiny)


def _parts(run: Solution, start: tuple) -> list[Array]:
    """Those of q, v and z that the system has, as arrays (K + 1, numbers)."""
    found = [x for x, given in zip((run.q, run.v, run.z), start, strict=True) if given is not None]
    return [jnp.concatenate([x.reshape(len(run.t), -1) for x in jax.tree.leaves(part)], axis=1) for part in found]


def _judged(parts: list[Array], start: tuple) -> tuple[Array, Array]:
    """How far the end of the period is from its start, and how far q moves from its start. Both are relative to the
    largest value, also of the given start, and have no derivatives."""

    def largest(x: Array) -> Array:
        return jnp.max(jnp.abs(lax.stop_gradient(x)))

    begun = [ravel_pytree(x)[0] for x in start if x is not None]
    sizes = [jnp.maximum(largest(x), largest(y)) for x, y in zip(parts, begun, strict=True)]
    sizes = [jnp.maximum(size, jnp.finfo(size.dtype).tiny) for size in sizes]
    left = [largest(x[-1] - x[0]) / size for x, size in zip(parts, sizes, strict=True)]
    return jnp.max(jnp.stack(left)), largest(parts[0] - parts[0][:1]) / sizes[0]


def _enough(dtype: Any) -> float:
    """The largest `left` of a motion that counts as periodic."""
    return max(CLOSED, 1e4 * float(jnp.finfo(dtype).eps))
