"""How a run becomes one kernel.

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
hhtjax.xla.WIDE)` (QUICK: up to 32 unknowns, nothing since JAX 0.11.1; WIDE: batches of up to four; both for the CPU).
Sines of float64 numbers in a kernel are polynomials, to 2 units in the last place, where XLA would call a function for
each. The gradient of a run takes 2.7 to 3.9 times the run, in memory that grows with the square root of the number of
steps.
Systems of few operations are stepped number by number, not array by array, with every sine evaluated once. What is no
single kernel runs as a list of them, several times slower, with all that the columns of a Jacobian share evaluated
once; in a jit of the user's each stage of a step is one: the squeezing mechanism with its 19 unknowns then takes 9
microseconds a step, its gradient 30. Jacobians keep track of what depends on
which unknown, so that for a chain of N links, or springs between neighbours, they take N^2 numbers and not N^3; a chain
or a tree may give the product M(q) w without M: `System(..., inertia=)`.
Measured, against C, by structure, batches and gradients, on a page, `experiments/benchmarks/README.md`; error against
time beside diffrax, SciPy, MuJoCo and exudyn, losses included, on another, `experiments/work_precision/README.md`.

All this may change rounding, and nothing else. Who doubts a number runs the same on plain JAX, and compares; the
environment variable `HHTJAX_PLAIN=1` does it for a whole process. JAX 0.7.2 to 0.12 make kernels. With a newer one it
is so from the start: a warning, once in a process, and `explain` say so (`HHTJAX_PLAIN=0` tries it all the same). A
program that XLA refuses runs on plain JAX too, with a warning, and is not tried again.

>>> with hhtjax.plain():
...     expected = fall(0.1)
>>> bool(jnp.allclose(fall(0.1), expected, rtol=1e-12))
True

The door
--------

    explain(f, *args)         what became of the loops of a program
    calls(names, f, *args)    whether a program calls compiled functions of these names
    polynomial_sines(x)       the sines of a kernel, for |x| <= RANGE
    keep_programs(folder)     compiled programs on disk, for the next process
    Programs(f)               f, compiled QUICKly, with WIDE vectors where that pays

What a program says of itself is in `hhtjax.primitives`; how its functions are evaluated number by number, and what that
may change, in `hhtjax.jaxpr`. On plain JAX the rest of the library works as well, several times slower.
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
