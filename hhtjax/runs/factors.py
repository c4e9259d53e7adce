"""What short runs of one linear system, in a scan of the user's, have in common: factorised once, where it is written.

XLA takes what does not change out of a loop, but not where all that does not change is constant: there each run
factorised its matrices.
"""

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import all_concrete, is_array, known_now
from hhtjax.numerics.elimination import UNROLLED
from hhtjax.numerics.panels import LARGEST
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.linear_system import LinearSystem
from hhtjax.xla import is_traced


def known_factors(problem, dt):
    """The `Factors` for the steps dt of a run, while something is traced; None where they are not constant, or large:
    a program would hold them."""
    system, stepper = problem.system, problem.stepper
    if not isinstance(system, LinearSystem) or not is_traced() or jnp.ndim(dt):
        return None
    given = [A for A in (system.M, system.C, system.K) if A is not None]
    if not all(map(is_array, given)) or not any(A.ndim == 2 for A in given) or not UNROLLED < len(system.M) <= LARGEST:
        return None
    if not all_concrete((given, stepper, dt)):
        return None
    return known_now(_factors, system.alone(), stepper, np.asarray(dt, jax.tree.leaves(problem.q0)[0].dtype))


@jax.jit
def _factors(system, stepper, dt):
    zero = jnp.zeros(len(system.M), dt.dtype)
    flat, *_ = flatten("simulate", system, zero, zero, 0 * dt, None)
    return stepper.astype(dt.dtype).factors_of(flat, dt)
