"""Parameters whose equations move as the steps did: the correction of `step_size_bias`.

What the steps do to a mode is known from the eigenvalues s of their amplification matrix, and from the change of s with
the stiffness: a force -eps K q changes s by as much as the mode responds to forces. So no force needs to be applied;
with the stiffness of one part of the coordinates after the other, it shows the shapes of the modes as well.
"""

import warnings
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.identification.refinement import StepSizeWarning

GAIN_WEIGHT = 1e-3  # frequency and damping first; the response to forces with the freedom that they leave
PROBE = 1e-4  # relative change of the stiffness that shows the response to forces
PARTS = 4  # of the coordinates, at most
FOLLOWED = 0.25  # share of the error of the response that may be left
LEAST = 0.02  # influence of a parameter on a frequency, below which it is no stiffness


class Motion(NamedTuple):
    """Of each mode: rates (modes,) and their changes (parts, modes) with the stiffness of a part of the coordinates."""

    rates: Any
    response: Any


def motion(rates, M, C, K, stiffness) -> Motion:
    """rates: function of (M, C, K). stiffness: the K that is probed."""
    n = len(stiffness)
    changes = []
    for part in np.array_split(np.arange(n), min(n, PARTS)):
        D = PROBE * np.isin(np.arange(n), part)[:, None] * np.asarray(stiffness)
        D = (D + D.T) / 2
        changes.append((rates(M, C, K + D) - rates(M, C, K - D)) / (2 * PROBE))
    return Motion(rates(M, C, K), np.stack(changes))


def prewarped(params, flags, linear_part, rates, target, stiffness, free):
    """params with the least relative changes that reproduce `target`, the `Motion` of the steps.

    flags: Booleans for leaves or branches of params. linear_part: params -> (M, C, K). rates: of those, in the order
    of the target. free: whether the only motion is the free vibration of one mode, whose response does not matter.
    """
    params = jax.tree.map(lambda p: jnp.asarray(p, jnp.result_type(float)), params)
    fitted, unravel = ravel_pytree(params)
    repeated = jax.tree.map(lambda flag, branch: jax.tree.map(lambda p: jnp.full(p.shape, flag), branch), flags, params)
    at = np.flatnonzero(ravel_pytree(repeated)[0])
    if not at.size:
        return params

    @jax.jit
    def moved(x):
        params = unravel(fitted.at[at].multiply(1 + x))
        return params, linear_part(params)

    def matrices(x):
        M, C, K = moved(x)[1]
        return np.asarray(M), np.asarray(C), np.asarray(K)

    def unlike(x):
        M, C, K = matrices(x)
        now = motion(rates, M, C, K, stiffness)
        return now.rates / target.rates - 1, (now.response - target.response) / np.linalg.norm(target.response, axis=0)

    def apart(x):
        off = np.concatenate([np.ravel(y) for y in unlike(x)])
        off[len(target.rates) :] *= GAIN_WEIGHT
        return np.concatenate([np.real(off), np.imag(off)])

    start = np.zeros(len(at))
    x = _least_change(apart, start)
    before, left = (np.linalg.norm(unlike(x)[1]) for x in (start, x))
    if not free and left > FOLLOWED * before:
        warnings.warn(_compromise(left), StepSizeWarning, stacklevel=3)
        x = _least_change(lambda x: np.abs(rates(*matrices(x))) / np.abs(target.rates) - 1, start, LEAST)
    return moved(x)[0]


def _compromise(left):
    return (
        f"step_size_bias: no values of params have the steps' response to forces ({100 * left:.2g} % of it is left): "
        "damping was fitted as a compromise that depends on the motion, and stays as it is; `refine` corrects it, and "
        "stiffness that was fitted to motion far from the resonances."
    )


def _least_change(apart, x, least=0.0):
    """Gauss-Newton steps of least norm towards apart(x) = 0, along directions that change it by more than `least`."""
    for _ in range(4):
        J = np.stack([(apart(x + e) - apart(x - e)) / 2e-5 for e in 1e-5 * np.eye(len(x))], axis=1)
        U, s, Vt = np.linalg.svd(J, full_matrices=False)
        seen = s > max(1e-5 * s[0], least)
        x = x - Vt[seen].T @ (U[:, seen].T @ apart(x) / s[seen])
    return x
