"""System descriptions: M(q) w = Q(q, v, t), with or without internal states, and y' = f(y, t), on pytrees."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree

from hhtjax.checks import positional_names, require_function, takes
from hhtjax.description import Array, Description, PyTree, Real
from hhtjax.jaxpr import linear_map
from hhtjax.primitives import traced
from hhtjax.systems.assembly import put_together
from hhtjax.systems.contact import Contact
from hhtjax.systems.elements import Elements, Joints
from hhtjax.systems.friction import require_friction
from hhtjax.systems.linear_system import LinearSystem
from hhtjax.systems.matrices import constant_matrix, require_mass

__all__ = ["AnySystem", "FirstOrderSystem", "LinearSystem", "System", "require_smooth", "require_system"]


@dataclass(frozen=True, eq=False)
class System(Description):
    """A second-order mechanical system  M(q) w = Q(q, v, t)  with acceleration w.

    Args:
        mass: M, the generalised mass matrix: `mass(q, params)`, or an array if M is constant. If M changes in time,
            write `mass(q, t, params)`; the second argument must be named t. (Q must then contain -(dM/dt) v if your
            equation is the rate of the momentum M v; `from_lagrangian` adds this term.) Shape (n, n), symmetric
            positive definite, or (n,) for a diagonal. Its rows follow `jax.flatten_util.ravel_pytree(v)`; for a dict
            this is the order of the *sorted* keys. An array that is not such a matrix is an error here. For a function,
            `Solution.check` reports a matrix that is not symmetric or not positive definite at the start of a run.
        force: Q, the generalised force: `force(q, v, t, params)`, a pytree structured like v. Steps use its first
            derivatives, and derivatives of runs its second derivatives. A contact force max(x, 0)**1.5 therefore gives
            NaN: its second derivative is infinite at 0. Write max(x, 1e-12)**1.5 instead.
        constraint: Phi with Phi(q, t) = 0, `constraint(q, t, params)` -> (m,), with independent rows (for dependent
            rows see `hht`). The equation is then M(q) w = Q + B^T L with B = dPhi/dq and multipliers L. Supported by
            the `hht` family, `extrapolated` and `conventional_hht`.
        inertia: the product M(q) w without M itself, `inertia(q, w, params)` or `inertia(q, w, t, params)`, a pytree
            structured like v. Use it for chains and trees, whose inverse dynamics take fewer operations than their
            matrix. It replaces the product of `mass` and w in the steps and in their Jacobians. That both agree is not
            checked. `mass` is still needed, for M itself.
        dynamics: r, the whole residual as one function, `dynamics(q, v, w, t, params)`, a pytree structured like v:
            inverse dynamics minus the forces that act. It replaces `force` and `inertia`:

                r(q, v, w, t) = M(q, t) w - Q(q, v, t)

            It must be affine in w; this is checked once, at a start with concrete numbers. The implicit steps call only
            this function. They differentiate it by `jax.jacfwd`, or by its own rule (`jax.custom_jvp`) if it has one.
            Where M or Q is needed alone, at a start or in an explicit method, M is the derivative of r with respect to
            w, and Q is -r(q, v, 0, t). Give `mass` as well if it takes fewer operations. With internal states write
            `dynamics(q, v, w, z, t, params)`; `mass` is then required.
        internal: g, the rate of first-order internal states z: `internal(q, v, z, t, params)`, a pytree structured like
            z, of any shapes. Examples: the current of a motor, the integral of a controller, hysteresis, a Maxwell
            branch. The force is then `force(q, v, z, t, params)`, and runs take a `z0`:

                M(q) w = Q(q, v, z, t) + B^T L,    zdot = g(q, v, z, t)

            Both equations are solved together, with one factorisation of their joint matrix, to the order of the
            stepper, however fast z is. (With alpha = 0, or rho_inf = 1, a fast z that starts away from its equilibrium
            oscillates about it without decay, as with the trapezoidal rule. Use a stepper with damping, or start z at
            its equilibrium.) Supported by the `hht` family, `extrapolated`, Rosenbrock and Runge-Kutta methods and
            `taylor`. g must have bounded derivatives, so it cannot describe a relay. The derivative of |z|^nu with
            respect to nu is not finite at z = 0; write exp(nu log(|z| + 1e-12)) instead.
        friction: F >= 0, the limits of dry friction: `friction(q, v, t, params)`, a pytree structured like v with one
            limit for each coordinate, 0 where there is no friction. With `sliding` it returns (m,), one limit for each
            row of `sliding`. With internal states it takes z after v. With a constraint it takes the multipliers L
            before t, for limits that depend on normal loads. The law is set-valued (Coulomb 1785):

                M(q) w = Q + B^T L - H^T tau,    tau = F sign(s) where s != 0,    |tau| <= F where s = 0

            F(q, v, t) may be any continuous function, such as a Stribeck curve; its value at s = 0 is the stiction. For
            friction that differs between directions, from -F1 to F2, use F = (F1 + F2)/2 and add the constant force (F1
            - F2)/2 to `force`. For the `hht` family; see `hhtjax.systems`.
        sliding: s, the sliding velocities, `sliding(q, v, t, params)` -> (m,), affine in v, with H = ds/dv. Examples:
            relative velocities of bodies, or v - u(t) on a moving belt. Default: v itself. If F is larger than every
            force that occurs, s = 0 holds throughout: a velocity constraint, as for a rolling wheel. m <= 16, because
            each step solves several dense problems of size m.

            Rows may depend on each other and on constraints. All joints of a closed loop may have friction, or both
            sides of a gear, or each joint of a mechanism with a driven crank (the multipliers then carry the friction).
            The motion is then unique, but the friction forces are not. Where dependent joints stick, the result is the
            set of forces that gives this motion, satisfies |tau_i| <= F_i, and has the least sum of K_ii tau_i^2, with
            K = H M^-1 H^T (constraints included). A joint at rest that cannot move gets 0. A rigid model cannot tell
            which force a real joint carries. Derivatives of the motion are exact while the same joints stick and slide.
            Derivatives of single forces of dependent sticking joints are only correct in sum. Rows are treated as
            dependent if there are more of them than freedoms (n minus the rows of `constraint`), if there are more than
            8, or if the start shows that they are. `check()` reports rows whose dependence only shows in traced values,
            or only later in the run; use `hht(redundant="least_squares")` for these. Each coordinate with friction
            needs a positive mass, also where constraints carry it; `check()` says so.
        contact: a `Contact`: bodies in a plane that collide, rest, stick, slide and separate. For the `hht` family;
            `run.contact` holds the contact forces.

    q and v are pytrees of the same structure and shapes; n is the number of entries of v. The exception is a rotation:
    a leaf R (..., 3, 3) of q maps material to spatial components. The same leaf of v is the material angular velocity
    Om (..., 3), with Rdot = R hat(Om). Its rows of M and Q are moments in material components. Any consistent units
    work. A System is frozen and hashable; its constant arrays are leaves of a pytree.

    Raises:
        TypeError: a function is not callable (or an array, for `mass`), is not hashable, or takes other arguments;
            `dynamics` given together with `force` or `inertia`.
        ValueError: a constant `mass` has a wrong shape, is not finite, not symmetric or not positive definite;
            `sliding` without `friction`.

    Example: a pendulum of length 2 m, with q the angle from the downward vertical in rad.

    >>> import jax.numpy as jnp, hhtjax
    >>> pendulum = hhtjax.System(
    ...     mass=lambda q, params: jnp.array([params["m"] * params["l"] ** 2]),
    ...     force=lambda q, v, t, params: -params["m"] * 9.81 * params["l"] * jnp.sin(q),
    ... )
    >>> solution = hhtjax.simulate(
    ...     pendulum, hhtjax.hht(alpha=-0.05), jnp.array([0.5]), jnp.array([0.0]), {"m": 1.0, "l": 2.0},
    ...     dt=1e-2, num_steps=100)
    >>> solution.q.shape
    (101, 1)

    Example: an arm of 0.1 kg m^2 on a motor with the torque constant 0.5 N m/A; z is the current in A, at 2 V.

    >>> arm = hhtjax.System(
    ...     mass=jnp.array([0.1]),
    ...     force=lambda q, v, z, t, params: params["kt"] * z - 0.01 * v,
    ...     internal=lambda q, v, z, t, params: (2.0 - params["R"] * z - params["kt"] * v) / params["L"],
    ... )
    >>> zero = jnp.zeros(1)
    >>> solution = hhtjax.simulate(
    ...     arm, hhtjax.hht(), zero, zero, {"kt": 0.5, "R": 1.0, "L": 1e-3}, z0=zero, dt=1e-2, num_steps=500)
    >>> [round(float(x[-1, 0]), 3) for x in (solution.v, solution.z)]         # 2 kt/(kt^2 + 0.01 R), 0.01 v/kt
    [3.846, 0.077]

    Example: a block of 1 kg on a spring, with dry friction of 1 N. It stops for good where the spring force is below 1
    N.

    >>> block = hhtjax.System(
    ...     mass=jnp.array([1.0]), force=lambda q, v, t, params: -9.0 * q, friction=lambda q, v, t, params: 1.0 + 0 * q)
    >>> solution = hhtjax.simulate(block, hhtjax.hht(), jnp.array([1.0]), jnp.zeros(1), dt=1e-2, num_steps=500)
    >>> bool(solution.sticking[-1, 0]), round(float(solution.friction[-1, 0]), 4), round(float(solution.q[-1, 0]), 4)
    (True, -1.0, 0.1111)

    Example: the pendulum again, by its inverse dynamics divided by m l: r = l w + g sin(q).

    >>> pendulum = hhtjax.System(dynamics=lambda q, v, w, t, params: params["l"] * w + 9.81 * jnp.sin(q))
    >>> pendulum.mass(jnp.array([0.5]), 0.0, {"l": 2.0}), pendulum.force(jnp.zeros(1), jnp.zeros(1), 0.0, {"l": 2.0})
    (Array([[2.]], dtype=float64), Array([-0.], dtype=float64))
    """

    mass: Any = None
    force: Callable | None = None
    constraint: Callable | None = None
    inertia: Callable | None = None
    internal: Callable | None = None
    friction: Callable | None = None
    sliding: Callable | None = None
    dynamics: Callable | None = None
    contact: Contact | None = None
    massless = None  # of a `LinearSystem` alone
    depending = False  # whether rows of `sliding` are known to depend on each other, or on constraints

    def __post_init__(self):
        if self.dynamics is not None:
            self._take_apart()
        if self.internal is None:
            require_function("System", "force", self.force, "force(q, v, t, params)")
        else:
            for name in ("force", "internal"):
                require_function("System", name, getattr(self, name), f"{name}(q, v, z, t, params)")
        if self.inertia is not None:
            require_inertial("System", "inertia", self.inertia, ("q", "w"))
        if self.constraint is not None:
            _require_constraint(self.constraint)
        more = (self.internal is not None) * ("z",) + (self.constraint is not None) * ("L",)
        if self.friction is not None or self.sliding is not None:
            require_friction("System", self.friction, self.sliding, *more)
        if self.contact is not None:
            self._require_contact()
        if callable(self.mass):
            require_inertial("System", "mass", self.mass, ("q",))
        else:
            mass = constant_matrix("System", "mass", self.mass)
            require_mass("System", "mass", mass, self.constraint is not None)
            object.__setattr__(self, "mass", mass)

    def _require_contact(self):
        """Raises an error if `contact` is not a `Contact`, or if `friction` is given too."""
        if not isinstance(self.contact, Contact):
            raise TypeError(f"System: `contact` must be a Contact; received {self.contact!r}.")
        if self.friction is not None:
            raise NotImplementedError(
                "System: give either `contact` or `friction`, not both; received both. A contact has friction of its "
                "own, `Contact(friction=)`. For dry friction elsewhere use a smooth force in `force`, such as F "
                "tanh(v/0.001)."
            )

    def _take_apart(self):
        """Derives `mass`, `force` and `inertia` from `dynamics`, for callers that need one of them alone."""
        z, dynamics = "" if self.internal is None else "z, ", self.dynamics
        assert dynamics is not None
        require_function("System", "dynamics", dynamics, f"dynamics(q, v, w, {z}t, params)")
        for name in ("force", "inertia"):
            given = getattr(self, name)
            if given is not None and getattr(given, "dynamics", None) is not dynamics:  # else dataclasses.replace
                raise TypeError(
                    f"System: give either `dynamics` or `{name}`, which `dynamics` contains; received both."
                )
        object.__setattr__(self, "force", DynamicsForce(dynamics))
        if self.mass is None and self.internal is None:
            object.__setattr__(self, "mass", DynamicsMass(dynamics))
        elif self.mass is None:
            raise TypeError("System: `dynamics` with internal states needs `mass` too; received None.")

    @classmethod
    def from_lagrangian(
        cls,
        lagrangian: Callable,
        force: Callable | None = None,
        internal: Callable | None = None,
        friction: Callable | None = None,
        sliding=None,
        constraint=None,
        contact: Contact | None = None,
    ) -> System:
        """The system of Lagrange's equations  d/dt (dL/dv) - dL/dq = F + B^T L, with M and Q by autodiff.

            M(q, t) = d2L/dv2,    Q = F + dL/dq - (d2L/dv dq) v - d2L/dv dt

        M may depend on time: a hoisted load, a pendulum whose length is driven, a tank that empties. The last term of Q
        accounts for the rate of M. For a body that loses mass, the equation assumes that the leaving mass is at rest.
        If it keeps the velocity of the body, add (dM/dt) v to `force`.

        Args:
            lagrangian: L = T - V, `lagrangian(q, v, t, params)`, a scalar. T must be quadratic in v, because M is
                evaluated at v = 0; `Solution.check` reports an L for which it is not. Every coordinate needs a mass;
                for coordinates without mass see `hhtjax.systems`.
            force: F, the forces that are not in the potential (damping, inputs): `force(q, v, t, params)`.
            internal: as for `System`; then `force(q, v, z, t, params)`.
            friction, sliding, constraint, contact: as for `System`. (Events are arguments of `simulate`.)

        Returns:
            A `System` whose `mass(q, t, params)` and `inertia(q, w, t, params)` are derived from L.

        Raises:
            TypeError, ValueError: an argument of a wrong kind.

        Example: a mass on a spring, L = m v^2/2 - k q^2/2.

        >>> import jax.numpy as jnp, hhtjax
        >>> spring = hhtjax.System.from_lagrangian(lambda q, v, t, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2)
        >>> float(spring.force(0.1, 0.0, 0.0, {"m": 2.0, "k": 30.0}))
        -3.0

        Example: a load of 1 kg on a rope that is hoisted at 0.1 m/s. The swing grows as the rope shortens.

        >>> def lagrangian(angle, rate, t, p):
        ...     l = p["l"] - p["u"] * t
        ...     return 0.5 * (l * rate) ** 2 + 0.5 * p["u"] ** 2 + 9.81 * l * jnp.cos(angle)
        >>> run = hhtjax.simulate(
        ...     hhtjax.System.from_lagrangian(lagrangian), hhtjax.hht(), 0.1, 0.0, {"l": 4.0, "u": 0.1},
        ...     dt=0.01, num_steps=3000)
        >>> [round(float(jnp.max(jnp.abs(x))), 2) for x in (run.q[:500], run.q[-500:])]
        [0.11, 0.27]
        """
        caller = "System.from_lagrangian"
        require_function(caller, "lagrangian", lagrangian, "lagrangian(q, v, t, params)")
        if force is not None:
            arguments = "q, v, t, params" if internal is None else "q, v, z, t, params"
            require_function(caller, "force", force, f"force({arguments})")
        own_force = (LagrangianForce if internal is None else InternalLagrangianForce)(lagrangian, force)
        parts = LagrangianMass(lagrangian), own_force, constraint, LagrangianInertia(lagrangian)
        return cls(*parts, internal, friction, sliding, contact=contact)

    @classmethod
    def from_elements(
        cls,
        *parts: Elements | Joints,
        mass: Any,
        held: dict | None = None,
        friction: Callable | None = None,
        sliding: Callable | None = None,
    ) -> System:
        """A system assembled from many small parts: elements between nodes, and joints between them.

        The first axis of every leaf of q and v counts the nodes: a plane frame has q = {"r": (N, 2), "theta": (N,)},
        and rotations are leaves (N, 3, 3). The result is a `System` like any other. The connections between nodes show
        which unknowns are coupled, and so how steps of the `hht` family are solved: by elimination along the nodes if
        they form a row or a ring (the cost then grows linearly with the number of nodes), otherwise by SuperLU.
        Jacobians are computed element by element. There is nothing to configure.

        Args:
            *parts: `Elements`, whose forces are summed, and `Joints`, whose rows are constraints. Each row has one
                multiplier in L, a reaction, in the order of the given joints.
            mass: the mass at the nodes: an array (n,), or a pytree structured like v with a mass for each number, for
                each node, or one for all; or a function of params that returns one. Or `Elements` with a consistent
                mass matrix, whose function returns M w of one element, `function(q, w, params)`. Or a list of both.
            held: nodes whose motion is prescribed: a dict whose keys are nodes, or tuples of nodes. Its values: True
                fixes the node at its initial position. Booleans structured like a node, as {"r": True} or
                {"r": [False, True]}, fix only these components. A function (t, params) returns the position of the
                node, structured like its q (a dict may omit keys); velocity and acceleration follow by differentiation.
                Prescribed components are not unknowns: their rows of `v` contain the prescribed rates.
            friction, sliding: as for `System`, for the whole system. Steps with dry friction use full matrices, for up
                to 600 unknowns.

        Internal states are not supported here. Write one `System` and solve it with `hht(solve=sparse_lu())`.

        Returns:
            A `System`.

        Raises:
            TypeError, ValueError: a part, `mass` or `held` has a wrong type, shape or value.

        References:
            M. Geradin, A. Cardona, Flexible Multibody Dynamics, Wiley 2001.

        Example: a hanging chain of 200 masses on springs, its upper end shaken.

        >>> import jax.numpy as jnp, numpy as np, hhtjax
        >>> def spring(q, v, t, params):
        ...     d = q[1] - q[0]
        ...     pull = (params["k"] * (1 - 0.01 / jnp.sqrt(d @ d))) * d
        ...     return jnp.stack([pull, -pull])
        >>> def weight(q, v, t, params):
        ...     return jnp.array([[0.0, -0.01 * 9.81]])
        >>> nodes = np.arange(201)
        >>> chain = hhtjax.System.from_elements(
        ...     hhtjax.Elements(spring, np.stack([nodes[:-1], nodes[1:]], axis=1)),
        ...     hhtjax.Elements(weight, nodes[:, None]),
        ...     mass=0.01, held={0: lambda t, params: jnp.stack([0.1 * jnp.sin(5 * t), 0 * t])})
        >>> q0 = jnp.stack([jnp.zeros(201), -0.01 * jnp.arange(201.0)], axis=1)
        >>> v0 = jnp.zeros((201, 2)).at[0, 0].set(0.5)
        >>> run = hhtjax.simulate(chain, hhtjax.hht(), q0, v0, {"k": 1e4}, dt=2e-3, num_steps=500)
        >>> run.check()
        >>> [round(float(x), 3) for x in run.q[-1, 0]]                            # 0.1 sin(5)
        [-0.096, 0.0]
        """
        mass, force, constraint, inertia = put_together(parts, mass, held)
        return cls(mass, force, constraint, inertia, None, friction, sliding)


@dataclass(frozen=True, eq=False)
class FirstOrderSystem(Description):
    """The first-order system  y' = f(y, t), for every stepper.

    `simulate` takes y0 as q0, and no v0. It returns y as `solution.q`, y' as `solution.v`, and no acceleration. The
    methods are

        hht(alpha), hht(alpha, iterations=None)     order 2 for every alpha (Jansen, Whiting, Hulbert 2000)
        kim_hht(alpha)                              y1 = y + h f/(1 - theta h f_y),  theta = (1/2 - alpha)(1 + alpha):
                                                    order 2 only where theta = 1/2, at alpha = 0, without explicit time
        implicit_euler(), rk4()                     as named

    Args:
        rate: f, `rate(y, t, params)`, a pytree structured like y.

    Raises:
        TypeError: `rate` is not a hashable function.

    References:
        Kim et al. (2019), Eq. 15-22; Jansen, Whiting, Hulbert, Comput. Methods Appl. Mech. Eng. 190 (2000).

    Example: the strongly damped equation of Kim et al., Sec. 3.2, at half the largest stable step of explicit Euler.

    >>> import jax.numpy as jnp, hhtjax
    >>> decay = hhtjax.FirstOrderSystem(lambda y, t, params: -params["rate"] * y)
    >>> run = hhtjax.simulate(
    ...     decay, hhtjax.kim_hht(alpha=0.0), jnp.array(1.0), params={"rate": 1000.0}, dt=1e-3, num_steps=3)
    >>> [round(float(y), 6) for y in run.q]                                   # powers of 1/3; e^-1 = 0.367879
    [1.0, 0.333333, 0.111111, 0.037037]
    """

    rate: Callable
    constraint = None
    internal = None
    friction = None
    contact = None
    massless = None

    def __post_init__(self):
        require_function("FirstOrderSystem", "rate", self.rate, "rate(y, t, params)")


def _require_constraint(constraint: Callable):
    """Raises an error unless it is a function constraint(q, t, params); explains what to do with velocity
    constraints."""
    try:
        require_function("System", "constraint", constraint, "constraint(q, t, params)")
    except TypeError as error:
        code = getattr(constraint, "__code__", None)
        if code is None or "v" not in code.co_varnames[: code.co_argcount]:
            raise
        raise TypeError(
            f"{error} For a velocity constraint, such as a rolling wheel, use `sliding` with a large `friction`."
        ) from None


AnySystem = System | LinearSystem | FirstOrderSystem  # what a run takes


def require_system(caller: str, system: AnySystem, massless: bool = False):
    """Raises an error for anything but a system, and for coordinates without mass unless `massless`."""
    if not isinstance(system, (System, LinearSystem, FirstOrderSystem)):
        raise TypeError(f"{caller}: `system` must be a System, LinearSystem or FirstOrderSystem; received {system!r}.")
    if not massless:
        require_masses(caller, system, "give them some")


def require_masses(caller: str, system: AnySystem, without: str):
    """Raises an error if the system has coordinates without mass; `without` says what to do."""
    if system.massless is not None:
        raise NotImplementedError(
            f"{caller}: the `M` of the system is singular. Coordinates without mass have no acceleration of their "
            f"own, so they are not supported here: {without}."
        )


def require_smooth(caller: str, system):
    """Raises an error for dry friction and contact, whose forces are not functions of q and v."""
    if system.contact is not None:
        raise NotImplementedError(
            f"{caller}: `system` has contact, whose forces are not functions of q and v: leave `contact` out."
        )
    if system.friction is not None:
        raise NotImplementedError(
            f"{caller}: `system` has dry friction, which is not a function of q and v: leave `friction` out, or put "
            "a smooth friction force into `force`."
        )


# ----------------------------------------------------------------------------
# Mass, inertia and force of Lagrange's equations by autodiff. Classes: equal Lagrangians give equal systems.


@dataclass(frozen=True)
class LagrangianMass:
    """M(q, t) = d2L/dv2, evaluated at v = 0, since it must not depend on v."""

    lagrangian: Callable
    is_lagrangian = True  # does not support rotations

    def __call__(self, q: Array, t: Real, params: PyTree) -> Array:
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return jax.hessian(lambda v: self.lagrangian(q, unravel(v), t, params))(zero)


@dataclass(frozen=True)
class LagrangianInertia:
    """M(q, t) w, the derivative of the momentum dL/dv in direction w. This avoids the full Hessian."""

    lagrangian: Callable

    def __call__(self, q: Array, w: Array, t: Real, params: PyTree) -> Array:
        q, w = (jax.tree.map(jnp.asarray, x) for x in (q, w))
        zero = jax.tree.map(jnp.zeros_like, w)
        return lagrangian_product(self.lagrangian, q, zero, w, t, params)


def lagrangian_product(lagrangian: Callable, q: Array, v: Array, w: Array, t: Real, params: PyTree) -> Array:
    """The product (d2L/dv2) w at velocity v."""
    momentum = jax.grad(lambda v: lagrangian(q, v, t, params))
    return jax.jvp(momentum, (v,), (w,))[1]


def mass_reads_velocity(lagrangian: Callable, q: Array, v: Array, t: Array, params: PyTree):
    """Whether d2L/dv2 depends on v, in which case L has no mass matrix. Evaluated only if v enters d2L/dv2 at all."""
    flat, unravel = ravel_pytree(v)
    some = jnp.asarray(1 + 0.618 * np.arange(flat.size) % 0.5, flat.dtype)

    product = traced(
        lambda v: ravel_pytree(lagrangian_product(lagrangian, q, unravel(v), unravel(some), t, params))[0], flat
    )
    if not product.reads(None)[0]:
        return jnp.array(False)
    rest, far = product(jnp.zeros_like(flat)), 1 + jnp.max(jnp.abs(flat))
    changes = jnp.stack([product(x) - rest for x in (flat, flat + 0.01 * far * some, flat - far * some)])
    rounding = max(1e-6, 1e3 * float(jnp.finfo(flat.dtype).eps))
    return lax.stop_gradient(jnp.any(jnp.abs(changes) > rounding * jnp.max(jnp.abs(rest))))  # not where it is NaN


@dataclass(frozen=True)
class LagrangianForce:
    """Q(q, v, t) = F + dL/dq - d/ds (dL/dv)(q + s v, t + s)."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q: Array, v: Array, t: Real, params: PyTree) -> Array:
        q, v = (jax.tree.map(jnp.asarray, x) for x in (q, v))
        t = jnp.asarray(t, jnp.result_type(*jax.tree.leaves(q)))

        def momentum(q: Array, t: Array) -> Array:
            return jax.grad(self.lagrangian, argnums=1)(q, v, t, params)

        _, convective = jax.jvp(momentum, (q, t), (v, jnp.ones_like(t)))
        Q = jax.tree.map(jnp.subtract, jax.grad(self.lagrangian)(q, v, t, params), convective)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, t, params))


@dataclass(frozen=True)
class InternalLagrangianForce:
    """As `LagrangianForce`, for an F that depends on internal states z too."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q: Array, v: Array, z: Array, t: Real, params: PyTree) -> Array:
        Q = LagrangianForce(self.lagrangian, None)(q, v, t, params)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, z, t, params))


# ----------------------------------------------------------------------------
# Mass and force of a residual r(q, v, w, t) = M w - Q. Classes: equal functions give equal systems.


@dataclass(frozen=True)
class DynamicsMass:
    """M(q, t), the derivative of r with respect to w at v = 0, for positions without rotations (v is structured like
    q)."""

    dynamics: Callable

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return self.matrix(q, zero, unravel, t, params)

    def matrix(self, q: PyTree, zero: Array, unravel: Callable, t: Real, params: PyTree) -> Array:
        """M(q, t) for any position. zero: (n,); unravel: from a vector of rates to their pytree."""
        v = unravel(zero)
        return linear_map(lambda x: ravel_pytree(self.product(q, v, unravel(x), t, params))[0], zero)

    def product(self, q: PyTree, v: PyTree, w: PyTree, t: Real, params: PyTree) -> PyTree:
        """The product M(q, t) w. v: zeros."""
        return jax.jvp(lambda w: self.dynamics(q, v, w, t, params), (v,), (w,))[1]


@dataclass(frozen=True)
class DynamicsForce:
    """Q(q, v, t) = -r(q, v, 0, t); with internal states Q(q, v, z, t)."""

    dynamics: Callable

    def __call__(self, q: PyTree, v: PyTree, *others: PyTree) -> PyTree:
        r = self.dynamics(q, v, jax.tree.map(jnp.zeros_like, v), *others)
        return jax.tree.map(jnp.negative, r)


# ----------------------------------------------------------------------------
# The mass of a system at a position and a time: a function of (q, params), or of (q, t, params).
#
# Equations with M(q, t) ask for nothing new of a stepper: w is the acceleration that M(q, t) w = Q(q, v, t) gives at a
# time, so a residual at (q1, v1, t1) takes M there, and derivatives in t pass through it. The rate of M is part of the
# momentum's, d/dt (M v) = M w + Mdot v, and belongs into Q: there `from_lagrangian` puts it.


TIMES = "t", "time"  # names that an argument for the time may have


def takes_time(function: Callable, before: int) -> bool:
    """Whether the argument after the first `before` ones, and before params, is named t."""
    names = positional_names(function)
    named = len(names) > before + 1 and names[before].lstrip("_") in TIMES
    return named and takes(function, before + 2)  # a decorator may have filled it in


def require_inertial(caller: str, name: str, function: Callable, before: tuple[str, ...]) -> None:
    """Raises an error unless the function takes the arguments `before` and params, or `before`, t and params."""
    more = ("t",) if callable(function) and takes_time(function, len(before)) else ()
    require_function(caller, name, function, f"{name}({', '.join((*before, *more, 'params'))})")


def timed(function: Callable, before: int, t: Real) -> tuple:
    """(t,) if the function takes the time after the first `before` arguments, else ()."""
    return (t,) if takes_time(function, before) else ()


def mass_at(system: System, q: PyTree, t: Real, params: PyTree):
    """M of a system on pytrees, as the user gave it: a function's value, or the constant array."""
    return system.mass(q, *timed(system.mass, 1, t), params) if callable(system.mass) else system.mass


def product_at(system, q: PyTree, w: PyTree, t: Real, params: PyTree) -> PyTree:
    """M w by the system's own `inertia`, a pytree."""
    return system.inertia(q, w, *timed(system.inertia, 2, t), params)
