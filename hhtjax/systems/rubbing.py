"""The check that directions of friction do not depend on each other, or on constraints, at the start."""

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


def require_independent_friction(caller, system, q0, v0, t0, params, z0=None):
    """An error that names directions of friction that others, or constraints, make redundant; tracers pass."""
    rows = known_now(_rows, system, q0, v0, t0, params, z0)
    if rows is None:
        return
    B, H, change = rows
    if not np.all(np.isfinite(H)):
        raise ValueError(f"{caller}: `sliding` has no finite derivative in v at the start.")
    if np.max(np.abs(change)) > DEPENDENT * np.max(np.abs(H)):
        raise ValueError(
            f"{caller}: `sliding` of a LinearSystem must have the same derivative in v for all q: else take a System."
        )
    basis = np.zeros((0, H.shape[1]))
    if B.size:
        _, sizes, basis = np.linalg.svd(B, full_matrices=False)
        basis = basis[sizes > DEPENDENT * sizes[0]]  # constraints may be redundant
    for i, row in enumerate(H):
        left = row
        for _ in range(2):  # once more, for what rounding leaves
            left = left - basis.T @ (basis @ left)
        if np.linalg.norm(left) <= DEPENDENT * np.linalg.norm(row):
            why = "does not depend on v" if not np.any(row) else "depends on those before it, or on constraints"
            raise ValueError(
                f"{caller}: row {i} of `sliding` {why}: friction there cannot be told from other forces. Leave it out."
            )
        basis = np.vstack([basis, left / np.linalg.norm(left)])
