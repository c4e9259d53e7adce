"""Vectors of 512 bits for loops over the members of a batch: XLA:CPU takes half of that, unless it is asked.

A batch of double pendulums then takes half the time. It is an option for the compiler of a whole program: of those that
start here. Inside a jit of the user's those of that jit hold: `jax.jit(f, compiler_options=hhtjax.xla.WIDE)`.
"""

from typing import Any

import jax

from hhtjax.xla.gate import is_on

WIDE = {"xla_cpu_prefer_vector_width": 512}  # bits; where a processor has none so long, nothing changes
MOST_UNKNOWNS = 4  # loops over more of them fit wide vectors badly: a chain of 7 takes 1.3 times as long


class Programs:
    """A function of arrays as two programs: with wide vectors, and to be called wherever it is.

    >>> twice = Programs(lambda x: 2 * x)
    >>> float(twice(2, 3.0)), float(jax.jit(lambda x: twice(2, x))(3.0))
    (6.0, 6.0)
    """

    def __init__(self, f, **static):
        """static: of `jax.jit`."""
        self.usual: Any = jax.jit(f, **static)
        self.wide: Any = jax.jit(f, compiler_options=WIDE, **static)

    def of(self, unknowns):
        """The one that is faster for a system of so many unknowns; None where members come one by one."""
        pays = unknowns is not None and unknowns <= MOST_UNKNOWNS and is_on() and jax.default_backend() == "cpu"
        return self.wide if pays else self.usual

    def __call__(self, unknowns, *args, **keywords):
        """The values of the function."""
        try:
            return self.of(unknowns)(*args, **keywords)
        except ValueError as error:  # there are options inside a jit of the user's
            if "compiler_options" not in str(error):
                raise
        return self.usual(*args, **keywords)

    def number(self):
        """Of all that have been compiled."""
        return self.usual._cache_size() + self.wide._cache_size()
