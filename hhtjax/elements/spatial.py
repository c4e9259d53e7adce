"""The geometrically exact beam in space: nodes {"r": (3,), "R": (3, 3)}."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hhtjax import rotation
from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import number, numbers, require_each, require_nodes
from hhtjax.elements.planar import between, lumped
from hhtjax.numerics.dense_lu import matvec

STIFFNESS = "EA", "GAy", "GAz", "GJ", "EIy", "EIz"


def spatial_beam(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The force of a beam in space with arbitrarily large stretch, shear, bending and twist.

    The x axis of the beam's frame (R of a node, or R frame) is the beam's axis; y and z are the principal axes of its
    cross-section. The beam has two nodes. One integration point in the middle prevents locking of thin elements. In
    between, positions are linear, and rotations are R(s) = R_1 exp(s psi), psi = log(R_1^T R_2). With R_m, the rotation
    in the middle, the strains (`spatial_strain`)

        Gamma = R_m^T (r_2 - r_1)/L - (1, 0, 0),    kappa = psi/L

    have the energy

        V = L/2 (EA Gamma_x^2 + GAy Gamma_y^2 + GAz Gamma_z^2 + GJ kappa_x^2 + EIy kappa_y^2 + EIz kappa_z^2).

    The force is its exact gradient -dV/dx along displacements (r + x, R exp(x)); it uses the rates for material angular
    velocities,

        psidot = T(psi)^-1 Om_2 - T(psi)^-T Om_1,    Om_m = (Om_1 + Om_2)/2 + tan(|psi|/4)/(2 |psi|) psi x (Om_2 - Om_1)

    A rigid motion rotates the force, and changes no strain. With damping, strains are replaced by strains plus
    `damping` times their rates. Displacements converge with order 2 in L. The relative rotation of neighbouring nodes
    must be below pi.

    Args:
        q: {"r": (2, 3) in m, "R": (2, 3, 3)} of two nodes.
        v: {"r": (2, 3) in m/s, "R": (2, 3) in rad/s}, the latter material angular velocities.
        t, params: not used.
        each: "L", m, the undeformed length; "EA", "GAy" and "GAz", N, where the latter two include the shear factors;
            "GJ", "EIy" and "EIz", N m^2: EIy for bending about y, in the plane of x and z. Optional: "damping", s: of
            the material; "frame", (3, 3): a rotation, whose columns are the axes of the beam in the frames of its
            nodes; "rest", (6,): the strains in the stress-free state, from `spatial_strain`.

    Returns: {"r": (2, 3) in N, "R": (2, 3) in N m}, the latter moments in material components.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    References:
        J. Simo, L. Vu-Quoc, A three-dimensional finite-strain rod model, part II, Comput. Methods Appl. Mech. Eng. 58,
        1986, 79-116; M. Crisfield, G. Jelenic, Objectivity of strain measures in the geometrically exact
        three-dimensional beam theory and its finite-element implementation, Proc. R. Soc. Lond. A 455, 1999, 1125-1147.

    Example: twisted by a tenth of a radian.

    >>> each = {"L": 1.0, "EA": 1e3, "GAy": 400.0, "GAz": 400.0, "GJ": 2.0, "EIy": 1.0, "EIz": 1.0}
    >>> twist = rotation.exp(jnp.array([0.1, 0.0, 0.0]))
    >>> q = {"r": jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), "R": jnp.stack([jnp.eye(3), twist])}
    >>> v = {"r": jnp.zeros((2, 3)), "R": jnp.zeros((2, 3))}
    >>> print(spatial_beam(q, v, 0.0, {}, each)["R"].round(3) + 0.0)
    [[ 0.2  0.   0. ]
     [-0.2  0.   0. ]]
    """
    strain, rates, pulls = _kinematics("spatial_beam", q, each, STIFFNESS)
    stiffness = numbers("spatial_beam", each, STIFFNESS, strain)
    if "damping" in each:
        strain = strain + number("spatial_beam", each, "damping", strain) * rates(v)
    return pulls(stiffness * strain)


def spatial_strain(q: PyTree, each: PyTree) -> jax.Array:
    """(Gamma, kappa) of a `spatial_beam`: stretch and shears, dimensionless, twist and curvatures, 1/m.

    Multiplied by the stiffnesses, they are the forces and moments in the cross-section, in the beam's frame. For a beam
    that is curved or twisted in its stress-free state, put its strains in that state into `each` as "rest".

    Args: q, each: as in `spatial_beam`; stiffnesses are not needed.
    Returns: (6,).
    Raises: TypeError, ValueError: as `spatial_beam`.

    >>> ends = jnp.stack([rotation.exp(jnp.array([0.0, 0.0, angle])) for angle in (-0.1, 0.1)])
    >>> q = {"r": jnp.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]]), "R": ends}
    >>> print(spatial_strain(q, {"L": 0.5}).round(6) + 0.0)
    [0.  0.  0.  0.  0.  0.4]
    """
    return _kinematics("spatial_strain", q, each, ())[0]


def spatial_mass(q: PyTree, w: PyTree, params: PyTree, each: PyTree) -> dict:
    """M w of a `spatial_beam`: consistent with linear positions; each node gets half of the moments of inertia.

        M = rhoA L/6 [[2, 1], [1, 2]] on r,    J = L/2 diag(rhoIy + rhoIz, rhoIy, rhoIz) on each Om, in the beam's frame

    Exact for rigid motions. M is constant; the only further inertia force is `gyroscopic` at the nodes, with this J.

    Args:
        q, w: of two nodes, {"r": (2, 3) in m, "R": (2, 3, 3)}; accelerations {"r": (2, 3), "R": (2, 3)}.
        params: not used.
        each: "L", m; "rhoA", kg/m; "rhoIy" and "rhoIz", kg m: the moments of inertia of the cross-section per length.
            Optional: "frame", as in `spatial_beam`.

    Returns: {"r": (2, 3) in N, "R": (2, 3) in N m}.
    Raises: TypeError, ValueError: as `spatial_beam`.

    >>> q = {"r": jnp.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), "R": jnp.stack([jnp.eye(3)] * 2)}
    >>> w = {"r": jnp.ones((2, 3)), "R": jnp.ones((2, 3))}
    >>> print(spatial_mass(q, w, {}, {"L": 2.0, "rhoA": 3.0, "rhoIy": 0.1, "rhoIz": 0.2})["R"])
    [[0.3 0.1 0.2]
     [0.3 0.1 0.2]]
    """
    require_nodes("spatial_mass", q, r=(2, 3), R=(2, 3, 3))
    require_each("spatial_mass", each, "L", "rhoA", "rhoIy", "rhoIz")
    L, rhoA, y, z = numbers("spatial_mass", each, ("L", "rhoA", "rhoIy", "rhoIz"), w["r"])
    J = L / 2 * jnp.stack([y + z, y, z])
    B = _frame("spatial_mass", each, w["r"])
    moments = [J * Om if B is None else matvec(B, J * matvec(B.T, Om)) for Om in w["R"]]
    return {"r": rhoA * L * between(w["r"]), "R": jnp.stack(moments)}


def spatial_lumped_mass(nodes: Array, each: PyTree, num_nodes: int) -> dict:
    """The diagonal mass of all beams in space together: half of each beam goes to either node.

    Its "R" is the "J" of `gyroscopic`, for elements with one node.

    Args:
        nodes: (E, 2), integers: the nodes of each beam.
        each: "L", m; "rhoA", kg/m; "rhoIy" and "rhoIz", kg m; each a number or (E,). With a "frame" the mass would not
            be diagonal: use `spatial_mass`.
        num_nodes: N, the number of nodes of the system.

    Returns: {"r": (N, 3) in kg, "R": (N, 3) in kg m^2}.
    Raises: ValueError: numbers that are missing or misspelt, or a frame.

    >>> pairs = jnp.array([[0, 1], [1, 2]])
    >>> print(spatial_lumped_mass(pairs, {"L": 0.5, "rhoA": 4.0, "rhoIy": 0.1, "rhoIz": 0.3}, 3)["R"])
    [[0.1   0.025 0.075]
     [0.2   0.05  0.15 ]
     [0.1   0.025 0.075]]
    """
    require_each("spatial_lumped_mass", each, "L", "rhoA", "rhoIy", "rhoIz")
    if "frame" in each:
        raise ValueError("spatial_lumped_mass: `each` must hold no 'frame'; received one. Take spatial_mass.")
    m, y, z = (lumped(nodes, jnp.asarray(each["L"]) * each[name] / 2, num_nodes) for name in ("rhoA", "rhoIy", "rhoIz"))
    return {"r": jnp.stack([m, m, m], axis=1), "R": jnp.stack([y + z, y, z], axis=1)}


def _frame(caller: str, each: PyTree, like: Array):
    return number(caller, each, "frame", like, (3, 3)) if "frame" in each else None


def _kinematics(caller: str, q: PyTree, each: PyTree, stiffness: tuple):
    """The strains (6,); their rates as a function of v; and the force on the nodes as a function of the stresses, which
    is -L times the transpose of the rates."""
    require_nodes(caller, q, r=(2, 3), R=(2, 3, 3))
    require_each(caller, each, "L", *stiffness)
    r, (R1, R2) = q["r"], q["R"]
    L, B = number(caller, each, "L", r), _frame(caller, each, r)
    psi = rotation.log(rotation.product(R1.T, R2))
    middle = rotation.product(R1, rotation.exp(psi / 2))

    def in_beam(x: Array) -> Array:  # from the frame of the middle
        return x if B is None else matvec(B.T, x)

    along = matvec(middle.T, (r[1] - r[0]) / L)
    strain = jnp.concatenate([in_beam(along) - np.eye(3, dtype=r.dtype)[0], in_beam(psi) / L])
    if "rest" in each:
        strain = strain - number(caller, each, "rest", r, (6,))
    inverse, share = rotation.inverse_tangent(psi), _share(psi)

    def rates(v: PyTree) -> Array:
        (dr1, dr2), (Om1, Om2) = v["r"], v["R"]
        spin = (Om1 + Om2) / 2 + share * rotation.cross(psi, Om2 - Om1)
        stretching = matvec(middle.T, (dr2 - dr1) / L) + rotation.cross(along, spin)
        bending = matvec(inverse, Om2) - matvec(inverse.T, Om1)
        return jnp.concatenate([in_beam(stretching), in_beam(bending) / L])

    def pulls(section: Array) -> dict:
        n, m = section[:3], section[3:]
        if B is not None:
            n, m = matvec(B, n), matvec(B, m)
        force, moment = matvec(middle, n), L * rotation.cross(n, along)
        half, more = moment / 2, share * rotation.cross(moment, psi)
        first, second = matvec(inverse, m) - half + more, -matvec(inverse.T, m) - half - more
        return {"r": jnp.stack([force, -force]), "R": jnp.stack([first, second])}

    return strain, rates, pulls


def _share(psi: Array) -> Array:
    """tan(|psi|/4)/(2 |psi|), smooth at 0."""
    x = jnp.sum(psi**2) / 16
    c1, c2, *_ = rotation.coefficients(x)
    return c1 / (8 * (1 - x * c2))
