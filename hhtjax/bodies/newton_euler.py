"""Inverse dynamics of a tree of bodies, and its derivatives in closed form.

    ID(q, v, w) = M(q) w + bias(q, v),    the joint forces needed for the accelerations w

All vectors are in world axes, and all moments about the root of each tree, so that the load of a joint is a sum over
bodies. A joint has one row S = (a, u) for each of its rates: a is the angular velocity for unit rate, and u the
velocity of the point at the root. With y the origin of its frame, about which it turns,

    hinge (a, y x a)      slide (0, a)      ball (R e_i, y x R e_i), material      translation (0, e_i)

The sums over the joints at or above a body, and those strictly above a joint (index p), give

    V = sum S v,    A = -g + sum (S w + V_p x S v)

and the force and moment needed by a body of mass m, first moment h and second moment Sigma about the root are

    lin = A_u + om x V_u,    D = hat(al) + om om^T - |om|^2 1
    f = m lin + D h,    N = lin h^T + D Sigma,    moment = (N32 - N23, N13 - N31, N21 - N12)

With F the sum of (moment, f) over the bodies that a joint carries, ID_i = S_i . F_i. The derivatives are in `slopes`.

References: R. Featherstone, Rigid Body Dynamics Algorithms, 2008, Ch. 5 and 6; J. Carpentier, N. Mansard, Analytical
derivatives of rigid body dynamics algorithms, Robotics: Science and Systems, 2018; S. Singh, R. Russell, P. Wensing,
IEEE Robot. Autom. Lett. 7, 2022, 1776-1783.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from hhtjax.bodies.tree import Tree
from hhtjax.description import Array, Real

ELEMENTWISE = 16  # rates up to which products of rows are written out, which one kernel likes; above, as products


class Position(NamedTuple):
    """The position of a tree.

    Attributes:
        x: of hinges and slides, (ns,). R: of balls, (nr, 3, 3), those of free joints last.
        y: of free joints, (nf, 3); only the positions of frames depend on it.
    """

    x: Array
    R: Array
    y: Array


class Inertia(NamedTuple):
    """For each link: mass (L,), first moment (L, 3) and second moment (L, 3, 3) about its frame, in its axes."""

    m: Array
    h: Array
    Sigma: Array


class Placed(NamedTuple):
    """Frames of all nodes relative to the root of their tree: R (K, 3, 3), y (K, 3); and the rows S (nv, 6)."""

    R: list
    y: list
    S: Array


def place(tree: Tree, p: Position, offsets: Any = None) -> Placed:
    """The frame of each node, from the root to the tips. offsets: (K, 3), instead of those of the tree, or None."""
    dtype = p.x.dtype
    sines, cosines = jnp.sin(p.x), 1 - jnp.cos(p.x)
    R: list = []
    y: list = []
    S: list = [None] * tree.rates
    for k, node in enumerate(tree.nodes):
        E, d = np.asarray(node.E, dtype), np.asarray(node.offset, dtype) if offsets is None else offsets[k]
        axis = np.asarray(node.axis, dtype)
        if node.kind == "hinge":
            EK, EKK = (np.asarray(x, dtype) for x in node.turns)
            E = E + sines[node.slot] * EK + cosines[node.slot] * EKK
        elif node.kind == "slide":
            d = d + p.x[node.slot] * (E @ axis)
        elif node.kind == "ball":
            E = product(E, p.R[node.slot])
        if node.parent < 0:
            R.append(jnp.asarray(E))
            y.append(jnp.asarray(d))
        else:
            above = R[node.parent]
            R.append(product(above, E))
            y.append(y[node.parent] + apply(above, d))
        for i, row in zip(node.rates, _rows(node, R[k], y[k], axis), strict=True):
            S[i] = row
    return Placed(R, y, jnp.stack(S))


def _rows(node, R: Array, y: Array, axis: np.ndarray):
    """The rows of a joint, which turns about the origin of its frame."""
    zero = np.zeros(3, R.dtype)
    if node.kind in ("hinge", "ball"):
        turns = [apply(R, axis)] if node.kind == "hinge" else list(R.T)
        return [jnp.concatenate([a, cross(y, a)]) for a in turns]
    ways = [apply(R, axis)] if node.kind == "slide" else np.eye(3, dtype=R.dtype)
    return [jnp.concatenate([zero, u]) for u in ways]


def in_world(tree: Tree, placed: Placed, inertia: Inertia) -> Inertia:
    """The inertias about the roots, in world axes."""
    R, y = (jnp.stack([x[k] for k in tree.links]) for x in (placed.R, placed.y))
    h = apply(R, inertia.h)
    whole = h + inertia.m[:, None] * y
    Sigma = product(product(R, inertia.Sigma), jnp.swapaxes(R, 1, 2)) + outer(y, h) + outer(whole, y)
    return Inertia(inertia.m, whole, Sigma)


class Motion(NamedTuple):
    """Velocities and accelerations. above: V_p x S, (nv, 6). V, A: of links, (L, 6). rates: S w + V_p x S v."""

    above: Array
    V: Array
    A: Array
    Vp: Array
    rates: Array
    base: Array


def motion(tree: Tree, S: Array, v: Array, w: Array, gravity: Array) -> Motion:
    """Velocities and accelerations; the world has the acceleration -g."""
    along = S * v[:, None]
    Vp = total(tree.above, along)
    above = turned(Vp, S)
    rates = S * w[:, None] + above * v[:, None]
    base = jnp.concatenate([np.zeros(3, S.dtype), -gravity])[None]
    return Motion(above, total(tree.carried.T, along), total(tree.carried.T, rates) + base, Vp, rates, base)


def required(inertia: Inertia, V: Array, A: Array):
    """The (moment, force) that each link needs: (L, 6)."""
    lin, D = _accelerations(V, A)
    f = inertia.m[:, None] * lin + apply(D, inertia.h)
    N = outer(lin, inertia.h) + product(D, inertia.Sigma)
    return jnp.concatenate([axial(N), f], axis=-1)


def _accelerations(V: Array, A: Array):
    """The acceleration of the point at the root, and D, which gives the acceleration of other points."""
    om, al = V[:, :3], A[:, :3]
    lin = A[:, 3:] + cross(om, V[:, 3:])
    eye = np.eye(3, dtype=V.dtype)[None]
    D = hat(al) + outer(om, om) - jnp.sum(om**2, axis=-1)[:, None, None] * eye
    return lin, D


def plain_inverse_dynamics(
    tree: Tree, p: Position, v: Array, w: Array, inertia: Inertia, gravity: Array, offsets: Any = None
) -> Array:
    """ID (nv,), which autodiff can differentiate in every way."""
    placed = place(tree, p, offsets)
    x = motion(tree, placed.S, v, w, gravity)
    F = total(tree.carried, required(in_world(tree, placed, inertia), x.V, x.A))
    return jnp.sum(placed.S * F, axis=-1)


class Slopes(NamedTuple):
    """ID (nv,), and its derivatives (nv, nv) in displacements, rates and accelerations; the last is M."""

    value: Array
    q: Array
    v: Array
    w: Array


def slopes(
    tree: Tree, p: Position, v: Array, w: Array, inertia: Inertia, gravity: Array, offsets: Any = None
) -> Slopes:
    """The derivatives in closed form. With C for the bodies that a joint carries, J their inertia, and p_j, c_j of a
    joint j

        K = V_u h^T + hat(om) Sigma,    f = m V_u + om x h,    2B X = (2 (tr K 1 - K) X_om, 2 X_om x f)
        p_j = V_p x S_j,    c^q_j = A_p x S_j + V_p x p_j,    c^v_j = 2 p_j + (S v of the joint) x S_j

    dID_i/dq_j = S_i . (J_i c^q_j + 2B_i p_j) for j at or above i, S_i . (J_j c^q_j + 2B_j p_j + S_j x* F_j) for i above
    j. dID_i/dv_j is the same with c^v_j and S_j instead of c^q_j and p_j, and without F.
    """
    placed = place(tree, p, offsets)
    S = placed.S
    x = motion(tree, S, v, w, gravity)
    inertia = in_world(tree, placed, inertia)
    om, u = x.V[:, :3], x.V[:, 3:]
    K = outer(u, inertia.h) + product(hat(om), inertia.Sigma)
    momentum = inertia.m[:, None] * u + cross(om, inertia.h)
    c = Carried.of(tree, required(inertia, x.V, x.A), inertia, K, momentum)

    Ap = total(tree.above, x.rates) + x.base
    cq = turned(Ap, S) + turned(x.Vp, x.above)
    cv = 2 * x.above + (turned(total(tree.beside, S * v[:, None]), S) if tree.balls else 0)
    upward = jnp.concatenate([c.momentum_of(S), c.transposed(S)], axis=-1)  # S_i . J_i, and S_i . 2B_i of turns
    down_q = c.momentum_of(cq) + c.twice_B(x.above) + wrenched(S, c.F)
    down_v = c.momentum_of(cv) + c.twice_B(S)
    M = products(upward[:, :6], S)
    return Slopes(
        jnp.sum(S * c.F, axis=-1),
        choose(tree, products(upward, jnp.concatenate([cq, x.above[:, :3]], axis=-1)), products(S, down_q)),
        choose(tree, products(upward, jnp.concatenate([cv, S[:, :3]], axis=-1)), products(S, down_v)),
        choose(tree, M, M.T),
    )


class Carried(NamedTuple):
    """Sums over the bodies that the joint of each rate carries."""

    F: Array
    m: Array
    h: Array
    Sigma: Array
    K: Array
    f: Array

    @classmethod
    def of(cls, tree: Tree, F: Array, inertia: Inertia, K: Array, f: Array) -> Carried:
        """The sums, from the values of the links."""
        L = len(tree.links)
        parts = [F, inertia.m[:, None], inertia.h, inertia.Sigma.reshape(L, 9), K.reshape(L, 9), f]
        whole = total(tree.carried, jnp.concatenate(parts, axis=-1))
        F, m, h, Sigma, K, f = jnp.split(whole, np.cumsum([x.shape[-1] for x in parts])[:-1], axis=-1)
        return cls(F, m, h, Sigma.reshape(-1, 3, 3), K.reshape(-1, 3, 3), f)

    def momentum_of(self, X: Array) -> Array:
        """J X."""
        om, u = X[:, :3], X[:, 3:]
        moment = trace(self.Sigma) * om - apply(self.Sigma, om) + cross(self.h, u)
        return jnp.concatenate([moment, self.m * u + cross(om, self.h)], axis=-1)

    def twice_B(self, X: Array) -> Array:
        """2B X."""
        om = X[:, :3]
        return 2 * jnp.concatenate([trace(self.K) * om - apply(self.K, om), cross(om, self.f)], axis=-1)

    def transposed(self, X: Array) -> Array:
        """2B^T X, whose part of velocities is zero: (nv, 3)."""
        om, u = X[:, :3], X[:, 3:]
        return 2 * (trace(self.K) * om - apply(jnp.swapaxes(self.K, 1, 2), om) + cross(self.f, u))


def choose(tree: Tree, upward: Array, downward: Array) -> Array:
    """Entry i, j of the first where j is at or above i, of the second where i is strictly above j, 0 elsewhere."""
    at_or_above, below = (jnp.asarray(mask, upward.dtype) for mask in (tree.at_or_above, tree.above.T))
    return at_or_above * upward + below * downward  # products with constants, whose zeros a kernel leaves out


def mass_matrix(tree: Tree, p: Position, inertia: Inertia, offsets: Any = None) -> Array:
    """M (nv, nv): S_i . J_i S_j, with the inertia of what both joints carry (composite rigid bodies)."""
    placed = place(tree, p, offsets)
    inertia, S = in_world(tree, placed, inertia), placed.S
    nothing = jnp.zeros((len(tree.links), 6), S.dtype)
    c = Carried.of(tree, nothing, inertia, jnp.zeros_like(inertia.Sigma), jnp.zeros_like(inertia.h))
    M = products(c.momentum_of(S), S)
    return choose(tree, M, M.T)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def inverse_dynamics(
    tree: Tree, p: Position, v: Array, w: Array, inertia: Inertia, gravity: Array, offsets: Any = None
) -> Array:
    """ID (nv,), with closed-form derivatives in q, v and w; derivatives in everything else are by autodiff."""
    return plain_inverse_dynamics(tree, p, v, w, inertia, gravity, offsets)


@partial(inverse_dynamics.defjvp, symbolic_zeros=True)
def _(tree: Tree, primals: tuple, tangents: tuple):
    p, v, w, *others = primals
    dp, dv, dw, *changes = tangents
    if all(map(is_zero, (*dp, dv, dw))):  # only what is linear moves, and nobody asks for slopes
        plain = partial(plain_inverse_dynamics, tree, p, v, w)
        return jax.jvp(plain, tuple(others), tuple(jax.tree.map(as_numbers, changes, is_leaf=is_zero)))
    known = slopes(tree, p, v, w, *others)
    parts = []
    if not all(map(is_zero, dp)):
        parts.append((known.q, displacement(tree, p, dp)))
    parts += [(J, dx) for J, dx in ((known.v, dv), (known.w, dw)) if not is_zero(dx)]
    change = [jnp.sum(J * dx[None, :], axis=-1) for J, dx in parts]
    if not all(map(is_zero, jax.tree.leaves(changes, is_leaf=is_zero))):
        changes = jax.tree.map(as_numbers, changes, is_leaf=is_zero)
        plain = partial(plain_inverse_dynamics, tree, p, v, w)
        change.append(jax.jvp(plain, tuple(others), tuple(changes))[1])
    return known.value, sum(change)


def displacement(tree: Tree, p: Position, dp: Position) -> Array:
    """The change of a position, as a vector of rates (nv,)."""
    dx, dR = as_numbers(dp.x), as_numbers(dp.R)
    dpsi = axial(product(jnp.swapaxes(p.R, 1, 2), dR)) / 2
    return jnp.concatenate([dpsi.ravel(), jnp.zeros(3 * tree.frees, dx.dtype), dx]) if tree.balls else dx


def is_zero(x) -> bool:
    """Whether a tangent is known to autodiff as zero."""
    return isinstance(x, SymbolicZero)


def as_numbers(x):
    """A tangent as an array."""
    return jnp.zeros(x.shape, x.dtype) if is_zero(x) else x


# ----------------------------------------------------------------------------
# Vectors (..., 3) and matrices (..., 3, 3), elementwise: XLA fuses that, and small products of matrices it does not.


def product(A: Real, B: Real) -> Array:
    """A B."""
    return jnp.sum(A[..., :, :, None] * B[..., None, :, :], axis=-2)


def apply(A: Real, x: Real) -> Array:
    """A x."""
    return jnp.sum(A * x[..., None, :], axis=-1)


def outer(x: Real, y: Real) -> Array:
    """x y^T."""
    return x[..., :, None] * y[..., None, :]


def cross(x: Real, y: Real) -> Array:
    """x cross y."""
    (x1, x2, x3), (y1, y2, y3) = (jnp.moveaxis(z, -1, 0) for z in (x, y))
    return jnp.stack([x2 * y3 - x3 * y2, x3 * y1 - x1 * y3, x1 * y2 - x2 * y1], axis=-1)


def hat(x: Array) -> Array:
    """hat(x) y = x cross y."""
    x1, x2, x3 = jnp.moveaxis(x, -1, 0)
    zero = jnp.zeros_like(x1)
    rows = [[zero, -x3, x2], [x3, zero, -x1], [-x2, x1, zero]]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def axial(N: Array) -> Array:
    """(N32 - N23, N13 - N31, N21 - N12)."""
    return jnp.stack([N[..., 2, 1] - N[..., 1, 2], N[..., 0, 2] - N[..., 2, 0], N[..., 1, 0] - N[..., 0, 1]], axis=-1)


def trace(A: Array) -> Array:
    """(..., 1)."""
    return jnp.trace(A, axis1=-2, axis2=-1)[..., None]


def turned(X: Array, Y: Array) -> Array:
    """X x Y, for motions: the rate of a motion Y that is fixed to a body moving with X."""
    om, u = X[:, :3], X[:, 3:]
    return jnp.concatenate([cross(om, Y[:, :3]), cross(u, Y[:, :3]) + cross(om, Y[:, 3:])], axis=-1)


def wrenched(X: Array, F: Array) -> Array:
    """X x* F: the rate of a (moment, force) that is fixed to a body moving with X."""
    om, u = X[:, :3], X[:, 3:]
    return jnp.concatenate([cross(om, F[:, :3]) + cross(u, F[:, 3:]), cross(om, F[:, 3:])], axis=-1)


def total(mask: np.ndarray, x: Array) -> Array:
    """Sums of rows of x."""
    return jnp.matmul(jnp.asarray(mask, x.dtype), x, precision="highest")


def products(X: Array, Y: Array) -> Array:
    """X Y^T."""
    return (
        jnp.sum(X[:, None, :] * Y[None, :, :], axis=-1)
        if len(X) <= ELEMENTWISE
        else jnp.matmul(X, Y.T, precision="highest")
    )
