"""The order of convergence that a stepper shows on a system."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import jax
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.checks import require_number, require_params
from hhtjax.description import PyTree, Real
from hhtjax.description.presentation import shown
from hhtjax.runs.progress import stages
from hhtjax.steppers.stepper import Stepper, begun, require_stepper
from hhtjax.systems.initial_conditions import initial_values
from hhtjax.systems.system import AnySystem
from hhtjax.xla import Programs


@shown
class ObservedOrder(NamedTuple):
    """Result of `observed_order`.

    Attributes:
        dt: step sizes (k,).
        error: (k,), 2-norm of the error of q at the end; without a reference, of the change to the next finer run.
        slope: (k - 1,), observed order between neighbouring step sizes.
    """

    dt: np.ndarray
    error: np.ndarray
    slope: np.ndarray


def observed_order(
    system: AnySystem,
    stepper: Stepper,
    q0: PyTree,
    v0: PyTree = None,
    params: PyTree = None,
    *,
    z0: PyTree = None,
    duration: Real,
    num_steps: Real,
    reference: PyTree = None,
    t0: Real = 0.0,
    progress: bool = False,
) -> ObservedOrder:
    """Order of convergence of q at t0 + duration, from one run for each entry of `num_steps`.

    Args:
        system, stepper, q0, v0, params, z0, t0: as in `simulate`.
        duration: s. num_steps: increasing integers, such as (100, 200, 400).
        reference: exact q at the end, like q0. Without it, the change from each run to the next replaces the error. It
            has the same slope, and there is one fewer. num_steps must then be a geometric sequence.
        progress: shows a bar in one line on stderr, with the step size of the current run.

    Returns:
        An `ObservedOrder`. Slopes are dlog(error)/dlog(dt). They are meaningful where dt resolves the motion and the
        error is well above rounding.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value.

    >>> import jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -q)
    >>> found = hhtjax.analysis.observed_order(
    ...     spring, hhtjax.rk4(), jnp.ones(1), jnp.zeros(1), duration=1.0, num_steps=(10, 20, 40))
    >>> print(found.slope.round(2))
    [3.95]
    """
    require_stepper("observed_order", stepper)
    require_number("observed_order", "duration", duration, lambda x: np.isfinite(x) and x > 0, "be positive and finite")
    counts, fewest = np.asarray(num_steps), 3 if reference is None else 2
    if (
        counts.ndim != 1
        or counts.dtype.kind != "i"
        or len(counts) < fewest
        or counts[0] < 1
        or np.any(np.diff(counts) < 1)
    ):
        raise ValueError(
            f"observed_order: `num_steps` must be increasing positive integers, {fewest} or more; received {num_steps}."
        )
    ratios = counts[1:] / counts[:-1]
    if reference is None and np.ptp(ratios) > 1e-9:
        raise ValueError(
            "observed_order: `num_steps` must be a geometric sequence where there is no `reference`; "
            f"received {num_steps!r}."
        )
    params = require_params("observed_order", params)
    q0, v0, z0 = initial_values("observed_order", system, q0, v0, z0)
    ends = []
    with stages("observed_order", progress, int(counts.sum())) as tell:
        for number, n in enumerate(counts.tolist(), 1):
            tell(f"step size {number} of {len(counts)}, {n} steps", work=n)
            ends.append(np.asarray(_end(system, stepper, q0, v0, params, z0, float(t0), float(duration) / n, n)))
    if reference is None:
        error = np.array([np.linalg.norm(x - y) for x, y in pairwise(ends)])
    else:
        exact = np.asarray(ravel_pytree(reference)[0])
        if exact.shape != ends[0].shape:
            raise ValueError(
                f"observed_order: `reference` must hold q at the end, {ends[0].size} numbers; received {exact.size}."
            )
        error = np.array([np.linalg.norm(x - exact) for x in ends])
    slope = np.diff(np.log(error)) / -np.log(ratios[: len(error) - 1])
    return ObservedOrder(float(duration) / counts[: len(error)], error, slope)


@Programs
def _end(system, stepper, q0: PyTree, v0: PyTree, params: PyTree, z0: PyTree, t0, dt, num_steps):
    """q at the end as a vector; one compilation for all numbers of steps."""
    state = begun("observed_order", system, stepper, q0, v0, z0, params, dt, t0)
    state = jax.lax.fori_loop(0, num_steps, lambda _, s: stepper.step(system, s, params, dt)[0], state)
    return ravel_pytree(state.q)[0]
