"""Linear solves with a constant matrix A0 and a part that changes: A = A0 - E J E^T, or A0 - J, or A0 + H^T D.

A0 is factorised once. A solve with the first kind also needs one with as many unknowns as E has columns (Woodbury
1950):

    A^-1 b = y + Z J (1 - S J)^-1 E^T y,    y = A0^-1 b,  Z = A0^-1 E,  S = E^T Z

For the last kind, with few rows D and A0 as above, A^-1 b = y - Z (1 + D Z)^-1 D y with Z = A0^-1 H^T.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import lax

from hhtjax.description import Array, PyTree, Real
from hhtjax.jaxpr import linear_map
from hhtjax.numerics.dense_lu import factorize, matvec

if TYPE_CHECKING:
    from hhtjax.numerics.sparse_matrix import Sparse
    from hhtjax.numerics.sparse_solve import Factorized


class AtState:
    """A `factorize` at a state, where it knows the matrix; `Changing.around` gives it."""

    def of_map(self, f, like: PyTree) -> Any:
        """The function (b, trans=0) -> A^-1 b, or A^-T b; f and like say nothing new."""
        raise NotImplementedError

    def bound(self, x) -> Any:
        """What the rows of A x are sums of: |A| |x|."""
        raise NotImplementedError


class Completed:
    """A `factorize` that is completed by a state."""

    def around(self, state, along: Callable) -> Any:
        """The `factorize` for the matrix at a state. along: change of the unknowns -> change of state."""
        raise NotImplementedError


class Changing(Completed):
    """A `factorize` for A0 and a part J that depends on the state: `around` a state it is complete.

    slope: state -> the linear function of a change of state that gives the change of the nonlinear force, (k,) or (n,).
    spread: E, (k,) -> (n,); size: k, None for a J of all rows and columns. inverse: what `factorize` makes of A0, where
    it is known.
    """

    def __init__(self, A0: Array | Sparse, slope: Callable, spread: Callable, size: int | None, inverse=None):
        self.A0, self.slope, self.spread, self.size = lax.stop_gradient(A0), slope, spread, size
        if size is None:
            return
        self.inverse = factorize(A0) if inverse is None else inverse
        self.columns = jax.vmap(spread)(jnp.eye(size, dtype=A0.dtype))  # E^T
        self.Z = [jax.vmap(lambda e, trans=trans: self.inverse(e, trans=trans))(self.columns).T for trans in (0, 1)]
        self.S = self.columns @ self.Z[0]

    def __call__(self, A: Array):
        """For a matrix that is not of this kind: the library's own elimination."""
        return factorize(A)

    def around(self, state, along: Callable) -> Known:
        """The `factorize` for the matrix at a state. along: change of acceleration -> change of state."""
        change = self.slope(state)
        size, spread = (self.A0.shape[0], lambda x: x) if self.size is None else (self.size, self.spread)
        J = linear_map(lambda x: change(along(spread(x))), jnp.zeros(size, self.A0.dtype))
        return Known(self, lax.stop_gradient(J))


@dataclass(frozen=True)
class Known(AtState):
    """`Changing` at a state."""

    matrices: Changing
    J: Any

    def __call__(self, A):
        """For a matrix that is not of this kind."""
        return self.matrices(A)

    def of_map(self, f: Callable | None, like: PyTree):
        known, J = self.matrices, self.J
        if known.size is None:
            return factorize(known.A0 - J)
        Z, Z_transposed = known.Z
        small = factorize(jnp.eye(known.size, dtype=J.dtype) - known.S @ J)

        def apply(b: Real, trans: int = 0) -> Array:
            y = known.inverse(b, trans=trans)
            x = known.columns @ y
            if trans:  # J^T (1 - S^T J^T)^-1 = (1 - J^T S^T)^-1 J^T
                return y + Z_transposed @ small(J.T @ x, trans=1)
            return y + Z @ (J @ small(x, trans=0))

        return apply

    def bound(self, x) -> Array:
        known, x = self.matrices, jnp.abs(x)
        if known.size is None:
            return matvec(jnp.abs(known.A0 - self.J), x)
        return matvec(abs(known.A0), x) + known.columns.T @ (jnp.abs(self.J) @ (known.columns @ x))


class Constant(Changing, AtState):
    """A `factorize` for A0 alone."""

    def __init__(self, A0, inverse=None):
        self.A0 = lax.stop_gradient(A0)
        self.inverse = factorize(self.A0) if inverse is None else inverse

    def around(self, state, along: Callable) -> Constant | Factorized:
        """Itself, at every state."""
        return self

    def of_map(self, f: Callable, like: PyTree):
        return self.inverse

    def bound(self, x) -> Array:
        return matvec(abs(self.A0), jnp.abs(x))


class Updated(Changing):
    """A `factorize` for A0 + H^T D with that of A0, a `Changing`.

    H: (m, n). slope: state -> the linear function of a change of state that gives (m,), of a change w: D w.
    """

    def __init__(self, base: Changing, H: Array, slope: Callable):
        self.base, self.H, self.slope = base, lax.stop_gradient(H), slope

    def around(self, state, along: Callable) -> KnownUpdate:
        """The `factorize` for the matrix at a state."""
        change, (m, n) = self.slope(state), self.H.shape
        pull = jax.linear_transpose(lambda w: change(along(w)), jnp.zeros(n, self.H.dtype))
        D = jnp.stack([pull(e)[0] for e in jnp.eye(m, dtype=self.H.dtype)])
        return KnownUpdate(self.base.around(state, along), self.H, lax.stop_gradient(D))


@dataclass(frozen=True)
class KnownUpdate(AtState):
    """`Updated` at a state."""

    base: Any
    H: Any
    D: Any

    def of_map(self, f: Callable | None, like: PyTree):
        inverse, D = self.base.of_map(f, like), self.D
        Z = jnp.stack([inverse(h, trans=0) for h in self.H])  # transposed
        small = factorize(jnp.eye(len(D), dtype=D.dtype) + jnp.stack([matvec(D, z) for z in Z], axis=1))

        def apply(b: Real, trans: int = 0) -> Array:
            if trans:
                return inverse(b - matvec(D.T, small(matvec(Z, b), trans=1)), trans=1)
            y = inverse(b, trans=0)
            return y - matvec(Z.T, small(matvec(D, y), trans=0))

        return apply

    def bound(self, x):
        return self.base.bound(x) + matvec(jnp.abs(self.H.T), matvec(jnp.abs(self.D), jnp.abs(x)))


def around(factorize: Callable | Constant, expand: Callable) -> Callable | Constant:
    """A `factorize` at the state that expand() gives with `along`, where it depends on it."""
    return factorize.around(*expand()) if isinstance(factorize, Completed) else factorize
