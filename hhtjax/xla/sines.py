"""Sines and cosines of a kernel, by polynomials: XLA:CPU calls a function for each float64 number, one by one.

Sine and cosine together take 2 ns in the place of 8, and batches are vectorised. The polynomials hold for |x| <= RANGE;
where some number of a batch is larger, infinite or none, a branch takes XLA's own, so that every x has its sine.
"""

from functools import lru_cache, reduce

import jax
import jax.numpy as jnp
from jax import lax
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func

from hhtjax.xla.inspection import ATTRIBUTES, callee
from hhtjax.xla.products import element_type

NAME = "hhtjax_sines"
FUNCTIONS = {"stablehlo.sine": lax.sin, "stablehlo.cosine": lax.cos}
RANGE = 1e5  # largest |x|, rad
ONES = 3 * 2.0**51  # beyond it the last bit of a number is one

# pi/2 in three parts. Whole numbers up to 2^17 times one of the first two, of 36 bits, are exact.
HALF_PI = float.fromhex("0x1.921fb5444p+0"), float.fromhex("0x1.68c234c4cp-39"), float.fromhex("0x1.98a2e03707345p-77")

# (sin r - r)/r^3 and (cos r - 1 + r^2/2)/r^4 as polynomials in r^2, through Chebyshev's nodes of r^2 < (1.01 pi/4)^2
SINE = (
    -0.16666666666666666,
    0.0083333333333307,
    -0.00019841269836385435,
    2.7557315910939e-06,
    -2.5051092308431315e-08,
    1.5915309183057748e-10,
)
COSINE = (
    0.041666666666666664,
    -0.0013888888888887241,
    2.480158729853226e-05,
    -2.7557317151858866e-07,
    2.0876121534608454e-09,
    -1.1380868171449786e-11,
)


def polynomial_sines(x, stage=lambda f: f):
    """(sin x, cos x) for float64 numbers |x| <= RANGE, to 2 units in the last place; beyond, what has no meaning.

        x = k pi/2 + r,  |r| <= pi/4,    sin r = r + r^3 S(r^2),    cos r = 1 - r^2/2 + r^4 C(r^2)

    with pi/2 in three parts (Cody, Waite 1980) and S, C of degree 5.

    Args:
        x: rad, an array.
        stage: what makes of a function one whose results are computed once.

    Returns:
        Two arrays like x.

    Raises:
        nothing.

    >>> [round(float(y), 6) for y in polynomial_sines(jnp.asarray(jnp.pi / 6))]
    [0.5, 0.866025]
    """
    k, sine, cosine = _of_quarter(x, stage)
    odd, second_half = _is_odd(k), _is_odd(lax.floor(k / 2))
    sine, cosine = lax.select(odd, cosine, sine), lax.select(odd, sine, cosine)
    sine, cosine = lax.select(second_half, -sine, sine), lax.select(odd != second_half, -cosine, cosine)
    return lax.select(x == 0, x, sine), cosine  # -0 has a sine of its own


def _sines_by_bits(x, stage):
    """The same by the bits of k: half the operations after the polynomials. Where operations are listed, or evaluated
    on scalars, there are no bits."""
    k, sine, cosine = _of_quarter(x, stage)
    bits = _bits(k + ONES)
    odd = lax.ne(bits & 1, jnp.int64(0))
    sine, cosine = lax.select(odd, cosine, sine), lax.select(odd, sine, cosine)
    return lax.select(x == 0, x, _with_sign(sine, bits)), _with_sign(cosine, bits + 1)


def _of_quarter(x, stage):
    """k, sin r and cos r."""
    r, k = stage(_reduced)(x)
    return k, *stage(_near_zero)(r)


def _reduced(x):
    """r and k."""
    k = lax.round(x * (2 / jnp.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    return reduce(lambda r, part: r - k * part, HALF_PI, x), k


def _near_zero(r):
    """sin r and cos r."""
    z = r * r
    return r + r * z * _polynomial(SINE, z), 1 + z * (z * _polynomial(COSINE, z) - 0.5)


def _is_odd(k):
    """Of whole numbers; in floating point, because conversion to integers takes longer than all the rest."""
    return lax.floor(k / 2) != k / 2


def _polynomial(coefficients, z):
    """Horner's scheme; of a single number, with nothing to do beside it, Estrin's, which waits less."""
    if z.ndim:
        return reduce(lambda value, c: c + z * value, reversed(coefficients))
    a, b, c, d, e, f = coefficients
    return (a + b * z) + z * z * ((c + d * z) + z * z * (e + f * z))


def _bits(x):
    return lax.bitcast_convert_type(x, jnp.int64)


def _with_sign(x, bits):
    """-x where the second bit of `bits` is set, else x."""
    sign = lax.shift_left(bits & 2, jnp.full_like(bits, 62))
    return lax.bitcast_convert_type(_bits(x) ^ sign, jnp.float64)


def write_sines(module, names):
    """Calls in the place of all sines and cosines of float64 numbers in functions of a module: one for those that can
    be computed together."""
    written = {}
    for name in names:
        if not name.startswith(NAME):
            for block in list(_blocks(module.symbol_table[name].operation)):
                for group in list(_groups(block)):
                    _replace(module, group, written)


def _blocks(op):
    for region in op.regions:
        for block in region:
            yield block
            for inner in block:
                yield from _blocks(inner.operation)


def _groups(block):
    """Lists of such operations of one shape, whose operands are known where the first of them is."""
    group, since = [], []
    for op in (x.operation for x in block):
        if op.name in FUNCTIONS and element_type(op.results[0]) == "f64":
            x = op.operands[0]
            if group and (x.type != group[0].operands[0].type or x.owner in since):
                yield group
                group, since = [], []
            group.append(op)
        if group:
            since.append(op)
    if group:
        yield group


def _replace(module, group, written):
    """One call for a list of operations."""
    operands = list(dict.fromkeys(op.operands[0] for op in group))
    wanted = tuple((op.name, operands.index(op.operands[0])) for op in group)
    kind = ir.RankedTensorType(operands[0].type)
    results: list[ir.Type] = [kind] * len(group)
    key = tuple(kind.shape), len(operands), wanted
    with group[0].location:
        if key not in written:
            written[key] = _insert(module, ir.Module.parse(_text(*key)))
        with ir.InsertionPoint(group[0]):
            call = func.CallOp(results, written[key], operands)
        _compute_once(call.operation)
    for op, result in zip(group, call.results, strict=True):
        op.results[0].replace_all_uses_with(result)
        op.erase()


def _insert(module, source):
    """The functions of another module, under names that are free: the reference to the first of them."""
    names = {}
    for function in reversed(list(source.body)):  # what is called stands behind
        copy = function.operation.clone(ip=module.ip)
        copy.attributes["sym_name"] = ir.StringAttr.get(NAME)
        copy.attributes["sym_visibility"] = ir.StringAttr.get("private")
        for call in _calls(copy):
            call.attributes["callee"] = names[callee(call)]
            _compute_once(call)
        names[function.name.value] = ir.FlatSymbolRefAttr.get(module.symbol_table.insert(copy).value)
    return names["main"]


def _calls(function):
    """The calls of a function."""
    for block in _blocks(function):
        yield from (x.operation for x in block if x.operation.name == "func.call")


def _compute_once(call):
    call.attributes[ATTRIBUTES] = ir.DictAttr.get({"inlineable": ir.StringAttr.get("false")})


@lru_cache(maxsize=256)
def _text(shape, count, wanted):
    """A function of `count` arrays that gives what is wanted, [(name of an operation, number of its operand)]."""
    stage = jax.jit if shape else lambda f: f  # on single numbers LLVM does it

    def exact(*x):
        return [FUNCTIONS[name](x[i]) for name, i in wanted]

    def fast(*x):
        pairs = [dict(zip(FUNCTIONS, _sines_by_bits(y, stage), strict=True)) for y in x]
        return [pairs[i][name] for name, i in wanted]

    def both(*x):
        inside = reduce(lax.bitwise_and, (lax.abs(y) <= RANGE for y in x))
        return lax.cond(lax.reduce_and(inside, range(len(shape))) if shape else inside, fast, exact, *x)

    with jax.enable_x64(True):
        return jax.jit(both, keep_unused=True).lower(*[jax.ShapeDtypeStruct(shape, jnp.float64)] * count).as_text()
