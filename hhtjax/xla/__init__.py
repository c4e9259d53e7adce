"""How a run becomes one kernel: the only reader of jaxprs, and of JAX's version.

On the CPU the whole loop over the steps becomes one kernel, that is, one compiled function without
calls to others; gradients and batches too, wherever XLA can compile it so: up to 16 unknowns, without sorting,
scattering of many numbers, LAPACK or callbacks in your functions. `explain` tells which, and why not:

>>> import jax.numpy as jnp, hhtjax
>>> ball = hhtjax.System(mass=jnp.ones(2), force=lambda q, v, t, c: -9.81 - c * v)
>>> def fall(c):
...     return hhtjax.simulate(ball, hhtjax.hht(), jnp.ones(2), jnp.zeros(2), c, dt=1e-2, num_steps=400).q
>>> print(hhtjax.explain(fall, 0.1))  # doctest: +ELLIPSIS
loop 1: ...

A step of the double pendulum, its functions in plain `jnp` and no Jacobian written by hand, then takes about as long as
C with everything written by hand, 40 ns, and in a batch 8 ns for each member, or 4 with vectors of 512 bits, which
`sweep` and `jax.vmap` of `simulate` take where no jit is around them. Such runs, and fits, are compiled in half the
time, too; inside a jit of the user's its own options hold: `jax.jit(f, compiler_options=hhtjax.xla.QUICK |
hhtjax.xla.WIDE)` (QUICK: up to 32 unknowns; WIDE: batches of up to four; both for XLA on the CPU). Sines of float64
numbers in a kernel are polynomials, to 2 units in the last place, where XLA would call a function for each. The
gradient of a run takes 2.7 to 3.9 times the run, in memory that grows with the square root of the number of steps.
Systems of few operations are stepped number by number, not array by array, with every sine evaluated once. What is no
single kernel runs as a list of them, several times slower, with all that the columns of a Jacobian share evaluated
once; in a jit of the user's each stage of a step is one: the squeezing mechanism with its 19 unknowns then takes 9
microseconds a step, its gradient 30. Jacobians keep track of what depends on
which unknown, so that for a chain of N links, or springs between neighbours, they take N^2 numbers and not N^3; a chain
or a tree may give the product M(q) w without M: `System(..., inertia=)`.
Measured, against C, by structure, batches and gradients, on a page, `experiments/benchmarks/README.md`; error against
time beside diffrax, SciPy, MuJoCo and exudyn, losses included, on another, `experiments/work_precision/README.md`.

All this may change rounding, and nothing else. Who doubts a number runs the same on plain JAX, and compares; the
environment variable `HHTJAX_PLAIN=1` does it for a whole process. With a JAX newer than the last one tested it is so
from the start, and `explain` says so (`HHTJAX_PLAIN=0` tries it all the same).

>>> with hhtjax.plain():
...     expected = fall(0.1)
>>> bool(jnp.allclose(fall(0.1), expected, rtol=1e-12))
True

The door
--------

The rest of the library knows 30 functions of this room, and works as well on plain JAX, several times slower.

    one_kernel(f, *args)      f(*args) as one kernel, where XLA can
    staged(f)                 f, whose results a kernel computes once
    part(f)                   f, a kernel of its own where it is in none
    choose(f, g, *args)       f(*args) in a kernel, g(*args) elsewhere
    consistent(f)             f, of which what is compared is computed once
    on_scalars(f, tree)       how to evaluate f, and others, number by number, where that pays
    structural(x)             x, whose zeros are such by structure
    traced(f, *args)          f, traced once, with word of which arguments its results are made of
    is_untouched()            whether neither a derivative nor a batch is being made here
    is_traced()               whether what runs here becomes part of a program
    is_in_batch()             whether a batch is being made here
    forward_only(x, words)    x, of which a reverse derivative is refused in these words
    largest_in_batch(x)       x, of which a batch has the largest, as a whole
    in_turn(f, asked, x)      f(x), of which a batch visits only members that ask
    or_alone(x)               x of a member of a batch, True where there is none
    row_written(x, row, i)    x with another row, each member of a batch its own
    block_written(x, y, i)    the same of a part along an axis
    linear_map(f, like)       the matrix of a linear map, from what depends on what
    listed(f, *args)          f as a list of operations on scalars, to be written in another language
    derivative(ways, x, dx)   values and tangents of a function that brings its derivatives, forward and reverse
    Bilinear(f, ...)          a product as one operation, with its transposes
    Family(members, rule)     functions of a number as one operation, with derivatives among them
    on_host(f, like, *args)   f(*args), an array like `like`, by a function of NumPy arrays
    together(f, x)            f(x), of which a batch has all values or none
    explain(f, *args)         what became of the loops of a program
    calls(names, f, *args)    whether a program calls compiled functions of these names
    polynomial_sines(x)       the sines of a kernel, for |x| <= RANGE
    plain()                   a context without all that
    or_plain(run)             run(), or the same without all that where XLA refuses it
    Programs(f)               f, compiled QUICKly, with WIDE vectors where that pays

The contract
------------

The same program gives the same numbers with and without, to rounding; signed zeros, NaN and infinities included. Two
licences: inside a sum of products a term with a factor that is zero by structure (a unit vector, a tangent that
autodiff knows to be zero) may be left out, and the sign of a sum that is zero is rounding (XLA itself takes x + 0 for
x). And in reverse mode such a zero becomes a number where a stage ends, as where a scan does: beside an infinite
derivative, that of 1/x at zero, it makes NaN where plain JAX may have infinity. A rule names the parameters of its
operation that it understands; what it does not understand runs on whole arrays. So a JAX that brings a new operation,
or a new option of an old one, makes programs slower, and never wrong.

A rule for an operation
-----------------------

An operation (a primitive of JAX) that has no rule runs on whole arrays, and ends a kernel if XLA cannot fuse it: so add
one only where `explain` names it in a program that matters. `parameters.py` states the parameters and the values that
the rule understands; `scalar_rules.py` has the rule itself, a function of the operation and of arrays in pieces that
returns the pieces of the results, or None for whole arrays; `linear_maps.py` has what is needed to know which result
depends on which unknown. Then put expressions with all its options into `tests/operations_table.py`:
`tests/test_conformance.py` compares values, forward and reverse derivatives and batches with those of plain JAX, with
NaN, infinities, signed zeros, integers and empty arrays, and fails for a rule without an entry. Random programs of
all operations are compared by `python tests/programs.py`, and `tests/test_kernels.py` looks at what XLA compiled.
"""

from hhtjax.jaxpr.interpreter import traced
from hhtjax.jaxpr.linear_maps import linear_map
from hhtjax.jaxpr.listing import Listing, Scalar
from hhtjax.jaxpr.recording import NotListed, listed
from hhtjax.jaxpr.scalars import on_scalars
from hhtjax.primitives.atomic_functions import Bilinear, Family
from hhtjax.primitives.batching import block_written, in_turn, row_written
from hhtjax.primitives.host_callback import on_host
from hhtjax.primitives.two_mode_derivative import (
    TwoWays,
    derivative,
    forward_only,
    is_in_batch,
    is_traced,
    is_untouched,
    together,
)
from hhtjax.xla.compat import or_plain, plain
from hhtjax.xla.consistent import consistent
from hhtjax.xla.explanation import Explanation, calls, explain
from hhtjax.xla.kernels import choose, largest_in_batch, one_kernel, or_alone, part, staged, structural
from hhtjax.xla.lowering import QUICK, WIDE, Programs
from hhtjax.xla.sines import RANGE, polynomial_sines

__all__ = [
    "QUICK",
    "RANGE",
    "WIDE",
    "Bilinear",
    "Explanation",
    "Family",
    "Listing",
    "NotListed",
    "Programs",
    "Scalar",
    "TwoWays",
    "block_written",
    "calls",
    "choose",
    "consistent",
    "derivative",
    "explain",
    "forward_only",
    "in_turn",
    "is_in_batch",
    "is_traced",
    "is_untouched",
    "largest_in_batch",
    "linear_map",
    "listed",
    "on_host",
    "on_scalars",
    "one_kernel",
    "or_alone",
    "or_plain",
    "part",
    "plain",
    "polynomial_sines",
    "row_written",
    "staged",
    "structural",
    "together",
    "traced",
]


def __dir__():
    return __all__
