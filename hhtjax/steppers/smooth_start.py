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
velocity.

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
from jax import lax

from hhtjax.description import is_concrete
from hhtjax.numerics.elimination import matvec
from hhtjax.numerics.linear_solve import Trusted, factorize_map, solve_map
from hhtjax.numerics.low_rank import around
from hhtjax.steppers.residual import Coefficients, residual
from hhtjax.steppers.stepper import State
from hhtjax.systems.constraints import curvature, jacobian, reaction, violation
from hhtjax.xla import linear_map, staged, traced

POWERS, CORRECTIONS = 5, 5
ITERATIONS = 40  # of Newton's method, at most
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
        force = self.system.inertia(self.base.q, dw, self.params)
        return force if dL is None else jnp.concatenate([force - matvec(self.B.T, dL), matvec(self.B, dw)])

    def zeros(self):
        """z = 0."""
        return jnp.zeros(self.system.size + self.system.num_constraints, self.base.v.dtype)


def smoothed(method, system, s, params, h):
    """The state from which the first step h goes, behind the layer at the start s."""
    zero = s._replace(w=jnp.zeros_like(s.w), a=None, L=None if s.L is None else jnp.zeros_like(s.L))
    layer = Layer.of(method, system, params, h, zero)
    moved, damped = reads(layer)
    if layer.B is None and not (moved or damped):
        return s  # time alone changes the force, and M^-1 Q is as smooth
    v, z, inverse = without_layer(method, layer, h, damped)
    w, L = layer.parts(z)
    a = w
    shift = method.coefficients.alpha_m - method.coefficients.alpha_f
    if method.corrects(system) and not (is_concrete(shift) and shift == 0):
        wdot = layer.parts(rate_of(layer, s._replace(v=v, w=w, L=L), inverse))[0]
        a = method.corrected(system, v, w, wdot, h)
    return s._replace(v=v, w=w, a=a, L=L)


def reads(layer):
    """Whether the force depends on q, and on v."""
    s, force = layer.base, layer.system.force
    return traced(lambda q, v: force(q, v, s.t, layer.params), s.q, s.v).reads(None)


def without_layer(method, layer, h, damped):
    """v+, the changes z = (dw, dL), and the solve with the matrix of the step."""
    c = method.coefficients
    newmark = replace(method, coefficients=Coefficients(0.0, 0.0, c.beta, c.gamma))
    factorize = newmark.factorization(layer.system, layer.params, h)
    v = layer.base.v
    if damped:
        z = layer.zeros() if layer.system.linear else root(layer, factorize)
        inverse, z, at, tangent = newton_step(layer, factorize, z)
        dv = layer.located(layer.V * z[: v.size])
        v = v + damped_part(layer, factorize, inverse, at, tangent, dv, h)
    else:
        inverse, *_ = newton_step(layer, factorize, layer.zeros())
    bend = None if layer.B is None else curvature(layer.system, layer.base.q, v, layer.base.t, layer.params)
    left = layer.rows(layer.base._replace(v=v), bend)
    return v, corrected_by(layer, inverse, left), inverse


def newton_step(layer, factorize, z):
    """The solve with the matrix at z, the z that it leads to, the state there, and the tangent of the rows."""
    at, along = jax.linearize(layer.path, z)
    value, tangent = jax.linearize(layer.rows, at)
    inverse = factorize_map(lambda dz: tangent(along(dz)), value, around(factorize, lambda: (at, along)))
    return inverse, z - inverse(value), at, tangent


def damped_part(layer, factorize, inverse, at, tangent, dv, h):
    """P^4 [1 + (5 - 2 gamma) (1 - P)] dv."""
    zero, n = jax.tree.map(jnp.zeros_like, at), dv.size

    def drag(x):
        return layer.located(tangent(zero._replace(v=layer.located(x)))[:n])

    if isinstance(factorize, Trusted):  # large: no matrix is formed
        pull = jax.linear_transpose(drag, dv)

        def both(x):
            return (drag(x) + pull(x)[0]) / 2
    else:
        C = staged(partial(linear_map, drag), n)(dv)
        both = partial(matvec, (C + C.T) / 2)

    def power(_, pair):
        x = pair[0]
        y = jnp.pad(layer.V * both(x), (0, layer.zeros().size - n))
        return layer.located(inverse(y)[:n]), x

    x, before = lax.fori_loop(0, POWERS, power, (dv, dv))
    return before + (POWERS - 2 * layer.V / h) * (before - x)


def corrected_by(layer, inverse, left):
    """z with product(z) = -left, as far as the corrections go."""

    def correct(_, z):
        return z - inverse(left + layer.product(z))

    return lax.fori_loop(0, CORRECTIONS, correct, layer.zeros())


def rate_of(layer, s, inverse):
    """(dw/dt, dL/dt) at the state s, by the same corrections."""
    system, params = layer.system, layer.params

    def rows(q, v, t):
        force = system.inertia(q, s.w, params) - system.force(q, v, t, params)
        if layer.B is None:
            return force
        along = system.rate(q, v), s.w, jnp.ones_like(t)
        _, bend = jax.jvp(lambda q, v, t: violation(system, q, v, t, params)[1], (q, v, t), along)
        return jnp.concatenate([force - reaction(system, q, t, params, s.L), bend])

    along = system.rate(s.q, s.v), s.w, jnp.ones_like(s.t)
    return corrected_by(layer, inverse, jax.jvp(rows, (s.q, s.v, s.t), along)[1])


def root(layer, factorize):
    """z behind the implicit step, by Newton with steps that are shortened until the next would be shorter.

    Where there is no way on it stays at the best that was found. Differentiated by the implicit-function theorem."""
    n, eps = layer.system.size, float(jnp.finfo(layer.base.v.dtype).eps)

    def once(f, z):
        value, tangent = jax.linearize(f, z)
        at = around(factorize, lambda: jax.linearize(layer.path, z))
        dz = factorize_map(tangent, value, at)(value)
        return dz, jnp.abs(jnp.sum(dz[:n] * value[:n]))  # the energy of the step to come

    def search(f, z):
        def unfinished(carry):
            _, _, energy, first, part, count = carry
            small = (count > 0) & (energy <= eps**1.1 * first)
            return ~small & (part > SHORTEST) & (count < ITERATIONS)

        def improve(carry):
            z, dz, energy, first, part, count = carry
            trial = z - part * dz
            next_dz, next_energy = once(f, trial)
            better = next_energy < energy
            z, dz, energy = (
                jnp.where(better, x, y) for x, y in ((trial, z), (next_dz, dz), (next_energy, energy))
            )
            return z, dz, energy, jnp.where(count == 0, energy, first), jnp.where(better, 1, part / 4), count + 1

        one = jnp.ones((), z.dtype)
        begin = z, jnp.zeros_like(z), jnp.inf * one, one, one, jnp.zeros((), jnp.int32)
        return lax.while_loop(unfinished, improve, begin)[0]

    def tangent_solve(g, y):
        return solve_map(g, y, factorize)

    return lax.custom_root(lambda z: layer.rows(layer.path(z)), layer.zeros(), search, tangent_solve)
