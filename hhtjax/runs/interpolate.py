"""`interpolate`: dense output, the values of a run between its saved times."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree, Real, is_array, is_concrete, is_real
from hhtjax.description.presentation import shown
from hhtjax.numerics.batched_cond import if_any, tree_where
from hhtjax.runs.driver import as_path, as_solution, saved
from hhtjax.runs.output import output_at
from hhtjax.runs.solution import ContactForces, Solution, told
from hhtjax.steppers.stepper import State, public
from hhtjax.steppers.taylor import Expansion, summed
from hhtjax.systems import kinematics, zero_order_hold
from hhtjax.xla import Programs

PRINTED = 1e-6  # times that were written to six digits may lie outside of a run by this part of it

if TYPE_CHECKING:
    from hhtjax.runs.output import Output
    from hhtjax.runs.solution import Failure
    from hhtjax.steppers.stepper import Info, Stepper
    from hhtjax.systems.flat_system import FlatSystem


@shown
class Interpolant(NamedTuple):
    """Values of a run between its saved times; made by `interpolate`. The axes of the requested times come first.

    Attributes:
        q, v: position and velocity; for a first-order system y and None.
        acceleration: the rate of v; None for a first-order system.
        multipliers: L; None without constraints.
        z, zdot: internal states and their rates; None without internal states.
        friction, sticking: dry friction, and whether a joint sticks; None without dry friction.
        output: the output of a run with `output=`, which has none of the other values; else None.
        contact: `ContactForces`; None without contacts.
    """

    q: PyTree
    v: PyTree
    acceleration: PyTree = None
    multipliers: Any = None
    z: PyTree = None
    zdot: PyTree = None
    friction: Any = None
    sticking: Array | None = None
    output: PyTree = None
    contact: Any = None


def interpolate(solution: Solution, times: Real | None) -> Interpolant:
    """Dense output: the values of a run at arbitrary times inside it, differentiable in all arguments.

    Between saved times it uses cubic Hermite polynomials: q from (q, v), v from (v, acceleration), internal states from
    (z, zdot). For a rotation it interpolates the rotation vector relative to the previous saved rotation. The error is
    O(H^4), where H is the spacing of the saved times. The acceleration, and zdot, are the derivatives of these cubics,
    with O(H^3). Multipliers and dry friction are interpolated linearly, with O(H^2). For a joint that begins to slide
    or to stick, the friction is that of the nearer saved time. Outputs of a run with `output=` are interpolated
    linearly, number by number. If O(H^2) is not accurate enough, give the times to the run:
    `simulate(..., times=, output=)`.

    Contact forces are interpolated linearly if no contact switches in between; otherwise they are those of the nearer
    saved time. If a contact has landed in between, all values have order 1: give such a run the times, too.

    If events lie between two saved times, the polynomials end there: q with O(H^4); v and z (and y of a first-order
    system) linear with O(H^2), and their rates constant. At the event itself v is the value after it. Multipliers and
    friction are those saved on the same side of the event, and NaN between two events. If there were more events than
    `keep_events`, everything after the last kept one is NaN. If a held input jumps at a saved time, the values at that
    time are those before the jump.

    Args:
        solution: a single run (use vmap for a batch).
        times: scalar or array, inside [solution.t[0], solution.t[-1]] up to rounding.

    Returns:
        An `Interpolant`.

    For a failed run the `FailedRunWarning` is repeated.

    Raises:
        TypeError, ValueError: times that are not real; a solution of several runs; a time outside the run (for tracers
            the result is NaN instead).
        NotImplementedError: a run with events and `output=`, whose output at the events is unknown.

    >>> import jax.numpy as jnp, hhtjax
    >>> ball = hhtjax.System(mass=jnp.array([1.0]), force=lambda q, v, t, params: 0 * q - 9.81)
    >>> run = hhtjax.simulate(ball, hhtjax.hht(), jnp.array([0.0]), jnp.array([10.0]), dt=0.1, num_steps=10)
    >>> found = hhtjax.interpolate(run, 0.25)
    >>> round(float(found.q[0]), 5), round(float(found.acceleration[0]), 5)                 # 10 t - 9.81 t^2/2
    (2.19344, -9.81)
    """
    t = solution.t
    if t.ndim != 1:
        raise ValueError(f"interpolate: `solution` must be of one run (vmap over a batch); received t of {t.shape}.")
    times = times if is_array(times) else np.asarray(times)
    if not is_real(times):
        raise TypeError(f"interpolate: `times` must be real numbers; received {times!r}.")
    told("interpolate: of a run that failed", solution, throw=False)
    if solution.output is not None and solution.events is not None:
        raise NotImplementedError(
            "interpolate: the output of a run with events is unknown at its events: give `times` to simulate."
        )
    known = solution._replace(dt=None, info=None, failure=None, error=None, steps=None, allowed=None)
    equal = not jnp.ndim(solution.dt) and solution.events is None  # an event may end a run early
    equal = None if equal and not is_concrete(t) else equal and not _are_uneven(t)
    found, outside = _found(known, jnp.asarray(times), equal=equal)
    if is_concrete(outside) and np.any(outside):
        bad = np.asarray(times).astype(t.dtype)[np.asarray(outside)].flat[0]
        raise ValueError(f"interpolate: `times` must lie in [{t[0]:.9g}, {t[-1]:.9g}]; received {bad:.9g}.")
    v = None if solution.acceleration is None else found.v
    return Interpolant(found.q, v, *(getattr(found, name) for name in Interpolant._fields[2:]))


def _are_uneven(t) -> Real:
    """Whether the saved times have other spacings than those of a run, apart from rounding, as when rows were
    selected."""
    xp = np if is_concrete(t) else jnp
    t = xp.asarray(t)
    mean, rounding = (t[-1] - t[0]) / max(len(t) - 1, 1), 4 * float(np.finfo(t.dtype).eps) * xp.max(xp.abs(t))
    return xp.max(xp.abs(xp.diff(t) - mean), initial=0) > rounding


@partial(Programs, static_argnames="equal")
def _found(known: Solution, times: Array, equal: bool | None):
    """The values of a run at the times, and which times lie outside of it. equal: whether its intervals are equal, None
    if this is known only at run time."""
    t, times = known.t, times.astype(known.t.dtype)
    start, end = t[0], t[-1]
    rounding = 16 * float(jnp.finfo(t.dtype).eps) * jnp.maximum(jnp.abs(start), jnp.abs(end))
    slack = jnp.maximum(rounding, PRINTED * (end - start))
    outside = ~((times >= start - slack) & (times <= end + slack))

    def of_equal():
        mean = (end - start) / (t.shape[0] - 1)  # a single difference has lost digits, far from t = 0
        i = jnp.clip(jnp.floor((times - start) / mean).astype(jnp.int32), 0, t.shape[0] - 2)
        return i, jnp.full_like(times, mean)

    def of_any():
        i = jnp.clip(jnp.searchsorted(t, times, side="right").astype(jnp.int32) - 1, 0, t.shape[0] - 2)
        return i, t[i + 1] - t[i]

    if equal is None:
        uneven = _are_uneven(t)
        i, H = if_any(lambda found: tree_where(uneven, of_any(), found), uneven, of_equal())
    else:
        i, H = of_equal() if equal else of_any()
    x = jnp.where(outside, jnp.nan, (times - t[i]) / H)
    a, b = (jax.tree.map(lambda y: y[j], known._replace(events=None)) for j in (i, i + 1))  # noqa: B023 (called at once)
    if known.events is not None:
        a, b, H, x = between_events(known.events, a, b, H, x, times)
    return between(a, b, H, x), outside


def on_axes(x, y: Array) -> Array:
    """x with as many axes as y; x has the leading axes of y."""
    return x.reshape(x.shape + (1,) * (y.ndim - x.ndim))


def between_events(events, a, b, H, x, times):
    """The arguments of `between`, with the events between a and b as additional end points."""
    t = jnp.where(jnp.isnan(events.t), jnp.inf, events.t)
    last = jnp.searchsorted(t, times, side="right") - 1
    earlier, later = jnp.maximum(last, 0), jnp.minimum(last + 1, t.size - 1)
    behind, ahead = (last >= 0) & (t[earlier] >= a.t), (last + 1 < t.size) & (t[later] <= b.t)
    first_order = a.acceleration is None

    def put(here, k, rates, state):
        q = rates if first_order else events.q
        new = {"t": events.t, "q": q} | ({} if first_order else {"v": rates, "z": events.z})
        return state._replace(**{
            name: jax.tree.map(lambda x, y: jnp.where(on_axes(here, y), x[k], y), value, getattr(state, name))
            for name, value in new.items()
        })  # fmt: skip

    a, b = put(behind, earlier, events.after, a), put(ahead, later, events.before, b)
    unknown = jnp.isnan(x) | ((events.count > t.size) & (last + 1 >= t.size))  # outside of the run, or not kept
    inside, H = behind | ahead, jnp.where(behind | ahead, b.t - a.t, H)
    x = jnp.where(unknown, jnp.nan, jnp.where(inside, (times - a.t) / jnp.where(H > 0, H, 1), x))

    def secant(rate, y0: PyTree, y1):
        return jnp.where(on_axes(inside, rate), (y1 - y0) / on_axes(jnp.where(H > 0, H, 1), rate), rate)

    def on_the_same_side(before, after):
        """For values that jump at events: the saved value on this side of them."""
        value = jnp.where(on_axes(inside & ahead, before), before, after)
        if before.dtype == bool:
            return value
        return jnp.where(on_axes(behind & ahead, before), jnp.nan, value)

    for name in ("multipliers", "friction", "sticking"):
        before, after = getattr(a, name), getattr(b, name)
        if before is not None:
            value = on_the_same_side(before, after)
            a, b = (
                side._replace(**{name: jnp.where(on_axes(inside, value), value, old)})
                for side, old in ((a, before), (b, after))
            )
    pairs = {"v": "q"} if first_order else {"acceleration": "v", "zdot": "z"}  # the slope of each, where none is known
    a, b = (
        side._replace(**{
            rate: jax.tree.map(secant, getattr(side, rate), getattr(a, x), getattr(b, x)) for rate, x in pairs.items()
        })
        for side in (a, b)
    )  # fmt: skip
    return a, b, H, x


def between(a: Solution, b: Solution, H: Array, x: Array) -> Solution:
    """The values between the saved values a and b, which are H apart, at the fraction x of the interval, 0 to 1; any
    leading axes.

    Rates are those of the polynomials unless others are known. Multipliers, friction and outputs are linear.
    """

    def hermite(y0: PyTree, y1: Array, slope0: Array, slope1: Array) -> Array:
        s, h = on_axes(x, y0), on_axes(H, y0)
        return y0 + kinematics.hermite(y1 - y0, h * slope0, h * slope1, s)

    def rate(y0: PyTree, y1: Array, slope0: Array, slope1: Array) -> Array:
        s, h = on_axes(x, y0), on_axes(H, y0)
        return kinematics.hermite_rate(y1 - y0, h * slope0, h * slope1, s) / h

    def position(q0: PyTree, q1: Array, v0: PyTree, v1: Array) -> Array:
        if not kinematics.is_rotation(q0.shape, v0.shape):
            return hermite(q0, q1, v0, v1)
        s, h = on_axes(x, v0), on_axes(H, v0)
        return kinematics.interpolate_rotation(q0, q1, h * v0, h * v1, s)

    def linear(y0: PyTree, y1: Array) -> Array:
        return y0 + on_axes(x, y0) * (y1 - y0)

    def nearer(y0: PyTree, y1: PyTree) -> Array:
        return jnp.where(on_axes(x, y0) < 0.5, y0, y1)

    def rubbing(tau0: PyTree, tau1: PyTree, sticks0: PyTree, sticks1: PyTree) -> Array:
        alike = (sticks0 == sticks1) & (sticks0 | (tau0 * tau1 >= 0))
        return jnp.where(alike, linear(tau0, tau1), nearer(tau0, tau1) + 0 * on_axes(x, tau0))

    def pushing(c0: ContactForces, c1: ContactForces) -> ContactForces:
        alike = (c0.closed == c1.closed) & (c0.sticking == c1.sticking)
        forces = (jnp.where(alike, linear(f0, f1), nearer(f0, f1)) for f0, f1 in zip(c0[:2], c1[:2], strict=True))
        return ContactForces(*forces, *map(nearer, c0[2:], c1[2:]))

    def told(y0: PyTree, y1):
        return (linear if jnp.issubdtype(y0.dtype, jnp.floating) else nearer)(y0, y1)

    a = a._replace(output=jax.tree.map(told, a.output, b.output))
    if a.friction is not None:
        friction = rubbing(a.friction, b.friction, a.sticking, b.sticking)
        a = a._replace(friction=friction, sticking=nearer(a.sticking, b.sticking))
    if a.contact is not None:
        a = a._replace(contact=pushing(a.contact, b.contact))
    q = jax.tree.map(position, a.q, b.q, a.v, b.v)
    if a.acceleration is None:
        return a._replace(q=q, v=jax.tree.map(rate, a.q, b.q, a.v, b.v))
    velocities, internal = (a.v, b.v, a.acceleration, b.acceleration), (a.z, b.z, a.zdot, b.zdot)
    v, w = (jax.tree.map(f, *velocities) for f in (hermite, rate))
    z, zdot = (jax.tree.map(f, *internal) for f in (hermite, rate))
    L = jax.tree.map(linear, a.multipliers, b.multipliers)
    return a._replace(q=q, v=v, acceleration=w, multipliers=L, z=z, zdot=zdot)


# ----------------------------------------------------------------------------
# Samples between the ends of steps: read off from the two states around each of the times.


TINY = 1e-9  # part of a run


def kept(flat: FlatSystem, stepper: Stepper, state: State):
    """The values saved of a state, and the additional terms of its dense output."""
    extra = None
    if stepper.reads_series:
        return saved(flat, state), state.memory
    if stepper.dense_term:
        extra = jax.vmap(lambda q, v: public(flat, State(state.t, q, v, 0 * v)))(*state.memory)
        extra = extra.q, (None if flat.positions == 0 else extra.v), extra.z
    return saved(flat, state), extra


def solution_at(
    flat: FlatSystem, start: State, around: tuple | None, times: Array, reached: Array, info: Info, failure: Failure
) -> Solution:
    """The `Solution` at the times, each between two states, from which `kept` has extracted the values in `around`. NaN
    beyond `reached` and before the states. Without `around`, a solution that only has the times."""
    if around is None:
        nothing: Any = None
        t = jnp.concatenate([start.t[None], times])
        return Solution(t, nothing, nothing, nothing, nothing, nothing, info, failure)
    (first, _), (second, extra) = around
    pair = [as_solution(flat, start, path, None, info, failure) for path in (first, second)]
    a, b = (jax.tree.map(lambda x: x[1:], run._replace(dt=None, info=None, failure=None)) for run in pair)
    start = jax.tree.map(lambda x: x[:1], pair[0]._replace(dt=None, info=None, failure=None))
    found = read_between(flat, a, b, extra, times, reached, times[-1] - start.t[0])
    path = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), start, found._replace(t=times))
    return path._replace(info=pair[1].info, failure=pair[1].failure)


def read_between(
    flat: FlatSystem, a: Solution, b: Solution, extra: tuple | None, times: Array, reached: Array, long: Array
) -> Solution:
    """The values at each of the times, between those of a and b."""
    # a part of a step that is a rounding, behind an event, is the beginning of a long one
    H = jnp.where(b.t - a.t > TINY * long, b.t - a.t, long)
    s = jnp.where((a.t <= times) & (times <= reached), (times - a.t) / H, jnp.nan)
    found = between(a, b, H, s)
    if isinstance(extra, Expansion):
        return by_series(flat, a, found, extra, s * H)
    return found if extra is None else with_dense_term(flat, found, extra, s, H)


def with_dense_term(flat, found, extra: tuple, s: Array, H: Array) -> Solution:
    """`found` plus s^2 (1 - s)^2 sum_k s^k e_k, the correction of the stepper's dense output to the cubics, and its
    rate.

    extra: e of q, v and z, each (number of times, number of terms, number of entries) or None."""
    e_q, e_v, e_z = extra
    s, k = s[:, None], jnp.arange(e_q.shape[1], dtype=s.dtype)[None]
    weight = (s * (1 - s)) ** 2 * s**k
    rate = s ** (k + 1) * (1 - s) * ((k + 2) * (1 - s) - 2 * s) / H[:, None]
    terms = [("q", flat.unravel, weight, e_q)]
    if flat.positions:
        terms += [("v", flat.unravel_rates, weight, e_v), ("acceleration", flat.unravel_rates, rate, e_v)]
        terms += [("z", flat.unravel_internal, weight, e_z), ("zdot", flat.unravel_internal, rate, e_z)]
    else:
        terms += [("v", flat.unravel_rates, rate, e_q)]
    for name, unravel, factor, e in terms:
        if e is not None:
            more = jax.vmap(unravel)(jnp.sum(factor[..., None] * e, axis=1))
            found = found._replace(**{name: jax.tree.map(jnp.add, getattr(found, name), more)})
    return found


def by_series(flat: FlatSystem, a: Solution, found: Solution, series: Expansion, h: Array) -> Solution:
    """`found`, with the values at h after a evaluated by the Taylor series from a."""

    def at(series: Expansion, h: Array):
        q, v, w = summed(series, h)
        state = public(flat, State(h, flat.located(q), v, w))
        pairs = (flat.unravel, state.q), (flat.unravel_rates, state.v), (flat.unravel_rates, state.w)
        more = (flat.unravel_internal, state.z), (flat.unravel_internal, state.zdot)
        return [None if x is None else unravel(x) for unravel, x in (*pairs, *more)]

    q, v, w, z, zdot = jax.vmap(at)(series, h)
    q = jax.tree.map(jnp.add, a.q, q) if flat.positions else q
    return found._replace(q=q, v=v, acceleration=w, z=z, zdot=zdot)


def output_between(flat: FlatSystem, output: Output, params: PyTree, pair: tuple, time: Array, long) -> PyTree:
    """The value of `output` at a time between two states, from what `kept` extracted of these; long: see
    `read_between`."""
    (a, _), (b, extra) = jax.tree.map(lambda x: x[None], pair)
    a, b, times = as_path(flat, a), as_path(flat, b), time[None]
    found = read_between(flat, a, b, extra, times, times, long)
    if zero_order_hold.holds(params):  # as the step has had them
        params = zero_order_hold.held_at(params, (a.t[0] + b.t[0]) / 2)
    return output_at(output, jax.tree.map(lambda x: x[0], found), time, params)


def with_output(run: Solution, start: PyTree, found: PyTree, times: Array, reached: Array) -> Solution:
    """The `Solution` with the output at its start and at the times; NaN beyond `reached`."""

    def joined(x: Array, y: Array) -> Array:
        if jnp.issubdtype(y.dtype, jnp.floating):
            y = jnp.where(on_axes(times <= reached, y), y, jnp.nan)
        return jnp.concatenate([x[None], y])

    return run._replace(output=jax.tree.map(joined, start, found))
