"""Forces along one direction or about one axis: bars, springs with dampers, torsion springs."""

from __future__ import annotations

import jax.numpy as jnp

from hhtjax import rotation
from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import number, numbers, require_each, require_nodes, shape_of
from hhtjax.numerics.dense_lu import matvec


def truss(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The force EA (l - L)/L of a bar along its line; its length is l = |r_2 - r_1|.

    Args:
        q: {"r": (2, d) in m} of two nodes, d = 2 or 3. v, t, params: not used.
        each: "L", m, the undeformed length; "EA", N.

    Returns: {"r": (2, d) in N}: the force on the nodes; 0 if l = 0, where the line has no direction.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    >>> q = {"r": jnp.array([[0.0, 0.0], [0.0, 1.1]])}
    >>> print(truss(q, {}, 0.0, {}, {"L": 1.0, "EA": 100.0})["r"].round(3) + 0.0)
    [[  0.  10.]
     [  0. -10.]]
    """
    length, direction = _line("truss", q, each, "L", "EA")
    L, EA = numbers("truss", each, ("L", "EA"), direction)
    return _pull(EA * (length - L) / L, direction)


def spring_damper(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The force k (l - L) + c dl/dt of a spring and a damper along their line; its length is l = |r_2 - r_1|.

    Args:
        q, v: {"r": (2, d) in m} of two nodes, d = 2 or 3; their rates. t, params: not used.
        each: "L", m, the undeformed length, which may be 0; "k", N/m; optional "c", N s/m.

    Returns: {"r": (2, d) in N}: the force on the nodes; 0 if l = 0, where the line has no direction.
    Raises: TypeError, ValueError: as `truss`.

    >>> q, v = {"r": jnp.array([[0.0, 0.0], [0.0, 1.1]])}, {"r": jnp.array([[0.0, 0.0], [3.0, 2.0]])}
    >>> print(spring_damper(q, v, 0.0, {}, {"L": 1.0, "k": 100.0, "c": 1.0})["r"].round(3) + 0.0)
    [[  0.  12.]
     [  0. -12.]]
    """
    length, direction = _line("spring_damper", q, each, "L", "k")
    L, k = numbers("spring_damper", each, ("L", "k"), direction)
    force = k * (length - L)
    if "c" in each:
        rate = jnp.sum(direction * (v["r"][1] - v["r"][0]))
        force = force + number("spring_damper", each, "c", direction) * rate
    return _pull(force, direction)


def torsion_spring(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The moment k phi + c dphi/dt of a torsion spring and damper between two bodies.

    In the plane phi = theta_2 - theta_1 - angle. In space phi = log(R_1^T R_2), the rotation vector; dphi/dt stands for
    the angular velocity of body 2 relative to body 1; |phi| < pi.

    Args:
        q, v: {"theta": (2,)} or {"R": (2, 3, 3)} of two nodes; {"theta": (2,)} or {"R": (2, 3)}, rad/s.
        t, params: not used.
        each: "k", N m/rad; optional "c", N m s/rad, and in the plane "angle", rad, the angle at which it is relaxed.

    Returns: {"theta": (2,)} or {"R": (2, 3)}, N m: the moment on the nodes, in material components.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    >>> print(torsion_spring({"theta": jnp.array([0.0, 0.5])}, {}, 0.0, {}, {"k": 2.0, "angle": 0.1})["theta"])
    [ 0.8 -0.8]
    """
    require_each("torsion_spring", each, "k")
    if "R" not in q:
        require_nodes("torsion_spring", q, theta=(2,))
        phi = q["theta"][1] - q["theta"][0]
        if "angle" in each:
            phi = phi - number("torsion_spring", each, "angle", phi)
        moment = number("torsion_spring", each, "k", phi) * phi
        if "c" in each:
            moment = moment + number("torsion_spring", each, "c", phi) * (v["theta"][1] - v["theta"][0])
        return {"theta": jnp.stack([moment, -moment])}
    require_nodes("torsion_spring", q, R=(2, 3, 3))
    turn = rotation.product(q["R"][0].T, q["R"][1])
    phi = rotation.log(turn)
    first = second = number("torsion_spring", each, "k", phi) * phi  # the axis is the same in both frames
    if "c" in each:
        rate = v["R"][1] - matvec(turn.T, v["R"][0])
        second = second + number("torsion_spring", each, "c", phi) * rate
        first = matvec(turn, second)
    return {"R": jnp.stack([first, -second])}


def _line(caller: str, q: PyTree, each: PyTree, *needed: str):
    """The length, and the unit vector from node 1 to node 2; derivatives are finite at length 0, too."""
    require_nodes(caller, q, r=(2, shape_of(q, "r")[-1]))
    require_each(caller, each, *needed)
    d = q["r"][1] - q["r"][0]
    x = jnp.sum(d**2)
    apart = x > 0
    length = jnp.where(apart, jnp.sqrt(jnp.where(apart, x, 1)), 0)
    return length, d / jnp.where(apart, length, 1)


def _pull(force: Array, direction: Array) -> dict:
    return {"r": jnp.stack([force * direction, -force * direction])}
