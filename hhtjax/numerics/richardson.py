"""Richardson's extrapolation over the step size."""

from functools import partial
from itertools import pairwise

import jax


def richardson(values, order, combine=None):
    """Richardson's value of pytrees that belong to h, h/2, h/4, ..., with errors h^order, h^(order + 1), ...

        fine + (fine - coarse)/(2^p - 1),    p = order, order + 1, ...

    combine: (gain, coarse, fine) -> fine + gain (fine - coarse), in place of that on each leaf.

    >>> [round(richardson([1 + h**2 + h**3 for h in (0.4, 0.2, 0.1)][:levels], 2), 6) + 0.0 for levels in (2, 3)]
    [0.989333, 1.0]
    """
    combine = combine or _on_leaves
    while len(values) > 1:
        gain = 1 / (2**order - 1)
        values = [combine(gain, coarse, fine) for coarse, fine in pairwise(values)]
        order += 1
    return values[0]


def _on_leaves(gain, coarse, fine):
    return jax.tree.map(partial(take_out, gain), coarse, fine)


def take_out(gain, coarse, fine):
    """The value without the leading error that both have."""
    return fine + gain * (fine - coarse)
