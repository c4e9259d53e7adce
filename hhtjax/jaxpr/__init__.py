"""Evaluators of jaxprs: they run a traced function with values other than arrays.

    on_scalars(f, tree)       a way to evaluate f, and other functions of the tree, number by number where that is
    faster linear_map(f, like)       the matrix of a linear map, computed with its sparsity
    listed(f, *args)          f as a list of operations on scalars, to be written in another language
    dependencies(f, x)        which outputs of f may depend on which inputs, as a sparse matrix

The contract
------------

A program gives the same numbers with and without these evaluators, to rounding. This includes signed zeros, NaN and
infinities, with three exceptions:

* In a sum of products, a term with a structural zero as a factor (an entry of a unit vector, or a tangent that autodiff
  knows to be zero) may be left out.
* The sign of a sum that is zero may differ. (XLA itself replaces x + 0 by x.)
* In reverse mode a structural zero becomes an ordinary one at the end of a stage or a scan. Multiplied by an infinite
  derivative, that of 1/x at zero, it gives NaN where plain JAX may give infinity.

Each rule lists the parameters of its operation that it supports. All other cases run on whole arrays. So a new
operation of JAX, or a new option of an old one, makes programs slower, but never wrong.

Adding a rule for an operation
------------------------------

An operation (a primitive of JAX) without a rule runs on whole arrays. It ends a kernel if XLA cannot fuse it. So add a
rule only if `explain` names the operation in a program that matters.

* Write the rule in `scalar_rules.py`: a function of the operation and of arrays in pieces. It returns the pieces of the
  results, or None to use whole arrays. In the table `UNDERSTOOD` list the parameters and values that it supports.
* In `linear_maps.py` add how its results depend on the unknowns.
* Add expressions with all options of the operation to `tests/operations_table.py`.

`tests/test_conformance.py` compares values, forward and reverse derivatives and batches with plain JAX, with NaN,
infinities, signed zeros, integers and empty arrays. It fails for a rule without an entry in that table.
`python tests/programs.py` compares random programs of all operations. `tests/test_kernels.py` checks what XLA has
compiled.
"""

from hhtjax.jaxpr.dependencies import dependencies as dependencies
from hhtjax.jaxpr.linear_maps import linear_map as linear_map
from hhtjax.jaxpr.listing import Listing as Listing
from hhtjax.jaxpr.listing import Scalar as Scalar
from hhtjax.jaxpr.recording import NotListed as NotListed
from hhtjax.jaxpr.recording import listed as listed
from hhtjax.jaxpr.row_sets import TooDense as TooDense
from hhtjax.jaxpr.scalars import on_scalars as on_scalars
