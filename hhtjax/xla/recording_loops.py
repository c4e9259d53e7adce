"""Operations of the list on large arrays, as loops: sums and products, number by number, and products of matrices.

Only where one of the arrays has a name already, or all numbers are known or the same: to gather scattered numbers takes
as many operations as it saves. Where zeros are structural, numbers one by one are fewer.
"""

import numpy as np

from hhtjax.xla.listing import Scalar
from hhtjax.xla.pieces import is_known, is_structural
from hhtjax.xla.recorder import LARGE, as_operand
from hhtjax.xla.recording_arrays import elements_of

MAPPED = {"add": "add", "add_any": "add", "div": "div", "mul": "mul", "neg": "neg", "sub": "sub"}


def in_loops(recorder, eqn, values):
    """The values of the results of an operation, or None where it is better written number by number."""
    name, out = eqn.primitive.name, eqn.outvars[0].aval
    if name in MAPPED and out.size >= LARGE and np.dtype(out.dtype).kind == "f":
        return _map(recorder, MAPPED[name], out, [np.broadcast_to(x, out.shape) for x in values])
    if name == "dot_general" and all(v.aval.dtype == out.dtype for v in eqn.invars):
        over, batch = eqn.params["dimension_numbers"]
        if not any(batch) and len(over[0]) == 1:
            a, b = values
            return _product(recorder, out, a, b, over[0][0], over[1][0])
    return None


def _map(recorder, name, out, values):
    if any(is_structural(y) for x in values for y in x.flat):
        return None
    found = [_operand(recorder, x) for x in values]
    if None in found and not any(isinstance(x, Scalar) and x.size for x in found):
        return None
    operands = [recorder.array(x.flat, out.dtype) if y is None else y for x, y in zip(values, found, strict=True)]
    found = recorder.arrays("map", operands, [(out.dtype, out.size)], of=name)
    return [elements_of(recorder, found[0], out.shape)]


def _operand(recorder, x):
    """The one number that an array holds, or its name; None of what has neither."""
    first = x.flat[0]
    if all(y.tobytes() == first.tobytes() if is_known(y) and is_known(first) else y is first for y in x.flat):
        return as_operand(first)
    return recorder.name_of(x.flat, known=True)


def _product(recorder, out, a, b, i, j):
    """sum_l a_il b_lj, the axis i of a and j of b summed; the elements of each at strides of its rows and columns."""
    if a.ndim == 1 and b.ndim == 2:
        a, b, i, j = b, a, j, i
    count = a.shape[i]
    rows, columns = a.size // count, b.size // count
    if a.ndim != 2 or b.ndim > 2 or rows * count * columns < LARGE or any(map(is_structural, (*a.flat, *b.flat))):
        return None
    if all(map(is_known, a.flat)):  # in the order in which a loop reads it
        a, i = np.moveaxis(a, i, 0), 0
    left = recorder.name_of(a.flat, known=True)
    right = recorder.array(b.flat, out.dtype) if b.ndim == 1 else recorder.name_of(b.flat, known=True)
    if not isinstance(left, Scalar) or not isinstance(right, Scalar):
        return None
    strides = (1, rows) if i == 0 else (count, 1), (columns, 1) if j == 0 else (1, count)
    found = recorder.arrays(
        "product", [left, right], [(out.dtype, out.size)], count=count, rows=rows, columns=columns, strides=strides
    )
    return [elements_of(recorder, found[0], out.shape)]
