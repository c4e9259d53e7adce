"""Forces on single nodes: weight, and the gyroscopic moment of a rotating body."""

from __future__ import annotations

import jax.numpy as jnp

from hhtjax import rotation
from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import number, require_each, require_nodes, shape_of
from hhtjax.numerics.dense_lu import matvec


def gravity(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The weight of an element: m g, distributed equally over its nodes.

    With one node it is the weight of a body whose centre of mass is the node. On two nodes of an ANCF cable, the cubic
    shape functions distribute the load, and the slopes get m L g/12 and -m L g/12, too.

    Args:
        q: {"r": (k, d)} of k nodes, and "slope" if they have one. v, t: not used.
        params: "gravity", (d,), m/s^2: the vector g, which points downwards.
        each: "m", kg: of the element, for a beam rhoA L. "L", m, if nodes have slopes.

    Returns: {"r": (k, d) in N}, and "slope" (k, d), in N m, if nodes have one.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    >>> q = {"r": jnp.zeros((2, 3)), "R": jnp.stack([jnp.eye(3)] * 2)}
    >>> print(gravity(q, {}, 0.0, {"gravity": jnp.array([0.0, 0.0, -10.0])}, {"m": 3.0})["r"] + 0.0)
    [[  0.   0. -15.]
     [  0.   0. -15.]]
    """
    k, d = shape_of(q, "r")
    require_nodes("gravity", q, r=(k, d))
    require_each("gravity", each, *(("m", "L") if "slope" in q else ("m",)))
    if not isinstance(params, dict) or jnp.shape(params.get("gravity", 0)) != (d,):
        raise ValueError(f"gravity: `params` must hold 'gravity' in shape {(d,)}; received {params!r}.")
    weight = number("gravity", each, "m", q["r"]) * jnp.asarray(params["gravity"], q["r"].dtype)
    shares = {"r": jnp.stack([weight / k] * k)}
    if "slope" in q:
        moment = number("gravity", each, "L", q["r"]) / 12 * weight
        shares["slope"] = jnp.stack([moment, -moment])
    return shares


def gyroscopic(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """-Om x J Om, in N m, on each node of an element: the gyroscopic moment of a rotating rigid body.

    Args:
        q, v: of k nodes, {"R": (k, 3, 3)}; {"R": (k, 3)}, material angular velocities, rad/s.
        t, params: not used.
        each: "J", kg m^2: (3, 3), the inertia about the node in its own frame, or (3,), its diagonal.

    Returns: {"R": (k, 3) in N m}, in material components.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    >>> q, v = {"R": jnp.eye(3)[None]}, {"R": jnp.array([[1.0, 2.0, 0.0]])}
    >>> print(gyroscopic(q, v, 0.0, {}, {"J": jnp.array([1.0, 2.0, 3.0])})["R"])
    [[ 0.  0. -2.]]
    """
    require_nodes("gyroscopic", q, R=(shape_of(q, "R")[0], 3, 3))
    require_each("gyroscopic", each, "J")
    shape = (3, 3) if jnp.ndim(each["J"]) == 2 else (3,)
    J = number("gyroscopic", each, "J", v["R"], shape)
    return {"R": jnp.stack([rotation.cross(matvec(J, Om), Om) for Om in v["R"]])}
