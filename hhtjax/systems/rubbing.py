"""Whether directions of friction depend on each other, or on constraints, at the start."""

from copy import copy

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax.description import known_now, thaw
from hhtjax.systems.constraints import jacobian
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.friction import directions

DEPENDENT = 1e-6  # relative size of what is left of a row, below which it is rounding


@jax.jit
def _rows(system, q0, v0, t0, params, z0):
    """B and H at the start, and how much H changes elsewhere."""
    params = thaw(params)
    flat, q, _ = flatten("simulate", system, q0, v0, t0, params, z0)
    t = jnp.asarray(t0).astype(q.dtype)
    B = jacobian(flat, q, t, params) if flat.num_constraints else jnp.zeros((0, flat.size), q.dtype)
    H = directions(flat, q, t, params)
    if not (flat.linear or flat.local):
        return B, H, jnp.zeros_like(H)
    elsewhere = q + 1 + jnp.arange(q.size, dtype=q.dtype) / q.size
    return B, H, directions(flat, elsewhere, t, params) - H


def with_known_rows(caller, system, q0, v0, t0, params, z0=None):
    """The system, marked where directions of friction depend on each other, or on constraints; an error for what are
    none. Of tracers nothing is known."""
    rows = known_now(_rows, system, q0, v0, t0, params, z0)
    if rows is None:
        return system
    B, H, change = rows
    if not np.all(np.isfinite(H)):
        raise ValueError(f"{caller}: `sliding` has no finite derivative in v at the start.")
    if np.max(np.abs(change)) > DEPENDENT * np.max(np.abs(H)):
        raise ValueError(
            f"{caller}: `sliding` of a LinearSystem must have the same derivative in v for all q: else take a System."
        )
    for i in np.flatnonzero(~np.any(H, axis=1))[:1]:
        raise ValueError(f"{caller}: row {i} of `sliding` does not depend on v: friction there does nothing.")
    if not _depend(B, H):
        return system
    marked = copy(system)
    object.__setattr__(marked, "depending", True)
    return marked


def _depend(B, H):
    """Whether a row of H depends on those before it, or on the rows of B."""
    basis = np.zeros((0, H.shape[1]))
    if B.size:
        _, sizes, basis = np.linalg.svd(B, full_matrices=False)
        basis = basis[sizes > DEPENDENT * sizes[0]]  # constraints may be redundant
    for row in H:
        left = row
        for _ in range(2):  # once more, for what rounding leaves
            left = left - basis.T @ (basis @ left)
        if np.linalg.norm(left) <= DEPENDENT * np.linalg.norm(row):
            return True
        basis = np.vstack([basis, left / np.linalg.norm(left)])
    return False
