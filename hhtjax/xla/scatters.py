"""A scatter of few windows, written out: XLA:CPU makes a kernel of its own for it, which cannot be part of another.

`x.at[:3, 3:].set(y)`, `x.at[i].add(y)`, and what reverse mode makes of `x[i]`, become a slice, an operation and an
update for each window; places that are known are folded into them.
"""

import math
from functools import reduce
from typing import Any

import numpy as np
from jax.interpreters import mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import stablehlo

MOST_WINDOWS = 32  # beyond, it takes longer to compile than it is worth
MOST_PLACES = 4096  # for a window, side by side; each of a step's updates may copy all
COMBINED = {"add", "maximum", "minimum", "multiply", "subtract"}
INTEGERS = {"i32": np.int32, "i64": np.int64, "ui32": np.uint32, "ui64": np.uint64}  # of indices


class Scatter:
    """A scatter, as its dimension numbers tell.

    counting: axes of the updates that count windows; sizes: of a window, along each axis of x; to: the axis of x for
    each number of an index; vector: the axis of the indices along which these stand, of the type `number`.
    """

    def __init__(self, op):
        dims = stablehlo.ScatterDimensionNumbers(op.attributes["scatter_dimension_numbers"])
        self.x, self.indices, self.updates, *others = op.operands
        self.number: Any = INTEGERS.get(str(_type(self.indices).element_type))
        self.is_usual = bool(self.number) and not (others or list(dims.input_batching_dims))
        self.to, self.vector = list(dims.scattered_dims_to_operand_dims), dims.index_vector_dim
        inside, missing = list(dims.update_window_dims), {*dims.inserted_window_dims}
        shape = _shape(self.updates)
        self.counting = [i for i in range(len(shape)) if i not in inside]
        lengths = iter([shape[i] for i in inside])
        self.sizes = [1 if i in missing else next(lengths, 1) for i in range(len(_shape(self.x)))]

    def windows(self):
        """The place of each in the updates."""
        return np.ndindex(*(_shape(self.updates)[i] for i in self.counting))

    def start(self, which):
        """Where the window begins in x: a scalar for each axis."""
        found = [mlir.ir_constant(self.number(0))] * len(self.sizes)
        for number, axis in enumerate(self.to):
            place = list(which)
            if self.vector < len(_shape(self.indices)):
                place.insert(self.vector, number)
            found[axis] = _part(self.indices, dict(enumerate(place)), [])
        return found


def is_of_few_windows(op):
    """Of few windows, in a small array, none of a batch with places of its own, that replace what is there or are
    combined with it."""
    found = Scatter(op)
    number = math.prod(_shape(found.updates)[i] for i in found.counting)
    if not found.is_usual or 0 in _shape(found.updates) or number > MOST_WINDOWS:
        return False
    return math.prod(_shape(found.x)) <= MOST_PLACES * math.prod(found.sizes) and _combination(op) is not None


def write_out(op):
    """A slice, an operation and an update for each window, in its place."""
    found = Scatter(op)
    combine: Any = _combination(op)
    x = found.x
    with op.location, ir.InsertionPoint(op):
        for which in found.windows():
            start = found.start(which)
            given = _part(found.updates, dict(zip(found.counting, which, strict=True)), found.sizes)
            before = stablehlo.dynamic_slice(x, start, ir.DenseI64ArrayAttr.get(found.sizes))
            inside = _is_inside(start, found, _shape(x))
            x = stablehlo.dynamic_update_slice(x, stablehlo.select(inside, combine(before, given), before), start)
    op.results[0].replace_all_uses_with(x)
    op.erase()


def _is_inside(start, found, shape):
    """Whether all of a window is: a slice would move it there, a scatter drops it."""
    known = []
    for axis in found.to:
        low, high = (mlir.ir_constant(found.number(n)) for n in (0, shape[axis] - found.sizes[axis]))
        moved = stablehlo.clamp(low, start[axis], high)
        known.append(stablehlo.compare(moved, start[axis], stablehlo.ComparisonDirectionAttr.get("EQ")))
    return reduce(stablehlo.and_, known, mlir.ir_constant(np.bool_(True)))


def _combination(op):
    """What is made of the numbers that are there and those given; None if it is no single operation."""
    (body,) = op.regions[0]
    *steps, end = (x.operation for x in body)
    given = list(body.arguments)
    if not steps:
        return (lambda before, given: given) if end.operands[0] == given[1] else None
    name = steps[0].name.removeprefix("stablehlo.")
    plain = len(steps) == 1 and list(steps[0].operands) == given and end.operands[0] == steps[0].results[0]
    return getattr(stablehlo, name) if plain and name in COMBINED else None


def _part(x, fixed, shape):
    """Of x what stands at these numbers along these axes, in a shape."""
    low = [fixed.get(i, 0) for i in range(len(_shape(x)))]
    high = [fixed[i] + 1 if i in fixed else n for i, n in enumerate(_shape(x))]
    part = stablehlo.slice(x, *map(ir.DenseI64ArrayAttr.get, (low, high, [1] * len(low))))
    return stablehlo.reshape(ir.RankedTensorType.get(shape, _type(x).element_type), part)


def _type(x):
    return ir.RankedTensorType(x.type)


def _shape(x):
    return list(_type(x).shape)
