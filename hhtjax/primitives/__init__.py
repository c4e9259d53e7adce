"""Operations of JAX of our own: what a program says of itself, carried through autodiff and vmap.

    one_kernel(f, *args)      f(*args) as one kernel, where XLA can
    staged(f)                 f, whose results a kernel computes once
    part(f)                   f, a kernel of its own where it is in none
    choose(f, g, *args)       f(*args) in a kernel, g(*args) elsewhere
    consistent(f)             f, of which what is compared is computed once
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
    derivative(ways, x, dx)   values and tangents of a function that brings its derivatives, forward and reverse
    together(f, x)            f(x), of which a batch has all values or none
    Bilinear(f, ...)          a product as one operation, with its transposes
    Linear(f, transposed)     a linear function as one operation, with its transpose
    Family(members, rule)     functions of a number as one operation, with derivatives among them
    on_host(f, like, *args)   f(*args), an array like `like`, by a function of NumPy arrays
    plain()                   a context without all that
    or_plain(run)             run(), or the same without all that where XLA refuses it

Each of them does nothing on plain JAX (`plain`), or what plain JAX would do, and the numbers are the same to rounding.
What XLA makes of them is decided above, in `hhtjax.xla`.

An operation of your own takes two files: a primitive here, with its rules for derivatives and batches, and its
lowering, in the same file where all platforms share it, in `xla/lowering.py` where the CPU has another.
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
