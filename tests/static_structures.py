"""Structures of elements at rest, by Newton's method on dense matrices, and their limit."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

from hhtjax import rotation


def chain(num_elements):
    """Pairs of neighbouring nodes, (E, 2)."""
    return np.stack([np.arange(num_elements), np.arange(num_elements) + 1], axis=1)


def rates_like(q):
    """Zeros like v."""
    return {name: jnp.zeros(x.shape[:-1] if name == "R" else x.shape, x.dtype) for name, x in q.items()}


def moved(q, x):
    """q (+) x."""
    turn = jax.vmap(lambda R, psi: rotation.product(R, rotation.exp(psi)))
    return {name: turn(q[name], x[name]) if name == "R" else q[name] + x[name] for name in q}


def force_of(element, pairs, each, q, v, params=None):
    """The sum of the forces of elements, like v."""
    own, rates = ({name: y[pairs] for name, y in z.items()} for z in (q, v))
    found = jax.vmap(element, in_axes=(0, 0, None, None, 0))(own, rates, 0.0, params, each)
    return {name: jnp.zeros_like(v[name]).at[pairs].add(found[name]) for name in found}


@partial(jax.jit, static_argnums=0)
def newton_step(element, each, q, load):
    """One step, and how far it goes, of a chain that is clamped at its first node and loaded by a force like v."""
    zero = rates_like(q)
    names, pairs = sorted(q), chain(len(q["r"]) - 1)
    free = {name: x[1:] for name, x in zero.items()}
    ends = np.cumsum([free[name].size for name in names])

    def residual(x):
        pieces = {name: y.reshape(free[name].shape) for name, y in zip(names, jnp.split(x, ends[:-1]), strict=True)}
        there = moved(q, {name: jnp.concatenate([zero[name][:1], y]) for name, y in pieces.items()})
        total = force_of(element, pairs, each, there, zero)
        return jnp.concatenate([(total[name] + load[name])[1:].ravel() for name in names])

    start = jnp.zeros(ends[-1], q["r"].dtype)
    x = -jnp.linalg.solve(jax.jacfwd(residual)(start), residual(start))
    pieces = {name: y.reshape(free[name].shape) for name, y in zip(names, jnp.split(x, ends[:-1]), strict=True)}
    return moved(q, {name: jnp.concatenate([zero[name][:1], y]) for name, y in pieces.items()}), jnp.max(jnp.abs(x))


def equilibrium(element, each, q, tip, stages=8):
    """q of a chain of elements under forces at its end, {leaf: force}, which grow in so many stages."""
    each = {name: jnp.broadcast_to(jnp.asarray(x), (len(q["r"]) - 1, *jnp.shape(x))) for name, x in each.items()}
    load = {name: x.at[-1].set(jnp.asarray(tip[name])) if name in tip else x for name, x in rates_like(q).items()}
    for stage in range(stages):
        given = {name: x * ((stage + 1) / stages) for name, x in load.items()}
        for _ in range(40):
            q, size = newton_step(element, each, q, given)
            if size < (1e-9 if stage + 1 == stages else 1e-2):  # the next one squares it
                break
        else:
            raise AssertionError(f"no equilibrium: {size}")
    return q


def rod_tip(curve, length, stiffness, force):
    """Where the end of a clamped rod goes: the equations of Reissner and Simo along the rod, shot at a free end.

    With R' = R hat(kappa) and r' = R (Gamma + e_1), the force in the section is constant and its moment falls to 0.
    curve (3,): curvature at rest, in the frame of the section, which is that of space at the clamp.
    """
    along, bending = np.asarray(stiffness[:3]), np.asarray(stiffness[3:])

    def change(s, y, moment):
        r, R = y[:3], y[3:].reshape(3, 3)
        kappa = R.T @ (moment - np.cross(r, force)) / bending + curve
        turn = np.cross(kappa, np.eye(3)).T  # hat(kappa)
        return np.concatenate([R @ (R.T @ force / along + [1, 0, 0]), (R @ turn).ravel()])

    def run(moment):
        start = np.concatenate([np.zeros(3), np.eye(3).ravel()])
        return solve_ivp(change, (0, length), start, "DOP853", rtol=1e-11, atol=1e-11, args=(moment,)).y[:3, -1]

    moment = np.zeros(3)
    for part in np.linspace(0.1, 1, 10):  # of the force, for a start that is near
        given, force = force, part * np.asarray(force)
        found = root(lambda m: m - np.cross(run(m), force), moment, tol=1e-11)  # noqa: B023
        force, moment = given, found.x
        assert found.success
    return run(moment)
