"""The text of the two C files, from the statements of the functions."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hhtjax.description import VERSION, PyTree
from hhtjax.export.model import FLAGS, Field, Given, Numbers
from hhtjax.export.statements import TYPES, helper, number
from hhtjax.jaxpr import Listing, Scalar

if TYPE_CHECKING:
    from hhtjax.steppers.stepper import Stepper

TAKEN = "fmi3", "math", "stdbool", "stddef", "stdint", "stdlib", "string"  # .h or .c

HEADER = """/* {name}: {stepper}

   Made by hhtjax {version}. {work}
   C99, no memory allocated, no global state. Flags are 0 where all is well, and stay in the state. */

#ifndef {guard}
#define {guard}

#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

#ifndef {name}_API
#define {name}_API /* "static inline", defined before {name}.c is included, lets a compiler take a loop as a whole */
#endif

typedef {real} {name}_real;

enum {{
{flags}
}};

typedef struct {{
    {name}_real t; /* time */
{state}
    int flags; /* of all steps so far */
    /* what the next step needs besides */
{rest}
}} {name}_state;

typedef struct {{
{params}
}} {name}_params;

extern const {name}_params {name}_defaults;

/* The state at t0 from {starts}{init_inputs}, for steps of dt. Returns flags. */
{name}_API int {name}_init({init});

/* One step of dt{step_inputs}. Returns flags. */
{name}_API int {name}_step({step});

#ifdef __cplusplus
}}
#endif

#endif
"""

SOURCE = """/* {name}: see {name}.h */

#include "{name}.h"

#include <math.h>
#include <string.h>

const {name}_params {name}_defaults = {{
{values}
}};
{helpers}{factorize}
{name}_API int {name}_init({init})
{{
{begin_unused}{begin}
    s->t = t0;
    s->t0 = t0;
    s->dt = dt;
    s->steps = 0;
{begin_factors}{begin_inputs}    s->flags = {begin_flags};
    return s->flags;
}}

{name}_API int {name}_step({step})
{{
{step_unused}{step_factors}{body}
{step_inputs}    if (s->dt != dt) {{
        s->t0 = s->t;
        s->dt = dt;
        s->steps = 0;
    }}
    s->steps += 1;
    s->t = s->t0 + ({name}_real)s->steps * dt; /* so that no rounding piles up */
    s->flags |= {step_flags};
    return s->flags;
}}
"""


FACTORIZE = """
/* Factors of matrices that these params and this dt give, for all steps with them. */
static void {name}_factorize({name}_state *s, const {name}_params *p, const {name}_real dt)
{{
{unused}{lines}
}}
"""


class Factors(NamedTuple):
    """Statements that compute the arrays `name_state.factors_i`, the places that they read, their types and sizes."""

    lines: list[str]
    reads: list[str]
    arrays: list[tuple]
    helpers: set


class Body(NamedTuple):
    """Statements, the name of the flags, the places that are read, and the helper functions that are called."""

    lines: list[str]
    flags: str
    reads: set[str]
    helpers: set


class Parts(NamedTuple):
    """The parts of which the files are composed."""

    name: str
    made: Given
    stepper: Stepper
    fields: list[Field]
    numbers: Numbers
    units: dict
    texts: list[Body]
    factors: Factors | None
    helpers: list
    counts: tuple


def used(listing: Listing):
    """The scalars that the operations and results of a listing read."""
    found = {x for value in _arrays(listing.results) for x in value.flat if isinstance(x, Scalar)}
    pending = list(listing.operations)
    while pending:
        x = pending.pop()
        found.update(y for y in x.operands if isinstance(y, Scalar))
        for block in x.blocks:
            found.update(y for y in block.results if isinstance(y, Scalar))
            pending += block.operations
    return found


def _arrays(tree: PyTree):
    return [tree] if isinstance(tree, np.ndarray) else [x for y in tree for x in _arrays(y)]


def local(place: str, name: str) -> str:
    """The name of a local constant for a struct member or array element, different from all names of model `name`.

    >>> [local(place, "p") for place in ("p->k", "s->q[3]", "p->k[3]", "u[0]", "(int32_t)s->sign", "dt")]
    ['p_k_', 's3_q', 'p3_k', 'u_0', 's_sign', 'dt']
    """
    of, *rest = re.findall(r"\w+", place.replace("(int32_t)", ""))
    text = f"{of}{''.join(rest[1:])}_{rest[0]}" if "->" in place else "_".join([of, *rest])
    return f"{text}_" if text.startswith(f"{name}_") else text


def header(parts: Parts) -> str:
    """The text of name.h."""
    name, real = parts.name, f"{parts.name}_real"
    operations, functions = parts.counts
    again = " If dt or params have changed since the step before, factors are computed again." * bool(parts.factors)
    num_inputs = sum(field.size for field in parts.numbers.inputs)
    rest = [Field("u", (num_inputs,)).declaration(real)] if num_inputs else []
    rest += [Field("t0", ()).declaration(real), Field("dt", ()).declaration(real), "    int64_t steps;"]
    if parts.factors:
        rest += [f"    {kind} factors_{i}[{size}];" for i, (kind, size) in enumerate(parts.factors.arrays)]
        rest.append(Field("factors_of", (len(parts.factors.reads),)).declaration(real))
    layout = ", ".join(_input(field, parts.units.get(field.name)) for field in parts.numbers.inputs)
    params = [field.declaration(real, parts.units.get(field.name)) for field in parts.numbers.fields]
    return HEADER.format(
        name=name, guard=f"{name.upper()}_H", version=VERSION, real=TYPES[np.dtype(parts.made.dtype)],
        stepper=_comment(parts.stepper),
        work=f"A step takes {operations} operations on numbers, {functions} of them functions such as sines.{again}",
        flags=",\n".join(f"    {name.upper()}_{x} = {2**i} /* {text} */" for i, (x, text) in enumerate(FLAGS.items())),
        state="\n".join(field.declaration(real, parts.units.get(field.name)) for field in parts.fields),
        rest="\n".join(rest), params="\n".join(params or ["    int none;"]),
        starts=" and ".join(sorted(parts.made.starts)), init_inputs=" and the inputs before" if num_inputs else "",
        step_inputs=f", u = {layout} held over it" if num_inputs else "; u is not read, and may be NULL",
        **_signatures(parts, ""),
    )  # fmt: skip


def _input(field: Field, unit) -> str:
    return f"{field.name}{f'[{field.size}]' * bool(field.shape)}{f' ({unit})' if unit else ''}"


def source(parts: Parts) -> str:
    """The text of name.c."""
    begin, body = parts.texts
    num_inputs = sum(field.size for field in parts.numbers.inputs)
    keep = f"    memcpy(s->u, u, {num_inputs} * sizeof *u);\n" if num_inputs else ""
    helpers = [helper(name, parts.name, dtype) for name, dtype in parts.helpers]
    arguments = [*sorted(parts.made.starts), "p", *["u"] * bool(num_inputs)]
    factorize, changed = _factorize(parts)
    call = f"{parts.name}_factorize(s, p, dt);"
    return SOURCE.format(
        name=parts.name, values=_values(parts), helpers="".join(f"\n{text}\n" for text in helpers),
        begin="\n".join(begin.lines), begin_unused=_unused(begin, arguments), begin_inputs=keep,
        factorize=factorize, begin_factors=f"    {call}\n" * bool(factorize),
        step_factors=f"    if ({changed}) {{\n        {call}\n    }}\n" * bool(factorize),
        begin_flags=begin.flags, body="\n".join(body.lines),
        step_unused=_unused(body, ["p", *["u"] * (not num_inputs)]),
        step_inputs=keep, step_flags=body.flags, **_signatures(parts, "restrict "),
    )  # fmt: skip


def _factorize(parts: Parts):
    """The function that computes the factors, and the C condition under which it is called again."""
    factors, name = parts.factors, parts.name
    if factors is None:
        return "", ""
    of = [(f"s->factors_of[{i}]", place) for i, place in enumerate(factors.reads)]
    lines = [*factors.lines, *(f"    {kept} = {place};" for kept, place in of)]
    unused = "" if any(place != "dt" for place in factors.reads) else "    (void)p;\n"
    text = FACTORIZE.format(name=name, lines="\n".join(lines), unused=unused)
    return text, " || ".join(f"{kept} != {place}" for kept, place in of)


def _signatures(parts: Parts, restrict: str):
    name = parts.name
    const = f"const {name}_real *{restrict}"
    both = [f"{name}_state *{restrict}s", f"const {name}_params *{restrict}p"]
    starts = [f"{const}{key}" for key in sorted(parts.made.starts)]
    inputs = [f"{const}u"] if parts.numbers.inputs else []
    init = [*both, *starts, *inputs, f"{name}_real t0", f"{name}_real dt"]
    return {"init": ", ".join(init), "step": ", ".join([*both, f"{const}u", f"{name}_real dt"])}


def _unused(text: Body, arguments: list) -> str:
    """Statements that avoid compiler warnings about unused arguments."""
    read = {re.split(r"\W", place)[0] for place in text.reads}
    return "".join(f"    (void){name};\n" for name in arguments if name not in read)


def _values(parts: Parts) -> str:
    """The values of the params as text in C."""
    lines = []
    for field, value in zip(parts.numbers.fields, parts.numbers.values, strict=True):
        numbers = [number(x) for x in np.ravel(np.asarray(value, parts.made.dtype))]
        text = f"{{{', '.join(numbers)}}}" if field.shape else numbers[0]
        lines.append(f"    {text}, /* {field.name} */")
    return "\n".join(lines or ["    0,"])


def _comment(x: Stepper) -> str:
    return " ".join(repr(x).replace("*/", "* /").split())
