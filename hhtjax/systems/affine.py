"""Checks whether r of `System(dynamics=r)` is affine in w, once for a function, with concrete numbers.

If the derivative with respect to w does not read w, the check is done. Otherwise r is evaluated at four accelerations.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any
from weakref import WeakSet

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from hhtjax.description import Array, PyTree, Real, all_concrete, is_tracing, thaw
from hhtjax.primitives import traced
from hhtjax.systems.system import AnySystem

ROUNDING = 1e-6  # of r, by which its sums may differ

_known: WeakSet = WeakSet()


def require_affine(
    caller: str, system: AnySystem, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree = None
) -> None:
    """Raises an error for `dynamics` that is not affine in w; an object with an attribute `is_affine` is trusted."""
    dynamics: Any = getattr(system, "dynamics", None)
    if dynamics is None or getattr(dynamics, "is_affine", False) or is_tracing() or not all_concrete((q0, v0, params)):
        return
    with suppress(TypeError):  # of what has no weak references, and is looked at again
        if dynamics in _known:
            return
    _look(caller, dynamics, q0, v0, t0, params, z0)
    with suppress(TypeError):
        _known.add(dynamics)


def _look(caller: str, dynamics: Callable, q0: PyTree, v0: PyTree, t0: Real, params: PyTree, z0: PyTree):
    """The violation, if r is not affine."""
    v, unravel = ravel_pytree(v0)
    z = () if z0 is None else (z0,)

    def r(w: Array) -> Array:
        return ravel_pytree(dynamics(q0, v0, unravel(w), *z, t0, thaw(params)))[0]

    some = jnp.asarray(1 + 0.618 * np.arange(v.size) % 0.5, v.dtype)
    try:
        slope = traced(lambda w: jax.jvp(r, (w,), (some,))[1], v)
    except Exception:  # of a user's function: `flatten` names what is wrong
        return
    if not slope.reads(None)[0]:
        return
    values = jax.jit(lambda w: jnp.stack([r(x) for x in w]))(
        jnp.stack([0 * some, some, -3 * some[::-1], some - 3 * some[::-1]])
    )
    left = np.abs(np.asarray(values[1] + values[2] - values[0] - values[3]))
    size = max(float(jnp.max(jnp.abs(values))), float(jnp.finfo(v.dtype).tiny))
    if np.max(left) > max(ROUNDING, 1e3 * float(jnp.finfo(v.dtype).eps)) * size:
        i = int(np.argmax(left))
        raise ValueError(
            f"{caller}: `dynamics` must be affine in w, r = M(q, t) w - Q(q, v, t); received one with r(w1) + r(w2) - "
            f"r(w1 + w2) - r(0) = {left[i]:.3g} in row {i}, at q0 and v0, where r is up to {size:.3g}."
        )
