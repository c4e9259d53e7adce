"""The common parts of all steppers: the state, the report of a step, and the interface of a method."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import Array, Description, PyTree, Real, freeze
from hhtjax.description.presentation import known, shown
from hhtjax.numerics.batched_cond import call_where
from hhtjax.systems import kinematics, zero_order_hold
from hhtjax.systems.constraints import answers
from hhtjax.systems.flat_system import FlatSystem, flatten
from hhtjax.systems.friction_rows import depends, held_back
from hhtjax.systems.initial_conditions import initial_values
from hhtjax.systems.system import AnySystem, require_masses
from hhtjax.systems.system import require_system as require_system


@shown
class State(NamedTuple):
    """The data that the next step needs.

    Attributes:
        t: time.
        q, v: position and velocity; for a first-order system y and y'.
        w: acceleration, equal to M^-1 Q along the motion; None for a first-order system.
        a: algorithmic acceleration of the generalised-alpha recursion (algorithmic y' for a first-order system); None
            if the method has none.
        z, zdot, za: internal states, their rates and their algorithmic rates; None without internal states.
        L: multipliers (m,) of constraints; None without constraints.
        friction: `FrictionState`, the sliding directions and the forces of dry friction; None without dry friction.
        contact: `ContactState`; None without contacts.
        memory: other data that a method carries, on vectors; None if there are none.
    """

    t: Array
    q: PyTree
    v: PyTree
    w: PyTree
    a: PyTree = None
    L: Any = None
    memory: PyTree = None
    z: PyTree = None
    zdot: PyTree = None
    za: PyTree = None
    friction: PyTree = None
    contact: PyTree = None


@shown
class ContactState(NamedTuple):
    """The data of contacts that the next step needs.

    Attributes:
        f: (2 m,), the forces: first the normal forces, positive where they push, then the forces along the surfaces.
        closed: (m,), 1 where bodies touch, else 0.
        sig: (m,), the direction in which a closed contact slides: -1, 1, or 0 where it sticks.
        sticks: (m,), 1 where friction holds it, else 0.
        since: (m,), the time since which a closed contact has been closed, -inf if since the start.
        impacts: (m,), the number of impacts so far.
        code: 0, or what went wrong when the modes were chosen, which the next step reports.
    """

    f: Array
    closed: Array
    sig: Array
    sticks: Array
    since: Array
    impacts: Array
    code: Array

    def following(self, before: ContactState, t: Array) -> ContactState:
        """The state for a new start at t, with the history from before: impacts, and since when contacts have been
        closed."""
        return self._replace(since=jnp.where(before.closed > 0, before.since, t), impacts=before.impacts)


@shown
class FrictionState(NamedTuple):
    """The data of dry friction that the next step needs.

    Attributes:
        sig: (m,), the direction in which each joint slides: -1, 1, or 0 where it sticks.
        tau: (m,), the friction, positive for positive sliding.
    """

    sig: Array
    tau: Array


INTERNAL = {"v": "z", "w": "zdot", "a": "za"}  # where a state has what is no rate of a position


@shown
class Info(NamedTuple):
    """The report of a step. A field is None if the method does not report it.

    Attributes:
        residual: max-norm of M w - Q at the accepted iterate, in units of force.
        iterations: number of Newton iterations.
        converged: whether they reached the tolerance.
        constraint: max-norm of Phi at the end of the step.
        constraint_rate: max-norm of dPhi/dt at the end of the step.
        dependent_row: index of the first row of the constraint that depends on the rows before it at the start of the
            step; -1 while B has full rank.
        solve_residual: the relative residual of the linear solve, if the solve may be inexact (`banded`,
            `conjugate_gradients`, a given function), or uses a sparse matrix.
        solved: whether that residual is within its tolerance.
        friction: the fraction of a step that is left if joints switch more often than the step can follow; infinite if
            a limit is negative or not finite, and 2 if directions of friction came to depend on each other.
        defect: S^-1 r, the residual that a linearised step leaves at its end, as a correction of the unknowns (only
            under error control).
        contact: 0, or the code of what went wrong with contacts.
        switched: the change of the accelerations by dry friction that switched (only under error control).
    """

    residual: Array | None = None
    iterations: Array | None = None
    converged: Array | None = None
    constraint: Any = None
    constraint_rate: Array | None = None
    dependent_row: Array | None = None
    solve_residual: Real = None
    solved: Array | None = None
    friction: Any = None
    contact: Any = None
    defect: Array | None = None
    switched: Array | None = None

    def _verdict(self):
        """The joined `Info` of several steps."""
        met = known(self.converged)
        if met is None or not met.ndim:
            return ""
        return f"{np.count_nonzero(~met)} of {met.size} not converged" if not met.all() else "all converged"


def join_info(info: Info, new: Info) -> Info:
    """The `Info` of several steps as one: largest residuals, number of iterations, whether all converged."""
    join = {
        "iterations": jnp.add,
        "converged": jnp.logical_and,
        "solved": jnp.logical_and,
        "defect": lambda _, new: new,
        "switched": lambda _, new: new,
    }
    pairs = {name: (x, getattr(new, name)) for name, x in info._asdict().items() if x is not None}
    return info._replace(**{name: join.get(name, jnp.maximum)(*pair) for name, pair in pairs.items()})


class Stepper(Description):
    """Base class of all steppers. A method implements `order`, `begin` and `bind`, on vectors.

    `init` and `step` wrap them for pytrees. Use them to write your own loop:

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: {"x": -4.0 * q["x"]})
    >>> stepper = hhtjax.hht(alpha=-0.05)
    >>> state = stepper.init(spring, {"x": 1.0}, {"x": 0.0}, None, dt=1e-2)
    >>> state, info = stepper.step(spring, state, None, dt=1e-2)
    >>> round(float(state.q["x"]), 4)
    0.9998
    """

    order: int  # of convergence of q and v in dt
    solves_constraints = False
    solves_rotations = False
    solves_internal = False
    solves_friction = False
    solves_contact = False
    keeps_sparse = False  # whether it never forms the matrix of a step of a system with sparse ones
    meets_events = False  # whether `begin` gives all that a step needs behind an event
    needs_equal_steps = False  # what it remembers belongs to steps of one size
    first_steps = 0  # those of another method, before it remembers enough
    resizes = False  # whether `resized` does anything
    estimate_order: int | None = None  # power of h with which the estimated error of a step falls; None without
    dense_term = False  # whether its memory is what dense output adds to cubics
    reads_series = False  # whether its memory is what dense output is made of, the series of the step behind
    proposes = False  # whether it knows the next step by itself: `proposed`
    lands = False  # whether its steps under error control end at each of the times asked for
    starts_massless = False  # whether it starts without dividing by M
    redundant: str | None = None  # how constraints that depend on each other are solved

    @property
    def name(self) -> str:
        """The name of the method in messages."""
        return type(self).__name__

    def for_tolerance(self, rtol: Real) -> Stepper:
        """The stepper for steps under error control."""
        return self

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """State at the initial time, for a `FlatSystem`."""
        raise NotImplementedError

    def smoothed(
        self,
        system: FlatSystem,
        state: State,
        params: PyTree,
        dt: Array,
        moves: bool = True,
        resolves: bool = False,
        alone: bool = False,
    ) -> State:
        """The state from which the first step starts, if it differs from the one at the initial time.

        moves: whether its velocity may differ, too. resolves: whether the first step, chosen by error control, is so
        short that it resolves the fastest motion. alone: whether no kernel surrounds it."""
        return state

    def jumped(
        self, system: FlatSystem, before: State, after: State, old: PyTree, new: PyTree, dt: Array, answer: Callable
    ) -> State:
        """`after`, the state where held inputs jump, with M dw = Q(new) - Q(old), or with what a step dt needs in
        addition; `before`: the state before the jump. answer: dQ -> dw."""
        return after

    def throws(self, system: FlatSystem) -> bool:
        """Whether a step far longer than those before leaves in q what does not fit that step, so that `grown` is
        needed."""
        return False

    def grown(self, system: FlatSystem, state, params: PyTree, dt: Array):
        """The state from which such a step starts, if `throws`: for the method and the state for dt."""
        raise NotImplementedError

    def factors_of(self, system: FlatSystem, dt: Array) -> Any:
        """The factors for many runs of a linear system with constant matrices, as `FlatSystem.factors`."""
        return None

    def bind(self, system: FlatSystem, params: PyTree, dt: Array):
        """The function State -> (State, Info) for a `FlatSystem`, with everything constant computed once."""
        raise NotImplementedError

    def resized(self, state: State, r: Array):
        """The stepper and the state for a step r times as long as the previous one; by default unchanged.

        Call it in your own loop before a step of another size:

        >>> import jax.numpy as jnp, hhtjax
        >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
        >>> stepper = hhtjax.hht()
        >>> state, _ = stepper.step(spring, stepper.init(spring, jnp.ones(1), jnp.zeros(1), None, 0.1), None, 0.1)
        >>> smaller, state = stepper.resized(state, 0.5)
        >>> state, _ = smaller.step(spring, state, None, 0.05)
        """
        return self, state

    def astype(self, dtype: np.dtype):
        """The stepper with its arrays, such as a traced alpha, in the dtype of the state."""
        return jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), self)

    def init(
        self, system, q0: PyTree, v0: PyTree, params: PyTree, dt: Real, t0: Real = 0.0, z0: PyTree = None
    ) -> State:
        """State at t0, from position q0, velocity v0 (None for a `FirstOrderSystem`) and internal states z0."""
        return begun("init", system, self, *initial_values("init", system, q0, v0, z0), params, dt, t0)

    def step(self, system: AnySystem, state: State, params: PyTree, dt: Real) -> tuple[State, Info]:
        """The state one step dt after `state`, and the `Info` of the step."""
        params = freeze(params)
        flat, q, v = flatten("step", system, state.q, state.v, state.t, params, state.z)
        w = ravel_pytree((state.w if flat.positions else state.v, state.zdot))[0]
        a = None if state.a is None else ravel_pytree((state.a, state.za))[0]
        step = bound(self.astype(q.dtype), flat, params, jnp.asarray(dt).astype(q.dtype))
        rest = {"L": state.L, "memory": state.memory, "friction": state.friction, "contact": state.contact}
        state, info = step(State(state.t, q, v, w, a, **rest))
        return _unravel(flat, state), info


def begun(
    caller: str,
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree,
    z0: PyTree,
    params: PyTree,
    dt: Real,
    t0: Real = 0.0,
) -> State:
    """The result of `Stepper.init`, for checked initial values."""
    require_capable(caller, system, stepper, q0, v0)
    params = freeze(params)
    flat, q, v = flatten(caller, system, q0, v0, t0, params, z0)
    dt, t0 = (jnp.asarray(x).astype(q.dtype) for x in (dt, t0))
    return _unravel(
        flat,
        entered(stepper.astype(q.dtype), flat, q, v, t0, zero_order_hold.before(params, t0, dt), dt, alone=True)[1],
    )


def entered(stepper: Stepper, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array, **how: bool):
    """The state at a start, and the state from which the first step dt starts. how: see `Stepper.smoothed`."""
    start = stepper.begin(system, q, v, t, params, dt)
    return start, stepper.smoothed(system, start, params, dt, **how)


def bound(stepper: Stepper, system: FlatSystem, params: PyTree, dt: Array, last: Array | None = None):
    """The function State -> (State, Info) of `stepper.bind`, with held inputs constant over each step.

    last: the size of the previous step, if it differs from dt."""
    if system.matrices is not None and not stepper.keeps_sparse:
        raise NotImplementedError(
            f"{stepper.name} does not support sparse matrices; use hht() or another of its "
            "family, a Rosenbrock method such as rodas5p(), rk4() or dopri5(), or pass arrays: K.toarray()."
        )
    if not zero_order_hold.holds(params):
        return stepper.bind(system, params, dt)

    def step(s: State):
        now, s = step_start(stepper, system, params, dt, dt if last is None else last, s)
        return stepper.bind(system, now, dt)(s)

    return step


def step_start(stepper: Stepper, system: FlatSystem, params: PyTree, dt: Array, last: Array, s: State):
    """The params of a step dt, and the state from which it starts; last: the size of the previous step."""
    if not zero_order_hold.holds(params):
        return params, s
    now = zero_order_hold.held_at(params, s.t + dt / 2)
    old, here = zero_order_hold.before(params, s.t, last), zero_order_hold.passed(params, s.t, last, dt)
    return now, behind_jump(stepper, system, s, old, now, dt, here)


def behind_jump(
    stepper: Stepper, system: FlatSystem, s: State, old: PyTree, new: PyTree, h: Array, here: Array | None = None
) -> State:
    """The state with the accelerations and multipliers for the new params, for a step h:

        M dw - B^T dL = Q(new) - Q(old),   B dw = 0

    Damping that is far too stiff for the step changes the velocity, too: see `Stepper.jumped`. here: whether there is a
    jump at all, as far as that is known. It does not depend on the values, because derivatives at equal values are
    those of a jump.
    """

    behind = partial(_behind_jump, stepper, system)
    return behind(s, old, new, h) if here is None else call_where(behind, here, s, old, new, h)


def _behind_jump(stepper: Stepper, system: FlatSystem, s: State, old: PyTree, new: PyTree, h: Array) -> State:
    """The state after a jump."""
    dQ, L = system.force(s.q, s.v, s.t, new) - system.force(s.q, s.v, s.t, old), s.L
    answer = answers(system, s.q, s.t, new, stepper.redundant)
    dw, dL = answer(dQ)
    if system.num_constraints:
        L = s.L + dL
    s1 = s
    if system.friction is not None:
        dw, friction, L = held_back(system, s, L, old, new, dw, answer, depends(system, stepper.redundant))
        s1 = s._replace(friction=friction)
    s1 = s1._replace(L=L, w=s.w + dw, a=None if s.a is None else s.a + dw)
    return stepper.jumped(system, s, s1, old, new, h, lambda dQ: answer(dQ)[0])


def require_stepper(caller: str, stepper: Stepper):
    """Raises an error for anything but a stepper."""
    if not isinstance(stepper, Stepper):
        raise TypeError(f"{caller}: `stepper` must be a stepper such as hht(); received {stepper!r}.")


def require_capable(caller: str, system: AnySystem, stepper: Stepper, q0: PyTree, v0: PyTree):
    """Raises an error for constraints, rotations, internal states, contact or friction that the stepper does not
    support."""
    name = stepper.name
    if not stepper.starts_massless:
        require_masses(caller, system, 'take hht(), or another of its family, with a smooth start, not start="simple"')
    if system.constraint is not None and not stepper.solves_constraints:
        raise NotImplementedError(
            f"{caller}: {name} cannot solve the `constraint`; use extrapolated(), hht() or another of its family."
        )
    if v0 is not None and not stepper.solves_rotations and kinematics.layout(q0, v0):
        raise NotImplementedError(
            f"{caller}: {name} cannot move the rotations in `q0`; use extrapolated(), hht() or another of its family."
        )
    if system.internal is not None and not stepper.solves_internal:
        raise NotImplementedError(
            f"{caller}: {name} cannot solve the `internal` states; use hht() or another of its family, "
            "a Rosenbrock method such as rodas5p(), rk4() or dopri5()."
        )
    if system.contact is not None and not stepper.solves_contact:
        raise NotImplementedError(f"{caller}: {name} cannot solve `contact`; use hht() or another of its family.")
    if system.friction is not None and not stepper.solves_friction:
        raise NotImplementedError(f"{caller}: {name} cannot solve dry `friction`; use hht() or another of its family.")


def public(flat: FlatSystem, state: State) -> State:
    """The state in the form that users see, with internal states separate.

    In a first-order system the internal states are its q, and their rates its v; it has no w.
    """
    n = flat.positions
    if n == 0:
        return state._replace(q=state.v, v=state.w, w=None)
    if n == flat.size:
        return state
    split = {name: (x[:n], x[n:]) for name in ("v", "w", "a") if (x := getattr(state, name)) is not None}
    rates = {name: x for name, (x, _) in split.items()}
    return state._replace(**rates, **{INTERNAL[name]: z for name, (_, z) in split.items()})


def _unravel(flat, state: State) -> State:
    state = public(flat, state)
    rates = {name: getattr(state, name) for name in INTERNAL}
    rates = {name: flat.unravel_rates(x) for name, x in rates.items() if x is not None}
    internal = {name: getattr(state, name) for name in INTERNAL.values()}
    internal = {name: flat.unravel_internal(x) for name, x in internal.items() if x is not None}
    return state._replace(q=flat.unravel(state.q), **rates, **internal)
