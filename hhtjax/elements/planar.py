"""The geometrically exact beam in the plane: nodes {"r": (2,), "theta": ()}."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from hhtjax import trigonometry
from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import number, numbers, require_each, require_nodes

STIFFNESS = "EA", "GA", "EI"


def planar_beam(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The force of a beam in the plane with arbitrarily large stretch, shear and bending.

    It has two nodes; positions and angles are linear in between. One integration point in the middle prevents locking
    of thin elements. With the angle theta_m = (theta_1 + theta_2)/2 + frame and its rotation A, the strains
    (`planar_strain`)

        Gamma = A^T (r_2 - r_1)/L - (1, 0),    kappa = (theta_2 - theta_1)/L

    have the energy V = L/2 (EA Gamma_1^2 + GA Gamma_2^2 + EI kappa^2), and the force is -dV/dq. A rigid motion rotates
    the force, and changes no strain. With damping, strains are replaced by strains plus `damping` times their rates.
    Displacements converge with order 2 in L. Under a moment at its end, the angles are exact with any number of
    elements.

    Args:
        q, v: {"r": (2, 2) in m, "theta": (2,) in rad} of two nodes; their rates.
        t, params: not used.
        each: "L", m, the undeformed length; "EA" and "GA", N, where GA includes the shear factor; "EI", N m^2.
            Optional: "damping", s: of the material; "frame", rad: the angle of the beam when its nodes have the angle
            0; "rest", (3,): the strains in the stress-free state, from `planar_strain`.

    Returns: {"r": (2, 2) in N, "theta": (2,) in N m}: the force on the nodes.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    Reference: E. Reissner, On one-dimensional finite-strain beam theory: the plane problem, Z. Angew. Math. Phys. 23,
    1972, 795-804.

    Example: stretched by a hundredth of its length.

    >>> each = {"L": 1.0, "EA": 1000.0, "GA": 400.0, "EI": 1.0}
    >>> q = {"r": jnp.array([[0.0, 0.0], [1.01, 0.0]]), "theta": jnp.zeros(2)}
    >>> print(planar_beam(q, jax.tree.map(jnp.zeros_like, q), 0.0, {}, each)["r"].round(3) + 0.0)
    [[ 10.   0.]
     [-10.   0.]]
    """
    strain, rates, pulls = _kinematics("planar_beam", q, each, STIFFNESS)
    stiffness = numbers("planar_beam", each, STIFFNESS, strain)
    if "damping" in each:
        strain = strain + number("planar_beam", each, "damping", strain) * rates(v)
    return pulls(stiffness * strain)


def planar_strain(q: PyTree, each: PyTree) -> jax.Array:
    """(Gamma_1, Gamma_2, kappa) of a `planar_beam`: stretch and shear, dimensionless, and curvature, 1/m.

    Multiplied by EA, GA and EI, they are the normal force, the shear force and the moment. For a beam that is curved in
    its stress-free state, put its strains in that state into `each` as "rest".

    Args: q, each: as in `planar_beam`; stiffnesses are not needed.
    Returns: (3,).
    Raises: TypeError, ValueError: as `planar_beam`.

    >>> q = {"r": jnp.array([[0.0, 0.0], [0.5, 0.0]]), "theta": jnp.array([-0.1, 0.1])}
    >>> print(planar_strain(q, {"L": 0.5}).round(6) + 0.0)
    [0.  0.  0.4]
    """
    return _kinematics("planar_strain", q, each, ())[0]


def planar_mass(q: PyTree, w: PyTree, params: PyTree, each: PyTree) -> dict:
    """M w of a `planar_beam`, consistent with its linear interpolation; exact for rigid motions.

        M = rhoA L/6 [[2, 1], [1, 2]] on r, and the same with rhoI on theta

    Args:
        q, w: {"r": (2, 2), "theta": (2,)} of two nodes, in m and rad; accelerations.
        params: not used.
        each: "L", m; "rhoA", kg/m; "rhoI", kg m: the moment of inertia of the section per length.

    Returns: {"r": (2, 2) in N, "theta": (2,) in N m}.
    Raises: TypeError, ValueError: as `planar_beam`.

    >>> w = {"r": jnp.ones((2, 2)), "theta": jnp.zeros(2)}
    >>> print(planar_mass(w, w, {}, {"L": 2.0, "rhoA": 3.0, "rhoI": 0.1})["r"])
    [[3. 3.]
     [3. 3.]]
    """
    require_nodes("planar_mass", q, r=(2, 2), theta=(2,))
    require_each("planar_mass", each, "L", "rhoA", "rhoI")
    L, of_r, of_theta = numbers("planar_mass", each, ("L", "rhoA", "rhoI"), w["r"])
    return {"r": of_r * L * between(w["r"]), "theta": of_theta * L * between(w["theta"])}


def planar_lumped_mass(nodes: Array, each: PyTree, num_nodes: int) -> dict:
    """The diagonal mass of all beams in the plane together: half of each beam goes to either node.

    Args:
        nodes: (E, 2), integers: the nodes of each beam.
        each: "L", m; "rhoA", kg/m; "rhoI", kg m; each a number or (E,).
        num_nodes: N, the number of nodes of the system.

    Returns: {"r": (N, 2) in kg, "theta": (N,) in kg m^2}.
    Raises: ValueError: numbers that are missing or misspelt.

    >>> pairs = jnp.array([[0, 1], [1, 2]])
    >>> print(planar_lumped_mass(pairs, {"L": 0.5, "rhoA": 4.0, "rhoI": 0.1}, 3)["r"][:, 0])
    [1. 2. 1.]
    """
    require_each("planar_lumped_mass", each, "L", "rhoA", "rhoI")
    m, J = (lumped(nodes, jnp.asarray(each["L"]) * each[name] / 2, num_nodes) for name in ("rhoA", "rhoI"))
    return {"r": jnp.stack([m, m], axis=1), "theta": J}


def between(x: Array) -> jax.Array:
    """[[2, 1], [1, 2]]/6, applied to the first axis, which counts two nodes."""
    return (x + jnp.sum(x, axis=0, keepdims=True)) / 6


def lumped(nodes: Array, half: Array, num_nodes: int) -> jax.Array:
    """(N,), the halves of elements, summed at their nodes."""
    nodes = jnp.asarray(nodes)
    half = jnp.broadcast_to(half, nodes.shape[:1])
    return jnp.zeros(num_nodes, half.dtype).at[nodes].add(jnp.stack([half, half], axis=1))


def _kinematics(caller: str, q: PyTree, each: PyTree, stiffness: tuple):
    """The strains (3,); their rates as a function of v; and the force on the nodes as a function of the stresses, which
    is -L times the transpose of the rates."""
    require_nodes(caller, q, r=(2, 2), theta=(2,))
    require_each(caller, each, "L", *stiffness)
    r, theta = q["r"], q["theta"]
    L = number(caller, each, "L", r)
    angle = (theta[0] + theta[1]) / 2
    if "frame" in each:
        angle = angle + number(caller, each, "frame", r)
    s, c = trigonometry.sincos(angle)

    def turned(x: Array):  # A^T x
        return c * x[0] + s * x[1], c * x[1] - s * x[0]

    stretch, shear = turned((r[1] - r[0]) / L)
    strain = jnp.stack([stretch - 1, shear, (theta[1] - theta[0]) / L])
    if "rest" in each:
        strain = strain - number(caller, each, "rest", r, (3,))

    def rates(v: PyTree) -> Array:
        along, across = turned((v["r"][1] - v["r"][0]) / L)
        spin = (v["theta"][0] + v["theta"][1]) / 2
        return jnp.stack([along + shear * spin, across - stretch * spin, (v["theta"][1] - v["theta"][0]) / L])

    def pulls(section: Array) -> dict:
        N, V, M = section
        force = jnp.stack([c * N - s * V, s * N + c * V])
        half = L / 2 * (shear * N - stretch * V)
        return {"r": jnp.stack([force, -force]), "theta": jnp.stack([M - half, -M - half])}

    return strain, rates, pulls
