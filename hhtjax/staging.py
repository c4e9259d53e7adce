"""A barrier for XLA's fusion on the CPU."""

import jax
from jax.experimental.xla_metadata import set_xla_metadata

SMALL = 3  # unknowns, up to which a call costs more than it saves


def staged(f, size):
    """f of pytrees, its results computed once, for a problem of `size` unknowns.

    XLA:CPU fuses a value into each of its users and evaluates it anew in all of them: the sines of a system once for
    every column of its Jacobian. It does not look past a call, and this keeps f one. Elsewhere, and for small
    problems, f as it is.
    """
    if size <= SMALL or jax.default_backend() != "cpu":
        return f

    @jax.jit
    def inner(*args):
        with set_xla_metadata(inlineable=None):
            return f(*args)

    def call(*args):
        with set_xla_metadata(inlineable="false"):
            return inner(*args)

    return call
