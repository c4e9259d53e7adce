"""What a run returns, and how `check` reports a step that failed."""

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
from hhtjax.systems.matrices import INDEFINITE, MASSLESS, OF_VELOCITY, RUBBED

if TYPE_CHECKING:
    from hhtjax.runs.error_control import Steps
    from hhtjax.steppers.stepper import ContactState


class FailedRunWarning(RuntimeWarning):
    """A run failed; the message says what `check` says. With `throw=True` a `SimulationError` is raised instead."""


class SimulationError(RuntimeError):
    """A run in which a step failed; raised by `Solution.check`."""


@shown
class ContactForces(NamedTuple):
    """Forces and states of contacts at the saved times.

    Attributes:
        normal: (K + 1, m), normal forces in N, positive where they press the bodies apart; 0 where they do not touch.
        friction: (K + 1, m), forces along the surfaces, positive in the direction of positive `sliding`.
        closed: (K + 1, m), whether the bodies touch.
        sticking: (K + 1, m), whether they also stick; always False without friction.
        impacts: (K + 1, m), number of impacts so far.
        rests_since: (K + 1, m), the time at which a contact closed for the last time, in s; -inf: it has been closed
            since the start; inf: it is open. After bouncing it is the time at which the infinite sequence of bounces
            would have ended.
    """

    normal: Array
    friction: Array
    closed: Array
    sticking: Array
    impacts: Array
    rests_since: Array

    @classmethod
    def of(cls, contact: ContactState) -> ContactForces:
        """The forces and states of contacts in the state of a step."""
        m = contact.closed.shape[-1]
        closed = contact.closed > 0
        since = jnp.where(closed, contact.since, jnp.inf)
        forces = contact.f[..., :m], contact.f[..., m:]
        return cls(*forces, closed, contact.sticks > 0, contact.impacts.astype(jnp.int32), since)


@shown
class Failure(NamedTuple):
    """The first step that failed, as data.

    Attributes:
        step: its number, from 1; 0 if no step failed.
        newton: whether Newton's iteration failed while the state was still finite.
        quantity: number of the first quantity that is not finite: 0 q, 1 v, 2 acceleration, 3 multipliers, 4 z, 5 zdot.
        row: index of the first constraint row that became dependent on the rows before it, -1 if none did; None without
            constraints.
        solve: the relative residual of the linear solve if it was too large, else 0; None for the library's own solve.
        friction: `info.friction` if it was too large, else 0; None without dry friction.
        mass: what is wrong at the start with a mass that is a function: 0 nothing, 1 it is not symmetric, 2 not
            positive definite (with constraints: not positive semidefinite), 3 it depends on velocities (only for
            `from_lagrangian`), 4 it is 0 in a coordinate with dry friction. None if the mass is constant, unless there
            are constraints and friction.
        event: what went wrong at an event, 0 nothing; None without events. guard: the number of that event.
        contact: `info.contact`, what went wrong with contacts, 0 nothing; None without contacts.
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
        """How many runs failed, or why one did."""
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
            return "the linear solve has too large a residual"
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
MASS = (None, "symmetric", "positive definite", "the same at all velocities", "positive where dry friction acts")
CONTACT = {  # what went wrong with contacts
    Fault.NO_FORCES: "no contact forces satisfy the contact and friction laws: normal forces that push, friction "
    "within its limits. Take a smaller dt, or less `friction`",
    Fault.MANY: "contacts separate, stick and slide too often within the step. Take a smaller dt",
    Fault.JAMMED: "a contact jams: with so much friction, more normal force presses the bodies together (Painleve). "
    "Take less `friction`, or a compliant `force`",
    Fault.SEVERAL: "several contacts that affect each other collide at the same time, with a `restitution` above 0: "
    "the outcome depends on the order. Take restitution 0",
    Fault.OPEN: "the gap of a closed contact was not brought to 0: its surfaces are too curved for the step. Take a "
    "smaller dt",
    Fault.OVERLAP: "at the start bodies overlap",
    Fault.APPROACH: "at the start bodies touch and move into each other",
    Fault.RANGE: "the `friction` of a contact must be a finite number, 0 or more, and its `restitution` lie in [0, 1]",
}
WAYS = {
    INDEFINITE: f". {MASSLESS}",
    OF_VELOCITY: ": from_lagrangian needs a kinetic energy quadratic in v. For others write a System(mass, force)",
    RUBBED: ". Give the coordinates with friction a small mass or inertia; with hhtjax.bodies, `armature` of the joint",
}
INTERNAL_STATE = 4  # the index of z in QUANTITIES


@shown
class Solution(NamedTuple):
    """A trajectory at its saved times, the start included.

    Attributes:
        t: (K + 1,).
        q, v, acceleration: pytrees like q0 and v0 with a leading axis K + 1; for a first-order system y, y' and None.
        multipliers: L (K + 1, m), with M w = Q + B^T L; None without constraints.
        dt: the step size; (N,) if N step sizes were given; (K,) in a sweep over `times`, one for each interval.
        info: `Info` for each of the K intervals between saved times: largest residual, number of Newton iterations,
            whether all converged, constraint drift. A field is None if the method does not report it.
        failure: the first step that failed, a `Failure`; `check` turns it into an error.
        z, zdot: internal states and their rates, like z0 with a leading axis K + 1; None without internal states.
        friction: tau (K + 1, m), dry friction, positive for positive sliding; None without dry friction. At the end of
            a step in which a joint starts or stops to slide, it and the acceleration have an error of order dt.
        sticking: (K + 1, m), whether a joint sticks; None without dry friction.
        contact: `ContactForces`; None without contacts.
        steps: the steps that error control chose, a `Steps`; dt then holds the accepted ones. None without error
            control.
        error: (K + 1,), the error of q at each saved time, in the coordinate where it is largest; None without
            `adaptive(verify=)`.
        failed: whether the run failed, a property; (B,) for a batch: which members failed.
        allowed: the largest `error` that `check` accepts, 10 (rtol max|q| + atol); a tenth of that with
            verify="tighten".
        events: the events of the run, `Events`; None without events.
        output: what `output=` returned, a pytree with a leading axis K + 1; q, v, acceleration, multipliers, z, zdot,
            friction and sticking are then None. None without `output=`.
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
        """Whether the run failed; for a batch, which members did. These are the failures for which `check` raises,
        except `reach` and times that float32 cannot distinguish. An array, also inside jit."""
        batch = self.t.shape[:-1]
        failed = (self.failure.step > 0) | ~jnp.all(jnp.diff(self.t) >= 0, axis=-1)
        failed |= jnp.any((self.dt <= 0).reshape(*batch, -1), axis=-1)
        if self.steps is not None:
            failed |= self.steps.stop > 0
        if self.error is not None:
            failed |= ~jnp.all(self.error <= self.allowed[..., None], axis=-1)
        return failed

    def _is_known(self) -> bool:
        """Whether `check` can read the values, which is so outside of jit, vmap and grad."""
        return all_concrete((self.failure, self.dt, self.t, self.steps, self.error))

    def check(self, reach=None):
        """Raises `SimulationError` if the run failed, naming the first bad step, the quantity and the reason.

        reach: largest distance of q from its start, in any coordinate and its unit. A run that goes farther counts as
        failed although it is finite; the first such saved time is named. Default: no limit.

        For a batch made by vmap it names the first bad member. It cannot be called inside jit.
        """
        if not self._is_known():
            raise TypeError("check: the solution is a tracer: call check() outside jit, vmap and grad.")
        if fault := self._fault(reach):
            raise SimulationError(f"simulate: {fault}")

    def _fault(self, reach=None):
        """The message for what is wrong with the run; None if nothing is."""
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
                raise ValueError(f"check: leave `reach` out: the run saved `output` only, and no q; received {reach}.")
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
        """The message if the error of the whole run is larger than allowed."""
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
        """One line about the run, and its arrays."""
        rows = leaf_rows(q=self.q, v=self.v, acceleration=self.acceleration, multipliers=self.multipliers)
        rows += leaf_rows(z=self.z, zdot=self.zdot, friction=self.friction, sticking=self.sticking)
        rows += leaf_rows(contact=self.contact)
        rows += leaf_rows(output=self.output)
        return Table(f"Solution: {self._title()}", [["", "shape", "dtype"], *rows, *leaf_rows(info=self.info)])

    def _title(self) -> str:
        """Saved times, steps, and what `check` would say. Only the times for tracers and for parts of a run."""
        numbers = all_known((self.t, self.dt, self.failure))
        if len(numbers) < 2 + 3:
            return f"t {brief(self.t)}"
        t, dt, *failed = numbers
        runs = failed[0].shape
        fitting = t.ndim == len(runs) + 1 and t.shape[:-1] == runs and all(x.shape == runs for x in failed)
        if not fitting or not t.size or dt.shape[: t.ndim - 1] != runs or dt.ndim > t.ndim:
            return f"t {brief(self.t)}"
        if self.steps is not None and np.isfinite(dt).any():
            dt = dt[np.isfinite(dt)]  # NaN after the last step of a member
        batch = f"{failed[0].size} runs {runs}, each of " if runs else ""
        fault = self._fault()
        verdict = "every step finite" if fault is None else fault.partition(". ")[0].removesuffix(".")
        if fault is None and self.info.converged is not None:
            verdict += ", and converged"
        if self.events is not None and (met := self.events._verdict()):
            verdict += f"; {met}"
        return f"{batch}{t.shape[-1]} saved times, t = {between(t, 's')}, dt = {between(dt, 's')}; {verdict}"

    def _why(self, member: tuple) -> str:
        """The message for one member of a batch, from `failure`."""
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
                "half_bandwidth of banded(), a complete pattern of sparse_lu(), more iterations of "
                "conjugate_gradients(), or another solve(A, b). A larger `tolerance` of these accepts the residual. "
                "With sparse matrices, M, C and K differ too much in size for this step, or for float32"
            )
        if contact:
            return CONTACT[float(contact)]
        if np.isinf(friction):
            return "a limit of the dry friction is negative or not finite: see `friction` of the System"
        if friction == DEPENDENT:
            return (
                "directions of dry friction came to depend on each other, which was not known when the run began. Give "
                'the stepper redundant="least_squares" if directions may depend on each other'
            )
        if friction:
            return (
                f"joints with dry friction switch too often: {friction:.2g} of the step is left. Take a smaller dt, "
                "short enough to resolve the forces that drive the sliding"
            )
        if newton:
            return (
                "Newton's iteration did not converge; the state is still finite. Take a smaller dt, or more "
                "max_iterations, or a larger tolerance"
            )
        if self.failure.row is not None and row >= 0:
            return (
                f"row {row} of the constraint depends on the rows before it, or has no gradient: the position is "
                'singular. Give the stepper redundant="least_squares", or reformulate the constraint. '
                f"{SWITCHED_OFF}"
            )
        started = [x for x in jax.tree.leaves(self.acceleration) if is_concrete(x)]
        if not all(np.isfinite(np.asarray(x)[(*member, 0)]).all() for x in started):
            return (
                "the acceleration is not finite at the start already: the mass is singular there, constraints depend "
                "on each other (outside jit an error names them), or a function of the system is not finite"
            )
        is_first_order = self.acceleration is None and self.output is None
        names = ("y", "y'") if is_first_order else QUANTITIES
        return f"{names[quantity]} is not finite. Take a smaller dt, or another linearize=, or a method that damps"

    def _first_beyond(self, reach: float) -> np.ndarray:
        """Step of the first saved time at which q is farther than `reach` from its start; 0 if there is none."""
        t, axis = np.asarray(self.t), self.t.ndim - 1
        far: Any = np.zeros(t.shape, bool)
        for q in map(np.asarray, jax.tree.leaves(self.q)):
            with np.errstate(invalid="ignore"):
                far |= (abs(q - np.take(q, [0], axis)) > reach).any(axis=tuple(range(axis + 1, q.ndim)))
        return np.take_along_axis(self._steps_taken(), far.argmax(axis)[..., None], axis)[..., 0]

    def _steps_taken(self) -> np.ndarray:
        """Number of steps before each saved time."""
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
        """Whether dt holds the size of each step, with possibly several steps before a saved time."""
        K = self.t.shape[-1] - 1
        return self.steps is not None or (np.ndim(self.dt) == self.t.ndim and self.dt.shape[-1] != K)

    def _time_of(self, step: Real, member: tuple) -> Real:
        """The time at which a step ends, for one member of a batch."""
        taken, t = self._steps_taken()[member], np.asarray(self.t)[member]
        if self._is_every_step():
            return t[0] + np.sum(np.asarray(self.dt)[member][:step])
        if np.ndim(self.dt) < self.t.ndim:  # steps of one size, which may end at none of the saved times
            return t[0] + step * np.asarray(self.dt)[member]
        dt = np.broadcast_to(np.asarray(self.dt)[member], t[1:].shape)
        i = np.clip(np.searchsorted(taken, step) - 1, 0, dt.size - 1)
        return t[i] + (step - taken[i]) * dt[i]


def told(caller: str, solution: Solution, throw: bool) -> Solution:
    """Returns the solution. If it is known to have failed, warns with a `FailedRunWarning`, or raises if `throw`."""
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
# Messages for wrong times and step sizes of a run. Traced values are only known after it.


ORDER = "`times` must increase, and lie after t0; with t0 in front they were {}."
ALIKE = "times are equal in {}, near t = {:g}: count from a t0 near zero, or take float64."


def first_bad(bad):
    """The index of the first bad member of a batch, and words for it; () and "" for a single run."""
    member = tuple(int(i) for i in np.argwhere(bad)[0])
    words = f"member {', '.join(map(str, member))} ({np.count_nonzero(bad)} of {bad.size} failed), "
    return member, words if member else ""


def bad_samples(t: np.ndarray, dt: np.ndarray):
    """The message for bad times or steps of a run under error control: times (..., K + 1), and dt NaN after the last
    step."""
    if not np.all(np.diff(t) >= 0):  # after an event that ends the run, times repeat
        return ORDER.format(t)
    return ALIKE.format(t.dtype, t.flat[0]) if np.any(dt == 0) else None


def bad_steps(t: np.ndarray, dt: np.ndarray, has_events: bool):
    """The message for bad times or steps of a run with given steps. In a sweep, a dt longer than the interval is
    NaN."""
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
# The events of a run.


WHOLE = 65  # the least size of an array of the log: a kernel splits smaller arrays into scalars


@shown
class Events(NamedTuple):
    """The events of a run, in their order, with `keep_events` entries. Unused entries are NaN (-1 in `which`).

    Attributes:
        count: number of events, including those for which there was no entry left.
        t: (keep_events,), their times; differentiable.
        which: (keep_events,), the number of the event in `events`.
        q: position at the event, like q0 with a leading axis; None for a first-order system.
        before, after: v before and after the event, like v0 with a leading axis; y for a first-order system.
        z: internal states at the event; None without internal states.
        rate: (keep_events,), dg/dt before the event; multipliers contribute as they change over the step. If it is
            small compared with the velocities, the motion grazes the guard; derivatives are then very large, and
            infinite in the limit.
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
        """How many events, and whether some were not kept; for a batch the smallest and the largest number."""
        count, times = known(self.count), known(self.t)
        if count is None or times is None or not count.size or not times.ndim:
            return ""
        lost = f", {times.shape[-1]} kept" if count.max() > times.shape[-1] else ""
        return f"{between(count)} {'event' if count.max() == count.min() == 1 else 'events'}{lost}"


class Log(NamedTuple):
    """The events so far, as vectors: their number, and a column for each that is kept. Unused columns are NaN.
    Additional columns for the events of one step serve as a buffer and are not reported."""

    count: Array
    columns: Array

    @classmethod
    def empty(cls, like: PyTree, keep: int, at_once: int) -> Log:
        """An empty log for `keep` columns like this one, and `at_once` more for the events of one step."""
        number = max(keep + at_once, -(-WHOLE // like.size))
        return cls(jnp.zeros((), jnp.int32), jnp.full((like.size, number), jnp.nan, like.dtype))

    def with_more(self, rows: Array, there: Array, keep: int) -> Log:
        """The log with those rows for which `there` is true, as long as there is room; unused columns are NaN."""
        places = jnp.cumsum(there, dtype=self.count.dtype) - 1
        numbers = jnp.arange(len(places), dtype=places.dtype)
        here = there[None, :] & (places[None, :] == numbers[:, None])  # some that are not there may be before
        rows = jnp.sum(jnp.where(here[:, :, None], rows[None], 0), axis=1)
        rows = jnp.where(jnp.any(here, axis=1)[:, None], rows, jnp.nan)
        columns = block_written(self.columns, rows.T, jnp.minimum(self.count, keep), axis=1)
        return Log(self.count + jnp.sum(there, dtype=self.count.dtype), columns)

    def told(self, flat, keep: int) -> Events:
        """The log as `Events`."""
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
    """The entries of a log for one event."""
    return jnp.concatenate([jnp.stack([t, which.astype(t.dtype), rate]), q, before, after])


# ----------------------------------------------------------------------------
# Failures at an event: their codes and messages.


FINE, MANY, STAYS, ALONG, CORNER, DIFFER, NO_NUMBER, NEGATIVE, THROWN, SINGULAR = range(10)
EVENTS = {  # what it is, before the number of the event, and what to do about it
    MANY: (
        "more than max_events events in one step, the first of them event",
        "A motion that comes to rest on a guard causes infinitely many. Let it rest by a `Contact`, a stiff force, or "
        "a constraint that the event switches on. Otherwise take a smaller dt, or a larger max_events",
    ),
    STAYS: (
        "the guard stays negative, because nothing turned the motion back, at event",
        "A body that rests there needs a `Contact`, a stiff force, or a constraint that the event switches on. An "
        "event without a reset needs a guard that depends on the mode that its switch changes. So does a force that "
        "jumps there",
    ),
    ALONG: (
        "no velocity changes the guard of event",
        "An impact needs a guard that depends on q, in a direction in which the body can move",
    ),
    CORNER: (
        "another event happens at the same time as event",
        "Simultaneous impacts have a different outcome from successive ones: describe them by one event with its own "
        "reset",
    ),
    DIFFER: (
        "the runs combined by extrapolate have different events, the first of them event",
        "Take a smaller dt, or leave extrapolate out",
    ),
    NO_NUMBER: (
        "q and v are finite, but the guard is NaN at event",
        "A guard must be finite beyond its zero, too: q, not sqrt(q)",
    ),
    NEGATIVE: (
        "after the switch and the reset of an event a guard is negative, that of event",
        "Guards must be positive where the motion continues. Let the sign or the level of the guard depend on the "
        "mode that the switch changes",
    ),
    THROWN: (
        "another event made a guard negative at once, that of event",
        "A reset changes guards of the velocity, and a switch changes guards of params. Describe both events by one, "
        "with its own reset and switch, or let the guard depend on a mode",
    ),
    SINGULAR: (
        "the constraint determines no acceleration after event",
        f"After its reset and switch, v and params must be finite, and the constraint rows independent. {SWITCHED_OFF}",
    ),
}
