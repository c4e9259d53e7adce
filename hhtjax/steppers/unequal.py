"""Steps of unequal size that keep order 2: the generalised-alpha family after a change of the step.

The algorithmic acceleration a_n belongs to the time t_n + s h_old, s = alpha_m - alpha_f and h_old the step before. A
step h = r h_old expects it at t_n + s h, and has an error of O(h) in a, of order 1 in the end. Two rules mend that,
without a solve; both leave r = 1 as it is:

    r <= 1    a is moved:  a := w + r (a - w)
    r > 1     a stays, and the coefficients of this step know where it is, with sigma = s/r:
              gamma = (1/2 - sigma)/(1 + s - sigma),  beta = (gamma + 1/2)^2/4,
              alpha_f := alpha_f + alpha_m (s - sigma)

The first alone makes steps that grow and shrink in turn unstable; the second alone loses half an order with index 3.
Where r = 1 the rules meet: a derivative in the step sizes is there that of one side, off by O(h^3).
For s = 0 (Newmark, the trapezoidal rule) there is nothing to mend. Steps that grow by more than 2 at once can make
strongly damping methods (rho near 0) unstable. In index-3 form multipliers are of order 1.4 only where steps change;
in GGL form, the default, of order 2.

Without damping (alpha = 0, rho_inf = 1) constraints leave w and the multipliers one weakly stable mode: a step from
known v has w1 = -w + 2 (v1 - v)/h, errors e1 = -e - h^2 w''/6. Equal steps keep e near -h^2 w''/12; each change of
h^2 adds to what alternates, for ever. Of random steps that is a random walk: with 80 % of jitter (a pendulum in GGL
form, 100 to 6400 steps) w is of order 1.47 and L of 1.43; q and v are of order 2.03, as are the means of w and L over
both ends of a step (2.01, 2.02). With alpha = -0.05 w and L are of order 1.98 and 1.97: damp, where they matter.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp

from hhtjax.description import is_concrete
from hhtjax.steppers.residual import Coefficients, weighted


class Resizing:
    """What the family does when the step changes: the two rules above."""

    coefficients: Coefficients

    @property
    def resizes(self):
        """Whether there is anything to mend, alpha_m != alpha_f; a tracer may be."""
        shift = self.coefficients.alpha_m - self.coefficients.alpha_f
        return not (is_concrete(shift) and shift == 0)

    def resized(self, state, r):
        """The method and the state for a step r times as long as the one before."""
        if not self.resizes:
            return self, state
        return replace(self, coefficients=adapted(self.coefficients, r)), moved(state, r)  # pyright: ignore[reportArgumentType]


def moved(state, r):
    """The state with a where steps r times as long expect it, for r <= 1; of vectors or of pytrees."""
    shrunk = jnp.minimum(r, 1) - 1

    def move(a, w):
        return a + shrunk.astype(jnp.result_type(a)) * (a - w)

    w = state.v if state.w is None else state.w  # of a first-order system as its user sees it
    a = jax.tree.map(move, state.a, w)
    return state._replace(a=a, za=None if state.za is None else jax.tree.map(move, state.za, state.zdot))


def adapted(c, r):
    """The coefficients of a step r times as long as the one before, for r > 1."""
    s = c.alpha_m - c.alpha_f
    grown = jnp.maximum(r, 1)
    gamma = (grown / 2 - s) / (grown * (1 + s) - s)  # not through sigma, a division to wait for
    new = Coefficients(c.alpha_m, c.alpha_f + weighted(c.alpha_m, s - s / grown), (gamma + 0.5) ** 2 / 4, gamma)
    return c._replace(**{
        name: jnp.where(grown > 1, getattr(new, name), getattr(c, name)) for name in ("alpha_f", "beta", "gamma")
    })  # fmt: skip
