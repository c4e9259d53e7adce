"""JAX primitives of this library. They mark parts of a program for the compiler, also through autodiff and vmap.

    one_kernel(f, *args)      f(*args) as one kernel, if XLA can compile it so
    staged(f)                 f; inside a kernel its results are computed only once
    part(f)                   f; outside a kernel it becomes a kernel of its own
    choose(f, g, *args)       f(*args) in a kernel, g(*args) elsewhere
    consistent(f)             f; numbers that it compares are computed only once
    structural(x)             x; its zeros are structural, so products with them may be left out
    traced(f, *args)          f, traced once; reports which arguments its results depend on
    is_untouched()            whether this code is outside derivatives and batches
    is_traced()               whether this code is being traced
    is_in_batch()             whether this code is inside vmap
    forward_only(x, words)    x; reverse derivatives raise an error with these words
    largest_in_batch(x)       x; under vmap the largest x of the batch
    in_turn(f, asked, x)      f(x) if asked; a batch evaluates only the members that ask, one by one
    or_alone(x)               x of a member of a batch; True without a batch
    row_written(x, row, i)    x with row i replaced; in a batch each member has its own i
    block_written(x, y, i)    x with a block along an axis replaced
    derivative(ways, x, dx)   values and tangents of a function with its own derivatives, forward and reverse
    together(f, x)            f(x); under vmap all values are batched, or none
    Bilinear(f, ...)          a product as one operation, with its transposes
    Linear(f, transposed)     a linear function as one operation, with its transpose
    Family(members, rule)     functions of a number as one operation, whose derivatives are among them
    on_host(f, like, *args)   f(*args), an array like `like`, computed by a function of NumPy arrays
    plain()                   a context without kernels and without these marks
    or_plain(run)             run(), on plain JAX if XLA refuses to compile it

On plain JAX (`plain`) each of them does nothing, or what plain JAX would do. The numbers are the same to rounding. How
XLA compiles them is decided in `hhtjax.xla`.

A new operation needs a primitive here, with its rules for derivatives and batches, and a lowering. The lowering is in
the same file if all platforms share it, and in `xla/lowering.py` if the CPU has its own.
"""

from hhtjax.primitives.atomic_functions import Bilinear as Bilinear
from hhtjax.primitives.atomic_functions import Family as Family
from hhtjax.primitives.atomic_functions import Linear as Linear
from hhtjax.primitives.batching import block_written as block_written
from hhtjax.primitives.batching import in_turn as in_turn
from hhtjax.primitives.batching import row_written as row_written
from hhtjax.primitives.compat import or_plain as or_plain
from hhtjax.primitives.compat import plain as plain
from hhtjax.primitives.consistent import consistent as consistent
from hhtjax.primitives.host_callback import on_host as on_host
from hhtjax.primitives.interpreter import traced as traced
from hhtjax.primitives.kernels import choose as choose
from hhtjax.primitives.kernels import largest_in_batch as largest_in_batch
from hhtjax.primitives.kernels import one_kernel as one_kernel
from hhtjax.primitives.kernels import or_alone as or_alone
from hhtjax.primitives.kernels import part as part
from hhtjax.primitives.kernels import staged as staged
from hhtjax.primitives.kernels import structural as structural
from hhtjax.primitives.two_mode_derivative import TwoWays as TwoWays
from hhtjax.primitives.two_mode_derivative import derivative as derivative
from hhtjax.primitives.two_mode_derivative import forward_only as forward_only
from hhtjax.primitives.two_mode_derivative import is_in_batch as is_in_batch
from hhtjax.primitives.two_mode_derivative import is_traced as is_traced
from hhtjax.primitives.two_mode_derivative import is_untouched as is_untouched
from hhtjax.primitives.two_mode_derivative import together as together
