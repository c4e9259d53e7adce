"""A system on vectors, as the steppers use it, and the checks of what its functions return."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jax.scipy.linalg import block_diag

from hhtjax.checks import check_like, check_matrix, count, describe, evaluate, telling_of_arguments
from hhtjax.description import Array, PyTree, Real, thaw
from hhtjax.numerics.dense_lu import LOOPED, by_factors, factorize, full_matrix, matvec
from hhtjax.numerics.linear_solve import factorize_map, reuse, solver
from hhtjax.numerics.sparse_lu import SparseLU
from hhtjax.numerics.sparse_matrix import Sparse, combined
from hhtjax.primitives import consistent
from hhtjax.systems import kinematics
from hhtjax.systems.assembly import ElementForce
from hhtjax.systems.contact import FlatContact, flat_contact
from hhtjax.systems.element_matrix import StepMatrix
from hhtjax.systems.elements import parts_of
from hhtjax.systems.friction import FrictionLaw, flat_friction
from hhtjax.systems.held_nodes import Held, at, staying
from hhtjax.systems.linear_system import with_known_matrices
from hhtjax.systems.matrices import as_matrix
from hhtjax.systems.step_sparsity import Sparsity, of_elements
from hhtjax.systems.system import DynamicsMass, FirstOrderSystem, LinearSystem, mass_at, product_at, timed

if TYPE_CHECKING:
    from hhtjax.systems.system import System


LARGEST_WITH_FRICTION = 600  # unknowns of a system of elements


class FlatSystem(NamedTuple):
    """A system on vectors, as the steppers use it; made by `flatten`.

    An internal state is a rate without a position: v = (velocity, z) and w = (acceleration, zdot) hold N rates, of
    which the first n have positions. Their force is (Q, g), and the mass of z is 1. A first-order system is the case n
    = 0. q is (n,) too, except for rotations, for which it holds the matrices.

    params are always in the form that `freeze` returns, a pytree of arrays only, which branches and loops can carry.
    Before a user's function is called they are thawed to their original form.
    function gets them as the user gave them: whoever calls it thaws them.
    """

    mass: Callable  # q, t, params -> (n, n), or (n,) for a diagonal: of the rates that have positions
    force: Callable  # q, v, t, params -> (N,)
    size: int  # N, the number of rates
    positions: int  # n, how many of them have positions
    linear: bool  # the residual is affine in (q, v, w), with constant coefficients
    unravel: Callable  # vector -> pytree structured like q
    unravel_rates: Callable  # (n,) -> pytree structured like v
    unravel_internal: Callable | None = None  # (N - n,) -> pytree structured like z
    constraint: Any = None  # q, t, params -> (m,); None without
    num_constraints: int = 0  # m
    blocks: tuple = ()  # where the rotations are; empty without
    product: Callable | None = None  # q, w, t, params -> M w, where the system has its own
    balance: Callable | None = None  # q, v, w, t, params -> M w - Q (N,), where the system has it as one function
    local: Any = None  # the `Local` force beside a linear system
    friction: FrictionLaw | None = None  # dry friction, which `force` does not hold
    contact: FlatContact | None = None  # contacts, alike
    matrices: Callable | None = None  # params -> M, C, K, where one of them is `Sparse`
    settle: Callable | None = None  # params -> the same system for these, its sparse matrices evaluated once
    diagonals: Callable | None = None  # params -> M, C, K (None where absent), where all of them are diagonals (n,)
    massless: Array | None = None  # G with M G M = M, where M is singular
    factors: Factors | None = None  # `Factors` for the steps of a run, where they are known before it
    sparse: SparseLU | None = None  # the solve of a step whose unknowns are known to meet few others
    stays: np.ndarray | None = None  # which coordinates stay where they start, where constraints meet them
    step_elements: Callable | None = None  # params -> `SparseLU.elements`
    told: Callable | None = None  # state, params -> the state with what is held as it is told

    def settled(self, params: PyTree) -> FlatSystem:
        """The system with the result of `settle`, if there is anything to settle."""
        return self if self.settle is None else self.settle(params)

    def without_sparse_solve(self) -> FlatSystem:
        """The system with steps solved by full matrices, including its mass."""
        mass = self.mass

        def full(q: Array, t: Array, params: PyTree) -> Array:
            M = mass(q, t, params)
            return full_matrix(M) if isinstance(M, Sparse) else M

        return self._replace(mass=full, sparse=None)

    def step_matrix(self, params: PyTree, w: Array, v: Array, q: Array):
        """w M + v C + q K, a `Sparse` or a diagonal (n,), for scalar factors."""
        known = self.matrices or self.diagonals
        assert known is not None
        terms = [(x, A) for x, A in zip((w, v, q), known(params), strict=True) if A is not None]
        return combined(*terms) if self.matrices is not None else sum(x * A for x, A in terms)

    @property
    def knows_matrices(self) -> bool:
        """Whether `step_matrix` gives the matrix of a step, so that it need not be computed column by column."""
        return self.matrices is not None or self.diagonals is not None

    def inertia(self, q: Array, w: Array, t: Array, params: PyTree) -> Array:
        """M(q, t) w, and zdot."""

        def product(w: Array):
            return matvec(self.mass(q, t, params), w) if self.product is None else self.product(q, w, t, params)

        return self._of_positions(product, w)

    def residual(self, q: Array, v: Array, w: Array, t: Array, params: PyTree) -> Array:
        """M(q, t) w - Q(q, v, t), and zdot - g: zero along the motion, apart from the reactions of constraints."""
        if self.balance is not None:
            return self.balance(q, v, w, t, params)
        return self.inertia(q, w, t, params) - self.force(q, v, t, params)

    def acceleration(self, q: Array, v: Array, t: Array, params: PyTree, factorize: Callable = factorize) -> Array:
        """w = M(q, t)^-1 Q(q, v, t), and zdot."""
        M, Q = self.mass(q, t, params), self.force(q, v, t, params)
        return self.mass_solver(M, factorize)(Q)

    def mass_solver(self, M: Array, factorize: Callable = factorize):
        """The function Q -> M^-1 Q, which leaves entries for z unchanged; factorised once."""
        if self.massless is not None:
            return partial(self._of_positions, partial(matvec, jnp.asarray(self.massless).astype(M.dtype)))
        if self.factors is not None and self.factors.mass is not None:
            factorize = reuse(factorize, by_factors(self.factors.mass))
        if M.ndim == 1:
            return partial(self._of_positions, lambda Q: Q / M)
        if self.sparse is not None:
            product = partial(self._of_positions, partial(matvec, M))
            return factorize_map(product, jnp.zeros(self.size, M.dtype), self.sparse)
        inverse = solver(M, factorize)
        return partial(self._of_positions, inverse)

    def with_ones(self, d: Array) -> Array:
        """d (n,), the diagonal of M, and ones for z: (N,)."""
        return d if self.positions == self.size else jnp.concatenate([d, jnp.ones(self.size - self.positions, d.dtype)])

    def full_mass(self, q: Array, t: Array, params: PyTree) -> Array:
        """M(q, t), and ones for z, as a matrix (N, N)."""
        M = self.mass(q, t, params)
        if M.ndim == 1:
            return jnp.diag(self.with_ones(M))
        M = full_matrix(M)
        return M if self.positions == self.size else block_diag(M, jnp.eye(self.size - self.positions, dtype=M.dtype))

    def located(self, x: Array) -> Array:
        """The entries of a vector (N,) of rates that have positions."""
        return x if self.positions == self.size else x[: self.positions]

    def with_internal(self, x: Array, z: Array):
        """x, with the entries of internal states taken from z: (N,)."""
        n = self.positions
        return x if n in (0, self.size) else jnp.concatenate([x[:n], z[n:]])

    def widened(self, D: Array) -> Array:
        """A derivative (N, n) with respect to q as one with respect to displacements (N,), zero for entries of z."""
        return D if self.positions == self.size else jnp.pad(D, ((0, 0), (0, self.size - self.positions)))

    def move(self, q: Array, x: Array) -> Array:
        """q displaced by x (N,): q + x, and R exp(x) for rotations."""
        return kinematics.move(self.blocks, q, self._freed(self.located(x)))

    def rate(self, q: Array, v: Array) -> Array:
        """qdot: v, and R hat(v) for rotations."""
        return kinematics.rate(self.blocks, q, self._freed(self.located(v)))

    def _freed(self, x: Array) -> Array:
        """x with 0 for held coordinates, which reactions of constraints do not move."""
        return x if self.stays is None else jnp.where(self.stays, 0, x)

    def end_of_chart(self, x: Array, *rates: Array):
        """Velocity, acceleration and algorithmic acceleration, from first and second rates of the displacement x."""
        if not self.blocks:
            return rates
        ends = kinematics.end_of_chart(self.blocks, *map(self.located, (x, *rates)))
        return tuple(map(self.with_internal, ends, rates))

    def in_chart(self, x: Array, v: Array, w: Array) -> Array:
        """The second rate of the displacement x, given its first rate v and the acceleration w."""
        if not self.blocks:
            return w
        return self.with_internal(kinematics.in_chart(self.blocks, *map(self.located, (x, v, w))), w)

    def tidy(self, state):
        """The state at the end of a step, with held nodes at their prescribed positions, and rotations orthogonal to
        rounding."""
        state = state if self.told is None else self.told(state)
        return state._replace(q=kinematics.orthonormalize(self.blocks, state.q))

    def _of_positions(self, f: Callable, x: Array) -> Array:
        """f applied to the entries that have positions; the others unchanged."""
        n = self.positions
        if n == self.size:
            return f(x)
        return jnp.concatenate([f(x[:n]), x[n:]]) if n else x


class Factors(NamedTuple):
    """The LU factors of a linear system of constant matrices, by `panels.lu`: of M (None if diagonal), and of the
    matrices of the start and of the step."""

    mass: Any
    start: Any
    step: Any


class Local(NamedTuple):
    """The nonlinear force of a linear system."""

    linear: FlatSystem  # without it
    force: Callable  # q, v, t, params -> (k,), or (n,)
    spread: Callable  # (k,) -> (n,)
    size: int | None  # k; None where it acts on all coordinates


def flatten(caller: str, system, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree = None):
    """The system on vectors, and q0 and (v0, z0) as vectors. This is the only place where pytrees are ravelled.

    It runs while tracing, so its checks of shapes and structures cost nothing at run time.
    """
    with telling_of_arguments(caller, q0, v0, params):
        if isinstance(system, FirstOrderSystem):
            return _flatten_first_order(caller, system, q0, t0, params)
        return _flatten_second_order(caller, system, q0, v0, t0, params, z0)


def _flatten_second_order(caller: str, system, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree):
    q, unravel = ravel_pytree(q0)
    dtype = q.dtype
    v, unravel_rates = ravel_pytree(v0)
    n, blocks = v.size, kinematics.layout(q0, v0)
    if blocks and (isinstance(system, LinearSystem) or getattr(system.mass, "is_lagrangian", False)):
        raise NotImplementedError(
            f"{caller}: `from_lagrangian` does not support rotations in `q0`, because they are not linear coordinates: "
            "write a System(mass, force)."
        )
    constraint, m = None, 0
    if system.constraint is not None:
        m = count(caller, "constraint", system.constraint, None, dtype, q0, t0, params)
        constraint = consistent(partial(_flat_constraint, system.constraint, unravel, dtype))

    linear = isinstance(system, LinearSystem)
    _check_functions(caller, system, linear, n, dtype, q0, v0, t0, params, z0)

    def on_vectors(system) -> FlatSystem:
        mass, force = (partial(f, system, unravel, dtype) for f in (_flat_mass, partial(_flat_force, unravel_rates)))
        mass, force = consistent(mass) if callable(system.mass) else mass, consistent(force)
        flat = FlatSystem(mass, force, n, n, linear, unravel, unravel_rates, None, constraint, m, blocks)
        return _with_local(system, flat, dtype) if linear and system.nonlinear is not None else flat

    flat = on_vectors(system)
    if not linear and system.dynamics is not None:
        flat = _with_dynamics(caller, system, flat, dtype, q0, v0, t0, params, z0)
    if not linear and system.inertia is not None:
        at = q0, v0, *timed(system.inertia, 2, t0), params
        check_like(caller, "inertia", evaluate(caller, "inertia", system.inertia, *at), "v0", v0, dtype)
        product = partial(_flat_product, system, unravel, unravel_rates, dtype)
        flat = flat._replace(product=consistent(product))
    if linear:
        flat = flat._replace(massless=system.massless)
        flat = with_known_matrices(caller, system, flat, on_vectors, dtype, params)
    if system.internal is not None:
        flat, q, v = _with_internal(system, flat, q, v0, z0)
    if not linear and isinstance(system.force, ElementForce):
        flat = _with_elements(caller, system, flat, q0, v0, t0, params)
    if system.friction is not None:
        flat = flat._replace(friction=flat_friction(caller, system, flat, q0, v0, z0, t0, params))
    if system.contact is not None:
        flat = flat._replace(contact=flat_contact(caller, system.contact, flat, q0, v0, t0, params, dtype))
    return flat, q, v


def _with_elements(
    caller: str, system: System, flat: FlatSystem, q0: PyTree, v0: PyTree, t0: Real, params: PyTree
) -> FlatSystem:
    """The system with the solve that its elements allow, and with its held nodes."""
    force, constraint = system.force, system.constraint
    assert isinstance(force, ElementForce)
    like = jax.eval_shape(lambda *x: jax.tree.map(jnp.asarray, x), q0, v0, t0, params)
    if constraint is not None:
        flat = flat._replace(stays=staying(force.held, v0))
    joints = parts_of(None if constraint is None else constraint.joints)

    @cache
    def sparsity() -> Sparsity:
        return of_elements(parts_of(force.elements), force.mass.parts, joints, flat, like)

    def settle(params: PyTree) -> FlatSystem:
        return flat._replace(settle=None, told=partial(_told, force.held, flat, thaw(params)))

    unknowns = flat.size + flat.num_constraints
    if system.friction is not None and unknowns > LARGEST_WITH_FRICTION:
        raise NotImplementedError(
            f"{caller}: dry `friction` in a system of elements is solved with full matrices, up to "
            f"{LARGEST_WITH_FRICTION} unknowns; received {unknowns}. Write smooth friction into the elements, or take "
            "fewer of them."
        )
    if system.contact is not None and unknowns > LARGEST_WITH_FRICTION:
        raise NotImplementedError(
            f"{caller}: `contact` in a system of elements is solved with full matrices, up to {LARGEST_WITH_FRICTION} "
            f"unknowns; received {unknowns}. Take fewer of them."
        )
    if unknowns > LOOPED and system.friction is None and system.contact is None:
        matrix = cache(lambda: StepMatrix(force, flat, like[1], sparsity().plan(flat.size)))
        flat = flat._replace(sparse=SparseLU(sparsity), step_elements=lambda params: lambda *at: matrix()(params, *at))
    else:
        flat = flat.without_sparse_solve()
    return flat._replace(settle=settle) if force.held is not None and force.held.moves else flat


def _told(held: Held | None, flat: FlatSystem, params: PyTree, state):
    """A state with the positions and velocities of held nodes as prescribed."""
    q, v = at(held, flat.unravel(state.q), flat.unravel_rates(state.v), state.t, params)
    return state._replace(q=ravel_pytree(q)[0], v=ravel_pytree(v)[0])


def _with_dynamics(caller: str, system, flat: FlatSystem, dtype, q0: PyTree, v0: PyTree, t0: Real, params, z0: PyTree):
    """The system with its residual as one function, from which M w and M follow."""
    z = () if system.internal is None else (z0,)
    r = evaluate(caller, "dynamics", system.dynamics, q0, v0, v0, *z, t0, params)
    check_like(caller, "dynamics", r, "v0", v0, dtype)
    unravel, unravel_rates, n = flat.unravel, flat.unravel_rates, flat.size

    def balance(q: Array, v: Array, w: Array, t: Array, params: PyTree) -> Array:
        r = system.dynamics(unravel(q), unravel_rates(v), unravel_rates(w), t, thaw(params))
        return ravel_pytree(r)[0].astype(dtype)

    if z:
        return flat
    known = flat._replace(balance=consistent(balance))
    if not isinstance(system.mass, DynamicsMass):
        return known
    derived = system.mass

    def mass(q: Array, t: Array, params: PyTree) -> Array:
        return derived.matrix(unravel(q), jnp.zeros(n, dtype), unravel_rates, t, thaw(params)).astype(dtype)

    def product(q: Array, w: Array, t: Array, params: PyTree) -> Array:
        v = unravel_rates(jnp.zeros(n, dtype))
        return ravel_pytree(derived.product(unravel(q), v, unravel_rates(w), t, thaw(params)))[0].astype(dtype)

    return known._replace(mass=consistent(mass), product=consistent(product))


def _flat_mass(system: System, unravel: Callable, dtype: np.dtype, q: Array, t: Array, params: PyTree):
    return as_matrix(mass_at(system, unravel(q), t, thaw(params)), dtype)


def _flat_force(
    unravel_rates: Callable,
    system: System,
    unravel: Callable,
    dtype: np.dtype,
    q: Array,
    v: Array,
    t: Array,
    params: PyTree,
) -> Array:
    return ravel_pytree(system.force(unravel(q), unravel_rates(v), t, thaw(params)))[0].astype(dtype)


def _with_local(system, flat: FlatSystem, dtype: np.dtype) -> FlatSystem:
    """The system with its nonlinear force also available separately."""

    def linear_force(q: Array, v: Array, t: Array, params: PyTree) -> Array:
        Q = system.linear_force(flat.unravel(q), flat.unravel_rates(v), t, thaw(params))
        return ravel_pytree(Q)[0].astype(dtype)

    def local_force(q: Array, v: Array, t: Array, params: PyTree) -> Array:
        return system.local_force(flat.unravel(q), flat.unravel_rates(v), t, thaw(params)).astype(dtype)

    spread, size = partial(system.spread, n=flat.size), None if system.at is None else len(system.at)
    local = Local(flat._replace(force=consistent(linear_force)), consistent(local_force), spread, size)
    return flat._replace(linear=False, local=local)


def _with_internal(system, flat: FlatSystem, q: Array, v0: PyTree, z0: PyTree):
    """The system with internal states, which follow the velocities and their rates."""
    V, unravel = ravel_pytree((v0, z0))
    unravel_internal = ravel_pytree(z0)[1]

    def force(q: Array, V, t: Array, params: PyTree) -> Array:
        at = flat.unravel(q), *unravel(V), t, thaw(params)
        return ravel_pytree((system.force(*at), system.internal(*at)))[0].astype(V.dtype)

    def balance(q: Array, V: Array, W: Array, t: Array, params: PyTree) -> Array:
        (v, z), (w, rate), q, params = unravel(V), unravel(W), flat.unravel(q), thaw(params)
        left = jax.tree.map(jnp.subtract, rate, system.internal(q, v, z, t, params))
        return ravel_pytree((system.dynamics(q, v, w, z, t, params), left))[0].astype(V.dtype)

    flat = flat._replace(force=consistent(force), size=V.size, unravel_internal=unravel_internal)
    return (flat if system.dynamics is None else flat._replace(balance=consistent(balance))), q, V


def _flatten_first_order(caller: str, system: FirstOrderSystem, y0: PyTree, t0: Real, params: PyTree):
    """The system y' = rate: only internal states, without positions."""
    y, unravel = ravel_pytree(y0)
    n, dtype = y.size, y.dtype
    check_like(caller, "rate", evaluate(caller, "rate", system.rate, y0, t0, params), "q0", y0, dtype)

    def rate(q: Array, v: Array, t: Array, params: PyTree) -> Array:
        return ravel_pytree(system.rate(unravel(v), t, thaw(params)))[0].astype(dtype)

    def mass(q: Array, t: Array, params: PyTree) -> Array:
        return jnp.ones(0, dtype)

    return FlatSystem(mass, consistent(rate), n, 0, False, unravel, unravel), jnp.zeros(0, dtype), y


def _check_functions(
    caller: str,
    system,
    linear: bool,
    n: int,
    dtype: np.dtype,
    q0: PyTree,
    v0: PyTree,
    t0: Real,
    params: PyTree,
    z0: PyTree,
):
    """Checks the shapes of what the functions of a system return."""
    if linear:
        for name in ("M", "C", "K"):
            matrix = getattr(system, name)
            if matrix is not None:
                check_matrix(caller, name, matrix, n, dtype, params)
    else:
        if getattr(system.mass, "is_lagrangian", False):
            L = evaluate(caller, "lagrangian", system.mass.lagrangian, q0, v0, t0, params)
            if getattr(L, "shape", None) != ():
                raise ValueError(f"{caller}: `lagrangian` must give a scalar, of shape (); received {describe(L)}.")
        at = (q0, *timed(system.mass, 1, t0), params) if callable(system.mass) else ()
        if not isinstance(system.mass, DynamicsMass):
            check_matrix(caller, "mass", system.mass, n, dtype, *at)
    if linear and system.load is not None:
        Q = evaluate(caller, "force", system.load, t0, params)
    elif system.internal is None:
        function = system.linear_force if linear else system.force
        Q = evaluate(caller, "force", function, q0, v0, t0, params)
    else:
        Q = evaluate(caller, "force", system.force, q0, v0, z0, t0, params)
        zdot = evaluate(caller, "internal", system.internal, q0, v0, z0, t0, params)
        check_like(caller, "internal", zdot, "z0", z0, dtype)
    check_like(caller, "force", Q, "v0", v0, dtype)
    if linear and system.nonlinear is not None:
        _check_nonlinear(caller, system, n, dtype, q0, v0, t0, params)


def _check_nonlinear(caller: str, system, n: int, dtype: np.dtype, q0: PyTree, v0: PyTree, t0: Array, params: PyTree):
    """The nonlinear force of a linear system."""
    if system.at is None:
        like = "v0", v0
    elif max(system.at) >= n:
        raise ValueError(f"{caller}: `at` must hold numbers of coordinates below {n}; received {list(system.at)}.")
    else:
        some = jnp.zeros(len(system.at), dtype)
        q0, v0, like = some, some, ("v0[at]", some)
    check_like(caller, "nonlinear", evaluate(caller, "nonlinear", system.nonlinear, q0, v0, t0, params), *like, dtype)


def _flat_constraint(
    constraint: Callable, unravel: Callable, dtype: np.dtype, q: Array, t: Array, params: PyTree
) -> Array:
    return jnp.asarray(constraint(unravel(q), t, thaw(params))).astype(dtype)


def _flat_product(
    system: System,
    unravel: Callable,
    unravel_rates: Callable,
    dtype: np.dtype,
    q: Array,
    w: Array,
    t: Real,
    params: PyTree,
) -> Array:
    return ravel_pytree(product_at(system, unravel(q), unravel_rates(w), t, thaw(params)))[0].astype(dtype)
