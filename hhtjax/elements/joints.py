"""Joints in the plane and in space: functions that are 0 if the joint is closed.

A joint connects two bodies, which are nodes {"r": (2,), "theta": ()} or {"r": (3,), "R": (3, 3)}. With one node, the
second body is the ground, whose frame is the frame of space. The joint acts on one point of each body, x_1 = r_1 + A_1
a and x_2 = r_2 + A_2 b, with A = R or the rotation by theta, and with offsets a and b in the frame of the body. Nodes
with only "r" have no frame, and so no offset; the ground has one.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax import rotation, trigonometry
from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import number, require_each, require_nodes, shape_of
from hhtjax.numerics.dense_lu import matvec


def pin(q: PyTree, t: Array, params: PyTree, each: PyTree | None = None) -> Array:
    """x_1 - x_2: keeps two points together. In the plane a pin, 2 rows; in space a ball joint, 3 rows.

    Args:
        q: of two nodes, {"r": (2, 2), "theta": (2,)} in the plane, {"r": (2, 3), "R": (2, 3, 3)} in space; with one
            node, the ground is the second body.
        t, params: not used.
        each: None, or optionally "a" and "b", (d,), m: the points in the frames of the first and the second body.

    Returns: (d,), in m: 0 if the joint is closed.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    Example: the end of an upright rod, pinned to the ground at (1, 2).

    >>> q = {"r": jnp.array([[1.0, 1.5]]), "theta": jnp.array([jnp.pi / 2])}
    >>> print(pin(q, 0.0, {}, {"a": jnp.array([0.5, 0.0]), "b": jnp.array([1.0, 2.0])}).round(6) + 0.0)
    [0. 0.]
    """
    (x1, x2), _ = _bodies("pin", q, each or {})
    return x1 - x2


def weld(q: PyTree, t: Array, params: PyTree, each: PyTree | None = None) -> Array:
    """`pin`, and no rotation of one body relative to the other: 3 rows in the plane, 6 in space.

    The rotation rows are theta_2 - theta_1 - frame in the plane, and the skew part of R_1^T R_2 frame^T in space.

    Args:
        q, t, params: as in `pin`.
        each: as in `pin`, and optionally "frame": the orientation of the second body in the frame of the first, an
            angle in rad in the plane, a rotation (3, 3) in space.

    Returns: (3,) or (6,), in m and rad: 0 if the joint is closed.
    Raises: TypeError, ValueError: as `pin`.

    >>> q = {"r": jnp.zeros((2, 2)), "theta": jnp.array([0.1, 0.4])}
    >>> print(weld(q, 0.0, {}, {"frame": 0.3}).round(6) + 0.0)
    [0. 0. 0.]
    """
    each = each or {}
    (x1, x2), _ = _bodies("weld", q, each)
    return jnp.concatenate([x1 - x2, _turn("weld", q, each)])


def revolute(q: PyTree, t: Array, params: PyTree, each: PyTree) -> Array:
    """A hinge in space: `pin`, and a common axis of both bodies; 5 rows.

    The last two rows are the components of the axis of the first body perpendicular to the axis of the second, in the
    frame of the second.

    Args:
        q, t, params: as in `pin`, in space.
        each: as in `weld`, and "axis", (3,): the axis in the frame of the second body. In the frame of the first it is
            `frame` axis.

    Returns: (5,), in m and rad: 0 if the joint is closed.
    Raises: TypeError, ValueError: as `pin`.

    >>> q = {"r": jnp.zeros((2, 3)), "R": jnp.stack([jnp.eye(3), rotation.exp(jnp.array([0.0, 0.0, 2.0]))])}
    >>> print(revolute(q, 0.0, {}, {"axis": jnp.array([0.0, 0.0, 1.0])}))
    [0. 0. 0. 0. 0.]
    """
    (x1, x2), R2 = _bodies("revolute", q, each)
    require_nodes("revolute", q, r=(jnp.shape(q["r"])[0], 3), R=(jnp.shape(q["r"])[0], 3, 3))
    axis, R1 = _axis("revolute", q, each), q["R"][0]
    first = axis if "frame" not in each else matvec(number("revolute", each, "frame", axis, (3, 3)), axis)
    return jnp.concatenate([x1 - x2, matvec(across(axis), matvec(R2.T, matvec(R1, first)))])


def slider(q: PyTree, t: Array, params: PyTree, each: PyTree) -> Array:
    """Keeps a point of the first body on a line of the second: 1 row in the plane, 2 in space. The body may rotate.

    The rows are the components of A_2^T (x_1 - x_2) perpendicular to the axis.

    Args:
        q, t, params: as in `pin`.
        each: as in `pin`, and "axis", (d,): the direction of the line through b, in the frame of the second body.

    Returns: (d - 1,), in m: 0 if the joint is closed.
    Raises: TypeError, ValueError: as `pin`.

    Example: the distance of a point from the line y = 1 on the ground.

    >>> each = {"axis": jnp.array([1.0, 0.0]), "b": jnp.array([0.0, 1.0])}
    >>> print(slider({"r": jnp.array([[3.0, 1.2]])}, 0.0, {}, each).round(6))
    [0.2]
    """
    (x1, x2), A2 = _bodies("slider", q, each)
    axis = _axis("slider", q, each)
    return matvec(across(axis), matvec(A2.T, x1 - x2))


def prismatic(q: PyTree, t: Array, params: PyTree, each: PyTree) -> Array:
    """A prismatic joint: `slider`, and no rotation of one body relative to the other; 2 rows in the plane, 5 in space.

    Args:
        q, t, params: as in `pin`.
        each: as in `weld`, and "axis", (d,): the direction of the line through b, in the frame of the second body.

    Returns: (2,) or (5,), in m and rad: 0 if the joint is closed.
    Raises: TypeError, ValueError: as `pin`.

    >>> q = {"r": jnp.array([[3.0, 0.0]]), "theta": jnp.array([0.1])}
    >>> print(prismatic(q, 0.0, {}, {"axis": jnp.array([1.0, 0.0])}).round(6) + 0.0)
    [ 0.  -0.1]
    """
    return jnp.concatenate([slider(q, t, params, each), _turn("prismatic", q, each)])


def rigid_link(q: PyTree, t: Array, params: PyTree, each: PyTree) -> Array:
    """(|x_1 - x_2|^2 - L^2)/(2 L): keeps two points at a distance L, a massless rod; 1 row.

    Args:
        q, t, params: as in `pin`; also nodes with only "r".
        each: as in `pin`, and "L", m: the distance, not 0.

    Returns: (1,), in m: 0 if the joint is closed.
    Raises: TypeError, ValueError: as `pin`.

    >>> print(rigid_link({"r": jnp.array([[3.0, 4.0]])}, 0.0, {}, {"L": 5.0}))
    [0.]
    """
    require_each("rigid_link", each, "L")
    (x1, x2), _ = _bodies("rigid_link", q, each)
    L = number("rigid_link", each, "L", x1)
    return ((jnp.sum((x1 - x2) ** 2) - L**2) / (2 * L))[None]


def across(axis: Array) -> Array:
    """Unit vectors (d - 1, d) perpendicular to an axis (d,), and to each other.

    In space: T. Duff et al., Building an orthonormal basis, revisited, J. Comput. Graph. Tech. 6(1), 2017, 1-8.
    """
    n = axis / jnp.sqrt(jnp.sum(axis**2))
    if n.size == 2:
        return jnp.stack([-n[1], n[0]])[None]
    x, y, z = n
    sign = jnp.where(z < 0, -1, 1).astype(n.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    return jnp.stack([jnp.stack([1 + sign * x * x * a, sign * b, -sign * x]), jnp.stack([b, sign + y * y * a, -y])])


def _bodies(caller: str, q: PyTree, each: PyTree):
    """The points (x_1, x_2) of both bodies, and A_2."""
    require_each(caller, each)
    if shape_of(q, "r") not in ((1, 2), (2, 2), (1, 3), (2, 3)):
        raise ValueError(f"{caller}: `q` must hold 'r' of one or two nodes, (k, 2) or (k, 3); received {q!r}.")
    r = q["r"]
    k, d = r.shape
    ground = jnp.asarray(np.eye(d), r.dtype)
    turned = _rotations(caller, q) if "R" in q or "theta" in q else None
    places = [*r, *[jnp.zeros_like(r[0])] * (2 - k)]
    for i, name in enumerate("ab"):
        if name not in each:
            continue
        if turned is None and i < k:
            raise ValueError(f"{caller}: `each` must hold no {name!r} for nodes that do not turn; received one.")
        A = ground if turned is None else turned[i]
        places[i] = places[i] + matvec(A, number(caller, each, name, r, (d,)))
    return places, ground if turned is None else turned[1]


def _rotations(caller: str, q: PyTree) -> list:
    """A_1 and A_2, where A_2 is that of the ground if there is one node."""
    k, d = q["r"].shape
    name, shape = ("theta", (k,)) if d == 2 else ("R", (k, 3, 3))
    require_nodes(caller, q, **{name: shape})
    if d == 2:
        sines, cosines = trigonometry.sincos(q["theta"])
        found = [jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])]) for s, c in zip(sines, cosines, strict=True)]
    else:
        found = list(q["R"])
    return [*found, *[jnp.asarray(np.eye(d), q["r"].dtype)] * (2 - k)]


def _turn(caller: str, q: PyTree, each: PyTree) -> Array:
    """The rotation of the second body relative to the first and `frame`: (1,) in the plane, (3,) in space; in rad if
    small."""
    if q["r"].shape[1] == 2:
        require_nodes(caller, q, theta=q["r"].shape[:1])
        theta = q["theta"]
        angle = (theta[1] if theta.size == 2 else 0) - theta[0]
        return (angle if "frame" not in each else angle - number(caller, each, "frame", theta))[None]
    R1, R2 = _rotations(caller, q)
    turn = rotation.product(R1.T, R2)
    if "frame" in each:
        turn = rotation.product(turn, number(caller, each, "frame", turn, (3, 3)).T)
    return rotation.vee(turn)


def _axis(caller: str, q: PyTree, each: PyTree) -> Array:
    require_each(caller, each, "axis")
    return number(caller, each, "axis", q["r"], q["r"].shape[1:])
