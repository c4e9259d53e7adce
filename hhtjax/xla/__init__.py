"""How a run becomes one kernel: the only reader of jaxprs, of MLIR, and of JAX's version.

Its door has nine functions. The rest of the library works as well on plain JAX, several times slower.

    one_kernel(f, *args)      f(*args) as one kernel, where XLA can
    staged(f)                 f, whose results a kernel computes once
    choose(f, g, *args)       f(*args) in a kernel, g(*args) elsewhere
    on_scalars(f, tree)       how to evaluate f, and others, number by number, where that pays
    structural(x)             x, whose zeros are such by structure
    linear_map(f, like)       the matrix of a linear map, from what depends on what
    explain(f, *args)         what became of the loops of a program
    plain()                   a context without all that
    or_plain(run)             run(), or the same without all that where XLA refuses it

The contract: the same program gives the same numbers with and without, to rounding; signed zeros, NaN and infinities
included. One licence: inside a sum of products a term with a factor that is zero by structure (a unit vector, a tangent
that autodiff knows to be zero) may be left out, and the sign of a sum that is zero is rounding (XLA itself takes x + 0
for x). A rule names the parameters of its operation that it understands; what
it does not understand runs on whole arrays.
"""

from hhtjax.xla.explanation import Explanation, explain
from hhtjax.xla.gate import or_plain, plain
from hhtjax.xla.kernels import choose, one_kernel, staged, structural
from hhtjax.xla.linear_maps import linear_map
from hhtjax.xla.scalars import on_scalars

__all__ = [
    "Explanation",
    "choose",
    "explain",
    "linear_map",
    "on_scalars",
    "one_kernel",
    "or_plain",
    "plain",
    "staged",
    "structural",
]


def __dir__():
    return __all__
