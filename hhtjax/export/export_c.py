"""Export of a system, a stepper and parameters as a C99 file with its header."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree
from hhtjax.export import files
from hhtjax.export.model import (
    Given,
    Layout,
    Numbers,
    begin,
    derivative_field,
    distinct,
    given,
    step,
    units_of,
    with_derivatives,
)
from hhtjax.export.statements import NotWritten, Statements
from hhtjax.jaxpr import Listing, NotListed, listed
from hhtjax.runs.progress import stages
from hhtjax.steppers.stepper import Stepper
from hhtjax.systems.system import AnySystem

if TYPE_CHECKING:
    from hhtjax.export.files import Body
    from hhtjax.steppers.stepper import State, Stepper


@dataclass(frozen=True)
class ExportedC:
    """A model in C, made by `export_c`.

    Attributes:
        name: name of the files, and prefix of every name in them.
        header, source: the text of name.h and name.c.
        state, params, inputs: (name, shape) of the fields of the structs `name_state` and `name_params`, and of the
            arrays that `u` holds one after the other.
        values, input_values: values of all numbers of the params, and of the inputs at the start.
        units: {name of a field: its unit}, for the fields whose unit was given.
        operations, functions: number of operations of a step, and how many of them are functions such as sines and
            roots. The body of a loop counts once.
    """

    name: str
    header: str = field(repr=False)
    source: str = field(repr=False)
    state: tuple
    params: tuple
    inputs: tuple
    values: tuple
    input_values: tuple
    units: dict
    operations: int
    functions: int

    def write(self, folder) -> list[Path]:
        """Writes name.c and name.h into a folder, which is created if necessary. Returns their paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{self.name}.{kind}" for kind in "ch"]
        for path, text in zip(paths, (self.source, self.header), strict=True):
            path.write_text(text)
        return paths


def export_c(
    system: AnySystem, stepper: Stepper, q0: PyTree, v0: PyTree = None, params: PyTree = None, *,
    z0: PyTree = None, name: str = "model", sensitivities: tuple = (), units: dict | None = None,
    progress: bool = False,
) -> ExportedC:  # fmt: skip
    """Exports the step of a system as C99 without dependencies, for hard real time.

        int NAME_init(NAME_state *s, const NAME_params *p, const NAME_real *q0, const NAME_real *v0,
                      NAME_real t0, NAME_real dt);
        int NAME_step(NAME_state *s, const NAME_params *p, const NAME_real *u, NAME_real dt);

    The functions perform the same operations as `stepper.step`, on single numbers. So C and `simulate` agree to
    rounding. They allocate no memory, have no global state, and all sizes are fixed. Steps of several states may run at
    the same time. Both functions return flags, which the state keeps: 0 without problems, otherwise NAME_NOT_FINITE,
    NAME_NOT_CONVERGED, NAME_DEPENDENT, NAME_NOT_SOLVED, NAME_FRICTION.

    The time of a step is bounded. A non-iterative step has no loop. With dry friction it iterates at most two rounds
    for each joint. Newton's iteration is bounded by its `max_iterations`.

    With dry friction the state has friction_sig, the directions in which joints slide (0 where they stick), and
    friction_tau, the forces.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`. Its constants are written into the code.
        stepper: `hht()`, `rk4()`, ...
        q0, v0: position and velocity. Their keys name the fields of the state. Their type, float64 or float32, becomes
            `NAME_real`. `NAME_init` takes their numbers in the order of these fields, matrices row by row. A
            `FirstOrderSystem` has y0 instead of q0 and no v0; `NAME_init` then has no argument v0.
        params: their floating numbers are the fields of `NAME_params`; the values given here are `NAME_defaults`. If
            two keys give the same name in C, the second is numbered: a_b and a_b_2. Integers and booleans are written
            into the code. Each `sampled` is an input. `u` holds the values of all inputs, one after the other, in the
            order of the leaves of params. They are constant during a step, as with `sampled(..., order=0)`. `NAME_init`
            then also takes the values before the start.
        z0: internal states, if the system has some. `NAME_init` then takes them after v0.
        name: name of the files, and prefix of all names in C.
        sensitivities: names of fields of `NAME_params` for which derivatives are computed in every step. With "k", the
            state has dq_dk, dv_dk, ... They assume that q0 and v0 do not depend on the params.
        units: units of fields, for comments in the header: {"q": "rad", "k": "N m/rad"}. A name also applies to all
            fields that begin with it, as "q" for q_arm, unless they have an entry of their own.
        progress: shows in one line on stderr which function is being written.

    Returns:
        An `ExportedC`; its `write(folder)` writes both files.

    Raises:
        NotImplementedError: an operation that cannot be written in C (a callback, sort, random numbers, eigenvalues).
            The message gives its name, and the line in which it is used.
        ValueError, TypeError: as `simulate`; a name that C does not allow; sensitivities or units of fields that do not
            exist; tracers.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(mass=jnp.ones(1), force=lambda q, v, t, p: {"x": -p["k"] * q["x"]})
    >>> start = {"x": jnp.ones(1)}, {"x": jnp.zeros(1)}
    >>> model = hhtjax.export_c(spring, hhtjax.hht(), *start, {"k": 4.0}, name="spring")
    >>> [field.name for field in model.state], [field.name for field in model.params]
    (['q_x', 'v_x', 'w_x', 'a_x'], ['k'])
    >>> print(model.header.splitlines()[-7])
    spring_API int spring_step(spring_state *s, const spring_params *p, const spring_real *u, spring_real dt);
    """
    with stages("export_c", progress) as tell:
        return exported("export_c", system, stepper, q0, v0, params, z0, name, sensitivities, units, tell)


def exported(
    caller: str,
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree,
    params: PyTree,
    z0: PyTree,
    name: str,
    sensitivities: tuple,
    units: dict | None,
    tell: Callable,
) -> ExportedC:
    """`export_c`, with error messages that begin with the name of the caller. tell: of `stages`."""
    if not isinstance(name, str) or not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise ValueError(f"{caller}: `name` must be one that C allows, such as 'pendulum'; received {name!r}.")
    if name.lower() in files.TAKEN:
        raise ValueError(f"{caller}: `name` must not be that of a file that is included; received {name!r}.")
    made = given(caller, system, stepper, q0, v0, params, z0)
    numbers = Numbers(made.params, made.dtype)
    rows, names = _rows(caller, numbers, sensitivities)
    t, u = jnp.zeros((), made.dtype), numbers.first_inputs()
    functions = begin(made, numbers), step(made, numbers)
    start = made.starts, numbers.values, u, t, t
    try:
        state = jax.eval_shape(functions[0], *start)[0]
        after = state, numbers.values, u, u, t
        layout = Layout.of(made, state)
        code = _Code(name, made, numbers, layout, rows, names, state)
        tell(f"writing {name}_init")
        texts = [code.begin(functions[0], start)]
        tell(f"writing {name}_step")
        texts.append(code.step(functions[1], after))
    except NotListed as error:
        where = "" if error.line is None else f"; it is used in {error.line}"
        raise NotImplementedError(f"{caller}: `{error.name}` cannot be written in C{where}.") from None
    except NotWritten as error:
        raise NotImplementedError(f"{caller}: `{error}` cannot be written in C.") from None
    units = units_of(caller, units, [*code.fields, *numbers.fields, *numbers.inputs])
    told = [*texts, code.factors] if code.factors else texts
    helpers = sorted({x for text in told for x in text.helpers}, key=str)
    tell(f"writing {name}.c")
    parts = files.Parts(name, made, stepper, code.fields, numbers, units, texts, code.factors, helpers, code.counts)
    return ExportedC(
        name, files.header(parts), files.source(parts), tuple(code.fields), tuple(numbers.fields),
        tuple(numbers.inputs), _numbers(numbers.values), _numbers(numbers.first_inputs()), units, *code.counts,
    )  # fmt: skip


def _rows(caller: str, numbers: Numbers, sensitivities: tuple):
    """(leaf, index in it) of each number in which derivatives are taken, and the names of these numbers."""
    known = {field.name: i for i, field in enumerate(numbers.fields)}
    names = [sensitivities] if isinstance(sensitivities, str) else list(sensitivities)
    wrong = [name for name in names if name not in known]
    if wrong or len(set(names)) < len(names):
        raise ValueError(
            f"{caller}: `sensitivities` must be different names among {', '.join(known)}; received {sensitivities!r}."
        )
    rows = [(known[name], j) for name in names for j in range(numbers.fields[known[name]].size)]
    shaped = {known[name] for name in names if numbers.fields[known[name]].shape}
    return rows, [f"{numbers.fields[i].name}{f'_{j}' * (i in shaped)}" for i, j in rows]


class _Code:
    """The bodies of both functions."""

    def __init__(self, name: str, made: Given, numbers: Numbers, layout: Layout, rows: list, names: list, state: State):
        self.name, self.made, self.numbers, self.layout = name, made, numbers, layout
        self.rows, self.names = rows, names
        self.floating = [jnp.issubdtype(x.dtype, jnp.floating) for x in jax.tree.leaves(state)]
        self.derivatives = [  # for each floating leaf but the time, the fields of each row
            [[derivative_field(field, name) for field in leaf] for name in names]
            for leaf, floats in list(zip(layout.leaves, self.floating, strict=True))[1:]
            if floats
        ]
        own = [field for leaf in layout.leaves[1:] for field in leaf]
        of_rows = [field for rows in self.derivatives for row in rows for field in row]
        found = iter(distinct(of_rows, [field.name for field in own]))
        self.derivatives = [[[next(found) for _ in row] for row in rows] for rows in self.derivatives]
        self.fields = own + [field for rows in self.derivatives for row in rows for field in row]
        self.counts, self.factors = (0, 0), None

    def begin(self, f: Callable, args: tuple) -> Body:
        """The body of NAME_init."""
        starts = [f"{key}[{i}]" for key, x in sorted(self.made.starts.items()) for i in range(_count(x))]
        if self.rows:
            f, args = with_derivatives(f, self.rows), ([], *args)
        return self._text(f, args, [*starts, *self._values(), *self._inputs("u"), "t0", "dt"])

    def step(self, f: Callable, args: tuple) -> Body:
        """The body of NAME_step."""
        state = ["s->t"]
        for leaf, floats in list(zip(self.layout.places("s->"), self.floating, strict=True))[1:]:
            state += leaf if floats else [f"(int32_t){place}" for place in leaf]
        names = [*state, *self._values(), *self._inputs("s->u"), *self._inputs("u"), "dt"]
        if self.rows:
            leaves = [x for x, floats in zip(jax.tree.leaves(args[0]), self.floating, strict=True) if floats][1:]
            tangents = [jax.ShapeDtypeStruct((len(self.rows), *x.shape), x.dtype) for x in leaves]
            f, args = with_derivatives(f, self.rows), (tangents, *args)
            names = [*self._derivative_places(), *names]
        return self._text(f, args, names, kept=True)

    def _values(self):
        return [place for field in self.numbers.fields for place in field.places("p->")]

    def _inputs(self, where: str):
        return [f"{where}[{i}]" for i in range(sum(field.size for field in self.numbers.inputs))]

    def _derivative_places(self):
        return [place for rows in self.derivatives for row in rows for field in row for place in field.places("s->")]

    def _text(self, f: Callable, args: tuple, names: list, kept: bool = False) -> Body:
        """Statements that read the arguments, compute, and write the state and the flags.

        kept: whether expensive results that depend only on params and dt are kept in the state.
        """

        def numbers_of(*args: PyTree):
            state, *change, flags = f(*args)
            return [*jax.tree.leaves(state)[1:], *change], flags

        listing: Listing = listed(numbers_of, *args)
        places = dict(zip(listing.arguments, names, strict=True))
        if kept:
            constant = [scalar for scalar, place in places.items() if place == "dt" or place.startswith("p->")]
            factors, operations, listing = listing.apart(constant)
            self.factors = self._factors(factors, operations, places)
            places |= {scalar: f"s->factors_{i}" for i, scalar in enumerate(factors)}
        operands, flags = listing.results
        targets = [place for leaf in self.layout.places("s->")[1:] for place in leaf]
        targets += self._derivative_places() if self.rows else []
        text, reads = self._begun(listing, places)
        self.counts = listing.count()
        values = [x for array in jax.tree.leaves(operands) for x in np.ravel(array)]
        for place, value in zip(targets, values, strict=True):
            text.line(f"{place} = {text.text(value)};")
        return files.Body(text.lines, text.text(flags.item()), reads, text.helpers)

    def _begun(self, listing, places: dict):
        """Constants for all values that are read, followed by all operations; and the places that are read."""
        text = Statements({}, self.name, (np.dtype(self.made.dtype), f"{self.name}_real"))
        found = {scalar: place for scalar, place in places.items() if scalar in files.used(listing)}
        for scalar, place in found.items():
            text.names[scalar] = place if scalar.size else files.local(place, self.name)
            if text.names[scalar] != place:
                text.line(f"const {text.type(scalar.dtype)} {text.names[scalar]} = {place};")
        text.write(listing.operations)
        return text, set(found.values())

    def _factors(self, factors: list, operations: list, places: dict):
        """The statements that compute the kept factors; None without factors."""
        if not factors:
            return None
        text, reads = self._begun(Listing([*places], operations, [np.array(factors, object)]), places)
        for i, scalar in enumerate(factors):
            text.line(f"memcpy(s->factors_{i}, {text.text(scalar)}, sizeof s->factors_{i});")
        return files.Factors(text.lines, sorted(reads), [(text.type(x.dtype), x.size) for x in factors], text.helpers)


def _numbers(values: list):
    return tuple(float(x) for value in values for x in np.ravel(value))


def _count(tree: PyTree) -> int:
    return sum(np.size(x) for x in jax.tree.leaves(tree))
