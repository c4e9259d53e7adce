"""Evaluators of jaxprs: a traced function, run with other values than arrays.

    on_scalars(f, tree)       how to evaluate f, and others, number by number, where that pays
    linear_map(f, like)       the matrix of a linear map, from what depends on what
    listed(f, *args)          f as a list of operations on scalars, to be written in another language
    dependencies(f, x)        which outputs of f may depend on which inputs, as a sparse matrix

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

An operation (a primitive of JAX) that has no rule runs on whole arrays, and ends a kernel if XLA cannot fuse it: so
add one only where `explain` names it in a program that matters. In `scalar_rules.py` the table `UNDERSTOOD` states
the parameters and the values that the rule understands; there is the rule itself, too, a function of the operation
and of arrays in pieces that returns the pieces of the results, or None for whole arrays. `linear_maps.py` has what is
needed to know which result depends on which unknown. Then put expressions with all its options into
`tests/operations_table.py`: `tests/test_conformance.py` compares values, forward and reverse derivatives and batches
with those of plain JAX, with NaN, infinities, signed zeros, integers and empty arrays, and fails for a rule without
an entry. Random programs of all operations are compared by `python tests/programs.py`, and `tests/test_kernels.py`
looks at what XLA compiled.
"""

from hhtjax.jaxpr.dependencies import dependencies as dependencies
from hhtjax.jaxpr.linear_maps import linear_map as linear_map
from hhtjax.jaxpr.listing import Listing as Listing
from hhtjax.jaxpr.listing import Scalar as Scalar
from hhtjax.jaxpr.recording import NotListed as NotListed
from hhtjax.jaxpr.recording import listed as listed
from hhtjax.jaxpr.row_sets import TooDense as TooDense
from hhtjax.jaxpr.scalars import on_scalars as on_scalars
