"""Extrapolation of the linearly implicit mid-point rule: high order with one Jacobian a step, also with constraints.

With accelerations and multipliers of the index-1 system, a mechanism is an ODE y' = f(y, t) with y = (x, u): x is the
displacement since the start of the step (for a rotation its rotation vector), u its rate. n micro-steps h = H/n of

    (1 - h J) d_0 = h f(y_0),    (1 - h J)(d_i - d_{i-1})/2 = h f(y_i, t_i) - d_{i-1},    y_{i+1} = y_i + d_i

end in S_n = y_n + (1 - h J)^-1 (h f(y_n, t_n) - d_{n-1}), a smoothing step. J is f_y at the start of the step. For any
J the error of S_n is a series in h^2. With n = 2, 4, 6, ..., the table of Aitken and Neville removes one power after
the other: k values of n give order 2 k - 1. With A = M, or [M, -B^T; B, 0], and K, C the derivatives of its equations
in x and u, the matrix to solve for a change of u is A + h C + h^2 K. A projection with M moves the ends of steps onto
Phi = 0 and dPhi/dt = 0.

On y' = c y the method is A-stable for k = 3, the default. For k = 4 it is A(89 degrees)-stable: an undamped vibration
of frequency w grows by up to 6 % a step about w H = 8, if error control permits it. Both damp stiffer components at
once. For 49 tolerances from 1e-4 to 1e-10 on the squeezer, the error of the run is at most 1.2 times the tolerance for
k = 3, and mostly far below it, but up to 10 times for k = 4 and 5.

G. Bader, P. Deuflhard, Numer. Math. 41, 1983, 373-398; E. Hairer, G. Wanner, Solving Ordinary Differential Equations
II, Sec. IV.9 and VII.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_integer
from hhtjax.description import Array, PyTree
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import differentiable_inverse, matvec
from hhtjax.primitives import staged
from hhtjax.steppers.stepper import Info, State, Stepper
from hhtjax.steppers.variable_step import Embedded, Errors
from hhtjax.systems.constraints import (
    acceleration_and_multipliers,
    curvature,
    dependent_row,
    jacobian,
    reaction,
    saddle_point,
    violation,
)

if TYPE_CHECKING:
    from hhtjax.systems.flat_system import FlatSystem

MOST = 6  # levels; beyond, rounding grows and stability shrinks


@dataclass(frozen=True, eq=False)
class Extrapolated(Embedded, Stepper):
    """The method with a number of levels; made by `extrapolated`."""

    levels: int

    solves_constraints = True
    solves_rotations = True
    solves_internal = True
    lands = True

    @property
    def order(self) -> int:  # pyright: ignore[reportIncompatibleVariableOverride]
        """2 k - 1."""
        return 2 * self.levels - 1

    @property
    def estimate_order(self) -> int:
        """The order of the error of the table without its first row."""
        return 2 * self.levels - 2

    def begin(self, system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree, dt: Array) -> State:
        """w0, and L0 of the index-1 system."""
        w, L = accelerations(system, q, v, t, params)
        return State(t, q, v, w, L=L)

    def bind_pair(self, system: FlatSystem, params: PyTree, dt: Array, estimating: bool = True):
        """State -> State, Info, Errors."""
        system = system.settled(params)

        def step(s: State):
            (x, u), (x_less, u_less) = basic_step(system, params, dt, self.levels, s)
            t, (q, v, _) = s.t + dt, placed(system, s, x, u, s.w)
            s1, info = on_constraints(system, params, s, system.tidy(State(t, q, v, s.w)))
            return s1, info, Errors(x - x_less, u - u_less)

        return step


def accelerations(system: FlatSystem, q: Array, v: Array, t: Array, params: PyTree):
    """w and L."""
    if system.num_constraints:
        return acceleration_and_multipliers(system, q, v, t, params)
    return system.acceleration(q, v, t, params), None


def placed(system: FlatSystem, s: State, x: Array, u: Array, a: Array):
    """q, v and w at the displacement x from s, with its rates u and a."""
    return system.move(s.q, x), *system.end_of_chart(x, u, a, a)[:2]


def weights(levels: int):
    """(2, k): the weights of the rows of the table in its last value, and in the last value without the first row; n =
    2, 4, ..."""
    n = 2.0 * np.arange(1, levels + 1)

    def of(rows: range) -> list:
        return [
            np.prod([n[j] ** 2 / (n[j] ** 2 - n[i] ** 2) for i in rows if i != j]) * (j in rows) for j in range(levels)
        ]

    return np.array([of(range(levels)), of(range(1, levels))])


def basic_step(system: FlatSystem, params: PyTree, H: Array, levels: int, s: State):
    """(x, u) at the end of the step, and the result of one order less."""
    dtype, N = s.v.dtype, system.size
    numbers = 2 * np.arange(1, levels + 1)
    inverses, A, K = matrices(system, params, s, H / jnp.asarray(numbers, dtype))
    final = weights(levels)
    micro = [(j, i, final[:, j] * (i == n)) for j, n in enumerate(numbers) for i in range(1, n + 1)]
    row, part, share = (np.array(x) for x in zip(*micro, strict=True))
    h = H / jnp.asarray(numbers[row], dtype)
    zero = jnp.zeros(N, dtype)

    def increment(h: Array, inverse: Array, b: Array, c: Array):
        """(1 - h J)^-1 (b, c)."""
        du = matvec(inverse, matvec(A, c) - h * matvec(K, b))[:N]
        return b + h * du, du

    def correction(h: Array, i: Array, inverse: Array, x: Array, u: Array, dx: Array, du: Array):
        """Half the difference between the next increment and the last one, (dx, du)."""
        q, v, _ = placed(system, s, x, u, s.w)
        w, _ = accelerations(system, q, v, s.t + i * h, params)
        return increment(h, inverse, h * u - dx, h * system.in_chart(x, u, w) - du)

    def body(carry: tuple, at: tuple):
        y, d, ends = carry
        h, i, inverse, share = at
        dx0, du0 = increment(h, inverse, h * s.v, h * s.w)
        first = i == 1
        x, u, dx, du = (
            jnp.where(first, new, old) for new, old in zip((dx0, s.v + du0, dx0, du0), (*y, *d), strict=True)
        )
        ex, eu = staged(correction)(h, i, inverse, x, u, dx, du)
        ends = ends + share[:, None, None] * jnp.stack([x + ex, u + eu])[None]
        d = dx + 2 * ex, du + 2 * eu
        return ((x + d[0], u + d[1]), d, ends), None

    start = (zero, s.v), (zero, zero), jnp.zeros((2, 2, N), dtype)
    along = h, jnp.asarray(part, dtype), inverses[row], jnp.asarray(share, dtype)
    _, _, ends = lax.scan(body, start, along)[0]
    return ends


def matrices(system: FlatSystem, params: PyTree, s: State, h: Array):
    """(A + h C + h^2 K)^-1 for each h, and A and K, without the columns of multipliers."""
    N, m = system.size, system.num_constraints
    zero, every = jnp.zeros(N, s.v.dtype), jnp.zeros(N + m, s.v.dtype)

    def rows(x: Array, u: Array, z: Array) -> Array:
        q, v, w = placed(system, s, x, u, z[:N])
        r = system.residual(q, v, w, s.t, params)
        if not m:
            return r
        along = violation(system, q, w, s.t, params)[1] - violation(system, q, 0 * w, s.t, params)[1]
        return jnp.concatenate([
            r - reaction(system, q, s.t, params, z[N:]), along + curvature(system, q, v, s.t, params)
        ])  # fmt: skip

    at = zero, s.v, (jnp.concatenate([s.w, s.L]) if m else s.w)
    _, tangent = jax.linearize(rows, *at)
    K = linear_map(lambda x: tangent(x, zero, every), zero)
    C = linear_map(lambda x: tangent(zero, x, every), zero)
    A = linear_map(lambda z: tangent(zero, zero, z), every)
    pad = ((0, 0), (0, m))
    C, K_all = jnp.pad(C, pad), jnp.pad(K, pad)
    return lax.map(lambda h: differentiable_inverse(A + h * C + h**2 * K_all), h), A[:, :N], K


def on_constraints(system: FlatSystem, params: PyTree, s: State, end: State):
    """The end of a step from s, moved onto the constraints, with its w and L; and the `Info`.

    Two corrections of q with one matrix reduce an error to its third power. dPhi/dt is linear in v, so one correction
    is exact to rounding if it uses the matrix at the new q, which w and L need anyway.
    """
    t, q, v = end.t, end.q, end.v
    if not system.num_constraints:
        return end._replace(w=system.acceleration(q, v, t, params)), Info()
    zero, move = jnp.zeros_like(v), saddle_point(system, q, t, params)
    for _ in range(2):
        q = system.move(q, move(zero, -violation(system, q, v, t, params)[0])[0])
    solve = saddle_point(system, q, t, params)
    v = v + solve(zero, -violation(system, q, v, t, params)[1])[0]
    w, L = solve(system.force(q, v, t, params), -curvature(system, q, v, t, params))
    constraint, rate = (jnp.max(jnp.abs(x)) for x in violation(system, q, v, t, params))
    row = dependent_row(jacobian(system, s.q, s.t, params))
    return State(t, q, v, w, L=L), Info(constraint=constraint, constraint_rate=rate, dependent_row=row)


def extrapolated(levels: int = 3) -> Extrapolated:
    """Extrapolation of the linearly implicit mid-point rule: k levels give order 2 k - 1.

    Order 5 by default, also for stiff systems, constraints and rotations. A step needs one Jacobian, k factorised
    matrices, and k (k + 1) evaluations of the acceleration, each with a factorised M (and B). Use it with error control
    for six or more digits. A-stable for levels=3. More levels need fewer steps from eight digits on, but the error of a
    run can reach ten times its tolerance; see the docstring of the module. With error control, steps end at each of
    `times`. It does not support events and dry friction.

    Args:
        levels: k, from 2 to 6.

    Returns:
        A `Stepper`.

    Raises:
        TypeError, ValueError: levels is not an integer from 2 to 6.

    References:
        Bader, Deuflhard, Numer. Math. 41, 1983, 373-398.

    >>> import hhtjax
    >>> hhtjax.extrapolated().order
    5
    >>> hhtjax.extrapolated(levels=9)
    Traceback (most recent call last):
    ValueError: extrapolated: `levels` must be from 2 to 6; received 9.
    """
    levels = require_integer("extrapolated", "levels", levels)
    if not 2 <= levels <= MOST:
        raise ValueError(f"extrapolated: `levels` must be from 2 to {MOST}; received {levels}.")
    return Extrapolated(levels)
