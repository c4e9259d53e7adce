"""The smooth start: a start after which steps are smooth, although damping may be far too stiff for their size.

A light, strongly damped coordinate loses the part of its velocity that does not fit its forces in a time m/c, far below
a step h. The acceleration at the start, M^-1 Q, is proportional to 1/m. The recursion keeps it, and adds h^2 w (1/2 -
beta/gamma) to q: any multiple of F/k. So the step starts after that time instead:

    S = M + h gamma C + h^2 beta K,      C = -dQ/dv,  K = -dQ/dq
    M dv = h gamma Q(q + h (beta/gamma) dv, v + dv, t)     an implicit step of the velocity: by Newton, with S
    P = S^-1 h gamma (C + C^T)/2                           1 where damping is stiff, O(h) where the step resolves it
    v+ = v + P^4 [1 + (5 - 2 gamma) (1 - P)] dv
    w <- w + S^-1 [Q(q, v+, t) - M w],  five times from 0 (see `Corrections`)

Where the step resolves the motion, v+ - v is O(h^5), and w differs from M^-1 Q by O(h^5), so order and error constants
do not change. Elsewhere w is bounded. Forces without dissipation, such as gyroscopic ones, have an antisymmetric C, and
change no velocity. If C + C^T is 0 nothing changes at all, because the recursion does not throw a spring by its M^-1 Q.

While its velocity changes, a coordinate falls behind by m/c dv. v+ is the velocity at the end of this phase. The
recursion treats the rest, v + dv - v+, as half a step of it. With the factor [1 + ...], whose slope at P = 1 is that of
P^(2 gamma), the two agree up to the square of m/(c h): 1 - 50 q - 5 v from rest has an error of 4e-4 at most for any
mass with hht(-.05), h = 1e-3; P^4 alone leaves 1e-3.

With constraints all solves use [S -B^T; B 0]: B dv = h g (-curvature), B P = 0, and w has its multipliers. Where an
input jumps between two steps, dQ = Q(new) - Q(old) replaces Q, and dv, dw and dL are changes. Internal states z, which
may be far faster than h, keep their rates.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.batched_cond import call_where, derivative_at_need, tree_where
from hhtjax.numerics.closures import carried, hoisted
from hhtjax.numerics.dense_lu import UNROLLED, diagonal, differentiable_inverse, inverse, matvec
from hhtjax.numerics.differentiable_while import implicit_root
from hhtjax.numerics.linear_solve import Trusted, factorize_map, invert, solve_map
from hhtjax.numerics.low_rank import around
from hhtjax.numerics.shortened_newton import improved
from hhtjax.primitives import one_kernel, staged, traced
from hhtjax.steppers.implicit_solve import linearize_rows, linearized
from hhtjax.steppers.residual import Coefficients, residual
from hhtjax.steppers.stepper import State
from hhtjax.systems.constraints import answers, curvature, gradient_maps, jacobian, reaction, violation

if TYPE_CHECKING:
    from hhtjax.numerics.linear_solve import Given
    from hhtjax.numerics.low_rank import Constant
    from hhtjax.steppers.collocation import Beginning
    from hhtjax.steppers.generalized_alpha import GeneralizedAlpha
    from hhtjax.steppers.stepper import Stepper
    from hhtjax.systems.flat_system import FlatSystem

POWERS = 5
STEPS = 3  # of it, which are differentiated: from the second on Hessians are right
LARGEST = 64  # unknowns whose matrix is inverted
STIFF = 0.03  # part of a jump of the acceleration by which damping changes it within a step, and h resolves it
LEAVES = 0.3  # part of its accelerations by which a motion changes them in a long step, so that this begins anew
GAINED = 0.03  # part of the energy of a motion that a C may give it within a step, and still counts as a damper
LATER = 1 / 16  # of h, for the rate of accelerations


class Corrections(NamedTuple):
    """w+ by `number` corrections, of which the last is applied `last` times.

    With R = 1 - S^-1 M, which is 1 where damping is stiff, w+ is (1 - R^5) M^-1 Q by default. In that limit it is 1/h
    times the velocity that v+ lacks."""

    number: int
    last: float


DEFAULT = Corrections(5, 1.0)


class Layer(NamedTuple):
    """The equations at a start, or at a jump.

    base: the state, with accelerations and multipliers to which unknown changes z = (dw, dL) are added. offset: the
    required values of the rows. X, V: displacement and velocity per unit of dw. bend: of constraints, None without; B:
    their gradient, also None if it is sparse. M: None if it is not formed."""

    system: Any
    params: PyTree
    base: State
    offset: Any
    X: Array
    V: Any
    B: Any
    bend: Any
    M: Array | None = None

    @classmethod
    def of(cls, method, system: FlatSystem, params: PyTree, h: Array, base: State, offset: float = 0.0) -> Layer:
        """The layer for a step h."""
        c = method.coefficients
        B = bend = None
        if system.num_constraints:
            B = jacobian(system, base.q, base.t, params) if system.sparse is None else None
            bend = curvature(system, base.q, base.v, base.t, params)
        return cls(system, params, base, offset, c.beta * h**2, c.gamma * h, B, bend)

    def data(self) -> Layer:
        """The fields that can be arguments of a JAX function: all but the system."""
        return self._replace(system=None)

    def with_data(self, data: PyTree) -> Layer:
        """The layer with these fields."""
        return data._replace(system=self.system)

    def located(self, x: Array) -> Array:
        """x (N,) with 0 for internal states."""
        return self.system.with_internal(x, jnp.zeros_like(x))

    def parts(self, z: Array):
        """dw and dL."""
        n = self.system.size
        return z[:n], (None if self.bend is None else z[n:])

    def push(self, w: Array) -> Array:
        """B w."""
        if self.B is not None:
            return matvec(self.B, w)
        return gradient_maps(self.system, self.base.q, self.base.t, self.params)[0](w)

    def pull(self, L: Array) -> Array:
        """B^T L."""
        if self.B is not None:
            return matvec(self.B.T, L)
        return reaction(self.system, self.base.q, self.base.t, self.params, L)

    def path(self, z: Array):
        """The state after the implicit step, for given changes of acceleration and multipliers."""
        base, (dw, dL) = self.base, self.parts(z)
        L = None if dL is None else base.L + dL
        q = self.system.move(base.q, self.X * dw)
        return State(base.t, q, base.v + self.located(self.V * dw), base.w + dw, L=L)

    def rows(self, s: State, bend: Array | None = None) -> Array:
        """The rows that must be zero: M w - Q - B^T L, and B w + curvature."""
        force = residual(self.system, self.params, s)
        if self.bend is None:
            return force - self.offset
        bend = self.bend if bend is None else bend
        assert s.L is not None
        assert bend is not None
        return jnp.concatenate([force - self.pull(s.L), self.push(s.w) + bend]) - self.offset

    def product(self, z: Array):
        """The part of the rows that depends on z at the start itself: M dw - B^T dL, B dw."""
        dw, dL = self.parts(z)
        force = self.inertia(dw)
        return force if dL is None else jnp.concatenate([force - self.pull(dL), self.push(dw)])

    def full_mass(self) -> Array:
        """M at the start, as a matrix."""
        return self.system.full_mass(self.base.q, self.base.t, self.params) if self.M is None else self.M

    def inertia(self, w: Array) -> Array:
        """M w at the start."""
        return (
            matvec(self.M, w) if self.M is not None else self.system.inertia(self.base.q, w, self.base.t, self.params)
        )

    def zeros(self):
        """z = 0."""
        return jnp.zeros(self.system.size + self.system.num_constraints, self.base.v.dtype)


def smoothed(
    method,
    system: FlatSystem,
    s: State,
    params: PyTree,
    h: Array,
    moves: bool = True,
    resolves: bool = False,
    alone: bool = False,
    finish: Callable | None = None,
    lags: bool = False,
) -> State:
    """The state from which the first step h starts, after the layer at the start s.

    moves: whether v becomes v+. resolves: whether there is no layer, as for steps far below h, for which S is M. alone:
    whether no kernel surrounds it. finish: computes the result from the implicit step, by default `finished`. lags:
    whether a keeps its difference from w, as far as the step resolves it.
    """
    damped, corrects = reads_velocity(system, s, params), method.corrects(system) and not lags
    if not (system.num_constraints or damped or corrects):
        return s  # M^-1 Q throws a velocity, but nothing that a spring holds
    size = 0 * h if resolves else h
    # of a linear system outside of the kernel: a loop of the user's around short runs then does it once
    known = factors(method, system, params, method.coefficients.gamma * size) if by_factors(method, system) else None

    def behind(s: State) -> State:
        lag = s.a - s.w if lags else None
        zero = s._replace(w=jnp.zeros_like(s.w), a=lag, L=None if s.L is None else jnp.zeros_like(s.L), friction=None)
        layer = Layer.of(method, system, params, size, zero)
        found = without_layer(method, layer, h, damped and moves and not resolves, corrects, finish or finished, known)
        w, L = layer.parts(found.z)
        if finish is None and not resolves:  # M^-1 Q as it is, where nothing damps
            w, L = tree_where(found.damps, (w, L), (s.w, s.L)) if damped else (s.w, s.L)
        a = w if found.wdot is None else method.corrected(system, found.v, w, found.wdot, h)
        a = a if found.lag is None else a + found.lag
        s1 = s._replace(v=found.v, w=w, a=a, L=L)
        return s1 if found.friction is None else s1._replace(friction=found.friction)

    return one_kernel(behind, s, around=True) if alone else behind(s)


def jumped(
    method: Stepper,
    system: FlatSystem,
    s: State,
    after: State,
    both: tuple,
    h: Array,
    answer: Callable,
    anew: Callable | None = None,
) -> State:
    """The state after a jump of held inputs: `after`, unless damping is stiff.

    anew: the start from s with other params and h, instead of changes to s; used for dry friction, which is not linear.
    """
    new = both[1]
    if not reads_velocity(system, s, new):
        return after
    stiff = is_stiff(method, system, s, new, h, after.w - s.w, answer)

    def smooth(_, s: State, both: tuple, h: Array) -> State:
        old, new = both
        if anew is not None:
            return anew(s, new, h)
        layer = Layer.of(method, system, new, h, s._replace(a=None, friction=None, memory=None))
        layer = layer._replace(offset=layer._replace(params=old).rows(layer.base))
        v, z, *_ = without_layer(method, layer, h, True, False, finished)
        dw, dL = layer.parts(z)
        a, L = (None if x is None else x + change for x, change in ((s.a, dw), (s.L, dL)))
        return s._replace(v=v, w=s.w + dw, a=a, L=L)

    return call_where(smooth, stiff, after, s, both, h)


def grown(
    method: Stepper, system: FlatSystem, s: State, params: PyTree, h: Array, smooth: Callable = smoothed
) -> State:
    """The state from which a step h starts that is far longer than those before.

    If accelerations change by the fraction LEAVES within h, and damping is stiff, it is the state of a smooth start:
    short steps have left what long ones cannot follow. Otherwise, as on a slow manifold, it is s."""
    if not reads_velocity(system, s, params):
        return s
    answer = answers(system, s.q, s.t, params, method.redundant)
    q, v = system.move(s.q, h * s.v), s.v + system.with_internal(h * s.w, jnp.zeros_like(s.w))
    change = answer(system.force(q, v, s.t + h, params) - system.force(s.q, s.v, s.t, params))[0]
    leaves = is_part(system, s, params, change, s.w, LEAVES)
    leaves = leaves & is_stiff(method, system, s, params, h, s.w, lambda dQ: answer(dQ)[0], LEAVES)

    def begin(s: State, params: PyTree, h: Array) -> State:
        return smooth(method, system, s, params, h, lags=True)

    return call_where(begin, leaves, s, params, h)


def is_stiff(method, system, s, params: PyTree, h, w, answer, part: float = STIFF) -> Array:
    """Whether the velocity of an explicit step, h gamma w, changes the accelerations by more than a part of w."""
    v = s.v + system.with_internal(method.coefficients.gamma * h * w, jnp.zeros_like(w))
    change = answer(system.force(s.q, v, s.t, params) - system.force(s.q, s.v, s.t, params))
    return is_part(system, s, params, change, w, part)


def is_part(system: FlatSystem, s: State, params: PyTree, change: Array, w: Array, part: float) -> Array:
    """Whether a change of accelerations is more than a part of these, in the norm of energy."""
    D = system.with_ones(diagonal(system.mass(s.q, s.t, params)))
    return jnp.sum(D * change**2) > part**2 * jnp.sum(D * w**2)


def reads_velocity(system: FlatSystem, s: State, params: PyTree) -> bool:
    """Whether the force depends on v."""
    return traced(lambda v: system.force(s.q, v, s.t, params), s.v).reads(None)[0]


def by_factors(method: Beginning | GeneralizedAlpha, system: FlatSystem) -> bool:
    """Whether the matrix of the implicit step belongs to a linear system that is factorised, not inverted."""
    return system.linear and (system.size > UNROLLED or method.options.solve is not None)


def factors(method, system, params: PyTree, V):
    """The factorisation of the matrix of the implicit step. V: h gamma."""
    if system.factors is not None:
        system = system._replace(factors=system.factors._replace(step=system.factors.start))
    return at_start(method).factorization(system, params, V / method.coefficients.gamma)


def at_start(method):
    """The method of the implicit step: Newmark's."""
    c = method.coefficients
    return replace(method, coefficients=Coefficients(0.0, 0.0, c.beta, c.gamma))


def without_layer(
    method, layer: Layer, h: Array, damped: bool, corrects: bool, finish: Callable, factorize: Callable | None = None
) -> Found:
    """The result of `finish` for the implicit step: a `Found`. factorize: `factors`, if they are known.

    Small matrices are formed once. Only products with these and the force in one place are then differentiated.
    """
    options = method.options

    def by_maps(find: Callable, method: Stepper, data: PyTree, h: Array) -> Found:
        known = layer.with_data(data)
        how = factors(method, known.system, known.params, known.V) if factorize is None else factorize
        inverse, z, tangent = find(known, how)
        drag, damps = damping(known, how, tangent) if damped else (None, None)
        return finish(method, known, inverse, drag, z, h, corrects)._replace(damps=damps)

    def by_matrices(
        find: Callable, invert: Callable, method: Beginning | GeneralizedAlpha, data: PyTree, h: Array
    ) -> Found:
        known = layer.with_data(data)
        if known.system.matrices is None:
            known = known._replace(M=known.system.full_mass(known.base.q, known.base.t, known.params))
        if known.system.linear or not damped:
            z, S, C = expanded(known, invert)
        else:
            z, S, C = find(known)
        drag = Drag(partial(matvec, C), dissipates(known, C)) if damped else None
        return finish(method, known, partial(matvec, S), drag, z, h, corrects)._replace(damps=jnp.any(C != 0))

    data = layer.data()
    large = layer.zeros().size > (UNROLLED if layer.system.linear else LARGEST)
    if large or options.solve is not None or options.redundant is not None or layer.system.sparse is not None:
        if layer.system.linear or not damped:
            return by_maps(lambda known, how: newton_step(known, how, known.zeros()), method, data, h)
        return derivative_at_need(partial(by_maps, at_root), partial(by_maps, searched_by_maps), method, data, h)
    moving = partial(by_matrices, differentiable, differentiable_inverse)
    return derivative_at_need(moving, partial(by_matrices, searched, inverse), method, data, h)


class Drag(NamedTuple):
    """The map (C + C^T)/2, and whether it takes energy from every motion; None if this is only tested for the motions
    that P produces, as for large systems."""

    of: Any
    dissipates: Array | None = None


class Found(NamedTuple):
    """The values after a layer: v+, the changes z = (dw, dL), dw/dt if needed, whether there is any damping, dry
    friction if there is any, and a - w if it is kept."""

    v: PyTree
    z: PyTree
    wdot: Array | None = None
    damps: Any = None
    friction: Any = None
    lag: Array | None = None


def finished(
    method: Beginning | GeneralizedAlpha,
    layer: Layer,
    inverse: Callable,
    drag: Drag | None,
    z: Array,
    h: Array,
    corrects: bool,
) -> Found:
    """The `Found`, from the solve with the matrix of the step, the map C, and z after the implicit step."""
    v, bend = layer.base.v, layer.bend
    if drag is not None:
        v = v + damped_part(layer, inverse, drag, layer.located(layer.V * z[: v.size]), h)
        bend = None if layer.bend is None else curvature(layer.system, layer.base.q, v, layer.base.t, layer.params)
    z = corrected_by(layer, inverse, layer.rows(layer.base._replace(v=v), bend), method.corrections)
    lag = lag_left(layer, inverse)
    if not corrects:
        return Found(v, z, lag=lag)
    (dw, dL), base = layer.parts(z), layer.base
    s = base._replace(v=v, w=base.w + dw, L=None if dL is None else base.L + dL)
    return Found(v, z, layer.parts(rate_of(layer, s, inverse, h))[0])


def expanded(layer: Layer, invert: Callable):
    """The result of Newton's step from 0, the inverse of the matrix of the step there, and C."""
    z = layer.zeros()
    dz, _, (inverse, C) = expansion(layer, z, invert)
    return z - dz, inverse, C


def expansion(layer: Layer, z: Array, invert: Callable = inverse):
    """Newton's step at z, its energy, and the inverse and C, from one loop over columns."""
    system, base, n = layer.system, layer.base, layer.system.size
    dw, dL = layer.parts(z)

    def force(x: Array, dv: Array, dw: Array) -> Array:
        at = State(base.t, system.move(base.q, x), base.v + layer.located(dv), base.w + dw)
        return residual(system, layer.params, at)

    value, tangent = linearized(lambda x: force(*x), (layer.X * dw, layer.V * dw, dw))
    unit, none = jnp.eye(n, dtype=z.dtype), jnp.zeros((n, n), z.dtype)
    directions = jnp.concatenate([layer.X * unit, none]), jnp.concatenate([none, unit]), jnp.concatenate([unit, none])
    columns = lax.map(tangent, directions)
    C = columns[n:].T
    A = columns[:n].T + layer.V * C
    if layer.B is not None:
        rates = matvec(layer.B, base.w + dw) + layer.bend
        value = jnp.concatenate([value - matvec(layer.B.T, base.L + dL), rates])
        A = jnp.block([[A, -layer.B.T], [layer.B, jnp.zeros((len(layer.B), len(layer.B)), A.dtype)]])
    S, value = invert(A), value - layer.offset
    dz = matvec(S, value)
    return dz, jnp.abs(jnp.sum(dz[:n] * value[:n])), (S, (C + C.T) / 2)


def searched(layer: Layer):
    """As `expanded`, at the end of Newton's method."""
    n, N = layer.system.size, layer.zeros().size
    empty = jnp.zeros((N, N), layer.base.v.dtype), jnp.zeros((n, n), layer.base.v.dtype)
    z, dz, (inverse, C) = improved(partial(expansion, layer), layer.zeros(), empty)
    return z - dz, inverse, C


def differentiable(layer: Layer):
    """As above, with derivatives: those of Newton's step at its end, which are exact to order 2^k - 1 after k steps."""
    find, constants = hoisted(lambda: searched(layer))
    found = lax.stop_gradient(find(lax.stop_gradient(constants)))

    def again(_, held: tuple):
        dz, _, more = expansion(layer, held[0], differentiable_inverse)
        return held[0] - dz, *more

    moved = lax.fori_loop(0, STEPS, again, found)
    return jax.tree.map(lambda value, x: value + (x - lax.stop_gradient(x)), found, moved)


def newton_step(layer: Layer, factorize: Callable | Given | Constant, z: Array):
    """The solve with the matrix at z, the next z, and the tangent of the rows."""
    at, along = jax.linearize(layer.path, z)
    value, tangent = linearize_rows(layer.rows, at)
    inverse = factorize_map(lambda dz: tangent(along(dz)), value, around(factorize, lambda: (at, along)))
    return inverse, z - inverse(value), tangent


def at_root(layer: Layer, factorize: Callable | Given | Constant):
    """As above, at the end of Newton's method; differentiated by the implicit-function theorem."""
    n = layer.system.size

    def f(z):
        return layer.rows(layer.path(z))

    def search(z):
        def around_it(z):
            value, tangent = linearized(f, z)
            dz = factorize_map(tangent, value, around(factorize, lambda: jax.linearize(layer.path, z)))(value)
            return dz, jnp.abs(jnp.sum(dz[:n] * value[:n]))

        return improved(around_it, z)[0], None

    def tangent_solve(g, y):
        return solve_map(g, y, factorize)

    return newton_step(layer, factorize, implicit_root(f, layer.zeros(), search, tangent_solve)[0])


def searched_by_maps(layer: Layer, factorize: Callable | Given | Constant):
    """As `at_root`, without derivatives: its loop passes on the last maps, so that none is computed twice."""
    n = layer.system.size

    def around_it(z: Array):
        at, along = jax.linearize(layer.path, z)
        value, tangent = linearize_rows(layer.rows, at)
        inverse = invert(lambda dz: tangent(along(dz)), value, around(factorize, lambda: (at, along)))
        dz = inverse(value, trans=0)
        maps = carried(partial(inverse, trans=0), z), carried(tangent, at)
        return dz, jnp.abs(jnp.sum(dz[:n] * value[:n])), *maps

    step = traced(around_it, layer.zeros())
    z, dz, inverse, tangent = improved(step, layer.zeros(), *jax.tree.map(jnp.zeros_like, step.result[2:]))
    return inverse, z - dz, tangent


def damping(layer: Layer, factorize: Callable | Given | Constant, tangent: Callable):
    """The map (C + C^T)/2 at a state, and whether it is different from 0."""
    v = layer.base.v
    zero = jax.tree.map(jnp.zeros_like, jax.eval_shape(layer.path, layer.zeros()))

    def drag(x: Array) -> Array:
        return tangent(zero._replace(v=layer.located(x)))[: v.size]

    if not (isinstance(factorize, Trusted) or layer.system.linear):
        C = staged(partial(linear_map, drag), v.size)(v)
        C = (C + C.T) / 2
        return Drag(partial(matvec, C), dissipates(layer, C)), jnp.any(C != 0)
    pull = jax.linear_transpose(drag, v)  # large: no matrix is formed

    def both(x: Array) -> Array:
        return (drag(x) + pull(x)[0]) / 2

    return Drag(both), jnp.any(both(jnp.asarray(1 + 0.618 * np.arange(v.size) % 0.5, v.dtype)) != 0)


def dissipates(layer: Layer, C: Array):
    """Whether h gamma x^T C x > -GAINED x^T M x for all x. Otherwise P would amplify what it should remove.

    This holds for every damper, but not for a feedback without reaction, whose C is not symmetric. None if M is sparse.
    """
    if layer.system.matrices is not None:
        return None
    n = layer.system.size
    moves = layer.located(jnp.ones(n, C.dtype))
    C = moves[:, None] * C * moves[None, :]  # internal states keep theirs, whatever they do
    A = lax.stop_gradient(layer.full_mass() + layer.V / GAINED * C)
    unit = jnp.sqrt(jnp.maximum(jnp.abs(diagonal(A)), float(jnp.finfo(A.dtype).tiny)))
    A, least = A / unit[:, None] / unit[None, :], n * float(jnp.finfo(A.dtype).eps)

    def eliminate(k: Array, carry: tuple):
        A, fine = carry
        pivot = A[k, k]
        A = A - A[:, k][:, None] * A[k][None, :] / jnp.where(jnp.abs(pivot) < least, least, pivot)
        return A, fine & (pivot > -least)

    return lax.fori_loop(0, n, eliminate, (A, jnp.array(True)))[1]


def damped_part(
    layer: Layer, inverse: Callable, drag: Drag, dv: Array, h: Array, project: Callable = lambda x: x
) -> Array:
    """P^4 [1 + (5 - 2 gamma) (1 - P)] dv, or 0 where C supplies energy.

    project: keeps P x among the velocities that may change.
    """

    def power(_, carry: tuple):
        x, _, fine = carry
        pull = layer.V * layer.located(drag.of(x))
        if drag.dissipates is None:
            given = layer.inertia(x)
            fine = fine & (jnp.sum(x * pull) >= -GAINED * jnp.sum(x * given))
        return project(response(layer, inverse, pull)), x, fine

    fine = jnp.array(True) if drag.dissipates is None else drag.dissipates
    x, before, fine = lax.fori_loop(0, POWERS, power, (dv, dv, fine))
    return jnp.where(fine, before + (POWERS - 2 * layer.V / h) * (before - x), 0)


def response(layer: Layer, inverse: Callable, force: Array) -> Array:
    """S^-1 of a force, 0 for internal states."""
    n = force.size
    return layer.located(inverse(jnp.pad(force, (0, layer.zeros().size - n)))[:n])


def corrected_by(layer: Layer, inverse: Callable, left: Array, corrections: Corrections = DEFAULT) -> Array:
    """z with product(z) = -left, to the accuracy of the corrections."""

    def correct(_, z: Array) -> Array:
        return z - inverse(left + layer.product(z))

    number, last = corrections
    if last == 1:
        return lax.fori_loop(0, number, correct, layer.zeros())

    def remember(i: Array, both: tuple):
        return correct(i, both[0]), both[0]

    z, before = lax.fori_loop(0, number, remember, (layer.zeros(), layer.zeros()))
    return before + last * (z - before)


def lag_left(layer: Layer, inverse: Callable):
    """The part of a - w that the step resolves; the layer's state holds a - w as its a."""
    lag = layer.base.a
    if lag is None:
        return None
    z = jnp.pad(lag, (0, layer.zeros().size - lag.size))
    return layer.parts(corrected_by(layer, inverse, -layer.product(z)))[0]


def rate_of(layer: Layer, s: State, inverse: Callable, h: Array) -> Array:
    """(dw/dt, dL/dt) at the state s, by the same corrections: a difference quotient over a time far below h, enough for
    first order in h. A derivative would need the third one of the constraints, and compile for long."""
    system, params = layer.system, layer.params

    def rows(later: Array) -> Array:
        q, v, t = system.move(s.q, later * s.v), s.v + layer.located(later * s.w), s.t + later
        force = system.residual(q, v, s.w, t, params)
        if layer.bend is None:
            return force
        along = system.rate(q, v), s.w, jnp.ones_like(t)
        _, bend = jax.jvp(lambda q, v, t: violation(system, q, v, t, params)[1], (q, v, t), along)
        return jnp.concatenate([force - reaction(system, q, t, params, s.L), bend])

    before, after = lax.map(rows, jnp.stack([jnp.zeros_like(h), LATER * h]))
    return corrected_by(layer, inverse, (after - before) / (LATER * h))
