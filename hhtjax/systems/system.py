"""What is simulated: M(q) w = Q(q, v, t), with or without internal states, or y' = f(y, t): functions of pytrees."""

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
        mass: M, the generalised mass matrix: `mass(q, params)`, or an array where M is constant; `mass(q, t, params)`,
            its second argument named t, where it changes in time. (Q then holds -(dM/dt) v, if it is the rate of the
            momentum M v that is known: `from_lagrangian` puts it there.)
            Shape (n, n), symmetric positive definite, or (n,) for a diagonal. Its rows follow
            `jax.flatten_util.ravel_pytree(v)`; for a dict that is the order of the *sorted* keys. What is no such
            matrix is an error here if it is an array, and named by `Solution.check` if it is so where a run starts.
        force: Q, the generalised force: `force(q, v, t, params)`, a pytree structured like v. Steps take its slopes,
            derivatives of runs its second derivatives: a contact max(x, 0)**1.5, whose second one is infinite at 0,
            gives NaN there, and max(x, 1e-12)**1.5 does not.
        constraint: Phi with Phi(q, t) = 0, `constraint(q, t, params)` -> (m,), rows independent (or see `hht`). Then
            M(q) w = Q + B^T L with B = dPhi/dq and multipliers L. For the steppers of the `hht` family.
        inertia: M(q) w without M, `inertia(q, w, params)`, or `inertia(q, w, t, params)`, a pytree structured like v:
            for chains and trees, whose
            inverse dynamics take fewer operations than their matrix. It replaces the product of `mass` and w, in the
            steps and in their Jacobians, and is trusted to be equal to it; `mass` is still asked for M itself.
        dynamics: r, the whole residual as one function, in the place of `force` and `inertia`: inverse dynamics less
            the forces that act, `dynamics(q, v, w, t, params)`, a pytree structured like v, with

                r(q, v, w, t) = M(q, t) w - Q(q, v, t)

            It must be affine in w; a start with known numbers looks at that, once. The implicit steps then call nothing
            else, and take its slopes by `jax.jacfwd`, or by the rule that it brings (`jax.custom_jvp`). Where M or Q is
            asked for alone, at a start or by an explicit method, M is its slope in w and Q is -r(q, v, 0, t); `mass`
            may be given beside it where it is known with fewer operations. With internal states it is `dynamics(q, v,
            w, z, t, params)`.
        internal: g, the rate of internal states z of first order, such as the current of a motor, the integral of a
            controller, hysteresis, or a Maxwell branch: `internal(q, v, z, t, params)`, a pytree structured like z,
            of any shapes. The force is then `force(q, v, z, t, params)`, and runs take a `z0`:

                M(q) w = Q(q, v, z, t) + B^T L,    zdot = g(q, v, z, t)

            Both are solved at once, in one factorisation of their common size, to the order of the stepper, however
            fast z is. (With alpha = 0, or rho_inf = 1, a fast z that starts off the values it is drawn to swings
            about them for ever, as the trapezoidal rule does: damp, or start it there.) For the `hht` family,
            Rosenbrock and Runge-Kutta methods. g should have bounded slopes: no relays, and |z|^nu at z = 0 has
            derivatives in nu that are not finite, unless written exp(nu log(|z| + 1e-12)).
        friction: F >= 0, the limits of dry friction, `friction(q, v, t, params)`, a pytree structured like v: of each
            coordinate, 0 where nothing rubs; with `sliding` (m,), one for each of its rows. It is called with z behind
            v where there are internal states, and with the multipliers L before t where there is a constraint, for
            limits that depend on normal loads. The law is set-valued (Coulomb 1785):

                M(q) w = Q + B^T L - H^T tau,    tau = F sign(s) where s != 0,    |tau| <= F where s = 0

            F(q, v, t) may be any continuous function, a Stribeck curve among them; its value at s = 0 is the stiction.
            Friction that differs from one direction to the other, from -F1 to F2, is F = (F1 + F2)/2 with the constant
            force (F1 - F2)/2 in `force`. For the `hht` family; see `hhtjax.systems`.
        sliding: s, the sliding velocities, `sliding(q, v, t, params)` -> (m,), affine in v, H = ds/dv: relative
            velocities of bodies, v - u(t) on a moving belt. Default: v itself. Where F is larger than all that comes,
            s = 0 holds throughout: a constraint of velocities, as of a wheel that rolls. m <= 16, as each step solves
            dense problems of m joints, several times, and its loops are as long.

            Rows may depend on each other, and on constraints: every joint of a closed loop may rub, both sides of a
            gear, each joint of a mechanism with a driven crank, whose friction the multipliers then bear. The motion
            is unique then, and the forces are not: where dependent joints stick, of all forces that give this motion,
            |tau_i| <= F_i, the ones with the least sum of K_ii tau_i^2 are given, K = H M^-1 H^T with the constraints;
            and 0 where a joint rests that can move nothing. Which of them a real joint bears no rigid model tells. The
            derivatives of the motion are exact for those who stick and slide; single forces of dependent joints that
            stick have derivatives that add up to the right ones, and no more. More rows than freedoms (n minus the rows
            of `constraint`), or than 8, are taken to be dependent, and so are rows that the start shows to be. Rows
            of which only a tracer tells, or that become dependent later, are named by `check()`:
            `hht(redundant="least_squares")` is for these.
        contact: a `Contact`: bodies in a plane that land on each other, rest, stick, slide and let go. For the `hht`
            family; `run.contact` has the forces.

    q and v are pytrees of the same structure and shapes; n is the number of entries of v. Only a rotation differs: a
    leaf R (..., 3, 3) of q, from material to spatial components, has the material angular velocity Om (..., 3) as its
    leaf of v, Rdot = R hat(Om); its rows of M and Q are moments in material components. Any consistent
    units do. A System is frozen and hashable; constant arrays in it are leaves of a pytree.

    Raises:
        TypeError: a function is not callable (or an array, for `mass`), not hashable, or has other arguments;
            `dynamics` beside `force` or `inertia`.
        ValueError: a constant `mass` of a wrong shape, not finite, not symmetric or not positive definite; `sliding`
            without `friction`.

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

    Example: a block of 1 kg on a spring, with dry friction of 1 N: it stops for good where the spring cannot move it.

    >>> block = hhtjax.System(
    ...     mass=jnp.array([1.0]), force=lambda q, v, t, params: -9.0 * q, friction=lambda q, v, t, params: 1.0 + 0 * q)
    >>> solution = hhtjax.simulate(block, hhtjax.hht(), jnp.array([1.0]), jnp.zeros(1), dt=1e-2, num_steps=500)
    >>> bool(solution.sticking[-1, 0]), round(float(solution.friction[-1, 0]), 4), round(float(solution.q[-1, 0]), 4)
    (True, -1.0, 0.1111)

    Example: the pendulum again, by its inverse dynamics: the moment that the acceleration w needs.

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
        """An error for what is no contact, or stands beside dry friction."""
        if not isinstance(self.contact, Contact):
            raise TypeError(f"System: `contact` must be a Contact; received {self.contact!r}.")
        if self.friction is not None:
            raise NotImplementedError(
                "System: leave out `friction` beside `contact`, whose own friction goes with its normal forces; dry "
                "friction elsewhere can be a smooth force, such as F tanh(v/0.001), in `force`."
            )

    def _take_apart(self):
        """`mass`, `force` and `inertia` by `dynamics`, for those who ask for one of them alone."""
        z, dynamics = "" if self.internal is None else "z, ", self.dynamics
        assert dynamics is not None
        require_function("System", "dynamics", dynamics, f"dynamics(q, v, w, {z}t, params)")
        for name in ("force", "inertia"):
            given = getattr(self, name)
            if given is not None and getattr(given, "dynamics", None) is not dynamics:  # else dataclasses.replace
                raise TypeError(f"System: `dynamics` holds what `{name}` says: give one of them; received both.")
        object.__setattr__(self, "force", DynamicsForce(dynamics))
        if self.mass is None and self.internal is None:
            object.__setattr__(self, "mass", DynamicsMass(dynamics))
        elif self.mass is None:
            raise TypeError("System: `dynamics` with internal states needs `mass` beside it, which they do not enter.")

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

        M may depend on the time: a hoisted load, a pendulum whose length is driven, a tank that runs empty. Its rate is
        the last term of Q. Of a body that loses mass this is the equation where what leaves is at rest; where it keeps
        the velocity of the body, add (dM/dt) v to `force`.

        Args:
            lagrangian: L = T - V, `lagrangian(q, v, t, params)`, a scalar. T must be quadratic in v, as M is that of
                v = 0: where it is not, `check` says so. Every coordinate needs a mass; `hhtjax.systems` has the ways
                for one that has none.
            force: F, the forces that no potential holds (damping, inputs): `force(q, v, t, params)`.
            internal: as for `System`; then `force(q, v, z, t, params)`.
            friction, sliding, constraint, contact: as for `System`. (Events are arguments of `simulate`.)

        Returns:
            A `System`, whose `mass(q, t, params)` and `inertia(q, w, t, params)` are those of L.

        Raises:
            TypeError, ValueError: an argument of a wrong kind.

        Example: a mass on a spring, L = m v^2/2 - k q^2/2.

        >>> import jax.numpy as jnp, hhtjax
        >>> spring = hhtjax.System.from_lagrangian(lambda q, v, t, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2)
        >>> float(spring.force(0.1, 0.0, 0.0, {"m": 2.0, "k": 30.0}))
        -3.0

        Example: a load of 1 kg on a rope that is hoisted at 0.1 m/s; it swings the wider, the shorter the rope is.

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
        """A system of many small parts: elements between nodes, and joints between them.

        Leaves of q and v have the nodes as their first axis, so that a plane frame has q = {"r": (N, 2), "theta":
        (N,)}, and rotations are leaves (N, 3, 3). It is a `System` like all others. From where the parts are follows
        which unknowns meet, and with that how steps of the `hht` family are solved: by an elimination along the nodes
        where these can be put in a row, or in a ring, and by SuperLU where not. Its cost grows with the number of nodes
        alone in the former. Jacobians are those of elements: nothing has to be set.

        Args:
            *parts: `Elements`, whose forces add up, and `Joints`, whose rows are constraints: each L of them is a
                reaction, in the order of the joints that are given.
            mass: what sits at the nodes: an array (n,), or a pytree structured like v with a mass for each number, each
                node, or one for all; or a function of params that gives one. Or `Elements` of a consistent mass, whose
                function gives M w of one element, `function(q, w, params)`; or a list of both.
            held: nodes that do not move freely, a dict from a node, or a tuple of nodes, to how they are held. True:
                where they start. Booleans structured like a node, as {"r": True} or {"r": [False, True]}: these numbers
                alone. A function (t, params): the position of the node, structured like q of it, from which velocity
                and acceleration follow; a dict may leave keys out. What is held is no unknown: its row of `v` has the
                acceleration that is known.
            friction, sliding: as for `System`, of the whole. Steps with dry friction are solved with full matrices: up
                to 600 unknowns.

        Internal states belong to a `System` of one function, with `hht(solve=sparse_lu())`.

        Returns:
            A `System`.

        Raises:
            TypeError, ValueError: a part, a mass or what is held is of a wrong kind.

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
    """The first-order system  y' = f(y, t), for every stepper: internal states without a position.

    `simulate` takes y0 as q0, no v0, and returns y as `solution.q`, y' as `solution.v`, no acceleration. On it

        hht(alpha), hht(alpha, iterations=None)     order 2 for every alpha (Jansen, Whiting, Hulbert 2000)
        kim_hht(alpha)                              y1 = y + h f/(1 - theta h f_y),  theta = (1/2 - alpha)(1 + alpha):
                                                    order 2 only where theta = 1/2, at alpha = 0, without explicit time
        implicit_euler(), rk4()                     what their names say

    Args:
        rate: f, `rate(y, t, params)`, a pytree structured like y.

    Raises:
        TypeError: `rate` is not a hashable function.

    References:
        Kim et al. (2019), Eq. 15-22; Jansen, Whiting, Hulbert, Comput. Methods Appl. Mech. Eng. 190 (2000).

    Example: the highly damped equation of Kim et al., Sec. 3.2, with half the step that explicit Euler could take.

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
    """An error for what is no function constraint(q, t, params); for one of velocities with the way to it."""
    try:
        require_function("System", "constraint", constraint, "constraint(q, t, params)")
    except TypeError as error:
        code = getattr(constraint, "__code__", None)
        if code is None or "v" not in code.co_varnames[: code.co_argcount]:
            raise
        raise TypeError(
            f"{error} Velocities that are held, as where a wheel rolls, are `sliding` with a large `friction`."
        ) from None


AnySystem = System | LinearSystem | FirstOrderSystem  # what a run takes


def require_system(caller: str, system: AnySystem, massless: bool = False):
    """An error for what is no system, or has coordinates without mass where these are not possible."""
    if not isinstance(system, (System, LinearSystem, FirstOrderSystem)):
        raise TypeError(f"{caller}: `system` must be a System, LinearSystem or FirstOrderSystem; received {system!r}.")
    if not massless:
        require_masses(caller, system, "give them some")


def require_masses(caller: str, system: AnySystem, without: str):
    """An error for coordinates without mass, with which something is not possible."""
    if system.massless is not None:
        raise NotImplementedError(
            f"{caller}: the `M` of the system is singular, and coordinates without mass have no acceleration of their "
            f"own: {without}."
        )


def require_smooth(caller: str, system):
    """An error for dry friction and contact, whose forces are no functions of the state."""
    if system.contact is not None:
        raise NotImplementedError(
            f"{caller}: `system` has contact, whose forces are no functions of q and v: leave `contact` out."
        )
    if system.friction is not None:
        raise NotImplementedError(
            f"{caller}: `system` has dry friction, which is no function of q and v: leave `friction` out, or put a "
            "smooth one into `force`."
        )


# ----------------------------------------------------------------------------
# Mass, inertia and force of Lagrange's equations by autodiff. Classes: equal Lagrangians give equal systems.


@dataclass(frozen=True)
class LagrangianMass:
    """M(q, t) = d2L/dv2, which no v enters: at v = 0."""

    lagrangian: Callable
    is_lagrangian = True  # knows no rotations

    def __call__(self, q: Array, t: Real, params: PyTree) -> Array:
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return jax.hessian(lambda v: self.lagrangian(q, unravel(v), t, params))(zero)


@dataclass(frozen=True)
class LagrangianInertia:
    """M(q, t) w, the derivative of the momentum dL/dv in the direction w: one column of the Hessian, not all."""

    lagrangian: Callable

    def __call__(self, q: Array, w: Array, t: Real, params: PyTree) -> Array:
        q, w = (jax.tree.map(jnp.asarray, x) for x in (q, w))
        zero = jax.tree.map(jnp.zeros_like, w)
        return lagrangian_product(self.lagrangian, q, zero, w, t, params)


def lagrangian_product(lagrangian: Callable, q: Array, v: Array, w: Array, t: Real, params: PyTree) -> Array:
    """d2L/dv2 w at a velocity."""
    momentum = jax.grad(lambda v: lagrangian(q, v, t, params))
    return jax.jvp(momentum, (v,), (w,))[1]


def mass_reads_velocity(lagrangian: Callable, q: Array, v: Array, t: Array, params: PyTree):
    """Whether d2L/dv2 depends on v, so that L is none of a mass matrix; looked at where v enters it at all."""
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
    """The same where F depends on internal states z too."""

    lagrangian: Callable
    force: Callable | None

    def __call__(self, q: Array, v: Array, z: Array, t: Real, params: PyTree) -> Array:
        Q = LagrangianForce(self.lagrangian, None)(q, v, t, params)
        return Q if self.force is None else jax.tree.map(jnp.add, Q, self.force(q, v, z, t, params))


# ----------------------------------------------------------------------------
# Mass and force of a residual r(q, v, w, t) = M w - Q. Classes: equal functions give equal systems.


@dataclass(frozen=True)
class DynamicsMass:
    """M(q, t), the slope of r in w, at v = 0. Of a position without rotations, whose rates are structured like it."""

    dynamics: Callable

    def __call__(self, q: PyTree, t: Real, params: PyTree) -> Array:
        zero, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, q))
        return self.matrix(q, zero, unravel, t, params)

    def matrix(self, q: PyTree, zero: Array, unravel: Callable, t: Real, params: PyTree) -> Array:
        """The same of any position. zero: (n,); unravel: of vectors of rates."""
        v = unravel(zero)
        return linear_map(lambda x: ravel_pytree(self.product(q, v, unravel(x), t, params))[0], zero)

    def product(self, q: PyTree, v: PyTree, w: PyTree, t: Real, params: PyTree) -> PyTree:
        """M(q, t) w. v: zeros."""
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
    """Whether a function takes t behind so many arguments, and before params: it tells by the name."""
    names = positional_names(function)
    named = len(names) > before + 1 and names[before].lstrip("_") in TIMES
    return named and takes(function, before + 2)  # a decorator may have filled it in


def require_inertial(caller: str, name: str, function: Callable, before: tuple[str, ...]) -> None:
    """An error for what is no function of these and params, nor one of these, t and params."""
    more = ("t",) if callable(function) and takes_time(function, len(before)) else ()
    require_function(caller, name, function, f"{name}({', '.join((*before, *more, 'params'))})")


def timed(function: Callable, before: int, t: Real) -> tuple:
    """(t,) for a function that takes the time behind so many arguments, () for one that does not."""
    return (t,) if takes_time(function, before) else ()


def mass_at(system: System, q: PyTree, t: Real, params: PyTree):
    """M of a system with pytrees, as its user gave it: a function's value, or the constant array."""
    return system.mass(q, *timed(system.mass, 1, t), params) if callable(system.mass) else system.mass


def product_at(system, q: PyTree, w: PyTree, t: Real, params: PyTree) -> PyTree:
    """M w by the system's own `inertia`, a pytree."""
    return system.inertia(q, w, *timed(system.inertia, 2, t), params)
