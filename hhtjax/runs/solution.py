"""What a run returns, and how it tells of a step that failed."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real, all_concrete, is_concrete
from hhtjax.description.presentation import Table, all_known, between, brief, known, leaf_rows, shown
from hhtjax.primitives import block_written
from hhtjax.steppers.friction_switching import DEPENDENT
from hhtjax.steppers.stepper import Info
from hhtjax.systems.constraints import SWITCHED_OFF
from hhtjax.systems.contact import Fault
from hhtjax.systems.matrices import INDEFINITE, MASSLESS, OF_VELOCITY

if TYPE_CHECKING:
    from hhtjax.runs.error_control import Steps
    from hhtjax.steppers.stepper import ContactState


class FailedRunWarning(RuntimeWarning):
    """A run failed, as its `check` says in words; `throw=True` raises a `SimulationError` instead."""


class SimulationError(RuntimeError):
    """A run in which a step failed; raised by `Solution.check`."""


@shown
class ContactForces(NamedTuple):
    """What contacts do at the saved times.

    Attributes:
        normal: (K + 1, m), the forces that press bodies apart, N; 0 where they do not touch.
        friction: (K + 1, m), those along the surfaces, positive against negative sliding.
        closed: (K + 1, m), whether bodies touch.
        sticking: (K + 1, m), whether they also stick; never without friction.
        impacts: (K + 1, m), how many impacts there have been.
        rests_since: (K + 1, m), since when a closed contact has been so, s; -inf: from the start on; inf: it is open.
            Of one that bounced, the time at which infinitely many bounces would have ended.
    """

    normal: Array
    friction: Array
    closed: Array
    sticking: Array
    impacts: Array
    rests_since: Array

    @classmethod
    def of(cls, contact: ContactState) -> ContactForces:
        """Those of a state of a step."""
        m = contact.closed.shape[-1]
        closed = contact.closed > 0
        since = jnp.where(closed, contact.since, jnp.inf)
        forces = contact.f[..., :m], contact.f[..., m:]
        return cls(*forces, closed, contact.sticks > 0, contact.impacts.astype(jnp.int32), since)


@shown
class Failure(NamedTuple):
    """The first step that failed, as data.

    Attributes:
        step: its number, from 1, or 0 if none did.
        newton: whether Newton's iteration failed while the state was still finite.
        quantity: number of the first quantity that is not finite.
        row: index of the row of the constraint that came to depend on those before it, -1 if none did; None without
            constraints.
        solve: what the linear solve left of its right-hand side, if that was too much, else 0; None where the solve is
            the library's own.
        friction: `info.friction`, if that was too much, else 0; None without dry friction.
        mass: what is wrong with a mass that is a function, at the start: 0 nothing, 1 it is not symmetric, 2 not
            positive definite (with constraints: not positive semidefinite); None where the mass is constant.
        event: what went wrong at an event, 0 nothing; None without events. guard: the number of that event.
        contact: `info.contact`, what went wrong with contacts, 0 nothing; None without.
    """

    step: Any
    newton: Array
    quantity: Array
    row: Real = None
    solve: Real = None
    friction: Any = None
    mass: Any = None
    event: Real = None
    guard: Real = None
    contact: Any = None

    def _verdict(self) -> str:
        """How many failed, or what did."""
        step, quantity = known(self.step), known(self.quantity)
        if step is None or quantity is None:
            return ""
        if step.ndim or not step:
            return f"{np.count_nonzero(step)} of {step.size} runs failed" if step.any() else "no step failed"
        if flaw := known(self.mass):
            return f"the mass is not {MASS[int(flaw)]}"
        if event := known(self.event):
            return f"{EVENTS[int(event)][0]} {int(known(self.guard))}"
        if known(self.newton):
            return "Newton did not converge"
        if known(self.solve):
            return "the linear solve left too much"
        if known(self.friction):
            return "the dry friction was not found"
        if contact := known(self.contact):
            return CONTACT[float(contact)].split(". ")[0]
        row = known(self.row)
        if row is not None and row >= 0:
            return "a constraint depends on others"
        return f"{QUANTITIES[quantity]} is not finite"


QUANTITIES = (
    "the position q", "the velocity v", "the acceleration", "the vector of multipliers",
    "the internal state z", "the rate of the internal state z",
)  # fmt: skip
MASS = (None, "symmetric", "positive definite", "the same at all velocities")
CONTACT = {  # what went wrong with contacts
    Fault.NO_FORCES: "no contact forces were found that neither pull nor hold more than friction allows. Take a "
    "smaller dt, or less `friction`",
    Fault.MANY: "contacts let go, stick and slide too often within the step. Take a smaller dt",
    Fault.JAMMED: "a contact jams: with so much friction, more normal force presses the bodies together (Painleve). "
    "Take less `friction`, or compliance in `force`",
    Fault.SEVERAL: "bodies that touch each other meet at several contacts at once, with a `restitution` above 0: what "
    "they do then depends on the order. Take restitution 0",
    Fault.OPEN: "the gap of a closed contact was not brought to 0: its surfaces are too curved for the step. Take a "
    "smaller dt",
    Fault.OVERLAP: "at the start bodies overlap",
    Fault.APPROACH: "at the start bodies touch and go into each other",
    Fault.RANGE: "the `friction` of a contact must be a finite number, 0 or more, and its `restitution` lie in [0, 1]",
}
WAYS = {
    INDEFINITE: f". {MASSLESS}",
    OF_VELOCITY: ": from_lagrangian takes energies that are quadratic in v. Write others as a System(mass, force)",
}
INTERNAL_STATE = 4  # among them


@shown
class Solution(NamedTuple):
    """A trajectory at its saved times, the start included.

    Attributes:
        t: (K + 1,).
        q, v, acceleration: pytrees like q0 and v0 with a leading axis K + 1; of a first-order system y, y' and None.
        multipliers: L (K + 1, m), None without constraints: M w = Q + B^T L.
        dt: the step size; (N,) of steps that were given, one for each; (K,) of a sweep over `times`, one for each
            interval.
        info: `Info` for each of the K intervals between saved times: largest residual, number of Newton iterations, all
            converged, how far the constraints drift; None where the method has nothing to tell.
        failure: the first step that failed, a `Failure`; `check` turns it into an error.
        z, zdot: internal states and their rates, like z0 with a leading axis K + 1; None without.
        friction: tau (K + 1, m), dry friction, positive against positive sliding; None without.
        sticking: (K + 1, m), whether a joint sticks; None without.
        contact: `ContactForces`, what contacts do; None without.
        steps: what error control chose, the `Steps`; dt are those accepted. None without.
        error: (K + 1,) of a run with `adaptive(verify=)`, that of q at each saved time, in its largest coordinate.
        failed: whether the run failed, a property; (B,) of a batch: which members did.
        allowed: what `check` lets pass of it, 10 (rtol max|q| + atol); a tenth of that with verify="tighten".
        events: what happened on the way, `Events`; None without.
        output: what `output=` returned, a pytree with a leading axis K + 1, in the place of q, v, acceleration,
            multipliers, z, zdot, friction and sticking, which are None then; None without.
    """

    t: Array
    q: PyTree
    v: PyTree
    acceleration: PyTree
    multipliers: Array | None
    dt: Any
    info: Info
    failure: Failure
    z: PyTree = None
    zdot: PyTree = None
    friction: Any = None
    sticking: Array | None = None
    contact: Any = None
    steps: Steps | None = None
    error: Any = None
    allowed: Any = None
    events: Events | None = None
    output: PyTree = None

    @property
    def failed(self) -> Array:
        """Whether the run failed, or, of a batch, which members did: those that `check` would raise for, but for
        `reach` and times that float32 cannot tell apart. Data, inside jit too."""
        batch = self.t.shape[:-1]
        failed = (self.failure.step > 0) | ~jnp.all(jnp.diff(self.t) >= 0, axis=-1)
        failed |= jnp.any((self.dt <= 0).reshape(*batch, -1), axis=-1)
        if self.steps is not None:
            failed |= self.steps.stop > 0
        if self.error is not None:
            failed |= ~jnp.all(self.error <= self.allowed[..., None], axis=-1)
        return failed

    def _is_known(self) -> bool:
        """Whether what `check` looks at are numbers: outside of jit, vmap and grad."""
        return all_concrete((self.failure, self.dt, self.t, self.steps, self.error))

    def check(self, reach=None):
        """Raises `SimulationError` naming the first bad step, the quantity and why; silent when all is well.

        reach: how far q may get from its start, in any coordinate and its unit. A run that gets farther has blown up,
        although it is finite still, and is named by the first saved time. By default q may go anywhere.

        For a batch made by vmap, names the first bad member. Not to be called inside jit.
        """
        if not self._is_known():
            raise TypeError("check: the solution is a tracer: call check() outside jit, vmap and grad.")
        if fault := self._fault(reach):
            raise SimulationError(f"simulate: {fault}")

    def _fault(self, reach=None):
        """What is wrong with the run, in words; None where nothing is."""
        t, dt = np.asarray(self.t), np.asarray(self.dt)
        if self.steps is None:
            fault = bad_steps(t, dt, self.events is not None)
        else:
            fault = self.steps._fault() or bad_samples(t, dt)
        if fault:
            return fault
        if self.error is not None and (fault := self._excess()):
            return fault
        steps = np.asarray(self.failure.step)
        strays = np.zeros_like(steps)
        if reach is not None:
            require_number("check", "reach", reach, lambda x: x > 0, "be positive")
            if self.q is None and self.output is not None:
                raise ValueError(f"check: leave `reach` out: the run has kept its output, and no q; received {reach}.")
            strays = self._first_beyond(reach)
            strays = np.where((steps > 0) & (steps <= strays), 0, strays)
        bad = np.where(strays > 0, strays, steps)
        if not bad.any():
            return None
        member, which = first_bad(bad)
        step, time = bad[member], self._time_of(bad[member], member)
        why = (
            f"the position q is farther than {reach:g} from its start. Take a smaller dt, or a method that damps"
            if strays[member]
            else self._why(member)
        )
        return f"{which}step {step} (to t = {time:.6g}) failed: {why}."

    def _excess(self):
        """Where the error of the whole run is more than what was asked for, in words."""
        error, allowed = np.asarray(self.error), np.asarray(self.allowed)
        bad = ~(error <= allowed[..., None])
        if not bad.any():
            return None
        *member, i = (int(x) for x in np.argwhere(bad)[0])
        which = f"member {', '.join(map(str, member))}, " if member else ""
        where = (*member, i)
        time = np.asarray(self.t)[where]
        known = f"{which}at t = {time:.6g} the error of the run is {error[where]:.3g}, by a"
        asked = f"{allowed[tuple(member)]:.3g} was allowed,"
        if self.steps.tightened is None:
            return f"{known} finer run, and {asked} 10 times the tolerance. Take a smaller rtol."
        share = float(np.asarray(self.steps.tightened)[tuple(member)])
        return f"{known} coarser run, and {asked} although steps were chosen for {share:.2g} of the tolerance."

    def _table(self) -> Table:
        """The run in a line, and its arrays."""
        rows = leaf_rows(q=self.q, v=self.v, acceleration=self.acceleration, multipliers=self.multipliers)
        rows += leaf_rows(z=self.z, zdot=self.zdot, friction=self.friction, sticking=self.sticking)
        rows += leaf_rows(contact=self.contact)
        rows += leaf_rows(output=self.output)
        return Table(f"Solution: {self._title()}", [["", "shape", "dtype"], *rows, *leaf_rows(info=self.info)])

    def _title(self) -> str:
        """Saved times, steps, and what `check` would say; of tracers, and of parts of a run, the times alone."""
        numbers = all_known((self.t, self.dt, self.failure))
        if len(numbers) < 2 + 3:
            return f"t {brief(self.t)}"
        t, dt, *failed = numbers
        runs = failed[0].shape
        fitting = t.ndim == len(runs) + 1 and t.shape[:-1] == runs and all(x.shape == runs for x in failed)
        if not fitting or not t.size or dt.shape[: t.ndim - 1] != runs or dt.ndim > t.ndim:
            return f"t {brief(self.t)}"
        if self.steps is not None and np.isfinite(dt).any():
            dt = dt[np.isfinite(dt)]  # behind the steps of a member is nothing
        batch = f"{failed[0].size} runs {runs}, each of " if runs else ""
        fault = self._fault()
        verdict = "every step finite" if fault is None else fault.partition(". ")[0].removesuffix(".")
        if fault is None and self.info.converged is not None:
            verdict += ", and converged"
        if self.events is not None and (met := self.events._verdict()):
            verdict += f"; {met}"
        return f"{batch}{t.shape[-1]} saved times, t = {between(t, 's')}, dt = {between(dt, 's')}; {verdict}"

    def _why(self, member: tuple) -> str:
        """What `failure` says of one member of a batch."""
        found = (0 if x is None else np.asarray(x)[member] for x in self.failure)
        _, newton, quantity, row, left, friction, mass, event, guard, contact = found
        if mass:
            way = WAYS.get(int(mass), "")
            return f"`mass` must be {MASS[mass]}; at the start it is not{way}"
        if event:
            what, advice = EVENTS[int(event)]
            return f"{what} {guard}. {advice}"
        if left:
            return (
                f"the linear solve of the step leaves a residual of {left:.2g} of its right-hand side. Take a larger "
                "half_bandwidth of banded(), a pattern of sparse_lu() that leaves nothing out, more iterations of "
                "conjugate_gradients(), or another solve(A, b); a larger `tolerance` of these accepts it. With sparse "
                "matrices M, C and K are too far apart in size for this step, or for float32"
            )
        if contact:
            return CONTACT[float(contact)]
        if np.isinf(friction):
            return "a limit of the dry friction is negative or not finite: see `friction` of the System"
        if friction == DEPENDENT:
            return (
                "directions of dry friction came to depend on each other, which was not known when the run began. Give "
                'the stepper redundant="least_squares", for all that may depend on each other'
            )
        if friction:
            return (
                f"joints with dry friction switch too often: {friction:.2g} of the step is left. Take a smaller dt, as "
                "for forces that drive what slides"
            )
        if newton:
            return (
                "Newton's iteration did not converge; the state is still finite. Take a smaller dt, or more "
                "max_iterations, or a larger tolerance"
            )
        if self.failure.row is not None and row >= 0:
            return (
                f"row {row} of the constraint depends on the rows before it, or has no gradient: the position is "
                'singular. Give the stepper redundant="least_squares", or formulate the constraint anew. '
                f"{SWITCHED_OFF}"
            )
        started = [x for x in jax.tree.leaves(self.acceleration) if is_concrete(x)]
        if not all(np.isfinite(np.asarray(x)[(*member, 0)]).all() for x in started):
            return (
                "the acceleration is not finite at the start already: there the mass is singular, constraints depend "
                "on each other (outside jit an error names them), or a function of the system is not finite"
            )
        is_first_order = self.acceleration is None and self.output is None
        names = ("y", "y'") if is_first_order else QUANTITIES
        return f"{names[quantity]} is not finite. Take a smaller dt, or another linearize=, or a method that damps"

    def _first_beyond(self, reach: float) -> np.ndarray:
        """Step of the first saved time at which q is farther than `reach` from its start; 0 if none is."""
        t, axis = np.asarray(self.t), self.t.ndim - 1
        far: Any = np.zeros(t.shape, bool)
        for q in map(np.asarray, jax.tree.leaves(self.q)):
            with np.errstate(invalid="ignore"):
                far |= (abs(q - np.take(q, [0], axis)) > reach).any(axis=tuple(range(axis + 1, q.ndim)))
        return np.take_along_axis(self._steps_taken(), far.argmax(axis)[..., None], axis)[..., 0]

    def _steps_taken(self) -> np.ndarray:
        """How many steps come before each saved time."""
        t, dt = np.asarray(self.t), np.asarray(self.dt)
        if self.steps is not None:  # the one that ends at a saved time, or beyond
            taken = np.zeros(t.shape, int)
            for i in np.ndindex(t.shape[:-1]):
                taken[i][1:] = 1 + np.searchsorted(t[i][0] + np.cumsum(dt[i]), t[i][1:])
            return np.minimum(taken, np.asarray(self.steps.accepted)[..., None])
        with np.errstate(all="ignore"):  # what was traced may be anything
            if self._is_every_step():
                taken = np.arange(t.shape[-1]) * (dt.shape[-1] // (t.shape[-1] - 1))
                taken = np.broadcast_to(taken, t.shape)
            elif dt.ndim < t.ndim:
                taken = (t - t[..., :1]) / dt[..., None]
            else:
                counts = np.nan_to_num(np.rint(np.diff(t) / dt), nan=1)
                taken = np.insert(np.cumsum(counts, axis=-1), 0, 0, axis=-1)
        return np.rint(np.nan_to_num(taken, posinf=0, neginf=0)).astype(int)

    def _is_every_step(self) -> bool:
        """Whether dt has the size of each step, and more than one of them may come before a saved time."""
        K = self.t.shape[-1] - 1
        return self.steps is not None or (np.ndim(self.dt) == self.t.ndim and self.dt.shape[-1] != K)

    def _time_of(self, step: Real, member: tuple) -> Real:
        """The time at which a step of a member of a batch ends."""
        taken, t = self._steps_taken()[member], np.asarray(self.t)[member]
        if self._is_every_step():
            return t[0] + np.sum(np.asarray(self.dt)[member][:step])
        if np.ndim(self.dt) < self.t.ndim:  # steps of one size, which may end at none of the saved times
            return t[0] + step * np.asarray(self.dt)[member]
        dt = np.broadcast_to(np.asarray(self.dt)[member], t[1:].shape)
        i = np.clip(np.searchsorted(taken, step) - 1, 0, dt.size - 1)
        return t[i] + (step - taken[i]) * dt[i]


def told(caller: str, solution: Solution, throw: bool) -> Solution:
    """The solution; with a `FailedRunWarning`, or for `throw` an error, where the run failed and that is known now."""
    if solution.failure is None or not is_concrete(solution.failure.step):
        return solution
    failure, steps = solution.failure.step, solution.steps
    failed = np.asarray(failure).any() or (steps is not None and np.asarray(steps.stop).any())
    if (failed or solution.error is not None) and solution._is_known() and (fault := solution._fault()):
        if throw:
            raise SimulationError(f"{caller}: {fault}")
        warnings.warn(f"{caller}: {fault}", FailedRunWarning, stacklevel=3)
    return solution


# ----------------------------------------------------------------------------
# What was wrong with the times and the step sizes of a run, in words: what was traced is not known before.


ORDER = "`times` must increase, and lie after t0; with it they were {}."
ALIKE = "times are alike in {}, near t = {:g}: count from a t0 near zero, or take float64."


def first_bad(bad):
    """The index of the first bad member of a batch, and words for it; () and none where there is no batch."""
    member = tuple(int(i) for i in np.argwhere(bad)[0])
    words = f"member {', '.join(map(str, member))} ({np.count_nonzero(bad)} of {bad.size} failed), "
    return member, words if member else ""


def bad_samples(t: np.ndarray, dt: np.ndarray):
    """Of a run under error control, with times (..., K + 1) and the steps that it chose, NaN behind the last."""
    if not np.all(np.diff(t) >= 0):  # behind an event that ends the run they are its end
        return ORDER.format(t)
    return ALIKE.format(t.dtype, t.flat[0]) if np.any(dt == 0) else None


def bad_steps(t: np.ndarray, dt: np.ndarray, has_events: bool):
    """Of a run with given steps, and of a sweep, whose dt are NaN where they would be longer than between samples."""
    gaps, unknown = np.diff(t), np.isnan(dt)
    is_over_times = t.ndim > 1 and dt.shape == gaps.shape
    if is_over_times and unknown.any() and not np.all((gaps > 0) & np.isfinite(gaps)):
        return ORDER.format(t)
    if np.any(dt <= 0):
        return f"`dt` must be positive and finite; it was {dt[dt <= 0].flat[0]:g}."
    if unknown.any():
        which = first_bad(unknown.reshape(*t.shape[:-1], -1).any(axis=-1))[1]
        return f"{which}`dt` must be positive and finite, and in a sweep at most the distance of the samples."
    if np.any(gaps < 0):
        return ORDER.format(t)
    alike = gaps == 0
    if has_events:  # one may have ended the run, at the last time
        alike &= (t[..., 1:] < t[..., -1:]) | (t[..., :1] == t[..., -1:])
    return ALIKE.format(t.dtype, t.flat[0]) if alike.any() else None


# ----------------------------------------------------------------------------
# What a run tells of its events.


WHOLE = 65  # numbers, at least: an array of fewer would be taken to pieces


@shown
class Events(NamedTuple):
    """The events of a run, in their order; with `keep_events` entries, NaN (of `which` -1) beyond those that were met.

    Attributes:
        count: how many were met, also those beyond the entries.
        t: (keep_events,), when; differentiable.
        which: (keep_events,), the number of the event.
        q: where, like q0 with a leading axis; None of a first-order system.
        before, after: v before and after each, like v0 with a leading axis; y of a first-order system.
        z: internal states there, None without.
        rate: (keep_events,), dg/dt before, the part of multipliers as they change over the step. Where it is small
            beside the velocities the motion grazes the guard, and derivatives are huge, at last infinite.
    """

    count: Array
    t: Array
    which: Array
    q: PyTree
    before: PyTree
    after: PyTree
    z: PyTree
    rate: Any

    def _verdict(self):
        """How many, and whether some are lost; of a batch the fewest and the most."""
        count, times = known(self.count), known(self.t)
        if count is None or times is None or not count.size or not times.ndim:
            return ""
        lost = f", {times.shape[-1]} kept" if count.max() > times.shape[-1] else ""
        return f"{between(count)} {'event' if count.max() == count.min() == 1 else 'events'}{lost}"


class Log(NamedTuple):
    """The events met so far, on vectors: how many, and a column of numbers for each that is kept, NaN beyond, and for
    those of one step more, of which nothing is told."""

    count: Array
    columns: Array

    @classmethod
    def empty(cls, like: PyTree, keep: int, at_once: int) -> Log:
        """Room for so many columns like this one, and for so many in a step."""
        number = max(keep + at_once, -(-WHOLE // like.size))
        return cls(jnp.zeros((), jnp.int32), jnp.full((like.size, number), jnp.nan, like.dtype))

    def with_more(self, rows: Array, there: Array, keep: int) -> Log:
        """With the first of these, as many as are there, as long as there is room; the others are NaN."""
        places = jnp.cumsum(there, dtype=self.count.dtype) - 1
        numbers = jnp.arange(len(places), dtype=places.dtype)
        here = there[None, :] & (places[None, :] == numbers[:, None])  # some that are not there may be before
        rows = jnp.sum(jnp.where(here[:, :, None], rows[None], 0), axis=1)
        rows = jnp.where(jnp.any(here, axis=1)[:, None], rows, jnp.nan)
        columns = block_written(self.columns, rows.T, jnp.minimum(self.count, keep), axis=1)
        return Log(self.count + jnp.sum(there, dtype=self.count.dtype), columns)

    def told(self, flat, keep: int) -> Events:
        """As `Events`."""
        n, N, columns = flat.positions, flat.size, self.columns[:, :keep]
        end = len(columns) - 2 * N  # of q, in which a rotation has nine numbers
        t, which, rate, *columns = jnp.split(columns, [1, 2, 3, end, end + N])
        which = jnp.where(jnp.isnan(which[0]), -1, which[0]).astype(jnp.int32)
        q, before, after = (x.reshape(-1, 1) if len(x) == 1 else x.T for x in columns)  # no copy
        z = None if n in (0, N) else jax.vmap(flat.unravel_internal)(before[:, n:])
        q, unravel = (jax.vmap(flat.unravel)(q), flat.unravel_rates) if n else (None, flat.unravel)
        before, after = (jax.vmap(lambda v: unravel(flat.located(v) if n else v))(v) for v in (before, after))
        return Events(self.count, t[0], which, q, before, after, z, rate[0])


def row_of(t: Array, which: Array, rate: Array, q: Array, before: Array, after: Array) -> Array:
    """What is noted of an event."""
    return jnp.concatenate([jnp.stack([t, which.astype(t.dtype), rate]), q, before, after])


# ----------------------------------------------------------------------------
# What may go wrong at an event, as data and in words.


FINE, MANY, STAYS, ALONG, CORNER, DIFFER, NO_NUMBER, NEGATIVE, THROWN, SINGULAR = range(10)
EVENTS = {  # what it is, before the number of the event, and what to do about it
    MANY: (
        "more than max_events in a step, the first of them event",
        "A motion that comes to rest on a guard gives infinitely many: let it rest by a stiff force, or a constraint "
        "that the event switches on. Else take a smaller dt, or a larger max_events",
    ),
    STAYS: (
        "the motion stays beyond the guard of event",
        "A body that rests there needs a stiff force, or a constraint that the event switches on. An event that turns "
        "nothing back needs a guard that depends on the mode its switch changes. A force that jumps there needs a "
        "mode, too",
    ),
    ALONG: (
        "no velocity changes the guard of event",
        "An impact needs a guard that depends on q, and a motion that may follow it",
    ),
    CORNER: (
        "another event happens at the same time as event",
        "Impacts one after the other are not the same as at once: say what happens by one event with its own reset",
    ),
    DIFFER: (
        "the runs that extrapolate joins do not meet the same events, the first of them event",
        "Take a smaller dt, or leave extrapolate out",
    ),
    NO_NUMBER: (
        "q and v are numbers, but not the guard of event",
        "A guard must be a number beyond its zero, too: q, not sqrt(q)",
    ),
    NEGATIVE: (
        "behind an event, with the params of its switch and the v of its reset, negative is the guard of event",
        "Guards are positive where the motion goes on: behind its event one may need the other sign, by the mode that "
        "the switch changes, or another level",
    ),
    THROWN: (
        "what another event changes takes the motion at once beyond the guard of event",
        "A guard of the velocity jumps with that, and one of params with a switch: say what happens by one event with "
        "a reset and a switch of its own, or let the guard depend on a mode",
    ),
    SINGULAR: (
        "the constraint determines no acceleration behind event",
        f"What its reset and its switch make of v and the params must be numbers, and rows independent. {SWITCHED_OFF}",
    ),
}
