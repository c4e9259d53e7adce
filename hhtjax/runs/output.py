"""The output of a run instead of its path: a user's function of the motion, such as the readings of sensors."""

from __future__ import annotations

import inspect
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.checks import check_dtype, describe, require_function
from hhtjax.description import Array, Description, PyTree, is_array, thaw
from hhtjax.runs.driver import as_solution
from hhtjax.runs.solution import ContactForces, Solution
from hhtjax.steppers.stepper import public
from hhtjax.systems import zero_order_hold

if TYPE_CHECKING:
    from hhtjax.runs.adaptive import Adaptive
    from hhtjax.runs.driver import Run
    from hhtjax.runs.interpolate import Interpolant
    from hhtjax.runs.solution import Failure
    from hhtjax.steppers.stepper import Info, State
    from hhtjax.systems.flat_system import FlatSystem

NAMES = ("q", "v", "w", "L", "z", "zdot", "friction", "sticking", "contact", "t", "params")
SIGNATURE = "of some of q, v, w, L, z, zdot, friction, sticking, contact, t and params, by these names"


@dataclass(frozen=True, eq=False)
class Output(Description):
    """A function of the motion; made by `require_output`.

    Attributes:
        function: the user's function.
        names: the names of its arguments.
        beside_path: whether the run saves q and v too.
    """

    function: Any
    names: tuple
    beside_path: bool = False

    def __call__(self, values: dict, dtype: np.dtype) -> PyTree:
        """The function of values, by name, checked while it is traced."""
        chosen = {name: values[name] for name in self.names}
        if "params" in chosen:
            chosen["params"] = thaw(chosen["params"])
        try:
            found = self.function(**chosen)
            return jax.tree.map(partial(_as_array, dtype=dtype), _checked(found, dtype))
        except Exception as error:
            absent = [name for name, x in chosen.items() if x is None]
            be = "are" if len(absent) > 1 else "is"
            words = f" {', '.join(absent)} {be} None, because the system has none." if absent else ""
            error.add_note(f"output: raised while tracing `output` with {', '.join(chosen)}.{words}")
            raise


def require_output(caller: str, function):
    """The `Output` of a user's function; None for None; raises an error that says what it must be."""
    if function is None or isinstance(function, Output):
        return function
    require_function(caller, "output", function, "output(...)")
    wanted = f"{caller}: `output` must be a function {SIGNATURE}, such as output(q, v, w, L, z, t, params)"
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        raise TypeError(f"{wanted}; received {function!r}, whose arguments are unknown.") from None
    filled = function.keywords if isinstance(function, partial) else {}
    for x in parameters:
        optional = x.default is not x.empty or x.kind is x.VAR_KEYWORD
        if (x.name not in NAMES or x.kind in (x.POSITIONAL_ONLY, x.VAR_POSITIONAL)) and not optional:
            shown = ", ".join(str(x.replace(annotation=x.empty)) for x in parameters)
            raise TypeError(f"{wanted}; received one of ({shown}).")
    names = tuple(x.name for x in parameters if x.name in NAMES and x.name not in filled)
    return Output(function, names)


def _checked(found: PyTree, dtype: np.dtype) -> PyTree:
    leaves = jax.tree.leaves(found)
    if not leaves or not all(is_array(x) or isinstance(x, (bool, int, float)) for x in leaves):
        raise TypeError(f"simulate: `output` must return a pytree of arrays, one or more; received {describe(found)}.")
    check_dtype("simulate", "output", [x for x in map(jnp.asarray, leaves) if x.dtype != bool], dtype)
    return found


def _as_array(x: Array, dtype: np.dtype) -> Array:
    """Python numbers in the dtype of the state."""
    x = jnp.asarray(x)
    return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x


def output_of(output: Output, flat, params: PyTree, state) -> PyTree:
    """The value of `output` at a state on vectors."""
    state = public(flat, state)
    values = {"t": state.t, "params": params, "L": state.L, "w": None, "z": None, "zdot": None}
    values |= {"friction": None, "sticking": None, "contact": None}
    values |= {"q": flat.unravel(state.q), "v": flat.unravel_rates(state.v)}
    if state.w is not None:
        values["w"] = flat.unravel_rates(state.w)
    if state.z is not None:
        values |= {"z": flat.unravel_internal(state.z), "zdot": flat.unravel_internal(state.zdot)}
    if state.friction is not None:
        values |= {"friction": state.friction.tau, "sticking": state.friction.sig == 0}
    if state.contact is not None:
        values["contact"] = ContactForces.of(state.contact)
    return output(values, state.t.dtype)


def output_at_start(flat: FlatSystem, output: Output, params: PyTree, start: State, h: Array) -> PyTree:
    """The value of `output` at the start of a run, with a step h."""
    return output_of(output, flat, zero_order_hold.before(params, start.t, h), start)


def output_at(output: Output, found: Interpolant | Solution, t: Array, params: PyTree) -> PyTree:
    """The value of `output` for anything with the attributes of a `Solution`, at one time."""
    names = {"w": "acceleration", "L": "multipliers"}
    values = {name: getattr(found, names.get(name, name)) for name in NAMES if name not in ("t", "params")}
    return output(values | {"t": t, "params": params}, t.dtype)


PATH = ("q", "v", "acceleration", "multipliers", "z", "zdot", "friction", "sticking")


def beside_path(output, control: Adaptive):
    """The `Output` of a run under error control. If errors are reported, the run also keeps q for comparison, and drops
    it at the end."""
    return output if output is None or not control.verify else replace(output, beside_path=True)


def without_path(run):
    """A `Solution` with only the output."""
    return run._replace(**dict.fromkeys(PATH))


def savings(run: Run):
    """How a `Run` saves: the function carry -> saved values, and the function from all saved values, dt, info and
    failure to the `Solution`.

    The first also takes the size of the step that has ended, if the loop does not know it.
    """
    problem, flat, params, loop, form = run
    output = problem.output
    if output is None:
        keep = form.of(loop.keep)
        return lambda carry, last=None: keep(carry[0]), partial(as_solution, flat, loop.start)

    def save(carry: tuple, last: Array | None = None):
        state, count, _, *met = carry
        now = loop.now(*met) if met else params
        if zero_order_hold.holds(now):  # as that step has had them
            last = loop.sizes(jnp.maximum(count - 1, 0))[0] if last is None else last
            now = zero_order_hold.before(now, state.t, last)
        return state.t, output_of(output, flat, now, state)

    def solution(path: tuple, dt: Array, info: Info, failure: Failure) -> Solution:
        t, found = jax.tree.map(lambda x, y: jnp.concatenate([x[None], y]), save((loop.start, *loop.carry[1:])), path)
        return Solution(t, None, None, None, None, dt, info, failure, output=found)

    return form.of(save), solution


def require_path(caller: str, run: Solution):
    """Raises an error for a run that saved only its output."""
    if getattr(run, "q", None) is None and getattr(run, "output", None) is not None:
        raise ValueError(
            f"{caller}: `solution` must have q and v; received a run with output=, which saves nothing else: leave it "
            "out, or let the output return q and v too."
        )
