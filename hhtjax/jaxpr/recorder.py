"""Writes the list of `listing.py`: each operation once, and none whose result is known."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import numpy as np

from hhtjax.description import PyTree
from hhtjax.jaxpr.listing import Block, Operation, Scalar
from hhtjax.jaxpr.scalar_rules import is_known, unmarked

COMMUTES = {"add", "mul", "and", "or", "xor", "eq", "ne"}
LARGE = 400  # numbers, or operations on them, from which on they are a loop
SAME = {"add_any": "add", "stop_gradient": "copy"}


class Recorder:
    """The list so far: that of the function, and those of the branches and loops that are being recorded."""

    def __init__(self):
        self.blocks, self.known = [Block()], [{}]
        self.places = {}  # {scalar: (array, index)} of what was read from an array
        self.orders = {}  # {array of pivots: array of the order of rows}
        self.multiples = {}  # {c x: (c, x)} for known c
        self.line = None  # of the user's that is being recorded

    def record(self, name: str, dtype, *operands, **params: PyTree):
        """The result of an operation, found if it was there before."""
        name, dtype, operands = SAME.get(name, name), np.dtype(dtype), [as_operand(x) for x in operands]
        found = _simple(self, name, dtype, operands, params)
        if found is not None:
            return found
        order = sorted(map(_key, operands)) if name in COMMUTES else map(_key, operands)
        result = self._once((name, dtype, *order, *sorted(params.items())), name, operands, params, dtype)
        if name == "mul" and any(map(is_known, operands)):
            self.multiples[result] = operands if is_known(operands[0]) else operands[::-1]
        return result

    def array(self, elements, dtype: np.dtype) -> Scalar:
        """The name of an array of these elements; of all that were read from one array, in their order, its own."""
        elements = [as_operand(x) for x in elements]
        name = self.name_of(elements)
        if name is not None:
            return name
        found = [self.places.get(x) if isinstance(x, Scalar) else None for x in elements]
        if len(found) >= LARGE and found[0] and all(x and x[0] is found[0][0] for x in found):
            at = tuple(x[1] for x in found if x)
            return self._once(("taken", id(found[0][0]), at), "taken", [found[0][0]], {"at": at}, dtype, len(at))
        return self._once(("array", *map(_key, elements)), "array", elements, {}, dtype, len(elements))

    def name_of(self, elements, known: bool = False):
        """The name of the array whose elements these are, in their order; of one that is known too; or None."""
        elements = [as_operand(x) for x in elements]
        if known and all(map(is_known, elements)):
            return self.array(elements, elements[0].dtype)
        places = [self.places.get(x) if isinstance(x, Scalar) else None for x in elements]
        name = places[0][0] if places[0] else None
        if name is not None and name.size == len(elements) and places == [(name, i) for i in range(name.size)]:
            return name
        return None

    def element(self, array, index):
        """array[index], for an index that is inside."""
        found = self._once(("element", id(array), _key(index)), "element", [array, index], {}, array.dtype)
        if is_known(index):
            self.places[found] = array, int(index)
        return found

    def arrays(self, name: str, operands: list, likes: Sequence, **params: PyTree):
        """The arrays that an operation on arrays gives. likes: (dtype, size) of each."""
        results = [Scalar(np.dtype(dtype), self, size) for dtype, size in likes]
        self.append(Operation(name, operands, results, params))
        return results

    def _once(self, key: tuple, name: str, operands: list, params: PyTree, dtype: np.dtype, size: int = 0) -> Scalar:
        for known in reversed(self.known):
            if key in known:
                return known[key]
        result = Scalar(np.dtype(dtype), self, size)
        self.append(Operation(name, operands, [result], params))
        self.known[-1][key] = result
        return result

    def append(self, operation: Operation):
        """At the end of the innermost list."""
        operation.line = self.line
        self.blocks[-1].operations.append(operation)

    def inside(self, f: Callable) -> Block:
        """The list of what f records, which returns operands."""
        self.blocks.append(Block())
        self.known.append({})
        results = [as_operand(x) for x in f()]
        self.known.pop()
        block = self.blocks.pop()
        block.results = results
        return block


def as_operand(x):
    """A scalar, or a known number of NumPy."""
    if isinstance(x, jax.Array):
        x = np.asarray(x)[()]
    return unmarked(x) if is_known(x) else x


def _key(x):
    """Tells operands apart: zeros of both signs, and numbers of different types."""
    return (1, id(x), "") if isinstance(x, Scalar) else (0, 0, f"{x.dtype}{x!r}")


def _simple(recorder: Recorder, name: str, dtype: np.dtype, x: list, params: PyTree):
    """What takes no operation, or simpler ones."""
    if name == "copy" or (name == "convert_element_type" and x[0].dtype == dtype):
        return x[0]
    if name == "add" and any(is_known(y) and y == 0 for y in x):
        return x[0] if is_known(x[1]) and x[1] == 0 else x[1]
    if name == "add" and all(y in recorder.multiples for y in x if isinstance(y, Scalar)) and not any(map(is_known, x)):
        (a, y), (b, z) = (recorder.multiples[y] for y in x)
        if y is z:  # the weights of an average, of what did not change
            return y if a + b == 1 else recorder.record("mul", dtype, a + b, y)
    if name == "sub" and is_known(x[1]) and x[1] == 0:
        return x[0]
    if name == "select_n" and len(x) == 3 and _key(x[1]) == _key(x[2]):
        return x[1]
    if name == "square":
        return recorder.record("mul", dtype, x[0], x[0])
    if name == "integer_pow":
        return _power(recorder, dtype, x[0], params["y"])
    return None


def _power(recorder: Recorder, dtype: np.dtype, x: Scalar, y: int) -> Scalar:
    """x^y as products, halving y as XLA does."""
    if y < 0:
        return recorder.record("div", dtype, dtype.type(1), _power(recorder, dtype, x, -y))
    result = None
    while y:
        if y & 1:
            result = x if result is None else recorder.record("mul", dtype, result, x)
        y >>= 1
        if y:
            x = recorder.record("mul", dtype, x, x)
    return dtype.type(1) if result is None else result
