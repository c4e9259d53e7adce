"""How a step is solved: by one linearisation, or by Newton's iteration."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.numerics import dense_lu
from hhtjax.numerics.batched_cond import call_where, derivative_of, tree_where
from hhtjax.numerics.closures import hoisted
from hhtjax.numerics.dense_lu import by_factors, diagonal
from hhtjax.numerics.differentiable_while import implicit_root
from hhtjax.numerics.linear_solve import Trusted, factorize_map, invert_and_bound, reuse, solve_map
from hhtjax.numerics.low_rank import Constant, around
from hhtjax.numerics.sparse_solve import changing, kept
from hhtjax.primitives import staged, traced
from hhtjax.steppers.residual import residual
from hhtjax.steppers.stepper import Info, State
from hhtjax.systems import kinematics
from hhtjax.systems.flat_system import Factors

if TYPE_CHECKING:
    from hhtjax.numerics.low_rank import Changing, Known, Updated
    from hhtjax.numerics.sparse_solve import ChangingSparse
    from hhtjax.systems.flat_system import FlatSystem, Local

RELATIVE = 1e-6  # of the terms of a row, above which its residual is never small; nor above what `tolerance` is of 1
SHAKE, NOISE, SHAKES = 2, 32, 3  # roundings by which a state is changed; how much more than that passes; how often


def linearized_solve(
    r: Callable, path: Callable, w: Array, factorize: Callable | Constant, at: State | None = None, again: bool = False
):
    """w1 with r(path(w1)) = 0, r replaced by its tangent at the state `at` (default: path(w)), and its `Info`.

    One linearisation, one factorisation, one solve: this is the non-iterative step, and a Newton step. again: one more
    solve, of the residual at the end, which becomes `Info.defect`.
    """
    w, info, *_ = solve_and_keep(r, path, w, factorize, at, again)
    return w, info


def solve_and_keep(
    r: Callable,
    path: Callable,
    w: Array,
    factorize: Callable | Constant | Updated,
    at: State | None = None,
    again: bool = False,
):
    """As `linearized_solve`; also returns the solve b -> x for more right-hand sides, and the linear function from x to
    the change of state."""
    expansion = Expand(partial(linearize_rows, r), partial(jax.linearize, path), w)(at)
    return *solve_expanded(r, path, w, factorize, again, expansion), expansion.along


def linearized(f: Callable, x: PyTree, linearize: Callable = jax.linearize):
    """f(x) and its tangent there; explains the error if a callback has no derivative."""
    with callbacks_named():
        return linearize(f, x)


@contextmanager
def callbacks_named():
    """Explains which derivatives are needed, if a callback has none."""
    try:
        yield
    except ValueError as error:
        if "callbacks do not support JVP" not in str(error):
            raise
        raise ValueError(
            "this stepper needs the derivatives of the force (and mass and constraint) in q and v, and in t for "
            "`rosenbrock` or events. `jax.pure_callback` and `io_callback`, which are called there, have "
            "none. Define them by `jax.custom_jvp`, or take a stepper that needs none, such as `rk4()`."
        ) from error


def linearize_rows(r: Callable, s: State, linearize: Callable = jax.linearize):
    """r and its tangent about a state s, for changes that do not change the time.

    If r cannot be differentiated in the time, as with a `jax.pure_callback` of it, the time is held constant.
    """
    try:
        return linearize(r, s)
    except ValueError:
        return linearized(lambda x: r(x._replace(t=s.t)), s, linearize)


class Expansion(NamedTuple):
    """The expansion of r about a state. value: of r at path(w), by its tangent; here: r at the state; along: the
    tangent of path."""

    value: Array
    at: Any
    tangent: Callable
    along: Any
    here: Array


class Expand:
    """State -> the `Expansion` about it, or about path(w) for None. r, path: results of `jax.linearize`."""

    def __init__(self, r, path, w: Array):
        self.r, self.path, self.w = r, path, w
        self.predicted, self.other = staged(self._predicted, w.size), staged(self._other, w.size)

    def __call__(self, at: State | None = None, known: tuple | None = None) -> Expansion:
        """The `Expansion`; known: path(w) and the tangent of path, if they are available."""
        if at is None:
            return Expansion(*self.predicted(self.w))
        start, along = staged(self.path, self.w.size)(self.w) if known is None else known
        value, tangent, here = self.other(start, at)
        return Expansion(value, at, tangent, along, here)

    def _predicted(self, w: Array):
        start, along = self.path(w)
        here, tangent = self.r(start)
        return here, start, tangent, along, here

    def _other(self, start: State, at: State):
        here, tangent = self.r(at)
        return here + tangent(jax.tree.map(jnp.subtract, start, at)), tangent, here


def solve_expanded(
    r: Callable, path: Callable, w: Array, factorize: Callable | Changing | Constant, again: bool, expansion: Expansion
):
    """w1 with r(path(w1)) = 0 by the expansion, its `Info`, and the solve."""
    value, at, tangent, along, _ = expansion

    def f(dw: Array) -> Array:
        return tangent(along(dw))

    factorize = around(factorize, lambda: (at, along))
    inverse = factorize_map(f, value, factorize)
    dw = inverse(value)
    w1, info = w - dw, told(factorize, left_by(factorize, f, value, dw))
    return w1, info._replace(defect=inverse(staged(r, w.size)(path(w1)))) if again else info, inverse


def left_by(factorize: Callable | Constant | Known, f: Callable, b: Array, x: Array):
    """The relative residual of b = f(x); None for the library's own solve, which need not be checked."""
    return factorize.leaves(f, b, x) if isinstance(factorize, Trusted) else None


def told(factorize, left, info=Info()) -> Info:  # noqa: B008 (a tuple)
    """The `Info` of a step whose solve left this residual."""
    return info if left is None else info._replace(solve_residual=left, solved=factorize.accepts(left))


def newton(
    system: FlatSystem,
    r: Callable,
    path: Callable,
    w: Array,
    s: State,
    factorize: Callable | Changing | Constant,
    tolerance: Real,
    max_iterations: int,
):
    """Newton on r(path(w)) from w, where s is the state before, until each row of r is small compared with its own
    terms:

        |r_i| <= tolerance and |r_i| <= relative (|A| |w|)_i,    or each is no larger than its rounding,

    relative being RELATIVE, or the tolerance if that is smaller. So units in which all terms are small do not loosen
    the test, and no row is compared with the forces of another. Rounding is tested when an iteration no longer halves a
    row.

    Differentiated by the implicit-function theorem, forward and reverse.
    """

    relative = jnp.minimum(RELATIVE, jnp.maximum(tolerance, SHAKE * NOISE * float(jnp.finfo(w.dtype).eps)))

    def f(w: Array) -> Array:
        return r(path(w))

    def search(w: Array):
        def unfinished(carry: tuple) -> Array:
            _, value, iterations, converged, _ = carry
            return ~converged & (iterations < max_iterations) & jnp.all(jnp.isfinite(value))

        def improve(carry: tuple):
            w0, _, iterations, _, left = carry
            before, tangent = staged(partial(linearized, f), w.size)(w0)
            here = around(factorize, lambda: jax.linearize(path, w0))
            inverse, terms = invert_and_bound(tangent, w, here)
            dw = inverse(before, trans=0)
            w1 = w0 - dw
            value = f(w1)
            limit = jnp.minimum(tolerance, relative * terms(w1))
            large = jnp.abs(value) > limit
            stalled = jnp.any(large & (jnp.abs(value) > 0.5 * jnp.abs(before)))
            small = ~jnp.any(large) | is_rounding(system, r, s, path(w1), value, limit, stalled)
            if isinstance(factorize, Trusted):
                left = jnp.maximum(left, factorize.leaves(tangent, before, dw))
            return w1, value, iterations + 1, small, left

        left = jnp.zeros((), w.dtype) if isinstance(factorize, Trusted) else None
        begin = w, jnp.zeros_like(w), jnp.zeros((), jnp.int32), jnp.array(False), left
        w, value, iterations, converged, left = lax.while_loop(unfinished, improve, begin)
        # as floats: integers have no tangents, which an evaluation on scalars cannot hand on
        return w, (jnp.max(jnp.abs(value)), iterations.astype(w.dtype), converged.astype(w.dtype), left)

    def tangent_solve(g: Callable, y: Array) -> Array:
        return solve_map(g, y, factorize)

    w, (size, iterations, converged, left) = implicit_root(f, w, search, tangent_solve)
    return w, told(factorize, left, Info(size, iterations.astype(jnp.int32), converged > 0))


def is_rounding(system: FlatSystem, r: Callable, s0: State, s1: State, value: Array, limit: Array, ask: Array) -> Array:
    """If asked, whether each row of r is below its limit, or changes by as much when s1 is rounded differently.

    It is a loop and not a condition, because a loop under vmap takes only the steps that some member needs.
    """
    sizes = term_sizes(system, s0, s1)

    def unsettled(carry: tuple) -> Array:
        i, allowed = carry
        return ask & (i < SHAKES) & ~jnp.all(jnp.abs(value) <= allowed)

    def shake(carry: tuple):
        i, allowed = carry
        shaken = s1._replace(**{name: getattr(s1, name) + _shake(size, i) for name, size in sizes.items()})
        return i + 1, jnp.maximum(allowed, NOISE * jnp.abs(r(shaken) - value))

    _, allowed = lax.while_loop(unsettled, shake, (jnp.zeros((), jnp.int32), limit))
    return ask & jnp.all(jnp.abs(value) <= allowed)


def term_sizes(system: FlatSystem, s0: State, s1: State):
    """The sizes of the terms of which the numbers of the state s1, reached from s0, are sums; roundings are relative to
    these."""
    h = s1.t - s0.t
    w = jnp.abs(s0.w) + jnp.abs(s1.w)
    v = jnp.abs(s0.v) + jnp.abs(s1.v) + h * w
    sizes = {"q": kinematics.terms(system.blocks, s0.q, s1.q, system.located(h * v)), "v": v, "w": w}
    return sizes if s1.L is None else sizes | {"L": jnp.abs(s0.L) + jnp.abs(s1.L)}


def _shake(size: Array, i: Array) -> Array:
    """A few roundings, of both signs and unequal, so that equal terms do not cancel; different for each i."""
    k, golden = np.arange(size.size), 0.618034
    first = (0.75 + golden * k % 0.5) * np.where(k % 2, -1, 1)
    more = (0.75 + golden**2 * k % 0.5) * np.where(k % 3, 1, -1)
    unit = SHAKE * float(jnp.finfo(size.dtype).eps)
    return size * (jnp.asarray(unit * first, size.dtype) + i.astype(size.dtype) * jnp.asarray(unit * more, size.dtype))


# ----------------------------------------------------------------------------
# The matrix of the step of a linear system, or of the linear part of one, factorised once for a whole run.


def factorized_once(method, system, params: PyTree, dt):
    """The factorised matrix of a linear system, used instead of `factorize`."""
    if system.knows_matrices and method.options.solve is None:
        return kept(step_matrix(method, system, params, dt))
    known = known_inverse(system)
    return reuse(method.factorize, known or method.factorize(step_matrix(method, system, params, dt)))


def known_inverse(system: FlatSystem):
    """The solve with the matrix of the step, if its factors are known."""
    return None if system.factors is None else by_factors(system.factors.step)


def factors_of(method, start, system: FlatSystem, dt: Array):
    """The `Factors` of a linear system of constant matrices; start: the method whose matrix the start of a run uses."""
    if method.options.solve is not None:
        return None
    step, first = (dense_lu.lu(step_matrix(x, system, None, dt)) for x in (method, start))
    M = system.mass(jnp.zeros(system.size, dt.dtype), 0 * dt, None)
    return Factors(None if M.ndim == 1 else dense_lu.lu(M), first, step)


def linear_part(method, system, params: PyTree, dt: Array):
    """A `Changing` that has the linear part, and adds the Jacobian of the additional force at each state.

    None if there is no linear part to keep; also for a linear system without friction, which has no other part.
    """
    local = system.local
    if method.options.solve is not None:
        return None
    if local is not None:
        return with_local(step_matrix(method, local.linear, params, dt), local, params, known_inverse(system))
    if system.linear and system.friction is not None:
        return Constant(step_matrix(method, system, params, dt), known_inverse(system))
    return None


def with_local(A, local: Local, params: PyTree, inverse=None) -> Changing | ChangingSparse:
    """The `Changing` of the matrix of the linear part and the Jacobian of the additional force."""

    def slope(s: State):
        return jax.linearize(lambda s: local.force(s.q, s.v, s.t, params), s)[1]

    if A.ndim == 1 and local.size is None:  # the force beside it has a full Jacobian
        A = jnp.diag(A)
    return changing(A, slope, local.spread, local.size, inverse)


def step_matrix(method, system, params: PyTree, dt):
    """The matrix of the step of a linear system; a diagonal one (n,)."""
    zero = jnp.zeros(1 if system.knows_matrices else system.size, dt.dtype)
    rest = State(jnp.zeros_like(dt), zero, zero, zero, zero)
    path = partial(method.arrive, system, rest, dt)
    if system.knows_matrices:
        _, change = jax.jvp(path, (zero,), (jnp.ones_like(zero),))  # the same for every unknown
        return system.step_matrix(params, change.w[0], change.v[0], change.q[0])
    return jax.jacfwd(lambda w: residual(system, params, path(w)))(zero)


# ----------------------------------------------------------------------------
# The state about which the non-iterative step expands its residual: where it is worth the most.


HELD_THRESHOLD = 0.3  # "auto": residual, relative to M w, above which the held point may be preferred


def linearized_step(
    system: FlatSystem,
    params: PyTree,
    r: Callable,
    path: Callable,
    s: State,
    dt: Array,
    factorize: Callable | Changing | Constant,
    where: str | None,
    again: bool = False,
):
    """w at t + dt by one linearisation of r, about the state named by `where`, and its `Info`."""
    if where == "predictor":
        return linearized_solve(r, path, s.w, factorize, None, again)
    now = s._replace(t=s.t + dt)
    if where == "state":
        return linearized_solve(r, path, s.w, factorize, now, again)
    held = now._replace(q=system.move(s.q, dt * s.v))
    if where == "held":
        return linearized_solve(r, path, s.w, factorize, held, again)

    # each traced once, for both states that r is expanded about
    rows = partial(linearize_rows, r, linearize=linearize)
    expand = Expand(traced(rows, now), traced(partial(linearize, path), s.w), s.w)

    @jax.jit
    def solution(expansion: Expansion):
        return solve_expanded(r, path, s.w, factorize, again, expansion)[:2]

    def about(at: State | None, known: tuple | None = None):
        expansion = expand(at, known)
        return *solution(expansion), expansion

    D = system.with_ones(diagonal(system.mass(s.q, s.t, params)))
    limit = HELD_THRESHOLD**2 * jnp.sum(D * s.w**2)
    ways = path(s.w), held, lambda r: jnp.sum(r * (r / D)), limit
    better = partial(better_solve, about)
    if system.sparse is not None:
        better = partial(better_solve_in_turn, about, lambda: expand.path(s.w))
    # derivatives by one expansion about the state that was chosen: through both they would take longer to compile
    return derivative_of(lambda: about(better_state(r, *ways))[:2], lambda: better(*ways[1:]))


def linearize(f: Callable, x: Array | State):
    """As `jax.linearize`, with a tangent that can leave a jit, and is traced once, however often it is called."""
    value, tangent = jax.linearize(f, x)
    call, constants = hoisted(tangent, x)
    return value, jax.tree_util.Partial(call, constants)


def better_state(r: Callable, predicted: State, held: State, size: Callable, limit: Array) -> State:
    """The predicted state; or the held state, if the residual at the predicted state is large, and larger than at the
    held one."""
    size = staged(lambda s, size=size: size(r(s)))
    predicted_size = size(predicted)
    use_predictor = lax.cond(predicted_size <= limit, lambda: jnp.array(True), lambda: predicted_size <= size(held))
    return tree_where(use_predictor, predicted, held)


def better_solve(about: Callable, held: State, size: Callable, limit: Array):
    """The solution about the better state, with a second evaluation of r only if the first residual is large.

    The branch surrounds the whole solve, instead of a choice of the state before it: the processor can then continue
    while it waits for the residual.
    """
    w, info, first = about(None)
    predicted_size = size(first.here)

    def better(found: tuple):
        w, info, expansion = about(held, (first.at, first.along))
        return tree_where(predicted_size <= size(expansion.here), found, (w, info))

    return call_where(better, ~(predicted_size <= limit), (w, info))


def better_solve_in_turn(about: Callable, first: Callable, held: State, size: Callable, limit: Array):
    """As `better_solve`, by a loop with one or two passes: a large program then contains one expansion, not two.

    first: () -> path(w) and the tangent of path."""
    known = start, _ = first()

    def solve(at: State):
        w, info, expansion = about(at, known)
        return (w, info), size(expansion.here)

    solved = traced(solve, held)

    def visit(carry: tuple):
        found, smallest, is_first, _ = carry
        other, here = solved(tree_where(is_first, start, held))
        found = tree_where(is_first | ~(smallest <= here), other, found)
        return found, here, jnp.array(False), is_first & ~(here <= limit)

    nothing = jax.tree.map(jnp.zeros_like, solved.result)
    yes = jnp.array(True)
    return lax.while_loop(lambda carry: carry[3], visit, (*nothing, yes, yes))[0]


def refresh(system: FlatSystem, params: PyTree, c, s, factorize):
    """The state with the acceleration w = M^-1 Q for its q and v, and the residual of the solve."""
    Q = system.force(s.q, s.v, s.t, params)
    w = system.acceleration(s.q, s.v, s.t, params, factorize)
    left = left_by(factorize, lambda w: system.inertia(s.q, w, s.t, params), Q, w)
    return s._replace(w=w, a=s.a + (1 - c.alpha_f) / (1 - c.alpha_m) * (w - s.w)), told(factorize, left)
