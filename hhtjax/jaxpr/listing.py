"""A program as a list of operations on scalars, to be written in another language.

An operand is a `Scalar`, or a known number. Two kinds of operations contain lists of their own: `cond` has one for each
branch; `while` has its condition and its body, and its results are the carried variables. Other operations make and
read small arrays, each named by a `Scalar` too: `array` (from elements), `element` (of an array at an index), `lu`,
`svd`, `triangular_solve`, `taken` (elements in another order), `map` (one operation on all elements), and `product` (of
matrices). On request a linear solve is an operation `solve`. Its operand is the right-hand side, and its results are
the unknowns. It contains a list that computes the left-hand side from the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from hhtjax.description import PyTree

FUNCTIONS = {  # operations of which each takes as long as ten or more sums
    *("acos", "acosh", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "cos", "cosh", "erf", "exp", "exp2"),
    *("expm1", "log", "log1p", "logistic", "pow", "sin", "sinh", "tan", "tanh"),
}

MOVES = {"array", "cond", "element", "taken", "while"}  # which compute nothing themselves
COSTLY = {"lu", "svd", "triangular_solve"}


@dataclass(eq=False)
class Scalar:
    """A number that is not known yet, or the name of an array of `size` numbers."""

    dtype: Any
    recorder: Any  # that made it
    size: int = 0


@dataclass(eq=False)
class Block:
    """Operations in their order, and the operands that they end with."""

    operations: list = field(default_factory=list)
    results: list = field(default_factory=list)


@dataclass(eq=False)
class Operation:
    """One of the list."""

    name: str
    operands: list
    results: list
    params: dict = field(default_factory=dict)
    blocks: list = field(default_factory=list)
    line: str | None = None  # of the user's that asked for it


@dataclass(frozen=True)
class Listing:
    """A function as a list of operations.

    arguments: a scalar for each number of its arguments. results: a pytree with operands instead of numbers.
    """

    arguments: list
    operations: list
    results: Any

    def apart(self, constant: list):
        """Separates the factors of matrices that depend only on the arguments `constant`, so that they can be kept.

        Returns the names of their arrays, the operations that compute them, and the listing with them as arguments."""
        known, found = set(constant), []
        for x in self.operations:
            if not x.blocks and known.issuperset(_scalars(x.operands)):
                known.update(x.results)
                found.append(x)
        costly = {id(x): x for x in found if x.name in COSTLY}
        wanted = {x for array in _arrays(self.results) for x in array.flat if isinstance(x, Scalar)}
        rest = pruned([x for x in self.operations if id(x) not in costly], wanted)
        factors = [y for x in costly.values() for y in x.results if y in wanted]
        return factors, pruned(found, set(factors)), Listing(self.arguments + factors, rest, self.results)

    def count(self):
        """Numbers of operations, and of those that are sines and the like; of a loop, its body counts once."""
        found = [x for x in everywhere(self.operations) if x.name not in MOVES]
        return sum(map(_weight, found)), sum(x.name in FUNCTIONS for x in found)


def _weight(x: Operation) -> int:
    """How many operations on numbers it is; of an elimination, which is few times as many as it has numbers, one."""
    if x.name == "product":
        return 2 * x.params["count"] * x.params["rows"] * x.params["columns"]
    return x.results[0].size if x.name == "map" else 1


def everywhere(operations: list):
    """All operations, those of inner lists included."""
    for x in operations:
        yield x
        for block in x.blocks:
            yield from everywhere(block.operations)


def pruned(operations: list, wanted):
    """The operations that the scalars `wanted` come from, a set that grows by all that these need."""
    kept = []
    for x in reversed(operations):
        if wanted.isdisjoint(x.results):
            continue
        x = _SHORTER.get(x.name, lambda x, wanted: x)(x, wanted)
        kept.append(x)
        wanted.update(_scalars(x.operands))
    return kept[::-1]


def _arrays(tree: PyTree):
    return [tree] if hasattr(tree, "flat") else [x for y in tree for x in _arrays(y)]


def _scalars(operands: list):
    return [x for x in operands if isinstance(x, Scalar)]


def _shorter(block: Block, places: list, wanted) -> Block:
    """The block with those of its results alone."""
    results = [block.results[i] for i in places]
    wanted.update(_scalars(results))
    return Block(pruned(block.operations, wanted), results)


def _branches(x: Operation, wanted) -> Operation:
    places = [i for i, result in enumerate(x.results) if result in wanted]
    blocks = [_shorter(block, places, wanted) for block in x.blocks]
    return replace(x, results=[x.results[i] for i in places], blocks=blocks)


def _loop(x: Operation, wanted) -> Operation:
    """A carried variable is needed after the loop, by its condition, or by the next value of one that is."""
    unfinished, body = x.blocks
    unfinished = _shorter(unfinished, [0], wanted)
    places = []
    while (found := [i for i, result in enumerate(x.results) if result in wanted]) != places:
        places = found
        shorter = _shorter(body, places, wanted)
    if not places:
        return replace(x, results=[], operands=[], blocks=[unfinished, Block()])
    results, operands = ([y[i] for i in places] for y in (x.results, x.operands))
    return replace(x, results=results, operands=operands, blocks=[unfinished, shorter])


def _solve(x: Operation, wanted) -> Operation:
    """All of its unknowns belong together."""
    (block,) = x.blocks
    return replace(x, blocks=[_shorter(block, list(range(len(block.results))), wanted)])


_SHORTER = {"cond": _branches, "while": _loop, "solve": _solve}
