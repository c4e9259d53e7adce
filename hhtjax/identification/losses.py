"""Robust losses, and the cost that a fit lowers: 1/2 sum rho((w r)^2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hhtjax.description import Array, PyTree


def huber(z: Array) -> Array:
    """z up to 1, then 2 sqrt(z) - 1: the square of a small residual, the size of a large one."""
    return jnp.where(z <= 1, z, 2 * jnp.sqrt(jnp.maximum(z, 1)) - 1)


def soft_l1(z: Array) -> Array:
    """2 (sqrt(1 + z) - 1): Huber's loss made smooth."""
    return 2 * z / (jnp.sqrt(1 + z) + 1)


LOSSES = {"huber": huber, "soft_l1": soft_l1, "cauchy": jnp.log1p}
LEAST_BEND = 0.1  # share of rho' that rho' + 2 rho'' z is taken to have at least, in a step


class Objective(NamedTuple):
    """The cost 1/2 sum rho(z), z = (w r)^2, of the first `data` residuals; for the others, the priors, rho(z) = z."""

    weights: PyTree  # (m,); 0: missing, whatever the residual
    loss: Callable | None
    data: int

    def scaled(self, r: Array) -> Array:
        """w r, with 0 where samples are missing; r may be a Jacobian."""
        w = self.weights.reshape(-1, *(1,) * (r.ndim - 1))
        return jnp.where(w == 0, 0, w * r)

    def losses(self, r: Array):
        """rho of each residual, and its first two derivatives."""
        z = self.scaled(r) ** 2
        ones = jnp.ones_like(z)
        loss = self.loss
        if loss is None:
            return z, ones, 0 * z

        def rho(z: Array) -> Array:
            return jnp.concatenate([loss(z[: self.data]), z[self.data :]])

        (value, slope), (_, curvature) = jax.jvp(lambda z: jax.jvp(rho, (z,), (ones,)), (z,), (ones,))
        return value, slope, curvature

    def cost(self, r: Array) -> Array:
        """1/2 sum rho."""
        return jnp.sum(self.losses(r)[0]) / 2

    def least_squares(self, r: Array, J: Array):
        """(r, J) of an ordinary least-squares problem with the same gradient J^T r.

        The rows of J are scaled by sqrt(rho' + 2 rho'' z) (Triggs et al. 2000, Sec. 4.3). This factor is kept from
        falling far below sqrt(rho'), that of iterative reweighting, so that r does not become too long.
        """
        if self.loss is None:
            return self.scaled(r), self.scaled(J)
        row, slope = jnp.sqrt(self._stretch(r)), self.losses(r)[1]
        r, J = self.scaled(r), self.scaled(J)
        return slope * r / jnp.where(row == 0, 1, row), J * row[:, None]

    def stretch(self, r: Array):
        """Squares of the factors by which `least_squares` scales the rows of w J; None without a loss (all 1).

        They are rho' + 2 rho'' z, kept from falling far below rho'.
        """
        return None if self.loss is None else self._stretch(r)

    def _stretch(self, r: Array) -> Array:
        """`stretch` of a cost with a loss."""
        _, slope, curvature = self.losses(r)
        return jnp.maximum(slope + 2 * curvature * self.scaled(r) ** 2, LEAST_BEND * slope)

    def estimating(self, r: Array, J: Array):
        """(J, pull, bend): w J, and the first and second derivative of the loss of each weighted residual.

        J^T pull is the gradient of the cost, and J^T diag(bend) J its second derivative. bend is None without a loss,
        where it is 1.
        """
        r, J, (_, slope, curvature) = self.scaled(r), self.scaled(J), self.losses(r)
        return J, slope * r, None if self.loss is None else slope + 2 * curvature * r**2
