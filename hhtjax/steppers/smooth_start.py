"""A start from which steps go on smoothly, though damping may be far too stiff for their size.

What is light and strongly damped takes a time m/c, far below a step h, to lose the velocity that does not fit its
forces. The acceleration at that start, M^-1 Q, is as large as 1/m. The recursion keeps it, and leaves
h^2 w (1/2 - beta/gamma) of it in q: any multiple of F/k. So a step begins behind that time instead:

    S = M + h gamma C + h^2 beta K,      C = -dQ/dv,  K = -dQ/dq
    M dv = h gamma Q(q + h (beta/gamma) dv, v + dv, t)     an implicit step of the velocity: by Newton, with S
    P = S^-1 h gamma (C + C^T)/2                           1 where damping is stiff, O(h) where the step resolves it
    v+ = v + P^4 [1 + (5 - 2 gamma) (1 - P)] dv
    w <- w + S^-1 [Q(q, v+, t) - M w],  five times from 0

Where the step resolves the motion v+ - v is O(h^5), and w is M^-1 Q but for O(h^5): order and error constants stay.
Elsewhere w is bounded. Forces without dissipation, such as gyroscopic ones, have an antisymmetric C, and move no
velocity. Where C + C^T is 0 nothing changes at all: the recursion throws no spring by its M^-1 Q.

While its velocity changes a coordinate falls back by m/c dv. Here v+ is that of the end, and what the recursion makes
of the rest, v + dv - v+, is half a step of it. With the factor [1 + ...], whose slope at P = 1 is that of P^(2 gamma),
both are the same, but for the square of m/(c h): 1 - 50 q - 5 v from rest ends 4e-4 off at most with any mass and
hht(-.05), h = 1e-3, where P^4 alone leaves 1e-3.

With constraints all solves are those with [S -B^T; B 0]: B dv = h g (-curvature), B P = 0, and w with its multipliers.
Where an input jumps between two steps, dQ = Q(new) - Q(old) takes the place of Q, and dv, dw and dL are changes.
Internal states z, which may be far faster than h, keep theirs.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import freeze, thaw
from hhtjax.numerics.elimination import UNROLLED, diagonal, inverse, matvec
from hhtjax.numerics.implicit_root import implicit_root
from hhtjax.numerics.linear_solve import Trusted, factorize_map, solve_map
from hhtjax.numerics.low_rank import around
from hhtjax.numerics.seldom import choose, derivative_at_need, seldom
from hhtjax.steppers.newton import linearize_rows, linearized
from hhtjax.steppers.residual import Coefficients, residual
from hhtjax.steppers.stepper import State
from hhtjax.systems.constraints import curvature, jacobian, reaction, violation
from hhtjax.xla import linear_map, one_kernel, staged, traced

POWERS, CORRECTIONS = 5, 5
ITERATIONS = 40  # of Newton's method, at most
LARGEST = 64  # unknowns whose matrix is inverted
STIFF = 0.03  # part of a jump of the acceleration by which damping changes it within a step, and h resolves it
GAINED = 0.03  # part of the energy of a motion that a C may give it within a step, and still counts as a damper
SHORTEST = 1e-3  # part of a Newton step below which there is no way on


class Layer(NamedTuple):
    """What is left of the equations at a start, or at a jump.

    base: the state, with accelerations and multipliers to which unknown changes z = (dw, dL) are added. offset: what
    rows are to be. X, V: displacement and velocity by a unit of dw. B, bend: of constraints, None without."""

    system: Any
    params: Any
    base: State
    offset: Any
    X: Any
    V: Any
    B: Any
    bend: Any

    @classmethod
    def of(cls, method, system, params, h, base, offset=0.0):
        """In a step h."""
        c = method.coefficients
        B = bend = None
        if system.num_constraints:
            B = jacobian(system, base.q, base.t, params)
            bend = curvature(system, base.q, base.v, base.t, params)
        return cls(system, params, base, offset, c.beta * h**2, c.gamma * h, B, bend)

    def data(self):
        """What may be arguments of a function of JAX: all but the system, with params frozen."""
        return freeze(self._replace(system=None))

    def with_data(self, data):
        """The layer with these."""
        return thaw(data)._replace(system=self.system)

    def located(self, x):
        """x (N,) with 0 for internal states."""
        return self.system.with_internal(x, jnp.zeros_like(x))

    def parts(self, z):
        """dw and dL."""
        n = self.system.size
        return z[:n], (None if self.B is None else z[n:])

    def path(self, z):
        """The state behind the implicit step, given the changes of acceleration and multipliers."""
        base, (dw, dL) = self.base, self.parts(z)
        L = None if dL is None else base.L + dL
        q = self.system.move(base.q, self.X * dw)
        return State(base.t, q, base.v + self.located(self.V * dw), base.w + dw, L=L)

    def rows(self, s, bend=None):
        """What is to be zero: M w - Q - B^T L, and B w + curvature."""
        force = residual(self.system, self.params, s)
        if self.B is None:
            return force - self.offset
        bend = self.bend if bend is None else bend
        return jnp.concatenate([force - matvec(self.B.T, s.L), matvec(self.B, s.w) + bend]) - self.offset

    def product(self, z):
        """The part of the rows that z enters at the start itself: M dw - B^T dL, B dw."""
        dw, dL = self.parts(z)
        force = self.system.inertia(self.base.q, dw, self.base.t, self.params)
        return force if dL is None else jnp.concatenate([force - matvec(self.B.T, dL), matvec(self.B, dw)])

    def zeros(self):
        """z = 0."""
        return jnp.zeros(self.system.size + self.system.num_constraints, self.base.v.dtype)


def smoothed(method, system, s, params, h, moves=True, resolves=False, alone=False, finish=None):
    """The state from which the first step h goes, behind the layer at the start s.

    moves: whether v becomes v+. resolves: whether there is no layer, as in steps far below h, whose S is M.
    alone: whether no kernel is around. finish: what is made of the implicit step, by default `finished`.
    """
    damped, corrects = reads_velocity(system, s, params), method.corrects(system)
    if not (system.num_constraints or damped or corrects):
        return s  # M^-1 Q throws a velocity, but nothing that a spring holds
    size = 0 * h if resolves else h
    # of a linear system outside of the kernel: a loop of the user's around short runs then does it once
    known = factors(method, system, params, method.coefficients.gamma * size) if by_factors(method, system) else None

    def behind(s):
        zero = s._replace(w=jnp.zeros_like(s.w), a=None, L=None if s.L is None else jnp.zeros_like(s.L), friction=None)
        layer = Layer.of(method, system, params, size, zero)
        found = without_layer(method, layer, h, damped and moves and not resolves, corrects, finish or finished, known)
        w, L = layer.parts(found.z)
        if finish is None and not resolves:  # M^-1 Q as it is, where nothing damps
            w, L = choose(found.damps, (w, L), (s.w, s.L)) if damped else (s.w, s.L)
        a = w if found.wdot is None else method.corrected(system, found.v, w, found.wdot, h)
        s1 = s._replace(v=found.v, w=w, a=a, L=L)
        return s1 if found.friction is None else s1._replace(friction=found.friction)

    return one_kernel(behind, s, around=True) if alone else behind(s)


def jumped(method, system, s, after, both, h, answer):
    """The state behind a jump of held inputs: `after`, but where what damps is stiff.

    That is so where the velocity of an explicit step, h gamma dw, changes the accelerations by more than a part of dw.
    """
    new, dw, V = both[1], after.w - s.w, method.coefficients.gamma * h
    if system.friction is not None or not reads_velocity(system, s, new):
        return after
    force = system.force(s.q, s.v + system.with_internal(V * dw, jnp.zeros_like(dw)), s.t, new)
    change = answer(force - system.force(s.q, s.v, s.t, new))
    D = system.with_ones(diagonal(system.mass(s.q, s.t, new)))
    stiff = jnp.sum(D * change**2) > STIFF**2 * jnp.sum(D * dw**2)

    def smooth(_, s, both, h):
        old, new = map(thaw, both)
        layer = Layer.of(method, system, new, h, s._replace(a=None, friction=None, memory=None))
        layer = layer._replace(offset=layer._replace(params=old).rows(layer.base))
        v, z, *_ = without_layer(method, layer, h, True, False, finished)
        dw, dL = layer.parts(z)
        a, L = (None if x is None else x + change for x, change in ((s.a, dw), (s.L, dL)))
        return s._replace(v=v, w=s.w + dw, a=a, L=L)

    return seldom(smooth, stiff, after, s, freeze(both), h)


def reads_velocity(system, s, params):
    """Whether the force depends on v."""
    return traced(lambda v: system.force(s.q, v, s.t, params), s.v).reads(None)[0]


def by_factors(method, system):
    """Whether the matrix of the implicit step is one of a linear system that is factorised, not inverted."""
    return system.linear and (system.size > UNROLLED or method.options.solve is not None)


def factors(method, system, params, V):
    """What the matrix of the implicit step is factorised by. V: h gamma."""
    if system.factors is not None:
        system = system._replace(factors=system.factors._replace(step=system.factors.start))
    return at_start(method).factorization(system, params, V / method.coefficients.gamma)


def at_start(method):
    """The method whose step the implicit one is: Newmark's."""
    c = method.coefficients
    return replace(method, coefficients=Coefficients(0.0, 0.0, c.beta, c.gamma))


def without_layer(method, layer, h, damped, corrects, finish, factorize=None):
    """What `finish` makes of the implicit step: a `Found`. factorize: `factors`, where they are known.

    The value comes from matrices, where these are small, and traces the force as seldom as can be, for programs that
    compile in less time; derivatives from what is differentiable.
    """
    options = method.options

    def by_maps(method, data, h):
        known = layer.with_data(data)
        how = factors(method, known.system, known.params, known.V) if factorize is None else factorize
        z = known.zeros() if known.system.linear or not damped else root(known, how)
        inverse, z, at, tangent = newton_step(known, how, z)
        drag, damps = damping(known, how, at, tangent)
        return finish(method, known, inverse, drag if damped else None, z, h, corrects)._replace(damps=damps)

    def by_matrices(method, data, h):
        known = layer.with_data(data)
        z, inverse, C = expanded(known, damped)
        drag = Drag(partial(matvec, C), dissipates(known, C)) if damped else None
        return finish(method, known, partial(matvec, inverse), drag, z, h, corrects)._replace(damps=jnp.any(C != 0))

    data = layer.data()
    large = layer.zeros().size > (UNROLLED if layer.system.linear else LARGEST)
    if large or options.solve is not None or options.redundant is not None:
        return by_maps(method, data, h)
    return derivative_at_need(by_maps, by_matrices, method, data, h)


class Drag(NamedTuple):
    """The map (C + C^T)/2, and whether it takes energy from every motion; None where that is asked only of the motions
    that P leads to, as of large systems."""

    of: Any
    dissipates: Any = None


class Found(NamedTuple):
    """Behind a layer: v+, the changes z = (dw, dL), dw/dt where it is asked for, whether anything damps at all, and
    dry friction where there is some."""

    v: Any
    z: Any
    wdot: Any = None
    damps: Any = None
    friction: Any = None


def finished(method, layer, inverse, drag, z, h, corrects):
    """The `Found`, from the solve with the matrix of the step, the map C, and z behind the implicit step."""
    v, bend = layer.base.v, layer.bend
    if drag is not None:
        v = v + damped_part(layer, inverse, drag, layer.located(layer.V * z[: v.size]), h)
        bend = None if layer.B is None else curvature(layer.system, layer.base.q, v, layer.base.t, layer.params)
    z = corrected_by(layer, inverse, layer.rows(layer.base._replace(v=v), bend))
    if not corrects:
        return Found(v, z)
    dw, dL = layer.parts(z)
    base = layer.base
    s = base._replace(v=v, w=base.w + dw, L=None if dL is None else base.L + dL)
    return Found(v, z, layer.parts(rate_of(layer, s, inverse))[0])


def expanded(layer, damped):
    """z behind the implicit step, and the inverse of the matrix of the step and C there, by one loop."""
    system, base, n = layer.system, layer.base, layer.system.size

    def force(x, dv, dw):
        at = State(base.t, system.move(base.q, x), base.v + layer.located(dv), base.w + dw)
        return residual(system, layer.params, at)

    def around(z):
        dw, dL = layer.parts(z)
        value, tangent = linearized(lambda x: force(*x), (layer.X * dw, layer.V * dw, dw))

        def columns(y):
            return tangent((layer.X * y[:n], y[n:], y[:n]))

        J = jax.vmap(columns, out_axes=1)(jnp.eye(2 * n, dtype=z.dtype))
        C = J[:, n:]
        A = J[:, :n] + layer.V * C
        if layer.B is not None:
            value = jnp.concatenate([
                value - matvec(layer.B.T, base.L + dL), matvec(layer.B, base.w + dw) + layer.bend
            ])  # fmt: skip
            A = jnp.block([[A, -layer.B.T], [layer.B, jnp.zeros((len(layer.B), len(layer.B)), A.dtype)]])
        solve = inverse(A)
        value = value - layer.offset
        dz = matvec(solve, value)
        return dz, jnp.abs(jnp.sum(dz[:n] * value[:n])), solve, (C + C.T) / 2

    z = layer.zeros()
    if system.linear or not damped:
        dz, _, solve, C = around(z)
    else:
        empty = jnp.zeros((z.size, z.size), z.dtype), jnp.zeros((n, n), z.dtype)
        z, dz, solve, C = improved(around, z, *empty)
    return z - dz, solve, C


def improved(around, z, *more):
    """The best z that Newton's method finds, with steps that are shortened until the next would be shorter, the next
    step, and what else `around` tells there."""
    eps = float(jnp.finfo(z.dtype).eps)

    def unfinished(carry):
        _, (_, energy, *_), first, part, count = carry
        small = (count > 0) & (energy <= eps**1.1 * first)
        return ~small & (part > SHORTEST) & (count < ITERATIONS)

    def improve(carry):
        z, best, first, part, count = carry
        trial = z - part * best[0]
        found = around(trial)
        better = found[1] < best[1]
        z, best = choose(better, (trial, found), (z, best))
        return z, best, jnp.where(count == 0, best[1], first), jnp.where(better, 1, part / 4), count + 1

    one = jnp.ones((), z.dtype)
    begin = z, (jnp.zeros_like(z), jnp.inf * one, *more), one, one, jnp.zeros((), jnp.int32)
    z, (dz, _, *more), *_ = lax.while_loop(unfinished, improve, begin)
    return z, dz, *more


def newton_step(layer, factorize, z):
    """The solve with the matrix at z, the z that it leads to, the state there, and the tangent of the rows."""
    at, along = jax.linearize(layer.path, z)
    value, tangent = linearize_rows(layer.rows, at)
    inverse = factorize_map(lambda dz: tangent(along(dz)), value, around(factorize, lambda: (at, along)))
    return inverse, z - inverse(value), at, tangent


def damping(layer, factorize, at, tangent):
    """The map (C + C^T)/2 at a state, and whether it is anything but 0."""
    zero, v = jax.tree.map(jnp.zeros_like, at), layer.base.v

    def drag(x):
        return tangent(zero._replace(v=layer.located(x)))[: v.size]

    if not (isinstance(factorize, Trusted) or layer.system.linear):
        C = staged(partial(linear_map, drag), v.size)(v)
        C = (C + C.T) / 2
        return Drag(partial(matvec, C), dissipates(layer, C)), jnp.any(C != 0)
    pull = jax.linear_transpose(drag, v)  # large: no matrix is formed

    def both(x):
        return (drag(x) + pull(x)[0]) / 2

    return Drag(both), jnp.any(both(jnp.asarray(1 + 0.618 * np.arange(v.size) % 0.5, v.dtype)) != 0)


def dissipates(layer, C):
    """Whether h gamma x^T C x > -GAINED x^T M x for all x: else P grows what it should take away.

    So it is of every damper, and not of a feedback without reaction, whose C is not symmetric. None where M is sparse.
    """
    if layer.system.matrices is not None:
        return None
    base, n = layer.base, layer.system.size
    A = lax.stop_gradient(layer.system.full_mass(base.q, base.t, layer.params) + layer.V / GAINED * C)
    unit = jnp.sqrt(jnp.maximum(jnp.abs(diagonal(A)), float(jnp.finfo(A.dtype).tiny)))
    A, least = A / unit[:, None] / unit[None, :], n * float(jnp.finfo(A.dtype).eps)

    def eliminate(k, carry):
        A, fine = carry
        pivot = A[k, k]
        A = A - A[:, k][:, None] * A[k][None, :] / jnp.where(jnp.abs(pivot) < least, least, pivot)
        return A, fine & (pivot > -least)

    return lax.fori_loop(0, n, eliminate, (A, jnp.array(True)))[1]


def damped_part(layer, inverse, drag, dv, h, project=lambda x: x):
    """P^4 [1 + (5 - 2 gamma) (1 - P)] dv, or 0 where C gives energy.

    project: what keeps P x among the velocities that may change.
    """

    def power(_, carry):
        x, _, fine = carry
        pull = layer.V * layer.located(drag.of(x))
        if drag.dissipates is None:
            given = layer.system.inertia(layer.base.q, x, layer.base.t, layer.params)
            fine = fine & (jnp.sum(x * pull) >= -GAINED * jnp.sum(x * given))
        return project(response(layer, inverse, pull)), x, fine

    fine = jnp.array(True) if drag.dissipates is None else drag.dissipates
    x, before, fine = lax.fori_loop(0, POWERS, power, (dv, dv, fine))
    return jnp.where(fine, before + (POWERS - 2 * layer.V / h) * (before - x), 0)


def response(layer, inverse, force):
    """S^-1 of a force, 0 for internal states."""
    n = force.size
    return layer.located(inverse(jnp.pad(force, (0, layer.zeros().size - n)))[:n])


def corrected_by(layer, inverse, left):
    """z with product(z) = -left, as far as the corrections go."""

    def correct(_, z):
        return z - inverse(left + layer.product(z))

    return lax.fori_loop(0, CORRECTIONS, correct, layer.zeros())


def rate_of(layer, s, inverse):
    """(dw/dt, dL/dt) at the state s, by the same corrections."""
    system, params = layer.system, layer.params

    def rows(q, v, t):
        force = system.inertia(q, s.w, t, params) - system.force(q, v, t, params)
        if layer.B is None:
            return force
        along = system.rate(q, v), s.w, jnp.ones_like(t)
        _, bend = jax.jvp(lambda q, v, t: violation(system, q, v, t, params)[1], (q, v, t), along)
        return jnp.concatenate([force - reaction(system, q, t, params, s.L), bend])

    along = system.rate(s.q, s.v), s.w, jnp.ones_like(s.t)
    change = linearized(lambda x: rows(*x), (s.q, s.v, s.t), lambda f, x: jax.jvp(f, (x,), (along,)))[1]
    return corrected_by(layer, inverse, change)


def root(layer, factorize):
    """z behind the implicit step; differentiated by the implicit-function theorem."""
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

    return implicit_root(f, layer.zeros(), search, tangent_solve)[0]
