"""Static equilibria: positions, multipliers and internal states with which a system is at rest."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.analysis.roots import root
from hhtjax.checks import require_number, require_params
from hhtjax.description import Array, PyTree, Real, all_concrete
from hhtjax.description.presentation import shown
from hhtjax.systems.constraints import reaction
from hhtjax.systems.flat_system import flatten
from hhtjax.systems.initial_conditions import initial_values
from hhtjax.systems.system import AnySystem, FirstOrderSystem, require_system
from hhtjax.xla import Programs

BALANCED = 1e-8  # largest `left` of an equilibrium; about 1e-3 in float32


@shown
class Equilibrium(NamedTuple):
    """Result of `equilibrium`.

    Attributes:
        q: positions, like q0; for a first-order system y.
        multipliers: L (m,), None without constraints.
        z: internal states, like z0; None without internal states.
        left: the largest unbalanced force relative to the largest force; or, if that is larger, the largest
            violation of a constraint relative to that at q0 (relative to 1 if that is less than 1).
        converged: whether `left` is at most 1e-8 (about 1e-3 in float32).
    """

    q: PyTree
    multipliers: Array | None
    z: PyTree
    left: Array
    converged: Array


def equilibrium(
    system: AnySystem, q0: PyTree, v0: PyTree = None, params: PyTree = None, *, t0: Real = 0.0, z0: PyTree = None
) -> Equilibrium:
    """A static equilibrium near q0:

        Q(q, 0, z, t0) + B^T L = 0,    Phi(q, t0) = 0,    g(q, 0, z, t0) = 0

    with the force Q, the constraints Phi and the rates g of internal states. It is found by the Levenberg-Marquardt
    method, which also converges from starts from which Newton's method would diverge. A system may have several
    equilibria, and the one found need not be stable. To check this, call `hhtjax.analysis.suggest_step_size` at q: it
    lists the modes, and a mode with a negative damping ratio grows.

    Args:
        system: a `System`, `LinearSystem` or `FirstOrderSystem`, without dry friction and contact.
        q0: initial guess, like the q0 of `simulate`.
        v0: needed for a system with rotations, to show which velocities are angular velocities (3,). Its values are not
            used.
        params, t0, z0: as in `simulate`.

    Returns:
        An `Equilibrium`. If it is isolated, it has forward and reverse derivatives with respect to params. Under jit no
        error is raised: check `converged`.

    Raises:
        TypeError, ValueError: an argument of a wrong kind or value; no equilibrium was found.
        NotImplementedError: dry friction or contact, with which equilibria are not isolated.

    >>> import jax, jax.numpy as jnp, hhtjax
    >>> spring = hhtjax.System(jnp.ones(1), lambda q, v, t, params: -9.81 - params["k"] * (q + q**3))
    >>> sag = lambda k: hhtjax.analysis.equilibrium(spring, jnp.zeros(1), params={"k": k}).q[0]
    >>> print(f"{sag(100.0):.5f} {jax.grad(sag)(100.0):.3e}")                    # q + q^3 = -mg/k
    -0.09718 9.540e-04
    """
    require_system("equilibrium", system)
    for name in ("friction", "contact"):
        if getattr(system, name, None) is not None:
            raise NotImplementedError(
                f"equilibrium: `system` has {name}, so its equilibria are not isolated. Simulate until it rests."
            )
    params = require_params("equilibrium", params)
    require_number("equilibrium", "t0", t0, np.isfinite, "be finite")
    if v0 is None and not isinstance(system, FirstOrderSystem):
        v0 = jax.tree.map(jnp.zeros_like, q0)
    q0, v0, z0 = initial_values("equilibrium", system, q0, v0, z0)
    found = _equilibrium(system, q0, v0, params, t0, z0)
    if all_concrete(found) and not found.converged:
        raise ValueError(
            f"equilibrium: none was found near `q0`: {float(found.left):.3g} of the forces is left. Start nearer. A "
            "body that moves freely, without springs, has no equilibrium."
        )
    return found


@Programs
def _equilibrium(system: AnySystem, q0: PyTree, v0: PyTree, params: PyTree, t0: Real, z0: PyTree) -> Equilibrium:
    flat, q, v = flatten("equilibrium", system, q0, v0, t0, params, z0)
    n, N, m = flat.positions, flat.size, flat.num_constraints
    t, still = jnp.asarray(t0).astype(v.dtype), jnp.zeros_like(v)

    def place(y: Array):
        """Position, rates and multipliers of the unknowns."""
        return flat.move(q, jnp.where(np.arange(N) < n, y[:N], 0)), still.at[n:].set(v[n:] + y[n:N]), y[N:]

    def parts(y: Array):
        q, v, L = place(y)
        pull = reaction(flat, q, t, params, L) if m else still
        return flat.force(q, v, t, params), pull, flat.constraint(q, t, params) if m else still[:0]

    def unbalanced(y: Array) -> Array:
        Q, pull, Phi = parts(y)
        return jnp.concatenate([Q + pull, Phi])

    y = root(unbalanced, jnp.zeros(N + m, v.dtype))
    (Q, pull, Phi), at = parts(y), place(y)
    begun = parts(jnp.zeros_like(y))
    size = jnp.maximum(jnp.max(jnp.abs(jnp.concatenate([Q, pull, begun[0]]))), jnp.finfo(v.dtype).tiny)
    left = jnp.max(jnp.abs(Q + pull)) / size
    if m:
        left = jnp.maximum(left, jnp.max(jnp.abs(Phi)) / jnp.maximum(jnp.max(jnp.abs(begun[2])), 1))
    enough = max(BALANCED, 1e4 * float(jnp.finfo(v.dtype).eps))
    left = lax.stop_gradient(left)
    z = flat.unravel_internal(at[1][n:]) if 0 < n < N else None
    q = flat.unravel(at[0]) if n else flat.unravel(at[1])
    return Equilibrium(q, at[2] if m else None, z, left, left <= enough)
