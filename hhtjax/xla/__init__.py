"""How runs are compiled, and how to see why a run is fast or slow.

On the CPU the whole loop over the steps is compiled into one kernel, that is, one function without calls to others.
This also holds for gradients and batches. It needs at most 16 unknowns, and functions without sorting, scattering of
many numbers, LAPACK or callbacks. `explain` shows for each loop whether it is one kernel, and if not, why:

>>> import jax.numpy as jnp, hhtjax
>>> ball = hhtjax.System(mass=jnp.ones(2), force=lambda q, v, t, c: -9.81 - c * v)
>>> def fall(c):
...     return hhtjax.simulate(ball, hhtjax.hht(), jnp.ones(2), jnp.zeros(2), c, dt=1e-2, num_steps=400).q
>>> print(hhtjax.explain(fall, 0.1))  # doctest: +ELLIPSIS
loop 1: ...

Speed
-----

A step of the double pendulum as one kernel takes 40 ns, about as long as C written by hand. Its functions are plain
`jnp`, without a Jacobian written by hand. In a batch a step takes 8 ns for each member, or 4 ns with vectors of 512
bits. `sweep` and `jax.vmap` of `simulate` use these vectors if they are not inside a `jax.jit`. The gradient of a run
takes 2.7 to 3.9 times as long as the run. Its memory grows with the square root of the number of steps.

If a loop cannot be one kernel, it runs as a list of kernels, several times slower. Values that the columns of a
Jacobian share are still evaluated only once. Inside your own `jax.jit` each stage of a step is then one kernel: the
squeezing mechanism with its 19 unknowns takes 9 microseconds a step, its gradient 30.

Measurements: `experiments/benchmarks/README.md` compares with C, by structure, batches and gradients.
`experiments/work_precision/README.md` compares error and time with diffrax, SciPy, MuJoCo and exudyn, including the
cases in which they are faster.

How it is done: systems of few operations are evaluated number by number, not array by array, and every sine once. Sines
of float64 numbers in a kernel are polynomials, accurate to 2 units in the last place, because XLA would call a function
for each. Jacobians are computed with their sparsity: for a chain of N links, or springs between neighbours, they take
N^2 numbers instead of N^3. A chain or a tree may give the product M(q) w without M: `System(..., inertia=)`.

Compiler options
----------------

Runs and fits outside `jax.jit` are compiled with options that halve the compile time. Inside your own jit the options
of that jit apply. You can pass the same ones: `jax.jit(f, compiler_options=hhtjax.xla.QUICK | hhtjax.xla.WIDE)`. Both
are for the CPU. QUICK helps for systems of up to 32 unknowns; since JAX 0.11.1 it is empty. WIDE helps for batches of
systems of up to four coordinates.

Checking a result
-----------------

All this may change rounding, and nothing else. To check a result, run the same on plain JAX and compare. The
environment variable `HHTJAX_PLAIN=1` does this for a whole process.

>>> with hhtjax.plain():
...     expected = fall(0.1)
>>> bool(jnp.allclose(fall(0.1), expected, rtol=1e-12))
True

Kernels are made with JAX 0.7.2 to 0.12. With a newer JAX everything runs on plain JAX; a warning, once in a process,
and `explain` say so. `HHTJAX_PLAIN=0` makes kernels nevertheless. If XLA refuses a program, it runs on plain JAX with a
warning, and kernels are not tried again for it.

Functions
---------

    explain(f, *args)         how the loops of a program run
    calls(names, f, *args)    whether a program calls compiled functions with these names
    polynomial_sines(x)       the sines of a kernel, for |x| <= RANGE
    keep_programs(folder)     keeps compiled programs on disk, for other processes
    Programs(f)               f, compiled with QUICK, and with WIDE where that is faster

`hhtjax.primitives` has the operations by which a program marks its parts for the compiler. `hhtjax.jaxpr` evaluates
functions number by number. Without them, on plain JAX, the rest of the library works too, several times slower.
"""

from hhtjax.primitives import plain
from hhtjax.xla.explanation import Explanation, calls, explain
from hhtjax.xla.first_call import keep_programs
from hhtjax.xla.lowering import QUICK, WIDE, Programs
from hhtjax.xla.sines import RANGE, polynomial_sines

__all__ = [
    "QUICK", "RANGE", "WIDE", "Explanation", "Programs", "calls", "explain", "keep_programs", "plain",
    "polynomial_sines",
]  # fmt: skip


def __dir__():
    return __all__
