"""Linear solves with a constant matrix and a part that changes: A = A0 - E J E^T, or A0 - J.

The inverse of the first is that of A0, and a solve with as many unknowns as E has columns (Woodbury 1950):

    A^-1 b = y + Z J (1 - S J)^-1 E^T y,    y = A0^-1 b,  Z = A0^-1 E,  S = E^T Z
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.numerics.elimination import factorize, matvec
from hhtjax.xla import linear_map


class Changing:
    """A `factorize` for A0 and a part J that depends on the state: `around` a state it is complete.

    slope: state -> the linear function of a change of state that gives the change of the nonlinear force, (k,) or (n,).
    spread: E, (k,) -> (n,); size: k, None for a J of all rows and columns.
    """

    def __init__(self, A0, slope, spread, size):
        self.A0, self.slope, self.spread, self.size = lax.stop_gradient(A0), slope, spread, size
        if size is None:
            return
        self.inverse = factorize(A0)
        self.columns = jax.vmap(spread)(jnp.eye(size, dtype=A0.dtype))  # E^T
        self.Z = [jax.vmap(lambda e, trans=trans: self.inverse(e, trans=trans))(self.columns).T for trans in (0, 1)]
        self.S = self.columns @ self.Z[0]

    def __call__(self, A):
        """For a matrix that is not of this kind: the library's own elimination."""
        return factorize(A)

    def around(self, state, along):
        """The `factorize` for the matrix at a state. along: change of acceleration -> change of state."""
        change = self.slope(state)
        size, spread = (self.A0.shape[0], lambda x: x) if self.size is None else (self.size, self.spread)
        J = linear_map(lambda x: change(along(spread(x))), jnp.zeros(size, self.A0.dtype))
        return Known(self, lax.stop_gradient(J))


@dataclass(frozen=True)
class Known:
    """`Changing` at a state."""

    matrices: Changing
    J: Any

    def __call__(self, A):
        """For a matrix that is not of this kind."""
        return self.matrices(A)

    def of_map(self, f, like):
        """The function (b, trans=0) -> A^-1 b, or A^-T b; f and like say nothing new."""
        known, J = self.matrices, self.J
        if known.size is None:
            return factorize(known.A0 - J)
        Z, Z_transposed = known.Z
        small = factorize(jnp.eye(known.size, dtype=J.dtype) - known.S @ J)

        def apply(b, trans=0):
            y = known.inverse(b, trans=trans)
            x = known.columns @ y
            if trans:  # J^T (1 - S^T J^T)^-1 = (1 - J^T S^T)^-1 J^T
                return y + Z_transposed @ small(J.T @ x, trans=1)
            return y + Z @ (J @ small(x, trans=0))

        return apply

    def bound(self, x):
        """What the rows of A x are sums of: |A| |x|."""
        known, x = self.matrices, jnp.abs(x)
        if known.size is None:
            return matvec(jnp.abs(known.A0 - self.J), x)
        return matvec(jnp.abs(known.A0), x) + known.columns.T @ (jnp.abs(self.J) @ (known.columns @ x))


def around(factorize, expand):
    """A `factorize` at the state that expand() gives with `along`, where it depends on it."""
    return factorize.around(*expand()) if isinstance(factorize, Changing) else factorize
