"""The check that a start of a system of elements satisfies its constraints, with sparse matrices only."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import PyTree, known_now
from hhtjax.systems import kinematics
from hhtjax.systems.constraints import dependent_row, jacobian, saddle_point, sparse_dependent_row, violation
from hhtjax.systems.flat_system import flatten
from hhtjax.xla import Programs

ROUNDINGS = 1000  # of q, which nobody asks about


def require_consistent_elements(caller: str, start: tuple, checked: tuple, consistent: float):
    """Raises an error if a start violates the constraints by more than rounding, or if these are dependent; tracers
    pass.

    start: system, q0, v0, t0, params, z0. checked: the caller's names of q0 and v0, and what they violate.
    """
    examined = known_now(_examine_elements, *start)
    if examined is None:
        return
    both, sizes, row = examined
    if row is not None and row >= 0:
        raise ValueError(
            f"{caller}: `constraint` row {int(row)} depends on others at the start: drop a redundant joint, or keep it "
            'with redundant="least_squares".'
        )
    rounding = ROUNDINGS * np.finfo(both[0].dtype).eps * (1 + max(np.max(x) for x in sizes))
    if not any(np.max(np.abs(x)) > rounding for x in both):
        return
    away = known_now(_distance_of_elements, *start)
    assert away is not None  # as what was examined
    for (name, meaning), x, far, size in zip(checked, both, away, sizes, strict=False):
        if not np.max(np.abs(far) / (1 + size)) <= consistent:
            raise ValueError(
                f"{caller}: `{name}` violates the constraint: max|{meaning}| = {np.max(np.abs(x)):.3g}, "
                f"{np.max(np.abs(far)):.3g} away from consistent values; hhtjax.consistent_initial gives them."
            )


@Programs
def _examine_elements(system, q0: PyTree, v0: PyTree, t0, params: PyTree, z0: PyTree):
    """Phi and dPhi/dt, the sizes of coordinates and rates, and a row that depends on others."""
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    row = None
    if flat.sparse is not None:
        row = sparse_dependent_row(flat, q, t, params)
    elif flat.num_constraints:
        row = dependent_row(jacobian(flat, q, t, params))
    return violation(flat, q, v, t, params), (kinematics.sizes(flat.blocks, q), jnp.abs(v)), row


@Programs
def _distance_of_elements(system, q0: PyTree, v0: PyTree, t0, params: PyTree, z0: PyTree):
    """How far q0 and v0 are from consistent values, in each coordinate."""
    flat, q, v = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    solve = saddle_point(flat, q, t, params)
    return tuple(solve(jnp.zeros_like(v), x)[0] for x in violation(flat, q, v, t, params))
