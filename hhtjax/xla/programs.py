"""Options for the compiler, of the programs that start here; inside a jit of the user's those of that jit hold.

QUICK: XLA:CPU compiles each fusion that stands outside a kernel by a pipeline of MLIR, some 10 ms for a few sums, and
gradients of mechanisms have hundreds; its older way, by which kernels are compiled anyway, takes a third of that. So in
programs without QUICK stages become kernels (lowering.py), which in those with it would take longer. What it makes of
the matrices of more than 32 unknowns is slower, by a fifth: runs and sweeps of such do without.
WIDE: vectors of 512 bits for loops over the members of a batch, where XLA:CPU takes half of that, unless it is asked: a
batch of double pendulums then takes half the time.

For a jit of one's own: `jax.jit(f, compiler_options=hhtjax.xla.QUICK)`, or `hhtjax.xla.QUICK | hhtjax.xla.WIDE`.
"""

from typing import Any

import jax

from hhtjax.description import programs
from hhtjax.xla.gate import is_on
from hhtjax.xla.lowering import quickly

QUICK = {"xla_cpu_use_fusion_emitters": False}
MOST_QUICK = 32  # rates; with 40, steps of a beam take 1.2 times as long
WIDE = {"xla_cpu_prefer_vector_width": 512}  # bits; where a processor has none so long, nothing changes
MOST_WIDE = 4  # coordinates; loops over more of them fit wide vectors badly: a chain of 7 takes 1.3 times as long


class Programs:
    """A function of arrays as programs: with options, and one to be called wherever it is.

    >>> twice = Programs(lambda x: 2 * x)
    >>> float(twice(2.0)), float(twice(3.0, rates=2, numbers=2)), float(jax.jit(twice)(3.0))
    (4.0, 6.0, 6.0)
    """

    are_refused = False  # the options, by an XLA that does not know one

    def __init__(self, f, **static):
        """static: of `jax.jit`."""
        self.usual: Any = jax.jit(f, **static)
        self.quick: Any = jax.jit(f, compiler_options=QUICK, **static)
        self.wide: Any = jax.jit(f, compiler_options=QUICK | WIDE, **static)
        programs.update((self.usual, self.quick, self.wide))

    def of(self, rates=0, numbers=None):
        """The one for a system of so many rates, 0 where nothing is known of one. numbers: in the position of a member
        of a batch, None where members come one by one."""
        if Programs.are_refused or rates > MOST_QUICK or not is_on() or jax.default_backend() != "cpu":
            return self.usual
        return self.wide if numbers is not None and numbers <= MOST_WIDE else self.quick

    def __call__(self, *args, rates=0, numbers=None, **keywords):
        """The values of the function."""
        program = self.of(rates, numbers)
        token = quickly.set(program is not self.usual)
        try:
            return program(*args, **keywords)
        except ValueError as error:  # there are options inside a jit of the user's
            if "compiler_options" not in str(error):
                raise
        except jax.errors.JaxRuntimeError as error:
            if "No such compile option" not in str(error):
                raise
            Programs.are_refused = True
        finally:
            quickly.reset(token)
        return self.usual(*args, **keywords)

    def number(self):
        """Of all that have been compiled."""
        return sum(program._cache_size() for program in (self.usual, self.quick, self.wide))
