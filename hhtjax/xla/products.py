"""Products of small matrices, written out: XLA:CPU hands them to another library, which cannot be part of a kernel."""

import math
from functools import reduce

import numpy as np
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func, stablehlo

LARGEST_SUM = 4095  # numbers of a sum; XLA hands larger ones to another library
LARGEST_MATRIX = 4096  # elements of one that meets a vector
MOST_TERMS = 32  # of the sum that a product is written as
MOST_ROWS = 64  # in one of the factors, of the product that is written out; the other may be a batch
EXACT = {"f32", "f64", "i32", "i64", "ui32", "ui64"}  # half precision would be rounded after every term


def size(value):
    """Number of elements."""
    return math.prod(ir.RankedTensorType(value.type).shape)


def element_type(value):
    """Of a tensor, as text."""
    return str(ir.RankedTensorType(value.type).element_type)


def is_small_sum(op):
    """Of a reduction: whether it stays in the kernel. Logical ones always do."""
    return size(op.operands[0]) <= LARGEST_SUM or element_type(op.operands[0]) == "i1"


def _dimensions(op):
    """Of both operands of a product: (batched, summed over, the others)."""
    dims = stablehlo.DotDimensionNumbers(op.attributes["dot_dimension_numbers"])
    batched = dims.lhs_batching_dimensions, dims.rhs_batching_dimensions
    summed = dims.lhs_contracting_dimensions, dims.rhs_contracting_dimensions
    ranks = [ir.RankedTensorType(x.type).rank for x in op.operands]
    return [
        (list(b), list(s), [i for i in range(rank) if i not in (*b, *s)])
        for b, s, rank in zip(batched, summed, ranks, strict=True)
    ]


def _lengths(op):
    """(terms, rows, columns) of a product, each over all its axes: what XLA looks at; a batch does not count."""
    shapes = [ir.RankedTensorType(x.type).shape for x in op.operands]
    (_, over, rows), (_, _, columns) = _dimensions(op)
    axes = (shapes[0], over), (shapes[0], rows), (shapes[1], columns)
    return [math.prod(shape[i] for i in which) for shape, which in axes]


def is_small_product(op):
    """Of a vector, batched or not: with a matrix, or another one, which is a sum. It stays in the kernel as it is."""
    _, rows, columns = _lengths(op)
    largest = max(map(size, op.operands))
    return min(rows, columns) <= 1 and largest <= (LARGEST_SUM if max(rows, columns) <= 1 else LARGEST_MATRIX)


def is_to_write_out(op):
    """Of two matrices, with few terms."""
    terms, *sides = _lengths(op)
    types = {element_type(x) for x in (*op.operands, *op.results)}
    return min(sides) > 1 and 0 < terms <= MOST_TERMS and min(sides) <= MOST_ROWS and len(types) == 1 and types <= EXACT


def written_out(module, product):
    """A function that gives the product as a sum over its terms, each a column times a row: its operation."""
    result = ir.RankedTensorType(product.results[0].type)
    function = func.FuncOp(
        "written_out", ir.FunctionType.get([x.type for x in product.operands], [result]), ip=module.ip
    )
    with ir.InsertionPoint(function.add_entry_block()):
        func.ReturnOp([_sum_of_terms(_dimensions(product), function.arguments, result)])
    return function.operation


def _sum_of_terms(dimensions, operands, result):
    shapes = [ir.RankedTensorType(x.type).shape for x in operands]
    (batched, summed, rows), _ = dimensions
    first = len(batched), len(batched) + len(rows)  # of the result, after the batch
    terms = []
    for index in np.ndindex(*(shapes[0][i] for i in summed)):
        factors = []
        for x, shape, (batch, over, rest), start in zip(operands, shapes, dimensions, first, strict=True):
            fixed = dict(zip(over, index, strict=True))
            low = [fixed.get(i, 0) for i in range(len(shape))]
            high = [fixed[i] + 1 if i in fixed else n for i, n in enumerate(shape)]
            kept = [i for i in range(len(shape)) if i not in fixed]
            part = stablehlo.slice(x, *map(ir.DenseI64ArrayAttr.get, (low, high, [1] * len(shape))))
            part = stablehlo.reshape(ir.RankedTensorType.get([shape[i] for i in kept], result.element_type), part)
            place = [batch.index(i) if i in batch else start + rest.index(i) for i in kept]
            factors.append(stablehlo.broadcast_in_dim(result, part, ir.DenseI64ArrayAttr.get(place)))
        terms.append(stablehlo.multiply(*factors))
    return reduce(stablehlo.add, terms)
