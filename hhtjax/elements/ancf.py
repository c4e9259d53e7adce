"""The cable of the absolute nodal coordinate formulation: nodes {"r": (d,), "slope": (d,)}, d = 2 or 3."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from hhtjax.description import Array, PyTree
from hhtjax.elements.arguments import numbers, require_each, require_nodes, shape_of

MASS = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420  # of length 1
POINTS = 3  # of Gauss: two would let one stretching go without a force, five lock more and end no closer


def ancf_cable(q: PyTree, v: PyTree, t: Array, params: PyTree, each: PyTree) -> dict:
    """The force of a thin cable or beam with large stretch and bending, without shear and twist; no rotations are
    needed.

    The position r(x), 0 <= x <= L, is the cubic with the ends r_1, r_2 and the slopes r'_1, r'_2 (dr/dx, of length 1 if
    nothing is stretched). The force is -dV/dq of
    nothing is stretched). The force is -dV/dq of

        V = int EA/2 eps^2 + EI/2 kappa^2 dx,    eps = |r'| - 1,    kappa = |r' x r''|/|r'|^2

    integrated with 3 Gauss points. kappa is the rotation per undeformed length, so EI kappa is the moment of a
    stretched cable, too. (With eps = (|r'|^2 - 1)/2 and the curvature |r' x r''|/|r'|^3 of the deformed line, the tip
    of a cantilever that is stretched by .0006 moves a thousandth too far.) Displacements converge with order 4 in L,
    once an element rotates by less than about .1 rad. Coarse meshes are too stiff, because stretch and bending of
    cubics are not independent. |r'| must not be 0.

    Args:
        q: {"r": (2, d) in m, "slope": (2, d), dimensionless} of two nodes. v: not used.
        t, params: not used.
        each: "L", m, the undeformed length; "EA", N; "EI", N m^2.

    Returns: {"r": (2, d) in N, "slope": (2, d) in N m}: the force on the nodes.
    Raises: TypeError, ValueError: leaves or numbers that are missing, misspelt, or of another shape.

    References:
        J. Gerstmayr, A. Shabana, Analysis of thin beams and cables using the absolute nodal co-ordinate formulation,
        Nonlinear Dyn. 45, 2006, 109-130; J. Gerstmayr, H. Irschik, On the correct representation of bending and axial
        deformation in the absolute nodal coordinate formulation with an elastic line approach, J. Sound Vib. 318, 2008,
        461-487, for eps and kappa.

    Example: stretched by a hundredth of its length.

    >>> q = {"r": jnp.array([[0.0, 0.0], [1.01, 0.0]]), "slope": jnp.array([[1.01, 0.0], [1.01, 0.0]])}
    >>> print(ancf_cable(q, q, 0.0, {}, {"L": 1.0, "EA": 1000.0, "EI": 1.0})["r"].round(3) + 0.0)
    [[ 10.   0.]
     [-10.   0.]]
    """
    _require("ancf_cable", q, each, "L", "EA", "EI")
    L, EA, EI = numbers("ancf_cable", each, ("L", "EA", "EI"), q["r"])
    first, second, weights = slopes(POINTS, q["r"].dtype)

    e = _coordinates(q, L) / L
    a, b = _times(first, e), _times(second, e) / L  # r', r''
    x, y = jnp.sum(a**2, axis=1, keepdims=True), jnp.sum(a * b, axis=1, keepdims=True)
    across = b - y / x * a  # of r'', to r': smooth where kappa = 0
    curved = jnp.sum(across**2, axis=1, keepdims=True)
    w = weights[:, None]
    of_a = w * (EA * (1 - 1 / jnp.sqrt(x)) * a - EI / x**2 * (curved * a + y * across))  # slopes of the energy
    of_b = w * EI / x * across
    pull = -_times(first.T, of_a) - _times(second.T, of_b) / L
    return {"r": pull[::2], "slope": L * pull[1::2]}


def ancf_mass(q: PyTree, w: PyTree, params: PyTree, each: PyTree) -> dict:
    """M w of an `ancf_cable`: rhoA int S^T S dx with its cubic shape functions S. M is constant, and exact.

    Args:
        q, w: {"r": (2, d), "slope": (2, d)} of two nodes; accelerations.
        params: not used.
        each: "L", m; "rhoA", kg/m.

    Returns: {"r": (2, d) in N, "slope": (2, d) in N m}.
    Raises: TypeError, ValueError: as `ancf_cable`.

    >>> w = {"r": jnp.ones((2, 2)), "slope": jnp.zeros((2, 2))}
    >>> print(ancf_mass(w, w, {}, {"L": 2.0, "rhoA": 3.0})["r"].round(3))
    [[3. 3.]
     [3. 3.]]
    """
    _require("ancf_mass", q, each, "L", "rhoA")
    L, rhoA = numbers("ancf_mass", each, ("L", "rhoA"), w["r"])
    f = rhoA * L * _times(MASS.astype(w["r"].dtype), _coordinates(w, L))
    return {"r": f[::2], "slope": L * f[1::2]}


def slopes(points: int, dtype: np.dtype) -> tuple:
    """dS/ds and d^2S/ds^2 of the shape functions S at Gauss points of (0, 1), (points, 4) each, and the weights.

    S multiplies (r_1, L r'_1, r_2, L r'_2), and s = x/L.
    """
    s, weights = np.polynomial.legendre.leggauss(points)
    s = (s + 1) / 2
    first = np.stack([6 * s**2 - 6 * s, 3 * s**2 - 4 * s + 1, 6 * s - 6 * s**2, 3 * s**2 - 2 * s], axis=1)
    second = np.stack([12 * s - 6, 6 * s - 4, 6 - 12 * s, 6 * s - 2], axis=1)
    return first.astype(dtype), second.astype(dtype), (weights / 2).astype(dtype)


def _coordinates(q: PyTree, L: Array) -> Array:
    """(r_1, L r'_1, r_2, L r'_2), (4, d)."""
    return jnp.stack([q["r"][0], L * q["slope"][0], q["r"][1], L * q["slope"][1]])


def _times(A: np.ndarray, x: Array) -> Array:
    return jnp.matmul(A, x, precision="highest")


def _require(caller: str, q: PyTree, each: PyTree, *needed: str):
    shape = (2, shape_of(q, "r")[-1])
    require_nodes(caller, q, r=shape, slope=shape)
    require_each(caller, each, *needed)
