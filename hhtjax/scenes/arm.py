"""A manipulator arm: an open chain of rigid links on N revolute joints, each with a spring and a damper.

q (N,): joint angles, rad: link i turns by q_i about joint i, which the link before carries. At q = 0 the
frames of all links are parallel to that of the base. The params, arrays in SI units, are made by `chain`.

Two formulations of one model. `newton_euler`: M by the composite-rigid-body algorithm, Q by the recursive
Newton-Euler algorithm, in the base frame. `lagrange`: both by autodiff of L = T - V, in the link frames.

References:
    Luh, Walker, Paul (1980); Walker, Orin (1982); Featherstone, Rigid Body Dynamics Algorithms (2008), Ch. 5-6.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax

from hhtjax.checks import require_number
from hhtjax.description import Array, PyTree, Real, is_array, is_concrete, is_real
from hhtjax.rotation import GENERATORS
from hhtjax.scenes.scene import Scene, array
from hhtjax.systems.system import System

GRAVITY = 9.80665


def product(A: Array, B: Array):
    """Matrices times matrices, (..., n, m) by (..., m, k), elementwise: XLA fuses that, and small dots it does not."""
    return jnp.sum(A[..., :, :, None] * B[..., None, :, :], axis=-2)


def apply(A: Array, x: Array) -> Array:
    """Matrices times vectors, (..., n, m) by (..., m)."""
    return jnp.sum(A * x[..., None, :], axis=-1)


def skew(a: Array) -> Array:
    """The matrices (..., 3, 3) of the cross product: skew(a) b = a x b."""
    generators = jnp.broadcast_to(jnp.asarray(GENERATORS, a.dtype), (*a.shape, 3, 3))
    return jnp.sum(a[..., None, None] * generators, axis=-3)


def rotation(axis: Array, angle: Array) -> Array:
    """R (..., 3, 3) by an angle about a unit vector; takes vectors of a link to the frame of the link before."""
    K, angle = skew(axis), angle[..., None, None]
    eye = jnp.broadcast_to(jnp.eye(3, dtype=K.dtype), K.shape)
    return eye + jnp.sin(angle) * K + (1 - jnp.cos(angle)) * product(K, K)


def joint_torques(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """-k (q - rest) - c v. Angles are relative, so the reactions on the links before need no terms."""
    return -params["k"] * (q - params["rest"]) - params["c"] * v


def lagrangian(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """L: over the links, the sum of m u.u/2 + Omega.(I Omega)/2 + m g.x; u and x of the centre of mass."""

    def add_link(before: tuple, link: tuple):
        Omega, u, g, gx, L = before  # in the frame of the link before; u and gx = g.x of its joint
        q, v, axis, offset, mass, com, inertia = link
        R = rotation(axis, q).T
        u, gx, g = apply(R, u + apply(skew(Omega), offset)), gx + jnp.sum(g * offset), apply(R, g)
        Omega = apply(R, Omega) + axis * v
        u_com = u + apply(skew(Omega), com)
        T = jnp.sum(mass * u_com**2 + Omega * apply(inertia, Omega)) / 2
        L = L + T + mass * (gx + jnp.sum(g * com))
        return (Omega, u, g, gx, L), None

    zero = jnp.zeros(3, q.dtype)
    base = zero, zero, params["gravity"], zero[0], zero[0]
    links = (params[name] for name in ("axis", "offset", "mass", "com", "inertia"))
    return lax.scan(add_link, base, (q, v, *links))[0][-1]


def frames(q: Array, params: PyTree):
    """R (N, 3, 3) and x (N, 3): the frame of each link and the place of its joint, in the base frame."""
    R, x = jnp.eye(3, dtype=q.dtype), jnp.zeros(3, q.dtype)
    placed = []
    for turn, offset in zip(rotation(params["axis"], q), params["offset"], strict=True):
        R, x = product(R, turn), x + apply(R, offset)
        placed.append((R, x))
    R, x = zip(*placed, strict=True)
    return jnp.stack(R), jnp.stack(x)


def axes_and_inertias(q: Array, params: PyTree):
    """S (N, 6) of the joints and J (N, 6, 6) of the links, as spatial vectors and matrices at the base.

    The velocity of a link is (Omega, u), with u of its point at the origin of the base: S_i for v_i = 1. J_i
    takes it to (moment of momentum about that origin, momentum). In this one frame, links simply add up.
    """
    R, x = frames(q, params)
    m, axis = params["mass"][:, None, None], apply(R, params["axis"])
    K, eye = skew(x + apply(R, params["com"])), jnp.eye(3, dtype=q.dtype)[None]
    inertia = product(product(R, params["inertia"]), jnp.swapaxes(R, 1, 2)) - m * product(K, K)
    J = jnp.block([[inertia, m * K], [-m * K, m * eye]])
    return jnp.concatenate([axis, apply(skew(x), axis)], axis=1), J


def mass(q: Array, params: PyTree) -> Array:
    """M_ij = S_i . (sum of J over the links that both joints carry) S_j: composite rigid bodies."""
    S, J = axes_and_inertias(q, params)
    U = _inward(q)
    composite = jnp.sum(U[:, :, None, None] * J[:, None], axis=0)
    M = product(S, apply(composite, S).T)
    return jnp.where(U.T > 0, M, M.T)


def force(q: Array, v: Array, t: Real, params: PyTree) -> Array:
    """Q: the joint torques, less those that motion without joint acceleration needs: recursive Newton-Euler."""
    S, J = axes_and_inertias(q, params)
    U, rates = _inward(q), S * v[:, None]
    V = product(U, rates)
    turning, moving = skew(V[:, :3]), skew(V[:, 3:])
    X = jnp.block([[turning, jnp.zeros_like(turning)], [moving, turning]])  # X y: rate of a y fixed to the link
    A = product(U, apply(X, rates)) - jnp.concatenate([jnp.zeros(3, q.dtype), params["gravity"]])[None]
    wrench = apply(J, A) - apply(jnp.swapaxes(X, 1, 2), apply(J, V))
    return joint_torques(q, v, t, params) - jnp.sum(S * product(U.T, wrench), axis=1)


def _inward(q: Array) -> Array:
    """U (N, N): 1 where joint j carries link i. U x sums from the base to each link, U^T x from each to the tip."""
    return jnp.tril(jnp.ones((q.size, q.size), q.dtype))


newton_euler = System(mass, force)
lagrange = System.from_lagrangian(lagrangian, joint_torques)


def chain(
    axis: PyTree,
    offset: PyTree,
    mass: PyTree,
    com: PyTree,
    inertia: PyTree,
    k: PyTree,
    c: PyTree,
    rest: PyTree,
    gravity: PyTree = (0.0, 0.0, -GRAVITY),
):
    """The params of an open chain of N joints: a dict of arrays.

    Args:
        axis: unit vectors of the joints, (N, 3), fixed to both links of a joint.
        offset: joint i seen from joint i - 1, in frame i - 1, (N, 3), m; of the first, from the base.
        mass: (N,), kg. com: centres of mass seen from their joints, (N, 3), m, in the frame of their links.
        inertia: tensors about the centres of mass, (N, 3, 3), kg m^2, in the frame of their links.
        k, c, rest: stiffness (N m/rad), damping (N m s/rad) and set points (rad) of the joints, (N,).
        gravity: (3,), m/s^2, in the base frame.

    Raises:
        TypeError, ValueError: not real, not finite, of a wrong length or shape; axes that are not unit vectors.

    Example: a rod of 1 m and 3 kg on a horizontal joint, M = m l^2/3.

    >>> import jax.numpy as jnp
    >>> rod = chain(
    ...     axis=[[0, 1, 0]], offset=[[0, 0, 0]], mass=[3.0], com=[[0.5, 0, 0]],
    ...     inertia=[[[0, 0, 0], [0, 0.25, 0], [0, 0, 0.25]]], k=[0.0], c=[0.0], rest=[0.0])
    >>> newton_euler.mass(jnp.array([0.3]), rod).round(6).tolist()
    [[1.0]]
    """
    axis = _real("axis", axis)
    if axis.ndim != 2 or axis.shape[0] == 0 or axis.shape[1] != 3:
        raise ValueError(f"chain: `axis` must have shape (N, 3); received {axis.shape}.")
    if is_concrete(axis) and not np.allclose(np.linalg.norm(axis, axis=1), 1, atol=1e-5):
        raise ValueError(f"chain: `axis` must hold unit vectors; received {axis!r}.")
    n = axis.shape[0]
    others = {"offset": (offset, (n, 3)), "mass": (mass, (n,)), "com": (com, (n, 3)), "inertia": (inertia, (n, 3, 3))}
    others |= {"k": (k, (n,)), "c": (c, (n,)), "rest": (rest, (n,)), "gravity": (gravity, (3,))}
    params = {"axis": axis}
    for name, (received, shape) in others.items():
        params[name] = value = _real(name, received)
        if value.shape != shape:
            raise ValueError(
                f"chain: `{name}` must have shape {shape} with N = {n} joints; received shape {value.shape}."
            )
    return params


def _real(name: str, received: PyTree) -> Array:
    """A float array, checked."""
    try:
        value = received if is_array(received) else np.asarray(received)
    except ValueError:
        raise ValueError(f"chain: `{name}` must be an array; received the ragged {received!r}.") from None
    if not is_real(value):
        raise TypeError(f"chain: `{name}` must be real numbers; received {received!r}.")
    if is_concrete(value) and not np.all(np.isfinite(value)):
        raise ValueError(f"chain: `{name}` must be finite; received {received!r}.")
    value = jnp.asarray(value)
    return value if jnp.issubdtype(value.dtype, jnp.floating) else value.astype(jnp.result_type(float))


def swing(joints: int = 6) -> Scene:
    """A six-axis arm of 45 kg and 1.2 m, let go from a bent pose; or its first few joints.

    Base yaw, shoulder and elbow pitch on soft springs, wrist roll, wrist pitch and tool roll on stiff
    ones with strong dampers: time scales from 1 ms to 2 s.

    Args:
        joints: how many, 1 to 6.

    Raises:
        TypeError, ValueError: joints is none of these.
    """
    joints = int(require_number("swing", "joints", joints, lambda n: n in range(1, 7), "be 1, 2, ... 6"))
    yaw, pitch, roll = np.eye(3)[::-1]
    radii = [[9, 9, 3], [1, 4, 4], [1, 2, 2], [0.3, 1.5, 1.5], [0.2, 0.3, 0.3], [0.2, 0.4, 0.4]]  # 0.01 m^2
    masses = np.array([20.0, 12.0, 6.0, 4.0, 2.0, 1.5])
    arrays = {
        "axis": [yaw, pitch, pitch, roll, pitch, roll],
        "offset": [[0, 0, 0], [0, 0, 0.4], [0.6, 0, 0], [0.2, 0, 0.05], [0.3, 0, 0], [0.1, 0, 0]],
        "mass": masses,
        "com": [[0, 0, 0.2], [0.25, 0, 0], [0.08, 0, 0.02], [0.15, 0, 0], [0.05, 0, 0], [0.08, 0.02, 0.03]],
        "inertia": [0.01 * m * np.diag(r) for m, r in zip(masses, radii, strict=True)],
        "k": [60.0, 150.0, 80.0, 200.0, 200.0, 30.0],
        "c": [5.0, 8.0, 3.0, 20.0, 20.0, 3.0],
        "rest": [0.0, -0.6, 0.9, 0.4, -0.5, 0.3],
    }
    params = chain(**{name: np.asarray(value, float)[:joints] for name, value in arrays.items()})
    q0 = np.array([0.8, -1.1, 1.5, 0.4, -0.5, 0.3])[:joints]
    return Scene(newton_euler, params, array(q0), array(0 * q0), 2.0)
